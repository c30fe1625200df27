"""The judge of springs with memory: microscale springs and relaxation, by brute force.

Like independent.py (the same steps, and its bistable law) it shares nothing with the solver, and
uses another method: the state of a microscale spring is its equilibrium stress s, in which its
strain (1-p) s/(k0+s) + p (eps_star + s/(kc+s)) is explicit on every branch, so that ds/dt is
(dε/dt)/(dε/ds) and no root of the law is ever looked for; what relaxes is integrated beside it as
z = q - g s. A spring carries T = (1 + Σ g) s + Σ z and its dashpot. Springs between two nodes that
have mass, are clamped or are driven carry one stress S; of those without a dashpot S = T, hence

    dε/dt = (dε/ds) (dS/dt - Σ dz/dt)/(1 + Σ g),

and dS/dt follows from the elongation, from the prescribed stress, or from a flat branch.

The rank of a spring that is held is a normal score w: it snaps through again where
ln s = ln sigma_plus + spread_plus w, and back where ln s = ln sigma_minus + spread_minus w. A step
ends at each turning point of s on a branch that snaps (where ds/dt, a rate of the state, changes
sign), at each end of a branch, sample and kink of the drive; the normal distribution is crossed in
steps of at most one standard deviation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from independent import (
    _A,
    _B,
    _C,
    _E3,
    _E5,
    DAMPER,
    DONE,
    ETA,
    FLAT,
    K0,
    KC,
    LINE,
    MASS,
    MOST_WORK,
    MOTION,
    NO_STEP,
    ONE_SIDED,
    RISEN,
    STRESS,
    TIGHT,
    TOO_LONG,
    WHY,
    A,
    Array,
    H,
    Integers,
    Truth,
    _bounds,
    _linear,
    _sigma,
    _slope,
    _turn,
    bistable_row,
)  # fmt: skip
from numba import njit

# Branches of a microscale spring: p is held; p = P+; p = raw P-; both are the same.
HELD, SNAP, BACK, BOTH = range(7, 11)
# Columns of a microscale spring beside K0, KC, ETA and H.
EPS_STAR, LOG_PLUS, WIDE_PLUS, LOG_MINUS, WIDE_MINUS = 2, 3, 4, 5, 6
FAR = 8.0  # standard deviations beyond which the normal distribution is 0 or 1 to rounding
# What only other loops call is compiled once, as a part of them.
inner = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


# ------------------------------------------------------------------------------------ the law


def _microscale(spring: Any, height: float) -> list[float]:
    row = [0.0] * 13
    row[K0], row[KC], row[EPS_STAR] = spring.k0, spring.kc, spring.eps_star
    row[LOG_PLUS], row[WIDE_PLUS] = math.log(spring.sigma_plus), spring.spread_plus
    row[LOG_MINUS], row[WIDE_MINUS] = math.log(spring.sigma_minus), spring.spread_minus
    row[ETA], row[H] = spring.eta, height
    return row


@inner
def _score(p: Array, branch: int, rank: float, s: float) -> tuple[float, float]:
    """Normal score of what is snapped, and the spread by which it follows ln s (0 = held)."""
    if branch == HELD:
        return rank, 0.0
    if s <= 0.0:
        return -math.inf, 0.0
    if branch == BACK:
        return (math.log(s) - p[LOG_MINUS]) / p[WIDE_MINUS], p[WIDE_MINUS]
    return (math.log(s) - p[LOG_PLUS]) / p[WIDE_PLUS], p[WIDE_PLUS]


@inner
def _mixture(p: Array, branch: int, rank: float, s: float) -> tuple[float, float]:
    """Strain of a microscale spring at a stress, and dε/ds; infinite past the pole."""
    u, wide = _score(p, branch, rank, s)
    snapped, whole = 0.5 * math.erfc(-u / math.sqrt(2.0)), 0.5 * math.erfc(u / math.sqrt(2.0))
    if p[K0] + s <= 0.0 or (snapped > 0.0 and p[KC] + s <= 0.0):
        return -math.inf, math.nan
    a, c = s / (p[K0] + s), p[EPS_STAR] + s / (p[KC] + s)
    soft = whole * p[K0] / (p[K0] + s) ** 2 + snapped * p[KC] / (p[KC] + s) ** 2
    if wide > 0.0:
        density = math.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
        soft += density / (wide * s) * (c - a)
    return whole * a + snapped * c, soft


@inner
def _lag(p: Array, log_s: float) -> float:
    """Score of snap-back less that of snap-through at a stress; above 0 the spring is hysteretic.

    Well below every stress at -inf.
    """
    slope = 1.0 / p[WIDE_MINUS] - 1.0 / p[WIDE_PLUS]
    constant = p[LOG_PLUS] / p[WIDE_PLUS] - p[LOG_MINUS] / p[WIDE_MINUS]
    if slope == 0.0:
        return constant
    if log_s == -math.inf:
        return -slope
    return log_s * slope + constant


@inner
def _meets(p: Array) -> tuple[float, bool]:
    """Stress at which both scores are the same, and whether the spring is hysteretic above it."""
    slope = 1.0 / p[WIDE_MINUS] - 1.0 / p[WIDE_PLUS]
    constant = p[LOG_PLUS] / p[WIDE_PLUS] - p[LOG_MINUS] / p[WIDE_MINUS]
    if slope == 0.0:
        return (-math.inf if constant > 0.0 else math.inf), True
    at = -constant / slope
    if at > 690.0:
        return math.inf, slope > 0.0
    return (math.exp(at) if at > -690.0 else -math.inf), slope > 0.0


@inner
def _ends(p: Array, branch: int, rank: float) -> tuple[float, float, int, int]:
    """What a branch is followed between (stress or strain), and the branches beyond."""
    if branch < HELD:
        return _bounds(p, branch)
    cross, above = _meets(p)
    if branch == HELD:
        high = math.exp(p[LOG_PLUS] + p[WIDE_PLUS] * rank) if rank > -math.inf else 0.0
        low = math.exp(p[LOG_MINUS] + p[WIDE_MINUS] * rank) if rank > -math.inf else -math.inf
        start = p[LOG_PLUS] + p[WIDE_PLUS] * rank if rank > -math.inf else -math.inf
        return low, high, BACK, (SNAP if _lag(p, start) > 0.0 else BOTH)
    if branch == SNAP:
        return -math.inf, (math.inf if above else cross), SNAP, BOTH
    if branch == BACK:
        return (cross if above else -math.inf), math.inf, BOTH, BACK
    return (
        (-math.inf if above else cross), (cross if above else math.inf), BACK, SNAP,
    )  # fmt: skip


# ----------------------------------------------------------------------------- the equations


@inner
def _rates(
    y: Array,
    out: Array,
    stress: Array,
    branch: Integers,
    ranks: Array,
    springs: Array,
    relax: Array,
    ends: Integers,
    mass: Array,
    drag: float,
    top: int,
    value: float,
    rate: float,
) -> bool:
    """Fill the rates `out` of a state and the `stress` of each group; see independent.py.

    The state is the velocities, then the strain or the stress of each spring, then z of each term.
    """
    groups, count, terms = ends.size, springs.shape[0], relax.shape[1]
    moving = groups if top == MASS else groups - 1
    first_z = moving + count
    held = np.empty(count)  # T
    fade = np.empty(count)  # Σ dz/dt
    gain = np.empty(count)
    soft = np.empty(count)  # dε/ds
    for i in range(count):
        p, x = springs[i], y[moving + i]
        if branch[i] >= HELD:
            s = x
            soft[i] = _mixture(p, branch[i], ranks[i], s)[1]
            if not soft[i] > 0.0:
                return False
        else:
            s = _sigma(p, branch[i], x)
            slope = _slope(p, branch[i], x)
            soft[i] = 1.0 / slope if slope > 0.0 else math.inf
        gain[i], held[i], fade[i] = 1.0, 0.0, 0.0
        for n in range(terms):
            g, tau, at = relax[i, n, 0], relax[i, n, 1], first_z + i * terms + n
            out[at] = 0.0
            if g > 0.0:
                gain[i] += g
                held[i] += y[at]
                out[at] = -(y[at] + g * s) / tau
                fade[i] += out[at]
        held[i] += gain[i] * s
    for g in range(groups):
        i0 = ends[g - 1] if g > 0 else 0
        i1 = ends[g]
        low = y[g - 1] if g > 0 else 0.0
        last = g == groups - 1
        prescribed = last and top == STRESS
        damper = last and top == DAMPER
        high = y[g] if g < moving else rate  # of a driven top
        flow = pull = 0.0
        free, flat = -1, -1
        for i in range(i0, i1):
            if springs[i, ETA] > 0.0:
                flow += springs[i, H] / springs[i, ETA]
                pull += springs[i, H] * held[i] / springs[i, ETA]
            else:
                if free < 0 or soft[i] > soft[free]:
                    free = i
                if soft[i] == math.inf:
                    flat = i
        if prescribed:
            s = value
        elif free >= 0:
            s = held[free]
            if damper:
                high = (value - s) / drag
        elif damper:
            s = (value / drag - low + pull) / (flow + 1.0 / drag)
            high = (value - s) / drag
        elif i1 - i0 == 1:
            s = held[i0] + springs[i0, ETA] * (high - low) / springs[i0, H]
        else:
            s = (high - low + pull) / flow
        stress[g] = s
        rest = high - low
        give = drift = 0.0
        for i in range(i0, i1):
            if springs[i, ETA] > 0.0:
                if i1 - i0 == 1 and not prescribed and not damper:
                    out[moving + i] = (high - low) / springs[i, H]
                else:
                    out[moving + i] = (s - held[i]) / springs[i, ETA]
                rest -= springs[i, H] * out[moving + i]
            else:
                part = springs[i, H] * soft[i] / gain[i]
                give += part
                drift += part * fade[i]
        if free >= 0:
            if prescribed:
                if flat >= 0:
                    return False
                pace = rate
            elif flat >= 0:
                pace = fade[flat]
            else:
                pace = (rest + drift) / give
            for i in range(i0, i1):
                if springs[i, ETA] == 0.0 and i != flat:
                    out[moving + i] = soft[i] * (pace - fade[i]) / gain[i]
                    rest -= springs[i, H] * out[moving + i]
            if flat >= 0:
                out[moving + flat] = rest / springs[flat, H]
    for i in range(count):
        if branch[i] >= HELD:
            out[moving + i] /= soft[i]
    for g in range(moving):
        net = (stress[g + 1] if g + 1 < groups else 0.0) - stress[g]
        if g == groups - 1:
            net += value - drag * y[g]
        out[g] = net / mass[g]
    return True


@inner
def _over(
    y: Array, rates: Array, moving: int, branch: Integers, ranks: Array, springs: Array,
    base: float, lifts: bool, peak: float, paces: Array,
) -> float:  # fmt: skip
    """By how much a state is past the end of a branch, a turn, or contact; negative if not."""
    worst = -math.inf
    for i in range(branch.size):
        low, high, _, _ = _ends(springs[i], branch[i], ranks[i])
        x = y[moving + i]
        unit = springs[i, K0] if branch[i] >= HELD else 1.0
        if branch[i] >= HELD and max(abs(low), abs(high)) < math.inf and high > 0.0:
            unit = high
        worst = max(worst, (low - x) / unit, (x - high) / unit)
        if branch[i] == SNAP:
            worst = max(worst, -rates[moving + i] / paces[i])
        elif branch[i] == BACK:
            worst = max(worst, rates[moving + i] / paces[i])
    if lifts:
        worst = max(worst, -base / peak)
    return worst


@inner
def _leaps(
    y: Array, y1: Array, moving: int, branch: Integers, ranks: Array, springs: Array
) -> bool:
    """Whether a step crosses more than a standard deviation of what snaps."""
    for i in range(branch.size):
        if branch[i] > HELD:
            u0 = _score(springs[i], branch[i], ranks[i], y[moving + i])[0]
            u1 = _score(springs[i], branch[i], ranks[i], y1[moving + i])[0]
            u0, u1 = min(max(u0, -FAR), FAR), min(max(u1, -FAR), FAR)
            if abs(u1 - u0) > 1.0:
                return True
    return False


@inner
def _step(
    y: Array, h: float, k: Array, y1: Array, some: Array, scale: Array, reach: Array, stress: Array,
    branch: Integers, ranks: Array, springs: Array, relax: Array, ends: Integers, mass: Array,
    drag: float, top: int, value: float, rate: float, tol: float, units: Integers,
    tableau: tuple[Array, Array, Array, Array, Array],
) -> float:  # fmt: skip
    """Take a step of length h from y, whose rates are k[0]; see independent.py."""
    ra, rb, rc, re3, re5 = tableau
    size = y.size
    for stage in range(1, 12):
        for j in range(size):
            total = 0.0
            for m in range(stage):
                total += ra[stage, m] * k[m, j]
            y1[j] = y[j] + h * total
        if not _rates(y1, k[stage], stress, branch, ranks, springs, relax, ends, mass, drag, top,
                      value + rate * rc[stage] * h, rate):  # fmt: skip
            return math.inf
    largest = np.zeros(3)
    for j in range(size):
        total = 0.0
        for m in range(12):
            total += rb[m] * k[m, j]
        some[j] = h * total
        y1[j] = y[j] + some[j]
        scale[j] = max(reach[j], abs(y1[j]))
        largest[units[j]] = max(largest[units[j]], scale[j])
    norm5 = norm3 = 0.0
    for j in range(size):
        e5 = e3 = 0.0
        for m in range(12):
            e5 += re5[m] * k[m, j]
            e3 += re3[m] * k[m, j]
        unit = tol * max(scale[j], 1e-6 * largest[units[j]]) + 1e-290
        norm5 += (e5 / unit) ** 2
        norm3 += (e3 / unit) ** 2
    if not math.isfinite(norm5 + norm3):
        return math.inf
    if norm5 == 0.0:
        return 0.0
    return abs(h) * norm5 / math.sqrt((norm5 + 0.01 * norm3) * size)


@inner
def _record(
    y: Array, moving: int, branch: Integers, ranks: Array, springs: Array, times: Array, now: float,
    done: int, pressure: float, nodes: Array, base: Array,
) -> int:  # fmt: skip
    """Write the samples that are due; returns how many are done."""
    while done < times.size and times[done] <= now:
        place = 0.0
        for i in range(springs.shape[0]):
            place += springs[i, H] * _strain(y[moving + i], branch[i], ranks[i], springs[i])
            nodes[i, done] = place
        base[done] = pressure
        done += 1
    return done


@inner
def _strain(x: float, branch: int, rank: float, p: Array) -> float:
    return _mixture(p, branch, rank, x)[0] if branch >= HELD else x


@inner
def _enter(
    y: Array, rates: Array, moving: int, branch: Integers, ranks: Array, springs: Array
) -> int:
    """Change the branch of each spring that is at an end, or turns, on its way out; how many."""
    moved = 0
    for i in range(branch.size):
        low, high, under, over = _ends(springs[i], branch[i], ranks[i])
        x, way = y[moving + i], rates[moving + i]
        before = branch[i]
        if x >= high and way > 0.0:
            branch[i] = over
        elif x <= low and way < 0.0:
            branch[i] = under
        elif (before == SNAP and way < 0.0) or (before == BACK and way > 0.0):
            ranks[i] = _score(springs[i], before, ranks[i], x)[0]
            branch[i] = HELD
        moved += branch[i] != before
    return moved


@njit(cache=True, error_model="numpy")
def _follow(
    springs: Array,
    relax: Array,
    kinds: Integers,
    ends: Integers,
    mass: Array,
    drag: float,
    top: int,
    speed: float,
    times: Array,
    values: Array,
    tol: float,
    most: int,
    nodes: Array,
    base: Array,
    tableau: tuple[Array, Array, Array, Array, Array],
) -> tuple[int, int, int, float, float]:
    """Follow a chain over the samples; see independent.py."""
    count, groups, terms = springs.shape[0], ends.size, relax.shape[1]
    moving = groups if top == MASS else groups - 1
    size = moving + count + count * terms
    y, lost, reach = np.zeros(size), np.zeros(size), np.zeros(size)
    y1, some, scale, near = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    k, f1 = np.empty((12, size)), np.empty(size)
    stress, stress1, stress2 = np.empty(groups), np.empty(groups), np.empty(groups)
    units = np.zeros(size, np.int64)
    units[moving:] = 2
    paces = np.ones(count)
    branch, ranks = kinds.copy(), np.full(count, -math.inf)
    for i in range(count):
        if branch[i] < HELD:
            units[moving + i] = 1
    struck = speed > 0.0
    now, done = (0.0 if struck else times[0]), 0
    if struck:
        y[groups - 1] = speed
        while done < times.size and times[done] < 0.0:
            for i in range(count):
                nodes[i, done] = speed * times[done] if i == count - 1 else 0.0
            base[done] = 0.0
            done += 1
    knot, steps, switches, peak, largest = 0, 0, 0, 0.0, 0.0
    pressed, least, last_base, falling = False, math.inf, 0.0, False
    h = late = value = rate = 0.0
    fresh, since = True, now
    while True:
        if done < times.size and times[done] <= now and not fresh:
            value += rate * (now - since)
            if _rates(y, k[0], stress, branch, ranks, springs, relax, ends, mass, drag, top, value,
                      rate):  # fmt: skip
                done = _record(y, moving, branch, ranks, springs, times, now, done, stress[0],
                               nodes, base)  # fmt: skip
        since = now
        if not struck:
            while knot + 2 < times.size and now >= times[knot + 1]:
                knot += 1
                fresh = True
            if fresh and times.size > 1:
                rate = (values[knot + 1] - values[knot]) / (times[knot + 1] - times[knot])
            value = values[knot] + rate * (now - times[knot])
        fine = _rates(y, k[0], stress, branch, ranks, springs, relax, ends, mass, drag, top, value,
                      rate)  # fmt: skip
        if not fine:
            return FLAT, steps, switches, math.nan, least
        if fresh and not struck and knot > 0 and top == MOTION:  # dashpots feel the mean rate
            a, b = times[knot] - times[knot - 1], times[knot + 1] - times[knot]
            base[knot] += a / (a + b) * (stress[0] - base[knot])
        fresh = False
        moved = _enter(y, k[0], moving, branch, ranks, springs)
        if moved:
            switches += moved
            steps += 1
            if steps > most:
                return TOO_LONG, steps, switches, math.nan, least
            continue
        done = _record(y, moving, branch, ranks, springs, times, now, done, stress[0], nodes, base)
        if done == times.size:
            return DONE, steps, switches, math.nan, least
        for g in range(groups):
            largest = max(largest, abs(stress[g]))
        peak = max(peak, stress[0])
        if struck and not pressed and stress[0] > RISEN * largest:
            pressed = True
        if pressed:
            if stress[0] > last_base and falling:
                least = min(least, last_base / peak)
            falling = stress[0] < last_base
            last_base = stress[0]
        for j in range(size):
            reach[j] = max(reach[j], abs(y[j]))
        for i in range(count):
            paces[i] = max(abs(k[0, moving + i]), 1e-12 * abs(y[moving + i]), 1e-290)
        target = times[done]
        left = (target - now) - late
        if h == 0.0:
            h = 1e-6 * (times[times.size - 1] - now)
        while True:  # until a step is short enough
            steps += 1
            if steps > most:
                return TOO_LONG, steps, switches, math.nan, least
            full = h
            lands = h >= left
            if lands:
                h = left
            elif h > 0.5 * left:
                h = 0.5 * left
            error = _step(y, h, k, y1, some, scale, reach, stress1, branch, ranks, springs, relax,
                          ends, mass, drag, top, value, rate, tol, units, tableau)  # fmt: skip
            if error <= 1.0 and _leaps(y, y1, moving, branch, ranks, springs):
                error = 20.0
            if error <= 1.0:
                break
            h *= max(0.9 * error**-0.125, 0.2) if error < math.inf else 0.1
            if now + 1e-3 * h == now and h < 1e-22:
                return NO_STEP, steps, switches, math.nan, least
        grow = min(0.9 * max(error, 1e-30) ** -0.125, 6.0)
        following = max(full, h * grow) if h < full else h * grow
        at_end = value + rate * h
        if not _rates(y1, f1, stress1, branch, ranks, springs, relax, ends, mass, drag, top, at_end,
                      rate):  # fmt: skip
            return FLAT, steps, switches, math.nan, least
        lifts = pressed and stress[0] > 0.0
        past = _over(y1, f1, moving, branch, ranks, springs, stress1[0], lifts, peak, paces)
        high_at, hit = 1.0, past > 0.0
        if not hit:  # may it have come and gone?
            first = 1.0
            for i in range(count):
                low, high, _, _ = _ends(springs[i], branch[i], ranks[i])
                e0, e1, d0, d1 = y[moving + i], y1[moving + i], k[0, moving + i], f1[moving + i]
                if high < math.inf and d0 > 0.0 > d1:
                    x = _turn(e0, d0, e1, d1, h)
                    if max(e0, e1) + 2.0 * h * d0 * x > high:
                        first = min(first, x)
                if low > -math.inf and d0 < 0.0 < d1:
                    x = _turn(-e0, -d0, -e1, -d1, h)
                    if min(e0, e1) + 2.0 * h * d0 * x < low:
                        first = min(first, x)
                if branch[i] == SNAP or branch[i] == BACK:
                    way = 1.0 if branch[i] == SNAP else -1.0
                    for stage in range(1, 12):
                        if way * k[stage, moving + i] < 0.0:
                            first = min(first, tableau[2][stage])
            if lifts:
                tiny = 1e-5
                for j in range(size):
                    near[j] = y[j] + tiny * h * k[0, j]
                _rates(near, scale, stress2, branch, ranks, springs, relax, ends, mass, drag, top,
                       value + tiny * h * rate, rate)  # fmt: skip
                d0 = (stress2[0] - stress[0]) / (tiny * h)
                for j in range(size):
                    near[j] = y1[j] - tiny * h * f1[j]
                _rates(near, scale, stress2, branch, ranks, springs, relax, ends, mass, drag, top,
                       at_end - tiny * h * rate, rate)  # fmt: skip
                d1 = (stress1[0] - stress2[0]) / (tiny * h)
                if d0 < 0.0 < d1:
                    x = _turn(-stress[0], -d0, -stress1[0], -d1, h)
                    if min(stress[0], stress1[0]) + 2.0 * h * d0 * x < 0.0:
                        first = min(first, x)
            if 1e-6 < first < 1.0:
                _step(y, first * h, k, y1, some, scale, reach, stress1, branch, ranks, springs,
                      relax, ends, mass, drag, top, value, rate, tol, units, tableau)  # fmt: skip
                steps += 1
                _rates(y1, f1, stress1, branch, ranks, springs, relax, ends, mass, drag, top,
                       value + rate * first * h, rate)  # fmt: skip
                past = _over(y1, f1, moving, branch, ranks, springs, stress1[0], lifts, peak,
                             paces)  # fmt: skip
                high_at, hit, lands = first, past > 0.0, False
        if hit:
            lands = False
            low_at = 0.0
            low_past = min(_over(y, k[0], moving, branch, ranks, springs, stress[0], lifts, peak,
                                 paces), 0.0)  # fmt: skip
            high_past = past
            for turn in range(80):
                if high_past <= 1e-16 or high_at - low_at <= 1e-15 * high_at:
                    break
                mid = 0.5 * (low_at + high_at)
                if turn % 3 != 2 and high_past > low_past and high_past < math.inf:
                    mid = high_at - high_past * (high_at - low_at) / (high_past - low_past)
                    nudge = 1e-3 if turn % 3 == 0 else 0.0
                    mid += nudge * (high_at - mid)
                    if not low_at < mid < high_at:
                        mid = 0.5 * (low_at + high_at)
                _step(y, mid * h, k, y1, some, scale, reach, stress1, branch, ranks, springs, relax,
                      ends, mass, drag, top, value, rate, tol, units, tableau)  # fmt: skip
                steps += 1
                _rates(y1, f1, stress1, branch, ranks, springs, relax, ends, mass, drag, top,
                       value + rate * mid * h, rate)  # fmt: skip
                past = _over(y1, f1, moving, branch, ranks, springs, stress1[0], lifts, peak,
                             paces)  # fmt: skip
                if past > 0.0:
                    high_at, high_past = mid, past
                else:
                    low_at, low_past = mid, past
        length = high_at * h
        if high_at < 1.0:
            _step(y, length, k, y1, some, scale, reach, stress1, branch, ranks, springs, relax,
                  ends, mass, drag, top, value, rate, tol, units, tableau)  # fmt: skip
            steps += 1
        for j in range(size):
            more = some[j] - lost[j]
            total = y[j] + more
            lost[j] = (total - y[j]) - more
            y[j] = total
        if lands:
            now, late = target, 0.0
        else:
            more = length + late
            total = now + more
            late = more - (total - now)
            now = total
        h = following
        if hit:
            _rates(y, f1, stress1, branch, ranks, springs, relax, ends, mass, drag, top,
                   value + rate * length, rate)  # fmt: skip
            for i in range(count):
                low, high, _, _ = _ends(springs[i], branch[i], ranks[i])
                for bound in (low, high):
                    x = y[moving + i]
                    floor = 1e-2 if branch[i] < HELD else 1e-290
                    if math.isfinite(bound) and abs(x - bound) <= 1e-15 * max(abs(bound), floor):
                        y[moving + i], lost[moving + i] = bound, 0.0
            if lifts and stress1[0] <= 1e-15 * peak:
                for j in range(done, times.size):  # the chain flies with the striker
                    place = y[groups - 1] * (times[j] - now)
                    for i in range(count):
                        place += springs[i, H] * _strain(
                            y[moving + i], branch[i], ranks[i], springs[i]
                        )
                        nodes[i, j] = place
                    base[j] = 0.0
                return DONE, steps, switches, now, least


# ------------------------------------------------------------------------------------ the judge


def has_memory(chain: Any) -> bool:
    """Whether this judge has to follow a chain."""
    return any(
        hasattr(s, "sigma_plus") or len(getattr(s, "relaxation", ())) > 0 for s in chain.springs
    )


def follow(chain: Any, drive: Any, time: Array, tol: float = TIGHT, most: int = MOST_WORK) -> Truth:
    """Follow a scene once, at one tolerance; its own uncertainty is not known then."""
    count = len(chain.springs)
    rows, kinds = [], []
    for spring, h in zip(chain.springs, chain.heights, strict=True):
        if hasattr(spring, "sigma_plus"):
            rows.append(_microscale(spring, h))
            kinds.append(HELD)
        elif hasattr(spring, "kc"):
            rows.append(bistable_row(spring, h))
            kinds.append(A)
        else:
            rows.append(_linear(spring, h))
            kinds.append(ONE_SIDED if spring.unilateral else LINE)
    springs, branch = np.array(rows), np.array(kinds)
    relaxing = [list(getattr(spring, "relaxation", ())) for spring in chain.springs]
    relax = np.ones((count, max(map(len, relaxing)), 2))
    relax[:, :, 0] = 0.0
    for i, terms in enumerate(relaxing):
        for n, term in enumerate(terms):
            relax[i, n] = term
    time = np.ascontiguousarray(time, float)
    above, speed, values, top = float(chain.masses[-1]), 0.0, np.zeros(time.size), MASS
    drag = chain.site_damping / math.fsum(chain.heights)
    if hasattr(drive, "velocity"):
        above, speed = above + drive.mass, float(drive.velocity)
    elif hasattr(drive, "displacement"):
        above, values, top = 0.0, np.array(drive.displacement, float), MOTION
    else:
        values = np.array(drive.stress, float)
        top = MASS if above > 0.0 else DAMPER if drag > 0.0 else STRESS
    if values[0] != 0.0:
        raise ValueError("a drive must start at zero")
    inside = [i for i in range(count - 1) if chain.masses[i] > 0.0]
    ends = np.array([*(i + 1 for i in inside), count])
    mass = np.array([*(chain.masses[i] for i in inside), above]) / chain.area
    nodes, base = np.zeros((count, time.size)), np.zeros(time.size)
    outcome, steps, switches, end, dip = _follow(
        springs, relax, branch, ends, mass, drag, top, speed, time, values, tol, most // count,
        nodes, base, (_A, _B, _C, _E3, _E5),
    )  # fmt: skip
    why = WHY[outcome]
    if not why and not (np.isfinite(nodes).all() and np.isfinite(base).all()):
        why = "not finite"
    return Truth(
        nodes, base, None if math.isnan(end) else end, math.nan, math.nan, dip, steps, switches, why
    )
