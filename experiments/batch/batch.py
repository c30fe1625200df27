"""What is the overhead of `foamfit batch`? Speed-up, overhead per test, memory, an estimate.

Method. Synthetic impacts on one spring with 1 % noise are fitted by the command and by its parts.
Other work on the machine slows everything, so processor times are given with wall-clock times.

Answer. 26 ms of processor time per test, constant memory, the same numbers with any number of
processes. Results go to batch.json; README.md describes them.

    python experiments/batch/batch.py               # all, some 15 minutes on two idle cores python
    experiments/batch/batch.py speedup       # one of them; see MEASURES

"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.study.batch_work import Recipe, Task, fingerprint, put, stored, work

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

TESTS, TINY, MANY = 24, 200, 1000
HEIGHT, AREA = 1.19e-3, 1.9635e-5
TOML = (
    '[specimen]\nheight = "1.19 mm"\narea = "19.635 mm^2"\n'
    '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n'
)
COMMAND = [sys.executable, "-m", "foamfit", "batch"]
FAST = ["--starts", "1", "--no-report", "--quiet"]


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


def called(place: Path, *words: object) -> dict[str, float]:
    """Run the command; return wall time and processor times of start and busiest process.

    The start is the command itself and the process that forks the others.
    """
    import psutil

    began, cpu = time.perf_counter(), dict[int, tuple[bool, float]]()
    command = [*COMMAND, "tests", "--specimen", "foam.toml", *map(str, words)]
    with subprocess.Popen(command, cwd=place) as process:
        whole = psutil.Process(process.pid)
        while process.poll() is None:
            time.sleep(0.1)
            try:
                first = {whole.pid, *(child.pid for child in whole.children())}
                for one in (whole, *whole.children(recursive=True)):
                    times = one.cpu_times()
                    cpu[one.pid] = one.pid in first, times.user + times.system
            except psutil.Error:
                continue
    wall = time.perf_counter() - began
    workers = [used for is_first, used in cpu.values() if not is_first]
    return {
        "wall_s": wall,
        "start_cpu_s": sum(used for is_first, used in cpu.values() if is_first),
        "busiest_cpu_s": max(workers, default=0.0),
        "all_cpu_s": sum(used for _, used in cpu.values()),
    }


def measure_speedup(place: Path, *words: str) -> dict[str, Any]:
    """Compare one process with two, and check that the numbers agree.

    On a busy machine wall time means little. The processor time of start plus busiest process is
    the critical path of a batch.
    """
    make_tests(place / "tests", TESTS, 601)
    took = {}
    for jobs in (1, 2):
        took[jobs] = called(place, "--jobs", jobs, "--quiet", "--out", f"out-{jobs}", *words)
    one, two = (
        [p.read_bytes() for p in sorted((place / f"out-{j}").glob("*/parameters.csv"))]
        for j in (1, 2)
    )
    way = {jobs: took[jobs]["start_cpu_s"] + took[jobs]["busiest_cpu_s"] for jobs in took}
    return {
        "tests": TESTS,
        "one": took[1],
        "two": took[2],
        "share of ideal (clock)": took[1]["wall_s"] / (2.0 * took[2]["wall_s"]),
        "share of ideal (processor time of the longest way)": way[1] / (2.0 * way[2]),
        "same numbers": one == two and len(one) == TESTS,
    }


def measure_overhead(place: Path) -> dict[str, Any]:
    """Measure the overhead per test (read, compare, write) and the complete command."""
    make_tests(place / "tests", TINY, 601)
    recipe = Recipe("bistable", {"starts": 1, "intervals": "local"}, pages=False)
    key, spent = recipe.key, [0.0, 0.0]
    from foamfit.study import batch_work

    real: Callable[..., Any] = batch_work.fit

    def fit(*words: Any, **options: Any) -> Any:
        began = time.process_time()
        try:
            return real(*words, **options)
        finally:
            spent[1] += time.process_time() - began

    batch_work.fit = fit
    toml = place / "foam.toml"
    for i, path in enumerate(sorted((place / "tests").iterdir())):
        if i == 20:  # everything is loaded
            spent[:] = [0.0, 0.0]
        began = time.process_time()
        mark = fingerprint(key, path.read_bytes(), toml.read_bytes(), None)
        work(Task(path.stem, path, toml, recipe, mark, place / "out" / path.stem))
        spent[0] += time.process_time() - began
    batch_work.fit = real
    count = TINY - 20
    out = called(place, *FAST, "--jobs", "1", "--out", "whole")
    return {
        "tests": count,
        "fit_ms": 1e3 * spent[1] / count,
        "beside_ms": 1e3 * (spent[0] - spent[1]) / count,
        "whole command, beside its fits, per test, start included (clock, ms)": 1e3
        * (out["wall_s"] - pd.read_csv(place / "whole" / "summary.csv")["runtime_s"].sum())
        / TINY,
    }


def measure_memory(place: Path) -> dict[str, Any]:
    """Measure the resident memory of the processes during a batch of many tests."""
    import psutil

    make_tests(place / "tests", MANY, 61, linear=True)
    quick = ["--starts", "1", "--model", "linear", "--no-report", "--quiet", "--jobs", "2"]
    command = [*COMMAND, "tests", "--specimen", "foam.toml", *quick, "--out", "out"]
    samples: list[tuple[int, float, float]] = []
    with subprocess.Popen(command, cwd=place) as process:
        whole = psutil.Process(process.pid)
        while process.poll() is None:
            time.sleep(1.0)
            try:
                done = len(os.listdir(place / "out"))
                main = whole.memory_info().rss / 2**20
                below = (child.memory_info().rss for child in whole.children(recursive=True))
                samples.append((done, main, max(below, default=0.0) / 2**20))
            except (psutil.Error, OSError):
                continue
    at = {}
    for wanted in (100, 500, MANY - 20):
        done, main, worker = min(samples, key=lambda s, w=wanted: abs(s[0] - w))
        at[str(wanted)] = {"done": done, "command_MiB": main, "largest_process_MiB": worker}
    again = called(place, *quick, "--out", "out")
    return {"tests": MANY, "after": at, "called again, nothing to do": again}


def measure_parts(place: Path) -> dict[str, Any]:
    """Measure the work of the coordinating process per test (ms) and the disk usage."""
    make_tests(place / "tests", 50, 601)
    toml, paths = place / "foam.toml", sorted((place / "tests").iterdir())
    found: dict[str, Any] = {}
    for name, pages in {"no report": False, "reports": True}.items():
        recipe = Recipe("bistable", {"starts": 1, "intervals": "local"}, pages=pages)
        key, path = recipe.key, paths[0]
        mark = fingerprint(key, path.read_bytes(), toml.read_bytes(), None)
        content = path.read_bytes(), toml.read_bytes(), None
        outcome = work(Task(path.stem, path, toml, recipe, mark, None, content))
        assert outcome.files is not None
        out = place / name
        found[name] = {
            "files": len(outcome.files),
            "kB": sum(map(len, outcome.files.values())) / 1e3,
            "write_ms": timed(lambda i, f=outcome.files, o=out: put(f, o / f"t{i}"), 50),
            "again_ms": timed(
                lambda i, k=key, o=out, m=mark, r=recipe: (
                    fingerprint(k, paths[i].read_bytes(), toml.read_bytes(), None),
                    stored(o / f"t{i}", m, r),
                ),
                50,
            ),
        }
    return found


def timed(call: Callable[[int], Any], count: int) -> float:
    """Return the processor time of a call, ms."""
    began = time.process_time()
    for i in range(count):
        call(i)
    return 1e3 * (time.process_time() - began) / count


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
    wanted = parser.parse_args().measures or list(MEASURES)
    kept = HERE / "batch.json"
    found = json.loads(kept.read_text()) if kept.exists() else {}
    for name in wanted:
        place = Path(tempfile.mkdtemp(prefix="batch-"))
        try:
            found[name] = MEASURES[name](place) | {"load": os.getloadavg()[1]}
        finally:
            shutil.rmtree(place)
        print(name, json.dumps(found[name], indent=1), flush=True)
        kept.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
