"""Misfit reached against seconds: the project's own search and eight methods of lmfit.

Question. How many problems does a method solve in a few seconds, and how fast?

Method. Every method minimises the same residual (`fitting.objective.Objective`) of the same
problems and is stopped after the same time. What is recorded is the lowest cost so far against the
processor time of the one thread that runs, which on an idle machine is the elapsed time. A local
method starts at a random point of the search's box (`fitting.search.box_starts`, drawn from the
seed) and starts again from the next one until the time is up; a global method that ends does so
too; and so does `foamfit.fit`, with another seed. A run also ends once its cost is within 0.1 % of
the best known, where nothing is left to gain. The eight methods are run twice: in the
`lmfit.Parameters` of `foamfit.make_params` (SI values and bounds, what a user of lmfit would
write), and in the coordinates of the project's own search, in which every point is admissible.

Answer. `foamfit.fit` solves all problems in 3 s; see identification.md.

    python experiments/error_vs_runtime/identification.py           # at most 35 min of one core
    python experiments/error_vs_runtime/identification.py --budget 1 --seeds 2
    python experiments/error_vs_runtime/identification.py --redraw  # figures and tables only

Writes identification_runs.csv.gz (every improvement by more than 2 %, and when a problem was
solved) and identification_runs.json (machine, versions, arguments) after each problem; then
identification.csv, .md and figures. FOAMFIT_DATA names the folder of the measurements by others;
without it the shoe foam is left out.
"""

# ruff: noqa: E402  (the number of threads is read when NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # one thread for all, so that processor time is elapsed time

import argparse
import platform
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import identification_report as told
import lmfit
import numpy as np
import pandas as pd
from identification_report import METHODS, OWN, SOLVED, Array, Setup, studies
from numpy.typing import NDArray

import foamfit as ff
from foamfit.fitting.box import Space
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import box_starts

HERE = Path(__file__).parent
GZIP = {"method": "gzip", "mtime": 0}
ENOUGH = 1.001  # cost over the best known at which a run ends
RECORDED = 0.98  # cost over the last recorded one below which it is recorded


# ---------------------------------------------------------------- problems


@dataclass(frozen=True)
class Case:
    """What is to be identified: a test file, a model and a drive."""

    title: str
    file: str  # from experiments/, or from FOAMFIT_DATA where `specimen` is given
    model: str
    drive: str
    specimen: tuple[str, str] | None = None  # height and diameter

    def problem(self) -> Problem:
        """Read the test and make the problem ready, as `foamfit.fit` does."""
        return make_problem(self.read(), self.model, self.drive, None, None, False)

    def read(self) -> ff.Measurement:
        """Read the test."""
        if self.specimen is None:
            return ff.read_test(HERE.parent / self.file)
        with tempfile.TemporaryDirectory() as folder:
            toml = studies.write_specimen(Path(folder) / "specimen.toml", *self.specimen, "")
            return ff.read_test(studies.measurements() / self.file, toml)


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
        ("10.53 mm", "7.63 mm"),
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
    known : float
        Best known cost; near it the run is over too.
    """

    objective: Objective
    budget: float
    known: float
    cost: float = np.inf
    values: Array | None = None
    evaluations: int = 0
    rows: list[tuple[float, int, float]] = field(default_factory=list)
    began: float = field(default_factory=lambda: time.process_time())
    ended: float = np.nan

    def count(self) -> float:
        """Count an evaluation of a residual or of its derivative; returns the seconds so far.

        Raises
        ------
        RunOver
            When the time is up.
        """
        seconds = time.process_time() - self.began
        if seconds > self.budget:
            raise RunOver
        self.evaluations += 1
        return seconds

    def note(self, objective: Objective, values: Array, residual: Array) -> None:
        """Take down an evaluation.

        Raises
        ------
        RunOver
            When the run is over.
        """
        seconds = self.count()
        if objective.measurement is self.objective.measurement:
            cost = float(residual @ residual)
            if cost < self.cost:
                self.cost, self.values = cost, values.copy()
                last = self.rows[-1][2] if self.rows else np.inf
                if cost < RECORDED * last or cost <= SOLVED * self.known < last:
                    self.rows.append((seconds, self.evaluations, cost))
        if self.cost <= ENOUGH * self.known:
            raise RunOver

    def finished(self) -> list[tuple[float, int, float]]:
        """Rows of the run, the last one at its end.

        Raises
        ------
        RuntimeError
            If the recorded cost is not that of the recorded point: the method minimised another
            function than the others.
        """
        if self.values is not None:
            residual = self.objective.residual(self.values)
            if not np.isclose(float(residual @ residual), self.cost, rtol=1e-6):
                raise RuntimeError("the method did not minimise the cost of the problem")
        return [*self.rows, (min(self.ended, self.budget), self.evaluations, self.cost)]


@contextmanager
def recorded(recorder: Recorder) -> Iterator[None]:
    """Have every residual of any objective noted, and its derivatives counted.

    Ends quietly when the run is over.
    """
    plain, derivative = Objective.residual, Objective.jacobian

    def residual(self: Objective, values: Array, shift: Array | float = 0.0) -> Array:
        out = plain(self, values, shift)
        recorder.note(self, values, out)
        return out

    def jacobian(self: Objective, values: Array, places: NDArray[np.int64]) -> Array:
        out = derivative(self, values, places)
        recorder.count()
        return out

    Objective.residual = residual  # type: ignore[method-assign]
    Objective.jacobian = jacobian  # type: ignore[method-assign]
    try:
        yield
    except RunOver:
        pass
    finally:
        Objective.residual = plain  # type: ignore[method-assign]
        Objective.jacobian = derivative  # type: ignore[method-assign]


def run_own(case: Case, problem: Problem, seed: int) -> None:
    """Fit by the project's own search, over and over with other seeds."""
    for again in range(1000):
        ff.fit(
            problem.measurement, model=case.model, drive=case.drive, seed=1000 * seed + again,
            intervals="local",
        )  # fmt: skip


def random_points(space: Space, rng: np.random.Generator) -> Iterator[Array]:
    """Points of the box, without end; the same ones for every method of the same seed."""
    while True:
        yield from box_starts(space, rng, 32)


@dataclass(frozen=True)
class Variables:
    """What a method of lmfit varies, and the way from there to the problem's flat vector.

    Parameters
    ----------
    problem : Problem
        The problem.
    space : Space
        Its box.
    coordinates : str
        "si" or "box".
    """

    problem: Problem
    space: Space
    coordinates: str

    def params(self, point: Array) -> lmfit.Parameters:
        """Parameters at a point of the box, off their bounds, where least_squares wants them."""
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
        """Residual of the problem."""
        return self.problem.objective.residual(self._vector(params))

    def jacobian(self, params: lmfit.Parameters) -> Array:
        """Derivative of the residual by what varies, (n_data, n_free)."""
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
        if self.coordinates == "box":
            return self.space.decode(_values(params))
        return self.problem.vector(params)

    def _free(self, values: Array) -> Array:
        return values[[self.problem.index[name] for name in self.problem.free()]]


def _values(params: lmfit.Parameters) -> Array:
    return np.array([parameter.value for parameter in params.values()])


def run_lmfit(problem: Problem, method: str, coordinates: str, seed: int, derivatives: str) -> None:
    """Minimise by a method of lmfit, over and over from other points of the box."""
    variables = Variables(problem, problem.space(), coordinates)
    rng = np.random.default_rng(seed)
    for point in random_points(variables.space, rng):
        options = _options(method, int(rng.integers(2**31)))
        if method in told.LEAST_SQUARES and derivatives == "problem":
            options |= {"Dfun" if method == "leastsq" else "jac": variables.jacobian}
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of lmfit's covariances, which nobody reads here
            try:
                lmfit.minimize(
                    variables.residual, variables.params(point), method=method, calc_covar=False,
                    max_nfev=10**9, **options,
                )  # fmt: skip
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
    for seed in range(9000, 9003):
        result = ff.fit(
            problem.measurement, model=case.model, drive=case.drive, seed=seed, starts=96,
            intervals="local",
        )  # fmt: skip
        residual = problem.objective.residual(problem.vector(result.params))
        costs.append(float(residual @ residual))
    return min(costs)


def run_all(options: argparse.Namespace, log: Path, notes: Path) -> None:
    """Run every method on every problem and seed; writes what was run after each problem."""
    names = ("foamfit", "lmfit", "scipy", "numpy", "numba")
    where = f"{studies.processor()}, {os.cpu_count()} cores, {platform.machine()}"
    machine = {"processor": where, **studies.versions(*names)}
    setup = Setup(machine, options.budget, options.seeds, options.derivatives, {}, {})
    frames: list[pd.DataFrame] = []
    ways = [("own", OWN), *((c, m) for c in options.coordinates for m in options.methods)]
    for key in options.problems:
        case = CASES[key]
        if case.specimen is not None and not os.environ.get("FOAMFIT_DATA"):
            print(f"{key}: left out, FOAMFIT_DATA names no folder of measurements")
            continue
        problem = case.problem()
        known = best_known(case, problem)
        print(f"{key}: best known cost {known:.6g} of {problem.objective.n_data} samples")
        for coordinates, method in ways:
            ended = []
            for seed in range(options.seeds):
                recorder = Recorder(problem.objective, options.budget, known)
                with recorded(recorder):
                    if method == OWN:
                        run_own(case, problem, seed)
                    else:
                        run_lmfit(problem, method, coordinates, seed, options.derivatives)
                recorder.ended = time.process_time() - recorder.began
                rows = [(key, coordinates, method, seed, *row) for row in recorder.finished()]
                frames.append(pd.DataFrame(rows, columns=told.COLUMNS))
                ended.append(f"{recorder.cost / known:.3g}")
            print(
                f"  {coordinates:4} {method:24} cost over best known: {' '.join(ended)}", flush=True
            )
        setup.titles[key], setup.known[key] = case.title, known
        pd.concat(frames).to_csv(log, index=False, float_format="%.5g", compression=GZIP)
        setup.write(notes)


def _listed(choices: Iterable[str]) -> Callable[[str], list[str]]:
    """Read a list like "impact,chain" for argparse."""

    def read(text: str) -> list[str]:
        for item in text.split(","):
            if item not in choices:
                raise argparse.ArgumentTypeError(f"{item!r} is none of {', '.join(choices)}")
        return text.split(",")

    return read


def main() -> None:
    parser = studies.arguments(__doc__, HERE, budget=(3.0, "seconds of a run"), seeds=10)
    for name, choices in {
        "problems": CASES, "methods": METHODS, "coordinates": told.COORDINATES,
    }.items():  # fmt: skip
        parser.add_argument(f"--{name}", type=_listed(choices), default=list(choices))
    parser.add_argument("--derivatives", choices=list(told.SLOPES), default="differences")
    parser.add_argument("--redraw", action="store_true", help="draw what was recorded")
    options = parser.parse_args()
    log, notes = (options.out / f"identification_runs.{end}" for end in ("csv.gz", "json"))
    if not options.redraw:
        run_all(options, log, notes)
    if not log.exists():
        raise SystemExit(f"nothing was run: there is no {log}")
    told.report(pd.read_csv(log), Setup.read(notes), options.out)


if __name__ == "__main__":
    studies.run(main, HERE)
