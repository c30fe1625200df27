"""The cycles of one record, each fitted on its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import lmfit

from foamfit.api import FitResult, fit
from foamfit.data.csv_file import read_test
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.search import what_stopped
from foamfit.one_model import Keywords, Options, Progress
from foamfit.report.figures import TWO, inches
from foamfit.report.studies.cycles import save_cycles
from foamfit.results import plain
from foamfit.springs.parameters import NUISANCE, springs_first
from foamfit.trust.intervals import Announce

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = 1
CURVES = ("stress_time", "displacement_time", "stress_strain")
ENERGY = "dissipated_energy"
Params = Callable[[Measurement], lmfit.Parameters | None]


@dataclass(frozen=True, eq=False)
class CycleFits:
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
    """

    test: str
    model: str
    recorded: tuple[int, ...]
    results: dict[int, FitResult]
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

    @property
    def table(self) -> pd.DataFrame:
        """The rows of cycles.csv, indexed by the cycle."""
        import pandas as pd

        head, *rows = self.rows()
        return pd.DataFrame(rows, columns=[str(name) for name in head]).set_index("cycle")

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

    def save(self, folder: str | Path, *, report: bool = True, figure_width: str = TWO) -> Path:
        """Write ``cycle-<n>/``, cycles.csv, cycles.png and cycles.json whole; returns the folder.

        An older result there is replaced as a whole, at the end. Without `report` there are tables
        alone. Figures are "one" or "two" columns wide, or as wide as a length ("85 mm").
        """
        inches(figure_width)  # refuses what is no width
        return save_cycles(self, folder, report=report, width=figure_width)


def fit_cycles(
    path: str | Path,
    specimen: str | Path | None = None,
    *,
    cycles: Sequence[int] | None = None,
    model: str = "bistable",
    params: Params | None = None,
    progress: Progress | None = None,
    tell: Announce | None = None,
    **options: Unpack[Keywords],
) -> CycleFits:
    """Fit cycles of a record in turn.

    A later cycle starts at its own contact; its start strain is taken off (see `read_test`).

    Parameters
    ----------
    path, specimen
        The record and its TOML, as for `read_test`.
    cycles : sequence of int, optional
        Numbers of the cycles; all by default.
    model, tell, options
        As for `foamfit.fit`.
    params : callable, optional
        Gives the parameters of each cycle's measurement, as `foamfit.make_params` does.
    progress : callable, optional
        Told the fraction done and what is going on.

    Returns
    -------
    CycleFits
        A cycle that cannot be read or fitted is in `refused` with its sentence.

    Raises
    ------
    InputError
        If the record or an option cannot be used at all.
    """
    Options.of("fit_cycles", options)  # refuses what is not admissible
    report = progress or (lambda *_: None)
    first = read_test(path, specimen)
    wanted = first.cycles if cycles is None else tuple(dict.fromkeys(cycles))
    if not wanted:
        raise InputError("no cycle is named; name one or leave cycles out for all")
    results, refused = dict[int, FitResult](), dict[int, str]()
    stopped = None
    for i, number in enumerate(wanted):

        def told(done: float, what: str, i: int = i, number: int = number) -> None:
            report((i + done) / len(wanted), f"cycle {number}: {what}")

        try:
            test = first if number == first.cycle else read_test(path, specimen, number)
            given = None if params is None else params(test)
            results[number] = fit(
                test, model=model, params=given, progress=told, tell=tell, **options
            )
            stopped = results[number].stopped
        except (InputError, SimulationError) as error:
            refused[number] = str(error)
        except KeyboardInterrupt as error:
            if not results:
                raise
            stopped = what_stopped(error)
        if stopped not in (None, "the time limit"):
            why = f"not fitted, because {stopped} ended the command before"
            refused |= {left: why for left in wanted[i:] if left not in results}
            break
    return CycleFits(first.name, model, first.cycles, results, refused)
