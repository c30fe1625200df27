"""The runs of experiments/error_vs_runtime/identification.py: clock, arithmetic, and redrawing."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from conftest import EXPERIMENTS
from foamfit.fitting.problem import Problem

sys.path.insert(0, str(EXPERIMENTS / "error_vs_runtime"))

import identification

FILES = {
    "identification.md",
    "identification_runs.csv.gz",
    "identification_runs.json",
    "identification_si.png",
}


def test_a_run_is_solved_at_its_first_cost_within_five_percent() -> None:
    rows = [(0.1, 5, 9.0), (0.2, 9, 1.04), (0.3, 12, 1.0)]
    start = ("p", "si", "powell", 0)
    runs = pd.DataFrame([(*start, *row) for row in rows], columns=identification.COLUMNS)
    assert identification.solved_after(runs, {"p": 1.0})["solved_after_s"].tolist() == [0.2]
    assert identification.solved_after(runs[:1], {"p": 1.0})["solved_after_s"].tolist() == [np.inf]


@pytest.fixture(scope="module")
def problem() -> Problem:
    return identification.CASES["displacement"].problem()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the clock by one that advances a millisecond at each reading."""
    ticks = itertools.count()
    monkeypatch.setattr("time.process_time", lambda: 1e-3 * next(ticks))


@pytest.mark.parametrize("coordinates", list(identification.COORDINATES))
@pytest.mark.parametrize("method", identification.METHODS)
def test_every_method_lowers_the_same_cost_until_its_time_is_up(
    method: str, coordinates: str, problem: Problem, clock: None
) -> None:
    plain = type(problem.objective).residual
    recorder = identification.Recorder(problem.objective, 0.4, known=0.0)
    with identification.recorded(recorder):
        identification.run_lmfit(problem, method, coordinates, 3)
    assert type(problem.objective).residual is plain
    recorder.ended = 0.4
    seconds, evaluations, costs = np.transpose(recorder.finished())
    assert np.all(np.diff(seconds) >= 0.0)
    assert np.all(np.diff(costs) <= 0.0)
    assert evaluations[-1] == pytest.approx(400, abs=2)
    assert costs[-1] < costs[0]


def test_a_run_ends_where_nothing_is_left_to_gain(problem: Problem, clock: None) -> None:
    case = identification.CASES["displacement"]
    recorder = identification.Recorder(problem.objective, np.inf, known=1e9)
    with identification.recorded(recorder):
        identification.run_own(case, problem, seed=0)
    assert recorder.cost <= identification.ENOUGH * 1e9
    assert recorder.rows[-1][2] == recorder.cost  # the last row records the solution


@pytest.mark.parametrize("coordinates", list(identification.COORDINATES))
def test_the_derivatives_of_the_problem_serve_in_both_coordinates(
    problem: Problem, coordinates: str
) -> None:
    space = problem.space()
    point = space.encode(problem.vector())
    variables = identification.Variables(problem, space, coordinates)
    params = variables.params(point)
    jacobian = variables.jacobian(params)
    moving = [name for name, parameter in params.items() if parameter.vary]
    rows = problem.objective.n_data + len(problem.objective.priors)
    assert jacobian.shape == (rows, len(moving))
    for column, name in enumerate(moving):
        sides = []
        for sign in (1.0, -1.0):
            moved = params.copy()
            scale = 1.0 if coordinates == "box" else problem.sizes((name,), problem.vector())[0]
            value = abs(params[name].value)
            size = value if value > 1e-9 * scale else float(scale)  # 0 is a rounding error off
            moved[name].value += sign * 1e-5 * size
            sides.append((moved[name].value, variables.residual(moved)))
        (up, high), (down, low) = sides
        expected = (high - low) / (up - down)
        largest = max(float(np.abs(expected).max()), 1e-300)
        np.testing.assert_allclose(jacobian[:, column], expected, rtol=0, atol=2e-3 * largest)


def test_what_was_recorded_is_drawn_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    short = ["--budget", "0.05", "--seeds", "2", "--methods", "leastsq", "powell"]
    short += ["--coordinates", "si"]
    out = ["identification.py", "--out", str(tmp_path), "--problems", "displacement"]
    monkeypatch.setattr(sys, "argv", [*out, *short])
    monkeypatch.setattr(identification, "best_known", lambda *_: 5155.0)
    identification.main()
    assert "foamfit.fit" in capsys.readouterr().out
    assert "| foamfit.fit | own |" in (tmp_path / "identification.md").read_text()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == FILES
    for name in FILES - {"identification_runs.csv.gz", "identification_runs.json"}:
        (tmp_path / name).unlink()
    monkeypatch.setattr(sys, "argv", ["identification.py", "--redraw", "--out", str(tmp_path)])
    identification.main()
    again = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert again == before
