"""Does the band of a prediction contain an unseen specimen, and is it narrow enough?

Method and answer: README.md. Also written: scatter.csv.

    FOAMFIT_DATA=… python experiments/scatter/scatter.py       # ten minutes
"""

import sys
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
OPEN = {"k0": "scatter", "sigma_plus": "shared"}  # the others are own


def predicted(
    folder: Path, group: str, fitted: list[int], left: list[int], kinds: dict[str, str]
) -> list[dict[str, Any]]:
    """Fit some specimens jointly and predict others; return one row for each."""
    names = {i: f"{group}-heel-comp-{i}_raw.txt" for i in (*fitted, *left)}
    study = studies.write_study(
        folder / "study.toml", [names[i] for i in fitted], "microscale", kinds,
        relaxation=1, drive="displacement", name=f"{group} heel",
    )  # fmt: skip
    result, rows = ff.joint(study), []
    every = {i: ff.read_test(folder / name) for i, name in names.items()}
    for i in left:
        found = ff.predict(result, every[i])
        one = found.curves["stress_strain"]
        simple = np.array([along(every[j], every[i]) for j in fitted])
        t = float(stats.t.ppf(0.975, len(fitted) - 1))
        half = t * simple.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / len(fitted))
        off = np.abs(every[i].stress - simple.mean(axis=0))
        rows.append({
            "specimen": f"{group} {i}", "fitted": len(fitted), "samples": int(one.kept.sum()),
            "inside": one.inside, "half_width": one.half_width / one.range,
            "inside_simple": float(np.mean(off <= half)),
            "half_width_simple": float(half.mean()) / one.range,
            **{part: one.half_width_of(part) / one.range for part in one.parts},
            "warned": any("leave open" in w for w in found.warnings),
        })  # fmt: skip
        print(rows[-1], flush=True)
    return rows


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
    four, two = frame[frame.fitted == COUNT - 1], frame[frame.fitted == 2]
    ratio = four.half_width / four.half_width_simple
    t_alone = np.sqrt(1.0 + 1.0 / (COUNT - 1))
    rows = [
        [r.specimen, percent(r.inside, 3), f"±{percent(r.half_width)}", percent(r.inside_simple, 3),
         f"±{percent(r.half_width_simple)}", f"{r.half_width / r.half_width_simple:.2f}",
         f"{r.half_width / r.half_width_simple * t_alone:.2f}"]
        for r in (*four.itertuples(), *two.itertuples())
    ]  # fmt: skip
    good = four[four.inside >= 0.93]
    inside, simple = (np.average(one, weights=four.samples) for one in
                      (four.inside, four.inside_simple))  # fmt: skip
    studies.write_page(
        HERE, rows=studies.lines(rows[: len(four)]),
        two=studies.lines(row[:3] for row in rows[len(four) :]),
        inside=percent(float(inside), 3), simple=percent(float(simple), 3),
        median=ratio.median(), least=ratio.min(), most=ratio.max(),
        few=len(four) - len(good), count=len(four), rest=percent(good.inside.min(), 3),
    )  # fmt: skip


def main() -> None:
    studies.arguments(__doc__).parse_args()
    studies.measurements("shoe-foam-twins")
    rows, numbers = [], list(range(1, COUNT + 1))
    with records.placed(*records.HEELS) as folder:
        for group in GROUPS:
            for left in numbers:
                others = [i for i in numbers if i != left]
                rows += predicted(folder, group, others, [left], SCATTER)
            rows += predicted(folder, group, [1, 2], [3, 4, 5], OPEN)
    frame = pd.DataFrame(rows)
    studies.write_csv(frame, HERE / "scatter.csv", 5)
    page(frame)


if __name__ == "__main__":
    main()
