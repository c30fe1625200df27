"""What to say of the best point: estimates, states, statistics, and the result itself."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.data.energy import audit, noise_sentences
from foamfit.data.measurement import INTEGRATED, interior_channel
from foamfit.data.prepare import engineering
from foamfit.errors import SimulationError
from foamfit.fitting.objective import (
    LOSSES,
    MODEL_ERROR,
    MOTION_CURVES,
    Objective,
    Simulated,
    soften,
)
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.results import Correlation, Curves, FitResult, ParameterEstimate, Switch
from foamfit.springs import kernels
from foamfit.springs.parameters import split_name, unit_of
from foamfit.trust import covariance
from foamfit.trust.checklist import MAY_VANISH, Evidence, make_checklist, status_of, warnings_of
from foamfit.trust.identifiability import Insight, look, unreached, visited
from foamfit.trust.intervals import Intervals
from foamfit.trust.refit import Vicinity

Array = NDArray[np.float64]

# Factor between an interval and the local one from which on the local standard error is given up.
ASTRAY = 2.0


def conclude(
    problem: Problem, values: Array, record: SearchRecord, intervals: Intervals | None = None
) -> FitResult:
    """Assemble the result at the best point, with other intervals than local ones if there are."""
    objective, measurement = problem.objective, problem.measurement
    simulated = objective.simulate(values, everything=True)
    springs = values[: len(problem.model.names)]
    residual = objective.differences(values)
    intervals = Intervals() if intervals is None else intervals
    estimates, spread, insight = _estimate(problem, values, intervals)
    correlation = None
    if insight is not None and spread is not None:
        correlation = Correlation(insight.names, spread.correlation)
    balance = audit(measurement)
    evidence = Evidence(
        problem=problem,
        estimates=estimates,
        visited=visited(problem, simulated),
        residual=residual,
        misfit=objective.misfit(simulated),
        spread=spread,
        record=record,
        balance=balance,
        intervals=intervals,
    )
    checklist = make_checklist(evidence)
    n_vary = 0 if insight is None else len(insight.names)  # determined or not, they follow the data
    return FitResult(
        measurement=measurement,
        model=problem.model.name,
        drive=objective.drive,
        seed=record.seed,
        status=status_of(checklist),
        warnings=warnings_of(checklist),
        chain=problem.model.chain(springs, measurement.specimen.height, measurement.specimen.area),
        params=problem.params,
        parameters=estimates,
        visited=evidence.visited,
        misfit=evidence.misfit,
        weights=objective.weights,
        statistics=_statistics(residual, n_vary, spread, objective, record),
        energy=balance.as_dict() | {"sentences": balance.sentences()},
        runtime_s=time.perf_counter() - record.began,
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
        notes=(*_notes(problem, values, simulated), *_noise_notes(objective), *intervals.notes),
        checklist=checklist,
        insight=insight,
        stopped=record.stopped,
        loss=objective.loss,
        noise=_noise(objective, residual),
        intervals=intervals,
    )


def _noise(objective: Objective, residual: Array) -> dict[str, dict[str, Any]]:
    """Noise of each counted curve, how it is known, its scale, and the residuals over it."""
    found = {}
    ends = np.cumsum(objective.sizes)
    for name, end, size in zip(objective.counted, ends, objective.sizes, strict=True):
        level, scale = objective.noise(name), objective.scale[name]
        part = residual[end - size : end] * scale / objective.weights[name] ** 0.5
        rms = float(np.sqrt(np.mean(part**2)))
        found[name] = {
            "sigma": level.sigma,
            "given": level.given,
            "how": level.how,
            "time": level.time,
            "scale": scale,
            "residual_over_noise": rms / level.sigma if level.sigma > 0.0 else None,
        }
    return found


def _noise_notes(objective: Objective) -> list[str]:
    """What the noise is, what the residuals are counted in, and which samples are left out."""
    measurement = objective.measurement
    told = [f"Noise of {sentence}" for sentence in noise_sentences(measurement)]
    floored = [
        name for name in objective.counted if objective.scale[name] > objective.noise(name).sigma
    ]
    if floored:
        told.append(
            f"{', '.join(floored)}: residuals count in units of {MODEL_ERROR:.1%} of the range, "
            "which is more than the estimated noise, so that no channel outweighs another by an "
            "error of the model; reduced χ² is in these units."
        )
    else:
        told.append("Residuals count in units of the noise: at its floor the reduced χ² is 1.")
    for channel, outliers in measurement.outliers.items():
        if outliers.at.size:
            told.append(f"{outliers.at.size} outliers of the {channel} are not fitted.")
    if objective.time_shift and objective.drive != "impact":
        told.append(
            "time_shift: a foam whose stress relaxes leads its strain, and looks just as if the "
            "motion were late."
        )
    if objective.loss != "linear":
        told.append(
            f"The loss is {objective.loss}: residuals past {LOSSES[objective.loss]:g} of their "
            "units count less than their squares; χ² is that of the loss."
        )
    return told


def _notes(problem: Problem, values: Array, simulated: Simulated) -> tuple[str, ...]:
    """What was left out of the model, and what it would change."""
    objective, specimen = problem.objective, problem.measurement.specimen
    unused = problem.notes + _along_integrated(problem, simulated)
    if len(problem.model.kinds) == 1 and problem.measurement.interior:
        names = ", ".join(map(interior_channel, sorted(problem.measurement.interior)))
        unused += (f"A single spring has no mass inside, so {names} is left out.",)
    if objective.drive == "stress":
        return (
            *unused,
            "The driving stress is smoothed by a parabola over a twenty-fifth of the samples.",
        )
    if len(problem.model.kinds) == 1 or objective.drive != "impact" or objective.interior_mass:
        return unused
    left_out = "The interior masses are left out"
    if specimen.mass is None:
        return (
            *unused,
            f"{left_out}; with [specimen] mass foamfit could say what they would change.",
        )
    heavy = replace(objective, interior_mass=True)
    try:
        other = heavy.simulate(values)
    except SimulationError as error:
        return (*unused, f"{left_out}; with them the simulation ends: {error}.")
    changes = [
        f"{name} by {_share(float(np.sqrt(np.mean((one - two) ** 2)) / np.ptp(one)))}"
        for name, one, two in (
            ("the base stress", simulated.stress_time, other.stress_time),
            ("the displacement", simulated.displacement_time, other.displacement_time),
            *((c.removesuffix("_time"), w, other.curve(c)) for c, w in simulated.interior.items()),
        )
        if one is not None and two is not None
    ]
    return (
        *unused,
        f"{left_out}; the specimen's {specimen.mass * 1e6:.3g} mg between the springs would change "
        f"{' and '.join(changes)} (RMS over range).",
    )


def _share(off: float) -> str:
    return "less than 0.01%" if off < 1e-4 else f"{off:.2%}"


def _along_integrated(problem: Problem, simulated: Simulated) -> tuple[str, ...]:
    """How far the fit is from a motion that was integrated from the force it is fitted to."""
    objective = problem.objective
    names = [name for name in MOTION_CURVES if name not in objective.counted]
    if problem.measurement.motion != INTEGRATED or not names:
        return ()
    off = [
        f"the {name.replace('_', '-')} curve is {share:.1%} of its range off"
        for name in names
        if (share := objective.off(simulated, name)) is not None
    ]
    if not off:
        return ()
    return (
        "The motion was integrated from the force, so it is no second measurement and has no "
        f"misfit; against it {' and '.join(off)}.",
    )


def _estimate(
    problem: Problem, values: Array, intervals: Intervals
) -> tuple[dict[str, ParameterEstimate], covariance.Covariance | None, Insight | None]:
    """Value, uncertainty and state of every parameter; also put into lmfit's parameters."""
    params = problem.params
    lost = unreached(problem, values)
    names = tuple(n for n in problem.names if params[n].vary and n not in lost)
    spread = insight = None
    if names:
        around = Vicinity.of(problem, values, names)
        spread = around.spread
        insight = look(problem, values, names, around.jacobian, _left_over(around))
    out = {}
    for i, name in enumerate(problem.names):
        value, parameter = float(values[i]), params[name]
        parameter.stderr = None
        if name in lost and parameter.vary:
            estimate = ParameterEstimate(
                value, None, None, unit_of(name), True, "not determined",
                f"branch {lost[name]} of spring {split_name(name)[0] + 1} was never reached",
            )  # fmt: skip
        elif name not in names:
            why = "held fixed" if parameter.expr is None else f"tied by {parameter.expr}"
            estimate = ParameterEstimate(value, None, None, unit_of(name), False, "fixed", why)
        else:
            assert spread is not None
            assert insight is not None
            estimate = _varied(problem, name, value, spread, insight, intervals)
            parameter.stderr = estimate.stderr
        out[name] = estimate
    return out, spread, insight


def _left_over(around: Vicinity) -> dict[str, float]:
    """One standard deviation of what is left of each curve, SI, its correlation counted."""
    objective, out = around.problem.objective, {}
    for name, process in zip(objective.counted, around.spread.noise, strict=True):
        spread = math.sqrt(max(process.variance * process.tau, 1e-300))
        out[name] = spread * objective.scale[name] / objective.weights[name] ** 0.5
    return out


def _varied(
    problem: Problem,
    name: str,
    value: float,
    spread: covariance.Covariance,
    insight: Insight,
    intervals: Intervals,
) -> ParameterEstimate:
    """Estimate of a parameter that was varied and whose branch was reached."""
    low, high = problem.params[name].min, problem.params[name].max
    column = insight.names.index(name)
    stderr = float(spread.stderr[column])
    half = covariance.half_width(stderr, float(spread.freedom[column]))
    local = (value - half, value + half)
    ends = _holding(value, intervals.ends.get(name, local))
    made, by_local = (
        min(pair[1], high) - max(pair[0], low)  # within the limits, which cut both
        for pair in (ends, local)
    )
    ratio = made / by_local if by_local > 0.0 else math.nan
    # refits that stall in a long valley make a profile narrow: the wider interval is the honest one
    stalled = ratio < 1.0 / ASTRAY and intervals.methods.get(name) == "profile likelihood"
    ends = local if stalled else ends
    verdict, why = state_of(name, value, ends, insight, (low, high))
    if verdict == "determined" and problem.objective.interior_mass:
        verdict, why = "weak", "the ringing of the interior mass leaves other valleys; " + why
    if verdict == "not determined":
        return ParameterEstimate(value, None, None, unit_of(name), True, verdict, why)
    if name in intervals.doubtful:
        why += "; its interval is local, though the cost is no parabola there"
    ci95 = (max(ends[0], low), min(ends[1], high))
    method = intervals.methods.get(name, "local covariance")
    if stalled:
        method = "local covariance"
        why += "; its profile is much narrower and was not taken"
    elif name in intervals.ends and (ratio < 1.0 / ASTRAY or ASTRAY < ratio < math.inf):
        stderr *= ratio
        why += "; its standard error is that of the interval, as the local one does not hold"
    return ParameterEstimate(value, stderr, ci95, unit_of(name), True, verdict, why, method)


def _holding(value: float, ends: tuple[float, float]) -> tuple[float, float]:
    """Ends of an interval in their order, moved out where they do not hold the value.

    Percentiles of refits, or of a chain, may all lie to one side of the best point.
    """
    return min(*ends, value), max(*ends, value)


def state_of(
    name: str,
    value: float,
    ends: tuple[float, float],
    insight: Insight,
    limits: tuple[float, float],
) -> tuple[str, str]:
    """State of a parameter that varies and whose branch is reached, and the reason in one sentence.

    Parameters
    ----------
    name : str
        For example "s1_kc".
    value : float
        Its value.
    ends : (float, float)
        Of its 95 % interval, not cut at the limits; NaN or infinite where the data fix only a
        combination.
    insight : Insight
        What the test can tell there.
    limits : (float, float)
        Its limits.
    """
    size, short = float(insight.sizes[insight.names.index(name)]), split_name(name)[1]
    half = 0.5 * (ends[1] - ends[0])
    half = half if math.isfinite(half) else math.nan
    verdict, why = covariance.state(value, half, size, *limits)
    if verdict == "not determined":
        trace = why if math.isfinite(half) else "it leaves no trace in the curves"
        return verdict, insight.combination(name, covariance.NOTHING / 1.96) or trace
    at_bound = value in limits and value != 0.0
    if short in MAY_VANISH and ends[0] <= 0.0 <= ends[1] and not at_bound:
        reach = engineering(ends[0] if short == "dsigma" else ends[1], unit_of(name))
        reach = reach.replace("Pa s", "Pa·s").replace("-", "−")
        where = "lies at its limit 0" if value == 0.0 else "is not told from zero"
        return "weak", f"it {where}: its 95 % interval goes from 0 to {reach}"
    if verdict == "determined":
        return verdict, why
    past = [ends[0] <= limits[0], ends[1] >= limits[1]]
    if any(past) and "open" not in why:
        limit, unit = limits[past.index(True)], unit_of(name)
        told = engineering(limit, unit) if unit else f"{limit:g}"
        why += f", open on one side: it reaches its limit {told}"
    together = insight.combination(name, covariance.WEAK / 1.96) or insight.companion(name)
    return verdict, f"{why}; {together}" if together else why


def _statistics(
    residual: Array,
    n_vary: int,
    spread: covariance.Covariance | None,
    objective: Objective,
    record: SearchRecord,
) -> dict[str, float | int | None]:
    """Statistics as lmfit defines them (chi-square, AIC, BIC), and what the search cost."""
    n = residual.size
    cost = soften(residual, objective.loss)
    chisqr = float(cost @ cost)
    log_likelihood = n * math.log(max(chisqr, 1e-300) / n)
    aic = log_likelihood + 2 * n_vary
    room = n - n_vary - 1
    return {
        "n_data": n,
        "n_effective": None if spread is None else spread.effective,
        "n_left_out": sum(objective.measured_size(name) for name in objective.counted) - n,
        "n_vary": n_vary,
        "chisqr": chisqr,
        "redchi": chisqr / max(n - n_vary, 1),
        "aic": aic,
        "aicc": aic + 2 * n_vary * (n_vary + 1) / room if room > 0 else None,
        "bic": log_likelihood + n_vary * math.log(n),
        "nfev": objective.evaluations,
        "n_failed": objective.failures,
        "n_starts": record.starts,
        "n_descents": len(record.costs),
        "n_agreeing": record.agreeing,
    }


def _switches(problem: Problem, simulated: Simulated) -> tuple[Switch, ...]:
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
