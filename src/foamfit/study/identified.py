"""The law and parameters of a result, read from fit.json or joint.json.

For a result in memory the content of its file is used, so that both give the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.codec import build
from foamfit.errors import InputError
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.options import DRIVES, KINDS, RATES
from foamfit.parts import ParameterEstimate
from foamfit.report.folder import Result, load_result
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name

NORMAL = 1.959964  # half the 95 % interval of a normal distribution, in standard deviations


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
    # Names of uncertain parameters and slopes of rate laws ("s1_k0:b"), and their correlation.
    names: tuple[str, ...]
    correlation: Array
    law_errors: dict[str, float]  # By channel, see `_law_errors`
    time_shift: bool  # Whether a time shift of the motion was fitted
    # Names of own and scattering parameters, and their correlation between specimens, if known.
    changing: tuple[str, ...]
    together: Array
    sha256: str | None  # Of the record of a fit of one test
    smoothed: bool | None  # Whether the drive was the smoothed motion
    # The number of the last fitted cycle, and `Fit.growth` of several fitted as one history.
    last_cycle: float | None
    growth: float


def read_source(result: Result | str | Path) -> Source:
    """Read a result in memory, in a folder, or in its fit.json or joint.json.

    Raises InputError if there is no result, or if it lacks something that a prediction needs.
    """
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
        rates=tuple(rate for test in tests if (rate := (test if joint else data).get("rate"))),
        rate0=content.get("rate0"),
        parameters=parameters,
        errors={name: error for name, error in errors.items() if error},
        names=names,
        correlation=correlation,
        law_errors=_law_errors(tests),
        time_shift=TIME_SHIFT in content["parameters"],
        changing=changing,
        together=together,
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


def _law_errors(tests: list[Mapping[str, Any]]) -> dict[str, float]:
    """Return half the 95 % band due to model error by channel, relative to the measured range.

    It is the part of the residuals of the fitted curves that their noise does not explain, RMS over
    the tests. Residuals that are mostly small but sometimes large are measured by their 95 %
    quantile.
    """
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
            square = max(NORMAL * misfit, most) ** 2 - (NORMAL * sigma) ** 2
            squares.setdefault(channel, []).append(max(square, 0.0))
    return {channel: math.sqrt(sum(each) / len(each)) for channel, each in squares.items()}
