"""`foamfit fit`: identify the parameters of a test, or of the cycles of a record."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli.fit_options import fit_options, intervals_of, params_of
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import (
    CYCLE,
    FILE,
    NO_REPORT,
    OPEN,
    SPECIMEN,
    TEST,
    WIDTH,
    check_open,
    compiling,
    cycles_of,
    drawing_beside,
    spare,
    tell_written,
)
from foamfit.cli.progress import Progress, progress_line
from foamfit.errors import InputError
from foamfit.terminal import say, without_ctrl_c

if TYPE_CHECKING:
    from foamfit.api import FitResult
    from foamfit.study.cycles import CycleFits

# Options of `fit` that are no keywords of `foamfit.fit`, and those that are one of them.
OF_ONE_MODEL, WAYS = ("cycle", "model", "fix", "vary"), ("profile", "bootstrap", "mcmc")


@main.command()
@TEST
@SPECIMEN
@CYCLE
@click.option("--out", type=FILE, help="Result folder. Default: fits/<test>/<model>.")
@NO_REPORT
@fit_options
@WIDTH
@OPEN
@click.option("--json", "as_json", is_flag=True, help="Print fit.json on stdout, nothing else.")
@click.option("--quiet", is_flag=True, help="Print nothing but warnings of failure.")
@click.option(
    "--verbose", is_flag=True, help="Print the checklist, reasons, notes and all models too."
)
def fit(
    test: Path, specimen: Path | None, cycle: str | None, model: str, out: Path | None,
    fix: dict[str, float], vary: tuple[str, ...], no_report: bool, figure_width: str,
    as_json: bool, quiet: bool, verbose: bool, **search: Any,
) -> int:  # fmt: skip
    """Identify the parameters of TEST.csv and write a result folder.

    With several cycles the folder holds one result folder for each, cycles.csv, cycles.png and
    cycles.json: what changes from cycle to cycle, by one fit of them together.

    Exit code 0: a fit was made; 1: the input or the call is wrong; 2: no acceptable fit was found
    (what was found is written); 70: a defect of foamfit; 130 and 143: ended by Ctrl-C or
    SIGTERM before anything was found, as these too give the best so far.

    \b
    Examples:
        foamfit fit TEST.csv
        foamfit fit TEST.csv --model auto --open
        foamfit fit TEST.csv --model microscale --relaxation 1
        foamfit fit TEST.csv --model microscale --relaxation 1 --cycle all
        foamfit fit TEST.csv --drive displacement --out results/today --figure-width one
        foamfit fit TEST.csv --model linear+bistable --fix s1_k0=60e6
    """
    check_open(as_json, no_report)
    hush = quiet or as_json
    model = _model_name(model, search["relaxation"])
    options = search | {"cycle": cycle, "model": model, "fix": fix, "vary": vary}
    with (
        compiling(hush, model, search["relaxation"]) as compile_rest,
        drawing_beside() as drawers,
    ):
        folder = _result_folder(out, test, specimen, model)

        def begin(limit: float | None) -> AbstractContextManager[Progress]:
            compile_rest()
            if not no_report:
                drawers.begin()
            return progress_line(hush, "fit", limit, says=not quiet)

        found = fit_as_asked(test, specimen, options, begin)
        drawn = {"report": not no_report, "width": figure_width, "mapped": drawers.map}
        save = partial(_save, found, folder, hush, drawn)
        from foamfit.results import Fit

        if not isinstance(found, Fit):
            code = _tell_cycles(found, folder, save, as_json, quiet)
            tell_written(folder / "cycles.png", hush)
            return code
        try:
            save()
        except InputError:  # the numbers are not lost with the folder
            _tell_result(found, as_json, quiet, verbose)
            raise
    _tell_result(found, as_json, quiet, verbose)
    tell_written(folder / "report.html", hush)
    if found.status == "failed":
        say(f"foamfit: no acceptable fit was found; see {folder}", err=True)
        return NOT_ACCEPTABLE
    return 0


def fit_as_asked(
    test: Path,
    specimen: Path | None,
    options: Mapping[str, Any],
    begin: Callable[[float | None], AbstractContextManager[Progress]],
) -> FitResult | CycleFits:
    """Fit a test, or cycles of a record, as the options of the command say.

    `begin` is called when all is read, before anything is simulated, with the seconds after which
    the fit ends in any case; what it gives is told how the fit goes.
    """
    from foamfit.data.csv_file import read_test

    search = {name: value for name, value in options.items() if name not in OF_ONE_MODEL}
    search |= intervals_of(**{way: search.pop(way) for way in WAYS})
    fix, vary = options["fix"], options["vary"]
    model = _model_name(options["model"])
    alone, several = cycles_of(options["cycle"])
    measurement = read_test(test, specimen, alone)
    for number in set(several or ()).difference(measurement.cycles):
        last = f"its cycles are {min(measurement.cycles)} to {max(measurement.cycles)}"
        raise InputError(f"--cycle {options['cycle']}: {test} has no cycle {number}; {last}")
    from foamfit import api
    from foamfit.one_model import Options

    Options(**search)  # refuses what is not admissible before anything is compiled
    params = params_of(measurement, model, search, fix, vary)
    # With several cycles the limit is that of each.
    with begin(search["max_time"] if several is None else None) as news:
        search |= {"progress": news.progress, "watch": news.watch, "tell": news.tell}
        if several is None:
            return api.fit(measurement, model=model, params=params, **search)
        from foamfit.study.cycles import fit_cycles

        return fit_cycles(
            test, specimen, cycles=several or None, model=model,
            params=lambda one: params_of(one, model, search, fix, vary), **search,
        )  # fmt: skip


def _model_name(model: str, relaxation: int = 0) -> str:
    """Return a model's name without spaces; InputError if it is none."""
    from foamfit.springs.model import Model

    return "auto" if model.strip() == "auto" else Model.parse(model, relaxation).name


def _save(found: FitResult | CycleFits, folder: Path, silent: bool, drawn: dict[str, Any]) -> None:
    """Write the folder; the line on the terminal says so."""
    from foamfit.report import folder as results
    from foamfit.report.studies.cycles import save_cycles
    from foamfit.results import Fit

    save = (
        partial(results.save_result, found)
        if isinstance(found, Fit)
        else partial(save_cycles, found)
    )
    with progress_line(silent, "fit") as shown, without_ctrl_c():
        shown.progress(1.0, "writing the report")
        results.save_somewhere(save, folder, **drawn)


def _tell_cycles(
    found: CycleFits, folder: Path, save: Callable[[], None], as_json: bool, quiet: bool
) -> int:
    """Write and print the fits of several cycles; returns the exit code."""
    import json

    from foamfit.report.studies.cycles import cycles_text

    content = found.to_json_dict()
    content["cycles"] = {n: one.to_json_dict() for n, one in sorted(found.results.items())}
    shown = json.dumps(content, allow_nan=False) if as_json else cycles_text(found)
    try:
        save()
    finally:  # the numbers are not lost with the folder
        if as_json or not quiet:
            say(shown)
    good = [n for n, one in found.results.items() if one.status != "failed"]
    if not good:
        say(f"foamfit: no acceptable fit of any cycle was found; see {folder}", err=True)
    return 0 if good else NOT_ACCEPTABLE


def _tell_result(result: FitResult, as_json: bool, quiet: bool, verbose: bool) -> None:
    """Print a result."""
    if as_json:
        import json

        say(json.dumps(result.to_json_dict(), allow_nan=False))
    elif not quiet:
        from foamfit.report.summary import summary_text

        say(summary_text(result, verbose=verbose))


def _result_folder(out: Path | None, test: Path, specimen: Path | None, model: str) -> Path:
    """Return the folder for a result, which must not be one that would be lost."""
    from foamfit.data.toml_file import toml_beside
    from foamfit.report.folder import try_target

    folder = Path("fits", toml_beside(test).stem, model) if out is None else out
    try_target(folder)
    spare(folder, (test, specimen or toml_beside(test)))
    return folder
