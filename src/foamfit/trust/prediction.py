"""How well a model predicts samples that it was not fitted to: blocks of the test held back.

Cross-validation in blocks (Burman, Chow & Nolan 1994, Biometrika 81, 351): neighbouring residuals
are alike where a law does not follow a foam, so single samples held back would be predicted by
their neighbours. Contiguous blocks in time are held back instead, each in turn; the parameters are
fitted to the rest from the best point on, and the whole history is simulated, so that the blocks
are predicted with the state in which the test enters them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting import levenberg
from foamfit.fitting.search import Tracker
from foamfit.trust.best_point import BestPoint

# Blocks in time: an eighth of a loop takes a whole feature of it away (the turning point, the first
# stress), and what is then predicted goes by chance; from two dozen on the order of models stays.
BLOCKS = 24
# Levenberg-Marquardt steps of the fit without one, which ends when two in a row gain less than a
# share.
STEPS, ENOUGH = 20, 1e-3


def misfit_of(best: BestPoint, residual: Array) -> float:
    """RMS over the measured ranges of all counted curves, of a residual as the objective has it."""
    return math.sqrt(float(np.mean((residual / _spans(best)) ** 2)))


def _spans(best: BestPoint) -> Array:
    """Measured range of the curve of each residual, in its unit, (n_data,)."""
    objective = best.problem.objective
    return np.repeat([objective.span(name) for name in objective.counted], objective.sizes)


def predicted_misfit(best: BestPoint, deadline: float | None = None) -> float:
    """RMS over the measured ranges of the samples of each block, predicted from the others.

    Raises
    ------
    SearchStoppedError
        If the time (`time.monotonic`) is past the deadline.
    """
    # With counts of its own, and each sample for itself: weighed residuals mix what is held back.
    problem, objective = best.problem, replace(best.problem.objective, weighing=None)
    space, tracker = problem.space(), Tracker(objective, deadline)
    block = np.arange(objective.time.size) * BLOCKS // objective.time.size
    of_sample = np.concatenate([block[objective.kept(name)] for name in objective.counted])
    of_sample = np.append(of_sample, np.full(len(objective.priors), BLOCKS))  # none of a block
    start, predicted = space.encode(best.values), np.empty(of_sample.size)
    for held in range(BLOCKS):
        rest = of_sample != held

        def residual(point: Array, rest: Array = rest) -> Array:
            return np.asarray(tracker.residual(space.decode(point))[rest])

        def jacobian(point: Array, rest: Array = rest) -> Array:
            values = space.decode(point)
            moves = space.slopes(point, values)
            return np.asarray(objective.jacobian_along(values, moves)[rest])

        end = levenberg.descend(residual, jacobian, start, space.box, STEPS, enough=ENOUGH)
        there = objective.residual(space.decode(end.point))
        predicted[~rest] = there[~rest]
    return misfit_of(best, predicted[: objective.n_data])
