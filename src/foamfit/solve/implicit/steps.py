"""The compiled integrator for stiff scenes: implicit collocation from switch to switch.

Light masses and heavy or very light dashpots make rates that explicit steps must follow. The steps
of `implicit.collocation` (Radau IIA, order 9) need not: the method is L-stable, what relaxes or
vibrates too fast to be followed dies out (and `implicit.vibration` estimates how much that was).

No branch changes inside a step. A switch, or the end of contact, is the first crossing of the
polynomial; the step is then taken again, shorter, until it ends there. Derivatives by parameters
are carried along where they are asked for; the law is continuous at its switches, so they pass
from branch to branch without a jump.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math

import numpy as np

from foamfit.solve.implicit.collocation import (
    STAGES,
    Body,
    Points,
    PointTangents,
    State,
    collocate,
    guess,
    make_points,
    make_tangents,
)
from foamfit.solve.implicit.control import (
    AGAIN,
    CONTROL,
    FREELY,
    SHORT,
    SMALL_BASE_ERROR,
    Control,
    Limits,
    Polynomials,
    Start,
    aim,
    allowed_length,
    error_of,
    raise_floor,
)
from foamfit.solve.implicit.recording import (
    fly_on,
    mend_kink,
    record_rest,
    record_step,
)
from foamfit.solve.implicit.vibration import (
    Unresolved,
    contact_time,
    is_overdamped,
    remember,
)
from foamfit.solve.polynomial import slope_at
from foamfit.solve.scene import (
    DONE,
    FLAT_UNDER_STRESS,
    FREE,
    MOTION,
    NOT_FINITE,
    STEP_UNDERFLOW,
    STRESS,
    TOO_MANY_STEPS,
    VISCOUS,
    Samples,
    Scene,
    SceneTuple,
    before_contact,
    first_past,
    log_switch,
)
from foamfit.springs.kernels import (
    ETA,
    OPEN,
    Array,
    Branches,
    above,
    below,
    branch_at_strain,
    branch_shape,
    compiled,
    first_branch,
    inner,
    interval,
    once,
    slope_on,
    stress_on,
)
from foamfit.springs.parameters import OWN_HEIGHT
from foamfit.springs.sensitivities import stress_tangent


@inner
def _base_stress(scene: Scene, state: State, push: float) -> float:
    """Stress that the springs below the lowest node with a state carry together."""
    first, below_top = scene.ends[0], scene.ends.size > 1
    if not below_top and scene.top == STRESS:
        return push
    driven = not below_top and scene.top == VISCOUS
    flow, rate = 0.0, 0.0 if driven else state.v0[first - 1]
    for i in range(first):
        stress = stress_on(scene.rows[i], state.branches[i], state.eps0[i])
        if scene.rows[i, ETA] == 0.0:
            return stress
        flow += scene.heights[i] / scene.rows[i, ETA]
        rate += scene.heights[i] * stress / scene.rows[i, ETA]
    if driven:
        return (rate + push / scene.drag) / (flow + 1.0 / scene.drag)
    return rate / flow


@once
def _step(
    scene: Scene,
    limits: Limits,
    body: Body,
    state: State,
    at: Points,
    out: Polynomials,
    rates: Array,
    control: Control,
    start: Start,
    span: float,
    tally: Branches,
) -> tuple[int, float, bool, int, int]:
    """Find the longest step within `span` that is exact enough and ends no later than an event.

    Returns the outcome (DONE if there is one), its length, whether it ends at an event, which
    spring (or the base, one past the last) has it, and on which side.
    """
    count, struck, now = body.heights.size, scene.speed > 0.0, start.now
    zero: int = body.heights.size - count  # not the literal: every type is compiled on its own
    longest, trials, which, side = span, zero, zero - 1, zero
    weight = limits.base_weight if start.pressed else 0.0
    first, first_error = span, math.inf
    for _ in range(200):
        if now + span <= now:
            break
        guess(out.moves, state, body.moving, span, control.taken, at.z)
        if not collocate(body, state, start.push, start.push_rate, span, control.motion, at, tally):
            span *= 0.3
            longest, trials, which = span, zero, zero - 1
            continue
        error = error_of(body, state, at, start, weight, control, out)
        if trials == 0:
            if first_error == math.inf:
                first, first_error = span, error
            rounded = span <= 1e-6 * first and error > 0.3 * first_error
            allowed = allowed_length(limits, rates, control, now, span, error, rounded)
            if allowed < span:
                longest = span = allowed
                continue
        for i in range(count):
            out.slack[i] = max(1e-12, limits.tol * control.step_motion / body.heights[i])
        out.slack[count] = min(control.worst * limits.tol, 1e-3) * control.step_stress
        trials += 1
        what, span, which, side = aim(
            body, state, at, out, start, struck, span, longest, trials > 13, which, side
        )
        if what != AGAIN:
            return DONE, span, what != FREELY, which, side
    for i in range(count):
        curved, _, x0, _ = branch_shape(body.rows[i], state.branches[i])
        if curved and 1.0 - (state.eps0[i] - x0) < 1e-3:
            return NOT_FINITE, 0.0, False, -1, 0
    return STEP_UNDERFLOW, 0.0, False, -1, 0


# ---------------------------------------------------------------- the state between steps


@inner
def _begin(
    i0: int, start: Array, top: int, body: Body, state: State, d: PointTangents, control: Control
) -> None:
    """Fill the state at the start and its scales; the nodes below spring i0 are at rest."""
    node = 0.0
    for i in range(body.heights.size):
        row = body.rows[i]
        state.branches[i] = first_branch(row)
        if start.shape[1] > 0:
            state.eps0[i] = start[0, i]
            state.branches[i] = branch_at_strain(row, state.branches[i], start[0, i])
            node += body.heights[i] * start[0, i]
        state.w[i] = node if i >= i0 else 0.0
        control.stress = max(control.stress, abs(stress_on(row, state.branches[i], state.eps0[i])))
        control.motion = max(control.motion, body.heights[i] * abs(state.eps0[i]))
        for c in range(d.base.size):
            d.eps0[i, c] = start[1 + c, i] if start.shape[1] > 0 else 0.0
            d.w[i, c] = body.heights[i] * d.eps0[i, c] + (d.w[i - 1, c] if i > i0 else 0.0)
            if d.directions[c, 0] == i and d.directions[c, 1] == OWN_HEIGHT:
                d.w[i, c] += state.eps0[i]
    for c in range(d.base.size):
        if top == MOTION and i0 == 0:
            own = d.directions[c, 1] if d.directions[c, 0] == 0 else -1
            d.base[c] = stress_tangent(
                body.rows[0], state.branches[0], state.eps0[0], d.eps0[0, c], own
            )


@inner
def _drive(
    scene: Scene,
    body: Body,
    state: State,
    knot: int,
    fresh: bool,
    now: float,
    d: PointTangents,
    out: Samples,
) -> tuple[float, float, float]:
    """Prescribe motion or stress from sample `knot` on, which may be reached just now (`fresh`).

    Returns when that ends, and the stress on the top with its rate.
    """
    t, values, top = scene.t, scene.values, body.heights.size - 1
    horizon, rate = t[t.size - 1], 0.0
    if t.size > 1:
        horizon = t[knot + 1]
        rate = (values[knot + 1] - values[knot]) / (t[knot + 1] - t[knot])
    if scene.top != MOTION:
        return horizon, values[knot] + rate * (now - t[knot]), rate
    if fresh:
        if knot > 0 and scene.ends.size == 1:
            mend_kink(scene, body, knot, rate - state.v0[top], d, out)
        state.eps0[top] += (values[knot] - state.w[top]) / body.heights[top]  # without rounding
        state.w[top] = values[knot]
    state.v0[top] = state.v[top] = rate
    return horizon, 0.0, 0.0


@inner
def _carry(body: Body, state: State, at: Points, span: float, top: int, control: Control) -> None:
    """Carry the state over a step, and the scales of motion and stress with it."""
    end, last = STAGES - 1, body.heights.size - 1
    for i in range(last + 1):
        state.w[i] += at.z[i, end] + span * state.v0[i]
        state.eps0[i] = at.eps[i, end]
        state.v[i] = at.vel[i, end]
        control.motion = max(control.motion, body.heights[i] * abs(state.eps0[i]))
        stress = stress_on(body.rows[i], state.branches[i], state.eps0[i])
        control.stress = max(control.stress, abs(stress))
    for i in range(last + 1):
        if body.mass[i] > 0.0:
            state.v0[i] = state.v[i]
    if top != STRESS:
        control.motion = max(control.motion, abs(state.w[last]))
    control.base = max(control.base, abs(at.total[0, end]))
    control.stress = max(control.stress, control.base)


@inner
def _switch(
    body: Body,
    state: State,
    strains: Array,
    spring: int,
    side: int,
    span: float,
    now: float,
    first: int,
    log: Array,
    switches: int,
) -> tuple[int, bool]:
    """Change the branch of a spring, and of all that end theirs at the same time.

    Returns the switches so far, and whether a spring of the first group without dashpot opened:
    nothing presses on the base then.
    """
    opened = False
    for i in range(body.heights.size):
        low, high = interval(body.rows[i], state.branches[i])
        out = 0
        if i == spring:
            out = side
        elif span > 0.0:
            tilt = slope_at(strains[i], STAGES, 1.0)
            if tilt > 0.0 and state.eps0[i] >= high - 1e-12:
                out = 1
            elif tilt < 0.0 and state.eps0[i] <= low + 1e-12:
                out = -1
        if out == 0:
            continue
        left = state.branches[i]
        entered = above(left) if out > 0 else below(left)
        opened = opened or (entered == OPEN and i < first and body.rows[i, ETA] == 0.0)
        eps = high if out > 0 else low
        switches = log_switch(log, switches, now, i, left, entered, eps)
        state.branches[i] = entered
    return switches, opened


@inner
def _is_flat(body: Body, state: State, i0: int) -> bool:
    """Whether a spring from i0 on that nothing slows is on a flat branch."""
    for i in range(i0, body.heights.size):
        slope = slope_on(body.rows[i], state.branches[i], state.eps0[i])
        if body.rows[i, ETA] == 0.0 and slope == 0.0:
            return True
    return False


@once
def _follow(
    scene: Scene,
    limits: Limits,
    body: Body,
    state: State,
    at: Points,
    out: Polynomials,
    r: Unresolved,
    control: Control,
    d: PointTangents,
    samples: Samples,
    log: Array,
    start: Array,
    tally: Branches,
) -> tuple[int, float, int, int]:
    """Step from event to event; see `integrate_implicit`."""
    t, top, struck = scene.t, scene.top, scene.speed > 0.0
    count, groups, first = body.heights.size, scene.ends.size, scene.ends[0]
    i0 = scene.ends[groups - 2] if groups > 1 else 0
    now = 0.0 if struck else t[0]
    _begin(i0, start, top, body, state, d, control)
    done = 0
    if struck:
        state.v0[count - 1] = state.v[count - 1] = scene.speed
        done = before_contact(samples.curves, t, scene.speed)
        for c in range(d.base.size):
            before_contact(samples.slopes[c], t, 0.0)
    pressed, switches = scene.speed < 0.0, done - done  # no, and none: not literals
    knot, step, stalled, fall = done - done, 0, 0, 0.0
    while step < limits.max_steps:
        if done == t.size:
            return DONE, math.nan, step, switches
        horizon, push, push_rate = t[t.size - 1], 0.0, 0.0
        if not struck:
            fresh = step == 0 and stalled == 0
            while knot < t.size - 2 and now >= t[knot + 1]:
                knot += 1
                fresh = True
            horizon, push, push_rate = _drive(scene, body, state, knot, fresh, now, d, samples)
        if top == STRESS and _is_flat(body, state, i0):
            return FLAT_UNDER_STRESS, now, step, switches
        base = _base_stress(scene, state, push)
        if horizon <= now:  # a single sample, or the last one
            record_rest(done, state, base, d, samples)
            return DONE, math.nan, step, switches
        span = min(horizon - now, control.proposed)
        begin = Start(now, base, pressed, push, push_rate)
        outcome, span, arrived, target, side = _step(
            scene, limits, body, state, at, out, r.rates, control, begin, span, tally
        )
        if outcome != DONE:
            return outcome, now, step, switches
        leaves = arrived and target == count
        stalled += 1
        if span > 0.0 and now + span > now:
            step, stalled = step + 1, 0
            last = span >= horizon - now or now + span >= horizon
            end = horizon if last else now + span
            begun, done = done, first_past(t, done, end, last)
            if not record_step(body, state, at, out, now, span, begun, done, d, samples):
                return NOT_FINITE, now, step, switches
            remember(scene, state, at, span, t[min(begun, t.size - 1)] - now, r)
            _carry(body, state, at, span, top, control)
            fall = slope_at(out.base, STAGES, 1.0) / span
            pressed = pressed or (not leaves and at.total[0, STAGES - 1] > 10.0 * out.slack[count])
            now = end
            raise_floor(span, last, limits, control)
        elif stalled > 4 * count + 8:
            return STEP_UNDERFLOW, now, step, switches
        if not arrived:
            continue
        if not leaves:
            switches, opened = _switch(
                body, state, out.strains, target, side, span, now, first, log, switches
            )
            leaves = opened and struck and pressed
        if leaves:
            fly_on(body, state, at, fall, now, done, d, samples, out.slack)
            return DONE, now, step, switches
    return TOO_MANY_STEPS, now, limits.max_steps, switches


@compiled
def integrate_implicit(
    given: SceneTuple,
    tol: float,
    max_steps: int,
    directions: Branches,
    start: Array,
    curves: Array,
    slopes: Array,
    log: Array,
    tally: Branches,
) -> tuple[int, float, int, int, float]:
    """Integrate a chain from rest (or struck) over the samples of a scene, by implicit steps.

    The arguments are those of `explicit.taylor.integrate`, as are the outcomes; `tol` is the
    truncation of a step relative to the motion so far. `tally` (2,) is filled with the
    linear systems solved and with the blocks eliminated in them.

    Returns
    -------
    tuple
        Outcome, end of contact (NaN if none; where there is no answer, how far it came), steps
        taken, switches (also those past the log), and the size, relative to the motion and stress,
        of the vibrations that were damped out because they could not be followed.
    """
    scene = Scene(*given)
    rows, heights, ends, top, t = scene.rows, scene.heights, scene.ends, scene.top, scene.t
    count, groups, struck = heights.size, ends.size, scene.speed > 0.0
    areal = np.zeros(count)
    for g in range(groups):
        if g < groups - 1 or top == FREE:
            areal[ends[g] - 1] = scene.mass[g]
    duration = t[t.size - 1] - (0.0 if struck else t[0])
    if struck:
        duration = min(duration, 5.0 * contact_time(scene))
    weight = min(1.0, tol / SMALL_BASE_ERROR) if is_overdamped(scene) else 0.0
    short = SHORT * duration * (tol / 3e-8) ** (1.0 / 6.0)
    limits = Limits(tol, max_steps, short, weight)
    body = Body(rows, heights, areal, scene.drag, count - 1 if top == MOTION else count)
    at, d = make_points(count), make_tangents(count, directions)
    shape = (count, STAGES + 1)
    out = Polynomials(
        np.zeros(shape), np.zeros(shape), np.zeros(STAGES + 1), np.zeros(count + 1),
        np.zeros((count, STAGES)), np.zeros(STAGES + 1),
    )  # fmt: skip
    r = Unresolved(
        np.zeros(groups), np.zeros(groups), np.zeros(2), np.zeros((groups, 3)), np.zeros(count)
    )
    moving = np.zeros((4, count))
    state = State(moving[0], moving[1], moving[2], moving[3], np.empty(count, np.int64))
    memory = np.zeros(1, CONTROL)  # used again below: it would be freed after its last use
    memory[0].worst, memory[0].proposed = 1.0, 0.02 * duration if struck else math.inf
    outcome, end, steps, switches = _follow(
        scene, limits, body, state, at, out, r, memory[0], d, Samples(t, curves, slopes), log,
        start, tally,
    )  # fmt: skip
    lost = memory[0].damped
    if r.worst[1] > 0.0:
        lost += max(r.worst[0] / memory[0].motion, r.worst[1] / memory[0].stress)
    return outcome, end, steps, switches, lost
