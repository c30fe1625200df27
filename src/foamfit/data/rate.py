"""The rate of a test: its mean strain rate on loading."""

from __future__ import annotations

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement

# Samples within so many standard deviations of the noise below the largest may be the peak.
SURE = 3.0
# The motion has come close to its peak at this share of it; one that takes longer from there than
# it took to get there is held.
CLOSE = 0.95


def loading_rate(test: Measurement, fitted: Array | None = None) -> float | None:
    """Mean strain rate on loading, from contact to the largest strain, 1/s; None without time.

    The peak is in the middle of the samples that noise alone may keep from being the largest: on a
    flat top the largest one lies anywhere. Where the motion is held there, loading ends at the
    start of that. The displacement that was `fitted` (m), where the drive does not prescribe it,
    has no noise, and is taken instead of the measured one.
    """
    if test.time is None or test.displacement is None:
        return None
    motion = test.displacement if fitted is None else fitted
    time, motion = test.time - test.time[0], motion - motion[0]
    most = float(motion.max())
    if most <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    if fitted is not None:
        return _without_noise(time, motion) / test.specimen.height
    noise = test.noise.of("displacement")
    high = motion >= most - SURE * (0.0 if noise is None else noise.sigma)
    when = float(np.mean(time[high]))
    reached = float(time[np.argmax(motion >= CLOSE * most)]) / CLOSE
    if when > 2.0 * reached > 0.0:
        when = reached
    return most / test.specimen.height / when


def _without_noise(time: Array, motion: Array) -> float:
    """Mean velocity up to the peak of a smooth motion, which lies between samples."""
    at = int(np.clip(np.argmax(motion), 1, motion.size - 2))
    near = slice(at - 1, at + 2)
    bend, slope, most = np.polyfit(time[near] - time[at], motion[near], 2)
    if bend >= 0.0:
        return float(motion[at] / time[at])
    apex = float(np.clip(-slope / (2.0 * bend), time[at - 1] - time[at], time[at + 1] - time[at]))
    return float((most + 0.5 * slope * apex) / (time[at] + apex))
