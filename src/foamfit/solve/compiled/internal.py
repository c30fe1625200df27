"""What only springs of INTERNAL laws need: derivatives, jumps, the stress V, starts of drives.

The results of such a law, from BY + parameters on, are σ, V and the rates A, B of each internal
variable; then their derivatives by ε, dε/dt, each internal variable and each parameter.

The derivatives δx of internal variables need those of the strain rate. Where no state contains the
strain these are unknown, and u = δx - A δε is integrated instead, the derivatives at fixed strain:
du/dt = dε/dt (A_x u + A_p) + δB - A_x B δε.

In a group of several springs the strain rate of one with a stress V solves T + V + η dε/dt = S.

A drive whose first sample is not zero takes internal variables there on a ramp, while time stands
still: B, V, dashpots and relaxation terms do nothing, and nodes rest.
"""

from __future__ import annotations

import math

from numba import cfunc

from foamfit.solve.compiled.motion import (
    BEGIN_RAMP,
    END_RAMP,
    FLOW,
    FRICTION,
    INSIDE,
    LOSE,
    LOSSES,
    PART,
    PATH,
    SHARE,
    evaluate,
    rates,
)
from foamfit.solve.compiled.run import numbers, spring, unpack
from foamfit.solve.scene import MOTION, VISCOUS
from foamfit.springs.compiled.contract import (
    BY,
    INTERNAL,
    OPTIONS,
    RELAX,
    RESULTS,
    X,
    call_switch,
    inner,
    past,
)
from foamfit.springs.laws.record import OWN_ETA

LEAST_RATE = 1e-25  # smaller strain rates are zero, 1/s
ENOUGH = 2e-15  # relative change of a rate or stress that ends Newton's method
RAMP = 1e-9  # time of a ramp to the first sample over the duration


@inner
def _path(c, i):  # type: ignore[no-untyped-def]
    """Fill dσ/dε along the path of the internal variables, and what their rates B add to dT/dt."""
    s, n = spring(c, i), numbers(c, i)
    x, values = n.internals, past(s, RESULTS + BY + n.parameters)
    size, tangent, drift = 2 + 2 * x, s.slope, 0.0
    for k in range(x):
        by_x = values[size + (2 + k) * size]
        tangent += by_x * values[2 + k]
        drift += c.drive.pace * s.gain * by_x * values[2 + x + k]
    s.tangent, s.drift = tangent, drift


# ---------------------------------------------------------------- derivatives


@inner
def _part(c, i, y, part):  # type: ignore[no-untyped-def]
    """Add the derivatives of the stress through the internal variables."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    size = 2 + 2 * n.internals
    for k in range(n.internals):
        by_x = s[RESULTS + BY + n.parameters + size + (2 + k) * size]
        d_x = past(y, c.base + (n.x_at + k) * p)
        for j in range(p):
            part[j] += by_x * d_x[j]


@inner
def _flow(c, i, y, f, quicker):  # type: ignore[no-untyped-def]
    """Fill the rates of the derivatives of the internal variables."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    x, values, strain = n.internals, past(s, RESULTS + BY + n.parameters), past(c.strain, i * p)
    size, rate, pace, fixed = 2 + 2 * x, s.rate, c.drive.pace, n.fixed
    by = past(values, size)
    for k in range(x):
        a, b = 2 + k, 2 + x + k
        at, by_strain = c.base + (n.x_at + k) * p, pace * by[b]
        if fixed:
            for m in range(x):
                column = past(by, (2 + m) * size)
                by_strain += pace * (column[b] * values[2 + m] - column[a] * values[2 + x + m])
        else:
            by_strain += rate * by[a]
        for j in range(p):
            f[at + j] = by_strain * strain[j] + (0.0 if fixed else values[a] * quicker[j])
        for m in range(x):
            column, d_x = past(by, (2 + m) * size), past(y, c.base + (n.x_at + m) * p)
            for j in range(p):
                f[at + j] += (rate * column[a] + pace * column[b]) * d_x[j]
        for m in range(c.owned[i], c.owned[i + 1]):
            j = c.owned[m]
            column = past(by, (2 + x + c.directions[2 * j + 1]) * size)
            f[at + j] += rate * column[a] + pace * column[b]


@inner
def _friction(c, i, y, quicker, out):  # type: ignore[no-untyped-def]
    """Add the derivatives of the stress V."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    strain, size, pace = past(c.strain, i * p), 2 + 2 * n.internals, c.drive.pace
    by = past(s, RESULTS + BY + n.parameters + size)
    for j in range(p):
        out[j] += pace * (by[1] * strain[j] + by[size + 1] * quicker[j])
    for k in range(n.internals):
        d_x = past(y, c.base + (n.x_at + k) * p)
        for j in range(p):
            out[j] += pace * by[(2 + k) * size + 1] * d_x[j]
    for m in range(c.owned[i], c.owned[i + 1]):
        j = c.owned[m]
        out[j] += pace * by[(2 + n.internals + c.directions[2 * j + 1]) * size + 1]


@inner
def _jump(c, i, up, y):  # type: ignore[no-untyped-def]
    """Change the branch; the internal variables may jump, and their derivatives with them.

    Their rates may jump too, so that the delay of the instant of the change counts.
    """
    s, n, p = spring(c, i), numbers(c, i), c.p
    x, pace = n.internals, c.drive.pace
    changes = past(s, RESULTS + BY + n.parameters + 2 + 2 * x)  # instead of derivatives
    for k in range(x):
        s[X + k] = y[n.x_at + k]
    call_switch(n.switch, past(s, c.row), s, up, changes)
    for k in range(x):
        y[n.x_at + k] = s[X + k]
    if p == 0:
        return
    wide, first = 1 + x + n.parameters, past(s, RESULTS + BY + n.parameters + 2)  # A, then B
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
def _lose(c, i, common):  # type: ignore[no-untyped-def]
    """Fill the strain rate of a damped spring under the stress of its group.

    Newton's method in logarithms inside a bracket: it takes one step for a power of the rate.
    """
    s, n = spring(c, i), numbers(c, i)
    force, s.loss = common - s.total, s.eta
    if s.lossy == 0.0:
        s.rate = force / s.eta
        return
    sign, rate, low, high = 1.0 if force > 0.0 else -1.0, abs(s.rate), 0.0, math.inf
    values = past(s, RESULTS + BY + n.parameters)
    rate = rate if rate > 0.0 else 1.0
    for _ in range(200):
        s.rate = sign * rate if force != 0.0 else 0.0
        evaluate(c, i, 2 + c.none)
        value = sign * (values[1] + s.eta * s.rate)
        s.loss = s.eta + values[2 * (2 + 2 * n.internals) + 1]
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
        if not rate > LEAST_RATE:
            force = 0.0


@inner
def _share(c, g):  # type: ignore[no-untyped-def]
    """Fill the stress and the rates of damped springs that reach the rate of their group together.

    Of a viscous top the velocity is the unknown, as the stresses on both sides of its damper may
    hardly differ.
    """
    i0, i1 = (c.ends[g - 1] if g > 0 else 0), c.ends[g]
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
def _losses(c, i, y, out):  # type: ignore[no-untyped-def]
    """Add the derivatives of V of a spring in a group, at the strain rate that it has found."""
    p, at = c.p, numbers(c, i).eps_at
    for j in range(p):
        c.strain[i * p + j] = y[c.base + at * p + j]
    evaluate(c, i, 1 + c.none)
    _friction(c, i, y, past(c.common, c.groups * p), out)


# ---------------------------------------------------------------- the start of a drive


@inner
def _begin_ramp(c, want):  # type: ignore[no-untyped-def]
    """Begin a ramp to the first sample of a drive. Under a prescribed stress dashpots are rigid."""
    r, drive, t, terms = c.now, c.drive, c.time, c.terms
    brief = RAMP * (t[c.samples - 1] - t[0]) if c.samples > 1 else RAMP
    r.now, r.begun, r.horizon, r.piece = 0.0, t[0] - brief, brief, -1.0
    aside, masses = c.aside, past(c.aside, c.count * (1 + terms))
    for g in range(c.groups):
        masses[g], c.per_mass[g] = c.per_mass[g], 0.0
    masses[c.groups] = drive.pace
    drive.value, drive.value_rate, drive.pace = 0.0, c.values[0] / brief, 0.0
    for i in range(c.ends[c.groups - 2] if c.groups > 1 else c.none, c.count):
        s, n = spring(c, i), numbers(c, i)
        kept = past(aside, i * (1 + terms))
        kept[0], s.gain = s.eta, 1.0
        if s.eta > 0.0:
            s.eta = s.loss = 0.0 if c.top == MOTION else math.inf
            n.fixed = int(c.top == MOTION and n.eps_at >= 0)
        for k in range(terms):
            kept[1 + k], s[RELAX + 2 * k] = s[RELAX + 2 * k], 0.0
    rates(c, c.y, c.stage, want, 0.0)


@inner
def _end_ramp(c, want):  # type: ignore[no-untyped-def]
    """Let time pass again: relaxation terms begin at zero, and dashpots at the present strain."""
    y, p, terms = c.y, c.p, c.terms
    aside, masses = c.aside, past(c.aside, c.count * (1 + terms))
    rates(c, y, c.stage, want, c.now.now)
    c.drive.pace, c.now.grow = masses[c.groups], 1.0
    for g in range(c.groups):
        c.per_mass[g] = masses[g]
    for i in range(c.ends[c.groups - 2] if c.groups > 1 else c.none, c.count):
        s, n = spring(c, i), numbers(c, i)
        kept = past(aside, i * (1 + terms))
        strain, part = past(c.strain, i * p), past(c.part, i * p)
        for k in range(terms):
            s[RELAX + 2 * k] = kept[1 + k]
            s.gain += kept[1 + k]
            y[n.z_at + k] = -s.sigma
            for j in range(p):
                y[c.base + (n.z_at + k) * p + j] = -(s.steep * strain[j] + part[j])
        if kept[0] == 0.0:
            continue
        s.eta = s.loss = kept[0]
        if n.eps_at >= 0 and c.top == MOTION:
            y[n.eps_at] = s.eps
            for j in range(p):
                y[c.base + n.eps_at * p + j] = strain[j]
        if n.fixed:
            first, n.fixed = past(s, RESULTS + BY + n.parameters + 2), 0
            for k in range(n.internals if n.kind == INTERNAL else c.none):
                for j in range(p):
                    y[c.base + (n.x_at + k) * p + j] += first[k] * strain[j]


@cfunc(INSIDE, **OPTIONS, cache=True)
def _inside(words, task, i, up, y, f, quicker, out):  # type: ignore[no-untyped-def]
    """Do one task, for a spring or a group."""
    c = unpack(words)
    if task == PART:
        _part(c, i, y, out)
    elif task == FLOW:
        _flow(c, i, y, f, quicker)
    elif task == FRICTION:
        _friction(c, i, y, quicker, out)
    elif task == PATH:
        _path(c, i)
    elif task == LOSE:
        _lose(c, i, c.carried[up])
    elif task == SHARE:
        _share(c, i)
    elif task == LOSSES:
        _losses(c, i, y, out)
    elif task == BEGIN_RAMP:
        _begin_ramp(c, up)
    elif task == END_RAMP:
        _end_ramp(c, up)
    else:
        _jump(c, i, up, y)


INSIDE_AT = _inside.address
