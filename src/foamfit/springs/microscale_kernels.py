"""The compiled microscale law: one spring followed along a history, and its derivatives.

Its memory is the rank w up to which micro-springs have snapped, in standard normal scores: the
snapped fraction is p = Φ(w). With u₊ = (ln σ - ln sigma_plus)/spread_plus and u₋ likewise (both -∞
in tension), w ← min(max(w, u₊), max(u₊, u₋)). So Φ is never inverted, and 1 - p = Φ(-w) keeps all
its digits. Stress and strain grow together along any history, so that a branch ends at a strain as
well as at a stress: the path of a spring is walked from end to end of its branches.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math

import numpy as np

from foamfit.springs import memory_kernels as memory
from foamfit.springs.kernels import (
    BACK,
    BOTH,
    EPS_STAR,
    HELD,
    K0,
    K_SNAPPED,
    KC,
    KIND,
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
    inner,
)
from foamfit.springs.law import (
    LEAST_RANK,
    MICROSCALE,
    crossing,
    least_eps_star,
    most_beyond,
)
from foamfit.springs.memory_kernels import turned as turned
from foamfit.springs.ranks import (
    BRANCH,
    CARRIED,
    CURVATURE,
    EPS,
    EVER,
    FIRST,
    FLEXIBILITY,
    HIGH,
    LAST,
    LEAST,
    LOW,
    MEET,
    NEAR,
    OF_STRAIN,
    PLAIN_CARRIED,
    RANK,
    REST,
    SIGMA,
    SIGMA_FIRST,
    SIGMA_HIGH,
    SIGMA_LAST,
    SIGMA_LOW,
    SIGMA_MEET,
    SNAPPED,
    STATE,
    density,
    share,
)

_least_eps_star = inner(least_eps_star)
_crossing = inner(crossing)
_most_beyond = inner(most_beyond)


@inner
def _fill_alike(values: Array, row: Row) -> bool:
    """Write k0 … spread_minus of a spring of any ε_*; false if they are not admissible."""
    k0, kc, eps_star = values[0], values[1], values[2]
    spread_plus, spread_minus = values[4], values[6]
    for own in range(7):
        if own != 2 and not 0.0 < values[own] < math.inf:
            return False
    if not 0.0 <= eps_star < math.inf:
        return False
    row[KIND], row[K0], row[KC], row[EPS_STAR] = MICROSCALE, k0, kc, eps_star
    row[LOG_PLUS], row[SPREAD_PLUS] = math.log(values[3]), spread_plus
    row[LOG_MINUS], row[SPREAD_MINUS] = math.log(values[5]), spread_minus
    row[LOG_CROSS] = _crossing(row[LOG_PLUS], spread_plus, row[LOG_MINUS], spread_minus)
    row[REMEMBERS], row[STIFFENING], row[K_SNAPPED], row[LOG_AGAIN] = 0.0, 1.0, k0, row[LOG_PLUS]
    return True


@compiled
def fill_microscale(values: Array, row: Row) -> bool:
    """Write k0 … spread_minus and what follows from them; false if they are not admissible."""
    return _fill_alike(values, row) and row[EPS_STAR] >= _least_eps_star(row[K0], row[KC])


@inner
def _remember(row: Row, stiffening: float, softening: float, weakening: float) -> bool:
    """Write what a spring remembers (model, section 8); false if it is not admissible."""
    if not (0.0 < stiffening < math.inf):
        return False
    if not (0.0 <= softening < math.inf and 0.0 <= weakening < math.inf):
        return False
    row[REMEMBERS], row[STIFFENING] = 1.0, stiffening
    row[K_SNAPPED] = row[K0] * math.exp(-softening)
    row[LOG_AGAIN] = row[LOG_PLUS] - weakening
    cross = _crossing(row[LOG_AGAIN], row[SPREAD_PLUS], row[LOG_MINUS], row[SPREAD_MINUS])
    row[LOG_CROSS] = cross
    if not row[K_SNAPPED] > 0.0:
        return False
    return row[EPS_STAR] >= _most_beyond(row[K_SNAPPED], row[KC], stiffening)[0]


@compiled
def fill_stiffening(values: Array, row: Row) -> bool:
    """Write k0 … spread_minus and stiffening; false if they are not admissible."""
    return _fill_alike(values, row) and _remember(row, values[7], 0.0, 0.0)


@compiled
def fill_mullins(values: Array, row: Row) -> bool:
    """Write k0 … spread_minus, softening and weakening; false if they are not admissible."""
    return _fill_alike(values, row) and _remember(row, 1.0, values[7], values[8])


@compiled
def fill_memory(values: Array, row: Row) -> bool:
    """Write k0 … spread_minus, stiffening, softening and weakening; false if not admissible."""
    return _fill_alike(values, row) and _remember(row, values[7], values[8], values[9])


# ---------------------------------------------------------------- the law


@inner
def strain_of(row: Row, p: float, rest: float, sigma: float) -> float:
    """Strain at which the share p has snapped, and the share `rest` = 1 - p has not."""
    return rest * (sigma / (row[K0] + sigma)) + p * (row[EPS_STAR] + sigma / (row[KC] + sigma))


@inner
def held_stress(row: Row, p: float, rest: float, eps: float) -> float:
    """Stress at which so many have snapped, the inverse of `strain_of`: one root of a quadratic."""
    k0, kc, beyond = row[K0], row[KC], eps - p * row[EPS_STAR]
    a, product = 1.0 - beyond, beyond * k0 * kc
    if not a > 0.0:
        return math.inf
    b = rest * kc + p * k0 - beyond * (k0 + kc)
    root = math.sqrt(b * b + 4.0 * a * product)
    return 2.0 * product / (b + root) if b >= 0.0 else (root - b) / (2.0 * a)


@inner
def _strain_between(row: Row, log: float, spread: float, sigma: float) -> float:
    """Strain at a stress at which rank and stress belong together; see `_along_law`."""
    if sigma == math.inf:
        return 1.0 + row[EPS_STAR]
    if not sigma > 0.0:
        return -math.inf
    rank = (math.log(sigma) - log) / spread
    return strain_of(row, share(rank), share(-rank), sigma)


@inner
def begin(row: Row, state: Array) -> None:
    """Set the state of a spring that never bore anything."""
    if row[REMEMBERS] > 0.0:
        memory.begin(row, state, 0.0)
        return
    state[:] = 0.0
    state[BRANCH], state[RANK], state[REST] = A, -math.inf, 1.0
    plus, minus = row[LOG_PLUS], row[LOG_MINUS]
    state[SIGMA_MEET] = math.exp(row[LOG_CROSS])
    state[MEET] = _strain_between(row, plus, row[SPREAD_PLUS], state[SIGMA_MEET])
    least = plus + row[SPREAD_PLUS] * LEAST_RANK
    state[SIGMA_FIRST] = math.exp(least)
    state[FIRST] = strain_of(row, 0.0, 1.0, state[SIGMA_FIRST])
    state[SIGMA_LAST] = math.exp(min(least, minus + row[SPREAD_MINUS] * LEAST_RANK))
    state[LAST] = strain_of(row, 0.0, 1.0, state[SIGMA_LAST])
    _enter(row, state, A)


@inner
def begin_above(row: Row, state: Array, least: float) -> None:
    """Set the state of a spring that never bore anything, and snaps nothing below a strain."""
    if row[REMEMBERS] > 0.0:
        memory.begin(row, state, least)
        return
    begin(row, state)
    if min(state[FIRST], state[LAST]) >= least:
        return
    plus = _along_law(row, state, least, row[LOG_PLUS], row[SPREAD_PLUS])
    minus = _along_law(row, state, least, row[LOG_MINUS], row[SPREAD_MINUS])
    if state[FIRST] < least:
        state[FIRST], state[SIGMA_FIRST] = least, plus
    if state[LAST] < least:
        state[LAST], state[SIGMA_LAST] = least, min(plus, minus)
    _enter(row, state, A)


@inner
def _hysteretic_below(row: Row) -> bool:
    """Whether snap-back lies below snap-through under the stress at which both meet, or above."""
    return row[SPREAD_MINUS] >= row[SPREAD_PLUS]


@inner
def _enter(row: Row, state: Array, branch: int) -> None:
    """Enter a branch at the strain and stress where the spring is."""
    below = _hysteretic_below(row)
    state[BRANCH] = branch
    state[LOW], state[SIGMA_LOW] = -math.inf, -math.inf
    state[HIGH], state[SIGMA_HIGH] = math.inf, math.inf
    if branch == A:
        state[RANK], state[SNAPPED], state[REST] = -math.inf, 0.0, 1.0
        state[HIGH], state[SIGMA_HIGH] = state[FIRST], state[SIGMA_FIRST]
    elif branch == SNAP:
        if below:
            state[HIGH], state[SIGMA_HIGH] = state[MEET], state[SIGMA_MEET]
    else:
        state[LOW], state[SIGMA_LOW] = state[LAST], state[SIGMA_LAST]
        met = below if branch == BOTH else not below
        if met and state[MEET] > state[LOW]:
            state[LOW], state[SIGMA_LOW] = state[MEET], state[SIGMA_MEET]
        if branch == BOTH and not below:
            state[HIGH], state[SIGMA_HIGH] = state[MEET], state[SIGMA_MEET]
    state[FLEXIBILITY] = 0.0


@inner
def _hold(row: Row, state: Array, up: bool) -> None:
    """Hold the rank that has been reached, where the strain turns (upwards or downwards)."""
    if up:
        rank = (math.log(state[SIGMA]) - row[LOG_MINUS]) / row[SPREAD_MINUS]
    else:
        rank = (math.log(state[SIGMA]) - row[LOG_PLUS]) / row[SPREAD_PLUS]
    p, rest = share(rank), share(-rank)
    state[BRANCH], state[RANK], state[SNAPPED], state[REST] = HELD, rank, p, rest
    state[FLEXIBILITY] = 0.0
    if up:
        state[LOW], state[SIGMA_LOW] = state[EPS], state[SIGMA]
        sigma = math.exp(row[LOG_PLUS] + row[SPREAD_PLUS] * rank)
        state[SIGMA_HIGH] = max(sigma, state[SIGMA])
        state[HIGH] = max(strain_of(row, p, rest, sigma), state[EPS])
    else:
        state[HIGH], state[SIGMA_HIGH] = state[EPS], state[SIGMA]
        sigma = math.exp(row[LOG_MINUS] + row[SPREAD_MINUS] * rank)
        state[SIGMA_LOW] = min(sigma, state[SIGMA])
        state[LOW] = min(strain_of(row, p, rest, sigma), state[EPS])


@inner
def switch(row: Row, state: Array, up: bool) -> None:
    """Go over from the end of a branch, or from where the strain turns, to the next branch."""
    if row[REMEMBERS] > 0.0:
        memory.switch(row, state, up)
        return
    branch = int(state[BRANCH])
    if turned(state, up):
        _hold(row, state, up)
        return
    end = HIGH if up else LOW
    state[EPS], state[SIGMA] = state[end], state[end + SIGMA_LOW - LOW]
    if branch == HELD:
        _enter(row, state, SNAP if up else BACK)
    elif branch == A:
        below = _hysteretic_below(row)
        _enter(row, state, SNAP if (state[SIGMA] < state[SIGMA_MEET]) == below else BOTH)
    elif branch == SNAP:
        _enter(row, state, BOTH)
    elif state[SIGMA] == state[SIGMA_LAST]:
        _enter(row, state, A)
    elif branch == BACK:
        _enter(row, state, BOTH)
    else:
        _enter(row, state, SNAP if up else BACK)


@inner
def stress_in(row: Row, state: Array, eps: float) -> float:
    """Stress at a strain on the branch that the spring is on; infinite if it cannot have any."""
    if row[REMEMBERS] > 0.0:
        return memory.stress_in(row, state, eps)
    branch = int(state[BRANCH])
    if branch == A:
        return row[K0] * eps / (1.0 - eps) if eps < 1.0 else math.inf
    if branch == HELD:
        return held_stress(row, state[SNAPPED], state[REST], eps)
    if branch == BACK:
        return _along_law(row, state, eps, row[LOG_MINUS], row[SPREAD_MINUS])
    return _along_law(row, state, eps, row[LOG_PLUS], row[SPREAD_PLUS])


@inner
def _stress_below(row: Row, eps: float, log: float, spread: float) -> float:
    """Return a stress above 0 below that at a strain above 0, where p = Φ((ln σ - log)/spread).

    Branches a and c take less than half of the strain there, and p eps_star the other half at most:
    at a rank below 0, p is at most exp(-rank²/2)/2.
    """
    bent = 0.5 * min(eps, 1.0) * min(row[K0], row[KC])
    rank = -math.sqrt(2.0 * math.log(max(row[EPS_STAR] / eps, 1.0)))
    return max(min(bent, math.exp(log + spread * rank)), LEAST)


@inner
def _along_law(row: Row, state: Array, eps: float, log: float, spread: float) -> float:
    """Stress at a strain where p = Φ((ln σ - log)/spread), to rounding.

    Halley's method from the parabola through the point before, inside a bracket. The strain lies
    between those of branches a and c.
    """
    k0, kc, star = row[K0], row[KC], row[EPS_STAR]
    if not eps < 1.0 + star:
        return math.inf
    low, high = 0.0, k0 * eps / (1.0 - eps) if eps < 1.0 else math.inf
    high *= 1.0 + 1e-15
    if eps > star:
        low = kc * (eps - star) / (1.0 - (eps - star)) * (1.0 - 1e-15)
    sigma, slope = state[SIGMA], state[FLEXIBILITY]
    if slope > 0.0:
        step = (eps - state[EPS]) / slope
        sigma += step * (1.0 - 0.5 * step * state[CURVATURE] / slope)
    if not low < sigma < high:
        sigma = 0.5 * (low + high) if high < math.inf else max(2.0 * low, k0)
    for _ in range(200):
        rank = (math.log(sigma) - log) / spread
        one, two = 1.0 / (k0 + sigma), 1.0 / (kc + sigma)
        p = share(rank)
        rest = share(-rank) if rank > 0.0 else 1.0 - p
        gap = star + sigma * (two - one)  # of branch c to branch a
        miss = rest * (sigma * one) + p * (star + sigma * two) - eps
        rate = density(rank) / (spread * sigma)
        on_a, on_c = k0 * one * one, kc * two * two
        slope = rest * on_a + p * on_c + rate * gap
        bend = 2.0 * (rate * (on_c - on_a) - rest * on_a * one - p * on_c * two)
        bend -= rate * gap * (rank / spread + 1.0) / sigma
        state[FLEXIBILITY], state[CURVATURE] = slope, bend
        if miss > 0.0:
            high = sigma
        else:
            low = sigma
        step = miss / slope
        share_of = 1.0 - 0.5 * step * bend / slope
        if 0.5 < share_of < 2.0:
            step /= share_of
        new = sigma - step
        if abs(step) <= NEAR * sigma * min(spread, 1.0) and low <= new <= high:
            state[FLEXIBILITY] += bend * (new - sigma)
            return new
        if not low < new < high:
            if low == 0.0:  # halving a stress of any size in its logarithm needs an end above 0
                low = min(_stress_below(row, eps, log, spread), sigma)
            new = math.sqrt(low) * math.sqrt(high) if high < math.inf else 2.0 * sigma
            if not low < new < high:  # neighbouring numbers: nothing lies between them
                return sigma
        sigma = new
    return sigma


@inner
def settle(row: Row, state: Array, eps: float) -> None:
    """Bring a spring to a strain that lies on its branch."""
    sigma = stress_in(row, state, eps)
    state[EPS], state[SIGMA] = eps, sigma


@inner
def fill_slopes(row: Row, state: Array) -> None:
    """Fill dε/dσ and d²ε/dσ² on a branch on which no micro-spring snaps: held, or `a`.

    Those of a spring that remembers come with the stress.
    """
    if row[REMEMBERS] > 0.0:
        return
    one, two = 1.0 / (row[K0] + state[SIGMA]), 1.0 / (row[KC] + state[SIGMA])
    on_a, on_c = state[REST] * row[K0] * one * one, state[SNAPPED] * row[KC] * two * two
    state[FLEXIBILITY], state[CURVATURE] = on_a + on_c, -2.0 * (on_a * one + on_c * two)


@inner
def leaves(state: Array, eps: float) -> bool:
    """Whether a spring leaves its branch before it reaches a strain."""
    up = eps > state[EPS]
    if eps == state[EPS]:
        return False
    return turned(state, up) or (eps > state[HIGH] if up else eps < state[LOW])


@inner
def rank_now(row: Row, state: Array) -> float:
    """The rank up to which micro-springs have snapped."""
    if row[REMEMBERS] > 0.0:
        return memory.rank_now(row, state)
    branch = int(state[BRANCH])
    if branch in (A, HELD):
        return state[RANK]
    if branch == BACK:
        return (math.log(state[SIGMA]) - row[LOG_MINUS]) / row[SPREAD_MINUS]
    return (math.log(state[SIGMA]) - row[LOG_PLUS]) / row[SPREAD_PLUS]


@inner
def ever_now(state: Array, rank: float) -> float:
    """The rank up to which micro-springs have ever snapped, where they have up to `rank` now."""
    return rank if state[BRANCH] == SNAP else state[EVER]


@compiled
def stress_along(row: Row, eps: Array) -> tuple[Array, Array, Branches]:
    """Stress, ranks and branch of one microscale spring along a strain history, from rest.

    The ranks (2, n) are those of what has snapped, and of what has ever snapped.
    """
    sigma, rank = np.empty(eps.size), np.empty((2, eps.size))
    branches, state = np.empty(eps.size, np.int64), np.empty(STATE)
    begin(row, state)
    for j in range(eps.size):
        while leaves(state, eps[j]):
            switch(row, state, eps[j] > state[EPS])
        settle(row, state, eps[j])
        sigma[j], rank[0, j] = state[SIGMA], rank_now(row, state)
        rank[1, j] = ever_now(state, rank[0, j])
        branches[j] = int(state[BRANCH])
        if not sigma[j] < math.inf:  # past the end of branch c: nothing follows
            sigma[j:] = math.inf
            branches[j:], rank[0, j:], rank[1, j:] = branches[j], rank[0, j], rank[1, j]
            break
    return sigma, rank, branches


@inner
def rank_at(
    row: Row, rank: float, ever: float, branch: int, sigma: float
) -> tuple[float, float, int]:
    """Ranks of what has snapped, and has ever, and branch of a spring last seen at other stresses.

    The second rank counts only where the spring remembers.
    """
    if row[REMEMBERS] > 0.0:
        return memory.rank_at(row, rank, ever, branch, sigma)
    plus = minus = -math.inf
    if sigma > 0.0:
        log = math.log(sigma)
        plus = (log - row[LOG_PLUS]) / row[SPREAD_PLUS]
        minus = (log - row[LOG_MINUS]) / row[SPREAD_MINUS]
    most = max(plus, minus)
    if rank < plus:
        rank, branch = plus, SNAP if minus > plus else BOTH
    elif rank > most:
        rank, branch = most, BACK if minus > plus else BOTH
    elif plus < rank < most or branch == (BACK if rank == plus else SNAP):
        branch = HELD  # also at an end of the held stresses that it has not passed
    if rank < LEAST_RANK:
        rank, branch = -math.inf, A
    return rank, ever, branch


@inner
def under_stress(
    row: Row, branch: int, rank: float, ever: float, sigma: float
) -> tuple[float, float, float, float, float]:
    """Strain at a stress, its derivatives by stress and both ranks, and of the rank by the stress.

    The strain is -inf where the spring cannot carry the tension.
    """
    if row[REMEMBERS] > 0.0:
        return memory.under_stress(row, branch, rank, ever, sigma)
    if not sigma > -row[K0]:
        return -math.inf, 0.0, 0.0, 0.0, 0.0
    one = 1.0 / (row[K0] + sigma)
    if branch == A:
        return sigma * one, row[K0] * one * one, 0.0, 0.0, 0.0
    two, p, rest = 1.0 / (row[KC] + sigma), share(rank), share(-rank)
    on_a, on_c = sigma * one, row[EPS_STAR] + sigma * two
    soft = rest * row[K0] * one * one + p * row[KC] * two * two
    pace = 0.0
    if branch != HELD:
        pace = 1.0 / (row[SPREAD_MINUS if branch == BACK else SPREAD_PLUS] * sigma)
    return rest * on_a + p * on_c, soft, density(rank) * (on_c - on_a), 0.0, pace


@compiled
def strain_along(row: Row, sigma: Array) -> tuple[Array, Array, Branches]:
    """Strain, ranks and branch of one microscale spring along a stress history, from rest.

    The ranks (2, n) are those of what has snapped, and of what has ever snapped.
    The strain is -inf where the spring cannot carry the tension.
    """
    eps, ranks = np.empty(sigma.size), np.empty((2, sigma.size))
    branches, branch, rank, ever = np.empty(sigma.size, np.int64), A, -math.inf, -math.inf
    for j in range(sigma.size):
        rank, ever, branch = rank_at(row, rank, ever, branch, sigma[j])
        eps[j] = -math.inf
        if row[REMEMBERS] > 0.0:
            p, rest, never = share(rank), share(-rank), share(-ever)
            eps[j] = memory.mixture(row, branch, p, rest, never, sigma[j])[0]
        elif sigma[j] > -row[K0]:
            eps[j] = strain_of(row, share(rank), share(-rank), sigma[j])
        branches[j], ranks[0, j], ranks[1, j] = branch, rank, ever
    return eps, ranks, branches


# ---------------------------------------------------------------- derivatives


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
    """Fill the derivatives of the stress at a strain; returns the slope dσ/dε.

    They are by k0 … spread_minus, and by the logarithm of the strain; where the spring remembers,
    also by stiffening, softening, weakening. `d_ranks` (2, CARRIED), the same of both ranks, is
    brought up to date where the spring moves.
    """
    d_rank = d_ranks[0]
    if row[REMEMBERS] > 0.0:
        return memory.tangents(row, branch, rank, ever, sigma, eps, d_rank, d_ranks[1], out)
    k0, kc, star = row[K0], row[KC], row[EPS_STAR]
    one, two = 1.0 / (k0 + sigma), 1.0 / (kc + sigma)
    if branch == A:
        for c in range(PLAIN_CARRIED):
            d_rank[c] = out[c] = 0.0
        slope = 1.0 / (k0 * one * one)
        out[0] = slope * sigma * one * one
        out[OF_STRAIN] = slope * eps
        return slope
    p, rest = share(rank), share(-rank)
    weight = density(rank) * (star + sigma * (two - one))  # dε/dw
    flexible = rest * k0 * one * one + p * kc * two * two
    if branch == HELD:
        slope = 1.0 / flexible
        for c in range(PLAIN_CARRIED):
            out[c] = -slope * weight * d_rank[c]
        out[0] += slope * rest * sigma * one * one
        out[1] += slope * p * sigma * two * two
        out[2] -= slope * p
        out[OF_STRAIN] += slope * eps
        return slope
    back = branch == BACK
    spread = row[SPREAD_MINUS] if back else row[SPREAD_PLUS]
    first = 5 if back else 3
    by_log = -math.exp(-(row[LOG_MINUS] if back else row[LOG_PLUS])) / spread
    slope = 1.0 / (flexible + weight / (spread * sigma))
    for c in range(PLAIN_CARRIED):
        out[c] = d_rank[c] = 0.0
    d_rank[first], d_rank[first + 1] = by_log, -rank / spread
    out[0] = slope * rest * sigma * one * one
    out[1] = slope * p * sigma * two * two
    out[2] = -slope * p
    out[first], out[first + 1] = -slope * weight * by_log, slope * weight * rank / spread
    out[OF_STRAIN] = slope * eps
    for c in range(PLAIN_CARRIED):
        d_rank[c] += out[c] / (spread * sigma)
    return slope


@inner
def carried(row: Row) -> int:
    """How many derivatives are carried along."""
    return CARRIED if row[REMEMBERS] > 0.0 else PLAIN_CARRIED


@compiled
def stress_tangents_along(
    row: Row, eps: Array, sigma: Array, ranks: Array, branches: Branches
) -> tuple[Array, Array]:
    """Derivatives of the stress (8 or 11, n) along a strain history, and the slope dσ/dε (n,).

    See `tangents` for what they are by.
    """
    count = carried(row)
    out, slope = np.empty((count, eps.size)), np.empty(eps.size)
    now, d_ranks = np.empty(CARRIED), np.zeros((2, CARRIED))
    for j in range(eps.size):
        w, ever, branch = ranks[0, j], ranks[1, j], branches[j]
        slope[j] = tangents(row, branch, w, ever, sigma[j], eps[j], d_ranks, now)
        for c in range(count):
            out[c, j] = now[c]
    return out, slope


@inner
def strain_tangents(
    row: Row, branch: int, rank: float, ever: float, sigma: float, out: Array
) -> None:
    """Fill the derivatives of the strain by k0, kc, eps_star; of the rank by sigma_plus and so on.

    Those of the strain are at a fixed stress and rank, those of the rank at a fixed stress.
    """
    if row[REMEMBERS] > 0.0:
        memory.strain_tangents(row, branch, rank, ever, sigma, out)
        return
    one, two, p = 1.0 / (row[K0] + sigma), 1.0 / (row[KC] + sigma), share(rank)
    out[0], out[1], out[2] = -share(-rank) * sigma * one * one, -p * sigma * two * two, p
    for own in range(3, OF_STRAIN):
        out[own] = 0.0
    if branch == BACK:
        out[5] = -math.exp(-row[LOG_MINUS]) / row[SPREAD_MINUS]
        out[6] = -rank / row[SPREAD_MINUS]
    elif branch not in (A, HELD):
        out[3] = -math.exp(-row[LOG_PLUS]) / row[SPREAD_PLUS]
        out[4] = -rank / row[SPREAD_PLUS]
