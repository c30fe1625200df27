"""Curves for parameters that are changed by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Unpack

import numpy as np

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.box import Reading, thinned
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import Tracker, rank
from foamfit.one_model import Options
from foamfit.options import Keywords
from foamfit.parts import law_in_words
from foamfit.report.summary import CURVES
from foamfit.springs.parameters import NUISANCE, split_name, unit_of
from foamfit.text import readable_unit

WIDE = 4.0  # upper end of a slider, as a multiple of the value
PANELS = tuple(CURVES)


@dataclass(frozen=True)
class Drawn:
    """Curves (x, y) by the name of their panel, or the error of the simulation."""

    curves: dict[str, tuple[Array, Array]]
    misfit: dict[str, float | None]
    points: dict[str, tuple[float, float]] = field(default_factory=dict)  # strain, stress
    error: str = ""


class Turning:
    """A model of a test, whose curves are simulated at any values of the parameters."""

    def __init__(
        self,
        measurement: Measurement,
        model: str,
        values: Mapping[str, float] | None = None,
        **options: Unpack[Keywords],
    ) -> None:
        """Start at `values` (SI), or at values read off the loop; `options` as for a fit."""
        self.problem: Problem = Options(**options).problem(measurement, model)
        test, springs = self.problem.measurement, self.problem.model
        self.law = law_in_words(springs.name, springs.relaxation)
        self.drive = self.problem.objective.drive
        self.cycles = len(cycles_of(test)) or 1  # in the history
        self.measured = self._panels(test.stress, test.displacement)
        self.values = self._guess() if not values else self._at(self.problem.vector(), values)
        self.rows = {name: self._row(name) for name in self.problem.names if self._own(name)}

    @property
    def named(self) -> dict[str, float]:
        """The values (SI) by name; times and zeros refer to those of the file."""
        values = self.values + self.problem.origins
        return dict(zip(self.problem.names, values.tolist(), strict=True))

    def _own(self, name: str) -> bool:
        """Return whether a parameter has a slider."""
        # Those of the record (such as the contact time), known heights and expressions have none.
        heights, short = self.problem.measurement.specimen.heights, split_name(name)[1]
        of_record = name in NUISANCE or (short == "height" and heights is not None)
        return name == "time_shift" or not (of_record or self.problem.params[name].expr)

    def _at(self, values: Array, moves: Mapping[str, float]) -> Array:
        """Return the vector with some values changed, and expressions evaluated again."""
        values, problem = values.copy(), self.problem
        for name, value in moves.items():
            if name in problem.index and math.isfinite(value):
                place = problem.index[name]
                values[place] = value - problem.origins[place]
        return problem.space().complete(values)

    def turn(self, moves: Mapping[str, float]) -> Drawn:
        """Change some parameters (SI) and return the curves."""
        problem = self.problem
        self.values = values = self._at(self.values, moves)
        try:
            springs = problem.model.springs(values[: len(problem.model.names)])
            simulated = problem.objective.simulate(values, everything=True)
        except (InputError, SimulationError) as error:
            return Drawn({}, {}, error=str(error))
        m, drive, found = problem.measurement, self.drive, simulated.curves
        without_time = found.get("stress_strain")  # simulated along the measured motion
        stress = m.stress if drive == "stress" else found.get("stress_time", without_time)
        moved = m.displacement if drive == "displacement" else found.get("displacement_time")
        curves = {n: xy for n, xy in self._panels(stress, moved).items() if n in self.measured}
        points = springs[0].corners if len(springs) == 1 and not problem.model.relaxation else {}
        return Drawn(curves, problem.objective.misfit(simulated), points)

    def _panels(self, stress: Array | None, moved: Array | None) -> dict[str, tuple[Array, Array]]:
        """Return curves (x, y) of a stress (Pa) and a displacement (m) by the name of the panel."""
        m = self.problem.measurement
        strain = None if moved is None else moved / m.specimen.height
        pairs = zip(PANELS, (m.time, m.time, strain), (stress, moved, stress), strict=True)
        return {n: (x, y) for n, x, y in pairs if x is not None and y is not None}

    def _guess(self) -> Array:
        """Return the best of the start points that a fit reads off the measured loop."""
        problem, space = self.problem, self.problem.space()
        if problem.measurement.displacement is None:
            return problem.vector()
        rng = np.random.default_rng(0)
        starts = Reading(space, thinned(problem.measurement, loop=True)).starts(rng)
        tracker = Tracker(problem.objective)
        rank(tracker, space, starts)
        return np.asarray(problem.vector() if tracker.best_values is None else tracker.best_values)

    def _row(self, name: str) -> dict[str, Any]:
        """Return a slider: unit (`factor` in SI), value, ends, limits, and if a fit holds it."""
        parameter = self.problem.params[name]
        value = float(self.values[self.problem.index[name]])
        factor, shown = readable_unit(value, unit_of(name))
        far = WIDE * value or 0.1 * (parameter.max if parameter.max > 0 else parameter.min)
        low, high = sorted((0.0, far))
        if split_name(name)[1] == "time_shift":
            low, high = parameter.min, parameter.max
        row = {"value": value, "low": max(low, parameter.min), "high": min(high, parameter.max)}
        row |= {"least": parameter.min, "most": parameter.max}
        about = {"name": name, "unit": shown, "factor": factor, "held": not parameter.vary}
        return about | {key: one / factor for key, one in row.items()}
