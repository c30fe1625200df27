"""Springs in series, between two nodes or under a top without mass: a group with one stress S.

- Several springs with dashpots: S = (Δv + Σ h T/η)/(Σ h/η), dε/dt = (S - T)/η.
- Some without: S is their T; they share the rest of the elongation by their compliances; a spring
  on a flat branch takes all of it.

A zero-mass node therefore needs no equation to be solved. If a stress is prescribed on a top
without mass, it is S of the last group; an onsite damper then moves the top with v = (push - S)/D.

A chain of undamped, massless springs needs no integration in time, along a motion or a stress.
Along a monotone part of the motion the strain of each spring is a monotone function of the common
stress. The springs are followed from one end of a branch to the next; between them the sum of their
elongations has one root.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled import motion, run
from foamfit.solve.compiled.run import MOTION, STRESS, VISCOUS, change_branch, numbers, spring
from foamfit.solve.compiled.samples import KNOWN, is_finite, write_sample
from foamfit.springs.compiled.contract import call_number, inner, outer, past

MOVES = 1e-9  # relative difference of stresses that is more than rounding
LEAST = 1e-6  # strain to whose rounding error elongations are always resolved
MOST_SWITCHES = 100_000  # of all springs between two samples


# ---------------------------------------------------------------- equilibrium at a stress


@inner
def _put(c, i, eps, sigma):
    """Bring a spring to a strain and stress of its branch."""
    s = spring(c, i)
    s.eps = eps
    if numbers(c, i).by_stress:
        s.x = (sigma - s.offset) / s.gain


@inner
def strain_at(c, i, sigma):
    """Return the strain of a spring at a stress T on its branch; fill SOFT."""
    s, n = spring(c, i), numbers(c, i)
    return call_number(n.strain, past(s, c.row), s, (sigma - s.offset) / s.gain)


@inner
def elongation_at(c, i0, i1, sigma, loose):
    """Bring springs, or `loose` ones, to a stress; return elongation, compliance, size of terms."""
    total = compliance = size = 0.0
    for i in range(i0, i1):
        s = spring(c, i)
        if loose and s.eta > 0.0:
            continue
        eps = strain_at(c, i, sigma)
        _put(c, i, eps, sigma)
        total += s.height * eps
        compliance += s.height * s.soft / s.gain
        size += s.height * max(abs(eps), LEAST)
    return total, compliance, size


@inner
def _split_jump(c, i0, i1, target, low, high, loose):
    """Distribute an elongation inside a jump between two stresses from the base up."""
    reached, _, _ = elongation_at(c, i0, i1, low, loose)
    rest = target - reached
    for i in range(i0, i1):
        s = spring(c, i)
        if loose and s.eta > 0.0:
            continue
        upper, eps = strain_at(c, i, high), strain_at(c, i, low)
        gain = min(max(rest / s.height, 0.0), upper - eps)
        _put(c, i, eps + gain, 0.5 * (low + high))
        rest -= s.height * gain
    return 0.5 * (low + high)


@inner
def root(c, i0, i1, target, sigma, low, high, end, loose):
    """Bring springs to an elongation; return the stress, and whether the root lies beyond `end`.

    Newton's method inside a bracket of stresses, which every third trial halves. The root may lie
    above the upper bound if `end` is 1, and below the lower one if it is -1; otherwise 0.
    """
    for trial in range(400):
        total, compliance, size = elongation_at(c, i0, i1, sigma, loose)
        miss = total - target
        if (end > 0 and sigma == high) or (end < 0 and sigma == low):
            if miss * end < 0.0:
                return sigma, 1 + c.none
            end = 0
        if abs(miss) <= 2e-15 * (size + abs(target)):
            return sigma, c.none
        if miss > 0.0:
            high = min(high, sigma)
        else:
            low = max(low, sigma)
        new = sigma - miss / compliance
        if not low < new < high or (trial >= 8 and trial % 3 == 0):
            beyond = (end > 0 and new >= high) or (end < 0 and new <= low)
            if beyond:
                new = high if end > 0 else low
            elif low > -math.inf and high < math.inf:
                new = 0.5 * (low + high)
            elif not low < new < high:
                new = sigma + (2.0 if miss < 0.0 else -2.0) * max(
                    abs(sigma), abs(miss / compliance)
                )
            if not beyond and new in (low, high):  # neighbouring floating-point numbers
                if end == 0:
                    return _split_jump(c, i0, i1, target, low, high, loose), c.none
                new = high if end > 0 else low
        sigma = new
    elongation_at(c, i0, i1, sigma, loose)
    return sigma, c.none


# ---------------------------------------------------------------- rates of a group


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
def share_rate(c, g, i0, i1, rate, loose, flat, pushed):
    """Fill the strain rates of a group of several springs; `pushed`: its stress is prescribed."""
    soft, rest, climb, common = 0.0, rate, c.drive.value_rate, c.carried[g]
    least, lightest = math.inf, spring(c, i0)
    for i in range(i0, i1):
        s = spring(c, i)
        if s.eta > 0.0:
            s.rate = (common - s.total) / s.eta
            rest -= s.height * s.rate
            if s.eta < least * s.height:
                least, lightest = s.eta / s.height, s
        elif flat < 0:
            compliance = s.height / (s.gain * s.tangent)
            soft += compliance
            rest += compliance * s.drift
    if loose < 0:
        if not pushed:  # rounding errors of S - T would change the elongation, and nothing resists
            lightest.rate += rest / lightest.height
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


@run.grouping
def group_values(c, g, y, f, want, at):
    """Fill the values of the springs of a group and their part of the rates `f`; return S."""
    if want != motion.ONLY_DERIVATIVES:
        _follow(c, g, y, f, want, at)
    if want:
        derive_group(c, g, y, f)
    return c.carried[g]


# ---------------------------------------------------------------- along a history


@inner
def push_to(c, i, sigma, before, y):
    """Bring a spring to a stress, from the stress `before`."""
    s, way = spring(c, i), 1.0 if sigma > before else -1.0
    for _ in range(MOST_SWITCHES):
        if sigma != before and s.turns * way < 0.0:
            change_branch(c, i, int(way > 0.0), y)
        elif sigma > s.sigma_high and s.high < math.inf:
            change_branch(c, i, 1, y)
        elif sigma < s.sigma_low and s.low > -math.inf:
            change_branch(c, i, int(c.none), y)
        else:
            break
    _put(c, i, strain_at(c, i, sigma), sigma)


@inner
def elongation(c, i0, i1):
    """Return the elongation of springs at their present strains."""
    total = 0.0
    for i in range(i0, i1):
        s = spring(c, i)
        total += s.height * s.eps
    return total


@inner
def _yield_flat(c, i0, i1, rest, y):
    """Let flat branches take an elongation from the base up; return the rest, and if one ended."""
    up = rest > 0.0
    for i in range(i0, i1):
        s = spring(c, i)
        if s.sigma_low != s.sigma_high or rest == 0.0:
            continue
        room = s.height * ((s.high if up else s.low) - s.eps)
        if abs(rest) <= abs(room):
            s.eps += rest / s.height
            return 0.0, False
        change_branch(c, i, int(up), y)
        return rest, True
    return rest, False


@inner
def bring(c, i0, i1, target, common, y):
    """Bring springs in series to an elongation, from a common stress; return that stress."""
    for _ in range(MOST_SWITCHES):
        rest = target - elongation(c, i0, i1)
        if rest == 0.0:
            break
        up, turned = rest > 0.0, False
        for i in range(i0, i1):
            if spring(c, i).turns * (1.0 if up else -1.0) < 0.0:
                change_branch(c, i, int(up), y)
                turned = True
        if turned:
            continue
        rest, left = _yield_flat(c, i0, i1, rest, y)
        if left:
            continue
        if rest == 0.0:
            break
        limit, compliance = math.inf if up else -math.inf, 0.0
        for i in range(i0, i1):
            s = spring(c, i)
            limit = min(limit, s.sigma_high) if up else max(limit, s.sigma_low)
            compliance += s.height * s.soft / s.gain
        limit = max(limit, common) if up else min(limit, common)
        ended = abs(limit) < math.inf
        # The compliance may be that of the branch before, as it only gives the first trial.
        start = common + rest / compliance if compliance > 0.0 else common
        low, high = min(common, limit), max(common, limit)
        if not low < start < high:
            start = limit if ended and (start > limit) == up else common
        end = (1 if up else -1) if ended else 0
        common, beyond = root(c, i0, i1, target, start, low, high, end, c.none)
        if not beyond:
            return common
        for i in range(i0, i1):
            s = spring(c, i)
            if (s.sigma_high <= limit) if up else (s.sigma_low >= limit):
                change_branch(c, i, int(up), y)
    return common


@inner
def _write(c, k, now):
    """Write sample k: the common stress, displacements, and their derivatives."""
    c.carried[0], c.drive.value, c.drive.shift = now, c.values[k], motion.in_contact(c, k)
    if c.p > 0:
        for i in range(c.count):
            s = spring(c, i)
            motion.evaluate(c, i, 1 + c.none)
            s.tangent, s.total = s.slope, s.sigma
        motion.rates_of(c, c.none, c.y, c.f, motion.ONLY_DERIVATIVES, 0.0)
    write_sample(c, c.y, 0.0, k, KNOWN + c.none)


@outer
def balance(ints, floats, rows, heights, mass, reals, values, time, out, log, history):
    """Follow undamped, massless springs in series along a motion or stress of the top.

    `history` (2, springs, n) becomes strains and branches. Return the largest error of an
    elongation, infinite if a sample is not finite.
    """
    c = run.begin_run(ints, floats, time, values, out, log, rows, heights, mass, reals)
    before = miss = 0.0
    for i in range(c.count):
        motion.evaluate(c, i, int(c.p > 0))
    for k in range(c.samples):
        now = c.values[k]
        if c.top == MOTION:
            now = bring(c, c.none, c.count, now, before, c.y)
        for i in range(c.count if c.top == STRESS else c.none):
            push_to(c, i, now, before, c.y)
        _write(c, k, now)
        before = now
        for i in range(c.count):
            s = spring(c, i)
            history[0, i, k], history[1, i, k] = s.eps, s.branch
        if c.top == MOTION:
            miss = max(miss, abs(elongation(c, c.none, c.count) - c.values[k]))
    return miss if is_finite(c, c.shown) else math.inf
