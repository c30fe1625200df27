"""What the page shows of a file before its specimen is known: columns, curves, and remedies."""

from __future__ import annotations

import re
import tomllib
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
    """Headers of a file, and its curves as a PNG (None if they cannot be read)."""

    headers: tuple[str, ...]
    picture: bytes | None


def preview(csv: Path, rest: str) -> Preview:
    """Return what can be shown of a file with the TOML of its columns, `rest`."""
    try:
        source = Source.of(read_text(csv, "a table"), {}, {})
        headers = tuple(header.text for header in source.table.headers if header.text)
    except InputError:
        return Preview((), None)
    try:
        document = tomllib.loads(rest)
        with TemporaryDirectory() as folder:
            toml = Path(folder, "test.toml")
            toml.write_text(tomli_w.dumps(document | UNIT), encoding="utf-8")
            return Preview(headers, _picture(csv, toml, "strain" in source.columns))
    except (InputError, tomllib.TOMLDecodeError, RecursionError):
        return Preview(headers, None)


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


def remedies(message: str) -> list[tuple[str, str]]:
    """Return the entries of [columns] that a message proposes: channel and content."""
    return list(dict.fromkeys(ENTRY.findall(message)))


def in_words(channel: str, content: str) -> str:
    """Return an entry of [columns] as a button says it: "Use Load in kN as force"."""
    entry = tomllib.loads(f"entry = {{ {content} }}")["entry"]
    unit = f" in {entry['unit']}" if "unit" in entry else ""
    return f"Use {entry['column']}{unit} as {channel}"


def with_column(rest: str, channel: str, content: str) -> str:
    """Return the TOML `rest` with an entry of [columns]; InputError if `rest` is invalid.

    `content` is like 'column = "Load", unit = "kN"'; "" removes the entry.
    """
    try:
        document = tomllib.loads(rest)
        entry = tomllib.loads(f"{channel} = {{ {content} }}") if content else {}
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"The further TOML is not valid TOML: {error}.") from None
    columns = {k: v for k, v in document.get("columns", {}).items() if k != channel} | entry
    document = {k: v for k, v in document.items() if k != "columns"}
    return tomli_w.dumps(document | ({"columns": columns} if columns else {}))
