"""The compiled functions of the springs of the paper: the bistable (eqs. 1-5) and the linear ones.

Their branches are hyperbolas, σ = k x/(1-x), or straight lines, σ = s0 + k x, with x = ε - x0. The
row is a table of the branches.
"""

from __future__ import annotations

import math
from functools import partial

from numba import njit

from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import BY, MISS, OF_LAW, SLOPE, Compiled, inner, past, start
from foamfit.springs.laws.bistable import admissible, derived_points

A, D, C, E = range(4)  # branches of a bistable spring
LINE, OPEN = range(2)  # of a linear one; OPEN: out of contact
# Of each branch in the row: 1 if it is curved; slope k, origins x0 and s0; stresses and strains at
# its ends; the branches below and above it. Then the derivatives of k, x0 and s0 by the parameters.
_NAMES = (
    "curved", "k", "x0", "s0", "sigma_low", "sigma_high", "low", "high", "below", "above"
)  # fmt: skip
SHAPE, PARAMETERS = 6, 7  # numbers of a branch up to the stresses at its ends
_OF_K = len(_NAMES)
_OF_X0, _OF_S0, WIDE = (_OF_K + k * PARAMETERS for k in (1, 2, 3))
COLUMNS = 4 * WIDE

_admissible, _derived_points = inner(admissible), inner(derived_points)
_as_branch = contract.naming("Branch", _NAMES)


@inner
def _write(row, branch, numbers, below, above):
    """Write a branch; return the place of its derivatives."""
    line = past(row, branch * WIDE)
    for k in range(WIDE):
        line[k] = numbers[k] if k < 8 else 0.0
    line[8], line[9] = below, above
    return past(line, _OF_K)


@njit(**contract.OPTIONS, cache=True)
def fill(given, array):
    """Write the row of the seven parameters."""
    values, row, far = start(given), start(array), math.inf
    k0, kc, dsigma, eps_a = values[0], values[1], values[2], values[3]
    eps_c, plus, minus = values[4], values[5], values[6]
    if not _admissible(k0, kc, dsigma, eps_a, eps_c, plus, minus):
        return False
    points = _derived_points(k0, kc, dsigma, eps_a, eps_c, plus, minus)
    sigma_a, sigma_c, star, hat_a, hat_c = points
    at_c1, at_a2 = sigma_a + plus * (hat_c - eps_a), -far
    if hat_a > -far:  # a flat branch without rounding
        at_a2 = sigma_c if minus == 0.0 else k0 * hat_a / (1.0 - hat_a)
    v, stiff = 1.0 - eps_a, kc + sigma_c
    by_k0, by_eps_a, share = eps_a / v, k0 / (v * v), kc / (stiff * stiff)  # of σ_a; of ε_*
    by = _write(row, A, (1.0, k0, 0.0, 0.0, -far, sigma_a, -far, eps_a), A, D)
    by[0] = 1.0
    by = _write(row, D, (0.0, plus, eps_a, sigma_a, sigma_a, at_c1, eps_a, hat_c), A, C)
    of_x0, of_s0 = past(by, PARAMETERS), past(by, 2 * PARAMETERS)
    by[5] = of_x0[3] = 1.0
    of_s0[0], of_s0[3] = by_k0, by_eps_a
    by = _write(row, C, (1.0, kc, star, 0.0, sigma_c, far, eps_c, far), E, C)
    of_x0 = past(by, PARAMETERS)  # ε_* = ε_c - σ̄_c/(k_c + σ̄_c)
    by[1] = of_x0[4] = 1.0
    of_x0[0], of_x0[2], of_x0[3] = -share * by_k0, -share, -share * by_eps_a
    of_x0[1] = sigma_c / (stiff * stiff)
    by = _write(row, E, (0.0, minus, eps_c, sigma_c, at_a2, sigma_c, hat_a, eps_c), A, C)
    of_x0, of_s0 = past(by, PARAMETERS), past(by, 2 * PARAMETERS)
    by[6] = of_x0[4] = of_s0[2] = 1.0
    of_s0[0], of_s0[3] = by_k0, by_eps_a
    return True


@njit(**contract.OPTIONS, cache=True)
def _fill_linear(opens, given, array):
    """Write the row of a linear spring, which may open instead of carrying tension."""
    row, k0, far = start(array), given[0], math.inf
    low = 0.0 if opens else -far
    for branch in range(4):
        by = _write(row, branch, (0.0, k0, 0.0, 0.0, low, far, low, far), OPEN, LINE)
        by[0] = 1.0
    if opens:
        _write(row, OPEN, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -far, 0.0), OPEN, LINE)
    return 0.0 < k0 < far


@inner
def _branch_of(row, branch):
    """Return a branch of the table."""
    return _as_branch(past(row, int(branch) * WIDE))


@contract.evaluating
def evaluate(row, s, eps, x, count, want, out):
    line = _branch_of(row, s.branch)
    sigma, slope = past(out, OF_LAW * count), past(out, SLOPE * count)
    factor = past(out, MISS * count)  # of the derivative by k; an explicit law has no miss
    k, origin, offset = line.k, line.x0, line.s0
    if line.curved > 0.0:
        for j in range(count):
            r = eps[j] - origin
            q = 1.0 / (1.0 - r)
            sigma[j] = k * r * q if r < 1.0 else math.inf
            slope[j], factor[j] = k * q * q, r * q
    else:
        for j in range(count):
            r = eps[j] - origin
            sigma[j], slope[j], factor[j] = offset + k * r, k, r
    if want:
        for c in range(PARAMETERS):
            by, of_k = past(out, (BY + c) * count), line[_OF_K + c]
            of_x0, of_s0 = line[_OF_X0 + c], line[_OF_S0 + c]
            for j in range(count):
                by[j] = of_k * factor[j] - of_x0 * slope[j] + of_s0
    return 0.0


@inner
def _enter(row, s, branch):
    """Enter a branch."""
    line, s.branch = _branch_of(row, branch), branch
    s.low, s.high, s.sigma_low, s.sigma_high = line.low, line.high, line.sigma_low, line.sigma_high


@contract.switching
def switch(row, s, up, out):
    line = _branch_of(row, s.branch)
    s.eps = s.high if up else s.low
    _enter(row, s, line.above if up else line.below)
    return 0.0


@contract.beginning
def begin(row, s):
    s.turns = 0.0
    _enter(row, s, 0.0)
    return 0.0


@contract.inverting
def strain(row, s, sigma):
    line = _branch_of(row, s.branch)
    k = line.k
    if line.curved > 0.0:
        if not sigma > -k:
            s.soft = 0.0
            return -math.inf
        per = 1.0 / (k + sigma)
        s.soft = k * per * per
        return line.x0 + sigma * per
    if k > 0.0:
        s.soft = 1.0 / k
        return line.x0 + (sigma - line.s0) / k
    s.soft = math.inf  # a flat branch, or out of contact
    return s.high if s.low == -math.inf and sigma >= 0.0 else s.low


_FUNCTIONS = (begin, evaluate, switch, contract.settle, strain)
_SLOPES = tuple(branch * WIDE + _NAMES.index("k") for branch in (A, C, D))
_STAR = C * WIDE + _NAMES.index("x0")
COMPILED, LINEAR, UNILATERAL = (
    Compiled(given, contract.EXPLICIT, COLUMNS, PARAMETERS, 0, _FUNCTIONS, slopes, pole)
    for given, slopes, pole in (
        (fill, _SLOPES, _STAR),
        (partial(_fill_linear, False), _SLOPES[:1], -1),
        (partial(_fill_linear, True), _SLOPES[:1], -1),
    )
)
