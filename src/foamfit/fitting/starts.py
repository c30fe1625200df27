"""Start values: springs read off the measured loop, and points all over the box."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from scipy.stats import qmc

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of, find_turns
from foamfit.data.measurement import Measurement
from foamfit.fitting.box import Space
from foamfit.fitting.curves import smoothed
from foamfit.springs.laws.record import Law, Param
from foamfit.springs.loop import Loop

LOOP_SAMPLES = 300
CURVE_STARTS = 300
OWN_MARKS = 5  # random numbers per spring; further ones that a law needs are appended
# Range of random start values of nuisance parameters, and of the time shift.
NEAR_USUAL, LATE = (-0.05, 0.05), (-0.3, 0.3)


def thinned(
    measurement: Measurement, followed: Array | None = None, *, loop: bool = False
) -> Measurement:
    """Return a test with a few hundred of its samples, on which starts are ranked and descend.

    The peaks of stress and motion and the turning points are among them. Each sample is still the
    mean over as many rows of the file. `followed` is the motion
    without its noise, m, if it is known; otherwise the motion of a `loop` is smoothed. A `loop` is
    compared along the motion alone and begins at the contact.
    """
    motion, stress, time = measurement.displacement, measurement.stress, measurement.time
    assert stress is not None
    if followed is not None:
        motion = followed
    elif loop and motion is not None:
        window = max(motion.size // 60, 1) * 2 + 1
        motion = smoothed(motion, window) if window > 3 else motion
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
        time=None if time is None else time[keep], outliers={}, sampled=masks, noise=level,
        block=1 if loop else measurement.block,
        interior={} if loop else {n: one[keep] for n, one in measurement.interior.items()},
        acceleration=None if loop or acceleration is None else acceleration[keep],
    )  # fmt: skip


def curve_starts(space: Space, loop: Measurement, rng: np.random.Generator) -> list[Array]:
    """Return start points read off the measured loop at places from a Latin hypercube.

    Linear springs take a random fraction of the largest displacement; each hysteretic spring is
    read off the remaining loop, at its own random places.
    """
    assert loop.displacement is not None
    assert loop.stress is not None
    model, index, laws = space.model, space.model.index, space.model.laws
    count, relaxing = len(laws), 2 * model.relaxation * sum(law.hysteretic for law in laws)
    more = sum(max(law.wanted_marks - OWN_MARKS, 0) for law in laws if law.hysteretic)
    marks = qmc.LatinHypercube(7 * count + more + relaxing, rng=rng).random(CURVE_STARTS)
    starts, once = [], next(iter(cycles_of(loop).values()), slice(None))
    lines = [law.own == ("k0",) for law in laws]
    ways = range(max(law.ways for law in laws))
    for (turn, mark), way in product(enumerate(marks), ways):
        values = space.values.copy()
        heights = np.full(count, space.scales.height / count)
        if count > 1:
            given = [index[f"s{i}_height"] for i in range(1, count + 1)]
            for i, at in enumerate(given):
                if model.names[at] in space.free:
                    values[at] = heights[i] * (0.3 + 1.4 * mark[7 * i + 5])
            values = space.complete(values)
            heights = np.maximum(values[given], 1e-3 * space.scales.height)
        motion, stress = loop.displacement[once], loop.stress[once]
        for i in range(count):
            if lines[i]:
                share = 10.0 ** (-3.0 + 2.7 * mark[7 * i + 6])
                k0 = heights[i] * space.scales.stress / (share * motion.max())
                values[index[f"s{i + 1}_k0"]] = k0
                motion = motion - heights[i] * stress / k0
        soft = sum(h for h, line in zip(heights, lines, strict=True) if not line)
        left, rest = Loop(motion / (soft or 1.0), stress), iter(mark[7 * count :])
        for i, law in enumerate(laws):
            if lines[i]:
                continue
            extra = [next(rest) for _ in range(max(law.wanted_marks - OWN_MARKS, 0))]
            places = np.append(mark[7 * i : 7 * i + OWN_MARKS], extra)
            own = model.own(i, values)
            if law.read_off is None:
                own[:] = _anywhere(space, law, places)
            elif law.read_in_series is not None and soft > heights[i] and turn % 2:
                own[:] = law.read_in_series(left, places, heights[i] / soft)
            else:
                own[:] = law.read_off(left, places, space.scales, way)
            terms = model.own_places[i] + own.size
            for at in range(terms, terms + 2 * model.relaxation * law.hysteretic, 2):
                values[at] = 10.0 ** (1.5 * next(rest) - 1.5)
                values[at + 1] = space.scales.duration * 10.0 ** (2.0 * next(rest) - 2.5)
        starts.append(space.encode(values))
    return starts


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
    limits = [
        one.param.start_limits if one.param is not None
        else LATE if one.short == "time_shift" else NEAR_USUAL
        for one in space.coordinates
    ]  # fmt: skip
    low, high = np.array(limits).reshape(-1, 2).T
    return list(low + (high - low) * qmc.LatinHypercube(low.size, rng=rng).random(count))
