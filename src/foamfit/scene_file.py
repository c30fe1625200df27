"""Scene files: a chain and a drive, read for `foamfit simulate`, and the CSV of the response."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from foamfit.arrays import Array
from foamfit.data.csv_file import read_history
from foamfit.data.toml_file import check_keys, load_toml
from foamfit.data.units import parse_quantity
from foamfit.errors import InputError
from foamfit.files import csv_bytes, read_whole, write_file
from foamfit.solve.simulation import Response
from foamfit.springs import laws
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.laws.record import COMMON, Param
from foamfit.springs.published import published
from foamfit.springs.spring import Spring

Made = TypeVar("Made")

_UNITS = {  # SI unit and example of each key that is not a parameter of a spring
    "mass": ("kg", "7 g"),
    "velocity": ("m/s", "1.75 m/s"),
    "gravity": ("m/s**2", "9.81 m/s^2"),
    "diameter": ("m", "5 mm"),
    "area": ("m**2", "19.6 mm^2"),
    "site_damping": ("Pa*s", "0 Pa*s"),
    "end": ("s", "1 ms"),
}
_MOST_SAMPLES = 1_000_000
# First columns of the CSV of a response.
RESPONSE = "time (s),base stress (Pa),strain"


@dataclass(frozen=True)
class _Part:
    """A table of the scene file, and its place for messages."""

    where: str
    table: dict[str, Any]

    def only(self, *keys: str) -> _Part:
        """Reject all other keys."""
        check_keys(self.where, self.table, list(keys))
        return self

    def number(self, key: str, param: Param | None = None, default: float | None = None) -> float:
        """Return a quantity in SI units; InputError if it is missing and has no default."""
        if key not in self.table and default is not None:
            return default
        if param is None:
            unit, example = _UNITS[key]
        else:
            unit, example = param.unit.replace(" ", "*"), param.example or f"1 {param.unit}".strip()
        if key not in self.table:
            right = example if unit == "" else f'"{example}"'
            raise InputError(f"{self.where} {key} is missing; give it like {key} = {right}.")
        value = self.table[key]
        if unit == "" and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        return parse_quantity(value, unit, f"{self.where} {key}", example)

    def made(self, make: Callable[..., Made], *given: Any, **named: Any) -> Made:
        """Call `make`; an InputError names the place in the file."""
        try:
            return make(*given, **named)
        except InputError as error:
            raise InputError(f"{self.where} {error}.") from None

    def parts(self, key: str, name: str, wrong: str) -> list[_Part]:
        """Return the tables of a list, numbered from 1; InputError if it is not a list."""
        given = self.table.get(key, [])
        if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
            raise InputError(f"{self.where} {wrong}.")
        return [_Part(f"{self.where} {name} {i}:", one) for i, one in enumerate(given, start=1)]


def read_scene(path: Path) -> tuple[Chain, Drive, Array]:
    """Read chain, drive and sample times (s); `foamfit simulate --help` lists the keys."""
    document = load_toml(path, "give the TOML file of a scene")
    check_keys(f"{path}:", document, ["chain", "drive", "time"])
    return _chain(_table(path, document, "chain")), *_drive(path, document)


def files_of_scene(path: Path) -> tuple[Path, ...]:
    """Return the path of the scene file and, if it names one, of the file of its drive."""
    drive = load_toml(path, "give the TOML file of a scene").get("drive")
    file = drive.get("file") if isinstance(drive, dict) else None
    return (path, path.parent / file) if isinstance(file, str) else (path,)


def _table(path: Path, document: dict[str, Any], name: str) -> _Part:
    table = document.get(name)
    if not isinstance(table, dict):
        raise InputError(f"{path}: the table [{name}] is missing; see foamfit simulate --help.")
    return _Part(f"{path}: [{name}]", table)


def _chain(given: _Part) -> Chain:
    where, table = given.where, given.table
    if "published" in table:
        name = given.only("published").table["published"]
        if not isinstance(name, str) or name not in published:
            raise InputError(f"{where} published = {name!r}; it may be {', '.join(published)}.")
        return published[name].chain
    given.only("area", "diameter", "springs", "site_damping")
    if "diameter" in table and "area" in table:
        raise InputError(f"{where} has both a diameter and an area; give one of them.")
    if "diameter" in table:
        area = math.pi / 4.0 * given.number("diameter") ** 2
    else:
        area = given.number("area")
    wrong = "needs springs, each under [[chain.springs]], base first"
    parts = given.parts("springs", "spring", wrong)
    if not parts:
        raise InputError(f"{where} {wrong}.")
    springs = [_spring(part) for part in parts]
    heights = [part.number("height", COMMON["height"]) for part in parts]
    masses = [part.number("mass", default=0.0) for part in parts]
    site = given.number("site_damping", default=0.0)
    return given.made(Chain, springs, heights, area, masses, site_damping=site)


def _spring(given: _Part) -> Spring:
    kind, known = given.table.get("kind"), laws.kinds()
    if kind not in known:
        raise InputError(f"{given.where} kind = {kind!r}; it must be one of {', '.join(known)}.")
    law = laws.law(kind)
    extra = max(law.options, key=len, default=())  # all parameters that options can free
    wide = laws.law(laws.with_options(kind, extra))
    law = wide if set(wide.own) - set(law.own) & set(given.table) else law
    terms = ["relaxation"] if law.hysteretic else []
    given.only("kind", "height", "mass", *law.names, *terms)
    values = [given.number(name, param, param.neutral) for name, param in law.by_name.items()]
    shown = given.table.get("relaxation")
    wrong = f'relaxation = {shown!r} must be a list of terms like [{{ g = 0.5, tau = "0.2 s" }}]'
    relaxation = [
        tuple(term.only("g", "tau").number(key, COMMON[key]) for key in ("g", "tau"))
        for term in given.parts("relaxation", "relaxation term", wrong)
    ]
    spring: Spring = given.made(law.make, values, relaxation)
    return spring


def _drive(path: Path, document: dict[str, Any]) -> tuple[Drive, Array]:
    given = _table(path, document, "drive")
    kind, file = given.table.get("kind"), given.table.get("file")
    if kind == "impact":
        given.only("kind", "mass", "velocity", "gravity")
        gravity = given.number("gravity", default=0.0)
        impact = given.made(Impact, given.number("mass"), given.number("velocity"), gravity)
        return impact, _samples(_table(path, document, "time"))
    if kind not in ("stress", "displacement"):
        choice = "it must be impact, stress or displacement"
        raise InputError(f"{given.where} kind = {kind!r}; {choice}.")
    given.only("kind", "file")
    if not isinstance(file, str):
        raise InputError(f'{given.where} file is missing; give a CSV like file = "drive.csv".')
    if "time" in document:
        raise InputError(f"{path}: [time] must be left out, the samples are those of the drive.")
    time, values = read_history(path.parent / file, kind)
    return (StressDrive(values) if kind == "stress" else DisplacementDrive(values)), time


def _samples(given: _Part) -> Array:
    end, samples = given.only("end", "samples").number("end"), given.table.get("samples", 501)
    if not 0.0 < end < math.inf:
        raise InputError(f"{given.where} end = {given.table['end']!r} must be positive.")
    if type(samples) is not int or not 2 <= samples <= _MOST_SAMPLES:
        limits = f"a whole number from 2 to {_MOST_SAMPLES}"
        raise InputError(f"{given.where} samples = {samples!r} must be {limits}.")
    return np.linspace(0.0, end, samples)


def check_target(path: Path) -> None:
    """Raise InputError if the path is a file other than the response of an earlier run."""
    if path.is_file() and not read_whole(path, len(RESPONSE)).startswith(RESPONSE.encode()):
        raise InputError(f"{path} exists and is not a response of foamfit; choose another name")


def write_response(response: Response, path: Path) -> None:
    """Write a response as CSV in SI units, one row per sample; an older file stays on failure."""
    nodes = range(1, len(response.displacement) + 1)
    header = [*RESPONSE.split(","), *(f"displacement_{i} (m)" for i in nodes)]
    columns = [response.time, response.base_stress, response.strain, *response.displacement]
    write_file(path, csv_bytes([header, *np.transpose(columns).tolist()]))
