"""`foamfit page`: the same in a browser, on this machine."""

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.errors import InputError


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
