"""Common value and spread of a parameter between specimens, separated from estimation errors.

The estimates u of n tests have errors of covariance C; the specimens scatter about a common value μ
with a standard deviation τ: u ~ N(μ, C + τ²). μ is the generalised mean, and τ that at which the
sum of squares Q(τ²) about it equals its expectation n-1 (Paule & Mandel 1982, J. Res. NBS 87, 377).
`correlation` is that of several parameters between specimens.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from foamfit.arrays import Array


@dataclass(frozen=True)
class Spread:
    """Common value μ and spread τ of n estimates, with 95 % intervals."""

    mean: float
    stderr: float
    ci95: tuple[float, float]
    tau: float
    tau_stderr: float | None  # None where the spread is zero
    tau_ci95: tuple[float, float]
    count: int


def common_and_spread(values: Array, errors: Array) -> Spread:
    """Estimate common value and spread from n >= 2 estimates (n,) with error covariance (n, n).

    The interval of the mean is that of Knapp and Hartung (2003, Stat. Med. 22, 2693) with Student's
    t of n-1 degrees of freedom. The interval of the spread is the generalised Q profile
    (Viechtbauer 2007, Stat. Med. 26, 37): Q(τ²) is χ² distributed with n-1 degrees of freedom.
    """
    n = values.size
    # Rotate to directions in which the errors are independent.
    variances, axes = np.linalg.eigh(0.5 * (errors + errors.T))
    variances = np.maximum(variances, 1e-12 * max(float(variances[-1]), 1e-300))
    seen, ones = axes.T @ values, axes.sum(axis=0)

    def mean(tau2: float) -> tuple[float, float]:
        """Return the generalised mean at a spread, and the inverse of its variance."""
        weights = 1.0 / (variances + tau2)
        precision = float(weights @ ones**2)
        return float(weights @ (ones * seen)) / precision, precision

    def q(tau2: float) -> float:
        """Return the sum of squares about the mean, in units of error plus spread."""
        return float(np.sum((seen - mean(tau2)[0] * ones) ** 2 / (variances + tau2)))

    levels = (n - 1.0, *(float(stats.chi2.ppf(p, n - 1)) for p in (0.975, 0.025)))
    most, error = max(float(np.var(values, ddof=1)), float(variances[0])), None
    tau2, low, high = (_crossing(q, level, most) for level in levels)
    if tau2 > 0.0:  # the expected information on τ² is half the trace of PP
        weights = 1.0 / (variances + tau2)
        once, twice = (float(np.sum(weights**power * ones**2)) for power in (2, 3))
        total = float(weights @ ones**2)
        trace = float(np.sum(weights**2)) - 2.0 * twice / total + (once / total) ** 2
        error = 0.5 / math.sqrt(max(0.5 * trace, 1e-300) * tau2)
    middle, precision = mean(tau2)
    stderr = math.sqrt(q(tau2) / (n - 1) / precision)
    half = float(stats.t.ppf(0.975, n - 1)) * stderr
    ci95, tau_ci95 = (middle - half, middle + half), (math.sqrt(low), math.sqrt(high))
    return Spread(middle, stderr, ci95, math.sqrt(tau2), error, tau_ci95, n)


def _crossing(q: Callable[[float], float], level: float, most: float) -> float:
    """Return τ² at which the decreasing Q reaches a level; 0 if Q(0) is below it."""
    if q(0.0) <= level:
        return 0.0
    while q(most) > level:
        most *= 10.0
    return float(brentq(lambda tau2: q(tau2) - level, 0.0, most, xtol=1e-12 * most, rtol=1e-10))


def correlation(values: Array, errors: Array) -> Array:
    """Return the correlation (k, k) of k parameters between specimens, from n tests (n, k).

    It follows from the covariance of the estimates minus the mean covariance `errors` (k, k) of
    their errors, and is shrunk towards 0 by the factor of Schäfer and Strimmer (2005, Stat. Appl.
    Genet. Mol. Biol. 4, 32): the sum of the variances of the correlations over that of their
    squares. Shrinkage is stronger for fewer tests and complete for two.
    """
    n, k = values.shape
    if n < 3:
        return np.eye(k)
    deviations = values - values.mean(axis=0)
    scale = np.sqrt(np.sum(deviations**2, axis=0) / (n - 1))
    scale = np.where(scale > 0.0, scale, 1.0)
    products = np.einsum("ti,tj->tij", deviations / scale, deviations / scale)
    mean = products.mean(axis=0)
    apart = ~np.eye(k, dtype=bool)
    doubt = np.sum((products - mean) ** 2, axis=0)[apart].sum() * n / (n - 1) ** 3
    left = mean * n / (n - 1) - errors / np.outer(scale, scale)
    share = min(doubt / max(float(np.sum(left[apart] ** 2)), 1e-300), 1.0)
    power, axes = np.linalg.eigh(left)
    true = (axes * np.maximum(power, 0.0)) @ axes.T
    size = np.sqrt(np.maximum(np.diag(true), 1e-12))
    out = (1.0 - share) * true / np.outer(size, size)
    np.fill_diagonal(out, 1.0)
    return np.asarray(out)
