"""The equations of motion of a chain: rates of its state, and of the derivatives of the state.

Springs without mass between them form a group, which carries one stress. Of one spring between two
nodes the strain follows from the nodes; `groups` has the other cases. A mass m accelerates by the
difference of the stresses S of the groups above and below it, A (S₊ - S₋)/m (docs/theory.md, "The
chain").
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import run
from foamfit.solve.compiled.run import FREE, MOTION, STRESS, VISCOUS, call_inside, numbers, spring
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import inlined, inner, past
from foamfit.springs.laws.record import HEAVIER, MOVED, OWN_ETA, OWN_RELAXATION

# Tasks of `internal`.
PART, FLOW, FRICTION, JUMP, PATH = range(5)
ALL, IN_STEP = -1, -2  # instead of a group
ONLY_DERIVATIVES = 2  # instead of 0 or 1 for `want`, where the values are known


# ---------------------------------------------------------------- springs


@inner
def evaluate(c, i, want):
    """Fill the results of the law of a spring at its strain and internal variables."""
    s, n = spring(c, i), numbers(c, i)
    contract.call_evaluate(n.evaluate, past(s, c.row), s, s.point, s.xs, 1, want, s.results)


@inner
def follow_spring(c, i, eps, y, f, want):
    """Fill the values of a spring at a strain, and the rates of its relaxation terms; return T."""
    s, n, known = spring(c, i), numbers(c, i), 0.0
    if n.by_stress and c.solved:
        known = contract.call_number(n.settle, past(s, c.row), s, eps)
    else:
        for k in range(n.internals):
            s.xs[k] = y[n.x_at + k]
    s.eps = eps
    if want or known == 0.0:
        evaluate(c, i, contract.PATHS if n.fixed and n.internal else want)
    sigma, tangent, drift = s.sigma, s.slope, 0.0
    if n.internal and n.fixed:
        call_inside(c, PATH, i, c.none, y, f, y, y)
        tangent, drift = s.tangent, s.drift
    stress = s.gain * sigma
    for k in range(c.terms):
        z = y[n.z_at + k]
        dz = -(z + sigma) / s.tau[k] * c.drive.pace
        f[n.z_at + k] = dz
        stress += s.g[k] * z
        drift += s.g[k] * dz
    s.total, s.drift, s.tangent = stress, drift, tangent
    return stress


@inner
def move_inside(c, i, f):
    """Fill the rates of the internal variables of a spring."""
    s, n = spring(c, i), numbers(c, i)
    if n.by_stress and not c.solved:
        f[n.x_at] = s.slope * s.rate
    elif n.internal:
        x, values = n.internals, s.by
        for k in range(x):
            f[n.x_at + k] = values[2 + k] * s.rate + c.drive.pace * values[2 + x + k]


@inner
def derive_spring(c, i, y):
    """Fill the derivatives of the stress of a spring at fixed strain, and of T at fixed strain."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    part, total = past(c.part, i * p), past(c.part, (c.count + i) * p)
    owned = past(c.owned, i * p)
    s.steep = s.tangent if n.fixed else s.slope
    for j in range(p):
        part[j] = 0.0
    if n.by_stress:
        a, b, held = s.by_held[0], s.by_held[1], past(c.held, 2 * i * p)
        for j in range(p):
            part[j] = a * held[j] + b * held[p + j]
    if n.internal:
        call_inside(c, PART, i, c.none, y, y, y, part)
    else:
        for j in range(p):
            if 0 <= owned[j] < OWN_ETA:
                part[j] += s.by[owned[j]]
    gain = s.gain
    for j in range(p):
        total[j] = gain * part[j]
    for k in range(c.terms):
        g, dz, of_g = s.g[k], past(y, c.base + (n.z_at + k) * p), OWN_RELAXATION + 2 * k
        for j in range(p):
            total[j] += g * dz[j]
            if owned[j] == of_g:
                total[j] += c.drive.pace * (s.sigma + y[n.z_at + k])


@inner
def derive_inside(c, i, y, f, quicker):
    """Fill the rates of the derivatives of relaxation terms and of internal variables."""
    # `quicker` are the derivatives of the strain rate, only for INTERNAL laws.
    s, n, p = spring(c, i), numbers(c, i), c.p
    part, strain = past(c.part, i * p), past(c.strain, i * p)
    owned, slope = past(c.owned, i * p), s.steep
    for k in range(c.terms):
        at, per = c.base + (n.z_at + k) * p, c.drive.pace / s.tau[k]
        more, of_tau = (y[n.z_at + k] + s.sigma) * per / s.tau[k], OWN_RELAXATION + 2 * k + 1
        for j in range(p):
            f[at + j] = -per * (y[at + j] + slope * strain[j] + part[j])
            if owned[j] == of_tau:
                f[at + j] += more
    if n.internal:
        call_inside(c, FLOW, i, c.none, y, f, quicker, f)


# ---------------------------------------------------------------- one spring between two nodes


@inner
def span_of(c, g, y, at):
    """Return elongation and its rate of a group, as far as its nodes tell."""
    last = g == c.groups - 1
    if last and c.top == MOTION:
        reach, rate = c.drive.value + c.drive.value_rate * at, c.drive.value_rate
    elif last and c.top == STRESS:
        reach = rate = 0.0
    else:
        reach, rate = y[2 * g], y[2 * g + 1]
        if last and c.top == VISCOUS:
            rate = 0.0
    if g > 0:
        reach, rate = reach - y[2 * g - 2], rate - y[2 * g - 1]
    return reach, rate


@inlined
def in_contact(c, k):
    """Return the derivative of sample k of a prescribed motion by its shift: 1 in contact."""
    return 1.0 if c.values[k] > 0.0 else 0.0


@inner
def span_tangents(c, g, y, reach, rate):
    """Fill the derivatives of elongation and rate of a group, as far as its nodes tell."""
    p, last = c.p, g == c.groups - 1
    for j in range(p):
        reach[j] = rate[j] = 0.0
        if last and c.top == MOTION and c.directions[2 * j + 1] == MOVED:
            reach[j], rate[j] = c.drive.shifted, c.drive.shift_rate
    if not last or c.top == FREE or c.top == VISCOUS:
        dw = past(y, c.base + 2 * g * p)
        for j in range(p):
            reach[j] = dw[j]
        if not last or c.top == FREE:
            for j in range(p):
                rate[j] = dw[p + j]
    if g > 0:
        dw = past(y, c.base + 2 * (g - 1) * p)
        for j in range(p):
            reach[j] -= dw[j]
            rate[j] -= dw[p + j]


@inner
def _follow_one(c, g, i, y, f, want, at):
    """Fill the values of a spring between two nodes, and their part of the rates; return S."""
    s, n = spring(c, i), numbers(c, i)
    reach, rate = span_of(c, g, y, at)
    s.rate = rate = rate * s.per_height
    common = follow_spring(c, i, reach * s.per_height, y, f, want) + s.eta * rate
    move_inside(c, i, f)
    if n.internal:
        common += c.drive.pace * s.by[1]
    c.carried[g] = common
    return common


@inner
def _derive_one(c, g, i, y, f):
    """Fill the derivatives of the stress of a spring between two nodes, and of its rates."""
    p = c.p
    out = past(c.common, g * p)
    reach, rate = past(c.common, (c.groups + 1) * p), past(c.common, (c.groups + 2) * p)
    span_tangents(c, g, y, reach, rate)
    derive_spring(c, i, y)
    s, own, strain = spring(c, i), past(c.own, 2 * i * p), past(c.strain, i * p)
    per, eta, total = s.per_height, s.eta, past(c.part, (c.count + i) * p)
    slope, eps, faster = s.slope * s.gain, s.eps, s.rate
    for j in range(p):
        strain[j] = (reach[j] - eps * own[j]) * per
        rate[j] = (rate[j] - faster * own[j]) * per
        out[j] = slope * strain[j] + total[j] + own[p + j] * faster + eta * rate[j]
    derive_inside(c, i, y, f, rate)
    if numbers(c, i).internal:
        call_inside(c, FRICTION, i, c.none, y, f, rate, out)


# ---------------------------------------------------------------- the chain


@inner
def _accelerate(c, g, y, f, want, at):
    """Fill the rates of a node, and of their derivatives."""
    p, last = c.p, g == c.groups - 1
    v, per, drag = y[2 * g + 1], c.per_mass[g] * c.drive.pace, 0.0
    if last:
        drag = c.drive.dragged
        force = c.drive.value + c.drive.value_rate * at - c.carried[g] - drag * v
    else:
        force = c.carried[g + 1] - c.carried[g]
    f[2 * g], f[2 * g + 1] = v, force * per
    if not want:
        return
    dv, df = past(y, c.base + (2 * g + 1) * p), past(f, c.base + 2 * g * p)
    here, above = past(c.common, g * p), past(c.common, (g + 1) * p)  # zeros above the last
    for j in range(p):
        df[j] = dv[j]
        df[p + j] = (above[j] - here[j] - drag * dv[j]) * per
    if last:
        of_drag = past(c.own, 2 * c.count * p)
        for j in range(p):
            df[p + j] -= of_drag[j] * v * per
            if c.directions[2 * j + 1] == HEAVIER:
                df[p + j] += (c.drive.gravity - f[2 * g + 1]) * per


@inner
def dense(c, n, x, out):
    """Fill the state at the share x of the step."""
    z, line, wide, y = 1.0 - x, c.line, c.wide, c.y
    if c.degree:
        for i in range(n):
            value = 0.0
            for q in range(c.degree - 1, -1, -1):
                value = (value + line[q * wide + i]) * x
            out[i] = y[i] + value
        return
    for i in range(n):
        value = line[4 * wide + i] + z * (line[5 * wide + i] + x * line[6 * wide + i])
        value = line[2 * wide + i] + z * (line[3 * wide + i] + x * value)
        out[i] = y[i] + x * (line[i] + z * (line[wide + i] + x * value))


@inner
def _stress_of_momentum(c, x):
    """Return the stress from the acceleration of the striker by an implicit step."""
    # At the end of an overdamped contact the sum of spring and dashpot has lost its digits.
    line, wide, rate = c.line, c.wide, 0.0
    for q in range(c.degree - 1, -1, -1):
        rate = rate * x + (q + 1) * line[q * wide + 1]
    return c.drive.value - c.drive.dragged * c.state[1] - rate / c.now.step / c.per_mass[0]


@run.computing
def compute_rates(c, y, f, want, at, only):
    """Fill the rates f of a state y, or only the values of one group, or those in a step."""
    share = at
    if only == IN_STEP and share == c.now.seen:
        return
    c.now.seen = share if only == IN_STEP else math.inf
    if only == IN_STEP:
        dense(c, c.base, share, y)
        at = c.now.now + share * c.now.step
    c.drive.shifted = c.drive.shift + c.drive.shift_rate * at
    for g in range(c.groups):
        if only >= 0 and g != only:
            continue
        i, several = c.first[g], c.first[g + 1] - c.first[g] > 1
        massless = g == c.groups - 1 and (c.top == STRESS or c.top == VISCOUS)
        if not several and not massless:  # its strain follows from its nodes
            if want != ONLY_DERIVATIVES:
                _follow_one(c, g, i, y, f, want, at)
            if want:
                _derive_one(c, g, i, y, f)
        else:
            run.call_group(c, g, y, f, want, at)
    if only >= 0:
        return
    for g in range(c.nodes):
        if g == c.groups - 1 and c.top == VISCOUS:
            f[2 * g], f[2 * g + 1] = c.drive.top_speed, 0.0
        else:
            _accelerate(c, g, y, f, want, at)
    if only == IN_STEP and c.drive.overdamped > 0.0 and c.groups == 1:
        c.carried[0] = _stress_of_momentum(c, share)


@inlined
def rates(c, y, f, want, at):
    """Fill the rates f of a state y (with derivatives if `want`), `at` a time since the piece."""
    run.call_rates(c, y, f, want, at, ALL)


@inlined
def rates_of(c, g, y, f, want, at):
    """Fill the values of one group, as `rates` does."""
    run.call_rates(c, y, f, want, at, g)


@inlined
def look(c, x):
    """Fill the values of all springs at the share x of the step."""
    run.call_rates(c, c.state, c.f, 0, x, IN_STEP)
