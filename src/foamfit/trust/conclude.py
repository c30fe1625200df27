"""What to say of the best point: estimates, states, statistics, and the result itself."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.cycles import inner_loops
from foamfit.data.describe import noise_sentences
from foamfit.data.energy import audit
from foamfit.data.measurement import INTEGRATED, interior_channel
from foamfit.errors import SimulationError
from foamfit.fitting.box import scale_in_words
from foamfit.fitting.branches import visited
from foamfit.fitting.curves import MOTION_CURVES
from foamfit.fitting.losses import LOSSES
from foamfit.fitting.objective import MODEL_ERROR, Objective, Simulated
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.results import Correlation, Curves, Fit, Intervals, ParameterEstimate, Switch
from foamfit.springs.parameters import split_name, unit_of
from foamfit.text import engineering, listed, percent
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import make_budget
from foamfit.trust.checklist import MAY_VANISH, Findings, make_checklist, status_of, warnings_of
from foamfit.trust.identifiability import Insight, look
from foamfit.trust.residuals.law_error import CurveError

# Factor between an interval and the local one from which on the local standard error is given up.
ASTRAY = 2.0


def conclude(best: BestPoint, record: SearchRecord, intervals: Intervals | None = None) -> Fit:
    """Assemble the result at the best point, with other intervals than local ones if there are."""
    problem, objective, simulated = best.problem, best.problem.objective, best.simulated
    measurement, specimen = problem.measurement, problem.measurement.specimen
    intervals = Intervals() if intervals is None else intervals
    insight = look(best, _left_over(best)) if best.names else None
    estimates, budget = make_budget(best, _estimates(best, insight, intervals))
    balance, misfit = audit(measurement), objective.misfit(simulated)
    checklist = make_checklist(Findings(best, estimates, misfit, record, balance, intervals))
    springs = best.values[: len(problem.model.names)]
    return Fit(
        measurement=measurement,
        model=problem.model.name,
        drive=objective.drive,
        seed=record.seed,
        status=status_of(checklist),
        warnings=warnings_of(checklist),
        chain=problem.model.chain(springs, specimen.height, specimen.area),
        params=problem.told(),
        parameters=estimates,
        visited=visited(problem, simulated),
        misfit=misfit,
        weights=objective.weights,
        statistics=_statistics(best, record),
        energy=balance.as_dict() | {"sentences": balance.sentences()},
        runtime_s=time.perf_counter() - record.began,
        curves=Curves(
            time=measurement.time,
            measured_stress=measurement.stress,
            measured_displacement=measurement.displacement,
            stress=simulated.curves.get("stress_time"),
            displacement=simulated.curves.get("displacement_time"),
            stress_along=simulated.curves.get("stress_strain"),
            interior={
                node: (measurement.interior[node], simulated.curves[name])
                for name, node in objective.interior.items()
            },
        ),
        switches=_switches(problem, simulated),
        correlation=Correlation(best.names, best.spread.correlation) if best.names else None,
        notes=(*_notes(best), *_noise_notes(objective), *intervals.notes),
        checklist=checklist,
        insight=insight,
        stopped=record.stopped,
        loss=objective.loss,
        relaxation=problem.model.relaxation,
        interior_mass=objective.interior_mass,
        noise=noise_of(best, best.errors if best.names else ()),
        intervals=intervals,
        budget=budget,
    )


def noise_of(best: BestPoint, errors: Sequence[CurveError]) -> dict[str, dict[str, Any]]:
    """Noise of each counted curve, how it is known, its scale, and the residuals over it.

    `errors` are those of the counted curves, or none if nothing varies. `law_error` is the RMS of
    what the law misses beyond the noise, SI, None where it misses nothing else;
    `law_error_evidence` by how much the Bayesian information criterion is for it.
    """
    objective, found = best.problem.objective, {}
    known = dict(zip(objective.counted, errors, strict=True)) if errors else {}
    for name, rms in objective.rms(best.residual).items():
        level, error = objective.noise(name), known.get(name)
        law = error is not None and error.found
        found[name] = asdict(level) | {
            "scale": objective.scale[name],
            "range": float(np.ptp(objective.measured[name])),
            "law_error": error.law / objective.factor(name) if error and law else None,
            "law_error_evidence": error.evidence if error else None,
            "residual_over_noise": rms / level.sigma if level.sigma > 0.0 else None,
        }
    return found


def _noise_notes(objective: Objective) -> list[str]:
    """What the noise is, what the residuals are counted in, and which samples are left out."""
    measurement = objective.measurement
    told = [f"Noise of {sentence}" for sentence in noise_sentences(measurement)]
    counted = objective.counted
    floored = [name for name in counted if objective.scale[name] > objective.noise(name).sigma]
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
        told.append("time_shift: a foam whose stress relaxes looks as if its motion were late.")
    if objective.loss != "linear":
        told.append(
            f"The loss is {objective.loss}: residuals past {LOSSES[objective.loss]:g} of their "
            "units count less than their squares; χ² is that of the loss."
        )
    return told


def _notes(best: BestPoint) -> list[str]:
    """What was left out of the model, and what it would change."""
    problem, simulated = best.problem, best.simulated
    objective, specimen = problem.objective, problem.measurement.specimen
    single = len(problem.model.kinds) == 1
    told = [*problem.notes, *_inner_loops(best)]
    unseen = [name for name in MOTION_CURVES if name not in objective.counted]
    off = [(name.replace("_", "-"), objective.off(simulated, name)) for name in unseen]
    there = [f"the {name} curve is {share:.1%} of its range off" for name, share in off if share]
    if problem.measurement.motion == INTEGRATED and there:
        told.append(
            "The motion was integrated from the force, so it is no second measurement and has no "
            f"misfit; against it {' and '.join(there)}."
        )
    if single and problem.measurement.interior:
        names = ", ".join(map(interior_channel, sorted(problem.measurement.interior)))
        told.append(f"A single spring has no mass inside, so {names} is left out.")
    if objective.drive == "stress":
        told.append(
            "The driving stress is smoothed by a parabola over a twenty-fifth of the samples."
        )
    if single or objective.drive != "impact" or objective.interior_mass:
        return told
    left_out = "The interior masses are left out"
    if specimen.mass is None:
        return [
            *told, f"{left_out}; with [specimen] mass foamfit could say what they would change."
        ]  # fmt: skip
    try:
        other = replace(objective, interior_mass=True).simulate(best.values).curves
    except SimulationError as error:
        return [*told, f"{left_out}; with them the simulation ends: {error}."]
    spoken = {"stress_time": "the base stress", "displacement_time": "the displacement"}
    changes = [
        f"{spoken.get(name, name.removesuffix('_time'))} by {_share(curve, other[name])}"
        for name, curve in simulated.curves.items()
        if name != "stress_strain" and name in other
    ]
    return [
        *told,
        f"{left_out}; the specimen's {specimen.mass * 1e6:.3g} mg between the springs would change "
        f"{' and '.join(changes)} (RMS over range).",
    ]


def _inner_loops(best: BestPoint) -> list[str]:
    """Say what a partial unloading leaves in the residuals of a law that has no inner loops."""
    test, kinds = best.problem.measurement, best.problem.model.kinds
    curve = best.simulated.curves.get("stress_strain")
    if "bistable" not in kinds or "microscale" in kinds or curve is None:
        return []
    assert test.displacement is not None  # there is a curve along it
    assert test.stress is not None
    loops = inner_loops(test.displacement)
    squares = (curve - test.stress) ** 2
    inside = np.zeros(squares.size, dtype=bool)
    for first, stop in loops:
        inside[first:stop] = True
    total = float(squares.sum())
    if not loops or total == 0.0:
        return []
    ends = [(first, min(stop, squares.size - 1)) for first, stop in loops]
    spans = [f"from sample {first} to {stop}" for first, stop in ends]
    if test.time is not None:
        spans = [f"from {engineering(test.time[a], 's')} to {engineering(test.time[b], 's')}"
                 for a, b in ends]  # fmt: skip
    return [
        f"The motion turns back below its peak ({listed(spans)}): these {percent(inside.mean())} "
        f"of the samples hold {percent(float(squares[inside].sum()) / total)} of the squared "
        "residuals of stress-strain. Bistable springs have no inner loops; microscale springs do."
    ]


def _share(one: Array, two: Array) -> str:
    off = float(np.sqrt(np.mean((one - two) ** 2)) / np.ptp(one))
    return "less than 0.01 %" if off < 1e-4 else percent(off)


def _estimates(
    best: BestPoint, insight: Insight | None, intervals: Intervals
) -> dict[str, ParameterEstimate]:
    """Value, uncertainty and state of every parameter; also put into lmfit's parameters."""
    out = {}
    for i, name in enumerate(best.problem.names):
        if best.problem.is_exact(name):
            continue
        value, parameter, unit = float(best.values[i]), best.problem.params[name], unit_of(name)
        if name in best.names:
            assert insight is not None
            out[name] = _varied(best, name, insight, intervals)
        elif parameter.vary:
            branch, spring = best.unreached[name], split_name(name)[0] + 1
            why = f"branch {branch} of spring {spring} was never reached"
            out[name] = ParameterEstimate(value, None, None, unit, True, "not determined", why)
        else:
            why = "held fixed" if parameter.expr is None else f"tied by {parameter.expr}"
            out[name] = ParameterEstimate(value, None, None, unit, False, "fixed", why)
        parameter.stderr = out[name].stderr
    origins = best.problem.measurement.origins
    return {name: one.counted_from(-origins.get(name, 0.0)) for name, one in out.items()}


def _left_over(best: BestPoint) -> dict[str, float]:
    """One standard deviation of what is left of each curve, SI, its correlation counted."""
    objective = best.problem.objective
    return {
        name: math.sqrt(max(process.variance * process.tau, 1e-300)) / objective.factor(name)
        for name, process in zip(objective.counted, best.spread.noise, strict=True)
    }


def _varied(
    best: BestPoint, name: str, insight: Insight, intervals: Intervals
) -> ParameterEstimate:
    """Estimate of a parameter that was varied and whose branch was reached."""
    (low, high), column = best.limits(name), best.names.index(name)
    problem, value, unit = best.problem, float(best.values[best.index[name]]), unit_of(name)
    stderr, half = float(best.spread.stderr[column]), float(best.halves[column])
    local = (value - half, value + half)
    # Percentiles of refits, or of a chain, may all lie to one side of the best point.
    given = (*intervals.ends.get(name, local), value)
    ends = min(given), max(given)
    # Within the limits, which cut both.
    made, by_local = (min(pair[1], high) - max(pair[0], low) for pair in (ends, local))
    ratio = made / by_local if by_local > 0.0 else math.nan
    method = intervals.methods.get(name, "local covariance")
    # refits that stall in a long minimum make a profile narrow: the wider interval is taken
    stalled = ratio < 1.0 / ASTRAY and method == "profile likelihood"
    ends = local if stalled else ends
    span = intervals.ranges.get(name)
    if span is not None:  # of a point a little off, if that was improved last
        span = min(span[0], value), max(span[1], value)
    state, why = state_of(name, value, ends, insight, (low, high), span)
    if state == "determined" and problem.objective.interior_mass:
        state, why = "weak", "the vibration of the interior mass leaves other minima; " + why
    elif state == "determined" and name in intervals.elsewhere:
        there = intervals.elsewhere[name] + problem.measurement.origins.get(name, 0.0)
        told = engineering(there, unit) if unit else f"{there:.3g}"
        state, why = "weak", f"it is {told} at a minimum that fits almost as well; {why}"
    if not 0.5 * (ends[1] - ends[0]) <= covariance.NOTHING * best.sizes[column]:
        return ParameterEstimate(value, None, None, unit, True, state, why, range=span)
    if name in intervals.doubtful:
        why += "; its interval is local, though the cost is no parabola there"
    if stalled:
        method = "local covariance"
        why += "; its profile is much narrower and was not taken"
    elif name in intervals.ends and (ratio < 1.0 / ASTRAY or ASTRAY < ratio < math.inf):
        why += "; the local standard error does not give it"
    ci95 = (max(ends[0], low), min(ends[1], high))
    return ParameterEstimate(value, stderr, ci95, unit, True, state, why, method, span)


def state_of(
    name: str, value: float, ends: tuple[float, float], insight: Insight,
    limits: tuple[float, float], span: tuple[float, float] | None = None,
) -> tuple[str, str]:  # fmt: skip
    """State of a parameter that varies and whose branch is reached, and the reason in one sentence.

    `ends` are those of its 95 % interval, not cut at its `limits`; NaN or infinite where the data
    fix only a combination. `span` is its range, if there is one; the wider of the two counts.
    """
    what = "95 % interval"
    if span is not None and span[1] - span[0] > ends[1] - ends[0]:
        ends, what = span, "range"
    size, short = float(insight.sizes[insight.names.index(name)]), split_name(name)[1]
    unit = unit_of(name)
    half = 0.5 * (ends[1] - ends[0])
    half = half if math.isfinite(half) else math.nan
    state, why = covariance.state(
        value, half, size, *limits, scale_in_words(name, value, size), what
    )
    if state == "not determined":
        reason = why if math.isfinite(half) else "the curves do not depend on it"
        return state, insight.combination(name, covariance.NOTHING / 1.96) or reason
    at_bound = value in limits and value != 0.0
    if short in MAY_VANISH and ends[0] <= 0.0 <= ends[1] and not at_bound:
        side, end = ("lower", ends[0]) if short == "dsigma" else ("upper", ends[1])
        bound = engineering(end, unit).replace("Pa s", "Pa·s").replace("-", "−")
        where = "lies at its limit 0" if value == 0.0 else "is consistent with zero"
        return "weak", f"it {where}; {side} bound {bound} ({what.removesuffix(' interval')})"
    if state == "determined":
        return state, why
    past = [ends[0] <= limits[0], ends[1] >= limits[1]]
    if any(past) and "open" not in why:
        limit = limits[past.index(True)]
        told = engineering(limit, unit) if unit else f"{limit:g}"
        why += f", open on one side: it reaches its limit {told}"
    together = insight.combination(name, covariance.WEAK / 1.96) or insight.companion(name)
    return state, f"{why}; {together}" if together else why


def _statistics(best: BestPoint, record: SearchRecord) -> dict[str, float | int | None]:
    """Statistics as lmfit defines them (chi-square, AIC, BIC), and what the search cost."""
    objective, chisqr = best.problem.objective, best.cost
    n, n_vary = objective.n_data, len(best.names)  # determined or not, they follow the data
    log_likelihood = n * math.log(max(chisqr, 1e-300) / n)
    aic, freedom = log_likelihood + 2 * n_vary, n - n_vary - 1
    return {
        "n_data": n,
        "n_effective": best.spread.effective if best.names else None,
        "n_left_out": sum(map(objective.n_measured, objective.counted)) - n,
        "n_vary": n_vary,
        "chisqr": chisqr,
        "redchi": chisqr / max(n - n_vary, 1),
        "aic": aic,
        "aicc": aic + 2 * n_vary * (n_vary + 1) / freedom if freedom > 0 else None,
        "bic": log_likelihood + n_vary * math.log(n),
        "nfev": objective.evaluations,
        "n_failed": objective.failures,
        "n_starts": record.starts,
        "n_descents": len(record.costs),
        "n_agreeing": record.agreeing,
    }


def _switches(problem: Problem, simulated: Simulated) -> tuple[Switch, ...]:
    """Place the switches of the fitted response on its curves."""
    motion, clock = simulated.motion, problem.objective.time
    laws = problem.model.laws
    return tuple(
        Switch(
            spring=int(spring) + 1,
            source=laws[int(spring)].named_branch(int(left)),
            target=laws[int(spring)].named_branch(int(entered)),
            time=None if problem.measurement.time is None else float(when),
            displacement=float(np.interp(when, clock, motion.displacement[-1])),
            stress=float(np.interp(when, clock, motion.base_stress)),
        )
        for when, spring, left, entered, _ in motion.switches
    )
