"""A result read from its folder (`load`), and what it predicts for another test and specimens.

To predict, a result in memory is read by the content of its file, fit.json or joint.json, so that
both give the same numbers.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lmfit
import numpy as np

from foamfit.api import FitResult
from foamfit.arrays import Array
from foamfit.codec import build, reading
from foamfit.data.measurement import Specimen
from foamfit.errors import InputError, UnknownLawError
from foamfit.files import read_whole, reason
from foamfit.fitting.box import is_logarithmic
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.fitting.together import factor
from foamfit.options import DRIVES, KINDS, RATES
from foamfit.parts import Pair, ParameterEstimate
from foamfit.report.folder import SAMPLES, Result, load_result, read_samples
from foamfit.report.listing import read_table
from foamfit.results import KEPT
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name
from foamfit.study.cycles import CycleFits
from foamfit.study.joint_result import JointResult
from foamfit.trust.identifiability import Insight

if TYPE_CHECKING:
    import pandas as pd

NORMAL = 1.959964  # half the 95 % interval of a normal distribution, in standard deviations
Correlation = tuple[tuple[str, ...], Array]  # names and their matrix


def load(folder: str | Path) -> FitResult | JointResult | CycleFits | pd.DataFrame:
    """Return the result in the folder of a fit, a joint fit, several cycles or a batch.

    It equals the result that was saved, and saving it again writes the same files. For a batch it
    is the summary that `foamfit.batch` returns.

    Raises
    ------
    InputError
        If there is no result in the format of this version, or one of its files is damaged.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{folder} is not a folder; name a result folder of foamfit")
    if (place / "joint.json").is_file():
        return _joint(place)
    if (place / "cycles.json").is_file():
        return _cycles(place)
    if (place / "summary.csv").is_file():
        return read_table(place / "summary.csv")
    return _fit(place)


def _fit(folder: Path) -> FitResult:
    content = load_result(folder)
    if not isinstance(content.get("load"), Mapping):
        raise InputError(
            f"{folder / 'fit.json'} is of foamfit {content.get('foamfit')}, which did not keep all "
            "that load needs; fit the test again"
        )
    kept = content | content["load"]
    columns = _columns(folder / "curves.csv", kept.get("samples"))
    with reading(f"{folder}: fit.json"):
        kept["measurement"] = content | content["data"] | kept["measurement"]
        given = {name: kept[name] for name in KEPT if name in kept}
        result: FitResult = build(FitResult, given, columns, lmfit=lmfit, Insight=Insight)
    result.draws.update(read_samples(folder / SAMPLES))
    return result


def _columns(path: Path, samples: object) -> dict[str, Array]:
    """Read curves.csv, which must have `samples` rows."""
    try:
        head, *lines = read_whole(path).decode(errors="replace").splitlines() or [""]
    except OSError as error:
        raise InputError(f"{path} cannot be read: {reason(error)}") from None
    if len(lines) != samples:
        raise InputError(f"{path} is damaged: it has {len(lines)} rows of {samples}")
    names = next(csv.reader([head]), [])
    try:
        values = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, len(names)))
        return dict(zip(names, values.T, strict=True))
    except ValueError as error:
        raise InputError(f"{path} is damaged: {str(error).partition(';')[0]}") from None


def _joint(folder: Path) -> JointResult:
    content = load_result(folder / "joint.json")
    with reading(f"{folder / 'joint.json'}"):
        given = content | {"model": Model.of_result(content).name}
        made: JointResult = build(JointResult, given | {"results": {}}, {})
    return replace(made, results={name: _fit(folder / name) for name in made.tests})


def _cycles(folder: Path) -> CycleFits:
    content = load_result(folder / "cycles.json")
    with reading(f"{folder / 'cycles.json'}"):
        made: CycleFits = build(CycleFits, content | {"results": {}}, {})
        names = content["fitted"]
    return replace(made, results={n: _fit(folder / f"cycle-{n}") for n in names})


def with_record(fit: FitResult, folder: str | Path) -> FitResult:
    """Return a fit with the path of its record as found from the folder of the result."""
    path = fit.measurement.path
    if path is None:
        return fit
    # It is relative to the current directory of the fit, which usually contains the folder.
    places = (place / path for place in Path(folder).resolve().parents)
    path = next((place for place in places if place.is_file()), path)
    return replace(fit, measurement=replace(fit.measurement, path=path))


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
    rates: tuple[float, ...]  # Known ones of the fitted tests, 1/s
    rate0: float | None
    parameters: dict[str, ParameterEstimate]  # Of the springs
    errors: dict[str, float]  # Standard errors, also of parameters that are not determined
    correlation: Correlation  # Of uncertain parameters and slopes of rate laws ("s1_k0:b")
    law_errors: dict[str, float]  # By channel, see `_law_errors`
    time_shift: bool  # Whether a time shift of the motion was fitted
    specimens: Correlation  # Of own and scattering parameters between specimens, if known
    sha256: str | None  # Of the record of a fit of one test
    smoothed: bool | None  # Whether the drive was the smoothed motion
    last_cycle: float | None  # Number of the last fitted cycle
    growth: float  # `Fit.growth` of several cycles fitted as one history


def read_source(result: Result | str | Path) -> Source:
    """Read a result in memory, in a folder or its file; InputError if it lacks what is needed."""
    if isinstance(result, str | Path):
        path, joint = Path(result), Path(result, "joint.json")
        content, where = load_result(joint if joint.is_file() else path), str(result)
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
    except UnknownLawError as error:
        raise InputError(f"{where} cannot be read here: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # InputError among them
        why = f"has no {error}" if isinstance(error, KeyError) else f"cannot be read: {error}"
        raise InputError(f"{where} {why}; give the result as foamfit wrote it") from None


def _source(content: Mapping[str, Any], where: str) -> Source:
    """Return the source for a content of fit.json or joint.json; KeyError etc. if damaged."""
    joint, drive, model = "tests" in content, content.get("drive"), Model.of_result(content)
    if drive not in (*DRIVES, None) or (drive is None and not joint):
        raise ValueError(f"drive is {drive!r}, not one of {', '.join(DRIVES)}")
    tests = list(content["tests"].values()) if joint else [content]
    data, noise = content.get("data") or {}, content.get("noise") or {}
    parameters = dict(_parameters(content["parameters"], model, joint))
    local = content.get("correlation") or {}
    errors = dict(zip(local.get("names") or (), local.get("stderr") or (), strict=False))
    errors |= {name: one.stderr for name, one in parameters.items() if one.stderr}
    key = "covariance" if joint else "correlation"
    return Source(
        name=str(content.get("name" if joint else "test") or where),
        where=where,
        joint=joint,
        model=model,
        drive=drive,
        interior_mass=bool(content.get("interior_mass", False)),
        status=str(content.get("status")),
        rates=tuple(rate for test in tests if (rate := (test if joint else data).get("rate"))),
        rate0=content.get("rate0"),
        parameters=parameters,
        errors={name: error for name, error in errors.items() if error},
        correlation=_correlation(content, key, "matrix", parameters),
        law_errors=_law_errors(tests),
        time_shift=TIME_SHIFT in content["parameters"],
        specimens=_correlation(content, "specimens", "correlation", parameters),
        sha256=content.get("data_sha256"),
        smoothed=next((curve.get("motion_smoothed") for curve in noise.values()), None),
        last_cycle=data.get("last_cycle") or data.get("cycle"),
        growth=(content.get("statistics") or {}).get("cycle_growth") or 0.0,
    )


def _parameters(
    content: Mapping[str, Any], model: Model, joint: bool
) -> Iterator[tuple[str, ParameterEstimate]]:
    """Yield the parameters of the springs; nuisance parameters apply to one record only."""
    springs = {name: one for name, one in content.items() if name not in NUISANCE}
    if unknown := springs.keys() - set(model.names):
        raise ValueError(f"{min(unknown)} is not a parameter of its model {model.name}")
    for name in model.names:
        if name not in springs and split_name(name)[1] != "eta":
            raise ValueError(f"it has no parameter {name} of its model {model.name}")
        one = springs.get(name, {"value": 0.0, "kind": "fixed"})
        try:
            tied = one.get("stderr") and not name.endswith("_height")  # given by an expression
            kind = one["kind"] if joint else "shared" if one.get("vary") or tied else "fixed"
            yield name, _parameter(kind, one)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"parameter {name}: {error}") from None


def _parameter(kind: str, given: Mapping[str, Any]) -> ParameterEstimate:
    """Return one parameter of fit.json or joint.json; ValueError for an inadmissible number."""
    if kind not in (*KINDS, "fixed"):
        raise ValueError(f"kind is {kind!r}")
    needed = {"b": kind in RATES, "scatter": kind == "scatter", "tests": kind in ("own", "scatter")}
    for key in (key for key, is_needed in needed.items() if is_needed and given.get(key) is None):
        raise ValueError(f"{key} is missing")
    # null marks an open side
    open_ends = {key: None for key in ("ci95", "range", "b_ci95") if None in (given.get(key) or ())}
    one: ParameterEstimate = build(ParameterEstimate, {**given, **open_ends, "kind": kind}, {})
    tests = one.tests if needed["tests"] and one.tests else {}
    numbers = {"value": one.value, "b": one.b or 0.0, "scatter": one.scatter or 0.0}
    numbers |= {f"value of {test}": at.value for test, at in tests.items()}
    errors = {"stderr": one.stderr or 0.0, "b_stderr": one.b_stderr or 0.0}
    for key, number in (numbers | errors).items():
        if not math.isfinite(number) or (key in errors and number < 0.0):
            raise ValueError(f"{key} is {number}")
    if kind == "scatter":  # the spread was found from the tests that determine the parameter
        sure = {test: at for test, at in tests.items() if at.stderr is not None}
        tests = sure if len(sure) > 1 else tests
    return replace(one, tests=tests)


def _correlation(
    content: Mapping[str, Any], key: str, of: str, parameters: Mapping[str, ParameterEstimate]
) -> Correlation:
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


def _law_errors(tests: list[Mapping[str, Any]]) -> dict[str, float]:
    """Return half the 95 % band due to model error by channel, over the range, RMS of the tests."""
    squares = dict[str, list[float]]()
    for test in tests:
        counted = test.get("noise") or {}  # its keys are the fitted curves
        for curve, misfit in (test.get("misfit") or {}).items():
            if misfit is None or (counted and curve not in counted):
                continue
            noise = counted.get(curve) or {}
            span = noise.get("range") or math.inf  # the noise is not known
            sigma, most = ((noise.get(key) or 0.0) / span for key in ("sigma", "residual_q95"))
            channel = "stress" if curve.startswith("stress") else curve.removesuffix("_time")
            # What noise does not explain; residuals that are sometimes large count by a quantile.
            square = max(NORMAL * misfit, most) ** 2 - (NORMAL * sigma) ** 2
            squares.setdefault(channel, []).append(max(square, 0.0))
    return {channel: math.sqrt(sum(each) / len(each)) for channel, each in squares.items()}


@dataclass(frozen=True, eq=False)
class Population:
    """The parameters that a result predicts for a test and its specimens, in the model's order."""

    source: Source
    specimen: Specimen  # Of the test
    rate: float | None  # Of the test, 1/s; None if unknown
    limits: Mapping[str, Pair] = field(default_factory=dict)  # Of parameters in a fit of the test

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
    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters, linearised, SI, given `held` and the limits."""
        free = [name for name in self._uncertain if name not in self.held]
        free += [f"{name}:b" for name, one in self._parameters.items() if one.b_stderr]
        (names, r), matrix = self.source.correlation, np.eye(len(free))
        _, at, places = np.intersect1d(free, names, return_indices=True)
        held = np.intersect1d(self.held, names, return_indices=True)[2]
        inner, across = r[np.ix_(places, places)], r[np.ix_(places, held)]
        if held.size:
            inverse = np.linalg.pinv(r[np.ix_(held, held)], hermitian=True)
            inner = inner - across @ inverse @ across.T
        matrix[np.ix_(at, at)] = inner
        errors = np.array([self._error(name) for name in free])
        matrix = matrix * np.outer(errors, errors)
        # Limits are like independent measurements with the variance of a flat distribution.
        flat = [self._flat(n, self.limits[n]) if n in self.limits else math.inf for n in free]
        bound = [i for i, sigma in enumerate(flat) if math.isfinite(sigma)]
        prior, rows = [flat[i] ** 2 for i in bound], matrix[bound]
        gain = np.linalg.lstsq(rows[:, bound] + np.diag(prior), rows, rcond=None)[0]
        matrix = matrix - rows.T @ gain
        slopes = np.zeros((len(self._parameters), len(free)))
        for column, name, error in zip(slopes.T, free, errors.tolist(), strict=True):
            one, step = self._parameters[name.removesuffix(":b")], 1e-4 * error
            value = (one.b or 0.0) if name.endswith(":b") else one.value
            sides = [self._vector({name: value + sign * step}) for sign in (-1.0, 1.0)]
            column[:] = (sides[1] - sides[0]) / (2.0 * step)
        return slopes @ matrix @ slopes.T

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
    def quantile(self) -> float:
        """Ratio of half a 95 % interval to the standard error: the median over the parameters."""
        # Few degrees of freedom increase all; a limit or a curved valley changes single ones.
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
        (names, known), out = self.source.specimens, np.eye(len(self.scattering))
        _, at, places = np.intersect1d(self.scattering, names, return_indices=True)
        out[np.ix_(at, at)] = known[np.ix_(places, places)]
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
        """Draw parameters of specimens, from their scatter and the uncertainty of the result."""
        rng, other = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        scatter, uncertain = _root(self._correlation), _root(self.covariance)
        freedom = max(self.fewest - 1, 1)  # of Student's t, as n tests determine the scatter
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
        """Return all parameters at rate and height of the test, with `changes` (slopes: ":b")."""
        values = dict[str, float]()
        for name, one in self._parameters.items():
            value = changes.get(name, one.value)
            if one.kind in RATES and self.rate is not None and self.source.rate0:
                x = math.log(self.rate / self.source.rate0)
                value *= factor(one.kind, changes.get(f"{name}:b", one.b or 0.0), x)[0]
            values[name] = value
        # The heights of a chain are the specimen's, or else keep their shares of its height.
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
