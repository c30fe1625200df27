"""The best point of a problem: its curves, residual, Jacobian and covariance, each computed once.

All that is concluded from a fit reads this: one plain simulation and one with sensitivities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.fitting.branches import unreached
from foamfit.fitting.losses import influence, soften
from foamfit.fitting.objective import Simulated
from foamfit.fitting.problem import Problem
from foamfit.trust import covariance
from foamfit.trust.covariance import Block, Covariance, Uncertainty
from foamfit.trust.residuals.law_error import CurveError, curve_errors
from foamfit.trust.residuals.noise_process import basis_of, noise_processes, parts

# Share of the residuals along a direction that a cycle takes at most, so that it is not all.
MOST_TAKEN = 0.99


def m_estimate(residual: Array, sizes: tuple[int, ...], loss: str) -> tuple[Array, Array]:
    """Weights of slopes and pseudo-residuals whose least squares have the covariance of a loss.

    With the mean m of ψ'(r) over each curve (of `sizes` samples): √m and ψ(r)/√m. The normal matrix
    of the slopes so weighted is half the curvature of the cost, and the covariance of their least
    squares that of an M-estimate (Huber 1981, Robust Statistics, section 7.6). Under the linear
    loss they are one and the residuals, as for priors, which follow the curves, under any loss.
    """
    psi, slope = influence(residual, loss)
    weights, data = np.ones(residual.size), sum(sizes)
    psi[data:] = residual[data:]
    for part in parts(sizes):
        weights[part] = max(float(slope[part].mean()), 0.05) ** 0.5
    return weights, psi / weights


@dataclass(frozen=True, eq=False)
class BestPoint:
    """A point of the parameters (SI), usually the best one, and what holds locally there.

    `chosen` are the parameters whose uncertainty is wanted; by default those that vary and
    whose branch was reached.
    """

    problem: Problem
    values: Array
    chosen: tuple[str, ...] | None = None

    @cached_property
    def simulated(self) -> Simulated:
        """All curves."""
        return self.problem.objective.simulate(self.values, everything=True)

    @cached_property
    def residual(self) -> Array:
        """Residual of curves and priors before the loss reduces large ones."""
        return self.problem.objective.compare(self.simulated, self.values)

    @cached_property
    def soft(self) -> Array:
        """Residual of curves and priors, softened by the loss."""
        objective = self.problem.objective
        return soften(self.residual, objective.loss, objective.n_data)

    @cached_property
    def cost(self) -> float:
        """Sum of squares of the softened residual."""
        return float(self.soft @ self.soft)

    @cached_property
    def unreached(self) -> dict[str, str]:
        """Parameters whose branch was never reached, and that branch."""
        return unreached(self.problem, self.simulated)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the k parameters whose uncertainty is wanted."""
        if self.chosen is not None:
            return self.chosen
        return tuple(name for name in self.problem.free() if name not in self.unreached)

    @property
    def index(self) -> dict[str, int]:
        """Place of each parameter in `values`."""
        return self.problem.index

    @cached_property
    def places(self) -> NDArray[np.intp]:
        """Places of the k parameters in `values`."""
        return np.array([self.index[name] for name in self.names], dtype=np.intp)

    @cached_property
    def sizes(self) -> Array:
        """Their characteristic sizes, (k,)."""
        return self.problem.sizes(self.names, self.values)

    def limits(self, name: str) -> tuple[float, float]:
        """Limits of a parameter, SI."""
        parameter = self.problem.params[name]
        return float(parameter.min), float(parameter.max)

    @cached_property
    def box(self) -> Array:
        """Lower and upper limits of the k parameters, SI, (2, k)."""
        return np.array([self.limits(name) for name in self.names]).reshape(-1, 2).T

    @cached_property
    def jacobian(self) -> Array:
        """Derivative of `residual` by them, (n_data, k)."""
        return self.problem.linear.slopes(self.values, self.names)

    @cached_property
    def weighted(self) -> tuple[Array, Array]:
        """Jacobian and residual whose least squares have the covariance of the loss."""
        objective = self.problem.objective
        weights, pseudo = m_estimate(self.residual, objective.sizes, objective.loss)
        return self.jacobian * weights[:, None], pseudo

    @cached_property
    def errors(self) -> tuple[CurveError, ...]:
        """Whether the residual of each counted curve is noise, or holds an error of the law too.

        The noise of a driving stress comes through the springs as slow waves of the displacement,
        which look like an error of the law but are none.
        """
        jacobian, pseudo = self.weighted
        scaled, objective = jacobian * self.sizes, self.problem.objective
        if objective.drive == "stress":
            noise = noise_processes(pseudo, scaled, objective.sizes)
            return tuple(CurveError(process) for process in noise)
        return tuple(curve_errors(pseudo, scaled, objective.sizes))

    @property
    def misfits(self) -> bool:
        """Whether the law misses more of some curve than its noise."""
        return any(error.found for error in self.errors)

    def block(self, errors: Sequence[CurveError]) -> Block:
        """Its part in a covariance, by the errors of its curves; as estimated with the loss."""
        jacobian, pseudo = self.weighted
        return Block(
            jacobian * self.sizes,
            pseudo,
            self.problem.objective.sizes,
            [error.noise for error in errors],
            np.eye(len(self.names)),
            self.gradient if any(error.found for error in errors) else None,
            (np.abs(self.box - self.values[self.places]) / self.sizes).T,
        )

    def gradient(self, places: NDArray[np.intp], step: Array) -> Array:
        """Half the gradient of the cost by some of the parameters, all scaled, at a step of them.

        The step ends at their limits.
        """
        at, sizes, (low, high) = self.places[places], self.sizes[places], self.box[:, places]
        values = self.values.copy()
        values[at] = np.clip(values[at] + step * sizes, low, high)
        slopes = self.problem.slopes(values, tuple(self.names[i] for i in places)) * sizes
        return np.asarray(slopes.T @ self.problem.objective.residual(values))

    @cached_property
    def spread(self) -> Covariance:
        """Their local covariance, as estimated with the loss."""
        return Uncertainty((self.block(self.errors),), self.sizes).covariance

    @cached_property
    def quantiles(self) -> Array:
        """Student's t of the 95 % interval of each parameter, (k,)."""
        return np.array([covariance.half_width(1.0, freedom) for freedom in self.spread.freedom])

    @cached_property
    def halves(self) -> Array:
        """Half of each local 95 % interval, (k,)."""
        return self.quantiles * self.spread.stderr

    @cached_property
    def known(self) -> list[str]:
        """Parameters that the local interval does not leave undetermined."""
        told = self.halves <= covariance.NOTHING * self.sizes
        return [name for name, known in zip(self.names, told, strict=True) if known]

    def rises(self, residual: Array) -> Array:
        """Rise of the cost at another point, from its softened residual, as χ² of each, (k,)."""
        return np.asarray((float(residual @ residual) - self.cost) / self.spread.inflation)


def cycle_growth(best: BestPoint) -> float | None:
    """`growth` from the last fitted cycle to the next; None where there are not several cycles."""
    objective, spans = best.problem.objective, cycles_of(best.problem.measurement)
    if len(spans) < 2 or not best.names:
        return None
    last = spans[max(spans)]
    kept = np.concatenate([objective.kept(name) for name in objective.counted])
    return growth(*best.weighted, np.flatnonzero((kept >= last.start) & (kept < last.stop)))


def growth(jacobian: Array, residual: Array, rows: NDArray[np.intp]) -> float:
    """Mean square of what a law misses of a new cycle over that of a fitted one, less one.

    The fitted cycle has the samples `rows` and the part H of the hat matrix. Errors that differ
    from cycle to cycle leave residuals r of covariance I - H in it, and of I + H in a new one like
    it: r'(I + H)(I - H)⁻¹r there for r'r here. (To leave the fitted cycle out would tell more,
    (I - H)⁻¹r, as one cycle fewer is fitted then.)
    """
    onto, share, _ = np.linalg.svd(basis_of(jacobian)[rows], full_matrices=False)
    hat, left = np.minimum(share**2, MOST_TAKEN), residual[rows]
    return float(2.0 * hat / (1.0 - hat) @ (onto.T @ left) ** 2 / max(left @ left, 1e-300))
