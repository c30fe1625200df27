"""Structure of residuals: tests of their randomness, and its place along the branches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from foamfit.arrays import Array

# Structure is called bent if a parabola removes more than this share of its squares.
BENT = 0.6


def runs_test(residual: Array) -> float:
    """Return the p-value of too few runs (Wald & Wolfowitz 1940, Ann. Math. Stat. 11, 147).

    Given n₊ positive and n₋ negative residuals in random order, the number of runs of one sign has
    mean μ = 2 n₊n₋/n + 1 and variance (μ-1)(μ-2)/(n-1), and is nearly normal (here with continuity
    correction). The test is one-sided: slow waves make few runs; alternating noise is not
    structure. Residuals are in the order of time; zeros are omitted.
    """
    signs = residual[residual != 0.0] > 0.0
    n, positive = signs.size, int(np.count_nonzero(signs))
    negative = n - positive
    if n < 2:
        return 1.0
    if positive == 0 or negative == 0:
        return math.ldexp(1.0, 1 - n)  # probability that n random signs are all the same
    runs = 1 + int(np.count_nonzero(signs[1:] != signs[:-1]))
    mean = 2.0 * positive * negative / n + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (n - 1.0)
    if variance <= 0.0:
        return 1.0
    return float(special.ndtr((runs + 0.5 - mean) / math.sqrt(variance)))


def neighbours_test(residual: Array) -> float:
    """Return the p-value of similar neighbouring residuals (von Neumann 1941, Ann. Math. Stat. 12).

    For white noise Σ r_i r_{i+1} / Σ r_i² is nearly normal with variance 1/n. The test is
    one-sided. It uses the size of the residuals and so detects a short strong wave that the runs
    test misses; the runs test uses their signs and is not misled by a few large residuals.
    """
    power = float(residual @ residual)
    if residual.size < 2 or power == 0.0:
        return 1.0
    rho = float(residual[1:] @ residual[:-1]) / power
    return float(special.ndtr(-rho * math.sqrt(residual.size)))


@dataclass(frozen=True)
class Structure:
    """Place of the largest structure in the residual of a curve."""

    # Root of the mean product of neighbouring residuals, in their units; 0 for white noise.
    size: float
    place: str  # branches of the springs, and loading or unloading
    share: float  # of all structure
    bent: float  # share of the squares there that a parabola over the samples removes

    @property
    def straight(self) -> bool:
        """Whether a spring is there on a branch that is a straight line in the law."""
        return "on d" in self.place or "on e" in self.place


def find_structure(residual: Array, places: NDArray[np.str_]) -> Structure:
    """Find the place, as of `fitting.branches.branch_of_samples`, with the largest structure."""
    product, branches = residual[1:] * residual[:-1], places[1:]
    sums = {str(place): float(product[branches == place].sum()) for place in np.unique(places)}
    place = max(sums, key=lambda key: sums[key])
    total = sum(max(value, 0.0) for value in sums.values())
    own, bent = residual[places == place], 0.0
    if own.size >= 8 and own.any():
        base = np.vander(np.linspace(-1.0, 1.0, own.size), 3)
        left = own - base @ np.linalg.lstsq(base, own, rcond=None)[0]
        bent = 1.0 - float(left @ left) / float(own @ own)
    size = math.sqrt(max(float(product.mean()), 0.0))
    return Structure(size, place, sums[place] / total if total > 0.0 else 0.0, bent)
