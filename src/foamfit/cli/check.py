"""`foamfit check`: what the loader understood of a test."""

from __future__ import annotations

from pathlib import Path

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.terminal import say


@main.command()
@options.TEST
@options.SPECIMEN
def check(test: Path, specimen: Path | None) -> None:
    """Say what the loader understood of TEST.csv: columns, contact, specimen, energy.

    \b
    Example:
        foamfit check TEST.csv --specimen foam.toml
    """
    from foamfit.data.csv_file import read_test
    from foamfit.data.describe import describe
    from foamfit.data.energy import audit

    measurement = read_test(test, specimen)
    say(describe(measurement, audit(measurement)))
