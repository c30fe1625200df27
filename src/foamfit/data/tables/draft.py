"""Draft the TOML of a test from its headers, with questions about the missing entries."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from foamfit.data.measurement import MIN_ROWS, Entry
from foamfit.data.tables.columns import Source, column_of, entries_of, si_factor
from foamfit.data.tables.csv_table import Table, Text, read_numbers
from foamfit.data.tables.headers import channel_of
from foamfit.data.toml_file import LONGEST, toml_beside
from foamfit.data.units import factor
from foamfit.errors import InputError, naming
from foamfit.terminal import printable
from foamfit.text import listed

_TEMPLATE = """\
# {file}: the data that foamfit needs for this test.
# Lines that start with "# " are questions: enter your value and remove the "# ".
name = {name}

[specimen]
# height = "10 mm"          # before the test; with its ± if known: "10 ± 0.02 mm"
# diameter = "5 mm"         # or area = "19.6 mm^2"

[striker]                 # only for an impact
# mass = "7 g"
# velocity = "1.75 m/s"     # at contact

[columns]
{columns}

[noise]                   # standard deviations; estimated if not given
# stress = "20 kPa"
# displacement = "2 um"
"""
_EVEN = 1.1  # largest ratio of the steps of a clock
# Groups of channels of which one is needed or useful, each with a question to the user.
_WANTED = {
    ("stress", "force"): "needed: a force (N) or a stress (MPa)",
    ("displacement", "strain"): "needed: a displacement (mm) or strain (%), or else the [striker]",
    ("time",): "a time (s); without it only slow drives make sense",
}


def draft(text: Text) -> tuple[str, list[str]]:
    """Return the text of a TOML with questions after "# ", and the entries still needed."""
    with naming(text.path):
        columns = _columns(text)
    name = json.dumps(printable(toml_beside(text.path).stem[:LONGEST]), ensure_ascii=False)
    file = printable(text.path.name)
    whole = _TEMPLATE.format(file=file, name=name, columns="\n".join(columns))
    _, *parts = whole.replace("\n# ", "\n").split("\n\n")
    needed, striker = (part.split("\n") for part in parts[:2])
    missing = [line.removeprefix("# ") for line in columns if "  # needed" in line]
    return whole, [*needed, *(["[columns]", *missing] if missing else []), *striker]


def without_toml(toml: Path, text: Text) -> InputError:
    """Return the error for a test without a TOML: its entries, and the command to draft it."""
    asked = draft(text)[1]  # the last three lines are the striker's
    keys = [line.partition(" = ")[0] for line in asked[:-3] if line[0] != "["]
    wrong = f"{toml}: no such file; {text.path.name} needs a TOML with {listed(keys)}, and for an "
    wrong += f"impact the striker's mass and velocity; create it with: foamfit init {text.path}"
    return InputError(wrong, asked)


def _columns(text: Text) -> list[str]:
    """Return the lines of [columns]: known from the headers, or as questions."""
    unclear = dict[str, list[int]]()
    source = Source.of(text, {}, unclear)
    lines, table = [], source.table
    for channel, k in (source.columns | {c: places[0] for c, places in unclear.items()}).items():
        unit, why = "", ""
        try:
            si_factor(table, channel, k, None)
        except InputError as error:
            unit = channel_of(channel).unit
            why = str(error).removeprefix("column ").partition(";")[0]
        if channel in unclear:
            why = f"which of {listed(map(table.name, unclear[channel]))} is it?"
        line = Entry(channel, column_of(table, k), unit)
        lines.append(f"# {line}  # needed: {why}" if why else str(line))
    known = {*source.columns.values(), *(k for places in unclear.values() for k in places)}
    others = [k for k, h in enumerate(table.headers) if h.text and k not in known]
    present = source.columns.keys() | unclear.keys()
    for names, what in _WANTED.items():
        if not present & set(names):
            entry = _proposal(table, names, others)
            more = ", with the scale of its sensor" if "scale" in entry else ""
            if "stress" in names and present & {"acceleration", "velocity"}:
                more += ", or else the [striker] mass"
            lines.append(f"# {entry}  # {what}{more}")
    rest = ", ".join(table.headers[k].text for k in others)
    lines += [f"# not used: {printable(rest)}"] if rest else []
    return lines if table.header_row else [*lines, "# give columns by number, like column = 1"]


def _proposal(table: Table, names: tuple[str, ...], columns: list[int]) -> str:
    """Return an entry for a missing channel; it names a column only if no other can be meant.

    That is the only one with a unit of the channel, the only voltage, or the only one without a
    unit whose numbers are neither counts nor, except for a time, a clock.
    """
    nameless = [k for k in columns if table.headers[k].nameless]
    for channel in names:
        entry = entries_of(table, set(), channel)
        if "…" not in entry:
            return entry
    volts = [k for k in nameless if factor(table.headers[k].unit or "", "V") is not None]
    if len(volts) == 1 and "force" in names:
        return str(Entry("force", column_of(table, volts[0]), scale=100.0, scale_unit="N/V"))
    plain = [k for k in nameless if table.headers[k].unit is None]
    clocks = {k: _is_clock(table, k) for k in plain}
    fits = [k for k, clock in clocks.items() if clock == ("time" in names)]
    column = column_of(table, fits[0]) if len(fits) == 1 else "…"
    return str(Entry(names[0], column, channel_of(names[0]).unit))


def _is_clock(table: Table, column: int) -> bool | None:
    """Return whether a column increases by even steps; None for counts, a constant or a text."""
    try:
        values = read_numbers(table, {"": column})[0][""]
    except InputError:
        return None
    if values.size < MIN_ROWS or np.array_equal(values, np.round(values)):
        return None
    steps = np.diff(values)
    return bool(steps.min() > 0.0 and steps.max() < _EVEN * steps.min())
