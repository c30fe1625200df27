"""Undamped, massless springs in series: a common stress, along a motion or a stress history.

Along a monotone part of the motion the strain of each spring is a monotone function of the common
stress. The springs are followed from one end of a branch to the next; between them the sum of their
elongations has one root, and no integration in time is needed.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled.motion import ONLY_DERIVATIVES, evaluate, in_contact, rates_of
from foamfit.solve.compiled.run import begin_run, change_branch, numbers, spring
from foamfit.solve.compiled.samples import KNOWN, is_finite, write_sample
from foamfit.solve.scene import MOTION, STRESS
from foamfit.springs.compiled.contract import call_number, inner, outer, past

LEAST = 1e-6  # strain to whose rounding error elongations are always resolved
MOST_SWITCHES = 100_000  # of all springs between two samples


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
    """Bring springs to a stress on their branches; return elongation, compliance, size of terms.

    With `loose`, only the springs without a dashpot.
    """
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
    """Let springs on flat branches take an elongation, from the base up; return what is left.

    One that reaches the end of its branch leaves it; the second value says so.
    """
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
    c.carried[0], c.drive.value, c.drive.shift = now, c.values[k], in_contact(c, k)
    if c.p > 0:
        for i in range(c.count):
            s = spring(c, i)
            evaluate(c, i, 1 + c.none)
            s.tangent, s.total = s.slope, s.sigma
        rates_of(c, c.none, c.y, c.f, ONLY_DERIVATIVES, 0.0)
    write_sample(c, c.y, 0.0, k, KNOWN + c.none)


@outer
def balance(ints, floats, rows, heights, mass, reals, values, time, out, log, history):
    """Follow undamped, massless springs in series along a motion or stress of the top.

    `history` (2, springs, n) becomes strains and branches. Return the largest error of an
    elongation, infinite if a sample is not finite.
    """
    c = begin_run(ints, floats, time, values, out, log, rows, heights, mass, reals)
    before = miss = 0.0
    for i in range(c.count):
        evaluate(c, i, int(c.p > 0))
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
