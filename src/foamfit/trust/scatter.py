"""Common value and spread of a parameter between specimens, apart from the errors of measurement.

The estimates u of n tests have errors of covariance C; the specimens scatter about a common value μ
with a standard deviation τ: u ~ N(μ, C + τ²). τ is that of the largest restricted likelihood
(REML), μ the generalised mean. How several parameters vary together is in `correlation`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import brentq, minimize_scalar

from foamfit.arrays import Array

# A spread is looked for between these multiples of the smallest error and of the estimates' own.
SMALLEST, LARGEST = 1e-3, 100.0


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


@dataclass(frozen=True, eq=False)
class _Estimates:
    """Estimates in the directions in which their errors are independent."""

    values: Array
    ones: Array
    variances: Array

    @classmethod
    def of(cls, values: Array, errors: Array) -> _Estimates:
        variances, axes = np.linalg.eigh(0.5 * (errors + errors.T))
        variances = np.maximum(variances, 1e-12 * max(float(variances[-1]), 1e-300))
        return cls(axes.T @ values, axes.sum(axis=0), variances)

    def mean(self, tau2: float) -> tuple[float, float]:
        """Generalised mean at a spread, and the inverse of its variance."""
        weights = 1.0 / (self.variances + tau2)
        precision = float(weights @ self.ones**2)
        return float(weights @ (self.ones * self.values)) / precision, precision

    def q(self, tau2: float) -> float:
        """Sum of squares about the mean in units of the errors and the spread."""
        rest = self.values - self.mean(tau2)[0] * self.ones
        return float(np.sum(rest**2 / (self.variances + tau2)))

    def criterion(self, tau2: float) -> float:
        """Twice the negative logarithm of the restricted likelihood."""
        bent = math.log(self.mean(tau2)[1])
        return float(np.sum(np.log(self.variances + tau2))) + bent + self.q(tau2)

    def information(self, tau2: float) -> float:
        """Expected information on τ²: half the trace of PP."""
        weights = 1.0 / (self.variances + tau2)
        total = float(weights @ self.ones**2)
        once, twice = weights**2 * self.ones**2, weights**3 * self.ones**2
        trace = float(np.sum(weights**2)) - 2.0 * float(twice.sum()) / total
        return 0.5 * (trace + (float(once.sum()) / total) ** 2)


def common_and_spread(values: Array, errors: Array) -> Spread:
    """Common value and spread of estimates (n,) with errors of covariance (n, n), n at least 2.

    The interval of the mean is that of Knapp and Hartung (2003, Stat. Med. 22, 2693) with Student's
    t of n-1 degrees of freedom; that of the spread is the generalised Q profile (Viechtbauer 2007,
    Stat. Med. 26, 37): Q(τ²) has the χ² distribution of n-1 degrees of freedom.
    """
    n, seen = values.size, _Estimates.of(values, errors)
    scale = float(np.var(values, ddof=1))
    least = SMALLEST**2 * float(seen.variances[0])
    most = max(LARGEST**2 * scale, 2.0 * least)
    grid = np.geomspace(max(least, 1e-9 * most), most, 40)
    costs = [seen.criterion(0.0), *(seen.criterion(float(tau2)) for tau2 in grid)]
    at, tau2 = int(np.argmin(costs)), 0.0
    if at > 0:
        ends = np.log([grid[max(at - 2, 0)], grid[min(at, grid.size - 1)]])
        found = minimize_scalar(
            lambda u: seen.criterion(math.exp(u)), bounds=tuple(ends), method="bounded",
            options={"xatol": 1e-8},
        )  # fmt: skip
        tau2 = math.exp(float(found.x))
        tau2 = tau2 if seen.criterion(tau2) < costs[0] else 0.0
    mean, precision = seen.mean(tau2)
    stderr = math.sqrt(seen.q(tau2) / (n - 1) / precision)
    half = float(stats.t.ppf(0.975, n - 1)) * stderr
    ends95 = tuple(
        math.sqrt(_crossing(seen.q, float(stats.chi2.ppf(p, n - 1)), most)) for p in (0.975, 0.025)
    )
    error = None
    if tau2 > 0.0:
        error = 0.5 / math.sqrt(max(seen.information(tau2), 1e-300) * tau2)
    return Spread(
        mean, stderr, (mean - half, mean + half), math.sqrt(tau2), error, (ends95[0], ends95[1]), n
    )


def _crossing(q: Callable[[float], float], level: float, most: float) -> float:
    """τ² at which the falling Q reaches a level; 0 if it is below from the start."""
    if q(0.0) <= level:
        return 0.0
    while q(most) > level:
        most *= 10.0
    return float(brentq(lambda tau2: q(tau2) - level, 0.0, most, xtol=1e-12 * most, rtol=1e-10))


def correlation(values: Array, errors: Array) -> Array:
    """Correlation (k, k) between specimens of k parameters, estimated in n tests: (n, k).

    It is that of the covariance of the estimates less the mean covariance (k, k) of their errors,
    shrunk towards none, 0, by the share that Schäfer and Strimmer (2005, Stat. Appl. Genet. Mol.
    Biol. 4, 32) give: the variances of the correlations over their squares. The fewer the tests,
    the larger it is; two tests say nothing of a correlation.
    """
    n, k = values.shape
    off = values - values.mean(axis=0)
    scale = np.sqrt(np.sum(off**2, axis=0) / max(n - 1, 1))
    scale = np.where(scale > 0.0, scale, 1.0)
    if n < 3:
        return np.eye(k)
    products = np.einsum("ti,tj->tij", off / scale, off / scale)
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
