"""Undamped, massless springs in series: a common stress, along a motion or a stress history.

Along a monotone part of the motion the strain of each spring is a monotone function of the common
stress. The sum of their elongations therefore has one root, across any number of switches, and no
integration in time is needed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.springs.kernels import (
    K0,
    KIND,
    OPEN,
    Array,
    Branches,
    branch_at_strain,
    branch_at_stress,
    compiled,
    first_branch,
    follow_stress,
    inner,
    maker,
    slope_on,
    strain_on,
)
from foamfit.springs.law import MICROSCALE, UNILATERAL
from foamfit.springs.microscale_kernels import rank_at, strain_along, strain_under

# Strain to whose rounding error elongations are always resolved.
LEAST = 1e-6


class Group(NamedTuple):
    """Springs in series: rows, branches, ranks (springs, 2) of microscale ones, heights (m)."""

    rows: Array
    branches: Branches
    ranks: Array
    heights: Array


@inner
def _series_strain(group: Group, sigma: float, eps: Array) -> tuple[float, float, float]:
    """Fill the strains under one stress; return elongation, compliance, and size of the terms."""
    rows, branches, ranks, heights = group
    total = compliance = size = 0.0
    for i in range(rows.shape[0]):
        if rows[i, KIND] == MICROSCALE:
            rank, ever, branch = rank_at(rows[i], ranks[i, 0], ranks[i, 1], branches[i], sigma)
            eps[i], soft = strain_under(rows[i], branch, rank, ever, sigma)
            compliance += heights[i] * soft
        else:
            branch = branch_at_stress(rows[i], branches[i], sigma)
            eps[i] = strain_on(rows[i], branch, sigma) if branch != OPEN else -math.inf
            if branch != OPEN:
                compliance += heights[i] / slope_on(rows[i], branch, eps[i])
        total += heights[i] * eps[i]
        size += heights[i] * max(abs(eps[i]), LEAST)
    return total, compliance, size


@inner
def _bracket(group: Group, elongation: float, sigma: float, eps: Array) -> tuple[float, float]:
    """Return stresses (low, high) between which springs in series reach `elongation`."""
    step = 1e-3 * abs(sigma)
    for i in range(group.rows.shape[0]):
        step = max(step, 1e-6 * group.rows[i, K0])
    low = high = sigma
    for _ in range(200):
        if _series_strain(group, low, eps)[0] <= elongation:
            break
        high = low
        low -= step
        step *= 2.0
    for _ in range(200):
        if _series_strain(group, high, eps)[0] >= elongation:
            break
        low = high
        high += step
        step *= 2.0
    return low, high


@maker
def _split_jump(group: Group, elongation: float, low: float, high: float, eps: Array) -> float:
    """Distribute an elongation inside a jump from the base up; return the stress.

    If a unilateral spring opens, the stress is zero and the gap takes the rest of the elongation.
    """
    rows, heights, upper = group.rows, group.heights, np.empty(eps.size)
    _series_strain(group, high, upper)
    rest = elongation - _series_strain(group, low, eps)[0]
    for i in range(eps.size):
        if eps[i] == -math.inf and rows[i, KIND] == UNILATERAL:
            rest = elongation - _series_strain(group, 0.0, eps)[0]
            eps[i] += rest / heights[i]
            return 0.0
    for i in range(eps.size):
        gain = min(max(rest / heights[i], 0.0), upper[i] - eps[i])
        eps[i] += gain
        rest -= heights[i] * gain
    return 0.5 * (low + high)


@maker
def equilibrate(group: Group, elongation: float, sigma: float, eps: Array) -> float:
    """Return the common stress of springs in series at an elongation; fill strains and memory.

    Newton's method, from the eighth trial on inside a bracket that every third trial halves. If the
    root lies in a jump of the elongation (k_h± = 0, or a very narrow snap), the springs take their
    part from the base up.
    """
    rows, branches, ranks, _ = group
    found = False
    low, high = -math.inf, math.inf
    for trial_number in range(400):
        total, compliance, size = _series_strain(group, sigma, eps)
        miss = total - elongation
        if abs(miss) <= 2e-15 * (size + abs(elongation)) and math.isfinite(total):
            found = True
            break
        if miss > 0.0:
            high = min(high, sigma)
        else:
            low = max(low, sigma)
        trial = sigma - miss / compliance
        if trial_number == 8:  # a kink or a jump
            low, high = _bracket(group, elongation, sigma, eps)
        if trial_number >= 8 and (trial_number % 3 == 0 or not low < trial < high):
            trial = 0.5 * (low + high)
            if trial in (low, high):  # adjacent floating-point numbers
                found = abs(miss) <= 1e-12 * (size + abs(elongation))
                break
        elif not low < trial < high:
            trial = 0.5 * (low + high) if math.isfinite(low) and math.isfinite(high) else sigma
        sigma = trial
    if not found:
        sigma = _split_jump(group, elongation, low, high, eps)
    for i in range(eps.size):
        if rows[i, KIND] == MICROSCALE:
            reached = rank_at(rows[i], ranks[i, 0], ranks[i, 1], branches[i], sigma)
            ranks[i, 0], ranks[i, 1], branches[i] = reached
        else:
            branches[i] = branch_at_strain(rows[i], branches[i], eps[i])
    return sigma


@compiled
def equilibrium_along(
    rows: Array, heights: Array, top: Array, sigma: Array, eps: Array, history: Branches
) -> None:
    """Follow undamped, massless springs in series along a motion of the top (m).

    Fills the common stress (n,), and strains and branches (springs, n).
    """
    count, n = rows.shape[0], top.size
    now, branches = np.empty(count), np.empty(count, np.int64)
    group = Group(rows, branches, np.full((count, 2), -math.inf), heights)
    for i in range(count):
        branches[i] = first_branch(rows[i])
    last = 0.0
    for j in range(n):
        last = equilibrate(group, top[j], last, now)
        sigma[j] = last
        for i in range(count):
            eps[i, j] = now[i]
            history[i, j] = branches[i]


@compiled
def strains_along(
    rows: Array, heights: Array, sigma: Array, top: Array, eps: Array, history: Branches
) -> bool:
    """Follow springs in series along a stress; fill motion of the top (n,), m, strains, branches.

    Returns False if a spring cannot carry the stress. `eps` and `history` may have no rows.
    """
    n, kept, total = sigma.size, eps.shape[0] > 0, 0.0
    strain, branches = np.empty(n), np.empty(n, np.int64)
    for i in range(rows.shape[0]):
        if kept:
            strain, branches = eps[i], history[i]
        if rows[i, KIND] == MICROSCALE:
            found, _, passed = strain_along(rows[i], sigma)
            for j in range(n):
                strain[j], branches[j] = found[j], passed[j]
        else:
            follow_stress(rows[i], sigma, strain, branches)
        if i == 0:
            for j in range(n):
                top[j] = heights[i] * strain[j]
        else:
            for j in range(n):
                top[j] += heights[i] * strain[j]
    for j in range(n):
        total += top[j]
    return math.isfinite(total)
