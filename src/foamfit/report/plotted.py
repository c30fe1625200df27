"""What is plotted in a figure, as a table from which any other program can draw it again.

It is read off the figure itself, so it is what is drawn. A line, band or mark is a series by its
label (one that begins with "_" is left out of legends, and is a series all the same); what has no
label is decoration. A panel has the name of its label, if it has one, or of its title.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from foamfit.errors import InputError
from foamfit.files import csv_bytes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.arrays import Array

HEAD = ("panel", "series", "x axis", "y axis", "x", "y")
# Names of the rows and columns of a matrix that is drawn as shaded cells.
_CELLS = WeakKeyDictionary["Artist", tuple[Sequence[str], Sequence[str]]]()


def name_cells(picture: Artist, rows: Sequence[str], columns: Sequence[str]) -> None:
    """Say what the rows and columns of a matrix are: they need not stand at its axes."""
    _CELLS[picture] = tuple(rows), tuple(columns)


def plotted(figure: Figure) -> Iterator[tuple[object, ...]]:
    """Give the rows of the table, the header first, in the units of the axes.

    x is empty for what lies across a panel, y for what stands upright in it. A band is its outline,
    an interval its two ends, a cell of a matrix has the names of its row (the series) and column.
    """
    yield HEAD
    for ax in figure.axes:
        axes = _sides(ax)
        titles = str(ax.get_label()), ax.get_title(loc="left"), ax.get_title()
        panel = next(filter(None, titles), f"{axes[1]} over {axes[0]}")
        for series, x, y in _series(ax):
            yield from ((panel, series, *axes, *place) for place in zip(x, y, strict=True))


def table(figure: Figure) -> bytes:
    """Return the table as the bytes of a CSV file."""
    return csv_bytes(plotted(figure))


def check_table(
    path: Path, head: str = ",".join(HEAD),
    words: str = "the plotted data of the figure are to be written, and is no such table; name the "
    "figure otherwise",
) -> None:  # fmt: skip
    """Raise InputError if something else stands where a table that begins so is to be written."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            known = file.readline().startswith(head)
    except FileNotFoundError:
        return
    except OSError:
        known = False
    if not known:
        raise InputError(f"{path} stands where {words}")


def _sides(ax: Axes) -> tuple[str, str]:
    """What the axes of a panel are, from the panel beside it where that is written only there."""
    found = []
    for side, shared in (("x", ax.get_shared_x_axes()), ("y", ax.get_shared_y_axes())):
        labels = [getattr(one, f"get_{side}label")() for one in (ax, *shared.get_siblings(ax))]
        found.append(next(filter(None, labels), ""))
    return found[0], found[1] or " ".join(ax.get_title().split())


def _series(ax: Axes) -> Iterator[tuple[str, list[str], list[str]]]:
    """Give the series of a panel, each with its places."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.text import Annotation

    for line in ax.lines:
        if name := _name(line):
            yield name, *_columns(ax, line, np.asarray(line.get_xydata(), dtype=float))
    for patch in ax.patches:
        if name := _name(patch):
            corners = patch.get_patch_transform().transform(patch.get_path().vertices)
            yield name, *_columns(ax, patch, corners[:-1])
    for drawn in ax.collections:
        if (name := _name(drawn)) and isinstance(drawn, LineCollection | PolyCollection):
            for path in drawn.get_paths():
                yield name, *_columns(ax, drawn, np.asarray(path.vertices, dtype=float))
    for text in ax.texts:
        if isinstance(text, Annotation) and (name := _name(text)):
            x, y = text.xy
            yield f"{name} {text.get_text()}", [_cell(x)], [_cell(y)]
    for picture in ax.images:
        rows, columns = _CELLS[picture]
        for row, values in zip(rows, np.asarray(picture.get_array()).tolist(), strict=True):
            there = [(x, v) for x, v in zip(columns, values, strict=True) if np.isfinite(v)]
            yield row, [x for x, _ in there], [_cell(v) for _, v in there]


def _name(artist: Artist) -> str:
    """Name of a series; "" of decoration, to which matplotlib gives names like "_child3"."""
    label = str(artist.get_label() or "")
    return "" if label.startswith("_child") else label.removeprefix("_")


def _columns(ax: Axes, artist: Artist, places: Array) -> tuple[list[str], list[str]]:
    """The coordinates as text; empty along an axis to which the series runs across."""
    here = artist.get_transform().contains_branch_seperately(ax.transData)
    if not all(here):  # a line across has two equal places
        places = np.unique(places[:, [int(here[1])]], axis=0)[:, [0, 0]]
    columns = [
        [_cell(value) for value in column] if own else [""] * len(places)
        for own, column in zip(here, places.T.tolist(), strict=True)
    ]
    return columns[0], columns[1]


def _cell(value: float) -> str:
    """A number as finely as a figure could ever show it; empty where there is none."""
    return f"{value:.6g}" if np.isfinite(value) else ""
