"""The noise of a channel, read off its own samples, and the samples that are plainly wrong.

Nothing here knows the model: a sample is judged by its neighbours alone, so that no switch of a
spring and no ringing is taken for noise where it is sampled well enough to be seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import Array, Measurement, NoiseLevel

# Widths of the local cubics (samples); the widest may cover a twelfth of the record.
_WIDTHS = (5, 7, 11, 17, 25, 37, 55, 83, 125)
_SHARE = 12
# Autocorrelations from one sample to the next that are tried, and the largest that is believed: a
# slower noise cannot be told from the signal.
_CORRELATIONS = np.linspace(0.0, 0.98, 99)
_SLOWEST = 0.95
# Scatter of the logarithms of the variances up to which they are those of one noise.
_AGREE = 0.12
# Residuals past this many deviations belong to switches, not to the noise.
_CUT = 3.0
_CUT_SHARE = 0.9733369246625415  # variance of a normal variable that is cut there
# An outlier is off by this many standard deviations of its leave-one-out residual, and by this
# many of what its neighbours are off when it is gone (at a kink they are off too).
_OFF, _ALONE = 4.0, 2.5
# A gap is entered and left by a jump so many times the median one of the samples nearby.
_JUMP, _NEARBY, _MAX_RUN = 10.0, 31, 5
# Weights of three samples in the line's next one, and where they are: left and right of the fifth.
_WIDTH, _HALF = 9, 4  # samples of a cubic, and on either side of its middle
_ONWARD, _SIDES = np.array([-2.0, 1.0, 4.0]) / 3.0, ([1, 2, 3], [7, 6, 5])
# Samples count as even if their steps differ by this share at most; a pause is so many times the
# usual step; a middle sample is judged if its neighbours hold so much of the cubic.
_EVEN, _PAUSE, _OPEN = 0.02, 6.0, 0.1
_CHUNK = 50_000
_LEAST = 5e-3  # of the range: what is less far off is let be
_MOST = 0.02  # of the samples: if more stand out, they are no exceptions


# ------------------------------------------------------------------------------------- the noise


@cache
def _residual_filter(width: int) -> tuple[Array, Array]:
    """Weights of "sample minus local cubic", and their autocorrelation from lag 0 on."""
    cubic = np.vander(np.linspace(-1.0, 1.0, width), 4)
    weights = -(cubic @ np.linalg.pinv(cubic))[width // 2]
    weights[width // 2] += 1.0
    return weights, np.correlate(weights, weights, mode="full")[width - 1 :]


def _robust_variance(residual: Array) -> float:
    """Variance of normal residuals among which some are not (cut at three deviations)."""
    scale = 1.4826 * float(np.median(np.abs(residual)))
    kept = residual[np.abs(residual) < _CUT * scale]
    return float(np.mean(kept**2)) / _CUT_SHARE if kept.size else 0.0


def quantum(values: Array) -> float:
    """Step of the digitiser of a channel: the smallest gap between its levels; 0 if it has none.

    Parameters
    ----------
    values : (n,) array
        The channel.
    """
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(float(np.ptp(values)), 1e-300)]
    # On a grid most gaps are the same few steps.
    return float(gaps.min()) if gaps.size and levels.size < 0.7 * values.size else 0.0


def residual_noise(values: Array) -> tuple[float, float]:
    """Noise of a sampled signal from what local cubics leave of it.

    Cubics over 5, 7, 11, … samples take off the signal; of the variance of what is left each shows
    a known share, which depends on how the noise follows itself: for an autocorrelation φ^k it is
    c_0 + 2 Σ c_k φ^k, with c the autocorrelation of the filter. If the three narrowest widths agree
    with white noise, their variance is the answer. Else σ and φ are those that explain all widths
    best. Switches and spikes are cut from the residuals at three deviations.

    Parameters
    ----------
    values : (n,) array
        Evenly sampled.

    Returns
    -------
    sigma : float
        Standard deviation, in the unit of the values; at least that of the digitiser's step q,
        q/√12.
    phi : float
        Autocorrelation from one sample to the next; 0 for white noise, and where ringing or a noise
        slower than the signal hides it.
    """
    n = values.size
    digital = quantum(values) / np.sqrt(12.0)
    if n < 12:
        return digital, 0.0
    widths = [w for w in _WIDTHS if w <= max(11, n // _SHARE)]
    filters = [_residual_filter(w) for w in widths]
    variance = np.array([_robust_variance(np.convolve(values, w, "valid")) for w, _ in filters])
    if variance.min() <= 0.0:
        return digital, 0.0
    powers = _CORRELATIONS[:, None, None] ** np.arange(1, max(widths))[None, None, :]
    shares = np.array(
        [c[0] + 2.0 * (powers[:, 0, : c.size - 1] @ c[1:]) for _, c in filters]
    ).T  # (correlations, widths)
    off = np.log(variance) - np.log(shares)
    narrow = off[:, :3]
    phi = _CORRELATIONS[int(np.argmin(np.var(narrow, axis=1)))]
    # The scatter of φ over records of white noise is about 1.5/√n.
    if phi < 4.5 / np.sqrt(n):
        return max(float(np.exp(0.5 * narrow[0, :2].mean())), digital), 0.0
    for used in range(len(widths), 2, -1):  # ringing and curvature show in the widest first
        scatter = np.std(off[:, :used], axis=1)
        best = int(np.argmin(scatter))
        if scatter[best] < _AGREE:
            break
    phi = _CORRELATIONS[best]
    if phi > _SLOWEST:  # what the widest cubic leaves is noise in any case
        return max(float(np.exp(0.5 * off[0, used - 1])), digital), 0.0
    sigma = max(float(np.exp(0.5 * off[best, :used].mean())), digital)
    return sigma, float(phi) if used == len(widths) else 0.0


def with_noise(measurement: Measurement) -> Measurement:
    """Complete the noise of a test: what is neither stated nor known is estimated from the samples.

    Parameters
    ----------
    measurement : Measurement
        The test; one whose channels all have their noise is returned as it is.
    """
    levels = dict(measurement.noise.estimated)
    for channel, values in measurement.channels().items():
        if measurement.noise.of(channel) is None:
            sigma, phi = residual_noise(values)
            how = f"estimated from what local cubics leave of {values.size} samples"
            levels[channel] = NoiseLevel(sigma, False, how, (1.0 + phi) / (1.0 - phi))
    if levels == measurement.noise.estimated:
        return measurement
    return replace(measurement, noise=replace(measurement.noise, estimated=levels))


# ---------------------------------------------------------------------------------- the outliers


def find_outliers(values: Array, clock: Array | None = None) -> NDArray[np.bool_]:
    """Isolated samples that no smooth signal with this noise can hold: spikes and gaps.

    First the jumps into and out of gaps of up to five samples are looked for (dropped to zero,
    saturated): ten times the median jump nearby, to and fro. Then each sample is predicted by the
    cubic through its eight neighbours: it is an outlier if it is off by four standard deviations of
    that prediction, as seen over the whole record, while the neighbours agree among themselves and
    the lines from either side do not lead to it. Where the signal bends they do one or the other.

    Parameters
    ----------
    values : (n,) array
        The channel. In one that is held for some samples at a time only gaps are looked for: the
        steps have no even spacing.
    clock : (n,) array, optional
        Time of each sample, increasing; without it they are evenly spaced. Cubics and lines go by
        the true spacing, and nothing is judged across a pause in the record.

    Returns
    -------
    (n,) array of bool
        True at an outlier. Never more than 2 % of the samples: then none, they are no exceptions.
    """
    n = values.size
    if n < 30:
        return np.zeros(n, dtype=bool)
    least = _LEAST * float(np.ptp(np.quantile(values, (0.005, 0.995))))
    clock = None if clock is None or _is_even(clock, values, least) else clock
    times = None if clock is None else _Times.of(clock)
    wrong = _gaps(values, clock)
    for _ in range(4):  # what a big spike hides
        smooth = bridged(values, wrong, clock)
        if is_staircase(smooth):
            break
        found = _spikes(smooth, least, times) & ~wrong
        if not found.any():
            break
        wrong |= found
    return wrong if wrong.sum() <= max(_MOST * n, 2) else np.zeros(n, dtype=bool)


def _is_even(clock: Array, values: Array, least: float) -> bool:
    """Whether the steps of a clock are the same, or as near as makes no difference to the values.

    Time stamps are rounded; what the signal does in the time that a step is off is far less than
    what counts as an outlier then.
    """
    step = np.diff(clock)
    usual = float(np.median(step))
    off = float(np.abs(step - usual).max()) / usual
    return off <= _EVEN or off * float(np.quantile(np.abs(np.diff(values)), 0.99)) < 0.1 * least


def is_staircase(values: Array) -> bool:
    """Whether most samples repeat the one before, as where a channel is held."""
    fresh = np.append(0, np.flatnonzero(np.diff(values) != 0.0) + 1)
    return bool(np.median(np.diff(np.append(fresh, values.size))) >= 2)


def bridged(values: Array, wrong: NDArray[np.bool_], clock: Array | None = None) -> Array:
    """Put the straight line between the samples around them in the place of some."""
    at = np.arange(values.size) if clock is None else clock
    return np.where(wrong, np.interp(at, at[~wrong], values[~wrong]), values)


def _gaps(values: Array, clock: Array | None = None) -> NDArray[np.bool_]:
    """Short runs into which the signal jumps and out of which it jumps back.

    In a step of the clock that is longer than usual the signal itself may go farther.
    """
    from scipy.ndimage import median_filter

    out = np.zeros(values.size, dtype=bool)
    jump = np.diff(values)
    usual = np.abs(jump)
    if clock is not None:
        step = np.diff(clock)
        usual = usual / np.maximum(step / median_filter(step, _NEARBY), 1.0)
    floor = float(np.median(usual[usual > 0.0])) if usual.any() else 0.0
    high = np.flatnonzero(usual > _JUMP * np.maximum(median_filter(usual, _NEARBY), floor))
    for start, end in ((i, j) for i in high for j in high[(high > i) & (high <= i + _MAX_RUN)]):
        there, back = jump[start], jump[end]
        left = abs(values[end + 1] - values[start])  # what the signal itself has changed
        if there * back < 0.0 and left < 0.5 * min(abs(there), abs(back)):
            out[start + 1 : end + 1] = True
    return out


def _spikes(values: Array, least: float, times: _Times | None = None) -> NDArray[np.bool_]:
    """Samples that the cubic through their eight neighbours does not expect."""
    out = np.zeros(values.size, dtype=bool)
    windows = np.lib.stride_tricks.sliding_window_view(values, _WIDTH)
    if times is None:
        cubic = np.vander(np.arange(-_HALF, _HALF + 1) / _HALF, 4)
        project = np.eye(_WIDTH) - cubic @ np.linalg.pinv(cubic)  # what a cubic leaves
        open_ = np.full(len(windows), project[_HALF, _HALF])
        residual = np.convolve(values, project[_HALF], "valid")
    else:
        open_, residual = times.open_, times.residual(values)
    off = np.abs(residual) / open_
    usual = np.sqrt(_robust_variance(residual / np.sqrt(open_)) / open_)
    far = np.flatnonzero(off > np.maximum(_OFF * usual, least))
    if times is None:
        left = windows[far] @ project
        onward = [np.broadcast_to(_ONWARD, (far.size, 3))] * 2
    else:
        clock = np.lib.stride_tricks.sliding_window_view(times.clock, _WIDTH)[far]
        basis = _cubics(clock.T)
        shares = np.einsum("ksw,ws->kw", basis, windows[far])
        left = windows[far] - np.einsum("kw,ksw->ws", shares, basis)
        onward = [_line_to_middle(clock, at) for at in _SIDES]
    rest = np.sum(left**2, axis=1) - residual[far] ** 2 / open_[far]
    alone = np.sqrt(np.maximum(rest, 0.0) / (_WIDTH - 5) / open_[far])
    # Beside a spike the cubic is off too: only the farthest of five is one.
    nearby = np.lib.stride_tricks.sliding_window_view(np.pad(off, 2), 5).max(axis=1)
    # The tip of a kink is where the line from one of its sides leads.
    leads = [
        np.sum(windows[far][:, at] * weights, axis=1)
        for at, weights in zip(_SIDES, onward, strict=True)
    ]
    beside = np.min((windows[far, _HALF] - np.array(leads)) * np.sign(residual[far]), axis=0)
    out[far + _HALF] = (
        (off[far] > _ALONE * alone) & (off[far] >= nearby[far]) & (beside > 0.5 * off[far])
    )
    return out


@dataclass(frozen=True, eq=False)
class _Times:
    """Cubics over nine samples at uneven times, for every sample with four on either side.

    `weights` (samples of a window, windows) are those of "sample minus cubic"; the share `open_` of
    a sample in it is its own weight. They are zero and one where nothing is judged: across a pause,
    and where the middle sample alone holds the cubic.
    """

    clock: Array
    weights: Array
    open_: Array

    @classmethod
    def of(cls, clock: Array) -> _Times:
        """Prepare a clock; in parts, for all cubics at once would take much memory."""
        n = clock.size - _WIDTH + 1
        weights = np.empty((_WIDTH, n))
        windows = np.lib.stride_tricks.sliding_window_view(clock, _WIDTH)
        for first in range(0, n, _CHUNK):
            basis = _cubics(windows[first : first + _CHUNK].T)
            weights[:, first : first + _CHUNK] = -np.einsum("kw,ksw->sw", basis[:, _HALF], basis)
        weights[_HALF] += 1.0
        step = np.diff(clock)
        steps = np.lib.stride_tricks.sliding_window_view(step, _WIDTH - 1)
        pause = steps.max(axis=1) > _PAUSE * float(np.median(step))
        unjudged = pause | (weights[_HALF] < _OPEN)
        weights[:, unjudged] = 0.0
        return cls(clock, weights, np.where(unjudged, 1.0, weights[_HALF]))

    def residual(self, values: Array) -> Array:
        """What the cubics leave of the middle samples."""
        n = self.open_.size
        left = np.zeros(n)
        for i, weights in enumerate(self.weights):
            left += weights * values[i : i + n]
        return left


def _cubics(times: Array) -> Array:
    """Orthonormal cubics over times (samples, windows), shape (4, samples, windows)."""
    x = times - times[_HALF]
    x = x / np.abs(x).max(axis=0)
    basis = np.empty((4, *x.shape))
    for k in range(4):
        new = x**k
        for lower in basis[:k]:
            new = new - np.einsum("sw,sw->w", new, lower) * lower
        basis[k] = new / np.sqrt(np.einsum("sw,sw->w", new, new))
    return basis


def _line_to_middle(times: Array, at: list[int]) -> Array:
    """Weights of three samples of each window in the value of their line in its middle."""
    x = times[:, at] - times[:, [_HALF]]
    centre = x.mean(axis=1, keepdims=True)
    x = x - centre
    return np.asarray(1.0 / 3.0 - centre * x / np.sum(x**2, axis=1, keepdims=True))
