"""The microscale spring as a law of the stepper; its internal variable is the stress.

    ε = (1-P) a(σ; k0) + (P-p) a(σ; k0 e^-d) + p (eps_star + σ/(kc+σ)),
    a(σ; k) = 1 - (1 + nσ/k)^(-1/n),     p = Φ(w),  P = Φ(W).

Held numbers are w and W. On SNAP (first loading) w = W = (ln σ - ln sigma_plus)/spread_plus; on
AGAIN (up to W) and BOTH w = (ln σ + s - ln sigma_plus)/spread_plus; on BACK it is that of snap-back.
Without stiffening, softening and weakening W has no effect and is not kept.
"""

import math

import numpy as np
from contract import (
    BRANCH,
    BY,
    CHANGE,
    HELD,
    HIGH,
    LOW,
    MISS,
    OF_HELD,
    OF_LAW,
    OF_PARAMETER,
    OF_STRESS,
    OWN,
    SLOPE,
    TURNS,
    Law,
    beginning,
    evaluating,
    inlined,
    inner,
    past,
    switching,
)  # fmt: skip

NAMES = (
    "k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus",
    "stiffening", "softening", "weakening",
)  # fmt: skip
A, FIXED, SNAP, BACK, BOTH, AGAIN = range(6)
# The row: k0, kc, eps_star, ln sigma_plus, spread_plus, ln sigma_minus, spread_minus, n, then:
N, WORN, LOG_AGAIN, REMEMBERS, LOG_CROSS = range(7, 12)
# Own memory: p, 1-p, P, 1-P of held ranks; stresses at the ends of the branch.
P, REST, EVER, NEVER, SIGMA_LOW, SIGMA_HIGH = range(OWN, OWN + 6)
W, MOST = HELD, HELD + 1
LEAST_RANK = -8.3  # below which no micro-spring counts as snapped
_HALF, _TURN = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)


def fill(k0, kc, star, plus, wide_plus, minus, wide_minus, n=1.0, softening=0.0, weakening=0.0):
    """Return the row."""
    lp, lm = math.log(plus), math.log(minus)
    again, cross = lp - weakening, 0.0
    if wide_plus == wide_minus:
        cross = math.inf if lm < again else -math.inf
    else:
        cross = again + wide_plus * ((again - lm) / (wide_minus - wide_plus))
    remembers = float(n != 1.0 or softening > 0.0 or weakening > 0.0)
    own = (k0, kc, star, lp, wide_plus, lm, wide_minus, n)
    return np.array([*own, k0 * math.exp(-softening), again, remembers, cross])


@inlined
def shares(rank):
    """Return Φ and 1 - Φ."""
    least = 0.5 * math.erfc(_HALF * abs(rank))
    return (1.0 - least, least) if rank > 0.0 else (least, 1.0 - least)


@inlined
def on_a(n, k, sigma):
    """Return a(σ; k), and its derivatives by σ and n."""
    if n == 1.0:
        one = 1.0 / (k + sigma)
        return sigma * one, k * one * one, 0.0
    log = math.log1p(n * sigma / k) / n
    left, per = math.exp(-log), 1.0 / (k + n * sigma)
    return -math.expm1(-log), left * per, left * (sigma * per - log) / n


@inner
def strain(row, memory, branch, sigma):
    """Return the strain at a stress on a branch."""
    p, rest, never = memory[P], memory[REST], memory[NEVER]
    if branch > FIXED:
        back = branch == BACK
        place = row[5] if back else (row[3] if branch == SNAP else row[LOG_AGAIN])
        p, rest = shares((math.log(sigma) - place) / row[6 if back else 4])
    if branch == SNAP:
        never = rest
    out = p * (row[2] + sigma / (row[1] + sigma))
    if row[WORN] == row[0]:
        return out + rest * on_a(row[N], row[0], sigma)[0]
    fresh = min(never, rest)
    out += fresh * on_a(row[N], row[0], sigma)[0]
    return out + (rest - fresh) * on_a(row[N], row[WORN], sigma)[0]


@evaluating
def evaluate(row, memory, eps, x, count, want, out):
    branch = memory[BRANCH]
    k0, kc, star, n, remembers = row[0], row[1], row[2], row[N], row[REMEMBERS] > 0.0
    p, rest, never, rank, pace, weight = memory[P], memory[REST], memory[NEVER], 0.0, 0.0, 0.0
    moves, first = branch > FIXED, 5 if branch == BACK else 3
    place = row[LOG_AGAIN] if branch >= BOTH else row[first]
    wide, through = 1.0 / row[first + 1], 0.0
    by_median = math.exp(-row[first]) if want and moves else 0.0
    # shares on branch a of what never and what once snapped
    mixed = remembers and branch != SNAP and never < 1.0
    softened = mixed and row[WORN] != k0
    on_most = 0.0
    if want and mixed:
        on_most = _TURN * math.exp(-0.5 * memory[MOST] * memory[MOST])
    if want and not moves and p > 0.0:
        weight = _TURN * math.exp(-0.5 * memory[W] * memory[W])
    for j in range(count):
        sigma = x[j]
        if moves:
            rank = (math.log(sigma) - place) * wide
            p, rest = shares(rank)
            weight, pace = _TURN * math.exp(-0.5 * rank * rank), wide / sigma
        two = 1.0 / (kc + sigma)
        fresh, worn = rest, 0.0
        if mixed:
            fresh = min(never, rest)
            worn = rest - fresh
        main, soft, by_n = on_a(n, k0, sigma)
        one, slope_one, by_n_one = main, soft, by_n
        if softened:
            one, slope_one, by_n_one = on_a(n, row[WORN], sigma)
        softness = fresh * soft + worn * slope_one
        on_c = star + sigma * two
        by_rank = weight * (on_c - one)
        slope = 1.0 / (softness + p * kc * two * two + by_rank * pace)
        out[OF_LAW * count + j], out[SLOPE * count + j] = sigma, slope
        out[MISS * count + j] = fresh * main + worn * one + p * on_c - eps[j]
        if want == 0:
            continue
        by = past(out, BY * count + j)
        by[0] = slope * sigma * softness / k0
        by[count], by[2 * count] = slope * p * sigma * two * two, -slope * p
        for c in range(3, 12):
            by[c * count] = 0.0
        if moves:
            through = slope * by_rank * wide
            by[first * count], by[(first + 1) * count] = through * by_median, through * rank
            if branch >= BOTH:
                by[9 * count] = -through
        else:
            by[10 * count] = -slope * by_rank
        if remembers:
            by[7 * count] = -slope * (fresh * by_n + worn * by_n_one)
            by[8 * count] = -slope * worn * sigma * slope_one
            by[11 * count] = -slope * on_most * (one - main)
    return 0.0


@inner
def end(row, memory, which, eps, x, sigma):
    """Set an end of the branch to a stress, but not behind the present point."""
    at = strain(row, memory, memory[BRANCH], sigma)
    if (which == HIGH and at < eps) or (which == LOW and at > eps):
        at, sigma = eps, x
    memory[which], memory[which + SIGMA_LOW - LOW] = at, sigma


@inner
def loops(row, sigma, up):
    """Whether snap-back lies below snap-through just above (`up`) or below a stress."""
    log = math.log(sigma)
    if row[6] >= row[4]:
        return log < row[LOG_CROSS] if up else log <= row[LOG_CROSS]
    return log >= row[LOG_CROSS] if up else log > row[LOG_CROSS]


@inner
def enter(row, memory, branch, eps, x):
    """Enter a branch on which ranks change, or A."""
    memory[BRANCH], memory[TURNS] = branch, 0.0
    memory[LOW], memory[SIGMA_LOW], memory[HIGH], memory[SIGMA_HIGH] = (
        -math.inf, -math.inf, math.inf, math.inf,
    )  # fmt: skip
    remembers, below, cross = row[REMEMBERS] > 0.0, row[6] >= row[4], math.exp(row[LOG_CROSS])
    if branch == A:
        memory[W], memory[P], memory[REST] = -math.inf, 0.0, 1.0
        first = row[3] if memory[NEVER] == 1.0 else row[LOG_AGAIN]
        end(row, memory, HIGH, eps, x, math.exp(first + row[4] * LEAST_RANK))
        return
    if branch == SNAP or branch == AGAIN:
        memory[TURNS] = 1.0
    elif branch == BACK:
        memory[TURNS] = -1.0
    if branch != BACK and (branch != SNAP or not remembers):
        high = math.exp(row[LOG_AGAIN] + row[4] * memory[MOST]) if remembers else math.inf
        if (branch != BOTH) == below:
            high = min(high, cross)
        if high < math.inf:
            end(row, memory, HIGH, eps, x, high)
    if branch == BOTH or branch == BACK:
        last = math.exp(min(row[LOG_AGAIN] + row[4] * LEAST_RANK, row[5] + row[6] * LEAST_RANK))
        end(row, memory, LOW, eps, x, max(last, cross) if (branch == BOTH) == below else last)


@inner
def hold(row, memory, rank, eps, x):
    """Hold a rank."""
    p, rest = shares(rank)
    memory[BRANCH], memory[TURNS], memory[W], memory[P], memory[REST] = FIXED, 0.0, rank, p, rest
    first = row[3] if rank >= memory[MOST] else row[LOG_AGAIN]
    back = min(row[5] + row[6] * rank, row[LOG_AGAIN] + row[4] * rank)
    end(row, memory, HIGH, eps, x, max(math.exp(first + row[4] * rank), x))
    end(row, memory, LOW, eps, x, min(math.exp(back), x))


@switching
def switch(row, memory, eps, x, up, out):
    branch, remembers = memory[BRANCH], row[REMEMBERS] > 0.0
    for h in range(2):
        for c in range(CHANGE):
            out[h * CHANGE + c] = 0.0
        out[h * CHANGE + OF_HELD + h] = 1.0
    turned = (branch == BACK) if up else (branch == SNAP or branch == AGAIN)
    if turned:
        first = 5 if branch == BACK else 3
        place = row[LOG_AGAIN] if branch == AGAIN else row[first]
        wide = 1.0 / row[first + 1]
        rank = (math.log(x) - place) * wide
        for h in range(2 if branch == SNAP and remembers else 1):
            out[h * CHANGE + OF_HELD + h] = 0.0
            out[h * CHANGE + OF_STRESS] = wide / x
            out[h * CHANGE + OF_PARAMETER + first] = -wide * math.exp(-row[first])
            out[h * CHANGE + OF_PARAMETER + first + 1] = -wide * rank
            if branch == AGAIN:
                out[h * CHANGE + OF_PARAMETER + 9] = wide
        if branch == SNAP and remembers:
            memory[MOST] = rank
            memory[EVER], memory[NEVER] = shares(rank)
        hold(row, memory, rank, eps, x)
        if not up and row[LOG_AGAIN] == row[3] and not loops(row, x, False):
            enter(row, memory, BOTH, eps, x)
        return x
    sigma = memory[SIGMA_HIGH] if up else memory[SIGMA_LOW]
    if branch == A or (branch == FIXED and up):
        if remembers and (memory[W] >= memory[MOST] or memory[NEVER] == 1.0):
            enter(row, memory, SNAP, eps, sigma)
        elif loops(row, sigma, True):
            enter(row, memory, AGAIN if remembers else SNAP, eps, sigma)
        else:
            enter(row, memory, BOTH, eps, sigma)
    elif branch == FIXED:
        enter(row, memory, BACK if loops(row, sigma, False) else BOTH, eps, sigma)
    elif up:
        log = row[LOG_AGAIN] + row[4] * memory[MOST]
        if not remembers:
            enter(row, memory, SNAP if branch == BOTH else BOTH, eps, sigma)
        elif math.log(sigma) < log - 1e-14 * max(abs(log), 1.0):
            enter(row, memory, AGAIN if branch == BOTH else BOTH, eps, sigma)
        elif row[LOG_AGAIN] == row[3]:
            enter(row, memory, SNAP, eps, sigma)
        else:  # all that ever snapped has snapped again
            for c in range(CHANGE):
                out[c] = 0.0
            out[OF_HELD + 1] = 1.0
            hold(row, memory, memory[MOST], eps, sigma)
    elif memory[BRANCH] == BACK or memory[BRANCH] == BOTH:
        last = math.exp(min(row[LOG_AGAIN] + row[4] * LEAST_RANK, row[5] + row[6] * LEAST_RANK))
        if sigma <= last:
            for c in range(CHANGE):
                out[c] = 0.0
            enter(row, memory, A, eps, sigma)
        else:
            enter(row, memory, BOTH if branch == BACK else BACK, eps, sigma)
    return sigma


@beginning
def begin(row, memory):
    memory[W], memory[MOST], memory[EVER], memory[NEVER] = -math.inf, -math.inf, 0.0, 1.0
    enter(row, memory, A, 0.0, 0.0)
    return 0.0


LAW = Law(fill, NAMES, True, (evaluate.address, switch.address, begin.address))
