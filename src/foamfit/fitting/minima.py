"""Minima of the cost near the best one, which the search from start values may miss.

Which spring of a chain owns which property, and where A1 or ε_* lies, may show in few samples: the
cost then has several minima that differ by little. What is found here makes the best point better,
or says what else the test leaves open.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.box import Space
from foamfit.fitting.levenberg import Iterate, following
from foamfit.fitting.nuisance import CONTACT_TIME
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import MISSING, Tracker, descend, has_several, rank, squares
from foamfit.springs.laws.record import Law
from foamfit.springs.model import exchanges
from foamfit.springs.parameters import relaxation_names, split_name

# Most minima whose springs exchange properties, and most descents from each but the best.
EXCHANGES, EXCHANGED = 8, 16
# Where the best point misses more than noise: share of its cost by which another end may be worse
# and still have its springs exchanged.
DETOUR = 0.5
# Ends of the search whose cost is above the best by less than so many variances of the noise are
# settled anew, at most so many; points of the box closer than the last are one minimum.
NEAR, MINIMA, SAME = 40.0, 24, 0.02
# Steps of a scan: the first and the least as a share of the box, and the most to each side, half as
# many where the curves miss more than noise: minima so near are equally good there. Rise of the
# cost, in variances of what is left of the curves, above which a step is halved; its change below
# which the next one is doubled, until one was halved; and below which the scan ends.
STEP, SHORTEST, STEPS, TOO_HIGH, FLAT, NOTHING = 0.04, 0.015, 12, 300.0, 4.0, 0.05


def scan_places(tracker: Tracker, space: Space) -> bool:
    """Descend from points whose ε_a or ε_* is moved step by step; say whether one is better.

    So is the contact time of an impact whose motion is not measured: with a dashpot, a wrong one
    may fit almost as well.
    At each step the other parameters follow, then all are free. Where the curves miss more than
    noise only better ends are kept.
    """
    if tracker.best_values is None:
        return False
    best, cost, met = tracker.best_values, tracker.best_cost, [space.encode(tracker.best_values)]
    left = max(cost, tracker.objective.floor) / tracker.objective.n_data
    at_noise = cost <= tracker.objective.floor
    scanned = {law.scanned for law in space.model.laws}
    if "displacement_time" not in tracker.objective.counted:
        scanned.add(CONTACT_TIME)
    for column, one in enumerate(space.coordinates):
        for sign in (1.0, -1.0) if one.short in scanned else ():
            values, step, growth, before = best, sign * STEP, 2.0, cost
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
    return tracker.best_cost < cost


def _moved(tracker: Tracker, space: Space, point: Array, column: int, share: float) -> Array | None:
    """Move one coordinate by a share of the box, the others following; None beyond the box."""
    (low, high), (residual, jacobian) = space.box, squares(tracker, space)
    held = np.arange(point.size) == column
    shift = np.where(held, share * (high - low), 0.0)
    if not low[column] < (point + shift)[column] < high[column]:
        return None
    at = Iterate(point, residual(point), jacobian(point))
    steps = following(at, shift, held)
    return rank(tracker, space, [np.clip(point + step, low, high) for step in steps])[0][1]


def exchange_springs(tracker: Tracker, space: Space) -> list[tuple[float, int]]:
    """Descend from the best points with properties exchanged between springs of one kind.

    Which of two springs in series owns which branch shows in few samples: the loop of the chain
    hardly changes where they exchange it, so each such exchange has a minimum of its own. Each
    minimum that may lead to the best one is exchanged in turn. Returned are the costs of the ends,
    as by `search`.
    """
    if tracker.best_values is None or not has_several(space.model):
        return []
    objective, costs = tracker.objective, list[tuple[float, int]]()
    met, open_ends = [], [(tracker.best_cost, tracker.best_values)]
    for _ in range(EXCHANGES):
        best = tracker.best_cost
        # Where it misses more than noise the true springs, if there are any, are not yet found.
        detour = DETOUR * best if best > MISSING * objective.floor else 0.0
        open_ends = [end for end in open_ends if end[0] <= best + max(_near(objective), detour)]
        if not open_ends:
            break
        at = min(range(len(open_ends)), key=lambda i: open_ends[i][0])
        cost, values = open_ends.pop(at)
        values = in_order(space, objective, values)
        met.append(space.encode(values))
        points = [space.encode(other) for other in exchanges(space.model, values)]
        most = len(points) if cost <= tracker.best_cost else EXCHANGED
        for _, point in rank(tracker, space, points)[:most]:
            cost, end = descend(tracker, space, point, 60)
            values = in_order(space, objective, space.decode(end))
            costs.append((cost, 1))
            if not _among(met, space.encode(values)):
                met.append(space.encode(values))
                tracker.ends.append(values)
                open_ends.append((cost, values))
    return costs


def settle_ends(tracker: Tracker, space: Space) -> None:
    """Descend once more from the ends of the search that other noise could have made the best.

    What counts may have changed since they were found. Each minimum is kept once, its springs in
    order. Where the curves miss more than noise all ends stay as they are: an error of the law
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
    """Rise of the cost that other noise could make up for, with a wide margin."""
    return NEAR * objective.floor / objective.n_data


def _among(points: list[Array], point: Array) -> bool:
    """Whether a point of the box is one of these."""
    return any(float(np.max(np.abs(point - other))) < SAME for other in points)


def in_order(space: Space, objective: Objective, values: Array) -> Array:
    """Order springs that can be exchanged by where they start to snap, the softest at the base.

    Two springs can be exchanged if they are of one kind and the curves stay the same, so never
    across a mass inside whose displacement is counted; the foam of the paper buckles first at its
    base. Relaxation terms are ordered by their times, unless one of them is held.
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
    """Order the springs of one law; see `in_order`."""
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
    same = np.allclose(before, after, rtol=0.0, atol=1e-9 * max(float(np.max(np.abs(before))), 1.0))
    return moved if same else values
