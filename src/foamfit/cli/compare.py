"""`foamfit compare` and `foamfit published`: fitted beside published parameters."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli.group import main
from foamfit.cli.options import FILE, PLOT, WIDTH, check_files
from foamfit.terminal import say


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True, type=FILE)
@click.option(
    "--published", "name", metavar="NAME",
    help="The published set to compare with. Default: the one that the name of the test contains.",
)  # fmt: skip
@PLOT
@WIDTH
@click.option("--csv", "table", type=FILE, help="Also write a table.")
def compare(
    results: tuple[Path, ...], name: str | None, plot: Path | None, figure_width: str,
    table: Path | None,
) -> None:  # fmt: skip
    """Put result folders beside the published parameters, or beside the first of them.

    \b
    Examples:
        foamfit compare fits/foam-1/model-1/impact fits/foam-1/model-1/stress
        foamfit compare fits/TEST/bistable --published foam-1/model-1 --plot comparison.png
    """
    from foamfit.report.comparison import compare as side_by_side
    from foamfit.report.comparison import comparison_text, plot_comparison, write_csv

    own = check_files(table, plot, [p / "fit.json" if p.is_dir() else p for p in results])
    comparison = side_by_side(results, name)
    say(comparison_text(comparison))
    if plot is not None:
        plot_comparison(comparison, plot, width=figure_width, table=own)
        say(f"\ndrawn in {plot}, its data in {plot.with_suffix('.csv')}")
    if table is not None:
        write_csv(comparison, table)
        say(f"\nwritten to {table}")


@main.command()
def published() -> None:
    """Print the published parameter sets and their derived points."""
    from foamfit.springs.published import table

    say(table())
