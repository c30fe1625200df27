"""A user-defined law: Bouc-Wen hysteresis, σ = α k ε + (1 - α) k z (Wen 1976, with β = γ).

On loading and unloading alike dz/dε = 1 - |z/limit|^n as long as z grows in the direction of the
motion, else 1.
"""

import foamfit as ff


def stress(p, x, strain, branch):
    """σ, Pa."""
    k, alpha, _, _ = p
    return alpha * k * strain + (1.0 - alpha) * k * x[0]


def along(p, x, strain, branch, out):
    """dz/dε."""
    _, _, limit, n = p
    grown = x[0] / limit if branch == 0 else -x[0] / limit
    out[0] = 1.0 - grown**n if grown.real > 0.0 else 1.0


def ends(p, x, strain, branch, out):
    """Loading (branch 0) ends where the strain stops rising, unloading (1) where it rises again."""
    out[2] = 1.0 if branch == 0 else -1.0


def switch(p, x, strain, branch, up):
    """The next branch."""
    return 1 - branch


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
    functions=ff.Functions(stress, along, ends=ends, switch=switch),
    internal=1,
    branches={"loading": "the strain grows", "unloading": "the strain falls"},
)  # fmt: skip
