"""Read and check the TOML of a test and convert its quantities to SI; its keys: docs/files.md.

A table of keys maps each key to its check: a function of the value and of its place in the file,
for messages, that returns the value to use or raises InputError.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from foamfit.data import units
from foamfit.data.measurement import GRAVITY, Entry, Noise, Specimen, Striker, Window, interior_node
from foamfit.errors import InputError, naming
from foamfit.files import read_whole, reason
from foamfit.terminal import printable

_LARGEST = 1_000_000  # characters of a TOML
LONGEST = 200  # characters of a name

Check = Callable[[Any, str], Any]


@dataclass(frozen=True)
class Rule:
    """Check of a value without a unit, and description of the valid values for messages."""

    valid: Callable[[Any], bool]
    right: str

    def __call__(self, value: Any, where: str) -> Any:
        """Return the value if it is valid."""
        if not self.valid(value):
            shown = repr(value) if len(repr(value)) <= LONGEST else f"{repr(value)[:LONGEST]} …"
            raise InputError(f"{where} = {shown} must be {self.right}.")
        return value


class Stated(NamedTuple):
    """A quantity in SI and its standard deviation, None if the file does not state it."""

    value: float
    sigma: float | None


@dataclass(frozen=True)
class Quantity:
    """Check of a quantity: its SI unit, an example, limits, and whether it may have a ±."""

    si: str
    example: str
    positive: bool = True
    uncertain: bool = False
    below: float = math.inf

    def __call__(self, value: Any, where: str) -> Any:
        """Return the quantity in SI."""
        given, sigma = (value, self.si, where, self.example), None
        if self.uncertain:
            number, sigma = units.parse_uncertain(*given, zero=not self.positive)
        else:
            number = units.parse_quantity(*given)
        self.check_limits(number, value, where)
        return Stated(number, sigma) if self.uncertain else number

    def check_limits(self, number: float, value: Any, where: str) -> None:
        """Raise InputError for a number that is not positive, or too large."""
        if (self.positive and number <= 0.0) or number >= self.below:
            wanted = "positive" if number <= 0.0 else f"between 0 and {self.below:g}"
            raise InputError(f'{where} = "{value}" must be {wanted}, like "{self.example}".')


class Span(Quantity):
    """Check of a range of positive quantities, like "0.5 to 6 m/s", or of a single one."""

    def __call__(self, value: Any, where: str) -> tuple[float, float]:
        """Return the ends in SI, in ascending order."""
        ends = value.split(" to ") if isinstance(value, str) else [value]
        first, last = (units.split_quantity(str(ends[i])) for i in (0, -1))
        if len(ends) == 2 and first and last and not first[1]:
            ends[0] = f"{ends[0]} {last[1]}"
        found = [units.parse_quantity(end, self.si, where, self.example) for end in ends]
        if len(found) > 2 or found[0] <= 0.0 or found != sorted(found):
            wanted = f'a range of positive values, like "{self.example}"'
            raise InputError(f'{where} = "{value}" must be {wanted}.')
        self.check_limits(found[-1], value, where)
        return found[0], found[-1]


@dataclass(frozen=True)
class Several:
    """Check of a list of at least one value; messages number each `item`, if that has a name."""

    each: Check
    right: str
    item: str = ""

    def __call__(self, value: Any, where: str) -> tuple[Any, ...]:
        """Return the checked values."""
        if not isinstance(value, list) or not value:
            raise InputError(f"{where} must be a list {self.right}.")
        at = [f"{where} {self.item} {i}" if self.item else where for i, _ in enumerate(value, 1)]
        return tuple(map(self.each, value, at))


@dataclass(frozen=True)
class Table:
    """Check of a table within a table, as that of a channel."""

    keys: Mapping[str, Check]
    right: str
    needed: tuple[str, ...] = ()

    def __call__(self, value: Any, where: str) -> dict[str, Any]:
        """Return the checked values by key."""
        if not isinstance(value, dict):
            raise InputError(f"{where} must be like {self.right}.")
        return checked(value, self.keys, f"{where}:", self.needed)


def anything(value: Any, where: str) -> Any:
    """Return a value that is checked elsewhere."""
    return value


COUNT = Rule(lambda v: type(v) is int and v > 0, "a whole number from 1 up")
RANGE = Rule(
    lambda v: isinstance(v, tuple | list) and len(v) == 2 and all(map(COUNT.valid, v)),
    "the numbers of the first and the last one, like [1, 3]",
)
FLAG = Rule(lambda v: type(v) is bool, "true or false")


def read_bytes(path: Path, otherwise: str) -> bytes:
    """Read a file; `otherwise` ends the message of an error with what would be right."""
    try:
        return read_whole(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {otherwise}.") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise InputError(f"{path}: cannot be read ({reason(error)}); {otherwise}.") from None


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
            near = difflib.get_close_matches(key, valid, n=2)
            meant = f"did you mean {' or '.join(map(repr, near))}?"
            remedy = meant if near else f"its keys are {', '.join(valid)}."
            raise InputError(f"{where} has no key {key!r}; {remedy}")


def table_of(document: Mapping[str, Any], name: str, within: str = "") -> dict[str, Any]:
    """Return a table of a document, empty if it is missing."""
    table = document.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{within}{name} must be a table, [{within}{name}].")
    return table


def checked_tables(
    document: Mapping[str, Any], tables: Mapping[str, Mapping[str, Check]]
) -> dict[str, dict[str, Any]]:
    """Return the checked values of the tables of a document, by table and key."""
    return {name: checked(table_of(document, name), tables[name], f"[{name}]") for name in tables}


def checked(
    table: Mapping[str, Any], keys: Mapping[str, Check], where: str, needed: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the checked values of a table by key; keys that are not `needed` may be missing."""
    check_keys(where.removesuffix(":"), table, keys)
    for key in (key for key in needed if key not in table):
        check = keys[key]
        remedy = f"it must be {getattr(check, 'right', '')}"
        if isinstance(check, Quantity):
            example = f'"{check.example}"' if check.si else check.example
            remedy = f"give it like {key} = {example}"
        raise InputError(f"{where} {key} is missing; {remedy}.")
    return {key: keys[key](value, f"{where} {key}") for key, value in table.items()}


_FILE = Rule(
    lambda v: isinstance(v, str) and v.strip() != "" and "\0" not in v, 'a file, like "camera.csv"'
)
NOISE: dict[str, Check] = {
    "stress": Quantity("Pa", "20 kPa"),
    "displacement": Quantity("m", "2 um"),
}
_stated = partial(Quantity, uncertain=True)
_SECTIONS: dict[str, dict[str, Check]] = {
    "specimen": {
        "height": _stated("m", "1.19 mm"),
        "diameter": _stated("m", "5 mm"),
        "area": _stated("m**2", "19.6 mm^2"),
        "mass": _stated("kg", "5.56 mg"),
        "heights": Several(_stated("m", "0.7 mm"), 'like ["0.700 mm", "0.490 mm"], base first'),
    },
    "striker": {
        "mass": _stated("kg", "7 g"),
        "velocity": _stated("m/s", "1.75 m/s"),
        "gravity": FLAG,
    },
    "noise": NOISE,
    "window": {
        "start": Quantity("s", "0.5 ms", positive=False),
        "end": Quantity("s", "2 ms", positive=False),
        "cycle": COUNT,
        "cycles": RANGE,
    },
    "data": {
        "duplicates": Rule(lambda v: v in ("average", "refuse"), "one of average, refuse"),
        "sheet": Rule(lambda v: isinstance(v, str), 'a name, like "Sheet1"'),
    },
    "motion": {
        "file": _FILE,
        "delay": _stated("s", "0 ± 50 us", positive=False),
        "columns": anything,
    },
}
_NAME = Rule(
    lambda v: isinstance(v, str) and v.strip() != "" and v.isprintable() and len(v) <= LONGEST,
    f"a printable text of {LONGEST} characters at most, in quotation marks",
)
_PRIOR = Rule(lambda v: isinstance(v, str), 'like "5.5 ± 0.1 MPa"')
_SCALE = "4444.4 N/V"
# Keys of TOML files that may lie beside a test with their name
_OTHERS = {"tests": "a study of several tests", "chain": "a scene", "machine": "a rig"}
# Channels of a [motion] file, in addition to displacements of interior masses.
MOTION_CHANNELS = "time", "displacement", "strain"


@dataclass(frozen=True)
class Motion:
    """A motion with its own clock: time of the force = time of the motion + `delay`, s."""

    file: Path
    columns: dict[str, Entry]
    delay: float = 0.0


@dataclass(frozen=True)
class Settings:
    """Contents of the TOML in SI; `uncertainties` as in `Measurement`, without the scales."""

    name: str
    specimen: Specimen
    striker: Striker | None
    noise: Noise
    window: Window
    columns: dict[str, Entry] = field(default_factory=dict)
    duplicates: str = "average"
    sheet: str | None = None
    uncertainties: dict[str, float] = field(default_factory=dict)
    motion: Motion | None = None
    priors: dict[str, str] = field(default_factory=dict)


def read_settings(path: Path, test: Path, *, channels: Iterable[str]) -> Settings:
    """Read and check the TOML at `path` that describes the file `test`.

    [columns] may contain `channels`, displacement_1, displacement_2, … InputError names the file
    and the invalid or missing key.
    """
    document = load_toml(path, f"{test.name} needs a TOML with [specimen] height and diameter")
    tables = dict.fromkeys(["columns", "motion", "priors", *_SECTIONS])
    for what in (what for key, what in _OTHERS.items() if key in document):
        remedy = "rename one of them, or give the other TOML by --specimen"
        raise InputError(f"{path}: is {what}, not the TOML of {test.name}; {remedy}.")
    check_keys(f"{path}:", document, ["name", *tables])
    with naming(path):
        values, spreads = _split(checked_tables(document, _SECTIONS))
        window, striker, priors = values["window"], values["striker"], table_of(document, "priors")
        if {"cycle", "cycles"} <= window.keys():
            raise InputError("[window] has both cycle and cycles; give one of them.")
        if "cycles" in window:
            window["cycle"], window["last"] = window.pop("cycles")
        if "gravity" in striker:
            striker["gravity"] = GRAVITY if striker["gravity"] else 0.0
        return Settings(
            name=_NAME(document.get("name", printable(toml_beside(test).stem)), "name"),
            specimen=_specimen(values["specimen"], spreads), uncertainties=spreads,
            striker=Striker(**striker) if striker else None,
            noise=Noise(**values["noise"]), window=Window(**window), **values["data"],
            columns=_columns(table_of(document, "columns"), channels),
            motion=_motion(path, values["motion"]) if "motion" in document else None,
            # Its keys depend on the model; the fit checks them.
            priors={key: _PRIOR(value, f"[priors] {key}") for key, value in priors.items()},
        )  # fmt: skip


def _split(tables: dict[str, dict[str, Any]]) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """Separate the values of the tables from the standard deviations."""
    spreads = dict[str, float | None]()

    def value(found: Any, section: str, key: str) -> Any:
        if isinstance(found, Stated):
            spreads[f"{section}_mass" if key == "mass" else key] = found.sigma
            return found.value
        if key == "heights":
            return tuple(value(one, section, f"height_{i}") for i, one in enumerate(found, 1))
        return found

    values = {s: {k: value(v, s, k) for k, v in table.items()} for s, table in tables.items()}
    return values, {name: sigma for name, sigma in spreads.items() if sigma}


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


def toml_beside(test: Path) -> Path:
    """Return the path of the TOML next to a test file: a.toml for a.csv or a.csv.gz."""
    plain = test.with_suffix("") if test.suffix.lower() == ".gz" else test
    return plain.parent / f"{plain.stem}.toml"


def motion_file(toml: Path) -> Path | None:
    """Return the file named in [motion]; None if none is named or the TOML cannot be read."""
    try:
        table = load_toml(toml, "").get("motion")
        return toml.parent / _FILE(table["file"], "") if isinstance(table, dict) else None
    except (InputError, KeyError):  # `read_settings` reports the error
        return None


def _motion(path: Path, values: dict[str, Any]) -> Motion:
    if "file" not in values:
        raise InputError(f"[motion] file is missing; it must be {_FILE.right}.")
    columns = _columns(table_of(values, "columns", "motion."), MOTION_CHANNELS, "motion.columns")
    return Motion(path.parent / values["file"], columns, values.get("delay", 0.0))


def _scale(value: Any, where: str) -> tuple[float, str, float | None]:
    """Return number, unit and standard deviation of a scale, such as "4444.4 ± 5 N/V"."""
    text = str(value)
    parts = units.split_quantity(units.split_uncertain(text)[0])
    if parts is None or parts[0] in (0.0, math.inf, -math.inf) or not units.is_unit(parts[1]):
        raise InputError(f'{where} = {value!r} must be like -1 or "{_SCALE}".')
    return *parts, units.parse_uncertain(text, parts[1], where, _SCALE)[1]


_COLUMN: dict[str, Check] = {
    "column": Rule(
        lambda v: isinstance(v, str) or (type(v) is int and v > 0),
        'a header or a number, like column = "Load" or column = 2',
    ),
    "unit": Rule(
        lambda v: isinstance(v, str) and units.is_unit(v), 'a known unit, like unit = "mm"'
    ),
    "scale": _scale,
    "counts_down": FLAG,
}


def _columns(
    table: dict[str, Any], channels: Iterable[str], name: str = "columns"
) -> dict[str, Entry]:
    check_keys(f"[{name}]", table, [*channels, *filter(interior_node, table)])
    columns: dict[str, Entry] = {}
    right = '{ column = "Load", unit = "V" }, or with a number, column = 2'
    for channel, entry in table.items():
        where, inside = f"[{name}] {channel}", interior_node(channel) is not None
        down = inside or channel == "displacement"
        keys = _COLUMN if down else {key: _COLUMN[key] for key in ("column", "unit", "scale")}
        found = Table(keys, right, ("column",))(entry, where)
        number, unit, sigma = found.pop("scale", (1.0, "", None))
        if sigma is not None and (inside or channel in ("time", "cycle")):
            units.parse_quantity(entry["scale"], unit, f"{where}: scale", _SCALE)  # refuses the ±
        spread = (sigma or 0.0) / abs(number)
        columns[channel] = Entry(channel, **found, scale=number, scale_unit=unit, spread=spread)
    return columns
