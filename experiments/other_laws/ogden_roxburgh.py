"""Ogden-Roxburgh softening: a pseudo-elastic foam that unloads below its loading curve.

    σ = η σ_0(ε),   η = 1 - (1/r) erf((W_m - W_0(ε)) / m)

σ_0 and W_0 are stress and energy of the Ogden curve (`ogden.py`), W_m is W_0 at the largest strain
so far. On the loading curve η = 1; unloading and reloading below the largest strain follow the same
softer path. r >= 1 and m > 0 (J/m³).

Ogden & Roxburgh 1999, Proc. R. Soc. A 455, 2861, equation (51).
"""

import math

import numpy as np

import foamfit as ff
from ogden import CURVE, curve, is_curve, near, read_curve, real_curve


def admissible(p):
    """Return whether the parameters are admissible."""
    return is_curve(p) and p[4] >= 1.0 and p[5] > 0.0


def stress(p, x, strain, branch):
    """Soften below the largest strain, x[0]."""
    stress, energy = curve(strain, p[0], p[1], p[2], p[3])
    if branch == 0:
        return stress
    u = (curve(x[0], p[0], p[1], p[2], p[3])[1] - energy) / p[5]
    erf = near(math.erf(u.real), 2.0 / math.sqrt(math.pi) * math.exp(-(u.real**2)), u)
    return stress * (1.0 - erf / p[4])


def ends(p, x, strain, branch, out):
    """End loading where the strain falls, and the softened curve at the largest strain."""
    if branch == 0:
        out[2] = 1.0
    else:
        out[1] = x[0]


def switch(p, x, strain, branch, up):
    """Keep the largest strain; return the other branch."""
    x[0] = strain
    return 1 - branch


def read_off(loop, marks, scales, way):
    """Read the curve off loading, and the softening off the loop at half the strain."""
    elastic = read_curve(loop, marks, scales, 1.0)
    half = 0.5 * scales.strain
    lost = 1.0 - loop.at(half, loading=False) / loop.at(half, loading=True)
    top = real_curve(scales.strain, *elastic)[1]
    m = top * 10.0 ** (1.5 * marks[2] - 1.0)
    reached = math.erf((top - real_curve(half, *elastic)[1]) / m)
    r = reached / min(max(lost, 0.02), 0.98)
    return np.array([*elastic, min(max(r, 1.01), 50.0), m, 0.0])


LAW = ff.Law(
    kind="ogden-roxburgh",
    title="Ogden-Roxburgh spring",
    params=(
        *CURVE,
        ff.Param("r", ("r", ""), "", "inverse of the largest softening", (1.5, "one"), (1.0, 1e2)),
        ff.Param("m", ("m", ""), "Pa", "energy over which it softens", (0.1, "stress"),
                 (1e-4, 1e1), "stress"),
    ),
    functions=ff.Functions(stress, ends=ends, switch=switch, admissible=admissible),
    internal=1,
    branches={"loading": "beyond the largest strain", "softened": "below it"},
    read_off=read_off,
)  # fmt: skip
