"""Read a test file and its TOML into a `Measurement` in SI units.

A file contains one table, one row per sample. The unit of a channel is given in its header, in a
row of units below the header, or in ``[columns]`` of the TOML. The motion may be in a second file
named in ``[motion]`` of the TOML.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from foamfit.arrays import Array
from foamfit.data.frames import Frames, join
from foamfit.data.measurement import (
    Entry,
    Measurement,
    Record,
    Striker,
    Window,
    interior_channel,
    interior_node,
)
from foamfit.data.noise import with_noise
from foamfit.data.prepare import condition, stress_of_motion
from foamfit.data.tables.channels import Channels, check_time, read_channels, turn_negative
from foamfit.data.tables.columns import TWINS, Source, entries_of, si_factor
from foamfit.data.tables.csv_table import read_numbers, read_text
from foamfit.data.tables.draft import without_toml
from foamfit.data.tables.headers import CHANNELS, example
from foamfit.data.toml_file import RANGE, Motion, Settings, read_settings, toml_beside
from foamfit.errors import InputError, naming
from foamfit.text import engineering, percent

_MOTION = "motion.columns"


def _with_cycles(window: Window, cycle: int | None, cycles: tuple[int, int] | None) -> Window:
    """Override the cycles of the TOML by those passed to `read_test`."""
    if cycles is None:
        return window if cycle is None else replace(window, cycle=cycle, last=None)
    if cycle is not None:
        raise InputError("give either cycle or cycles, not both")
    first, last = RANGE(cycles, "cycles")
    return replace(window, cycle=first, last=last)


def read_test(
    path: str | Path, specimen: str | Path | None = None, cycle: int | None = None, *,
    cycles: tuple[int, int] | None = None,
) -> Measurement:  # fmt: skip
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
        source = Source.of(text, settings.columns).needed(settings)
        parts = [read_channels(source, settings.duplicates)]
    sha256, stated = text.sha256, settings.uncertainties
    if (motion := settings.motion) is not None:
        parts.append(_read_motion(path, toml, motion, settings.duplicates))
        sha256 = hashlib.sha256(f"{sha256} {parts[1].source.table.sha256}".encode()).hexdigest()
    with naming(path):
        turned = turn_negative(parts, window)
        record = _record(parts[0], settings)
    if motion is not None:
        with naming(motion.file):
            frames, notes = _frames(parts[1], motion.file.name, settings)
        with naming(toml):
            record = join(record.noted(*notes), frames)
    with naming(path):
        test = condition(
            record, settings.specimen, striker=settings.striker, window=window,
            spread=stated.get("velocity", 0.0), stated=settings.noise, late="delay" in stated,
        )  # fmt: skip
    for channel, unit in (("stress", "Pa"), ("displacement", "m")):
        size, sigma = float(np.ptp(test.channels()[channel])), getattr(settings.noise, channel)
        if sigma is not None and sigma > size:
            raise InputError(
                f"{toml}: [noise] {channel} = {engineering(sigma, unit)} is "
                f"{percent(sigma / size, 3)} of the range of the measured {channel}, "
                f"{engineering(size, unit)}; give one standard deviation."
            )
    spreads, entries = dict[str, float](), dict[str, Entry]()
    for part in parts:
        used = part.source.in_use()
        entries |= used
        spreads |= {f"{name}_scale": entry.spread for name, entry in used.items() if entry.spread}
    test = replace(
        test, name=settings.name, path=path, data_sha256=sha256, turned=turned,
        uncertainties=spreads | stated, priors=settings.priors, entries=entries,
    )  # fmt: skip
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
        check_time(numbers["time"], source.name("time"), rows)
        for name, k in source.columns.items():
            in_si = None if headers[k].unit else Entry(name, headers[k].text, CHANNELS[name].si)
            numbers[name] *= si_factor(source.table, name, k, in_si)
    return numbers["time"], numbers[channel]


def _read_motion(path: Path, toml: Path, motion: Motion, duplicates: str) -> Channels:
    if os.path.realpath(motion.file) == os.path.realpath(path):
        wrong = f"[motion] file = {motion.file.name!r} is the file of the force"
        raise InputError(f"{toml}: {wrong}; name one of its own.")
    text = read_text(motion.file, f"in [motion] file of {toml.name} the CSV file of the motion")
    try:
        with naming(motion.file):
            source = Source.of(text, motion.columns, section=_MOTION).of_motion()
            return read_channels(source, duplicates, motion.delay)
    except InputError as error:
        raise InputError(str(error).replace("[columns]", f"[{_MOTION}]")) from None


def _frames(channels: Channels, name: str, settings: Settings) -> tuple[Frames, list[str]]:
    """Return the motion of the file `name`, and notes."""
    numbers = channels.engineering()
    notes = channels.notes + [f"Not used: {item}." for item in channels.dropped]
    by = 1 / settings.specimen.height
    top = _one_of(numbers, "displacement", "strain", by, "height", notes)
    assert top is not None  # see `Source.of_motion`
    inside = {interior_channel(k): w for k, w in _inside(numbers, top, notes).items()}
    moved, spread = {"displacement": top} | inside, settings.uncertainties.get("delay")
    frames = Frames(name, numbers["time"], moved, channels.delay, spread)
    return frames, [f"{name}: {note}" for note in notes]


def _record(channels: Channels, settings: Settings) -> Record:
    """Return the channels of a test in SI; notes name the columns used."""
    numbers, notes = channels.engineering(), channels.notes
    notes += _compare(channels.source, numbers, settings)
    specimen, striker = settings.specimen, settings.striker or Striker()
    if "time" not in numbers:
        slow = "this is treated as a slow test and the striker is not used"
        said = f"there is a [striker] but no time column, so {slow}"
        said = said if settings.striker is not None else "no column is named as the time"
        entry = entries_of(channels.source.table, set(), "time")
        if settings.striker is not None or "…" not in entry:
            notes.append(f"Check: {said}; name the time in [columns], like {entry}.")
    stress = _one_of(numbers, "stress", "force", specimen.area, "area", notes)
    displacement = _one_of(numbers, "displacement", "strain", 1 / specimen.height, "height", notes)
    acceleration = numbers.get("acceleration")
    time, velocity, braked = numbers.get("time"), numbers.get("velocity"), stress is None
    derived = tuple[str, ...]()
    if stress is None:
        assert striker.mass is not None  # see `Source.needed`
        ratio = striker.mass / specimen.area
        if acceleration is not None:
            stress, acceleration = acceleration * ratio, None
            notes.append("The force is the striker's mass times its acceleration.")
        else:
            motion = numbers["time"], displacement, velocity
            stress = stress_of_motion(*motion, ratio, striker.gravity or 0.0)
            derived = ("stress",)
            notes.append(
                "The force is the striker's mass times the deceleration of its motion, from a "
                "smoothing spline; it is not an independent measurement."
            )
    record = Record(
        time, stress, displacement, velocity, acceleration, derived=derived, braked=braked,
        interior=_inside(numbers, displacement, notes), cycle=numbers.get("cycle"),
        numbers=channels.rows, dropped=tuple(channels.dropped),
    )  # fmt: skip
    return record.noted(*notes)


def _compare(source: Source, numbers: dict[str, Array], settings: Settings) -> list[str]:
    """Compare the columns in use with alternative columns of the same channel.

    Raises InputError if an impact has two inconsistent time columns.
    """
    table, notes = source.table, list[str]()
    as_used = {"force": 1 / settings.specimen.area, "strain": settings.specimen.height}
    for channel, k in source.left_out().items():
        alone = replace(source, columns={channel: k}, given={})
        try:
            values = read_channels(alone, "refuse").engineering()[channel]
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
            notes += [f"The {channel} {name} is left out; it differs by up to {by} of the range."]
        elif np.ptp(values - one) > np.median(np.diff(one)):
            both = f"columns {table.name(source.columns['time'])} and {name} are times that differ"
            by = engineering(float(np.ptp(values - one)), "s")
            if settings.striker is not None:
                other = "put a motion with its own clock into a file of its own ([motion])"
                raise InputError(f"{both} by {by}; name the right one in [columns], or {other}.")
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


def _one_of(
    numbers: dict[str, Array], first: str, second: str, ratio: float, by: str, notes: list[str]
) -> Array | None:
    """Return `first`, or else `second` divided by `ratio`; note whether both agree to 3 %."""
    one, two = numbers.get(first), numbers.get(second)
    if two is None:
        return one
    if one is None:
        operation = "over" if first == "stress" else "times"
        notes.append(f"The {first} is the {second} {operation} the {by}.")
        return two / ratio
    slope = float(np.dot(two, one) / np.dot(one, one)) / ratio
    apart = percent(max(1e-5, float(np.max(np.abs(two / ratio - one)) / np.ptp(one))))
    if abs(slope - 1) > 0.03:
        agree = f"{slope:.3g} times its equivalent with the specimen's {by}; they are inconsistent"
        notes.append(f"Check: the {first} is used, but the {second} is {agree}.")
    else:
        used = f"The {first} is used rather than the {second}"
        notes.append(f"{used}, and they agree to {apart} of the range.")
    return one
