"""Explicit steps of a chain: the pair of Dormand and Prince of order 8(5,3) with dense output.

Switches of branch and the end of contact are roots on the dense output, of order 7. Its stages are
computed only in steps that contain a sample or, by a look at both ends, may contain a switch. The
error norm leaves the derivatives by parameters out.

A drive is linear between two samples, so no step is longer; see also `loop`.

Springs that relax, in series or under a known stress, need few steps from sample to sample. Within
such a step, the stress of each spring is a parabola in time: it has the stress and slope of the
start, and the stress of the end. Relaxation terms are integrated exactly for it, see `along`, so
that they are linear in the stress at the end. Static equilibrium with another gain and an offset
of each spring then gives that stress. The slope at the end adds a cubic term, which corrects the
relaxation terms and is the error estimate. The slopes of derivatives are unknown: these are linear
within a step, and what the parabola adds to a straight line bounds their error.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from scipy.integrate._ivp import dop853_coefficients as pair

from foamfit.solve.compiled import events, run
from foamfit.solve.compiled.along import TABLE, integral, tabulate
from foamfit.solve.compiled.events import MIDDLE
from foamfit.solve.compiled.groups import strain_at
from foamfit.solve.compiled.motion import ONLY_DERIVATIVES, evaluate, rates, rates_of
from foamfit.solve.compiled.run import STEPPED, STRESS, numbers, spring
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import inner, past, start
from foamfit.springs.laws.record import OWN_RELAXATION

ALL_STAGES = 16  # those of a step and of the dense output
_A = np.zeros((ALL_STAGES, ALL_STAGES))
_A[:, : pair.A.shape[1]] = pair.A
_A[STEPPED, :STEPPED] = pair.B
# Coefficients without zeros: stage s is the sum of WEIGHT[k] K[FROM[k]] for BEGINS[s] <= k <
# BEGINS[s+1]; after the stages come the four higher terms of the dense output, and the errors of
# order 5 and 3.
_FULL = np.zeros((22, ALL_STAGES))
_FULL[:16], _FULL[16:20], _FULL[20, :13], _FULL[21, :13] = _A, pair.D, pair.E5, pair.E3
_ROWS = [np.flatnonzero(row) for row in _FULL]
_WIDE = [(0, row.size % 2) for row in _ROWS]  # a zero that fills up a row to pairs
BEGINS = np.cumsum([0, *(row.size + wide[1] for row, wide in zip(_ROWS, _WIDE, strict=True))])
FROM = np.concatenate([np.pad(row, wide) for row, wide in zip(_ROWS, _WIDE, strict=True)])
WEIGHT = np.concatenate(
    [np.pad(full[row], wide) for full, row, wide in zip(_FULL, _ROWS, _WIDE, strict=True)]
)
TIMES = pair.C[:ALL_STAGES]
MIDWAY_STAGE = int(np.flatnonzero(TIMES == MIDDLE)[0])

LAST_TERM = 3e-4  # share of the last term of the dense output that counts as its error
AIMED = 0.77  # growth of a step whose dense output has an error of 1; few steps are then repeated


def _emit_sum(context, builder, signature, args):
    """Add up four components at a time, in two sums that do not wait for each other."""
    # The compiler makes such code of a plain loop only where components are many.
    n, wide, first, last, scale, weights, sources, stage, begin, out = args
    four, together = ir.VectorType(ir.DoubleType(), 4), ("contract",)
    zero, one, two, quad = (context.get_constant(types.intp, k) for k in (0, 1, 2, 4))

    def at(pointer, place):
        return builder.bitcast(builder.gep(pointer, [place]), four.as_pointer())

    def read(pointer, place):
        return builder.load(at(pointer, place), align=8)

    def spread(number):
        lane = builder.insert_element(ir.Constant(four, ir.Undefined), number, ir.IntType(32)(0))
        return builder.shuffle_vector(lane, lane, ir.VectorType(ir.IntType(32), 4)([0] * 4))

    def add(total, factor, values):
        return builder.fadd(total, builder.fmul(factor, values, together), together)

    with cgutils.for_range_slice(builder, zero, n, quad) as (i, _):
        sums = [cgutils.alloca_once_value(builder, four([0.0] * 4)) for _ in range(2)]
        with cgutils.for_range_slice(builder, first, last, two) as (k, _):
            for place, total in zip((k, builder.add(k, one)), sums, strict=True):
                row = builder.mul(builder.load(builder.gep(sources, [place])), wide)
                weight = spread(builder.load(builder.gep(weights, [place])))
                values = read(stage, builder.add(row, i))
                builder.store(add(builder.load(total), weight, values), total)
        change = builder.fadd(*map(builder.load, sums), together)
        builder.store(add(read(begin, i), spread(scale), change), at(out, i), align=8)
    return context.get_dummy_value()


_at = contract.REALS_AT
_sum = contract.emitted(
    types.void(*[contract.WHOLE] * 4, contract.REAL, _at, contract.WHOLES_AT, _at, _at, _at),
    _emit_sum,
)


@inner
def combine(c, n, row, scale, begin, out):
    """Fill out = begin + scale Σ WEIGHT[k] stage[FROM[k]], and up to three components above n."""
    k, last = BEGINS[row], BEGINS[row + 1]
    _sum(n, c.wide, k, last, scale, start(WEIGHT), start(FROM), c.stage, begin, out)


@inner
def take(c, n, dt, at, want):
    """Fill the stages of a step from the first, and the state and rates at its end."""
    for s in range(1, STEPPED + 1):
        target = c.new if s == STEPPED else c.state
        combine(c, n, s, dt, c.y, target)
        when = at + TIMES[s] * dt if s < STEPPED else at + dt
        rates(c, target, past(c.stage, s * c.wide), want, when)
        if s == MIDWAY_STAGE:
            events.keep_midway(c)


@inner
def error_of(c, dt, tol):
    """Return the error of a step over the tolerance."""
    y, new, kinds, scales, errors, wide = c.y, c.new, c.kinds, c.scales, c.errors, c.wide
    for q in range(2):
        combine(c, c.base, 20 + q, dt, c.nil, past(errors, q * wide))
    five = three = 0.0
    for i in range(c.base):
        size = max(scales[kinds[i]], max(abs(y[i]), abs(new[i])))
        if size > 0.0:
            scale = 1.0 / (tol * size)
            one, other = errors[i] * scale, errors[wide + i] * scale
            five, three = five + one * one, three + other * other
    if five == 0.0:
        return 0.0
    return five / math.sqrt(c.base * (five + 0.01 * three))


@inner
def make_dense(c, n, dt, at, tol, want):
    """Fill the dense output of a step; return the size of its last term over the tolerance."""
    wide, line, stage, y, new = c.wide, c.line, c.stage, c.y, c.new
    for s in range(STEPPED + 1, ALL_STAGES):
        combine(c, n, s, dt, y, c.state)
        rates(c, c.state, past(stage, s * wide), want, at + TIMES[s] * dt)
    for i in range(n):
        rise, last = new[i] - y[i], stage[STEPPED * wide + i]
        line[i], line[wide + i] = rise, dt * stage[i] - rise
        line[2 * wide + i] = 2.0 * rise - dt * (last + stage[i])
    for q in range(4):
        combine(c, n, ALL_STAGES + q, dt, c.nil, past(line, (3 + q) * wide))
    # Where fast processes have died out, that exceeds the error at the end by far.
    size, kinds, scales = 0.0, c.kinds, c.scales
    for i in range(c.base):
        most = max(scales[kinds[i]], abs(new[i]))
        if most > 0.0:
            size = max(size, abs(line[6 * wide + i]) / most)
    return LAST_TERM / tol * size


@run.stepping
def step(c, want, tol, upto, most):
    """Take one step, shorter ones until it is accurate; return how it ended."""
    r, again, n = c.now, False, c.base + c.carries * c.p
    if c.short_at and run.call_short(c, want, tol):
        return events.PLAIN + c.none
    while True:
        dt, at = r.step, r.now
        if r.now + dt == r.now or not dt > 0.0:
            return events.FAILED
        take(c, n, dt, at, want)
        r.taken += 1.0
        error = error_of(c, dt, tol)
        if not error <= 1.0:
            again = True
            r.step = dt * (max(0.2, 0.9 * error**-0.125) if error < math.inf else 0.2)
            if r.taken >= most:
                return events.FAILED
            continue
        grow = 6.0
        if error > 1e-8:
            grow = min(6.0, max(0.3, 0.9 * error**-0.115 * r.last**0.02))
        r.grow = min(grow, 1.0) if again else grow
        # A step that may contain a switch, or contains a sample, has its dense output.
        doubtful = events.suspicious(c, dt)
        if not doubtful and upto > r.now + dt:
            r.last = max(error, 1e-4)
            return events.PLAIN
        size = make_dense(c, n, dt, at, tol, want)
        if size > 1.0 and dt > 1e-12 * abs(r.horizon):
            again = True
            r.step = dt * max(0.3, AIMED * size**-0.143)
            continue
        r.last = max(error, 1e-4)
        if size * r.grow**7 > AIMED**7:
            r.grow = AIMED * size**-0.143
        return events.DOUBTFUL if doubtful else events.SAMPLED


# ---------------------------------------------------------------- springs that relax

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
        run.sum_gain(c, i)


@inner
def _balance(c, h, guess, near):
    """Fill strains, stresses and terms at the end of a step; return the common stress, or NaN."""
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
    # Newton's method does not converge at once in a narrow snap.
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


@run.shortening
def relaxing_step(c, want, tol):
    """Try one step up to the next sample, or a shorter one; return whether it was taken."""
    r, s, first, rest = c.now, c.springs, c.carried[0], c.now.horizon - c.now.now
    climb = s.gain * s.slope * s.rate + s.drift  # rate of the common stress
    last = past(c.stage, STEPPED * c.wide)
    r.paused -= 1.0
    if r.paused >= 0.0 or not rest > 0.0 or not _keep(c):
        return c.none
    h = min(max(r.step, SHORTEST * rest), rest)
    while h >= SHORTEST * rest:
        _prepare(c, h)
        common = _balance(c, h, first + climb * h, min(NEAR, CLOSE * tol))
        _restore(c)
        rates(c, c.new, last, c.none, r.now + h)
        error = _correct(c, h, want, tol, common)
        if error <= 1.0:
            break
        h *= max(0.2, 0.8 * error ** (-1.0 / 3.0)) if error < math.inf else 0.0
    if h < SHORTEST * rest or events.suspicious(c, h):
        r.paused = PAUSE
        return c.none
    if want:
        _derive(c, h)
    r.step, r.taken = h, r.taken + 1.0
    r.grow = min(6.0, 0.8 * max(error, 1e-6) ** (-1.0 / 3.0))
    if h < rest:  # else the next piece does it
        rates(c, c.new, last, want, r.now + h)
    return 1 + c.none
