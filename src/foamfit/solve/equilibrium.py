"""The common stress of springs in series on their branches, at an elongation."""

from __future__ import annotations

import math

from foamfit.solve.run import numbers, spring
from foamfit.springs.compiled.contract import BY_STRESS, call_number, inner, past

LEAST = 1e-6  # strain to whose rounding error elongations are always resolved


@inner
def put(c, i, eps, sigma):  # type: ignore[no-untyped-def]
    """Bring a spring to a strain and stress of its branch."""
    s = spring(c, i)
    s.eps = eps
    if numbers(c, i).kind == BY_STRESS:
        s.x = (sigma - s.offset) / s.gain


@inner
def strain_at(c, i, sigma):  # type: ignore[no-untyped-def]
    """Return the strain of a spring at a stress T on its branch; fill SOFT."""
    s, n = spring(c, i), numbers(c, i)
    return call_number(n.strain, past(s, c.row), s, (sigma - s.offset) / s.gain)


@inner
def elongation_at(c, i0, i1, sigma, loose):  # type: ignore[no-untyped-def]
    """Return elongation, compliance, and size of the terms at a stress on the branches.

    With `loose`, only of the springs without a dashpot.
    """
    total = compliance = size = 0.0
    for i in range(i0, i1):
        s = spring(c, i)
        if loose and s.eta > 0.0:
            continue
        eps = strain_at(c, i, sigma)
        total += s.height * eps
        compliance += s.height * s.soft / s.gain
        size += s.height * max(abs(eps), LEAST)
    return total, compliance, size


@inner
def _split_jump(c, i0, i1, target, low, high, loose):  # type: ignore[no-untyped-def]
    """Distribute an elongation inside a jump between two stresses from the base up."""
    rest = target - elongation_at(c, i0, i1, low, loose)[0]
    for i in range(i0, i1):
        s = spring(c, i)
        if loose and s.eta > 0.0:
            continue
        upper, eps = strain_at(c, i, high), strain_at(c, i, low)
        gain = min(max(rest / s.height, 0.0), upper - eps)
        put(c, i, eps + gain, 0.5 * (low + high))
        rest -= s.height * gain
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
        if not (loose and spring(c, i).eta > 0.0):
            put(c, i, strain_at(c, i, sigma), sigma)
    return sigma
