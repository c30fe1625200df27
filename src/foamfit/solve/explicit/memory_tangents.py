"""The derivatives by parameters of springs with memory, along their Taylor series in time.

They are those of the strain at a fixed stress; the recurrences of `explicit.memory`, linearised.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math

from foamfit.solve.explicit.memory import (
    BASE,
    BELOW_A,
    BELOW_C,
    BY_EVER,
    BY_N,
    BY_N_FRESH,
    BY_RANK,
    BY_STRESS,
    D_EQ,
    DENSITY,
    EQ,
    FRACTION,
    FRESH,
    GAIN,
    K_MAIN,
    LEFT,
    LOG,
    N_MEMORY,
    N_TANGENTS,
    PER_GAIN,
    PLACE,
    SCALE,
    SCORE,
    SNAPPED,
    SQUARE_A,
    SQUARE_C,
    SQUARE_FRESH,
    STEEP,
    UNSNAPPED,
    WIDTH,
    Memory,
    stands,
)
from foamfit.solve.polynomial import value_at
from foamfit.springs.kernels import (
    AGAIN,
    BACK,
    BOTH,
    EPS_STAR,
    ETA,
    K0,
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
)
from foamfit.springs.law import BISTABLE, MICROSCALE
from foamfit.springs.parameters import OWN_ETA, OWN_RELAXATION
from foamfit.springs.ranks import (
    BRANCH,
    EVER,
    OF_SOFTENING,
    OF_STIFFENING,
    OF_WEAKENING,
    RANK,
    density,
)


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
def _fill_partials_remembering(memory: Memory, i: int, moving: bool, order: int) -> float:
    """Fill the same of a spring that remembers what has snapped."""
    row, now, m, out = memory.rows[i], memory.now[i], memory.series[i], memory.partials
    state, n, star = memory.state[i], row[STIFFENING], row[EPS_STAR]
    branch, k, never = int(state[BRANCH]), now[K_MAIN], now[UNSNAPPED]
    s, below, below_c, fresh = m[:, EQ], m[:, BELOW_A], m[:, BELOW_C], m[:, FRESH]
    snapped, score, dense = m[:, SNAPPED], m[:, SCORE], m[:, DENSITY]
    square, square_c, hard = out[SQUARE_A, i], out[SQUARE_C, i], out[SQUARE_FRESH, i]
    gap, wide, steep = out[BY_RANK, i], out[WIDTH, i], out[STEEP, i]
    _fill_of_a(s, below, k, n, square, out[LOG, i], out[BY_N, i], order)
    if never > 0.0:
        _fill_of_a(s, fresh, row[K0], n, hard, out[LOG, i], out[BY_N_FRESH, i], order)
    at_rank = 1.0 if moving else density(state[RANK])
    at_ever = density(state[EVER]) if never > 0.0 else 0.0
    first = 5 if branch == BACK else 3
    place = row[LOG_MINUS] if branch == BACK else row[LOG_PLUS]
    per_scale, per_place = 1.0 / now[SCALE], math.exp(-place) / now[SCALE]
    for o in range(order + 1):
        cc = 0.0
        for j in range(o + 1):
            cc += below_c[j] * below_c[o - j]
        square_c[o] = cc
        gap[o] = at_rank * (below[o] - below_c[o] + (star if o == 0 else 0.0))
        worn, p = now[LEFT] - never, now[FRACTION]
        on_a, soft = worn * (below[o] - square[o]), worn * square[o]
        by_n, on_c, soft_c = worn * out[BY_N, i, o], p * (below_c[o] - cc), p * cc
        if moving:
            width = gap[0] * dense[o]
            for j in range(1, o + 1):
                on_a -= snapped[j] * (below[o - j] - square[o - j])
                soft -= snapped[j] * square[o - j]
                by_n -= snapped[j] * out[BY_N, i, o - j]
                on_c += snapped[j] * (below_c[o - j] - square_c[o - j])
                soft_c += snapped[j] * square_c[o - j]
                width += gap[j] * dense[o - j]
            wide[o] = width
            by_score, by_s = width * score[0], width
            for j in range(1, o + 1):
                by_score += score[j] * wide[o - j]
                by_s -= s[j] * steep[o - j]
            steep[o] = by_s / s[0]
            out[first, i, o], out[first + 1, i, o] = -width * per_place, -by_score * per_scale
            if branch in (AGAIN, BOTH):
                out[OF_WEAKENING, i, o] = width * per_scale
        out[OF_SOFTENING, i, o] = on_a / n if never > 0.0 else 0.0
        out[2, i, o] = snapped[o] if moving else (p if o == 0 else 0.0)
        out[BY_EVER, i, o] = 0.0
        if never > 0.0:
            on_a += never * (fresh[o] - hard[o])
            by_n += never * out[BY_N_FRESH, i, o]
            out[BY_EVER, i, o] = at_ever * (fresh[o] - below[o])
        out[0, i, o], out[1, i, o] = -on_a / (n * row[K0]), -on_c / row[KC]
        out[OF_STIFFENING, i, o] = by_n
        out[BY_STRESS, i, o] = soft / k + soft_c / row[KC]
        out[BY_STRESS, i, o] += never * hard[o] / row[K0] if never > 0.0 else 0.0
        out[BY_STRESS, i, o] += steep[o] * per_scale if moving else 0.0
    return now[GAIN] / out[BY_STRESS, i, 0]


@inner
def fill_partials(
    memory: Memory, i: int, moving: bool, back: bool, eps: Array, order: int
) -> float:
    """Fill the derivatives of a spring's strain at fixed stress; returns the slope dΣ/dε now."""
    if memory.rows[i, REMEMBERS] > 0.0 and memory.rows[i, KIND] == MICROSCALE:
        return _fill_partials_remembering(memory, i, moving, order)
    row, now, m, out = memory.rows[i], memory.now[i], memory.series[i], memory.partials
    s, below_a, below_c = m[:, EQ], m[:, BELOW_A], m[:, BELOW_C]
    snapped, score, dense = m[:, SNAPPED], m[:, SCORE], m[:, DENSITY]
    square_a, square_c, width = out[SQUARE_A, i], out[SQUARE_C, i], out[WIDTH, i]
    gap, by_stress, steep = out[BY_RANK, i], out[BY_STRESS, i], out[STEEP, i]
    by_k0, by_kc, by_star = out[0, i], out[1, i], out[2, i]
    by_place, by_scale = out[5 if back else 3, i], out[6 if back else 4, i]
    per_k0, per_kc, per_scale, per_s = 1.0 / row[K0], 1.0 / row[KC], 1.0 / now[SCALE], 1.0 / s[0]
    per_place = per_scale * math.exp(-now[PLACE])
    p, q, star = now[FRACTION], now[LEFT], row[EPS_STAR]
    at_rank = 1.0 if moving else density(memory.state[i, RANK])
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
            wide = gap[0] * dense[n]
            for j in range(1, n + 1):
                qa -= snapped[j] * below_a[n - j]
                qaa -= snapped[j] * square_a[n - j]
                pcc += snapped[j] * square_c[n - j]
                wide += gap[j] * dense[n - j]
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
    d_s = memory.tangents[k, i, D_EQ]
    soft, own = memory.partials[BY_STRESS, i], memory.directions[k, 1]
    even = odd = 0.0  # two sums at once
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
    """Order n of the derivative of Σ z_k, and of g s at fixed s, in direction k."""
    total = 0.0
    for term in range(memory.series.shape[2] - N_MEMORY):
        total += memory.tangents[k, i, N_TANGENTS + term, n]
        own = OWN_RELAXATION + 2 * term
        if memory.directions[k, 0] == i and memory.directions[k, 1] == own:
            total += memory.series[i, n, EQ]
    return total


@inlined
def keep_tangent(memory: Memory, k: int, i: int, n: int, d_sig: float) -> None:
    """Write order n of the derivative of the equilibrium stress, and the next of what relaxes."""
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
def advance_memory_tangents(memory: Memory, k: int, order: int, span: float) -> None:
    """Carry the derivatives in direction k of what relaxes over a step."""
    for i in range(memory.now.shape[0]):
        for term in range(memory.series.shape[2] - N_MEMORY):
            dz = memory.tangents[k, i, N_TANGENTS + term]
            dz[0] = value_at(dz, order, span)


@inner
def _is_flat(row: Row, branch: int) -> bool:
    """Whether a spring is on a flat branch that nothing slows."""
    slope = row[KH_PLUS] if branch == D else row[KH_MINUS] if branch == E else 1.0
    return row[KIND] == BISTABLE and slope == 0.0 and row[ETA] == 0.0


@inner
def mark_one_sided(
    memory: Memory, branches: Branches, eps: Array, series: Array, order: int, span: float
) -> None:
    """Mark the directions that would move a spring that snaps and stands still, or a plateau.

    One way of the parameter the spring snaps on, the other way it is held; of several springs on
    flat branches one goes first: there are two derivatives. `eps` and `series` (p, springs, …) are
    the series of the strains, and their derivatives.
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
