"""The look ahead at tests of springs that are not bistable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import foamfit as ff
from foamfit.cli import main
from foamfit.errors import SimulationError
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import make_problem
from foamfit.report.outlook import start_values

SPRING = ff.MicroscaleSpring(4.4e5, 4.9e5, 0.29, 1.06e5, 0.44, 6e4, 0.7, relaxation=[(0.5, 0.3)])


@pytest.fixture
def slow_test(tmp_path: Path) -> Path:
    """A triangle of two seconds to 60 %, with noise on its stress."""
    time = np.linspace(0.0, 2.0, 201)
    strain = 0.6 * (1.0 - np.abs(time - 1.0))
    chain = ff.Chain([SPRING], [0.01], 5e-5)
    stress = ff.simulate(chain, ff.DisplacementDrive(0.01 * strain), time).base_stress
    stress += 500.0 * np.random.default_rng(0).standard_normal(time.size)
    path = tmp_path / "slow.csv"
    np.savetxt(
        path, np.column_stack([time, 10.0 * strain, stress]), "%.9g", ",", comments="",
        header="time (s),displacement (mm),stress (Pa)",
    )  # fmt: skip
    path.with_suffix(".toml").write_text('[specimen]\nheight = "10 mm"\narea = "50 mm^2"\n')
    return path


def test_a_microscale_spring_that_relaxes_is_looked_at_ahead(slow_test: Path) -> None:
    args = ["check", str(slow_test), "--model", "microscale", "--relaxation", "1"]
    done = CliRunner().invoke(main, args)
    assert done.exit_code == 0, done.output
    words = " ".join(done.stdout.split())
    assert "microscale with 1 relaxation term, displacement drive" in words
    assert "of the micro-springs of spring 1 snap, and it snaps back" in words
    for name in ("s1_spread_plus", "s1_g1", "s1_tau1"):
        assert name in words


def test_relaxation_without_a_model_is_refused(slow_test: Path) -> None:
    done = CliRunner().invoke(main, ["check", str(slow_test), "--relaxation", "1"])
    assert done.exit_code == 1
    assert "--relaxation needs --model" in done.stderr


def test_what_cannot_be_simulated_is_refused_with_its_reason(
    slow_test: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise SimulationError("these springs cannot be simulated so")

    problem = make_problem(ff.read_test(slow_test), "microscale", None, None, None, False)
    monkeypatch.setattr(Objective, "simulate", fail)
    with pytest.raises(SimulationError, match="these springs cannot be simulated so"):
        start_values(problem)
