"""`foamfit init`: the TOML of a test, with questions for what its file does not say."""

from __future__ import annotations

from pathlib import Path

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.errors import InputError
from foamfit.terminal import say


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
