"""Base class of all springs: histories of stress and strain, and checks of numbers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError

if TYPE_CHECKING:
    from foamfit.springs.laws.record import Law

FLOAT = np.dtype(np.float64)
Relaxation = Sequence[tuple[float, float]]  # stored as a tuple of tuples


def require(holds: bool, name: str, value: float, wanted: str) -> None:
    """Raise InputError with the name of the parameter unless a condition holds."""
    if not holds:
        raise InputError(f"{name} = {value:g} is not admissible: it must be {wanted}")


def as_number(value: object, name: str) -> float:
    """Return a real number as a float, finite or not; InputError for anything else."""
    try:
        if not isinstance(value, str | bytes):
            return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        pass
    raise InputError(f"{name} = {value!r} is not admissible: it must be a number")


def as_samples(values: ArrayLike, name: str) -> Array:
    """Return real numbers as a new array of floats, contiguous and writable."""
    try:
        given = np.asarray(values)
        if given.dtype.kind in "biuf":
            return given.copy() if given.dtype is FLOAT else given.astype(FLOAT, order="C")
    except (TypeError, ValueError):  # rows of several lengths
        pass
    raise InputError(f"{name} must be an array of numbers")


def freeze(spring: Any, law: Law, relaxation: Any = ()) -> None:
    """Convert parameters to floats and relaxation terms to pairs of floats.

    InputError if one is not admissible; a parameter with coordinate `Between` need only be finite.
    """
    from foamfit.springs.laws.record import ADMISSIBLE

    put = object.__setattr__
    for name, param in law.by_name.items():
        value = as_number(getattr(spring, name), name)
        require(math.isfinite(value), name, value, "finite")
        if not param.of:
            require(ADMISSIBLE[param.admissible](value), name, value, param.admissible)
        put(spring, name, value)
    try:
        pairs = [(g, tau) for g, tau in relaxation]
    except (TypeError, ValueError):
        raise InputError("relaxation must be a sequence of pairs (g, tau in s)") from None
    terms = []
    for k, (g, tau) in enumerate(pairs, start=1):
        g, tau = as_number(g, f"g{k}"), as_number(tau, f"tau{k}")
        require(0 <= g < math.inf, f"g{k}", g, "finite and zero or positive")
        require(0 < tau < math.inf, f"tau{k}", tau, "finite and positive")
        terms.append((g, tau))
    if law.hysteretic:
        put(spring, "relaxation", tuple(terms))


def first_infinite(values: Array) -> int | None:
    """Return the first sample that is not finite; None if all are."""
    finite = np.isfinite(values)
    return None if finite.all() else int(np.argmin(finite))


def as_history(values: ArrayLike, name: str, *, or_number: bool = False) -> Array:
    """Return a history of finite numbers, (n,), as a new array; `or_number`: one will do."""
    samples = as_samples(values, name)
    history = np.atleast_1d(samples) if or_number else samples
    if history.ndim != 1 or not history.size:
        raise InputError(f"{name} must be a one-dimensional array with at least one sample")
    if (at := first_infinite(history)) is not None:
        raise InputError(f"{name} must be finite; sample {at} is {history[at]}")
    return history


class Spring(ABC):
    """A spring of any law; its histories do not include the dashpot."""

    k0: float
    eta: float

    @property
    @abstractmethod
    def law(self) -> Law:
        """The record of its law."""

    @cached_property
    def row(self) -> Array:
        """The row of the spring for the solver, without relaxation."""
        return self.solver_row(0)

    def solver_row(self, room: int) -> Array:
        """Return the row with `room` relaxation terms; InputError if the law refuses the spring."""
        from foamfit.springs.compiled import compiled, fill_row

        made, values = compiled(self.law), np.array(self.values)
        row, terms = np.zeros(1 + 2 * room + made.columns), self.relaxation if room else ()
        if not fill_row(made, values, np.ravel(terms), room, row):
            named = zip(self.law.names, self.values, strict=True)
            given = ", ".join(f"{name} = {value:g}" for name, value in named)
            raise InputError(f"{given} is not admissible: the law '{self.law.kind}' refuses it")
        return row

    @property
    @abstractmethod
    def relaxation(self) -> Relaxation:
        """Relaxation terms (g, τ in s)."""

    @property
    def values(self) -> tuple[float, ...]:
        """Parameters in the order of the law, then eta, SI."""
        return tuple(getattr(self, name) for name in self.law.names)

    @property
    def corners(self) -> dict[str, tuple[float, float]]:
        """Named points of the loop, strain and stress (Pa); may be empty."""
        return {}

    def fraction_along(self, stress: ArrayLike) -> Array | None:
        """Return the fraction of snapped micro-springs along a stress history (Pa), or None."""
        return None

    def stress(self, strain: ArrayLike) -> Array:
        """Return the stress (Pa) along a strain history (n,), from rest (eqs. 2 and 3).

        Raises
        ------
        SimulationError
            If a strain is at or past the end of its branch (1 on a, 1 + ε_* on c).
        """
        return self._along(strain)[1].reshape(np.shape(strain))

    def strain(self, stress: ArrayLike) -> Array:
        """Return the strain along a stress history (n,), Pa, from rest: the inverse of `stress`.

        On a flat branch (k_h± = 0) a stress beyond it jumps to the next branch.

        Raises
        ------
        SimulationError
            If the spring cannot carry a tension: -k0 on branch a, or any on a unilateral spring.
        """
        from foamfit.solve.histories import strain_along

        history = as_history(stress, "stress", or_number=True)
        strain = strain_along(self.law, self.row, history)
        if (at := first_infinite(strain)) is not None:
            raise SimulationError(
                f"stress {history[at]:g} Pa (sample {at}) is a tension that the spring cannot carry"
            )
        return strain.reshape(np.shape(stress))

    def tangent(self, strain: ArrayLike) -> Array:
        """Return the slope dσ/dε (Pa) at each sample of a strain history, (n,)."""
        from foamfit.solve.histories import slope_along

        return slope_along(self.law, self.row, self._along(strain)[0]).reshape(np.shape(strain))

    def branches(self, strain: ArrayLike) -> NDArray[np.str_]:
        """Return the name of the branch at each sample of a strain history, (n,).

        A bistable spring is on "a", "d", "c" or "e". A microscale spring is on "a" before its first
        snap, then on "held" (the snapped fraction is constant), "snap-through", "snap-back" or
        "reversible" (both at one stress). A linear spring is on "line" or, out of contact, "open".
        """
        numbers = self._along(strain)[2]
        names = np.array([self.law.named_branch(int(number)) for number in numbers])
        return names.reshape(np.shape(strain))

    def _along(self, strain: ArrayLike) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return strains, stresses and branches along a strain history."""
        from foamfit.solve.histories import stress_along

        history = as_history(strain, "strain", or_number=True)
        stress, branches = stress_along(self.law, self.row, history)
        if (at := first_infinite(stress)) is not None:
            raise SimulationError(
                f"strain {history[at]:g} (sample {at}) is at or past the end of its branch, "
                "where the stress is infinite: 1 on branch a, 1 + eps_star on branch c"
            )
        return history, stress, branches


@dataclass(frozen=True, init=False)
class LawSpring(Spring):
    """A spring of a law registered with `foamfit.register`.

    Parameters
    ----------
    law : Law
        Its record.
    values : sequence of float
        Parameters in the order of the law, then eta, SI; they are attributes as well.
    relaxation : sequence of pairs of float
        Relaxation terms (g, τ in s) in parallel; by default none.

    Raises
    ------
    ValueError
        If a parameter is not admissible; the message names it.
    """

    record: Law
    numbers: tuple[float, ...]
    relaxation: Relaxation = ()

    def __init__(self, law: Law, values: Sequence[float], relaxation: Relaxation = ()) -> None:
        """Check the arguments and make the spring immutable."""
        put = object.__setattr__
        put(self, "record", law)
        for name, value in zip(law.names, values, strict=True):
            put(self, name, value)
        freeze(self, law, relaxation)
        put(self, "numbers", self.values)
        self.solver_row(0)  # the law may refuse it

    @property
    def law(self) -> Law:
        """The record of its law."""
        return self.record
