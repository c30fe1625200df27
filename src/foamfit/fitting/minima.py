"""Minima of the cost that other noise could have made the best, and the order of springs in them.

Which properties belong to which spring of a chain may depend on a few samples; the cost then has
several minima of similar depth. They show what the test leaves undetermined.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from operator import attrgetter

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import SimulationError
from foamfit.fitting.box import Space
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import MINIMA, Tracker, descend, halve, rank
from foamfit.fitting.together import Layout, Together, fit_linked
from foamfit.springs.laws.record import Law
from foamfit.springs.model import exchanges
from foamfit.springs.parameters import relaxation_names, split_name

# Largest number of minima of a joint fit from which springs are exchanged, and of descents from
# each but the best.
EXCHANGES, EXCHANGED = 8, 16
# Ends of the search within NEAR noise variances of the best cost are refined, at most MINIMA of
# them. Points of the box closer than SAME are one minimum.
NEAR, SAME = 40.0, 0.02
# Largest change of the residual, over the largest residual, by an order of springs that changes
# nothing; simulated impacts differ by up to 3e-5. SAME_COST: the relative change of the cost.
SAME_CURVES, SAME_COST = 1e-4, 1e-5


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
        if cost > tracker.best_cost + _near(objective) or len(settled) == MINIMA:
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
    return NEAR * objective.floor / objective.n_data


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
