"""Chains of springs and masses, and the drives that act on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.springs.laws.record import Law
from foamfit.springs.spring import Spring, as_history, as_number


def _finite(value: object, name: str, strict: bool) -> float:
    number = as_number(value, name)
    if not math.isfinite(number) or number < 0.0 or (strict and number == 0.0):
        wanted = "greater than 0" if strict else "at least 0"
        raise InputError(f"{name} = {number:g} is not admissible: it must be finite and {wanted}")
    return number


def _listed(values: Any, name: str, wanted: str) -> tuple[Any, ...]:
    """Return a sequence as a tuple; InputError for anything else."""
    try:
        if not isinstance(values, str | bytes):
            return tuple(values)
    except TypeError:
        pass
    raise InputError(
        f"{name} = {values!r} is not admissible: it must be a sequence of {wanted}, base first"
    )


class ChainArrays(NamedTuple):
    """A chain in the form that the solver uses.

    rows (n_springs, columns) are the springs (`compiled.fill_row`), padded with zeros; heights
    (m) are (n_springs,). `ends` are one past the last spring below each interior mass and the top,
    `inside` the interior masses over the area (kg/m²), `damped` whether there are dashpots,
    `steep` the sum of the heights times the steepest slopes at zero stress (Pa·m).
    """

    rows: Array
    heights: Array
    ends: tuple[int, ...]
    inside: tuple[float, ...]
    damped: bool
    steep: float


@dataclass(frozen=True, init=False)
class Chain:
    """Springs from the base up, with the masses between and above them.

    Parameters
    ----------
    springs : sequence of springs
        Base first: BistableSpring, MicroscaleSpring, LinearSpring, or springs of a registered law.
    heights : sequence of float
        Height h_i of each spring, m.
    area : float
        Cross-section A, m².
    masses : sequence of float, optional
        Mass above each spring, kg; 0 = massless. By default all are massless.
    site_damping : float
        Onsite damper η_site of the paper, acting on the top mass, Pa·s.

    Raises
    ------
    ValueError
        If a value is not admissible; the message names it.
    """

    springs: tuple[Spring, ...]
    heights: tuple[float, ...]
    area: float
    masses: tuple[float, ...] = ()
    site_damping: float = 0.0

    def __init__(
        self,
        springs: Sequence[Spring],
        heights: Sequence[float],
        area: float,
        masses: Sequence[float] | None = None,
        site_damping: float = 0.0,
    ) -> None:
        """Check the arguments and make the chain immutable."""
        springs = _listed(springs, "springs", "springs")
        n = len(springs)
        if n == 0:
            raise InputError("springs is empty: a chain needs at least one spring")
        for i, spring in enumerate(springs, start=1):
            if not isinstance(spring, Spring):
                known = "a BistableSpring, a MicroscaleSpring or a LinearSpring"
                raise InputError(
                    f"springs: spring {i} is a {type(spring).__name__}; it must be {known}"
                )
        heights = _listed(heights, "heights", "numbers")
        masses = _listed([0.0] * n if masses is None else masses, "masses", "numbers")
        for name, values in (("heights", heights), ("masses", masses)):
            if len(values) != n:
                raise InputError(
                    f"{name} has {len(values)} values for {n} springs: give one per spring"
                )
        put = object.__setattr__
        put(self, "springs", tuple(springs))
        put(self, "heights", tuple(_finite(h, "heights", True) for h in heights))
        put(self, "area", _finite(area, "area", True))
        put(self, "masses", tuple(_finite(m, "masses", False) for m in masses))
        put(self, "site_damping", _finite(site_damping, "site_damping", False))

    @cached_property
    def height(self) -> float:
        """Overall height H = Σ h_i, m."""
        return math.fsum(self.heights)

    @cached_property
    def laws(self) -> tuple[Law, ...]:
        """The law of each spring."""
        return tuple(spring.law for spring in self.springs)

    @cached_property
    def relaxes(self) -> bool:
        """Whether a spring has a nonzero relaxation term."""
        return any(g > 0.0 for spring in self.springs for g, _ in spring.relaxation)

    @cached_property
    def relaxation(self) -> tuple[int, ...]:
        """Number of relaxation terms of each spring."""
        return tuple(len(spring.relaxation) for spring in self.springs)

    @cached_property
    def arrays(self) -> ChainArrays:
        """The chain in the form that the solver uses."""
        from foamfit.springs.compiled import compiled, slopes_of

        room = max(self.relaxation)
        made = [one.solver_row(room) for one in self.springs]
        rows = np.zeros((len(made), max(row.size for row in made)))
        for line, row in zip(rows, made, strict=True):
            line[: row.size] = row
        steep = slopes_of([compiled(law) for law in self.laws], rows[:, 1 + 2 * room :])[1]
        heavy = [i for i, mass in enumerate(self.masses[:-1]) if mass > 0.0]
        return ChainArrays(
            rows=rows,
            heights=np.array(self.heights),
            ends=(*(i + 1 for i in heavy), len(self.springs)),
            inside=tuple(self.masses[i] / self.area for i in heavy),
            damped=any(spring.eta > 0.0 for spring in self.springs),
            steep=float(steep @ np.array(self.heights)),
        )


@dataclass(frozen=True)
class Impact:
    """A striker of `mass` (kg) meets the top of the chain with `velocity` (m/s) at t = 0.

    `gravity` (m/s²) accelerates it before, during and after contact.
    """

    mass: float
    velocity: float
    gravity: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError for an inadmissible value; the message names it."""
        for name in ("mass", "velocity", "gravity"):
            value = _finite(getattr(self, name), name, name != "gravity")
            object.__setattr__(self, name, value)


class _Sampled:
    """A drive that is sampled at t and linear in between."""

    def __post_init__(self) -> None:
        """Check the samples and make them immutable."""
        for name, values in tuple(vars(self).items()):
            samples = as_history(values, name)
            samples.setflags(write=False)
            object.__setattr__(self, name, samples)


@dataclass(frozen=True, eq=False)
class StressDrive(_Sampled):
    """A prescribed stress (Pa) on the top, sampled at t and linear in between, from rest."""

    stress: Array


@dataclass(frozen=True, eq=False)
class DisplacementDrive(_Sampled):
    """A prescribed displacement (m) of the top, sampled at t and linear in between."""

    displacement: Array


Drive = Impact | StressDrive | DisplacementDrive


def check_scene(chain: object, drive: object) -> None:
    """Raise InputError if an argument is not a chain or a drive."""
    if not isinstance(chain, Chain):
        raise InputError(f"chain is a {type(chain).__name__}; it must be a Chain")
    if not isinstance(drive, Drive):
        raise InputError(
            f"drive is a {type(drive).__name__}; it must be an Impact, a StressDrive or a "
            "DisplacementDrive"
        )
