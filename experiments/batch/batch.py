"""What is the overhead of `foamfit batch`? Time per test and memory.

Method and answer: README.md, whose numbers are in batch.json. The tests are copies of a
reconstruction of foam-1.

    python experiments/batch/batch.py               # both, some 10 minutes
    python experiments/batch/batch.py overhead      # one of them; see MEASURES
"""

import json
import os
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd

from foamfit.study import batch as study
from foamfit.study.batch import Recipe, Task, fingerprint, work

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies

HERE = Path(__file__).parent
TEST = HERE.parent / "foam-1" / "model-1-2.0mps-reconstruction.csv"
TINY, MANY = 200, 1000


def make_tests(folder: Path, count: int, linear: bool = False) -> None:
    """Copy the test, or a tenth of its rows with a linear force, and write the common TOML."""
    folder.mkdir()
    table = pd.read_csv(TEST, comment="#")
    if linear:
        table = table[::10].assign(**{"force (N)": 200.0 * table["displacement (mm)"].clip(0.0)})
    for i in range(count):
        table.to_csv(folder / f"t{i:05d}.csv", index=False)
    (folder.parent / "foam.toml").write_text(TEST.with_suffix(".toml").read_text())


def size_of(folder: Path) -> dict[str, float]:
    """Return number and size of the files of a result."""
    sizes = [path.stat().st_size for path in folder.iterdir()]
    return {"files": len(sizes), "kB": sum(sizes) / 1e3}


def measure_overhead(place: Path) -> dict[str, Any]:
    """Measure the overhead per test (read, compare, write), and the size of a result folder."""
    make_tests(place / "tests", TINY)
    recipe = Recipe("bistable", {"starts": 1, "intervals": "local"}, pages=False)
    fits, real, toml = list[float](), study.fit, place / "foam.toml"

    def fit(*words: Any, **options: Any) -> Any:
        result, seconds = studies.timed(real, *words, **options)
        fits.append(seconds)
        return result

    def whole(path: Path) -> None:
        key = fingerprint(recipe, path, toml)
        work(Task(path.stem, path, toml, recipe, key, place / "out" / path.stem))

    with patch.object(study, "fit", fit):
        every = [studies.timed(whole, path)[1] for path in sorted((place / "tests").iterdir())]
    mean = [1e3 * float(np.mean(each[20:])) for each in (fits, every)]  # then all is loaded
    found = {"tests": TINY - 20, "fit_ms": mean[0], "beside_ms": mean[1] - mean[0]}
    return found | size_of(place / "out" / "t00000")


def measure_memory(place: Path) -> dict[str, Any]:
    """Measure the memory of the largest process of a batch, and the time of a second run."""
    words = ("--starts", 1, "--model", "linear", "--drive", "displacement", "--no-report")
    command, found = [sys.executable, "-m", "foamfit", "batch", *words, "--quiet"], {}
    command += ["--jobs", 2, "--specimen", "foam.toml"]
    for count in (MANY // 10, MANY):
        make_tests(place / f"t{count}", count, linear=True)
        one = [*command, f"t{count}", "--out", f"out{count}"]
        found[f"peak_MiB_{count}"] = studies.run(one, cwd=place)[3]
    return found | {"again_cpu_s": studies.run(one, cwd=place)[2]}


MEASURES = {"overhead": measure_overhead, "memory": measure_memory}


def main() -> None:
    parser = studies.arguments(__doc__)
    parser.add_argument("measures", nargs="*", choices=[[], *MEASURES], help="all, if left out")
    kept = HERE / "batch.json"
    found = json.loads(kept.read_text())
    for name in parser.parse_args().measures or MEASURES:
        with studies.workplace() as place:
            found[name] = MEASURES[name](place) | {"load": os.getloadavg()[1]}
        print(name, json.dumps(found[name], indent=1), flush=True)
        kept.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
