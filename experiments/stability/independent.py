"""A judge that shares neither code nor method with the solver: brute force by Runge-Kutta steps.

It reads the public attributes of springs, chain and drive and imports nothing else. The law is
written out branch by branch, its derived points are roots found by bracketing, and the motion is an
ordinary differential equation of the velocities of the nodes with mass and the strains of all
springs: no algebraic equation is solved. The method of Dormand and Prince of order 8(5,3) takes
explicit steps with compensated sums, ends one at each sample, and ends one at each switch of
branch, which it finds by taking the same step again and again with another length.

Springs between two nodes that have mass, are clamped or are driven carry one stress S:

- every spring has a dashpot: S = (v_top - v_bottom + Σ h σ/η)/(Σ h/η), dε/dt = (S - σ)/η;
- some have none: S is the stress of one of these; those with a dashpot follow as above and the
  others share the rest of the elongation's rate by h/slope; a flat branch takes all of it;
- the stress on a massless top is prescribed: S is that, dε/dt = (dS/dt)/slope without a dashpot.

Stiff scenes take many steps: past a bound there is no judgement.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import DOP853
from scipy.optimize import brentq

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

TIGHT, LOOSE = 1e-13, 1e-12  # local error of a step relative to the largest values so far
MOST_WORK = 30_000_000  # steps times springs of one run
# Base stress over the largest stress so far from which on it has risen, and can return to zero.
RISEN = 1e-11

_A, _B, _C = DOP853.A[:12, :12].copy(), DOP853.B.copy(), DOP853.C[:12].copy()
_E3, _E5 = DOP853.E3[:12].copy(), DOP853.E5[:12].copy()

# Columns of a spring.
K0, KC, EPS_A, EPS_C, STAR, SIG_A, SIG_C, UP, DOWN, HAT_A, HAT_C, ETA, H = range(13)
# Branches.
A, D, C, E, LINE, ONE_SIDED, GAP = range(7)
# What is known of the top.
MASS, DAMPER, STRESS, MOTION = range(4)
# How a run ended.
DONE, TOO_LONG, NO_STEP, FLAT = range(4)
WHY = ("", "too many steps", "no step is short enough", "stress prescribed on a flat branch")
SHARED = "several gaps or flat branches share an elongation, and the law does not say how"


# ------------------------------------------------------------------------------------ the law


def bistable_row(spring: Any, height: float) -> list[float]:
    k0, kc, up, down = spring.k0, spring.kc, spring.kh_plus, spring.kh_minus
    eps_a, eps_c = spring.eps_a, spring.eps_c
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + spring.dsigma
    # C2 lies on branch c: x/(1-x) = σ_c/k_c
    star = eps_c - (sigma_c / kc) / (1.0 + sigma_c / kc)

    def c_over_d(eps: float) -> float:  # times the room that is left to the end of branch c
        x = eps - star
        return kc * x - (1.0 - x) * (sigma_a + up * (eps - eps_a))

    def a_over_e(eps: float) -> float:
        return k0 * eps - (1.0 - eps) * (sigma_c + down * (eps - eps_c))

    hat_c = eps_c
    if c_over_d(eps_c) < 0.0:
        hat_c = float(brentq(c_over_d, eps_c, 1.0 + star, xtol=1e-16, rtol=1e-15))
    lowest = -1.0
    if down > 0.0:
        lowest = max((down * (1.0 + eps_c) - k0 - sigma_c) / (2.0 * down), -1e9)
    hat_a = -math.inf
    if a_over_e(eps_a) <= 0.0:
        hat_a = eps_a
    elif lowest < eps_a and a_over_e(lowest) < 0.0:
        hat_a = float(brentq(a_over_e, lowest, eps_a, xtol=1e-16, rtol=1e-15))
    return [
        k0, kc, eps_a, eps_c, star, sigma_a, sigma_c, up, down, hat_a, hat_c, spring.eta, height,
    ]  # fmt: skip


def _linear(spring: Any, height: float) -> list[float]:
    row = [0.0] * 13
    row[K0], row[ETA], row[H] = spring.k0, spring.eta, height
    return row


@njit(cache=True, error_model="numpy")
def _sigma(p: Array, branch: int, eps: float) -> float:
    if branch == A:
        return p[K0] * eps / (1.0 - eps) if eps < 1.0 else math.inf
    if branch == D:
        return p[SIG_A] + p[UP] * (eps - p[EPS_A])
    if branch == C:
        x = eps - p[STAR]
        return p[KC] * x / (1.0 - x) if x < 1.0 else math.inf
    if branch == E:
        return p[SIG_C] + p[DOWN] * (eps - p[EPS_C])
    return 0.0 if branch == GAP else p[K0] * eps


@njit(cache=True, error_model="numpy")
def _slope(p: Array, branch: int, eps: float) -> float:
    if branch == A:
        return p[K0] / (1.0 - eps) ** 2
    if branch == D:
        return p[UP]
    if branch == C:
        return p[KC] / (1.0 - (eps - p[STAR])) ** 2
    if branch == E:
        return p[DOWN]
    return 0.0 if branch == GAP else p[K0]


@njit(cache=True, error_model="numpy")
def _bounds(p: Array, branch: int) -> tuple[float, float, int, int]:
    """Strains at which a branch ends, below and above, and the branches that follow there."""
    if branch == A:
        return -math.inf, p[EPS_A], A, D
    if branch == D:
        return p[EPS_A], p[HAT_C], A, C
    if branch == C:
        return p[EPS_C], math.inf, E, C
    if branch == E:
        return p[HAT_A], p[EPS_C], A, C
    if branch == ONE_SIDED:
        return 0.0, math.inf, GAP, ONE_SIDED
    if branch == GAP:
        return -math.inf, 0.0, GAP, ONE_SIDED
    return -math.inf, math.inf, LINE, LINE


# ----------------------------------------------------------------------------- the equations


@njit(cache=True, error_model="numpy")
def _rates(
    y: Array,
    out: Array,
    stress: Array,
    branch: Integers,
    springs: Array,
    ends: Integers,
    mass: Array,
    drag: float,
    top: int,
    value: float,
    rate: float,
) -> bool:
    """Fill the rates `out` of a state and the `stress` of each group.

    `value` and `rate` are those of the drive (stress or displacement). False on a flat branch under
    a prescribed stress.
    """
    groups = ends.size
    moving = groups if top == MASS else groups - 1
    for g in range(groups):
        i0 = ends[g - 1] if g > 0 else 0
        i1 = ends[g]
        low = y[g - 1] if g > 0 else 0.0
        last = g == groups - 1
        prescribed = last and top == STRESS
        damper = last and top == DAMPER
        high = y[g] if g < moving else rate  # of a driven top
        flow = pull = 0.0
        softest, least = -1, math.inf
        for i in range(i0, i1):
            p = springs[i]
            if p[ETA] > 0.0:
                flow += p[H] / p[ETA]
                pull += p[H] * _sigma(p, branch[i], y[moving + i]) / p[ETA]
            else:
                slope = _slope(p, branch[i], y[moving + i])
                if slope < least:
                    softest, least = i, slope
        if prescribed:
            s = value
        elif softest >= 0:
            s = _sigma(springs[softest], branch[softest], y[moving + softest])
            if damper:
                high = (value - s) / drag
        elif damper:
            s = (value / drag - low + pull) / (flow + 1.0 / drag)
            high = (value - s) / drag
        elif i1 - i0 == 1:
            p = springs[i0]
            s = _sigma(p, branch[i0], y[moving + i0]) + p[ETA] * (high - low) / p[H]
        else:
            s = (high - low + pull) / flow
        stress[g] = s
        rest, soft = high - low, 0.0
        for i in range(i0, i1):
            p = springs[i]
            eps = y[moving + i]
            if p[ETA] > 0.0:
                if i1 - i0 == 1 and not prescribed and not damper:
                    out[moving + i] = (high - low) / p[H]
                else:
                    out[moving + i] = (s - _sigma(p, branch[i], eps)) / p[ETA]
                rest -= p[H] * out[moving + i]
            else:
                slope = _slope(p, branch[i], eps)
                if prescribed:
                    if slope == 0.0:
                        return False
                    out[moving + i] = rate / slope
                elif least > 0.0:
                    soft += p[H] / slope
        if not prescribed and softest >= 0:
            for i in range(i0, i1):
                p = springs[i]
                if p[ETA] == 0.0:
                    if least == 0.0:
                        out[moving + i] = rest / p[H] if i == softest else 0.0
                    else:
                        slope = _slope(p, branch[i], y[moving + i])
                        out[moving + i] = rest / soft / slope
    for g in range(moving):
        net = (stress[g + 1] if g + 1 < groups else 0.0) - stress[g]
        if g == groups - 1:
            net += value - drag * y[g]
        out[g] = net / mass[g]
    return True


@njit(cache=True, error_model="numpy")
def _over(
    y: Array, moving: int, branch: Integers, springs: Array, base: float, lifts: bool, peak: float
) -> float:
    """By how much a state is past the end of a branch, or of contact; negative if it is not."""
    worst = -math.inf
    for i in range(branch.size):
        low, high, _, _ = _bounds(springs[i], branch[i])
        eps = y[moving + i]
        worst = max(worst, low - eps, eps - high)
    if lifts:
        worst = max(worst, -base / peak)
    return worst


@njit(cache=True, error_model="numpy")
def _turn(g0: float, d0: float, g1: float, d1: float, h: float) -> float:
    """Where in a step a quantity that rises at first and falls at last is largest; 1 if nowhere.

    By the cubic through its values and rates at both ends.
    """
    if not (d0 > 0.0 > d1):
        return 1.0
    # rate: d0 + 2 (3m - 2 d0 - d1) x + 3 (d0 + d1 - 2 m) x², m the mean rate
    m = (g1 - g0) / h
    a, b = 3.0 * (d0 + d1 - 2.0 * m), 3.0 * m - 2.0 * d0 - d1
    disc = math.sqrt(max(b * b - a * d0, 0.0))
    x = d0 / (disc - b) if disc - b > 0.0 else 0.5
    return min(max(x, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def _follow(
    springs: Array,
    kinds: Integers,
    ends: Integers,
    mass: Array,
    drag: float,
    top: int,
    speed: float,
    start: Array,
    times: Array,
    values: Array,
    tol: float,
    most: int,
    nodes: Array,
    base: Array,
    log: Array,
    tableau: tuple[Array, Array, Array, Array, Array],
) -> tuple[int, int, int, float, float, float]:
    """Follow a chain over the samples; fills displacements and base stress.

    Returns how it ended, the steps, the switches, the end of contact (NaN if none), the least
    minimum of the base stress before it over its maximum, and the time reached.
    """
    count, groups = springs.shape[0], ends.size
    moving = groups if top == MASS else groups - 1
    size = moving + count
    y, lost, reach = np.zeros(size), np.zeros(size), np.zeros(size)
    y1, some, scale = np.empty(size), np.empty(size), np.empty(size)
    near = np.empty(size)
    k, f1 = np.empty((12, size)), np.empty(size)
    stress, stress1, stress2 = np.empty(groups), np.empty(groups), np.empty(groups)
    branch = kinds.copy()
    struck = speed > 0.0
    now = 0.0 if struck else times[0]
    done = 0
    if struck:
        y[groups - 1] = speed
        while done < times.size and times[done] < 0.0:
            for i in range(count):
                nodes[i, done] = speed * times[done] if i == count - 1 else 0.0
            base[done] = 0.0
            done += 1
    for i in range(count):
        y[moving + i] = start[i]
        while True:  # a spring that starts far along
            _, high, _, after = _bounds(springs[i], branch[i])
            if start[i] <= high:
                break
            branch[i] = after
    knot, steps, switches, peak, largest = 0, 0, 0, 0.0, 0.0
    pressed, least, last_base, falling = False, math.inf, 0.0, False
    h = 0.0
    late = 0.0  # what the clock has lost to rounding
    value = rate = 0.0
    fresh, since = True, now
    while True:
        # samples that are due, by the rate of the drive that led to them
        due = done < times.size and times[done] <= now
        if due and not fresh:
            value += rate * (now - since)
            due = _rates(y, k[0], stress, branch, springs, ends, mass, drag, top, value, rate)
            done = _record(y, moving, springs, times, now, done, stress[0], nodes, base, due)
        # what the drive does from here on
        since = now
        if not struck:
            while knot + 2 < times.size and now >= times[knot + 1]:
                knot += 1
                fresh = True
            if fresh and times.size > 1:
                rate = (values[knot + 1] - values[knot]) / (times[knot + 1] - times[knot])
            value = values[knot] + rate * (now - times[knot])
        fine = _rates(y, k[0], stress, branch, springs, ends, mass, drag, top, value, rate)
        if fresh and not struck and knot > 0 and top == MOTION:  # dashpots feel the mean rate
            a, b = times[knot] - times[knot - 1], times[knot + 1] - times[knot]
            base[knot] += a / (a + b) * (stress[0] - base[knot])
        fresh = False
        # a spring at the end of its branch, on its way out
        moved = False
        for i in range(count):
            low, high, under, over = _bounds(springs[i], branch[i])
            eps, way = y[moving + i], k[0, moving + i]
            if fine and ((eps >= high and way > 0.0) or (eps <= low and way < 0.0)):
                if switches < log.shape[0]:
                    log[switches, 0], log[switches, 1] = now, i
                    log[switches, 2] = branch[i]
                switches += 1
                branch[i] = over if way > 0.0 else under
                moved = True
        if moved:
            steps += 1
            if steps > most:
                return TOO_LONG, steps, switches, math.nan, least, now
            continue
        done = _record(y, moving, springs, times, now, done, stress[0], nodes, base, fine)
        if done == times.size:
            return DONE, steps, switches, math.nan, least, now
        if not fine:
            return FLAT, steps, switches, math.nan, least, now
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
        target = times[done]
        left = (target - now) - late
        if h == 0.0:
            h = 1e-6 * (times[times.size - 1] - now)
        while True:  # until a step is short enough
            steps += 1
            if steps > most:
                return TOO_LONG, steps, switches, math.nan, least, now
            full = h
            lands = h >= left
            if lands:
                h = left
            elif h > 0.5 * left:
                h = 0.5 * left
            error = _step(
                y, h, k, y1, some, scale, reach, stress1, branch, springs, ends, mass, drag, top,
                value, rate, tol, tableau, moving,
            )  # fmt: skip
            if error <= 1.0:
                break
            h *= max(0.9 * error**-0.125, 0.2) if error < math.inf else 0.1
            if now + 1e-3 * h == now and h < 1e-22:
                return NO_STEP, steps, switches, math.nan, least, now
        grow = min(0.9 * max(error, 1e-30) ** -0.125, 6.0)
        following = max(full, h * grow) if h < full else h * grow
        # does a branch, or contact, end in it?
        at_end = value + rate * h
        if not _rates(y1, f1, stress1, branch, springs, ends, mass, drag, top, at_end, rate):
            return FLAT, steps, switches, math.nan, least, now
        lifts = pressed and stress[0] > 0.0
        past = _over(y1, moving, branch, springs, stress1[0], lifts, peak)
        high_at, hit = 1.0, past > 0.0
        if not hit:  # may it have come and gone?
            first = 1.0
            for i in range(count):
                low, high, _, _ = _bounds(springs[i], branch[i])
                e0, e1, d0, d1 = y[moving + i], y1[moving + i], k[0, moving + i], f1[moving + i]
                if high < math.inf and d0 > 0.0 > d1:
                    x = _turn(e0, d0, e1, d1, h)
                    if max(e0, e1) + 2.0 * h * d0 * x > high:
                        first = min(first, x)
                if low > -math.inf and d0 < 0.0 < d1:
                    x = _turn(-e0, -d0, -e1, -d1, h)
                    if min(e0, e1) + 2.0 * h * d0 * x < low:
                        first = min(first, x)
            if lifts:
                tiny = 1e-5
                for j in range(size):
                    near[j] = y[j] + tiny * h * k[0, j]
                _rates(near, scale, stress2, branch, springs, ends, mass, drag, top,
                       value + tiny * h * rate, rate)  # fmt: skip
                d0 = (stress2[0] - stress[0]) / (tiny * h)
                for j in range(size):
                    near[j] = y1[j] - tiny * h * f1[j]
                _rates(near, scale, stress2, branch, springs, ends, mass, drag, top,
                       at_end - tiny * h * rate, rate)  # fmt: skip
                d1 = (stress1[0] - stress2[0]) / (tiny * h)
                if d0 < 0.0 < d1:
                    x = _turn(-stress[0], -d0, -stress1[0], -d1, h)
                    if min(stress[0], stress1[0]) + 2.0 * h * d0 * x < 0.0:
                        first = min(first, x)
            if 1e-6 < first < 1.0:
                _step(
                    y, first * h, k, y1, some, scale, reach, stress1, branch, springs, ends, mass,
                    drag, top, value, rate, tol, tableau, moving,
                )  # fmt: skip
                steps += 1
                _rates(y1, f1, stress1, branch, springs, ends, mass, drag, top,
                       value + rate * first * h, rate)  # fmt: skip
                past = _over(y1, moving, branch, springs, stress1[0], lifts, peak)
                high_at, hit, lands = first, past > 0.0, False
        if hit:
            # the length at which it happens: false position and bisection in turn
            lands = False
            low_at, low_past = (
                0.0,
                min(_over(y, moving, branch, springs, stress[0], lifts, peak), 0.0),
            )
            high_past = past
            for turn in range(80):
                if high_past <= 1e-16 or high_at - low_at <= 1e-15 * high_at:
                    break
                mid = 0.5 * (low_at + high_at)
                if turn % 3 != 2 and high_past > low_past:
                    mid = high_at - high_past * (high_at - low_at) / (high_past - low_past)
                    nudge = 1e-3 if turn % 3 == 0 else 0.0
                    mid += nudge * (high_at - mid)
                    if not low_at < mid < high_at:
                        mid = 0.5 * (low_at + high_at)
                _step(
                    y, mid * h, k, y1, some, scale, reach, stress1, branch, springs, ends, mass,
                    drag, top, value, rate, tol, tableau, moving,
                )  # fmt: skip
                steps += 1
                _rates(y1, f1, stress1, branch, springs, ends, mass, drag, top,
                       value + rate * mid * h, rate)  # fmt: skip
                past = _over(y1, moving, branch, springs, stress1[0], lifts, peak)
                if past > 0.0:
                    high_at, high_past = mid, past
                else:
                    low_at, low_past = mid, past
            # y1 is of the last length that was tried: take that of the one that was found
        length = high_at * h
        if high_at < 1.0:
            _step(
                y, length, k, y1, some, scale, reach, stress1, branch, springs, ends, mass, drag,
                top, value, rate, tol, tableau, moving,
            )  # fmt: skip
            steps += 1
        # the step is taken, with what rounding takes off it
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
            _rates(y, f1, stress1, branch, springs, ends, mass, drag, top,
                   value + rate * length, rate)  # fmt: skip
            for i in range(count):
                low, high, _, _ = _bounds(springs[i], branch[i])
                for bound in (low, high):
                    near_it = abs(y[moving + i] - bound) <= 1e-15 * max(abs(bound), 1e-2)
                    if math.isfinite(bound) and near_it:
                        y[moving + i], lost[moving + i] = bound, 0.0
            if lifts and stress1[0] <= 1e-15 * peak:
                _fly(y, moving, groups, springs, times, done, now, nodes, base)
                return DONE, steps, switches, now, least, now


@njit(cache=True, error_model="numpy")
def _record(
    y: Array,
    moving: int,
    springs: Array,
    times: Array,
    now: float,
    done: int,
    pressure: float,
    nodes: Array,
    base: Array,
    fine: bool,
) -> int:
    """Write the samples that are due; returns how many are done."""
    while fine and done < times.size and times[done] <= now:
        place = 0.0
        for i in range(springs.shape[0]):
            place += springs[i, H] * y[moving + i]
            nodes[i, done] = place
        base[done] = pressure
        done += 1
    return done


@njit(cache=True, error_model="numpy")
def _fly(
    y: Array,
    moving: int,
    groups: int,
    springs: Array,
    times: Array,
    done: int,
    now: float,
    nodes: Array,
    base: Array,
) -> None:
    """After contact the chain moves with the striker, and nothing presses."""
    for j in range(done, times.size):
        place = y[groups - 1] * (times[j] - now)
        for i in range(springs.shape[0]):
            place += springs[i, H] * y[moving + i]
            nodes[i, j] = place
        base[j] = 0.0


@njit(cache=True, error_model="numpy")
def _step(
    y: Array,
    h: float,
    k: Array,
    y1: Array,
    some: Array,
    scale: Array,
    reach: Array,
    stress: Array,
    branch: Integers,
    springs: Array,
    ends: Integers,
    mass: Array,
    drag: float,
    top: int,
    value: float,
    rate: float,
    tol: float,
    tableau: tuple[Array, Array, Array, Array, Array],
    moving: int,
) -> float:
    """Take a step of length h from y, whose rates are k[0]; fills y1 and, in `some`, y1 - y.

    Returns the error over the tolerance; infinite where something is not finite.
    """
    ra, rb, rc, re3, re5 = tableau
    size = y.size
    for stage in range(1, 12):
        for j in range(size):
            total = 0.0
            for m in range(stage):
                total += ra[stage, m] * k[m, j]
            y1[j] = y[j] + h * total
        if not _rates(y1, k[stage], stress, branch, springs, ends, mass, drag, top,
                      value + rate * rc[stage] * h, rate):  # fmt: skip
            return math.inf
    fastest = longest = 0.0
    for j in range(size):
        total = 0.0
        for m in range(12):
            total += rb[m] * k[m, j]
        some[j] = h * total
        y1[j] = y[j] + some[j]
        scale[j] = max(reach[j], abs(y1[j]))
        if j < moving:
            fastest = max(fastest, scale[j])
        else:
            longest = max(longest, scale[j])
    norm5 = norm3 = 0.0
    for j in range(size):
        e5 = e3 = 0.0
        for m in range(12):
            e5 += re5[m] * k[m, j]
            e3 += re3[m] * k[m, j]
        unit = tol * max(scale[j], 1e-6 * (fastest if j < moving else longest)) + 1e-290
        norm5 += (e5 / unit) ** 2
        norm3 += (e3 / unit) ** 2
    if not math.isfinite(norm5 + norm3):
        return math.inf
    if norm5 == 0.0:
        return 0.0
    return abs(h) * norm5 / math.sqrt((norm5 + 0.01 * norm3) * size)


# ------------------------------------------------------------------------------------ the judge


@dataclass(frozen=True, eq=False)
class Truth:
    """What the judge found of a scene.

    Attributes
    ----------
    displacement : (n_springs, n_t) array
        m.
    base_stress : (n_t,) array
        Pa.
    contact_end : float or None
        s.
    unsure : float
        Largest difference from the run at the looser tolerance, over the range of each curve.
    unsure_end : float
        Difference of the ends of contact over their time; infinite where only one run has one.
    dip : float
        Least minimum of the base stress before the end of contact, over its maximum: where it is
        below a tolerance, an answer to that tolerance may end contact there.
    steps, switches : int
        Of the run at the tighter tolerance.
    why : str
        Why there is no judgement; "" if there is one.
    """

    displacement: Array
    base_stress: Array
    contact_end: float | None
    unsure: float
    unsure_end: float
    dip: float
    steps: int
    switches: int
    why: str = ""


def over_range(one: Array, other: Array) -> float:
    """Largest difference of two curves over the range of the second, rest included."""
    span = max(float(other.max()), 0.0) - min(float(other.min()), 0.0)
    miss = float(np.abs(one - other).max())
    if miss == 0.0:
        return 0.0
    return miss / span if span > 0.0 and math.isfinite(miss) else math.inf


def _virgin_strain(p: Array, bistable: bool, sigma: float) -> float:
    """Strain at a stress of a spring that was never loaded before."""
    if not bistable:
        return sigma / float(p[K0])
    if sigma <= p[SIG_A]:
        return sigma / (float(p[K0]) + sigma)
    if sigma <= p[SIG_A] + p[UP] * (p[HAT_C] - p[EPS_A]):
        return float(p[EPS_A]) + (sigma - float(p[SIG_A])) / float(p[UP])
    return float(p[STAR]) + sigma / (float(p[KC]) + sigma)


def _start(rows: Array, kinds: Integers, ends: Integers, top: int, first: float) -> Array:
    """Strains of the springs under the top at the first sample of a drive that does not start at 0.

    In equilibrium with it; under a stress, a dashpot holds its spring where it is.
    """
    start = np.zeros(len(rows))
    own = range(int(ends[-2]) if len(ends) > 1 else 0, len(rows))
    if top in (MASS, DAMPER) or first == 0.0:
        return start

    def strains(sigma: float) -> Array:
        return np.array([_virgin_strain(rows[i], bool(kinds[i] == A), sigma) for i in own])

    if top == STRESS:
        held = rows[own, ETA] > 0.0
        start[own] = np.where(held, 0.0, strains(first))
        return start
    heights = rows[own, H]
    high = 1.0
    while heights @ strains(high) < first:
        high *= 2.0
    sigma = float(brentq(lambda s: float(heights @ strains(s)) - first, 0.0, high, xtol=1e-30))
    start[own] = strains(sigma)
    return start


def _fastest(rows: Array, ends: Integers, mass: Array, top: int) -> float:
    """Largest rate (1/s) at which dashpots stop a mass: explicit steps are a few times shorter."""
    hold = []
    for first, last in zip([0, *ends[:-1]], ends, strict=True):
        eta, height = rows[first:last, ETA], rows[first:last, H]
        hold.append(1.0 / float((height / eta).sum()) if (eta > 0.0).all() else 0.0)
    known = mass if top == MASS else mass[:-1]
    return max(
        ((hold[g] + (hold[g + 1] if g + 1 < len(hold) else 0.0)) / m for g, m in enumerate(known)),
        default=0.0,
    )


def _shares(chain: Any, drive: Any, ends: Integers) -> bool:
    """Whether a prescribed motion may meet gaps or flat branches of several springs at one stress.

    They carry one stress whichever of them moves: the law leaves open which does, and a spring that
    has moved through its flat branch alone has snapped, while one that has shared it has not.
    """
    if not hasattr(drive, "displacement"):
        return False
    for first, last in zip([0, *ends[:-1]], ends, strict=True):
        stresses = []
        for spring in chain.springs[first:last]:
            if spring.eta > 0.0:
                continue
            if not hasattr(spring, "kc"):
                stresses += [("gap", 0.0)] if spring.unilateral else []
                continue
            snap = spring.k0 * spring.eps_a / (1.0 - spring.eps_a)
            stresses += [("d", snap)] if spring.kh_plus == 0.0 else []
            stresses += [("e", snap + spring.dsigma)] if spring.kh_minus == 0.0 else []
        if len(set(stresses)) < len(stresses):
            return True
    return False


def follow(chain: Any, drive: Any, time: Array, tol: float = TIGHT, most: int = MOST_WORK) -> Truth:
    """Follow a scene once, at one tolerance; its own uncertainty is not known then."""
    count = len(chain.springs)
    bistable = [hasattr(spring, "kc") for spring in chain.springs]
    rows = np.array(
        [
            (bistable_row if two else _linear)(spring, h)
            for spring, h, two in zip(chain.springs, chain.heights, bistable, strict=True)
        ]
    )
    kinds = np.array(
        [
            A if two else ONE_SIDED if spring.unilateral else LINE
            for spring, two in zip(chain.springs, bistable, strict=True)
        ]
    )
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
    inside = [i for i in range(count - 1) if chain.masses[i] > 0.0]
    ends = np.array([*(i + 1 for i in inside), count])
    mass = np.array([*(chain.masses[i] for i in inside), above]) / chain.area
    nodes, base = np.zeros((count, time.size)), np.zeros(time.size)
    if _fastest(rows, ends, mass, top) * (time[-1] - time[0]) > 6.0 * most / count:
        return Truth(nodes, base, None, math.nan, math.nan, math.inf, 0, 0, WHY[TOO_LONG])
    if _shares(chain, drive, ends):
        return Truth(nodes, base, None, math.nan, math.nan, math.inf, 0, 0, SHARED)
    log = np.zeros((4096, 3))
    start = _start(rows, kinds, ends, top, float(values[0]))
    outcome, steps, switches, end, dip, _ = _follow(
        rows, kinds, ends, mass, drag, top, speed, start, time, values, tol, most // count, nodes,
        base, log, (_A, _B, _C, _E3, _E5),
    )  # fmt: skip
    why = WHY[outcome]
    if not why and not (np.isfinite(nodes).all() and np.isfinite(base).all()):
        why = "not finite"
    return Truth(
        nodes, base, None if math.isnan(end) else end, math.nan, math.nan, dip, steps, switches, why
    )


def judge(
    chain: Any,
    drive: Any,
    time: Array,
    most: int = MOST_WORK,
    by: Callable[[Any, Any, Array, float, int], Truth] = follow,
) -> Truth:
    """Follow a scene at two tolerances; their difference is the uncertainty of the judgement."""
    tight = by(chain, drive, time, TIGHT, most)
    if tight.why:
        return tight
    loose = by(chain, drive, time, LOOSE, most)
    if loose.why:
        return loose
    unsure = max(
        max(over_range(a, b) for a, b in zip(loose.displacement, tight.displacement, strict=True)),
        over_range(loose.base_stress, tight.base_stress),
    )
    if tight.contact_end is None or loose.contact_end is None:
        end = 0.0 if tight.contact_end is loose.contact_end else math.inf
    else:
        end = abs(loose.contact_end / tight.contact_end - 1.0)
    return Truth(
        tight.displacement, tight.base_stress, tight.contact_end, unsure, end,
        min(tight.dip, loose.dip), tight.steps, tight.switches,
    )  # fmt: skip
