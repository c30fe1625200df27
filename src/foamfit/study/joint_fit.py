"""The fit of several tests with linked parameters: uncertainty, scatter between tests, states.

The best values of a scattering parameter in the tests, its common value and its spread depend on
each other. For a given spread, a fit pulls the values towards the common value. The values without
this pull follow from the curvature of the cost, and give common value and spread
(`trust.joint_point`). This is repeated until the spread no longer changes (Laplace's method).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import SimulationError
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import Tracker
from foamfit.fitting.together import Links, Together, fit_linked
from foamfit.options import RATES
from foamfit.parts import ParameterEstimate
from foamfit.springs.parameters import NUISANCE, split_name, unit_of
from foamfit.text import counted
from foamfit.trust import covariance, say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import Settled, judged, settle
from foamfit.trust.covariance import Ends
from foamfit.trust.intervals import FAR, HARDLY_WORSE
from foamfit.trust.joint_point import Error, JointPoint, Spread, common_and_spread, correlation
from foamfit.trust.refits import ITERATIONS, PLACED, TRIALS, left_open, nearer, tolerance
from foamfit.trust.residuals import CurveError
from foamfit.trust.settle import joint_minima

ROUNDS = 12  # most iterations between best values and spreads
STILL = 0.01  # relative change of the spreads at which these iterations end
# Least spread used in a fit, in units of the error of a single test. A stronger pull is taken off
# by a long linear step, which multiplies the errors of the fit along a flat valley: those of kc
# and eps_star of four shoe foams never settled (0.05 and 3 in turn).
LEAST_SPREAD = 2.0
# Tests in which the logarithm of a parameter has a larger error (a factor of 150) are ignored.
SAYS_NOTHING = 5.0
GROUPS = 10  # largest number of groups of tests that are left out in turn
REFIT = 15  # iterations of a fit without one group
LARGEST = 300.0  # largest logarithm of a common value that the tests do not determine
_BLANK = ParameterEstimate(math.nan, systematic=None)  # known for the fits of single tests only
Vectors = Sequence[Array]  # Parameters of each test


@dataclass(frozen=True, eq=False)
class JointFit:
    """Several tests fitted together: the best point, and the spreads of scattering parameters."""

    point: JointPoint
    spreads: Mapping[str, Spread] = field(default_factory=dict)
    ranges: Mapping[str, Ends] = field(default_factory=dict)  # See `ranges_of`
    own: tuple[Mapping[str, Ends], ...] = ()  # of each test, see `own_ranges`
    correlation: tuple[tuple[str, ...], Array] = ((), np.empty((0, 0)))  # See `correlation_of`
    others: tuple[JointPoint, ...] = ()  # other minima, where noise alone decides between them

    @property
    def found(self) -> Together:
        """The fitted tests at the best point."""
        return self.point.found

    @cached_property
    def _settled(self) -> tuple[tuple[Settled, ...], ...]:
        return tuple(settle(best, best.contradictions) for best in self.point.bests)

    def contested(
        self, one: ParameterEstimate, name: str, tests: Sequence[int]
    ) -> ParameterEstimate:
        """Return an estimate with the state that contradictions in these records leave it."""
        for settled, best in ((self._settled[t], self.point.bests[t]) for t in tests):
            if settled and one.ci95 is not None:
                state, why = judged(settled, best, name, one.ci95, (one.state, one.why))
                one = replace(one, state=state, why=why)
        return one


def fit_jointly(problems: Sequence[Problem], links: Links, starts: Sequence[Vectors]) -> JointFit:
    """Fit tests by `fitting.together.fit_linked` and find the uncertainty."""
    found, *minima = joint_minima(fit_linked(problems, links, starts))
    errors = errors_of(found)
    point, undrawn, spreads = JointPoint(found, errors), dict[str, Array](), dict[str, Spread]()
    scatter = [name for name in found.own if links.kind(name) == "scatter"]
    for _ in range(ROUNDS if scatter else 0):
        before, spreads = spreads, {}
        inflations, pulls = dict[str, Array](), dict[str, Array]()
        for name in scatter:
            if (estimate := _spread(point, name)) is not None:
                undrawn[name], spreads[name], inflations[name], pulls[name] = estimate
        if _still(before, spreads):
            break
        found = fit_linked(problems, replace(links, pulls=pulls), [found.values])
        point = JointPoint(found, errors, inflations)
    ranges, refits = ranges_of(point)
    own = own_ranges(point, refits)
    minima = [] if scatter or point.uncertainty.errs else minima
    others = tuple(JointPoint(one, errors) for one in minima)
    return JointFit(point, spreads, ranges, own, correlation_of(point, undrawn), others)


def _spread(point: JointPoint, name: str) -> tuple[Array, Spread, Array, Array] | None:
    """Return logarithms without the pull, spread, inflations and pulls; None for < 2 tests."""
    found, (matrix, bread) = point.found, point.of_logarithms(name)
    drawn = _logarithms(found, name)
    sure = (np.diag(matrix) < SAYS_NOTHING**2) & np.isfinite(drawn)
    if np.count_nonzero(sure) < 2:
        return None
    inner, variance = np.ix_(sure, sure), np.diag(matrix)[sure]
    pull = found.links.pulls.get(name, np.zeros(drawn.size))[sure]
    deviation = drawn[sure] - math.log(found.common[name][0])
    undrawn, inflation = np.full(drawn.size, np.nan), np.ones(drawn.size)
    undrawn[sure] = drawn[sure] + bread[inner] @ (pull**2 * deviation)
    spread = common_and_spread(undrawn[sure], matrix[inner])
    inflation[sure] = np.maximum(variance / np.diag(bread)[sure], 1e-6)
    least = LEAST_SPREAD * math.sqrt(float(np.median(variance)))
    return undrawn, spread, inflation, np.sqrt(inflation) / max(spread.tau, least)


def _logarithms(found: Together, name: str) -> Array:
    """Return the logarithms of a parameter in all tests; NaN where it is fixed or zero."""
    values = np.abs(np.array(found.value(name)))
    free = np.array([name in problem.free() for problem in found.problems]) & (values > 0.0)
    return np.log(np.where(free, values, np.nan))


def _still(before: Mapping[str, Spread], now: Mapping[str, Spread]) -> bool:
    """Return whether no spread changed by more than `STILL`, relative to itself."""
    return before.keys() == now.keys() and all(
        abs(one.tau - before[name].tau) <= STILL * max(one.tau, 1e-3 * one.stderr)
        for name, one in now.items()
    )


def correlation_of(
    point: JointPoint, undrawn: Mapping[str, Array]
) -> tuple[tuple[str, ...], Array]:
    """Return names of own and scattering parameters, and their correlation between specimens.

    It is the correlation of logarithms for parameters with `is_logarithmic`; `undrawn` are the
    logarithms of scattering parameters. Only tests that determine all of these parameters are used;
    see `trust.joint_point.correlation`.
    """
    found, columns, scales = point.found, dict[str, Array](), list[Array]()
    for name in found.own:
        if name in NUISANCE or (found.links.kind(name) == "scatter" and name not in undrawn):
            continue
        values = np.array(found.value(name))
        free = np.array([name in problem.free() for problem in found.problems])
        logs = name in undrawn or (is_logarithmic(split_name(name)[1]) and np.all(values > 0.0))
        own = _logarithms(found, name) if logs else np.where(free, values, np.nan)
        columns[name] = undrawn.get(name, own)
        scales.append(np.abs(values) if logs else np.ones(values.size))
    names = tuple(columns)
    table = np.reshape(list(columns.values()), (len(names), len(found.problems))).T
    complete = np.flatnonzero(np.isfinite(table).all(axis=1))
    errors = np.zeros((len(names), len(names)))
    for t in complete:
        scale = np.array([of_tests[t] for of_tests in scales])
        errors += point.own_errors(int(t), names) / np.outer(scale, scale) / complete.size
    return names, correlation(table[complete], errors)


def errors_of(found: Together) -> tuple[tuple[CurveError, ...], ...]:
    """Return noise and model error in each curve of each test; see `BestPoint.errors`."""
    point = JointPoint(found)
    return tuple(best.judged(point.taken(t)) for t, best in enumerate(point.bests))


def ranges_of(point: JointPoint) -> tuple[dict[str, Ends], list[Together]]:
    """Return ranges of shared values and slopes of rate laws (":b") due to model error.

    A range is the hull of two: the 95 % interval of a value found from the same number of other
    specimens, from fits without each test in turn (a jackknife of n <= `GROUPS` groups, with
    Student's t of n - 1 degrees of freedom); and shared values that fit almost equally well
    (`trust.refits`), with the fits at their ends. Empty if there is only noise.
    """
    refits = list[Together]()
    if not point.uncertainty.errs:
        return {}, refits
    out = _over_specimens(point.found)
    for name in point.found.shared:
        one = next(best for best in point.bests if name in best.problem.free())
        ends = [*out.get(name, ())]
        if point.found.links.kind(name) == "shared":
            held = [fit for sign in (-1.0, 1.0) if (fit := _held(point, name, sign))]
            every = [values[one.index[name]] for fit in held for values in fit.values]
            ends, refits = [*ends, *every, point.found.common[name][0]], refits + held
        if ends:
            low, high = np.clip([min(ends), max(ends)], *one.limits(name)).tolist()
            out[name] = low, high
    return out, refits


def own_ranges(point: JointPoint, refits: Sequence[Together]) -> tuple[dict[str, Ends], ...]:
    """Return the ranges due to model error of the values that each test has for itself."""
    # The hull of values that fit the test almost equally well with the same shared values
    # (`trust.refits`), and of those in the `refits` with other shared values.
    out = []
    for t, best in enumerate(point.bests):
        shared = {name: best.value(name) for name in best.names if name in point.found.shared}
        problem = best.problem.holding(shared)
        alone = BestPoint(problem, best.values)
        found = left_open(alone, (), Tracker(problem.objective), descents=False).ranges
        for name, ends in found.items():
            each = [*ends, *(float(one.values[t][best.index[name]]) for one in refits)]
            found[name] = min(each), max(each)
        out.append(found)
    return tuple(out)


def _over_specimens(found: Together) -> dict[str, Ends]:
    """Return ranges of shared values and slopes from fits without each group of tests."""
    count = len(found.problems)
    groups = range(min(count, GROUPS))
    kept = [[t for t in range(count) if t % GROUPS != group] for group in groups]
    others = [common for one in kept if (common := _without(found, one))]
    if len(others) < 2:
        return {}
    out, quantile = dict[str, Ends](), covariance.half_width(1.0, len(others) - 1)
    for name in found.shared:
        values = np.array([common[name] for common in others if name in common])
        if len(values) < len(others):  # only one group has the parameter
            continue
        halves = quantile * np.sqrt((len(values) - 1.0) * np.var(values, axis=0))
        for at, (value, half) in enumerate(zip(found.common[name], halves, strict=True)):
            out[f"{name}:b" if at else name] = (float(value - half), float(value + half))
    return out


def _without(found: Together, kept: list[int]) -> Mapping[str, tuple[float, ...]] | None:
    """Return the common values of the kept tests; None if they cannot be fitted."""
    links = found.links.of(kept)
    laws = any(links.kind(name) in RATES for name in found.shared)
    if laws and links.log_rates is not None and not np.ptp(links.log_rates) > 0.0:
        return None
    problems, values = [found.problems[t] for t in kept], [found.values[t] for t in kept]
    try:
        return fit_linked(problems, links, [values], iterations=REFIT).common
    except SimulationError:
        return None


def _held(point: JointPoint, name: str, sign: float) -> Together | None:
    """Return a fit with the farthest shared value that fits almost equally well; None if none."""
    found, (value,) = point.found, point.found.common[name]
    rise = sum(map(tolerance, point.bests, point.errors))
    low, high = next(best for best in point.bests if name in best.problem.free()).limits(name)
    change = math.sqrt(rise) * point.reach(name)
    for _ in range(TRIALS):
        end = min(max(value + sign * change, low), high) if math.isfinite(change) else value
        if end == value:
            break
        start = point.moved(name, end - value)
        problems = [problem.holding({name: end}) for problem in found.problems]
        try:
            other = fit_linked(problems, found.links, [start], iterations=ITERATIONS)
        except SimulationError:
            change *= 0.5
            continue
        if other.cost - found.cost <= rise:
            return other
        change = abs(end - value) * nearer(rise, other.cost - found.cost)
    return None


def parameters_of(fit: JointFit, tests: tuple[str, ...]) -> dict[str, ParameterEstimate]:
    """Return all parameters of the joint fit, those of the springs first."""
    problems = fit.found.problems
    return {
        name: parameter_of(fit, tests, name)
        for name in (*problems[0].model.names, *NUISANCE)
        if any(name in one.index and not one.is_exact(name) for one in problems)
    }


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
        return fit.contested(_scattering(fit, name, each), name, free)
    (value, *slope), span = found.common[name], fit.ranges.get(name)
    one = fit.contested(_judged(fit, free[0], name, span), name, free)
    why = f"one value for {counted(len(free), 'test')}: {one.why}"
    if not slope:
        return replace(one, why=why, kind=kind)
    b, error = slope[0], fit.point.of_common(f"{name}:b")
    half, why = error.half, f"at the rate of the median test; {why}"
    if math.isfinite(half):
        one = replace(one, b_stderr=error.stderr, b_ci95=(b - half, b + half))
    b_range = fit.ranges.get(f"{name}:b")
    return replace(one, why=why, kind=kind, tests=each, b=b, b_range=b_range)


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
    if state != "not determined":
        one = replace(one, stderr=abs(value) * spread.stderr, ci95=ci95)
    why = f"common value of {counted(spread.count, 'test')}: {why}"
    one = replace(one, scatter_stderr=spread.tau_stderr, scatter_ci95=spread.tau_ci95)
    return replace(one, value=value, state=state, why=why, scatter=spread.tau)


def _judged(
    fit: JointFit, test: int, name: str, span: Ends | None, *, own: bool = False
) -> ParameterEstimate:
    """Judge the common value, or the `own` one of a `test`, by `trust.covariance.RULE`."""

    def at(point: JointPoint) -> tuple[float, Error]:
        if own:
            return point.bests[test].value(name), point.of_test(test, name)
        return point.found.common[name][0], point.of_common(name)

    problem, (value, error) = fit.found.problems[test], at(fit.point)
    low, high = limits = fit.point.bests[test].limits(name)
    size, unit = float(problem.sizes((name,), fit.found.values[test])[0]), unit_of(name)
    ends, near = (value - error.half, value + error.half), list[float]()
    # As in a fit of one test, the interval extends to other minima that different noise could have
    # made the best, and a value far outside it at a minimum hardly worse leaves it weak.
    for point in fit.others:
        other, around = at(point)
        rise = (point.found.cost - fit.found.cost) / (error.quantile**2 * error.inflation)
        half = around.half * math.sqrt(max(1.0 - rise, 0.0))
        wider = min(ends[0], other - half), max(ends[1], other + half)
        if rise < 1.0 and np.ptp(wider) > (1.0 + PLACED) * np.ptp(ends):
            ends = wider
        near += [other] if rise <= HARDLY_WORSE**2 else []
    state, why = covariance.state(name, value, covariance.wider(ends, span), size, limits)
    far = [x for x in near if max(ends[0] - x, x - ends[1]) > FAR * np.ptp(ends)]
    if state == "determined" and far:
        there = far[0] + problem.measurement.origins.get(name, 0.0)
        state, why = "weak", say("why", "weak", why=why, unit=unit, there=there)
    one = replace(_BLANK, value=value, unit=unit, state=state, why=why, range=span)
    if not np.ptp(ends) <= 2.0 * covariance.NOTHING * size:
        return one
    return replace(one, stderr=error.stderr, ci95=(max(ends[0], low), min(ends[1], high)))


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
            one = _judged(fit, t, name, fit.own[t].get(name), own=True)
        one = one.counted_from(-problem.measurement.origins.get(name, 0.0))
        out[test] = fit.contested(one, name, [t])
    return out
