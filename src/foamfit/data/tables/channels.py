"""Read the channels of a file in SI, and reverse those that are negative in compression.

Signs are judged over the loading. A run is a part of the record in which the motion does not turn.
The first run in which the force does a considerable part of its work is the loading (or the
unloading, if the force falls to zero in it). It shows the directions of force and motion in
compression. Extremes have no influence: adhesion, a spike or rows after the test do little work.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from foamfit.arrays import Array, Integers, means
from foamfit.data.cycles import find_turns
from foamfit.data.measurement import MIN_ROWS, Dropped, Window
from foamfit.data.noise import integrated_twice, noise_level
from foamfit.data.outliers import fresh_samples, inner_samples
from foamfit.data.tables.columns import SOURCES, Source
from foamfit.data.tables.csv_table import read_numbers
from foamfit.data.units import LARGEST
from foamfit.errors import InputError

_COPIES = 0.9  # share of these that equal it in all channels, above which rows were repeated
_COARSE = 0.1  # share of rows with the stamp of the row before, from which a clock is coarse

# Signs
_FIRST = 0.2  # least work (or impulse) of the loading, as a share of the largest one
_FEW, _NEAR = 9, 0.002  # most samples at an end of a run, and most of its way, with one force
_UNLOADED = 0.25  # an unloading ends below this share of the force at its start
_LOADED = 0.1  # share of the mean load that counts as a load
_ONE_SIDED = 0.5  # most way under the opposite load, as a share of that under load
_AGREE = 0.5  # least share of the work, over all runs, that has the sign of the loading's
_PULSE = 0.3  # share of the mean force of a pulse above which it counts
_NOISE = 8.0  # least size of a pulse in standard deviations of the noise
_SMOOTHED = 30, 5  # least number of samples for a running median, and its width


@dataclass
class Channels:
    """The channels of a file in SI, their rows in the file, the dropped rows, and notes.

    Time of the test = time of the file + `delay`, s.
    """

    source: Source
    numbers: dict[str, Array]
    rows: Integers
    dropped: list[Dropped]
    notes: list[str]
    delay: float = 0.0

    def engineering(self) -> dict[str, Array]:
        """Convert a strain of another measure to engineering strain, with a note."""
        table, columns = self.source.table, self.source.columns
        for channel, values in self.numbers.items():
            if measure := table.headers[columns[channel]].measure(channel):
                self.numbers[channel] = engineering_strain(measure, values)
                was = f"{measure} strain {self.source.name(channel)}"
                self.notes.append(f"The strain is converted from the {was}.")
        return self.numbers


def read_channels(source: Source, duplicates: str, delay: float = 0.0) -> Channels:
    """Read the channels of a table; for `duplicates` see `toml_file`."""
    table = source.table
    factors = {channel: source.factor(channel) for channel in source.columns}
    numbers, rows, dropped = read_numbers(table, source.columns)
    if rows.size < MIN_ROWS:
        raise InputError(f"has fewer than {MIN_ROWS} rows; a test needs more.")
    notes = [source.note()]
    for channel, values in numbers.items():
        column = f"column {source.name(channel)}"
        if values.min() == values.max():
            raise InputError(f"{column} is constant; a {channel} must vary.")
        with np.errstate(over="ignore"):  # what overflows is refused below
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
    dropped = [*table.dropped, *dropped]
    if "time" in numbers:
        if duplicates == "average":
            numbers, rows = _averaged(numbers, rows, dropped, notes)
        check_time(numbers["time"], source.name("time"), rows)
    return Channels(source, numbers, rows, dropped, notes, delay)


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
        clocks = {part.source.section: part.numbers["time"] + part.delay for part in parts}
        first = max(window.start, *(clock[0] for clock in clocks.values()))
        last = min(window.end, *(clock[-1] for clock in clocks.values()))
        time = time[(time >= first) & (time <= last)]
        if time.size < MIN_ROWS:
            return ()  # refused later
        for channel, part in owners.items():
            channels[channel] = np.interp(time, clocks[part.source.section], channels[channel])
    wrong, certain = negative_channels(channels, time)
    if not certain:
        sources = {c: owners[c].source for c in wrong}
        entries = [f"{s.sign_entry(c)} in [{s.section}]" for c, s in sources.items()]
        raise InputError(
            f"{' and '.join(wrong)} change in opposite directions under load, and the record does "
            f"not show which of them is negative in compression: write {' or '.join(entries)}."
        )
    for channel in wrong:
        part = owners[channel]
        if stated := part.source.stated_sign(channel):
            remedy = f"it must be positive: leave {stated} out in [{part.source.section}]"
            raise InputError(f"the {channel} is negative in compression; {remedy}.")
        what = "counts down" if part.numbers[channel].min() >= 0.0 else "is negative"
        what = f"The {channel} {part.source.name(channel)} {what} in compression"
        part.notes.append(f"{what}; its sign is reversed.")
        part.numbers[channel] = -part.numbers[channel]
    return tuple(wrong)


def negative_channels(channels: Mapping[str, Array], time: Array | None) -> tuple[list[str], bool]:
    """Return the channels that are negative in compression, and whether the record proves it.

    The channels have the same rows, but any zero and unit. If force and motion contradict each
    other and the record does not show which of them is wrong, both are returned.
    """
    from scipy.ndimage import median_filter

    force, motion = (next((c for c in names if c in channels), "") for names in SOURCES.values())
    inner = [inner_samples(channels[c]) for c in (force or motion or "velocity", motion) if c]
    kept = slice(max(part.start for part in inner), min(part.stop for part in inner))
    upright = {c: values[kept] for c, values in channels.items()}
    least, width = _SMOOTHED
    if kept.stop - kept.start >= least:  # a running median removes single spikes
        upright = {c: median_filter(v, width, mode="nearest") for c, v in upright.items()}
    if force and motion:
        signs = _signs(upright[force], upright[motion])
        if signs is None:
            return [force, motion], False
        wrong = [c for c, sign in zip((force, motion), signs, strict=True) if sign < 0]
    else:
        wrong = [force] * bool(force and _pulse_is_negative(upright[force]))
        wrong += [motion] * bool(motion and _falls(upright[motion]))
    upright |= {c: -upright[c] for c in wrong}
    for channel, values in upright.items():
        other = force if channel in SOURCES["stress"] else motion
        if other and channel not in (other, "velocity"):
            opposite = np.dot(values - values.mean(), upright[other] - upright[other].mean()) < 0.0
            wrong += [channel] * bool(opposite)
    if time is not None and (velocity := upright.get("velocity")) is not None:
        wrong += ["velocity"] * _falls(integrated_twice(time[kept], velocity)[0])
    return wrong, True


def _signs(force: Array, motion: Array) -> tuple[int, int] | None:
    """Return the signs of force and motion in compression; None if one of them is uncertain.

    Consistent channels remain as they are unless they are negative on one side only.
    """
    ends = np.unique([0, *find_turns(motion), motion.size - 1]).tolist()
    runs = [_judged(force[i : j + 1], motion[i : j + 1]) for i, j in pairwise(ends)]
    zeros, ways, works = np.array(runs).reshape(-1, 3).T
    size = np.abs(works)
    if size.max(initial=0.0) == 0.0:
        return 1, 1
    at = int(np.argmax(size >= _FIRST * size.max()))
    same, towards = (1 if works[at] > 0.0 else -1), int(ways[at])
    sign = same * towards
    if sign > 0 and towards > 0:
        return 1, 1
    zero = float(np.min(sign * zeros[: at + 1]))  # unloaded
    load, steps = sign * force - zero, np.abs(np.diff(motion, append=motion[-1]))
    work = float(np.dot(steps, np.maximum(load, 0.0)))
    # A mean weighted by the load itself does not depend on motion without load.
    mean = float(np.dot(steps, np.maximum(load, 0.0) ** 2)) / work if work else 0.0
    under, against = (float(steps[s * load > _LOADED * mean].sum()) for s in (1, -1))
    agree = same * works.sum() >= _AGREE * size.sum()
    if against < _ONE_SIDED * under and agree and zero + mean > 0.0:
        return sign, towards
    return (1, 1) if same > 0 else None


def _judged(force: Array, motion: Array) -> tuple[float, float, float]:
    """Judge a run: it is a loading unless the force falls from its peak to zero.

    Return the force of the unloaded specimen, the direction of the motion in compression, and the
    work, positive if force and motion have the same direction.
    """
    ends = slice(_FEW), slice(-1, -_FEW - 1, -1)
    near = (np.abs(motion[e] - motion[e][0]) <= _NEAR * np.ptp(motion) for e in ends)
    start, end = (float(np.median(force[e][n])) for e, n in zip(ends, near, strict=True))
    way = float(np.sign(motion[-1] - motion[0]))
    work, other = (float(np.trapezoid(force - zero, motion)) for zero in (start, end))
    falls = abs(end) < _UNLOADED * abs(start) and abs(start) > 0.5 * float(np.abs(force).max())
    # A long way without load does no work from the level at that end.
    work = math.copysign(min(abs(work), abs(other)), work)
    return (end, -way, work) if falls else (start, way, work)


def _pulse_is_negative(force: Array) -> bool:
    """Return whether the first considerable pulse of a force, and most of its impulse, is negative.

    Pulses are parts in which the force differs from its level at the start.
    """
    level = force - np.median(force[: max(5, force.size // 200)])
    size = float(np.dot(level, level)) / max(float(np.abs(level).sum()), 1e-300)
    sides = np.sign(level) * (np.abs(level) > max(_PULSE * size, _NOISE * noise_level(force)))
    impulses = np.add.reduceat(np.abs(sides) * level, fresh_samples(sides)[0])
    considerable = np.abs(impulses) >= _FIRST * np.abs(impulses).max()
    first, total = impulses[int(np.argmax(considerable))], float(np.abs(impulses).sum())
    return bool(first < 0.0 and impulses.sum() < -_AGREE * total)


def _falls(motion: Array) -> bool:
    """Return whether a motion without a force falls, turns and rises again."""
    low = int(np.argmin(motion))
    fallen, risen = motion[0] - motion[low], motion[: low + 1].max() - motion[0]
    return bool(low < 0.98 * motion.size and fallen > max(2 * risen, 0.3 * np.ptp(motion)))
