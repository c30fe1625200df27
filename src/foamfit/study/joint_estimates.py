"""The parameters of a joint fit: values, intervals and states, in common and in each test."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.box import scale_in_words
from foamfit.springs.parameters import NUISANCE, unit_of
from foamfit.study.joint_fit import JointFit
from foamfit.study.joint_result import JointParameter, TestValue
from foamfit.text import counted
from foamfit.trust import covariance

# Logarithms of what tests leave open by any number of orders of magnitude end here.
LARGEST = 300.0


def common_covariance(fit: JointFit) -> tuple[tuple[str, ...], Array]:
    """Covariance of the common values and slopes, SI; see `JointData.to_json_dict`."""
    point, scales = fit.point, []
    for name in point.names:
        one, scale = fit.spreads.get(name), 1.0
        if fit.found.links.kind(name) == "scatter":
            scale = math.exp(min(one.mean, LARGEST)) if one else fit.found.common[name][0]
            before = point.of_common(name)[0]
            scale *= one.stderr / before if one and before > 0.0 else 1.0
        scales.append(scale)
    count = len(scales)
    return point.names, point.covariance.matrix[:count, :count] * np.outer(scales, scales)


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
    words = f"one value for {counted(len(there), 'test')}"
    words = f"at the rate of the median test; {words}" if slope else words
    why = f"{words}: {one.why}"
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
    """One parameter that scatters between specimens."""
    unit, spread, kind = unit_of(name), fit.spreads.get(name), "scatter"
    if spread is None:
        why = "too few tests determine it to tell its common value"
        value = fit.found.common[name][0]
        return JointParameter(kind, value, unit, state="not determined", why=why, tests=tests)
    sign = -1.0 if next(iter(tests.values())).value < 0.0 else 1.0
    value, *ends = (sign * np.exp(np.minimum([spread.mean, *spread.ci95], LARGEST))).tolist()
    half = 0.5 * abs(ends[1] - ends[0])
    state, why = covariance.state(value, half, abs(value), -math.inf, math.inf)
    known = state != "not determined"
    return JointParameter(
        kind,
        value,
        unit,
        abs(value) * spread.stderr if known else None,
        (min(ends), max(ends)) if known else None,
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
    low, high = fit.point.bests[test].limits(name)
    size = float(problem.sizes((name,), fit.found.values[test])[0])
    half = covariance.half_width(stderr, freedom)
    wider, what = half, "95 % interval"
    if span is not None and 0.5 * (span[1] - span[0]) > half:
        wider, what = 0.5 * (span[1] - span[0]), "range"
    of = scale_in_words(name, value, size)
    state, why = covariance.state(value, wider, size, low, high, of, what)
    if not half <= covariance.NOTHING * size:
        return TestValue(value, None, None, state, why)
    return TestValue(value, stderr, (max(value - half, low), min(value + half, high)), state, why)


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
