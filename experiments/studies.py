"""Common code of the studies: command line, tables, pages, figures and files.

A study is one command. Its docstring states question, method and answer. `arguments` reads the
options, `in_order` runs the cases, `markdown`, `write_csv` and `write_page` write tables and page,
and `sheet` draws figures. Each study has its own seeds: each case draws from
`numpy.random.default_rng([seed, ..., case])`. Once this module is imported, the modules of all
studies can be.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import binomtest

import foamfit as ff
from foamfit.report.figures import drawing

Array = NDArray[np.float64]
HERE = Path(__file__).parent
sys.path += sorted(str(place) for place in HERE.iterdir() if place.is_dir())

# Parameters of a microscale spring, without stiffening, softening and weakening.
MICROSCALE = ("k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus")
# Colours of Okabe and Ito, safe for colour-blind readers.
BLACK, GREY, BLUE, SKY = "#000000", "#8c8c8c", "#0072B2", "#56B4E9"
VERMILION, ORANGE, GREEN = "#D55E00", "#E69F00", "#009E73"


# ------------------------------------------------------------------------------- arguments


def arguments(
    doc: str | None, out: Path | None = None, page: bool = False, **numbers: Any
) -> argparse.ArgumentParser:
    """Make the parser of a study from its docstring, output folder and numeric options.

    A numeric option is given by its default, or by default and help text. A study with `page` can
    write its page from its tables alone.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, given in numbers.items():
        default, what = given if isinstance(given, tuple) else (given, None)
        parser.add_argument(f"--{name}", type=type(default), default=default, help=what)
    if page:
        parser.add_argument("--page", action="store_true", help="only write page and figures")
    if out is not None:
        parser.add_argument("--out", type=Path, default=out, help="where results are written")
    return parser


def measurements(*folders: str) -> Path:
    """Return FOAMFIT_DATA, the folder of third-party measurements; check that `folders` exist."""
    data = Path(os.environ.get("FOAMFIT_DATA", ""))
    for folder in folders:
        if not (data / folder).is_dir():
            sys.exit(f"there is no {data / folder}; set FOAMFIT_DATA to the folder with {folder}/")
    return data


def in_order(
    work: Callable[..., Any], jobs: Iterable[tuple[Any, ...]], processes: int = 1
) -> Iterator[Any]:
    """Yield work(*job) for each job, in order, computed in several processes if there are."""
    if processes == 1:
        yield from (work(*job) for job in jobs)
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from (task.result() for task in [pool.submit(work, *job) for job in jobs])


def timed(work: Callable[..., Any], *given: Any, **options: Any) -> tuple[Any, float]:
    """Return the result of a call and its processor time, s (the machine may be shared)."""
    began = time.process_time()
    return work(*given, **options), time.process_time() - began


def run(command: Sequence[Any], **options: Any) -> tuple[str, float, float, float]:
    """Run a command; return its output, wall and processor time (s) and peak memory (MiB).

    The memory is that of its largest process.
    """
    began, words = time.perf_counter(), list(map(str, command))
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, **options) as process:
        output = process.stdout.read() if process.stdout else ""
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words)
    wall = time.perf_counter() - began
    return output, wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0


@contextmanager
def workplace() -> Iterator[Path]:
    """Yield a temporary folder."""
    with TemporaryDirectory() as place:
        yield Path(place)


def said(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Collect rows, printing each."""
    out = []
    for row in rows:
        print(row, flush=True)
        out.append(row)
    return pd.DataFrame(out)


# ------------------------------------------------------------------------------- tables and pages


def markdown(head: str | Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return a Markdown table; the head is a list, or names separated by "|"."""
    names = [name.strip() for name in head.split("|")] if isinstance(head, str) else list(head)
    return lines([names, ["---"] * len(names), *rows])


def lines(rows: Iterable[Iterable[Any]]) -> str:
    """Return the rows of a table whose head is in the page template."""
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in rows)


def shown(frame: pd.DataFrame, digits: int = 3) -> str:
    """Return a DataFrame as Markdown: numbers with `digits` digits, a dash for NaN."""

    def cell(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        large = 10.0**digits <= abs(value) < 1e5
        return "–" if np.isnan(value) else f"{value:.0f}" if large else f"{value:.{digits}g}"

    return markdown(frame.columns, (map(cell, row) for row in frame.astype(object).to_numpy()))


def write_csv(
    rows: Iterable[Mapping[str, Any]] | pd.DataFrame, path: Path, digits: int = 4
) -> None:
    """Write rows, or a DataFrame, with `digits` significant digits; compressed if named .gz."""
    raw: Any = {"method": "gzip", "mtime": 0} if path.suffix == ".gz" else None
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"float_format": f"%.{digits}g", "lineterminator": "\n"}
    pd.DataFrame(rows).to_csv(path, index=False, compression=raw, **options)


def write_page(folder: Path, out: Path | None = None, **values: Any) -> str:
    """Fill page.template.md of a folder and write README.md there or to `out`; return its text.

    `values` may leave out {circumstances}.
    """
    text = (folder / "page.template.md").read_text(encoding="utf-8")
    text = text.format(**{"circumstances": circumstances()} | values)
    ((out or folder) / "README.md").write_text(text, encoding="utf-8")
    return text


def circumstances(*packages: str) -> str:
    """Return versions and machine as text for a page; with packages also the processor."""
    if not packages:
        return f"foamfit {ff.__version__}, Python {platform.python_version()}, {platform.machine()}"
    info = Path("/proc/cpuinfo")
    text = info.read_text() if info.exists() else ""
    name = text.partition("model name")[2].partition("\n")[0].strip("\t :") or platform.processor()
    used = ", ".join(f"{package} {version(package)}" for package in packages)
    machine = f"{name} ({platform.machine()}, {os.cpu_count()} cores)"
    return f"{machine}; Python {platform.python_version()}, {used}"


def share(hits: Sequence[bool]) -> dict[str, float]:
    """Return the share of hits with its 95 % interval (Wilson)."""
    ends = binomtest(int(sum(hits)), len(hits)).proportion_ci(0.95, "wilson")
    return {"share": float(np.mean(hits)), "low": float(ends.low), "high": float(ends.high)}


# ------------------------------------------------------------------------------- figures


@contextmanager
def sheet(path: Path, width: float, height: float, dpi: int = 200) -> Iterator[Figure]:
    """Yield an empty figure (inches) in the common style and save it at the end."""
    with drawing(width, height) as figure:
        yield figure
        figure.savefig(path, dpi=dpi)


def gridlines(ax: Any) -> None:
    """Draw faint grid lines below the curves."""
    ax.grid(color="0.93", linewidth=0.5)
    ax.set_axisbelow(True)


# ------------------------------------------------------------------------------- files of tests


def write_test(path: Path, toml: str | None = None, **columns: Iterable[float]) -> Path:
    """Write a synthetic test (`time`, `stress`, `displacement` in SI) and its TOML."""
    units = {"time": "s", "stress": "Pa", "displacement": "m"}
    table = {f"{name} ({units[name]})": values for name, values in columns.items()}
    pd.DataFrame(table).to_csv(path, index=False)
    if toml is not None:
        path.with_suffix(".toml").write_text(toml)
    return path


def write_study(
    path: Path, tests: Iterable[str | Path], model: str, kinds: Mapping[str, Any], **settings: Any
) -> Path:
    """Write a STUDY.toml: tests, model, kinds of the parameters, settings.

    Parameters are those of the first spring unless they have a prefix. A mapping among the settings
    becomes a separate table.
    """
    import tomli_w  # with the extras "page" and "test"

    plain = {"tests": list(map(str, tests)), "model": model} | settings
    own = {n if re.match(r"s\d+_|site_", n) else f"s1_{n}": kind for n, kind in kinds.items()}
    path.write_text(tomli_w.dumps(plain | {"parameters": own}), encoding="utf-8")
    return path
