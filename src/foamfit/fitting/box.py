"""The coordinates of the search: a box in which every point is an admissible chain.

The record of a law defines the coordinate of each parameter: its logarithm, its ratio to a scale of
the test, or its position between two ends that depend on other parameters. The coordinate of a
nuisance parameter runs between its limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.fitting import nuisance
from foamfit.springs.laws.record import Between, Param
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, any_param, family, split_name, unit_of
from foamfit.text import engineering

# Sets the parameters that depend on others through expressions, in place, in a vector (n,) or in
# each column (n, m).
Tied = Callable[[Array], Array]
NUISANCE_BOX = (-1.0, 1.0)  # coordinates of nuisance parameters at their two limits
_TENTHS = np.linspace(0.1, 1.0, 10)  # of the largest motion; the fastest is the rate of a ramp
_RAMPS = 20  # ramps under load up to which the least relaxation time is that of its scale


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


def scale_in_words(name: str, value: float, scale: float) -> str:
    """Return the scale of a parameter in words: its value, or a number with its unit."""
    if math.isclose(scale, abs(value), rel_tol=1e-9):
        return "its value"
    return engineering(scale, unit_of(name))


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
