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

from foamfit.solve.polynomial import value_at
from foamfit.springs.kernels import (
    BACK,
    BOTH,
    EPS_STAR,
    HELD,
    K0,
    KC,
    LOG_CROSS,
    LOG_MINUS,
    LOG_PLUS,
    N_COLUMNS,
    SNAP,
    SPREAD_MINUS,
    SPREAD_PLUS,
    A,
    Array,
    Branches,
    Row,
    inner,
    maker,
    piece,
)
from foamfit.springs.law import LEAST_RANK
from foamfit.springs.parameters import OWN_ETA, OWN_RELAXATION

# Rows of `Memory.series`: equilibrium stress s; 1 - a, 1 + eps_star - c; P; n u_n, u_n, φ, h.
EQ, BELOW_A, BELOW_C, SNAPPED, PACE, SCORE, DENSITY, BEND, N_MEMORY = range(9)
# Rows of `Memory.partials`: the derivatives of the strain at fixed stress by the seven parameters
# of the law, by p, and by the stress; then what these are made of.
BY_RANK, BY_STRESS, SQUARE_A, SQUARE_C, WIDTH, STEEP, N_PARTIALS = range(7, 14)
# Columns of `Memory.now`: equilibrium stress where the step starts; what is held, as a normal
# score, p and 1 - p; place and scale of the normal distribution that is followed; 1 + Σ g; dε/ds
# where the step starts, and dε/dΣ; what of a derivative of Σ is not the law's.
STRESS, RANK, FRACTION, REST, PLACE, SCALE, GAIN, GIVE, SOFT, BASE, N_NOW = range(11)
# A strain is past where a spring turned if it is so much larger, over itself.
MARGIN = 1e-13
ROOT_HALF = math.sqrt(0.5)
DENSITY_0 = 1.0 / math.sqrt(2.0 * math.pi)


class Memory(NamedTuple):
    """What springs remember, and its series and derivatives.

    rows (springs, columns) are the springs, now (springs, N_NOW) the numbers above, series
    (N_MEMORY, springs, order + 2), z (terms, springs, order + 2) the relaxation. `partials`
    (N_PARTIALS, springs, order + 2) are filled where derivatives are wanted; of these, in p
    `directions` (p, 2), `ranks` (p, springs) are those of the normal scores and `tangents`
    (p, 1 + terms, springs, order + 2) the series of ε less its change at fixed stress, and of z.
    """

    rows: Array
    now: Array
    series: Array
    z: Array
    partials: Array
    directions: Branches
    ranks: Array
    tangents: Array


@maker
def make_memory(rows: Array, order: int, directions: Branches) -> Memory:
    """Make the memory of springs at rest."""
    count, terms, size = rows.shape[0], (rows.shape[1] - N_COLUMNS) // 2, directions.shape[0]
    memory = Memory(
        rows,
        np.zeros((count, N_NOW)),
        np.zeros((N_MEMORY, count, order + 2)),
        np.zeros((terms, count, order + 2)),
        np.zeros((N_PARTIALS, count, order + 2)),
        directions,
        np.zeros((size, count)),
        np.zeros((size, 1 + terms, count, order + 2)),
    )
    for i in range(count):
        gain = 1.0
        for k in range(terms):
            gain += rows[i, N_COLUMNS + 2 * k]
        memory.now[i, GAIN] = gain
    return memory


# ---------------------------------------------------------------- the law


@inner
def _strain_and_slope(row: Row, now: Row, moving: bool, s: float) -> tuple[float, float]:
    """Strain of a microscale spring at the stress s > 0, and its slope dε/ds."""
    a, c, p, q, steep = 1.0 / (row[K0] + s), 1.0 / (row[KC] + s), now[FRACTION], now[REST], 0.0
    if moving:
        u = (math.log(s) - now[PLACE]) / now[SCALE]
        p, q = 0.5 * math.erfc(-ROOT_HALF * u), 0.5 * math.erfc(ROOT_HALF * u)
        steep = DENSITY_0 * math.exp(-0.5 * u * u) / (now[SCALE] * s)
    strain = q * s * a + p * (row[EPS_STAR] + s * c)
    gap = row[EPS_STAR] + s * (c - a)
    return strain, q * row[K0] * a * a + p * row[KC] * c * c + gap * steep


@piece
def stress_of_mixture(row: Row, now: Row, moving: bool, eps: float) -> float:
    """Stress at a strain: guarded Newton from where the last step led; infinite at the pole."""
    s, low, high = now[STRESS], 0.0, math.inf
    for _ in range(400):
        value, slope = _strain_and_slope(row, now, moving, s)
        if value > eps:
            high = s
        else:
            low = s
        trial = s - (value - eps) / slope
        if abs(trial - s) <= 1e-10 * s:  # its error is squared
            return trial
        if not low < trial < high:
            trial = 2.0 * s if high == math.inf else 0.5 * (low + high)
            if trial in (low, high):
                return s
        if trial > 1e290:
            break
        s = trial
    return math.inf


@inner
def is_hysteretic(row: Row, log_s: float, ahead: float) -> bool:
    """Whether snap-back of a rank lies below its snap-through, a little `ahead` (±1) of a stress.

    So it is below the stress at which both meet where spread_minus >= spread_plus, else above.
    """
    beyond = log_s - row[LOG_CROSS]
    if beyond == 0.0:
        beyond = ahead
    return beyond < 0.0 if row[SPREAD_MINUS] >= row[SPREAD_PLUS] else beyond > 0.0


@inner
def _limits(row: Row, branch: int, rank: float) -> tuple[float, float]:
    """Logarithms of the stresses (low, high) at which a microscale spring leaves a branch.

    Below LEAST_RANK it counts as virgin, above -LEAST_RANK as wholly snapped.
    """
    cross = row[LOG_CROSS]
    steeper = row[SPREAD_MINUS] >= row[SPREAD_PLUS]  # then it is hysteretic below the crossing
    least, most = row[LOG_PLUS] + row[SPREAD_PLUS] * LEAST_RANK, math.inf
    if branch == A:
        return -math.inf, least
    if branch == HELD:
        at_plus = row[LOG_PLUS] + row[SPREAD_PLUS] * rank
        at_minus = row[LOG_MINUS] + row[SPREAD_MINUS] * rank
        return min(at_plus, at_minus), (at_plus if rank < -LEAST_RANK else math.inf)
    most = row[LOG_PLUS] - row[SPREAD_PLUS] * LEAST_RANK
    if branch == SNAP:
        return -math.inf, (min(most, cross) if steeper else most)
    if branch == BACK:
        least = row[LOG_MINUS] + row[SPREAD_MINUS] * LEAST_RANK
        return (least if steeper else max(least, cross)), math.inf
    return (max(least, cross) if steeper else least), (most if steeper else min(most, cross))


@inner
def next_branch(row: Row, branch: int, rank: float, side: int) -> int:
    """Branch that a microscale spring enters at the end of its branch, above (1) or below (-1)."""
    low, high = _limits(row, branch, rank)
    at = high if side > 0 else low
    if branch in (SNAP, BACK, BOTH) and at != row[LOG_CROSS]:
        return HELD if side > 0 else A
    if is_hysteretic(row, at, side):
        return SNAP if side > 0 else BACK
    return BOTH


@inner
def end_of_virgin(row: Row) -> float:
    """Strain at which a virgin microscale spring leaves branch a."""
    s = math.exp(_limits(row, A, 0.0)[1])
    return s / (row[K0] + s)


@inner
def enter_mixture(memory: Memory, i: int, branch: int) -> tuple[float, float]:
    """Write the branch, other than a, that a microscale spring enters; strains of its ends."""
    row, now = memory.rows[i], memory.now[i]
    back, rank, moving = branch == BACK, now[RANK], branch != HELD
    now[PLACE] = row[LOG_MINUS] if back else row[LOG_PLUS]
    now[SCALE] = row[SPREAD_MINUS] if back else row[SPREAD_PLUS]
    now[FRACTION] = 0.5 * math.erfc(-ROOT_HALF * rank)
    now[REST] = 0.5 * math.erfc(ROOT_HALF * rank)
    for own in range(3, OWN_ETA):
        for n in range(memory.partials.shape[2]):
            memory.partials[own, i, n] = 0.0
    low, high = _limits(row, branch, rank)
    first, last = -math.inf, math.inf
    if low > -math.inf:
        first = _strain_and_slope(row, now, moving, math.exp(low))[0]
    if high < math.inf:
        last = _strain_and_slope(row, now, moving, math.exp(high))[0]
    if not moving:
        first, last = first * (1.0 - MARGIN), last * (1.0 + MARGIN)
    return first, last


@inner
def leave(memory: Memory, i: int, branch: int, side: int) -> None:
    """Write the stress, and a full rank, with which a microscale spring leaves a branch's end."""
    now = memory.now[i]
    low, high = _limits(memory.rows[i], branch, now[RANK])
    now[STRESS] = math.exp(high if side > 0 else low)
    if branch in (SNAP, BOTH) and side > 0:
        now[RANK] = -LEAST_RANK
        for p in range(memory.directions.shape[0]):
            memory.ranks[p, i] = 0.0


@inner
def hold(memory: Memory, i: int, branch: int, eps: float, d: Array) -> None:
    """Keep the rank at which a microscale spring turns, and its derivatives.

    d (p, springs) holds those of the strain. Where the stress turns they do not feel when it does.
    """
    row, now = memory.rows[i], memory.now[i]
    s = stress_of_mixture(row, now, True, eps)
    u = (math.log(s) - now[PLACE]) / now[SCALE]
    soft = _strain_and_slope(row, now, True, s)[1]
    p, q = 0.5 * math.erfc(-ROOT_HALF * u), 0.5 * math.erfc(ROOT_HALF * u)
    a, c = 1.0 / (row[K0] + s), 1.0 / (row[KC] + s)
    steep = DENSITY_0 * math.exp(-0.5 * u * u) / now[SCALE] * (row[EPS_STAR] + s * (c - a))
    now[STRESS], now[RANK] = s, u
    place = 5 if branch == BACK else 3
    for k in range(memory.directions.shape[0]):
        own = memory.directions[k, 1] if memory.directions[k, 0] == i else OWN_ETA
        change, moved = d[k, i], 0.0
        if own == 0:
            change += q * s * a * a
        elif own == 1:
            change += p * s * c * c
        elif own == 2:
            change -= p
        elif own == place:
            moved = math.exp(-now[PLACE])
        elif own == place + 1:
            moved = u
        change += steep * moved
        memory.ranks[k, i] = (change / (soft * s) - moved) / now[SCALE]


@inner
def loaded_branch(memory: Memory, i: int, eps: float) -> int:
    """Branch of a microscale spring that was loaded from rest to a strain in one go."""
    row, now = memory.rows[i], memory.now[i]
    if eps <= end_of_virgin(row):
        return A
    now[STRESS] = math.exp(_limits(row, A, 0.0)[1])
    enter_mixture(memory, i, SNAP)
    s = stress_of_mixture(row, now, True, eps)
    now[STRESS] = s
    if s >= math.exp(now[PLACE] - LEAST_RANK * now[SCALE]):
        now[RANK] = -LEAST_RANK
        return HELD
    return SNAP if is_hysteretic(row, math.log(s), 1.0) else BOTH


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
    row, now, m = memory.rows[i], memory.now[i], memory.series
    s = stress_of_mixture(row, now, moving, eps)
    now[STRESS] = s
    below_a, below_c = row[K0] / (row[K0] + s), row[KC] / (row[KC] + s)
    m[BELOW_A, i, 0], m[BELOW_C, i, 0] = below_a, below_c
    steep = 0.0
    if moving:
        u = (math.log(s) - now[PLACE]) / now[SCALE]
        now[FRACTION], now[REST] = 0.5 * math.erfc(-ROOT_HALF * u), 0.5 * math.erfc(ROOT_HALF * u)
        density = DENSITY_0 * math.exp(-0.5 * u * u)
        m[SCORE, i, 0], m[DENSITY, i, 0], m[BEND, i, 0] = u, density, u * density
        steep = density / (now[SCALE] * s)
    m[SNAPPED, i, 0] = now[FRACTION]
    now[GIVE] = (
        now[REST] * below_a / (row[K0] + s)
        + now[FRACTION] * below_c / (row[KC] + s)
        + (row[EPS_STAR] + below_a - below_c) * steep
    )
    return s


@inner
def strain_of_mixture(memory: Memory, i: int, moving: bool, n: int) -> float:
    """Order n >= 1 of the strain of a microscale spring, but for what that of its stress adds.

    All series are filled as if that were zero.
    """
    row, now, m = memory.rows[i], memory.now[i], memory.series
    s, below_a, below_c = m[EQ, i], m[BELOW_A, i], m[BELOW_C, i]
    p, q = now[FRACTION], now[REST]
    by_a = by_c = 0.0
    if not moving:
        for j in range(1, n):
            by_a += s[j] * below_a[n - j]
            by_c += s[j] * below_c[n - j]
        below_a[n], below_c[n] = -by_a / (row[K0] + s[0]), -by_c / (row[KC] + s[0])
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
    below_a[n], below_c[n] = -by_a / (row[K0] + s[0]), -by_c / (row[KC] + s[0])
    pace[n] = -by_s / s[0]
    score[n] = pace[n] / n
    snapped[n] = (pace[n] * density[0] + by_density) / n
    density[n] = -(pace[n] * bend[0] + by_bend) / n
    bend[n] = products
    gap = row[EPS_STAR] + below_a[0] - below_c[0]
    return snapped[n] * gap - q * below_a[n] - p * below_c[n] + parts


@inner
def finish_mixture(memory: Memory, i: int, moving: bool, n: int, s_n: float) -> None:
    """Add to the series what order n >= 1 of the stress adds."""
    row, now, m = memory.rows[i], memory.now[i], memory.series
    s = m[EQ, i, 0]
    m[BELOW_A, i, n] -= s_n * m[BELOW_A, i, 0] / (row[K0] + s)
    m[BELOW_C, i, n] -= s_n * m[BELOW_C, i, 0] / (row[KC] + s)
    if moving:
        more = s_n / (now[SCALE] * s)
        m[PACE, i, n] += n * more
        m[SCORE, i, n] += more
        m[SNAPPED, i, n] += m[DENSITY, i, 0] * more
        m[DENSITY, i, n] -= m[BEND, i, 0] * more
        m[BEND, i, n] += m[SCORE, i, 0] * m[DENSITY, i, n] + m[SCORE, i, n] * m[DENSITY, i, 0]


@inner
def relaxed(memory: Memory, i: int, n: int) -> float:
    """Order n of Σ z_k of a spring."""
    total = 0.0
    for k in range(memory.z.shape[0]):
        total += memory.z[k, i, n]
    return total


@inner
def keep(memory: Memory, i: int, n: int, s_n: float) -> None:
    """Write order n of a spring's equilibrium stress, and what relaxes in the next."""
    memory.series[EQ, i, n] = s_n
    for k in range(memory.z.shape[0]):
        g, tau = memory.rows[i, N_COLUMNS + 2 * k], memory.rows[i, N_COLUMNS + 2 * k + 1]
        memory.z[k, i, n + 1] = -(memory.z[k, i, n] + g * s_n) / (tau * (n + 1))


@inner
def longest(memory: Memory, i: int, span: float) -> float:
    """Longest step, within `span`, over which a stress whose logarithm counts stays of one size."""
    s = memory.series[EQ, i]
    for _ in range(60):
        if (abs(s[1]) + (abs(s[2]) + abs(s[3]) * span) * span) * span <= s[0]:
            break
        span *= 0.75
    return span


@inner
def advance_memory(memory: Memory, order: int, span: float) -> None:
    """Carry what relaxes over a step, and where the search for the stress starts."""
    for i in range(memory.now.shape[0]):
        reached = value_at(memory.series[EQ, i], order, span)
        memory.now[i, STRESS] = reached if reached > 0.0 else memory.now[i, STRESS]
        for k in range(memory.z.shape[0]):
            memory.z[k, i, 0] = value_at(memory.z[k, i], order, span)


# ---------------------------------------------------------------- its derivatives


@inner
def fill_partials(memory: Memory, i: int, moving: bool, back: bool, tilt: Array, order: int) -> None:
    """Fill the derivatives of a spring's strain at fixed stress, and `tilt`, those dσ/dε."""
    row, now, m, out = memory.rows[i], memory.now[i], memory.series, memory.partials
    s, below_a, below_c = m[EQ, i], m[BELOW_A, i], m[BELOW_C, i]
    snapped, score, density = m[SNAPPED, i], m[SCORE, i], m[DENSITY, i]
    square_a, square_c, width = out[SQUARE_A, i], out[SQUARE_C, i], out[WIDTH, i]
    gap, by_stress, steep = out[BY_RANK, i], out[BY_STRESS, i], out[STEEP, i]
    by_place, by_scale = out[5 if back else 3, i], out[6 if back else 4, i]
    per_k0, per_kc, per_scale = 1.0 / row[K0], 1.0 / row[KC], 1.0 / now[SCALE]
    per_place = per_scale * math.exp(-now[PLACE])
    p, q = now[FRACTION], now[REST]
    for n in range(order + 1):
        aa = cc = 0.0
        for j in range(n + 1):
            aa += below_a[j] * below_a[n - j]
            cc += below_c[j] * below_c[n - j]
        square_a[n], square_c[n] = aa, cc
        gap[n] = below_a[n] - below_c[n]
        qa, qaa, pc, pcc = q * below_a[n], q * aa, p * below_c[n], p * cc
        out[2, i, n] = p if n == 0 else 0.0
        if n == 0:
            gap[0] += row[EPS_STAR]
        if moving:
            wide = gap[0] * density[n] if n > 0 else 0.0
            for j in range(1, n + 1):
                qa -= snapped[j] * below_a[n - j]
                qaa -= snapped[j] * square_a[n - j]
                pc += snapped[j] * below_c[n - j]
                pcc += snapped[j] * square_c[n - j]
                wide += gap[j] * density[n - j]
            width[n] = wide if n > 0 else gap[0] * density[0]
            by_score, by_s = width[n] * score[0], width[n]
            for j in range(1, n + 1):
                by_score += score[j] * width[n - j]
                by_s -= s[j] * steep[n - j]
            steep[n] = by_s / s[0]
            out[2, i, n] = snapped[n]
            by_place[n], by_scale[n] = -width[n] * per_place, -by_score * per_scale
        out[0, i, n], out[1, i, n] = (qaa - qa) * per_k0, (pcc - pc) * per_kc
        by_stress[n] = qaa * per_k0 + pcc * per_kc
        if moving:
            by_stress[n] += steep[n] * per_scale
        known = 0.0
        for j in range(1, n + 1):
            known += by_stress[j] * tilt[n - j]
        tilt[n] = (now[GAIN] if n == 0 else -known) / by_stress[0]
    if not moving:
        at_rank = DENSITY_0 * math.exp(-0.5 * now[RANK] * now[RANK])
        for n in range(order + 1):
            gap[n] *= at_rank


@inner
def tangent_of_mixture(
    memory: Memory, k: int, i: int, moving: bool, tilt: Array, n: int
) -> float:
    """Order n of the derivative of (1 + Σ g) s in direction k, but for the term T_0 δε_n."""
    out, own = memory.tangents[k, 0, i], memory.directions[k, 1]
    change = 0.0
    if memory.directions[k, 0] == i and own < OWN_ETA:
        change = memory.partials[own, i, n]
    if not moving:
        change += memory.partials[BY_RANK, i, n] * memory.ranks[k, i]
    out[n] = -change
    known = -tilt[0] * change
    for j in range(n):
        known += out[j] * tilt[n - j]
    return known


@inner
def relaxed_tangent(memory: Memory, k: int, i: int, n: int) -> float:
    """Order n of the derivative of Σ z_k, and of g s at fixed s, in direction k."""
    total = 0.0
    for term in range(memory.z.shape[0]):
        total += memory.tangents[k, 1 + term, i, n]
        if memory.directions[k, 0] == i:
            if memory.directions[k, 1] == OWN_RELAXATION + 2 * term:
                total += memory.series[EQ, i, n]
    return total


@inner
def keep_tangent(memory: Memory, k: int, i: int, n: int, d_eps: float, d_sig: float) -> None:
    """Go on with the derivatives of what relaxes from those of strain and stress of order n."""
    memory.tangents[k, 0, i, n] += d_eps
    d_s = (d_sig - memory.now[i, BASE]) / memory.now[i, GAIN]
    for term in range(memory.z.shape[0]):
        g, tau = memory.rows[i, N_COLUMNS + 2 * term], memory.rows[i, N_COLUMNS + 2 * term + 1]
        dz = memory.tangents[k, 1 + term, i]
        flow = dz[n] + g * d_s
        own = OWN_RELAXATION + 2 * term
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own:
            flow += memory.series[EQ, i, n]
        dz[n + 1] = -flow / (tau * (n + 1))
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own + 1:
            dz[n + 1] -= memory.z[term, i, n + 1] / tau


@inner
def advance_memory_tangents(memory: Memory, k: int, order: int, span: float) -> None:
    """Carry the derivatives in direction k of what relaxes over a step."""
    for term in range(memory.z.shape[0]):
        for i in range(memory.now.shape[0]):
            dz = memory.tangents[k, 1 + term, i]
            dz[0] = value_at(dz, order, span)
