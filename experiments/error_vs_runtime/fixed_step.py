"""Compiled fixed-step schemes, as one would write them by hand for the same scenes.

The law is that of `written_law`, as for SciPy's integrators. The branch is constant within a step
and updated at its end; the step is the sampling interval divided by an integer. Velocity Verlet
evaluates dashpots at the velocity predicted for the end of the step.
Sources: Hairer, Lubich & Wanner, Geometric Numerical Integration (2006), I.1 and II.1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from written_law import ETA, branch_at, equilibrate, first_branch, stress_on

VERLET, RK4 = range(2)
NAMES = ("velocity Verlet", "Runge-Kutta 4")

compiled = njit(cache=True, error_model="numpy")


# ---------------------------------------------------------------- an impact


@compiled
def _group(rows, branches, heights, i0, i1, u, rate, guess, freeze):
    """Return the stress of the springs i0 … i1-1 between two nodes.

    If there are several, they are massless and undamped, and equilibrium gives the common stress.
    """
    if i1 - i0 == 1:
        eps = u / heights[i0]
        if not freeze:
            branches[i0] = branch_at(rows[i0], branches[i0], eps)
        return stress_on(rows[i0], branches[i0], eps) + rows[i0, ETA] * rate / heights[i0]
    own = branches[i0:i1].copy() if freeze else branches[i0:i1]
    return equilibrate(rows[i0:i1], own, heights[i0:i1], u, guess)


@compiled
def _accelerate(rows, branches, heights, ends, mass, drag, w, v, freeze, group, acc):
    """Fill in accelerations (m/s²) and group stresses (Pa) at a state."""
    last = ends.size - 1
    i0 = 0
    for g in range(last + 1):
        below_w = w[g - 1] if g > 0 else 0.0
        below_v = v[g - 1] if g > 0 else 0.0
        group[g] = _group(
            rows, branches, heights, i0, ends[g], w[g] - below_w, v[g] - below_v, group[g], freeze
        )
        i0 = ends[g]
    for g in range(last + 1):
        above = group[g + 1] if g < last else -drag * v[g]
        acc[g] = (above - group[g]) / mass[g]


@compiled
def impact(rows, heights, ends, mass, drag, speed, t, substeps, scheme, out_w, out_s):
    """Integrate an impact over the samples t, in `substeps` steps between two samples.

    Fill in out_w (n,), the displacement of the striker, and out_s (n,), the base stress. Contact
    ends where the base stress, linear within the step, passes zero.
    """
    n = ends.size
    branches = np.empty(rows.shape[0], np.int64)
    for i in range(rows.shape[0]):
        branches[i] = first_branch(rows[i])
    w, v, acc, group = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    k = np.zeros((4, n))
    v[n - 1] = speed
    _accelerate(rows, branches, heights, ends, mass, drag, w, v, False, group, acc)
    out_w[0], out_s[0] = w[n - 1], group[0]
    pressed = group[0] > 0.0
    for j in range(1, t.size):
        h = (t[j] - t[j - 1]) / substeps
        for sub in range(substeps):
            base, top_w, top_v = group[0], w[n - 1], v[n - 1]
            if scheme == VERLET:
                for g in range(n):
                    k[0, g] = v[g] + 0.5 * h * acc[g]
                    w[g] += h * k[0, g]
                    v[g] += h * acc[g]
            else:
                for g in range(n):
                    k[0, g], k[1, g] = w[g], v[g]  # the start
                    k[2, g], k[3, g] = v[g], acc[g]  # sums of slopes
                    w[g] += 0.5 * h * v[g]
                    v[g] += 0.5 * h * acc[g]
                for stage in range(1, 4):
                    reach = h if stage == 2 else 0.5 * h
                    weight = 1.0 if stage == 3 else 2.0
                    _accelerate(rows, branches, heights, ends, mass, drag, w, v, True, group, acc)
                    for g in range(n):
                        k[2, g] += weight * v[g]
                        k[3, g] += weight * acc[g]
                        w[g] = k[0, g] + reach * v[g]
                        v[g] = k[1, g] + reach * acc[g]
                for g in range(n):
                    w[g] = k[0, g] + h / 6.0 * k[2, g]
                    v[g] = k[1, g] + h / 6.0 * k[3, g]
            _accelerate(rows, branches, heights, ends, mass, drag, w, v, False, group, acc)
            if scheme == VERLET:
                for g in range(n):
                    v[g] = k[0, g] + 0.5 * h * acc[g]
            if pressed and group[0] <= 0.0:
                part = base / (base - group[0])
                end = t[j - 1] + (sub + part) * h
                top_w += part * (w[n - 1] - top_w)
                top_v += part * (v[n - 1] - top_v)
                for rest in range(j, t.size):
                    out_s[rest] = 0.0
                    out_w[rest] = top_w + top_v * (t[rest] - end)
                return
            pressed = pressed or group[0] > 0.0
        out_w[j], out_s[j] = w[n - 1], group[0]
