"""The fit: search, refinement by lmfit, uncertainty, and the verdict."""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import lmfit
import numpy as np
from numpy.typing import NDArray

from foamfit import kernels, uncertainty
from foamfit.audit import EnergyAudit, audit
from foamfit.errors import InputError, SimulationError
from foamfit.measurement import Measurement, interior_channel
from foamfit.model import BRANCHES, Model, split_name, unit_of
from foamfit.objective import (
    Objective,
    Simulated,
    check_interior,
    choose_drive,
    default_weights,
)
from foamfit.result import Correlation, Curves, FitResult, ParameterEstimate, Switch
from foamfit.search import Scales, SearchStoppedError, Space, Tracker, search

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

# A curve was not fitted if it is off by more than this share of its own standard deviation; it is
# fitted poorly if it is off by more than this share of its range.
UNACCEPTABLE = 0.5
POOR = 0.05

# Descents of the search for each spring.
STARTS = 16

Costs = list[tuple[float, int]]


def make_params(
    measurement: Measurement, model: str | Model = "bistable", drive: str | None = None
) -> lmfit.Parameters:
    """Parameters of a model for a test, with bounds from its scales; change them, then `fit`.

    One damper varies in the impact drive: the dashpot of a single spring, and in a chain the onsite
    damper of the striker, as in the paper. The other drives are rate-independent unless told
    otherwise. Heights are the specimen's where it states
    them, else they vary with their sum fixed.

    Parameters
    ----------
    measurement : Measurement
        The test.
    model : str or Model
        For example "linear+bistable".
    drive : str, optional
        "impact", "stress" or "displacement"; see `foamfit.objective.choose_drive`.

    Returns
    -------
    lmfit.Parameters
        Values in SI, named s1_k0 … site_eta.
    """
    model = Model.parse(model) if isinstance(model, str) else model
    drive = choose_drive(measurement) if drive is None else drive
    scales = Scales.of(measurement)
    stress, slope = scales.stress, scales.slope
    guess = {
        "k0": (3.0 * slope, 1e-3 * stress, 1e4 * stress),
        "kc": (20.0 * slope, 1e-2 * stress, 1e5 * stress),
        "dsigma": (-0.1 * stress, -10.0 * stress, 0.0),
        "eps_a": (0.15 * scales.strain, 1e-3, 0.95),
        "eps_c": (0.8 * scales.strain, 2e-3, 0.999),
        "kh_plus": (slope, 0.0, 100.0 * slope),
        "kh_minus": (0.3 * slope, 0.0, 100.0 * slope),
        "eta": (0.0, 0.0, 10.0 * scales.eta),
    }
    params = lmfit.Parameters()
    count = len(model.kinds)
    for name in model.names:
        spring, short = split_name(name)
        if short == "height":
            continue
        value, low, high = guess[short]
        vary = short != "eta" or (drive == "impact" and (spring >= 0) == (count == 1))
        params.add(name, value=value, min=low, max=high, vary=vary)
    _add_heights(params, measurement, model)
    for name in model.names:
        if name.endswith("_dsigma"):
            own = name.removesuffix("dsigma")
            eps_a = params[own + "eps_a"].value
            params[name].value = -0.2 * params[own + "k0"].value * eps_a / (1.0 - eps_a)
    return params


def _add_heights(params: lmfit.Parameters, measurement: Measurement, model: Model) -> None:
    """Heights of a chain: the specimen's, or varied with their sum fixed."""
    count = len(model.kinds)
    if count == 1:
        return
    specimen = measurement.specimen
    if specimen.heights is not None:
        if len(specimen.heights) != count:
            raise InputError(
                f"{measurement.name}: [specimen] heights has {len(specimen.heights)} values for "
                f"a model of {count} springs; give one per spring, base first"
            )
        for i, height in enumerate(specimen.heights, start=1):
            params.add(f"s{i}_height", value=height, vary=False)
        return
    low = 0.02 * specimen.height
    for i in range(1, count):
        value = specimen.height / count
        params.add(f"s{i}_height", value=value, min=low, max=specimen.height - low)
    params.add(f"s{count}_height", expr=_rest_of_height(measurement, model))


def _rest_of_height(measurement: Measurement, model: Model) -> str:
    """Expression of the last spring's height: what the others leave of the specimen."""
    others = [f"s{i}_height" for i in range(1, len(model.kinds))]
    return " - ".join([repr(measurement.specimen.height), *others])


@dataclass(frozen=True, eq=False)
class _Problem:
    """What a fit works on, and the way between lmfit's parameters and the flat vector."""

    measurement: Measurement
    model: Model
    objective: Objective
    params: lmfit.Parameters
    scales: Scales

    def vector(self, params: lmfit.Parameters | None = None) -> Array:
        values = (self.params if params is None else params).valuesdict()
        return np.array([values[name] for name in self.model.names])

    def put(self, values: Array) -> None:
        """Write a flat vector into the parameters that vary."""
        for name, value in zip(self.model.names, values, strict=True):
            if self.params[name].expr is None:
                self.params[name].value = float(value)
        self.params.update_constraints()

    def free(self) -> tuple[str, ...]:
        return tuple(name for name in self.model.names if self.params[name].vary)

    def tied(self) -> Callable[[Array], Array]:
        """Completion of a vector by the expressions among the parameters."""
        tied = [name for name in self.model.names if self.params[name].expr is not None]
        if not tied:
            return lambda values: values
        places = [self.model.index[name] for name in tied]
        rest = _rest_of_height(self.measurement, self.model)
        if [self.params[name].expr for name in tied] == [rest]:
            return self._last_height
        scratch = self.params.copy()

        def complete(values: Array) -> Array:
            for name in self.free():
                scratch[name].value = values[self.model.index[name]]
            scratch.update_constraints()
            for name, place in zip(tied, places, strict=True):
                values[place] = scratch[name].value
            return values

        return complete

    def _last_height(self, values: Array) -> Array:
        """Complete the heights to that of the specimen; the expression itself, but fast."""
        count = len(self.model.kinds)
        values[-2] = self.measurement.specimen.height - values[-1 - count : -2].sum()
        return values

    def space(self) -> Space:
        return Space(
            model=self.model,
            scales=self.scales,
            values=self.vector(),
            free=self.free(),
            low=np.array([self.params[name].min for name in self.model.names]),
            high=np.array([self.params[name].max for name in self.model.names]),
            tied=self.tied(),
        )

    def sizes(self, names: tuple[str, ...], values: Array) -> Array:
        """Natural sizes of some parameters at a point."""
        at = dict(zip(self.model.names, map(float, values), strict=True))
        return np.array([self.scales.of_parameter(name, at) for name in names])


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
    if starts is not None and starts < 1:
        raise InputError(f"starts = {starts} is not admissible; it must be at least 1")
    if max_time is not None and not max_time > 0:
        raise InputError(f"max_time = {max_time:g} s is not admissible; it must be positive")
    problem = _problem(measurement, model, drive, params, weights, interior_mass)
    starts = STARTS * len(problem.model.kinds) if starts is None else starts
    deadline = None if max_time is None else time.monotonic() + max_time
    tracker = Tracker(problem.objective, deadline)
    costs, stopped = _identify(problem, tracker, starts, seed, progress or (lambda *_: None))
    if tracker.best_values is None:
        raise SimulationError(
            f"{measurement.name}: none of the {problem.objective.evaluations} sets of parameters "
            "that were tried could be simulated; check the drive, the heights and the bounds"
        )
    values = _ordered(problem, tracker.best_values)
    problem.put(values)
    return _conclude(problem, values, seed, starts, costs, stopped, began)


def _problem(
    measurement: Measurement,
    model_name: str,
    drive: str | None,
    params: lmfit.Parameters | None,
    weights: Mapping[str, float] | None,
    interior_mass: bool,
) -> _Problem:
    model = Model.parse(model_name)
    drive = choose_drive(measurement) if drive is None else drive
    count = len(model.kinds)
    check_interior(measurement, count)
    chosen = default_weights(measurement, drive, count) if weights is None else dict(weights)
    objective = Objective(measurement, model, drive, chosen, interior_mass=interior_mass)
    wanted = make_params(measurement, model, drive)
    for name in params or ():
        if name not in wanted:
            raise InputError(
                f"parameter '{name}' is not one of the model {model.name}; "
                f"its parameters are {', '.join(model.names)}"
            )
    for name in params or ():
        wanted[name] = params[name]  # type: ignore[index]
    if not any(parameter.vary for parameter in wanted.values()):
        raise InputError("no parameter varies; let at least one vary")
    return _Problem(measurement, model, objective, wanted, Scales.of(measurement))


def _identify(
    problem: _Problem,
    tracker: Tracker,
    starts: int,
    seed: int,
    progress: Callable[[float, str], None],
) -> tuple[Costs, str | None]:
    """Search, then refine by lmfit; returns the costs of the descents and what stopped it."""
    costs: Costs = []
    try:
        costs = search(
            tracker,
            problem.space(),
            starts=starts,
            rng=np.random.default_rng(seed),
            progress=progress,
        )
        progress(0.95, "refinement")
        _refine(problem, tracker)
    except SearchStoppedError:
        return costs, "the time limit"
    except KeyboardInterrupt:
        return costs, "Ctrl-C"
    progress(1.0, "done")
    return costs, None


def _refine(problem: _Problem, tracker: Tracker) -> None:
    """Refine the best point by lmfit's least_squares in the physical parameters.

    Parameters on branches that the best point never reaches leave no trace in the curves; they are
    held for the refinement.
    """
    if tracker.best_values is None:
        return
    problem.put(tracker.best_values)
    unreached = set(_unreached(problem, tracker.best_values))
    params = problem.params.copy()
    for name in unreached:
        params[name].vary = False
    names = tuple(name for name in problem.model.names if params[name].vary)
    if not names:
        return
    _move_inside(params, names)
    sizes = problem.sizes(names, tracker.best_values)
    places = np.array([problem.model.index[name] for name in names])
    steps = np.zeros(len(problem.model.names))
    steps[places] = 1e-5 * sizes
    tied = problem.tied()

    def residual(p: lmfit.Parameters) -> Array:
        return tracker.residual(problem.vector(p))

    def jacobian(p: lmfit.Parameters) -> Array:
        return problem.objective.jacobian(problem.vector(p), steps, places, tied)

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


def _ordered(problem: _Problem, values: Array) -> Array:
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


def _visited(problem: _Problem, simulated: Simulated) -> dict[str, tuple[str, ...]]:
    """Branches that each spring went through, in the order of the first visit."""
    seen = {
        i: ["a" if kind == "bistable" else "line"] for i, kind in enumerate(problem.model.kinds)
    }
    for _, spring, _, entered, _ in simulated.motion.switches:
        name = kernels.BRANCH_NAMES[int(entered)]
        if name not in seen[int(spring)]:
            seen[int(spring)].append(name)
    return {f"s{i + 1}": tuple(names) for i, names in seen.items()}


def _unreached(problem: _Problem, values: Array) -> dict[str, str]:
    """Parameters whose branch was never reached, and that branch."""
    visited = _visited(problem, problem.objective.simulate(values, everything=True))
    out = {}
    for name in problem.model.names:
        spring, short = split_name(name)
        branch = BRANCHES.get(short)
        bistable = branch and problem.model.kinds[spring] == "bistable"
        if branch and bistable and branch not in visited[f"s{spring + 1}"]:
            out[name] = branch
    return out


# ---------------------------------------------------------------- what to say of it


def _conclude(
    problem: _Problem,
    values: Array,
    seed: int,
    starts: int,
    costs: Costs,
    stopped: str | None,
    began: float,
) -> FitResult:
    """Assemble the result at the best point."""
    objective, measurement = problem.objective, problem.measurement
    simulated = objective.simulate(values, everything=True)
    residual = objective.residual(values)
    estimates, spread, correlation = _estimate(problem, values, residual)
    misfit = objective.misfit(simulated)
    balance = audit(measurement)
    n_vary = sum(1 for item in estimates.values() if item.vary and item.stderr is not None)
    warnings = _warnings(problem, estimates, misfit, spread, stopped, costs, balance)
    missed = any(_missed(objective, misfit, name) for name in objective.counted)
    status = "failed" if missed else ("warnings" if warnings else "ok")
    return FitResult(
        measurement=measurement,
        model=problem.model.name,
        drive=objective.drive,
        seed=seed,
        status=status,
        warnings=tuple(warnings),
        chain=problem.model.chain(values, measurement.specimen.height, measurement.specimen.area),
        params=problem.params,
        parameters=estimates,
        visited=_visited(problem, simulated),
        misfit=misfit,
        weights=objective.weights,
        statistics=_statistics(residual, n_vary, starts, spread, objective, costs),
        energy=balance.as_dict() | {"sentences": balance.sentences()},
        runtime_s=time.perf_counter() - began,
        curves=Curves(
            time=measurement.time,
            measured_stress=measurement.stress,
            measured_displacement=measurement.displacement,
            stress=simulated.stress_time,
            displacement=simulated.displacement_time,
            stress_along=simulated.stress_strain,
            interior={
                node: (measurement.interior[node], simulated.interior[name])
                for name, node in objective.interior.items()
            },
        ),
        switches=_switches(problem, simulated),
        correlation=correlation,
        notes=_notes(problem, values, simulated),
    )


def _notes(problem: _Problem, values: Array, simulated: Simulated) -> tuple[str, ...]:
    """What was left out of the model, and what it would change."""
    objective, specimen = problem.objective, problem.measurement.specimen
    unused: tuple[str, ...] = ()
    if len(problem.model.kinds) == 1 and problem.measurement.interior:
        names = ", ".join(map(interior_channel, sorted(problem.measurement.interior)))
        unused = (f"A single spring has no mass inside, so {names} is left out.",)
    if objective.drive == "stress":
        return (
            *unused,
            "The driving stress is smoothed by a parabola over a twenty-fifth of the samples.",
        )
    if len(problem.model.kinds) == 1 or objective.drive != "impact" or objective.interior_mass:
        return unused
    left_out = "The interior masses are left out"
    if specimen.mass is None:
        return (f"{left_out}; with [specimen] mass foamfit could say what they would change.",)
    heavy = Objective(
        problem.measurement, problem.model, "impact", objective.weights, interior_mass=True
    )
    try:
        other = heavy.simulate(values)
    except SimulationError as error:
        return (f"{left_out}; with them the simulation ends: {error}.",)
    changes = [
        f"{name} by {np.sqrt(np.mean((one - two) ** 2)) / np.ptp(one):.2%}"
        for name, one, two in (
            ("the base stress", simulated.stress_time, other.stress_time),
            ("the displacement", simulated.displacement_time, other.displacement_time),
            *((c.removesuffix("_time"), w, other.curve(c)) for c, w in simulated.interior.items()),
        )
        if one is not None and two is not None
    ]
    return (
        f"{left_out}; the specimen's {specimen.mass * 1e6:.3g} mg between the springs would change "
        f"{' and '.join(changes)} (RMS over range).",
    )


def _estimate(
    problem: _Problem, values: Array, residual: Array
) -> tuple[dict[str, ParameterEstimate], uncertainty.Covariance | None, Correlation | None]:
    """Value, uncertainty and state of every parameter; also put into lmfit's parameters."""
    params, objective = problem.params, problem.objective
    unreached = _unreached(problem, values)
    names = tuple(n for n in problem.model.names if params[n].vary and n not in unreached)
    spread = None
    if names:
        sizes = problem.sizes(names, values)
        places = np.array([problem.model.index[name] for name in names])
        jacobian = _slopes(problem, values, places, sizes)
        spread = uncertainty.covariance(jacobian, residual, objective.sizes, sizes)
    out = {}
    for i, name in enumerate(problem.model.names):
        value, parameter = float(values[i]), params[name]
        parameter.stderr = None
        if name in unreached and parameter.vary:
            estimate = ParameterEstimate(
                value, None, None, unit_of(name), True, "not determined",
                f"branch {unreached[name]} of spring {split_name(name)[0] + 1} was never reached",
            )  # fmt: skip
        elif name not in names:
            why = "held fixed" if parameter.expr is None else f"tied by {parameter.expr}"
            estimate = ParameterEstimate(value, None, None, unit_of(name), False, "fixed", why)
        else:
            assert spread is not None
            estimate = _varied(problem, name, value, spread, names.index(name), sizes)
            parameter.stderr = estimate.stderr
        out[name] = estimate
    return out, spread, None if spread is None else Correlation(names, spread.correlation)


def _slopes(problem: _Problem, values: Array, places: NDArray[np.int64], sizes: Array) -> Array:
    """Derivative of the residual by the parameters, (n_data, n_places).

    Where the response jumps (a ringing mass that just closes a loop or does not), differences over
    a short step are as large as the step is short. Of two steps the smaller slope is taken.
    """
    slopes = []
    for share in (1e-5, 3e-4):
        steps = np.zeros(values.size)
        steps[places] = share * sizes
        slopes.append(problem.objective.jacobian(values, steps, places, problem.tied()))
    short, wide = slopes
    jumps = np.linalg.norm(short, axis=0) > 1.5 * np.linalg.norm(wide, axis=0)
    return np.where(jumps, wide, short)


def _varied(
    problem: _Problem,
    name: str,
    value: float,
    spread: uncertainty.Covariance,
    column: int,
    sizes: Array,
) -> ParameterEstimate:
    """Estimate of a parameter that was varied and whose branch was reached."""
    low, high = problem.params[name].min, problem.params[name].max
    stderr = float(spread.stderr[column])
    half = uncertainty.half_width(stderr, spread.effective - len(sizes))
    verdict, why = uncertainty.state(value, half, float(sizes[column]), low, high)
    if verdict == "not determined":
        return ParameterEstimate(value, None, None, unit_of(name), True, verdict, why)
    ci95 = (max(value - half, low), min(value + half, high))
    return ParameterEstimate(value, stderr, ci95, unit_of(name), True, verdict, why)


def _statistics(
    residual: Array,
    n_vary: int,
    starts: int,
    spread: uncertainty.Covariance | None,
    objective: Objective,
    costs: Costs,
) -> dict[str, float | int | None]:
    """Statistics as lmfit defines them (chi-square, AIC, BIC), and what the search cost."""
    n = residual.size
    chisqr = float(residual @ residual)
    log_likelihood = n * math.log(max(chisqr, 1e-300) / n)
    aic = log_likelihood + 2 * n_vary
    room = n - n_vary - 1
    return {
        "n_data": n,
        "n_effective": None if spread is None else spread.effective,
        "n_vary": n_vary,
        "chisqr": chisqr,
        "redchi": chisqr / max(n - n_vary, 1),
        "aic": aic,
        "aicc": aic + 2 * n_vary * (n_vary + 1) / room if room > 0 else None,
        "bic": log_likelihood + n_vary * math.log(n),
        "nfev": objective.evaluations,
        "n_failed": objective.failures,
        "n_starts": starts,
        "n_descents": len(costs),
        "n_agreeing": _agreeing(costs),
    }


def _agreeing(costs: Costs) -> int:
    """How many descents led to the best cost, within 2 %."""
    return sum(count for cost, count in costs if cost <= 1.02 * costs[0][0])


def _missed(objective: Objective, misfit: Mapping[str, float | None], name: str) -> bool:
    """Whether a counted curve was not fitted at all."""
    measured = objective.measured[name]
    assert measured is not None
    return (misfit[name] or 0.0) * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))


def _switches(problem: _Problem, simulated: Simulated) -> tuple[Switch, ...]:
    """Place the switches of the fitted response on its curves."""
    measurement, motion = problem.measurement, simulated.motion
    clock = problem.objective.time
    top, stress = motion.displacement[-1], motion.base_stress
    out = []
    for when, spring, left, entered, _ in motion.switches:
        out.append(
            Switch(
                spring=int(spring) + 1,
                source=kernels.BRANCH_NAMES[int(left)],
                target=kernels.BRANCH_NAMES[int(entered)],
                time=None if measurement.time is None else float(when),
                displacement=float(np.interp(when, clock, top)),
                stress=float(np.interp(when, clock, stress)),
            )
        )
    return tuple(out)


def _warnings(
    problem: _Problem,
    estimates: Mapping[str, ParameterEstimate],
    misfit: Mapping[str, float | None],
    spread: uncertainty.Covariance | None,
    stopped: str | None,
    costs: Costs,
    balance: EnergyAudit,
) -> list[str]:
    """List what a reader must know before trusting the numbers, worst first."""
    objective = problem.objective
    out = []
    if stopped is not None:
        out.append(f"The search was stopped by {stopped}; this is the best point until then.")
    for name in objective.counted:
        off = misfit[name] or 0.0
        if off > POOR:
            word = "is not acceptable" if _missed(objective, misfit, name) else "is large"
            out.append(f"The misfit of {name} is {off:.1%} of its range, which {word}.")
    for verdict in ("not determined", "weak"):
        names = [name for name, item in estimates.items() if item.state == verdict]
        if names:
            reasons = sorted({estimates[name].why for name in names if verdict != "weak"})
            because = f": {'; '.join(reasons)}" if reasons else ""
            out.append(f"{verdict.capitalize()}: {', '.join(names)}{because}.")
    if objective.failures > 0.5 * max(objective.evaluations, 1):
        out.append(
            f"{objective.failures} of {objective.evaluations} trials could not be simulated; "
            "the bounds may be wrong."
        )
    if _agreeing(costs) == 1 and stopped is None:
        out.append("Only one of the descents reached the best point; try more starts.")
    if spread is not None and max(spread.tau) > 5.0:
        out.append(
            "The residuals are structured: they follow each other over "
            f"{max(spread.tau):.0f} samples, and the intervals count that."
        )
    out.extend(balance.warnings())
    return out
