"""The results in a folder: a line each in the terminal, and a page with links to their reports."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.errors import InputError
from foamfit.files import write_file
from foamfit.report.figures import tail
from foamfit.report.folder import load_result
from foamfit.report.render import page
from foamfit.report.tables import MISFITS
from foamfit.results import law_in_words
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.text import percent

PAGE, MARK = "index.html", b'<meta name="generator" content="foamfit list">'
LONGEST = 36  # characters of the name of a test in the terminal
POINTS = 60  # of each curve of a small loop
WIDE, TALL = 88, 56  # of a small loop, pixels
AXES = (
    "measured displacement (m)",
    "measured stress (Pa)",
    "stress along measured displacement (Pa)",
)


@dataclass(frozen=True)
class Listed:
    """One result: its place within the folder, and what the table shows of it."""

    place: Path
    test: str
    model: str
    options: str
    status: str
    misfits: dict[str, float]  #: by the names in `tables.MISFITS`
    determined: int
    varied: int
    when: float  #: s since the epoch
    damaged: str = ""  #: why the file cannot be read
    curves: tuple[str, ...] = ()  #: points of the measured and the fitted loop, of an SVG polyline

    @property
    def report(self) -> Path | None:
        """The report of the result, if it was written."""
        names = ("report.html", "joint.html")
        return next((self.place / name for name in names if (self.place / name).is_file()), None)

    @property
    def date(self) -> str:
        """The local time at which it was written."""
        return time.strftime("%Y-%m-%d %H:%M", time.localtime(self.when))

    @property
    def row(self) -> list[str]:
        """The cells of the line in the terminal; of the misfits the largest."""
        shown = percent(max(self.misfits.values())) if self.misfits else "–"
        number = f"{self.determined} of {self.varied}"
        known = [self.damaged, "", ""] if self.damaged else [self.options, shown, number]
        return [tail(self.test, LONGEST), self.model, self.status, *known, self.date]


HEAD = ["test", "model", "status", "options", "misfit", "determined", "when"]


def lines(results: Sequence[Listed]) -> str:
    """Return a line for each result, below a head."""
    rows = [HEAD, *(one.row for one in results)]
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, wide, strict=True)).rstrip()
        for row in rows
    )


def results_in(folder: str | Path) -> list[Listed]:
    """Return the results of fits and joint fits in a folder and below, by place.

    Raises InputError if the folder contains no result.
    """
    top = Path(folder)
    if not top.is_dir():
        raise InputError(f"{folder} is not a folder; foamfit fit TEST.csv writes results to fits/")
    found = sorted({path for name in ("fit.json", "joint.json") for path in top.rglob(name)})
    of_joint = {path.parent for path in found if path.name == "joint.json"}
    kept = [
        path for path in found if path.name == "joint.json" or path.parent.parent not in of_joint
    ]
    if not kept:
        raise InputError(f"there is no result in {folder}; foamfit fit TEST.csv writes one")
    return [_listed(path) for path in kept]


def _listed(path: Path) -> Listed:
    """Return one result; a damaged one says why."""
    when, place = path.stat().st_mtime, path.parent
    try:
        content = load_result(path)
        model = Model.of_result(content)
        law = law_in_words(model.name, content.get("relaxation", 0))
        given = content.get("options") or {"drive": content.get("drive")}
        rest = {
            k: v for k, v in given.items() if k not in ("model", "relaxation") and v is not None
        }
        words = ", ".join(k if v is True else f"{k} {v}" for k, v in rest.items())
        known = [one for name, one in content["parameters"].items() if _varies(name, one)]
        misfit = content.get("misfit") or _largest(content.get("tests", {}))
        misfits = {MISFITS[k]: v for k, v in misfit.items() if k in MISFITS and v is not None}
        number = sum(one.get("state") == "determined" for one in known)
        test = str(content.get("test") or content.get("name"))
        about = (test, law, words, content["status"], misfits, number, len(known), when)
        return Listed(place, *about, curves=tuple(_loop(place / "curves.csv")))
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = str(error) if isinstance(error, InputError) else f"{path.name} is damaged"
        return Listed(place, place.name, "", "", "failed", {}, 0, 0, when, why)


def _varies(name: str, one: dict[str, Any]) -> bool:
    """Return whether a parameter belongs to a spring and was identified."""
    return name not in NUISANCE and bool(one.get("vary", one.get("kind") != "fixed"))


def _largest(tests: dict[str, Any]) -> dict[str, float]:
    """Return the largest misfit of each curve over the tests of a joint fit."""
    out = dict[str, float]()
    for one in tests.values():
        for name, value in one["misfit"].items():
            out[name] = max(out.get(name, 0.0), value or 0.0)
    return {name: value for name, value in out.items() if value}


def _loop(path: Path) -> Iterator[str]:
    """Yield measured and fitted loop of a result as points of SVG polylines, if it has them."""
    if not path.is_file():
        return
    with path.open(encoding="utf-8") as file:
        head = file.readline().strip().split(",")
    if not set(AXES[:2]) <= set(head):
        return
    columns = [head.index(name) for name in AXES if name in head]
    values = np.loadtxt(path, delimiter=",", skiprows=1, usecols=columns, ndmin=2)
    values = values[np.unique(np.linspace(0, len(values) - 1, POINTS).astype(int))]
    low, high = values[:, :2].min(axis=0), values[:, :2].max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    x = 2.0 + (WIDE - 4.0) * (values[:, 0] - low[0]) / span[0]
    for curve in values[:, 1:].T:
        y = TALL - 2.0 - (TALL - 4.0) * (curve - low[1]) / span[1]
        yield " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def write_index(folder: str | Path, results: Sequence[Listed]) -> Path | None:
    """Write FOLDER/index.html, with links to the reports, and return its path.

    None if the folder is a result itself. Raises InputError rather than replace another page.
    """
    top = Path(folder)
    if any(one.place == top for one in results):
        return None
    path = top / PAGE
    if path.exists() and MARK not in path.read_bytes():
        raise InputError(f"{path} was not written by foamfit and is not replaced; move it")
    misfits = [name for name in MISFITS.values() if any(name in one.misfits for one in results)]
    relative = {one.place: one.place.relative_to(top).as_posix() for one in results}
    text = page("index", folder=str(folder), results=results, misfits=misfits, place=relative,
                size=(WIDE, TALL), mark=MARK.decode())  # fmt: skip
    write_file(path, text.encode("utf-8", errors="replace"))
    return path
