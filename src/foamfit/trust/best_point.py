"""The best point of a problem: its curves, residual, Jacobian and covariance, each computed once.

All that is concluded from a fit reads this: one plain simulation and one with sensitivities.
"""

from __future__ import annotations

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
from foamfit.trust.covariance import Covariance
from foamfit.trust.residuals.law_error import CurveError, curve_errors
from foamfit.trust.residuals.noise_process import noise_processes, parts, variance_of


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

    @cached_property
    def spread(self) -> Covariance:
        """Their local covariance, as estimated with the loss.

        Where the law has an error it goes by the curvature of the cost itself, and what the
        residual presses to a limit is held.
        """
        jacobian, pseudo = self.weighted
        noise, curves = [error.noise for error in self.errors], self.problem.objective.sizes
        plain = covariance.covariance(jacobian, pseudo, curves, self.sizes, noise)
        free = np.arange(len(self.names))
        if self.misfits:
            free = np.flatnonzero(~self._held(jacobian, pseudo, plain))
        if not self.misfits or not free.size:
            return plain
        places, sizes, (low, high) = self.places[free], self.sizes[free], self.box[:, free]
        names = tuple(self.names[i] for i in free)

        def gradient(step: Array) -> Array:
            values = self.values.copy()
            values[places] = np.clip(values[places] + step * sizes, low, high)
            slopes = self.problem.slopes(values, names) * sizes
            return np.asarray(slopes.T @ self.problem.objective.residual(values))

        bent = covariance.covariance(jacobian[:, free], pseudo, curves, sizes, noise, gradient)
        return plain.with_some(free, bent)

    def _held(self, jacobian: Array, residual: Array, spread: Covariance) -> NDArray[np.bool_]:
        """Parameters that the residual presses to a limit by more than its noise could, (k,)."""
        pull = jacobian.T @ residual
        sure = variance_of(spread.noise, jacobian, self.problem.objective.sizes)
        near = np.abs(self.box - self.values[self.places]) <= covariance.AT_LIMIT * self.sizes
        outward = np.where(near[0], pull, np.where(near[1], -pull, 0.0))
        return np.asarray(outward > 1.96 * np.sqrt(sure))

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
