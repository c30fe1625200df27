"""Compiled polynomials c[0] + c[1] τ + … of a step in time: values, slopes, first crossings."""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

from foamfit.kernels import Array, compiled


@compiled
def value_at(c: Array, order: int, tau: float) -> float:
    """Value of a polynomial."""
    total = c[order]
    for n in range(order - 1, -1, -1):
        total = total * tau + c[n]
    return total


@compiled
def add_values(
    c: Array, order: int, t: Array, first: int, last: int, now: float, scale: float, out: Array
) -> None:
    """Add scale × polynomial at the times t[first:last] - now to `out`, four at a time."""
    j = first
    while j + 4 <= last:
        x0, x1, x2, x3 = t[j] - now, t[j + 1] - now, t[j + 2] - now, t[j + 3] - now
        y0 = y1 = y2 = y3 = c[order]
        for n in range(order - 1, -1, -1):
            y0 = y0 * x0 + c[n]
            y1 = y1 * x1 + c[n]
            y2 = y2 * x2 + c[n]
            y3 = y3 * x3 + c[n]
        out[j] += scale * y0
        out[j + 1] += scale * y1
        out[j + 2] += scale * y2
        out[j + 3] += scale * y3
        j += 4
    while j < last:
        out[j] += scale * value_at(c, order, t[j] - now)
        j += 1


@compiled
def slope_at(c: Array, order: int, tau: float) -> float:
    """Return the derivative of a polynomial."""
    total = order * c[order]
    for n in range(order - 1, 0, -1):
        total = total * tau + n * c[n]
    return total


@compiled
def _root(c: Array, order: int, level: float, lo: float, hi: float) -> float:
    """Root of polynomial - level in [lo, hi], whose ends lie on either side: guarded Newton."""
    rising = value_at(c, order, hi) > level
    tau = 0.5 * (lo + hi)
    for _ in range(100):
        f = value_at(c, order, tau) - level
        if f == 0.0:
            break
        if (f > 0.0) == rising:
            hi = tau
        else:
            lo = tau
        d = slope_at(c, order, tau)
        trial = tau - f / d if d != 0.0 else lo
        if not lo < trial < hi:
            trial = 0.5 * (lo + hi)
        if abs(trial - tau) <= 4e-16 * abs(tau) or trial in (lo, hi):
            tau = trial
            break
        tau = trial
    return tau


@compiled
def _turn(c: Array, order: int, lo: float, hi: float) -> float:
    """Bisect for the turning point of a polynomial whose slope changes sign in [lo, hi]."""
    rising = slope_at(c, order, lo) > 0.0
    for _ in range(50):
        mid = 0.5 * (lo + hi)
        if (slope_at(c, order, mid) > 0.0) == rising:
            lo = mid
        else:
            hi = mid
    return 0.5 * (lo + hi)


@compiled
def first_crossing(c: Array, order: int, low: float, high: float, span: float) -> tuple[float, int]:
    """First time in [0, span] at which a polynomial leaves [low, high], and the side (-1, 0, 1).

    A start outside by rounding, or on an end, counts as inside until it moves outwards.
    """
    reach = 0.0
    power = 1.0
    for n in range(1, order + 1):
        power *= span
        reach += abs(c[n]) * power
    if c[0] - reach > low and c[0] + reach < high:
        return span, 0
    low, high = min(low, c[0]), max(high, c[0])
    pieces = 8
    lo = 0.0
    slope_lo = c[1]
    for piece in range(1, pieces + 1):
        hi = span * piece / pieces
        slope_hi = slope_at(c, order, hi)
        mid = hi
        if slope_lo * slope_hi < 0.0:  # a turning point may reach beyond both ends
            mid = _turn(c, order, lo, hi)
        for end in (mid, hi):
            value = value_at(c, order, end)
            if value > high:
                return _root(c, order, high, lo, end), 1
            if value < low:
                return _root(c, order, low, lo, end), -1
            lo = end
        slope_lo = slope_hi
    return span, 0
