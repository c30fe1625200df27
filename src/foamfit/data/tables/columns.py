"""Assign the columns of a table to channels, and find their factors to SI."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from foamfit.data.measurement import Entry, Striker, interior_channel, interior_node
from foamfit.data.tables.csv_table import Table, Text, find_table, read_numbers, without_foot
from foamfit.data.tables.headers import CHANNELS, WEAK, WEIGHTS, channel_of, example, in_si
from foamfit.data.toml_file import Settings
from foamfit.data.units import is_unit
from foamfit.errors import InputError
from foamfit.text import listed, percent

_MOTIONS = "displacement", "strain"
TWINS = {"stress": "force", "force": "stress", "displacement": "strain", "strain": "displacement"}
# Channels that stress and displacement are read from, the preferred one first.
SOURCES = {"stress": ("stress", "force", "acceleration"), "displacement": _MOTIONS}


@dataclass(frozen=True)
class Source:
    """A table, the column number of each channel, and the entries in a `section` of the TOML."""

    table: Table
    columns: dict[str, int]
    given: dict[str, Entry]
    section: str = "columns"

    @classmethod
    def of(
        cls, text: Text, given: dict[str, Entry], unclear: dict[str, list[int]] | None = None,
        section: str = "columns",
    ) -> Source:  # fmt: skip
        """Find the table in the text of a file and the columns of the channels.

        If several columns could be a channel, they are added to `unclear`. Without that, this
        raises InputError, and for a table without headers, unless it is given numbers of columns.
        """
        names = {column.column for column in given.values()}
        table = without_foot(find_table(text, names if unclear is None else {*names, 1}))
        return cls(table, _assigned(table, given, unclear), given, section)

    def factor(self, channel: str) -> float:
        """Return the factor from the numbers of a channel to SI."""
        return si_factor(self.table, channel, self.columns[channel], self.given.get(channel))

    def name(self, channel: str) -> str:
        """Return the quoted header of a channel."""
        return self.table.name(self.columns[channel])

    @cached_property
    def entries(self) -> dict[str, Entry]:
        """The entries by which the channels are read: those of the TOML, completed."""
        entries = dict[str, Entry]()
        for channel, k in self.columns.items():
            given = self.given.get(channel, Entry(channel))
            over = _inverse(given, given.unit or self.table.headers[k].unit or "") is not None
            column = column_of(self.table, k)
            entries[channel] = replace(given, column=column, inverse=over, table=self.section)
        return entries

    def in_use(self) -> dict[str, Entry]:
        """Return the entries by which stress, displacement, velocity, acceleration are read."""
        own = {c: e for c, e in self.entries.items() if c in ("velocity", "acceleration")}
        for name, channels in SOURCES.items():
            if used := next((c for c in channels if c in self.entries), None):
                own.pop(used, None)  # an acceleration read as a force is no channel of its own
                own[name] = self.entries[used]
        return own

    def only(self, channels: Iterable[str]) -> Source:
        """Return a source with these channels only."""
        return replace(self, columns={c: k for c, k in self.columns.items() if c in channels})

    def needed(self, settings: Settings) -> Source:
        """Select the channels to read; raise InputError if an indispensable one is missing."""
        table, has, motion = self.table, set(self.columns), settings.motion
        striker = settings.striker or Striker()
        forced, moved = bool(has & {"stress", "force"}), bool(has & set(_MOTIONS))
        braked = bool(has & {"acceleration", "velocity"} or (moved and striker.velocity))
        if not forced and not ("time" in has and braked and striker.mass):
            more = "with a time and the [striker] mass an acceleration or a velocity will do, and "
            wanted, others = ("stress", "force"), ("displacement", "time")
            raise self._missing(wanted, others, f"; {more}with its velocity a displacement")
        if motion is not None:
            own = [c for c in self.columns if c in _MOTIONS or interior_node(c)]
            if own:
                header = table.headers[self.columns[own[0]]].text
                wrong = f"column {header!r} is a {own[0]}, but [motion] file = {motion.file.name!r}"
                raise InputError(f"{wrong} contains the motion; leave one of them out.")
            if "time" not in has:
                wrong = f"no column is a time (there are {table.listed})"
                raise InputError(f"{wrong}; with [motion] it needs one like 'time (ms)'.")
        optional = {"velocity"} if moved or "acceleration" in has else set[str]()
        optional = {"velocity", "acceleration"} if forced else optional
        if moved or motion is not None:
            return self.only(has - optional)
        for channel in has & optional - set(self.given):
            try:  # ignore an optional channel without a usable unit
                self.factor(channel)
            except InputError:
                has.remove(channel)
        integrable = striker.velocity and (striker.mass or "acceleration" in has)
        if "time" not in has or not ("velocity" in has or integrable):
            timed = "" if "time" in has else f"{entries_of(table, has, 'time')} there, and "
            more = f", or give {timed}the [striker] mass and velocity to integrate the motion"
            raise self._missing(_MOTIONS, (), more)
        return self.only(has)

    def of_motion(self) -> Source:
        """Select time and displacements of a [motion] file; raise InputError if one is missing."""
        present = {c for c in self.columns if c in ("time", *_MOTIONS) or interior_node(c)}
        for wanted in (("time",), _MOTIONS):
            if not present & set(wanted):
                raise self._missing(wanted)
        return self.only(present)

    def _missing(
        self, wanted: tuple[str, ...], others: tuple[str, ...] = (), more: str = ""
    ) -> InputError:
        """Return the error for a file without any of the `wanted` channels."""
        entry = "force" if "force" in wanted else wanted[0]
        entries = entries_of(self.table, set(self.columns), entry, *others)
        wrong = f"no column is a {' or a '.join(wanted)} (there are {self.table.listed})"
        remedy = f"name one like '{example(wanted[0])}', or write {entries} in [columns]{more}"
        return InputError(f"{wrong}; {remedy}.")

    def left_out(self) -> dict[str, int]:
        """Return unused columns that duplicate a channel: its twin, or another time."""
        found = dict[str, int]()
        for channel in (c for c in self.columns if c in {"time", *TWINS}):
            twin = TWINS.get(channel, channel)
            headers = ((k, h.rank(twin)) for k, h in enumerate(self.table.headers))
            ranks = {k: r for k, r in headers if r is not None and k not in self.columns.values()}
            if ranks and (twin not in self.columns or channel == "time"):
                found[twin] = min(ranks, key=ranks.__getitem__)
        return found

    def note(self) -> str:
        """Return a note with the column of each channel and the unused columns."""
        parts, table = [], self.table
        for channel, entry in self.entries.items():
            by = f"{entry.scale:.6g} {entry.scale_unit}".strip()
            by += f" ± {percent(entry.spread)}" if entry.spread else ""
            how = "over the sensitivity" if entry.inverse else "times"
            part = f"{channel} from {self.name(channel)}"
            part += f" in {entry.unit}" if entry.unit else ""
            part += f" {how} {by}" if by != "1" else ""
            part += ", counting down" if entry.counts_down else ""
            unit = entry.unit or table.headers[self.columns[channel]].unit or ""
            if channel == "force" and unit.casefold() in WEIGHTS:
                part += f" ({WEIGHTS[unit.casefold()]}: the weight of that mass)"
            parts.append(part)
        used = self.columns.values()
        rest = [repr(h.text) for k, h in enumerate(table.headers) if h.text and k not in used]
        return f"Read {', '.join(parts)}" + (f"; not used: {', '.join(rest)}." if rest else ".")

    def sign_entry(self, channel: str) -> Entry:
        """Return the entry of the TOML that reverses the sign of a channel."""
        entry = self.entries[channel]
        if channel.startswith("displacement"):
            return replace(entry, counts_down=True)
        return replace(entry, scale=-entry.scale)

    def stated_sign(self, channel: str) -> str:
        """Return what reverses the sign of a channel in the TOML; "" if nothing does."""
        entry = self.entries[channel]
        minus = f"the minus sign of scale = {entry.scale:g}" if entry.scale < 0.0 else ""
        return "counts_down = true" if entry.counts_down else minus


def _assigned(
    table: Table, given: dict[str, Entry], unclear: dict[str, list[int]] | None
) -> dict[str, int]:
    """Return the column number of each channel; see `Source.of`."""
    found: dict[str, int] = {}
    strained = "strain" in given or any(h.rank("strain") is not None for h in table.headers)
    for channel in _channels(table, given):
        if channel not in given and TWINS.get(channel) in given:
            continue  # its twin in the TOML takes precedence
        if channel in given:
            found[channel] = _place(table, channel, given[channel].column)
            continue
        ranks = {k: r for k, h in enumerate(table.headers) if (r := h.rank(channel)) is not None}
        best = _best(table, channel, ranks)
        if not best or (ranks[best[0]] == WEAK and strained):
            continue
        if len(best) == 1:
            found[channel] = best[0]
            continue
        if unclear is None:
            both = " and ".join(map(table.name, best))
            entry = Entry(channel, column_of(table, best[0]))
            remedy = f"keep one, or write {entry} in [columns]"
            raise InputError(f"columns {both} could both be the {channel}; {remedy}.")
        unclear[channel] = best
    # A true stress cannot be converted: the current cross-section is unknown.
    true = "stress" in found and table.headers[found["stress"]].measure("stress")
    if true and "stress" not in given and "force" in found:
        del found["stress"]
    return found


def _best(table: Table, channel: str, ranks: dict[int, int]) -> list[int]:
    best = [k for k, rank in ranks.items() if rank == min(ranks.values())]
    names = {k: table.headers[k] for k in best}  # "stress" is better than "reference stress"
    best = [k for k in best if not any(names[k].qualifies(names[other]) for other in best)]
    if len(best) < 2 or channel != "time":
        return best
    try:  # the only time column that never decreases, if any
        numbers = read_numbers(table, {str(k): k for k in best})[0]
    except InputError:  # for example tests of different lengths side by side
        return best
    steps = {k: np.diff(numbers[str(k)]) for k in best}
    rising = [k for k, step in steps.items() if step.size and step.min() >= 0.0 < step.max()]
    return rising if len(rising) == 1 else best


def _channels(table: Table, given: dict[str, Entry]) -> list[str]:
    """List the channels to look for: the usual ones, then those of interior masses."""
    numbers = {int(w) for h in table.headers for w in h.words if w.isdecimal()}
    inside = {c for c in (*map(interior_channel, numbers), *given) if interior_node(c)}
    return [*CHANNELS, *sorted(inside, key=lambda c: (c not in given, interior_node(c) or 0))]


def _place(table: Table, channel: str, column: str | int) -> int:
    """Return the index of a column given in the TOML by its header or number."""
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


def column_of(table: Table, k: int) -> str | int:
    """Return a column as written in [columns]: its header, or its number if not unique."""
    text = table.headers[k].text
    unique = table.header_row and [h.text for h in table.headers].count(text) == 1
    return text if unique else k + 1


def si_factor(table: Table, channel: str, k: int, given: Entry | None) -> float:
    """Return the factor from the numbers of column `k` to SI."""
    header, given = table.headers[k], given or Entry(channel)
    # A count (pint would read "Cycles" in a header as a unit of angle), or times of a clock, s.
    if channel == "cycle" or (channel == "time" and table.period(k)):
        return 1.0
    right, where = example(channel), f"column {table.name(k)}"
    if header.measure(channel) and channel == "stress":
        raise InputError(
            f"{where} is a {header.measure(channel)} stress, which needs the cross-section of each "
            "instant; give the force or the nominal (engineering) stress."
        )
    unit = given.unit if given.unit is not None else header.unit
    if unit is None and in_si(channel, "", given.scale_unit) is None:
        usual = channel_of(channel).unit
        if given.scale_unit:
            over, _, under = given.scale_unit.rpartition("/")
            usual = under if in_si(channel, under) is None else over  # of N/mV or mV/N
        entry = replace(given, column=column_of(table, k), unit=usual)
        remedy = f"write it in the header like '{right}' or in [columns] like {entry}"
        raise InputError(f"{where} has no unit; {remedy}.")
    unit = unit or ""
    if not is_unit(unit, any_case=True):
        raise InputError(f"{where} has an unknown unit {unit!r}; write it like '{right}'.")
    own = header.unit
    if given.unit is not None and own is not None and is_unit(own, any_case=True):
        stated, in_header = in_si(channel, given.unit), in_si(channel, own)
        # Without brackets, the last word of a name may only look like a unit.
        bracketed = in_header is not None or header.text.endswith((")", "]", "}"))
        other = stated is None and given.unit.casefold() != own.casefold()
        if bracketed and (stated != in_header or other):
            raise InputError(
                f"{where} has the unit {own!r} in its header, but [columns] {channel} says "
                f"{given.unit!r}; leave unit out, or, if the header is wrong, correct it by scale."
            )
    si, inverse = in_si(channel, unit, given.scale_unit), _inverse(given, unit)
    si = inverse / given.scale**2 if inverse is not None else si
    if si is None:
        raise InputError(
            f"{where} cannot be read as {channel}: its unit {unit!r} has the wrong dimension; "
            f"write it like '{right}' or give a scale in [columns]."
        )
    return given.scale * si * (-1.0 if given.counts_down else 1.0)


def _inverse(given: Entry, unit: str) -> float | None:
    """Return the factor to SI if the scale is a sensitivity such as "4 mV/N", else None."""
    if not given.scale_unit or in_si(given.channel, unit, given.scale_unit) is not None:
        return None
    return in_si(given.channel, unit, f"1/({given.scale_unit})")


def entries_of(table: Table, has: set[str], *channels: str) -> str:
    """Suggest entries of [columns] for missing channels; a column only if its unit is unique."""
    entries, headers = [], [(k, h) for k, h in enumerate(table.headers) if h.nameless and h.unit]
    for channel in (c for c in channels if c not in has):
        fits = [k for k, header in headers if in_si(channel, header.unit or "") is not None]
        if len(fits) == 1:
            entries.append(str(Entry(channel, column_of(table, fits[0]))))
        else:
            entries.append(str(Entry(channel, unit=channel_of(channel).unit)))
    return listed(entries)
