"""From the command to the report: how long does it take, warm and at first use, and where?

Method. A synthetic impact of 600 rows (published foam-1/model-1 at 2 m/s, 1 % white noise) is
fitted by `foamfit fit`, each time in a new process. "First use" is the first fit after
installation: nothing is compiled (an empty NUMBA_CACHE_DIR). The parts are those of one more
process, which calls in turn what the command calls; in the last part, figures are drawn in other
processes where there are two cores, as by the command.

Answer. 2.3 s once compiled, 11.4 s at first use; README.md says where the time goes.

    python experiments/start_up/start_up.py                 # table of this version
    python experiments/start_up/start_up.py --before PATH   # and of another checkout, in turns

Another checkout is the `src` folder of an earlier version; it runs with this Python.
"""

from __future__ import annotations

import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402
from million_rows import write  # noqa: E402

ROWS, WARM, FIRST = 600, 9, 3
PARTS = (
    "start of Python, command line",
    "CSV and TOML read (pandas, pint, parts of SciPy)",
    "import of the fit (numba, SciPy, lmfit)",
    "fit and intervals, compiled loops loaded",
    "figures, report, result folder",
)
PROBE = """
import contextlib, gc, sys, time
gc.set_threshold(100_000, 20, 10)  # as the command
marks = [time.perf_counter()]
import foamfit.cli
marks.append(time.perf_counter())
import foamfit
test = foamfit.read_test(sys.argv[1])
marks.append(time.perf_counter())
from foamfit import api
from foamfit.report.folder import save_result
try:
    from foamfit.cli.options import drawing_beside
except ImportError:  # earlier versions draw in their own process
    drawing_beside = None
with contextlib.nullcontext() if drawing_beside is None else drawing_beside() as drawers:
    if drawers is not None:
        drawers.begin()
    marks.append(time.perf_counter())
    result = api.fit(test)
    marks.append(time.perf_counter())
    save_result(result, sys.argv[2], **({} if drawers is None else {"mapped": drawers.map}))
    marks.append(time.perf_counter())
print(*(after - before for before, after in zip(marks, marks[1:])))
gc.freeze()  # as the command: what is left goes with the process
"""


def environment(source: Path | None, cache: Path | None) -> dict[str, str]:
    """Variables for a version of foamfit and, at first use, an empty cache."""
    changed = {"MPLBACKEND": "Agg"}
    if source is not None:
        changed["PYTHONPATH"] = str(source)
    if cache is not None:
        changed["NUMBA_CACHE_DIR"] = str(cache)
    return os.environ | changed


def fitted(test: Path, variables: dict[str, str]) -> tuple[float, float]:
    """Wall time and processor time of one fit by the command, s."""
    command = [sys.executable, "-m", "foamfit", "fit", str(test), "--quiet"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        subprocess.run(
            [*command, "--out", f"{folder}/result"], check=True, env=variables,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        wall = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, used


def parts(test: Path, variables: dict[str, str]) -> list[float]:
    """Wall time of each of `PARTS`, s."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", PROBE, str(test), f"{folder}/result"], check=True,
            env=variables, capture_output=True, text=True,
        )  # fmt: skip
        wall = time.perf_counter() - began
    measured = [float(part) for part in done.stdout.split()]
    return [wall - sum(measured[1:]), *measured[1:]]


def measure(sources: list[Path | None], test: Path) -> list[list[float]]:
    """Medians for each version: first use, warm, its processor time, and the parts.

    The versions take turns, so that a busy machine is busy for all.
    """
    runs: list[dict[str, list[list[float]]]] = [
        {"first": [], "warm": [], "parts": []} for _ in sources
    ]
    for _ in range(FIRST):
        for source, kept in zip(sources, runs, strict=True):
            with tempfile.TemporaryDirectory() as cache:
                kept["first"].append([fitted(test, environment(source, Path(cache)))[0]])
    for source in sources:
        fitted(test, environment(source, None))  # what is not compiled yet
    for _ in range(WARM):
        for source, kept in zip(sources, runs, strict=True):
            variables = environment(source, None)
            kept["warm"].append(list(fitted(test, variables)))
            kept["parts"].append(parts(test, variables))
    return [
        [
            statistics.median(column)
            for name in ("first", "warm", "parts")
            for column in zip(*kept[name], strict=True)
        ]
        for kept in runs
    ]


def table(names: list[str], measured: list[list[float]]) -> str:
    """A Markdown table with a column for each version."""
    rows = (
        f"first use, from command to report (median of {FIRST})",
        f"warm, from command to report (median of {WARM})",
        "processor time of its first process",
        *(f"– {part}" for part in PARTS),
    )
    told = ([f"{value:.2f}" for value in values] for values in zip(*measured, strict=True))
    cells = ([row, *values] for row, values in zip(rows, told, strict=True))
    return studies.markdown([f"{ROWS} rows; wall time in s", *names], cells)


def main() -> None:
    parser = studies.arguments(__doc__)
    parser.add_argument("--before", type=Path, metavar="PATH", help="src folder of another version")
    before = parser.parse_args().before
    sources: list[Path | None] = [None] if before is None else [before, None]
    with tempfile.TemporaryDirectory() as folder:
        measured = measure(sources, write(Path(folder), ROWS))
    told = table(["now"] if before is None else ["before", "now"], measured)
    print(told)
    if before is not None:
        machine = f"{os.cpu_count()} cores, {platform.machine()}"
        machine += f", Python {platform.python_version()}"
        page = (HERE / "page.template.md").read_text(encoding="utf-8")
        text = page.replace("{table}", told).replace("{machine}", machine)
        (HERE / "README.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
