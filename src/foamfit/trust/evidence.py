"""What speaks for a model: AICc and BIC where the noise is reached, else what it predicts.

AICc and BIC count the effective samples and parameters: neither correlated residuals nor
combinations of parameters that the curves do not fix are evidence. They take the residuals for
noise, so they do not hold where every model has an error of its own; then models are compared by
how well they predict blocks of the test that are held back.

Cross-validation in blocks (Burman, Chow & Nolan 1994, Biometrika 81, 351): neighbouring residuals
are alike where a law does not follow a foam, so single samples held back would be predicted by
their neighbours. Contiguous blocks in time are held back instead, each in turn; the parameters are
fitted to the rest from the best point on, and the whole history is simulated, so that the blocks
are predicted with the state in which the test enters them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.fitting import levenberg
from foamfit.fitting.branches import branch_of_samples
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import Tracker, squares
from foamfit.results import Fit, rung_name
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import NOTHING
from foamfit.trust.residuals.noise_process import autocorrelation_time
from foamfit.trust.residuals.residual_tests import neighbours_test, runs_test

# Residuals are random where neither test of their order rejects it at the first level. Below the
# second their order is an error of the model for sure: one true model in twenty or ten fails the
# first by chance, hardly one the second.
LEVEL, SURE = 0.05, 1e-4
# By how much AICc and BIC must both fall for a richer model to be preferred: "strong" evidence of
# Kass & Raftery (1995), J. Am. Stat. Assoc. 90, 773.
MARGIN = 6.0
# Where no model reaches the noise: by what share each further parameter of a richer model must
# lower the predicted misfit for it to be preferred.
SHARE = 0.03
# A model whose misfit is this many times that of another with as many parameters is not chosen,
# whatever it predicts.
WORSE = 2.0
# Below this misfit (over the range) residuals are the simulation's own error.
EXACT = 1e-5
# Blocks in time: an eighth of a loop takes a whole feature of it away (the turning point, the first
# stress), so that the prediction is a matter of chance; from two dozen on the ranking is stable.
BLOCKS = 24
# Levenberg-Marquardt steps of the fit without one block, which ends when two in a row gain less
# than a share.
STEPS, ENOUGH = 20, 1e-3


def misfit_of(objective: Objective, residual: Array) -> float:
    """RMS over the measured ranges of all counted curves, of a residual as the objective has it."""
    spans = np.repeat([objective.span(name) for name in objective.counted], objective.sizes)
    return math.sqrt(float(np.mean((residual[: spans.size] / spans) ** 2)))


def predicted_misfit(best: BestPoint, deadline: float | None = None) -> float:
    """RMS over the measured ranges of the samples of each block, predicted from the others.

    Raises SearchStoppedError if the time (`time.monotonic`) is past the deadline.
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
        functions = squares(tracker, space, rest)
        end = levenberg.descend(*functions, start, space.box, STEPS, enough=ENOUGH)
        there = objective.residual(space.decode(end.point))
        predicted[~rest] = there[~rest]
    return misfit_of(objective, predicted)


@dataclass(eq=False)
class Tried:
    """A fitted model: its result, "with" or "without" damping, its best point, and its run time.

    `predicted` is the RMS over the range of samples that were held back, None where the time did
    not allow it; `misfit` that of all samples, not less than the simulation's own error, like the
    chi-square `chisqr`. `curves` are the residuals of each, and `grams` their JᵀJ, J the derivative
    by relative changes, (n_curves, k, k).
    """

    result: Fit
    damping: str
    best: BestPoint
    seconds: float
    predicted: float | None = None

    def __post_init__(self) -> None:
        """Compute all that the comparison needs."""
        best, objective = self.best, self.best.problem.objective
        self.name = rung_name(self.result.model, self.damping, self.result.relaxation)
        self.varied = sum(item.vary for item in self.result.parameters.values())
        self.counted, self.sizes = objective.counted, objective.sizes
        self.spans = [objective.span(name) for name in self.counted]  # in the unit of the residual
        residual = best.residual[: objective.n_data]
        self.curves = list(objective.by_curve(residual).values())
        self.taus = [autocorrelation_time(curve) for curve in self.curves]
        self.grams = np.array([one.T @ one for one in objective.by_curve(best.scaled).values()])
        floor = sum(n * (EXACT * s) ** 2 for n, s in zip(self.sizes, self.spans, strict=True))
        self.chisqr = max(float(residual @ residual), floor)
        self.misfit = max(misfit_of(objective, residual), EXACT)
        # p-values of all curves together (Bonferroni)
        self.runs_p, self.neighbours_p = (
            min(1.0, len(self.sizes) * min(map(test, self.curves)))
            for test in (runs_test, neighbours_test)
        )
        least = min(self.runs_p, self.neighbours_p)
        self.structureless = self.chisqr <= floor or least >= LEVEL  # only noise is left
        self.errs = self.chisqr > floor and least < SURE  # an error of the model is left for sure

    @property
    def n_eff(self) -> float:
        """Effective samples n/τ of all curves."""
        return float(sum(n / tau for n, tau in zip(self.sizes, self.taus, strict=True)))

    @property
    def places(self) -> list[NDArray[np.str_]]:
        """Branches that the springs are on at each counted sample of each curve."""
        words = branch_of_samples(self.best.problem, self.best.simulated)
        return [words[self.best.problem.objective.kept(name)] for name in self.counted]

    def states(self, state: str) -> tuple[str, ...]:
        """Names of the parameters in a state."""
        return tuple(n for n, item in self.result.parameters.items() if item.state == state)


@dataclass(frozen=True)
class Criteria:
    """Information criteria of a model, all models by one measure of the noise."""

    rank: int
    aicc: float
    bic: float

    def beats(self, other: Criteria) -> bool:
        """Whether AICc and BIC both speak for this one, strongly."""
        return self.aicc < other.aicc - MARGIN and self.bic < other.bic - MARGIN


def reference_of(tried: Sequence[Tried]) -> Tried:
    """The model of the least chi-square: its residuals are taken for the noise of all.

    As the variance inflation of the global model in QAICc (Burnham & Anderson 2002, Model Selection
    and Multimodel Inference, section 2.5): what a simpler model leaves over is not noise.
    """
    return min(tried, key=lambda one: one.chisqr)


def effective_parameters(grams: Array, reference: Tried) -> int:
    """How many combinations of its parameters the curves fix against the noise.

    The rank of the Jacobian (`grams` as in `Tried`), counted against the residuals of `reference`
    as noise: a direction counts if its 95 % interval is narrower than a relative change of
    ±`NOTHING`, the limit at which a parameter is called not determined. Where a linear spring in
    series only bends the branches of a bistable one, the curves do not depend on such combinations.
    """
    information = np.zeros(grams.shape[1:])
    for gram, part, tau in zip(grams, reference.curves, reference.taus, strict=True):
        information += gram / (max(float(part @ part), 1e-300) / part.size * tau)
    singular = np.sqrt(np.maximum(np.linalg.eigvalsh(information), 0.0))
    return max(int(np.count_nonzero(NOTHING * singular > 1.96)), 1)


def criteria(one: Tried, reference: Tried) -> Criteria:
    """AICc and BIC of a model: n_eff ln(χ²/n) and the penalty for its effective parameters."""
    n_eff = reference.n_eff
    rank = effective_parameters(one.grams, reference)
    fit = n_eff * math.log(max(one.chisqr, 1e-300) / sum(one.sizes))
    freedom = n_eff - rank - 1.0
    aicc = fit + 2.0 * rank + 2.0 * rank * (rank + 1.0) / freedom if freedom > 0.0 else math.inf
    return Criteria(rank, aicc, fit + rank * math.log(max(n_eff, 1.0)))


@dataclass(frozen=True)
class Score:
    """What a comparison by prediction uses: parameters, fitted and predicted misfit."""

    varied: int
    misfit: float
    predicted: float

    def beats(self, other: Score) -> bool:
        """Whether it predicts better, by `SHARE` for each parameter that it has more."""
        return self.predicted < other.predicted * (1.0 - SHARE) ** (self.varied - other.varied)

    def rules_out(self, other: Score) -> bool:
        """Whether it has no more parameters and follows the curves better, or much better.

        Better is enough for fewer parameters; as many need `WORSE` times better.
        """
        factor = 1.0 if self.varied < other.varied else WORSE
        return self.varied <= other.varied and factor * self.misfit < other.misfit


@dataclass(frozen=True)
class Decision:
    """Which model is chosen, and what it and the others were compared with."""

    best: int
    criteria: tuple[Criteria, ...]
    by_prediction: bool  # Else by AICc and BIC
    # Of each model: the best of those with fewer parameters, None of the first; another that
    # follows the curves better with no more parameters, if any.
    before: tuple[int | None, ...]
    ruled_out_by: tuple[int | None, ...]


def scores_of(tried: Sequence[Tried]) -> list[Score]:
    """Scores of all models; the fitted misfit is that predicted if one has no prediction."""
    known = all(one.predicted is not None for one in tried)
    return [
        Score(one.varied, one.misfit, one.predicted if known and one.predicted else one.misfit)
        for one in tried
    ]


def decide(scores: Sequence[Score], criteria: Sequence[Criteria], by_prediction: bool) -> Decision:
    """Go through the models from the fewest parameters up; see `choose`."""
    before: list[int | None] = [None] * len(scores)
    rulers = [
        next((j for j, other in enumerate(scores) if j != i and other.rules_out(one)), None)
        for i, one in enumerate(scores)
    ]
    best: int | None = None
    judged: Sequence[Any] = scores if by_prediction else criteria
    for i in sorted(range(len(scores)), key=lambda i: scores[i].varied):
        before[i] = best
        if rulers[i] is None and (best is None or judged[i].beats(judged[best])):
            best = i
    assert best is not None  # the model of the least misfit and fewest parameters is not ruled out
    return Decision(best, tuple(criteria), by_prediction, tuple(before), tuple(rulers))


def choose(tried: Sequence[Tried]) -> Decision:
    """Choose the simplest model that no richer one beats.

    AICc and BIC decide where at least one model comes to the noise; else the misfit of samples that
    were held back decides.
    """
    reference = reference_of(tried)
    found = [criteria(one, reference) for one in tried]
    return decide(scores_of(tried), found, all(one.errs for one in tried))
