"""What the error of a law leaves open: parameters that follow the curves about as well.

Where a law misses part of the curves, its best point depends on the weights of the samples, the
window of time that is fitted and on the minimum of the cost that is found. The range of a
parameter is the hull of its values over such descriptions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.search import Tracker
from foamfit.trust.best_point import BestPoint
from foamfit.trust.profile import BETTER, ENOUGH, Refit
from foamfit.trust.residuals.law_error import CurveError

# A description follows the curves about as well if the RMS of what it misses of them, the noise
# taken off, is larger by this factor at most.
ALIKE = 1.2
# Weight of some samples over that of the others, and windows that are left out in turn.
HEAVIER, WINDOWS = 4.0, 3
# Iterations of a refit, and trials to find one that follows the curves about as well.
ITERATIONS, TRIALS = 6, 4
# Iterations of a descent to another minimum.
DESCENT = 15


def tolerance(best: BestPoint, errors: Sequence[CurveError] | None = None) -> float:
    """Rise of the cost up to which a description follows the curves about as well."""
    found, sizes = best.errors if errors is None else errors, best.problem.objective.sizes
    missed = sum(n * error.law**2 for error, n in zip(found, sizes, strict=True))
    return (ALIKE**2 - 1.0) * missed


def alike(
    best: BestPoint, minima: Sequence[Array], tracker: Tracker, budget: float = math.inf
) -> list[Array]:
    """Descriptions that follow the curves about as well as the best point, which is the first.

    Ends of the search's descents (`minima`); refits with each parameter held as far off as it can
    be, starting from where it would be if the law were linear; and refits with other weights of the
    samples, moved back towards the best point where they miss too much. After `budget` evaluations
    no further refit is begun.
    """
    most, refit = tolerance(best), Refit(best, tracker)
    refit.enough, allowed = 0.01 * most, tracker.objective.evaluations + budget
    out = [best.values, *(point for point in minima if refit.rise(point) <= most)]
    inverse = np.linalg.pinv(best.scaled.T @ best.scaled, rcond=1e-12, hermitian=True)
    for column, row in enumerate(inverse):
        for limit, sign in zip(best.box[:, column], (-1.0, 1.0), strict=True):
            if tracker.objective.evaluations < allowed:
                out += _held(refit, column, sign, float(limit), row, most)
    for weights in _weights(best):
        if tracker.objective.evaluations < allowed:
            out += _towards(refit, weights, most)
    return out


@dataclass(frozen=True, eq=False)
class Open:
    """What the error of a law leaves open: nothing where only noise is left of the curves."""

    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)  # of each parameter
    minima: tuple[Array, ...] = ()  # to which descriptions that follow the curves descend
    better: Array | None = None  # a point of lower cost: the fit should go on from there


def left_open(
    best: BestPoint,
    minima: Sequence[Array],
    tracker: Tracker,
    budget: float = math.inf,
    descents: bool = True,
) -> Open:
    """Ranges of the parameters, and minima near by that the search has not found; see `alike`.

    Without `descents`, a half to two thirds of the work, such minima are not looked for.
    """
    if not best.misfits:
        return Open()
    allowed = tracker.objective.evaluations + budget
    points = alike(best, minima, tracker, budget)
    refit, further = Refit(best, tracker), []
    for point in points[1:] if descents else ():
        new = not any(point is other for other in minima)
        if new and tracker.objective.evaluations < allowed:
            found = refit.run(point, iterations=DESCENT)
            further += [] if found is None else [found.point]
    values = np.array(points)[:, best.places] + 0.0  # no -0
    ends = zip(values.min(axis=0).tolist(), values.max(axis=0).tolist(), strict=True)
    lower = best.cost - tracker.best_cost > refit.enough / ENOUGH * BETTER  # of a cut
    better = tracker.best_values if lower else None
    return Open(dict(zip(best.names, ends, strict=True)), tuple(further), better)


def _weights(best: BestPoint) -> Iterator[Array]:
    """Weights of the counted samples: loading, unloading, low or high stress heavier; windows."""
    objective = best.problem.objective
    stress, number = objective.stress, np.arange(objective.time.size)
    loading, low = number <= int(np.argmax(stress)), stress < 0.5 * float(np.max(stress))
    heavy = [loading, ~loading, low, ~low]
    heavy += [number * WINDOWS // stress.size != window for window in range(WINDOWS)]
    for samples in heavy:
        kept = [samples[objective.kept(name)] for name in objective.counted]
        priors = np.zeros(len(objective.priors), dtype=bool)
        yield np.where(np.concatenate([*kept, priors]), HEAVIER, 1.0)


def _towards(refit: Refit, weights: Array, most: float) -> list[Array]:
    """Refit with other weights, moved towards the best point until it follows the curves."""
    best, share = refit.best, 1.0
    found = refit.run(best.values, weights=weights, iterations=ITERATIONS)
    assert found is not None  # the best point can be simulated
    step = (found.point - best.values)[best.places] / best.sizes
    for _ in range(TRIALS):
        point = refit.moved(best.values, share * step)
        missed = refit.rise(point)
        if missed <= most:
            return [point]
        share *= nearer(most, missed, 0.9)
    return []


def _held(
    refit: Refit, column: int, sign: float, limit: float, along: Array, most: float
) -> list[Array]:
    """Refit with one parameter held as far off as the curves are followed about as well."""
    best = refit.best
    size, value = best.sizes[column], best.values[best.places[column]]
    if not along[column] > 0.0:
        return []
    off = min(math.sqrt(most * along[column]), abs(limit - value) / size)
    for _ in range(TRIALS if off > 0.0 else 0):
        point = refit.moved(best.values, sign * off * along / along[column])
        hold = (column, value + sign * off * size)
        found = refit.run(point, hold, iterations=ITERATIONS)
        missed = math.inf if found is None else found.cost - best.cost
        if found is not None and missed <= most:
            return [found.point]
        off *= nearer(most, missed, 0.8)
    return []


def nearer(most: float, missed: float, largest: float) -> float:
    """Factor of a step whose rise was too large; the rise is about the square of the step."""
    return min(max(math.sqrt(most / missed), 0.3), largest) if math.isfinite(missed) else 0.5
