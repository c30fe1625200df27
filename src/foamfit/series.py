"""The Taylor series in time of a chain on fixed branches, and of its derivatives by parameters.

On one branch the law is either a straight line or σ (1 - x) = k x, so every coefficient of strains,
stresses and motion follows from the lower ones by a short recurrence. The recurrence of the
derivatives is the same one, linearised about the motion: with T the series of the slope dσ/dε,

    δσ_n = Σ_j T_{n-j} δx_j + (∂σ/∂k)_n δk,      x = ε - x0.

The law is continuous at its switches, so the derivatives pass from branch to branch without a jump.

The nodes are those masses that are there. Between two of them lies a group of springs in series,
which carry one stress: massless nodes have no state. In a group of several springs those without
dashpot share the elongation by their compliances, at every order of the series.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.kernels import (
    EPS_A,
    K0,
    KC,
    KIND,
    SIGMA_C,
    A,
    Array,
    Branches,
    D,
    E,
    Row,
    branch_shape,
    compiled,
    inlined,
    inner,
    interval,
    maker,
    piece,
)
from foamfit.law import BISTABLE

# What is known of the top node.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Columns of `Links.law`: whether the branch is curved, its slope k, its origins x0 and s0, and the
# strains between which the spring stays on it.
CURVED, SLOPE, ORIGIN, OFFSET, LOW, HIGH = range(6)
# What a step keeps of a curved branch: 1/(1 - x) at its start.
ROOM, N_LAW = 6, 7
# What a direction of derivatives moves, besides a spring's own parameters 0 … 7 (k0 … eta): its
# height, or (of no spring, -1) the onsite damping of the top.
OWN_ETA, HEIGHT, DRAG = 7, 8, 9


class Links(NamedTuple):
    """A chain on the branches that its springs are on.

    `law` (springs, N_LAW) is what `enter` writes, `eta` and `heights` (springs,) are in Pa·s and m,
    `ends` (groups,) is one past the last spring of each group and `mass` (groups,) the areal mass
    of the node above it, kg/m²; `drag` is the onsite damping of the top, η_site/H in Pa·s/m, `top`
    what is known of it.
    """

    law: Array
    eta: Array
    heights: Array
    ends: Branches
    mass: Array
    drag: float
    top: int


class Series(NamedTuple):
    """Taylor coefficients of all that moves; order 0 of w, v and eps is the state.

    w, v (groups, order + 2) belong to the nodes above the groups, eps and sig (springs, order + 2)
    to the springs, group (groups, order + 2) to the common stresses; the last column of sig and
    group is not used.
    """

    w: Array
    v: Array
    eps: Array
    sig: Array
    group: Array


class Tangents(NamedTuple):
    """Derivatives of `Links` and `Series` in p directions: the same shapes with an axis p in front.

    law (p, springs, 3) holds those of k, x0 and s0; `drag` is (p,). slope (springs, order + 1) is
    the series T of all directions, `live` (p,) tells which directions have left zero.
    """

    law: Array
    eta: Array
    heights: Array
    drag: Array
    w: Array
    v: Array
    eps: Array
    sig: Array
    group: Array
    slope: Array
    live: Branches


class Moves(NamedTuple):
    """One direction of derivatives: those of the branches, dashpots, heights and damping."""

    law: Array
    eta: Array
    heights: Array
    drag: float


@inner
def direction(t: Tangents, p: int) -> tuple[Moves, Series]:
    """What moves in direction p, and its series."""
    return (
        Moves(t.law[p], t.eta[p], t.heights[p], t.drag[p]),
        Series(t.w[p], t.v[p], t.eps[p], t.sig[p], t.group[p]),
    )


@inner
def enter(rows: Array, i: int, branch: int, law: Array) -> None:
    """Write the branch that spring i enters."""
    curved, law[i, SLOPE], law[i, ORIGIN], law[i, OFFSET] = branch_shape(rows[i], branch)
    law[i, CURVED] = 1.0 if curved else 0.0
    law[i, LOW], law[i, HIGH] = interval(rows[i], branch)


@inner
def branch_derivative(row: Row, branch: int, own: int) -> tuple[float, float, float]:
    """Derivatives of (k, x0, s0) of a branch of eq. 2 by a spring's own parameter k0 … kh_minus."""
    if row[KIND] != BISTABLE or branch == A:
        return (1.0 if own == 0 else 0.0), 0.0, 0.0
    eps_a, v = row[EPS_A], 1.0 - row[EPS_A]
    d_sigma_a = (eps_a / v if own == 0 else 0.0) + (row[K0] / (v * v) if own == 3 else 0.0)
    if branch == D:
        return (1.0 if own == 5 else 0.0), (1.0 if own == 3 else 0.0), d_sigma_a
    d_sigma_c = d_sigma_a + (1.0 if own == 2 else 0.0)
    d_eps_c = 1.0 if own == 4 else 0.0
    if branch == E:
        return (1.0 if own == 6 else 0.0), d_eps_c, d_sigma_c
    d_kc = 1.0 if own == 1 else 0.0
    stiff = row[KC] + row[SIGMA_C]
    d_eps_star = d_eps_c - (row[KC] * d_sigma_c - row[SIGMA_C] * d_kc) / (stiff * stiff)
    return d_kc, d_eps_star, 0.0


@inner
def enter_tangents(rows: Array, i: int, branch: int, directions: Branches, d: Tangents) -> None:
    """Write the derivatives of the branch that spring i enters."""
    for p in range(directions.shape[0]):
        if directions[p, 0] == i and directions[p, 1] < OWN_ETA:
            dk, dx0, ds0 = branch_derivative(rows[i], branch, directions[p, 1])
            d.law[p, i, 0], d.law[p, i, 1], d.law[p, i, 2] = dk, dx0, ds0
            if dk != 0.0 or dx0 != 0.0 or ds0 != 0.0:
                d.live[p] = 1


@maker
def make_series(count: int, groups: int, order: int) -> Series:
    """Make series of zeros."""
    nodes, springs = np.zeros((3, groups, order + 2)), np.zeros((2, count, order + 2))
    return Series(nodes[0], nodes[1], springs[0], springs[1], nodes[2])


@maker
def make_tangents(count: int, groups: int, order: int, directions: Branches) -> Tangents:
    """Make derivatives of a chain at rest; those of the branches are still to be entered."""
    p = directions.shape[0]
    nodes, springs = np.zeros((3, p, groups, order + 2)), np.zeros((2, p, count, order + 2))
    moves = np.zeros((2, p, count))
    d = Tangents(
        np.zeros((p, count, 3)),
        moves[0],
        moves[1],
        np.zeros(p),
        nodes[0],
        nodes[1],
        springs[0],
        springs[1],
        nodes[2],
        np.zeros((count if p > 0 else 0, order + 1)),
        np.zeros(p, np.int64),
    )
    for q in range(p):
        i, what = directions[q, 0], directions[q, 1]
        d.live[q] = what >= OWN_ETA
        if what == OWN_ETA:
            d.eta[q, i] = 1.0
        elif what == HEIGHT:
            d.heights[q, i] = 1.0
        elif what == DRAG:
            d.drag[q] = 1.0
    return d


# ---------------------------------------------------------------- the motion


@inner
def springs_of(ends: Branches, g: int) -> tuple[np.int64, np.int64]:
    """First spring of a group, and one past its last."""
    first = ends[g - 1] if g > 0 else ends[0] - ends[0]
    return first, ends[g]


@inlined
def _product(x: Array, y: Array, i: int, n: int, first: int, last: int) -> float:
    """Σ x_j y_{n-j} of spring i for j from first to last."""
    even = odd = 0.0  # two sums at once
    for j in range(first, last, 2):
        even += x[i, j] * y[i, n - j]
        odd += x[i, j + 1] * y[i, n - j - 1]
    if (last - first) % 2 == 0:
        even += x[i, last] * y[i, n - last]
    return even + odd


@inlined
def _stress_term(law: Array, i: int, eps: Array, sig: Array, n: int) -> float:
    """Order n of a spring's stress from its strain up to order n."""
    k = law[i, SLOPE]
    if n > 0:
        if law[i, CURVED] == 0.0:
            return k * eps[i, n]
        known = _product(eps, sig, i, n, 1, n - 1)
        return ((k + sig[i, 0]) * eps[i, n] + known) * law[i, ROOM]
    x = eps[i, 0] - law[i, ORIGIN]
    if law[i, CURVED] == 0.0:
        return law[i, OFFSET] + k * x
    law[i, ROOM] = 1.0 / (1.0 - x) if x < 1.0 else math.inf
    return k * x * law[i, ROOM]


@inlined
def _strain_term(law: Array, i: int, eps: Array, sig: Array, n: int) -> tuple[float, float]:
    """Order n >= 1 of a spring's strain as (known part, compliance): ε_n = known + compliance σ_n.

    The compliance of a flat branch is infinite.
    """
    k = law[i, SLOPE]
    if law[i, CURVED] == 0.0:
        return 0.0, (1.0 / k if k > 0.0 else math.inf)
    stiff = k + sig[i, 0]
    known = _product(eps, sig, i, n, 1, n - 1)
    return -known / stiff, (1.0 - (eps[i, 0] - law[i, ORIGIN])) / stiff


@inner
def _share_elongation(
    law: Array,
    eta: Array,
    heights: Array,
    i0: int,
    i1: int,
    eps: Array,
    sig: Array,
    u_n: float,
    n: int,
) -> float:
    """Order n >= 1 of the common stress of a group that has springs without dashpot.

    Fills the strains of those springs; a flat branch takes up all that the others leave.
    """
    compliance, rest, flat = 0.0, u_n, -1
    for i in range(i0, i1):
        if eta[i] > 0.0:
            rest -= heights[i] * eps[i, n]
            continue
        known, soft = _strain_term(law, i, eps, sig, n)
        eps[i, n] = known  # so far
        rest -= heights[i] * known
        if soft < math.inf:
            compliance += heights[i] * soft
        elif flat < 0:
            flat = i
    s_n = 0.0 if flat >= 0 else rest / compliance
    for i in range(i0, i1):
        if eta[i] == 0.0:
            sig[i, n] = s_n
            if law[i, CURVED] != 0.0:
                x = eps[i, 0] - law[i, ORIGIN]
                eps[i, n] += (1.0 - x) / (law[i, SLOPE] + sig[i, 0]) * s_n
            elif law[i, SLOPE] > 0.0:
                eps[i, n] += s_n / law[i, SLOPE]
    if flat >= 0:
        eps[flat, n] = rest / heights[flat]
    return s_n


@inlined
def _damped_term(
    eta: Array,
    heights: Array,
    i0: int,
    i1: int,
    sig: Array,
    rate_n: float,
    push_n: float,
    drag: float,
    n: int,
) -> float:
    """Order n of the common stress of a group in which every spring has a dashpot.

    Σ = (rate + Σ h_i σ_i/η_i) / Σ h_i/η_i; under a viscous top (drag > 0), whose rate is
    (push - Σ)/drag, `rate_n` leaves that node out.
    """
    total, weight = rate_n, 0.0
    for i in range(i0, i1):
        total += heights[i] * sig[i, n] / eta[i]
        weight += heights[i] / eta[i]
    if drag > 0.0:
        total += push_n / drag
        weight += 1.0 / drag
    return total / weight


@inlined
def _group_term(
    law: Array,
    eta: Array,
    heights: Array,
    i0: int,
    i1: int,
    eps: Array,
    sig: Array,
    u_n: float,
    rate_n: float,
    push_n: float,
    drag: float,
    n: int,
) -> float:
    """Order n of the common stress of a group whose elongation u and its rate are known."""
    if i1 - i0 == 1:
        if n > 0:
            eps[i0, n] = u_n * (1.0 / heights[i0])  # the quotient waits for nothing
        sig[i0, n] = _stress_term(law, i0, eps, sig, n)
        if eta[i0] == 0.0:
            return sig[i0, n]
        return _damped_term(eta, heights, i0, i1, sig, rate_n, push_n, drag, n)
    damped, first = 0, i0
    for i in range(i1 - 1, i0 - 1, -1):
        if eta[i] > 0.0:
            damped += 1
        else:
            first = i
        if n == 0 or eta[i] > 0.0:
            sig[i, n] = _stress_term(law, i, eps, sig, n)
    if damped == i1 - i0:
        return _damped_term(eta, heights, i0, i1, sig, rate_n, push_n, drag, n)
    if n == 0:
        return sig[first, 0]
    return _share_elongation(law, eta, heights, i0, i1, eps, sig, u_n, n)


@inner
def _stressed_term(
    law: Array, eta: Array, i0: int, i1: int, eps: Array, sig: Array, s_n: float, n: int
) -> bool:
    """Order n of the strains of a group whose stress is prescribed; false if it cannot be."""
    for i in range(i0, i1):
        if eta[i] > 0.0 or n == 0:
            sig[i, n] = _stress_term(law, i, eps, sig, n)
            continue
        known, soft = _strain_term(law, i, eps, sig, n)
        if soft == math.inf:
            return False
        eps[i, n] = known + soft * s_n
        sig[i, n] = s_n
    return True


@inner
def is_bare(links: Links) -> bool:
    """Whether every spring is undamped and alone between two masses."""
    if links.top != FREE or links.ends.size != links.eta.size:
        return False
    damped = 0
    for i in range(links.eta.size):
        damped += links.eta[i] > 0.0
    return damped == 0


@inlined
def expand_bare(links: Links, s: Series, push: Array, order: int) -> None:
    """Fill the series of a chain that `is_bare`, as `expand` does, asking less at each order."""
    law, _, heights, _, mass, drag, _ = links
    w, v, eps, sig, _ = s
    last = heights.size - 1
    for n in range(order + 1):
        share = 1.0 / (n + 1)
        for i in range(last + 1):
            eps[i, n] = (w[i, n] - (w[i - 1, n] if i > 0 else 0.0)) * (1.0 / heights[i])
            sig[i, n] = _stress_term(law, i, eps, sig, n)
        for i in range(last + 1):
            net = -sig[i, n]
            if i < last:
                net += sig[i + 1, n]
            else:
                net += push[n] if n < 2 else 0.0
                if drag > 0.0:
                    net -= drag * v[i, n]
            v[i, n + 1] = net * (share / mass[i])
            w[i, n + 1] = v[i, n] * share
    for i in range(last + 1):
        for n in range(order + 1):
            s.group[i, n] = sig[i, n]


@inner
def expand(links: Links, s: Series, push: Array, motion: Array, order: int) -> bool:
    """Fill the series up to `order`; false if a prescribed stress meets a flat branch.

    `push` (2,) is the stress on the top and its rate, `motion` (2,) its displacement and rate.
    """
    law, eta, heights, ends, mass, drag, top = links
    w, v, eps, sig, group = s
    last = ends.size - 1
    for n in range(order + 1):
        push_n = push[n] if n < 2 else 0.0
        share = 1.0 / (n + 1)
        if top == MOTION:
            w[last, n] = motion[n] if n < 2 else 0.0
            v[last, n] = motion[1] if n == 0 else 0.0
        for g in range(last + 1):
            i0, i1 = springs_of(ends, g)
            stressed = g == last and top == STRESS
            if stressed:
                group[g, n] = push_n
                if not _stressed_term(law, eta, i0, i1, eps, sig, push_n, n):
                    return False
            else:
                viscous = g == last and top == VISCOUS
                u_n, rate_n = w[g, n], (0.0 if viscous else v[g, n])
                if g > 0:
                    u_n -= w[g - 1, n]
                    rate_n -= v[g - 1, n]
                group[g, n] = _group_term(
                    law, eta, heights, i0, i1, eps, sig, u_n, rate_n,
                    push_n, drag if viscous else 0.0, n,
                )  # fmt: skip
            if i1 - i0 > 1 or stressed:
                for i in range(i0, i1):
                    if eta[i] > 0.0:
                        eps[i, n + 1] = (group[g, n] - sig[i, n]) * share / eta[i]
        for g in range(last + 1):
            if g < last or top == FREE:
                net = (group[g + 1, n] if g < last else push_n) - group[g, n]
                if g == last and drag > 0.0:
                    net -= drag * v[g, n]
                v[g, n + 1] = net * (share / mass[g])
                w[g, n + 1] = v[g, n] * share
            elif top == VISCOUS:
                v[g, n] = (push_n - group[g, n]) / drag
                w[g, n + 1] = v[g, n] * share
    return True


# ---------------------------------------------------------------- its derivatives


@inner
def _fill_slope(law: Array, i: int, sig: Array, slope: Array) -> None:
    """Series T of dσ/dε of a spring: k on a straight branch, (k + σ)²/k on a curved one."""
    k = law[i, SLOPE]
    slope[i, 0] = k
    order = slope.shape[1] - 1
    if law[i, CURVED] == 0.0:
        for n in range(1, order + 1):
            slope[i, n] = 0.0
        return
    stiff = k + sig[i, 0]
    slope[i, 0] = stiff * stiff / k
    for n in range(1, order + 1):
        slope[i, n] = (2.0 * stiff * sig[i, n] + _product(sig, sig, i, n, 1, n - 1)) / k


@inlined
def _known_tangent(
    links: Links, s: Series, slope: Array, m: Moves, eps: Array, i: int, n: int
) -> float:
    """Order n of δσ of a spring, but for the term T_0 δε_n."""
    law = links.law
    known = -slope[i, n] * m.law[i, 1]
    if law[i, CURVED] == 0.0:
        known += (s.eps[i, n] - (law[i, ORIGIN] if n == 0 else 0.0)) * m.law[i, 0]
        known += m.law[i, 2] if n == 0 else 0.0
    else:
        known += s.sig[i, n] / law[i, SLOPE] * m.law[i, 0]
        if n > 0:
            known += _product(eps, slope, i, n, 0, n - 1)
    if links.eta[i] == 0.0 and n + 1 < slope.shape[1]:  # a dashpot of zero adds what it would take
        known += (n + 1) * s.eps[i, n + 1] * m.eta[i]
    return known


@inner
def _share_tangent(
    links: Links, slope: Array, d: Series, i0: int, i1: int, rest: float, n: int
) -> float:
    """Order n of the derivative of a group's stress, where some springs have no dashpot.

    `rest` is that of the elongation, but for the moves of the springs. Fills their δε and δσ, whose
    known parts must be in d.sig.
    """
    compliance, flat = 0.0, -1
    for i in range(i0, i1):
        if links.eta[i] > 0.0:
            rest -= links.heights[i] * d.eps[i, n]
        elif slope[i, 0] > 0.0:
            compliance += links.heights[i] / slope[i, 0]
            rest += links.heights[i] / slope[i, 0] * d.sig[i, n]
        elif flat < 0:
            flat = i
    common = d.sig[flat, n] if flat >= 0 else rest / compliance
    for i in range(i0, i1):
        if links.eta[i] == 0.0 and i != flat:
            soft = 1.0 / slope[i, 0] if slope[i, 0] > 0.0 else 0.0
            d.eps[i, n] = (common - d.sig[i, n]) * soft
            d.sig[i, n] = common
    if flat >= 0:  # the flat branch takes up all that the others leave
        d.eps[flat, n] = (rest - common * compliance) / links.heights[flat]
    return common


@inner
def _damped_tangent(
    links: Links, s: Series, m: Moves, d: Series, g: int, i0: int, i1: int, n: int
) -> float:
    """Order n of the derivative of `_damped_term`."""
    viscous = g == links.ends.size - 1 and links.top == VISCOUS
    total, weight = (0.0 if viscous else d.v[g, n]), 0.0
    if g > 0:
        total -= d.v[g - 1, n]
    if viscous:  # v of the top is (push - Σ)/drag
        total -= s.v[g, n] / links.drag * m.drag
        weight = 1.0 / links.drag
    for i in range(i0, i1):
        share = links.heights[i] / links.eta[i]
        change = (m.heights[i] - share * m.eta[i]) / links.eta[i]
        total += share * d.sig[i, n] + change * (s.sig[i, n] - s.group[g, n])
        weight += share
    return total / weight


@inlined
def _group_tangent(
    links: Links, s: Series, slope: Array, m: Moves, d: Series, g: int, n: int
) -> None:
    """Order n of the derivative of a group's stress and of its strains that are no state."""
    i0, i1 = springs_of(links.ends, g)
    stressed = g == links.ends.size - 1 and links.top == STRESS
    rest = d.w[g, n] - (d.w[g - 1, n] if g > 0 else 0.0)
    single = i1 - i0 == 1 and not stressed
    damped = 0
    for i in range(i0, i1):
        damped += links.eta[i] > 0.0
        rest -= s.eps[i, n] * m.heights[i]
        known = _known_tangent(links, s, slope, m, d.eps, i, n)
        if single:
            d.eps[i, n] = rest * (1.0 / links.heights[i])
        elif stressed and links.eta[i] == 0.0:
            d.eps[i, n] = -known / slope[i, 0]
        if single or stressed or links.eta[i] > 0.0:
            known += slope[i, 0] * d.eps[i, n]
        d.sig[i, n] = known
    if stressed:
        d.group[g, n] = 0.0
    elif damped == i1 - i0:
        d.group[g, n] = _damped_tangent(links, s, m, d, g, i0, i1, n)
    elif single:
        d.group[g, n] = d.sig[i0, n]
    else:
        d.group[g, n] = _share_tangent(links, slope, d, i0, i1, rest, n)


@inner
def _expand_tangent(links: Links, s: Series, slope: Array, m: Moves, d: Series, order: int) -> None:
    """Fill the derivatives in one direction up to `order`."""
    last = links.ends.size - 1
    for n in range(order + 1):
        share = 1.0 / (n + 1)
        for g in range(last + 1):
            _group_tangent(links, s, slope, m, d, g, n)
            i0, i1 = springs_of(links.ends, g)
            if i1 - i0 > 1 or (g == last and links.top == STRESS):
                for i in range(i0, i1):
                    if links.eta[i] > 0.0:
                        flow = (s.group[g, n] - s.sig[i, n]) / links.eta[i]
                        net = d.group[g, n] - d.sig[i, n] - flow * m.eta[i]
                        d.eps[i, n + 1] = net * share / links.eta[i]
        for g in range(last + 1):
            net = -d.group[g, n]
            if g < last:
                net += d.group[g + 1, n]
            elif links.top == VISCOUS:
                d.v[g, n] = (net - s.v[g, n] * m.drag) / links.drag
            elif links.drag > 0.0 or m.drag != 0.0:
                net -= links.drag * d.v[g, n] + s.v[g, n] * m.drag
            if g < last or links.top == FREE:
                d.v[g, n + 1] = net * (share / links.mass[g])
            if g < last or links.top in (FREE, VISCOUS):
                d.w[g, n + 1] = d.v[g, n] * share


@piece
def expand_tangents(links: Links, s: Series, t: Tangents, order: int) -> None:
    """Fill the derivatives up to `order`, after `expand`; those that are still zero stay so."""
    for i in range(links.eta.size):
        _fill_slope(links.law, i, s.sig, t.slope)
    for p in range(t.drag.size):
        if t.live[p] != 0:
            moves, d = direction(t, p)
            _expand_tangent(links, s, t.slope, moves, d, order)


# ---------------------------------------------------------------- the end of a step


@inner
def _move(c: Array, order: int, span: float) -> None:
    """Carry order 0 of polynomials c (m, …) over a step."""
    for i in range(c.shape[0]):
        total = c[i, order]
        for n in range(order - 1, -1, -1):
            total = total * span + c[i, n]
        c[i, 0] = total


@inner
def advance(s: Series, order: int, span: float) -> None:
    """Carry the state over a step of length `span`."""
    _move(s.w, order, span)
    _move(s.v, order, span)
    _move(s.eps, order, span)


@inner
def advance_tangents(d: Tangents, order: int, span: float) -> None:
    """Carry the derivatives of the state over a step of length `span`."""
    for p in range(d.drag.size):
        if d.live[p] != 0:
            _move(d.w[p], order, span)
            _move(d.v[p], order, span)
            _move(d.eps[p], order, span)


# ---------------------------------------------------------------- without inertia and damping


@compiled
def equilibrium_tangents(
    rows: Array,
    heights: Array,
    eps: Array,
    branches: Branches,
    moved: bool,
    directions: Branches,
) -> tuple[Array, Array]:
    """Derivatives along a history of springs in series, undamped and massless.

    Parameters
    ----------
    rows, heights : arrays
        The springs.
    eps, branches : (springs, n) arrays
        Their strains and branches.
    moved : bool
        Whether the displacement of the top is prescribed, or else the stress.
    directions : (p, 2) array
        See `foamfit.taylor.integrate`.

    Returns
    -------
    tuple of arrays
        Derivatives of the displacements above the springs (p, springs, n), m, and of the common
        stress (p, n), Pa, per unit of the parameters.
    """
    count, n = eps.shape
    size = directions.shape[0]
    out_w, out_s = np.empty((size, count, n)), np.empty((size, n))
    law, branch = np.empty((count, N_LAW)), np.full(count, -1)
    change = np.zeros((size, 3))  # of k, x0 and s0 of the branch that the direction's spring is on
    slope, soft = np.empty(count), np.empty(count + 1)
    for j in range(n):
        flat = -1
        soft[0] = 0.0  # compliance of the springs below each node
        for i in range(count):
            if branches[i, j] != branch[i]:
                branch[i] = branches[i, j]
                enter(rows, i, branch[i], law)
                for p in range(size):
                    if directions[p, 0] == i and directions[p, 1] < OWN_ETA:
                        change[p, 0], change[p, 1], change[p, 2] = branch_derivative(
                            rows[i], branch[i], directions[p, 1]
                        )
            x = eps[i, j] - law[i, ORIGIN]
            slope[i] = law[i, SLOPE]
            if law[i, CURVED] != 0.0:
                slope[i] /= (1.0 - x) * (1.0 - x)
            soft[i + 1] = soft[i]
            if slope[i] > 0.0:
                soft[i + 1] += heights[i] / slope[i]
            elif flat < 0:
                flat = i
        for p in range(size):
            i = directions[p, 0]
            known = longer = 0.0  # δσ at fixed strain, δ of the elongation at fixed stress
            if i >= 0 and directions[p, 1] == HEIGHT:
                longer = eps[i, j]
            elif i >= 0:
                x = eps[i, j] - law[i, ORIGIN]
                factor = x / (1.0 - x) if law[i, CURVED] != 0.0 else x
                known = factor * change[p, 0] - slope[i] * change[p, 1] + change[p, 2]
                longer = -heights[i] * known / slope[i] if slope[i] > 0.0 else 0.0
            common = gap = 0.0
            if moved and flat < 0:
                common = -longer / float(soft[count])
            elif moved:  # a flat branch takes up all that the others leave
                common = known if i == flat else 0.0
                gap = -longer - common * float(soft[count])
            out_s[p, j] = common
            for node in range(count):
                own = longer if 0 <= i <= node else 0.0
                out_w[p, node, j] = own + common * soft[node + 1]
                if 0 <= flat <= node:
                    out_w[p, node, j] += gap
    return out_w, out_s
