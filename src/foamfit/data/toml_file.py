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

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from foamfit.data.checks import (
    COUNT,
    FLAG,
    LONGEST,
    RANGE,
    Check,
    Quantity,
    Rule,
    Several,
    Stated,
    Uncertain,
    anything,
    check_keys,
    checked,
    checked_tables,
    load_toml,
    table_of,
)
from foamfit.data.measurement import GRAVITY, Noise, Specimen, Striker, Window, interior_node
from foamfit.data.units import (
    is_unit,
    parse_quantity,
    parse_uncertain,
    split_quantity,
    split_uncertain,
)
from foamfit.errors import InputError, naming
from foamfit.terminal import printable

_SECTIONS: dict[str, dict[str, Check]] = {
    "specimen": {
        "height": Uncertain("m", "1.19 mm"),
        "diameter": Uncertain("m", "5 mm"),
        "area": Uncertain("m**2", "19.6 mm^2"),
        "mass": Uncertain("kg", "5.56 mg"),
        "heights": Several(Uncertain("m", "0.7 mm"), 'like ["0.700 mm", "0.490 mm"], base first'),
    },
    "striker": {
        "mass": Uncertain("kg", "7 g"),
        "velocity": Uncertain("m/s", "1.75 m/s"),
        "gravity": FLAG,
    },
    "noise": {"stress": Quantity("Pa", "20 kPa"), "displacement": Quantity("m", "2 um")},
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
}
_NAME = Rule(
    lambda v: isinstance(v, str) and v.strip() != "" and v.isprintable() and len(v) <= LONGEST,
    f"a printable text of {LONGEST} characters at most, in quotation marks",
)
_PRIOR = Rule(lambda v: isinstance(v, str), 'like "5.5 ± 0.1 MPa"')
_FILE = Rule(
    lambda v: isinstance(v, str) and v.strip() != "" and "\0" not in v, 'a file, like "camera.csv"'
)
_DELAY = Uncertain("s", "0 ± 50 us", positive=False)
# Names in `Settings.uncertainties` that differ from the key.
_SPREADS = {"specimen mass": "specimen_mass", "striker mass": "striker_mass"}
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


def read_settings(path: Path, test: Path, *, channels: Iterable[str]) -> Settings:
    """Read and check the TOML at `path` that describes the file `test`.

    [columns] may contain `channels`, displacement_1, displacement_2, … InputError names the file
    and the invalid or missing key.
    """
    document = load_toml(path, f"{test.name} needs a TOML with [specimen] height and diameter")
    check_keys(f"{path}:", document, ["name", "columns", "motion", "priors", *_SECTIONS])
    with naming(path):
        values, spreads = _split(checked_tables(document, _SECTIONS))
        window, striker, priors = values["window"], values["striker"], table_of(document, "priors")
        if {"cycle", "cycles"} <= window.keys():
            raise InputError("[window] has both cycle and cycles; give one of them.")
        if "cycles" in window:
            window["cycle"], window["last"] = window.pop("cycles")
        if "gravity" in striker:
            striker["gravity"] = GRAVITY if striker["gravity"] else 0.0
        motion, delay = _motion(path, document)
        return Settings(
            name=_NAME(document.get("name", printable(toml_beside(test).stem)), "name"),
            specimen=_specimen(values["specimen"], spreads),
            striker=Striker(**striker) if striker else None,
            noise=Noise(**values["noise"]),
            window=Window(**window),
            columns=_columns(table_of(document, "columns"), channels),
            uncertainties=spreads | ({"delay": delay} if delay else {}),
            motion=motion,
            # Its keys depend on the model; the fit checks them.
            priors={key: _PRIOR(value, f"[priors] {key}") for key, value in priors.items()},
            **values["data"],
        )


def _split(tables: dict[str, dict[str, Any]]) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """Separate the values of the tables from the standard deviations."""
    spreads = dict[str, float | None]()

    def value(found: Any, name: str) -> Any:
        if isinstance(found, Stated):
            spreads[_SPREADS.get(name, name.partition(" ")[2])] = found.sigma
            return found.value
        if isinstance(found, tuple) and name == "specimen heights":
            return tuple(value(one, f"specimen height_{i}") for i, one in enumerate(found, 1))
        return found

    values = {
        name: {key: value(found, f"{name} {key}") for key, found in table.items()}
        for name, table in tables.items()
    }
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


def _motion(path: Path, document: dict[str, Any]) -> tuple[Motion | None, float | None]:
    """Return the motion in a file of its own, and the standard deviation of its delay, s."""
    if "motion" not in document:
        return None, None
    table = document["motion"]
    if not isinstance(table, dict) or "file" not in table:
        raise InputError('[motion] must name a file, like file = "camera.csv".')
    keys: dict[str, Check] = {"file": _FILE, "delay": _DELAY, "columns": anything}
    found = {"delay": Stated(0.0, None)} | checked(table, keys, "[motion]")
    columns = _columns(table_of(found, "columns", "motion."), MOTION_CHANNELS, "motion.columns")
    delay = found["delay"]
    return Motion(path.parent / found["file"], columns, delay.value), delay.sigma


_COLUMN: dict[str, Check] = {
    "column": Rule(
        lambda v: isinstance(v, str) or (type(v) is int and v > 0),
        'a header or a number, like column = "Load" or column = 2',
    ),
    "unit": Rule(lambda v: isinstance(v, str) and is_unit(v), 'a known unit, like unit = "mm"'),
    "scale": lambda value, where: _scale(value, where),
    "counts_down": FLAG,
}


def _columns(
    table: dict[str, Any], channels: Iterable[str], name: str = "columns"
) -> dict[str, Column]:
    check_keys(f"[{name}]", table, [*channels, *filter(interior_node, table)])
    columns: dict[str, Column] = {}
    right = '{ column = "Load", unit = "V" }, or with a number, column = 2'
    for channel, entry in table.items():
        where, inside = f"[{name}] {channel}", interior_node(channel) is not None
        if not isinstance(entry, dict) or "column" not in entry:
            raise InputError(f"{where} must be like {right}.")
        down = inside or channel == "displacement"
        keys = _COLUMN if down else {key: _COLUMN[key] for key in ("column", "unit", "scale")}
        found = checked(entry, keys, f"{where}:")
        number, unit, sigma = found.pop("scale", (1.0, "", None))
        if sigma is not None and (inside or channel in ("time", "cycle")):
            parse_quantity(entry["scale"], unit, f"{where}: scale", _SCALE)  # refuses the ±
        columns[channel] = Column(
            **found, scale=number, scale_unit=unit, spread=(sigma or 0.0) / abs(number)
        )
    return columns


def _scale(value: Any, where: str) -> tuple[float, str, float | None]:
    """Return number, unit and standard deviation of a scale, such as "4444.4 ± 5 N/V"."""
    text = str(value)
    parts = split_quantity(split_uncertain(text)[0])
    if parts is None or parts[0] in (0.0, math.inf, -math.inf) or not is_unit(parts[1]):
        raise InputError(f'{where} = {value!r} must be like -1 or "{_SCALE}".')
    return *parts, parse_uncertain(text, parts[1], where, _SCALE)[1]
