"""What the studies share: their command line, their tables and pages, their figures, their files.

A study is one command. Its docstring says question, method and answer; `arguments` reads its
options, `markdown`, `write_csv` and `write_page` write its tables and its page, `sheet` draws its
figures, and `run` keeps the files in which remaking has changed no figure (see `unchanged`). Seeds
are the study's own: each case draws from `numpy.random.default_rng([seed, ..., case])`.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import binomtest

import foamfit as ff
from foamfit.report.figures import drawing
from unchanged import keep_unchanged

# What the columns of measurements of others are: a machine's gap, and the printed lattices'.
GAP = 'displacement = { column = "Gap (um)", counts_down = true }'
LATTICE = """\
time = { column = "Total Time (s)" }
displacement = { column = "Position(Linear:Position) (mm)", counts_down = true }
force = { column = "Force(Linear:Load) (kN)", scale = -1 }
cycle = { column = "Total Cycles" }"""
# Okabe and Ito's colours, which all can tell apart.
BLACK, GREY, BLUE, SKY = "#000000", "#8c8c8c", "#0072B2", "#56B4E9"
VERMILION, ORANGE, GREEN, PURPLE = "#D55E00", "#E69F00", "#009E73", "#CC79A7"


def run(main: Callable[[], Any], place: Path) -> None:
    """Run a study; its files stay as they were where remaking them changed no figure."""
    with keep_unchanged(place):
        main()


# ------------------------------------------------------------------------------- arguments


def arguments(doc: str | None, out: Path | None = None, **numbers: Any) -> argparse.ArgumentParser:
    """Make a parser of a study: its docstring, the folder of what it writes, and its numbers.

    A number is a default, or a default and what it means.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, given in numbers.items():
        default, what = given if isinstance(given, tuple) else (given, None)
        parser.add_argument(f"--{name}", type=type(default), default=default, help=what)
    if out is not None:
        parser.add_argument("--out", type=Path, default=out, help="folder of what is written")
    return parser


def measurements(*folders: str) -> Path:
    """Return the folder of the measurements of others, FOAMFIT_DATA, which holds these folders."""
    data = Path(os.environ.get("FOAMFIT_DATA", ""))
    for folder in folders:
        if not (data / folder).is_dir():
            sys.exit(f"there is no {data / folder}; set FOAMFIT_DATA to the folder with {folder}/")
    return data


# ------------------------------------------------------------------------------- tables and pages


def markdown(head: str | Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """Write a table of Markdown; its head is a list, or the names between "|"."""
    names = [name.strip() for name in head.split("|")] if isinstance(head, str) else list(head)
    return "\n".join(line_of(cells) for cells in (names, ["---"] * len(names), *rows))


def lines(rows: Iterable[Iterable[Any]]) -> str:
    """Write the rows of a table whose head is in the template of its page."""
    return "\n".join(map(line_of, rows))


def line_of(cells: Iterable[Any]) -> str:
    """Write one row of a table of Markdown."""
    return f"| {' | '.join(map(str, cells))} |"


def shown(frame: pd.DataFrame, digits: int = 3) -> str:
    """Write a DataFrame as Markdown: numbers to so many digits, a dash for NaN."""

    def cell(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return "–" if np.isnan(value) else f"{value:.{digits}g}"

    return markdown(frame.columns, (map(cell, row) for row in frame.astype(object).to_numpy()))


def write_csv(
    rows: Iterable[Mapping[str, Any]] | pd.DataFrame, path: Path, digits: int = 4
) -> None:
    """Write rows, or a DataFrame, with so many significant digits."""
    frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
    frame.to_csv(path, index=False, float_format=f"%.{digits}g", lineterminator="\n")


def write_page(
    folder: Path, name: str = "README.md", out: Path | None = None, **values: Any
) -> str:
    """Fill page.template.md of a folder; writes it there, or to another folder, as its page."""
    text = (folder / "page.template.md").read_text(encoding="utf-8").format(**values)
    ((out or folder) / name).write_text(text, encoding="utf-8")
    return text


def circumstances() -> str:
    """Versions and the machine in words, for the foot of a page."""
    return f"foamfit {ff.__version__}, Python {platform.python_version()}, {platform.machine()}"


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    told = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in told if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions(*names: str) -> dict[str, str]:
    """Versions of packages, and of Python."""
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def share(hits: Sequence[bool]) -> dict[str, float]:
    """Share of hits, with its 95 % interval (Wilson)."""
    ends = binomtest(int(sum(hits)), len(hits)).proportion_ci(0.95, "wilson")
    return {"share": float(np.mean(hits)), "low": float(ends.low), "high": float(ends.high)}


# ------------------------------------------------------------------------------- figures


@contextmanager
def sheet(path: Path, width: float, height: float, dpi: int = 200) -> Iterator[Figure]:
    """Give an empty figure (inches) in the style of all figures, which is saved in the end."""
    with drawing(width, height) as figure:
        yield figure
        figure.savefig(path, dpi=dpi)


def gridlines(ax: Any) -> None:
    """Lay faint lines below what is drawn."""
    ax.grid(color="0.93", linewidth=0.5)
    ax.set_axisbelow(True)


# ------------------------------------------------------------------------------- files of tests


def write_specimen(path: Path, height: str, diameter: str, columns: str = GAP) -> Path:
    """Write the TOML of a cylinder, with what its columns are; returns its path.

    The machines of most measurements of others record the gap between their plates.
    """
    text = f'[specimen]\nheight = "{height}"\ndiameter = "{diameter}"\n'
    path.write_text(text + (f"[columns]\n{columns}\n" if columns else ""), encoding="utf-8")
    return path


def write_test(path: Path, toml: str | None = None, **columns: Iterable[float]) -> Path:
    """Write a synthetic test: columns `time`, `stress` and `displacement` in SI, and its TOML."""
    units = {"time": "s", "stress": "Pa", "displacement": "m"}
    table = {f"{name} ({units[name]})": values for name, values in columns.items()}
    pd.DataFrame(table).to_csv(path, index=False)
    if toml is not None:
        path.with_suffix(".toml").write_text(toml)
    return path


def write_study(
    path: Path, tests: Iterable[str | Path], model: str, kinds: Mapping[str, Any], **settings: Any
) -> Path:
    """Write a STUDY.toml: tests, model, kinds of the parameters of the first spring, settings.

    A mapping among the settings becomes a table of its own.
    """

    def told(value: Any) -> str:
        return str(value) if isinstance(value, int | float) else f'"{value}"'

    tables = {name: one for name, one in settings.items() if isinstance(one, Mapping)}
    plain = {"model": model} | {k: v for k, v in settings.items() if k not in tables}
    text = [f"tests = [{', '.join(told(test) for test in tests)}]"]
    text += [f"{name} = {told(value)}" for name, value in plain.items()]
    tables["parameters"] = {f"s1_{name.removeprefix('s1_')}": kind for name, kind in kinds.items()}
    for name, table in tables.items():
        text += ["", f"[{name}]", *(f"{key} = {told(value)}" for key, value in table.items())]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def twins(data: Path) -> Iterator[tuple[str, str, str]]:
    """Name, height and diameter of each specimen of shoe-foam-twins/."""
    for row in pd.read_csv(data / "specimens.csv", dtype=str).itertuples():
        yield row.test, f"{row.height_mm} mm", f"{row.diameter_mm} mm"


def place_twins(data: Path, folder: Path) -> None:
    """Link the tests of shoe-foam-twins/ into a folder, with the TOML of each beside it."""
    for test, height, diameter in twins(data):
        (folder / f"{test}_raw.txt").symlink_to((data / f"{test}_raw.txt").resolve())
        write_specimen(folder / f"{test}_raw.toml", height, diameter)
