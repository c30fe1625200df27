"""Find the channels that are negative in compression, judged over the loading.

A run is a part of the record in which the motion does not turn. The first run in which the force
does a considerable part of its work is the loading (or the unloading, if the force falls to zero
in it). It shows the directions of force and motion in compression. Extremes have no influence:
adhesion, a spike or rows after the test do little work.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.cycles import find_turns
from foamfit.data.noise import integrated_twice, noise_level
from foamfit.data.outliers import fresh_samples, inner_samples

FORCES = "stress", "force", "acceleration"  # the preferred one first
MOTIONS = "displacement", "strain"
_FIRST = 0.2  # least work (or impulse) of the loading, as a share of the largest one
_FEW, _NEAR = 9, 0.002  # most samples at an end of a run, and most of its way, with one force
_UNLOADED = 0.25  # an unloading ends below this share of the force at its start
_LOADED = 0.1  # share of the mean load that counts as a load
_ONE_SIDED = 0.5  # most way under the opposite load, as a share of that under load
_AGREE = 0.5  # least share of the work, over all runs, that has the sign of the loading's
_PULSE = 0.3  # share of the mean force of a pulse above which it counts
_NOISE = 8.0  # least size of a pulse in standard deviations of the noise
_SMOOTHED = 30, 5  # least number of samples for a running median, and its width


def negative_channels(channels: Mapping[str, Array], time: Array | None) -> tuple[list[str], bool]:
    """Return the channels that are negative in compression, and whether the record proves it.

    The channels have the same rows, but any zero and unit. If force and motion contradict each
    other and the record does not show which of them is wrong, both are returned.
    """
    from scipy.ndimage import median_filter

    force, motion = (next((c for c in names if c in channels), "") for names in (FORCES, MOTIONS))
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
        other = force if channel in FORCES else motion
        if other and channel not in (other, "velocity"):
            opposite = np.dot(values - values.mean(), upright[other] - upright[other].mean()) < 0.0
            wrong += [channel] * bool(opposite)
    if time is not None and (velocity := upright.get("velocity")) is not None:
        if motion:  # whose derivative it is
            against = np.dot(np.gradient(upright[motion], time[kept]), velocity) < 0.0
        else:  # its integral rises first
            against = _falls(integrated_twice(time[kept], velocity)[0])
        wrong += ["velocity"] * bool(against)
    return wrong, True


def _signs(force: Array, motion: Array) -> tuple[int, int] | None:
    """Return the signs of force and motion in compression; None if one of them is uncertain.

    Consistent channels remain as they are unless they are negative on one side only.
    """
    ends = np.unique([0, *find_turns(motion), motion.size - 1]).tolist()
    runs = [_Run.of(force[i : j + 1], motion[i : j + 1]) for i, j in pairwise(ends)]
    most = max((abs(run.work) for run in runs), default=0.0)
    if most == 0.0:
        return 1, 1
    at, run = next((i, run) for i, run in enumerate(runs) if abs(run.work) >= _FIRST * most)
    same, towards = (1 if run.work > 0.0 else -1), run.towards
    sign = same * towards
    if sign > 0 and towards > 0:
        return 1, 1
    zero = min(sign * earlier.zero for earlier in runs[: at + 1])  # unloaded
    load, steps = sign * force - zero, np.abs(np.diff(motion, append=motion[-1]))
    work = float(np.dot(steps, np.maximum(load, 0.0)))
    # A mean weighted by the load itself does not depend on motion without load.
    mean = float(np.dot(steps, np.maximum(load, 0.0) ** 2)) / work if work else 0.0
    under, against = (float(steps[s * load > _LOADED * mean].sum()) for s in (1, -1))
    agree = same * sum(run.work for run in runs) >= _AGREE * sum(abs(run.work) for run in runs)
    if against < _ONE_SIDED * under and agree and zero + mean > 0.0:
        return sign, towards
    return (1, 1) if same > 0 else None


class _Run(NamedTuple):
    """A part of the record in which the motion does not turn.

    `zero` is the force of the unloaded specimen, `towards` the direction of the motion in
    compression, and the work is positive if force and motion have the same one.
    """

    zero: float
    towards: int
    work: float

    @classmethod
    def of(cls, force: Array, motion: Array) -> _Run:
        """Judge a run: it is a loading unless the force falls from its peak to zero."""
        ends = slice(_FEW), slice(-1, -_FEW - 1, -1)
        near = (np.abs(motion[e] - motion[e][0]) <= _NEAR * np.ptp(motion) for e in ends)
        start, end = (float(np.median(force[e][n])) for e, n in zip(ends, near, strict=True))
        way = int(np.sign(motion[-1] - motion[0]))
        work, other = (float(np.trapezoid(force - zero, motion)) for zero in (start, end))
        falls = abs(end) < _UNLOADED * abs(start) and abs(start) > 0.5 * float(np.abs(force).max())
        # A long way without load does no work from the level at that end.
        least = min(abs(work), abs(other))
        return cls(*((end, -way) if falls else (start, way)), math.copysign(least, work))


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
