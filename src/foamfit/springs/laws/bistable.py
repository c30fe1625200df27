"""The hysteretic bistable spring of the paper (eqs. 1-5)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from foamfit.arrays import Array, Mask
from foamfit.springs.laws.record import LAST_STRAIN, Between, Compared, Law, Loop, Param, PointOf
from foamfit.springs.spring import Relaxation, Spring, freeze, require

_INNER = (math.log(0.3), math.log(300.0))  # of stiffness divided by largest stress
K0 = Param(
    "k0", ("k", "0"), "Pa", "first slope of branch a", (3.0, "slope"), (1e-3, 1e4), "stress",
    inner=_INNER, branch="a", example="5.5 MPa",
)  # fmt: skip
KC = Param(
    "kc", ("k", "c"), "Pa", "first slope of branch c", (20.0, "slope"), (1e-2, 1e5), "stress",
    inner=_INNER, branch="c", example="82.5 MPa",
)  # fmt: skip


# ---------------------------------------------------------------- formulas, compiled as well


def derived_points(
    k0: float, kc: float, dsigma: float, eps_a: float, eps_c: float, kh_plus: float, kh_minus: float
) -> tuple[float, float, float, float, float]:
    """Return σ_a and σ̄_c (Pa), ε_*, ε̂_a (-inf: e never meets a) and ε̂_c (eqs. 4 and 5).

    Both quadratic equations are written relative to the known end of the branch (C2 for ε̂_c, A1 for
    ε̂_a), so that their coefficients contain no difference of nearly equal numbers.
    """
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + dsigma
    eps_star = eps_c - sigma_c / (kc + sigma_c)

    # Eq. 5, c = d. With y = ε - ε_c and u = 1 - (ε_c - ε_*) = kc/(kc + σ̄_c):
    # u kh+ y² + (kc - u² kh+ + u gap) y - u² gap = 0, one root y >= 0.
    gap = kh_plus * (eps_c - eps_a) - dsigma
    u = kc / (kc + sigma_c)
    b = kc - u * u * kh_plus + u * gap
    root = math.sqrt(b * b + 4.0 * u * kh_plus * u * u * gap)
    y = 2.0 * u * u * gap / (b + root) if b >= 0.0 else (root - b) / (2.0 * u * kh_plus)

    # Eq. 4, a = e. With z = ε_a - ε and v = 1 - ε_a:
    # v kh- z² + (v² kh- + v fall - k0) z + v² fall = 0, the smaller root z >= 0, if any.
    fall = kh_minus * (eps_c - eps_a) - dsigma
    v = 1.0 - eps_a
    b = v * v * kh_minus + v * fall - k0
    discriminant = b * b - 4.0 * v * kh_minus * v * v * fall
    if fall == 0.0:
        eps_hat_a = eps_a
    elif b < 0.0 and discriminant >= 0.0:
        eps_hat_a = eps_a - 2.0 * v * v * fall / (math.sqrt(discriminant) - b)
    else:
        eps_hat_a = -math.inf
    return sigma_a, sigma_c, eps_star, eps_hat_a, eps_c + y


def admissible(
    k0: float, kc: float, dsigma: float, eps_a: float, eps_c: float, kh_plus: float, kh_minus: float
) -> bool:
    """Return whether the seven parameters are admissible (docs/theory.md)."""
    # The other conditions follow: branch d lies above C2 and branch e below A1.
    return (
        0.0 < k0 < math.inf
        and 0.0 < kc < math.inf
        and 0.0 < eps_a < 1.0
        and eps_a < eps_c < math.inf
        and -k0 * eps_a / (1.0 - eps_a) < dsigma <= 0.0
        and 0.0 <= kh_plus < math.inf
        and 0.0 <= kh_minus < math.inf
    )


def _point(place: int, what: str) -> Any:
    """Return a property that is one of the `derived_points`, None if infinite."""

    def point(spring: BistableSpring) -> float | None:
        value = derived_points(*spring.seven)[place]
        return value if math.isfinite(value) else None

    return property(point, doc=what)


@dataclass(frozen=True)
class BistableSpring(Spring):
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
        Relaxation terms (g, τ in s) in parallel; by default none. `stress` and `strain` are the
        equilibrium values, without relaxation.

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
        """Raise InputError for an inadmissible value; the message names it."""
        freeze(self, LAW, self.relaxation)
        past = f"greater than eps_a = {self.eps_a:g}"
        require(self.eps_c > self.eps_a, "eps_c", self.eps_c, past)
        least = -_sigma_a(self.k0, self.eps_a)
        allowed = f"greater than -sigma_a = {least:g} and at most 0"
        require(least < self.dsigma <= 0, "dsigma", self.dsigma, allowed)

    @property
    def law(self) -> Law:
        """The record of its law."""
        return LAW

    @property
    def seven(self) -> tuple[float, ...]:
        """The seven parameters of the law, SI."""
        return self.values[:-1]

    sigma_a = _point(0, "σ_a, stress at A1, Pa.")
    sigma_c = _point(1, "σ̄_c, stress at C2, Pa.")
    eps_star = _point(2, "ε_*, strain of branch c at zero stress (eq. 2).")
    eps_hat_a = _point(3, "ε̂_a, strain at A2 (eq. 4); None if branch e never meets branch a.")
    eps_hat_c = _point(4, "ε̂_c, strain at C1 (eq. 5).")

    @property
    def sigma_hat_a(self) -> float | None:
        """Stress at A2, Pa; None if branch e never meets branch a."""
        eps_hat_a = self.eps_hat_a
        return None if eps_hat_a is None else self.k0 * eps_hat_a / (1 - eps_hat_a)

    @property
    def sigma_hat_c(self) -> float:
        """Stress at C1, Pa."""
        return float(self.sigma_a + self.kh_plus * (self.eps_hat_c - self.eps_a))

    @property
    def corners(self) -> dict[str, tuple[float, float]]:
        """Strain and stress (Pa) at A1, C1, C2 and, if it exists, A2."""
        out = {
            "A1": (self.eps_a, self.sigma_a),
            "C1": (self.eps_hat_c, self.sigma_hat_c),
            "C2": (self.eps_c, self.sigma_c),
        }
        if self.eps_hat_a is not None and self.sigma_hat_a is not None:
            out["A2"] = (self.eps_hat_a, self.sigma_hat_a)
        return out


def _sigma_a(k0: float, eps_a: float) -> float:
    """Return σ_a = k0 ε_a/(1-ε_a), Pa."""
    return k0 * eps_a / (1.0 - eps_a)


# ---------------------------------------------------------------- reading a loop


def read_off(loop: Loop, marks: Array, scales: Any, way: int) -> Array:
    """Read a spring off a loop with A1, C1 and C2 at assumed positions.

    `marks` (5,) in [0, 1] are the positions of A1, C1 and C2, and fractions for the stress at C2
    and the damping. Returns k0 … kh_minus, eta (SI): the initial slope from A1, k_h+ from A1 to C1,
    k_c through C1 and C2 (the stiffer of two solutions, or on the second `way` the one near its
    pole), and k_h- from C2 towards rest.
    """
    last = float(np.max(loop.strain))
    eps_a = min((0.02 + 0.85 * marks[0]) * last, 0.9)
    sigma_a = max(loop.at(eps_a, loading=True), 0.005 * scales.stress)
    hat_c = eps_a + (0.15 + 1.1 * marks[1]) * max(last - eps_a, 1e-3)  # C1 may never be reached
    seen = min(hat_c, max(last, eps_a + 1e-3))
    kh_plus = max((loop.at(seen, loading=True) - sigma_a) / (seen - eps_a), 0.0)
    sigma_hat_c = sigma_a + kh_plus * (hat_c - eps_a)
    eps_c = eps_a + (0.2 + 0.8 * marks[2]) * (hat_c - eps_a)
    sigma_c = loop.at(eps_c, loading=False) * (0.5 + marks[3])
    sigma_c = min(max(sigma_c, 0.02 * sigma_a), 0.98 * sigma_a)
    kc = _stiffness_between(hat_c - eps_c, sigma_c, sigma_hat_c)
    if way == 1:
        kc = sigma_c * sigma_hat_c / kc  # the product of both solutions is known
    k0, eta = sigma_a * (1.0 - eps_a) / eps_a, 0.1 * scales.eta * marks[4] ** 2
    return np.array([k0, kc, sigma_c - sigma_a, eps_a, eps_c, kh_plus, sigma_c / eps_c, eta])


def read_in_series(loop: Loop, marks: Array, share: float) -> Array:
    """Read one of several springs in series off the kinks of their common loop.

    While a spring with a `share` of the height snaps, the others stay on their branches, so the
    loop bends at the stresses of A1, C1, C2 and A2. `marks` (6,) in [0, 1] select these among the
    kinks, k_c, and k0: that of the loop, or stiffer than if the spring alone were soft. Returns k0
    … kh_minus and eta = 0 (SI).
    """

    def pick(kinks: Array, mark: float) -> tuple[float, float]:
        strain, stress = kinks[min(int(mark * len(kinks)), len(kinks) - 1)]
        return float(strain), max(float(stress), 1e-3 * top)

    def soft(stress: float, stiffness: float) -> float:
        return stress / (stiffness + stress)

    top = float(np.max(loop.stress))
    at_a1, at_c1, at_c2, at_a2 = loop.kinks
    (from_x, sigma_a), (to_x, sigma_hat_c) = pick(at_a1, marks[0]), pick(at_c1, marks[1])
    (_, sigma_c), (_, sigma_e) = pick(at_c2, marks[2]), pick(at_a2, marks[3])
    early = 0.05 * float(np.max(loop.strain))
    k0 = loop.at(early, loading=True) / early
    k0 = max(k0, sigma_a) if marks[5] < 0.5 else share * k0 * 10.0 ** (3.0 * marks[5] - 1.5)
    kc = k0 * 10.0 ** (0.3 + 1.7 * marks[4])
    sigma_c, sigma_e = min(sigma_c, 0.98 * sigma_a), min(sigma_e, 0.9 * sigma_c, 0.9 * sigma_a)
    sigma_hat_c = max(sigma_hat_c, 1.001 * sigma_a)
    moved = abs(to_x - from_x) - (1.0 - share) * (soft(sigma_hat_c, k0) - soft(sigma_a, k0))
    eps_a = soft(sigma_a, k0)
    hat_c = eps_a + max(moved, 0.02) / share
    eps_c = max(hat_c - soft(sigma_hat_c, kc) + soft(sigma_c, kc), eps_a + 0.01)
    kh_plus = (sigma_hat_c - sigma_a) / (hat_c - eps_a)
    kh_minus = (sigma_c - sigma_e) / max(eps_c - soft(sigma_e, k0), 0.01)
    return np.array([k0, kc, sigma_c - sigma_a, eps_a, eps_c, kh_plus, kh_minus, 0.0])


def _stiffness_between(rise: float, low: float, high: float) -> float:
    """Return k_c of a branch c whose strain grows by `rise` from stress `low` to `high` (Pa)."""
    # The larger root k of rise (k+low)(k+high) = k (high-low), or √(low high) without a root.
    gain = max(high - low, 1e-9 * high)
    rise = max(rise, 1e-6)
    b = gain - rise * (low + high)
    discriminant = b * b - 4.0 * rise * rise * low * high
    if b <= 0.0 or discriminant < 0.0:
        return float(np.sqrt(low * high))
    return float((b + np.sqrt(discriminant)) / (2.0 * rise))


# k_c of further start points, divided by the largest stress.
STEEP = np.geomspace(1.0, 1000.0, 7)


def steeper(values: Array, start: int, top: float, low: float) -> Iterator[Array]:
    """Yield springs with another k_c whose branch c has the same strain at the largest stress.

    A search that changes only k_c misses a steep branch c. `start` is the index of the strain at
    which branch c begins, at the stress `low`; k_c is the second parameter.
    """
    for other in top * STEEP:
        moved = values.copy()
        moved[1] = other
        rises = [top / (k + top) - low / (k + low) for k in (values[1], other)]
        moved[start] += rises[0] - rises[1]
        yield moved


def _neighbours(values: Array, top: float) -> Iterator[Array]:
    k0, _, dsigma, eps_a = values[:4]
    return steeper(values, 4, top, _sigma_a(k0, eps_a) + dsigma)


def _likely(values: Array, seen: Mask, marks: Array) -> Array:
    """Return a foam with the ratios of those in Tables 2 and 3 of the paper, with wide margins.

    There k_c/k0 is 15 to 40, k_h+/k0 3 to 6, Δσ/σ_a -0.2 to -0.8, ε_c - ε_a 0.17 to 0.36, and
    branch e runs nearly through the origin, k_h- = σ̄_c/ε_c within 20 %. A k0 below k_h+/3 is open,
    and k_c is that of this value.
    """
    k0, eps_a, u = values[0], values[3], marks
    sigma_a = _sigma_a(k0, eps_a)
    kh_plus = values[5] if seen[5] else k0 * (0.1 + 4.0 * u[5])
    kc, drop = max(k0, kh_plus / 3.0) * 10.0 ** (0.6 + 1.2 * u[1]), 0.05 + 0.85 * u[2]
    eps_c = min(eps_a + 0.05 * 10.0 ** u[4], 0.9 * LAST_STRAIN)  # of unknown magnitude
    kh_minus = sigma_a * (1.0 - drop) / eps_c * (0.5 + 0.7 * u[6])
    return np.array([k0, kc, -drop * sigma_a, eps_a, eps_c, kh_plus, kh_minus, values[7]])


def _fewer(values: Array, top: float) -> Iterator[Array]:
    """Yield springs of the same strain at a stress: one on branches a and d, and one on a only."""
    k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus, eta = values
    sigma_a = _sigma_a(k0, eps_a)
    sigma_c, far = sigma_a + dsigma, 0.9 * LAST_STRAIN
    on_c = eps_c - sigma_c / (kc + sigma_c) + top / (kc + top)
    strain = min(eps_a + (top - sigma_a) / max(kh_plus, 1e-3 * k0), on_c)
    if eps_a < strain < far:
        slope = (top - sigma_a) / (strain - eps_a)
        yield np.array([k0, max(kc, k0), 0.0, eps_a, far, slope, kh_minus, eta])
        k0 = top * (1.0 - strain) / strain
        eps_a = 1.5 * top / (k0 + 1.5 * top)
        yield np.array([k0, max(kc, k0), 0.0, eps_a, 0.5 * (1.0 + eps_a), kh_plus, kh_minus, eta])


def _to_stresses(values: Array, height: float) -> Array:
    """Return k0, kc, k_h±, each per height (Pa/m), σ_a, σ̄_c, elongation from a to C2 (m)."""
    k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus = values
    sigma_a = _sigma_a(k0, eps_a)
    sigma_c = sigma_a + dsigma
    gap = eps_c - sigma_c / (k0 + sigma_c)
    stiff = np.array([k0, kc, kh_plus, kh_minus]) / height
    return np.append(stiff, [sigma_a, sigma_c, gap * height])


def _from_stresses(mixed: Array, height: float) -> Array:
    k0, kc, kh_plus, kh_minus = mixed[:4] * height
    sigma_a, sigma_c, gap = mixed[4:]
    eps_a, eps_c = sigma_a / (k0 + sigma_a), gap / height + sigma_c / (k0 + sigma_c)
    return np.array([k0, kc, min(sigma_c - sigma_a, 0.0), eps_a, eps_c, kh_plus, kh_minus])


# ---------------------------------------------------------------- the record

_DROP = Between(  # Δσ from 0 to -σ_a
    ("k0", "eps_a"),
    lambda k0, eps_a: (0.0, -_sigma_a(k0, eps_a)),
    lambda k0, eps_a: ((0.0, -eps_a / (1.0 - eps_a)), (0.0, -k0 / (1.0 - eps_a) ** 2)),
)
_BEYOND_A1 = Between(("eps_a",), lambda eps_a: (eps_a, LAST_STRAIN), lambda eps_a: ((1.0, 0.0),))


LAW = Law(
    kind="bistable",
    title="bistable spring",
    params=(
        K0,
        KC,
        Param(
            "dsigma", ("Δσ", ""), "Pa", "stress at C2 less that at A1", (-0.1, "stress"),
            (-10.0, 0.0), "stress", _DROP, box=(0.0, 0.999), least_size=1.0,
            admissible="zero or negative", neutral=0.0, branch="e", example="-0.18 MPa",
        ),
        Param(
            "eps_a", ("ε", "a"), "", "strain at A1, where snapping starts", (0.15, "strain"),
            (1e-3, 0.95), admissible="between 0 and 1", branch="d", example="0.14",
        ),
        Param(
            "eps_c", ("ε", "c"), "", "strain at C2, where snap-back starts", (0.8, "strain"),
            (2e-3, 0.999), "one", _BEYOND_A1, box=(0.002, 1.0), admissible="between 0 and 1",
            branch="e", moves="c", example="0.31",
        ),
        Param(
            "kh_plus", ("k", "h+"), "Pa", "slope of branch d", (1.0, "slope"), (0.0, 100.0),
            "slope", "value", (0.0, 50.0), (0.0, 4.0), 0.1, "zero or positive", 0.0, "d",
            "14.3 MPa",
        ),
        Param(
            "kh_minus", ("k", "h−"), "Pa", "slope of branch e", (0.3, "slope"), (0.0, 100.0),
            "slope", "value", (0.0, 50.0), (0.0, 4.0), 0.1, "zero or positive", 0.0, "e",
            "2.34 MPa",
        ),
    ),
    functions="bistable.COMPILED",
    branches={"a": "elastic", "d": "snap-buckling", "c": "densified", "e": "snap-back"},
    spring=BistableSpring,
    searched=("k0", "kc", "eps_a", "eps_c", "dsigma", "kh_plus", "kh_minus"),
    read_off=read_off,
    read_in_series=read_in_series,
    ways=2,
    onset=lambda values: _sigma_a(values[0], values[3]),
    neighbours=_neighbours,
    likely=_likely,
    fewer=_fewer,
    exchanged=(_to_stresses, _from_stresses),
    points=(
        PointOf("sigma_a", ("σ", "a"), "stress at A1, where snapping starts", "Pa"),
        PointOf("sigma_c", ("σ̄", "c"), "stress at C2, where snap-back starts", "Pa"),
        PointOf("eps_star", ("ε", "*"), "strain at which branch c starts from zero stress", ""),
        PointOf("eps_hat_a", ("ε̂", "a"), "strain at A2, where branches e and a meet", ""),
        PointOf("eps_hat_c", ("ε̂", "c"), "strain at C1, where branches d and c meet", ""),
        PointOf("sigma_hat_c", ("σ̂", "c"), "stress at C1", "Pa"),
    ),
    compared=(
        "k0",
        Compared(
            "Δσ/σ_a", "", ("dsigma", "k0", "eps_a"),
            lambda dsigma, k0, eps_a: dsigma * (1.0 - eps_a) / (k0 * eps_a),
        ),
        *("eta", "eps_a", "eps_c", "height"),
        Compared("k_h+/k0", "", ("kh_plus", "k0"), lambda slope, k0: slope / k0),
        Compared("k_h−/k0", "", ("kh_minus", "k0"), lambda slope, k0: slope / k0),
        Compared("k_c/k0", "", ("kc", "k0"), lambda kc, k0: kc / k0),
    ),
    note="A1 and C1 are where the spring starts to snap and has snapped on loading; C2 and A2 "
    "where it starts to snap back and has recovered on unloading.",
    remembers=False,
)  # fmt: skip
