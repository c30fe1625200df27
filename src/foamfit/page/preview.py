"""What the page shows of a file before its specimen is known: columns, curves, and remedies."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import tomli_w

from foamfit.data.csv_file import read_test
from foamfit.data.tables.columns import Source
from foamfit.data.tables.csv_table import read_text
from foamfit.errors import InputError
from foamfit.report import figures
from foamfit.report.readable import readable_unit

# Choices of unit for each channel that the page offers.
UNITS = {
    "time": ("s", "ms", "us"),
    "force": ("N", "kN", "mN"),
    "stress": ("MPa", "kPa", "Pa"),
    "displacement": ("mm", "um", "m"),
    "strain": ("%", ""),
}
# Any specimen: with 1 m² and 1 m, stress is force and strain displacement.
UNIT = {"specimen": {"height": "1 m", "area": "1 m^2"}}
ENTRY = re.compile(r"\b(\w+) = \{ ?(column = [^{}…]+?) ?\}")


class Preview(NamedTuple):
    """Headers of a file, and its curves as a PNG, or why they cannot be read."""

    headers: tuple[str, ...] = ()
    picture: bytes | None = None
    why: str = ""


def preview(csv: Path, rest: str) -> Preview:
    """Return what can be shown of a file with the TOML of its columns, `rest`."""
    try:
        source = Source.of(read_text(csv, "a table"), {}, {})
        headers = tuple(header.text for header in source.table.headers if header.text)
    except InputError:
        return Preview()
    try:
        document = tomllib.loads(rest)
        with TemporaryDirectory() as folder:
            toml = Path(folder, "test.toml")
            toml.write_text(tomli_w.dumps(document | UNIT), encoding="utf-8")
            return Preview(headers, _picture(csv, toml, "strain" in source.columns))
    except (InputError, tomllib.TOMLDecodeError, RecursionError) as error:
        return Preview(headers, None, str(error))


def _picture(csv: Path, toml: Path, strained: bool) -> bytes:
    """Draw force over time and over the motion."""
    test = read_test(csv, toml)
    if test.stress is None:
        raise InputError("there is no force to draw")
    force, unit = readable_unit(float(abs(test.stress).max()), "N")
    panels = list[tuple[Any, str, float]]()
    if test.time is not None:
        scale, name = readable_unit(float(abs(test.time).max()), "s")
        panels.append((test.time, f"time ({name})", scale))
    if test.displacement is not None:
        scale, name = readable_unit(float(abs(test.displacement).max()), "m")
        label = "strain" if strained else f"displacement ({name})"
        panels.append((test.displacement, label, 1.0 if strained else scale))
    with figures.drawing(7.0, 2.6) as figure:
        for ax, (x, label, scale) in zip(
            figures.grid_of(figure, 1, max(len(panels), 1), len(panels)), panels, strict=True
        ):
            ax.plot(x / scale, test.stress / force, color=figures.BLUE, linewidth=0.9)
            ax.set(xlabel=label, ylabel=f"force ({unit})")
    return figures.image(figure, "png", 130)


def remedies(message: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the entries of [columns] that a message proposes, by the words of their buttons."""
    found = [
        (channel, tomllib.loads(f"entry = {{ {content} }}")["entry"])
        for channel, content in ENTRY.findall(message)
    ]
    return {in_words(*one): one for one in found}


def in_words(channel: str, entry: Mapping[str, Any]) -> str:
    """Return an entry of [columns] in words: "Use Load in kN as force"."""
    unit = f" in {entry['unit']}" if "unit" in entry else ""
    return f"Use {entry['column']}{unit} as {channel}"


def with_column(rest: str, channel: str, entry: Mapping[str, Any]) -> str:
    """Return the TOML `rest` with an entry of [columns]; InputError if `rest` is invalid.

    `entry` is like {"column": "Load", "unit": "kN"}; an empty one is removed.
    """
    try:
        document = tomllib.loads(rest)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"The further TOML is not valid TOML: {error}.") from None
    document["columns"] = document.get("columns", {}) | {channel: dict(entry)}
    document["columns"] = {name: one for name, one in document["columns"].items() if one}
    return tomli_w.dumps({name: one for name, one in document.items() if one != {}})
