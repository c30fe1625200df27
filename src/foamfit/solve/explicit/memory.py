"""Taylor series in time of springs with memory: the microscale law, and relaxation.

The stress of such a spring consists of the equilibrium stress s of its law and relaxation terms:

    Σ = (1 + Σ g_k) s + Σ z_k,      dz_k/dt = -(z_k + g_k s)/τ_k,      z_k = q_k - g_k s.

A microscale spring that is neither virgin (on branch a) nor held follows P = Φ(u) with
u = (ln s - l)/w. Its strain is a + P (c - a), a = s/(k0 + s), c = eps_star + s/(kc + s). With
h = u φ(u) every part has a short recurrence,

    w s u' = s',   φ' = -u' h,   P' = u' φ,   (k0 + s) (1 - a) = k0,

in which the last coefficient of s enters linearly, so that one division gives it from that of the
strain. While the spring is held, P is constant. For a spring that remembers (docs/theory.md) the
last equation becomes (k + ns) (1-a)' = -s' (1-a), with the softened k of micro-springs that have
snapped before; those that have never snapped, a share N, add N (a(s; k0) - a(s; k)). The rank of a
spring is stored as a normal score w = Φ⁻¹(p); like the rest of the state it depends on parameters.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.polynomial import first_crossing, value_at
from foamfit.springs import microscale_kernels as micro
from foamfit.springs.kernels import (
    AGAIN,
    BACK,
    BOTH,
    EPS_STAR,
    ETA,
    HELD,
    K0,
    K_SNAPPED,
    KC,
    KH_MINUS,
    KH_PLUS,
    KIND,
    LOG_MINUS,
    LOG_PLUS,
    N_COLUMNS,
    REMEMBERS,
    SNAP,
    STIFFENING,
    Array,
    Branches,
    D,
    E,
    Row,
    inlined,
    inner,
    maker,
    piece,
)
from foamfit.springs.law import BISTABLE, MICROSCALE
from foamfit.springs.microscale_kernels import CARRIED, OF_STRAIN, density, shares
from foamfit.springs.parameters import OWN_ETA, OWN_RELAXATION

# Columns of `Memory.series`, contiguous at each order because the recurrences read them together:
# equilibrium stress s; Σ z_k; 1 - a, 1 + eps_star - c; their difference; P; n u_n, u_n, φ, h;
# 1 - a of micro-springs that have never snapped. The z of the relaxation terms follow.
EQ, RELAXED, BELOW_A, BELOW_C, BETWEEN, SNAPPED, PACE, SCORE, DENSITY, BEND = range(10)
FRESH, N_MEMORY = 10, 11
# Rows of `Memory.partials`: derivatives of the strain at fixed stress by the parameters of the law
# (see `microscale_kernels`), by both ranks, and by the stress; then intermediate results.
BY_RANK, BY_EVER, BY_STRESS, SQUARE_A, SQUARE_C, WIDTH, STEEP = range(CARRIED, CARRIED + 7)
SQUARE_FRESH, BY_N, BY_N_FRESH, LOG, N_PARTIALS = range(CARRIED + 7, CARRIED + 12)
# Rows of `Memory.tangents`: the derivatives of s, and those of the z of the terms.
D_EQ, N_TANGENTS = range(2)
# Columns of `Memory.now`. Mean and standard deviation of the normal distribution of ln s on this
# branch; p and 1 - p at the start of the step; 1 + Σ g and its inverse; dε/ds at the start, its
# inverse, and dε/dΣ; the part of a derivative of Σ that does not depend on that of s. Common
# factors of all orders of a step: 1/(k0 + s) (on a curved branch of another spring 1/(k + s)),
# 1/(kc + s), 1/s; derivatives of a, c and u by s; c - a. For a spring that remembers: n and k of
# branch a, the share that has never snapped (0 if all are on one branch a), and for that share
# 1/(k0 + ns) and the derivative of a.
PLACE, SCALE, FRACTION, LEFT, GAIN, PER_GAIN, GIVE, PER_GIVE, SOFT, BASE = range(10)
PER_A, PER_C, PER_S, RATE_A, RATE_C, RATE_U, GAP = range(10, 17)
STIFF, K_MAIN, UNSNAPPED, PER_FRESH, RATE_FRESH, N_NOW = range(17, 23)
MARGIN = 1e-14  # relative strain by which a held spring must exceed its turning point to leave
STILL = 1e-14  # relative change of strain in a step below which a spring stands still
NOW = 1e-8  # a spring that turns within this share of a step turns at its start
LEAST_STRAIN = 1e-14  # no micro-spring snaps below this strain, where ln s is singular
# P counts as 0 or 1 beyond a normal score u, between NEAR and FAR, where its effect on the strain
# falls below the share NEGLIGIBLE of the truncation (in fact a tenth: P is about exp(-u²/2)/10).
NEAR, FAR, NEGLIGIBLE = 4.0, 8.0, 0.1
# Limits of a step elsewhere. The series of exp(-u²/2) decrease only from the order u δu on.
SHARE_OF_ORDER = 0.7  # largest u δu, over the order of the series
MOST_SCORE = 3.0  # largest δu
MOST_GROWTH = 0.8  # largest relative change of the stress
LOOSE = 0.05  # relative tolerance of these limits


class Memory(NamedTuple):
    """Memory of the springs, its series, and its derivatives in p directions."""

    rows: Array  #: the springs, (springs, columns)
    state: Array  #: state of microscale springs, (springs, STATE)
    now: Array  #: (springs, N_NOW)
    series: Array  #: (springs, order + 2, N_MEMORY + terms)
    partials: Array  #: (N_PARTIALS, springs, order + 2)
    directions: Branches  #: (p, 2)
    ranks: Array  #: derivatives of the ranks of held springs, (p, springs)
    evers: Array  #: derivatives of the largest ranks ever reached, (p, springs)
    tangents: Array  #: (p, springs, N_TANGENTS + terms, order + 2)
    one_sided: Array  #: 1 where left and right derivatives differ, (p,)
    scratch: Array  #: (3, CARRIED)


@maker
def make_memory(rows: Array, order: int, directions: Branches, one_sided: Array) -> Memory:
    """Return the memory of springs at rest."""
    count, terms, size = rows.shape[0], (rows.shape[1] - N_COLUMNS) // 2, directions.shape[0]
    memory = Memory(
        rows,
        np.zeros((count, micro.STATE)),
        np.zeros((count, N_NOW)),
        np.zeros((count, order + 2, N_MEMORY + terms)),
        np.zeros((N_PARTIALS, count, order + 2)),
        directions,
        np.zeros((size, count)),
        np.zeros((size, count)),
        np.zeros((size, count, N_TANGENTS + terms, order + 2)),
        one_sided,
        np.empty((3, CARRIED)),
    )
    for i in range(count):
        gain = 1.0
        for k in range(terms):
            gain += rows[i, N_COLUMNS + 2 * k]
        memory.now[i, GAIN], memory.now[i, PER_GAIN] = gain, 1.0 / gain
        if rows[i, KIND] == MICROSCALE:
            micro.begin(rows[i], memory.state[i], LEAST_STRAIN)
    return memory


# ---------------------------------------------------------------- from branch to branch


@inner
def load(memory: Memory, i: int, eps: float) -> int:
    """Load a microscale spring monotonically from rest to a strain; return its branch."""
    row, state = memory.rows[i], memory.state[i]
    while micro.leaves(state, eps):
        micro.switch(row, state, eps > state[micro.EPS])
    micro.settle(row, state, eps)
    return int(state[micro.BRANCH])


@inner
def enter_mixture(memory: Memory, i: int) -> tuple[float, float]:
    """Prepare for the new branch of a microscale spring; return the strains at its ends."""
    row, state, now = memory.rows[i], memory.state[i], memory.now[i]
    branch, low, high = int(state[micro.BRANCH]), state[micro.LOW], state[micro.HIGH]
    now[PLACE], now[SCALE] = micro.line(row, branch)
    hard = branch == SNAP or state[micro.NEVER] == 1.0  # nothing on branch a has ever snapped
    now[STIFF], now[K_MAIN] = row[STIFFENING], row[K0] if hard else row[K_SNAPPED]
    now[UNSNAPPED] = 0.0 if hard else state[micro.NEVER]
    for own in range(3, CARRIED):
        for n in range(memory.partials.shape[2] if own != OF_STRAIN else 0):
            memory.partials[own, i, n] = 0.0
    if branch == HELD:
        low, high = low * (1.0 - MARGIN), high * (1.0 + MARGIN)
    return low, high


@inner
def leave(memory: Memory, i: int, eps: float, up: bool, turning: bool, d_eps: Array) -> int:
    """Move a microscale spring to its next branch, at an end or a turning point; return that.

    d_eps (p, springs) are the derivatives of the strain. The rank held from a turning point on does
    not depend to first order on the time of the turn.
    """
    row, state, now = memory.rows[i], memory.state[i], memory.now[i]
    if turning:
        state[micro.FLEXIBILITY] = 0.0
        micro.settle(row, state, eps)
        branch, rank = int(state[micro.BRANCH]), micro.rank_now(row, state)
        sigma = state[micro.SIGMA]
        ever, d_ranks = micro.ever_now(state, rank), memory.scratch[:2]
        d_ranks[:] = 0.0
        slope = micro.tangents(row, branch, rank, ever, sigma, eps, d_ranks, memory.scratch[2])
        by_ever = micro.strain_tangents(row, branch, rank, ever, sigma, memory.scratch[2])[2]
        for k in range(memory.directions.shape[0]):
            own = memory.directions[k, 1]
            known = memory.directions[k, 0] == i and own < OWN_ETA
            moved = slope * (d_eps[k, i] - by_ever * memory.evers[k, i]) / (now[SCALE] * sigma)
            memory.ranks[k, i] = moved + (d_ranks[0, own] if known else 0.0)
            if branch == SNAP:
                memory.evers[k, i] = memory.ranks[k, i]
    micro.switch(row, state, up)
    if row[REMEMBERS] > 0.0 and state[micro.RANK] == state[micro.EVER]:
        for k in range(memory.directions.shape[0]):
            memory.ranks[k, i] = memory.evers[k, i]
    return int(state[micro.BRANCH])


@inner
def stands(c: Array, order: int, span: float) -> bool:
    """Whether a strain stands still over a step, except for rounding."""
    change = 0.0
    for n in range(order, 0, -1):
        change = (change + abs(c[n])) * span
    return change <= STILL * abs(c[0])


@piece
def first_turn(
    branches: Branches, eps: Array, order: int, span: float, c: Array
) -> tuple[float, int]:
    """Return the first time within `span` at which a snapping spring turns, and which spring.

    After a kink it may have turned already. Rounding errors turn no spring that stands still. c is
    scratch.
    """
    spring, whole = -1, span
    for i in range(branches.size):
        if branches[i] in (SNAP, AGAIN, BACK):
            if stands(eps[i], order, whole):
                continue
            ahead = -1.0 if branches[i] == BACK else 1.0
            for n in range(order):
                c[n] = ahead * (n + 1) * eps[i, n + 1]
            when, where = (
                (0.0, -1) if c[0] < 0.0 else first_crossing(c, order - 1, 0.0, math.inf, span)
            )
            if where != 0 and (spring < 0 or when < span):
                spring, span = i, (0.0 if when <= NOW * whole else when)
    return span, spring


# ---------------------------------------------------------------- the motion


@inner
def start_mixture(memory: Memory, i: int, moving: bool, eps: float) -> float:
    """Fill order 0 of a microscale spring; return the stress at its strain."""
    row, state, now, m = memory.rows[i], memory.state[i], memory.now[i], memory.series[i, 0]
    micro.settle(row, state, eps)
    s = state[micro.SIGMA]
    k, stiff = now[K_MAIN], now[STIFF]
    per_a, per_c = 1.0 / (k + stiff * s), 1.0 / (row[KC] + s)
    below_a, below_c = k * per_a, row[KC] * per_c
    if stiff != 1.0:
        below_a = below_a ** (1.0 / stiff)
    m[BELOW_A], m[BELOW_C], m[BETWEEN] = below_a, below_c, below_a - below_c
    p, q, steep = state[micro.SNAPPED], state[micro.REST], 0.0
    if moving:
        u = (math.log(s) - now[PLACE]) / now[SCALE]
        (p, q), at = shares(u), density(u)
        m[SCORE], m[DENSITY], m[BEND] = u, at, u * at
        now[PER_S] = 1.0 / s
        now[RATE_U] = now[PER_S] / now[SCALE]
        steep = at * now[RATE_U]
    m[SNAPPED] = now[FRACTION] = p
    now[LEFT] = q
    now[PER_A], now[PER_C] = per_a, per_c
    now[RATE_A], now[RATE_C] = below_a * per_a, below_c * per_c
    now[GAP] = row[EPS_STAR] + below_a - below_c
    now[GIVE] = q * now[RATE_A] + p * now[RATE_C] + now[GAP] * steep
    if now[UNSNAPPED] > 0.0:
        now[PER_FRESH] = 1.0 / (row[K0] + stiff * s)
        m[FRESH] = (row[K0] * now[PER_FRESH]) ** (1.0 / stiff)
        now[RATE_FRESH] = m[FRESH] * now[PER_FRESH]
        now[GIVE] += now[UNSNAPPED] * (now[RATE_FRESH] - now[RATE_A])
    now[PER_GIVE] = 1.0 / now[GIVE]
    now[SOFT] = now[GIVE] * now[PER_GAIN]
    return s


@inner
def _bent(m: Array, column: int, n: int, stiff: float) -> float:
    """Return order n of 1 - a, without the factor -1/(k + ns) and the term of s_n."""
    total = 0.0
    for j in range(1, n):
        total += (j + stiff * (n - j)) * m[j, EQ] * m[n - j, column]
    return total / n


@inner
def _unsnapped(now: Array, m: Array, n: int) -> float:
    """Return order n of the extra strain of the share that never snapped, on a stiffer branch a."""
    m[n, FRESH] = -_bent(m, FRESH, n, now[STIFF]) * now[PER_FRESH]
    return now[UNSNAPPED] * (m[n, BELOW_A] - m[n, FRESH])


@inlined
def strain_of_mixture(now: Array, m: Array, moving: bool, n: int) -> float:
    """Return order n >= 1 of the strain of a microscale spring, without the term of s_n.

    `now` and `m` are the spring's rows of `Memory.now` and `Memory.series`; order n of `m` is
    filled for s_n = 0.
    """
    by_a = by_c = 0.0
    if not moving:
        for j in range(1, n):
            s_j, k = m[j, EQ], n - j
            by_a += s_j * m[k, BELOW_A]
            by_c += s_j * m[k, BELOW_C]
        if now[STIFF] != 1.0:
            by_a = _bent(m, BELOW_A, n, now[STIFF])
        below_a, below_c = -by_a * now[PER_A], -by_c * now[PER_C]
        m[n, BELOW_A], m[n, BELOW_C] = below_a, below_c
        more = _unsnapped(now, m, n) if now[UNSNAPPED] > 0.0 else 0.0
        return more - now[LEFT] * below_a - now[FRACTION] * below_c
    by_s = by_density = by_bend = products = parts = 0.0
    for j in range(1, n):
        s_j, pace_j, k = m[j, EQ], m[j, PACE], n - j
        by_a += s_j * m[k, BELOW_A]
        by_c += s_j * m[k, BELOW_C]
        by_s += s_j * m[k, PACE]
        by_density += pace_j * m[k, DENSITY]
        by_bend += pace_j * m[k, BEND]
        products += m[j, SCORE] * m[k, DENSITY]
        parts += m[j, SNAPPED] * m[k, BETWEEN]
    if now[STIFF] != 1.0:
        by_a = _bent(m, BELOW_A, n, now[STIFF])
    per_n = 1.0 / n
    below_a, below_c, pace = -by_a * now[PER_A], -by_c * now[PER_C], -by_s * now[PER_S]
    snapped = (pace * m[0, DENSITY] + by_density) * per_n
    m[n, BELOW_A], m[n, BELOW_C], m[n, BETWEEN] = below_a, below_c, below_a - below_c
    m[n, PACE], m[n, SCORE], m[n, SNAPPED] = pace, pace * per_n, snapped
    m[n, DENSITY], m[n, BEND] = -(pace * m[0, BEND] + by_bend) * per_n, products
    if now[UNSNAPPED] > 0.0:
        parts += _unsnapped(now, m, n)
    return snapped * now[GAP] - now[LEFT] * below_a - now[FRACTION] * below_c + parts


@inlined
def finish_mixture(now: Array, m: Array, moving: bool, n: int, s_n: float) -> None:
    """Add the terms of order n >= 1 of the stress to the series; see `strain_of_mixture`."""
    on_a, on_c = s_n * now[RATE_A], s_n * now[RATE_C]
    m[n, BELOW_A] -= on_a
    m[n, BELOW_C] -= on_c
    if now[UNSNAPPED] > 0.0:
        m[n, FRESH] -= s_n * now[RATE_FRESH]
    if moving:
        more = s_n * now[RATE_U]
        score, density = m[n, SCORE] + more, m[n, DENSITY] - m[0, BEND] * more
        m[n, BETWEEN] -= on_a - on_c
        m[n, PACE] += n * more
        m[n, SNAPPED] += m[0, DENSITY] * more
        m[n, SCORE], m[n, DENSITY] = score, density
        m[n, BEND] += m[0, SCORE] * density + score * m[0, DENSITY]


@inlined
def keep(row: Row, m: Array, n: int, s_n: float) -> None:
    """Write order n of a spring's equilibrium stress, and order n + 1 of its relaxation terms."""
    m[n, EQ], total = s_n, 0.0
    for k in range(m.shape[1] - N_MEMORY):
        g, tau = row[N_COLUMNS + 2 * k], row[N_COLUMNS + 2 * k + 1]
        z = -(m[n, N_MEMORY + k] + g * s_n) * (1.0 / (tau * (n + 1)))
        m[n + 1, N_MEMORY + k] = z
        total += z
    m[n + 1, RELAXED] = total


@inner
def longest(m: Array, now: Array, order: int, tol: float, span: float) -> float:
    """Return the longest step within `span` over which the series of ln s converges well.

    Where almost none or almost all micro-springs have snapped, the series do not show when the
    others will: such a step ends where their effect on the strain reaches the truncation `tol`.
    """
    s, u, scale = m[0, EQ], abs(m[0, SCORE]), now[SCALE]
    change = min(MOST_SCORE, SHARE_OF_ORDER * order / u) if u > 0.0 else MOST_SCORE
    if u > NEAR:
        few = -2.0 * math.log(NEGLIGIBLE * tol * now[GIVE] * s / now[GAP])
        change = max(change, u - math.sqrt(min(max(few, NEAR * NEAR), FAR * FAR)))
    rise = s * min(MOST_GROWTH, math.exp(scale * change) - 1.0)
    fall = s * min(MOST_GROWTH, 1.0 - math.exp(-scale * change))
    least = LOOSE * MOST_SCORE * scale * s  # a relative tolerance is too loose far from a snap
    for _ in range(40):  # Newton's method from above on convex functions
        up = down = up_slope = down_slope = 0.0
        for n in range(order, 0, -1):
            up_slope, down_slope = up_slope * span + up, down_slope * span + down
            up, down = up * span + max(m[n, EQ], 0.0), down * span + max(-m[n, EQ], 0.0)
        over, under = up * span - rise, down * span - fall
        if over <= min(LOOSE * rise, least) and under <= min(LOOSE * fall, least):
            break
        span -= max(over / (up + up_slope * span), under / (down + down_slope * span), 0.0)
    return span


@inner
def strain_at(row: Row, state: Array, now: Array, moving: bool, s: float) -> tuple[float, float]:
    """Return the strain of a mixture at a stress (NaN past the law's end), and its slope dε/ds."""
    branch, p, q, steep = int(state[micro.BRANCH]), state[micro.SNAPPED], state[micro.REST], 0.0
    if moving:
        if not s > 0.0:
            return math.nan, math.nan
        u = (math.log(s) - now[PLACE]) / now[SCALE]
        (p, q), steep = shares(u), density(u) / (now[SCALE] * s)
    eps, soft, _, on_main, _ = micro.mixture(row, branch, p, q, state[micro.NEVER], s)
    return eps, soft + (row[EPS_STAR] + s / (row[KC] + s) - on_main) * steep


@inner
def advance_memory(state: Array, series: Array, order: int, span: float) -> None:
    """Advance the relaxation terms, and the initial guesses of the stress, over a step."""
    for i in range(state.shape[0]):
        if state[i, micro.BRANCH] >= HELD:
            reached = value_at(series[i, :, EQ], order, span)
            state[i, micro.FLEXIBILITY] = 0.0
            state[i, micro.SIGMA] = reached if reached > 0.0 else state[i, micro.SIGMA]
        total = 0.0
        for k in range(N_MEMORY, series.shape[2]):
            z = value_at(series[i, :, k], order, span)
            series[i, 0, k] = z
            total += z
        series[i, 0, RELAXED] = total


# ---------------------------------------------------------------- derivatives by parameters


@inner
def _fill_of_a(
    s: Array, below: Array, k: float, n: float, out: Array, log: Array, by_n: Array, order: int
) -> None:
    """Fill the series of (1 - a)^(1+n), of ln(1 + ns/k) and of ∂a/∂n from that of 1 - a."""
    per = 1.0 / (k + n * s[0])
    out[0], log[0] = below[0] * k * per, math.log1p(n * s[0] / k)
    for m in range(1, order + 1):
        power, logs = (1.0 + n) * m * s[m] * out[0], 0.0
        for j in range(1, m):
            power += ((1.0 + n) * j + n * (m - j)) * s[j] * out[m - j]
            logs += s[j] * (m - j) * log[m - j]
        out[m], log[m] = -power * per / m, n * (s[m] - logs / m) * per
    for m in range(order + 1):
        total = 0.0
        for j in range(m + 1):
            total += below[j] * log[m - j]
        by_n[m] = (below[m] - out[m] - total) / (n * n)


@inner
def fill_partials(memory: Memory, i: int, moving: bool, eps: Array, order: int) -> float:
    """Fill derivatives of a spring's strain at fixed stress; return the slope dΣ/dε (order 0)."""
    row, state, now, m = memory.rows[i], memory.state[i], memory.now[i], memory.series[i]
    out, remembers, branch = memory.partials, row[REMEMBERS] > 0.0, int(state[micro.BRANCH])
    n, star, k, never, p = (
        row[STIFFENING],
        row[EPS_STAR],
        now[K_MAIN],
        now[UNSNAPPED],
        now[FRACTION],
    )
    first_loading = branch == SNAP or state[micro.NEVER] == 1.0  # not if all have snapped
    s, below, below_c, fresh = m[:, EQ], m[:, BELOW_A], m[:, BELOW_C], m[:, FRESH]
    snapped, score, dense = m[:, SNAPPED], m[:, SCORE], m[:, DENSITY]
    square, square_c, hard = out[SQUARE_A, i], out[SQUARE_C, i], out[SQUARE_FRESH, i]
    gap, width, steep = out[BY_RANK, i], out[WIDTH, i], out[STEEP, i]
    if remembers:
        _fill_of_a(s, below, k, n, square, out[LOG, i], out[BY_N, i], order)
    if never > 0.0:
        _fill_of_a(s, fresh, row[K0], n, hard, out[LOG, i], out[BY_N_FRESH, i], order)
    at_rank = 1.0 if moving else density(state[micro.RANK])
    at_ever = density(state[micro.EVER]) if never > 0.0 else 0.0
    first, place = (5, row[LOG_MINUS]) if branch == BACK else (3, row[LOG_PLUS])
    per_k, per_k0, per_kc, per_s = 1.0 / k, 1.0 / (n * row[K0]), 1.0 / row[KC], 1.0 / s[0]
    weakens = remembers and branch in (AGAIN, BOTH)
    by_k0, by_kc, by_star, by_stress = out[0, i], out[1, i], out[2, i], out[BY_STRESS, i]
    by_place, by_scale = out[first, i], out[first + 1, i]
    per_scale, per_place, worn = 1.0 / now[SCALE], math.exp(-place) / now[SCALE], now[LEFT] - never
    for o in range(order + 1):
        aa = cc = 0.0
        for j in range((o + 1) // 2):
            aa += below[j] * below[o - j]
            cc += below_c[j] * below_c[o - j]
        aa, cc, middle = 2.0 * aa, 2.0 * cc, o // 2
        if o % 2 == 0:
            aa += below[middle] * below[middle]
            cc += below_c[middle] * below_c[middle]
        square_c[o] = cc
        if not remembers:
            square[o] = aa
        gap[o] = at_rank * (below[o] - below_c[o] + (star if o == 0 else 0.0))
        qa, qaa, pc, pcc = worn * below[o], worn * square[o], p * below_c[o], p * square_c[o]
        by_star[o] = snapped[o] if moving else (p if o == 0 else 0.0)
        by_stress[o] = 0.0
        if moving:
            wide = gap[0] * dense[o]
            for j in range(1, o + 1):
                qa -= snapped[j] * below[o - j]
                qaa -= snapped[j] * square[o - j]
                pcc += snapped[j] * square_c[o - j]
                wide += gap[j] * dense[o - j]
            if o > 0:  # from the strain, the sum of all parts
                pc = star * snapped[o] - qa - eps[o] - (never * fresh[o] if never > 0.0 else 0.0)
            width[o] = wide
            by_score, by_s = wide * score[0], wide
            for j in range(1, o + 1):
                by_score += score[j] * width[o - j]
                by_s -= s[j] * steep[o - j]
            steep[o] = by_s * per_s
            by_stress[o] = steep[o] * per_scale
            by_place[o], by_scale[o] = -wide * per_place, -by_score * per_scale
            if weakens:
                out[micro.OF_WEAKENING, i, o] = wide * per_scale
        on_a = qa - qaa
        by_stress[o] += qaa * per_k + pcc * per_kc
        if remembers:
            by_n = worn * out[BY_N, i, o]
            for j in range(1, o + 1 if moving else 1):
                by_n -= snapped[j] * out[BY_N, i, o - j]
            out[micro.OF_SOFTENING, i, o] = 0.0 if first_loading else on_a / n
            out[BY_EVER, i, o] = 0.0
            if never > 0.0:
                on_a += never * (fresh[o] - hard[o])
                by_n += never * out[BY_N_FRESH, i, o]
                by_stress[o] += never * hard[o] / row[K0]
                out[BY_EVER, i, o] = at_ever * (fresh[o] - below[o])
            out[micro.OF_STIFFENING, i, o] = by_n
        by_k0[o], by_kc[o] = -on_a * per_k0, (pcc - pc) * per_kc
    return now[GAIN] / by_stress[0]


@inlined
def tangent_of_mixture(memory: Memory, k: int, i: int, moving: bool, slope: float, n: int) -> float:
    """Return order n of the derivative of (1 + Σ g) s in direction k, without the term of δε_n."""
    d_s = memory.tangents[k, i, D_EQ]
    soft, own = memory.partials[BY_STRESS, i], memory.directions[k, 1]
    even = odd = 0.0  # two independent sums run in parallel
    if memory.directions[k, 0] == i and own < OWN_ETA:
        even = memory.partials[own, i, n]
    if not moving:
        odd = memory.partials[BY_RANK, i, n] * memory.ranks[k, i]
    if memory.now[i, UNSNAPPED] > 0.0:
        even += memory.partials[BY_EVER, i, n] * memory.evers[k, i]
    for j in range(1, n, 2):
        even += soft[j] * d_s[n - j]
        odd += soft[j + 1] * d_s[n - j - 1]
    if n % 2 == 1:
        even += soft[n] * d_s[0]
    return -slope * (even + odd)


@inlined
def relaxed_tangent(memory: Memory, k: int, i: int, n: int) -> float:
    """Return order n of the derivative of Σ z_k, and of g s at fixed s, in direction k."""
    total = 0.0
    for term in range(memory.series.shape[2] - N_MEMORY):
        total += memory.tangents[k, i, N_TANGENTS + term, n]
        own = OWN_RELAXATION + 2 * term
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own:
            total += memory.series[i, n, EQ]
    return total


@inlined
def keep_tangent(memory: Memory, k: int, i: int, n: int, d_sig: float) -> None:
    """Write order n of the derivative of s, and order n + 1 of those of the relaxation terms."""
    d_s = (d_sig - memory.now[i, BASE]) * memory.now[i, PER_GAIN]
    memory.tangents[k, i, D_EQ, n] = d_s
    for term in range(memory.series.shape[2] - N_MEMORY):
        g, tau = memory.rows[i, N_COLUMNS + 2 * term], memory.rows[i, N_COLUMNS + 2 * term + 1]
        dz = memory.tangents[k, i, N_TANGENTS + term]
        flow = dz[n] + g * d_s
        own = OWN_RELAXATION + 2 * term
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own:
            flow += memory.series[i, n, EQ]
        dz[n + 1] = -flow * (1.0 / (tau * (n + 1)))
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own + 1:
            dz[n + 1] -= memory.series[i, n + 1, N_MEMORY + term] * (1.0 / tau)


@inner
def _is_flat(row: Row, branch: int) -> bool:
    """Whether a spring is on a flat branch without dashpot."""
    slope = row[KH_PLUS] if branch == D else row[KH_MINUS] if branch == E else 1.0
    return row[KIND] == BISTABLE and slope == 0.0 and row[ETA] == 0.0


@inner
def mark_one_sided(
    memory: Memory, branches: Branches, eps: Array, series: Array, order: int, span: float
) -> None:
    """Mark the directions in which left and right derivatives differ.

    A snapping spring that stands still continues for one sign of the change of a parameter and is
    held for the other; of several springs on flat branches, the sign decides which moves first.
    """
    flat = 0
    for i in range(branches.size):
        flat += _is_flat(memory.rows[i], branches[i])
    for p in range(series.shape[0]):
        i, own = memory.directions[p, 0], memory.directions[p, 1]
        if flat > 1 and i >= 0 and own in (0, 2, 3) and _is_flat(memory.rows[i], branches[i]):
            memory.one_sided[p] = 1.0
    for i in range(branches.size):
        if branches[i] in (SNAP, AGAIN, BACK) and stands(eps[i], order, span):
            for p in range(series.shape[0]):
                if not stands(series[p, i], order, span) and series[p, i, 1] != 0.0:
                    memory.one_sided[p] = 1.0
