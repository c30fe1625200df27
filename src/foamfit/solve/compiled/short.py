"""Explicit steps from one sample of a drive to the next, where samples are close.

The pair of Bogacki and Shampine of order 3(2) is then accurate enough, with a third of the
evaluations of the rates.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cfunc

from foamfit.solve.compiled.events import MIDDLE, suspicious
from foamfit.solve.compiled.explicit import SHORT, SHORTENING, combine
from foamfit.solve.compiled.motion import rates
from foamfit.solve.compiled.run import STEPPED, spring, unpack
from foamfit.springs.compiled.contract import OPTIONS, RELAX, inner, past

TIMES = np.array((0.5, 0.75, 1.0))
BETWEEN = (MIDDLE - TIMES[0]) / (TIMES[1] - TIMES[0])
# Its errors add up, as they are close to the estimate; those of order 8 are far below it.
STRICT = 0.1
PAUSE = 8  # steps without an attempt at order 3 after one that was not accurate


@inner
def _take(c, n, want, tol):  # type: ignore[no-untyped-def]
    """Take a step as `explicit.take` does; return its error over the tolerance."""
    y, new, scales, errors, wide, dt = c.y, c.new, c.scales, c.errors, c.wide, c.now.step
    for i in range(c.count):
        s = spring(c, i)
        for k in range(c.terms):
            if s[RELAX + 2 * k] > 0.0 and dt > s[RELAX + 2 * k + 1]:  # derivatives would grow
                return math.inf
    for q in range(3):
        target, row = c.new if q == 2 else c.state, STEPPED if q == 2 else 1 + q
        combine(c, n, SHORT + q, dt, y, target)
        rates(c, target, past(c.stage, row * wide), want, c.now.now + TIMES[q] * dt)
        for i in range(c.count):
            s = spring(c, i)
            if q < 2:  # at MIDDLE, by a straight line between the stages
                s.midway = s.rate if q == 0 else s.midway + BETWEEN * (s.rate - s.midway)
    combine(c, c.base, SHORT + 3, dt, c.nil, errors)
    total = 0.0
    for i in range(c.base):
        size = max(scales[c.kinds[i]], max(abs(y[i]), abs(new[i])))
        if size > 0.0:
            share = errors[i] / (tol * size)
            total += share * share
    return math.sqrt(total / c.base)


@cfunc(SHORTENING, **OPTIONS, cache=True)
def _step(words, want, tol):  # type: ignore[no-untyped-def]
    """Try one step over a whole piece of the drive; return whether it was taken."""
    c = unpack(words)
    r = c.now
    if r.now != 0.0 or r.step != r.horizon or not r.step > 0.0:
        return c.none
    r.paused -= 1.0
    if r.paused >= 0.0:
        return c.none
    if _take(c, c.base + c.carries * c.p, want, tol) <= STRICT and not suspicious(c, r.step):
        r.taken, r.grow = r.taken + 1.0, 6.0
        return 1 + c.none
    r.paused = PAUSE
    return c.none


SHORT_STEP = _step.address
