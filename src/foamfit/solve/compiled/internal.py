"""What only springs of INTERNAL laws need: derivatives, jumps, the stress V.

The results of such a law are σ, V and the rates A, B of each internal variable, and their
derivatives, see `compiled.contract`.

The derivatives δx of internal variables need those of the strain rate. Where no state contains the
strain these are unknown, and u = δx - A δε is integrated instead, the derivatives at fixed strain:
du/dt = dε/dt (A_x u + A_p) + δB - A_x B δε.

In a group of several springs the strain rate of one with a stress V solves T + V + η dε/dt = S.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import motion
from foamfit.solve.compiled.motion import evaluate
from foamfit.solve.compiled.run import numbers, spring, working
from foamfit.solve.scene import VISCOUS
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import ALONG_A, ALONG_B, BY_RATE, inner, past
from foamfit.springs.laws.record import OWN_ETA

LEAST_RATE = 1e-25  # smaller strain rates are zero, 1/s
MOST_RATE = 1e30  # larger ones mean that V vanishes, so that no stress determines the rate
ENOUGH = 2e-15  # relative change of a rate or stress that ends Newton's method


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
def _path(c, i):
    """Fill dσ/dε along the path of the internal variables, and what their rates B add to dT/dt."""
    s, values, size = spring(c, i), spring(c, i).by, 2 + 2 * numbers(c, i).internals
    s.tangent = s.slope + values[ALONG_A * size]
    s.drift = c.drive.pace * s.gain * values[ALONG_B * size]


# ---------------------------------------------------------------- derivatives


@inner
def _part(c, i, y, part):
    """Fill the derivatives at fixed strain, by direction, and those of the stress."""
    n, p, x = numbers(c, i), c.p, numbers(c, i).internals
    if spring(c, i).lossy > 0.0:  # at the strain rate found since
        evaluate(c, i, contract.PATHS if n.fixed else 1)
    for j in range(p):
        out = toward(c, i, j)
        change, own = past(out, 2 + 2 * x), c.directions[2 * j + 1]
        for k in range(x):
            change[k] = y[c.base + (n.x_at + k) * p + j]
        direct(c, i, change, own if c.directions[2 * j] == i and 0 <= own < OWN_ETA else -1, out)
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
    """Change the branch; the internal variables may jump, and their derivatives with them.

    Their rates may jump too, so that the delay of the instant of the change counts.
    """
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
    faster = s.rate * (1.0 - end[0])  # of the strain past the end
    for k in range(x):
        faster -= end[1 + k] * (s.rate * first[k] + pace * first[x + k])
    delays = past(c.common, (c.groups + 1) * p)
    for j in range(p):
        strain, late = c.strain[i * p + j], 0.0
        own = c.directions[2 * j + 1] if c.directions[2 * j] == i else OWN_ETA
        for k in range(x + 1):  # of the end, then of the internal variables at the instant
            by = end if k == 0 else past(changes, (k - 1) * wide)
            value = by[0] * (strain + s.rate * late if k > 0 else strain)
            for m in range(x):
                d_x = y[c.base + (n.x_at + m) * p + j] + (first[m] * strain if n.fixed else 0.0)
                if k > 0:
                    d_x += (s.rate * first[m] + pace * first[x + m]) * late
                value += by[1 + m] * d_x
            if own < OWN_ETA:
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


# ---------------------------------------------------------------- the stress V in a group


@inner
def _lose(c, i, common):
    """Fill the strain rate of a damped spring under the stress of its group.

    Newton's method in logarithms inside a bracket: it takes one step for a power of the rate.
    """
    s, n = spring(c, i), numbers(c, i)
    force, s.loss = common - s.total, s.eta
    if s.lossy == 0.0:
        s.rate = force / s.eta
        return
    sign, rate, low, high = 1.0 if force > 0.0 else -1.0, abs(s.rate), 0.0, math.inf
    values = spring(c, i).by
    rate = rate if rate > 0.0 else 1.0
    for _ in range(200):
        s.rate = sign * rate if force != 0.0 else 0.0
        evaluate(c, i, 1 + c.none)
        value = sign * (values[1] + s.eta * s.rate)
        s.loss = s.eta + values[BY_RATE * (2 + 2 * n.internals)]
        if force == 0.0:  # at rest, where the derivative of a power is infinite or zero
            s.loss = math.inf
            return
        low, high = (low, rate) if value >= abs(force) else (rate, high)
        new = -1.0
        if value > 0.0 and s.loss > 0.0:
            new = rate * (abs(force) / value) ** (value / (s.loss * rate))
        if abs(new - rate) <= ENOUGH * rate:
            return
        if not low < new < high:
            new = math.sqrt(low * high) if low > 0.0 else 1e-3 * high
            if high == math.inf:
                new = 1e3 * low
        if new in (low, high):
            return
        rate = new
        if rate > MOST_RATE:
            s.rate = s.loss = math.nan
            return
        if not rate > LEAST_RATE:
            force = 0.0


@inner
def _share(c, g):
    """Fill the stress and the rates of damped springs that reach the rate of their group together.

    Of a viscous top the velocity is the unknown, as the stresses on both sides of its damper may
    hardly differ.
    """
    i0, i1 = c.first[g], c.first[g + 1]
    push, rate, low, high = c.drive.push, c.drive.spread, -math.inf, math.inf
    drag = c.drive.dragged if g == c.groups - 1 and c.top == VISCOUS else 0.0
    now = c.carried[g] if drag == 0.0 else -c.drive.top_speed
    now = now if abs(now) < math.inf else 0.0
    for _ in range(200):
        common = now if drag == 0.0 else push + drag * now
        miss, soft = -rate, 0.0
        for i in range(i0, i1):
            s = spring(c, i)
            _lose(c, i, common)
            miss += s.height * s.rate
            soft += s.height / s.loss
        if drag > 0.0:
            miss, soft = miss + now, soft * drag + 1.0
        low, high = (low, now) if miss > 0.0 else (now, high)
        new = now - miss / soft if soft > 0.0 else math.nan
        if miss == 0.0 or abs(new - now) <= ENOUGH * abs(now):
            break
        if not low < new < high:
            if low > -math.inf and high < math.inf:
                new = 0.5 * (low + high)
            else:
                new = now + (1.0 if miss < 0.0 else -1.0) * max(abs(now), 1.0)
            if new in (low, high):
                break
        now = new
    c.carried[g] = common
    if drag > 0.0:
        c.drive.top_speed = -now


@inner
def _losses(c, i, y, out):
    """Add the derivatives of V of a spring in a group, at the strain rate that it has found."""
    p, at = c.p, numbers(c, i).eps_at
    for j in range(p):
        c.strain[i * p + j] = y[c.base + at * p + j]
    _friction(c, i, past(c.common, c.groups * p), out)


@working
def inside_task(c, task, i, up, y, f, quicker, out):
    """Do one task, for a spring or a group."""
    if task == motion.PART:
        _part(c, i, y, out)
    elif task == motion.FLOW:
        _flow(c, i, f, quicker)
    elif task == motion.FRICTION:
        _friction(c, i, quicker, out)
    elif task == motion.PATH:
        _path(c, i)
    elif task == motion.LOSE:
        _lose(c, i, c.carried[up])
    elif task == motion.SHARE:
        _share(c, i)
    elif task == motion.LOSSES:
        _losses(c, i, y, out)
    else:
        _jump(c, i, up, y)
