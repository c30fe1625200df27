"""The objective: what is counted, how it is scaled, and what a failure costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import synthetic_impact, synthetic_loop
from foamfit.measurement import Noise
from foamfit.model import Model
from foamfit.objective import (
    PENALTY,
    Objective,
    check_drive,
    choose_drive,
    default_weights,
)

BISTABLE = Model.parse("bistable")


def values_of(spring: ff.BistableSpring) -> np.ndarray:
    return np.array([*spring.seven, spring.eta, 0.0])


def objective(measurement, drive="impact", weights=None):
    return Objective(measurement, BISTABLE, drive, weights or default_weights(measurement, drive))


def test_the_true_parameters_leave_nothing_without_noise():
    spring, measurement = synthetic_impact(noise=0.0)
    assert np.max(np.abs(objective(measurement).residual(values_of(spring)))) < 1e-12


def test_residuals_in_units_of_stated_noise_have_unit_variance():
    spring, measurement = synthetic_impact()
    residual = objective(measurement).residual(values_of(spring))
    assert np.std(residual) == pytest.approx(1.0, abs=0.1)


def test_without_noise_the_scale_is_the_range():
    spring, measurement = synthetic_impact()
    plain = replace(measurement, noise=Noise())
    residual = objective(plain).residual(values_of(spring))
    n = measurement.time.size
    simulated = objective(plain).simulate(values_of(spring))
    expected = (simulated.stress_time - plain.stress) / np.ptp(plain.stress)
    np.testing.assert_allclose(residual[:n], expected, rtol=1e-14)
    assert residual.size == 2 * n


def test_a_weight_multiplies_squares():
    spring, measurement = synthetic_impact()
    one = objective(measurement, weights={"stress_time": 1.0}).residual(values_of(spring))
    four = objective(measurement, weights={"stress_time": 4.0}).residual(values_of(spring))
    assert four @ four == pytest.approx(4 * (one @ one), rel=1e-12)


def test_each_channel_is_counted_once():
    _, impact = synthetic_impact()
    assert objective(impact).counted == ("stress_time", "displacement_time")
    integrated = replace(impact, motion="integrated from force")
    assert objective(integrated).counted == ("stress_time",)
    assert objective(impact, "displacement").counted == ("stress_strain",)
    assert objective(impact, "stress").counted == ("displacement_time",)


def test_failures_cost_a_finite_penalty_and_are_counted():
    spring, measurement = synthetic_impact()
    plain = objective(replace(measurement, noise=Noise()))
    bad = values_of(spring)
    bad[2] = 1.0  # dsigma > 0
    assert np.all(plain.residual(bad) == PENALTY)
    assert (plain.evaluations, plain.failures) == (1, 1)
    worst = plain.residual(values_of(spring))
    assert np.max(np.abs(worst)) < PENALTY


def test_the_stress_strain_misfit_runs_along_the_measured_displacement():
    spring, measurement = synthetic_loop()
    one = objective(measurement, "displacement")
    misfit = one.misfit(one.simulate(values_of(spring), everything=True))
    assert misfit["stress_time"] is None
    assert misfit["displacement_time"] is None
    along = spring.stress(measurement.displacement / measurement.specimen.height)
    expected = np.sqrt(np.mean((along - measurement.stress) ** 2)) / np.ptp(measurement.stress)
    assert misfit["stress_strain"] == pytest.approx(expected, rel=1e-12)


def test_the_jacobian_agrees_with_the_law_in_closed_form():
    """In the displacement drive dσ/dk0 on branch a is ε/(1-ε), on branch d is ε_a/(1-ε_a)."""
    spring, measurement = synthetic_loop()
    one = objective(measurement, "displacement")
    values = values_of(spring)
    steps = 1e-6 * np.abs(values)
    column = one.jacobian(values, steps, np.array([0]))[:, 0] * np.ptp(measurement.stress)
    strain = measurement.displacement / measurement.specimen.height
    up = np.arange(strain.size) < 200
    on_a = up & (strain < 0.13)
    on_d = up & (strain > 0.15) & (strain < 0.33)
    np.testing.assert_allclose(
        column[on_a], strain[on_a] / (1 - strain[on_a]), rtol=1e-6, atol=1e-9
    )
    np.testing.assert_allclose(column[on_d], 0.14 / 0.86, rtol=1e-6)


def test_the_drive_is_chosen_by_what_the_test_has():
    _, impact = synthetic_impact()
    _, loop = synthetic_loop()
    assert choose_drive(impact) == "impact"
    assert choose_drive(replace(impact, striker=None)) == "displacement"
    assert choose_drive(loop) == "displacement"
    with pytest.raises(ff.InputError, match="no drive is possible"):
        choose_drive(replace(loop, displacement=None))


@pytest.mark.parametrize(
    ("drive", "missing"),
    [("impact", "time column and \\[striker\\] mass"), ("sideways", "unknown")],
)
def test_a_drive_that_the_test_cannot_feed_is_refused(drive, missing):
    _, loop = synthetic_loop()
    with pytest.raises(ff.InputError, match=missing):
        check_drive(loop, drive)


def test_unknown_and_negative_weights_are_refused():
    _, loop = synthetic_loop()
    for weights in ({"stress": 1.0}, {"stress_strain": -1.0}, {"stress_strain": 0.0}):
        with pytest.raises(ff.InputError):
            objective(loop, "displacement", weights)


def test_an_unknown_spring_in_a_model_is_refused():
    with pytest.raises(ff.InputError, match="'elastic' is not a spring"):
        Model.parse("linear+elastic")
