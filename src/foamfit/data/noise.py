"""Estimate the noise of a channel from its samples, without a model of the test.

Switches of a spring and vibrations are not mistaken for noise if they are sampled finely.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement, NoiseLevel

MIN_REST = 20  # least number of samples for an estimate of their noise
_WIDTHS = (5, 7, 11, 17, 25, 37, 55, 83, 125)  # of the local cubics, in samples
EXACT = 1e-6  # noise of a channel, as a share of its range, below which it is exact
TENSION = 0.02  # of the peak stress: the least that a specimen must bear to count as glued
_SHARE = 12  # the widest cubic covers at most this fraction of the record, 1/12
_CORRELATIONS = np.linspace(0.0, 0.98, 99)  # trial values of the lag-1 autocorrelation
_SLOWEST = 0.95  # noise with a larger autocorrelation cannot be distinguished from the signal
_AGREE = 0.12  # largest scatter of the log variances of one noise over the widths
_CUT = 3.0  # residuals beyond this many standard deviations belong to switches, not to the noise
_CUT_SHARE = 0.9733369246625415  # variance of a standard normal variable truncated there


@cache
def residual_filter(width: int) -> tuple[Array, Array]:
    """Return the weights of "sample minus local cubic", and their autocorrelation."""
    cubic = np.vander(np.linspace(-1.0, 1.0, width), 4)
    weights = -(cubic @ np.linalg.pinv(cubic))[width // 2]
    weights[width // 2] += 1.0
    return weights, np.correlate(weights, weights, mode="full")[width - 1 :]


def robust_variance(residual: Array) -> float:
    """Return the variance of normal residuals with outliers, truncated at 3 deviations."""
    scale = 1.4826 * float(np.median(np.abs(residual)))
    kept = residual[np.abs(residual) < _CUT * scale]
    return float(np.mean(kept**2)) / _CUT_SHARE if kept.size else 0.0


def quantum(values: Array) -> float:
    """Return the step of the digitiser: the smallest gap between levels; 0 if not digitised."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * float(np.ptp(values))]
    # Digitised values have few levels. So has a motion to and fro at constant speed, but its steps
    # from sample to sample are all equal, while those of a digitised signal vary.
    if not gaps.size or levels.size >= 0.7 * values.size:
        return 0.0
    step = float(gaps.min())
    changes = np.count_nonzero(np.abs(np.diff(np.abs(np.diff(values)))) > 0.3 * step)
    return step if changes > levels.size / 4 else 0.0


def residual_noise(values: Array) -> tuple[float, float]:
    """Estimate the noise of a sampled signal from the residuals of local cubic fits.

    Cubics over 5, 7, 11, … samples remove the signal. The residuals retain a known share of the
    variance of noise with autocorrelation φ^k: c_0 + 2 Σ c_k φ^k, with c the autocorrelation of the
    filter. If the three narrowest fits are consistent with white noise, σ is theirs; otherwise σ
    and φ are fitted to all widths. Return σ, at least q/√12 for a digitiser step q, and φ, which is
    0 for white noise and if a vibration or noise slower than the signal makes φ unknown.
    """
    n = values.size
    digital = quantum(values) / np.sqrt(12.0)
    if n < 12:
        return digital, 0.0
    widths = [w for w in _WIDTHS if w <= max(11, n // _SHARE)]
    filters = [residual_filter(w) for w in widths]
    variance = np.array([robust_variance(np.convolve(values, w, "valid")) for w, _ in filters])
    if variance.min() <= 0.0:
        return digital, 0.0
    powers = _CORRELATIONS[:, None] ** np.arange(1, max(widths))
    shares = np.array([c[0] + 2.0 * (powers[:, : c.size - 1] @ c[1:]) for _, c in filters])
    level = np.log(variance) - np.log(shares.T)  # ln σ², (correlations, widths)
    narrow = level[:, :3]
    phi = _CORRELATIONS[int(np.argmin(np.var(narrow, axis=1)))]
    # Over records of white noise, the standard deviation of φ is about 1.5/√n.
    if phi < 4.5 / np.sqrt(n):
        return max(float(np.exp(0.5 * narrow[0, :2].mean())), digital), 0.0
    for used in range(len(widths), 2, -1):  # vibration and curvature affect wide cubics first
        scatter = np.std(level[:, :used], axis=1)
        best = int(np.argmin(scatter))
        if scatter[best] < _AGREE:
            break
    phi = _CORRELATIONS[best]
    if phi > _SLOWEST:  # the residuals of the widest cubic are still noise
        return max(float(np.exp(0.5 * level[0, used - 1])), digital), 0.0
    sigma = max(float(np.exp(0.5 * level[best, :used].mean())), digital)
    return sigma, float(phi) if used == len(widths) else 0.0


def noise_level(values: Array) -> float:
    """Return the noise (standard deviation) of a finely sampled signal from second differences."""
    if len(values) < 4:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6))


def correlation_time(phi: float) -> float:
    """Return the autocorrelation time, in samples, of noise with autocorrelation φ^k."""
    return (1.0 + phi) / (1.0 - phi)


def estimated_noise(values: Array, what: str = "samples") -> NoiseLevel:
    """Estimate the noise of a channel with `residual_noise`."""
    sigma, phi = residual_noise(values)
    how = f"estimated from the residuals of local cubic fits to {values.size} {what}"
    return NoiseLevel(sigma, False, how, correlation_time(phi))


def noise_of_integral(time: Array, values: Array) -> NoiseLevel:
    """Return the noise of the integral of a signal, shape (n,): that of a random walk.

    It is the RMS over the record; such noise is correlated over all of it.
    """
    level, n, step = estimated_noise(values), values.size, float(np.median(np.diff(time)))
    sigma = level.sigma * step * float(np.sqrt(0.5 * n * level.time))
    return NoiseLevel(sigma, False, f"of an integral, {level.how}", float(n))


def noise_before_contact(
    whole: dict[str, Array], n: int, curves: dict[str, Array], block: int
) -> dict[str, NoiseLevel]:
    """Estimate the noise of channels from their `n` samples before contact.

    A line or a cubic is subtracted. If the result contradicts the noise of the `curves` during
    contact, which are means of `block` samples, the latter is used.
    """
    levels = dict[str, NoiseLevel]()
    for name, values in ((c, v[:n]) for c, v in whole.items() if n >= MIN_REST):
        (sigma, time), bent = (noise_about(values, degree) for degree in (1, 3))
        # The path of an accelerating machine is curved, not correlated noise; BIC decides.
        if sigma > bent[0] * n ** (2.0 * bent[1] / n):
            sigma, time = bent
        how = f"estimated from {n} samples before contact"
        level = averaged(NoiseLevel(sigma, False, how, time), block)
        during = estimated_noise(curves[name])
        if 0.5 < level.sigma / max(during.sigma, 1e-300) < 4.0:
            levels[name] = level
        elif min(sigma, during.sigma) > 0.0:
            word = "quieter" if level.sigma < during.sigma else "noisier"
            levels[name] = replace(during, how=f"{during.how}; the {n} before contact are {word}")
    return levels


def noise_about(values: Array, degree: int) -> tuple[float, float]:
    """Return standard deviation and correlation time (samples) of noise about a polynomial."""
    x = np.linspace(-1.0, 1.0, values.size)
    residual = values - np.polyval(np.polyfit(x, values, degree), x)
    variance = residual @ residual / (residual.size - degree - 1)
    return float(np.sqrt(variance)), residual_time(residual)


def residual_time(residual: Array) -> float:
    """Return the correlation time, in samples, of residuals if it is significant, else 1."""
    phi = float(residual[1:] @ residual[:-1]) / max(float(residual @ residual), 1e-300)
    return correlation_time(phi) if 2 / np.sqrt(residual.size) < phi < 1 else 1.0


class Level(NamedTuple):
    """Value of a signal at one time, its standard error, and the number of samples used."""

    value: float
    error: float
    samples: int


NOTHING = Level(0.0, 0.0, 0)


def mean_level(values: Array, noise: NoiseLevel) -> Level:
    """Return the mean of a signal at rest; `noise` applies if the samples are too few."""
    n, sigma, time, zero = len(values), noise.sigma, noise.time, float(values.mean())
    if n >= MIN_REST:
        time = max(time, residual_time(values - zero))
    if n >= MIN_REST * time:
        sigma = float(np.std(values, ddof=1))
    return Level(zero, sigma * float(np.sqrt(min(time, n) / n)), n)


def polynomial_at(
    time: Array, values: Array, at: float, noise: NoiseLevel, degree: int = 1
) -> list[Level]:
    """Return the coefficients, at a time, of a polynomial through samples: value, slope, …"""
    n, t = len(time), time - at
    found, variance = np.polyfit(t, values, degree, cov="unscaled")
    left = values - np.polyval(found, t)  # includes what the polynomial does not follow
    scatter = max(noise.sigma, float(np.sqrt(left @ left / max(n - degree - 1, 1))))
    errors = scatter * np.sqrt(noise.time * np.diag(variance))
    pairs = zip(found[::-1].tolist(), errors[::-1].tolist(), strict=True)
    return [Level(value, error, n) for value, error in pairs]


def integrated_twice(time: Array, rate: Array) -> tuple[Array, Array]:
    """Return first and second integral of a rate that is linear between samples, shape (n,)."""
    dt = np.diff(time)
    first = np.append(0.0, np.cumsum(0.5 * dt * (rate[1:] + rate[:-1])))
    steps = first[:-1] * dt + dt**2 * (2.0 * rate[:-1] + rate[1:]) / 6.0
    return first, np.append(0.0, np.cumsum(steps))


def smooth(values: Array, width: int) -> Array:
    """Return the moving mean over `width` samples, shape (n,)."""
    from scipy.ndimage import uniform_filter1d

    return values if width < 2 else np.asarray(uniform_filter1d(values, width, mode="nearest"))


def lowest_mean(stress: Array, first: int) -> tuple[float, int]:
    """Return the lowest moving mean of a stress from a sample on, and the number of its samples."""
    width = max(1, stress.size // 100)
    return float(smooth(stress, width)[first:].min()), width


def averaged(level: NoiseLevel, block: int) -> NoiseLevel:
    """Return the noise of the means of blocks of samples."""
    if block == 1:
        return level
    sigma = level.sigma * np.sqrt(min(level.time / block, 1.0))
    how = f"{level.how}, averaged in blocks of {block}"
    return replace(level, sigma=float(sigma), how=how, time=max(level.time / block, 1.0))


def with_noise(measurement: Measurement) -> Measurement:
    """Estimate the noise of the channels without a known noise."""
    noise, taken = measurement.noise, measurement.sampled
    unknown = {c: v for c, v in measurement.channels().items() if noise.of(c) is None}
    new = {c: estimated_noise(v[taken.get(c, slice(None))]) for c, v in unknown.items()}
    if not new:
        return measurement
    return replace(measurement, noise=replace(noise, estimated=noise.estimated | new))
