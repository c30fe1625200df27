"""`foamfit fit`: identify the parameters of a test, or of the cycles of a record."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli.fit_options import fit_options, intervals_of, params_of
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import (
    CYCLE,
    FILE,
    SPECIMEN,
    TEST,
    compiling,
    cycles_of,
    drawing_beside,
    progress_bar,
    spare,
)
from foamfit.errors import InputError
from foamfit.terminal import say, without_ctrl_c

if TYPE_CHECKING:
    from foamfit.api import FitResult
    from foamfit.report.result_figures import Mapped
    from foamfit.study.cycles import CycleFits


@main.command()
@TEST
@SPECIMEN
@CYCLE
@click.option("--out", type=FILE, help="Result folder. Default: fits/<test>/<model>.")
@fit_options
@click.option("--json", "as_json", is_flag=True, help="Print fit.json on stdout, nothing else.")
@click.option("--quiet", is_flag=True, help="Print nothing but warnings of failure.")
@click.option(
    "--verbose", is_flag=True, help="Print the checklist, reasons, notes and all models too."
)
def fit(
    test: Path, specimen: Path | None, cycle: str | None, model: str, out: Path | None,
    fix: dict[str, float], vary: tuple[str, ...],
    as_json: bool, quiet: bool, verbose: bool, **search: Any,
) -> int:  # fmt: skip
    """Identify the parameters of TEST.csv and write a result folder.

    With several cycles the folder holds one result folder for each, cycles.csv, cycles.png and
    cycles.json: what changes from cycle to cycle, by one fit of them together.

    Exit code 0: a fit was made; 1: the input or the call is wrong; 2: no acceptable fit was found
    (what was found is written); 70: a defect of foamfit; 130 and 143: ended by Ctrl-C before
    anything was found, and by SIGTERM.

    \b
    Examples:
        foamfit fit TEST.csv
        foamfit fit TEST.csv --model auto
        foamfit fit TEST.csv --model microscale --relaxation 1
        foamfit fit TEST.csv --model microscale --relaxation 1 --cycle all
        foamfit fit TEST.csv --drive displacement --out results/today
        foamfit fit TEST.csv --model linear+bistable --fix s1_k0=60e6
    """
    from foamfit.data.csv_file import read_test
    from foamfit.springs.model import Model

    search |= intervals_of(**{way: search.pop(way) for way in ("profile", "bootstrap", "mcmc")})
    model = "auto" if model.strip() == "auto" else Model.parse(model).name
    alone, several = cycles_of(cycle)
    with ExitStack() as beside:
        compile_rest = beside.enter_context(
            compiling(quiet or as_json, model, search["relaxation"])
        )
        measurement = read_test(test, specimen, alone)
        folder = _result_folder(out, test, specimen, model)
        from foamfit import api
        from foamfit.report.folder import save_result

        params = params_of(measurement, model, search, fix, vary)
        compile_rest()
        mapped = beside.enter_context(drawing_beside())
        tell = None if quiet else lambda told: say(f"foamfit: {told}", err=True)
        with progress_bar(quiet or as_json) as progress:
            if several is not None:
                from foamfit.study.cycles import fit_cycles

                found = fit_cycles(
                    test, specimen, cycles=several or None, model=model, progress=progress,
                    tell=tell, **search,
                    params=lambda one: params_of(one, model, search, fix, vary),
                )  # fmt: skip
            else:
                result = api.fit(
                    measurement, model=model, params=params, progress=progress, tell=tell, **search
                )
        if several is not None:
            return _tell_cycles(found, folder, mapped, as_json, quiet)
        try:
            with without_ctrl_c():
                save_result(result, folder, mapped)
        except InputError:  # the numbers are not lost with the folder
            _tell_result(result, as_json, quiet, verbose)
            raise
    _tell_result(result, as_json, quiet, verbose)
    if not quiet and not as_json:
        say(f"\nwritten to {folder}: open {folder / 'report.html'}")
    if result.status == "failed":
        say(f"foamfit: no acceptable fit was found; see {folder}", err=True)
        return NOT_ACCEPTABLE
    return 0


def _tell_cycles(found: CycleFits, folder: Path, mapped: Mapped, as_json: bool, quiet: bool) -> int:
    """Write and print the fits of several cycles; returns the exit code."""
    import json

    from foamfit.report.studies.cycles import cycles_text, save_cycles

    content = found.to_json_dict()
    content["cycles"] = {n: one.to_json_dict() for n, one in sorted(found.results.items())}
    shown = json.dumps(content, allow_nan=False) if as_json else cycles_text(found)
    try:
        with without_ctrl_c():
            save_cycles(found, folder, mapped)
    finally:  # the numbers are not lost with the folder
        if as_json or not quiet:
            say(shown)
    if not quiet and not as_json:
        say(f"\nwritten to {folder}: open {folder / 'cycles.png'}")
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
    from foamfit.report.folder import check_target

    folder = Path("fits", test.stem, model) if out is None else out
    check_target(folder)
    spare(folder, (test, specimen or test.with_suffix(".toml")))
    return folder
