"""Ranges of the parameters due to model error: values that fit almost equally well.

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
from foamfit.fitting.minima import in_order
from foamfit.fitting.search import Tracker
from foamfit.trust.best_point import BestPoint
from foamfit.trust.profile import BETTER, ENOUGH, Refit
from foamfit.trust.residuals.law_error import CurveError

# A point fits almost equally well if its RMS model error is larger by at most this factor.
ALIKE = 1.2
ITERATIONS = 6  # of a refit
TRIALS = 4  # refits until one fits almost equally well
DESCENT = 15  # iterations of a descent to another minimum


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
        if tracker.objective.evaluations < allowed:
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
    allowed = tracker.objective.evaluations + budget
    refits = list(refits_alike(best, tracker, allowed))
    refit, further = Refit(best, tracker), list[Array]()
    for point in refits if descents else ():
        if tracker.objective.evaluations < allowed:
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
