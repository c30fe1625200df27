"""What springs of every law have in common: following a history, and refusing wrong numbers."""

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
    from foamfit.springs.kernels import Row
    from foamfit.springs.laws.record import Law

FLOAT = np.dtype(np.float64)
Relaxation = Sequence[tuple[float, float]]  # frozen to a tuple of tuples


def require(holds: bool, name: str, value: float, wanted: str) -> None:
    """Refuse a value by the name of its parameter (InputError) unless a condition holds."""
    if not holds:
        raise InputError(f"{name} = {value:g} is not admissible: it must be {wanted}")


def as_number(value: object, name: str) -> float:
    """Return a real number as a float, finite or not; refuse anything else by name."""
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


def freeze_numbers(spring: Any, law: Law) -> None:
    """Make the parameters of a spring finite floats that the law's record admits."""
    from foamfit.springs.laws.record import ADMISSIBLE

    for name in law.names:
        value = as_number(getattr(spring, name), name)
        require(math.isfinite(value), name, value, "finite")
        object.__setattr__(spring, name, value)
    for name, param in law.by_name.items():
        if not param.of:  # the law itself refuses what its other parameters rule out
            value, wanted = getattr(spring, name), param.admissible
            require(ADMISSIBLE[wanted](value), name, value, wanted)


def freeze_terms(spring: object, given: Any) -> None:
    """Make the relaxation terms of a spring pairs of finite floats of the right sign."""
    wanted = "relaxation must be a sequence of pairs (g, tau in s)"
    try:
        pairs = [tuple(pair) for pair in given]
    except TypeError:
        raise InputError(wanted) from None
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(wanted)
    terms = []
    for k, (g, tau) in enumerate(pairs, start=1):
        g, tau = as_number(g, f"g{k}"), as_number(tau, f"tau{k}")
        require(0 <= g < math.inf, f"g{k}", g, "finite and zero or positive")
        require(0 < tau < math.inf, f"tau{k}", tau, "finite and positive")
        terms.append((g, tau))
    object.__setattr__(spring, "relaxation", tuple(terms))


def _as_history(values: ArrayLike, name: str) -> Array:
    history = np.ascontiguousarray(as_samples(values, name))
    if history.ndim > 1:
        raise InputError(f"{name} must be one history (one dimension), not {history.ndim}")
    if not np.all(np.isfinite(history)):
        raise InputError(f"{name} must be finite; sample {_first(~np.isfinite(history))} is not")
    return np.atleast_1d(history)


def _first(mask: NDArray[np.bool_]) -> int:
    return int(np.argmax(np.atleast_1d(mask)))


class Spring(ABC):
    """A spring of any law: what it does along a history, without its dashpot."""

    k0: float
    eta: float

    @property
    @abstractmethod
    def law(self) -> Law:
        """The record of its law."""

    @cached_property
    def row(self) -> Row:
        """The spring as the kernels of the paper's laws know it, without relaxation."""
        return self.solver_row(0)

    def solver_row(self, room: int) -> Row:
        """The same with room for so many relaxation terms; without any, none is written."""
        from foamfit.springs.laws import followed

        terms = self.relaxation if room else ()
        row = followed.solver_row(self.law, np.array(self.values), terms, room)
        assert row is not None  # it was checked when the spring was made
        return row

    @property
    @abstractmethod
    def relaxation(self) -> Relaxation:
        """Relaxation terms (g, τ in s)."""

    @property
    def values(self) -> tuple[float, ...]:
        """Own parameters in the order of the law, then eta, SI."""
        return tuple(getattr(self, name) for name in self.law.names)

    @property
    def corners(self) -> dict[str, tuple[float, float]]:
        """Named points of the loop, strain and stress (Pa); a law may have none."""
        return {}

    def fraction_along(self, stress: ArrayLike) -> Array | None:
        """Fraction of micro-springs that has snapped along a stress history (Pa), if it has any."""
        return None

    def snapped_along(self, strain: ArrayLike) -> Array | None:
        """Fraction that has snapped along a strain history, (n,); None where the law has none."""
        return None

    def stress(self, strain: ArrayLike) -> Array:
        """Stress (Pa) along a strain history (n,), or at one strain, from rest (eqs. 2 and 3).

        Raises
        ------
        SimulationError
            If a strain is at or past the end of its branch (1 on a, 1 + ε_* on c).
        """
        return self._along(strain)[1].reshape(np.shape(strain))

    def strain(self, stress: ArrayLike) -> Array:
        """Strain along a stress history (Pa), shape (n,), from rest; the inverse of `stress`.

        Where a branch is flat (k_h± = 0) a stress beyond it jumps to the next branch.

        Raises
        ------
        SimulationError
            If the spring cannot carry a tension: -k0 on branch a, or any on a unilateral spring.
        """
        history = _as_history(stress, "stress")
        strain = self._strain_along(history)
        if not np.all(np.isfinite(strain)):
            at = _first(~np.isfinite(strain))
            raise SimulationError(
                f"stress {history[at]:g} Pa (sample {at}) is a tension that the spring cannot carry"
            )
        return strain.reshape(np.shape(stress))

    def tangent(self, strain: ArrayLike) -> Array:
        """Slope dσ/dε (Pa) on the branch of each sample of a strain history, shape (n,)."""
        return self._slope_along(self._along(strain)[0]).reshape(np.shape(strain))

    def branches(self, strain: ArrayLike) -> NDArray[np.str_]:
        """Name of the branch of each sample of a strain history, shape (n,).

        A bistable spring is on "a", "d", "c" or "e"; a microscale spring on "a" while none of it
        has snapped, then on "held" (what has snapped stays so), "snap-through", "snap-back" or
        "reversible" (both at one stress); a linear spring on "line" or, out of contact, "open".
        """
        numbers = self._along(strain)[2]
        names = np.array([self.law.named_branch(int(number)) for number in numbers])
        return names.reshape(np.shape(strain))

    def _stress_along(self, strain: Array) -> tuple[Array, NDArray[np.int64]]:
        """Stresses and numbers of the branches of a strain history."""
        from foamfit.springs import kernels

        return kernels.stress_along(self.row, strain)

    def _strain_along(self, stress: Array) -> Array:
        """Strains of a stress history; not finite where the spring cannot have its stress."""
        from foamfit.springs import equilibrium

        strain, none = np.empty(stress.size), np.empty((0, stress.size))
        row = self.row[None, :]  # of height 1: its elongation is its strain
        equilibrium.strains_along(row, np.ones(1), stress, strain, none, none.astype(np.int64))
        return strain

    def _slope_along(self, strain: Array) -> Array:
        """Slopes of a strain history."""
        from foamfit.springs import kernels

        return kernels.tangent_along(self.row, strain, self._stress_along(strain)[1])

    def _along(self, strain: ArrayLike) -> tuple[Array, Array, NDArray[np.int64]]:
        """Strains, stresses and branches of a strain history."""
        history = _as_history(strain, "strain")
        stress, branches = self._stress_along(history)
        if not np.all(np.isfinite(stress)):
            at = _first(~np.isfinite(stress))
            raise SimulationError(
                f"strain {history[at]:g} (sample {at}) is at or past the end of its branch, "
                "where the stress is infinite: 1 on branch a, 1 + eps_star on branch c"
            )
        return history, stress, branches


@dataclass(frozen=True, init=False)
class LawSpring(Spring):
    """A spring of a law that was made known by `foamfit.register`.

    Parameters
    ----------
    law : Law
        Its record.
    values : sequence of float
        Its own parameters in the order of the law, then eta, SI; they are attributes too.
    relaxation : sequence of pairs of float
        Relaxation terms (g, τ in s) in parallel; left out = none.

    Raises
    ------
    ValueError
        If a parameter is not admissible; the message names it.
    """

    record: Law
    numbers: tuple[float, ...]
    relaxation: Relaxation = ()

    def __init__(self, law: Law, values: Sequence[float], relaxation: Relaxation = ()) -> None:
        """Check and freeze the spring."""
        from foamfit.springs.laws import followed

        put = object.__setattr__
        put(self, "record", law)
        for name, value in zip(law.names, values, strict=True):
            put(self, name, value)
        freeze_numbers(self, law)
        freeze_terms(self, relaxation)
        put(self, "numbers", tuple(getattr(self, name) for name in law.names))
        if followed.row_of(law, self.numbers) is None:
            given = ", ".join(f"{n} = {v:g}" for n, v in zip(law.names, self.numbers, strict=True))
            raise InputError(f"{given} is not admissible: the law '{law.kind}' refuses it")

    @property
    def law(self) -> Law:
        """The record of its law."""
        return self.record

    def _stress_along(self, strain: Array) -> tuple[Array, NDArray[np.int64]]:
        from foamfit.springs.laws import followed

        return followed.stress_along(self.record, self.numbers, strain)

    def _strain_along(self, stress: Array) -> Array:
        from foamfit.springs.laws import followed

        return followed.strain_along(self.record, self.numbers, stress)

    def _slope_along(self, strain: Array) -> Array:
        step = 1e-6 * max(float(np.max(np.abs(strain))), 1e-9)
        beside = [  # stresses after a small step back and on, from each sample of the history
            [self._stress_along(np.append(strain[:j], strain[j - 1] + by))[0][-1] for by in steps]
            for j in range(1, strain.size + 1)
            for steps in ((-step, step),)
        ]
        return np.asarray(np.diff(beside, axis=1)[:, 0] / (2.0 * step))
