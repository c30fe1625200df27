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

import foamfit as ff
from ogden import CURVE, curve, is_curve, near, read_curve

N, SLOWEST, RATIO = 17, 1e-4, 4.0


def admissible(p):
    """Return whether the parameters are admissible."""
    return is_curve(p) and p[4] > 0.0 and 0.0 < p[5] < 1.0


def stress(p, x, strain, branch):
    """Return the stress of curve, spring and exponentials; elastic + x[j] are their strains."""
    elastic, a = curve(strain, p[0], p[1], p[2], p[3])[0], p[5]
    sine = near(math.sin(math.pi * a.real), math.pi * math.cos(math.pi * a.real), a)
    strength, ratio = p[4] * sine / math.pi * SLOWEST**a, RATIO**a
    out = (1.0 + strength / a) * elastic  # slower exponentials are a spring
    for j in range(N):
        share = 0.5 if j == 0 else 1.0  # the other half belongs to the spring
        out += math.log(RATIO) * share * strength * (elastic + x[j])
        strength *= ratio
    return out


def decay(p, x, strain, branch, out):
    """Relax each exponential."""
    elastic = curve(strain, p[0], p[1], p[2], p[3])[0]
    for j in range(N):
        out[j] = -SLOWEST * RATIO**j * (elastic + x[j])


def read_off(loop, marks, scales, way):
    """Read the curve below the middle of the loop; the overstress is half the loop width."""
    order = 0.05 * 12.0 ** marks[2]
    g = 0.5 * 4.0 ** (marks[3] - 0.5) * scales.duration**order
    mu, alpha, nu, beta = read_curve(loop, marks, scales, 0.5)
    share = 1.0 / (1.0 + 0.5 * marks[4])
    return np.array([share * mu, alpha, share * nu, beta, g, order, 0.0])


LAW = ff.Law(
    kind="fractional",
    title="Ogden spring with a fractional element",
    params=(
        *CURVE,
        ff.Param("strength", ("g", ""), "", "strength of the spring-pot", (0.3, "one"),
                 (1e-4, 1e2)),
        ff.Param("order", ("a", ""), "", "order of the derivative", (0.2, "one"), (0.01, 0.99),
                 admissible="between 0 and 1"),
    ),
    functions=ff.Functions(stress, decay=decay, admissible=admissible),
    internal=N,
    branches={"elastic": "all along"},
    read_off=read_off,
)  # fmt: skip
