"""Compiled derivatives of springs in equilibrium by their parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foamfit.springs import kernels
from foamfit.springs.kernels import (
    Array,
    Branches,
    Row,
    branch_shape,
    compiled,
    inner,
    maker,
    slope_on,
)
from foamfit.springs.law import BISTABLE, MICROSCALE
from foamfit.springs.microscale_kernels import (
    CARRIED,
    OF_STRAIN,
    OF_WEAKENING,
    strain_along,
    strain_tangents,
)
from foamfit.springs.parameters import OWN_ETA, OWN_HEIGHT


@inner
def branch_derivative(row: Row, branch: int, own: int) -> tuple[float, float, float]:
    """Return the derivatives of (k, x0, s0) of a branch of eq. 2 by k0 … kh_minus."""
    if branch == kernels.OPEN:
        return 0.0, 0.0, 0.0
    if row[kernels.KIND] != BISTABLE or branch == kernels.A:
        return (1.0 if own == 0 else 0.0), 0.0, 0.0
    eps_a, v = row[kernels.EPS_A], 1.0 - row[kernels.EPS_A]
    d_sigma_a = (eps_a / v if own == 0 else 0.0) + (row[kernels.K0] / (v * v) if own == 3 else 0.0)
    if branch == kernels.D:
        return (1.0 if own == 5 else 0.0), (1.0 if own == 3 else 0.0), d_sigma_a
    d_sigma_c = d_sigma_a + (1.0 if own == 2 else 0.0)
    d_eps_c = 1.0 if own == 4 else 0.0
    if branch == kernels.E:
        return (1.0 if own == 6 else 0.0), d_eps_c, d_sigma_c
    d_kc = 1.0 if own == 1 else 0.0
    stiff = row[kernels.KC] + row[kernels.SIGMA_C]
    d_eps_star = d_eps_c - (row[kernels.KC] * d_sigma_c - row[kernels.SIGMA_C] * d_kc) / (
        stiff * stiff
    )
    return d_kc, d_eps_star, 0.0


@inner
def branch_tangents(row: Row, branch: int, eps: float, moved: float, out: Array) -> None:
    """Fill the derivatives of the stress at a strain by k0 … kh_minus, then by a shift `moved`."""
    slope = slope_on(row, branch, eps)
    curved, _, x0, _ = branch_shape(row, branch)
    x = eps - x0
    factor = x / (1.0 - x) if curved else x
    for own in range(OF_STRAIN):
        dk, dx0, ds0 = branch_derivative(row, branch, own)
        out[own] = factor * dk - slope * dx0 + ds0
    out[OF_STRAIN] = slope * moved


@compiled
def stress_tangents_along(row: Row, eps: Array, branches: Branches) -> Array:
    """Return the derivatives (8, n) of the stress of a bistable or linear spring.

    They are taken along a strain history by k0 … kh_minus and by the logarithm of the strain.
    """
    out, now = np.empty((OF_STRAIN + 1, eps.size)), np.empty(OF_STRAIN + 1)
    for j in range(eps.size):
        branch_tangents(row, branches[j], eps[j], eps[j], now)
        for own in range(now.size):
            out[own, j] = now[own]
    return out


class _Followed(NamedTuple):
    """Springs at one sample, and the derivatives that are carried from sample to sample.

    slope (springs,) is dσ/dε, change (p, 3) the derivatives of k, x0 and s0 of a branch. For
    microscale springs: ranks (springs, 2, n), derivatives of the strain `by` parameters (springs,
    CARRIED) and by_ranks (springs, 2), the derivative `pace` of the first rank by the stress, and
    d_ranks (p, springs, 2).
    """

    slope: Array
    change: Array
    ranks: Array
    by: Array
    by_ranks: Array
    pace: Array
    d_ranks: Array


@maker
def _followed(rows: Array, sigma: Array, size: int) -> _Followed:
    """Return springs at rest."""
    count, n = rows.shape[0], sigma.size
    ranks = np.zeros((count, 2, n))
    for i in range(count):
        if rows[i, kernels.KIND] == MICROSCALE:
            found = strain_along(rows[i], sigma)[1]
            for j in range(n):
                ranks[i, 0, j], ranks[i, 1, j] = found[0, j], found[1, j]
    return _Followed(
        np.empty(count), np.zeros((size, 3)), ranks, np.zeros((count, CARRIED)),
        np.zeros((count, 2)), np.zeros(count), np.zeros((size, count, 2)),
    )  # fmt: skip


@inner
def _follow(
    at: _Followed, rows: Array, i: int, j: int, sigma: float, eps: Array, branches: Branches,
    directions: Branches,
) -> None:  # fmt: skip
    """Fill the fields of spring i at sample j."""
    branch = branches[i, j]
    if rows[i, kernels.KIND] == MICROSCALE:
        w, ever = at.ranks[i, 0, j], at.ranks[i, 1, j]
        soft, by_rank, by_ever, pace = strain_tangents(rows[i], branch, w, ever, sigma, at.by[i])
        at.by_ranks[i, 0], at.by_ranks[i, 1], at.pace[i] = by_rank, by_ever, pace
        at.slope[i] = 1.0 / (soft + by_rank * pace)
        return
    if j == 0 or branch != branches[i, j - 1]:
        for p in range(directions.shape[0]):
            own = directions[p, 1]
            if directions[p, 0] == i and own < OWN_ETA:
                new = branch_derivative(rows[i], branch, own)
                at.change[p, 0], at.change[p, 1], at.change[p, 2] = new
    at.slope[i] = slope_on(rows[i], branch, eps[i, j])


@inner
def _moves_line(own: int) -> bool:
    """Return whether a parameter changes the ranks of a microscale spring, not the strain."""
    return 3 <= own < OF_STRAIN or own == OF_WEAKENING


@inner
def _mixture_tangent(at: _Followed, p: int, i: int, branch: int, own: int, held: bool) -> float:
    """Return the derivative of the strain of a microscale spring at a fixed stress.

    It is taken by its parameter `own`, -1 for a parameter of another spring; `held` is whether all
    micro-springs that have ever snapped are held.
    """
    d_rank, d_ever = at.d_ranks[p, i, 0], at.d_ranks[p, i, 1]
    if branch == kernels.HELD:  # the held rank depends on the stress at the turn
        d_rank = d_ever if held else d_rank
    else:
        d_rank = at.by[i, own] if _moves_line(own) else 0.0
    at.d_ranks[p, i, 0] = d_rank
    out = at.by_ranks[i, 0] * d_rank + at.by_ranks[i, 1] * d_ever
    return out + at.by[i, own] if own >= 0 and not _moves_line(own) else out


@inner
def _rank_tangents(at: _Followed, p: int, branches: Branches, common: float) -> None:
    """Update the derivatives of moving ranks by the change of the common stress."""
    for i in range(branches.size):
        if branches[i] != kernels.HELD:
            at.d_ranks[p, i, 0] += at.pace[i] * common
        if branches[i] == kernels.SNAP:
            at.d_ranks[p, i, 1] = at.d_ranks[p, i, 0]


@compiled
def equilibrium_tangents(
    rows: Array,
    heights: Array,
    sigma: Array,
    eps: Array,
    branches: Branches,
    moved_top: bool,
    directions: Branches,
) -> tuple[Array, Array]:
    """Return derivatives along a history of undamped, massless springs in series.

    `sigma` (n,) is the common stress; strains and branches are (springs, n); the motion of the top
    is prescribed, or else the stress. Returns the derivatives in p directions (see `parameters`) of
    the displacements above the springs, (p, springs, n), m, and of the common stress, (p, n), Pa.
    """
    (count, n), size = eps.shape, directions.shape[0]
    out_w, out_s = np.empty((size, count, n)), np.empty((size, n))
    at, longer = _followed(rows, sigma, size), np.empty(count)
    compliance, slope = np.zeros(count + 1), at.slope  # compliance of all springs below a node
    for j in range(n):
        flat = -1
        for i in range(count):
            _follow(at, rows, i, j, sigma[j], eps, branches, directions)
            compliance[i + 1] = compliance[i]
            if slope[i] > 0.0:
                compliance[i + 1] += heights[i] / slope[i]
            elif flat < 0:
                flat = i
        for p in range(size):
            own, spring = directions[p, 1], directions[p, 0]
            known = total = 0.0  # δσ at fixed strain, δ of the elongation at fixed stress
            for i in range(count):
                longer[i] = 0.0
                mine = own if i == spring and own < OWN_ETA else -1
                if rows[i, kernels.KIND] == MICROSCALE:
                    held = (
                        at.ranks[i, 0, j] == at.ranks[i, 1, j] and rows[i, kernels.REMEMBERS] > 0.0
                    )
                    moved = _mixture_tangent(at, p, i, branches[i, j], mine, held)
                    longer[i] = heights[i] * moved
                elif mine >= 0:
                    curved, _, x0, _ = branch_shape(rows[i], branches[i, j])
                    x = eps[i, j] - x0
                    factor = x / (1.0 - x) if curved else x
                    known = factor * at.change[p, 0] - slope[i] * at.change[p, 1] + at.change[p, 2]
                    longer[i] = -heights[i] * known / slope[i] if slope[i] > 0.0 else 0.0
                if i == spring and own == OWN_HEIGHT:
                    longer[i] += eps[i, j]
                total += longer[i]
            common = gap = 0.0
            if moved_top and flat < 0:
                common = -total / float(compliance[count])
            elif moved_top:  # a flat branch takes the rest of the elongation
                common = known if spring == flat else 0.0
                gap = -total - common * float(compliance[count])
            out_s[p, j], total = common, 0.0
            for node in range(count):
                total += longer[node] + (gap if node == flat else 0.0)
                out_w[p, node, j] = total + common * compliance[node + 1]
            _rank_tangents(at, p, branches[:, j], common)
    return out_w, out_s
