"""The compiled integrator of an impact on many undamped, massless springs: as one spring.

Such springs carry one stress S, and on its branch the strain of each is known in closed form. Their
common elongation is therefore a function of the stress alone,

    w = F(S) = Σ h_i ε_i(S),        μ w'' = -S - drag w',

analytic as far as the nearest pole of a curved branch (-k). Its Taylor polynomial about an anchor
stress stands for all springs: a spring that switches takes its terms out and puts others in, which
costs the same in a chain of ten springs and of a thousand. The whole sum is made anew only where
the stress nears the end of the polynomial's reach. The next spring to switch is found in a
binary tree of the switching stresses. So a run costs little more than in proportion to its springs,
where following every spring through every step costs their number squared.

In time a step is a Taylor series again, with powers of the series of S put into the polynomial.
It goes regularly through the turning point of the motion and through any damping of the top.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve import scene as scenes
from foamfit.solve.polynomial import (
    LEAST_TRUNCATION,
    fill_values,
    first_crossing,
    order_for,
    value_at,
)
from foamfit.solve.scene import Scene, SceneTuple, before_contact, first_past, fly, log_switch
from foamfit.springs.kernels import (
    ETA,
    K0,
    KC,
    KH_MINUS,
    KH_PLUS,
    KIND,
    OF_STRESS,
    Array,
    Branches,
    above,
    below,
    branch_shape,
    compiled,
    first_branch,
    inner,
    interval,
    maker,
)
from foamfit.springs.law import BISTABLE, UNILATERAL

# Degree of the polynomial of the elongation, and how far from its anchor it is used, in distances
# to the nearest pole: what it leaves out is below 0.125**17 < 1e-15 of the elongation.
DEGREE, REACH = 16, 0.125
# Springs whose switching stresses differ by less than this share switch together.
CLOSE = 1e-13
# Orders by which the time of the next event is guessed.
GUESS = 3
# Columns of `Group.place`.
ANCHOR, UNIT, LEAST, N_PLACE = range(4)


class Group(NamedTuple):
    """Springs in series under one stress, on the branches that they are on.

    The second halves of `upper` and `lower` hold the stresses at which each spring leaves its
    branch upwards and, negative, downwards; every entry before is the lesser of its two children:
    the first is the next. `sum` (DEGREE + 1,) is the elongation as a polynomial of (S -
    anchor)/unit, with both, Pa, in `place`, and the least first slope of a branch.
    """

    rows: Array
    heights: Array
    branches: Branches
    upper: Array
    lower: Array
    sum: Array
    place: Array


class Step(NamedTuple):
    """Series in time of stress s, displacement w and velocity v of the top; order 0 is the state.

    `powers` (order + 1, order + 1) are those of the series of (S - S(0))/unit, `shifted` (DEGREE +
    1,) is the polynomial of the elongation about S(0).
    """

    s: Array
    w: Array
    v: Array
    powers: Array
    shifted: Array


@compiled
def holds(rows: Array) -> bool:
    """Whether every spring has one strain at each stress on its branch, and no dashpot."""
    for i in range(rows.shape[0]):
        if rows[i, ETA] > 0.0 or rows[i, KIND] == UNILATERAL:
            return False
        if rows[i, KIND] == BISTABLE and not (rows[i, KH_PLUS] > 0.0 and rows[i, KH_MINUS] > 0.0):
            return False
    return True


# ---------------------------------------------------------------- the springs as one


@inner
def _set(tree: Array, i: int, value: float) -> None:
    """Set a leaf of a tree in which every node is the lesser of its children."""
    at = tree.size // 2 + i
    tree[at] = value
    while at > 1:
        at //= 2
        tree[at] = min(tree[2 * at], tree[2 * at + 1])


@inner
def _enter(group: Group, i: int, branch: int) -> None:
    """Put a spring on a branch."""
    group.branches[i] = branch
    low, high = interval(group.rows[i], branch, OF_STRESS)
    _set(group.upper, i, high)
    _set(group.lower, i, -low)


@inner
def _add(group: Group, i: int, share: float) -> None:
    """Add a share (1 or -1) of a spring's elongation to the sum.

    On a curved branch ε = x0 + 1 - k/(k + S), a geometric series.
    """
    curved, k, x0, s0 = branch_shape(group.rows[i], group.branches[i])
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
    """Make the sum anew about an anchor ahead of the stress, which is then within its reach."""
    least = group.place[LEAST]
    ahead = REACH if rising else -REACH
    group.place[ANCHOR] = (stress + ahead * least) / (1.0 - ahead)
    group.place[UNIT] = least + group.place[ANCHOR]
    for m in range(DEGREE + 1):
        group.sum[m] = 0.0
    for i in range(group.heights.size):
        _add(group, i, 1.0)


@maker
def _make_group(rows: Array, heights: Array) -> Group:
    """Springs as one, all on their first branches, free of stress."""
    count, leaves = heights.size, 1
    while leaves < count:
        leaves *= 2
    group = Group(
        rows, heights, np.zeros(count, np.int64), np.full(2 * leaves, math.inf),
        np.full(2 * leaves, math.inf), np.zeros(DEGREE + 1), np.zeros(N_PLACE),
    )  # fmt: skip
    least = math.inf
    for i in range(rows.shape[0]):
        _enter(group, i, first_branch(rows[i]))
        least = min(least, rows[i, K0])
        if rows[i, KIND] == BISTABLE:
            least = min(least, rows[i, KC])
    group.place[LEAST] = least
    _anchor(group, 0.0, least > 0.0)  # not the literal, which is a type
    return group


@inner
def _strain(group: Group, i: int, stress: float) -> float:
    """Strain of a spring on its branch."""
    curved, k, x0, s0 = branch_shape(group.rows[i], group.branches[i])
    return x0 + (stress / (k + stress) if curved else (stress - s0) / k)


@inner
def _switch(
    group: Group, stress: float, rising: bool, now: float, log: Array, switches: int
) -> int:
    """Change the branches of all springs that leave theirs at this stress; counts them."""
    tree = group.upper if rising else group.lower
    met = (stress if rising else -stress) + CLOSE * abs(stress)
    while tree[1] <= met:
        i = 1  # the leaf that is the least
        while i < tree.size // 2:
            i = 2 * i if tree[2 * i] == tree[i] else 2 * i + 1
        i -= tree.size // 2
        left = group.branches[i]
        entered = above(left) if rising else below(left)
        strain = _strain(group, i, stress)
        switches = log_switch(log, switches, now, i, left, entered, strain)
        _add(group, i, -1.0)
        _enter(group, i, entered)
        _add(group, i, 1.0)
    return switches


# ---------------------------------------------------------------- a step in time


@inner
def _next_order(group: Group, now: Step, n: int, mass: float, drag: float) -> None:
    """Find the coefficients n > 0 of a step from the lower ones.

    The stress follows from w_n = Σ_m g_m [S^m]_n, in which its own coefficient stands with g_1
    alone.
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
    """Step within `span` at which the terms n - 1 and n of a series are below a limit."""
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
    """Expand a step until its terms fall below the limits: orders found, and the longest step.

    The first orders estimate the next event; the step is a little longer than that.
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
    """Write base stress and displacements at the samples first … last-1 of a step."""
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
    """Write the displacement above each spring, or of the top alone."""
    place = 0.0
    for i in range(group.heights.size):
        place += group.heights[i] * _strain(group, i, stress)
        nodes[min(i, nodes.size - 1)] = place


@compiled
def integrate_aggregate(
    given: SceneTuple, tol: float, max_steps: int, curves: Array, log: Array, effort: Branches
) -> tuple[int, float, int, int]:
    """Integrate an impact on springs without dashpots or masses between them, over the samples.

    Arguments and results are those of `explicit.taylor.integrate`, of springs as `holds` wants
    them; `effort` (2,) is added to: sums over all springs, and orders of all steps.
    """
    scene = Scene(*given)
    heights, mass, drag, speed, t = scene.heights, scene.mass[0], scene.drag, scene.speed, scene.t
    tol = max(tol, LEAST_TRUNCATION)
    count, group, order = heights.size, _make_group(scene.rows, heights), order_for(tol, DEGREE)
    now = Step(
        np.zeros(order + 1), np.zeros(order + 1), np.zeros(order + 1),
        np.zeros((order + 1, order + 1)), np.zeros(DEGREE + 1),
    )  # fmt: skip
    compliance = group.sum[1] / group.place[UNIT]
    w_scale = speed * math.sqrt(mass * compliance)  # least ranges to be expected
    if drag > 0.0:
        w_scale = min(w_scale, speed * mass / drag)
    s_scale = min(w_scale / compliance, group.upper[1])
    w_scale = s_scale * compliance
    effort[0] += 1
    done = before_contact(curves, t, speed, 0.0)
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
            fly(curves, t, done, begin, w_end, velocity, 0.0)
            return scenes.DONE, begin, step + 1, switches
        s_scale = max(s_scale, stress)
        w_scale = max(w_scale, now.w[0])
        if side != 0:
            switches = _switch(group, stress, side > 0, begin, log, switches)
            if abs(stress - group.place[ANCHOR]) >= reach * (1.0 - 1e-12):
                _anchor(group, stress, side > 0)
                effort[0] += 1
    return scenes.TOO_MANY_STEPS, begin, max_steps, switches
