"""The compiled integrator of an impact on many undamped, massless springs, treated as one spring.

Such springs carry one stress S, and the strain of each on its branch is known in closed form. Their
total elongation is therefore a function of the stress alone,

    w = F(S) = Σ h_i ε_i(S),        μ w'' = -S - drag w',

analytic up to the nearest pole of a curved branch (-k). Its Taylor polynomial about an anchor
stress represents all springs. A switch of one spring replaces the terms of that spring only, at a
cost independent of the length of the chain; the full sum is recomputed only where the stress leaves
the range of the polynomial. The next spring to switch is found in a binary tree of the switching
stresses. The cost of a run grows little faster than the number of springs, where following every
spring through every step would cost the square of that number.

In time, a step is a Taylor series too, obtained by inserting the powers of the series of S into the
polynomial. It is regular at the turning point of the motion and with any damping of the top.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from foamfit.arrays import Array
from foamfit.solve import scene as scenes
from foamfit.solve.polynomial import (
    LEAST_TRUNCATION,
    fill_values,
    first_crossing,
    order_for,
    value_at,
)
from foamfit.springs.compiled.bistable import A, C, D, E

# With arrays that are made inside, which count references.
_OPTIONS = {"error_model": "numpy", "fastmath": {"contract"}}
inner = njit(**_OPTIONS, no_cpython_wrapper=True, no_cfunc_wrapper=True)
# Columns of the shape of a branch: 1 if curved, slope k, origins of strain and stress, stresses at
# its ends.
CURVED, SLOPE, ORIGIN, OFFSET, FIRST, LAST, SHAPE = range(7)
DEGREE = 16  # of the polynomial of the elongation
# Range of the polynomial about its anchor, as a share of the distance to the nearest pole. The
# relative truncation error of the elongation is below 0.125**17 < 1e-15.
REACH = 0.125
CLOSE = 1e-13  # relative difference of switching stresses below which springs switch together
GUESS = 3  # order of the series that estimates the time of the next event
# Columns of `Group.place`.
ANCHOR, UNIT, LEAST, N_PLACE = range(4)


class Group(NamedTuple):
    """Springs in series under one stress.

    `upper` and `lower` are binary trees: the second half of the array holds the leaves, every entry
    before is the lesser of its two children, and entry 1 is the least of all.
    """

    shapes: Array  #: of the four branches, (springs, 4, SHAPE)
    heights: Array
    branches: Array  #: current branches
    upper: Array  #: stresses at which the springs leave their branches upwards
    lower: Array  #: negative stresses at which they leave them downwards
    sum: Array  #: elongation as a polynomial of (S - anchor)/unit, (DEGREE + 1,)
    place: Array  #: anchor and unit, Pa, and the least initial slope k of a branch


class Step(NamedTuple):
    """Series in time of a step; order 0 is the state."""

    s: Array  #: stress
    w: Array  #: displacement of the top
    v: Array  #: velocity of the top
    powers: Array  #: powers of the series of (S - S(0))/unit, (order + 1, order + 1)
    shifted: Array  #: polynomial of the elongation about S(0), (DEGREE + 1,)


def shapes_of(plan: Any, rows: Array) -> Array | None:
    """Return the shapes of the branches, (springs, 4, SHAPE); None if an aggregate cannot hold.

    It holds undamped bistable and linear springs without flat branches and gaps.
    """
    from foamfit.springs.compiled.bistable import (
        EPS_A,
        EPS_C,
        EPS_HAT_A,
        EPS_HAT_C,
        TABLE,
        TO_STRESS,
        WIDE,
    )  # fmt: skip

    own, out = rows[:, 1 + 2 * plan.terms :], np.zeros((len(rows), 4, SHAPE))
    out[:, :, FIRST], out[:, :, LAST] = -math.inf, math.inf
    bistable = np.array([len(one.slopes) == 3 for one in plan.laws.made])
    known = np.array([one.columns == 2 for one in plan.laws.made]) | bistable
    if not known.all() or rows[:, 0].any() or plan.laws.loose or plan.terms:
        return None
    out[~bistable, :, SLOPE] = own[~bistable, :1]
    for branch in range(4):
        lines = own[bistable, TABLE + branch * WIDE :]
        out[bistable, branch, CURVED] = float(branch in (A, C))
        out[bistable, branch, SLOPE : OFFSET + 1] = lines[:, :3]
    ends = {A: (None, EPS_A), D: (EPS_A, EPS_HAT_C), C: (EPS_C, None), E: (EPS_HAT_A, EPS_C)}
    for branch, (low, high) in ends.items():
        for column, end in ((FIRST, low), (LAST, high)):
            if end is not None:
                out[bistable, branch, column] = own[bistable, TO_STRESS + end]
    return out if (out[:, :, SLOPE] > 0.0).all() else None


@inner
def above(branch):  # type: ignore[no-untyped-def]
    """Return the branch that a spring enters when it leaves `branch` upwards."""
    return D if branch == A else C


@inner
def below(branch):  # type: ignore[no-untyped-def]
    """Return the branch that a spring enters when it leaves `branch` downwards."""
    return E if branch == C else A


@inner
def first_past(t, first, end, last):  # type: ignore[no-untyped-def]
    """Return the first sample from `first` on at or after `end`; strictly after it if `last`."""
    while first < t.size and (t[first] < end or (last and t[first] == end)):
        first += 1
    return first


# ---------------------------------------------------------------- the aggregate


@inner
def _set(tree: Array, i: int, value: float) -> None:
    """Set a leaf of a tree (see `Group`) and update the nodes above it."""
    at = tree.size // 2 + i
    tree[at] = value
    while at > 1:
        at //= 2
        tree[at] = min(tree[2 * at], tree[2 * at + 1])


@inner
def _enter(group: Group, i: int, branch: int) -> None:
    """Put a spring on a branch."""
    group.branches[i] = branch
    low, high = group.shapes[i, branch, FIRST], group.shapes[i, branch, LAST]
    _set(group.upper, i, high)
    _set(group.lower, i, -low)


@inner
def _add(group: Group, i: int, share: float) -> None:
    """Add a share (1 or -1) of a spring's elongation to the sum.

    On a curved branch ε = x0 + 1 - k/(k + S), a geometric series.
    """
    shape = group.shapes[i, group.branches[i]]
    curved, k, x0, s0 = shape[CURVED] > 0.0, shape[SLOPE], shape[ORIGIN], shape[OFFSET]
    anchor, unit, height = group.place[ANCHOR], group.place[UNIT], share * group.heights[i]
    if not curved:
        group.sum[0] += height * (x0 + (anchor - s0) / k)
        group.sum[1] += height * unit / k
        return
    ratio = unit / (k + anchor)
    group.sum[0] += height * (x0 + anchor / (k + anchor))
    term = height * k / (k + anchor) * ratio
    for m in range(1, DEGREE + 1):
        group.sum[m] += term
        term *= -ratio


@inner
def _anchor(group: Group, stress: float, rising: bool) -> None:
    """Recompute the sum about an anchor ahead of the stress, which stays within its reach."""
    least = group.place[LEAST]
    ahead = REACH if rising else -REACH
    group.place[ANCHOR] = (stress + ahead * least) / (1.0 - ahead)
    group.place[UNIT] = least + group.place[ANCHOR]
    for m in range(DEGREE + 1):
        group.sum[m] = 0.0
    for i in range(group.heights.size):
        _add(group, i, 1.0)


@inner
def _make_group(shapes: Array, heights: Array) -> Group:
    """Return the group of springs at zero stress, each on its first branch."""
    count, leaves = heights.size, 1
    while leaves < count:
        leaves *= 2
    group = Group(
        shapes, heights, np.zeros(count, np.int64), np.full(2 * leaves, math.inf),
        np.full(2 * leaves, math.inf), np.zeros(DEGREE + 1), np.zeros(N_PLACE),
    )  # fmt: skip
    least = math.inf
    for i in range(count):
        _enter(group, i, A)
        for branch in range(4):
            if shapes[i, branch, CURVED] > 0.0 or shapes[i, branch, LAST] == math.inf:
                least = min(least, shapes[i, branch, SLOPE])
    group.place[LEAST] = least
    _anchor(group, 0.0, least > 0.0)  # a literal would be another type
    return group


@inner
def _strain(group: Group, i: int, stress: float) -> float:
    """Return the strain of a spring on its branch."""
    shape = group.shapes[i, group.branches[i]]
    curved, k, x0, s0 = shape[CURVED] > 0.0, shape[SLOPE], shape[ORIGIN], shape[OFFSET]
    return x0 + (stress / (k + stress) if curved else (stress - s0) / k)


@inner
def _switch(
    group: Group, stress: float, rising: bool, now: float, log: Array, switches: int
) -> int:
    """Switch all springs that leave their branch at this stress; return the number of switches."""
    tree = group.upper if rising else group.lower
    met = (stress if rising else -stress) + CLOSE * abs(stress)
    while tree[1] <= met:
        i = 1  # descend to the least leaf
        while i < tree.size // 2:
            i = 2 * i if tree[2 * i] == tree[i] else 2 * i + 1
        i -= tree.size // 2
        left = group.branches[i]
        entered = above(left) if rising else below(left)
        strain = _strain(group, i, stress)
        if switches < log.shape[0]:
            log[switches, 0], log[switches, 1], log[switches, 2] = now, i, left
            log[switches, 3], log[switches, 4] = entered, strain
        switches += 1
        _add(group, i, -1.0)
        _enter(group, i, entered)
        _add(group, i, 1.0)
    return switches


# ---------------------------------------------------------------- a step in time


@inner
def _next_order(group: Group, now: Step, n: int, mass: float, drag: float) -> None:
    """Compute the coefficients n > 0 of a step from the lower ones.

    The stress follows from w_n = Σ_m g_m [S^m]_n, where its coefficient n appears only with g_1.
    """
    g, x = now.shifted, now.powers
    now.w[n] = now.v[n - 1] / n
    now.v[n] = -(now.s[n - 1] + drag * now.v[n - 1]) / (mass * n)
    step = (now.s[0] - group.place[ANCHOR]) / group.place[UNIT]
    for m in range(DEGREE - 1, n - 1, -1):  # one more pass of Horner's shift
        g[m] += step * g[m + 1]
    rest = now.w[n]
    for m in range(2, n + 1):
        power = 0.0
        for j in range(1, n - m + 2):
            power += x[1, j] * x[m - 1, n - j]
        x[m, n] = power
        rest -= g[m] * power
    x[1, n] = rest / g[1]
    now.s[n] = x[1, n] * group.place[UNIT]


@inner
def _longest(c: Array, n: int, limit: float, span: float) -> float:
    """Return the longest step within `span` with terms n - 1 and n of a series below a limit."""
    for m in (n - 1, n):
        if abs(c[m]) * span**m > limit:
            span = (limit / abs(c[m])) ** (1.0 / m)
    return span


@inner
def _expand(
    group: Group,
    now: Step,
    mass: float,
    drag: float,
    low: float,
    high: float,
    span: float,
    s_limit: float,
    w_limit: float,
) -> tuple[int, float]:
    """Expand a step until its terms fall below the limits; return the order and longest step.

    The lowest orders estimate the time of the next event; the step extends a little beyond it.
    """
    step = (now.s[0] - group.place[ANCHOR]) / group.place[UNIT]
    now.shifted[DEGREE] = group.sum[DEGREE]
    for m in range(DEGREE - 1, -1, -1):
        now.shifted[m] = group.sum[m] + step * now.shifted[m + 1]
    now.w[0] = now.shifted[0]
    most = now.s.size - 1
    n = min(GUESS, most)
    for m in range(1, n + 1):
        _next_order(group, now, m, mass, drag)
    span = min(1.02 * first_crossing(now.s, n, low, high, span)[0], span)
    while n < most:
        fine = _longest(now.s, n, s_limit, span) == span
        if fine and _longest(now.w, n, w_limit, span) == span:
            break
        n += 1
        _next_order(group, now, n, mass, drag)
    return n, _longest(now.w, n, w_limit, _longest(now.s, n, s_limit, span))


@inner
def _sample(
    group: Group, now: Step, order: int, t: Array, first: int, last: int, begin: float,
    curves: Array
) -> None:  # fmt: skip
    """Write base stress and displacements at samples first … last-1 of a step."""
    if first == last:
        return
    fill_values(now.s, order, t, first, last, begin, curves[0])
    if curves.shape[0] == 2:
        fill_values(now.w, order, t, first, last, begin, curves[1])
        return
    for j in range(first, last):
        _shape(group, curves[0, j], curves[1:, j])


@inner
def _shape(group: Group, stress: float, nodes: Array) -> None:
    """Write the displacement above each spring, or of the top only."""
    place = 0.0
    for i in range(group.heights.size):
        place += group.heights[i] * _strain(group, i, stress)
        nodes[min(i, nodes.size - 1)] = place


@njit(**_OPTIONS, no_cfunc_wrapper=True, cache=True)
def integrate_aggregate(shapes, heights, numbers, t, max_steps, curves, log, effort):  # type: ignore[no-untyped-def]
    """Integrate an impact on springs of these shapes, without masses between them.

    `numbers`: areal mass, drag, speed, tolerance. `curves` (1 + nodes, n) become base stress and
    displacements. Return outcome, end of contact, steps and switches. The numbers of sums over all
    springs and of orders of all steps are added to `effort` (2,).
    """
    mass, drag, speed, tol = numbers[0], numbers[1], numbers[2], numbers[3]
    tol = max(tol, LEAST_TRUNCATION)
    count, group, order = heights.size, _make_group(shapes, heights), order_for(tol, DEGREE)
    now = Step(
        np.zeros(order + 1), np.zeros(order + 1), np.zeros(order + 1),
        np.zeros((order + 1, order + 1)), np.zeros(DEGREE + 1),
    )  # fmt: skip
    compliance = group.sum[1] / group.place[UNIT]
    w_scale = speed * math.sqrt(mass * compliance)  # lower bounds of the ranges
    if drag > 0.0:
        w_scale = min(w_scale, speed * mass / drag)
    s_scale = min(w_scale / compliance, group.upper[1])
    w_scale = s_scale * compliance
    effort[0] += 1
    done = first_past(t, 0, 0.0, False)
    for j in range(done):
        for i in range(curves.shape[0]):
            curves[i, j] = 0.0
        curves[curves.shape[0] - 1, j] = speed * t[j]
    begin, switches, stalled, horizon = 0.0, 0, 0, t[t.size - 1]
    now.v[0] = speed
    for step in range(max_steps):
        if done == t.size:
            return scenes.DONE, math.nan, step, switches
        reach = REACH * group.place[UNIT]
        high = min(group.upper[1], group.place[ANCHOR] + reach)
        low = max(-group.lower[1], group.place[ANCHOR] - reach, 0.0)
        n, span = _expand(
            group, now, mass, drag, low, high, horizon - begin, tol * s_scale, tol * w_scale
        )
        effort[1] += n
        if not math.isfinite(span) or not math.isfinite(now.s[n]):
            return scenes.NOT_FINITE, begin, step, switches
        span, side = first_crossing(now.s, n, low, high, span)
        end = begin + span
        stalled = stalled + 1 if end <= begin else 0
        if stalled > 4 * count + 8:
            return scenes.STEP_UNDERFLOW, begin, step, switches
        last = end >= horizon and side == 0
        first, done = done, first_past(t, done, horizon if last else end, last)
        _sample(group, now, n, t, first, done, begin, curves)
        begin = end
        stress, velocity = value_at(now.s, n, span), value_at(now.v, n, span)
        if side > 0:
            stress = max(high, now.s[0])
        elif side < 0:
            stress = min(low, now.s[0])
        now.s[0], now.v[0] = stress, velocity
        if side < 0 and stress <= 0.0:
            w_end = np.zeros(curves.shape[0] - 1)
            _shape(group, 0.0, w_end)
            for j in range(done, t.size):
                curves[0, j] = 0.0
                for i in range(w_end.size):
                    curves[1 + i, j] = w_end[i] + velocity * (t[j] - begin)
            return scenes.DONE, begin, step + 1, switches
        s_scale = max(s_scale, stress)
        w_scale = max(w_scale, now.w[0])
        if side != 0:
            switches = _switch(group, stress, side > 0, begin, log, switches)
            if abs(stress - group.place[ANCHOR]) >= reach * (1.0 - 1e-12):
                _anchor(group, stress, side > 0)
                effort[0] += 1
    return scenes.TOO_MANY_STEPS, begin, max_steps, switches
