"""The contact time that the first rise of a channel leaves open, without a law of the springs.

For every trial time of contact, least squares fits a level before it and, from it on, a jump, a
slope, a parabola and a cubic, none of them negative. The probability of each trial time follows
from its sum of squares: a rise that begins softly leaves the contact open, a kink does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import NoiseLevel
from foamfit.data.noise import MIN_REST, noise_about, smooth

_SHARE, _CLEAR, _MOST = 0.05, 8.0, 0.5  # end of the first rise: share of the peak, or of the noise
_WINDOWS = 64  # moving means up to the peak, which show this level above the noise
_LOW = 0.25  # share of that level from which the duration of the rise is measured
_BEFORE, _ROWS_BEFORE = 6, 60  # rows before the rise: multiples of its duration, and more
_TRIALS, _ROWS = 80, 240  # trial times, and most rows (means of blocks)
_UNLIKELY = 1e-4  # trial times of less probability, relative to the best, are left out
_FREE = 0.02  # of the peak: standard deviation of the zero of a channel without a rest
_FEWEST = 8  # rows


class Rise(NamedTuple):
    """Contact time by the first rise, s (or sample number), and its standard error."""

    time: float
    error: float


def rise_of(
    time: Array, values: Array, noise: NoiseLevel, rest: int, zero: float | None
) -> Rise | None:
    """Estimate the contact time from the first rise of a channel; None with too few rows.

    Parameters
    ----------
    time, values : (n,) array
        s (or sample numbers) and the channel, positive in compression, zero taken off.
    noise : NoiseLevel
        Noise of the channel; the scatter at rest is used instead if it is larger.
    rest : int
        Number of rows before any contact.
    zero : float, optional
        Standard error of the zero; None if it was not measured.
    """
    top = int(np.argmax(values))
    up, sigma, tau = values[: top + 1], noise.sigma, noise.time
    base = float(up[:rest].mean()) if rest >= MIN_REST else float(np.percentile(up, 5.0))
    if rest >= MIN_REST and (scatter := noise_about(values[:rest], 1))[0] > sigma:
        sigma, tau = scatter
    size = float(up[-1]) - base
    width = 1 + up.size // _WINDOWS  # a soft start may be hidden by noise in single samples
    clear = _CLEAR * sigma * np.sqrt(min(tau / width, 1.0))
    level = min(max(_SHARE * size, clear), _MOST * size)
    part = _first_rise(smooth(up, width) - base, level)
    if part.stop - part.start < _FEWEST:
        return None
    rows = part.stop - part.start
    block = max(1, rows // _ROWS)
    part = slice(part.stop - rows // block * block, part.stop)
    t, y = (x[part].reshape(-1, block).mean(axis=1) for x in (time, values))
    white = sigma**2 * min(tau / block, 1.0)
    known = np.sqrt(white) / (_FREE * size if zero is None else max(zero, 1e-6 * size))

    def likely(trials: Array) -> Array:
        squares = np.array([_squares(t, y, trial, float(known)) for trial in trials])
        best = float(squares.min())
        variance = max(best / max(t.size - 4, 1), white, 1e-300) * max(tau / block, 1.0)
        return np.asarray(np.exp(-0.5 * (squares - best) / variance))

    early = 0.0 if part.start else 0.5  # the record may begin in contact
    trials = np.linspace(t[0] - early * (t[-1] - t[0]), t[-1], _TRIALS)
    near = np.flatnonzero(likely(trials) > _UNLIKELY)
    first, last = max(near[0] - 1, 0), min(near[-1] + 1, _TRIALS - 1)
    trials = np.linspace(trials[first], trials[last], _TRIALS)
    weights = likely(trials)
    mean = float(weights @ trials / weights.sum())
    grid, step = float(trials[1] - trials[0]), float(np.median(np.diff(time)))
    spread = weights @ (trials - mean) ** 2 / weights.sum() + (grid**2 + step**2) / 12.0
    return Rise(mean, float(np.sqrt(spread)))


def _first_rise(values: Array, level: float) -> slice:
    """Return the rows of the first rise up to a level, and as many before it as tell its start."""
    above = values > level
    three = above[:-2] & above[1:-1] & above[2:]
    high = int(np.argmax(three if three.any() else above))
    below = np.flatnonzero(values[: high + 1] < _LOW * level)
    low = int(below[-1]) if below.size else 0
    return slice(max(0, low - _BEFORE * max(high - low, 2) - _ROWS_BEFORE), high + 2)


def _squares(time: Array, values: Array, start: float, known: float) -> float:
    """Return the sum of squares about the best rise from `start`; `known` weighs a zero level."""
    from scipy.optimize import nnls

    x = np.maximum(time - start, 0.0) / (time[-1] - time[0])
    one = np.ones_like(time)
    columns = np.column_stack([one, -one, (time >= start).astype(float), x, x**2, x**3])
    columns = np.vstack([columns, [known, -known, 0.0, 0.0, 0.0, 0.0]])
    return float(nnls(columns, np.append(values, 0.0), maxiter=1000)[1] ** 2)
