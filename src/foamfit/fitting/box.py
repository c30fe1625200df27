"""The coordinates of the search: a box in which every point is an admissible chain.

Logarithms of the stiffnesses, of ε_a, of snap stresses, spreads and relaxation times; the drop
Δσ/σ_a; the places of ε_c between ε_a and one and of ε_* between its least and one; slopes, damping
and shares of relaxation over the scales of the test; nuisance parameters between their limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.fitting import nuisance
from foamfit.springs.law import least_eps_star
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name

LAST_STRAIN = 0.999
# Parameters whose coordinate is a logarithm, besides the relaxation times.
LOGARITHMIC = (
    "k0", "kc", "eps_a", "sigma_plus", "sigma_minus", "spread_plus", "spread_minus"
)  # fmt: skip


def is_share(short: str) -> bool:
    """Whether a parameter is the share g of a relaxation term."""
    return family(short) == "g"


def is_time(short: str) -> bool:
    """Whether a parameter is the time τ of a relaxation term."""
    return family(short) == "tau"


def is_logarithmic(short: str) -> bool:
    """Whether the coordinate of a parameter is its logarithm."""
    return short in LOGARITHMIC or is_time(short)


def family(short: str) -> str:
    """Name of a parameter without the number of its relaxation term: "g1" is "g"."""
    for name in ("g", "tau"):
        if short.startswith(name) and short.removeprefix(name).isdigit():
            return name
    return short


@dataclass(frozen=True)
class Scales:
    """The scales of a test that make its parameters dimensionless."""

    # Largest stress (Pa) and overall strain.
    stress: float
    strain: float
    rate: float  # Typical strain rate, 1/s; 0 where time is unknown
    height: float  # m

    @classmethod
    def of(cls, measurement: Measurement) -> Scales:
        """Scales of a test with stress and, if known, displacement."""
        assert measurement.stress is not None
        height = measurement.specimen.height
        strain = 0.5
        if measurement.displacement is not None:
            strain = min(max(float(np.max(measurement.displacement)) / height, 1e-6), 0.999)
        rate = 0.0
        if measurement.time is not None:
            loaded = measurement.time[measurement.stress > 0.02 * np.max(measurement.stress)]
            rate = 2.0 * strain / max(float(np.ptp(loaded)), 1e-300) if loaded.size > 1 else 0.0
        return cls(float(np.max(measurement.stress)), strain, rate, height)

    @property
    def slope(self) -> float:
        """Stress over strain, Pa."""
        return self.stress / self.strain

    @property
    def eta(self) -> float:
        """Damping that would carry the whole stress, Pa·s."""
        return self.stress / self.rate if self.rate > 0.0 else 1.0

    @property
    def duration(self) -> float:
        """Time under load, s; 1 where time is unknown."""
        return 2.0 * self.strain / self.rate if self.rate > 0.0 else 1.0

    @property
    def _hundredth(self) -> dict[str, float]:
        """A hundredth of the time under load, and of the largest value of each channel."""
        times = dict.fromkeys((nuisance.CONTACT_TIME, nuisance.TIME_SHIFT), 0.01 * self.duration)
        moved, acceleration = self.strain * self.height, self.height / self.duration**2
        return times | {
            "stress_zero": 0.01 * self.stress,
            "displacement_zero": 0.01 * moved,
            "acceleration_zero": 0.01 * acceleration,
        }

    def of_parameter(self, name: str, values: dict[str, float]) -> float:
        """Scale of a parameter, in its unit: a change by so much is a relative change of 1."""
        spring, short = split_name(name)
        if short == "eta":
            return max(abs(values[name]), 0.1 * self.eta)
        if spring < 0 and short in NUISANCE:
            return abs(values[name]) if name in nuisance.STRIKER else self._hundredth[short]
        if short in ("kh_plus", "kh_minus"):
            return max(abs(values[name]), 0.1 * self.slope)
        if short == "dsigma":
            eps_a = values[f"s{spring + 1}_eps_a"]
            return values[f"s{spring + 1}_k0"] * eps_a / (1.0 - eps_a)
        if short == "eps_star" or is_share(short):
            return max(abs(values[name]), 0.1)
        return abs(values[name]) or 1.0


def scale_in_words(name: str, value: float, scale: float) -> str:
    """Say what the scale of a parameter is."""
    if math.isclose(scale, abs(value), rel_tol=1e-9):
        return "its value"
    return {
        "eta": "a tenth of the damping that would carry the whole stress",
        "time_shift": "a hundredth of the time under load",
        "contact_time": "a hundredth of the time under load",
        "stress_zero": "a hundredth of the largest stress",
        "displacement_zero": "a hundredth of the largest displacement",
        "acceleration_zero": "a hundredth of the height over the squared time under load",
        "kh_plus": "a tenth of the largest stress over strain",
        "kh_minus": "a tenth of the largest stress over strain",
        "dsigma": "σ_a",
        "eps_star": "0.1",
    }.get(split_name(name)[1], "0.1" if is_share(split_name(name)[1]) else "its value")


# Coordinates of the box: lowest and highest. Stiffnesses and stresses are over the largest stress,
# slopes over stress/strain, relaxation times over the time under load, all of the test.
BOX = {
    "k0": (np.log(1e-3), np.log(1e4)),
    "kc": (np.log(1e-2), np.log(1e5)),
    "eps_a": (np.log(1e-3), np.log(0.95)),
    "eps_c": (0.002, 1.0),
    "eps_star": (0.0, 1.0),
    "dsigma": (0.0, 0.999),
    "kh_plus": (0.0, 50.0),
    "kh_minus": (0.0, 50.0),
    "sigma_plus": (np.log(1e-3), np.log(30.0)),
    "sigma_minus": (np.log(1e-4), np.log(30.0)),
    "spread_plus": (np.log(1e-3), np.log(5.0)),
    "spread_minus": (np.log(1e-3), np.log(5.0)),
    "g": (0.0, 10.0),
    "tau": (np.log(1e-4), np.log(30.0)),
    "eta": (0.0, 10.0),
    "height": (0.02, 0.98),
} | dict.fromkeys(NUISANCE, (-1.0, 1.0))


@dataclass(frozen=True, eq=False)
class Space:
    """The box in which the search moves, and the way between it and the vector of parameters."""

    model: Model  # The springs
    names: tuple[str, ...]  # Of all parameters: those of the springs, then the nuisance
    scales: Scales  # Of the test
    values: Array  # (n,): Values of the parameters that do not vary (SI); the others are ignored
    free: tuple[str, ...]  # Names of the parameters that vary
    # (n,): Limits of every parameter, SI.
    low: Array
    high: Array
    # Completes a vector in which some parameters hang on others.
    tied: Callable[[Array], Array] | None
    # Free parameters that are their own coordinates (SI) rather than relative to others: what is
    # shared by tests would not be one value else. Not every point is admissible then.
    absolute: tuple[str, ...] = ()

    @cached_property
    def coordinates(self) -> list[tuple[int, str, int]]:
        """Place, short name, place of the spring's first parameter; what others need is first.

        An absolute one has no short name.
        """
        out, shorts = [], list(BOX)
        for name in sorted(self.free, key=lambda name: shorts.index(family(split_name(name)[1]))):
            spring, short = split_name(name)
            first = self.model.index[f"s{spring + 1}_k0"] if spring >= 0 else -1
            out.append((self.names.index(name), "" if name in self.absolute else short, first))
        return out

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates, (n_free,) each."""
        pairs = np.array([
            BOX[family(short)] if short else (self.low[i], self.high[i])
            for i, short, _ in self.coordinates
        ]).reshape(-1, 2)  # fmt: skip
        return pairs[:, 0], pairs[:, 1]

    def _unit(self, short: str) -> float:
        """What a parameter is measured in, SI."""
        scales = self.scales
        units = {"height": scales.height, "eta": scales.eta, "tau": scales.duration}
        units |= dict.fromkeys(("k0", "kc", "sigma_plus", "sigma_minus"), scales.stress)
        units |= dict.fromkeys(("kh_plus", "kh_minus"), scales.slope)
        return units.get(family(short), 1.0)

    def _middle(self, i: int) -> tuple[float, float]:
        """Middle between the limits of a nuisance parameter, and half of their distance."""
        return 0.5 * (self.low[i] + self.high[i]), 0.5 * (self.high[i] - self.low[i])

    def encode(self, values: Array) -> Array:
        """Coordinates of a vector of parameters, moved into the box."""
        out = np.empty(len(self.coordinates))
        for j, (i, short, first) in enumerate(self.coordinates):
            if is_logarithmic(short):
                out[j] = np.log(max(values[i], 1e-300) / self._unit(short))
            elif short == "eps_c":
                out[j] = (values[i] - values[first + 3]) / (LAST_STRAIN - values[first + 3])
            elif short == "eps_star":
                least = least_eps_star(values[first], values[first + 1])
                out[j] = (values[i] - least) / (LAST_STRAIN - least)
            elif short == "dsigma":
                out[j] = -values[i] / _stress_at_a1(values, first)
            elif short in NUISANCE:
                middle, half = self._middle(i)
                out[j] = (values[i] - middle) / half
            else:
                out[j] = values[i] / self._unit(short)
        low, high = self.box
        margin = 1e-9 * (high - low)
        return np.clip(out, low + margin, high - margin)

    def decode(self, point: Array) -> Array:
        """Vector of parameters (SI) at a point of the box."""
        values = self.values.copy()
        for u, (i, short, first) in zip(point, self.coordinates, strict=True):
            value = self._value(u, i, short, first, values)
            values[i] = min(max(value, self.low[i]), self.high[i])
        return self.complete(values)

    def complete(self, values: Array) -> Array:
        """Complete a vector by what hangs on others."""
        return values if self.tied is None else self.tied(values)

    def _value(self, u: float, i: int, short: str, first: int, values: Array) -> float:
        """Parameter of a coordinate, whatever its limits; what it needs of `values` is there."""
        if is_logarithmic(short):
            return float(np.exp(u)) * self._unit(short)
        if short in ("eps_c", "eps_star"):
            least = least_eps_star(values[first], values[first + 1])
            least = least if short == "eps_star" else float(values[first + 3])
            return least + u * (LAST_STRAIN - least)
        if short in NUISANCE:
            middle, half = self._middle(i)
            return middle + u * half
        return -u * _stress_at_a1(values, first) if short == "dsigma" else u * self._unit(short)

    def slopes(self, point: Array, values: Array) -> Array:
        """Derivative of the parameters by the coordinates at a point, (n_values, n_free).

        `values` is the decoded point.
        """
        moves = np.zeros((values.size, point.size))
        for j, (i, short, first) in enumerate(self.coordinates):
            if is_logarithmic(short):
                moves[i, j] = values[i]
            elif short == "eps_star":
                k0, kc = float(values[first]), float(values[first + 1])
                least = least_eps_star(k0, kc)
                if least > 0.0:  # its derivative by the logarithm of kc/k0
                    rise = 0.25 * (1.0 - least * least)
                    moves[i] = (1.0 - point[j]) * rise * (moves[first + 1] / kc - moves[first] / k0)
                moves[i, j] = LAST_STRAIN - least
            elif short == "eps_c":
                moves[i] = (1.0 - point[j]) * moves[first + 3]
                moves[i, j] = LAST_STRAIN - values[first + 3]
            elif short == "dsigma":
                eps_a = values[first + 3]
                rise = eps_a / (1.0 - eps_a) * moves[first]
                rise += values[first] / (1.0 - eps_a) ** 2 * moves[first + 3]
                moves[i] = -point[j] * rise
                moves[i, j] = -_stress_at_a1(values, first)
            elif short in NUISANCE:
                moves[i, j] = self._middle(i)[1]
            else:
                moves[i, j] = self._unit(short)
            if not self.low[i] <= self._value(point[j], i, short, first, values) <= self.high[i]:
                moves[i] = 0.0
        return self.follow(values, moves, np.full(point.size, 1e-5))

    def follow(self, values: Array, moves: Array, steps: Array) -> Array:
        """Complete moves (n_values, m) of the parameters by those of what hangs on others.

        Differences of the expressions over `steps` (m,): no simulation is in them.
        """
        if self.tied is None:
            return moves
        out = np.empty_like(moves)
        for j, step in enumerate(steps):
            ahead = self.tied(values + step * moves[:, j])
            out[:, j] = (ahead - self.tied(values - step * moves[:, j])) / (2.0 * step)
        # what does not hang on others keeps its move to the last digit
        return np.where(moves != 0.0, moves, out)


def _stress_at_a1(values: Array, first: int) -> float:
    """σ_a = k0 ε_a/(1-ε_a) of the spring whose parameters start at `first`, Pa."""
    return float(values[first] * values[first + 3] / (1.0 - values[first + 3]))
