"""From the samples of a file to one loading and unloading, with time zero where contact starts.

Each step is a function that returns a new `Record` and a sentence for each thing that it did.
`condition` runs them in order. Nothing is dropped or changed without a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import (
    INTEGRATED,
    Array,
    Dropped,
    NoiseLevel,
    Outliers,
    RowCount,
    Specimen,
    Striker,
    interior_channel,
    interior_node,
)
from foamfit.errors import InputError

_MIN_ROWS = 10
_MIN_REST = 20
# A rest has as many independent samples, and the slope of a signal on it is less than this share of
# the slope that follows: the branches of a foam on loading differ less in stiffness (6 times in the
# published sets), so that a soft start is no rest. A striker in contact is not speeded up.
_LEAST_REST, _STILL, _STILL_STRIKER = 5, 0.15, 0.5
# Standard errors that decide whether a signal rises or rests, and whether its zero lies elsewhere.
_ERRORS, _ELSEWHERE = 3.0, 5.0
_MAX_ROWS = 1500
# A force may be clipped where so many samples are equal at its top; a parabola falls by so many
# steps of its digits within half that length on either side.
_FLAT, _PARABOLA = 5, 3
_BLOCKS = 1000
# Shares of the largest displacement: what a reversal goes back at least, what is left of it at
# rest, what counts as unloading, and a cycle that is named for being small.
_TURN, _REST, _UNLOADED, _SMALLER = 0.05, 0.35, 0.1, 0.9


@dataclass(frozen=True, eq=False)
class Record:
    """The channels of a test in SI, each of shape (n,) or None where the file lacks it.

    Time in s, stress in Pa, displacement of the top in m, velocity of the top in m/s and its
    deceleration in m/s² (like the stress that causes it, it is positive in compression). `interior`
    holds the displacement of masses inside in m, 1 for the one above spring 1. `excess` is what the
    file has beyond the straight line that bridges an outlier, 0 elsewhere, for each channel that
    has outliers. `clipped` marks the samples at which the force is clipped. `numbers` holds the row
    number in the file of each sample (None: they count from 1), and `dropped` the rows of the file
    that were left out so far.
    """

    time: Array | None
    stress: Array
    displacement: Array | None
    velocity: Array | None = None
    acceleration: Array | None = None
    interior: dict[int, Array] = field(default_factory=dict)
    excess: dict[str, Array] = field(default_factory=dict)
    clipped: NDArray[np.bool_] | None = None
    numbers: NDArray[np.int64] | None = None
    dropped: tuple[Dropped, ...] = ()

    @property
    def row_numbers(self) -> NDArray[np.int64]:
        """Row number in the file of each sample, shape (n,)."""
        return np.arange(1, len(self) + 1) if self.numbers is None else self.numbers

    def without(self, gone: slice | NDArray[np.bool_], why: str) -> Record:
        """Leave out some rows of every channel, and count them with the reason."""
        numbers = self.row_numbers
        lost = numbers[gone]
        if not lost.size:
            return self
        kept = np.ones(len(self), dtype=bool)
        kept[gone] = False
        item = Dropped(lost.size, int(lost[0]), int(lost[-1]), why)
        return replace(self, numbers=numbers, dropped=(*self.dropped, item)).rows(kept)

    def between(self, first: int, end: int, before: str, after: str) -> Record:
        """Keep the samples from `first` up to `end`; the reasons count what lies outside."""
        return self.without(slice(end, None), after).without(slice(0, first), before)

    def rows(self, which: slice | NDArray[np.bool_]) -> Record:
        """Keep some rows of every channel; rows that `without` leaves out are counted, too."""
        channels: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        del channels["dropped"]
        inside = {node: values[which] for node, values in channels.pop("interior").items()}
        excess = {name: values[which] for name, values in channels.pop("excess").items()}
        kept: dict[str, Any] = {k: v[which] for k, v in channels.items() if v is not None}
        return replace(self, **(kept | {"interior": inside, "excess": excess}))

    def channel(self, name: str) -> Array | None:
        """Return a channel by its name; "displacement_1" is the mass inside above spring 1."""
        node = interior_node(name)
        values: Array | None = getattr(self, name) if node is None else self.interior.get(node)
        return values

    def changed(self, name: str, values: Array) -> Record:
        """Put other values into a channel."""
        node = interior_node(name)
        if node is None:
            change: dict[str, Any] = {name: values}
            return replace(self, **change)
        return replace(self, interior=self.interior | {node: values})

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the channels that are there."""
        names = ("stress", "displacement", "velocity", "acceleration")
        there = [name for name in names if getattr(self, name) is not None]
        return (*there, *map(interior_channel, self.interior))

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.stress)

    @property
    def clock(self) -> Array:
        """Time, or the sample's number where there is none, shape (n,)."""
        return np.arange(len(self), dtype=np.float64) if self.time is None else self.time


@dataclass(frozen=True)
class Window:
    """The part of a file to look at: times in s by the file's own clock, and which cycle."""

    start: float | None = None
    end: float | None = None
    cycle: int = 1


@dataclass(frozen=True, eq=False)
class Conditioned:
    """A conditioned record, where its displacement came from, and what was done.

    `noise` is what the samples before contact, or those where a held channel is fresh, say of it;
    `contact` is the channel that set time zero: "stress", "motion", or "file" for the file's own.
    """

    record: Record
    motion: str
    notes: tuple[str, ...]
    outliers: dict[str, Outliers]
    noise: dict[str, NoiseLevel]
    contact: str
    count: RowCount


@dataclass(frozen=True)
class Start:
    """Where contact starts: on the file's clock (None: at its first sample), and at which height.

    `zero` is the displacement there, and `zero_from` says what shows it. `free` says that nothing
    pressed on the specimen before, so that the samples before it show the offset of the sensor.
    `clock` says that the first sample lies so far behind the file's time zero as the striker has
    gone by then: contact starts at that zero.
    """

    time: float | None
    zero: float
    free: bool
    how: str
    zero_from: str = ""
    clock: bool = False

    @property
    def by(self) -> str:
        """The channel that set time zero: "stress", "motion", or "file" for the file's own."""
        if self.time is None:
            return "file"
        return "motion" if "displacement" in self.how else "stress"


def condition(
    record: Record,
    specimen: Specimen,
    *,
    striker: Striker | None = None,
    window: Window | None = None,
    reversed_: Mapping[str, str] | None = None,
) -> Conditioned:
    """Turn the samples of a file into one loading and unloading.

    Parameters
    ----------
    record : Record
        All samples of the file.
    specimen : Specimen
        Its height and area turn force into stress and limit the strain.
    striker : Striker, optional
        With it and a time the record is an impact, else a slow test whose displacement is driven.
    window : Window, optional
        What the user chose to look at.
    reversed_ : mapping, optional
        What to say of a channel that is plainly the other way round; see `check_signs`.

    Returns
    -------
    Conditioned
        At most 1500 samples; time is zero and displacement is zero where contact starts.
    """
    notes: list[str] = []

    def done(result: tuple[Record, list[str]]) -> Record:
        notes.extend(result[1])
        return result[0]

    window = window or Window()
    impact = striker is not None and record.time is not None
    record = done(cut_to_window(record, window))
    record = bridge_outliers(record)
    record = done(mark_clipped(record))
    spoilt = {name: int(np.count_nonzero(excess)) for name, excess in record.excess.items()}
    check_signs(record, reversed_ or {})
    held = noise_of_held(record)
    record = done(fill_staircase(record))
    if impact and window.cycle != 1:
        raise InputError("[window] cycle is for slow tests; for an impact give start and end.")
    first = record if impact else select_cycle(record, 1)[0]
    levels = noise_levels(first, held)
    start = find_start(first, impact, levels, striker)
    resting = first if impact or start.free else None
    record = done(zero_interior(record, first, start, levels))
    record = done(remove_offset(record, start, impact, levels))
    if not impact:
        record = done(select_cycle(record, window.cycle))
    if window.cycle > 1:  # a later cycle keeps the zero of the first, when the foam was fresh
        start = Start(None, start.zero, False, f"with cycle {window.cycle}", start.zero_from)
    record = done(cut_to_contact(record, start, impact, levels))
    motion = "measured"
    if record.displacement is None:
        if record.clipped is not None and record.acceleration is None and record.velocity is None:
            raise InputError(
                "the force is clipped, so the motion cannot be integrated from it; give a "
                "displacement, an acceleration or a velocity."
            )
        record, motion = integrate_motion(record, specimen, striker or Striker())
        notes.append(f"The file has no displacement: the motion is {motion}.")
    notes += inner_reversals(record)
    notes += checks(record, specimen, striker if impact else None, motion)
    whole, record = record, done(thin(record))
    block = -(-len(whole) // len(record))
    noise = noise_at_rest(resting, start, record, block) if resting is not None else {}
    noise |= {name: _averaged(level, block) for name, level in held.items()}
    outliers = _outliers(whole, record, block)
    notes += [
        _outlier_note(name, count, outliers.get(name), record) for name, count in spoilt.items()
    ]
    count = _row_count(whole, outliers, block)
    return Conditioned(record, motion, tuple(notes), outliers, noise, start.by, count)


def engineering(value: float, unit: str) -> str:
    """Write a value for people: 3.839e6, "Pa" gives "3.839 MPa"."""
    prefixes = {9: "G", 6: "M", 3: "k", 0: "", -3: "m", -6: "µ", -9: "n"}
    power = 0 if value == 0 else int(np.clip(3 * np.floor(np.log10(abs(value)) / 3), -9, 9))
    return f"{value / 10.0**power:.4g} {prefixes[power]}{unit}"


# What the signals are like.


def noise_level(values: Array) -> float:
    """Estimate the standard deviation of the noise of a smooth, well sampled signal, shape (n,)."""
    if len(values) < 4:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6))


def smooth(values: Array, width: int) -> Array:
    """Take the moving mean over `width` samples, shape (n,)."""
    from scipy.ndimage import uniform_filter1d

    return values if width < 2 else np.asarray(uniform_filter1d(values, width, mode="nearest"))


def line_at(time: Array, values: Array, at: float) -> tuple[float, float]:
    """Value at the time `at`, and slope, of the straight line through the samples."""
    slope, level = np.polyfit(time - at, values, 1)
    return float(level), float(slope)


def check_signs(record: Record, reversed_: Mapping[str, str]) -> None:
    """Refuse a channel that is plainly the other way round: compression is positive.

    `reversed_` holds, by channel, what is wrong and what the user can write to turn it round.
    """

    def refuse(channel: str) -> NoReturn:
        wrong = "is negative in compression; it must be positive: give its column and scale = -1"
        raise InputError(f"the {reversed_.get(channel, f'{channel} {wrong} in [columns]')}.")

    stress, peak = record.stress, int(np.argmax(record.stress))
    first = float(np.median(stress[:5]))
    if first - stress.min() > 2 * max(stress[peak] - first, 0) and abs(stress.min()) > stress[peak]:
        refuse("stress")
    if record.displacement is not None:
        moved = record.displacement[peak] - record.displacement[0]
        if moved < -0.5 * np.ptp(record.displacement[: peak + 1]):
            refuse("displacement")
    for node, values in record.interior.items():
        if values[peak] - values[0] < -0.5 * np.ptp(values[: peak + 1]):
            refuse(interior_channel(node))
    if record.displacement is not None:
        return
    if record.acceleration is not None:
        if np.dot(stress - first, record.acceleration) < 0:
            refuse("acceleration")
    elif record.velocity is not None and record.velocity[0] < record.velocity[-1]:
        refuse("velocity")


def checks(record: Record, specimen: Specimen, striker: Striker | None, motion: str) -> list[str]:
    """Refuse strains beyond one; say what smells wrong."""
    displacement, stress = record.displacement, record.stress
    assert displacement is not None  # measured or integrated by now
    if len(record) < _MIN_ROWS:
        raise InputError(f"only {len(record)} samples are in contact; at least {_MIN_ROWS} needed.")
    strain = float(displacement.max()) / specimen.height
    if strain >= 1:
        cause = "the unit of displacement or strain" if motion == "measured" else "the striker"
        raise InputError(f"strain reaches {strain:.3g}, beyond one; check height and {cause}.")
    notes = []
    for node, values in record.interior.items():
        name, most = interior_channel(node), float(values.max())
        if most >= specimen.height:
            told = f"{engineering(most, 'm')}, the height {engineering(specimen.height, 'm')}"
            raise InputError(f"{name} reaches {told}; check its unit.")
        if most > 1.05 * displacement.max():
            notes.append(f"Check: {name} goes farther than the top; check its unit and its node.")
    peak, last = float(stress.max()), int(np.argmax(stress))
    if stress[:3].mean() > 0.05 * peak:
        share = stress[:3].mean() / peak
        notes.append(f"Check: the record starts under load, at {share:.0%} of the peak stress.")
    width = max(1, len(record) // 100)
    lowest = float(smooth(stress, width)[last:].min())
    if lowest < -max(0.002 * peak, 4 * noise_level(stress) / np.sqrt(width)):
        notes.append(
            f"The stress goes down to {engineering(lowest, 'Pa')} after the peak (adhesion, drift "
            "or ringing); it is kept."
        )
    if striker and striker.velocity and record.time is not None and motion != INTEGRATED:
        early = displacement <= 0.15 * displacement.max()
        early[int(np.argmax(displacement)) :] = False
        if early.sum() >= 3:
            speed = line_at(record.time[early], displacement[early], 0.0)[1]
            if abs(speed / striker.velocity - 1) > 0.1:
                notes.append(
                    f"Check: the displacement starts at {speed:.3g} m/s, but the striker's velocity"
                    f" is given as {striker.velocity:.3g} m/s."
                )
    if specimen.mass:
        density = specimen.mass / (specimen.area * specimen.height)
        if not 1 < density < 3000:
            notes.append(f"Check: mass and volume give a density of {density:.3g} kg/m³.")
    return notes


# The steps.


def cut_to_window(record: Record, window: Window) -> tuple[Record, list[str]]:
    """Keep what lies between the window's start and end, by the file's own clock."""
    if window.start is None and window.end is None:
        return record, []
    if record.time is None:
        raise InputError("[window] start and end need a time column; the file has none.")
    start = -np.inf if window.start is None else window.start
    end = np.inf if window.end is None else window.end
    inside = (record.time >= start) & (record.time <= end)
    cut = len(record) - int(inside.sum())
    if len(record) - cut < _MIN_ROWS:
        first, last = (engineering(float(t), "s") for t in record.time[[0, -1]])
        raise InputError(
            f"[window] start and end leave {inside.sum()} samples; at least {_MIN_ROWS} between "
            f"{first} and {last} are needed."
        )
    note = f"[window] cut {cut} of {len(record)} samples."
    record = record.without(~inside, "outside [window] start and end")
    for name in ("stress", "displacement"):
        values = getattr(record, name)
        if values is not None and np.ptp(values) == 0:
            raise InputError(f"the {name} is constant within [window]; it must vary.")
    for node, values in record.interior.items():
        if np.ptp(values) == 0:
            name = interior_channel(node)
            raise InputError(f"{name} is constant within [window]; it must vary.")
    return record, [note]


def mark_clipped(record: Record) -> tuple[Record, list[str]]:
    """Find the samples at which the force is clipped: a flat top at one value, with steep flanks.

    A rounded top shows equal samples, too, where its values are rounded: it is about a parabola,
    which falls by some three more steps of the digits within half the length of the flat on either
    side. A clipped force falls by more.
    """
    stress = record.stress
    top = float(stress.max())
    at_top = stress >= top - 1e-9 * float(np.ptp(stress))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], at_top.astype(np.int8), [0]])))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    first, end = int(starts[longest]), int(ends[longest])
    fresh = np.append(0, np.flatnonzero(np.diff(stress) != 0.0) + 1)
    held = float(np.median(np.diff(np.append(fresh, len(stress)))))
    if end - first < max(_FLAT, 3 * held):
        return record, []
    reach = -(-(end - first) // 2)
    around = stress[max(first - reach, 0)], stress[min(end - 1 + reach, len(stress) - 1)]
    levels = np.diff(np.unique(stress))
    step = float(levels[levels > 1e-9 * np.ptp(stress)].min())
    if top - max(around) < 4 * _PARABOLA * step:
        return record, []
    count, told = int(at_top.sum()), engineering(top, "Pa")
    lines = record.row_numbers[at_top]
    note = (
        f"Check: the force is clipped: {count} samples have one and the same value at its top, a "
        f"stress of {told} (rows {lines[0]} to {lines[-1]}); they are not fitted, the true peak is "
        "not known, and energy and impulse come out too small."
    )
    return replace(record, clipped=at_top), [note]


def bridge_outliers(record: Record) -> Record:
    """Put a straight line in the place of spikes and short gaps; `excess` keeps what was there."""
    from foamfit.data.noise import bridged, find_outliers

    for name in record.measured:
        values = record.channel(name)
        assert values is not None
        wrong = find_outliers(values, record.time)
        if wrong.any():
            line = bridged(values, wrong, record.clock)
            excess = record.excess | {name: np.where(wrong, values - line, 0.0)}
            record = replace(record.changed(name, line), excess=excess)
    return record


def _outlier_note(name: str, count: int, found: Outliers | None, record: Record) -> str:
    """Name a channel's outliers: how many, and where those of the part that is used are."""
    some = f"{count} samples" if count > 1 else "1 sample"
    note = f"Check: {some} of the {name} stood out as spikes or gaps and"
    if found is None or not found.at.size:
        return f"{note} were bridged, none of them in the part that is used."
    unit = {"stress": "Pa", "velocity": "m/s", "acceleration": "m/s²"}.get(name, "m")
    told = []
    for at, value in list(zip(found.at, found.values, strict=True))[:4]:
        place = f"sample {at:.0f}" if record.time is None else engineering(float(at), "s")
        told.append(f"{engineering(float(value), unit)} at {place}")
    used = found.at.size
    rest = f" and {used - len(told)} more" if used > len(told) else ""
    part = "" if used == count else f", {used} of them in the part that is used"
    return f"{note} are not fitted{part}: {', '.join(told)}{rest}."


def _outliers(whole: Record, record: Record, block: int) -> dict[str, Outliers]:
    """Outliers of a record that was thinned: a block of them is left out, one in a block is not."""
    found = {}
    edges = np.arange(0, len(whole), block)
    for name, excess in whole.excess.items():
        values, wrong = whole.channel(name), excess != 0.0
        if values is None or not wrong.any():
            continue
        share = np.add.reduceat(wrong.astype(float), edges) / block
        at = np.flatnonzero(wrong)
        found[name] = Outliers(share > 0.5, whole.clock[at], values[at] + excess[at])
    if whole.clipped is not None and whole.clipped.any():
        left_out = np.add.reduceat(whole.clipped.astype(float), edges) > 0.0
        none = np.zeros(0)
        spikes = found.get("stress") or Outliers(np.zeros(left_out.size, dtype=bool), none, none)
        top = float(whole.stress[whole.clipped].max())
        found["stress"] = replace(spikes, left_out=spikes.left_out | left_out, clipped_at=top)
    return found


def _row_count(whole: Record, outliers: dict[str, Outliers], block: int) -> RowCount:
    """Count the rows of the file: `whole` holds those that are left, before it was thinned."""
    dropped, used = list(whole.dropped), np.ones(len(whole), dtype=bool)

    def drop(wrong: NDArray[np.bool_], why: str) -> None:
        wrong = wrong & used
        lost = whole.row_numbers[wrong]
        used[wrong] = False
        if lost.size:
            dropped.append(Dropped(lost.size, int(lost[0]), int(lost[-1]), why))

    for name, excess in whole.excess.items():
        drop(excess != 0.0, f"a spike or gap of the {name}, bridged by a straight line")
    if whole.clipped is not None:
        left_out = np.repeat(outliers["stress"].left_out, block)[: len(whole)]
        drop(left_out & whole.clipped, "the force is clipped")
    for name, found in outliers.items():
        left_out = np.repeat(found.left_out, block)[: len(whole)]
        drop(left_out, f"in a block of {block} samples of the {name} that is not fitted")
    count = int(used.sum())
    total = len(whole) + sum(item.rows for item in whole.dropped)
    return RowCount(total, count, tuple(sorted(dropped, key=lambda item: item.first)))


def noise_of_held(record: Record) -> dict[str, NoiseLevel]:
    """Estimate the noise of the channels that are held, from the samples where they are fresh."""
    from foamfit.data.noise import is_staircase, residual_noise

    levels = {}
    for name in record.measured:
        values = record.channel(name)
        if not name.startswith("displacement") or values is None or not is_staircase(values):
            continue
        fresh = values[np.append(0, np.flatnonzero(np.diff(values) != 0) + 1)]
        if len(fresh) >= _MIN_ROWS:
            how = f"estimated from what local cubics leave of {len(fresh)} fresh samples"
            step = len(values) / len(fresh)
            levels[name] = NoiseLevel(residual_noise(fresh)[0], False, how, step)
    return levels


def noise_levels(record: Record, held: dict[str, NoiseLevel]) -> dict[str, NoiseLevel]:
    """Noise of the channels that decide on contact, from all samples; `held` is known already."""
    from foamfit.data.noise import residual_noise

    levels = dict(held)
    for name in ("stress", "displacement", *map(interior_channel, record.interior)):
        values = record.channel(name)
        if name not in levels and values is not None:
            sigma, phi = residual_noise(values)
            how = f"estimated from what local cubics leave of {len(values)} samples"
            levels[name] = NoiseLevel(sigma, False, how, (1.0 + phi) / (1.0 - phi))
    return levels


def noise_at_rest(first: Record, start: Start, record: Record, block: int) -> dict[str, NoiseLevel]:
    """Estimate the noise of each channel from the samples before contact, about their line.

    They are taken where there are twenty, and where what the signal itself shows during contact
    does not contradict: a sensor may be quieter at rest, and a motion may start before the stress.
    """
    from foamfit.data.noise import residual_noise

    before = 0 if start.time is None else int(np.searchsorted(first.clock, start.time)) - 2
    levels: dict[str, NoiseLevel] = {}
    if before < _MIN_REST:
        return levels
    for name in ("stress", "displacement", *map(interior_channel, first.interior)):
        rest, signal = first.channel(name), record.channel(name)
        if rest is None or signal is None:
            continue
        x = np.arange(before, dtype=np.float64)
        off = rest[:before] - np.polyval(np.polyfit(x, rest[:before], 1), x)
        sigma = float(np.sqrt(off @ off / (before - 2)))
        if sigma == 0.0:
            continue
        phi = float(off[1:] @ off[:-1] / (off @ off))
        time = (1 + phi) / (1 - phi) if 2 / np.sqrt(before) < phi < 1 else 1.0
        how = f"estimated from {before} samples before contact"
        level = _averaged(NoiseLevel(sigma, False, how, time), block)
        during, phi = residual_noise(signal)
        if 0.5 < level.sigma / max(during, 1e-300) < 4.0:
            levels[name] = level
        elif during > 0.0:
            how = f"estimated from what local cubics leave of {len(signal)} samples"
            word = "quieter" if level.sigma < during else "less quiet"
            how = f"{how}, the {before} before contact being {word}"
            levels[name] = NoiseLevel(during, False, how, (1.0 + phi) / (1.0 - phi))
    return levels


def _averaged(level: NoiseLevel, block: int) -> NoiseLevel:
    """Noise of the means of blocks of samples."""
    if block == 1:
        return level
    sigma = level.sigma * np.sqrt(min(level.time / block, 1.0))
    how = f"{level.how}, averaged in blocks of {block}"
    return replace(level, sigma=float(sigma), how=how, time=max(level.time / block, 1.0))


def fill_staircase(record: Record) -> tuple[Record, list[str]]:
    """Interpolate displacements that are held while the stress goes on.

    The instants where a value is fresh are kept. A much longer hold is a real one: it lasts
    until one usual step before the next fresh value.
    """
    notes: list[str] = []
    if record.displacement is not None:
        filled = _filled(record.clock, record.displacement, "The displacement", notes)
        record = record if filled is None else replace(record, displacement=filled)
    for node, values in record.interior.items():
        filled = _filled(record.clock, values, interior_channel(node), notes)
        if filled is not None:
            record = replace(record, interior=record.interior | {node: filled})
    return record, notes


def _filled(clock: Array, values: Array, name: str, notes: list[str]) -> Array | None:
    """Ramps in the place of the steps of a signal, None if it has no steps."""
    fresh = np.append(0, np.flatnonzero(np.diff(values) != 0) + 1)
    lengths = np.diff(np.append(fresh, len(values)))
    step = int(np.median(lengths))
    if len(lengths) < _MIN_ROWS or step < 2:
        return None
    held = lengths > 3 * step
    knots = np.union1d(fresh, (fresh + lengths - step)[held])
    notes.append(
        f"{name} is held for about {step} samples at a time; it is interpolated between "
        f"the {len(fresh)} instants where it is fresh."
    )
    return np.asarray(np.interp(clock, clock[knots], values[knots]))


def select_cycle(record: Record, cycle: int) -> tuple[Record, list[str]]:
    """Keep one loading and unloading of a slow test, cycle 1 being the first in the file.

    A cycle ends where the motion has gone back most of the way of the smaller of the peaks on
    either side, so that cycles of growing amplitude count from the first; a reversal that goes
    back less is part of its cycle.
    """
    displacement = record.displacement
    if displacement is None:
        return record, []  # refused or integrated later
    turns = find_turns(displacement)
    peaks, rests = _cycles(record, turns)
    n = len(peaks)
    if cycle > n:
        raise InputError(f"[window] cycle = {cycle}, but the file has {n}; give one from 1 to {n}.")
    # A cycle runs from the last rest before its rise to its first return to rest after its fall.
    size = float(np.ptp(displacement))
    start = 0 if cycle == 1 else rests[cycle - 2]
    top = peaks[cycle - 1]
    after = displacement[top : peaks[cycle] if cycle < n else len(record)]
    unloaded = float(after[0] - after.min())
    end = len(record)
    if unloaded > _UNLOADED * size:
        end = top + int(np.argmax(after <= after.min() + 0.005 * size)) + 1
    notes = []
    if n > 1 or end - start < len(record):
        notes.append(
            f"Cycle {cycle} of {n} is used: {end - start} of {len(record)} samples, "
            f"{start} before it and {len(record) - end} after it are cut."
        )
    largest = int(np.argmax(displacement[peaks]))
    share = (displacement[top] - displacement.min()) / size
    if share < _SMALLER:
        notes.append(
            f"Check: cycle {cycle} reaches {share:.0%} of the largest displacement; "
            f"cycle {largest + 1} of {n} reaches all of it ([window] cycle = {largest + 1})."
        )
    if unloaded <= _UNLOADED * size:
        notes.append("The record has no unloading, so nothing in it determines unloading.")
    record = record.between(start, end, f"before cycle {cycle}", f"after cycle {cycle}")
    return record, notes


def find_turns(values: Array) -> NDArray[np.int64]:
    """Samples at which a motion turns round: peaks and valleys by turns, the first a peak.

    Only what goes back by more than a twentieth of the range, and by more than the noise, turns.
    """
    back = max(_TURN * float(np.ptp(values)), 8.0 * noise_level(values))
    # The extremes of short blocks are all that counts.
    block = max(1, len(values) // 20_000)
    at = np.arange(len(values))
    if block > 1:
        parts = values[: len(values) // block * block].reshape(-1, block)
        first = np.arange(len(parts)) * block
        ends = np.arange(parts.size, len(values))
        at = np.unique(
            np.concatenate([first + parts.argmin(axis=1), first + parts.argmax(axis=1), ends])
        )
    turns: list[int] = []
    up, best = True, int(at[0])
    for i, value in zip(at.tolist(), values[at].tolist(), strict=True):
        ahead = value - values[best] if up else values[best] - value
        if ahead > 0.0:
            best = i
        elif ahead < -back:
            turns.append(best)
            up, best = not up, i
    if up or not turns:  # the record ends on its way up
        turns.append(best)
    return np.array(turns, dtype=np.int64)


def _cycles(record: Record, turns: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Peaks of the cycles of a slow test, and the last sample of the rest between two of them."""
    displacement, stress = record.displacement, record.stress
    assert displacement is not None
    low = float(displacement.min())
    free = float(np.median(stress[displacement <= low + 0.02 * np.ptp(displacement)]))
    least = free + 0.01 * (float(stress.max()) - free)
    peaks, rests = [int(turns[0])], list[int]()
    for valley, peak in zip(turns[1::2], turns[2::2], strict=False):
        smaller = min(displacement[peaks[-1]], displacement[peak]) - low
        if stress[peaks[-1]] < least:  # a movement without a force, as an approach, is no cycle
            peaks[-1] = int(peak)
        elif displacement[valley] - low < _REST * smaller:
            between = displacement[peaks[-1] : peak + 1]
            rests.append(int(peak) - int(np.argmin(between[::-1])))
            peaks.append(int(peak))
        elif displacement[peak] > displacement[peaks[-1]]:
            peaks[-1] = int(peak)
    return peaks, rests


def inner_reversals(record: Record) -> list[str]:
    """Say where a record of one loading and unloading turns round below its peak."""
    displacement = record.displacement
    assert displacement is not None
    turns = find_turns(displacement)
    peak = int(np.argmax(displacement[turns]))
    size = float(np.ptp(displacement))
    # Before the peak each valley after a peak is a reversal, after it each peak after a valley.
    backs = [
        abs(float(displacement[turns[i]] - displacement[turns[i + 1]]))
        for i in [*range(0, peak, 2), *range(peak + 1, len(turns) - 1, 2)]
    ]
    if not backs:
        return []
    times = "once" if len(backs) == 1 else f"{len(backs)} times"
    return [
        f"Check: the record reverses {times} below its peak, by up to {max(backs) / size:.0%} of "
        "it; the law has no inner loops: partial unloading runs back along the branch it came "
        "along, so a loop there stays in the residuals."
    ]


def _rise(values: Array, share: float) -> int:
    """First of three samples in a row above a share of the way from the lowest level to the top."""
    before_peak = values[: int(np.argmax(values)) + 1]
    base = float(np.percentile(before_peak, 5))
    above = before_peak > base + share * (before_peak[-1] - base)
    run = above[:-2] & above[1:-1] & above[2:]
    return int(np.argmax(run)) if run.any() else int(np.argmax(above))


def leave_rest(
    time: Array, values: Array, noise: NoiseLevel, still: float = _STILL, drift: float = np.inf
) -> float | None:
    """Time at which a signal leaves its rest, or None if none is shown before it rises.

    Where a rise seems to start, the samples before it must be at rest: their slope is less than a
    share `still` of the slope that follows, and they do not surely rise by more than `drift`. If
    they do, the kink was one in a rise, and the part before it is looked at in the same way.
    """
    end = len(time)
    while True:
        at = _kink(time[:end], values[:end], noise)
        if at is None:
            return None
        before = _slopes(time[:end], values[:end], at, noise)
        if before.upper < still and before.drift <= drift:
            return at
        rows = int(np.searchsorted(time, at))
        if not _MIN_ROWS <= rows < end:
            return None
        end = rows


@dataclass(frozen=True)
class _Slopes:
    """Slope of a signal before a time over its mean slope after it, up to 15 % of the peak.

    The bounds are three standard errors away, and infinite where the samples before, or the rise
    after, are too few or too noisy to tell. `upper` is that of the slope's size: a signal that
    falls does not rest either. `drift` is how much the signal changes at least before that time.
    """

    lower: float = -np.inf
    upper: float = np.inf
    drift: float = 0.0


def _slopes(time: Array, values: Array, at: float, noise: NoiseLevel) -> _Slopes:
    """Compare the slopes of a signal before and after a time."""
    n = int(np.searchsorted(time, at))
    high = _rise(values, 0.15)
    high = high if time[high] > at else int(np.argmax(values))
    if n < max(_LEAST_REST * noise.time, 3) or time[high] <= at:
        return _Slopes()
    t, rest = time[:n] - time[:n].mean(), values[:n]
    slope = float(t @ rest) / float(t @ t)
    scatter = float(np.sqrt(np.sum((rest - rest.mean() - slope * t) ** 2) / (n - 2)))
    if n < _MIN_REST * noise.time:  # too few to show their own noise
        scatter = max(scatter, noise.sigma)
    error = _ERRORS * scatter * np.sqrt(noise.time / float(t @ t))
    top = values[high : high + 3]
    doubt = _ERRORS * noise.sigma * np.sqrt(1.0 / len(top) + noise.time / n)
    rise, lasts = float(top.mean() - rest.mean()), float(time[high] - at)
    drift = max(0.0, abs(slope) - error) * float(np.ptp(t))
    if rise <= doubt:
        return _Slopes(drift=drift)
    upper = (abs(slope) + error) * lasts / (rise - doubt)
    return _Slopes((slope - error) * lasts / rise, upper, drift)


def _kink(time: Array, values: Array, noise: NoiseLevel) -> float | None:
    """Time at which a signal seems to start to rise, None if it may do so from its first sample.

    A rest followed by a straight or else a quadratic rise is fitted by least squares to the samples
    up to 15 % of the peak, so that the time is finer than the sampling.
    """
    high, low = _rise(values, 0.15), _rise(values, 0.05)
    first = max(0, high - 4 * max(high - low, 3) - 8)
    part = slice(first, high + 1, max(1, (high - first) // 1000))
    t, y = time[part], values[part]
    if len(t) < 5:
        return None
    starts = np.linspace(t[0], t[-2], 400)
    straight, curved = _rise_misfit(t, y, starts, 1), _rise_misfit(t, y, starts, 2)
    # The curve must fit clearly better: where noise hides the shape, the line is the safer guess.
    variance = min(noise.sigma**2, min(straight.min(), curved.min()) / len(t))
    slow = 9 * noise.time * variance  # three standard errors of noise with its correlation
    less = max(9 / len(t) * straight.min(), slow)
    misfit = curved if curved.min() < straight.min() - less else straight
    best = int(np.argmin(misfit))
    if first == 0:
        # Would a rise from the very first sample do nearly as well?
        more = max(9 / len(t) * misfit[best], slow)
        if misfit[0] <= misfit[best] + more + 1e-9 * np.var(y):
            return None
        # A curved start looks like a rest, but rises.
        rest = t < starts[best]
        if rest.sum() < 3:
            return None
        if (time[high] - starts[best]) * 2 > starts[best] - t[0]:
            rise = line_at(t[rest], y[rest], 0.0)[1] * np.ptp(t[rest])
            doubt = 4 * noise_level(values) * np.sqrt(12 / rest.sum())
            if abs(rise) > max(doubt, 2e-3 * np.ptp(values)):
                return None
    return float(starts[best])


def _rise_misfit(t: Array, y: Array, starts: Array, power: int) -> Array:
    """Squared misfit of rest + factor · (t − start)^power, at its best, for each start."""
    ramps = np.maximum(0.0, (t - starts[:, None]) / (t[-1] - t[0])) ** power
    ramps -= ramps.mean(axis=1, keepdims=True)
    centred = y - y.mean()
    misfit: Array = (centred**2).sum() - (ramps @ centred) ** 2 / (ramps**2).sum(axis=1)
    return misfit


@dataclass(frozen=True)
class _Level:
    """Where a signal is at one time: by how many samples, and how sure that is."""

    value: float
    error: float
    samples: int

    def told(self, noise: NoiseLevel, shape: str) -> str:
        """Say its size against the noise, and what it was read off."""
        size = abs(self.value) / noise.sigma if noise.sigma > 0 else np.inf
        ratio = f"{size:.{0 if size >= 10 else 1}f} noise standard deviations; "
        return f"{ratio if np.isfinite(size) else ''}{shape} {self.samples} samples"

    @property
    def sureness(self) -> float:
        """Size over standard error."""
        if self.error > 0:
            return abs(self.value) / self.error
        return np.inf if self.value else 0.0


def _resting_level(values: Array, noise: NoiseLevel) -> _Level:
    """Level of a signal at rest: the median of its samples, whose error is 1.25 of the mean's."""
    n = len(values)
    error = 1.25 * float(np.std(values)) * np.sqrt(min(noise.time, n) / n)
    return _Level(float(np.median(values)), error, n)


def _level_on_line(time: Array, values: Array, at: float, noise: NoiseLevel) -> _Level:
    """Level of a signal at a time, by the straight line through samples around or after it."""
    n, t = len(time), time - time.mean()
    away = float((at - time.mean()) ** 2 / (t @ t))
    level, slope = line_at(time, values, at)
    left = values - level - slope * (time - at)  # noise, or what is no straight line
    scatter = max(noise.sigma, float(np.sqrt(left @ left / (n - 2))))
    error = scatter * np.sqrt(noise.time * (1.0 / n + away))
    return _Level(level, float(error), n)


def _level_by_balance(time: Array, w: Array, stress: Array) -> _Level:
    """Level of the motion at the first sample, by the striker's balance of motion.

    w = w0 + v t - c ∬σ with free w0, v and c is fitted by least squares. What it leaves is the
    noise, as slow as it may be, or what contradicts it, so that the error holds either.
    """
    t = time - time[0]
    dt = np.diff(t, prepend=0.0)
    slowed = np.cumsum(dt * (stress - 0.5 * np.diff(stress, prepend=stress[0])))
    braked = np.cumsum(dt * (slowed - 0.5 * np.diff(slowed, prepend=0.0)))
    columns = np.column_stack([np.ones(t.size), t, braked])
    columns /= np.sqrt((columns**2).sum(axis=0))
    inverse = np.linalg.pinv(columns)
    level = inverse @ w
    left = w - columns @ level
    square = float(left @ left)
    phi = float(np.clip(left[1:] @ left[:-1] / square, 0.0, 0.99)) if square > 0 else 0.0
    variance = square / max(t.size - 3, 1) * (1.0 + phi) / (1.0 - phi)
    error = np.sqrt(variance * float(inverse[0] @ inverse[0]))
    return _Level(float(level[0]) * columns[0, 0], float(error) * columns[0, 0], t.size)


def find_start(
    record: Record,
    impact: bool,
    levels: dict[str, NoiseLevel],
    striker: Striker | None = None,
) -> Start:
    """Find where contact starts, which motion and stress decide together.

    A motion that passes its own zero, or leaves a rest, starts contact there, unless the stress has
    risen before; a stress that leaves a rest starts it where the motion has gone on meanwhile, as
    that of a striker on its way. Where no rest is shown, contact starts at the first sample.
    """
    time, w, stress = record.clock, record.displacement, record.stress
    drift = 0.01 * float(stress.max())
    if w is None:
        by_stress = leave_rest(time, stress, levels["stress"], drift=drift)
        if by_stress is None:
            return Start(None, 0.0, False, "at the first sample")
        return Start(by_stress, 0.0, True, "where the stress leaves its rest")
    noise = levels["displacement"]
    top = int(np.argmax(w))
    first, balance = _first_levels(time, w, stress, top, noise)
    surely = min(first, balance, key=lambda level: level.sureness) if impact else first
    away = surely.sureness > _ELSEWHERE
    elsewhere = away and abs(first.value) > 0.02 * (w[top] - first.value)
    # Where the motion of a striker starts at its zero, no stress that rises is taken for a rest.
    drift = np.inf if elsewhere else 0.0 if impact else drift
    by_stress = leave_rest(time, stress, levels["stress"], drift=drift)
    if impact and elsewhere and by_stress is None:
        # No zero of the file speaks for its first sample: the likelier start is taken.
        by_stress = leave_rest(time, stress, levels["stress"], _STILL_STRIKER)
    onset = 0 if by_stress is None else int(np.searchsorted(time, by_stress))
    travel = float(w[top] - w[onset])
    crossing, near = _passage(time, w, top, noise)
    below = crossing > 1 and away and surely.value < -1e-4 * travel
    unloaded = stress[near].mean() < 0.2 * stress.max()
    unloaded &= not _loaded(record, time[crossing], levels)
    if below and unloaded and (by_stress is None or abs(w[onset]) < 0.3 * w[top]):
        at = _time_of_passage(time, w, crossing, near)
        return Start(at, 0.0, False, "where the displacement passes zero")
    still = _STILL_STRIKER if impact else _STILL
    by_motion = leave_rest(time[: top + 1], w[: top + 1], noise, still)
    approach = w[onset] - first.value if by_stress is not None else 0.0
    # A striker's motion starts at contact, if tracked so; a machine's may start above the specimen.
    small = approach < (0.3 if impact else 0.1) * travel
    if by_motion is not None and small and not _loaded(record, by_motion, levels):
        rest = _resting_level(w[time < by_motion], noise)
        told = rest.told(noise, "median of") + " at rest before contact"
        return Start(by_motion, rest.value, True, "where the displacement leaves its rest", told)
    if by_stress is not None and approach > (0.02 if elsewhere else 0.1) * travel:
        reach = max(5, min(onset, (top - onset) // 24))
        near = slice(max(0, onset - reach), onset + reach)
        zero = _level_on_line(time[near], w[near], by_stress, noise)
        told = zero.told(noise, "line through") + " around it, the stress being at rest before"
        return Start(by_stress, zero.value, True, "where the stress leaves its rest", told)
    velocity = striker.velocity if impact and striker is not None else None
    gone = (velocity or 0.0) * time[0]
    if surely.sureness > _ERRORS and 0.7 < first.value / max(gone, 1e-300) < 1.1:
        return Start(None, 0.0, False, "before the first sample", clock=True)
    under_load = stress[:3].mean() > 0.05 * stress.max() and 0 < first.value < travel
    if not elsewhere or under_load:
        return Start(None, 0.0, False, "at the first sample")
    told = first.told(noise, "line through") + " from the first on; the file's zero lies elsewhere"
    return Start(None, first.value, False, "at the first sample", told)


def _first_levels(
    time: Array, w: Array, stress: Array, top: int, noise: NoiseLevel
) -> list[_Level]:
    """Level of a motion at its first sample: by a line, and by the balance of a striker."""
    if top < _LEAST_REST:
        return [_Level(float(w[0]), np.inf, 1)] * 2  # so few samples show no zero
    early, loading = slice(0, max(_LEAST_REST, top // 12)), slice(0, 2 * top)
    return [
        _level_on_line(time[early], w[early], time[0], noise),
        _level_by_balance(time[loading], w[loading], stress[loading]),
    ]


def _time_of_passage(time: Array, w: Array, crossing: int, near: slice) -> float:
    """Time at which a motion passes zero, by the line through the samples around."""
    level, speed = line_at(time[near], w[near], time[crossing])
    at = time[crossing] - level / speed if speed > 0 else time[crossing]
    at = float(np.clip(at, time[near][0], time[near][-1]))
    own = abs(at) < 0.05 * (time[crossing] - time[crossing - 1])
    return 0.0 if own else at  # the file's own time zero


def _loaded(record: Record, at: float, levels: dict[str, NoiseLevel]) -> bool:
    """Whether the stress has plainly risen before a time."""
    return _slopes(record.clock, record.stress, at, levels["stress"]).lower > _STILL


def _passage(time: Array, w: Array, top: int, noise: NoiseLevel) -> tuple[int, slice]:
    """Sample at which a motion passes zero on its way up, and the samples around it.

    A mean over a fiftieth of the rise keeps noise from passing first. The samples around are as
    many as bring the scatter of their line to a thousandth of the rise, but within a twelfth of the
    rise on either side, where the motion is still straight.
    """
    if w[top] <= 0:
        return 0, slice(0, 5)
    rough = int(np.argmax(w >= 0))
    crossing = int(np.argmax(smooth(w, max(1, (top - rough) // 50)) >= 0))
    needed = noise.time * (noise.sigma / (1e-3 * w[top])) ** 2
    reach = (time[top] - time[crossing]) * min(1 / 12, 0.5 * needed / max(top - crossing, 1))
    first = int(np.searchsorted(time, time[crossing] - reach))
    last = int(np.searchsorted(time, time[crossing] + reach))
    return crossing, slice(max(0, min(first, crossing - 5)), max(last, crossing + 5))


def _zero_time(record: Record, start: Start) -> float:
    """Time of contact by the file's clock."""
    if start.time is not None:
        return start.time
    if start.clock:
        return 0.0
    # A file whose first sample is a step or so after time zero has its zero right.
    time = record.clock
    return 0.0 if 0 <= time[0] <= 2 * (time[1] - time[0]) else float(time[0])


def zero_interior(
    record: Record, first: Record, start: Start, levels: dict[str, NoiseLevel]
) -> tuple[Record, list[str]]:
    """Take from each interior displacement its value where contact starts in `first`.

    That is the median of its rest before contact; without a rest it is where a line through the
    first samples starts, unless this is zero within their noise.
    """
    before = 0 if start.time is None else int(np.searchsorted(first.clock, start.time)) - 2
    inside, notes = dict(record.interior), []
    for node, values in first.interior.items():
        name = interior_channel(node)
        noise = levels[name]
        if before >= _MIN_ROWS:
            zero = _resting_level(values[:before], noise)
            told = zero.told(noise, "median of") + " before contact"
        else:
            reach = max(_LEAST_REST, int(np.argmax(values)) // 12)
            early = slice(max(before, 0), max(before, 0) + reach)
            at = _zero_time(first, start)
            zero = _level_on_line(first.clock[early], values[early], at, noise)
            told = zero.told(noise, "line through") + " from there on"
            if abs(zero.value) < max(_ELSEWHERE * zero.error, 2e-3 * np.ptp(values)):
                continue
        inside[node] = inside[node] - zero.value
        if abs(zero.value) > 1e-3 * np.ptp(values):
            size = engineering(zero.value, "m")
            notes.append(f"{name} at contact, {size}, is taken off ({told}).")
    return replace(record, interior=inside), notes


def remove_offset(
    record: Record, start: Start, impact: bool, levels: dict[str, NoiseLevel]
) -> tuple[Record, list[str]]:
    """Take from the stress (and the acceleration) its median before contact."""
    if start.time is None or not (impact or start.free):
        return record, []  # before a slow test nothing shows that the specimen is free
    before = record.clock < start.time
    before[max(0, int(before.sum()) - 2) :] = False
    n = int(before.sum())
    if n < _MIN_REST:
        return record, []
    rest, noise = record.stress[before], levels["stress"]
    offset, scatter = float(np.median(rest)), float(rest.std())
    rise = line_at(np.arange(n, dtype=np.float64), rest, 0.0)[1] * n
    doubt = 4 * noise_level(rest) * np.sqrt(12 * noise.time / n)
    if abs(rise) > max(0.01 * record.stress.max(), doubt):
        told = f"by {engineering(rise, 'Pa')} in the {n} samples before contact"
        return record, [f"The stress drifts {told}, so no offset is taken off."]
    ratio = f", {abs(offset) / scatter:.2g} times that" if scatter > 0 else ""
    note = (
        f"The stress before contact, {engineering(offset, 'Pa')}, is taken off as the sensor's "
        f"offset ({n} samples at rest with a standard deviation of {engineering(scatter, 'Pa')}"
        f"{ratio})."
    )
    a = record.acceleration
    record = replace(
        record,
        stress=record.stress - offset,
        acceleration=None if a is None else a - np.median(a[before]),
    )
    return record, [note]


def contact_end(stress: Array, noise: NoiseLevel) -> tuple[int, bool]:
    """Index after the last sample of the contact with the highest stress, and if it was reached.

    The end is the last return to zero: a mean over as many samples as bring the noise to half a
    percent of the peak, but no more than follow the form of the pulse, keeps noise from ending it
    early. A stress that soon rises again has not ended, nor one whose mean over the next quarter of
    the time since the peak is not zero within its error.
    """
    top = int(np.argmax(stress))
    peak = float(stress[top])
    below = np.flatnonzero(stress[top:] < 0.5 * peak)
    loaded = int(np.count_nonzero(stress > 0.1 * peak))
    needed = noise.time * (2 * noise.sigma / (0.005 * peak)) ** 2
    steep = int(below[0]) if below.size else 0
    width = max(1, steep // 12, int(min(needed, loaded // 24)))
    mean = smooth(stress, width)

    def zero(samples: int) -> float:
        """Level that the mean of so many samples stays below at zero stress."""
        error = noise.sigma * np.sqrt(min(1.0, noise.time / samples))
        return min(0.0025 * peak + 2 * float(error), 0.04 * peak)

    level, end = zero(width), top
    while True:
        quiet = np.flatnonzero(mean[end:] <= level)
        if not quiet.size:  # a record cut right at the end of contact has returned
            return len(stress), bool(stress[-1] <= 0.02 * peak + level)
        end += int(quiet[0])
        ahead = end + max(1, (end - top) // 5)
        again = np.flatnonzero(mean[end:ahead] > 0.05 * peak)
        tail = stress[end : end + max(4 * width, (end - top) // 4)]
        if again.size:
            end += max(1, int(again[-1]))
        elif len(tail) > width and tail.mean() > zero(len(tail)):
            end += 1
        else:
            return end, True


def cut_to_contact(
    record: Record, start: Start, impact: bool, levels: dict[str, NoiseLevel]
) -> tuple[Record, list[str]]:
    """Cut what lies before and after contact; time and displacement are zero where it starts."""
    time, w = record.clock, record.displacement
    zero_time = _zero_time(record, start)
    first = 0 if start.time is None else int(np.searchsorted(time, start.time))
    notes: list[str] = []
    end = len(record)
    if impact:
        found, returned = contact_end(record.stress[first:], levels["stress"])
        end = min(end, first + found + max(3, found // 50)) if returned else end
        if not returned:
            notes.append("Check: the record ends before the stress has returned to zero.")
    cut = f"; {first} samples before and {len(record) - end} after are cut, {end - first} kept"
    at = "" if record.time is None else f", {engineering(zero_time, 's')} in the file"
    notes.insert(0, f"Contact starts {start.how}{at}{cut if end - first < len(record) else ''}.")
    if start.zero != 0:
        size, told = engineering(start.zero, "m"), f" ({start.zero_from})" * bool(start.zero_from)
        notes.append(f"The displacement there, {size}, is taken off{told}.")
    record = replace(
        record,
        time=None if record.time is None else time - zero_time,
        displacement=None if w is None else w - start.zero,
    )
    return record.between(first, end, "before contact starts", "after contact ends"), notes


def integrate_motion(record: Record, specimen: Specimen, striker: Striker) -> tuple[Record, str]:
    """Integrate the displacement from acceleration, else velocity, else from the force.

    From w(0) = 0 and w'(0) the striker's velocity; w'' = −a, or −σA/m. The integrals are exact
    where the channel is straight between samples.
    """
    time = record.time
    assert time is not None  # without a time the file has been refused
    if record.acceleration is not None and striker.velocity:
        rate, source = -record.acceleration, "acceleration"
    elif record.velocity is not None:
        rate, source = record.velocity, "velocity"
    else:
        assert striker.mass  # likewise
        rate, source = -record.stress * specimen.area / striker.mass, "force"
    # From time zero, which may lie before the first sample, to each sample.
    first = rate[0] if source == "velocity" else 0.0
    lead = time[0] > 0
    t, r = (np.append(0.0, time), np.append(first, rate)) if lead else (time, rate)
    dt = np.diff(t)
    once = np.append(0.0, np.cumsum(0.5 * dt * (r[1:] + r[:-1])))
    if source == "velocity":
        w = once
    else:
        assert striker.velocity
        v = striker.velocity + once
        w = np.append(0.0, np.cumsum(v[:-1] * dt + dt**2 * (2 * r[:-1] + r[1:]) / 6))
    return replace(record, displacement=w[1:] if lead else w), f"integrated from {source}"


def thin(record: Record) -> tuple[Record, list[str]]:
    """Average blocks of samples where there are many more than a fit needs; noise falls with it."""
    n = len(record)
    if n <= _MAX_ROWS:
        return record, []
    size = -(-n // _BLOCKS)
    edges = np.arange(0, n, size)
    counts = np.diff(np.append(edges, n))

    def mean(values: Array | None) -> Array | None:
        return None if values is None else np.add.reduceat(values, edges) / counts

    stress = mean(record.stress)
    assert stress is not None
    inside = {node: np.add.reduceat(v, edges) / counts for node, v in record.interior.items()}
    thinned = Record(mean(record.time), stress, mean(record.displacement), interior=inside)
    return thinned, [f"{n} samples are averaged in {len(edges)} blocks of {size}."]
