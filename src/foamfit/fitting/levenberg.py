"""Levenberg-Marquardt: the descent of one test, of several, and of refits near a minimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array

# Steps in a row after which the Jacobian is only updated, and how far the gain of such a step may
# be from the expected one, as a share of it.
UPDATES, PREDICTED = 6, 0.5
# Damping of the first step of what follows a move; more, until it lowers the cost.
FOLLOWING = (1e-9, 1e-6, 1e-3, 0.1)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Jacobian of the residuals of several tests, one under the other.

    Each test has the derivatives (n_t, c_t) of its residual by those of the `count` coordinates
    that it depends on, and their places.
    """

    tests: Sequence[tuple[Array, NDArray[np.intp]]]
    count: int

    def gradient(self, residual: Array) -> Array:
        """Return Jᵀr."""
        out, first = np.zeros(self.count), 0
        for slopes, places in self.tests:
            out[places] += slopes.T @ residual[first : first + len(slopes)]
            first += len(slopes)
        return out

    @property
    def normal(self) -> Array:
        """JᵀJ."""
        out = np.zeros((self.count, self.count))
        for slopes, places in self.tests:
            out[np.ix_(places, places)] += slopes.T @ slopes
        return out


@dataclass(frozen=True, eq=False)
class Iterate:
    """A point with its residual and the derivative of the residual by scaled coordinates."""

    point: Array
    residual: Array
    jacobian: Any  # (n, k), or the Blocks of several tests

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    @cached_property
    def gradient(self) -> Array:
        """Half the gradient of the cost, Jᵀr."""
        if isinstance(self.jacobian, Blocks):
            return self.jacobian.gradient(self.residual)
        return np.asarray(self.jacobian.T @ self.residual)

    @cached_property
    def normal(self) -> Array:
        """Normal matrix JᵀJ."""
        if isinstance(self.jacobian, Blocks):
            return self.jacobian.normal
        return np.asarray(self.jacobian.T @ self.jacobian)

    def expected(self, step: Array) -> float:
        """Gain of the cost that the Jacobian predicts for a step."""
        return -float(step @ (2.0 * self.gradient + self.normal @ step))

    def updated(self, point: Array, residual: Array) -> Iterate:
        """Return another point, its Jacobian that of this one but for what the step has shown.

        Of all Jacobians that agree with the step it is the one nearest to this (Broyden 1965, Math.
        Comp. 19, 577).
        """
        step = point - self.point
        shown = residual - self.residual - self.jacobian @ step
        return Iterate(point, residual, self.jacobian + np.outer(shown, step / float(step @ step)))


def damped_step(gradient: Array, normal: Array, damping: float, held: NDArray[np.bool_]) -> Array:
    """Gauss-Newton step of what is not held, its damping over the diagonal of the normal matrix."""
    moving = np.flatnonzero(~held)
    step = np.zeros(gradient.size)
    if moving.size:
        own = normal[np.ix_(moving, moving)]  # a copy
        diagonal = np.einsum("ii->i", own)  # a view
        diagonal += damping * np.maximum(diagonal, 1e-12 * max(float(diagonal.sum()), 1e-300))
        step[moving] = np.linalg.solve(own, -gradient[moving])
    return step


def following(at: Iterate, shift: Array, held: NDArray[np.bool_]) -> list[Array]:
    """Steps that move what is `held` by a shift, alone and with all else following to first order.

    Where the data hardly fix what follows, the whole step may lead far off: each is damped more
    than the one before it.
    """
    ahead = at.gradient + at.normal @ shift
    return [shift, *(shift + damped_step(ahead, at.normal, one, held) for one in FOLLOWING)]


def descend(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array | Blocks],
    start: Array,
    box: tuple[Array, Array] | Array,
    iterations: int,
    *,
    enough: float = 0.0,
    least: float = 0.0,
    damping: float = 1e-3,
) -> Iterate:
    """Descend inside a box; what lies at a limit and is pressed outwards is held.

    The damping follows the gain ratio (Nielsen 1999, IMM-REP-1999-05). It ends when two steps in a
    row lower the cost by less than the share `enough`, or when the expected gain is below `least`.
    A point with an infinite residual is refused; the start must have a finite one. Where steps gain
    what was expected the Jacobian of one test, which costs as much as many residuals, is updated;
    no descent ends on an updated one unless its `iterations` are over.
    """
    low, high = box
    at = Iterate(start, residual(start), jacobian(start))
    growth, small, updates = 2.0, 0, 0
    for _ in range(iterations):
        held = ((at.point <= low) & (at.gradient > 0)) | ((at.point >= high) & (at.gradient < 0))
        step = damped_step(at.gradient, at.normal, damping, held | (low == high))
        ended = not step.any() or at.expected(step) < least
        if not ended:
            trial = np.clip(at.point + step, low, high)
            moved = trial - at.point
            found = residual(trial)
            gain = at.cost - float(found @ found)
            if gain > 0.0:
                small = small + 1 if gain < enough * at.cost else 0
                ratio = gain / max(at.expected(moved), 1e-300)
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
                growth = 2.0
                if small >= 2 and not updates:
                    return replace(at, point=trial, residual=found)
                close = abs(ratio - 1.0) < PREDICTED and updates < UPDATES and small < 2
                if close and not isinstance(at.jacobian, Blocks):
                    updates += 1
                    at = at.updated(trial, found)
                else:
                    updates, at = 0, Iterate(trial, found, jacobian(trial))
                continue
            if not updates:
                damping *= growth
                growth *= 2.0
                ended = damping > 1e8 or float(np.max(np.abs(moved))) < 1e-9
        if updates:
            updates, at = 0, Iterate(at.point, at.residual, jacobian(at.point))
        elif ended:
            break
    return at
