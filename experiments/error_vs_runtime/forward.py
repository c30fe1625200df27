"""How much time does a simulation of given accuracy take? Error against run time, by scene.

Method and answer: README.md. All solvers of a scene alternate in one process, and processor time is
measured, so that a busy machine affects all of them equally; ratios compare medians of one run. A
table and a figure per scene and summary.csv go to `forward/`.

    python experiments/error_vs_runtime/forward.py                      # all: about 5 minutes
    python experiments/error_vs_runtime/forward.py one_spring_impact    # some scenes, no page
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # processor time of one thread

import contextlib
import gc
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
import rivals as kinds
from rivals import KERNEL, PUBLIC, Competitor, Scene

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLUE, GREEN, ORANGE, SKY, VERMILION

HERE = Path(__file__).parent
WANTED = 2e-6  # the error at which solvers are compared
ROUNDS = 40
SHORTEST = 2e-3  # s; shorter runs are timed in groups
BRIEF = 1e-2  # s; shorter runs are preceded by an untimed run
SLOW = 1.0  # s; longer runs are made once
FLOOR = 1e-16  # a zero error is drawn here
# Markers also distinguish solvers, besides colours.
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
    """A competitor with its error and run times."""

    competitor: Competitor
    error: float
    first: float
    times: list[float] = field(default_factory=list)
    runs: int = 0

    @property
    def at_once(self) -> int:
        """Number of runs that are timed together."""
        return max(1, round(SHORTEST / self.first))

    def measure(self) -> None:
        """Time one run, or several short ones together."""
        if self.first < BRIEF:  # the previous run has displaced the caches
            self.competitor.run()
        self.times.append(seconds(self.competitor.run, self.at_once))
        self.runs += self.at_once


def seconds(run: Callable[[], object], times: int = 1) -> float:
    """Return the processor time of a run, s."""
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
    """Return error and approximate time; None if the run fails (unstable, or past a pole)."""
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
    """Run every kind of solver once, so that later runs do not compile."""
    for scene in kinds.scenes():
        many = scene.name.startswith("1000")  # only foamfit is fast here
        for ladder in (kinds.own(scene) | ({} if many else kinds.others(scene))).values():
            with contextlib.suppress(RuntimeError, ff.SimulationError):
                ladder[0].run()


def _take_turns(timed: list[Timed], budget: float) -> None:
    """Time all competitors in turn, as often as each one's share of the budget (s) allows."""
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


# ---------------------------------------------------------------- figures


def draw_scene(table: pd.DataFrame, title: str, path: Path) -> None:
    """Plot error over median time of every solver of a scene, with quartiles of time."""
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
    """Return the fastest setting of a family (name prefix) with an error below WANTED."""
    part = table[table["solver"].str.startswith(family) & (table["error"] < WANTED)]
    return part.loc[part["median (s)"].idxmin()] if len(part) else None


def compare(scene: Scene, table: pd.DataFrame) -> dict[str, object]:
    """Return one row of the summary: foamfit against the best other solvers at WANTED."""
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


def main() -> None:
    """Measure and draw the scenes; write the page if all were asked for."""
    parser = studies.arguments(__doc__, HERE, budget=(6.0, "seconds of turns a scene"))
    parser.add_argument("scenes", nargs="*", help="names; left out = all, and the page")
    options = parser.parse_args()
    folder = options.out / "forward"
    folder.mkdir(parents=True, exist_ok=True)
    compile_all()
    rows, figures = [], []
    for scene in kinds.scenes():
        if options.scenes and scene.name not in options.scenes:
            continue
        table = measure(scene, options.budget)
        studies.write_csv(table, folder / f"{scene.name}.csv")
        draw_scene(table, scene.title, folder / f"{scene.name}.png")
        figures.append(f"![Error against run time: {scene.title}](forward/{scene.name}.png)")
        rows.append(compare(scene, table))
        ratios = (f"{name} {rows[-1][f'SciPy / {name}']:.3g}" for name in ("simulate", "kernel"))
        print(scene.name, "SciPy over", *ratios, file=sys.stderr)
    if options.scenes:
        return
    studies.write_csv(rows, folder / "summary.csv")
    studies.write_page(
        HERE, options.out, wanted=f"{WANTED:g}", table=studies.shown(pd.DataFrame(rows)),
        where=studies.circumstances("NumPy", "SciPy", "numba", "foamfit"),
        figures="\n\n".join(figures),
    )  # fmt: skip


if __name__ == "__main__":
    main()
