"""Checks of a law before it is registered."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.springs.laws import followed
from foamfit.springs.laws.record import ADMISSIBLE, COMMON, EPS, Functions, Law, Param

SCALES = {"one": 1.0, "strain": 0.5, "stress": 1e6, "slope": 2e6, "damping": 1e3, "duration": 1e-3}
_UP = np.linspace(0.0, 0.5, 101)
TRIED = np.concatenate([_UP, _UP[-2::-1]])  # strains of the trial: loading and unloading
FALLS = 1e-9  # allowed decrease of stress on loading (rounding), relative to the largest stress


def _names(law: Law, taken: Sequence[str]) -> str | None:
    """Return what is wrong with the names and numbers of a record, or None."""
    if not re.fullmatch(r"[a-z][a-z0-9-]*", law.kind):
        return "its kind must be small letters, digits and hyphens, beginning with a letter"
    if law.kind in taken:
        return "the name is that of a law of foamfit; choose another"
    if not law.params:
        return "it has no parameters; give it at least one Param"
    for param in law.params:
        if (wrong := _param(law, param)) is not None:
            return f"parameter '{param.name}': {wrong}"
    return None


def _param(law: Law, param: Param) -> str | None:
    """Return what is wrong with one parameter, or None."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", param.name) or re.fullmatch(r"(g|tau)\d+", param.name):
        return "the name must be small letters, digits and underscores, and not g1, tau1, …"
    if param.name in COMMON or law.own.count(param.name) > 1:
        return f"the name is taken; every spring has {', '.join(COMMON)} of its own"
    if param.scale not in SCALES or param.start[1] not in SCALES:
        return f"scale and start must name one of {', '.join(SCALES)}"
    if param.admissible not in ADMISSIBLE:
        return f"admissible must be one of {', '.join(map(repr, ADMISSIBLE))}"
    if not param.bounds[0] < param.bounds[1]:
        return "bounds must be (lower, upper)"
    if param.is_logarithmic and param.bounds[0] <= 0.0:
        return 'its coordinate is a logarithm, so bounds must be positive; or coordinate = "value"'
    if unknown := [name for name in param.of if name not in law.own]:
        return f"its coordinate is relative to '{unknown[0]}', which the law does not have"
    return None


def start_values(law: Law) -> Array:
    """Return the start values of the parameters for a test of 1 MPa at a strain of 0.5."""
    return law.assembled(lambda param: 0.5 if param.of else param.start[0] * SCALES[param.start[1]])


def _missing(law: Law) -> str | None:
    """Return what is wrong with the functions of a record, or None."""
    given = law.loaded_functions()
    if not isinstance(given, Functions):
        return "functions must be foamfit.Functions(fill, begin, leaves, switch, settle)"
    needed = given if given.viscous is not None else given._replace(viscous=bool)
    absent = [name for name, one in needed._asdict().items() if not callable(one)]
    return f"the function {absent[0]} is missing" if absent else None


def _overrun(law: Law, values: Array) -> str | None:
    """Return what is wrong with the lengths of row and state, or None.

    Compiled functions do not check indices and could write outside an array. The law is therefore
    first followed by the uncompiled functions.
    """
    given = law.loaded_functions()
    written: list[Any] = [getattr(one, "py_func", one) for one in given]
    plain = Functions(*written)
    if any(one and one.__module__.startswith("foamfit.") for one in written):
        return None  # built-in laws call compiled functions
    columns, states = followed.sizes_of(law)
    row, state = np.zeros(columns), np.zeros(states)
    try:
        with np.errstate(all="ignore"):
            plain.fill(values, row)
            plain.begin(row, state)
            for strain in TRIED[:: TRIED.size // 8]:
                for _ in range(len(law.branches)):
                    if plain.leaves(row, state, strain):
                        plain.switch(row, state, strain > state[EPS])
                plain.settle(row, state, strain)
                if plain.viscous is not None:
                    plain.viscous(row, state, 1.0, 0.1)
    except IndexError:
        return (
            f"a function goes beyond the {columns} numbers of row or the {states} of state; give "
            "the law as many columns and states as it uses"
        )
    except Exception:
        return None  # the trial of the compiled functions reports it
    return None


def _trial(law: Law) -> str | None:
    """Return what is wrong in a loading and unloading at start values, or None."""
    values = start_values(law)
    if (wrong := _overrun(law, values)) is not None:
        return wrong
    shown = ", ".join(f"{n} = {v:g}" for n, v in zip(law.own, values, strict=True))
    try:
        if followed.row_of(law, values) is None:
            return f"fill refuses its own start values ({shown}); give others"
        stress, branches = followed.stress_along(law, values, TRIED)
        followed.compile_delayed(law)
    except Exception as error:  # any error of the compiler in a user's function
        told = " ".join(str(error).split())[:300]
        return f"its functions cannot be compiled or run ({type(error).__name__}: {told})"
    if not np.all(np.isfinite(stress)):
        at = int(np.argmin(np.isfinite(stress)))
        return f"the stress is not finite at the strain {TRIED[at]:g} ({shown})"
    if branches.min() < 0 or branches.max() >= len(law.numbered or law.branches):
        return f"a branch has the number {branches.max()}, but branches names {len(law.branches)}"
    loading = stress[: _UP.size]
    fall = np.diff(loading) < -FALLS * np.abs(loading).max()
    if fall.any():
        at = int(np.argmax(fall))
        return (
            f"the stress falls on loading between the strains {TRIED[at]:g} and {TRIED[at + 1]:g} "
            f"({shown}); a branch must rise with the strain"
        )
    return None


def check(law: Law, taken: Sequence[str]) -> None:
    """Raise InputError if a law is wrong; `taken` are the names of built-in laws."""
    if not isinstance(law, Law):
        raise InputError(f"{law!r} is not a foamfit.Law")
    wrong = _names(law, taken) or _missing(law) or _trial(law)
    if wrong:
        raise InputError(f"law '{law.kind}': {wrong}")
