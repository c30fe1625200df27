"""Parameters by their names, their units, and directions of derivatives.

A direction is what a derivative is taken by: a spring (0 at the base) and one of its own parameters
in the order of its law, or its height, or a number of a relaxation term; or no spring (-1) and the
onsite damping of the top.
"""

from __future__ import annotations

from collections.abc import Iterable

from foamfit.errors import InputError
from foamfit.springs import laws
from foamfit.springs.laws.record import COMMON, ETA, Param

# What a direction changes, besides the parameters of a spring's law (0, 1, …). From OWN_RELAXATION
# on: the strength g_k of term k = 1, 2, … is OWN_RELAXATION + 2 (k-1), its time τ_k the number
# after it.
OWN_ETA, OWN_HEIGHT, DRAG, OWN_RELAXATION = 20, 21, 22, 23
# By the displacement of all samples of a known motion that are in contact; of one spring alone.
MOVED = -1

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


def relaxation_names(terms: int) -> tuple[str, ...]:
    """Names of the parameters of so many relaxation terms: g1, tau1, g2, …"""
    return tuple(f"{name}{k}" for k in range(1, terms + 1) for name in ("g", "tau"))


def names_of(kind: str, relaxation: int = 0) -> tuple[str, ...]:
    """Names of the own parameters of a kind of spring that has so many relaxation terms, if any."""
    law = laws.law(kind)
    return law.names + (relaxation_names(relaxation) if law.hysteretic else ())


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


def family(short: str) -> str:
    """Name of a parameter without the number of its relaxation term: "g1" is "g"."""
    for name in ("g", "tau"):
        if short.startswith(name) and short.removeprefix(name).isdigit():
            return name
    return short


def param_of(kinds: tuple[str, ...], name: str) -> Param:
    """Record of a parameter ("s1_k0", "s2_height", "site_eta") of springs of these kinds."""
    spring, short = split_name(name)
    common = COMMON.get(family(short))
    return common or laws.law(kinds[spring]).by_name[short]


def any_param(short: str) -> Param:
    """Record of a parameter by its short name alone, of the first law that has it."""
    if (common := COMMON.get(family(short))) is not None:
        return common
    return next(law.by_name[short] for law in laws.records() if short in law.by_name)


def unit_of(name: str) -> str:
    """Unit of a parameter, SI; "" for a pure number."""
    return NUISANCE[name] if name in NUISANCE else any_param(split_name(name)[1]).unit


def direction(
    kinds: tuple[str, ...], name: str, relaxation: tuple[int, ...] = ()
) -> tuple[int, int]:
    """Direction of the derivative by a parameter of springs with so many relaxation terms each.

    A parameter that they do not have is refused (InputError).
    """
    if name == "site_eta":
        return -1, DRAG
    prefix, _, short = name.partition("_")
    known = [f"s{i}" for i in range(1, len(kinds) + 1)]
    if prefix in known:
        spring = known.index(prefix)
        law, terms = laws.law(kinds[spring]), relaxation[spring] if relaxation else 0
        if short == "height":
            return spring, OWN_HEIGHT
        if short == ETA.name:
            return spring, OWN_ETA
        if short in law.own:
            return spring, law.derivative(short)
        if short in names_of(law.kind, terms):
            return spring, OWN_RELAXATION + relaxation_names(terms).index(short)
    raise InputError(
        f"sensitivities: '{name}' is not a parameter of this chain; give names like s1_k0, "
        "s2_height or site_eta"
    )
