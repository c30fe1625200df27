"""`foamfit check`: what the loader understood of a test, and what the test can tell."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli.group import main
from foamfit.cli.options import (
    DRIVE,
    FILE,
    PLOT,
    RELAXATION,
    SPECIMEN,
    TEST,
    WIDTH,
    check_files,
    compiling,
)
from foamfit.errors import InputError
from foamfit.terminal import say


@main.command()
@TEST
@SPECIMEN
@click.option("--model", help="Also estimate what the test determines of this model.")
@DRIVE
@RELAXATION
@click.option("--published", "published_set", metavar="NAME", help="Start from a published set.")
@click.option(
    "--params", metavar="RESULT", type=FILE,
    help="Start from an earlier result. Default: a quick descent from the measured loop.",
)  # fmt: skip
@PLOT
@WIDTH
def check(
    test: Path, specimen: Path | None, model: str | None, drive: str | None,
    published_set: str | None, params: Path | None, plot: Path | None, figure_width: str,
    relaxation: int,
) -> None:  # fmt: skip
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
        given: dict[str, object] = {
            "drive": drive, "published": published_set, "params": params, "plot": plot,
            "relaxation": relaxation or None,
        }  # fmt: skip
        for option, value in given.items():
            if value is not None:
                raise InputError(f"--{option} needs --model; give one, as --model bistable")
    check_files(None, plot, ())
    if published_set is not None and params is not None:
        raise InputError("--published and --params exclude each other; give one of them")
    description = ""
    if model is None or test.suffix.lower() != ".toml":
        measurement = read_test(test, specimen)
        description = describe(measurement, audit(measurement), exact=model is None) + "\n"
    if model is None:
        say(description, newline=False)
        return
    from foamfit.report.outlook import outlook_of, outlook_text

    with compiling(False, model, relaxation) as compile_rest:
        compile_rest()
    outlook = outlook_of(
        test, specimen, model, drive, published_set=published_set, result=params,
        relaxation=relaxation,
    )  # fmt: skip
    if description:
        say(description)
    say(outlook_text(outlook))
    if plot is not None:
        from foamfit.report.identifiability_plots import plot_insight

        name, insight = outlook.problem.measurement.name, outlook.planned.insight
        if insight is None:
            say("\nnothing is drawn: no parameter changes the curves")
        else:
            title = f"{name} · {outlook.problem.model.name} · before the fit"
            plot_insight(insight, title=title, path=plot, width=figure_width)
            say(f"\ndrawn in {plot}, its data in {plot.with_suffix('.csv')}")
