"""What only springs of INTERNAL laws need: derivatives, jumps, the stress V, decay.

The results of such a law are σ, V and the rates A, B of each internal variable, and their
derivatives, see `compiled.contract`.

The derivatives δx of internal variables need those of the strain rate. Where no state contains the
strain these are unknown, and u = δx - A δε is integrated instead, the derivatives at fixed strain:
du/dt = dε/dt (A_x u + A_p) + δB - A_x B δε. A spring with a stress V is the only one between two
nodes.

Of one spring in a known motion, internal variables that decay are as exact as relaxation terms:
where dx/dt = L x + N and N depends on the strain alone, x is integrated exactly for the quartic
through N at both ends and the middle of a step and its slopes at the ends (see `along`), however
fast it decays. Whether N depends on x is seen when it is computed again.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import along, motion
from foamfit.solve.compiled.along import TABLE, derive, integral, quartic, tabulate
from foamfit.solve.compiled.motion import evaluate
from foamfit.solve.compiled.run import fading, numbers, spring, working
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import ALONG_A, ALONG_B, BY_RATE, PATHS, inner, past
from foamfit.springs.laws.record import OWN_ETA

DEPENDS = 1e-9  # relative change of N that is not rounding
# Rows of memory, of one number per internal variable: L; x, N and dN/dr at the start; N and dN/dr
# at the end; N and x in the middle; x at the end; the largest |x| and |N|. Then the tables of a
# whole and of half a step, and derivatives: of x and N at the start, of N in the middle and at the
# end.
RATE, FIRST_X, FIRST, LOW, LAST, HIGH, MIDDLE, HALF_X, LAST_X, LARGEST, SIZE, TABLES = range(12)
DERIVATIVES = TABLES + 2 * TABLE


@contract.inlined
def toward(c, i, j):
    """Return the derivatives of σ, V, A and B at fixed strain in a direction, and its dx."""
    n, x = numbers(c, i), numbers(c, i).internals
    changes = contract.changes_of(spring(c, i).by, x)
    return past(changes, (x + 1) * (1 + x + n.parameters) + j * (2 + 3 * x))


@inner
def direct(c, i, change, own, out):
    """Fill the derivatives of σ, V, A and B by dx and, unless negative, parameter `own`."""
    s, law, want = spring(c, i), numbers(c, i).evaluate, contract.DIRECTION
    contract.call_evaluate(law, past(s, c.row), s, s.point, change, own, want, out)


@inner
def _part(c, i, y, part):
    """Fill the derivatives at fixed strain, by direction, and those of the stress."""
    n, p, x = numbers(c, i), c.p, numbers(c, i).internals
    for j in range(p):
        out = toward(c, i, j)
        change, own = past(out, 2 + 2 * x), c.owned[i * p + j]
        for k in range(x):
            change[k] = y[c.base + (n.x_at + k) * p + j]
        direct(c, i, change, own if own < OWN_ETA else -1, out)
        part[j] = out[0]


@inner
def _flow(c, i, f, quicker):
    """Fill the rates of the derivatives of the internal variables."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    x, values, strain = n.internals, spring(c, i).by, past(c.strain, i * p)
    size, rate, pace, fixed = 2 + 2 * x, s.rate, c.drive.pace, n.fixed
    by, by_a, by_b = past(values, size), past(values, ALONG_A * size), past(values, ALONG_B * size)
    for k in range(x):
        a, b = 2 + k, 2 + x + k
        at, by_strain = c.base + (n.x_at + k) * p, pace * by[b]
        if fixed:
            by_strain += pace * (by_a[b] - by_b[a])
        else:
            by_strain += rate * by[a]
        for j in range(p):
            out = toward(c, i, j)
            f[at + j] = by_strain * strain[j] + rate * out[a] + pace * out[b]
            if not fixed:
                f[at + j] += values[a] * quicker[j]


@inner
def _friction(c, i, quicker, out):
    """Add the derivatives of the stress V."""
    values, size, p = spring(c, i).by, 2 + 2 * numbers(c, i).internals, c.p
    strain, by_strain, by_rate = past(c.strain, i * p), values[size + 1], values[BY_RATE * size]
    for j in range(p):
        by_x = toward(c, i, j)[1]
        out[j] += c.drive.pace * (by_strain * strain[j] + by_rate * quicker[j] + by_x)


@inner
def _jump(c, i, up, y):
    """Change the branch; the internal variables may jump, and their derivatives with them."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    x, pace = n.internals, c.drive.pace
    changes, first = contract.changes_of(spring(c, i).by, x), past(spring(c, i).by, 2)  # A, then B
    for k in range(x):
        s.xs[k] = y[n.x_at + k]
    contract.call_switch(n.switch, past(s, c.row), s, up, changes)
    for k in range(x):
        y[n.x_at + k] = s.xs[k]
    if p == 0:
        return
    wide = 1 + x + n.parameters
    end, out = past(changes, x * wide), past(changes, (x + 1) * wide)
    # Rates may jump too, so that the delay of the instant of the change counts.
    faster = s.rate * (1.0 - end[0])  # of the strain past the end
    for k in range(x):
        faster -= end[1 + k] * (s.rate * first[k] + pace * first[x + k])
    delays = past(c.common, (c.groups + 1) * p)
    for j in range(p):
        strain, late = c.strain[i * p + j], 0.0
        own = c.owned[i * p + j]
        for k in range(x + 1):  # of the end, then of the internal variables at the instant
            by = end if k == 0 else past(changes, (k - 1) * wide)
            value = by[0] * (strain + s.rate * late if k > 0 else strain)
            for m in range(x):
                d_x = y[c.base + (n.x_at + m) * p + j] + (first[m] * strain if n.fixed else 0.0)
                if k > 0:
                    d_x += (s.rate * first[m] + pace * first[x + m]) * late
                value += by[1 + m] * d_x
            if 0 <= own < OWN_ETA:
                value += by[1 + x + own]
            if k == 0:
                late = (value - strain) / faster if faster != 0.0 else 0.0
            else:
                out[k - 1] = value
        delays[j] = late
        for k in range(x):
            y[c.base + (n.x_at + k) * p + j] = out[k]
    evaluate(c, i, c.none)  # on the next branch
    for j in range(p):
        strain = c.strain[i * p + j] if n.fixed else 0.0
        for k in range(x):
            moved = first[k] * (strain + s.rate * delays[j]) + pace * first[x + k] * delays[j]
            y[c.base + (n.x_at + k) * p + j] -= moved


@working
def inside_task(c, task, i, up, y, f, quicker, out):
    """Do one task for a spring."""
    if task == motion.PART:
        _part(c, i, y, out)
    elif task == motion.FLOW:
        _flow(c, i, f, quicker)
    elif task == motion.FRICTION:
        _friction(c, i, quicker, out)
    elif task == motion.PATH:
        # dσ/dε along the path of the internal variables, and what their rates B add to dT/dt
        s, values, size = spring(c, i), spring(c, i).by, 2 + 2 * numbers(c, i).internals
        s.tangent = s.slope + values[ALONG_A * size]
        s.drift = c.drive.pace * s.gain * values[ALONG_B * size]
    else:
        _jump(c, i, up, y)


# ---------------------------------------------------------------- one spring in a known motion


@inner
def _begin(c):
    """Fill L, the derivatives of the rates of all internal variables by themselves."""
    x, m = c.numbers.internals, c.aside
    unit, out = past(m, x * FIRST_X), past(m, x * TABLES)
    for k in range(x):
        unit[k] = 1.0
        direct(c, c.none, unit, -1 + c.none, out)
        m[x * RATE + k], unit[k] = out[2 + x + k], 0.0


@inner
def _force(c, step, to):
    """Fill N and dN/dr at a point."""
    s, x, m, values = c.springs, c.numbers.internals, c.aside, c.springs.by
    for k in range(x):
        m[x * to + k] = values[2 + x + k] - m[x * RATE + k] * s.xs[k]
        m[x * (to + 1) + k] = values[4 + 3 * x + k] * step
        m[x * SIZE + k] = max(m[x * SIZE + k], abs(m[x * to + k]))


@inner
def _is_other(c, to):
    """Whether N is not what it was with other internal variables."""
    s, x, m, values = c.springs, c.numbers.internals, c.aside, c.springs.by
    for k in range(x):
        part = m[x * RATE + k] * s.xs[k]
        miss = abs(values[2 + x + k] - part - m[x * to + k])
        if not miss <= DEPENDS * (m[x * SIZE + k] + abs(part)):
            return True
    return False


@inner
def _put(c, eps, at, want):
    """Bring the spring to a strain and internal variables."""
    s, n, x = c.springs, c.numbers, c.numbers.internals
    s.eps = eps
    for k in range(x):
        s.xs[k] = c.y[n.x_at + k] = c.aside[x * at + k]
    evaluate(c, c.none, want)


@inner
def _slope(c, step, h):
    """Return dσ/dr at a point evaluated with `want` = PATHS."""
    size = 2 + 2 * c.numbers.internals
    return c.springs.slope * step + c.springs.by[ALONG_B * size] * h


@inner
def _respond(c, h, tol):
    """Fill the internal variables in the middle and at the end; false if a step is too long."""
    x, m, fine = c.numbers.internals, c.aside, True
    for k in range(x):
        if not m[x * RATE + k] <= 0.0:
            return False
        table, half = past(m, x * TABLES + 2 * k * TABLE), past(m, x * TABLES + (2 * k + 1) * TABLE)
        fade = -m[x * RATE + k] * h
        tabulate(fade, h, table)
        tabulate(0.5 * fade, 0.5 * h, half)
        first, low = m[x * FIRST + k], m[x * LOW + k]
        square, cube, fourth, bump = quartic(
            first, m[x * MIDDLE + k], m[x * LAST + k], low, m[x * HIGH + k]
        )
        whole = integral(table, first, low, square, cube, fourth)
        part = integral(half, first, 0.5 * low, 0.25 * square, 0.125 * cube, 0.0625 * fourth)
        before = m[x * FIRST_X + k]
        m[x * HALF_X + k] = math.exp(-0.5 * fade) * before + 0.5 * h * part
        m[x * LAST_X + k] = math.exp(-fade) * before + h * whole
        size = max(m[x * LARGEST + k], abs(m[x * LAST_X + k]))
        fine = fine and not along.FOLLOWED * h * table[0] * abs(bump) > tol * size
        if fine:
            m[x * LARGEST + k] = size
    return fine


# ---------------------------------------------------------------- derivatives


@inner
def _change(c, seed, to):
    """Fill the derivatives of N at a point, `to` 1 (start), 2 (middle) or 3 (end)."""
    x, m, p, values = c.numbers.internals, c.aside, c.p, c.springs.by
    derive(c, seed)
    rows = past(m, x * DERIVATIVES)
    for j in range(p):
        out, strain = toward(c, c.none, j), c.strain[j]
        for k in range(x):
            own = out[2 + x + k] - m[x * RATE + k] * out[2 + 2 * x + k]
            rows[(to * x + k) * p + j] = own + values[4 + 3 * x + k] * strain


@inner
def _move(c, h, whole):
    """Fill the derivatives of the internal variables at the end of a step, or in its middle."""
    x, m, p, n = c.numbers.internals, c.aside, c.p, c.numbers
    rows, long = past(m, x * DERIVATIVES), 1.0 if whole else 0.5
    for k in range(x):
        a = past(m, x * TABLES + (2 * k + 1 - whole) * TABLE)
        decay, dx = math.exp(m[x * RATE + k] * h * long), past(c.y, c.base + (n.x_at + k) * p)
        for j in range(p):
            first, middle, last = (
                rows[(x + k) * p + j], rows[(2 * x + k) * p + j], rows[(3 * x + k) * p + j],
            )  # fmt: skip
            low, square = 4.0 * middle - 3.0 * first - last, 2.0 * (first + last) - 4.0 * middle
            step = first * a[0] + long * (low * a[1] + long * square * a[2])
            dx[j] = decay * rows[k * p + j] + h * long * step


@inner
def _keep(c, seed, h):
    """Keep the start of a step, or return to it if h is negative."""
    x, m, p, y, n = c.numbers.internals, c.aside, c.p, c.y, c.numbers
    rows, mine = past(m, x * DERIVATIVES), c.base + n.x_at * p
    for k in range(x * p):
        if h < 0.0:
            y[mine + k] = rows[k]
        else:
            rows[k] = y[mine + k]
    for k in range(x if h >= 0.0 else c.none):
        m[x * FIRST_X + k] = c.springs.xs[k]
    if h >= 0.0 and p > 0:
        _change(c, seed, 1)


@fading
def fade(c, part, h, tol, seed, room):
    """Step to a strain within h; begin a run if h is zero, go back a step if it is negative.

    `room` becomes the stress in the middle of the step, its slopes at both ends, and its
    derivatives in the middle.
    """
    s, want = c.springs, PATHS if c.terms > 0 else c.none
    if h == 0.0:
        _begin(c)
        return along.SAME + c.none
    if h < 0.0:
        _keep(c, seed, h)
        _put(c, part, FIRST_X, want)
        derive(c, seed)
        return along.SAME + c.none
    origin, step = s.eps, part - s.eps
    evaluate(c, c.none, want)
    room[1] = _slope(c, step, h)
    _keep(c, seed, h)
    _force(c, step, FIRST)
    _put(c, origin + 0.5 * step, FIRST_X, c.none)
    _force(c, step, MIDDLE)
    _put(c, part, FIRST_X, c.none)
    _force(c, step, LAST)
    if not _respond(c, h, tol):
        _put(c, origin, FIRST_X, want)
        derive(c, seed)
        return along.TOO_LONG + c.none
    if c.p > 0:
        _put(c, part, LAST_X, c.none)
        _change(c, seed, 3)
    _put(c, origin + 0.5 * step, HALF_X, c.none)
    room[0], other = s.sigma, _is_other(c, MIDDLE)
    if c.p > 0:
        _change(c, seed, 2)
        _move(c, h, c.none)
        derive(c, seed)
        for j in range(c.p):
            room[3 + j] = c.common[j]
    _put(c, part, LAST_X, want)
    if other or _is_other(c, LAST):
        return along.UNFIT + c.none
    _move(c, h, 1 + c.none)
    derive(c, seed)
    room[2] = _slope(c, step, h)
    return along.SAME + c.none
