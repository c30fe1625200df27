"""`foamfit compare` and `foamfit published`: fitted beside published parameters."""

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.terminal import say


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True, type=options.FILE)
@options.option(
    "--published name",
    "The published set to compare with. Default: the one in the name of the test.",
    str,
    metavar="NAME",
)
@options.PLOT
@options.WIDTH
@options.option("--csv table", "Also write a table.", options.FILE)
def compare(
    results: tuple[Path, ...],
    name: str | None,
    plot: Path | None,
    figure_width: str,
    table: Path | None,
) -> None:
    """Put result folders beside the published parameters, or beside the first of them.

    \b
    Examples:
        foamfit compare fits/foam-1/model-1/impact fits/foam-1/model-1/stress
        foamfit compare fits/TEST/bistable --published foam-1/model-1 --plot comparison.png
    """
    from foamfit.report.comparison import compare as side_by_side
    from foamfit.report.comparison import comparison_text, plot_comparison, write_csv

    read = [path / "fit.json" if path.is_dir() else path for path in results]
    options.check_files(table, plot, read)
    comparison = side_by_side(results, name)
    say(comparison_text(comparison))
    if plot is not None:
        plot_comparison(comparison, plot, width=figure_width)
        say(f"\ndrawn in {plot}")
    if table is not None:
        write_csv(comparison, table)
        say(f"\nwritten to {table}")


@main.command()
def published() -> None:
    """Print the published parameter sets and their derived points."""
    from foamfit.springs.published import table

    say(table())
