"""Intervals that hold: profiles of the cost, bootstrap, Markov chains.

The local covariance of `trust.covariance` takes the cost for a parabola. Where branches a and d
are about equally stiff it is none: it is flat along ε_a, with several shallow valleys. Here the
cost itself is asked. A profile is the least cost with one parameter held; a rise of the cost is
compared with what the noise would make of it, correlated as it is (`Covariance.inflation`), so
that on a parabola profile and local interval are the same.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.errors import InputError
from foamfit.fitting.search import STOPPING, Tracker, what_stopped
from foamfit.trust.covariance import NoiseProcess
from foamfit.trust.refit import Place, Refit, Vicinity, m_estimate

Array = NDArray[np.float64]

# A profile is followed until its χ² is this many times that of the 95 % cut: small barriers
# between shallow valleys are crossed.
BEYOND = 2.0
# Refits of one side of a profile: to get beyond the cut, and to place it.
OUTWARD, INWARD = 14, 6
# The cut is placed to this share of the root of its χ².
PLACED = 0.02
# The least share of the cut by which a profile below the best point tells of a better valley.
BETTER = 0.01
# The default profiles a parameter if the root of the cost departs from a straight line by this
# share at the end of its local interval.
BENT = 0.15
METHODS = ("auto", "local", "profile", "bootstrap", "mcmc")
# Refits of an average profile, for the announcement; draws that percentiles need.
REFITS, ENOUGH_DRAWS = 9, 40
# Farthest that a walker of a Markov chain begins from the best point along a direction that the
# test does not fix, in natural sizes; and how often its way there is halved where nothing can be
# simulated.
FARTHEST, HALVINGS = 0.1, 10


@dataclass(frozen=True, eq=False)
class Profile:
    """Least cost along one parameter.

    Attributes
    ----------
    name : str
        The parameter.
    values : (m,) array
        Where it was held, ascending, SI; the best point is among them.
    rises : (m,) array
        Rise of the cost there as a χ² of one degree of freedom.
    points : (m, n) array
        All parameters of the model at each.
    cut : float
        χ² of the 95 % interval.
    ci95 : (float, float)
        Outermost crossings of the cut; a limit of the parameter where there is none.
    open_low, open_high : bool
        Whether the cost does not reach the cut on that side.
    stopped : str or None
        What ended it before its end on both sides: "the time limit", "Ctrl-C".
    """

    name: str
    values: Array
    rises: Array
    points: Array
    cut: float
    ci95: tuple[float, float]
    open_low: bool
    open_high: bool
    stopped: str | None = None

    @property
    def complete(self) -> bool:
        """Whether it was followed to its end on both sides."""
        return self.stopped is None


def profile(
    vicinity: Vicinity,
    name: str,
    tracker: Tracker | None = None,
    valleys: Sequence[Array] = (),
) -> Profile:
    """Follow the least cost along a parameter to both sides, past the 95 % cut.

    The adjusted likelihood ratio: the rise of the cost over `Covariance.inflation`, which is χ²
    with one degree of freedom also where the noise is correlated (Chandler & Bate 2007,
    Biometrika 94, 167).

    Parameters
    ----------
    vicinity : Vicinity
        The best point.
    name : str
        One of its names.
    tracker : Tracker, optional
        Counts, keeps the best point seen and ends the profile at its deadline.
    valleys : sequence of (n,) arrays
        Other points at which descents ended: the profile goes on beyond them where they are
        within the cut, whatever barrier lies between.

    Returns
    -------
    Profile
        Incomplete if the deadline or Ctrl-C ended it: `ci95` is then that of what was done.
    """
    tracker = Tracker(vicinity.problem.objective) if tracker is None else tracker
    walk = _Walk(vicinity, name, tracker)
    walk.follow(valleys)
    return walk.profile


@dataclass(eq=False)
class _Side:
    """One side of a profile: down (-1) or up (+1)."""

    vicinity: Vicinity
    name: str
    refit: Refit
    sign: float

    def __post_init__(self) -> None:
        """Begin at the best point."""
        best = self.vicinity
        self.column = best.names.index(self.name)
        self.place = best.index[self.name]
        self.unit = float(best.spread.inflation[self.column])
        self.quantile = float(best.quantiles[self.column])
        self.places = [self.refit.start()]
        low, high = best.limits(self.name)
        self.limit = low if self.sign < 0 else high

    def value(self, place: Place) -> float:
        """Where the parameter was held."""
        return float(place.point[self.place])

    def rise(self, place: Place) -> float:
        """Rise of the cost as a χ²."""
        return (place.cost - self.vicinity.cost) / self.unit

    def root(self, place: Place) -> float:
        """Root of the rise, straight along a parabola."""
        return math.sqrt(max(self.rise(place), 0.0))

    def follow(self, valleys: Sequence[Array]) -> None:
        """Go outward until well beyond the cut and place the crossing; go on beyond the valleys.

        What was followed before is not followed again.
        """
        if len(self.places) == 1:
            self._outward()
            self._inward()
        reach = PLACED * self.quantile * float(self.vicinity.spread.stderr[self.column])
        for valley in sorted(valleys, key=lambda point: -self.sign * float(point[self.place])):
            value = float(valley[self.place])
            edge = self.value(self.places[-1]) if self.is_open else self.bound
            if self.better or self.sign * (value - edge) <= reach:
                break
            residual = self.refit.residual(valley)
            if residual is None:
                continue
            place = self.refit.run(self.refit.fresh(valley, residual), self._others)
            if self.rise(place) < self.quantile**2:
                # Places farther out are of another valley, or of refits that stalled.
                inside = [p for p in self.places if self.sign * (self.value(p) - value) < 0.0]
                self.places = [*inside, place]
                self._outward()
                self._inward()

    @property
    def _others(self) -> NDArray[np.bool_]:
        """All parameters but the one that is held."""
        return np.asarray(np.arange(len(self.vicinity.names)) != self.column)

    def _outward(self) -> None:
        """Go on from the outermost place until well beyond the cut."""
        step = 0.5 * self.quantile * float(self.vicinity.spread.stderr[self.column])
        refused = 0
        for _ in range(OUTWARD):
            last = self.places[-1]
            if self.value(last) == self.limit or refused > 3:
                break
            value = self.value(last) + self.sign * step
            value = max(value, self.limit) if self.sign < 0 else min(value, self.limit)
            place = self._hold(value, last)
            if place is None:
                step, refused = 0.3 * step, refused + 1
                continue
            self.places.append(place)
            if self.rise(place) >= BEYOND * self.quantile**2 or self.better:
                break
            if self.root(place) - self.root(last) < 0.35 * self.quantile:
                step *= 1.6

    def _inward(self) -> None:
        """Place the outermost crossing of the cut."""
        for _ in range(INWARD):
            inner, outer = self._bracket()
            if outer is None or self.better:
                break
            miss = min(abs(self.root(p) - self.quantile) for p in (inner, outer))
            if miss <= PLACED * self.quantile:
                break
            place = self._hold(self.bound, inner)
            if place is None:
                break
            self.places.append(place)
            self.places.sort(key=lambda p: self.sign * self.value(p))

    @property
    def better(self) -> bool:
        """Whether a better point than the best was met."""
        return min(map(self.rise, self.places)) < -BETTER * self.quantile**2

    def _hold(self, value: float, near: Place) -> Place | None:
        """Refit with the parameter held, starting from a place near by; None if nothing is found.

        The others follow as the slopes there promise; where that cannot be simulated they stay.
        """
        free = self._others
        shift = np.zeros(free.size)
        shift[self.column] = (value - self.value(near)) / self.vicinity.sizes[self.column]
        ahead = replace(near, residual=near.residual + near.slopes @ shift)
        follow, _ = self.refit.step(ahead, free, 1e-9)
        for step in (shift + follow, shift):
            point = self.refit.moved(near, step)
            point[self.place] = value
            residual = self.refit.residual(point)
            if residual is not None:
                taken = (point - near.point)[self.refit.places] / self.vicinity.sizes
                surprise = residual - near.residual - near.slopes @ taken
                slopes = near.slopes + np.outer(surprise, taken / (taken @ taken))
                return self.refit.run(Place(point, residual, slopes), free)
        return None

    def _bracket(self) -> tuple[Place, Place | None]:
        """The outermost place below the cut, and the next one."""
        last = max(i for i, place in enumerate(self.places) if self.root(place) < self.quantile)
        return self.places[last], self.places[last + 1] if last + 1 < len(self.places) else None

    @property
    def bound(self) -> float:
        """Where the root of the rise crosses that of the cut; where it never does, the limit."""
        inner, outer = self._bracket()
        if outer is None:
            return self.limit
        share = (self.quantile - self.root(inner)) / (self.root(outer) - self.root(inner))
        return self.value(inner) + share * (self.value(outer) - self.value(inner))

    @property
    def is_open(self) -> bool:
        """Whether the cost never reached the cut."""
        return self._bracket()[1] is None


class _Walk:
    """A profile that is being followed; a side that was not begun ends at the best point."""

    def __init__(self, vicinity: Vicinity, name: str, tracker: Tracker) -> None:
        refit = Refit(vicinity, tracker)
        self.low, self.high = (_Side(vicinity, name, refit, sign) for sign in (-1.0, 1.0))
        self.stopped: str | None = None
        self._turned = False

    def follow(self, valleys: Sequence[Array]) -> None:
        """Follow both sides, or go on beyond further valleys; incomplete if that was ended."""
        try:
            self.low.follow(valleys)
            self._turned = True
            self.high.follow(valleys)
        except STOPPING as error:
            self.stopped = what_stopped(error)

    @property
    def better(self) -> Array | None:
        """A point that is better than the best."""
        least = min((*self.low.places, *self.high.places), key=lambda place: place.cost)
        return least.point if self.low.better or self.high.better else None

    @property
    def profile(self) -> Profile:
        """What was found so far."""
        low, high = self.low, self.high
        places = low.places[::-1] + high.places[1:]
        return Profile(
            name=low.name,
            values=np.array([low.value(place) for place in places]),
            rises=np.array([low.rise(place) for place in places]),
            points=np.array([place.point for place in places]),
            cut=low.quantile**2,
            ci95=(low.bound, high.bound if self._turned else high.value(high.places[0])),
            open_low=low.is_open,
            open_high=high.is_open or not self._turned,
            stopped=self.stopped,
        )


def departures(vicinity: Vicinity) -> Array:
    """How far the cost is from a parabola at either end of each local interval, (k, 2).

    One evaluation each: the parameter is put at the end of its interval (nearer if nothing can be
    simulated there), the others follow their correlation, and what they could still gain is read
    off the local slopes. Given is the root of the rise over what a parabola has, less one; zero
    where a limit leaves no room, infinite where nothing can be simulated.
    """
    refit = Refit(vicinity, Tracker(vicinity.problem.objective))
    start = refit.start()
    normal = start.slopes.T @ start.slopes
    out = np.zeros((len(vicinity.names), 2))
    for i, name in enumerate(vicinity.names):
        others = np.arange(len(vicinity.names)) != i
        inverse = np.linalg.pinv(normal[np.ix_(others, others)], rcond=1e-10, hermitian=True)
        own = start.slopes[:, others]

        def least(residual: Array, own: Array = own, inverse: Any = inverse) -> float:
            slope = own.T @ residual
            return float(residual @ residual - slope @ inverse @ slope)

        here = least(start.residual)
        stderr = float(vicinity.spread.stderr[i])
        reach = float(vicinity.quantiles[i]) * stderr
        value = vicinity.values[vicinity.index[name]]
        low, high = vicinity.limits(name)
        for side, room in enumerate((value - low, high - value)):
            if not room > 0.05 * reach:
                continue
            out[i, side] = np.inf
            for share in (1.0, 0.5, 0.25):
                shift = min(share * reach, room)
                along = vicinity.along(name) * (-shift if side == 0 else shift) / vicinity.sizes
                residual = refit.residual(refit.moved(start, along))
                if residual is not None:
                    rise = (least(residual) - here) / vicinity.spread.inflation[i]
                    out[i, side] = math.sqrt(max(rise, 0.0)) * stderr / shift - 1.0
                    break
    return out


# ---------------------------------------------------------------- bootstrap


def block_length(process: NoiseProcess, n: int) -> int:
    """Length of the blocks of a bootstrap of n samples of a noise.

    The one that makes the error of a variance least if the noise is autoregressive of first order
    with the same autocorrelation time (Politis & White 2004, Econometric Reviews 23, 53):
    (3/8 n ((τ²-1)/τ)²)^(1/3), one for white noise.
    """
    tau = process.tau
    length = (0.375 * n * ((tau * tau - 1.0) / tau) ** 2) ** (1.0 / 3.0)
    return int(min(max(round(length), 1), max(n // 4, 1)))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Circular blocks of the residuals of one curve (Politis & Romano 1992).

    Residuals are smaller than the noise was, and blocks break correlation at their ends: both are
    made up for by a factor, such that sums over the curve vary as those of its noise.
    """

    residual: Array
    length: int

    @classmethod
    def of(cls, residual: Array, process: NoiseProcess, like: Array | None = None) -> Blocks:
        """Blocks of a residual whose noise is known; `like` is what it was read off, if not it."""
        length = block_length(process, residual.size)
        centred = residual - residual.mean()
        lags = process.autocovariance(length) / process.variance
        within = 1.0 + 2.0 * float((1.0 - np.arange(1, length) / length) @ lags[1:])
        power = max(float(np.var(residual if like is None else like)), 1e-300)
        factor = process.variance / power * max(process.tau / within, 1.0)
        return cls(centred * math.sqrt(factor), length)

    def draw(self, rng: np.random.Generator) -> Array:
        """As many samples as the residual has, from blocks with random starts."""
        n = self.residual.size
        starts = rng.integers(0, n, -(-n // self.length))
        drawn = (starts[:, None] + np.arange(self.length)) % n
        return np.asarray(self.residual[drawn.ravel()[:n]])


@dataclass(frozen=True, eq=False)
class Refits:
    """Parameters refitted to resampled data.

    Attributes
    ----------
    values : (m, k) array
        One refit per row, SI.
    stopped : str or None
        What ended them before they were as many as asked for: "the time limit", "Ctrl-C".
    """

    values: Array
    stopped: str | None = None


def bootstrap(vicinity: Vicinity, draws: int, seed: int, tracker: Tracker | None = None) -> Refits:
    """Refits to data remade from the fitted curves and blocks of the residuals.

    Each refit descends from the best point; other valleys of the cost are not searched.

    Parameters
    ----------
    vicinity : Vicinity
        The best point.
    draws : int
        How many.
    seed : int
        Same seed, same numbers.
    tracker : Tracker, optional
        Ends it at its deadline.

    Returns
    -------
    Refits
        Fewer than asked for if the deadline or Ctrl-C ended them.
    """
    objective = vicinity.problem.objective
    tracker = Tracker(objective) if tracker is None else tracker
    rng = np.random.default_rng([seed, 1])
    free = np.ones(len(vicinity.names), dtype=bool)
    ends = np.cumsum(objective.sizes)[:-1]
    _, pseudo = m_estimate(vicinity.residual, objective.sizes, objective.loss)
    pairs = zip(np.split(vicinity.residual, ends), np.split(pseudo, ends), strict=True)
    blocks = [
        Blocks.of(part, process, like)
        for (part, like), process in zip(pairs, vicinity.spread.noise, strict=True)
    ]
    out: list[Array] = []
    stopped = None
    try:
        for _ in range(draws):
            noise = np.concatenate([block.draw(rng) for block in blocks])
            refit = Refit(vicinity, tracker, vicinity.residual - noise)
            out.append(refit.run(refit.start(), free).point[refit.places])
    except STOPPING as error:
        stopped = what_stopped(error)
    return Refits(np.array(out).reshape(-1, len(vicinity.names)), stopped)


# ---------------------------------------------------------------- Markov chain


@dataclass(frozen=True, eq=False)
class Chain:
    """A Markov chain of the parameters.

    Attributes
    ----------
    samples : (m, k) array
        Draws after the burn-in, all walkers, SI.
    steps, burn_in : int
        Steps of each walker, and how many of the first were left out.
    walkers : int
        Number of walkers.
    autocorrelation : float
        Integrated autocorrelation time of the slowest parameter, steps.
    stopped : str or None
        What ended it before its steps were done.
    """

    samples: Array
    steps: int
    burn_in: int
    walkers: int
    autocorrelation: float
    stopped: str | None = None

    @property
    def converged(self) -> bool:
        """Whether the chain is longer than fifty autocorrelation times, as emcee asks for."""
        return self.steps - self.burn_in >= 50.0 * self.autocorrelation

    def sentence(self) -> str:
        """What the autocorrelation says of the chain."""
        length = self.steps - self.burn_in
        word = "enough" if self.converged else "too short to trust: wanted are 50"
        return (
            f"Markov chain of {self.walkers} walkers and {self.steps} steps, the first "
            f"{self.burn_in} left out: {length / self.autocorrelation:.0f} autocorrelation times "
            f"of the slowest parameter, which is {word}."
            + (f" It was stopped by {self.stopped}." if self.stopped else "")
        )


def check_emcee() -> None:
    """Raise InputError if emcee is not there."""
    if importlib.util.find_spec("emcee") is None:
        raise InputError(
            'Markov chains need emcee, which is not installed; pip install "foamfit[mcmc]"'
        )


def walkers(vicinity: Vicinity) -> int:
    """Number of walkers of a chain."""
    return 2 * len(vicinity.names) + 4


def mcmc(vicinity: Vicinity, steps: int, seed: int, tracker: Tracker | None = None) -> Chain:
    """Sample the posterior by emcee's affine-invariant ensemble (Foreman-Mackey et al. 2013).

    Flat priors within the limits; the likelihood counts n/τ samples of each curve: its sum of
    squares over the variance of its noise is divided by τ. What the test does not determine is
    sampled too and runs over its limits, so that the others are those whatever its value is.

    Parameters
    ----------
    vicinity : Vicinity
        The best point, about which the walkers begin.
    steps : int
        Of each walker; the first fifth is left out.
    seed : int
        Same seed, same numbers.
    tracker : Tracker, optional
        Ends it at its deadline.

    Raises
    ------
    InputError
        If emcee is not installed.
    """
    check_emcee()
    import emcee

    tracker = Tracker(vicinity.problem.objective) if tracker is None else tracker
    refit = Refit(vicinity, tracker)
    start = refit.start()
    weights = np.concatenate(
        [
            np.full(n, 1.0 / (process.variance * process.tau))
            for n, process in zip(
                vicinity.problem.objective.sizes, vicinity.spread.noise, strict=True
            )
        ]
    )

    def log_probability(scaled: Array) -> float:
        point = start.point.copy()
        point[refit.places] = scaled * vicinity.sizes
        inside = np.all((point[refit.places] >= refit.low) & (point[refit.places] <= refit.high))
        residual = refit.residual(refit.complete(point)) if inside else None
        return -0.5 * float(weights @ residual**2) if residual is not None else -np.inf

    count, k = walkers(vicinity), len(vicinity.names)
    sampler = emcee.EnsembleSampler(count, k, log_probability)
    # Not through emcee's wrapper, which prints a traceback of whatever ends the chain.
    sampler.log_prob_fn = log_probability
    bits = np.random.MT19937(np.random.SeedSequence([seed, 3]))  # of a seed of any size
    sampler.random_state = np.random.RandomState(bits).get_state()
    steps_done: list[Array] = []  # emcee would make room for all of them at once
    stopped = None
    try:
        begin = _begin(vicinity, refit, log_probability, count, np.random.default_rng([seed, 2]))
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
    return Chain(chain.reshape(-1, k) * vicinity.sizes, done, burn_in, count, slowest, stopped)


def _begin(
    vicinity: Vicinity,
    refit: Refit,
    log_probability: Callable[[Array], float],
    count: int,
    rng: np.random.Generator,
) -> Array | None:
    """Points about the best one at which walkers begin, scaled, (count, k); None if there are none.

    Half a standard error away along what the test fixes, no more than `FARTHEST` along the rest.
    """
    noise = max(process.variance * process.tau for process in vicinity.spread.noise)
    _, singular, axes = np.linalg.svd(vicinity.jacobian * vicinity.sizes, full_matrices=False)
    reach = 0.5 * math.sqrt(noise) / np.maximum(singular, 1e-300)
    low, high = refit.low / vicinity.sizes, refit.high / vicinity.sizes
    best = refit.start().point[refit.places] / vicinity.sizes
    begin = []
    for _ in range(count):
        away = (np.minimum(reach, FARTHEST) * rng.standard_normal(reach.size)) @ axes
        for halving in range(HALVINGS):
            drawn = np.clip(best + 0.5**halving * away, low, high)
            if np.isfinite(log_probability(drawn)):
                begin.append(drawn)
                break
        else:
            return None
    return np.array(begin)


# ---------------------------------------------------------------- the intervals of a fit


@dataclass(frozen=True)
class Choice:
    """Which intervals are wanted.

    Attributes
    ----------
    method : str
        "auto" (profiles of those parameters along which the cost is no parabola, local covariance
        for the others), "local", "profile", "bootstrap" or "mcmc".
    draws : int
        Refits of the bootstrap, or steps of the Markov chain.
    seed : int
        Source of all chance.
    """

    method: str = "auto"
    draws: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what is unknown or cannot be done."""
        if self.method not in METHODS:
            raise InputError(
                f"intervals '{self.method}' is unknown; it must be one of {', '.join(METHODS)}"
            )
        least = {"bootstrap": 40, "mcmc": 100}.get(self.method, 0)
        if self.draws < least:
            raise InputError(
                f"{self.draws} draws are too few for intervals by {self.method}; "
                f"it must be at least {least}"
            )
        if self.method == "mcmc":
            check_emcee()


@dataclass(frozen=True, eq=False)
class Intervals:
    """The 95 % intervals of a fit, and how they were made.

    Attributes
    ----------
    ends : dict of str to (float, float)
        Ends of the intervals that are not those of the local covariance.
    methods : dict of str to str
        How each of these was made.
    profiles : tuple of Profile
        All profiles that were followed, whole or not.
    doubtful : tuple of str
        Parameters along which the cost is no parabola and whose interval is local all the same.
    notes : tuple of str
        One sentence each.
    warnings : tuple of str
        Why they are not, or hardly, what was asked for; one sentence each.
    better : (n,) array or None
        A point with a lower cost that was met: it should be gone on from.
    """

    ends: dict[str, tuple[float, float]] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()
    doubtful: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    better: Array | None = None


def assess(
    vicinity: Vicinity,
    choice: Choice,
    *,
    valleys: Sequence[Array] = (),
    deadline: float | None = None,
    budget: float = math.inf,
    tell: Callable[[str], None] = lambda told: None,
) -> Intervals:
    """Make the intervals that were chosen.

    Parameters
    ----------
    vicinity : Vicinity
        The best point.
    choice : Choice
        The method.
    valleys : sequence of (n,) arrays
        Points at which the descents of the search ended.
    deadline : float, optional
        `time.monotonic` at which it ends with what was done.
    budget : float
        Evaluations after which "auto" begins no further profile.
    tell : callable
        Told what it will cost before it is paid.
    """
    tracker = Tracker(vicinity.problem.objective, deadline, best_cost=vicinity.cost)
    known = [name for name in vicinity.names if vicinity.knows(name)]
    if choice.method == "local" or (choice.method == "auto" and not known):
        return Intervals()
    if not known:
        what = {"mcmc": "a Markov chain", "bootstrap": "a bootstrap"}.get(choice.method, "profiles")
        none = (
            f"The test determines no parameter, so {what} would make no interval and was not run."
        )
        return Intervals(warnings=(none,))
    if choice.method == "bootstrap":
        return _by_bootstrap(vicinity, choice, tracker, tell)
    if choice.method == "mcmc":
        return _by_mcmc(vicinity, choice, tracker, tell)
    if choice.method == "profile":
        tell(_cost_told(vicinity, "profile likelihood", REFITS * len(known)))
        return _by_profiles(vicinity, known, valleys, tracker, math.inf)
    far = np.abs(departures(vicinity)).max(axis=1, initial=0.0)
    far[_elsewhere(vicinity, valleys, tracker)] = np.inf
    order = sorted(known, key=lambda name: -far[vicinity.names.index(name)])
    bent = [name for name in order if far[vicinity.names.index(name)] > BENT]
    return _by_profiles(vicinity, bent, valleys, tracker, budget)


def _elsewhere(vicinity: Vicinity, valleys: Sequence[Array], tracker: Tracker) -> NDArray[np.bool_]:
    """Parameters that another valley within the cut puts outside of their local interval, (k,)."""
    places = [vicinity.index[name] for name in vicinity.names]
    out = np.zeros(len(places), dtype=bool)
    for valley in valleys:
        residual = tracker.consider(valley)
        rise = (float(residual @ residual) - vicinity.cost) / vicinity.spread.inflation
        apart = np.abs(valley - vicinity.values)[places] / vicinity.spread.stderr
        out |= (rise < vicinity.quantiles**2) & (apart > vicinity.quantiles)
    return out


def _by_profiles(
    vicinity: Vicinity,
    names: Sequence[str],
    valleys: Sequence[Array],
    tracker: Tracker,
    budget: float,
) -> Intervals:
    """Profiles of some parameters, until they are done, a better point is met or all ends.

    A point within the cut that the profile of one parameter has met is evidence for the others too:
    their intervals must hold it. So each profile goes on beyond what the others have met, and a
    parameter that these put outside of its local interval is profiled as well. Refits with one
    parameter held end in the nearest of several shallow valleys; those with another one held have
    been led through the next.
    """
    objective = tracker.objective
    allowed = objective.evaluations + budget
    walks: dict[str, _Walk] = {}
    wanted, better = list(names), None
    known = [name for name in vicinity.names if vicinity.knows(name)]
    for name in (*names, *known):
        met = _met(vicinity, name, [walk for other, walk in walks.items() if other != name])
        begun = name in walks
        if name not in wanted:
            if not _outside(vicinity, name, met):
                continue
            wanted.append(name)
        if objective.evaluations >= allowed and not begun:
            continue
        walk = walks.setdefault(name, _Walk(vicinity, name, tracker))
        walk.follow(met if begun else [*valleys, *met])
        better = walk.better
        if better is not None or walk.stopped:
            break
    profiles = [walk.profile for walk in walks.values()]
    whole = {p.name: p for p in profiles if p.complete}
    left = tuple(name for name in wanted if name not in whole)
    warnings = tuple(
        f"The profiles were stopped by {p.stopped}: {len(whole)} of {len(wanted)} were done, and "
        f"the intervals of {', '.join(left)} are local."
        for p in profiles
        if p.stopped
    )
    return Intervals(
        ends={name: p.ci95 for name, p in whole.items()},
        methods=dict.fromkeys(whole, "profile likelihood"),
        profiles=tuple(profiles),
        doubtful=left,
        warnings=warnings,
        better=better,
    )


def _met(vicinity: Vicinity, name: str, walks: Sequence[_Walk]) -> list[Array]:
    """Lowest and highest of a parameter among the points within its cut that profiles have met."""
    column, at = vicinity.names.index(name), vicinity.index[name]
    highest = vicinity.quantiles[column] ** 2 * vicinity.spread.inflation[column]
    places = [place for walk in walks for place in (*walk.low.places, *walk.high.places)]
    points = [place.point for place in places if place.cost - vicinity.cost < highest]
    if not points:
        return []
    return [min(points, key=lambda point: point[at]), max(points, key=lambda point: point[at])]


def _outside(vicinity: Vicinity, name: str, points: Sequence[Array]) -> bool:
    """Whether one of the points is outside of a local interval."""
    column, at = vicinity.names.index(name), vicinity.index[name]
    half = vicinity.quantiles[column] * vicinity.spread.stderr[column] * (1.0 + PLACED)
    return any(abs(point[at] - vicinity.values[at]) > half for point in points)


def _by_bootstrap(
    vicinity: Vicinity, choice: Choice, tracker: Tracker, tell: Callable[[str], None]
) -> Intervals:
    tell(_cost_told(vicinity, "block bootstrap", choice.draws))
    drawn = bootstrap(vicinity, choice.draws, choice.seed, tracker)
    sizes = vicinity.problem.objective.sizes
    lengths = [block_length(p, n) for p, n in zip(vicinity.spread.noise, sizes, strict=True)]
    note = (
        f"Block bootstrap: {len(drawn.values)} of {choice.draws} refits, blocks of "
        f"{' and '.join(map(str, lengths))} samples."
    )
    if drawn.stopped:
        note += f" It was stopped by {drawn.stopped}."
    if len(drawn.values) < ENOUGH_DRAWS:
        return Intervals(warnings=(note + " These are too few, so the intervals are local.",))
    return _percentiles(vicinity, drawn.values, "block bootstrap", note, drawn.stopped is None)


def _by_mcmc(
    vicinity: Vicinity, choice: Choice, tracker: Tracker, tell: Callable[[str], None]
) -> Intervals:
    count = (choice.draws + 1) * walkers(vicinity)
    seconds = count * _seconds(vicinity)[0]
    tell(f"Markov chain: {count} simulations, about {seconds:.2g} s")
    chain = mcmc(vicinity, choice.draws, choice.seed, tracker)
    note = chain.sentence()
    if len(chain.samples) < ENOUGH_DRAWS:
        return Intervals(warnings=(note + " The intervals are local.",))
    lost = [name for name in vicinity.names if not vicinity.knows(name)]
    if lost:
        note += (
            f" The test does not determine {', '.join(lost)}: the chain samples them with a flat "
            "prior within their limits, and they have no interval."
        )
    fine = chain.converged and chain.stopped is None
    return _percentiles(vicinity, chain.samples, "MCMC", note, fine)


def _percentiles(vicinity: Vicinity, drawn: Array, method: str, note: str, fine: bool) -> Intervals:
    """Intervals between the 2.5th and the 97.5th percentile of what was drawn.

    What is said of them is a warning if they are not what was asked for.
    """
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
    ends = {
        name: (float(low[i]), float(high[i]))
        for i, name in enumerate(vicinity.names)
        if vicinity.knows(name)
    }
    notes, warnings = ((note,), ()) if fine else ((), (note,))
    return Intervals(ends, dict.fromkeys(ends, method), notes=notes, warnings=warnings)


def _seconds(vicinity: Vicinity) -> tuple[float, float]:
    """Seconds of one evaluation of the residual and of its slopes."""
    problem = vicinity.problem
    began = time.perf_counter()
    for _ in range(3):
        problem.objective.residual(vicinity.values)
    middle = time.perf_counter()
    problem.slopes(vicinity.values, vicinity.names)
    return (middle - began) / 3.0, time.perf_counter() - middle


def _cost_told(vicinity: Vicinity, what: str, refits: int) -> str:
    """Announcement of so many refits."""
    evaluation, slopes = _seconds(vicinity)
    return f"{what}: {refits} refits, about {refits * (6.0 * evaluation + 0.6 * slopes):.2g} s"
