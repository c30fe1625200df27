"""Find the start of contact: a start value for an impact, time zero for a slow test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import NoiseLevel, Record
from foamfit.data.noise import MIN_REST, noise_about, polynomial_at, smooth

# A signal is at rest if its slope is less than this share of the slope that follows. The slopes of
# the loading branches differ by a smaller factor (6 in the published sets), so a soft start is not
# mistaken for rest. The limit is larger for a motion, and for an impact, whose fit refines it.
STILL, _STILL_IMPACT, STILL_MOTION = 0.15, 0.3, 0.5
# Largest deviation of a rest from its line, as a share of the range of a stress or a motion. A hold
# after a step or a preload deviates more.
_WANDERS, _MOTION_WANDERS = 0.01, 0.025
_STRAIGHT = 0.005  # RMS deviation of a motion from a line, as a share of its range
_LINE = 5  # smallest number of rows for a line
_ERRORS = 2.0  # standard errors added to the slope at rest
# Largest drift of an impact's stress at rest, as a share of the peak: without a motion; if the
# motion starts at zero (a rising stress is then contact); and if it starts away from zero, unless
# there is no other rest.
_DRIFT, _DRIFT_AT_ZERO, _DRIFT_AWAY = 0.01, 0.002, 0.06
_APPROACH = 0.02  # share of its travel beyond which a machine without load is not in contact
_AGAIN = 0.1  # share of the peak above which a stress shows a contact
_BRAKED = 0.02  # share of the peak of a derived stress at which contact starts
_SHARES = 0.025, 0.05, 0.1, 0.2  # shares of the peak up to which a rise is taken as straight
_CLEAR = 8.0  # the smallest share of at least this many standard deviations of noise is used
_LARGEST = 0.5  # else this share
ELSEWHERE = 5.0  # standard errors of a displacement that is significantly not zero
_RISE_SHARE = 0.05  # least share of the peak at which the first rise ends
_WINDOWS = 64  # moving means up to the peak, which show this level above the noise
_LATER = 3.0  # standard errors by which a motion leaves its rest after the stress
_LOW = 0.25  # share of that level from which the duration of the rise is measured
_BEFORE, _ROWS_BEFORE = 6, 60  # rows before the rise: multiples of its duration, and more
_TRIALS, _ROWS = 80, 240  # trial times, and most rows (means of blocks)
_UNLIKELY = 1e-4  # trial times of less probability, relative to the best, are left out
_FREE = 0.02  # of the peak: standard deviation of the zero of a channel without a rest
_RISE_FEWEST = 8  # rows

Levels = dict[str, NoiseLevel]
Kink = tuple[float, float]  # where a signal starts to rise: time and standard error, s


@dataclass(frozen=True)
class Start:
    """Start of contact: at a `time` of the file, s, at or before its sample `first`.

    `error` is the standard error of that time; `how` describes in words how it was found, and `by`
    is the channel: "stress", "motion", or "file" if nothing was recorded before contact. If `free`,
    the specimen was unloaded before. `gauge` is the motion before contact: "rest", "flight" (at the
    initial velocity of contact), "other", or "" if not recorded; the striker comes into its range
    at the sample `seen`.
    """

    how: str
    time: float
    first: int
    error: float = 0.0
    by: str = "file"
    free: bool = False
    gauge: str = ""
    seen: int = 0

    @property
    def resting(self) -> int:
        """Number of initial rows in which the specimen is certainly unloaded."""
        return max(0, self.first - 2) if self.free else 0


def misfits_of_rises(x: Array, y: Array, starts: Array, *, centred: bool) -> Array:
    """Return the squares that remain of y about the best straight rise from each start.

    Before the start, y is zero, or at any level if it is `centred`.
    """
    rises = np.maximum(0.0, x - starts[:, None])
    rises -= rises.mean(axis=1, keepdims=True) if centred else 0.0
    size = np.maximum(np.sum(rises**2, axis=1), 1e-300)
    return np.asarray(y @ y - np.maximum(rises @ y, 0.0) ** 2 / size)


def _kink(time: Array, values: Array, noise: NoiseLevel) -> Kink | None:
    """Find the time from which a signal rises linearly; None if it rises from the first sample.

    Least squares over a grid of times, then over a finer grid.
    """
    block = 1 + len(time) // 500  # means of blocks are accurate enough
    rows = len(time) // block
    if rows < 6:
        return None
    t, y = (x[-rows * block :].reshape(rows, block).mean(axis=1) for x in (time, values))
    y = y - y.mean()
    coarse = np.linspace(t[0], t[-2], 200)
    misfits = misfits_of_rises(t, y, coarse, centred=True)
    at = int(np.argmin(misfits))
    fine = np.linspace(coarse[max(at - 2, 0)], coarse[min(at + 2, 199)], 41)
    near = misfits_of_rises(t, y, fine, centred=True)
    best = float(near.min())
    white = noise.sigma**2 * min(noise.time / block, 1.0)
    variance = max(best / rows, 0.25 * white) * max(noise.time / block, 1.0)
    if misfits[0] <= best + 9 * variance + 1e-9 * float(y @ y):
        return None
    alike = int(np.count_nonzero(misfits <= best + variance))
    error = 0.5 * max(float(alike) - 1.0, 0.5) * float(coarse[1] - coarse[0])
    return float(fine[int(np.argmin(near))]), error


def _first_above(values: Array, level: float) -> int:
    """Return the first of three samples above a level, or else the first one."""
    above = values > level
    three = above[:-2] & above[1:-1] & above[2:]
    return int(np.argmax(three if three.any() else above))


def _reached(values: Array, share: float) -> tuple[int, int]:
    """Return the first of three samples above a share of the rise, and samples since a third."""
    up = values[: int(np.argmax(values)) + 1]
    base = float(np.percentile(up, 5))
    level = (up - base) / ((up[-1] - base) or 1.0)
    high = _first_above(level, share)
    return high, 1 + int(np.argmin(level[high::-1] > share / 3.0))


def _onset(time: Array, values: Array, noise: NoiseLevel) -> Kink | None:
    """Find where a signal starts to rise, from the smallest part of the rise above the noise."""
    clear, size = _CLEAR * noise.sigma, float(np.ptp(values[: int(np.argmax(values)) + 1]))
    for share in [s for s in _SHARES if s * size >= clear] or [_LARGEST] * bool(size >= clear):
        high, lasts = _reached(values, share)
        part = slice(max(0, high - 4 * max(lasts, 3) - 8), high + 1)
        if found := _kink(time[part], values[part], noise):
            return found
    return None


def leave_rest(
    time: Array, values: Array, noise: NoiseLevel,
    still: float = STILL, drift: float = np.inf, wanders: float = np.inf,
) -> Kink | None:  # fmt: skip
    """Find where a signal leaves its rest; None if there is no rest before the rise.

    A line is extrapolated back from the first part of the rise. At rest the slope, plus two
    standard errors, is less than a share `still` of the mean slope up to 15 % of the peak, and the
    signal does not change significantly by more than `drift`, nor leave a line by more than the
    share `wanders` of its range. A kink within a rise is skipped.
    """
    rows = len(time)
    while rows >= 10 and (found := _onset(time[:rows], values[:rows], noise)):
        at, t, y = found[0], time[:rows], values[:rows]
        n = int(np.searchsorted(time, at))
        if n < max(3 * noise.time, 5) or n >= rows:
            return None
        enough = n >= MIN_REST * noise.time  # to estimate the noise from these samples
        slope = polynomial_at(t[:n], y[:n], at, replace(noise, sigma=0.0) if enough else noise)
        size, error, rest = abs(slope[1].value), slope[1].error, float(y[:n].mean())
        high = _reached(y, 0.15)[0]
        high = high if t[high] > at else int(np.argmax(y))
        after = float(y[high : high + 3].mean() - rest) / (t[high] - at)
        changed = (size - _ERRORS * error) * (t[n - 1] - t[0])
        off = smooth(y[:n] - rest - slope[1].value * (t[:n] - t[:n].mean()), 1 + n // 100)
        steady = np.abs(off).max() <= max(wanders * np.ptp(y), 5.0 * noise.sigma)
        if steady and size + _ERRORS * error < still * after and changed <= drift:
            return found
        rows = n
    return None


def _at_kink(channel: str, time: Array, at: Kink, by: str, what: str = "rest") -> Start:
    how = f"where the {channel} leaves its {what}"
    return Start(how, at[0], int(np.searchsorted(time, at[0])), at[1], by, free=True)


def straight(time: Array, w: Array, first: int, rows: int, noise: NoiseLevel) -> int:
    """Return the number of rows, at most `rows`, in which a motion follows a straight line."""
    most = max(3.0 * noise.sigma, _STRAIGHT * float(np.ptp(w)))
    while rows > _LINE:
        t, y = time[first : first + rows] - time[first], w[first : first + rows]
        if np.std(y - np.polyval(np.polyfit(t, y, 1), t)) <= most:
            break
        rows = max(_LINE, rows // 2)
    return rows


def _first_motion(time: Array, w: Array, noise: NoiseLevel) -> tuple[float, bool]:
    """Return the initial value of a motion, from a line, and whether it is clearly not zero."""
    top = int(np.argmax(w))
    early = slice(0, straight(time, w, 0, max(_LINE, top // 12), noise))
    first = polynomial_at(time[early], w[early], time[0], noise)[0]
    least = max(ELSEWHERE * first.error, 0.02 * (float(w[top]) - first.value))
    return first.value, top >= 5 and abs(first.value) > least  # not with fewer samples


def first_contact(record: Record) -> Record:
    """Leave out further contacts of a striker that rebounds and comes back.

    The first contact has at least half of the largest stress and half of the impulse of any that
    follows; a flight lasts longer than twice the longest contact.
    """
    stress, free = smooth(record.stress, 3), float(np.median(record.stress))
    share = (stress - free) / max(float(stress.max()) - free, 1e-300)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], share > _AGAIN, [False]))))
    begins, ends = edges[::2], edges[1::2]
    if not begins.size:
        return record
    flights = begins[1:] - ends[:-1] > 2 * (ends - begins).max()
    impulses = np.add.reduceat(share.clip(0.0), begins)
    for i in np.flatnonzero(flights):
        before, after = impulses[: i + 1].sum(), impulses[i + 1 :].max()
        if share[: ends[i]].max() >= 0.5 and before >= 0.5 * after:
            why = "after the first contact, as the striker comes back"
            note = "The striker comes back after its rebound; only the first contact is used."
            return record.without(slice((ends[i] + begins[i + 1]) // 2, None), why).noted(note)
    return record


def start_of_impact(record: Record, levels: Levels, *, late: bool = False) -> Start:
    """Estimate the start of an impact: stress or motion leaves its rest.

    A motion that may be `late` is used only if the stress has no rest. Without a force, contact
    starts where the flight decelerates. Without a rest, the first part of the rise is extrapolated
    back to zero, by a few samples at most, unless the file's time zero is at most two steps before
    the first sample.
    """
    time, stress, w = record.instants, record.stress, record.displacement
    drift, at, elsewhere = _DRIFT, None, False
    if w is not None:
        elsewhere = _first_motion(time, w, levels["displacement"])[1]
        drift = _DRIFT_AWAY if elsewhere else _DRIFT_AT_ZERO
    if "stress" not in record.derived:
        leaves = partial(leave_rest, time, stress, levels["stress"], _STILL_IMPACT)
        at = leaves(drift * float(np.ptp(stress))) or (leaves() if elsewhere else None)
    start = _at_kink("stress", time, at, "stress") if at else _first_sample(record, levels)
    flies = elsewhere if w is not None else record.velocity is not None
    if late and start.free:
        return start
    if w is not None and (at := motion_leaves_rest(record, levels)):
        up = slice(int(np.argmax(w)) + 1)
        # A motion that starts far from the onset of the stress is not due to contact.
        alike = abs(at[0] - start.time) < 0.1 * (time[up][-1] - start.time)
        if not start.free or (at[1] < start.error and alike):
            start = _at_kink("displacement", time, at, "motion")
        elif not alike and at[0] < start.time:
            start = replace(start, seen=int(np.searchsorted(time, at[0])))
    elif "stress" in record.derived and flies:  # the motion was recorded in flight
        below = np.flatnonzero(stress[: int(np.argmax(stress))] < _BRAKED * stress.max())
        last = int(below[-1]) if below.size else 0
        at = float(time[last]), _BRAKED * float(np.ptp(time))
        channel = "displacement" if w is not None else "velocity"
        start = _at_kink(channel, time, at, "motion", "line") if last else start
    return start


def motion_leaves_rest(record: Record, levels: Levels) -> Kink | None:
    """Find where the motion of an impact leaves its rest; None if it has none."""
    w = record.curves()["displacement"]
    up = slice(int(np.argmax(w)) + 1)
    return leave_rest(record.instants[up], w[up], levels["displacement"], STILL_MOTION)


def _at_first(time: Array) -> Start:
    """Return the start for a file that begins in contact: its time zero if that is close."""
    first = 0.0 if 0 <= time[0] <= 2 * (time[1] - time[0]) else float(time[0])
    return Start("at the first sample", first, 0)


def _first_sample(record: Record, levels: Levels) -> Start:
    """Return the start of an impact whose record begins during or at contact."""
    time, stress, start = record.instants, record.stress, _at_first(record.instants)
    early = slice(0, max(5, _reached(stress, 0.2)[0]))
    level, slope = polynomial_at(time[early], stress[early], time[0], levels["stress"])
    back = level.value / slope.value if slope.value > 0 else 0.0
    most = max(8 * (time[1] - time[0]), 0.15 * (time[np.argmax(stress)] - time[0]))
    if start.time == time[0] != 0 and back < most and level.value > _ERRORS * level.error:
        how = "before the first sample, where the rise extrapolates to zero"
        return Start(how, start.time - back, 0)
    return start


def start_of_slow_test(record: Record, levels: Levels) -> Start:
    """Return the start of a slow test: motion or stress leaves its rest, or motion is zero."""
    time, w, stress = record.instants, record.displacement, record.stress
    first, elsewhere, peak = 0.0, False, float(stress.max())
    if w is not None:
        first, elsewhere = _first_motion(time, w, levels["displacement"])
    drift = np.inf if elsewhere else 0.01 * peak
    at = leave_rest(time, stress, levels["stress"], drift=drift, wanders=_WANDERS)
    start = _at_kink("stress", time, at, "stress") if at else None
    if w is None:
        return start or _at_first(time)
    top = int(np.argmax(w))
    if start and w[start.first] - first > _APPROACH * float(w[top] - w[start.first]):
        return replace(start, gauge="flight")
    up, noise = slice(top + 1), levels["displacement"]
    if at := leave_rest(time[up], w[up], noise, wanders=_MOTION_WANDERS):
        # Where a stress drives a foam with a dashpot, the motion follows it later.
        later = start and start.time + _LATER * float(np.hypot(start.error, at[1])) < at[0]
        if start and later and _has_risen(time, stress, start.first, at[0], levels["stress"]):
            return replace(start, gauge="rest")
        return replace(_at_kink("displacement", time, at, "motion"), gauge="rest")
    return _at_first(time)


def _has_risen(time: Array, stress: Array, first: int, end: float, noise: NoiseLevel) -> bool:
    """Return whether the stress has left its rest between a sample and an instant."""
    rows, rest = stress[first : int(np.searchsorted(time, end))], stress[:first]
    if not (rows.size and rest.size):
        return False
    error = noise.sigma * np.sqrt(noise.time * (1.0 / rows.size + 1.0 / rest.size))
    return bool(rows.mean() - rest.mean() > _CLEAR * error)


def rise_of(
    time: Array, values: Array, noise: NoiseLevel, rest: int, zero: float | None
) -> Kink | None:
    """Estimate the contact time from the first rise of a channel; None with too few rows.

    For every trial time of contact, least squares fits a level before it and, from it on, a jump, a
    slope, a parabola and a cubic, none of them negative. The probability of each trial time follows
    from its sum of squares: a rise that begins softly leaves the contact open, a kink does not.

    Time, s (or sample numbers), and values, zero taken off, are of shape (n,). The first `rest`
    rows are before any contact; their scatter is used if it is larger than the `noise`. `zero` is
    the standard error of the zero, None if it was not measured.
    """
    top = int(np.argmax(values))
    up, sigma, tau = values[: top + 1], noise.sigma, noise.time
    low = min(float(np.percentile(up, 5.0)), float(up[:_LINE].mean()))  # a hold may come early
    base = float(up[:rest].mean()) if rest >= MIN_REST else low
    if rest >= MIN_REST and (scatter := noise_about(values[:rest], 1))[0] > sigma:
        sigma, tau = scatter
    size = float(up[-1]) - base
    # A soft start may be hidden by noise in single samples; any length of rest may precede it.
    width = 1 + max(up.size - rest, 0) // _WINDOWS
    clear = _CLEAR * sigma * np.sqrt(min(tau / width, 1.0))
    level = min(max(_RISE_SHARE * size, clear), _LARGEST * size)
    part = _first_rise(smooth(up, width) - base, level)
    if (rows := part.stop - part.start) < _RISE_FEWEST:
        return None
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
    return mean, float(np.sqrt(spread))


def _first_rise(values: Array, level: float) -> slice:
    """Return the rows of the first rise up to a level, and enough before it to find its start."""
    high = _first_above(values, level)
    low = max(np.flatnonzero(values[: high + 1] < _LOW * level), default=0)
    return slice(max(0, low - _BEFORE * max(high - low, 2) - _ROWS_BEFORE), high + 2)


def _squares(time: Array, values: Array, start: float, known: float) -> float:
    """Return the sum of squares about the best rise from `start`; `known` weighs a zero level."""
    from scipy.optimize import nnls

    x = np.maximum(time - start, 0.0) / (time[-1] - time[0])
    one = np.ones_like(time)
    columns = np.column_stack([one, -one, (time >= start).astype(float), x, x**2, x**3])
    columns = np.vstack([columns, [known, -known, 0.0, 0.0, 0.0, 0.0]])
    return float(nnls(columns, np.append(values, 0.0), maxiter=1000)[1] ** 2)
