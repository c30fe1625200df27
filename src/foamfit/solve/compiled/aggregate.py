"""Many undamped, massless springs under one stress, taken as one spring in an impact.

The strain of each spring on its branch is known in closed form, so that the strain of the chain is
a function of the stress alone,

    ε = Σ h_i ε_i(S)/H,

analytic up to the nearest pole of a curved branch (-k). Its Taylor polynomial about an anchor
stress is the law of the chain. A switch of one spring replaces the terms of that spring only, at a
cost independent of the length of the chain; the full sum is recomputed only where the stress leaves
the range of the polynomial. The next spring to switch is found in a binary tree of the switching
stresses. The cost of a run grows little faster than the number of springs, where following every
spring through every step would cost the square of that number.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from foamfit.arrays import Array
from foamfit.springs.compiled import bistable, contract
from foamfit.springs.compiled.bistable import A, C, D, E
from foamfit.springs.compiled.contract import MISS, OF_LAW, SLOPE, inner, past
from foamfit.springs.laws.record import Law

# The shape of a branch: 1 if curved, slope k, origins of strain and stress, stresses at its ends.
CURVED, STEEP, ORIGIN, OFFSET, FIRST, LAST = range(bistable.SHAPE)
SHAPE = bistable.SHAPE
DEGREE = 16  # of the polynomial
# Range of the polynomial about its anchor, as a share of the distance to the nearest pole. The
# relative truncation error of the strain is below 0.125**17 < 1e-15.
REACH = 0.125
CLOSE = 1e-13  # relative difference of switching stresses below which springs switch together
# The row: number of springs; leaves of the trees; anchor and unit of the polynomial in
# (S - anchor)/unit, Pa; least initial slope k of a branch; changes of branch, and switches of
# springs. Then the polynomial; of each spring its branch, share of the height, and four shapes;
# trees of the stresses at which springs leave their branches upwards, and of the negative ones at
# which they leave them downwards; change, spring, branch left, branch entered and strain of each
# switch. The leaves are the second half of a tree. Each entry of the first half is the lesser of
# its two children, so that entry 1 is the least of all.
_NAMES = ("count", "leaves", "anchor", "unit", "least", "changes", "switches")
HEAD = len(_NAMES)
SPRINGS, OF_SPRING = HEAD + DEGREE + 1, 2 + 4 * SHAPE
MOST_SWITCHES = 4  # of a spring in an impact
as_row = contract.naming("Aggregate", _NAMES)


@inner
def _shape(row, i):
    """Return the shape of the branch of a spring."""
    own = past(row, SPRINGS + i * OF_SPRING)
    return past(own, 2 + int(own[0]) * SHAPE)


@inner
def _tree(row, up):
    """Return a tree of switching stresses."""
    first = SPRINGS + int(row.count) * OF_SPRING
    return past(row, first if up else first + 2 * int(row.leaves))


@inner
def _set(tree, at, value):
    """Set a leaf of a tree and update the nodes above it."""
    tree[at] = value
    while at > 1:
        at //= 2
        tree[at] = min(tree[2 * at], tree[2 * at + 1])


@inner
def _enter(row, i, branch):
    """Put a spring on a branch."""
    row[SPRINGS + i * OF_SPRING] = branch
    shape, leaf = _shape(row, i), int(row.leaves) + i
    _set(_tree(row, True), leaf, shape[LAST])
    _set(_tree(row, False), leaf, -shape[FIRST])


@inner
def _add(row, i, times):
    """Add the strain of a spring to the polynomial, or subtract it (`times` -1)."""
    shape, total, anchor = _shape(row, i), past(row, HEAD), row.anchor
    share, k = times * row[SPRINGS + i * OF_SPRING + 1], shape[STEEP]
    if not shape[CURVED] > 0.0:
        total[0] += share * (shape[ORIGIN] + (anchor - shape[OFFSET]) / k)
        total[1] += share * row.unit / k
        return
    # On a curved branch ε = x0 + 1 - k/(k + S), a geometric series.
    ratio = row.unit / (k + anchor)
    total[0] += share * (shape[ORIGIN] + anchor / (k + anchor))
    term = share * k / (k + anchor) * ratio
    for m in range(1, DEGREE + 1):
        total[m] += term
        term *= -ratio


@inner
def _anchor(row, stress, rising):
    """Recompute the polynomial about an anchor ahead of the stress, which stays in its reach."""
    ahead = REACH if rising else -REACH
    row.anchor = (stress + ahead * row.least) / (1.0 - ahead)
    row.unit = row.least + row.anchor
    for m in range(DEGREE + 1):
        row[HEAD + m] = 0.0
    for i in range(int(row.count)):
        _add(row, i, 1.0)


@inner
def _at(row, stress):
    """Return strain and dε/dS at a stress."""
    x, total = (stress - row.anchor) / row.unit, past(row, HEAD)
    value, slope = total[DEGREE], 0.0
    for m in range(DEGREE - 1, -1, -1):
        slope = slope * x + value
        value = value * x + total[m]
    return value, slope / row.unit


@inner
def _bound(row, s):
    """Set the ends of the present branch: the next switch, or the reach of the polynomial."""
    reach = REACH * row.unit
    s.sigma_high = min(_tree(row, True)[1], row.anchor + reach)
    s.sigma_low = max(-_tree(row, False)[1], row.anchor - reach)
    s.high, s.low = _at(row, s.sigma_high)[0], _at(row, s.sigma_low)[0]


@inner
def _strain(shape, stress):
    """Return the strain of a spring on its branch."""
    k = shape[STEEP]
    part = stress / (k + stress) if shape[CURVED] > 0.0 else (stress - shape[OFFSET]) / k
    return shape[ORIGIN] + part


@inner
def _change(row, stress, up):
    """Switch all springs that leave their branches at a stress."""
    tree, leaves = _tree(row, up), int(row.leaves)
    log = past(_tree(row, False), 2 * leaves)
    met = (stress if up else -stress) + CLOSE * abs(stress)
    while tree[1] <= met:
        i = 1  # descend to the least leaf
        while i < leaves:
            i = 2 * i if tree[2 * i] == tree[i] else 2 * i + 1
        i -= leaves
        left, strain = row[SPRINGS + i * OF_SPRING], _strain(_shape(row, i), stress)
        entered = (D if left == A else C) if up else (E if left == C else A)
        if row.switches < MOST_SWITCHES * row.count:
            one = past(log, 5 * int(row.switches))
            one[0], one[1], one[2], one[3], one[4] = row.changes, i, left, entered, strain
        row.switches += 1.0
        _add(row, i, -1.0)
        _enter(row, i, entered)
        _add(row, i, 1.0)
    row.changes += 1.0
    if abs(stress - row.anchor) >= REACH * row.unit * (1.0 - 1e-12):
        _anchor(row, stress, up)


@contract.beginning
def _begin(row, s):
    row = as_row(row)
    for k in range(2 * int(row.leaves)):
        _tree(row, True)[k] = _tree(row, False)[k] = math.inf
    for i in range(int(row.count)):
        _enter(row, i, A)
    _anchor(row, 0.0, True)
    s.eps = s.x = s.turns = s.branch = 0.0
    _bound(row, s)
    return 0.0


@contract.evaluating
def _evaluate(row, s, eps, x, count, want, out):
    row = as_row(row)
    for j in range(count):
        strain, soft = _at(row, x[j])
        out[OF_LAW * count + j], out[SLOPE * count + j] = x[j], 1.0 / soft
        out[MISS * count + j] = strain - eps[j]
    return 0.0


@contract.switching
def _switch(row, s, up, out):
    row = as_row(row)
    s.eps, s.x = (s.high, s.sigma_high) if up else (s.low, s.sigma_low)
    _change(row, s.x, up != 0)
    _bound(row, s)
    return 0.0


@contract.outer
def _place(shapes, heights, branches, log, time, stress, free, nodes):
    """Fill displacements above all springs but the last, with which they fly from `free` on."""
    count, done = heights.size, 0
    for j in range(time.size):
        while done < log.shape[0] and log[done, 0] <= time[j]:
            branches[int(log[done, 1])] = int(log[done, 3])
            done += 1
        place = 0.0
        for i in range(count):
            place += heights[i] * _strain(shapes[i, branches[i]], stress[j])
            if i < count - 1:
                nodes[i, j] = place
        if j >= free:
            for i in range(count - 1):
                nodes[i, j] += nodes[count - 1, j] - place


def nodes_and_switches(
    row: Array, heights: Array, times: Array, time: Array, end: float, out: Array
) -> Array:
    """Fill the displacements of all nodes, and return the switches of the springs (n, 5)."""
    # `row` is that of the run, `times` those of its changes of branch, `end` of the contact.
    count, leaves = int(row[0]), int(row[1])
    first = SPRINGS + count * OF_SPRING
    log = row[first + 4 * leaves :][: 5 * int(row[_NAMES.index("switches")])].reshape(-1, 5).copy()
    log[:, 0] = times[log[:, 0].astype(np.int64)]
    shapes = row[SPRINGS:first].reshape(count, OF_SPRING)[:, 2:].reshape(count, 4, SHAPE)
    if out.shape[1] > 2:
        free = time.size if math.isnan(end) else int(np.searchsorted(time, end, "right"))
        shapes, branches = np.ascontiguousarray(shapes), np.zeros(count, np.int64)
        _place(shapes, heights, branches, log, time, out[0, 0], free, out[0, 1:])
    return log


def row_of(laws: tuple[contract.Compiled, ...], rows: Array, heights: Array) -> Array | None:
    """Return the row of an aggregate; None if the springs cannot be one."""
    # Undamped bistable and linear springs, without flat branches, gaps and relaxation.
    if rows[:, 0].any() or not {bistable.COMPILED, bistable.LINEAR}.issuperset(laws):
        return None
    count = len(heights)
    shapes = rows[:, 1:].reshape(count, 4, bistable.WIDE)[:, :, :SHAPE]
    steep = shapes[:, :, STEEP]
    if not (steep > 0.0).all():
        return None
    row = np.zeros(law_of(count)[1].columns)
    least = steep[(shapes[:, :, CURVED] > 0.0) | (shapes[:, :, LAST] == math.inf)].min()
    row[:5] = count, _leaves(count), 0.0, 0.0, least
    springs = np.zeros((count, OF_SPRING))
    springs[:, 1], springs[:, 2:] = heights / heights.sum(), shapes.reshape(count, -1)
    row[SPRINGS : SPRINGS + springs.size] = springs.ravel()
    return row


def _leaves(count: int) -> int:
    return 1 << (count - 1).bit_length()


@lru_cache(maxsize=64)
def law_of(count: int) -> tuple[Law, contract.Compiled]:
    """Return the law of an aggregate of so many springs."""
    columns = SPRINGS + count * OF_SPRING + 4 * _leaves(count) + 5 * MOST_SWITCHES * count
    # Explicit steps integrate its stress, so that `settle` and `strain` are not called.
    functions = _begin, _evaluate, _switch, contract.settle, bistable.strain
    made = contract.Compiled(None, contract.BY_STRESS, columns, 0, 1, functions)
    return Law("aggregate", (), made), made
