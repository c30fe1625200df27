"""One spring under a known motion, without integration of the motion.

The strain is linear between samples, so the stress needs no integration, nor do internal variables
that change only where a branch ends. Relaxation terms z = q/g -
σ with dz/dt = -(z + σ)/τ are integrated exactly for the quartic through the stress at both ends and
the middle of a step and its slopes at the ends; what the middle adds to the cubic is the error
estimate. Derivatives follow from those of the stress at the same three points.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import run
from foamfit.solve.compiled.motion import PART, evaluate
from foamfit.solve.compiled.run import begin_run, call_fade, call_inside, change_branch
from foamfit.solve.compiled.samples import is_finite, row_of
from foamfit.springs.compiled.contract import call_number, inner, outer, past, start
from foamfit.springs.laws.record import MOVED, OWN_ETA, OWN_HEIGHT, OWN_RELAXATION

OF_STEP, TABLE = 6, 8  # columns of the table of a relaxation term, which begins with moments
LEAST_STEP, FOLLOWED = 1e-9, 0.1  # share of an interval; error over what the middle adds
LEAST_FADE = 1e-6  # least step with internal variables that decay
SAME, TOO_LONG, UNFIT = range(3)  # ends of a step of `fade`; UNFIT if the law needs another solver


@inner
def bring_to(c, eps):
    """Bring the spring to a strain on its branch; return the stress."""
    s, n = c.springs, c.numbers
    known = call_number(n.settle, past(s, c.row), s, eps)
    if c.p > 0 or known == 0.0:
        evaluate(c, c.none, int(c.p > 0))
    return s.sigma


@inner
def derive(c, seed):
    """Fill the derivatives of the stress now in `part`, and those of the strain."""
    s, n, p = c.springs, c.numbers, c.p
    held, part, strain = c.held, c.part, c.strain
    if n.internal:
        call_inside(c, PART, c.none, c.none, c.y, c.y, c.y, part)
    for j in range(p):
        own = c.directions[2 * j + 1]
        strain[j] = s.per_height * (seed[0] + seed[1] * s.eps) if own == MOVED else 0.0
        if own == OWN_HEIGHT:
            strain[j] = -s.eps * s.per_height
        if not n.internal:
            part[j] = s.by[own] if 0 <= own < OWN_ETA else 0.0
        if n.by_stress:
            part[j] += s.by_held[0] * held[j] + s.by_held[1] * held[p + j]
        c.common[j] = part[j] + s.slope * strain[j]


@inner
def tabulate(x, h, table):
    """Fill the moments ∫₀¹ exp(-x (1-r)) r^m dr, m = 0 … 5, for steps of length h, if it is new."""
    if abs(h - table[OF_STEP]) <= 1e-13 * h:
        return
    table[OF_STEP] = h
    if x > 1.0:
        table[0] = -math.expm1(-x) / x
        for m in range(1, 6):
            table[m] = (1.0 - m * table[m - 1]) / x
        return
    term = total = 1.0 / 6.0
    for k in range(1, 30):
        term *= -x / (6.0 + k)
        total += term
        if abs(term) < 1e-17:
            break
    table[5] = total
    for m in range(5, 0, -1):
        table[m - 1] = (1.0 - x * table[m]) / m


@inner
def quartic(first, middle, last, low, high):
    """Return coefficients 2 to 4 of a quartic; its middle adds `bump` 16 r² (1-r)² to the cubic."""
    rise, bump = last - first, middle - (0.5 * (first + last) + 0.125 * (low - high))
    square, cube = 3.0 * rise - 2.0 * low - high, low + high - 2.0 * rise
    return square + 16.0 * bump, cube - 32.0 * bump, 16.0 * bump, bump


@inner
def integral(a, first, low, square, cube, fourth):
    """Return ∫₀¹ exp(-x (1-r)) (first + low r + square r² + …) dr from the moments `a`."""
    # From the next moments, a + 1, it has another factor r: its sum with its derivative by x.
    return first * a[0] + low * a[1] + square * a[2] + cube * a[3] + fourth * a[4]


@inner
def relax(c, h, tables, first, low, square, cube, fourth, d_first, d_middle):
    """Advance relaxation terms and their derivatives over a step, in which stress is a quartic."""
    s, p, y = c.springs, c.p, c.y
    for k in range(c.terms):
        tau, a, dz = s.tau[k], past(tables, k * TABLE), past(y, c.base + k * p)
        x = h / tau
        decay = math.exp(-x)
        total = integral(a, first, low, square, cube, fourth)
        change = integral(past(a, 1), first, low, square, cube, fourth) - total
        by_tau = (decay * y[k] + total + x * change) * x / tau
        one, two, three = a[0] - 3.0 * a[1] + 2.0 * a[2], 4.0 * (a[1] - a[2]), 2.0 * a[2] - a[1]
        for j in range(p):
            step = one * d_first[j] + two * d_middle[j] + three * c.common[j]
            dz[j] = decay * dz[j] - x * step
            if c.directions[2 * j + 1] == OWN_RELAXATION + 2 * k + 1:
                dz[j] += by_tau
        y[k] = decay * y[k] - x * total


@inner
def sum_up(c, j):
    """Write stress and derivatives of a sample, with all terms."""
    s, p, y = c.springs, c.p, c.y
    sigma = s.sigma
    total = sigma
    for q in range(p):
        slope = c.common[q]
        for k in range(c.terms):
            slope += s.g[k] * (c.common[q] + y[c.base + k * p + q])
            if c.directions[2 * q + 1] == OWN_RELAXATION + 2 * k:
                slope += sigma + y[k]
        row_of(c, 1 + q, c.none)[j] = slope
    for k in range(c.terms):
        total += s.g[k] * (sigma + y[k])
    row_of(c, c.none, c.none)[j] = total


@inner
def step_to(c, part, h, m, seed, tol, weight):
    """Step to a strain of the branch within h; false, unchanged, if the step is too long."""
    # m: largest stress; share of the interval, negative if unfit; tables; derivatives at the start.
    s, p = c.springs, c.p
    tables, d_first = past(m, 2), past(m, 2 + c.terms * TABLE)
    room, fades = past(d_first, p), c.fade_at and c.drive.pace > 0.0
    d_middle = past(room, 3)
    origin, first, slope, x = s.eps, s.sigma, s.slope, s.x
    step = part - origin
    for j in range(p):
        d_first[j] = c.common[j]
    if h <= 0.0 or (c.terms == 0 and not fades):
        m[0] = max(m[0], abs(bring_to(c, part)))
        derive(c, seed)
        return True
    if fades:
        told = call_fade(c, part, h, tol, seed, room)
        if told == TOO_LONG and m[1] > LEAST_FADE:
            return False
        if told != SAME:
            m[0], m[1] = math.inf, -1.0
            return True
        half, low, high, last = room[0], room[1], room[2], s.sigma
    else:
        half = bring_to(c, origin + 0.5 * step)
        derive(c, seed)
        for j in range(p):
            d_middle[j] = c.common[j]
        last = bring_to(c, part)
        low, high = slope * step, s.slope * step
    square, cube, fourth, bump = quartic(first, half, last, low, high)
    size = max(m[0], abs(last))
    if FOLLOWED * weight * abs(bump) > tol * size and m[1] > LEAST_STEP:
        if fades:
            call_fade(c, origin, -1.0, tol, seed, room)
            return False
        s.eps, s.x = origin, x
        bring_to(c, origin)
        for j in range(p):
            c.common[j] = d_first[j]
        return False
    m[0] = size
    derive(c, seed)
    for k in range(c.terms):
        tabulate(h / s.tau[k], h, past(tables, k * TABLE))
    relax(c, h, tables, first, low, square, cube, fourth, d_first, d_middle)
    return True


@inner
def leave(c, up, seed):
    """Change the branch; the strain may grow at any rate, as time does not count."""
    s = c.springs
    s.rate = 1.0 if up else -1.0
    change_branch(c, c.none, int(up), c.y)
    bring_to(c, s.eps)
    derive(c, seed)


@inner
def go_to(c, eps, between, m, seed, tol, weight):
    """Go to the strain of the next sample, `between` later, from branch to branch."""
    s, begun, left, pace = c.springs, c.springs.eps, 1.0, 1.0
    while left > 0.0 or s.eps != eps:
        up = eps > s.eps
        if s.eps != eps and s.turns * (1.0 if up else -1.0) < 0.0:
            leave(c, up, seed)
        goal, until, leaving = eps, 0.0, False
        if up and eps > s.high:
            goal, leaving = s.high, True
        elif not up and eps < s.low:
            goal, leaving = s.low, True
        if leaving:
            until = min(max((eps - goal) / (eps - begun), 0.0), left)
        share, part, whole = left - until, goal, True
        if pace < share:
            part, whole = s.eps + pace / share * (goal - s.eps), False
            share = pace
        m[1] = share
        if not step_to(c, part, share * between, m, seed, tol, weight):
            pace = 0.5 * share
            continue
        if not m[0] < math.inf:
            return
        left = max(left - share, 0.0)
        pace = 1.0 if whole else 2.0 * share
        if leaving and whole:
            leave(c, up, seed)
        elif whole and left == 0.0 and s.eps == eps:
            return


@outer
def follow(ints, floats, rows, heights, mass, reals, strains, time, out, log, samples):
    """Follow one spring, without its dashpot, along strains from rest.

    `samples` (n, 4) become the derivative by a shift of the motion in contact, as the factors of 1
    and ε, then branch and slope dσ/dε. Return DONE, NOT_FINITE, or UNFIT if the law needs another
    solver.
    """
    c = begin_run(ints, floats, time, strains, out, log, rows, heights, mass, reals)
    s, t, tol, n, weight, m = c.springs, c.time, reals[3], c.samples, 0.0, c.batch
    lasts = t[n - 1] - t[0]
    for k in range(c.terms):
        weight += s.g[k] * min(1.0, lasts / s.tau[k])
    before = 0.0
    for j in range(n):
        contact = 1.0 if c.values[j] != 0.0 else 0.0
        samples[j, 0], samples[j, 1] = contact, 0.0
        if j > 0 and contact != before:  # it begins or ends before this sample
            rise = 1.0 / (c.values[j] - c.values[j - 1]) * (contact - before)
            samples[j, 0], samples[j, 1] = 0.0, rise
        before = contact
    bring_to(c, 0.0)
    derive(c, start(samples))
    if c.fade_at:
        call_fade(c, 0.0, 0.0, tol, start(samples), m)
    for j in range(n):
        seed, eps = past(start(samples), 4 * j), c.values[j]
        go_to(c, eps, t[j] - t[j - 1] if j > 0 else 0.0, m, seed, tol, weight)
        for k in range(c.terms if j == 0 else c.none):  # they carry nothing yet
            c.y[k] = -s.sigma
            for q in range(c.p):
                c.y[c.base + k * c.p + q] = -c.common[q]
        sum_up(c, j)
        samples[j, 2], samples[j, 3] = s.branch, s.slope
        if not m[0] < math.inf:
            for k in range(j, n):
                out[0, 0, k], samples[k, 2] = math.inf, s.branch
            return UNFIT if m[1] < 0.0 else run.NOT_FINITE + c.none
    return (run.DONE if is_finite(c, 1) else run.NOT_FINITE) + c.none
