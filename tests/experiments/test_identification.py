"""The comparison of searches: every method minimises the same cost for the same time."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from conftest import EXPERIMENTS
from foamfit.fitting.problem import Problem

sys.path.insert(0, str(EXPERIMENTS / "identification"))
import identification as study


@pytest.fixture(scope="module")
def problem() -> Problem:
    return study.CASES["displacement"].problem()


@pytest.mark.parametrize("coordinates", list(study.COORDINATES))
@pytest.mark.parametrize("method", ["least_squares", "nelder", "ampgo"])
def test_a_method_lowers_the_cost_until_its_time_is_up(
    method: str, coordinates: str, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock advances a millisecond at each evaluation."""
    ticks, plain = itertools.count(), type(problem.objective).residual
    monkeypatch.setattr("time.process_time", lambda: 1e-3 * next(ticks))
    rows = study.recorded(
        lambda: study.run_lmfit(problem, method, coordinates, 3), problem.objective, 0.2, 0.0
    )
    assert type(problem.objective).residual is plain
    seconds, costs = np.transpose(rows)
    assert np.all(np.diff(seconds) >= 0.0)
    assert np.all(np.diff(costs) <= 0.0)
    assert seconds[-1] == pytest.approx(0.2, abs=0.01)
    assert costs[-1] < costs[0]


@pytest.mark.parametrize("coordinates", list(study.COORDINATES))
def test_the_derivatives_of_the_problem_serve_in_both_coordinates(
    problem: Problem, coordinates: str
) -> None:
    space = problem.space()
    variables = study.Variables(problem, space, coordinates)
    params = variables.params(space.encode(problem.vector()))
    moving = [name for name, parameter in params.items() if parameter.vary]
    sizes = dict.fromkeys(moving, 1.0)
    if coordinates == "si":
        sizes = dict(zip(moving, problem.sizes(tuple(moving), problem.vector()), strict=True))
    for column, name in zip(variables.jacobian(params).T, moving, strict=True):
        sides = []
        for sign in (1.0, -1.0):
            moved = params.copy()
            moved[name].value += sign * 1e-5 * sizes[name]
            sides.append((moved[name].value, variables.residual(moved)))
        (up, high), (down, low) = sides
        expected = (high - low) / (up - down)
        largest = max(float(np.abs(expected).max()), 1e-300)
        np.testing.assert_allclose(column, expected, rtol=0, atol=2e-3 * largest)
