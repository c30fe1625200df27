"""Minima of the cost near the best point, which the search from start values may miss.

The assignment of properties to the springs of a chain, and the place of A1 or ε_*, may depend on a
few samples; the cost then has several minima of similar depth. The minima found here improve the
best point, or show what the test leaves undetermined.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import SimulationError
from foamfit.fitting.box import Space
from foamfit.fitting.levenberg import Iterate, following
from foamfit.fitting.nuisance import CONTACT_TIME
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import MINIMA, Tracker, descend, halve, rank, squares
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
# Steps of a scan. STEP and SHORTEST: first and shortest step, as a fraction of the box. STEPS: most
# steps to each side, halved above the noise floor, where nearby minima are equally good.
STEP, SHORTEST, STEPS = 0.04, 0.015, 12
# Largest change of the residual, over the largest residual, by an order of springs that changes
# nothing; simulated impacts differ by up to 3e-5. SAME_COST: the relative change of the cost.
SAME_CURVES, SAME_COST = 1e-4, 1e-5
CONTACT_STEP = 0.12  # first step of the contact time: about the error of the first rise
# Changes of the cost, in residual variances: above TOO_HIGH a step is halved, below FLAT the next
# one is doubled (until one has been halved), and below NOTHING the scan ends.
TOO_HIGH, FLAT, NOTHING = 300.0, 4.0, 0.05


def scan_places(tracker: Tracker, space: Space) -> None:
    """Move ε_a or ε_* in steps and descend from each; the tracker keeps the best point.

    At each step the other parameters are fitted first, then all parameters. The contact time of an
    impact without a measured motion is scanned as well, because with a dashpot a wrong one may fit
    almost as well. Above the noise floor only better ends are kept.
    """
    if tracker.best_values is None:
        return
    best, cost, met = tracker.best_values, tracker.best_cost, [space.encode(tracker.best_values)]
    left = max(cost, tracker.objective.floor) / tracker.objective.n_data
    at_noise = cost <= tracker.objective.floor
    scanned = {law.scanned for law in space.model.laws}
    if "displacement_time" not in tracker.objective.counted:
        scanned.add(CONTACT_TIME)
    for column, one in enumerate(space.coordinates):
        for sign in (1.0, -1.0) if one.short in scanned else ():
            first = CONTACT_STEP if one.short == CONTACT_TIME else STEP
            values, step, growth, before = best, sign * first, 2.0, cost
            for _ in range(STEPS if at_noise else STEPS // 2):
                point = _moved(tracker, space, space.encode(values), column, step)
                if point is None:
                    break
                free = tuple(name for name in space.free if name != space.names[one.place])
                fixed = replace(space, values=space.decode(point), free=free)
                now, point = descend(tracker, fixed, fixed.encode(fixed.values), 30, enough=1e-4)
                if now > cost + TOO_HIGH * left:
                    step, growth = 0.5 * step, 1.0
                    if abs(step) < SHORTEST:
                        break
                    continue
                change, values, before = abs(now - before), fixed.decode(point), now
                if change < NOTHING * left:
                    break
                step *= growth if change < FLAT * left else 1.0
                now, end = descend(tracker, space, space.encode(values), 60)
                if not _among(met, end) and (at_noise or now < cost):
                    met.append(end)
                    tracker.ends.append(space.decode(end))


def _moved(tracker: Tracker, space: Space, point: Array, column: int, share: float) -> Array | None:
    """Move one coordinate by a fraction of the box, the others following; None outside it."""
    (low, high), (residual, jacobian) = space.box, squares(tracker, space)
    held = np.arange(point.size) == column
    shift = np.where(held, share * (high - low), 0.0)
    if not low[column] < (point + shift)[column] < high[column]:
        return None
    at = Iterate(point, residual(point), jacobian(point))
    steps = following(at, shift, held)
    return rank(tracker, space, [np.clip(point + step, low, high) for step in steps])[0][1]


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
