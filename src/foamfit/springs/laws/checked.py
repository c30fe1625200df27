"""Checks of a law before it is registered."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.solve.histories import stress_along
from foamfit.springs.compiled.contract import MOST_INTERNAL
from foamfit.springs.laws.record import ADMISSIBLE, COMMON, SCALES, Functions, Law, Param
from foamfit.springs.spring import LawSpring, first_infinite

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


def _missing(law: Law) -> str | None:
    """Return what is wrong with the functions of a record, or None."""
    given: Any = law.functions
    if not isinstance(given, Functions):
        return "functions must be foamfit.Functions(stress, …)"
    if not isinstance(law.internal, int) or not 0 <= law.internal <= MOST_INTERNAL:
        return f"internal must be a number of internal variables from 0 to {MOST_INTERNAL}"
    own = given._asdict()
    if given.stress is None:
        return "the function stress is missing"
    if wrong := [name for name, one in own.items() if not (one is None or callable(one))]:
        return f"{wrong[0]} is not a function"
    if (given.along or given.decay) and not law.internal:
        name = "along" if given.along else "decay"
        return f"{name} fills the rates of internal variables, but internal is 0"
    if law.internal and not (given.along or given.decay or given.switch):
        return "the function along is missing: nothing changes the internal variables"
    if given.ends and not given.switch:
        return "the function switch is missing: branches end, but none follows"
    return None


def _overrun(law: Law, values: Array) -> str | None:
    """Return what is wrong with the indices in the functions, or None."""
    # Compiled functions could write outside an array, so they first run as they are.
    given: Any = law.functions
    own = {name: getattr(one, "py_func", one) for name, one in given._asdict().items() if one}
    p, rate = tuple(values.astype(complex).tolist()), 1.0 + 0j
    for branch, strain, held in product(
        range(len(law.branches)), (-0.1 + 0j, 0.1 + 0j, 0.4 + 0j), (0.0, 0.1, -0.1)
    ):
        x = np.full(law.internal, held, complex)
        at, out = (p, x, strain, branch), np.zeros(law.internal, complex)
        calls: dict[str, tuple[Any, ...]] = {
            "stress": at, "along": (*at, out), "decay": (*at, out),
            "ends": (*at, np.zeros(3, complex)), "viscous": (p, x, strain, rate, branch),
            "switch": (*at, True),
        }  # fmt: skip
        for name in own.keys() & calls.keys():
            try:
                with np.errstate(all="ignore"):
                    own[name](*calls[name])
            except IndexError:
                return (
                    f"the function {name} goes beyond the {len(p)} numbers of p, the "
                    f"{law.internal} of x or those of out; set internal to the length of x"
                )
            except Exception:
                continue  # the trial of the compiled functions reports it
    return None


def _trial(law: Law) -> str | None:
    """Return what is wrong in a loading and unloading at start values, or None."""
    values = law.start_values
    if (wrong := _overrun(law, values)) is not None:
        return wrong
    shown = ", ".join(f"{n} = {v:g}" for n, v in zip(law.own, values, strict=True))
    try:
        stress, branches = stress_along(law, LawSpring(law, [*values, 0.0]).row, TRIED)
    except InputError:
        return f"admissible refuses its own start values ({shown}); give others"
    except Exception as error:  # any error of the compiler in a user's function
        told = re.sub("\x1b\\[[0-9;]*m", "", str(error)).split()  # without the compiler's colours
        what = f"{type(error).__name__}: {' '.join(told)[:300]}"
        return f"its functions cannot be compiled or run ({what})"
    if (at := first_infinite(stress)) is not None:
        return f"the stress is not finite at the strain {TRIED[at]:g} ({shown})"
    if branches.min() < 0 or branches.max() >= len(law.branches):
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


def check(law: Law, taken: Sequence[str]) -> Law:
    """Return the law with a way to make springs; InputError if it is wrong or its name `taken`."""
    if not isinstance(law, Law):
        raise InputError(f"{law!r} is not a foamfit.Law")
    if law.spring is None:
        law = replace(law, spring=lambda *given, **terms: LawSpring(law, given, **terms))
    wrong = _names(law, taken) or _missing(law) or _trial(law)
    if wrong:
        raise InputError(f"law '{law.kind}': {wrong}")
    return law
