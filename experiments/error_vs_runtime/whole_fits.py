"""How long does a whole fit of a real record take, compared with plain least squares?

Method. Real loops and an impact are fitted by `foamfit.fit` with its defaults, in one process, after
a first fit of each kind that compiles: search, refinement, intervals, ranges and warnings. The unit
is the time that plain SciPy needs for the shoe foam turbo-comp-2 with one bistable spring: sixteen
random starts of `least_squares` along the measured motion, without any interval. It runs before and
after every fit, so that both see the same machine. Also printed: the misfit, the evaluations, and
the shares of the solver.

Answer. See whole_fits.md.

    FOAMFIT_DATA=path/to/data python experiments/error_vs_runtime/whole_fits.py       # 5 minutes
"""

# ruff: noqa: E402  (the number of threads is read when NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "real_records")]

import foamfit as ff
import real_records
import studies
from real_foams import first_cycles

STARTS = 16  # of plain least squares
# Record, options of the fit.
FITS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("turbo-comp-2", {"model": "bistable"}),
    ("turbo-comp-2", {"model": "microscale", "relaxation": 1}),
    ("turbo-comp-2", {"model": "bistable+bistable"}),
    ("turbo-comp-2", {"model": "auto"}),
    ("cartilage 1", {"model": "microscale", "relaxation": 1}),
    ("aluminium foam", {"model": "auto"}),
    ("leap-comp-2", {"model": "bistable+bistable"}),
    ("turbo-comp-1", {"model": "bistable+bistable"}),
)


def tests(data: Path, folder: Path) -> dict[str, ff.Measurement]:
    """Return the measurements by name."""
    found = {test.name: test for test in first_cycles(data, folder, ("turbo-comp", "leap-comp"))}
    for real in real_records.RECORDS:
        if real.name in {name for name, _ in FITS}:
            toml = folder / "test.toml"
            toml.write_text(real.toml)
            found[real.name] = ff.read_test(data / real.file, toml)
    return found


def plain(test: ff.Measurement) -> tuple[float, float]:
    """Return the seconds and the misfit (%) of plain least squares with one bistable spring."""
    began = time.perf_counter()
    misfit = real_records.plain(test, "bistable", 0.0, starts=STARTS)
    return time.perf_counter() - began, 100.0 * misfit


def rows(found: dict[str, ff.Measurement]) -> Iterator[dict[str, object]]:
    """Yield one row for each fit."""
    for name, options in FITS:
        small = {k: v for k, v in options.items() if k != "model"}
        model = options["model"]
        for one in ("microscale", "bistable+bistable") if model == "auto" else (model,):
            ff.fit(found[name], model=one, max_time=0.5, **small)
    unit = plain(found["turbo-comp-2"])
    for name, options in FITS:
        began = time.perf_counter()
        result = ff.fit(found[name], **options)
        seconds = time.perf_counter() - began
        later = plain(found["turbo-comp-2"])
        per = seconds / (0.5 * (unit[0] + later[0]))
        unit = later
        misfits = [f"{100.0 * m:.2f}" for m in result.misfit.values() if m is not None]
        yield {
            "record": name, "fit": options["model"], "relaxation": options.get("relaxation", 0),
            "chosen": result.model_name if hasattr(result, "model_name") else result.model,
            "seconds": round(seconds, 2), "times plain SciPy": round(per, 1),
            "misfits (%)": " / ".join(misfits), "evaluations": result.statistics["nfev"],
        }  # fmt: skip


def main() -> None:
    """Fit all records and write the table."""
    args = studies.arguments(__doc__, HERE).parse_args()
    data = studies.measurements("cartilage-impact", "aluminium-foam", "shoe-foam")
    with tempfile.TemporaryDirectory() as made:
        found = tests(data, Path(made))
        table = pd.DataFrame(real_records.said(rows(found)))
        seconds, misfit = plain(found["turbo-comp-2"])
        print(f"plain SciPy: {seconds:.2f} s, {misfit:.2f} %")
    print(studies.shown(table))


if __name__ == "__main__":
    main()
