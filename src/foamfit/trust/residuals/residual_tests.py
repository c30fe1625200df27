"""What residuals still hold: tests of their order, and where along the branches structure sits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from foamfit.arrays import Array

# A structure of which a parabola takes more than this share is called bent.
BENT = 0.6


def runs_test(residual: Array) -> float:
    """p-value of too few runs of one sign: Wald & Wolfowitz (1940), Ann. Math. Stat. 11, 147.

    Given n₊ positive and n₋ negative residuals in random order, the number of runs has mean
    μ = 2 n₊n₋/n + 1 and variance (μ-1)(μ-2)/(n-1), and is nearly normal (here with the correction
    for continuity). One-sided: slow waves make few runs; noise that alternates is not structure.
    The residuals are in the order of time; those that are exactly zero are left out.
    """
    signs = residual[residual != 0.0] > 0.0
    n, positive = signs.size, int(np.count_nonzero(signs))
    negative = n - positive
    if n < 2:
        return 1.0
    if positive == 0 or negative == 0:
        return math.ldexp(1.0, 1 - n)  # n signs of a fair coin that are all the same
    runs = 1 + int(np.count_nonzero(signs[1:] != signs[:-1]))
    mean = 2.0 * positive * negative / n + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (n - 1.0)
    if variance <= 0.0:
        return 1.0
    return float(special.ndtr((runs + 0.5 - mean) / math.sqrt(variance)))


def neighbours_test(residual: Array) -> float:
    """p-value of neighbouring residuals that are alike: von Neumann (1941), Ann. Math. Stat. 12.

    Σ r_i r_{i+1} / Σ r_i² of white noise is normal with variance 1/n, nearly. One-sided. It weighs
    by size what the runs test only counts by sign, and so sees a short strong wave that the runs
    test does not; the runs test in turn is not led astray by a few large samples.
    """
    power = float(residual @ residual)
    if residual.size < 2 or power == 0.0:
        return 1.0
    rho = float(residual[1:] @ residual[:-1]) / power
    return float(special.ndtr(-rho * math.sqrt(residual.size)))


@dataclass(frozen=True)
class Structure:
    """Where the largest structure of a curve's residual sits."""

    # Root of the mean product of neighbouring residuals, in their unit: white noise adds nothing.
    size: float
    place: str  # branches that the springs are on, and whether on loading or unloading
    share: float  # of the structure, that this place holds
    bent: float  # share of the squares there that a parabola over the samples takes off

    @property
    def straight(self) -> bool:
        """Whether a spring is there on a branch that the law makes a straight line."""
        return "on d" in self.place or "on e" in self.place


def find_structure(residual: Array, places: NDArray[np.str_]) -> Structure:
    """Find the place that holds the largest part of the structure of the residual of one curve.

    `places` are as from `fitting.branches.branch_of_samples`.
    """
    product, here = residual[1:] * residual[:-1], places[1:]
    sums = {str(place): float(product[here == place].sum()) for place in np.unique(places)}
    place = max(sums, key=lambda key: sums[key])
    held = sum(max(value, 0.0) for value in sums.values())
    own, bent = residual[places == place], 0.0
    if own.size >= 8 and own.any():
        base = np.vander(np.linspace(-1.0, 1.0, own.size), 3)
        left = own - base @ np.linalg.lstsq(base, own, rcond=None)[0]
        bent = 1.0 - float(left @ left) / float(own @ own)
    size = math.sqrt(max(float(product.mean()), 0.0))
    return Structure(size, place, sums[place] / held if held > 0.0 else 0.0, bent)
