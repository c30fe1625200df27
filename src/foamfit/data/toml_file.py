"""Read and check the TOML of a test and convert its quantities to SI.

[columns] describes a channel that is not clear from its header: ``column`` (header or number),
``unit``, ``scale`` (a number, or a quantity such as "4444.4 N/V"; a negative one changes the sign)
and, for displacements, ``counts_down = true`` (a gap or a position that decreases in compression).
[data] ``duplicates`` is "average" (consecutive rows with the same time stamp become one sample) or
"refuse", ``sheet`` the name of a sheet in a workbook. A quantity may have a standard deviation,
"1.75 ± 0.01 m/s"; see `Measurement.uncertainties`. [motion] names a ``file``, relative to the TOML,
with its own clock, the ``delay`` of that clock, and in [motion.columns] its columns. [priors]
contains prior knowledge of parameters, "5.5 ± 0.1 MPa".
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from foamfit.data.measurement import GRAVITY, Noise, Specimen, Striker, Window, interior_node
from foamfit.data.units import (
    is_unit,
    parse_quantity,
    parse_uncertain,
    split_quantity,
    split_uncertain,
)
from foamfit.errors import InputError, naming
from foamfit.files import read_whole
from foamfit.terminal import printable

_LARGEST = 1_000_000  # characters of a TOML
LONGEST = 200  # characters of a name


class _Quantity(NamedTuple):
    """SI unit, an example, and the name of its ± in `Settings.uncertainties` ("": no ±)."""

    si: str
    example: str
    spread: str = ""


class Rule(NamedTuple):
    """Check of a value without a unit, and description of the valid values for messages."""

    valid: Callable[[Any], bool]
    right: str


def is_range(cycles: Any) -> bool:
    """Return whether a value is a pair of cycle numbers."""
    pair = isinstance(cycles, tuple | list) and len(cycles) == 2
    return pair and all(type(number) is int and number > 0 for number in cycles)


COUNT = Rule(lambda v: type(v) is int and v > 0, "a whole number from 1 up")
RANGE = Rule(is_range, "the numbers of the first and the last one, like [1, 3]")
FLAG = Rule(lambda v: type(v) is bool, "true or false")
_SECTIONS: dict[str, dict[str, _Quantity | Rule]] = {
    "specimen": {
        "height": _Quantity("m", "1.19 mm", "height"),
        "diameter": _Quantity("m", "5 mm", "diameter"),
        "area": _Quantity("m**2", "19.6 mm^2", "area"),
        "mass": _Quantity("kg", "5.56 mg", "specimen_mass"),
        "heights": _Quantity("m", "0.7 mm", "height"),
    },
    "striker": {
        "mass": _Quantity("kg", "7 g", "striker_mass"),
        "velocity": _Quantity("m/s", "1.75 m/s", "velocity"),
        "gravity": FLAG,
    },
    "noise": {"stress": _Quantity("Pa", "20 kPa"), "displacement": _Quantity("m", "2 um")},
    "window": {
        "start": _Quantity("s", "0.5 ms"),
        "end": _Quantity("s", "2 ms"),
        "cycle": COUNT,
        "cycles": RANGE,
    },
    "data": {
        "duplicates": Rule(lambda v: v in ("average", "refuse"), "one of average, refuse"),
        "sheet": Rule(lambda v: isinstance(v, str), 'a name, like "Sheet1"'),
    },
}
_SCALE = "4444.4 N/V"
# Channels of a [motion] file, in addition to displacements of interior masses.
MOTION_CHANNELS = "time", "displacement", "strain", "velocity"


@dataclass(frozen=True)
class Column:
    """Entry of [columns] for one channel: header or number (from 1), unit and scale.

    `spread` is the relative standard deviation of the scale; the values of a column that
    `counts_down` decrease in compression.
    """

    column: str | int
    unit: str | None = None
    scale: float = 1.0
    scale_unit: str = ""
    counts_down: bool = False
    spread: float = 0.0


@dataclass(frozen=True)
class Motion:
    """A motion with its own clock: time of the force = time of the motion + `delay`, s."""

    file: Path
    columns: dict[str, Column]
    delay: float = 0.0


@dataclass(frozen=True)
class Settings:
    """Contents of the TOML in SI; `uncertainties` as in `Measurement`, without the scales."""

    name: str
    specimen: Specimen
    striker: Striker | None
    noise: Noise
    window: Window
    columns: dict[str, Column] = field(default_factory=dict)
    duplicates: str = "average"
    sheet: str | None = None
    uncertainties: dict[str, float] = field(default_factory=dict)
    motion: Motion | None = None
    priors: dict[str, str] = field(default_factory=dict)


def toml_beside(test: Path) -> Path:
    """Return the path of the TOML next to a test file: a.toml for a.csv or a.csv.gz."""
    plain = test.with_suffix("") if test.suffix.lower() == ".gz" else test
    return plain.parent / f"{plain.stem}.toml"


def read_bytes(path: Path, otherwise: str) -> bytes:
    """Read a file; `otherwise` ends the message of an error with what would be right."""
    try:
        return read_whole(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {otherwise}.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {otherwise}.") from None


def load_toml(path: Path, otherwise: str) -> dict[str, Any]:
    """Load a TOML file; `otherwise` ends the message if the file is missing or unreadable."""
    raw = read_bytes(path, otherwise)
    if len(raw) > _LARGEST:
        raise InputError(f"{path}: has {len(raw)} characters; a TOML must have {_LARGEST} at most.")
    try:
        return tomllib.loads(raw.decode("utf-8-sig"))
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply; write a TOML of few levels.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; a TOML file must be.") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not valid TOML: {error}.") from None


def check_keys(where: str, given: Iterable[str], valid: Iterable[str]) -> None:
    """Raise InputError for an invalid key, and suggest similar valid ones."""
    valid = list(valid)
    for key in given:
        if key not in valid:
            key = key[:LONGEST]
            near = difflib.get_close_matches(key, valid, n=2, cutoff=0.4) or valid
            raise InputError(f"{where} has no key {key!r}; meant may be {', '.join(near)}.")


def read_settings(path: Path, test: Path, *, channels: Iterable[str]) -> Settings:
    """Read and check the TOML at `path` that describes the file `test`.

    [columns] may contain `channels`, displacement_1, displacement_2, … InputError names the file
    and the invalid or missing key.
    """
    document = load_toml(path, f"{test.name} needs a TOML with [specimen] height and diameter")
    check_keys(f"{path}:", document, ["name", "columns", "motion", "priors", *_SECTIONS])
    with naming(path):
        spreads: dict[str, float] = {}
        values: dict[str, dict[str, Any]] = {}
        for section, keys in _SECTIONS.items():
            table = _table(document, section)
            check_keys(f"[{section}]", table, keys)
            values[section] = {k: _value(section, k, v, spreads) for k, v in table.items()}
        name = document.get("name", printable(toml_beside(test).stem))
        if not (isinstance(name, str) and name.strip() and name.isprintable()):
            raise InputError(f"name = {name!r} must be a printable text in quotation marks.")
        if len(name) > LONGEST:
            raise InputError(f"name has {len(name)} characters; it must have {LONGEST} at most.")
        priors, window, striker = _table(document, "priors"), values["window"], values["striker"]
        for key, value in priors.items():  # the keys depend on the model; the fit checks them
            if not isinstance(value, str):
                raise InputError(f'[priors] {key} = {value!r} must be like "5.5 ± 0.1 MPa".')
        if {"cycle", "cycles"} <= window.keys():
            raise InputError("[window] has both cycle and cycles; give one of them.")
        if "cycles" in window:
            window["cycle"], window["last"] = window.pop("cycles")
        if "gravity" in striker:
            striker["gravity"] = GRAVITY if striker["gravity"] else 0.0
        return Settings(
            name=name,
            specimen=_specimen(values["specimen"], spreads),
            striker=Striker(**striker) if striker else None,
            noise=Noise(**values["noise"]),
            window=Window(**window),
            columns=_columns(_table(document, "columns"), channels),
            uncertainties=spreads,
            motion=_motion(path, document, spreads),
            priors=priors,
            **values["data"],
        )


def _table(document: dict[str, Any], name: str, within: str = "") -> dict[str, Any]:
    table = document.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{within}{name} must be a table, [{within}{name}].")
    return table


def _value(section: str, key: str, value: Any, spreads: dict[str, float]) -> Any:
    """Check a value and return it in SI; its ± is stored in `spreads`."""
    where, several, kind = f"[{section}] {key}", key == "heights", _SECTIONS[section][key]
    if isinstance(kind, Rule):
        if not kind.valid(value):
            raise InputError(f"{where} = {value!r} must be {kind.right}.")
        return value
    if several and (not isinstance(value, list) or not value):
        raise InputError(f'{where} must be a list like ["0.700 mm", "0.490 mm"], base first.')
    (si, example, spread), numbers = kind, []
    for i, v in enumerate(value if several else [value], 1):
        if spread:
            number, sigma = parse_uncertain(v, si, where, example)
            spreads |= {f"{spread}_{i}" if several else spread: sigma} if sigma else {}
        else:
            number = parse_quantity(v, si, where, example)
        if section != "window" and not 0.0 < number < math.inf:
            raise InputError(f'{where} = "{v}" must be positive.')
        numbers.append(number)
    return tuple(numbers) if several else numbers[0]


def _specimen(values: dict[str, Any], spreads: dict[str, float]) -> Specimen:
    size = 'a diameter = "5 mm" or an area = "19.6 mm^2"'
    if "height" not in values:
        raise InputError(f'[specimen] height is missing; give it like "1.19 mm", and {size}.')
    if not values.keys() & {"diameter", "area"}:
        raise InputError(f"[specimen] needs {size}.")
    diameter, spread = values.pop("diameter", None), spreads.pop("diameter", 0.0)
    if diameter is not None:
        area = math.pi * diameter**2 / 4
        if not math.isclose(values.setdefault("area", area), area, rel_tol=0.02):
            raise InputError("[specimen] area and diameter disagree; give one of them.")
        if spread:
            spreads.setdefault("area", 2.0 * values["area"] * spread / diameter)
    heights = values.get("heights")
    if heights and not math.isclose(sum(heights), values["height"], rel_tol=0.02):
        raise InputError("[specimen] heights must add up to height.")
    return Specimen(**values)


def motion_file(toml: Path) -> Path | None:
    """Return the file named in [motion]; None if none is named or the TOML cannot be read."""
    try:
        return _file(toml, load_toml(toml, "").get("motion"))
    except InputError:  # `read_settings` reports the error
        return None


def _file(toml: Path, table: Any) -> Path | None:
    """Resolve the file of the table [motion] relative to the TOML."""
    name = table.get("file") if isinstance(table, dict) else None
    named = isinstance(name, str) and name.strip() and "\0" not in name
    return toml.parent / str(name) if named else None


def _motion(path: Path, document: dict[str, Any], spreads: dict[str, float]) -> Motion | None:
    if "motion" not in document:
        return None
    table = document["motion"]
    file = _file(path, table)
    if isinstance(table, dict):
        check_keys("[motion]", table, ["file", "delay", "columns"])
    if file is None:
        raise InputError('[motion] must name a file, like file = "camera.csv".')
    columns = _columns(_table(table, "columns", "motion."), MOTION_CHANNELS, "motion.columns")
    given = table.get("delay", "0 s")
    delay, sigma = parse_uncertain(given, "s", "[motion] delay", "0 ± 50 us", zero=True)
    spreads |= {"delay": sigma} if sigma else {}
    return Motion(file, columns, delay)


def _columns(
    table: dict[str, Any], channels: Iterable[str], name: str = "columns"
) -> dict[str, Column]:
    check_keys(f"[{name}]", table, [*channels, *filter(interior_node, table)])
    columns: dict[str, Column] = {}
    for channel, spec in table.items():
        where, inside = f"[{name}] {channel}", interior_node(channel) is not None
        column = spec.get("column") if isinstance(spec, dict) else None
        if not (isinstance(column, str) or (type(column) is int and column > 0)):
            right = '{ column = "Load", unit = "V" }, or with a number, column = 2'
            raise InputError(f"{where} must be like {right}.")
        more = ["counts_down"] if inside or channel == "displacement" else []
        check_keys(where, spec, ["column", "unit", "scale", *more])
        down, unit, scale = (spec.get(key) for key in ("counts_down", "unit", "scale"))
        if not isinstance(down, bool | None):
            raise InputError(f"{where}: counts_down = {down!r} must be true or false.")
        if unit is not None and (not isinstance(unit, str) or not is_unit(unit)):
            raise InputError(f'{where}: unit = {unit!r} is unknown; give it like unit = "mm".')
        text = "1" if scale is None else str(scale)
        parts = split_quantity(split_uncertain(text)[0])
        if parts is None or parts[0] in (0.0, math.inf, -math.inf) or not is_unit(parts[1]):
            raise InputError(f'{where}: scale = {scale!r} must be like -1 or "{_SCALE}".')
        if inside or channel in ("time", "cycle"):  # a ± has no meaning there
            parse_quantity(text, parts[1], f"{where}: scale", _SCALE)
            sigma = 0.0
        else:
            sigma = parse_uncertain(text, parts[1], f"{where}: scale", _SCALE)[1] or 0.0
        columns[channel] = Column(column, unit, *parts, bool(down), sigma / abs(parts[0]))
    return columns
