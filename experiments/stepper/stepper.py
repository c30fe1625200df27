"""One explicit stepper for chains of springs of any law.

Steps are the pair of Dormand and Prince of order 8(5,3) with dense output of order 7. Switches are
roots on the dense output; derivatives by parameters are further columns of the state, which the
error norm leaves out. The stages of the dense output are computed only in steps that contain a
sample or, by a look at both ends, may contain a switch.

The state is one array: w and v of each node with mass, then of each spring its strain (if other
springs lie between the same nodes), its stress (if its law gives strain by stress) and its
relaxation terms z_k = q_k/g_k - σ with dz/dt = -(z + σ)/τ; then the derivatives, component by
component. Springs without mass between them carry one stress S:

- one spring: its strain follows from the nodes;
- several with dashpots: S = (Δv + Σ h T/η)/(Σ h/η), dε/dt = (S - T)/η;
- some without: S is their T; they share the rest of the elongation by their compliances.

A zero-mass node therefore needs no equation to be solved, and its derivatives are linear algebra.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from contract import (
    BRANCH, BY, BY_HELD, CHANGE, HELD, HELD_NUMBERS, HIGH, LOW, MEMORY, OF_HELD, OF_PARAMETER,
    OF_STRESS, OPTIONS, RESULTS, SLOPE, TURNS, call_begin, call_law, inlined, inner, maker,
)  # fmt: skip
from numba import njit
from numpy.typing import NDArray
from scipy.integrate._ivp import dop853_coefficients as pair

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

STAGES, ALL_STAGES = 12, 16
_A = np.zeros((ALL_STAGES, ALL_STAGES))
_A[:, : pair.A.shape[1]] = pair.A
_A[STAGES, :STAGES] = pair.B
# Coefficients without zeros: stage s is the sum of WEIGHT[k] K[FROM[k]] for FIRST[s] <= k < FIRST[s+1].
_ROWS = [np.flatnonzero(row) for row in _A]
_D = np.zeros((4, ALL_STAGES))
_D[:, :] = pair.D
_ROWS += [np.flatnonzero(row) for row in _D]
FIRST = np.cumsum([0] + [len(row) for row in _ROWS])
FROM = np.concatenate(_ROWS)
WEIGHT = np.concatenate([full[row] for full, row in zip(np.vstack([_A, _D]), _ROWS, strict=True)])
E3, E5 = pair.E3[:13].copy(), pair.E5[:13].copy()

# Directions of derivatives apart from the parameters of a law, as in foamfit.
OWN_ETA, OWN_HEIGHT, DRAG, RELAXING = 20, 21, 22, 23
DONE, TOO_MANY, UNDERFLOW = range(3)
# Columns: of a spring; of its places in the state (-1: none); of its values now.
HEIGHT, ETA, GAIN, OF_SPRING = range(4)
EPS_AT, X_AT, Z_AT, D_EPS_AT, D_Z_AT, IMPLICIT, PLACES = range(7)
EPS, RATE, SIGMA, STRESS, DRIFT, NOW = range(6)
RISEN = 1e-9  # base stress over the largest stress above which its return to zero ends the contact


class Chain(NamedTuple):
    """The constants of a run, and what is known at the present point."""

    rows: Array
    memory: Array
    laws: Integers  #: addresses, (springs, 3)
    spring: Array  #: (springs, OF_SPRING)
    relax: Array  #: g and tau, (springs, 2 terms)
    ends: Integers
    mass: Array
    drag: float
    place: Integers  #: (springs, PLACES)
    now: Array  #: (springs, NOW)
    by: Array  #: results of the laws, (springs, RESULTS)
    carried: Array  #: stress of each group, (groups + 1,)
    directions: Integers
    own: Array  #: derivatives of height and eta, (springs, 2, p), and of the drag, in the last row
    d_held: Array  #: derivatives of held numbers, (springs, HELD_NUMBERS, p)
    part: Array  #: derivatives of stress at fixed strain; at fixed strain and z, total; (2 springs, p)
    d_now: Array  #: of the stresses of the groups, (groups + 1, p); of one elongation and its rate
    d_eps: Array  #: of the strains, (springs, p)


@inlined
def follow_group(c, g, y, f, reach, rate, want):
    """Fill the values of the springs of a group and their part of the rates `f`; return S."""
    i0, i1 = (c.ends[g - 1] if g > 0 else 0), c.ends[g]
    damped, weight, total, loose, flat = 0, 0.0, rate, -1, -1
    for i in range(i0, i1):
        h, eta, gain, at, z_at = c.spring[i, HEIGHT], c.spring[i, ETA], c.spring[i, GAIN], c.place[i, X_AT], c.place[i, Z_AT]
        eps = reach / h if c.place[i, EPS_AT] < 0 else y[c.place[i, EPS_AT]]
        x = y[at] if at >= 0 else 0.0
        sigma = call_law(c.laws[i, 0], i, c.rows, c.memory, eps, x, want, c.by)
        stress, drift = gain * sigma, 0.0
        if gain != 1.0:
            for k in range(c.relax.shape[1] // 2):
                z = y[z_at + k]
                f[z_at + k] = dz = -(z + sigma) / c.relax[i, 2 * k + 1]
                stress += c.relax[i, 2 * k] * z
                drift += c.relax[i, 2 * k] * dz
        c.now[i, EPS], c.now[i, SIGMA], c.now[i, STRESS], c.now[i, DRIFT] = eps, sigma, stress, drift
        if eta > 0.0:
            damped += 1
            weight += h / eta
            total += h / eta * stress
        else:
            loose = i
            if c.by[i, SLOPE] == 0.0:
                flat = i
    if i1 - i0 == 1:
        c.now[i0, RATE] = rate / c.spring[i0, HEIGHT]
        common = c.now[i0, STRESS] + c.spring[i0, ETA] * c.now[i0, RATE]
    elif loose < 0:
        common = total / weight
    else:
        common, soft, rest = c.now[loose, STRESS], 0.0, rate
        for i in range(i0, i1):
            h = c.spring[i, HEIGHT]
            if c.spring[i, ETA] > 0.0:
                rest -= h * (common - c.now[i, STRESS]) / c.spring[i, ETA]
            elif flat < 0:
                compliance = h / (c.spring[i, GAIN] * c.by[i, SLOPE])
                soft += compliance
                rest += compliance * c.now[i, DRIFT]
        for i in range(i0, i1):
            if c.spring[i, ETA] == 0.0:
                if flat < 0:
                    c.now[i, RATE] = (rest / soft - c.now[i, DRIFT]) / (c.spring[i, GAIN] * c.by[i, SLOPE])
                else:
                    c.now[i, RATE] = rest / c.spring[i, HEIGHT] if i == flat else 0.0
    for i in range(i0, i1):
        if i1 - i0 > 1:
            if c.spring[i, ETA] > 0.0:
                c.now[i, RATE] = (common - c.now[i, STRESS]) / c.spring[i, ETA]
            f[c.place[i, EPS_AT]] = c.now[i, RATE]
        if c.place[i, X_AT] >= 0:
            f[c.place[i, X_AT]] = c.by[i, SLOPE] * c.now[i, RATE]
    c.carried[g] = common
    return common


@inlined
def derive_spring(c, i, y, f):
    """Fill the derivatives of the stress of a spring at fixed strain, and at fixed z, total."""
    p, count = c.directions.shape[0], c.ends[-1]
    part, total = c.part[i], c.part[count + i]
    gain, at, terms = c.spring[i, GAIN], c.place[i, D_Z_AT], c.relax.shape[1] // 2
    if c.place[i, IMPLICIT] > 0:
        a, b = c.by[i, BY_HELD], c.by[i, BY_HELD + 1]
        for j in range(p):
            part[j] = a * c.d_held[i, 0, j] + b * c.d_held[i, 1, j]
        for j in range(p):
            if c.directions[j, 0] == i and c.directions[j, 1] < OWN_ETA:
                part[j] += c.by[i, BY + c.directions[j, 1]]
    else:
        for j in range(p):
            if c.directions[j, 0] == i and c.directions[j, 1] < OWN_ETA:
                part[j] = c.by[i, BY + c.directions[j, 1]]
    for j in range(p):
        total[j] = gain * part[j]
    if terms > 0:
        for k in range(terms):
            g = c.relax[i, 2 * k]
            for j in range(p):
                total[j] += g * y[at + k * p + j]
        for j in range(p):
            what = c.directions[j, 1] - RELAXING
            if c.directions[j, 0] == i and what >= 0 and what % 2 == 0:
                total[j] += c.now[i, SIGMA] + y[c.place[i, Z_AT] + what // 2]


@inlined
def relax_spring(c, i, y, f):
    """Fill the rates of the derivatives of the relaxation terms."""
    d_eps, p, terms = c.d_eps[i], c.directions.shape[0], c.relax.shape[1] // 2
    for k in range(terms):
        at, per = c.place[i, D_Z_AT] + k * p, 1.0 / c.relax[i, 2 * k + 1]
        for j in range(p):
            f[at + j] = -per * (y[at + j] + c.by[i, SLOPE] * d_eps[j] + c.part[i, j])
    for j in range(p):
        what = c.directions[j, 1] - RELAXING
        if c.directions[j, 0] == i and what >= 0 and what % 2 == 1:
            z_at, tau = c.place[i, Z_AT] + what // 2, c.relax[i, what]
            f[c.place[i, D_Z_AT] + what // 2 * p + j] += (y[z_at] + c.now[i, SIGMA]) / (tau * tau)


@inlined
def derive_group(c, g, base, y, f):
    """Fill the derivatives of the stress of a group, and of the rates of its springs."""
    i0, i1, p, nodes = (c.ends[g - 1] if g > 0 else 0), c.ends[g], c.directions.shape[0], c.mass.size
    d_reach, d_rate, out, count = c.d_now[nodes + 1], c.d_now[nodes + 2], c.d_now[g], c.ends[-1]
    at = base + 2 * g * p
    for j in range(p):
        d_reach[j], d_rate[j] = y[at + j], y[at + p + j]
    if g > 0:
        for j in range(p):
            d_reach[j] -= y[at - 2 * p + j]
            d_rate[j] -= y[at - p + j]
    for i in range(i0, i1):
        derive_spring(c, i, y, f)
    if i1 - i0 == 1:
        i, total, h_own, eta_own = i0, c.part[count + i0], c.own[2 * i0], c.own[2 * i0 + 1]
        h, eta, rate, eps = 1.0 / c.spring[i, HEIGHT], c.spring[i, ETA], c.now[i, RATE], c.now[i, EPS]
        slope = c.by[i, SLOPE] * c.spring[i, GAIN]
        d_eps = c.d_eps[i]
        for j in range(p):
            d_eps[j] = (d_reach[j] - eps * h_own[j]) * h
            out[j] = slope * d_eps[j] + total[j]
        for j in range(p):
            out[j] += eta_own[j] * rate + eta * h * (d_rate[j] - rate * h_own[j])
        relax_spring(c, i, y, f)
        return
    loose, soft, weight, flat = -1, 0.0, 0.0, -1
    for i in range(i0, i1):
        if c.spring[i, ETA] > 0.0:
            weight += c.spring[i, HEIGHT] / c.spring[i, ETA]
            continue
        loose = i
        if c.by[i, SLOPE] == 0.0:
            flat = i
        else:
            soft += c.spring[i, HEIGHT] / (c.spring[i, GAIN] * c.by[i, SLOPE])
    for i in range(i0, i1):  # of damped springs `total` becomes the whole derivative
        total, h, eta = c.part[count + i], c.spring[i, HEIGHT], c.spring[i, ETA]
        slope, mine = c.spring[i, GAIN] * c.by[i, SLOPE], c.place[i, D_EPS_AT]
        if eta > 0.0:
            for j in range(p):
                total[j] += slope * y[mine + j]
        if loose < 0:
            over = c.now[i, STRESS] - c.carried[g]
            for j in range(p):
                d_rate[j] += h / eta * total[j] + over / eta * (c.own[2 * i, j] - h / eta * c.own[2 * i + 1, j])
        else:
            for j in range(p):
                d_reach[j] -= c.now[i, EPS] * c.own[2 * i, j]
                if eta > 0.0:
                    d_reach[j] -= h * y[mine + j]
                elif flat < 0:
                    d_reach[j] += h / slope * total[j]
    for j in range(p):
        out[j] = d_rate[j] / weight if loose < 0 else d_reach[j] / soft if flat < 0 else c.part[count + flat, j]
        d_reach[j] -= out[j] * soft  # left for a flat branch
    for i in range(i0, i1):
        total, eta, mine = c.part[count + i], c.spring[i, ETA], c.place[i, D_EPS_AT]
        slope = c.spring[i, GAIN] * c.by[i, SLOPE]
        for j in range(p):
            if eta > 0.0:
                f[mine + j] = (out[j] - total[j] - c.now[i, RATE] * c.own[2 * i + 1, j]) / eta
                c.d_eps[i, j] = y[mine + j]
            elif i == flat:
                c.d_eps[i, j] = d_reach[j] / c.spring[i, HEIGHT]
            else:
                c.d_eps[i, j] = (out[j] - total[j]) / slope if slope > 0.0 else 0.0
        relax_spring(c, i, y, f)


@inlined
def rates(c, base, y, f, push, want):
    """Fill the rates f of a state y (with derivatives if `want`)."""
    last, p = c.mass.size - 1, c.directions.shape[0]
    for g in range(last + 1):
        reach, rate = y[2 * g], y[2 * g + 1]
        if g > 0:
            reach, rate = reach - y[2 * g - 2], rate - y[2 * g - 1]
        follow_group(c, g, y, f, reach, rate, want)
        if want:
            derive_group(c, g, base, y, f)
    c.carried[last + 1] = push
    for g in range(last + 1):
        f[2 * g] = y[2 * g + 1]
        drag, per = (c.drag if g == last else 0.0), 1.0 / c.mass[g]
        f[2 * g + 1] = (c.carried[g + 1] - c.carried[g] - drag * y[2 * g + 1]) * per
        if want:
            at, of_drag = base + 2 * g * p, c.own[2 * c.ends[-1]]
            here, above = c.d_now[g], c.d_now[g + 1]
            for j in range(p):
                f[at + j] = y[at + p + j]
                f[at + p + j] = (above[j] - here[j] - drag * y[at + p + j]) * per
            if g == last:
                for j in range(p):
                    f[at + p + j] -= of_drag[j] * y[2 * g + 1] * per


@inlined
def combine(stage, n, first, last, scale, start, out):
    """Fill out = start + scale Σ WEIGHT[k] stage[FROM[k]]."""
    for i in range(0, n, 4):
        a = b = c = d = 0.0
        for k in range(first, last):
            weight, q = WEIGHT[k], FROM[k]
            a += weight * stage[q, i]
            b += weight * stage[q, i + 1]
            c += weight * stage[q, i + 2]
            d += weight * stage[q, i + 3]
        out[i] = start[i] + scale * a
        out[i + 1] = start[i + 1] + scale * b
        out[i + 2] = start[i + 2] + scale * c
        out[i + 3] = start[i + 3] + scale * d


@inlined
def dense(line, y, n, x, out):
    """Fill the state at the share x of the step."""
    z = 1.0 - x
    for i in range(n):
        value = line[4, i] + z * (line[5, i] + x * line[6, i])
        value = line[2, i] + z * (line[3, i] + x * value)
        out[i] = y[i] + x * (line[0, i] + z * (line[1, i] + x * value))


@inner
def look(c, base, line, y, x, state, f, push):
    """Fill the values of the springs at the share x of the step."""
    dense(line, y, base, x, state)
    rates(c, base, state, f, push, 0)


@inner
def excess(c, i, kind):
    """Return how far a spring is past an end of its branch (positive), or the contact past its."""
    if kind == 3:
        return -c.carried[0]
    if kind == 2:
        return -c.memory[i, TURNS] * c.now[i, RATE]
    eps = c.now[i, EPS]
    return eps - c.memory[i, HIGH] if kind == 0 else c.memory[i, LOW] - eps


@inner
def first_event(c, base, line, y, state, f, push, risen):
    """Return share, spring and kind of the first switch in a step; kind -1 if there is none."""
    at, who, what, before = 1.0, -1, -1, 0.0
    for piece in range(1, 5):
        x = 0.25 * piece
        look(c, base, line, y, x, state, f, push)
        found = False
        for i in range(c.ends[-1]):
            for kind in range(4):
                if kind == 3 and (i > 0 or not risen):
                    continue
                if not excess(c, i, kind) > 0.0:
                    continue
                # Illinois' method between the last look and this one
                low, high = before, x
                look(c, base, line, y, low, state, f, push)
                f_low = excess(c, i, kind)
                look(c, base, line, y, high, state, f, push)
                f_high, side = excess(c, i, kind), 0
                if f_low >= 0.0:
                    high = low
                for _ in range(60):
                    if high - low <= 4e-16 or f_high == 0.0:
                        break
                    middle = high - f_high * (high - low) / (f_high - f_low)
                    if not low < middle < high:
                        break
                    look(c, base, line, y, middle, state, f, push)
                    value = excess(c, i, kind)
                    if value > 0.0:
                        high, f_high = middle, value
                        f_low = 0.5 * f_low if side == 1 else f_low
                        side = 1
                    else:
                        low, f_low = middle, value
                        f_high = 0.5 * f_high if side == -1 else f_high
                        side = -1
                    if abs(value) < 1e-15 * abs(c.now[i, EPS]) and kind < 2:
                        high = middle
                        break
                if what < 0 or high < at:
                    at, who, what, found = high, i, kind, True
                look(c, base, line, y, x, state, f, push)
        if found:
            break
        before = x
    return at, who, what


@inner
def suspicious(c, old, dt, risen):
    """Whether a step may contain a switch, by the values at both ends (`old` and now)."""
    if risen and c.carried[0] <= 0.0:
        return True
    for i in range(c.ends[-1]):
        eps, low, high = c.now[i, EPS], c.memory[i, LOW], c.memory[i, HIGH]
        if eps > high or eps < low or c.memory[i, TURNS] * c.now[i, RATE] < 0.0:
            return True
        first, last = old[i, RATE] * dt, c.now[i, RATE] * dt
        if first * last < 0.0:  # an extremum is no further away than this
            most = 0.5 * max(abs(first), abs(last))
            if max(eps, old[i, EPS]) + most > high or min(eps, old[i, EPS]) - most < low:
                return True
    return False


@inner
def change_branch(c, i, up, y, changes):
    """Change the branch of a spring, and the derivatives of its held numbers."""
    at, p = c.place[i, X_AT], c.directions.shape[0]
    x = y[at] if at >= 0 else 0.0
    x = call_law(c.laws[i, 1], i, c.rows, c.memory, c.now[i, EPS], x, up, changes)
    if at < 0:
        return
    y[at] = x
    for j in range(p):
        d_sigma = c.by[i, SLOPE] * c.d_eps[i, j] + c.part[i, j]
        first, second = c.d_held[i, 0, j], c.d_held[i, 1, j]
        for h in range(HELD_NUMBERS):
            by = h * CHANGE
            value = changes[i, by + OF_STRESS] * d_sigma
            value += changes[i, by + OF_HELD] * first + changes[i, by + OF_HELD + 1] * second
            if c.directions[j, 0] == i and c.directions[j, 1] < OWN_ETA:
                value += changes[i, by + OF_PARAMETER + c.directions[j, 1]]
            c.d_held[i, h, j] = value


@maker
def lay_out(rows, laws, implicit, spring, relax, ends, mass, drag, directions):
    """Return the chain at rest, the numbers of values and of all columns, and kinds of values."""
    count, nodes, p, terms = ends[-1], mass.size, directions.shape[0], relax.shape[1] // 2
    place, kinds = np.full((count, PLACES), -1), np.zeros(2 * nodes + count * (2 + terms), np.int64)
    for g in range(nodes):
        kinds[2 * g + 1] = 1
    base, carried, i0 = 2 * nodes, 2 * nodes, 0
    for g in range(nodes):
        for i in range(i0, ends[g]):
            place[i, IMPLICIT] = implicit[i]
            if ends[g] - i0 > 1:
                place[i, EPS_AT], kinds[base] = base, 2
                base += 1
                if spring[i, ETA] > 0.0:
                    place[i, D_EPS_AT] = carried
                    carried += 1
            if implicit[i] > 0:
                place[i, X_AT], kinds[base] = base, 3
                base += 1
            spring[i, GAIN] = 1.0
            if terms > 0:
                place[i, Z_AT], place[i, D_Z_AT] = base, carried
                for k in range(terms):
                    spring[i, GAIN] += relax[i, 2 * k]
                    kinds[base + k] = 3
                base += terms
                carried += terms
        i0 = ends[g]
    for i in range(count):
        for at in (D_EPS_AT, D_Z_AT):
            place[i, at] = base + place[i, at] * p if place[i, at] >= 0 else -1
    own = np.zeros((2 * count + 1, p))
    for j in range(p):
        i, what = directions[j]
        if what == OWN_HEIGHT:
            own[2 * i, j] = 1.0
        elif what == OWN_ETA:
            own[2 * i + 1, j] = 1.0
        elif what == DRAG:
            own[2 * count, j] = 1.0
    memory = np.zeros((count, MEMORY))
    c = Chain(
        rows, memory, laws, spring, relax, ends, mass, drag, place, np.zeros((count, NOW)),
        np.zeros((count, RESULTS)), np.zeros(nodes + 1), directions, own,
        np.zeros((count, HELD_NUMBERS, p)), np.zeros((2 * count, p)), np.zeros((nodes + 3, p)),
        np.zeros((count, p)),
    )  # fmt: skip
    for i in range(count):
        call_begin(laws[i, 2], i, rows, memory)
    return c, base, base + carried * p, kinds


@inlined
def error_of(stage, y, new, base, kinds, scales, tol, dt):
    """Return the error of a step over the tolerance, and raise the scales to its values."""
    five = three = 0.0
    for i in range(base):
        a = b = 0.0
        for q in range(13):
            a += E5[q] * stage[q, i]
            b += E3[q] * stage[q, i]
        scale = scales[kinds[i]]
        size = max(abs(y[i]), abs(new[i]))
        scale = 1.0 / (tol * max(scale, size))
        five += (a * scale) ** 2
        three += (b * scale) ** 2
    if five == 0.0:
        return 0.0
    return dt * five / math.sqrt(base * (five + 0.01 * three))


@inner
def first_step(c, tol):
    """Return a first step, from the fastest vibration of a node at rest."""
    fastest, before = 0.0, 0.0
    for g in range(c.mass.size - 1, -1, -1):
        soft = 0.0
        for i in range(c.ends[g - 1] if g > 0 else 0, c.ends[g]):
            stiff = c.spring[i, GAIN] * c.by[i, SLOPE]
            soft += c.spring[i, HEIGHT] / stiff if stiff > 0.0 else math.inf
        fastest = max(fastest, (1.0 / soft + before) / c.mass[g])
        before = 1.0 / soft
    return 4.0 * tol**0.125 / math.sqrt(fastest)


@inner
def fly(c, base, y, f, t, first, now, out, slope):
    """Fill the samples after the end of contact at `now`; `slope` is dS/dt there."""
    p, top = c.directions.shape[0], 2 * c.mass.size - 2
    for k in range(first, t.size):
        out[0, 0, k], out[0, 1, k] = 0.0, y[top] + y[top + 1] * (t[k] - now)
    for j in range(p):
        at = base + top * p + j
        later = -c.d_now[0, j] / slope if slope < 0.0 else 0.0  # derivative of the end
        d_v = y[at + p] + f[top + 1] * later
        for k in range(first, t.size):
            out[1 + j, 0, k], out[1 + j, 1, k] = 0.0, y[at] + d_v * (t[k] - now)


@inner
def march(c, base, n, kinds, numbers, t, work, old, changes, scales, out):
    """Take the steps of `integrate`."""
    push, speed, tol, most = numbers[1], numbers[2], numbers[3], numbers[4]
    p, count, wide = c.directions.shape[0], c.ends[-1], work.shape[1]
    want = 1 if p > 0 else 0
    stage, line = work[:ALL_STAGES], work[ALL_STAGES : ALL_STAGES + 7]
    y, new, state, f = work[ALL_STAGES + 7], work[ALL_STAGES + 8], work[ALL_STAGES + 9], work[ALL_STAGES + 10]
    top, at, now, end, steps, lost, dt = 2 * c.mass.size - 2, 0, 0.0, t[-1], 0, 0, 0.0
    y[top + 1] = scales[1] = speed
    while at < t.size and t[at] < 0.0:
        out[0, 0, at], out[0, 1, at] = 0.0, speed * t[at]
        for j in range(p):
            out[1 + j, 0, at] = out[1 + j, 1, at] = 0.0
        at += 1
    s, largest, risen, last_error, pending, kind, before, landed = 0, 0.0, False, 1e-4, -1, 0, 0.0, False
    while True:
        # one stage of a step
        if s == 0:
            rates(c, base, y, stage[0], push, want)
            if landed:
                fly(c, base, y, stage[0], t, at, now, out, before)
                return DONE, now, steps, lost
            if pending >= 0:
                before = c.by[pending, SLOPE]
                change_branch(c, pending, kind, y, changes)
                pending = -2 - pending
                continue
            if pending < -1:
                after = c.by[-2 - pending, SLOPE]
                dt *= min(max(math.sqrt(before / after), 0.2), 2.0) if after > 0.0 else 2.0
                pending = -1
            if steps == 0:
                dt = first_step(c, tol)
            for i in range(count):
                old[i, EPS], old[i, RATE] = c.now[i, EPS], c.now[i, RATE]
            s = 1
            steps += 1
            if steps > most:
                return TOO_MANY, now, steps, lost
            if dt > end - now:
                dt = end - now
            scales[0] = max(scales[0], abs(speed) * dt)
            for i in range(base):
                scales[kinds[i]] = max(scales[kinds[i]], abs(stage[0, i]) * dt * 0.1)
        target = new if s == STAGES else state
        combine(stage, n, FIRST[s], FIRST[s + 1], dt, y, target)
        rates(c, base, target, stage[s], push, want)
        s += 1
        if s <= STAGES:
            continue
        if s == STAGES + 1:
            error = error_of(stage, y, new, base, kinds, scales, tol, dt)
            if not error <= 1.0:
                lost += 1
                steps += 1
                dt *= max(0.2, 0.9 * error**-0.125) if error < math.inf else 0.2
                if now + dt == now or steps > most:
                    return UNDERFLOW, now, steps, lost
                s = 1
                continue
            grow = 6.0
            if error > 1e-8:
                grow = min(6.0, max(0.3, 0.9 * error**-0.115 * last_error**0.02))
            last_error = max(error, 1e-4)
            doubtful = suspicious(c, old, dt, risen)
            for i in range(count):
                largest = max(largest, abs(c.now[i, STRESS]))
            ends_at = c.carried[0]
            sampled = at < t.size and t[at] <= now + dt
            if sampled or doubtful:
                for i in range(count):
                    old[i, EPS], old[i, RATE] = c.now[i, EPS], c.now[i, RATE]
                continue
        elif s < ALL_STAGES:
            continue
        # the end of an accepted step
        share, who, kind = 1.0, -1, -1
        if s == ALL_STAGES:
            for i in range(0, wide):
                rise = new[i] - y[i]
                line[0, i], line[1, i] = rise, dt * stage[0, i] - rise
                line[2, i] = 2.0 * rise - dt * (stage[12, i] + stage[0, i])
                f[i] = 0.0
            for q in range(4):
                first = ALL_STAGES + q
                combine(stage, n, FIRST[first], FIRST[first + 1], dt, f, line[3 + q])
            if doubtful:
                share, who, kind = first_event(c, base, line, y, state, f, push, risen)
            reached = now + share * dt
            if who < 0 and now + dt >= end:
                reached = end
            while at < t.size and t[at] <= reached:
                dense(line, y, n, (t[at] - now) / dt, state)
                out[0, 0, at] = follow_group(c, 0, state, f, state[0], state[1], want)
                out[0, 1, at] = state[top]
                if want:
                    derive_group(c, 0, base, state, f)
                    for j in range(p):
                        out[1 + j, 0, at], out[1 + j, 1, at] = c.d_now[0, j], state[base + top * p + j]
                at += 1
        if at == t.size:
            return DONE, math.nan, steps, lost
        risen = risen or (s == ALL_STAGES or who < 0) and ends_at > RISEN * largest
        if who >= 0:
            if kind == 3:  # dS/dt at the end of contact
                look(c, base, line, y, share * (1.0 - 1e-4), state, f, push)
                before = -c.carried[0] / (1e-4 * share * dt)
                landed = True
            dense(line, y, n, share, state)
            for i in range(n):
                y[i] = state[i]
            now += share * dt
            if kind < 3:
                up = kind == 0
                if kind == 2:
                    up = c.memory[who, TURNS] < 0.0
                pending, kind = who, int(up)
            s = 0
            dt *= min(grow, 1.0)
        else:
            for i in range(wide):
                y[i], stage[0, i] = new[i], stage[STAGES, i]
            now += dt
            dt *= grow
            if s == STAGES + 1:
                for i in range(count):
                    old[i, EPS], old[i, RATE] = c.now[i, EPS], c.now[i, RATE]
            s = 1
            steps += 1
            if steps > most:
                return TOO_MANY, now, steps, lost
            if dt > end - now:
                dt = end - now
        for i in range(base):
            scales[kinds[i]] = max(scales[kinds[i]], abs(y[i]))


@njit(**OPTIONS, no_cfunc_wrapper=True)
def integrate(rows, laws, implicit, spring, relax, ends, mass, numbers, t, directions, out):
    """Integrate an impact over sample times; return outcome, end of contact, steps, rejections.

    `numbers`: drag, weight over area, speed, tolerance, bound on steps. `out` (1 + p, 2, n) becomes
    base stress and displacement of the top, and their derivatives.
    """
    c, base, n, kinds = lay_out(rows, laws, implicit, spring, relax, ends, mass, numbers[0], directions)
    work, count = np.zeros((ALL_STAGES + 11, (n + 3) // 4 * 4)), ends[-1]
    old, changes = np.zeros((count, NOW)), np.zeros((count, HELD_NUMBERS * CHANGE))
    return march(c, base, n, kinds, numbers, t, work, old, changes, np.zeros(4), out)
