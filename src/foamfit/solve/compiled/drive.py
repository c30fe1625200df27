"""Prescribed stress or motion of the top: its pieces between samples, and the start from rest.

A drive whose first sample is not zero takes the springs there on a ramp, while time stands still:
dashpots, relaxation terms and the rates B and stresses V of laws do nothing, and nodes rest.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled.motion import in_contact, rates
from foamfit.solve.compiled.run import driving, numbers, spring, sum_gain, write
from foamfit.solve.compiled.samples import KNOWN, row_of
from foamfit.solve.scene import MOTION, STRESS
from foamfit.springs.compiled.contract import inner, past

RAMP = 1e-9  # time of a ramp over the duration


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
def _begin_ramp(c, want):
    """Begin a ramp to the first sample of a drive. Under a prescribed stress dashpots are rigid."""
    r, drive, t = c.now, c.drive, c.time
    brief = RAMP * (t[c.samples - 1] - t[0]) if c.samples > 1 else RAMP
    r.now, r.begun, r.horizon, r.piece, r.paused = 0.0, t[0] - brief, brief, -1.0, math.inf
    c.aside[c.count] = drive.pace
    drive.value, drive.value_rate, drive.pace = 0.0, c.values[0] / brief, 0.0
    drive.shift, drive.shift_rate = 0.0, in_contact(c, c.none) / brief
    for i in range(c.first[c.groups - 1], c.count):
        s, n = spring(c, i), numbers(c, i)
        c.aside[i], s.gain = s.eta, 1.0
        if s.eta > 0.0:
            s.eta = 0.0 if c.top == MOTION else math.inf
            n.fixed = int(c.top == MOTION and n.eps_at >= 0)
    rates(c, c.y, c.stage, want, 0.0)


@inner
def _end_ramp(c, want):
    """Let time pass again: relaxation terms begin at zero, and dashpots at the present strain."""
    y, p, aside = c.y, c.p, c.aside
    rates(c, y, c.stage, want, c.now.now)
    c.drive.pace, c.now.grow, c.now.paused = aside[c.count], 1.0, 0.0
    for i in range(c.first[c.groups - 1], c.count):
        s, n = spring(c, i), numbers(c, i)
        strain, part = past(c.strain, i * p), past(c.part, i * p)
        for k in range(c.terms):
            y[n.z_at + k] = -s.sigma
            for j in range(p):
                y[c.base + (n.z_at + k) * p + j] = -(s.steep * strain[j] + part[j])
        sum_gain(c, i)
        if aside[i] == 0.0:
            continue
        s.eta = aside[i]
        if n.eps_at >= 0 and c.top == MOTION:
            y[n.eps_at] = s.eps
            for j in range(p):
                y[c.base + n.eps_at * p + j] = strain[j]
        if n.fixed:
            first, n.fixed = past(s.by, 2), 0
            for k in range(n.internals if n.internal else c.none):
                for j in range(p):
                    y[c.base + (n.x_at + k) * p + j] += first[k] * strain[j]


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
        _end_ramp(c, want)
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
    if c.values[0] != 0.0 and (c.top == MOTION or c.top == STRESS):
        _begin_ramp(c, want)
        return c.none
    _begin_piece(c, c.none)
    rates(c, c.y, c.stage, want, 0.0)
    write(c, c.y, 0.0, c.none, want)
    return int(c.samples == 1)
