"""Derivatives of the law by the parameters of a spring, compiled."""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import numpy as np

from foamfit.springs.kernels import (
    EPS_A,
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
from foamfit.springs.law import BISTABLE
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


@inner
def stress_tangent(row: Row, branch: int, eps: float, d_eps: float, own: int) -> float:
    """Derivative of a spring's stress by its `own` parameter (or -1), by which eps moves d_eps."""
    dk = dx0 = ds0 = 0.0
    if 0 <= own < OWN_ETA:
        dk, dx0, ds0 = branch_derivative(row, branch, own)
    curved, _, x0, _ = branch_shape(row, branch)
    x = eps - x0
    at_rest = (x / (1.0 - x) if curved else x) * dk + ds0
    return at_rest + slope_on(row, branch, eps) * (d_eps - dx0)


@compiled
def equilibrium_tangents(
    rows: Array, heights: Array, eps: Array, branches: Branches, moved: bool, directions: Branches
) -> tuple[Array, Array]:
    """Derivatives along a history of springs in series, undamped and massless.

    Parameters
    ----------
    rows, heights : arrays
        The springs.
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
    for j in range(n):
        flat = -1
        for i in range(count):
            branch = branches[i, j]
            if j == 0 or branch != branches[i, j - 1]:
                for p in range(size):
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
            i = directions[p, 0]
            known = longer = 0.0  # δσ at fixed strain, δ of the elongation at fixed stress
            if i >= 0 and directions[p, 1] == OWN_HEIGHT:
                longer = eps[i, j]
            elif i >= 0:
                curved, _, x0, _ = branch_shape(rows[i], branches[i, j])
                x = eps[i, j] - x0
                factor = x / (1.0 - x) if curved else x
                known = factor * change[p, 0] - slope[i] * change[p, 1] + change[p, 2]
                longer = -heights[i] * known / slope[i] if slope[i] > 0.0 else 0.0
            common = gap = 0.0
            if moved and flat < 0:
                common = -longer / float(compliance[count])
            elif moved:  # a flat branch takes up all that the others leave
                common = known if i == flat else 0.0
                gap = -longer - common * float(compliance[count])
            out_s[p, j] = common
            for node in range(count):
                own_part = longer if 0 <= i <= node else 0.0
                out_w[p, node, j] = own_part + common * compliance[node + 1]
                if 0 <= flat <= node:
                    out_w[p, node, j] += gap
    return out_w, out_s
