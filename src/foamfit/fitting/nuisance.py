"""Nuisance parameters: contact time, zeros of the channels, striker, force scale and time shift.

They are fitted together with the parameters of the springs: all of them in an impact, the zeros of
motion and stress under a driving motion, that of the motion under a driving stress. Times and zeros
are relative to the values found by the loader (`Measurement.origins`), 0 for an exact record;
velocity and mass are those of the TOML. `shown_by` returns what the record says of them without a
law of the springs; their limits follow from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from foamfit.data.calibration import balance
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.data.noise import lowest_mean
from foamfit.springs.parameters import NUISANCE

CONTACT_TIME, TIME_SHIFT = "contact_time", "time_shift"
VELOCITY, STRIKER_MASS = "velocity", "striker_mass"
FORCE_SCALE = "force_scale"  # true force over measured force
# Zeros of the channels: the reading of a channel when the quantity is zero.
ZEROS = {f"{channel}_zero": channel for channel in ("displacement", "stress", "acceleration")}
STRIKER = (VELOCITY, STRIKER_MASS)
POSITIVE = (*STRIKER, FORCE_SCALE)  # positive parameters, each of which is its own scale
UNDER_DRIVE = {
    "impact": (CONTACT_TIME, *ZEROS, *STRIKER, FORCE_SCALE),
    "displacement": ("displacement_zero", "stress_zero"),
    "stress": ("displacement_zero",),
}
# Limits of a parameter with a prior, and of one that the first rise shows, in standard deviations.
REACH, REACH_OF_RISE = 6.0, 5.0
# Where the record shows nothing: largest contact time and time shift, as a fraction of the time
# under load; largest zero, as a fraction of the range of the channel.
LARGEST_CONTACT, LARGEST_SHIFT, LARGEST_ZERO = 0.15, 0.1, 0.5
# The zero of the file is kept if it is this close to the motion at contact, in standard deviations.
ALIKE = 1.5
LARGEST_STRAIN = 0.999  # of the measured motion, with its zero taken off
_NEAR = 12  # the speed at contact is that over this part of the way to the turn
_OUTSIDE = 0.1  # of that part: a contact outside the record is far from it
_FIRST = 3  # rows that show the stress at which a record begins


@dataclass(frozen=True)
class Prior:
    """Normal prior distribution of a parameter, SI."""

    name: str
    mean: float
    sigma: float


def is_late(measurement: Measurement, *, time_shift: bool) -> bool:
    """Return whether a time shift is fitted: by request, or because the delay has a ±."""
    return time_shift or bool(measurement.uncertainties.get("delay"))


def names_of(drive: str, *, time_shift: bool) -> tuple[str, ...]:
    """Return the names of the nuisance parameters, in the order of the flat vector."""
    return (*UNDER_DRIVE.get(drive, ()), *((TIME_SHIFT,) if time_shift else ()))


def values_of(measurement: Measurement) -> dict[str, float]:
    """Return the values given by the record and its TOML, SI."""
    striker = measurement.striker
    values = dict.fromkeys(NUISANCE, 0.0) | {FORCE_SCALE: 1.0}
    values[VELOCITY] = (striker.velocity if striker else None) or math.nan
    values[STRIKER_MASS] = (striker.mass if striker else None) or math.nan
    return values


def priors_of(measurement: Measurement, drive: str) -> dict[str, Prior]:
    """Return the priors of nuisance parameters: zeros measured before contact, ± of the TOML.

    A machine may move before it touches the specimen, so its rest position is not the zero of a
    driving motion, unless it is set to zero at the first row, in contact. The mass has no prior if
    the stress was computed from it, because force and inertia then change together.
    """
    values = values_of(measurement)
    known = {zero: measurement.zeros.get(channel) for zero, channel in ZEROS.items()}
    if drive != "impact" and measurement.contact != "file":
        known["displacement_zero"] = None
    stated = {VELOCITY: "velocity", STRIKER_MASS: "striker_mass", TIME_SHIFT: "delay"}
    stated[FORCE_SCALE] = "stress_scale"
    known |= {name: measurement.uncertainties.get(key) for name, key in stated.items()}
    if measurement.braked:
        del known[STRIKER_MASS]
    return {name: Prior(name, values[name], sigma) for name, sigma in known.items() if sigma}


def open_in(measurement: Measurement, drive: str, counted: Mapping[str, bool]) -> frozenset[str]:
    """Return the nuisance parameters to fit by default, given which channels are `counted`.

    The zero of a motion is arbitrary in an impact, and in a slow test recorded from before the
    contact. The zero of a force or an acceleration is that of the file unless samples before the
    contact show another.
    """
    priors = priors_of(measurement, drive)
    known = {name for name in priors if counted.get(ZEROS.get(name, ""), True)} - {FORCE_SCALE}
    moved = counted["displacement"]
    if drive == "impact":
        known.add(CONTACT_TIME)
    else:
        elsewhere = measurement.origins.get("displacement_zero", 0.0) != 0.0
        moved = elsewhere or measurement.contact != "file" or "displacement" in measurement.zeros
    return frozenset(known | {"displacement_zero"} if moved else known)


def shown_by(measurement: Measurement, drive: str, *, late: bool = False) -> dict[str, Prior]:
    """Return contact time and zeros as the record shows them without a law, SI.

    The first rise of the stress shows the contact; the motion at that time is its zero, unless the
    zero of the file is as likely. A motion that may be `late` shows neither.
    """
    out = {name: one for name, one in priors_of(measurement, drive).items() if name in ZEROS}
    if measurement.rise is None or (late and measurement.contact == "motion"):
        return out
    contact, error = measurement.rise
    if "displacement_zero" not in out and measurement.displacement is not None and not late:
        zero, speed, noise = _motion_at(measurement, contact)
        spread = math.hypot(speed * error, noise)
        of_file = -measurement.origins.get("displacement_zero", 0.0)
        if abs(of_file - zero) < ALIKE * spread and speed > 0.0:
            contact, zero = contact + (of_file - zero) / speed, of_file
        out["displacement_zero"] = Prior("displacement_zero", zero, spread)
    if drive == "impact":
        out[CONTACT_TIME] = Prior(CONTACT_TIME, contact, error)
    return out


def aligned(measurement: Measurement) -> dict[str, float]:
    """Return delay (s) and zero (m) of a motion that may be late, as the striker shows them."""
    late, motion = balance(measurement).delay, measurement.displacement
    if late is None or motion is None:
        return {}
    zero = float(np.interp(late[0], measurement.instants, motion))
    return {TIME_SHIFT: late[0], "displacement_zero": zero}


def open_zero(measurement: Measurement, *, glued: bool) -> float:
    """Return the error of the zero of the stress in a slow test that begins in contact, Pa.

    Its first stress may be an offset of the sensor, and so may a tension, unless it is `glued`.
    """
    stress = measurement.stress
    if measurement.contact != "file" or "stress" in measurement.zeros:
        return 0.0
    tension = 0.0 if glued else -lowest_mean(stress, int(np.argmax(stress)))[0]
    return max(float(stress[:_FIRST].mean()), tension, 0.0)


def _motion_at(measurement: Measurement, contact: float) -> tuple[float, float, float]:
    """Return the motion (m) and its speed at contact, and its noise."""
    values, level = measurement.displacement, measurement.noise.of("displacement")
    assert values is not None
    time = measurement.instants
    first = next(iter(cycles_of(measurement).values()), slice(None))  # of several cycles
    at, top = int(np.searchsorted(time, contact)), int(np.argmax(values[first]))
    reach = max(3, (top - at) // _NEAR)
    near = slice(max(0, at - reach), at + reach + 1)
    since = time[near] - contact
    # A parabola, as the motion may begin there; far outside the record, a line.
    outside = max(since[0], -since[-1]) > _OUTSIDE * (since[-1] - since[0])
    *_, speed, zero = np.polyfit(since, values[near], 1 if outside else 2)
    return float(zero), float(speed), 0.0 if level is None else level.sigma


def limits_of(
    name: str, measurement: Measurement, drive: str, duration: float, *, late: bool
) -> tuple[float, float]:
    """Return the limits of a nuisance parameter, SI.

    They follow from what the record shows (`shown_by`); a measured strain stays below one.
    """
    prior, middle = priors_of(measurement, drive).get(name), values_of(measurement)[name]
    rise = None if prior is not None else shown_by(measurement, drive, late=late).get(name)
    if prior is not None:
        reach = REACH * prior.sigma
        reach = min(reach, 0.9 * middle) if name in POSITIVE else reach
    elif rise is not None:
        reach = REACH_OF_RISE * rise.sigma
    elif name in POSITIVE:
        reach = 0.9 * middle
    elif name in ZEROS:
        values = measurement.channels().get(ZEROS[name])
        reach = 0.0 if values is None else LARGEST_ZERO * float(np.ptp(values))
    else:
        reach = (LARGEST_CONTACT if name == CONTACT_TIME else LARGEST_SHIFT) * duration
    at = middle if rise is None else rise.mean
    low, high = min(at - reach, middle), max(at + reach, middle)
    if name == "displacement_zero" and measurement.displacement is not None:
        least = float(measurement.displacement.max()) - LARGEST_STRAIN * measurement.specimen.height
        low = min(max(low, least), 0.0)
    return low, high
