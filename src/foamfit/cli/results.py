"""`foamfit compare`, `list`, `published`, `predict`, `plan`, `card`: commands that use results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from foamfit.cli import options
from foamfit.cli.fit import folder_name
from foamfit.cli.group import main
from foamfit.cli.options import Output
from foamfit.cli.progress import progress_line
from foamfit.errors import InputError
from foamfit.terminal import say


def _named(*results: str | Path, **given: Any) -> str:
    """Return a name from the places of results below fits/, and from the options given.

    It is foam-bistable-cycle-2 for fits/foam/bistable and cycle 2. Of a result elsewhere it has the
    last two folders.
    """
    names = list[str]()
    for one in results:
        place = Path(one).resolve()
        *above, last = (place.parent if place.is_file() else place).parts
        below = len(above) - above[::-1].index("fits") if "fits" in above else -1
        names.append("-".join([*above[below:], last]))
    asked = {name: value for name, value in given.items() if value is not None}
    return folder_name({"model": "+".join(names), **asked})


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True, type=options.FILE)
@options.option(
    "--published name",
    "Published set to compare with. Default: the one in the name of the test.",
    str,
    metavar="NAME",
)
@options.PLOT
@options.WIDTH
def compare(
    results: tuple[Path, ...], name: str | None, plot: Path | None, figure_width: str
) -> None:
    """Compare results with published parameters or each other.

    Without a published set they are compared with the first result.

    \b
    Examples:
        foamfit compare fits/foam-1/model-1/impact fits/foam-1/model-1/stress
        foamfit compare fits/TEST/bistable --published foam-1/model-1 --plot comparison.png
    """
    from foamfit.report.comparison import compare as side_by_side
    from foamfit.report.comparison import comparison_text, plot_comparison

    options.check_plot(plot)
    comparison = side_by_side(results, name)
    say(comparison_text(comparison))
    if plot is not None:
        plot_comparison(comparison, plot, width=figure_width)
        say(f"\ndrawn in {plot}")


@main.command("list")
@click.argument("folder", metavar="[FOLDER]", default="fits", type=options.FILE)
@options.option("--open opening", "Open the page in the browser.")
def list_results(folder: Path, opening: bool) -> None:
    """List the results in FOLDER (default: fits), a line each.

    Writes FOLDER/index.html: a table to sort, with small loops and links to the reports.

    \b
    Examples:
        foamfit list
        foamfit list runs --open
    """
    from foamfit.report.listing import lines, results_in, write_index

    found = results_in(folder)
    say(lines(found, folder))
    page = write_index(folder, found)
    if page is not None:
        say(f"\nthe same with loops and links: {page}")
        if opening:
            options.open_page(page)


@main.command()
def published() -> None:
    """Print the published parameter sets and their derived points."""
    from foamfit.springs.published import table

    say(table())


@main.command()
@click.argument("result", metavar="RESULT", type=options.FILE)
@options.TEST
@options.SPECIMEN
@options.declared(
    "cycle",
    help="Cycle of a slow record. Default: the first.",
    type=options.COUNT,
    metavar="N",
    callback=None,
)
@options.CYCLES
@options.declared("drive", help="Default: the drive of the result.")
@options.option(
    "--extrapolate", "Allow a rate outside the fitted rates by more than a factor of 1.25."
)
@options.option(
    "--draws",
    "Number of random specimens for the band.",
    click.IntRange(40, 100_000),
    default=400,
    metavar="N",
)
@options.declared("seed", help="The same result, test and seed give the same numbers.")
@options.output("predictions/<test>/<result and options>", "prediction.json")
def predict(
    result: Path,
    test: Path,
    specimen: Path | None,
    cycle: int | None,
    cycles: tuple[int, int] | None,
    output: Output,
    **asked: Any,
) -> None:
    """Predict an unseen test from the result of a fit.

    RESULT is the folder of a fit or joint fit, or its JSON. The specimen, striker and motion of
    TEST.csv are simulated with the parameters of RESULT. The folder contains prediction.json,
    prediction.csv (per sample) and figures: the curve with its 95 % band, and the parts of the
    band: parameters, scatter between specimens, noise and the error of the law in fitted tests.

    \b
    Examples:
        foamfit predict fits/TEST/microscale OTHER.csv
        foamfit predict joint/new-heel OTHER.csv --cycle 2 --out predictions/second
        foamfit predict fits/TEST/microscale TEST.csv --cycles 1-5
    """
    output.check(without_report=False)
    from foamfit.data.csv_file import read_test
    from foamfit.data.toml_file import toml_beside
    from foamfit.study.identified import read_source

    given: dict[str, Any] = {"cycle": cycle, "cycles": cycles and "-".join(map(str, cycles))}
    given |= {"drive": asked["drive"], "specimen": specimen and specimen.stem}
    name = _named(result, **given)
    folder = output.folder(Path("predictions", toml_beside(test).stem, name), "prediction.json")
    read_source(result)  # report a wrong path before anything is compiled
    measurement = read_test(test, specimen, cycle, cycles=cycles)
    from foamfit.study import predict as study

    options.compile_solver(output.silent)
    found = study.predict(result, measurement, **asked)
    output.finish(found, folder / "prediction.png")


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True)
@options.option("--rig", "What the rig can do. Default: the record of RESULT.", options.FILE,
                metavar="RIG.toml")  # fmt: skip
@options.option(
    "--for quantity",
    "What the foam is needed for: peak_force, peak_strain, absorbed_energy or dissipated_energy "
    "at a velocity.",
    metavar='"peak_force at 3 m/s"',
)
@options.declared("seed", help="The same results, rig and seed give the same numbers.")
@options.output("plans/<results and options>", "plan.json")
def plan(
    results: tuple[str, ...], rig: Path | None, quantity: str | None, seed: int, output: Output
) -> None:
    """Find the test that would determine most of what the results leave open.

    RESULT is the folder of a fit or joint fit, or a published set. Several results of one model are
    tests of one foam; a result of another model is a rival, which the test should tell apart.
    Every test of the rig is simulated over what the results leave open. Writes plan.json,
    plan.html, figures, next.toml (the TOML of the advised test) and joint.toml, which fits its
    record together with the tests at hand. `foamfit init --rig RIG.toml` writes a draft of the rig.

    \b
    Examples:
        foamfit plan fits/TEST/bistable
        foamfit plan fits/TEST/bistable --rig RIG.toml --for "peak_force at 3 m/s"
        foamfit plan foam-1/model-2
    """
    output.check(without_report=False)
    name = _named(*results, rig=rig and rig.stem, quantity=quantity)
    folder = output.folder(Path("plans", name), "plan.json")
    from foamfit.study import plan as study

    options.compile_solver(output.silent)
    with progress_line(output.silent, "plan") as line:
        found = study.plan(*results, rig=rig, quantity=quantity, seed=seed,
                           progress=line.progress)  # fmt: skip
    output.finish(found, folder / "plan.html")


@main.command()
@click.argument("result", metavar="RESULT", type=options.FILE)
@options.option(
    "--format",
    "LS-DYNA *MAT_083 or *MAT_057, Radioss LAW90, Abaqus low-density foam, or curves only.",
    metavar="mat083|mat057|law90|abaqus|csv",
    required=True,
)
@options.option(
    "--units", "Consistent units of the card.", metavar="kg-mm-ms|t-mm-s|SI", default="kg-mm-ms"
)
@options.option(
    "--rates",
    "Strain rates of the loading curves, 1/s. Default: those of the fitted tests.",
    metavar="RATE,RATE,…",
)
@options.option(
    "--out",
    "Card file. Default: cards/<result>-<format> with the extension of the format.",
    options.FILE,
)
def card(result: Path, format: str, units: str, rates: str | None, out: Path | None) -> None:
    """Write a material card for finite elements.

    RESULT is the folder of a fit or joint fit.
    FILE.json (parameters, curves in SI units, misfit of fit and card), FILE.png and FILE.pdf
    (measured, fitted, card) are written next to FILE. A rate outside the fitted rates gets the
    curve of the nearest fitted rate, with a warning; beyond the measured strain the law
    extrapolates.

    \b
    Examples:
        foamfit card fits/TEST/microscale --format mat083
        foamfit card joint/new-heel --format law90 --units t-mm-s --rates 0.01,1,100 --out foam.rad
    """
    from foamfit.cards import card as cards
    from foamfit.study.identified import read_source

    asked = None if rates is None else rates.split(",")
    cards.check(format, units, asked)
    source = read_source(result)
    file = out or Path("cards", f"{_named(result)}-{format}{cards.FORMATS[format][0]}")
    folder = result if result.is_dir() else result.parent
    if folder.resolve() in file.resolve().parents:
        raise InputError(
            f"{file} lies in a result folder, which may be replaced; choose another --out"
        )
    options.compile_solver(False, source.model.name)
    made = cards.card(result, format=format, units=units, rates=asked)
    if out is None:
        try:
            file.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{file.parent} cannot be made: {error.strerror}; give --out"
            ) from None
    made.save(file)
    say(f"{made}\nwritten to {file}, with {file.name}.json, .png and .pdf beside it")
