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
from typing import Any, NamedTuple

import numpy as np
from contract import (
    BY,
    BY_HELD,
    CHANGE,
    CHANGES,
    COLUMNS,
    DRIFT,
    EPS,
    ETA,
    GAIN,
    HEIGHT,
    HELD_NUMBERS,
    HIGH,
    LOW,
    OF_HELD,
    OF_LAW,
    OF_PARAMETER,
    OF_STRESS,
    OLD_EPS,
    OLD_RATE,
    OPTIONS,
    PER_HEIGHT,
    RATE,
    RELAX,
    RESULTS,
    SIGMA,
    SLOPE,
    STRESS,
    TURNS,
    call_begin,
    call_evaluate,
    call_switch,
    inner,
    past,
    start,
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
# Coefficients without zeros: stage s is the sum of WEIGHT[k] K[FROM[k]], FIRST[s] <= k < FIRST[s+1];
# after the stages come the four higher terms of the dense output, and the errors of order 5 and 3.
_FULL = np.zeros((22, ALL_STAGES))
_FULL[:16], _FULL[16:20], _FULL[20, :13], _FULL[21, :13] = _A, pair.D, pair.E5, pair.E3
_ROWS = [np.flatnonzero(row) for row in _FULL]
NONE = np.array([-row.size % 4 for row in _ROWS])  # zeros at the end of a row
_ROWS = [
    np.append(row, [row[-1] if row.size else 0] * (-row.size % 4)).astype(int) for row in _ROWS
]
FIRST = np.cumsum([0] + [len(row) for row in _ROWS])
FROM = np.concatenate(_ROWS)
WEIGHT = np.concatenate(
    [np.where(np.arange(row.size) < row.size - more, full[row], 0.0)
     for full, row, more in zip(_FULL, _ROWS, NONE, strict=True)]
)  # fmt: skip

# Directions of derivatives apart from the parameters of a law, as in foamfit.
OWN_ETA, OWN_HEIGHT, DRAG, RELAXING = 20, 21, 22, 23
LAST_TERM = 1e-3  # share of the last term of the dense output that counts as its error
DONE, TOO_MANY, UNDERFLOW = range(3)
# Places of a spring in the state (-1: none), and addresses of its law.
EPS_AT, X_AT, Z_AT, D_EPS_AT, D_Z_AT, IMPLICIT, LAW, PLACES = 0, 1, 2, 3, 4, 5, 6, 10
BATCH = 64  # samples that are computed together
RISEN = 1e-9  # base stress over the largest stress above which its return to zero ends the contact


class Chain(NamedTuple):
    """A chain in a run: pointers and sizes."""

    springs: Any  #: rows of `width` numbers, see `contract`
    places: Any  #: rows of PLACES integers
    ends: Any  #: one past the last spring of each group
    directions: Any  #: of the derivatives, (p, 2)
    owned: Any  #: where the list of directions of each spring begins and ends, and these lists
    per_mass: Any  #: of the nodes, area over mass
    carried: Any  #: stress of each group, and the push on the top
    own: Any  #: derivatives of height and of eta of each spring; of drag
    held: Any  #: of the held numbers of each spring
    part: Any  #: of the stress of each spring at fixed strain, then of its T at fixed strain
    common: Any  #: of the stress of each group, of the push; two rows to work with
    strain: Any  #: of the strains
    width: int
    count: int  #: springs
    groups: int
    p: int
    base: int  #: values before the derivatives in the state
    terms: int  #: of relaxation
    drag: float
    none: int  #: 0; a literal is another type, for which functions are compiled again


@inner
def follow_spring(c, i, eps, y, f, want):
    """Fill the values of a spring at a strain, and the rates of its relaxation terms."""
    s, place = past(c.springs, i * c.width), past(c.places, i * PLACES)
    s[EPS] = eps
    if place[X_AT] >= 0:
        s[SIGMA] = y[place[X_AT]]
    call_evaluate(place[LAW], s, past(s, EPS), past(s, SIGMA), 1, want, past(s, RESULTS))
    s[SIGMA] = sigma = s[RESULTS + OF_LAW]
    stress, drift = s[GAIN] * sigma, 0.0
    for k in range(c.terms):
        z, at = y[place[Z_AT] + k], RELAX + 2 * k
        dz = -(z + sigma) / s[at + 1]
        f[place[Z_AT] + k] = dz
        stress += s[at] * z
        drift += s[at] * dz
    s[STRESS], s[DRIFT] = stress, drift
    return stress


@inner
def follow_group(c, g, y, f, want):
    """Fill the values of the springs of a group and their part of the rates `f`; return S."""
    i0, i1 = (c.ends[g - 1] if g > 0 else 0), c.ends[g]
    reach, rate = y[2 * g], y[2 * g + 1]
    if g > 0:
        reach, rate = reach - y[2 * g - 2], rate - y[2 * g - 1]
    if i1 - i0 == 1:
        s, per = past(c.springs, i0 * c.width), c.springs[i0 * c.width + PER_HEIGHT]
        s[RATE] = rate = rate * per
        common = follow_spring(c, i0, reach * per, y, f, want) + s[ETA] * rate
        if c.places[i0 * PLACES + X_AT] >= 0:
            f[c.places[i0 * PLACES + X_AT]] = s[RESULTS + SLOPE] * rate
        c.carried[g] = common
        return common
    weight, total, loose, flat = 0.0, rate, -1, -1
    for i in range(i0, i1):
        s, place = past(c.springs, i * c.width), past(c.places, i * PLACES)
        h, eta, stress = s[HEIGHT], s[ETA], follow_spring(c, i, y[place[EPS_AT]], y, f, want)
        if eta > 0.0:
            weight += h / eta
            total += h / eta * stress
        else:
            loose = i
            if s[RESULTS + SLOPE] == 0.0:
                flat = i
    soft, common = 0.0, total / weight if loose < 0 else 0.0
    if loose >= 0:
        common, total = c.springs[loose * c.width + STRESS], rate
        for i in range(i0, i1):
            s = past(c.springs, i * c.width)
            if s[ETA] > 0.0:
                total -= s[HEIGHT] * (common - s[STRESS]) / s[ETA]
            elif flat < 0:
                compliance = s[HEIGHT] / (s[GAIN] * s[RESULTS + SLOPE])
                soft += compliance
                total += compliance * s[DRIFT]
    for i in range(i0, i1):
        s, place = past(c.springs, i * c.width), past(c.places, i * PLACES)
        if s[ETA] > 0.0:
            s[RATE] = (common - s[STRESS]) / s[ETA]
        elif flat < 0:
            s[RATE] = (total / soft - s[DRIFT]) / (s[GAIN] * s[RESULTS + SLOPE])
        else:
            s[RATE] = total / s[HEIGHT] if i == flat else 0.0
        f[place[EPS_AT]] = s[RATE]
        if place[X_AT] >= 0:
            f[place[X_AT]] = s[RESULTS + SLOPE] * s[RATE]
    c.carried[g] = common
    return common


@inner
def derive_spring(c, i, y):
    """Fill the derivatives of the stress of a spring at fixed strain, and of T at fixed strain."""
    s, place, p = past(c.springs, i * c.width), past(c.places, i * PLACES), c.p
    part, total = past(c.part, i * p), past(c.part, (c.count + i) * p)
    if place[IMPLICIT] > 0:
        a, b, held = s[RESULTS + BY_HELD], s[RESULTS + BY_HELD + 1], past(c.held, 2 * i * p)
        for j in range(p):
            part[j] = a * held[j] + b * held[p + j]
        for k in range(c.owned[i], c.owned[i + 1]):
            part[c.owned[k]] += s[RESULTS + BY + c.directions[2 * c.owned[k] + 1]]
    else:
        for k in range(c.owned[i], c.owned[i + 1]):
            part[c.owned[k]] = s[RESULTS + BY + c.directions[2 * c.owned[k] + 1]]
    gain = s[GAIN]
    for j in range(p):
        total[j] = gain * part[j]
    for k in range(c.terms):
        g, dz = s[RELAX + 2 * k], past(y, place[D_Z_AT] + k * p)
        for j in range(p):
            total[j] += g * dz[j]
            if c.directions[2 * j] == i and c.directions[2 * j + 1] == RELAXING + 2 * k:
                total[j] += s[SIGMA] + y[place[Z_AT] + k]


@inner
def relax_spring(c, i, y, f):
    """Fill the rates of the derivatives of the relaxation terms of a spring."""
    s, place, p = past(c.springs, i * c.width), past(c.places, i * PLACES), c.p
    part, strain = past(c.part, i * p), past(c.strain, i * p)
    for k in range(c.terms):
        at, per = place[D_Z_AT] + k * p, 1.0 / s[RELAX + 2 * k + 1]
        more = (y[place[Z_AT] + k] + s[SIGMA]) * per * per
        for j in range(p):
            f[at + j] = -per * (y[at + j] + s[RESULTS + SLOPE] * strain[j] + part[j])
            if c.directions[2 * j] == i and c.directions[2 * j + 1] == RELAXING + 2 * k + 1:
                f[at + j] += more


@inner
def derive_group(c, g, y, f):
    """Fill the derivatives of the stress of a group, and of the rates of its springs."""
    i0, i1, p = (c.ends[g - 1] if g > 0 else 0), c.ends[g], c.p
    out, dw = past(c.common, g * p), past(y, c.base + 2 * g * p)
    below = past(y, c.base + 2 * max(g - 1, 0) * p)
    if i1 - i0 == 1:
        derive_spring(c, i0, y)
        s, own, strain = (
            past(c.springs, i0 * c.width),
            past(c.own, 2 * i0 * p),
            past(c.strain, i0 * p),
        )
        per, eta, total = s[PER_HEIGHT], s[ETA], past(c.part, (c.count + i0) * p)
        slope, eps, faster = s[RESULTS + SLOPE] * s[GAIN], s[EPS], s[RATE]
        some = 1.0 if g > 0 else 0.0
        for j in range(p):
            longer = (dw[j] - some * below[j] - eps * own[j]) * per
            quicker = (dw[p + j] - some * below[p + j] - faster * own[j]) * per
            strain[j] = longer
            out[j] = slope * longer + total[j] + own[p + j] * faster + eta * quicker
        relax_spring(c, i0, y, f)
        return
    reach, rate = past(c.common, (c.groups + 1) * p), past(c.common, (c.groups + 2) * p)
    some = 1.0 if g > 0 else 0.0
    for j in range(p):
        reach[j], rate[j] = dw[j] - some * below[j], dw[p + j] - some * below[p + j]
    loose, soft, weight, flat = -1, 0.0, 0.0, -1
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] > 0.0:
            weight += s[HEIGHT] / s[ETA]
            continue
        loose = i
        if s[RESULTS + SLOPE] == 0.0:
            flat = i
        else:
            soft += s[HEIGHT] / (s[GAIN] * s[RESULTS + SLOPE])
    for i in range(i0, i1):  # of damped springs `total` becomes the whole derivative
        derive_spring(c, i, y)
        s, own, total = (
            past(c.springs, i * c.width),
            past(c.own, 2 * i * p),
            past(c.part, (c.count + i) * p),
        )
        slope, mine, share = s[GAIN] * s[RESULTS + SLOPE], c.places[i * PLACES + D_EPS_AT], 0.0
        if s[ETA] > 0.0:
            share = s[HEIGHT] / s[ETA]
            for j in range(p):
                total[j] += slope * y[mine + j]
        elif flat < 0:
            share = s[HEIGHT] / slope
        over = (s[STRESS] - c.carried[g]) / s[ETA] if loose < 0 else 0.0
        for j in range(p):
            if loose < 0:
                rate[j] += share * total[j] + over * (own[j] - share * own[p + j])
            else:
                reach[j] -= s[EPS] * own[j] + (
                    s[HEIGHT] * y[mine + j] if s[ETA] > 0.0 else -share * total[j]
                )
    if flat < 0:
        per = 1.0 / (weight if loose < 0 else soft)
        for j in range(p):
            out[j] = per * (rate[j] if loose < 0 else reach[j])
    else:
        for j in range(p):
            out[j] = c.part[(c.count + flat) * p + j]
            reach[j] -= out[j] * soft  # left for the flat branch
    for i in range(i0, i1):
        s, own, total = (
            past(c.springs, i * c.width),
            past(c.own, 2 * i * p),
            past(c.part, (c.count + i) * p),
        )
        slope, mine, strain = (
            s[GAIN] * s[RESULTS + SLOPE],
            c.places[i * PLACES + D_EPS_AT],
            past(c.strain, i * p),
        )
        per = 1.0 / (s[ETA] if s[ETA] > 0.0 else s[HEIGHT] if i == flat else slope)
        for j in range(p):
            if s[ETA] > 0.0:
                f[mine + j] = per * (out[j] - total[j] - s[RATE] * own[p + j])
                strain[j] = y[mine + j]
            else:
                strain[j] = per * (reach[j] if i == flat else out[j] - total[j])
        relax_spring(c, i, y, f)


@inner
def rates(c, y, f, want):
    """Fill the rates f of a state y (with derivatives if `want`)."""
    p = c.p
    for g in range(c.groups):
        follow_group(c, g, y, f, want)
        if want:
            derive_group(c, g, y, f)
    for g in range(c.groups):
        v, per = y[2 * g + 1], c.per_mass[g]
        drag = c.drag if g == c.groups - 1 else 0.0
        f[2 * g] = v
        f[2 * g + 1] = (c.carried[g + 1] - c.carried[g] - drag * v) * per
        if want:
            dv, df = past(y, c.base + (2 * g + 1) * p), past(f, c.base + 2 * g * p)
            here, above, of_drag = (
                past(c.common, g * p),
                past(c.common, (g + 1) * p),
                past(c.own, 2 * c.count * p),
            )
            for j in range(p):
                df[j] = dv[j]
            for j in range(p):
                df[p + j] = (above[j] - here[j] - drag * dv[j]) * per
            if g == c.groups - 1:
                for j in range(p):
                    df[p + j] -= of_drag[j] * v * per


@inner
def combine(stage, wide, n, row, scale, begin, out):
    """Fill out = begin + scale Σ WEIGHT[k] stage[FROM[k]] of a row of coefficients."""
    first, last = FIRST[row], FIRST[row + 1]
    if n <= 8:
        for i in range(0, n, 4):
            a = b = c = d = 0.0
            for k in range(first, last - NONE[row]):
                weight, at = WEIGHT[k], FROM[k] * wide + i
                a += weight * stage[at]
                b += weight * stage[at + 1]
                c += weight * stage[at + 2]
                d += weight * stage[at + 3]
            out[i] = begin[i] + scale * a
            out[i + 1] = begin[i + 1] + scale * b
            out[i + 2] = begin[i + 2] + scale * c
            out[i + 3] = begin[i + 3] + scale * d
        return
    source = begin
    for k in range(first, last, 4):  # loops that are vectorised; rows are filled up with zeros
        one, two, three, four = (
            scale * WEIGHT[k],
            scale * WEIGHT[k + 1],
            scale * WEIGHT[k + 2],
            scale * WEIGHT[k + 3],
        )
        a, b, c, d = (
            past(stage, FROM[k] * wide),
            past(stage, FROM[k + 1] * wide),
            past(stage, FROM[k + 2] * wide),
            past(stage, FROM[k + 3] * wide),
        )
        for i in range(n):
            out[i] = source[i] + (one * a[i] + two * b[i] + (three * c[i] + four * d[i]))
        source = out


@inner
def dense(line, wide, y, n, x, out):
    """Fill the state at the share x of the step."""
    z = 1.0 - x
    for i in range(n):
        value = line[4 * wide + i] + z * (line[5 * wide + i] + x * line[6 * wide + i])
        value = line[2 * wide + i] + z * (line[3 * wide + i] + x * value)
        out[i] = y[i] + x * (line[i] + z * (line[wide + i] + x * value))


@inner
def make_dense(stage, wide, y, new, dt, nil, line):
    """Fill the polynomials of a step."""
    for i in range(wide):
        rise, last = new[i] - y[i], stage[STAGES * wide + i]
        line[i], line[wide + i] = rise, dt * stage[i] - rise
        line[2 * wide + i] = 2.0 * rise - dt * (last + stage[i])
    for q in range(4):
        combine(stage, wide, wide, ALL_STAGES + q, dt, nil, past(line, (3 + q) * wide))


@inner
def excess(c, i, kind):
    """Return how far a spring is past the end of its branch, or the contact past its own."""
    s = past(c.springs, i * c.width)
    if kind == 3:
        return -c.carried[0]
    if kind == 2:
        return -s[TURNS] * s[RATE]
    return s[EPS] - s[HIGH] if kind == 0 else s[LOW] - s[EPS]


@inner
def look(c, line, wide, y, x, state, f, i, kind):
    """Return the excess of a spring at the share x of the step."""
    dense(line, wide, y, c.base, x, state)
    rates(c, state, f, c.none)
    return excess(c, i, kind)


@inner
def locate(c, line, wide, y, dt, low, high, state, f, i, kind):
    """Return where an excess becomes positive between two shares, by Illinois' method."""
    f_low = look(c, line, wide, y, low, state, f, i, kind)
    f_high, side = look(c, line, wide, y, high, state, f, i, kind), 0
    if f_low >= 0.0:
        return low
    s, value, slope, middle = past(c.springs, i * c.width), f_high, 0.0, high
    for _ in range(60):
        if kind < 2:  # Newton's method
            slope = (s[RATE] if kind == 0 else -s[RATE]) * dt
            middle -= value / slope
        if kind >= 2 or not low < middle < high:
            middle = high - f_high * (high - low) / (f_high - f_low)
        if high - low <= 4e-16 or not low < middle < high:
            break
        value = look(c, line, wide, y, middle, state, f, i, kind)
        if kind < 2 and abs(value) < 1e-15:
            return middle
        if value > 0.0:
            f_low *= 0.5 if side == 1 else 1.0
            high, f_high, side = middle, value, 1
        else:
            f_high *= 0.5 if side == -1 else 1.0
            low, f_low, side = middle, value, -1
    return high


@inner
def first_event(c, line, wide, y, dt, state, f, risen):
    """Return share, spring and kind of the first switch in a step; kind -1 if there is none."""
    at, who, what, before, pieces = 1.0, -1, -1, 0.0, 1
    look(c, line, wide, y, 1.0, state, f, c.none, c.none)
    for i in range(c.count):
        s = past(c.springs, i * c.width)
        if s[OLD_RATE] * s[RATE] <= 0.0:  # otherwise one look at the end tells
            pieces = 4
    for piece in range(1, pieces + 1):
        x, missed = piece / pieces, True
        for i in range(c.count):
            for kind in range(4):
                if kind == 3 and (i > 0 or not risen):
                    continue
                if missed:  # or else still known
                    look(c, line, wide, y, x, state, f, i, kind)
                    missed = False
                if excess(c, i, kind) > 0.0:
                    found = locate(c, line, wide, y, dt, before, x, state, f, i, kind)
                    missed = True
                    if what < 0 or found < at:
                        at, who, what = found, i, kind
        if what >= 0:
            break
        before = x
    return at, who, what


@inner
def suspicious(c, dt, risen):
    """Whether a step may contain a switch, by the values at both ends."""
    if risen and c.carried[0] <= 0.0:
        return True
    for i in range(c.count):
        s = past(c.springs, i * c.width)
        eps, old, low, high = s[EPS], s[OLD_EPS], s[LOW], s[HIGH]
        if eps > high or eps < low or s[TURNS] * s[RATE] < 0.0:
            return True
        if s[OLD_RATE] * s[RATE] < 0.0:  # an extremum is no further away than this
            most = 0.5 * dt * max(abs(s[OLD_RATE]), abs(s[RATE]))
            if max(eps, old) + most > high or min(eps, old) - most < low:
                return True
    return False


@inner
def change_branch(c, i, up, y):
    """Change the branch of a spring, and the derivatives of its held numbers."""
    s, place, p = past(c.springs, i * c.width), past(c.places, i * PLACES), c.p
    x = y[place[X_AT]] if place[X_AT] >= 0 else 0.0
    x = call_switch(place[LAW + 1], s, s[EPS], x, up, CHANGES)
    if place[IMPLICIT] == 0:
        return
    y[place[X_AT]] = x
    held = past(c.held, 2 * i * p)
    for j in range(p):
        d_sigma = s[RESULTS + SLOPE] * c.strain[i * p + j] + c.part[i * p + j]
        first, second = held[j], held[p + j]
        for h in range(HELD_NUMBERS):
            by = past(s, CHANGES + h * CHANGE)
            value = by[OF_STRESS] * d_sigma + by[OF_HELD] * first + by[OF_HELD + 1] * second
            if c.directions[2 * j] == i and c.directions[2 * j + 1] < OWN_ETA:
                value += by[OF_PARAMETER + c.directions[2 * j + 1]]
            held[h * p + j] = value


@inner
def error_of(c, errors, wide, y, new, kinds, scales, tol):
    """Return the error of a step over the tolerance."""
    five = three = 0.0
    for i in range(c.base):
        scale = 1.0 / (tol * max(scales[kinds[i]], max(abs(y[i]), abs(new[i]))))
        five += (errors[i] * scale) ** 2
        three += (errors[wide + i] * scale) ** 2
    return five / math.sqrt(c.base * (five + 0.01 * three)) if five != 0.0 else 0.0


@inner
def last_term(c, line, wide, new, kinds, scales, tol):
    """Return the last term of the dense output over the tolerance.

    Where fast processes have died out, it exceeds the error at the end of the step by far.
    """
    size = 0.0
    for i in range(c.base):
        size = max(size, abs(line[6 * wide + i]) / max(scales[kinds[i]], abs(new[i])))
    return LAST_TERM / tol * size


@inner
def first_step(c, tol):
    """Return a first step, from the fastest vibration of a node at rest."""
    fastest, before = 0.0, 0.0
    for g in range(c.groups - 1, -1, -1):
        soft = 0.0
        for i in range(c.ends[g - 1] if g > 0 else 0, c.ends[g]):
            s = past(c.springs, i * c.width)
            soft += s[HEIGHT] / (s[GAIN] * s[RESULTS + SLOPE])
        fastest = max(fastest, (1.0 / soft + before) * c.per_mass[g])
        before = 1.0 / soft
    return 4.0 * tol**0.125 / math.sqrt(fastest)


@inner
def fly(c, y, acceleration, t, first, now, out, slope):
    """Fill the samples after the end of contact at `now`; `slope` is dS/dt there."""
    top, p = 2 * c.groups - 2, c.p
    for k in range(first, t.size):
        out[0, 0, k], out[0, 1, k] = 0.0, y[top] + y[top + 1] * (t[k] - now)
    for j in range(p):
        at = c.base + top * p + j
        # velocity at an end that comes later or earlier
        dv = y[at + p] - acceleration * c.common[j] / slope
        for k in range(first, t.size):
            out[1 + j, 0, k], out[1 + j, 1, k] = 0.0, y[at] + dv * (t[k] - now)


@inner
def polynomial(line, wide, y, i, shares, n, out):
    """Fill component i of the state at n shares of the step."""
    a, b, c, d = line[i], line[wide + i], line[2 * wide + i], line[3 * wide + i]
    e, g, h, first = line[4 * wide + i], line[5 * wide + i], line[6 * wide + i], y[i]
    for k in range(n):
        x = shares[k]
        z = 1.0 - x
        out[k] = first + x * (a + z * (b + x * (c + z * (d + x * (e + z * (g + x * h))))))


@inner
def sample_one(c, first, line, wide, y, now, dt, t, at, n, batch, out):
    """Fill n samples from `at` on where the stress of one spring, `first`, is the base stress."""
    s, place, p, top = (
        past(c.springs, first * c.width),
        past(c.places, first * PLACES),
        c.p,
        2 * c.groups - 2,
    )
    shares, eps, x, work = batch, past(batch, BATCH), past(batch, 2 * BATCH), past(batch, 3 * BATCH)
    w, v, results = past(batch, 4 * BATCH), past(batch, 5 * BATCH), past(batch, 6 * BATCH)
    per, eta, gain, want = s[PER_HEIGHT], s[ETA], s[GAIN], 1 if p > 0 else 0
    for k in range(n):
        shares[k] = (t[at + k] - now) / dt
    polynomial(line, wide, y, c.none, shares, n, w)
    polynomial(line, wide, y, c.none + 1, shares, n, v)
    if place[EPS_AT] >= 0:
        polynomial(line, wide, y, place[EPS_AT], shares, n, eps)
    else:
        for k in range(n):
            eps[k] = w[k] * per
    if place[X_AT] >= 0:
        polynomial(line, wide, y, place[X_AT], shares, n, x)
    sigma, slope = x, past(results, SLOPE * n)
    if place[X_AT] < 0 or want:  # otherwise the state says it
        call_evaluate(place[LAW], s, eps, x, n, want, results)
        sigma = past(results, OF_LAW * n)
    for k in range(n):
        out[0, 0, at + k] = gain * sigma[k] + eta * per * v[k]
    for m in range(c.terms):
        polynomial(line, wide, y, place[Z_AT] + m, shares, n, work)
        for k in range(n):
            out[0, 0, at + k] += s[RELAX + 2 * m] * work[k]
        for j in range(p):
            if c.directions[2 * j] == 0 and c.directions[2 * j + 1] == RELAXING + 2 * m:
                for k in range(n):
                    out[1 + j, 0, at + k] = sigma[k] + work[k]
    if top > 0:
        polynomial(line, wide, y, top, shares, n, work)
        for k in range(n):
            out[0, 1, at + k] = work[k]
    else:
        for k in range(n):
            out[0, 1, at + k] = w[k]
    for j in range(p):
        what, mine = c.directions[2 * j + 1], c.directions[2 * j] == 0
        if not (mine and what >= RELAXING and (what - RELAXING) % 2 == 0):
            for k in range(n):
                out[1 + j, 0, at + k] = 0.0
        polynomial(line, wide, y, c.base + j, shares, n, work)
        own_h, own_eta = c.own[j], c.own[p + j]
        for k in range(n):
            out[1 + j, 1, at + k] = work[k]
            out[1 + j, 0, at + k] += gain * slope[k] * per * (work[k] - own_h * eps[k])
        if mine and what < OWN_ETA:
            by = past(results, (BY + what) * n)
            for k in range(n):
                out[1 + j, 0, at + k] += gain * by[k]
        if place[IMPLICIT] > 0:
            held, ever = gain * c.held[j], gain * c.held[p + j]
            by = past(results, BY_HELD * n)
            for k in range(n):
                out[1 + j, 0, at + k] += held * by[k] + ever * by[n + k]
        if eta > 0.0 or own_eta > 0.0:
            polynomial(line, wide, y, c.base + p + j, shares, n, work)
            for k in range(n):
                out[1 + j, 0, at + k] += per * (
                    own_eta * v[k] + eta * (work[k] - own_h * per * v[k])
                )
        for m in range(c.terms):
            polynomial(line, wide, y, place[D_Z_AT] + m * p + j, shares, n, work)
            for k in range(n):
                out[1 + j, 0, at + k] += s[RELAX + 2 * m] * work[k]
        if top > 0:
            polynomial(line, wide, y, c.base + top * p + j, shares, n, work)
            for k in range(n):
                out[1 + j, 1, at + k] = work[k]


@inner
def keep_values(c):
    """Keep strains and rates of the beginning of a step; return the largest stress."""
    largest = 0.0
    for i in range(c.count):
        s = past(c.springs, i * c.width)
        s[OLD_EPS], s[OLD_RATE] = s[EPS], s[RATE]
        largest = max(largest, abs(s[STRESS]))
    return largest


@njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False)
def integrate(whole, work, numbers, t, out):
    """Integrate an impact over sample times; return outcome, end of contact, steps, rejections.

    `whole` and `work`, which begins with the rows of `contract`, are laid out by `Prepared`;
    `work` is overwritten. `numbers`: drag, weight over area, speed, tolerance, bound on steps. `out`
    (1 + p, 2, n) becomes base stress and displacement of the top, and their derivatives.
    """
    drag, push, speed, tol, most = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    count, groups, p, base, n, terms = whole[0], whole[1], whole[2], whole[3], whole[4], whole[5]
    wide, places = (n + 3) // 4 * 4, past(start(whole), 8)
    ends = past(places, count * PLACES)
    directions = past(ends, groups)
    owned = past(directions, 2 * p)
    kinds = past(owned, owned[count])
    width, springs = RELAX + 2 * terms, start(work)
    per_mass = past(springs, count * width)
    scales = past(per_mass, groups)
    carried = past(scales, 4)
    own = past(carried, groups + 1)
    held = past(own, (2 * count + 1) * p)
    part = past(held, 2 * count * p)
    common = past(part, 2 * count * p)
    strain = past(common, (groups + 3) * p)
    stage = past(strain, count * p)
    line, y, new = past(stage, 16 * wide), past(stage, 23 * wide), past(stage, 24 * wide)
    state, f, nil = past(stage, 25 * wide), past(stage, 26 * wide), past(stage, 27 * wide)
    batch = past(stage, 28 * wide)
    errors = past(stage, 13 * wide)  # where the stages of the dense output follow
    c = Chain(
        springs, places, ends, directions, owned, per_mass, carried, own, held, part, common,
        strain, width, count, groups, p, base, terms, drag, whole[6],
    )  # fmt: skip
    for i in range(count):
        springs[i * width + PER_HEIGHT] = 1.0 / springs[i * width + HEIGHT]
        call_begin(places[i * PLACES + LAW + 2], past(c.springs, i * c.width))
    want, first = 1 if p > 0 else 0, 0 if ends[0] == 1 else -1
    for i in range(ends[0]):  # without a dashpot it carries the stress of its group
        if p == 0 and springs[i * width + ETA] == 0.0:
            first = i
    top, at, now, end, steps, lost, dt = 2 * groups - 2, 0, 0.0, t[-1], 0, 0, 0.0
    y[top + 1] = speed
    scales[1], carried[groups] = speed, push
    while at < t.size and t[at] < 0.0:
        out[0, 0, at], out[0, 1, at] = 0.0, speed * t[at]
        for j in range(p):
            out[1 + j, 0, at] = out[1 + j, 1, at] = 0.0
        at += 1
    fresh, largest, risen, last_error, who, kind, before = True, 0.0, False, 1e-4, -1, 0, 0.0
    while True:
        s, doubtful, again, target = 1, False, False, state
        if fresh:
            s = 0
        else:
            keep_values(c)
            dt = min(dt, end - now)
        while True:  # the stages of a step
            if s > 0:
                target = new if s == STAGES else state
                combine(stage, wide, n, s, dt, y, target)
            else:
                target = y
            rates(c, target, past(stage, s * wide), want)
            if s == 0:
                if kind == 3:
                    fly(c, y, stage[top + 1], t, at, now, out, before)
                    return DONE, now, steps, lost
                if who >= 0:
                    before = springs[who * width + RESULTS + SLOPE]
                    change_branch(c, who, kind, y)
                    who = -2 - who
                    continue
                if who < -1:
                    after = springs[(-2 - who) * width + RESULTS + SLOPE]
                    dt *= min(max(math.sqrt(before / after), 0.2), 2.0) if after > 0.0 else 2.0
                    who = -1
                if steps == 0:
                    dt = first_step(c, tol)
                keep_values(c)
                dt, fresh = min(dt, end - now), False
                scales[0] = max(scales[0], speed * dt)
                for i in range(base):
                    scales[kinds[i]] = max(scales[kinds[i]], 0.1 * dt * abs(stage[i]))
            s += 1
            if s == STAGES + 1:
                steps += 1
                for q in range(2):
                    combine(stage, wide, base, 20 + q, dt, nil, past(errors, q * wide))
                error = error_of(c, errors, wide, y, new, kinds, scales, tol)
                if not error <= 1.0:
                    lost, again = lost + 1, True
                    dt *= max(0.2, 0.9 * error**-0.125) if error < math.inf else 0.2
                    if now + dt == now or steps > most:
                        return UNDERFLOW, now, steps, lost
                    s = 1
                    continue
                grow = 6.0
                if error > 1e-8:
                    grow = min(6.0, max(0.3, 0.9 * error**-0.115 * last_error**0.02))
                if again:
                    grow, again = min(grow, 1.0), False
                last_error = max(error, 1e-4)
                doubtful = suspicious(c, dt, risen)
                if not (doubtful or t[at] <= now + dt):
                    break
            if s == ALL_STAGES:
                make_dense(stage, wide, y, new, dt, nil, line)
                size = last_term(c, line, wide, new, kinds, scales, tol)
                if size > 1.0 and dt > 1e-12 * end:
                    lost, again = lost + 1, True
                    dt *= max(0.3, 0.9 * size**-0.143)
                    s = 1
                    continue
                if size > 0.0:
                    grow = min(grow, 0.9 * size**-0.143)
                break
        share, here = 1.0, carried[0]
        who = kind = -1
        if s == ALL_STAGES:
            if doubtful:
                share, who, kind = first_event(c, line, wide, y, dt, state, f, risen)
            reached = end if who < 0 and now + dt >= end else now + share * dt
            while first >= 0 and at < t.size and t[at] <= reached:
                last = at + 1
                while last < t.size and last - at < BATCH and t[last] <= reached:
                    last += 1
                sample_one(c, first, line, wide, y, now, dt, t, at, last - at, batch, out)
                at = last
            while at < t.size and t[at] <= reached:
                dense(line, wide, y, n, (t[at] - now) / dt, state)
                out[0, 0, at], out[0, 1, at] = follow_group(c, c.none, state, f, want), state[top]
                if want:
                    derive_group(c, c.none, state, f)
                    for j in range(p):
                        out[1 + j, 0, at], out[1 + j, 1, at] = common[j], state[base + top * p + j]
                at += 1
            if at == t.size:
                return DONE, math.nan, steps, lost
            if who < 0:  # values at the end of the step
                rates(c, new, f, c.none)
                here = carried[0]
        if steps >= most:
            return TOO_MANY, now, steps, lost
        if who >= 0:
            if kind == 3:  # dS/dt at the end of contact
                after = look(c, line, wide, y, share + 1e-3, state, f, c.none, 3 + c.none)
                before = (
                    after - look(c, line, wide, y, share - 1e-3, state, f, c.none, 3 + c.none)
                ) / (-2e-3 * dt)
            elif kind == 2:
                kind = int(springs[who * width + TURNS] < 0.0)
            else:
                kind = 1 - kind
            dense(line, wide, y, n, share, state)
            for i in range(n):
                y[i] = state[i]
            now += share * dt
            fresh = True
            dt *= min(grow, 1.0)
        else:
            largest = max(largest, keep_values(c))
            risen = risen or here > RISEN * largest
            for i in range(wide):
                y[i], stage[i] = new[i], stage[STAGES * wide + i]
            now += dt
            dt *= grow
        for i in range(base):
            scales[kinds[i]] = max(scales[kinds[i]], abs(y[i]))


class Prepared:
    """A chain under an impact, laid out for repeated runs.

    `laws` and `relaxation` (g, τ pairs) are those of the springs, `ends` and `mass` (over the area)
    of the nodes with mass, `directions` (p, 2) the derivatives.
    """

    def __init__(self, laws, ends, mass, terms, etas, directions=()):
        count, groups, self.p, self.terms = len(laws), len(ends), len(directions), terms
        p, place, kinds = self.p, np.full((count, PLACES), -1), [0, 1] * groups
        base, carried, i0 = 2 * groups, 2 * groups, 0
        for end in ends:
            for i in range(i0, end):
                place[i, IMPLICIT], place[i, LAW : LAW + 3] = laws[i].implicit, laws[i].addresses
                if end - i0 > 1:
                    place[i, EPS_AT], base = base, base + 1
                    kinds.append(2)
                    if etas[i] > 0.0:
                        place[i, D_EPS_AT], carried = carried, carried + 1
                if laws[i].implicit:
                    place[i, X_AT], base = base, base + 1
                    kinds.append(3)
                place[i, Z_AT], place[i, D_Z_AT] = base, carried
                base, carried = base + terms, carried + terms
                kinds += [3] * terms
            i0 = end
        for at in (D_EPS_AT, D_Z_AT):
            place[:, at] = np.where(place[:, at] >= 0, base + place[:, at] * p, -1)
        n = base + carried * p
        head = [count, groups, p, base, n, terms, 0, 0]
        mine = [
            [j for j, one in enumerate(directions) if one[0] == i and one[1] < OWN_ETA]
            for i in range(count)
        ]
        lists = [np.cumsum([count + 1, *map(len, mine)]), *mine]
        self.whole = np.concatenate(
            [head, place.ravel(), ends, np.array(directions, np.int64).ravel(), *lists, kinds]
        ).astype(np.int64)
        own = np.zeros((2 * count + 1, p))
        for j, (i, what) in enumerate(directions):
            if what in (OWN_ETA, OWN_HEIGHT, DRAG):
                own[{OWN_HEIGHT: 2 * i, OWN_ETA: 2 * i + 1, DRAG: 2 * count}[what], j] = 1.0
        size = groups + 4 + groups + 1 + own.size + (5 * count + groups + 3) * p
        self.rows = count * (RELAX + 2 * terms)
        self.work = np.zeros(self.rows + size + 28 * ((n + 3) // 4 * 4) + (6 + COLUMNS) * BATCH)
        self.work[self.rows : self.rows + groups] = 1.0 / np.array(mass)
        at = self.rows + 2 * groups + 5  # after scales and stresses
        self.work[at : at + own.size] = own.ravel()

    def run(self, springs, numbers, t):
        """Return outcome, end, steps, rejections, and `out` of `integrate`."""
        out, work = np.empty((1 + self.p, 2, t.size)), self.work.copy()
        work[: self.rows] = springs.ravel()
        return integrate(self.whole, work, numbers, t, out), out


def row(law, values, height, eta=0.0, relaxation=(), terms=0):
    """Return the row of a spring."""
    from contract import ROW

    out, own = np.zeros(RELAX + 2 * terms), law.fill(*values)
    out[ROW : ROW + own.size], out[HEIGHT], out[ETA], out[GAIN] = own, height, eta, 1.0
    out[RELAX + 1 :: 2] = math.inf
    for k, (g, tau) in enumerate(relaxation):
        out[RELAX + 2 * k : RELAX + 2 * k + 2] = g, tau
        out[GAIN] += g
    return out
