"""What the fits of several tests one by one come to: starts of a fit of all, and its evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.problem import Problem

# Blocks of a curve that can show an error of the law: noise averages out in them.
BLOCKS = 50
# Vectors that more than one test's shared parameters start from.
MOST_STARTS = 4


@dataclass(frozen=True, eq=False)
class Group:
    """Tests that share parameters, and the vector of parameters that each one's own fit found."""

    problems: tuple[Problem, ...]
    vectors: tuple[Array, ...]

    @property
    def _pairs(self) -> list[tuple[Problem, Array]]:
        return list(zip(self.problems, self.vectors, strict=True))

    def starts(self, most: int = MOST_STARTS) -> list[list[Array]]:
        """Where joint fits start: at the own fits, and at those of so many tests for all."""
        n = len(self.vectors)
        chosen = np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))
        one_for_all = (
            [p.with_springs(self.vectors[i], own) for p, own in self._pairs] for i in chosen
        )
        return [list(self.vectors), *one_for_all]

    @cached_property
    def n_eff(self) -> int:
        """Effective samples of the curves: see `effective_samples`."""
        return sum(effective_samples(problem, values) for problem, values in self._pairs)

    @property
    def n_data(self) -> int:
        """Samples of all tests."""
        return sum(problem.objective.n_data for problem in self.problems)

    @property
    def n_alone(self) -> int:
        """Parameters that vary in all tests where nothing is shared."""
        return sum(len(problem.free()) for problem in self.problems)

    @cached_property
    def alone(self) -> float:
        """Sum of squares of the own fits: what is left where nothing is shared."""
        return float(sum(np.sum(p.objective.residual(values) ** 2) for p, values in self._pairs))

    def bic(self, cost: float, n_vary: int) -> float:
        """Bayesian information criterion of a fit of these tests; see `bic`."""
        return bic(cost, self.n_data, n_vary, self.n_eff)

    @property
    def bic_alone(self) -> float:
        """That of the own fits."""
        return self.bic(self.alone, self.n_alone)

    @property
    def misfits(self) -> tuple[dict[str, float | None], ...]:
        """Misfit of each curve of each own fit."""
        return tuple(p.objective.look(values, everything=True) or {} for p, values in self._pairs)


def effective_samples(problem: Problem, values: Array) -> int:
    """Stretches of the curves of a test in which its own fit lies on one side.

    What the own fit leaves is mostly an error of the law, which is no noise: one stretch on one
    side, whatever its samples, says one thing. Counted over `BLOCKS` means of each curve.
    """
    residual, count = problem.objective.residual(values)[: problem.objective.n_data], 0
    for part in np.split(residual, np.cumsum(problem.objective.sizes)[:-1]):
        blocks = np.array_split(part, min(BLOCKS, part.size))
        signs = np.sign([float(np.mean(block)) for block in blocks])
        count += 1 + int(np.count_nonzero(np.diff(signs)))
    return count


def bic(cost: float, n_data: int, n_vary: int, n_eff: int) -> float:
    """Bayesian information criterion n_eff ln(χ²/n) + k ln(n_eff)."""
    n_eff = max(n_eff, 2)
    return n_eff * math.log(max(cost, 1e-12 * n_data) / n_data) + n_vary * math.log(n_eff)
