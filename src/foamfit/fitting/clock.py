"""When curves are simulated, and the motion along which: what an objective takes of the clock."""

from __future__ import annotations

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.data.motion import SmoothMotion, follow

# Noise of a motion, over its range, that counts as none; most that a smooth motion may leave of the
# samples, over their noise.
EXACT, FOLLOWED = 1e-6, 1.5


def driving_motion(measurement: Measurement, time: Array) -> SmoothMotion | None:
    """The measured motion without its noise; None where its samples say all, or are not there.

    An exact motion that turns sharply between samples went further than they say. Where a noisy one
    leaves the samples more than their noise the machine's motion is not that smooth: the samples
    themselves are the better motion. `time` (n,) is that of the samples, s.
    """
    values, level = measurement.displacement, measurement.noise.of("displacement")
    if values is None or level is None:
        return None
    counts = measurement.sampled.get("displacement")
    found = follow(time, values, level, counts)
    if level.sigma <= EXACT * float(np.ptp(values)):
        beside = np.abs(found.turns[:, None] - time).min(axis=1, initial=np.inf)
        return found if np.any(beside > 1e-6 * float(np.median(np.diff(time)))) else None
    if measurement.block > 1 and found.turns.size:
        # The mean of rows on either side of a turn lies off the motion.
        gap = float(np.median(np.diff(time)))
        apart = np.abs(time[:, None] - found.turns).min(axis=1) > 0.75 * gap
        counts = apart if counts is None else counts & apart
        found = follow(time, values, level, counts)
    return found if found.sigma <= FOLLOWED * level.sigma else None


def later(time: Array, curves: Array, late: float) -> Array:
    """Curves (…, n) seen `late` seconds later, at the samples; straight past their ends."""
    when = time - late
    ahead, after = np.minimum(when - time[0], 0.0), np.maximum(when - time[-1], 0.0)
    first = (curves[..., 1] - curves[..., 0]) / (time[1] - time[0])
    last = (curves[..., -1] - curves[..., -2]) / (time[-1] - time[-2])
    rows = [np.interp(when, time, row) for row in np.atleast_2d(curves)]
    inside = np.reshape(rows, curves.shape)
    return np.asarray(inside + first[..., None] * ahead + last[..., None] * after)


def instants(time: Array, fine: int) -> Array:
    """Instants that each sample averages: so many, evenly spread over its share of the clock."""
    if fine == 1:
        return time
    gaps = np.diff(time)
    widths = np.minimum(np.append(gaps, gaps[-1]), np.append(gaps[0], gaps))
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    return np.asarray((time[:, None] + widths[:, None] * offsets).ravel())
