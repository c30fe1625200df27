"""The parameters that a result predicts for another test, and for specimens of the same foam.

The uncertainty of the parameters is a covariance; parameters that vary between specimens (kinds
"scatter" and "own") are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Specimen
from foamfit.errors import InputError
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.together import factor
from foamfit.options import RATES
from foamfit.parts import Pair, ParameterEstimate
from foamfit.springs.parameters import split_name
from foamfit.study.identified import NORMAL, Source


@dataclass(frozen=True, eq=False)
class Population:
    """The parameters that a result predicts for one test, in the order of the model, SI."""

    source: Source
    specimen: Specimen  # Of the test
    rate: float | None  # Of the test, 1/s; None if unknown
    # Limits of parameters in a fit of the test.
    limits: Mapping[str, Pair] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise InputError if there is a rate law but no rate."""
        laws = [name for name, one in self._parameters.items() if one.kind in RATES]
        if laws and (self.rate is None or self.source.rate0 is None):
            raise InputError(
                f"{laws[0]} follows a rate law, but the rate "
                f"{'of the test' if self.rate is None else 'rate0 of the result'} is not known; "
                "give a time and a displacement column, or rate0 in joint.json"
            )
        own = (one for name in self.scattering if (one := self._parameters[name]).kind == "own")
        if len({tuple(one.tests or ()) for one in own}) > 1:
            why = f"{self.source.where}: all own parameters must have values for the same tests"
            raise InputError(why)

    @property
    def _parameters(self) -> dict[str, ParameterEstimate]:
        return self.source.parameters

    def _span(self, name: str) -> Pair | None:
        """Return an interval of a parameter without a standard error."""
        return self._parameters[name].range or self._parameters[name].ci95

    def _tests(self, name: str) -> list[float]:
        """Return the values of an own or scattering parameter in the tests."""
        return [at.value for at in (self._parameters[name].tests or {}).values()]

    @cached_property
    def _uncertain(self) -> list[str]:
        """Names of free parameters with a common value."""
        return [name for name, one in self._parameters.items() if one.kind not in ("own", "fixed")]

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Free parameters of unknown uncertainty, which are fixed at their values."""
        known = self.source.errors
        return tuple(n for n in self._uncertain if n not in known and self._span(n) is None)

    @cached_property
    def _open(self) -> tuple[tuple[str, ...], Array]:
        """Names and covariance of free parameters and slopes, given `held` and the limits.

        Limits are treated as independent measurements with the variance of a flat distribution.
        """
        free = [name for name in self._uncertain if name not in self.held]
        free += [f"{name}:b" for name, one in self._parameters.items() if one.b_stderr]
        _, at, places = np.intersect1d(free, self.source.names, return_indices=True)
        held = np.intersect1d(self.held, self.source.names, return_indices=True)[2]
        r, matrix = self.source.correlation, np.eye(len(free))
        inner, across = r[np.ix_(places, places)], r[np.ix_(places, held)]
        if held.size:
            inverse = np.linalg.pinv(r[np.ix_(held, held)], hermitian=True)
            inner = inner - across @ inverse @ across.T
        matrix[np.ix_(at, at)] = inner
        errors = np.array([self._error(name) for name in free])
        matrix = matrix * np.outer(errors, errors)
        flat = [self._flat(n, self.limits[n]) if n in self.limits else math.inf for n in free]
        bound = [i for i, sigma in enumerate(flat) if math.isfinite(sigma)]
        prior, rows = [flat[i] ** 2 for i in bound], matrix[bound]
        gain = np.linalg.lstsq(rows[:, bound] + np.diag(prior), rows, rcond=None)[0]
        return tuple(free), matrix - rows.T @ gain

    def _error(self, name: str) -> float:
        """Return the standard error of a parameter or slope, SI; by its range if it has none."""
        one = self._parameters[name.removesuffix(":b")]
        error, ends = self.source.errors.get(name), one.ci95
        if name.endswith(":b"):
            error, ends = one.b_stderr, one.b_ci95
        if error is None:
            span = self._span(name)
            assert span is not None
            return self._flat(name, span)
        if ends is None or not self.source.joint:
            return error
        # With few tests, intervals are wider than the standard errors.
        return max(error, 0.5 * (ends[1] - ends[0]) / NORMAL)

    def _flat(self, name: str, span: Pair) -> float:
        """Return the standard deviation of a flat distribution, or of a log-flat one, SI."""
        (low, high), one = span, self._parameters[name]
        if low > 0.0 and (is_logarithmic(split_name(name)[1]) or one.kind in ("scatter", *RATES)):
            return abs(one.value) * math.log(high / low) / math.sqrt(12.0)
        return (high - low) / math.sqrt(12.0)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters due to the uncertainty of the result, linearised."""
        free, matrix = self._open
        slopes = np.zeros((len(self._parameters), len(free)))
        for column, name in zip(slopes.T, free, strict=True):
            one = self._parameters[name.removesuffix(":b")]
            at = (one.b or 0.0) if name.endswith(":b") else one.value
            step = 1e-4 * self._error(name)
            sides = [self._vector({name: at + sign * step}) for sign in (-1.0, 1.0)]
            column[:] = (sides[1] - sides[0]) / (2.0 * step)
        return slopes @ matrix @ slopes.T

    @cached_property
    def quantile(self) -> float:
        """Ratio of half a 95 % interval to the standard error: the median over the parameters.

        Few degrees of freedom increase it. A limit or a curved valley changes single intervals and
        hardly affects the median.
        """
        ratios = [
            0.5 * (one.ci95[1] - one.ci95[0]) / one.stderr
            for one in map(self._parameters.__getitem__, self._uncertain)
            if one.ci95 is not None and one.stderr and not self.source.joint
        ]
        return max(NORMAL, float(np.median(ratios))) if ratios else NORMAL

    @cached_property
    def scattering(self) -> tuple[str, ...]:
        """Parameters that vary between specimens."""
        return tuple(
            name
            for name, one in self._parameters.items()
            if (one.kind == "scatter" and one.scatter)
            or (one.kind == "own" and np.ptp(self._tests(name)) > 0.0)
        )

    @cached_property
    def _correlation(self) -> Array:
        """Correlation of the scattering parameters between specimens."""
        names = self.scattering
        out = np.eye(len(names))
        _, at, places = np.intersect1d(names, self.source.changing, return_indices=True)
        out[np.ix_(at, at)] = self.source.together[np.ix_(places, places)]
        return out

    @property
    def fewest(self) -> int:
        """Least number of tests that determine a scattering parameter; 0 if none scatters."""
        return min((len(self._tests(name)) for name in self.scattering), default=0)

    @cached_property
    def _varying(self) -> dict[str, tuple[float, float, bool]]:
        """Mean and standard deviation over specimens, as estimated; whether of the logarithm."""
        out = dict[str, tuple[float, float, bool]]()
        for name in self.scattering:
            one, values = self._parameters[name], np.array(self._tests(name))
            logs = is_logarithmic(split_name(name)[1]) and bool(np.min(values) > 0.0)
            if one.kind == "scatter":
                out[name] = math.log(abs(one.value)), one.scatter or 0.0, True
            else:
                each = np.log(values) if logs else values
                spread = math.sqrt((1.0 + 1.0 / each.size) * np.var(each, ddof=1))
                out[name] = float(each.mean()), spread, logs
        return out

    @property
    def point(self) -> Array:
        """The common values, at the rate of the test."""
        return self._vector({})

    def candidates(self) -> Iterator[Array]:
        """Yield the common values, then those with the own values of each test, nearest first."""
        yield self.point
        own = [name for name in self.scattering if self._parameters[name].kind == "own"]
        rows = np.array([self._tests(name) for name in own]).T
        if not own:
            return
        off = (rows - rows.mean(axis=0)) / rows.std(axis=0)
        for row in rows[np.argsort(np.sum(off**2, axis=1))]:
            yield self._vector(dict(zip(own, row.tolist(), strict=True)))

    def draws(self, seed: int) -> Iterator[Array]:
        """Draw parameters of specimens, from their scatter and the uncertainty of the result.

        The scatter is correlated between parameters. Because its size is estimated from n tests, it
        has Student's t distribution with n - 1 degrees of freedom.
        """
        rng, other = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        scatter, uncertain = _root(self._correlation), _root(self.covariance)
        freedom = max(self.fewest - 1, 1)
        while True:
            tail = math.sqrt(freedom / rng.chisquare(freedom))
            drawn = tail * (scatter @ rng.standard_normal(len(self.scattering)))
            values = dict[str, float]()
            for (name, (mean, spread, logs)), x in zip(self._varying.items(), drawn, strict=True):
                number = mean + spread * float(x)
                size = math.exp(min(max(number, -700.0), 700.0))  # finite; none may be that large
                values[name] = math.copysign(size, self._parameters[name].value) if logs else number
            yield self._vector(values) + uncertain @ other.standard_normal(len(self._parameters))

    def _vector(self, changes: Mapping[str, float]) -> Array:
        """Return all parameters at the rate and the height of the test.

        `changes` replace common values and, with ":b", slopes of rate laws. The heights of a chain
        are the specimen's, or else keep their shares of its height.
        """
        values = dict[str, float]()
        for name, one in self._parameters.items():
            value = changes.get(name, one.value)
            if one.kind in RATES and self.rate is not None and self.source.rate0:
                x = math.log(self.rate / self.source.rate0)
                value *= factor(one.kind, changes.get(f"{name}:b", one.b or 0.0), x)[0]
            values[name] = value
        heights = [name for name in self._parameters if name.endswith("_height")]
        if heights and self.specimen.heights is not None:
            values |= dict(zip(heights, self.specimen.heights, strict=True))
        elif heights:
            if self._parameters[heights[-1]].kind == "fixed":  # the rest of the height
                total = sum(self._parameters[name].value for name in heights)
                values[heights[-1]] = total - sum(values[name] for name in heights[:-1])
            total = sum(values[name] for name in heights)
            values |= {name: values[name] * self.specimen.height / total for name in heights}
        return np.array(list(values.values()))


def _root(correlation: Array) -> Array:
    """Return a matrix square root of a covariance; negative eigenvalues count as zero."""
    power, axes = np.linalg.eigh(correlation)
    return np.asarray(axes * np.sqrt(np.maximum(power, 0.0)))
