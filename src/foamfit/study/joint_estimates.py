"""What is said of a joint fit: values, intervals, states, warnings and sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.links import RATES
from foamfit.report import render
from foamfit.springs.parameters import NUISANCE, unit_of
from foamfit.study.joint_fit import JointFit
from foamfit.study.joint_result import JointData, JointParameter, TestValue
from foamfit.text import counted, listed, percent
from foamfit.trust import covariance
from foamfit.trust.checklist import POOR, UNACCEPTABLE

# Logarithms of what tests leave open by any number of orders of magnitude end here.
LARGEST = 300.0
# Share of χ² from which on one test of many is named.
DOMINANT = 0.5
Joint = TypeVar("Joint", bound=JointData)


def common_covariance(fit: JointFit) -> tuple[tuple[str, ...], Array]:
    """Covariance of the common values and slopes, SI; see `JointData.to_json_dict`."""
    point, count = fit.point, len(fit.point.names)
    scales = np.ones(count)
    for i, name in enumerate(point.names):
        if fit.found.links.kind(name) == "scatter":
            one, before = fit.spreads.get(name), point.of_common(name)[0]
            scales[i] = math.exp(min(one.mean, LARGEST)) if one else fit.found.common[name][0]
            scales[i] *= one.stderr / before if one and before > 0.0 else 1.0
    matrix = point.uncertainty.covariance.matrix[:count, :count]
    return point.names, matrix * np.outer(scales, scales)


def parameters_of(fit: JointFit, tests: tuple[str, ...]) -> dict[str, JointParameter]:
    """All parameters of the joint fit, those of the springs first."""
    problems = fit.found.problems
    return {
        name: parameter_of(fit, tests, name)
        for name in (*problems[0].model.names, *NUISANCE)
        if any(name in one.index and not one.is_exact(name) for one in problems)
    }


def parameter_of(fit: JointFit, tests: tuple[str, ...], name: str) -> JointParameter:
    """One parameter of the joint fit."""
    found, unit, kind = fit.found, unit_of(name), fit.found.links.kind(name)
    there = [t for t, problem in enumerate(found.problems) if name in problem.free()]
    each = _values(fit, tests, name)
    if not there:
        value = float(np.median([one.value for one in each.values()]))
        return JointParameter("fixed", value, unit, state="fixed", why="held fixed")
    if kind == "own":
        value = float(np.median([each[tests[t]].value for t in there]))
        why = "one value for each test; this is their median"
        return JointParameter(kind, value, unit, why=why, tests=each)
    if kind == "scatter":
        return _scattering(fit, name, each)
    (value, *slope), span = found.common[name], fit.ranges.get(name)
    one = _judged(fit, there[0], name, value, fit.point.of_common(name), span)
    why = f"one value for {counted(len(there), 'test')}: {one.why}"
    why = f"at the rate of the median test; {why}" if slope else why
    joint = JointParameter(kind, value, unit, one.stderr, one.ci95, one.state, why, range=span)
    if not slope:
        return joint
    b, (error, freedom) = slope[0], fit.point.of_common(f"{name}:b")
    half = covariance.half_width(error, freedom)
    known = math.isfinite(half)
    return replace(
        joint,
        tests=each,
        b=b,
        b_stderr=error if known else None,
        b_ci95=(b - half, b + half) if known else None,
        b_range=fit.ranges.get(f"{name}:b"),
    )


def _scattering(fit: JointFit, name: str, tests: dict[str, TestValue]) -> JointParameter:
    unit, spread, kind = unit_of(name), fit.spreads.get(name), "scatter"
    if spread is None:
        why = "too few tests determine it to tell its common value"
        value = fit.found.common[name][0]
        return JointParameter(kind, value, unit, state="not determined", why=why, tests=tests)
    sign = -1.0 if next(iter(tests.values())).value < 0.0 else 1.0
    value, *ends = (sign * np.exp(np.minimum([spread.mean, *spread.ci95], LARGEST))).tolist()
    known_to = (min(ends), max(ends))
    limits = (-math.inf, math.inf)
    state, why = covariance.state(name, value, covariance.wider(known_to, None), abs(value), limits)
    known = state != "not determined"
    return JointParameter(
        kind,
        value,
        unit,
        abs(value) * spread.stderr if known else None,
        known_to if known else None,
        state,
        f"common value of {counted(spread.count, 'test')}: {why}",
        tests,
        spread.tau,
        spread.tau_stderr,
        spread.tau_ci95,
    )


def _judged(
    fit: JointFit,
    test: int,
    name: str,
    value: float,
    known: tuple[float, float],
    span: tuple[float, float] | None = None,
) -> TestValue:
    """Judge a value by its interval, or by its range if that is wider (`trust.covariance.RULE`)."""
    problem, (stderr, freedom) = fit.found.problems[test], known
    limits = fit.point.bests[test].limits(name)
    size = float(problem.sizes((name,), fit.found.values[test])[0])
    half = covariance.half_width(stderr, freedom)
    ends = (value - half, value + half)
    judged = covariance.state(name, value, covariance.wider(ends, span), size, limits)
    if not half <= covariance.NOTHING * size:
        return TestValue(value, None, None, *judged)
    return TestValue(value, stderr, (max(ends[0], limits[0]), min(ends[1], limits[1])), *judged)


def _values(fit: JointFit, tests: tuple[str, ...], name: str) -> dict[str, TestValue]:
    """A parameter in each test that leaves it free or holds it, in the numbers of its file."""
    out, found = dict[str, TestValue](), fit.found
    for t, (test, problem) in enumerate(zip(tests, found.problems, strict=True)):
        if name not in problem.index or problem.is_exact(name):
            continue
        value = float(found.values[t][problem.index[name]])
        branch = fit.point.bests[t].unreached.get(name)
        if not problem.params[name].vary:
            one = TestValue(value, None, None, "fixed", "held fixed")
        elif branch is not None and found.links.kind(name) == "own":
            why = f"branch {branch} was never reached"
            one = TestValue(value, None, None, "not determined", why)
        else:
            one = _judged(fit, t, name, value, fit.point.of_test(t, name))
        zero = problem.measurement.origins.get(name, 0.0)
        ends = one.ci95 and (one.ci95[0] + zero, one.ci95[1] + zero)
        out[test] = replace(one, value=value + zero, ci95=ends)
    return out


def with_words(result: Joint) -> Joint:
    """Give a joint fit its status, warnings and sentences."""
    lost, large = dict[str, None](), list[str]()
    for t, (test, problem) in enumerate(zip(result.tests, result.problems, strict=True)):
        for curve in problem.objective.counted:
            off, measured = result.fit.found.misfits[t][curve], problem.objective.measured[curve]
            if off is None or not off <= UNACCEPTABLE * np.std(measured) / np.ptp(measured):
                lost[test] = None
            elif off > POOR:
                large.append(f"{test} ({curve} {percent(off)})")
    share, top = max(zip(result.shares, result.tests, strict=True))
    evidence = list[tuple[str, str, str, float]]()  # the best kind, its own, how much lower BIC is
    for name, tried in result.tried.items():
        mine, best = next(o for o in tried if o.chosen), min(tried, key=lambda one: one.bic)
        evidence.append((name, best.kind, mine.kind, mine.bic - best.bic))
    known = [rate for rate in result.rates if rate is not None]
    shown = {
        "parameters": list(result.parameters.items()),
        "laws": RATES,
        "rates": f"{min(known):.3g} to {max(known):.3g} 1/s" if known else "",
        "slopes": [
            (name, result.parameters[name].kind, half) for name, half in result.open_slopes.items()
        ],
    }
    warnings = render.sentences(
        "joint_warnings",
        refused=[(Path(file).name, why.rstrip(".")) for file, why in result.refused.items()],
        lost=list(lost),
        large=large,
        top=(top, share) if len(result.tests) > 3 and share > DOMINANT else None,
        gap=result.bic - result.alone.bic(result.alone.n_eff),
        together=span_of(result.fit.found.misfits),
        alone=span_of(result.alone.misfits),
        evidence=evidence,
        **shown,
    )
    kinds = dict[str, list[str]]()
    for name, one in result.parameters.items():
        kinds.setdefault(one.kind, []).append(name)
    sentences = render.sentences(
        "joint_sentences",
        tests=len(result.tests),
        n_vary=result.fit.found.n_vary,
        kinds=[f"{listed(names)} {kind}" for kind, names in kinds.items() if kind != "fixed"],
        scatter=[
            f"{name} {percent(one.scatter)} ({' to '.join(map(percent, one.scatter_ci95))})"
            for name, one in result.parameters.items()
            if one.scatter is not None and one.scatter_ci95 is not None
        ],
        **shown,
    )
    status = "failed" if lost else "warnings" if warnings else "ok"
    return replace(result, status=status, warnings=warnings, sentences=sentences)


def span_of(found: Sequence[dict[str, float | None]]) -> tuple[float, float] | None:
    """Smallest and largest misfit of some fits, of the loop or else of the stress; None if none."""
    names = ("stress_strain", "stress_time", "displacement_time")
    each = (next((one[n] for n in names if one.get(n) is not None), None) for one in found)
    known = [one for one in each if one is not None]
    return (min(known), max(known)) if known else None
