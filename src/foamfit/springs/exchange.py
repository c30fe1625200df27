"""Chains of nearly one loop: two springs in series exchange some of their properties."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from foamfit.arrays import Array
from foamfit.springs.model import Model
from foamfit.springs.parameters import HYSTERETIC

PROPERTIES = 7


def exchanges(model: Model, values: Array) -> Iterator[Array]:
    """Give the chains in which two springs of one kind have exchanged some properties.

    A chain under a common stress shows the sum of its springs' elongations, so properties are put
    as stresses and as elongations between them (`_by_stress`): with each exchange the springs snap
    at the same stresses and the rest of the loop moves as little as it can.

    Parameters
    ----------
    model
        The springs.
    values
        Vector of parameters, (n,) SI; nuisance parameters behind those of the springs stay.
    """
    kinds, index = model.kinds, model.index
    for one, other in combinations(range(len(kinds)), 2):
        if kinds[one] != kinds[other] or kinds[one] not in HYSTERETIC:
            continue
        places = [index[f"s{i + 1}_k0"] for i in (one, other)]
        names = [f"s{i + 1}_height" for i in (one, other)]
        heights = [float(values[index[n]]) if n in index else 1.0 for n in names]
        bistable = kinds[one] == "bistable"
        own = [
            _by_stress(values[first : first + PROPERTIES], height, bistable)
            for first, height in zip(places, heights, strict=True)
        ]
        for bits in range(1, 2 ** (PROPERTIES - 1)):
            chosen = np.array([bool(bits >> k & 1) for k in range(PROPERTIES)])
            out = values.copy()
            pairs = (own[0], own[1]), (own[1], own[0])
            for first, height, (mine, their) in zip(places, heights, pairs, strict=True):
                mixed = np.where(chosen, their, mine)
                out[first : first + PROPERTIES] = _by_strain(mixed, height, bistable)
            yield out


def _by_stress(spring: Array, height: float, bistable: bool) -> Array:
    """Stiffnesses over the height (Pa/m), stresses of snapping (Pa), elongations (m), (7,).

    Of a bistable spring k0, kc, k_h+, k_h-, σ_a, σ̄_c and the distance from branch a to C2.
    """
    if not bistable:
        k0, kc, eps_star, *rest = spring
        return np.array([k0 / height, kc / height, eps_star * height, *rest])
    k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus = spring
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + dsigma
    gap = eps_c - sigma_c / (k0 + sigma_c)
    stiff = np.array([k0, kc, kh_plus, kh_minus]) / height
    return np.append(stiff, [sigma_a, sigma_c, gap * height])


def _by_strain(mixed: Array, height: float, bistable: bool) -> Array:
    """The inverse of `_by_stress`."""
    if not bistable:
        return np.asarray(mixed * [height, height, 1.0 / height, 1.0, 1.0, 1.0, 1.0])
    k0, kc, kh_plus, kh_minus = mixed[:4] * height
    sigma_a, sigma_c, gap = mixed[4:]
    eps_a, eps_c = sigma_a / (k0 + sigma_a), gap / height + sigma_c / (k0 + sigma_c)
    return np.array([k0, kc, min(sigma_c - sigma_a, 0.0), eps_a, eps_c, kh_plus, kh_minus])
