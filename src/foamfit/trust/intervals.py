"""The 95 % intervals of a fit: choice of method, computation and warnings.

The local covariance assumes that the cost is a parabola. Where branches a and d are about equally
stiff it is not: it is flat along ε_a, with several shallow minima. There, profiles are computed.
Markov chains are computed only on request.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.search import STOPPING, Tracker, what_stopped
from foamfit.results import Intervals, Profile
from foamfit.springs.parameters import NUISANCE
from foamfit.trust import say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import WEAK, Uncertainty
from foamfit.trust.refits import BETTER, PLACED, Refit, departures, trace

# "auto" profiles a parameter if the root of the cost departs from a straight line by this share at
# an end of its local interval.
BENT = 0.15
# Assumed number of refits per profile and of evaluations per refit, for the expected run time.
REFITS, EVALUATIONS = 6, 8.0
# Smallest number of samples of a Markov chain from which percentiles are computed.
ENOUGH_DRAWS = 40
# A minimum is hardly worse than the best if the root of its χ² is within this multiple of the 95 %
# cut. Noise alone exceeds that in one test of ten thousand, but there are many minima.
HARDLY_WORSE = 2.0
# A value is far outside its interval beyond this multiple of the width: one, less rounding.
FAR = 1.0 - 1e-9
ITERATIONS = 10  # iterations of a refit at a value one width outside an interval
# Largest start distance of a walker from the best point along an undetermined direction, over the
# scales of the parameters.
FARTHEST = 0.1
Announce = Callable[[str], None]
# Points at which descents ended, their residuals and `_halves`.
Minima = Sequence[tuple[Array, Array, Array]]


@dataclass(frozen=True)
class Choice:
    """Requested intervals."""

    method: str = "auto"  # one of `options.METHODS`
    draws: int = 0  # steps of the Markov chain
    seed: int = 0  # of the random numbers
    ranges: bool = True  # whether to compute ranges where there is model error

    def __post_init__(self) -> None:
        """Reject a method whose package is missing."""
        if self.method == "mcmc" and importlib.util.find_spec("emcee") is None:
            raise InputError(
                'Markov chains need emcee, which is not installed; pip install "foamfit[mcmc]"'
            )


def assess(
    best: BestPoint,
    choice: Choice,
    searched: Tracker | None = None,
    minima: Sequence[Array] = (),
    budget: float = math.inf,
    announce: Announce = lambda _: None,
) -> Intervals:
    """Compute the requested intervals.

    `minima` are the points at which the descents of the search ended. At the deadline of the
    tracker `searched` the computation stops with partial results. "auto" begins no new profile
    after `budget` evaluations, and none if there is model error. `announce` is called with the
    expected run time beforehand.
    """
    method, known = choice.method, best.known
    if method == "local":
        return Intervals()
    tracker = Tracker(best.problem.objective, best_cost=best.cost)
    if searched is not None:
        tracker.deadline, tracker.pulse = searched.deadline, searched.pulse
    if not known:
        return Intervals(warnings=() if method == "auto" else (say("interval", "nothing"),))
    if method != "auto":
        count, began = evaluations_of(best, choice), time.perf_counter()
        tracker.consider(best.values)
        seconds = count * (time.perf_counter() - began)
        announce(say("interval", "cost", by=method, count=count, seconds=seconds))
    if method == "mcmc":
        return _by_mcmc(best, choice, tracker)
    others = [(x, residual := tracker.consider(x), _halves(best, x, residual)) for x in minima]
    bent, far = known, dict[str, float]()
    if method == "auto" and best.misfits:  # the range, which includes model error, decides
        bent = []
    elif method == "auto":
        far = departures(best)
        for point, residual, _ in others:  # a minimum within the cut but outside the local interval
            apart = np.abs(point - best.values)[best.places] / best.spread.stderr
            near = (best.rises(residual) < best.quantiles**2) & (apart > best.quantiles)
            far |= {name: math.inf for name, found in zip(best.names, near, strict=True) if found}
        bent = sorted((name for name in known if far[name] > BENT), key=lambda name: -far[name])
    made = _by_profiles(best, bent, tracker, budget if method == "auto" else math.inf)
    made = _with_minima(best, made, others)
    done = method == "profile" or best.misfits or made.better is not None
    return made if done else _with_far(best, made, tracker)


def evaluations_of(best: BestPoint, choice: Choice) -> float:
    """Return the expected number of evaluations for profiles or MCMC; 0 for other methods."""
    if choice.method == "mcmc":
        return float((choice.draws + 1) * walkers(best))
    return EVALUATIONS * REFITS * len(best.known) if choice.method == "profile" else 0.0


def _with_minima(best: BestPoint, made: Intervals, minima: Minima) -> Intervals:
    """Extend the intervals to minima that other noise could make the best; note values far off."""
    ends, methods = dict(made.ends), dict(made.methods)
    intervals = {name: made.ends.get(name, best.local(name)) for name in best.known}
    for point, _, halves in minima:
        for name, (low, high) in intervals.items():
            if math.isfinite(half := float(halves[best.names.index(name)])):
                value = float(point[best.index[name]])
                wider = min(low, value - half), max(high, value + half)
                if wider[1] - wider[0] > (1.0 + PLACED) * (high - low):
                    intervals[name] = ends[name] = wider
                    methods[name] = "other minima"
    made, elsewhere = replace(made, ends=ends, methods=methods), dict[str, float]()
    for point, residual, _ in () if best.misfits else minima:
        elsewhere = _far_values(best, made, point, residual) | elsewhere
    return replace(made, elsewhere=elsewhere)


def _far_values(
    best: BestPoint, made: Intervals, point: Array, residual: Array
) -> dict[str, float]:
    """Return the values of a point far outside their intervals, if it is hardly worse."""
    near, far = best.rises(residual) <= (HARDLY_WORSE * best.quantiles) ** 2, dict[str, float]()
    for name in best.known:
        value, (low, high) = float(point[best.index[name]]), made.ends.get(name, best.local(name))
        if near[best.names.index(name)] and max(low - value, value - high) > FAR * (high - low):
            far[name] = value
    return far


def _with_far(best: BestPoint, made: Intervals, tracker: Tracker) -> Intervals:
    """Find values one width outside an interval at which a refit is hardly worse.

    On a parabola, χ² there is nine times the cut. Other parameters that the refit moves as far
    outside their own intervals are included.
    """
    elsewhere, warnings = dict(made.elsewhere), made.warnings
    try:
        for name in best.known:
            column, refit = best.names.index(name), Refit(best, tracker, name)
            low, high = made.ends.get(name, best.local(name))
            if name in NUISANCE or high - low > 2.0 * WEAK * best.sizes[column]:
                continue
            least, most = best.limits(name)
            for outside in (2.0 * low - high, 2.0 * high - low):
                if name in elsewhere or not least <= outside <= most:
                    continue
                found = refit.hold(refit.origin, outside, ITERATIONS)
                if found is None:
                    continue
                values = refit.values(found)
                if best.rises(found.residual)[column] < -BETTER * best.quantiles[column] ** 2:
                    return replace(made, better=values)
                elsewhere = _far_values(best, made, values, found.residual) | elsewhere
    except STOPPING as error:
        warnings = (*warnings, say("interval", "far", by=what_stopped(error)))
    return replace(made, elsewhere=elsewhere, warnings=warnings)


def _halves(best: BestPoint, point: Array, residual: Array) -> Array:
    """Return half widths at another minimum, (k,); NaN if noise cannot make it the best.

    The cost is assumed to be a parabola about that minimum too, with the noise of the best point.
    With model error the minima are compared by the effect of noise e on the difference of their
    costs, 2 eᵀd, with d the difference of their residuals.
    """
    if best.misfits:
        apart, objective = residual - best.residual, best.problem.objective
        pairs = zip(best.errors, objective.by_curve(apart).values(), strict=True)
        spread = objective.unit**2 * float(np.sum(apart[objective.n_data :] ** 2))  # of priors
        spread += sum(float(own @ error.noise.times(own)) for error, own in pairs)
        near = float(residual @ residual) - best.cost <= 1.96 * 2.0 * math.sqrt(spread)
        return best.halves if near else np.full(best.halves.shape, np.nan)
    left = 1.0 - best.rises(residual) / best.quantiles**2
    if not np.any(left > 0.0):
        return np.full(left.shape, np.nan)
    other = BestPoint(best.problem, point, best.names)
    try:
        own = Uncertainty((other.block(best.errors),), other.sizes).covariance
    except SimulationError:  # the stress along the measured motion need not exist there
        return np.full(left.shape, np.nan)
    with np.errstate(invalid="ignore"):
        return np.where(left > 0.0, best.quantiles * own.stderr * np.sqrt(left), np.nan)


def _by_profiles(
    best: BestPoint, names: Sequence[str], tracker: Tracker, budget: float
) -> Intervals:
    """Profile some parameters, until a better point is found or time is up."""
    allowed = tracker.objective.spent.evaluations + budget
    profiles, better = list[Profile](), None
    for name in names:
        if tracker.objective.spent.evaluations >= allowed:
            break
        profile, better = trace(best, name, tracker)
        profiles.append(profile)
        if better is not None or profile.stopped:
            break
    ends = {one.name: one.ci95 for one in profiles if one.complete}
    left = ", ".join(name for name in names if name not in ends)
    facts = {"done": len(ends), "count": len(names), "names": left}
    stopped = (one.stopped for one in profiles if one.stopped)
    warnings = tuple(say("interval", "profiles", by=by, **facts) for by in stopped)
    methods = dict.fromkeys(ends, "profile likelihood")
    return Intervals(ends, methods, tuple(profiles), warnings=warnings, better=better)


def _by_mcmc(best: BestPoint, choice: Choice, tracker: Tracker) -> Intervals:
    """Return the 2.5th and 97.5th percentiles of a Markov chain, or a warning if it is short."""
    chain = mcmc(best, choice.draws, choice.seed, tracker)
    note = chain.sentence([name for name in best.names if name not in best.known])
    if len(drawn := chain.samples) < ENOUGH_DRAWS:
        return Intervals(warnings=(note,))
    # To first order: contact and zeros that are held are off by their errors, so is the motion.
    off_by = [best.shifts] if best.problem.kept else []
    off_by += [best.modes] if best.misfits else []
    if off_by:
        steps = best.answer(np.hstack(off_by))
        off = np.random.default_rng([choice.seed, 4]).standard_normal((len(drawn), steps.shape[1]))
        drawn = np.clip(drawn + off @ steps.T, *best.box)
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0).tolist()
    pairs = zip(best.names, low, high, strict=True)
    ends = {name: (a, b) for name, a, b in pairs if name in best.known}
    fine = chain.converged and chain.stopped is None
    samples = drawn.reshape(-1, chain.walkers, len(best.names)).T  # (k, walkers, steps)
    draws, told = dict(zip(best.names, samples, strict=True)), "notes" if fine else "warnings"
    said: dict[str, Any] = {told: (note,)}
    return Intervals(ends, dict.fromkeys(ends, "MCMC"), draws=draws, **said)


# ---------------------------------------------------------------- Markov chains


@dataclass(frozen=True, eq=False)
class MarkovChain:
    """A Markov chain of the parameters."""

    samples: Array  # (m, k): draws after the burn-in, all walkers, SI
    steps: int  # of each walker
    burn_in: int  # number of first steps discarded
    walkers: int
    times: float  # length in integrated autocorrelation times of the slowest parameter
    stopped: str | None = None  # what ended it early

    @property
    def converged(self) -> bool:
        """Whether the chain has at least fifty autocorrelation times, as emcee recommends."""
        return self.times >= 50.0

    def sentence(self, lost: Sequence[str] = ()) -> str:
        """Describe length and convergence; `lost` parameters have no intervals."""
        few = len(self.samples) < ENOUGH_DRAWS
        return say("interval", "chain", chain=self, lost=lost, few=few)


def walkers(best: BestPoint) -> int:
    """Return the number of walkers of a chain."""
    return 2 * len(best.names) + 4


def mcmc(best: BestPoint, steps: int, seed: int, tracker: Tracker | None = None) -> MarkovChain:
    """Sample the posterior with emcee's affine-invariant ensemble (Foreman-Mackey et al. 2013).

    Priors are flat within the limits. The likelihood uses n/τ effective samples of each curve: its
    sum of squares over the variance of its noise is divided by τ. Undetermined parameters are
    sampled between their limits too, so that the others are marginalised over them. The first fifth
    of the steps of each walker is discarded.
    """
    import emcee

    objective = best.problem.objective
    tracker = Tracker(objective) if tracker is None else tracker
    (low, high), complete = best.box, best.problem.space().complete
    variances = [error.noise.variance * error.noise.tau for error in best.errors]
    weights = np.repeat(1.0 / np.array(variances), objective.sizes)
    weights = np.append(weights, np.full(len(objective.priors), objective.unit**-2))

    def log_probability(scaled: Array) -> float:
        point = best.values.copy()
        own = point[best.places] = scaled * best.sizes
        if not np.all((own >= low) & (own <= high)):
            return -np.inf
        residual = tracker.possible(complete(point))
        return -np.inf if residual is None else -0.5 * float(weights @ residual**2)

    count, k = walkers(best), len(best.names)
    sampler = emcee.EnsembleSampler(count, k, log_probability)
    # Bypass emcee's wrapper, which prints a traceback for any exception that ends the chain.
    sampler.log_prob_fn = log_probability
    bits = np.random.MT19937(np.random.SeedSequence([seed, 3]))  # accepts a seed of any size
    sampler.random_state = np.random.RandomState(bits).get_state()
    # Walkers start half a standard error from the best point along determined directions, and at
    # most `FARTHEST` along the others.
    _, singular, axes = np.linalg.svd(best.scaled, full_matrices=False)
    reach = 0.5 * math.sqrt(max(variances)) / np.maximum(singular, 1e-300)
    away = np.random.default_rng([seed, 2]).standard_normal((count, singular.size))
    begin = best.values[best.places] / best.sizes + np.minimum(reach, FARTHEST) * away @ axes
    begin = np.clip(begin, low / best.sizes, high / best.sizes)
    steps_done: list[Array] = []  # emcee would allocate all of them at once
    stopped = None
    try:
        with np.errstate(invalid="ignore"):  # walkers whose simulation fails
            for state in sampler.sample(
                begin, iterations=steps, skip_initial_state_check=True, store=False
            ):
                if not np.isfinite(state.log_prob).any():
                    stopped = "failures: nothing can be simulated near the best point"
                    break
                steps_done.append(state.coords.copy())
    except STOPPING as error:
        stopped = what_stopped(error)
    done = len(steps_done)
    chain = np.array(steps_done[done // 5 :]).reshape(-1, count, k)
    with np.errstate(invalid="ignore", divide="ignore"):  # a walker that never moved
        times = emcee.autocorr.integrated_time(chain, tol=0, quiet=True) if done > 10 else [np.inf]
    length = len(chain) / float(np.max(np.nan_to_num(times, nan=np.inf)))
    return MarkovChain(chain.reshape(-1, k) * best.sizes, done, done // 5, count, length, stopped)
