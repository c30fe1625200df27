"""Ogden-Roxburgh softening: a pseudo-elastic foam that unloads below its loading curve.

    σ = η σ_0(ε),   η = 1 - (1/r) erf((W_m - W_0(ε)) / m)

σ_0 and W_0 are stress and energy of the Ogden curve (`ogden.py`), W_m is the largest energy so far,
the only state variable. On the loading curve η = 1; unloading and reloading below the largest
strain follow the same softer path. r >= 1 and m > 0 (J/m³).

Ogden & Roxburgh 1999, Proc. R. Soc. A 455, 2861, equation (51).
"""

import math

import numpy as np
from ogden import CURVE, begin, curve, leaves, read_curve, switch

import foamfit as ff

EPS, SIGMA, BRANCH, LARGEST = range(4)


def fill(values, row):
    """Copy the parameters; return whether they are admissible."""
    for j in range(6):
        row[j] = values[j]
    return values[:3].min() > 0.0 and values[3] >= -3.0 and values[4] >= 1.0 and values[5] > 0.0


def settle(row, state, strain):
    """Soften by the largest energy."""
    stress, energy = curve(strain, row[0], row[1], row[2], row[3])
    state[LARGEST] = max(state[LARGEST], energy)
    state[EPS], state[SIGMA] = strain, stress
    if energy < state[LARGEST]:
        state[SIGMA] *= 1.0 - math.erf((state[LARGEST] - energy) / row[5]) / row[4]


def read_off(loop, marks, scales, way):
    """Read the curve off loading, and the softening off the loop at half the strain."""
    elastic = read_curve(loop, marks, scales, 1.0)
    half = 0.5 * scales.strain
    lost = 1.0 - loop.at(half, loading=False) / loop.at(half, loading=True)
    top = curve(scales.strain, *elastic)[1]
    m = top * 10.0 ** (1.5 * marks[2] - 1.0)
    reached = math.erf((top - curve(half, *elastic)[1]) / m)
    r = reached / min(max(lost, 0.02), 0.98)
    return np.array([*elastic, min(max(r, 1.01), 50.0), m, 0.0])


LAW = ff.Law(
    kind="ogden-roxburgh",
    title="Ogden-Roxburgh spring",
    params=(
        *CURVE,
        ff.Param("r", ("r", ""), "", "inverse of the largest softening", (1.5, "one"), (1.0, 1e2)),
        ff.Param(
            "m", ("m", ""), "Pa", "energy over which it softens", (0.1, "stress"), (1e-4, 1e1),
            "stress",
        ),
    ),
    functions=ff.Functions(fill, begin, leaves, switch, settle),
    states=4,
    branches={"elastic": "the softened curve"},
    read_off=read_off,
)  # fmt: skip
