"""Compiled functions of the polynomial c[0] + c[1] τ + … of a time step: values, slopes, roots."""

from __future__ import annotations

import math

from numba import njit

from foamfit.arrays import Array

inner = njit(error_model="numpy", fastmath={"contract"}, no_cpython_wrapper=True)

LEAST_TRUNCATION = 1e-16  # of a step; rounding errors are larger


@inner
def order_for(tol: float, most: int) -> int:
    """Return the cheapest order, from 6 to `most`, of series with truncation `tol` per step."""
    return min(max(round(4.0 - 0.5 * math.log(tol)), 6), most)


@inner
def value_at(c: Array, order: int, tau: float) -> float:
    """Return the value of a polynomial."""
    total = c[order]
    for n in range(order - 1, -1, -1):
        total = total * tau + c[n]
    return total


@inner
def value_and_slope(c: Array, order: int, tau: float) -> tuple[float, float]:
    """Return the value and derivative of a polynomial."""
    total, slope = c[order], 0.0
    for n in range(order - 1, -1, -1):
        slope = slope * tau + total
        total = total * tau + c[n]
    return total, slope


@inner
def slope_at(c: Array, order: int, tau: float) -> float:
    """Return the derivative of a polynomial."""
    return value_and_slope(c, order, tau)[1]


@inner
def fill_values(
    c: Array, order: int, t: Array, first: int, last: int, now: float, out: Array
) -> None:
    """Write the polynomial at the times t[first:last] - now into `out`, block by block.

    The inner loops have no dependence between samples, so that they vectorise; six coefficients per
    pass reduce reads and writes of the block.
    """
    while first < last:
        end = min(first + 512, last)
        times, block = t[first:end], out[first:end]
        n = order
        for j in range(times.size):
            block[j] = c[n]
        while n >= 6:
            c1, c2, c3, c4, c5, c6 = c[n - 1], c[n - 2], c[n - 3], c[n - 4], c[n - 5], c[n - 6]
            for j in range(times.size):
                x = times[j] - now
                block[j] = (((((block[j] * x + c1) * x + c2) * x + c3) * x + c4) * x + c5) * x + c6
            n -= 6
        while n >= 2:
            c1, c2 = c[n - 1], c[n - 2]
            for j in range(times.size):
                x = times[j] - now
                block[j] = (block[j] * x + c1) * x + c2
            n -= 2
        if n == 1:
            c1 = c[0]
            for j in range(times.size):
                block[j] = block[j] * (times[j] - now) + c1
        first = end


@inner
def _root(
    c: Array, order: int, level: float, lo: float, f_lo: float, hi: float, f_hi: float
) -> float:
    """Return the root of polynomial - level in [lo, hi], where the polynomial is f_lo and f_hi.

    Newton's method with bisection as safeguard, from the root of the chord. Convergence is
    quadratic: a step below 1e-9 of the interval is the last.
    """
    rising, close = f_hi > f_lo, 1e-9 * (hi - lo)
    tau = lo + (level - f_lo) / (f_hi - f_lo) * (hi - lo)
    if not lo < tau < hi:
        tau = 0.5 * (lo + hi)
    for _ in range(100):
        f, d = value_and_slope(c, order, tau)
        f -= level
        if f == 0.0:
            break
        if (f > 0.0) == rising:
            hi = tau
        else:
            lo = tau
        trial = tau - f / d if d != 0.0 else lo
        newton = lo < trial < hi
        if not newton:
            trial = 0.5 * (lo + hi)
        done = trial in (lo, hi) or abs(trial - tau) <= (close if newton else 4e-16 * abs(tau))
        tau = trial
        if done:
            break
    return tau


@inner
def _turn(c: Array, order: int, lo: float, hi: float) -> float:
    """Bisect for the turning point of a polynomial whose slope changes sign in [lo, hi].

    Half the digits suffice, because the value near it varies with the square of the distance.
    """
    rising = slope_at(c, order, lo) > 0.0
    for _ in range(27):
        mid = 0.5 * (lo + hi)
        if (slope_at(c, order, mid) > 0.0) == rising:
            lo = mid
        else:
            hi = mid
    return 0.5 * (lo + hi)


@inner
def first_crossing(c: Array, order: int, low: float, high: float, span: float) -> tuple[float, int]:
    """Return the first time in [0, span] at which a polynomial leaves [low, high], and the side.

    The side is -1 or 1, or 0 if it stays inside. A start on an end, or outside by rounding, counts
    as inside until the polynomial moves outwards.
    """
    reach, bend = 0.0, 0.0
    power = 1.0
    for n in range(1, order + 1):
        power *= span
        size = abs(c[n]) * power
        reach += size
        if n > 1:
            bend += n * size
    if c[0] - reach > low and c[0] + reach < high:
        return span, 0
    low, high = min(low, c[0]), max(high, c[0])
    parts = 1 if bend < abs(c[1]) * span else 8  # 1 if monotonic
    lo, value_lo = 0.0, c[0]
    slope_lo = c[1]
    for part in range(1, parts + 1):
        hi = span * part / parts
        value, slope_hi = value_and_slope(c, order, hi)
        if parts > 1 and slope_lo * slope_hi < 0.0:  # the turning point may lie beyond both ends
            mid = _turn(c, order, lo, hi)
            turned = value_at(c, order, mid)
            if turned > high:
                return _root(c, order, high, lo, value_lo, mid, turned), 1
            if turned < low:
                return _root(c, order, low, lo, value_lo, mid, turned), -1
            lo, value_lo = mid, turned
        if value > high:
            return _root(c, order, high, lo, value_lo, hi, value), 1
        if value < low:
            return _root(c, order, low, lo, value_lo, hi, value), -1
        lo, value_lo = hi, value
        slope_lo = slope_hi
    return span, 0
