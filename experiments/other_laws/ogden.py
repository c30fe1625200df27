"""Quasi-linear viscoelasticity on an Ogden curve: the hyperfoam of Storåkers with a Prony series.

A highly compressible Ogden solid with two terms and zero Poisson's ratio. With the stretch λ = 1 -
ε, nominal stress and stored energy in compression are

    σ(ε) = p(λ; mu, alpha) + p(λ; nu, -beta),   p(λ; m, a) = (2 m / a) (1/λ - λ^(a-1))
    W(ε) = w(λ; mu, alpha) + w(λ; nu, -beta),   w(λ; m, a) = (2 m / a) ((λ^a - 1) / a - ln λ)

The first term is the plateau, with sharpness alpha, the second densification (beta >= -3). In
tension the curve continues as a straight line of slope 2 (mu + nu).

The curve alone has no loop. `relaxation=N` adds a Prony series, dq/dt = -q/τ + g dσ/dt for each of
N terms, which gives quasi-linear viscoelasticity. Other laws of this folder use the same curve.

Storåkers 1986, J. Mech. Phys. Solids 34, 125; Fung 1981, Biomechanics, chapter 7.
"""

import cmath
import math

import numpy as np
from numba import njit
from scipy.optimize import nnls

import foamfit as ff

CURVE = (
    ff.Param("mu", ("µ", ""), "Pa", "plateau modulus", (0.5, "slope"), (1e-3, 1e2), "slope"),
    ff.Param("alpha", ("α", ""), "", "sharpness of the plateau", (15.0, "one"), (1.0, 200.0)),
    ff.Param("nu", ("ν", ""), "Pa", "densified modulus", (0.05, "slope"), (1e-6, 1e1), "slope"),
    ff.Param(
        "beta", ("β", ""), "", "sharpness of densification", (2.0, "one"), (-3.0, 30.0),
        coordinate="value", inner=(-2.0, 6.0), least_size=1.0, admissible="finite",
    ),
)  # fmt: skip


@njit
def near(value, slope, z):
    """Return value + i slope Im z: a real function at z, if its imaginary part is a tiny step."""
    return complex(value, slope * z.imag)


@njit
def curve(strain, mu, alpha, nu, beta):
    """Return stress (Pa) and energy (J/m³) of the elastic curve."""
    if strain.real >= 1.0:
        return complex(math.inf, 0.0), complex(math.inf, 0.0)
    if strain.real <= 0.0:
        return 2.0 * (mu + nu) * strain, (mu + nu) * strain**2
    log = cmath.log(1.0 - strain)
    stress, energy = 0j, 0j
    for m, a in ((mu, alpha), (nu, -beta)):
        u = a * log
        if abs(u.real) < 1e-4:  # series about a = 0
            stress -= 2.0 * m * log * (1.0 + 0.5 * u + u * u / 6.0)
            energy += m * log**2 * (1.0 + u / 3.0 + u * u / 12.0)
        else:
            grown = near(math.expm1(u.real), math.exp(u.real), u)
            stress -= 2.0 * m / a * grown
            energy += 2.0 * m / a * (grown / a - log)
    return stress / (1.0 - strain), energy


def real_curve(strain, *values):
    """Return the same for real numbers."""
    stress, energy = curve(complex(strain), *map(complex, values))
    return stress.real, energy.real


def read_curve(loop, marks, scales, share):
    """Read mu, alpha, nu, beta off the loop at a fraction `share` from unloading to loading."""
    alpha, beta = 3.0 * 20.0 ** marks[0], 8.0 * marks[1] - 2.0
    strain = np.linspace(0.05, 1.0, 20) * scales.strain
    up = np.array([loop.at(e, loading=True) for e in strain])
    down = np.array([loop.at(e, loading=False) for e in strain])
    terms = [
        [real_curve(e, *one)[0] for e in strain]
        for one in ((1.0, alpha, 0.0, 1.0), (0.0, 1.0, 1.0, beta))
    ]
    mu, nu = nnls(np.transpose(terms), share * up + (1.0 - share) * down)[0]
    return [max(mu, 2e-3 * scales.slope), alpha, max(nu, 2e-6 * scales.slope), beta]


def read_half(loop, marks, scales):
    """Read the curve midway, and half the width of the loop at half the strain (not zero)."""
    half = 0.5 * scales.strain
    width = loop.at(half, loading=True) - loop.at(half, loading=False)
    return read_curve(loop, marks, scales, 0.5), max(0.5 * width, 0.01 * scales.stress)


def is_curve(p):
    """Return whether the first four parameters are admissible."""
    return p[:3].min() > 0.0 and p[3] >= -3.0


def stress(p, x, strain, branch):
    """Return the stress of the curve."""
    return curve(strain, p[0], p[1], p[2], p[3])[0]


def read_off(loop, marks, scales, way):
    """Start from a random curve between unloading and loading."""
    return np.array([*read_curve(loop, marks, scales, marks[2]), 0.0])


LAW = ff.Law(
    kind="ogden",
    title="Ogden spring",
    params=CURVE,
    functions=ff.Functions(stress, admissible=is_curve),
    branches={"elastic": "all along"},
    read_off=read_off,
)
