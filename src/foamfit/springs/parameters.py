"""Parameters by their names: units, the branches that show them, and directions of derivatives.

A direction is what a derivative is taken by: a spring (0 at the base) and one of its own parameters
in the order of BISTABLE_NAMES, or its height; or no spring (-1) and the onsite damping of the top.
"""

from __future__ import annotations

from foamfit.errors import InputError

# Parameters of the two kinds of spring, in their order; a linear spring takes what it has of them.
BISTABLE_NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")
LINEAR_NAMES = ("k0", "eta")
# Kinds of spring in the name of a model, in the order of the kernels' BISTABLE, LINEAR, UNILATERAL.
KINDS = ("bistable", "linear", "unilateral")
# What a direction changes, besides the parameters k0 … kh_minus of a spring (0 … 6).
OWN_ETA, OWN_HEIGHT, DRAG = 7, 8, 9

UNITS = {name: "" if name.startswith("eps") else "Pa" for name in BISTABLE_NAMES} | {
    "eta": "Pa s",
    "height": "m",
    "time_shift": "s",
}
# The branches of which a test must have reached one for the parameter to leave a trace in it.
BRANCHES = {
    "k0": "a",
    "eps_a": "d",
    "kh_plus": "d",
    "kc": "c",
    "eps_c": "e",
    "dsigma": "e",
    "kh_minus": "e",
}


def names_of(kind: str) -> tuple[str, ...]:
    """Names of the own parameters of a kind of spring."""
    return BISTABLE_NAMES if kind == "bistable" else LINEAR_NAMES


def split_name(name: str) -> tuple[int, str]:
    """Split "s2_kh_plus" into (1, "kh_plus"); (-1, "eta") for "site_eta", (-1, "time_shift")."""
    if name in ("site_eta", "time_shift"):
        return -1, name.removeprefix("site_")
    prefix, short = name.split("_", 1)
    return int(prefix[1:]) - 1, short


def unit_of(name: str) -> str:
    """Unit of a parameter, SI; "" for a strain."""
    return UNITS[split_name(name)[1]]


def direction(kinds: tuple[str, ...], name: str) -> tuple[int, int]:
    """Direction of the derivative by a parameter of springs of these kinds.

    Raises
    ------
    InputError
        If the springs have no such parameter.
    """
    if name == "site_eta":
        return -1, DRAG
    prefix, _, short = name.partition("_")
    known = [f"s{i}" for i in range(1, len(kinds) + 1)]
    if prefix in known:
        spring = known.index(prefix)
        if short == "height":
            return spring, OWN_HEIGHT
        if short in names_of(kinds[spring]):
            return spring, BISTABLE_NAMES.index(short)
    raise InputError(
        f"sensitivities: '{name}' is not a parameter of this chain; give names like s1_k0, "
        "s2_height or site_eta"
    )
