"""Maxwell-slip (Iwan): an elastic foam in parallel with N sliders, each with its own spring.

    σ = σ_0(ε) + (k/N) Σ e_j,   de_j = dε  as long as |e_j| < y_j,   y_j = slip ((j - ½)/N)^spread

σ_0 is the Ogden curve (`ogden.py`), e_j the elastic strain of slider j.
The slip strains are those of Segalman's power law, spread = 1/(1 + χ), in N = 24 equal shares of
the stiffness k. For N → ∞ loading from rest adds k ε (1 - u spread/(1 + spread)) with u =
(ε/slip)^(1/spread) as long as ε <= slip, and unloading subtracts twice this curve at half the
strain (Masing).

Iwan 1966, J. Appl. Mech. 33, 893; Segalman 2005, J. Appl. Mech. 72, 752.
"""

import numpy as np
from numba import njit

import foamfit as ff
from bouc_wen_foam import admissible, ends
from ogden import CURVE, curve, read_half

N = 24  # sliders; their elastic strains at the last turn, and the strain there, are internal


@njit
def held(p, x, strain, j):
    """Return the elastic strain of a slider."""
    limit = p[5] * ((j + 0.5) / N) ** p[6]
    value = x[j] + strain - x[N]
    if abs(value.real) <= limit.real:
        return value
    return limit if value.real > 0.0 else -limit


def stress(p, x, strain, branch):
    """Return the stress."""
    total = 0j
    for j in range(N):
        total += held(p, x, strain, j)
    return curve(strain, p[0], p[1], p[2], p[3])[0] + p[4] / N * total


def switch(p, x, strain, branch, up):
    """Keep the strains at a turn; return the other branch."""
    for j in range(N):
        x[j] = held(p, x, strain, j)
    x[N] = strain
    return 1 - branch


def read_off(loop, marks, scales, way):
    """Read the elastic curve midway; half the loop width is the stress of all sliders."""
    elastic, width = read_half(loop, marks, scales)
    slip, spread = scales.strain * 10.0 ** (1.2 * marks[2] - 1.2), 0.5 * 8.0 ** marks[3]
    return np.array([*elastic, width / slip * (1.0 + spread), slip, spread, 0.0])


LAW = ff.Law(
    kind="maxwell-slip",
    title="Maxwell-slip spring",
    params=(
        *CURVE,
        ff.Param("k", ("k", ""), "Pa", "stiffness of all sliders", (1.0, "slope"), (1e-3, 1e3),
                 "slope"),
        ff.Param("slip", ("y", "m"), "", "largest slip strain", (0.2, "strain"), (1e-3, 1e1),
                 "strain"),
        ff.Param("spread", ("s", ""), "", "spread of the slip strains", (1.0, "one"), (0.1, 10.0)),
    ),
    functions=ff.Functions(stress, ends=ends, switch=switch, admissible=admissible),
    internal=N + 1,
    branches={"loading": "the strain grows", "unloading": "the strain falls"},
    read_off=read_off,
)  # fmt: skip
