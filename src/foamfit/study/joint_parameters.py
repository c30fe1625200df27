"""From the fit of several tests to its result: parameters with their states, and sentences."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import contradictions
from foamfit.data.measurement import ASKED
from foamfit.data.zeros import CONTRADICTED
from foamfit.fitting.links import RATES
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.fitting.together import Together
from foamfit.parts import ParameterEstimate
from foamfit.report import render
from foamfit.results import Fit, Loop, loop_of
from foamfit.springs.parameters import NUISANCE, unit_of
from foamfit.study.joint_fit import JointFit
from foamfit.study.joint_result import JointResult, JointTest
from foamfit.study.study_file import Study
from foamfit.text import counted
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import judged, settle, unsettled
from foamfit.trust.checklist import POOR, UNACCEPTABLE, status_of, warnings_of
from foamfit.trust.conclude import conclude, noise_of
from foamfit.trust.covariance import Ends

# Items of the checklist that apply only to a search.
_OF_A_SEARCH = ("ended", "agree")
_BLANK = ParameterEstimate(math.nan, systematic=None)  # known for the fits of single tests only
LARGEST = 300.0  # largest logarithm of a common value that the tests do not determine
# More than this share of χ², and this multiple of its share of samples, make a test dominant.
DOMINANT, MORE = 0.5, 2.0


def fit_of_test(
    problem: Problem, values: Array, parameters: dict[str, ParameterEstimate], note: str, seed: int
) -> Fit:
    """Return the result of a test in a joint fit; `systematic` is from this test alone."""
    problem.put(values)
    alone = conclude(BestPoint(problem, values), SearchRecord(seed, 0, time.perf_counter()))
    checklist = tuple(check for check in alone.checklist if check.key not in _OF_A_SEARCH)
    own = {
        name: replace(one, systematic=alone.parameters.get(name, one).systematic)
        for name, one in parameters.items()
    }
    return replace(
        alone,
        parameters=own,
        notes=(note, *alone.notes),
        checklist=checklist,
        status=status_of(checklist),
        warnings=warnings_of(checklist),
        budget=None,
    )


def result_of(
    study: Study,
    tests: Mapping[str, Path],
    rates: Sequence[float | None],
    rate0: float | None,
    fit: JointFit,
    alone: Together,
    slopes: Mapping[str, float],
    **about: Any,
) -> JointResult:
    """Return the result of a joint fit of `tests` (names and files) at these rates (1/s).

    `alone` are the separate fits, and `slopes` those of `joint_fit.evidence`. `about` has further
    fields of the result.
    """
    found, parameters = fit.found, parameters_of(fit, tuple(tests))
    total = float(np.sum(found.costs))
    shares = np.divide(found.costs, total) if total else np.full(len(tests), 1.0 / len(tests))
    others = counted(len(tests) - 1, "other test")
    note = f"Fitted together with {others} ({study.name}): intervals use all of them."
    of_tests, fits, loops = dict[str, JointTest](), list[Callable[[], Fit]](), list[Loop]()
    pairs = zip(tests.items(), rates, fit.point.bests, strict=True)
    for t, ((name, file), rate, best) in enumerate(pairs):
        problem, values, curves = best.problem, found.values[t], best.simulated.curves
        measurement, objective = problem.measurement, problem.objective
        estimates = _estimates(problem, values, name, parameters)
        of_tests[name] = JointTest(
            file=str(file),
            drive=objective.drive,
            rate=rate,
            misfit=found.misfits[t],
            chi2_share=float(shares[t]),
            noise=noise_of(best, fit.point.errors[t]),
            n_data=objective.n_data,
            data_sha256=measurement.data_sha256,
            values={one: estimate.value for one, estimate in estimates.items()},
        )
        fits.append(partial(fit_of_test, problem, values, estimates, note, study.seed))
        loop = loop_of(measurement, curves.get("stress_strain"), curves.get("stress_time"))
        loops += [] if loop is None else [loop._replace(name=name)]
    drives = {one.drive for one in of_tests.values()}
    result = JointResult(
        name=study.name,
        model=study.model,
        relaxation=study.relaxation,
        drive=drives.pop() if len(drives) == 1 else None,
        seed=study.seed,
        tests=of_tests,
        rate0=rate0,
        parameters=parameters,
        covariance={"names": fit.point.names, "matrix": _common_covariance(fit)},
        specimens={"names": fit.correlation[0], "correlation": fit.correlation[1]},
        statistics=_statistics(fit, alone),
        loops=tuple(loops),
        fits=tuple(fits),
        fit=fit,
        **about,
    )
    return _with_words(result, fit, alone, slopes)


def _estimates(
    problem: Problem, values: Array, test: str, parameters: Mapping[str, ParameterEstimate]
) -> dict[str, ParameterEstimate]:
    """Return the parameters of one test, as in its fit.json."""
    out = dict[str, ParameterEstimate]()
    for name, value in zip(problem.names, (values + problem.origins).tolist(), strict=True):
        if problem.is_exact(name):
            continue
        one, param = parameters[name], problem.params[name]
        if param.vary:
            at = one.in_test(test)
            method = at.ci95 and "local covariance"
            out[name] = replace(at, value=value, ci95_method=method)
        else:
            why = "held fixed" if param.expr is None else f"tied by {param.expr}"
            out[name] = ParameterEstimate(value, None, None, one.unit, False, "fixed", why)
    return out


def _statistics(fit: JointFit, alone: Together) -> dict[str, float | int]:
    """Return statistics of the joint fit and of the separate fits."""
    found = fit.found
    return {
        "n_tests": len(found.problems),
        "n_data": found.n_data,
        "n_vary": found.n_vary,
        "chisqr": found.cost,
        "redchi": found.cost / max(found.n_data - found.n_vary, 1),
        "n_effective": fit.point.uncertainty.covariance.effective,
        "n_eff": alone.n_eff,
        "bic": found.bic(alone.n_eff),
        "bic_alone": alone.bic(alone.n_eff),
        "n_vary_alone": alone.n_vary,
        "chisqr_alone": alone.cost,
    }


def _common_covariance(fit: JointFit) -> Array:
    """Return the covariance of common values and slopes, SI; see `JointResult`."""
    point, count = fit.point, len(fit.point.names)
    scales = np.ones(count)
    for i, name in enumerate(point.names):
        if fit.found.links.kind(name) == "scatter":
            spread, error = fit.spreads.get(name), point.of_common(name)[0]
            scales[i] = math.exp(min(spread.mean, LARGEST)) if spread else fit.found.common[name][0]
            scales[i] *= spread.stderr / error if spread and error > 0.0 else 1.0
    matrix = point.uncertainty.covariance.matrix[:count, :count]
    return np.asarray(matrix * np.outer(scales, scales))


def parameters_of(fit: JointFit, tests: tuple[str, ...]) -> dict[str, ParameterEstimate]:
    """Return all parameters of the joint fit, those of the springs first."""
    problems = fit.found.problems
    found = {
        name: parameter_of(fit, tests, name)
        for name in (*problems[0].model.names, *NUISANCE)
        if any(name in one.index and not one.is_exact(name) for one in problems)
    }
    for test, best in zip(tests, fit.point.bests, strict=True):
        settled = settle(best, unsettled(best, contradictions(best.problem.measurement)))
        for name in best.problem.free() if settled else ():
            found[name] = _contested(found[name], test, partial(judged, settled, best, name))
    return found


def _contested(
    one: ParameterEstimate, test: str, judge: Callable[[Ends, tuple[str, str]], tuple[str, str]]
) -> ParameterEstimate:
    """Return a parameter with the states that contradictions in the record of a test leave it."""
    if one.ci95 is not None and one.state:
        state, why = judge(one.ci95, (one.state, one.why))
        one = replace(one, state=state, why=why)
    if one.tests is None or test not in one.tests:
        return one
    own = _contested(one.tests[test], "", judge)
    return replace(one, tests={**one.tests, test: own})


def parameter_of(fit: JointFit, tests: tuple[str, ...], name: str) -> ParameterEstimate:
    """Return one parameter of the joint fit."""
    found, kind = fit.found, fit.found.links.kind(name)
    free = [t for t, problem in enumerate(found.problems) if name in problem.free()]
    each = _values(fit, tests, name)
    if not free:
        fixed = next(iter(each.values()))
        value = float(np.median([one.value for one in each.values()]))
        return replace(fixed, value=value, kind="fixed")
    if kind == "own":
        value = float(np.median([each[tests[t]].value for t in free]))
        why = "one value for each test; this is their median"
        return replace(_BLANK, value=value, unit=unit_of(name), why=why, kind=kind, tests=each)
    if kind == "scatter":
        return _scattering(fit, name, each)
    (value, *slope), span = found.common[name], fit.ranges.get(name)
    one = _judged(fit, free[0], name, value, fit.point.of_common(name), span)
    why = f"one value for {counted(len(free), 'test')}: {one.why}"
    why = f"at the rate of the median test; {why}" if slope else why
    joint = replace(one, why=why, range=span, kind=kind)
    if not slope:
        return joint
    b, (error, freedom) = slope[0], fit.point.of_common(f"{name}:b")
    half = covariance.half_width(error, freedom)
    determined = math.isfinite(half)
    return replace(
        joint,
        tests=each,
        b=b,
        b_stderr=error if determined else None,
        b_ci95=(b - half, b + half) if determined else None,
        b_range=fit.ranges.get(f"{name}:b"),
    )


def _scattering(fit: JointFit, name: str, tests: dict[str, ParameterEstimate]) -> ParameterEstimate:
    spread = fit.spreads.get(name)
    one = replace(_BLANK, unit=unit_of(name), kind="scatter", tests=tests, state="not determined")
    if spread is None:
        why = "too few tests determine it to estimate its common value"
        return replace(one, value=fit.found.common[name][0], why=why)
    sign = -1.0 if next(iter(tests.values())).value < 0.0 else 1.0
    value, *ends = (sign * np.exp(np.minimum([spread.mean, *spread.ci95], LARGEST))).tolist()
    ci95, limits = (min(ends), max(ends)), (-math.inf, math.inf)
    state, why = covariance.state(name, value, covariance.wider(ci95, None), abs(value), limits)
    determined = state != "not determined"
    return replace(
        one,
        value=value,
        stderr=abs(value) * spread.stderr if determined else None,
        ci95=ci95 if determined else None,
        state=state,
        why=f"common value of {counted(spread.count, 'test')}: {why}",
        scatter=spread.tau,
        scatter_stderr=spread.tau_stderr,
        scatter_ci95=spread.tau_ci95,
    )


def _judged(
    fit: JointFit,
    test: int,
    name: str,
    value: float,
    error: tuple[float, float],
    span: Ends | None = None,
) -> ParameterEstimate:
    """Judge a value by the wider of interval and range (`trust.covariance.RULE`).

    `error` contains standard error and degrees of freedom; limits and scale are those of `test`.
    """
    problem, (stderr, freedom) = fit.found.problems[test], error
    low, high = limits = fit.point.bests[test].limits(name)
    size = float(problem.sizes((name,), fit.found.values[test])[0])
    half = covariance.half_width(stderr, freedom)
    ends = (value - half, value + half)
    state, why = covariance.state(name, value, covariance.wider(ends, span), size, limits)
    one = replace(_BLANK, value=value, unit=unit_of(name), state=state, why=why)
    if not half <= covariance.NOTHING * size:
        return one
    return replace(one, stderr=stderr, ci95=(max(ends[0], low), min(ends[1], high)))


def _values(fit: JointFit, tests: tuple[str, ...], name: str) -> dict[str, ParameterEstimate]:
    """Return a parameter in each test that has it, with the zeros of the test's file."""
    out, found = dict[str, ParameterEstimate](), fit.found
    for t, (test, problem) in enumerate(zip(tests, found.problems, strict=True)):
        if name not in problem.index or problem.is_exact(name):
            continue
        one = replace(_BLANK, value=float(found.values[t][problem.index[name]]), unit=unit_of(name))
        branch = fit.point.bests[t].unreached.get(name)
        if not problem.params[name].vary:
            one = replace(one, vary=False, state="fixed", why="held fixed")
        elif branch is not None and found.links.kind(name) == "own":
            why = f"branch {branch} was never reached"
            one = replace(one, state="not determined", why=why)
        else:
            span = fit.own[t].get(name)
            one = _judged(fit, t, name, one.value, fit.point.of_test(t, name), span)
            one = replace(one, range=span)
        out[test] = one.counted_from(-problem.measurement.origins.get(name, 0.0))
    return out


def _with_words(
    result: JointResult, fit: JointFit, alone: Together, open_slopes: Mapping[str, float]
) -> JointResult:
    """Return a joint fit with its status, warnings and sentences."""
    lost, large, wrong, missed = dict[str, None](), list[Any](), list[Any](), list[float]()
    doubts = dict[str, list[str]]()  # tests by their notes about probable errors in the input
    every = zip(result.tests.items(), fit.point.bests, fit.point.errors, strict=True)
    for (test, one), best, errors in every:
        objective = best.problem.objective
        pairs = zip(objective.counted, errors, strict=True)
        shares = [error.law / objective.span(curve) for curve, error in pairs if error.found]
        missed += [max(shares)] if shares else []
        measurement = best.problem.measurement
        found = unsettled(best, contradictions(measurement))
        for note in measurement.notes:
            if note.startswith(ASKED) and CONTRADICTED not in note:
                doubts.setdefault(note.removeprefix(ASKED).strip(), []).append(test)
        wrong += [(test, each, objective.drive) for each in found]
        for curve in objective.counted:
            misfit, measured = one.misfit[curve], objective.measured[curve]
            if misfit is None or not misfit <= UNACCEPTABLE * np.std(measured) / np.ptp(measured):
                lost[test] = None
            elif misfit > POOR:
                large.append((test, curve, misfit))
    rates = [rate for rate in result.rates if rate is not None]
    top = max(result.tests.values(), key=lambda one: one.chi2_share)
    told: dict[str, Any] = {
        "result": result,
        "laws": RATES,
        "rates": f"{min(rates):.3g} to {max(rates):.3g} 1/s" if rates else "",
        "slopes": [(n, result.parameters[n].kind, half) for n, half in open_slopes.items()],
        "dominant": max(DOMINANT, MORE * top.n_data / fit.found.n_data),
        "top": (next(name for name, one in result.tests.items() if one is top), top),
        "lost": list(lost),
        "large": large,
        "wrong": wrong,
        "doubts": doubts,
        "missed": missed,
        "together": _span_of(fit.found.misfits),
        "alone": _span_of(alone.misfits),
        "n_vary": fit.found.n_vary,
    }
    warnings = render.sentences("joint_warnings", **told)
    status = "failed" if lost else "warnings" if warnings else "ok"
    said = render.sentences("joint_sentences", **told)
    return replace(result, status=status, warnings=warnings, sentences=said)


def _span_of(found: Sequence[dict[str, float | None]]) -> Ends | None:
    """Return smallest and largest misfit of some fits, of the loop or else of a time curve."""
    names = ("stress_strain", "stress_time", "displacement_time")
    each = (next((fit[n] for n in names if fit.get(n) is not None), None) for fit in found)
    misfits = [misfit for misfit in each if misfit is not None]
    return (min(misfits), max(misfits)) if misfits else None
