"""How many problems do foamfit's search and eight methods of lmfit solve in a few seconds?

Method and answer: README.md. Also written: runs.csv.gz (every improvement by more than 2 %, and
when a problem was solved), runs.json (machine, settings) and solved.png. Without FOAMFIT_DATA the
shoe foam is omitted.

    FOAMFIT_DATA=… python experiments/identification/identification.py    # 35 min of one core
    python experiments/identification/identification.py --page            # figure and page only
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
import matplotlib
import numpy as np
import pandas as pd
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
METHODS = ("leastsq", "least_squares", "nelder", "powell", *SEEDED, "ampgo")
COORDINATES = {
    "si": "lmfit.Parameters in SI, bounds of make_params",
    "box": "lmfit.Parameters in the coordinates of foamfit's search",
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


def draw(ends: pd.DataFrame, budget: float, path: Path) -> None:
    """Plot the runs solved against seconds, for the methods in each kind of coordinates."""
    order = (OWN, *METHODS)
    with studies.sheet(path, 7.0, 3.4) as figure:
        axes = figure.subplots(1, len(COORDINATES), sharey=True)
        for ax, (coordinates, title) in zip(axes, COORDINATES.items(), strict=True):
            among = ends[ends["coordinates"].isin(("own", coordinates))]
            for i, name in enumerate(order):
                own = among.loc[among["method"] == name, "solved_after_s"]
                after = np.sort(own).clip(max=2.0 * budget)
                share = np.arange(after.size + 1) / after.size
                style = {"color": matplotlib.colormaps["tab10"](i), "linewidth": 2.0 - (i > 0)}
                ax.step([0.01, *after], 100.0 * share, where="post", label=name, **style)
            ax.set(xscale="log", xlim=(0.01, budget), ylim=(0.0, 101.0), title=title)
            ax.set_xlabel("processor time (s)")
            studies.gridlines(ax)
        axes[0].set_ylabel("runs solved (%)")
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=5)


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
    """Run all methods, unless recorded runs are only drawn, and write figure and page."""
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
    ends = solved_after(runs, known)
    draw(ends, setup["budget_s"], options.out / "solved.png")
    studies.write_page(
        HERE, options.out, seeds=runs["seed"].nunique(), problems=len(known),
        budget=setup["budget_s"], machine=setup["machine"],
        table=summary(ends, known),
    )  # fmt: skip


if __name__ == "__main__":
    main()
