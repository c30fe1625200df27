"""The cycles of one record, each fitted on its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from foamfit.api import fit
from foamfit.arrays import single_threaded
from foamfit.data.csv_file import read_test
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.search import what_stopped
from foamfit.one_model import Keywords, Options, Progress
from foamfit.report.figures import TWO, inches
from foamfit.report.plots import draw_loops
from foamfit.report.shown import cycles_shown
from foamfit.report.studies.cycles import save_cycles
from foamfit.report.tables import frame, stacked
from foamfit.results import Fit
from foamfit.study.cycle_fits import FittedCycles
from foamfit.trust.intervals import Announce

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


class CycleFits(FittedCycles):
    """Fits of the cycles of one record, as `FittedCycles`; `save` writes them."""

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

        head, *rows = self.rows()
        return pd.DataFrame(rows, columns=[str(name) for name in head]).set_index("cycle")

    def __repr__(self) -> str:
        """Return model, misfits and parameters of the cycles."""
        return cycles_shown(self)

    def _repr_html_(self) -> str:
        return cycles_shown(self, html=True)

    def save(self, folder: str | Path, *, report: bool = True, figure_width: str = TWO) -> Path:
        """Write ``cycle-<n>/``, cycles.csv, cycles.png and cycles.json whole; returns the folder.

        An older result there is replaced as a whole, at the end. Without `report` there are tables
        alone. Figures are "one" or "two" columns wide, or as wide as a length ("85 mm").
        """
        inches(figure_width)  # refuses what is no width
        return save_cycles(self, folder, report=report, width=figure_width)


@single_threaded
def fit_cycles(
    path: str | Path,
    specimen: str | Path | None = None,
    *,
    cycles: Sequence[int] | None = None,
    model: str = "bistable",
    progress: Progress | None = None,
    tell: Announce | None = None,
    **options: Unpack[Keywords],
) -> CycleFits:
    """Fit cycles of a record in turn.

    A later cycle starts at its own contact; its start strain is taken off (see `read_test`).

    A cycle that cannot be read or fitted is in `refused` of the result with its sentence.

    Parameters
    ----------
    path, specimen
        The record and its TOML, as for `read_test`.
    cycles
        Numbers of the cycles; all by default.
    model, progress, tell, options
        As for `foamfit.fit`.

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
    results, refused = dict[int, Fit](), dict[int, str]()
    stopped = None
    for i, number in enumerate(wanted):

        def told(done: float, what: str, i: int = i, number: int = number) -> None:
            report((i + done) / len(wanted), f"cycle {number}: {what}")

        try:
            test = first if number == first.cycle else read_test(path, specimen, number)
            results[number] = fit(test, model=model, progress=told, tell=tell, **options)
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
