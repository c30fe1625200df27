"""Springs that relax, in series or under a known stress: few steps from sample to sample.

Within a step, the stress of each spring is a parabola in time: it has the stress and slope of the
start, and the stress of the end. Relaxation terms are integrated exactly for it, see `along`, so
that they are linear in the stress at the end. Static equilibrium with another gain and an offset
of each spring then gives that stress. The slope at the end adds a cubic term, which corrects the
relaxation terms and is the error estimate. The slopes of derivatives are unknown: these are linear
within a step, and what the parabola adds to a straight line bounds their error.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled.along import TABLE, integral, tabulate
from foamfit.solve.compiled.events import MIDDLE, suspicious
from foamfit.solve.compiled.motion import ONLY_DERIVATIVES, evaluate, rates, rates_of
from foamfit.solve.compiled.run import STEPPED, numbers, shortening, spring, sum_gain
from foamfit.solve.compiled.static import strain_at
from foamfit.solve.scene import STRESS
from foamfit.springs.compiled.contract import inner, past
from foamfit.springs.laws.record import OWN_RELAXATION

# Memory of a spring, see `layout`: stress, slope and strain rate at the start of a step, and the
# stress at its end. Then the table of each relaxation term.
FIRST, STEEP, RATE, LAST, TABLES = range(5)
# Newton's method: relative elongation that a last step corrects, at most and over the tolerance;
# number of steps.
NEAR, CLOSE, TRIALS = 1e-7, 100.0, 4
EQUAL = 1e-9  # difference between the stresses of two springs over their scale
# Largest cubic term over the tolerance, as its own error is of higher order. Largest parabola where
# derivatives are computed, over its power: a search needs fewer digits of them than a simulation.
CUBIC, PARABOLA, POWER = 2.0, 2.5e3, 1.25
SHORTEST = 0.15  # share of the rest of a piece; shorter steps would cost more than one of order 8
# Change of a strain rate, over its sizes at both ends of a step, above which the law bends sharply
# between them; what then counts as the error.
ABRUPT, BENT = 0.5, 8.0
PAUSE = 2  # steps without an attempt after one that was not accurate
# The strain rate at MIDDLE follows from the rise of the strain and the rates at both ends.
RISE, EARLY, LATE = (
    6.0 * MIDDLE * (1.0 - MIDDLE), (1.0 - MIDDLE) * (1.0 - 3.0 * MIDDLE),
    MIDDLE * (3.0 * MIDDLE - 2.0),
)  # fmt: skip


@inner
def _memory(c, i):
    """Return the memory of a spring."""
    return past(c.aside, i * (TABLES + c.terms * TABLE))


@inner
def _keep(c):
    """Keep the values at the start of a step; return whether no spring is on a flat branch."""
    steep = True
    for i in range(c.count):
        s, m = spring(c, i), _memory(c, i)
        steep = steep and s.slope > 0.0 and s.sigma_low < s.sigma_high
        m[FIRST], m[STEEP], m[RATE] = s.sigma, s.slope, s.rate
    return steep


@inner
def _prepare(c, h):
    """Fill what the terms at the end of a step owe to its start, and gain and offset of each T."""
    y, new, p = c.y, c.new, c.p
    for i in range(c.count):
        s, n, m = spring(c, i), numbers(c, i), _memory(c, i)
        s.gain, s.offset, low = 1.0, 0.0, m[STEEP] * m[RATE] * h
        part, strain, slope = past(c.part, i * p), past(c.strain, i * p), m[STEEP]
        for k in range(c.terms):
            g, a, at = s.g[k], past(m, TABLES + k * TABLE), n.z_at + k
            x = h / s.tau[k]
            tabulate(x, h, a)
            decay = math.exp(-x)
            new[at] = decay * y[at] - x * (m[FIRST] * (a[0] - a[2]) + low * (a[1] - a[2]))
            s.gain += g * (1.0 - x * a[2])
            s.offset += g * new[at]
            before, after = past(y, c.base + at * p), past(new, c.base + at * p)
            for j in range(p):
                after[j] = decay * before[j] - x * (a[0] - a[1]) * (slope * strain[j] + part[j])


@inner
def _restore(c):
    """Give the springs back their own gains."""
    for i in range(c.count):
        spring(c, i).offset = 0.0
        sum_gain(c, i)


@inner
def _balance(c, h, guess, near):
    """Fill strains and stresses at the end of a step, and the terms; return the common stress.

    The result is not a number if Newton's method does not converge at once, as in a narrow snap.
    """
    new, pushed, change, off = c.new, c.top == STRESS, 0.0, 0.0
    end = c.drive.value + c.drive.value_rate * (c.now.now + h)
    common = end if pushed else guess
    for _ in range(TRIALS):
        miss, compliance, size = -end, 0.0, abs(end)
        for i in range(c.count):
            s = spring(c, i)
            s.eps = strain_at(c, i, common)
            miss += s.height * s.eps
            compliance += s.height * s.soft / s.gain
            size += s.height * abs(s.eps)
        if pushed:
            break
        change, off = -miss / compliance, abs(miss) - near * size
        common += change
        if off <= 0.0:
            break
    for i in range(c.count):
        s, n, m = spring(c, i), numbers(c, i), _memory(c, i)
        m[LAST] = (common - s.offset) / s.gain
        new[n.eps_at] = s.eps + s.soft / s.gain * change
        if n.x_at >= 0:
            new[n.x_at] = m[LAST]
        for k in range(c.terms):
            x = h / s.tau[k]
            new[n.z_at + k] -= x * m[TABLES + k * TABLE + 2] * m[LAST]
    return common if off <= 0.0 else math.nan


@inner
def _correct(c, h, want, tol, common):
    """Add the cubic terms; return the largest error over the one that is allowed."""
    y, new, error, balanced = c.y, c.new, 0.0, True
    least = PARABOLA * tol**POWER if want else math.inf
    for i in range(c.count):
        s, n, m = spring(c, i), numbers(c, i), _memory(c, i)
        most = max(abs(common), c.now.largest)
        balanced = balanced and abs(s.total - common) <= EQUAL * most
        if abs(s.rate - m[RATE]) > ABRUPT * (abs(s.rate) + abs(m[RATE])):
            error = max(error, BENT)
        low = m[STEEP] * m[RATE] * h
        square = m[LAST] - m[FIRST] - low
        cube = s.slope * s.rate * h - low - 2.0 * square
        for k in range(c.terms):
            g, a, at = s.g[k], past(m, TABLES + k * TABLE), n.z_at + k
            x = h / s.tau[k]
            more, bend = x * cube * (a[2] - a[3]), x * square * (a[1] - a[2])
            size = max(c.scales[c.kinds[at]], max(abs(y[at]), abs(new[at])))
            new[at] += more
            s.total += g * more
            if size > 0.0:
                error = max(error, max(abs(more) / (CUBIC * tol), abs(bend) / least) / size)
        s.midway = RISE * (s.eps - s.old_eps) / h + EARLY * s.old_rate + LATE * s.rate
    return error if balanced and abs(common) < math.inf else math.inf


@inner
def _derive(c, h):
    """Fill the derivatives of the relaxation terms at the end of a step."""
    new, p = c.new, c.p
    for i in range(c.count):
        s, n, m = spring(c, i), numbers(c, i), _memory(c, i)
        evaluate(c, i, 1 + c.none)
        first, low = m[FIRST], m[STEEP] * m[RATE] * h
        square = m[LAST] - first - low
        for k in range(c.terms):
            a, tau, at = past(m, TABLES + k * TABLE), s.tau[k], n.z_at + k
            x, after, what = h / tau, past(new, c.base + at * p), OWN_RELAXATION + 2 * k + 1
            s.gain -= s.g[k] * x * a[1]
            total = integral(a, first, low, square, 0.0, 0.0)
            change = integral(past(a, 1), first, low, square, 0.0, 0.0) - total
            for j in range(p):
                if c.owned[i * p + j] == what:
                    after[j] += (math.exp(-x) * c.y[at] + total + x * change) * x / tau
    rates_of(c, c.none, new, c.f, ONLY_DERIVATIVES, c.now.now + h)
    for i in range(c.count):
        s, n, m = spring(c, i), numbers(c, i), _memory(c, i)
        part, strain = past(c.part, i * p), past(c.strain, i * p)
        for k in range(c.terms):
            after = past(new, c.base + (n.z_at + k) * p)
            weight = h / s.tau[k] * m[TABLES + k * TABLE + 1]
            for j in range(p):
                after[j] -= weight * (s.slope * strain[j] + part[j])
    _restore(c)


@inner
def _try(c, h, want, tol, guess):
    """Fill the state at the end of a step; return the largest error over the one allowed."""
    _prepare(c, h)
    common = _balance(c, h, guess, min(NEAR, CLOSE * tol))
    _restore(c)
    rates(c, c.new, past(c.stage, STEPPED * c.wide), c.none, c.now.now + h)
    return _correct(c, h, want, tol, common)


@shortening
def relaxing_step(c, want, tol):
    """Try one step up to the next sample, or a shorter one; return whether it was taken."""
    r, s, first, rest = c.now, c.springs, c.carried[0], c.now.horizon - c.now.now
    climb = s.gain * s.slope * s.rate + s.drift  # rate of the common stress
    r.paused -= 1.0
    if r.paused >= 0.0 or not rest > 0.0 or not _keep(c):
        return c.none
    h = min(max(r.step, SHORTEST * rest), rest)
    while h >= SHORTEST * rest:
        error = _try(c, h, want, tol, first + climb * h)
        if error <= 1.0:
            break
        h *= max(0.2, 0.8 * error ** (-1.0 / 3.0)) if error < math.inf else 0.0
    if h < SHORTEST * rest or suspicious(c, h):
        r.paused = PAUSE
        return c.none
    if want:
        _derive(c, h)
    r.step, r.taken = h, r.taken + 1.0
    r.grow = min(6.0, 0.8 * max(error, 1e-6) ** (-1.0 / 3.0))
    if h < rest:  # else the next piece does it
        rates(c, c.new, past(c.stage, STEPPED * c.wide), want, r.now + h)
    return 1 + c.none
