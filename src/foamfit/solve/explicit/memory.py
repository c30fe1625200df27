"""The Taylor series in time of springs with memory: the microscale law, and relaxation.

The stress of such a spring is that of its law in equilibrium, s, and what relaxes:

    Σ = (1 + Σ g_k) s + Σ z_k,      dz_k/dt = -(z_k + g_k s)/τ_k,      z_k = q_k - g_k s.

A microscale spring that is neither virgin (then it is on branch a) nor held follows P = Φ(u) with
u = (ln s - l)/w. Its strain is a + P (c - a), a = s/(k0 + s), c = eps_star + s/(kc + s), and with
h = u φ(u) all that is in it has a short recurrence,

    w s u' = s',   φ' = -u' h,   P' = u' φ,   (k0 + s) (1 - a) = k0,

in each of which the last coefficient of s enters linearly: one division finds it from that of the
strain. Held, P is a constant. The rank of a spring is kept as a normal score w = Φ⁻¹(p). It moves
with the parameters like all that is in the state.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.polynomial import first_crossing, value_at
from foamfit.springs import microscale_kernels as micro
from foamfit.springs.kernels import (
    BACK,
    EPS_STAR,
    HELD,
    K0,
    KC,
    KIND,
    LOG_MINUS,
    LOG_PLUS,
    N_COLUMNS,
    SNAP,
    SPREAD_MINUS,
    SPREAD_PLUS,
    Array,
    Branches,
    inlined,
    inner,
    maker,
    piece,
)
from foamfit.springs.law import MICROSCALE
from foamfit.springs.microscale_kernels import (
    BRANCH,
    CARRIED,
    EPS,
    FLEXIBILITY,
    HIGH,
    LOW,
    RANK,
    REST,
    SIGMA,
    STATE,
)
from foamfit.springs.parameters import OWN_ETA, OWN_RELAXATION

# Rows of `Memory.series`: equilibrium stress s; 1 - a, 1 + eps_star - c; P; n u_n, u_n, φ, h.
EQ, BELOW_A, BELOW_C, SNAPPED, PACE, SCORE, DENSITY, BEND, N_MEMORY = range(9)
# Rows of `Memory.partials`: the derivatives of the strain at fixed stress by the seven parameters
# of the law, by p, and by the stress; then what these are made of.
BY_RANK, BY_STRESS, SQUARE_A, SQUARE_C, WIDTH, STEEP, N_PARTIALS = range(7, 14)
# Columns of `Memory.now`: place and scale of the normal distribution that is followed, p and 1 - p
# where the step starts, 1 + Σ g; dε/ds there, and dε/dΣ; what of a derivative of Σ is not of s.
PLACE, SCALE, FRACTION, LEFT, GAIN, GIVE, SOFT, BASE, N_NOW = range(9)
# A held spring is past where it turned if its strain is, by so much of itself.
MARGIN = 1e-13
# A spring that turns within so small a part of a step turns at its start.
NOW = 1e-8
# Beyond this normal score P is 0 or 1 to rounding. Within it the score u may change in a step by so
# much over u as its series have orders, times a share (they are those of exp(-u²/2), whose terms
# fall only from the order u δu on), and by so much at most.
FAR = 8.0
SHARE_OF_ORDER, MOST_SCORE = 0.7, 3.0


class Memory(NamedTuple):
    """What springs remember, and its series and derivatives.

    rows (springs, columns) are the springs, state (springs, STATE) that of the microscale ones,
    now (springs, N_NOW) the numbers above, series (N_MEMORY, springs, order + 2), z (terms,
    springs, order + 2) the relaxation. `partials` (N_PARTIALS, springs, order + 2) are filled where
    derivatives are wanted; of these, in p `directions` (p, 2), `ranks` (p, springs) are those of
    what is held and `tangents` (p, 1 + terms, springs, order + 2) the series of s and z. `scratch`
    is (2, CARRIED).
    """

    rows: Array
    state: Array
    now: Array
    series: Array
    z: Array
    partials: Array
    directions: Branches
    ranks: Array
    tangents: Array
    scratch: Array


@maker
def make_memory(rows: Array, order: int, directions: Branches) -> Memory:
    """Make the memory of springs at rest."""
    count, terms, size = rows.shape[0], (rows.shape[1] - N_COLUMNS) // 2, directions.shape[0]
    memory = Memory(
        rows,
        np.zeros((count, STATE)),
        np.zeros((count, N_NOW)),
        np.zeros((N_MEMORY, count, order + 2)),
        np.zeros((terms, count, order + 2)),
        np.zeros((N_PARTIALS, count, order + 2)),
        directions,
        np.zeros((size, count)),
        np.zeros((size, 1 + terms, count, order + 2)),
        np.empty((2, CARRIED)),
    )
    for i in range(count):
        gain = 1.0
        for k in range(terms):
            gain += rows[i, N_COLUMNS + 2 * k]
        memory.now[i, GAIN] = gain
        if rows[i, KIND] == MICROSCALE:
            micro.begin(rows[i], memory.state[i])
    return memory


# ---------------------------------------------------------------- from branch to branch


@inner
def load(memory: Memory, i: int, eps: float) -> int:
    """Load a microscale spring from rest to a strain in one go; returns its branch."""
    row, state = memory.rows[i], memory.state[i]
    while micro.leaves(state, eps):
        micro.switch(row, state, eps > state[EPS])
    micro.settle(row, state, eps)
    return int(state[BRANCH])


@inner
def enter_mixture(memory: Memory, i: int) -> tuple[float, float]:
    """Prepare for the branch that a microscale spring has entered; the strains of its ends."""
    row, state, now = memory.rows[i], memory.state[i], memory.now[i]
    branch, low, high = int(state[BRANCH]), state[LOW], state[HIGH]
    now[PLACE] = row[LOG_MINUS] if branch == BACK else row[LOG_PLUS]
    now[SCALE] = row[SPREAD_MINUS] if branch == BACK else row[SPREAD_PLUS]
    for own in range(3, OWN_ETA):
        for n in range(memory.partials.shape[2]):
            memory.partials[own, i, n] = 0.0
    if branch == HELD:
        low, high = low * (1.0 - MARGIN), high * (1.0 + MARGIN)
    return low, high


@inner
def leave(memory: Memory, i: int, eps: float, up: bool, turning: bool, d_eps: Array) -> int:
    """Let a microscale spring leave its branch, at an end or where it turns; returns the next.

    d_eps (p, springs) holds the derivatives of the strain. Where the stress turns, what is held
    from then on does not feel when it does.
    """
    row, state, now = memory.rows[i], memory.state[i], memory.now[i]
    if turning:
        state[FLEXIBILITY] = 0.0
        micro.settle(row, state, eps)
        rank, d_rank = micro.rank_now(row, state), memory.scratch[0]
        slope = micro.tangents(
            row, int(state[BRANCH]), rank, state[SIGMA], eps, d_rank, memory.scratch[1]
        )
        for k in range(memory.directions.shape[0]):
            own = memory.directions[k, 1]
            known = memory.directions[k, 0] == i and own < OWN_ETA
            moved = slope * d_eps[k, i] / (now[SCALE] * state[SIGMA])
            memory.ranks[k, i] = moved + (d_rank[own] if known else 0.0)
    micro.switch(row, state, up)
    return int(state[BRANCH])


@piece
def first_turn(
    branches: Branches, eps: Array, order: int, span: float, c: Array
) -> tuple[float, int]:
    """First time within `span` at which a spring that snaps turns, and which; c is scratch.

    After a kink it may have turned already.
    """
    spring, whole = -1, span
    for i in range(branches.size):
        if branches[i] == SNAP or branches[i] == BACK:
            ahead = 1.0 if branches[i] == SNAP else -1.0
            for n in range(order):
                c[n] = ahead * (n + 1) * eps[i, n + 1]
            when, where = (
                (0.0, -1) if c[0] < 0.0 else first_crossing(c, order - 1, 0.0, math.inf, span)
            )
            if where != 0 and (spring < 0 or when < span):
                spring, span = i, (0.0 if when <= NOW * whole else when)
    return span, spring


@inner
def start_relaxed(memory: Memory, i: int, s: float) -> None:
    """Nothing has relaxed yet of the stress at which a spring starts."""
    for k in range(memory.z.shape[0]):
        memory.z[k, i, 0] = -memory.rows[i, N_COLUMNS + 2 * k] * s


@inner
def start_relaxed_tangent(memory: Memory, p: int, i: int, change: float) -> None:
    """Derivative in direction p of what `start_relaxed` writes, from that of the stress."""
    own = memory.directions[p, 1] if memory.directions[p, 0] == i else OWN_ETA
    for k in range(memory.z.shape[0]):
        memory.tangents[p, 1 + k, i, 0] = -memory.rows[i, N_COLUMNS + 2 * k] * change
        if own == OWN_RELAXATION + 2 * k:
            memory.tangents[p, 1 + k, i, 0] -= memory.series[EQ, i, 0]


# ---------------------------------------------------------------- the motion


@inner
def start_mixture(memory: Memory, i: int, moving: bool, eps: float) -> float:
    """Order 0 of a microscale spring: the stress at a strain, and all that follows from it."""
    row, state, now, m = memory.rows[i], memory.state[i], memory.now[i], memory.series
    micro.settle(row, state, eps)
    s = state[SIGMA]
    below_a, below_c = row[K0] / (row[K0] + s), row[KC] / (row[KC] + s)
    m[BELOW_A, i, 0], m[BELOW_C, i, 0] = below_a, below_c
    p, q, steep = state[micro.SNAPPED], state[REST], 0.0
    if moving:
        u = (math.log(s) - now[PLACE]) / now[SCALE]
        p, q, at = micro.share(u), micro.share(-u), micro.density(u)
        m[SCORE, i, 0], m[DENSITY, i, 0], m[BEND, i, 0] = u, at, u * at
        steep = at / (now[SCALE] * s)
    m[SNAPPED, i, 0] = now[FRACTION] = p
    now[LEFT] = q
    gap = row[EPS_STAR] + below_a - below_c
    now[GIVE] = q * below_a / (row[K0] + s) + p * below_c / (row[KC] + s) + gap * steep
    return s


@inlined
def strain_of_mixture(memory: Memory, i: int, moving: bool, n: int) -> float:
    """Order n >= 1 of the strain of a microscale spring, but for what that of its stress adds.

    All series are filled as if that were zero.
    """
    row, now, m = memory.rows[i], memory.now[i], memory.series
    s, below_a, below_c = m[EQ, i], m[BELOW_A, i], m[BELOW_C, i]
    p, q = now[FRACTION], now[LEFT]
    per_a, per_c = 1.0 / (row[K0] + s[0]), 1.0 / (row[KC] + s[0])  # quotients that wait for nothing
    by_a = by_c = 0.0
    if not moving:
        for j in range(1, n):
            by_a += s[j] * below_a[n - j]
            by_c += s[j] * below_c[n - j]
        below_a[n], below_c[n] = -by_a * per_a, -by_c * per_c
        return -q * below_a[n] - p * below_c[n]
    snapped, pace, score = m[SNAPPED, i], m[PACE, i], m[SCORE, i]
    density, bend = m[DENSITY, i], m[BEND, i]
    by_s = by_density = by_bend = products = parts = 0.0
    for j in range(1, n):
        by_a += s[j] * below_a[n - j]
        by_c += s[j] * below_c[n - j]
        by_s += s[j] * pace[n - j]
        by_density += pace[j] * density[n - j]
        by_bend += pace[j] * bend[n - j]
        products += score[j] * density[n - j]
        parts += snapped[j] * (below_a[n - j] - below_c[n - j])
    per_n = 1.0 / n
    below_a[n], below_c[n] = -by_a * per_a, -by_c * per_c
    pace[n] = -by_s * (1.0 / s[0])
    score[n] = pace[n] * per_n
    snapped[n] = (pace[n] * density[0] + by_density) * per_n
    density[n] = -(pace[n] * bend[0] + by_bend) * per_n
    bend[n] = products
    gap = row[EPS_STAR] + below_a[0] - below_c[0]
    return snapped[n] * gap - q * below_a[n] - p * below_c[n] + parts


@inlined
def finish_mixture(memory: Memory, i: int, moving: bool, n: int, s_n: float) -> None:
    """Add to the series what order n >= 1 of the stress adds."""
    row, now, m = memory.rows[i], memory.now[i], memory.series
    s = m[EQ, i, 0]
    m[BELOW_A, i, n] -= s_n * (m[BELOW_A, i, 0] / (row[K0] + s))
    m[BELOW_C, i, n] -= s_n * (m[BELOW_C, i, 0] / (row[KC] + s))
    if moving:
        more = s_n * (1.0 / (now[SCALE] * s))
        m[PACE, i, n] += n * more
        m[SCORE, i, n] += more
        m[SNAPPED, i, n] += m[DENSITY, i, 0] * more
        m[DENSITY, i, n] -= m[BEND, i, 0] * more
        m[BEND, i, n] += m[SCORE, i, 0] * m[DENSITY, i, n] + m[SCORE, i, n] * m[DENSITY, i, 0]


@inlined
def relaxed(memory: Memory, i: int, n: int) -> float:
    """Order n of Σ z_k of a spring."""
    total = 0.0
    for k in range(memory.z.shape[0]):
        total += memory.z[k, i, n]
    return total


@inlined
def keep(memory: Memory, i: int, n: int, s_n: float) -> None:
    """Write order n of a spring's equilibrium stress, and what relaxes in the next."""
    memory.series[EQ, i, n] = s_n
    for k in range(memory.z.shape[0]):
        g, tau = memory.rows[i, N_COLUMNS + 2 * k], memory.rows[i, N_COLUMNS + 2 * k + 1]
        memory.z[k, i, n + 1] = -(memory.z[k, i, n] + g * s_n) * (1.0 / (tau * (n + 1)))


@inner
def longest(memory: Memory, i: int, order: int, span: float) -> float:
    """Longest step, within `span`, over which the logarithm of a stress has a good series.

    Where nearly none, or all, have snapped, the series do not show how soon the others do: a step
    from beyond `FAR` ends there.
    """
    s, u, scale = memory.series[EQ, i], abs(memory.series[SCORE, i, 0]), memory.now[i, SCALE]
    within = min(MOST_SCORE, SHARE_OF_ORDER * order / u) if u > 0.0 else MOST_SCORE
    most = s[0] * min(0.8, 1.0 - math.exp(-scale * max(within, u - FAR)))  # also where it falls
    for _ in range(400):
        moved = 0.0
        for n in range(order, 0, -1):
            moved = (moved + abs(s[n])) * span
        if moved <= most:
            break
        span *= 0.75
    return span


@inner
def strain_at(memory: Memory, i: int, moving: bool, s: float) -> tuple[float, float]:
    """Strain of a mixture at a stress (NaN where its law ends), and its slope dε/ds."""
    row, state, now = memory.rows[i], memory.state[i], memory.now[i]
    p, q, steep = state[micro.SNAPPED], state[REST], 0.0
    if moving:
        if not s > 0.0:
            return math.nan, math.nan
        u = (math.log(s) - now[PLACE]) / now[SCALE]
        p, q, steep = micro.share(u), micro.share(-u), micro.density(u) / (now[SCALE] * s)
    one, two = 1.0 / (row[K0] + s), 1.0 / (row[KC] + s)
    soft = q * row[K0] * one * one + p * row[KC] * two * two
    gap = row[EPS_STAR] + s * (two - one)
    return q * (s * one) + p * (row[EPS_STAR] + s * two), soft + gap * steep


@inner
def advance_memory(memory: Memory, order: int, span: float) -> None:
    """Carry what relaxes over a step, and where the search for the stress starts."""
    for i in range(memory.now.shape[0]):
        if memory.state[i, BRANCH] >= HELD:
            reached = value_at(memory.series[EQ, i], order, span)
            memory.state[i, FLEXIBILITY] = 0.0
            memory.state[i, SIGMA] = reached if reached > 0.0 else memory.state[i, SIGMA]
        for k in range(memory.z.shape[0]):
            memory.z[k, i, 0] = value_at(memory.z[k, i], order, span)


# ---------------------------------------------------------------- its derivatives


@inner
def fill_partials(
    memory: Memory, i: int, moving: bool, back: bool, eps: Array, order: int
) -> float:
    """Fill the derivatives of a spring's strain at fixed stress; returns the slope dΣ/dε now."""
    row, now, m, out = memory.rows[i], memory.now[i], memory.series, memory.partials
    s, below_a, below_c = m[EQ, i], m[BELOW_A, i], m[BELOW_C, i]
    snapped, score, density = m[SNAPPED, i], m[SCORE, i], m[DENSITY, i]
    square_a, square_c, width = out[SQUARE_A, i], out[SQUARE_C, i], out[WIDTH, i]
    gap, by_stress, steep = out[BY_RANK, i], out[BY_STRESS, i], out[STEEP, i]
    by_k0, by_kc, by_star = out[0, i], out[1, i], out[2, i]
    by_place, by_scale = out[5 if back else 3, i], out[6 if back else 4, i]
    per_k0, per_kc, per_scale, per_s = 1.0 / row[K0], 1.0 / row[KC], 1.0 / now[SCALE], 1.0 / s[0]
    per_place = per_scale * math.exp(-now[PLACE])
    p, q, star = now[FRACTION], now[LEFT], row[EPS_STAR]
    at_rank = 1.0 if moving else micro.density(memory.state[i, RANK])
    for n in range(order + 1):
        aa = cc = 0.0
        for j in range((n + 1) // 2):
            aa += below_a[j] * below_a[n - j]
            cc += below_c[j] * below_c[n - j]
        aa, cc, middle = 2.0 * aa, 2.0 * cc, n // 2
        if n % 2 == 0:
            aa += below_a[middle] * below_a[middle]
            cc += below_c[middle] * below_c[middle]
        square_a[n], square_c[n] = aa, cc
        gap[n] = at_rank * (below_a[n] - below_c[n] + (star if n == 0 else 0.0))
        qa, qaa, pc, pcc = q * below_a[n], q * aa, p * below_c[n], p * cc
        by_star[n] = p if n == 0 else 0.0
        by_stress[n] = 0.0
        if moving:
            wide = gap[0] * density[n]
            for j in range(1, n + 1):
                qa -= snapped[j] * below_a[n - j]
                qaa -= snapped[j] * square_a[n - j]
                pcc += snapped[j] * square_c[n - j]
                wide += gap[j] * density[n - j]
            if n > 0:  # all of the strain is in these parts
                pc = star * snapped[n] - qa - eps[n]
            width[n] = wide
            by_score, by_s = wide * score[0], wide
            for j in range(1, n + 1):
                by_score += score[j] * width[n - j]
                by_s -= s[j] * steep[n - j]
            steep[n] = by_s * per_s
            by_star[n], by_stress[n] = snapped[n], steep[n] * per_scale
            by_place[n], by_scale[n] = -wide * per_place, -by_score * per_scale
        by_k0[n], by_kc[n] = (qaa - qa) * per_k0, (pcc - pc) * per_kc
        by_stress[n] += qaa * per_k0 + pcc * per_kc
    return now[GAIN] / by_stress[0]


@inlined
def tangent_of_mixture(memory: Memory, k: int, i: int, moving: bool, slope: float, n: int) -> float:
    """Order n of the derivative of (1 + Σ g) s in direction k, but for what δε_n adds.

    `slope` is dΣ/dε.
    """
    d_s, soft, own = (
        memory.tangents[k, 0, i],
        memory.partials[BY_STRESS, i],
        memory.directions[k, 1],
    )
    even = odd = 0.0  # two sums at once
    if memory.directions[k, 0] == i and own < OWN_ETA:
        even = memory.partials[own, i, n]
    if not moving:
        odd = memory.partials[BY_RANK, i, n] * memory.ranks[k, i]
    for j in range(1, n, 2):
        even += soft[j] * d_s[n - j]
        odd += soft[j + 1] * d_s[n - j - 1]
    if n % 2 == 1:
        even += soft[n] * d_s[0]
    return -slope * (even + odd)


@inlined
def relaxed_tangent(memory: Memory, k: int, i: int, n: int) -> float:
    """Order n of the derivative of Σ z_k, and of g s at fixed s, in direction k."""
    total = 0.0
    for term in range(memory.z.shape[0]):
        total += memory.tangents[k, 1 + term, i, n]
        own = OWN_RELAXATION + 2 * term
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own:
            total += memory.series[EQ, i, n]
    return total


@inlined
def keep_tangent(memory: Memory, k: int, i: int, n: int, d_sig: float) -> None:
    """Write order n of the derivative of the equilibrium stress, and the next of what relaxes."""
    d_s = (d_sig - memory.now[i, BASE]) * (1.0 / memory.now[i, GAIN])  # waits for no quotient
    memory.tangents[k, 0, i, n] = d_s
    for term in range(memory.z.shape[0]):
        g, tau = memory.rows[i, N_COLUMNS + 2 * term], memory.rows[i, N_COLUMNS + 2 * term + 1]
        dz = memory.tangents[k, 1 + term, i]
        flow = dz[n] + g * d_s
        own = OWN_RELAXATION + 2 * term
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own:
            flow += memory.series[EQ, i, n]
        dz[n + 1] = -flow * (1.0 / (tau * (n + 1)))
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own + 1:
            dz[n + 1] -= memory.z[term, i, n + 1] * (1.0 / tau)


@inner
def advance_memory_tangents(memory: Memory, k: int, order: int, span: float) -> None:
    """Carry the derivatives in direction k of what relaxes over a step."""
    for term in range(memory.z.shape[0]):
        for i in range(memory.now.shape[0]):
            dz = memory.tangents[k, 1 + term, i]
            dz[0] = value_at(dz, order, span)
