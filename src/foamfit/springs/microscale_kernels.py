"""The compiled microscale law: the response of one spring along a history, and its derivatives.

With p the snapped fraction of micro-springs and P its largest value so far (docs/theory.md),

    ε = (1-P) a(σ; k0) + (P-p) a(σ; k0 e^-d) + p (eps_star + σ/(kc+σ)),
    a(σ; k) = 1 - (1 + nσ/k)^(-1/n).

The memory of a spring consists of two ranks w and W as standard normal scores, p = Φ(w) and
P = Φ(W), so that Φ is never inverted and 1 - p = Φ(-w) keeps all its digits. On first loading
w = W = u₊ = (ln σ - ln sigma_plus)/spread_plus. Micro-springs that have snapped before snap through
again at w = u₊ + s/spread_plus up to W; then p is held until u₊ = W, where first loading continues.
They snap back at w = u₋. Without softening, weakening and stiffening W has no effect and is not
stored: P = 0.

Stress and strain grow together along any history, so a branch ends at a strain as well as at a
stress, and a history is followed from one end of a branch to the next.
"""

from __future__ import annotations

import math

import numpy as np

from foamfit.springs.kernels import (
    AGAIN,
    BACK,
    BOTH,
    EPS_STAR,
    HELD,
    K0,
    K_SNAPPED,
    KC,
    LOG_AGAIN,
    LOG_CROSS,
    LOG_MINUS,
    LOG_PLUS,
    REMEMBERS,
    SNAP,
    SPREAD_MINUS,
    SPREAD_PLUS,
    STIFFENING,
    A,
    Array,
    Branches,
    Row,
    compiled,
    inlined,
    inner,
)
from foamfit.springs.law import LEAST_RANK

# The state: strain, stress, branch, rank w, p, 1 - p; strains and stresses at its branch's ends;
# dε/dσ and d²ε/dσ² where the stress was last computed; rank W, 1 - P, and the strain below which no
# micro-spring snaps.
EPS, SIGMA, BRANCH, RANK, SNAPPED, REST, LOW, HIGH, SIGMA_LOW, SIGMA_HIGH = range(10)
FLEXIBILITY, CURVATURE, EVER, NEVER, LEAST_AT, STATE = range(10, 16)
# Derivatives by k0 … spread_minus, by (the logarithm of) the strain, and by stiffening, softening
# and weakening if the spring remembers: CARRIED in total, or PLAIN_CARRIED if it does not.
OF_STRAIN, OF_STIFFENING, OF_SOFTENING, OF_WEAKENING, CARRIED, PLAIN_CARRIED = 7, 8, 9, 10, 11, 8
# Relative step of Halley's method, per width of the snap, below which the step is the last: the
# remaining error is about its cube.
NEAR = 3e-6
ROUNDED = 1e-8  # largest correction of a share that rounding errors can explain
LEAST = 2.0**-1022  # least stress of a search: the least normal number
_ROOT_HALF, _ROOT_TURN = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)


@inner
def shares(rank: float) -> tuple[float, float]:
    """Return Φ and 1 - Φ, the shares below and above a rank; the smaller one has all digits."""
    least = 0.5 * math.erfc(_ROOT_HALF * abs(rank))
    return (1.0 - least, least) if rank > 0.0 else (least, 1.0 - least)


@inner
def density(rank: float) -> float:
    """Return Φ', the density of ranks."""
    return _ROOT_TURN * math.exp(-0.5 * rank * rank)


# ---------------------------------------------------------------- the elastic branches


@inlined
def _root(n: float, x: float) -> tuple[float, float]:
    """Return a = 1 - (1 + nx)^(-1/n), and -ln(1 - a); avoid the slower `log1p` if possible."""
    y = 1.0 + n * x
    if y > 1.25:
        log = math.log(y) / n
        return 1.0 - math.exp(-log), log
    log = math.log1p(n * x) / n
    return -math.expm1(-log), log


@inlined
def on_a(n: float, k: float, sigma: float) -> tuple[float, float, float]:
    """Return strain a(σ; k) of the stiffening branch (-inf past its pole) and two derivatives."""
    if n == 1.0:
        one = 1.0 / (k + sigma)
        slope = k * one * one
        return (sigma * one, slope, -2.0 * slope * one) if sigma > -k else (-math.inf, 0.0, 0.0)
    above = k + n * sigma
    if not above > 0.0:
        return -math.inf, 0.0, 0.0
    strain, log = _root(n, sigma / k)
    per = 1.0 / above
    slope = (1.0 - strain if strain < 0.9 else math.exp(-log)) * per
    return strain, slope, -(1.0 + n) * slope * per


@inner
def stress_on_a(n: float, k: float, eps: float) -> float:
    """Return the stress at a strain of branch a; infinite from its end on."""
    if not eps < 1.0:
        return math.inf
    return k * eps / (1.0 - eps) if n == 1.0 else k * math.expm1(-n * math.log1p(-eps)) / n


@inlined
def changes_on_a(n: float, k: float, sigma: float) -> tuple[float, float, float]:
    """Return the strain a(σ; k) and its derivatives by σ and n; σ must be above the pole."""
    strain, log = _root(n, sigma / k)
    left, per = 1.0 - strain if strain < 0.9 else math.exp(-log), 1.0 / (k + n * sigma)
    return strain, left * per, left * (sigma * per - log) / n


# ---------------------------------------------------------------- the branches of the spring


@inner
def line(row: Row, branch: int) -> tuple[float, float]:
    """Return mean and standard deviation of the normal distribution of ln σ on a branch."""
    if branch == BACK:
        return row[LOG_MINUS], row[SPREAD_MINUS]
    return row[LOG_PLUS] if branch == SNAP else row[LOG_AGAIN], row[SPREAD_PLUS]


@inner
def moves(branch: int) -> bool:
    """Whether micro-springs snap or snap back on a branch."""
    return branch != A and branch != HELD


@inlined
def mixture(
    row: Row, branch: int, p: float, rest: float, never: float, sigma: float
) -> tuple[float, float, float, float, float]:
    """Return the strain at a stress, given p, 1 - p and 1 - P, and two derivatives at fixed p, P.

    The last two values are strain and slope of the branch a that snaps.
    """
    n, k = row[STIFFENING], row[K_SNAPPED]
    two = 1.0 / (row[KC] + sigma)
    on_c = row[KC] * two * two
    if branch == SNAP or never == 1.0:  # nothing on branch a has ever snapped
        k, never = row[K0], 0.0
    one, slope, bend = on_a(n, k, sigma)
    strain = rest * one + p * (row[EPS_STAR] + sigma * two)
    soft, bent = rest * slope + p * on_c, rest * bend - 2.0 * p * on_c * two
    if never > 0.0 and k != row[K0]:
        fresh, stiff, stiffer = on_a(n, row[K0], sigma)
        strain += never * (fresh - one)
        soft += never * (stiff - slope)
        bent += never * (stiffer - bend)
    return strain, soft, bent, one, slope


@inlined
def at_stress(row: Row, state: Array, sigma: float) -> float:
    """Return the strain at a stress on the current branch; fill dε/dσ and d²ε/dσ²."""
    branch = int(state[BRANCH])
    if not moves(branch):
        p, rest = state[SNAPPED], state[REST]
        strain, slope, bend, _, _ = mixture(row, branch, p, rest, state[NEVER], sigma)
        state[FLEXIBILITY], state[CURVATURE] = slope, bend
        return strain
    if not sigma > 0.0:
        return -math.inf
    place, scale = line(row, branch)
    rank = (math.log(sigma) - place) / scale
    p, rest = shares(rank)
    strain, slope, bend, one, on_one = mixture(row, branch, p, rest, state[NEVER], sigma)
    two = 1.0 / (row[KC] + sigma)
    gap, rate = row[EPS_STAR] + sigma * two - one, density(rank) / (scale * sigma)
    bend += 2.0 * rate * (row[KC] * two * two - on_one)
    bend -= rate * gap * (rank / scale + 1.0) / sigma
    state[FLEXIBILITY], state[CURVATURE] = slope + rate * gap, bend
    return strain


@inner
def _ends_of_stress(row: Row, state: Array, eps: float) -> tuple[float, float]:
    """Return bounds of the stress at a strain, from the stiffest and the softest branch."""
    n, star, stiff = row[STIFFENING], row[EPS_STAR], stress_on_a(row[STIFFENING], row[K0], eps)
    if eps < 0.0 or (not moves(int(state[BRANCH])) and state[SNAPPED] == 0.0):
        soft = stress_on_a(n, row[K_SNAPPED], eps)
        low, high = min(stiff, soft), max(stiff, soft)
    else:
        low, high = 0.0, stiff
        if eps > star:
            low = row[KC] * (eps - star) / (1.0 - (eps - star))
    wide = 1e-14
    return low - wide * abs(low), high + wide * abs(high)


@inner
def held_stress(row: Row, p: float, rest: float, eps: float) -> float:
    """Return the stress at a strain for fixed p without memory: the root of a quadratic."""
    k0, kc, beyond = row[K0], row[KC], eps - p * row[EPS_STAR]
    a, product = 1.0 - beyond, beyond * k0 * kc
    if not a > 0.0:
        return math.inf
    b = rest * kc + p * k0 - beyond * (k0 + kc)
    root = math.sqrt(b * b + 4.0 * a * product)
    return 2.0 * product / (b + root) if b >= 0.0 else (root - b) / (2.0 * a)


@inner
def stress_in(row: Row, state: Array, eps: float) -> float:
    """Return the stress at a strain on the current branch; infinite past its end.

    The method is Halley's inside a bracket, from a parabola at the previous point.
    """
    branch = int(state[BRANCH])
    if branch == HELD and row[REMEMBERS] == 0.0:
        return held_stress(row, state[SNAPPED], state[REST], eps)
    reach = 1.0 + (row[EPS_STAR] if moves(branch) or state[SNAPPED] > 0.0 else 0.0)
    if not eps < reach:
        return math.inf
    if branch == A and (state[NEVER] == 1.0 or eps == 0.0):
        return stress_on_a(row[STIFFENING], row[K0], eps)
    sigma, slope, low, high = state[SIGMA], state[FLEXIBILITY], -math.inf, math.inf
    bounded = not slope > 0.0
    if bounded:
        low, high = _ends_of_stress(row, state, eps)
        if not low < sigma < high:
            sigma = _inside(row, low, high)
    else:
        step = (eps - state[EPS]) / slope
        sigma += step * (1.0 - 0.5 * step * state[CURVATURE] / slope)
    narrow = min(row[SPREAD_PLUS], row[SPREAD_MINUS], 1.0) if moves(branch) else 1.0
    for _ in range(300):
        miss = at_stress(row, state, sigma) - eps
        slope, bend = state[FLEXIBILITY], state[CURVATURE]
        step = miss / slope
        part = 1.0 - 0.5 * step * bend / slope
        if 0.5 < part < 2.0:
            step /= part
        new = sigma - step
        if abs(step) <= NEAR * abs(sigma) * narrow and low <= new <= high:
            state[FLEXIBILITY] += bend * (new - sigma)
            return new
        if not bounded:  # the initial guess did not suffice
            low, high = _ends_of_stress(row, state, eps)
            bounded = True
            if not low < sigma < high:
                sigma = _inside(row, low, high)
                continue
        if miss > 0.0:
            high = sigma
        else:
            low = sigma
        if not low < new < high:
            new = _halfway(low, high, sigma)
            if not low < new < high:  # neighbouring floating-point numbers
                return sigma
        sigma = new
    return sigma


@inner
def _inside(row: Row, low: float, high: float) -> float:
    """Return a stress between two bounds, the upper of which may be infinite."""
    return 0.5 * (low + high) if high < math.inf else max(2.0 * low, row[K0])


@inner
def _halfway(low: float, high: float, sigma: float) -> float:
    """Return a stress between two bounds, halfway in the logarithm if possible."""
    if high == math.inf:
        return 2.0 * max(sigma, LEAST)
    if low > 0.0:
        return math.sqrt(low) * math.sqrt(high)
    if low == 0.0:
        return 1e-3 * high if high > 1e6 * LEAST else 0.5 * high
    return 0.5 * (low + high)


# ---------------------------------------------------------------- from branch to branch


@inner
def begin(row: Row, state: Array, least: float) -> None:
    """Set the state of a virgin spring in which nothing snaps below the strain `least`."""
    state[:] = 0.0
    state[RANK], state[EVER], state[REST], state[NEVER] = -math.inf, -math.inf, 1.0, 1.0
    state[LEAST_AT] = least
    _enter(row, state, A)


@inner
def _ends(row: Row, state: Array, end: int, sigma: float) -> None:
    """Set the upper (HIGH) or lower (LOW) end of the branch to a stress."""
    kept = state[FLEXIBILITY], state[CURVATURE]
    eps = at_stress(row, state, sigma)
    state[FLEXIBILITY], state[CURVATURE] = kept
    if (end == HIGH and eps < state[EPS]) or (end == LOW and eps > state[EPS]):
        eps, sigma = state[EPS], state[SIGMA]
    state[end], state[end + SIGMA_LOW - LOW] = eps, sigma


@inner
def _no_less(row: Row, state: Array, end: int) -> None:
    """Raise the end of a branch to the least strain at which a micro-spring may snap."""
    least = state[LEAST_AT]
    if state[end] < least:
        kept = state[FLEXIBILITY], state[CURVATURE]
        state[end + SIGMA_LOW - LOW], state[end] = stress_in(row, state, least), least
        state[FLEXIBILITY], state[CURVATURE] = kept


@inner
def _has_loop(row: Row, sigma: float, up: bool) -> bool:
    """Whether snap-back lies below snap-through just above (`up`) or just below a stress."""
    below = row[SPREAD_MINUS] >= row[SPREAD_PLUS]
    log = math.log(sigma)
    if below:
        return log < row[LOG_CROSS] if up else log <= row[LOG_CROSS]
    return log >= row[LOG_CROSS] if up else log > row[LOG_CROSS]


@inner
def _last_stress(row: Row) -> float:
    """Return the stress at which the last micro-spring has snapped back."""
    through = row[LOG_AGAIN] + row[SPREAD_PLUS] * LEAST_RANK
    return math.exp(min(through, row[LOG_MINUS] + row[SPREAD_MINUS] * LEAST_RANK))


@inner
def _enter(row: Row, state: Array, branch: int) -> None:
    """Enter a branch at the current strain and stress."""
    state[BRANCH], state[FLEXIBILITY] = branch, 0.0
    state[LOW], state[SIGMA_LOW] = -math.inf, -math.inf
    state[HIGH], state[SIGMA_HIGH] = math.inf, math.inf
    below, cross = row[SPREAD_MINUS] >= row[SPREAD_PLUS], math.exp(row[LOG_CROSS])
    if branch == A:
        state[RANK], state[SNAPPED], state[REST] = -math.inf, 0.0, 1.0
        first = row[LOG_PLUS] if state[NEVER] == 1.0 else row[LOG_AGAIN]
        _ends(row, state, HIGH, math.exp(first + row[SPREAD_PLUS] * LEAST_RANK))
        if state[HIGH] < state[LEAST_AT]:
            state[BRANCH] = SNAP if state[NEVER] == 1.0 else AGAIN
            _no_less(row, state, HIGH)
            state[BRANCH] = A
        return
    if branch != BACK and (branch != SNAP or row[REMEMBERS] == 0.0):
        high = math.inf
        if row[REMEMBERS] > 0.0:
            high = math.exp(row[LOG_AGAIN] + row[SPREAD_PLUS] * state[EVER])
        if (branch != BOTH) == below:  # the other branch begins where both laws of snapping meet
            high = min(high, cross)
        if high < math.inf:
            _ends(row, state, HIGH, high)
    if branch in (BOTH, BACK):
        last = _last_stress(row)
        _ends(row, state, LOW, max(last, cross) if (branch == BOTH) == below else last)
        _no_less(row, state, LOW)


@inner
def _hold(row: Row, state: Array, rank: float) -> None:
    """Hold the current rank.

    In a narrow snap the last digit of the stress covers many ranks, so the snapped share is
    corrected to match the strain.
    """
    (p, rest), sigma, never = shares(rank), state[SIGMA], state[NEVER]
    eps, _, _, on_main, _ = mixture(row, HELD, p, rest, never, sigma)
    more = (state[EPS] - eps) / (row[EPS_STAR] + sigma / (row[KC] + sigma) - on_main)
    if abs(more) < min(ROUNDED, p, rest):
        p, rest = p + more, rest - more
    state[BRANCH], state[RANK], state[SNAPPED], state[REST] = HELD, rank, p, rest
    state[FLEXIBILITY] = 0.0
    first = row[LOG_PLUS] if rank >= state[EVER] else row[LOG_AGAIN]
    back = row[LOG_MINUS] + row[SPREAD_MINUS] * rank
    again = row[LOG_AGAIN] + row[SPREAD_PLUS] * rank
    _ends(row, state, HIGH, max(math.exp(first + row[SPREAD_PLUS] * rank), state[SIGMA]))
    _ends(row, state, LOW, min(math.exp(min(back, again)), state[SIGMA]))


@inner
def turned(state: Array, up: bool) -> bool:
    """Whether the motion of a spring that snaps or snaps back has reversed."""
    branch = state[BRANCH]
    return branch == BACK if up else branch in (SNAP, AGAIN)


@inner
def leaves(state: Array, eps: float) -> bool:
    """Whether a spring leaves its branch before it reaches a strain."""
    up = eps > state[EPS]
    if eps == state[EPS]:
        return False
    return turned(state, up) or (eps > state[HIGH] if up else eps < state[LOW])


@inner
def _snap(row: Row, state: Array) -> None:
    """Enter the branch of snap-through, on first loading or again."""
    if row[REMEMBERS] > 0.0 and (state[RANK] >= state[EVER] or state[NEVER] == 1.0):
        _enter(row, state, SNAP)
    elif _has_loop(row, state[SIGMA], True):
        _enter(row, state, AGAIN if row[REMEMBERS] > 0.0 else SNAP)
    else:
        _enter(row, state, BOTH)


@inner
def switch(row: Row, state: Array, up: bool) -> None:
    """Change to the next branch, at the end of a branch or where the strain reverses."""
    branch, remembers = int(state[BRANCH]), row[REMEMBERS] > 0.0
    if turned(state, up):
        rank = rank_now(row, state)
        if branch == SNAP and remembers:
            state[EVER], state[NEVER] = rank, shares(rank)[1]
        _hold(row, state, rank)
        if not up and row[LOG_AGAIN] == row[LOG_PLUS] and not _has_loop(row, state[SIGMA], False):
            _enter(row, state, BOTH)
        return
    end = HIGH if up else LOW
    state[EPS], state[SIGMA] = state[end], state[end + SIGMA_LOW - LOW]
    sigma = state[SIGMA]
    if branch == A or (branch == HELD and up):
        _snap(row, state)
    elif branch == HELD:
        _enter(row, state, BACK if _has_loop(row, sigma, False) else BOTH)
    elif up:
        log = row[LOG_AGAIN] + row[SPREAD_PLUS] * state[EVER]
        if not remembers:
            _enter(row, state, SNAP if branch == BOTH else BOTH)
        elif math.log(sigma) < log - 1e-14 * max(abs(log), 1.0):
            _enter(row, state, AGAIN if branch == BOTH else BOTH)
        else:  # all micro-springs that ever snapped have snapped again
            state[RANK] = state[EVER]
            if row[LOG_AGAIN] == row[LOG_PLUS]:
                _enter(row, state, SNAP)
            else:
                _hold(row, state, state[EVER])
    elif sigma <= _last_stress(row) or state[EPS] <= state[LEAST_AT]:
        _enter(row, state, A)
    else:
        _enter(row, state, BOTH if branch == BACK else BACK)


@inner
def settle(row: Row, state: Array, eps: float) -> None:
    """Bring a spring to a strain on its branch."""
    sigma = stress_in(row, state, eps)
    state[EPS], state[SIGMA] = eps, sigma


@inner
def rank_now(row: Row, state: Array) -> float:
    """Return the rank up to which micro-springs have snapped."""
    branch = int(state[BRANCH])
    if not moves(branch):
        return state[RANK]
    place, scale = line(row, branch)
    return (math.log(state[SIGMA]) - place) / scale


@inner
def ever_now(state: Array, rank: float) -> float:
    """Return the rank up to which micro-springs have ever snapped; `rank` is the current one."""
    return rank if state[BRANCH] == SNAP else state[EVER]


@compiled
def stress_along(row: Row, eps: Array) -> tuple[Array, Array, Branches]:
    """Return stress, ranks w and W (2, n), and branch along a strain history from rest."""
    sigma, rank = np.empty(eps.size), np.empty((2, eps.size))
    branches, state = np.empty(eps.size, np.int64), np.empty(STATE)
    begin(row, state, 0.0)
    for j in range(eps.size):
        while leaves(state, eps[j]):
            switch(row, state, eps[j] > state[EPS])
        settle(row, state, eps[j])
        sigma[j], rank[0, j] = state[SIGMA], rank_now(row, state)
        rank[1, j] = ever_now(state, rank[0, j])
        branches[j] = int(state[BRANCH])
        if not sigma[j] < math.inf:  # past the end of branch c: stop
            sigma[j:] = math.inf
            branches[j:], rank[0, j:], rank[1, j:] = branches[j], rank[0, j], rank[1, j]
            break
    return sigma, rank, branches


# ---------------------------------------------------------------- along a stress


@inner
def rank_at(
    row: Row, rank: float, ever: float, branch: int, sigma: float
) -> tuple[float, float, int]:
    """Return ranks w and W and branch at a stress, from those at the previous stress."""
    remembers = row[REMEMBERS] > 0.0
    first = again = back = -math.inf
    if sigma > 0.0:
        log = math.log(sigma)
        first = (log - row[LOG_PLUS]) / row[SPREAD_PLUS]
        again = (log - row[LOG_AGAIN]) / row[SPREAD_PLUS]
        back = (log - row[LOG_MINUS]) / row[SPREAD_MINUS]
    least = max(first, min(again, ever))
    most = max(least, back)
    if remembers and first > max(ever, LEAST_RANK):  # first loading, also of a virgin spring
        return first, first, SNAP
    if rank < least:
        rank, branch = least, BOTH
        if remembers and least == ever:
            branch = HELD
        elif back > least:
            branch = AGAIN if remembers else SNAP
    elif rank > most:
        rank, branch = most, BACK if back > least else BOTH
    elif least < rank < most or rank == ever:
        branch = HELD
    elif (rank == least and branch == BACK) or (rank == most and branch in (SNAP, AGAIN)):
        branch = HELD  # also at an end of the held branch, if not passed
    if rank < LEAST_RANK:
        rank, branch = -math.inf, A
    return rank, ever, branch


@inner
def strain_under(
    row: Row, branch: int, rank: float, ever: float, sigma: float
) -> tuple[float, float]:
    """Return strain (-inf if the spring cannot carry the tension) and dε/dσ at a stress."""
    p, rest = shares(rank) if branch != A else (0.0, 1.0)
    strain, soft, _, one, _ = mixture(row, branch, p, rest, shares(ever)[1], sigma)
    if moves(branch):
        gap = row[EPS_STAR] + sigma / (row[KC] + sigma) - one
        soft += density(rank) * gap / (line(row, branch)[1] * sigma)
    return strain, soft


@compiled
def strain_along(row: Row, sigma: Array) -> tuple[Array, Array, Branches]:
    """Return strain (-inf: no such tension), ranks (2, n), branch along stresses, from rest."""
    eps, ranks = np.empty(sigma.size), np.empty((2, sigma.size))
    branches, branch, rank, ever = np.empty(sigma.size, np.int64), A, -math.inf, -math.inf
    for j in range(sigma.size):
        rank, ever, branch = rank_at(row, rank, ever, branch, sigma[j])
        eps[j] = strain_under(row, branch, rank, ever, sigma[j])[0]
        branches[j], ranks[0, j], ranks[1, j] = branch, rank, ever
    return eps, ranks, branches


# ---------------------------------------------------------------- derivatives


@inner
def carried(row: Row) -> int:
    """Return the number of derivatives of a spring."""
    return CARRIED if row[REMEMBERS] > 0.0 else PLAIN_CARRIED


@inlined
def strain_tangents(
    row: Row, branch: int, rank: float, ever: float, sigma: float, out: Array
) -> tuple[float, float, float, float]:
    """Fill the derivatives of the strain at fixed stress and ranks.

    Those of w are filled instead for the parameters of the snap stresses. Return the derivatives of
    the strain by stress, w and W, and that of w by the stress; on first loading W = w.
    """
    k0, two = row[K0], 1.0 / (row[KC] + sigma)
    p, rest, weight = 0.0, 1.0, 0.0
    if branch != A:
        p, rest = shares(rank)
        weight = density(rank)
    for c in range(carried(row)):
        out[c] = 0.0
    fresh, worn, by_ever, pace = rest, 0.0, 0.0, 0.0
    if row[REMEMBERS] == 0.0:
        one, slope, _ = on_a(1.0, k0, sigma)
        softer = slope
    else:
        n, never, weight_ever = row[STIFFENING], rest, weight
        if rank != ever:
            never, weight_ever = shares(ever)[1], density(ever)
        if branch != SNAP and never != 1.0:
            fresh = never  # the share on branch a that has never snapped
            worn = max(rest - fresh, 0.0)
        a, slope, by_n = changes_on_a(n, k0, sigma)
        one, softer, by_n_softer = a, slope, by_n
        if branch != SNAP and row[K_SNAPPED] != k0:
            one, softer, by_n_softer = changes_on_a(n, row[K_SNAPPED], sigma)
        if never < 1.0:
            by_ever = weight_ever * (one - a)
        out[OF_STIFFENING] = fresh * by_n + worn * by_n_softer
        out[OF_SOFTENING] = worn * sigma * softer
        if branch in (AGAIN, BOTH):
            out[OF_WEAKENING] = 1.0 / row[SPREAD_PLUS]
    out[0] = -sigma * (fresh * slope + worn * softer) / k0
    out[1], out[2] = -p * sigma * two * two, p
    soft = fresh * slope + worn * softer + p * row[KC] * two * two
    by_rank = weight * (row[EPS_STAR] + sigma * two - one)
    if moves(branch):
        back = branch == BACK
        per_scale, first = 1.0 / row[SPREAD_MINUS if back else SPREAD_PLUS], 5 if back else 3
        pace = per_scale / sigma
        out[first] = -math.exp(-row[LOG_MINUS if back else LOG_PLUS]) * per_scale
        out[first + 1] = -rank * per_scale
    return soft, by_rank, by_ever, pace


@inner
def tangents(
    row: Row,
    branch: int,
    rank: float,
    ever: float,
    sigma: float,
    eps: float,
    d_ranks: Array,
    out: Array,
) -> float:
    """Fill the derivatives of the stress at a strain; return the slope dσ/dε.

    They are by k0 … spread_minus, the logarithm of the strain, stiffening, softening and weakening.
    `d_ranks` (2, CARRIED), those of w and W, is updated if the branch changes the ranks.
    """
    d_rank, d_ever, count = d_ranks[0], d_ranks[1], carried(row)
    soft, by_rank, by_ever, pace = strain_tangents(row, branch, rank, ever, sigma, out)
    slope = 1.0 / (soft + by_rank * pace)
    out[OF_STRAIN] = -eps
    if not moves(branch):
        for c in range(count):
            if branch == A:
                d_rank[c] = 0.0
            elif rank == ever:
                d_rank[c] = d_ever[c]
            out[c] = -slope * (out[c] + by_rank * d_rank[c] + by_ever * d_ever[c])
        return slope
    first = 5 if branch == BACK else 3
    by_middle, by_spread, by_weakening = out[first], out[first + 1], 0.0
    out[first], out[first + 1] = by_rank * by_middle, by_rank * by_spread
    if row[REMEMBERS] > 0.0:
        by_weakening = out[OF_WEAKENING]
        out[OF_WEAKENING] = by_rank * by_weakening
    for c in range(count):
        out[c] = -slope * (out[c] + by_ever * d_ever[c])
        d_rank[c] = pace * out[c]
    d_rank[first] += by_middle
    d_rank[first + 1] += by_spread
    d_rank[OF_WEAKENING] += by_weakening
    if branch == SNAP:
        for c in range(count):
            d_ever[c] = d_rank[c]
    return slope


@compiled
def stress_tangents_along(
    row: Row, eps: Array, sigma: Array, ranks: Array, branches: Branches
) -> tuple[Array, Array]:
    """Return derivatives of the stress (8 or 11, n) along strains, see `tangents`, and slope."""
    count = carried(row)
    out, slope = np.empty((count, eps.size)), np.empty(eps.size)
    now, d_ranks = np.empty(CARRIED), np.zeros((2, CARRIED))
    for j in range(eps.size):
        w, ever, branch = ranks[0, j], ranks[1, j], branches[j]
        slope[j] = tangents(row, branch, w, ever, sigma[j], eps[j], d_ranks, now)
        for c in range(count):
            out[c, j] = now[c]
    return out, slope
