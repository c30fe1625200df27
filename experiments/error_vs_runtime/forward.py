"""What does an answer cost? Error against run time of the simulation, scene by scene.

Method. For every scene of `scenes.py`: the error of the project's solver, of fixed-step schemes and
of three of SciPy's integrators against the judge of the stability study (`independent.py`, some 14
digits), over the median time of many runs. All solvers of a scene take turns in one process, and
processor time is counted, so that a busy machine disturbs all of them alike; ratios compare medians
of one run. A table (CSV, Markdown) and a figure per scene, the scaling with springs and samples,
and a summary go to `forward/`.

Answer. With an error below 2e-6 the project's solver takes 7 µs to 7 ms, SciPy 30 to 300 times as
long: see forward/summary.md.

    python experiments/error_vs_runtime/forward.py                      # all: about 5 minutes
    python experiments/error_vs_runtime/forward.py one_spring_impact    # some scenes, no summary
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # processor time is that of one thread

import contextlib
import gc
import platform
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scenes as kinds
from scenes import KERNEL, PUBLIC, Competitor, Scene

import foamfit as ff
from foamfit.solve.plan import plan

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLUE, GREEN, ORANGE, SKY, VERMILION
from unchanged import keep_unchanged

HERE = Path(__file__).parent
REFERENCE = "brute force at 1e-13 (experiments/stability/independent.py)"
WANTED = 2e-6  # the error at which solvers are compared
ROUNDS = 40
SHORTEST = 2e-4  # s: shorter runs are timed several at once
BRIEF = 1e-2  # s: shorter runs are preceded by one that is not timed
SLOW = 1.0  # s: longer runs are made once
FLOOR = 1e-16  # an error of zero is drawn there
# The mark tells solvers apart where colours do not.
SOLVERS: dict[str, dict[str, Any]] = {
    PUBLIC: {"color": BLUE, "marker": "o", "linewidth": 1.6},
    KERNEL: {"color": VERMILION, "marker": "D", "linewidth": 1.6},
    "SciPy DOP853": {"color": "black", "marker": "s"},
    "SciPy LSODA": {"color": SKY, "marker": "^"},
    "SciPy Radau": {"color": "#6b6b6b", "marker": "v"},
    "velocity Verlet": {"color": ORANGE, "marker": "x", "linestyle": "--"},
    "exponential recursion": {"color": ORANGE, "marker": "x", "linestyle": "--"},
    "Runge-Kutta 4": {"color": GREEN, "marker": "+", "linestyle": "--"},
}  # fmt: skip


@dataclass
class Timed:
    """A competitor that has run: its error and its times."""

    competitor: Competitor
    error: float
    first: float
    times: list[float] = field(default_factory=list)
    runs: int = 0

    @property
    def at_once(self) -> int:
        """Runs that are timed together."""
        return max(1, round(SHORTEST / self.first))

    def measure(self) -> None:
        """Time one run, or several short ones together."""
        if self.first < BRIEF:  # what ran before has taken the caches
            self.competitor.run()
        self.times.append(seconds(self.competitor.run, self.at_once))
        self.runs += self.at_once


def seconds(run: Callable[[], object], times: int = 1) -> float:
    """Processor time of a run, s."""
    began = time.process_time_ns()
    for _ in range(times):
        run()
    return 1e-9 * (time.process_time_ns() - began) / times


def measure(scene: Scene, budget: float) -> pd.DataFrame:
    """Return error and time of every competitor in a scene."""
    truth, timed = kinds.reference(scene), list[Timed]()
    for ladder in (kinds.own(scene) | kinds.others(scene)).values():
        for competitor in ladder:
            one = _first_run(competitor, truth)
            if one is not None:
                timed.append(one)
                if one.first > scene.longest:
                    break
    _take_turns(timed, budget)
    rows = [
        (one.competitor.family, one.competitor.setting, one.error,
         *np.percentile(one.times, [50, 25, 75]), one.runs)
        for one in timed
    ]  # fmt: skip
    times = ["median (s)", "lower quartile (s)", "upper quartile (s)"]
    return pd.DataFrame(rows, columns=["solver", "setting", "error", *times, "runs"])


def _first_run(competitor: Competitor, truth: kinds.Answer) -> Timed | None:
    """Error, and about how long it takes; None if it fails (unstable, or past a pole)."""
    answers: list[kinds.Answer] = []
    try:
        first = seconds(lambda: answers.append(competitor.run()))
        if first < SLOW:
            first = seconds(competitor.run)
    except (RuntimeError, ff.SimulationError):
        return None
    error = kinds.error(answers[0], truth)
    if not error < 1.0:
        return None
    one = Timed(competitor, error, first)
    if first >= SLOW:
        one.times, one.runs = [first], 1
    return one


def compile_all() -> None:
    """Run every kind of solver once: what is measured later is compiled."""
    for scene in kinds.scenes():
        if not scene.name.startswith("100"):
            for ladder in (kinds.own(scene) | kinds.others(scene)).values():
                with contextlib.suppress(RuntimeError, ff.SimulationError):
                    ladder[0].run()


def _take_turns(timed: list[Timed], budget: float) -> None:
    """Time all competitors in turns: each as often as its share of the budget (s) allows."""
    share = budget / len(timed)
    turns = [
        min(max(round(share / (one.first * one.at_once)), 3), ROUNDS) if one.first < SLOW else 0
        for one in timed
    ]
    gc.collect()
    gc.disable()
    for turn in range(ROUNDS):
        for one, count in zip(timed, turns, strict=True):
            if (turn + 1) * count // ROUNDS > turn * count // ROUNDS:
                one.measure()
    gc.enable()


# ---------------------------------------------------------------- scaling


def _impact(count: int, samples: int, velocity: float) -> Scene:
    t = np.linspace(0.0, kinds.LENGTH, samples)
    return Scene("", "", kinds.graded(count), ff.Impact(kinds.MASS, velocity), t)


def _driven(count: int, samples: int, by_stress: bool) -> Scene:
    t = np.linspace(0.0, kinds.LENGTH, samples)
    chain = kinds.graded(count)
    spring = kinds.MODEL_2.bistable
    stress = 1.1 * kinds.loop(spring, samples, True)  # past C1 of the hardest one
    drive: ff.StressDrive | ff.DisplacementDrive = ff.StressDrive(stress)
    if not by_stress:
        most = ff.simulate(chain, drive, t).displacement[-1].max()
        shape = kinds.loop(spring, samples, False)
        drive = ff.DisplacementDrive(most * shape / shape.max())
    return Scene("", "", chain, drive, t)


SCALED: dict[str, Callable[[int, int], Scene]] = {
    "stress drive": lambda n, samples: _driven(n, samples, True),
    "displacement drive": lambda n, samples: _driven(n, samples, False),
    "impact, no spring snaps": lambda n, samples: _impact(n, samples, 0.5),
    "impact, every spring snaps": lambda n, samples: _impact(n, samples, 2.2),
}


def scaling(longest: float) -> pd.DataFrame:
    """Time of the project's solver against springs (501 samples) and samples (one spring)."""
    springs = [(n, kinds.SAMPLES) for n in (1, 3, 10, 30, 100, 300, 1000)]
    samples = [(1, n) for n in (101, 316, 1001, 3162, 10001, 31623, 100001)]
    rows: list[dict[str, Any]] = []
    for drive, make in SCALED.items():
        for over, sizes in (("springs", springs), ("samples", samples)):
            for count, n in sizes:
                first, times, runs = _timed(make(count, n))
                rows += [
                    {"drive": drive, "over": over, "springs": count, "samples": n, "solver": solver,
                     "median (s)": np.median(one), "runs": runs}
                    for solver, one in times.items()
                ]  # fmt: skip
                if first >= longest:
                    break
    return pd.DataFrame(rows)


def _timed(scene: Scene) -> tuple[float, dict[str, list[float]], int]:
    """Time of a first run of a scene, the times of both ways to call the solver, and runs."""
    made = plan(scene.chain, scene.drive, scene.time)
    rows, heights = scene.chain.arrays.rows, scene.chain.arrays.heights
    runs: dict[str, Callable[[], object]] = {
        KERNEL: lambda: made.run(rows, heights, 1e-6, everything=False),
        PUBLIC: lambda: ff.simulate(scene.chain, scene.drive, scene.time),
    }
    first = seconds(runs[KERNEL])
    if first < 0.5:
        first = seconds(runs[KERNEL])
    at_once = max(1, round(SHORTEST / first))
    turns = min(max(round(0.1 / (first * at_once)), 3), 21) if first < 1.0 else 1
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(turns):
        for name, run in runs.items():
            times[name].append(seconds(run, at_once))
    return first, times, turns * at_once


def exponents(table: pd.DataFrame) -> pd.DataFrame:
    """Slopes of log time over log size: of a line through all sizes, and of the last decade."""
    rows = []
    for (drive, over, solver), part in table.groupby(["drive", "over", "solver"], sort=False):
        x, y = np.log10(part[over].to_numpy(float)), np.log10(part["median (s)"].to_numpy(float))
        last = x >= x[-1] - 1.01
        rows.append(
            {
                "drive": drive, "over": over, "from": part[over].iloc[0],
                "to": part[over].iloc[-1], "solver": solver,
                "exponent": np.polyfit(x, y, 1)[0],
                "exponent of the last decade": np.polyfit(x[last], y[last], 1)[0],
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def per_sample(table: pd.DataFrame) -> pd.DataFrame:
    """Time of the closed-form drives per sample and spring, ns."""
    part = table[table["drive"].isin(["stress drive", "displacement drive"])].copy()
    part["ns per sample and spring"] = 1e9 * part["median (s)"] / part["springs"] / part["samples"]
    large = (
        (part["springs"] >= 100)
        | (part["samples"] >= 10000)
        | ((part["springs"] == 1) & (part["samples"] == kinds.SAMPLES))
    )
    return part[large][["drive", "springs", "samples", "solver", "ns per sample and spring"]]


# ---------------------------------------------------------------- figures


def draw_scene(table: pd.DataFrame, title: str, path: Path) -> None:
    """Error over median time of every solver of a scene; a bar spans the quartiles of time."""
    with studies.sheet(path, 5.2, 3.1) as figure:
        ax = figure.add_subplot()
        ax.axhline(WANTED, color="0.75", linewidth=0.8, zorder=0)
        for solver, look in SOLVERS.items():
            part = table[table["solver"] == solver]
            if len(part):
                middle = part["median (s)"]
                spread = [middle - part["lower quartile (s)"], part["upper quartile (s)"] - middle]
                look = {"linewidth": 1.0, "markersize": 4, **look}
                error = part["error"].clip(lower=FLOOR)
                ax.errorbar(middle, error, xerr=spread, elinewidth=0.6, label=solver, **look)
        ax.set(xscale="log", yscale="log", xlabel="processor time of one run (s)")
        ax.set(ylim=(FLOOR / 3, 1.0), yticks=[10.0**k for k in range(-16, 1, 2)])
        ax.set_ylabel("largest error over range (–)")
        studies.gridlines(ax)
        figure.suptitle(textwrap.fill(title, 60), fontsize=8)
        ax.annotate(
            f"{WANTED:.0e}".replace("e-0", "e-"), (ax.get_xlim()[1], WANTED), (-2, 2), color="0.5",
            ha="right", textcoords="offset points", fontsize=6.5,
        )  # fmt: skip
        figure.legend(loc="outside right center")


# ---------------------------------------------------------------- tables


def cheapest(table: pd.DataFrame, family: str) -> pd.Series | None:
    """The fastest setting of a family (the start of its name) with an error below WANTED."""
    part = table[table["solver"].str.startswith(family) & (table["error"] < WANTED)]
    return part.loc[part["median (s)"].idxmin()] if len(part) else None


def compare(scene: Scene, table: pd.DataFrame) -> dict[str, object]:
    """One row of the summary: the project against the best of the others at WANTED."""
    fixed = table[~table["solver"].str.startswith(("foamfit", "SciPy"))]
    best = {
        "simulate": cheapest(table, PUBLIC),
        "kernel": cheapest(table, KERNEL),
        "SciPy": cheapest(table, "SciPy"),
        "fixed step": cheapest(fixed, ""),
    }
    row: dict[str, object] = {"scene": scene.title}
    for name, item in best.items():
        row[f"{name} (s)"] = np.nan if item is None else item["median (s)"]
        if name in ("SciPy", "fixed step"):
            how = "none reaches it" if item is None else f"{item['solver']}, {item['setting']}"
            row[f"best {name}"] = how.removeprefix("SciPy ")
    for other in ("SciPy", "fixed step"):
        for name in ("simulate", "kernel"):
            row[f"{other} / {name}"] = row[f"{other} (s)"] / row[f"{name} (s)"]
    return row


def write(table: pd.DataFrame, path: Path, heading: list[str]) -> pd.DataFrame:
    """Write a table as CSV (comments first) and as Markdown; return what is kept.

    That is the older table where times are much the same, so that figure and summary are, too.
    """
    written, page = path.with_suffix(".csv"), path.with_suffix(".md")
    with keep_unchanged(written), written.open("w") as file:
        file.writelines(f"# {line}\n" for line in heading)
        table.to_csv(file, index=False, float_format="%.4g")
    kept = pd.read_csv(written, skiprows=len(heading))
    title, *others = heading
    page.write_text(f"# {title}\n\n" + "\n".join(others) + f"\n\n{studies.shown(kept)}\n")
    return kept


def main() -> None:
    parser = studies.arguments(__doc__, HERE / "forward", budget=(6.0, "seconds of turns a scene"))
    parser.add_argument("scenes", nargs="*", help="names; left out = all, and the summary")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    names = studies.versions("numpy", "scipy", "numba", "foamfit")
    spelled = zip(("Python", "NumPy", "SciPy", "numba", "foamfit"), names.values(), strict=True)
    machine = f"{studies.processor()} ({platform.machine()}, {os.cpu_count()} cores)"
    where = f"{machine}; {', '.join(' '.join(one) for one in spelled)}"
    compile_all()
    rows = []
    for scene in kinds.scenes():
        if options.scenes and scene.name not in options.scenes:
            continue
        began = time.perf_counter()
        heading = [
            f"Error against run time: {scene.title}",
            f"{scene.time.size} samples. Error: largest over range, of displacement and base "
            f"stress, against {REFERENCE}. Processor time: median and quartiles.",
            where,
        ]
        table = write(measure(scene, options.budget), options.out / scene.name, heading)
        draw_scene(table, scene.title, options.out / f"{scene.name}.png")
        rows.append(compare(scene, table))
        told = (
            f"SciPy / {name} {rows[-1][f'SciPy / {name}']:.3g}" for name in ("simulate", "kernel")
        )
        print(scene.name, *told, f"({time.perf_counter() - began:.0f} s)", file=sys.stderr)
    if options.scenes:
        return
    heading = ["Run time against springs and samples", where]
    sizes = write(scaling(longest=4.0), options.out / "scaling", heading)
    summary = pd.DataFrame(rows)
    studies.write_csv(summary, options.out / "summary.csv")
    tables = {"table": summary, "sizes": per_sample(sizes), "exponents": exponents(sizes)}
    text = (HERE / "summary.template.md").read_text(encoding="utf-8").format(
        wanted=f"{WANTED:g}", where=where, samples=kinds.SAMPLES,
        **{name: studies.shown(one) for name, one in tables.items()},
    )  # fmt: skip
    (options.out / "summary.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    studies.run(main, HERE)
