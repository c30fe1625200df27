"""Does the band of a prediction hold the next specimen of a foam, and is it as narrow as can be?

    FOAMFIT_DATA=path/to/data python experiments/scatter/scatter.py

The measurements are not part of this repository: shoe-foam-twins/ are compressions of five
specimens of a new and of a worn heel (arXiv:2602.12694, LivingMatterLab/CANN on GitHub). Each
specimen is predicted from a joint fit of the other four of its heel, all parameters "scatter", and
then three specimens from two, most parameters "own". Writes README.md and scatter.csv beside this
file. About ten minutes.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

import foamfit as ff
from foamfit.text import percent

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from specimens import twins, write_specimen  # noqa: E402

GROUPS, COUNT = ("new", "worn"), 5
LAW = (
    "k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus", "g1", "tau1"
)  # fmt: skip
SCATTER = {f"s1_{name}": "scatter" for name in LAW}
OPEN = {"s1_k0": "scatter", "s1_sigma_plus": "shared"}  # the others are own
STUDY = """\
name = "{group} heel"
tests = [{tests}]
model = "microscale"
relaxation = 1
drive = "displacement"

[parameters]
{parameters}
"""


def place_tests(data: Path, folder: Path) -> None:
    """Link the tests into a folder, with the TOML of each beside it."""
    for test, height, diameter in twins(data):
        (folder / f"{test}_raw.txt").symlink_to((data / f"{test}_raw.txt").resolve())
        write_specimen(folder / f"{test}_raw.toml", height, diameter)


def name_of(group: str, number: int) -> str:
    """Name of the file of a specimen."""
    return f"{group}-heel-comp-{number}_raw.txt"


def predicted(
    folder: Path, group: str, fitted: list[int], left: list[int], kinds: dict[str, str]
) -> list[dict[str, Any]]:
    """Fit some specimens together and predict others: one row for each."""
    study = folder / "study.toml"
    study.write_text(
        STUDY.format(
            group=group,
            tests=", ".join(f'"{name_of(group, i)}"' for i in fitted),
            parameters="\n".join(f'{name} = "{kind}"' for name, kind in kinds.items()),
        )
    )
    result, rows = ff.joint(study, jobs=1), []
    every = {i: ff.read_test(folder / name_of(group, i)) for i in (*fitted, *left)}
    for i in left:
        found = ff.predict(result, every[i])
        one = found.curves["stress_strain"]
        simple = np.array([along(every[j], every[i]) for j in fitted])
        t = float(stats.t.ppf(0.975, len(fitted) - 1))
        half = t * simple.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / len(fitted))
        off = np.abs(every[i].stress - simple.mean(axis=0))
        rows.append(
            {
                "specimen": f"{group} {i}", "fitted": len(fitted), "samples": int(one.kept.sum()),
                "inside": one.inside, "half_width": one.half_width / one.range,
                "inside_simple": float(np.mean(off <= half)),
                "half_width_simple": float(half.mean()) / one.range,
                **{part: one.half_width_of(part) / one.range for part in one.parts},
                "warned": any("leave open" in w for w in found.warnings),
            }
        )  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def along(test: Any, other: Any) -> np.ndarray:
    """Stress of a test where another one has the same share of its largest strain, same branch."""
    strain, at = test.displacement / test.displacement.max(), other.displacement
    turn, at = int(np.argmax(strain)), at / at.max()
    back = int(np.argmax(at)) + 1
    up = np.interp(at[:back], np.maximum.accumulate(strain[: turn + 1]), test.stress[: turn + 1])
    falling = np.maximum.accumulate(strain[turn:][::-1])
    return np.concatenate([up, np.interp(at[back:], falling, test.stress[turn:][::-1])])


def page(frame: pd.DataFrame) -> str:
    """The page of all rows."""
    four, two = frame[frame.fitted == COUNT - 1], frame[frame.fitted == 2]
    ratio = four.half_width / four.half_width_simple
    worst = ratio.idxmax()
    t_alone = np.sqrt(1.0 + 1.0 / (COUNT - 1))
    rows = [
        f"| {r.specimen} | {percent(r.inside, 3)} | ±{percent(r.half_width)} | "
        f"{percent(r.inside_simple, 3)} | ±{percent(r.half_width_simple)} | "
        f"{ratio[r.Index]:.2f} | {ratio[r.Index] * t_alone:.2f} |"
        for r in four.itertuples()
    ]
    good = four[four.inside >= 0.93]
    template = (HERE / "page.template.md").read_text(encoding="utf-8")
    return template.format(
        rows="\n".join(rows),
        inside=percent(float(np.average(four.inside, weights=four.samples)), 3),
        simple=percent(float(np.average(four.inside_simple, weights=four.samples)), 3),
        median=ratio.median(), most=ratio.drop(worst).max(), worst=four.specimen[worst],
        outlier=percent(four.inside_simple[worst]), few=len(four) - len(good), count=len(four),
        rest=percent(good.inside.min(), 3),
        two="\n".join(
            f"| {r.specimen} | {percent(r.inside, 3)} | ±{percent(r.half_width)} |"
            for r in two.itertuples()
        ),
    )  # fmt: skip


def main() -> None:
    data = Path(os.environ.get("FOAMFIT_DATA", "")) / "shoe-foam-twins"
    if not data.is_dir():
        sys.exit(f"there is no {data}; set FOAMFIT_DATA to the folder with shoe-foam-twins/")
    rows, numbers = [], list(range(1, COUNT + 1))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        place_tests(data, folder)
        for group in GROUPS:
            for left in numbers:
                others = [i for i in numbers if i != left]
                rows += predicted(folder, group, others, [left], SCATTER)
            rows += predicted(folder, group, [1, 2], [3, 4, 5], OPEN)
    frame = pd.DataFrame(rows)
    frame.to_csv(HERE / "scatter.csv", index=False, float_format="%.5g", lineterminator="\n")
    (HERE / "README.md").write_text(page(frame), encoding="utf-8")


if __name__ == "__main__":
    main()
