"""`foamfit check`: what the loader understood of a test, and what the test can tell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.errors import InputError
from foamfit.terminal import say


@main.command()
@options.TEST
@options.SPECIMEN
@options.option("--model", "Also estimate what the test determines of this model.", str)
@options.DRIVE
@options.RELAXATION
@options.option("--published", "Start from a published set.", str, metavar="NAME")
@options.option(
    "--params",
    "Start from an earlier result. Default: a quick descent from the measured loop.",
    options.FILE,
    metavar="RESULT",
)
@options.PLOT
@options.WIDTH
def check(
    test: Path,
    specimen: Path | None,
    model: str | None,
    drive: str | None,
    relaxation: int,
    published: str | None,
    params: Path | None,
    plot: Path | None,
    figure_width: str,
) -> None:
    """Say what the loader understood of TEST.csv: columns, contact, specimen, energy.

    With --model also what the test determines: the velocity that closes the loop, the standard
    errors to expect, the channel worth measuring better. A TOML in place of the CSV plans a test
    that is not made yet, if --published or --params says what foam it will be.

    \b
    Examples:
        foamfit check TEST.csv --specimen foam.toml
        foamfit check TEST.csv --model bistable --plot what.png
        foamfit check PLAN.toml --model bistable --published foam-1/model-1
    """
    from foamfit.data.csv_file import read_test
    from foamfit.data.describe import describe
    from foamfit.data.energy import audit

    if model is None:
        given = {"drive": drive, "published": published, "params": params, "plot": plot}
        for name, value in (given | {"relaxation": relaxation or None}).items():
            if value is not None:
                raise InputError(f"--{name} needs --model; give one, as --model bistable")
    options.check_files(None, plot, ())
    if published is not None and params is not None:
        raise InputError("--published and --params exclude each other; give one of them")
    told = []
    if model is None or test.suffix.lower() != ".toml":
        measurement = read_test(test, specimen)
        told.append(describe(measurement, audit(measurement), exact=model is None))
    if model is None:
        say(told[0])
        return
    from foamfit.report.identifiability_plots import plot_insight
    from foamfit.report.outlook import outlook_of, outlook_text

    with options.compiling(False, model, relaxation) as compile_rest:
        compile_rest()
    start: dict[str, Any] = {"published_set": published, "result": params, "relaxation": relaxation}
    outlook = outlook_of(test, specimen, model, drive, **start)
    told.append(outlook_text(outlook))
    insight, problem = outlook.planned.insight, outlook.problem
    if plot is not None and insight is None:
        told.append("nothing is drawn: no parameter changes the curves")
    elif plot is not None and insight is not None:
        title = f"{problem.measurement.name} · {problem.model.name} · before the fit"
        plot_insight(insight, title=title, path=plot, width=figure_width)
        told.append(f"drawn in {plot}, its data in {plot.with_suffix('.csv')}")
    say("\n\n".join(told))
