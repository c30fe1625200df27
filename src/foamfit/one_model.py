"""The fit of one model: search, refinement, intervals and result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import lmfit
import numpy as np

from foamfit.arrays import Array
from foamfit.codec import plain
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.fitting import search
from foamfit.fitting.box import carried
from foamfit.fitting.curves import check_time_shift, choose_drive
from foamfit.fitting.problem import Problem, fix_and_vary, make_params, make_problem
from foamfit.fitting.search import STOPPING, SearchRecord, SearchStoppedError, Tracker, what_stopped
from foamfit.options import DRAWS, FREED, STARTS, STARTS_IN_SERIES, Given, Watch
from foamfit.results import Fit, Intervals
from foamfit.solve.cache import SPENT
from foamfit.springs.model import Model, with_options
from foamfit.text import listed
from foamfit.trust import settle
from foamfit.trust.best_point import BestPoint
from foamfit.trust.conclude import conclude
from foamfit.trust.covariance import AT_LIMIT
from foamfit.trust.intervals import Announce, Choice, assess, evaluations_of
from foamfit.trust.refits import Open, left_open

CARRIED = 8  # minima of a poorer model from which the search of a richer one begins
Progress = Callable[[float, str], None]
# Budget of the profiles, and of the ranges, as a multiple of the evaluations of the search, and the
# largest number of restarts from a better point found by either.
PROFILE_SHARE, IMPROVEMENTS = 0.5, 3
# Ranges are computed again if a better point has less than this fraction of the cost.
MOVED = 0.999
# Evaluations that ranges and profiles usually need, as a multiple of those of the search: with an
# error of the law, and at the noise floor.
JUDGED, JUDGED_NOISE = 2.0, 0.15
SEARCHED = 0.5  # fraction of the run time that the search takes


@dataclass(frozen=True)
class Options(Given):
    """The options of a fit, applied to a test and a model.

    Raises InputError for an inadmissible value; the message names the option.
    """

    def __post_init__(self) -> None:
        """Reject inadmissible values."""
        super().__post_init__()
        _ = self.choice

    @property
    def choice(self) -> Choice:
        """The method of the intervals."""
        return Choice(self.intervals, self.draws or DRAWS, self.seed)

    @property
    def of_springs(self) -> dict[str, bool]:
        """The options that free further parameters of some springs."""
        return {name: getattr(self, name) for name in FREED}

    def stored(
        self, measurement: Measurement, model: str, several: Sequence[int] = ()
    ) -> dict[str, Any]:
        """Return the model, the cycle and all options that change the numbers, for fit.json.

        Defaults are left out, among them the default drive of the test and its first cycle.
        `several` are the cycles of a record that are fitted one by one.
        """
        every = {name: value for name, value in vars(self).items() if name != "watch"}
        if model != "auto":
            parsed = Model.parse(model)
            model = parsed.words
            every |= {name: every[name] or is_set for name, is_set in parsed.options.items()}
        every["fix"] = dict(sorted((self.fix or {}).items()))
        every["vary"] = sorted(set(self.vary))
        every["draws"] = self.choice.draws if self.intervals == "mcmc" else None
        with suppress(InputError):  # a test without a drive is refused by the fit
            if self.drive and self.drive == choose_drive(measurement, self.vary):
                every["drive"] = None
        first, last = measurement.cycle, measurement.last_cycle
        if several:
            whole = set(several) == set(measurement.cycles)
            every["cycle"] = "all" if whole else ",".join(map(str, sorted(set(several))))
        elif last is not None:
            every["cycles"] = f"{first}-{last}"
        elif first != min(measurement.cycles, default=first):
            every["cycle"] = first
        usual = vars(Options())
        changed = {n: value for n, value in every.items() if value and value != usual.get(n)}
        return dict(plain({"model": model, **changed}))

    def drive_for(self, measurement: Measurement) -> str:
        """Return the drive, which by default depends on the test."""
        return self.drive or choose_drive(measurement, self.vary)

    def check(
        self, measurement: Measurement, model: str, params: lmfit.Parameters | None = None
    ) -> None:
        """Reject options that the test or the model does not allow, before any simulation."""
        if self.time_shift:
            check_time_shift(measurement, self.drive_for(measurement))
        if model == "auto":
            self.check_auto(params=params is not None, priors=measurement.priors)
        else:
            self.parse(model)
            self.params(measurement, model)

    def parse(self, model: str) -> Model:
        """Return the model with these options; InputError if it does not allow them."""
        return Model.parse(with_options(model, **self.of_springs), self.relaxation)

    def check_auto(self, **given: object) -> None:
        """Reject options of a single model, and those in `given`, if models are to be compared."""
        own = {"priors": self.priors, "fix and vary": self.fix or self.vary}
        for name, value in (*given.items(), *own.items()):
            if value:
                raise InputError(f"{name} belong to one model; name it instead of 'auto'")
        if self.relaxation:
            raise InputError(
                f"relaxation = {self.relaxation} belongs to one model; name it instead of 'auto', "
                "which tries relaxation by itself"
            )
        with_options("auto", **self.of_springs)

    def params(self, measurement: Measurement, model: str) -> lmfit.Parameters | None:
        """Return the parameters with `fix` and `vary` applied; None without either."""
        if not (self.fix or self.vary):
            return None
        drive, springs = self.drive_for(measurement), self.parse(model)
        made = make_params(measurement, springs, drive, time_shift=self.time_shift)
        return fix_and_vary(made, model, self.fix or {}, self.vary)

    def problem(
        self, measurement: Measurement, model: str, params: lmfit.Parameters | None = None
    ) -> Problem:
        """Return the problem of fitting one model."""
        chosen = self.params(measurement, model)
        if params is not None and chosen is not None:
            why = "fix and vary have no effect beside params; set the value and vary of params"
            raise InputError(why)
        model = with_options(model, **self.of_springs)
        given = (self.drive, chosen or params, self.weights, self.interior_mass)
        more: Any = {"time_shift": self.time_shift, "relaxation": self.relaxation}
        more["priors"] = {**measurement.priors, **(self.priors or {})}
        problem = make_problem(measurement, model, *given, **more)
        if self.mullins and measurement.last_cycle is None and (cycle := measurement.cycle) > 1:
            note = f"Cycle {cycle} is fitted as if nothing had snapped before it; with --cycles "
            note += f"1-{cycle} the springs remember the cycles before."
            problem = replace(problem, notes=(*problem.notes, note))
        return problem


def part_of(progress: Progress, begin: float, end: float, prefix: str = "") -> Progress:
    """Report the progress of a part of the work, between two fractions of the whole."""
    return lambda share, what: progress((1 - share) * begin + share * end, f"{prefix}{what}")


@dataclass(frozen=True, eq=False)
class Found:
    """Outcome of a search: the problem, the tracker with the best point, and the record."""

    problem: Problem
    tracker: Tracker
    record: SearchRecord

    def minima(self) -> list[Array]:
        """Return the best of the distinct minima that the search has met, the best one first."""
        tracker, space = Tracker(self.problem.objective), self.problem.space()
        ends = [x for x in (*self.tracker.ends, self.tracker.best_values) if x is not None]
        ranked = search.distinct(search.rank(tracker, space, [space.encode(x) for x in ends]))
        return [space.decode(point) for _, point in ranked[:CARRIED]]

    def best(self) -> BestPoint:
        """Return the best point, with its springs in order.

        Parameters within rounding of a limit are moved onto it.
        """
        problem, space, cost = self.problem, self.problem.space(), self.tracker.best_cost
        assert self.tracker.best_values is not None  # checked by identify
        values = settle.in_order(space, problem.objective, self.tracker.best_values) + 0.0  # no -0
        names, moved = problem.free(), values.copy()
        places = [problem.index[name] for name in names]
        near = AT_LIMIT * problem.sizes(names, values)
        for limits in (space.low, space.high):
            close = np.abs(values[places] - limits[places]) <= near
            moved[places] = np.where(close, limits[places], moved[places])
        best, at_limits = BestPoint(problem, values), BestPoint(problem, space.complete(moved))
        if np.array_equal(at_limits.values, values):
            return best
        with suppress(SimulationError):
            return at_limits if at_limits.cost <= cost + 1e-6 * (1.0 + cost) else best
        return best


def identify(
    measurement: Measurement,
    model: str,
    params: lmfit.Parameters | None,
    options: Options,
    progress: Progress,
    look: Watch | None = None,
    below: Found | None = None,
) -> Found:
    """Search for the best point and refine it; `foamfit.fit` describes arguments and errors.

    `below` is the fit of a model that this one contains, from whose minima the search begins.
    """
    began = time.perf_counter()
    problem = options.problem(measurement, model, params)
    each = STARTS_IN_SERIES if problem.model.has_several else STARTS
    starts = each * len(problem.model.kinds) if options.starts is None else options.starts
    deadline = None if options.max_time is None else time.monotonic() + options.max_time
    better = None if options.watch is None else partial(options.watch, problem)
    looked = None if look is None else partial(look, problem)
    tracker, led = Tracker(problem.objective, deadline, better, looked=looked), below is not None
    record = SearchRecord(options.seed, starts, began, compiled=SPENT.seconds, led=led)
    known = [] if below is None else carried(problem.space(), below.problem.space(), below.minima())
    given = {*(options.fix or {}), *(params or {})}
    found = _search(Found(problem, tracker, record), options.vary, given, progress, known)
    if tracker.best_values is None:
        objective, why = found.problem.objective, "check the drive, the heights and the bounds"
        tried = objective.spent.evaluations
        try:
            objective.simulate(found.problem.vector())
        except SimulationError as error:
            why = str(error)
        if options.fix:
            why += f" with {listed(f'{name} = {one:g}' for name, one in options.fix.items())}"
        raise SimulationError(
            f"{measurement.name}: none of the {tried} sets of parameters that were tried could be "
            f"simulated; {why}"
        )
    return found


def judge(
    found: Found, choice: Choice, announce: Announce, progress: Progress = lambda *_: None
) -> tuple[Fit, BestPoint]:
    """Compute intervals, ranges and result of the best point."""
    try:
        with as_signalled():
            best, record, intervals = found.best(), found.record, Intervals()
            if record.stopped is None:
                found.tracker.pulse = _pulse(found, best, choice, progress)
                best, record, intervals = _assess(found, best, choice, announce)
            found.problem.put(best.values)
            return conclude(best, record, intervals), best
    except KeyboardInterrupt as error:  # a late Ctrl-C keeps the best point
        best = found.best()
        found.problem.put(best.values)
        return conclude(best, replace(found.record, stopped=what_stopped(error))), best


def _pulse(found: Found, best: BestPoint, choice: Choice, progress: Progress) -> Callable[[], None]:
    """Return a function that reports the progress of ranges and intervals by evaluations."""
    spent, before = found.problem.objective.spent, found.problem.objective.spent.evaluations
    share = JUDGED if choice.ranges and best.misfits else JUDGED_NOISE
    expected = max(share * before, 1.0) + evaluations_of(best, choice)
    progress(0.0, "intervals")
    return lambda: progress(min((spent.evaluations - before) / expected, 0.97), "intervals")


def _assess(
    found: Found, best: BestPoint, choice: Choice, announce: Announce
) -> tuple[BestPoint, SearchRecord, Intervals]:
    """Compute ranges and intervals; if they find a better point, start again from it."""
    problem, tracker, record = found.problem, found.tracker, found.record
    budget = PROFILE_SHARE * problem.objective.spent.evaluations
    left, cost_of_ranges = Open(), math.inf
    for restarts in range(IMPROVEMENTS + 1):
        before = tracker.best_cost
        try:
            better = None
            # Ranges of the previous point are not valid here.
            if choice.ranges and best.cost < MOVED * cost_of_ranges:
                if record.led and best.misfits:
                    _hop(problem, tracker, best, record.seed)
                other = choice.method != "local"  # local intervals belong to this minimum
                left = left_open(best, tracker.ends, tracker, budget, other)
                better, cost_of_ranges = left.better if other else None, best.cost
            made = Intervals(better=better)
            if better is None or restarts == IMPROVEMENTS:
                minima = [*tracker.ends, *left.minima]
                made = assess(best, choice, tracker, minima, budget, announce)
            if made.better is None or restarts == IMPROVEMENTS:
                break
            tracker.consider(made.better)
            settle.refine(problem, tracker)
            settle.back_to_plain(problem, tracker)
        except SearchStoppedError:
            return found.best(), record, Intervals()
        best = found.best()
        if tracker.best_cost < before / 1.02:  # a minimum that the search missed
            record = replace(record, costs=((tracker.best_cost, 1), *record.costs))
    return best, record, replace(made, better=None, ranges=left.ranges)


def _hop(problem: Problem, tracker: Tracker, best: BestPoint, seed: int) -> None:
    """Hop between minima of springs in series for the ranges, if the search has not done that."""
    if problem.model.has_several and not tracker.met:
        thinned = problem.thinned()
        coarse = Tracker(thinned.objective, tracker.deadline, met=tracker.met, pulse=tracker.pulse)
        coarse.consider(best.values)
        coarse.ends = [best.values, *tracker.ends]
        search.leave_minimum(coarse, problem.space(), np.random.default_rng(seed), search.LONG)


def _search(
    begun: Found, asked: Collection[str], given: Collection[str], progress: Progress,
    known: Sequence[Array],
) -> Found:  # fmt: skip
    """Search and refine; the record has the costs and the reason of a stop.

    The search begins from points already `known`, if there are any. Along a given motion, contact
    and zeros are fitted after it only: the first rise shows them to a fraction of a sample. Those
    that the user has `asked` to vary, or has `given`, stay as they are.
    """
    problem, tracker, record = begun.problem, begun.tracker, begun.record
    rng, early = np.random.default_rng(record.seed), list[Array]()
    thinned, impact = problem.thinned(), problem.objective.drive == "impact"
    coarse = Tracker(
        thinned.objective, tracker.deadline, tracker.better,
        looked=tracker.looked, met=tracker.met,
    )  # fmt: skip

    def search_thinned(problem: Problem) -> tuple[list[tuple[float, int]], list[Array]]:
        """Search on the thinned record; return the costs and ends of its descents."""
        space = problem.space()
        how: Any = {"rng": rng, "progress": progress, "known": known}
        costs = search.search(coarse, space, starts=record.starts, **how)
        best = [] if coarse.best_values is None else [coarse.best_values]
        return costs, [*best, *coarse.ends]

    def search_held() -> list[Array]:
        """Search with contact and zeros held, unless the first search did that; return the ends."""
        if early:
            return early
        coarse.best_values, coarse.best_cost, coarse.ends = None, np.inf, []
        return search_thinned(settle.held_by_record(thinned, asked))[1]

    try:
        first = thinned if impact else settle.held_by_record(thinned, asked)
        costs, tracker.ends = search_thinned(first)
        record = replace(record, costs=tuple(costs))
        early += [] if impact else tracker.ends
        progress(search.REFINED, "refinement")
        settle.descend_again(problem, tracker)
        for step, freed in settle.steps(problem, tracker, asked, given, search_held):
            problem, record = step, replace(record, freed=freed)
        settle.settle_ends(tracker, problem.space())
    except STOPPING as error:
        if tracker.best_values is None and coarse.best_values is not None:
            tracker.consider(coarse.best_values)
        search.ensure_feasible(tracker, problem.space(), np.random.default_rng(record.seed))
        return Found(problem, tracker, replace(record, stopped=what_stopped(error)))
    progress(1.0, "done")
    return Found(problem, tracker, record)
