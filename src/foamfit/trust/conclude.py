"""Result of a fit at the best point: estimates with their states, statistics and notes."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import repeat
from typing import Any

import numpy as np

from foamfit.data.cycles import inner_loops
from foamfit.data.energy import audit, noise_sentences
from foamfit.data.measurement import INTEGRATED, Measurement, interior_channel
from foamfit.data.zeros import UNDER_LOAD
from foamfit.errors import SimulationError
from foamfit.fitting.curves import MOTION_CURVES
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.fitting.objective import MODEL_ERROR
from foamfit.fitting.search import SearchRecord
from foamfit.parts import ParameterEstimate
from foamfit.results import Correlation, Curves, Fit, Intervals, Switch
from foamfit.solve.cache import SPENT
from foamfit.springs.parameters import NUISANCE, any_param, split_name, unit_of
from foamfit.text import engineering
from foamfit.trust import checklist, covariance, say
from foamfit.trust.best_point import BestPoint, cycle_growth, visited
from foamfit.trust.budget import Settled, changed, judged, make_budget, of_flight, settle
from foamfit.trust.covariance import Ends
from foamfit.trust.identifiability import Insight, look

STALLED = 2.0  # a profile narrower than the local interval by more than this factor has stalled
SHORT = 0.8  # share of the change by friction that a linear step finds, in synthetic records
UNDER = 0.05  # share of the peak stress, above which a record ends under load
CLOSED = 0.005  # area of a loop over peak stress times largest strain, below which it is closed


def conclude(best: BestPoint, record: SearchRecord, intervals: Intervals | None = None) -> Fit:
    """Assemble the result at the best point; `intervals` replace the local ones."""
    problem, objective, simulated = best.problem, best.problem.objective, best.simulated
    measurement, specimen = problem.measurement, problem.measurement.specimen
    intervals = Intervals() if intervals is None else intervals
    insight, correlation = (look(best), _correlation(best)) if best.names else (None, None)
    if record.stopped is not None and best.names and best.misfits:
        warnings = (*intervals.warnings, say("interval", "stopped"))
        intervals = replace(intervals, ranged=False, warnings=warnings)
    late = best.value(TIME_SHIFT) if objective.time_shift else 0.0
    on_time = changed(measurement, TIME_SHIFT, late) if late else measurement
    balance, misfit = audit(on_time), objective.misfit(simulated)
    settled = settle(best, best.contradictions or of_flight(best))
    doubts = _doubts(best, record, intervals)
    estimates, budget = make_budget(best, _estimates(best, insight, intervals, settled, doubts))
    checks = checklist.make_checklist(best, estimates, misfit, record, balance, intervals)
    springs = best.values[: len(problem.model.names)]
    return Fit(
        measurement=measurement,
        model=problem.model.name,
        drive=objective.drive,
        seed=record.seed,
        status=checklist.status_of(checks),
        warnings=checklist.warnings_of(checks),
        chain=problem.model.chain(springs, specimen.height, specimen.area),
        params=problem.told(),
        parameters=estimates,
        contradictions=best.contradictions,
        visited=visited(problem, simulated),
        misfit=misfit,
        weights=objective.weights,
        statistics=_statistics(best, record),
        energy=balance.as_dict() | {"sentences": balance.sentences()},
        runtime_s=(total := time.perf_counter() - record.began),
        curves=Curves(
            time=measurement.time,
            measured_stress=measurement.stress,
            measured_displacement=measurement.displacement,
            stress=simulated.curves.get("stress_time"),
            displacement=simulated.curves.get("displacement_time"),
            stress_along=simulated.curves.get("stress_strain"),
            interior={
                node: (measurement.interior[node], objective.as_read(name, simulated.curves[name]))
                for name, node in objective.interior.items()
            },
        ),
        switches=_switches(best),
        correlation=correlation,
        notes=(*problem.notes, *_notes(best), *intervals.notes),
        checklist=checks,
        insight=insight,
        stopped=record.stopped,
        relaxation=problem.model.relaxation,
        interior_mass=objective.interior_mass,
        noise=_noise(best),
        intervals=replace(intervals, draws={}),
        budget=budget,
        priors={prior.name: (prior.mean, prior.sigma) for prior in objective.given},
        weighed_at=() if objective.weighing is None else tuple(objective.weighing.at.tolist()),
        problem=problem,
        effort={
            "simulations": objective.spent.evaluations,
            "with_derivatives": objective.spent.sloped,
            "simulating": objective.spent.seconds,
            "compiled": SPENT.seconds - record.compiled,
            "total": total,
        },
        draws={n: draw + measurement.origins.get(n, 0.0) for n, draw in intervals.draws.items()},
    )


def _noise(best: BestPoint) -> dict[str, dict[str, Any]]:
    """Return the noise of each fitted curve, its source, and residuals and RMS model error, SI."""
    objective, out = best.problem.objective, {}
    smoothed = objective.drive == "displacement" and objective.scenes.motion is not None
    errors = best.errors if best.names else repeat(None)
    for (name, rms), error in zip(objective.rms(best.residual).items(), errors, strict=False):
        curve = objective.as_read(name, best.simulated.curves[name])
        residual = curve - objective.measured[name]
        level = objective.noise(name)
        out[name] = asdict(level) | {
            "scale": objective.scale[name],
            "range": float(np.ptp(objective.measured[name])),
            "law_error": error.law / objective.factor(name) if error and error.found else None,
            "law_error_evidence": error.evidence if error else None,
            "residual_over_noise": rms / level.sigma if level.sigma > 0.0 else None,
            "motion_smoothed": smoothed,
            "residual_q95": float(np.quantile(np.abs(residual[objective.kept[name]]), 0.95)),
        }
    return out


def _notes(best: BestPoint) -> tuple[str, ...]:
    """Return notes on the effects that the model omits, on priors, noise and units of residuals."""
    test, objective = best.problem.measurement, best.problem.objective
    single = len(best.problem.model.kinds) == 1
    derived = set(MOTION_CURVES) - set(objective.counted) if test.motion == INTEGRATED else ()
    off = {name: objective.off(best.simulated, name) for name in MOTION_CURVES if name in derived}
    text = say(
        "notes",
        "all",
        objective=objective,
        loops=_inner_loops(best),
        priors=[(p, unit_of(p.name), best.value(p.name)) for p in objective.given],
        off={name: misfit for name, misfit in off.items() if misfit},
        inside=list(map(interior_channel, sorted(test.interior))) if single else [],
        masses=None if single else _masses(best),
        noises=noise_sentences(test),
        floored=[n for n in objective.counted if objective.scale[n] > objective.noise(n).sigma],
        floor=MODEL_ERROR,
    )
    return tuple(text.splitlines())


def _masses(best: BestPoint) -> dict[str, Any] | None:
    """Return the effect of interior masses omitted from an impact, or the error that "ended" it."""
    objective, mass = best.problem.objective, best.problem.measurement.specimen.mass
    if objective.drive != "impact" or objective.interior_mass:
        return None
    if mass is None:
        return {"changes": [], "ended": None}
    try:
        massive = replace(objective, interior_mass=True)
        with_mass = massive.simulate(best.values, everything=True).curves
    except SimulationError as error:
        return {"changes": [], "ended": error}
    changes = [
        (name, float(np.sqrt(np.mean((curve - with_mass[name]) ** 2)) / np.ptp(curve)))
        for name, curve in best.simulated.curves.items()
        if name != "stress_strain" and name in with_mass
    ]
    return {"mass": mass, "changes": changes}


def _inner_loops(best: BestPoint) -> dict[str, Any] | None:
    """Return the share of partial unloadings in the residuals of laws without inner loops."""
    test, curve = best.problem.measurement, best.simulated.curves.get("stress_strain")
    hysteretic = [law for law in best.problem.model.laws if law.hysteretic]
    if not hysteretic or curve is None or any(law.remembers for law in hysteretic):
        return None
    assert test.displacement is not None
    squares, inside, spans = (curve - test.stress) ** 2, np.zeros(curve.size, dtype=bool), []
    for first, stop in inner_loops(test.displacement):
        inside[first:stop] = True
        ends = [first, min(stop, curve.size - 1)]
        clock = ends if test.time is None else test.time[ends].tolist()
        word, unit = ("sample ", "") if test.time is None else ("", "s")
        start, end = (engineering(at, unit) for at in clock)
        spans.append(f"from {word}{start} to {end}")
    if not spans or not (total := float(squares.sum())) > 0.0:
        return None
    shares = {"samples": float(inside.mean()), "squares": float(squares[inside].sum()) / total}
    return shares | {"spans": spans, "laws": [f"{law.title}s" for law in hysteretic]}


def _doubts(best: BestPoint, record: SearchRecord, intervals: Intervals) -> dict[str, Any]:
    """Return what makes all determined parameters weak, for the sentence of `why.weak`."""
    test, model = best.problem.measurement, best.problem.model
    objective, errs = best.problem.objective, bool(best.names) and best.misfits
    several = [name for name in best.names if len(model.kinds) > 1 and name not in NUISANCE]
    ended = float(test.stress[-3:].mean() / test.stress.max())
    misfit, curve = max((objective.off(best.simulated, n) or 0.0, n) for n in objective.counted)
    return {
        "stopped": not intervals.ranged,
        "vibrates": objective.interior_mass,
        "rounded": objective.drive == "stress" and objective.scenes.smooth and _is_led(test),
        "begun": (model.relaxation or objective.drive == "impact")
        and any(UNDER_LOAD in note for note in test.notes),
        "ended": ended if errs and objective.drive != "impact" and ended > UNDER else 0.0,
        "lost": checklist.lost_height(best),
        "stayed": test.last_cycle is None and test.start_strain != 0.0 and _is_closed(best),
        "alone": errs and not (record.stopped or record.led) and 0 < record.agreeing < 2,
        "cornered": next((name for name in several if errs and any(best.at_limits(name))), ""),
        "off": misfit if misfit > checklist.POOR else 0.0,
        "curve": curve,
    }


def _is_closed(best: BestPoint) -> bool:
    """Return whether loading and unloading coincide in a fitted spring without inner loops.

    If it has not snapped back after a cycle, it goes up and down branches e and c in the next one,
    as a fresh spring does on branches that coincide.
    """
    motion, laws = best.simulated.motion, best.problem.model.laws
    own = np.diff(motion.displacement, axis=0, prepend=0.0)  # compression of each spring
    loops = [np.abs(np.trapezoid(motion.base_stress, w)) / np.ptp(w) for w in own]
    kept = [law.hysteretic and not law.remembers for law in laws]
    return any(np.array(loops)[kept] < CLOSED * motion.base_stress.max())


def _is_led(test: Measurement) -> bool:
    """Return whether the machine led the motion: its stress has bends, which smoothing rounds."""
    if test.displacement is None:
        return False
    n = int(np.argmax(test.displacement)) + 1
    curves = np.column_stack((test.displacement[:n], test.stress[:n]))
    _, off, *_ = np.polyfit(test.instants[:n], curves / np.ptp(curves, axis=0), 1, full=True)
    return bool(off[0] < off[1])


def _estimates(
    best: BestPoint,
    insight: Insight | None,
    intervals: Intervals,
    settled: Sequence[Settled],
    doubts: Mapping[str, Any],
) -> dict[str, ParameterEstimate]:
    """Return the estimates of all parameters; their standard errors are also set in lmfit's."""
    problem, out = best.problem, {}
    varied = {}
    if insight is not None:
        wanted = [name for name in best.names if name not in best.unreached]
        varied = {n: _varied(best, n, insight, intervals, settled, doubts) for n in wanted}
    for name, value in zip(problem.names, best.values.tolist(), strict=True):
        if problem.is_exact(name):
            continue
        parameter = problem.params[name]
        if (estimate := varied.get(name)) is None:
            vary, spring = bool(parameter.vary), split_name(name)[0] + 1
            state, key = ("not determined", "unreached") if vary else ("fixed", "held")
            stderr, ends = _of_tied(best, name, varied) if parameter.expr else (None, None)
            key = "tied" if parameter.expr else key
            if (shown := problem.kept.get(name)) is not None:
                key, stderr, half = "kept", shown.sigma, 1.96 * shown.sigma
                ends = value - half, value + half
            facts = {"branch": best.unreached.get(name), "expression": parameter.expr}
            why = say("why", key, spring=spring, **facts)
            estimate = ParameterEstimate(value, stderr, ends, unit_of(name), vary, state, why)
        parameter.stderr = estimate.stderr
        out[name] = estimate.counted_from(-problem.measurement.origins.get(name, 0.0))
    return out


def _correlation(best: BestPoint) -> Correlation:
    """Return the correlation of varied parameters, then of those given by expressions."""
    spread, problem = best.spread, best.problem
    names = (*best.names, *(name for name in problem.names if problem.params[name].expr))
    moves = problem.moves(best.values, best.names)[[problem.index[name] for name in names]]
    change = np.where(moves == 0.0, 0.0, moves * spread.stderr)  # by one standard error of each
    matrix = change @ np.nan_to_num(spread.correlation) @ change.T
    stderr = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):  # of one that depends on none of them
        return Correlation(names, matrix / np.outer(stderr, stderr), stderr)


def _of_tied(
    best: BestPoint, name: str, varied: Mapping[str, ParameterEstimate]
) -> tuple[float | None, Ends | None]:
    """Return the linearised error and 95 % interval of a parameter that an expression gives."""
    if not varied:
        return None, None
    slopes = best.problem.moves(best.values, best.names)[best.problem.index[name]]
    by = np.flatnonzero(slopes)
    variance = float(slopes[by] @ best.spread.matrix[np.ix_(by, by)] @ slopes[by])
    value, half = best.value(name), 1.96 * math.sqrt(max(variance, 0.0))
    if not 0.0 < half <= covariance.NOTHING * best.size(name):
        return None, None
    ends = value - half, value + half
    # That of a single other parameter need not be symmetric.
    if by.size == 1 and (ci95 := (one := varied[best.names[by[0]]]).ci95) is not None:
        first, last = (value + float(slopes[by[0]]) * (end - one.value) for end in ci95)
        ends = min(first, last), max(first, last)
    return half / 1.96, ends


def _varied(
    best: BestPoint,
    name: str,
    insight: Insight,
    intervals: Intervals,
    settled: Sequence[Settled],
    doubts: Mapping[str, Any],
) -> ParameterEstimate:
    """Return the estimate of a varied parameter whose branch was reached."""
    (low, high), column = best.limits(name), best.names.index(name)
    problem, value, unit = best.problem, best.value(name), unit_of(name)
    local, method = best.local(name), intervals.methods.get(name, "local covariance")
    # The percentiles of a Markov chain may all lie to one side of the best point.
    points = (*intervals.ends.get(name, local), value)
    ends = min(points), max(points)
    width, local_width = (min(pair[1], high) - max(pair[0], low) for pair in (ends, local))
    # Refits that stall in a long valley make a profile too narrow: use the wider local interval.
    stalled = method == "profile likelihood" and STALLED * width < local_width
    ends = local if stalled else ends
    span = intervals.ranges.get(name)
    if span is not None:  # it may belong to the point before the last improvement
        span = min(span[0], value), max(span[1], value)
    state, why = _state_of(best, name, ends, insight, span)
    zero = problem.measurement.origins.get(name, 0.0)  # in the numbers of the file
    if (there := intervals.elsewhere.get(name)) is not None:
        there += zero
    own = {"there": there, "rubbed": _rubbed(best, name)}
    doubted = any({**doubts, "curve": ""}.values()) or any(x is not None for x in own.values())
    if state == "determined" and doubted:
        state, why = "weak", say("why", "weak", why=why, unit=unit, **own, **doubts)
    state, why = judged(settled, best, name, (ends[0] + zero, ends[1] + zero), (state, why))
    if not 0.5 * (ends[1] - ends[0]) <= covariance.NOTHING * best.sizes[column]:
        return ParameterEstimate(value, None, None, unit, True, state, why, range=span)
    method = "local covariance" if stalled else method
    why = say("why", "interval", why=why, stalled=stalled)
    ci95, stderr = (max(ends[0], low), min(ends[1], high)), float(best.spread.stderr[column])
    return ParameterEstimate(value, stderr, ci95, unit, True, state, why, method, span)


def _rubbed(best: BestPoint, name: str) -> float | None:
    """Return the value with friction in the rig if it is far from the fitted one, else None."""
    if best.friction is None or name in NUISANCE:
        return None
    value, there = best.value(name), float(best.friction[1][best.index[name]])
    far = abs(there - value) > SHORT * covariance.WEAK * min(best.size(name), abs(there))
    return there if far else None


def _state_of(
    best: BestPoint, name: str, ends: Ends, insight: Insight, span: Ends | None
) -> tuple[str, str]:
    """Return the state of a varied parameter whose branch was reached, and the reason.

    `ends` is its 95 % interval, not cut at its limits; NaN or infinite where the data fix only a
    combination. `span` is its range, if there is one; the wider of the two decides.
    """
    (ends, what), limits, unit = covariance.wider(ends, span), best.limits(name), unit_of(name)
    value, size = best.value(name), best.size(name)
    state, why = covariance.state(name, value, (ends, what), size, limits)
    if state == "not determined":
        reason = why if math.isfinite(ends[1] - ends[0]) else say("why", "independent")
        return state, insight.combination(name, covariance.NOTHING / 1.96) or reason
    at_bound = value in limits and value != 0.0
    if checklist.may_vanish(name) and ends[0] <= 0.0 <= ends[1] and not at_bound:
        below = any_param(split_name(name)[1]).admissible == "zero or negative"
        side, end = ("lower", ends[0]) if below else ("upper", ends[1])
        what = what.removesuffix(" interval")
        return "weak", say("why", "zero", value=value, side=side, bound=end, unit=unit, what=what)
    if state == "determined":
        return state, why
    past = ends[0] <= limits[0], ends[1] >= limits[1]
    if any(past) and "open" not in why:
        why = say("why", "open", why=why, limit=limits[past.index(True)], unit=unit)
    together = insight.combination(name, covariance.WEAK / 1.96)
    return state, f"{why}; {together}" if together else why


def _statistics(best: BestPoint, record: SearchRecord) -> dict[str, float | int | None]:
    """Return the statistics as lmfit defines them (χ², AIC, BIC), and the effort of the search."""
    objective, chisqr = best.problem.objective, best.cost
    n, n_vary = objective.n_data, len(best.names)  # including undetermined ones
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
        "nfev": objective.spent.evaluations,
        "n_failed": objective.spent.failures,
        "n_starts": record.starts,
        "n_descents": record.descents,
        "n_agreeing": record.agreeing,
        "cycle_growth": cycle_growth(best),
    }


def _switches(best: BestPoint) -> tuple[Switch, ...]:
    """Return the switches of the fitted response with their place on the curves."""
    motion, clock = best.simulated.motion, best.problem.objective.time
    own_laws, timed = best.problem.model.laws, best.problem.measurement.time is not None
    return tuple(
        Switch(
            spring=int(spring) + 1,
            source=own_laws[int(spring)].named_branch(int(left)),
            target=own_laws[int(spring)].named_branch(int(entered)),
            time=float(when) if timed else None,
            displacement=float(np.interp(when, clock, motion.displacement[-1])),
            stress=float(np.interp(when, clock, motion.base_stress)),
        )
        for when, spring, left, entered, _ in motion.switches
    )
