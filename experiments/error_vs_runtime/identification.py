"""Misfit reached against seconds: the project's own search and eight methods of lmfit.

Every method minimises the same residual (`foamfit.objective.Objective`) of the same problems and
is stopped by the same clock. What is recorded is the lowest cost so far against the processor time
of the one thread that runs, which on an idle machine is the time on the clock. A local method
starts at a random point of the search's box (`foamfit.search.box_starts`, drawn from the seed) and
starts again from the next one until the time is up; a global method that ends does so too; and so
does `foamfit.fit`, with another seed. A run also ends once its cost is within 0.1 % of the best
known, where nothing is left to gain.

The eight methods are run twice: in the `lmfit.Parameters` of `foamfit.make_params` (SI values and
bounds, what a user of lmfit would write), and in the coordinates of the project's own search,
lent to them as `lmfit.Parameters` too, in which every point is admissible.

    python experiments/error_vs_runtime/identification.py            # at most 35 minutes of one core
    python experiments/error_vs_runtime/identification.py --budget 1 --seeds 2
    python experiments/error_vs_runtime/identification.py --redraw   # figures and table only

Writes beside itself: identification_runs.csv.gz (every improvement by more than 0.1 %) with
identification_runs.json (machine, versions, arguments), identification.csv, identification.md,
identification_profiles.png, identification_si.png and identification_box.png. FOAMFIT_DATA names
the folder of the measurements by others; without it the shoe foam is left out.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # one thread for all, so that processor time is the time on the clock

import argparse
import json
import platform
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import lmfit
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

import foamfit as ff
from foamfit.objective import Objective
from foamfit.problem import Problem, make_problem
from foamfit.search import box_starts
from foamfit.space import Space

Array = NDArray[np.float64]

HERE = Path(__file__).parent
SOLVED = 1.05  # cost over the best known cost at which a problem counts as solved
ENOUGH = 1.001  # and at which a run ends
RECORDED = 0.999  # cost over the last recorded one below which it is recorded
OWN = "foamfit.fit"
LEAST_SQUARES = ("leastsq", "least_squares")
DIRECT = ("nelder", "powell")
GLOBAL = ("differential_evolution", "basinhopping", "dual_annealing", "ampgo")
METHODS = (*LEAST_SQUARES, *DIRECT, *GLOBAL)
COORDINATES = {
    "si": "lmfit.Parameters in SI, bounds of make_params",
    "box": "lmfit.Parameters in the coordinates of foamfit's search",
}
# Colours of Okabe and Ito, told apart by all; lines differ in their dashes too.
STYLES: dict[str, tuple[str, str]] = {
    OWN: ("#000000", "-"),
    "leastsq": ("#0072B2", "-"),
    "least_squares": ("#56B4E9", "--"),
    "nelder": ("#009E73", "-"),
    "powell": ("#999933", "--"),
    "differential_evolution": ("#D55E00", "-"),
    "basinhopping": ("#E69F00", "--"),
    "dual_annealing": ("#CC79A7", "-."),
    "ampgo": ("#7F7F7F", ":"),
}


# ---------------------------------------------------------------- problems


@dataclass(frozen=True)
class Case:
    """What is to be identified: a test file, a model and a drive."""

    title: str
    file: str  # from experiments/, or from FOAMFIT_DATA where `specimen` is given
    model: str
    drive: str
    specimen: str | None = None

    def problem(self) -> Problem:
        """Read the test and make the problem ready, as `foamfit.fit` does."""
        return make_problem(self.read(), self.model, self.drive, None, None, False)

    def read(self) -> ff.Measurement:
        """Read the test."""
        if self.specimen is None:
            return ff.read_test(HERE.parent / self.file)
        with tempfile.TemporaryDirectory() as folder:
            toml = Path(folder) / "specimen.toml"
            toml.write_text(self.specimen)
            return ff.read_test(Path(os.environ["FOAMFIT_DATA"]) / self.file, toml)


CASES = {
    "impact": Case(
        "One spring, impact (reconstruction of foam-1)",
        "foam-1/model-1-2.0mps-reconstruction.csv", "bistable", "impact",
    ),
    "displacement": Case(
        "One spring, displacement drive (the same test)",
        "foam-1/model-1-2.0mps-reconstruction.csv", "bistable", "displacement",
    ),
    "chain": Case(
        "Linear + bistable, impact (reconstruction of foam-1)",
        "foam-1/model-3-2.0mps-reconstruction.csv", "linear+bistable", "impact",
    ),
    "shoe-foam": Case(
        "One spring, shoe foam (measurement: arXiv:2602.12694)",
        "shoe-foam/turbo-comp-1_cycle1.csv", "bistable", "displacement",
        '[specimen]\nheight = "10.53 mm"\ndiameter = "7.63 mm"\n',
    ),
}  # fmt: skip


# ---------------------------------------------------------------- one run


class RunOver(Exception):  # noqa: N818 (nothing went wrong)
    """The time is up, or nothing is left to gain."""


@dataclass(eq=False)
class Recorder:
    """The lowest cost of one run so far, against seconds and evaluations.

    Parameters
    ----------
    objective : Objective
        Of the problem: only evaluations of the same curves count as progress.
    budget : float
        Processor time after which the run is over, s.
    enough : float
        Cost at which it is over too.
    """

    objective: Objective
    budget: float
    enough: float
    cost: float = np.inf
    values: Array | None = None
    evaluations: int = 0
    rows: list[tuple[float, int, float]] = field(default_factory=list)
    began: float = field(default_factory=time.process_time)

    def note(self, objective: Objective, values: Array, residual: Array) -> None:
        """Take down an evaluation.

        Raises
        ------
        RunOver
            When the run is over.
        """
        seconds = time.process_time() - self.began
        self.evaluations += 1
        if objective.measurement is self.objective.measurement:
            cost = float(residual @ residual)
            if cost < self.cost:
                self.cost, self.values = cost, values.copy()
                if not self.rows or cost < RECORDED * self.rows[-1][2]:
                    self.rows.append((seconds, self.evaluations, cost))
        if seconds > self.budget or self.cost <= self.enough:
            raise RunOver

    def finished(self) -> list[tuple[float, int, float]]:
        """Rows of the run, the last one at its end.

        Raises
        ------
        RuntimeError
            If the recorded cost is not that of the recorded point: the method minimised another
            function than the others.
        """
        if self.values is None:
            raise RuntimeError("nothing was evaluated")
        residual = self.objective.residual(self.values)
        if not np.isclose(float(residual @ residual), self.cost, rtol=1e-6):
            raise RuntimeError("the method did not minimise the cost of the problem")
        seconds = min(time.process_time() - self.began, self.budget)
        return [*self.rows, (seconds, self.evaluations, self.cost)]


@contextmanager
def recorded(recorder: Recorder) -> Iterator[None]:
    """Have every residual of any objective noted; ends quietly when the run is over."""
    plain = Objective.residual

    def residual(self: Objective, values: Array) -> Array:
        out = plain(self, values)
        recorder.note(self, values, out)
        return out

    Objective.residual = residual  # type: ignore[method-assign]
    try:
        yield
    except RunOver:
        pass
    finally:
        Objective.residual = plain  # type: ignore[method-assign]


def run_own(case: Case, problem: Problem, seed: int) -> None:
    """Fit by the project's own search, over and over with other seeds."""
    for again in range(1000):
        ff.fit(problem.measurement, model=case.model, drive=case.drive, seed=1000 * seed + again)


def random_points(space: Space, rng: np.random.Generator) -> Iterator[Array]:
    """Points of the box, without end; the same ones for every method of the same seed."""
    while True:
        yield from box_starts(space, rng, 32)


def run_lmfit(problem: Problem, method: str, coordinates: str, seed: int, derivatives: str) -> None:
    """Minimise by a method of lmfit, over and over from other points of the box."""
    space = problem.space()
    names = problem.free()
    places = [problem.model.index[name] for name in names]

    if coordinates == "box":
        params = lmfit.Parameters()
        for j, (low, high) in enumerate(zip(*space.box, strict=True)):
            params.add(f"u{j}", min=low, max=high, value=0.5 * (low + high))
        free = tuple(params)

        def vector(p: lmfit.Parameters) -> Array:
            return space.decode(np.array([p[name].value for name in free]))

    else:
        params, free, vector = problem.params.copy(), names, problem.vector

    def residual(p: lmfit.Parameters) -> Array:
        return problem.objective.residual(vector(p))

    def jacobian(p: lmfit.Parameters) -> Array:
        """Slopes of the residual by the free parameters, and those by the coordinates."""
        slopes = problem.slopes(vector(p), names)
        if coordinates == "si":
            return slopes
        point = np.array([p[name].value for name in free])
        step = 1e-6
        columns = [
            (space.decode(point + step * unit) - space.decode(point - step * unit))[places]
            for unit in np.eye(point.size)
        ]
        return np.asarray(slopes @ (np.transpose(columns) / (2.0 * step)))

    rng = np.random.default_rng(seed)
    for point in random_points(space, rng):
        start = point if coordinates == "box" else space.decode(point)[places]
        for name, value in zip(free, start, strict=True):
            low, high = params[name].min, params[name].max
            margin = 1e-9 * (high - low)  # least_squares wants its start off the bounds
            params[name].value = float(np.clip(value, low + margin, high - margin))
        params.update_constraints()
        options = _options(method, int(rng.integers(2**31)))
        if method in LEAST_SQUARES and derivatives == "problem":
            options |= {"Dfun" if method == "leastsq" else "jac": jacobian}
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of lmfit's covariances, which nobody reads here
            try:
                lmfit.minimize(
                    residual, params, method=method, calc_covar=False, max_nfev=10**9, **options
                )
            except (ValueError, np.linalg.LinAlgError):
                continue  # a method that breaks down starts again, on its own time


def _options(method: str, seed: int) -> dict[str, object]:
    """What a knowing user would set: chance from the seed, scales and steps of least_squares."""
    if method == "least_squares":
        return {"x_scale": "jac", "diff_step": 1e-5}
    if method in ("differential_evolution", "basinhopping", "dual_annealing"):
        return {"seed": seed}
    if method == "ampgo":
        np.random.seed(seed)  # noqa: NPY002 (lmfit's ampgo draws from there)
    return {}


# ---------------------------------------------------------------- all runs


def best_known(case: Case, problem: Problem) -> float:
    """Lowest cost of three long searches, which also compile whatever there is to compile."""
    costs = []
    for seed in range(3):
        result = ff.fit(
            problem.measurement, model=case.model, drive=case.drive, seed=9000 + seed, starts=96
        )
        residual = problem.objective.residual(problem.vector(result.params))
        costs.append(float(residual @ residual))
    return min(costs)


def run_all(options: argparse.Namespace) -> tuple[pd.DataFrame, dict[str, object]]:
    """Run every method on every problem and seed; returns the improvements and what was asked."""
    frames = []
    meta: dict[str, object] = machine() | {
        "budget_s": options.budget, "seeds": options.seeds, "derivatives": options.derivatives,
    }  # fmt: skip
    known: dict[str, float] = {}
    sizes: dict[str, int] = {}
    for key in options.problems:
        case = CASES[key]
        if case.specimen is not None and not os.environ.get("FOAMFIT_DATA"):
            print(f"{key}: left out, FOAMFIT_DATA names no folder of measurements")
            continue
        problem = case.problem()
        known[key] = best_known(case, problem)
        sizes[key] = problem.objective.n_data
        print(f"{key}: best known cost {known[key]:.6g} of {sizes[key]} samples")
        runs = [(OWN, "own"), *((m, c) for c in options.coordinates for m in options.methods)]
        for method, coordinates in runs:
            ended = []
            for seed in range(options.seeds):
                recorder = Recorder(problem.objective, options.budget, ENOUGH * known[key])
                with recorded(recorder):
                    if method == OWN:
                        run_own(case, problem, seed)
                    else:
                        run_lmfit(problem, method, coordinates, seed, options.derivatives)
                rows = recorder.finished()
                ended.append(f"{rows[-1][2] / known[key]:.3g}")
                frame = pd.DataFrame(rows, columns=["seconds", "evaluations", "cost"])
                frames.append(
                    frame.assign(problem=key, coordinates=coordinates, method=method, seed=seed)
                )
            print(f"  {coordinates:4} {method:24} cost over best known: {' '.join(ended)}")
    meta |= {"best_known": known, "n_data": sizes}
    order = ["problem", "coordinates", "method", "seed", "seconds", "evaluations", "cost"]
    return pd.concat(frames, ignore_index=True)[order], meta


def machine() -> dict[str, str]:
    """Machine and versions, which times belong to."""
    names = ("foamfit", "lmfit", "scipy", "numpy", "numba")
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        processor = lines[0].split(":", 1)[1].strip() if lines else processor
    return {
        "processor": f"{processor}, {os.cpu_count()} cores, {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in names},
    }


# ---------------------------------------------------------------- table


def solved_after(runs: pd.DataFrame, known: dict[str, float]) -> pd.DataFrame:
    """One row for each run: seconds until it was solved (inf if never) and how it ended."""
    rows = []
    keys = ["problem", "coordinates", "method", "seed"]
    for (problem, coordinates, method, seed), run in runs.groupby(keys, sort=False):
        reached = run[run["cost"] <= SOLVED * known[str(problem)]]
        rows.append(
            {
                "problem": problem,
                "coordinates": coordinates,
                "method": method,
                "seed": seed,
                "solved_after_s": reached["seconds"].iloc[0] if len(reached) else np.inf,
                "misfit_ratio": (run["cost"].iloc[-1] / known[str(problem)]) ** 0.5,
                "ended_after_s": run["seconds"].iloc[-1],
                "evaluations": run["evaluations"].iloc[-1],
            }
        )
    return pd.DataFrame(rows)


def tabulate(ends: pd.DataFrame) -> pd.DataFrame:
    """One row for each problem and method: how many seeds it solved, how fast, how far it came."""
    rows = []
    keys = ["problem", "coordinates", "method"]
    for (problem, coordinates, method), runs in ends.groupby(keys, sort=False):
        # inf - inf is no number: quartiles of times by rank, not by interpolation
        low, middle, high = np.quantile(
            runs["solved_after_s"], (0.25, 0.5, 0.75), method="inverted_cdf"
        )
        rows.append(
            {
                "problem": problem,
                "coordinates": coordinates,
                "method": method,
                "solved": int(np.isfinite(runs["solved_after_s"]).sum()),
                "seeds": len(runs),
                "solved after, quartile 1 (s)": low,
                "solved after, median (s)": middle,
                "solved after, quartile 3 (s)": high,
                "misfit over best known at the end, median": runs["misfit_ratio"].median(),
                "misfit over best known at the end, worst": runs["misfit_ratio"].max(),
                "evaluations per second, median": (
                    runs["evaluations"] / runs["ended_after_s"]
                ).median(),
            }
        )
    return pd.DataFrame(rows)


def profile(ends: pd.DataFrame, coordinates: str) -> dict[str, Array]:
    """Performance ratios of each method over all problem-seeds (Dolan & Moré 2002, eq. 1).

    The ratio is the time a method took to solve a problem from a seed, over the shortest time of
    all methods there; inf where it did not.
    """
    among = ends[ends["coordinates"].isin(("own", coordinates))]
    times = among.pivot_table(
        index=["problem", "seed"], columns="method", values="solved_after_s", sort=False
    ).replace(np.nan, np.inf)
    best = times.min(axis=1)
    ratios = times.div(best.where(np.isfinite(best), 1.0), axis=0)
    return {name: ratios[name].to_numpy() for name in STYLES if name in ratios}


# ---------------------------------------------------------------- figures


def draw_profiles(ends: pd.DataFrame, meta: dict[str, object], path: Path) -> None:
    """Share of problem-seeds solved within a factor of the shortest time."""
    shown = [c for c in COORDINATES if c in set(ends["coordinates"])]
    figure = Figure(figsize=(4.4 * len(shown) + 0.2, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes_row = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axes, coordinates in zip(axes_row, shown, strict=True):
        ratios = profile(ends, coordinates)
        finite = np.concatenate([r[np.isfinite(r)] for r in ratios.values()])
        last = 10.0 ** np.ceil(np.log10(max(finite.max() * 1.05, 10.0)))
        for name in reversed(ratios):
            colour, dash = STYLES[name]
            steps = np.sort(ratios[name][np.isfinite(ratios[name])])
            share = np.arange(1, steps.size + 1) / ratios[name].size
            axes.step(
                np.concatenate([[1.0], steps, [last]]),
                np.concatenate([[0.0], share, share[-1:] if share.size else [0.0]]),
                where="post", color=colour, linestyle=dash, label=name,
                linewidth=2.2 if name == OWN else 1.4,
            )  # fmt: skip
        axes.set(xscale="log", xlim=(1.0, last), ylim=(-0.02, 1.02))
        axes.set_title(COORDINATES[coordinates], fontsize=9)
        axes.set_xlabel("time over the shortest time, τ (–)", fontsize=9)
        _plain(axes)
    axes_row[0].set_ylabel("share of problem-seeds solved within τ (–)", fontsize=9)
    count = next(iter(ratios.values())).size
    figure.suptitle(
        f"{count} problem-seeds; solved: cost within 5 % of the best known, "
        f"in at most {meta['budget_s']:g} s",
        fontsize=10,
    )
    _legend(figure, axes_row[0], columns=3 if len(shown) > 1 else 2)
    figure.savefig(path, dpi=200)


def draw_curves(runs: pd.DataFrame, coordinates: str, meta: dict[str, object], path: Path) -> None:
    """Misfit over the best known against seconds: median and quartiles over the seeds."""
    known: dict[str, float] = meta["best_known"]  # type: ignore[assignment]
    budget = float(meta["budget_s"])  # type: ignore[arg-type]
    problems = [key for key in CASES if key in known]
    groups = (("least squares", LEAST_SQUARES), ("direct", DIRECT), ("global", GLOBAL))
    figure = Figure(figsize=(8.8, 2.1 * len(problems) + 1.1), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(problems), len(groups), sharex=True, sharey=True, squeeze=False)
    clock = np.geomspace(0.01, budget, 200)
    for key, row in zip(problems, grid, strict=True):
        for axes, (title, methods) in zip(row, groups, strict=True):
            for name in (*methods, OWN):
                among = ("own",) if name == OWN else (coordinates,)
                mine = (runs["problem"] == key) & (runs["method"] == name)
                chosen = runs[mine & runs["coordinates"].isin(among)]
                if len(chosen):
                    _band(axes, clock, chosen, known[key], name)
            axes.set(xscale="log", yscale="log", xlim=(clock[0], budget), ylim=(0.9, 100.0))
            axes.axhline(1.0, color="0.7", linewidth=0.6, zorder=0)
            _plain(axes)
            if axes is row[0]:
                axes.set_ylabel("misfit over\nbest known (–)", fontsize=9)
            elif axes is row[1]:
                axes.set_title(CASES[key].title, fontsize=9)
            if key == problems[-1]:
                axes.set_xlabel(f"seconds, {title} methods", fontsize=9)
    figure.suptitle(f"{COORDINATES[coordinates]}: median and quartiles of {meta['seeds']} seeds",
                    fontsize=10)  # fmt: skip
    _legend(figure, grid[0, 0], columns=5, everyone=True)
    figure.savefig(path, dpi=200)


def _band(axes: Axes, clock: Array, runs: pd.DataFrame, known: float, name: str) -> None:
    """Draw one method: what each seed had reached at each second, as median and quartiles."""
    reached = []
    for _, run in runs.groupby("seed", sort=False):
        at = np.searchsorted(run["seconds"].to_numpy(), clock, side="right") - 1
        misfit = np.sqrt(run["cost"].to_numpy() / known)
        reached.append(np.where(at >= 0, misfit[at], np.inf))
    low, middle, high = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
    colour, dash = STYLES[name]
    axes.fill_between(clock, low, np.minimum(high, 1e6), color=colour, alpha=0.15, linewidth=0)
    axes.plot(clock, middle, color=colour, linestyle=dash, linewidth=2.0 if name == OWN else 1.3)


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.92", linewidth=0.5)
    axes.set_axisbelow(True)


def _legend(figure: Figure, axes: Axes, columns: int, everyone: bool = False) -> None:
    """Put the legend below the panels, in the order of the styles."""
    if everyone:
        from matplotlib.lines import Line2D

        handles = [Line2D([], [], color=c, linestyle=d, label=n) for n, (c, d) in STYLES.items()]
    else:
        handles = axes.get_legend_handles_labels()[0][::-1]
    figure.legend(
        handles=handles, frameon=False, fontsize=8, loc="outside lower center", ncols=columns,
        handlelength=3.2,
    )  # fmt: skip


# ---------------------------------------------------------------- page

PAGE = """\
# Identification: misfit against run time

Made by `python experiments/error_vs_runtime/identification.py`{again}. {count} problem-seeds: \
{problems} problems, {seeds} seeds each, at most {budget:g} s for a run, one thread, seconds of \
processor time (on an idle machine the time on the clock).

Machine: {processor}; Python {python}, foamfit {foamfit}, lmfit {lmfit}, SciPy {scipy}, NumPy \
{numpy}, numba {numba}.

Everyone minimises the same residual, is stopped by the same clock, and starts again from the next \
random point of the seed when it ends early. *Solved* is a cost (sum of squares) within 5 % of the \
best known, which is the lowest of three long searches of `foamfit.fit` and of every run. In the \
column "in", *si* are the `lmfit.Parameters` that `foamfit.make_params` gives, and *box* lends the \
coordinates of foamfit's own search, in which every point is an admissible chain. {slopes}

{findings}

![Performance profiles](identification_profiles.png)

*Performance profiles (Dolan & Moré, Math. Program. 91, 201, 2002): the share of problem-seeds that \
a method solves within a factor τ of the shortest time. Left edge: how often it is the fastest; \
right edge: how often it solves at all.*

{curves}

*Reconstruction: simulated from published parameters with 1 % noise, not measured. {shoe}*

{table}
"""
SLOPES = {
    "differences": "`leastsq` and `least_squares` take forward differences with a step of 1e-5; "
    "`least_squares` scales its variables by the Jacobian.",
    "problem": "`leastsq` and `least_squares` are given the derivatives that the project's own "
    "search uses (`Problem.slopes`); `least_squares` scales its variables by the Jacobian.",
}
SHOE = "Shoe foam: first cycle of turbo-comp-1, a measurement by others, arXiv:2602.12694."


def findings(ends: pd.DataFrame) -> str:
    """Say in two sentences what the runs say."""
    out = []
    for coordinates in COORDINATES:
        among = ends[ends["coordinates"] == coordinates]
        if among.empty:
            continue
        own = ends[ends["coordinates"] == "own"]["solved_after_s"]
        solved = among.groupby("method", sort=False)["solved_after_s"].agg(
            lambda times: int(np.isfinite(times).sum())
        )
        best = solved.idxmax()
        ratios = profile(ends, coordinates)
        first = np.mean(ratios[OWN] == 1.0)
        out.append(
            f"In *{coordinates}*, `{OWN}` solves {int(np.isfinite(own).sum())} of {len(own)} "
            f"problem-seeds and is the fastest in {first:.0%}; of lmfit's methods "
            f"`{best}` solves most, {solved[best]} of {len(own)}."
        )
    return " ".join(out)


def page(ends: pd.DataFrame, table: pd.DataFrame, meta: dict[str, object]) -> str:
    """The page: what was done, on what machine, figures and table."""
    known: dict[str, float] = meta["best_known"]  # type: ignore[assignment]
    shown = [c for c in COORDINATES if c in set(ends["coordinates"])]
    lines = [
        "| problem | in | method | solved | seconds until solved: median (quartiles) | "
        "misfit over best known: median (worst) | evaluations per second |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in table.to_dict("records"):
        times = [row[f"solved after, {q} (s)"] for q in ("median", "quartile 1", "quartile 3")]
        middle, low, high = (f"{t:.2f}" if np.isfinite(t) else "never" for t in times)
        end = [row[f"misfit over best known at the end, {q}"] for q in ("median", "worst")]
        lines.append(
            f"| {row['problem']} | {row['coordinates']} | {row['method']} "
            f"| {row['solved']} of {row['seeds']} | {middle} ({low}–{high}) "
            f"| {end[0]:.3g} ({end[1]:.3g}) | {row['evaluations per second, median']:.0f} |"
        )
    curves = "\n\n".join(
        f"![Misfit against seconds, {COORDINATES[c]}](identification_{c}.png)" for c in shown
    )
    return PAGE.format(
        again="; `--redraw` draws the recorded runs again",
        count=len(known) * int(meta["seeds"]),  # type: ignore[call-overload]
        problems=len(known),
        budget=meta["budget_s"],
        slopes=SLOPES[str(meta["derivatives"])],
        findings=findings(ends),
        curves=curves,
        shoe=SHOE if "shoe-foam" in known else "",
        table="\n".join(lines),
        **{k: meta[k] for k in
           ("seeds", "processor", "python", "foamfit", "lmfit", "scipy", "numpy", "numba")},
    )  # fmt: skip


def report(runs: pd.DataFrame, meta: dict[str, object], folder: Path) -> None:
    """Write table, page and figures of recorded runs."""
    known: dict[str, float] = meta["best_known"]  # type: ignore[assignment]
    lowest = runs.groupby("problem")["cost"].min()
    meta["best_known"] = {key: min(cost, float(lowest[key])) for key, cost in known.items()}
    ends = solved_after(runs, meta["best_known"])  # type: ignore[arg-type]
    table = tabulate(ends)
    table.to_csv(folder / "identification.csv", index=False, float_format="%.4g")
    (folder / "identification.md").write_text(page(ends, table, meta))
    draw_profiles(ends, meta, folder / "identification_profiles.png")
    for coordinates in COORDINATES:
        if coordinates in set(ends["coordinates"]):
            draw_curves(runs, coordinates, meta, folder / f"identification_{coordinates}.png")
    print(findings(ends))


def _listed(choices: dict[str, object] | tuple[str, ...]) -> Callable[[str], list[str]]:
    """Reader of a list like "impact,chain" for argparse."""

    def read(text: str) -> list[str]:
        given = text.split(",")
        for item in given:
            if item not in choices:
                raise argparse.ArgumentTypeError(f"{item!r} is none of {', '.join(choices)}")
        return given

    return read


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--budget", type=float, default=3.0, help="seconds of a run")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--problems", type=_listed({**CASES}), default=list(CASES))
    parser.add_argument("--methods", type=_listed(METHODS), default=list(METHODS))
    parser.add_argument("--coordinates", type=_listed({**COORDINATES}), default=list(COORDINATES))
    parser.add_argument("--derivatives", choices=list(SLOPES), default="differences")
    parser.add_argument("--redraw", action="store_true", help="draw what was recorded")
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    log, notes = (options.out / f"identification_runs.{end}" for end in ("csv.gz", "json"))
    if options.redraw:
        runs, meta = pd.read_csv(log), json.loads(notes.read_text())
    else:
        runs, meta = run_all(options)
        compression = {"method": "gzip", "mtime": 0}
        runs.to_csv(log, index=False, float_format="%.6g", compression=compression)
        notes.write_text(json.dumps(meta, indent=1) + "\n")
        runs = pd.read_csv(log)  # what is drawn now is what is drawn again
    report(runs, meta, options.out)


if __name__ == "__main__":
    main()
