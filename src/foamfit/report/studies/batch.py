"""Summary of a batch, one row per test, as CSV and as an HTML page."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.codec import plain
from foamfit.errors import InputError
from foamfit.files import csv_bytes, read_whole, write_file
from foamfit.report.figures import write_both
from foamfit.report.listing import Row, index_page
from foamfit.report.render import words
from foamfit.report.studies.parameters import panels_of, plot_parameters
from foamfit.report.summary import CURVES
from foamfit.report.tables import (
    by_test_tex,
    unit_of_all,
    varied,
    wide,
    with_head,
)
from foamfit.results import Fit
from foamfit.springs.parameters import NUISANCE
from foamfit.text import counted, listed

if TYPE_CHECKING:
    import pandas as pd

# Status of a test without a result.
REFUSED, OPEN = "refused", "not fitted"
_STATUS = {
    "ok": "fitted",
    "warnings": "fitted with warnings",
    "failed": "without an acceptable fit",
    REFUSED: "refused",
    OPEN: "not fitted yet",
}
MOST_ON_PAGE = 5000
_MOST_REFUSALS = 20  # named on the terminal


def row_of(test: str, file: str, result: Fit) -> Row:
    """Return the row of a fit."""
    error = None
    if result.status == "failed":
        fatal = (check for check in result.checklist if check.fatal and check.answer is False)
        reasons = [w for check in fatal for w in (check.warnings or (check.sentence,))]
        error = " ".join(["no acceptable fit was found:", *(reasons or result.warnings)[:1]])
    misfit, runtime = plain(result.misfit), plain(result.runtime_s)
    return Row(test, file, result.status, error, misfit, runtime, result.parameters)


# ------------------------------------------------------------------------------- the table


def table_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows of summary.csv in SI, one per test; None for missing values."""
    return [
        {name: getattr(row, name) for name in ("test", "file", "status", "error")}
        | {f"misfit_{name}": row.misfit.get(name) for name in CURVES}
        | {"runtime_s": row.runtime_s, **parameters}
        for row, parameters in zip(rows, wide([row.parameters for row in rows]), strict=True)
    ]


def table(rows: Sequence[Row]) -> pd.DataFrame:
    """Return the rows of summary.csv as a data frame."""
    return _frame(table_rows(rows))


def read_table(path: Path) -> pd.DataFrame:
    """Read a summary.csv; raise InputError if the file is not one."""
    try:
        cells = csv.reader(read_whole(path).decode().splitlines(True))
        head, *rows = ([re.sub("^'(?=[=+@-])", "", one) or None for one in row] for row in cells)
        return _frame([dict(zip(head, row, strict=True)) for row in rows])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is not the summary of a batch: {error}") from None


def _frame(rows: list[dict[Any, Any]]) -> pd.DataFrame:
    import pandas as pd

    words = ("test", "file", "status", "error")
    numbers = (name for name in rows[0] if name not in words and not name.endswith("_state"))
    return pd.DataFrame(rows).astype(dict.fromkeys(numbers, float))


def write_summary(rows: Sequence[Row], folder: Path) -> None:
    """Write summary.csv."""
    write_file(folder / "summary.csv", csv_bytes(with_head(table_rows(rows))))


def counts_in_words(rows: Sequence[Row]) -> str:
    """Return the numbers of tests, of cycles and of each status in words."""
    number = Counter(row.status for row in rows)
    parts = [f"{number[status]} {label}" for status, label in _STATUS.items() if number[status]]
    total = counted(len({row.test.partition("/")[0] for row in rows}), "test")
    if cycles := sum("/" in row.test for row in rows):
        total += f", {counted(cycles, 'cycle')}"
    return f"{total}: {listed(parts)}" if parts else "no test"


def summary_words(rows: Sequence[Row]) -> str:
    """Return the text that the command prints for a batch.

    Its table contains median and quartiles over the tests for each varied parameter.
    """
    wrong, parameters = [row for row in rows if not row.has_fit], list[Any]()
    for name, each in varied([row.parameters for row in rows if row.has_fit]).items():
        present = [p for p in each if p is not None]
        factor, unit = unit_of_all(present)
        quartiles = np.quantile([p.value / factor for p in present], [0.5, 0.25, 0.75])
        parameters.append((name, quartiles, unit, [p.state for p in present]))
    return words(
        "batch",
        counts=counts_in_words(rows),
        wrong=wrong[:_MOST_REFUSALS],
        more=max(len(wrong) - _MOST_REFUSALS, 0),
        parameters=parameters,
    )


# ------------------------------------------------------------------------------- the page


def write_comparison(
    rows: Sequence[Row], folder: Path, title: str, *, width: str, pictures: bool
) -> bytes | None:
    """Write the parameters of all tests as summary.tex and, with `pictures`, as figures.

    Return the figure as SVG, if there is one.
    """
    fitted = [row for row in rows if row.has_fit]
    tests = [row.test for row in fitted]
    every = varied([row.parameters for row in fitted])
    found = {name: each for name, each in every.items() if name not in NUISANCE}
    write_file(folder / "summary.tex", by_test_tex("Test", tests, found).encode("utf-8", "replace"))
    if not (pictures and found):
        return None
    figure = plot_parameters(
        f"{title} · {counts_in_words(rows)}", tests, panels_of(tests, found), width=width
    )
    return write_both(figure, folder / "summary")


def write_page(rows: Sequence[Row], folder: Path, title: str, picture: bytes | None = None) -> None:
    """Write summary.html, a self-contained page, with a figure (SVG)."""
    shown = rows
    if len(rows) > MOST_ON_PAGE:  # tests without a fit are always shown
        first = {id(row) for row in rows[:MOST_ON_PAGE]}
        shown = [row for row in rows if id(row) in first or not row.has_fit][: 2 * MOST_ON_PAGE]
    more: Any = {"picture": picture, "csv": "summary.csv", "left_out": len(shown) < len(rows)}
    text = index_page(shown, folder, title, counts_in_words(rows), **more)
    write_file(folder / "summary.html", text)
