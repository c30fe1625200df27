"""Implicit steps of a chain, where light masses or dashpots make it stiff.

A step is a polynomial of degree 5 through the state at its start that satisfies the equations of
motion at the five points of the Radau IIA method (order 9; Hairer & Wanner 1996). Newton's method
solves for the increments of state and derivatives at all points, in the basis in which the inverse
of the coefficients is diagonal, so that three linear systems of the size of the state are solved.
They are banded in the order of the groups.

If the error keeps many steps in a row short, something vibrates too fast to be worth resolving:
steps then grow up to a floor regardless of their error, and the vibration is damped out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import cfunc

from foamfit.solve.equilibrium import EPS_AT, INTERNALS, KIND, NUMBERS, X_AT, Z_AT
from foamfit.solve.explicit import (
    BEFORE,
    BEGUN,
    BRIEF,
    DAMPED,
    DAMPING,
    DOUBTFUL,
    FAILED,
    FLOOR,
    GROW,
    HORIZON,
    IN_ROW,
    NOW,
    PRESSED,
    SAMPLED,
    STAGES,
    STEP,
    STEPPING,
    TAKEN,
    suspicious,
    unpack_work,
)
from foamfit.solve.links import DRAGGED, rates, unpack
from foamfit.solve.scene import FREE, STRESS, VISCOUS
from foamfit.springs.compiled.contract import (
    ETA,
    GAIN,
    HEIGHT,
    INTERNAL,
    OPTIONS,
    TANGENT,
    complexes_at,
    floats_at,
    inner,
    past,
)

POINTS = 5


def _radau() -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes c and the matrix A of the method."""
    series = np.zeros(POINTS + 1)
    series[-2:] = 1.0, -1.0
    nodes = np.sort(0.5 * (1.0 + np.real(np.polynomial.legendre.legroots(series))))
    nodes[-1] = 1.0
    powers = np.arange(1, POINTS + 1)
    integrals = nodes[:, None] ** powers / powers
    values = nodes[:, None] ** (powers - 1)
    return nodes, np.linalg.solve(values.T, integrals.T).T


NODES, _A = _radau()
_INVERSE = np.linalg.inv(_A)
_values, _vectors = np.linalg.eig(_INVERSE)
_kept = [int(np.argmin(np.abs(_values.imag)))] + [
    int(k) for k in np.argsort(_values.imag) if _values[k].imag > 1e-9
]
EIGEN = np.array(_values[_kept])  # one of each pair
SYSTEMS = len(_kept)
TO_BASIS = np.ascontiguousarray(np.linalg.inv(_vectors)[_kept])
FROM_BASIS = np.ascontiguousarray(_vectors[:, _kept] * np.where(np.abs(EIGEN.imag) > 1e-9, 2.0, 1.0))
# Coefficients 1 … 5 of the polynomial over the step [0, 1], from increments at the points.
COEFFICIENTS = np.linalg.inv(NODES[:, None] ** np.arange(1, POINTS + 1))
# The error of an embedded method of order 5 that also uses the rate at the start, with weight
# 1/EIGEN[0]: (1 - J h/EIGEN[0]) error = h/EIGEN[0] (f0 + Σ OF_ERROR z/h).
_gamma = 1.0 / float(EIGEN[0].real)
_moments = 1.0 / np.arange(1, POINTS + 1) - np.where(np.arange(POINTS) == 0, _gamma, 0.0)
_weights = np.linalg.solve((NODES[:, None] ** np.arange(POINTS)).T, _moments)
OF_ERROR = (_weights - _A[-1]) @ _INVERSE / _gamma

FOLLOW_LIMIT = 600  # number of short steps in a row that are taken
TURNS_OF_NEWTON = 12
# Newton's method ends at changes of ENOUGH over the tolerance, of derivatives at ENOUGH/OF_TANGENTS: as
# they obey linear equations, the next change is smaller by the error of the matrices.
ENOUGH, OF_TANGENTS = 1e-3, 1e3


class Systems(NamedTuple):
    """The linear systems of a step: pointers."""

    systems: Any  #: factored, complex, SYSTEMS of n rows of 3 reach + 1
    right: Any  #: their right sides, complex, SYSTEMS of n
    jacobian: Any  #: n rows of 2 reach + 1
    pivots: Any  #: SYSTEMS of n integers
    places: Any  #: of the components in the systems
    groups_of: Any  #: groups of the components
    reach: int  #: see `order_state`
    alive: Any  #: vibrations, see `remember`, (groups, 2)
    worst: Any  #: the largest motion and stress at a sample
    largest: Any  #: values of the derivatives, over the scales, (p,)


# ---------------------------------------------------------------- banded systems


@inner
def order_state(c, places, groups_of):  # type: ignore[no-untyped-def]
    """Order the components by groups: fill place and group of each; return size and reach.

    Components couple with those of the neighbouring groups: at places closer than the reach.
    """
    at, most, before = c.none, c.none, c.none
    for g in range(c.groups):
        first = at
        if g < c.nodes:
            for k in range(2):
                places[2 * g + k], groups_of[2 * g + k], at = at, g, at + 1
        for i in range(c.ends[g - 1] if g > 0 else c.none, c.ends[g]):
            n = past(c.numbers, i * NUMBERS)
            if n[EPS_AT] >= 0:
                places[n[EPS_AT]], groups_of[n[EPS_AT]], at = at, g, at + 1
            inside = n[INTERNALS] if n[KIND] == INTERNAL else c.none
            for k in range(c.terms + inside):
                one = n[Z_AT] + k if k < c.terms else n[X_AT] + k - c.terms
                places[one], groups_of[one], at = at, g, at + 1
        most, before = max(most, at - first + before), at - first
    return at, most - 1


@inner
def factor(a, n, reach, pivots):  # type: ignore[no-untyped-def]
    """Factor a banded complex matrix in place, with pivots; a[i, j - i + reach], up to 3 reach."""
    wide = 3 * reach + 1
    for k in range(n):
        last, best, size = min(k + reach, n - 1), k, 0.0
        for i in range(k, last + 1):
            value = a[i * wide + k - i + reach]
            here = abs(value.real) + abs(value.imag)
            if here > size:
                best, size = i, here
        pivots[k] = best
        if not size > 0.0:
            return False
        end = min(k + 2 * reach, n - 1)
        if best != k:
            for j in range(k, end + 1):
                one, other = k * wide + j - k + reach, best * wide + j - best + reach
                a[one], a[other] = a[other], a[one]
        per = 1.0 / a[k * wide + reach]
        for i in range(k + 1, last + 1):
            share = a[i * wide + k - i + reach] * per
            a[i * wide + k - i + reach] = share
            if share != 0.0:
                for j in range(k + 1, end + 1):
                    a[i * wide + j - i + reach] -= share * a[k * wide + j - k + reach]
    return True


@inner
def substitute(a, n, reach, pivots, x):  # type: ignore[no-untyped-def]
    """Solve a factored system in place."""
    wide = 3 * reach + 1
    for k in range(n):
        best = pivots[k]
        if best != k:
            x[k], x[best] = x[best], x[k]
        for i in range(k + 1, min(k + reach, n - 1) + 1):
            x[i] -= a[i * wide + k - i + reach] * x[k]
    for k in range(n - 1, -1, -1):
        total = x[k]
        for j in range(k + 1, min(k + 2 * reach, n - 1) + 1):
            total -= a[k * wide + j - k + reach] * x[j]
        x[k] = total / a[k * wide + reach]


@inner
def linearise(c, m, at, n, reach, work, jacobian):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the rates by the state, by differences, in bands of 2 reach + 1."""
    places, groups_of = work.places, work.groups_of
    y, f0, f1, wide = m.y, m.f, m.state, 2 * reach + 1
    for k in range(n * wide):
        jacobian[k] = 0.0
    rates(c, y, f0, c.none, at)
    for one in range(n):
        step = 1e-8 * max(abs(y[one]), m.scales[m.kinds[one]])
        if step == 0.0:
            step = 1e-12
        kept = y[one]
        y[one] = kept + step
        step = y[one] - kept
        rates(c, y, f1, c.none, at)
        y[one] = kept
        for k in range(n):
            if abs(groups_of[k] - groups_of[one]) <= 1:
                row = places[k]
                jacobian[row * wide + places[one] - row + reach] = (f1[k] - f0[k]) / step
    rates(c, y, f0, c.none, at)


@inner
def prepare(n, reach, h, work):  # type: ignore[no-untyped-def]
    """Factor the systems of a step of length h; false if one is singular."""
    wide, narrow = 3 * reach + 1, 2 * reach + 1
    for e in range(SYSTEMS):
        a, pivots = past(work.systems, e * n * wide), past(work.pivots, e * n)
        for i in range(n):
            for j in range(wide):
                a[i * wide + j] = complex(-work.jacobian[i * narrow + j], 0.0) if j < narrow else 0j
            a[i * wide + reach] += EIGEN[e] / h
        if not factor(a, n, reach, pivots):
            return False
    return True


# ---------------------------------------------------------------- one step


@inner
def _improve(c, m, n, reach, h, column, tol, work):  # type: ignore[no-untyped-def]
    """Take one step of Newton's method for the state (column 0) or a derivative; return its size.

    Sizes are relative to the scales, for derivatives also to the largest value so far.
    """
    wide, base, p = m.wide, c.base, c.p
    rates_at, moves = past(m.stage, wide), past(m.stage, (POINTS + 1) * wide)
    for e in range(SYSTEMS):
        x = past(work.right, e * n)
        for k in range(n):
            one = k if column == 0 else base + k * p + column - 1
            value = 0j
            for i in range(POINTS):
                rate, move = rates_at[i * wide + one], moves[i * wide + one]
                value += TO_BASIS[e, i] * (rate - EIGEN[e] * (move / h))
            x[work.places[k]] = value
        substitute(past(work.systems, e * n * (3 * reach + 1)), n, reach, past(work.pivots, e * n), x)
    size = most = 0.0
    for k in range(n):
        one, place = (k if column == 0 else base + k * p + column - 1), work.places[k]
        scale = max(m.scales[m.kinds[k]], max(abs(m.y[k]), abs(m.y[k] + moves[(POINTS - 1) * wide + k])))
        per = 1.0 / scale if scale > 0.0 else 0.0
        for i in range(POINTS):
            change = 0.0
            for e in range(SYSTEMS):
                change += (FROM_BASIS[i, e] * work.right[e * n + place]).real
            moves[i * wide + one] += change
            size = max(size, abs(change) * per)
            most = max(most, abs(m.y[one] + moves[i * wide + one]) * per)
    if column == 0:
        return size / tol
    largest = past(work.largest, column - 1)
    largest[0] = most = max(most, largest[0])
    return OF_TANGENTS * size / most if most > 0.0 else 0.0


@inner
def _collocate(c, m, n, reach, h, at, tol, want, work):  # type: ignore[no-untyped-def]
    """Solve one step by Newton's method from the guess in its increments; false if it fails."""
    wide, before = m.wide, math.inf
    total = c.base + c.carries * c.p
    moves = past(m.stage, (POINTS + 1) * wide)
    for turn in range(TURNS_OF_NEWTON):
        for i in range(POINTS):
            for k in range(total):
                m.state[k] = m.y[k] + moves[i * wide + k]
            rates(c, m.state, past(m.stage, (1 + i) * wide), want, at + NODES[i] * h)
        size = _improve(c, m, n, reach, h, 0, tol, work)
        for column in range(1, 1 + c.p):
            size = max(size, _improve(c, m, n, reach, h, column, tol, work))
        if not size < math.inf:
            return False
        if size <= ENOUGH or (turn > 1 and size > 0.3 * before and size <= 0.03):
            return True
        if turn > 2 and size > 2.0 * before:
            return False
        before = size
    return size <= 0.3


@inner
def _error(c, m, n, reach, h, tol, work):  # type: ignore[no-untyped-def]
    """Return the error of a step over the tolerance."""
    x, wide = work.right, m.wide
    for k in range(n):
        value = m.stage[k]
        for i in range(POINTS):
            value += OF_ERROR[i] * m.stage[(POINTS + 1 + i) * wide + k] / h
        x[work.places[k]] = complex(value, 0.0)
    substitute(work.systems, n, reach, work.pivots, x)
    size = 0.0
    for k in range(n):
        scale = max(m.scales[m.kinds[k]], max(abs(m.y[k]), abs(m.y[k] + m.stage[2 * POINTS * wide + k])))
        if scale > 0.0:
            size = max(size, abs(x[work.places[k]].real) / scale)
    return size / tol


@inner
def _finish(c, m, h, at, want):  # type: ignore[no-untyped-def]
    """Fill the polynomial of a step, and state and rates at its end."""
    wide, total = m.wide, c.base + c.carries * c.p
    for q in range(POINTS):
        for k in range(total):
            value = 0.0
            for i in range(POINTS):
                value += COEFFICIENTS[q, i] * m.stage[(POINTS + 1 + i) * wide + k]
            m.line[q * wide + k] = value
    for k in range(total):
        m.new[k] = m.y[k] + m.stage[2 * POINTS * wide + k]
    rates(c, m.new, past(m.stage, STAGES * wide), want, at + h)


@inner
def _guess(c, m, h, last):  # type: ignore[no-untyped-def]
    """Extrapolate the polynomial of the step before, of length `last` (0: none)."""
    wide, total = m.wide, c.base + c.carries * c.p
    for i in range(POINTS):
        move = past(m.stage, (POINTS + 1 + i) * wide)
        if not 0.0 < h <= 2.0 * last:
            for k in range(total):
                move[k] = NODES[i] * h * m.stage[k] if last < 0.0 else 0.0
            continue
        x = 1.0 + NODES[i] * h / last
        for k in range(total):
            value = whole = 0.0
            for q in range(POINTS - 1, -1, -1):
                value = (value + m.line[q * wide + k]) * x
                whole += m.line[q * wide + k]
            move[k] = value - whole


# ---------------------------------------------------------------- vibrations


@inner
def stiffness_of(c, g, damped):  # type: ignore[no-untyped-def]
    """Return the stiffness of a group or, if `damped`, its damping; 0 beyond both ends."""
    if g >= c.groups or (g == c.groups - 1 and c.nodes < c.groups and c.top == STRESS):
        return 0.0
    soft = 0.0
    for i in range(c.ends[g - 1] if g > 0 else 0, c.ends[g]):
        s = past(c.springs, i * c.width)
        part = s[ETA] if damped else s[GAIN] * s[TANGENT]
        soft += s[HEIGHT] / part if part > 0.0 else math.inf
    return 1.0 / soft


@inner
def is_unresolved(c, span):  # type: ignore[no-untyped-def]
    """Whether a mass vibrates too fast for a step and keeps vibrating after it."""
    for g in range(c.nodes):
        own = math.sqrt((stiffness_of(c, g, False) + stiffness_of(c, g + 1, False)) * c.per_mass[g])
        fade = 0.5 * c.per_mass[g] * (stiffness_of(c, g, True) + stiffness_of(c, g + 1, True))
        if own * span > 0.5 and fade < own and fade * span < 20.0 and c.top != VISCOUS:
            return True
    return False


@inner
def remember(c, m, span, wait, alive, worst):  # type: ignore[no-untyped-def]
    """Add the vibrations that a step was too long to resolve to those the response lacks.

    A mass whose velocity differs by δv from the initial velocity of the step's polynomial then
    vibrates with amplitude δv/ω. `alive` (groups, 2) sums δv/√ω over all steps, because a vibration
    whose stiffness changes slowly conserves energy over frequency, and keeps the decay rate of the
    slowest: in a row of masses the slowest unresolved vibration decays last, with the amplitude of
    all of them together. `worst` (motion, stress) includes the vibration left after `wait`, at the
    first sample that may show it.
    """
    motion = stress = 0.0
    row = math.sin(0.5 * math.pi / max(c.nodes, 2))
    for g in range(c.nodes):
        below, above = stiffness_of(c, g, False), stiffness_of(c, g + 1, False)
        damping = stiffness_of(c, g, True) + stiffness_of(c, g + 1, True)
        damping += c.drive[DRAGGED] if g == c.groups - 1 else 0.0
        own = math.sqrt((below + above) * c.per_mass[g])
        fade, root = 0.5 * damping * c.per_mass[g], math.sqrt(own)
        if g == c.groups - 1 and c.top != FREE or own == 0.0:
            continue
        started = 0.0
        if own * span > 2.0 and fade < own:
            started = abs(m.line[2 * g] - span * m.y[2 * g + 1]) / span / root
            slow = fade * min(max(2.0 * row * row, 4.0 / (own * span) ** 2), 1.0)
            lasting = alive[2 * g] > 1e-3 * started
            alive[2 * g + 1] = min(slow, alive[2 * g + 1]) if lasting else slow
            alive[2 * g] += started
        if alive[2 * g] > 0.0:
            size = alive[2 * g] / root * math.exp(-alive[2 * g + 1] * wait)
            motion += size
            stress = max(stress, max(below, above) * size)
            alive[2 * g] *= math.exp(-alive[2 * g + 1] * span)
    worst[0], worst[1] = max(worst[0], motion), max(worst[1], stress)


# ---------------------------------------------------------------- length of steps


@inner
def _allowed(c, m, h, excess, tol, rounded):  # type: ignore[no-untyped-def]
    """Return the length to use for a step with this error over the tolerance: h to accept it.

    An excessive error is accepted if rounding dominates it or if no shorter step is resolved.
    """
    r = m.run
    if not excess < math.inf:
        return 0.3 * h
    factor, floor = 0.9 * max(excess, 1e-12) ** (-1.0 / 6.0), max(r[FLOOR], 1e-15 * abs(r[NOW]))
    if excess > 1.0 and not rounded and h > floor * (1.0 + 1e-9):
        return max(h * min(max(factor, 0.1), 0.9), floor)
    if excess <= 1.0:
        r[DAMPING] = 0.0
    elif excess * tol > r[DAMPING] and is_unresolved(c, h):
        r[DAMPED] += excess * tol - r[DAMPING]
        r[DAMPING] = excess * tol
    proposed = max(h * min(max(factor, 0.2), 5.0), r[FLOOR])
    if excess > 1.0:
        proposed = max(proposed, 2.0 * h)
    whole = r[NOW] + h >= r[HORIZON]
    if proposed >= r[BRIEF]:
        r[IN_ROW] = r[FLOOR] = 0.0
    elif not whole:
        r[IN_ROW] += 1.0
        if r[IN_ROW] > FOLLOW_LIMIT:
            r[FLOOR] = min(max(2.0 * r[FLOOR], 2.0 * h), r[BRIEF])
            proposed = max(proposed, r[FLOOR])
    r[GROW] = proposed / h
    return h


@inner
def systems_of(c, words):  # type: ignore[no-untyped-def]
    """Return the systems of a run; their words contain 3 addresses, reach, and integers.

    At the first step, which finds a reach of zero, the components are ordered.
    """
    n = c.carries
    pivots = past(words, 4)
    places, groups_of = past(pivots, SYSTEMS * n), past(pivots, (SYSTEMS + 1) * n)
    if words[3] == 0:
        words[3] = order_state(c, places, groups_of)[1]
    reach = words[3]
    jacobian, alive = floats_at(words[1]), floats_at(words[2])
    worst, right = past(alive, 2 * c.groups), complexes_at(words[0])
    return Systems(
        past(right, SYSTEMS * n), right, jacobian, pivots, places, groups_of, reach, alive, worst,
        past(worst, 2),
    )  # fmt: skip


@cfunc(STEPPING, **OPTIONS, cache=True)
def _step(words, of_work, want, tol, upto, most, of_systems):  # type: ignore[no-untyped-def]
    """Take one implicit step, shorter ones until it is accurate; return how it ended."""
    c, m = unpack(words), unpack_work(of_work)
    work = systems_of(c, of_systems)
    r, at, reach = m.run, m.run[NOW], work.reach
    linearise(c, m, at, c.carries, reach, work, work.jacobian)
    first, first_error = r[STEP], math.inf
    while True:
        h = r[STEP]
        if r[NOW] + h == r[NOW] or not h > 0.0 or r[TAKEN] > most:
            return FAILED
        r[TAKEN] += 1.0
        _guess(c, m, h, r[BEFORE])
        solved = prepare(c.carries, reach, h, work)
        if not (solved and _collocate(c, m, c.carries, reach, h, at, tol, want, work)):
            r[STEP], r[BEFORE] = 0.3 * h, 0.0
            continue
        excess = _error(c, m, c.carries, reach, h, tol, work)
        if first_error == math.inf:
            first, first_error = h, excess
        rounded = h <= 1e-6 * first and excess > 0.3 * first_error
        allowed = _allowed(c, m, h, excess, tol, rounded)
        if allowed < h:
            r[STEP] = allowed
            continue
        break
    _finish(c, m, h, at, want)
    remember(c, m, h, max(upto - r[NOW], 0.0) if upto < math.inf else h, work.alive, work.worst)
    r[BEFORE] = h
    return DOUBTFUL if suspicious(c, h, r[PRESSED] > 0.0) else SAMPLED


IMPLICIT_STEP = _step.address
