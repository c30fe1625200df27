"""How long does a whole fit of a real record take, compared with plain least squares?

Method and answer: README.md.

    FOAMFIT_DATA=… python experiments/whole_fits/whole_fits.py       # 5 minutes
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from real_records import plain_misfit

HERE = Path(__file__).parent
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


def plain(test: ff.Measurement) -> tuple[float, float]:
    """Return misfit and seconds of plain least squares with one bistable spring."""
    return studies.timed(plain_misfit, test, "bistable", 0.0, starts=STARTS)


def rows(found: dict[str, ff.Measurement]) -> Iterator[dict[str, object]]:
    """Yield one row for each fit."""
    for name, options in FITS:  # compiles
        auto = options["model"] == "auto"
        for one in ("microscale", "bistable+bistable") if auto else (options["model"],):
            ff.fit(found[name], **options | {"model": one}, max_time=0.5)
    unit = plain(found["turbo-comp-2"])[1]
    for name, options in FITS:
        result, seconds = studies.timed(ff.fit, found[name], **options)
        later = plain(found["turbo-comp-2"])[1]
        effort, misfit = result.effort, result.misfit["stress_strain"]
        yield {
            "record": name, "fit": " ".join(f"--{key} {value}" for key, value in options.items()),
            "selected": result.law,
            "misfit (%)": round(100.0 * misfit, 2), "seconds": round(seconds, 2),
            "times plain SciPy": round(2.0 * seconds / (unit + later), 1),
            "simulations": effort["simulations"],
            "ms each": round(1e3 * effort["simulating"] / effort["simulations"], 2),
            "compiled (%)": round(100.0 * effort["compiled"] / effort["total"]),
        }  # fmt: skip
        unit = later


def main() -> None:
    """Fit all records and write the table."""
    args = studies.arguments(__doc__, HERE).parse_args()
    threadpool_limits(1)
    studies.measurements("cartilage-impact", "aluminium-foam", "shoe-foam")
    with studies.workplace() as folder:
        found = {name: ff.read_test(records.place(name, folder)) for name, _ in FITS}
        table = studies.said(rows(found))
        misfit, seconds = plain(found["turbo-comp-2"])
    studies.write_page(
        HERE, args.out, table=studies.shown(table), seconds=f"{seconds:.2f}",
        misfit=f"{100.0 * misfit:.2f}", starts=STARTS,
    )  # fmt: skip


if __name__ == "__main__":
    main()
