"""The common stress of springs in series on their branches, at an elongation."""

from __future__ import annotations

import math

from foamfit.solve.run import KIND, NUMBERS
from foamfit.springs.compiled.contract import (
    BY_STRESS,
    EPS,
    ETA,
    GAIN,
    HEIGHT,
    OFFSET,
    SOFT,
    STRAIN,
    X,
    call_number,
    inner,
    past,
)

LEAST = 1e-6  # strain to whose rounding error elongations are always resolved


@inner
def put(c, i, eps, sigma):  # type: ignore[no-untyped-def]
    """Bring a spring to a strain and stress of its branch."""
    s = past(c.springs, i * c.width)
    s[EPS] = eps
    if c.numbers[i * NUMBERS + KIND] == BY_STRESS:
        s[X] = (sigma - s[OFFSET]) / s[GAIN]


@inner
def strain_at(c, i, sigma):  # type: ignore[no-untyped-def]
    """Return the strain of a spring at a stress T on its branch; fill SOFT."""
    s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
    return call_number(n[STRAIN], past(s, c.row), s, (sigma - s[OFFSET]) / s[GAIN])


@inner
def elongation_at(c, i0, i1, sigma, loose):  # type: ignore[no-untyped-def]
    """Return elongation, compliance, and size of the terms at a stress on the branches.

    With `loose`, only of the springs without a dashpot.
    """
    total = compliance = size = 0.0
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if loose and s[ETA] > 0.0:
            continue
        eps = strain_at(c, i, sigma)
        total += s[HEIGHT] * eps
        compliance += s[HEIGHT] * s[SOFT] / s[GAIN]
        size += s[HEIGHT] * max(abs(eps), LEAST)
    return total, compliance, size


@inner
def _split_jump(c, i0, i1, target, low, high, loose):  # type: ignore[no-untyped-def]
    """Distribute an elongation inside a jump between two stresses from the base up."""
    rest = target - elongation_at(c, i0, i1, low, loose)[0]
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if loose and s[ETA] > 0.0:
            continue
        upper, eps = strain_at(c, i, high), strain_at(c, i, low)
        gain = min(max(rest / s[HEIGHT], 0.0), upper - eps)
        put(c, i, eps + gain, 0.5 * (low + high))
        rest -= s[HEIGHT] * gain
    return 0.5 * (low + high)


@inner
def root(c, i0, i1, target, sigma, low, high, loose):  # type: ignore[no-untyped-def]
    """Return the stress between two bounds at which springs reach an elongation; fill strains.

    Newton's method inside a bracket, which every third trial halves.
    """
    for trial in range(400):
        total, compliance, size = elongation_at(c, i0, i1, sigma, loose)
        miss = total - target
        if abs(miss) <= 2e-15 * (size + abs(target)):
            break
        if miss > 0.0:
            high = min(high, sigma)
        else:
            low = max(low, sigma)
        new = sigma - miss / compliance
        if not low < new < high or (trial >= 8 and trial % 3 == 0):
            if low > -math.inf and high < math.inf:
                new = 0.5 * (low + high)
            elif not low < new < high:
                new = sigma + (2.0 if miss < 0.0 else -2.0) * max(
                    abs(sigma), abs(miss / compliance)
                )
            if new in (low, high):  # neighbouring floating-point numbers
                return _split_jump(c, i0, i1, target, low, high, loose)
        sigma = new
    for i in range(i0, i1):
        if not (loose and past(c.springs, i * c.width)[ETA] > 0.0):
            put(c, i, strain_at(c, i, sigma), sigma)
    return sigma
