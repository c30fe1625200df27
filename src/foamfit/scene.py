"""A scene file: any chain under any drive, for the forward run of the command."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.errors import InputError
from foamfit.literature import published
from foamfit.model import BISTABLE_NAMES, KINDS
from foamfit.reading import _parse_quantity as parse_quantity
from foamfit.simulation import Response
from foamfit.spring import BistableSpring, LinearSpring, Spring

Array = NDArray[np.float64]

_UNITS = {"eps_a": "", "eps_c": "", "eta": "Pa*s", "height": "m", "mass": "kg"}
_EXAMPLES = {"eps_a": "0.14", "eps_c": "0.31", "eta": "100 Pa*s", "height": "1 mm", "mass": "5 mg"}


def read_scene(path: Path) -> tuple[Chain, Drive, Array]:
    """Read a scene file; see `foamfit simulate --help` for its keys.

    Parameters
    ----------
    path : Path
        TOML with [chain], [drive] and, in an impact, [time].

    Returns
    -------
    tuple
        Chain, drive and samples (s).

    Raises
    ------
    InputError
        Naming the file and the key that is wrong.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give the TOML file of a scene") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is no valid TOML: {error}") from None
    _only(f"{path}", document, {"chain", "drive", "time"})
    try:
        chain = _chain(f"{path}: [chain]", _table(path, document, "chain"))
        drive, time = _drive(path, document)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return chain, drive, time


def _table(path: Path, document: dict[str, Any], name: str) -> dict[str, Any]:
    table = document.get(name)
    if not isinstance(table, dict):
        raise InputError(f"{path}: the table [{name}] is missing; see foamfit simulate --help")
    return table


def _only(where: str, table: dict[str, Any], known: set[str]) -> None:
    for key in table:
        if key not in known:
            raise InputError(f"{where} has no key '{key}'; it may have {', '.join(sorted(known))}")


def _number(where: str, table: dict[str, Any], key: str, unit: str, example: str) -> float:
    if key not in table:
        raise InputError(f'{where} {key} is missing; give it like {key} = "{example}"')
    value = table[key]
    if unit == "" and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return parse_quantity(value, unit, f"{where} {key}", example)


def _chain(where: str, table: dict[str, Any]) -> Chain:
    if "published" in table:
        _only(where, table, {"published"})
        if table["published"] not in published:
            raise InputError(f"{where} published must be one of {', '.join(published)}")
        return published[table["published"]].chain
    _only(where, table, {"area", "diameter", "springs", "site_damping"})
    if "diameter" in table:
        area = np.pi / 4.0 * _number(where, table, "diameter", "m", "5 mm") ** 2
    else:
        area = _number(where, table, "area", "m**2", "19.6 mm^2")
    springs, heights, masses = [], [], []
    for i, given in enumerate(table.get("springs", []), start=1):
        here = f"{where} spring {i}:"
        springs.append(_spring(here, given))
        heights.append(_number(here, given, "height", "m", "1 mm"))
        masses.append(_number(here, given, "mass", "kg", "5 mg") if "mass" in given else 0.0)
    site = _number(where, table, "site_damping", "Pa*s", "0 Pa*s") if "site_damping" in table else 0
    return Chain(springs, heights, area, masses, site_damping=site)


def _spring(where: str, given: dict[str, Any]) -> Spring:
    kind = given.get("kind")
    if kind not in KINDS:
        raise InputError(f"{where} kind = {kind!r}; it must be one of {', '.join(KINDS)}")
    names = BISTABLE_NAMES if kind == "bistable" else ("k0", "eta")
    _only(where, given, {"kind", "height", "mass", *names})
    values = {
        name: _number(where, given, name, _UNITS.get(name, "Pa"), _EXAMPLES.get(name, "1 MPa"))
        for name in names
        if name != "eta" or name in given
    }
    if kind == "bistable":
        return BistableSpring(**values)
    return LinearSpring(**values, unilateral=kind == "unilateral")


def _drive(path: Path, document: dict[str, Any]) -> tuple[Drive, Array]:
    table = _table(path, document, "drive")
    where = f"{path}: [drive]"
    kind = table.get("kind")
    if kind == "impact":
        _only(where, table, {"kind", "mass", "velocity"})
        mass = _number(where, table, "mass", "kg", "7 g")
        velocity = _number(where, table, "velocity", "m/s", "1.75 m/s")
        return Impact(mass, velocity), _samples(path, document)
    if kind not in ("stress", "displacement"):
        raise InputError(f"{where} kind = {kind!r}; it must be impact, stress or displacement")
    _only(where, table, {"kind", "file"})
    if "file" not in table:
        raise InputError(f"{where} file is missing; give a CSV with columns t (s) and {kind} (SI)")
    time, values = _history(path.parent / str(table["file"]))
    return (StressDrive(values) if kind == "stress" else DisplacementDrive(values)), time


def _samples(path: Path, document: dict[str, Any]) -> Array:
    table = _table(path, document, "time")
    where = f"{path}: [time]"
    _only(where, table, {"end", "samples"})
    end = _number(where, table, "end", "s", "1 ms")
    samples = table.get("samples", 501)
    if not isinstance(samples, int) or samples < 2 or not end > 0:
        raise InputError(f"{where} needs a positive end and at least 2 samples")
    return np.linspace(0.0, end, samples)


def _history(path: Path) -> tuple[Array, Array]:
    """Read the two columns of a drive, time (s) and stress (Pa) or displacement (m)."""
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a drive ({error})") from None
    if table.shape[1] != 2:
        raise InputError(f"{path}: has {table.shape[1]} columns; give time (s) and the drive (SI)")
    return table[:, 0], table[:, 1]


def write_response(response: Response, path: Path) -> None:
    """Write a response as CSV, SI, one row per sample.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    nodes = range(1, len(response.displacement) + 1)
    header = ["time (s)", "base stress (Pa)", "strain", *(f"displacement_{i} (m)" for i in nodes)]
    columns = [response.time, response.base_stress, response.strain, *response.displacement]
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(zip(*(column.tolist() for column in columns), strict=True))
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}") from None
