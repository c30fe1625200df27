"""Explicit steps of a chain: the pair of Dormand and Prince of order 8(5,3) with dense output.

Switches of branch and the end of contact are roots on the dense output, of order 7. Its stages are
computed only in steps that contain a sample or, by a look at both ends, may contain a switch. The
error norm leaves the derivatives by parameters out.

A drive is linear between two samples, so no step is longer; see also `loop`.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from scipy.integrate._ivp import dop853_coefficients as pair

from foamfit.solve.compiled import events
from foamfit.solve.compiled.motion import rates
from foamfit.solve.compiled.run import STEPPED, call_short, stepping
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import inner, past, start

ALL_STAGES = 16  # those of a step and of the dense output
_A = np.zeros((ALL_STAGES, ALL_STAGES))
_A[:, : pair.A.shape[1]] = pair.A
_A[STEPPED, :STEPPED] = pair.B
# Coefficients without zeros: stage s is the sum of WEIGHT[k] K[FROM[k]] for FIRST[s] <= k <
# FIRST[s+1]; after the stages come the four higher terms of the dense output, and the errors of
# order 5 and 3.
_FULL = np.zeros((22, ALL_STAGES))
_FULL[:16], _FULL[16:20], _FULL[20, :13], _FULL[21, :13] = _A, pair.D, pair.E5, pair.E3
_ROWS = [np.flatnonzero(row) for row in _FULL]
_WIDE = [(0, row.size % 2) for row in _ROWS]  # a zero that fills up a row to pairs
FIRST = np.cumsum([0, *(row.size + wide[1] for row, wide in zip(_ROWS, _WIDE, strict=True))])
FROM = np.concatenate([np.pad(row, wide) for row, wide in zip(_ROWS, _WIDE, strict=True)])
WEIGHT = np.concatenate(
    [np.pad(full[row], wide) for full, row, wide in zip(_FULL, _ROWS, _WIDE, strict=True)]
)
TIMES = pair.C[:ALL_STAGES]
MIDWAY_STAGE = int(np.flatnonzero(TIMES == events.MIDDLE)[0])

LAST_TERM = 3e-4  # share of the last term of the dense output that counts as its error
AIMED = 0.77  # growth of a step whose dense output has an error of 1; few steps are then repeated


def _emit_sum(context, builder, signature, args):
    """Add up four components at a time, in two sums that do not wait for each other.

    The compiler makes such code of a plain loop only where components are many.
    """
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
    """Fill out = begin + scale Σ WEIGHT[k] stage[FROM[k]] of a row of coefficients.

    Up to three components more than n are filled, for which all arrays have room.
    """
    k, last = FIRST[row], FIRST[row + 1]
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
    """Fill the dense output of a step; return the size of its last term over the tolerance.

    Where fast processes have died out, that exceeds the error at the end of the step by far.
    """
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
    size, kinds, scales = 0.0, c.kinds, c.scales
    for i in range(c.base):
        most = max(scales[kinds[i]], abs(new[i]))
        if most > 0.0:
            size = max(size, abs(line[6 * wide + i]) / most)
    return LAST_TERM / tol * size


@stepping
def step(c, want, tol, upto, most):
    """Take one step, shorter ones until it is accurate; return how it ended.

    `upto` is the time of the next sample inside the piece. A step that may contain a switch or
    contains a sample has its dense output.
    """
    r, again, n = c.now, False, c.base + c.carries * c.p
    if c.short_at and call_short(c, want, tol):
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
