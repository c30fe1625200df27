"""Least squares close to the best point with some parameters held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.fitting.levenberg import Iterate, damped_step, descend_updated
from foamfit.fitting.losses import soften, softness
from foamfit.fitting.search import Tracker
from foamfit.trust.best_point import BestPoint

# How often a refit gets a new Jacobian before it is taken as it is.
RENEWALS = 2
# Largest drop of the stress from A1 to C2 over the stress at A1.
LAST_DROP = 0.999


@dataclass(eq=False)
class Refit:
    """Least squares close to the best point, with some parameters held."""

    best: BestPoint  # Where to start
    tracker: Tracker  # Simulates, counts and ends all at its deadline
    # (n_data,): Taken off the residual, before the loss: data that differ from those that were
    # fitted.
    shift: Array | float = 0.0

    def __post_init__(self) -> None:
        """Lay out the scaled parameters."""
        best, index = self.best, self.best.index
        self.places = np.array([index[name] for name in best.names])
        self.low, self.high = np.array([best.limits(name) for name in best.names]).T
        self.complete = best.problem.space().complete
        self.drops = [
            ([index[own + "k0"], index[own + "eps_a"]], index[own + "dsigma"])
            for own in (name.removesuffix("dsigma") for name in best.names if "_dsigma" in name)
        ]
        # Of the cost: less than this is no gain.
        cuts = best.quantiles**2 * best.spread.inflation  # NaN where the test says nothing
        self.enough = 1e-3 * float(min(cuts[np.isfinite(cuts)], default=1.0))

    def start(self) -> Iterate:
        """The best point itself."""
        return self._softened(self.best.values, self.best.residual - self.shift, self.best.jacobian)

    def _softened(self, point: Array, differences: Array, jacobian: Array) -> Iterate:
        """An iterate under the loss."""
        loss = self.best.problem.objective.loss
        slopes = softness(differences, loss)[:, None] * jacobian * self.best.sizes
        return Iterate(point, soften(differences, loss), slopes)

    def residual(self, point: Array) -> Array | None:
        """Residual of a point that can be simulated, else None."""
        objective = self.tracker.objective
        failures = objective.failures
        residual = self.tracker.residual(point, self.shift)
        return residual if objective.failures == failures else None

    def fresh(self, point: Array, residual: Array) -> Iterate:
        """An iterate with a Jacobian of its own."""
        problem, names = self.best.problem, self.best.names
        jacobian = problem.linear.slopes(point, names)
        if problem.objective.loss == "linear":
            return Iterate(point, residual, jacobian * self.best.sizes)
        return self._softened(point, problem.objective.differences(point) - self.shift, jacobian)

    def moved(self, at: Iterate, step: Array) -> Array:
        """Point that is off an iterate by a scaled step, within the limits."""
        point = at.point.copy()
        there = point[self.places] + step * self.best.sizes
        point[self.places] = np.clip(there, self.low, self.high)
        for sigma_a, drop in self.drops:  # no spring's stress at C2 falls below zero
            k0, eps_a = point[sigma_a]
            point[drop] = max(point[drop], -LAST_DROP * k0 * eps_a / (1.0 - eps_a))
        return self.complete(point)

    def taken(self, at: Iterate, point: Array) -> Array:
        """Scaled step from an iterate to a point."""
        return np.asarray((point - at.point)[self.places] / self.best.sizes)

    def step(self, at: Iterate, free: NDArray[np.bool_], damping: float) -> Array:
        """Scaled step of the free parameters."""
        return damped_step(at, at.point[self.places], self.low, self.high, damping, free)

    def _move(self, at: Iterate, step: Array) -> tuple[Array, Array]:
        point = self.moved(at, step)
        return point, self.taken(at, point)

    def run(self, at: Iterate, free: NDArray[np.bool_], *, steps: int = 12) -> Iterate:
        """Descend with these parameters free."""
        for renewal in range(RENEWALS + 1):
            at, settled, poor = descend_updated(
                self.residual, lambda here, damping: self.step(here, free, damping), self._move,
                at, steps, self.enough,
            )  # fmt: skip
            if settled and (renewal or not poor):
                break
            if renewal < RENEWALS:
                at = self.fresh(at.point, at.residual)
        return at
