"""Groups of several springs between two nodes, or under a top without mass: one stress S.

- Several springs with dashpots: S = (Δv + Σ h T/η)/(Σ h/η), dε/dt = (S - T)/η.
- Some without: S is their T; they share the rest of the elongation by their compliances; a spring
  on a flat branch takes all of it.

A zero-mass node therefore needs no equation to be solved. If a stress is prescribed on a top
without mass, it is S of the last group; an onsite damper then moves the top with v = (push - S)/D.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import motion
from foamfit.solve.compiled.run import grouping, numbers, spring
from foamfit.solve.compiled.static import elongation_at, root
from foamfit.solve.scene import STRESS, VISCOUS
from foamfit.springs.compiled.contract import inner, past

MOVES = 1e-9  # relative difference of stresses that is more than rounding


@inner
def _follow(c, g, y, f, want, at):
    """Fill the values of the springs of a group and their part of the rates `f`."""
    i0, i1 = c.first[g], c.first[g + 1]
    reach, rate = motion.span_of(c, g, y, at)
    last = g == c.groups - 1
    push = c.drive.value + c.drive.value_rate * at
    weight, total, pull, loose, flat = 0.0, rate, -rate, -1, -1
    if c.solved:
        solve_loose(c, g, i0, i1, reach, push, y)
    for i in range(i0, i1):
        s, n = spring(c, i), numbers(c, i)
        eps = y[n.eps_at] if s.eta > 0.0 or not c.solved else s.eps
        h, eta, stress = s.height, s.eta, motion.follow_spring(c, i, eps, y, f, want)
        if eta > 0.0:
            weight += h / eta
            total += h / eta * stress
            pull += h / eta * (push - stress)
        else:
            loose = i
            if s.tangent == 0.0:
                flat = i
    if last and c.top == STRESS:
        common = push
    elif loose >= 0:
        common = spring(c, loose if flat < 0 else flat).total
    elif last and c.top == VISCOUS:  # without the difference of S and push, which may be tiny
        common = push - c.drive.dragged * pull / (c.drive.dragged * weight + 1.0)
    else:
        common = total / weight
    if last and c.top == VISCOUS:
        drag = c.drive.dragged
        alone = pull / (drag * weight + 1.0)
        c.drive.top_speed = alone if loose < 0 else (push - common) / drag
        rate += c.drive.top_speed
    c.carried[g] = common
    share_rate(c, g, i0, i1, rate, loose, flat, last and c.top == STRESS)
    for i in range(i0, i1):
        s = spring(c, i)
        if s.eta > 0.0 or not c.solved:
            f[numbers(c, i).eps_at] = s.rate
        motion.move_inside(c, i, f)


@inner
def solve_loose(c, g, i0, i1, reach, push, y):
    """Fill the strains of the springs without a dashpot on their branches."""
    flat, rest, some = -1, reach, False
    common = c.carried[g] if abs(c.carried[g]) < math.inf else 0.0  # after a trial that failed
    for i in range(i0, i1):
        s, n = spring(c, i), numbers(c, i)
        s.offset = 0.0
        for k in range(c.terms):
            s.offset += s.g[k] * y[n.z_at + k]
        if s.eta > 0.0:
            rest -= s.height * y[n.eps_at]
            continue
        some = True
        if n.internal:
            for k in range(n.internals):
                s.xs[k] = y[n.x_at + k]
        if s.sigma_low == s.sigma_high:
            flat = i
    if not some:
        return
    pushed = g == c.groups - 1 and c.top == STRESS
    if not pushed and flat < 0:
        root(c, i0, i1, rest, common, -math.inf, math.inf, 0, 1)
        return
    s = spring(c, max(flat, i0))
    eps, common = s.eps, push if pushed else s.gain * s.sigma_high + s.offset
    total, _, _ = elongation_at(c, i0, i1, common, 1)
    if flat >= 0:
        s.eps = eps if pushed else s.eps + (rest - total) / s.height


@inner
def _close(c, i0, i1, rest):
    """Give what rounding leaves of the rate of elongation to the spring with the lightest dashpot.

    Rounding errors of S - T over a light dashpot would change the elongation, and nothing resists.
    """
    least, where = math.inf, i0
    for i in range(i0, i1):
        s = spring(c, i)
        if s.eta < least * s.height:
            least, where = s.eta / s.height, i
    s = spring(c, where)
    s.rate += rest / s.height


@inner
def share_rate(c, g, i0, i1, rate, loose, flat, pushed):
    """Fill the strain rates of a group of several springs; `pushed`: its stress is prescribed."""
    soft, rest, climb, common = 0.0, rate, c.drive.value_rate, c.carried[g]
    for i in range(i0, i1):
        s = spring(c, i)
        if s.eta > 0.0:
            s.rate = (common - s.total) / s.eta
            rest -= s.height * s.rate
        elif flat < 0:
            compliance = s.height / (s.gain * s.tangent)
            soft += compliance
            rest += compliance * s.drift
    if loose < 0:
        if not pushed:
            _close(c, i0, i1, rest)
        return
    if not pushed and flat < 0:
        climb = rest / soft
    elif not pushed:
        climb = spring(c, flat).drift
    if pushed:  # the last values of a step decide: those of a trial may be anywhere
        c.drive.flat = 0.0
        if flat >= 0:  # it stands at its own stress, like an open gap under none
            off, most = abs(common - spring(c, flat).total), max(abs(common), c.now.largest)
            c.drive.flat = 1.0 if off > MOVES * most else 0.0
    for i in range(i0, i1):
        s = spring(c, i)
        if s.eta == 0.0 and i != flat:
            slope = s.gain * s.tangent
            s.rate = (climb - s.drift) / slope if slope > 0.0 else 0.0
            rest -= s.height * s.rate if flat >= 0 else 0.0
    if flat >= 0:
        spring(c, flat).rate = 0.0 if pushed else rest / spring(c, flat).height


# ---------------------------------------------------------------- derivatives


@inner
def derive_group(c, g, y, f):
    """Fill the derivatives of the stress of a group, and of the rates of its springs."""
    i0, i1, p = c.first[g], c.first[g + 1], c.p
    out = past(c.common, g * p)
    reach, rate = past(c.common, (c.groups + 1) * p), past(c.common, (c.groups + 2) * p)
    motion.span_tangents(c, g, y, reach, rate)
    loose, soft, weight, flat = -1, 0.0, 0.0, -1
    last = g == c.groups - 1
    for i in range(i0, i1):
        s = spring(c, i)
        if s.eta > 0.0:
            weight += s.height / s.eta
            continue
        loose = i
        if s.tangent == 0.0:
            flat = i
        else:
            soft += s.height / (s.gain * s.tangent)
    for i in range(i0, i1):  # of damped springs `total` becomes the whole derivative
        motion.derive_spring(c, i, y)
        s, own, total = spring(c, i), past(c.own, 2 * i * p), past(c.part, (c.count + i) * p)
        slope, at, share = s.gain * s.steep, numbers(c, i).eps_at, 0.0
        if s.eta > 0.0:
            share = s.height / s.eta
            for j in range(p):
                total[j] += slope * y[c.base + at * p + j]
        else:
            for j in range(p):
                total[j] += c.drive.pace * own[p + j] * s.rate
            if slope > 0.0:
                share = s.height / slope
        over = -s.rate if loose < 0 else 0.0
        for j in range(p):
            if loose < 0:
                rate[j] += share * total[j] + over * (own[j] - share * own[p + j])
            elif s.eta > 0.0:
                reach[j] -= s.eps * own[j] + s.height * y[c.base + at * p + j]
            else:
                reach[j] -= s.eps * own[j] - share * total[j]
    derive_common(c, last, loose, flat, soft, weight, reach, rate, out)
    for i in range(i0, i1):
        derive_share(c, i, y, f, i == flat, reach, out)
    if last and c.top == VISCOUS:
        per, of_drag, top = 1.0 / c.drive.dragged, past(c.own, 2 * c.count * p), c.base + 2 * g * p
        for j in range(p):
            here = -per * (out[j] + of_drag[j] * c.drive.top_speed)
            f[top + j], f[top + p + j] = rate[j] if loose < 0 else here, 0.0


@inner
def derive_common(c, last, loose, flat, soft, weight, reach, rate, out):
    """Fill the derivatives of the stress of a group; see `derive_group`."""
    p, of_drag = c.p, past(c.own, 2 * c.count * c.p)
    if last and c.top == STRESS:
        for j in range(p):
            out[j] = 0.0
    elif loose < 0 and last and c.top == VISCOUS:
        drag, speed = c.drive.dragged, c.drive.top_speed
        for j in range(p):  # `rate` becomes that of the velocity of the top
            rate[j] = -(rate[j] + of_drag[j] * speed * weight) / (drag * weight + 1.0)
            out[j] = -drag * rate[j] - of_drag[j] * speed
    elif loose < 0:
        for j in range(p):
            out[j] = rate[j] / weight if weight > 0.0 else 0.0  # all at rest
    elif flat < 0:
        for j in range(p):
            out[j] = reach[j] / soft
    else:
        for j in range(p):
            out[j] = c.part[(c.count + flat) * p + j]
            reach[j] -= out[j] * soft  # left for the flat branch


@inner
def derive_share(c, i, y, f, is_flat, reach, out):
    """Fill the derivatives of the strain of a spring in a group of several; of its rate too."""
    p, at = c.p, numbers(c, i).eps_at
    s, own, total = spring(c, i), past(c.own, 2 * i * p), past(c.part, (c.count + i) * p)
    strain, mine = past(c.strain, i * p), c.base + at * p
    if s.eta > 0.0:
        for j in range(p):
            strain[j] = y[mine + j]
            f[mine + j] = (out[j] - total[j] - s.rate * own[p + j]) / s.eta
    elif is_flat:
        for j in range(p):
            strain[j] = reach[j] / s.height
    else:
        slope = s.gain * s.steep
        for j in range(p):
            strain[j] = (out[j] - total[j]) / slope if slope > 0.0 else 0.0
    motion.derive_inside(c, i, y, f, past(f, mine) if s.eta > 0.0 else strain)


@grouping
def group_values(c, g, y, f, want, at):
    """Fill the values of the springs of a group and their part of the rates `f`; return S."""
    if want != motion.ONLY_DERIVATIVES:
        _follow(c, g, y, f, want, at)
    if want:
        derive_group(c, g, y, f)
    return c.carried[g]
