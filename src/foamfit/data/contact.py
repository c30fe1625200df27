"""Where contact starts: a first value for the fit of an impact, time zero of a slow test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import NoiseLevel, Record, Striker
from foamfit.data.noise import MIN_REST, correlation_time, lag_one

# A signal rests where its slope is less than this share of the slope that follows: the branches of
# a foam differ less on loading (6 times in the published sets), so that a soft start is no rest.
STILL = 0.15
ERRORS = 2.0  # standard errors that decide whether a signal rises or rests
_STILL_IMPACT = 0.3  # as `STILL`, for a signal that a fit goes on from
ELSEWHERE = 5.0  # standard errors that decide whether the zero of a motion lies elsewhere
# Share of its travel from which on a machine that moves without a stress has not touched the
# specimen yet.
APPROACH = 0.02
_SHARES = 0.2, 0.1, 0.05, 0.025  # of the peak, up to which a rise is taken for straight

Levels = dict[str, NoiseLevel]


@dataclass(frozen=True)
class Start:
    """Where contact starts: at a `time` of the file, s, at or before its sample `first`.

    `error` is the standard error of that time. `by` is the channel that shows it: "stress",
    "motion", or "file" where nothing was recorded from before contact; `how` says it in words. With
    `free` nothing pressed on the specimen before. `gauge` says what the motion was before contact:
    "rest", "flight" (at the striker's velocity), "other", or "" where the record does not show it.
    """

    how: str
    time: float
    first: int
    error: float = 0.0
    by: str = "file"
    free: bool = False
    gauge: str = ""
    zero: Level | None = None
    zero_from: str = ""


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


class Kink(NamedTuple):
    """Where a signal starts to rise: time and standard error, s."""

    time: float
    error: float


def mean_level(values: Array, noise: NoiseLevel) -> Level:
    """Level of a signal at rest: the mean of its samples; few of them do not show their noise."""
    n, sigma, time, zero = len(values), noise.sigma, noise.time, float(values.mean())
    if n >= MIN_REST:
        phi = lag_one(values - zero)
        time = max(time, correlation_time(phi)) if 2 / np.sqrt(n) < phi < 1 else time
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


def kink(time: Array, values: Array, noise: NoiseLevel, power: int = 1) -> Kink | None:
    """Time from which a signal rises as (t − t0)^power above what was before.

    That was a level for the power 1, else a line. Least squares on a grid of times. None if a rise
    from the first sample does about as well.
    """
    block = 1 + len(time) // 500  # their means show it as well
    rows = len(time) // block
    t, y = (x[-rows * block :].reshape(rows, block).mean(axis=1) for x in (time, values))
    if rows < 6:
        return None
    rest = np.linalg.qr(np.vander(t - t.mean(), 1 if power == 1 else 2))[0]
    y = y - rest @ (rest.T @ y)

    def misfit(starts: Array) -> Array:
        ramps = np.maximum(0.0, (t - starts[:, None]) / (t[-1] - t[0])) ** power
        ramps -= (ramps @ rest) @ rest.T
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
    alike = coarse[off <= best + variance]
    error = 0.5 * float(np.ptp(alike)) if alike.size > 1 else 0.25 * float(coarse[1] - coarse[0])
    return Kink(float(fine[int(np.argmin(near))]), error)


def _rise(values: Array, share: float) -> int:
    """First of three samples in a row above a share of the way from the lowest level to the top."""
    above = _above(values, share)
    run = above[:-2] & above[1:-1] & above[2:]
    return int(np.argmax(run)) if run.any() else int(np.argmax(above))


def _above(values: Array, share: float) -> NDArray[np.bool_]:
    """Mark the samples up to the peak that are above that share."""
    before_peak = values[: int(np.argmax(values)) + 1]
    base = float(np.percentile(before_peak, 5))
    return np.asarray(before_peak > base + share * (before_peak[-1] - base))


def _nearest(time: Array, values: Array, noise: NoiseLevel, power: int = 1) -> Kink | None:
    """Where a signal starts to rise, by the least part of its rise that the noise allows."""
    found, peak = None, float(np.ptp(values[: int(np.argmax(values)) + 1]))
    for share in _SHARES:
        if found is not None and share * peak < 8 * noise.sigma:
            break
        high = _rise(values, share)
        lasts = 1 + int(np.argmin(_above(values, share / 3)[: high + 1][::-1]))
        part = slice(max(0, high - 4 * max(lasts, 3) - 8), high + 1)
        nearer = kink(time[part], values[part], noise, power)
        if nearer is None and found is None:
            return None
        found = nearer or found
    return found


def leave_rest(
    time: Array, values: Array, noise: NoiseLevel, still: float = STILL, drift: float = np.inf
) -> Kink | None:
    """Where a signal leaves its rest, or None if none is shown before it rises.

    A line is extrapolated back from the first part of the rise. Before, the slope is less than a
    share `still` of the slope that follows, and the signal does not significantly change by more
    than `drift`; a kink within a rise is passed over.
    """
    found = _nearest(time, values, noise)
    if found is None:
        return None
    before = slopes(time, values, found.time, noise)
    if before.upper < still and before.drift <= drift:
        return found
    rows = int(np.searchsorted(time, found.time))
    more = 10 <= rows < len(time)
    return leave_rest(time[:rows], values[:rows], noise, still, drift) if more else None


def leave_flight(time: Array, w: Array, noise: NoiseLevel) -> Kink | None:
    """Where a striker's motion, up to its peak, leaves its straight line: it is braked from there.

    With a stress that rises steadily the distance from the line grows as the cube of time. None if
    the motion before does not show that it is straight.
    """
    found = kink(time, -w, noise, 3)
    before = slice(int(np.searchsorted(time, found.time)) if found else 0)
    if found is None or before.stop < 8:
        return None
    t = time[before] - found.time
    curve, variance = np.polyfit(t, w[before], 2, cov="unscaled")
    error = noise.sigma * float(np.sqrt(noise.time * variance[0, 0]))
    off = np.polyval(np.polyfit(t, w[before], 1), time - found.time) - w
    braked = float(off[-1]) / (time[-1] - found.time) ** 2
    if abs(curve[0]) + ERRORS * error > 0.5 * braked:
        return None
    return _nearest(time, off, noise, 3) or found


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
    if n < max(5 * noise.time, 3) or time[high] <= at:
        return Slopes()
    few = n < MIN_REST * noise.time  # they do not show their own noise
    least = noise if few else replace(noise, sigma=0.0)
    slope = level_on_line(time[:n], values[:n], at, least)[1]
    error, top = ERRORS * slope.error, values[high : high + 3]
    uncertainty = ERRORS * noise.sigma * np.sqrt(1.0 / len(top) + noise.time / n)
    rise, lasts = float(top.mean() - values[:n].mean()), float(time[high] - at)
    drift = max(0.0, abs(slope.value) - error) * float(time[n - 1] - time[0])
    if rise <= uncertainty:
        return Slopes(drift=drift)
    upper = (abs(slope.value) + error) * lasts / (rise - uncertainty)
    return Slopes((slope.value - error) * lasts / rise, upper, drift)


def first_level(time: Array, w: Array, noise: NoiseLevel) -> Level:
    """Level of a motion at its first sample, by a line through the first part of its rise."""
    top = int(np.argmax(w))
    early = slice(0, max(5, top // 12))
    level = level_on_line(time[early], w[early], time[0], noise)[0]
    return level if top >= 5 else level._replace(error=np.inf)  # so few show no zero


def is_elsewhere(first: Level, top: float) -> bool:
    """Whether a motion with this first level and this top has its zero elsewhere."""
    away = abs(first.value) > ELSEWHERE * first.error
    return away and abs(first.value) > 0.02 * (top - first.value)


def start_of_impact(record: Record, levels: Levels, striker: Striker) -> Start:
    """Estimate where an impact starts: where stress, acceleration or motion leave their rest.

    Of several channels the one with the least standard error says so. A motion that is followed in
    flight alone leaves its straight line. If none does, the first part of the rise is extrapolated
    back to zero, by a few samples at most; a file whose first sample is a step or so after its time
    zero has that right.
    """
    time, w = record.instants, record.displacement
    drift = 0.01
    if w is not None:
        # Where the motion starts at its zero, no stress that rises is taken for a rest.
        first, top = first_level(time, w, levels["displacement"]), int(np.argmax(w))
        drift = np.inf if is_elsewhere(first, float(w[top])) else 0.002
    for name in ("stress", "acceleration"):
        values = record.channel(name)
        if values is not None and name not in record.derived:
            least = drift * float(np.ptp(values))
            at = leave_rest(time, values, levels[name], _STILL_IMPACT, least)
            if at is not None:
                start = _at_kink(f"where the {name} leaves its rest", time, at, "stress")
                break
    else:
        start = _first_sample(record, levels)
    if w is None:
        return start
    noise, up = levels["displacement"], slice(int(np.argmax(w)) + 1)
    by_motion, how = leave_rest(time[up], w[up], noise, 0.5), "where the displacement leaves its "
    if by_motion is not None:
        # Far from the onset of the stress something else than contact has moved the gauge.
        alike = abs(by_motion.time - start.time) < 0.1 * (time[up][-1] - start.time)
        if not start.free or (by_motion.error < start.error and alike):
            start = _at_kink(f"{how}rest", time, by_motion, "motion")
    elif "stress" in record.derived:
        by_motion = leave_flight(time[up], w[up], noise)
        start = _at_kink(f"{how}line", time, by_motion, "motion") if by_motion else start
    return replace(start, gauge=_gauge(record, start, noise, striker)) if start.free else start


def _at_kink(how: str, time: Array, at: Kink, by: str) -> Start:
    return Start(how, at.time, int(np.searchsorted(time, at.time)), at.error, by, True)


def first_time(time: Array) -> float:
    """Time zero of a file that starts in contact: its own if that is two steps before at most."""
    return 0.0 if 0 <= time[0] <= 2 * (time[1] - time[0]) else float(time[0])


def _first_sample(record: Record, levels: Levels) -> Start:
    """Start of a record that begins in contact or at it."""
    time, stress = record.instants, record.stress
    first, step = first_time(time), float(time[1] - time[0])
    early = slice(0, max(5, _rise(stress, 0.2)))
    level, slope = level_on_line(time[early], stress[early], time[0], levels["stress"])
    back = level.value / slope.value if slope.value > 0 else 0.0
    most = max(8 * step, 0.15 * float(time[int(np.argmax(stress))] - time[0]))
    if first == time[0] != 0 and level.value > ERRORS * level.error and back < most:
        return Start("before the first sample, where the rise leads back to zero", first - back, 0)
    return Start("at the first sample", first, 0)


def _gauge(record: Record, start: Start, noise: NoiseLevel, striker: Striker) -> str:
    """Say what the motion was before contact: "rest", "flight", or "other"."""
    time, w, before = record.instants, record.displacement, start.first - 2
    assert w is not None
    if before < 3:
        return "other" if start.first else ""
    top = int(np.argmax(w))
    early = slice(start.first, start.first + max(5, (top - start.first) // 6))
    speed = striker.velocity or line_at(time[early], w[early], start.time)[1]
    slope = level_on_line(time[:before], w[:before], start.time, noise)[1]
    for gauge, expected in (("flight", speed), ("rest", 0.0)):
        if abs(slope.value - expected) <= slope.error + 0.05 * speed:
            return gauge if slope.error < 0.2 * speed else "other"
    return "other"


def start_of_slow_test(record: Record, levels: Levels) -> Start:
    """Find where a slow test starts: where the motion passes its own zero or leaves a rest.

    If the stress has risen before, it is where the stress leaves its rest; without any rest it is
    the first sample.
    """
    time, w, stress = record.instants, record.displacement, record.stress
    drift, none = 0.01 * float(stress.max()), Level(0.0, 0.0, 0)
    shown = "where the stress leaves its rest"
    at_first = Start("at the first sample", first_time(time), 0, zero=none)
    if w is None:
        at = leave_rest(time, stress, levels["stress"], drift=drift)
        return at_first if at is None else replace(_at_kink(shown, time, at, "stress"), zero=none)
    noise, top = levels["displacement"], int(np.argmax(w))
    first = first_level(time, w, noise)
    away, elsewhere = abs(first.value) > ELSEWHERE * first.error, is_elsewhere(first, float(w[top]))
    by_stress = leave_rest(time, stress, levels["stress"], drift=np.inf if elsewhere else drift)
    onset = 0 if by_stress is None else int(np.searchsorted(time, by_stress.time))
    travel = float(w[top] - w[onset])
    crossing = int(np.argmax(smooth(w, max(1, top // 50)) >= 0)) if w[top] > 0 else 0
    near = slice(max(0, crossing - 5), crossing + 5)
    unloaded = stress[near].mean() < 0.2 * stress.max()
    unloaded &= not _loaded(record, time[crossing], levels)
    below = crossing > 1 and away and first.value < -1e-4 * travel
    if below and unloaded and (by_stress is None or abs(w[onset]) < 0.3 * w[top]):
        level, speed = line_at(time[near], w[near], time[crossing])
        passed = time[crossing] - level / speed if speed > 0 else time[crossing]
        passed = float(np.clip(passed, time[near][0], time[near][-1]))
        rows = int(np.searchsorted(time, passed))
        return Start("where the displacement passes zero", passed, rows, by="motion", zero=none)
    by_motion = leave_rest(time[: top + 1], w[: top + 1], noise)
    approach = w[onset] - first.value if by_stress is not None else 0.0
    if (
        by_motion is not None
        and approach < APPROACH * travel
        and not _loaded(record, by_motion.time, levels)
    ):
        rows = int(np.searchsorted(time, by_motion.time))
        zero = mean_level(w[:rows], noise)
        source = zero.source(noise, "mean of") + " at rest before contact"
        return Start(
            "where the displacement leaves its rest",
            by_motion.time,
            rows,
            by_motion.error,
            "motion",
            True,
            "rest",
            zero,
            source,
        )
    if by_stress is not None and approach > APPROACH * travel:
        reach = max(5, min(onset, (top - onset) // 24))
        near = slice(max(0, onset - reach), onset + reach)
        zero = level_on_line(time[near], w[near], by_stress.time, noise)[0]
        source = zero.source(noise, "line through") + " around it, the stress being at rest before"
        by = _at_kink(shown, time, by_stress, "stress")
        return replace(by, zero=zero, zero_from=source)
    under_load = stress[:3].mean() > 0.05 * stress.max() and 0 < first.value < travel
    if under_load or not elsewhere:
        return at_first
    source = first.source(noise, "line through") + " from the first on; the file's zero lies"
    return replace(at_first, zero=first, zero_from=f"{source} elsewhere")


def _loaded(record: Record, at: float, levels: Levels) -> bool:
    """Whether the stress has significantly risen before a time."""
    return slopes(record.instants, record.stress, at, levels["stress"]).lower > STILL
