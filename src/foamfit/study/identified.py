"""The law and parameters of a result, and the parameters that it predicts for another test.

They are read from fit.json or joint.json. For a result in memory the content of its file is used,
so that both give the same numbers. The uncertainty of the parameters is a covariance; parameters
that vary between specimens (kinds "scatter" and "own") are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.codec import build
from foamfit.data.measurement import Specimen
from foamfit.errors import InputError
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.links import KINDS, RATES, factor
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.options import DRIVES
from foamfit.report.folder import load_result
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name
from foamfit.trust.scatter import correlation

NORMAL = 1.959964  # half the 95 % interval of a normal distribution, in standard deviations
Pair = tuple[float, float]


class HasContent(Protocol):
    """A result in memory."""

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of the result file."""


@dataclass(frozen=True)
class Identified:
    """One parameter of a result, SI.

    `kind` is one of `links.KINDS` or "fixed"; free parameters of a single test are "shared".
    `tests` are the values of an own or scattering parameter in the tests, and `rates` the rates of
    these tests (1/s). Raises ValueError if a number is missing or inadmissible.
    """

    kind: str
    value: float
    stderr: float | None = None
    local: float | None = None  # Standard error, also of a parameter that is not determined
    ci95: Pair | None = None
    range: Pair | None = None
    state: str | None = None
    b: float = 0.0
    b_stderr: float | None = None
    b_ci95: Pair | None = None
    scatter: float = 0.0
    tests: tuple[float, ...] = ()
    rates: tuple[float | None, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for numbers that are not finite and for negative errors."""
        numbers = {name: getattr(self, name) for name in ("value", "b", "scatter")}
        errors = {name: getattr(self, name) or 0.0 for name in ("stderr", "local", "b_stderr")}
        numbers |= {f"value of test {i + 1}": value for i, value in enumerate(self.tests)}
        for name, value in (numbers | errors).items():
            if not math.isfinite(value) or (name in errors and value < 0.0):
                raise ValueError(f"{name} is {value}")
        if self.kind not in (*KINDS, "fixed"):
            raise ValueError(f"kind is {self.kind!r}")

    @property
    def error(self) -> float | None:
        """Standard error; of the local covariance if the parameter is not determined."""
        return self.stderr or self.local or None

    @property
    def span(self) -> Pair | None:
        """Interval of a parameter without a standard error."""
        return self.range or self.ci95


class Miss(NamedTuple):
    """Residuals of a curve of a fitted test, relative to the measured range."""

    misfit: float  # RMS
    noise: float | None  # Standard deviation
    most: float = 0.0  # 95 % quantile of the magnitude


@dataclass(frozen=True, eq=False)
class Source:
    """A result from which tests are predicted."""

    name: str
    where: str  # Name or path of the result in messages
    joint: bool
    model: Model
    drive: str | None  # None if the tests of a joint fit have different drives
    interior_mass: bool
    status: str
    rates: tuple[float, ...]  # Known rates of the fitted tests, 1/s
    rate0: float | None
    parameters: dict[str, Identified]
    # Names of uncertain parameters and slopes of rate laws ("s1_k0:b"), and their correlation.
    names: tuple[str, ...]
    correlation: Array
    misses: dict[str, list[Miss]]  # Of the fitted tests, by channel
    time_shift: bool  # Whether a time shift of the motion was fitted
    # Names of own and scattering parameters, and their correlation between specimens, if known.
    changing: tuple[str, ...]
    together: Array
    sha256: str | None  # Of the record of a fit of one test
    smoothed: bool | None  # Whether the drive was the smoothed motion
    # For several cycles fitted as one history: the number of the last, and `Fit.growth`.
    last_cycle: float | None
    growth: float

    def law_error(self, channel: str, noise: float) -> float:
        """Return half the 95 % band due to model error, relative to the measured range.

        It is the part of the residuals of the fitted tests that their noise does not explain. If
        the result does not report this noise, `noise` (relative to the range) is used. Residuals
        that are mostly small but sometimes large are measured by their 95 % quantile.
        """
        squares = []
        for miss in self.misses.get(channel, ()):
            sigma = noise if miss.noise is None else miss.noise
            residual = max(NORMAL * miss.misfit, miss.most)
            squares.append(max(residual**2 - (NORMAL * sigma) ** 2, 0.0))
        return math.sqrt(sum(squares) / len(squares)) if squares else 0.0


def read_source(result: HasContent | str | Path) -> Source:
    """Read a result in memory, in a folder, or in its fit.json or joint.json.

    Raises InputError if there is no result, or if it lacks something that a prediction needs.
    """
    if isinstance(result, str | Path):
        content, where = load_result(_file(Path(result))), str(result)
    elif hasattr(result, "to_json_dict"):
        content = result.to_json_dict()
        where = str(content.get("test") or content.get("name") or "the result")
    else:
        kind = type(result).__name__
        raise InputError(f"a prediction needs a result of fit or joint, or its path, not {kind}")
    if not isinstance(content.get("parameters"), Mapping) or "model" not in content:
        raise InputError(f"{where} is not the result of a fit or joint fit (fit.json, joint.json)")
    try:
        return _source(content, where)
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # InputError among them
        why = f"has no {error}" if isinstance(error, KeyError) else f"cannot be read: {error}"
        raise InputError(f"{where} {why}; give the result as foamfit wrote it") from None


def _file(path: Path) -> Path:
    """Return the file of a result; in a folder joint.json, or else fit.json."""
    if not path.is_dir():
        return path
    if (path / "joint.json").is_file():
        return path / "joint.json"
    if not (path / "fit.json").is_file() and (path / "cycles.json").is_file():
        raise InputError(f"{path} contains fits of several cycles; name one, like {path}/cycle-1")
    return path / "fit.json"


def _source(content: Mapping[str, Any], where: str) -> Source:
    """Return the source for a content of fit.json or joint.json; KeyError etc. if damaged."""
    joint, drive, model = "tests" in content, content.get("drive"), Model.of_result(content)
    if drive not in (*DRIVES, None) or (drive is None and not joint):
        raise ValueError(f"drive is {drive!r}, not one of {', '.join(DRIVES)}")
    tests = content["tests"] if joint else {"": content}
    data, noise = content.get("data") or {}, content.get("noise") or {}
    rates = {name: (test if joint else data).get("rate") for name, test in tests.items()}
    parameters = dict(_parameters(content, model, joint, rates))
    key = "covariance" if joint else "correlation"
    names, correlation = _correlation(content, key, "matrix", parameters)
    changing, together = _correlation(content, "specimens", "correlation", parameters)
    return Source(
        name=str(content.get("name" if joint else "test") or where),
        where=where,
        joint=joint,
        model=model,
        drive=drive,
        interior_mass=bool(content.get("interior_mass", False)),
        status=str(content.get("status")),
        rates=tuple(rate for rate in rates.values() if rate),
        rate0=content.get("rate0"),
        parameters=parameters,
        names=names,
        correlation=correlation,
        misses=_misses(list(tests.values())),
        time_shift=TIME_SHIFT in content["parameters"],
        changing=changing,
        together=together,
        sha256=content.get("data_sha256"),
        smoothed=next((curve.get("motion_smoothed") for curve in noise.values()), None),
        last_cycle=data.get("last_cycle"),
        growth=(content.get("statistics") or {}).get("cycle_growth") or 0.0,
    )


def _parameters(
    content: Mapping[str, Any], model: Model, joint: bool, rates: Mapping[str, float | None]
) -> Iterator[tuple[str, Identified]]:
    """Yield the parameters of the springs; nuisance parameters apply to one record only."""
    local = content.get("correlation") or {}
    errors = dict(zip(local.get("names") or (), local.get("stderr") or (), strict=False))
    springs = {name: one for name, one in content["parameters"].items() if name not in NUISANCE}
    if unknown := springs.keys() - set(model.names):
        raise ValueError(f"{min(unknown)} is not a parameter of its model {model.name}")
    for name in model.names:
        if name not in springs and split_name(name)[1] != "eta":
            raise ValueError(f"it has no parameter {name} of its model {model.name}")
        one = springs.get(name, {"value": 0.0, "kind": "fixed"})
        try:
            kind = one["kind"] if joint else "shared" if one.get("vary") else "fixed"
            yield name, _identified(kind, {"local": errors.get(name)} | one, rates)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"parameter {name}: {error}") from None


def _identified(kind: str, one: Any, rates: Mapping[str, float | None]) -> Identified:
    """Return one parameter of fit.json or joint.json; `rates` are the rates of the tests."""
    tests = one["tests"] if kind in ("own", "scatter") else {}
    if kind == "scatter":  # the spread was found from the tests that determine the parameter
        sure = {test: at for test, at in tests.items() if at.get("stderr") is not None}
        tests = sure if len(sure) > 1 else tests
    # NaN is rejected: these kinds need these keys.
    needed = {"b": math.nan if kind in RATES else 0.0}
    needed |= {"scatter": math.nan if kind == "scatter" else 0.0}
    content = needed | one | {"kind": kind, "rates": [rates.get(test) for test in tests]}
    content["tests"] = [at["value"] for at in tests.values()]
    for key in ("ci95", "range", "b_ci95"):  # null marks an open side
        content[key] = None if None in (content.get(key) or ()) else content.get(key)
    for key in ("stderr", "local", "b_stderr"):
        content[key] = content.get(key) or None
    identified: Identified = build(Identified, content, {})
    return identified


def _correlation(
    content: Mapping[str, Any], key: str, of: str, parameters: Mapping[str, Identified]
) -> tuple[tuple[str, ...], Array]:
    """Return the names and the correlation in `content[key][of]`, which may be a covariance."""
    if content.get(key) is None:
        return (), np.empty((0, 0))
    names = content[key]["names"]
    matrix = np.reshape(np.array(content[key][of], dtype=float), (len(names),) * 2)
    if unknown := {name.removesuffix(":b") for name in names} - {*parameters, *NUISANCE}:
        raise ValueError(f"{key} contains {min(unknown)}, which is not a parameter")
    kept = [i for i, name in enumerate(names) if name not in NUISANCE]
    matrix = matrix[np.ix_(kept, kept)]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.diag(matrix))
        matrix = matrix / np.outer(scale, scale)
    matrix = np.clip(np.nan_to_num(matrix, posinf=0.0, neginf=0.0), -1.0, 1.0)  # unknown: 0
    np.fill_diagonal(matrix, 1.0)
    return tuple(names[i] for i in kept), 0.5 * (matrix + matrix.T)


def _misses(tests: list[Mapping[str, Any]]) -> dict[str, list[Miss]]:
    """Return the residuals of the fitted curves of all tests, by channel."""
    found = dict[str, list[Miss]]()
    for test in tests:
        counted = test.get("noise") or {}  # its keys are the fitted curves
        for curve, misfit in (test.get("misfit") or {}).items():
            if misfit is None or (counted and curve not in counted):
                continue
            noise, share, most = counted.get(curve) or {}, None, 0.0
            if span := noise.get("range"):
                share, most = noise["sigma"] / span, (noise.get("residual_q95") or 0.0) / span
            channel = "stress" if curve.startswith("stress") else curve.removesuffix("_time")
            found.setdefault(channel, []).append(Miss(misfit, share, most))
    return found


# An own parameter has a trend with the rate if these conditions are met.
EVIDENCE = 2.0  # least decrease of BIC
FEWEST_OF_TREND = 5  # least number of tests
SAME_RATE = 0.05  # least standard deviation of ln(rate)


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

    @property
    def _parameters(self) -> dict[str, Identified]:
        return self.source.parameters

    @cached_property
    def _uncertain(self) -> list[str]:
        """Names of free parameters with a common value."""
        return [name for name, one in self._parameters.items() if one.kind not in ("own", "fixed")]

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Free parameters of unknown uncertainty, which are fixed at their values."""
        pairs = ((name, self._parameters[name]) for name in self._uncertain)
        return tuple(name for name, one in pairs if one.error is None and one.span is None)

    @cached_property
    def _open(self) -> tuple[tuple[str, ...], Array]:
        """Names and covariance of free parameters and slopes, given `held` and the limits.

        Limits are treated as independent measurements with the variance of a flat distribution.
        """
        free = [name for name in self._uncertain if name not in self.held]
        free += [f"{name}:b" for name, one in self._parameters.items() if one.b_stderr]
        at, places = _places(free, self.source.names)
        held = _places(self.held, self.source.names)[1]
        r, matrix = self.source.correlation, np.eye(len(free))
        inner, across = r[np.ix_(places, places)], r[np.ix_(places, held)]
        if held.size:
            inverse = np.linalg.pinv(r[np.ix_(held, held)], hermitian=True)
            inner = inner - across @ inverse @ across.T
        matrix[np.ix_(at, at)] = inner
        at, places = _places(free, self.scattering)  # their common values
        matrix[np.ix_(at, at)] = self._correlation[np.ix_(places, places)]
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
        slope = name.endswith(":b")
        error, ends = (one.b_stderr, one.b_ci95) if slope else (one.error, one.ci95)
        if error is None:
            assert one.span is not None
            return self._flat(name, one.span)
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
            at, step = one.b if name.endswith(":b") else one.value, 1e-4 * self._error(name)
            sides = [self._vector(self._means | {name: at + sign * step}) for sign in (-1.0, 1.0)]
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
            if one.ci95 is not None and one.stderr is not None and not self.source.joint
        ]
        return max(NORMAL, float(np.median(ratios))) if ratios else NORMAL

    @cached_property
    def scattering(self) -> tuple[str, ...]:
        """Parameters that vary between specimens."""
        return tuple(
            name
            for name, one in self._parameters.items()
            if (one.kind == "scatter" and one.scatter > 0.0)
            or (one.kind == "own" and np.ptp(one.tests) > 0.0)
        )

    @cached_property
    def _correlation(self) -> Array:
        """Correlation of the scattering parameters between specimens."""
        names, own = self.scattering, self._own
        out = np.eye(len(names))
        at, places = _places(names, self.source.changing)
        out[np.ix_(at, at)] = self.source.together[np.ix_(places, places)]
        # For own parameters with a trend, or missing in the result, from their deviations.
        if own.slopes.any() or not set(own.names) <= set(self.source.changing):
            at, places = _places(names, own.names)
            among_own = correlation(own.deviations, np.zeros((places.size, places.size)))
            out[np.ix_(at, at)] = among_own[np.ix_(places, places)]
        return out

    @property
    def fewest(self) -> int:
        """Least number of tests that determine a scattering parameter; 0 if none scatters."""
        return min((len(self._parameters[name].tests) for name in self.scattering), default=0)

    @cached_property
    def _own(self) -> _Own:
        """Own parameters of the tests, as logarithms where `_in_logarithms` holds."""
        names = tuple(name for name in self.scattering if self._parameters[name].kind == "own")
        if not names:
            return _Own((), np.empty(0), np.empty(0), np.empty((0, 0)), np.empty(0))
        if len({len(self._parameters[name].tests) for name in names}) > 1:
            raise InputError(
                f"{self.source.where}: all own parameters must have values for the same tests"
            )
        values = np.array([self._parameters[name].tests for name in names]).T
        logs = [self._in_logarithms(name) for name in names]
        values[:, logs] = np.log(values[:, logs])
        n, k = values.shape
        mean, deviations = values.mean(axis=0), values - values.mean(axis=0)
        slopes, leverage = np.zeros(k), np.full(k, 1.0 / n)
        rates = [rate for rate in self._parameters[names[0]].rates if rate]
        if self.rate is not None and len(rates) == n >= FEWEST_OF_TREND:
            x = np.log(rates)
            at, x = math.log(self.rate) - x.mean(), x - x.mean()
            square = float(x @ x)
            line = x @ deviations / max(square, 1e-300)
            about = deviations - np.outer(x, line)
            squares = np.maximum([np.sum(deviations**2, axis=0), np.sum(about**2, axis=0)], 1e-300)
            gain = n * np.log(squares[0] / squares[1]) - math.log(n)
            trend = (gain > EVIDENCE) & (square > n * SAME_RATE**2)
            slopes = np.where(trend, line, 0.0)
            mean, deviations = mean + slopes * at, np.where(trend, about, deviations)
            leverage = leverage + np.where(trend, at**2 / max(square, 1e-300), 0.0)
        freedom = max(n - 1 - bool(np.any(slopes)), 1)
        spread = np.sqrt((1.0 + leverage) * np.sum(deviations**2, axis=0) / freedom)
        return _Own(names, mean, slopes, deviations, spread)

    @property
    def trends(self) -> list[str]:
        """Own parameters that have a trend with the rate."""
        pairs = zip(self._own.names, self._own.slopes, strict=True)
        return [name for name, slope in pairs if slope]

    def _in_logarithms(self, name: str) -> bool:
        return is_logarithmic(split_name(name)[1]) and min(self._parameters[name].tests) > 0.0

    def _own_values(self, logarithms: Array) -> dict[str, float]:
        """Return own parameters, SI, given their logarithms where `_in_logarithms` holds."""
        pairs = zip(self._own.names, logarithms.tolist(), strict=True)
        return {name: _exp(u) if self._in_logarithms(name) else u for name, u in pairs}

    @property
    def _means(self) -> dict[str, float]:
        """Values at the rate of the test of own parameters with a trend."""
        means = self._own_values(self._own.mean)
        return {name: means[name] for name in self.trends}

    @property
    def point(self) -> Array:
        """The common values, at the rate of the test."""
        return self._vector(self._means)

    def candidates(self) -> Iterator[Array]:
        """Yield the common values, then those with the own values of each test, nearest first."""
        yield self.point
        own = self._own
        scale = np.maximum(np.sqrt(np.sum(own.deviations**2, axis=0)), 1e-300)
        for row in own.deviations[np.argsort(np.sum((own.deviations / scale) ** 2, axis=1))]:
            yield self._vector(self._own_values(own.mean + row))

    def draws(self, seed: int) -> Iterator[Array]:
        """Draw parameters of specimens, from their scatter and the uncertainty of the result.

        The scatter is correlated between parameters. Because its size is estimated from n tests, it
        has Student's t distribution with n - 1 degrees of freedom.
        """
        rng, other = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        scatter, uncertain = _root(self._correlation), _root(self.covariance)
        own, freedom = self._own, max(self.fewest - 1 - bool(self._own.slopes.any()), 1)
        while True:
            tail = math.sqrt(freedom / rng.chisquare(freedom))
            drawn = tail * (scatter @ rng.standard_normal(len(self.scattering)))
            deviates = dict(zip(self.scattering, drawn.tolist(), strict=True))
            values = self._own_values(own.mean + own.spread * [deviates[n] for n in own.names])
            for name in deviates.keys() - values.keys():
                one = self._parameters[name]
                values[name] = one.value * _exp(one.scatter * deviates[name])
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
                value *= factor(one.kind, changes.get(f"{name}:b", one.b), x)[0]
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


class _Own(NamedTuple):
    """k own parameters of n tests, as a sample of specimens.

    If there is evidence for a trend with the rate, the mean of a parameter is a straight line over
    the logarithm of the rate.
    """

    names: tuple[str, ...]
    mean: Array  # (k,): at the rate of the test that is predicted
    slopes: Array  # (k,): by the logarithm of the rate; 0 without evidence for a trend
    deviations: Array  # (n, k): of the tests from the means
    spread: Array  # (k,): standard deviation of a new specimen from the mean, as estimated


def _places(
    names: tuple[str, ...] | list[str], among: tuple[str, ...]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the names that occur in `among`, and their indices in `among`."""
    pairs = [(i, among.index(name)) for i, name in enumerate(names) if name in among]
    at, places = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return at, places


def _root(correlation: Array) -> Array:
    """Return a matrix square root of a covariance; negative eigenvalues count as zero."""
    power, axes = np.linalg.eigh(correlation)
    return np.asarray(axes * np.sqrt(np.maximum(power, 0.0)))


def _exp(value: float) -> float:
    """Return the exponential, clipped to a finite value; no parameter may be that large."""
    return math.exp(min(max(value, -700.0), 700.0))
