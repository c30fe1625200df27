"""What a result says of a law: read from fit.json or joint.json.

A result in memory is read by the content of its file, so that both give the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from foamfit.arrays import Array
from foamfit.codec import build
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
        raise InputError(f"{path} holds the fits of several cycles; name one, as {path}/cycle-1")
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
