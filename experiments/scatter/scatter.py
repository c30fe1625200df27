"""Does the band of a prediction contain an unseen specimen, and is it narrow enough?

Method and answer: README.md. Also written: scatter.csv.

    FOAMFIT_DATA=… python experiments/scatter/scatter.py    # ten minutes; --page: from the table
"""

import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

import foamfit as ff
from foamfit.text import percent

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies

HERE = Path(__file__).parent
GROUPS, COUNT = ("new", "worn"), 5
SCATTER = dict.fromkeys((*studies.MICROSCALE, "g1", "tau1"), "scatter")


def predicted(folder: Path, group: str, left: int) -> dict[str, Any]:
    """Predict one specimen from a joint fit of the others of its group."""
    names = {i: f"{group}-heel-comp-{i}_raw.txt" for i in range(1, COUNT + 1)}
    study = studies.write_study(
        folder / "study.toml", [name for i, name in names.items() if i != left], "microscale",
        SCATTER, relaxation=1, drive="displacement", name=f"{group} heel",
    )  # fmt: skip
    every = {i: ff.read_test(folder / name) for i, name in names.items()}
    test = every.pop(left)
    found = ff.predict(ff.joint(study), test)
    one = found.curves["stress_strain"]
    simple = np.array([along(other, test) for other in every.values()])
    t = float(stats.t.ppf(0.975, COUNT - 2))
    half = t * simple.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / (COUNT - 1))
    off = np.abs(test.stress - simple.mean(axis=0))
    return {
        "specimen": f"{group} {left}", "samples": int(one.kept.sum()),
        "inside": one.inside, "half_width": one.half_width / one.range,
        "inside_simple": float(np.mean(off <= half)),
        "half_width_simple": float(half.mean()) / one.range,
        **{part: one.half_width_of(part) / one.range for part in one.parts},
        "warned": any("leave open" in w for w in found.warnings),
    }  # fmt: skip


def along(test: ff.Measurement, other: ff.Measurement) -> np.ndarray:
    """Return a test's stress at the relative strains and branches of another test."""
    here, at = (one.displacement / one.displacement.max() for one in (test, other))
    stress = test.stress
    turn, there = int(np.argmax(here)), int(np.argmax(at)) + 1
    back = np.maximum.accumulate(here[turn:][::-1])
    loaded = np.interp(at[:there], np.maximum.accumulate(here[: turn + 1]), stress[: turn + 1])
    unloaded = np.interp(at[there:], back, stress[turn:][::-1], left=float(stress[-1]))
    return np.concatenate([loaded, unloaded])


def page(frame: pd.DataFrame) -> None:
    """Write the page from all rows."""
    ratio, t_alone = frame.half_width / frame.half_width_simple, np.sqrt(1.0 + 1.0 / (COUNT - 1))
    table = pd.DataFrame({
        "left out": frame.specimen, "inside (%)": 100.0 * frame.inside,
        "band (±%)": 100.0 * frame.half_width, "inside the simple band (%)":
        100.0 * frame.inside_simple, "simple band (±%)": 100.0 * frame.half_width_simple,
        "ratio": ratio, "to ± t s": ratio * t_alone,
    })  # fmt: skip
    good = frame[frame.inside >= 0.93]
    inside, simple = (np.average(frame[one], weights=frame.samples)
                      for one in ("inside", "inside_simple"))  # fmt: skip
    studies.write_page(
        HERE, table=studies.shown(table), inside=percent(float(inside), 3),
        simple=percent(float(simple), 3), median=ratio.median(), least=ratio.min(),
        most=ratio.max(), few=len(frame) - len(good), count=len(frame),
        rest=percent(good.inside.min(), 3),
    )  # fmt: skip


def main() -> None:
    if not studies.arguments(__doc__, page=True).parse_args().page:
        studies.measurements("shoe-foam-twins")
        with studies.workplace() as folder:
            for name in records.HEELS:
                records.place(name, folder)
            cases = product(GROUPS, range(1, COUNT + 1))
            frame = studies.said(predicted(folder, group, left) for group, left in cases)
        studies.write_csv(frame, HERE / "scatter.csv", 5)
    page(pd.read_csv(HERE / "scatter.csv"))


if __name__ == "__main__":
    main()
