"""What a record does not say exactly: contact, zeros of the channels, and the striker.

They are unknowns of an impact beside the parameters of its springs. Each value counts from what the
record itself gives (`Measurement.origins`, the striker of the TOML), so that a measurement taken
for exact has zeros here, and the velocity and mass that the TOML states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from foamfit.data.measurement import Measurement
from foamfit.springs.parameters import NUISANCE

CONTACT_TIME, TIME_SHIFT = "contact_time", "time_shift"
VELOCITY, STRIKER_MASS = "velocity", "striker_mass"
# Zeros of the channels: what a channel shows where the quantity itself is zero.
ZEROS = {
    "displacement_zero": "displacement",
    "stress_zero": "stress",
    "acceleration_zero": "acceleration",
}
STRIKER = (VELOCITY, STRIKER_MASS)
OF_IMPACT = (CONTACT_TIME, *ZEROS, *STRIKER)
# Standard deviations of a prior within which its parameter is looked for.
REACH = 6.0
# Largest contact time and time shift, over the time under load; largest zeros, over the range.
LARGEST_CONTACT, LARGEST_SHIFT, LARGEST_ZERO = 0.15, 0.1, 0.5


@dataclass(frozen=True)
class Prior:
    """What is known of a nuisance parameter before the fit: a normal distribution, SI."""

    name: str
    mean: float
    sigma: float


def names_of(drive: str, *, time_shift: bool) -> tuple[str, ...]:
    """Names of the nuisance parameters under a drive, in the order of the flat vector."""
    return (*(OF_IMPACT if drive == "impact" else ()), *((TIME_SHIFT,) if time_shift else ()))


def values_of(measurement: Measurement) -> dict[str, float]:
    """Values that the record and its TOML give, SI."""
    striker = measurement.striker
    values = dict.fromkeys(NUISANCE, 0.0)
    values[VELOCITY] = (striker.velocity if striker else None) or math.nan
    values[STRIKER_MASS] = (striker.mass if striker else None) or math.nan
    return values


def priors_of(measurement: Measurement) -> dict[str, Prior]:
    """Priors of nuisance parameters: zeros shown before contact, and each ± of the TOML.

    The mass has none where the stress was computed with it: force and inertia then change together.
    """
    values = values_of(measurement)
    known = {zero: measurement.zeros.get(channel) for zero, channel in ZEROS.items()}
    stated = {VELOCITY: "velocity", STRIKER_MASS: "striker_mass", TIME_SHIFT: "delay"}
    known |= {name: measurement.uncertainties.get(key) for name, key in stated.items()}
    if measurement.braked:
        del known[STRIKER_MASS]
    return {name: Prior(name, values[name], sigma) for name, sigma in known.items() if sigma}


def open_in(measurement: Measurement, counted: Mapping[str, bool]) -> frozenset[str]:
    """Nuisance parameters that an impact leaves open, by which of its channels are `counted`.

    The zero of a motion is arbitrary; that of a force or an acceleration is the file's own where
    nothing recorded before the contact shows another.
    """
    priors = priors_of(measurement)
    known = {name for name in priors if counted.get(ZEROS.get(name, ""), True)}
    moved = {"displacement_zero"} if counted.get("displacement", False) else set()
    return frozenset({CONTACT_TIME} | moved | known)


def limits_of(
    name: str, measurement: Measurement, duration: float, ranges: Mapping[str, float]
) -> tuple[float, float]:
    """Limits of a nuisance parameter, SI; `ranges` are those of the channels."""
    prior = priors_of(measurement).get(name)
    middle = values_of(measurement)[name]
    if prior is not None:
        reach = REACH * prior.sigma
        if name in STRIKER:
            reach = min(reach, 0.9 * middle)
        return middle - reach, middle + reach
    if name in (CONTACT_TIME, TIME_SHIFT):
        reach = (LARGEST_CONTACT if name == CONTACT_TIME else LARGEST_SHIFT) * duration
        return -reach, reach
    if name in ZEROS:
        reach = LARGEST_ZERO * ranges.get(ZEROS[name], 0.0)
        return -reach, reach
    return 0.1 * middle, 10.0 * middle
