"""`foamfit fit`; its options and the call of the fit are shared with batch and page."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli import options
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import COUNT, Output, option
from foamfit.cli.progress import Progress, progress_line
from foamfit.errors import InputError
from foamfit.springs.options import OPTIONS
from foamfit.terminal import say

if TYPE_CHECKING:
    from foamfit.api import FitResult
    from foamfit.report.studies.cycles import CycleFits

# Options that are not keywords of `foamfit.fit`, and options that select its `intervals`.
NO_KEYWORDS, WAYS = ("cycle", "cycles", "model"), ("profile", "mcmc")


def _fixes(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> dict[str, float] | None:
    fixed = {}
    for text in values:
        name, _, number = text.partition("=")
        try:
            fixed[name.strip()] = value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise click.BadParameter(f"'{text}' is not NAME=VALUE in SI, as s1_eta=0.")
    return fixed or None


fit_options = options.together(
    option(
        "--model",
        "Springs from the base up; auto selects the simplest model that describes the curves.",
        default="bistable",
    ),
    options.DRIVE,
    option("--seed", "The same test and seed give the same numbers.", options.WHOLE, default=0),
    option(
        "--starts",
        "Start points of the search. Default: 16 per spring, 48 if several are hysteretic.",
        COUNT,
    ),
    option(
        "--max-time", "Time limit; the best point so far is returned.", float, metavar="SECONDS"
    ),
    option("--fix", "Fix a parameter (SI).", multiple=True, metavar="NAME=VALUE", callback=_fixes),
    option("--vary", "Vary a parameter that is fixed by default.", multiple=True, metavar="NAME"),
    option("--interior-mass", "Distribute the specimen's mass between the springs."),
    option("--time-shift", "Fit the delay of the motion relative to the force."),
    options.RELAXATION,
    *options.MORE,
    option("--profile", "95 % intervals by profile likelihood."),
    option("--mcmc", "95 % intervals by N steps of emcee.", int, metavar="N"),
)


def model_name(asked: Mapping[str, Any]) -> str:
    """Return the name of the model without spaces; InputError for an unknown model."""
    from foamfit.springs.model import Model, with_options

    model = asked["model"].strip()
    with_options(model, **{name: asked[name] for name in OPTIONS})
    return "auto" if model == "auto" else Model.parse(model, asked["relaxation"]).words


def cycles_of(asked: Mapping[str, Any]) -> int | tuple[int, ...] | None:
    """Return the value of --cycle: a number, several numbers, or () for "all".

    Raises InputError if it is invalid, or if --cycles is given too.
    """
    text = asked["cycle"]
    if text is not None and asked["cycles"] is not None:
        raise InputError("give either --cycle or --cycles, not both")
    if text is None or text.strip().lower() == "all":
        return None if text is None else ()
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--cycle {text!r} must be a number from 1 up, several as 1,2,10, or all")
    numbers = tuple(int(part) for part in parts)
    return numbers if len(numbers) > 1 else numbers[0]


def keywords_of(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a command as keywords of `foamfit.fit`."""
    given = {way: asked[way] for way in WAYS if asked[way] not in (None, False)}
    if len(given) > 1:
        names = " and ".join(f"--{way}" for way in given)
        raise InputError(f"{names} exclude each other; choose one method for the intervals")
    search = {name: one for name, one in asked.items() if name not in (*NO_KEYWORDS, *WAYS)}
    way, draws = next(iter(given.items()), ("auto", None))
    return search | {"intervals": way, "draws": None if draws is True else draws}


def fit_as_asked(
    test: Path,
    specimen: Path | None,
    asked: Mapping[str, Any],
    begin: Callable[[float | None], AbstractContextManager[Progress]],
) -> FitResult | CycleFits:
    """Fit a test, or cycles of a record, with the options of the command.

    `begin` is called after all files are read and before the first simulation, with the time limit
    (s) of the fit if there is one; the fit reports its progress to the object that it returns.
    """
    from foamfit.data.csv_file import read_test

    search = keywords_of(asked)
    model = model_name(asked)
    wanted = cycles_of(asked)
    several = wanted if isinstance(wanted, tuple) else None
    alone = None if isinstance(wanted, tuple) else wanted
    measurement = read_test(test, specimen, alone, cycles=asked["cycles"])
    for number in set(several or ()).difference(measurement.cycles):
        last = f"its cycles are {min(measurement.cycles)} to {max(measurement.cycles)}"
        raise InputError(f"--cycle {asked['cycle']}: {test} has no cycle {number}; {last}")
    from foamfit import api
    from foamfit.one_model import Options

    Options(**search).check(measurement, model)  # fail before anything is compiled
    with begin(search["max_time"] if several is None else None) as news:  # else a limit per cycle
        search |= {"progress": news.progress, "watch": news.watch, "tell": news.tell}
        if several is None:
            return api.fit(measurement, model=model, **search)
        from foamfit.study import cycles as study

        return study.fit_cycles(test, specimen, cycles=several or None, model=model, **search)


@main.command()
@options.TEST
@options.SPECIMEN
@options.CYCLE
@options.CYCLES
@fit_options
@options.output("fits/<test>/<model>", "fit.json")
@options.option("--verbose", "Also print the checklist, reasons, notes and all models.")
def fit(test: Path, specimen: Path | None, output: Output, verbose: bool, **asked: Any) -> int:
    """Identify the parameters of TEST.csv and write a result folder.

    With several cycles the folder holds one result folder for each, cycles.csv, cycles.png and
    cycles.json: the parameters by cycle.

    Exit code 0: a fit was made; 1: the input or the call is wrong; 2: no acceptable fit was found
    (the best one is written); 70: a defect of foamfit; 130 and 143: ended by Ctrl-C or SIGTERM
    before any result (later, the best point so far is the result).

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
    model = asked["model"] = model_name(asked)
    with (
        options.compiling(output.silent, model, asked["relaxation"]) as compile_rest,
        closing(options.Drawers()) as drawers,
    ):
        from foamfit.data.toml_file import toml_beside

        toml = toml_beside(test)
        folder = output.folder(Path("fits", toml.stem, model), (test, specimen or toml))

        def begin(limit: float | None) -> AbstractContextManager[Progress]:
            compile_rest()
            if not output.no_report:
                drawers.begin()
            return progress_line(output.silent, "fit", limit, says=not output.quiet)

        found = fit_as_asked(test, specimen, asked, begin)
        from foamfit.report.studies.cycles import cycles_text
        from foamfit.report.summary import summary_text
        from foamfit.results import Fit

        if isinstance(found, Fit):
            page, which, failed = "report.html", "", found.status == "failed"
            content, text = found.to_json_dict, partial(summary_text, found, verbose=verbose)
        else:
            page, which = "cycles.png", " of any cycle"
            failed = all(one.status == "failed" for one in found.results.values())
            content, text = partial(_content_of, found), partial(cycles_text, found)
        output.finish(found.save, folder / page, content, text, mapped=drawers.map)
    if failed:
        say(f"foamfit: no acceptable fit{which} was found; see {folder}", err=True)
    return NOT_ACCEPTABLE if failed else 0


def _content_of(found: CycleFits) -> dict[str, Any]:
    """Return the fits of several cycles as content of a JSON file."""
    each = {n: one.to_json_dict() for n, one in sorted(found.results.items())}
    return found.to_json_dict() | {"cycles": each}
