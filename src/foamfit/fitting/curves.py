"""Drives, measured curves and simulated instants of a test."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from numbers import Real

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.signal import savgol_filter

from foamfit.arrays import Array
from foamfit.data.calibration import contradictions
from foamfit.data.measurement import INTEGRATED, Measurement, interior_channel, is_clipped
from foamfit.data.motion import SmoothMotion, follow
from foamfit.data.noise import EXACT, TENSION, lowest_mean, residual_noise
from foamfit.errors import InputError
from foamfit.options import DRIVES
from foamfit.solve.plan import Motion
from foamfit.springs.model import Model

# Curves of every test; tests with measured interior masses add displacement_1_time, ….
CURVES = ("stress_time", "displacement_time", "stress_strain")
# Curve of an impact with an accelerometer on the striker and no measured displacement.
ACCELERATION = "acceleration_time"
MOTION_CURVES = ("displacement_time", "stress_strain")  # curves that need a motion
FOLLOWED = 1.5  # a smooth motion is used if its residuals are at most this multiple of the noise
LOADED = 0.01  # share of the peak stress from which there certainly is load
# Largest time between contact and the first sample, in sampling intervals, for which the simulation
# starts at the contact.
LATEST = 50.0


def choose_drive(measurement: Measurement, vary: Iterable[str] = ()) -> str:
    """Return "impact" if striker and time are known, else "displacement".

    A measured displacement also drives an impact whose record contradicts velocity, mass or scale
    of the force, unless these are among the parameters to `vary`. Raises InputError if no drive is
    possible.
    """
    striker = measurement.striker
    moving = striker is not None and striker.mass is not None and striker.velocity
    if moving and measurement.time is not None and not replaces_striker(measurement, vary):
        return "impact"
    if measurement.displacement is not None:
        return "displacement"
    raise InputError(
        f"{measurement.name}: no drive is possible; give a displacement or strain column, "
        "or time and a [striker] with mass and velocity"
    )


def replaces_striker(measurement: Measurement, vary: Iterable[str] = ()) -> bool:
    """Return whether the measured motion drives an impact, as its record contradicts the striker.

    The contradiction may also be settled by parameters to `vary`.
    """
    if measurement.displacement is None or "displacement" in measurement.derived:
        return False
    varied = set(vary)
    found = [one for one in contradictions(measurement) if one.quantity != "time_shift"]
    return any(not one.is_settled(varied) for one in found)


def check_drive(measurement: Measurement, drive: str) -> None:
    """Raise InputError if the test lacks the data for a drive; the message names them."""
    if drive not in DRIVES:
        raise InputError(f"drive '{drive}' is unknown; it must be one of {', '.join(DRIVES)}")
    striker, impact = measurement.striker, drive == "impact"
    needed = {
        "a time column": not impact or measurement.time is not None,
        "[striker] mass": not impact or (striker is not None and striker.mass is not None),
        "[striker] velocity greater than zero": not impact or (striker and striker.velocity),
        "a displacement or strain column": impact or measurement.displacement is not None,
    }
    if missing := [what for what, there in needed.items() if not there]:
        raise InputError(f"{measurement.name}: the {drive} drive needs {' and '.join(missing)}")
    if drive == "stress" and is_clipped(measurement):
        raise InputError(
            f"{measurement.name}: the force is clipped, so it cannot drive the specimen; choose "
            "the displacement or the impact drive"
        )


def interior_curves(measurement: Measurement, springs: int) -> dict[str, int]:
    """Return the curves of interior masses whose motion was measured, and their nodes."""
    nodes = sorted(node for node in measurement.interior if node < springs)
    return {f"{interior_channel(node)}_time": node for node in nodes}


def check_interior(measurement: Measurement, springs: int) -> None:
    """Raise InputError for the displacement of a mass that is not inside the chain.

    A single spring has no interior mass; the notes of the result say so.
    """
    wrong = min((node for node in measurement.interior if node >= springs), default=0)
    if wrong and springs > 1:
        raise InputError(
            f"{measurement.name}: {interior_channel(wrong)} is not a mass inside a chain of "
            f"{springs} springs: node {springs} of a {springs}-spring chain is the top, which is "
            "the 'displacement' column; take a model of more springs, or rename or leave out that "
            "column"
        )


def checked_weights(weights: Mapping[str, float], curves: Sequence[str]) -> dict[str, float]:
    """Return the weights of all curves; missing weights are zero."""
    for name, weight in weights.items():
        if name not in curves or not isinstance(weight, Real) or not 0 <= weight < np.inf:
            raise InputError(
                f"weights: '{name}' = {weight} is not admissible; give {', '.join(curves)} a "
                "weight of zero or more"
            )
    return dict.fromkeys(curves, 0.0) | dict(weights)


def default_weights(measurement: Measurement, drive: str, springs: int = 1) -> dict[str, float]:
    """Return weights that count each measured channel once.

    In the impact drive stress and displacement are compared in time; a displacement integrated from
    the force is not a second measurement. The displacement drive compares the stress along the
    measured displacement, the stress drive the displacement. Displacements of interior masses count
    in all drives, because they distinguish the springs.
    """
    weights = dict.fromkeys(CURVES, 0.0)
    weights |= dict.fromkeys(interior_curves(measurement, springs), 1.0)
    if drive != "impact":
        return weights | {"displacement_time" if drive == "stress" else "stress_strain": 1.0}
    moved = measurement.displacement is not None and measurement.motion != INTEGRATED
    weights["stress_time"] = float("stress" not in measurement.derived)
    weights["displacement_time"] = float(moved and "displacement" not in measurement.derived)
    if measurement.acceleration is not None:
        weights[ACCELERATION] = 1.0
    return weights


def smooth_stress(measurement: Measurement, time: Array) -> SmoothMotion | None:
    """Return the measured stress without its noise, Pa; None if the samples are to be used.

    The pulse of an impact has kinks that a spline takes for noise; see `driving_stress`.
    """
    stress, level = measurement.stress, measurement.noise.of("stress")
    if measurement.striker is not None or level is None or level.sigma <= EXACT * np.ptp(stress):
        return None
    found = follow(time, stress, level, measurement.sampled.get("stress"))
    return found if found.sigma <= FOLLOWED * level.sigma else None


def driving_stress(
    measurement: Measurement, model: Model, time: Array, smooth: SmoothMotion | None
) -> Array:
    """Return the stress (Pa) of a test that drives a model; it is zero before contact.

    Noise of a driving stress biases the soft branches (errors in variables), so that it is removed
    as that of a driving motion: that of the pulse of an impact by a moving parabola over a
    twenty-fifth of the samples, which loading and unloading have of their own, as one across the
    peak would cut it off. Chains with a unilateral spring carry no tension.
    """
    stress, begins = measurement.stress, (measurement.rise or (0.0, 0.0))[0]
    if measurement.striker is not None:
        window, first = 2 * (stress.size // 50) + 1, int(np.searchsorted(time, begins))
        top = first + int(np.argmax(stress[first:]))
        parts = [stress[:first], stress[first:top], stress[top:]]
        stress = np.concatenate(
            [savgol_filter(own, window, 2) if own.size > window > 3 else own for own in parts]
        )
    elif smooth is not None:
        stress = smooth.at(time)
    stress = np.where(time < begins, 0.0, stress)
    return np.maximum(stress, 0.0) if "unilateral" in model.kinds else stress


def history(measurement: Measurement, model: Model) -> tuple[Array, Array] | None:
    """Return times and motion of the cycles before, which a stress that relaxes remembers."""
    return measurement.before if model.relaxation else None


def shows_motion(stress: Array) -> NDArray[np.bool_]:
    """Return in which samples a driving stress shows the motion: from contact to its end."""
    loaded = np.flatnonzero(stress > LOADED * stress.max())
    rows = np.arange(stress.size)
    return np.asarray((np.cumsum(stress != 0.0) > 0) & (rows <= loaded[-1]))


def is_exact(measurement: Measurement) -> bool:
    """Return whether the motion of a test has no noise."""
    values, level = measurement.displacement, measurement.noise.of("displacement")
    return values is None or level is None or level.sigma <= EXACT * float(np.ptp(values))


def driving_motion(
    measurement: Measurement, time: Array, *, always: bool = False
) -> SmoothMotion | None:
    """Return the measured motion without its noise; None if the samples are to be used.

    An exact motion with a sharp turn between samples has gone farther than the samples show. If the
    residuals of a noisy motion exceed its noise, the true motion is not that smooth and the samples
    are the better description, unless `always` is set. `time` (n,) is that of the samples, s.
    """
    values, level = measurement.displacement, measurement.noise.of("displacement")
    if values is None or level is None:
        return None
    counts = measurement.sampled.get("displacement")
    found = follow(time, values, level, counts)
    if is_exact(measurement):
        beside = np.abs(found.turns[:, None] - time).min(axis=1, initial=np.inf)
        return found if np.any(beside > 1e-6 * float(np.median(np.diff(time)))) else None
    if measurement.block > 1 and found.turns.size:
        # A mean over rows on both sides of a turn does not lie on the motion.
        gap = float(np.median(np.diff(time)))
        apart = np.abs(time[:, None] - found.turns).min(axis=1) > 0.75 * gap
        counts = apart if counts is None else counts & apart
        found = follow(time, values, level, counts)
    noise = level.sigma if level.given else max(level.sigma, residual_noise(values)[0])
    return found if always or found.sigma <= FOLLOWED * noise else None


def moved_at(instants: Array, time: Array, values: Array, motion: SmoothMotion | None) -> Array:
    """Return the motion (m) at some instants; linear extrapolation before the first sample."""
    if motion is not None:
        return motion.at(instants)
    before = np.minimum(instants - time[0], 0.0) / (time[1] - time[0])
    return np.asarray(np.interp(instants, time, values) + before * (values[1] - values[0]))


def driven_instants(measurement: Measurement, clock: Array, motion: SmoothMotion | None) -> Array:
    """Return the instants to simulate: the samples, the turns between them, and the contact.

    Springs remember the largest motion, which is reached at a turn. If the first sample lies
    shortly after the contact, the simulation starts at the contact with zero strain, because the
    stress has already relaxed at the first sample.
    """
    more = [] if motion is None else motion.turns.tolist()
    values = measurement.displacement
    if values is not None and measurement.contact != "file" and not measurement.start_strain:
        time = measurement.instants
        (at, then), (first, second) = clock[:2], moved_at(clock[:2], time, values, motion)
        late = first / (second - first) if second > first else -1.0
        more += [at - late * (then - at)] if 0.0 < late < LATEST else []
    return np.union1d(clock, more) if more else clock


def is_glued(measurement: Measurement, *, leaves: bool) -> bool:
    """Return whether the specimen is glued to its platens: a slow record shows tension.

    A specimen that may have left the platen (`leaves`), or whose zero of the force is uncertain, is
    glued only if the tension is more than `TENSION` of the peak.
    """
    stress, level = measurement.stress, measurement.noise.of("stress")
    several = measurement.last_cycle is not None  # the first peak need not be the highest
    lowest, width = lowest_mean(stress, 0 if several else int(np.argmax(stress)))
    noise = 0.0 if level is None else 4.0 * level.sigma / math.sqrt(width)
    unknown = leaves or noise == 0.0 or stress[0] < -noise  # the zero may be off
    least = TENSION * float(stress.max()) if unknown else 0.0
    return lowest < -max(least, noise)


def without_tension(motion: Motion) -> Motion:
    """Return the run of a specimen that is not fixed to the platen: tension becomes zero.

    The specimen has lost contact there; its internal state still follows the platen.
    """
    lost = motion.base_stress < 0.0
    if not lost.any():
        return motion
    slopes = motion.slopes
    if slopes is not None:
        slopes = slopes._replace(base_stress=np.where(lost, 0.0, slopes.base_stress))
    return replace(motion, base_stress=np.where(lost, 0.0, motion.base_stress), slopes=slopes)


def later(time: Array, curves: Array, late: float) -> Array:
    """Return curves (…, n) delayed by `late` seconds; linear extrapolation past the ends."""
    return np.asarray(make_interp_spline(time, curves, k=1, axis=-1)(time - late))


def instants(time: Array, fine: int, most: float = np.inf) -> Array:
    """Return `fine` instants per sample, evenly spread over the interval that it averages.

    The interval is that between samples, `most` s at most.
    """
    if fine == 1:
        return time
    gaps = np.diff(time)
    widths = np.minimum(np.append(gaps, gaps[-1]), np.append(gaps[0], gaps)).clip(max=most)
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    return np.asarray((time[:, None] + widths[:, None] * offsets).ravel())


def check_time_shift(measurement: Measurement, drive: str) -> None:
    """Raise InputError if the test does not have two channels in time to shift."""
    if measurement.time is None:
        why = "it has no time"
    elif measurement.displacement is None or measurement.motion == INTEGRATED:
        why = "its motion is not measured apart from the force"
    else:
        return
    raise InputError(
        f"{measurement.name}: a time shift between force and motion cannot be fitted in the "
        f"{drive} drive, {why}; both channels must be measured in time"
    )
