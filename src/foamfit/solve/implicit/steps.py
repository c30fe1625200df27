"""The compiled integrator for stiff scenes: implicit collocation from switch to switch.

Light masses and heavy or very light dashpots make rates that explicit steps must follow. The steps
of `implicit.collocation` (Radau IIA, order 9) need not: the method is L-stable, what relaxes or
vibrates too fast to be followed dies out (and `implicit.vibration` tells how much that was).

No branch changes inside a step. A switch, or the end of contact, is the first crossing of the
polynomial; the step is then taken again, shorter, until it ends there. Derivatives by parameters
are carried along where they are asked for; the law is continuous at its switches, so they pass
from branch to branch without a jump.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.explicit.series import FREE, MOTION, OWN_ETA, OWN_HEIGHT, STRESS, VISCOUS
from foamfit.solve.explicit.taylor import (
    DONE,
    FLAT_UNDER_STRESS,
    LEAST_BASE,
    NOT_FINITE,
    STEP_UNDERFLOW,
    TOO_MANY_STEPS,
    Samples,
    before_contact,
    first_past,
    fly,
)
from foamfit.solve.implicit.collocation import (
    NODES,
    RATES,
    STAGES,
    THROUGH,
    Body,
    Points,
    State,
    Tangents,
    collocate,
    guess,
    linearise,
    make_points,
    make_tangents,
    polynomial,
    stress_tangent,
    truncation,
)
from foamfit.solve.implicit.vibration import bounce, parts_faintly, passed_over, ringing_of, rings
from foamfit.solve.polynomial import first_crossing, slope_at, value_at
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

# Steps that the error alone makes short, compared with the motion, before they may grow anyway:
# then something vibrates too fast to be worth following, and is damped out. Where that would cost
# more than the wanted error, it is followed for so many steps of one spring all the same.
SHORT, PATIENCE, LITTLE_PATIENCE, LONGEST_PATIENCE = 5e-4, 600, 60, 10_000
# Behind heavy dashpots contact ends when no more than 1e-12 of the peak of the base stress is left:
# while the striker presses it is followed with so large an error of what is left, at most.
FAINT = 1e-7

# The memory of the step control: length of the last step and of that proposed; the least that the
# error may ask for; steps in a row, and in all, that the error alone made short; the largest error
# let pass, over tol; vibrations that were damped out, and that of the last steps; how far anything
# has moved (m) and the largest stress (Pa); length and error of the first trial of this step; the
# largest base stress (Pa).
TAKEN, PROPOSAL, FLOOR, HURRY, SHORTS, WORST, SEEN, BURST, REACH, LOAD = range(10)
TRIAL_SPAN, TRIAL_ERROR, BASE, N_PACE = range(10, 14)
# What to do with a step whose end was compared with the first event in it.
AGAIN, FREELY, ARRIVED, AT_ONCE = range(4)


class Scene(NamedTuple):
    """What does not change: the arguments of `integrate_implicit`, and what follows from them.

    `short` is the length under which steps are short, `faint` weighs the truncation of the base
    stress relative to what is left of it, ringing (groups, 2) is what `ringing_of` returns and
    `fast` tells whether anything vibrates at all.
    """

    ends: Branches
    mass: Array
    drag: float
    top: int
    values: Array
    struck: bool
    t: Array
    tol: float
    wanted: float
    short: float
    faint: float
    ringing: Array
    fast: bool


class Curves(NamedTuple):
    """Polynomials over [0, 1] of a step: moves and strains (springs, 6), base stress (6,).

    slack (springs + 1,) is what strains and base stress are known to; stress (springs, points) and
    some (6,) are scratch.
    """

    moves: Array
    strains: Array
    base: Array
    slack: Array
    stress: Array
    some: Array


class Ripples(NamedTuple):
    """Vibrations that steps passed over, per mass (groups,): see `passed_over`.

    worst (2,) is the largest motion and stress that they had at a sample.
    """

    alive: Array
    begun: Array
    fading: Array
    worst: Array


@inner
def _base_stress(
    rows: Array,
    branches: Branches,
    heights: Array,
    eps: Array,
    first: int,
    below_top: bool,
    top: int,
    v_top: float,
    drag: float,
    push: float,
) -> float:
    """Stress that the `first` springs at the base carry together, up to the lowest node with state.

    `v_top` is the velocity of that node, if it has one.
    """
    if not below_top and top == STRESS:
        return push
    flow, rate = 0.0, v_top
    for i in range(first):
        stress = stress_on(rows[i], branches[i], eps[i])
        if rows[i, ETA] == 0.0:
            return stress
        flow += heights[i] / rows[i, ETA]
        rate += heights[i] * stress / rows[i, ETA]
    if not below_top and top == VISCOUS:
        return (rate + push / drag) / (flow + 1.0 / drag)
    return rate / flow


@inner
def _describe(
    body: Body, state: State, at: Points, base0: float, faint: float, pace: Array, out: Curves
) -> tuple[float, float, float]:
    """Fill the polynomials of the strains and the base stress of a step.

    Returns the truncation relative to the scales of motion and stress, and these scales with what
    the step itself reaches. While the striker presses, `faint` weighs the truncation of the base
    stress relative to what is left of it.
    """
    rows, heights = body.rows, body.heights
    reach, load = pace[REACH], pace[LOAD]
    present, parts = abs(base0), 0.0
    for i in range(heights.size):
        polynomial(state.eps0[i], at.eps[i], out.strains[i])
        for j in range(STAGES):
            out.stress[i, j] = stress_on(rows[i], state.branches[i], at.eps[i, j])
            reach = max(reach, heights[i] * abs(at.eps[i, j]))
            load = max(load, abs(out.stress[i, j]))
    for j in range(STAGES):
        present = max(present, abs(at.total[0, j]))
        parts = max(parts, abs(out.stress[0, j]))
    load = max(load, present)
    polynomial(base0, at.total[0], out.base)
    left_out = truncation(out.base)
    error = left_out / max(pace[BASE], present, LEAST_BASE * load) if load > 0.0 else 0.0
    if faint > 0.0 and load > 0.0:  # what is left is known to the rounding of its parts
        error = max(error, faint * left_out / max(present, FAINT * parts))
    for i in range(heights.size):
        if reach > 0.0:
            error = max(error, truncation(out.strains[i]) * heights[i] / reach)
        if load > 0.0:
            first = stress_on(rows[i], state.branches[i], state.eps0[i])
            polynomial(first, out.stress[i], out.some)
            error = max(error, truncation(out.some) / load)
    return error, reach, load


@inner
def _first_event(
    rows: Array,
    branches: Branches,
    strains: Array,
    base: Array,
    slack: Array,
    struck: bool,
    pressed: bool,
) -> tuple[float, int, int]:
    """First event of a step: where in [0, 1], which spring (-1: none, the last + 1: base), side.

    A spring that starts within `slack` of the end of its branch leaves it by more than that. The
    last slack is that of the base stress, which has to rise by ten times as much before contact can
    end.
    """
    when, which, side = 1.0, -1, 0
    count = branches.size
    for i in range(count):
        low, high = interval(rows[i], branches[i])
        if abs(strains[i, 0] - low) <= slack[i]:
            low -= slack[i]
        if abs(strains[i, 0] - high) <= slack[i]:
            high += slack[i]
        at, out = first_crossing(strains[i], STAGES, low, high, 1.0)
        if out != 0 and (which < 0 or at < when):
            when, which, side = at, i, out
    if struck:
        low = 0.0 if pressed else -slack[count]
        at, out = first_crossing(base, STAGES, low, math.inf, 1.0)
        risen = pressed or value_at(base, STAGES, 0.5 * at) > 10.0 * slack[count]
        if out != 0 and at <= when and risen:
            when, which, side = at, count, out
    return when, which, side


# ---------------------------------------------------------------- the length of a step


@inner
def _vibrating(
    scene: Scene, body: Body, state: State, at: Points, span: float, wait: float, r: Ripples
) -> tuple[float, float, float, float]:
    """What `passed_over` says of a step."""
    return passed_over(
        body.rows, state.branches, body.heights, scene.ends, scene.mass, scene.drag, scene.top,
        state.eps0, at.z, span, wait, r.alive, r.begun, r.fading,
    )  # fmt: skip


@inner
def _bearable(
    scene: Scene,
    body: Body,
    state: State,
    at: Points,
    now: float,
    span: float,
    wait: float,
    error: float,
    reach: float,
    load: float,
    pace: Array,
    r: Ripples,
) -> float:
    """Length at which to take a step whose truncation is `error`: its own where that may pass."""
    tol, count = scene.tol, body.heights.size
    error /= tol
    if not math.isfinite(error):
        return 0.3 * span
    factor = 0.9 * max(error, 1e-12) ** (-1.0 / 6.0)
    stuck = False  # rounding, or a layer thinner than the clock can tell
    if error > 1.0 and span <= 1e-6 * pace[TRIAL_SPAN]:
        stuck = error > 0.3 * pace[TRIAL_ERROR]
        pace[TRIAL_SPAN], pace[TRIAL_ERROR] = span, error
    elif pace[TRIAL_SPAN] == math.inf:
        pace[TRIAL_SPAN], pace[TRIAL_ERROR] = span, error
    stuck = stuck or now + 0.1 * span <= now
    vibrates = error > 1.0 and rings(scene.ringing, span)
    if error > 1.0 and not stuck and span <= pace[FLOOR] * (1.0 + 1e-9):
        patient = pace[SHORTS] * count < LONGEST_PATIENCE
        costs = pace[SEEN] - pace[BURST] + error * tol > 0.3 * scene.wanted
        if vibrates and patient and costs:
            pace[FLOOR], pace[HURRY] = 0.0, -4 * PATIENCE
    if error > 1.0 and not stuck and span > pace[FLOOR] * (1.0 + 1e-9):
        return max(span * min(max(factor, 0.1), 0.9), pace[FLOOR])
    if scene.fast and pace[FLOOR] == 0.0 and not stuck:
        moved, pressed, rate, decay = _vibrating(scene, body, state, at, span, wait, r)
        size = max(moved / reach, pressed / load) if moved > 0.0 else 0.0
        left = LONGEST_PATIENCE // count - pace[SHORTS]
        if size > 0.1 * scene.wanted and rate > 0.0 and decay * left > 10.0 * rate:
            return 1.0 / rate  # it dies out soon enough to be followed
    if error > 1.0 and vibrates and error * tol > pace[BURST]:
        pace[SEEN] += error * tol - pace[BURST]
        pace[BURST] = error * tol
    elif error <= 1.0:
        pace[BURST] = 0.0
    pace[PROPOSAL] = max(span * min(max(factor, 0.2), 5.0), pace[FLOOR])
    if error > 1.0:
        pace[PROPOSAL] = max(pace[PROPOSAL], 2.0 * span)
    pace[WORST] = max(pace[WORST], error)
    return span


@inner
def _aim(
    body: Body,
    state: State,
    at: Points,
    out: Curves,
    struck: bool,
    pressed: bool,
    base0: float,
    now: float,
    span: float,
    longest: float,
    chased: int,
    target: int,
    side: int,
    level: float,
) -> tuple[int, float, int, int, float]:
    """What to do with a step, for what length, and what it is to end at.

    `target` is a spring (or, one past the last, the base stress) whose crossing of `level` towards
    `side` a step of the length before this one has shown; -1 if none.
    """
    count = body.heights.size
    when, which, where = _first_event(
        body.rows, state.branches, out.strains, out.base, out.slack, struck, pressed
    )
    if target >= 0:
        value = at.total[0, STAGES - 1] if target == count else at.eps[target, STAGES - 1]
        fine = 1e-13 * (abs(base0) if target == count else max(1.0, abs(level)))
        same = which < 0 or which == target or when > 1.0 - 1e-9
        if same and abs(value - level) <= fine:
            return ARRIVED, span, target, side, level
        if same and chased > 12:
            near = abs(value - level) <= 1e5 * fine
            return ARRIVED if near else FREELY, span, target, side, level
        if which < 0:  # a little further
            pace_out = slope_at(out.base if target == count else out.strains[target], STAGES, 1.0)
            more = (level - value) / pace_out if pace_out * side > 0.0 else math.inf
            further = (1.0 + more) * span
            if not further < longest:  # it turned back: nothing was crossed
                return FREELY, span, target, side, level
            return AGAIN, further, target, side, level
    if which < 0:
        return FREELY, span, target, side, level
    level = 0.0
    if which < count:
        low, high = interval(body.rows[which], state.branches[which])
        level = high if where > 0 else low
    ending = out.base if which == count else out.strains[which]
    beyond = value_at(ending, STAGES, 0.5 * when) - level
    near = abs(ending[0] - level) <= out.slack[which] and beyond * where >= 0.0
    if now + when * span <= now or near:
        return AT_ONCE, 0.0, which, where, level
    if when >= 1.0 - 1e-15:
        return ARRIVED, span, which, where, level
    return AGAIN, when * span, which, where, level


@once
def _step(
    scene: Scene,
    body: Body,
    state: State,
    at: Points,
    out: Curves,
    r: Ripples,
    pace: Array,
    v: Array,
    now: float,
    span: float,
    wait: float,
    push: float,
    push_rate: float,
    base0: float,
    pressed: bool,
    tally: Branches,
) -> tuple[int, float, bool, int, int]:
    """Find the longest step within `span` that is exact enough and ends no later than an event.

    Returns the outcome (DONE if there is one), its length, whether it ends at an event, which
    spring (or the base, one past the last) has it, and on which side.
    """
    count = body.heights.size
    zero: int = body.heights.size - count  # not the literal: every type is compiled on its own
    longest, target, side, level, chased = span, zero - 1, zero, 0.0, zero
    pace[TRIAL_SPAN] = pace[TRIAL_ERROR] = math.inf
    faint = scene.faint if pressed else 0.0
    for _ in range(200):
        if now + span <= now:
            break
        guess(out.moves, v, state.v0, body.moving, span, pace[TAKEN], at.z)
        if not collocate(body, state, push, push_rate, span, pace[REACH], at, tally):
            if chased > 0:
                target, side, chased = zero - 1, zero, zero
            span *= 0.3
            longest = span
            continue
        error, reach, load = _describe(body, state, at, base0, faint, pace, out)
        if chased == 0:
            fair = _bearable(
                scene, body, state, at, now, span, wait, error, reach, load, pace, r
            )  # fmt: skip
            if fair < span:
                longest = span = fair
                continue
        for i in range(count):
            out.slack[i] = max(1e-12, scene.tol * reach / body.heights[i])
        out.slack[count] = min(pace[WORST] * scene.tol, 1e-3) * load
        what, span, target, side, level = _aim(
            body, state, at, out, scene.struck, pressed, base0, now, span, longest, chased,
            target, side, level,
        )  # fmt: skip
        if what != AGAIN:
            return DONE, span, what != FREELY, target, side
        chased += 1
    if chased > 0:  # the crossing is here, within rounding
        return DONE, 0.0, True, target, side
    for i in range(count):
        curved, _, x0, _ = branch_shape(body.rows[i], state.branches[i])
        if curved and 1.0 - (state.eps0[i] - x0) < 1e-3:
            return NOT_FINITE, 0.0, False, -1, 0
    return STEP_UNDERFLOW, 0.0, False, -1, 0


# ---------------------------------------------------------------- samples


@inner
def _record(
    now: float,
    span: float,
    first: int,
    done: int,
    state: State,
    curves: Curves,
    out: Samples,
) -> None:
    """Write the samples first … done-1, which a step contains."""
    top = state.w.size - 1
    for sample in range(first, done):
        at = (out.t[sample] - now) / span
        out.curves[0, sample] = value_at(curves.base, STAGES, at)
        if out.curves.shape[0] == 2:
            out.curves[1, sample] = state.w[top] + value_at(curves.moves[top], STAGES, at)
        else:
            for i in range(state.w.size):
                moved = value_at(curves.moves[i], STAGES, at)
                out.curves[1 + i, sample] = state.w[i] + moved


@inner
def _through(values: Array, at: float) -> float:
    """Value at a place of a step of the polynomial through the values at its points.

    Where nothing has inertia or a dashpot, the derivatives by a dashpot jump at switches and kinks:
    the polynomial of a step asks nothing of its start.
    """
    total = 0.0
    for k in range(STAGES - 1, -1, -1):
        term = 0.0
        for j in range(STAGES):
            term += THROUGH[k, j] * values[j]
        total = total * at + term
    return total


@inner
def _record_tangents(
    now: float, span: float, first: int, done: int, d: Tangents, out: Samples
) -> None:
    """Write the derivatives at the samples first … done-1, which a step contains."""
    nodes, count = out.curves.shape[0] - 1, d.w.shape[0]
    for c in range(d.base.size):
        for sample in range(first, done):
            at = (out.t[sample] - now) / span
            out.slopes[c, 0, sample] = _through(d.total[c, 0], at)
            for node in range(nodes):
                i = node if nodes > 1 else count - 1
                moved = d.w[i, c] + at * span * d.v0[i, c]
                out.slopes[c, 1 + node, sample] = moved + _through(d.work.delta[c, i], at)


@inner
def _record_step(
    body: Body,
    state: State,
    at: Points,
    curves: Curves,
    now: float,
    span: float,
    first: int,
    done: int,
    d: Tangents,
    out: Samples,
) -> bool:
    """Write the samples of a step and carry its derivatives; false if these are not finite."""
    for i in range(body.heights.size):
        for j in range(STAGES):
            curves.stress[i, j] = at.z[i, j] + NODES[j] * span * state.v0[i]
        polynomial(0.0, curves.stress[i], curves.moves[i])
    _record(now, span, first, done, state, curves, out)
    if d.base.size > 0:
        if not linearise(body, state, span, at, d):
            return False
        _record_tangents(now, span, first, done, d, out)
        _carry_tangents(body, span, d)
    return True


@inner
def _record_rest(first: int, state: State, base: float, d: Tangents, out: Samples) -> None:
    """Write a single sample, or one that is left where the steps have ended."""
    nodes, count = out.curves.shape[0] - 1, state.w.size
    for sample in range(first, out.t.size):
        out.curves[0, sample] = base
        for c in range(d.base.size):
            out.slopes[c, 0, sample] = d.base[c]
        for node in range(nodes):
            i = node if nodes > 1 else count - 1
            out.curves[1 + node, sample] = state.w[i]
            for c in range(d.base.size):
                out.slopes[c, 1 + node, sample] = d.w[i, c]


@inner
def _mend_kink(scene: Scene, body: Body, knot: int, jump: float, d: Tangents, out: Samples) -> None:
    """Dashpots feel the mean rate where the prescribed motion has a kink of `jump`."""
    flow = 0.0
    for i in range(body.heights.size):
        eta = body.rows[i, ETA]
        flow += body.heights[i] / eta if eta > 0.0 else math.inf
    t = scene.t
    share = (t[knot] - t[knot - 1]) / (t[knot + 1] - t[knot - 1])
    out.curves[0, knot] += share * jump / flow
    if flow == math.inf:
        return
    for c in range(d.base.size):
        i = d.directions[c, 0]
        if i >= 0 and d.directions[c, 1] in (OWN_ETA, OWN_HEIGHT):
            eta = body.rows[i, ETA]
            more = 1.0 / eta if d.directions[c, 1] == OWN_HEIGHT else -body.heights[i] / (eta * eta)
            out.slopes[c, 0, knot] -= share * jump / (flow * flow) * more


@inner
def _leave(
    body: Body,
    state: State,
    at: Points,
    v: Array,
    fall: float,
    now: float,
    done: int,
    d: Tangents,
    out: Samples,
    w_end: Array,
) -> None:
    """Fill the samples after contact, which ended now with the base stress falling at `fall`.

    A later end leaves the nodes as they move until then, and the top with the velocity that it has
    then. `w_end` (nodes,) is scratch.
    """
    nodes, top = out.curves.shape[0] - 1, state.w.size - 1
    for node in range(nodes):
        w_end[node] = state.w[node if nodes > 1 else top]
    fly(out.curves, out.t, done, now, w_end, v[top])
    pull = -(at.total[top, STAGES - 1] + body.drag * v[top]) / body.mass[top]
    for c in range(d.base.size):
        late = -d.base[c] / fall if fall != 0.0 else 0.0
        for node in range(nodes):
            i = node if nodes > 1 else top
            w_end[node] = d.w[i, c] + (v[i] - v[top]) * late
        fly(out.slopes[c], out.t, done, now, w_end, d.v0[top, c] + pull * late)


# ---------------------------------------------------------------- the state between steps


@inner
def _begin(
    i0: int, start: Array, top: int, body: Body, state: State, d: Tangents, pace: Array
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
        pace[LOAD] = max(pace[LOAD], abs(stress_on(row, state.branches[i], state.eps0[i])))
        pace[REACH] = max(pace[REACH], body.heights[i] * abs(state.eps0[i]))
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
    v: Array,
    knot: int,
    fresh: bool,
    now: float,
    d: Tangents,
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
            _mend_kink(scene, body, knot, rate - state.v0[top], d, out)
        state.eps0[top] += (values[knot] - state.w[top]) / body.heights[top]  # without rounding
        state.w[top] = values[knot]
    state.v0[top] = v[top] = rate
    return horizon, 0.0, 0.0


@inner
def _carry(
    body: Body, state: State, at: Points, span: float, v: Array, top: int, pace: Array
) -> None:
    """Carry the state over a step, and the scales of motion and stress with it."""
    end, last = STAGES - 1, body.heights.size - 1
    for i in range(last + 1):
        state.w[i] += at.z[i, end] + span * state.v0[i]
        state.eps0[i] = at.eps[i, end]
        v[i] = at.vel[i, end]
        pace[REACH] = max(pace[REACH], body.heights[i] * abs(state.eps0[i]))
        stress = stress_on(body.rows[i], state.branches[i], state.eps0[i])
        pace[LOAD] = max(pace[LOAD], abs(stress))
    for i in range(last + 1):
        if body.mass[i] > 0.0:
            state.v0[i] = v[i]
    if top != STRESS:
        pace[REACH] = max(pace[REACH], abs(state.w[last]))
    pace[BASE] = max(pace[BASE], abs(at.total[0, end]))
    pace[LOAD] = max(pace[LOAD], pace[BASE])


@inner
def _carry_tangents(body: Body, span: float, d: Tangents) -> None:
    """Carry the derivatives of the state over a step."""
    end = STAGES - 1
    for i in range(body.heights.size):
        for c in range(d.base.size):
            d.w[i, c] += d.work.delta[c, i, end] + span * d.v0[i, c]
            d.eps0[i, c] = d.eps[c, i, end]
            if body.mass[i] > 0.0:
                rate = 0.0
                for k in range(STAGES):
                    rate += RATES[end, k] * d.work.delta[c, i, k]
                d.v0[i, c] += rate / span
    for c in range(d.base.size):
        d.base[c] = d.total[c, 0, end]


@inner
def _hold_back(span: float, last: bool, scene: Scene, pace: Array) -> None:
    """Let steps grow again that only the error has kept short for long."""
    pace[TAKEN] = span
    if pace[PROPOSAL] < scene.short and not last:
        pace[HURRY] += 1
        pace[SHORTS] += 1
        if pace[HURRY] > (PATIENCE if pace[SHORTS] < 3 * PATIENCE else LITTLE_PATIENCE):
            pace[FLOOR] = min(max(2.0 * pace[FLOOR], 2.0 * span), scene.short)
            pace[PROPOSAL] = max(pace[PROPOSAL], pace[FLOOR])
    elif pace[PROPOSAL] >= scene.short:
        pace[HURRY] = pace[FLOOR] = 0.0


@inner
def _remember(
    scene: Scene, body: Body, state: State, at: Points, span: float, wait: float, r: Ripples
) -> None:
    """Add what a step passed over to the vibrations that the answer lacks."""
    moved, pressed, _, _ = _vibrating(scene, body, state, at, span, wait, r)
    r.worst[0], r.worst[1] = max(r.worst[0], moved), max(r.worst[1], pressed)
    for g in range(r.alive.size):
        r.alive[g] = (r.alive[g] + r.begun[g]) * math.exp(-r.fading[g] * span)


@inner
def _lost(pace: Array, r: Ripples) -> float:
    """Size of all vibrations that were damped out, relative to motion and stress."""
    if r.worst[1] > 0.0:
        return pace[SEEN] + max(r.worst[0] / pace[REACH], r.worst[1] / pace[LOAD])
    return pace[SEEN]


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
        if switches < log.shape[0]:
            log[switches, 0], log[switches, 1] = now, i
            log[switches, 2], log[switches, 3] = left, entered
            log[switches, 4] = high if out > 0 else low
        switches += 1
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


@inner
def _wait(t: Array, done: int, now: float) -> float:
    """Time until the next sample."""
    while done < t.size - 1 and t[done] <= now:
        done += 1
    return max(t[done] - now, 0.0)


@once
def _follow(
    scene: Scene,
    body: Body,
    state: State,
    at: Points,
    curves: Curves,
    ripples: Ripples,
    pace: Array,
    v: Array,
    now: float,
    paced: float,
    speed: float,
    d: Tangents,
    out: Samples,
    w_end: Array,
    start: Array,
    max_steps: int,
    log: Array,
    tally: Branches,
    lost: Array,
) -> tuple[int, float, int, int]:
    """Step from event to event; see `integrate_implicit`. Nothing is allocated from here on."""
    rows, heights, t, top, struck = body.rows, body.heights, scene.t, scene.top, scene.struck
    count, groups, first = heights.size, scene.ends.size, scene.ends[0]
    i0 = scene.ends[groups - 2] if groups > 1 else 0
    _begin(i0, start, top, body, state, d, pace)
    done = 0
    if struck:
        state.v0[count - 1] = v[count - 1] = speed
        done = before_contact(out.curves, t, speed)
        for c in range(d.base.size):
            before_contact(out.slopes[c], t, 0.0)
    pressed, switches = speed < 0.0, done - done  # no, and none: not literals, which are types
    knot, step, stalled, fall = done - done, 0, 0, 0.0
    while step < max_steps:
        if done == t.size:
            return DONE, math.nan, step, switches
        horizon, push, push_rate = t[t.size - 1], 0.0, 0.0
        if not struck:
            fresh = step == 0 and stalled == 0
            while knot < t.size - 2 and now >= t[knot + 1]:
                knot += 1
                fresh = True
            horizon, push, push_rate = _drive(scene, body, state, v, knot, fresh, now, d, out)
        if top == STRESS and _is_flat(body, state, i0):
            return FLAT_UNDER_STRESS, now, step, switches
        v_first = 0.0 if groups == 1 and top in (STRESS, VISCOUS) else state.v0[first - 1]
        base0 = _base_stress(
            rows, state.branches, heights, state.eps0, first, groups > 1, top, v_first, scene.drag,
            push,
        )  # fmt: skip
        if horizon <= now:  # a single sample, or the last one
            _record_rest(done, state, base0, d, out)
            return DONE, math.nan, step, switches
        span = horizon - now
        if pace[PROPOSAL] > 0.0:
            span = min(span, pace[PROPOSAL])
        elif struck:
            span = min(span, 0.02 * paced)
        wait = _wait(t, done, now) if scene.fast else 0.0
        outcome, span, arrived, target, side = _step(
            scene, body, state, at, curves, ripples, pace, v, now, span, wait, push, push_rate,
            base0, pressed, tally,
        )  # fmt: skip
        if outcome != DONE:
            return outcome, now, step, switches
        leaves = arrived and target == count
        stalled += 1
        if span > 0.0 and now + span > now:
            step, stalled = step + 1, 0
            last = span >= horizon - now or now + span >= horizon
            end = horizon if last else now + span
            begun, done = done, first_past(t, done, end, last)
            if not _record_step(body, state, at, curves, now, span, begun, done, d, out):
                return NOT_FINITE, now, step, switches
            if scene.fast:
                _remember(scene, body, state, at, span, wait, ripples)
            _carry(body, state, at, span, v, top, pace)
            lost[0] = _lost(pace, ripples)
            fall = slope_at(curves.base, STAGES, 1.0) / span
            pressed = pressed or (
                not leaves and at.total[0, STAGES - 1] > 10.0 * curves.slack[count]
            )
            now = end
            _hold_back(span, last, scene, pace)
        elif stalled > 4 * count + 8:
            return STEP_UNDERFLOW, now, step, switches
        if not arrived:
            continue
        if not leaves:
            switches, opened = _switch(
                body, state, curves.strains, target, side, span, now, first, log, switches
            )
            leaves = opened and struck and pressed
        if leaves:
            _leave(body, state, at, v, fall, now, done, d, out, w_end)
            return DONE, now, step, switches
    return TOO_MANY_STEPS, now, max_steps, switches


@compiled
def integrate_implicit(
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
    max_steps: int,
    directions: Branches,
    start: Array,
    curves: Array,
    slopes: Array,
    log: Array,
    tally: Branches,
    wanted: float,
    lost: Array,
) -> tuple[int, float, int, int]:
    """Integrate a chain from rest (or struck) over the samples t, by implicit steps.

    All but the last arguments are those of `explicit.taylor.integrate`, as are the outcomes; `tol`
    is the truncation of a step relative to the motion so far. `tally` (2,) is filled with the
    linear systems solved and with the blocks eliminated in them; `lost` (1,) with the size,
    relative to the motion and stress, of the vibrations that were damped out because they could not
    be followed. Those above `wanted` are followed longer.

    Returns
    -------
    tuple
        Outcome, end of contact (NaN if none; where there is no answer, how far it came), steps
        taken, switches (also those past the log).
    """
    count, groups = rows.shape[0], ends.size
    areal = np.zeros(count)
    for g in range(groups):
        if g < groups - 1 or top == FREE:
            areal[ends[g] - 1] = mass[g]
    struck = speed > 0.0
    now = 0.0 if struck else t[0]
    paced = t[t.size - 1] - now
    if struck:
        paced = min(paced, 5.0 * bounce(rows, heights, areal, drag))
    ringing = ringing_of(rows, heights, ends, mass, drag, top)
    faintly = struck and parts_faintly(rows, heights, mass[groups - 1])
    scene = Scene(
        ends, mass, drag, top, values, struck, t, tol, wanted,
        SHORT * paced * (tol / 3e-8) ** (1.0 / 6.0),
        min(1.0, tol / FAINT) if faintly else 0.0, ringing, ringing[:, 0].max() > 0.0,
    )  # fmt: skip
    body = Body(rows, heights, areal, drag, count - 1 if top == MOTION else count)
    out = Samples(t, curves, slopes)
    at, d = make_points(count), make_tangents(count, directions)
    shape = (count, STAGES + 1)
    step = Curves(
        np.zeros(shape), np.zeros(shape), np.zeros(STAGES + 1), np.zeros(count + 1),
        np.zeros((count, STAGES)), np.zeros(STAGES + 1),
    )  # fmt: skip
    ripples = Ripples(np.zeros(groups), np.zeros(groups), np.zeros(groups), np.zeros(2))
    state = State(np.zeros(count), np.zeros(count), np.zeros(count), np.empty(count, np.int64))
    v, pace = np.zeros(count), np.zeros(N_PACE)
    pace[WORST], lost[0] = 1.0, 0.0
    return _follow(
        scene, body, state, at, step, ripples, pace, v, now, paced, speed, d, out,
        np.zeros(curves.shape[0] - 1), start, max_steps, log, tally, lost,
    )  # fmt: skip
