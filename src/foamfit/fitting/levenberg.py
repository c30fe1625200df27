"""The Levenberg-Marquardt method for one test and for several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg.lapack import dposv

from foamfit.arrays import Array

# Largest number of consecutive Broyden updates of the Jacobian, and the largest relative difference
# between actual and predicted gain for which it is updated.
UPDATES, PREDICTED = 6, 0.5
# A descent ends where a step fails whose predicted gain is below this multiple of `least`: it is of
# the size of errors of the simulation.
LITTLE = 100.0
SHORTEST = 0.1  # a failed step is followed by one of at least about this fraction of its length
FOLLOWING = (1e-9, 1e-6, 1e-3, 0.1)  # damping of the trial steps in `following`

Jacobian = Any  # an array, or a csr_array of several tests


@dataclass(frozen=True, eq=False)
class Iterate:
    """A point, its residual, and the derivative of the residual by scaled coordinates."""

    point: Array
    residual: Array
    jacobian: Jacobian  # (n, k)
    damping: float | None = None  # with which a descent from here goes on

    @cached_property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    @cached_property
    def gradient(self) -> Array:
        """Half the gradient of the cost, Jᵀr."""
        return np.asarray(self.jacobian.T @ self.residual)

    @cached_property
    def normal(self) -> Array:
        """Normal matrix JᵀJ."""
        with np.errstate(over="ignore", invalid="ignore"):  # derivatives of a hopeless trial
            normal = self.jacobian.T @ self.jacobian
        return np.asarray(normal if isinstance(normal, np.ndarray) else normal.toarray())

    def expected(self, step: Array) -> float:
        """Return the decrease of the cost that the Jacobian predicts for a step."""
        return -float(step @ (2.0 * self.gradient + self.normal @ step))

    def updated(self, point: Array, residual: Array) -> Iterate:
        """Return another point with Broyden's update of the Jacobian (1965, Math. Comp. 19, 577).

        It is the nearest Jacobian that reproduces the observed change of the residual.
        """
        step = point - self.point
        shown = residual - self.residual - self.jacobian @ step
        jacobian = self.jacobian + np.outer(shown, step / float(step @ step))
        return Iterate(point, residual, jacobian)


def damped_step(gradient: Array, normal: Array, damping: float, held: NDArray[np.bool_]) -> Array:
    """Return the Gauss-Newton step of the coordinates not `held`.

    `damping` multiplies the diagonal of the normal matrix.
    """
    step, moving = np.zeros(gradient.size), (~held).nonzero()[0]
    if not moving.size:
        return step
    own, slope = normal.copy(), gradient
    if moving.size < gradient.size:
        own, slope = normal[moving[:, None], moving], gradient[moving]
    diagonal = own.ravel()[:: moving.size + 1]  # a view
    diagonal += damping * np.maximum(diagonal, 1e-12 * max(float(diagonal.sum()), 1e-300))
    _, found, failed = dposv(own, -slope)
    step[moving] = np.linalg.solve(own, -slope) if failed else found
    return step


def following(at: Iterate, shift: Array, held: NDArray[np.bool_]) -> list[Array]:
    """Return steps that shift the `held` coordinates, alone and with all others following.

    The others follow to first order. As this may lead far off along poorly determined directions,
    each step is damped more than the previous one.
    """
    ahead = at.gradient + at.normal @ shift
    return [shift, *(shift + damped_step(ahead, at.normal, one, held) for one in FOLLOWING)]


def descend(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Jacobian],
    start: Array | Iterate,
    box: tuple[Array, Array] | Array,
    iterations: int,
    *,
    enough: float = 0.0,
    least: float = 0.0,
    damping: float = 1e-3,
    stale: bool = False,
) -> Iterate:
    """Minimise a sum of squares inside a box; an Iterate continues a descent.

    The Jacobian of a `stale` one is that of a nearby point.

    A coordinate at a limit whose gradient points outwards is fixed for the step. The damping
    follows the gain ratio (Nielsen 1999, IMM-REP-1999-05). A failed step is followed by one that
    ends about where the parabola through its cost, and through the cost and slope at the point, has
    its minimum (Dennis & Schnabel 1983, 6.3.2). The descent ends after two consecutive steps that
    lower the cost by less than the fraction `enough`, when the predicted gain is below `least`, or
    when a step fails that promised little more. Points with an infinite residual are rejected; the
    start must have a finite one. A dense Jacobian, that of a single test, is updated while steps
    gain what it predicts; a descent ends with an exact one unless it runs out of `iterations`.
    """
    low, high = box
    fixed = low == high
    if isinstance(start, Iterate):
        at, damping = start, start.damping or damping
    else:
        at = Iterate(start, residual(start), jacobian(start))
    growth, small, updates = 2.0, 0, int(stale)
    for _ in range(iterations):
        held = ((at.point <= low) & (at.gradient > 0)) | ((at.point >= high) & (at.gradient < 0))
        step = damped_step(at.gradient, at.normal, damping, held | fixed)
        ended = not step.any() or at.expected(step) < least
        if not ended:
            trial = np.minimum(np.maximum(at.point + step, low), high)
            moved = trial - at.point
            found = residual(trial)
            gain = at.cost - float(found @ found)
            if gain > 0.0:
                small = small + 1 if gain < enough * at.cost else 0
                ratio = gain / max(at.expected(moved), 1e-300)
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
                growth = 2.0
                if small >= 2 and not updates:
                    return replace(at, point=trial, residual=found, damping=damping)
                close = abs(ratio - 1.0) < PREDICTED and updates < UPDATES and small < 2
                if close and not sparse.issparse(at.jacobian):
                    updates += 1
                    at = at.updated(trial, found)
                else:
                    updates, at = 0, Iterate(trial, found, jacobian(trial))
                continue
            if not updates:
                slope = -2.0 * float(at.gradient @ moved)
                part = 0.5 * slope / max(slope - gain, 1e-300)
                damping *= max(growth, 1.0 / min(max(part, SHORTEST), 0.5) ** 2)
                growth *= 2.0
                little = at.expected(step) < LITTLE * least
                ended = little or damping > 1e8 or float(np.max(np.abs(moved))) < 1e-9
        if updates:
            updates, at = 0, Iterate(at.point, at.residual, jacobian(at.point))
        elif ended:
            break
    return replace(at, damping=damping)
