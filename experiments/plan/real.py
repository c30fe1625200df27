"""What does the plan promise on real records, and what did the further tests determine?

Method and answer: README.md. Written: real.csv; plan.py then writes the page.

    FOAMFIT_DATA=… python experiments/plan/real.py
"""

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies

HERE = Path(__file__).parent
RATES = {"2s": 1.0, "4s": 0.5, "80s": 0.025}  # 1/s
HEEL = "new-heel-comp-1"
Row = dict[str, Any]


def row(foam: str, name: str, what: str, one: Any) -> Row:
    """Return the row of a fitted or expected parameter: half its 95 % interval, half its range."""
    if hasattr(one, "share"):  # expected
        half, open_ = one.share, math.nan
    else:
        size, unknown = abs(one.value) or math.nan, (math.nan, math.nan)
        low, high = one.ci95 or unknown
        least, most = one.range or unknown
        half, open_ = 0.5 * (high - low) / size, 0.5 * (most - least) / size
    return {"foam": foam, "parameter": name, "tests": what, "95 % interval (±%)": 100.0 * half,
            "range (±%)": 100.0 * open_, "state": one.state}  # fmt: skip


def relaxation(folder: Path) -> Iterator[Row]:
    """Yield rows on the relaxation of the mycelium."""
    paths = {rate: records.place(f"outplane-{rate}-1", folder) for rate in RATES}
    rig = folder / "rig.toml"
    rig.write_text('[machine]\nrate = "0.025 to 1 1/s"\nstrain = "0.5"\ncycles = 1\n')
    first = ff.fit(ff.read_test(paths["2s"]), model="microscale", relaxation=1)
    plan = ff.plan(first, rig=rig)
    print(plan)
    for name in ("s1_g1", "s1_tau1"):
        yield row("mycelium", name, "2 s per cycle, alone", first.parameters[name])
        for one in plan.outcomes:
            if not (one.candidate.hold or one.candidate.repeat):
                what = f"expected with a test at {one.candidate.rate:.3g} 1/s"
                yield row("mycelium", name, what, one.expected[name])
    for rate in ("4s", "80s"):
        study = studies.write_study(
            folder / f"{rate}.toml", [paths["2s"].name, paths[rate].name], "microscale",
            {"g1": "shared", "tau1": "shared"}, name=rate, relaxation=1,
        )  # fmt: skip
        joint = ff.joint(study)
        alone = ff.fit(ff.read_test(paths[rate]), model="microscale", relaxation=1)
        test = f"test at {RATES[rate]:g} 1/s"
        for name in ("s1_g1", "s1_tau1"):
            what = f"obtained with a {test} (joint fit)"
            yield row("mycelium", name, what, joint.parameters[name])
            yield row("mycelium", name, f"the {test} alone", alone.parameters[name])


def cycles(folder: Path) -> Iterator[Row]:
    """Yield rows on the cycles of a shoe foam."""
    path = records.place(HEEL, folder)
    law = {"model": "microscale", "relaxation": 1, "mullins": True}
    first = ff.fit(ff.read_test(path), **law)
    again = next(one.candidate for one in ff.plan(first).outcomes if one.candidate.repeat)
    rig = folder / "heel-rig.toml"
    rig.write_text(f'[machine]\nrate = "{again.rate} 1/s"\nstrain = "{again.strain}"\ncycles = 5\n')
    plan = ff.plan(first, rig=rig)
    print(plan)
    five = next(one for one in plan.outcomes if one.candidate.cycles == 5)
    later = ff.fit(ff.read_test(path, cycles=(1, 5)), **law)
    for name, found in five.expected.items():
        yield row("shoe foam", name, "cycle 1", first.parameters[name])
        yield row("shoe foam", name, "expected with five cycles", found)
        yield row("shoe foam", name, "obtained from cycles 1 to 5", later.parameters[name])


def main() -> None:
    """Run the study."""
    out = studies.arguments(__doc__, HERE).parse_args().out
    studies.measurements("mycelium-rates", "shoe-foam-twins")
    with studies.workplace() as folder:
        rows = [*relaxation(folder), *cycles(folder)]
    studies.write_csv(rows, out / "real.csv", 3)
    print(pd.DataFrame(rows).to_string(index=False))


if __name__ == "__main__":
    main()
