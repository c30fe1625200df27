"""Chains of nearly one loop: two springs in series exchange some of their properties."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from foamfit.arrays import Array
from foamfit.springs.model import Model


def exchanges(model: Model, values: Array) -> Iterator[Array]:
    """Give the chains in which two springs of one kind have exchanged some properties.

    A chain under a common stress shows the sum of its springs' elongations, so properties are put
    as stresses and as elongations between them (`Law.exchanged`): with each exchange the springs
    snap at the same stresses and the rest of the loop moves as little as it can.

    Parameters
    ----------
    model
        The springs.
    values
        Vector of parameters, (n,) SI; nuisance parameters behind those of the springs stay.
    """
    index, laws = model.index, model.laws
    for pair in combinations(range(len(laws)), 2):
        law, other = (laws[i] for i in pair)
        if law is not other or law.exchanged is None:
            continue
        to_stresses, from_stresses = law.exchanged
        names = [f"s{i + 1}_height" for i in pair]
        heights = [float(values[index[n]]) if n in index else 1.0 for n in names]
        own = [
            to_stresses(model.own(i, values)[:-1], height)
            for i, height in zip(pair, heights, strict=True)
        ]
        count = len(law.params)
        for bits in range(1, 2 ** (count - 1)):
            chosen = np.array([bool(bits >> k & 1) for k in range(count)])
            out = values.copy()
            for i, height, mine, their in zip(pair, heights, own, own[::-1], strict=True):
                mixed = np.where(chosen, their, mine)
                model.own(i, out)[:-1] = from_stresses(mixed, height)
            yield out
