"""Draft the TOML of a test from its headers, with questions about the missing entries."""

from __future__ import annotations

import json
from pathlib import Path

from foamfit.data.tables.columns import Source, entries_of, quoted
from foamfit.data.tables.csv_table import Text
from foamfit.data.tables.headers import CHANNELS, channel_of
from foamfit.data.toml_file import LONGEST, toml_beside
from foamfit.errors import InputError
from foamfit.terminal import printable
from foamfit.text import listed

# Entries for every test, entries for an impact, and optional entries.
_NEEDED = (
    "[specimen]",
    'height = "10 mm"          # before the test; with its ± if known: "10 ± 0.02 mm"',
    'diameter = "5 mm"         # or area = "19.6 mm^2"',
)
_IMPACT = (
    "[striker]                 # only for an impact",
    'mass = "7 g"',
    'velocity = "1.75 m/s"     # at contact',
)
_HELPS = (
    "[noise]                   # standard deviations; estimated if not given",
    'stress = "20 kPa"',
    'displacement = "2 um"',
)
# Groups of channels of which one is needed or useful, each with a question to the user.
_WANTED = {
    ("stress", "force"): "needed: a force (N) or a stress (MPa)",
    ("displacement", "strain"): "needed: a displacement (mm) or strain (%), or else the [striker]",
    ("time",): "a time (s); without it only slow drives make sense",
}


def draft(text: Text) -> tuple[str, list[str]]:
    """Return the text of a TOML with questions after "# ", and the entries still needed."""
    columns, name = _columns(text), printable(toml_beside(text.path).stem[:LONGEST])
    head = (
        f"# {printable(text.path.name)}: the data that foamfit needs for this test.",
        '# Lines that start with "# " are questions: enter your value and remove the "# ".',
        f"name = {json.dumps(name, ensure_ascii=False)}",
    )
    needed, impact, helps = (
        (title, *(f"# {line}" for line in lines)) for title, *lines in (_NEEDED, _IMPACT, _HELPS)
    )
    parts = [head, needed, impact, ("[columns]", *columns), helps]
    missing = [line.removeprefix("# ") for line in columns if "  # needed" in line]
    asked = [*_NEEDED, *(["[columns]", *missing] if missing else []), *_IMPACT]
    return "\n\n".join(map("\n".join, parts)) + "\n", asked


def without_toml(toml: Path, text: Text) -> InputError:
    """Return the error for a test without a TOML: its entries, and the command to draft it."""
    asked = draft(text)[1]
    keys = [line.partition(" = ")[0] for line in asked[: -len(_IMPACT)] if line[0] != "["]
    name = text.path.name
    return InputError(
        f"{toml}: no such file; {name} needs a TOML with {listed(keys)}, and for an impact the "
        f"striker's mass and velocity; create it with: foamfit init {text.path}",
        asked,
    )


def _columns(text: Text) -> list[str]:
    """Return the lines of [columns]: known from the headers, or as questions."""
    try:
        source = Source.of(text, {})
    except InputError as error:
        units = ((names[0], CHANNELS[names[0]].unit, what) for names, what in _WANTED.items())
        asked = (
            f'# {c} = {{ column = "…", unit = "{unit}" }}  # {what}' for c, unit, what in units
        )
        return [f"# {printable(' '.join(str(error).split()))}", *asked]
    lines, table = [], source.table
    for channel, k in source.columns.items():
        name = f"{channel} = {{ column = {quoted(table, k)}"
        try:
            source.factor(channel)
            lines.append(f"{name} }}")
        except InputError as error:
            why = str(error).removeprefix("column ").partition(";")[0]
            lines.append(f'# {name}, unit = "{channel_of(channel).unit}" }}  # needed: {why}')
    others = [k for k in range(len(table.headers)) if k not in source.columns.values()]
    for names, what in _WANTED.items():
        if not source.columns.keys() & set(names):
            first = quoted(table, others[0]) if others else '"…"'
            entry = entries_of(table, set(), names[0]).replace('"…"', first)
            lines.append(f"# {entry}  # {what}")
    rest = ", ".join(table.headers[k].text for k in others)
    return [*lines, *([f"# not understood: {printable(rest)}"] if rest else [])]
