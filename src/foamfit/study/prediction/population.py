"""Parameters of a test that was not fitted: uncertain as a covariance, or drawn where they scatter.

Those that change from specimen to specimen scatter or are own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import Specimen
from foamfit.errors import InputError
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.links import RATES, factor
from foamfit.springs.parameters import split_name
from foamfit.study.prediction.identified import NORMAL, Identified, Pair, Source
from foamfit.trust.scatter import correlation

# Own parameters change with the rate if that lowers BIC by so much, over so many tests or more, of
# which the logarithms of the rate spread by more than this.
EVIDENCE, FEWEST_OF_TREND, SAME_RATE = 2.0, 5, 0.05


@dataclass(frozen=True, eq=False)
class Population:
    """The parameters of one test, in the order of `names` (SI), as a result predicts them.

    `rate` (1/s) is that of the test, None where it is not known; `limits` are those of a fit of it.
    """

    source: Source
    names: tuple[str, ...]
    specimen: Specimen
    rate: float | None
    limits: Mapping[str, Pair] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse a law of rate where there is no rate."""
        laws = [name for name, one in self._known.items() if one.kind in RATES]
        if laws and (self.rate is None or self.source.rate0 is None):
            raise InputError(
                f"{laws[0]} follows a law of rate, and the rate "
                f"{'of the test' if self.rate is None else 'rate0 of the result'} is not known; "
                "give a time and a displacement column, or rate0 in joint.json"
            )

    @cached_property
    def _known(self) -> dict[str, Identified]:
        return {name: self.source.parameters[name] for name in self.names}

    @cached_property
    def _uncertain(self) -> list[str]:
        """Parameters that vary and have a common value."""
        return [name for name, one in self._known.items() if one.kind not in ("own", "fixed")]

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Parameters that vary, that nothing is known of, and that stay at their values."""
        pairs = ((name, self._known[name]) for name in self._uncertain)
        return tuple(name for name, one in pairs if one.error is None and one.span is None)

    @cached_property
    def _open(self) -> tuple[tuple[str, ...], Array]:
        """Uncertain quantities, within their limits, and their covariance given what is held."""
        free = [name for name in self._uncertain if name not in self.held]
        free += [f"{name}:b" for name, one in self._known.items() if one.b_stderr]
        there, places = _places(free, self.source.names)
        gone = _places(self.held, self.source.names)[1]
        r, matrix = self.source.correlation, np.eye(len(free))
        inner, across = r[np.ix_(places, places)], r[np.ix_(places, gone)]
        if gone.size:
            told = np.linalg.pinv(r[np.ix_(gone, gone)], hermitian=True)
            inner = inner - across @ told @ across.T
        matrix[np.ix_(there, there)] = inner
        mine, places = _places(free, self.scattering)  # means of what scatters
        matrix[np.ix_(mine, mine)] = self._correlation[np.ix_(places, places)]
        errors = np.array([self._error(name) for name in free])
        matrix = matrix * np.outer(errors, errors)
        limited = [(i, name) for i, name in enumerate(free) if name in self.limits]
        flat = {i: self._flat(name, self.limits[name]) for i, name in limited}
        bound = [i for i, spread in flat.items() if math.isfinite(spread)]
        prior, spread = [flat[i] ** 2 for i in bound], matrix[bound]
        told = np.linalg.lstsq(spread[:, bound] + np.diag(prior), spread, rcond=None)[0]
        return tuple(free), matrix - spread.T @ told

    def _error(self, name: str) -> float:
        """Standard error of an uncertain quantity, SI; by its range where it has none."""
        one = self._known[name.removesuffix(":b")]
        slope = name.endswith(":b")
        error, ends = (one.b_stderr, one.b_ci95) if slope else (one.error, one.ci95)
        if error is None:
            assert one.span is not None
            return self._flat(name, one.span)
        if ends is None or not self.source.joint:
            return error
        # Errors of few tests are larger by what their intervals are.
        return max(error, 0.5 * (ends[1] - ends[0]) / NORMAL)

    def _flat(self, name: str, span: Pair) -> float:
        """Standard deviation of a flat distribution, of the logarithm where that is positive."""
        (low, high), one = span, self._known[name]
        if low > 0.0 and (is_logarithmic(split_name(name)[1]) or one.kind in ("scatter", *RATES)):
            return abs(one.value) * math.log(high / low) / math.sqrt(12.0)
        return (high - low) / math.sqrt(12.0)

    @cached_property
    def covariance(self) -> Array:
        """What the result leaves uncertain of the parameters, SI, (p, p), to first order."""
        free, matrix = self._open
        slopes = np.zeros((len(self.names), len(free)))
        for column, name in zip(slopes.T, free, strict=True):
            one = self._known[name.removesuffix(":b")]
            at, step = one.b if name.endswith(":b") else one.value, 1e-4 * self._error(name)
            sides = [self._vector(self._means | {name: at + way * step}) for way in (-1.0, 1.0)]
            column[:] = (sides[1] - sides[0]) / (2.0 * step)
        return slopes @ matrix @ slopes.T

    @cached_property
    def quantile(self) -> float:
        """Half of a 95 % interval over a standard error: the median over the intervals.

        Few degrees of freedom widen it; a limit or a curved valley, which changes one interval,
        does not, as along a valley the others follow.
        """
        ratios = [
            0.5 * (one.ci95[1] - one.ci95[0]) / one.stderr
            for one in map(self._known.__getitem__, self._uncertain)
            if one.ci95 is not None and one.stderr is not None and not self.source.joint
        ]
        return max(NORMAL, float(np.median(ratios))) if ratios else NORMAL

    @cached_property
    def scattering(self) -> tuple[str, ...]:
        """Parameters that change from specimen to specimen."""
        return tuple(
            name
            for name, one in self._known.items()
            if (one.kind == "scatter" and one.scatter > 0.0)
            or (one.kind == "own" and np.ptp(one.tests) > 0.0)
        )

    @cached_property
    def _correlation(self) -> Array:
        """Correlation of the scattering parameters from specimen to specimen."""
        names, own = self.scattering, self._own
        out = np.eye(len(names))
        there, places = _places(names, self.source.changing)
        out[np.ix_(there, there)] = self.source.together[np.ix_(places, places)]
        # Of own parameters with a trend, or of which the result says nothing: of their deviations.
        if own.slopes.any() or not set(own.names) <= set(self.source.changing):
            there, places = _places(names, own.names)
            alone = correlation(own.off, np.zeros((places.size, places.size)))
            out[np.ix_(there, there)] = alone[np.ix_(places, places)]
        return out

    @property
    def fewest(self) -> int:
        """Tests from which what changes from specimen to specimen is known."""
        return min(len(self._known[name].tests) for name in self.scattering)

    @cached_property
    def _own(self) -> _Own:
        """Own parameters of the tests, in logarithms where `_in_logarithms`."""
        names = tuple(name for name in self.scattering if self._known[name].kind == "own")
        if not names:
            return _Own((), np.empty(0), np.empty(0), np.empty((0, 0)), np.empty(0))
        if len({len(self._known[name].tests) for name in names}) > 1:
            raise InputError(
                f"{self.source.where}: own parameters must have a value for each test, all of them "
                "for the same tests"
            )
        values = np.array([self._known[name].tests for name in names]).T
        logs = [self._in_logarithms(name) for name in names]
        values[:, logs] = np.log(values[:, logs])
        n, k = values.shape
        mean, off = values.mean(axis=0), values - values.mean(axis=0)
        slopes, leverage = np.zeros(k), np.full(k, 1.0 / n)
        known = [one for one in self._known[names[0]].rates if one]
        if self.rate is not None and len(known) == n >= FEWEST_OF_TREND:
            x = np.log(known)
            at, x = math.log(self.rate) - x.mean(), x - x.mean()
            square = float(x @ x)
            steep = x @ off / max(square, 1e-300)
            left = off - np.outer(x, steep)
            squares = np.maximum([np.sum(off**2, axis=0), np.sum(left**2, axis=0)], 1e-300)
            gain = n * np.log(squares[0] / squares[1]) - math.log(n)
            sure = (gain > EVIDENCE) & (square > n * SAME_RATE**2)
            slopes = np.where(sure, steep, 0.0)
            mean, off = mean + slopes * at, np.where(sure, left, off)
            leverage = leverage + np.where(sure, at**2 / max(square, 1e-300), 0.0)
        freedom = max(n - 1 - bool(np.any(slopes)), 1)
        spread = np.sqrt((1.0 + leverage) * np.sum(off**2, axis=0) / freedom)
        return _Own(names, mean, slopes, off, spread)

    @property
    def trends(self) -> list[str]:
        """Own parameters that change with the rate."""
        pairs = zip(self._own.names, self._own.slopes, strict=True)
        return [name for name, slope in pairs if slope]

    def _in_logarithms(self, name: str) -> bool:
        return is_logarithmic(split_name(name)[1]) and min(self._known[name].tests) > 0.0

    def _own_values(self, of: Array) -> dict[str, float]:
        """Own parameters of their logarithms, where these vary, or themselves."""
        pairs = zip(self._own.names, of.tolist(), strict=True)
        return {name: _exp(u) if self._in_logarithms(name) else u for name, u in pairs}

    @property
    def _means(self) -> dict[str, float]:
        """Own parameters that have a trend: the median over the tests is that of no rate."""
        means = self._own_values(self._own.mean)
        return {name: means[name] for name in self.trends}

    @property
    def point(self) -> Array:
        """The common values, at the rate of the test."""
        return self._vector(self._means)

    def candidates(self) -> Iterator[Array]:
        """The common values, then those with the own parameters of a test, the nearest first."""
        yield self.point
        own = self._own
        scale = np.maximum(np.sqrt(np.sum(own.off**2, axis=0)), 1e-300)
        for row in own.off[np.argsort(np.sum((own.off / scale) ** 2, axis=1))]:
            yield self._vector(self._own_values(own.mean + row))

    def draws(self, seed: int) -> Iterator[Array]:
        """Draw specimens: their scatter, and what the result leaves uncertain.

        Parameters change together from specimen to specimen. Their spreads are known from n tests:
        the deviates are Student's t with n - 1 degrees of freedom.
        """
        rng, other = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        changed, uncertain = _root(self._correlation), _root(self.covariance)
        own, freedom = self._own, max(self.fewest - 1 - bool(self._own.slopes.any()), 1)
        while True:
            tail = math.sqrt(freedom / rng.chisquare(freedom))
            drawn = tail * (changed @ rng.standard_normal(len(self.scattering)))
            of = dict(zip(self.scattering, drawn.tolist(), strict=True))
            values = self._own_values(own.mean + own.spread * [of[name] for name in own.names])
            for name in of.keys() - values.keys():
                one = self._known[name]
                values[name] = one.value * _exp(one.scatter * of[name])
            yield self._vector(values) + uncertain @ other.standard_normal(len(self.names))

    def _vector(self, given: Mapping[str, float]) -> Array:
        """Values in their order, at the rate and the height of the test.

        `given` are those that are not the common ones, and slopes by rate. The heights of a chain
        are those of the specimen, or keep their shares of its height.
        """
        values = dict[str, float]()
        for name, one in self._known.items():
            value = given.get(name, one.value)
            if one.kind in RATES and self.rate is not None and self.source.rate0:
                x = math.log(self.rate / self.source.rate0)
                value *= factor(one.kind, given.get(f"{name}:b", one.b), x)[0]
            values[name] = value
        heights = [name for name in self.names if name.endswith("_height")]
        if heights and self.specimen.heights is not None:
            values |= dict(zip(heights, self.specimen.heights, strict=True))
        elif heights:
            total = sum(self._known[name].value for name in heights)
            if self._known[heights[-1]].kind == "fixed":  # what the others leave
                values[heights[-1]] = total - sum(values[name] for name in heights[:-1])
            whole = sum(values[name] for name in heights)
            values |= {name: values[name] * self.specimen.height / whole for name in heights}
        return np.array([values[name] for name in self.names])


class _Own(NamedTuple):
    """Own parameters of n tests, as a sample of what specimens have.

    Where there is evidence that one changes with the rate, its mean is on the line through its
    values against the logarithm of the rate.
    """

    names: tuple[str, ...]
    mean: Array  # (k,): at the rate of the test that is predicted
    slopes: Array  # (k,): by the logarithm of the rate; 0 where there is no evidence
    off: Array  # (n, k): what the tests are off their means
    spread: Array  # (k,): standard deviation of a specimen about the mean, known from n tests


def _places(
    names: tuple[str, ...] | list[str], among: tuple[str, ...]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Which of the names stand among others, and where there."""
    pairs = [(i, among.index(name)) for i, name in enumerate(names) if name in among]
    there, places = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return there, places


def _root(correlation: Array) -> Array:
    """Matrix square root of a correlation or covariance, its negative eigenvalues set to zero."""
    power, axes = np.linalg.eigh(correlation)
    return np.asarray(axes * np.sqrt(np.maximum(power, 0.0)))


def _exp(value: float) -> float:
    """Exponential that stays finite; a parameter that far off is admissible nowhere."""
    return math.exp(min(max(value, -700.0), 700.0))
