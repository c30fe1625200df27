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
