"""Does one Runge-Kutta stepper for every law do what the present solver does, as fast?

Method. Both run in one process, in turns, as a fit runs them: a prepared scene, base stress and
displacement of the top at all samples, with and without derivatives. Errors are the largest over
range against the judge of the stability study (`independent.py`), those of derivatives against the
present solver at rtol 1e-12. For an asked error each solver gets its loosest setting that reaches
it (half powers of 10), and the time is the best of many repeats; "rtol = 1e-6" is the setting of a fit.
Compile times are processor seconds of fresh processes without a cache.

    python experiments/stepper/spike.py            # the table: about 2 minutes
    python experiments/stepper/spike.py --compile  # compile times: about 3 minutes
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

import foamfit as ff

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "error_vs_runtime"), str(HERE.parent / "stability")]
import cases
import independent

ROUNDS, SHORTEST = 15, 2e-3  # turns of each competitor; s, shorter runs are timed together
SETTINGS = [10.0 ** (-0.5 * k) for k in range(4, 27)]
ASKED = (1e-6, 1e-9)
Array = np.ndarray
Answer = tuple[Array, Array]


def answer_of(out: object) -> Answer:
    """Return base stress and displacement (1 + p, n) of a run of either solver."""
    if isinstance(out, np.ndarray):
        return (out, out[:0]) if out.ndim == 2 else (out[:, 0], out[:, 1])
    stress, top = out.base_stress[None, :], out.displacement[-1:]
    if out.slopes is not None:
        stress = np.vstack([stress, out.slopes.base_stress])
        top = np.vstack([top, out.slopes.displacement[:, -1]])
    return stress, top


def error(found: Answer, truth: Answer) -> float:
    """Return the largest error over range of base stress and displacement."""
    pairs = [(a[0], b[0]) for a, b in zip(found, truth, strict=True) if len(a) and len(b)]
    return max(float(np.abs(a - b).max() / np.ptp(b)) for a, b in pairs)


def slope_error(found: Answer, truth: Answer) -> float:
    """Return the largest error of derivatives over the largest value of each."""
    worst = 0.0
    for a, b in zip(found, truth, strict=True):
        for one, other in zip(a[1:], b[1:], strict=False):
            size = np.abs(other).max()
            if size > 0.0:
                worst = max(worst, float(np.abs(one - other).max() / size))
    return worst


def loosest(run: Callable[[float], object], truth: Answer, asked: float) -> tuple[float, float]:
    """Return the loosest setting whose error is below the one asked, and its error."""
    for setting in SETTINGS:
        try:
            miss = error(answer_of(run(setting)), truth)
        except (ff.SimulationError, AssertionError, ZeroDivisionError):
            continue
        if miss <= asked:
            return setting, miss
    return np.nan, np.nan


def take_turns(runs: list[Callable[[], object]]) -> list[float]:
    """Return the best processor time of each, s, taken in turns."""
    best, counts = [np.inf] * len(runs), []
    for run in runs:
        run()
        began = time.process_time_ns()
        run()
        counts.append(max(1, round(SHORTEST / max(1e-9 * (time.process_time_ns() - began), 1e-6))))
    for _ in range(ROUNDS):
        for k, run in enumerate(runs):
            began = time.process_time_ns()
            for _ in range(counts[k]):
                run()
            best[k] = min(best[k], 1e-9 * (time.process_time_ns() - began) / counts[k])
    return best


def measure(scene: cases.Scene) -> list[dict[str, object]]:
    """Return the rows of a scene."""
    truth = independent.follow(scene.chain, scene.drive, scene.time, most=10**8)
    assert not truth.why, truth.why
    moved = isinstance(scene.drive, ff.DisplacementDrive)
    true = truth.base_stress[None, :], truth.displacement[-1:][: 0 if moved else 1]
    rows, slopes = [], answer_of(cases.present(scene, True)(1e-12))
    for derive in (False, True):
        old, new = cases.present(scene, derive), cases.stepped(scene, derive)
        pairs = [
            (f"{asked:.0e}", loosest(old, true, asked)[0], loosest(new, true, asked)[0])
            for asked in ASKED
        ]
        pairs.append(("rtol = 1e-6", 1e-6, 1e-6))
        for asked, mine, other in pairs:
            runs = [lambda s=mine: old(s), lambda s=other: new(s)]
            if not derive:
                runs.append(
                    lambda s=mine: ff.simulate(scene.chain, scene.drive, scene.time, max(s, 1e-13))
                )
            times = take_turns(runs)
            found = answer_of(old(mine)), answer_of(new(other))
            rows.append({
                "scene": scene.name, "derivatives": len(scene.names) if derive else 0, "asked": asked,
                "present setting": mine, "stepper setting": other,
                "present µs": 1e6 * times[0], "stepper µs": 1e6 * times[1],
                "ratio": times[1] / times[0], "simulate µs": np.nan if derive else 1e6 * times[2],
                "present error": error(found[0], true), "stepper error": error(found[1], true),
                "present slope error": slope_error(found[0], slopes) if derive else np.nan,
                "stepper slope error": slope_error(found[1], slopes) if derive else np.nan,
            })  # fmt: skip
    return rows


COMPILED = """
import os, resource, sys, time
sys.path[:0] = {path!r}
def spent():
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in both)
import numba, numpy, pandas, foamfit, scipy.integrate
began = spent()
if {which!r} == "stepped":
    import contract
    from laws import {law}
laws = spent() - began
import cases
scene = [one for one in cases.scenes() if one.name == {name!r}][0]
loaded = spent()
run = cases.{which}(scene, True)
run(1e-6)
print("%.1f s" % (spent() - loaded + laws), "of it the law %.1f s" % laws)
"""


def compile_times() -> None:
    """Print processor seconds of the first run in fresh processes, after the imports."""
    names = (
        "one spring, impact",
        "two springs, zero-mass node, one dashpot, impact",
        "microscale, relaxation, impact",
        "microscale, relaxation, motion",
    )
    for name in names:
        for which in ("present", "stepped"):
            with tempfile.TemporaryDirectory() as folder:
                law = "microscale" if "micro" in name else "bistable"
                code = COMPILED.format(path=sys.path[:4], name=name, which=which, law=law)
                env = os.environ | {"NUMBA_CACHE_DIR": folder, "FOAMFIT_CACHE_DIR": folder}
                began = time.perf_counter()
                out = subprocess.run(
                    [sys.executable, "-c", code], env=env, capture_output=True, text=True
                )
                print(
                    name,
                    which,
                    out.stdout.strip(),
                    f"wall {time.perf_counter() - began:.1f} s",
                    out.stderr.strip()[-300:],
                )


def main() -> None:
    if "--compile" in sys.argv:
        compile_times()
        return
    wanted, rows = [one for one in sys.argv[1:] if not one.startswith("-")], []
    for scene in cases.scenes():
        if wanted and not any(part in scene.name for part in wanted):
            continue
        rows += measure(scene)
        table = pd.DataFrame(rows)
        print(
            table.tail(6).to_string(float_format=lambda x: f"{x:.3g}", header=len(rows) == 6),
            flush=True,
        )
    if not wanted:
        table.to_csv(HERE / "spike.csv", index=False, float_format="%.4g")


if __name__ == "__main__":
    main()
