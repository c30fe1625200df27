"""Least squares close to the best point, with one parameter held or none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.levenberg import Iterate, descend
from foamfit.fitting.losses import soften, softness
from foamfit.fitting.search import Tracker
from foamfit.springs.law import least_eps_star
from foamfit.trust.best_point import BestPoint

# Largest drop of the stress from A1 to C2 over the stress at A1.
LAST_DROP = 0.999
# A refit ends where the expected gain of the cost is below this share of the 95 % cut, or after so
# many steps. Refits that end earlier depend on where they began, and so on rounding.
ENOUGH, STEPS = 1e-6, 40


@dataclass(eq=False)
class Refit:
    """Least squares close to the best point."""

    best: BestPoint
    tracker: Tracker  # Simulates, counts and ends all at its deadline
    # Taken off the residual, before the loss: data (and means of priors) that differ from those
    # that were fitted.
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
        self.stars = [
            ([index[own + "k0"], index[own + "kc"]], index[own + "eps_star"])
            for own in (name.removesuffix("eps_star") for name in best.names if "_eps_star" in name)
        ]
        cuts = best.quantiles**2 * best.spread.inflation  # NaN where the test says nothing
        self.enough = ENOUGH * float(min(cuts[np.isfinite(cuts)], default=1.0))

    def start(self) -> Iterate:
        """The best point itself."""
        differences = self.best.residual - self.shift
        objective = self.best.problem.objective
        soft = soften(differences, objective.loss, objective.n_data)
        return Iterate(self.best.values, soft, self._jacobian(differences, self.best.jacobian))

    def _jacobian(self, differences: Array, slopes: Array) -> Array:
        """Derivative of the softened residual by the scaled parameters."""
        objective = self.best.problem.objective
        soft = softness(differences, objective.loss, objective.n_data)
        return np.asarray(soft[:, None] * slopes * self.best.sizes)

    def residual(self, point: Array) -> Array | None:
        """Residual of a point that can be simulated, else None."""
        failures = self.tracker.objective.failures
        residual = self.tracker.residual(point, self.shift)
        return residual if self.tracker.objective.failures == failures else None

    def point(self, scaled: Array, low: Array, high: Array) -> Array:
        """Vector of all parameters from the scaled ones, moved between these limits (SI)."""
        point = self.best.values.copy()
        point[self.places] = np.clip(scaled * self.best.sizes, low, high)
        for sigma_a, drop in self.drops:  # no spring's stress at C2 falls below zero
            k0, eps_a = point[sigma_a]
            point[drop] = max(point[drop], -LAST_DROP * k0 * eps_a / (1.0 - eps_a))
        for stiffnesses, star in self.stars:  # branch c never lies before branch a
            point[star] = max(point[star], least_eps_star(*point[stiffnesses]))
        return self.complete(point)

    def moved(self, at: Iterate, step: Array) -> Array:
        """Point that is off an iterate by a scaled step, within the limits."""
        return self.point(at.point[self.places] / self.best.sizes + step, self.low, self.high)

    def taken(self, point: Array) -> Array:
        """Scaled step from the best point to another one."""
        return np.asarray((point - self.best.values)[self.places] / self.best.sizes)

    def run(
        self,
        start: Array,
        hold: tuple[int, float] | None = None,
        *,
        weights: Array | float = 1.0,
        iterations: int = STEPS,
    ) -> Iterate | None:
        """Descend from a point, one parameter (its column) held at a value or none.

        `weights` (n_data,) multiply the squares. Returns None if the start cannot be simulated.
        """
        root = np.sqrt(weights)
        rows = np.reshape(root, (-1, 1))
        problem, names, sizes = self.best.problem, self.best.names, self.best.sizes
        low, high = self.low.copy(), self.high.copy()
        if hold is not None:
            low[hold[0]] = high[hold[0]] = hold[1]

        def point(scaled: Array) -> Array:
            return self.point(scaled, low, high)

        def jacobian(scaled: Array) -> Array:
            slopes: Array = problem.linear.slopes(point(scaled), names) * rows
            if problem.objective.loss == "linear":
                return slopes * sizes
            differences = problem.objective.differences(point(scaled)) - self.shift
            return self._jacobian(differences, slopes)

        scaled = np.clip(start[self.places], low, high) / sizes
        if self.residual(point(scaled)) is None:
            return None
        end = descend(
            lambda scaled: root * self.tracker.residual(point(scaled), self.shift), jacobian,
            scaled, (low / sizes, high / sizes), iterations, least=self.enough, damping=1e-6,
        )  # fmt: skip
        return replace(end, point=point(end.point))
