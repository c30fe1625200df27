"""The cycles of a slow test: where its motion turns round, and which loading is looked at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import Record
from foamfit.data.noise import noise_level
from foamfit.errors import InputError
from foamfit.text import percent

# Shares of the largest displacement: what a reversal goes back at least, what is left of it at
# rest, what counts as unloading, and a cycle that is named for being small.
_TURN, _REST, _UNLOADED, _SMALLER = 0.05, 0.35, 0.1, 0.9


def select_cycle(record: Record, cycle: int) -> tuple[Record, list[str]]:
    """Keep one loading and unloading of a slow test, cycle 1 being the first in the file.

    A cycle ends where the motion has gone back most of the way of the smaller of the peaks on
    either side; a reversal that goes back less is part of its cycle.
    """
    displacement = record.displacement
    if displacement is None:
        return record, []  # refused or integrated later
    peaks, rests = _cycles(displacement, record.stress)
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
            f"Check: cycle {cycle} reaches {percent(share)} of the largest displacement; "
            f"cycle {largest + 1} of {n} reaches all of it ([window] cycle = {largest + 1})."
        )
    if unloaded <= _UNLOADED * size:
        notes.append("The record has no unloading, so nothing in it determines unloading.")
    return record.between(start, end, f"before cycle {cycle}", f"after cycle {cycle}"), notes


def find_turns(values: Array) -> NDArray[np.int64]:
    """Samples at which a motion turns round: peaks and valleys by turns, the first a peak.

    Only what goes back by more than a twentieth of the range, and by more than the noise, turns.
    """
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
