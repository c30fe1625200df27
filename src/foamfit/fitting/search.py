"""The search: descents from the best of many start values.

All points lie in the box of `fitting.box` and are admissible. The search first fits the loop (the
stress along the measured motion, which is cheap to compute), then the curves of the drive.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter, itemgetter

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.fitting import levenberg
from foamfit.fitting.box import BOX_STARTS, Reading, Space, box_starts, inner_part, thinned
from foamfit.fitting.objective import Objective
from foamfit.springs.model import exchanges, neighbours
from foamfit.springs.parameters import NUISANCE

Progress = Callable[[float, str], None]
# Residual at a point of the box, and its derivative by the coordinates.
Functions = tuple[Callable[[Array], Array], Callable[[Array], levenberg.Jacobian]]
End = tuple[float, Array]  # cost and coordinates of the end of a descent
Way = Callable[[Space, Array, Array, np.random.Generator], Array]  # from two points to a child

PULSE = 16  # evaluations between two calls of `Tracker.pulse`
# Fractions of the run time of a search at which its parts begin, as measured.
DESCENTS, ON_CURVES, REFINED = 0.25, 0.75, 0.95
ATTEMPTS = 3  # largest number of rounds; see `_settled`
FOUND_AGAIN = 0.02  # relative difference of the costs of descents that agree on the best end
MISSING = 0.8  # fraction of the noise floor up to which a cost is mere noise
# Hops in a row on the curves that find nothing better, which ends them: of one spring, and where
# there are many minima: of springs in series, or if the cost exceeds LOST noise floors (one in an
# impact, as no law follows the waves in the specimen). MINIMA: the most minima that are kept.
SHORT, LONG, LOST, MINIMA = 40, 160, 30.0, 24
# Stages of successive halving: iterations, the share of the starts that then goes on, and that of
# the work.
STAGES = ((8, 0.5, 0.5), (8, 0.25, 0.25), (24, 0.25, 0.25))
HALFWAY = STAGES[0][2]
LEAST = 6  # descents that go on in any case
NEAR = 1.5  # largest cost over the best one of an end that may fit almost as well
ALIKE = 1e-3  # relative difference of the costs of descents that ended in one minimum
# Ends that are combined, and the least relative difference of their costs; failures in a row after
# which this stops.
POOL, DIFFERENT, PATIENCE = 12, 0.01, 120
# Stages of the descent from a child: iterations, relative gain at which it ends, and largest cost,
# over the best one, with which it goes on.
OF_CHILD = ((5, ALIKE, 5.0), (7, ALIKE, 1.5), (40, 1e-5, np.inf))


class SearchStoppedError(Exception):
    """The time limit was reached; the best point so far is the result."""


# Exceptions that stop a search, a profile or a Markov chain early; results so far are kept.
STOPPING = (SearchStoppedError, KeyboardInterrupt)


def what_stopped(error: BaseException) -> str:
    """Return the cause of one of the exceptions in `STOPPING`."""
    return "the time limit" if isinstance(error, SearchStoppedError) else str(error) or "Ctrl-C"


@dataclass(frozen=True)
class Freed:
    """What free contact time and zeros would gain where the law errs.

    Misfits (RMS over range) with these `held` where the record shows them and `free`, and the
    value, SI, of each spring parameter with both, (held, free).
    """

    names: tuple[str, ...]
    held: float
    free: float
    moved: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class SearchRecord:
    """Record of a search."""

    seed: int
    starts: int  # Requested number of descents on the loop
    began: float  # `time.perf_counter` at its start, s
    # Final costs of the descents on the curves, best first, and the number of descents on the loop
    # that led to each.
    costs: tuple[tuple[float, int], ...] = ()
    stopped: str | None = None  # Why it ended early: "the time limit", "Ctrl-C", "SIGTERM"
    freed: Freed | None = None  # What free contact time and zeros would gain where the law errs
    compiled: float = 0.0  # `cache.SPENT` at its start, s
    led: bool = False  # Whether it began from the minima of a poorer model, with fewer starts

    @property
    def descents(self) -> int:
        """Number of descents."""
        return sum(count for _, count in self.costs)

    @property
    def agreeing(self) -> int:
        """Number of descents that led to the best cost; see `_agreeing`."""
        return _agreeing(self.costs)


def _agreeing(ends: Sequence[tuple[float, int]]) -> int:
    """Return the number of descents that led to the best cost, within 2 %."""
    best = min(ends, default=(math.inf, 0))[0]  # none if the fit was stopped early
    return sum(count for cost, count in ends if cost <= (1.0 + FOUND_AGAIN) * best)


@dataclass(eq=False)
class Tracker:
    """Evaluates an objective within a time limit, and keeps the best point.

    `ends` are the end points of the descents on the curves, and `met` those of springs in series,
    hops included, that are at most `NEAR` times as costly as the best one. `better` is called with
    each new best point, `pulse` every `PULSE` evaluations, and `looked` with the best point of the
    first descents; an exception from `looked` ends the fit.
    """

    objective: Objective
    deadline: float | None = None
    better: Callable[[Array], None] | None = None
    best_values: Array | None = None
    best_cost: float = np.inf
    pulse: Callable[[], None] | None = None
    looked: Callable[[Array], None] | None = None
    ends: list[Array] = field(default_factory=list)
    met: list[Array] = field(default_factory=list)
    plain: tuple[Array, float] | None = None  # point and cost of plain least squares, if weighed

    def residual(self, values: Array) -> Array:
        """Return the residual of the objective; SearchStoppedError after the time limit."""
        residual = self.consider(values)
        if self.pulse is not None and self.objective.spent.evaluations % PULSE == 0:
            self.pulse()
        if self.deadline is not None and time.monotonic() > self.deadline:
            raise SearchStoppedError
        return residual

    def look(self) -> None:
        """Call `looked` with the best point, if there are both."""
        if self.looked is not None and self.best_values is not None:
            self.looked(self.best_values)

    def possible(self, values: Array) -> Array | None:
        """Return the residual like `residual`; None if the simulation fails."""
        failures, residual = self.objective.spent.failures, self.residual(values)
        return residual if self.objective.spent.failures == failures else None

    def consider(self, values: Array) -> Array:
        """Return the residual of the objective, without a time limit."""
        failures = self.objective.spent.failures
        residual = self.objective.residual(values)
        cost = float(residual @ residual)
        if cost < self.best_cost and self.objective.spent.failures == failures:
            self.best_cost, self.best_values = cost, values.copy()
            if self.better is not None:
                self.better(self.best_values)
        return residual


def descend(
    tracker: Tracker, space: Space, start: Array, iterations: int, enough: float = 1e-5
) -> End:
    """Descend inside the box by Levenberg-Marquardt; return cost and coordinates of the end."""
    end = levenberg.descend(*squares(tracker, space), start, space.box, iterations, enough=enough)
    return end.cost, end.point


def halve(
    functions: Functions,
    box: tuple[Array, Array],
    starts: Sequence[Array],
    step: Callable[[float], None] = lambda _: None,
) -> list[End]:
    """Descend from many starts by successive halving; return costs and coordinates of the ends.

    After each of the `STAGES` only the better part of the descents goes on (Jamieson & Talwalkar
    2016, AISTATS 51, 240). `functions` are the residual at a point of the `box` and its derivative.
    `step` is called with the share that is done.
    """
    at, done, out = list[levenberg.Iterate | Array](starts), 0.0, list[levenberg.Iterate]()
    for iterations, share, work in STAGES:
        out = []
        for i, one in enumerate(at):
            step(done + work * i / len(at))
            out.append(levenberg.descend(*functions, one, box, iterations, enough=1e-5))
        done += work
        out.sort(key=attrgetter("cost"))
        at = list(out[: max(math.ceil(share * len(starts)), min(LEAST, len(out)))])
    return [(end.cost, end.point) for end in out]


def squares(
    tracker: Tracker, space: Space, rows: slice | NDArray[np.bool_] = slice(None)
) -> Functions:
    """Return functions for some rows of the residual at a point of the box, and its derivative."""

    def residual(point: Array) -> Array:
        return tracker.residual(space.decode(point))[rows]

    def jacobian(point: Array) -> Array:
        values = space.decode(point)
        return tracker.objective.jacobian_along(values, space.slopes(point, values))[rows]

    return residual, jacobian


def rank(tracker: Tracker, space: Space, points: list[Array]) -> list[End]:
    """Points of the box with their costs, cheapest first."""
    residuals = (tracker.residual(space.decode(point)) for point in points)
    costs = [float(residual @ residual) for residual in residuals]
    return sorted(zip(costs, points, strict=True), key=itemgetter(0))


def search(
    tracker: Tracker, space: Space, *, starts: int, rng: np.random.Generator, progress: Progress,
    known: Sequence[Array] = (),
) -> list[tuple[float, int]]:  # fmt: skip
    """Search for the best parameters, which the tracker keeps.

    `starts` descents begin on the smooth loop, and the best of their ends go on along the curves of
    the drive; `ATTEMPTS` says when this is repeated. Returns the final costs, best first, each with
    the number of descents on the loop that led to it. Points already `known`, which a poorer model
    has found, replace all other starts. Raises SearchStoppedError after the time limit.
    """
    progress(0.0, "start values")
    out = list[tuple[float, int]]()
    points = [space.encode(values) for values in known]
    points += [] if known else [space.encode(space.values), *box_starts(space, rng, BOX_STARTS)]
    attempts, most = (1, LEAST) if known else (ATTEMPTS, max(3, starts // 4))
    for attempt in range(attempts):
        before, counts = tracker.best_cost, dict[int, int]()
        if tracker.objective.measurement.displacement is not None and not known:
            found = grouped(_search_loop(tracker, space, points, starts, rng, progress), ALIKE)
            points = [group[0][1] for group in found]
            counts = {id(group[0][1]): len(group) for group in found}
        points = [point for _, point in distinct(rank(tracker, space, points))][:most]
        for i, point in enumerate(points):
            progress(ON_CURVES + (REFINED - ON_CURVES) * i / len(points), "curves")
            cost, end = descend(tracker, space, point, 60)
            tracker.ends.append(space.decode(end))
            out.append((cost, counts.get(id(point), 1)))
        if attempt == 0:
            tracker.look()
        now = min(cost for cost, _ in out[-len(points) :])
        if attempt + 1 == attempts or _settled(tracker, out, attempt, before, now):
            break
        points = box_starts(space, rng, BOX_STARTS)
    several, objective = space.model.has_several, tracker.objective
    least = objective.floor * (LOST if objective.measurement.striker is None else 1.0)
    many = several or tracker.best_cost > least
    if not (several and known):  # springs of the poorer model were combined
        out += leave_minimum(tracker, space, rng, LONG if many else SHORT)
    return sorted(out)


def leave_minimum(
    tracker: Tracker, space: Space, rng: np.random.Generator, patience: int
) -> list[tuple[float, int]]:
    """Hop from the ends on the curves until `patience` in a row find nothing better.

    The tracker keeps the minima. The costs of the hops are returned as by `search`.

    The loop of a chain hardly changes when two springs in series exchange a branch, so each
    exchange has its own minimum; so have the neighbours of a single spring.
    """
    if tracker.best_values is None:
        return []
    functions = squares(tracker, space)
    ends = rank(tracker, space, [space.encode(values) for values in tracker.ends])
    alike = exchanges if space.model.has_several else partial(neighbours, top=space.scales.stress)
    chains = alike(space.model, tracker.best_values)
    ends += halve(functions, space.box, [space.encode(values) for values in chains])
    every = hop(space, ends, functions, rng, patience=patience)
    tracker.met += _near(space, every)
    tracker.ends = [space.decode(point) for _, point in distinct(every)[:MINIMA]]
    return [(cost, 1) for cost, _ in every[len(ends) :]]


def _near(space: Space, ends: Sequence[End]) -> list[Array]:
    """Return the parameters of the ends that may fit almost as well as the best one.

    None of a single spring, of which refits near the best point show what is open.
    """
    several = space.model.has_several
    most = NEAR * min((cost for cost, _ in ends), default=math.inf) if several else -math.inf
    return [space.decode(point) for cost, point in ends if cost <= most]


def _settled(
    tracker: Tracker, ends: list[tuple[float, int]], attempt: int, before: float, now: float
) -> bool:
    """Return whether no further round is needed after the best costs `before` and `now`.

    Several descents must agree on the best end, or after a second round its cost must be at the
    noise floor. The ends of springs in series are not independent, as they were combined: there two
    rounds must agree, unless several ends agree on mere noise.
    """
    best, floor, agree = min(ends)[0], tracker.objective.floor, _agreeing(ends) > 1
    if tracker.objective.model.has_several:
        return (agree and best <= MISSING * floor) or abs(now - before) <= FOUND_AGAIN * best
    return agree or (attempt > 0 and best <= floor)


def ensure_feasible(tracker: Tracker, space: Space, rng: np.random.Generator) -> None:
    """Find a point that can be simulated, if the search was stopped before it had one."""
    for point in [space.encode(space.values), *box_starts(space, rng, BOX_STARTS)]:
        if tracker.best_values is not None:
            return
        tracker.consider(space.decode(point))


def _search_loop(
    tracker: Tracker, space: Space, points: list[Array], starts: int,
    rng: np.random.Generator, progress: Progress,
) -> list[End]:  # fmt: skip
    """Descend on the smoothed loop from `points` and from starts read off it; return the ends."""
    objective = tracker.objective
    motion = objective.scenes.motion
    followed = None if motion is None else motion.at(objective.time)
    loop = thinned(objective.measurement, followed, loop=True)
    along = Objective(
        loop, objective.model, "displacement", {"stress_strain": 1.0},
        time_shift=objective.time_shift, nuisance=objective.nuisance, spent=objective.spent,
    )  # fmt: skip
    inner = Tracker(along, tracker.deadline, tracker.better)
    own = space
    if objective.drive == "impact":  # contact and zeros do not affect its loop
        own = replace(space, free=tuple(one for one in space.free if one not in NUISANCE))
    try:
        points = [own.encode(space.decode(point)) for point in points]
        points = [p for _, p in rank(inner, own, points + Reading(own, loop).starts(rng))]

        def step(share: float) -> None:
            progress(DESCENTS + (ON_CURVES - DESCENTS) * share, "loop")
            if share == HALFWAY and objective.drive != "impact" and inner.best_values is not None:
                tracker.consider(inner.best_values)
                tracker.look()

        ends = halve(squares(inner, own), own.box, points[:starts], step)
        if own.model.has_several and not own.model.relaxation:
            ends = hop(own, ends, squares(inner, own), rng)
        ends = [(cost, space.encode(own.decode(end))) for cost, end in ends]
        tracker.met += _near(space, ends)
    finally:
        if inner.best_values is not None:
            tracker.consider(inner.best_values)
    return ends


# ---------------------------------------------------------------- hops
# Descents from points beside the good ends of the search, which may be in a wrong minimum. Springs
# in series share the strain, so that a change of one moves the branches of all others, and few
# descents from start values end in the best minimum. There the hops also combine ends.


def grouped(ends: Sequence[End], alike: float) -> list[list[End]]:
    """Return the ends of descents, best first, in groups whose relative cost differs by `alike`."""
    groups: list[list[End]] = []
    for end in sorted(ends, key=itemgetter(0)):
        if groups and end[0] <= (1.0 + alike) * groups[-1][0][0]:
            groups[-1].append(end)
        else:
            groups.append([end])
    return groups


def distinct(ends: Sequence[End], alike: float = ALIKE) -> list[End]:
    """Return the distinct minima among the ends of descents, best first; see `grouped`."""
    return [group[0] for group in grouped(ends, alike)]


def hop(
    space: Space, ends: Sequence[End], functions: Functions, rng: np.random.Generator,
    patience: int = PATIENCE,
) -> list[End]:  # fmt: skip
    """Descend from children of the best ends until `patience` in a row are no better.

    `functions` are the residual and its derivative; `WAYS`, and for springs in series `IN_SERIES`,
    say how a child is made of two ends. Return all ends.
    """
    ways = *WAYS, *(IN_SERIES if space.model.has_several else ())
    pool, failed, out = distinct(ends, DIFFERENT)[:POOL], 0, [*ends]
    while failed < patience:
        best = pool[0][0]
        one, other = (pool[int(len(pool) * rng.random() ** 2)][1] for _ in range(2))
        child = ways[rng.integers(len(ways))](space, one, other, rng)
        failed += 1
        if np.array_equal(child, one):
            continue
        at: Array | levenberg.Iterate = child
        for iterations, enough, hopeful in OF_CHILD:
            at = end = levenberg.descend(*functions, at, space.box, iterations, enough=enough)
            if end.cost > hopeful * best:
                break
        out.append((end.cost, end.point))
        if end.cost < (1.0 - ALIKE) * best:
            failed = 0
        pool = distinct([*pool, out[-1]], DIFFERENT)[:POOL]
    return out


def _crossed(space: Space, one: Array, other: Array, rng: np.random.Generator) -> Array:
    """Return a point with a spring of one law of another point, in half of the cases its height."""
    model, out, source = space.model, space.decode(one), space.decode(other)
    to = int(rng.integers(len(model.kinds)))
    place = int(rng.choice([i for i, law in enumerate(model.laws) if law is model.laws[to]]))
    model.own(to, out)[:] = model.own(place, source)
    if rng.random() < 0.5:
        out[model.index[f"s{to + 1}_height"]] = source[model.index[f"s{place + 1}_height"]]
    return space.encode(space.complete(out))


def _exchanged(space: Space, one: Array, _: Array, rng: np.random.Generator) -> Array:
    """Return a point whose springs have exchanged branches."""
    chains = [*exchanges(space.model, space.decode(one))]
    return space.encode(chains[rng.integers(len(chains))]) if chains else one


def _mixed(space: Space, one: Array, other: Array, rng: np.random.Generator) -> Array:
    """Return a point with about half of the coordinates of another."""
    return np.where(rng.random(one.size) < 0.5, one, other)


def _far(space: Space, one: Array, _: Array, rng: np.random.Generator) -> Array:
    """Return a point with one coordinate anywhere in the inner part of the box."""
    out, at, (low, high) = one.copy(), rng.integers(one.size), inner_part(space)
    out[at] = rng.uniform(low[at], high[at])
    return out


def _beside(space: Space, one: Array, _: Array, rng: np.random.Generator) -> Array:
    """Return a point with about half of the coordinates changed, within the inner part of the box.

    Further out lie stiff springs, which take long and need the implicit method.
    """
    low, high = inner_part(space)
    far = 10.0 ** rng.uniform(-2.0, -0.5) * (high - low) * rng.standard_normal(one.size)
    far *= rng.random(one.size) < 0.5
    return np.asarray(np.clip(one + far, np.minimum(low, one), np.maximum(high, one)))


WAYS: tuple[Way, ...] = _mixed, _far, _beside
IN_SERIES: tuple[Way, ...] = _crossed, _exchanged
