"""The curves of parameters that are turned by hand, over those that were measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Unpack

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.errors import SimulationError
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import Tracker, rank
from foamfit.fitting.starts import curve_starts, smooth_loop
from foamfit.one_model import Keywords, Options
from foamfit.report.readable import readable_unit
from foamfit.results import law_in_words
from foamfit.springs.laws import BistableSpring
from foamfit.springs.parameters import NUISANCE, split_name, unit_of

MOST_SAMPLES = 1500  # of a curve that is drawn again at every move
WIDE = 4.0  # times its value that a slider reaches
# Of each panel: its curve, and what it is drawn over.
PANELS = ("stress_time", "displacement_time", "stress_strain")


@dataclass(frozen=True)
class Row:
    """A parameter to be turned: its value in a unit in which it reads well, and its limits there.

    `low` and `high` are the ends of the slider, `least` and `most` what is admissible.
    """

    name: str
    unit: str
    factor: float  # SI over the unit
    value: float
    low: float
    high: float
    least: float
    most: float
    held: bool = False  # a fit does not vary it unless it is told to


@dataclass(frozen=True)
class Drawn:
    """Curves at some parameters, by the name of their panel, x beside y; or why there are none."""

    curves: dict[str, tuple[Array, Array]]
    misfit: dict[str, float | None]
    values: dict[str, float]
    points: dict[str, tuple[float, float]] = field(default_factory=dict)  # strain, stress
    error: str = ""


class Turning:
    """A model over a test: its parameters, and its curves wherever they are turned to."""

    def __init__(
        self, measurement: Measurement, model: str, values: Mapping[str, float] | None = None,
        **options: Unpack[Keywords],
    ) -> None:  # fmt: skip
        """Begin at these values (SI), or else at those read off the loop; options as of a fit."""
        thin = thinned(measurement)
        self.samples = thin.rows.used, _size(thin)
        self.problem: Problem = Options(**options).problem(thin, model)
        self.values = self._guess() if not values else self._at(self.problem.vector(), values)
        self.rows = [self._row(name) for name in self.problem.names if self._own(name)]

    @property
    def drive(self) -> str:
        """What drives the chain."""
        return self.problem.objective.drive

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.problem.model.name, self.problem.model.relaxation)

    @property
    def named(self) -> dict[str, float]:
        """The values (SI) by their names, in the numbers of the file."""
        told = self.values + self.problem.origins
        return dict(zip(self.problem.names, told.tolist(), strict=True))

    def _own(self, name: str) -> bool:
        """Whether a parameter is turned: it does not follow from others or the specimen.

        Nor is it one of the record's own, such as the contact time, which is for a fit to find.
        """
        if name in NUISANCE and name != "time_shift":
            return False
        given = self.problem.measurement.specimen.heights is not None
        if given and split_name(name)[1] == "height":
            return False
        return self.problem.params[name].expr is None

    def _at(self, values: Array, moves: Mapping[str, float]) -> Array:
        """Put some values into a vector; what hangs on them by expressions follows."""
        values, problem = values.copy(), self.problem
        for name, value in moves.items():
            if name in problem.index and math.isfinite(value):
                place = problem.index[name]
                values[place] = value - problem.origins[place]
        complete = problem.tied()
        return values if complete is None else complete(values)

    def turn(self, moves: Mapping[str, float]) -> Drawn:
        """Turn some parameters (SI) and return the curves that follow."""
        problem = self.problem
        self.values = values = self._at(self.values, moves)
        named = self.named
        try:
            simulated = problem.objective.simulate(values, everything=True)
        except SimulationError as error:
            return Drawn({}, {}, named, error=self._why(error))
        curves, misfit = self._curves(simulated.curves), problem.objective.misfit(simulated)
        return Drawn(curves, misfit, named, self._points())

    def _points(self) -> dict[str, tuple[float, float]]:
        """Where the branches of a single bistable spring meet, by the names of the paper."""
        model = self.problem.model
        if model.kinds != ("bistable",) or model.relaxation:
            return {}
        spring = model.springs(self.values[: len(model.names)])[0]
        assert isinstance(spring, BistableSpring)
        ends = {
            "A1": (spring.eps_a, spring.sigma_a), "C1": (spring.eps_hat_c, spring.sigma_hat_c),
            "C2": (spring.eps_c, spring.sigma_c), "A2": (spring.eps_hat_a, spring.sigma_hat_a),
        }  # fmt: skip
        # A2 is missing where the branches e and a do not meet.
        return {n: (x, y) for n, (x, y) in ends.items() if x is not None and y is not None}

    @cached_property
    def measured(self) -> dict[str, tuple[Array, Array]]:
        """The measured curves by the name of their panel, in SI, as far as they are there."""
        m = self.problem.measurement
        curves: dict[str, Array | None] = {
            "stress_time": None if m.time is None else m.stress,
            "displacement_time": None if m.time is None else m.displacement,
            "stress_strain": None if m.displacement is None else m.stress,
        }
        return {n: (self._along(n, m.displacement), y) for n, y in curves.items() if y is not None}

    def _curves(self, found: dict[str, Array]) -> dict[str, tuple[Array, Array]]:
        """Give each panel its curve: of the loop that of the run, where the run has both."""
        m, drive = self.problem.measurement, self.drive
        stress = m.stress if drive == "stress" else found.get("stress_time")
        moved = m.displacement if drive == "displacement" else found.get("displacement_time")
        if stress is None:  # no time: along the measured motion
            stress = found.get("stress_strain")
        there = {"stress_time": stress, "displacement_time": moved, "stress_strain": stress}
        return {
            name: (self._along(name, moved), y)
            for name, y in there.items()
            if y is not None and name in self.measured and (moved is not None or "time" in name)
        }

    def _along(self, panel: str, moved: Array | None) -> Array:
        m = self.problem.measurement
        if panel != "stress_strain":
            assert m.time is not None  # no panel in time without it
            return m.time
        assert moved is not None
        return moved / m.specimen.height

    def _why(self, error: SimulationError) -> str:
        """Name the parameter that is not admissible, where one is."""
        model = self.problem.model
        try:
            model.springs(self.values[: len(model.names)])
        except ValueError as reason:
            return str(reason)
        return str(error)

    def _guess(self) -> Array:
        """Begin at the best of the fit's own starts, read off the measured loop."""
        problem, space = self.problem, self.problem.space()
        if problem.measurement.displacement is None:
            return problem.vector()
        rng = np.random.default_rng(0)
        starts = curve_starts(space, smooth_loop(problem.measurement), rng)
        tracker = Tracker(problem.objective)
        rank(tracker, space, starts)
        found = problem.vector() if tracker.best_values is None else tracker.best_values
        return np.asarray(found)

    def _row(self, name: str) -> Row:
        problem = self.problem
        value = float(self.values[problem.index[name]])
        parameter = problem.params[name]
        unit = unit_of(name)
        factor, shown = readable_unit(value, unit)
        far = WIDE * value or 0.1 * (parameter.max if parameter.max > 0 else parameter.min)
        low, high = sorted((0.0, far))
        if split_name(name)[1] == "time_shift":
            low, high = parameter.min, parameter.max
        low, high = max(low, parameter.min), min(high, parameter.max)
        return Row(
            name, shown, factor, value / factor, low / factor, high / factor,
            parameter.min / factor, parameter.max / factor, held=not parameter.vary,
        )  # fmt: skip


def thinned(measurement: Measurement) -> Measurement:
    """Leave out samples evenly where there are more than can be drawn at once."""
    count = _size(measurement)
    if count <= MOST_SAMPLES:
        return measurement
    keep = np.unique(np.linspace(0, count - 1, MOST_SAMPLES).astype(int))

    def some(values: Array | None) -> Array | None:
        return None if values is None else values[keep]

    outliers = {
        channel: replace(found, left_out=found.left_out[keep])
        for channel, found in measurement.outliers.items()
    }
    return replace(
        measurement, time=some(measurement.time), stress=some(measurement.stress),
        displacement=some(measurement.displacement), acceleration=some(measurement.acceleration),
        outliers=outliers, block=1,
        interior={node: values[keep] for node, values in measurement.interior.items()},
        sampled={channel: taken[keep] for channel, taken in measurement.sampled.items()},
    )  # fmt: skip


def _size(measurement: Measurement) -> int:
    return max(map(len, measurement.channels().values()))
