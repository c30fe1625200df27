"""Start values: springs read off the measured loop, and points all over the box."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.signal import savgol_filter
from scipy.stats import qmc

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of, find_turns
from foamfit.data.measurement import Measurement
from foamfit.fitting.box import Space
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.springs.laws.record import Law, Loop, Param
from foamfit.springs.parameters import family, split_name

LOOP_SAMPLES = 300
CURVE_STARTS, BOX_STARTS = 300, 100
IN_SERIES = -1  # way to read a loop whose kinks are those of springs in series
OWN_MARKS = 5  # random numbers per spring; further ones that a law needs are appended
# Range of random start values of nuisance parameters, and of the time shift.
NEAR_USUAL, LATE = (-0.05, 0.05), (-0.3, 0.3)
# Strength of relaxation terms that are new to a fitted model, and their times, as shares of the
# time under load.
WEAK, CARRIED_TIMES = 0.05, (0.01, 0.1, 0.5)


def thinned(
    measurement: Measurement, followed: Array | None = None, *, loop: bool = False
) -> Measurement:
    """Return a test with a few hundred of its samples, on which starts are ranked and descend.

    The peaks of stress and motion and the turning points are among them. Each sample is still the
    mean over as many rows of the file. `followed` is the motion without its noise, m, if it is
    known; otherwise the motion of a `loop` is smoothed. A `loop` is compared along the motion alone
    and begins at the contact.
    """
    motion, stress, time = measurement.displacement, measurement.stress, measurement.time
    if followed is not None:
        motion = followed
    elif loop and motion is not None:
        window = max(motion.size // 60, 1) * 2 + 1
        motion = savgol_filter(motion, window, 2) if window > 3 else motion
    first = int(np.searchsorted(time, 0.0)) if loop and time is not None else 0
    cycles = 1 if measurement.last_cycle is None else 2  # twice the samples for a history
    count = min(stress.size - first, cycles * LOOP_SAMPLES)
    keep = np.linspace(first, stress.size - 1, count).astype(int)
    marks = [int(np.argmax(stress))]
    if motion is not None:
        marks += [int(np.argmax(motion)), *(find_turns(motion) if cycles > 1 else ())]
    keep = np.unique([*keep, *(mark for mark in marks if mark >= first)])
    masks = {name: ~one.left_out[keep] for name, one in measurement.outliers.items()}
    level = replace(measurement.noise, displacement=0.0) if loop else measurement.noise
    acceleration = measurement.acceleration
    return replace(
        measurement, displacement=None if motion is None else motion[keep], stress=stress[keep],
        # Without time the clock still counts the samples of the whole record.
        time=keep.astype(float) if time is None else time[keep], outliers={}, sampled=masks,
        noise=level, block=1 if loop else measurement.block,
        interior={} if loop else {n: one[keep] for n, one in measurement.interior.items()},
        acceleration=None if loop or acceleration is None else acceleration[keep],
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Reading:
    """Reads start points off a measured loop.

    Linear springs take a fraction of the largest displacement; each hysteretic spring is read off
    the remaining loop, at its own places.
    """

    space: Space
    loop: Measurement

    @cached_property
    def _curves(self) -> tuple[Array, Array]:
        """Motion (m) and stress (Pa) of the first cycle, without the delay of the motion."""
        space, loop = self.space, self.loop
        assert loop.displacement is not None
        once, motion = next(iter(cycles_of(loop).values()), slice(None)), loop.displacement
        at = {name: float(value) for name, value in zip(space.names, space.values, strict=True)}
        if late := at.get(TIME_SHIFT, 0.0):
            motion = np.interp(loop.instants + late, loop.instants, motion)
            motion = motion - at["displacement_zero"]
        return motion[once], loop.stress[once]

    @cached_property
    def _whole(self) -> Loop:
        """The loop without linear springs."""
        motion, stress = self._curves
        return Loop(motion / self.space.scales.height, stress)

    @cached_property
    def size(self) -> int:
        """Number of marks of a start."""
        model, laws = self.space.model, self.space.model.laws
        relaxing = 2 * model.relaxation * sum(law.hysteretic for law in laws)
        more = sum(max(law.wanted_marks - OWN_MARKS, 0) for law in laws if law.hysteretic)
        return 7 * len(laws) + more + relaxing

    def start(self, mark: Array, way: int) -> Array:
        """Return the start point at some places, read in one of the ways of a law."""
        space, model, laws = self.space, self.space.model, self.space.model.laws
        values, lines = space.values.copy(), [law.own == ("k0",) for law in laws]
        heights = np.full(len(laws), space.scales.height / len(laws))
        if len(laws) > 1:
            given = [model.index[f"s{i}_height"] for i in range(1, len(laws) + 1)]
            for i, at in enumerate(given):
                if model.names[at] in space.free:
                    values[at] = heights[i] * (0.3 + 1.4 * mark[7 * i + 5])
            values = space.complete(values)
            heights = np.maximum(values[given], 1e-3 * space.scales.height)
        motion, stress = self._curves
        for i in np.flatnonzero(lines).tolist():
            share = 10.0 ** (-3.0 + 2.7 * mark[7 * i + 6])
            k0 = heights[i] * space.scales.stress / (share * motion.max())
            values[model.index[f"s{i + 1}_k0"]] = k0
            motion = motion - heights[i] * stress / k0
        soft = sum(h for h, line in zip(heights, lines, strict=True) if not line)
        left = Loop(motion / (soft or 1.0), stress) if any(lines) else self._whole
        rest = iter(mark[7 * len(laws) :])
        for i, law in enumerate(laws):
            if lines[i]:
                continue
            extra = [next(rest) for _ in range(max(law.wanted_marks - OWN_MARKS, 0))]
            places = np.append(mark[7 * i : 7 * i + OWN_MARKS], extra)
            own = model.own(i, values)
            if law.read_off is None:
                own[:] = _anywhere(space, law, places)
            elif law.read_in_series is not None and soft > heights[i] and way == IN_SERIES:
                places = np.append(places, mark[7 * i + 6])
                own[:] = law.read_in_series(left, places, heights[i] / soft)
            else:
                own[:] = law.read_off(left, places, space.scales, max(way, 0))
            terms = model.own_places[i] + own.size
            for at in range(terms, terms + 2 * model.relaxation * law.hysteretic, 2):
                values[at] = 10.0 ** (1.5 * next(rest) - 1.5)
                values[at + 1] = space.scales.duration * 10.0 ** (2.0 * next(rest) - 2.5)
        return space.encode(values)

    def starts(self, rng: np.random.Generator) -> list[Array]:
        """Return starts at places from a Latin hypercube, read in each possible way in turn."""
        laws = self.space.model.laws
        ways = [*range(max(law.ways for law in laws))]
        if len(laws) > 1 and any(law.read_in_series for law in laws):
            ways.append(IN_SERIES)
        marks = qmc.LatinHypercube(self.size, rng=rng).random(CURVE_STARTS)
        return [self.start(mark, ways[i % len(ways)]) for i, mark in enumerate(marks)]


def _anywhere(space: Space, law: Law, marks: Array) -> Array:
    """Return random parameters of a law that has no `read_off`, from marks in [0, 1]."""
    mark_of = dict(zip(law.search_order, marks, strict=False))

    def chosen(param: Param) -> float:
        low, high = param.start_limits
        u = low + float(mark_of[param.name]) * (high - low)
        if param.of:
            return u
        return space.scales.unit(param.scale) * float(np.exp(u) if param.is_logarithmic else u)

    return np.append(law.assembled(chosen), 0.0)


def box_starts(space: Space, rng: np.random.Generator, count: int) -> list[Array]:
    """Return a Latin hypercube over the inner part of the box, independent of the curves."""
    low, high = inner_part(space)
    return list(low + (high - low) * qmc.LatinHypercube(low.size, rng=rng).random(count))


def inner_part(space: Space) -> Array:
    """Return limits within which start values are drawn, (2, n)."""
    limits = [
        one.param.start_limits if one.param is not None
        else LATE if one.short == TIME_SHIFT else NEAR_USUAL
        for one in space.coordinates
    ]  # fmt: skip
    return np.array(limits).reshape(-1, 2).T


def carried(space: Space, below: Space, minima: Iterable[Array]) -> list[Array]:
    """Return start points from the minima of a model that this one contains.

    Springs are matched from the top. A new linear spring starts short and stiff, new relaxation
    terms are weak, of several times, and other new parameters without effect, so that the curves
    start nearly as those of that fit.
    """
    kinds, was = ([law.word or law.kind for law in one.model.laws] for one in (space, below))
    sources = dict[int, int]()
    for spring in reversed(range(len(kinds))):
        if was and kinds[spring] == was[-1]:
            was.pop()
            sources[spring] = len(was)
    times = CARRIED_TIMES if space.model.relaxation > below.model.relaxation else (1.0,)
    return [
        _carried_one(space, below, values, sources, share)
        for values, share in product(minima, times)
    ]


def _carried_one(
    space: Space, below: Space, values: Array, sources: Mapping[int, int], share: float
) -> Array:
    """Return one of the points of `carried`; `share` is that of the relaxation time."""
    start, index = space.values.copy(), {name: i for i, name in enumerate(below.names)}
    for at, name in enumerate(space.names):
        spring, short = split_name(name)
        source = name if spring < 0 else f"s{sources.get(spring, -1) + 1}_{short}"
        if name not in space.free:
            continue
        if source in index:
            start[at] = values[index[source]]
        elif spring in sources and family(short) in ("g", "tau"):
            start[at] = WEAK if family(short) == "g" else share * space.scales.duration
        elif spring in sources and (neutral := space.model.param(name).neutral) is not None:
            start[at] = neutral
        elif spring >= 0 and spring not in sources:
            start[at] = space.low[at] if short == "height" else 0.1 * space.high[at]
    return space.complete(start)
