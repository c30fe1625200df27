"""A user-defined law: Bouc-Wen hysteresis, σ = α k ε + (1 - α) k z (Wen 1976, with β = γ).

On loading and unloading alike dz/dε = 1 - |z/limit|^n as long as z grows in the direction of the
motion, else 1.
"""

from numba import njit

import foamfit as ff

EPS, SIGMA, BRANCH, Z = range(4)


def fill(values, row):
    """Copy the parameters; refuse what no spring has."""
    row[0], row[1], row[2], row[3] = values
    return values[0] > 0.0 and values[2] > 0.0


def begin(row, state):
    """Rest: no strain, no stress, z = 0."""
    state[:] = 0.0


def leaves(row, state, strain):
    """Whether the strain turns."""
    return strain != state[EPS] and (strain > state[EPS]) != (state[BRANCH] == 0.0)


def switch(row, state, up):
    """Loading is branch 0, unloading branch 1."""
    state[BRANCH] = 0.0 if up else 1.0


@njit
def slope(z, step, limit, n):
    """dz/dε."""
    return 1.0 - (abs(z) / limit) ** n if z * step > 0.0 else 1.0


def settle(row, state, strain):
    """Follow z to a strain on the same branch."""
    k, alpha, limit, n = row
    count = int(abs(strain - state[EPS]) / (0.01 * limit)) + 1
    step, z = (strain - state[EPS]) / count, state[Z]
    for _ in range(count):  # the classical Runge-Kutta method
        one = slope(z, step, limit, n)
        two = slope(z + 0.5 * step * one, step, limit, n)
        three = slope(z + 0.5 * step * two, step, limit, n)
        four = slope(z + step * three, step, limit, n)
        z += step * (one + 2.0 * two + 2.0 * three + four) / 6.0
    state[EPS], state[Z] = strain, z
    state[SIGMA] = alpha * k * strain + (1.0 - alpha) * k * z


LAW = ff.Law(
    kind="bouc-wen",
    title="Bouc-Wen spring",
    params=(
        ff.Param("k", ("k", ""), "Pa", "first stiffness", (2.0, "slope"), (1e-2, 1e2), "slope"),
        ff.Param(
            "alpha", ("α", ""), "", "stiffness after yield over the first", (0.3, "one"),
            (0.0, 1.0), coordinate="value", least_size=0.1, admissible="zero or positive",
            neutral=0.0,
        ),
        ff.Param(
            "limit", ("z", "m"), "", "largest hysteretic strain", (0.2, "strain"), (1e-3, 1.0)
        ),
        ff.Param("n", ("n", ""), "", "sharpness of the yield", (1.0, "one"), (0.3, 10.0)),
    ),
    functions=ff.Functions(fill, begin, leaves, switch, settle),
    states=4,
    branches={"loading": "the strain grows", "unloading": "the strain falls"},
)  # fmt: skip
