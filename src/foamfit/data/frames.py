"""Align a motion that was recorded with its own clock with the clock of the force.

If it has fewer samples than the force, like that of a camera, it is interpolated. Only samples of
the force with a frame then count as measured, see `Record.sampled`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array, means
from foamfit.data.measurement import MIN_ROWS, Record
from foamfit.data.outliers import PAUSE, find_outliers, fresh_samples
from foamfit.errors import InputError
from foamfit.text import counted, engineering


@dataclass(frozen=True, eq=False)
class Frames:
    """Motion from a separate file: time, s, of its own clock, and displacements, m, by channel.

    On the clock of the force, a frame has its time + `delay` (s); `spread` is the standard
    deviation of the delay, None if it is exact.
    """

    name: str
    time: Array
    motion: dict[str, Array]
    delay: float = 0.0
    spread: float | None = None

    def __str__(self) -> str:
        """Return a sentence with the number of frames, their clock, and the delay."""
        clock = float(np.median(np.diff(self.time))), *self.time[[0, -1]].tolist(), self.delay
        step, first, last, delay = (engineering(t, "s") for t in clock)
        sigma = "exactly" if self.spread is None else f"± {engineering(self.spread, 's')}"
        return (
            f"The motion is that of {self.name}: {self.time.size} frames, every {step} from "
            f"{first} to {last} by its own clock; time of the force = time of the motion + delay, "
            f"and the delay is {delay} {sigma}."
        )


def join(record: Record, frames: Frames) -> Record:
    """Add the motion of frames with their own clock to a record of a force.

    If there are fewer frames than samples, the motion at each sample comes from a cubic spline, and
    only the sample nearest to a frame counts as measured. Otherwise frames are averaged or
    interpolated for each sample, and all samples count. Spikes, and samples outside the time of the
    frames, are dropped. Raises InputError if the two hardly overlap in time, or if the ± of the
    delay is longer than both.
    """
    time = record.time
    assert time is not None  # a force without a time was rejected
    longest = max(np.ptp(time), np.ptp(frames.time))
    if (spread := frames.spread or 0.0) > longest:
        wrong = f"[motion] ± of delay = {engineering(spread, 's')} is longer than the record"
        raise InputError(f"{wrong}, {engineering(float(longest), 's')}; it must be shorter.")
    at = frames.time + frames.delay
    slack = 1e-9 * longest  # for rounding
    outside = (time < at[0] - slack) | (time > at[-1] + slack)
    inside = (at >= time[0] - slack) & (at <= time[-1] + slack)
    count = int(np.count_nonzero(~outside))
    if count < MIN_ROWS or inside.sum() < 2:
        few = f"overlaps in time with {count} samples of the force; at least {MIN_ROWS} are needed"
        shared = few if 0 < count < MIN_ROWS else "does not overlap in time with the force"
        spans = [" to ".join(engineering(float(t), "s") for t in c[[0, -1]]) for c in (time, at)]
        when = f"the force is from {spans[0]}, the motion with its delay from {spans[1]}"
        raise InputError(f"[motion] {frames.name} {shared}: {when}.")
    record = record.without(outside, f"outside the time of {frames.name}").noted(str(frames))
    time = record.instants
    if lost := int(np.count_nonzero(~inside)):
        frames_lost = f"{counted(lost, 'frame')} of {frames.name}"
        record = record.noted(f"{frames_lost} outside the time of the force.")
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
        taken = _nearest(time, at[good & inside])
        record = record.interpolated(channel, _through(at[good], values[good], time), taken).noted(
            f"{np.unique(taken).size} of {time.size} samples have a frame of the {channel}; "
            "between them it is interpolated and does not count as measured."
        )
    return record


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    return np.searchsorted(0.5 * (time[1:] + time[:-1]), at)


def _through(at: Array, values: Array, time: Array) -> Array:
    """Interpolate by a cubic spline, across a pause linearly."""
    from scipy.interpolate import CubicSpline

    step = np.diff(at)
    gap = np.clip(np.searchsorted(at, time, side="right") - 1, 0, step.size - 1)
    pause = step[gap] > PAUSE * float(np.median(step))
    return np.where(pause, np.interp(time, at, values), CubicSpline(at, values)(time))


def _averaged(at: Array, values: Array, time: Array) -> Array:
    """Average the samples nearest to each time, and interpolate the means to that time."""
    if np.median(np.diff(time)) >= 2.0 * np.median(np.diff(at)):
        step = 0.5 * (time[[1, -1]] - time[[0, -2]])
        near = (at >= time[0] - step[0]) & (at <= time[-1] + step[1])
        place = _nearest(time, at[near])
        at, values = (means(x[near], fresh_samples(place)[0]) for x in (at, values))
    return _through(at, values, time)
