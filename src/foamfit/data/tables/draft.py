"""The first TOML of a test: what its headers say, and questions about the rest."""

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

# What every test needs, what an impact needs, and what helps.
_NEEDED = (
    "[specimen]",
    'height = "10 mm"          # before the test; with its ± where it is known: "10 ± 0.02 mm"',
    'diameter = "5 mm"         # or area = "19.6 mm^2"',
)
_IMPACT = (
    "[striker]                 # of an impact; a slow test has none",
    'mass = "7 g"',
    'velocity = "1.75 m/s"     # at contact',
)
_HELPS = (
    "[noise]                   # one standard deviation each; else it is estimated",
    'stress = "20 kPa"',
    'displacement = "2 um"',
)
# Channels one of which must be there, or that are worth asking for, each with its question.
_WANTED = {
    ("stress", "force"): "needed: a force (N) or a stress (MPa)",
    ("displacement", "strain"): "needed: a displacement (mm) or strain (%), or else the [striker]",
    ("time",): "a time (s); without it only slow drives make sense",
}


def draft(text: Text) -> tuple[str, list[str]]:
    """Return the text of a TOML with questions behind "# ", and those that must be answered."""
    columns, name = _columns(text), printable(toml_beside(text.path).stem[:LONGEST])
    head = (
        f"# {printable(text.path.name)}: what foamfit needs to know of this test.",
        '# A line behind "# " is a question: give your value and take the "# " away.',
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
    """Say that a test has no TOML, what it must hold, and what writes it."""
    asked = draft(text)[1]
    keys = [line.partition(" = ")[0] for line in asked[: -len(_IMPACT)] if line[0] != "["]
    name = text.path.name
    return InputError(
        f"{toml}: no such file; {name} needs a TOML with {listed(keys)}, and of an impact with the "
        f"striker's mass and velocity; write it by: foamfit init {text.path}",
        asked,
    )


def _columns(text: Text) -> list[str]:
    """Lines of [columns]: those that the headers answer, and the others as questions."""
    try:
        source = Source.of(text, {})
    except InputError as error:
        units = ((names[0], CHANNELS[names[0]].unit, what) for names, what in _WANTED.items())
        asked = (
            f'# {c} = {{ column = "…", unit = "{unit}" }}  # {what}' for c, unit, what in units
        )
        return [f"# {printable(' '.join(str(error).split()))}", *asked]
    lines, table, found = [], source.table, source.columns
    for channel, k in found.items():
        name = f"{channel} = {{ column = {quoted(table, k)}"
        try:
            source.factor(channel)
            lines.append(f"{name} }}")
        except InputError as error:
            why = str(error).removeprefix("column ").partition(";")[0]
            lines.append(f'# {name}, unit = "{channel_of(channel).unit}" }}  # needed: {why}')
    others = [k for k in range(len(table.headers)) if k not in found.values()]
    for names, what in _WANTED.items():
        if not found.keys() & set(names):
            first = quoted(table, others[0]) if others else '"…"'
            entry = entries_of(table, set(), names[0]).replace('"…"', first)
            lines.append(f"# {entry}  # {what}")
    rest = ", ".join(table.headers[k].text for k in others)
    return [*lines, *([f"# not understood: {printable(rest)}"] if rest else [])]
