"""What a result says of a law: read from fit.json or joint.json, or from their content.

The files are the contract: a result in memory is read as its file would be, so that both give the
same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.fitting.curves import DRIVES
from foamfit.fitting.links import RATES
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.report.folder import load_result
from foamfit.results import SCHEMA
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name

KINDS = ("shared", "own", "scatter", *RATES, "fixed")
Pair = tuple[float, float]
# Curves that a drive gives, but which it does not count: see `fitting.curves.default_weights`.
_UNCOUNTED = {
    "impact": ("stress_strain",),
    "stress": ("stress_time", "stress_strain"),
    "displacement": ("stress_time", "displacement_time"),
}


class HasContent(Protocol):
    """A result in memory: it gives the content of its file."""

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of its file."""


@dataclass(frozen=True)
class Identified:
    """One parameter of a result, SI; `kind` is as in joint.json, "shared" for that of one test.

    `tests` has the values of an own or scattering parameter, one for each test.
    """

    kind: str
    value: float
    stderr: float | None = None
    ci95: Pair | None = None
    range: Pair | None = None
    state: str | None = None
    b: float = 0.0
    b_stderr: float | None = None
    b_ci95: Pair | None = None
    scatter: float = 0.0
    tests: tuple[float, ...] = ()
    rates: tuple[float | None, ...] = ()  # of these tests, 1/s

    @property
    def span(self) -> Pair | None:
        """Where it may lie if it has no standard error."""
        return self.range or self.ci95


class Miss(NamedTuple):
    """How far a curve of a fitted test was missed, and its noise if that is known.

    Both are over the measured range: the RMS, and one standard deviation.
    """

    misfit: float
    noise: float | None


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
    misses: dict[str, tuple[Miss, ...]]  # Of the fitted tests, by channel
    time_shift: bool = False  # Whether a time shift of the motion was fitted
    # Correlation between specimens of own and scattering parameters, as far as the result has it.
    changing: tuple[str, ...] = ()
    together: Array = field(default_factory=lambda: np.empty((0, 0)))

    def law_error(self, channel: str, noise: float) -> float:
        """RMS of what the law missed of the fitted tests beyond their noise, over the range.

        `noise` stands for that of a test whose noise the result does not tell: one standard
        deviation over the range.
        """
        squares = [
            max(miss.misfit**2 - (noise if miss.noise is None else miss.noise) ** 2, 0.0)
            for miss in self.misses.get(channel, ())
        ]
        return math.sqrt(sum(squares) / len(squares)) if squares else 0.0


def read_source(result: HasContent | str | Path) -> Source:
    """Read what a result says of its law.

    Parameters
    ----------
    result : FitResult, JointResult, str or Path
        A result in memory, its folder, or its fit.json or joint.json.

    Raises
    ------
    InputError
        If there is no result, or it lacks what a prediction needs; the message names the key.
    """
    if isinstance(result, str | Path):
        path = _file(Path(result))
        return _source(load_result(path), str(result))
    if not hasattr(result, "to_json_dict"):
        raise InputError(
            f"a prediction is made from a result of fit or joint or the path of one, not from "
            f"a {type(result).__name__}"
        )
    content = result.to_json_dict()
    return _source(content, str(content.get("test") or content.get("name") or "the result"))


def _file(path: Path) -> Path:
    """The file of a result: joint.json before fit.json in a folder."""
    if not path.is_dir():
        return path
    if (path / "joint.json").is_file():
        return path / "joint.json"
    if not (path / "fit.json").is_file() and (path / "cycles.json").is_file():
        raise InputError(f"{path} holds the fits of several cycles; name one, as {path}/cycle-1")
    return path / "fit.json"


def _source(content: Mapping[str, Any], where: str) -> Source:
    if content.get("schema") != SCHEMA:
        raise InputError(f"{where} has schema {content.get('schema')}, not {SCHEMA}")
    if not isinstance(content.get("parameters"), Mapping) or "model" not in content:
        raise InputError(
            f"{where} is not the result of a fit or of a joint fit (fit.json, joint.json)"
        )
    joint = "tests" in content
    relaxation = content.get("relaxation", 0)
    try:
        model = Model.parse(content["model"], relaxation)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    drive = content.get("drive")
    if drive not in (*DRIVES, None) or (drive is None and not joint):
        raise InputError(f"{where}: drive is {drive!r}; it must be one of {', '.join(DRIVES)}")
    tests = _mapping(content, "tests", where) if joint else {}
    data = content.get("data")
    single = data.get("rate") if isinstance(data, Mapping) and not joint else None
    given = {name: one.get("rate") for name, one in tests.items() if isinstance(one, Mapping)}
    rates = {
        name: None if rate is None else _number(rate, f"{where}: rate")
        for name, rate in (given if joint else {"": single}).items()
    }
    # What a record does not say exactly is its own, and no other test's.
    parameters = {
        name: _parameter(item, joint, rates, f"{where}: {name}")
        for name, item in content["parameters"].items()
        if name not in NUISANCE
    }
    for name in model.names:
        if name in parameters:
            continue
        if split_name(name)[1] != "eta":
            raise InputError(f"{where} has no parameter {name}, which its model {model.name} has")
        parameters[name] = Identified("fixed", 0.0)
    if unknown := [name for name in parameters if name not in model.names]:
        raise InputError(f"{where}: {unknown[0]} is no parameter of its model {model.name}")
    rate0 = content.get("rate0")
    names, correlation = _correlation(
        content, "covariance" if joint else "correlation", "matrix", parameters, where
    )
    changing, together = _correlation(content, "specimens", "correlation", parameters, where)
    fits = list(tests.values()) if joint else [content]
    return Source(
        name=str(content.get("name" if joint else "test") or where),
        where=where,
        joint=joint,
        model=model,
        drive=drive,
        interior_mass=bool(content.get("interior_mass", False)),
        status=str(content.get("status")),
        rates=tuple(rate for rate in rates.values() if rate),
        rate0=None if rate0 is None else _number(rate0, f"{where}: rate0"),
        parameters=parameters,
        names=names,
        correlation=correlation,
        misses=_misses([one for one in fits if isinstance(one, Mapping)], where),
        time_shift=TIME_SHIFT in content["parameters"],
        changing=changing,
        together=together,
    )


def _parameter(
    item: object, joint: bool, rates: Mapping[str, float | None], where: str
) -> Identified:
    """One parameter of fit.json or joint.json; `rates` are those of the tests."""
    if not isinstance(item, Mapping):
        raise InputError(f"{where} is {item!r}; it must be an object with a value")
    kind = item.get("kind") if joint else "shared" if item.get("vary") else "fixed"
    if kind not in KINDS:
        raise InputError(f"{where}: kind is {kind!r}; it must be one of {', '.join(KINDS)}")
    tests, of_rates = tuple[float, ...](), tuple[float | None, ...]()
    if kind in ("own", "scatter"):
        given = _mapping(item, "tests", where)
        each = {name: one if isinstance(one, Mapping) else {} for name, one in given.items()}
        # the spread is that of the tests that determine it
        sure = {name: one for name, one in each.items() if one.get("stderr") is not None}
        if kind == "scatter" and len(sure) > 1:
            each = sure
        tests = tuple(_number(one.get("value"), f"{where}: tests") for one in each.values())
        of_rates = tuple(rates.get(name) for name in each)
    scatter = item.get("scatter") if kind == "scatter" else 0.0
    return Identified(
        kind,
        _number(item.get("value"), f"{where}: value"),
        _positive(item.get("stderr"), f"{where}: stderr"),
        _pair(item.get("ci95"), f"{where}: ci95"),
        _pair(item.get("range"), f"{where}: range"),
        item.get("state"),
        _number(item.get("b"), f"{where}: b") if kind in RATES else 0.0,
        _positive(item.get("b_stderr"), f"{where}: b_stderr"),
        _pair(item.get("b_ci95"), f"{where}: b_ci95"),
        _number(scatter, f"{where}: scatter"),
        tests,
        of_rates,
    )


def _correlation(
    content: Mapping[str, Any], key: str, of: str, parameters: Mapping[str, Identified], where: str
) -> tuple[tuple[str, ...], Array]:
    """Correlation of the parameters that are named, from that or a covariance; 0 if unknown."""
    if content.get(key) is None:
        return (), np.empty((0, 0))
    item = _mapping(content, key, where)
    names = item.get("names")
    try:
        matrix = np.array(item.get(of), dtype=float).reshape(len(names or ()), -1)
    except (TypeError, ValueError):
        matrix = np.empty((0, 0))
    known = isinstance(names, list) and all(
        isinstance(name, str) and name.removesuffix(":b") in (*parameters, *NUISANCE)
        for name in names
    )
    if not known or matrix.shape != (len(names or ()), len(names or ())):
        raise InputError(
            f"{where}: {key} must have the names of parameters and a square matrix of as many rows"
        )
    kept = [i for i, name in enumerate(names or ()) if name not in NUISANCE]
    names, matrix = [(names or ())[i] for i in kept], matrix[np.ix_(kept, kept)]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.diag(matrix))
        matrix = matrix / np.outer(scale, scale)
    matrix = np.clip(np.where(np.isfinite(matrix), matrix, 0.0), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return tuple(names), 0.5 * (matrix + matrix.T)


def _misses(fits: list[Mapping[str, Any]], where: str) -> dict[str, tuple[Miss, ...]]:
    """By how much the counted curves of each channel were missed, test by test."""
    found = dict[str, list[Miss]]()
    for fit in fits:
        misfits, noise = fit.get("misfit"), fit.get("noise")
        for curve, misfit in (misfits if isinstance(misfits, Mapping) else {}).items():
            if misfit is None or curve in _UNCOUNTED.get(str(fit.get("drive")), ()):
                continue
            level = noise.get(curve) if isinstance(noise, Mapping) else None
            level = level if isinstance(level, Mapping) else {}
            share = None
            if level.get("range"):
                range_ = _number(level["range"], f"{where}: range of {curve}")
                share = _number(level.get("sigma"), f"{where}: sigma of {curve}") / range_
            channel = "stress" if curve.startswith("stress") else curve.removesuffix("_time")
            off = _number(misfit, f"{where}: misfit of {curve}")
            found.setdefault(channel, []).append(Miss(off, share))
    return {channel: tuple(each) for channel, each in found.items()}


def _mapping(content: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    item = content.get(key)
    if not isinstance(item, Mapping):
        raise InputError(f"{where} has no object '{key}', which a prediction needs")
    return item


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where} is {value!r}; it must be a number")
    return float(value)


def _positive(value: object, where: str) -> float | None:
    if value is None:
        return None
    number = _number(value, where)
    if number < 0.0:
        raise InputError(f"{where} is {value!r}; it must not be negative")
    return number or None


def _pair(value: object, where: str) -> Pair | None:
    if value is None:
        return None
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError(f"{where} is {value!r}; it must be two numbers")
    if any(end is None for end in value):  # open on one side
        return None
    low, high = (_number(end, where) for end in value)
    return low, high
