"""Microscale springs: micro-springs in series whose snap stresses are spread log-normally."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit.arrays import Array
from foamfit.springs.law import BRANCH_NAMES, least_eps_star
from foamfit.springs.laws.record import (
    LAST_STRAIN,
    Between,
    Compared,
    Law,
    Param,
)
from foamfit.springs.laws.shared import (
    COMPARED_ETA,
    COMPARED_HEIGHT,
    COMPARED_K0,
    K0,
    KC,
    functions_of,
    steeper,
)
from foamfit.springs.loop import Loop
from foamfit.springs.spring import (
    Relaxation,
    Spring,
    as_samples,
    freeze_numbers,
    freeze_terms,
    require,
)


@dataclass(frozen=True)
class MicroscaleSpring(Spring):
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
        Relaxation terms (g, τ in s) in parallel; left out = none. `stress` and `strain` follow the
        equilibrium, without them.

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
        freeze_numbers(self, LAW)
        freeze_terms(self, self.relaxation)
        least = least_eps_star(self.k0, self.kc)
        wanted = f"at least {least:.9g}, so that branch c lies beyond branch a at every stress"
        require(self.eps_star >= least, "eps_star", self.eps_star, wanted)

    @property
    def law(self) -> Law:
        """The record of its law."""
        return LAW

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

    def fraction_along(self, stress: ArrayLike) -> Array:
        """Fraction that has snapped along a stress history (Pa), shape (n,), from none."""
        history = np.atleast_1d(as_samples(stress, "stress"))
        out, snapped = np.empty(history.size), 0.0
        ends = zip(self.snapped_below(history), self.left_below(history), strict=True)
        for j, (least, most) in enumerate(ends):
            snapped = min(max(snapped, least), most)
            out[j] = snapped
        return out

    def elastic_branches(self, stress: Array) -> dict[str, Array]:
        """Strains of branches a (none has snapped) and c (all have) at these stresses (Pa)."""
        on_c = self.eps_star + stress / (self.kc + stress)
        return {"a": stress / (self.k0 + stress), "c": on_c}

    @property
    def medians(self) -> tuple[tuple[str, str, float, float], ...]:
        """Sign, direction, median and spread (of the logarithm) of both snap stresses, Pa."""
        return (
            ("+", "through", self.sigma_plus, self.spread_plus),
            ("−", "back", self.sigma_minus, self.spread_minus),
        )

    def _stress_along(self, strain: Array) -> tuple[Array, NDArray[np.int64]]:
        from foamfit.springs import microscale_kernels

        stress, _, branches = microscale_kernels.stress_along(self.row, strain)
        return stress, branches

    def _slope_along(self, strain: Array) -> Array:
        from foamfit.springs import microscale_kernels

        path = microscale_kernels.stress_along(self.row, strain)
        return microscale_kernels.stress_tangents_along(self.row, strain, *path)[1]


def _ranks_below(stress: ArrayLike, middle: float, spread: float) -> Array:
    """Fraction of ranks whose snap stress lies below these stresses; none in tension."""
    from scipy.special import ndtr

    with np.errstate(divide="ignore"):
        scores = (np.log(np.maximum(stress, 0.0)) - math.log(middle)) / spread
    return np.asarray(ndtr(scores), dtype=float)


def read_off(loop: Loop, marks: Array, scales: Any, way: int) -> Array:
    """Read a spring off a loop, given where on it its snap stresses are taken to lie.

    `marks` (7,) in [0, 1]: the initial slope over that at a twentieth of the largest strain, k_c
    over the largest stress, the place of ε_* above its least, the strains at which the median
    micro-springs snap through and back, and the two spreads. Returned are k0 … spread_minus, and a
    dashpot of zero (SI).
    """
    last = float(np.max(loop.strain))
    first = max(loop.at(0.05 * last, loading=True), 0.002 * scales.stress) / (0.05 * last)
    k0, kc = first * 10.0 ** (1.2 * marks[0] - 0.4), scales.stress * 10.0 ** (2.3 * marks[1] - 0.5)
    least = least_eps_star(k0, kc)
    star = least + 0.5 * marks[2] * (LAST_STRAIN - least)
    plus = max(loop.at((0.2 + 0.8 * marks[3]) * last, loading=True), 0.02 * scales.stress)
    minus = max(loop.at((0.2 + 0.7 * marks[5]) * last, loading=False), 0.01 * scales.stress)
    spreads = 10.0 ** (1.2 * marks[[4, 6]] - 1.0)
    return np.array([k0, kc, star, plus, spreads[0], minus, spreads[1], 0.0])


def _neighbours(values: Array, top: float) -> Iterator[Array]:
    return steeper(values, 1, 2, top, 0.0)


def _to_stresses(values: Array, height: float) -> Array:
    """k0 and kc over the height (Pa/m), elongation of ε_* (m), stresses and spreads."""
    k0, kc, eps_star, *rest = values
    return np.array([k0 / height, kc / height, eps_star * height, *rest])


def _from_stresses(mixed: Array, height: float) -> Array:
    return np.asarray(mixed * [height, height, 1.0 / height, 1.0, 1.0, 1.0, 1.0])


def _least_slopes(k0: float, kc: float) -> tuple[tuple[float, float], ...]:
    """Derivatives of both ends of ε_* by k0 and kc."""
    least = least_eps_star(k0, kc)
    rise = 0.25 * (1.0 - least * least) if least > 0.0 else 0.0  # by the logarithm of kc/k0
    return (-rise / k0, 0.0), (rise / kc, 0.0)


_BEYOND_A = Between(
    ("k0", "kc"), lambda k0, kc: (least_eps_star(k0, kc), LAST_STRAIN), _least_slopes
)
_STRESSES, _SPREADS = (math.log(0.02), math.log(1.0)), (math.log(0.05), math.log(2.0))


LAW = Law(
    kind="microscale",
    title="microscale spring",
    params=(
        replace(K0, example="0.55 MPa"),
        replace(KC, branch="snap-through", example="0.25 MPa"),
        Param(
            "eps_star", ("ε", "*"), "", "strain at which branch c starts from zero stress",
            (0.8, "one"), (0.0, LAST_STRAIN), "one", _BEYOND_A, box=(0.0, 1.0), least_size=0.1,
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
    ),
    numbered=BRANCH_NAMES,
    functions=functions_of("microscale"),
    branches={
        "a": "elastic, none has snapped",
        "snap-through": "micro-springs snap",
        "held": "as many stay snapped",
        "snap-back": "micro-springs snap back",
        "reversible": "micro-springs snap through and back at one stress",
    },
    spring=MicroscaleSpring,
    searched=(
        "k0", "kc", "eps_star", "sigma_plus", "sigma_minus", "spread_plus", "spread_minus",
    ),
    read_off=read_off,
    marks=7,
    onset=lambda values: values[3],
    scanned="eps_star",
    neighbours=_neighbours,
    exchanged=(_to_stresses, _from_stresses),
    compared=(
        COMPARED_K0,
        Compared("k_c", "MPa", ("kc",), lambda kc: kc / 1e6),
        COMPARED_ETA,
        Compared("ε_*", "", ("eps_star",), lambda star: star),
        Compared("σ₊", "MPa", ("sigma_plus",), lambda sigma: sigma / 1e6),
        Compared("s₊", "", ("spread_plus",), lambda spread: spread),
        Compared("σ₋", "MPa", ("sigma_minus",), lambda sigma: sigma / 1e6),
        Compared("s₋", "", ("spread_minus",), lambda spread: spread),
        COMPARED_HEIGHT,
    ),
    note="σ₊ and σ₋ are where half of the micro-springs have snapped on loading, and where half "
    "have snapped back on unloading. For a single spring its branches are shown too, thin and "
    "grey: the elastic branch a, on which none has snapped, and the densified branch c, on which "
    "all have.",
)  # fmt: skip
