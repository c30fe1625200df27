"""How many problems do foamfit's search and eight methods of lmfit solve in a few seconds?

Method and answer: README.md. Also written: runs.csv (when each run solved its problem, and its
lowest cost), runs.json (machine, settings) and solved.png. Without FOAMFIT_DATA the shoe foam is
omitted.

    FOAMFIT_DATA=… python experiments/identification/identification.py    # 20 min of one core
    python experiments/identification/identification.py --page            # figure and page only
"""

import argparse
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from itertools import product
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
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import box_starts

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from studies import Array

HERE = Path(__file__).parent
SOLVED = 1.05  # cost over the best known cost at which a problem is solved
COLUMNS = ["problem", "method", "seed", "solved_after_s", "cost"]
OWN = "foamfit.fit"
SEEDED = ("differential_evolution", "basinhopping", "dual_annealing")
METHODS = ("leastsq", "least_squares", "nelder", "powell", *SEEDED, "ampgo")


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
    """The time is up, or the problem is solved."""


def solved_after(
    work: Callable[[], Any], objective: Objective, budget: float, known: float
) -> tuple[float, float]:
    """Return the processor time (s) in which a search solves a problem, and its lowest cost.

    The time is infinite if it is not solved within `budget` seconds; `known` is the best known
    cost. Only evaluations of the residual of `objective` count, not those of a thinned record or of
    one weighed by the uncertainty of its motion.
    """
    plain, derivative = Objective.residual, Objective.jacobian
    solved, lowest, began = np.inf, np.inf, time.process_time()

    def elapsed() -> float:
        seconds = time.process_time() - began
        if seconds > budget:
            raise RunOver
        return seconds

    def residual(self: Objective, values: Array) -> Array:
        nonlocal lowest, solved
        out, seconds = plain(self, values), elapsed()
        if self.measurement is objective.measurement and self.weighing is None:
            lowest = min(lowest, float(out @ out))
            if lowest <= SOLVED * known:
                solved = seconds
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
    return solved, lowest


def run_own(search: Callable[..., ff.FitResult], seed: int) -> None:
    """Fit repeatedly by foamfit's search, each time with another seed."""
    for again in range(1000):
        search(seed=1000 * seed + again)


def run_lmfit(problem: Problem, method: str, seed: int) -> None:
    """Minimise repeatedly by a method of lmfit, each time from another point of the box.

    The points are the same for every method with the same seed.
    """
    space, names = problem.space(), problem.free()
    free, (low, high) = [problem.index[name] for name in names], space.box
    rng, points, margin = np.random.default_rng(seed), list[Array](), 1e-9 * (high - low)

    def point_of(params: lmfit.Parameters) -> Array:
        return np.array(list(params.valuesdict().values()))

    def residual(params: lmfit.Parameters) -> Array:
        return problem.objective.residual(space.decode(point_of(params)))

    def jacobian(params: lmfit.Parameters) -> Array:
        point, step = point_of(params), 1e-6
        moves = step * np.eye(point.size)
        moved = np.array([space.decode(point + one) - space.decode(point - one) for one in moves])
        slopes = problem.slopes(space.decode(point), names)
        return np.asarray(slopes @ (moved[:, free].T / (2.0 * step)))

    while True:
        points = points or list(box_starts(space, rng, 32))
        start, draw = np.clip(points.pop(0), low + margin, high - margin), int(rng.integers(2**31))
        params = lmfit.Parameters()
        for j, ends in enumerate(zip(start, low, high, strict=True)):
            params.add(f"u{j}", ends[0], min=ends[1], max=ends[2])
        np.random.seed(draw)  # noqa: NPY002 (lmfit's ampgo draws from there)
        options: dict[str, Any] = {  # of an experienced user
            "leastsq": {"Dfun": jacobian},
            "least_squares": {"jac": jacobian, "x_scale": "jac"},
        }.get(method, {"seed": draw} if method in SEEDED else {})
        with (
            warnings.catch_warnings(action="ignore"),  # about covariances of lmfit, not used here
            np.errstate(all="ignore"),
            suppress(ValueError, np.linalg.LinAlgError),  # the method restarts within its time
        ):
            lmfit.minimize(
                residual, params, method=method, calc_covar=False, max_nfev=10**9, **options
            )


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
        for method, seed in product((OWN, *METHODS), range(options.seeds)):
            work = partial(run_lmfit, problem, method, seed)
            if method == OWN:
                work = partial(run_own, search, seed)
            found = solved_after(work, problem.objective, options.budget, known[key])
            rows.append((key, method, seed, *found))
            print(*rows[-1], flush=True)
    machine = studies.circumstances("foamfit", "lmfit", "scipy", "numpy", "numba")
    setup = {"machine": machine, "budget_s": options.budget, "known": known}
    return pd.DataFrame(rows, columns=COLUMNS), setup


def draw(runs: pd.DataFrame, budget: float, path: Path) -> None:
    """Plot the runs solved against seconds, for every method."""
    with studies.sheet(path, 5.6, 3.1) as figure:
        ax = figure.add_subplot()
        for i, (name, own) in enumerate(runs.groupby("method", sort=False)):
            after = np.sort(own["solved_after_s"]).clip(max=2.0 * budget)
            share = np.arange(after.size + 1) / after.size
            style = {"color": matplotlib.colormaps["tab10"](i), "linewidth": 2.0 - (i > 0)}
            ax.step([0.01, *after], 100.0 * share, where="post", label=name, **style)
        ax.set(xscale="log", xlim=(0.01, budget), ylim=(0.0, 101.0))
        ax.set(xlabel="processor time (s)", ylabel="runs solved (%)")
        studies.gridlines(ax)
        figure.legend(loc="outside right center")


def summary(runs: pd.DataFrame, problems: Iterable[str]) -> str:
    """Return a Markdown table: one row for each method, one column for each problem."""
    rows = []
    for method, own in runs.groupby("method", sort=False):
        cells = []
        for key in problems:
            after = own.loc[own["problem"] == key, "solved_after_s"]
            median = np.quantile(after, 0.5, method="inverted_cdf")
            shown = f"{median:.2f} s" if np.isfinite(median) else "never"
            cells.append(f"{np.isfinite(after).sum()} of {len(after)}, {shown}")
        solved = np.isfinite(own["solved_after_s"])
        rows.append([method, *cells, f"{solved.sum()} of {len(own)}"])
    return studies.markdown(["method", *(CASES[key].title for key in problems), "all"], rows)


def main() -> None:
    """Run all methods, unless recorded runs are only drawn, and write figure and page."""
    parser = studies.arguments(__doc__, HERE, page=True, budget=(3.0, "seconds of a run"), seeds=10)
    parser.add_argument("--problems", nargs="+", choices=list(CASES), default=list(CASES))
    options = parser.parse_args()
    threadpool_limits(1)  # for all, so that processor time is elapsed time
    log, notes = options.out / "runs.csv", options.out / "runs.json"
    if not options.page:
        runs, setup = run_all(options)
        studies.write_csv(runs, log, 5)
        notes.write_text(json.dumps(setup, indent=1) + "\n")
    runs, setup = pd.read_csv(log), json.loads(notes.read_text())
    draw(runs, setup["budget_s"], options.out / "solved.png")
    studies.write_page(
        HERE, options.out, seeds=runs["seed"].nunique(), problems=len(setup["known"]),
        budget=setup["budget_s"], machine=setup["machine"],
        table=summary(runs, setup["known"]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
