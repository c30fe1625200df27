"""The search: descents from the best of many start values.

It moves in the box of `fitting.box`, so that no step leaves what the law admits. It first fits the
loop (stress along the measured motion, closed form, cheap), then the curves of the drive itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.fitting import levenberg
from foamfit.fitting.box import Space
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.fitting.objective import Objective
from foamfit.fitting.starts import CURVE_STARTS, box_starts, curve_starts, smooth_loop
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, family, relaxation_names

Progress = Callable[[float, str], None]

PULSE = 16  # evaluations
# Shares of the time of a search, as measured, at which its parts begin.
DESCENTS, ON_CURVES, REFINED = 0.25, 0.75, 0.95
# Searches at most: a second one where a single descent led to the best end, and a third where this
# still misses more of the curves than noise; one more for several hysteretic springs.
ATTEMPTS = 3
IN_SERIES = 3  # searches at least for several hysteretic springs
LOST = 30.0  # times the noise floor of the cost, above which no agreement is believed at once
NOISY = 0.005  # noise of a motion, over its range, that is much
AROUND = 200  # points about the best one among which another search begins
# Share of the box that counts as its edge, that of what is moved where the curves miss more than
# noise, and where inside a descent begins again.
EDGE, EDGE_MISSING, INSIDE = 0.02, 0.1, (0.35, 0.5, 0.65)
# Change of the logarithm of a parameter, and further ones of a relaxation time, that lead out of a
# wrong minimum; they are tried if the cost is above this share of the noise floor, which includes
# a margin.
APART, APART_IN_TIME, MISSING = 1.2, (3.0, -3.0, 4.8, -4.8), 0.8
# Strength of each relaxation term that begins anew, and scales of what is as stiff as before then.
ANEW, STIFF = 0.3, ("stress", "slope")
# Points off the best one are tried again where it costs less than before by this share.
NEWS = 1e-5
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
    return "the time limit" if isinstance(error, SearchStoppedError) else str(error) or "Ctrl-C"


@dataclass(frozen=True)
class SearchRecord:
    """How a search went."""

    seed: int
    starts: int  # Descents on the loop that were asked for
    began: float  # `time.perf_counter` at its start, s
    # Final costs of the descents on the drive's curves, best first, and how many descents on the
    # loop led to each.
    costs: tuple[tuple[float, int], ...] = ()
    stopped: str | None = None  # What ended it early: "the time limit", "Ctrl-C", "SIGTERM"

    @property
    def agreeing(self) -> int:
        """How many descents led to the best cost, within 2 %."""
        return sum(count for cost, count in self.costs if cost <= 1.02 * self.costs[0][0])


@dataclass(eq=False)
class Tracker:
    """Counts and times the evaluations of an objective and keeps the best point ever seen.

    `ends` holds the parameters at which the descents on the drive's curves ended; `better` is
    called with every point that is the best so far, `pulse` at every so many evaluations, `looked`
    with the best point of the first descents. What `looked` raises ends the fit.
    """

    objective: Objective
    deadline: float | None = None
    better: Callable[[Array], None] | None = None
    best_values: Array | None = None
    best_cost: float = np.inf
    pulse: Callable[[], None] | None = None
    looked: Callable[[Array], None] | None = None
    ends: list[Array] = field(default_factory=list)

    def residual(self, values: Array) -> Array:
        """Residual of the objective; raises SearchStoppedError once the time is up."""
        residual = self.consider(values)
        if self.pulse is not None and self.objective.evaluations % PULSE == 0:
            self.pulse()
        if self.deadline is not None and time.monotonic() > self.deadline:
            raise SearchStoppedError
        return residual

    def look(self) -> None:
        """Show the best point, if there is one and somebody wants to see it."""
        if self.looked is not None and self.best_values is not None:
            self.looked(self.best_values)

    def consider(self, values: Array) -> Array:
        """Residual of the objective, whatever the time."""
        failures = self.objective.failures
        residual = self.objective.residual(values)
        cost = float(residual @ residual)
        if cost < self.best_cost and self.objective.failures == failures:
            self.best_cost, self.best_values = cost, values.copy()
            if self.better is not None:
                self.better(self.best_values)
        return residual


def descend(
    tracker: Tracker, space: Space, start: Array, iterations: int, enough: float = 1e-5
) -> tuple[float, Array]:
    """Levenberg-Marquardt descent inside the box; returns (cost, coordinates) of its end."""
    end = levenberg.descend(*squares(tracker, space), start, space.box, iterations, enough=enough)
    return end.cost, end.point


def squares(
    tracker: Tracker, space: Space, rows: slice | NDArray[np.bool_] = slice(None)
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Residual of some rows by the coordinates of a box, and its derivative."""

    def residual(point: Array) -> Array:
        return tracker.residual(space.decode(point))[rows]

    def jacobian(point: Array) -> Array:
        values = space.decode(point)
        return tracker.objective.jacobian_along(values, space.slopes(point, values))[rows]

    return residual, jacobian


def rank(tracker: Tracker, space: Space, points: list[Array]) -> list[tuple[float, Array]]:
    """Points of the box with their costs, cheapest first."""
    residuals = [tracker.residual(space.decode(point)) for point in points]
    return sorted(
        ((float(r @ r), p) for r, p in zip(residuals, points, strict=True)), key=itemgetter(0)
    )


def spread_out(space: Space, points: list[Array], count: int) -> list[Array]:
    """Choose `count` of the ranked points: the best, then the best of each range of `Law.strata`.

    Where branch d is about as stiff as branch a, the minima of the cost differ by ε_a.
    """
    wanted = {law.strata for law in space.model.laws}
    marks = [j for j, one in enumerate(space.coordinates) if one.short in wanted]
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
    groups: list[list[tuple[float, Array]]] = []
    for end in sorted(ends, key=itemgetter(0)):
        if groups and end[0] <= (1.0 + apart) * groups[-1][0][0]:
            groups[-1].append(end)
        else:
            groups.append([end])
    return [(len(group), group[0][1]) for group in groups]


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
    several = has_several(space.model)
    attempts, edges, left = ATTEMPTS + several, list[float](), np.inf
    for attempt in range(attempts):
        counts: dict[int, int] = {}
        if tracker.objective.measurement.displacement is not None:
            found = distinct(_search_loop(tracker, space, points, starts, rng, progress))
            points = [point for _, point in found]
            counts = {id(point): count for count, point in found}
        ranked = rank(tracker, space, points)
        if attempt == 0 and tracker.objective.drive != "impact":  # there the loop is not the curves
            tracker.look()
        if tracker.objective.interior_mass:
            progress(ON_CURVES, "vibration")
            ranked = sorted(ranked + _scan_vibration(tracker, space, points[0]), key=itemgetter(0))
        promising = [item for item in ranked if item[0] <= PROMISING * ranked[0][0]]
        points = [point for _, point in distinct(promising)][: max(3, starts // 4)]
        for i, point in enumerate(points):
            progress(ON_CURVES + (REFINED - ON_CURVES) * i / len(points), "curves")
            cost, end = descend(tracker, space, point, 60)
            tracker.ends.append(space.decode(end))
            out.append((cost, counts.get(id(point), 1)))
        if attempt == 0:
            tracker.look()
        if tracker.best_cost < (1.0 - NEWS) * left:  # else it would all be the same again
            edges = _off_edges(tracker, space)
            apart = _descended(tracker, space, _apart(tracker, space))
            out += [(cost, 1) for cost in edges + apart]
            reached = tracker.best_cost
            _descended(tracker, space, _far_off(tracker, space))
            if tracker.best_cost < reached:  # that several of them lead there is no agreement
                out.append((tracker.best_cost, 1))
            left = tracker.best_cost
        least = IN_SERIES if several else max(attempts // 2, 2 if edges else 1)
        if attempt + 1 == attempts or _settled(tracker, out, attempt, least):
            break
        points = box_starts(space, rng, CURVE_STARTS // 3) + _around_best(tracker, space, rng)
    return sorted(out)


def has_several(model: Model) -> bool:
    """Whether more than one spring of a chain is hysteretic."""
    return sum(law.hysteretic for law in model.laws) > 1


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

    A stiffness that few samples show may run to an edge and stay there while all else is found. In
    a chain that misses far more than noise any stiffness may have run far off.
    """
    low, high = space.box
    best = space.encode(tracker.best_values) if tracker.best_values is not None else low
    span = high - low
    edges = (best - low < EDGE * span) | (high - best < EDGE * span)
    edges |= len(space.model.kinds) > 1 and tracker.best_cost > tracker.objective.floor
    starts = []
    for at in np.flatnonzero(edges & [one.is_logarithmic for one in space.coordinates]):
        for share in INSIDE:
            start = best.copy()
            start[at] = low[at] + share * span[at]
            starts.append(start)
    if tracker.best_cost > tracker.objective.floor:
        starts += _neighbours(space, space.decode(best))
    return _descended(tracker, space, starts)


def _descended(tracker: Tracker, space: Space, starts: Iterable[Array]) -> list[float]:
    """Descend from each start; the costs of the ends, which the tracker keeps."""
    costs = []
    for start in starts:
        cost, end = descend(tracker, space, start, 60)
        tracker.ends.append(space.decode(end))
        costs.append(cost)
    return costs


def _apart(tracker: Tracker, space: Space) -> Iterator[Array]:
    """Points with one positive parameter of the best changed by a factor, larger and smaller.

    All descents may end in the same wrong minimum. There are none where only noise is left.
    """
    if tracker.best_values is None or tracker.best_cost < MISSING * tracker.objective.floor:
        return
    (low, high), best = space.box, space.encode(tracker.best_values)
    for at, one in enumerate(space.coordinates):
        for step in (APART, -APART) if one.is_logarithmic else ():
            if low[at] < best[at] + step < high[at]:
                start = best.copy()
                start[at] += step
                yield start


def _far_off(tracker: Tracker, space: Space) -> Iterator[Array]:
    """Points farther from the best than those of `_off_edges` and `_apart`, if more is missed.

    Other relaxation times, along which the cost is flat far off, a relaxation begun anew, and
    what lies in the outer tenth of the box moved inside.
    """
    if tracker.best_values is None or tracker.best_cost < MISSING * tracker.objective.floor:
        return
    (low, high), best = space.box, space.encode(tracker.best_values)
    for at, one in enumerate(space.coordinates):
        off, span = min(best[at] - low[at], high[at] - best[at]), high[at] - low[at]
        places: list[float] = []
        if family(one.short) == "tau":
            places = [best[at] + step for step in APART_IN_TIME]
        if one.is_logarithmic and EDGE * span <= off < EDGE_MISSING * span:
            places += [low[at] + share * span for share in INSIDE]
        for place in places:
            if low[at] < place < high[at]:
                start = best.copy()
                start[at] = place
                yield start
    yield from _relaxing_anew(space, space.decode(best))


def _relaxing_anew(space: Space, values: Array) -> Iterator[Array]:
    """Point with new relaxation terms, their times a tenth to a hundredth of the time under load.

    The springs keep their instantaneous stiffness k (1 + Σ g). Large strengths with long times are
    a wide wrong minimum.
    """
    model, moved, count = space.model, values.copy(), space.model.relaxation
    times = space.scales.duration * 10.0 ** ((np.arange(count) + 0.5) / max(count, 1) - 2.0)
    for spring, law in enumerate(model.laws if count else ()):
        names = [f"s{spring + 1}_{short}" for short in relaxation_names(count)]
        stiff = [f"s{spring + 1}_{one.name}" for one in law.params if one.scale in STIFF]
        if not law.hysteretic or not set(space.free).issuperset(names + stiff):
            continue
        places = [model.index[name] for name in names]
        before = 1.0 + float(values[places[::2]].sum())
        moved[places] = np.ravel(np.column_stack([np.full(count, ANEW), times]))
        moved[[model.index[name] for name in stiff]] *= before / (1.0 + ANEW * count)
    if np.any(moved != values):
        yield space.encode(moved)


def _neighbours(space: Space, values: Array) -> Iterator[Array]:
    """Points whose springs have nearly the same loop, as their laws say."""
    for spring, law in enumerate(space.model.laws):
        own = space.model.own(spring, values)[:-1]
        for near in law.neighbours(own, space.scales.stress):
            changed = [f"s{spring + 1}_{law.own[at]}" for at in np.flatnonzero(near != own)]
            if all(name in space.free for name in changed):
                moved = values.copy()
                space.model.own(spring, moved)[:-1] = near
                yield space.encode(moved)


def _settled(tracker: Tracker, ends: list[tuple[float, int]], attempt: int, least: int) -> bool:
    """Whether descents agree on the best end, or none of a second search is better than noise.

    `least` searches are made in any case where the best end misses more of the curves than noise or
    springs are in series, and two where it misses far more.
    """
    best, floor = min(ends)[0], tracker.objective.floor
    several = has_several(tracker.objective.model)
    if attempt + 1 < least and (several or best > floor):
        return False
    if attempt == 0 and best > LOST * floor:
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
        time_shift=objective.time_shift, nuisance=objective.nuisance,
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
            if 2 * i == starts and objective.drive != "impact" and inner.best_values is not None:
                tracker.consider(inner.best_values)  # half of them show whether more are worth it
                tracker.look()
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
    for spring, law in enumerate(space.model.laws, start=1):
        name = f"s{spring}_k0"
        if law.hysteretic or name not in space.free:
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
