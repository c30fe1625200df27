"""The search: start values read from the curve, and descents from the best of many.

It moves in the box of `fitting.box`, so that no step leaves what the law admits. It first fits the
loop (stress along the measured motion, closed form, cheap), then the curves of the drive itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.stats import qmc

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.fitting import levenberg
from foamfit.fitting.box import BOX, LAST_STRAIN, Scales, Space, family, is_logarithmic
from foamfit.fitting.curves import smoothed
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.fitting.objective import Objective
from foamfit.springs.law import least_eps_star
from foamfit.springs.parameters import HYSTERETIC, NUISANCE

Progress = Callable[[float, str], None]

LOOP_SAMPLES = 240
PULSE = 16  # evaluations
# Shares of the time of a search, as measured, at which its parts begin.
DESCENTS, ON_CURVES, REFINED = 0.25, 0.75, 0.95
CURVE_STARTS = 300
# Searches at most: a second one where a single descent led to the best end, and a third where this
# still misses more of the curves than noise; one more for several hysteretic springs.
ATTEMPTS = 3
LOST = 30.0  # times the noise floor of the cost, above which no agreement is believed at once
NOISY = 0.005  # noise of a motion, over its range, that is much
AROUND = 200  # points about the best one among which another search begins
# Share of the box that counts as its edge, and where inside a descent begins again.
EDGE, INSIDE = 0.02, (0.35, 0.5, 0.65)
# Minima of the loop whose cost on the drive's curves is within this factor of the best go on.
PROMISING = 100.0
# Factors by which the stiffness that an interior mass vibrates on is changed, and their inverses.
STIFFER = np.geomspace(1.0, 2.0, 71)[1:]


class SearchStoppedError(Exception):
    """The time is up; the best point so far is the result."""


# What ends a search, refits or a chain before they are done: what was found is kept.
STOPPING = (SearchStoppedError, KeyboardInterrupt)


def what_stopped(error: BaseException) -> str:
    """Say what has raised one of `STOPPING`."""
    return "the time limit" if isinstance(error, SearchStoppedError) else "Ctrl-C"


@dataclass(frozen=True)
class SearchRecord:
    """How a search went."""

    seed: int
    starts: int  # Descents on the loop that were asked for
    began: float  # `time.perf_counter` at its start, s
    # Final costs of the descents on the drive's curves, best first, and how many descents on the
    # loop led to each.
    costs: tuple[tuple[float, int], ...] = ()
    stopped: str | None = None  # What ended it before its time: "the time limit", "Ctrl-C"

    @property
    def agreeing(self) -> int:
        """How many descents led to the best cost, within 2 %."""
        return sum(count for cost, count in self.costs if cost <= 1.02 * self.costs[0][0])


@dataclass(eq=False)
class Tracker:
    """Counts and times the evaluations of an objective and keeps the best point ever seen.

    `ends` holds the parameters at which the descents on the drive's curves ended; `better` is
    called with every point that is the best so far, `pulse` at every so many evaluations.
    """

    objective: Objective
    deadline: float | None = None
    better: Callable[[Array], None] | None = None
    best_values: Array | None = None
    best_cost: float = np.inf
    pulse: Callable[[], None] | None = None
    ends: list[Array] = field(default_factory=list)

    def residual(self, values: Array, shift: Array | float = 0.0) -> Array:
        """Residual of the objective; raises SearchStoppedError once the time is up."""
        residual = self.consider(values, shift)
        if self.pulse is not None and self.objective.evaluations % PULSE == 0:
            self.pulse()
        if self.deadline is not None and time.monotonic() > self.deadline:
            raise SearchStoppedError
        return residual

    def restart(self) -> None:
        """Go on from the best point with an objective that has changed."""
        best, self.best_values, self.best_cost = self.best_values, None, np.inf
        if best is not None:
            self.consider(best)

    def consider(self, values: Array, shift: Array | float = 0.0) -> Array:
        """Residual of the objective, whatever the time; with a shift, that of other data."""
        failures = self.objective.failures
        residual = self.objective.residual(values, shift)
        cost = float(residual @ residual)
        if np.any(shift):
            return residual
        if cost < self.best_cost and self.objective.failures == failures:
            self.best_cost, self.best_values = cost, values.copy()
            if self.better is not None:
                self.better(self.best_values)
        return residual


# ---------------------------------------------------------------- starts


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


def _stiffness_between(rise: float, low: float, high: float) -> float:
    """k_c of a branch c that rises by a strain `rise` from stress `low` to `high` (Pa).

    The larger root of rise (k+low)(k+high) = k (high-low); the nearest k_c if there is none.
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
    for mark, near_pole in product(marks, (False, True) if "bistable" in kinds else (False,)):
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


# ---------------------------------------------------------------- descent


def _cost(item: tuple[float, Array]) -> float:
    return item[0]


def descend(
    tracker: Tracker, space: Space, start: Array, iterations: int, enough: float = 1e-5
) -> tuple[float, Array]:
    """Levenberg-Marquardt descent inside the box; returns (cost, coordinates) of its end."""

    def jacobian(point: Array) -> Array:
        values = space.decode(point)
        return tracker.objective.jacobian_along(values, space.slopes(point, values))

    end = levenberg.descend(
        lambda point: tracker.residual(space.decode(point)), jacobian,
        start, space.box, iterations, enough=enough,
    )  # fmt: skip
    return end.cost, end.point


def rank(tracker: Tracker, space: Space, points: list[Array]) -> list[tuple[float, Array]]:
    """Points of the box with their costs, cheapest first."""
    residuals = [tracker.residual(space.decode(point)) for point in points]
    return sorted(((float(r @ r), p) for r, p in zip(residuals, points, strict=True)), key=_cost)


def spread_out(space: Space, points: list[Array], count: int) -> list[Array]:
    """Choose `count` of the ranked points: the best, then the best of each range of ε_a.

    Where branch d is about as stiff as branch a, the minima of the cost differ by where A1 lies.
    """
    marks = [j for j, (_, short, _) in enumerate(space.coordinates) if short == "eps_a"]
    if not marks:
        return points[:count]
    places = np.array([point[marks[0]] for point in points])
    strata = np.searchsorted(np.quantile(places, np.linspace(0, 1, count + 1)[1:-1]), places)
    first = np.sort(np.unique(strata, return_index=True)[1]).tolist()
    chosen = list(dict.fromkeys([*first, *range(len(points))]))[:count]
    return [points[i] for i in sorted(chosen)]


def distinct(ends: list[tuple[float, Array]], apart: float = 1e-3) -> list[tuple[int, Array]]:
    """Distinct minima among the ends of descents, best first: how many ended there, and one end.

    Ends whose costs differ by less than the share `apart` are of one minimum.
    """
    chosen: list[tuple[int, Array]] = []
    last = 0.0
    for cost, point in sorted(ends, key=_cost):
        if chosen and cost <= (1.0 + apart) * last:
            chosen[-1] = (chosen[-1][0] + 1, chosen[-1][1])
        else:
            chosen.append((1, point))
            last = cost
    return chosen


def search(
    tracker: Tracker, space: Space, *, starts: int, rng: np.random.Generator, progress: Progress
) -> list[tuple[float, int]]:
    """Search for the best parameters; the tracker keeps them.

    Of the descents on the loop (so many `starts`) the best quarter go on to the curves of the
    drive; see `ATTEMPTS` for when that is done again. Returned are the final costs there, best
    first, and how many descents on the loop led to each. Raises SearchStoppedError when the time is
    up.
    """
    progress(0.0, "start values")
    points = [space.encode(space.values), *box_starts(space, rng, CURVE_STARTS // 3)]
    out: list[tuple[float, int]] = []
    several = sum(kind in HYSTERETIC for kind in space.model.kinds) > 1
    attempts = ATTEMPTS + several
    for attempt in range(attempts):
        counts: dict[int, int] = {}
        if tracker.objective.measurement.displacement is not None:
            found = distinct(_search_loop(tracker, space, points, starts, rng, progress))
            points = [point for _, point in found]
            counts = {id(point): count for count, point in found}
        ranked = rank(tracker, space, points)
        if tracker.objective.interior_mass:
            progress(ON_CURVES, "vibration")
            ranked = sorted(ranked + _scan_vibration(tracker, space, points[0]), key=_cost)
        promising = [item for item in ranked if item[0] <= PROMISING * ranked[0][0]]
        points = [point for _, point in distinct(promising)][: max(3, starts // 4)]
        for i, point in enumerate(points):
            progress(ON_CURVES + (REFINED - ON_CURVES) * i / len(points), "curves")
            cost, end = descend(tracker, space, point, 60)
            tracker.ends.append(space.decode(end))
            out.append((cost, counts.get(id(point), 1)))
        edges = _off_edges(tracker, space)
        out += [(cost, 1) for cost in edges]
        least = max(attempts // 2, 2 if edges else 1)
        if attempt + 1 == attempts or _settled(tracker, out, attempt, least):
            break
        points = box_starts(space, rng, CURVE_STARTS // 3) + _around_best(tracker, space, rng)
    return sorted(out)


def _around_best(tracker: Tracker, space: Space, rng: np.random.Generator) -> list[Array]:
    """Points about the best one: some of its coordinates moved by a share of the box or less."""
    if tracker.best_values is None:
        return []
    low, high = space.box
    best, out = space.encode(tracker.best_values), []
    for _ in range(AROUND):
        far = 10.0 ** rng.uniform(-2.0, -0.5) * rng.standard_normal(best.size)
        moved = best + np.where(rng.random(best.size) < 0.5, far, 0.0) * (high - low)
        out.append(np.clip(moved, low, high))
    return out


def _off_edges(tracker: Tracker, space: Space) -> list[float]:
    """Descend from the best point with what lies at an edge of the box moved inside; the costs.

    A stiffness that few samples show may run to an edge and stay there while all else is found.
    """
    low, high = space.box
    best = space.encode(tracker.best_values) if tracker.best_values is not None else low
    span, costs = high - low, []
    edges = (best - low < EDGE * span) | (high - best < EDGE * span)
    for at in np.flatnonzero(edges & [is_logarithmic(short) for _, short, _ in space.coordinates]):
        for share in INSIDE:
            start = best.copy()
            start[at] = low[at] + share * span[at]
            cost, end = descend(tracker, space, start, 60)
            tracker.ends.append(space.decode(end))
            costs.append(cost)
    return costs


def _settled(tracker: Tracker, ends: list[tuple[float, int]], attempt: int, least: int) -> bool:
    """Whether descents agree on the best end, or none of a second search is better than noise.

    `least` searches are made in any case where the best end misses more of the curves than noise,
    and two where it misses far more.
    """
    best, floor = min(ends)[0], tracker.objective.floor
    if (attempt + 1 < least and best > floor) or (attempt == 0 and best > LOST * floor):
        return False
    if sum(count for cost, count in ends if cost <= 1.02 * best) > 1:
        return True
    return attempt > 0 and best <= floor


def ensure_feasible(tracker: Tracker, space: Space, rng: np.random.Generator) -> None:
    """Find some point that can be simulated, if the search was stopped before it had one."""
    for point in [space.encode(space.values), *box_starts(space, rng, CURVE_STARTS // 3)]:
        if tracker.best_values is not None:
            return
        tracker.consider(space.decode(point))


def _search_loop(
    tracker: Tracker, space: Space, points: list[Array], starts: int,
    rng: np.random.Generator, progress: Progress,
) -> list[tuple[float, Array]]:  # fmt: skip
    """Descend on the smoothed loop, from the curve's own starts too; returns costs and ends.

    However this ends, the best point of the loop is handed to the tracker.
    """
    objective = tracker.objective
    followed = None
    if _is_noisy(objective) and objective.motion is not None:
        followed = objective.motion.at(objective.time)
    loop = smooth_loop(objective.measurement, followed)
    along = Objective(
        loop, objective.model, "displacement", {"stress_strain": 1.0},
        time_shift=objective.time_shift, nuisance=objective.nuisance, loss=objective.loss,
    )  # fmt: skip
    inner = Tracker(along, tracker.deadline, tracker.better)
    own = space
    if objective.drive == "impact":  # whose contact and zero show in its curves alone
        free = [name for name in space.free if name not in NUISANCE or name == TIME_SHIFT]
        own = replace(space, free=tuple(free))
    try:
        points = [own.encode(space.decode(point)) for point in points]
        ranked = rank(inner, own, points + curve_starts(own, loop, rng))
        points = [point for _, point in ranked]
        ends = []
        for i, point in enumerate(spread_out(own, points, starts)):
            progress(DESCENTS + (ON_CURVES - DESCENTS) * i / starts, "loop")
            cost, end = descend(inner, own, point, 40)
            ends.append((cost, space.encode(own.decode(end))))
    finally:
        objective.add_counts(inner.objective)
        if inner.best_values is not None:
            tracker.consider(inner.best_values)
    return ends


def _is_noisy(objective: Objective) -> bool:
    """Whether a loop needs the motion without its noise: where it drives, or has much of it."""
    test = objective.measurement
    motion, level = test.displacement, test.noise.of("displacement")
    if objective.drive != "impact" or motion is None or level is None:
        return objective.drive == "displacement"
    return bool(level.sigma > NOISY * np.ptp(motion))


def _scan_vibration(tracker: Tracker, space: Space, start: Array) -> list[tuple[float, Array]]:
    """Fits of the massless chain for each stiffness of a linear spring, ranked with its masses.

    The cost has a minimum for every cycle that the vibration of an interior mass on a stiff spring
    gains on the measured one: no descent crosses from one to the next.
    """
    objective = replace(tracker.objective, interior_mass=False)
    massless = Tracker(objective, tracker.deadline)
    _, start = descend(massless, space, start, 40)
    out: list[tuple[float, Array]] = []
    for spring, kind in enumerate(space.model.kinds, start=1):
        name = f"s{spring}_k0"
        if kind in HYSTERETIC or name not in space.free:
            continue
        at = space.model.index[name]
        for factors in (STIFFER, 1.0 / STIFFER):
            values = space.decode(start)
            for stiffness in values[at] * factors:
                values[at] = np.clip(stiffness, space.low[at], space.high[at])
                free = tuple(other for other in space.free if other != name)
                held = replace(space, values=values.copy(), free=free)
                _, point = descend(massless, held, held.encode(values), 3, enough=1e-3)
                values = held.decode(point)
                out += rank(tracker, space, [space.encode(values)])
    tracker.objective.add_counts(objective)
    return out
