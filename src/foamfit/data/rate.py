"""The rate of a test: its mean strain rate on loading."""

from __future__ import annotations

import math

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement

# Samples within so many standard deviations of the noise below the largest may be the peak.
SURE = 3.0
# The motion has come close to its peak at this share of it; one that takes longer from there than
# it took to get there is held.
CLOSE = 0.95
# Copies of a record with other noise that tell the error of its rate.
COPIES = 30
NORMAL = 0.6745  # median of the size of a normal deviate


def loading_rate(test: Measurement, fitted: Array | None = None) -> float | None:
    """Mean strain rate on loading, from contact to the largest strain, 1/s; None without time.

    The peak is in the middle of the samples that noise alone may keep from being the largest: on a
    flat top the largest one lies anywhere. Where the motion is held there, loading ends at the
    start of that. The displacement that was `fitted` (m), where the drive does not prescribe it,
    has no noise, and is taken instead of the measured one.
    """
    if test.time is None or test.displacement is None:
        return None
    time = test.time - test.time[0]
    if fitted is None:
        velocity = _with_noise(time, test.displacement, _sigma(test))
    else:
        velocity = _without_noise(time, fitted - fitted[0])
    return None if velocity is None else velocity / test.specimen.height


def rate_error(test: Measurement) -> float:
    """Standard error of the logarithm of the rate by the noise of the measured displacement.

    From the rates of `COPIES` of the record to which as much noise is added again. Noise that is
    estimated is no larger than the samples differ from a parabola through their neighbours.
    """
    if test.time is None or test.displacement is None or test.displacement.size < 5:
        return 0.0
    sigma = _sigma(test)
    scatter = sigma
    if test.noise.displacement is None:
        third = np.abs(np.diff(test.displacement, 3))
        scatter = min(sigma, float(np.median(third)) / (NORMAL * math.sqrt(20.0)))
    time, rng, rates = test.time - test.time[0], np.random.default_rng(0), list[float]()
    for _ in range(COPIES if scatter > 0.0 else 0):
        noisy = test.displacement + scatter * rng.standard_normal(time.size)
        if (rate := _with_noise(time, noisy, sigma)) is not None:
            rates.append(rate)
    return float(np.std(np.log(rates), ddof=1)) if len(rates) > 1 else 0.0


def _sigma(test: Measurement) -> float:
    """Standard deviation of the noise of the displacement, as far as it is known."""
    noise = test.noise.of("displacement")
    return 0.0 if noise is None else noise.sigma


def _with_noise(time: Array, motion: Array, sigma: float) -> float | None:
    """Mean velocity up to the peak of a measured motion; None where it does not go up."""
    motion = motion - motion[0]
    most = float(motion.max())
    if most <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    when = float(np.mean(time[motion >= most - SURE * sigma]))
    reached = float(time[np.argmax(motion >= CLOSE * most)]) / CLOSE
    if when > 2.0 * reached > 0.0:
        when = reached
    return most / when


def _without_noise(time: Array, motion: Array) -> float | None:
    """Mean velocity up to the peak of a smooth motion, which lies between samples."""
    if motion.max() <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    at = int(np.clip(np.argmax(motion), 1, motion.size - 2))
    near = slice(at - 1, at + 2)
    bend, slope, most = np.polyfit(time[near] - time[at], motion[near], 2)
    if bend >= 0.0:
        return float(motion[at] / time[at])
    apex = float(np.clip(-slope / (2.0 * bend), time[at - 1] - time[at], time[at + 1] - time[at]))
    return float((most + 0.5 * slope * apex) / (time[at] + apex))
