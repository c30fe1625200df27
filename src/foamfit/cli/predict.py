"""`foamfit predict`: a test that was not fitted, predicted with its 95 % band."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from foamfit.cli.group import main
from foamfit.cli.options import (
    FILE,
    NO_REPORT,
    OPEN,
    SPECIMEN,
    TEST,
    WIDTH,
    check_open,
    compiling,
    spare,
    tell_written,
)
from foamfit.errors import InputError
from foamfit.terminal import say, without_ctrl_c

if TYPE_CHECKING:
    from foamfit.study.predict import Prediction


@main.command()
@click.argument("result", metavar="RESULT", type=FILE)
@TEST
@SPECIMEN
@click.option(
    "--cycle", type=click.IntRange(min=1), metavar="N",
    help="Cycle of a slow record. Default: the first.",
)  # fmt: skip
@click.option(
    "--drive", type=click.Choice(["impact", "stress", "displacement"]),
    help="Default: that of the result.",
)  # fmt: skip
@click.option(
    "--extrapolate", is_flag=True,
    help="Predict a rate outside the fitted ones by more than a factor of 1.25, too.",
)  # fmt: skip
@click.option(
    "--draws", type=click.IntRange(40, 100_000), default=400, show_default=True, metavar="N",
    help="Draws of the parameters for the band.",
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True,
    help="Same result, test and seed, same numbers.",
)  # fmt: skip
@click.option("--out", type=FILE, help="Folder. Default: predictions/<test>.")
@NO_REPORT
@WIDTH
@OPEN
@click.option(
    "--json", "as_json", is_flag=True, help="Print prediction.json on stdout, nothing else."
)
@click.option("--quiet", is_flag=True, help="Print nothing.")
def predict(
    result: Path, test: Path, specimen: Path | None, cycle: int | None, drive: str | None,
    extrapolate: bool, draws: int, seed: int, out: Path | None, no_report: bool,
    figure_width: str, as_json: bool, quiet: bool,
) -> int:  # fmt: skip
    """Predict TEST.csv from RESULT: the folder of a fit or of a joint fit, or its JSON.

    TEST.csv was not fitted; its specimen, striker and motion are simulated with the parameters of
    the result. The folder holds prediction.json, prediction.csv (per sample) and pictures: the
    curve with its 95 % band and what makes the band, the parameters, the scatter between specimens,
    the noise and what the law missed before.

    \b
    Examples:
        foamfit predict fits/TEST/microscale OTHER.csv
        foamfit predict joint/new-heel OTHER.csv --cycle 2 --out predictions/second
    """
    check_open(as_json, no_report)
    from foamfit.data.csv_file import read_test
    from foamfit.data.toml_file import toml_beside
    from foamfit.report.folder import save_somewhere, try_target
    from foamfit.report.studies.prediction import check_replaceable
    from foamfit.study.prediction.identified import read_source

    folder = Path("predictions", toml_beside(test).stem) if out is None else out
    check_replaceable(folder)
    try_target(folder)
    spare(folder, (test, specimen or toml_beside(test), result))
    read_source(result)  # a wrong path is told before anything is compiled
    with compiling(quiet or as_json) as compile_rest:
        measurement = read_test(test, specimen, cycle)
        from foamfit.study import predict as study

        compile_rest()
        found = study.predict(
            result, measurement, drive=drive, extrapolate=extrapolate, draws=draws, seed=seed
        )
        try:
            with without_ctrl_c():
                save_somewhere(found.save, folder, report=not no_report, figure_width=figure_width)
        except InputError:  # the numbers are not lost with the folder
            _tell(found, as_json, quiet)
            raise
    _tell(found, as_json, quiet)
    tell_written(folder / "prediction.png", quiet or as_json)
    return 0


def _tell(found: Prediction, as_json: bool, quiet: bool) -> None:
    """Print a prediction."""
    if as_json:
        import json

        say(json.dumps(found.to_json_dict(), allow_nan=False))
    elif not quiet:
        from foamfit.report.studies.prediction import prediction_text

        say(prediction_text(found))
