"""What the fits of the cycles of one record found: data only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from foamfit.api import FitResult
from foamfit.results import plain
from foamfit.springs.parameters import NUISANCE, springs_first
from foamfit.study.shared import Selection

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = 1
CURVES = ("stress_time", "displacement_time", "stress_strain")
ENERGY = "dissipated_energy"
Misfits = dict[str, float | None]  # of each curve


@dataclass(frozen=True, eq=False)
class FittedCycles:
    """Fits of the cycles of one record.

    Attributes
    ----------
    test, model
        Names of the test and of the model.
    recorded : tuple of int
        Numbers of all cycles in the record.
    results : dict of int to FitResult
        The fit of each cycle that could be read and fitted.
    refused : dict of int to str
        Why the others could not, one sentence each.
    selection : Selection or None
        Which parameters change from cycle to cycle; `together` holds the numbers of its cycles.
    sentences : tuple of str
        What the fit of several cycles says, or why it failed.
    """

    test: str
    model: str
    recorded: tuple[int, ...]
    results: dict[int, FitResult]
    refused: dict[int, str]
    selection: Selection | None = None
    together: tuple[int, ...] = ()
    sentences: tuple[str, ...] = ()

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

    @property
    def table(self) -> pd.DataFrame:
        """The rows of cycles.csv, indexed by the cycle."""
        import pandas as pd

        head, *rows = self.rows()
        return pd.DataFrame(rows, columns=[str(name) for name in head]).set_index("cycle")

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of cycles.json: what was fitted together, in plain types and SI."""
        content: dict[str, Any] = {
            "schema": SCHEMA,
            "foamfit": version("foamfit"),
            "test": self.test,
            "model": self.model,
            "recorded": self.recorded,
            "fitted": sorted(self.results),
            "refused": self.refused,
            "sentences": self.sentences,
            "together": None if self.selection is None else self._together(self.selection),
        }
        return dict(plain(content))

    def _together(self, selection: Selection) -> dict[str, Any]:
        best = selection.best.fits[0]
        own = [name for name in best.own if name in selection.best.own]
        return {
            "cycles": self.together,
            "effective_samples": selection.n_eff,
            "own": own,
            "shared": best.shared,
            "parameters": {name: best.value(name) for name in own}
            | {name: best.value(name)[0] for name in best.shared},
            "steps": [
                {
                    "own": step.own,
                    "n_vary": step.n_vary,
                    "bic": step.bic,
                    "misfit": dict(
                        zip(self.together, loop_misfits(step.fits[0].misfits), strict=True)
                    ),
                    "explained": selection.explained(step),
                    "chosen": step is selection.best,
                }
                for step in selection.steps
            ],
            "alone": {
                "n_vary": selection.n_alone,
                "bic": selection.bic_alone,
                "misfit": {n: loop_misfits([self.results[n].misfit])[0] for n in self.together},
            },
        }


def loop_misfits(found: Sequence[Misfits]) -> list[float | None]:
    """The one misfit that tells most of each fit: of the loop, else of the stress."""
    names = ("stress_strain", "stress_time", "displacement_time")
    return [next((one[n] for n in names if one.get(n) is not None), None) for one in found]


def span_of(found: Sequence[Misfits]) -> tuple[float, float] | None:
    """Smallest and largest misfit of some fits; None if there is none."""
    known = [one for one in loop_misfits(found) if one is not None]
    return (min(known), max(known)) if known else None
