"""What does the plan promise on real records, and what did the further tests determine?

Method. (1) A mycelium tested at 2 s per cycle (outplane-2s-1, microscale spring with relaxation):
which rate would determine the relaxation? The plan is compared with joint fits with other specimens
at 4 s and at 80 s per cycle (all parameters own but g1 and tau1). (2) A shoe foam (new-heel-comp-1,
microscale spring with relaxation, softening and weakening): what would cycles 2 to 5 add to cycle
1? The plan for five cycles of the same strain and rate is compared with the fit of cycles 1 to 5.

Answer. See README.md.

    FOAMFIT_DATA=path/to/data python experiments/plan/real.py
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

import foamfit as ff

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

RATES = {"2s": 1.0, "4s": 0.5, "80s": 0.025}  # 1/s
HEEL = "new-heel-comp-1"
Row = dict[str, Any]


def mycelium(data: Path, folder: Path, name: str) -> Path:
    """Write the TOML of a mycelium test, copy its record, and return the path of the copy."""
    text = (data / f"{name}_raw.txt").read_text(encoding="utf-8")
    gap = text.splitlines()[1].split("\t")[5].strip()
    studies.write_specimen(folder / f"{name}.toml", f"{gap} um", "8 mm")
    path = folder / f"{name}.txt"
    path.write_text(text, encoding="utf-8")
    return path


def shares(one: Any) -> tuple[float, float]:
    """Return half the 95 % interval and half the range of a parameter, over its value."""
    ends = [one.ci95, one.range]
    size = abs(one.value) or math.nan
    half, open_ = (math.nan if e is None else 0.5 * (e[1] - e[0]) / size for e in ends)
    return half, open_


def relaxation(data: Path, folder: Path) -> Iterator[Row]:
    """Yield rows on the relaxation of the mycelium."""
    paths = {rate: mycelium(data, folder, f"outplane-{rate}-1") for rate in RATES}
    rig = folder / "rig.toml"
    rig.write_text('[machine]\nrate = "0.025 to 1 1/s"\nstrain = "0.5"\ncycles = 1\n')
    first = ff.fit(ff.read_test(paths["2s"]), model="microscale", relaxation=1)
    plan = ff.plan(first, rig=rig)
    print(plan)
    for name in ("s1_g1", "s1_tau1"):
        now = first.parameters[name]
        yield row("mycelium", name, "2 s per cycle, alone", *shares(now), now.state)
        for one in plan.outcomes:
            if one.candidate.hold or one.candidate.repeat:
                continue
            found = one.expected[name]
            what = f"expected with a test at {one.candidate.rate:.3g} 1/s"
            yield row("mycelium", name, what, found.share, math.nan, found.state)
    for rate in ("4s", "80s"):
        study = folder / f"{rate}.toml"
        names = [paths["2s"].name, paths[rate].name]
        study.write_text(
            f'name = "{rate}"\ntests = {json.dumps(names)}\nmodel = "microscale"\nrelaxation = 1\n'
            '[parameters]\ns1_g1 = "shared"\ns1_tau1 = "shared"\n', encoding="utf-8"
        )  # fmt: skip
        joint = ff.joint(study, jobs=1)
        alone = ff.fit(ff.read_test(paths[rate]), model="microscale", relaxation=1)
        for name in ("s1_g1", "s1_tau1"):
            what = f"obtained with a test at {RATES[rate]:g} 1/s (joint fit)"
            yield row("mycelium", name, what, *shares(joint.parameters[name]),
                      joint.parameters[name].state)  # fmt: skip
            what = f"the test at {RATES[rate]:g} 1/s alone"
            yield row("mycelium", name, what, *shares(alone.parameters[name]),
                      alone.parameters[name].state)  # fmt: skip


def cycles(data: Path, folder: Path) -> Iterator[Row]:
    """Yield rows on the cycles of a shoe foam."""
    sizes = {name: size for name, *size in studies.twins(data)}
    toml = studies.write_specimen(folder / "heel.toml", *sizes[HEEL])
    path, law = data / f"{HEEL}_raw.txt", {"model": "microscale", "relaxation": 1, "mullins": True}
    first = ff.fit(ff.read_test(path, toml), **law)
    again = next(one.candidate for one in ff.plan(first).outcomes if one.candidate.repeat)
    rig = folder / "heel-rig.toml"
    rig.write_text(f'[machine]\nrate = "{again.rate} 1/s"\nstrain = "{again.strain}"\ncycles = 5\n')
    plan = ff.plan(first, rig=rig)
    print(plan)
    five = next(one for one in plan.outcomes if one.candidate.cycles == 5)
    obtained = ff.fit(ff.read_test(path, toml, cycles=(1, 5)), **law)
    for name, found in five.expected.items():
        one = first.parameters[name]
        yield row("shoe foam", name, "cycle 1", *shares(one), one.state)
        yield row(
            "shoe foam", name, "expected with five cycles", found.share, math.nan, found.state
        )
        one = obtained.parameters[name]
        yield row("shoe foam", name, "obtained from cycles 1 to 5", *shares(one), one.state)


def row(foam: str, name: str, what: str, half: float, open_: float, state: str) -> Row:
    """Return one row of the table; shares in %."""
    return {"foam": foam, "parameter": name, "tests": what, "95 % interval (±%)": 100.0 * half,
            "range (±%)": 100.0 * open_, "state": state}  # fmt: skip


def main() -> None:
    """Run the study."""
    out = studies.arguments(__doc__, HERE).parse_args().out
    data = studies.measurements("mycelium-rates", "shoe-foam-twins")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rows = [*relaxation(data / "mycelium-rates", folder),
                *cycles(data / "shoe-foam-twins", folder)]  # fmt: skip
    table = pd.DataFrame(rows)
    table.to_csv(out / "real.csv", index=False, float_format="%.3g")
    print(table.to_string(index=False))


if __name__ == "__main__":
    studies.run(main, HERE)
