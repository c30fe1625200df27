"""Mean strain rate of a test on loading."""

from __future__ import annotations

import math

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement

_SURE = 3.0  # samples within this many standard deviations below the largest may be the peak
_CLOSE = 0.95  # share of the peak; a motion is held if it takes longer from there than up to there
_COPIES = 30  # number of copies with additional noise
_NORMAL = 0.6745  # median magnitude of a standard normal variable


def loading_rate(test: Measurement, fitted: Array | None = None) -> float | None:
    """Return the mean strain rate from contact to the largest strain, 1/s; None without a time.

    The peak is the middle of the samples that may be the largest in view of the noise, or the start
    of a hold. If given, the `fitted` displacement (m) is used instead; it has no noise.
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
    """Return the standard error of the logarithm of the rate due to noise of the displacement.

    It is the scatter over copies of the record with added noise of the same size. Estimated noise
    is limited to the deviation of samples from a parabola through their neighbours.
    """
    w, sigma = test.displacement, _sigma(test)
    if test.time is None or w is None or w.size < 5 or sigma <= 0.0:
        return 0.0
    third = float(np.median(np.abs(np.diff(w, 3)))) / (_NORMAL * math.sqrt(20.0))
    scatter = min(sigma, third) if test.noise.displacement is None else sigma
    noise = scatter * np.random.default_rng(0).standard_normal((_COPIES, w.size))
    copies = [_velocity(test.time - test.time[0], w + added, sigma) for added in noise]
    rates = [rate for rate in copies if rate is not None]
    return float(np.std(np.log(rates), ddof=1)) if len(rates) > 1 else 0.0


def _sigma(test: Measurement) -> float:
    noise = test.noise.of("displacement")
    return noise.sigma if noise else 0.0


def _velocity(time: Array, motion: Array, sigma: float) -> float | None:
    """Return the mean velocity up to the peak of a measured motion; None if it never rises."""
    motion = motion - motion[0]
    most = float(motion.max())
    if most <= 0.0 or time[np.argmax(motion)] <= 0.0:
        return None
    when = float(np.mean(time[motion >= most - _SURE * sigma]))
    reached = float(time[np.argmax(motion >= _CLOSE * most)]) / _CLOSE
    return most / (reached if when > 2.0 * reached > 0.0 else when)
