"""Recording an implicit step: base stress, displacements and their derivatives at the samples."""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math

from foamfit.solve.implicit.collocation import (
    NODES,
    RATES,
    STAGES,
    THROUGH,
    Body,
    Points,
    PointTangents,
    State,
    linearise,
    polynomial,
)
from foamfit.solve.implicit.control import Polynomials
from foamfit.solve.polynomial import value_at
from foamfit.solve.scene import Samples, Scene, fly
from foamfit.springs.kernels import ETA, Array, inner
from foamfit.springs.parameters import OWN_ETA, OWN_HEIGHT


@inner
def _record(
    now: float, span: float, first: int, done: int, state: State, curves: Polynomials, out: Samples
) -> None:
    """Write the samples first … done-1, which a step contains."""
    nodes, count = out.curves.shape[0] - 1, state.w.size
    for sample in range(first, done):
        at = (out.t[sample] - now) / span
        out.curves[0, sample] = value_at(curves.base, STAGES, at)
        for node in range(nodes):
            i = node if nodes > 1 else count - 1
            out.curves[1 + node, sample] = state.w[i] + value_at(curves.moves[i], STAGES, at)


@inner
def _through(values: Array, at: float) -> float:
    """Value at a place of a step of the polynomial through the values at its points.

    Where nothing has inertia or a dashpot, the derivatives by a dashpot jump at switches and kinks:
    this polynomial does not pass through the start of the step.
    """
    total = 0.0
    for k in range(STAGES - 1, -1, -1):
        term = 0.0
        for j in range(STAGES):
            term += THROUGH[k, j] * values[j]
        total = total * at + term
    return total


@inner
def _record_tangents(
    now: float, span: float, first: int, done: int, d: PointTangents, out: Samples
) -> None:
    """Write the derivatives at the samples first … done-1, which a step contains."""
    nodes, count = out.curves.shape[0] - 1, d.w.shape[0]
    for c in range(d.base.size):
        for sample in range(first, done):
            at = (out.t[sample] - now) / span
            out.slopes[c, 0, sample] = _through(d.total[c, 0], at)
            for node in range(nodes):
                i = node if nodes > 1 else count - 1
                moved = d.w[i, c] + at * span * d.v0[i, c]
                out.slopes[c, 1 + node, sample] = moved + _through(d.work.delta[c, i], at)


@inner
def _carry_tangents(body: Body, span: float, d: PointTangents) -> None:
    """Carry the derivatives of the state over a step."""
    end = STAGES - 1
    for i in range(body.heights.size):
        for c in range(d.base.size):
            d.w[i, c] += d.work.delta[c, i, end] + span * d.v0[i, c]
            d.eps0[i, c] = d.eps[c, i, end]
            if body.mass[i] > 0.0:
                rate = 0.0
                for k in range(STAGES):
                    rate += RATES[end, k] * d.work.delta[c, i, k]
                d.v0[i, c] += rate / span
    for c in range(d.base.size):
        d.base[c] = d.total[c, 0, end]


@inner
def record_step(
    body: Body,
    state: State,
    at: Points,
    curves: Polynomials,
    now: float,
    span: float,
    first: int,
    done: int,
    d: PointTangents,
    out: Samples,
) -> bool:
    """Write the samples of a step and carry its derivatives; false if these are not finite."""
    for i in range(body.heights.size):
        for j in range(STAGES):
            curves.stress[i, j] = at.z[i, j] + NODES[j] * span * state.v0[i]
        polynomial(0.0, curves.stress[i], curves.moves[i])
    _record(now, span, first, done, state, curves, out)
    if d.base.size > 0:
        if not linearise(body, state, span, at, d):
            return False
        _record_tangents(now, span, first, done, d, out)
        _carry_tangents(body, span, d)
    return True


@inner
def record_rest(first: int, state: State, base: float, d: PointTangents, out: Samples) -> None:
    """Write a single sample, or one that is left where the steps have ended."""
    nodes, count = out.curves.shape[0] - 1, state.w.size
    for sample in range(first, out.t.size):
        out.curves[0, sample] = base
        for c in range(d.base.size):
            out.slopes[c, 0, sample] = d.base[c]
        for node in range(nodes):
            i = node if nodes > 1 else count - 1
            out.curves[1 + node, sample] = state.w[i]
            for c in range(d.base.size):
                out.slopes[c, 1 + node, sample] = d.w[i, c]


@inner
def mend_kink(
    scene: Scene, body: Body, knot: int, jump: float, d: PointTangents, out: Samples
) -> None:
    """Dashpots feel the mean rate where the prescribed motion has a kink of `jump`."""
    flow = 0.0
    for i in range(body.heights.size):
        eta = body.rows[i, ETA]
        flow += body.heights[i] / eta if eta > 0.0 else math.inf
    t = scene.t
    share = (t[knot] - t[knot - 1]) / (t[knot + 1] - t[knot - 1])
    out.curves[0, knot] += share * jump / flow
    if flow == math.inf:
        return
    for c in range(d.base.size):
        i = d.directions[c, 0]
        if i >= 0 and d.directions[c, 1] in (OWN_ETA, OWN_HEIGHT):
            eta = body.rows[i, ETA]
            more = 1.0 / eta if d.directions[c, 1] == OWN_HEIGHT else -body.heights[i] / (eta * eta)
            out.slopes[c, 0, knot] -= share * jump / (flow * flow) * more


@inner
def fly_on(
    body: Body,
    state: State,
    at: Points,
    fall: float,
    now: float,
    done: int,
    d: PointTangents,
    out: Samples,
    w_end: Array,
) -> None:
    """Fill the samples after contact, which ended now with the base stress falling at `fall`.

    A later end leaves the nodes as they move until then, and the top with the velocity that it has
    then. `w_end` (nodes or more,) is scratch.
    """
    nodes, top = out.curves.shape[0] - 1, state.w.size - 1
    for node in range(nodes):
        w_end[node] = state.w[node if nodes > 1 else top]
    fly(out.curves, out.t, done, now, w_end, state.v[top])
    pull = -(at.total[top, STAGES - 1] + body.drag * state.v[top]) / body.mass[top]
    for c in range(d.base.size):
        late = -d.base[c] / fall if fall != 0.0 else 0.0
        for node in range(nodes):
            i = node if nodes > 1 else top
            w_end[node] = d.w[i, c] + (state.v[i] - state.v[top]) * late
        fly(out.slopes[c], out.t, done, now, w_end, d.v0[top, c] + pull * late)
