"""Find the cycles of a slow test from the turns of its motion, and the rate of its loading."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array, Integers
from foamfit.data.contact import misfits_of_rises
from foamfit.data.measurement import Measurement, Record
from foamfit.data.noise import TENSION, lowest_mean, noise_level, smooth
from foamfit.errors import InputError
from foamfit.text import engineering, percent

# Shares of the range of the displacement
_TURN = 0.05  # least way back at a reversal
_REST = 0.35  # most displacement at rest between two cycles
_UNLOADED = 0.1  # least decrease that counts as unloading
_SMALLER = 0.9  # a cycle with a lower peak is reported as small
_LOWEST = 0.02  # the lowest displacements, at which the specimen is unloaded
# Shares of the peak stress
_LOADED = 0.01  # more counts as load
_REMEMBERED, _PER_CYCLE = 3, 60  # cycles before a later one, and their samples, that are kept
_STILL_LOADED = 0.05  # from here a later cycle is reported to start under load
_EARLY = 0.1  # the rise of a later cycle is straight up to here
_FEWEST = 5  # least number of samples of that rise
_PLACES = 400  # number of trial values for the start of that rise
_SURE = 4.0  # standard errors for a stress significantly below zero
_STRETCH = 1000  # samples in which the next turn is searched first
_BEGUN = 3.0  # multiple of the least load above which the first rise has certainly started

# Rate
_AT_PEAK = 3.0  # samples within this many standard deviations below the largest may be the peak
_CLOSE = 0.95  # share of the peak from which a parabola leads to it
_HELD = 1.15  # ratio of the middle of a peak to its end on a parabola above which it is a hold


@dataclass(frozen=True)
class Cycle:
    """One loading and unloading of a slow test, or several as one history: `first` to `end`.

    `number` comes from the column of cycles in the record, or counts from 1; `place` counts from 0.
    The first peak is at sample `top`, the last one at `turn`. `last` is the number of the last of
    several cycles.
    """

    number: int
    place: int
    first: int
    top: int
    end: int
    turn: int
    last: int | None = None


def find_cycles(record: Record) -> list[Cycle]:
    """List the cycles of a slow test; none without a displacement.

    Two cycles are separate if the motion between them goes back most of the way from the smaller of
    the two peaks. A smaller reversal is part of its cycle, and so is motion without load, such as
    an approach. A cycle runs from the last rest before its rise to its first return to rest.
    """
    w, stress = record.displacement, record.stress
    if w is None:
        return []  # rejected or integrated later
    turns, low, size = find_turns(w), float(w.min()), float(np.ptp(w))
    free = float(np.median(stress[w <= low + _LOWEST * size]))
    least = free + _LOADED * (float(stress.max()) - free)
    peaks, rests = [int(turns[0])], [0]
    # The approach before the first load does not count as part of the way to a peak.
    first = next((int(turn) for turn in turns[::2] if stress[turn] >= least), 0)
    light = np.flatnonzero(stress[:first] <= free + _BEGUN * (least - free))
    low = max(low, float(w[light[-1]])) if light.size else low
    for valley, peak in zip(turns[1::2], turns[2::2], strict=False):
        unloaded = w[valley] - low < _REST * (min(w[peaks[-1]], w[peak]) - low)
        if stress[peaks[-1]] >= least and unloaded:
            rests.append(int(peak) - int(np.argmin(w[peaks[-1] : peak + 1][::-1])))
            peaks.append(int(peak))
        elif stress[peaks[-1]] < least or w[peak] > w[peaks[-1]]:
            peaks[-1] = int(peak)
    column, found = record.cycle, list[Cycle]()
    for place, (first, top, after) in enumerate(zip(rests, peaks, [*peaks[1:], None], strict=True)):
        fall, end = w[top:after], after or len(record)
        if fall[0] - fall.min() > _UNLOADED * (w[top] - low):
            end = top + int(np.argmax(fall <= fall.min() + 0.005 * size)) + 1
        number = place + 1 if column is None else round(float(column[top]))
        found.append(Cycle(number, place, first, top, end, turn=top))
    return found


def choose_cycles(cycles: list[Cycle], number: int | None, last: int | None) -> Cycle | None:
    """Return a cycle (default: the first, None without cycles), or several as one history."""
    first = _choose(cycles, number)
    if last is None or last == number:
        return first
    end = _choose(cycles, last) if len(cycles) > 1 else None
    if first is None or end is None or end.place <= first.place:
        wrong = f"cycles {number} to {last} cannot be taken"
        why = "the record has no such cycles in this order; foamfit check says how many it has"
        raise InputError(f"{wrong}: {why}.")
    return replace(first, end=end.end, last=end.number, turn=end.top)


def _choose(cycles: list[Cycle], number: int | None) -> Cycle | None:
    if number is None or not cycles:
        return cycles[0] if cycles else None
    numbers = [cycle.number for cycle in cycles]
    if numbers.count(number) == 1:
        return cycles[numbers.index(number)]
    wrong = f"has cycles {numbers[0]} to {numbers[-1]}"
    if number in numbers:
        wrong = "contains it twice"
    elif len(numbers) == 1:
        wrong = f"has only cycle {numbers[0]}"
    elif numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        wrong = f"has {len(numbers)} of the cycles {min(numbers)} to {max(numbers)}"
    raise InputError(f"cycle {number} cannot be taken: the file {wrong}; give one that exists.")


def cut_to_cycle(record: Record, cycles: list[Cycle], cycle: Cycle) -> Record:
    """Keep the samples of one loading and unloading, or of several cycles."""
    w, n, number = record.curves()["displacement"], len(cycles), cycle.number
    size, start, top, end = float(np.ptp(w)), cycle.first, cycle.top, cycle.end
    notes = []
    if n > 1 or end - start < len(record):
        order = "" if number == cycle.place + 1 else f" (number {cycle.place + 1} in the file)"
        named, used = f"Cycle {number}", "is used"
        if cycle.last is not None:
            named, used = f"Cycles {number} to {cycle.last}", "are used as one history"
        cut = f"{start} before and {len(record) - end} after are cut"
        rows = f"{end - start} of {len(record)} samples"
        notes.append(f"{named}{order} of {n} {used}: {rows}, {cut}.")
    largest = max(cycles, key=lambda c: float(w[c.top])).number
    share = (w[top] - w.min()) / size
    if share < _SMALLER and cycle.last is None:
        how = f"--cycle {largest}, or [window] cycle = {largest}"
        notes.append(
            f"Check: cycle {number} reaches {percent(share)} of the largest displacement; "
            f"cycle {largest} of {n} reaches all of it ({how})."
        )
    if end == len(record) and w[cycle.turn] - w[cycle.turn :].min() <= _UNLOADED * size:
        notes.append("The record has no unloading, so the unloading is undetermined.")
    after = f"after cycle {cycle.last or number}"
    return record.noted(*notes).between(start, end, f"before cycle {number}", after)


def cut_to_reload(record: Record, cycles: list[Cycle], cycle: Cycle, height: float) -> Record:
    """Cut a later cycle to its contact; time, displacement and stress are zero at its start.

    The specimen is unloaded, or loaded least, at the lowest displacements between the cycles.
    Contact starts where a straight line through the early rise meets the level of the stress there,
    and ends where the stress returns to that level. A level clearly below zero is an offset of the
    sensor, as a foam does not pull its platen for long. If the zero was measured before contact and
    the tension is more than that of a loose specimen, it is glued: then the level is zero. The
    strain not recovered is `origins["start_strain"]`. The motion `before` is kept, as a stress that
    relaxes remembers it.
    """
    w, stress, top = record.curves()["displacement"], record.stress, cycle.top
    turn, number, end_of = cycle.turn, cycle.number, cycle.last or cycle.number
    free, error = _level_between(record, cycles, cycle.place - 1)
    mean = smooth(stress, max(1, (top - cycle.first) // 100))
    glued = _is_glued(record, free, float(mean[top]))
    free = 0.0 if glued else free
    rise = float(mean[top]) - free
    early = cycle.first + int(np.argmax(mean[cycle.first : top + 1] >= free + _EARLY * rise))
    part = slice(cycle.first, max(early, cycle.first + _FEWEST) + 1)
    above = stress[part] - free
    contact = _hinge(w[part], np.maximum(above, 0.0) if glued else above)
    last = min(part.start + int(np.flatnonzero(w[part] <= contact)[-1]), top - 1)
    ahead = float(w[last + 1] - w[last])
    share = (contact - float(w[last])) / ahead if ahead > 0.0 else 0.0

    def at_contact(values: Array) -> float:
        return float(values[last] + share * (values[last + 1] - values[last]))

    level, offset = free + _LOADED * rise, free if free < -_SURE * error else 0.0
    back = np.flatnonzero(mean[turn : cycle.end] <= level)
    first, end = last + (share > 0.0), turn + int(back[0]) + 1 if back.size else cycle.end
    time = at_contact(record.instants)
    moment = "" if record.time is None else f" {engineering(time, 's')} in the file,"
    level_of = "zero (taken as glued)" if glued else "its level between the cycles"
    notes = [
        f"Contact of cycle {number} starts{moment} where the stress rises above {level_of}, at a "
        f"strain of {percent(contact / height)} from the first contact (start strain, not "
        f"recovered), which is taken off; {first - cycle.first} samples before and "
        f"{cycle.end - end} after contact are cut."
    ]
    loaded = (level - offset) / (float(stress[top]) - offset)
    if offset < 0.0:
        notes.append(_offset_note("between the cycles", offset))
    elif loaded > _STILL_LOADED:
        by = f"by {percent(loaded)} of the peak stress"
        notes.append(f"Check: the specimen stays under load between the cycles, {by}.")
    moved = record.shifted("stress", offset).shifted("displacement", contact)
    moved = moved if record.time is None else moved.shifted("time", time)
    moved = replace(
        moved,
        interior={node: values - at_contact(values) for node, values in record.interior.items()},
        zeros={name: record.zeros[name] for name in moved.zeros.keys() & {"stress"}},
        origins=moved.origins | {"start_strain": contact / height},
        before=_before(moved, cycles[: cycle.place], last),
        notes=(*cut_to_cycle(record, cycles, cycle).notes, *notes),
    )
    cut = moved.between(cycle.first, cycle.end, f"before cycle {number}", f"after cycle {end_of}")
    first, end = first - cycle.first, end - cycle.first
    return cut.between(first, end, "before contact starts", "after contact ends")


def _before(record: Record, earlier: list[Cycle], last: int) -> tuple[Array, Array] | None:
    """Return times and motion of the last cycles up to a row, with their turning points."""
    if record.time is None:
        return None
    kept = earlier[-_REMEMBERED:]
    turns = [row for one in kept for row in (one.first, one.top)]
    rows = np.linspace(turns[0], last, _PER_CYCLE * len(kept)).astype(int)
    rows = np.unique([*rows, *turns])
    return record.time[rows], record.curves()["displacement"][rows]


def zero_between(record: Record, cycles: list[Cycle], cycle: Cycle) -> Record:
    """Use a stress significantly below zero after the first of several cycles as its zero."""
    if cycle.last is None:
        return record
    # A preloaded specimen may become free only after the first cycle.
    zero, error = _level_between(record, cycles, cycle.place)
    tension = min(zero, lowest_mean(record.stress[cycle.top : cycles[cycle.place + 1].top], 0)[0])
    if zero > -_SURE * error or _is_glued(record, tension, float(record.stress[cycle.top])):
        return record
    record = replace(record.shifted("stress", zero), zeros=record.zeros | {"stress": error})
    return record.noted(_offset_note("between the first two cycles", zero))


def _offset_note(when: str, zero: float) -> str:
    free, value = "without contact the specimen bears none", engineering(zero, "Pa")
    return f"The stress {when}, {value}, is taken off as the sensor's offset: {free}."


def _level_between(record: Record, cycles: list[Cycle], place: int) -> tuple[float, float]:
    """Return the stress at the lowest displacements between two peaks, and its standard error."""
    between, w = slice(cycles[place].top, cycles[place + 1].top), record.curves()["displacement"]
    rest = record.stress[between][w[between] <= w[between].min() + _LOWEST * np.ptp(w)]
    return float(np.median(rest)), float(np.std(rest)) / float(np.sqrt(rest.size))


def _is_glued(record: Record, level: float, peak: float) -> bool:
    """Return whether a stress between cycles is tension that only a glued specimen bears."""
    error = record.zeros.get("stress", np.inf)  # finite if the zero was measured before contact
    return level < -max(TENSION * peak, _SURE * error)


def _hinge(w: Array, stress: Array) -> float:
    """Return the displacement up to which a stress is zero and from which it rises linearly."""
    every = slice(None, None, 1 + w.size // 1000)
    w, stress = w[every], stress[every]
    places = np.linspace(float(w.min()), float(w.max()), _PLACES, endpoint=False)
    return float(places[int(np.argmin(misfits_of_rises(w, stress, places, centred=False)))])


def find_turns(values: Array, back: float | None = None) -> Integers:
    """Return the samples at which a motion turns: peaks and valleys alternate, first a peak.

    A turn goes back by more than `back`, by default a twentieth of the range and more than noise.
    """
    if back is None:
        back = max(_TURN * float(np.ptp(values)), 8.0 * noise_level(values))
    # Search increasingly long stretches after a turn for the next one.
    turns, first, sign, length = list[int](), 0, 1.0, _STRETCH
    while True:
        ahead = sign * values[first : first + length]
        gone = np.maximum.accumulate(ahead) - ahead > back
        end = int(np.argmax(gone))
        if gone[end]:
            turns.append(first + int(np.argmax(ahead[:end])))
            first, sign, length = first + end, -sign, _STRETCH
        elif first + length < values.size:
            length *= 2
        else:
            break
    if sign > 0.0 or not turns:  # the record ends while rising
        turns.append(first + int(np.argmax(ahead)))
    return np.array(turns, dtype=np.int64)


def cycles_of(test: Measurement) -> dict[int, slice]:
    """Return the samples of each cycle, by number, of several used as one history; else {}.

    Cycles are separated where the motion turns from unloading to loading.
    """
    if test.last_cycle is None or test.displacement is None:
        return {}
    turns = find_turns(test.displacement, _REST * float(np.ptp(test.displacement)))
    ends = [0, *turns[1::2].tolist()]
    numbers = test.cycles[test.cycles.index(test.cycle) : test.cycles.index(test.last_cycle) + 1]
    ends = [*ends[: len(numbers)], len(test.displacement)]
    return {n: slice(*ends[i : i + 2]) for i, n in enumerate(numbers[: len(ends) - 1])}


def _reversals(displacement: Array) -> list[tuple[int, int, bool]]:
    """Return the turns at both ends of each inner reversal, and whether it occurs on loading."""
    turns = find_turns(displacement).tolist()
    peak = int(np.argmax(displacement[turns]))
    places = *range(0, peak, 2), *range(peak + 1, len(turns) - 1, 2)
    return [(turns[i], turns[i + 1], i < peak) for i in places]


def inner_loops(displacement: Array) -> list[tuple[int, int]]:
    """Return the samples (first, end) from each reversal until the motion is back there."""
    out = list[tuple[int, int]]()
    for start, turn, loading in _reversals(displacement):
        ahead, level = displacement[turn:], displacement[start]
        past = ahead >= level if loading else ahead <= level
        stop = turn + int(np.argmax(past)) if past.any() else len(displacement)
        if not out or start >= out[-1][1]:  # skip a loop within a loop
            out.append((start, stop))
    return out


def inner_reversals(displacement: Array) -> list[str]:
    """Return a note if the motion of one loading and unloading reverses below its peak."""
    backs = [abs(displacement[a] - displacement[b]) for a, b, _ in _reversals(displacement)]
    if not backs:
        return []
    times = "once" if len(backs) == 1 else f"{len(backs)} times"
    share = percent(float(max(backs) / np.ptp(displacement)))
    return [
        f"Check: the record reverses {times} below its peak, by up to {share} of it; a law with "
        "no inner loops runs back along the branch it came along, so a loop there stays in the "
        "residuals of its fit."
    ]


def loading_rate(test: Measurement) -> float | None:
    """Return the mean strain rate from contact to the largest strain, 1/s; None without a time.

    The peak is the middle of the samples that may be the largest in view of the noise, or the start
    of a hold.
    """
    if test.time is None or test.displacement is None:
        return None
    time, motion, noise = test.time, test.displacement, test.noise.of("displacement")
    sigma = noise.sigma if noise else 0.0
    if test.striker is not None and time[0] < 0.0:  # neither flight nor rest before contact loads
        motion = np.append(np.interp(0.0, time, motion), motion[time > 0.0])
        time = np.append(0.0, time[time > 0.0])
    time = time - time[0]
    velocity = _velocity(time, motion, sigma)
    return None if velocity is None else velocity / test.specimen.height


def _velocity(time: Array, motion: Array, sigma: float) -> float | None:
    """Return the mean velocity up to the peak of a measured motion; None if it never rises.

    Where the samples that may be the peak last longer than on a parabola, the motion is held.
    """
    motion = motion - motion[0]
    most = float(motion.max())
    if most <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    near = int(np.argmax(motion >= _CLOSE * most))
    below = np.flatnonzero(motion[near:] < 0.5 * most)
    if below.size:  # the peak is that of the first cycle
        time, motion = time[: near + below[0]], motion[: near + below[0]]
        most = float(motion.max())
        near = int(np.argmax(motion >= _CLOSE * most))
    when, depth = float(np.mean(time[motion >= most - _AT_PEAK * sigma])), 2.0 * _AT_PEAK * sigma
    close, first = time[near], time[np.argmax(motion >= most - depth)]
    share = math.sqrt(depth / ((1.0 - _CLOSE) * most))  # of the way from `close` that is left
    top = float(close + (first - close) / (1.0 - share)) if share < 1.0 else when
    top = top if when > _HELD * top else when
    rest = np.flatnonzero(motion[:near] <= depth)  # rows of a rest before contact do not load
    low = int(rest[-1]) + 1 if depth > 0.0 and rest.size else 0
    return float((most - motion[low]) / (top - time[low])) if top > time[low] else None
