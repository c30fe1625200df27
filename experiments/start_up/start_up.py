"""How long does `foamfit fit` take to the report, warm and at first use, and where is time spent?

Method and answer: README.md. "First use" is the first fit after installation: nothing is compiled
(an empty NUMBA_CACHE_DIR). The parts are measured in another process, which calls the same
functions.

    python experiments/start_up/start_up.py
    python experiments/start_up/start_up.py --rows 1000000 --warm 1 --first 0
"""

import os
import statistics
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

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


def measure(test: Path, first: int, warm: int) -> dict[str, float]:
    """Return medians of first use, warm use, its processor time and memory, and the parts."""
    out, own = test.parent / "result", os.environ | {"MPLBACKEND": "Agg"}
    fit = [sys.executable, "-m", "foamfit", "fit", test, "--quiet", "--out", out]
    probe = [sys.executable, "-c", PROBE, test, out]
    found = defaultdict[str, list[float]](list)
    for _ in range(first):
        with studies.workplace() as cache:
            wall = studies.run(fit, env=own | {"NUMBA_CACHE_DIR": str(cache)})[1]
        found[f"first use, from command to report (median of {first})"].append(wall)
    studies.run(fit, env=own)  # compiles the rest
    for _ in range(warm):
        _, wall, used, peak = studies.run(fit, env=own)
        found[f"warm, from command to report (median of {warm})"].append(wall)
        found["processor time of its first process"].append(used)
        found["peak memory"].append(peak)
        printed, wall, *_ = studies.run(probe, env=own)
        parts = [float(part) for part in printed.split()]
        for name, part in zip(PARTS, [wall - sum(parts[1:]), *parts[1:]], strict=True):
            found[f"– {name}"].append(part)
    return {name: statistics.median(values) for name, values in found.items()}


def main() -> None:
    counts: dict[str, Any] = {"first": (3, "fits at first use"), "warm": (9, "once compiled")}
    options = studies.arguments(__doc__, HERE, rows=reconstruct.ROWS, **counts).parse_args()
    with studies.workplace() as folder:
        test = reconstruct.write(ff.published["foam-1/model-1"], 2.0, folder, options.rows)
        measured = measure(test, options.first, options.warm)
    peak = measured.pop("peak memory")
    rows = ((name, f"{seconds:.2f}") for name, seconds in measured.items())
    table = studies.markdown([f"{options.rows} rows", "wall time (s)"], rows)
    print(table, f"peak memory {peak:.0f} MiB", sep="\n")
    if options.rows == reconstruct.ROWS:
        machine = f"{os.cpu_count()} cores, {studies.circumstances()}"
        studies.write_page(HERE, options.out, table=table, circumstances=machine)


if __name__ == "__main__":
    main()
