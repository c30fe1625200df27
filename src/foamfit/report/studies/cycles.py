"""The fits of a record's cycles: what they say, their folder, table and picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.report import figures
from foamfit.report.figures import TWO
from foamfit.report.folder import save_whole, write_json, write_result, write_table, write_text
from foamfit.report.plots import draw_loops
from foamfit.report.readable import own_name
from foamfit.report.render import words
from foamfit.report.shown import Shown, brief
from foamfit.report.studies.parameters import Panel, panels_of, plot_parameters
from foamfit.report.summary import CURVES
from foamfit.report.tables import (
    by_test,
    by_test_tex,
    frame,
    stacked,
    varied,
    wide,
)
from foamfit.results import Fit, ParameterEstimate, plain
from foamfit.springs.parameters import NUISANCE
from foamfit.text import counted, percent

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.report.result_figures import Mapped

SCHEMA = 1
ENERGY = "dissipated_energy"
MOST_LOOPS = 12
MOST_NAMES = 12  # of parameters on the terminal; those of a chain are in cycles.csv
DPI = 200
# Panels beside the parameters: columns of cycles.csv (SI), and what these are multiplied with.
BY_CYCLE = {
    "start\nstrain (%)": ("start_strain", 100.0),
    "dissipated\n(kJ/m³)": ("dissipated_energy", 1e-3),
    "misfit of\nthe loop (%)": ("misfit_stress_strain", 100.0),
}


@dataclass(frozen=True, eq=False, repr=False)
class CycleFits(Shown):
    """Fits of the cycles of one record."""

    test: str  #: Names of the test and of the model
    model: str
    recorded: tuple[int, ...]  #: Numbers of all cycles in the record
    results: dict[int, Fit]  #: Of each cycle that could be read and fitted
    refused: dict[int, str]  #: Why the others could not, one sentence each

    @property
    def varied(self) -> dict[str, list[ParameterEstimate | None]]:
        """The parameters of the springs that vary in any fit, by cycle in ascending order."""
        every = varied([one.parameters for _, one in sorted(self.results.items())])
        return {name: each for name, each in every.items() if name not in NUISANCE}

    def rows(self) -> Iterator[dict[str, Any]]:
        """Rows of cycles.csv: SI, one for each cycle, None = not there."""
        every = {n: self.results.get(n) for n in sorted({*self.results, *self.refused})}
        parameters = wide([{} if one is None else one.parameters for one in every.values()])
        names = ["start_strain", "peak_strain", "peak_stress", ENERGY]
        names += [f"misfit_{name}" for name in CURVES]
        for (number, one), own in zip(every.items(), parameters, strict=True):
            cells: list[Any] = [None] * len(names)
            status = "refused"
            if one is not None:
                m, status = one.measurement, one.status
                moved, height = m.displacement, m.specimen.height
                strain = None if moved is None else moved.max() / height
                stress = None if m.stress is None else m.stress.max()
                cells = [m.start_strain, strain, stress, one.energy.get(ENERGY)]
                cells += map(one.misfit.get, CURVES)
            told = {"status": status, "error": self.refused.get(number)}
            yield {"cycle": number, **dict(zip(names, plain(cells), strict=True)), **told, **own}

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

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the loops of all cycles, measured and fitted, into axes or a new figure."""
        found = ((n, one.loop) for n, one in sorted(self.results.items()))
        loops = (loop._replace(name=f"cycle {n}") for n, loop in found if loop is not None)
        return draw_loops(loops, ax)

    def table(self) -> pd.DataFrame:
        """Return a row for each cycle and parameter, SI; `to_latex` of it compiles."""
        results = sorted(self.results.items())
        return stacked({n: frame(one.parameters) for n, one in results}, "cycle")

    @property
    def by_cycle(self) -> pd.DataFrame:
        """Return the rows of cycles.csv, indexed by the cycle."""
        import pandas as pd

        return pd.DataFrame(list(self.rows())).set_index("cycle")

    def _shown(self, *, html: bool = False) -> str:
        """Return how many cycles were fitted and their misfits; in HTML their parameters too."""
        line = (
            f"{self.model} · {len(self.results)} of {counted(len(self.recorded), 'cycle')} fitted"
        )
        each = (one.misfit.get("stress_strain") for one in self.results.values())
        if known := [off for off in each if off is not None]:
            line += f" · misfit {percent(min(known))} to {percent(max(known))}"
        table = by_test(list(map(str, sorted(self.results))), self.varied) if html else {}
        return brief(self.test, line, [], html, table and {"first": "cycle", **table})

    def save(
        self,
        folder: str | Path,
        *,
        report: bool = True,
        figure_width: str = TWO,
        mapped: Mapped = map,
    ) -> Path:
        """Write ``cycle-<n>/``, cycles.csv, cycles.png and cycles.json whole; returns the folder.

        An older result there is replaced as a whole, at the end. Without `report` there are tables
        alone. Figures are "one" or "two" columns wide, or as wide as a length ("85 mm"); `mapped`
        draws those of the cycles, as the `map` of an executor does.
        """
        figures.inches(figure_width)  # refuses what is no width
        drawn: Any = {"pages": report, "width": figure_width, "mapped": mapped}
        return save_whole(folder, partial(write_cycles, self, **drawn))


def write_cycles(
    found: CycleFits, folder: Path, *, pages: bool = True, width: str = TWO, mapped: Mapped = map
) -> None:
    """Write all files of the cycles into a folder that is there; reports and pictures if wanted."""
    for number, result in found.results.items():
        inner = folder / f"cycle-{number}"
        inner.mkdir()
        write_result(result, inner, pages=pages, width=width, mapped=mapped)
    write_table(folder / "cycles.csv", found.rows())
    write_json(folder / "cycles.json", found.to_json_dict())
    numbers = [str(number) for number in sorted(found.results)]
    write_text(folder / "table.tex", by_test_tex("Cycle", numbers, found.varied))
    if pages:
        figures.write_both(plot_cycles(found, width=width), folder / "cycles", DPI)


def cycles_text(found: CycleFits) -> str:
    """Return what the command prints of the cycles of a record."""
    names = list(found.varied) if len(found.varied) <= MOST_NAMES else []
    return words("cycles", found=found, names={name: own_name(name, found.model) for name in names})


def plot_cycles(found: CycleFits, *, width: str = TWO) -> Figure:
    """Draw the loops over each other, and start strain, energy, misfit and parameters by cycle.

    For the parameters and `width` see `plot_parameters`; of very many loops some are drawn.
    """
    results = dict(sorted(found.results.items()))
    loops = [
        loop._replace(
            name=f"cycle {number}",
            along=loop.along + one.measurement.start_strain,
            label="strain from the first contact",
        )
        for number, one in results.items()
        if (loop := one.loop) is not None and loop.label == "strain"
    ]
    keep = np.unique(np.geomspace(1, max(len(loops), 1), MOST_LOOPS).astype(int)) - 1
    rows, panels = list(found.rows()), list[Panel]()
    for title, (column, factor) in BY_CYCLE.items():
        known = {f"cycle {row['cycle']}": row[column] for row in rows if row[column] is not None}
        values = {
            cycle: ParameterEstimate(factor * x, None, None, "", True, "determined", "")
            for cycle, x in known.items()
        }
        panels.append(Panel(column, title, values))
    names = [f"cycle {number}" for number in results]
    return plot_parameters(
        f"{found.test} · {found.model}",
        names,
        [*panels, *panels_of(names, found.varied)],
        width=width,
        above=partial(draw_loops, [loops[i] for i in keep[: len(loops)]]),
    )
