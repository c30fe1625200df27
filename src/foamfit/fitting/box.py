"""The coordinates of the search, a box in which every point is an admissible chain, and its starts.

The record of a law defines the coordinate of each parameter: its logarithm, its ratio to a scale of
the test, or its position between two ends that depend on other parameters. The coordinate of a
nuisance parameter runs between its limits.

Start values are springs read off the measured loop, and points all over the box.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter
from scipy.stats import qmc

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of, find_turns
from foamfit.data.measurement import Measurement
from foamfit.fitting import nuisance
from foamfit.springs.laws.record import Between, Law, Loop, Param
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, any_param, family, split_name

# Sets the parameters that depend on others through expressions, in place, in a vector (n,) or in
# each column (n, m).
Tied = Callable[[Array], Array]
NUISANCE_BOX = (-1.0, 1.0)  # coordinates of nuisance parameters at their two limits
_TENTHS = np.linspace(0.1, 1.0, 10)  # of the largest motion; the fastest is the rate of a ramp
_RAMPS = 20  # ramps under load up to which the least relaxation time is that of its scale
LOOP_SAMPLES = 300
CURVE_STARTS, BOX_STARTS = 300, 100
IN_SERIES = -1  # way to read a loop whose kinks are those of springs in series
OWN_MARKS = 5  # random numbers per spring; further ones that a law needs are appended
# Range of random start values of nuisance parameters, and of the time shift.
NEAR_USUAL, LATE = (-0.05, 0.05), (-0.3, 0.3)
# Strength of relaxation terms that are new to a fitted model, and their times, as shares of the
# time under load.
WEAK, CARRIED_TIMES = 0.05, (0.01, 0.1, 0.5)


def is_logarithmic(short: str) -> bool:
    """Return whether the coordinate of a parameter is its logarithm."""
    return short not in NUISANCE and any_param(short).is_logarithmic


@dataclass(frozen=True)
class Scales:
    """Scales of a test, which make its parameters dimensionless."""

    stress: float  # Largest stress, Pa
    strain: float  # Largest overall strain
    rate: float  # Typical strain rate, 1/s; 0 without time
    height: float  # m
    # Factor, at most 1, of the least relaxation time: its scale is the time under load, beside
    # which a ramp before a long hold or rest is short.
    least_time: float = 1.0

    @classmethod
    def of(cls, measurement: Measurement) -> Scales:
        """Return the scales of a test with stress and, if known, displacement."""
        height = measurement.specimen.height
        strain = 0.5
        if measurement.displacement is not None:
            strain = min(max(float(np.max(measurement.displacement)) / height, 1e-6), 0.999)
        rate, least = 0.0, 1.0
        if (time := measurement.time) is not None:
            loaded = time[measurement.stress > 0.02 * np.max(measurement.stress)]
            lasts = max(float(np.ptp(loaded)), 1e-300) if loaded.size > 1 else math.inf
            rate = 2.0 * strain / lasts
            if (motion := measurement.displacement) is not None:
                steps = [int(np.argmax(motion >= s * motion.max())) for s in _TENTHS]
                gaps = np.maximum(np.diff(time[steps]), np.diff(time).min())
                least = min(1.0, _RAMPS * 10.0 * float(gaps.min()) / lasts)
        return cls(float(np.max(measurement.stress)), strain, rate, height, least)

    def least(self, param: Param) -> float:
        """Return the factor of the lower limit of a parameter, below 1 for relaxation times."""
        return self.least_time if param.scale == "duration" and param.is_logarithmic else 1.0

    @property
    def slope(self) -> float:
        """Largest stress divided by largest strain, Pa."""
        return self.stress / self.strain

    @property
    def eta(self) -> float:
        """Damping that would carry the whole stress at the typical rate, Pa·s."""
        return self.stress / self.rate if self.rate > 0.0 else 1.0

    @property
    def duration(self) -> float:
        """Time under load, s; 1 without time."""
        return 2.0 * self.strain / self.rate if self.rate > 0.0 else 1.0

    def unit(self, scale: str) -> float:
        """Return a scale by the name that `springs.laws.record.Param` gives it."""
        return 1.0 if scale == "one" else float(getattr(self, scale.replace("damping", "eta")))

    def of_parameter(self, model: Model, name: str, values: dict[str, float]) -> float:
        """Return the scale of a parameter, in its unit: what its relative change is divided by."""
        if name in nuisance.POSITIVE:
            return abs(values[name])
        if name in NUISANCE:  # a hundredth of the largest value of a channel, or of the duration
            largest = {
                "stress_zero": self.stress,
                "displacement_zero": self.strain * self.height,
                "acceleration_zero": self.height / self.duration**2,
            }
            return 0.01 * largest.get(name, self.duration)
        param = model.param(name)
        if not param.least_size:
            return abs(values[name]) or 1.0
        unit = self.unit(param.scale)
        if isinstance(param.coordinate, Between) and param.scale != "one":
            first, last = param.coordinate.ends(*others(name, param, values))
            unit = abs(last - first)
        return max(abs(values[name]), param.least_size * unit)


def others(name: str, param: Param, values: dict[str, float]) -> list[float]:
    """Return the values of the parameters of the same spring that a parameter depends on."""
    prefix = name.partition("_")[0]
    return [values[f"{prefix}_{short}"] for short in param.of]


# Order of the coordinates that all springs have; they follow those of the law.
COMMON_ORDER = ("g", "tau", "eta", "height")


class Coordinate(NamedTuple):
    """One coordinate: the index of its parameter in the vector, and the transform between them.

    It is the logarithm of the parameter divided by the second of its `ends` (SI), or the position
    between the ends, 0 to 1. The ends may depend on the parameters with the indices `of`.
    """

    place: int
    short: str
    param: Param | None  # None for nuisance parameters and absolute coordinates
    limits: tuple[float, float]
    bounds: tuple[float, float]  # of the parameter, SI
    ends: tuple[float, float] | Between
    of: tuple[int, ...] = ()
    is_logarithmic: bool = False

    def ends_at(self, values: Array | list[float]) -> tuple[float, float]:
        """Return the values of the parameter at the coordinates 0 and 1 (if not logarithmic)."""
        if isinstance(self.ends, Between):
            return self.ends.ends(*[float(values[place]) for place in self.of])
        return self.ends


@dataclass(frozen=True, eq=False)
class Space:
    """The box of the search, and the transforms between it and the vector of parameters."""

    model: Model
    names: tuple[str, ...]  # All parameters: those of the springs, then the nuisance parameters
    scales: Scales
    values: Array  # (n,): Values of the fixed parameters, SI; the others are ignored
    free: tuple[str, ...]  # Names of the parameters that vary
    low: Array  # (n,): Lower limit of every parameter, SI
    high: Array  # (n,): Upper limit of every parameter, SI
    tied: Tied | None
    # Parameters whose coordinate is their SI value, so that several tests can share it. Not every
    # point of the box is admissible then.
    absolute: tuple[str, ...] = ()

    @cached_property
    def coordinates(self) -> list[Coordinate]:
        """One coordinate per varied parameter, each after those that it depends on."""
        out, index = [], {name: i for i, name in enumerate(self.names)}
        for name in sorted(self.free, key=self._rank):
            at = index[name]
            low, high = float(self.low[at]), float(self.high[at])
            if name in self.absolute:
                out.append(Coordinate(at, name, None, (low, high), (low, high), (0.0, 1.0)))
            elif name in NUISANCE:
                ends = 0.5 * (low + high), high
                out.append(Coordinate(at, name, None, NUISANCE_BOX, (low, high), ends))
            else:
                param, prefix = self.model.param(name), name.partition("_")[0]
                of = tuple(index[f"{prefix}_{short}"] for short in param.of)
                ends = 0.0, self.scales.unit(param.scale)
                between = param.coordinate if isinstance(param.coordinate, Between) else ends
                short = split_name(name)[1]
                log, bounds, (least, most) = param.is_logarithmic, (low, high), param.limits
                limits = least + math.log(self.scales.least(param)), most
                out.append(Coordinate(at, short, param, limits, bounds, between, of, log))
        return out

    def _rank(self, name: str) -> int:
        """Return the rank of a coordinate: parameters of the law in its order, then all others."""
        spring, short = split_name(name)
        own = self.model.laws[spring].search_order if spring >= 0 else ()
        if short in own:
            return own.index(short)
        rest = (*COMMON_ORDER, *NUISANCE)
        return 1000 + rest.index(family(short))

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates, (n_free,) each."""
        limits = np.array([one.limits for one in self.coordinates])
        low, high = np.reshape(limits, (-1, 2)).T.copy()
        return low, high

    def encode(self, values: Array) -> Array:
        """Return the coordinates of a vector of parameters, moved into the box."""
        out = np.empty(len(self.coordinates))
        for j, one in enumerate(self.coordinates):
            first, last = one.ends_at(values)
            if one.is_logarithmic:
                out[j] = np.log(max(values[one.place], 1e-300) / last)
            else:
                out[j] = (values[one.place] - first) / (last - first)
        low, high = self.box
        margin = 1e-9 * (high - low)
        return np.clip(out, low + margin, high - margin)

    def decode(self, point: Array) -> Array:
        """Return the vector of parameters (SI) at a point of the box."""
        own, parts = self.values.tolist(), point.copy()
        logarithmic = np.array([one.is_logarithmic for one in self.coordinates], dtype=bool)
        np.exp(point, out=parts, where=logarithmic)
        for part, one in zip(parts.tolist(), self.coordinates, strict=True):
            (first, last), (least, most) = one.ends_at(own), one.bounds
            own[one.place] = min(max(first + part * (last - first), least), most)
        return self.complete(np.array(own))

    def complete(self, values: Array) -> Array:
        """Set the parameters of a vector that depend on others through expressions."""
        return values if self.tied is None else self.tied(values)

    def slopes(self, point: Array, values: Array) -> Array:
        """Return the derivative of the parameters by the coordinates, (n_values, n_free).

        `values` is the decoded `point`.
        """
        moves, own = np.zeros((values.size, point.size)), values.tolist()
        for j, (part, one) in enumerate(zip(point.tolist(), self.coordinates, strict=True)):
            if one.is_logarithmic:
                moves[one.place, j] = own[one.place]
                continue
            (first, last), (least, most) = one.ends_at(own), one.bounds
            if not least <= first + part * (last - first) <= most:
                continue
            moves[one.place, j] = last - first
            if isinstance(one.ends, Between):
                by = one.ends.slopes(*[own[place] for place in one.of])
                for place, (first_by, last_by) in zip(one.of, by, strict=True):
                    moves[one.place] += (first_by + part * (last_by - first_by)) * moves[place]
        if self.tied is None:
            return moves
        return follow(self.tied, values, moves, np.full(point.size, 1e-5))


def follow(tied: Tied, values: Array, moves: Array, steps: Array) -> Array:
    """Complete moves (n_values, m) of the parameters by those of dependent parameters.

    They are central differences of the expressions with `steps` (m,); nothing is simulated.
    """
    way = steps * moves
    out = (tied(values[:, None] + way) - tied(values[:, None] - way)) / (2.0 * steps)
    return np.where(moves != 0.0, moves, out)  # independent parameters keep exact moves


# ---------------------------------------------------------------- starts


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
        if late := at.get(nuisance.TIME_SHIFT, 0.0):
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
        else LATE if one.short == nuisance.TIME_SHIFT else NEAR_USUAL
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
    pairs = product(minima, times)
    return [_carried_one(space, below, values, sources, share) for values, share in pairs]


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
