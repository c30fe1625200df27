"""A motion that was recorded with a clock of its own, put on the clock of the force.

If it has fewer samples, like that of a camera, it is interpolated, and only the samples of the
force that have a frame count as measured: `Record.sampled`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array, Integers, Mask, means
from foamfit.data.measurement import MIN_ROWS, NoiseLevel, Record
from foamfit.data.noise import averaged
from foamfit.data.outliers import find_outliers
from foamfit.errors import InputError
from foamfit.text import counted, engineering

_FEW = 8  # with fewer frames, straight lines are drawn and no spline
_SEVERAL = 2.0  # usual number of frames in a block from which on they are averaged
_PAUSE = 6.0  # usual steps of time that make a pause, across which the line is straight too


@dataclass(frozen=True, eq=False)
class Frames:
    """Motion of a file of its own: time, s, by its own clock, and displacements, m, by channel.

    A frame was taken at its time + `delay` (s) by the clock of the force; `spread` is the standard
    deviation of the delay, None if it is exact.
    """

    name: str
    time: Array
    motion: dict[str, Array]
    delay: float = 0.0
    spread: float | None = None

    def __str__(self) -> str:
        """Say how many frames there are, their clock, and the delay."""
        step, first, last = float(np.median(np.diff(self.time))), self.time[0], self.time[-1]
        sigma = "exactly" if self.spread is None else f"± {engineering(self.spread, 's')}"
        return (
            f"The motion is that of {self.name}: {self.time.size} frames, every "
            f"{engineering(step, 's')} from {engineering(float(first), 's')} to "
            f"{engineering(float(last), 's')} by its own clock; time of the force = time of the "
            f"motion + delay, and the delay is {engineering(self.delay, 's')} {sigma}."
        )


def join(record: Record, frames: Frames) -> Record:
    """Give a record of a force the motion of frames that have a clock of their own.

    If there are fewer frames than samples, a cubic spline through them gives the motion at every
    sample; only the sample nearest to a frame counts as measured. Otherwise they are averaged or
    interpolated for each sample, and all count. Spikes and samples outside the time of the frames
    are left out. InputError if the two do not overlap in time, or the delay is longer than both.
    """
    time = record.time
    assert time is not None  # a force without it is refused
    longest = max(np.ptp(time), np.ptp(frames.time))
    for size, what in ((frames.delay, "delay"), (frames.spread or 0.0, "± of delay")):
        if abs(size) > longest:
            raise InputError(
                f"[motion] {what} = {engineering(size, 's')} is longer than the record, "
                f"{engineering(float(longest), 's')}; it must be shorter."
            )
    at = frames.time + frames.delay
    slack = 1e-9 * longest  # for rounding
    outside = (time < at[0] - slack) | (time > at[-1] + slack)
    there = (at >= time[0] - slack) & (at <= time[-1] + slack)
    count = int(np.count_nonzero(~outside))
    if count < MIN_ROWS or there.sum() < 2:
        few = f"overlaps with {count} samples of the force in time, not with {MIN_ROWS} at least"
        shared = few if 0 < count < MIN_ROWS else "does not overlap in time with the force"
        spans = [" to ".join(engineering(float(t), "s") for t in c[[0, -1]]) for c in (time, at)]
        raise InputError(
            f"[motion] {frames.name} {shared}: that is from {spans[0]}, the motion with its delay "
            f"from {spans[1]}."
        )
    record = record.without(outside, f"outside the time of {frames.name}").noted(str(frames))
    time = record.instants
    if lost := int(np.count_nonzero(~there)):
        told = f"{counted(lost, 'frame')} of {frames.name} outside the time of the force."
        record = record.noted(told)
    slower = np.median(np.diff(at)) > 1.001 * np.median(np.diff(time))
    for channel, values in frames.motion.items():
        good = ~find_outliers(values, at)
        if not good.all():
            which = ", ".join(engineering(float(t), "s") for t in frames.time[~good][:4])
            out = f"{counted(int(np.sum(~good)), 'frame')} of the {channel} stood out and"
            record = record.noted(f"Check: {out} are not used, the first by its clock: {which}.")
        if not slower:
            record = record.changed(channel, _averaged(at[good], values[good], time))
            continue
        taken = _nearest(time, at[good & there])
        record = record.interpolated(channel, _through(at[good], values[good], time), taken).noted(
            f"{np.unique(taken).size} of {time.size} samples have a frame of the {channel}; "
            "between them it is interpolated and does not count as measured."
        )
    return record


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    return np.searchsorted(0.5 * (time[1:] + time[:-1]), at)


def _through(at: Array, values: Array, time: Array) -> Array:
    """Cubic spline through samples; straight where they are few, or across a pause."""
    from scipy.interpolate import CubicSpline

    straight = np.interp(time, at, values)
    if at.size < _FEW:
        return straight
    step = np.diff(at)
    gap = np.clip(np.searchsorted(at, time, side="right") - 1, 0, step.size - 1)
    pause = step[gap] > _PAUSE * float(np.median(step))
    return np.where(pause, straight, CubicSpline(at, values)(time))


def _averaged(at: Array, values: Array, time: Array) -> Array:
    """Mean of the samples that are nearest to each time, led to that time by a spline."""
    if np.median(np.diff(time)) >= 2.0 * np.median(np.diff(at)):
        step = 0.5 * (time[[1, -1]] - time[[0, -2]])
        near = (at >= time[0] - step[0]) & (at <= time[-1] + step[1])
        place = _nearest(time, at[near])
        starts = np.append(0, np.flatnonzero(np.diff(place)) + 1)
        at, values = (means(x[near], starts) for x in (at, values))
    return _through(at, values, time)


def frames_of_blocks(record: Record, thinned: Record, edges: Integers) -> Record:
    """Put channels that were not taken at every sample into the blocks that begin at `edges`.

    The value of a block is interpolated at its time, as averages over a curve are biased, or
    averaged where each block has several frames.
    """
    middle = means(record.instants, edges)
    for name, taken in record.sampled.items():
        values = record.channel(name)
        if values is None:
            continue
        many = np.add.reduceat(taken.astype(np.int64), edges)
        usual = float(np.median(many))
        whole = many >= 0.5 * usual if usual >= _SEVERAL else many > 0
        if usual < _SEVERAL:
            thinned = thinned.changed(name, np.interp(middle, record.instants, values))
        if usual < _SEVERAL or not whole.all():
            thinned = replace(thinned, sampled=thinned.sampled | {name: whole})
    return thinned


def noise_of_blocks(level: NoiseLevel, block: int, taken: Mask | None) -> NoiseLevel:
    """Noise of blocks of samples, some of which were `taken`; see `frames_of_blocks`."""
    edges = np.arange(0, 0 if taken is None else taken.size, block)
    if taken is None or np.median(np.add.reduceat(taken.astype(np.int64), edges)) >= _SEVERAL:
        return averaged(level, block)
    return replace(level, time=max(level.time * float(taken.mean()), 1.0))
