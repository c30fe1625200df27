"""Taylor series in time of the derivatives of a chain by parameters.

Their recurrence is that of `explicit.series`, linearised about the motion. With the series T of the
slope dσ/dε,

    δσ_n = Σ_j T_{n-j} δx_j + (∂σ/∂k)_n δk,      x = ε - x0.

The law is continuous at its switches, so the derivatives do not jump there.
"""

from __future__ import annotations

from foamfit.solve.explicit.memory import (
    BASE,
    EQ,
    GAIN,
    N_MEMORY,
    N_TANGENTS,
    RELAXED,
    Memory,
    fill_partials,
    keep_tangent,
    relaxed_tangent,
    tangent_of_mixture,
)
from foamfit.solve.explicit.series import (
    CURVED,
    DASHPOT,
    EPS,
    GROUP,
    HEIGHT,
    OFFSET,
    ORIGIN,
    SIG,
    SLOPE,
    TILT,
    Links,
    SeriesTangents,
    V,
    W,
    _stress_term,
    advance,
    product,
    springs_of,
)
from foamfit.solve.polynomial import value_at
from foamfit.solve.scene import FREE, STRESS, VISCOUS
from foamfit.springs.kernels import HELD, N_COLUMNS, Array, inlined, inner, once, piece
from foamfit.springs.parameters import OWN_ETA, OWN_RELAXATION


@inner
def _fill_tilt(law: Array, i: int, sig: Array, tilt: Array, order: int) -> None:
    """Fill the series T of dσ/dε: k on a straight branch, (k + σ)²/k on a curved one."""
    k = law[i, SLOPE]
    tilt[i, 0] = k
    if law[i, CURVED] == 0.0:
        for n in range(1, order + 1):
            tilt[i, n] = 0.0
        return
    stiff = k + sig[i, 0]
    tilt[i, 0] = stiff * stiff / k
    for n in range(1, order + 1):
        tilt[i, n] = (2.0 * stiff * sig[i, n] + product(sig, sig, i, n)) / k


@inlined
def _known_tangent(
    law: Array, s: Array, m: Array, d: Array, i: int, n: int, memory: Memory | None, p: int
) -> float:
    """Return order n of δσ of a spring in direction p, without the term T_0 δε_n."""
    eps, sig, tilt, gain = s[EPS], s[SIG], s[TILT], 1.0
    if memory is not None:
        sig, gain = memory.series[:, :, EQ], memory.now[i, GAIN]
    known = -tilt[i, n] * m[i, ORIGIN]
    if law[i, CURVED] == 0.0:
        known += gain * (eps[i, n] - (law[i, ORIGIN] if n == 0 else 0.0)) * m[i, SLOPE]
        known += gain * m[i, OFFSET] if n == 0 else 0.0
    elif law[i, CURVED] < HELD:
        known += gain * sig[i, n] / law[i, SLOPE] * m[i, SLOPE]
        if n > 0:
            known += d[EPS, i, 0] * tilt[i, n] + product(d[EPS], tilt, i, n)
    if memory is not None:
        if law[i, CURVED] >= HELD:
            known = tangent_of_mixture(memory, p, i, law[i, CURVED] > HELD, tilt[i, 0], n)
        memory.now[i, BASE] = relaxed_tangent(memory, p, i, n)
        known += memory.now[i, BASE]
    if law[i, DASHPOT] == 0.0 and n + 2 < tilt.shape[1]:  # derivative by a zero dashpot
        known += (n + 1) * eps[i, n + 1] * m[i, DASHPOT]
        if memory is not None:
            memory.now[i, BASE] += (n + 1) * eps[i, n + 1] * m[i, DASHPOT]
    return known


@inner
def _share_tangent(
    law: Array, tilt: Array, d: Array, i0: int, i1: int, rest: float, n: int
) -> float:
    """Return order n of the derivative of a group's stress if some springs have no dashpot.

    `rest` is the derivative of the elongation at fixed strains. The δε and δσ of the springs are
    filled from the known parts in d[SIG].
    """
    eps, sig = d[EPS], d[SIG]
    compliance, flat = 0.0, -1
    for i in range(i0, i1):
        if law[i, DASHPOT] > 0.0:
            rest -= law[i, HEIGHT] * eps[i, n]
        elif tilt[i, 0] > 0.0:
            compliance += law[i, HEIGHT] / tilt[i, 0]
            rest += law[i, HEIGHT] / tilt[i, 0] * sig[i, n]
        elif flat < 0:
            flat = i
    common = sig[flat, n] if flat >= 0 else rest / compliance
    for i in range(i0, i1):
        if law[i, DASHPOT] == 0.0 and i != flat:
            soft = 1.0 / tilt[i, 0] if tilt[i, 0] > 0.0 else 0.0
            eps[i, n] = (common - sig[i, n]) * soft
            sig[i, n] = common
    if flat >= 0:  # the flat branch takes up the remaining elongation
        eps[flat, n] = (rest - common * compliance) / law[flat, HEIGHT]
    return common


@inner
def _damped_tangent(
    links: Links, s: Array, m: Array, drag: float, d: Array, g: int, i0: int, i1: int, n: int
) -> float:
    """Return order n of the derivative of `_damped_term`."""
    law, viscous = links.law, g == links.ends.size - 1 and links.top == VISCOUS
    total, weight = (0.0 if viscous else d[V, g, n]), 0.0
    if g > 0:
        total -= d[V, g - 1, n]
    if viscous:  # v of the top is (push - Σ)/drag
        total -= s[V, g, n] / links.drag * drag
        weight = 1.0 / links.drag
    for i in range(i0, i1):
        share = law[i, HEIGHT] / law[i, DASHPOT]
        change = (m[i, HEIGHT] - share * m[i, DASHPOT]) / law[i, DASHPOT]
        total += share * d[SIG, i, n] + change * (s[SIG, i, n] - s[GROUP, g, n])
        weight += share
    return total / weight


@inlined
def _group_tangent(
    links: Links,
    s: Array,
    m: Array,
    drag: float,
    d: Array,
    g: int,
    n: int,
    memory: Memory | None,
    p: int,
) -> None:
    """Fill order n of the derivatives of a group's stress and of strains that are not states."""
    law, tilt = links.law, s[TILT]
    i0, i1 = springs_of(links.ends, g)
    stressed = g == links.ends.size - 1 and links.top == STRESS
    rest = d[W, g, n] - (d[W, g - 1, n] if g > 0 else 0.0)
    single = i1 - i0 == 1 and not stressed
    damped = 0
    for i in range(i0, i1):
        damped += law[i, DASHPOT] > 0.0
        rest -= s[EPS, i, n] * m[i, HEIGHT]
        known = _known_tangent(law, s, m, d, i, n, memory, p)
        if single:
            d[EPS, i, n] = rest * (1.0 / law[i, HEIGHT])
        elif stressed and law[i, DASHPOT] == 0.0:
            d[EPS, i, n] = -known / tilt[i, 0]
        if single or stressed or law[i, DASHPOT] > 0.0:
            known += tilt[i, 0] * d[EPS, i, n]
        d[SIG, i, n] = known
    if stressed:
        d[GROUP, g, n] = 0.0
    elif damped == i1 - i0:
        d[GROUP, g, n] = _damped_tangent(links, s, m, drag, d, g, i0, i1, n)
    elif single:
        d[GROUP, g, n] = d[SIG, i0, n]
    else:
        d[GROUP, g, n] = _share_tangent(law, tilt, d, i0, i1, rest, n)


@once
def _expand_tangent(
    links: Links,
    s: Array,
    m: Array,
    drag: float,
    d: Array,
    order: int,
    memory: Memory | None,
    p: int,
) -> None:
    """Fill the derivatives in direction p, with changes `m` and `drag`, up to `order`."""
    law, last = links.law, links.ends.size - 1
    w, v = d[W], d[V]
    for n in range(order + 1):
        share = 1.0 / (n + 1)
        for g in range(last + 1):
            _group_tangent(links, s, m, drag, d, g, n, memory, p)
            i0, i1 = springs_of(links.ends, g)
            if memory is not None:
                for i in range(i0, i1):
                    keep_tangent(memory, p, i, n, d[SIG, i, n])
            if i1 - i0 > 1 or (g == last and links.top == STRESS):
                for i in range(i0, i1):
                    if law[i, DASHPOT] > 0.0:
                        flow = (s[GROUP, g, n] - s[SIG, i, n]) / law[i, DASHPOT]
                        net = d[GROUP, g, n] - d[SIG, i, n] - flow * m[i, DASHPOT]
                        d[EPS, i, n + 1] = net * share / law[i, DASHPOT]
        for g in range(last + 1):
            net = -d[GROUP, g, n]
            if g < last:
                net += d[GROUP, g + 1, n]
            elif links.top == VISCOUS:
                v[g, n] = (net - s[V, g, n] * drag) / links.drag
            elif links.drag > 0.0 or drag != 0.0:
                net -= links.drag * v[g, n] + s[V, g, n] * drag
            if g < last or links.top == FREE:
                v[g, n + 1] = net * (share / links.mass[g])
            if g < last or links.top in (FREE, VISCOUS):
                w[g, n + 1] = v[g, n] * share


@piece
def expand_tangents(
    links: Links, s: Array, d: SeriesTangents, order: int, memory: Memory | None
) -> None:
    """Fill the derivatives up to `order`, after `expand`; skip those that are still zero."""
    for i in range(links.law.shape[0]):
        if memory is None:
            _fill_tilt(links.law, i, s[SIG], s[TILT], order)
        else:
            kind = links.law[i, CURVED]
            if kind >= HELD:
                s[TILT, i, 0] = fill_partials(memory, i, kind > HELD, s[EPS, i], order)
            else:
                _fill_tilt(links.law, i, memory.series[:, :, EQ], s[TILT], order)
                for n in range(order + 1):
                    s[TILT, i, n] *= memory.now[i, GAIN]
    for p in range(d.drag.size):
        if d.live[p] > 0.0:
            _expand_tangent(links, s, d.law[p], d.drag[p], d.series[p], order, memory, p)


@inner
def start_relaxing(law: Array, i: int, s: Array, d: SeriesTangents, memory: Memory) -> None:
    """Start relaxation from the unrelaxed state q_k = 0 at the initial stress of a spring."""
    sig, tilt = s[SIG], s[TILT]
    _stress_term(law, i, s[EPS], sig, 0, memory)
    kind, stress = law[i, CURVED], memory.series[i, 0, EQ]
    if kind >= HELD:
        tilt[i, 0] = fill_partials(memory, i, kind > HELD, s[EPS, i], 0)
    else:
        _fill_tilt(law, i, memory.series[:, :, EQ], tilt, 0)
        tilt[i, 0] *= memory.now[i, GAIN]
    for p in range(d.drag.size):
        change = _known_tangent(law, s, d.law[p], d.series[p], i, 0, memory, p)
        change += tilt[i, 0] * d.series[p, EPS, i, 0] - memory.now[i, BASE]
        own = memory.directions[p, 1] if memory.directions[p, 0] == i else OWN_ETA
        for k in range(memory.series.shape[2] - N_MEMORY):
            dz = -memory.rows[i, N_COLUMNS + 2 * k] * change / memory.now[i, GAIN]
            if own == OWN_RELAXATION + 2 * k:
                dz -= stress
            memory.tangents[p, i, N_TANGENTS + k, 0] = dz
    memory.series[i, 0, RELAXED] = 0.0
    for k in range(memory.series.shape[2] - N_MEMORY):
        z = -memory.rows[i, N_COLUMNS + 2 * k] * stress
        memory.series[i, 0, N_MEMORY + k] = z
        memory.series[i, 0, RELAXED] += z


@piece
def advance_tangents(
    d: SeriesTangents, groups: int, order: int, span: float, memory: Memory | None
) -> None:
    """Advance the derivatives of the state over a step of length `span`."""
    for p in range(d.drag.size):
        if d.live[p] > 0.0:
            advance(d.series[p], groups, order, span)
            if memory is not None:
                for i in range(memory.now.shape[0]):
                    for k in range(memory.series.shape[2] - N_MEMORY):
                        dz = memory.tangents[p, i, N_TANGENTS + k]
                        dz[0] = value_at(dz, order, span)
