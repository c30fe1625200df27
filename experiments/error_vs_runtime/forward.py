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

import gc
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
import rivals
from rivals import HEYOKA, KERNEL, PUBLIC, SCIPY, Scene

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLACK, BLUE, GREEN, ORANGE, SKY, VERMILION

HERE = Path(__file__).parent
WANTED = 2e-6  # the error at which solvers are compared
ROUNDS = 40
SHORTEST = 2e-3  # s; shorter runs are timed in groups
BRIEF = 1e-2  # s; shorter runs are preceded by an untimed run
SLOW = 1.0  # s; longer runs are made once
FLOOR = 1e-16  # a zero error is drawn here
TIMES = ["median (s)", "lower quartile (s)", "upper quartile (s)"]
# Markers also distinguish solvers, besides colours.
SOLVERS: dict[str, dict[str, Any]] = {
    PUBLIC: {"color": BLUE, "marker": "o", "linewidth": 1.6},
    KERNEL: {"color": VERMILION, "marker": "D", "linewidth": 1.6},
    HEYOKA: {"color": GREEN, "marker": "*", "markersize": 6},
    f"{SCIPY} DOP853": {"color": BLACK, "marker": "s"},
    f"{SCIPY} LSODA": {"color": SKY, "marker": "^"},
    f"{SCIPY} Radau": {"color": ORANGE, "marker": "v"},
}


@dataclass
class Timed:
    """A solver at one tolerance with its error, an approximate time, and its measured times."""

    solver: str
    tolerance: float
    run: Callable[[], rivals.Answer]
    error: float
    first: float
    times: list[float] = field(default_factory=list)

    @property
    def at_once(self) -> int:
        """Number of runs that are timed together."""
        return max(1, round(SHORTEST / self.first))

    def measure(self) -> None:
        """Time one run, or several short ones together."""
        if self.first < BRIEF:  # the previous run has displaced the caches
            self.run()
        self.times.append(seconds(self.run, self.at_once))

    def row(self) -> dict[str, Any]:
        """Return a row of the table."""
        quartiles = np.percentile(self.times or [self.first], [50, 25, 75])
        found = {"solver": self.solver, "setting": f"rtol = {self.tolerance:.0e}"}
        return found | {"error": self.error, **dict(zip(TIMES, quartiles, strict=True))}


def seconds(run: Callable[[], object], times: int = 1) -> float:
    """Return the processor time of a run, s."""
    began = time.process_time_ns()
    for _ in range(times):
        run()
    return 1e-9 * (time.process_time_ns() - began) / times


def measure(scene: Scene, budget: float) -> pd.DataFrame:
    """Return error and time of every solver in a scene at every tolerance."""
    truth, timed = rivals.reference(scene), list[Timed]()
    for solver, runs in rivals.solvers(scene).items():
        for tolerance, run in runs.items():
            try:
                answer = run()  # compiles
                first = seconds(run)
            except (RuntimeError, ff.SimulationError):  # unstable, or past a pole
                continue
            error = rivals.error(answer, truth)
            if error < 1.0:
                timed.append(Timed(solver, tolerance, run, error, first))
            if first > scene.longest:
                break
    take_turns(timed, budget)
    return pd.DataFrame([one.row() for one in timed])


def take_turns(timed: list[Timed], budget: float) -> None:
    """Time all solvers in turn, as often as each one's share of the budget (s) allows."""
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


# ---------------------------------------------------------------- figures and tables


def draw_scene(table: pd.DataFrame, title: str, path: Path) -> None:
    """Plot error over median time of every solver of a scene, with quartiles of time."""
    with studies.sheet(path, 5.6, 3.1) as figure:
        ax = figure.add_subplot()
        ax.axhline(WANTED, color="0.75", linewidth=0.8, zorder=0)
        for solver, look in SOLVERS.items():
            part = table[table["solver"] == solver]
            if len(part):
                middle, low, high = (part[name] for name in TIMES)
                look = {"linewidth": 1.0, "markersize": 4, **look}
                error = part["error"].clip(lower=FLOOR)
                spread = [middle - low, high - middle]
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


def compare(scene: Scene, table: pd.DataFrame) -> dict[str, object]:
    """Return one row of the summary: the fastest setting of each solver with an error < WANTED."""
    reached, row = table[table["error"] < WANTED], dict[str, object](scene=scene.title)
    columns = {"simulate": PUBLIC, "kernel": KERNEL, "SciPy": SCIPY, "heyoka": HEYOKA}
    for column, family in columns.items():
        part = reached[reached["solver"].str.startswith(family)]
        row[f"{column} (s)"] = part[TIMES[0]].min()
    for name in ("simulate", "kernel"):
        row[f"SciPy / {name}"] = row["SciPy (s)"] / row[f"{name} (s)"]
    return row


def main() -> None:
    """Measure and draw the scenes; write the page if all were asked for."""
    parser = studies.arguments(__doc__, HERE, budget=(6.0, "seconds of turns a scene"))
    parser.add_argument("scenes", nargs="*", help="names; left out = all, and the page")
    options = parser.parse_args()
    folder, wanted = options.out / "forward", rivals.scenes()
    if options.scenes:
        wanted = [scene for scene in wanted if scene.name in options.scenes]
    folder.mkdir(parents=True, exist_ok=True)
    rows, figures = [], []
    for scene in wanted:
        print(scene.name, file=sys.stderr)
        table = measure(scene, options.budget)
        studies.write_csv(table, folder / f"{scene.name}.csv")
        draw_scene(table, scene.title, folder / f"{scene.name}.png")
        figures.append(f"![Error against run time: {scene.title}](forward/{scene.name}.png)")
        rows.append(compare(scene, table))
    if options.scenes:
        print(studies.shown(pd.DataFrame(rows)))
        return
    summary = pd.DataFrame(rows)
    studies.write_csv(summary, folder / "summary.csv")
    optional = [HEYOKA] if find_spec(HEYOKA) else []
    studies.write_page(
        HERE, options.out, wanted=f"{WANTED:g}", table=studies.shown(summary),
        where=studies.circumstances("NumPy", "SciPy", "numba", "foamfit", *optional),
        figures="\n\n".join(figures),
    )  # fmt: skip


if __name__ == "__main__":
    main()
