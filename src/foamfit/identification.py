"""The fit: search, refinement by lmfit, and the best point ever seen."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace

import lmfit
import numpy as np
from numpy.typing import NDArray

from foamfit.errors import InputError, SimulationError
from foamfit.insight import unreached
from foamfit.intervals import Choice, Intervals, assess
from foamfit.measurement import Measurement
from foamfit.model import Model, split_name
from foamfit.problem import Problem, make_problem
from foamfit.result import FitResult
from foamfit.search import SearchRecord, SearchStoppedError, Tracker, salvage, search
from foamfit.verdict import conclude
from foamfit.vicinity import Vicinity

Array = NDArray[np.float64]

# Descents of the search for each spring.
STARTS = 16
# Refits of the bootstrap and steps of the Markov chain.
DRAWS = {"bootstrap": 500, "mcmc": 2000}
# Evaluations that the default spends on profiles, over those of the search; and how often it goes
# on from a better point that a profile has met.
PROFILE_SHARE, IMPROVEMENTS = 0.5, 3


def fit(
    measurement: Measurement,
    *,
    model: str = "bistable",
    drive: str | None = None,
    seed: int = 0,
    starts: int | None = None,
    max_time: float | None = None,
    params: lmfit.Parameters | None = None,
    weights: Mapping[str, float] | None = None,
    interior_mass: bool = False,
    time_shift: bool = False,
    loss: str = "linear",
    intervals: str = "auto",
    draws: int | None = None,
    progress: Callable[[float, str], None] | None = None,
    tell: Callable[[str], None] | None = None,
) -> FitResult:
    """Identify the parameters of a chain of springs from a test.

    Parameters
    ----------
    measurement : Measurement
        The test; see `foamfit.read_test`.
    model : str
        Springs from the base up, joined by "+".
    drive : str, optional
        "impact", "stress" or "displacement"; by default what the test allows, in this order:
        impact, displacement.
    seed : int
        Same test and seed give the same numbers.
    starts : int, optional
        Descents of the search; by default 16 for each spring.
    max_time : float, optional
        Seconds after which the best point so far is the result.
    params : lmfit.Parameters, optional
        Values, bounds, fixed values and expressions; see `make_params`.
    weights : mapping, optional
        Weight of each curve; see `foamfit.objective.default_weights`.
    interior_mass : bool
        Whether the specimen's mass sits between the springs of a chain, in equal parts; by default
        it is left out, and the result's notes say what it would change.
    time_shift : bool
        Whether the time by which the motion channel is late against the force is fitted too, as
        the parameter time_shift (s).
    loss : str
        "linear" (least squares), or one that gives way to large residuals: "soft_l1", "huber",
        "cauchy"; see `foamfit.objective.soften`.
    intervals : str
        What makes the 95 % intervals: "auto" (local covariance, and profiles of the parameters
        along which the cost is no parabola), "local", "profile", "bootstrap" or "mcmc".
    draws : int, optional
        Refits of the bootstrap (by default 500) or steps of the Markov chain (2000).
    progress : callable, optional
        Told the fraction done and what is going on.
    tell : callable, optional
        Told what the intervals will cost before it is paid.

    Returns
    -------
    FitResult
        Also when Ctrl-C or `max_time` ended the search: the best point ever seen.

    Raises
    ------
    InputError
        If the test cannot feed the drive or a parameter is unknown; the message names it.
    SimulationError
        If nothing that was tried could be simulated.
    """
    began = time.perf_counter()
    if starts is not None and starts < 1:
        raise InputError(f"starts = {starts} is not admissible; it must be at least 1")
    if max_time is not None and not max_time > 0:
        raise InputError(f"max_time = {max_time:g} s is not admissible; it must be positive")
    choice = Choice(intervals, DRAWS.get(intervals, 0) if draws is None else draws, seed)
    problem = make_problem(
        measurement, model, drive, params, weights, interior_mass,
        time_shift=time_shift, loss=loss,
    )  # fmt: skip
    starts = STARTS * len(problem.model.kinds) if starts is None else starts
    deadline = None if max_time is None else time.monotonic() + max_time
    tracker = Tracker(problem.objective, deadline)
    record = SearchRecord(seed, starts, began)
    record = _identify(problem, tracker, record, progress or (lambda *_: None))
    if tracker.best_values is None:
        raise SimulationError(
            f"{measurement.name}: none of the {problem.objective.evaluations} sets of parameters "
            "that were tried could be simulated; check the drive, the heights and the bounds"
        )
    try:
        if record.stopped is None:
            found, record = _assess(problem, tracker, record, choice, tell or (lambda _: None))
        else:
            found = Intervals()
        return _finish(problem, tracker.best_values, record, found)
    except KeyboardInterrupt:  # what was found is not given up for a late Ctrl-C
        record = replace(record, stopped="Ctrl-C")
        return _finish(problem, tracker.best_values, record, Intervals())


def _finish(
    problem: Problem, values: Array, record: SearchRecord, intervals: Intervals
) -> FitResult:
    """Order the springs, write the point into the parameters, and say what is to be said of it."""
    values = _ordered(problem, values)
    problem.put(values)
    return conclude(problem, values, record, intervals)


def _assess(
    problem: Problem,
    tracker: Tracker,
    record: SearchRecord,
    choice: Choice,
    tell: Callable[[str], None],
) -> tuple[Intervals, SearchRecord]:
    """Make the intervals; where these meet a better point, go on from there."""
    assert tracker.best_values is not None
    budget = PROFILE_SHARE * problem.objective.evaluations
    found = Intervals()
    for _ in range(IMPROVEMENTS + 1):
        values = _ordered(problem, tracker.best_values)
        lost = unreached(problem, values)
        names = tuple(name for name in problem.free() if name not in lost)
        if not names:
            break
        vicinity = Vicinity.of(problem, values, names)
        found = assess(
            vicinity,
            choice,
            valleys=tracker.ends,
            deadline=tracker.deadline,
            budget=budget,
            tell=tell,
        )
        if found.better is None:
            break
        before = tracker.best_cost
        tracker.consider(found.better)
        try:
            _refine(problem, tracker)
        except SearchStoppedError:
            break
        if tracker.best_cost < before / 1.02:  # a valley that no descent of the search has found
            record = replace(record, costs=((tracker.best_cost, 1), *record.costs))
    return (found if found.better is None else Intervals()), record


def _identify(
    problem: Problem,
    tracker: Tracker,
    record: SearchRecord,
    progress: Callable[[float, str], None],
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
    except (SearchStoppedError, KeyboardInterrupt) as error:
        salvage(tracker, problem.space(), np.random.default_rng(record.seed))
        late = isinstance(error, SearchStoppedError)
        return replace(record, stopped="the time limit" if late else "Ctrl-C")
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
