"""Where contact starts: a start value for the fit of an impact, time zero of a slow test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import NoiseLevel, Record
from foamfit.data.noise import MIN_REST, level_on_line

# A signal rests where its slope is less than this share of the slope that follows: the branches of
# a foam differ less on loading (6 times in the published sets), so that a soft start is no rest.
# For an impact, whose fit refines the start, and for a motion a larger share will do.
STILL, _STILL_IMPACT, STILL_MOTION = 0.15, 0.3, 0.5
# Standard errors that are added to the slope of a rest; fewer where the motion of an impact begins
# elsewhere than at zero, so that the record may begin before contact.
_ERRORS, _ERRORS_AWAY = 2.0, 1.0
# Share of the peak by which the rest of an impact may drift: without a motion, where the motion
# begins at its zero (a stress that rises then is no rest), and where it begins elsewhere. There a
# rest that drifts more is taken if there is no other.
_DRIFT, _DRIFT_AT_ZERO, _DRIFT_AWAY = 0.01, 0.002, 0.06
_APPROACH = 0.02  # share of its travel beyond which a machine without a stress is not in contact
_BRAKED = 0.02  # share of the peak of a derived stress at which contact starts
# Shares of the peak up to which a rise is taken for straight: the least that is so many standard
# deviations of the noise, or else the largest.
_SHARES, _CLEAR, _LARGEST = (0.025, 0.05, 0.1, 0.2), 8.0, 0.5
ELSEWHERE = 5.0  # standard errors of a motion whose zero lies elsewhere

Levels = dict[str, NoiseLevel]
Kink = tuple[float, float]  # where a signal starts to rise: time and standard error, s


@dataclass(frozen=True)
class Start:
    """Where contact starts: at a `time` of the file, s, at or before its sample `first`.

    `error` is the standard error of that time; `how` says in words what shows it, `by` which
    channel: "stress", "motion", or "file" where nothing was recorded before contact. If `free`, the
    specimen was unloaded before. `gauge` is the motion before contact: "rest", "flight" (at the
    velocity that it goes on with), "other", or "" where none was recorded.
    """

    how: str
    time: float
    first: int
    error: float = 0.0
    by: str = "file"
    free: bool = False
    gauge: str = ""

    @property
    def resting(self) -> int:
        """Number of rows that certainly show the specimen without load."""
        return max(0, self.first - 2) if self.free else 0


def _kink(time: Array, values: Array, noise: NoiseLevel) -> Kink | None:
    """Time from which a signal rises as a straight line; None if it rises from the first sample on.

    Least squares on a grid of times, then on a finer one.
    """
    block = 1 + len(time) // 500  # their means show it as well
    rows = len(time) // block
    if rows < 6:
        return None
    t, y = (x[-rows * block :].reshape(rows, block).mean(axis=1) for x in (time, values))
    y = y - y.mean()

    def misfit(starts: Array) -> Array:
        ramps = np.maximum(0.0, (t - starts[:, None]) / (t[-1] - t[0]))
        ramps -= ramps.mean(axis=1, keepdims=True)
        size = np.maximum(np.sum(ramps**2, axis=1), 1e-300)
        return np.asarray(y @ y - np.maximum(ramps @ y, 0.0) ** 2 / size)

    coarse = np.linspace(t[0], t[-2], 200)
    off = misfit(coarse)
    at = int(np.argmin(off))
    fine = np.linspace(coarse[max(at - 2, 0)], coarse[min(at + 2, 199)], 41)
    near = misfit(fine)
    best = float(near.min())
    white = noise.sigma**2 * min(noise.time / block, 1.0)
    variance = max(best / rows, 0.25 * white) * max(noise.time / block, 1.0)
    if off[0] <= best + 9 * variance + 1e-9 * float(y @ y):
        return None
    alike = int(np.count_nonzero(off <= best + variance))
    error = 0.5 * max(float(alike) - 1.0, 0.5) * float(coarse[1] - coarse[0])
    return float(fine[int(np.argmin(near))]), error


def _reached(values: Array, share: float) -> tuple[int, int]:
    """First of three samples in a row above a share of the rise; samples from a third of it on."""
    up = values[: int(np.argmax(values)) + 1]
    base = float(np.percentile(up, 5))
    level = (up - base) / ((up[-1] - base) or 1.0)
    above = level > share
    three = above[:-2] & above[1:-1] & above[2:]
    high = int(np.argmax(three if three.any() else above))
    return high, 1 + int(np.argmin(level[high::-1] > share / 3.0))


def _onset(time: Array, values: Array, noise: NoiseLevel) -> Kink | None:
    """Where a signal starts to rise, by the least part of its rise that stands out of its noise."""
    clear, size = _CLEAR * noise.sigma, float(np.ptp(values[: int(np.argmax(values)) + 1]))
    for share in [s for s in _SHARES if s * size >= clear] or [_LARGEST] * bool(size >= clear):
        high, lasts = _reached(values, share)
        part = slice(max(0, high - 4 * max(lasts, 3) - 8), high + 1)
        if found := _kink(time[part], values[part], noise):
            return found
    return None


def leave_rest(
    time: Array,
    values: Array,
    noise: NoiseLevel,
    still: float = STILL,
    drift: float = np.inf,
    errors: float = _ERRORS,
) -> Kink | None:
    """Where a signal leaves its rest, or None if the record shows no rest before the rise.

    A line is extrapolated back from the first part of the rise. At rest the slope is surely less
    than a share `still` of the mean slope that follows, up to 15 % of the peak, and the signal does
    not change significantly by more than `drift`. A kink within a rise is passed over.
    """
    rows = len(time)
    while rows >= 10 and (found := _onset(time[:rows], values[:rows], noise)):
        at, t, y = found[0], time[:rows], values[:rows]
        n = int(np.searchsorted(time, at))
        if n < max(3 * noise.time, 5) or n >= rows:
            return None
        own = n >= MIN_REST * noise.time  # else they do not show their own noise
        slope = level_on_line(t[:n], y[:n], at, replace(noise, sigma=0.0) if own else noise)
        size, error, rest = abs(slope[1].value), slope[1].error, float(y[:n].mean())
        high = _reached(y, 0.15)[0]
        high = high if t[high] > at else int(np.argmax(y))
        after = float(y[high : high + 3].mean() - rest) / (t[high] - at)
        changed = (size - _ERRORS * error) * (t[n - 1] - t[0])
        if size + errors * error < still * after and changed <= drift:
            return found
        rows = n
    return None


def _at_kink(channel: str, time: Array, at: Kink, by: str, what: str = "rest") -> Start:
    how = f"where the {channel} leaves its {what}"
    return Start(how, at[0], int(np.searchsorted(time, at[0])), at[1], by, free=True)


def _first_motion(time: Array, w: Array, noise: NoiseLevel) -> tuple[float, bool]:
    """First value of a motion, by a line through its rise, and whether it is clearly not zero."""
    top = int(np.argmax(w))
    early = slice(0, max(5, top // 12))
    first = level_on_line(time[early], w[early], time[0], noise)[0]
    least = max(ELSEWHERE * first.error, 0.02 * (float(w[top]) - first.value))
    return first.value, top >= 5 and abs(first.value) > least  # fewer show no zero


def start_of_impact(record: Record, levels: Levels) -> Start:
    """Estimate where an impact starts: where the stress or the motion leaves its rest.

    Without a force, contact starts where the flight is braked. Without a rest, the first part of
    the rise is extrapolated back to zero, by a few samples at most, unless the first sample is a
    step or two after the file's time zero.
    """
    time, stress, w = record.instants, record.stress, record.displacement
    drift, at, elsewhere = _DRIFT, None, False
    if w is not None:
        elsewhere = _first_motion(time, w, levels["displacement"])[1]
        drift = _DRIFT_AWAY if elsewhere else _DRIFT_AT_ZERO
    if "stress" not in record.derived:
        errors = _ERRORS_AWAY if elsewhere else _ERRORS
        leaves = partial(leave_rest, time, stress, levels["stress"], _STILL_IMPACT, errors=errors)
        at = leaves(drift * float(np.ptp(stress))) or (leaves() if elsewhere else None)
    start = _at_kink("stress", time, at, "stress") if at else _first_sample(record, levels)
    if w is None:
        return start
    noise, up = levels["displacement"], slice(int(np.argmax(w)) + 1)
    if at := leave_rest(time[up], w[up], noise, STILL_MOTION):
        # Far from the onset of the stress, something other than contact has moved the gauge.
        alike = abs(at[0] - start.time) < 0.1 * (time[up][-1] - start.time)
        if not start.free or (at[1] < start.error and alike):
            start = _at_kink("displacement", time, at, "motion")
    elif "stress" in record.derived and elsewhere:  # it brakes a motion followed in flight
        below = np.flatnonzero(stress[: int(np.argmax(stress))] < _BRAKED * stress.max())
        last = int(below[-1]) if below.size else 0
        at = float(time[last]), _BRAKED * float(np.ptp(time))
        start = _at_kink("displacement", time, at, "motion", "line") if last else start
    return start


def _at_first(time: Array) -> Start:
    """Start of a file that starts in contact: its time zero if that is two steps before at most."""
    first = 0.0 if 0 <= time[0] <= 2 * (time[1] - time[0]) else float(time[0])
    return Start("at the first sample", first, 0)


def _first_sample(record: Record, levels: Levels) -> Start:
    """Start of an impact whose record begins in contact or at it."""
    time, stress, start = record.instants, record.stress, _at_first(record.instants)
    early = slice(0, max(5, _reached(stress, 0.2)[0]))
    level, slope = level_on_line(time[early], stress[early], time[0], levels["stress"])
    back = level.value / slope.value if slope.value > 0 else 0.0
    most = max(8 * (time[1] - time[0]), 0.15 * (time[np.argmax(stress)] - time[0]))
    if start.time == time[0] != 0 and back < most and level.value > _ERRORS * level.error:
        how = "before the first sample, where the rise leads back to zero"
        return Start(how, start.time - back, 0)
    return start


def start_of_slow_test(record: Record, levels: Levels) -> Start:
    """Start where the motion leaves a rest, or the stress does later, or the motion passes zero."""
    time, w, stress = record.instants, record.displacement, record.stress
    first, elsewhere, peak = 0.0, False, float(stress.max())
    if w is not None:
        first, elsewhere = _first_motion(time, w, levels["displacement"])
    at = leave_rest(time, stress, levels["stress"], drift=np.inf if elsewhere else 0.01 * peak)
    start = _at_kink("stress", time, at, "stress") if at else None
    if w is None:
        return start or _at_first(time)
    top, onset = int(np.argmax(w)), start.first if start else 0
    if start and float(w[onset]) - first > _APPROACH * float(w[top] - w[onset]):
        return replace(start, gauge="flight")
    if at := leave_rest(time[: top + 1], w[: top + 1], levels["displacement"]):
        return replace(_at_kink("displacement", time, at, "motion"), gauge="rest")
    crossing = int(np.argmax(w >= 0.0))
    if elsewhere and first < 0.0 < w[top] and stress[crossing] < 0.2 * peak:
        how = "where the displacement passes zero"
        return Start(how, float(time[crossing]), crossing, by="motion", gauge="other")
    return _at_first(time)
