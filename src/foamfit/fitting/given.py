"""What the user gives about parameters: values, bounds, expressions and priors, checked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import lmfit
import numpy as np

from foamfit.data.measurement import Measurement
from foamfit.data.units import LARGEST, parse_uncertain
from foamfit.errors import InputError
from foamfit.fitting import nuisance
from foamfit.springs.laws.record import ADMISSIBLE
from foamfit.springs.parameters import NUISANCE, any_param, split_name


def copied(params: lmfit.Parameters) -> lmfit.Parameters:
    """Return a copy, as the caller's must not change; InputError for a wrong expression."""
    try:
        own = params.copy()
        own.update_constraints()
        values = own.valuesdict()
    except RecursionError:
        why = "expressions of params depend on each other; give one of these parameters a value"
        raise InputError(why) from None
    except (ArithmeticError, NameError, TypeError, ValueError) as error:
        why, each = str(error) or type(error).__name__, params.items()
        given = [f"{name} = {one.expr}" for name, one in each if one.expr]
        of = f" ({', '.join(given)})" if given else ""
        raise InputError(f"params cannot be evaluated{of}: {why}") from None
    for name, expression in ((name, one.expr) for name, one in own.items() if one.expr):
        if not np.isfinite(values[name]):
            raise InputError(f"the expression {name} = {expression} gives {values[name]}")
        if used := {name, *re.findall(r"\w+", expression)} & {*NUISANCE}:
            raise InputError(
                f"the expression {name} = {expression} has {min(used)}, which may be held "
                "where the record shows it; only parameters of springs may be in an expression"
            )
    return own


def check_admissible(params: lmfit.Parameters, usual: Mapping[str, float]) -> None:
    """Raise InputError for a fixed value, or for bounds without a value, that is admissible.

    Bounds have one if the value in them that is nearest to the `usual` one is admissible.
    """
    for name, one in params.items():
        if one.expr is not None:
            continue
        wanted = "positive" if name in nuisance.POSITIVE else "finite"
        if name not in NUISANCE:
            wanted = any_param(split_name(name)[1]).admissible
        value = min(one.max, max(one.min, usual[name])) if one.vary else one.value
        if abs(value) > LARGEST or not ADMISSIBLE[wanted](value):
            wanted = f"less than {LARGEST:g} (SI)" if abs(value) > LARGEST else wanted
            what = f"between {one.min:g} and {one.max:g}" if one.vary else f"= {value:g}"
            raise InputError(f"{name} {what} is not admissible: it must be {wanted}")


def check_strain(params: lmfit.Parameters, measurement: Measurement) -> None:
    """Raise InputError for a fixed zero of the motion at which the measured strain reaches one."""
    zero, motion = params.get("displacement_zero"), measurement.displacement
    if zero is None or zero.vary or motion is None:
        return
    strain = (float(motion.max()) - zero.value) / measurement.specimen.height
    if strain >= 1.0:
        origin = measurement.origins.get("displacement_zero", 0.0)
        least = float(motion.max()) - measurement.specimen.height + origin
        raise InputError(
            f"displacement_zero = {zero.value + origin:g} m is not admissible: the measured strain "
            f"would reach {strain:.3g}; it must be larger than {least:g} m"
        )


def prior_of(name: str, value: object) -> nuisance.Prior:
    """Read a prior of a spring parameter of any law: mean and standard deviation, or a text."""
    where = f"priors: {name}"
    if name in NUISANCE:
        raise InputError(
            f"{where} is not a parameter of the springs; if the TOML has it, give its ± there"
        )
    try:
        param = any_param(split_name(name)[1])
    except StopIteration:
        raise InputError(f"{where} is not a parameter of any law") from None
    unit = param.unit
    example = "5.5 ± 0.1 MPa" if unit == "Pa" else f"0.2 ± 0.01 {unit}".rstrip()
    if isinstance(value, str):
        mean, sigma = parse_uncertain(value, unit or "", where, example, zero=True)
    else:
        try:
            mean, sigma = map(float, value)  # type: ignore[call-overload]
        except (TypeError, ValueError):
            mean, sigma = math.nan, None
    if sigma is None or not (math.isfinite(mean) and 0.0 < sigma < math.inf):
        pair = f"({unit or 'a number'}, {unit or 'a number'})"
        raise InputError(
            f"{where} = {value!r} must be a mean and a positive standard deviation {pair}, or a "
            f'text like "{example}"'
        )
    if not ADMISSIBLE[wanted := param.admissible](mean):
        raise InputError(f"{where} = {value!r} is not admissible: its mean must be {wanted}")
    return nuisance.Prior(name, mean, sigma)
