"""Least squares near the best point, and profiles: the least cost at fixed values of a parameter.

A rise of the cost is divided by `Covariance.inflation`, which accounts for correlated noise. If the
cost is a parabola, profile and local interval are therefore the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.fitting.levenberg import Iterate, descend, following
from foamfit.fitting.search import STOPPING, Tracker, what_stopped
from foamfit.results import Profile
from foamfit.trust.best_point import BestPoint

# A refit ends if the expected gain of the cost is below this share of the 95 % cut; with a coarser
# limit its end would depend on the start, and so on rounding.
ENOUGH = 1e-6
STEPS = 40  # largest number of steps of a refit
# A profile is followed until its χ² is this multiple of the 95 % cut, to cross small barriers
# between shallow minima.
BEYOND = 2.0
# Largest number of refits on one side of a profile: outward until beyond the cut, and to place it.
OUTWARD, INWARD = 14, 6
# The root of χ² at a crossing differs from the root of the cut by at most this share.
PLACED = 0.02
# A profile that falls below the best point by this share of the cut has found a better minimum.
BETTER = 0.01


@dataclass(eq=False)
class Refit:
    """Least squares near the best point."""

    best: BestPoint
    tracker: Tracker  # simulates, counts evaluations and raises at the deadline

    def __post_init__(self) -> None:
        """Set the space of the parameters and the gain at which a refit ends."""
        self.space = self.best.problem.space()
        cuts = self.best.quantiles**2 * self.best.spread.inflation  # rise at the ends of intervals
        self.enough = ENOUGH * float(min(cuts[np.isfinite(cuts)], default=1.0))

    def residual(self, point: Array) -> Array | None:
        """Return the residual of a point; None if the simulation fails."""
        objective = self.tracker.objective
        failures, residual = objective.failures, self.tracker.residual(point)
        return residual if objective.failures == failures else None

    def rise(self, point: Array) -> float:
        """Return the rise of the cost from the best point; infinite if the simulation fails."""
        residual = self.residual(point)
        return np.inf if residual is None else float(residual @ residual) - self.best.cost

    def point(self, scaled: Array, box: Array) -> Array:
        """Return all parameters from the scaled ones, clipped to the limits `box` (SI)."""
        point = self.best.values.copy()
        point[self.best.places] = np.clip(scaled * self.best.sizes, *box)
        return self.space.admit(point, self.best.places[box[0] == box[1]])

    def moved(self, at: Array, step: Array) -> Array:
        """Return a point moved by a scaled step, clipped to the limits."""
        return self.point(at[self.best.places] / self.best.sizes + step, self.best.box)

    def along(self, column: int, shift: float) -> Array:
        """Return the best point with a parameter shifted (SI) and the others by correlation."""
        covariance = self.best.spread.matrix[:, column]
        along = np.nan_to_num(covariance / covariance[column]) / self.best.sizes
        return self.moved(self.best.values, shift * along)

    def run(
        self,
        start: Array,
        hold: tuple[int, float] | None = None,
        *,
        iterations: int = STEPS,
        near: Iterate | None = None,
    ) -> Iterate | None:
        """Descend from a point; `hold` is the column and the value of a fixed parameter, if any.

        The Jacobian of a point `near` the start saves one of its own. Returns None if the start
        cannot be simulated.
        """
        best, sizes, box = self.best, self.best.sizes, self.best.box.copy()
        if hold is not None:
            box[:, hold[0]] = hold[1]

        def residual(scaled: Array) -> Array:
            return self.tracker.residual(self.point(scaled, box))

        def jacobian(scaled: Array) -> Array:
            return np.asarray(best.problem.slopes(self.point(scaled, box), best.names) * sizes)

        begin = np.clip(start[best.places], *box) / sizes
        first = self.residual(self.point(begin, box))
        if first is None:
            return None
        at = Iterate(begin, first, jacobian(begin) if near is None else near.jacobian)
        end = descend(
            residual, jacobian, at, box / sizes, iterations, least=self.enough, damping=1e-6,
            stale=near is not None,
        )  # fmt: skip
        return replace(end, point=self.point(end.point, box))


class _Side:
    """One side of a profile, below (-1) or above (+1): refits from the best point outward."""

    def __init__(self, refit: Refit, name: str, sign: float) -> None:
        best, self.column = refit.best, refit.best.names.index(name)
        self.refit, self.sign, self.place = refit, sign, best.index[name]
        self.quantile, self.half = float(best.quantiles[self.column]), best.halves[self.column]
        self.limit = best.limits(name)[0 if sign < 0 else 1]
        self.refits = [Iterate(best.values, best.residual, best.scaled)]

    def value(self, at: Iterate) -> float:
        """Return the fixed value of the parameter."""
        return float(at.point[self.place])

    def rise(self, at: Iterate) -> float:
        """Return the rise of the cost as a χ²."""
        return float(self.refit.best.rises(at.residual)[self.column])

    def root(self, at: Iterate) -> float:
        """Return the root of the rise, which is linear along a parabola."""
        return math.sqrt(max(self.rise(at), 0.0))

    @property
    def better(self) -> bool:
        """Whether a point of clearly lower cost than the best one was found."""
        return min(map(self.rise, self.refits)) < -BETTER * self.quantile**2

    @property
    def bracket(self) -> tuple[Iterate, Iterate | None]:
        """The outermost refit below the cut, and the next one; None if the profile is open."""
        last = max(i for i, at in enumerate(self.refits) if self.root(at) < self.quantile)
        return self.refits[last], self.refits[last + 1] if last + 1 < len(self.refits) else None

    @property
    def bound(self) -> float:
        """Value at which the root of the rise crosses that of the cut, or else the limit."""
        inner, outer = self.bracket
        if outer is None:
            return self.limit
        share = (self.quantile - self.root(inner)) / (self.root(outer) - self.root(inner))
        return self.value(inner) + share * (self.value(outer) - self.value(inner))

    def follow(self) -> None:
        """Go outward until well beyond the cut, and place the crossing."""
        step, refused = 0.5 * self.half, 0
        for _ in range(OUTWARD):
            last = self.refits[-1]
            if self.value(last) == self.limit or refused > 3:
                break
            value = self.value(last) + self.sign * step
            over = self.sign * (value - self.limit) > 0.0
            found = self._hold(self.limit if over else value, last)
            if found is None:
                step, refused = 0.3 * step, refused + 1
                continue
            self.refits.append(found)
            if self.rise(found) >= BEYOND * self.quantile**2 or self.better:
                break
            if self.root(found) - self.root(last) < 0.35 * self.quantile:
                step *= 1.6
        for _ in range(INWARD):
            inner, outer = self.bracket
            if outer is None or self.better:
                break
            miss = min(abs(self.root(at) - self.quantile) for at in (inner, outer))
            placed = miss <= PLACED * self.quantile
            if placed or (found := self._hold(self.bound, inner)) is None:
                break
            self.refits.append(found)
            self.refits.sort(key=lambda at: self.sign * self.value(at))

    def _hold(self, value: float, near: Iterate) -> Iterate | None:
        """Refit at a fixed value, starting from a nearby refit; None if the start fails.

        At the start the other parameters follow if that lowers the cost.
        """
        shift = np.zeros(len(self.refit.best.names))
        shift[self.column] = (value - self.value(near)) / self.refit.best.sizes[self.column]
        alone, *together = following(near, shift, np.arange(shift.size) == self.column)
        start = self.refit.moved(near.point, alone)
        least = self.refit.rise(start)
        for step in together:
            trial = self.refit.moved(near.point, step)
            if self.refit.rise(trial) < least:
                start = trial
                break
        return self.refit.run(start, (self.column, value), near=near)


def trace(best: BestPoint, name: str, tracker: Tracker) -> tuple[Profile, Array | None]:
    """Follow the least cost along a parameter to both sides, past the 95 % cut.

    It uses the adjusted likelihood ratio: the rise of the cost over `Covariance.inflation` is a χ²
    of one degree of freedom even if noise is correlated (Chandler & Bate 2007, Biometrika 94, 167).
    If the deadline or Ctrl-C ends it early, it is incomplete and `ci95` covers only the part
    computed so far. A point of clearly lower cost than the best one, if there is one, is returned
    too.
    """
    refit, stopped = Refit(best, tracker), None
    low, high = _Side(refit, name, -1.0), _Side(refit, name, 1.0)
    try:
        low.follow()
        high.follow()
    except STOPPING as error:
        stopped = what_stopped(error)
    refits = low.refits[::-1] + high.refits[1:]
    better = min(refits, key=lambda at: at.cost).point if low.better or high.better else None
    begun = stopped is None or len(high.refits) > 1
    profile = Profile(
        name=name,
        values=np.array([low.value(at) for at in refits]),
        rises=np.array([low.rise(at) for at in refits]),
        points=np.array([at.point for at in refits]),
        cut=low.quantile**2,
        ci95=(low.bound, high.bound if begun else best.value(name)),
        stopped=stopped,
    )
    return profile, better


def departures(best: BestPoint) -> Array:
    """Return the departure of the cost from a parabola at both ends of each interval, (k, 2).

    A parameter is moved to an end of its local interval (less if the simulation fails there), the
    others follow their correlation, and one linear step of these, with the local slopes, completes
    the refit. The departure is the root of the rise over that of a parabola, less 1; it is zero if
    a limit is close to the best point, infinite if the simulation fails.
    """
    refit, k = Refit(best, Tracker(best.problem.objective)), len(best.names)
    out, normal = np.zeros((k, 2)), best.scaled.T @ best.scaled

    def least(residual: Array, others: NDArray[np.intp]) -> float:
        """Return the sum of squares after one linear step of the other parameters."""
        inverse = np.linalg.pinv(normal[np.ix_(others, others)], rcond=1e-10, hermitian=True)
        slope = best.scaled[:, others].T @ residual
        return float(residual @ residual - slope @ inverse @ slope)

    for i, side in np.ndindex(k, 2):
        others, half = np.delete(np.arange(k), i), float(best.halves[i])
        to_limit = abs(float(best.box[side, i] - best.values[best.places[i]]))
        if not to_limit > 0.05 * half:
            continue
        out[i, side] = np.inf
        for share in (1.0, 0.5, 0.25):
            shift = min(share * half, to_limit)
            residual = refit.residual(refit.along(i, shift if side else -shift))
            if residual is not None:
                rise = least(residual, others) - least(best.residual, others)
                root = math.sqrt(max(rise / float(best.spread.inflation[i]), 0.0))
                out[i, side] = root * float(best.spread.stderr[i]) / shift - 1.0
                break
    return out
