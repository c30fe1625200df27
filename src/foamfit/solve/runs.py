"""Runs of a chain: its layout, the loop over time, and the samples."""

from __future__ import annotations

import math

from numba import njit

from foamfit.solve.along import TABLE, follow_motion
from foamfit.solve.explicit import (
    BEGUN,
    BRIEF,
    DAMPED,
    DOUBTFUL,
    FAILED,
    GROW,
    HORIZON,
    LARGEST,
    LAST,
    LOGGED,
    NOW,
    PIECE,
    PLAIN,
    PRESSED,
    RELEASE,
    RISEN,
    RUN,
    SAMPLE,
    STAGES,
    STEP,
    TAKEN,
    TOP_END,
    TURN,
    WORK_WORDS,
    Work,
    dense,
    first_event,
    keep_values,
    look,
    pack_work,
    take_step,
)
from foamfit.solve.links import PACE as PACED
from foamfit.solve.links import (
    CHANGE_AT,
    DRAGGED,
    DRIVES,
    EPS_AT,
    FIXED,
    FLAT,
    INTERNALS,
    KIND,
    NUMBERS,
    OF_EPS,
    OF_SIGMA,
    OF_V,
    OF_W,
    PARAMETERS,
    RATES_AT,
    SCALES,
    TOP_SPEED,
    VALUE,
    VALUE_RATE,
    WORDS,
    X_AT,
    Z_AT,
    Links,
    begin,
    change_branch,
    derive_group,
    evaluate,
    pack,
    rates,
    rates_of,
)
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
)
from foamfit.solve.static import bring, derive_here, elongation, push_to, strain_to
from foamfit.springs.compiled.contract import (
    BRANCH,
    BY,
    BY_HELD,
    BY_STRESS,
    EPS,
    ETA,
    EVALUATE,
    EXPLICIT,
    GAIN,
    HEIGHT,
    INTERNAL,
    LOSS,
    MISS,
    OF_LAW,
    OPTIONS,
    PER_HEIGHT,
    RATE,
    RELAX,
    RESULTS,
    SLOPE,
    STEEP,
    STRESS as TOTAL,
    TANGENT,
    TURNS,
    X,
    call_evaluate,
    inner,
    past,
    results_of,
    start,
)
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_HEIGHT, OWN_RELAXATION

# Integers of a run, then for each spring: addresses of its law, kind, parameters, internals.
COUNT, GROUPS, P, TERMS, TOP, NODES_OUT, RESULTS_OF, ROW_OF, WIDE, RATES_OF, CHANGE_OF, STEP_OF, DEGREE_OF, SIZES = range(14)
LAW = 8
BATCH, MOST_OWN = 64, 10  # samples that are computed together, of a law with so many parameters
# Numbers of a run.
DRAGS, SPEED, TOL, MOST, PACE, BRIEFLY, REALS = range(7)
# Results of a run.
OUTCOME, ENDED, STEPS, SWITCHES, STRONGEST, FARTHEST, DAMPED_OUT, ENDINGS = range(8)
RAMP = 1e-9  # time of a ramp to the first sample over the duration


def room(sizes: tuple[int, ...], internals: int) -> tuple[int, int]:
    """Return the numbers of floats and integers that a run needs, at most."""
    count, groups, p, terms, _, _, _, _, wide, *_ = sizes
    n = 2 * groups + count * (1 + terms) + internals
    n += n * p
    wide_n = (n + 3) // 4 * 4
    floats = count * wide + 2 * groups + DRIVES + (2 * count + 1 + 4 * count + groups + 3 + count) * p
    floats += SCALES + internals + count + RUN + 28 * wide_n + BATCH * (6 + BY + MOST_OWN) + 2 + terms * (TABLE + 1 + p) + 3 * p + 8
    return floats, WORDS + WORK_WORDS + count * NUMBERS + count + 1 + p + n


@inner
def place_state(c, kinds, numbers):  # type: ignore[no-untyped-def]
    """Give every component of the state its place; return the numbers of components."""
    at, more = 2 * c.nodes, SCALES + c.count
    for k in range(at):
        kinds[k] = OF_V if k % 2 else OF_W
    i = c.none
    for g in range(c.groups):
        several = c.ends[g] - i > 1 or (g == c.groups - 1 and (c.top == STRESS or c.top == VISCOUS))
        while i < c.ends[g]:
            n, eta = past(numbers, i * NUMBERS), c.springs[i * c.width + ETA]
            n[EPS_AT] = n[X_AT] = -1
            n[FIXED] = int(several and eta == 0.0)
            if several and eta > 0.0:
                n[EPS_AT], kinds[at], at = at, SCALES + i, at + 1
            n[Z_AT] = at
            for _ in range(c.terms):
                kinds[at], at = OF_SIGMA, at + 1
            if n[KIND] == INTERNAL:
                n[X_AT] = at
                for _ in range(n[INTERNALS]):
                    kinds[at], at, more = more, at + 1, more + 1
            i += 1
    carries, i = at, c.none
    for g in range(c.groups):
        several = c.ends[g] - i > 1 or (g == c.groups - 1 and (c.top == STRESS or c.top == VISCOUS))
        while i < c.ends[g]:
            n = past(numbers, i * NUMBERS)
            if c.solved:
                i += 1
                continue
            if several and n[EPS_AT] < 0:
                n[EPS_AT], kinds[at], at = at, SCALES + i, at + 1
            if n[KIND] == BY_STRESS:
                n[X_AT], kinds[at], at = at, OF_SIGMA, at + 1
            i += 1
    return carries, at


@inner
def own_directions(c, own, owned):  # type: ignore[no-untyped-def]
    """List the directions of each spring, and mark those of heights, dashpots and drag."""
    p, at = c.p, c.count + 1
    for k in range((2 * c.count + 1) * p):
        own[k] = 0.0
    for i in range(c.count):
        owned[i] = at
        for j in range(p):
            what = c.directions[2 * j + 1]
            if c.directions[2 * j] == i and 0 <= what < OWN_ETA:
                owned[at], at = j, at + 1
    owned[c.count] = at
    for j in range(p):
        i, what = c.directions[2 * j], c.directions[2 * j + 1]
        if what == OWN_HEIGHT:
            own[2 * i * p + j] = 1.0
        elif what == OWN_ETA:
            own[(2 * i + 1) * p + j] = 1.0
        elif what == DRAG:
            own[2 * c.count * p + j] = 1.0


@inner
def lay_out(sizes, laws, ends, directions, rows, heights, mass, reals, solved, ints, floats):  # type: ignore[no-untyped-def]
    """Lay out a run; return chain and work."""
    count, groups, p, terms, wide = sizes[COUNT], sizes[GROUPS], sizes[P], sizes[TERMS], sizes[WIDE]
    top, row = sizes[TOP], sizes[ROW_OF]
    nodes = groups if top == FREE or top == VISCOUS else groups - 1
    words = start(ints)
    words[RATES_AT], words[CHANGE_AT] = sizes[RATES_OF], sizes[CHANGE_OF]
    of_work = past(words, WORDS)
    numbers = past(of_work, WORK_WORDS)
    owned = past(numbers, count * NUMBERS)
    kinds = past(owned, count + 1 + p)
    springs = start(floats)
    per_mass = past(springs, count * wide)
    drive = past(per_mass, groups)
    carried = past(drive, DRIVES)
    own = past(carried, groups)
    held = past(own, (2 * count + 1) * p)
    part = past(held, 2 * count * p)
    common = past(part, 2 * count * p)
    strain = past(common, (groups + 3) * p)
    scales = past(strain, count * p)
    none = count - count
    for i in range(count):
        s, n = past(springs, i * wide), past(numbers, i * NUMBERS)
        for k in range(LAW):
            n[k] = laws[i, k]
        for k in range(row):
            s[k] = 0.0
        s[HEIGHT], s[PER_HEIGHT], s[ETA], s[GAIN] = heights[i], 1.0 / heights[i], rows[i, 0], 1.0
        s[LOSS] = s[ETA]
        for k in range(terms):
            s[RELAX + 2 * k], s[RELAX + 2 * k + 1] = rows[i, 1 + 2 * k], rows[i, 2 + 2 * k]
            s[GAIN] += rows[i, 1 + 2 * k]
        for k in range(1 + 2 * terms, rows.shape[1]):
            s[row + k - 1 - 2 * terms] = rows[i, k]
    for g in range(groups):
        per_mass[g], carried[g] = 1.0 / mass[g], 0.0  # the first guess of a stress
    for k in range(DRIVES):
        drive[k] = 0.0
    for k in range((4 * count) * p):
        held[k] = 0.0
    for k in range((groups + 3 + count) * p):
        common[k] = 0.0
    drive[DRAGGED], drive[PACED] = reals[DRAGS], reals[PACE]
    c = Links(
        springs, per_mass, drive, carried, own, held, part, common, strain, numbers, start(ends),
        start(directions), owned, words, sizes[RESULTS_OF], row, wide, count, groups, nodes, p,
        none, none, terms, top, solved, none,
    )  # fmt: skip
    own_directions(c, own, owned)
    carries, base = place_state(c, kinds, numbers)
    more = SCALES + count
    for i in range(count):
        more += numbers[i * NUMBERS + INTERNALS]
    for k in range(more):
        scales[k] = 0.0
    run = past(scales, more)
    n = base + carries * p
    w = (n + 3) // 4 * 4
    stage = past(run, RUN)
    for k in range(28 * w):
        stage[k] = 0.0
    c = Links(
        springs, per_mass, drive, carried, own, held, part, common, strain, numbers, start(ends),
        start(directions), owned, words, sizes[RESULTS_OF], row, wide, count, groups, nodes, p,
        base, carries, terms, top, solved, none,
    )  # fmt: skip
    pack(c)
    line = past(stage, 16 * w)
    m = Work(
        stage, line, past(line, 7 * w), past(line, 8 * w), past(line, 9 * w), past(line, 10 * w),
        past(line, 11 * w), past(stage, 13 * w), scales, run, past(line, 12 * w), kinds, of_work,
        w, sizes[DEGREE_OF],
    )  # fmt: skip
    pack_work(m)
    return c, m


# ---------------------------------------------------------------- samples


@inner
def write(c, y, f, at, k, want, out):  # type: ignore[no-untyped-def]
    """Write base stress and displacements, and their derivatives, at sample k from a state."""
    every, p, last = out.shape[1] > 2, c.p, c.groups - 1
    rates_of(c, c.none, y, f, want, at)
    out[0, 0, k] = c.carried[0]
    for j in range(p):
        out[1 + j, 0, k] = c.common[j]
    for g in range(c.none if every else last, c.groups):
        solved = g < c.nodes
        if every or not (solved or c.top == MOTION):
            if g > 0:
                rates_of(c, g, y, f, want, at)
            place_nodes(c, g, y, k, every, out)
        node = out.shape[1] - 1 if not every else c.ends[g]
        if solved:
            out[0, node, k] = y[2 * g]
            for j in range(p):
                out[1 + j, node, k] = y[c.base + 2 * g * p + j]
        elif c.top == MOTION:
            out[0, node, k] = c.drive[VALUE] + c.drive[VALUE_RATE] * at
            for j in range(p):
                out[1 + j, node, k] = 0.0


@inner
def place_nodes(c, g, y, k, every, out):  # type: ignore[no-untyped-def]
    """Write the displacements above the springs of a group, or only of the last."""
    p, i0 = c.p, c.ends[g - 1] if g > 0 else c.none
    place = y[2 * (g - 1)] if g > 0 else 0.0
    reach = past(c.common, (c.groups + 1) * p)
    for j in range(p):
        reach[j] = y[c.base + 2 * (g - 1) * p + j] if g > 0 else 0.0
    for i in range(i0, c.ends[g]):
        s, strain, own = past(c.springs, i * c.width), past(c.strain, i * p), past(c.own, 2 * i * p)
        place += s[HEIGHT] * s[EPS]
        for j in range(p):
            reach[j] += s[HEIGHT] * strain[j] + s[EPS] * own[j]
        node = 1 + i if every else out.shape[1] - 1
        out[0, node, k] = place
        for j in range(p):
            out[1 + j, node, k] = reach[j]


@inner
def fly(c, m, t, first, gravity, slope, out):  # type: ignore[no-untyped-def]
    """Write the samples after the end of contact; `slope` is dS/dt there.

    The chain moves with the striker. Derivatives include the shift of the end of contact.
    """
    p, y, now, top = c.p, m.y, m.run[NOW], c.groups - 1
    speed, pull = y[2 * top + 1], m.stage[2 * top + 1]
    node, place, quick = 1, 0.0, 0.0
    for g in range(c.groups):
        i0 = c.ends[g - 1] if g > 0 else c.none
        place, quick = (y[2 * g - 2], y[2 * g - 1]) if g > 0 else (0.0, 0.0)
        reach = past(c.common, (c.groups + 1) * p)
        for j in range(p):
            reach[j] = y[c.base + 2 * (g - 1) * p + j] if g > 0 else 0.0
        for i in range(i0, c.ends[g]):
            s, strain, own = (
                past(c.springs, i * c.width), past(c.strain, i * p), past(c.own, 2 * i * p),
            )  # fmt: skip
            place += s[HEIGHT] * s[EPS]
            quick += s[HEIGHT] * s[RATE]
            for j in range(p):
                reach[j] += s[HEIGHT] * strain[j] + s[EPS] * own[j]
            if i == c.ends[g] - 1:
                place, quick = y[2 * g], y[2 * g + 1]
                for j in range(p):
                    reach[j] = y[c.base + 2 * g * p + j]
            if out.shape[1] == 2 and i < c.count - 1:
                continue
            for k in range(first, t.size):
                since = t[k] - now
                out[0, 0, k], out[0, node, k] = 0.0, place + (speed + 0.5 * gravity * since) * since
            for j in range(p):
                late = -c.common[j] / slope if slope != 0.0 else 0.0
                dv = y[c.base + (2 * top + 1) * p + j] + (pull - gravity) * late
                at = reach[j] + (quick - speed) * late
                for k in range(first, t.size):
                    out[1 + j, 0, k], out[1 + j, node, k] = 0.0, at + dv * (t[k] - now)
            node += 1


@inner
def approach(c, t, speed, gravity, out):  # type: ignore[no-untyped-def]
    """Write the samples before contact, when only the striker moves; return their number."""
    done, last = c.none, out.shape[1] - 1
    while done < t.size and t[done] < 0.0:
        for q in range(out.shape[0]):
            for node in range(out.shape[1]):
                out[q, node, done] = 0.0
        out[0, last, done] = (speed + 0.5 * gravity * t[done]) * t[done]
        done += 1
    return done


# ---------------------------------------------------------------- the loop over time


@inner
def first_step(c, tol):  # type: ignore[no-untyped-def]
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
def begin_piece(c, m, k, t, values):  # type: ignore[no-untyped-def]
    """Prescribe the drive between samples k and k + 1."""
    r, drive = m.run, c.drive
    r[NOW], r[BEGUN], drive[VALUE], drive[VALUE_RATE] = 0.0, t[k], values[k], 0.0
    r[HORIZON] = 0.0
    if k + 1 < t.size:
        r[HORIZON] = t[k + 1] - t[k]
        drive[VALUE_RATE] = (values[k + 1] - values[k]) / (t[k + 1] - t[k])


@inner
def log_switch(c, m, i, left, log):  # type: ignore[no-untyped-def]
    """Log a change of branch, if there is room."""
    s, at = past(c.springs, i * c.width), int(m.run[LOGGED])
    if at < log.shape[0]:
        log[at, 0], log[at, 1], log[at, 2] = m.run[BEGUN] + m.run[NOW], i, left
        log[at, 3], log[at, 4] = s[BRANCH], s[EPS]
    m.run[LOGGED] += 1.0


@inner
def mend(c, y):  # type: ignore[no-untyped-def]
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
def pass_event(c, m, n, want, share, who, kind, log):  # type: ignore[no-untyped-def]
    """Move to an event within the step; return dS/dt at the end of contact, or change the branch."""
    r, y = m.run, m.y
    dt, at, slope = r[STEP], r[NOW], 0.0
    if kind == RELEASE:
        after = look(c, m, dt, at, share + 1e-3, c.none, RELEASE + c.none)
        before = look(c, m, dt, at, share - 1e-3, c.none, RELEASE + c.none)
        slope = (after - before) / (-2e-3 * dt)
    dense(m, n, share, m.state)
    for k in range(n):
        y[k] = m.state[k]
    r[NOW] += share * dt
    r[GROW] = min(r[GROW], 1.0)
    rates(c, y, m.stage, want, r[NOW])
    mend(c, y)
    rates(c, y, m.stage, want, r[NOW])
    if kind == RELEASE:
        return slope
    s = past(c.springs, who * c.width)
    up = int(s[TURNS] < 0.0) if kind == TURN else int(kind == TOP_END)
    left, steep = s[BRANCH], s[TANGENT]
    change_branch(c, who, up, y)
    log_switch(c, m, who, left, log)
    rates(c, y, m.stage, want, r[NOW])
    if steep > 0.0 and s[TANGENT] > 0.0:
        r[GROW] *= min(max(math.sqrt(steep / s[TANGENT]), 0.2), 2.0)
    return slope


@inner
def fresh_scales(c, m):  # type: ignore[no-untyped-def]
    """Let the scales of the error cover what the next step may reach."""
    for k in range(c.base):
        kind = m.kinds[k]
        m.scales[kind] = max(m.scales[kind], max(abs(m.y[k]), 0.1 * m.run[STEP] * abs(m.stage[k])))


@inner
def ended(out, outcome, m):  # type: ignore[no-untyped-def]
    """Write the results of a run."""
    out[OUTCOME], out[STEPS], out[SWITCHES] = outcome, m.run[TAKEN], m.run[LOGGED]
    out[STRONGEST], out[FARTHEST], out[DAMPED_OUT] = m.run[LARGEST], m.scales[OF_W], m.run[DAMPED]
    if outcome != DONE:
        out[ENDED] = m.run[BEGUN] + m.run[NOW]


@inner
def start_at_rest(c, m, t, values, rows):  # type: ignore[no-untyped-def]
    """Bring the springs above the last mass into equilibrium with the first sample of a drive.

    Under a prescribed stress, springs with a dashpot start from rest.
    """
    g = c.groups - 1
    i0, i1, y = (c.ends[g - 1] if g > 0 else c.none), c.ends[g], m.y
    begin_piece(c, m, c.none, t, values)
    first = c.drive[VALUE]
    if c.top == FREE or c.top == VISCOUS:
        return
    for i in range(i0, i1):
        c.springs[i * c.width + GAIN] = 1.0  # relaxation terms carry nothing yet
    if c.top == STRESS:
        for i in range(i0, i1):
            if c.springs[i * c.width + ETA] == 0.0:
                push_to(c, i, first, 0.0, y)
    elif i1 - i0 == 1:
        strain_to(c, i0, first / c.springs[i0 * c.width + HEIGHT], y)
        first = 0.0
    else:
        first = bring(c, i0, i1, first, 0.0, y)
    for i in range(i0, i1):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        evaluate(c, i, int(c.p > 0))
        s[TANGENT], s[TOTAL] = s[c.results + SLOPE], s[c.results + OF_LAW]
        if n[EPS_AT] >= 0:
            y[n[EPS_AT]] = s[EPS]
        if n[KIND] == BY_STRESS and n[X_AT] >= 0:
            y[n[X_AT]] = s[X]
        for k in range(c.terms):
            y[n[Z_AT] + k] = -s[TOTAL]
    if c.p > 0:
        derive_start(c, m, i0, i1, first, rows)
    for i in range(i0, i1):
        for k in range(c.terms):
            c.springs[i * c.width + GAIN] += rows[i, 1 + 2 * k]


@inner
def starts_on_ramp(c, values):  # type: ignore[no-untyped-def]
    """Whether internal variables change up to the first sample of a drive."""
    if values[0] == 0.0 or not (c.top == MOTION or c.top == STRESS):
        return False
    for i in range(c.ends[c.groups - 2] if c.groups > 1 else c.none, c.count):
        if c.numbers[i * NUMBERS + KIND] == INTERNAL:
            return True
    return False


@inner
def begin_ramp(c, m, t, values):  # type: ignore[no-untyped-def]
    """Begin a ramp to the first sample of a drive, while time stands still.

    Nodes rest. Relaxation terms and dashpots carry nothing; under a prescribed stress dashpots are
    rigid.
    """
    r, drive = m.run, c.drive
    brief = RAMP * (t[t.size - 1] - t[0]) if t.size > 1 else RAMP
    r[NOW], r[BEGUN], r[HORIZON], r[PIECE] = 0.0, t[0] - brief, brief, -1.0
    drive[VALUE], drive[VALUE_RATE], drive[PACED] = 0.0, values[0] / brief, 0.0
    for g in range(c.groups):
        c.per_mass[g] = 0.0
    for i in range(c.ends[c.groups - 2] if c.groups > 1 else c.none, c.count):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        if s[ETA] > 0.0:
            s[ETA] = 0.0 if c.top == MOTION else math.inf
            n[FIXED] = int(c.top == MOTION and n[EPS_AT] >= 0)
        s[GAIN] = 1.0
        for k in range(c.terms):
            s[RELAX + 2 * k] = 0.0


@inner
def end_ramp(c, m, rows, mass, pace):  # type: ignore[no-untyped-def]
    """Let time pass again: relaxation terms begin at zero, and dashpots at the present strain."""
    y, p, i0 = m.y, c.p, (c.ends[c.groups - 2] if c.groups > 1 else c.none)
    rates(c, y, m.stage, int(p > 0), m.run[NOW])
    c.drive[PACED], m.run[GROW] = pace, 1.0
    for g in range(c.groups):
        c.per_mass[g] = 1.0 / mass[g]
    for i in range(i0, c.count):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        for k in range(c.terms):
            s[RELAX + 2 * k] = rows[i, 1 + 2 * k]
            s[GAIN] += rows[i, 1 + 2 * k]
            y[n[Z_AT] + k] = -s[c.results + OF_LAW]
            for j in range(p):
                by = s[STEEP] * c.strain[i * p + j] + c.part[i * p + j]
                y[c.base + (n[Z_AT] + k) * p + j] = -by
        if rows[i, 0] == 0.0:
            continue
        s[ETA] = rows[i, 0]
        if n[EPS_AT] >= 0 and c.top == MOTION:
            y[n[EPS_AT]] = s[EPS]
            for j in range(p):
                y[c.base + n[EPS_AT] * p + j] = c.strain[i * p + j]
        if n[FIXED]:
            first, n[FIXED] = past(s, c.results + BY + n[PARAMETERS] + 2), 0
            for k in range(n[INTERNALS] if n[KIND] == INTERNAL else c.none):
                for j in range(p):
                    y[c.base + (n[X_AT] + k) * p + j] += first[k] * c.strain[i * p + j]


@inner
def derive_start(c, m, i0, i1, common, rows):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the state at rest, where terms carry nothing, nor dashpots."""
    y, p = m.y, c.p
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        s[ETA] = 0.0 if c.top == MOTION else s[ETA]
        for k in range(c.terms):
            s[RELAX + 2 * k] = 0.0
    c.carried[c.groups - 1] = common
    derive_group(c, c.groups - 1, y, m.f)
    for i in range(i0, i1):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        s[ETA] = rows[i, 0]
        for k in range(c.terms):
            s[RELAX + 2 * k] = rows[i, 1 + 2 * k]
        slope = s[c.results + SLOPE]
        for j in range(p):
            strain, part = c.strain[i * p + j], c.part[i * p + j]
            if s[ETA] > 0.0 and n[EPS_AT] >= 0:
                strain = strain if c.top == MOTION else 0.0
                y[c.base + n[EPS_AT] * p + j] = strain
            for k in range(c.terms):
                y[c.base + (n[Z_AT] + k) * p + j] = -(slope * strain + part)


@inner
def blend(c, m, t, k, want, out):  # type: ignore[no-untyped-def]
    """Give dashpots the mean rate at a sample where the prescribed rate jumps."""
    share = (t[k] - t[k - 1]) / (t[k + 1] - t[k - 1])
    out[0, 0, k] += share * (c.carried[0] - out[0, 0, k])
    for j in range(c.p):
        out[1 + j, 0, k] += share * (c.common[j] - out[1 + j, 0, k])


@inner
def next_piece(c, m, t, values, want, out):  # type: ignore[no-untyped-def]
    """Write the sample at the end of a piece, and begin the next; return whether it was the last."""
    r, k = m.run, int(m.run[PIECE]) + 1
    r[PIECE] = k
    if k == 0:  # after a ramp, with the rate of the first piece
        begin_piece(c, m, k, t, values)
    write(c, m.y, m.f, r[NOW], k, want, out)
    if k == t.size - 1:
        return True
    if k > 0:
        begin_piece(c, m, k, t, values)
    rates(c, m.y, m.stage, want, 0.0)
    if c.top == MOTION and c.groups == 1 and k > 0:
        blend(c, m, t, k, want, out)
    return False


@inner
def polynomial(m, i, shares, n, out):  # type: ignore[no-untyped-def]
    """Fill component i of the state at n shares of an explicit step."""
    line, wide = m.line, m.wide
    a, b, c, d = line[i], line[wide + i], line[2 * wide + i], line[3 * wide + i]
    e, g, h, first = line[4 * wide + i], line[5 * wide + i], line[6 * wide + i], m.y[i]
    for k in range(n):
        x = shares[k]
        z = 1.0 - x
        out[k] = first + x * (a + z * (b + x * (c + z * (d + x * (e + z * (g + x * h))))))


@inner
def write_batch(c, m, t, at, n, out):  # type: ignore[no-untyped-def]
    """Write n samples from `at` on: base stress of one spring, which is alone, and the top."""
    s, own, p, top = past(c.springs, c.none), past(c.numbers, c.none), c.p, 2 * c.groups - 2
    shares = m.batch
    eps, x, work = past(shares, BATCH), past(shares, 2 * BATCH), past(shares, 3 * BATCH)
    w, v, found = past(shares, 4 * BATCH), past(shares, 5 * BATCH), past(shares, 6 * BATCH)
    per, eta, gain, dt, now = s[PER_HEIGHT], s[ETA], s[GAIN], m.run[STEP], m.run[NOW]
    for k in range(n):
        shares[k] = (t[at + k] - now) / dt
    polynomial(m, c.none, shares, n, w)
    polynomial(m, c.none + 1, shares, n, v)
    for k in range(n):
        eps[k] = w[k] * per
    if own[X_AT] >= 0:
        polynomial(m, own[X_AT], shares, n, x)
    call_evaluate(own[EVALUATE], past(s, c.row), s, eps, x, n, int(p > 0), found)
    sigma = past(found, OF_LAW * n)
    for k in range(n):
        out[0, 0, at + k] = gain * sigma[k] + eta * per * v[k]
    for q in range(c.terms):
        polynomial(m, own[Z_AT] + q, shares, n, work)
        for k in range(n):
            out[0, 0, at + k] += s[RELAX + 2 * q] * work[k]
    if top > 0:
        polynomial(m, top, shares, n, work)
    for k in range(n):
        out[0, 1, at + k] = work[k] if top > 0 else w[k]
    for j in range(p):
        write_slope(c, m, j, at, n, out)


@inner
def write_slope(c, m, j, at, n, out):  # type: ignore[no-untyped-def]
    """Write derivative j of the samples of `write_batch`."""
    s, own, p, top = past(c.springs, c.none), past(c.numbers, c.none), c.p, 2 * c.groups - 2
    shares = m.batch
    eps, work, v = past(shares, BATCH), past(shares, 3 * BATCH), past(shares, 5 * BATCH)
    found = past(shares, 6 * BATCH)
    slope, sigma = past(found, SLOPE * n), past(found, OF_LAW * n)
    per, eta, gain, what = s[PER_HEIGHT], s[ETA], s[GAIN], c.directions[2 * j + 1]
    mine, of_height, of_eta = c.directions[2 * j] == 0, c.own[j], c.own[p + j]
    polynomial(m, c.base + j, shares, n, work)
    for k in range(n):
        out[1 + j, 1, at + k] = work[k]
        out[1 + j, 0, at + k] = gain * slope[k] * per * (work[k] - of_height * eps[k])
    if mine and 0 <= what < OWN_ETA:
        by = past(found, (BY + what) * n)
        for k in range(n):
            out[1 + j, 0, at + k] += gain * by[k]
    if own[KIND] == BY_STRESS:
        held, ever, by = gain * c.held[j], gain * c.held[p + j], past(found, BY_HELD * n)
        for k in range(n):
            out[1 + j, 0, at + k] += held * by[k] + ever * by[n + k]
    if eta > 0.0 or of_eta > 0.0:
        polynomial(m, c.none + 1, shares, n, v)
        polynomial(m, c.base + p + j, shares, n, work)
        for k in range(n):
            more = of_eta * v[k] + eta * (work[k] - of_height * per * v[k])
            out[1 + j, 0, at + k] += per * more
    for q in range(c.terms):
        polynomial(m, c.base + (own[Z_AT] + q) * p + j, shares, n, work)
        for k in range(n):
            out[1 + j, 0, at + k] += s[RELAX + 2 * q] * work[k]
        if mine and what == OWN_RELAXATION + 2 * q:
            polynomial(m, own[Z_AT] + q, shares, n, work)
            for k in range(n):
                out[1 + j, 0, at + k] += sigma[k] + work[k]
    if top > 0:
        polynomial(m, c.base + top * p + j, shares, n, work)
        for k in range(n):
            out[1 + j, 1, at + k] = work[k]


@inner
def write_inside(c, m, n, t, reached, want, out):  # type: ignore[no-untyped-def]
    """Write the samples of an impact up to a time inside the step."""
    r = m.run
    k = int(r[SAMPLE])
    quick = out.shape[1] == 2 and c.ends[0] == 1 and c.top == FREE and m.degree == 0
    if quick and c.numbers[KIND] != INTERNAL and c.numbers[PARAMETERS] <= MOST_OWN:
        while k < t.size and t[k] <= reached:
            last = k + 1
            while last < t.size and last - k < BATCH and t[last] <= reached:
                last += 1
            write_batch(c, m, t, k, last - k, out)
            k = last
    while k < t.size and t[k] <= reached:
        dense(m, n, (t[k] - r[NOW]) / r[STEP], m.state)
        write(c, m.state, m.f, t[k], k, want, out)
        k += 1
    r[SAMPLE] = k


@inner
def finish_step(c, m, struck):  # type: ignore[no-untyped-def]
    """Advance to the end of a step."""
    r = m.run
    largest = keep_values(c)
    r[LARGEST] = max(r[LARGEST], largest)
    if struck and c.carried[0] > RISEN * r[LARGEST]:
        r[PRESSED] = 1.0
    for k in range(m.wide):
        m.y[k], m.stage[k] = m.new[k], m.stage[STAGES * m.wide + k]
    mend(c, m.y)
    r[NOW] = r[HORIZON] if r[NOW] + r[STEP] >= r[HORIZON] else r[NOW] + r[STEP]
    for k in range(c.base):
        kind = m.kinds[k]
        m.scales[kind] = max(m.scales[kind], abs(m.y[k]))


@njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False, cache=True)
def integrate(  # type: ignore[no-untyped-def]
    sizes, laws, ends, directions, rows, heights, mass, reals, values, t, out, log, ints, floats,
    scales, endings, systems,
):  # fmt: skip
    """Integrate a chain over sample times; fill `endings`.

    `out` (1 + p, 1 + nodes, n) becomes base stress and displacements, and their derivatives, `log`
    the switches; `ints` and `floats` are overwritten. `systems` are the words of implicit steps.
    """
    solved = int(sizes[DEGREE_OF] > 0)
    c, m = lay_out(sizes, laws, ends, directions, rows, heights, mass, reals, solved, ints, floats)
    r, want, tol, most, speed = m.run, int(c.p > 0), reals[TOL], reals[MOST], reals[SPEED]
    ramps, struck, n, step = False, speed > 0.0, c.base + c.carries * c.p, sizes[STEP_OF]
    for k in range(RUN):
        r[k] = 0.0
    for k in range(SCALES):
        m.scales[k] = scales[k]
    for i in range(c.count):  # of the strain of each spring
        m.scales[SCALES + i] = scales[OF_EPS]
    begin(c)
    gravity, r[BRIEF] = 0.0, reals[BRIEFLY]
    if struck:
        m.y[2 * c.nodes - 1] = speed
        gravity = values[0] / mass[c.groups - 1]
        c.drive[VALUE], r[HORIZON] = values[0], t[t.size - 1]
        r[SAMPLE] = approach(c, t, speed, gravity, out)
    else:
        ramps = starts_on_ramp(c, values)
        if ramps:
            begin_ramp(c, m, t, values)
        else:
            start_at_rest(c, m, t, values, rows)
    rates(c, m.y, m.stage, want, 0.0)
    r[STEP], r[LAST], r[GROW] = r[HORIZON] - r[NOW], 1e-4, 1.0
    if struck:
        r[STEP] = min(r[STEP], first_step(c, tol))
    elif t.size == 1 and not ramps:
        write(c, m.y, m.f, 0.0, c.none, want, out)
        ended(endings, DONE, m)
        return
    elif not ramps:
        write(c, m.y, m.f, 0.0, c.none, want, out)
    fresh_scales(c, m)
    stalled = 0
    while True:
        if struck and int(r[SAMPLE]) == t.size:
            endings[ENDED] = math.nan
            ended(endings, DONE, m)
            return
        keep_values(c)
        r[STEP] = min(r[STEP], r[HORIZON] - r[NOW])
        upto = t[int(r[SAMPLE])] if struck else math.inf
        how = take_step(step, c.words, m.words, want, tol, upto, most, start(systems))
        if how == FAILED or r[TAKEN] >= most or c.drive[FLAT] > 0.0:
            outcome = TOO_MANY_STEPS if r[TAKEN] >= most else STEP_UNDERFLOW
            if how == FAILED and not abs(m.new[0]) < math.inf:
                outcome = NOT_FINITE
            ended(endings, FLAT_UNDER_STRESS if c.drive[FLAT] > 0.0 else outcome, m)
            return
        share, who, kind = 1.0, -1, -1
        if how == DOUBTFUL:
            dt, at = r[STEP], r[NOW]
            share, who, kind = first_event(c, m, dt, at, r[PRESSED] > 0.0)
        if struck and how != PLAIN:
            whole = who < 0 and r[NOW] + r[STEP] >= r[HORIZON]
            write_inside(c, m, n, t, r[HORIZON] if whole else r[NOW] + share * r[STEP], want, out)
        if who >= 0:
            stalled = stalled + 1 if share * r[STEP] <= 1e-15 * abs(r[NOW]) else 0
            slope = pass_event(c, m, n, want, share, who, kind, log)
            if kind == RELEASE:
                fly(c, m, t, int(r[SAMPLE]), gravity, slope, out)
                endings[ENDED] = r[NOW]
                ended(endings, DONE, m)
                return
            if stalled > 4 * c.count + 8:
                ended(endings, STEP_UNDERFLOW, m)
                return
            keep_values(c)
        else:
            if how != PLAIN:
                rates(c, m.new, m.f, c.none, r[NOW] + r[STEP])
            finish_step(c, m, struck)
            stalled = 0
        dt = r[STEP] * r[GROW]
        if not struck and r[NOW] >= r[HORIZON]:
            if ramps and r[PIECE] < 0.0:
                end_ramp(c, m, rows, mass, reals[PACE])
            if next_piece(c, m, t, values, want, out):
                endings[ENDED] = math.nan
                ended(endings, DONE, m)
                return
        elif who >= 0 and r[NOW] >= r[HORIZON] and struck:
            r[HORIZON] = math.nextafter(r[NOW], math.inf)
        r[STEP] = dt
        fresh_scales(c, m)


@njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False, cache=True)
def balance(  # type: ignore[no-untyped-def]
    sizes, laws, ends, directions, rows, heights, mass, reals, values, t, out, history, ints,
    floats, strains, endings,
):  # fmt: skip
    """Follow undamped, massless springs in series along a motion or stress of the top.

    `strains` (springs, n) and `history` become strains and branches.
    """
    c, m = lay_out(sizes, laws, ends, directions, rows, heights, mass, reals, 1, ints, floats)
    begin(c)
    want, y, before, p, reach = int(c.p > 0), m.y, 0.0, c.p, past(c.common, 2 * c.p)
    for i in range(c.count):
        evaluate(c, i, want)
    for k in range(t.size):
        now = values[k]
        if c.top == STRESS:
            for i in range(c.count):
                push_to(c, i, now, before, y)
        elif c.count == 1:
            strain_to(c, c.none, now / heights[0], y)
            evaluate(c, c.none, c.none)
            now = past(c.springs, c.none)[c.results + OF_LAW]
        else:
            now = bring(c, c.none, c.count, now, before, y)
        before, place = now, 0.0
        if want:
            derive_here(c, c.none, now, y, m.f)
        for i in range(c.count):
            s = past(c.springs, i * c.width)
            place += s[HEIGHT] * s[EPS]
            if out.shape[1] > 2:
                out[0, 1 + i, k] = place
            strains[i, k], history[i, k] = s[EPS], int(s[BRANCH])
        out[0, 0, k], out[0, out.shape[1] - 1, k] = now, place
        for j in range(p):
            out[1 + j, 0, k] = c.common[j]
            total = 0.0
            for i in range(c.count):
                s = past(c.springs, i * c.width)
                total += s[HEIGHT] * c.strain[i * p + j] + s[EPS] * c.own[2 * i * p + j]
                if out.shape[1] > 2:
                    out[1 + j, 1 + i, k] = total
            out[1 + j, out.shape[1] - 1, k] = total
    endings[OUTCOME] = DONE


@njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False, cache=True)
def follow(  # type: ignore[no-untyped-def]
    sizes, laws, ends, directions, rows, heights, mass, reals, strain, t, out, branches, slopes,
    ints, floats, seeds,
):  # fmt: skip
    """Follow one spring, without its dashpot, along strains; see `along`."""
    c, m = lay_out(sizes, laws, ends, directions, rows, heights, mass, reals, 1, ints, floats)
    begin(c)
    y = past(m.run, RUN)
    work = past(y, c.terms * (1 + c.p))
    follow_motion(c, strain, t, reals[TOL], start(seeds), work, y, out, branches, slopes)
