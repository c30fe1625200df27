"""`foamfit predict`: an unseen test, predicted with its 95 % band."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.cli.options import Output


@main.command()
@click.argument("result", metavar="RESULT", type=options.FILE)
@options.TEST
@options.SPECIMEN
@options.option(
    "--cycle", "Cycle of a slow record. Default: the first.", options.COUNT, metavar="N"
)
@options.CYCLES
@options.option(
    "--drive",
    "Default: that of the result.",
    click.Choice(["impact", "stress", "displacement"]),
)
@options.option(
    "--extrapolate", "Also predict a rate outside the fitted ones by more than a factor of 1.25."
)
@options.option(
    "--draws",
    "Draws of specimens for the band.",
    click.IntRange(40, 100_000),
    default=400,
    metavar="N",
)
@options.option(
    "--seed", "The same result, test and seed give the same numbers.", options.WHOLE, default=0
)
@options.output("predictions/<test>", "prediction.json")
def predict(
    result: Path,
    test: Path,
    specimen: Path | None,
    cycle: int | None,
    cycles: tuple[int, int] | None,
    output: Output,
    **asked: Any,
) -> None:
    """Predict TEST.csv from RESULT: the folder of a fit or of a joint fit, or its JSON.

    TEST.csv was not fitted; its specimen, striker and motion are simulated with the parameters of
    the result. The folder holds prediction.json, prediction.csv (per sample) and pictures: the
    curve with its 95 % band and what makes the band, the parameters, the scatter between specimens,
    the noise and what the law missed before.

    \b
    Examples:
        foamfit predict fits/TEST/microscale OTHER.csv
        foamfit predict joint/new-heel OTHER.csv --cycle 2 --out predictions/second
        foamfit predict fits/TEST/microscale TEST.csv --cycles 1-5
    """
    output.check(without_report=False)
    from foamfit.data.csv_file import read_test
    from foamfit.data.toml_file import toml_beside
    from foamfit.report.studies.prediction import check_replaceable, prediction_text
    from foamfit.study.prediction.identified import read_source

    toml = toml_beside(test)
    default = Path("predictions", toml.stem)
    check_replaceable(output.out or default)
    folder = output.folder(default, (test, specimen or toml, result))
    read_source(result)  # a wrong path is reported before anything is compiled
    with options.compiling(output.silent) as compile_rest:
        measurement = read_test(test, specimen, cycle, cycles=cycles)
        from foamfit.study import predict as study

        compile_rest()
        found = study.predict(result, measurement, **asked)
        output.finish(
            found.save,
            folder / "prediction.png",
            found.to_json_dict,
            lambda: prediction_text(found),
            figure_width=output.figure_width,
        )
