"""One implicit step of a chain on fixed branches: Radau IIA collocation, and its linearisation.

A step is a polynomial in time through five Radau points (order 9), on which the balance of every
node holds exactly:

    μ_i d²w_i/dt² + c dw_i/dt + Σ_i - Σ_{i+1} = p,      Σ_i = σ_i(ε_i) + η_i dε_i/dt

A node without mass or a spring without dashpot only lacks its term, so massless, undamped and mixed
chains are one case. The unknowns are the displacements of all nodes at the points. Newton's method
with the exact Jacobian finds them; it is block tridiagonal over the nodes, and its elimination goes
once up the chain and once down: cost grows with the number of springs. The derivatives by
parameters solve the same equations, linearised at the points that were found.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.polynomial import value_at
from foamfit.springs.kernels import (
    ETA,
    K0,
    Array,
    Branches,
    branch_shape,
    inner,
    maker,
    once,
    slope_on,
    stress_on,
)
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_HEIGHT
from foamfit.springs.sensitivities import stress_tangent

STAGES = 5


def radau(stages: int) -> tuple[Array, Array]:
    """Nodes c and matrix A of the Radau IIA method of order 2 stages - 1."""
    series = np.zeros(stages + 1)
    series[-2:] = 1.0, -1.0
    nodes = np.sort(0.5 * (1.0 + np.real(np.polynomial.legendre.legroots(series))))
    nodes[-1] = 1.0
    powers = np.arange(1, stages + 1)
    integrals = nodes[:, None] ** powers / powers
    values = nodes[:, None] ** (powers - 1)
    return nodes, np.asarray(np.linalg.solve(values.T, integrals.T).T, dtype=np.float64)


NODES, WEIGHTS = radau(STAGES)
# From increments at the points to their time derivatives (times the step), first and second.
RATES = np.linalg.inv(WEIGHTS)
RATES_2 = RATES @ RATES
# From increments at the points to the coefficients 1 … 5 of the polynomial over the step [0, 1].
COEFFICIENTS = np.linalg.inv(NODES[:, None] ** np.arange(1, STAGES + 1))


# From values at the points to the coefficients 0 … 4 of the polynomial through them alone.
THROUGH = np.linalg.inv(NODES[:, None] ** np.arange(STAGES))


class Body(NamedTuple):
    """A chain, as a step knows it.

    rows (springs, columns) are the springs, heights (springs,) is in m, mass (springs,) the areal
    mass above each spring, kg/m², or 0; `drag` is the onsite damping of the top, Pa·s/m; the first
    `moving` nodes are free.
    """

    rows: Array
    heights: Array
    mass: Array
    drag: float
    moving: int


class Work(NamedTuple):
    """Arrays of linear systems: residual (columns, springs, points) in, delta (the same) out.

    lift (springs, points, points), stiff and spring (points, points) and m (points, 2 points +
    columns) are scratch.
    """

    residual: Array
    delta: Array
    lift: Array
    stiff: Array
    spring: Array
    m: Array


class Points(NamedTuple):
    """What a step finds at its points, all (springs, points) but for the last.

    z is what the nodes move beyond v0 times time, eps the strains, vel the velocities of the nodes,
    total the stresses with those of the dashpots, slope dσ/dε; `work` is that of Newton's method.
    """

    z: Array
    eps: Array
    vel: Array
    total: Array
    slope: Array
    work: Work


class State(NamedTuple):
    """What a step starts from, all (springs,).

    Displacements and velocities w and v of the nodes, v0 of those with a mass (0 of the others),
    strains and branches.
    """

    w: Array
    v: Array
    v0: Array
    eps0: Array
    branches: Branches


class PointTangents(NamedTuple):
    """Derivatives by p parameters of a state and of what a step finds at its points.

    directions (p, 2) are those of `springs.parameters`. w, v0 and eps0 are (springs, p); eps and
    total are (p, springs, points), like z, which is `work.delta`; base (p,) is the base stress at
    the last step's end.
    """

    directions: Branches
    w: Array
    v0: Array
    eps0: Array
    eps: Array
    total: Array
    base: Array
    work: Work


@maker
def _make_work(count: int, columns: int) -> Work:
    """Allocate linear systems."""
    n = STAGES
    return Work(
        np.zeros((columns, count, n)), np.zeros((columns, count, n)), np.zeros((count, n, n)),
        np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 2 * n + columns)),
    )  # fmt: skip


@maker
def make_points(count: int) -> Points:
    """Allocate the points of a step."""
    s = (count, STAGES)
    return Points(
        np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s), _make_work(count, 1)
    )


@maker
def make_tangents(count: int, directions: Branches) -> PointTangents:
    """Make derivatives of a chain at rest."""
    p = directions.shape[0]
    at, points = (count, p), (p, count, STAGES)
    return PointTangents(
        directions, np.zeros(at), np.zeros(at), np.zeros(at), np.zeros(points), np.zeros(points),
        np.zeros(p), _make_work(count if p > 0 else 0, p),
    )  # fmt: skip


@inner
def _fill(body: Body, state: State, span: float, at: Points) -> bool:
    """Fill strains, velocities, stresses, slopes at the points; false past the end of a branch."""
    for i in range(body.heights.size):
        row, branch, height = body.rows[i], state.branches[i], body.heights[i]
        for j in range(STAGES):
            rate = 0.0
            for k in range(STAGES):
                rate += RATES[j, k] * at.z[i, k]
            at.vel[i, j] = state.v0[i] + rate / span
            move = at.z[i, j] + NODES[j] * span * state.v0[i]
            stretching = at.vel[i, j]
            if i > 0:
                move -= at.z[i - 1, j] + NODES[j] * span * state.v0[i - 1]
                stretching -= at.vel[i - 1, j]
            at.eps[i, j] = state.eps0[i] + move / height
            at.slope[i, j] = slope_on(row, branch, at.eps[i, j])
            stress = stress_on(row, branch, at.eps[i, j])
            if not math.isfinite(stress):
                return False
            at.total[i, j] = stress + row[ETA] * stretching / height
    return True


@inner
def _solve(m: Array, n: int, columns: int) -> bool:
    """Solve n equations in place, right-hand sides in the columns past n; false if singular."""
    for p in range(n):
        best = p
        for q in range(p + 1, n):
            if abs(m[q, p]) > abs(m[best, p]):
                best = q
        if not abs(m[best, p]) > 0.0:
            return False
        if best != p:
            for k in range(p, columns):
                m[p, k], m[best, k] = m[best, k], m[p, k]
        for q in range(p + 1, n):
            factor = m[q, p] / m[p, p]
            if factor != 0.0:
                for k in range(p + 1, columns):
                    m[q, k] -= factor * m[p, k]
    for k in range(n, columns):
        for p in range(n - 1, -1, -1):
            rest = m[p, k]
            for q in range(p + 1, n):
                rest -= m[p, q] * m[q, k]
            m[p, k] = rest / m[p, p]
    return True


@inner
def _stiffness(rows: Array, i: int, height: float, span: float, slope: Array, out: Array) -> None:
    """Force of spring i at the points per displacement of its upper node at the points."""
    soft = 1e-12 * rows[i, K0]  # a flat branch: the step would have no bound, the force has
    damp = rows[i, ETA] / (height * span)
    for j in range(STAGES):
        for k in range(STAGES):
            out[j, k] = damp * RATES[j, k]
        out[j, j] += max(slope[i, j], soft) / height


@inner
def _put(delta: Array, i: int, m: Array, first: int) -> None:
    """Put the columns of node i beside the matrix of a linear system."""
    for c in range(delta.shape[0]):
        for j in range(STAGES):
            m[j, first + c] = delta[c, i, j]


@inner
def _get(delta: Array, i: int, m: Array, first: int) -> None:
    """Get the columns of node i from where `_put` put them."""
    for c in range(delta.shape[0]):
        for j in range(STAGES):
            delta[c, i, j] = m[j, first + c]


@inner
def _correct(body: Body, span: float, slope: Array, work: Work) -> bool:
    """Displacements `delta` of the first `moving` nodes that balance the forces in `residual`.

    Both are (columns, springs, points): every column is a system of its own with the same matrix.
    False if the equations are singular. Going up, the chain below a node acts on it through a
    stiffness K and a force r. Written so that nothing cancels: under a spring of stiffness S,
    (K, r) become (S D⁻¹ K, S D⁻¹ r), D = K + S.
    """
    rows, heights, mass, drag, moving = body
    residual, delta, lift, stiff, spring, m = work  # stiff: the chain below, as it acts on the node
    s, columns = STAGES, residual.shape[0]
    for i in range(moving):
        _stiffness(rows, i, heights[i], span, slope, spring)
        if i == 0:
            for j in range(s):
                for k in range(s):
                    stiff[j, k] = spring[j, k]
        else:
            for j in range(s):
                for k in range(s):
                    m[j, k] = stiff[j, k] + spring[j, k]
                    m[j, s + k] = stiff[j, k]
            _put(delta, i - 1, m, 2 * s)
            if not _solve(m, s, 2 * s + columns):
                return False
            _get(delta, i - 1, m, 2 * s)
            for j in range(s):
                for k in range(s):
                    lift[i - 1, j, k] = (1.0 if j == k else 0.0) - m[j, s + k]
            for j in range(s):
                for k in range(s):
                    stiff[j, k] = 0.0
                    for q in range(s):
                        stiff[j, k] += spring[j, q] * m[q, s + k]
        resist = drag if i == heights.size - 1 else 0.0
        for j in range(s):
            for k in range(s):
                stiff[j, k] += mass[i] * RATES_2[j, k] / span**2 + resist * RATES[j, k] / span
        for c in range(columns):
            for j in range(s):
                force = residual[c, i, j]
                if i > 0:
                    for k in range(s):
                        force += spring[j, k] * delta[c, i - 1, k]
                delta[c, i, j] = force
    last = moving - 1
    if moving < heights.size:  # the spring above the last free node is held by the driven top
        _stiffness(rows, moving, heights[moving], span, slope, spring)
        for j in range(s):
            for k in range(s):
                stiff[j, k] += spring[j, k]
    for j in range(s):
        for k in range(s):
            m[j, k] = stiff[j, k]
    _put(delta, last, m, s)
    if not _solve(m, s, s + columns):
        return False
    _get(delta, last, m, s)
    for c in range(columns):
        for i in range(last - 1, -1, -1):
            for j in range(s):
                gain = 0.0
                for k in range(s):
                    gain += lift[i, j, k] * delta[c, i + 1, k]
                delta[c, i, j] += gain
    return True


@once
def collocate(
    body: Body,
    state: State,
    push: float,
    push_rate: float,
    span: float,
    reach: float,
    at: Points,
    tally: Branches,
) -> bool:
    """Solve one step by Newton's method from the guess in z; false if it does not converge."""
    rows, heights, mass, drag, moving = body
    z, eps, vel, total, slope, work = at
    residual, delta = work.residual, work.delta
    count = heights.size
    if not _fill(body, state, span, at):
        for i in range(moving):
            for j in range(STAGES):
                z[i, j] = 0.0
        if not _fill(body, state, span, at):
            return False
    before = math.inf
    slow = 0
    for _ in range(30):
        if moving == 0:
            return True
        for i in range(moving):
            for j in range(STAGES):
                force = -total[i, j]
                if i < count - 1:
                    force += total[i + 1, j]
                else:
                    force += push + push_rate * NODES[j] * span - drag * vel[i, j]
                if mass[i] > 0.0:
                    pull = 0.0
                    for k in range(STAGES):
                        pull += RATES_2[j, k] * z[i, k]
                    force -= mass[i] * pull / span**2
                residual[0, i, j] = force
        tally[0] += 1
        tally[1] += moving
        if not _correct(body, span, slope, work):
            return False
        part, size, moved = 1.0, 0.0, 0.0
        for i in range(count):
            curved, _, x0, _ = branch_shape(rows[i], state.branches[i])
            for j in range(STAGES):
                gain = delta[0, i, j] if i < moving else 0.0
                size = max(size, abs(gain))
                if not math.isfinite(gain):
                    return False
                moved = max(moved, abs(z[i, j] + NODES[j] * span * state.v0[i]))
                if i > 0:
                    gain -= delta[0, i - 1, j]
                most = 0.9 * (1.0 - (eps[i, j] - x0))
                if curved and gain / heights[i] > most:
                    part = min(part, most * heights[i] / gain)
        for i in range(moving):
            for j in range(STAGES):
                z[i, j] += part * delta[0, i, j]
        if not _fill(body, state, span, at):
            return False
        if part == 1.0:
            if size <= 1e-8 * moved + 1e-15 * reach:
                return True
            slow = slow + 1 if size > 0.5 * before else 0
            if slow > 5:  # near a pole corrections double before they halve
                return False
            before = size
    return False


@once
def linearise(body: Body, state: State, span: float, at: Points, d: PointTangents) -> bool:
    """Derivatives at the points of a step that was found, and at its end; false if singular.

    The equations of the step, linearised: first what the parameters and the derivatives at the
    start of the step do to the forces while z rests, then the z that balances them.
    """
    heights, moving = body.heights, body.moving
    count, last = heights.size, heights.size - 1
    for i in range(count):
        for c in range(d.base.size):
            _rest(body, state, span, at, d, i, c)
    for i in range(moving):
        for j in range(STAGES):
            for c in range(d.base.size):
                net = -d.total[c, i, j]
                if i < last:
                    net += d.total[c, i + 1, j]
                else:
                    net -= body.drag * d.v0[i, c]
                    if d.directions[c, 1] == DRAG:
                        net -= at.vel[i, j]
                d.work.residual[c, i, j] = net
    if moving > 0 and not _correct(body, span, at.slope, d.work):
        return False
    for i in range(count):
        for j in range(STAGES):
            for c in range(d.base.size):
                move, stretching = _relative(d.work.delta, i, j, c)
                d.eps[c, i, j] += move / heights[i]
                damp = body.rows[i, ETA] * stretching / span
                d.total[c, i, j] += (at.slope[i, j] * move + damp) / heights[i]
    return True


@inner
def _relative(z: Array, i: int, j: int, c: int) -> tuple[float, float]:
    """Elongation of spring i at a point, and its rate times the step, of column c of z."""
    move, rate = z[c, i, j], 0.0
    for k in range(STAGES):
        rate += RATES[j, k] * z[c, i, k]
    if i > 0:
        move -= z[c, i - 1, j]
        for k in range(STAGES):
            rate -= RATES[j, k] * z[c, i - 1, k]
    return move, rate


@inner
def _rest(
    body: Body, state: State, span: float, at: Points, d: PointTangents, i: int, c: int
) -> None:
    """Derivatives of strain and stress of spring i at the points in direction c, while z rests."""
    row, branch, height = body.rows[i], state.branches[i], body.heights[i]
    own = d.directions[c, 1] if d.directions[c, 0] == i else -1
    longer = 1.0 if own == OWN_HEIGHT else 0.0
    dv = d.v0[i, c] - (d.v0[i - 1, c] if i > 0 else 0.0)
    for j in range(STAGES):
        rate = (at.vel[i, j] - (at.vel[i - 1, j] if i > 0 else 0.0)) / height
        part = NODES[j] * span * dv - (at.eps[i, j] - state.eps0[i]) * longer
        d.eps[c, i, j] = d.eps0[i, c] + part / height
        stress = stress_tangent(row, branch, at.eps[i, j], d.eps[c, i, j], own)
        stress += row[ETA] * (dv - rate * longer) / height
        d.total[c, i, j] = stress + (rate if own == OWN_ETA else 0.0)


@inner
def polynomial(first: float, points: Array, out: Array) -> None:
    """Coefficients over [0, 1] of the polynomial through `first` at 0 and the values at points."""
    out[0] = first
    for k in range(STAGES):
        out[k + 1] = 0.0
        for j in range(STAGES):
            out[k + 1] += COEFFICIENTS[k, j] * (points[j] - first)


@inner
def truncation(c: Array) -> float:
    """Size of the first Legendre term that a step's polynomial leaves out."""
    fifth = abs(c[5]) / 252.0
    fourth = abs(c[4] + 2.5 * c[5]) / 70.0
    if fifth >= fourth:
        return fifth
    return fifth * max(fifth / fourth, 0.02)


@inner
def guess(moves: Array, state: State, moving: int, span: float, taken: float, z: Array) -> None:
    """Fill z with the motion of the last step, of length `taken`, carried on over the next."""
    for i in range(state.v.size):
        ahead = i < moving and 0.0 < span <= 2.0 * taken
        last = value_at(moves[i], STAGES, 1.0)
        for j in range(STAGES):
            time = NODES[j] * span
            if ahead:
                z[i, j] = value_at(moves[i], STAGES, 1.0 + time / taken) - last
                z[i, j] -= time * state.v0[i]
            else:
                z[i, j] = time * (state.v[i] - state.v0[i]) if i < moving else 0.0
