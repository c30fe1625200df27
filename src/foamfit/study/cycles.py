"""Separate fits of the cycles of one record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from foamfit.api import fit
from foamfit.arrays import single_threaded
from foamfit.data.csv_file import read_test
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.search import what_stopped
from foamfit.one_model import Options, Progress
from foamfit.options import Keywords
from foamfit.report.studies.cycles import CycleFits
from foamfit.results import Fit
from foamfit.trust.intervals import Announce


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
    if not wanted:
        raise InputError("no cycle is given; give at least one, or omit cycles to fit all")
    results, refused = dict[int, Fit](), dict[int, str]()
    stopped = None
    for i, number in enumerate(wanted):

        def notify(done: float, what: str, i: int = i, number: int = number) -> None:
            report((i + done) / len(wanted), f"cycle {number}: {what}")

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
