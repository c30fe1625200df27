"""The fit of one model: search, refinement by lmfit, intervals, and the best point ever seen."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real

import lmfit
import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import (
    STOPPING,
    SearchRecord,
    SearchStoppedError,
    Tracker,
    salvage,
    search,
    what_stopped,
)
from foamfit.results import FitResult
from foamfit.springs.model import Model
from foamfit.springs.parameters import split_name
from foamfit.trust.conclude import conclude
from foamfit.trust.covariance import AT_LIMIT
from foamfit.trust.identifiability import unreached
from foamfit.trust.intervals import Choice, Intervals, assess
from foamfit.trust.refit import Vicinity

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
Tell = Callable[[str], None]

# Descents of the search for each spring.
STARTS = 16
# Refits of the bootstrap and steps of the Markov chain.
DRAWS = {"bootstrap": 500, "mcmc": 2000}
# Evaluations that the default spends on profiles, over those of the search; and how often it goes
# on from a better point that a profile has met.
PROFILE_SHARE, IMPROVEMENTS = 0.5, 3


@dataclass(frozen=True)
class Options:
    """How a test is fitted, whatever the model; see `foamfit.fit` for each.

    Raises
    ------
    InputError
        If one is not admissible; the message names it.
    """

    drive: str | None = None
    seed: int = 0
    starts: int | None = None
    max_time: float | None = None
    weights: Mapping[str, float] | None = None
    interior_mass: bool = False
    time_shift: bool = False
    loss: str = "linear"
    intervals: str = "auto"
    draws: int | None = None

    def __post_init__(self) -> None:
        """Refuse what is of no use."""
        for name, value, least in (("seed", self.seed, 0), ("starts", self.starts, 1)):
            whole = isinstance(value, Integral) and int(value) >= least
            if not whole and (name == "seed" or value is not None):
                raise InputError(
                    f"{name} = {value!r} is not admissible; it must be a whole number, at least "
                    f"{least}"
                )
        limit = self.max_time
        if limit is not None and not (isinstance(limit, Real) and float(limit) > 0):
            raise InputError(f"max_time = {limit!r} is not admissible; it must be positive, in s")
        if self.weights is not None and not isinstance(self.weights, Mapping):
            raise InputError(
                "weights must be a mapping of curves to numbers, like {'stress_time': 1}"
            )
        _ = self.choice

    @property
    def choice(self) -> Choice:
        """Which intervals are wanted."""
        draws = DRAWS.get(self.intervals, 0) if self.draws is None else self.draws
        return Choice(self.intervals, draws, self.seed)

    def problem(
        self, measurement: Measurement, model: str, params: lmfit.Parameters | None = None
    ) -> Problem:
        """Make the problem of one model ready."""
        return make_problem(
            measurement, model, self.drive, params, self.weights, self.interior_mass,
            time_shift=self.time_shift, loss=self.loss,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Found:
    """What a search has found: the problem, its best point (in the tracker), and how it went."""

    problem: Problem
    tracker: Tracker
    record: SearchRecord

    @property
    def values(self) -> Array:
        """The best point, SI."""
        assert self.tracker.best_values is not None  # checked by identify
        return self.tracker.best_values


def identify(
    measurement: Measurement,
    model: str,
    params: lmfit.Parameters | None,
    options: Options,
    progress: Progress,
) -> Found:
    """Search and refine; see `foamfit.fit` for the arguments.

    Raises
    ------
    InputError
        If the test cannot feed the drive or a parameter is unknown; the message names it.
    SimulationError
        If nothing that was tried could be simulated.
    """
    began = time.perf_counter()
    problem = options.problem(measurement, model, params)
    starts = STARTS * len(problem.model.kinds) if options.starts is None else options.starts
    deadline = None if options.max_time is None else time.monotonic() + options.max_time
    tracker = Tracker(problem.objective, deadline)
    record = SearchRecord(options.seed, starts, began)
    record = _search(problem, tracker, record, progress)
    if tracker.best_values is None:
        raise SimulationError(
            f"{measurement.name}: none of the {problem.objective.evaluations} sets of parameters "
            "that were tried could be simulated; check the drive, the heights and the bounds"
        )
    return Found(problem, tracker, record)


def judge(found: Found, choice: Choice, tell: Tell) -> FitResult:
    """Make the intervals that were chosen, and say what is to be said of the best point."""
    intervals, record = Intervals(), found.record
    try:
        if record.stopped is None:
            intervals, record = _assess(found, choice, tell)
        return _finish(found, record, intervals)
    except KeyboardInterrupt:  # what was found is not given up for a late Ctrl-C
        return _finish(found, replace(found.record, stopped="Ctrl-C"), Intervals())


def _finish(found: Found, record: SearchRecord, intervals: Intervals) -> FitResult:
    """Order the springs, write the point into the parameters, and conclude."""
    values = _on_limits(found.problem, _ordered(found.problem, found.values))
    found.problem.put(values)
    return conclude(found.problem, values, record, intervals)


def _assess(found: Found, choice: Choice, tell: Tell) -> tuple[Intervals, SearchRecord]:
    """Make the intervals; where these meet a better point, go on from there."""
    problem, tracker, record = found.problem, found.tracker, found.record
    budget = PROFILE_SHARE * problem.objective.evaluations
    made = Intervals()
    for _ in range(IMPROVEMENTS + 1):
        values = _ordered(problem, found.values)
        lost = unreached(problem, values)
        names = tuple(name for name in problem.free() if name not in lost)
        if not names or choice.method == "local":
            break
        made = assess(
            Vicinity.of(problem, values, names),
            choice,
            valleys=tracker.ends,
            deadline=tracker.deadline,
            budget=budget,
            tell=tell,
        )
        if made.better is None:
            break
        before = tracker.best_cost
        tracker.consider(made.better)
        try:
            _refine(problem, tracker)
        except SearchStoppedError:
            break
        if tracker.best_cost < before / 1.02:  # a valley that no descent of the search has found
            record = replace(record, costs=((tracker.best_cost, 1), *record.costs))
    return (made if made.better is None else Intervals()), record


def _search(
    problem: Problem,
    tracker: Tracker,
    record: SearchRecord,
    progress: Progress,
) -> SearchRecord:
    """Search, then refine by lmfit; returns the record with its costs and what stopped it."""
    try:
        costs = search(
            tracker,
            problem.space(),
            starts=record.starts,
            rng=np.random.default_rng(record.seed),
            progress=progress,
        )
        record = replace(record, costs=tuple(costs))
        progress(0.95, "refinement")
        _refine(problem, tracker)
    except STOPPING as error:
        salvage(tracker, problem.space(), np.random.default_rng(record.seed))
        return replace(record, stopped=what_stopped(error))
    progress(1.0, "done")
    return record


def _refine(problem: Problem, tracker: Tracker) -> None:
    """Refine the best point by lmfit's least_squares in the physical parameters.

    Parameters on branches that the best point never reaches leave no trace in the curves; they are
    held for the refinement.
    """
    if tracker.best_values is None:
        return
    problem.put(tracker.best_values)
    lost = unreached(problem, tracker.best_values)
    params = problem.params.copy()
    for name in lost:
        params[name].vary = False
    names = tuple(name for name in problem.names if params[name].vary)
    if not names:
        return
    _move_inside(params, names)
    sizes = problem.sizes(names, tracker.best_values)

    def residual(p: lmfit.Parameters) -> Array:
        return tracker.residual(problem.vector(p))

    def jacobian(p: lmfit.Parameters) -> Array:
        return problem.slopes(problem.vector(p), names)

    with warnings.catch_warnings():  # of its covariance, which `uncertainty` does better
        warnings.simplefilter("ignore", RuntimeWarning)
        lmfit.minimize(
            residual, params, method="least_squares", jac=jacobian, x_scale=sizes,
            ftol=1e-10, xtol=1e-10, gtol=1e-12, max_nfev=60,
        )  # fmt: skip


def _move_inside(params: lmfit.Parameters, names: tuple[str, ...]) -> None:
    """Move values off their bounds by a hair, where least_squares wants its start."""
    for name in names:
        parameter = params[name]
        span = parameter.max - parameter.min
        if math.isfinite(span):
            margin = 1e-9 * span
            parameter.value = min(
                max(parameter.value, parameter.min + margin), parameter.max - margin
            )


def _on_limits(problem: Problem, values: Array) -> Array:
    """Put parameters that are within rounding of a limit on it, if that costs nothing.

    The refinement stays off the limits by a hair (`_move_inside`).
    """
    names = problem.free()
    places = [problem.index[name] for name in names]
    near = AT_LIMIT * problem.sizes(names, values)
    moved = values = values + 0.0  # no -0
    for limits in (problem.space().low, problem.space().high):
        close = np.abs(values[places] - limits[places]) <= near
        moved = moved.copy()
        moved[places] = np.where(close, limits[places], moved[places])
    moved = problem.space().complete(moved)
    if np.array_equal(moved, values):
        return values
    failures = problem.objective.failures
    before, after = (float(r @ r) for r in map(problem.objective.residual, (values, moved)))
    fine = problem.objective.failures == failures and after <= before + 1e-6 * (1.0 + before)
    return moved if fine else values


def _moved(model: Model, values: Array, sources: Mapping[int, int]) -> Array:
    """Put other springs in some places of a chain: {place: spring}, 0 at the base."""
    moved = values.copy()
    for name in model.names:
        place, short = split_name(name)
        if place in sources:
            moved[model.index[name]] = values[model.index[f"s{sources[place] + 1}_{short}"]]
    return moved


def _ordered(problem: Problem, values: Array) -> Array:
    """Order springs that the data cannot tell apart by their σ_a, the softest at the base.

    Two springs can be exchanged if they are of one kind and the curves stay the same, so never
    across a mass inside whose displacement is counted; the foam of the paper buckles first at its
    base.
    """
    model = problem.model
    bistable = [i for i, kind in enumerate(model.kinds) if kind == "bistable"]
    if len(bistable) < 2:
        return values
    held = {name for name in model.names if not problem.params[name].vary}
    if any(
        split_name(name)[0] in bistable for name in held if not name.endswith(("eta", "height"))
    ):
        return values

    def onset(spring: int) -> float:
        k0, eps_a = (values[model.index[f"s{spring + 1}_{short}"]] for short in ("k0", "eps_a"))
        return float(k0 * eps_a / (1.0 - eps_a))

    counted = problem.objective.counted
    nodes = [node for name, node in problem.objective.interior.items() if name in counted]

    def order(spring: int) -> tuple[int, float]:
        return sum(node <= spring for node in nodes), onset(spring)

    moved = _moved(model, values, dict(zip(bistable, sorted(bistable, key=order), strict=True)))
    before, after = (problem.objective.residual(v) for v in (values, moved))
    same = np.allclose(before, after, rtol=0.0, atol=1e-9 * max(float(np.max(np.abs(before))), 1.0))
    return moved if same else values
