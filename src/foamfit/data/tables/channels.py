"""Read the channels of a file in SI, and reverse those that are negative in compression."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from foamfit.arrays import Array, Integers, means
from foamfit.data.measurement import MIN_ROWS, Dropped, Window
from foamfit.data.outliers import fresh_samples
from foamfit.data.tables.columns import Source
from foamfit.data.tables.csv_table import read_numbers, without_cut_row
from foamfit.data.tables.signs import negative_channels
from foamfit.data.units import LARGEST
from foamfit.errors import InputError

_COPIES = 0.9  # share of these that equal it in all channels, above which rows were repeated
_COARSE = 0.1  # share of rows with the stamp of the row before, from which a clock is coarse


@dataclass
class Channels:
    """The channels of a file in SI, their rows in the file, the dropped rows, and notes.

    Time of the test = time of the file + `delay`, s. `section` is the one of the TOML that
    describes the columns.
    """

    source: Source
    numbers: dict[str, Array]
    rows: Integers
    dropped: list[Dropped]
    notes: list[str]
    section: str = "columns"
    delay: float = 0.0

    def turn(self, channel: str) -> None:
        """Reverse the sign of a channel, with a note."""
        values, name = self.numbers[channel], self.source.name(channel)
        down = "counts down" if values.min() >= 0.0 else "is negative"
        self.numbers[channel] = -values
        self.notes.append(f"The {channel} {name} {down} in compression; its sign is reversed.")

    def engineering(self) -> dict[str, Array]:
        """Convert a strain of another measure to engineering strain, with a note."""
        for channel, values in self.numbers.items():
            if measure := self.source.measure(channel):
                self.numbers[channel] = engineering_strain(measure, values)
                was = f"{measure} strain {self.source.name(channel)}"
                self.notes.append(f"The strain is converted from the {was}.")
        return self.numbers


def read_channels(
    source: Source, duplicates: str, section: str = "columns", delay: float = 0.0
) -> Channels:
    """Read the channels of a table; for `duplicates` see `toml_file`."""
    table, cut = without_cut_row(source.table)
    factors = {channel: source.factor(channel) for channel in source.columns}
    numbers, rows, dropped = read_numbers(table, source.columns)
    if rows.size < MIN_ROWS:
        raise InputError(f"has fewer than {MIN_ROWS} rows; a test needs more.")
    notes = [source.note()]
    for channel, values in numbers.items():
        column = f"column {source.name(channel)}"
        if np.ptp(values) == 0:
            raise InputError(f"{column} is constant; a {channel} must vary.")
        numbers[channel] = values * factors[channel]
        if not 1.0 / LARGEST < np.max(np.abs(numbers[channel])) < LARGEST:
            raise InputError(
                f"{column} is up to {np.max(np.abs(values)):.3g} in the file, which cannot be a "
                f"{channel}; correct its numbers, its unit or its scale."
            )
    # Some instruments write the number of samples into the header.
    for row, line in enumerate(table.content.split("\n", table.first_row)[: table.first_row], 1):
        match = re.match(r"\W*(?:number of )?samples\W+(\d+)", line, re.IGNORECASE | re.ASCII)
        if match and (said := int(match[1])) != rows.size:
            notes.append(f"Check: row {row} announces {said} samples, the table has {rows.size}.")
            break
    dropped = [*cut, *dropped]
    if "time" in numbers:
        if duplicates == "average":
            numbers, rows = _averaged(numbers, rows, dropped, notes)
        check_time(numbers["time"], source.name("time"), rows)
    return Channels(source, numbers, rows, dropped, notes, section, delay)


def engineering_strain(measure: str, strain: Array) -> Array:
    """Convert a strain of another measure to engineering strain, positive in compression."""
    if measure == "logarithmic":
        return 1.0 - np.exp(-strain)
    if measure and strain.max() >= 0.5:
        raise InputError(
            f"the {measure} strain reaches {strain.max():.3g}; in compression it stays below 0.5, "
            "so the column must contain another strain or have another unit."
        )
    return 1.0 - np.sqrt(1.0 - 2.0 * strain) if measure else strain


def _averaged(
    numbers: dict[str, Array], rows: Integers, dropped: list[Dropped], notes: list[str]
) -> tuple[dict[str, Array], Integers]:
    """Average consecutive rows with the same time stamp, and count them as dropped."""
    time = numbers["time"]
    starts, _ = fresh_samples(time)
    again = np.delete(rows, starts)
    if not again.size:
        return numbers, rows
    same = np.all([np.diff(values) == 0 for values in numbers.values()], axis=0)
    copies = np.count_nonzero(same) > _COPIES * again.size  # whole rows, written several times
    if not copies and again.size > _COARSE * time.size and (even := _evenly(time)) is not None:
        notes.append(
            f"{again.size} of {time.size} rows have the time stamp of the row before: the clock is "
            "coarser than the rows, which are even within its steps and are taken as even."
        )
        return numbers | {"time": even}, rows
    dropped.append(Dropped.of(again, "the time stamp of the row before, averaged with it"))
    notes.append(
        f"Check: {again.size} of {len(time)} rows have the time stamp of the row before, the first "
        f"in row {again[0]}; rows with the same stamp are averaged (or refused by [data] "
        'duplicates = "refuse").'
    )
    averages = {channel: means(values, starts) for channel, values in numbers.items()}
    return averages | {"time": time[starts]}, rows[starts]


def _evenly(time: Array) -> Array | None:
    """Return even times for the stamps of a coarse clock; None if the rows are not even."""
    places = np.arange(time.size)
    slope, start = np.polyfit(places, time, 1)
    even = start + slope * places
    return even if np.ptp(time - even) < 1.2 * np.median(np.diff(np.unique(time))) else None


def check_time(time: Array, name: str, rows: Integers) -> None:
    """Raise InputError unless the time increases from row to row."""
    back = np.flatnonzero(np.diff(time) <= 0)
    if not back.size:
        return
    i, wrong, more = int(back[0]) + 1, "goes back", ""
    if time[i] == time[i - 1]:
        more = ' (in a test, [data] duplicates = "average" averages rows with the same stamp)'
        wrong = "repeats"
    elif len(back) > len(time) / 2:
        more = "; as the record runs backwards, reverse the order of its rows"
    where = f"row {rows[i]}, column {name}"
    raise InputError(f"{where}: time {wrong}; it must increase from row to row{more}.")


def turn_negative(parts: list[Channels], window: Window) -> tuple[str, ...]:
    """Reverse the channels that are negative in compression, and return their names.

    The first part contains the force, a second one a motion with its own clock. Raises InputError
    if the TOML states this sign, or if the record does not show which channel is wrong.
    """
    owners = {c: part for part in parts for c in part.numbers if c not in ("time", "cycle")}
    channels = {c: part.numbers[c] for c, part in owners.items()}
    time = parts[0].numbers.get("time")
    if time is not None:
        clocks = {part.section: part.numbers["time"] + part.delay for part in parts}
        first = max(window.start, *(clock[0] for clock in clocks.values()))
        last = min(window.end, *(clock[-1] for clock in clocks.values()))
        time = time[(time >= first) & (time <= last)]
        if time.size < MIN_ROWS:
            return ()  # refused later
        for channel, part in owners.items():
            channels[channel] = np.interp(time, clocks[part.section], channels[channel])
    wrong, certain = negative_channels(channels, time)
    entries = [f"{owners[c].source.sign_entry(c)} in [{owners[c].section}]" for c in wrong]
    if not certain:
        raise InputError(
            f"{' and '.join(wrong)} change in opposite directions under load, and the record does "
            f"not show which of them is negative in compression: write {' or '.join(entries)}."
        )
    for channel in wrong:
        if stated := owners[channel].source.stated_sign(channel):
            raise InputError(
                f"the {channel} is negative in compression; it must be positive: leave {stated} "
                f"out in [{owners[channel].section}]."
            )
        owners[channel].turn(channel)
    return tuple(wrong)
