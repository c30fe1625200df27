"""Tables of fits of `list`, `batch` and `joint`: a page, a CSV, and lines in the terminal."""

from __future__ import annotations

import csv
import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.codec import build, plain
from foamfit.errors import InputError
from foamfit.files import csv_bytes, read_whole, write_file
from foamfit.parts import ParameterEstimate
from foamfit.report import figures, render
from foamfit.report.folder import load_result
from foamfit.report.plots import plot_parameters, values_of
from foamfit.report.summary import CURVES
from foamfit.results import Fit
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.text import counted, listed, option_value

if TYPE_CHECKING:
    import pandas as pd

PAGE, MARK = "index.html", b'<meta name="generator" content="foamfit list">'
POINTS = 60  # of each curve of a small loop
WIDE, TALL = 88, 56  # of a small loop, pixels
STRAIN, STRESS = "measured displacement (m)", "measured stress (Pa)"
FITTED = "stress along measured displacement (Pa)"
REFUSED, OPEN = "refused", "not fitted"  # status of a test without a result
_STATUS = {
    "ok": "fitted",
    "warnings": "fitted with warnings",
    "failed": "without an acceptable fit",
    REFUSED: "refused",
    OPEN: "not fitted yet",
}
_MOST_REFUSALS = 20  # named on the terminal


@dataclass(frozen=True)
class Row:
    """A line of a table of fits: a result, or a test of a batch or a joint fit."""

    test: str
    file: str = ""
    status: str = ""
    error: str | None = None  #: why there is no result
    misfit: Mapping[str, float | None] = field(default_factory=dict)  #: by the names of fit.json
    runtime_s: float | None = None
    parameters: Mapping[str, ParameterEstimate] = field(default_factory=dict)
    model: str = ""
    options: str = ""
    more: Mapping[str, tuple[str, str]] = field(default_factory=dict)  #: other cells, with notes
    place: Path = Path()  #: its folder
    when: float | None = field(default=None, metadata={"omitted": True})  #: s since the epoch

    @property
    def has_fit(self) -> bool:
        """Whether there is an acceptable fit."""
        return self.status in ("ok", "warnings")

    @property
    def report(self) -> str:
        """The name of its report; "" if none was written."""
        names = ("report.html", "joint.html")
        return next((name for name in names if (self.place / name).is_file()), "")

    @property
    def comparable(self) -> bool:
        """Whether `foamfit compare` takes it: a fit, and not a joint fit."""
        return not self.error and (self.place / "fit.json").is_file()

    @property
    def counts(self) -> tuple[int, int]:
        """How many parameters of the springs are determined, and how many have a state."""
        return render.count_determined(self.parameters)

    @property
    def date(self) -> str:
        """The local time at which it was written."""
        return time.strftime("%Y-%m-%d %H:%M", time.localtime(self.when))


def lines(results: Sequence[Row], top: Path) -> str:
    """Return a line for each result in the folder `top`, below a head."""
    return render.words("list", results=results, top=top)


def results_in(folder: str | Path) -> list[Row]:
    """Return the fits and joint fits in a folder and below, by place; InputError without any."""
    if not (top := Path(folder)).is_dir():
        raise InputError(f"{folder} is not a folder; foamfit fit TEST.csv writes results to fits/")
    joints = {*top.rglob("joint.json")}
    fits = {one for one in top.rglob("fit.json") if one.parent.parent / "joint.json" not in joints}
    if not joints | fits:
        raise InputError(f"there is no result in {folder}; foamfit fit TEST.csv writes one")
    return [_listed(path) for path in sorted(joints | fits)]


def _listed(path: Path) -> Row:
    """Return one result; a damaged one says why."""
    when, place = path.stat().st_mtime, path.parent
    try:
        content = load_result(path)
        model = Model.of_result(content)
        given = content.get("options") or {"drive": content.get("drive")}
        given = {"relaxation": content.get("relaxation"), **model.options, **given, "model": None}
        rest = (k if v is True else f"{k} {option_value(v)}" for k, v in given.items() if v)
        every = content["parameters"].items()
        made = {n: {"vary": p.get("kind") != "fixed", **p} for n, p in every if n not in NUISANCE}
        about: dict[str, Any] = {"test": content.get("test") or content["name"]}
        about |= {"status": content["status"], "runtime_s": content.get("runtime_s")}
        about["misfit"] = content.get("misfit") or _largest(content.get("tests", {}))
        about |= {"parameters": made, "model": model.words, "options": ", ".join(rest)}
        row: Row = build(Row, about, {})
        return replace(row, place=place, when=when)
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = str(error) if isinstance(error, InputError) else f"{path.name} is damaged"
        return Row(place.name, status="failed", error=why, place=place, when=when)


def _largest(tests: dict[str, Any]) -> dict[str, float]:
    """Return the largest misfit of each curve over the tests of a joint fit."""
    found = [one["misfit"] for one in tests.values()]
    names = dict.fromkeys(name for one in found for name, value in one.items() if value)
    return {name: max(one.get(name) or 0.0 for one in found) for name in names}


def small_loop(path: Path) -> tuple[str, ...]:
    """Return the measured and the fitted loop of a curves.csv as points of SVG polylines."""
    try:
        with path.open(encoding="utf-8") as file:
            head = file.readline().strip().split(",")
            columns = [head.index(STRAIN), head.index(STRESS)]
            columns += [head.index(FITTED)] if FITTED in head else []
            values = np.loadtxt(file, delimiter=",", usecols=columns, ndmin=2)
    except (OSError, ValueError):  # missing or damaged, or there is no loop
        return ()
    if not len(values):
        return ()
    values = values[np.unique(np.linspace(0, len(values) - 1, POINTS).astype(int))]
    low, high = values[:, :2].min(axis=0), values[:, :2].max(axis=0)
    span = np.where(high > low, high - low, 1.0)

    def points(stress: Array) -> str:
        x = 2.0 + (WIDE - 4.0) * (values[:, 0] - low[0]) / span[0]
        y = TALL - 2.0 - (TALL - 4.0) * (stress - low[1]) / span[1]
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))

    return tuple(map(points, values[:, 1:].T))


def table_of(results: Sequence[Row], top: Path) -> dict[str, Any]:
    """Return the values of table.html for results in `top`, with parameters if models are alike."""
    results = [one if one.place.name else replace(one, place=top / one.test) for one in results]
    alike = len({one.model for one in results if not one.error}) <= 1
    parameters = render.varied([one.parameters for one in results if alike])
    found = render.by_test([one.place.relative_to(top).as_posix() for one in results], parameters)
    loops = [small_loop(one.place / "curves.csv") for one in results]
    misfits = {name for one in results for name, x in one.misfit.items() if x is not None}
    return {
        "rows": list(zip(results, loops, ((at, p) for at, *p in found["rows"]), strict=True)),
        "heads": found["heads"],
        "misfits": {curve: name for curve, name in render.MISFITS.items() if curve in misfits},
        "more": list(dict.fromkeys(name for one in results for name in one.more)),
        "models": not alike,
        "size": (WIDE, TALL),
    }


def index_page(results: Sequence[Row], top: Path, title: str, counts: str, **more: Any) -> bytes:
    """Return the page of a table of fits; `more` may have a picture and a CSV."""
    given = {"picture": None, "csv": "", "mark": MARK.decode()} | more
    text = render.page("index", title=title, counts=counts, table=table_of(results, top), **given)
    return text.encode("utf-8", errors="replace")


def write_index(folder: str | Path, results: Sequence[Row]) -> Path | None:
    """Write FOLDER/index.html, with links to the reports, and return its path.

    None if the folder is a result itself. Raises InputError rather than replace another page.
    """
    top = Path(folder)
    if any(one.place == top for one in results):
        return None
    path = top / PAGE
    if path.exists() and MARK not in path.read_bytes():
        raise InputError(f"{path} was not written by foamfit and is not replaced; move it")
    laws = {one.model for one in results}
    law = f" · {laws.pop()}" if len(laws) == 1 else ""
    write_file(path, index_page(results, top, str(folder), counted(len(results), "result") + law))
    return path


def row_of(test: str, file: str, result: Fit) -> Row:
    """Return the row of a fit."""
    error = None
    if result.status == "failed":
        fatal = (check for check in result.checklist if check.fatal and check.answer is False)
        reasons = [w for check in fatal for w in (check.warnings or (check.sentence,))]
        error = " ".join(["no acceptable fit was found:", *(reasons or result.warnings)[:1]])
    misfit, runtime = plain(result.misfit), plain(result.runtime_s)
    return Row(test, file, result.status, error, misfit, runtime, result.parameters)


def table_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows of summary.csv in SI, one per test; None for missing values."""
    return [
        {name: getattr(row, name) for name in ("test", "file", "status", "error")}
        | {f"misfit_{name}": row.misfit.get(name) for name in CURVES}
        | {"runtime_s": row.runtime_s, **parameters}
        for row, parameters in zip(rows, render.wide([row.parameters for row in rows]), strict=True)
    ]


def read_table(path: Path) -> pd.DataFrame:
    """Read a summary.csv; raise InputError if the file is not one."""
    import pandas as pd

    words = ("test", "file", "status", "error")
    try:
        cells = csv.reader(read_whole(path).decode().splitlines(True))
        head, *rows = ([re.sub("^'(?=[=+@-])", "", one) or None for one in row] for row in cells)
        numbers = [name for name in head if name not in words and not str(name).endswith("_state")]
        table = pd.DataFrame([dict(zip(head, row, strict=True)) for row in rows])
        return table.astype(dict.fromkeys(numbers, float))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is not the summary of a batch: {error}") from None


def write_summary(rows: Sequence[Row], folder: Path) -> None:
    """Write summary.csv."""
    write_file(folder / "summary.csv", csv_bytes(render.with_head(table_rows(rows))))


def counts_in_words(rows: Sequence[Row]) -> str:
    """Return the numbers of tests, of cycles and of each status in words."""
    number = Counter(row.status for row in rows)
    parts = [f"{number[status]} {label}" for status, label in _STATUS.items() if number[status]]
    total = counted(len({row.test.partition("/")[0] for row in rows}), "test")
    if cycles := sum("/" in row.test for row in rows):
        total += f", {counted(cycles, 'cycle')}"
    return f"{total}: {listed(parts)}" if parts else "no test"


def _of_springs(rows: Sequence[Row]) -> render.ByTest:
    """Return the varied parameters of the springs; a median of contact times has no meaning."""
    every = render.varied([row.parameters for row in rows])
    return {name: each for name, each in every.items() if name not in NUISANCE}


def summary_words(rows: Sequence[Row]) -> str:
    """Return the text that the command prints for a batch, with quartiles of the parameters."""
    wrong, parameters = [row for row in rows if not row.has_fit], list[Any]()
    for name, each in _of_springs([row for row in rows if row.has_fit]).items():
        present = [p for p in each if p is not None]
        factor, unit = render.unit_of_all(present)
        quartiles = np.quantile([p.value / factor for p in present], [0.5, 0.25, 0.75]).tolist()
        parameters.append((name, quartiles, unit, [p.state for p in present]))
    return render.words(
        "batch",
        counts=counts_in_words(rows),
        wrong=wrong[:_MOST_REFUSALS],
        more=max(len(wrong) - _MOST_REFUSALS, 0),
        parameters=parameters,
    )


def write_comparison(
    rows: Sequence[Row], folder: Path, title: str, *, width: str, pictures: bool
) -> bytes | None:
    """Write the parameters as summary.tex and, with `pictures`, as figures; return that as SVG."""
    fitted = [row for row in rows if row.has_fit]
    tests = [row.test for row in fitted]
    found = _of_springs(fitted)
    tex = render.by_test_tex("Test", tests, found)
    write_file(folder / "summary.tex", tex.encode("utf-8", "replace"))
    if not (pictures and found):
        return None
    title += f" · {counts_in_words(rows)}"
    figure = plot_parameters(title, tests, values_of(tests, found), width=width)
    png, pdf, svg = figures.images(figure, "png", "pdf", "svg")
    write_file(folder / "summary.png", png)
    write_file(folder / "summary.pdf", pdf)
    return svg


def write_page(rows: Sequence[Row], folder: Path, title: str, picture: bytes | None = None) -> None:
    """Write summary.html, a self-contained page, with a figure (SVG)."""
    more: Any = {"picture": picture, "csv": "summary.csv"}
    text = index_page(rows, folder, title, counts_in_words(rows), **more)
    write_file(folder / "summary.html", text)
