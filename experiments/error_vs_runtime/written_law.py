"""The bistable and the linear law as the competitors of foamfit evaluate it, compiled.

It is written from docs/theory.md (eqs. 1-5) and reads only public attributes of springs, so that
the competitors share no compiled code with foamfit.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

import foamfit as ff

compiled = njit(cache=True, error_model="numpy")

# Columns of a row. The stress of each of four points is OF_STRESS columns after its strain.
ETA, K0, KC, STAR, PLUS, MINUS, EPS_A, EPS_C, EPS_HAT_A, EPS_HAT_C = range(10)
OF_STRESS, COLUMNS = 4, 14
SIGMA_A, SIGMA_C, SIGMA_HAT_A, SIGMA_HAT_C = (OF_STRESS + k for k in range(EPS_A, EPS_HAT_C + 1))
A, D, C, E, LINE = range(5)


def rows_of(chain: ff.Chain) -> np.ndarray:
    """Return the rows of bistable and linear springs, (springs, COLUMNS)."""
    rows = np.zeros((len(chain.springs), COLUMNS))
    for row, spring in zip(rows, chain.springs, strict=True):
        row[ETA], row[K0] = spring.eta, spring.k0
        if isinstance(spring, ff.LinearSpring):
            assert not spring.unilateral
            continue
        assert isinstance(spring, ff.BistableSpring)
        assert spring.kh_plus > 0.0
        assert spring.kh_minus > 0.0
        row[KC], row[STAR] = spring.kc, spring.eps_star
        row[PLUS], row[MINUS] = spring.kh_plus, spring.kh_minus
        corners = {"A2": (-math.inf, -math.inf)} | spring.corners
        for column, name in ((EPS_A, "A1"), (EPS_C, "C2"), (EPS_HAT_A, "A2"), (EPS_HAT_C, "C1")):
            row[column], row[column + OF_STRESS] = corners[name]
    return rows


@compiled
def first_branch(row):
    """Return the branch of a spring at rest."""
    return A if row[KC] > 0.0 else LINE


@compiled
def branch_shape(row, branch):
    """Return (curved, slope k, strain origin x0, stress origin s0) of a branch of eq. 2.

    Curved (a and c): σ = k x/(1-x) with x = ε - x0. Straight (d, e, linear): σ = s0 + k (ε - x0).
    """
    if branch == A:
        return True, row[K0], 0.0, 0.0
    if branch == C:
        return True, row[KC], row[STAR], 0.0
    if branch == D:
        return False, row[PLUS], row[EPS_A], row[SIGMA_A]
    if branch == E:
        return False, row[MINUS], row[EPS_C], row[SIGMA_C]
    return False, row[K0], 0.0, 0.0


@compiled
def stress_on(row, branch, eps):
    """Return the stress on a branch; infinite at or past the pole of a curved one."""
    curved, k, x0, s0 = branch_shape(row, branch)
    x = eps - x0
    if not curved:
        return s0 + k * x
    return k * x / (1.0 - x) if x < 1.0 else math.inf


@compiled
def strain_on(row, branch, sigma):
    """Return the strain on a branch."""
    curved, k, x0, s0 = branch_shape(row, branch)
    if curved:
        return x0 + sigma / (k + sigma) if sigma > -k else -math.inf
    return x0 + (sigma - s0) / k


@compiled
def slope_on(row, branch, eps):
    """Return the slope dσ/dε on a branch."""
    curved, k, x0, _ = branch_shape(row, branch)
    return k / (1.0 - (eps - x0)) ** 2 if curved else k


@compiled
def interval(row, branch, of=0):
    """Return the strains (low, high) at the ends of a branch; with `of` = OF_STRESS, stresses."""
    if branch == A:
        return -math.inf, row[EPS_A + of]
    if branch == D:
        return row[EPS_A + of], row[EPS_HAT_C + of]
    if branch == C:
        return row[EPS_C + of], math.inf
    if branch == E:
        return row[EPS_HAT_A + of], row[EPS_C + of]
    return -math.inf, math.inf


@compiled
def above(branch):
    """Return the branch that a spring enters when it leaves `branch` upwards."""
    return D if branch == A else C


@compiled
def below(branch):
    """Return the branch that a spring enters when it leaves `branch` downwards."""
    return E if branch == C else A


@compiled
def branch_at(row, branch, value, of=0):
    """Return the branch at a strain (or stress, see `interval`) of a spring that was on another."""
    if branch == LINE:
        return LINE
    if branch in (A, D):
        if value < row[EPS_A + of]:
            return A
        return D if value <= row[EPS_HAT_C + of] else C
    if value > row[EPS_C + of]:
        return C
    return E if value >= row[EPS_HAT_A + of] else A


@compiled
def _elongation(rows, branches, heights, s):
    """Return the elongation of springs in series at a stress, and its derivative."""
    total = soft = 0.0
    for i in range(heights.size):
        branch = branch_at(rows[i], branches[i], s, OF_STRESS)
        curved, k, _, _ = branch_shape(rows[i], branch)
        total += heights[i] * strain_on(rows[i], branch, s)
        soft += heights[i] * (k / (k + s) ** 2 if curved else 1.0 / k)
    return total, soft


@compiled
def equilibrate(rows, branches, heights, elongation, s):
    """Return the common stress of springs in series at an elongation; change their branches.

    Newton's method, inside a bracket from the eighth trial on.
    """
    low, high = -math.inf, math.inf
    for trial in range(200):
        total, soft = _elongation(rows, branches, heights, s)
        miss = total - elongation
        if abs(miss) <= 1e-15 * (abs(total) + abs(elongation)):
            break
        if miss > 0.0:
            high = s
        else:
            low = s
        s -= miss / soft
        if (trial >= 8 and trial % 3 == 0) or not low < s < high:
            if low > -math.inf and high < math.inf:
                s = 0.5 * (low + high)
                if s in (low, high):  # adjacent floating-point numbers
                    break
            elif not math.isfinite(s):
                break
    for i in range(heights.size):
        branches[i] = branch_at(rows[i], branches[i], s, OF_STRESS)
    return s
