"""What a result says of a law: read from fit.json or joint.json.

A result in memory is read by the content of its file, so that both give the same numbers.
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
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name

NORMAL = 1.959964  # half of the 95 % interval of a normal distribution over its standard deviation
KINDS = ("shared", "own", "scatter", *RATES, "fixed")
Pair = tuple[float, float]
# Curves that a drive gives, but which it does not count: see `fitting.curves.default_weights`.
_UNCOUNTED = {
    "impact": ("stress_strain",),
    "stress": ("stress_time", "stress_strain"),
    "displacement": ("stress_time", "displacement_time"),
}


class HasContent(Protocol):
    """A result in memory."""

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
    local: float | None = None  # As `stderr`, also where the test does not determine it
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
    def error(self) -> float | None:
        """Its standard error, that of the local covariance where it is not determined."""
        return self.stderr or self.local

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
    misses: dict[str, tuple[Miss, ...]]  # Of the fitted tests, by channel
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
        return _source(_Item(load_result(_file(Path(result))), str(result)))
    if not hasattr(result, "to_json_dict"):
        told = f"not from a {type(result).__name__}"
        raise InputError(f"a prediction is made from a result of fit or joint or its path, {told}")
    content = result.to_json_dict()
    where = content.get("test") or content.get("name") or "the result"
    return _source(_Item(content, str(where)))


def _file(path: Path) -> Path:
    """The file of a result: joint.json before fit.json in a folder."""
    if not path.is_dir():
        return path
    if (path / "joint.json").is_file():
        return path / "joint.json"
    if not (path / "fit.json").is_file() and (path / "cycles.json").is_file():
        raise InputError(f"{path} holds the fits of several cycles; name one, as {path}/cycle-1")
    return path / "fit.json"


@dataclass(frozen=True)
class _Item:
    """An object of a JSON file, and what messages call it."""

    content: Any
    where: str

    def get(self, key: str) -> Any:
        """Value of a key; None if the item is no object, or does not have it."""
        return self.content.get(key) if isinstance(self.content, Mapping) else None

    def item(self, key: str) -> _Item:
        """What stands under a key."""
        return _Item(self.get(key), f"{self.where}: {key}")

    def items(self, key: str) -> dict[str, _Item]:
        """The items of an object that must be there."""
        found = self.get(key)
        if not isinstance(found, Mapping):
            raise InputError(f"{self.where} has no object '{key}', which a prediction needs")
        return {name: _Item(value, f"{self.where}: {name}") for name, value in found.items()}

    @property
    def number(self) -> float:
        """The item as a finite number."""
        value = self.content
        known = isinstance(value, int | float) and not isinstance(value, bool)
        if not (known and math.isfinite(value)):
            raise InputError(f"{self.where} is {value!r}; it must be a number")
        return float(value)

    @property
    def maybe(self) -> float | None:
        """The item as a number, if there is one."""
        return None if self.content is None else self.number

    @property
    def error(self) -> float | None:
        """The item as a standard error; None if there is none, or it is zero."""
        if (number := self.maybe or 0.0) < 0.0:
            raise InputError(f"{self.where} is {self.content!r}; it must not be negative")
        return number or None

    @property
    def pair(self) -> Pair | None:
        """The item as the ends of an interval; None if there is none, or a side is open."""
        if self.content is None:
            return None
        if not isinstance(self.content, list | tuple) or len(self.content) != 2:
            raise InputError(f"{self.where} is {self.content!r}; it must be two numbers")
        low, high = (_Item(end, self.where).maybe for end in self.content)
        return None if low is None or high is None else (low, high)


def _source(given: _Item) -> Source:
    """What the content of fit.json or joint.json says."""
    where, content = given.where, given.content
    if not isinstance(content.get("parameters"), Mapping) or "model" not in content:
        raise InputError(f"{where} is not the result of a fit or joint fit (fit.json, joint.json)")
    joint, drive = "tests" in content, content.get("drive")
    try:
        model = Model.of_result(content)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if drive not in (*DRIVES, None) or (drive is None and not joint):
        raise InputError(f"{where}: drive is {drive!r}; it must be one of {', '.join(DRIVES)}")
    tests = given.items("tests") if joint else {"": given}
    rates = {
        name: (one if joint else one.item("data")).item("rate").maybe for name, one in tests.items()
    }
    parameters = _parameters(given, model, joint, rates)
    key = "covariance" if joint else "correlation"
    names, correlation = _correlation(given, key, "matrix", parameters)
    changing, together = _correlation(given, "specimens", "correlation", parameters)
    noise = given.items("noise") if content.get("noise") else {}
    return Source(
        name=str(content.get("name" if joint else "test") or where),
        where=where,
        joint=joint,
        model=model,
        drive=drive,
        interior_mass=bool(content.get("interior_mass", False)),
        status=str(content.get("status")),
        rates=tuple(rate for rate in rates.values() if rate),
        rate0=given.item("rate0").maybe,
        parameters=parameters,
        names=names,
        correlation=correlation,
        misses=_misses(list(tests.values())),
        time_shift=TIME_SHIFT in content["parameters"],
        changing=changing,
        together=together,
        sha256=content.get("data_sha256"),
        smoothed=next((one.get("motion_smoothed") for one in noise.values()), None),
        last_cycle=given.item("data").item("last_cycle").maybe,
        growth=given.item("statistics").item("cycle_growth").maybe or 0.0,
    )


def _parameters(
    given: _Item, model: Model, joint: bool, rates: Mapping[str, float | None]
) -> dict[str, Identified]:
    """The parameters of the springs: nuisance parameters are those of one record."""
    told = given.item("correlation")
    errors = dict(zip(told.get("names") or (), told.get("stderr") or (), strict=False))
    found = {
        name: _parameter(item, _Item(errors.get(name), item.where).error, joint, rates)
        for name, item in given.items("parameters").items()
        if name not in NUISANCE
    }
    needed = (name for name in model.names if split_name(name)[1] != "eta")
    if lost := [name for name in needed if name not in found]:
        raise InputError(f"{given.where} has no parameter {lost[0]} of its model {model.name}")
    if unknown := [name for name in found if name not in model.names]:
        raise InputError(f"{given.where}: {unknown[0]} is no parameter of its model {model.name}")
    return {name: Identified("fixed", 0.0) for name in model.names} | found


def _parameter(
    item: _Item, local: float | None, joint: bool, rates: Mapping[str, float | None]
) -> Identified:
    """One parameter of fit.json or joint.json; `rates` are those of the tests."""
    if not isinstance(item.content, Mapping):
        raise InputError(f"{item.where} is {item.content!r}; it must be an object with a value")
    kind = item.get("kind") if joint else "shared" if item.get("vary") else "fixed"
    if kind not in KINDS:
        raise InputError(f"{item.where}: kind is {kind!r}; it must be one of {', '.join(KINDS)}")
    tests = dict[str, _Item]()
    if kind in ("own", "scatter"):
        tests = item.items("tests")
        # the spread is that of the tests that determine it
        sure = {name: one for name, one in tests.items() if one.get("stderr") is not None}
        tests = sure if kind == "scatter" and len(sure) > 1 else tests
    return Identified(
        kind,
        item.item("value").number,
        item.item("stderr").error,
        local,
        item.item("ci95").pair,
        item.item("range").pair,
        item.get("state"),
        item.item("b").number if kind in RATES else 0.0,
        item.item("b_stderr").error,
        item.item("b_ci95").pair,
        item.item("scatter").number if kind == "scatter" else 0.0,
        tuple(one.item("value").number for one in tests.values()),
        tuple(rates.get(name) for name in tests),
    )


def _correlation(
    given: _Item, key: str, of: str, parameters: Mapping[str, Identified]
) -> tuple[tuple[str, ...], Array]:
    """Correlation of the parameters that are named, from that or a covariance; 0 if unknown."""
    if given.get(key) is None:
        return (), np.empty((0, 0))
    given.items(key)  # refuses what is no object
    names = given.item(key).get("names")
    names = names if isinstance(names, list) else [None]
    known = {*parameters, *NUISANCE}
    try:
        matrix = np.reshape(np.array(given.item(key).get(of), dtype=float), (len(names),) * 2)
        there = all(str(name).removesuffix(":b") in known for name in names)
    except (TypeError, ValueError):
        there = False
    if not there:
        raise InputError(
            f"{given.where}: {key} must have the names of parameters and a square matrix of as "
            "many rows"
        )
    kept = [i for i, name in enumerate(names) if name not in NUISANCE]
    matrix = matrix[np.ix_(kept, kept)]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.diag(matrix))
        matrix = matrix / np.outer(scale, scale)
    matrix = np.clip(np.nan_to_num(matrix, posinf=0.0, neginf=0.0), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return tuple(names[i] for i in kept), 0.5 * (matrix + matrix.T)


def _misses(tests: list[_Item]) -> dict[str, tuple[Miss, ...]]:
    """By how much the counted curves of each channel were missed, test by test."""
    found = dict[str, list[Miss]]()
    for test in tests:
        misfits = test.items("misfit") if test.get("misfit") else {}
        for curve, misfit in misfits.items():
            if misfit.content is None or curve in _UNCOUNTED.get(str(test.get("drive")), ()):
                continue
            noise, share, most = test.item("noise").item(curve), None, 0.0
            if noise.get("range"):
                share = noise.item("sigma").number / noise.item("range").number
                most = (noise.item("residual_q95").maybe or 0.0) / noise.item("range").number
            channel = "stress" if curve.startswith("stress") else curve.removesuffix("_time")
            found.setdefault(channel, []).append(Miss(misfit.number, share, most))
    return {channel: tuple(each) for channel, each in found.items()}
