"""Common value of several estimates with errors, and their spread."""

import numpy as np
import pytest
from scipy import stats

from foamfit.trust.joint_point import common_and_spread, correlation


def test_equal_errors_leave_what_the_text_books_have():
    values = np.array([1.0, 2.0, 4.0, 4.5, 6.0])
    found = common_and_spread(values, 0.3**2 * np.eye(5))
    variance = np.var(values, ddof=1)
    assert found.mean == pytest.approx(3.5)
    assert found.tau == pytest.approx(np.sqrt(variance - 0.09), rel=1e-5)
    assert found.stderr == pytest.approx(np.sqrt(variance / 5))
    half = stats.t.ppf(0.975, 4) * found.stderr
    assert found.ci95 == pytest.approx((3.5 - half, 3.5 + half))
    ends = [np.sqrt(4 * variance / stats.chi2.ppf(p, 4) - 0.09) for p in (0.975, 0.025)]
    assert found.tau_ci95 == pytest.approx(ends)
    # the variance of τ² is 2 (τ² + σ²)²/(n-1)
    assert found.tau_stderr == pytest.approx(variance * np.sqrt(2 / 4) / (2 * found.tau), rel=1e-4)


def test_an_error_that_all_have_in_common_is_no_spread_but_one_of_the_mean():
    values, own = np.array([1.0, 1.3, 0.7, 1.1, 0.9]), 0.1**2 * np.eye(5)
    alone, common = common_and_spread(values, own), common_and_spread(values, own + 0.5**2)
    assert common.tau == pytest.approx(alone.tau, rel=1e-3)
    assert common.mean == pytest.approx(alone.mean)


@pytest.mark.parametrize("tau", [0.0, 0.1, 1.0])
def test_intervals_hold(tau):
    """About 95 % (± 3 % by chance) of 200 groups of 8 estimates with unequal errors."""
    rng, hits = np.random.default_rng(1), []
    for _ in range(200):
        errors = 0.1 * np.exp(0.5 * rng.standard_normal(8))
        values = 2.0 + tau * rng.standard_normal(8) + errors * rng.standard_normal(8)
        one = common_and_spread(values, np.diag(errors**2))
        low, high = one.tau_ci95
        hits.append([one.ci95[0] <= 2.0 <= one.ci95[1], low <= tau <= high])
    mean, spread = np.mean(hits, axis=0)
    assert 0.92 < mean < 0.98
    assert 0.92 < spread < (0.98 if tau else 1.0)


def specimens(n, seed, errors=0.0):
    """Return three parameters of n specimens and their true correlation matrix.

    The first two parameters have a correlation of -0.9.
    """
    truth = np.array([[1.0, -0.9, 0.0], [-0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(seed)
    drawn = rng.multivariate_normal(np.zeros(3), truth, n)
    # the first two parameters share an error, as stiffness and onset do
    return drawn + errors * rng.standard_normal((n, 1)) * np.array([1.0, 1.0, 0.0]), truth


def test_many_specimens_show_how_parameters_vary_together():
    values, truth = specimens(2000, 0)
    np.testing.assert_allclose(correlation(values, np.zeros((3, 3))), truth, atol=0.05)


def test_the_errors_of_the_estimates_are_no_correlation_between_specimens():
    values, truth = specimens(4000, 1, errors=1.0)
    errors = np.zeros((3, 3))
    errors[:2, :2] = 1.0
    assert correlation(values, np.zeros((3, 3)))[0, 1] > -0.1
    np.testing.assert_allclose(correlation(values, errors), truth, atol=0.1)
