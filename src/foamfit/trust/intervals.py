"""The 95 % intervals of a fit: which are made, how, and what is said of them.

The local covariance takes the cost for a parabola. Where branches a and d are about equally stiff
it is none: it is flat along ε_a, with several shallow minima. There the cost itself is asked.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.fitting.search import Tracker
from foamfit.results import Intervals
from foamfit.trust.best_point import BestPoint
from foamfit.trust.profile import PLACED, Tracing, departures
from foamfit.trust.resample import bootstrap, check_emcee, mcmc, walkers
from foamfit.trust.residuals.noise_process import parts

# The default profiles a parameter if the root of the cost departs from a straight line by this
# share at the end of its local interval.
BENT = 0.15
METHODS = ("auto", "local", "profile", "bootstrap", "mcmc")
# Refits of an average profile, for the announcement; draws that percentiles need, and at most.
REFITS, ENOUGH_DRAWS, MOST_DRAWS = 9, 40, 100_000
# Evaluations of a refit, and its slopes.
EVALUATIONS, SLOPES = 6.0, 0.6
# A minimum is hardly worse than the best within this factor of the 95 % cut, of standard errors:
# noise makes so much of a difference in three tests of a thousand.
HARDLY_WORSE = 1.5
Announce = Callable[[str], None]


@dataclass(frozen=True)
class Choice:
    """Which intervals are wanted."""

    method: str = "auto"  # One of `METHODS`; see `foamfit.fit`
    draws: int = 0  # Refits of the bootstrap, or steps of the Markov chain
    seed: int = 0  # Source of all chance
    ranges: bool = True  # Whether ranges are made where the law has an error

    def __post_init__(self) -> None:
        """Refuse what is unknown or cannot be done."""
        if self.method not in METHODS:
            raise InputError(
                f"intervals '{self.method}' is unknown; it must be one of {', '.join(METHODS)}"
            )
        least = {"bootstrap": 40, "mcmc": 100}.get(self.method, 0)
        if not least <= self.draws <= MOST_DRAWS:
            wrong = "few" if self.draws < least else "many"
            raise InputError(
                f"{self.draws} draws are too {wrong} for intervals by {self.method}; "
                f"it must be at {f'least {least}' if wrong == 'few' else f'most {MOST_DRAWS}'}"
            )
        if self.method == "mcmc":
            check_emcee()


def assess(
    best: BestPoint,
    choice: Choice,
    *,
    minima: Sequence[Array] = (),
    deadline: float | None = None,
    budget: float = math.inf,
    announce: Announce = lambda _: None,
    pulse: Callable[[], None] | None = None,
) -> Intervals:
    """Make the intervals that were chosen.

    `minima` are points at which the descents of the search ended. It ends at the `deadline` (of
    `time.monotonic`) with what was done; after `budget` evaluations "auto" begins no further
    profile. `announce` is called with the expected run time before it is spent, `pulse` at every so
    many evaluations.
    """
    if choice.method == "local":
        return Intervals()
    tracker = Tracker(best.problem.objective, deadline, best_cost=best.cost, pulse=pulse)
    known = best.known
    if not known:
        none = "The test determines no parameter, so no intervals were made."
        return Intervals(warnings=() if choice.method == "auto" else (none,))
    if choice.method == "bootstrap":
        return _by_bootstrap(best, choice, tracker, announce)
    if choice.method == "mcmc":
        return _by_mcmc(best, choice, tracker, announce)
    if choice.method == "profile":
        announce(_cost_told(best, "profile likelihood", REFITS * len(known)))
        return _by_profiles(best, known, minima, tracker, math.inf)
    far = np.abs(departures(best)).max(axis=1, initial=0.0)
    far[_elsewhere(best, minima, tracker)] = np.inf
    order = sorted(known, key=lambda name: -far[best.names.index(name)])
    bent = [name for name in order if far[best.names.index(name)] > BENT]
    made = _with_minima(best, _by_profiles(best, bent, minima, tracker, budget), minima, tracker)
    return replace(made, elsewhere=_hardly_worse(best, made, minima, tracker))


def evaluations_of(best: BestPoint, choice: Choice) -> float:
    """Evaluations that intervals which were asked for are expected to take; 0 by default."""
    match choice.method:
        case "mcmc":
            return float((choice.draws + 1) * walkers(best))
        case "bootstrap":
            return EVALUATIONS * choice.draws
        case "profile":
            return EVALUATIONS * REFITS * len(best.known)
    return 0.0


def _with_minima(
    best: BestPoint, made: Intervals, minima: Sequence[Array], tracker: Tracker
) -> Intervals:
    """Intervals that hold the other minima which other noise could have made the best."""
    if made.better is not None:
        return made
    ends, methods = dict(made.ends), dict(made.methods)
    halves_at = _law_halves if best.misfits else _halves
    for point in minima:
        halves = halves_at(best, point, tracker)
        for column, name in enumerate(best.names):
            if name not in best.known or not math.isfinite(halves[column]):
                continue
            value, there = best.values[best.index[name]], point[best.index[name]]
            half = best.halves[column]
            low, high = ends.get(name, (value - half, value + half))
            wider = min(low, there - halves[column]), max(high, there + halves[column])
            if wider[1] - wider[0] > (1.0 + PLACED) * (high - low):
                ends[name] = wider
                methods[name] = "other minima"
    return replace(made, ends=ends, methods=methods)


def _hardly_worse(
    best: BestPoint, made: Intervals, minima: Sequence[Array], tracker: Tracker
) -> dict[str, float]:
    """Values further outside of an interval than it is wide at minima that are hardly worse."""
    out: dict[str, float] = {}
    for point in minima if not best.misfits else ():
        residual = tracker.consider(point)
        rise = (float(residual @ residual) - best.cost) / best.spread.inflation
        for column, name in enumerate(best.names):
            if (
                name not in best.known
                or rise[column] > (HARDLY_WORSE * best.quantiles[column]) ** 2
            ):
                continue
            value, there = best.values[best.index[name]], float(point[best.index[name]])
            half = best.halves[column]
            low, high = made.ends.get(name, (value - half, value + half))
            if max(low - there, there - high) > high - low:
                out.setdefault(name, there)
    return out


def _law_halves(best: BestPoint, point: Array, tracker: Tracker) -> Array:
    """What the values at another minimum are uncertain by beside an error of the law, (k,).

    There two minima differ by more than noise: of the difference of their costs the noise e makes
    2 eᵀd, with d the difference of their residuals. NaN where it could not have made this the best.
    """
    residual = tracker.consider(point)
    apart = (residual - best.soft)[:, None]
    objective = best.problem.objective
    noise = zip(best.spread.noise, parts(objective.sizes), strict=True)
    spread = sum(float(process.forms(apart[p])[0]) for process, p in noise)
    spread += float(np.sum(apart[objective.n_data :] ** 2))
    near = float(residual @ residual) - best.cost <= 1.96 * 2.0 * math.sqrt(spread)
    return best.halves if near else np.full(best.halves.shape, np.nan)


def _halves(best: BestPoint, point: Array, tracker: Tracker) -> Array:
    """Halves of the local intervals at another minimum, (k,), as far as its cost is in the cut.

    The cost is taken for a parabola about that minimum too; NaN where it is above the cut.
    """
    residual = tracker.consider(point)
    rises = (float(residual @ residual) - best.cost) / best.spread.inflation
    left = 1.0 - rises / best.quantiles**2
    if not np.any(left > 0.0):
        return np.full(left.shape, np.nan)
    there = BestPoint(best.problem, point, best.names)
    with np.errstate(invalid="ignore"):
        return np.where(left > 0.0, there.halves * np.sqrt(left), np.nan)


def _elsewhere(best: BestPoint, minima: Sequence[Array], tracker: Tracker) -> NDArray[np.bool_]:
    """Parameters that another minimum within the cut puts outside of their local interval, (k,)."""
    places = [best.index[name] for name in best.names]
    out = np.zeros(len(places), dtype=bool)
    for point in minima:
        residual = tracker.consider(point)
        rise = (float(residual @ residual) - best.cost) / best.spread.inflation
        apart = np.abs(point - best.values)[places] / best.spread.stderr
        out |= (rise < best.quantiles**2) & (apart > best.quantiles)
    return out


def _by_profiles(
    best: BestPoint, names: Sequence[str], minima: Sequence[Array], tracker: Tracker, budget: float
) -> Intervals:
    """Profiles of some parameters, until they are done, a better point is met or all ends.

    The intervals of all parameters must hold a point within the cut that the profile of one has
    met: each profile goes on beyond what the others have met, and a parameter that these put
    outside of its local interval is profiled as well.
    """
    allowed = tracker.objective.evaluations + budget
    tracings: dict[str, Tracing] = {}
    wanted, better = list(names), None
    for name in (*names, *best.known):
        met = _met(best, name, [one for other, one in tracings.items() if other != name])
        begun = name in tracings
        if name not in wanted:
            if not _outside(best, name, met):
                continue
            wanted.append(name)
        if tracker.objective.evaluations >= allowed and not begun:
            continue
        tracing = tracings.setdefault(name, Tracing(best, name, tracker))
        tracing.follow(met if begun else [*minima, *met])
        better = tracing.better
        if better is not None or tracing.stopped:
            break
    profiles = tuple(tracing.profile for tracing in tracings.values())
    ends = {p.name: p.ci95 for p in profiles if p.complete}
    left = tuple(name for name in wanted if name not in ends)
    warnings = tuple(
        f"The profiles were stopped by {p.stopped}: {len(ends)} of {len(wanted)} were done, and "
        f"the intervals of {', '.join(left)} are local."
        for p in profiles
        if p.stopped
    )
    methods = dict.fromkeys(ends, "profile likelihood")
    return Intervals(ends, methods, profiles, left, warnings=warnings, better=better)


def _met(best: BestPoint, name: str, tracings: Sequence[Tracing]) -> list[Array]:
    """Lowest and highest of a parameter among the points within its cut that profiles have met."""
    column, at = best.names.index(name), best.index[name]
    highest = best.quantiles[column] ** 2 * best.spread.inflation[column]
    refits = [one for tracing in tracings for one in tracing.refits]
    points = [one.point for one in refits if one.cost - best.cost < highest]
    if not points:
        return []
    return [min(points, key=lambda point: point[at]), max(points, key=lambda point: point[at])]


def _outside(best: BestPoint, name: str, points: Sequence[Array]) -> bool:
    """Whether one of the points is outside of a local interval."""
    at, half = best.index[name], best.halves[best.names.index(name)] * (1.0 + PLACED)
    return any(abs(point[at] - best.values[at]) > half for point in points)


def _by_bootstrap(
    best: BestPoint, choice: Choice, tracker: Tracker, announce: Announce
) -> Intervals:
    announce(_cost_told(best, "block bootstrap", choice.draws))
    drawn = bootstrap(best, choice.draws, choice.seed, tracker)
    note = f"Block bootstrap: {len(drawn.values)} of {choice.draws} refits."
    if drawn.stopped:
        note += f" It was stopped by {drawn.stopped}."
    if len(drawn.values) < ENOUGH_DRAWS:
        return Intervals(warnings=(note + " These are too few, so the intervals are local.",))
    return _percentiles(best, drawn.values, "block bootstrap", note, drawn.stopped is None)


def _by_mcmc(best: BestPoint, choice: Choice, tracker: Tracker, announce: Announce) -> Intervals:
    count = (choice.draws + 1) * walkers(best)
    announce(f"Markov chain: {count} simulations, about {count * _seconds(best)[0]:.2g} s")
    chain = mcmc(best, choice.draws, choice.seed, tracker)
    note = chain.sentence()
    if len(chain.samples) < ENOUGH_DRAWS:
        return Intervals(warnings=(note + " The intervals are local.",))
    lost = ", ".join(name for name in best.names if name not in best.known)
    if lost:
        note += (
            f" The test does not determine {lost}: the chain samples them with a flat prior within "
            "their limits, and they have no interval."
        )
    fine = chain.converged and chain.stopped is None
    return _percentiles(best, chain.samples, "MCMC", note, fine)


def _percentiles(best: BestPoint, drawn: Array, method: str, note: str, fine: bool) -> Intervals:
    """Intervals between the 2.5th and the 97.5th percentile of what was drawn.

    What is said of them is a warning if they are not what was asked for.
    """
    columns = dict(zip(best.names, np.percentile(drawn, [2.5, 97.5], axis=0).T, strict=True))
    ends = {name: (float(columns[name][0]), float(columns[name][1])) for name in best.known}
    notes, warnings = ((note,), ()) if fine else ((), (note,))
    return Intervals(ends, dict.fromkeys(ends, method), notes=notes, warnings=warnings)


def _seconds(best: BestPoint) -> tuple[float, float]:
    """Seconds of one evaluation of the residual and of its slopes."""
    problem = best.problem
    began = time.perf_counter()
    for _ in range(3):
        problem.objective.residual(best.values)
    middle = time.perf_counter()
    problem.slopes(best.values, best.names)
    return (middle - began) / 3.0, time.perf_counter() - middle


def _cost_told(best: BestPoint, what: str, refits: int) -> str:
    """Announcement of so many refits."""
    evaluation, slopes = _seconds(best)
    seconds = refits * (EVALUATIONS * evaluation + SLOPES * slopes)
    return f"{what}: {refits} refits, about {seconds:.2g} s"
