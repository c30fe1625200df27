"""Where a signal leaves its rest, and at which level it is: the tools that find contact.

A newcomer may skip this module.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import MIN_ROWS, NoiseLevel
from foamfit.data.noise import correlation_time, lag_one, noise_level

# A rest has as many independent samples, and the slope of a signal on it is less than this share of
# the slope that follows: the branches of a foam on loading differ less in stiffness (6 times in the
# published sets), so that a soft start is no rest.
LEAST_REST, STILL = 5, 0.15
MIN_REST = 20  # samples that show their own noise
ERRORS = 3.0  # standard errors that decide whether a signal rises or rests


def smooth(values: Array, width: int) -> Array:
    """Take the moving mean over `width` samples, shape (n,)."""
    from scipy.ndimage import uniform_filter1d

    return values if width < 2 else np.asarray(uniform_filter1d(values, width, mode="nearest"))


def line_at(time: Array, values: Array, at: float) -> tuple[float, float]:
    """Value at the time `at`, and slope, of the straight line through the samples."""
    slope, level = np.polyfit(time - at, values, 1)
    return float(level), float(slope)


def _rise(values: Array, share: float) -> int:
    """First of three samples in a row above a share of the way from the lowest level to the top."""
    before_peak = values[: int(np.argmax(values)) + 1]
    base = float(np.percentile(before_peak, 5))
    above = before_peak > base + share * (before_peak[-1] - base)
    run = above[:-2] & above[1:-1] & above[2:]
    return int(np.argmax(run)) if run.any() else int(np.argmax(above))


def leave_rest(
    time: Array, values: Array, noise: NoiseLevel, still: float = STILL, drift: float = np.inf
) -> float | None:
    """Time at which a signal leaves its rest, or None if none is shown before it rises.

    Before it the slope is less than a share `still` of the slope that follows, and the signal does
    not significantly change by more than `drift`. A kink within a rise is passed over for an
    earlier one.
    """
    at = _kink(time, values, noise)
    if at is None:
        return None
    before = slopes(time, values, at, noise)
    if before.upper < still and before.drift <= drift:
        return at
    rows = int(np.searchsorted(time, at))
    if not MIN_ROWS <= rows < len(time):
        return None
    return leave_rest(time[:rows], values[:rows], noise, still, drift)


class Slopes(NamedTuple):
    """Slope of a signal before a time over its mean slope after it, up to 15 % of the peak.

    The bounds are three standard errors away, infinite where samples are too few or too noisy;
    `upper` is that of the slope's size. `drift` is the least change of the signal before that time.
    """

    lower: float = -np.inf
    upper: float = np.inf
    drift: float = 0.0


def slopes(time: Array, values: Array, at: float, noise: NoiseLevel) -> Slopes:
    """Compare the slopes of a signal before and after a time."""
    n = int(np.searchsorted(time, at))
    high = _rise(values, 0.15)
    high = high if time[high] > at else int(np.argmax(values))
    if n < max(LEAST_REST * noise.time, 3) or time[high] <= at:
        return Slopes()
    t, rest = time[:n] - time[:n].mean(), values[:n]
    slope = float(t @ rest) / float(t @ t)
    scatter = float(np.sqrt(np.sum((rest - rest.mean() - slope * t) ** 2) / (n - 2)))
    if n < MIN_REST * noise.time:  # too few to show their own noise
        scatter = max(scatter, noise.sigma)
    error = ERRORS * scatter * np.sqrt(noise.time / float(t @ t))
    top = values[high : high + 3]
    doubt = ERRORS * noise.sigma * np.sqrt(1.0 / len(top) + noise.time / n)
    rise, lasts = float(top.mean() - rest.mean()), float(time[high] - at)
    drift = max(0.0, abs(slope) - error) * float(np.ptp(t))
    if rise <= doubt:
        return Slopes(drift=drift)
    upper = (abs(slope) + error) * lasts / (rise - doubt)
    return Slopes((slope - error) * lasts / rise, upper, drift)


def _kink(time: Array, values: Array, noise: NoiseLevel) -> float | None:
    """Time at which a signal seems to start to rise, None if it may do so from its first sample.

    A rest followed by a straight or a quadratic rise is fitted to the samples up to 15 % of the
    peak by least squares.
    """
    high, low = _rise(values, 0.15), _rise(values, 0.05)
    first = max(0, high - 4 * max(high - low, 3) - 8)
    part = slice(first, high + 1, max(1, (high - first) // 1000))
    t, y = time[part], values[part]
    if len(t) < 5:
        return None
    starts = np.linspace(t[0], t[-2], 400)
    straight, curved = _rise_misfit(t, y, starts, 1), _rise_misfit(t, y, starts, 2)
    # The curve must fit clearly better: where noise hides the shape, the line is the safer guess.
    variance = min(noise.sigma**2, min(straight.min(), curved.min()) / len(t))
    slow = 9 * noise.time * variance  # three standard errors of noise with its correlation
    less = max(9 / len(t) * straight.min(), slow)
    misfit = curved if curved.min() < straight.min() - less else straight
    best = int(np.argmin(misfit))
    if first == 0:
        # Would a rise from the very first sample do nearly as well?
        more = max(9 / len(t) * misfit[best], slow)
        if misfit[0] <= misfit[best] + more + 1e-9 * np.var(y):
            return None
        # A curved start looks like a rest, but rises.
        rest = t < starts[best]
        if rest.sum() < 3:
            return None
        if (time[high] - starts[best]) * 2 > starts[best] - t[0]:
            rise = line_at(t[rest], y[rest], 0.0)[1] * np.ptp(t[rest])
            doubt = 4 * noise_level(values) * np.sqrt(12 / rest.sum())
            if abs(rise) > max(doubt, 2e-3 * np.ptp(values)):
                return None
    return float(starts[best])


def _rise_misfit(t: Array, y: Array, starts: Array, power: int) -> Array:
    """Squared misfit of rest + factor · (t − start)^power, at its best, for each start."""
    ramps = np.maximum(0.0, (t - starts[:, None]) / (t[-1] - t[0])) ** power
    ramps -= ramps.mean(axis=1, keepdims=True)
    centred = y - y.mean()
    misfit: Array = (centred**2).sum() - (ramps @ centred) ** 2 / (ramps**2).sum(axis=1)
    return misfit


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

    @property
    def significance(self) -> float:
        """Size over standard error."""
        if self.error > 0:
            return abs(self.value) / self.error
        return np.inf if self.value else 0.0


def resting_level(values: Array, noise: NoiseLevel) -> Level:
    """Level of a signal at rest: the median of its samples, whose error is 1.25 of the mean's."""
    n = len(values)
    error = 1.25 * float(np.std(values)) * np.sqrt(min(noise.time, n) / n)
    return Level(float(np.median(values)), error, n)


def level_on_line(time: Array, values: Array, at: float, noise: NoiseLevel) -> Level:
    """Level of a signal at a time, by the straight line through samples around or after it."""
    n, t = len(time), time - time.mean()
    away = float((at - time.mean()) ** 2 / (t @ t))
    level, slope = line_at(time, values, at)
    left = values - level - slope * (time - at)  # noise, or what is no straight line
    scatter = max(noise.sigma, float(np.sqrt(left @ left / (n - 2))))
    error = scatter * np.sqrt(noise.time * (1.0 / n + away))
    return Level(level, float(error), n)


def level_by_balance(time: Array, w: Array, stress: Array) -> Level:
    """Level of a motion at its first sample, by the striker's balance of momentum.

    w = w0 + v t - c ∬σ is fitted by least squares; the error is that of its correlated residuals.
    """
    from scipy.integrate import cumulative_trapezoid

    t = time - time[0]
    braked = cumulative_trapezoid(cumulative_trapezoid(stress, t, initial=0), t, initial=0)
    columns = np.column_stack([np.ones(t.size), t, braked])
    columns /= np.sqrt((columns**2).sum(axis=0))
    inverse = np.linalg.pinv(columns)
    level = inverse @ w
    left = w - columns @ level
    phi = float(np.clip(lag_one(left), 0.0, 0.99))
    variance = float(left @ left) / max(t.size - 3, 1) * correlation_time(phi)
    error = np.sqrt(variance * float(inverse[0] @ inverse[0]))
    return Level(float(level[0]) * columns[0, 0], float(error) * columns[0, 0], t.size)
