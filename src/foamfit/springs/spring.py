"""One mesoscopic spring: the bistable law (eqs. 1-5), the microscale law and the linear spring."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.springs.law import (
    BISTABLE,
    LINEAR,
    MICROSCALE,
    UNILATERAL,
    derived_points,
    least_eps_star,
)

if TYPE_CHECKING:
    from foamfit.springs.kernels import Row

Relaxation = Sequence[tuple[float, float]]  # frozen to a tuple of tuples


def _require(holds: bool, name: str, value: float, wanted: str) -> None:
    if not holds:
        raise InputError(f"{name} = {value:g} is not admissible: it must be {wanted}")


def as_number(value: object, name: str) -> float:
    """Return a value as a float, finite or not.

    Raises
    ------
    ValueError
        If it is no real number; the message names it.
    """
    try:
        if not isinstance(value, str | bytes):
            return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        pass
    raise InputError(f"{name} = {value!r} is not admissible: it must be a number")


def as_samples(values: ArrayLike, name: str) -> Array:
    """Return values as a new array of floats, contiguous and writable.

    Raises
    ------
    ValueError
        If they are no real numbers; the message names them.
    """
    try:
        if np.asarray(values).dtype.kind in "biuf":
            return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError):  # rows of several lengths
        pass
    raise InputError(f"{name} must be an array of numbers")


def _freeze_numbers(spring: object, *names: str) -> None:
    """Make the parameters of a spring finite floats, slopes and dashpots of the right sign."""
    for name in names:
        value = as_number(getattr(spring, name), name)
        _require(math.isfinite(value), name, value, "finite")
        object.__setattr__(spring, name, value)
    for name in names:
        value = getattr(spring, name)
        if name in ("k0", "kc"):
            _require(value > 0, name, value, "positive")
        elif name in ("kh_plus", "kh_minus", "eta"):
            _require(value >= 0, name, value, "zero or positive")


def _freeze_terms(spring: object, given: Any) -> None:
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
        _require(0 <= g < math.inf, f"g{k}", g, "finite and zero or positive")
        _require(0 < tau < math.inf, f"tau{k}", tau, "finite and positive")
        terms.append((g, tau))
    object.__setattr__(spring, "relaxation", tuple(terms))


def _numbers_of(spring: Any) -> tuple[str, ...]:
    """Names of the fields of a spring that are numbers."""
    return tuple(item.name for item in fields(spring) if item.name != "relaxation")


def _as_history(values: ArrayLike, name: str) -> Array:
    history = np.ascontiguousarray(as_samples(values, name))
    if history.ndim > 1:
        raise InputError(f"{name} must be one history (one dimension), not {history.ndim}")
    if not np.all(np.isfinite(history)):
        raise InputError(f"{name} must be finite; sample {_first(~np.isfinite(history))} is not")
    return np.atleast_1d(history)


def _ranks_below(stress: ArrayLike, middle: float, spread: float) -> Array:
    """Fraction of ranks whose snap stress lies below these stresses; none in tension."""
    from scipy.special import ndtr

    with np.errstate(divide="ignore"):
        scores = (np.log(np.maximum(stress, 0.0)) - math.log(middle)) / spread
    return np.asarray(ndtr(scores), dtype=float)


def _first(mask: NDArray[np.bool_]) -> int:
    return int(np.argmax(np.atleast_1d(mask)))


class _Law(ABC):
    """What a spring does along a history, without its dashpot."""

    @property
    @abstractmethod
    def row(self) -> Row:
        """The spring as the kernels know it."""

    def stress(self, strain: ArrayLike) -> Array:
        """Stress (Pa) along a strain history, shape (n,), from rest.

        One flag is carried along the history (eqs. 2 and 3), or the fraction that has snapped; the
        first sample starts with flag a and nothing snapped.
        A single strain gives a single stress.

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
            If the spring cannot carry a tension: beyond the pole of branch a (-k0), or any on a
            unilateral spring.
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
        """Name the branch of each sample of a strain history, shape (n,).

        A bistable spring is on "a", "d", "c" or "e"; a microscale spring on "a" while none of it
        has snapped, then on "held" (what has snapped stays so), "snap-through", "snap-back" or
        "reversible" (both at one stress); a linear spring on "line" or, out of contact, "open".
        """
        from foamfit.springs import kernels

        names = np.array(kernels.BRANCH_NAMES)[self._along(strain)[2]]
        return names.reshape(np.shape(strain))

    def _stress_along(self, strain: Array) -> tuple[Array, NDArray[np.int64]]:
        """Stresses and branches of a strain history."""
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


@dataclass(frozen=True)
class BistableSpring(_Law):
    """The hysteretic bistable spring of eqs. 2-5 with a dashpot in parallel.

    Parameters
    ----------
    k0 : float
        k_0, first slope of branch a, at zero stress, Pa.
    kc : float
        k_c, first slope of the densified branch c, at zero stress, Pa.
    dsigma : float
        Δσ = σ̄_c - σ_a, Pa; not positive.
    eps_a : float
        ε_a, strain at A1, where snapping starts.
    eps_c : float
        ε_c, strain at C2, where snap-back starts.
    kh_plus : float
        k_h+, slope of the snap-buckling branch d, A1→C1, Pa.
    kh_minus : float
        k_h-, slope of the snap-back branch e, C2→A2, Pa.
    eta : float
        η, dashpot in parallel, Pa·s.
    relaxation : sequence of pairs of float
        Relaxation terms (g, τ in s) in parallel; left out = none. What follows the law along a
        history (`stress`, `strain`) is the equilibrium, without them.

    Raises
    ------
    ValueError
        If a parameter is not admissible; the message names it.
    """

    k0: float
    kc: float
    dsigma: float
    eps_a: float
    eps_c: float
    kh_plus: float
    kh_minus: float
    eta: float = 0.0
    relaxation: Relaxation = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Refuse what is not admissible, by name."""
        _freeze_numbers(self, *_numbers_of(self))
        _freeze_terms(self, self.relaxation)
        _require(0 < self.eps_a < 1, "eps_a", self.eps_a, "between 0 and 1")
        past = f"greater than eps_a = {self.eps_a:g}"
        _require(self.eps_c > self.eps_a, "eps_c", self.eps_c, past)
        least = -self.k0 * self.eps_a / (1 - self.eps_a)
        allowed = f"greater than -sigma_a = {least:g} and at most 0"
        _require(least < self.dsigma <= 0, "dsigma", self.dsigma, allowed)

    @property
    def seven(self) -> tuple[float, float, float, float, float, float, float]:
        """The seven parameters of the law in their order, SI."""
        first = (self.k0, self.kc, self.dsigma, self.eps_a)
        return *first, self.eps_c, self.kh_plus, self.kh_minus

    @property
    def sigma_a(self) -> float:
        """σ_a, stress at A1, Pa."""
        return derived_points(*self.seven)[0]

    @property
    def sigma_c(self) -> float:
        """σ̄_c, stress at C2, Pa."""
        return derived_points(*self.seven)[1]

    @property
    def eps_star(self) -> float:
        """ε_*, strain at which branch c starts from zero stress (eq. 2)."""
        return derived_points(*self.seven)[2]

    @property
    def eps_hat_a(self) -> float | None:
        """ε̂_a, strain at A2 (eq. 4); None where branch e never meets branch a."""
        eps_hat_a = derived_points(*self.seven)[3]
        return eps_hat_a if math.isfinite(eps_hat_a) else None

    @property
    def eps_hat_c(self) -> float:
        """ε̂_c, strain at C1 (eq. 5)."""
        return derived_points(*self.seven)[4]

    @property
    def sigma_hat_a(self) -> float | None:
        """Stress at A2, Pa; None where branch e never meets branch a."""
        eps_hat_a = self.eps_hat_a
        return None if eps_hat_a is None else self.k0 * eps_hat_a / (1 - eps_hat_a)

    @property
    def sigma_hat_c(self) -> float:
        """Stress at C1, Pa."""
        return self.sigma_a + self.kh_plus * (self.eps_hat_c - self.eps_a)

    @property
    def kind(self) -> int:
        """The kind of spring that the kernels know."""
        return BISTABLE

    @cached_property
    def row(self) -> Row:
        """The spring as the kernels know it."""
        from foamfit.springs import kernels

        return kernels.bistable_row(*self.seven, self.eta)


@dataclass(frozen=True)
class MicroscaleSpring(_Law):
    """Micro-springs in series whose snap stresses are spread log-normally, with a dashpot.

    Its state is the fraction p of them that has snapped. With P₊ and P₋ the fractions whose
    snap-through and snap-back stress lies below σ (P₋ no less than P₊, both 0 in tension),

        p ← min(max(p, P₊(σ)), P₋(σ))          along the history of σ, from p = 0,
        ε = (1-p) σ/(k0+σ) + p (eps_star + σ/(kc+σ)).

    Parameters
    ----------
    k0 : float
        First slope of branch a, at zero stress, Pa.
    kc : float
        First slope of the densified branch c, at zero stress, Pa.
    eps_star : float
        Strain at which branch c starts from zero stress.
    sigma_plus : float
        Snap-through stress of the middle rank, Pa.
    spread_plus : float
        Standard deviation of the logarithm of the snap-through stress.
    sigma_minus : float
        Snap-back stress of the middle rank, Pa.
    spread_minus : float
        Standard deviation of the logarithm of the snap-back stress.
    eta : float
        η, dashpot in parallel, Pa·s.
    relaxation : sequence of pairs of float
        Relaxation terms (g, τ in s) in parallel; left out = none. What follows the law along a
        history (`stress`, `strain`) is the equilibrium, without them.

    Raises
    ------
    ValueError
        If a parameter is not admissible; the message names it.
    """

    k0: float
    kc: float
    eps_star: float
    sigma_plus: float
    spread_plus: float
    sigma_minus: float
    spread_minus: float
    eta: float = 0.0
    relaxation: Relaxation = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Refuse what is not admissible, by name."""
        _freeze_numbers(self, *_numbers_of(self))
        _freeze_terms(self, self.relaxation)
        for name in ("sigma_plus", "spread_plus", "sigma_minus", "spread_minus"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "positive")
        least = least_eps_star(self.k0, self.kc)
        wanted = f"at least {least:.9g}, so that branch c lies beyond branch a at every stress"
        _require(self.eps_star >= least, "eps_star", self.eps_star, wanted)

    @property
    def kind(self) -> int:
        """The kind of spring that the kernels know."""
        return MICROSCALE

    @property
    def snap_strain(self) -> float:
        """Strain by which a micro-spring of the middle rank jumps where it snaps through."""
        sigma = self.sigma_plus
        return self.eps_star + sigma / (self.kc + sigma) - sigma / (self.k0 + sigma)

    def snapped_below(self, stress: ArrayLike) -> Array:
        """P₊: the fraction that has snapped on first loading to these stresses."""
        return _ranks_below(stress, self.sigma_plus, self.spread_plus)

    def left_below(self, stress: ArrayLike) -> Array:
        """P₋: the fraction that is left on unloading to these stresses, P₊ at least."""
        left = _ranks_below(stress, self.sigma_minus, self.spread_minus)
        return np.maximum(left, self.snapped_below(stress))

    @cached_property
    def row(self) -> Row:
        """The spring as the kernels know it."""
        from foamfit.springs import microscale_kernels

        return microscale_kernels.microscale_row(
            *(getattr(self, name) for name in _numbers_of(self))
        )

    def _stress_along(self, strain: Array) -> tuple[Array, NDArray[np.int64]]:
        from foamfit.springs import microscale_kernels

        stress, _, branches = microscale_kernels.stress_along(self.row, strain)
        return stress, branches

    def _slope_along(self, strain: Array) -> Array:
        from foamfit.springs import microscale_kernels

        path = microscale_kernels.stress_along(self.row, strain)
        return microscale_kernels.stress_tangents_along(self.row, strain, *path)[1]


@dataclass(frozen=True)
class LinearSpring(_Law):
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
        _freeze_numbers(self, "k0", "eta")

    @property
    def kind(self) -> int:
        """The kind of spring that the kernels know."""
        return UNILATERAL if self.unilateral else LINEAR

    @cached_property
    def row(self) -> Row:
        """The spring as the kernels know it."""
        from foamfit.springs import kernels

        return kernels.linear_row(self.k0, self.eta, self.unilateral)

    @property
    def relaxation(self) -> Relaxation:
        """Relaxation terms: a linear spring has none."""
        return ()


Spring = BistableSpring | MicroscaleSpring | LinearSpring
