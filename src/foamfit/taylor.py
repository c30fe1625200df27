"""The compiled integrator: Taylor series from switch to switch.

A step is as long as the series of `foamfit.series` allow at the wanted tolerance; switches of
branch, the end of contact and the samples are roots and values of the same polynomials. No branch
changes inside a step. Derivatives by parameters are carried along where they are asked for.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.kernels import (
    ETA,
    Array,
    Branches,
    above,
    below,
    branch_at_strain,
    branch_at_stress,
    compiled,
    equilibrate,
    first_branch,
    inlined,
    inner,
    piece,
    strain_on,
)
from foamfit.polynomial import fill_values, first_crossing, slope_at, value_at
from foamfit.series import (
    CURVED,
    FREE,
    HIGH,
    LOW,
    MOTION,
    N_LAW,
    ORIGIN,
    SLOPE,
    STRESS,
    VISCOUS,
    Links,
    Series,
    Tangents,
    advance,
    advance_tangents,
    enter,
    enter_tangents,
    expand,
    expand_bare,
    expand_tangents,
    is_bare,
    make_series,
    make_tangents,
    springs_of,
)

__all__ = ["FREE", "MOTION", "STRESS", "VISCOUS", "integrate"]

# Outcomes.
DONE, TOO_MANY_STEPS, STEP_UNDERFLOW, FLAT_UNDER_STRESS, NOT_FINITE = range(5)
# Strains closer than this to the end of a branch are at it.
CLOSE = 1e-13


class Samples(NamedTuple):
    """The curves to fill, over the samples t (n,).

    w (springs or 1, n) holds the displacements above each spring, or of the top alone, m; s (n,)
    the base stress, Pa; dw (p, springs or 1, n) and ds (p, n) their derivatives in p directions.
    """

    t: Array
    w: Array
    s: Array
    dw: Array
    ds: Array


# ---------------------------------------------------------------- the length of a step


@inlined
def _tail(links: Links, s: Series, n: int, reach: float, load: float) -> float:
    """Largest coefficient of order n among strains and stresses, over motion and stress so far."""
    worst = 0.0
    for i in range(links.heights.size):
        if reach > 0.0:
            worst = max(worst, abs(s.eps[i, n]) * links.heights[i] / reach)
        if load > 0.0:
            worst = max(worst, abs(s.sig[i, n]) / load)
    return worst


@inlined
def step_length(
    links: Links,
    s: Series,
    push: Array,
    order: int,
    tol: float,
    span: float,
    w_scale: float,
    s_scale: float,
) -> float:
    """Longest step within `span` whose last two terms fall below `tol` of motion and stress."""
    reach, load = w_scale, max(s_scale, abs(push[0]))
    for _ in range(60):  # at rest the only scale is what the step itself reaches
        tried = span
        if w_scale == 0.0 or s_scale == 0.0:
            reach = max(w_scale, abs(s.w[-1, 1]) * span if links.top != STRESS else 0.0)
            load = max(s_scale, max(abs(push[0]), abs(push[1]) * span))
            for i in range(links.heights.size):
                reach = max(reach, links.heights[i] * abs(s.eps[i, 1]) * span)
                load = max(load, abs(s.sig[i, 1]) * span)
        for n in (order - 1, order):
            tail = _tail(links, s, n, reach, load)
            if tail * span**n > tol:
                span = (tol / tail) ** (1.0 / n)
        if span >= 0.5 * tried or (w_scale > 0.0 and s_scale > 0.0):
            break
    return span


@inner
def _first_switch(links: Links, s: Series, order: int, span: float) -> tuple[float, int, int]:
    """First switch of branch within `span`: when, which spring (-1: none), on which side."""
    spring, side = -1, 0
    for i in range(links.heights.size):
        when, where = first_crossing(s.eps[i], order, links.law[i, LOW], links.law[i, HIGH], span)
        if where != 0 and (spring < 0 or when < span):
            span, spring, side = when, i, where
    return span, spring, side


@inner
def _least(c: Array, order: int, span: float, tol: float, most: int) -> int:
    """Orders that the series in the rows of c need over a step."""
    for i in range(c.shape[0]):
        size, power = abs(c[i, 0]), 1.0
        for n in range(1, order + 1):
            power *= span
            size += abs(c[i, n]) * power
        tail, n = 0.0, order
        while n > most and tail + abs(c[i, n]) * power <= tol * size:
            tail += abs(c[i, n]) * power
            power /= span
            n -= 1
        most = n
    return most


@inner
def _enough(s: Series, order: int, span: float, tol: float) -> int:
    """Orders that are enough over a step, if a switch made it short."""
    least = min(order, 2)
    if span == 0.0:
        return least
    return _least(s.sig, order, span, tol, _least(s.eps, order, span, tol, least))


# ---------------------------------------------------------------- samples


@piece
def sample(
    links: Links, s: Series, order: int, out: Samples, first: int, last: int, now: float, c: Array
) -> None:
    """Write displacements and base stress at the samples first … last-1 of a step; c is scratch."""
    fill_values(s.group[0], order, out.t, first, last, now, out.s)
    if out.w.shape[0] == 1 and links.top != STRESS:
        fill_values(s.w[links.ends.size - 1], order, out.t, first, last, now, out.w[0])
        return
    for n in range(order + 1):
        c[n] = 0.0
    count = links.heights.size
    for i in range(count):
        for n in range(order + 1):
            c[n] += links.heights[i] * s.eps[i, n]
        if out.w.shape[0] > 1 or i == count - 1:
            fill_values(c, order, out.t, first, last, now, out.w[min(i, out.w.shape[0] - 1)])


@piece
def sample_tangents(
    links: Links,
    s: Series,
    d: Tangents,
    order: int,
    out: Samples,
    first: int,
    last: int,
    now: float,
    c: Array,
) -> None:
    """Write the derivatives of displacements and base stress at some samples of a step."""
    nodes, count = out.w.shape[0], links.heights.size
    top = links.ends.size - 1
    for p in range(d.drag.size):
        if d.live[p] == 0:
            for j in range(first, last):
                out.ds[p, j] = 0.0
                for i in range(nodes):
                    out.dw[p, i, j] = 0.0
            continue
        fill_values(d.group[p, 0], order, out.t, first, last, now, out.ds[p])
        if nodes == 1 and links.top != STRESS:
            fill_values(d.w[p, top], order, out.t, first, last, now, out.dw[p, 0])
            continue
        for n in range(order + 1):
            c[n] = 0.0
        for i in range(count):
            for n in range(order + 1):
                c[n] += links.heights[i] * d.eps[p, i, n] + d.heights[p, i] * s.eps[i, n]
            if nodes > 1 or i == count - 1:
                fill_values(c, order, out.t, first, last, now, out.dw[p, min(i, nodes - 1)])


@inner
def _mend_kink(out: Samples, s: Series, d: Tangents, knot: int) -> None:
    """A dashpot feels the mean rate where the prescribed motion has a kink."""
    before, after = out.t[knot] - out.t[knot - 1], out.t[knot + 1] - out.t[knot]
    share = before / (before + after)
    out.s[knot] += share * (s.group[0, 0] - out.s[knot])
    for p in range(d.drag.size):
        out.ds[p, knot] += share * (d.group[p, 0, 0] - out.ds[p, knot])


@inner
def _fill_before(out: Samples, speed: float) -> int:
    """Before contact nothing presses and only the striker moves; returns the first sample after."""
    nodes, done = out.w.shape[0], 0
    while done < out.t.size and out.t[done] < 0.0:
        done += 1
    for j in range(done):
        out.s[j] = 0.0
        for i in range(nodes):
            out.w[i, j] = speed * out.t[j] if i == nodes - 1 else 0.0
        for p in range(out.ds.shape[0]):
            out.ds[p, j] = 0.0
            for i in range(nodes):
                out.dw[p, i, j] = 0.0
    return done


# ---------------------------------------------------------------- the end of contact


@inner
def fly(
    out_w: Array, out_s: Array, t: Array, first: int, t_end: float, w_end: Array, speed: float
) -> None:
    """After contact the chain keeps its shape and moves with the striker; nothing presses."""
    for i in range(out_w.shape[0]):
        for j in range(first, t.size):
            out_w[i, j] = w_end[i] + speed * (t[j] - t_end)
    for j in range(first, t.size):
        out_s[j] = 0.0


@inner
def _delay(s: Series, d: Tangents, order: int, span: float, late: Array) -> None:
    """Derivative of the time at which the base stress meets zero at the end of a step."""
    fall = slope_at(s.group[0], order, span)
    if fall == 0.0:
        return
    for p in range(late.size):
        late[p] = -value_at(d.group[p, 0], order, span) / fall


@piece
def depart(
    links: Links,
    s: Series,
    d: Tangents,
    order: int,
    more: int,
    span: float,
    now: float,
    late: Array,
    rate: Array,
    w_end: Array,
    out: Samples,
    done: int,
) -> None:
    """Fill the samples after contact, which ends at the end of this step, at the time `now`.

    A later end (`late`) leaves the nodes as they move until then, and the top with the velocity
    that it has then. `rate` and `w_end` (nodes,) are scratch.
    """
    nodes, count, top = out.w.shape[0], links.heights.size, links.ends.size - 1
    pull = slope_at(s.v[top], order, span)
    speed = 0.0
    for i in range(count):
        speed += links.heights[i] * slope_at(s.eps[i], order, span)
        rate[min(i, nodes - 1)] = speed
    advance(s, order, span)
    advance_tangents(d, more, span)
    place = 0.0
    for i in range(count):
        place += links.heights[i] * s.eps[i, 0]
        w_end[min(i, nodes - 1)] = place
    fly(out.w, out.s, out.t, done, now, w_end, s.v[top, 0])
    for p in range(late.size):
        away = d.v[p, top, 0] + pull * late[p]
        moved = 0.0
        for i in range(count):
            moved += links.heights[i] * d.eps[p, i, 0] + d.heights[p, i] * s.eps[i, 0]
            if nodes > 1 or i == count - 1:
                node = min(i, nodes - 1)
                there = moved + (rate[node] - s.v[top, 0]) * late[p]
                for j in range(done, out.t.size):
                    out.dw[p, node, j] = there + away * (out.t[j] - now)
        for j in range(done, out.t.size):
            out.ds[p, j] = 0.0


# ---------------------------------------------------------------- the state between steps


@inner
def settle(links: Links, s: Series) -> None:
    """Share the elongation of undamped groups anew, so that rounding does not pile up."""
    for g in range(links.ends.size):
        i0, i1 = springs_of(links.ends, g)
        plain = not (g == links.ends.size - 1 and links.top == STRESS)
        if i1 - i0 == 1:
            continue
        compliance = 0.0
        miss = s.w[g, 0] - (s.w[g - 1, 0] if g > 0 else 0.0)
        for i in range(i0, i1):
            slope = _slope_now(links.law, i, s.eps[i, 0])
            plain = plain and links.eta[i] == 0.0 and slope > 0.0
            compliance += links.heights[i] / slope
            miss -= links.heights[i] * s.eps[i, 0]
        if plain:
            for i in range(i0, i1):
                s.eps[i, 0] += miss / compliance / _slope_now(links.law, i, s.eps[i, 0])


@inner
def _slope_now(law: Array, i: int, eps: float) -> float:
    """Slope dσ/dε on the branch that spring i is on."""
    k, y = law[i, SLOPE], 1.0 - (eps - law[i, ORIGIN])
    return k / (y * y) if law[i, CURVED] != 0.0 else k


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
        for i in range(i0, i1):
            eps[i, 0] = now[i - i0]
    elif top == STRESS:
        for i in range(i0, i1):
            if rows[i, ETA] == 0.0:
                branches[i] = branch_at_stress(rows[i], branches[i], value)
                eps[i, 0] = strain_on(rows[i], branches[i], value)


@inner
def switch(
    rows: Array,
    branches: Branches,
    links: Links,
    s: Series,
    d: Tangents,
    directions: Branches,
    order: int,
    span: float,
    now: float,
    spring: int,
    side: int,
    log: Array,
    switches: int,
) -> int:
    """Change the branch of a spring, and of all that end theirs at the same time; counts them."""
    for i in range(branches.size):
        low, high = links.law[i, LOW], links.law[i, HIGH]
        out = 0
        if i == spring:
            out = side
        elif s.eps[i, 0] >= high - CLOSE and slope_at(s.eps[i], order, span) > 0.0:
            out = 1
        elif s.eps[i, 0] <= low + CLOSE and slope_at(s.eps[i], order, span) < 0.0:
            out = -1
        if out == 0:
            continue
        entered = above(branches[i]) if out > 0 else below(branches[i])
        s.eps[i, 0] = high if out > 0 else low
        if switches < log.shape[0]:
            log[switches, 0], log[switches, 1] = now, i
            log[switches, 2], log[switches, 3] = branches[i], entered
            log[switches, 4] = s.eps[i, 0]
        switches += 1
        branches[i] = entered
        enter(rows, i, entered, links.law)
        enter_tangents(rows, i, entered, directions, d)
    return switches


# ---------------------------------------------------------------- from step to step


@inner
def _prescribe(
    top: int, values: Array, t: Array, knot: int, now: float, push: Array, motion: Array
) -> float:
    """Write what the top is given between samples knot and knot + 1; returns when that ends."""
    horizon, rate = t[t.size - 1], 0.0
    if t.size > 1:
        horizon = t[knot + 1]
        rate = (values[knot + 1] - values[knot]) / (t[knot + 1] - t[knot])
    driven = motion if top == MOTION else push
    driven[0], driven[1] = values[knot] + rate * (now - t[knot]), rate
    return horizon


@inner
def _first_lift(
    s: Series, order: int, first: bool, pressed: bool, span: float
) -> tuple[float, bool]:
    """When within `span` the base stress meets zero again, and whether it does.

    Before the blow has come through to the base (`pressed`) rounding alone may do so; only in the
    first step can it come and go.
    """
    when, where = first_crossing(s.group[0], order, 0.0, math.inf, span)
    if pressed and s.group[0, 0] <= 0.0 and s.group[0, 1] <= 0.0:
        when, where = 0.0, -1  # a unilateral spring has just opened
    if where != 0 and when <= span and (pressed or (first and when > 0.0)):
        return when, True
    return span, False


@inner
def begin(
    rows: Array,
    start: Array,
    speed: float,
    directions: Branches,
    branches: Branches,
    links: Links,
    s: Series,
    d: Tangents,
) -> None:
    """Write the state at the first sample: branches, strains and their derivatives."""
    s.v[-1, 0] = speed
    for i in range(branches.size):
        branches[i] = first_branch(rows[i])
        if start.shape[1] > 0:
            s.eps[i, 0] = start[0, i]
            branches[i] = branch_at_strain(rows[i], branches[i], start[0, i])
            for p in range(directions.shape[0]):
                d.eps[p, i, 0] = start[1 + p, i]
                d.live[p] = d.live[p] or start[1 + p, i] != 0.0
        links.eta[i] = rows[i, ETA]
        enter(rows, i, branches[i], links.law)
        enter_tangents(rows, i, branches[i], directions, d)


@inner
def _loaded(s: Series, s_scale: float) -> float:
    """Largest stress so far."""
    for i in range(s.sig.shape[0]):
        s_scale = max(s_scale, abs(s.sig[i, 0]))
    return s_scale


@inner
def _reached(links: Links, s: Series, w_scale: float) -> tuple[float, float]:
    """Largest displacement so far, and a number that is finite only if the state is."""
    top = links.ends.size - 1
    total = s.w[top, 0]
    if links.top != STRESS:
        w_scale = max(w_scale, abs(s.w[top, 0]))
    for i in range(links.heights.size):
        w_scale = max(w_scale, links.heights[i] * abs(s.eps[i, 0]))
        total += s.eps[i, 0]
    return w_scale, total


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
    directions: Branches,
    start: Array,
    out_w: Array,
    out_s: Array,
    out_dw: Array,
    out_ds: Array,
    log: Array,
) -> tuple[int, float, int, int]:
    """Integrate a chain over the samples t.

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
    directions : (p, 2) array
        What derivatives are carried along: spring and its own parameter, or HEIGHT, or -1 and DRAG.
    start : (1 + p, springs or 0) array
        The strains from which the springs start, never loaded before, and their derivatives; none
        where they start from rest.
    out_w, out_s, out_dw, out_ds : arrays
        Filled; see `Samples`. The derivatives have p = 0 where none are wanted.
    log : (m, 5) array
        Filled with the switches: time, spring, branch left, branch entered, strain.

    Returns
    -------
    tuple
        Outcome, end of contact (NaN if none), steps taken, switches (also those past the log).
    """
    count, size = rows.shape[0], directions.shape[0]
    struck, tangent = speed > 0.0, size > 0
    links = Links(np.empty((count, N_LAW)), np.empty(count), heights, ends, mass, drag, top)
    s = make_series(count, ends.size, order)
    d = make_tangents(count, ends.size, order, directions)
    out = Samples(t, out_w, out_s, out_dw, out_ds)
    branches = np.empty(count, np.int64)
    scratch, late = np.zeros(order + 1), np.zeros(size)
    given, places = np.zeros((2, 2)), np.zeros((2, out_w.shape[0]))
    push, motion, rate, w_end = given[0], given[1], places[0], places[1]
    begin(rows, start, speed, directions, branches, links, s, d)
    bare = is_bare(links)
    w_scale, s_scale, pressed, knot, stalled = 0.0, 0.0, False, 0, 0
    switches = count - count  # a whole number, and no constant: one type to compile for
    now, done = (0.0 if struck else t[0]), 0
    if struck:
        done = _fill_before(out, speed)
    for step in range(max_steps):
        if done == t.size:
            return DONE, math.nan, step, switches
        fresh, horizon = False, t[t.size - 1]
        if not struck:
            while knot < t.size - 2 and now >= t[knot + 1]:
                knot += 1
                fresh = True
            horizon = _prescribe(top, values, t, knot, now, push, motion)
        if bare:
            expand_bare(links, s, push, order)
        elif not expand(links, s, push, motion, order):
            return FLAT_UNDER_STRESS, math.nan, step, switches
        if step > 0:
            s_scale = _loaded(s, s_scale)
        span = step_length(links, s, push, order, tol, horizon - now, w_scale, s_scale)
        if not math.isfinite(span) or not math.isfinite(s.group[0, order]):
            return NOT_FINITE, math.nan, step, switches
        span, spring, side = _first_switch(links, s, order, span)
        leaves = False
        if struck:
            pressed = pressed or s.group[0, 0] > tol * s_scale
            span, leaves = _first_lift(s, order, step == 0, pressed, span)
            spring = -1 if leaves else spring
        end = now + span
        stalled = stalled + 1 if span == 0.0 else 0
        if (end <= now and span > 0.0) or stalled > 4 * count + 8:
            return STEP_UNDERFLOW, math.nan, step, switches
        last = end >= horizon and not leaves and spring < 0
        end = horizon if last else end
        enough = _enough(s, order, span, 1e-3 * tol)
        more = min(enough + 2, order)  # for what is, in time, a derivative of these
        if tangent:
            expand_tangents(links, s, d, more)
        if top == MOTION and knot > 0 and fresh:
            _mend_kink(out, s, d, knot)
        first = done
        while done < t.size and (t[done] < end or (last and t[done] <= end)):
            done += 1
        if first < done:
            sample(links, s, enough, out, first, done, now, scratch)
        if tangent:
            sample_tangents(links, s, d, more, out, first, done, now, scratch)
            _delay(s, d, more, span, late)
        now = end
        if leaves:
            depart(links, s, d, order, more, span, now, late, rate, w_end, out, done)
            return DONE, now, step + 1, switches
        advance(s, order, span)
        if tangent:
            advance_tangents(d, more, span)
        w_scale, total = _reached(links, s, w_scale)
        if not math.isfinite(total):
            return NOT_FINITE, math.nan, step, switches
        settle(links, s)
        if spring >= 0:
            switches = switch(
                rows, branches, links, s, d, directions, order, span, now, spring, side,
                log, switches,
            )  # fmt: skip
    return TOO_MANY_STEPS, math.nan, max_steps, switches
