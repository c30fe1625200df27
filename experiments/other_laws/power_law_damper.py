"""The paper's bistable spring parallel to a power-law damper: Σ = σ(ε) + c |dε/dt|^n sign(dε/dt).

σ is the law of Thevamaran, Fraternali & Daraio 2014 (J. Appl. Mech. 81, 121006, eqs. 2-5); the
damper is that of their reference 22. c (Pa) is the stress at a strain rate of 1 1/s; n = 1 is a
dashpot, n near 0 dry friction.

Carretero-González, Khatri, Porter, Kevrekidis & Daraio 2009, Phys. Rev. Lett. 102, 024102.
"""

import math
from dataclasses import replace

import numpy as np
from numba import njit

import foamfit as ff
from foamfit.springs.laws import bistable, law

PAPER = law("bistable")
points_of = njit(bistable.derived_points)
A, D, C, E = range(4)  # branches


def admissible(p):
    """Return whether the parameters are admissible."""
    return bistable.admissible(*p[:7]) and p[7] >= 0.0 and p[8] > 0.0


def stress(p, x, strain, branch):
    """Return the stress of the paper's spring (eqs. 2 and 3)."""
    k0, kc, dsigma, eps_a, eps_c, plus, minus = p[:7]
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + dsigma
    if branch == D:
        return sigma_a + plus * (strain - eps_a)
    if branch == E:
        return sigma_c + minus * (strain - eps_c)
    k, r = (k0, strain) if branch == A else (kc, strain - eps_c + sigma_c / (kc + sigma_c))
    return k * r / (1.0 - r) if r.real < 1.0 else math.inf


def ends(p, x, strain, branch, out):
    """Fill the ends of the branch (eqs. 4 and 5)."""
    k0, kc, dsigma, eps_a, eps_c, plus, minus = p[:7]
    points = points_of(k0.real, kc.real, dsigma.real, eps_a.real, eps_c.real, plus.real, minus.real)
    if branch != A:
        out[0] = eps_a if branch == D else eps_c if branch == C else points[3]
    if branch != C:
        out[1] = points[4] if branch == D else eps_c if branch == E else eps_a


def switch(p, x, strain, branch, up):
    """Return the next branch."""
    if up:
        return D if branch == A else C
    return E if branch == C else A


def viscous(p, x, strain, rate, branch):
    """Return the stress of the damper."""
    if rate.real == 0.0:
        return 0j
    return p[7] * rate ** p[8] if rate.real > 0.0 else -p[7] * (-rate) ** p[8]


def read_off(loop, marks, scales, way):
    """Read the spring off the loop; the damper bears up to a tenth of the stress."""
    spring, n = PAPER.read_off(loop, marks, scales, way), 0.1 * 10.0 ** marks[5]
    rate = max(scales.rate, 1e-6)
    c = 0.1 * scales.stress * 10.0 ** (-1.5 * marks[6]) / rate**n
    return np.array([*spring[:7], c, n, 0.0])


LAW = replace(
    PAPER, kind="bistable-power-damper", title="bistable spring beside a power-law damper",
    params=(
        *PAPER.params,
        ff.Param("c", ("c", ""), "Pa", "damping stress at 1 1/s", (0.02, "stress"), (1e-8, 1e2),
                 "stress"),
        ff.Param("n", ("n", ""), "", "exponent of the damper", (0.5, "one"), (0.02, 2.0)),
    ),
    functions=ff.Functions(stress, ends=ends, switch=switch, viscous=viscous,
                           admissible=admissible),
    spring=None, searched=(*PAPER.searched, "c", "n"),
    read_off=read_off, read_in_series=None, marks=7, neighbours=lambda values, top: iter(()),
    exchanged=None, points=(), compared=(),
)  # fmt: skip
