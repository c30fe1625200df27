"""Derivatives of springs of INTERNAL laws, and jumps of their internal variables.

The results of such a law, from BY + parameters on, are σ, V and the rates A, B of each internal
variable; then their derivatives by ε, dε/dt, each internal variable and each parameter.
"""

from __future__ import annotations

from numba import cfunc

from foamfit.solve.motion import FLOW, FRICTION, INSIDE, PART
from foamfit.solve.run import INTERNALS, NUMBERS, PACE, PARAMETERS, X_AT, unpack
from foamfit.springs.compiled.contract import (
    BY,
    OPTIONS,
    RATE,
    SWITCH,
    X,
    call_switch,
    inner,
    past,
)
from foamfit.springs.parameters import OWN_ETA


@inner
def _part(c, i, y, part):  # type: ignore[no-untyped-def]
    """Add the derivatives of the stress through the internal variables."""
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    size = 2 + 2 * n[INTERNALS]
    for k in range(n[INTERNALS]):
        by_x = s[c.results + BY + n[PARAMETERS] + size + (2 + k) * size]
        d_x = past(y, c.base + (n[X_AT] + k) * p)
        for j in range(p):
            part[j] += by_x * d_x[j]


@inner
def _flow(c, i, y, f, quicker):  # type: ignore[no-untyped-def]
    """Fill the rates of the derivatives of the internal variables."""
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    x, values, strain = n[INTERNALS], past(s, c.results + BY + n[PARAMETERS]), past(c.strain, i * p)
    size, rate, pace = 2 + 2 * x, s[RATE], c.drive[PACE]
    by = past(values, size)
    for k in range(x):
        a, b = 2 + k, 2 + x + k
        at = c.base + (n[X_AT] + k) * p
        for j in range(p):
            f[at + j] = values[a] * quicker[j] + (rate * by[a] + pace * by[b]) * strain[j]
        for m in range(x):
            column, d_x = past(by, (2 + m) * size), past(y, c.base + (n[X_AT] + m) * p)
            for j in range(p):
                f[at + j] += (rate * column[a] + pace * column[b]) * d_x[j]
        for m in range(c.owned[i], c.owned[i + 1]):
            j = c.owned[m]
            column = past(by, (2 + x + c.directions[2 * j + 1]) * size)
            f[at + j] += rate * column[a] + pace * column[b]


@inner
def _friction(c, i, y, quicker, out):  # type: ignore[no-untyped-def]
    """Add the derivatives of the stress V."""
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    strain, size, pace = past(c.strain, i * p), 2 + 2 * n[INTERNALS], c.drive[PACE]
    by = past(s, c.results + BY + n[PARAMETERS] + size)
    for j in range(p):
        out[j] += pace * (by[1] * strain[j] + by[size + 1] * quicker[j])
    for k in range(n[INTERNALS]):
        d_x = past(y, c.base + (n[X_AT] + k) * p)
        for j in range(p):
            out[j] += pace * by[(2 + k) * size + 1] * d_x[j]
    for m in range(c.owned[i], c.owned[i + 1]):
        j = c.owned[m]
        out[j] += pace * by[(2 + n[INTERNALS] + c.directions[2 * j + 1]) * size + 1]


@inner
def _jump(c, i, up, y):  # type: ignore[no-untyped-def]
    """Change the branch; the internal variables may jump, and their derivatives with them."""
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    x = n[INTERNALS]
    changes = past(s, c.results + BY + n[PARAMETERS] + 2 + 2 * x)  # instead of derivatives
    for k in range(x):
        s[X + k] = y[n[X_AT] + k]
    call_switch(n[SWITCH], past(s, c.row), s, up, changes)
    for k in range(x):
        y[n[X_AT] + k] = s[X + k]
    wide = 1 + x + n[PARAMETERS]
    out = past(changes, x * wide)
    for j in range(p):
        own = c.directions[2 * j + 1] if c.directions[2 * j] == i else OWN_ETA
        for k in range(x):
            by = past(changes, k * wide)
            value = by[0] * c.strain[i * p + j]
            for m in range(x):
                value += by[1 + m] * y[c.base + (n[X_AT] + m) * p + j]
            if own < OWN_ETA:
                value += by[1 + x + own]
            out[k] = value
        for k in range(x):
            y[c.base + (n[X_AT] + k) * p + j] = out[k]


@cfunc(INSIDE, **OPTIONS, cache=True)
def _inside(words, task, i, up, y, f, quicker, out):  # type: ignore[no-untyped-def]
    """Do one task for a spring."""
    c = unpack(words)
    if task == PART:
        _part(c, i, y, out)
    elif task == FLOW:
        _flow(c, i, y, f, quicker)
    elif task == FRICTION:
        _friction(c, i, y, quicker, out)
    else:
        _jump(c, i, up, y)


INSIDE_AT = _inside.address
