"""The compiled integrator: Taylor series from switch to switch.

On one branch the law is either a straight line or σ (1 - x) = k x, so every coefficient of the
Taylor series in time of strains, stresses and motion follows from the lower ones by a short
recurrence. A step is as long as the series allows at the wanted tolerance; switches of branch, the
end of contact and the samples are roots and values of the same polynomials. No branch changes
inside a step.

The nodes are those masses that are there. Between two of them lies a group of springs in series,
which carry one stress: massless nodes have no state. In a group of several springs those without
dashpot share the elongation by their compliances, at every order of the series.
"""

from __future__ import annotations

import math

import numpy as np

from foamfit.kernels import (
    ETA,
    Array,
    Branches,
    above,
    below,
    branch_at_strain,
    branch_at_stress,
    branch_shape,
    compiled,
    equilibrate,
    first_branch,
    interval,
    slope_on,
    strain_on,
    stress_on,
)
from foamfit.polynomial import add_values, first_crossing, value_at

# What is known of the top node.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Outcomes.
DONE, TOO_MANY_STEPS, STEP_UNDERFLOW, FLAT_UNDER_STRESS, NOT_FINITE = range(5)


@compiled
def _product(x: Array, y: Array, n: int, first: int, last: int) -> float:
    """Σ x_j y_{n-j} for j from first to last."""
    total = 0.0
    for j in range(first, last + 1):
        total += x[j] * y[n - j]
    return total


@compiled
def _stress_term(rows: Array, i: int, branch: int, eps: Array, sig: Array, n: int) -> float:
    """Order n of a spring's stress from its strain up to order n."""
    if n == 0:
        return stress_on(rows[i], branch, eps[i, 0])
    curved, k, x0, _ = branch_shape(rows[i], branch)
    if not curved:
        return k * eps[i, n]
    x = eps[i, 0] - x0
    known = _product(eps[i], sig[i], n, 1, n)
    return (k * eps[i, n] + known) / (1.0 - x)


@compiled
def _strain_term(
    rows: Array, i: int, branch: int, eps: Array, sig: Array, n: int
) -> tuple[float, float]:
    """Order n >= 1 of a spring's strain as (known part, compliance): ε_n = known + compliance σ_n.

    The compliance of a flat branch is infinite.
    """
    curved, k, x0, _ = branch_shape(rows[i], branch)
    if not curved:
        return 0.0, (1.0 / k if k > 0.0 else math.inf)
    stiff = k + sig[i, 0]
    known = _product(eps[i], sig[i], n, 1, n - 1)
    return -known / stiff, (1.0 - (eps[i, 0] - x0)) / stiff


@compiled
def _share_elongation(
    rows: Array,
    branches: Branches,
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
    compliance = 0.0
    flat = -1
    rest = u_n
    for i in range(i0, i1):
        if rows[i, ETA] > 0.0:
            rest -= heights[i] * eps[i, n]
            continue
        known, soft = _strain_term(rows, i, branches[i], eps, sig, n)
        rest -= heights[i] * known
        if soft == math.inf:
            if flat < 0:
                flat = i
        else:
            compliance += heights[i] * soft
    s_n = 0.0 if flat >= 0 else rest / compliance
    for i in range(i0, i1):
        if rows[i, ETA] == 0.0:
            known, soft = _strain_term(rows, i, branches[i], eps, sig, n)
            eps[i, n] = known + (0.0 if soft == math.inf else soft * s_n)
            sig[i, n] = s_n
    if flat >= 0:
        eps[flat, n] = rest / heights[flat]
    return s_n


@compiled
def _group_term(
    rows: Array,
    branches: Branches,
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
    """Order n of the common stress of a group whose elongation is known.

    u_n and rate_n are order n of the elongation and of its rate. Where the node above is viscous
    (drag > 0), rate_n leaves out that node, whose rate is (push - stress)/drag.
    """
    damped = 0
    for i in range(i0, i1):
        damped += rows[i, ETA] > 0.0
    if i1 - i0 == 1 and n > 0:
        eps[i0, n] = u_n / heights[i0]
    if i1 - i0 == 1 or n == 0 or damped == i1 - i0:
        for i in range(i0, i1):
            sig[i, n] = _stress_term(rows, i, branches[i], eps, sig, n)
    if damped == 0 and i1 - i0 == 1:
        return sig[i0, n]
    if damped == i1 - i0:
        total = rate_n
        weight = 0.0
        for i in range(i0, i1):
            total += heights[i] * sig[i, n] / rows[i, ETA]
            weight += heights[i] / rows[i, ETA]
        if drag > 0.0:
            total += push_n / drag
            weight += 1.0 / drag
        return total / weight
    if n == 0:
        for i in range(i0, i1):
            if rows[i, ETA] == 0.0:
                return sig[i, 0]
    for i in range(i0, i1):
        if rows[i, ETA] > 0.0:
            sig[i, n] = _stress_term(rows, i, branches[i], eps, sig, n)
    return _share_elongation(rows, branches, heights, i0, i1, eps, sig, u_n, n)


@compiled
def _stressed_term(
    rows: Array, branches: Branches, i0: int, i1: int, eps: Array, sig: Array, s_n: float, n: int
) -> bool:
    """Order n of the strains of a group whose stress is prescribed; false if it cannot be."""
    for i in range(i0, i1):
        if rows[i, ETA] > 0.0 or n == 0:
            sig[i, n] = _stress_term(rows, i, branches[i], eps, sig, n)
            continue
        known, soft = _strain_term(rows, i, branches[i], eps, sig, n)
        if soft == math.inf:
            return False
        eps[i, n] = known + soft * s_n
        sig[i, n] = s_n
    return True


@compiled
def _expand(
    rows: Array,
    branches: Branches,
    heights: Array,
    ends: Branches,
    mass: Array,
    top: int,
    drag: float,
    push: Array,
    motion: Array,
    w: Array,
    v: Array,
    eps: Array,
    sig: Array,
    group: Array,
    order: int,
) -> bool:
    """Fill the Taylor coefficients of all that moves, up to `order`; false if it cannot be.

    w, v (groups, order + 2) hold the nodes above the groups, eps and sig (springs, order + 1) the
    springs, group (groups, order + 1) the common stresses. Order 0 of w, v and eps is the state.
    `push` (2,) is the stress on the top and its rate, `motion` (2,) its displacement and rate.
    """
    last = ends.size - 1
    for n in range(order + 1):
        push_n = push[n] if n < 2 else 0.0
        if top == MOTION:
            w[last, n] = motion[n] if n < 2 else 0.0
            v[last, n] = motion[1] if n == 0 else 0.0
        i0 = 0
        for g in range(last + 1):
            i1 = ends[g]
            if g == last and top == STRESS:
                group[g, n] = push_n
                if not _stressed_term(rows, branches, i0, i1, eps, sig, push_n, n):
                    return False
            else:
                u_n = w[g, n] - (w[g - 1, n] if g > 0 else 0.0)
                viscous = g == last and top == VISCOUS
                rate_n = (0.0 if viscous else v[g, n]) - (v[g - 1, n] if g > 0 else 0.0)
                group[g, n] = _group_term(
                    rows, branches, heights, i0, i1, eps, sig, u_n, rate_n,
                    push_n, drag if viscous else 0.0, n,
                )  # fmt: skip
            if i1 - i0 > 1 or (g == last and top == STRESS):
                for i in range(i0, i1):
                    if rows[i, ETA] > 0.0:
                        eps[i, n + 1] = (group[g, n] - sig[i, n]) / (rows[i, ETA] * (n + 1))
            i0 = i1
        for g in range(last + 1):
            if g < last or top == FREE:
                net = (group[g + 1, n] if g < last else push_n - drag * v[g, n]) - group[g, n]
                v[g, n + 1] = net / (mass[g] * (n + 1))
                w[g, n + 1] = v[g, n] / (n + 1)
            elif top == VISCOUS:
                v[g, n] = (push_n - group[g, n]) / drag
                w[g, n + 1] = v[g, n] / (n + 1)
    return True


@compiled
def _longest(c: Array, order: int, scale: float, tol: float, span: float) -> float:
    """Step at which the last two terms of a series fall below tol × scale."""
    for n in (order - 1, order):
        size = abs(c[n])
        if size * span**n > tol * scale:
            span = (tol * scale / size) ** (1.0 / n)
    return span


@compiled
def _step_length(
    heights: Array,
    w: Array,
    eps: Array,
    sig: Array,
    push: Array,
    order: int,
    tol: float,
    span: float,
    w_scale: float,
    s_scale: float,
    top: int,
) -> float:
    """Longest step within `span` that truncates below `tol` of the motion and stress so far."""
    reach = w_scale
    load = max(s_scale, abs(push[0]))
    for _ in range(60):  # at rest the only scale is what the step itself reaches
        tried = span
        if w_scale == 0.0 or s_scale == 0.0:
            reach = max(w_scale, abs(w[-1, 1]) * span if top != STRESS else 0.0)
            load = max(s_scale, max(abs(push[0]), abs(push[1]) * span))
            for i in range(heights.size):
                reach = max(reach, heights[i] * abs(eps[i, 1]) * span)
                load = max(load, abs(sig[i, 1]) * span)
        if reach == 0.0 and load == 0.0:
            return span
        for i in range(heights.size):
            if reach > 0.0:
                span = _longest(eps[i], order, reach / heights[i], tol, span)
            if load > 0.0:
                span = _longest(sig[i], order, load, tol, span)
        if span >= 0.5 * tried or (w_scale > 0.0 and s_scale > 0.0):
            break
    return span


@compiled
def _sample(
    heights: Array,
    ends: Branches,
    order: int,
    t: Array,
    first: int,
    last: int,
    now: float,
    w: Array,
    eps: Array,
    group: Array,
    top: int,
    out_w: Array,
    out_s: Array,
) -> None:
    """Write displacements and base stress at the samples first … last-1 of a step."""
    out_s[first:last] = 0.0
    add_values(group[0], order, t, first, last, now, 1.0, out_s)
    out_w[:, first:last] = 0.0
    if out_w.shape[0] == 1 and top != STRESS:
        add_values(w[ends.size - 1], order, t, first, last, now, 1.0, out_w[0])
        return
    for i in range(heights.size):
        node = min(i, out_w.shape[0] - 1)
        if node > 0:
            out_w[node, first:last] = out_w[node - 1, first:last]
        add_values(eps[i], order, t, first, last, now, heights[i], out_w[node])


@compiled
def fly(
    out_w: Array, out_s: Array, t: Array, first: int, t_end: float, w_end: Array, speed: float
) -> None:
    """After contact the chain keeps its shape and moves with the striker; nothing presses."""
    for j in range(first, t.size):
        out_s[j] = 0.0
        for i in range(out_w.shape[0]):
            out_w[i, j] = w_end[i] + speed * (t[j] - t_end)


@compiled
def _settle(
    rows: Array,
    branches: Branches,
    heights: Array,
    ends: Branches,
    w: Array,
    eps: Array,
    top: int,
    push0: float,
) -> None:
    """Share the elongation of undamped groups anew, so that rounding does not pile up."""
    i0 = 0
    for g in range(ends.size):
        i1 = ends[g]
        plain = i1 - i0 > 1 and not (g == ends.size - 1 and top == STRESS)
        for i in range(i0, i1):
            plain = plain and rows[i, ETA] == 0.0
        if plain:
            u = w[g, 0] - (w[g - 1, 0] if g > 0 else 0.0)
            compliance = 0.0
            miss = u
            for i in range(i0, i1):
                slope = slope_on(rows[i], branches[i], eps[i, 0])
                if slope == 0.0:
                    plain = False
                    break
                compliance += heights[i] / slope
                miss -= heights[i] * eps[i, 0]
            if plain:
                for i in range(i0, i1):
                    slope = slope_on(rows[i], branches[i], eps[i, 0])
                    eps[i, 0] += miss / compliance / slope
        i0 = i1


@compiled
def start(
    rows: Array,
    branches: Branches,
    heights: Array,
    ends: Branches,
    top: int,
    value: float,
    w: Array,
    eps: Array,
) -> None:
    """At the first sample the springs under a prescribed motion or stress are in equilibrium."""
    last = ends.size - 1
    i0, i1 = (ends[last - 1] if last > 0 else 0), ends[last]
    if top == MOTION:
        w[last, 0] = value
        now = np.zeros(i1 - i0)
        if i1 - i0 == 1:
            now[0] = value / heights[i0]
            branches[i0] = branch_at_strain(rows[i0], branches[i0], now[0])
        else:
            equilibrate(rows[i0:i1], branches[i0:i1], heights[i0:i1], value, 0.0, now)
        eps[i0:i1, 0] = now
    elif top == STRESS:
        for i in range(i0, i1):
            if rows[i, ETA] == 0.0:
                branches[i] = branch_at_stress(rows[i], branches[i], value)
                eps[i, 0] = strain_on(rows[i], branches[i], value)


@compiled
def integrate(
    rows: Array,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    values: Array,
    speed: float,
    t: Array,
    tol: float,
    order: int,
    max_steps: int,
    out_w: Array,
    out_s: Array,
    log: Array,
) -> tuple[int, float, int, int]:
    """Integrate a chain from rest (or struck) over the samples t.

    Parameters
    ----------
    rows : (springs, columns) array
        The springs, base first; see `foamfit.kernels`.
    heights : (springs,) array
        m.
    ends : (groups,) array
        One past the last spring of each group; a node lies above each group.
    mass : (groups,) array
        Areal mass m/A of the node above each group, kg/m².
    drag : float
        Onsite damping of the top, η_site/H, Pa·s/m.
    top : int
        FREE (a mass), VISCOUS (no mass, but the onsite damper), STRESS or MOTION.
    values : (n,) array
        Prescribed stress (Pa) or, for MOTION, displacement (m) of the top; zeros in an impact.
    speed : float
        Velocity of the striker at contact, m/s; 0 = no impact. Contact then ends with base stress.
    t : (n,) array
        Samples, s; an impact starts at 0, every other drive at t[0].
    tol, order, max_steps
        Truncation of a step relative to the motion so far; order of the series; bound on steps.
    out_w : (springs or 1, n) array
        Filled with the displacement above each spring, or of the top alone, m.
    out_s : (n,) array
        Filled with the base stress, Pa.
    log : (m, 5) array
        Filled with the switches: time, spring, branch left, branch entered, strain.

    Returns
    -------
    tuple
        Outcome, end of contact (NaN if none), steps taken, switches (also those past the log).
    """
    count, groups = rows.shape[0], ends.size
    w, v = np.zeros((groups, order + 2)), np.zeros((groups, order + 2))
    eps, sig = np.zeros((count, order + 2)), np.zeros((count, order + 1))
    group = np.zeros((groups, order + 1))
    branches = np.empty(count, np.int64)
    push, motion = np.zeros(2), np.zeros(2)
    for i in range(count):
        branches[i] = first_branch(rows[i])
    struck = speed > 0.0
    now = 0.0 if struck else t[0]
    done = 0
    while struck and done < t.size and t[done] < 0.0:  # the striker is still on its way
        out_s[done] = 0.0
        for i in range(out_w.shape[0]):
            out_w[i, done] = speed * t[done] if i == out_w.shape[0] - 1 else 0.0
        done += 1
    v[groups - 1, 0] = speed
    if not struck:
        start(rows, branches, heights, ends, top, values[0], w, eps)
    w_scale, s_scale, pressed, knot, switches = 0.0, 0.0, False, 0, 0
    contact_end = math.nan
    stalled = 0
    fresh = False
    for step in range(max_steps):
        if done == t.size:
            return DONE, contact_end, step, switches
        horizon = t[t.size - 1]
        if not struck and t.size == 1:
            motion[0] = push[0] = values[0]
        if not struck and t.size > 1:
            fresh = False
            while knot < t.size - 2 and now >= t[knot + 1]:
                knot += 1
                fresh = True
            horizon = t[knot + 1]
            rate = (values[knot + 1] - values[knot]) / (t[knot + 1] - t[knot])
            driven = motion if top == MOTION else push
            driven[0], driven[1] = values[knot] + rate * (now - t[knot]), rate
        if not _expand(
            rows, branches, heights, ends, mass, top, drag, push, motion,
            w, v, eps, sig, group, order,
        ):  # fmt: skip
            return FLAT_UNDER_STRESS, contact_end, step, switches
        if top == MOTION and knot > 0 and fresh:  # a dashpot feels the kink in the motion
            before, after = t[knot] - t[knot - 1], t[knot + 1] - t[knot]
            out_s[knot] = (after * out_s[knot] + before * group[0, 0]) / (before + after)
        span = horizon - now
        span = _step_length(heights, w, eps, sig, push, order, tol, span, w_scale, s_scale, top)
        if not math.isfinite(span) or not math.isfinite(group[0, order]):
            return NOT_FINITE, contact_end, step, switches
        spring, side = -1, 0
        for i in range(count):
            low, high = interval(rows[i], branches[i])
            when, where = first_crossing(eps[i], order, low, high, span)
            if where != 0 and (spring < 0 or when < span):
                span, spring, side = when, i, where
        leaves = False
        if struck:
            when, where = first_crossing(group[0], order, 0.0, math.inf, span)
            if pressed and group[0, 0] <= 0.0 and group[0, 1] <= 0.0:
                when, where = 0.0, -1  # a unilateral spring has just opened
            pressed = pressed or group[0, 0] > 0.0
            if where != 0 and when <= span and (pressed or when > 0.0):
                span, leaves, spring = when, True, -1
        end = now + span
        if end <= now and span > 0.0:
            return STEP_UNDERFLOW, contact_end, step, switches
        stalled = stalled + 1 if span == 0.0 else 0
        if stalled > 4 * count + 8:
            return STEP_UNDERFLOW, contact_end, step, switches
        last = end >= horizon and not leaves and spring < 0
        if last:
            end = horizon
        first = done
        while done < t.size and (t[done] < end or (last and t[done] <= end)):
            done += 1
        _sample(heights, ends, order, t, first, done, now, w, eps, group, top, out_w, out_s)
        for g in range(groups):
            w[g, 0], v[g, 0] = value_at(w[g], order, span), value_at(v[g], order, span)
        for i in range(count):
            s_scale = max(s_scale, abs(value_at(sig[i], order, span)))
            eps[i, 0] = value_at(eps[i], order, span)
        w_scale = max(w_scale, abs(w[groups - 1, 0]) if top != STRESS else 0.0)
        for i in range(count):
            w_scale = max(w_scale, heights[i] * abs(eps[i, 0]))
        now = end
        if leaves:
            w_end = np.zeros(out_w.shape[0])
            node = 0.0
            for i in range(count):
                node += heights[i] * eps[i, 0]
                w_end[i if out_w.shape[0] > 1 else 0] = node
            fly(out_w, out_s, t, done, now, w_end, v[groups - 1, 0])
            return DONE, now, step + 1, switches
        _settle(rows, branches, heights, ends, w, eps, top, push[0])
        if spring >= 0:
            low, high = interval(rows[spring], branches[spring])
            entered = above(branches[spring]) if side > 0 else below(branches[spring])
            eps[spring, 0] = high if side > 0 else low
            if switches < log.shape[0]:
                log[switches, 0], log[switches, 1] = now, spring
                log[switches, 2], log[switches, 3] = branches[spring], entered
                log[switches, 4] = eps[spring, 0]
            switches += 1
            branches[spring] = entered
    return TOO_MANY_STEPS, contact_end, max_steps, switches
