"""Least squares close to the best point, with one parameter held or none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.levenberg import Iterate, descend
from foamfit.fitting.losses import soften, softness
from foamfit.fitting.search import Tracker
from foamfit.trust.best_point import BestPoint

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
        """Find the box of the parameters and the gain at which a refit ends."""
        best = self.best
        self.space = best.problem.space()
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

    def rise(self, point: Array) -> float:
        """Rise of the cost from the best point; infinite where nothing can be simulated."""
        residual = self.residual(point)
        return np.inf if residual is None else float(residual @ residual) - self.best.cost

    def point(self, scaled: Array, box: Array) -> Array:
        """Vector of all parameters from the scaled ones, moved between these limits (SI)."""
        point = self.best.values.copy()
        point[self.best.places] = np.clip(scaled * self.best.sizes, *box)
        return self.space.admit(point, self.best.places[box[0] == box[1]])

    def moved(self, at: Array, step: Array) -> Array:
        """Point that is off another by a scaled step, within the limits."""
        return self.point(at[self.best.places] / self.best.sizes + step, self.best.box)

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
        problem, names, sizes = self.best.problem, self.best.names, self.best.sizes
        root, box = np.sqrt(weights), self.best.box.copy()
        if hold is not None:
            box[:, hold[0]] = hold[1]

        def residual(scaled: Array) -> Array:
            if scaled is begin:
                return np.asarray(root * first)
            return np.asarray(root * self.tracker.residual(self.point(scaled, box), self.shift))

        def jacobian(scaled: Array) -> Array:
            point = self.point(scaled, box)
            slopes: Array = problem.linear.slopes(point, names) * np.reshape(root, (-1, 1))
            if problem.objective.loss == "linear":
                return slopes * sizes
            return self._jacobian(problem.objective.differences(point) - self.shift, slopes)

        begin = np.clip(start[self.best.places], *box) / sizes
        first = self.residual(self.point(begin, box))
        if first is None:
            return None
        limits = box[0] / sizes, box[1] / sizes
        end = descend(
            residual, jacobian, begin, limits, iterations, least=self.enough, damping=1e-6
        )
        return replace(end, point=self.point(end.point, box))
