"""The linear spring S1 of the two-spring models, σ = k0 ε, and one that carries no tension."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from foamfit.springs.law import BRANCH_NAMES
from foamfit.springs.laws.record import Compared, Functions, Law, Param
from foamfit.springs.spring import Relaxation, Spring, freeze_numbers


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
        If true the spring carries no tension.

    Raises
    ------
    ValueError
        If a parameter is not admissible; the message names it.
    """

    k0: float
    eta: float = 0.0
    unilateral: bool = False

    def __post_init__(self) -> None:
        """Refuse what is not admissible, by name."""
        freeze_numbers(self, LAW)

    @property
    def law(self) -> Law:
        """The record of its law."""
        return UNILATERAL_LAW if self.unilateral else LAW

    @property
    def relaxation(self) -> Relaxation:
        """Relaxation terms: a linear spring has none."""
        return ()


def _unilateral(k0: float, eta: float = 0.0) -> LinearSpring:
    return LinearSpring(k0, eta, unilateral=True)


def _functions(kind: str) -> Functions:
    from foamfit.springs.laws import followed

    return followed.functions_of(kind)


LAW = Law(
    kind="linear",
    title="linear spring",
    params=(
        Param(
            "k0", ("k", "0"), "Pa", "slope", (3.0, "slope"), (1e-3, 1e4), "stress",
            inner=(math.log(0.3), math.log(300.0)), example="60 MPa",
        ),
    ),
    numbered=BRANCH_NAMES,
    functions=lambda: _functions("linear"),
    branches={"line": "linear"},
    hysteretic=False,
    spring=LinearSpring,
    compared=(
        Compared("k0", "MPa", ("k0",), lambda k0: k0 / 1e6),
        Compared("η", "Pa·s", ("eta",), lambda eta: eta),
        Compared("h", "mm", ("height",), lambda height: height / 1e-3),
    ),
    inner_loops=False,
    remembers=False,
    published=True,
)  # fmt: skip
UNILATERAL_LAW = replace(
    LAW, kind="unilateral", title="linear spring without tension", spring=_unilateral,
    functions=lambda: _functions("unilateral"),
    branches={"line": "linear", "open": "out of contact"},
)  # fmt: skip
