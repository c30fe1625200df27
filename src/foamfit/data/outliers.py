"""Samples to leave out: spikes, short gaps, a clipped force, a gauge that stands still.

A sample is judged by its neighbours, not by a model. A gauge that stands still while the stress
changes, and then jumps, has play where the motion turns round, or a display that is not renewed
there. A true hold ends otherwise: the motion goes on smoothly from where it stood, and the stress
follows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from foamfit.arrays import Array, Integers, Mask
from foamfit.data.measurement import MIN_ROWS, NoiseLevel, Outliers, Record
from foamfit.data.noise import estimated_noise, noise_level, quantum, robust_variance
from foamfit.text import counted, engineering, percent

# An outlier is off by so many standard deviations of its leave-one-out residual, and by so many of
# the residuals of its neighbours without it (at a kink they are off too).
_OFF, _ALONE = 4.0, 2.5
_LEAST = 5e-3  # of the range: what is less far off is no outlier
_MOST = 0.02  # of the samples: if more stand out, none is an outlier
# A gap begins and ends with a jump of so many times the median jump nearby; its longest, samples.
_JUMP, _NEARBY, _MAX_RUN = 10.0, 31, 5
_WIDTH, _HALF = 9, 4  # samples of a cubic, and on either side of its middle
# Share by which the steps of even samples differ at most; usual steps that make a pause; least
# leverage that the neighbours of a sample must have for it to be judged.
_EVEN, _PAUSE, _OPEN = 0.02, 6.0, 0.1
_CHUNK = 50_000
# A force may be clipped where so many samples are equal at its top; a parabola falls by so many
# steps of its digits within half that length on either side.
_FLAT, _PARABOLA = 5, 3
_STEPS, _SAMPLES = 4, 8  # a gauge stands still for at least so many of its readings, and samples
# A jump is at least this share of the range, so many deviations of the noise and so many steps of
# the digitiser; it takes so many samples at most; then the motion goes on by less than a share.
_LEAP, _ABOVE_NOISE, _DIGITS, _LONGEST, _GOES_ON = 0.003, 12.0, 2.5, 3, 0.75
# A gauge that stands moves by less than this share of its jump, and so many deviations of the
# noise; it stands as soon as it is so near its level.
_STANDS, _SCATTER, _NEAR = 0.1, 5.0, 0.02
# Shares of the range of the stress: least stress of a specimen in contact, least change while the
# gauge stands, and least change that a motion as large as the jump would cause.
_CONTACT, _CHANGE, _FELT = 0.1, 0.005, 0.004
# The stress follows by less than this share of that change, and what is missing is so many standard
# errors. The stiffness is taken over so many jumps on either side.
_FOLLOWS, _SURE, _AROUND = 0.5, 3.0, 3.0


def find_outliers(values: Array, time: Array | None = None) -> Mask:
    """Isolated samples that cannot belong to a smooth signal with this noise: spikes and gaps.

    Gaps are up to five samples between two opposite jumps of ten times the median jump nearby,
    before and after which the signal changes by less than half as much. A spike is off the cubic
    through its eight neighbours by four standard deviations, while these agree among themselves and
    the lines from either side do not lead to it. Samples across a pause are not judged, and of a
    held channel only gaps are found. If more than 2 % stand out, none is an outlier.
    """
    n = values.size
    if n < 30:
        return np.zeros(n, dtype=bool)
    least = _LEAST * float(np.ptp(np.quantile(values, (0.005, 0.995))))
    even, at = True, np.arange(n, dtype=np.float64)
    if time is not None:  # are its steps equal, or so nearly that the values hardly differ by it?
        step = np.diff(time)
        off = float(np.abs(step / np.median(step) - 1.0).max())
        differ = off * float(np.quantile(np.abs(np.diff(values)), 0.99))
        even = off <= _EVEN or differ < 0.1 * least
        at = at if even else time
    weights = _weights(at, even)
    wrong = _gaps(values, at)
    for _ in range(4):  # beside a large spike a small one is found later
        smooth = _bridged(values, wrong, at)
        if is_staircase(smooth):
            break
        found = _spikes(smooth, least, at, weights) & ~wrong
        if not found.any():
            break
        wrong |= found
    return wrong if wrong.sum() <= max(_MOST * n, 2) else np.zeros(n, dtype=bool)


def _bridged(values: Array, wrong: Mask, time: Array) -> Array:
    """Replace samples by the straight line between those around them."""
    return np.where(wrong, np.interp(time, time[~wrong], values[~wrong]), values)


def _gaps(values: Array, time: Array) -> Mask:
    """Short runs into which the signal jumps and out of which it jumps back."""
    from scipy.ndimage import median_filter

    out = np.zeros(values.size, dtype=bool)
    jump, step = np.diff(values), np.diff(time)
    # In a step of time that is longer than usual the signal itself may go farther.
    usual = np.abs(jump) / np.maximum(step / median_filter(step, _NEARBY), 1.0)
    floor = float(np.median(usual[usual > 0.0])) if usual.any() else 0.0
    high = np.flatnonzero(usual > _JUMP * np.maximum(median_filter(usual, _NEARBY), floor))
    for start, end in ((i, j) for i in high for j in high[(high > i) & (high <= i + _MAX_RUN)]):
        there, back = jump[start], jump[end]
        # What the signal itself changes, also just before and after: a steep peak is no gap.
        beside = *jump[start - 1 : start], *jump[end + 1 : end + 2]
        most = max(np.abs([values[end + 1] - values[start], *beside]))
        if there * back < 0.0 and most < 0.5 * min(abs(there), abs(back)):
            out[start + 1 : end + 1] = True
    return out


def _spikes(values: Array, least: float, time: Array, weights: Array) -> Mask:
    """Samples that the cubic through their eight neighbours does not expect; see `_weights`."""
    from scipy.ndimage import maximum_filter1d

    out, own = np.zeros(values.size, dtype=bool), weights[:, _HALF]
    residual = np.einsum("ws,ws->w", weights, sliding_window_view(values, _WIDTH)) / np.where(
        own, own, 1.0
    )
    usual = np.sqrt(robust_variance(residual * np.sqrt(own)) / np.where(own, own, 1.0))
    off, own = np.abs(residual), np.broadcast_to(own, residual.shape)
    # Beside a spike the cubic is off too: only the farthest of five is one.
    farthest = off >= maximum_filter1d(off, 5, mode="constant")
    for i in np.flatnonzero((off > np.maximum(_OFF * usual, least)) & farthest):
        y, t = values[i : i + _WIDTH], time[i : i + _WIDTH] - time[i + _HALF]
        rest = np.polyfit(np.delete(t, _HALF), np.delete(y, _HALF), 3, full=True)[1][0]
        alone = np.sqrt(rest / (_WIDTH - 5) / own[i])
        # The tip of a kink is where the line from one of its sides leads.
        lines = (np.polyfit(t[side], y[side], 1)[1] for side in (slice(1, 4), slice(5, 8)))
        beside = min((y[_HALF] - line) * np.sign(residual[i]) for line in lines)
        out[i + _HALF] = off[i] > _ALONE * alone and beside > 0.5 * off[i]
    return out


def _weights(time: Array, even: bool) -> Array:
    """Weights (windows, samples) of "sample minus local cubic", one window if all are the same.

    They are zero where the window spans a pause, or where only its middle sample fixes the cubic.
    """
    windows = sliding_window_view(time, _WIDTH)[: 1 if even else None]
    weights = np.empty(windows.shape)
    for first in range(0, len(windows), _CHUNK):  # all at once would take much memory
        x = windows[first : first + _CHUNK] - windows[first : first + _CHUNK, [_HALF]]
        powers = (x / np.abs(x).max(axis=1, keepdims=True))[:, :, None] ** np.arange(4)
        at_middle = np.linalg.solve(powers.swapaxes(1, 2) @ powers, np.eye(4)[:, :1])
        weights[first : first + _CHUNK] = -(powers @ at_middle)[:, :, 0]
    weights[:, _HALF] += 1.0
    step = np.diff(time)
    pause = sliding_window_view(step, _WIDTH - 1).max(axis=1) > _PAUSE * float(np.median(step))
    unjudged = pause | (weights[:, _HALF] < _OPEN)
    return np.where(unjudged[:, None], 0.0, weights) if unjudged.any() else weights


def bridge_outliers(record: Record) -> Record:
    """Replace spikes and short gaps by a straight line; `excess` keeps what the file has there."""
    for name, values in record.curves("velocity", "acceleration").items():
        if name in record.sampled:  # interpolated between frames, which have been looked through
            continue
        wrong = find_outliers(values, record.time)
        if wrong.any():
            line = _bridged(values, wrong, record.instants)
            excess = record.excess | {name: np.where(wrong, values - line, 0.0)}
            record = replace(record.changed(name, line), excess=excess)
    return record


def mark_clipped(record: Record) -> Record:
    """Find the samples at which the force is clipped: a flat top at one value, with steep flanks.

    A rounded top of a smooth curve has equal samples too, but is nearly a parabola, which falls by
    three more steps of the digits within half the length of the flat; a clipped force by more.
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
        f"Check: the force is clipped: {lines.size} samples have one and the same value at its "
        f"top, a stress of {engineering(top, 'Pa')} (rows {lines[0]} to {lines[-1]}); they are not "
        "fitted, the true peak is not known, and energy and impulse come out too small."
    )


def outliers_of_blocks(record: Record, block: int) -> dict[str, Outliers]:
    """Outliers of blocks of samples: a block of them is left out, one in a block is not."""
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
    """Count the `spikes` and gaps of each channel; name those of the used part and standstills."""
    notes = []
    for name, count in spikes.items():
        note = f"Check: {counted(count, 'sample')} of the {name} stood out as spikes or gaps and"
        one = found.get(name)
        if one is None or not one.at.size:
            notes.append(f"{note} were bridged, none of them in the part that is used.")
            continue
        unit = {"stress": "Pa", "velocity": "m/s", "acceleration": "m/s²"}.get(name, "m")
        told, used = list[str](), one.at.size
        for at, value in zip(one.at[:4], one.values[:4], strict=True):
            where = f"sample {at:.0f}" if record.time is None else engineering(at, "s")
            told.append(f"{engineering(value, unit)} at {where}")
        more = f" and {used - 4} more" if used > 4 else ""
        part = "" if used == count else f", {used} of them in the part that is used"
        notes.append(f"{note} are not fitted{part}: {', '.join(told)}{more}.")
    return notes + [note for note, rows in record.standstills.items() if rows.any()]


def fresh_samples(values: Array | Mask) -> tuple[Integers, Integers]:
    """Samples at which a value is new, and for how many samples each is held."""
    fresh = np.append(0, np.flatnonzero(np.diff(values) != 0) + 1)
    return fresh, np.diff(np.append(fresh, len(values)))


def is_staircase(values: Array) -> bool:
    """Whether most samples repeat the one before."""
    return bool(np.median(fresh_samples(values)[1]) >= 2)


def noise_of_held(record: Record) -> dict[str, NoiseLevel]:
    """Noise of displacements from their fresh samples, or from the frames of their own clock."""
    levels = {}
    for name, values in record.curves().items():
        if name in record.sampled:
            frames = values[record.sampled[name]]
            level = estimated_noise(frames, "frames on their own clock")
            levels[name] = replace(level, time=level.time * len(values) / len(frames))
        elif name != "stress" and is_staircase(values):
            fresh = values[fresh_samples(values)[0]]
            if len(fresh) >= MIN_ROWS:
                level = estimated_noise(fresh, "fresh samples")
                levels[name] = replace(level, time=len(values) / len(fresh))
    return levels


def fill_staircase(record: Record) -> Record:
    """Interpolate displacements that are held while the stress changes.

    The instants at which a value is new are kept, and only these count as measured. A hold of more
    than three usual steps is real: it lasts until one usual step before the next new value.
    """
    time = record.instants
    for name, values in record.curves().items():
        fresh, lengths = fresh_samples(values)
        step = int(np.median(lengths))
        if name == "stress" or name in record.sampled or len(lengths) < MIN_ROWS or step < 2:
            continue
        knots = np.union1d(fresh, (fresh + lengths - step)[lengths > 3 * step])
        shown = "The displacement" if name == "displacement" else name
        line = np.interp(time, time[knots], values[knots])
        record = record.interpolated(name, line, knots).noted(
            f"{shown} is held for about {step} samples at a time; it is interpolated between the "
            f"{len(fresh)} instants where it is fresh."
        )
    return record


def find_standstills(record: Record) -> list[tuple[int, int]]:
    """Find where the gauge of a slow test stands still and then jumps.

    Returns the last sample before each stretch and the first after its jump. Meanwhile the specimen
    is in contact and its stress changes, but the stress does not follow the jump, and the motion
    does not go on with it. A displacement held at each reading must not be interpolated yet.
    """
    w, stress, found = record.displacement, record.stress, list[tuple[int, int]]()
    if w is None or len(w) < 4 * _SAMPLES:
        return found
    fresh, lengths = fresh_samples(w)
    noise, step = noise_level(w[fresh]), int(np.median(lengths))
    shortest = max(_STEPS * step, _SAMPLES)
    size, low = float(np.ptp(stress)), float(np.quantile(stress, 0.01))
    for after, length in sorted(_jumps(w, noise, step, shortest).items()):
        last = after - length
        if found and last < found[-1][1]:
            continue
        level = float(np.median(w[last - _SAMPLES + 1 : last + 1]))
        near = _NEAR * abs(float(w[after]) - level) + _SCATTER * noise
        moving = np.flatnonzero(np.abs(w[: last + 1] - level) > near)
        before = int(moving[-1]) + 1 if moving.size else 0  # there the gauge is still right
        if last + 1 - before < shortest:
            continue
        meanwhile = stress[before : last + 1]
        change, part = _change(meanwhile)
        error = noise_level(meanwhile) * np.sqrt(2.0 / part)
        changed = abs(change) >= max(_CHANGE * size, _SURE * error)
        loaded = np.median(meanwhile) - low >= _CONTACT * size
        if changed and loaded and not _follows(w, stress, noise, step, before, last, after):
            found.append((before, after))
    return found


def _jumps(w: Array, noise: float, step: int, width: int) -> dict[int, int]:
    """First samples after jumps out of a stretch, and how many samples each jump takes."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    n = len(w)
    # The window of sample i ends with it.
    shift: Any = {"size": width, "origin": (width - 1) // 2, "mode": "nearest"}
    range_before = maximum_filter1d(w, **shift) - minimum_filter1d(w, **shift)
    least = max(_LEAP * float(np.ptp(w)), _ABOVE_NOISE * noise, _DIGITS * quantum(w))
    found = dict[int, int]()
    for length in range(_LONGEST, 0, -1):  # the shortest counts
        last = np.arange(width - 1, n - length)
        jump = w[last + length] - w[last]
        far = np.abs(jump)
        later = np.minimum(last + length + 2 * max(step, length), n - 1)
        goes_on = (w[later] - w[last + length]) * np.sign(jump) > _GOES_ON * far
        stands = range_before[last] <= _STANDS * far + _SCATTER * noise
        good = (far >= least) & stands & ~goes_on
        found |= dict.fromkeys((last[good] + length).tolist(), length)
    return found


def _change(stress: Array) -> tuple[float, int]:
    """Rise of a stress from its lowest, or fall from its highest, by means of so many samples."""
    part = max(stress.size // 4, _SAMPLES // 2)
    mean = np.convolve(stress, np.full(part, 1.0 / part), "valid")
    return max(float(mean[-1] - mean.min()), float(mean[-1] - mean.max()), key=abs), part


def _follows(
    w: Array, stress: Array, noise: float, step: int, before: int, last: int, after: int
) -> bool:
    """Whether the stress leaves its trend as if the jump were a motion, or this is unknown.

    A gauge that is read at steps may show a motion a step late.
    """
    # As long as the displacement stays where it jumped to.
    rest = w[after : after + 3 * max(step, 2)]
    jump = float(rest[0] - np.median(w[before : last + 1]))
    away = np.abs(rest - rest[0]) > 0.25 * abs(jump) + _SCATTER * noise
    window = after + np.arange(int(np.argmax(away)) if away.any() else rest.size)
    end = last + 1 - (step if step > 1 else 0)
    fitted = np.arange(min((before + end) // 2, end - 5), end)
    middle = float(fitted.mean())
    slope, level = np.polyfit(fitted - middle, stress[fitted], 1)
    scatter = float(np.std(stress[fitted] - level - slope * (fitted - middle)))
    ahead = float(window.mean()) - middle
    shares = 1.0 / window.size, 1.0 / fitted.size, ahead**2 / np.sum((fitted - middle) ** 2)
    error = max(noise_level(stress[before : last + 1]), scatter) * np.sqrt(sum(shares))
    slopes = []  # the smaller of the stiffnesses before and after counts, Pa/m
    for sides in (slice(before, None, -1), slice(after, None)):
        motion, force = w[sides], stress[sides]
        far = int(np.argmax(np.abs(motion - motion[0]) >= _AROUND * abs(w[after] - w[before])))
        if far:
            change = float(force[far : far + 5].mean() - force[:5].mean())
            slopes.append(change / float(motion[far] - motion[0]))
    expected = max(min(slopes, default=0.0), 0.0) * abs(jump)
    change = (float(stress[window].mean()) - level - slope * ahead) * np.sign(jump)
    return bool(
        expected < _FELT * float(np.ptp(stress))
        or change > _FOLLOWS * expected
        or expected - change < _SURE * error
    )


def bridge_standstills(record: Record, found: list[tuple[int, int]], height: float) -> Record:
    """Draw straight lines from the last sample before each stretch to the first after its jump."""
    if record.displacement is None or not found:
        return record
    w, time, numbers = record.displacement.copy(), record.instants, record.row_numbers
    standstills = dict[str, Mask]()
    for before, after in found:
        stress = record.stress[before:after]
        change = _change(stress)[0] / float(np.abs(stress).max())
        jump, inside, ends = w[after] - w[before], slice(before + 1, after), [before, after]
        w[inside] = np.interp(time[inside], time[ends], w[ends])
        told = (
            f"Check: the displacement stands still in rows {numbers[before + 1]} to "
            f"{numbers[after - 1]} while the stress {'rises' if change > 0.0 else 'falls'} by "
            f"{percent(abs(change))}, then jumps by {percent(abs(jump) / height)} strain, which "
            "the stress does not follow: play of the gauge; it is bridged by a straight line."
        )
        standstills[told] = np.zeros(len(w), dtype=bool)
        standstills[told][inside] = True
    return replace(record, displacement=w, standstills=standstills)
