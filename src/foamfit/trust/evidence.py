"""Evidence for a model: AICc and BIC if a model reaches the noise, else cross-validation.

Tests of the randomness of residuals show whether a model reaches the noise; `find_structure` shows
where it does not.

AICc and BIC use the numbers of effective samples and parameters, so that neither correlated
residuals nor combinations of parameters that the curves do not fix count as evidence. They assume
that the residuals are noise. If every model has an error of its own, models are compared by how
well they predict contiguous blocks in time that are held out in turn (Burman, Chow & Nolan 1994,
Biometrika 81, 351); single samples would be predicted by their neighbours. The parameters are
fitted to the rest, starting from the best point, and the complete history is simulated, so that
each block is predicted with the state in which the test enters it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from foamfit.arrays import Array
from foamfit.fitting import levenberg
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import Tracker, squares
from foamfit.parts import law_in_words
from foamfit.results import Fit
from foamfit.trust.best_point import BestPoint, branch_of_samples
from foamfit.trust.covariance import NOTHING
from foamfit.trust.residuals import autocorrelation_time

# p-value of the runs and neighbours tests below which residuals are not random. One true model in
# ten to twenty fails by chance.
LEVEL = 0.05
SURE = 1e-4  # p-value below which the residuals certainly contain model error
# Reduction of both AICc and BIC for which a richer model is preferred: "strong" evidence in Kass &
# Raftery (1995), J. Am. Stat. Assoc. 90, 773.
MARGIN = 6.0
# If no model reaches the noise, a richer model is preferred if it lowers the predicted misfit by
# this share per additional parameter.
SHARE = 0.03
# A model is not chosen if its misfit is more than this many times that of another model with as
# many parameters, whatever its prediction.
WORSE = 2.0
EXACT = 1e-5  # below this misfit over range, residuals are the numerical error of the simulation
# Number of blocks in time. With 8, a block removes an entire feature of the loop (turning point,
# first stress), and its prediction is a matter of chance; from about 24 on the ranking is stable.
BLOCKS = 24
# Largest number of Levenberg-Marquardt steps without a block, and the relative gain of the cost
# below which two successive steps end the fit.
STEPS, ENOUGH = 20, 1e-3
BENT = 0.6  # structure is called bent if a parabola removes more than this share of its squares


def runs_test(residual: Array) -> float:
    """Return the p-value of too few runs (Wald & Wolfowitz 1940, Ann. Math. Stat. 11, 147).

    Given n₊ positive and n₋ negative residuals in random order, the number of runs of one sign has
    mean μ = 2 n₊n₋/n + 1 and variance (μ-1)(μ-2)/(n-1), and is nearly normal (here with continuity
    correction). The test is one-sided: slow waves make few runs; alternating noise is not
    structure. Residuals are in the order of time; zeros are omitted.
    """
    signs = residual[residual != 0.0] > 0.0
    n, positive = signs.size, int(np.count_nonzero(signs))
    if positive in (0, n):
        return min(math.ldexp(1.0, 1 - n), 1.0)  # probability that n random signs are all the same
    runs = 1 + int(np.count_nonzero(signs[1:] != signs[:-1]))
    mean = 2.0 * positive * (n - positive) / n + 1.0
    variance = max((mean - 1.0) * (mean - 2.0) / (n - 1.0), 1e-300)  # 0 of two samples
    return float(special.ndtr((runs + 0.5 - mean) / math.sqrt(variance)))


def neighbours_test(residual: Array) -> float:
    """Return the p-value of similar neighbouring residuals (von Neumann 1941, Ann. Math. Stat. 12).

    For white noise Σ r_i r_{i+1} / Σ r_i² is nearly normal with variance 1/n. The test is
    one-sided. It uses the size of the residuals and so detects a short strong wave that the runs
    test misses; the runs test uses their signs and is not misled by a few large residuals.
    """
    power = float(residual @ residual)
    if residual.size < 2 or power == 0.0:
        return 1.0
    rho = float(residual[1:] @ residual[:-1]) / power
    return float(special.ndtr(-rho * math.sqrt(residual.size)))


def misfit_of(objective: Objective, residual: Array) -> float:
    """Return the RMS over range of a residual, over all fitted curves."""
    spans = np.repeat([objective.span(name) for name in objective.counted], objective.sizes)
    return math.sqrt(float(np.mean((residual[: spans.size] / spans) ** 2)))


def predicted_misfit(best: BestPoint, deadline: float | None = None) -> float:
    """Return the RMS over range of all samples, each predicted without its block.

    Raises SearchStoppedError if the time (`time.monotonic`) is past the deadline.
    """
    # A new objective has its own counters. Weighing would mix held-out samples with others.
    problem, objective = best.problem, replace(best.problem.objective, weighing=None)
    space, tracker = problem.space(), Tracker(objective, deadline)
    block = np.arange(objective.time.size) * BLOCKS // objective.time.size
    of_sample = np.concatenate([block[objective.kept[name]] for name in objective.counted])
    of_sample = np.append(of_sample, np.full(len(objective.priors), BLOCKS))  # in no block
    start, predicted = space.encode(best.values), np.empty(of_sample.size)
    for held_out in range(BLOCKS):
        rest = of_sample != held_out
        functions = squares(tracker, space, rest)
        end = levenberg.descend(*functions, start, space.box, STEPS, enough=ENOUGH)
        predicted[~rest] = objective.residual(space.decode(end.point))[~rest]
    return misfit_of(objective, predicted)


@dataclass(eq=False)
class Tried:
    """A fitted model: its result, "with" or "without" damping, its best point and run time (s).

    `predicted` is the RMS over range of held-out samples, None if time ran out. `misfit` is that of
    all samples. `misfit` and `chisqr` are at least those of the simulation's numerical error.
    `curves` contains the residual of each curve and `grams` (n_curves, k, k) its JᵀJ, with J the
    derivative by relative changes.
    """

    result: Fit
    damping: str
    best: BestPoint
    seconds: float
    predicted: float | None = None

    def __post_init__(self) -> None:
        """Compute the quantities of the comparison."""
        best, objective = self.best, self.best.problem.objective
        self.name = law_in_words(self.result.model, self.result.relaxation, self.damping)
        self.varied = sum(item.vary for item in self.result.parameters.values())
        self.counted, self.sizes = objective.counted, objective.sizes
        self.spans = [objective.span(name) for name in self.counted]  # in units of the residual
        residual = best.residual[: objective.n_data]
        self.curves = list(objective.by_curve(residual).values())
        self.taus = [autocorrelation_time(curve) for curve in self.curves]
        self.grams = np.array([part.T @ part for part in objective.by_curve(best.scaled).values()])
        floor = sum(n * (EXACT * s) ** 2 for n, s in zip(self.sizes, self.spans, strict=True))
        self.chisqr = max(float(residual @ residual), floor)
        self.misfit = max(misfit_of(objective, residual), EXACT)
        # p-values of all curves together (Bonferroni)
        self.runs_p, self.neighbours_p = (
            min(1.0, len(self.sizes) * min(map(test, self.curves)))
            for test in (runs_test, neighbours_test)
        )
        least = min(self.runs_p, self.neighbours_p)
        self.structureless = self.chisqr <= floor or least >= LEVEL  # residuals are only noise
        self.errs = self.chisqr > floor and least < SURE  # residuals contain model error

    @property
    def n_eff(self) -> float:
        """Effective samples n/τ of all curves."""
        return float(sum(n / tau for n, tau in zip(self.sizes, self.taus, strict=True)))

    def structure(self) -> dict[str, Any]:
        """Return what is "left" in the least random "curve", and its "size" over the range."""
        worst = int(np.argmin([min(runs_test(one), neighbours_test(one)) for one in self.curves]))
        name, problem = self.counted[worst], self.best.problem
        branches = branch_of_samples(problem, self.best.simulated)
        left = find_structure(self.curves[worst], branches[problem.objective.kept[name]])
        return {"left": left, "curve": name, "size": left.size / self.spans[worst]}

    def states(self, state: str) -> tuple[str, ...]:
        """Return the names of the parameters in a state."""
        return tuple(n for n, item in self.result.parameters.items() if item.state == state)


@dataclass(frozen=True)
class Criteria:
    """Information criteria of a model, with the same noise for all models."""

    rank: int
    aicc: float
    bic: float

    def beats(self, other: Criteria) -> bool:
        """Whether AICc and BIC both strongly favour this model."""
        return self.aicc < other.aicc - MARGIN and self.bic < other.bic - MARGIN


def reference_of(tried: Sequence[Tried]) -> Tried:
    """Return the model of the least χ², whose residuals are taken as the noise of all models.

    This corresponds to the variance inflation of the global model in QAICc (Burnham & Anderson
    2002, Model Selection and Multimodel Inference, section 2.5): the larger residuals of a simpler
    model are not noise.
    """
    return min(tried, key=lambda one: one.chisqr)


def effective_parameters(grams: Array, reference: Tried) -> int:
    """Return the number of combinations of parameters that the curves determine.

    This is the rank of the Jacobian (`grams` as in `Tried`) with the residuals of `reference` as
    noise: a direction counts if its 95 % interval is narrower than a relative change of ±`NOTHING`,
    the limit at which a parameter is called not determined. Where a linear spring in series only
    bends the branches of a bistable one, the curves do not depend on some combinations.
    """
    information = np.zeros(grams.shape[1:])
    for gram, part, tau in zip(grams, reference.curves, reference.taus, strict=True):
        information += gram / (max(float(part @ part), 1e-300) / part.size * tau)
    singular = np.sqrt(np.maximum(np.linalg.eigvalsh(information), 0.0))
    return max(int(np.count_nonzero(NOTHING * singular > 1.96)), 1)


def criteria(one: Tried, reference: Tried) -> Criteria:
    """Return AICc and BIC of a model: n_eff ln(χ²/n) plus a penalty for effective parameters."""
    n_eff, rank = reference.n_eff, effective_parameters(one.grams, reference)
    fit = n_eff * math.log(max(one.chisqr, 1e-300) / sum(one.sizes))
    freedom = n_eff - rank - 1.0
    aicc = fit + 2.0 * rank + 2.0 * rank * (rank + 1.0) / freedom if freedom > 0.0 else math.inf
    return Criteria(rank, aicc, fit + rank * math.log(max(n_eff, 1.0)))


@dataclass(frozen=True)
class Score:
    """Number of parameters, and fitted and predicted misfit, for a comparison by prediction."""

    varied: int
    misfit: float
    predicted: float

    def beats(self, other: Score) -> bool:
        """Whether it predicts better, by `SHARE` for each additional parameter."""
        return self.predicted < other.predicted * (1.0 - SHARE) ** (self.varied - other.varied)

    def rules_out(self, other: Score) -> bool:
        """Whether it follows the curves better with fewer parameters, or `WORSE` times better."""
        factor = 1.0 if self.varied < other.varied else WORSE
        return self.varied <= other.varied and factor * self.misfit < other.misfit


@dataclass(frozen=True)
class Decision:
    """Choice of a model, and which other model each was compared with."""

    best: int
    criteria: tuple[Criteria, ...]
    by_prediction: bool  # otherwise by AICc and BIC
    before: tuple[int | None, ...]  # best model with fewer parameters; None for the first
    ruled_out_by: tuple[int | None, ...]  # see `Score.rules_out`; None if not ruled out


def decide(scores: Sequence[Score], criteria: Sequence[Criteria], by_prediction: bool) -> Decision:
    """Compare the models in the order of their number of parameters; see `choose`."""
    before: list[int | None] = [None] * len(scores)
    rulers = [
        next((j for j, other in enumerate(scores) if other.rules_out(one)), None) for one in scores
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

    AICc and BIC decide if at least one model reaches the noise, otherwise the misfit of held-out
    samples, or the fitted misfit if any model has no prediction.
    """
    reference = reference_of(tried)
    by_noise = [criteria(one, reference) for one in tried]
    predicted = [one.predicted or one.misfit for one in tried]
    if any(one.predicted is None for one in tried):
        predicted = [one.misfit for one in tried]
    scores = [Score(one.varied, one.misfit, p) for one, p in zip(tried, predicted, strict=True)]
    return decide(scores, by_noise, all(one.errs for one in tried))


@dataclass(frozen=True)
class Structure:
    """Place of the largest structure in the residual of a curve."""

    # Root of the mean product of neighbouring residuals, in their units; 0 for white noise.
    size: float
    place: str  # branches of the springs, and loading or unloading
    share: float  # of all structure
    bent: float  # share of the squares there that a parabola over the samples removes

    @property
    def straight(self) -> bool:
        """Whether a spring is there on a branch that is a straight line in the law."""
        return "on d" in self.place or "on e" in self.place


def find_structure(residual: Array, places: NDArray[np.str_]) -> Structure:
    """Find the place, as of `branch_of_samples`, with the largest structure."""
    product, branches = residual[1:] * residual[:-1], places[1:]
    sums = {str(place): float(product[branches == place].sum()) for place in np.unique(places)}
    place = max(sums, key=lambda key: sums[key])
    total = sum(max(value, 0.0) for value in sums.values())
    own, bent = residual[places == place], 0.0
    if own.size >= 8 and own.any():
        base = np.vander(np.linspace(-1.0, 1.0, own.size), 3)
        left = own - base @ np.linalg.lstsq(base, own, rcond=None)[0]
        bent = 1.0 - float(left @ left) / float(own @ own)
    size = math.sqrt(max(float(product.mean()), 0.0))
    return Structure(size, place, sums[place] / total if total > 0.0 else 0.0, bent)
