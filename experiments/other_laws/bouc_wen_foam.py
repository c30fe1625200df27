"""Bouc-Wen hysteresis beside an elastic foam: σ = σ_0(ε) + k z.

    dz/dε = 1 - |z/limit|^n  where z grows in the direction of the motion, else 1;  z = 0 at rest

(Bouc-Wen with β = γ.) σ_0 is the Ogden curve (`ogden.py`), so the law has a plateau and
densification, unlike `notebooks/bouc_wen.py` with its linear spring.

Wen 1976, J. Eng. Mech. Div. ASCE 102, 249; Ismail, Ikhouane & Rodellar 2009, Arch. Comput. Methods
Eng. 16, 161.
"""

import numpy as np
from numba import njit
from ogden import CURVE, curve, read_curve

import foamfit as ff

EPS, SIGMA, BRANCH, Z = range(4)


def fill(values, row):
    """Copy the parameters; return whether they are admissible."""
    for j in range(7):
        row[j] = values[j]
    return values[:3].min() > 0.0 and values[3] >= -3.0 and values[4:].min() > 0.0


def begin(row, state):
    """Set the state at rest."""
    state[:] = 0.0


def leaves(row, state, strain):
    """Return whether the strain reverses."""
    return strain != state[EPS] and (strain > state[EPS]) != (state[BRANCH] == 0.0)


def switch(row, state, up):
    """Set branch 0 for loading, 1 for unloading."""
    state[BRANCH] = 0.0 if up else 1.0


@njit
def slope(z, step, limit, n):
    """Return dz/dε."""
    return 1.0 - min(abs(z) / limit, 1.0) ** n if z * step > 0.0 else 1.0


def settle(row, state, strain):
    """Follow z to a strain on the same branch."""
    limit, n, z = row[5], row[6], state[Z]
    left = strain - state[EPS]
    if z * left < 0.0:  # up to z = 0 the slope is 1
        free = min(abs(left), abs(z)) * (1.0 if left > 0.0 else -1.0)
        z, left = z + free, left - free
    count = int(min(abs(left), 40.0 * limit) / (0.05 * limit)) + 1  # beyond, z = ±limit
    step = left / count
    for _ in range(count):  # the classical Runge-Kutta method
        one = slope(z, step, limit, n)
        two = slope(z + 0.5 * step * one, step, limit, n)
        three = slope(z + 0.5 * step * two, step, limit, n)
        four = slope(z + step * three, step, limit, n)
        z += step * (one + 2.0 * two + 2.0 * three + four) / 6.0
    state[EPS], state[Z] = strain, min(max(z, -limit), limit)
    elastic = curve(strain, row[0], row[1], row[2], row[3])[0]
    state[SIGMA] = elastic + row[4] * state[Z]


def read_off(loop, marks, scales, way):
    """Read the elastic curve midway; half the width of the loop is k·limit."""
    half = 0.5 * scales.strain
    width = loop.at(half, loading=True) - loop.at(half, loading=False)
    limit = scales.strain * 10.0 ** (1.5 * marks[2] - 2.0)
    k = max(0.5 * width, 0.01 * scales.stress) / limit
    elastic = read_curve(loop, marks, scales, 0.5)
    return np.array([*elastic, k, limit, 0.7 * 3.0 ** marks[3], 0.0])


LAW = ff.Law(
    kind="bouc-wen-foam",
    title="Bouc-Wen spring beside an elastic foam",
    params=(
        *CURVE,
        ff.Param(
            "k", ("k", ""), "Pa", "hysteretic stiffness", (1.0, "slope"), (1e-3, 1e3), "slope"
        ),
        ff.Param(
            "limit", ("z", "m"), "", "largest hysteretic strain", (0.1, "strain"), (1e-3, 1.0),
            "strain",
        ),
        ff.Param("n", ("n", ""), "", "sharpness of the yield", (1.0, "one"), (0.3, 10.0)),
    ),
    functions=ff.Functions(fill, begin, leaves, switch, settle),
    states=4,
    branches={"loading": "the strain grows", "unloading": "the strain falls"},
    read_off=read_off,
)  # fmt: skip
