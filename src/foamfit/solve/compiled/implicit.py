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

import numpy as np

from foamfit.solve.compiled import events
from foamfit.solve.compiled.motion import rates
from foamfit.solve.compiled.rates import is_unresolved, remember, stiffness_of
from foamfit.solve.compiled.run import OF_V, OF_W, POINTS, STEPPED, SYSTEMS, spring, stepping
from foamfit.springs.compiled.contract import inner, past


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
assert len(_kept) == SYSTEMS
TO_BASIS = np.ascontiguousarray(np.linalg.inv(_vectors)[_kept])
FROM_BASIS = np.ascontiguousarray(
    _vectors[:, _kept] * np.where(np.abs(EIGEN.imag) > 1e-9, 2.0, 1.0)
)
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
# Newton's method ends at changes of ENOUGH over the tolerance, for derivatives ENOUGH/OF_TANGENTS:
# as they obey linear equations, the next change is smaller by the error of the matrices.
ENOUGH, OF_TANGENTS = 1e-3, 1e6
ROUNDED = 1e-15  # relative error that is nothing but rounding


# ---------------------------------------------------------------- banded systems


@inner
def factor(a, n, reach, pivots):
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
def substitute(a, n, reach, pivots, x):
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
def _scale(c, k):
    """Return the scale of a component; that of nodes is shared."""
    if k < 2 * c.nodes:
        return c.scales[OF_V if k % 2 else OF_W]
    return c.scales[c.kinds[k]]


@inner
def linearise(c, at):
    """Fill the derivatives of the rates by the state, by differences, in bands of 2 reach + 1."""
    places, groups_of, n, reach, jacobian = c.places, c.groups_of, c.carries, c.reach, c.jacobian
    y, f0, f1, wide = c.y, c.f, c.state, 2 * reach + 1
    for k in range(n * wide):
        jacobian[k] = 0.0
    rates(c, y, f0, c.none, at)
    c.drive.beginning = abs(c.carried[0])
    for one in range(n):
        step = 1e-8 * max(abs(y[one]), _scale(c, one))
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
def prepare(c, h):
    """Factor the systems of a step of length h; false if one is singular."""
    n, reach, jacobian = c.carries, c.reach, c.jacobian
    wide, narrow = 3 * reach + 1, 2 * reach + 1
    for e in range(SYSTEMS):
        a, pivots = past(c.systems, e * n * wide), past(c.pivots, e * n)
        for i in range(n):
            for j in range(wide):
                a[i * wide + j] = complex(-jacobian[i * narrow + j], 0.0) if j < narrow else 0j
            a[i * wide + reach] += EIGEN[e] / h
        if not factor(a, n, reach, pivots):
            return False
    return True


# ---------------------------------------------------------------- one step


@inner
def _improve(c, h, column, tol):
    """Take a step of Newton's method for the state (column 0) or a derivative; return its size."""
    wide, base, p, n, reach = c.wide, c.base, c.p, c.carries, c.reach
    rates_at, moves = past(c.stage, wide), past(c.stage, (POINTS + 1) * wide)
    for e in range(SYSTEMS):
        x = past(c.right, e * n)
        for k in range(n):
            one = k if column == 0 else base + k * p + column - 1
            value = 0j
            for i in range(POINTS):
                rate, move = rates_at[i * wide + one], moves[i * wide + one]
                value += TO_BASIS[e, i] * (rate - EIGEN[e] * (move / h))
            x[c.places[k]] = value
        substitute(past(c.systems, e * n * (3 * reach + 1)), n, reach, past(c.pivots, e * n), x)
    # Relative to the scales, for derivatives also to the largest value so far.
    size = most = 0.0
    for k in range(n):
        one, place = (k if column == 0 else base + k * p + column - 1), c.places[k]
        last = c.y[k] + moves[(POINTS - 1) * wide + k]
        scale = max(_scale(c, k), max(abs(c.y[k]), abs(last)))
        per = 1.0 / scale if scale > 0.0 else 0.0
        for i in range(POINTS):
            change = 0.0
            for e in range(SYSTEMS):
                change += (FROM_BASIS[i, e] * c.right[e * n + place]).real
            if not abs(change) < math.inf:  # `max` would pass over what is not a number
                return math.inf
            moves[i * wide + one] += change
            size = max(size, abs(change) * per)
            most = max(most, abs(c.y[one] + moves[i * wide + one]) * per)
    if column == 0:
        return size / tol
    largest = past(c.largest, column - 1)
    largest[0] = most = max(most, largest[0])
    return OF_TANGENTS * size / most if most > 0.0 else 0.0


@inner
def _collocate(c, h, at, tol, want):
    """Solve one step by Newton's method from the guess in its increments; false if it fails."""
    # The state must not depend on whether derivatives are wanted, so it is solved first.
    if not _solve(c, h, at, tol, c.none, c.none + 1):
        return False
    if not want:
        return True
    size, groups = c.count * c.width, c.groups
    for k in range(size):
        c.kept[k] = c.springs[k]
    for g in range(groups):
        c.kept[size + g] = c.carried[g]
    solved = _solve(c, h, at, tol, c.none + 1, 1 + c.p)
    for k in range(size):
        c.springs[k] = c.kept[k]
    for g in range(groups):
        c.carried[g] = c.kept[size + g]
    return solved


@inner
def _solve(c, h, at, tol, first, last):
    """Solve for the state (column 0) or for the derivatives (columns from 1 on)."""
    wide, before, y, state = c.wide, math.inf, c.y, c.state
    total = c.base + c.carries * c.p
    moves = past(c.stage, (POINTS + 1) * wide)
    for turn in range(TURNS_OF_NEWTON):
        for i in range(POINTS):
            for k in range(total):
                state[k] = y[k] + moves[i * wide + k]
            rates(c, state, past(c.stage, (1 + i) * wide), first, at + NODES[i] * h)
            if i == POINTS // 2:
                events.keep_midway(c)
        size = 0.0
        for column in range(first, last):
            size = max(size, _improve(c, h, column, tol))
        if not size < math.inf:
            return False
        if size <= ENOUGH or (turn > 1 and size > 0.3 * before and size <= 0.03):
            return True
        if turn > 2 and size > 2.0 * before:
            return False
        before = size
    return size <= 0.3


@inner
def _size(c, k, old, new):
    """Return the size to which the error of a component is relative.

    Stresses depend on the velocity of a node by its dashpots: by its damping, relative to the
    largest stress, or to the present one where an overdamped contact ends. Velocities of vibrations
    that are damped out are not judged, as they would only shorten the steps.
    """
    size = max(abs(old), abs(new))
    if k >= 2 * c.nodes or k % 2 == 0:
        return max(_scale(c, k), size)
    g = k // 2
    for i in range(c.first[g], c.first[min(g + 2, c.groups)]):
        if spring(c, i).lossy > 0.0:
            return max(_scale(c, k), size)
    damping = stiffness_of(c, g, True) + stiffness_of(c, g + 1, True)
    if c.drive.overdamped > 0.0:
        return max(c.drive.beginning, abs(c.carried[0])) / damping
    return max(c.now.largest / damping, size) if damping > 0.0 else math.inf


@inner
def _error(c, h, tol):
    """Return the error of a step over the tolerance."""
    x, wide, n, reach = c.right, c.wide, c.carries, c.reach
    for k in range(n):
        value = c.stage[k]
        for i in range(POINTS):
            value += OF_ERROR[i] * c.stage[(POINTS + 1 + i) * wide + k] / h
        x[c.places[k]] = complex(value, 0.0)
    substitute(c.systems, n, reach, c.pivots, x)
    size = 0.0
    for k in range(n):
        error = abs(x[c.places[k]].real)
        if not error < math.inf:
            return math.inf
        per = _size(c, k, c.y[k], c.y[k] + c.stage[2 * POINTS * wide + k])
        if per > 0.0 and error > ROUNDED * abs(c.y[k]):
            size = max(size, error / per)
    return size / tol


@inner
def _finish(c, h, at, want):
    """Fill the polynomial of a step, and state and rates at its end."""
    wide, total = c.wide, c.base + c.carries * c.p
    for q in range(POINTS):
        for k in range(total):
            value = 0.0
            for i in range(POINTS):
                value += COEFFICIENTS[q, i] * c.stage[(POINTS + 1 + i) * wide + k]
            c.line[q * wide + k] = value
    for k in range(total):
        c.new[k] = c.y[k] + c.stage[2 * POINTS * wide + k]
    rates(c, c.new, past(c.stage, STEPPED * wide), want, at + h)


@inner
def _guess(c, h, last):
    """Extrapolate the polynomial of the step before, of length `last` (0: none)."""
    wide, total, known = c.wide, c.base + c.carries * c.p, 0.0 < h <= 2.0 * last
    for i in range(POINTS):
        move, x = past(c.stage, (POINTS + 1 + i) * wide), 1.0 + NODES[i] * h / last
        for k in range(total):
            value = whole = 0.0
            for q in range(POINTS - 1 if known else -1, -1, -1):
                value = (value + c.line[q * wide + k]) * x
                whole += c.line[q * wide + k]
            move[k] = value - whole


# ---------------------------------------------------------------- length of steps


@inner
def _allowed(c, h, excess, tol):
    """Return the length to use for a step with this error over the tolerance: h to accept it."""
    r = c.now
    if not excess < math.inf:
        return 0.3 * h
    factor, floor = 0.9 * max(excess, 1e-12) ** (-1.0 / 6.0), max(r.floor, 1e-15 * abs(r.now))
    if excess > 1.0 and h > floor * (1.0 + 1e-9):
        return max(h * min(max(factor, 0.1), 0.9), floor)
    if excess <= 1.0:
        r.damping = 0.0
    # An excessive error is accepted if no shorter step is resolved.
    elif excess * tol > r.damping and is_unresolved(c, h):
        r.damped += excess * tol - r.damping
        r.damping = excess * tol
    proposed = max(h * min(max(factor, 0.2), 5.0), r.floor)
    if excess > 1.0:
        proposed = max(proposed, 2.0 * h)
    whole = r.now + h >= r.horizon
    if proposed >= r.brief:
        r.in_row = r.floor = 0.0
    elif not whole:
        r.in_row += 1.0
        if r.in_row > FOLLOW_LIMIT:
            r.floor = min(max(2.0 * r.floor, 2.0 * h), r.brief)
            proposed = max(proposed, r.floor)
    r.grow = proposed / h
    return h


@stepping
def step(c, want, tol, upto, most):
    """Take one implicit step, shorter ones until it is accurate; return how it ended."""
    r, at = c.now, c.now.now
    linearise(c, at)
    while True:
        h = r.step
        if r.now + h == r.now or not h > 0.0 or r.taken >= most:
            return events.FAILED
        r.taken += 1.0
        _guess(c, h, r.before)
        solved = prepare(c, h)
        if not (solved and _collocate(c, h, at, tol, want)):
            r.step, r.before = 0.3 * h, 0.0
            continue
        excess = _error(c, h, tol)
        allowed = _allowed(c, h, excess, tol)
        if allowed < h:
            r.step = allowed
            continue
        break
    _finish(c, h, at, want)
    remember(c, h, max(upto - r.now, 0.0) if upto < math.inf else h)
    r.before = h
    return events.DOUBTFUL if events.suspicious(c, h) else events.SAMPLED
