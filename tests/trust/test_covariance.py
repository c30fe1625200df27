"""Autocorrelation, covariance and states, compared with closed-form results."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from conftest import correlated
from foamfit.trust.best_point import growth
from foamfit.trust.covariance import Block, Uncertainty, covariance, half_width, state
from foamfit.trust.residuals import NoiseProcess, autocorrelation_time


def about(value: float, half: float) -> tuple[tuple[float, float], str]:
    return (value - half, value + half), "95 % interval"


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8, 0.9])
def test_autocorrelation_time_of_an_autoregressive_noise(rho):
    """The closed form is τ = (1+ρ)/(1-ρ)."""
    found = np.mean(
        [
            autocorrelation_time(correlated(np.random.default_rng(seed), 4000, rho))
            for seed in range(20)
        ]
    )
    assert found == pytest.approx((1 + rho) / (1 - rho), rel=0.15)


def test_the_degrees_of_freedom_are_the_effective_samples_without_those_of_the_parameters():
    residual = correlated(np.random.default_rng(0), 4000, 0.8)
    found = covariance(np.ones((4000, 1)), residual, (4000,), np.ones(1))
    assert found.freedom == pytest.approx([found.effective - 1.0])
    assert found.effective == pytest.approx(4000 / 9.0, rel=0.2)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_the_error_of_a_line_covers_its_scatter(rho):
    """Offset and slope of a line have a known scatter in white and in correlated noise."""
    x = np.linspace(-1, 1, 800)
    jacobian = np.column_stack([np.ones_like(x), x])
    pull = np.linalg.pinv(jacobian)
    scatter = np.sqrt(np.diag(pull @ toeplitz(rho ** np.arange(x.size)) @ pull.T))
    errors = []
    for seed in range(40):
        y = correlated(np.random.default_rng(seed), x.size, rho)
        residual = y - jacobian @ (pull @ y)
        errors.append(covariance(jacobian, residual, (x.size,), np.ones(2)).stderr)
    assert np.mean(errors, axis=0) == pytest.approx(scatter, rel=0.15)


def test_each_curve_has_its_own_noise():
    rng = np.random.default_rng(3)
    jacobian = np.zeros((2000, 2))
    jacobian[:1000, 0] = jacobian[1000:, 1] = 1.0
    residual = rng.standard_normal(2000)
    residual[1000:] *= 10.0
    spread = covariance(jacobian, residual, (1000, 1000), np.ones(2))
    assert spread.stderr[1] / spread.stderr[0] == pytest.approx(10.0, rel=0.1)


@pytest.mark.parametrize("source", ["shifts", "modes"])
def test_an_error_of_a_held_parameter_or_of_the_motion_is_added(source):
    """A mean of n values, all of which are off by one normal error."""
    rng, n, off = np.random.default_rng(1), 400, 0.3
    residual = rng.standard_normal(n)
    residual -= residual.mean()
    mean, noise = np.ones((n, 1)), NoiseProcess(np.zeros(0), 1.0)
    block = Block(mean, (n,), [noise], np.eye(1), **{source: np.full((n, 1), off)})
    found = Uncertainty((block,), np.ones(1)).covariance
    assert found.stderr[0] == pytest.approx(np.hypot(1.0 / np.sqrt(n), off), rel=1e-3)


def test_the_curvature_is_that_at_the_bottom_of_a_curved_valley():
    """One standard error away the fourth-order term is up to 400 times as large."""
    hessian, steep = np.array([[1.5, 0.2], [0.2, 0.8]]), np.array([2.0, -4.0])
    block = Block(
        np.eye(9, 2), (9,), [NoiseProcess(np.zeros(0), 1.0)], np.eye(2),
        lambda step: hessian @ step + (steep @ step) ** 3 * steep,
    )  # fmt: skip
    found = block.curvature(np.eye(2))
    assert np.linalg.eigvalsh(found) == pytest.approx(np.linalg.eigvalsh(hessian), rel=0.02)


def test_a_direction_without_trace_is_not_a_number():
    x = np.linspace(0, 1, 100)
    jacobian = np.column_stack([x, x, np.ones_like(x)])
    spread = covariance(jacobian, np.sin(40 * x), (100,), np.ones(3))
    assert np.isnan(spread.stderr[:2]).all()
    assert np.isfinite(spread.stderr[2])


def test_the_half_width_is_that_of_students_t():
    assert half_width(2.0, 1e6) == pytest.approx(2 * 1.95996, abs=1e-4)
    assert half_width(1.0, 5.0) == pytest.approx(2.57058, abs=1e-4)


@pytest.mark.parametrize(
    ("half", "value", "expected"),
    [
        (0.1, 1.0, "determined"),
        (0.8, 1.0, "weak"),
        (5.0, 1.0, "not determined"),
        (float("nan"), 1.0, "not determined"),
        (0.1, 0.0, "weak"),
        (1e6, 10.0, "not determined"),
    ],
)
def test_states(half, value, expected):
    assert state("s1_k0", value, about(value, half), 1.0, (0.0, 10.0))[0] == expected
    side = value - 0.1, value + 0.6  # far on one side
    assert state("s1_k0", value, (side, "95 % interval"), 1.0, (0.0, 10.0))[0] == "weak"


def test_the_growth_to_a_further_cycle_is_that_of_predicted_repetitions():
    """400 fits of three cycles with independent model errors, and predictions of a fourth cycle.

    Only the third cycle determines some directions, so that the residuals of its fit are much
    smaller than those of the prediction.
    """
    rng, rows = np.random.default_rng(0), np.arange(80, 120)
    jacobian = rng.standard_normal((120, 12))
    jacobian[:80, :6] *= 0.1
    fitted, told, predicted = 0.0, 0.0, 0.0
    for _ in range(400):
        y, further = rng.standard_normal(120), rng.standard_normal(40)
        best = np.linalg.lstsq(jacobian, y, rcond=None)[0]
        residual = y - jacobian @ best
        square = float(residual[rows] @ residual[rows])
        fitted, told = fitted + square, told + square * (1.0 + growth(jacobian, residual, rows))
        predicted += float(np.sum((further - jacobian[rows] @ best) ** 2))
    assert told == pytest.approx(predicted, rel=0.1)
    assert predicted > 1.3 * fitted
