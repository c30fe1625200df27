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
    interval,
)
from foamfit.law import BISTABLE
from foamfit.polynomial import value_at

# What is known of the top node.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Columns of `Links.law`: whether the branch is curved, its slope k, its origins x0 and s0, and the
# strains between which the spring stays on it.
CURVED, SLOPE, ORIGIN, OFFSET, LOW, HIGH, N_LAW = range(7)
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

    w, v (groups, order + 2) belong to the nodes above the groups, eps (order + 2) and sig
    (springs, order + 1) to the springs, group (groups, order + 1) to the common stresses.
    """

    w: Array
    v: Array
    eps: Array
    sig: Array
    group: Array


class Tangents(NamedTuple):
    """Derivatives of `Links` and `Series` in p directions: the same shapes with an axis p behind.

    law (springs, 3, p) holds those of k, x0 and s0, and slope (springs, order + 1) the series T.
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


@compiled
def enter(rows: Array, i: int, branch: int, law: Array) -> None:
    """Write the branch that spring i enters."""
    curved, law[i, SLOPE], law[i, ORIGIN], law[i, OFFSET] = branch_shape(rows[i], branch)
    law[i, CURVED] = 1.0 if curved else 0.0
    law[i, LOW], law[i, HIGH] = interval(rows[i], branch)


@compiled
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


@compiled
def enter_tangents(
    rows: Array, i: int, branch: int, directions: Branches, tangents: Tangents
) -> None:
    """Write the derivatives of the branch that spring i enters."""
    for p in range(directions.shape[0]):
        if directions[p, 0] == i and directions[p, 1] < OWN_ETA:
            dk, dx0, ds0 = branch_derivative(rows[i], branch, directions[p, 1])
            tangents.law[i, 0, p], tangents.law[i, 1, p], tangents.law[i, 2, p] = dk, dx0, ds0


@compiled
def make_series(count: int, groups: int, order: int) -> Series:
    """Make series of zeros."""
    return Series(
        np.zeros((groups, order + 2)),
        np.zeros((groups, order + 2)),
        np.zeros((count, order + 2)),
        np.zeros((count, order + 1)),
        np.zeros((groups, order + 1)),
    )


@compiled
def make_tangents(count: int, groups: int, order: int, directions: Branches) -> Tangents:
    """Make derivatives of a chain at rest; those of the branches are still to be entered."""
    p = directions.shape[0]
    some = count if p > 0 else 0
    tangents = Tangents(
        np.zeros((some, 3, p)),
        np.zeros((some, p)),
        np.zeros((some, p)),
        np.zeros(p),
        np.zeros((groups, order + 2, p)),
        np.zeros((groups, order + 2, p)),
        np.zeros((some, order + 2, p)),
        np.zeros((some, order + 1, p)),
        np.zeros((groups, order + 1, p)),
        np.zeros((some, order + 1)),
    )
    for q in range(p):
        i, what = directions[q, 0], directions[q, 1]
        if what == OWN_ETA:
            tangents.eta[i, q] = 1.0
        elif what == HEIGHT:
            tangents.heights[i, q] = 1.0
        elif what == DRAG:
            tangents.drag[q] = 1.0
    return tangents


# ---------------------------------------------------------------- the motion


@inlined
def _product(x: Array, y: Array, i: int, n: int, first: int, last: int) -> float:
    """Σ x_j y_{n-j} of spring i for j from first to last."""
    total = 0.0
    for j in range(first, last + 1):
        total += x[i, j] * y[i, n - j]
    return total


@inlined
def _stress_term(law: Array, i: int, eps: Array, sig: Array, n: int) -> float:
    """Order n of a spring's stress from its strain up to order n."""
    k, x = law[i, SLOPE], eps[i, 0] - law[i, ORIGIN]
    if law[i, CURVED] == 0.0:
        return k * eps[i, n] if n > 0 else law[i, OFFSET] + k * x
    if n == 0:
        return k * x / (1.0 - x) if x < 1.0 else math.inf
    return (k * eps[i, n] + _product(eps, sig, i, n, 1, n)) / (1.0 - x)


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


@compiled
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
            eps[i0, n] = u_n / heights[i0]
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


@compiled
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


@compiled
def expand(links: Links, s: Series, push: Array, motion: Array, order: int) -> bool:
    """Fill the series up to `order`; false if a prescribed stress meets a flat branch.

    `push` (2,) is the stress on the top and its rate, `motion` (2,) its displacement and rate.
    """
    law, eta, heights, ends, mass, drag, top = links
    w, v, eps, sig, group = s
    last = ends.size - 1
    for n in range(order + 1):
        push_n = push[n] if n < 2 else 0.0
        if top == MOTION:
            w[last, n] = motion[n] if n < 2 else 0.0
            v[last, n] = motion[1] if n == 0 else 0.0
        i0 = 0
        for g in range(last + 1):
            i1 = ends[g]
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
                        eps[i, n + 1] = (group[g, n] - sig[i, n]) / (eta[i] * (n + 1))
            i0 = i1
        for g in range(last + 1):
            if g < last or top == FREE:
                above = group[g + 1, n] if g < last else push_n - drag * v[g, n]
                v[g, n + 1] = (above - group[g, n]) / (mass[g] * (n + 1))
                w[g, n + 1] = v[g, n] / (n + 1)
            elif top == VISCOUS:
                v[g, n] = (push_n - group[g, n]) / drag
                w[g, n + 1] = v[g, n] / (n + 1)
    return True


# ---------------------------------------------------------------- its derivatives


@compiled
def _fill_slope(law: Array, i: int, sig: Array, order: int, slope: Array) -> None:
    """Series T of dσ/dε of a spring: k on a straight branch, (k + σ)²/k on a curved one."""
    k = law[i, SLOPE]
    slope[i, 0] = k
    if law[i, CURVED] == 0.0:
        for n in range(1, order + 1):
            slope[i, n] = 0.0
        return
    stiff = k + sig[i, 0]
    slope[i, 0] = stiff * stiff / k
    for n in range(1, order + 1):
        slope[i, n] = (2.0 * stiff * sig[i, n] + _product(sig, sig, i, n, 1, n - 1)) / k


@compiled
def _known_tangent(links: Links, s: Series, d: Tangents, i: int, n: int) -> None:
    """Order n of δσ of a spring, written to d.sig, but for the term T_0 δε_n."""
    law, out = links.law, d.sig[i, n]
    if law[i, CURVED] == 0.0:
        factor = s.eps[i, n] - (law[i, ORIGIN] if n == 0 else 0.0)
    else:
        factor = s.sig[i, n] / law[i, SLOPE]
    # a dashpot of zero adds to the stress what it would take
    flow = (n + 1) * s.eps[i, n + 1] if links.eta[i] == 0.0 and n + 1 < d.slope.shape[1] else 0.0
    for p in range(out.size):
        out[p] = factor * d.law[i, 0, p] - d.slope[i, n] * d.law[i, 1, p] + flow * d.eta[i, p]
    if n == 0:
        for p in range(out.size):
            out[p] += d.law[i, 2, p]
    if law[i, CURVED] != 0.0:
        for j in range(n):
            slope = d.slope[i, n - j]
            for p in range(out.size):
                out[p] += slope * d.eps[i, j, p]


@compiled
def _share_tangent(links: Links, s: Series, d: Tangents, g: int, i0: int, i1: int, n: int) -> None:
    """Order n of δε, δσ of the springs without dashpot in a group, and of the common stress.

    The known parts of their δσ must be in d.sig, and the rest of the elongation in d.group.
    """
    compliance, flat = 0.0, -1
    rest = d.group[g, n]
    for i in range(i0, i1):
        if links.eta[i] > 0.0:
            for p in range(rest.size):
                rest[p] -= links.heights[i] * d.eps[i, n, p]
        elif d.slope[i, 0] > 0.0:
            compliance += links.heights[i] / d.slope[i, 0]
            for p in range(rest.size):
                rest[p] += links.heights[i] / d.slope[i, 0] * d.sig[i, n, p]
        elif flat < 0:
            flat = i
    for p in range(rest.size):
        left = rest[p]
        common = d.sig[flat, n, p] if flat >= 0 else left / compliance
        for i in range(i0, i1):
            if links.eta[i] == 0.0 and i != flat:
                known = d.sig[i, n, p]
                soft = 1.0 / d.slope[i, 0] if d.slope[i, 0] > 0.0 else 0.0
                d.eps[i, n, p] = (common - known) * soft
                left -= links.heights[i] * common * soft
                d.sig[i, n, p] = common
        if flat >= 0:
            d.eps[flat, n, p] = left / links.heights[flat]
        rest[p] = common


@compiled
def _damped_tangent(
    links: Links, s: Series, d: Tangents, g: int, i0: int, i1: int, viscous: bool, n: int
) -> None:
    """Order n of the derivative of `_damped_term`, written to d.group."""
    out = d.group[g, n]
    weight = 1.0 / links.drag if viscous else 0.0
    for p in range(out.size):
        out[p] = 0.0 if viscous else d.v[g, n, p]
        if g > 0:
            out[p] -= d.v[g - 1, n, p]
        if viscous:  # v of the top is (push - Σ)/drag
            out[p] -= s.v[g, n] / links.drag * d.drag[p]
    for i in range(i0, i1):
        share = links.heights[i] / links.eta[i]
        flow = s.sig[i, n] - s.group[g, n]
        weight += share
        for p in range(out.size):
            change = (d.heights[i, p] - share * d.eta[i, p]) / links.eta[i]
            out[p] += share * d.sig[i, n, p] + change * flow
    for p in range(out.size):
        out[p] /= weight


@compiled
def _group_tangent(links: Links, s: Series, d: Tangents, g: int, i0: int, i1: int, n: int) -> None:
    """Order n of the derivative of a group's stress and of its strains that are no state."""
    last = links.ends.size - 1
    stressed, viscous = g == last and links.top == STRESS, g == last and links.top == VISCOUS
    size = d.group.shape[2]
    damped = 0
    for i in range(i0, i1):
        damped += links.eta[i] > 0.0
        _known_tangent(links, s, d, i, n)
    for p in range(size):
        d.group[g, n, p] = 0.0
        if not stressed:
            d.group[g, n, p] = d.w[g, n, p] - (d.w[g - 1, n, p] if g > 0 else 0.0)
            for i in range(i0, i1):
                d.group[g, n, p] -= s.eps[i, n] * d.heights[i, p]
    for i in range(i0, i1):
        for p in range(size):
            if i1 - i0 == 1 and not stressed:
                d.eps[i, n, p] = d.group[g, n, p] / links.heights[i]
            elif stressed and links.eta[i] == 0.0:
                soft = 1.0 / d.slope[i, 0] if d.slope[i, 0] > 0.0 else 0.0
                d.eps[i, n, p] = -d.sig[i, n, p] * soft
            if links.eta[i] > 0.0 or i1 - i0 == 1 or stressed:
                d.sig[i, n, p] += d.slope[i, 0] * d.eps[i, n, p]
    if stressed:
        return
    if damped == i1 - i0:
        _damped_tangent(links, s, d, g, i0, i1, viscous, n)
    elif i1 - i0 == 1:
        for p in range(size):
            d.group[g, n, p] = d.sig[i0, n, p]
    else:
        _share_tangent(links, s, d, g, i0, i1, n)


@compiled
def start_tangents(links: Links, s: Series, d: Tangents) -> None:
    """Derivatives of the strains of springs that a prescribed motion finds in equilibrium."""
    count, last = links.eta.size, links.ends.size - 1
    calm = Links(
        links.law, np.zeros(count), links.heights, links.ends, links.mass, links.drag, links.top
    )
    for i in range(count):
        s.sig[i, 0] = _stress_term(links.law, i, s.eps, s.sig, 0)
        _fill_slope(links.law, i, s.sig, 0, d.slope)
    _group_tangent(calm, s, d, last, links.ends[last - 1] if last > 0 else 0, count, 0)


@compiled
def expand_tangents(links: Links, s: Series, d: Tangents, order: int) -> None:
    """Fill the derivatives up to `order`, after `expand`."""
    last, size = links.ends.size - 1, d.drag.size
    for i in range(links.eta.size):
        _fill_slope(links.law, i, s.sig, order, d.slope)
    for n in range(order + 1):
        i0 = 0
        for g in range(last + 1):
            i1 = links.ends[g]
            _group_tangent(links, s, d, g, i0, i1, n)
            if i1 - i0 > 1 or (g == last and links.top == STRESS):
                for i in range(i0, i1):
                    if links.eta[i] > 0.0:
                        flow = (s.group[g, n] - s.sig[i, n]) / links.eta[i]
                        for p in range(size):
                            change = d.group[g, n, p] - d.sig[i, n, p] - flow * d.eta[i, p]
                            d.eps[i, n + 1, p] = change / (links.eta[i] * (n + 1))
            i0 = i1
        for g in range(last + 1):
            if g < last or links.top == FREE:
                inertia = links.mass[g] * (n + 1)
                for p in range(size):
                    net = -d.group[g, n, p]
                    if g < last:
                        net += d.group[g + 1, n, p]
                    else:
                        net -= links.drag * d.v[g, n, p] + s.v[g, n] * d.drag[p]
                    d.v[g, n + 1, p] = net / inertia
                    d.w[g, n + 1, p] = d.v[g, n, p] / (n + 1)
            elif links.top == VISCOUS:
                for p in range(size):
                    change = d.group[g, n, p] + s.v[g, n] * d.drag[p]
                    d.v[g, n, p] = -change / links.drag
                    d.w[g, n + 1, p] = d.v[g, n, p] / (n + 1)


# ---------------------------------------------------------------- the end of a step


@compiled
def _move_tangent(c: Array, order: int, span: float) -> None:
    """Carry order 0 of the polynomials c (order + 2, p) over a step."""
    for p in range(c.shape[1]):
        total = c[order, p]
        for n in range(order - 1, -1, -1):
            total = total * span + c[n, p]
        c[0, p] = total


@compiled
def advance(s: Series, d: Tangents, order: int, span: float) -> None:
    """Carry the state, and its derivatives, over a step of length `span`."""
    for g in range(s.w.shape[0]):
        s.w[g, 0], s.v[g, 0] = value_at(s.w[g], order, span), value_at(s.v[g], order, span)
    for i in range(s.eps.shape[0]):
        s.eps[i, 0] = value_at(s.eps[i], order, span)
    if d.drag.size > 0:
        for g in range(s.w.shape[0]):
            _move_tangent(d.w[g], order, span)
            _move_tangent(d.v[g], order, span)
        for i in range(s.eps.shape[0]):
            _move_tangent(d.eps[i], order, span)


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
            i = int(directions[p, 0])
            known, longer = 0.0, 0.0  # δσ at fixed strain, δ of the elongation at fixed stress
            if i >= 0 and directions[p, 1] == HEIGHT:
                longer = eps[i, j]
            elif i >= 0:
                x = eps[i, j] - law[i, ORIGIN]
                factor = x / (1.0 - x) if law[i, CURVED] != 0.0 else x
                known = factor * change[p, 0] - slope[i] * change[p, 1] + change[p, 2]
                longer = -heights[i] * known / slope[i] if slope[i] > 0.0 else 0.0
            common, gap = 0.0, 0.0
            if moved and flat < 0:
                common = -longer / soft[count]
            elif moved:  # a flat branch takes up all that the others leave
                common = known if i == flat else 0.0
                gap = -longer - common * soft[count]
            out_s[p, j] = common
            for node in range(count):
                own = longer if 0 <= i <= node else 0.0
                out_w[p, node, j] = own + common * soft[node + 1]
                if 0 <= flat <= node:
                    out_w[p, node, j] += gap
    return out_w, out_s
