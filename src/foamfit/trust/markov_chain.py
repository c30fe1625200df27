"""Markov chains of the parameters, computed only on request."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.search import STOPPING, Tracker, what_stopped
from foamfit.trust import say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.profile import Refit

# Largest start distance of a walker from the best point along an undetermined direction, over the
# scales of the parameters.
FARTHEST = 0.1


@dataclass(frozen=True, eq=False)
class MarkovChain:
    """A Markov chain of the parameters."""

    samples: Array  # (m, k): draws after the burn-in, all walkers, SI
    steps: int  # of each walker
    burn_in: int  # number of first steps discarded
    walkers: int
    autocorrelation: float  # integrated autocorrelation time of the slowest parameter, steps
    stopped: str | None = None  # what ended it early

    @property
    def converged(self) -> bool:
        """Whether the chain has at least fifty autocorrelation times, as emcee recommends."""
        return self.times >= 50.0

    @property
    def times(self) -> float:
        """Length of the chain in autocorrelation times."""
        return (self.steps - self.burn_in) / self.autocorrelation

    def sentence(self, lost: Sequence[str] = (), few: bool = False) -> str:
        """Describe length and convergence; `lost` parameters have no intervals."""
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
    refit = Refit(best, Tracker(objective) if tracker is None else tracker)
    low, high = best.box
    variances = [process.variance * process.tau for process in best.spread.noise]
    weights = np.repeat(1.0 / np.array(variances), objective.sizes)
    weights = np.append(weights, np.ones(len(objective.priors)))

    def log_probability(scaled: Array) -> float:
        point = best.values.copy()
        own = point[best.places] = scaled * best.sizes
        inside = np.all((own >= low) & (own <= high))
        residual = refit.residual(refit.space.complete(point)) if inside else None
        return -0.5 * float(weights @ residual**2) if residual is not None else -np.inf

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
    slowest = float(np.max(np.nan_to_num(times, nan=np.inf)))
    return MarkovChain(chain.reshape(-1, k) * best.sizes, done, done // 5, count, slowest, stopped)
