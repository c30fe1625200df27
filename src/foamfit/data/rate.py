"""The rate of a test: its mean strain rate on loading."""

from __future__ import annotations

import math

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement

# Samples within so many standard deviations of the noise below the largest may be the peak.
_SURE = 3.0
_CLOSE = 0.95  # of its peak: a motion that takes longer from there than to there is held
_COPIES, _NORMAL = 30, 0.6745  # copies with other noise; median of the size of a normal deviate


def loading_rate(test: Measurement, fitted: Array | None = None) -> float | None:
    """Mean strain rate on loading, from contact to the largest strain, 1/s; None without time.

    The peak is in the middle of the samples that noise alone may keep from being the largest, or at
    the start of a hold. A displacement that was `fitted` (m) has no noise and is taken instead.
    """
    if test.time is None or test.displacement is None:
        return None
    time = test.time - test.time[0]
    if fitted is None:
        velocity = _velocity(time, test.displacement, _sigma(test))
        return None if velocity is None else velocity / test.specimen.height
    motion, at = fitted - fitted[0], int(np.argmax(fitted))
    if motion[at] <= 0.0 or time[at] <= 0.0:
        return None
    # The peak of a smooth motion lies between samples.
    at = int(np.clip(at, 1, motion.size - 2))
    near = slice(at - 1, at + 2)
    t = time[near] - time[at]
    bend, slope, most = np.polyfit(t, motion[near], 2)
    apex = float(np.clip(-slope / (2.0 * bend), t[0], t[2])) if bend < 0.0 else 0.0
    return float((most + 0.5 * slope * apex) / (time[at] + apex)) / test.specimen.height


def rate_error(test: Measurement) -> float:
    """Standard error of the logarithm of the rate by the noise of the measured displacement.

    From the rates of copies of the record to which as much noise is added again. Noise that is
    estimated is no larger than the samples differ from a parabola through their neighbours.
    """
    w, sigma = test.displacement, _sigma(test)
    if test.time is None or w is None or w.size < 5 or sigma <= 0.0:
        return 0.0
    third = float(np.median(np.abs(np.diff(w, 3)))) / (_NORMAL * math.sqrt(20.0))
    scatter = min(sigma, third) if test.noise.displacement is None else sigma
    noise = scatter * np.random.default_rng(0).standard_normal((_COPIES, w.size))
    rates = [_velocity(test.time - test.time[0], w + one, sigma) for one in noise]
    known = [rate for rate in rates if rate is not None]
    return float(np.std(np.log(known), ddof=1)) if len(known) > 1 else 0.0


def _sigma(test: Measurement) -> float:
    noise = test.noise.of("displacement")
    return noise.sigma if noise else 0.0


def _velocity(time: Array, motion: Array, sigma: float) -> float | None:
    """Mean velocity up to the peak of a measured motion; None where it does not go up."""
    motion = motion - motion[0]
    most = float(motion.max())
    if most <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    when = float(np.mean(time[motion >= most - _SURE * sigma]))
    reached = float(time[np.argmax(motion >= _CLOSE * most)]) / _CLOSE
    return most / (reached if when > 2.0 * reached > 0.0 else when)
