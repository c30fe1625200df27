"""Where contact starts and ends, and what stress and motion are there: time zero, and offsets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import MIN_ROWS, NoiseLevel, Record, Striker, interior_node
from foamfit.data.noise import noise_level
from foamfit.data.rest import (
    ERRORS,
    LEAST_REST,
    MIN_REST,
    STILL,
    Level,
    leave_rest,
    level_by_balance,
    level_on_line,
    line_at,
    resting_level,
    slopes,
    smooth,
)
from foamfit.text import engineering

_STILL_STRIKER = 0.5  # as `STILL`, for a striker, which contact does not speed up
_ELSEWHERE = 5.0  # standard errors that decide whether the zero of a motion lies elsewhere

Levels = dict[str, NoiseLevel]


@dataclass(frozen=True)
class Start:
    """Where contact starts: at a time of the file (None: at its first sample).

    `zero` is the displacement there, and `zero_from` says what shows it. With `free` nothing
    pressed on the specimen before, so that the samples before it show the sensor's offset. With
    `at_zero` contact starts at the file's time zero, before its first sample.
    """

    how: str
    time: float | None = None
    zero: float = 0.0
    free: bool = False
    zero_from: str = ""
    at_zero: bool = False

    @property
    def by(self) -> str:
        """The channel that set time zero: "stress", "motion", or "file" for the file's own."""
        if self.time is None:
            return "file"
        return "motion" if "displacement" in self.how else "stress"

    def rest(self, record: Record) -> int:
        """Count the samples that surely lie before contact."""
        if self.time is None:
            return 0
        return max(0, int(np.searchsorted(record.instants, self.time)) - 2)

    def zero_time(self, record: Record) -> float:
        """Time of contact as the file counts it."""
        if self.time is not None:
            return self.time
        # A file whose first sample is a step or so after time zero has its zero right.
        first, second = record.instants[:2]
        return 0.0 if self.at_zero or 0 <= first <= 2 * (second - first) else float(first)


def find_start(record: Record, levels: Levels, striker: Striker | None) -> Start:
    """Find where contact starts, which motion and stress decide together.

    A motion that passes its own zero, or leaves a rest, starts contact there, unless the stress has
    risen before; a stress that leaves a rest starts it while the motion goes on. Where no rest is
    shown, contact starts at the first sample.
    """
    time, w, stress = record.instants, record.displacement, record.stress
    impact, drift = striker is not None, 0.01 * float(stress.max())
    by_the_stress = "where the stress leaves its rest"
    if w is None:
        at = leave_rest(time, stress, levels["stress"], drift=drift)
        return Start("at the first sample") if at is None else Start(by_the_stress, at, free=True)
    noise, top = levels["displacement"], int(np.argmax(w))
    first, balance = _first_levels(time, w, stress, top, noise)
    surely = min(first, balance, key=lambda level: level.significance) if impact else first
    away = surely.significance > _ELSEWHERE
    elsewhere = away and abs(first.value) > 0.02 * (w[top] - first.value)
    # Where the motion of a striker starts at its zero, no stress that rises is taken for a rest.
    drift = np.inf if elsewhere else 0.0 if impact else drift
    by_stress = leave_rest(time, stress, levels["stress"], drift=drift)
    if impact and elsewhere and by_stress is None:
        # The file's zero does not lie at its first sample: the likelier start is taken.
        by_stress = leave_rest(time, stress, levels["stress"], _STILL_STRIKER)
    onset = 0 if by_stress is None else int(np.searchsorted(time, by_stress))
    travel = float(w[top] - w[onset])
    crossing, near = _passage(time, w, top, noise)
    below = crossing > 1 and away and surely.value < -1e-4 * travel
    unloaded = stress[near].mean() < 0.2 * stress.max()
    unloaded &= not _loaded(record, time[crossing], levels)
    if below and unloaded and (by_stress is None or abs(w[onset]) < 0.3 * w[top]):
        level, speed = line_at(time[near], w[near], time[crossing])
        at = time[crossing] - level / speed if speed > 0 else time[crossing]
        at = float(np.clip(at, time[near][0], time[near][-1]))
        own = abs(at) < 0.05 * (time[crossing] - time[crossing - 1])  # the file's own time zero
        return Start("where the displacement passes zero", 0.0 if own else at)
    up_to = slice(top + 1)
    by_motion = leave_rest(time[up_to], w[up_to], noise, _STILL_STRIKER if impact else STILL)
    approach = w[onset] - first.value if by_stress is not None else 0.0
    # A striker's motion starts at contact, if tracked so; a machine's may start above the specimen.
    small = approach < (0.3 if impact else 0.1) * travel
    if by_motion is not None and small and not _loaded(record, by_motion, levels):
        rest = resting_level(w[time < by_motion], noise)
        source = rest.source(noise, "median of") + " at rest before contact"
        return Start("where the displacement leaves its rest", by_motion, rest.value, True, source)
    if by_stress is not None and approach > (0.02 if elsewhere else 0.1) * travel:
        reach = max(5, min(onset, (top - onset) // 24))
        near = slice(max(0, onset - reach), onset + reach)
        zero = level_on_line(time[near], w[near], by_stress, noise)
        source = zero.source(noise, "line through") + " around it, the stress being at rest before"
        return Start(by_the_stress, by_stress, zero.value, True, source)
    gone = time[0] * (striker.velocity or 0.0) if striker is not None else 0.0
    if surely.significance > ERRORS and 0.7 < first.value / max(gone, 1e-300) < 1.1:
        return Start("before the first sample", at_zero=True)
    under_load = stress[:3].mean() > 0.05 * stress.max() and 0 < first.value < travel
    if under_load or not elsewhere:
        return Start("at the first sample")
    source = first.source(noise, "line through") + " from the first on; the file's zero lies"
    return Start("at the first sample", zero=first.value, zero_from=f"{source} elsewhere")


def _first_levels(
    time: Array, w: Array, stress: Array, top: int, noise: NoiseLevel
) -> tuple[Level, Level]:
    """Level of a motion at its first sample: by a line, and by the balance of a striker."""
    if top < LEAST_REST:
        return (Level(float(w[0]), np.inf, 1),) * 2  # so few samples show no zero
    early, loading = slice(0, max(LEAST_REST, top // 12)), slice(0, 2 * top)
    by_line = level_on_line(time[early], w[early], time[0], noise)
    return by_line, level_by_balance(time[loading], w[loading], stress[loading])


def _loaded(record: Record, at: float, levels: Levels) -> bool:
    """Whether the stress has plainly risen before a time."""
    return slopes(record.instants, record.stress, at, levels["stress"]).lower > STILL


def _passage(time: Array, w: Array, top: int, noise: NoiseLevel) -> tuple[int, slice]:
    """Sample at which the moving mean of a rising motion passes zero, and the samples around it.

    They bring the scatter of their line to a thousandth of the rise, but lie within a twelfth of
    the rise on either side, where the motion is still straight.
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


def zero_interior(
    record: Record, first: Record, start: Start, levels: Levels
) -> tuple[Record, list[str]]:
    """Take from each interior displacement its value where contact starts in `first`.

    That is the median of its rest before contact, or else where a line through the first samples
    starts, unless this is zero within their noise.
    """
    before, notes = start.rest(first), []
    for name, values in first.curves().items():
        if interior_node(name) is None:
            continue
        noise = levels[name]
        if before >= MIN_ROWS:
            zero = resting_level(values[:before], noise)
            source = zero.source(noise, "median of") + " before contact"
        else:
            early = slice(before, before + max(LEAST_REST, int(np.argmax(values)) // 12))
            at = start.zero_time(first)
            zero = level_on_line(first.instants[early], values[early], at, noise)
            source = zero.source(noise, "line through") + " from there on"
            if abs(zero.value) < max(_ELSEWHERE * zero.error, 2e-3 * np.ptp(values)):
                continue
        record = record.changed(name, record.curves()[name] - zero.value)
        if abs(zero.value) > 1e-3 * np.ptp(values):
            size = engineering(zero.value, "m")
            notes.append(f"{name} at contact, {size}, is taken off ({source}).")
    return record, notes


def remove_offset(record: Record, n: int, noise: NoiseLevel) -> tuple[Record, list[str]]:
    """Take from the stress (and the acceleration) its median over `n` samples before contact."""
    if n < MIN_REST:
        return record, []
    rest = record.stress[:n]
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
    if record.acceleration is not None:
        a = record.acceleration
        record = record.changed("acceleration", a - np.median(a[:n]))
    return record.changed("stress", record.stress - offset), [note]


def contact_end(stress: Array, noise: NoiseLevel) -> tuple[int, bool]:
    """Index after the last sample of the contact with the highest stress, and if it was reached.

    The end is the last return to zero of a moving mean, whose noise is half a percent of the peak
    if the pulse is long enough. A stress that soon rises again has not ended, nor one whose mean
    over the next quarter of the time since the peak is not zero within its error.
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
    record: Record, start: Start, impact: bool, noise: NoiseLevel
) -> tuple[Record, list[str]]:
    """Cut what lies before and after contact; time and displacement are zero where it starts."""
    w, zero_time = record.displacement, start.zero_time(record)
    first = 0 if start.time is None else int(np.searchsorted(record.instants, start.time))
    notes: list[str] = []
    end = len(record)
    if impact:
        found, returned = contact_end(record.stress[first:], noise)
        end = min(end, first + found + max(3, found // 50)) if returned else end
        if not returned:
            notes.append("Check: the record ends before the stress has returned to zero.")
    cut = f"; {first} samples before and {len(record) - end} after are cut, {end - first} kept"
    at = "" if record.time is None else f", {engineering(zero_time, 's')} in the file"
    notes.insert(0, f"Contact starts {start.how}{at}{cut if end - first < len(record) else ''}.")
    if start.zero != 0:
        size, source = engineering(start.zero, "m"), f" ({start.zero_from})"
        notes.append(f"The displacement there, {size}, is taken off{source}.")
    if record.time is not None:
        record = replace(record, time=record.time - zero_time)
    if w is not None:
        record = replace(record, displacement=w - start.zero)
    return record.between(first, end, "before contact starts", "after contact ends"), notes
