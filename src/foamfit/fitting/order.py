"""The order of springs and of relaxation terms that could be exchanged."""

from __future__ import annotations

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.box import Space
from foamfit.fitting.objective import Objective
from foamfit.springs.laws.record import Law
from foamfit.springs.parameters import relaxation_names, split_name


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
