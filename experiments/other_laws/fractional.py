"""Fractional element: an Ogden curve whose stress relaxes by a power of time.

    Σ = σ_0(ε) + g d^a σ_0/dt^a = ∫ (1 + g (t - s)^-a / Γ(1-a)) dσ_0(s)        (t in s, 0 < a < 1)

A spring-pot of order a acts on the stress of the Ogden curve (`ogden.py`), in the same way as the
exponentials of quasi-linear viscoelasticity. The kernel is the integral

    t^-a / Γ(1-a) = sin(πa)/π ∫ s^(a-1) exp(-s t) ds

by the trapezoidal rule in ln s: N = 17 exponentials with rates from 1e-4 to 2^32 1e-4 1/s, each
four times the previous one; slower ones are lumped into one spring. The error is below 0.3 % from
1e-5 to 1e3 s.

Koeller 1984, J. Appl. Mech. 51, 299; Doehring, Freed, Carew & Vesely 2005, J. Biomech. Eng. 127,
700; for foam: Deng, Davies & Bajaj 2006, Signal Process. 86, 2728.
"""

import math

import numpy as np
from ogden import CURVE, begin, curve, leaves, read_curve, switch

import foamfit as ff

EPS, SIGMA, BRANCH, LAST, TIME, FIRST = range(6)
N, SLOWEST, RATIO = 17, 1e-4, 4.0


def fill(values, row):
    """Copy the parameters and compute the strength of each exponential."""
    for j in range(6):
        row[j] = values[j]
    g, a = values[4], values[5]
    if values[:3].min() <= 0.0 or values[3] < -3.0 or g <= 0.0 or not 0.0 < a < 1.0:
        return False
    for j in range(N):
        row[6 + j] = g * math.sin(math.pi * a) / math.pi * (SLOWEST * RATIO**j) ** a
    row[6] *= 0.5  # the other half belongs to the spring
    row[6 + N] = row[6] * 2.0 / a  # the integral from zero to the slowest rate
    for j in range(N):
        row[6 + j] *= math.log(RATIO)
    return True


def settle(row, state, strain):
    """Follow the curve."""
    state[EPS], state[SIGMA] = strain, curve(strain, row[0], row[1], row[2], row[3])[0]


def viscous(row, state, rate, h):
    """Relax each exponential; the stress of the curve is linear in time."""
    kept, rising = FIRST + N, FIRST + 2 * N  # of each exponential, for steps of this length
    if abs(h - state[TIME]) > 1e-7 * h:
        state[TIME] = h
        for j in range(N):
            x = SLOWEST * RATIO**j * h
            state[kept + j], state[rising + j] = math.exp(-x), -math.expm1(-x) / x
    rise, out = state[SIGMA] - state[LAST], row[6 + N] * state[SIGMA]
    if h == 0.0:
        return out
    state[LAST] = state[SIGMA]
    for j in range(N):
        state[FIRST + j] = state[kept + j] * state[FIRST + j] + state[rising + j] * rise
        out += row[6 + j] * state[FIRST + j]
    return out


def read_off(loop, marks, scales, way):
    """Read the curve below the middle of the loop; the overstress is half the loop width."""
    order = 0.05 * 12.0 ** marks[2]
    g = 0.5 * 4.0 ** (marks[3] - 0.5) * scales.duration**order
    curve_of = read_curve(loop, marks, scales, 0.5)
    share = 1.0 / (1.0 + 0.5 * marks[4])
    return np.array(
        [share * curve_of[0], curve_of[1], share * curve_of[2], curve_of[3], g, order, 0.0]
    )


LAW = ff.Law(
    kind="fractional",
    title="Ogden spring with a fractional element",
    params=(
        *CURVE,
        ff.Param(
            "strength", ("g", ""), "", "strength of the spring-pot", (0.3, "one"), (1e-4, 1e2)
        ),
        ff.Param(
            "order", ("a", ""), "", "order of the derivative", (0.2, "one"), (0.01, 0.99),
            admissible="between 0 and 1",
        ),
    ),
    functions=ff.Functions(fill, begin, leaves, switch, settle, viscous),
    columns=7 + N,
    states=5 + 3 * N,
    branches={"elastic": "all along"},
    read_off=read_off,
)  # fmt: skip
