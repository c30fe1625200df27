"""The neighbourhood of the best point: its covariance, and refits with some parameters held."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from foamfit.fitting.objective import influence, soften, softness
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import Tracker
from foamfit.trust import covariance
from foamfit.trust.covariance import Covariance

Array = NDArray[np.float64]

# How often a refit gets new slopes before it is taken as it is.
RENEWALS = 2
# Largest drop of the stress from A1 to C2 over the stress at A1.
LAST_DROP = 0.999


def m_estimate(residual: Array, sizes: tuple[int, ...], loss: str) -> tuple[Array, Array]:
    """Weights of slopes and pseudo-residuals whose least squares have the covariance of a loss.

    With the mean m of ψ'(r) over each curve: √m and ψ(r)/√m. The normal matrix of the slopes so
    weighted is half the curvature of the cost, and the covariance of their least squares that of
    an M-estimate (Huber 1981, Robust Statistics, section 7.6). Under the linear loss they are one
    and the residuals.

    Parameters
    ----------
    residual : (n,) array
        Before the loss.
    sizes : tuple of int
        Samples of each curve.
    loss : str
        See `fitting.objective.soften`.
    """
    psi, slope = influence(residual, loss)
    weights = np.empty(residual.size)
    for part in covariance.parts(sizes):
        weights[part] = max(float(slope[part].mean()), 0.05) ** 0.5
    return weights, psi / weights


@dataclass(frozen=True, eq=False)
class Vicinity:
    """The best point of a problem and its local covariance.

    Attributes
    ----------
    problem : Problem
        What was fitted.
    values : (n,) array
        All parameters of the model there, SI.
    residual : (n_data,) array
        Of the objective there, before its loss gives way to large ones.
    names : tuple of str
        Parameters that vary and whose branch was reached.
    sizes : (k,) array
        Their natural sizes.
    jacobian : (n_data, k) array
        Derivative of `residual` by them.
    spread : Covariance
        Of them, as estimated with the loss.
    """

    problem: Problem
    values: Array
    residual: Array
    names: tuple[str, ...]
    sizes: Array
    jacobian: Array
    spread: Covariance

    @classmethod
    def of(cls, problem: Problem, values: Array, names: tuple[str, ...]) -> Vicinity:
        """Look around a point."""
        objective = problem.objective
        residual = objective.differences(values)
        sizes = problem.sizes(names, values)
        jacobian = problem.linear.slopes(values, names)
        weights, pseudo = m_estimate(residual, objective.sizes, objective.loss)
        spread = covariance.covariance(jacobian * weights[:, None], pseudo, objective.sizes, sizes)
        return cls(problem, values, residual, names, sizes, jacobian, spread)

    @property
    def cost(self) -> float:
        """Sum of squares of the residual, softened by the loss."""
        soft = soften(self.residual, self.problem.objective.loss)
        return float(soft @ soft)

    @property
    def index(self) -> dict[str, int]:
        """Place of each parameter in `values`."""
        return self.problem.index

    @cached_property
    def quantiles(self) -> Array:
        """Student's t of the 95 % interval of each parameter, (k,)."""
        return np.array([covariance.half_width(1.0, freedom) for freedom in self.spread.freedom])

    def limits(self, name: str) -> tuple[float, float]:
        """Limits of a parameter, SI."""
        parameter = self.problem.params[name]
        return float(parameter.min), float(parameter.max)

    def knows(self, name: str) -> bool:
        """Whether the local interval says anything of a parameter."""
        column = self.names.index(name)
        half = self.quantiles[column] * self.spread.stderr[column]
        return bool(half <= covariance.NOTHING * self.sizes[column])

    def along(self, name: str) -> Array:
        """Change of all parameters per change of one, as their correlation has it, (k,)."""
        column = self.names.index(name)
        covariance = self.spread.matrix[:, column]
        return np.asarray(np.nan_to_num(covariance / covariance[column]))


@dataclass(frozen=True, eq=False)
class Place:
    """A point at which some parameters were refitted.

    `slopes` are the derivatives of its residual by the scaled parameters of the vicinity, as far
    as they are known there.
    """

    point: Array
    residual: Array
    slopes: Array

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)


@dataclass(eq=False)
class Refit:
    """Least squares in the vicinity of the best point, with some parameters held.

    Levenberg-Marquardt steps with the slopes of the neighbour, kept up by Broyden's rank-one
    updates (Broyden 1965, Math. Comp. 19, 577) and made anew only where these do not get on.

    Parameters
    ----------
    vicinity : Vicinity
        Where to start.
    tracker : Tracker
        Simulates, counts and ends all at its deadline.
    shift : (n_data,) array or float
        Taken off the residual, before the loss: data that differ from those that were fitted.
    """

    vicinity: Vicinity
    tracker: Tracker
    shift: Array | float = 0.0
    _doubtful: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Lay out the scaled parameters."""
        best = self.vicinity
        self.places = np.array([best.index[name] for name in best.names])
        bounds = np.array([best.limits(name) for name in best.names])
        self.low, self.high = bounds.T
        self.complete = best.problem.space().complete
        index = best.index
        self.drops = [
            ([index[own + "k0"], index[own + "eps_a"]], index[own + "dsigma"])
            for own in (name.removesuffix("dsigma") for name in best.names if "_dsigma" in name)
        ]
        # Of the cost: less than this is no gain.
        cuts = best.quantiles**2 * best.spread.inflation  # NaN where the test says nothing
        self.enough = 1e-3 * float(min(cuts[np.isfinite(cuts)], default=1.0))

    def start(self) -> Place:
        """The best point itself."""
        best, loss = self.vicinity, self.vicinity.problem.objective.loss
        differences = best.residual - self.shift
        slopes = softness(differences, loss)[:, None] * best.jacobian * best.sizes
        return Place(best.values, soften(differences, loss), slopes)

    def residual(self, point: Array) -> Array | None:
        """Residual of a point that can be simulated, else None."""
        objective = self.tracker.objective
        failures = objective.failures
        residual = self.tracker.residual(point, self.shift)
        return residual if objective.failures == failures else None

    def fresh(self, point: Array, residual: Array) -> Place:
        """A place with slopes of its own."""
        best, objective = self.vicinity, self.vicinity.problem.objective
        slopes = best.problem.linear.slopes(point, best.names) * best.sizes
        if objective.loss != "linear":
            differences = objective.differences(point) - self.shift
            slopes *= softness(differences, objective.loss)[:, None]
        return Place(point, residual, slopes)

    def moved(self, place: Place, step: Array) -> Array:
        """Point that is off a place by a scaled step, within the limits."""
        point = place.point.copy()
        there = point[self.places] + step * self.vicinity.sizes
        point[self.places] = np.clip(there, self.low, self.high)
        for sigma_a, drop in self.drops:  # no spring's stress at C2 falls below zero
            k0, eps_a = point[sigma_a]
            point[drop] = max(point[drop], -LAST_DROP * k0 * eps_a / (1.0 - eps_a))
        return self.complete(point)

    def step(self, place: Place, free: NDArray[np.bool_], damping: float) -> tuple[Array, float]:
        """Damped Gauss-Newton step of the free parameters, and the gain that it promises."""
        gradient = place.slopes.T @ place.residual
        at = place.point[self.places]
        held = ((at <= self.low) & (gradient > 0)) | ((at >= self.high) & (gradient < 0)) | ~free
        step = np.zeros(at.size)
        if held.all():
            return step, 0.0
        own = place.slopes[:, ~held]
        normal = own.T @ own
        scale = np.maximum(np.diag(normal), 1e-12 * max(float(np.trace(normal)), 1e-300))
        step[~held] = np.linalg.solve(normal + damping * np.diag(scale), -gradient[~held])
        along = place.slopes @ step
        return step, -float(along @ (2.0 * place.residual + along))

    def run(self, place: Place, free: NDArray[np.bool_], *, steps: int = 12) -> Place:
        """Descend with these parameters free."""
        for renewal in range(RENEWALS + 1):
            place, settled = self._descend(place, free, steps)
            if settled and (renewal or not self._doubtful):
                break
            if renewal < RENEWALS:
                place = self.fresh(place.point, place.residual)
        return place

    def _descend(self, place: Place, free: NDArray[np.bool_], steps: int) -> tuple[Place, bool]:
        """Some steps with updated slopes; whether no more gain is promised."""
        damping, growth = 1e-6, 4.0
        self._doubtful = False
        for _ in range(steps):
            step, promise = self.step(place, free, damping)
            if promise < self.enough:
                return place, True
            point = self.moved(place, step)
            taken = (point - place.point)[self.places] / self.vicinity.sizes
            residual = self.residual(point)
            if residual is None or not taken.any():
                damping, growth, self._doubtful = max(damping, 1e-3) * growth, growth * 2, True
                continue
            surprise = residual - place.residual - place.slopes @ taken
            slopes = place.slopes + np.outer(surprise, taken / (taken @ taken))
            gain = place.cost - float(residual @ residual)
            if gain <= 0.25 * promise:
                self._doubtful = True
            if gain > 0.0:
                place = Place(point, residual, slopes)
                damping, growth = damping * (0.2 if gain > 0.75 * promise else 1.0), 4.0
            else:
                place = replace(place, slopes=slopes)
                damping, growth = max(damping, 1e-3) * growth, growth * 2
        return place, False
