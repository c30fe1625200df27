"""A displacement gauge that stands still while the stress goes on, and then jumps.

So shows the play of a gauge where a motion turns round, or a display that is not renewed there. A
true hold has another end: the motion goes on smoothly from where it stood, and the stress follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Record, Standstill
from foamfit.data.noise import noise_level
from foamfit.data.outliers import fresh_samples
from foamfit.text import percent

# A gauge stands still for at least so many of the steps in which it is read, and so many samples.
_STEPS, _SAMPLES = 4, 8
# A jump is at least this share of the range, so many deviations of the noise and so many steps of
# the digitiser; it takes so many samples at most, while which no smooth motion goes so far.
_JUMP, _ABOVE_NOISE, _DIGITS, _LONGEST = 0.003, 12.0, 2.5, 3
# While it stands the gauge moves by less than this share of its jump, and so many deviations; it
# stands as soon as it is so near its level.
_STANDS, _SCATTER, _NEAR = 0.1, 5.0, 0.02
# After a jump the motion goes on the same way by less than this share of it.
_GOES_ON = 0.75
# Of the range of the stress: what a specimen in contact bears, by how much the stress changes
# while the gauge stands, and what a motion as large as the jump would change.
_CONTACT, _CHANGE, _FELT = 0.1, 0.005, 0.004
# Of what such a motion would change, the stress changes by less than this share, and what is
# missing is so many standard errors.
_FOLLOWS, _SURE = 0.5, 3.0
# Of a jump: how far the motion goes on either side over which the stiffness is taken.
_AROUND = 3.0


@dataclass(frozen=True)
class _Samples:
    """What is looked at: displacement and stress, the noise of the first, and its reading step."""

    w: Array
    stress: Array
    noise: float
    step: int  # samples

    @property
    def shortest(self) -> int:
        """Samples of a stretch at least."""
        return max(_STEPS * self.step, _SAMPLES)


def find_standstills(record: Record) -> list[tuple[int, int]]:
    """Find where the gauge of a slow test stands still and then jumps.

    Each is the last sample before the stretch and the first after the jump. The displacement stands
    still, with the specimen in contact and a stress that changes, then jumps by more than the
    motion goes on with, and the stress does not follow the jump. Nothing is found where the noise
    or the digitiser's step is too large to tell.

    The displacement is taken as it was recorded: a held one is not yet interpolated.
    """
    w = record.displacement
    if w is None or len(w) < 4 * _SAMPLES:
        return []
    fresh, lengths = fresh_samples(w)
    at = _Samples(w, record.stress, noise_level(w[fresh]), int(np.median(lengths)))
    found = list[tuple[int, int]]()
    for after, length in sorted(_jumps(at).items()):
        last = after - length
        if found and last < found[-1][1]:
            continue
        before = _start(at, last, after)
        if (
            last + 1 - before >= at.shortest
            and _stress_goes_on(at, before, last)
            and not _stress_follows(at, before, last, after)
        ):
            found.append((before, after))
    return found


def _jumps(at: _Samples) -> dict[int, int]:
    """First samples after jumps out of a stretch, and how many samples each jump takes."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    w, n, width = at.w, len(at.w), at.shortest
    # The window of sample i ends with it.
    shift: Any = {"size": width, "origin": (width - 1) // 2, "mode": "nearest"}
    range_before = maximum_filter1d(w, **shift) - minimum_filter1d(w, **shift)
    least = max(_JUMP * float(np.ptp(w)), _ABOVE_NOISE * at.noise, _DIGITS * _digit(w))
    found = dict[int, int]()
    for length in range(_LONGEST, 0, -1):  # the shortest counts
        last = np.arange(width - 1, n - length)
        jump = w[last + length] - w[last]
        far = np.abs(jump)
        later = np.minimum(last + length + 2 * max(at.step, length), n - 1)
        goes_on = (w[later] - w[last + length]) * np.sign(jump)
        good = (
            (far >= least)
            & (range_before[last] <= _STANDS * far + _SCATTER * at.noise)
            & (goes_on <= _GOES_ON * far)
        )
        found |= dict.fromkeys((last[good] + length).tolist(), length)
    return found


def _digit(w: Array) -> float:
    """Step of the digitiser, of which nearly all gaps between the levels are multiples; else 0."""
    gaps = np.diff(np.unique(w))
    gaps = gaps[gaps > 1e-6 * float(np.ptp(w))]
    if not gaps.size:
        return 0.0
    step = float(np.quantile(gaps, 0.1, method="nearest"))  # below it a few that were bridged
    off = np.abs(gaps / step - np.rint(gaps / step))
    return step if float(np.mean(off < 0.05)) > 0.8 else 0.0


def _start(at: _Samples, last: int, after: int) -> int:
    """First sample of the stretch that ends with `last`: the gauge is right there."""
    level = float(np.median(at.w[last - _SAMPLES + 1 : last + 1]))
    off = np.abs(at.w[: last + 1] - level)
    within = _NEAR * abs(float(at.w[after] - level)) + _SCATTER * at.noise
    moving = np.flatnonzero(off > within)
    return int(moving[-1]) + 1 if moving.size else 0


def _stress_goes_on(at: _Samples, before: int, last: int) -> bool:
    """Whether the specimen is loaded while the gauge stands, by a stress that changes."""
    stress = at.stress[before : last + 1]
    size, low = float(np.ptp(at.stress)), float(np.quantile(at.stress, 0.01))
    error = noise_level(stress) * np.sqrt(2.0 / _part(stress))
    return bool(
        np.median(stress) - low >= _CONTACT * size
        and max(map(abs, _changes(stress))) >= max(_CHANGE * size, _SURE * error)
    )


def _part(stress: Array) -> int:
    """Samples over which the stress of a stretch is averaged."""
    return max(stress.size // 4, _SAMPLES // 2)


def _changes(stress: Array) -> tuple[float, float]:
    """By how much a stress has risen from its lowest, and fallen from its highest, in the end."""
    part = _part(stress)
    mean = np.convolve(stress, np.full(part, 1.0 / part), "valid")
    return float(mean[-1] - mean.min()), float(mean[-1] - mean.max())


def _stress_follows(at: _Samples, before: int, last: int, after: int) -> bool:
    """Whether the stress changes as it would by a motion as large as the jump, or this is unknown.

    What it does is compared with its trend while the gauge stood; a gauge that is read at steps may
    show a motion a step late.
    """
    w, stress = at.w, at.stress
    # As long as the displacement stays where it jumped to.
    rest = w[after : after + 3 * max(at.step, 2)]
    jump = float(rest[0] - np.median(w[before : last + 1]))
    away = np.abs(rest - rest[0]) > 0.25 * abs(jump) + _SCATTER * at.noise
    window = after + np.arange(int(np.argmax(away)) if away.any() else rest.size)
    end = last + 1 - (at.step if at.step > 1 else 0)
    fitted = np.arange(min((before + end) // 2, end - 5), end)
    middle = float(fitted.mean())
    slope, level = np.polyfit(fitted - middle, stress[fitted], 1)
    scatter = float(np.std(stress[fitted] - level - slope * (fitted - middle)))
    ahead = float(window.mean()) - middle
    shares = 1.0 / window.size, 1.0 / fitted.size, ahead**2 / np.sum((fitted - middle) ** 2)
    error = max(noise_level(stress[before : last + 1]), scatter) * np.sqrt(sum(shares))
    expected = _stiffness(at, before, after) * abs(jump)
    change = (float(stress[window].mean()) - level - slope * ahead) * np.sign(jump)
    return bool(
        expected < _FELT * float(np.ptp(stress))
        or change > _FOLLOWS * expected
        or expected - change < _SURE * error
    )


def _stiffness(at: _Samples, before: int, after: int) -> float:
    """Smaller of the stiffnesses before and after, Pa/m; 0 where neither is known."""
    far = _AROUND * abs(float(at.w[after] - at.w[before]))
    slopes = []
    for w, stress in (
        (at.w[before::-1], at.stress[before::-1]),
        (at.w[after:], at.stress[after:]),
    ):
        away = int(np.argmax(np.abs(w - w[0]) >= far))
        if away:
            slopes.append(
                float(stress[away : away + 5].mean() - stress[:5].mean()) / float(w[away] - w[0])
            )
    return max(min(slopes, default=0.0), 0.0)


def bridge_standstills(record: Record, found: list[tuple[int, int]]) -> Record:
    """Draw straight lines from the last sample before each stretch to the first after its jump."""
    if record.displacement is None or not found:
        return record
    w, time, numbers = record.displacement.copy(), record.instants, record.row_numbers
    standstills = []
    for before, after in found:
        stress = record.stress[before:after]
        rise, fall = _changes(stress)
        change = (rise if rise > -fall else fall) / float(np.abs(stress).max())
        first, last = int(numbers[before + 1]), int(numbers[after - 1])
        standstills.append(Standstill(first, last, change, float(w[after] - w[before])))
        w[before + 1 : after] = np.interp(
            time[before + 1 : after], time[[before, after]], w[[before, after]]
        )
    return replace(record, displacement=w, standstills=tuple(standstills))


def standstill_notes(record: Record, height: float) -> list[str]:
    """Name the stretches in what is left of a record, by the rows of the file."""
    return [
        f"Check: the displacement stands still in rows {one.first} to {one.last} while the stress "
        f"{'rises' if one.change > 0.0 else 'falls'} by {percent(abs(one.change))}, then jumps by "
        f"{percent(abs(one.jump) / height)} strain, which the stress does not follow: play of the "
        "gauge; it is bridged by a straight line."
        for one in record.standstills
        if one.among(record.row_numbers).any()
    ]


def standstill_spans(record: Record, block: int) -> tuple[tuple[float, float], ...]:
    """First and last instant of each stretch in what is left of a record, s or blocks of samples.

    Blocks are what is left of samples where there are many; without a time they are counted.
    """
    instants = record.instants if record.time is not None else record.instants // block
    there = [instants[one.among(record.row_numbers)] for one in record.standstills]
    return tuple((float(at[0]), float(at[-1])) for at in there if at.size)
