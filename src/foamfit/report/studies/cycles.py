"""The folder of a record's cycles: a result folder for each, a table, a picture, a summary."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.report import figures
from foamfit.report.figures import TWO
from foamfit.report.folder import save_whole, write_json, write_result, write_table, write_text
from foamfit.report.plots import draw_loops
from foamfit.report.readable import own_name
from foamfit.report.render import words
from foamfit.report.studies.parameters import Panel, panels_of, plot_parameters
from foamfit.report.tables import by_test_tex
from foamfit.results import ParameterEstimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from foamfit.report.result_figures import Mapped
    from foamfit.study.cycle_fits import FittedCycles

MOST_LOOPS = 12
MOST_NAMES = 12  # of parameters on the terminal; those of a chain are in cycles.csv
DPI = 200
# Panels beside the parameters: columns of cycles.csv (SI), and what these are multiplied with.
BY_CYCLE = {
    "start\nstrain (%)": ("start_strain", 100.0),
    "dissipated\n(kJ/m³)": ("dissipated_energy", 1e-3),
    "misfit of\nthe loop (%)": ("misfit_stress_strain", 100.0),
}


def save_cycles(
    found: FittedCycles,
    folder: str | Path,
    *,
    report: bool = True,
    width: str = TWO,
    mapped: Mapped = map,
) -> Path:
    """Write the folder whole, replacing an older result at the end; returns it.

    For `report`, `width` and `mapped` see `foamfit.report.folder.save_result`.
    """
    return save_whole(
        folder, lambda fresh: write_cycles(found, fresh, pages=report, width=width, mapped=mapped)
    )


def write_cycles(
    found: FittedCycles, folder: Path, *, pages: bool = True, width: str = TWO, mapped: Mapped = map
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


def cycles_text(found: FittedCycles) -> str:
    """Return what the command prints of the cycles of a record."""
    names = list(found.varied) if len(found.varied) <= MOST_NAMES else []
    return words("cycles", found=found, names={name: own_name(name, found.model) for name in names})


def plot_cycles(found: FittedCycles, *, width: str = TWO) -> Figure:
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
    head, *table = map(list[Any], found.rows())
    panels = list[Panel]()
    for title, (column, factor) in BY_CYCLE.items():
        values = {
            f"cycle {row[0]}": ParameterEstimate(factor * x, None, None, "", True, "determined", "")
            for row in table
            if (x := row[head.index(column)]) is not None
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
