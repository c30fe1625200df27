"""The noise of a channel, from its own samples: each is judged by its neighbours, not by a model.

No switch of a spring and no vibration is taken for noise where it is sampled finely.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement, NoiseLevel

MIN_REST = 20  # samples that show their own noise
# Widths of the local cubics (samples); the widest may cover a twelfth of the record.
_WIDTHS = (5, 7, 11, 17, 25, 37, 55, 83, 125)
_SHARE = 12
# Autocorrelations from one sample to the next that are tried, and the largest that is accepted: a
# slower noise cannot be distinguished from the signal.
_CORRELATIONS = np.linspace(0.0, 0.98, 99)
_SLOWEST = 0.95
# Scatter of the logarithms of the variances up to which they are those of one noise.
_AGREE = 0.12
# Residuals past this many deviations belong to switches, not to the noise.
_CUT = 3.0
_CUT_SHARE = 0.9733369246625415  # variance of a normal variable that is cut there


@cache
def _residual_filter(width: int) -> tuple[Array, Array]:
    """Weights of "sample minus local cubic", and their autocorrelation from lag 0 on."""
    cubic = np.vander(np.linspace(-1.0, 1.0, width), 4)
    weights = -(cubic @ np.linalg.pinv(cubic))[width // 2]
    weights[width // 2] += 1.0
    return weights, np.correlate(weights, weights, mode="full")[width - 1 :]


def robust_variance(residual: Array) -> float:
    """Variance of normal residuals among which some are not (cut at three deviations)."""
    scale = 1.4826 * float(np.median(np.abs(residual)))
    kept = residual[np.abs(residual) < _CUT * scale]
    return float(np.mean(kept**2)) / _CUT_SHARE if kept.size else 0.0


def quantum(values: Array) -> float:
    """Step of the digitiser of a channel: the smallest gap between its levels; 0 if it has none."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(float(np.ptp(values)), 1e-300)]
    # On a grid most gaps are the same few steps; a motion at one speed, to and fro, has them too,
    # but goes from sample to sample by the same step, where a digitiser changes it at every level.
    if not gaps.size or levels.size >= 0.7 * values.size:
        return 0.0
    step = float(gaps.min())
    changes = np.count_nonzero(np.abs(np.diff(np.abs(np.diff(values)))) > 0.3 * step)
    return step if changes > levels.size / 4 else 0.0


def residual_noise(values: Array) -> tuple[float, float]:
    """Noise of a sampled signal from the residuals of local cubic fits.

    Cubics over 5, 7, 11, … samples take off the signal; each leaves a known share of the variance
    of noise with the autocorrelation φ^k: c_0 + 2 Σ c_k φ^k, with c the autocorrelation of the
    filter. If the three narrowest agree with white noise, their variance is the answer, else σ and
    φ explain all widths best. Returns σ, at least that of the digitiser's step q, q/√12, and φ, 0
    for white noise and where a vibration or a noise slower than the signal hides it.
    """
    n = values.size
    digital = quantum(values) / np.sqrt(12.0)
    if n < 12:
        return digital, 0.0
    widths = [w for w in _WIDTHS if w <= max(11, n // _SHARE)]
    filters = [_residual_filter(w) for w in widths]
    variance = np.array([robust_variance(np.convolve(values, w, "valid")) for w, _ in filters])
    if variance.min() <= 0.0:
        return digital, 0.0
    powers = _CORRELATIONS[:, None] ** np.arange(1, max(widths))
    shares = np.array([c[0] + 2.0 * (powers[:, : c.size - 1] @ c[1:]) for _, c in filters])
    off = np.log(variance) - np.log(shares.T)  # (correlations, widths)
    narrow = off[:, :3]
    phi = _CORRELATIONS[int(np.argmin(np.var(narrow, axis=1)))]
    # The scatter of φ over records of white noise is about 1.5/√n.
    if phi < 4.5 / np.sqrt(n):
        return max(float(np.exp(0.5 * narrow[0, :2].mean())), digital), 0.0
    for used in range(len(widths), 2, -1):  # vibration and curvature show in the widest first
        scatter = np.std(off[:, :used], axis=1)
        best = int(np.argmin(scatter))
        if scatter[best] < _AGREE:
            break
    phi = _CORRELATIONS[best]
    if phi > _SLOWEST:  # what the widest cubic leaves is noise in any case
        return max(float(np.exp(0.5 * off[0, used - 1])), digital), 0.0
    sigma = max(float(np.exp(0.5 * off[best, :used].mean())), digital)
    return sigma, float(phi) if used == len(widths) else 0.0


def noise_level(values: Array) -> float:
    """Noise of a finely sampled signal, a standard deviation, from its second differences."""
    if len(values) < 4:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6))


def correlation_time(phi: float) -> float:
    """Autocorrelation time, in samples, of a noise with the autocorrelation φ^k."""
    return (1.0 + phi) / (1.0 - phi)


def estimated_noise(values: Array, what: str = "samples") -> NoiseLevel:
    """Noise of a channel by `residual_noise`."""
    sigma, phi = residual_noise(values)
    how = f"estimated from what local cubics leave of {values.size} {what}"
    return NoiseLevel(sigma, False, how, correlation_time(phi))


def noise_before_contact(
    whole: dict[str, Array], n: int, curves: dict[str, Array], block: int
) -> dict[str, NoiseLevel]:
    """Noise of channels from their `n` samples before contact, about a line or a cubic.

    The `curves` during contact, means of `block` samples, decide where their noise contradicts.
    """
    found = dict[str, NoiseLevel]()
    for name, values in ((c, v[:n]) for c, v in whole.items() if n >= MIN_REST):
        (sigma, time), bent = (_noise_about(values, degree) for degree in (1, 3))
        # The path of a machine that accelerates is curved; that is not correlated noise (BIC).
        if sigma > bent[0] * n ** (2.0 * bent[1] / n):
            sigma, time = bent
        how = f"estimated from {n} samples before contact"
        level = averaged(NoiseLevel(sigma, False, how, time), block)
        during = estimated_noise(curves[name])
        if 0.5 < level.sigma / max(during.sigma, 1e-300) < 4.0:
            found[name] = level
        elif min(sigma, during.sigma) > 0.0:
            word = "quieter" if level.sigma < during.sigma else "less quiet"
            found[name] = replace(during, how=f"{during.how}, the {n} before contact being {word}")
    return found


def _noise_about(values: Array, degree: int) -> tuple[float, float]:
    """Noise of samples about a polynomial: standard deviation and correlation time in samples."""
    x = np.linspace(-1.0, 1.0, values.size)
    off = values - np.polyval(np.polyfit(x, values, degree), x)
    return float(np.sqrt(off @ off / (off.size - degree - 1))), _time_shown(off)


def _time_shown(residual: Array) -> float:
    """Correlation time, in samples, if the residual shows a significant one, else 1."""
    phi = float(residual[1:] @ residual[:-1]) / max(float(residual @ residual), 1e-300)
    return correlation_time(phi) if 2 / np.sqrt(residual.size) < phi < 1 else 1.0


class Level(NamedTuple):
    """Value of a signal at one time, its standard error, and from how many samples it is."""

    value: float
    error: float
    samples: int

    def source(self, noise: NoiseLevel, shape: str) -> str:
        """Say its size over that of the noise, and what it was read off."""
        size = abs(self.value) / noise.sigma if noise.sigma > 0 else np.inf
        ratio = f"{size:.{0 if size >= 10 else 1}f} noise standard deviations; "
        return f"{ratio if np.isfinite(size) else ''}{shape} {self.samples} samples"


NOTHING = Level(0.0, 0.0, 0)


def mean_level(values: Array, noise: NoiseLevel) -> Level:
    """Level of a signal at rest: the mean of its samples; few of them do not show their noise."""
    n, sigma, time, zero = len(values), noise.sigma, noise.time, float(values.mean())
    if n >= MIN_REST:
        time = max(time, _time_shown(values - zero))
    if n >= MIN_REST * time:
        sigma = float(np.std(values, ddof=1))
    return Level(zero, sigma * float(np.sqrt(min(time, n) / n)), n)


def line_at(time: Array, values: Array, at: float) -> tuple[float, float]:
    """Value at the time `at`, and slope, of the straight line through the samples."""
    slope, level = np.polyfit(time - at, values, 1)
    return float(level), float(slope)


def level_on_line(time: Array, values: Array, at: float, noise: NoiseLevel) -> tuple[Level, Level]:
    """Level of a signal at a time, and its slope, by the line through the samples around it."""
    n, t = len(time), time - time.mean()
    spread = float(t @ t)
    level, slope = line_at(time, values, at)
    left = values - level - slope * (time - at)  # noise, or what is no straight line
    scatter = max(noise.sigma, float(np.sqrt(left @ left / max(n - 2, 1)))) * np.sqrt(noise.time)
    error = scatter * np.sqrt(1.0 / n + (at - time.mean()) ** 2 / spread)
    return Level(level, float(error), n), Level(slope, float(scatter / np.sqrt(spread)), n)


def smooth(values: Array, width: int) -> Array:
    """Take the moving mean over `width` samples, shape (n,)."""
    from scipy.ndimage import uniform_filter1d

    return values if width < 2 else np.asarray(uniform_filter1d(values, width, mode="nearest"))


def averaged(level: NoiseLevel, block: int) -> NoiseLevel:
    """Noise of the means of blocks of samples."""
    if block == 1:
        return level
    sigma = level.sigma * np.sqrt(min(level.time / block, 1.0))
    how = f"{level.how}, averaged in blocks of {block}"
    return replace(level, sigma=float(sigma), how=how, time=max(level.time / block, 1.0))


def with_noise(measurement: Measurement) -> Measurement:
    """Estimate the noise of the channels that have none; a test that has all stays as it is."""
    noise, taken = measurement.noise, measurement.sampled
    unknown = {c: v for c, v in measurement.channels().items() if noise.of(c) is None}
    found = {c: estimated_noise(v[taken.get(c, slice(None))]) for c, v in unknown.items()}
    if not found:
        return measurement
    return replace(measurement, noise=replace(noise, estimated=noise.estimated | found))
