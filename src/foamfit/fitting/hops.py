"""Hops of the search: descents from points beside its good ends, which may be in a wrong minimum.

Springs in series share the strain, so that a change of one moves the branches of all others, and
few descents from start values end in the best minimum. There the hops also combine ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import itemgetter

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.box import Space
from foamfit.fitting.levenberg import Iterate, descend
from foamfit.fitting.starts import inner_part
from foamfit.springs.model import exchanges

# Residual at a point of the box, and its derivative by the coordinates.
Functions = tuple[Callable[[Array], Array], Callable[[Array], Array]]
End = tuple[float, Array]  # cost and coordinates of the end of a descent
Way = Callable[[Space, Array, Array, np.random.Generator], Array]  # from two points to a child

ALIKE = 1e-3  # relative difference of the costs of descents that ended in one minimum
# Ends that are combined, and the least relative difference of their costs; failures in a row after
# which this stops.
POOL, DIFFERENT, PATIENCE = 12, 0.01, 120
# Stages of the descent from a child: iterations, relative gain at which it ends, and largest cost,
# over the best one, with which it goes on.
STAGES = ((5, ALIKE, 5.0), (7, ALIKE, 1.5), (40, 1e-5, np.inf))


def grouped(ends: Sequence[End], alike: float) -> list[list[End]]:
    """Return the ends of descents, best first, in groups whose relative cost differs by `alike`."""
    groups: list[list[End]] = []
    for end in sorted(ends, key=itemgetter(0)):
        if groups and end[0] <= (1.0 + alike) * groups[-1][0][0]:
            groups[-1].append(end)
        else:
            groups.append([end])
    return groups


def hop(
    space: Space, ends: Sequence[End], functions: Functions, rng: np.random.Generator,
    patience: int = PATIENCE,
) -> list[End]:  # fmt: skip
    """Descend from children of the best ends until `patience` in a row are no better.

    `functions` are the residual and its derivative; `WAYS`, and for springs in series `IN_SERIES`,
    say how a child is made of two ends. Return all ends.
    """
    ways = *WAYS, *(IN_SERIES if space.model.has_several else ())
    pool, failed, out = [group[0] for group in grouped(ends, DIFFERENT)][:POOL], 0, [*ends]
    while failed < patience:
        best = pool[0][0]
        one, other = (pool[int(len(pool) * rng.random() ** 2)][1] for _ in range(2))
        child = ways[rng.integers(len(ways))](space, one, other, rng)
        failed += 1
        if np.array_equal(child, one):
            continue
        at: Array | Iterate = child
        for iterations, enough, hopeful in STAGES:
            at = end = descend(*functions, at, space.box, iterations, enough=enough)
            if end.cost > hopeful * best:
                break
        out.append((end.cost, end.point))
        if end.cost < (1.0 - ALIKE) * best:
            failed = 0
        pool = [group[0] for group in grouped([*pool, out[-1]], DIFFERENT)][:POOL]
    return out


def _crossed(space: Space, one: Array, other: Array, rng: np.random.Generator) -> Array:
    """Return a point with a spring of another point, in half of the cases with its height.

    Springs of one law are taken for each other. The last height follows from the others.
    """
    model, out, source = space.model, space.decode(one), space.decode(other)
    to = int(rng.integers(len(model.kinds)))
    place = int(rng.choice([i for i, law in enumerate(model.laws) if law is model.laws[to]]))
    model.own(to, out)[:] = model.own(place, source)
    if rng.random() < 0.5:
        out[model.index[f"s{to + 1}_height"]] = source[model.index[f"s{place + 1}_height"]]
    return space.encode(space.complete(out))


def _exchanged(space: Space, one: Array, _: Array, rng: np.random.Generator) -> Array:
    """Return a point whose springs have exchanged branches."""
    chains = [*exchanges(space.model, space.decode(one))]
    return space.encode(chains[rng.integers(len(chains))]) if chains else one


def _mixed(space: Space, one: Array, other: Array, rng: np.random.Generator) -> Array:
    """Return a point with about half of the coordinates of another."""
    return np.where(rng.random(one.size) < 0.5, one, other)


def _far(space: Space, one: Array, _: Array, rng: np.random.Generator) -> Array:
    """Return a point with one coordinate anywhere in the inner part of the box."""
    out, at, (low, high) = one.copy(), rng.integers(one.size), inner_part(space)
    out[at] = rng.uniform(low[at], high[at])
    return out


def _beside(space: Space, one: Array, _: Array, rng: np.random.Generator) -> Array:
    """Return a point with about half of the coordinates changed, within the inner part of the box.

    Further out lie stiff springs, which take long and need the implicit method.
    """
    low, high = inner_part(space)
    far = 10.0 ** rng.uniform(-2.0, -0.5) * (high - low) * rng.standard_normal(one.size)
    far *= rng.random(one.size) < 0.5
    return np.asarray(np.clip(one + far, np.minimum(low, one), np.maximum(high, one)))


WAYS: tuple[Way, ...] = _mixed, _far, _beside
IN_SERIES: tuple[Way, ...] = _crossed, _exchanged
