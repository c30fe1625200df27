"""Run scenes without compilation, count the operations of the compiled loops, and print JSON.

`tests/test_counting.py` runs `NUMBA_DISABLE_JIT=1 python tests/counted.py`. The loops need no
changes: springs and masses are arrays that count reads of their entries, dashpots are numbers that
count the arithmetic done with them, and `sys.setprofile` and `sys.settrace` observe every call and
every line.
"""

from __future__ import annotations

import functools
import json
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import foamfit as ff
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.fitting.problem import make_params, make_problem
from foamfit.fitting.search import Tracker
from foamfit.solve.explicit import taylor
from foamfit.solve.plan import plan
from foamfit.springs import kernels
from foamfit.springs.chain import Drive

COUNTS: Counter[str] = Counter()
PACKAGE = Path(ff.__file__).parent


@functools.cache
def _module(filename: str) -> str:
    """Return the name of the project's module in a file, or "" for any other file."""
    path = Path(filename)
    return path.stem if path.is_relative_to(PACKAGE) else ""


def _caller() -> str:
    """Return the project's module that is being executed."""
    frame: Any = sys._getframe(1)
    while not _module(frame.f_code.co_filename):
        frame = frame.f_back
    return _module(frame.f_code.co_filename)


class Counted(np.float64):
    """A number that counts the arithmetic done with it (comparisons are not counted)."""

    tag = "dashpot arithmetic"

    def _note(self) -> np.float64:
        COUNTS[f"{self.tag} in {_caller()}"] += 1
        return np.float64(self)


class CountedDrag(Counted):
    """The onsite damper, counted separately."""

    tag = "onsite arithmetic"


def _counting(name: str) -> Any:
    method = getattr(np.float64, name)
    return lambda self, other: method(self._note(), np.float64(other))


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv"):
    setattr(Counted, f"__{_name}__", _counting(f"__{_name}__"))


class Springs(np.ndarray):
    """Rows of springs that count the reads of each column, by kind of spring."""

    def __getitem__(self, key: Any) -> Any:
        value = super().__getitem__(key)
        if self.ndim == 1 and self.size == kernels.N_COLUMNS and np.ndim(value) == 0:
            return _read(np.asarray(self), key, value)
        if self.ndim == 2 and isinstance(key, tuple):
            for row in np.atleast_2d(np.asarray(self)[key[0]]):
                last = _read(row, key[1], value)
            return last if np.ndim(value) == 0 else np.asarray(value)
        return value


def _read(row: Any, column: Any, value: Any) -> Any:
    kind = "bistable" if row[kernels.KIND] == kernels.BISTABLE else "linear"
    for one in np.arange(kernels.N_COLUMNS)[column].ravel():
        law = one not in (kernels.KIND, kernels.K0, kernels.ETA)
        COUNTS[f"{kind}: {'law' if law else 'other'} columns read in {_caller()}"] += 1
    return Counted(value) if np.ndim(value) == 0 and column == kernels.ETA else value


class Masses(np.ndarray):
    """Areal masses that count how often they are read."""

    def __getitem__(self, key: Any) -> Any:
        COUNTS["masses read"] += 1
        return super().__getitem__(key)


class Numbers(np.ndarray):
    """The array of scalar inputs of the explicit steps; the onsite damper comes first."""

    def __getitem__(self, key: Any) -> Any:
        value = super().__getitem__(key)
        return CountedDrag(value) if key == 0 else value


def integrate(*given: Any) -> Any:
    """Take explicit steps and count the use of the onsite damper."""
    return _integrate(*given[:4], given[4].view(Numbers), *given[5:])


_integrate, taylor.integrate = taylor.integrate, integrate


# Dashpots are stored in the rows of their springs, so the lines that compute with them are counted.
DASHPOT = re.compile(r"[*/] *\(?[\w.]*(rows\[\w+, ETA|law\[\w+, DASHPOT)|, (ETA|DASHPOT)\] *[*/]")


@functools.cache
def _dashpot_lines(filename: str) -> frozenset[int]:
    """Return the line numbers of a project module that compute with a dashpot."""
    lines = Path(filename).read_text().splitlines() if _module(filename) else []
    return frozenset(n for n, line in enumerate(lines, start=1) if DASHPOT.search(line))


def tracer(frame: Any, event: str, _: Any) -> Any:
    """Count the executed lines that compute with a dashpot."""
    lines = _dashpot_lines(frame.f_code.co_filename)
    if not lines or _module(frame.f_code.co_filename) in ("steps", "control", "rates"):
        return None
    if event == "line" and frame.f_lineno in lines:
        COUNTS["dashpot lines"] += 1
    return tracer


def profiler(frame: Any, event: str, _: Any) -> None:
    """Count the calls of the project's functions by module, and evaluations of the law by kind."""
    module = _module(frame.f_code.co_filename) if event == "call" else ""
    if not module:
        return
    name = frame.f_code.co_name
    COUNTS[f"calls in {module}"] += 1
    if name == "_expand_tangent":
        COUNTS["tangents expanded"] += 1
    if name in ("stress_on", "strain_on", "slope_on", "branch_shape"):
        arguments = frame.f_locals
        bistable = arguments["row"][kernels.KIND] == kernels.BISTABLE
        of_law = arguments["branch"] in (kernels.A, kernels.D, kernels.C, kernels.E)
        kind = "bistable" if bistable else "linear"
        COUNTS[f"{kind}: {'law' if of_law else 'line'} evaluated"] += 1


def run(chain: ff.Chain, drive: Drive, t: np.ndarray) -> dict[str, Any]:
    """Return the counts of one run, the sizes of the state, and the number of steps."""
    made = plan(chain, drive, t)
    made = made._replace(mass=made.mass.view(Masses))
    rows = np.array([spring.row for spring in chain.springs]).view(Springs)
    COUNTS.clear()
    sys.setprofile(profiler)
    sys.settrace(tracer)
    try:
        with np.errstate(all="ignore"):
            motion = made.run(rows, np.array(chain.heights), drag=CountedDrag(made.drag))
    finally:
        sys.setprofile(None)
        sys.settrace(None)
    return {
        **COUNTS,
        "solver": made.solver,
        "nodes with a state": int(made.mass.size),
        "ends": made.ends.tolist(),
        "steps": int(motion.steps),
    }


SOME = ("s1_eta", "s1_kc", "s1_eps_c")
OTHERS = ("s1_k0", "s1_dsigma", "s1_eps_a", "s1_kh_plus", "s1_kh_minus")


KNOWN = ("contact_time", "displacement_zero")


def slopes(held: tuple[str, ...], way: str) -> dict[str, Any]:
    """Return the counts and columns of one residual derivative with some parameters fixed.

    `way` selects the derivative of the refinement ("fit") or of the search ("search"), or only the
    residual ("none").
    """
    spring, height, area = ff.published["foam-1/model-1"].bistable, 1.19e-3, 1.9635e-5
    time = np.linspace(0.0, 0.75e-3, 21)
    response = ff.simulate(ff.Chain([spring], [height], area), ff.Impact(7e-3, 2.0), time)
    test = Measurement(
        name="synthetic", path=None, data_sha256="", time=time, stress=response.base_stress,
        displacement=response.displacement[-1], specimen=Specimen(height, area),
        striker=Striker(7e-3, 2.0), noise=Noise(1e4, 1e-6), motion="measured",
    )  # fmt: skip
    params = make_params(test)
    for name, value in zip(params, [*spring.seven, 20.0, 0.0], strict=False):
        params[name].value = value
    for one in params.values():
        one.vary = one.vary and one.name not in held
    problem = make_problem(test, "bistable", "impact", params, None, False)
    values = problem.vector()
    tracker, space = Tracker(problem.objective), problem.space()
    COUNTS.clear()
    sys.setprofile(profiler)
    try:
        if way == "fit":
            columns = problem.slopes(values, problem.free())
        elif way == "search":
            point = space.encode(values)
            there = space.decode(point)
            columns = problem.objective.jacobian_along(there, space.slopes(point, there))
        else:
            columns = tracker.residual(values)[:, None][:, :0]
    finally:
        sys.setprofile(None)
    places = np.array([problem.index[name] for name in problem.free()])
    carried = problem.objective.simulate(values, places=places).slopes or {}
    return {
        "tangents expanded": COUNTS["tangents expanded"],
        "columns": columns.shape[1],
        "carried": {name: len(rows) for name, rows in carried.items()},
    }


def main() -> None:
    t = np.linspace(0.0, 0.8e-3, 41)
    spring, area = ff.published["foam-1/model-2"].bistable, 1.9635e-5
    damped = ff.BistableSpring(*spring.seven, eta=50.0)
    line = ff.LinearSpring(60e6)
    impact = ff.Impact(7e-3, 2.0)
    load = 4e6 * np.sin(np.pi * t / t[-1]) ** 2
    stress = ff.StressDrive(load)
    shift = ff.DisplacementDrive(4e-4 * np.sin(np.pi * t / t[-1]) ** 2)
    three, h3 = [line, spring, line], [4e-4, 6e-4, 2e-4]
    made = {
        "linear, impact": (ff.Chain([line], [1e-3], area), impact),
        "linear, stress": (ff.Chain([line], [1e-3], area), stress),
        "linear, displacement": (ff.Chain([line], [1e-3], area), shift),
        "mixed, impact": (ff.Chain(three, h3, area), impact),
        "mixed, impact, one mass": (ff.Chain(three, h3, area, [3e-3, 0.0, 0.0]), impact),
        "mixed, impact, two masses": (ff.Chain(three, h3, area, [3e-3, 3e-3, 0.0]), impact),
        "mixed, stress": (ff.Chain(three, h3, area), stress),
        "mixed, displacement": (ff.Chain(three, h3, area), shift),
        "bistable, impact": (ff.Chain([spring], [1.19e-3], area), impact),
        "bistable, impact, dashpot": (ff.Chain([damped], [1.19e-3], area), impact),
        "bistable, impact, onsite": (
            ff.Chain([spring], [1.19e-3], area, site_damping=50.0),
            impact,
        ),
        "bistable, displacement": (ff.Chain([spring], [1.19e-3], area), shift),
        "bistable, stress": (ff.Chain([spring], [1.19e-3], area), stress),
        "bistable, stress, dashpot": (ff.Chain([damped], [1.19e-3], area), stress),
    }
    scenes = {name: run(chain, drive, t) for name, (chain, drive) in made.items()}
    sensitivities = {
        f"{way}, {len(held)} held": slopes(held + KNOWN, way)
        for held in ((), SOME, OTHERS)
        for way in ("none", "fit", "search")
    } | {f"{way}, contact unknown": slopes((), way) for way in ("fit", "search")}
    print(json.dumps({"scenes": scenes, "sensitivities": sensitivities}))


if __name__ == "__main__":
    main()
