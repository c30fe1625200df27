"""The compiled integrator: Taylor series between switches of branch.

A step is as long as the series of `explicit.series` allow at the requested tolerance. Switches of
branch and the end of contact are roots, and samples are values, of the same polynomials. No branch
changes inside a step. Derivatives by parameters are integrated on request.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve import scene as scenes
from foamfit.solve.explicit.memory import (
    Memory,
    advance_memory,
    first_turn,
    leave,
    load,
    longest,
    make_memory,
    mark_one_sided,
)
from foamfit.solve.explicit.samples import delay, depart, mend_kink, sample, sample_tangents
from foamfit.solve.explicit.series import (
    DASHPOT,
    EPS,
    GROUP,
    HEIGHT,
    HIGH,
    LOW,
    N_LAW,
    SIG,
    Links,
    SeriesTangents,
    V,
    W,
    advance,
    enter,
    enter_tangents,
    expand,
    expand_bare,
    is_bare,
    make_series,
    settle,
    settle_together,
    share_a_stress,
    share_stresses,
)
from foamfit.solve.explicit.tangents import advance_tangents, expand_tangents, start_relaxing
from foamfit.solve.polynomial import LEAST_TRUNCATION, first_crossing, order_for, slope_at, value_at
from foamfit.solve.scene import Samples, SceneTuple, before_contact, first_past, log_switch
from foamfit.springs.kernels import (
    BACK,
    ETA,
    HELD,
    KIND,
    N_COLUMNS,
    A,
    Array,
    Branches,
    above,
    below,
    branch_at_strain,
    compiled,
    first_branch,
    inlined,
    inner,
    once,
    piece,
)
from foamfit.springs.law import MICROSCALE
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_RELAXATION

CLOSE = 1e-13  # distance of a strain from the end of a branch below which it is at the end
TURN = 2  # "side" on which a spring leaves its branch at a turning point
MOST_ORDERS = 24
Scales = tuple[float, float, float]  # largest displacement, stress and base stress so far
OF_TANGENTS = 1e3  # relative truncation of derivatives over that of the motion


class Run(NamedTuple):
    """State and output of a run.

    Loops that take it at every step are `inlined`, because passing it would take longer than they.
    """

    rows: Array  #: springs, (springs, columns)
    branches: Branches  #: (springs,)
    links: Links
    s: Array  #: series, see `Links`
    d: SeriesTangents
    directions: Branches  #: of the derivatives, (p, 2)
    out: Samples
    log: Array  #: switches of branch


@inlined
def _tail(
    law: Array, s: Array, n: int, per_reach: float, per_load: float, per_base: float
) -> float:
    """Return the largest coefficient of order n of strains and stresses, over their scales."""
    worst = abs(s[GROUP, 0, n]) * per_base
    for i in range(law.shape[0]):
        worst = max(worst, abs(s[EPS, i, n]) * law[i, HEIGHT] * per_reach)
        worst = max(worst, abs(s[SIG, i, n]) * per_load)
    return worst


@inlined
def step_length(
    links: Links, s: Array, push: Array, order: int, tol: float, span: float, scales: Scales
) -> float:
    """Return the longest step within `span` with the last two terms below `tol`.

    The terms are relative to the scales of motion, stress and base stress. An infinite scale of the
    base stress means that it needs no test of its own.
    """
    w_scale, s_scale, b_scale = scales
    reach, load = w_scale, max(s_scale, abs(push[0]))
    for _ in range(60):  # at rest the step itself sets the scale
        tried = span
        if w_scale == 0.0 or s_scale == 0.0:
            top = links.ends.size - 1
            reach = max(w_scale, abs(s[W, top, 1]) * span if links.top != scenes.STRESS else 0.0)
            load = max(s_scale, max(abs(push[0]), abs(push[1]) * span))
            for i in range(links.law.shape[0]):
                reach = max(reach, links.law[i, HEIGHT] * abs(s[EPS, i, 1]) * span)
                load = max(load, abs(s[SIG, i, 1]) * span)
        per_reach = 1.0 / reach if reach > 0.0 else 0.0
        per_load = 1.0 / load if load > 0.0 else 0.0
        base = b_scale
        if b_scale < math.inf:
            base = max(b_scale, abs(value_at(s[GROUP, 0], order, span)), scenes.LEAST_BASE * load)
        per_base = 1.0 / base if base > 0.0 else 0.0
        for n in (order - 1, order):
            tail = _tail(links.law, s, n, per_reach, per_load, per_base)
            if tail * span**n > tol:
                span = (tol / tail) ** (1.0 / n)
        if span >= 0.5 * tried:
            break
        if w_scale > 0.0 and s_scale > 0.0 and base == b_scale:
            break
    return span


@piece
def tangent_length(
    law: Array, d: SeriesTangents, order: int, tol: float, span: float, sizes: Array, lagging: bool
) -> float:
    """Return the longest step within `span` for the derivatives.

    Their last two terms must be below `tol` of their sizes so far. A vibration or relaxation that
    appears only in the derivatives grows without bound if steps are too long for it. `sizes` (p, 2)
    are the largest elongation and base stress of each direction; springs with memory (`lagging`)
    may have directions that are still zero and do not bound the step.
    """
    for p in range(d.drag.size):
        if d.live[p] == 0.0:
            continue
        for part in range(2):
            for _ in range(2):  # a step that is too long overestimates the size
                bar = tail = before = 0.0
                for i in range(law.shape[0] if part == 0 else 1):
                    c = d.series[p, EPS, i] if part == 0 else d.series[p, GROUP, 0]
                    weight, power = law[i, HEIGHT] if part == 0 else 1.0, 1.0
                    for n in range(order // 2 + 1):
                        bar = max(bar, weight * abs(c[n]) * power)
                        power *= span
                    before = max(before, weight * abs(c[order - 1]))
                    tail = max(tail, weight * abs(c[order]))
                size, longest = max(sizes[p, part], bar), span
                if lagging and size == 0.0:
                    break
                bar = tol * size
                if before * span ** (order - 1) > bar:
                    span = (bar / before) ** (1.0 / (order - 1))
                if tail * span**order > bar:
                    span = (bar / tail) ** (1.0 / order)
                if span == longest:
                    break
            sizes[p, part] = size
    return span


@piece
def first_switch(law: Array, s: Array, order: int, span: float) -> tuple[float, int, int]:
    """Return time, spring (-1: none) and side of the first end of a branch within `span`."""
    spring, side = -1, 0
    for i in range(law.shape[0]):
        when, where = first_crossing(s[EPS, i], order, law[i, LOW], law[i, HIGH], span)
        if where != 0 and (spring < 0 or when < span):
            span, spring, side = when, i, where
    return span, spring, side


@inner
def _enough(law: Array, s: Array, order: int, span: float, tol: float, scales: Scales) -> int:
    """Return the order that suffices for a step shortened by a switch or a sample."""
    w_scale, s_scale, b_scale = scales
    base = max(b_scale, scenes.LEAST_BASE * s_scale)
    if w_scale == 0.0 or s_scale == 0.0 or span == 0.0:
        return order
    tail, power, per_span = 0.0, span**order, 1.0 / span
    while order > 2:
        tail += _tail(law, s, order, 1.0 / w_scale, 1.0 / s_scale, 1.0 / base) * power
        if tail > tol:
            break
        power *= per_span
        order -= 1
    return order


# ---------------------------------------------------------------- the state between steps


@inner
def switch(
    run: Run,
    order: int,
    span: float,
    now: float,
    spring: int,
    side: int,
    switches: int,
    push: Array,
    memory: Memory | None,
) -> int:
    """Switch a spring, and all that switch at the same time; return the number of switches."""
    rows, branches, law, eps = run.rows, run.branches, run.links.law, run.s[EPS]
    turned = branches[spring]
    for i in range(branches.size):
        near = 1.0
        if rows[i, KIND] == MICROSCALE:  # micro-springs may snap at any strain above 0
            near = min(abs(eps[i, 0]), 1.0)
        together = False
        if memory is not None and side == TURN and branches[i] == turned:
            together = share_a_stress(law, run.links.ends, i, spring, memory)
        if i == spring:
            out = side
        elif together:
            out = TURN  # their common stress turns
        elif eps[i, 0] >= law[i, HIGH] - CLOSE * near and slope_at(eps[i], order, span) > 0.0:
            out = 1
        elif eps[i, 0] <= law[i, LOW] + CLOSE * near and slope_at(eps[i], order, span) < 0.0:
            out = -1
        else:
            continue
        left = branches[i]
        if out != TURN:
            eps[i, 0] = law[i, HIGH] if out > 0 else law[i, LOW]
        branches[i] = above(left) if out > 0 else below(left)
        if memory is not None and rows[i, KIND] == MICROSCALE:
            up = left == BACK if out == TURN else out > 0
            moved = run.d.series[:, EPS, :, 0]
            branches[i] = leave(memory, i, eps[i, 0], up, out == TURN, moved)
        switches = log_switch(run.log, switches, now, i, left, branches[i], eps[i, 0])
        enter(rows, i, branches[i], law, memory)
        enter_tangents(rows, i, branches[i], run.directions, run.d)
    if memory is not None and share_stresses(run.links):
        settle_together(run.links, run.s, order, span, push, memory)
    return switches


# ---------------------------------------------------------------- from step to step


@inner
def _prescribe(
    top: int, values: Array, clock: Array, knot: int, now: float, push: Array, motion: Array
) -> float:
    """Prescribe the top from a sample on; return the time from it to the next sample."""
    horizon = rate = 0.0
    if values.size > 1:
        horizon = clock[knot + 1]
        rate = (values[knot + 1] - values[knot]) / horizon
    driven = motion if top == scenes.MOTION else push
    driven[0], driven[1] = values[knot] + rate * now, rate
    return horizon


@piece
def first_lift(s: Array, order: int, first: bool, pressed: bool, span: float) -> tuple[float, bool]:
    """Return when the base stress returns to zero within `span`, and whether it does.

    Before the impact has reached the base (`pressed`), rounding errors may cross zero, and do not
    count. Only in the first step can it reach the base and end.
    """
    base = s[GROUP, 0]
    when, where = first_crossing(base, order, 0.0, math.inf, span)
    if pressed and base[0] <= 0.0 and base[1] <= 0.0:
        when, where = 0.0, -1  # a unilateral spring has just opened
    if where != 0 and when <= span and (pressed or (first and when > 0.0)):
        return when, True
    return span, False


@inner
def begin(
    run: Run, heights: Array, start: Array, speed: float, gravity: float, memory: Memory | None
) -> int:
    """Set the initial state; return the number of samples before an impact."""
    rows, branches, law, s, d = run.rows, run.branches, run.links.law, run.s, run.d
    for i in range(branches.size):
        branches[i] = first_branch(rows[i])
        if start.shape[1] > 0:
            s[EPS, i, 0] = start[0, i]
            branches[i] = branch_at_strain(rows[i], branches[i], start[0, i])
            for p in range(d.drag.size):
                d.series[p, EPS, i, 0] = start[1 + p, i]
                if start[1 + p, i] != 0.0:
                    d.live[p] = 1.0
        law[i, DASHPOT], law[i, HEIGHT] = rows[i, ETA], heights[i]
        if memory is not None and rows[i, KIND] == MICROSCALE:
            branches[i] = A if start.shape[1] == 0 else load(memory, i, start[0, i])
        enter(rows, i, branches[i], law, memory)
        enter_tangents(rows, i, branches[i], run.directions, d)
        if memory is not None and start.shape[1] > 0:
            start_relaxing(law, i, s, d, memory)
    if speed == 0.0:
        return 0
    s[V, run.links.ends.size - 1, 0] = speed
    for p in range(d.drag.size):
        before_contact(run.out.slopes[p], run.out.t, 0.0, 0.0)
    return before_contact(run.out.curves, run.out.t, speed, gravity)


@inner
def _reached(links: Links, s: Array, w_scale: float) -> tuple[float, float]:
    """Return the largest displacement so far, and a number that is finite if the state is."""
    top = links.ends.size - 1
    total = s[W, top, 0]
    if links.top != scenes.STRESS:
        w_scale = max(w_scale, abs(s[W, top, 0]))
    for i in range(links.law.shape[0]):
        w_scale = max(w_scale, links.law[i, HEIGHT] * abs(s[EPS, i, 0]))
        total += s[EPS, i, 0]
    return w_scale, total


@inlined
def _first_end(
    run: Run, order: int, tol: float, span: float, c: Array, memory: Memory | None
) -> tuple[float, int, int]:
    """Return the first end of a branch, or turn of a snapping spring; see `first_switch`."""
    if memory is not None:
        fine = 0.0 if run.directions.shape[0] > 0 else tol  # no snap is negligible for derivatives
        for i in range(run.branches.size):
            if run.branches[i] > HELD:
                span = longest(memory.series[i], memory.now[i], order, fine, span)
    span, spring, side = first_switch(run.links.law, run.s, order, span)
    if memory is not None:
        span, turning = first_turn(run.branches, run.s[EPS], order, span, c)
        if turning >= 0:
            spring, side = turning, TURN
    return span, spring, side


@inlined
def _scales(run: Run, started: bool, reach: float, stress: float, base: float) -> Scales:
    """Return the largest displacement, stress and base stress so far.

    Without a mass or dashpot at the base, the base stress cannot be much smaller, or change faster,
    than the stresses of the springs, and its scale is infinite.
    """
    for i in range(run.branches.size if started else 0):
        stress = max(stress, abs(run.s[SIG, i, 0]))
    if run.links.ends.size > 1 or run.links.law[0, DASHPOT] > 0.0:
        base = max(base if started else 0.0, abs(run.s[GROUP, 0, 0]))
    return reach, stress, base


@inlined
def _shorten(
    run: Run, order: int, tol: float, span: float, sizes: Array, memory: Memory | None
) -> float:
    """Fill the derivatives of a step; return the longest step within `span` for them."""
    expand_tangents(run.links, run.s, run.d, order, memory)
    if memory is not None:
        mark_one_sided(memory, run.branches, run.s[EPS], run.d.series[:, EPS], order, span)
    lagging = memory is not None
    return tangent_length(run.links.law, run.d, order, OF_TANGENTS * tol, span, sizes, lagging)


@inlined
def _record(
    run: Run,
    orders: tuple[int, int],
    span: float,
    first: int,
    done: int,
    now: float,
    scratch: Array,
    ends: bool,
) -> None:
    """Write samples first … done-1 of a step and, if it `ends` at an event, the delay of that."""
    if first < done:
        sample(run.links, run.s, orders[0], run.out, first, done, now, scratch[3])
    if run.directions.shape[0] > 0:
        sample_tangents(run.links, run.s, run.d, orders[1], run.out, first, done, now, scratch[3])
        if ends:  # the base stress may end with this step
            delay(run.s, run.d, orders[1], span, scratch[0])


@inlined
def _carry(
    run: Run, order: int, more: int, span: float, push: Array, memory: Memory | None
) -> None:
    """Advance the state, and the derivatives to order `more`, and redistribute elongations."""
    groups = run.links.ends.size
    advance(run.s, groups, order, span)
    if memory is not None:
        advance_memory(memory.state, memory.series, order, span)
    if run.directions.shape[0] > 0:
        advance_tangents(run.d, groups, more, span, memory)
    if share_stresses(run.links):
        if memory is None:
            settle(run.links, run.s)
        else:
            settle_together(run.links, run.s, order, span, push, memory)


@inner
def _fill_clock(t: Array, struck: bool, clock: Array) -> None:
    """Store the times of a drive as differences: a distant origin would cost digits."""
    for j in range(1, t.size if not struck else 1):
        clock[j] = t[j] - t[j - 1]


@inlined
def _passed(clock: Array, done: int, knot: int, end: float, last: bool, struck: bool) -> int:
    """Return the number of samples filled after a step; the `last` ends at the next sample."""
    if struck:
        return first_past(clock, done, end, last)
    if last:
        return min(knot + 2, clock.size)
    return max(done, 1) if end > 0.0 else done


@once
def _integrated(
    given: SceneTuple,
    tol: float,
    max_steps: int,
    directions: Branches,
    start: Array,
    out: Array,
    log: Array,
    memory: Memory | None,
) -> tuple[int, float, int, int]:
    """Integrate a chain of springs with or without memory; see `integrate`."""
    rows, heights, ends, mass, drag, top, values, speed, t = given
    tol = max(tol, LEAST_TRUNCATION)
    count, size = heights.size, directions.shape[0]
    struck, order = speed > 0.0, order_for(tol, MOST_ORDERS)
    links = Links(np.empty((count, N_LAW)), ends, mass, drag, top)
    s, d = make_series(count, order, directions)
    samples = Samples(t if struck else np.zeros(t.size), out[0], out[1:])
    _fill_clock(t, struck, samples.t)
    run = Run(rows, np.empty(count, np.int64), links, s, d, directions, samples, log)
    scratch, sizes = np.zeros((6, max(order + 1, max(size, out.shape[1])))), np.zeros((size, 2))
    push, motion = scratch[4], scratch[5]
    push[0] = values[0] * struck  # the weight of a striker
    gravity = push[0] / mass[mass.size - 1]
    done = begin(run, heights, start, speed, gravity, memory)
    bare, scales = is_bare(links, memory), (0.0, 0.0, math.inf)
    pressed, knot, stalled = False, 0, 0
    switches = count - count  # 0, but not a literal, which would be another type
    now = since = 0.0  # along a drive, since the last sample
    for step in range(max_steps):
        if done == t.size:
            return scenes.DONE, math.nan, step, switches
        fresh, horizon = False, t[t.size - 1]
        if not struck:
            fresh = done == knot + 2
            if fresh:
                knot, now = knot + 1, 0.0
            since = t[knot]
            horizon = _prescribe(top, values, samples.t, knot, now, push, motion)
        if bare:
            expand_bare(links, s, push, order, memory)
        elif not expand(links, s, push, motion, order, memory):
            return scenes.FLAT_UNDER_STRESS, since + now, step, switches
        scales = _scales(run, step > 0, scales[0], scales[1], scales[2])
        span = step_length(links, s, push, order, tol, horizon - now, scales)
        if not math.isfinite(span + s[GROUP, 0, order]):
            return scenes.NOT_FINITE, since + now, step, switches
        span, spring, side = _first_end(run, order, tol, span, scratch[3], memory)
        leaves = False
        if struck:
            pressed |= s[GROUP, 0, 0] > tol * scales[1]
            span, leaves = first_lift(s, order, step == 0, pressed, span)
        least = order
        if spring >= 0 or leaves or now + span >= horizon:  # an event ended the step
            least = _enough(links.law, s, order, span, 1e-3 * tol, scales)
        more = min(least + 2, order)  # for their time derivatives
        if size > 0:
            shorter = _shorten(run, more, tol, span, sizes, memory)
            if shorter < span:
                span, spring, leaves = shorter, -1, False
        end, stalled = now + span, stalled + 1 if span == 0.0 else 0
        if (end <= now and span > 0.0) or stalled > 4 * count + 8:
            return scenes.STEP_UNDERFLOW, since + now, step, switches
        last = end >= horizon and not leaves and spring < 0
        end = horizon if last else end
        if fresh and top == scenes.MOTION:
            mend_kink(samples, s, d, knot)
        first, done = done, _passed(samples.t, done, knot, end, last, struck)
        _record(run, (least, more), span, first, done, now, scratch, leaves or spring >= 0)
        if leaves:
            depart(links, s, d, order, more, span, end, gravity, samples, done, scratch)
            return scenes.DONE, end, step + 1, switches
        now = end
        _carry(run, order, more, span, push, memory)
        reach, total = _reached(links, s, scales[0])
        scales = reach, scales[1], scales[2]
        if not math.isfinite(total):
            return scenes.NOT_FINITE, since + now, step, switches
        if spring >= 0:
            switches = switch(run, order, span, since + now, spring, side, switches, push, memory)
    return scenes.TOO_MANY_STEPS, since + now, max_steps, switches


@compiled
def integrate(
    rows: Array,
    heights: Array,
    ends: Branches,
    mass: Array,
    numbers: Array,
    values: Array,
    t: Array,
    directions: Branches,
    start: Array,
    out: Array,
    log: Array,
) -> tuple[int, float, int, int]:
    """Integrate a chain over the samples of a scene.

    rows, heights, ends, mass, values and t are fields of a `Scene`; passing a `Scene` would take as
    long as a short run. `numbers` (5,) contains its drag, top and speed, the truncation of a step
    relative to the motion so far, and the bound on steps. An impact ends when the base stress
    returns to zero. Derivatives are computed in `directions` (p, 2). Springs start from strains and
    their derivatives, `start` (1 + p, springs), or from rest (1 + p, 0). The curves and their
    derivatives are written to `out` (1 + p, …), see `Samples`, and the switches to `log`.

    Return the outcome, the end of contact (NaN if none; after a failure, the time reached), the
    number of steps, and the number of switches, including those that did not fit the log.
    """
    given = (rows, heights, ends, mass, numbers[0], int(numbers[1]), values, numbers[2], t)
    return _integrated(given, numbers[3], int(numbers[4]), directions, start, out, log, None)


@compiled
def integrate_with_memory(
    given: SceneTuple,
    unit: float,
    tol: float,
    max_steps: int,
    directions: Branches,
    start: Array,
    out: Array,
    log: Array,
    one_sided: Array,
) -> tuple[int, float, int, int]:
    """Integrate a chain with microscale springs or relaxation; see `integrate`.

    The internal unit of time is `unit`, s. One-sided derivatives are marked in `one_sided` (p,).
    """
    rows, heights, ends, mass, drag, top, values, speed, t = given
    order = order_for(max(tol, LEAST_TRUNCATION), MOST_ORDERS)
    rows, terms = rows.copy(), rows[:, N_COLUMNS:].shape[1]
    for i in range(heights.size):
        rows[i, ETA] /= unit
        for k in range(1, terms, 2):
            rows[i, N_COLUMNS + k] /= unit
    scene = (
        rows, heights, ends, mass / unit**2, drag / unit, top, values, speed * unit, t / unit,
    )  # fmt: skip
    memory = make_memory(rows, order, directions, one_sided)
    outcome, end, steps, switches = _integrated(
        scene, tol, max_steps, directions, start, out, log, memory
    )
    for j in range(min(switches, log.shape[0])):
        log[j, 0] *= unit
    for p in range(directions.shape[0]):
        what = directions[p, 1]
        of_tau = what > OWN_RELAXATION and (what - OWN_RELAXATION) % 2 == 1
        if of_tau or what in (OWN_ETA, DRAG):
            for curve in out[1 + p]:
                for j in range(curve.size):
                    curve[j] /= unit
    return outcome, end * unit, steps, switches
