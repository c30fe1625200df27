"""Find and repair bad samples: spikes, short gaps, a clipped force, a stuck gauge.

A sample is compared with its neighbours, not with a model. A gauge is stuck if it stands still
while the stress changes, and then jumps, because of play at a reversal or missed readings. After a
true hold, the motion continues smoothly from its level and the stress follows.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import mode
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from foamfit.arrays import Array, Integers, Mask
from foamfit.data.measurement import MIN_ROWS, UNITS, NoiseLevel, Outliers, Record
from foamfit.data.noise import (
    estimated_noise,
    noise_level,
    quantum,
    residual_filter,
    robust_variance,
)
from foamfit.text import counted, engineering, percent

# Spikes
_RARE = 0.005  # probability that white noise alone shows an outlier in a record
_ALONE = 2.5  # the same in standard deviations of its neighbours' residuals (large at a kink)
_LEAST = 5e-3  # least residual of an outlier, as a share of the range
_MOST = 0.02  # share of the samples: if more stand out, none is an outlier
_FEWEST = 30  # samples of a record in which outliers can be found
_WIDTH, _HALF = 9, 4  # samples of a local cubic, and on either side of its middle
PAUSE = 6.0  # a longer step, in usual steps, is a pause
# Values for missing ones
_FAR = 2.0  # least step to them, as a multiple of the largest step between other samples
# Short gaps
_JUMP, _NEARBY = 10.0, 31  # least jump at both ends, in median jumps of this many samples
_MAX_RUN = 5  # longest gap, samples
# Clipped force
_FLAT = 5  # least number of equal samples at the top
_PARABOLA = 3  # digitiser steps that a parabola falls within half the flat length on either side
# Stuck gauge
_STEPS, _SAMPLES = 4, 8  # shortest standstill, in readings of the gauge and in samples
_LEAP, _ABOVE_NOISE, _DIGITS = 0.003, 12.0, 2.5  # least jump: of range, noise, digitiser steps
_LONGEST = 3  # most samples that a jump takes
_GOES_ON = 0.75  # after the jump the motion continues by less than this share of the jump
_STANDS, _SCATTER = 0.1, 5.0  # most motion while stuck: share of the jump plus multiple of noise
_NEAR = 0.02  # distance from the final level, as a share of the jump, at which it is stuck
_CONTACT = 0.1  # least stress in contact, as a share of its range
_CHANGE = 0.005  # least change of stress while the gauge is stuck, likewise
_FELT = 0.004  # least change of stress that a real motion like the jump would cause, likewise
_FOLLOWS = 0.5  # share of that change: if the stress changes more, the jump is real
_AROUND = 3.0  # the stiffness is that over this many jumps on either side


def find_outliers(values: Array, time: Array | None = None) -> Mask:
    """Find spikes and short gaps: isolated samples that do not belong to a smooth noisy signal.

    A gap consists of up to five samples between two opposite jumps of ten times the median jump
    nearby, if the signal changes by less than half as much before, after and across the gap. A
    spike deviates by four standard deviations from the cubic through its eight neighbours, while
    the neighbours are consistent and the lines through either side do not lead to the spike.
    Samples at a pause are not tested, and in a held channel only gaps are found. If more than 2 %
    of the samples stand out, none is an outlier, except those with one value that stands for a
    missing one, such as 9999.
    """
    n = values.size
    if n < _FEWEST:
        return np.zeros(n, dtype=bool)
    least = _LEAST * float(np.ptp(np.quantile(values, (0.005, 0.995))))
    at = np.arange(n, dtype=np.float64) if time is None else time
    wrong = _gaps(values)
    for _ in range(4):  # a large spike hides small ones next to it
        smooth = _bridged(values, wrong, at)
        if is_staircase(smooth):
            break
        found = _spikes(smooth, least, at) & ~wrong
        if not found.any():
            break
        wrong |= found
    if wrong.sum() <= max(_MOST * n, 2):
        return wrong
    missing = _missing(values, wrong)
    rest = _bridged(values, missing, at)
    return missing | find_outliers(rest, time) if missing.any() else missing


def _missing(values: Array, wrong: Mask) -> Mask:
    """Find the `wrong` samples whose value stands for a missing one, if there is such a value.

    It is far from its neighbours, in steps that the other samples do not show; the flanks of
    clipped peaks are such steps. Peaks too short for flanks leave only noise, whose steps scatter
    more than its values.
    """
    one = values == mode(values[wrong].tolist())
    steps, found = np.abs(np.diff(values)), one & wrong
    others, ends = steps[~(one[1:] | one[:-1])], steps[found[1:] != found[:-1]]
    far = np.median(ends) > _FAR * others.max(initial=0.0)
    signal = np.mean(others**2) < np.var(values[~one])
    return found if far and signal else np.zeros(values.size, dtype=bool)


def _bridged(values: Array, wrong: Mask, time: Array) -> Array:
    return np.where(wrong, np.interp(time, time[~wrong], values[~wrong]), values)


def _gaps(values: Array) -> Mask:
    """Find short runs with opposite jumps at both ends."""
    from scipy.ndimage import median_filter

    out = np.zeros(values.size, dtype=bool)
    jump = np.diff(values)
    usual = np.abs(jump)
    floor = float(np.median(usual[usual > 0.0])) if usual.any() else 0.0
    high = np.flatnonzero(usual > _JUMP * np.maximum(median_filter(usual, _NEARBY), floor))
    for start, end in ((i, j) for i in high for j in high[(high > i) & (high <= i + _MAX_RUN)]):
        into, back = jump[start], jump[end]
        # Changes of the signal itself across and next to the gap: a steep peak is not a gap.
        adjacent = *jump[start - 1 : start], *jump[end + 1 : end + 2]
        most = max(np.abs([values[end + 1] - values[start], *adjacent]))
        if into * back < 0.0 and most < 0.5 * min(abs(into), abs(back)):
            out[start + 1 : end + 1] = True
    return out


def _spikes(values: Array, least: float, time: Array) -> Mask:
    """Find samples far from the cubic through their eight neighbours, none of them at a pause."""
    from scipy.ndimage import maximum_filter1d
    from scipy.special import ndtri

    out, weights = np.zeros(values.size, dtype=bool), residual_filter(_WIDTH)[0]
    size = np.abs(np.convolve(values, weights, "valid")) / (own := float(weights[_HALF]))
    steps = sliding_window_view(np.diff(time), _WIDTH - 1)
    size[steps.max(axis=1) > PAUSE * float(np.median(steps))] = 0.0
    most = max(least, -float(ndtri(0.5 * _RARE / values.size)) * robust_variance(size) ** 0.5)
    # A spike also increases the residuals of its neighbours: only the largest of five is one.
    largest = size >= maximum_filter1d(size, 5, mode="constant")
    for i in np.flatnonzero((size > most) & largest):
        y, t = values[i : i + _WIDTH], time[i : i + _WIDTH] - time[i + _HALF]
        cubic, rest, *_ = np.polyfit(np.delete(t, _HALF), np.delete(y, _HALF), 3, full=True)
        off = y[_HALF] - cubic[-1]  # not ± `size` if the clock is uneven
        alone = np.sqrt(rest.sum() / (_WIDTH - 5) / own)
        # The tip of a kink lies on the line through the samples on one side.
        lines = (np.polyfit(t[side], y[side], 1)[1] for side in (slice(1, 4), slice(5, 8)))
        above = min((y[_HALF] - line) * np.sign(off) for line in lines)
        out[i + _HALF] = abs(off) > max(most, _ALONE * alone) and above > 0.5 * abs(off)
    return out


def bridge_outliers(record: Record) -> Record:
    """Replace spikes and short gaps by straight lines; `excess` stores the differences."""
    for name, values in record.curves("velocity", "acceleration").items():
        if name in record.sampled:  # `frames.join` has already checked its frames
            continue
        wrong = find_outliers(values, record.time)
        if wrong.any():
            line = _bridged(values, wrong, record.instants)
            excess = record.excess | {name: np.where(wrong, values - line, 0.0)}
            record = replace(record.changed(name, line), excess=excess)
    return record


def inner_samples(values: Array) -> slice:
    """Return the samples without the few at either end that do not belong to the signal.

    They are outside the range of the others by more than that range, after one jump.
    """
    n, most = values.size, max(_MAX_RUN, int(_MOST * values.size))
    if n < _FEWEST:
        return slice(0, n)
    low, high = float(values[most:-most].min()), float(values[most:-most].max())
    inside = np.flatnonzero(np.abs(values - 0.5 * (low + high)) <= 1.5 * (high - low))

    def strays(ahead: Array, count: int) -> int:
        steps = np.abs(np.diff(ahead[: count + 1]))
        jumps = 0 < count <= most and steps[-1] > _JUMP * steps[:-1].max(initial=0.0)
        return count if jumps else 0

    first, last = int(inside[0]), int(inside[-1])
    return slice(strays(values, first), n - strays(values[::-1], n - 1 - last))


def cut_strays(record: Record) -> Record:
    """Drop rows at either end whose stress or displacement does not belong to the test.

    A stress above the range may belong to the test: the record may start or end at its peak.
    """
    for name in ("stress", "displacement"):
        values = record.channel(name)
        if values is not None:
            stray = np.ones(len(record), dtype=bool)
            stray[inner_samples(values)] = False
            stray &= (values < 0.0) | (name != "stress")
            why = f"the {name} jumps there by more than its range in the rest of the record"
            record = record.without(stray, why)
    return record


def mark_clipped(record: Record) -> Record:
    """Mark the samples of a clipped force: a flat top of equal values with steep flanks.

    The digitised top of a smooth curve has equal samples, too. But it is nearly a parabola, which
    falls by three more digitiser steps within half the length of the flat; a clipped force by more.
    """
    stress = record.stress
    top = float(stress.max())
    at_top = stress >= top - 1e-9 * float(np.ptp(stress))
    starts, lengths = fresh_samples(at_top)
    longest = int(np.argmax(np.where(at_top[starts], lengths, 0)))
    first, length = int(starts[longest]), int(lengths[longest])
    if length < max(_FLAT, 3 * float(np.median(fresh_samples(stress)[1]))):
        return record
    reach = -(-length // 2)
    last = min(first + length - 1 + reach, len(stress) - 1)
    around = stress[max(first - reach, 0)], stress[last]
    levels = np.diff(np.unique(stress))
    step = float(levels[levels > 1e-9 * np.ptp(stress)].min())
    if top - max(around) < 4 * _PARABOLA * step:
        return record
    lines = record.row_numbers[at_top]
    return replace(record, clipped=at_top).noted(
        f"Check: the force is clipped: {lines.size} samples have the same value at its top, a "
        f"stress of {engineering(top, 'Pa')} (rows {lines[0]} to {lines[-1]}); they are not "
        "fitted, the true peak is unknown, and energy and impulse are underestimated."
    )


def outliers_of_blocks(record: Record, block: int) -> dict[str, Outliers]:
    """Return the outliers after averaging: a block is left out if most of its samples are bad."""
    found, none = dict[str, Outliers](), np.zeros(len(record))
    edges = np.arange(0, len(record), block)

    def share(wrong: Mask) -> Array:
        return np.asarray(np.add.reduceat(wrong.astype(float), edges) / block)

    for name, values in record.curves("velocity", "acceleration").items():
        excess, top, clipped = record.excess.get(name, none), None, record.clipped
        at, left_out = np.flatnonzero(excess), share(excess != 0.0) > 0.5
        if name == "displacement":
            left_out |= share(record.stood_still) > 0.5
        if name == "stress" and clipped is not None and clipped.any():
            left_out, top = left_out | (share(clipped) > 0.0), float(values.max())
        if at.size or left_out.any():
            found[name] = Outliers(left_out, record.instants[at], (values + excess)[at], top)
    return found


def notes_on(record: Record, spikes: dict[str, int], found: dict[str, Outliers]) -> list[str]:
    """Return notes on spikes and gaps (`spikes`: count, `found`: in the used part), standstills."""
    notes = []
    for name, count in spikes.items():
        note = f"Check: {counted(count, 'sample')} of the {name} stood out as spikes or gaps and"
        outliers = found.get(name)
        if outliers is None or not outliers.at.size:
            notes.append(f"{note} were bridged, none of them in the part that is used.")
            continue
        shown, used = list[str](), outliers.at.size
        for at, value in zip(outliers.at[:4], outliers.values[:4], strict=True):
            where = f"sample {at:.0f}" if record.time is None else engineering(at, "s")
            shown.append(f"{engineering(value, UNITS.get(name, 'm'))} at {where}")
        more = f" and {used - 4} more" if used > 4 else ""
        part = "" if used == count else f", {used} of them in the part that is used"
        notes.append(f"{note} are not fitted{part}: {', '.join(shown)}{more}.")
    return notes + [note for note, rows in record.standstills.items() if rows.any()]


def fresh_samples(values: NDArray[Any]) -> tuple[Integers, Integers]:
    """Return the samples with a new value, and the number of samples that each is held."""
    fresh = np.append(0, np.flatnonzero(np.diff(values) != 0) + 1)
    return fresh, np.diff(np.append(fresh, len(values)))


def is_staircase(values: Array) -> bool:
    """Return whether most samples repeat the previous one, and not for a coarse digitiser."""
    at, lengths = fresh_samples(values)
    if np.median(lengths) < 2:
        return False
    steps, gaps = np.abs(np.diff(values[at])), np.diff(np.unique(values[at]))
    gaps = gaps[gaps > 1e-6 * float(np.ptp(values))]
    return not (gaps.size and np.median(steps) < 1.5 * gaps.min())  # usually by a single step


def fill_staircase(record: Record) -> tuple[Record, dict[str, NoiseLevel]]:
    """Interpolate displacements that are updated less often than the stress.

    Return also the noise of held or interpolated displacements, from fresh samples or frames. Only
    samples with a new value count as measured. A value held for more than three usual steps is a
    real hold, which lasts until one usual step before the next new value.
    """
    time, levels = record.instants, dict[str, NoiseLevel]()
    for name, values in record.curves().items():
        if name in record.sampled:
            frames = values[record.sampled[name]]
            level = estimated_noise(frames, "frames on their own clock")
            levels[name] = replace(level, time=level.time * len(values) / len(frames))
            continue
        fresh, lengths = fresh_samples(values)
        if name == "stress" or len(fresh) < MIN_ROWS or not is_staircase(values):
            continue
        level = estimated_noise(values[fresh], "fresh samples")
        levels[name] = replace(level, time=len(values) / len(fresh))
        step = int(np.median(lengths))
        knots = np.union1d(fresh, (fresh + lengths - step)[lengths > 3 * step])
        label = "The displacement" if name == "displacement" else name
        line = np.interp(time, time[knots], values[knots])
        record = record.interpolated(name, line, knots).noted(
            f"{label} is held for about {step} samples at a time; it is interpolated between the "
            f"{len(fresh)} instants where it is fresh."
        )
    return record, levels


def find_standstills(record: Record) -> list[tuple[int, int]]:
    """Find the intervals in which the gauge of a slow test is stuck and then jumps.

    Return the last good sample before each interval and the first after its jump. The specimen is
    in contact, the stress changes while the gauge is stuck but does not follow the jump, and the
    motion does not continue at the speed of the jump. Call this before `fill_staircase`.
    """
    w, stress, found = record.displacement, record.stress, list[tuple[int, int]]()
    if w is None or len(w) < 4 * _SAMPLES:
        return found
    fresh, lengths = fresh_samples(w)
    noise, step = noise_level(w[fresh]), int(np.median(lengths))
    shortest, size = max(_STEPS * step, _SAMPLES), float(np.ptp(stress))
    low = float(np.quantile(stress, 0.01))
    for after, length in sorted(_jumps(w, noise, step, shortest).items()):
        last = after - length
        if found and last < found[-1][1]:
            continue
        level = float(np.median(w[last - _SAMPLES + 1 : last + 1]))
        near = _NEAR * abs(float(w[after]) - level) + _SCATTER * noise
        moving = np.flatnonzero(np.abs(w[: last + 1] - level) > near)
        before = int(moving[-1]) + 1 if moving.size else 0  # last good sample
        if last + 1 - before < shortest:
            continue
        meanwhile = stress[before : last + 1]
        changed = abs(_change(meanwhile)) >= _CHANGE * size
        loaded = np.median(meanwhile) - low >= _CONTACT * size
        if changed and loaded and not _follows(w, stress, noise, step, before, last, after):
            found.append((before, after))
    return found


def _jumps(w: Array, noise: float, step: int, width: int) -> dict[int, int]:
    """Return the first samples after jumps from a standstill, and the length of each jump."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    n = len(w)
    # The window of sample i ends at sample i.
    shift: Any = {"size": width, "origin": (width - 1) // 2, "mode": "nearest"}
    range_before = maximum_filter1d(w, **shift) - minimum_filter1d(w, **shift)
    least = max(_LEAP * float(np.ptp(w)), _ABOVE_NOISE * noise, _DIGITS * quantum(w))
    found = dict[int, int]()
    for length in range(_LONGEST, 0, -1):  # shorter jumps replace longer ones
        last = np.arange(width - 1, n - length)
        jump = w[last + length] - w[last]
        far = np.abs(jump)
        later = np.minimum(last + length + 2 * max(step, length), n - 1)
        goes_on = (w[later] - w[last + length]) * np.sign(jump) > _GOES_ON * far
        stands = range_before[last] <= _STANDS * far + _SCATTER * noise
        good = (far >= least) & stands & ~goes_on
        found |= dict.fromkeys((last[good] + length).tolist(), length)
    return found


def _change(stress: Array) -> float:
    """Return the final rise or fall of a stress."""
    part = max(stress.size // 4, _SAMPLES // 2)
    mean = np.convolve(stress, np.full(part, 1.0 / part), "valid")
    return max(float(mean[-1] - mean.min()), float(mean[-1] - mean.max()), key=abs)


def _follows(
    w: Array, stress: Array, noise: float, step: int, before: int, last: int, after: int
) -> bool:
    """Return whether the stress follows the jump like a real motion, or this cannot be decided.

    A gauge that is read in steps may show a motion one step late.
    """
    # Use the samples until the displacement leaves the level that it jumped to.
    rest = w[after : after + 3 * max(step, 2)]
    jump = float(rest[0] - np.median(w[before : last + 1]))
    away = np.abs(rest - rest[0]) > 0.25 * abs(jump) + _SCATTER * noise
    window = after + np.arange(int(np.argmax(away)) if away.any() else rest.size)
    end = last + 1 - (step if step > 1 else 0)
    fitted = np.arange(min((before + end) // 2, end - 5), end)
    ahead = np.polyval(np.polyfit(fitted, stress[fitted], 1), window.mean())
    slopes = []  # stiffnesses before and after, Pa/m; the smaller one is used
    for sides in (slice(before, None, -1), slice(after, None)):
        motion, force = w[sides], stress[sides]
        far = int(np.argmax(np.abs(motion - motion[0]) >= _AROUND * abs(w[after] - w[before])))
        if far:
            change = float(force[far : far + 5].mean() - force[:5].mean())
            slopes.append(change / float(motion[far] - motion[0]))
    expected = max(min(slopes, default=0.0), 0.0) * abs(jump)
    change = float(stress[window].mean() - ahead) * np.sign(jump)
    return bool(expected < _FELT * float(np.ptp(stress)) or change > _FOLLOWS * expected)


def bridge_standstills(record: Record, found: list[tuple[int, int]], height: float) -> Record:
    """Replace a stuck displacement by the straight line to the first sample after the jump."""
    if record.displacement is None or not found:
        return record
    w, time, numbers = record.displacement.copy(), record.instants, record.row_numbers
    standstills = dict[str, Mask]()
    for before, after in found:
        stress = record.stress[before:after]
        change = _change(stress) / float(np.abs(stress).max())
        jump, inside, ends = w[after] - w[before], slice(before + 1, after), [before, after]
        w[inside] = np.interp(time[inside], time[ends], w[ends])
        note = (
            f"Check: the displacement stands still in rows {numbers[before + 1]} to "
            f"{numbers[after - 1]} while the stress {'rises' if change > 0.0 else 'falls'} by "
            f"{percent(abs(change))}, then jumps by {percent(abs(jump) / height)} strain, which "
            "the stress does not follow: play of the gauge; it is bridged by a straight line."
        )
        standstills[note] = np.zeros(len(w), dtype=bool)
        standstills[note][inside] = True
    return replace(record, displacement=w, standstills=standstills)
