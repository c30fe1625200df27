"""Bouc-Wen hysteresis beside an elastic foam: σ = σ_0(ε) + k z.

    dz/dε = 1 - |z/limit|^n  where z grows in the direction of the motion, else 1;  z = 0 at rest

(Bouc-Wen with β = γ.) σ_0 is the Ogden curve (`ogden.py`), so the law has a plateau and
densification, unlike `notebooks/bouc_wen.py` with its linear spring.

Wen 1976, J. Eng. Mech. Div. ASCE 102, 249; Ismail, Ikhouane & Rodellar 2009, Arch. Comput. Methods
Eng. 16, 161.
"""

import numpy as np

import foamfit as ff
from ogden import CURVE, curve, is_curve, read_half


def admissible(p):
    """Return whether the parameters are admissible."""
    return is_curve(p) and p[4:].min() > 0.0


def stress(p, x, strain, branch):
    """Return the stress."""
    return curve(strain, p[0], p[1], p[2], p[3])[0] + p[4] * x[0]


def along(p, x, strain, branch, out):
    """Fill dz/dε."""
    grown = x[0] / p[5] if branch == 0 else -x[0] / p[5]
    out[0] = 1.0 - grown ** p[6] if grown.real > 0.0 else 1.0


def ends(p, x, strain, branch, out):
    """End loading (branch 0) and unloading (1) where the strain turns."""
    out[2] = 1.0 if branch == 0 else -1.0


def switch(p, x, strain, branch, up):
    """Return the other branch."""
    return 1 - branch


def read_off(loop, marks, scales, way):
    """Read the elastic curve midway; half the width of the loop is k·limit."""
    elastic, width = read_half(loop, marks, scales)
    limit = scales.strain * 10.0 ** (1.5 * marks[2] - 2.0)
    return np.array([*elastic, width / limit, limit, 0.7 * 3.0 ** marks[3], 0.0])


LAW = ff.Law(
    kind="bouc-wen-foam",
    title="Bouc-Wen spring beside an elastic foam",
    params=(
        *CURVE,
        ff.Param("k", ("k", ""), "Pa", "hysteretic stiffness", (1.0, "slope"), (1e-3, 1e3),
                 "slope"),
        ff.Param("limit", ("z", "m"), "", "largest hysteretic strain", (0.1, "strain"),
                 (1e-3, 1.0), "strain"),
        ff.Param("n", ("n", ""), "", "sharpness of the yield", (1.0, "one"), (0.3, 10.0)),
    ),
    functions=ff.Functions(stress, along, None, ends, switch, admissible=admissible),
    internal=1,
    branches={"loading": "the strain grows", "unloading": "the strain falls"},
    read_off=read_off,
)  # fmt: skip
