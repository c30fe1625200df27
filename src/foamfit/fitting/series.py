"""Springs in series in the search: descents along their elongations, and crossing of good ends.

Along the measured motion springs in series share the strain, so that a change of one moves the
branches of all others, and few descents end in the best minimum. Under the measured stress their
elongations add up: each bends the curve at stresses of its own. A descent there and one along the
motion have different wrong minima, so that going from one to the other leaves most of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.box import Space
from foamfit.fitting.levenberg import descend
from foamfit.fitting.objective import Objective
from foamfit.fitting.starts import apart, off_edges
from foamfit.springs.model import exchanges

# Residual at a point of the box, and its derivative by the coordinates.
Functions = tuple[Callable[[Array], Array], Callable[[Array], Array]]
End = tuple[float, Array]  # cost and coordinates of the end of a descent

ALIKE = 1e-3  # relative difference of the costs of descents that ended in one minimum
# Samples to each side from which the local slope of a loop is taken, and its limits over the mean.
NEARBY, LEAST_SLOPE, LARGEST_SLOPE = 3, 0.02, 20.0
# Ends that are combined, and the least relative difference of their costs; failures in a row after
# which this stops; largest cost, over the best one, of a child whose descent goes on.
POOL, DIFFERENT, PATIENCE, HOPEFUL = 12, 0.01, 120, 1.5


def grouped(ends: Sequence[End], alike: float) -> list[list[End]]:
    """Return the ends of descents, best first, in groups whose relative cost differs by `alike`."""
    groups: list[list[End]] = []
    for end in sorted(ends, key=itemgetter(0)):
        if groups and end[0] <= (1.0 + alike) * groups[-1][0][0]:
            groups[-1].append(end)
        else:
            groups.append([end])
    return groups


def elongations(along: Objective, space: Space) -> Functions:
    """Return residual and derivative of the motion under the measured stress of a loop.

    `along` is the objective of the loop along its motion. Each elongation that is missed is
    multiplied by the local slope of the loop, so that it counts as the stress that is missed.
    """
    test = along.measurement
    assert test.displacement is not None
    assert test.stress is not None
    motion, stress = test.displacement, test.stress
    span, at = float(np.ptp(motion)), np.arange(motion.size)
    under = Objective(
        replace(test, noise=replace(test.noise, displacement=span)), along.model, "stress",
        {"displacement_time": 1.0}, nuisance=(), spent=along.spent,
    )  # fmt: skip
    ahead, behind = np.minimum(at + NEARBY, at[-1]), np.maximum(at - NEARBY, 0)
    run = np.maximum(np.abs(motion[ahead] - motion[behind]), 1e-9 * span) / span
    slope = np.abs(stress[ahead] - stress[behind]) / run / np.ptp(stress)
    weight = np.clip(slope, LEAST_SLOPE, LARGEST_SLOPE) * along.span("stress_strain")
    weight, count = weight[under.kept["displacement_time"]], len(along.model.names)

    def residual(point: Array) -> Array:
        return np.asarray(weight * under.residual(space.decode(point)[:count]))

    def jacobian(point: Array) -> Array:
        values = space.decode(point)
        moves = space.slopes(point, values)[:count]
        return np.asarray(weight[:, None] * under.jacobian_along(values[:count], moves))

    return residual, jacobian


def cross(
    space: Space, ends: Sequence[End], loop: Functions, stretched: Functions,
    rng: np.random.Generator,
) -> list[End]:  # fmt: skip
    """Combine the springs of the best ends until nothing better is found; return all ends.

    A child has a spring of another end, springs that have exchanged branches, or one stiffness far
    off, or is the end itself. It goes on along the `loop`, half of them first along the elongations
    (`stretched`).
    """
    pool, failed, out = [group[0] for group in grouped(ends, DIFFERENT)][:POOL], 0, [*ends]
    while failed < PATIENCE:
        best = pool[0][0]
        one, other = (pool[int(len(pool) * rng.random() ** 2)][1] for _ in range(2))
        way, children = rng.integers(4), [one]
        if way == 1:
            children = [_crossed(space, one, other, rng)]
        elif way == 2:
            children += [space.encode(x) for x in exchanges(space.model, space.decode(one))]
        elif way == 3:
            children += [*off_edges(space, one, anywhere=True), *apart(space, one)]
        one = children[rng.integers(len(children))]
        if way == 0 or rng.random() < 0.5:
            one = descend(*stretched, one, space.box, 15, enough=ALIKE).point
        end = descend(*loop, one, space.box, 12, enough=ALIKE)
        if end.cost < HOPEFUL * best:
            end = descend(*loop, end, space.box, 40, enough=1e-5)
        out.append((end.cost, end.point))
        failed = 0 if end.cost < (1.0 - ALIKE) * best else failed + 1
        pool = [group[0] for group in grouped([*pool, out[-1]], DIFFERENT)][:POOL]
    return out


def _crossed(space: Space, one: Array, other: Array, rng: np.random.Generator) -> Array:
    """Return a point with a spring of another point, every second time with its height.

    Springs of one law are taken for each other. The last height follows from the others.
    """
    model, out, source = space.model, space.decode(one), space.decode(other)
    to = int(rng.integers(len(model.kinds)))
    place = int(rng.choice([i for i, law in enumerate(model.laws) if law is model.laws[to]]))
    model.own(to, out)[:] = model.own(place, source)
    if rng.random() < 0.5:
        out[model.index[f"s{to + 1}_height"]] = source[model.index[f"s{place + 1}_height"]]
    return space.encode(space.complete(out))
