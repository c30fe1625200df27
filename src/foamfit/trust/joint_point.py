"""The best point of a joint fit, and the scatter of a parameter between specimens.

The unknowns of several tests are the common ones, then the own parameters of each test.

The estimates u of n tests have errors of covariance C; the specimens scatter about a common value μ
with a standard deviation τ: u ~ N(μ, C + τ²). μ is the generalised mean, and τ that at which the
sum of squares Q(τ²) about it equals its expectation n-1 (Paule & Mandel 1982, J. Res. NBS 87, 377).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from foamfit.arrays import Array
from foamfit.fitting.together import Together, factor
from foamfit.options import RATES
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import Block, Uncertainty
from foamfit.trust.residuals import CurveError


class Error(NamedTuple):
    """Standard error, degrees of freedom, and variance over that under unit white noise."""

    stderr: float
    freedom: float
    inflation: float

    @property
    def quantile(self) -> float:
        """Student's t of the 95 % interval."""
        return covariance.half_width(1.0, self.freedom)

    @property
    def half(self) -> float:
        """Half of the local 95 % interval."""
        return self.quantile * self.stderr


@dataclass(frozen=True, eq=False)
class JointPoint:
    """The best point of a joint fit with its local properties.

    `errors` are those of the curves of each test (`BestPoint.errors`). `inflations` (n,) contains
    for each scattering parameter the ratio of its variance to that under white noise; the weight
    that draws it to the common value exceeds the one that its spread implies by this factor.
    """

    found: Together
    errors: tuple[tuple[CurveError, ...], ...] = ()
    inflations: Mapping[str, Array] = field(default_factory=dict)

    @cached_property
    def bests(self) -> tuple[BestPoint, ...]:
        """The best point of each test."""
        return tuple(map(BestPoint, self.found.problems, self.found.values))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the common unknowns, which precede the own ones.

        They are the shared parameters, the slopes of rate laws (with ":b"), and the logarithms of
        the common values of scattering parameters.
        """
        out, links = list[str](), self.found.links
        for name in self.found.shared:
            out += [name, f"{name}:b"] if links.kind(name) in RATES else [name]
        return (*out, *(name for name in self.found.own if links.kind(name) == "scatter"))

    @cached_property
    def _own(self) -> list[dict[str, int]]:
        """Place of each own parameter of each test among the unknowns."""
        places, own = count(len(self.names)), self.found.own
        each = [[name for name in best.names if name in own] for best in self.bests]
        return [dict(zip(names, places, strict=False)) for names in each]

    @cached_property
    def _scales(self) -> Array:
        """Scales of the unknowns; 1 for a slope or a logarithm."""
        out, shared = list[float](), set(self.found.shared)
        for name in self.names:
            users = [b for b in self.bests if name in shared and name in b.problem.free()]
            out.append(users[0].size(name) if users else 1.0)
        for best, own in zip(self.bests, self._own, strict=True):
            out += map(best.size, own)
        return np.array(out)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Uncertainty of all unknowns due to noise."""
        blocks = (*map(self._block, range(len(self.bests))), *self._drawn())
        return Uncertainty(blocks, self._scales)

    def _block(self, t: int) -> Block:
        """Return the block of a test."""
        best, links = self.bests[t], self.found.links
        block = best.block(self.errors[t] if self.errors else ())
        places = {name: i for i, name in enumerate(self.names)} | self._own[t]
        through = np.zeros((len(best.names), self._scales.size))
        for i, name in enumerate(best.names):
            at, kind = places[name], links.kind(name)
            through[i, at] = 1.0
            if kind in RATES:
                v, b = self.found.common[name]
                f, slope = factor(kind, b, links.x(t))
                through[i, at : at + 2] = f, v * slope
        return replace(block, through=through * self._scales / best.sizes[:, None])

    def _drawn(self) -> list[Block]:
        """Return a block of the residuals that draw values to a common one, if there are any."""
        rows, variances = list[Array](), list[float]()
        for name, pulls in self.found.links.pulls.items():
            for t, (best, own) in enumerate(zip(self.bests, self._own, strict=True)):
                if name not in own or name not in self.names:
                    continue
                row, value = np.zeros(self._scales.size), best.value(name)
                row[own[name]] = self._scales[own[name]] / value if value else 0.0
                row[self.names.index(name)] = -1.0
                rows.append(row * pulls[t])
                variances.append(float(self.inflations[name][t]) if self.inflations else 1.0)
        through, of_priors = np.eye(self._scales.size), np.array(variances)
        return [Block(np.array(rows), (), (), through, of_priors=of_priors)] if rows else []

    def of_common(self, name: str) -> Error:
        """Return the error of a common unknown; NaN for others."""
        return self._of_sum(np.array([common == name for common in self.names], dtype=float))

    def of_test(self, test: int, name: str) -> Error:
        """Return the error of a test's parameter; NaN if unreached."""
        best = self.bests[test]
        if name not in best.names:
            return Error(math.nan, 1.0, 1.0)
        i = best.names.index(name)
        row = self.uncertainty.blocks[test].through[i] * best.sizes[i] / self._scales
        return self._of_sum(row)

    def _of_sum(self, row: Array) -> Error:
        """Return the error of a weighted sum of unknowns."""
        if not (at := np.flatnonzero(row)).size:
            return Error(math.nan, 1.0, 1.0)
        covariance, first = self.uncertainty.covariance, at[0]
        variance = row[at] @ covariance.matrix[np.ix_(at, at)] @ row[at]
        freedom, inflation = covariance.freedom[first], covariance.inflation[first]
        return Error(float(np.sqrt(variance)), float(freedom), float(inflation))

    def reach(self, name: str) -> float:
        """Return the change of a shared value that raises the cost by 1; 0 if undetermined."""
        at, uncertainty = self.names.index(name), self.uncertainty
        change = 0.0 if uncertainty.lost[at] else math.sqrt(uncertainty.inverse[at, at])
        return change * float(self._scales[at])

    def moved(self, name: str, change: float) -> list[Array]:
        """Return the values of each test after a change of a shared value.

        The other unknowns follow to minimise the linearised cost.
        """
        at, out = self.names.index(name), list[Array]()
        along = self.uncertainty.inverse[:, at]
        step = change / self._scales[at] * along / along[at]
        for best, block in zip(self.bests, self.uncertainty.blocks, strict=False):  # not `_drawn`
            values = best.values.copy()
            moved = values[best.places] + block.through @ step * best.sizes
            values[best.places] = np.clip(moved, *best.box)
            out.append(values)
        return out

    def taken(self, test: int) -> Array:
        """Return the part of a test's noise that the joint fit absorbed; see `noise_processes`.

        A direction that several tests determine absorbed only a share of each test's noise.
        """
        left = self.uncertainty.lefts[test]
        share, axes = np.linalg.eigh(left @ left.T)
        own = self.uncertainty.blocks[test].axes[0]
        return np.asarray((own @ axes) * np.sqrt(np.clip(share, 0.0, 1.0)))

    def scale(self, test: int) -> tuple[float, float]:
        """Return the factor of a test's force that lowers the cost most, and the share it lowers.

        It is a score test: a linear step of this factor and of all unknowns, without a further fit.
        """
        best, block, left = self.bests[test], self.uncertainty.blocks[test], self.uncertainty.lefts
        curve = next((n for n in best.problem.objective.counted if n.startswith("stress")), None)
        if curve is None:
            return 1.0, 0.0
        column = -best.added(curve, best.problem.objective.measured[curve])
        taken = left[test].T @ (block.axes[0].T @ column)
        free, slope = float(column @ column - taken @ taken), float(column @ best.residual)
        if free <= 1e-6 * float(column @ column):
            return 1.0, 0.0
        return 1.0 - slope / free, slope**2 / free / max(self.found.cost, 1e-300)

    @cached_property
    def _undrawn(self) -> tuple[Array, Array]:
        """Covariance and inverse curvature without the pull to common values, SI, (m, m) each."""
        full, n, scales = self.uncertainty, len(self.bests), np.outer(self._scales, self._scales)
        curvatures = full.bent.curvatures if full.errs else None
        alone = Uncertainty(full.blocks[:n], self._scales, curvatures and curvatures[:n])
        return alone.matrix * scales, alone.inverse * scales

    def own_errors(self, test: int, names: Sequence[str]) -> Array:
        """Return the covariance of own parameters from a test's data alone, SI; else 0."""
        out, own = np.zeros((len(names), len(names))), self._own[test]
        rows = [i for i, name in enumerate(names) if name in own]
        places = [own[names[i]] for i in rows]
        out[np.ix_(rows, rows)] = np.nan_to_num(self._undrawn[0][np.ix_(places, places)])
        return out

    def of_logarithms(self, name: str) -> tuple[Array, Array]:
        """Return covariance and inverse curvature of the logarithms of an own parameter, (n, n).

        Both are from the data alone, without the pull to a common value, over all n tests; NaN
        where a test does not determine the parameter.
        """
        sizes = np.abs(self.found.value(name))
        tests = [t for t, own in enumerate(self._own) if name in own and sizes[t] > 0.0]
        places = [self._own[t][name] for t in tests]
        out = np.full((2, len(self.bests), len(self.bests)), np.nan)
        for logs, linear in zip(out, self._undrawn, strict=True):
            inner = linear[np.ix_(places, places)]
            logs[np.ix_(tests, tests)] = inner / np.outer(sizes[tests], sizes[tests])
        return out[0], out[1]


# ---------------------------------------------------------------- scatter between specimens


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
