"""Refits near the best point: profiles of the cost, and ranges due to model error.

A profile is the least cost at fixed values of a parameter. A rise of the cost, divided by
`Covariance.inflation`, is a χ² of one degree of freedom even if noise is correlated (the adjusted
likelihood ratio of Chandler & Bate 2007, Biometrika 94, 167). If the cost is a parabola, profile
and local interval are therefore the same.

With model error, the best point depends on the weights of the samples and on the minimum that the
search finds. The range of a parameter is the hull of its values over points that follow the curves
about as well, among them one with friction in the rig if the residuals show it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.levenberg import Iterate, descend, following
from foamfit.fitting.search import STOPPING, Tracker, squares, what_stopped
from foamfit.results import Profile
from foamfit.trust.best_point import BestPoint
from foamfit.trust.residuals import CurveError
from foamfit.trust.settle import in_order

ENOUGH = 1e-4  # a refit ends if the expected gain of the cost is below this share of the 95 % cut
STEPS = 40  # largest number of steps of a refit
# The first refit is at the end of the local interval. The first step outward from there is this
# share of half of it, each later one this multiple of the one before.
STEP, GROWTH = 0.5, 1.6
# A profile is followed until the root of χ² is this multiple of that of the cut, to cross small
# barriers between shallow minima, unless its first refit shows a parabola: the roots agree by this
# share.
BEYOND, PARABOLA = 1.4, 0.05
# Largest number of refits on one side of a profile: outward until beyond the cut, and to place it.
OUTWARD, INWARD = 14, 3
# The root of χ² of the refit next to a crossing differs from that of the cut by at most this share.
PLACED = 0.03
# A profile that falls below the best point by this share of the cut has found a better minimum.
BETTER = 0.01
# A point fits almost equally well if its RMS model error is larger by at most this factor.
ALIKE = 1.2
ITERATIONS = 6  # of a refit
TRIALS = 4  # refits until one fits almost equally well
DESCENT = 15  # iterations of a descent to another minimum


@dataclass(eq=False)
class Refit:
    """Least squares near the best point in the coordinates of the search.

    The parameter of a given name can be held; its coordinate is then its value, SI.
    """

    best: BestPoint
    tracker: Tracker  # simulates, counts evaluations and raises at the deadline
    name: str = ""

    def __post_init__(self) -> None:
        """Set the space, its box, the functions of a descent, and the best point as an iterate."""
        best = self.best
        self.space = best.problem.space((self.name,) if self.name else ())
        self.functions = squares(self.tracker, self.space)
        places = np.array([one.place for one in self.space.coordinates], dtype=np.intp)
        self.held = places == best.index.get(self.name, -1)
        point = np.where(self.held, best.values[places], self.space.encode(best.values))
        self.box = np.where(np.isin(places, best.places), self.space.box, point)
        moves = self.space.slopes(point, best.values)[best.places]
        self.origin = Iterate(point, best.residual, best.jacobian @ moves)
        column = best.names.index(self.name) if self.name else slice(None)
        cuts = (best.quantiles**2 * best.spread.inflation)[column]  # rises at ends of intervals
        self.least = ENOUGH * float(np.min(cuts, where=np.isfinite(cuts), initial=1e300))

    def shifted(self, near: Iterate, value: float) -> Iterate | None:
        """Return a point with the held parameter at a value; the others follow from a point `near`.

        They follow to first order, and less where that would raise the cost above that without
        them. The Jacobian is Broyden's update. Returns None if nothing can be simulated.
        """
        alone, *together = following(near, np.where(self.held, value - near.point, 0.0), self.held)
        most = near.cost - near.expected(alone)
        for step in (*together, alone):
            point = np.clip(near.point + step, *np.where(self.held, value, self.box))
            residual = self.tracker.possible(self.space.decode(point))
            if residual is not None and (step is alone or float(residual @ residual) <= most):
                return near.updated(point, residual) if np.any(point != near.point) else near
        return None

    def hold(self, near: Iterate, value: float, iterations: int = STEPS) -> Iterate | None:
        """Descend with the parameter held at a value, from a point near it; None if that fails."""
        start = self.shifted(near, value)
        if start is None:
            return None
        return self.descend(start, np.where(self.held, value, self.box), iterations)

    def descend(self, start: Iterate | Array, box: Array, iterations: int) -> Iterate:
        """Descend in a box; the Jacobian of an iterate is only that of a nearby point."""
        return descend(
            *self.functions, start, box, iterations, least=self.least, damping=1e-6,
            stale=isinstance(start, Iterate),
        )  # fmt: skip

    def after_step(self, at: Iterate) -> float:
        """Return the sum of squares after one step of all but the held one, with local slopes."""
        slopes = self.origin.jacobian[:, ~self.held]
        ahead = slopes @ np.linalg.lstsq(slopes, at.residual, rcond=1e-10)[0]
        return float(at.residual @ (at.residual - ahead))

    def values(self, at: Iterate) -> Array:
        """Return all parameters of a point, SI."""
        return self.space.decode(at.point)


class _Side:
    """One side of a profile, below (-1) or above (+1): refits from the best point outward."""

    def __init__(self, refit: Refit, sign: float) -> None:
        best, column = refit.best, refit.best.names.index(refit.name)
        self.refit, self.sign, self.inflation = refit, sign, best.spread.inflation[column]
        self.quantile, self.half = float(best.quantiles[column]), float(best.halves[column])
        self.limit = best.limits(refit.name)[0 if sign < 0 else 1]
        self.refits = [refit.origin]

    def value(self, at: Iterate) -> float:
        """Return the fixed value of the parameter."""
        return float(at.point[self.refit.held][0])

    def rise(self, at: Iterate) -> float:
        """Return the rise of the cost as a χ²."""
        return (at.cost - self.refit.origin.cost) / float(self.inflation)

    def root(self, at: Iterate) -> float:
        """Return the root of the rise over that of the cut; it is linear along a parabola."""
        return math.sqrt(max(self.rise(at), 0.0)) / self.quantile

    @property
    def better(self) -> bool:
        """Whether a point of clearly lower cost than the best one was found."""
        return min(map(self.rise, self.refits)) < -BETTER * self.quantile**2

    @property
    def bracket(self) -> tuple[Iterate, Iterate | None]:
        """The outermost refit below the cut, and the lowest of those farther out, if there are any.

        A refit between the two that lies above the cut has stalled.
        """
        last = max(i for i, at in enumerate(self.refits) if self.root(at) < 1.0)
        return self.refits[last], min(self.refits[last + 1 :], key=self.root, default=None)

    @property
    def parabola(self) -> bool:
        """Whether the only refit is near the cut, as along a parabola."""
        return len(self.refits) == 2 and abs(self.root(self.refits[-1]) - 1.0) <= PARABOLA

    def crossing(self, inner: Iterate, outer: Iterate) -> float:
        """Return the value at which a line through the roots of two refits crosses the cut."""
        (low, high), (x, y) = map(self.root, (inner, outer)), map(self.value, (inner, outer))
        return x + (1.0 - low) / (high - low) * (y - x)

    @property
    def bound(self) -> float:
        """Value at which the root of the rise crosses that of the cut, or else the limit."""
        inner, outer = self.refits if self.parabola else self.bracket
        return self.limit if outer is None else self._within(self.crossing(inner, outer))

    def follow(self) -> None:
        """Go outward until well beyond the cut, and place the crossing."""
        self._go_outward()
        for _ in range(0 if self.parabola else INWARD):
            inner, outer = self.bracket
            if outer is None or self.better:
                break
            near = min(abs(self.root(at) - 1.0) for at in (inner, outer))
            found = None if near <= PLACED else self.refit.hold(inner, self.crossing(inner, outer))
            if found is None:
                break
            self.refits.append(found)
            self.refits.sort(key=lambda at: self.sign * self.value(at))

    def _go_outward(self) -> None:
        step, refused = self.half, 0
        for _ in range(OUTWARD):
            last = self.refits[-1]
            if self.value(last) == self.limit or refused > 3:
                break
            found = self.refit.hold(last, self._within(self.value(last) + self.sign * step))
            if found is None:
                step, refused = 0.3 * step, refused + 1
                continue
            self.refits.append(found)
            if self.root(found) >= BEYOND or self.better or self.parabola:
                break
            step *= STEP if step == self.half else GROWTH

    def _within(self, value: float) -> float:
        """Return a value, or the limit if it lies beyond."""
        return self.limit if self.sign * (value - self.limit) > 0.0 else value


def trace(best: BestPoint, name: str, tracker: Tracker) -> tuple[Profile, Array | None]:
    """Follow the least cost along a parameter past the 95 % cut to both sides.

    If the deadline or Ctrl-C ends it early, it is incomplete. A point of clearly lower cost than
    the best one, if there is one, is returned too.
    """
    refit, stopped = Refit(best, tracker, name), None
    low, high = _Side(refit, -1.0), _Side(refit, 1.0)
    try:
        low.follow()
        high.follow()
    except STOPPING as error:
        stopped = what_stopped(error)
    refits = low.refits[::-1] + high.refits[1:]
    better = low.better or high.better
    profile = Profile(
        name=name,
        values=np.array([low.value(at) for at in refits]),
        rises=np.array([low.rise(at) for at in refits]),
        points=np.array([refit.values(at) for at in refits]),
        cut=low.quantile**2,
        ci95=(low.bound, high.bound),
        stopped=stopped,
    )
    return profile, refit.values(min(refits, key=lambda at: at.cost)) if better else None


def departures(best: BestPoint) -> dict[str, float]:
    """Return the departure of the cost from a parabola for each parameter, at least zero.

    A parameter is moved to an end of its local interval, the others follow, and one linear step of
    these, with the local slopes, completes the refit. The departure is the difference between 1 and
    the root of the rise over that of a parabola, the larger one of both ends; a limit close to the
    best point has none. It is infinite if the simulation fails.
    """
    out, tracker = dict.fromkeys(best.names, 0.0), Tracker(best.problem.objective)
    columns = zip(best.halves, best.spread.stderr, best.spread.inflation, strict=True)
    for name, (half, stderr, inflation) in zip(best.names, columns, strict=True):
        refit, value = Refit(best, tracker, name), best.value(name)
        for limit in best.limits(name):
            if not abs(limit - value) > 0.05 * half:
                continue
            shift = min(max(limit - value, -half), half)
            found, root = refit.shifted(refit.origin, value + shift), math.inf
            if found is not None:
                rise = refit.after_step(found) - refit.after_step(refit.origin)
                root = math.sqrt(max(rise / inflation, 0.0)) * stderr / abs(shift)
            out[name] = max(out[name], abs(root - 1.0))
    return out


# ---------------------------------------------------------------- ranges


def tolerance(best: BestPoint, errors: Sequence[CurveError] | None = None) -> float:
    """Return the largest rise of the cost of a point that fits almost equally well."""
    errors, sizes = best.errors if errors is None else errors, best.problem.objective.sizes
    missed = sum(n * error.law**2 for error, n in zip(errors, sizes, strict=True))
    return (ALIKE**2 - 1.0) * missed


def ends_alike(best: BestPoint, minima: Sequence[Array], tracker: Tracker) -> list[Array]:
    """Return the ends of descents (`minima`) and of hops that fit almost as well as the best point.

    Their springs are in order.
    """
    most, space, out = tolerance(best), best.problem.space(), list[Array]()
    for point in (*minima, *(space.decode(space.encode(met)) for met in tracker.met)):
        residual = tracker.possible(point)
        if residual is not None and float(residual @ residual) - best.cost <= most:
            out.append(in_order(space, tracker.objective, point))
    return out


def refits_alike(best: BestPoint, tracker: Tracker, allowed: float) -> Iterator[Array]:
    """Refit with each parameter fixed as far as a point still fits almost as well as the best one.

    The refits start from the linear prediction. After `allowed` evaluations none is begun.
    """
    inverse = np.linalg.pinv(best.scaled.T @ best.scaled, rcond=1e-12, hermitian=True)
    for (name, along), side in product(zip(best.names, inverse, strict=True), (0, 1)):
        if tracker.objective.spent.evaluations < allowed:
            yield from _held(Refit(best, tracker, name), side, along * best.sizes, tolerance(best))


@dataclass(frozen=True, eq=False)
class Open:
    """Ranges due to model error, and points found on the way; empty if there is only noise."""

    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)  # of each parameter
    minima: tuple[Array, ...] = ()  # to which points that fit almost equally well descend
    better: Array | None = None  # a point of lower cost from which the fit should continue


def left_open(
    best: BestPoint,
    minima: Sequence[Array],
    tracker: Tracker,
    budget: float = math.inf,
    descents: bool = True,
) -> Open:
    """Find the ranges of the parameters, and nearby minima that the search missed.

    The ranges are those of `ends_alike` and `refits_alike`. Without `descents`, which are half to
    two thirds of the work, these minima are not computed.
    """
    if not best.misfits:
        return Open()
    points = [best.values, *ends_alike(best, minima, tracker)]
    allowed = tracker.objective.spent.evaluations + budget
    refits = list(refits_alike(best, tracker, allowed))
    refit, further = Refit(best, tracker), list[Array]()
    for point in refits if descents else ():
        if tracker.objective.spent.evaluations < allowed:
            found = refit.descend(refit.space.encode(point), refit.box, DESCENT)
            further.append(refit.values(found))
    values = np.array([*points, *refits])[:, best.places] + 0.0  # turns -0 into 0
    # With each held contact time or zero off by ± its error, to first order.
    steps = best.answer(np.concatenate([best.shifts, -best.shifts], axis=1)).T
    values = np.concatenate([values, np.clip(best.values[best.places] + steps, *best.box)])
    if best.friction is not None:
        values = np.concatenate([values, best.friction[1][None, best.places]])
    ends = zip(values.min(axis=0).tolist(), values.max(axis=0).tolist(), strict=True)
    lower = best.cost - tracker.best_cost > BETTER * refit.least / ENOUGH
    better = tracker.best_values if lower else None
    return Open(dict(zip(best.names, ends, strict=True)), tuple(further), better)


def _held(refit: Refit, side: int, along: Array, most: float) -> list[Array]:
    """Refit with one parameter fixed as far to one side as the rise `most` allows.

    `along` is the step (SI) of all parameters that raises the linear cost by the scaled one of it.
    """
    best, name, column = refit.best, refit.name, refit.best.names.index(refit.name)
    size, value, refit.least = best.sizes[column], best.value(name), 0.01 * most
    if not along[column] > 0.0:
        return []
    shift = min(math.sqrt(most * along[column] * size), abs(best.limits(name)[side] - value))
    for _ in range(TRIALS if shift > 0.0 else 0):
        moved, sign = best.values.copy(), 1.0 if side else -1.0
        steps = sign * shift * along / along[column]
        moved[best.places] = np.clip(moved[best.places] + steps, *best.box)
        held = np.where(refit.held, value + sign * shift, refit.box)
        found = refit.descend(refit.space.encode(moved), held, ITERATIONS)
        if found.cost - best.cost <= most:
            return [refit.values(found)]
        shift *= nearer(most, found.cost - best.cost)
    return []


def nearer(most: float, rise: float) -> float:
    """Return the factor for a step whose rise was too large; the rise is about quadratic."""
    return min(max(math.sqrt(most / rise), 0.3), 0.8) if math.isfinite(rise) else 0.5
