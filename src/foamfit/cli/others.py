"""The commands that do not fit: first those of a test or a scene, then those that use results."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from foamfit.cli import options
from foamfit.cli.fit import folder_name
from foamfit.cli.options import COUNT, FILE, Output, compile_solver, declared, main, option
from foamfit.errors import InputError
from foamfit.terminal import progress_line, say


@main.command()
@options.TEST
@options.SPECIMEN
def check(test: Path, specimen: Path | None) -> None:
    """Print how TEST.csv is understood, and its energy audit.

    Shows columns, units, contact, specimen and the rows that are not used.

    \b
    Example:
        foamfit check TEST.csv --specimen foam.toml
    """
    from foamfit.data.csv_file import read_test
    from foamfit.data.energy import audit
    from foamfit.report.summary import describe

    measurement = read_test(test, specimen)
    if measurement.priors:
        from foamfit.fitting.given import prior_of

        for name, value in measurement.priors.items():
            prior_of(name, value)  # refuses what no fit accepts
    say(describe(measurement, audit(measurement)))


@main.command()
@options.TEST
@option("--force", "Overwrite an existing TOML.")
@option("--rig", "Write a draft of a rig for foamfit plan, with the name given.")
def init(test: Path, force: bool, rig: bool) -> None:
    """Write a TOML for TEST.csv, with questions to answer.

    TEST.toml contains what the headers of TEST.csv say, and questions for the rest.
    Each question is a line after "# " with a unit and an example: enter your value and remove the
    "# ". An existing TOML is kept unless --force is given.

    \b
    Examples:
        foamfit init TEST.csv
        foamfit init --rig RIG.toml
    """
    from foamfit.data.rig import DRAFT
    from foamfit.data.tables.csv_table import read_text
    from foamfit.data.tables.draft import draft
    from foamfit.data.toml_file import toml_beside

    if rig:
        _write(test, DRAFT, force, "name another file")
        say(f"written to {test}; then: foamfit plan RESULT --rig {test}")
        return
    text, asked = draft(read_text(test, "the CSV file of a test"))
    target = toml_beside(test)
    _write(target, text, force, f"foamfit check {test} says what it lacks")
    say("\n    ".join([f"written to {target}; it asks for", *asked]))
    say(f"then: foamfit check {test}")


def _write(target: Path, text: str, force: bool, kept: str) -> None:
    """Write a new file, or with `force` replace it; `kept` tells about an existing one."""
    from foamfit.files import write_file

    if target.exists() and not force:
        raise InputError(
            f"{target} exists already and is not changed; {kept}, and --force overwrites it"
        )
    write_file(target, text.encode())


@main.command()
@click.argument("scene", metavar="SCENE.toml", type=FILE)
@option("--out", "CSV of the response. Default: SCENE.csv in this folder.", FILE)
@options.PLOT
@options.WIDTH
@option(
    "--rtol", "Largest error, divided by the range.", click.FloatRange(1e-14, 0.1), default=1e-6
)
def simulate(
    scene: Path, out: Path | None, plot: Path | None, figure_width: str, rtol: float
) -> None:
    """Simulate a chain and write the response as CSV.

    \b
    SCENE.toml, for example:
        [chain]
        diameter = "5 mm"
        [[chain.springs]]               # from the base up
        kind = "bistable"               # or "microscale", "linear", "unilateral"
        height = "1.19 mm"
        k0 = "5.5 MPa"
        kc = "82.5 MPa"
        dsigma = "-0.179 MPa"
        eps_a = 0.14
        eps_c = 0.31
        kh_plus = "14.3 MPa"
        kh_minus = "2.34 MPa"
        [drive]
        kind = "impact"                 # or "stress", "displacement" with file = "drive.csv"
        mass = "7 g"
        velocity = "2 m/s"
        [time]
        end = "1 ms"
        samples = 501
    Instead of springs, published = "foam-1/model-3" under [chain] selects a published set. A
    microscale spring has k0, kc, eps_star, sigma_plus, spread_plus, sigma_minus and spread_minus.
    Both may have relaxation terms: relaxation = [{ g = 0.5, tau = "0.2 s" }].
    """
    from foamfit.files import check_file
    from foamfit.scene_file import check_target, read_scene, write_response
    from foamfit.solve.simulation import simulate as run

    target = Path(f"{scene.stem}.csv") if out is None else out
    options.check_plot(plot)
    check_file(target)
    check_target(target)  # the scene and its drive are kept, as every file of others
    chain, drive, time = read_scene(scene)
    compile_solver(quiet=False)
    response = run(chain, drive, time, rtol)
    write_response(response, target)
    say(f"{response.solver}, {response.time.size} samples, written to {target}")
    if plot is not None:
        from foamfit.report.plots import plot_response

        plot_response(response, plot, width=figure_width)
        say(f"drawn in {plot}")


@main.command()
@click.argument("test", metavar="[TEST.csv]", type=FILE, required=False)
@option("--port", "Port of 127.0.0.1; 0: a free one.", click.IntRange(0, 65535), default=0)
@option("--no-browser", "Print the address only; open no browser.")
def page(test: Path | None, port: int, no_browser: bool) -> None:
    """Check, fit and explore TEST.csv in a browser.

    The page is served on this machine only (127.0.0.1). The first line of stdout is its address,
    which contains a random access token. Ctrl-C ends the server.

    \b
    Examples:
        foamfit page
        foamfit page TEST.csv
        foamfit page --no-browser --port 8123
    """
    if test is not None and not test.is_file():
        raise InputError(f"{test}: no such file; give the CSV of a test, or none.")
    try:
        import panel  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"the page needs Panel, which cannot be imported ({error}); install it by "
            'pip install "foamfit[page]"'
        ) from None
    from foamfit.page.server import serve

    serve(test, port, browser=not no_browser)


def _named(*results: str | Path, **given: Any) -> str:
    """Return a name like foam-bistable-cycle-2, for fits/foam/bistable and cycle 2."""
    names = list[str]()
    for one in results:
        place = Path(one).resolve()
        *above, last = (place.parent if place.is_file() else place).parts
        # The folders below fits/; elsewhere the last two
        below = len(above) - above[::-1].index("fits") if "fits" in above else -1
        names.append("-".join([*above[below:], last]))
    asked = {name: value for name, value in given.items() if value is not None}
    return folder_name({"model": "+".join(names), **asked})


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True, type=FILE)
@option(
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
    from foamfit.report.comparison import compare as side_by_side, comparison_text, plot_comparison

    options.check_plot(plot)
    comparison = side_by_side(results, name)
    say(comparison_text(comparison))
    if plot is not None:
        plot_comparison(comparison, plot, width=figure_width)
        say(f"\ndrawn in {plot}")


@main.command("list")
@click.argument("folder", metavar="[FOLDER]", default="fits", type=FILE)
@option("--open opening", "Open the page in the browser.")
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
    if (page := write_index(folder, found)) is not None:
        say(f"\nthe same with loops and links: {page}")
        if opening:
            options.open_page(page)


@main.command()
def published() -> None:
    """Print the published parameter sets and their derived points."""
    from foamfit.springs.published import table

    say(table())


@main.command()
@click.argument("result", metavar="RESULT", type=FILE)
@options.TEST
@options.SPECIMEN
@declared("cycle", help="Cycle of a slow record. Default: the first.", type=COUNT, metavar="N")
@options.CYCLES
@declared("drive", help="Default: the drive of the result.")
@option("--extrapolate", "Allow a rate outside the fitted rates by more than a factor of 1.25.")
@option(
    "--draws",
    "Number of random specimens for the band.",
    click.IntRange(40, 100_000),
    default=400,
    metavar="N",
)
@declared("seed", help="The same result, test and seed give the same numbers.")
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

    compile_solver(output.silent)
    output.finish(study.predict(result, measurement, **asked), folder / "prediction.png")


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True)
@option("--rig", "What the rig can do. Default: the record of RESULT.", FILE, metavar="RIG.toml")
@option(
    "--for quantity",
    "What the foam is needed for: peak_force, peak_strain, absorbed_energy or dissipated_energy "
    "at a velocity.",
    metavar='"peak_force at 3 m/s"',
)
@declared("seed", help="The same results, rig and seed give the same numbers.")
@options.output("plans/<results and options>", "plan.json")
def plan(
    results: tuple[str, ...], rig: Path | None, quantity: str | None, seed: int, output: Output
) -> None:
    """Find the next test: the one that would determine most.

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
    name = _named(*results, rig=rig and rig.stem, quantity=quantity)
    folder = output.folder(Path("plans", name), "plan.json")
    from foamfit.study import plan as study

    compile_solver(output.silent)
    with progress_line(output.silent, "plan") as line:
        found = study.plan(*results, rig=rig, quantity=quantity, seed=seed,
                           progress=line.progress)  # fmt: skip
    output.finish(found, folder / "plan.html")


@main.command()
@click.argument("result", metavar="RESULT", type=FILE)
@option(
    "--format",
    "LS-DYNA *MAT_083 or *MAT_057, Radioss LAW90, Abaqus low-density foam, or curves only.",
    metavar="mat083|mat057|law90|abaqus|csv",
    required=True,
)
@option(
    "--units", "Consistent units of the card.", metavar="kg-mm-ms|t-mm-s|SI", default="kg-mm-ms"
)
@option(
    "--rates",
    "Strain rates of the loading curves, 1/s. Default: those of the fitted tests.",
    metavar="RATE,RATE,…",
)
@option(
    "--out",
    "Card file. Default: cards/<result>-<format> with the extension of the format.",
    FILE,
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
    if (result if result.is_dir() else result.parent).resolve() in file.resolve().parents:
        raise InputError(
            f"{file} lies in a result folder, which may be replaced; choose another --out"
        )
    compile_solver(False, source.model.name)
    made = cards.card(result, format=format, units=units, rates=asked)
    if out is None:
        with suppress(OSError):  # saving says that there is no such folder
            file.parent.mkdir(exist_ok=True)
    made.save(file)
    say(f"{made}\nwritten to {file}, with {file.name}.json, .png and .pdf beside it")
