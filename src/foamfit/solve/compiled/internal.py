"""What only springs of INTERNAL laws need: derivatives, jumps, the stress V.

The results of such a law are σ, V and the rates A, B of each internal variable, and their
derivatives, see `compiled.contract`.

The derivatives δx of internal variables need those of the strain rate. Where no state contains the
strain these are unknown, and u = δx - A δε is integrated instead, the derivatives at fixed strain:
du/dt = dε/dt (A_x u + A_p) + δB - A_x B δε. A spring with a stress V is the only one between two
nodes.
"""

from __future__ import annotations

from foamfit.solve.compiled import motion
from foamfit.solve.compiled.motion import evaluate
from foamfit.solve.compiled.run import numbers, spring, working
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import ALONG_A, ALONG_B, BY_RATE, inner, past
from foamfit.springs.laws.record import OWN_ETA


@contract.inlined
def toward(c, i, j):
    """Return the derivatives of σ, V, A and B at fixed strain in a direction, and its dx."""
    n, x = numbers(c, i), numbers(c, i).internals
    changes = contract.changes_of(spring(c, i).by, x)
    return past(changes, (x + 1) * (1 + x + n.parameters) + j * (2 + 3 * x))


@inner
def direct(c, i, change, own, out):
    """Fill the derivatives of σ, V, A and B by dx and, unless negative, parameter `own`."""
    s, law, want = spring(c, i), numbers(c, i).evaluate, contract.DIRECTION
    contract.call_evaluate(law, past(s, c.row), s, s.point, change, own, want, out)


@inner
def _path(c, i):
    """Fill dσ/dε along the path of the internal variables, and what their rates B add to dT/dt."""
    s, values, size = spring(c, i), spring(c, i).by, 2 + 2 * numbers(c, i).internals
    s.tangent = s.slope + values[ALONG_A * size]
    s.drift = c.drive.pace * s.gain * values[ALONG_B * size]


@inner
def _part(c, i, y, part):
    """Fill the derivatives at fixed strain, by direction, and those of the stress."""
    n, p, x = numbers(c, i), c.p, numbers(c, i).internals
    for j in range(p):
        out = toward(c, i, j)
        change, own = past(out, 2 + 2 * x), c.owned[i * p + j]
        for k in range(x):
            change[k] = y[c.base + (n.x_at + k) * p + j]
        direct(c, i, change, own if own < OWN_ETA else -1, out)
        part[j] = out[0]


@inner
def _flow(c, i, f, quicker):
    """Fill the rates of the derivatives of the internal variables."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    x, values, strain = n.internals, spring(c, i).by, past(c.strain, i * p)
    size, rate, pace, fixed = 2 + 2 * x, s.rate, c.drive.pace, n.fixed
    by, by_a, by_b = past(values, size), past(values, ALONG_A * size), past(values, ALONG_B * size)
    for k in range(x):
        a, b = 2 + k, 2 + x + k
        at, by_strain = c.base + (n.x_at + k) * p, pace * by[b]
        if fixed:
            by_strain += pace * (by_a[b] - by_b[a])
        else:
            by_strain += rate * by[a]
        for j in range(p):
            out = toward(c, i, j)
            f[at + j] = by_strain * strain[j] + rate * out[a] + pace * out[b]
            if not fixed:
                f[at + j] += values[a] * quicker[j]


@inner
def _friction(c, i, quicker, out):
    """Add the derivatives of the stress V."""
    values, size, p = spring(c, i).by, 2 + 2 * numbers(c, i).internals, c.p
    strain, by_strain, by_rate = past(c.strain, i * p), values[size + 1], values[BY_RATE * size]
    for j in range(p):
        by_x = toward(c, i, j)[1]
        out[j] += c.drive.pace * (by_strain * strain[j] + by_rate * quicker[j] + by_x)


@inner
def _jump(c, i, up, y):
    """Change the branch; the internal variables may jump, and their derivatives with them.

    Their rates may jump too, so that the delay of the instant of the change counts.
    """
    s, n, p = spring(c, i), numbers(c, i), c.p
    x, pace = n.internals, c.drive.pace
    changes, first = contract.changes_of(spring(c, i).by, x), past(spring(c, i).by, 2)  # A, then B
    for k in range(x):
        s.xs[k] = y[n.x_at + k]
    contract.call_switch(n.switch, past(s, c.row), s, up, changes)
    for k in range(x):
        y[n.x_at + k] = s.xs[k]
    if p == 0:
        return
    wide = 1 + x + n.parameters
    end, out = past(changes, x * wide), past(changes, (x + 1) * wide)
    faster = s.rate * (1.0 - end[0])  # of the strain past the end
    for k in range(x):
        faster -= end[1 + k] * (s.rate * first[k] + pace * first[x + k])
    delays = past(c.common, (c.groups + 1) * p)
    for j in range(p):
        strain, late = c.strain[i * p + j], 0.0
        own = c.owned[i * p + j]
        for k in range(x + 1):  # of the end, then of the internal variables at the instant
            by = end if k == 0 else past(changes, (k - 1) * wide)
            value = by[0] * (strain + s.rate * late if k > 0 else strain)
            for m in range(x):
                d_x = y[c.base + (n.x_at + m) * p + j] + (first[m] * strain if n.fixed else 0.0)
                if k > 0:
                    d_x += (s.rate * first[m] + pace * first[x + m]) * late
                value += by[1 + m] * d_x
            if 0 <= own < OWN_ETA:
                value += by[1 + x + own]
            if k == 0:
                late = (value - strain) / faster if faster != 0.0 else 0.0
            else:
                out[k - 1] = value
        delays[j] = late
        for k in range(x):
            y[c.base + (n.x_at + k) * p + j] = out[k]
    evaluate(c, i, c.none)  # on the next branch
    for j in range(p):
        strain = c.strain[i * p + j] if n.fixed else 0.0
        for k in range(x):
            moved = first[k] * (strain + s.rate * delays[j]) + pace * first[x + k] * delays[j]
            y[c.base + (n.x_at + k) * p + j] -= moved


@working
def inside_task(c, task, i, up, y, f, quicker, out):
    """Do one task for a spring."""
    if task == motion.PART:
        _part(c, i, y, out)
    elif task == motion.FLOW:
        _flow(c, i, f, quicker)
    elif task == motion.FRICTION:
        _friction(c, i, quicker, out)
    elif task == motion.PATH:
        _path(c, i)
    else:
        _jump(c, i, up, y)
