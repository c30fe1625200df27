"""What a result says of its law, and of the parameters of a test that was not fitted.

It is read from fit.json or joint.json. A result in memory is read by the content of its file, so
that both give the same numbers. Uncertain parameters have a covariance; those that change from
specimen to specimen, because they scatter or are own, are drawn.
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
from foamfit.fitting.curves import DRIVES
from foamfit.fitting.links import RATES, factor
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.report.folder import load_result
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name
from foamfit.trust.scatter import correlation

NORMAL = 1.959964  # half of the 95 % interval of a normal distribution over its standard deviation
KINDS = ("shared", "own", "scatter", *RATES, "fixed")
Pair = tuple[float, float]


class HasContent(Protocol):
    """A result in memory."""

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of its file."""


@dataclass(frozen=True)
class Identified:
    """One parameter of a result, SI; `kind` is as in joint.json, "shared" for that of one test.

    `tests` has the values of an own or scattering parameter, one for each test, and `rates` the
    rates of these tests (1/s). Raises ValueError if a number is missing or inadmissible.
    """

    kind: str
    value: float
    stderr: float | None = None
    local: float | None = None  # As `stderr`, also where the test does not determine it
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
        """Refuse what is no number."""
        numbers = {name: getattr(self, name) for name in ("value", "b", "scatter")}
        errors = {name: getattr(self, name) or 0.0 for name in ("stderr", "local", "b_stderr")}
        numbers |= {f"value of test {i + 1}": value for i, value in enumerate(self.tests)}
        for name, value in (numbers | errors).items():
            if not math.isfinite(value) or (name in errors and value < 0.0):
                raise ValueError(f"{name} is {value}")
        if self.kind not in KINDS:
            raise ValueError(f"kind is {self.kind!r}")

    @property
    def error(self) -> float | None:
        """Its standard error, that of the local covariance where it is not determined."""
        return self.stderr or self.local or None

    @property
    def span(self) -> Pair | None:
        """Where it may lie if it has no standard error."""
        return self.range or self.ci95


class Miss(NamedTuple):
    """Misfit (RMS) of a curve of a fitted test and its noise, both over the measured range.

    `most` is what 95 % of the residuals are below.
    """

    misfit: float
    noise: float | None
    most: float = 0.0


@dataclass(frozen=True, eq=False)
class Source:
    """A result from which tests are predicted."""

    name: str
    where: str  # What messages call it
    joint: bool
    model: Model
    drive: str | None  # None where the tests of a joint fit have several
    interior_mass: bool
    status: str
    rates: tuple[float, ...]  # Of the fitted tests, as far as they are known, 1/s
    rate0: float | None
    parameters: dict[str, Identified]
    # Correlation of what is named: a parameter, or its slope by rate as "s1_k0:b".
    names: tuple[str, ...]
    correlation: Array
    misses: dict[str, list[Miss]]  # Of the fitted tests, by channel
    time_shift: bool = False  # Whether a time shift of the motion was fitted
    # Correlation between specimens of own and scattering parameters, as far as the result has it.
    changing: tuple[str, ...] = ()
    together: Array = field(default_factory=lambda: np.empty((0, 0)))
    sha256: str | None = None  # Of the record, where it is that of one test
    smoothed: bool | None = None  # Whether the driving motion was followed without its noise
    # Of several cycles fitted as one history: the last, and `Fit.growth`.
    last_cycle: float | None = None
    growth: float = 0.0

    def law_error(self, channel: str, noise: float) -> float:
        """Half of the 95 % band by what the law missed of the fitted tests beyond their noise.

        Over the range. `noise` (over the range) is taken for tests whose noise the result does not
        tell. Residuals that are mostly small and sometimes large count by their quantile.
        """
        squares = []
        for miss in self.misses.get(channel, ()):
            known = noise if miss.noise is None else miss.noise
            missed = max(NORMAL * miss.misfit, miss.most)
            squares.append(max(missed**2 - (NORMAL * known) ** 2, 0.0))
        return math.sqrt(sum(squares) / len(squares)) if squares else 0.0


def read_source(result: HasContent | str | Path) -> Source:
    """Read what a result says of its law: one in memory, its folder, its fit.json or joint.json.

    Raises InputError if there is no result, or it lacks what a prediction needs.
    """
    if isinstance(result, str | Path):
        content, where = load_result(_file(Path(result))), str(result)
    elif hasattr(result, "to_json_dict"):
        content = result.to_json_dict()
        where = str(content.get("test") or content.get("name") or "the result")
    else:
        told = f"not from a {type(result).__name__}"
        raise InputError(f"a prediction is made from a result of fit or joint or its path, {told}")
    if not isinstance(content.get("parameters"), Mapping) or "model" not in content:
        raise InputError(f"{where} is not the result of a fit or joint fit (fit.json, joint.json)")
    try:
        return _source(content, where)
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # InputError among them
        told = f"has no {error}" if isinstance(error, KeyError) else f"cannot be read: {error}"
        raise InputError(f"{where} {told}; give the result as foamfit wrote it") from None


def _file(path: Path) -> Path:
    """The file of a result: joint.json before fit.json in a folder."""
    if not path.is_dir():
        return path
    if (path / "joint.json").is_file():
        return path / "joint.json"
    if not (path / "fit.json").is_file() and (path / "cycles.json").is_file():
        raise InputError(f"{path} contains fits of several cycles; name one, as {path}/cycle-1")
    return path / "fit.json"


def _source(content: Mapping[str, Any], where: str) -> Source:
    """What the content of fit.json or joint.json says; KeyError, TypeError… where it is damaged."""
    joint, drive, model = "tests" in content, content.get("drive"), Model.of_result(content)
    if drive not in (*DRIVES, None) or (drive is None and not joint):
        raise ValueError(f"drive is {drive!r}, not one of {', '.join(DRIVES)}")
    tests = content["tests"] if joint else {"": content}
    data, noise = content.get("data") or {}, content.get("noise") or {}
    told = [one if joint else data for one in tests.values()]
    rates = {name: one.get("rate") for name, one in zip(tests, told, strict=True)}
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
        smoothed=next((one.get("motion_smoothed") for one in noise.values()), None),
        last_cycle=data.get("last_cycle"),
        growth=(content.get("statistics") or {}).get("cycle_growth") or 0.0,
    )


def _parameters(
    content: Mapping[str, Any], model: Model, joint: bool, rates: Mapping[str, float | None]
) -> Iterator[tuple[str, Identified]]:
    """The parameters of the springs: nuisance parameters are those of one record."""
    told = content.get("correlation") or {}
    errors = dict(zip(told.get("names") or (), told.get("stderr") or (), strict=False))
    given = {name: one for name, one in content["parameters"].items() if name not in NUISANCE}
    if unknown := given.keys() - set(model.names):
        raise ValueError(f"{min(unknown)} is no parameter of its model {model.name}")
    for name in model.names:
        if name not in given and split_name(name)[1] != "eta":
            raise ValueError(f"it has no parameter {name} of its model {model.name}")
        one = given.get(name, {"value": 0.0, "kind": "fixed"})
        try:
            kind = one["kind"] if joint else "shared" if one.get("vary") else "fixed"
            yield name, _identified(kind, {"local": errors.get(name)} | one, rates)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"parameter {name}: {error}") from None


def _identified(kind: str, one: Any, rates: Mapping[str, float | None]) -> Identified:
    """One parameter of fit.json or joint.json; `rates` are those of the tests."""
    needed = {"b": math.nan if kind in RATES else 0.0}
    needed |= {"scatter": math.nan if kind == "scatter" else 0.0}
    tests = one["tests"] if kind in ("own", "scatter") else {}
    if kind == "scatter":  # the spread is that of the tests that determine it
        sure = {test: each for test, each in tests.items() if each.get("stderr") is not None}
        tests = sure if len(sure) > 1 else tests
    made = needed | one | {"kind": kind, "rates": [rates.get(test) for test in tests]}
    made["tests"] = [each["value"] for each in tests.values()]
    for key in ("ci95", "range", "b_ci95"):  # null at a side that is open
        made[key] = None if None in (made.get(key) or ()) else made.get(key)
    for key in ("stderr", "local", "b_stderr"):
        made[key] = made.get(key) or None
    found: Identified = build(Identified, made, {})
    return found


def _correlation(
    content: Mapping[str, Any], key: str, of: str, parameters: Mapping[str, Identified]
) -> tuple[tuple[str, ...], Array]:
    """Correlation of the parameters that are named, from that or a covariance; 0 if unknown."""
    if content.get(key) is None:
        return (), np.empty((0, 0))
    names = content[key]["names"]
    matrix = np.reshape(np.array(content[key][of], dtype=float), (len(names),) * 2)
    if unknown := {name.removesuffix(":b") for name in names} - {*parameters, *NUISANCE}:
        raise ValueError(f"{key} has {min(unknown)}, which is no parameter")
    kept = [i for i, name in enumerate(names) if name not in NUISANCE]
    matrix = matrix[np.ix_(kept, kept)]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.diag(matrix))
        matrix = matrix / np.outer(scale, scale)
    matrix = np.clip(np.nan_to_num(matrix, posinf=0.0, neginf=0.0), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return tuple(names[i] for i in kept), 0.5 * (matrix + matrix.T)


def _misses(tests: list[Mapping[str, Any]]) -> dict[str, list[Miss]]:
    """By how much the counted curves of each channel were missed, test by test."""
    found = dict[str, list[Miss]]()
    for test in tests:
        counted = test.get("noise") or {}  # has the noise of these curves
        for curve, misfit in (test.get("misfit") or {}).items():
            if misfit is None or (counted and curve not in counted):
                continue
            noise, share, most = counted.get(curve) or {}, None, 0.0
            if span := noise.get("range"):
                share, most = noise["sigma"] / span, (noise.get("residual_q95") or 0.0) / span
            channel = "stress" if curve.startswith("stress") else curve.removesuffix("_time")
            found.setdefault(channel, []).append(Miss(misfit, share, most))
    return found


# Own parameters follow the rate if this lowers BIC by at least the first number, there are at least
# as many tests as the second, and ln(rate) scatters by more than the third.
EVIDENCE, FEWEST_OF_TREND, SAME_RATE = 2.0, 5, 0.05


@dataclass(frozen=True, eq=False)
class Population:
    """The parameters of one test, in the order of the model (SI), as a result predicts them.

    `rate` (1/s) is that of the test, None where it is not known; `limits` are those of a fit of it.
    """

    source: Source
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

    @property
    def _known(self) -> dict[str, Identified]:
        return self.source.parameters

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
        slopes = np.zeros((len(self._known), len(free)))
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
            yield self._vector(values) + uncertain @ other.standard_normal(len(self._known))

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
        heights = [name for name in self._known if name.endswith("_height")]
        if heights and self.specimen.heights is not None:
            values |= dict(zip(heights, self.specimen.heights, strict=True))
        elif heights:
            total = sum(self._known[name].value for name in heights)
            if self._known[heights[-1]].kind == "fixed":  # what the others leave
                values[heights[-1]] = total - sum(values[name] for name in heights[:-1])
            whole = sum(values[name] for name in heights)
            values |= {name: values[name] * self.specimen.height / whole for name in heights}
        return np.array([values[name] for name in self._known])


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
