"""Prescribed stress or motion of the top: its pieces between samples, and the start from rest."""

from __future__ import annotations

from foamfit.solve.compiled import motion
from foamfit.solve.compiled.motion import evaluate, in_contact, rates, rates_of
from foamfit.solve.compiled.run import call_inside, driving, numbers, spring, sum_gain, write
from foamfit.solve.compiled.samples import KNOWN, row_of
from foamfit.solve.compiled.static import bring, push_to
from foamfit.solve.scene import FREE, MOTION, STRESS, VISCOUS
from foamfit.springs.compiled.contract import inner, past


@inner
def _begin_piece(c, k):
    """Prescribe the drive between samples k and k + 1."""
    r, drive, t, values = c.now, c.drive, c.time, c.values
    r.now, r.begun, drive.value, drive.value_rate = 0.0, t[k], values[k], 0.0
    r.horizon, drive.shift, drive.shift_rate = 0.0, in_contact(c, k), 0.0
    if k + 1 < c.samples:
        r.horizon = t[k + 1] - t[k]
        drive.value_rate = (values[k + 1] - values[k]) / (t[k + 1] - t[k])
        drive.shift_rate = (in_contact(c, k + 1) - drive.shift) / (t[k + 1] - t[k])


@inner
def _starts_on_ramp(c):
    """Whether internal variables change up to the first sample of a drive."""
    internal = 0
    for i in range(c.first[c.groups - 1], c.count):
        internal += numbers(c, i).internal
    return internal > 0 and c.values[0] != 0.0 and (c.top == MOTION or c.top == STRESS)


@inner
def _start(c):
    """Bring the springs above the last mass into equilibrium with the first sample of a drive.

    Under a prescribed stress, springs with a dashpot start from rest.
    """
    g, y = c.groups - 1, c.y
    i0, i1 = c.first[g], c.first[g + 1]
    _begin_piece(c, c.none)
    first = c.drive.value
    if c.top == FREE or c.top == VISCOUS:
        return
    for i in range(i0, i1):
        spring(c, i).gain = 1.0  # relaxation terms carry nothing yet
    if c.top == STRESS:
        for i in range(i0, i1):
            if spring(c, i).eta == 0.0:
                push_to(c, i, first, 0.0, y)
    else:
        first = bring(c, i0, i1, first, 0.0, y)
    for i in range(i0, i1):
        s, n = spring(c, i), numbers(c, i)
        evaluate(c, i, int(c.p > 0))
        s.tangent, s.total = s.slope, s.sigma
        if n.eps_at >= 0:
            y[n.eps_at] = s.eps
        if n.by_stress and n.x_at >= 0:
            y[n.x_at] = s.x
        for k in range(c.terms):
            y[n.z_at + k] = -s.total
    if c.p > 0:
        _derive_start(c, g, i0, i1, first)
    for i in range(i0, i1):
        sum_gain(c, i)


@inner
def _derive_start(c, g, i0, i1, common):
    """Fill the derivatives of the state at rest, where relaxation terms carry nothing.

    A prescribed motion has moved the springs before their dashpots carry anything.
    """
    y, p, base = c.y, c.p, c.base
    c.carried[g] = common
    for i in range(i0, i1):
        s = spring(c, i)
        s.offset = s.eta
        s.eta = 0.0 if c.top == MOTION else s.eta
    rates_of(c, g, y, c.f, motion.ONLY_DERIVATIVES, 0.0)
    for i in range(i0, i1):
        s, n, strain = spring(c, i), numbers(c, i), past(c.strain, i * p)
        s.eta, s.offset = s.offset, 0.0
        slope, part, at = s.slope, past(c.part, i * p), base + n.eps_at * p
        if s.eta > 0.0 and n.eps_at >= 0:
            for j in range(p):
                strain[j] = y[at + j] = strain[j] if c.top == MOTION else 0.0
        for k in range(c.terms):
            z = past(y, base + (n.z_at + k) * p)
            for j in range(p):
                z[j] = -(slope * strain[j] + part[j])


@inner
def _is_damped(c):
    """Whether the stress of a spring depends on its strain rate."""
    damped = False
    for i in range(c.count):
        s = spring(c, i)
        damped = damped or s.eta > 0.0 or s.lossy > 0.0
    return damped


@inner
def _next_piece(c, want):
    """Write the sample at the end of a piece, and begin the next; return whether it was the last.

    Dashpots have the mean rate at a sample where the prescribed rate jumps.
    """
    r, k, t = c.now, int(c.now.piece) + 1, c.time
    if k == 0:  # after a ramp
        call_inside(c, motion.END_RAMP, c.none, want, c.y, c.stage, c.y, c.y)
        _begin_piece(c, k)
    r.piece, jumps = k, k > 0 and c.top == MOTION and c.groups == 1 and _is_damped(c)
    if jumps or k == c.samples - 1:
        write(c, c.y, r.now, k, want)
    if k == c.samples - 1:
        return 1
    if k > 0:
        _begin_piece(c, k)
    rates(c, c.y, c.stage, want, 0.0)
    if not jumps:
        write(c, c.y, 0.0, k, KNOWN + c.none)
    else:
        share, out = (t[k] - t[k - 1]) / (t[k + 1] - t[k - 1]), row_of(c, c.none, c.none)
        out[k] += share * (c.carried[0] - out[k])
        for j in range(c.p):
            out = row_of(c, 1 + j, c.none)
            out[k] += share * (c.common[j] - out[k])
    return c.none


@driving
def next_piece(c, starts, want):
    """Start from rest, or begin the next piece; return whether all samples are written."""
    if not starts:
        return _next_piece(c, want)
    if _starts_on_ramp(c):
        call_inside(c, motion.BEGIN_RAMP, c.none, want, c.y, c.stage, c.y, c.y)
        return c.none
    _start(c)
    rates(c, c.y, c.stage, want, 0.0)
    write(c, c.y, 0.0, c.none, want)
    return int(c.samples == 1)
