"""The fit: search, refinement by lmfit, and the best point ever seen."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from numbers import Integral, Real

import lmfit
import numpy as np
from numpy.typing import NDArray

from foamfit.errors import InputError, SimulationError
from foamfit.measurement import Measurement
from foamfit.model import Model, split_name
from foamfit.problem import Problem, make_problem
from foamfit.result import FitResult
from foamfit.search import SearchRecord, SearchStoppedError, Tracker, salvage, search
from foamfit.verdict import conclude, unreached

Array = NDArray[np.float64]

# Descents of the search for each spring.
STARTS = 16


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
    progress: Callable[[float, str], None] | None = None,
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
    progress : callable, optional
        Told the fraction done and what is going on.

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
    _check_call(measurement, seed, starts, max_time, params, weights)
    problem = make_problem(measurement, model, drive, params, weights, interior_mass)
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
        return _finish(problem, tracker.best_values, record)
    except KeyboardInterrupt:  # what was found is not given up for a late Ctrl-C
        return _finish(problem, tracker.best_values, replace(record, stopped="Ctrl-C"))


def _check_call(
    measurement: object,
    seed: object,
    starts: object,
    max_time: object,
    params: object,
    weights: object,
) -> None:
    """Refuse arguments of `fit` that are of no use, by name."""
    if not isinstance(measurement, Measurement):
        raise InputError(
            f"measurement is a {type(measurement).__name__}; give what foamfit.read_test returns"
        )
    for name, value, least in (("seed", seed, 0), ("starts", starts, 1)):
        whole = isinstance(value, Integral) and int(value) >= least
        if not whole and (name == "seed" or value is not None):
            raise InputError(
                f"{name} = {value!r} is not admissible; it must be a whole number, at least {least}"
            )
    if max_time is not None and not (isinstance(max_time, Real) and float(max_time) > 0):
        raise InputError(f"max_time = {max_time!r} is not admissible; it must be positive, in s")
    if params is not None and not isinstance(params, lmfit.Parameters):
        raise InputError("params must be lmfit.Parameters, as foamfit.make_params returns them")
    if weights is not None and not isinstance(weights, Mapping):
        raise InputError("weights must be a mapping of curves to numbers, like {'stress_time': 1}")


def _finish(problem: Problem, values: Array, record: SearchRecord) -> FitResult:
    """Order the springs, write the point into the parameters, and say what is to be said of it."""
    values = _ordered(problem, values)
    problem.put(values)
    return conclude(problem, values, record)


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
    names = tuple(name for name in problem.model.names if params[name].vary)
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
