"""How long does `foamfit fit` take to the report, warm and at first use, and where is time spent?

Method and answer: README.md. "First use" is the first fit after installation: nothing is compiled
(an empty NUMBA_CACHE_DIR). The parts are measured in another process, which calls the same
functions.

    python experiments/start_up/start_up.py
    python experiments/start_up/start_up.py --rows 1000000 --warm 1 --first 0
"""

import os
import resource
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import reconstruct
import studies

HERE = Path(__file__).parent
PARTS = {  # of a fit, and what each runs
    "start of Python, command line": "import foamfit.cli",
    "CSV and TOML read (pandas, pint, parts of SciPy)":
        "import foamfit; test = foamfit.read_test(sys.argv[1])",
    "import of the fit (numba, SciPy, lmfit)": "from foamfit import api",
    "fit and intervals, compiled loops loaded": "result = api.fit(test)",
    "figures, report, result folder": "result.save(sys.argv[2])",
}  # fmt: skip
MARK = "\nmarks.append(time.perf_counter())\n"
PROBE = (  # garbage is collected as in the command
    "import gc, sys, time\ngc.set_threshold(100_000, 20, 10)\nmarks = [time.perf_counter()]\n"
    + MARK.join([*PARTS.values(), ""])
    + "print(*(after - before for before, after in zip(marks, marks[1:])))\ngc.freeze()"
)


def run(command: list[str], **variables: str) -> tuple[float, float, str]:
    """Run a command; return wall and processor time (s) and output."""
    own = os.environ | {"MPLBACKEND": "Agg"} | variables
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, check=True, env=own, capture_output=True, text=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, sum(after[:2]) - sum(before[:2]), done.stdout  # user and system


def measure(test: Path, first: int, warm: int) -> dict[str, float]:
    """Return medians of first use, warm use, its processor time, and the parts."""
    out = str(test.parent / "result")
    fit = [sys.executable, "-m", "foamfit", "fit", str(test), "--quiet", "--out", out]
    probe = [sys.executable, "-c", PROBE, str(test), out]
    found = defaultdict[str, list[float]](list)
    for _ in range(first):
        with studies.workplace() as cache:
            wall = run(fit, NUMBA_CACHE_DIR=str(cache))[0]
        found[f"first use, from command to report (median of {first})"].append(wall)
    run(fit)  # compiles the rest
    for _ in range(warm):
        wall, used, _ = run(fit)
        found[f"warm, from command to report (median of {warm})"].append(wall)
        found["processor time of its first process"].append(used)
        wall, _, printed = run(probe)
        parts = [float(part) for part in printed.split()]
        for name, part in zip(PARTS, [wall - sum(parts[1:]), *parts[1:]], strict=True):
            found[f"– {name}"].append(part)
    return {name: statistics.median(values) for name, values in found.items()}


def main() -> None:
    parser = studies.arguments(
        __doc__,
        HERE,
        rows=reconstruct.ROWS,
        first=(3, "fits at first use"),
        warm=(9, "fits once compiled"),
    )
    options = parser.parse_args()
    with studies.workplace() as folder:
        test = reconstruct.write(ff.published["foam-1/model-1"], 2.0, folder, options.rows)
        measured = measure(test, options.first, options.warm)
    rows = ((name, f"{seconds:.2f}") for name, seconds in measured.items())
    table = studies.markdown([f"{options.rows} rows", "wall time (s)"], rows)
    print(table)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"peak memory {peak:.0f} MiB")
    if options.rows == reconstruct.ROWS:
        machine = f"{os.cpu_count()} cores, {studies.circumstances()}"
        studies.write_page(HERE, options.out, table=table, circumstances=machine)


if __name__ == "__main__":
    main()
