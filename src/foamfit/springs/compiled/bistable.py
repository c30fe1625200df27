"""The compiled functions of the bistable spring (eqs. 1-5) and of the linear ones."""

from __future__ import annotations

import math
from functools import partial

from numba import njit

from foamfit.arrays import Array
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import BY, MISS, OF_LAW, SLOPE, Compiled, inner, past, start
from foamfit.springs.law import admissible, derived_points

# Branches; LINE and OPEN of linear springs. OPEN is that of a unilateral one out of contact.
A, D, C, E, LINE, OPEN = range(6)
# Columns of the row: strains and stresses at A1, C2, A2, C1; then of each branch slope k, origins
# x0 and s0, and their derivatives by the seven parameters. On a and c σ = k x/(1-x) with
# x = ε - x0, on d and e σ = s0 + k x.
EPS_A, EPS_C, EPS_HAT_A, EPS_HAT_C, TO_STRESS, TABLE, WIDE = 0, 1, 2, 3, 4, 8, 24
COLUMNS = TABLE + 4 * WIDE

_admissible, _derived_points = inner(admissible), inner(derived_points)


@njit(**contract.OPTIONS, cache=True)
def fill(given, array):
    """Write the row of the seven parameters."""
    values, row = start(given), start(array)
    k0, kc, dsigma, eps_a = values[0], values[1], values[2], values[3]
    eps_c, plus, minus = values[4], values[5], values[6]
    if not _admissible(k0, kc, dsigma, eps_a, eps_c, plus, minus):
        return False
    points = _derived_points(k0, kc, dsigma, eps_a, eps_c, plus, minus)
    sigma_a, sigma_c, star, hat_a, hat_c = points
    row[EPS_A], row[EPS_C], row[EPS_HAT_A], row[EPS_HAT_C] = eps_a, eps_c, hat_a, hat_c
    row[TO_STRESS + EPS_A], row[TO_STRESS + EPS_C] = sigma_a, sigma_c
    row[TO_STRESS + EPS_HAT_A] = -math.inf if hat_a == -math.inf else k0 * hat_a / (1.0 - hat_a)
    if minus == 0.0 and hat_a > -math.inf:  # a flat branch, without rounding
        row[TO_STRESS + EPS_HAT_A] = sigma_c
    row[TO_STRESS + EPS_HAT_C] = sigma_a + plus * (hat_c - eps_a)
    for c in range(TABLE, COLUMNS):
        row[c] = 0.0
    v, stiff = 1.0 - eps_a, kc + sigma_c
    by_k0, by_eps_a = eps_a / v, k0 / (v * v)  # of σ_a
    one = TABLE + A * WIDE
    row[one], row[one + 3] = k0, 1.0
    one = TABLE + D * WIDE
    row[one], row[one + 1], row[one + 2] = plus, eps_a, sigma_a
    row[one + 3 + 5], row[one + 10 + 3] = 1.0, 1.0
    row[one + 17], row[one + 17 + 3] = by_k0, by_eps_a
    one = TABLE + C * WIDE
    row[one], row[one + 1], row[one + 3 + 1] = kc, star, 1.0
    share = kc / (stiff * stiff)  # ε_* = ε_c - σ̄_c/(k_c + σ̄_c)
    row[one + 10], row[one + 10 + 2] = -share * by_k0, -share
    row[one + 10 + 1], row[one + 10 + 3] = sigma_c / (stiff * stiff), -share * by_eps_a
    row[one + 10 + 4] = 1.0
    one = TABLE + E * WIDE
    row[one], row[one + 1], row[one + 2] = minus, eps_c, sigma_c
    row[one + 3 + 6], row[one + 10 + 4] = 1.0, 1.0
    row[one + 17], row[one + 17 + 2], row[one + 17 + 3] = by_k0, 1.0, by_eps_a
    return True


@contract.evaluating
def evaluate(row, s, eps, x, count, want, out):
    branch = s.branch
    line = past(row, TABLE + int(branch) * WIDE)
    sigma, slope = past(out, OF_LAW * count), past(out, SLOPE * count)
    factor = past(out, MISS * count)  # of the derivative by k; an explicit law has no miss
    k, origin, offset = line[0], line[1], line[2]
    if branch == A or branch == C:
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
        for c in range(7):
            by, of_k = past(out, (BY + c) * count), line[3 + c]
            of_x0, of_s0 = line[10 + c], line[17 + c]
            for j in range(count):
                by[j] = of_k * factor[j] - of_x0 * slope[j] + of_s0
    return 0.0


@inner
def _enter(row, s, branch):
    """Enter a branch."""
    s.branch = branch
    s.low, s.high, s.sigma_low, s.sigma_high = -math.inf, math.inf, -math.inf, math.inf
    low = EPS_A if branch == D else EPS_C if branch == C else EPS_HAT_A
    high = EPS_HAT_C if branch == D else EPS_C if branch == E else EPS_A
    if branch != A:
        s.low, s.sigma_low = row[low], row[TO_STRESS + low]
    if branch != C:
        s.high, s.sigma_high = row[high], row[TO_STRESS + high]


@contract.switching
def switch(row, s, up, out):
    s.eps = s.high if up else s.low
    if up:
        _enter(row, s, D if s.branch == A else C)
    else:
        _enter(row, s, E if s.branch == C else A)
    return 0.0


@contract.beginning
def begin(row, s):
    s.turns = 0.0
    _enter(row, s, A)
    return 0.0


@contract.settling
def settle(row, s, eps):
    s.eps = eps
    return 0.0


@contract.inverting
def strain(row, s, sigma):
    branch = s.branch
    line = past(row, TABLE + int(branch) * WIDE)
    k, origin = line[0], line[1]
    if branch == A or branch == C:
        if not sigma > -k:
            s.soft = 0.0
            return -math.inf
        per = 1.0 / (k + sigma)
        s.soft = k * per * per
        return origin + sigma * per
    s.soft = 1.0 / k if k > 0.0 else math.inf
    return origin + (sigma - line[2]) / k if k > 0.0 else s.low


_FUNCTIONS = (begin, evaluate, switch, settle, strain)
_SLOPES = (TABLE + A * WIDE, TABLE + C * WIDE, TABLE + D * WIDE)
_STAR = TABLE + C * WIDE + 1
COMPILED = Compiled(fill, contract.EXPLICIT, COLUMNS, 7, 0, _FUNCTIONS, _SLOPES, _STAR)


# ---------------------------------------------------------------- linear springs


def fill_line(opens: float, values: Array, row: Array) -> bool:
    """Write k0, and 1 if the spring carries no tension, else 0."""
    row[0], row[1] = values[0], opens
    return bool(0.0 < values[0] < math.inf)


@contract.evaluating
def evaluate_linear(row, s, eps, x, count, want, out):
    touches = 1.0 if s.branch == LINE else 0.0
    k = touches * row[0]
    for j in range(count):
        out[OF_LAW * count + j], out[SLOPE * count + j] = k * eps[j], k
        out[MISS * count + j], out[BY * count + j] = 0.0, touches * eps[j]
    return 0.0


@inner
def _enter_line(row, s, branch):
    """Enter a branch of a linear spring."""
    s.branch, s.low, s.sigma_low, s.high, s.sigma_high = (
        branch, -math.inf, -math.inf, math.inf, math.inf,
    )  # fmt: skip
    if branch == OPEN:
        s.high, s.sigma_high, s.sigma_low = 0.0, 0.0, 0.0
    elif row[1] > 0.0:
        s.low, s.sigma_low = 0.0, 0.0


@contract.switching
def switch_linear(row, s, up, out):
    s.eps = 0.0
    _enter_line(row, s, LINE if up else OPEN)
    return 0.0


@contract.beginning
def begin_linear(row, s):
    s.turns = 0.0
    _enter_line(row, s, LINE)
    return 0.0


@contract.inverting
def strain_linear(row, s, sigma):
    if s.branch == OPEN:
        s.soft = math.inf
        return 0.0 if sigma >= 0.0 else -math.inf
    s.soft = 1.0 / row[0]
    return sigma / row[0]


_LINE = (begin_linear, evaluate_linear, switch_linear, settle, strain_linear)
LINEAR = Compiled(partial(fill_line, 0.0), contract.EXPLICIT, 2, 1, 0, _LINE, (0,))
UNILATERAL = Compiled(partial(fill_line, 1.0), contract.EXPLICIT, 2, 1, 0, _LINE, (0,))
