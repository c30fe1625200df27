"""Levenberg-Marquardt: the one descent of the search and of refits close to a minimum."""

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


def damped_step(residual: Array, jacobian: Array, damping: float, held: NDArray[np.bool_]) -> Array:
    """Gauss-Newton step of what is not held, its damping over the diagonal of the normal matrix."""
    gradient = jacobian.T @ residual
    moving = np.flatnonzero(~held)
    step = np.zeros(gradient.size)
    if moving.size:
        own = jacobian[:, moving]
        normal = own.T @ own
        scale = np.maximum(np.diag(normal), 1e-12 * max(float(np.trace(normal)), 1e-300))
        step[moving] = np.linalg.solve(normal + damping * np.diag(scale), -gradient[moving])
    return step


def _expected(at: Iterate, gradient: Array, step: Array) -> float:
    """Gain of the cost that the Jacobian predicts for a step."""
    return -float(step @ (2.0 * gradient + at.jacobian.T @ (at.jacobian @ step)))


def descend(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    start: Array,
    box: tuple[Array, Array],
    iterations: int,
    *,
    enough: float = 0.0,
    least: float = 0.0,
    damping: float = 1e-3,
) -> Iterate:
    """Descend inside a box; what lies at a limit and is pressed outwards is held.

    The damping follows the gain ratio (Nielsen 1999, IMM-REP-1999-05). It ends when two steps in a
    row lower the cost by less than the share `enough`, or when the expected gain is below `least`.
    """
    low, high = box
    at = Iterate(start, residual(start), jacobian(start))
    growth, small = 2.0, 0
    for _ in range(iterations):
        gradient = at.jacobian.T @ at.residual
        held = ((at.point <= low) & (gradient > 0)) | ((at.point >= high) & (gradient < 0))
        step = damped_step(at.residual, at.jacobian, damping, held | (low == high))
        if not step.any() or _expected(at, gradient, step) < least:
            break
        trial = np.clip(at.point + step, low, high)
        moved = trial - at.point
        found = residual(trial)
        gain = at.cost - float(found @ found)
        if gain > 0.0:
            small = small + 1 if gain < enough * at.cost else 0
            ratio = gain / max(_expected(at, gradient, moved), 1e-300)
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
    return at
