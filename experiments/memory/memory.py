"""Do springs that remember describe all cycles of a foam with one set of parameters?

Method and answer: README.md. Also written: memory.csv (a row for each cycle of each specimen) and
memory.png.

    FOAMFIT_DATA=… python experiments/memory/memory.py          # --page: from the tables alone
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.data.cycles import cycles_of
from foamfit.report.prediction import plot_prediction
from foamfit.results import Fit

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from records import HEELS, SOURCE

HERE = Path(__file__).parent
TABLE = HERE / "memory.csv"
SHOWN = "new-heel-comp-3"  # in the picture
FIRST, HISTORY, PREDICTED = "first cycle", "cycles 1 to 3", "predicted"
# Specimens on which the growth of the band was chosen.
CHOSEN = [f"new-heel-comp-{i}" for i in (1, 2, 4, 5)]
BARS = {FIRST: (0.56, 0.75), HISTORY: (0.90, 1.10), PREDICTED: (1.0, 1.25)}  # mean, worst, %
MEMORY: dict[str, Any] = {"model": "microscale", "stiffening": True, "mullins": True}


def misfits(test: ff.Measurement, result: Fit) -> dict[int, float]:
    """Return the misfit of each cycle relative to the range of that cycle."""
    fitted, measured = result.curves.stress, test.stress
    assert fitted is not None
    assert measured is not None
    spans = cycles_of(test) or {test.cycle: slice(None)}
    return {
        number: float(np.sqrt(np.mean((fitted - measured)[part] ** 2)) / np.ptp(measured[part]))
        for number, part in spans.items()
    }


def fits(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield a row for each fitted or predicted cycle, and for three cycles as one history."""
    for test in records.first_cycles(folder):
        result, seconds = studies.timed(ff.fit, test, **MEMORY, relaxation=1)
        miss = misfits(test, result)[test.cycle]
        row = {"test": test.name, "what": FIRST, "cycle": 1, "misfit": miss, "inside": np.nan}
        yield row | {"seconds": seconds}
    for name in ("turbo-comp-1 cycles", *HEELS):
        file, specimen = records.place(name, folder), name.removesuffix(" cycles")
        about, test = {"test": specimen, "what": HISTORY}, ff.read_test(file, cycles=(1, 3))
        result, seconds = studies.timed(ff.fit, test, **MEMORY, relaxation=2)
        later = ff.predict(result, ff.read_test(file, cycles=(1, 5)))
        whole = {"cycle": "1-3", "misfit": result.misfit["stress_strain"], "seconds": seconds}
        yield about | whole
        yield from (about | {"cycle": n, "misfit": m} for n, m in misfits(test, result).items())
        for number, one in later.by_cycle.items():
            if number > 3:
                yield about | {"what": PREDICTED, "cycle": number, **one}
        if specimen == SHOWN:
            plot_prediction(later).savefig(HERE / "memory.png", dpi=200)


def summary(table: pd.DataFrame) -> str:
    """Return mean and worst misfit of each part with the goals, and samples inside the band."""
    rows = []
    for what, (mean, worst) in BARS.items():
        own = table[(table["what"] == what) & ((what != HISTORY) | (table["cycle"] == "1-3"))]
        miss, inside = (100.0 * own[one].astype(float) for one in ("misfit", "inside"))
        rows.append({
            "what": what, "specimens": own["test"].nunique(),
            "mean misfit (goal), %": f"{miss.mean():.2f} (≤ {mean:.2f})",
            "worst misfit (goal), %": f"{miss.max():.2f} (≤ {worst:.2f})",
            "least inside the band, %": inside.min(), "most": inside.max(),
        })  # fmt: skip
    return studies.shown(pd.DataFrame(rows))


def per_specimen(table: pd.DataFrame) -> str:
    """Return misfit of each cycle, and samples of predicted ones inside the band, in %."""
    wide = table[table["what"] != FIRST].assign(cycle="cycle " + table["cycle"].astype(str))
    made = wide.pivot_table(index="test", columns="cycle", values=["misfit", "inside"], sort=False)
    cells = 100.0 * made.dropna(axis="columns", how="all")
    cells.columns = [cycle + " inside" * (what == "inside") for what, cycle in cells.columns]
    return studies.shown(cells.reset_index())


def coverage(predicted: pd.DataFrame) -> str:
    """Describe the share of samples of cycles 4 and 5 inside the band, for some specimens."""
    share = 100.0 * predicted["inside"].astype(float)
    there = int(((share >= 93.0) & (share <= 99.0)).sum())
    return (
        f"{share.mean():.1f} % of the samples on average, {share.min():.0f}–{share.max():.0f} % "
        f"per cycle, and 93–99 % in {there} of {share.size} cycles"
    )


def main() -> None:
    if not studies.arguments(__doc__, page=True).parse_args().page:
        studies.measurements("shoe-foam", "shoe-foam-twins")
        with studies.workplace() as folder:
            studies.write_csv(studies.said(fits(folder)), TABLE)
    table = pd.read_csv(TABLE)
    took = table[table["what"] == HISTORY]["seconds"].dropna()
    studies.write_page(
        HERE, source=SOURCE, summary=summary(table), specimens=per_specimen(table),
        inside=coverage(table[table["what"] == PREDICTED]),
        seconds=f"{took.min():.0f} to {took.max():.0f} s, {took.mean():.0f} s on average,",
        verified=coverage(table[(table["what"] == PREDICTED) & ~table["test"].isin(CHOSEN)]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
