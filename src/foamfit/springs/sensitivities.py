"""Derivatives of the law by the parameters of a spring, compiled."""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import numpy as np

from foamfit.springs.kernels import (
    EPS_A,
    HELD,
    K0,
    KC,
    KIND,
    OPEN,
    SIGMA_C,
    A,
    Array,
    Branches,
    D,
    E,
    Row,
    branch_shape,
    compiled,
    inner,
    slope_on,
)
from foamfit.springs.law import BISTABLE, MICROSCALE
from foamfit.springs.microscale_kernels import (
    OF_STRAIN,
    strain_along,
    strain_tangents,
    under_stress,
)
from foamfit.springs.parameters import OWN_ETA, OWN_HEIGHT


@inner
def branch_derivative(row: Row, branch: int, own: int) -> tuple[float, float, float]:
    """Derivatives of (k, x0, s0) of a branch of eq. 2 by a spring's own parameter k0 … kh_minus.

    Across an open gap nothing acts, whatever the spring is.
    """
    if branch == OPEN:
        return 0.0, 0.0, 0.0
    if row[KIND] != BISTABLE or branch == A:
        return (1.0 if own == 0 else 0.0), 0.0, 0.0
    eps_a, v = row[EPS_A], 1.0 - row[EPS_A]
    d_sigma_a = (eps_a / v if own == 0 else 0.0) + (row[K0] / (v * v) if own == 3 else 0.0)
    if branch == D:
        return (1.0 if own == 5 else 0.0), (1.0 if own == 3 else 0.0), d_sigma_a
    d_sigma_c = d_sigma_a + (1.0 if own == 2 else 0.0)
    d_eps_c = 1.0 if own == 4 else 0.0
    if branch == E:
        return (1.0 if own == 6 else 0.0), d_eps_c, d_sigma_c
    d_kc = 1.0 if own == 1 else 0.0
    stiff = row[KC] + row[SIGMA_C]
    d_eps_star = d_eps_c - (row[KC] * d_sigma_c - row[SIGMA_C] * d_kc) / (stiff * stiff)
    return d_kc, d_eps_star, 0.0


@compiled
def equilibrium_tangents(
    rows: Array,
    heights: Array,
    sigma: Array,
    eps: Array,
    branches: Branches,
    moved: bool,
    directions: Branches,
) -> tuple[Array, Array]:
    """Derivatives along a history of springs in series, undamped and massless.

    Parameters
    ----------
    rows, heights : arrays
        The springs.
    sigma : (n,) array
        Their common stress, Pa.
    eps, branches : (springs, n) arrays
        Their strains and branches.
    moved : bool
        Whether the displacement of the top is prescribed, or else the stress.
    directions : (p, 2) array
        See `parameters`.

    Returns
    -------
    tuple of arrays
        Derivatives of the displacements above the springs (p, springs, n), m, and of the common
        stress (p, n), Pa, per unit of the parameters.
    """
    (count, n), size = eps.shape, directions.shape[0]
    out_w, out_s = np.empty((size, count, n)), np.empty((size, n))
    change = np.zeros((size, 3))  # of k, x0 and s0 of the branch that the direction's spring is on
    slope, compliance = np.empty(count), np.zeros(count + 1)  # the latter of all below each node
    ranks, d_ranks, longer = np.zeros((count, n)), np.zeros((size, count)), np.empty(count)
    by, by_rank, pace = np.zeros((count, OF_STRAIN)), np.zeros(count), np.zeros(count)
    for i in range(count):
        if rows[i, KIND] == MICROSCALE:
            ranks[i] = strain_along(rows[i], sigma)[1]
    for j in range(n):
        flat = -1
        for i in range(count):
            branch = branches[i, j]
            if rows[i, KIND] == MICROSCALE:
                _, soft, by_rank[i], pace[i] = under_stress(rows[i], branch, ranks[i, j], sigma[j])
                strain_tangents(rows[i], branch, ranks[i, j], sigma[j], by[i])
                slope[i] = 1.0 / (soft + by_rank[i] * pace[i])
            else:
                for p in range(size if j == 0 or branch != branches[i, j - 1] else 0):
                    own = directions[p, 1]
                    if directions[p, 0] == i and own < OWN_ETA:
                        new = branch_derivative(rows[i], branch, own)
                        change[p, 0], change[p, 1], change[p, 2] = new
                slope[i] = slope_on(rows[i], branch, eps[i, j])
            compliance[i + 1] = compliance[i]
            if slope[i] > 0.0:
                compliance[i + 1] += heights[i] / slope[i]
            elif flat < 0:
                flat = i
        for p in range(size):
            own, at = directions[p, 1], directions[p, 0]
            known = total = 0.0  # δσ at fixed strain, δ of the elongation at fixed stress
            for i in range(count):
                longer[i] = 0.0
                if rows[i, KIND] == MICROSCALE:
                    if branches[i, j] != HELD:  # what is held moves with the stress where it turned
                        d_ranks[p, i] = by[i, own] if i == at and 3 <= own < OWN_ETA else 0.0
                    longer[i] = heights[i] * by_rank[i] * d_ranks[p, i]
                if i == at and own == OWN_HEIGHT:
                    longer[i] += eps[i, j]
                elif i == at and rows[i, KIND] == MICROSCALE:
                    longer[i] += heights[i] * by[i, own] if own < 3 else 0.0
                elif i == at and own < OWN_ETA:
                    curved, _, x0, _ = branch_shape(rows[i], branches[i, j])
                    x = eps[i, j] - x0
                    factor = x / (1.0 - x) if curved else x
                    known = factor * change[p, 0] - slope[i] * change[p, 1] + change[p, 2]
                    longer[i] = -heights[i] * known / slope[i] if slope[i] > 0.0 else 0.0
                total += longer[i]
            common = gap = 0.0
            if moved and flat < 0:
                common = -total / float(compliance[count])
            elif moved:  # a flat branch takes up all that the others leave
                common = known if at == flat else 0.0
                gap = -total - common * float(compliance[count])
            out_s[p, j], total = common, 0.0
            for node in range(count):
                total += longer[node] + (gap if node == flat else 0.0)
                out_w[p, node, j] = total + common * compliance[node + 1]
                if branches[node, j] != HELD:
                    d_ranks[p, node] += pace[node] * common
    return out_w, out_s
