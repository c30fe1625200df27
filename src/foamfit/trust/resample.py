"""Intervals by resampling: the block bootstrap and Markov chains. Both are made only on demand."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.fitting.search import STOPPING, Tracker, what_stopped
from foamfit.trust.best_point import BestPoint, m_estimate
from foamfit.trust.refit import Refit
from foamfit.trust.residuals.noise_process import NoiseProcess

# Farthest that a walker of a Markov chain begins from the best point along a direction that the
# test does not fix, over the scales of the parameters; and how often its way there is halved where
# nothing can be simulated.
FARTHEST, HALVINGS = 0.1, 10


def block_length(process: NoiseProcess, n: int) -> int:
    """Length of the blocks of a bootstrap of n samples of a noise.

    The one that makes the error of a variance least if the noise is autoregressive of first order
    with the same autocorrelation time (Politis & White 2004, Econometric Reviews 23, 53):
    (3/8 n ((τ²-1)/τ)²)^(1/3), one for white noise.
    """
    tau = process.tau
    length = (0.375 * n * ((tau * tau - 1.0) / tau) ** 2) ** (1.0 / 3.0)
    return int(min(max(round(length), 1), max(n // 4, 1)))


def _scaled_residual(residual: Array, process: NoiseProcess, like: Array, length: int) -> Array:
    """Residual of one curve for circular blocks of it (Politis & Romano 1992).

    A factor corrects that residuals are smaller than the noise was, which was read off `like`, and
    that blocks break correlation at their ends: sums over the curve vary as those of its noise.
    """
    lags = process.autocovariance(length) / process.variance
    within = 1.0 + 2.0 * float((1.0 - np.arange(1, length) / length) @ lags[1:])
    power = max(float(np.var(like)), 1e-300)
    factor = process.variance / power * max(process.tau / within, 1.0)
    return np.asarray((residual - residual.mean()) * math.sqrt(factor))


def _draw(residual: Array, length: int, rng: np.random.Generator) -> Array:
    """As many samples as the residual has, from circular blocks with random starts."""
    n = residual.size
    starts = rng.integers(0, n, -(-n // length))
    drawn = (starts[:, None] + np.arange(length)) % n
    return np.asarray(residual[drawn.ravel()[:n]])


@dataclass(frozen=True, eq=False)
class Refits:
    """Parameters refitted to resampled data: (m, k) values (SI), and what ended them early."""

    values: Array
    stopped: str | None = None


def _misfits(best: BestPoint) -> Array:
    """Residuals of the curves that hold an error of the law, zero for the others, (n_data,)."""
    pairs = zip(best.problem.objective.sizes, best.errors, strict=True)
    found = np.concatenate([np.full(size, error.found) for size, error in pairs])
    return np.where(found, best.residual[: found.size], 0.0)


def bootstrap(best: BestPoint, draws: int, seed: int, tracker: Tracker | None = None) -> Refits:
    """Refits to data remade from the fitted curves and blocks of the residuals.

    Where a residual holds an error of the law, that stays, and noise of the kind that is in it is
    added to the measured curve.

    Each refit descends from the best point; other minima of the cost are not searched. They are
    fewer than asked for if the deadline or Ctrl-C ended them.
    """
    objective = best.problem.objective
    tracker = Tracker(objective) if tracker is None else tracker
    rng = np.random.default_rng([seed, 1])
    ends = np.cumsum(objective.sizes)
    priors = len(objective.priors)
    _, pseudo = m_estimate(best.residual, objective.sizes, objective.loss)
    sources = []
    for n, part, like, process in zip(
        objective.sizes, np.split(best.residual, ends)[:-1], np.split(pseudo, ends)[:-1],
        best.spread.noise, strict=True,
    ):  # fmt: skip
        length = block_length(process, n)
        sources.append((_scaled_residual(part, process, like, length), length))
    kept = _misfits(best)
    out: list[Array] = []
    stopped = None
    try:
        for _ in range(draws):
            drawn = [
                process.draw(part.size, rng) if error.found else _draw(part, length, rng)
                for (part, length), error, process in zip(
                    sources, best.errors, best.spread.noise, strict=True
                )
            ]
            left = best.residual[: objective.n_data] - kept - np.concatenate(drawn)
            refit = Refit(best, tracker, np.append(left, rng.standard_normal(priors)))
            end = refit.run(best.values)
            assert end is not None  # the best point can be simulated
            out.append(end.point[refit.places])
    except STOPPING as error:
        stopped = what_stopped(error)
    return Refits(np.array(out).reshape(-1, len(best.names)), stopped)


@dataclass(frozen=True, eq=False)
class MarkovChain:
    """A Markov chain of the parameters."""

    samples: Array  # (m, k): Draws after the burn-in, all walkers, SI
    # Steps of each walker, and how many of the first were left out.
    steps: int
    burn_in: int
    walkers: int  # Number of walkers
    autocorrelation: float  # Integrated autocorrelation time of the slowest parameter, steps
    stopped: str | None = None  # What ended it before its steps were done

    @property
    def converged(self) -> bool:
        """Whether the chain is longer than fifty autocorrelation times, as emcee asks for."""
        return self.steps - self.burn_in >= 50.0 * self.autocorrelation

    def sentence(self) -> str:
        """What the autocorrelation says of the chain."""
        times = (self.steps - self.burn_in) / self.autocorrelation
        enough = "enough" if self.converged else "too short: at least 50 are needed"
        return (
            f"Markov chain of {self.walkers} walkers and {self.steps} steps, the first "
            f"{self.burn_in} left out: {times:.0f} autocorrelation times of the slowest parameter, "
            f"which is {enough}." + (f" It was stopped by {self.stopped}." if self.stopped else "")
        )


def check_emcee() -> None:
    """Raise InputError if emcee is not there."""
    if importlib.util.find_spec("emcee") is None:
        raise InputError(
            'Markov chains need emcee, which is not installed; pip install "foamfit[mcmc]"'
        )


def walkers(best: BestPoint) -> int:
    """Number of walkers of a chain."""
    return 2 * len(best.names) + 4


def mcmc(best: BestPoint, steps: int, seed: int, tracker: Tracker | None = None) -> MarkovChain:
    """Sample the posterior by emcee's affine-invariant ensemble (Foreman-Mackey et al. 2013).

    Flat priors within the limits; the likelihood counts n/τ samples of each curve: its sum of
    squares over the variance of its noise is divided by τ. What the test does not determine is
    sampled too and runs over its limits, so that the others are those whatever its value is. The
    first fifth of the steps of each walker is left out. Raises InputError without emcee.
    """
    check_emcee()
    import emcee

    tracker = Tracker(best.problem.objective) if tracker is None else tracker
    refit = Refit(best, tracker)
    start = refit.start()
    variances = [process.variance * process.tau for process in best.spread.noise]
    weights = np.repeat(1.0 / np.array(variances), best.problem.objective.sizes)
    weights = np.append(weights, np.ones(len(best.problem.objective.priors)))

    def log_probability(scaled: Array) -> float:
        point = start.point.copy()
        point[refit.places] = scaled * best.sizes
        inside = np.all((point[refit.places] >= refit.low) & (point[refit.places] <= refit.high))
        residual = refit.residual(refit.complete(point)) if inside else None
        return -0.5 * float(weights @ residual**2) if residual is not None else -np.inf

    count, k = walkers(best), len(best.names)
    sampler = emcee.EnsembleSampler(count, k, log_probability)
    # Not through emcee's wrapper, which prints a traceback of whatever ends the chain.
    sampler.log_prob_fn = log_probability
    bits = np.random.MT19937(np.random.SeedSequence([seed, 3]))  # of a seed of any size
    sampler.random_state = np.random.RandomState(bits).get_state()
    steps_done: list[Array] = []  # emcee would allocate all of them at once
    stopped = None
    try:
        begin = _begin(best, refit, log_probability, count, np.random.default_rng([seed, 2]))
        if begin is None:
            stopped = "the best point, next to which nothing can be simulated"
        else:
            for state in sampler.sample(
                begin, iterations=steps, skip_initial_state_check=True, store=False
            ):
                steps_done.append(state.coords.copy())
    except STOPPING as error:
        stopped = what_stopped(error)
    done = len(steps_done)
    burn_in = done // 5
    chain = np.array(steps_done[burn_in:]).reshape(-1, count, k)
    with np.errstate(invalid="ignore", divide="ignore"):  # of a walker that never moved
        times = emcee.autocorr.integrated_time(chain, tol=0, quiet=True) if done > 10 else [np.inf]
    slowest = float(np.max(np.nan_to_num(times, nan=np.inf)))
    return MarkovChain(chain.reshape(-1, k) * best.sizes, done, burn_in, count, slowest, stopped)


def _begin(
    best: BestPoint, refit: Refit, log_probability: Callable[[Array], float], count: int,
    rng: np.random.Generator,
) -> Array | None:  # fmt: skip
    """Points about the best one at which walkers begin, scaled, (count, k); None if there are none.

    Half a standard error away along what the test fixes, no more than `FARTHEST` along the rest.
    """
    noise = max(process.variance * process.tau for process in best.spread.noise)
    _, singular, axes = np.linalg.svd(best.jacobian * best.sizes, full_matrices=False)
    reach = 0.5 * math.sqrt(noise) / np.maximum(singular, 1e-300)
    low, high = refit.low / best.sizes, refit.high / best.sizes
    middle = best.values[refit.places] / best.sizes
    begin = []
    for _ in range(count):
        away = (np.minimum(reach, FARTHEST) * rng.standard_normal(reach.size)) @ axes
        for halving in range(HALVINGS):
            drawn = np.clip(middle + 0.5**halving * away, low, high)
            if np.isfinite(log_probability(drawn)):
                begin.append(drawn)
                break
        else:
            return None
    return np.array(begin)
