"""Which column of a table is which channel, and what its numbers are multiplied by to be in SI."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from foamfit.data.measurement import Striker, interior_channel, interior_node
from foamfit.data.tables.csv_table import Table, Text, find_table, read_numbers
from foamfit.data.tables.headers import CHANNELS, WEAK, WEIGHTS, channel_of, example, in_si
from foamfit.data.toml_file import Column, Settings
from foamfit.data.units import is_unit
from foamfit.errors import InputError
from foamfit.text import listed, percent

_NONE = Column("")
_MOTIONS = "displacement", "strain"
TWINS = {"stress": "force", "force": "stress", "displacement": "strain", "strain": "displacement"}
# What stress and displacement are read from, the first that there is.
_SOURCES = {"stress": ("stress", "force", "acceleration"), "displacement": _MOTIONS}


@dataclass(frozen=True)
class Source:
    """A table, the column that each channel is in, and what [columns] of the TOML says of them."""

    table: Table
    columns: dict[str, int]
    given: dict[str, Column]

    @classmethod
    def of(cls, text: Text, given: dict[str, Column]) -> Source:
        """Find the table of a file, and which column each channel is in."""
        table = find_table(text, {column.column for column in given.values()})
        return cls(table, assign_columns(table, given), given)

    def factor(self, channel: str) -> float:
        """Return what the numbers of a channel are multiplied by to be SI."""
        return si_factor(self.table, channel, self.columns[channel], self.given.get(channel))

    def only(self, channels: Iterable[str]) -> Source:
        """Read no other channels."""
        return replace(self, columns={c: k for c, k in self.columns.items() if c in channels})

    def needed(self, settings: Settings) -> Source:
        """Choose the channels worth reading; refuse a file that lacks one nothing can replace."""
        table, has, motion = self.table, set(self.columns), settings.motion
        striker = settings.striker or Striker()
        forced, moved = bool(has & {"stress", "force"}), bool(has & set(_MOTIONS))
        braked = bool(has & {"acceleration", "velocity"} or (moved and striker.velocity))
        if not forced and not ("time" in has and braked and striker.mass):
            more = "with a time and the [striker] mass an acceleration or a velocity will do, and "
            wanted, others = ("stress", "force"), ("displacement", "time")
            raise self._lacks(wanted, others, f"; {more}with its velocity a displacement")
        if motion is not None:
            own = [c for c in self.columns if c in _MOTIONS or interior_node(c)]
            if own:
                header = table.headers[self.columns[own[0]]].text
                raise InputError(
                    f"column {header!r} is a {own[0]}, but [motion] file = {motion.file.name!r} "
                    "has the motion; leave one of them out."
                )
            if "time" not in has:
                told = f"no column is a time (there are {table.listed})"
                raise InputError(f"{told}; with [motion] it needs one like 'time (ms)'.")
        helping = {"velocity"} if moved or "acceleration" in has else set[str]()
        helping = {"velocity", "acceleration"} if forced else helping
        if moved or motion is not None:
            return self.only(has - helping)
        for channel in has & helping - set(self.given):
            try:  # these only help, so one whose unit does not say what it is can be left
                self.factor(channel)
            except InputError:
                has.remove(channel)
        sources = "velocity" in has or (
            striker.velocity and (striker.mass or "acceleration" in has)
        )
        if "time" not in has or not sources:
            timed = "" if "time" in has else f"{entries_of(table, has, 'time')} there, and "
            more = f", or give {timed}the [striker] mass and velocity to integrate the motion"
            raise self._lacks(_MOTIONS, (), more)
        return self.only(has)

    def of_motion(self) -> Source:
        """Choose time and displacements of a file of [motion]; refuse one that lacks them."""
        there = {c for c in self.columns if c in ("time", *_MOTIONS) or interior_node(c)}
        for wanted in (("time",), _MOTIONS):
            if not there & set(wanted):
                raise self._lacks(wanted)
        return self.only(there)

    def _lacks(
        self, wanted: tuple[str, ...], others: tuple[str, ...] = (), more: str = ""
    ) -> InputError:
        """Say that no column is one of the `wanted` channels, and how to name one."""
        entry = "force" if "force" in wanted else wanted[0]
        entries = entries_of(self.table, set(self.columns), entry, *others)
        return InputError(
            f"no column is a {' or a '.join(wanted)} (there are {self.table.listed}); name one "
            f"like '{example(wanted[0])}', or write {entries} in [columns]{more}."
        )

    def left_out(self) -> dict[str, int]:
        """Columns that could be read instead of those that are: the twins and other times."""
        found = dict[str, int]()
        for channel in (c for c in self.columns if c in {"time", *TWINS}):
            twin = TWINS.get(channel, channel)
            headers = ((k, h.rank(twin)) for k, h in enumerate(self.table.headers))
            ranks = {k: r for k, r in headers if r is not None and k not in self.columns.values()}
            if ranks and (twin not in self.columns or channel == "time"):
                found[twin] = min(ranks, key=lambda k: ranks[k])
        return found

    def scale_spreads(self) -> dict[str, float]:
        """Standard deviations of the scales of the channels that are read, each over its scale."""
        sources = _SOURCES | {c: (c,) for c in ("velocity", "acceleration")}
        used = {
            name: next((c for c in cs if c in self.columns), "") for name, cs in sources.items()
        }
        if used["stress"] == "acceleration":  # then it is no channel of its own
            del used["acceleration"]
        spreads = {f"{name}_scale": self.given.get(c, _NONE).spread for name, c in used.items()}
        return {name: spread for name, spread in spreads.items() if spread}

    def note(self) -> str:
        """Say what is read from which column, and which columns are not used."""
        parts, table = [], self.table
        for channel, k in self.columns.items():
            given, header = self.given.get(channel, _NONE), table.headers[k]
            unit = given.unit or header.unit or ""
            by = f"{given.scale:.6g} {given.scale_unit}".strip()
            by += f" ± {percent(given.spread)}" if given.spread else ""
            over = _inverse(channel, unit, given) is not None
            part = f"{channel} from {table.name(k)}" + (f" in {given.unit}" if given.unit else "")
            part += f" {'over the sensitivity' if over else 'times'} {by}" if by != "1" else ""
            part += ", counting down" if given.counts_down else ""
            if channel == "force" and unit.casefold() in WEIGHTS:
                part += f" ({WEIGHTS[unit.casefold()]}: the weight of that mass)"
            parts.append(part)
        used = self.columns.values()
        rest = [repr(h.text) for k, h in enumerate(table.headers) if h.text and k not in used]
        return f"Read {', '.join(parts)}" + (f"; not used: {', '.join(rest)}." if rest else ".")

    def sign_advice(self, channel: str) -> str:
        """Say what makes a channel positive that is negative in compression."""
        channel = next(c for c in _SOURCES.get(channel, (channel,)) if c in self.columns)
        given = self.given.get(channel, _NONE)
        entry = f"{channel} = {{ column = {quoted(self.table, self.columns[channel])}"
        by = f'"{-given.scale:g} {given.scale_unit}"' if given.scale_unit else f"{-given.scale:g}"
        wrong = "is negative in compression; it must be positive"
        right = f"write {entry}, scale = {by} }}"
        if channel.startswith("displacement"):
            wrong = "is negative or gets smaller in compression; it must get larger"
            right = (
                f"write {entry}, counts_down = true }} (of a gap or a position; else scale = {by})"
            )
        if given.counts_down:
            right = "leave counts_down = true out"
        elif given.scale < 0.0:
            right = f"leave the minus sign of scale = {given.scale:g} out"
        return f"{channel} {wrong}: {right} in [columns]"


def assign_columns(table: Table, given: dict[str, Column]) -> dict[str, int]:
    """Which column each channel is in: as [columns] of the TOML says, else as the headers do."""
    found: dict[str, int] = {}
    strained = "strain" in given or any(h.rank("strain") is not None for h in table.headers)
    for channel in _channels(table, given):
        if channel in given:
            found[channel] = _place(table, channel, given[channel].column)
            continue
        ranks = {k: r for k, h in enumerate(table.headers) if (r := h.rank(channel)) is not None}
        if interior_node(channel):  # a column that the TOML calls the top is not inside
            taken = {found[c] for c in given if c in found}
            ranks = {k: r for k, r in ranks.items() if k not in taken}
        best = [k for k, r in ranks.items() if r == min(ranks.values())]
        if len(best) > 1 and channel == "time":
            best = _clear_time(table, best)
        if len(best) > 1 and TWINS.get(channel) in given:
            continue
        if len(best) > 1:
            both = " and ".join(map(table.name, best))
            entry = f"{channel} = {{ column = {quoted(table, best[0])} }}"
            raise InputError(
                f"columns {both} could both be the {channel}; keep one, or write {entry} in "
                "[columns]."
            )
        if best and not (ranks[best[0]] == WEAK and strained):
            found[channel] = best[0]
    # A channel that the TOML names replaces its twin that only a header names.
    for named, twin in TWINS.items():
        if named in given and twin not in given:
            found.pop(twin, None)
    # A true stress needs the cross-section that no file has.
    true = "stress" in found and table.headers[found["stress"]].measure("stress")
    if true and "stress" not in given and "force" in found:
        del found["stress"]
    return found


def _channels(table: Table, given: dict[str, Column]) -> list[str]:
    """List the channels to look for: the usual ones, then the masses inside that are named."""
    numbers = {int(w) for h in table.headers for w in h.words if w.isdecimal()}
    inside = {c for c in (*map(interior_channel, numbers), *given) if interior_node(c)}
    return [*CHANNELS, *sorted(inside, key=lambda c: (c not in given, interior_node(c) or 0))]


def _place(table: Table, channel: str, column: str | int) -> int:
    """Place of a column that the TOML gives by its header or its number."""
    if isinstance(column, int):
        places = [column - 1] if column <= len(table.headers) else []
    else:
        places = [k for k, h in enumerate(table.headers) if h.is_named(column)]
    if len(places) == 1:
        return places[0]
    numbers = " or ".join(str(k + 1) for k in places)
    more = f"twice in it; give its number, column = {numbers}"
    if not places:
        more = f"nowhere in it, which has {len(table.headers)} columns: {table.listed}"
    raise InputError(f"[columns] {channel}: column {column!r} is {more}.")


def quoted(table: Table, k: int) -> str:
    """A column as [columns] names it: by its header, or by its number where others are equal."""
    text = table.headers[k].text
    alone = table.header_row and [h.text for h in table.headers].count(text) == 1
    return json.dumps(text, ensure_ascii=False) if alone else str(k + 1)


def _clear_time(table: Table, columns: list[int]) -> list[int]:
    """Of several columns that could be the time keep the one that never goes back, if it is one."""
    try:
        numbers = read_numbers(table, {str(k): k for k in columns})[0]
    except InputError:  # tests of different lengths, side by side
        return columns
    steps = {k: np.diff(numbers[str(k)]) for k in columns}
    onward = [k for k, step in steps.items() if step.size and step.min() >= 0.0 < step.max()]
    return onward if len(onward) == 1 else columns


def si_factor(table: Table, channel: str, k: int, given: Column | None) -> float:
    """Return what the numbers of column `k` are multiplied by to be SI."""
    header, given = table.headers[k], given or _NONE
    if channel == "cycle":  # counted; pint takes "Cycles" in a header for a unit of angle
        return 1.0
    right, where = example(channel), f"column {table.name(k)}"
    if header.measure(channel) and channel == "stress":
        raise InputError(
            f"{where} is a {header.measure(channel)} stress, which needs the cross-section of each "
            "instant; give the force or the nominal (engineering) stress."
        )
    unit = given.unit if given.unit is not None else header.unit
    over = header.text.partition("/")[2].strip()  # Weg/mm, which only the TOML calls displacement
    if unit is None and over and in_si(channel, over, given.scale_unit) is not None:
        unit = over
    if unit is None and in_si(channel, "", given.scale_unit) is None:
        usual, more = channel_of(channel).unit, ""
        if given.scale_unit:
            over, _, under = given.scale_unit.rpartition("/")
            usual = under if in_si(channel, under) is None else over  # N/mV, or mV/N of a sensor
            more = f', scale = "{given.scale:g} {given.scale_unit}"'
        raise InputError(
            f"{where} has no unit; write it in the header like '{right}' or in [columns] like "
            f'{channel} = {{ column = {quoted(table, k)}, unit = "{usual}"{more} }}.'
        )
    unit = unit or ""
    if not is_unit(unit, any_case=True):
        raise InputError(f"{where} has an unknown unit {unit!r}; write it like '{right}'.")
    own = header.unit
    if given.unit is not None and own is not None and is_unit(own, any_case=True):
        stated, there = in_si(channel, given.unit), in_si(channel, own)
        # The last word of a name may only look like a unit.
        bracketed = there is not None or header.text.endswith((")", "]", "}"))
        other = stated is None and given.unit.casefold() != own.casefold()
        if bracketed and (stated != there or other):
            raise InputError(
                f"{where} has the unit {own!r} in its header, but [columns] {channel} says "
                f"{given.unit!r}; leave unit out, or, if the header is wrong, correct it by scale."
            )
    one, inverse = in_si(channel, unit, given.scale_unit), _inverse(channel, unit, given)
    one = inverse / given.scale**2 if inverse is not None else one
    if one is None:
        raise InputError(
            f"{where} cannot be read as {channel}: its unit {unit!r} is of another kind; "
            f"write it like '{right}' or give a scale in [columns]."
        )
    return given.scale * one * (-1.0 if given.counts_down else 1.0)


def _inverse(channel: str, unit: str, given: Column) -> float | None:
    """SI value of a unit over that of a scale which is a sensor's sensitivity, as "4 mV/N"."""
    if not given.scale_unit or in_si(channel, unit, given.scale_unit) is not None:
        return None
    return in_si(channel, unit, f"1/({given.scale_unit})")


def entries_of(table: Table, has: set[str], *channels: str) -> str:
    """Entries of [columns] for channels that the file seems to lack, by units of its headers."""
    entries = []
    unnamed = [
        k
        for k, header in enumerate(table.headers)
        if header.unit and all(header.rank(channel) is None for channel in CHANNELS)
    ]
    for channel in channels:
        units = ((k, table.headers[k].unit or "") for k in unnamed)
        k = next((k for k, unit in units if in_si(channel, unit) is not None), None)
        column = '"…"' if k is None else quoted(table, k)
        unit = f', unit = "{channel_of(channel).unit}"' if k is None else ""
        entries += [f"{channel} = {{ column = {column}{unit} }}"] if channel not in has else []
    return listed(entries)
