"""The parameters of a joint fit: values, intervals and states, in common and in each test."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.box import scale_in_words
from foamfit.fitting.problem import Problem
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
        one = fit.spreads.get(name)
        value = math.exp(min(one.mean, LARGEST)) if one else fit.found.common.get(name, (1.0,))[0]
        before = point.of_common(name)[0]
        factor = one.stderr / before if one and before > 0.0 else 1.0
        scales.append(value * factor if fit.found.links.kind(name) == "scatter" else 1.0)
    s = len(scales)
    return point.names, point.covariance.matrix[:s, :s] * np.outer(scales, scales)


def parameters_of(fit: JointFit, tests: tuple[str, ...]) -> dict[str, JointParameter]:
    """All parameters of the joint fit, those of the springs first."""
    problems = fit.found.problems
    names = (*problems[0].model.names, *NUISANCE)
    told = [
        name for name in names
        if any(name in one.index and not one.is_exact(name) for one in problems)
    ]  # fmt: skip
    return {name: parameter_of(fit, tests, name) for name in told}


def parameter_of(fit: JointFit, tests: tuple[str, ...], name: str) -> JointParameter:
    """One parameter of the joint fit."""
    found = fit.found
    kind, unit = found.links.kind(name), unit_of(name)
    there = [t for t, problem in enumerate(found.problems) if name in problem.free()]
    each = _values(fit, tests, name) if kind == "own" or not there else {}
    if not there:
        value = float(np.median([one.value for one in each.values()]))
        return JointParameter("fixed", value, unit, state="fixed", why="held fixed")
    if kind == "own":
        varied = [each[tests[t]].value for t in there]
        return JointParameter(
            kind, float(np.median(varied)), unit,
            why="one value for each test; this is their median", tests=each,
        )  # fmt: skip
    if kind == "scatter":
        return _scattering(fit, tests, name)
    first = found.problems[there[0]]
    (value, *slope) = found.common[name]
    stderr, freedom = fit.point.of_common(name)
    span = fit.ranges.get(name)
    judged = _judged(first, name, value, stderr, freedom, found.values[there[0]], span)
    words = f"one value for {counted(len(there), 'test')}"
    if not slope:
        return replace(_estimate(kind, value, unit, judged, words), range=span)
    b_error, b_freedom = fit.point.of_common(f"{name}:b")
    half = covariance.half_width(b_error, b_freedom)
    known = math.isfinite(half)
    one = _estimate(kind, value, unit, judged, f"at the rate of the median test; {words}")
    return replace(
        one, tests=_values(fit, tests, name), b=slope[0], b_stderr=b_error if known else None,
        b_ci95=(slope[0] - half, slope[0] + half) if known else None,
        range=span, b_range=fit.ranges.get(f"{name}:b"),
    )  # fmt: skip


def _scattering(fit: JointFit, tests: tuple[str, ...], name: str) -> JointParameter:
    """One parameter that scatters between specimens."""
    unit, spread = unit_of(name), fit.spreads.get(name)
    values = _values(fit, tests, name)
    if spread is None:
        (common,) = fit.found.common[name]
        why = "too few tests determine it to tell its common value"
        return JointParameter(
            "scatter", common, unit, state="not determined", why=why, tests=values
        )
    sign = -1.0 if next(iter(values.values())).value < 0.0 else 1.0
    ends = np.minimum([spread.mean, *spread.ci95], LARGEST)
    value, *ends = (sign * np.exp(ends)).tolist()
    half = 0.5 * abs(ends[1] - ends[0])
    state, why = covariance.state(value, half, abs(value), -math.inf, math.inf)
    known = state != "not determined"
    return JointParameter(
        "scatter", value, unit, abs(value) * spread.stderr if known else None,
        (min(ends), max(ends)) if known else None, state,
        f"common value of {counted(spread.count, 'test')}: {why}", values,
        spread.tau, spread.tau_stderr, spread.tau_ci95,
    )  # fmt: skip


_Judged = tuple[float | None, tuple[float, float] | None, str, str]


def _estimate(kind: str, value: float, unit: str, judged: _Judged, words: str) -> JointParameter:
    stderr, ci95, state, why = judged
    return JointParameter(kind, value, unit, stderr, ci95, state, f"{words}: {why}")


def _judged(
    problem: Problem, name: str, value: float, stderr: float, freedom: float, values: Array,
    span: tuple[float, float] | None = None,
) -> _Judged:  # fmt: skip
    """Standard error, interval, state and reason of a value; see `trust.covariance.RULE`.

    `span` is its range, if there is one; the state is that of the wider of the two.
    """
    parameter = problem.params[name]
    low, high = float(parameter.min), float(parameter.max)
    size = float(problem.sizes((name,), values)[0])
    half = covariance.half_width(stderr, freedom)
    of = scale_in_words(name, value, size)
    wider, what = half, "95 % interval"
    if span is not None and 0.5 * (span[1] - span[0]) > half:
        wider, what = 0.5 * (span[1] - span[0]), "range"
    state, why = covariance.state(value, wider, size, low, high, of, what)
    if not half <= covariance.NOTHING * size:
        return None, None, state, why
    return stderr, (max(value - half, low), min(value + half, high)), state, why


def _values(fit: JointFit, tests: tuple[str, ...], name: str) -> dict[str, TestValue]:
    """A parameter in each test that leaves it free or holds it, in the numbers of its file."""
    out, found = dict[str, TestValue](), fit.found
    for t, (test, problem) in enumerate(zip(tests, found.problems, strict=True)):
        if name not in problem.index or problem.is_exact(name):
            continue
        values, zero = found.values[t], -problem.measurement.origins.get(name, 0.0)
        value = float(values[problem.index[name]])
        if not problem.params[name].vary:
            out[test] = TestValue(value - zero, None, None, "fixed", "held fixed")
            continue
        branch = fit.point.bests[t].unreached.get(name)
        if branch is not None and found.links.kind(name) == "own":
            why = f"branch {branch} was never reached"
            out[test] = TestValue(value, None, None, "not determined", why)
            continue
        error, freedom = fit.point.of_test(t, name)
        stderr, ci95, state, why = _judged(problem, name, value, error, freedom, values)
        ends = None if ci95 is None else (ci95[0] - zero, ci95[1] - zero)
        out[test] = TestValue(value - zero, stderr, ends, state, why)
    return out
