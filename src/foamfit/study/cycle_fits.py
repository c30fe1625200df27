"""Fits of the cycles of one record: data only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from foamfit.report.tables import names_of, varied, wide_cells, wide_head
from foamfit.results import Fit, ParameterEstimate, plain
from foamfit.springs.parameters import NUISANCE

SCHEMA = 1
CURVES = ("stress_time", "displacement_time", "stress_strain")
ENERGY = "dissipated_energy"


@dataclass(frozen=True, eq=False)
class FittedCycles:
    """Fits of the cycles of one record."""

    test: str  # Names of the test and of the model
    model: str
    recorded: tuple[int, ...]  # Numbers of all cycles in the record
    results: dict[int, Fit]  # Of each cycle that could be read and fitted
    refused: dict[int, str]  # Why the others could not, one sentence each

    @property
    def varied(self) -> dict[str, list[ParameterEstimate | None]]:
        """The parameters of the springs that vary in any fit, by cycle in ascending order."""
        every = varied([one.parameters for _, one in sorted(self.results.items())])
        return {name: each for name, each in every.items() if name not in NUISANCE}

    def rows(self) -> Iterator[list[object]]:
        """Rows of cycles.csv, the header first: SI, one row for each cycle, empty = not there."""
        names = names_of(one.parameters for one in self.results.values())
        head = ["cycle", "start_strain", "peak_strain", "peak_stress", ENERGY]
        head += [*(f"misfit_{name}" for name in CURVES), "status", "error"]
        yield [*head, *wide_head(names)]
        for number in sorted({*self.results, *self.refused}):
            one = self.results.get(number)
            if one is None:
                told = [number, *[None] * 7, "refused", self.refused[number]]
                yield [*told, *wide_cells(names, {})]
                continue
            m = one.measurement
            strain = None if m.displacement is None else m.displacement.max() / m.specimen.height
            stress = None if m.stress is None else m.stress.max()
            cells = [number, m.start_strain, strain, stress, one.energy.get(ENERGY)]
            cells += [*map(one.misfit.get, CURVES), one.status, None]
            yield [*plain(cells), *wide_cells(names, one.parameters)]

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of cycles.json, in plain types."""
        content: dict[str, Any] = {
            "schema": SCHEMA,
            "foamfit": version("foamfit"),
            "test": self.test,
            "model": self.model,
            "recorded": self.recorded,
            "fitted": sorted(self.results),
            "refused": self.refused,
        }
        return dict(plain(content))
