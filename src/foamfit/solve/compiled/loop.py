"""The loop over time: steps, events, samples, and the pieces of a prescribed drive between samples.

A drive whose first sample is not zero takes the springs there on a ramp, while time stands still:
dashpots, relaxation terms and the rates B and stresses V of laws do nothing, and nodes rest.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import events, run
from foamfit.solve.compiled.motion import dense, in_contact, look, rates
from foamfit.solve.compiled.run import MOTION, STRESS, change_branch, numbers, spring, write
from foamfit.solve.compiled.samples import APPROACH, FLIGHT, INSIDE, KNOWN, is_finite, row_of
from foamfit.springs.compiled.contract import inner, outer, past, start
from foamfit.springs.laws.record import BEGUN, STRUCK

# Numbers that a run is given, after onsite damping and pace: velocity of a striker, tolerance,
# bound on steps, length of a short implicit step, whether the contact is overdamped, least scales
# of displacement, velocity, strain, stress.
SPEED, TOL, MOST, BRIEFLY, OVER, LEAST = range(2, 8)
FIRST = 40.0  # first implicit step over a short one
FADES = 5.0  # longest explicit step over a relaxation time; steps are stable up to 6.3
LEAST_SHARE = 1e-6  # of the largest scale of nodes, see `_fresh_scales`
SWITCHED, RELEASED, STALLED = 1, 2, 3  # what happened in a step
RAMP = 1e-9  # time of a ramp over the duration


@inner
def _first_step(c, tol):
    """Return a first step of an impact, from the fastest vibration of a node at rest."""
    fastest, before = 0.0, 0.0
    for g in range(c.nodes - 1, -1, -1):
        soft = 0.0
        for i in range(c.first[g], c.first[g + 1]):
            s = spring(c, i)
            stiff = s.gain * s.slope
            soft += s.height / stiff if stiff > 0.0 else 0.0
        soft = soft if soft > 0.0 else math.inf
        fastest = max(fastest, (1.0 / soft + before) * c.per_mass[g])
        before = 1.0 / soft
    return 4.0 * tol**0.125 / math.sqrt(fastest) if fastest > 0.0 else math.inf


@inner
def _mend(c, y):
    """Bring what is integrated besides the state back to it; return whether the state changed."""
    # By Newton: stresses stay those of strains, and springs without dashpots keep one stress.
    changed = False
    for g in range(c.none if not c.solved else c.groups, c.groups):
        i0, soft, mean, count = c.first[g], 0.0, 0.0, 0
        for i in range(i0, c.first[g + 1]):
            s, n = spring(c, i), numbers(c, i)
            if n.by_stress:
                change, changed = s.miss * s.slope, True
                y[n.x_at] -= change
                s.total -= s.gain * change
            if s.eta == 0.0 and n.eps_at >= 0 and s.tangent > 0.0:
                compliance = s.height / (s.gain * s.tangent)
                soft, mean, count = soft + compliance, mean + compliance * s.total, count + 1
            elif s.eta == 0.0:
                count -= c.count  # a flat branch takes the rest
        if count < 2:
            continue
        changed = True
        for i in range(i0, c.first[g + 1]):
            s, n = spring(c, i), numbers(c, i)
            if s.eta == 0.0:
                longer = (mean / soft - s.total) / (s.gain * s.tangent)
                y[n.eps_at] += longer
                if n.by_stress:
                    y[n.x_at] += longer * s.tangent
                elif n.internal:
                    for k in range(n.internals):
                        y[n.x_at + k] += longer * s.by[2 + k]
    return changed


@inner
def _log(c, i, left):
    """Log a change of branch, if there is room."""
    s, r, at = spring(c, i), c.now, int(c.now.logged)
    if at < c.room:
        log = past(c.log, 5 * at)
        log[0], log[1], log[2], log[3], log[4] = r.begun + r.now, i, left, s.branch, s.eps
    r.logged += 1.0


@inner
def _switch(c, i, up, want):
    """Change the branch of a spring now."""
    s, r = spring(c, i), c.now
    left, steep = s.branch, s.tangent
    change_branch(c, i, up, c.y)
    _log(c, i, left)
    rates(c, c.y, c.stage, want, r.now)
    if steep > 0.0 and s.tangent > 0.0:
        r.grow *= min(max(math.sqrt(steep / s.tangent), 0.2), 2.0)


@inner
def _leaves(c, i):
    """Whether a spring at an end of a flat branch leaves it, as a prescribed stress changes."""
    s, way = spring(c, i), c.drive.value_rate
    if c.top != STRESS or s.eta > 0.0 or s.sigma_low < s.sigma_high:
        return False
    first, end = c.first[c.groups - 1], s.high if way > 0.0 else s.low
    return i >= first and way != 0.0 and abs(s.eps - end) < events.ROUNDED


@inner
def _turn(c, want, changed):
    """Let springs turn whose rate has changed its sign by a jump.

    The prescribed rate jumps, or the branch of a spring, `changed` (else -1), which makes it softer
    or stiffer. Then its own rate keeps its sign, and those of springs with a dashpot do not jump.
    """
    for _ in range(4 * c.count):
        turned = False
        for i in range(c.count):
            s = spring(c, i)
            jumps = changed < 0 or (i != changed and s.eta == 0.0)
            if jumps and s.turns * s.rate < 0.0:
                _switch(c, i, int(s.turns < 0.0), want)
                turned = True
            elif changed < 0 and _leaves(c, i):
                _switch(c, i, int(c.drive.value_rate > 0.0), want)
                turned = True
        if not turned:
            return


@inner
def _pass_event(c, want, share, who, kind):
    """Move to an event in the step; return dS/dt at the end of contact, or change the branch."""
    r, y, n, slope = c.now, c.y, c.base + c.carries * c.p, 0.0
    if kind == events.RELEASE:
        look(c, share - 1e-3)
        before = c.carried[0]
        look(c, share + 1e-3)
        slope = (c.carried[0] - before) / (2e-3 * r.step)
    dense(c, n, share, c.state)
    for k in range(n):
        y[k] = c.state[k]
    r.now += share * r.step
    r.grow = min(r.grow, 1.0)
    rates(c, y, c.stage, want, r.now)
    if _mend(c, y):
        rates(c, y, c.stage, want, r.now)
    if kind == events.RELEASE:
        return slope
    turns = spring(c, who).turns
    _switch(c, who, int(turns < 0.0) if kind == events.TURN else int(kind == events.TOP_END), want)
    _turn(c, want, who)
    return slope


@inner
def _finish_step(c, struck):
    """Advance to the end of a step."""
    r, y, stage, new, wide = c.now, c.y, c.stage, c.new, c.wide
    events.keep_values(c)
    if struck and c.carried[0] > events.RISEN * r.largest:
        r.pressed = 1.0
    for k in range(wide):
        y[k], stage[k] = new[k], stage[run.STEPPED * wide + k]
    _mend(c, y)
    r.now = r.horizon if r.now + r.step >= r.horizon else r.now + r.step


@inner
def _fresh_scales(c):
    """Let the scales of the error cover what the next step may reach."""
    y, rate, scales, kinds, part = c.y, c.stage, c.scales, c.kinds, 0.1 * c.now.step
    for k in range(c.base):
        kind = kinds[k]
        scales[kind] = max(scales[kind], max(abs(y[k]), part * abs(rate[k])))
    # A dashpot under a mass that hardly moves makes base stress of its velocity.
    for k in range(2 * c.nodes):
        shared = run.OF_V if k % 2 else run.OF_W
        scales[shared] = max(scales[shared], scales[kinds[k]])
    for k in range(2 * c.nodes):
        shared = run.OF_V if k % 2 else run.OF_W
        scales[kinds[k]] = max(scales[kinds[k]], LEAST_SHARE * scales[shared])


@inner
def _longest(c, want):
    """Return the longest step."""
    # Near the limit of stability, derivatives of relaxation terms grow before errors are seen.
    longest = math.inf
    if want and c.degree == 0:
        for i in range(c.count):
            s = spring(c, i)
            for k in range(c.terms):
                if s.g[k] > 0.0:
                    longest = min(longest, FADES * s.tau[k])
    return longest


@inner
def _begin(c, reals):
    """Set scales and, for an impact, the striker."""
    r, top = c.now, c.groups - 1
    for k in range(run.SCALES):
        c.scales[k] = reals[LEAST + k]
    for i in range(c.count):  # of the strain of each spring
        c.scales[run.SCALES + i] = reals[LEAST + run.OF_EPS]
    r.brief, r.last, r.grow, c.drive.overdamped = reals[BRIEFLY], 1e-4, 1.0, reals[OVER]
    if reals[SPEED] > 0.0:
        c.y[2 * top + 1] = reals[SPEED]
        c.drive.value, c.drive.gravity = c.values[0], c.values[0] * c.per_mass[top]
        r.horizon = max(c.time[c.samples - 1], 1e-30)  # a sample at contact needs a step
        write(c, c.y, reals[SPEED], APPROACH, c.none)


@inner
def _strike(c, want):
    """Fill the rates at contact; derivatives by its time and by the velocity of the striker."""
    y, p, top = c.y, c.p, c.groups - 1
    rates(c, y, c.stage, c.none, 0.0)
    for j in range(p):
        what = c.directions[2 * j + 1]
        if what == STRUCK:
            y[c.base + (2 * top + 1) * p + j] = 1.0
        for k in range(c.carries if what == BEGUN else c.none):
            y[c.base + k * p + j] = -c.stage[k]
    if p > 0:
        rates(c, y, c.stage, want, 0.0)


# ---------------------------------------------------------------- prescribed drives


@inner
def _begin_piece(c, k):
    """Prescribe the drive between samples k and k + 1."""
    r, drive, t, values = c.now, c.drive, c.time, c.values
    r.now, r.begun, drive.value, drive.value_rate = 0.0, t[k], values[k], 0.0
    r.horizon, drive.shift, drive.shift_rate = 0.0, in_contact(c, k), 0.0
    if k + 1 < c.samples:
        r.horizon = t[k + 1] - t[k]
        drive.value_rate = (values[k + 1] - values[k]) / (t[k + 1] - t[k])
        drive.shift_rate = (in_contact(c, k + 1) - drive.shift) / (t[k + 1] - t[k])


@inner
def _begin_ramp(c, want):
    """Begin a ramp to the first sample of a drive. Under a prescribed stress dashpots are rigid."""
    r, drive, t = c.now, c.drive, c.time
    brief = RAMP * (t[c.samples - 1] - t[0]) if c.samples > 1 else RAMP
    r.now, r.begun, r.horizon, r.piece, r.paused = 0.0, t[0] - brief, brief, -1.0, math.inf
    c.aside[c.count] = drive.pace
    drive.value, drive.value_rate, drive.pace = 0.0, c.values[0] / brief, 0.0
    drive.shift, drive.shift_rate = 0.0, in_contact(c, c.none) / brief
    for i in range(c.first[c.groups - 1], c.count):
        s, n = spring(c, i), numbers(c, i)
        c.aside[i], s.gain = s.eta, 1.0
        if s.eta > 0.0:
            s.eta = 0.0 if c.top == MOTION else math.inf
            n.fixed = int(c.top == MOTION and n.eps_at >= 0)
    rates(c, c.y, c.stage, want, 0.0)


@inner
def _end_ramp(c, want):
    """Let time pass again: relaxation terms begin at zero, and dashpots at the present strain."""
    y, p, aside = c.y, c.p, c.aside
    rates(c, y, c.stage, want, c.now.now)
    c.drive.pace, c.now.grow, c.now.paused = aside[c.count], 1.0, 0.0
    for i in range(c.first[c.groups - 1], c.count):
        s, n = spring(c, i), numbers(c, i)
        strain, part = past(c.strain, i * p), past(c.part, i * p)
        for k in range(c.terms):
            y[n.z_at + k] = -s.sigma
            for j in range(p):
                y[c.base + (n.z_at + k) * p + j] = -(s.steep * strain[j] + part[j])
        run.sum_gain(c, i)
        if aside[i] == 0.0:
            continue
        s.eta = aside[i]
        if n.eps_at >= 0 and c.top == MOTION:
            y[n.eps_at] = s.eps
            for j in range(p):
                y[c.base + n.eps_at * p + j] = strain[j]
        if n.fixed:
            first, n.fixed = past(s.by, 2), 0
            for k in range(n.internals if n.internal else c.none):
                for j in range(p):
                    y[c.base + (n.x_at + k) * p + j] += first[k] * strain[j]


@inner
def _is_damped(c):
    """Whether the stress of a spring depends on its strain rate."""
    damped = False
    for i in range(c.count):
        s = spring(c, i)
        damped = damped or s.eta > 0.0 or s.lossy > 0.0
    return damped


@run.driving
def next_piece(c, starts, want):
    """Start from rest, or write a sample and begin a piece; return whether it was the last."""
    r, k, t = c.now, int(c.now.piece) + 1, c.time
    if starts:
        if c.values[0] != 0.0 and (c.top == MOTION or c.top == STRESS):
            _begin_ramp(c, want)
            return c.none
        _begin_piece(c, c.none)
        rates(c, c.y, c.stage, want, 0.0)
        write(c, c.y, 0.0, c.none, want)
        return int(c.samples == 1)
    if k == 0:  # after a ramp
        _end_ramp(c, want)
        _begin_piece(c, k)
    r.piece, jumps = k, k > 0 and c.top == MOTION and c.groups == 1 and _is_damped(c)
    if jumps or k == c.samples - 1:
        write(c, c.y, r.now, k, want)
    if k == c.samples - 1:
        return 1
    if k > 0:
        _begin_piece(c, k)
    rates(c, c.y, c.stage, want, 0.0)
    # Dashpots have the mean rate at a sample where the prescribed rate jumps.
    if not jumps:
        write(c, c.y, 0.0, k, KNOWN + c.none)
    else:
        share, out = (t[k] - t[k - 1]) / (t[k + 1] - t[k - 1]), row_of(c, c.none, c.none)
        out[k] += share * (c.carried[0] - out[k])
        for j in range(c.p):
            out = row_of(c, 1 + j, c.none)
            out[k] += share * (c.common[j] - out[k])
    return c.none


# ---------------------------------------------------------------- from step to step


@run.advancing
def advance(c, how, struck, want):
    """Go to the first event in the step or to its end, write its samples, return what happened."""
    r, share, who, kind = c.now, 1.0, -1, -1
    if how == events.DOUBTFUL:
        share, who, kind = events.first_event(c)
    if struck and how != events.PLAIN:
        whole = who < 0 and r.now + r.step >= r.horizon
        write(c, c.y, r.horizon if whole else r.now + share * r.step, INSIDE, want)
    if who < 0:
        if how != events.PLAIN:
            rates(c, c.new, c.f, c.none, r.now + r.step)
        _finish_step(c, struck)
        return c.none
    moved = share * r.step > 1e-15 * abs(r.now)
    slope = _pass_event(c, want, share, who, kind)
    if kind == events.RELEASE:
        write(c, c.y, slope, FLIGHT, c.none)
        return RELEASED + c.none
    return (SWITCHED if moved else STALLED) + c.none


@inner
def _failure(c, how, most):
    """Return how a run ends after a step: DONE if it goes on."""
    if c.drive.flat > 0.0:
        return c.none + run.FLAT_UNDER_STRESS
    if how == events.FAILED and not abs(c.new[0]) < math.inf:
        return c.none + run.NOT_FINITE
    if c.now.taken >= most:
        return c.none + run.TOO_MANY_STEPS
    return c.none + (run.STEP_UNDERFLOW if how == events.FAILED else run.DONE)


@outer
def integrate(ints, floats, rows, heights, mass, reals, values, time, out, log):
    """Integrate a chain over sample times.

    `out` (1 + p, 1 + nodes, n) becomes base stress and displacements, and their derivatives, `log`
    the switches; `ints` and `floats`, zeros, are the memory of the run, which begins with its
    results, see `run.NOW`.
    """
    c = run.begin_run(ints, floats, time, values, out, log, rows, heights, mass, reals)
    r, given, want = c.now, start(reals), int(c.p > 0)
    struck, tol, most, stalled, done = int(given[SPEED] > 0.0), given[TOL], given[MOST], 0, 0
    _begin(c, given)
    longest = _longest(c, want)
    if struck:
        _strike(c, want)
        short = FIRST * r.brief
        r.step = min(r.horizon, short if c.degree and short > 0.0 else _first_step(c, tol))
    else:
        done = run.call_drive(c, 1, want)
        r.step = r.horizon
    outcome, ended = run.DONE, math.nan
    while not (done or (struck and int(r.sample) == c.samples)):
        _fresh_scales(c)
        events.keep_values(c)
        r.step = min(r.step, r.horizon - r.now, longest)
        upto = c.time[int(r.sample)] if struck else math.inf
        how = run.call_step(c, want, tol, upto, most)
        outcome = _failure(c, how, most)
        event = run.call_advance(c, how, struck, want) if outcome == run.DONE else c.none
        stalled = stalled + 1 if event == STALLED else 0
        if stalled > 4 * c.count + 8:
            outcome = run.STEP_UNDERFLOW
        if outcome != run.DONE or event == RELEASED:
            ended = r.begun + r.now
            break
        dt = r.step * r.grow
        if r.now >= r.horizon and struck:
            r.horizon = math.nextafter(r.now, math.inf)
        elif r.now >= r.horizon:
            done = run.call_drive(c, 0, want)
            dt = r.horizon if r.piece == 0.0 else dt  # after a ramp
            _turn(c, want, -1 + c.none)
        r.step = dt
    r.outcome, r.ended, r.finite = outcome, ended, is_finite(c, c.shown)
    r.farthest = c.scales[run.OF_W]


def lost(strongest: float, moved: float, damped: float, motion: float, stress: float) -> float:
    """Return the size of vibrations that were damped out over the ranges, from results of a run."""
    if motion > 0.0:
        share = motion / moved if moved > 0.0 else 0.0
        damped += max(share, stress / strongest)
    return damped
