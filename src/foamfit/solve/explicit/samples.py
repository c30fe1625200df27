"""Output of the explicit integrator: samples, their derivatives, and the end of contact."""

from __future__ import annotations

from foamfit.solve.explicit.series import EPS, GROUP, HEIGHT, Links, SeriesTangents, V, W, advance
from foamfit.solve.explicit.tangents import advance_tangents
from foamfit.solve.polynomial import fill_values, slope_at, value_at
from foamfit.solve.scene import STRESS, Samples, fly
from foamfit.springs.kernels import Array, inner, piece


@inner
def _write(
    links: Links,
    s: Array,
    order: int,
    samples: Samples,
    first: int,
    last: int,
    now: float,
    curves: Array,
    c: Array,
    change: tuple[Array, Array] | None,
) -> None:
    """Write base stress and displacements of a series at some samples of a step; c is scratch.

    Derivatives by heights need a `change`: the derivatives of `Links.law`, and the strains.
    """
    law, t, nodes, count = links.law, samples.t, curves.shape[0] - 1, links.law.shape[0]
    fill_values(s[GROUP, 0], order, t, first, last, now, curves[0])
    if nodes == 1 and links.top != STRESS:
        fill_values(s[W, links.ends.size - 1], order, t, first, last, now, curves[1])
        return
    for n in range(order + 1):
        c[n] = 0.0
    for i in range(count):
        for n in range(order + 1):
            c[n] += law[i, HEIGHT] * s[EPS, i, n]
            if change is not None:
                c[n] += change[0][i, HEIGHT] * change[1][i, n]
        if nodes > 1 or i == count - 1:
            fill_values(c, order, t, first, last, now, curves[min(1 + i, nodes)])


@piece
def sample(
    links: Links, s: Array, order: int, out: Samples, first: int, last: int, now: float, c: Array
) -> None:
    """Write base stress and displacements at the samples first … last-1 of a step; c is scratch."""
    _write(links, s, order, out, first, last, now, out.curves, c, None)


@piece
def sample_tangents(
    links: Links,
    s: Array,
    d: SeriesTangents,
    order: int,
    out: Samples,
    first: int,
    last: int,
    now: float,
    c: Array,
) -> None:
    """Write the derivatives of base stress and displacements at some samples of a step."""
    for p in range(d.drag.size):
        slopes = out.slopes[p]
        if d.live[p] == 0.0:
            slopes[:, first:last] = 0.0
        else:
            change = d.law[p], s[EPS]
            _write(links, d.series[p], order, out, first, last, now, slopes, c, change)


@inner
def mend_kink(out: Samples, s: Array, d: SeriesTangents, knot: int) -> None:
    """Give dashpots the mean rate at a sample where the prescribed motion has a kink."""
    before, after = out.t[knot], out.t[knot + 1]  # each since the previous sample
    share = before / (before + after)
    out.curves[0, knot] += share * (s[GROUP, 0, 0] - out.curves[0, knot])
    for p in range(d.drag.size):
        out.slopes[p, 0, knot] += share * (d.series[p, GROUP, 0, 0] - out.slopes[p, 0, knot])


# ---------------------------------------------------------------- the end of contact


@inner
def delay(s: Array, d: SeriesTangents, order: int, span: float, late: Array) -> None:
    """Fill the derivatives of the time at which the base stress vanishes at the end of a step.

    If a unilateral spring has just opened, those of the previous step are kept.
    """
    fall = slope_at(s[GROUP, 0], order, span)
    for p in range(d.drag.size if fall != 0.0 else 0):
        late[p] = -value_at(d.series[p, GROUP, 0], order, span) / fall


@piece
def depart(
    links: Links,
    s: Array,
    d: SeriesTangents,
    order: int,
    more: int,
    span: float,
    now: float,
    gravity: float,
    out: Samples,
    done: int,
    scratch: Array,
) -> None:
    """Fill the samples after contact, which ends with this step at time `now`.

    scratch[0] contains the derivatives of that time: if contact ends later, the nodes move on until
    then, and the top keeps its velocity from then on. The rest of `scratch` (3, …) is free.
    """
    late, rate, place = scratch[0], scratch[1], scratch[2]
    law, nodes, groups = links.law, out.curves.shape[0] - 1, links.ends.size
    count, top = law.shape[0], groups - 1
    pull = slope_at(s[V, top], order, span) - gravity
    speed = moved = 0.0
    for i in range(count):
        speed += law[i, HEIGHT] * slope_at(s[EPS, i], order, span)
        rate[min(i, nodes - 1)] = speed
    advance(s, groups, order, span)
    advance_tangents(d, groups, more, span, None)
    for i in range(count):
        moved += law[i, HEIGHT] * s[EPS, i, 0]
        place[min(i, nodes - 1)] = moved
    away = s[V, top, 0]
    fly(out.curves, out.t, done, now, place, away, gravity)
    for p in range(d.drag.size):
        moved = 0.0
        for i in range(count):
            moved += law[i, HEIGHT] * d.series[p, EPS, i, 0] + d.law[p, i, HEIGHT] * s[EPS, i, 0]
            place[min(i, nodes - 1)] = moved
        for node in range(nodes):
            place[node] += (rate[node] - away) * late[p]
        faster = d.series[p, V, top, 0] + pull * late[p]
        fly(out.slopes[p], out.t, done, now, place, faster, 0.0)
