"""The loop over time: steps, events, samples."""

from __future__ import annotations

import math

from numba import njit
from numba.extending import intrinsic

from foamfit.solve.events import (
    DOUBTFUL,
    FAILED,
    PLAIN,
    RELEASE,
    RISEN,
    TOP_END,
    TURN,
    change_branch,
    dense,
    first_event,
    keep_values,
    look,
    take_step,
)
from foamfit.solve.motion import rates
from foamfit.solve.run import (
    BEGUN,
    BRIEF,
    DAMPED,
    EPS_AT,
    FLAT,
    GRAVITY,
    GROW,
    HORIZON,
    INTERNALS,
    KIND,
    LARGEST,
    LAST,
    LOGGED,
    NOW,
    NUMBERS,
    OF_EPS,
    OF_V,
    OF_W,
    OVERDAMPED,
    PARAMETERS,
    PRESSED,
    RECORD,
    SAMPLE,
    SCALES,
    STEP,
    STEPPED,
    TAKEN,
    VALUE,
    X_AT,
    begin_run,
)
from foamfit.solve.samples import approach, fly, write_inside
from foamfit.solve.scene import (
    DONE,
    FLAT_UNDER_STRESS,
    NOT_FINITE,
    STEP_UNDERFLOW,
    TOO_MANY_STEPS,
)
from foamfit.springs.compiled.contract import (
    BRANCH,
    BY,
    BY_STRESS,
    EPS,
    ETA,
    GAIN,
    HEIGHT,
    INTERNAL,
    MISS,
    OPTIONS,
    RATE,
    RELAX,
    SLOPE,
    TANGENT,
    TOTAL,
    TURNS,
    WHOLE,
    by_address,
    inlined,
    inner,
    past,
)  # fmt: skip

# Numbers that a run is given, after onsite damping and pace: velocity of a striker, tolerance,
# bound on steps, length of a short implicit step, whether the contact is overdamped, least scales
# of displacement, velocity, strain and stress.
SPEED, TOL, MOST, BRIEFLY, OVER, LEAST = range(2, 8)
FIRST = 40.0  # first implicit step over a short one
FADES = 5.0  # longest explicit step over a relaxation time; steps are stable up to 6.3
STOPPED = 0.1  # most of the velocity that a first step takes
# Results of a run; after them, for each derivative, whether it is one-sided.
OUTCOME, ENDED, STEPS, SWITCHES, STRONGEST, FARTHEST, DAMPED_OUT, MOTION_LOST, STRESS_LOST = range(
    9
)
ENDINGS = 9
LEAST_SHARE = 1e-6  # of the largest scale of nodes, see `_fresh_scales`
SWITCHED, RELEASED, STALLED = 1, 2, 3  # what happened in a step


@intrinsic
def _call_drive(typing, where, c, starts, want):  # type: ignore[no-untyped-def]
    return WHOLE(WHOLE, RECORD, WHOLE, WHOLE), by_address


@inlined
def drive(c, starts, want):  # type: ignore[no-untyped-def]
    """Start from rest, or begin the next piece; return whether all samples are written."""
    return _call_drive(c.drive_at, c, starts, want)


@inner
def _first_step(c, tol):  # type: ignore[no-untyped-def]
    """Return a first step of an impact, from the fastest vibration of a node at rest."""
    fastest, before = 0.0, 0.0
    for g in range(c.nodes - 1, -1, -1):
        soft = 0.0
        for i in range(c.ends[g - 1] if g > 0 else 0, c.ends[g]):
            s = past(c.springs, i * c.width)
            stiff = s[GAIN] * s[c.results + SLOPE]
            soft += s[HEIGHT] / stiff if stiff > 0.0 else 0.0
        soft = soft if soft > 0.0 else math.inf
        fastest = max(fastest, (1.0 / soft + before) * c.per_mass[g])
        before = 1.0 / soft
    return 4.0 * tol**0.125 / math.sqrt(fastest) if fastest > 0.0 else math.inf


@inner
def _mend(c, y):  # type: ignore[no-untyped-def]
    """Bring what is integrated besides the state back to it: one step of Newton's method.

    So the stress of a BY_STRESS law stays that of its strain, and springs without a dashpot in one
    group keep one stress.
    """
    for g in range(c.none if not c.solved else c.groups, c.groups):
        i0, soft, mean, count = c.ends[g - 1] if g > 0 else c.none, 0.0, 0.0, 0
        for i in range(i0, c.ends[g]):
            s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
            if n[KIND] == BY_STRESS:
                change = s[c.results + MISS] * s[c.results + SLOPE]
                y[n[X_AT]] -= change
                s[TOTAL] -= s[GAIN] * change
            if s[ETA] == 0.0 and n[EPS_AT] >= 0 and s[TANGENT] > 0.0:
                compliance = s[HEIGHT] / (s[GAIN] * s[TANGENT])
                soft, mean, count = soft + compliance, mean + compliance * s[TOTAL], count + 1
            elif s[ETA] == 0.0:
                count -= c.count  # a flat branch takes the rest
        if count < 2:
            continue
        for i in range(i0, c.ends[g]):
            s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
            if s[ETA] == 0.0:
                longer = (mean / soft - s[TOTAL]) / (s[GAIN] * s[TANGENT])
                y[n[EPS_AT]] += longer
                if n[KIND] == BY_STRESS:
                    y[n[X_AT]] += longer * s[TANGENT]
                elif n[KIND] == INTERNAL:
                    for k in range(n[INTERNALS]):
                        y[n[X_AT] + k] += longer * s[c.results + BY + n[PARAMETERS] + 2 + k]


@inner
def _log(c, i, left):  # type: ignore[no-untyped-def]
    """Log a change of branch, if there is room."""
    s, r, at = past(c.springs, i * c.width), c.now, int(c.now[LOGGED])
    if at < c.room:
        log = past(c.log, 5 * at)
        log[0], log[1], log[2], log[3], log[4] = r[BEGUN] + r[NOW], i, left, s[BRANCH], s[EPS]
    r[LOGGED] += 1.0


@inner
def _switch(c, i, up, want):  # type: ignore[no-untyped-def]
    """Change the branch of a spring now."""
    s, r = past(c.springs, i * c.width), c.now
    left, steep = s[BRANCH], s[TANGENT]
    change_branch(c, i, up, c.y)
    _log(c, i, left)
    rates(c, c.y, c.stage, want, r[NOW])
    if steep > 0.0 and s[TANGENT] > 0.0:
        r[GROW] *= min(max(math.sqrt(steep / s[TANGENT]), 0.2), 2.0)


@inner
def _turn(c, want, changed):  # type: ignore[no-untyped-def]
    """Let springs turn whose rate has changed its sign by a jump.

    The prescribed rate jumps, or the branch of a spring, `changed` (else -1), which makes it softer
    or stiffer. Then its own rate keeps its sign, and those of springs with a dashpot do not jump.
    """
    for _ in range(4 * c.count):
        turned = False
        for i in range(c.count):
            s = past(c.springs, i * c.width)
            jumps = changed < 0 or (i != changed and s[ETA] == 0.0)
            if jumps and s[TURNS] * s[RATE] < 0.0:
                _switch(c, i, int(s[TURNS] < 0.0), want)
                turned = True
        if not turned:
            return


@inner
def _pass_event(c, want, share, who, kind):  # type: ignore[no-untyped-def]
    """Move to an event in the step; return dS/dt at the end of contact, or change the branch."""
    r, y, n, slope = c.now, c.y, c.base + c.carries * c.p, 0.0
    if kind == RELEASE:
        look(c, share - 1e-3)
        before = c.carried[0]
        look(c, share + 1e-3)
        slope = (c.carried[0] - before) / (2e-3 * r[STEP])
    dense(c, n, share, c.state)
    for k in range(n):
        y[k] = c.state[k]
    r[NOW] += share * r[STEP]
    r[GROW] = min(r[GROW], 1.0)
    rates(c, y, c.stage, want, r[NOW])
    _mend(c, y)
    rates(c, y, c.stage, want, r[NOW])
    if kind == RELEASE:
        return slope
    turns = c.springs[who * c.width + TURNS]
    _switch(c, who, int(turns < 0.0) if kind == TURN else int(kind == TOP_END), want)
    _turn(c, want, who)
    return slope


@inner
def _finish_step(c, struck):  # type: ignore[no-untyped-def]
    """Advance to the end of a step."""
    r, y, stage, new, wide = c.now, c.y, c.stage, c.new, c.wide
    keep_values(c)
    if struck and c.carried[0] > RISEN * r[LARGEST]:
        r[PRESSED] = 1.0
    for k in range(wide):
        y[k], stage[k] = new[k], stage[STEPPED * wide + k]
    _mend(c, y)
    r[NOW] = r[HORIZON] if r[NOW] + r[STEP] >= r[HORIZON] else r[NOW] + r[STEP]


@inner
def _fresh_scales(c):  # type: ignore[no-untyped-def]
    """Let the scales of the error cover what the next step may reach.

    A dashpot under a mass that hardly moves makes the base stress of its velocity, so each node has
    a scale of its own, down to LEAST_SHARE of the largest.
    """
    y, rate, scales, kinds, part = c.y, c.stage, c.scales, c.kinds, 0.1 * c.now[STEP]
    for k in range(c.base):
        kind = kinds[k]
        scales[kind] = max(scales[kind], max(abs(y[k]), part * abs(rate[k])))
    for k in range(2 * c.nodes):
        shared = OF_V if k % 2 else OF_W
        scales[shared] = max(scales[shared], scales[kinds[k]])
    for k in range(2 * c.nodes):
        shared = OF_V if k % 2 else OF_W
        scales[kinds[k]] = max(scales[kinds[k]], LEAST_SHARE * scales[shared])


@inner
def _longest(c, want):  # type: ignore[no-untyped-def]
    """Return the longest step.

    The error of a step keeps relaxation terms stable, but not their derivatives: near the limit of
    stability these grow by many steps before that error is seen.
    """
    longest = math.inf
    if want and c.degree == 0:
        for i in range(c.count):
            s = past(c.springs, i * c.width)
            for k in range(c.terms):
                if s[RELAX + 2 * k] > 0.0:
                    longest = min(longest, FADES * s[RELAX + 2 * k + 1])
    return longest


@inner
def _begin(c, reals, mass):  # type: ignore[no-untyped-def]
    """Set scales and, for an impact, the striker."""
    r, top = c.now, c.groups - 1
    for k in range(SCALES):
        c.scales[k] = reals[LEAST + k]
    for i in range(c.count):  # of the strain of each spring
        c.scales[SCALES + i] = reals[LEAST + OF_EPS]
    r[BRIEF], r[LAST], r[GROW], c.drive[OVERDAMPED] = reals[BRIEFLY], 1e-4, 1.0, reals[OVER]
    if reals[SPEED] > 0.0:
        c.y[2 * top + 1] = reals[SPEED]
        c.drive[VALUE], c.drive[GRAVITY] = c.values[0], c.values[0] / mass[top]
        r[HORIZON] = max(c.time[c.samples - 1], 1e-30)  # a sample at contact needs a step
        approach(c, reals[SPEED])


@inner
def _advance(c, how, struck, want):  # type: ignore[no-untyped-def]
    """Go to the first event in the step or to its end, and write its samples.

    Return what happened: nothing, an event, the end of contact, or an event without any progress.
    """
    r, share, who, kind = c.now, 1.0, -1, -1
    if how == DOUBTFUL:
        share, who, kind = first_event(c)
    if struck and how != PLAIN:
        whole = who < 0 and r[NOW] + r[STEP] >= r[HORIZON]
        write_inside(c, r[HORIZON] if whole else r[NOW] + share * r[STEP], want)
    if who < 0:
        if how != PLAIN:
            rates(c, c.new, c.f, c.none, r[NOW] + r[STEP])
        _finish_step(c, struck)
        return c.none
    moved = share * r[STEP] > 1e-15 * abs(r[NOW])
    slope = _pass_event(c, want, share, who, kind)
    if kind == RELEASE:
        fly(c, slope)
        return RELEASED + c.none
    return (SWITCHED if moved else STALLED) + c.none


@inner
def _failure(c, how, most):  # type: ignore[no-untyped-def]
    """Return how a run ends after a step: DONE if it goes on."""
    if c.drive[FLAT] > 0.0:
        return c.none + FLAT_UNDER_STRESS
    if how == FAILED and not abs(c.new[0]) < math.inf:
        return c.none + NOT_FINITE
    if c.now[TAKEN] >= most:
        return c.none + TOO_MANY_STEPS
    return c.none + (STEP_UNDERFLOW if how == FAILED else DONE)


@njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False, cache=True)
def integrate(  # type: ignore[no-untyped-def]
    template, ints, floats, rows, heights, mass, reals, values, time, out, log, endings
):  # fmt: skip
    """Integrate a chain over sample times; fill `endings`.

    `out` (1 + p, 1 + nodes, n) becomes base stress and displacements, and their derivatives, `log`
    the switches; `ints` and `floats`, zeros, are the memory of the run.
    """
    c = begin_run(template, ints, floats, time, values, out, log, rows, heights, mass, reals)
    r, want, struck = c.now, int(c.p > 0), reals[SPEED] > 0.0
    tol, most, stalled, done = reals[TOL], reals[MOST], 0, 0
    _begin(c, reals, mass)
    if struck:
        rates(c, c.y, c.stage, want, 0.0)
        short = FIRST * r[BRIEF]
        r[STEP] = min(r[HORIZON], short if c.degree and short > 0.0 else _first_step(c, tol))
        if c.inside_at:  # a stress that depends on the rate may stop the striker at once
            top = 2 * c.groups - 1
            r[STEP] = min(r[STEP], STOPPED * abs(c.y[top] / c.stage[top]))
    else:
        done = drive(c, 1, want)
        r[STEP] = r[HORIZON]
    outcome, ended, longest = DONE, math.nan, _longest(c, want)
    while not (done or (struck and int(r[SAMPLE]) == c.samples)):
        _fresh_scales(c)
        keep_values(c)
        r[STEP] = min(r[STEP], r[HORIZON] - r[NOW], longest)
        upto = c.time[int(r[SAMPLE])] if struck else math.inf
        how = take_step(c, want, tol, upto, most)
        outcome = _failure(c, how, most)
        event = _advance(c, how, struck, want) if outcome == DONE else c.none
        stalled = stalled + 1 if event == STALLED else 0
        if stalled > 4 * c.count + 8:
            outcome = STEP_UNDERFLOW
        if outcome != DONE or event == RELEASED:
            ended = r[BEGUN] + r[NOW]
            break
        dt = r[STEP] * r[GROW]
        if r[NOW] >= r[HORIZON] and struck:
            r[HORIZON] = math.nextafter(r[NOW], math.inf)
        elif r[NOW] >= r[HORIZON]:
            done = drive(c, c.none, want)
            _turn(c, want, -1 + c.none)
        r[STEP] = dt
    endings[OUTCOME], endings[ENDED] = outcome, ended
    endings[STEPS], endings[SWITCHES] = r[TAKEN], r[LOGGED]
    endings[STRONGEST], endings[FARTHEST], endings[DAMPED_OUT] = (
        r[LARGEST],
        c.scales[OF_W],
        r[DAMPED],
    )
    endings[MOTION_LOST], endings[STRESS_LOST] = c.worst[0], c.worst[1]
    for j in range(c.p):
        endings[ENDINGS + j] = c.sided[j]
