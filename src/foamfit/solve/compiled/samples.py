"""Samples of a run: base stress, displacements of the nodes, and their derivatives.

`out` contains, for the response and for each of its derivatives, a row of the base stress and rows
of displacements: of all nodes, or of the top only.
"""

from __future__ import annotations

import math

from foamfit.solve.compiled.motion import dense, rates_of
from foamfit.solve.compiled.run import BATCH, FREE, MOTION, numbers, sampling, spring
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import inlined, inner, outer, past, start
from foamfit.springs.laws.record import BEGUN, OWN_ETA, OWN_RELAXATION, STRUCK

# Tasks, instead of the number of a sample: write those up to a time inside the step, those after
# the end of contact (with dS/dt there instead of a time), and those before contact (with the
# velocity of the striker).
INSIDE, FLIGHT, APPROACH = -1, -2, -3
KNOWN = -1  # instead of whether with derivatives, if all values are those of the state


@inlined
def row_of(c, q, node):
    """Return the samples of the response (q = 0) or of a derivative; node 0 is the base stress."""
    return past(c.out, (q * c.shown + node) * c.samples)


@inner
def place_nodes(c, g, y, reach):
    """Fill displacement and derivatives `reach` of the node below a group; return the first."""
    for j in range(c.p):
        reach[j] = y[c.base + 2 * (g - 1) * c.p + j] if g > 0 else 0.0
    return y[2 * (g - 1)] if g > 0 else 0.0


@inner
def _rise(c, i, reach):
    """Add the elongation of a spring to derivatives of a displacement; return the elongation."""
    s, p = spring(c, i), c.p
    strain, own, height, eps = past(c.strain, i * p), past(c.own, 2 * i * p), s.height, s.eps
    for j in range(p):
        reach[j] += height * strain[j] + eps * own[j]
    return height * eps


@outer
def increases(time):
    """Whether sample times increase."""
    values, fine = start(time), 1
    for k in range(1, time.size):
        fine += values[k] > values[k - 1]
    return fine == time.size


@inner
def is_finite(c, rows):
    """Whether all samples of the first rows of the response are finite."""
    out, fine = c.out, c.none
    for k in range(rows * c.samples):
        fine += abs(out[k]) < math.inf
    return fine == rows * c.samples


@inner
def _put(c, node, k, value, slopes):
    """Write a sample of a row and its derivatives."""
    row_of(c, c.none, node)[k] = value
    for j in range(c.p):
        row_of(c, 1 + j, node)[k] = slopes[j]


@inner
def write_sample(c, y, at, k, want):
    """Write sample k from a state; the values of all springs are computed unless KNOWN."""
    every, p, last = c.shown > 2, c.p, c.groups - 1
    reach = past(c.common, (c.groups + 1) * p)
    if want != KNOWN:
        rates_of(c, c.none, y, c.f, want, at)
    _put(c, c.none, k, c.carried[0], c.common)
    for g in range(c.none if every else last, c.groups):
        solved = g < c.nodes
        top = c.first[g + 1] if every else c.shown - 1
        if every or not (solved or c.top == MOTION):
            if g > 0 and want != KNOWN:
                rates_of(c, g, y, c.f, want, at)
            place = place_nodes(c, g, y, reach)
            for i in range(c.first[g], c.first[g + 1]):
                place += _rise(c, i, reach)
                if every or i == c.count - 1:
                    _put(c, 1 + i if every else top, k, place, reach)
        if solved:
            _put(c, top, k, y[2 * g], past(y, c.base + 2 * g * p))
        elif c.top == MOTION:
            _put(c, top, k, c.drive.value + c.drive.value_rate * at, past(c.common, c.groups * p))


# ---------------------------------------------------------------- many samples of one step


@inner
def polynomial(c, i, n, out):
    """Fill component i of the state at the n shares in `batch` of an explicit step."""
    line, wide, shares = c.line, c.wide, c.batch
    a, b, d, e = line[i], line[wide + i], line[2 * wide + i], line[3 * wide + i]
    g, h, q, first = line[4 * wide + i], line[5 * wide + i], line[6 * wide + i], c.y[i]
    for k in range(n):
        x = shares[k]
        z = 1.0 - x
        out[k] = first + x * (a + z * (b + x * (d + z * (e + x * (g + z * (h + x * q))))))


@inner
def _write_batch(c, at, n):
    """Write n samples from `at` on: base stress of one spring, which is alone, and the top."""
    s, own, top = spring(c, 0), numbers(c, 0), 2 * c.groups - 2
    shares, time = c.batch, c.time
    eps, x, work = past(shares, BATCH), past(shares, 2 * BATCH), past(shares, 3 * BATCH)
    w, v, found = past(shares, 4 * BATCH), past(shares, 5 * BATCH), past(shares, 6 * BATCH)
    per, eta, gain, dt, now = s.per_height, s.eta, s.gain, c.now.step, c.now.now
    for k in range(n):
        shares[k] = (time[at + k] - now) / dt
    polynomial(c, c.none, n, w)
    for k in range(n):
        eps[k] = w[k] * per
    if own.x_at >= 0:
        polynomial(c, own.x_at, n, x)
    contract.call_evaluate(own.evaluate, past(s, c.row), s, eps, x, n, int(c.p > 0), found)
    sigma, stress = past(found, contract.OF_LAW * n), past(row_of(c, c.none, c.none), at)
    for k in range(n):
        stress[k] = gain * sigma[k]
    if eta > 0.0:
        polynomial(c, c.none + 1, n, v)
        for k in range(n):
            stress[k] += eta * per * v[k]
    for q in range(c.terms):
        polynomial(c, own.z_at + q, n, work)
        for k in range(n):
            stress[k] += s.g[q] * work[k]
    if top > 0:
        polynomial(c, top, n, w)
    motion = past(row_of(c, c.none, c.none + 1), at)
    for k in range(n):
        motion[k] = w[k]
    for j in range(c.p):
        _write_slope(c, j, at, n)


@inner
def _write_slope(c, j, at, n):
    """Write derivative j of the samples of `_write_batch`."""
    s, own, p, top = spring(c, 0), numbers(c, 0), c.p, 2 * c.groups - 2
    shares = c.batch
    eps, work, v = past(shares, BATCH), past(shares, 3 * BATCH), past(shares, 5 * BATCH)
    found = past(shares, 6 * BATCH)
    slope, sigma = past(found, contract.SLOPE * n), past(found, contract.OF_LAW * n)
    stress, motion = past(row_of(c, 1 + j, c.none), at), past(row_of(c, 1 + j, c.none + 1), at)
    per, eta, gain, what = s.per_height, s.eta, s.gain, c.owned[j]
    of_height, of_eta = c.own[j], c.own[p + j]
    polynomial(c, c.base + j, n, work)
    for k in range(n):
        motion[k] = work[k]
        stress[k] = gain * slope[k] * per * (work[k] - of_height * eps[k])
    if 0 <= what < OWN_ETA:
        by = past(found, (contract.BY + what) * n)
        for k in range(n):
            stress[k] += gain * by[k]
    if own.by_stress:
        held, ever, by = gain * c.held[j], gain * c.held[p + j], past(found, contract.BY_HELD * n)
        for k in range(n):
            stress[k] += held * by[k] + ever * by[n + k]
    if eta > 0.0 or of_eta > 0.0:
        polynomial(c, c.none + 1, n, v)
        polynomial(c, c.base + p + j, n, work)
        for k in range(n):
            stress[k] += per * (of_eta * v[k] + eta * (work[k] - of_height * per * v[k]))
    for q in range(c.terms):
        polynomial(c, c.base + (own.z_at + q) * p + j, n, work)
        for k in range(n):
            stress[k] += s.g[q] * work[k]
        if what == OWN_RELAXATION + 2 * q:
            polynomial(c, own.z_at + q, n, work)
            for k in range(n):
                stress[k] += sigma[k] + work[k]
    if top > 0:
        polynomial(c, c.base + top * p + j, n, motion)


@inner
def _write_inside(c, reached, want):
    """Write the samples of an impact up to a time inside the step."""
    r, t, n = c.now, c.time, c.base + c.carries * c.p
    k, quick = int(r.sample), c.shown == 2 and c.first[1] == 1 and c.top == FREE and c.degree == 0
    if quick and not c.numbers.internal:
        while k < c.samples and t[k] <= reached:
            last = k + 1
            while last < c.samples and last - k < BATCH and t[last] <= reached:
                last += 1
            _write_batch(c, k, last - k)
            k = last
    while k < c.samples and t[k] <= reached:
        dense(c, n, (t[k] - r.now) / r.step, c.state)
        write_sample(c, c.state, t[k], k, want)
        k += 1
    r.sample = k


# ---------------------------------------------------------------- without contact


@inner
def _coast(c, row, first, last, since, place, speed, pull):
    """Write samples of a uniformly accelerated motion."""
    for k in range(first, last):
        dt = c.time[k] - since
        row[k] = place + (speed + 0.5 * pull * dt) * dt


@inner
def _approach(c, speed):
    """Write the samples before contact, when only the striker moves."""
    done = c.none
    while done < c.samples and c.time[done] < 0.0:
        done += 1
    for j in range(1 + c.p):
        what = c.directions[2 * j - 1] if j > 0 else c.none
        for node in range(c.shown):
            place = quick = pull = 0.0
            if node == c.shown - 1:
                place = -speed if what == BEGUN else 0.0
                quick = -c.drive.gravity if what == BEGUN else 0.0
                quick = 1.0 if what == STRUCK else quick
                if j == 0:
                    quick, pull = speed, c.drive.gravity
            _coast(c, row_of(c, j, node), c.none, done, 0.0, place, quick, pull)
    c.now.sample = done


@inner
def _fly(c, slope):
    """Write the samples after the end of contact; `slope` is dS/dt there."""
    # The chain moves with the striker. Derivatives include the shift of the end of contact.
    p, y, now, top, gravity = c.p, c.y, c.now.now, c.groups - 1, c.drive.gravity
    speed, pull, first = y[2 * top + 1], c.stage[2 * top + 1] - gravity, int(c.now.sample)
    for j in range(1 + p):
        _coast(c, row_of(c, j, c.none), first, c.samples, now, 0.0, 0.0, 0.0)
    reach = past(c.common, (c.groups + 1) * p)
    for g in range(c.groups):
        place, quick = place_nodes(c, g, y, reach), y[2 * g - 1] if g > 0 else 0.0
        for i in range(c.first[g], c.first[g + 1]):
            place += _rise(c, i, reach)
            quick += spring(c, i).height * spring(c, i).rate
            if i == c.first[g + 1] - 1:
                place, quick = y[2 * g], y[2 * g + 1]
                for j in range(p):
                    reach[j] = y[c.base + 2 * g * p + j]
            if c.shown == 2 and i < c.count - 1:
                continue
            node = 1 + i if c.shown > 2 else 1
            for j in range(1 + p):
                at, fast, more = place, speed, gravity
                if j > 0:
                    late = -c.common[j - 1] / slope if slope != 0.0 else 0.0
                    fast = y[c.base + (2 * top + 1) * p + j - 1] + pull * late
                    at, more = reach[j - 1] + (quick - speed) * late, 0.0
                _coast(c, row_of(c, j, node), first, c.samples, now, at, fast, more)


@sampling
def sample_task(c, y, at, k, want):
    """Do what `write` is asked for."""
    if k == INSIDE:
        _write_inside(c, at, want)
    elif k == FLIGHT:
        _fly(c, at)
    elif k == APPROACH:
        _approach(c, at)
    else:
        write_sample(c, y, at, k, want)
