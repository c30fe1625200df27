"""The linear spring of the paper's two-spring models, with or without tension."""

from __future__ import annotations

from dataclasses import dataclass, replace

from foamfit.springs.laws.bistable import K0
from foamfit.springs.laws.record import Law
from foamfit.springs.spring import Relaxation, Spring, freeze


@dataclass(frozen=True)
class LinearSpring(Spring):
    """The linear spring S1 of the two-spring models, σ = k0 ε, with a dashpot in parallel.

    Parameters
    ----------
    k0 : float
        Slope, Pa.
    eta : float
        η, dashpot in parallel, Pa·s.
    unilateral : bool
        Whether the spring carries no tension.

    Raises
    ------
    ValueError
        If a parameter is not admissible; the message names it.
    """

    k0: float
    eta: float = 0.0
    unilateral: bool = False

    def __post_init__(self) -> None:
        """Raise InputError for an inadmissible value; the message names it."""
        freeze(self, LAW)

    @property
    def law(self) -> Law:
        """The record of its law."""
        return UNILATERAL_LAW if self.unilateral else LAW

    @property
    def relaxation(self) -> Relaxation:
        """Relaxation terms; a linear spring has none."""
        return ()


def _unilateral(k0: float, eta: float = 0.0) -> LinearSpring:
    return LinearSpring(k0, eta, unilateral=True)


LAW = Law(
    kind="linear",
    title="linear spring",
    params=(replace(K0, what="slope", branch="", example="60 MPa"),),
    functions="bistable.LINEAR",
    branches={"line": "linear"},
    hysteretic=False,
    spring=LinearSpring,
    remembers=False,
)  # fmt: skip
UNILATERAL_LAW = replace(
    LAW, kind="unilateral", title="linear spring without tension", spring=_unilateral,
    functions="bistable.UNILATERAL",
    branches={"line": "linear", "open": "out of contact"},
)  # fmt: skip
