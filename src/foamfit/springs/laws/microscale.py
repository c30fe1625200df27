"""Microscale springs: micro-springs in series with log-normally distributed snap stresses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from foamfit.arrays import Array
from foamfit.springs.laws.bistable import K0, KC, steeper
from foamfit.springs.laws.record import LAST_STRAIN, Between, Law, Loop, Param
from foamfit.springs.spring import Relaxation, Spring, as_samples, freeze, require


@dataclass(frozen=True)
class MicroscaleSpring(Spring):
    """Micro-springs in series with log-normally distributed snap stresses, and a dashpot.

    The state is the snapped fraction p. With P₊ and P₋ the fractions whose snap-through and
    snap-back stress lies below σ (P₋ at least P₊, both 0 in tension),

        p ← min(max(p, P₊(σ)), P₋(σ))          along the history of σ, from p = 0,
        ε = (1-p) σ/(k0+σ) + p (eps_star + σ/(kc+σ))          (docs/theory.md).

    With stiffening, softening or weakening the state also contains P, the largest p so far.
    Micro-springs that have snapped once are softer on branch a and snap through at a lower stress,
    and branch a is a(σ; k) = 1 - (1 + nσ/k)^(-1/n):

        U(σ) = max(P₊(σ), min(P₊(σ e^s), P)),   p ← min(max(p, U(σ)), max(U(σ), P₋(σ))),
        ε = (1-P) a(σ; k0) + (P-p) a(σ; k0 e^-d) + p (eps_star + σ/(kc+σ)).

    Parameters
    ----------
    k0 : float
        First slope of branch a, at zero stress, Pa.
    kc : float
        First slope of the densified branch c, at zero stress, Pa.
    eps_star : float
        Strain of branch c at zero stress.
    sigma_plus : float
        Median snap-through stress, Pa.
    spread_plus : float
        Standard deviation of the logarithm of the snap-through stress.
    sigma_minus : float
        Median snap-back stress, Pa.
    spread_minus : float
        Standard deviation of the logarithm of the snap-back stress.
    eta : float
        η, dashpot in parallel, Pa·s.
    stiffening : float
        n > 0; with n = 1 branch a is that of eq. 2.
    softening : float
        d >= 0: micro-springs that have snapped once have k0 e^-d instead of k0.
    weakening : float
        s >= 0: micro-springs that have snapped once snap through at σ₊ e^-s.
    relaxation : sequence of pairs of float
        Relaxation terms (g, τ in s) in parallel; by default none. `stress` and `strain` are the
        equilibrium values, without relaxation.

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
    stiffening: float = 1.0
    softening: float = 0.0
    weakening: float = 0.0
    relaxation: Relaxation = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Raise InputError for an inadmissible value; the message names it."""
        freeze(self, MEMORY_LAW, self.relaxation)
        least = _least_star(self.k0, self.kc, self.stiffening, self.softening)
        wanted = f"at least {least:.9g}, so that branch c lies beyond branch a at every stress"
        require(self.eps_star >= least, "eps_star", self.eps_star, wanted)

    @property
    def law(self) -> Law:
        """The record of its law, the variant with memory if it has any."""
        neutral = self.stiffening == 1.0 and self.softening == 0.0 == self.weakening
        return LAW if neutral else MEMORY_LAW

    @property
    def snap_strain(self) -> float:
        """Jump of the strain of the median micro-spring at its first snap-through."""
        on = self.elastic_branches(np.array([self.sigma_plus]))
        return float(on["c"][0] - on["a"][0])

    def fraction_along(self, stress: ArrayLike) -> Array:
        """Return the snapped fraction along a stress history (n,), Pa, from rest."""
        return self.fractions_along(stress)[0]

    def fractions_along(self, stress: ArrayLike) -> tuple[Array, Array]:
        """Return the snapped fractions p and P along a stress history (Pa), from rest."""
        from scipy.special import ndtr

        history = np.atleast_1d(as_samples(stress, "stress"))
        with np.errstate(divide="ignore", invalid="ignore"):
            log = np.log(np.maximum(history, 0.0))
        first = ndtr((log - math.log(self.sigma_plus)) / self.spread_plus)
        again = ndtr((log - math.log(self.sigma_plus) + self.weakening) / self.spread_plus)
        back = ndtr((log - math.log(self.sigma_minus)) / self.spread_minus)
        p, most, out = 0.0, 0.0, np.empty((2, history.size))
        for j, (one, two, three) in enumerate(zip(first, again, back, strict=True)):
            least = max(one, min(two, most))
            p = min(max(p, least), max(least, three))
            most = max(most, p)
            out[:, j] = p, most
        return out[0], out[1]

    def elastic_branches(self, stress: Array) -> dict[str, Array]:
        """Return the strains of branches a (p = 0) and c (p = 1) at these stresses (Pa).

        With softening also a′, branch a of micro-springs that have snapped once.
        """
        out = {"a": self._on_a(stress, self.k0)}
        if self.softening > 0.0:
            out["a′"] = self._on_a(stress, self.k0 * math.exp(-self.softening))
        return out | {"c": self.eps_star + stress / (self.kc + stress)}

    def _on_a(self, stress: Array, k: float) -> Array:
        """Return the strain a(σ; k) of branch a."""
        n = self.stiffening
        return np.asarray(-np.expm1(-np.log1p(n * stress / k) / n))

    @property
    def medians(self) -> tuple[tuple[str, str, float, float], ...]:
        """Sign, direction, median (Pa) and spread (of the logarithm) of both snap stresses."""
        return (
            ("+", "through", self.sigma_plus, self.spread_plus),
            ("−", "back", self.sigma_minus, self.spread_minus),
        )


def most_beyond(k: float, kc: float, n: float) -> tuple[float, float]:
    """Return the least ε_* with which branch c never lies before branch a, and its stress.

    It is the maximum over σ of the difference
    f(σ) = a(σ; k) - σ/(kc+σ) with a = 1 - (1 + nσ/k)^(-1/n). It rises where
    g(σ) = 2 ln(kc+σ) - ln(k kc) - (1+1/n) ln(1+nσ/k) is positive; g turns once at most, so f has
    one maximum at most.
    """
    if n == 1.0:
        one, other = math.sqrt(k), math.sqrt(kc)
        return max(0.0, (other - one) / (other + one)), one * other

    def rises(sigma: float) -> float:
        gains = 2.0 * math.log(kc + sigma) - math.log(k) - math.log(kc)
        return gains - (1.0 + 1.0 / n) * math.log1p(n * sigma / k)

    turn = ((1.0 + n) * kc - 2.0 * k) / (n - 1.0)  # of g
    if n > 1.0:  # g falls up to its turn, and is negative there
        if kc <= k:
            return 0.0, 0.0
        low, high = 0.0, turn
    else:  # g rises up to its turn, if that is at a stress at all, and falls without end
        low = max(turn, 0.0)
        if rises(low) <= 0.0:
            return 0.0, 0.0
        high = max(low, k, kc)
        while rises(high) > 0.0 and high < 1e300:
            high *= 2.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        if rises(middle) > 0.0:
            low = middle
        else:
            high = middle
    sigma = 0.5 * (low + high)
    excess = -math.expm1(-math.log1p(n * sigma / k) / n) - sigma / (kc + sigma)
    return max(excess, 0.0), sigma


@lru_cache(maxsize=256)
def _least_star(k0: float, kc: float, stiffening: float = 1.0, softening: float = 0.0) -> float:
    """Return the least ε_*, with which branch c never lies before branch a."""
    return most_beyond(k0 * math.exp(-softening), kc, stiffening)[0]


def _neighbours(values: Array, top: float) -> Iterator[Array]:
    """Yield springs with a steeper branch c, and one that snaps back where it snaps."""
    yield from steeper(values, 2, top, 0.0)
    back = values.copy()
    back[5:7] = values[3:5]
    yield back


def _to_stresses(values: Array, height: float) -> Array:
    """Return k0 and kc per height (Pa/m), the elongation of ε_* (m), stresses and spreads."""
    k0, kc, eps_star, *rest = values
    return np.array([k0 / height, kc / height, eps_star * height, *rest])


def _from_stresses(mixed: Array, height: float) -> Array:
    return np.asarray(mixed * [height, height, 1.0 / height, 1.0, 1.0, 1.0, 1.0])


def _least_slopes(
    k0: float, kc: float, stiffening: float = 1.0, softening: float = 0.0
) -> dict[str, float]:
    """Return the derivatives of the least ε_*; none if it is zero."""
    k, n = k0 * math.exp(-softening), stiffening
    excess, sigma = most_beyond(k, kc, n)
    if excess == 0.0:
        return {}
    x, log = sigma / k, math.log1p(n * sigma / k)
    on_a = math.exp(-log / n)  # 1 - a
    by_log_k = -x * on_a / (1.0 + n * x)
    by_n = on_a * (x / (1.0 + n * x) - log / n) / n
    by_kc = sigma / (kc + sigma) ** 2
    return {"k0": by_log_k / k0, "kc": by_kc, "stiffening": by_n, "softening": -by_log_k}


_STRESSES, _SPREADS = (math.log(0.02), math.log(1.0)), (math.log(0.05), math.log(2.0))

_PARAMS = (
    replace(K0, example="0.55 MPa"),
    replace(KC, branch="snap-through", example="0.25 MPa"),
    Param(
        "eps_star", ("ε", "*"), "", "strain at which branch c starts from zero stress",
        (0.8, "one"), (0.0, LAST_STRAIN), box=(0.0, 1.0), least_size=0.1,
        admissible="at least 0 and less than 1", branch="snap-through", example="0.08",
    ),
    Param(
        "sigma_plus", ("σ", "+"), "Pa", "median snap-through stress", (0.5, "stress"),
        (1e-3, 30.0), "stress", inner=_STRESSES, branch="snap-through", example="0.13 MPa",
    ),
    Param(
        "spread_plus", ("s", "+"), "", "spread of the logarithm of the snap-through stress",
        (0.4, "one"), (1e-3, 5.0), inner=_SPREADS, branch="snap-through", example="0.4",
    ),
    Param(
        "sigma_minus", ("σ", "−"), "Pa", "median snap-back stress", (0.2, "stress"),
        (1e-4, 30.0), "stress", inner=_STRESSES, branch="snap-back", example="55 kPa",
    ),
    Param(
        "spread_minus", ("s", "−"), "", "spread of the logarithm of the snap-back stress",
        (0.7, "one"), (1e-3, 5.0), inner=_SPREADS, branch="snap-back", example="0.8",
    ),
)  # fmt: skip
_OPTIONAL = {
    "stiffening": (
        Param(
            "stiffening", ("n", ""), "", "stiffening of branch a (1: the paper's)", (1.0, "one"),
            (0.02, 50.0), inner=(math.log(0.3), math.log(3.0)), neutral=1.0, branch="a",
            example="2.0",
        ),
    ),
    "mullins": (
        Param(
            "softening", ("d", ""), "", "softening of what has snapped once: k0 becomes k0·exp(-d)",
            (0.5, "one"), (0.0, 6.0), "one", "value", inner=(0.0, 2.0), least_size=0.1,
            admissible="zero or positive", neutral=0.0, branch="snap-back", example="0.8",
        ),
        Param(
            "weakening", ("s", ""), "", "weakening of what has snapped once: σ₊ becomes σ₊·exp(-s)",
            (0.3, "one"), (0.0, 6.0), "one", "value", inner=(0.0, 1.0), least_size=0.1,
            admissible="zero or positive", neutral=0.0, branch="snap-through again", example="0.5",
        ),
    ),
}  # fmt: skip
_BRANCHES = {
    "a": "elastic, none has snapped",
    "snap-through": "micro-springs snap",
    "held": "as many stay snapped",
    "snap-back": "micro-springs snap back",
    "reversible": "micro-springs snap through and back at one stress",
}
_NOTE = (
    "σ₊ and σ₋ are where half of the micro-springs have snapped on loading, and where half have "
    "snapped back on unloading. For a single spring its branches are shown too, thin and grey: the "
    "elastic branch a, on which none has snapped, and the densified branch c, on which all have."
)


def _law(*options: str) -> Law:
    """Return the law with the parameters of some options; without any, the basic law."""
    extra = tuple(param for option in options for param in _OPTIONAL[option])
    names = tuple(param.name for param in extra)
    # Parameters on which the least ε_* depends besides k0 and kc.
    also = tuple(name for name in names if name != "weakening")

    def least(k0: float, kc: float, *given: float) -> float:
        return _least_star(k0, kc, **dict(zip(also, given, strict=True)))

    def slopes(k0: float, kc: float, *given: float) -> tuple[tuple[float, float], ...]:
        found = _least_slopes(k0, kc, **dict(zip(also, given, strict=True)))
        return tuple((found.get(name, 0.0), 0.0) for name in ("k0", "kc", *also))

    def read_off(loop: Loop, marks: Array, scales: Any, way: int) -> Array:
        """Read a spring off a loop with its snap stresses at assumed positions.

        `marks` in [0, 1]: the initial slope relative to that at a twentieth of the largest strain;
        k_c relative to the largest stress; ε_* above its least; strain and spread of the median
        snap-through, and of the median snap-back; and the optional parameters. Returns the
        parameters and eta = 0 (SI).
        """
        last, top = float(np.max(loop.strain)), scales.stress
        first = max(loop.at(0.05 * last, loading=True), 0.002 * top) / (0.05 * last)
        k0, kc = first * 10.0 ** (1.2 * marks[0] - 0.4), top * 10.0 ** (2.3 * marks[1] - 0.5)
        more = {
            p.name: 3.0 ** (2.0 * mark - 1.0) if p.is_logarithmic else p.start_limits[1] * mark
            for p, mark in zip(extra, marks[7:], strict=True)
        }
        lowest = least(k0, kc, *(more[name] for name in also))
        star = lowest + 0.5 * marks[2] * (LAST_STRAIN - lowest)
        plus = max(loop.at((0.2 + 0.8 * marks[3]) * last, loading=True), 0.02 * top)
        minus = max(loop.at((0.2 + 0.7 * marks[5]) * last, loading=False), 0.01 * top)
        spreads = 10.0 ** (1.2 * marks[[4, 6]] - 1.0)
        own = (k0, kc, star, plus, spreads[0], minus, spreads[1])
        return np.array([*own, *more.values(), 0.0])

    def make(*values: float, relaxation: Relaxation = ()) -> MicroscaleSpring:
        own = (param.name for param in _PARAMS)
        given: dict[str, Any] = dict(zip((*own, *names, "eta"), values, strict=True))
        return MicroscaleSpring(relaxation=relaxation, **given)

    kind = ", ".join(("microscale", *options))
    beyond = Between(("k0", "kc", *also), lambda *given: (least(*given), LAST_STRAIN), slopes)
    again = {"snap-through again": "what has snapped before snaps once more"} if options else {}
    softened = " The branch a′ is that of what has snapped once." if "mullins" in options else ""
    return Law(
        kind=kind,
        word="microscale" if options else "",
        title="microscale spring",
        params=(*_PARAMS[:2], replace(_PARAMS[2], coordinate=beyond), *_PARAMS[3:], *extra),
        places={"stiffening": 7, "softening": 8, "weakening": 9} if options else {},
        functions="microscale.COMPILED",
        branches=_BRANCHES | again,
        spring=make,
        searched=(
            "k0", "kc", *names, "eps_star", "sigma_plus", "sigma_minus", "spread_plus",
            "spread_minus",
        ),
        read_off=read_off,
        marks=7 + len(names),
        onset=lambda values: values[3],
        neighbours=_neighbours,
        exchanged=None if options else (_to_stresses, _from_stresses),
        note=_NOTE + softened,
    )  # fmt: skip


LAWS = _law(), _law("stiffening"), _law("mullins"), _law("stiffening", "mullins")
LAW, *_, MEMORY_LAW = LAWS
