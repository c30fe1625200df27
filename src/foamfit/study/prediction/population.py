"""Draws of the parameters of a test that was not fitted, from what a result says of them.

Two things are drawn: what the result leaves uncertain (its standard errors and their correlation),
and what changes from specimen to specimen (parameters that scatter or are own).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from foamfit.arrays import Array
from foamfit.data.measurement import Specimen
from foamfit.errors import InputError
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.links import RATES, factor
from foamfit.springs.parameters import split_name
from foamfit.study.prediction.identified import Identified, Pair, Source
from foamfit.trust.scatter import correlation

# Own parameters change with the rate if that lowers BIC by so much, over so many tests or more, of
# which the logarithms of the rate spread by more than this.
EVIDENCE, FEWEST_OF_TREND, SAME_RATE = 2.0, 5, 0.05
NORMAL = 1.959964  # half of the 95 % interval of a normal distribution over its standard deviation


@dataclass(frozen=True, eq=False)
class Population:
    """The parameters of one test, in the order of `names` (SI), as a result predicts them.

    `rate` (1/s) is that of the test, None where it is not known.
    """

    source: Source
    names: tuple[str, ...]
    specimen: Specimen
    rate: float | None

    def __post_init__(self) -> None:
        """Refuse a law of rate where there is no rate."""
        laws = [name for name, one in self._items if one.kind in RATES]
        if laws and (self.rate is None or self.source.rate0 is None):
            raise InputError(
                f"{laws[0]} follows a law of rate, and the rate "
                f"{'of the test' if self.rate is None else 'rate0 of the result'} is not known; "
                "give a time and a displacement column, or rate0 in joint.json"
            )

    @property
    def _items(self) -> list[tuple[str, Identified]]:
        return [(name, self.source.parameters[name]) for name in self.names]

    @cached_property
    def _log_rate(self) -> float:
        """Logarithm of the rate over the reference rate; 0 where no law needs it."""
        if self.rate is None or not self.source.rate0:
            return 0.0
        return math.log(self.rate / self.source.rate0)

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Parameters that vary, that nothing is known of, and that stay at their values."""
        return tuple(
            name
            for name, one in self._items
            if one.kind not in ("own", "fixed") and one.stderr is None and one.span is None
        )

    # ------------------------------------------------------------------ what the result leaves open

    @cached_property
    def _open(self) -> tuple[tuple[str, ...], Array]:
        """Uncertain quantities, and the root of their correlation given those that are held.

        What a result leaves undetermined is correlated with other parameters: where it stays at its
        value, these have the spread that is left to them then.
        """
        named = [name for name, one in self._items if one.kind not in ("own", "fixed")]
        sloped = [f"{name}:b" for name, one in self._items if one.b_stderr]
        free = [name for name in named if name not in self.held] + sloped
        known = {name: i for i, name in enumerate(self.source.names)}
        matrix = np.eye(len(free))
        there = [i for i, name in enumerate(free) if name in known]
        places = [known[free[i]] for i in there]
        r = self.source.correlation
        inner = r[np.ix_(places, places)]
        if gone := [known[name] for name in self.held if name in known]:
            across = r[np.ix_(places, gone)]
            inner = (
                inner - across @ np.linalg.pinv(r[np.ix_(gone, gone)], hermitian=True) @ across.T
            )
        if there:
            matrix[np.ix_(there, there)] = inner
        changing = {name: i for i, name in enumerate(self.scattering)}
        mine = [i for i, name in enumerate(free) if name in changing]  # means of what scatters
        if mine:
            places = [changing[free[i]] for i in mine]
            matrix[np.ix_(mine, mine)] = self._correlation[np.ix_(places, places)]
        return tuple(free), _root(matrix)

    @property
    def uncertain(self) -> bool:
        """Whether the result leaves anything uncertain."""
        return bool(self._open[0])

    def _placed(self, name: str, z: float) -> float:
        """Value of an uncertain quantity at a standard normal z."""
        if name.endswith(":b"):
            one = self.source.parameters[name.removesuffix(":b")]
            assert one.b_stderr is not None
            return one.b + z * one.b_stderr * _wider(one.b_ci95, one.b_stderr)
        one, short = self.source.parameters[name], split_name(name)[1]
        positive = is_logarithmic(short) or one.kind in ("scatter", *RATES)
        if one.stderr is None:
            assert one.span is not None
            low, high = one.span
            if positive and low > 0.0:
                return low * math.exp(math.log(high / low) * float(ndtr(z)))
            return low + (high - low) * float(ndtr(z))
        stderr = one.stderr * _wider(one.ci95, one.stderr)
        if positive and one.value > 0.0:  # log-normal of the same coefficient of variation
            return one.value * math.exp(z * math.sqrt(math.log1p((stderr / one.value) ** 2)))
        return one.value + z * stderr

    # ------------------------------------------------------------------ from specimen to specimen

    @cached_property
    def scattering(self) -> tuple[str, ...]:
        """Parameters that change from specimen to specimen."""
        return tuple(
            name
            for name, one in self._items
            if (one.kind == "scatter" and one.scatter > 0.0)
            or (one.kind == "own" and np.ptp(one.tests) > 0.0)
        )

    @cached_property
    def _correlation(self) -> Array:
        """Correlation of the scattering parameters from specimen to specimen.

        That of the result; of own parameters that change with the rate, or of which it says
        nothing, that of their deviations.
        """
        names, own = self.scattering, self._own
        out = np.eye(len(names))
        known = {name: i for i, name in enumerate(self.source.changing)}
        there = [i for i, name in enumerate(names) if name in known]
        places = [known[names[i]] for i in there]
        out[np.ix_(there, there)] = self.source.together[np.ix_(places, places)]
        if own.slopes.any() or not set(own.names) <= known.keys():
            places = [names.index(name) for name in own.names]
            none = np.zeros((len(places), len(places)))
            out[np.ix_(places, places)] = correlation(own.off, none)
        return out

    @property
    def fewest(self) -> int:
        """Tests from which what changes from specimen to specimen is known."""
        return min(len(self.source.parameters[name].tests) for name in self.scattering)

    @cached_property
    def _changed(self) -> Array:
        """Root of the correlation of the scattering parameters."""
        return _root(self._correlation)

    @cached_property
    def _own(self) -> _Own:
        """Own parameters of the tests, in logarithms where `_in_logarithms`."""
        names = [name for name in self.scattering if self.source.parameters[name].kind == "own"]
        columns = []
        for name in names:
            tests = np.array(self.source.parameters[name].tests)
            columns.append(np.log(tests) if self._in_logarithms(name) else tests)
        if len({column.size for column in columns}) > 1:
            raise InputError(
                f"{self.source.where}: own parameters must have a value for each test, all of them "
                "for the same tests"
            )
        rates = self.source.parameters[names[0]].rates if names else ()
        return _Own.of(tuple(names), columns, rates, self.rate)

    @property
    def trends(self) -> dict[str, float]:
        """Own parameters that change with the rate, and by how much per unit of its logarithm.

        Of the logarithm of the parameter where `is_logarithmic`.
        """
        return dict(zip(self._own.names, self._own.slopes.tolist(), strict=True))

    def _in_logarithms(self, name: str) -> bool:
        tests = self.source.parameters[name].tests
        return is_logarithmic(split_name(name)[1]) and min(tests) > 0.0

    # ------------------------------------------------------------------ values of one test

    @property
    def point(self) -> Array:
        """The common values, at the rate of the test."""
        found = {name: self._at_rate(name, one.value, one.b) for name, one in self._items}
        for name, mean, slope in zip(
            self._own.names, self._own.mean, self._own.slopes, strict=True
        ):
            if slope:  # the median over the tests is that of no rate
                found[name] = self._from_own(name, mean)
        return self._vector(found)

    def _from_own(self, name: str, value: float) -> float:
        return _exp(value) if self._in_logarithms(name) else float(value)

    def nearest(self, admissible: Callable[[Array], bool]) -> Array | None:
        """Values with the own parameters of the admissible test nearest to their means."""
        own = self._own
        if not own.names:
            return None
        scale = np.maximum(np.sqrt(np.mean(own.off**2, axis=0)), 1e-300)
        for row in own.off[np.argsort(np.sum((own.off / scale) ** 2, axis=1))]:
            values = {name: self._at_rate(name, one.value, one.b) for name, one in self._items}
            for name, value in zip(own.names, own.mean + row, strict=True):
                values[name] = self._from_own(name, value)
            if admissible(found := self._vector(values)):
                return found
        return None

    def draw(self, rng: np.random.Generator, *, open_: bool, scatter: bool) -> Array:
        """Draw what the result leaves open, the scatter between specimens, or both.

        Parameters change together from specimen to specimen. Their spreads are known from n tests:
        the deviates are Student's t with n - 1 degrees of freedom.
        """
        values = {name: one.value for name, one in self._items}
        slopes = {name: one.b for name, one in self._items}
        if open_:
            free, root = self._open
            for name, z in zip(free, root @ rng.standard_normal(len(free)), strict=True):
                if name.endswith(":b"):
                    slopes[name.removesuffix(":b")] = self._placed(name, float(z))
                else:
                    values[name] = self._placed(name, float(z))
        if scatter:
            freedom = max(self.fewest - 1 - bool(self._own.slopes.any()), 1)
            tail = math.sqrt(freedom / rng.chisquare(freedom))
            drawn = tail * (self._changed @ rng.standard_normal(len(self.scattering)))
            for name, z in zip(self.scattering, drawn.tolist(), strict=True):
                one = self.source.parameters[name]
                if one.kind == "scatter":
                    values[name] *= _exp(one.scatter * z)
                else:
                    values[name] = self._from_own(name, self._own.at(name, z))
        return self._vector(
            {name: self._at_rate(name, value, slopes[name]) for name, value in values.items()}
        )

    def _at_rate(self, name: str, value: float, b: float) -> float:
        kind = self.source.parameters[name].kind
        return value * factor(kind, b, self._log_rate)[0] if kind in RATES else value

    def _vector(self, values: dict[str, float]) -> Array:
        """Flat vector, with the heights of a chain those of the test's specimen."""
        heights = [name for name in self.names if name.endswith("_height")]
        if heights and self.specimen.heights is not None:
            values |= dict(zip(heights, self.specimen.heights, strict=True))
        elif heights:
            common = self.source.parameters
            total = sum(common[name].value for name in heights)
            if common[heights[-1]].kind == "fixed":  # what the others leave
                values[heights[-1]] = total - sum(values[name] for name in heights[:-1])
            whole = sum(values[name] for name in heights)
            values |= {name: values[name] * self.specimen.height / whole for name in heights}
        return np.array([values[name] for name in self.names])


@dataclass(frozen=True, eq=False)
class _Own:
    """Own parameters of n tests, as a sample of what specimens have.

    Where there is evidence that one changes with the rate, its mean is on the line through its
    values against the logarithm of the rate.
    """

    names: tuple[str, ...]
    mean: Array  # (k,): at the rate of the test that is predicted
    slopes: Array  # (k,): by the logarithm of the rate; 0 where there is no evidence
    off: Array  # (n, k): what the tests are off their means
    wider: Array  # (k,): √(1 + leverage), for the mean is not known exactly
    freedom: int

    @classmethod
    def of(
        cls, names: tuple[str, ...], columns: list[Array], rates: tuple[float | None, ...],
        rate: float | None,
    ) -> _Own:  # fmt: skip
        """Means and deviations of the columns (n,), one for each name."""
        if not names:
            return cls((), np.empty(0), np.empty(0), np.empty((0, 0)), np.empty(0), 1)
        values = np.array(columns).T
        n, k = values.shape
        mean, off = values.mean(axis=0), values - values.mean(axis=0)
        slopes, leverage = np.zeros(k), np.full(k, 1.0 / n)
        known = [one for one in rates if one]
        if rate is not None and len(known) == n >= FEWEST_OF_TREND:
            x = np.log(known)
            at, x = math.log(rate) - x.mean(), x - x.mean()
            square = float(x @ x)
            if square > n * SAME_RATE**2:
                steep = x @ off / square
                left = off - np.outer(x, steep)
                gain = n * np.log(
                    np.maximum(np.sum(off**2, axis=0), 1e-300)
                    / np.maximum(np.sum(left**2, axis=0), 1e-300)
                ) - math.log(n)
                sure = gain > EVIDENCE
                slopes = np.where(sure, steep, 0.0)
                mean, off = mean + slopes * at, np.where(sure, left, off)
                leverage = leverage + sure * at**2 / square
        freedom = max(n - 1 - bool(np.any(slopes)), 1)
        return cls(names, mean, slopes, off, np.sqrt(1.0 + leverage), freedom)

    def at(self, name: str, z: float) -> float:
        """Value of a specimen that is z standard deviations off the mean."""
        i = self.names.index(name)
        spread = math.sqrt(float(np.sum(self.off[:, i] ** 2)) / self.freedom)
        return float(self.mean[i] + self.wider[i] * spread * z)


def _wider(ci95: Pair | None, stderr: float) -> float:
    """How much wider a 95 % interval is than that of a normal distribution with this error.

    Few degrees of freedom widen it, and a cost that is no parabola; a limit that cuts it does not
    make it narrower.
    """
    if ci95 is None:
        return 1.0
    return max(1.0, 0.5 * (ci95[1] - ci95[0]) / (NORMAL * stderr))


def _root(correlation: Array) -> Array:
    """Matrix square root of a correlation, its negative eigenvalues set to zero."""
    power, axes = np.linalg.eigh(correlation)
    return np.asarray(axes * np.sqrt(np.maximum(power, 0.0)))


def _exp(value: float) -> float:
    """Exponential that stays finite; a parameter that far off is admissible nowhere."""
    return math.exp(min(max(value, -700.0), 700.0))
