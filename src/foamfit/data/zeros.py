"""Evaluate the rows around contact: zeros of the channels, and the flight of the striker."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.data.contact import ELSEWHERE, Levels, Start, motion_leaves_rest, straight
from foamfit.data.measurement import GRAVITY, UNITS, NoiseLevel, Record, Striker, interior_channel
from foamfit.data.noise import (
    EXACT,
    MIN_REST,
    NOTHING,
    Level,
    mean_level,
    polynomial_at,
    quantum,
    smooth,
)
from foamfit.text import engineering, percent

_LEAST_LEAD = 8  # least number of rows kept before contact
_FEWEST = 3  # least number of rows for a zero
_FEW = 20  # with fewer rows before contact, a flat end of the record gives a better zero
_TAIL = 0.04  # share of a record taken as its end
_FLAT = 3.5  # most slope of a flat end, in standard errors
_HIGHEST = 0.1  # highest level of the end, as a share of the range
_DRIFTS = 0.005  # share of its range by which a stress that drifts changes at least
# Parts of notes that others search for: motion and given velocity are inconsistent; what relaxed
# before the first row is unknown.
UNDER_LOAD = "the record starts under load"
CONTRADICTED = "but the striker's velocity is given as"


@dataclass(frozen=True)
class Span:
    """Rows around contact: `first` to `end` are kept, those before `rest` determine the zeros.

    Contact ends at the row `leaves`; `returned` is whether the stress has returned to zero there.
    """

    first: int
    end: int
    rest: int
    leaves: int
    returned: bool = True


def span_of_impact(record: Record, start: Start, levels: Levels) -> Span:
    """Find the rows to keep: contact, a tenth of its rows before it, and a fiftieth after it.

    The rows kept before contact do not determine zeros, as the estimate of contact may be late.
    After contact, a quarter is kept if the stress is derived, because its end is less certain.
    """
    first, stress = start.first, record.stress
    before = stress[: max(0, first - 2)]
    zero = float(before.mean()) if before.size >= _FEWEST else 0.0
    if before.size < _FEW and (tail := tail_level(stress, levels["stress"])):
        zero = tail.value
    found, returned = contact_end(stress[first:] - zero, levels["stress"])
    after = found // (4 if "stress" in record.derived else 50)
    end = min(len(record), first + found + max(3, after)) if returned else len(record)
    # If few rows precede contact, half of them are kept and the others determine the zeros.
    lead = min(max(_LEAST_LEAD, found // 10), first // 2 if first >= 2 * _FEWEST else first)
    late = int(3 * start.error / float(np.median(np.diff(record.instants))))
    rest = first - max(lead, min(late, 2 * first // 3))
    return Span(first - lead, end, rest, first + found, returned)


def tail_level(values: Array, noise: NoiseLevel) -> Level | None:
    """Return the level of a force at the end of an impact, if flat, as after the rebound.

    A crest of a vibration is not flat. The end is extended backwards as long as the preceding rows
    agree with its level within one standard error, a strict limit because a soft end of contact
    stays below the noise for long. The correlation of few rows is unknown, so their mean gets the
    standard error of one row.
    """
    size = max(8, int(_TAIL * len(values)))
    if len(values) < size:
        return None
    step, n = max(4, size // 2), size
    level, rows = mean_level(values[-n:], noise), np.arange(n, dtype=np.float64)
    slope = polynomial_at(rows, values[-n:], 0.0, noise)[1]
    # A crest is no parabola either: what that leaves must not count as noise.
    (bend, *_), variance = np.polyfit(rows, values[-n:], 2, cov="unscaled")
    error = noise.sigma * float(np.sqrt(noise.time * variance[0, 0]))
    if abs(slope.value) > _FLAT * slope.error or abs(bend) > _FLAT * error:
        return None
    while n + step < len(values) // 2:
        more = mean_level(values[-n - step : -n], noise)
        if abs(more.value - level.value) > float(np.hypot(more.error, level.error)):
            break
        n += step
        level = mean_level(values[-n:], noise)
    # The rows next to the end of contact may still be loaded.
    level = mean_level(values[step - n :], noise) if n > 2 * step else level
    if level.samples < MIN_REST:
        level = level._replace(error=max(level.error, noise.sigma))
    return level if abs(level.value) < _HIGHEST * float(np.ptp(values)) else None


def take_zeros(
    record: Record, first: Record, start: Start, span: Span, levels: Levels, *, impact: bool
) -> Record:
    """Subtract the zeros of the channels, found in `first` before contact, or at contact.

    If too few rows precede the contact of an impact, the zero of the force is taken from the end of
    the record. If that is impossible, the zero of the file remains.
    """
    errors, n = dict[str, float](), span.rest
    for name, values in first.curves("acceleration").items():
        if name in record.derived:
            continue
        noise, size, unit = levels[name], float(np.ptp(values)), UNITS.get(name, "m")
        if sensor := name in ("stress", "acceleration"):
            zero, how, drift = _zero_of_sensor(values, n, noise, impact=impact)
            if drift:
                drifts = f"The {name} drifts by {engineering(drift, unit)} in the {n} samples"
                record = record.noted(f"{drifts} before contact, so its zero is as uncertain.")
            known, least = zero.samples > 0, 0.0
            steps = _of_steps(values, values[:n]) if known else 0.0
            if impact and steps > zero.error:  # rows on one level do not show the zero again
                away = np.ones(len(record), dtype=bool)
                away[start.first : span.leaves] = False
                seen = record.sampled.get(name, ~away)
                record = replace(record, sampled=record.sampled | {name: seen & ~away})
            zero = zero._replace(error=float(np.hypot(zero.error, steps)))
        else:
            zero, how = _zero_of_motion(name, first, start, n, noise, impact=impact)
            top = name == "displacement"
            known, least = n >= _FEWEST and not (top and start.gauge != "rest"), 1e-3 * (not top)
        if known:
            errors[name] = zero.error
        elif not impact and not zero.samples and start.by == "file" and values[0] == 0.0:
            # The first row, which was set to zero, has an error unless the channel is exact.
            errors |= {name: noise.sigma} if noise.sigma > EXACT * size else {}
        if max(abs(zero.value), zero.error * sensor) > least * size:
            value = engineering(zero.value, unit, zero.error if sensor else 0.0)
            record = record.noted(f"The {name} at contact, {value}, is taken off ({how}).")
        record = record.shifted(name, zero.value)
    return replace(record, zeros=errors)


def _of_steps(values: Array, rest: Array) -> float:
    """Return the error of a mean at rest due to the steps of the digitiser.

    It averages out only as far as noise spreads the samples over several levels: steps q with
    noise s leave the first harmonic, of amplitude exp(-2π²s²/q²).
    """
    if not (step := quantum(values)):
        return 0.0
    spread = (float(rest.std()) / step) ** 2 - 1.0 / 12.0 if rest.size >= MIN_REST else 0.0
    return float(step / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * max(spread, 0.0)))


def without_drift(record: Record, start: Start, levels: Levels) -> Record:
    """Take off a linear drift of the stress that the rest before and after an impact both show."""
    n, time, stress, noise = start.resting, record.instants, record.stress, levels["stress"]
    if n < MIN_REST or "stress" in record.derived:
        return record
    level, slope = polynomial_at(time[:n], stress[:n], start.time, noise)
    straight = stress - level.value - slope.value * (time - start.time)
    found, returned = contact_end(straight[start.first :], noise)
    end = start.first + found
    if not returned or len(stress) - end < _LEAST_LEAD:
        return record
    after, apart = mean_level(straight[end:], noise), float(time[end:].mean() - time[:n].mean())
    error = float(np.hypot(after.error, slope.error * apart))
    drift = abs(slope.value) * apart
    if abs(after.value) > 3.0 * error or drift < max(4.0 * error, _DRIFTS * float(np.ptp(stress))):
        return record
    rest = np.r_[:n, end : len(stress)]
    slope = polynomial_at(time[rest], stress[rest], start.time, noise)[1]
    by = engineering(slope.value * apart, "Pa")
    note = f"The stress drifts by {by} from before contact to after it; this line is taken off."
    return record.noted(note).changed("stress", stress - slope.value * (time - start.time))


def _zero_of_sensor(
    values: Array, n: int, noise: NoiseLevel, *, impact: bool
) -> tuple[Level, str, float]:
    """Return the zero of a stress or acceleration from `n` rows at rest, or from the flat end.

    Return also where it is from, and the drift of the rows if that is significant.
    """
    tail = tail_level(values, noise) if impact and n < _FEW else None
    if tail is not None and tail.samples > n:
        return tail, f"mean of the last {tail.samples} rows, after the striker has left", 0.0
    if n < _FEWEST:
        return NOTHING, "", 0.0
    zero, how = mean_level(values[:n], noise), f"mean of {n} samples at rest before contact"
    slope = polynomial_at(np.arange(n, dtype=np.float64), values[:n], 0.0, noise)[1]
    rise = slope.value * n
    if abs(rise) <= max(0.01 * float(np.ptp(values)), 4 * slope.error * n):
        return zero, how, 0.0
    kept = zero.value if abs(zero.value) > abs(rise) else 0.0
    return Level(kept, float(np.hypot(zero.error, rise)), n), how, rise


def _zero_of_motion(
    name: str, record: Record, start: Start, n: int, noise: NoiseLevel, *, impact: bool
) -> tuple[Level, str]:
    """Return the value of a motion at contact: its mean at rest, or else from a line.

    The zero of the file is kept if nothing was recorded before contact, unless it is clearly wrong,
    and in a slow test whose record starts under load.
    """
    time, values, first = record.instants, record.curves()[name], start.first
    top = name == "displacement"
    rows = n if n >= _FEWEST else max(0, first - 2)
    if rows >= _FEWEST and (not top or start.gauge == "rest"):
        return mean_level(values[:rows], noise), f"mean of {rows} samples at rest before contact"
    flies = top and start.gauge == "flight"
    reach = max(5, (int(np.argmax(values)) - first) // (24 if flies else 12))
    reach = reach if impact else straight(time, values, first, reach, noise)
    near = slice(max(0, first - reach) if flies else first, first + reach)
    zero = polynomial_at(time[near], values[near], start.time, noise)[0]
    source = f"line through {zero.samples} samples {'around it' if flies else 'from there on'}"
    size, stress = float(np.ptp(values)), record.stress
    loaded = not impact and stress[:3].mean() > 0.05 * stress.max() and 0.0 < zero.value < size
    least = max(ELSEWHERE * zero.error, 0.1 * size if impact else 0.0)
    keep = not flies and (loaded or abs(zero.value) <= least)
    return NOTHING if keep else zero, source


def gauge_before(record: Record, start: Start, levels: Levels, striker: Striker) -> str:
    """Classify the motion of an impact before contact; see `Start.gauge`."""
    time, w, before = record.instants, record.displacement, slice(start.seen, start.first - 2)
    if w is None or not start.free or start.first == 0:
        return ""
    if before.stop - before.start < 3:
        return "other"
    top = int(np.argmax(w))
    early = slice(start.first, start.first + max(5, (top - start.first) // 6))
    slope, after = (
        polynomial_at(time[rows], w[rows], start.time, levels["displacement"])[1]
        for rows in (before, early)
    )
    speed = striker.velocity or after.value
    # The stated velocity may be wrong, but the striker does not change its speed at contact.
    for gauge, expected in (("flight", speed), ("flight", after.value), ("rest", 0.0)):
        if abs(slope.value - expected) <= slope.error + 0.05 * speed:
            return gauge if slope.error < 0.2 * speed else "other"
    return "other"


def mark_flight(record: Record, start: Start, span: Span, levels: Levels) -> Record:
    """Mark rows in which a gauge does not follow the striker or the specimen as not measured.

    After contact the specimen may stay on its base or leave with the striker: its interior motions
    are then not compared.
    """
    touching = np.arange(len(record)) < span.leaves - span.first
    inside = map(interior_channel, record.interior)
    inner = {name: record.sampled.get(name, touching) & touching for name in inside}
    record = replace(record, sampled=record.sampled | inner)
    if record.displacement is None or start.gauge in ("flight", ""):
        return record
    step = float(np.median(np.diff(record.instants)))
    moves = record.instants > max(2.5 * step, 2 * start.error)
    if start.gauge == "rest":
        moves &= touching
        if at := motion_leaves_rest(record, levels):  # possibly late
            moves &= record.instants > at[0] + max(2.5 * step, 2 * at[1])
    kept = record.sampled.get("displacement", np.ones(len(record), dtype=bool))
    return replace(record, sampled=record.sampled | {"displacement": kept & moves})


def flight_of(
    record: Record, start: Start, span: Span, levels: Levels, striker: Striker, spread: float
) -> tuple[Striker, tuple[float, float] | None, list[str]]:
    """Compare the striker's flight with its velocity ± `spread`, m/s, and detect free fall.

    Return the striker, with gravity from its flight if the TOML does not give it, its velocity in
    flight with its standard error, m/s, or None, and notes.
    """
    given, notes, before = striker.velocity, list[str](), slice(start.seen, start.first - 2)
    if not given or record.displacement is None or before.stop - before.start < 8:
        return striker, None, notes
    w, t = record.displacement[before], record.instants[before] - start.time
    noise = levels["displacement"]
    gravity, error = (2.0 * half for half in polynomial_at(t, w, 0.0, noise, 2)[2][:2])
    none = start.gauge == "flight" and 4.0 * error < GRAVITY
    if falls := gravity > 4.0 * error and abs(gravity - GRAVITY) < 0.2 * GRAVITY + 2.0 * error:
        gain = percent(GRAVITY * float(record.instants[span.end - 1] - start.time) / given)
        starts, ends = "Before", ". The fit includes gravity."
        if striker.gravity == 0.0:
            starts, ends = "Check: before", ", but [striker] gravity is false."
        notes.append(
            f"{starts} contact the striker accelerates by {engineering(gravity, 'm/s²')}: it "
            f"falls, and gains {gain} of its velocity over the contact{ends}"
        )
    if striker.gravity is None and (falls or none):
        striker = replace(striker, gravity=GRAVITY if falls else 0.0)
    fall = 0.5 * (striker.gravity or 0.0) * t**2
    speed, error = polynomial_at(t, w - fall, 0.0, noise)[1][:2]
    if striker.gravity is None:  # the line has the mean velocity of a fall
        error = float(np.hypot(error, 0.5 * GRAVITY * np.ptp(t)))
    flight = (speed, error) if speed > 0.5 * given else None
    deviation, error = abs(speed - given), float(np.hypot(error, spread))
    if deviation > max(3.0 * error, 0.005 * given) and abs(speed) > 0.5 * given:
        moves = f"the displacement moves at {speed:.4g} ± {error:.2g} m/s"
        notes.append(f"Check: before contact {moves}, {CONTRADICTED} {given:.4g} m/s.")
    return striker, flight, notes


def contact_end(stress: Array, noise: NoiseLevel) -> tuple[int, bool]:
    """Return the index after the end of contact, and whether the record contains the end.

    Contact is the one with the highest stress. It ends at the last return to zero of a moving mean,
    wide enough for a noise of half a percent of the peak if the pulse is long enough. Contact
    continues if the mean over the next quarter of the time since the peak is significantly above
    zero.
    """
    top = int(np.argmax(stress))
    peak = float(stress[top])
    loaded = int(np.count_nonzero(stress > 0.1 * peak))
    needed = noise.time * (2 * noise.sigma / (0.005 * peak)) ** 2
    steep = int(np.argmax(stress[top:] < 0.5 * peak))  # 0 if it stays above
    width = max(1, steep // 12, int(min(needed, loaded // 24)))
    mean = smooth(stress, width)

    def zero(samples: int) -> float:
        """Return the largest mean of a number of samples that is consistent with zero stress."""
        error = noise.sigma * np.sqrt(min(1.0, noise.time / samples))
        return min(0.0025 * peak + 2 * float(error), 0.04 * peak)

    level, end = zero(width), top
    while True:
        quiet = np.flatnonzero(mean[end:] <= level)
        if not quiet.size:  # the record may be cut just at the end of contact
            return len(stress), bool(stress[-1] <= 0.02 * peak + level)
        end += int(quiet[0])
        tail = stress[end : end + max(4 * width, (end - top) // 4)]
        if len(tail) <= width or tail.mean() <= zero(len(tail)):
            return end, True
        end += 1
