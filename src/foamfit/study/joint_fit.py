"""The fit of several tests with linked parameters, its uncertainty, and the scatter between them.

With a parameter that scatters, the best values of the tests, the common value and the spread depend
on each other. Given a spread, the tests are drawn to their common value as much as their errors
allow; what they would say undrawn follows from the curvature, and from that REML gives the common
value and the spread (`trust.scatter`): in turn until the spread stands still (Laplace's method).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import stats

from foamfit.arrays import Array
from foamfit.errors import SimulationError
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.links import RATES, Links
from foamfit.fitting.problem import Problem
from foamfit.fitting.together import Together, fit_linked
from foamfit.springs.parameters import NUISANCE, split_name
from foamfit.trust import covariance
from foamfit.trust.best_point import JointPoint
from foamfit.trust.ranges import ITERATIONS, TRIALS, nearer, tolerance
from foamfit.trust.residuals.law_error import CurveError, curve_errors
from foamfit.trust.scatter import Spread, common_and_spread, correlation

# Rounds between the best values and the spreads at most, and the change of the logarithm of a
# spread at which they end.
ROUNDS, STILL = 12, 0.01
# Least spread of a scattering parameter, over the error of a single test: with zero spread all
# tests would have one value, and their own values would stay unknown.
LEAST_SPREAD = 0.3
# Tests say nothing of a parameter whose logarithm has a larger error than this (a factor of 150).
SAYS_NOTHING = 5.0
# Groups of tests that are left out in turn, and steps of a fit without one of them.
GROUPS, REFIT = 10, 15
Map = Callable[..., Iterable[Any]]
Vectors = Sequence[Array]  # Parameters of each test


@dataclass(frozen=True, eq=False)
class JointFit:
    """Several tests fitted together: the best point, and the spread of what scatters."""

    point: JointPoint
    spreads: Mapping[str, Spread] = field(default_factory=dict)
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # See `ranges_of`
    correlation: tuple[tuple[str, ...], Array] = ((), np.empty((0, 0)))  # See `correlation_of`

    @property
    def found(self) -> Together:
        """The fit itself."""
        return self.point.found


def fit_jointly(
    problems: Sequence[Problem],
    links: Links,
    starts: Sequence[Vectors],
    *,
    each: Map = map,
) -> JointFit:
    """Fit tests as `fitting.together.fit_linked` does, and judge the fit; `each` is like `map`."""
    found = fit_linked(problems, links, starts)
    errors = errors_of(found, each)
    point, undrawn, spreads = JointPoint(found, errors), dict[str, Array](), dict[str, Spread]()
    scatter = [name for name in found.own if links.kind(name) == "scatter"]
    for _ in range(ROUNDS if scatter else 0):
        before, spreads = spreads, {}
        inflations, pulls = dict[str, Array](), dict[str, Array]()
        for name in scatter:
            if (told := _spread(point, name)) is not None:
                undrawn[name], spreads[name], inflations[name], pulls[name] = told
        if _still(before, spreads):
            break
        found = fit_linked(problems, replace(links, pulls=pulls), [found.values])
        point = JointPoint(found, errors, inflations)
    return JointFit(point, spreads, ranges_of(point, each), correlation_of(point, undrawn))


def _spread(point: JointPoint, name: str) -> tuple[Array, Spread, Array, Array] | None:
    """What tests say undrawn (logarithms), spread, inflations, pulls; None of fewer than two."""
    found, (matrix, bread) = point.found, point.of_logarithms(name)
    drawn = _logarithms(found, name)
    there = (np.diag(matrix) < SAYS_NOTHING**2) & np.isfinite(drawn)
    if np.count_nonzero(there) < 2:
        return None
    inner, variance = np.ix_(there, there), np.diag(matrix)[there]
    pull = found.links.pulls.get(name, np.zeros(drawn.size))[there]
    off = drawn[there] - math.log(found.common[name][0])
    undrawn, inflation = np.full(drawn.size, np.nan), np.ones(drawn.size)
    undrawn[there] = drawn[there] + bread[inner] @ (pull**2 * off)
    spread = common_and_spread(undrawn[there], matrix[inner])
    inflation[there] = np.maximum(variance / np.diag(bread)[there], 1e-6)
    least = LEAST_SPREAD * math.sqrt(float(np.median(variance)))
    return undrawn, spread, inflation, np.sqrt(inflation) / max(spread.tau, least)


def _logarithms(found: Together, name: str) -> Array:
    """Logarithms of a parameter in all tests; NaN where it does not vary, or vanishes."""
    values = np.abs(np.array(found.value(name)))
    free = np.array([name in problem.free() for problem in found.problems]) & (values > 0.0)
    return np.log(np.where(free, values, np.nan))


def _still(before: Mapping[str, Spread], now: Mapping[str, Spread]) -> bool:
    """Whether no spread changed by more than `STILL` of itself."""
    return before.keys() == now.keys() and all(
        abs(one.tau - before[name].tau) <= STILL * max(one.tau, 1e-3 * one.stderr)
        for name, one in now.items()
    )


def correlation_of(
    point: JointPoint, undrawn: Mapping[str, Array]
) -> tuple[tuple[str, ...], Array]:
    """Names of own and scattering parameters, and their correlation between specimens.

    Of logarithms where these are what varies (`is_logarithmic`); `undrawn` has them for what
    scatters. Tests count that tell of all of these parameters; see `trust.scatter.correlation`.
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
    there = np.flatnonzero(np.isfinite(table).all(axis=1))
    errors = np.zeros((len(names), len(names)))
    for t in there:
        scale = np.array([one[t] for one in scales])
        errors += point.own_errors(int(t), names) / np.outer(scale, scale) / there.size
    return names, correlation(table[there], errors)


def errors_of(found: Together, each: Map = map) -> tuple[tuple[CurveError, ...], ...]:
    """What the residual of each curve of each test is made of; see `BestPoint.errors`."""
    point = JointPoint(found)
    work = [best.to_judge(point.taken(t)) for t, best in enumerate(point.bests)]
    return tuple(each(curve_errors, *zip(*work, strict=True)))


def ranges_of(point: JointPoint, each: Map = map) -> dict[str, tuple[float, float]]:
    """What the error of the law leaves open of shared values and (":b") slopes by rate.

    The wider of two: where a value would lie (95 %) were it found from as many other specimens, by
    fits without each test in turn (a jackknife of at most `GROUPS` groups, with Student's t of one
    less than their number); and how far a shared value can be held off while all tests are followed
    about as well (`trust.ranges`). Empty where all is noise.
    """
    if not point.uncertainty.errs:
        return {}
    out = _over_specimens(point.found, each)
    shared = [name for name in point.found.shared if point.found.links.kind(name) == "shared"]
    ways = [(name, sign) for name in shared for sign in (-1.0, 1.0)]
    held = each(_held, [point] * len(ways), *zip(*ways, strict=True)) if ways else ()
    for (name, _), end in zip(ways, held, strict=True):
        ends = [end, point.found.common[name][0], *out.get(name, ())]
        out[name] = min(ends), max(ends)
    return out


def _over_specimens(found: Together, each: Map) -> dict[str, tuple[float, float]]:
    """Ranges of shared values and of slopes by the fits without each test in turn."""
    count = len(found.problems)
    groups = [range(first, count, GROUPS) for first in range(min(count, GROUPS))]
    kept = [[t for t in range(count) if t not in group] for group in groups]
    others = [common for common in each(_without, [found] * len(kept), kept) if common]
    if len(others) < 2:
        return {}
    out, quantile = dict[str, tuple[float, float]](), covariance.half_width(1.0, len(others) - 1)
    for name in found.shared:
        values = np.array([common[name] for common in others if name in common])
        if len(values) < len(others):  # a test that alone has it says nothing of others
            continue
        halves = quantile * np.sqrt((len(values) - 1.0) * np.var(values, axis=0))
        for at, (value, half) in enumerate(zip(found.common[name], halves, strict=True)):
            out[f"{name}:b" if at else name] = (float(value - half), float(value + half))
    return out


def _without(found: Together, kept: list[int]) -> Mapping[str, tuple[float, ...]] | None:
    """What the kept tests have in common; None where they cannot be fitted alone."""
    links = found.links.of(kept)
    laws = any(links.kind(name) in RATES for name in found.shared)
    if laws and links.log_rates is not None and not np.ptp(links.log_rates) > 0.0:
        return None
    problems, values = [found.problems[t] for t in kept], [found.values[t] for t in kept]
    try:
        return fit_linked(problems, links, [values], iterations=REFIT).common
    except SimulationError:
        return None


def _held(point: JointPoint, name: str, sign: float) -> float:
    """How far a shared value can be held off while the tests are followed about as well."""
    found, (value,) = point.found, point.found.common[name]
    rise = sum(map(tolerance, point.bests, point.errors))
    low, high = next(best for best in point.bests if name in best.problem.free()).limits(name)
    off = math.sqrt(rise) * point.reach(name)
    for _ in range(TRIALS):
        end = min(max(value + sign * off, low), high) if math.isfinite(off) else value
        if end == value:
            break
        start = point.moved(name, end - value)
        problems = [problem.holding(name, end) for problem in found.problems]
        try:
            missed = fit_linked(problems, found.links, [start], iterations=ITERATIONS).cost
        except SimulationError:
            off *= 0.5
            continue
        if missed - found.cost <= rise:
            return end
        off = abs(end - value) * nearer(rise, missed - found.cost, 0.8)
    return value


@dataclass(frozen=True)
class Alternative:
    """One kind of a parameter, and the evidence for it."""

    parameter: str
    kind: str
    chosen: bool
    bic: float
    n_vary: int
    chi2: float


def evidence(
    fit: Together, names: Sequence[str], n_eff: int, kinds: Sequence[str], near: Sequence[Vectors]
) -> tuple[tuple[Alternative, ...], dict[str, float]]:
    """Evidence for each of these kinds of each of these parameters, the others as they are.

    Also the parameters whose slope by rate the tests leave open, and by how much (`open_slope`).
    """
    found, wide = list[Alternative](), dict[str, float]()
    for name in names:
        mine = fit.links.kind(name)
        for kind, one in _kinds_of(fit, name, (mine, *kinds), [fit.values, *near], wide):
            score = one.bic(n_eff)
            found.append(Alternative(name, kind, kind == mine, score, one.n_vary, one.cost))
    return tuple(found), wide


def choose_kinds(
    problems: Sequence[Problem],
    links: Links,
    names: Sequence[str],
    starts: Sequence[Vectors],
    n_eff: int,
    kinds: Sequence[str],
) -> Links:
    """Links in which each of these parameters has the kind of the least BIC.

    All are shared at first; in each round the change of one kind that lowers BIC most is taken. A
    law of rate is not offered where the tests leave its slope open (`open_slope`).
    """
    now = fit_linked(problems, links.having(**dict.fromkeys(names, "shared")), starts)
    while True:
        trials = [
            one
            for name in names
            for kind, one in _kinds_of(now, name, kinds, [now.values, *starts[:1]], {})
            if kind != now.links.kind(name)
        ]
        found = min(trials, key=lambda one: one.bic(n_eff), default=now)
        if found.bic(n_eff) >= now.bic(n_eff):
            return now.links
        now = found


def _kinds_of(
    fit: Together, name: str, kinds: Sequence[str], near: Sequence[Vectors], wide: dict[str, float]
) -> Iterator[tuple[str, Together]]:
    """Fits with a parameter of these kinds, and of its present one, the others as they are.

    Kinds that cannot be simulated are left out, and laws of rate where the slope is open (`wide`).
    """
    mine = fit.links.kind(name)
    for kind in sorted(dict.fromkeys(kinds), key=lambda kind: (kind in RATES, kind != mine)):
        if kind in RATES and kind != mine and name in wide:
            continue
        try:
            links = fit.links.having(**{name: kind})
            one = fit if kind == mine else fit_linked(fit.problems, links, near)
        except SimulationError:
            continue
        yield kind, one
        if kind == "own" and any(other in RATES for other in kinds):
            half = open_slope(one, name)
            if half > covariance.WEAK:
                wide[name] = half


def open_slope(fit: Together, name: str) -> float:
    """Half of the 95 % interval of a parameter's slope by rate from its own value in each test.

    The scatter of specimens about a law of rate is in no error of a fit in which that law holds. A
    slope (of the logarithm) of one doubles a value with the rate.
    """
    there = [name in problem.free() for problem in fit.problems]
    values = np.array(fit.value(name))[there]
    level = float(np.median(values))
    if fit.links.log_rates is None or values.size < 3 or level == 0.0:
        return math.inf
    x = fit.links.log_rates[there]
    if not np.ptp(x) > 0.0:
        return math.inf
    logs = np.log(values / level) if np.all(values / level > 0.0) else values / level
    return covariance.half_width(float(stats.linregress(x, logs).stderr), values.size - 2)
