"""Where contact starts: a first value for the fit of an impact, time zero of a slow test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import NoiseLevel, Record, Striker
from foamfit.data.noise import MIN_REST, NOTHING, Level, level_on_line, line_at, mean_level, smooth

# A signal rests where its slope is less than this share of the slope that follows: the branches of
# a foam differ less on loading (6 times in the published sets), so that a soft start is no rest.
# An impact, whose fit goes on from there, and a motion need less.
_STILL, _STILL_IMPACT, _STILL_MOTION = 0.15, 0.3, 0.5
# A machine that travels farther than this share without a stress has not yet reached the specimen.
_APPROACH = 0.02
# Shares of the peak up to which a rise is taken for straight: the least that is so many standard
# deviations of the noise, or else the largest.
_SHARES, _CLEAR, _LARGEST = (0.025, 0.05, 0.1, 0.2), 8.0, 0.5
_ERRORS, ELSEWHERE = 2.0, 5.0  # standard errors: of a slope; of a motion whose zero lies elsewhere

Levels = dict[str, NoiseLevel]


@dataclass(frozen=True)
class Start:
    """Where contact starts: at a `time` of the file, s, at or before its sample `first`.

    `error` is the standard error of that time. `by` is the channel that shows it: "stress",
    "motion", or "file" where nothing was recorded from before contact; `how` says it in words. With
    `free` nothing pressed on the specimen before. `gauge` says what the motion was before contact:
    "rest", "flight" (at the striker's velocity), "other", or "" where the record does not show it.
    `zero` is what the displacement of a slow test shows there, read off `zero_from`.
    """

    how: str
    time: float
    first: int
    error: float = 0.0
    by: str = "file"
    free: bool = False
    gauge: str = ""
    zero: Level = NOTHING
    zero_from: str = ""


class Kink(NamedTuple):
    """Where a signal starts to rise: time and standard error, s."""

    time: float
    error: float


def _kink(time: Array, values: Array, noise: NoiseLevel, power: int) -> Kink | None:
    """Time from which a signal rises as (t − t0)^power above what was before.

    That was a level for the power 1, else a line. Least squares on a grid of times, then on a finer
    one. None if a rise from the first sample does about as well.
    """
    block = 1 + len(time) // 500  # their means show it as well
    rows = len(time) // block
    if rows < 6:
        return None
    t, y = (x[-rows * block :].reshape(rows, block).mean(axis=1) for x in (time, values))
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
    alike = coarse[off <= max(best + variance, float(off[at]))]
    error = 0.5 * max(float(np.ptp(alike)), 0.5 * float(coarse[1] - coarse[0]))
    return Kink(float(fine[int(np.argmin(near))]), error)


def _reached(up: Array, share: float) -> tuple[int, int]:
    """First of three samples in a row above a share of a rise, and how many samples it took.

    They are counted from the last sample below a third of the share.
    """
    base = float(np.percentile(up, 5))
    above = up > base + share * (up[-1] - base)
    three = above[:-2] & above[1:-1] & above[2:]
    high = int(np.argmax(three if three.any() else above))
    early = up[high::-1] > base + share / 3.0 * (up[-1] - base)
    return high, 1 + int(np.argmin(early))


def _onset(time: Array, values: Array, noise: NoiseLevel, power: int = 1) -> Kink | None:
    """Where a signal starts to rise, by the least part of its rise that stands out of its noise."""
    up = values[: int(np.argmax(values)) + 1]
    clear, size = _CLEAR * noise.sigma, float(np.ptp(up))
    if size < clear:
        return None
    for share in [s for s in _SHARES if s * size >= clear] or [_LARGEST]:
        high, lasts = _reached(up, share)
        part = slice(max(0, high - 4 * max(lasts, 3) - 8), high + 1)
        if found := _kink(time[part], values[part], noise, power):
            return found
    return None


def _slopes(time: Array, values: Array, at: float, noise: NoiseLevel) -> tuple[float, float, float]:
    """Slope of a signal before a time over its mean slope after it, up to 15 % of the peak.

    Returns the lower bound of the slope, the upper one of its size, which are infinite where the
    samples before are too few, and the least change of the signal before that time.
    """
    n, top = int(np.searchsorted(time, at)), int(np.argmax(values))
    high = _reached(values[: top + 1], 0.15)[0]
    high = high if time[high] > at else top
    if n < max(5 * noise.time, 3) or time[high] <= at:
        return -np.inf, np.inf, 0.0
    few = n < MIN_REST * noise.time  # they do not show their own noise
    slope = level_on_line(time[:n], values[:n], at, noise if few else replace(noise, sigma=0.0))[1]
    after = float(values[high : high + 3].mean() - values[:n].mean()) / (time[high] - at)
    size, error = abs(slope.value), _ERRORS * slope.error
    if after <= 0.0:
        return -np.inf, np.inf, 0.0
    drift = max(0.0, size - error) * float(time[n - 1] - time[0])
    return (slope.value - error) / after, (size + error) / after, drift


def leave_rest(
    time: Array, values: Array, noise: NoiseLevel, still: float = _STILL, drift: float = np.inf
) -> Kink | None:
    """Where a signal leaves its rest, or None if none is shown before it rises.

    A line is extrapolated back from the first part of the rise. Before, the slope is less than a
    share `still` of the slope that follows, and the signal does not significantly change by more
    than `drift`; a kink within a rise is passed over.
    """
    rows = len(time)
    while rows >= 10:
        time, values = time[:rows], values[:rows]
        found = _onset(time, values, noise)
        if found is None:
            return None
        _, upper, least = _slopes(time, values, found.time, noise)
        if upper < still and least <= drift:
            return found
        rows = min(int(np.searchsorted(time, found.time)), rows - 1)
    return None


def _leave_flight(time: Array, w: Array, noise: NoiseLevel) -> Kink | None:
    """Where a striker's motion, up to its peak, leaves its straight line: it is braked from there.

    With a stress that rises steadily the distance from the line grows as the cube of time. None if
    the motion before does not show that it is straight.
    """
    found = _kink(time, -w, noise, 3)
    before = slice(int(np.searchsorted(time, found.time)) if found else 0)
    if found is None or before.stop < 8:
        return None
    t = time[before] - found.time
    curve, variance = np.polyfit(t, w[before], 2, cov="unscaled")
    error = noise.sigma * float(np.sqrt(noise.time * variance[0, 0]))
    off = np.polyval(np.polyfit(t, w[before], 1), time - found.time) - w
    braked = float(off[-1]) / (time[-1] - found.time) ** 2
    if abs(curve[0]) + _ERRORS * error > 0.5 * braked:
        return None
    return _onset(time, off, noise, 3) or found


def _at_kink(channel: str, time: Array, at: Kink, by: str, what: str = "rest") -> Start:
    how = f"where the {channel} leaves its {what}"
    return Start(how, at.time, int(np.searchsorted(time, at.time)), at.error, by, True)


def _first_motion(time: Array, w: Array, noise: NoiseLevel) -> tuple[Level, bool]:
    """Level of a motion at its first sample, by a line through the first part of its rise.

    With it whether the motion has its zero elsewhere.
    """
    top = int(np.argmax(w))
    early = slice(0, max(5, top // 12))
    level = level_on_line(time[early], w[early], time[0], noise)[0]
    level = level if top >= 5 else level._replace(error=np.inf)  # so few show no zero
    size = abs(level.value)
    return level, size > ELSEWHERE * level.error and size > 0.02 * (float(w[top]) - level.value)


def start_of_impact(record: Record, levels: Levels, striker: Striker) -> Start:
    """Estimate where an impact starts: where stress, acceleration or motion leave their rest.

    A motion that is followed in flight alone leaves its straight line. If none does, the first part
    of the rise is extrapolated back to zero, by a few samples at most; a file whose first sample is
    a step or so after its time zero has that right.
    """
    time, w, drift = record.instants, record.displacement, 0.01
    if w is not None:  # where the motion starts at its zero, no stress that rises is at rest
        drift = np.inf if _first_motion(time, w, levels["displacement"])[1] else 0.002
    start = None
    for name in ("stress", "acceleration"):
        values = record.channel(name)
        if start is None and values is not None and name not in record.derived:
            least = drift * float(np.ptp(values))
            at = leave_rest(time, values, levels[name], _STILL_IMPACT, least)
            start = None if at is None else _at_kink(name, time, at, "stress")
    start = start or _first_sample(record, levels)
    if w is None:
        return start
    noise, up = levels["displacement"], slice(int(np.argmax(w)) + 1)
    at = leave_rest(time[up], w[up], noise, _STILL_MOTION)
    if at is not None:
        # Far from the onset of the stress something else than contact has moved the gauge.
        alike = abs(at.time - start.time) < 0.1 * (time[up][-1] - start.time)
        if not start.free or (at.error < start.error and alike):
            start = _at_kink("displacement", time, at, "motion")
    elif "stress" in record.derived and (at := _leave_flight(time[up], w[up], noise)):
        start = _at_kink("displacement", time, at, "motion", "line")
    return replace(start, gauge=_gauge(record, start, noise, striker)) if start.free else start


def _first_time(time: Array) -> float:
    """Time zero of a file that starts in contact: its own if that is two steps before at most."""
    return 0.0 if 0 <= time[0] <= 2 * (time[1] - time[0]) else float(time[0])


def _first_sample(record: Record, levels: Levels) -> Start:
    """Start of a record that begins in contact or at it."""
    time, stress = record.instants, record.stress
    first, step, top = _first_time(time), float(time[1] - time[0]), int(np.argmax(stress))
    early = slice(0, max(5, _reached(stress[: top + 1], 0.2)[0]))
    level, slope = level_on_line(time[early], stress[early], time[0], levels["stress"])
    back = level.value / slope.value if slope.value > 0 else 0.0
    most = max(8 * step, 0.15 * float(time[top] - time[0]))
    if first == time[0] != 0 and level.value > _ERRORS * level.error and back < most:
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
    at_first, drift = Start("at the first sample", _first_time(time), 0), 0.01 * float(stress.max())
    first, elsewhere = NOTHING, False
    if w is not None:
        first, elsewhere = _first_motion(time, w, levels["displacement"])
    at = leave_rest(time, stress, levels["stress"], drift=np.inf if elsewhere else drift)
    by_stress = None if at is None else _at_kink("stress", time, at, "stress")
    if w is None:
        return by_stress or at_first
    noise, top, onset = (
        levels["displacement"],
        int(np.argmax(w)),
        by_stress.first if by_stress else 0,
    )
    travel = float(w[top] - w[onset])

    def loaded(at: float) -> bool:  # the stress has significantly risen before
        return _slopes(time, stress, at, levels["stress"])[0] > _STILL

    crossing = int(np.argmax(smooth(w, max(1, top // 50)) >= 0)) if w[top] > 0 else 0
    near = slice(max(0, crossing - 5), crossing + 5)
    below = crossing > 1 and -first.value > max(ELSEWHERE * first.error, 1e-4 * travel)
    unloaded = stress[near].mean() < 0.2 * stress.max() and not loaded(time[crossing])
    if below and unloaded and (by_stress is None or abs(w[onset]) < 0.3 * w[top]):
        level, speed = line_at(time[near], w[near], time[crossing])
        passed = time[crossing] - level / speed if speed > 0 else time[crossing]
        passed = float(np.clip(passed, time[near][0], time[near][-1]))
        rows = int(np.searchsorted(time, passed))
        return Start("where the displacement passes zero", passed, rows, by="motion")
    approach = float(w[onset]) - first.value if by_stress else 0.0
    at = leave_rest(time[: top + 1], w[: top + 1], noise)
    if at is not None and approach < _APPROACH * travel and not loaded(at.time):
        by_motion = _at_kink("displacement", time, at, "motion")
        zero = mean_level(w[: by_motion.first], noise)
        source = zero.source(noise, "mean of") + " at rest before contact"
        return replace(by_motion, gauge="rest", zero=zero, zero_from=source)
    if by_stress and approach > _APPROACH * travel:
        reach = max(5, min(onset, (top - onset) // 24))
        near = slice(max(0, onset - reach), onset + reach)
        zero = level_on_line(time[near], w[near], by_stress.time, noise)[0]
        source = zero.source(noise, "line through") + " around it, the stress being at rest before"
        return replace(by_stress, zero=zero, zero_from=source)
    under_load = stress[:3].mean() > 0.05 * stress.max() and 0 < first.value < travel
    if under_load or not elsewhere:
        return at_first
    source = first.source(noise, "line through") + " from the first on; the file's zero lies"
    return replace(at_first, zero=first, zero_from=f"{source} elsewhere")
