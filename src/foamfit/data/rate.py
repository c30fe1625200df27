"""The rate of a test: its mean strain rate on loading."""

from __future__ import annotations

import numpy as np

from foamfit.data.measurement import Measurement

# Samples within so many standard deviations of the noise below the largest may be the peak.
SURE = 3.0
# The motion has come close to its peak at this share of it; one that takes longer from there than
# it took to get there is held.
CLOSE = 0.95


def loading_rate(test: Measurement) -> float | None:
    """Mean strain rate on loading, from contact to the largest strain, 1/s; None without time.

    The peak is in the middle of the samples that noise alone may keep from being the largest: on a
    flat top the largest one lies anywhere. Where the motion is held there, loading ends at the
    start of that.
    """
    if test.time is None or test.displacement is None:
        return None
    time, motion = test.time - test.time[0], test.displacement - test.displacement[0]
    most = float(motion.max())
    if most <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    noise = test.noise.of("displacement")
    high = motion >= most - SURE * (0.0 if noise is None else noise.sigma)
    when = float(np.mean(time[high]))
    reached = float(time[np.argmax(motion >= CLOSE * most)]) / CLOSE
    if when > 2.0 * reached > 0.0:
        when = reached
    return most / test.specimen.height / when
