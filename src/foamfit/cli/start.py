"""`foamfit check`, `init`, `simulate` and `page`."""

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.errors import InputError
from foamfit.terminal import say


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
    from foamfit.report.described import describe

    measurement = read_test(test, specimen)
    if measurement.priors:
        from foamfit.fitting.problem import prior_of

        for name, value in measurement.priors.items():
            prior_of(name, value)  # refuses what no fit accepts
    say(describe(measurement, audit(measurement)))


@main.command()
@options.TEST
@options.option("--force", "Overwrite an existing TOML.")
@options.option("--rig", "Write a draft of a rig for foamfit plan, with the name given.")
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
@click.argument("scene", metavar="SCENE.toml", type=options.FILE)
@options.option("--out", "CSV of the response. Default: SCENE.csv in this folder.", options.FILE)
@options.PLOT
@options.WIDTH
@options.option(
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

    target = Path(scene.with_suffix(".csv").name) if out is None else out
    options.check_plot(plot)
    check_file(target)
    check_target(target)  # the scene and its drive are kept, as every file of others
    chain, drive, time = read_scene(scene)
    options.compile_solver(quiet=False)
    response = run(chain, drive, time, rtol)
    write_response(response, target)
    say(f"{response.solver}, {response.time.size} samples, written to {target}")
    if plot is not None:
        from foamfit.report.plots import plot_response

        plot_response(response, plot, width=figure_width)
        say(f"drawn in {plot}")


@main.command()
@click.argument("test", metavar="[TEST.csv]", type=options.FILE, required=False)
@options.option("--port", "Port of 127.0.0.1. Default: a free one.", click.IntRange(1, 65535))
@options.option("--no-browser", "Print the address only; open no browser.")
def page(test: Path | None, port: int | None, no_browser: bool) -> None:
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

    serve(test, port or 0, browser=not no_browser)
