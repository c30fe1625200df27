"""Separate fits of the cycles of one record: their folder, table, text and figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from foamfit.api import fit
from foamfit.arrays import single_threaded
from foamfit.codec import plain
from foamfit.data.csv_file import read_test
from foamfit.errors import InputError, SimulationError, check_whole
from foamfit.fitting.search import what_stopped
from foamfit.one_model import Options, Progress, part_of
from foamfit.options import Keywords
from foamfit.parts import ParameterEstimate
from foamfit.report import figures
from foamfit.report.folder import Result, brief, write_json, write_result, write_table, write_text
from foamfit.report.listing import REFUSED, Row, row_of, table_rows
from foamfit.report.plots import Values, draw_loops, plot_parameters, values_of
from foamfit.report.render import by_test, by_test_tex, frame, stacked, varied, words
from foamfit.results import Fit, stamp
from foamfit.springs.parameters import NUISANCE
from foamfit.text import counted, percent
from foamfit.trust.intervals import Announce

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ENERGY = "dissipated_energy"
FEATURES = ("start_strain", "peak_strain", "peak_stress", ENERGY)  # columns of cycles.csv
MOST_NAMES = 12  # more parameters than this are not printed; all are in cycles.csv
# Panels next to the parameters: columns of cycles.csv (SI), and their factors.
BY_CYCLE = {
    "start\nstrain (%)": ("start_strain", 100.0),
    "dissipated\n(kJ/m³)": ("dissipated_energy", 1e-3),
    "misfit of\nthe loop (%)": ("misfit_stress_strain", 100.0),
}


@dataclass(frozen=True, eq=False, repr=False)
class CycleFits(Result):
    """Fits of the cycles of one record."""

    _kind = "cycles.json"
    test: str  #: Name of the test
    model: str  #: Name of the model
    recorded: tuple[int, ...]  #: Numbers of all cycles in the record
    results: dict[int, Fit]  #: Fit of each cycle that could be read and fitted
    refused: dict[int, str]  #: Reason for each of the other cycles, one sentence
    data_sha256: str = ""  #: Digest of the record
    options: dict[str, Any] | None = None  #: As `Fit.options`, with the numbers of the cycles

    @property
    def varied(self) -> dict[str, list[ParameterEstimate | None]]:
        """Parameters of the springs that vary in any fit, with their values in ascending cycles."""
        every = varied([one.parameters for _, one in sorted(self.results.items())])
        return {name: each for name, each in every.items() if name not in NUISANCE}

    def listed(self, test: str, file: str) -> tuple[Row, ...]:
        """Return a row of a table of fits for each cycle."""
        return tuple(
            row_of(f"{test}/cycle-{n}", file, self.results[n])
            if n in self.results
            else Row(f"{test}/cycle-{n}", file, REFUSED, " ".join(self.refused[n].split()))
            for n in sorted({*self.results, *self.refused})
        )

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield the rows of cycles.csv in SI, one per cycle; None for missing values."""
        numbers = sorted({*self.results, *self.refused})
        for number, row in zip(numbers, table_rows(self.listed(self.test, "")), strict=True):
            own: dict[str, Any] = dict.fromkeys(FEATURES)
            if (one := self.results.get(number)) is not None:
                m = one.measurement
                own |= {"start_strain": m.start_strain, ENERGY: one.energy.get(ENERGY)}
                tops = ("strain", m.displacement, m.specimen.height), ("stress", m.stress, 1.0)
                own |= {f"peak_{name}": x.max() / by for name, x, by in tops if x is not None}
            del row["test"], row["file"]
            yield {"cycle": number, **plain(own), **row}

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of cycles.json, in plain types."""
        content = {**stamp(), "fitted": sorted(self.results)}
        names = (one.name for one in fields(self) if one.name != "results")
        return dict(plain(content | {name: getattr(self, name) for name in names}))

    def printed(self) -> dict[str, Any]:
        """Return what the command prints as JSON: also the fits."""
        each = {n: one.to_json_dict() for n, one in sorted(self.results.items())}
        return self.to_json_dict() | {"cycles": each}

    @property
    def failed(self) -> bool:
        """Whether no acceptable fit was found of any cycle."""
        return all(one.status == "failed" for one in self.results.values())

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints."""
        shown = self.varied if len(self.varied) <= MOST_NAMES else {}
        numbers = [str(number) for number in sorted(self.results)]
        return words("cycles", found=self, shown=list(shown), table=by_test(numbers, shown))

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the loops of all cycles, measured and fitted, into axes or a new figure."""
        every = ((n, one.loop) for n, one in sorted(self.results.items()))
        loops = (loop._replace(name=f"cycle {n}") for n, loop in every if loop is not None)
        return draw_loops(loops, ax)

    def table(self) -> pd.DataFrame:
        """Return a row for each cycle and parameter, in SI; the output of `to_latex` compiles."""
        results = sorted(self.results.items())
        return stacked({n: frame(one.parameters) for n, one in results}, "cycle")

    @property
    def by_cycle(self) -> pd.DataFrame:
        """The rows of cycles.csv, indexed by cycle."""
        import pandas as pd

        return pd.DataFrame(list(self.rows())).set_index("cycle")

    def __repr__(self) -> str:
        """Return the number of fitted cycles and their misfits."""
        cycles = counted(len(self.recorded), "cycle")
        line = f"{self.model} · {len(self.results)} of {cycles} fitted"
        misfits = (one.misfit.get("stress_strain") for one in self.results.values())
        if known := [misfit for misfit in misfits if misfit is not None]:
            line += f" · misfit {percent(min(known))} to {percent(max(known))}"
        return brief(self.test, line, [])

    def write(self, folder: Path, *, pages: bool, width: str) -> None:
        """Write ``cycle-<n>/``, cycles.csv, cycles.json, table.tex and figures."""
        for number, result in self.results.items():
            inner = folder / f"cycle-{number}"
            inner.mkdir()
            write_result(result, inner, pages=pages, width=width)
        write_table(folder / "cycles.csv", self.rows())
        write_json(folder / "cycles.json", self.to_json_dict())
        numbers = [str(number) for number in sorted(self.results)]
        write_text(folder / "table.tex", by_test_tex("Cycle", numbers, self.varied))
        if pages:
            figures.write_both(plot_cycles(self, width=width), folder / "cycles")


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
    """Fit cycles of a record one after the other; returns `CycleFits`.

    A later cycle starts at its own contact, and its start strain is subtracted (see `read_test`). A
    cycle that cannot be read or fitted is listed in `refused` of the result, with the error
    message.

    Parameters
    ----------
    path, specimen
        The record and its TOML, as for `read_test`.
    cycles : sequence of int, optional
        Numbers of the cycles; all by default.
    model, progress, tell, options
        As for `foamfit.fit`.

    Raises
    ------
    InputError
        If the record or an option cannot be used for any cycle.
    """
    chosen = Options.of("fit_cycles", options)  # rejects invalid options
    report = progress or (lambda *_: None)
    first = read_test(path, specimen)
    wanted = first.cycles if cycles is None else tuple(dict.fromkeys(cycles))
    for number in wanted:
        check_whole("cycles: a number", number, 1)
    if not wanted:
        raise InputError("no cycle is given; give at least one, or omit cycles to fit all")
    results, refused = dict[int, Fit](), dict[int, str]()
    stopped, count = None, len(wanted)
    for i, number in enumerate(wanted):
        notify = part_of(report, i / count, (i + 1) / count, f"cycle {number}: ")
        try:
            test = first if number == first.cycle else read_test(path, specimen, number)
            results[number] = fit(test, model=model, progress=notify, tell=tell, **options)
            stopped = results[number].stopped
        except (InputError, SimulationError) as error:
            refused[number] = str(error)
        except KeyboardInterrupt as error:
            if not results:
                raise
            stopped = what_stopped(error)
        if stopped not in (None, "the time limit"):
            why = f"not fitted because {stopped} ended the command first"
            refused |= {later: why for later in wanted[i:] if later not in results}
            break
    made = first.data_sha256, chosen.stored(first, model, wanted)
    return CycleFits(first.name, model, first.cycles, results, refused, *made)


def plot_cycles(found: CycleFits, *, width: str = figures.TWO) -> Figure:
    """Draw all loops, and start strain, energy, misfit and parameters; see `plot_parameters`."""
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
    rows, panels = list(found.rows()), list[Values]()
    for title, (column, factor) in BY_CYCLE.items():
        known = {f"cycle {row['cycle']}": row[column] for row in rows if row[column] is not None}
        values = {n: ParameterEstimate(factor * x, state="determined") for n, x in known.items()}
        panels.append(Values(column, title, values))
    names = [f"cycle {number}" for number in results]
    panels += values_of(names, found.varied)
    title = f"{found.test} · {found.model}"
    return plot_parameters(title, names, panels, width=width, loops=loops)
