"""Fits of the cycles of one record: data only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from foamfit.results import Fit, plain
from foamfit.springs.parameters import NUISANCE, springs_first

SCHEMA = 1
CURVES = ("stress_time", "displacement_time", "stress_strain")
ENERGY = "dissipated_energy"


@dataclass(frozen=True, eq=False)
class FittedCycles:
    """Fits of the cycles of one record.

    Attributes
    ----------
    test, model
        Names of the test and of the model.
    recorded : tuple of int
        Numbers of all cycles in the record.
    results : dict of int to Fit
        The fit of each cycle that could be read and fitted.
    refused : dict of int to str
        Why the others could not, one sentence each.
    """

    test: str
    model: str
    recorded: tuple[int, ...]
    results: dict[int, Fit]
    refused: dict[int, str]

    @property
    def names(self) -> list[str]:
        """Names of the parameters of any fit, in their order, those of the springs first."""
        return springs_first(name for one in self.results.values() for name in one.parameters)

    @property
    def varied(self) -> list[str]:
        """Names of the parameters of the springs that vary in any fit."""
        fits = [one.parameters for one in self.results.values()]
        return [
            name
            for name in self.names
            if name not in NUISANCE and any(name in one and one[name].vary for one in fits)
        ]

    def rows(self) -> Iterator[list[object]]:
        """Rows of cycles.csv, the header first: SI, one row for each cycle, empty = not there."""
        head = [
            "cycle",
            "start_strain",
            "peak_strain",
            "peak_stress",
            ENERGY,
            *(f"misfit_{name}" for name in CURVES),
            "status",
            "error",
        ]
        parts = "", "_stderr", "_lo", "_hi", "_state"
        yield [*head, *(f"{name}{part}" for name in self.names for part in parts)]
        for number in sorted({*self.results, *self.refused}):
            one = self.results.get(number)
            if one is None:
                blank = [None] * (5 * len(self.names))
                yield [number, *[None] * 7, "refused", self.refused[number], *blank]
                continue
            m = one.measurement
            strain = None if m.displacement is None else m.displacement.max() / m.specimen.height
            cells: list[object] = [
                number,
                m.start_strain,
                strain,
                None if m.stress is None else m.stress.max(),
                one.energy.get(ENERGY),
                *(one.misfit.get(name) for name in CURVES),
                one.status,
                None,
            ]
            for name in self.names:
                p, none = one.parameters.get(name), (None, None)
                cells += (p.value, p.stderr, *(p.ci95 or none), p.state) if p else [None] * 5
            yield [plain(cell) for cell in cells]

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
