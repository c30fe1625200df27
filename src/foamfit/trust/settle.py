"""After the search: refinement, nuisance parameters that keep to the record, and weighing.

An error of the law could be hidden by a wrong contact time or zero. Where it is larger than the
noise, these stay where the record shows them (`keep_to_record`). Where the motion that drives is
uncertain, the residual is weighed by its covariance once, at the optimum of plain least squares; a
fit that then follows the record worse returns to that optimum (`weigh_motion`).

Which properties belong to which spring of a chain may depend on a few samples; the cost then has
several minima of similar depth. Those that other noise could have made the best show what the test
leaves undetermined (`settle_ends`, `joint_minima`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from operator import attrgetter

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import SimulationError
from foamfit.fitting import levenberg, search
from foamfit.fitting.box import Space
from foamfit.fitting.curves import history
from foamfit.fitting.nuisance import shown_by
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import Freed, Tracker, descend, distinct, halve, rank, squares
from foamfit.fitting.together import Layout, Together, fit_linked
from foamfit.springs.laws.record import Law
from foamfit.springs.model import exchanges
from foamfit.springs.parameters import NUISANCE, relaxation_names, split_name
from foamfit.trust.best_point import BestPoint

SearchHeld = Callable[[], Sequence[Array]]  # searches with contact and zeros held
# The law errs if its RMS error exceeds the noise, and this share of the scale of the curve, which
# is at least half a percent of its range.
OVER_SCALE = 0.2
# Ends of the search from which a descent begins on all samples or once parameters are held, and
# their largest cost over the best one.
MINIMA, NEAR = 12, 1.5
ITERATIONS, ENOUGH = 60, 1e-3  # of such a descent, and its relative gain at the end
LEFT = 1e-6  # predicted gain of the sum of squares at which a refinement ends
SHOWN = 3.0  # standard errors from the zero of the file, from which the fitted one is another
WORSE = 1.05  # largest RMS deviation from the record over that of plain least squares
# Largest number of minima of a joint fit from which springs are exchanged, and of descents from
# each but the best.
EXCHANGES, EXCHANGED = 8, 16
# Noise variances over the best cost within which ends of the search are minima of their own. Points
# of the box closer than SAME are one minimum.
BY_NOISE, SAME = 40.0, 0.02
# Largest change of the residual, over the largest residual, by an order of springs that changes
# nothing; simulated impacts differ by up to 3e-5. SAME_COST: the relative change of the cost.
SAME_CURVES, SAME_COST = 1e-4, 1e-5


def refine(problem: Problem, tracker: Tracker) -> None:
    """Descend from the best point until nothing is left to gain."""
    if tracker.best_values is not None:
        space = problem.space()
        start = space.encode(tracker.best_values)
        levenberg.descend(*squares(tracker, space), start, space.box, ITERATIONS, least=LEFT)


def held_by_record(problem: Problem, asked: Collection[str]) -> Problem:
    """Return the problem with contact and zeros held where the record shows them.

    Those that the user has `asked` to vary stay free.
    """
    objective, test = problem.objective, problem.measurement
    shown = shown_by(test, objective.drive, late=objective.time_shift)
    if history(test, problem.model) is not None:  # the stress may start above the zero
        shown.pop("displacement_zero", None)
    kept = {name: shown[name] for name in problem.free() if name in shown and name not in asked}
    return replace(problem.holding({name: one.mean for name, one in kept.items()}), kept=kept)


def errs(best: BestPoint) -> bool:
    """Return whether the error of the law is larger than the noise in some curve."""
    return any(one.law > max(math.sqrt(one.noise.variance), OVER_SCALE) for one in best.errors)


def descend_again(problem: Problem, tracker: Tracker) -> None:
    """Descend from the ends of the search after other parameters have become free or held.

    The best point comes first, so that the tracker keeps it if the time limit is reached.
    """
    space, best = problem.space(), tracker.best_values
    starts = [*([] if best is None else [best]), *tracker.ends]
    tracker.best_values, tracker.best_cost, tracker.ends = None, math.inf, []
    ranked = rank(tracker, space, [space.encode(values) for values in starts])
    near = [one for one in ranked if one[0] <= NEAR * ranked[0][0]]
    for _, point in distinct(near)[:MINIMA]:
        end = descend(tracker, space, point, ITERATIONS, ENOUGH)[1]
        tracker.ends.append(space.decode(end))
    refine(problem, tracker)


def steps(
    problem: Problem,
    tracker: Tracker,
    asked: Collection[str],
    given: Collection[str],
    search_held: SearchHeld = tuple,
) -> Iterator[tuple[Problem, Freed | None]]:
    """Decide what stays free and weigh the residuals, with descents from the ends of the search.

    Yields the problem after each step, and what `keep_to_record` found. Nuisance parameters that
    the user has `asked` to vary, or has `given`, stay as they are.
    """
    problem, freed = keep_to_record(problem, tracker, asked, search_held)
    yield problem, freed
    problem = free_zero(problem, tracker, given)
    yield problem, freed
    problem = weigh_priors(problem, tracker)
    yield problem, freed
    weigh_motion(problem, tracker)


def keep_to_record(
    problem: Problem, tracker: Tracker, asked: Collection[str], search_held: SearchHeld
) -> tuple[Problem, Freed | None]:
    """Hold contact and zeros where the record shows them, if the law errs more than the noise.

    `search_held` searches without them and returns the ends; descents begin from those of both.
    """
    values, held = tracker.best_values, held_by_record(problem, asked)
    if values is None or not held.kept or not errs(BestPoint(problem, values)):
        return problem, None
    other = _afresh(tracker, [*search_held(), *tracker.ends, values])
    descend_again(held, other)
    if other.best_values is None:
        return problem, None
    if other.best_cost < tracker.best_cost:  # the search with these free had missed a minimum
        values = other.best_values
    tracker.best_values, tracker.best_cost = other.best_values, other.best_cost
    tracker.ends = other.ends
    springs = [name for name in problem.free() if name not in NUISANCE]
    both = {name: problem.index[name] for name in springs}
    moved = {n: (float(other.best_values[i]), float(values[i])) for n, i in both.items()}
    misfits = _misfit(problem, other.best_values), _misfit(problem, values)
    return held, Freed(tuple(held.kept), *misfits, moved)


def _afresh(tracker: Tracker, ends: list[Array]) -> Tracker:
    """Return a tracker without a best point, with the same limits and other ends."""
    return replace(tracker, ends=ends, best_values=None, best_cost=math.inf)


def free_zero(problem: Problem, tracker: Tracker, given: Collection[str]) -> Problem:
    """Free the zero of the force of a record that begins in contact, if only an offset is wrong.

    The zero of the file counts unless it is `SHOWN` standard errors off and the law has no error
    with the fitted one. One that the user has `given` stays.
    """
    name, values, test = "stress_zero", tracker.best_values, problem.measurement
    if values is None or problem.objective.drive != "displacement" or test.contact != "file":
        return problem
    if name in given or name in problem.free() or not problem.is_exact(name):
        return problem
    freed = replace(problem, params=problem.params.copy())
    freed.params[name].vary = True
    held = BestPoint(freed, values)
    other = _afresh(tracker, [*tracker.ends, values])
    descend_again(freed, other)
    assert other.best_values is not None  # the start can be simulated
    best = BestPoint(freed, other.best_values)
    pairs = zip(held.errors, best.errors, strict=True)
    # The uncertain motion, by which the residual is not yet weighed, may leave a little.
    follows = all(
        new.law <= min(0.5 * old.law, 0.25 * math.sqrt(new.noise.variance)) for old, new in pairs
    )
    error = best.spread.stderr[best.names.index(name)] if name in best.names else math.inf
    if not follows or abs(best.value(name)) < SHOWN * error:
        return problem
    tracker.best_values, tracker.best_cost = other.best_values, other.best_cost
    tracker.ends += other.ends
    note = "The record begins in contact; the law follows it only with another zero of the force "
    note += "than that of the file, so stress_zero is fitted."
    return replace(freed, notes=(*problem.notes, note))


def weigh_priors(problem: Problem, tracker: Tracker) -> Problem:
    """Return the problem with priors that count for more if the law errs, after a descent."""
    objective, values = problem.objective, tracker.best_values
    if values is None or not objective.priors or objective.unit >= 1.0:
        return problem
    if errs(BestPoint(problem, values)):
        tracker.objective = replace(objective, erring=True)
        problem = replace(problem, objective=tracker.objective)
        descend_again(problem, tracker)
    return problem


def _misfit(problem: Problem, values: Array) -> float:
    """Return the largest misfit of the counted curves, RMS over range."""
    objective = problem.objective
    rms = objective.rms(objective.plain(values))
    return max(value / float(np.ptp(objective.measured[name])) for name, value in rms.items())


def weigh_motion(problem: Problem, tracker: Tracker) -> None:
    """Weight the residual by the covariance due to the motion's own uncertainty, and refine.

    The covariance is that at the optimum of plain least squares, to which the fit returns if it
    then follows the record worse.
    """
    plain, cost = tracker.best_values, tracker.best_cost
    if plain is None or not problem.objective.weigh_motion(plain):
        return
    tracker.plain = plain, cost
    tracker.best_values, tracker.best_cost = None, math.inf  # the weights have changed
    tracker.consider(plain)
    refine(problem, tracker)
    back_to_plain(problem, tracker)


def back_to_plain(problem: Problem, tracker: Tracker) -> None:
    """Return to plain least squares if the best point follows the record more than 5 % worse.

    Where both residuals are noise, the weighed one is right.
    """
    objective = problem.objective
    if tracker.plain is None or objective.weighing is None or tracker.best_values is None:
        return
    values, cost = tracker.plain
    residual = objective.plain(tracker.best_values)
    if float(residual @ residual) <= WORSE**2 * cost:
        return
    unweighed = copy(objective)
    unweighed.weighing = None
    alone = replace(problem, objective=unweighed)
    if errs(BestPoint(alone, values)) or errs(BestPoint(alone, tracker.best_values)):
        objective.weighing, tracker.best_values, tracker.best_cost = None, values, cost


# ---------------------------------------------------------------- other minima


def joint_minima(found: Together) -> list[Together]:
    """Return the minima of a joint fit that noise could make the best, cheapest first.

    Branches of springs in series are exchanged in all tests alike, and the springs put in order, if
    that changes no curve of any test.
    """
    problems, links, model = found.problems, found.links, found.problems[0].model
    if not model.has_several:
        return [found]
    whole = Layout.of(problems, links)
    thin = Layout.of(tuple(problem.thinned() for problem in problems), links)
    near, nearly = (max(_near(one.objective) for one in few) for few in (problems, thin.problems))

    def settled(vectors: Sequence[Array]) -> Together:
        end = fit_linked(problems, links, [vectors])
        pairs = zip(problems, end.values, strict=True)
        ordered = [in_order(one.space(), one.objective, values) for one, values in pairs]
        other = whole.fitted(whole.start(ordered))
        return other if other.cost <= end.cost * (1.0 + SAME_COST) else end

    ends = [settled(found.values)]
    met, left = [thin.start(ends[0].values)], ends[:]
    for _ in range(EXCHANGES):
        best = min(end.cost for end in ends)
        left = sorted((end for end in left if end.cost <= best + near), key=attrgetter("cost"))
        if not left:
            break
        end = left.pop(0)
        exchanged = zip(*(exchanges(model, values) for values in end.values), strict=True)
        points = list(map(thin.start, exchanged))
        costs = np.array([np.sum(thin.residual(point) ** 2) for point in points])
        places = np.argsort(costs)[: len(points) if end.cost == best else EXCHANGED]
        starts = [points[i] for i in places if np.isfinite(costs[i])]
        least = float(np.sum(thin.residual(thin.start(end.values)) ** 2))
        for cost, point in halve((thin.residual, thin.jacobian), thin.box, starts):
            if cost > least + nearly or _among(met, point):
                continue
            with suppress(SimulationError):  # the thinned record was simulated
                other = settled([term.values(point) for term in thin.terms])
                met += [point, at := thin.start(other.values)]
                if not _among(met[:-2], at):
                    ends.append(other)
                    left.append(other)
    best = min(end.cost for end in ends)
    return sorted((end for end in ends if end.cost <= best + near), key=attrgetter("cost"))


def settle_ends(tracker: Tracker, space: Space) -> None:
    """Descend again from the ends of the search that would be the best with other noise.

    The weights may have changed since the ends were found. Each minimum is kept once, with its
    springs in order. Above the noise floor all ends stay as they are, because an error of the law
    could make any of them the best.
    """
    objective = tracker.objective
    if tracker.best_values is None or tracker.best_cost > objective.floor:
        return

    def in_box(values: Array) -> Array:
        return space.encode(in_order(space, objective, values))

    settled, met = list[Array](), [in_box(tracker.best_values)]
    for cost, point in rank(tracker, space, [in_box(values) for values in tracker.ends]):
        if cost > tracker.best_cost + _near(objective) or len(settled) == search.MINIMA:
            break
        if _among(met, point):
            continue
        end = in_box(space.decode(descend(tracker, space, point, 60)[1]))
        if not _among(met, end):
            met.append(end)
            settled.append(space.decode(end))
    tracker.ends = settled


def _near(objective: Objective) -> float:
    """Return the increase of the cost that other noise could cause, with a wide margin."""
    return BY_NOISE * objective.floor / objective.n_data


def _among(points: list[Array], point: Array) -> bool:
    """Return whether a point of the box coincides with one of the points."""
    return any(float(np.max(np.abs(point - other))) < SAME for other in points)


def in_order(space: Space, objective: Objective, values: Array) -> Array:
    """Sort interchangeable springs by the strain at which they snap, the softest at the base.

    The foam of the paper buckles first at its base. Springs are interchangeable if they are of one
    kind and the curves do not change, so never across an interior mass whose displacement counts.
    Relaxation terms are sorted by their times, unless one of them is fixed.
    """
    model, free = space.model, set(space.free)
    for law in dict.fromkeys(model.laws):
        values = _of_law(space, objective, values, law) if law.hysteretic else values
    out = values.copy()
    for spring in range(1, len(model.kinds) + 1):
        names = [f"s{spring}_{short}" for short in relaxation_names(model.relaxation)]
        if names and free.issuperset(names):
            places = [model.index[name] for name in names]
            terms = values[places].reshape(-1, 2)
            out[places] = terms[np.argsort(terms[:, 1])].ravel()
    return out


def _of_law(space: Space, objective: Objective, values: Array, law: Law) -> Array:
    """Sort the springs of one law; see `in_order`."""
    model = space.model
    own = [i for i, other in enumerate(model.laws) if other is law]
    held = [split_name(name) for name in model.names if name not in space.free]
    if any(spring in own and short not in ("eta", "height") for spring, short in held):
        return values
    nodes = [n for name, n in objective.interior.items() if name in objective.counted]

    def order(spring: int) -> tuple[int, float]:
        parameters = model.own(spring, values)
        onset = float(parameters[0] if law.onset is None else law.onset(parameters))
        return sum(node <= spring for node in nodes), onset

    ranked = sorted(own, key=order)
    if ranked == own:
        return values
    moved, sources = values.copy(), dict(zip(own, ranked, strict=True))
    for name in model.names:
        place, short = split_name(name)
        if place in sources:
            moved[model.index[name]] = values[model.index[f"s{sources[place] + 1}_{short}"]]
    before, after = (objective.residual(v) for v in (values, moved))
    most = SAME_CURVES * max(float(np.max(np.abs(before))), 1e-5)
    return moved if np.allclose(before, after, rtol=0.0, atol=most) else values
