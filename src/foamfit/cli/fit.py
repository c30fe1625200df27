"""`foamfit fit`: identify the parameters of a test, or of the cycles of a record."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit.cli import fitting, options
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import Output
from foamfit.cli.progress import Progress, progress_line
from foamfit.terminal import say

if TYPE_CHECKING:
    from foamfit.study.cycles import CycleFits


@main.command()
@options.TEST
@options.SPECIMEN
@options.CYCLE
@options.CYCLES
@fitting.fit_options
@options.output("fits/<test>/<model>", "fit.json")
@options.option("--verbose", "Print the checklist, reasons, notes and all models too.")
def fit(test: Path, specimen: Path | None, output: Output, verbose: bool, **asked: Any) -> int:
    """Identify the parameters of TEST.csv and write a result folder.

    With several cycles the folder holds one result folder for each, cycles.csv, cycles.png and
    cycles.json: the parameters by cycle.

    Exit code 0: a fit was made; 1: the input or the call is wrong; 2: no acceptable fit was found
    (what was found is written); 70: a defect of foamfit; 130 and 143: ended by Ctrl-C or SIGTERM
    before anything was found (else the best so far is the result).

    \b
    Examples:
        foamfit fit TEST.csv
        foamfit fit TEST.csv --model auto --open
        foamfit fit TEST.csv --model microscale --relaxation 1
        foamfit fit TEST.csv --model microscale --relaxation 1 --cycle all
        foamfit fit TEST.csv --model microscale --stiffening --mullins --cycles 1-3
        foamfit fit TEST.csv --drive displacement --out results/today --figure-width one
        foamfit fit TEST.csv --model linear+bistable --fix s1_k0=60e6
    """
    output.check(without_report=False)
    model = asked["model"] = fitting.model_name(asked)
    with (
        options.compiling(output.silent, model, asked["relaxation"]) as compile_rest,
        options.drawing_beside() as drawers,
    ):
        from foamfit.data.toml_file import toml_beside

        toml = toml_beside(test)
        folder = output.folder(Path("fits", toml.stem, model), (test, specimen or toml))

        def begin(limit: float | None) -> AbstractContextManager[Progress]:
            compile_rest()
            if not output.no_report:
                drawers.begin()
            return progress_line(output.silent, "fit", limit, says=not output.quiet)

        found = fitting.fit_as_asked(test, specimen, asked, begin)
        from foamfit.report import folder as result_folder
        from foamfit.report.studies import cycles
        from foamfit.report.summary import summary_text
        from foamfit.results import Fit

        save: Callable[..., object]
        if isinstance(found, Fit):
            page, which, failed = "report.html", "", found.status == "failed"
            save, content = partial(result_folder.save_result, found), found.to_json_dict
            text = partial(summary_text, found, verbose=verbose)
        else:
            page, which = "cycles.png", " of any cycle"
            failed = all(one.status == "failed" for one in found.results.values())
            save, content = partial(cycles.save_cycles, found), partial(_content, found)
            text = partial(cycles.cycles_text, found)
        drawn = {"width": output.figure_width, "mapped": drawers.map}
        output.finish(save, folder / page, content, text, **drawn)
    if failed:
        say(f"foamfit: no acceptable fit{which} was found; see {folder}", err=True)
    return NOT_ACCEPTABLE if failed else 0


def _content(found: CycleFits) -> dict[str, Any]:
    """Return the fits of several cycles as JSON has them."""
    each = {n: one.to_json_dict() for n, one in sorted(found.results.items())}
    return found.to_json_dict() | {"cycles": each}
