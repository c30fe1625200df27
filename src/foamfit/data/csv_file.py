"""Read a test file and its TOML into a `Measurement` in SI units.

A file contains one table, one row per sample. The unit of a channel is given in its header, in a
row of units below the header, or in ``[columns]`` of the TOML. The motion may be in a second file
named in ``[motion]`` of the TOML.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from foamfit.arrays import Array, Integers, means
from foamfit.data.frames import Frames, join
from foamfit.data.measurement import (
    MIN_ROWS,
    Dropped,
    Measurement,
    Record,
    Striker,
    Window,
    interior_channel,
    interior_node,
)
from foamfit.data.noise import with_noise
from foamfit.data.outliers import fresh_samples
from foamfit.data.prepare import condition, stress_of_motion
from foamfit.data.tables.columns import TWINS, Source, si_factor
from foamfit.data.tables.csv_table import read_numbers, read_text, without_cut_row
from foamfit.data.tables.draft import without_toml
from foamfit.data.tables.headers import CHANNELS, example
from foamfit.data.toml_file import Column, Settings, is_range, read_settings, toml_beside
from foamfit.data.units import LARGEST
from foamfit.errors import InputError, naming
from foamfit.text import engineering, percent


def _with_cycles(window: Window, cycle: int | None, cycles: tuple[int, int] | None) -> Window:
    """Override the cycles of the TOML by those passed to `read_test`."""
    if cycles is None:
        return window if cycle is None else replace(window, cycle=cycle, last=None)
    if cycle is not None:
        raise InputError("give either cycle or cycles, not both")
    if not is_range(cycles):
        raise InputError(
            f"cycles = {cycles!r} must be the numbers of the first and the last one, like (1, 3)"
        )
    return replace(window, cycle=cycles[0], last=cycles[1])


def read_test(
    path: str | Path,
    specimen: str | Path | None = None,
    cycle: int | None = None,
    *,
    cycles: tuple[int, int] | None = None,
) -> Measurement:
    """Read and check a test file and its TOML, and prepare the data for a fit.

    Parameters
    ----------
    path : str or Path
        CSV file separated by commas, semicolons or tabs, one row per sample.
    specimen : str or Path, optional
        TOML file; by default the file of the same name ending in ``.toml`` next to the table.
    cycle : int, optional
        Number of the cycle of a slow test; by default the one in ``[window]`` of the TOML, or else
        the first. Strain in a later cycle is counted from the contact of that cycle; the strain
        not recovered until then is subtracted and returned as `start_strain`.
    cycles : (int, int), optional
        Numbers of the first and last of several cycles that are used as one history.

    Returns
    -------
    Measurement
        Channels in SI, compression positive, time zero at the start of contact. Its `notes`
        describe each step of the preparation.

    Raises
    ------
    InputError
        If the file, the TOML or their contents are invalid.
    """
    path = Path(path)
    toml = Path(specimen) if specimen is not None else toml_beside(path)
    if specimen is None and not os.path.lexists(toml):
        raise without_toml(toml, read_text(path, "the CSV file of a test"))
    settings = read_settings(toml, path, channels=CHANNELS)
    text = read_text(path, "the CSV file of a test", settings.sheet)
    window = _with_cycles(settings.window, cycle, cycles)
    with naming(path):
        source = Source.of(text, settings.columns)
        record = _record(source, settings)
    sha256, spreads, moved = text.sha256, source.scale_spreads(), source
    entries = source.entries()
    if settings.motion is not None:
        moved, frames, notes = _read_motion(path, toml, settings)
        with naming(toml):
            record = join(record.noted(*notes), frames)
        spreads |= moved.scale_spreads()
        entries |= moved.entries("motion.columns")
        sha256 = hashlib.sha256(f"{sha256} {moved.table.sha256}".encode()).hexdigest()

    def advice(channel: str) -> str:
        of_motion = moved is not source and channel.startswith("displacement")
        return _of_motion(moved.sign_advice(channel)) if of_motion else source.sign_advice(channel)

    with naming(path):
        test = condition(
            record,
            settings.specimen,
            striker=settings.striker,
            window=window,
            advice=advice,
            spread=settings.uncertainties.get("velocity", 0.0),
        )
    for channel, unit in (("stress", "Pa"), ("displacement", "m")):
        size, sigma = float(np.ptp(test.channels()[channel])), getattr(settings.noise, channel)
        if sigma is not None and sigma > size:
            raise InputError(
                f"{toml}: [noise] {channel} = {engineering(sigma, unit)} is "
                f"{percent(sigma / size, 3)} of the range of the measured {channel}, "
                f"{engineering(size, unit)}; give one standard deviation."
            )
    test = replace(
        test,
        name=settings.name,
        path=path,
        data_sha256=sha256,
        uncertainties=spreads | settings.uncertainties,
        noise=replace(settings.noise, estimated=test.noise.estimated),
        priors=settings.priors,
        entries=entries,
    )
    return with_noise(test)


def read_history(path: Path, channel: str) -> tuple[Array, Array]:
    """Read time and one other channel of a table in SI; columns without a unit are in SI."""
    wanted = f"a CSV with the columns 'time (ms)' and '{example(channel)}'"
    text = read_text(path, wanted)
    with naming(path):
        source = Source.of(text, {}).only(("time", channel))
        for name in ("time", channel):
            if name not in source.columns:
                raise InputError(f"has no column for the {name}; it must be {wanted}.")
        headers = source.table.headers
        numbers, rows, _ = read_numbers(source.table, source.columns)
        _check_time(numbers["time"], headers[source.columns["time"]].text, rows)
        for name, k in source.columns.items():
            in_si = None if headers[k].unit else Column(headers[k].text, CHANNELS[name].si)
            numbers[name] *= si_factor(source.table, name, k, in_si)
    return numbers["time"], numbers[channel]


def _read_motion(path: Path, toml: Path, settings: Settings) -> tuple[Source, Frames, list[str]]:
    """Read the file named in [motion]; return its source, its frames and notes."""
    motion, spreads = settings.motion, settings.uncertainties
    assert motion is not None  # checked by the caller
    name = motion.file.name
    if os.path.realpath(motion.file) == os.path.realpath(path):
        raise InputError(
            f"{toml}: [motion] file = {name!r} is the file of the force; name one of its own."
        )
    text = read_text(motion.file, f"in [motion] file of {toml.name} the CSV file of the motion")
    try:
        with naming(motion.file):
            source = Source.of(text, motion.columns).of_motion()
            numbers, _, dropped, notes = _channels(source, settings)
    except InputError as error:
        raise InputError(_of_motion(str(error))) from None
    notes += [f"Not used: {item}." for item in dropped]
    top = _one_of(numbers, "displacement", "strain", 1 / settings.specimen.height, "height", notes)
    assert top is not None  # see `Source.of_motion`
    inside = {interior_channel(k): w for k, w in _inside(numbers, top, notes).items()}
    moved = {"displacement": top} | inside
    frames = Frames(name, numbers["time"], moved, motion.delay, spreads.get("delay"))
    return source, frames, [f"{name}: {note}" for note in notes]


def _of_motion(text: str) -> str:
    return text.replace("[columns]", "[motion.columns]")


def _record(source: Source, settings: Settings) -> Record:
    """Read the channels needed for the test, in SI; notes name the columns used."""
    source = source.needed(settings)
    numbers, rows, dropped, notes = _channels(source, settings)
    notes += _compare(source, numbers, settings)
    specimen, striker = settings.specimen, settings.striker or Striker()
    if settings.striker is not None and "time" not in numbers:
        notes.append(
            "Check: there is a [striker] but no time column, so this is treated as a slow test "
            "and the striker is not used; name the time in [columns]."
        )
    stress = _one_of(numbers, "stress", "force", specimen.area, "the area", notes)
    displacement = _one_of(numbers, "displacement", "strain", 1 / specimen.height, "height", notes)
    acceleration = numbers.get("acceleration")
    derived, braked = tuple[str, ...](), stress is None
    if stress is None:
        assert striker.mass is not None  # see `Source.needed`
        ratio = striker.mass / specimen.area
        if acceleration is not None:
            stress, acceleration = acceleration * ratio, None
            notes.append("The force is the striker's mass times its acceleration.")
        else:
            motion = numbers["time"], displacement, numbers.get("velocity")
            stress = stress_of_motion(*motion, ratio, striker.gravity or 0.0)
            derived = ("stress",)
            notes.append(
                "The force is the striker's mass times the deceleration of its motion, from a "
                "smoothing spline; it is not an independent measurement."
            )
    inside = _inside(numbers, displacement, notes)
    return Record(
        numbers.get("time"),
        stress,
        displacement,
        numbers.get("velocity"),
        acceleration,
        interior=inside,
        cycle=numbers.get("cycle"),
        numbers=rows,
        dropped=tuple(dropped),
        derived=derived,
        braked=braked,
        notes=tuple(notes),
    )


def _channels(
    source: Source, settings: Settings
) -> tuple[dict[str, Array], Integers, list[Dropped], list[str]]:
    """Return the channels of a table in SI, their row numbers, dropped rows, and notes."""
    table, dropped = without_cut_row(source.table)
    factors = {channel: source.factor(channel) for channel in source.columns}
    numbers, rows, empty = read_numbers(table, source.columns)
    if rows.size < MIN_ROWS:
        raise InputError(f"has fewer than {MIN_ROWS} rows; a test needs more.")
    notes = [source.note()]
    for channel, values in numbers.items():
        header = table.headers[source.columns[channel]]
        column, measure = f"column {header.text!r}", header.measure(channel)
        if np.ptp(values) == 0:
            raise InputError(f"{column} is constant; a {channel} must vary.")
        numbers[channel] = _nominal(measure, values * factors[channel])
        if not 1.0 / LARGEST < np.max(np.abs(numbers[channel])) < LARGEST:
            raise InputError(
                f"{column} is up to {np.max(np.abs(values)):.3g} in the file, which cannot be a "
                f"{channel}; correct its numbers, its unit or its scale."
            )
        if measure:
            notes.append(f"The strain is converted from the {measure} strain {header.text!r}.")
    # Some instruments write the number of samples into the header.
    for row, line in enumerate(table.content.split("\n", table.first_row)[: table.first_row], 1):
        match = re.match(r"\W*(?:number of )?samples\W+(\d+)", line, re.IGNORECASE | re.ASCII)
        if match and int(match[1]) != rows.size:
            counts = f"{int(match[1])} samples, the table has {rows.size}"
            notes.append(f"Check: row {row} announces {counts}.")
            break
    if empty.size:
        dropped.append(Dropped.of(empty, "no numbers in the columns in use"))
    if "time" in numbers:
        if settings.duplicates == "average":
            numbers, rows = _averaged(numbers, rows, dropped, notes)
        _check_time(numbers["time"], table.headers[source.columns["time"]].text, rows)
    return numbers, rows, dropped, notes


def _nominal(measure: str, strain: Array) -> Array:
    """Convert a strain of another measure to engineering strain, positive in compression."""
    if measure == "logarithmic":
        return 1.0 - np.exp(-strain)
    if measure and strain.max() >= 0.5:
        raise InputError(
            f"the {measure} strain reaches {strain.max():.3g}; in compression it stays below 0.5, "
            "so the column must contain another strain or have another unit."
        )
    return 1.0 - np.sqrt(1.0 - 2.0 * strain) if measure else strain


def _compare(source: Source, numbers: dict[str, Array], settings: Settings) -> list[str]:
    """Compare the columns in use with alternative columns of the same channel.

    Raises InputError if an impact has two inconsistent time columns.
    """
    table, notes = source.table, list[str]()
    as_used = {"force": 1 / settings.specimen.area, "strain": settings.specimen.height}
    for channel, k in source.left_out().items():
        try:
            values = read_numbers(table, {channel: k})[0][channel]
            values = values * si_factor(table, channel, k, None)
            values = _nominal(table.headers[k].measure(channel), values)
        except InputError:  # not usable as an alternative
            continue
        used = TWINS.get(channel, channel)
        one, name = numbers[used] * as_used.get(used, 1.0), table.name(k)
        if len(values) != len(one) or (channel == "time" and "time" in settings.columns):
            continue
        if channel != "time":
            other = (values - values[0]) * as_used.get(channel, 1.0)
            other = one[0] + other * np.sign(np.dot(other, one - one[0]))
            by = percent(float(np.max(np.abs(other - one)) / np.ptp(one)))
            notes.append(
                f"The {channel} {name} is left out; it differs by up to {by} of the range."
            )
        elif np.diff(values).min() > 0 and np.ptp(values - one) > np.median(np.diff(one)):
            both = f"columns {table.name(source.columns['time'])} and {name} are times that differ"
            by = engineering(float(np.ptp(values - one)), "s")
            if settings.striker is not None:
                raise InputError(
                    f"{both} by {by}; name the right one in [columns], or put a "
                    "motion with its own clock into a file of its own ([motion])."
                )
            notes.append(f"Check: {both} by {by}; the first is used.")
    return notes


def _inside(numbers: dict[str, Array], top: Array | None, notes: list[str]) -> dict[int, Array]:
    """Return the displacements of interior masses, without a copy of that of the top."""
    inside = {}
    for channel, values in numbers.items():
        node = interior_node(channel)
        if node and top is not None and np.allclose(values, top, 0.0, 1e-9 * np.ptp(top)):
            notes.append(f"{channel} is the displacement of the top; it is left out.")
        elif node:
            inside[node] = values
    return inside


def _averaged(
    numbers: dict[str, Array], rows: Integers, dropped: list[Dropped], notes: list[str]
) -> tuple[dict[str, Array], Integers]:
    """Average consecutive rows with the same time stamp, and count them as dropped."""
    time = numbers["time"]
    starts, _ = fresh_samples(time)
    again = np.delete(rows, starts)
    if not again.size:
        return numbers, rows
    dropped.append(Dropped.of(again, "the time stamp of the row before, averaged with it"))
    notes.append(
        f"Check: {again.size} of {len(time)} rows have the time stamp of the row before, the first "
        f"in row {again[0]}; rows with the same stamp are averaged (or refused by [data] "
        'duplicates = "refuse").'
    )
    averages = {channel: means(values, starts) for channel, values in numbers.items()}
    return averages | {"time": time[starts]}, rows[starts]


def _check_time(time: Array, name: str, rows: Integers) -> None:
    """Raise InputError unless the time increases from row to row."""
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = int(back[0]) + 1
        wrong, more = "goes back", ""
        if time[i] == time[i - 1]:
            more = ' (in a test, [data] duplicates = "average" averages rows with the same stamp)'
            wrong = "repeats"
        elif len(back) > len(time) / 2:
            more = "; as the record runs backwards, reverse the order of its rows"
        where = f"row {rows[i]}, column {name!r}"
        raise InputError(f"{where}: time {wrong}; it must increase from row to row{more}.")


def _one_of(
    numbers: dict[str, Array], first: str, second: str, ratio: float, by: str, notes: list[str]
) -> Array | None:
    """Return `first`, or else `second` divided by `ratio`; note whether both agree to 3 %."""
    one, two = numbers.get(first), numbers.get(second)
    if two is None:
        return one
    if one is None:
        operation = "over" if first == "stress" else "times"
        notes.append(f"The {first} is the {second} {operation} {by}.")
        return two / ratio
    slope = float(np.dot(two, one) / np.dot(one, one)) / ratio
    apart = percent(max(1e-5, float(np.max(np.abs(two / ratio - one)) / np.ptp(one))))
    if abs(slope - 1) > 0.03:
        agree = f"{slope:.3g} times its equivalent with {by} of the specimen; they are inconsistent"
        notes.append(f"Check: the {first} is used, but the {second} is {agree}.")
    else:
        used = f"The {first} is used rather than the {second}"
        notes.append(f"{used}, and they agree to {apart} of the range.")
    return one
