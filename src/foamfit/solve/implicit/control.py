"""How long an implicit step may be: the error control, and the first event of a step.

A step is as long as its truncation allows. Where the error alone keeps steps short for long,
something vibrates too fast to be worth following: from the follow limit on steps grow up to a step
floor whatever their error, and the vibration is damped out (L-stability).
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.implicit.collocation import STAGES, Body, Points, State, polynomial, truncation
from foamfit.solve.implicit.vibration import is_unresolved
from foamfit.solve.polynomial import first_crossing, slope_at, value_at
from foamfit.solve.scene import LEAST_BASE
from foamfit.springs.kernels import Array, inner, interval, stress_on

# A step is short below this share of the motion; so many in a row are followed.
SHORT, FOLLOW_LIMIT = 5e-4, 600
# Behind heavy dashpots contact ends when no more than 1e-12 of the peak of the base stress is left:
# while the striker presses it is followed with so large an error of what is left, at most.
SMALL_BASE_ERROR = 1e-7
# What to do with a step whose end was compared with the first event in it.
AGAIN, FREELY, ARRIVED, AT_ONCE = range(4)


class Limits(NamedTuple):
    """What does not change in a run besides the scene.

    `tol` is the truncation of a step relative to the motion so far, `short` the length (s) under
    which steps are short. `base_weight` weighs the truncation of the base stress relative to what
    is left of it.
    """

    tol: float
    max_steps: int
    short: float
    base_weight: float


class Control:
    """Memory of the step control: a record of numbers (numba knows no class).

    `taken` and `proposed` are the lengths of the last step and the next; `floor` is the least that
    the error may ask for; `short_in_row` counts steps that the error alone made short; `worst` is
    the largest error let pass, over tol. `damped` is the size of all vibrations that were damped
    out, `damping` of those in the last steps. `motion` (m), `stress` and `base` (Pa) are the
    largest so far, `step_motion` and `step_stress` with the step that is tried.
    """

    taken: float
    proposed: float
    floor: float
    short_in_row: float
    worst: float
    damped: float
    damping: float
    motion: float
    stress: float
    base: float
    step_motion: float
    step_stress: float


# As numpy's own record it has attributes without compilation, too.
CONTROL = np.dtype((np.record, [(name, np.float64) for name in Control.__annotations__]))


class Start(NamedTuple):
    """Where a step starts: time, base stress, whether contact has come through to the base.

    `push` is the stress on the top and `push_rate` its rate.
    """

    now: float
    base: float
    pressed: bool
    push: float
    push_rate: float


class Polynomials(NamedTuple):
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


@inner
def error_of(
    body: Body, state: State, at: Points, start: Start, weight: float, c: Control, out: Polynomials
) -> float:
    """Fill the polynomials of the strains and the base stress of a step; returns its truncation.

    It is relative to the scales of motion and stress with what the step itself reaches. While the
    striker presses, `weight` is that of the base stress relative to what is left of it.
    """
    rows, heights = body.rows, body.heights
    reach, load = c.motion, c.stress
    present, parts = abs(start.base), 0.0
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
    polynomial(start.base, at.total[0], out.base)
    left_out = truncation(out.base)
    error = left_out / max(c.base, present, LEAST_BASE * load) if load > 0.0 else 0.0
    if weight > 0.0 and load > 0.0:  # what is left is known to the rounding of its parts
        error = max(error, weight * left_out / max(present, SMALL_BASE_ERROR * parts))
    for i in range(heights.size):
        if reach > 0.0:
            error = max(error, truncation(out.strains[i]) * heights[i] / reach)
        if load > 0.0:
            first = stress_on(rows[i], state.branches[i], state.eps0[i])
            polynomial(first, out.stress[i], out.some)
            error = max(error, truncation(out.some) / load)
    c.step_motion, c.step_stress = reach, load
    return error


@inner
def allowed_length(
    limits: Limits, rates: Array, c: Control, now: float, span: float, error: float, rounded: bool
) -> float:
    """Length at which to take a step whose truncation is `error`: its own where that may pass.

    It may also where the error is one of rounding, or the step as short as times can resolve.
    """
    excess = error / limits.tol
    if not math.isfinite(excess):
        return 0.3 * span
    factor = 0.9 * max(excess, 1e-12) ** (-1.0 / 6.0)
    floor = max(c.floor, 1e-15 * now)
    if excess > 1.0 and not rounded and span > floor * (1.0 + 1e-9):
        return max(span * min(max(factor, 0.1), 0.9), floor)
    if excess <= 1.0:
        c.damping = 0.0
    elif is_unresolved(rates, span) and error > c.damping:
        c.damped += error - c.damping
        c.damping = error
    c.proposed = max(span * min(max(factor, 0.2), 5.0), c.floor)
    if excess > 1.0:
        c.proposed = max(c.proposed, 2.0 * span)
    c.worst = max(c.worst, excess)
    return span


@inner
def raise_floor(span: float, last: bool, limits: Limits, c: Control) -> None:
    """Let steps grow again that only the error has kept short for long."""
    c.taken = span
    if c.proposed >= limits.short:
        c.short_in_row = c.floor = 0.0
    elif not last:
        c.short_in_row += 1
        if c.short_in_row > FOLLOW_LIMIT:
            c.floor = min(max(2.0 * c.floor, 2.0 * span), limits.short)
            c.proposed = max(c.proposed, c.floor)


# ---------------------------------------------------------------- where a step ends


@inner
def _first_event(
    body: Body, state: State, out: Polynomials, struck: bool, pressed: bool
) -> tuple[float, int, int]:
    """First event of a step: where in [0, 1], which spring (-1: none, the last + 1: base), side.

    A spring that starts within `slack` of the end of its branch leaves it by more than that. The
    last slack is that of the base stress, which has to rise by ten times as much before contact can
    end.
    """
    when, which, side = 1.0, -1, 0
    count = body.heights.size
    for i in range(count):
        low, high = interval(body.rows[i], state.branches[i])
        if abs(out.strains[i, 0] - low) <= out.slack[i]:
            low -= out.slack[i]
        if abs(out.strains[i, 0] - high) <= out.slack[i]:
            high += out.slack[i]
        at, where = first_crossing(out.strains[i], STAGES, low, high, 1.0)
        if where != 0 and (which < 0 or at < when):
            when, which, side = at, i, where
    if struck:
        low = 0.0 if pressed else -out.slack[count]
        at, where = first_crossing(out.base, STAGES, low, math.inf, 1.0)
        risen = pressed or value_at(out.base, STAGES, 0.5 * at) > 10.0 * out.slack[count]
        if where != 0 and at <= when and risen:
            when, which, side = at, count, where
    return when, which, side


@inner
def aim(
    body: Body,
    state: State,
    at: Points,
    out: Polynomials,
    start: Start,
    struck: bool,
    span: float,
    longest: float,
    last: bool,
    which: int,
    side: int,
) -> tuple[int, float, int, int]:
    """What to do with a step, for what length; the spring (or base) at whose event, and its side.

    `which` and `side` are the event that the step aims at (-1: none).
    """
    when, event, way = _first_event(body, state, out, struck, start.pressed)
    aimed = which >= 0 and (event < 0 or event == which or when > 1.0 - 1e-9)
    if not aimed:
        which, side = event, way
    if which < 0:
        return FREELY, span, which, side
    level, fine = 0.0, 1e-13 * abs(start.base)
    ending, value = out.base, at.total[0, STAGES - 1]
    if which < body.heights.size:
        low, high = interval(body.rows[which], state.branches[which])
        level = high if side > 0 else low
        fine = 1e-13 * max(1.0, abs(level))
        ending, value = out.strains[which], at.eps[which, STAGES - 1]
    near = False
    if aimed:
        if abs(level - value) <= (1e5 * fine if last else fine):
            return ARRIVED, span, which, side
        if event < 0:  # a little further; where it turned back, nothing was crossed
            more = (level - value) / slope_at(ending, STAGES, 1.0)
            when = 1.0 + more if more > 0.0 else math.inf
        if last or not when * span < longest:
            return FREELY, span, which, side
    else:
        beyond = value_at(ending, STAGES, 0.5 * when) - level
        near = abs(ending[0] - level) <= out.slack[which] and beyond * side >= 0.0
    if near or start.now + when * span <= start.now:
        return AT_ONCE, 0.0, which, side
    if when >= 1.0 - 1e-15 and not aimed:
        return ARRIVED, span, which, side
    return AGAIN, when * span, which, side
