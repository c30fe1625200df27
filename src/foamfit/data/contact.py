"""Where contact starts and ends, and what stress and motion are there: time zero, and offsets.

The second half holds what finds a rest and its end in a signal; a newcomer may skip it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import MIN_ROWS, NoiseLevel, Record, Striker, interior_node
from foamfit.data.noise import MIN_REST, correlation_time, lag_one, noise_level
from foamfit.text import engineering

# A rest has as many independent samples, and the slope of a signal on it is less than this share of
# the slope that follows: the branches of a foam on loading differ less in stiffness (6 times in the
# published sets), so that a soft start is no rest.
LEAST_REST, STILL = 5, 0.15
ERRORS = 3.0  # standard errors that decide whether a signal rises or rests
_STILL_STRIKER = 0.5  # as `STILL`, for a striker, which contact does not speed up
_ELSEWHERE = 5.0  # standard errors that decide whether the zero of a motion lies elsewhere

Levels = dict[str, NoiseLevel]


@dataclass(frozen=True)
class Start:
    """Where contact starts: at a time of the file (None: at its first sample).

    `zero` is the displacement there, and `zero_from` says what shows it. With `free` nothing
    pressed on the specimen before, so that the samples before it show the sensor's offset. With
    `at_zero` contact starts at the file's time zero, before its first sample.
    """

    how: str
    time: float | None = None
    zero: float = 0.0
    free: bool = False
    zero_from: str = ""
    at_zero: bool = False

    @property
    def by(self) -> str:
        """The channel that set time zero: "stress", "motion", or "file" for the file's own."""
        if self.time is None:
            return "file"
        return "motion" if "displacement" in self.how else "stress"

    def rest(self, record: Record) -> int:
        """Count the samples that certainly lie before contact."""
        before = 0 if self.time is None else int(np.searchsorted(record.instants, self.time))
        return max(0, before - 2)

    def zero_time(self, record: Record) -> float:
        """Time of contact as the file counts it."""
        if self.time is not None:
            return self.time
        # A file whose first sample is a step or so after time zero has its zero right.
        first, second = record.instants[:2]
        return 0.0 if self.at_zero or 0 <= first <= 2 * (second - first) else float(first)


def find_start(record: Record, levels: Levels, striker: Striker | None) -> Start:
    """Find where contact starts: where the motion passes its own zero or leaves a rest.

    If the stress has risen before, it is where the stress leaves its rest; without any rest it is
    the first sample.
    """
    time, w, stress = record.instants, record.displacement, record.stress
    impact, drift = striker is not None, 0.01 * float(stress.max())
    by_the_stress = "where the stress leaves its rest"
    if w is None:
        at = leave_rest(time, stress, levels["stress"], drift=drift)
        return Start("at the first sample") if at is None else Start(by_the_stress, at, free=True)
    noise, top = levels["displacement"], int(np.argmax(w))
    first, balance = _first_levels(time, w, stress, top, noise)
    origin = min(first, balance, key=lambda level: level.significance) if impact else first
    away = origin.significance > _ELSEWHERE
    elsewhere = away and abs(first.value) > 0.02 * (w[top] - first.value)
    # Where the motion of a striker starts at its zero, no stress that rises is taken for a rest.
    drift = np.inf if elsewhere else 0.0 if impact else drift
    by_stress = leave_rest(time, stress, levels["stress"], drift=drift)
    if impact and elsewhere and by_stress is None:
        # The file's zero does not lie at its first sample: the likelier start is taken.
        by_stress = leave_rest(time, stress, levels["stress"], _STILL_STRIKER)
    onset = 0 if by_stress is None else int(np.searchsorted(time, by_stress))
    travel = float(w[top] - w[onset])
    crossing, near = _passage(time, w, top, noise)
    below = crossing > 1 and away and origin.value < -1e-4 * travel
    unloaded = stress[near].mean() < 0.2 * stress.max()
    unloaded &= not _loaded(record, time[crossing], levels)
    if below and unloaded and (by_stress is None or abs(w[onset]) < 0.3 * w[top]):
        level, speed = line_at(time[near], w[near], time[crossing])
        at = time[crossing] - level / speed if speed > 0 else time[crossing]
        at = float(np.clip(at, time[near][0], time[near][-1]))
        own = abs(at) < 0.05 * (time[crossing] - time[crossing - 1])  # the file's own time zero
        return Start("where the displacement passes zero", 0.0 if own else at)
    up_to = slice(top + 1)
    by_motion = leave_rest(time[up_to], w[up_to], noise, _STILL_STRIKER if impact else STILL)
    approach = w[onset] - first.value if by_stress is not None else 0.0
    # A striker's motion starts at contact, if tracked so; a machine's may start above the specimen.
    small = approach < (0.3 if impact else 0.1) * travel
    if by_motion is not None and small and not _loaded(record, by_motion, levels):
        rest = resting_level(w[time < by_motion], noise)
        source = rest.source(noise, "median of") + " at rest before contact"
        return Start("where the displacement leaves its rest", by_motion, rest.value, True, source)
    if by_stress is not None and approach > (0.02 if elsewhere else 0.1) * travel:
        reach = max(5, min(onset, (top - onset) // 24))
        near = slice(max(0, onset - reach), onset + reach)
        zero = level_on_line(time[near], w[near], by_stress, noise)
        source = zero.source(noise, "line through") + " around it, the stress being at rest before"
        return Start(by_the_stress, by_stress, zero.value, True, source)
    gone = time[0] * (striker.velocity or 0.0) if striker is not None else 0.0
    if origin.significance > ERRORS and 0.7 < first.value / max(gone, 1e-300) < 1.1:
        return Start("before the first sample", at_zero=True)
    under_load = stress[:3].mean() > 0.05 * stress.max() and 0 < first.value < travel
    if under_load or not elsewhere:
        return Start("at the first sample")
    source = first.source(noise, "line through") + " from the first on; the file's zero lies"
    return Start("at the first sample", zero=first.value, zero_from=f"{source} elsewhere")


def _loaded(record: Record, at: float, levels: Levels) -> bool:
    """Whether the stress has significantly risen before a time."""
    return slopes(record.instants, record.stress, at, levels["stress"]).lower > STILL


def _first_levels(
    time: Array, w: Array, stress: Array, top: int, noise: NoiseLevel
) -> tuple[Level, Level]:
    """Level of a motion at its first sample: by a line, and by the balance of a striker."""
    if top < LEAST_REST:
        return (Level(float(w[0]), np.inf, 1),) * 2  # so few samples show no zero
    early, loading = slice(0, max(LEAST_REST, top // 12)), slice(0, 2 * top)
    by_line = level_on_line(time[early], w[early], time[0], noise)
    return by_line, level_by_balance(time[loading], w[loading], stress[loading])


def _passage(time: Array, w: Array, top: int, noise: NoiseLevel) -> tuple[int, slice]:
    """Sample at which the moving mean of a rising motion passes zero, and the samples around it.

    They bring the scatter of their line to a thousandth of the rise, but lie within a twelfth of
    the rise on either side, where the motion is still straight.
    """
    if w[top] <= 0:
        return 0, slice(0, 5)
    rough = int(np.argmax(w >= 0))
    crossing = int(np.argmax(smooth(w, max(1, (top - rough) // 50)) >= 0))
    needed = noise.time * (noise.sigma / (1e-3 * w[top])) ** 2
    reach = (time[top] - time[crossing]) * min(1 / 12, 0.5 * needed / max(top - crossing, 1))
    first = int(np.searchsorted(time, time[crossing] - reach))
    last = int(np.searchsorted(time, time[crossing] + reach))
    return crossing, slice(max(0, min(first, crossing - 5)), max(last, crossing + 5))


def zero_interior(
    record: Record, first: Record, start: Start, levels: Levels
) -> tuple[Record, list[str]]:
    """Take from each interior displacement its value where contact starts in `first`.

    That is the median of its rest before contact, or else where a line through the first samples
    starts, unless this is zero within their noise.
    """
    before, notes = start.rest(first), []
    for name, values in first.curves().items():
        if interior_node(name) is None:
            continue
        noise = levels[name]
        if before >= MIN_ROWS:
            zero = resting_level(values[:before], noise)
            source = zero.source(noise, "median of") + " before contact"
        else:
            early = slice(before, before + max(LEAST_REST, int(np.argmax(values)) // 12))
            at = start.zero_time(first)
            zero = level_on_line(first.instants[early], values[early], at, noise)
            source = zero.source(noise, "line through") + " from there on"
            if abs(zero.value) < max(_ELSEWHERE * zero.error, 2e-3 * np.ptp(values)):
                continue
        record = record.changed(name, record.curves()[name] - zero.value)
        if abs(zero.value) > 1e-3 * np.ptp(values):
            size = engineering(zero.value, "m")
            notes.append(f"{name} at contact, {size}, is taken off ({source}).")
    return record, notes


def remove_offset(record: Record, n: int, noise: NoiseLevel) -> tuple[Record, list[str]]:
    """Take from the stress (and the acceleration) its median over `n` samples before contact."""
    if n < MIN_REST:
        return record, []
    rest = record.stress[:n]
    offset, scatter = float(np.median(rest)), float(rest.std())
    rise = line_at(np.arange(n, dtype=np.float64), rest, 0.0)[1] * n
    uncertainty = 4 * noise_level(rest) * np.sqrt(12 * noise.time / n)
    if abs(rise) > max(0.01 * record.stress.max(), uncertainty):
        told = f"by {engineering(rise, 'Pa')} in the {n} samples before contact"
        return record, [f"The stress drifts {told}, so no offset is taken off."]
    ratio = f", {abs(offset) / scatter:.2g} times that" if scatter > 0 else ""
    note = (
        f"The stress before contact, {engineering(offset, 'Pa')}, is taken off as the sensor's "
        f"offset ({n} samples at rest with a standard deviation of {engineering(scatter, 'Pa')}"
        f"{ratio})."
    )
    if record.acceleration is not None:
        a = record.acceleration
        record = record.changed("acceleration", a - np.median(a[:n]))
    return record.changed("stress", record.stress - offset), [note]


def contact_end(stress: Array, noise: NoiseLevel) -> tuple[int, bool]:
    """Index after the last sample of the contact with the highest stress, and if it was reached.

    The end is the last return to zero of a moving mean, whose noise is half a percent of the peak
    if the pulse is long enough. A stress that soon rises again has not ended, nor one whose mean
    over the next quarter of the time since the peak is not zero within its error.
    """
    top = int(np.argmax(stress))
    peak = float(stress[top])
    below = np.flatnonzero(stress[top:] < 0.5 * peak)
    loaded = int(np.count_nonzero(stress > 0.1 * peak))
    needed = noise.time * (2 * noise.sigma / (0.005 * peak)) ** 2
    steep = int(below[0]) if below.size else 0
    width = max(1, steep // 12, int(min(needed, loaded // 24)))
    mean = smooth(stress, width)

    def zero(samples: int) -> float:
        """Level that the mean of so many samples stays below at zero stress."""
        error = noise.sigma * np.sqrt(min(1.0, noise.time / samples))
        return min(0.0025 * peak + 2 * float(error), 0.04 * peak)

    level, end = zero(width), top
    while True:
        quiet = np.flatnonzero(mean[end:] <= level)
        if not quiet.size:  # a record cut right at the end of contact has returned
            return len(stress), bool(stress[-1] <= 0.02 * peak + level)
        end += int(quiet[0])
        ahead = end + max(1, (end - top) // 5)
        again = np.flatnonzero(mean[end:ahead] > 0.05 * peak)
        tail = stress[end : end + max(4 * width, (end - top) // 4)]
        if again.size:
            end += max(1, int(again[-1]))
        elif len(tail) > width and tail.mean() > zero(len(tail)):
            end += 1
        else:
            return end, True


def cut_to_contact(
    record: Record, start: Start, impact: bool, noise: NoiseLevel
) -> tuple[Record, list[str]]:
    """Cut what lies before and after contact; time and displacement are zero where it starts."""
    w, zero_time = record.displacement, start.zero_time(record)
    first = 0 if start.time is None else int(np.searchsorted(record.instants, start.time))
    notes: list[str] = []
    end = len(record)
    if impact:
        found, returned = contact_end(record.stress[first:], noise)
        end = min(end, first + found + max(3, found // 50)) if returned else end
        if not returned:
            notes.append("Check: the record ends before the stress has returned to zero.")
    cut = f"; {first} samples before and {len(record) - end} after are cut, {end - first} kept"
    at = "" if record.time is None else f", {engineering(zero_time, 's')} in the file"
    notes.insert(0, f"Contact starts {start.how}{at}{cut if end - first < len(record) else ''}.")
    if start.zero != 0:
        size, source = engineering(start.zero, "m"), f" ({start.zero_from})"
        notes.append(f"The displacement there, {size}, is taken off{source}.")
    if record.time is not None:
        record = replace(record, time=record.time - zero_time)
    if w is not None:
        record = replace(record, displacement=w - start.zero)
    return record.between(first, end, "before contact starts", "after contact ends"), notes


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
    uncertainty = ERRORS * noise.sigma * np.sqrt(1.0 / len(top) + noise.time / n)
    rise, lasts = float(top.mean() - rest.mean()), float(time[high] - at)
    drift = max(0.0, abs(slope) - error) * float(np.ptp(t))
    if rise <= uncertainty:
        return Slopes(drift=drift)
    upper = (abs(slope) + error) * lasts / (rise - uncertainty)
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
    # The curve must fit significantly better than the line.
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
            uncertainty = 4 * noise_level(values) * np.sqrt(12 / rest.sum())
            if abs(rise) > max(uncertainty, 2e-3 * np.ptp(values)):
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
