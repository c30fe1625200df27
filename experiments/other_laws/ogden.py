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

import math

import numpy as np
from numba import njit
from scipy.optimize import nnls

import foamfit as ff

EPS, SIGMA, BRANCH = range(3)
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
def curve(strain, mu, alpha, nu, beta):
    """Return stress (Pa) and energy (J/m³) of the elastic curve."""
    if strain >= 1.0:
        return math.inf, math.inf
    if strain <= 0.0:
        return 2.0 * (mu + nu) * strain, (mu + nu) * strain**2
    log = math.log(1.0 - strain)
    stress, energy = 0.0, 0.0
    for m, a in ((mu, alpha), (nu, -beta)):
        if abs(a * log) < 1e-4:  # series about a = 0
            stress -= 2.0 * m * log * (1.0 + 0.5 * a * log)
            energy += m * log**2 * (1.0 + a * log / 3.0)
        else:
            grown = math.expm1(a * log)
            stress -= 2.0 * m / a * grown
            energy += 2.0 * m / a * (grown / a - log)
    return stress / (1.0 - strain), energy


def read_curve(loop, marks, scales, share):
    """Read mu, alpha, nu, beta off the loop at a fraction `share` from unloading to loading."""
    alpha, beta = 3.0 * 20.0 ** marks[0], 8.0 * marks[1] - 2.0
    strain = np.linspace(0.05, 1.0, 20) * scales.strain
    up = np.array([loop.at(e, loading=True) for e in strain])
    down = np.array([loop.at(e, loading=False) for e in strain])
    terms = [
        [curve(e, *one)[0] for e in strain]
        for one in ((1.0, alpha, 0.0, 1.0), (0.0, 1.0, 1.0, beta))
    ]
    mu, nu = nnls(np.transpose(terms), share * up + (1.0 - share) * down)[0]
    return [max(mu, 2e-3 * scales.slope), alpha, max(nu, 2e-6 * scales.slope), beta]


def fill(values, row):
    """Copy the parameters; return whether they are admissible."""
    for j in range(4):  # `row[:] = values` takes two seconds to compile
        row[j] = values[j]
    return values[:3].min() > 0.0 and values[3] >= -3.0


def begin(row, state):
    """Set the state at rest."""
    state[:] = 0.0


def leaves(row, state, strain):
    """Return False: there is only one branch."""
    return False


def switch(row, state, up):
    """Do nothing: there is no other branch."""


def settle(row, state, strain):
    """Follow the curve."""
    state[EPS], state[SIGMA] = strain, curve(strain, row[0], row[1], row[2], row[3])[0]


def read_off(loop, marks, scales, way):
    """Start from a random curve between unloading and loading."""
    return np.array([*read_curve(loop, marks, scales, marks[2]), 0.0])


LAW = ff.Law(
    kind="ogden",
    title="Ogden spring",
    params=CURVE,
    functions=ff.Functions(fill, begin, leaves, switch, settle),
    branches={"elastic": "all along"},
    read_off=read_off,
)
