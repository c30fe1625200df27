"""`foamfit check`, `init` and `page`: a test before it is fitted, and in a browser."""

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


@main.command()
@options.TEST
def init(test: Path) -> None:
    """Write TEST.toml beside TEST.csv: what was understood, and questions for the rest.

    A question is a line behind "# " with its unit and an example: give your value and take the "# "
    away. A TOML that is there is left as it is.

    Example: foamfit init TEST.csv
    """
    from foamfit.data.tables.csv_table import read_text
    from foamfit.data.tables.draft import draft
    from foamfit.data.toml_file import toml_beside
    from foamfit.files import reason

    text, asked = draft(read_text(test, "the CSV file of a test"))
    target = toml_beside(test)
    try:
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(
            f"{target} is there and is left as it is; foamfit check {test} says what it lacks"
        ) from None
    except OSError as error:
        raise InputError(f"{target} cannot be written: {reason(error)}") from None
    say("\n    ".join([f"written to {target}; it asks for", *asked]))
    say(f"then: foamfit check {test}")


@main.command()
@click.argument("test", metavar="[TEST.csv]", type=options.FILE, required=False)
@options.option("--port", "Port of 127.0.0.1. Default: a free one.", click.IntRange(1, 65535))
@options.option("--no-browser", "Print the address only; open no browser.")
def page(test: Path | None, port: int | None, no_browser: bool) -> None:
    """Check, fit and turn the parameters of TEST.csv in a browser.

    The page is served to this machine alone (127.0.0.1). Its address, with a random token without
    which nothing is answered, is the first line of stdout; Ctrl-C ends it.

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
