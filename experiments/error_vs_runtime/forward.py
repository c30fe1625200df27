"""What does an answer cost? Error against run time of the simulation, scene by scene.

For every scene of `scenes.py`: the error of the project's solver, of three fixed-step schemes and
of three of SciPy's integrators against a reference of 12 digits, over the median time of many runs.
All solvers of a scene take turns in one process, and processor time is counted, so that a busy
machine disturbs all of them alike; ratios compare medians of one run. A table (CSV, Markdown) and a
figure per scene, the scaling with springs and samples, and a summary go to `forward/`.

    python experiments/error_vs_runtime/forward.py                      # all: about 5 minutes
    python experiments/error_vs_runtime/forward.py one_spring_impact    # some scenes, no summary
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # processor time is that of one thread

import argparse
import contextlib
import gc
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numba
import numpy as np
import pandas as pd
import scenes as kinds
import scipy
from drawing import draw_scaling, draw_scene
from scenes import KERNEL, PUBLIC, Competitor, Scene

import foamfit as ff
from foamfit.solve.plan import plan

HERE = Path(__file__).parent
REFERENCE = "brute force at 1e-13 (experiments/stability/independent.py)"
WANTED = 2e-6  # the error at which solvers are compared
ROUNDS = 40
SHORTEST = 2e-4  # s: shorter runs are timed several at once
BRIEF = 1e-2  # s: shorter runs are preceded by one that is not timed
SLOW = 1.0  # s: longer runs are made once


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
    truth = kinds.reference(scene)
    timed = []
    for ladder in (kinds.own(scene) | kinds.others(scene)).values():
        for competitor in ladder:
            one = _first_run(competitor, truth)
            if one is not None:
                timed.append(one)
                if one.first > scene.longest:
                    break
    _take_turns(timed, budget)
    rows = []
    for one in timed:
        low, middle, high = np.percentile(one.times, [25, 50, 75])
        rows.append(
            {
                "solver": one.competitor.family,
                "setting": one.competitor.setting,
                "error": one.error,
                "median (s)": middle,
                "lower quartile (s)": low,
                "upper quartile (s)": high,
                "runs": one.runs,
            }
        )
    return pd.DataFrame(rows)


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
    wanted = (
        "one_spring_stress",
        "one_spring_impact",
        "two_springs_impact",
        "10_springs_impact",
        "10_springs_mass_impact",
        "microscale_impact",
        "microscale_relaxation_displacement",
        "linear_microscale_relaxation_impact",
    )
    for scene in kinds.scenes():
        if scene.name in wanted:
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
    rows = []
    for drive, make in SCALED.items():
        for over, sizes in (("springs", springs), ("samples", samples)):
            for count, n in sizes:
                scene = make(count, n)
                if not _add_times(rows, scene, drive, over, longest):
                    break
    return pd.DataFrame(rows)


def _add_times(rows: list, scene: Scene, drive: str, over: str, longest: float) -> bool:
    """Add the median times of a scene to `rows`; false if the next size would take too long."""
    made = plan(scene.chain, scene.drive, scene.time)
    table = np.array([spring.row for spring in scene.chain.springs])
    heights = np.array(scene.chain.heights)
    runs = {
        KERNEL: lambda: made.run(table, heights, 1e-6, everything=False),
        PUBLIC: lambda: ff.simulate(scene.chain, scene.drive, scene.time),
    }
    first = seconds(runs[KERNEL])
    if first < 0.5:
        first = seconds(runs[KERNEL])
    at_once = max(1, round(SHORTEST / first))
    turns = min(max(round(0.1 / (first * at_once)), 3), 21) if first < 1.0 else 1
    times = {name: [] for name in runs}
    for _ in range(turns):
        for name, run in runs.items():
            times[name].append(seconds(run, at_once))
    for name in runs:
        rows.append(
            {
                "drive": drive, "over": over, "springs": heights.size, "samples": made.time.size,
                "solver": name, "median (s)": np.median(times[name]), "runs": turns * at_once,
            }
        )  # fmt: skip
    return first < longest


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


def circumstances() -> str:
    """Machine and versions."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":")[1].strip() if names else model
    return (
        f"{model} ({platform.machine()}, {os.cpu_count()} cores); Python "
        f"{platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}, numba "
        f"{numba.__version__}, foamfit {ff.__version__}"
    )


def markdown(table: pd.DataFrame) -> str:
    """A table of Markdown."""

    def cell(value: object) -> str:
        if isinstance(value, float):
            return "–" if np.isnan(value) else f"{value:.3g}"
        return str(value)

    head = "| " + " | ".join(table.columns) + " |\n" + "| --- " * len(table.columns) + "|\n"
    rows = table.astype(object).itertuples(index=False)
    return head + "".join("| " + " | ".join(map(cell, row)) + " |\n" for row in rows)


def write(table: pd.DataFrame, path: Path, heading: list[str]) -> pd.DataFrame:
    """Write a table as CSV (comments first) and as Markdown; return what is kept.

    That is the older table where times are much the same, so that figure and summary are, too.
    """
    written, page = path.with_suffix(".csv"), path.with_suffix(".md")
    with keep_unchanged(written), written.open("w") as file:
        file.writelines(f"# {line}\n" for line in heading)
        table.to_csv(file, index=False, float_format="%.4g")
    kept = pd.read_csv(written, skiprows=len(heading))
    page.write_text(f"# {heading[0]}\n\n" + "\n".join(heading[1:]) + "\n\n" + markdown(kept))
    return kept


def write_summary(
    rows: list[dict[str, object]], sizes: pd.DataFrame, where: str, out: Path
) -> None:
    """Write ratios, cost per sample and exponents to summary.md."""
    table = pd.DataFrame(rows)
    table.to_csv(out / "summary.csv", index=False, float_format="%.4g")
    text = (
        "# Error against run time: summary\n\n"
        f"Processor times of the fastest setting with an error below {WANTED:g} (of the range of "
        "displacement and base stress), medians of one run in which all took turns. The last "
        "columns are ratios: how often the project's solver answers while the best of the others "
        f"answers once.\n\n{where}\n\n{markdown(table)}\n"
        "## Closed-form drives\n\n" + markdown(per_sample(sizes)) + "\n"
        "## Cost against size\n\n"
        "Slope of log time over log size, by least squares over all sizes (springs at "
        f"{kinds.SAMPLES} samples, samples with one spring). Where every spring snaps, a scene of "
        "n springs also has about 3 n switches, each of which ends a step.\n\n"
        + markdown(exponents(sizes))
    )
    (out / "summary.md").write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", help="names; left out = all, and the summary")
    parser.add_argument("--budget", type=float, default=6.0, help="seconds of turns per scene")
    parser.add_argument("--out", type=Path, default=HERE / "forward")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    where = circumstances()
    compile_all()
    rows = []
    for scene in kinds.scenes():
        if options.scenes and scene.name not in options.scenes:
            continue
        began = time.perf_counter()
        table = measure(scene, options.budget)
        heading = [
            f"Error against run time: {scene.title}",
            f"{scene.time.size} samples. Error: largest over range, of displacement and base "
            f"stress, against {REFERENCE}. Processor time: median and quartiles.",
            where,
        ]
        table = write(table, options.out / scene.name, heading)
        draw_scene(table, scene.title, WANTED, options.out / f"{scene.name}.png")
        rows.append(compare(scene, table))
        print(
            f"{scene.name}: SciPy / simulate {rows[-1]['SciPy / simulate']:.3g}, "
            f"SciPy / kernel {rows[-1]['SciPy / kernel']:.3g} "
            f"({time.perf_counter() - began:.0f} s)",
            file=sys.stderr,
        )
    if options.scenes:
        return
    heading = ["Run time against springs and samples", where]
    sizes = write(scaling(longest=4.0), options.out / "scaling", heading)
    draw_scaling(sizes, options.out / "scaling.png")
    write_summary(rows, sizes, where, options.out)
    print(markdown(pd.DataFrame(rows)))


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
