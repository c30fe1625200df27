"""Fixed-step schemes, compiled: what one would write by hand for the same scenes.

The law is the project's own (`springs.kernels`), so that only the integration differs. A branch is
frozen within a step and brought up to date at its end; the step is the sampling interval over a
whole number. Velocity Verlet takes dashpots at the velocity predicted for the end of the step;
the implicit midpoint rule is solved by Newton's method with the tridiagonal Jacobian.
Sources: Hairer, Lubich & Wanner, Geometric Numerical Integration (2006), I.1 and II.1.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from foamfit.springs.equilibrium import Group, equilibrate
from foamfit.springs.kernels import (
    ETA,
    branch_at_strain,
    first_branch,
    slope_on,
    strain_on,
    stress_on,
)

VERLET, RK4, MIDPOINT, HEUN = range(4)
NAMES = ("velocity Verlet", "Runge-Kutta 4", "implicit midpoint", "Heun")

compiled = njit(cache=True, error_model="numpy")


# ---------------------------------------------------------------- an impact


@compiled
def _group(rows, branches, heights, i0, i1, u, rate, guess, freeze):
    """Stress of the springs i0 … i1-1 between two nodes, and its derivatives by u and rate.

    Several springs are massless and undamped: their common stress follows from equilibrium.
    """
    if i1 - i0 == 1:
        eps = u / heights[i0]
        eta = rows[i0, ETA]
        if not freeze:
            branches[i0] = branch_at_strain(rows[i0], branches[i0], eps)
        stress = stress_on(rows[i0], branches[i0], eps) + eta * rate / heights[i0]
        return stress, slope_on(rows[i0], branches[i0], eps) / heights[i0], eta / heights[i0]
    own = branches[i0:i1].copy() if freeze else branches[i0:i1]
    eps = np.empty(i1 - i0)
    none = np.zeros((i1 - i0, 2))  # no spring keeps a rank
    stress = equilibrate(Group(rows[i0:i1], own, none, heights[i0:i1]), u, guess, eps)
    soft = 0.0
    for i in range(i0, i1):
        soft += heights[i] / slope_on(rows[i], own[i - i0], eps[i - i0])
    return stress, 1.0 / soft, 0.0


@compiled
def _accelerate(rows, branches, heights, ends, mass, drag, w, v, freeze, group, by_w, by_v, acc):
    """Fill accelerations (m/s²), group stresses (Pa) and their derivatives at a state."""
    last = ends.size - 1
    i0 = 0
    for g in range(last + 1):
        below_w = w[g - 1] if g > 0 else 0.0
        below_v = v[g - 1] if g > 0 else 0.0
        group[g], by_w[g], by_v[g] = _group(
            rows, branches, heights, i0, ends[g], w[g] - below_w, v[g] - below_v, group[g], freeze
        )
        i0 = ends[g]
    for g in range(last + 1):
        above = group[g + 1] if g < last else -drag * v[g]
        acc[g] = (above - group[g]) / mass[g]


@compiled
def _solve_tridiagonal(low, main, high, x):
    """Thomas' algorithm; x holds the right-hand side and receives the solution."""
    n = x.size
    for i in range(1, n):
        part = low[i] / main[i - 1]
        main[i] -= part * high[i - 1]
        x[i] -= part * x[i - 1]
    x[n - 1] /= main[n - 1]
    for i in range(n - 2, -1, -1):
        x[i] = (x[i] - high[i] * x[i + 1]) / main[i]


@compiled
def _midpoint(rows, branches, heights, ends, mass, drag, w, v, h, group, by_w, by_v, acc, work):
    """One implicit midpoint step: Newton's method for the displacements in the middle."""
    n = w.size
    half = 0.5 * h
    w_mid, v_mid, low, main, high, miss = work[0], work[1], work[2], work[3], work[4], work[5]
    for g in range(n):
        w_mid[g] = w[g] + half * v[g] + half * half * acc[g]
    for _ in range(20):
        for g in range(n):
            v_mid[g] = (w_mid[g] - w[g]) / half
        _accelerate(
            rows, branches, heights, ends, mass, drag, w_mid, v_mid, True, group, by_w, by_v, acc
        )
        size = 0.0
        for g in range(n):
            miss[g] = v[g] + half * acc[g] - v_mid[g]
            stiff = by_w[g] + by_v[g] / half
            above = by_w[g + 1] + by_v[g + 1] / half if g < n - 1 else drag / half
            main[g] = 1.0 / half + half * (stiff + above) / mass[g]
            low[g] = -half * stiff / mass[g]
            high[g] = -half * above / mass[g]
        _solve_tridiagonal(low, main, high, miss)
        for g in range(n):
            w_mid[g] += miss[g]
            size = max(size, abs(miss[g]) / (abs(w_mid[g]) + 1e-12))
        if size < 1e-13:
            break
    for g in range(n):
        v[g] += h * acc[g]
        w[g] = 2.0 * w_mid[g] - w[g]


@compiled
def impact(rows, heights, ends, mass, drag, speed, t, substeps, scheme, out_w, out_s):
    """Integrate an impact over the samples t, in `substeps` steps between two samples.

    Fills out_w (n,), the displacement of the striker, and out_s (n,), the base stress. The end of
    contact is where the base stress, straight within its step, passes zero.
    """
    n = ends.size
    branches = np.empty(rows.shape[0], np.int64)
    for i in range(rows.shape[0]):
        branches[i] = first_branch(rows[i])
    w, v, acc = np.zeros(n), np.zeros(n), np.zeros(n)
    group, by_w, by_v = np.zeros(n), np.zeros(n), np.zeros(n)
    k, work = np.zeros((4, n)), np.zeros((6, n))
    v[n - 1] = speed
    _accelerate(rows, branches, heights, ends, mass, drag, w, v, False, group, by_w, by_v, acc)
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
            elif scheme == RK4:
                for g in range(n):
                    k[0, g], k[1, g] = w[g], v[g]  # the start
                    k[2, g], k[3, g] = v[g], acc[g]  # sums of slopes
                    w[g] += 0.5 * h * v[g]
                    v[g] += 0.5 * h * acc[g]
                for stage in range(1, 4):
                    reach = h if stage == 2 else 0.5 * h
                    weight = 1.0 if stage == 3 else 2.0
                    _accelerate(
                        rows, branches, heights, ends, mass, drag, w, v, True,
                        group, by_w, by_v, acc,
                    )  # fmt: skip
                    for g in range(n):
                        k[2, g] += weight * v[g]
                        k[3, g] += weight * acc[g]
                        w[g] = k[0, g] + reach * v[g]
                        v[g] = k[1, g] + reach * acc[g]
                for g in range(n):
                    w[g] = k[0, g] + h / 6.0 * k[2, g]
                    v[g] = k[1, g] + h / 6.0 * k[3, g]
            else:
                _midpoint(
                    rows, branches, heights, ends, mass, drag, w, v, h,
                    group, by_w, by_v, acc, work,
                )  # fmt: skip
            _accelerate(
                rows, branches, heights, ends, mass, drag, w, v, False, group, by_w, by_v, acc
            )
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


# ---------------------------------------------------------------- one spring without inertia


@compiled
def _slope(row, branch, eps, by_stress):
    return 1.0 / slope_on(row, branch, eps) if by_stress else slope_on(row, branch, eps)


@compiled
def quasi_static(row, driven, by_stress, substeps, scheme, out):
    """One undamped spring along a history of strain, or of stress, in rate form.

    dσ = k(ε) dε along a strain history, dε = dσ/k(ε) along a stress history; fills `out` (n,) with
    the other quantity. Nothing has inertia, so Heun's rule stands in for velocity Verlet.
    """
    branch = first_branch(row)
    start = strain_on(row, branch, driven[0]) if by_stress else driven[0]
    y = start if by_stress else stress_on(row, branch, start)
    out[0] = y
    for j in range(1, driven.size):
        h = (driven[j] - driven[j - 1]) / substeps
        for sub in range(substeps):
            x = driven[j - 1] + sub * h
            here, mid, end = (y, y, y) if by_stress else (x, x + 0.5 * h, x + h)
            first = _slope(row, branch, here, by_stress)
            if scheme == HEUN:
                if by_stress:
                    end = y + h * first
                y += 0.5 * h * (first + _slope(row, branch, end, by_stress))
            elif scheme == RK4:
                if by_stress:
                    mid = y + 0.5 * h * first
                second = _slope(row, branch, mid, by_stress)
                if by_stress:
                    mid = y + 0.5 * h * second
                third = _slope(row, branch, mid, by_stress)
                if by_stress:
                    end = y + h * third
                fourth = _slope(row, branch, end, by_stress)
                y += h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
            else:
                rate = first
                for _ in range(50 if by_stress else 1):
                    if by_stress:
                        mid = y + 0.5 * h * rate
                    before = rate
                    rate = _slope(row, branch, mid, by_stress)
                    if math.fabs(rate - before) <= 1e-15 * math.fabs(rate):
                        break
                y += h * rate
            branch = branch_at_strain(row, branch, y if by_stress else x + h)
        out[j] = y
