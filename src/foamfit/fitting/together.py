"""The fit of several tests with linked parameters.

The residuals of all tests, each in units of its own noise, are minimised as one sum of squares.

A parameter is shared (one value), own (one value per test), scattering (one value per test,
log-normal about a common value), or follows a rate law with a common value v and slope b: with
x = ln(rate/rate0) of a test, v·(1 + b x) or v·(rate/rate0)^b = v·e^(b x).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.fitting import levenberg
from foamfit.fitting.box import Scales, Space
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import Problem
from foamfit.options import POWER_RATE, RATES
from foamfit.springs.parameters import NUISANCE

# A descent ends after two consecutive steps with less than this relative gain, or after ITERATIONS.
ENOUGH, ITERATIONS = 1e-5, 80
# Number of blocks of a curve; noise averages out in each, so that an error of the law shows.
BLOCKS = 50
# Least value whose logarithm is taken, and the largest logarithm.
_TINY, _FAR = 1e-30, 100.0
LEAST_FACTOR = 1e-6  # smallest factor 1 + b x, below which the law has no positive value
STEEPEST = 5.0  # largest absolute slope of a rate law


@dataclass(frozen=True, eq=False)
class Links:
    """The links between the parameters of n tests.

    `kinds` gives one of `KINDS` for each named parameter; all others are own. `log_rates` (n,) are
    ln(rate/rate0), needed for rate laws. `pulls` (n,) of a scattering parameter are the square
    roots of the weights of (ln v - ln common value)²; parameters without an entry have no such
    term.
    """

    kinds: Mapping[str, str]
    log_rates: Array | None = None
    pulls: Mapping[str, Array] = field(default_factory=dict)

    def kind(self, name: str) -> str:
        """Return the kind of a parameter."""
        return self.kinds.get(name, "own")

    def x(self, test: int) -> float:
        """Return ln(rate/rate0) of a test; 0 if no rates are known."""
        return 0.0 if self.log_rates is None else float(self.log_rates[test])

    def having(self, **kinds: str) -> Links:
        """Return links with some kinds replaced."""
        return replace(self, kinds={**self.kinds, **kinds})

    def of(self, tests: list[int]) -> Links:
        """Return the links of a subset of the tests."""
        rates = None if self.log_rates is None else self.log_rates[tests]
        pulls = {name: pull[tests] for name, pull in self.pulls.items()}
        return replace(self, log_rates=rates, pulls=pulls)


def factor(kind: str, b: float, x: float) -> tuple[float, float]:
    """Return value over common value at x = ln(rate/rate0), and its derivative by b."""
    if kind == POWER_RATE:
        value = float(np.exp(b * x))
        return value, x * value
    value = 1.0 + b * x
    return (value, x) if value > LEAST_FACTOR else (LEAST_FACTOR, 0.0)


def start_of(kind: str, values: Array, x: Array) -> tuple[float, float]:
    """Return the common value and slope of the rate law fitted to the values of some tests.

    If the law cannot describe the values, their median and slope zero are returned.
    """
    middle = float(np.median(values))
    if not np.ptp(x) > 0.0:
        return middle, 0.0
    if kind == POWER_RATE and np.all(values > 0.0):
        slope, level = np.polyfit(x, np.log(values), 1)
        v = float(np.exp(level))
    else:
        slope, v = np.polyfit(x, values, 1)
        slope = slope / v if v else 0.0
    slope = float(np.clip(slope, -STEEPEST, STEEPEST))
    if not np.isfinite(v) or v == 0.0 or min(factor(kind, slope, one)[0] for one in x) <= 1e-3:
        return middle, 0.0
    return float(v), slope


def _by_rate(
    kind: str, x: float, logarithmic: bool, v: float, b: float
) -> tuple[float, float, float]:
    """Return a coordinate that follows a rate law, v at rate0, and its derivatives by v and b."""
    f, slope = factor(kind, b, x)
    return (v + math.log(f), 1.0, slope / f) if logarithmic else (v * f, f, v * slope)


@dataclass(frozen=True, eq=False)
class Term:
    """One test in a sum of squares.

    `places` are the indices of its coordinates (in the box `space`) among all coordinates. The
    slope b of a rate law follows directly after the value at rate0. Each scattering parameter has
    a residual, its pull: its logarithm minus that of the common value, times `weights`.
    """

    objective: Objective
    space: Space
    names: tuple[str, ...]  # Parameter of each coordinate
    places: NDArray[np.intp]
    # The rate laws of some coordinates, by their index; see `_by_rate`
    rates: Mapping[int, Callable[[float, float], tuple[float, float, float]]]
    pulled: NDArray[np.intp]  # Indices of the scattering parameters in the vector of parameters
    commons: NDArray[np.intp]  # Indices of the coordinates ln(common value)
    weights: Array

    @cached_property
    def all_places(self) -> NDArray[np.intp]:
        """Indices of all coordinates on which the residual depends."""
        return np.array([*self.places, *self.slopes, *self.commons], np.intp)

    @property
    def slopes(self) -> list[int]:
        """Indices of the slopes of rate laws."""
        return [int(self.places[at]) + 1 for at in self.rates]

    def _at(self, point: Array) -> tuple[Array, Array]:
        """Return the point of the test's box, and its derivative by `all_places`."""
        own = point[self.places]
        through = np.eye(own.size, self.all_places.size)
        for j, (at, law) in enumerate(self.rates.items(), own.size):
            own[at], through[at, at], through[at, j] = law(own[at], point[self.places[at] + 1])
        return own, through

    def values(self, point: Array) -> Array:
        """Return the parameters of the test, SI."""
        return self.space.decode(self._at(point)[0])

    def residual_at(self, point: Array) -> Array:
        """Return the residual of the test, then of the pulls; infinite if the simulation fails."""
        values, failures = self.values(point), self.objective.spent.failures
        found = self.objective.residual(values)
        if self.objective.spent.failures > failures:
            found = np.full(found.size, np.inf)
        off = self.weights * (_logarithm(values[self.pulled]) - point[self.commons])
        return np.append(found, off)

    def jacobian_at(self, point: Array) -> Array:
        """Return the derivative of `residual_at` by the coordinates in `all_places`, (n, c)."""
        own, through = self._at(point)
        values = self.space.decode(own)
        moves = self.space.slopes(own, values) @ through
        seen = np.abs(pulled := values[self.pulled]) > _TINY
        rows = moves[self.pulled] / np.where(seen, pulled, 1.0)[:, None]
        rows[:, own.size + len(self.rates) :] -= np.eye(pulled.size)
        rows *= np.where(seen, self.weights, 0.0)[:, None]
        return np.vstack([self.objective.jacobian_along(values, moves), rows])


@dataclass(frozen=True, eq=False)
class Together:
    """Several tests with linked parameters, at the best point found.

    `shared` are the parameters determined by common values, `own` those with one value per test
    (scattering ones included). `values` (n_values,) are all parameters of each test, SI, and
    `costs` the sum of squares of each test, in units of its noise.
    """

    problems: tuple[Problem, ...]
    links: Links
    shared: tuple[str, ...]
    own: tuple[str, ...]
    values: tuple[Array, ...]
    costs: tuple[float, ...]
    # Common values, SI: the value of a shared parameter, value and slope of a rate law, and the
    # common value of a scattering parameter (the mean logarithm).
    common: Mapping[str, tuple[float, ...]]

    @classmethod
    def of_own_fits(cls, problems: Sequence[Problem], values: Sequence[Array]) -> Together:
        """Return tests without links, at the results of their separate fits."""
        pairs = zip(problems, values, strict=True)
        costs = tuple(float(np.sum(p.objective.residual(own) ** 2)) for p, own in pairs)
        own = _varying(problems)
        return cls(tuple(problems), Links({}), (), own, tuple(values), costs, {})

    def starts(self, most: int) -> list[list[Array]]:
        """Return start values for other links: these values, and those of one test for all.

        `most` is the largest number of tests whose values are tried for all.
        """
        count = len(self.values)
        chosen = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
        one_for_all = ([p.with_springs(self.values[t], v) for p, v in self.pairs] for t in chosen)
        return [list(self.values), *one_for_all]

    @property
    def pairs(self) -> list[tuple[Problem, Array]]:
        """Each test with its parameters."""
        return list(zip(self.problems, self.values, strict=True))

    @cached_property
    def n_eff(self) -> int:
        """Effective number of samples; see `effective_samples`."""
        return sum(map(effective_samples, self.problems, self.values))

    def bic(self, n_eff: int) -> float:
        """Return the Bayesian information criterion n_eff ln(χ²/n) + k ln(n_eff)."""
        n, n_eff = self.n_data, max(n_eff, 2)
        return n_eff * math.log(max(self.cost, 1e-12 * n) / n) + self.n_vary * math.log(n_eff)

    @property
    def cost(self) -> float:
        """Sum of squares over all tests."""
        return float(sum(self.costs))

    @property
    def n_vary(self) -> int:
        """Number of varied parameters: common ones, and own ones of each test."""
        shared = sum(2 if self.links.kind(name) in RATES else 1 for name in self.shared)
        return shared + sum(name in p.free() for name in self.own for p in self.problems)

    @property
    def n_data(self) -> int:
        """Number of samples of all tests."""
        return sum(problem.objective.n_data for problem in self.problems)

    @cached_property
    def misfits(self) -> tuple[dict[str, float | None], ...]:
        """Misfit of each curve of each test, RMS over the measured range."""
        pairs = [(problem.objective, values) for problem, values in self.pairs]
        return tuple(one.misfit(one.simulate(values, everything=True)) for one, values in pairs)

    def value(self, name: str) -> list[float]:
        """Return the values of one parameter in the tests that have it."""
        return [float(values[p.index[name]]) for p, values in self.pairs if name in p.index]


def fit_linked(
    problems: Sequence[Problem],
    links: Links,
    starts: Sequence[Sequence[Array]],
    *,
    iterations: int = ITERATIONS,
) -> Together:
    """Fit several tests of one model together, with linked parameters.

    Drives, noise and nuisance parameters may differ between tests; a fixed parameter keeps its
    value in each test. Each of the `starts` has one vector of parameters per test. Shared
    parameters start at the median over the tests, rate laws at a least-squares fit. The best end is
    returned. Raises InputError if the problems have different models, and SimulationError if no
    start can be simulated.
    """
    layout = Layout.of(tuple(problems), links)
    given, box = (layout.residual, layout.jacobian), layout.box
    points = [p for p in map(layout.start, starts) if np.isfinite(layout.residual(p)).all()]
    ends = [levenberg.descend(*given, p, box, iterations, enough=ENOUGH) for p in points]
    if not ends:
        raise SimulationError(
            f"{problems[0].measurement.name}: no start of the fit of {len(problems)} tests can be "
            "simulated; give values that each test can be simulated with"
        )
    return layout.fitted(min(ends, key=lambda end: end.cost).point)


def effective_samples(problem: Problem, values: Array) -> int:
    """Return the number of runs of equal sign in the residuals of a test's own fit.

    The residuals are mostly an error of the law. A run of equal sign counts as one sample, however
    many samples it has. Runs are counted over `BLOCKS` block means of each curve.
    """
    objective, count = problem.objective, 0
    for part in objective.by_curve(objective.residual(values)).values():
        blocks = np.array_split(part, min(BLOCKS, part.size))
        signs = np.sign([float(np.mean(block)) for block in blocks])
        count += 1 + int(np.count_nonzero(np.diff(signs)))
    return count


def _varying(problems: Sequence[Problem]) -> tuple[str, ...]:
    """Return the parameters that vary in any test; InputError if the models differ."""
    first = problems[0]
    for problem in problems[1:]:
        if problem.model.names != first.model.names:
            raise InputError(
                f"{problem.measurement.name} has other parameters than {first.measurement.name}; "
                "tests that are fitted together need one model"
            )
    free = {name for problem in problems for name in problem.free()}
    return tuple(name for name in (*first.model.names, *NUISANCE) if name in free)


def _spaces(problems: Sequence[Problem], absolute: tuple[str, ...]) -> list[Space]:
    """Return the boxes of the tests, with common scales and limits."""
    every, spaces = [problem.scales for problem in problems], [one.space() for one in problems]
    scales = Scales(
        max(one.stress for one in every),
        max(one.strain for one in every),
        float(np.median([one.rate for one in every])),
        max(one.height for one in every),
        min(one.least_time for one in every),
    )
    count = len(problems[0].model.names)  # limits of nuisance parameters differ
    low = np.min([space.low[:count] for space in spaces], axis=0)
    high = np.max([space.high[:count] for space in spaces], axis=0)
    for i, one in enumerate(spaces):
        ends = np.append(low, one.low[count:]), np.append(high, one.high[count:])
        spaces[i] = replace(one, scales=scales, absolute=absolute, low=ends[0], high=ends[1])
    return spaces


@dataclass(frozen=True, eq=False)
class Layout:
    """The sum of squares of linked tests as a function of the coordinates (k,) of a box."""

    problems: tuple[Problem, ...]
    links: Links
    own: tuple[str, ...]
    common_places: Mapping[str, int]  # Index of each common coordinate
    terms: tuple[Term, ...]
    box: tuple[Array, Array]

    @classmethod
    def of(cls, problems: tuple[Problem, ...], links: Links) -> Layout:
        """Assign indices to the coordinates: common ones first, then own ones test by test."""
        names = _varying(problems)
        kinds = {name: links.kind(name) for name in names}
        own = tuple(name for name in names if kinds[name] in ("own", "scatter"))
        shared = {name for name in names if kinds[name] == "shared"}
        rated = {name for name in names if kinds[name] in RATES}
        absolute = []
        for name in names:  # its coordinate may depend on parameters that are not shared
            of = () if name in NUISANCE else problems[0].model.param(name).of
            parents = {f"{name.partition('_')[0]}_{short}" for short in of} & set(names)
            if name not in own and (parents - shared or (parents and name in rated)):
                absolute.append(name)
        places, count = dict[str, int](), 0
        for name in names:
            if kinds[name] != "own":
                places[name] = count
                count += 2 if name in rated else 1
        terms = list[Term]()
        pairs = zip(problems, _spaces(problems, tuple(absolute)), strict=True)
        for t, (problem, space) in enumerate(pairs):
            at, rates = list[int](), dict[int, partial[tuple[float, float, float]]]()
            coordinates = {problem.names[one.place]: one for one in space.coordinates}
            for j, (name, one) in enumerate(coordinates.items()):
                at.append(count if name in own else places[name])
                count += name in own
                if name in rated:
                    rates[j] = partial(_by_rate, kinds[name], links.x(t), one.is_logarithmic)
            free = places.keys() & problem.free()
            pulls = {n: pull[t] for n, pull in links.pulls.items() if n in free and pull[t]}
            pulled = np.array([problem.index[name] for name in pulls], np.intp)
            commons = np.array([places[name] for name in pulls], np.intp)
            given = problem.objective, space, tuple(coordinates), np.array(at, np.intp)
            terms.append(Term(*given, rates, pulled, commons, np.array([*pulls.values()])))
        box = np.full(count, -_FAR), np.full(count, _FAR)
        for term in terms:
            for side, ends, steepest in zip(
                box, term.space.box, (-STEEPEST, STEEPEST), strict=True
            ):
                side[term.places], side[term.slopes] = ends, steepest
        return cls(problems, links, own, places, tuple(terms), box)

    @property
    def shared(self) -> tuple[str, ...]:
        """Names of the parameters determined by common values."""
        return tuple(name for name in self.common_places if name not in self.own)

    def fitted(self, point: Array) -> Together:
        """Return the tests at a point."""
        values, costs = tuple(term.values(point) for term in self.terms), list[float]()
        for term in self.terms:
            own = term.residual_at(point)
            costs.append(float(np.sum(own[: own.size - term.pulled.size] ** 2)))
        shared, common = self.shared, self.common(point, values)
        return Together(self.problems, self.links, shared, self.own, values, tuple(costs), common)

    def residual(self, point: Array) -> Array:
        """Return the stacked residuals of the tests; infinite for a failed simulation."""
        return np.concatenate([term.residual_at(point) for term in self.terms])

    def jacobian(self, point: Array) -> sparse.csr_array:
        """Return the derivative of the residual by the coordinates."""
        found = [(term.jacobian_at(point), term.all_places) for term in self.terms]
        places = np.concatenate([np.tile(places, len(slopes)) for slopes, places in found])
        lengths = np.concatenate([np.full(len(slopes), places.size) for slopes, places in found])
        content = np.concatenate([slopes.ravel() for slopes, _ in found])
        ends = np.append(0, np.cumsum(lengths))
        return sparse.csr_array((content, places, ends), shape=(lengths.size, point.size))

    def start(self, vectors: Sequence[Array]) -> Array:
        """Return the point with these own parameters and the nearest common values."""
        point, links = np.zeros(self.box[0].size), self.links
        found = [term.space.encode(own) for term, own in zip(self.terms, vectors, strict=True)]
        for term, own in zip(self.terms, found, strict=True):
            point[term.places] = own
        for name, place in self.common_places.items():
            free = [t for t, problem in enumerate(self.problems) if name in problem.free()]
            if name in self.own:
                values = [vectors[t][self.problems[t].index[name]] for t in free]
                point[place] = np.median(_logarithm(np.array(values)))
                continue
            columns = {t: self.terms[t].names.index(name) for t in free}
            own = np.array([found[t][j] for t, j in columns.items()])
            if (kind := links.kind(name)) not in RATES:
                point[place] = np.median(own)
                continue
            logarithmic = self.terms[free[0]].space.coordinates[columns[free[0]]].is_logarithmic
            x = np.array([links.x(t) for t in free])
            v, b = start_of(kind, np.exp(own) if logarithmic else own, x)
            point[place : place + 2] = np.log(v) if logarithmic else v, b
        return np.clip(point, *self.box)

    def common(self, point: Array, values: Sequence[Array]) -> dict[str, tuple[float, ...]]:
        """Return the common values at a point, SI; see `Together.common`."""
        out = dict[str, tuple[float, ...]]()
        for name, place in self.common_places.items():
            t = next(t for t, problem in enumerate(self.problems) if name in problem.free())
            value, kind = float(values[t][self.problems[t].index[name]]), self.links.kind(name)
            if kind in RATES:
                b = float(point[place + 1])
                out[name] = value / factor(kind, b, self.links.x(t))[0], b
            else:
                out[name] = (float(np.exp(point[place])) if name in self.own else value,)
        return out


def _logarithm(values: Array) -> Array:
    """Return the logarithms of the absolute values of parameters."""
    return np.log(np.maximum(np.abs(values), _TINY))
