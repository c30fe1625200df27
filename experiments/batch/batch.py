"""What is the overhead of `foamfit batch`? Speed-up, overhead per test, memory.

Method and answer: README.md, whose numbers are in batch.json.

    python experiments/batch/batch.py               # all, some 15 minutes on two idle cores
    python experiments/batch/batch.py speedup       # one of them; see MEASURES
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import foamfit as ff
from foamfit.study import batch as study
from foamfit.study.batch import Recipe, Task, fingerprint, stored, work

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies

HERE = Path(__file__).parent
TESTS, TINY, MANY = 24, 200, 1000
HEIGHT, AREA = 1.19e-3, 1.9635e-5
TOML = (
    '[specimen]\nheight = "1.19 mm"\narea = "19.635 mm^2"\n'
    '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n'
)
COMMAND = [sys.executable, "-m", "foamfit", "batch"]


def make_tests(folder: Path, count: int, samples: int, linear: bool = False) -> None:
    """Write synthetic tests and their common TOML."""
    folder.mkdir()
    spring = ff.LinearSpring(8e6) if linear else ff.published["foam-1/model-1"].bistable
    chain = ff.Chain([spring], [HEIGHT], AREA)
    t = np.linspace(0.0, 0.75e-3, samples)
    response = ff.simulate(chain, ff.Impact(7e-3, 2.0), t)
    curves = response.base_stress, response.displacement[-1]
    rng = np.random.default_rng(0)
    for i in range(count):
        s, u = (c + 0.01 * np.ptp(c) * rng.standard_normal(samples) for c in curves)
        columns = {"time": t.round(9), "stress": s.round(), "displacement": u.round(9)}
        studies.write_test(folder / f"t{i:05d}.csv", **columns)
    (folder.parent / "foam.toml").write_text(TOML)


def watched(
    place: Path, *words: object, note: Callable[[Any], None] = lambda _: None
) -> dict[str, float]:
    """Run the command; return wall time, and processor times of the start and of all processes.

    The start is the command itself and the process that forks the others. `note` is called with the
    process of the command, ten times a second.
    """
    import psutil

    began, cpu = time.perf_counter(), dict[int, tuple[bool, float]]()
    command = [*COMMAND, "tests", "--specimen", "foam.toml", "--quiet", *map(str, words)]
    with subprocess.Popen(command, cwd=place) as process:
        whole = psutil.Process(process.pid)
        while process.poll() is None:
            time.sleep(0.1)
            with contextlib.suppress(psutil.Error, OSError):
                first = {whole.pid, *(child.pid for child in whole.children())}
                for one in (whole, *whole.children(recursive=True)):
                    times = one.cpu_times()
                    cpu[one.pid] = one.pid in first, times.user + times.system
                note(whole)
    return {
        "wall_s": time.perf_counter() - began,
        "start_cpu_s": sum(used for is_first, used in cpu.values() if is_first),
        "all_cpu_s": sum(used for _, used in cpu.values()),
    }


def measure_speedup(place: Path, *words: str) -> dict[str, Any]:
    """Compare one process with two, and check that the numbers agree."""
    make_tests(place / "tests", TESTS, 601)
    took, values = {}, {}
    for jobs in (1, 2):
        out = place / f"out-{jobs}"
        took[jobs] = watched(place, "--jobs", jobs, "--out", out.name, *words)
        values[jobs] = [file.read_bytes() for file in sorted(out.glob("*/parameters.csv"))]
    return {
        "tests": TESTS, "one": took[1], "two": took[2],
        "share of ideal (clock)": took[1]["wall_s"] / (2.0 * took[2]["wall_s"]),
        "same numbers": values[1] == values[2] and len(values[1]) == TESTS,
    }  # fmt: skip


def task(path: Path, recipe: Recipe, out: Path) -> Task:
    """Return a test as the command hands it to a process."""
    toml = path.parent.with_name("foam.toml")
    return Task(path.stem, path, toml, recipe, fingerprint(recipe, path, toml), out)


def measure_overhead(place: Path) -> dict[str, Any]:
    """Measure the overhead per test (read, compare, write) and the complete command."""
    make_tests(place / "tests", TINY, 601)
    recipe = Recipe("bistable", {"starts": 1, "intervals": "local"}, pages=False)
    fits, real = list[float](), study.fit

    def fit(*words: Any, **options: Any) -> Any:
        result, seconds = studies.timed(real, *words, **options)
        fits.append(seconds)
        return result

    def whole(path: Path) -> None:
        work(task(path, recipe, place / "out" / path.stem))

    with patch.object(study, "fit", fit):
        every = [studies.timed(whole, path)[1] for path in sorted((place / "tests").iterdir())]
    mean = [1e3 * float(np.mean(each[20:])) for each in (fits, every)]  # then all is loaded
    return {"tests": TINY - 20, "fit_ms": mean[0], "beside_ms": mean[1] - mean[0]}


def measure_memory(place: Path) -> dict[str, Any]:
    """Measure the resident memory of the processes during a batch of many tests."""
    make_tests(place / "tests", MANY, 61, linear=True)
    words = ("--starts", 1, "--model", "linear", "--no-report", "--jobs", 2, "--out", "out")
    samples: list[tuple[int, float, float]] = []

    def note(whole: Any) -> None:
        below = [child.memory_info().rss / 2**20 for child in whole.children(recursive=True)]
        done, own = len(os.listdir(place / "out")), whole.memory_info().rss / 2**20
        samples.append((done, own, max(below, default=0.0)))

    watched(place, *words, note=note)
    at = {}
    for wanted in (100, 500, MANY - 20):
        done, main, worker = min(samples, key=lambda s, w=wanted: abs(s[0] - w))
        at[str(wanted)] = {"done": done, "command_MiB": main, "largest_process_MiB": worker}
    again = watched(place, *words)
    return {"tests": MANY, "after": at, "called again, nothing to do": again}


def measure_parts(place: Path) -> dict[str, Any]:
    """Measure the work of the coordinating process per test (ms) and the disk usage."""
    make_tests(place / "tests", 50, 601)
    paths, found = sorted((place / "tests").iterdir()), {}
    for name, pages in {"no report": False, "reports": True}.items():
        recipe = Recipe("bistable", {"starts": 1, "intervals": "local"}, pages=pages)
        first = task(paths[0], recipe, place / name)
        work(first)
        files = [path.stat().st_size for path in first.out.iterdir()]
        began = time.process_time()
        for path in paths:
            fingerprint(recipe, path, first.toml)
            stored(first)
        again = 1e3 * (time.process_time() - began) / len(paths)
        found[name] = {"files": len(files), "kB": sum(files) / 1e3, "again_ms": again}
    return found


MEASURES = {
    "speedup": lambda place: measure_speedup(place, "--no-report"),
    "speedup-reports": measure_speedup,
    "overhead": measure_overhead,
    "memory": measure_memory,
    "parts": measure_parts,
}


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
