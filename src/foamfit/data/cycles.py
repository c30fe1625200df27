"""The cycles of a slow test: where its motion turns round, and which loading is looked at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import Record
from foamfit.data.noise import noise_level, smooth
from foamfit.errors import InputError
from foamfit.text import engineering, percent

# Shares of the largest displacement: what a reversal goes back at least, what is left of it at
# rest, what counts as unloading, and a cycle that is named for being small.
_TURN, _REST, _UNLOADED, _SMALLER = 0.05, 0.35, 0.1, 0.9
# Share of the range of the displacement that is lowest between cycles; shares of the peak stress
# that are a load at all, and from which it is said that a later cycle never was without load.
_LOWEST, _LOADED, _STILL_LOADED = 0.02, 0.01, 0.05
# Share of its peak stress up to which the rise of a later cycle is taken for straight, the fewest
# samples of it, and the places that are tried for its foot.
_EARLY, _FEWEST, _PLACES = 0.1, 5, 400


@dataclass(frozen=True)
class Cycle:
    """One loading and unloading among the samples of a slow test: `first` up to `end`.

    `number` is that of the record's own column of cycles, or counts from 1; `place` counts from 0.
    """

    number: int
    place: int
    first: int
    top: int
    end: int


def find_cycles(record: Record) -> list[Cycle]:
    """List the cycles of a slow test; none if it has no displacement.

    A cycle ends where the motion has gone back most of the way of the smaller of the peaks on
    either side; a reversal that goes back less is part of its cycle. It runs from the last rest
    before its rise to its first return to rest after its fall.
    """
    displacement = record.displacement
    if displacement is None:
        return []  # refused or integrated later
    peaks, rests = _cycles(displacement, record.stress)
    size, n = float(np.ptp(displacement)), len(peaks)
    numbers = range(1, n + 1) if record.cycle is None else np.rint(record.cycle[peaks]).astype(int)
    found = []
    for place, (number, top) in enumerate(zip(numbers, peaks, strict=True)):
        after = displacement[top : peaks[place + 1] if place + 1 < n else len(record)]
        end = len(record)
        if after[0] - after.min() > _UNLOADED * size:
            end = top + int(np.argmax(after <= after.min() + 0.005 * size)) + 1
        found.append(Cycle(int(number), place, rests[place - 1] if place else 0, top, end))
    return found


def choose_cycle(cycles: list[Cycle], number: int | None) -> Cycle:
    """Return the cycle with this number, the first one without; InputError if it is not there."""
    if number is None:
        return cycles[0]
    there = [cycle.number for cycle in cycles]
    if there.count(number) != 1:
        wrong = "has it twice" if number in there else f"has {_numbers(there)}"
        raise InputError(f"cycle {number} cannot be taken: the file {wrong}; give one that it has.")
    return cycles[there.index(number)]


def _numbers(numbers: list[int]) -> str:
    """Say which cycles a file has, as in "1 to 6" or "145 of them from 1 to 1000"."""
    if len(numbers) == 1:
        return f"cycle {numbers[0]} alone"
    span = f"{min(numbers)} to {max(numbers)}"
    alike = numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    return f"cycles {span}" if alike else f"{len(numbers)} of the cycles {span}"


def cut_to_cycle(record: Record, cycles: list[Cycle], cycle: Cycle) -> tuple[Record, list[str]]:
    """Keep one loading and unloading of a slow test, and say what is cut."""
    displacement, n, number = record.displacement, len(cycles), cycle.number
    assert displacement is not None  # it has cycles
    size = float(np.ptp(displacement))
    start, top, end = cycle.first, cycle.top, cycle.end
    notes = []
    if n > 1 or end - start < len(record):
        order = "" if number == cycle.place + 1 else f" (number {cycle.place + 1} in the file)"
        notes.append(
            f"Cycle {number}{order} of {n} is used: {end - start} of {len(record)} samples, "
            f"{start} before it and {len(record) - end} after it are cut."
        )
    largest = max(cycles, key=lambda one: float(displacement[one.top])).number
    share = (displacement[top] - displacement.min()) / size
    if share < _SMALLER:
        notes.append(
            f"Check: cycle {number} reaches {percent(share)} of the largest displacement; "
            f"cycle {largest} of {n} reaches all of it (--cycle {largest}, or [window] cycle = "
            f"{largest})."
        )
    if end == len(record) and displacement[top] - displacement[top:].min() <= _UNLOADED * size:
        notes.append("The record has no unloading, so nothing in it determines unloading.")
    return record.between(start, end, f"before cycle {number}", f"after cycle {number}"), notes


@dataclass(frozen=True)
class Reload:
    """Contact of a later cycle: where its stress rises from no load, and falls back to it.

    `first` and `end` are samples of the whole record; `time` (s, or samples), `displacement` (m)
    and those of masses inside are at the start of contact. `offset` (Pa) is what the sensor shows
    without load, and `level` is the stress (Pa) above it at which contact ends.
    """

    first: int
    end: int
    time: float
    displacement: float
    interior: dict[int, float]
    offset: float
    level: float


def find_reload(record: Record, cycles: list[Cycle], cycle: Cycle) -> Reload:
    """Find the contact of a later cycle.

    The specimen is free or least loaded at the lowest displacements between the cycles. Contact is
    where a straight line through the early rise meets the level there: the hinge of least squares
    from the rest up to a small share of the peak, so that noise does not shift it. A level below
    zero is the sensor's: a foam does not pull its platen for long.
    """
    w, stress, top = record.displacement, record.stress, cycle.top
    assert w is not None  # it has cycles
    before = slice(cycles[cycle.place - 1].top, top)
    lowest = w[before] <= w[before].min() + _LOWEST * np.ptp(w)
    free = float(np.median(stress[before][lowest]))
    mean = smooth(stress, max(1, (top - cycle.first) // 100))
    rise = float(mean[top]) - free
    early = cycle.first + int(np.argmax(mean[cycle.first : top + 1] >= free + _EARLY * rise))
    part = slice(cycle.first, max(early, cycle.first + _FEWEST) + 1)
    displacement = _hinge(w[part], stress[part] - free)
    last = min(part.start + int(np.flatnonzero(w[part] <= displacement)[-1]), top - 1)
    ahead = float(w[last + 1] - w[last])
    share = (displacement - float(w[last])) / ahead if ahead > 0.0 else 0.0
    level = free + _LOADED * rise

    def passed(values: Array) -> float:
        return float(values[last] + share * (values[last + 1] - values[last]))

    back = np.flatnonzero(mean[top : cycle.end] <= level)
    return Reload(
        first=last + (share > 0.0),
        end=top + int(back[0]) + 1 if back.size else cycle.end,
        time=passed(record.instants),
        displacement=displacement,
        interior={node: passed(values) for node, values in record.interior.items()},
        offset=min(free, 0.0),
        level=level - min(free, 0.0),
    )


def _hinge(w: Array, stress: Array) -> float:
    """Displacement up to which a stress is zero, and from which it rises as a straight line."""
    every = slice(None, None, 1 + w.size // 1000)
    w, stress = w[every], stress[every]
    places = np.linspace(float(w.min()), float(w.max()), _PLACES, endpoint=False)
    beyond = np.maximum(w - places[:, None], 0.0)
    slopes = beyond @ stress / np.maximum(np.sum(beyond**2, axis=1), 1e-300)
    left = np.sum((stress - slopes[:, None] * beyond) ** 2, axis=1)
    return float(places[int(np.argmin(left))])


def cut_to_reload(
    record: Record, cycle: Cycle, at: Reload, height: float
) -> tuple[Record, list[str]]:
    """Cut a later cycle to its contact, with time, displacement and stress zero where it starts.

    The displacement was zero at the first contact: what the foam has not recovered since is taken
    off, and said as a strain.
    """
    number, w = cycle.number, record.displacement
    assert w is not None  # it has cycles
    strain = at.displacement / height
    peak = float(record.stress[cycle.top]) - at.offset
    moment = "" if record.time is None else f" {engineering(at.time, 's')} in the file,"
    notes = [
        f"Contact of cycle {number} starts{moment} where the stress rises from its level between "
        f"the cycles, at a strain of {percent(strain)} from the first contact (start strain, not "
        f"recovered), which is taken off; {at.first - cycle.first} samples before and "
        f"{cycle.end - at.end} after, where the stress has gone back to that level, are cut."
    ]
    if at.offset < 0.0:
        notes.append(
            f"The stress between the cycles, {engineering(at.offset, 'Pa')}, is taken off as the "
            "sensor's offset: without contact the specimen bears none."
        )
    elif at.level > _STILL_LOADED * peak:
        notes.append(
            f"Check: the specimen stays under load between the cycles, by "
            f"{percent(at.level / peak)} of the peak stress."
        )
    moved = replace(
        record,
        time=None if record.time is None else record.time - at.time,
        stress=record.stress - at.offset,
        displacement=w - at.displacement,
        interior={node: values - at.interior[node] for node, values in record.interior.items()},
    )
    cut = moved.without(slice(cycle.end, None), f"after cycle {number}")
    cut = cut.without(slice(at.end, None), "after contact ends")
    cut = cut.without(slice(cycle.first, at.first), "before contact starts")
    return cut.without(slice(0, cycle.first), f"before cycle {number}"), notes


def find_turns(values: Array, back: float | None = None) -> NDArray[np.int64]:
    """Samples at which a motion turns round: peaks and valleys by turns, the first a peak.

    Only what goes back by more than `back`, by default a twentieth of the range and more than the
    noise, turns.
    """
    if back is None:
        back = max(_TURN * float(np.ptp(values)), 8.0 * noise_level(values))
    # The extremes of short blocks are all that counts.
    block = max(1, len(values) // 20_000)
    parts = values[: len(values) // block * block].reshape(-1, block)
    first, rest = np.arange(len(parts)) * block, np.arange(parts.size, len(values))
    extremes = first + parts.argmin(axis=1), first + parts.argmax(axis=1)
    at = np.unique(np.concatenate([*extremes, rest]))
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


def _cycles(displacement: Array, stress: Array) -> tuple[list[int], list[int]]:
    """Peaks of the cycles of a slow test, and the last sample of the rest between two of them."""
    turns = find_turns(displacement)
    low = float(displacement.min())
    free = float(np.median(stress[displacement <= low + _LOWEST * np.ptp(displacement)]))
    least = free + _LOADED * (float(stress.max()) - free)
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


def inner_loops(displacement: Array) -> list[tuple[int, int]]:
    """Samples (first, past the last) in which one loading and unloading is partly reversed.

    A reversal lasts until the motion is past the place again where it turned.
    """
    turns = find_turns(displacement)
    peak, out = int(np.argmax(displacement[turns])), list[tuple[int, int]]()
    for i in (*range(0, peak, 2), *range(peak + 1, len(turns) - 1, 2)):
        start = int(turns[i])
        ahead = displacement[int(turns[i + 1]) :]
        past = ahead >= displacement[start] if i < peak else ahead <= displacement[start]
        stop = int(turns[i + 1]) + int(np.argmax(past)) if past.any() else len(displacement)
        if not out or start >= out[-1][1]:  # a loop in a loop is a part of it
            out.append((start, stop))
    return out


def inner_reversals(displacement: Array) -> list[str]:
    """Say where the motion of one loading and unloading turns round below its peak."""
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
    times, share = "once" if len(backs) == 1 else f"{len(backs)} times", max(backs) / size
    return [
        f"Check: the record reverses {times} below its peak, by up to {percent(share)} of it; "
        "bistable springs have no inner loops: their partial unloading runs back along the branch "
        "it came along, so a loop there stays in the residuals; microscale springs follow it."
    ]
