"""Compiled functions: the bistable and linear laws along a history.

A spring is one row of numbers (`Row`); a chain is an array of rows, base first. The only memory of
a bistable spring is its branch: a and d belong to the paper's flag a, c and e to flag c (eq. 3).
All quantities are SI. Integration in time is in `explicit.taylor`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from foamfit.arrays import Array as Array
from foamfit.springs.law import (
    BISTABLE,
    LINEAR,
    MICROSCALE,
    UNILATERAL,
    admissible,
    crossing,
    derived_points,
    most_beyond,
)

if TYPE_CHECKING:
    from numba.core.decorators import _JITWrapper

Row = Array
Branches = NDArray[np.int64]

# Division by zero gives infinity, as in NumPy; functions in which it can occur handle it.
PLAIN: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True}
compiled = cast("_JITWrapper", njit(**PLAIN, cache=True))
# For functions that are only called by compiled ones: without the wrapper for Python, which takes
# long to compile, and with fused multiply-add, which is faster and at least as exact.
_BRIDGELESS: dict[str, Any] = {**PLAIN, "no_cpython_wrapper": True, "fastmath": {"contract"}}
# Without reference counting of arrays, which takes long to run. Such functions copy arrays element
# by element: `a[:] = b` takes two seconds to compile, because of its error message.
_COUNTLESS: dict[str, Any] = {**_BRIDGELESS, "_nrt": False}
maker = njit(**_BRIDGELESS, cache=True)
inner = njit(**_COUNTLESS)
inlined = njit(**_COUNTLESS, forceinline=True)
# For long functions with a single caller, of which they are compiled as a part.
once = njit(error_model="numpy", inline="always")
# For parts of a large function that are compiled and cached separately; see `solve.precompile`.
piece = njit(**_COUNTLESS, cache=True)

# Columns of a row; the stress of each point is OF_STRESS columns after its strain.
KIND, K0, KC, KH_PLUS, KH_MINUS, ETA, EPS_STAR, OF_STRESS = *range(7), 4
EPS_A, EPS_C, EPS_HAT_A, EPS_HAT_C = range(7, 11)
SIGMA_A, SIGMA_C, SIGMA_HAT_A, SIGMA_HAT_C, N_COLUMNS = range(11, 16)

# Columns that a microscale spring uses differently: the logarithms of sigma_plus and sigma_minus,
# the spreads, and the logarithm of the stress at which both snap laws meet (see `law.crossing`).
LOG_PLUS, SPREAD_PLUS, LOG_MINUS, SPREAD_MINUS, LOG_CROSS = EPS_A, EPS_C, KH_PLUS, KH_MINUS, SIGMA_A
# REMEMBERS is 1 for microscale springs with softening, weakening or stiffening n, else 0. K_SNAPPED
# and LOG_AGAIN are k0 and the logarithm of the median snap-through stress of micro-springs that
# have snapped before; LOG_CROSS is then the stress at which the latter meets snap-back.
REMEMBERS, STIFFENING, K_SNAPPED, LOG_AGAIN = SIGMA_C, EPS_HAT_A, EPS_HAT_C, SIGMA_HAT_A
# The relaxation terms follow: g of term k = 0, 1, … is in column N_COLUMNS + 2 k, τ in the next.
# Unused terms have g = 0 and τ = inf.

# Branches: A to E of the bistable spring, LINE of a linear one, OPEN of a unilateral one out of
# contact. Of the microscale spring (on A before its first snap): HELD for a constant snapped
# fraction p, SNAP for p = P₊, BACK for p = P₋ > P₊, BOTH for p = P₊ = P₋, and AGAIN for
# p = P₊(σ e^s) of micro-springs that have snapped before.
A, D, C, E, LINE, OPEN, HELD, SNAP, BACK, BOTH, AGAIN = range(11)

_derived_points = inner(derived_points)
_admissible = inner(admissible)
_crossing = inner(crossing)
_most_beyond = inner(most_beyond)


@compiled
def fill_bistable(values: Array, row: Row) -> bool:
    """Write k0 … kh_minus and derived columns; return false if they are not admissible."""
    k0, kc, dsigma, eps_a = values[0], values[1], values[2], values[3]
    eps_c, kh_plus, kh_minus = values[4], values[5], values[6]
    if not _admissible(k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus):
        return False
    sigma_a, sigma_c, eps_star, hat_a, hat_c = _derived_points(
        k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus
    )
    row[KIND] = BISTABLE
    row[K0], row[KC], row[EPS_A], row[EPS_C] = k0, kc, eps_a, eps_c
    row[KH_PLUS], row[KH_MINUS] = kh_plus, kh_minus
    row[SIGMA_A], row[SIGMA_C], row[EPS_STAR] = sigma_a, sigma_c, eps_star
    row[EPS_HAT_A], row[EPS_HAT_C] = hat_a, hat_c
    row[SIGMA_HAT_A] = -math.inf if hat_a == -math.inf else k0 * hat_a / (1.0 - hat_a)
    row[SIGMA_HAT_C] = sigma_a + kh_plus * (hat_c - eps_a)
    return True


@compiled
def fill_microscale(values: Array, row: Row) -> bool:
    """Write own parameters and derived columns; return false if they are not admissible.

    Stiffening, softening and weakening, if present, follow spread_minus in this order.
    """
    count, stiffening, softening, weakening = values.size, 1.0, 0.0, 0.0
    if count == 8 or count == 10:
        stiffening = values[7]
    if count > 8:
        softening, weakening = values[count - 2], values[count - 1]
    for own in range(7):
        if own != 2 and not 0.0 < values[own] < math.inf:
            return False
    fine = 0.0 <= values[2] < math.inf and 0.0 < stiffening < math.inf
    if not (fine and 0.0 <= softening < math.inf and 0.0 <= weakening < math.inf):
        return False
    row[KIND], row[K0], row[KC], row[EPS_STAR] = MICROSCALE, values[0], values[1], values[2]
    row[LOG_PLUS], row[SPREAD_PLUS] = math.log(values[3]), values[4]
    row[LOG_MINUS], row[SPREAD_MINUS] = math.log(values[5]), values[6]
    row[REMEMBERS], row[STIFFENING] = 1.0 if count > 7 else 0.0, stiffening
    row[K_SNAPPED] = row[K0] * math.exp(-softening)
    row[LOG_AGAIN] = row[LOG_PLUS] - weakening
    row[LOG_CROSS] = _crossing(row[LOG_AGAIN], row[SPREAD_PLUS], row[LOG_MINUS], row[SPREAD_MINUS])
    if not row[K_SNAPPED] > 0.0:
        return False
    return row[EPS_STAR] >= _most_beyond(row[K_SNAPPED], row[KC], stiffening)[0]


@compiled
def fill_linear(values: Array, row: Row) -> bool:
    """Write k0; return false if it is not admissible."""
    row[KIND], row[K0] = LINEAR, values[0]
    return 0.0 < values[0] < math.inf


@compiled
def fill_unilateral(values: Array, row: Row) -> bool:
    """Write k0; return false if it is not admissible."""
    row[KIND], row[K0] = UNILATERAL, values[0]
    return 0.0 < values[0] < math.inf


# ---------------------------------------------------------------- the law of one spring


@inner
def branch_shape(row: Row, branch: int) -> tuple[bool, float, float, float]:
    """Return (curved, slope k, strain origin x0, stress origin s0) of a branch of eq. 2.

    Curved (a and c): σ = k x/(1-x) with x = ε - x0. Straight (d, e, linear): σ = s0 + k (ε - x0).
    """
    if branch == A:
        return True, row[K0], 0.0, 0.0
    if branch == C:
        return True, row[KC], row[EPS_STAR], 0.0
    if branch == D:
        return False, row[KH_PLUS], row[EPS_A], row[SIGMA_A]
    if branch == E:
        return False, row[KH_MINUS], row[EPS_C], row[SIGMA_C]
    if branch == LINE:
        return False, row[K0], 0.0, 0.0
    return False, 0.0, 0.0, 0.0


@inner
def stress_on(row: Row, branch: int, eps: float) -> float:
    """Return the stress on a branch (eq. 2); infinite at or past the pole of a curved one."""
    curved, k, x0, s0 = branch_shape(row, branch)
    x = eps - x0
    if not curved:
        return s0 + k * x
    return k * x / (1.0 - x) if x < 1.0 else math.inf


@inner
def strain_on(row: Row, branch: int, sigma: float) -> float:
    """Return the strain on a branch, the inverse of eq. 2; on a flat branch its first end."""
    curved, k, x0, s0 = branch_shape(row, branch)
    if curved:
        return x0 + sigma / (k + sigma) if sigma > -k else -math.inf
    return x0 + (sigma - s0) / k if k > 0.0 else x0


@inner
def slope_on(row: Row, branch: int, eps: float) -> float:
    """Return the slope dσ/dε of eq. 2 on a branch."""
    curved, k, x0, _ = branch_shape(row, branch)
    return k / (1.0 - (eps - x0)) ** 2 if curved else k


@inner
def interval(row: Row, branch: int, of: int = 0) -> tuple[float, float]:
    """Return the strains (low, high) at the ends of a branch; with `of` = OF_STRESS, stresses."""
    if branch == A:
        return -math.inf, row[EPS_A + of]
    if branch == D:
        return row[EPS_A + of], row[EPS_HAT_C + of]
    if branch == C:
        return row[EPS_C + of], math.inf
    if branch == E:
        return row[EPS_HAT_A + of], row[EPS_C + of]
    if branch == LINE:
        return (0.0 if row[KIND] == UNILATERAL else -math.inf), math.inf
    return -math.inf, 0.0


@inner
def above(branch: int) -> int:
    """Return the branch that a spring enters when it leaves `branch` upwards in strain."""
    if branch == A:
        return D
    return C if branch in (D, E) else LINE


@inner
def below(branch: int) -> int:
    """Return the branch that a spring enters when it leaves `branch` downwards in strain."""
    if branch == C:
        return E
    return A if branch in (D, E) else OPEN


@inner
def first_branch(row: Row) -> int:
    """Return the branch of a spring at rest."""
    return A if row[KIND] == BISTABLE or row[KIND] == MICROSCALE else LINE


@inner
def branch_at_strain(row: Row, branch: int, eps: float) -> int:
    """Return the branch at strain `eps` of a spring that was on `branch` (eqs. 2 and 3)."""
    if row[KIND] == LINEAR:
        return LINE
    if row[KIND] == UNILATERAL:
        return LINE if eps >= 0.0 else OPEN
    if branch in (A, D):
        if eps < row[EPS_A]:
            return A
        return D if eps <= row[EPS_HAT_C] else C
    if eps > row[EPS_C]:
        return C
    return E if eps >= row[EPS_HAT_A] else A


@inner
def branch_at_stress(row: Row, branch: int, sigma: float) -> int:
    """Return the branch at stress `sigma` of a spring that was on `branch` (eqs. 2 and 3)."""
    if row[KIND] == LINEAR:
        return LINE
    if row[KIND] == UNILATERAL:
        return LINE if sigma >= 0.0 else OPEN
    if branch in (A, D):
        if sigma < row[SIGMA_A]:
            return A
        if row[KH_PLUS] == 0.0:
            return A if sigma == row[SIGMA_A] else C
        return D if sigma <= row[SIGMA_HAT_C] else C
    if sigma > row[SIGMA_C]:
        return C
    if row[KH_MINUS] == 0.0:
        return C if sigma == row[SIGMA_C] else A
    return E if sigma >= row[SIGMA_HAT_A] else A


@inner
def _follow_strain(row: Row, eps: Array, sigma: Array, history: Branches) -> None:
    """Fill stress and branch along the strains of one spring from rest, branch by branch."""
    branch, first = first_branch(row), 0
    while first < eps.size:
        branch = branch_at_strain(row, branch, eps[first])
        low, high = interval(row, branch)
        last = first + 1
        while last < eps.size and low < eps[last] < high:
            last += 1
        curved, k, x0, s0 = branch_shape(row, branch)
        given, found = eps[first:last], sigma[first:last]  # their indices are never negative
        if curved:
            for j in range(given.size):
                x = given[j] - x0
                found[j] = k * x / (1.0 - x) if x < 1.0 else math.inf
        else:
            for j in range(given.size):
                found[j] = s0 + k * (given[j] - x0)
        history[first:last] = branch
        first = last


@inner
def follow_stress(row: Row, sigma: Array, eps: Array, history: Branches) -> None:
    """Fill strain and branch along the stresses of one spring from rest, branch by branch.

    The strain is -inf where the spring cannot carry the stress.
    """
    branch, first = first_branch(row), 0
    while first < sigma.size:
        branch = branch_at_stress(row, branch, sigma[first])
        low, high = interval(row, branch, OF_STRESS)
        last = first + 1
        while last < sigma.size and low < sigma[last] < high:
            last += 1
        curved, k, x0, s0 = branch_shape(row, branch)
        given, found = sigma[first:last], eps[first:last]
        if curved:
            for j in range(given.size):
                found[j] = x0 + given[j] / (k + given[j]) if given[j] > -k else -math.inf
        elif k > 0.0:
            for j in range(given.size):
                found[j] = x0 + (given[j] - s0) * (1.0 / k)
        else:
            found[:] = -math.inf if branch == OPEN else x0
        history[first:last] = branch
        first = last


@compiled
def stress_along(row: Row, eps: Array) -> tuple[Array, Branches]:
    """Return stress and branch of one spring along a strain history, from rest."""
    sigma = np.empty(eps.size)
    branches = np.empty(eps.size, np.int64)
    _follow_strain(row, eps, sigma, branches)
    return sigma, branches


@compiled
def tangent_along(row: Row, eps: Array, branches: Branches) -> Array:
    """Return the slope dσ/dε at each sample of a strain history with known branches."""
    slope = np.empty(eps.size)
    for j in range(eps.size):
        slope[j] = slope_on(row, branches[j], eps[j])
    return slope


@compiled
def fault(t: Array) -> int:
    """Return the first sample that is not finite or not later than the previous one, or -1."""
    rises = math.isfinite(t[0]) and math.isfinite(t[-1])
    for j in range(1, t.size):  # free of branches, so that it can be vectorised
        rises &= t[j] > t[j - 1]
    for j in range(t.size if not rises else 0):
        if not math.isfinite(t[j]) or (j > 0 and t[j] <= t[j - 1]):
            return j
    return -1


@compiled
def list_switches(time: Array, strain: Array, branches: Branches) -> Array:
    """Return the changes of branch between samples, at the later sample."""
    count, n = branches.shape
    seen = 0
    for i in range(count):
        for j in range(1, n):
            seen += branches[i, j] != branches[i, j - 1]
    out, at = np.empty((seen, 5)), 0
    for j in range(1, n):
        for i in range(count):
            if branches[i, j] != branches[i, j - 1]:
                out[at, 0], out[at, 1], out[at, 4] = time[j], i, strain[i, j]
                out[at, 2], out[at, 3] = branches[i, j - 1], branches[i, j]
                at += 1
    return out


@compiled
def distance_to_pole(rows: Array, heights: Array, displacement: Array) -> float:
    """Return the least distance, in strain, of any spring on branch c from 1 + ε_*; at most 1.

    `displacement` (n, n_t) is that of the node above each spring.
    """
    least = 1.0
    for i in range(heights.size):
        strain = -math.inf
        for j in range(displacement.shape[1]):
            below = displacement[i - 1, j] if i > 0 else 0.0
            strain = max(strain, (displacement[i, j] - below) / heights[i])
        kind = rows[i, KIND]
        if kind == MICROSCALE or (kind == BISTABLE and strain > rows[i, EPS_C]):
            least = min(least, 1.0 - (strain - rows[i, EPS_STAR]))
    return least


@compiled
def total(values: Array) -> float:
    """Return the sum of an array, which is finite only if all elements are."""
    out = 0.0
    for value in values:
        out += value
    return out
