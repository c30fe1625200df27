"""Samples that are no measurements: spikes, short gaps, a clipped force, and values that are held.

A sample is judged by its neighbours, not by a model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import MIN_ROWS, NoiseLevel, Outliers, Record
from foamfit.data.noise import estimated_noise, robust_variance
from foamfit.text import counted, engineering

# An outlier is off by this many standard deviations of its leave-one-out residual, and by this
# many of what its neighbours are off when it is gone (at a kink they are off too).
_OFF, _ALONE = 4.0, 2.5
_LEAST = 5e-3  # of the range: what is less far off is no outlier
_MOST = 0.02  # of the samples: if more stand out, they are no exceptions
# A gap is entered and left by a jump so many times the median one of the samples nearby.
_JUMP, _NEARBY, _MAX_RUN = 10.0, 31, 5
_WIDTH, _HALF = 9, 4  # samples of a cubic, and on either side of its middle
_SIDES = [1, 2, 3], [5, 6, 7]  # samples of the lines that lead to its middle
# Samples count as even if their steps differ by this share at most; a pause is so many times the
# usual step; a middle sample is judged if its neighbours hold so much of the cubic.
_EVEN, _PAUSE, _OPEN = 0.02, 6.0, 0.1
_CHUNK = 50_000
# A force may be clipped where so many samples are equal at its top; a parabola falls by so many
# steps of its digits within half that length on either side.
_FLAT, _PARABOLA = 5, 3


def find_outliers(values: Array, time: Array | None = None) -> NDArray[np.bool_]:
    """Isolated samples that no smooth signal with this noise can hold: spikes and gaps.

    Gaps are up to five samples between two opposite jumps of ten times the median jump nearby. Then
    each sample is predicted by the cubic through its eight neighbours: it is an outlier if it is
    off by four standard deviations of that prediction, as seen over the whole record, while the
    neighbours agree among themselves and the lines from either side do not lead to it.

    `values` and `time` have the shape (n,); without a time the samples are evenly spaced. Nothing
    is judged across a pause, and of a channel that is held for some samples at a time only gaps.
    If more than 2 % of the samples stand out, none is an outlier.
    """
    n = values.size
    if n < 30:
        return np.zeros(n, dtype=bool)
    least = _LEAST * float(np.ptp(np.quantile(values, (0.005, 0.995))))
    even = time is None or _is_even(time, values, least)
    at = np.arange(n, dtype=np.float64) if time is None or even else time
    cubics = _cubics(at, even)
    wrong = _gaps(values, at)
    for _ in range(4):  # beside a large spike a small one is found later
        smooth = _bridged(values, wrong, at)
        if is_staircase(smooth):
            break
        found = _spikes(smooth, least, at, *cubics) & ~wrong
        if not found.any():
            break
        wrong |= found
    return wrong if wrong.sum() <= max(_MOST * n, 2) else np.zeros(n, dtype=bool)


def _is_even(time: Array, values: Array, least: float) -> bool:
    """Whether the steps of time are equal, or so nearly that the values hardly differ by it."""
    step = np.diff(time)
    usual = float(np.median(step))
    off = float(np.abs(step - usual).max()) / usual
    return off <= _EVEN or off * float(np.quantile(np.abs(np.diff(values)), 0.99)) < 0.1 * least


def _bridged(values: Array, wrong: NDArray[np.bool_], time: Array) -> Array:
    """Replace samples by the straight line between those around them."""
    return np.where(wrong, np.interp(time, time[~wrong], values[~wrong]), values)


def _gaps(values: Array, time: Array) -> NDArray[np.bool_]:
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
        left = abs(values[end + 1] - values[start])  # what the signal itself has changed
        if there * back < 0.0 and left < 0.5 * min(abs(there), abs(back)):
            out[start + 1 : end + 1] = True
    return out


def _spikes(
    values: Array, least: float, time: Array, weights: Array, own: Array
) -> NDArray[np.bool_]:
    """Samples that the cubic through their eight neighbours does not expect; see `_cubics`."""
    out = np.zeros(values.size, dtype=bool)
    residual = np.einsum("sw,ws->w", weights, _windows(values))
    off = np.abs(residual) / own
    usual = np.sqrt(robust_variance(residual / np.sqrt(own)) / own)
    far = np.flatnonzero(off > np.maximum(_OFF * usual, least))
    near, times = _windows(values)[far], _windows(time)[far]
    basis = _orthonormal(times.T)
    left = near - np.einsum("kw,ksw->ws", np.einsum("ksw,ws->kw", basis, near), basis)
    rest = np.sum(left**2, axis=1) - residual[far] ** 2 / own[far]
    alone = np.sqrt(np.maximum(rest, 0.0) / (_WIDTH - 5) / own[far])
    # Beside a spike the cubic is off too: only the farthest of five is one.
    nearby = _windows(np.pad(off, 2), 5).max(axis=1)
    # The tip of a kink is where the line from one of its sides leads.
    leads = [np.sum(near[:, at] * _line_to_middle(times, at), axis=1) for at in _SIDES]
    beside = np.min((near[:, _HALF] - np.array(leads)) * np.sign(residual[far]), axis=0)
    out[far + _HALF] = (
        (off[far] > _ALONE * alone) & (off[far] >= nearby[far]) & (beside > 0.5 * off[far])
    )
    return out


def _cubics(time: Array, even: bool) -> tuple[Array, Array]:
    """Weights (samples, windows) of "sample minus local cubic", and those of the middle samples.

    They are zero and one where nothing is judged: across a pause, and where the middle sample
    alone holds the cubic.
    """
    windows = _windows(time)[: 1 if even else None]  # even ones are all the same
    weights = np.empty((_WIDTH, len(windows)))
    for first in range(0, len(windows), _CHUNK):  # all at once would take much memory
        basis = _orthonormal(windows[first : first + _CHUNK].T)
        weights[:, first : first + _CHUNK] = -np.einsum("kw,ksw->sw", basis[:, _HALF], basis)
    weights[_HALF] += 1.0
    step = np.diff(time)
    pause = _windows(step, _WIDTH - 1).max(axis=1) > _PAUSE * float(np.median(step))
    unjudged = pause | (weights[_HALF] < _OPEN)
    own = np.where(unjudged, 1.0, weights[_HALF])
    return np.where(unjudged, 0.0, weights) if unjudged.any() else weights, own


def _windows(values: Array, width: int = _WIDTH) -> Array:
    return np.lib.stride_tricks.sliding_window_view(values, width)


def _orthonormal(times: Array) -> Array:
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


def mark_clipped(record: Record) -> tuple[Record, list[str]]:
    """Find the samples at which the force is clipped: a flat top at one value, with steep flanks.

    A top whose values are rounded shows equal samples, too, but it is about a parabola, which falls
    by three more steps of the digits within half the length of the flat; a clipped force by more.
    """
    stress = record.stress
    top = float(stress.max())
    at_top = stress >= top - 1e-9 * float(np.ptp(stress))
    starts, lengths = fresh_samples(at_top)
    longest = int(np.argmax(np.where(at_top[starts], lengths, 0)))
    first, length = int(starts[longest]), int(lengths[longest])
    if length < max(_FLAT, 3 * float(np.median(fresh_samples(stress)[1]))):
        return record, []
    reach = -(-length // 2)
    last = min(first + length - 1 + reach, len(stress) - 1)
    around = stress[max(first - reach, 0)], stress[last]
    levels = np.diff(np.unique(stress))
    step = float(levels[levels > 1e-9 * np.ptp(stress)].min())
    if top - max(around) < 4 * _PARABOLA * step:
        return record, []
    lines = record.row_numbers[at_top]
    note = (
        f"Check: the force is clipped: {lines.size} samples have one and the same value at its "
        f"top, a stress of {engineering(top, 'Pa')} (rows {lines[0]} to {lines[-1]}); they are not "
        "fitted, the true peak is not known, and energy and impulse come out too small."
    )
    return replace(record, clipped=at_top), [note]


def outliers_of_blocks(record: Record, block: int) -> dict[str, Outliers]:
    """Outliers of blocks of samples: a block of them is left out, one in a block is not."""
    found = {}
    edges = np.arange(0, len(record), block)
    for name, excess in record.excess.items():
        values, wrong = record.channel(name), excess != 0.0
        if values is None or not wrong.any():
            continue
        share = np.add.reduceat(wrong.astype(float), edges) / block
        at = np.flatnonzero(wrong)
        found[name] = Outliers(share > 0.5, record.instants[at], values[at] + excess[at])
    still = record.stood_still
    none = np.zeros(0)
    if still.any():
        left_out = np.add.reduceat(still.astype(float), edges) > 0.5 * block
        spikes = found.get("displacement") or Outliers(np.zeros_like(left_out), none, none)
        found["displacement"] = replace(spikes, left_out=spikes.left_out | left_out)
    if record.clipped is not None and record.clipped.any():
        left_out = np.add.reduceat(record.clipped.astype(float), edges) > 0.0
        spikes = found.get("stress") or Outliers(np.zeros_like(left_out), none, none)
        top = float(record.stress[record.clipped].max())
        found["stress"] = replace(spikes, left_out=spikes.left_out | left_out, clipped_at=top)
    return found


def outlier_note(name: str, count: int, found: Outliers | None, timed: bool) -> str:
    """Name a channel's outliers: how many, and where those of the part that is used are."""
    note = f"Check: {counted(count, 'sample')} of the {name} stood out as spikes or gaps and"
    if found is None or not found.at.size:
        return f"{note} were bridged, none of them in the part that is used."
    unit = {"stress": "Pa", "velocity": "m/s", "acceleration": "m/s²"}.get(name, "m")
    told = [
        f"{engineering(value, unit)} at {engineering(at, 's') if timed else f'sample {at:.0f}'}"
        for at, value in zip(found.at[:4], found.values[:4], strict=True)
    ]
    used = found.at.size
    more = f" and {used - 4} more" if used > 4 else ""
    part = "" if used == count else f", {used} of them in the part that is used"
    return f"{note} are not fitted{part}: {', '.join(told)}{more}."


def fresh_samples(
    values: Array | NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples at which a value is new, and for how many samples each is held."""
    fresh = np.append(0, np.flatnonzero(np.diff(values) != 0) + 1)
    return fresh, np.diff(np.append(fresh, len(values)))


def is_staircase(values: Array) -> bool:
    """Whether most samples repeat the one before."""
    return bool(np.median(fresh_samples(values)[1]) >= 2)


def noise_of_held(record: Record) -> dict[str, NoiseLevel]:
    """Noise of the displacements that are held, from the samples where they are fresh.

    That of a channel with a clock of its own is that of its frames.
    """
    levels = {}
    for name, values in record.curves().items():
        if name in record.sampled:
            frames = values[record.sampled[name]]
            level = estimated_noise(frames, "frames on their own clock")
            levels[name] = replace(level, time=level.time * len(values) / len(frames))
            continue
        fresh = values[fresh_samples(values)[0]]
        if name != "stress" and is_staircase(values) and len(fresh) >= MIN_ROWS:
            level = estimated_noise(fresh, "fresh samples")
            levels[name] = replace(level, time=len(values) / len(fresh))
    return levels


def fill_staircase(record: Record) -> tuple[Record, list[str]]:
    """Interpolate displacements that are held while the stress goes on.

    The instants where a value is fresh are kept, and only these count as measured. A hold of more
    than three usual steps is a real one: it lasts until one usual step before the next fresh value.
    """
    notes, time = [], record.instants
    for name, values in record.curves().items():
        fresh, lengths = fresh_samples(values)
        step = int(np.median(lengths))
        if name == "stress" or name in record.sampled or len(lengths) < MIN_ROWS or step < 2:
            continue
        knots = np.union1d(fresh, (fresh + lengths - step)[lengths > 3 * step])
        record = record.changed(name, np.interp(time, time[knots], values[knots]))
        taken = np.zeros(len(values), dtype=bool)
        taken[knots] = True
        record = replace(record, sampled=record.sampled | {name: taken})
        shown = "The displacement" if name == "displacement" else name
        notes.append(
            f"{shown} is held for about {step} samples at a time; it is interpolated between the "
            f"{len(fresh)} instants where it is fresh."
        )
    return record, notes
