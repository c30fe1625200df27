"""`foamfit simulate`: a forward run of any chain."""

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.terminal import say


@main.command()
@click.argument("scene", metavar="SCENE.toml", type=options.FILE)
@options.option("--out", "CSV. Default: SCENE.csv here.", options.FILE)
@options.PLOT
@options.WIDTH
@options.option(
    "--rtol", "Wanted error over the range.", click.FloatRange(1e-14, 0.1), default=1e-6
)
def simulate(
    scene: Path, out: Path | None, plot: Path | None, figure_width: str, rtol: float
) -> None:
    """Run any chain under any drive forward and write its response as CSV.

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
    Instead of the springs, published = "foam-1/model-3" under [chain] takes a published set. A
    microscale spring has k0, kc, eps_star, sigma_plus, spread_plus, sigma_minus and spread_minus;
    it and the bistable one may relax: relaxation = [{ g = 0.5, tau = "0.2 s" }].
    """
    from foamfit.scene_file import check_target, files_of_scene, read_scene, write_response
    from foamfit.solve.simulation import simulate as run

    target = Path(scene.with_suffix(".csv").name) if out is None else out
    options.check_files(target, plot, files_of_scene(scene))
    check_target(target)
    with options.compiling(quiet=False) as compile_rest:
        chain, drive, time = read_scene(scene)
        compile_rest()
    response = run(chain, drive, time, rtol)
    write_response(response, target)
    say(f"{response.solver}, {response.time.size} samples, written to {target}")
    if plot is not None:
        from foamfit.report.plots import plot_response

        plot_response(response, plot, width=figure_width)
        say(f"drawn in {plot}")
