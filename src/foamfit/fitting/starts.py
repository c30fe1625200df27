"""Start values: springs read off a measured loop, and points all over the box of the search."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.stats import qmc

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.fitting.box import BOX, LAST_STRAIN, Scales, Space, family
from foamfit.fitting.curves import smoothed
from foamfit.springs.law import least_eps_star
from foamfit.springs.parameters import HYSTERETIC, NUISANCE

LOOP_SAMPLES = 240
CURVE_STARTS = 300
CORNERS = 8  # of the polygon along each way of a loop


def smooth_loop(measurement: Measurement, followed: Array | None = None) -> Measurement:
    """Smooth and thin the measured loop, for the first descent only.

    `followed` is the motion without its noise, m, where it is known better.
    """
    motion, stress, time = measurement.displacement, measurement.stress, measurement.time
    assert motion is not None
    assert stress is not None
    if followed is not None:
        motion = followed
    else:
        window = max(motion.size // 60, 1) * 2 + 1
        motion = smoothed(motion, window) if window > 3 else motion
    first = 0 if time is None else int(np.searchsorted(time, 0.0))  # no loop before contact
    count = min(motion.size - first, LOOP_SAMPLES)
    keep = np.unique(np.linspace(first, motion.size - 1, count).astype(int))
    thinned = None if time is None else time[keep]
    return replace(
        measurement, displacement=motion[keep], stress=stress[keep], time=thinned,
        outliers={}, sampled={}, interior={},  # bridged, and smoothed over
        acceleration=None, block=1, noise=replace(measurement.noise, displacement=0.0),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Loop:
    """Loading and unloading stress (Pa) as functions of strain, read from a measured loop."""

    strain: Array
    stress: Array

    @cached_property
    def kinks(self) -> tuple[Array, Array, Array, Array]:
        """Where the loop bends: strain and stress (k, 2) at what may be A1, C1, C2 and A2.

        On the way up the slope falls at A1 and rises at C1, or the loop turns there; on the way
        down it falls at C2 and rises at A2, or the loop ends.
        """
        peak = int(np.argmax(self.strain))
        ways = slice(peak + 1), slice(peak, None)
        up, down = (corners(self.strain[w], self.stress[w], CORNERS) for w in ways)
        out = []
        for line in (up, down[::-1]):
            steps = np.diff(line, axis=0)
            slopes = np.arctan2(
                steps[:, 1] / np.ptp(self.stress), steps[:, 0] / np.ptp(self.strain)
            )
            falls = np.append(False, np.append(np.diff(slopes) < 0.0, False))
            out.append((line[falls], line[1:-1][~falls[1:-1]]))
        (a1, c1), (a2, c2) = out
        a1 = a1 if len(a1) else up[1:2]
        return a1, np.vstack([c1, up[-1]]), np.vstack([c2, down[0]]), np.vstack([a2, down[-1]])

    def at(self, strain: float, *, loading: bool) -> float:
        """Stress (Pa) on the way up to the largest strain, or down from it."""
        peak = int(np.argmax(self.strain))
        way = slice(peak + 1) if loading else slice(None, peak - 1 if peak else None, -1)
        return float(np.interp(strain, np.maximum.accumulate(self.strain[way]), self.stress[way]))


def read_spring(loop: Loop, marks: Array, scales: Scales, *, soft: bool = False) -> Array:
    """Read a bistable spring off a loop, given where on it A1, C1 and C2 are taken to lie.

    `marks` (5,) in [0, 1] are the places of A1, C1 and C2 between their neighbours, and shares of
    the stress at C2 and of the damping. Returned are k0 … kh_minus, eta (SI): initial slope from
    A1, k_h+ from A1 to C1, k_c through C1 and C2 (of two such branches the `soft` one, close to its
    pole, or the stiff one), k_h- from C2 towards rest.
    """
    last = float(np.max(loop.strain))
    eps_a = min((0.02 + 0.85 * marks[0]) * last, 0.9)
    sigma_a = max(loop.at(eps_a, loading=True), 0.005 * scales.stress)
    hat_c = eps_a + (0.15 + 1.1 * marks[1]) * max(last - eps_a, 1e-3)  # perhaps never reached
    seen = min(hat_c, max(last, eps_a + 1e-3))
    kh_plus = max((loop.at(seen, loading=True) - sigma_a) / (seen - eps_a), 0.0)
    sigma_hat_c = sigma_a + kh_plus * (hat_c - eps_a)
    eps_c = eps_a + (0.2 + 0.8 * marks[2]) * (hat_c - eps_a)
    sigma_c = loop.at(eps_c, loading=False) * (0.5 + marks[3])
    sigma_c = min(max(sigma_c, 0.02 * sigma_a), 0.98 * sigma_a)
    kc = _stiffness_between(hat_c - eps_c, sigma_c, sigma_hat_c)
    return np.array(
        [
            sigma_a * (1.0 - eps_a) / eps_a,
            sigma_c * sigma_hat_c / kc if soft else kc,  # the product of the two
            sigma_c - sigma_a,
            eps_a,
            eps_c,
            kh_plus,
            sigma_c / eps_c,
            0.1 * scales.eta * marks[4] ** 2,
        ]
    )


def read_in_series(loop: Loop, marks: Array, share: float) -> Array:
    """Read one of several bistable springs off the kinks of their common loop.

    While a spring that has but a `share` of the height snaps, the others keep their branches, so
    the chain bends at the stresses of A1, C1, C2 and A2. `marks` (5,) in [0, 1] choose these among
    the kinks of the loop, and k_c. Returned are k0 … kh_minus, and a dashpot of zero (SI).
    """

    def pick(kinks: Array, mark: float) -> tuple[float, float]:
        strain, stress = kinks[min(int(mark * len(kinks)), len(kinks) - 1)]
        return float(strain), max(float(stress), 1e-3 * top)

    top = float(np.max(loop.stress))
    at_a1, at_c1, at_c2, at_a2 = loop.kinks
    (from_x, sigma_a), (to_x, sigma_hat_c) = pick(at_a1, marks[0]), pick(at_c1, marks[1])
    (_, sigma_c), (_, sigma_e) = pick(at_c2, marks[2]), pick(at_a2, marks[3])
    early = 0.05 * float(np.max(loop.strain))
    k0 = max(loop.at(early, loading=True) / early, sigma_a)
    kc = k0 * 10.0 ** (0.3 + 1.7 * marks[4])
    sigma_c, sigma_e = min(sigma_c, 0.98 * sigma_a), min(sigma_e, 0.9 * sigma_c, 0.9 * sigma_a)
    sigma_hat_c = max(sigma_hat_c, 1.001 * sigma_a)

    def soft(stress: float, stiffness: float) -> float:
        return stress / (stiffness + stress)

    moved = abs(to_x - from_x) - (1.0 - share) * (soft(sigma_hat_c, k0) - soft(sigma_a, k0))
    eps_a = soft(sigma_a, k0)
    hat_c = eps_a + max(moved, 0.02) / share
    eps_c = max(hat_c - soft(sigma_hat_c, kc) + soft(sigma_c, kc), eps_a + 0.01)
    kh_plus = (sigma_hat_c - sigma_a) / (hat_c - eps_a)
    kh_minus = (sigma_c - sigma_e) / max(eps_c - soft(sigma_e, k0), 0.01)
    return np.array([k0, kc, sigma_c - sigma_a, eps_a, eps_c, kh_plus, kh_minus, 0.0])


def corners(strain: Array, stress: Array, count: int) -> Array:
    """Corners of the polygon with so many that follows a curve, (count, 2), its ends included.

    Each is where the polygon of those before is farthest off, over the ranges of the curve.
    """
    x, y = strain / (np.ptp(strain) or 1.0), stress / (np.ptp(stress) or 1.0)
    chosen = [0, x.size - 1]
    for _ in range(min(count, x.size) - 2):
        parts = np.clip(np.searchsorted(chosen, np.arange(x.size)), 1, len(chosen) - 1)
        low, high = np.array(chosen)[parts - 1], np.array(chosen)[parts]
        dx, dy = x[high] - x[low], y[high] - y[low]
        off = np.abs((x - x[low]) * dy - (y - y[low]) * dx) / np.maximum(np.hypot(dx, dy), 1e-12)
        chosen = sorted({*chosen, int(np.argmax(off))})
    return np.column_stack([strain, stress])[chosen]


def _stiffness_between(rise: float, low: float, high: float) -> float:
    """k_c of a branch c that rises by a strain `rise` from stress `low` to `high` (Pa).

    It is the larger root k of rise (k+low)(k+high) = k (high-low). Where that equation has no root,
    k = √(low high) comes closest to it.
    """
    gain = max(high - low, 1e-9 * high)
    rise = max(rise, 1e-6)
    b = gain - rise * (low + high)
    discriminant = b * b - 4.0 * rise * rise * low * high
    if b <= 0.0 or discriminant < 0.0:
        return float(np.sqrt(low * high))
    return float((b + np.sqrt(discriminant)) / (2.0 * rise))


def read_microscale(loop: Loop, marks: Array, scales: Scales) -> Array:
    """Read a microscale spring off a loop, given where on it its snap stresses are taken to lie.

    `marks` (7,) in [0, 1]: the initial slope over that at a twentieth of the largest strain, k_c
    over the largest stress, the place of ε_* above its least, the strains at which the median
    micro-springs snap through and back, and the two spreads. Returned are k0 … spread_minus, and a
    dashpot of zero (SI).
    """
    last = float(np.max(loop.strain))
    first = max(loop.at(0.05 * last, loading=True), 0.002 * scales.stress) / (0.05 * last)
    k0, kc = first * 10.0 ** (1.2 * marks[0] - 0.4), scales.stress * 10.0 ** (2.3 * marks[1] - 0.5)
    least = least_eps_star(k0, kc)
    return np.array(
        [
            k0,
            kc,
            least + 0.5 * marks[2] * (LAST_STRAIN - least),
            max(loop.at((0.2 + 0.8 * marks[3]) * last, loading=True), 0.02 * scales.stress),
            10.0 ** (1.2 * marks[4] - 1.0),
            max(loop.at((0.2 + 0.7 * marks[5]) * last, loading=False), 0.01 * scales.stress),
            10.0 ** (1.2 * marks[6] - 1.0),
            0.0,
        ]
    )


def curve_starts(space: Space, loop: Measurement, rng: np.random.Generator) -> list[Array]:
    """Vectors of parameters read off the measured loop, from a Latin hypercube of marks.

    Linear springs take a share of the largest displacement; each hysteretic spring is then read off
    what is left, with marks of its own.
    """
    assert loop.displacement is not None
    assert loop.stress is not None
    kinds, index, terms = space.model.kinds, space.model.index, space.model.relaxation
    count, micro = len(kinds), kinds.count("microscale")
    relaxing = 2 * terms * sum(kind in HYSTERETIC for kind in kinds)
    marks = qmc.LatinHypercube(7 * count + 2 * micro + relaxing, rng=rng).random(CURVE_STARTS)
    starts = []
    ways = (False, True) if "bistable" in kinds else (False,)
    for (turn, mark), near_pole in product(enumerate(marks), ways):
        values = space.values.copy()
        heights = np.full(count, space.scales.height / count)
        if count > 1:
            given = [index[f"s{i}_height"] for i in range(1, count + 1)]
            for i, at in enumerate(given):
                if space.model.names[at] in space.free:
                    values[at] = heights[i] * (0.3 + 1.4 * mark[7 * i + 5])
            values = space.complete(values)
            heights = np.maximum(values[given], 1e-3 * space.scales.height)
        motion = loop.displacement.copy()
        for i, kind in enumerate(kinds):
            if kind not in HYSTERETIC:
                share = 10.0 ** (-3.0 + 2.7 * mark[7 * i + 6])
                k0 = heights[i] * space.scales.stress / (share * motion.max())
                values[index[f"s{i + 1}_k0"]] = k0
                motion = motion - heights[i] * loop.stress / k0
        soft = sum(h for h, kind in zip(heights, kinds, strict=True) if kind in HYSTERETIC)
        own, rest = Loop(motion / (soft or 1.0), loop.stress), iter(mark[7 * count :])
        for i, kind in enumerate(kinds):
            if kind not in HYSTERETIC:
                continue
            first, places = index[f"s{i + 1}_k0"], mark[7 * i : 7 * i + 5]
            if kind == "microscale":
                places = np.append(places, [next(rest), next(rest)])
                values[first : first + 8] = read_microscale(own, places, space.scales)
            else:
                if soft > heights[i] and turn % 2:
                    read = read_in_series(own, places, heights[i] / soft)
                else:
                    read = read_spring(own, places, space.scales, soft=near_pole)
                values[first : first + 8] = read
            for at in range(first + 8, first + 8 + 2 * terms, 2):
                values[at] = 10.0 ** (1.5 * next(rest) - 1.5)
                values[at + 1] = space.scales.duration * 10.0 ** (2.0 * next(rest) - 2.5)
        starts.append(space.encode(values))
    return starts


def box_starts(space: Space, rng: np.random.Generator, count: int) -> list[Array]:
    """Latin hypercube over the inner part of the box, whatever the curve looks like."""
    inner = {"kh_plus": (0.0, 4.0), "kh_minus": (0.0, 4.0), "eta": (0.0, 0.3), "g": (0.0, 1.0)}
    inner |= dict.fromkeys(NUISANCE, (-0.05, 0.05)) | {"time_shift": (-0.3, 0.3)}
    inner |= {"tau": tuple(np.log([0.002, 1.0]))}
    inner |= dict.fromkeys(("k0", "kc"), tuple(np.log([0.3, 300.0])))
    inner |= dict.fromkeys(("sigma_plus", "sigma_minus"), tuple(np.log([0.02, 1.0])))
    inner |= dict.fromkeys(("spread_plus", "spread_minus"), tuple(np.log([0.05, 2.0])))
    shorts = [family(short) for _, short, _ in space.coordinates]
    low, high = np.array([inner.get(short, BOX[short]) for short in shorts]).T
    return list(low + (high - low) * qmc.LatinHypercube(low.size, rng=rng).random(count))
