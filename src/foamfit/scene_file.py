"""A scene file: any chain under any drive, for the forward run of the command."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from foamfit.arrays import Array
from foamfit.data.csv_file import read_history
from foamfit.data.toml_file import check_keys, load_toml
from foamfit.data.units import parse_quantity
from foamfit.errors import InputError
from foamfit.files import write_file
from foamfit.solve.simulation import Response
from foamfit.springs import laws
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.parameters import any_param
from foamfit.springs.published import published
from foamfit.springs.spring import Spring

Made = TypeVar("Made")

_EXAMPLES = {  # key: SI unit and an example, of what is no parameter of a spring
    "mass": ("kg", "7 g"),
    "velocity": ("m/s", "1.75 m/s"),
    "diameter": ("m", "5 mm"),
    "area": ("m**2", "19.6 mm^2"),
    "site_damping": ("Pa*s", "0 Pa*s"),
    "end": ("s", "1 ms"),
}
_MOST_SAMPLES = 1_000_000
# What the table of a response begins with.
RESPONSE = "time (s),base stress (Pa),strain"


def read_scene(path: Path) -> tuple[Chain, Drive, Array]:
    """Read chain, drive and samples (s) of a scene; see `foamfit simulate --help` for the keys."""
    document = load_toml(path, "give the TOML file of a scene")
    check_keys(f"{path}:", document, ["chain", "drive", "time"])
    chain = _chain(f"{path}: [chain]", _table(path, document, "chain"))
    return chain, *_drive(path, document)


def files_of_scene(path: Path) -> tuple[Path, ...]:
    """Files that a scene is read from: itself and that of its drive, if it names one."""
    drive = load_toml(path, "give the TOML file of a scene").get("drive")
    file = drive.get("file") if isinstance(drive, dict) else None
    return (path, path.parent / file) if isinstance(file, str) else (path,)


def _table(path: Path, document: dict[str, Any], name: str) -> dict[str, Any]:
    table = document.get(name)
    if not isinstance(table, dict):
        raise InputError(f"{path}: the table [{name}] is missing; see foamfit simulate --help.")
    return table


def _number(where: str, table: dict[str, Any], key: str) -> float:
    unit, example = _EXAMPLES.get(key) or _example(key)
    if key not in table:
        right = example if unit == "" else f'"{example}"'
        raise InputError(f"{where} {key} is missing; give it like {key} = {right}.")
    value = table[key]
    if unit == "" and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return parse_quantity(value, unit, f"{where} {key}", example)


def _example(key: str) -> tuple[str, str]:
    """Unit and example of a parameter of springs."""
    param = any_param(key)
    return param.unit.replace(" ", "*"), param.example or f"1 {param.unit}".strip()


def _chain(where: str, table: dict[str, Any]) -> Chain:
    if "published" in table:
        check_keys(where, table, ["published"])
        name = table["published"]
        if not isinstance(name, str) or name not in published:
            raise InputError(f"{where} published = {name!r}; it may be {', '.join(published)}.")
        return published[name].chain
    check_keys(where, table, ["area", "diameter", "springs", "site_damping"])
    if "diameter" in table and "area" in table:
        raise InputError(f"{where} has both a diameter and an area; give one of them.")
    if "diameter" in table:
        area = math.pi / 4.0 * _number(where, table, "diameter") ** 2
    else:
        area = _number(where, table, "area")
    given = table.get("springs")
    if not isinstance(given, list) or not given or not all(isinstance(g, dict) for g in given):
        raise InputError(f"{where} needs springs, each under [[chain.springs]], base first.")
    springs, heights, masses = [], [], []
    for i, item in enumerate(given, start=1):
        here = f"{where} spring {i}:"
        springs.append(_spring(here, item))
        heights.append(_number(here, item, "height"))
        masses.append(_number(here, item, "mass") if "mass" in item else 0.0)
    site = _number(where, table, "site_damping") if "site_damping" in table else 0.0
    return _made(where, Chain, springs, heights, area, masses, site_damping=site)


def _made(where: str, make: Callable[..., Made], *given: Any, **named: Any) -> Made:
    """Make a part of the scene; a refusal names where its numbers stand."""
    try:
        return make(*given, **named)
    except InputError as error:
        raise InputError(f"{where} {error}.") from None


def _spring(where: str, given: dict[str, Any]) -> Spring:
    kind = given.get("kind")
    if kind not in laws.kinds():
        raise InputError(f"{where} kind = {kind!r}; it must be one of {', '.join(laws.kinds())}.")
    law = laws.law(kind)
    more = ["relaxation"] if law.hysteretic else []
    check_keys(where, given, ["kind", "height", "mass", *law.names, *more])
    values = [
        _number(where, given, name) if name != "eta" or name in given else 0.0 for name in law.names
    ]
    terms = _relaxation(where, given.get("relaxation", []))
    spring: Spring = _made(where, law.make, values, terms)
    return spring


def _relaxation(where: str, given: Any) -> list[tuple[float, float]]:
    """Read the relaxation terms of a spring, tables with g and tau."""
    if not isinstance(given, list) or not all(isinstance(term, dict) for term in given):
        raise InputError(
            f"{where} relaxation = {given!r} must be a list of terms like "
            '[{ g = 0.5, tau = "0.2 s" }].'
        )
    terms = []
    for k, term in enumerate(given, start=1):
        here = f"{where} relaxation term {k}:"
        check_keys(here, term, ["g", "tau"])
        terms.append((_number(here, term, "g"), _number(here, term, "tau")))
    return terms


def _drive(path: Path, document: dict[str, Any]) -> tuple[Drive, Array]:
    table = _table(path, document, "drive")
    where = f"{path}: [drive]"
    kind = table.get("kind")
    if kind == "impact":
        check_keys(where, table, ["kind", "mass", "velocity"])
        given = (_number(where, table, key) for key in ("mass", "velocity"))
        return _made(where, Impact, *given), _samples(path, document)
    if kind not in ("stress", "displacement"):
        raise InputError(f"{where} kind = {kind!r}; it must be impact, stress or displacement.")
    check_keys(where, table, ["kind", "file"])
    if not isinstance(table.get("file"), str):
        raise InputError(f'{where} file is missing; give a CSV like file = "drive.csv".')
    if "time" in document:
        raise InputError(f"{path}: [time] must be left out, the samples are those of the drive.")
    time, values = read_history(path.parent / table["file"], kind)
    return (StressDrive(values) if kind == "stress" else DisplacementDrive(values)), time


def _samples(path: Path, document: dict[str, Any]) -> Array:
    table = _table(path, document, "time")
    where = f"{path}: [time]"
    check_keys(where, table, ["end", "samples"])
    end = _number(where, table, "end")
    if not 0.0 < end < math.inf:
        raise InputError(f"{where} end = {table['end']!r} must be positive.")
    samples = table.get("samples", 501)
    if type(samples) is not int or not 2 <= samples <= _MOST_SAMPLES:
        raise InputError(
            f"{where} samples = {samples!r} must be a whole number from 2 to {_MOST_SAMPLES}."
        )
    return np.linspace(0.0, end, samples)


def write_response(response: Response, path: Path) -> None:
    """Write a response as CSV, SI, one row per sample; what stood there stays if that fails."""
    nodes = range(1, len(response.displacement) + 1)
    header = [RESPONSE, *(f"displacement_{i} (m)" for i in nodes)]
    columns = [response.time, response.base_stress, response.strain, *response.displacement]
    text = io.StringIO()
    np.savetxt(text, np.transpose(columns), "%s", ",", header=",".join(header), comments="")
    write_file(path, text.getvalue().encode())
