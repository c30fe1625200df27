"""Parameters by their names: units, the branches that show them, and directions of derivatives.

A direction is what a derivative is taken by: a spring (0 at the base) and one of its own parameters
in the order of BISTABLE_NAMES or MICROSCALE_NAMES, or its height, or a number of a relaxation term;
or no spring (-1) and the onsite damping of the top.
"""

from __future__ import annotations

from collections.abc import Iterable

from foamfit.errors import InputError

# Parameters of the kinds of spring, in their order; a linear spring takes what it has of them.
BISTABLE_NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")
MICROSCALE_NAMES = (
    "k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus", "eta",
)  # fmt: skip
LINEAR_NAMES = ("k0", "eta")
# Kinds of spring in the name of a model, in the order of the kernels' BISTABLE, LINEAR, UNILATERAL,
# MICROSCALE; those that may relax.
KINDS = ("bistable", "linear", "unilateral", "microscale")
HYSTERETIC = ("bistable", "microscale")
# What a direction changes, besides the seven parameters of a spring's law (0 … 6). From
# OWN_RELAXATION on: the strength g_k of term k = 1, 2, … is OWN_RELAXATION + 2 (k-1), its time τ_k
# the number after it.
OWN_ETA, OWN_HEIGHT, DRAG, OWN_RELAXATION = 7, 8, 9, 10

UNITS = {
    name: "" if name.startswith(("eps", "spread")) else "Pa"
    for name in BISTABLE_NAMES + MICROSCALE_NAMES
} | {
    "eta": "Pa s",
    "height": "m",
    "g": "",
    "tau": "s",
}
# What a record does not say exactly of an impact, and its unit: unknowns beside the springs.
NUISANCE = {
    "contact_time": "s",
    "displacement_zero": "m",
    "stress_zero": "Pa",
    "acceleration_zero": "m/s^2",
    "velocity": "m/s",
    "striker_mass": "kg",
    "time_shift": "s",
}
# By kind of spring, the branches of which a test must have reached one for the parameter to leave a
# trace in it.
BRANCHES = {
    "bistable": {
        "k0": "a",
        "eps_a": "d",
        "kh_plus": "d",
        "kc": "c",
        "eps_c": "e",
        "dsigma": "e",
        "kh_minus": "e",
    },
    "microscale": {
        "k0": "a",
        "sigma_plus": "snap-through",
        "spread_plus": "snap-through",
        "kc": "snap-through",
        "eps_star": "snap-through",
        "sigma_minus": "snap-back",
        "spread_minus": "snap-back",
    },
}


def relaxation_names(terms: int) -> tuple[str, ...]:
    """Names of the parameters of so many relaxation terms: g1, tau1, g2, …"""
    return tuple(f"{name}{k}" for k in range(1, terms + 1) for name in ("g", "tau"))


def names_of(kind: str, relaxation: int = 0) -> tuple[str, ...]:
    """Names of the own parameters of a kind of spring that has so many relaxation terms, if any."""
    if kind not in HYSTERETIC:
        return LINEAR_NAMES
    law = BISTABLE_NAMES if kind == "bistable" else MICROSCALE_NAMES
    return law + relaxation_names(relaxation)


def springs_first(names: Iterable[str]) -> list[str]:
    """Return each name once: those of the springs as they come, then the nuisance parameters."""
    rank = {name: i for i, name in enumerate(NUISANCE)}
    return sorted(dict.fromkeys(names), key=lambda name: rank.get(name, -1))


def split_name(name: str) -> tuple[int, str]:
    """Split "s2_kh_plus" into (1, "kh_plus"); (-1, "eta") for "site_eta", (-1, "velocity")."""
    prefix, _, short = name.partition("_")
    if prefix.startswith("s") and prefix[1:].isdigit():
        return int(prefix[1:]) - 1, short
    return -1, name.removeprefix("site_")


def unit_of(name: str) -> str:
    """Unit of a parameter, SI; "" for a pure number."""
    if name in NUISANCE:
        return NUISANCE[name]
    short = split_name(name)[1]
    return UNITS[short if short in UNITS else short.rstrip("0123456789")]


def direction(
    kinds: tuple[str, ...], name: str, relaxation: tuple[int, ...] = ()
) -> tuple[int, int]:
    """Direction of the derivative by a parameter of springs of these kinds.

    `relaxation` has the number of relaxation terms of each spring; left out, there are none.

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
        kind, terms = kinds[spring], relaxation[spring] if relaxation else 0
        if short in names_of(kind):
            law = MICROSCALE_NAMES if kind == "microscale" else BISTABLE_NAMES
            return spring, law.index(short)
        if short in names_of(kind, terms):
            return spring, OWN_RELAXATION + relaxation_names(terms).index(short)
    raise InputError(
        f"sensitivities: '{name}' is not a parameter of this chain; give names like s1_k0, "
        "s2_height or site_eta"
    )
