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
from foamfit.fitting.branches import unreached
from foamfit.fitting.losses import influence, soften
from foamfit.fitting.objective import Simulated
from foamfit.fitting.problem import Problem
from foamfit.trust import covariance
from foamfit.trust.covariance import Block, Covariance, Uncertainty
from foamfit.trust.residuals.law_error import CurveError, curve_errors
from foamfit.trust.residuals.noise_process import noise_processes, parts


def m_estimate(residual: Array, sizes: tuple[int, ...], loss: str) -> tuple[Array, Array]:
    """Weights of slopes and pseudo-residuals whose least squares have the covariance of a loss.

    With the mean m of ψ'(r) over each curve (so many samples in `sizes`): √m and ψ(r)/√m. The
    normal matrix of the slopes so weighted is half the curvature of the cost, and the covariance of
    their least squares that of an M-estimate (Huber 1981, Robust Statistics, section 7.6). Under
    the linear loss they are one and the residuals, as those of priors behind the curves always are.
    """
    psi, slope = influence(residual, loss)
    weights, data = np.ones(residual.size), sum(sizes)
    psi = np.append(psi[:data], residual[data:])
    for part in parts(sizes):
        weights[part] = max(float(slope[part].mean()), 0.05) ** 0.5
    return weights, psi / weights


@dataclass(frozen=True, eq=False)
class BestPoint:
    """A point of the parameters (SI), usually the best one, and what holds locally there.

    `chosen` are the parameters whose uncertainty is asked for; by default those that vary and
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
        """Residual of curves and priors before its loss gives way to large ones."""
        return self.problem.objective.compare(self.simulated, self.values)

    @cached_property
    def unreached(self) -> dict[str, str]:
        """Parameters whose branch was never reached, and that branch."""
        return unreached(self.problem, self.simulated)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the k parameters whose uncertainty is asked for."""
        if self.chosen is not None:
            return self.chosen
        return tuple(name for name in self.problem.free() if name not in self.unreached)

    @cached_property
    def sizes(self) -> Array:
        """Their characteristic sizes, (k,)."""
        return self.problem.sizes(self.names, self.values)

    @cached_property
    def jacobian(self) -> Array:
        """Derivative of `residual` by them, (n_data, k)."""
        return self.problem.linear.slopes(self.values, self.names)

    @cached_property
    def _weighted(self) -> tuple[Array, Array]:
        """Jacobian and residual whose least squares have the covariance of the loss."""
        objective = self.problem.objective
        weights, pseudo = m_estimate(self.residual, objective.sizes, objective.loss)
        return self.jacobian * weights[:, None], pseudo

    @cached_property
    def errors(self) -> tuple[CurveError, ...]:
        """What the residual of each counted curve is made of: noise, or an error of the law too.

        The noise of a driving stress comes through the springs as slow waves of the displacement,
        which look like an error of the law and are none.
        """
        jacobian, pseudo = self._weighted
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
        jacobian, pseudo = self._weighted
        values = self.values[[self.index[name] for name in self.names]]
        limits = np.array([self.limits(name) for name in self.names]).reshape(-1, 2)
        room = np.column_stack([values - limits[:, 0], limits[:, 1] - values])
        return Block(
            jacobian * self.sizes,
            pseudo,
            self.problem.objective.sizes,
            [error.noise for error in errors],
            np.eye(len(self.names)),
            self.gradient if any(error.found for error in errors) else None,
            room / self.sizes[:, None],
        )

    def gradient(self, places: NDArray[np.intp], step: Array) -> Array:
        """Half the gradient of the cost by some of the parameters, all scaled, at a step of them.

        The step ends at their limits.
        """
        names = tuple(self.names[i] for i in places)
        at, values = [self.index[name] for name in names], self.values.copy()
        low, high = np.array([self.limits(name) for name in names]).T
        values[at] = np.clip(values[at] + step * self.sizes[places], low, high)
        slopes = self.problem.slopes(values, names) * self.sizes[places]
        return np.asarray(slopes.T @ self.problem.objective.residual(values))

    @cached_property
    def spread(self) -> Covariance:
        """Their local covariance."""
        return Uncertainty((self.block(self.errors),), self.sizes).covariance

    @cached_property
    def soft(self) -> Array:
        """Residual of curves and priors, softened by the loss."""
        objective = self.problem.objective
        return soften(self.residual, objective.loss, objective.n_data)

    @cached_property
    def cost(self) -> float:
        """Sum of squares of the residual, softened by the loss."""
        return float(self.soft @ self.soft)

    @property
    def index(self) -> dict[str, int]:
        """Place of each parameter in `values`."""
        return self.problem.index

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
        """Parameters of which the local interval says anything."""
        told = self.halves <= covariance.NOTHING * self.sizes
        return [name for name, known in zip(self.names, told, strict=True) if known]

    def limits(self, name: str) -> tuple[float, float]:
        """Limits of a parameter, SI."""
        parameter = self.problem.params[name]
        return float(parameter.min), float(parameter.max)

    def along(self, name: str) -> Array:
        """Change of all k parameters per change of one, as their correlation has it, (k,)."""
        column = self.names.index(name)
        row = self.spread.matrix[:, column]
        return np.asarray(np.nan_to_num(row / row[column]))
