"""How many problems do foamfit's search and eight methods of lmfit solve in a few seconds?

Method and answer: README.md. Also written: runs.csv.gz (every improvement by more than 2 %, and
when a problem was solved), runs.json (machine, settings) and figures. Without FOAMFIT_DATA the shoe
foam is omitted.

    FOAMFIT_DATA=… python experiments/identification/identification.py    # 35 min of one core
    python experiments/identification/identification.py --page            # figures and page only
"""

import argparse
import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import lmfit
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import foamfit as ff
from foamfit.fitting.box import Space
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import box_starts

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from studies import Array

HERE = Path(__file__).parent
SOLVED = 1.05  # cost over the best known cost at which a problem counts as solved
ENOUGH = 1.001  # cost over the best known at which a run ends
RECORDED = 0.98  # a cost is recorded below this multiple of the last recorded one
RUN = ["problem", "coordinates", "method", "seed"]
OWN = "foamfit.fit"
SEEDED = ("differential_evolution", "basinhopping", "dual_annealing")
GROUPS = {
    "least squares": ("leastsq", "least_squares"),
    "direct": ("nelder", "powell"),
    "global": (*SEEDED, "ampgo"),
}
METHODS = tuple(name for group in GROUPS.values() for name in group)
COORDINATES = {
    "si": "lmfit.Parameters in SI, bounds of make_params",
    "box": "lmfit.Parameters in the coordinates of foamfit's search",
}
# Colours safe for colour-blind readers (Okabe & Ito, and two more); lines also differ in dashes.
STYLES = {
    OWN: (studies.BLUE, "-"),
    "leastsq": ("black", "-"),
    "least_squares": (studies.SKY, "--"),
    "nelder": (studies.GREEN, "-"),
    "powell": ("#999933", "--"),
    "differential_evolution": (studies.VERMILION, "-"),
    "basinhopping": (studies.ORANGE, "--"),
    "dual_annealing": (studies.PURPLE, "-."),
    "ampgo": ("#6b6b6b", ":"),
}


class Case(NamedTuple):
    """An identification problem."""

    title: str
    record: str  # a reconstruction of foam-1, or a measurement of others
    model: str
    drive: str

    @property
    def by_others(self) -> bool:
        """Whether the record is not part of this repository."""
        return self.record in records.SHOE_FOAM

    def problem(self) -> Problem:
        """Read the test and set up the problem, as `foamfit.fit` does."""
        with studies.workplace() as folder:
            path = HERE.parent / f"foam-1/{self.record}-2.0mps-reconstruction.csv"
            test = ff.read_test(records.place(self.record, folder) if self.by_others else path)
        return make_problem(test, self.model, self.drive, None, None, False)


CASES = {
    "impact":
        Case("One spring, impact (reconstruction of foam-1)", "model-1", "bistable", "impact"),
    "displacement":
        Case("One spring, displacement drive (the same test)", "model-1", "bistable",
             "displacement"),
    "chain":
        Case("Linear + bistable, impact (reconstruction of foam-1)", "model-3", "linear+bistable",
             "impact"),
    "shoe-foam":
        Case("One spring, shoe foam (measurement: arXiv:2602.12694)", "turbo-comp-1", "bistable",
             "displacement"),
}  # fmt: skip


class RunOver(Exception):  # noqa: N818 (nothing went wrong)
    """The time is up, or the best known cost is reached."""


def recorded(
    work: Callable[[], Any], objective: Objective, budget: float, known: float
) -> list[tuple[float, float]]:
    """Return seconds and lowest cost of a search: at each clear improvement and at its end.

    The search ends after `budget` seconds of processor time, or near the best `known` cost. Only
    evaluations of the residual of `objective` count as progress, not those of a thinned record or
    of one weighed by the uncertainty of its motion.
    """
    plain, derivative = Objective.residual, Objective.jacobian
    rows, lowest, began = list[tuple[float, float]](), np.inf, time.process_time()

    def elapsed() -> float:
        seconds = time.process_time() - began
        if seconds > budget:
            raise RunOver
        return seconds

    def residual(self: Objective, values: Array) -> Array:
        nonlocal lowest
        out, seconds = plain(self, values), elapsed()
        if self.measurement is objective.measurement and self.weighing is None:
            lowest, last = min(lowest, float(out @ out)), rows[-1][1] if rows else np.inf
            if lowest < RECORDED * last or lowest <= SOLVED * known < last:
                rows.append((seconds, lowest))
            if lowest <= ENOUGH * known:
                raise RunOver
        return out

    def jacobian(self: Objective, values: Array, places: NDArray[np.int64]) -> Array:
        out = derivative(self, values, places)
        elapsed()
        return out

    with (
        suppress(RunOver),
        patch.object(Objective, "residual", residual),
        patch.object(Objective, "jacobian", jacobian),
    ):
        work()
    return [*rows, (min(time.process_time() - began, budget), lowest)]


def run_own(search: Callable[..., ff.FitResult], seed: int) -> None:
    """Fit repeatedly by foamfit's search, each time with another seed."""
    for again in range(1000):
        search(seed=1000 * seed + again)


@dataclass(frozen=True)
class Variables:
    """Variables of an lmfit method, "si" or "box", and their map to the problem's vector."""

    problem: Problem
    space: Space
    coordinates: str

    def params(self, point: Array) -> lmfit.Parameters:
        """Return parameters at a point of the box, inside their bounds for least_squares."""
        if self.coordinates == "box":
            params = lmfit.Parameters()
            for j, (low, high) in enumerate(zip(*self.space.box, strict=True)):
                params.add(f"u{j}", min=low, max=high)
            free, start = tuple(params), point
        else:
            params, free = self.problem.params.copy(), self.problem.free()
            start = self._free(self.space.decode(point))
        for name, value in zip(free, start, strict=True):
            low, high = params[name].min, params[name].max
            margin = 1e-9 * (high - low)
            params[name].value = float(np.clip(value, low + margin, high - margin))
        params.update_constraints()
        return params

    def residual(self, params: lmfit.Parameters) -> Array:
        """Return the residual of the problem."""
        return self.problem.objective.residual(self._vector(params))

    def jacobian(self, params: lmfit.Parameters) -> Array:
        """Return the derivative of the residual by the free parameters, (n_data, n_free)."""
        slopes = self.problem.slopes(self._vector(params), self.problem.free())
        if self.coordinates == "si":
            return slopes
        point, step = _values(params), 1e-6
        columns = [
            self._free(self.space.decode(point + move) - self.space.decode(point - move))
            for move in step * np.eye(point.size)
        ]
        return np.asarray(slopes @ (np.transpose(columns) / (2.0 * step)))

    def _vector(self, params: lmfit.Parameters) -> Array:
        box = self.coordinates == "box"
        return self.space.decode(_values(params)) if box else self.problem.vector(params)

    def _free(self, values: Array) -> Array:
        return values[[self.problem.index[name] for name in self.problem.free()]]


def _values(params: lmfit.Parameters) -> Array:
    return np.array(list(params.valuesdict().values()))


def run_lmfit(problem: Problem, method: str, coordinates: str, seed: int) -> None:
    """Minimise repeatedly by a method of lmfit, each time from another point of the box.

    The points are the same for every method with the same seed.
    """
    variables = Variables(problem, problem.space(), coordinates)
    rng, points = np.random.default_rng(seed), list[Array]()
    while True:
        points = points or list(box_starts(variables.space, rng, 32))
        start, draw = points.pop(0), int(rng.integers(2**31))
        np.random.seed(draw)  # noqa: NPY002 (lmfit's ampgo draws from there)
        options: dict[str, Any] = {  # of an experienced user
            "leastsq": {"Dfun": variables.jacobian},
            "least_squares": {"jac": variables.jacobian, "x_scale": "jac"},
        }.get(method, {"seed": draw} if method in SEEDED else {})
        with (
            warnings.catch_warnings(action="ignore"),  # about covariances of lmfit, not used here
            np.errstate(all="ignore"),
            suppress(ValueError, np.linalg.LinAlgError),  # the method restarts within its time
        ):
            lmfit.minimize(
                variables.residual, variables.params(start), method=method, calc_covar=False,
                max_nfev=10**9, **options,
            )  # fmt: skip


def run_all(options: argparse.Namespace) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Run every method on every problem and seed; return the runs and their setup."""
    known, rows = dict[str, float](), list[tuple[Any, ...]]()
    for key in options.problems:
        case = CASES[key]
        if case.by_others and not os.environ.get("FOAMFIT_DATA"):
            print(f"{key}: left out, FOAMFIT_DATA names no folder of measurements")
            continue
        problem, own = case.problem(), {"model": case.model, "drive": case.drive}
        search = partial(ff.fit, problem.measurement, intervals="local", **own)
        # The lowest cost of three long searches without the file's zeros; they compile everything.
        long = [search(seed=seed, starts=96).problem.vector() for seed in range(9000, 9003)]
        ends = [problem.objective.residual(vector) for vector in long]
        known[key] = min(float(residual @ residual) for residual in ends)
        for coordinates, method in [("own", OWN), *((c, m) for c in COORDINATES for m in METHODS)]:
            for seed in range(options.seeds):
                if method == OWN:
                    work = partial(run_own, search, seed)
                else:
                    work = partial(run_lmfit, problem, method, coordinates, seed)
                found = recorded(work, problem.objective, options.budget, known[key])
                rows += [(key, coordinates, method, seed, *row) for row in found]
            print(key, coordinates, method, f"{rows[-1][-1] / known[key]:.3g}", flush=True)
    machine = studies.circumstances("foamfit", "lmfit", "scipy", "numpy", "numba")
    setup = {"machine": machine, "budget_s": options.budget, "known": known}
    return pd.DataFrame(rows, columns=[*RUN, "seconds", "cost"]), setup


def solved_after(runs: pd.DataFrame, known: dict[str, float]) -> pd.DataFrame:
    """Return one row for each run: seconds to solution (inf if never)."""
    solved = runs["cost"] <= SOLVED * runs["problem"].map(known)
    after = runs.assign(solved_after_s=runs["seconds"].where(solved, np.inf))
    return after.groupby(RUN, sort=False)["solved_after_s"].min().reset_index()


def draw_curves(
    runs: pd.DataFrame, coordinates: str, known: dict[str, float], budget: float, path: Path
) -> None:
    """Plot misfit over the best known against seconds: median and quartiles over the seeds."""
    elapsed = np.geomspace(0.01, budget, 200)
    among = runs[runs["coordinates"].isin(("own", coordinates))]
    with studies.sheet(path, 7.0, 1.7 * len(known) + 0.9) as figure:
        grid = figure.subplots(len(known), len(GROUPS), sharex=True, sharey=True, squeeze=False)
        for key, row in zip(known, grid, strict=True):
            for axes, methods in zip(row, GROUPS.values(), strict=True):
                for name in (*methods, OWN):
                    chosen = among[(among["problem"] == key) & (among["method"] == name)]
                    _band(axes, elapsed, chosen, known[key], name)
                axes.set(xscale="log", yscale="log")
                axes.set(xlim=(elapsed[0], elapsed[-1]), ylim=(0.9, 300.0))
                axes.axhline(1.0, color="0.75", linewidth=0.8, zorder=0)
                studies.gridlines(axes)
            row[0].set_ylabel("misfit over\nbest known (–)")
            row[len(GROUPS) // 2].set_title(CASES[key].title)
        for axes, title in zip(grid[-1], GROUPS, strict=True):
            axes.set_xlabel(f"processor time (s): {title}")
        seeds = runs["seed"].nunique()
        heading = f"{COORDINATES[coordinates]}: median and quartiles of {seeds} seeds"
        figure.suptitle(heading, fontsize=8)
        for name in STYLES:
            axes.plot([], [], label=name, **_line(name))
        handles = axes.get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=5, handlelength=3.2)


def _band(axes: Axes, elapsed: Array, runs: pd.DataFrame, known: float, name: str) -> None:
    """Draw one method: median and quartiles over the seeds at each time."""
    reached = []
    for _, run in runs.groupby("seed", sort=False):
        at = np.searchsorted(run["seconds"].to_numpy(), elapsed, side="right") - 1
        misfit = np.sqrt(run["cost"].to_numpy() / known)
        reached.append(np.where(at >= 0, misfit[at], np.inf))
    low, middle, high = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
    there = list(np.isfinite(high))  # true once three quarters of the seeds have a result
    line = _line(name)
    axes.fill_between(elapsed, low, high, where=there, color=line["color"], alpha=0.15, linewidth=0)
    axes.plot(elapsed, middle, **line)


def _line(name: str) -> dict[str, Any]:
    colour, dash = STYLES[name]
    return {"color": colour, "linestyle": dash, "linewidth": 2.0 if name == OWN else 1.1}


def summary(ends: pd.DataFrame, known: dict[str, float]) -> str:
    """Return a Markdown table: one row for each method, one column for each problem."""
    rows = []
    for (coordinates, method), own in ends.groupby(["coordinates", "method"], sort=False):
        cells = []
        for key in known:
            after = own.loc[own["problem"] == key, "solved_after_s"]
            median = np.quantile(after, 0.5, method="inverted_cdf")
            shown = f"{median:.2f} s" if np.isfinite(median) else "never"
            cells.append(f"{np.isfinite(after).sum()} of {len(after)}, {shown}")
        solved = np.isfinite(own["solved_after_s"])
        rows.append([method, coordinates, *cells, f"{solved.sum()} of {len(own)}"])
    titles = [CASES[key].title for key in known]
    return studies.markdown(["method", "in", *titles, "all"], rows)


def main() -> None:
    """Run all methods, unless recorded runs are only drawn, and write figures and page."""
    parser = studies.arguments(__doc__, HERE, page=True, budget=(3.0, "seconds of a run"), seeds=10)
    parser.add_argument("--problems", nargs="+", choices=list(CASES), default=list(CASES))
    options = parser.parse_args()
    threadpool_limits(1)  # for all, so that processor time is elapsed time
    log, notes = options.out / "runs.csv.gz", options.out / "runs.json"
    if not options.page:
        runs, setup = run_all(options)
        studies.write_csv(runs, log, 5)
        notes.write_text(json.dumps(setup, indent=1) + "\n")
    runs, setup = pd.read_csv(log), json.loads(notes.read_text())
    lowest = runs.groupby("problem")["cost"].min()
    known = {key: min(cost, float(lowest[key])) for key, cost in setup["known"].items()}
    for coordinates in COORDINATES:
        draw_curves(runs, coordinates, known, setup["budget_s"], options.out / f"{coordinates}.png")
    studies.write_page(
        HERE, options.out, seeds=runs["seed"].nunique(), problems=len(known),
        budget=setup["budget_s"], machine=setup["machine"],
        table=summary(solved_after(runs, known), known), **COORDINATES,
    )  # fmt: skip


if __name__ == "__main__":
    main()
