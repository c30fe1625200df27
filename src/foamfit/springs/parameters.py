"""Names and units of parameters, and directions of derivatives.

A direction is a pair of numbers that names a parameter: the spring (0 = base) and the index of the
parameter in its law, or one of the constants of `laws.record` for height, dashpot and relaxation
terms; for the onsite damper the spring is -1.
"""

from __future__ import annotations

from collections.abc import Iterable

from foamfit.errors import InputError
from foamfit.springs import laws
from foamfit.springs.laws import record
from foamfit.springs.laws.record import COMMON, Law, Param

# Nuisance parameters (see `fitting.nuisance`): symbol, unit, and the name in reports.
_NUISANCE = (
    Param("contact_time", ("t", "0"), "s", "contact time t₀"),
    Param("displacement_zero", ("w", "0"), "m", "motion zero w₀"),
    Param("stress_zero", ("σ", "0"), "Pa", "stress zero σ₀"),
    Param("acceleration_zero", ("a", "0"), "m/s^2", "acceleration zero a₀"),
    Param("velocity", ("v", "0"), "m/s", "velocity v₀"),
    Param("striker_mass", ("m", ""), "kg", "striker mass m"),
    Param("force_scale", ("s", "F"), "", "force scale s_F"),
    Param("time_shift", ("Δt", ""), "s", "time shift Δt"),
)
NUISANCE = {param.name: param for param in _NUISANCE}


def relaxation_names(terms: int) -> tuple[str, ...]:
    """Return the names of the parameters of relaxation terms: g1, tau1, g2, …"""
    return tuple(f"{name}{k}" for k in range(1, terms + 1) for name in ("g", "tau"))


def names_of(law: Law, relaxation: int) -> tuple[str, ...]:
    """Return the names of the parameters of a law, with its relaxation terms."""
    return law.names + (relaxation_names(relaxation) if law.hysteretic else ())


def springs_first(names: Iterable[str]) -> list[str]:
    """Return each name once: first parameters of the springs, then nuisance parameters."""
    rank = {name: i for i, name in enumerate(NUISANCE)}
    return sorted(dict.fromkeys(names), key=lambda name: rank.get(name, -1))


def split_name(name: str) -> tuple[int, str]:
    """Split "s2_kh_plus" into (1, "kh_plus"); (-1, "eta") for "site_eta", (-1, "velocity")."""
    prefix, _, short = name.partition("_")
    if prefix.startswith("s") and prefix[1:].isdecimal():
        return int(prefix[1:]) - 1, short
    return -1, name.removeprefix("site_")


def family(short: str) -> str:
    """Return a name without the number of a relaxation term: "g" for "g1"."""
    for name in ("g", "tau"):
        if short.startswith(name) and short.removeprefix(name).isdigit():
            return name
    return short


def any_param(short: str) -> Param:
    """Return the record of a parameter by its short name, from the first law that has it."""
    if (common := COMMON.get(family(short))) is not None:
        return common
    return next(law.by_name[short] for law in laws.records() if short in law.by_name)


def unit_of(name: str) -> str:
    """Return the SI unit of a parameter; "" for a dimensionless one."""
    return (NUISANCE.get(name) or any_param(split_name(name)[1])).unit


def direction(
    chain: tuple[Law, ...], name: str, relaxation: tuple[int, ...] = ()
) -> tuple[int, int]:
    """Return the direction of the derivative by a parameter of springs of these laws.

    Raises InputError if springs with these numbers of relaxation terms do not have it.
    """
    if name == "site_eta":
        return -1, record.DRAG
    spring, short = split_name(name)
    if 0 <= spring < len(chain):
        law, terms = chain[spring], relaxation[spring] if relaxation else 0
        if short == "height":
            return spring, record.OWN_HEIGHT
        if short == record.ETA.name:
            return spring, record.OWN_ETA
        if short in law.own:
            return spring, law.places.get(short, law.own.index(short))
        if short in names_of(law, terms):
            return spring, record.OWN_RELAXATION + relaxation_names(terms).index(short)
    raise InputError(
        f"sensitivities: '{name}' is not a parameter of this chain; give names like s1_k0, "
        "s2_height or site_eta"
    )
