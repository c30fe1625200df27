"""Levenberg-Marquardt: the damped step and the two descents that use it.

`descend` takes a new Jacobian at each step, for the search; `descend_updated` keeps one up by
Broyden's rank-one updates (Broyden 1965, Math. Comp. 19, 577), for refits close to a minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array


@dataclass(frozen=True, eq=False)
class Iterate:
    """A point with its residual and the derivative of the residual by scaled coordinates."""

    point: Array
    residual: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    def updated(self, point: Array, residual: Array, step: Array) -> Iterate:
        """The iterate a scaled step away, its Jacobian by Broyden's update."""
        error = residual - self.residual - self.jacobian @ step
        return Iterate(point, residual, self.jacobian + np.outer(error, step / (step @ step)))


def damped_step(
    at: Iterate, coordinates: Array, low: Array, high: Array, damping: float,
    free: NDArray[np.bool_] | bool = True,
) -> Array:  # fmt: skip
    """Damped Gauss-Newton step; what lies at a limit and is pressed outwards is held.

    `coordinates` (k,) stand between `low` and `high`, `damping` is over the diagonal of the normal
    matrix; those that are not `free` do not move.
    """
    gradient = at.jacobian.T @ at.residual
    pressed = ((coordinates <= low) & (gradient > 0)) | ((coordinates >= high) & (gradient < 0))
    moving = np.flatnonzero(~pressed & free)
    step = np.zeros(gradient.size)
    if moving.size:
        own = at.jacobian[:, moving]
        # Two copies are multiplied with other rounding than one with itself; flat fits show it.
        normal = (at.jacobian[:, moving] if free is True else own).T @ own
        scale = np.maximum(np.diag(normal), 1e-12 * max(float(np.trace(normal)), 1e-300))
        step[moving] = np.linalg.solve(normal + damping * np.diag(scale), -gradient[moving])
    return step


def descend(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    start: Array,
    box: tuple[Array, Array],
    iterations: int,
    enough: float,
) -> tuple[float, Array]:
    """Descend inside a box; returns (cost, coordinates) of the end.

    The damping follows the gain ratio (Nielsen 1999, IMM-REP-1999-05). It ends when two steps in a
    row lower the cost by less than the share `enough`.
    """
    low, high = box
    at = Iterate(start, residual(start), jacobian(start))
    damping, growth, small = 1e-3, 2.0, 0
    for _ in range(iterations):
        step = damped_step(at, at.point, low, high, damping)
        if not step.any():
            break
        trial = np.clip(at.point + step, low, high)
        moved = trial - at.point
        slope = 2.0 * (at.jacobian.T @ at.residual) + at.jacobian.T @ (at.jacobian @ moved)
        expected = -float(moved @ slope)
        found = residual(trial)
        gain = at.cost - float(found @ found)
        if gain > 0.0:
            small = small + 1 if gain < enough * at.cost else 0
            ratio = gain / max(expected, 1e-300)
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
            growth = 2.0
            at = replace(at, point=trial, residual=found)
            if small == 2:
                break
            at = replace(at, jacobian=jacobian(trial))
        else:
            damping *= growth
            growth *= 2.0
            if damping > 1e8 or float(np.max(np.abs(moved))) < 1e-9:
                break
    return at.cost, at.point


def descend_updated(
    residual: Callable[[Array], Array | None],
    step_from: Callable[[Iterate, float], Array],
    move: Callable[[Iterate, Array], tuple[Array, Array]],
    at: Iterate,
    iterations: int,
    enough: float,
) -> tuple[Iterate, bool, bool]:
    """Descend by the Jacobian of the start and its updates, until `enough` gain is not expected.

    `residual` of a point is None where it cannot be simulated; `move` gives the point that a step
    leads to and the step taken. Returned are the end, whether no more gain is expected, and whether
    the Jacobian predicted a gain badly.
    """
    damping, growth, poor = 1e-6, 4.0, False
    for _ in range(iterations):
        step = step_from(at, damping)
        along = at.jacobian @ step
        expected = -float(along @ (2.0 * at.residual + along))
        if expected < enough:
            return at, True, poor
        point, taken = move(at, step)
        found = residual(point)
        gain = -1.0
        if found is None or not taken.any():
            poor = True
        else:
            trial = at.updated(point, found, taken)
            gain = at.cost - trial.cost
            poor = poor or gain <= 0.25 * expected
            at = trial if gain > 0.0 else replace(at, jacobian=trial.jacobian)
        if gain > 0.0:
            damping, growth = damping * (0.2 if gain > 0.75 * expected else 1.0), 4.0
        else:
            damping, growth = max(damping, 1e-3) * growth, 2.0 * growth
    return at, False, poor
