"""What a test gives an objective: its drive, the curves to compare, and when they are simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.linalg import lstsq
from scipy.ndimage import convolve1d

from foamfit.arrays import Array
from foamfit.data.measurement import INTEGRATED, Measurement, interior_channel
from foamfit.data.motion import SmoothMotion, follow
from foamfit.errors import InputError
from foamfit.solve.scene import Motion
from foamfit.springs.model import Model

# Those of every objective, besides displacement_1_time … where masses inside were followed.
CURVES = ("stress_time", "displacement_time", "stress_strain")
# Of an impact whose striker carries an accelerometer and whose displacement was not measured.
ACCELERATION = "acceleration_time"
# Those that need a motion.
MOTION_CURVES = ("displacement_time", "stress_strain")
DRIVES = ("impact", "stress", "displacement")
# Noise of a motion, over its range, that counts as none; most that a smooth motion may leave of the
# samples, over their noise.
EXACT, FOLLOWED = 1e-6, 1.5
# Gaps between samples by which the first may lie after contact, for it to be simulated from there.
LATEST = 50.0


def choose_drive(measurement: Measurement) -> str:
    """Choose the drive: impact if striker and time are known, else displacement.

    Raises InputError if the test has neither.
    """
    striker = measurement.striker
    moving = striker is not None and striker.mass is not None and striker.velocity
    if moving and measurement.time is not None:
        return "impact"
    if measurement.displacement is not None:
        return "displacement"
    raise InputError(
        f"{measurement.name}: no drive is possible; give a displacement or strain column, "
        "or time and a [striker] with mass and velocity"
    )


def check_drive(measurement: Measurement, drive: str) -> None:
    """Refuse a drive that the test cannot feed (InputError, naming what is missing)."""
    if drive not in DRIVES:
        raise InputError(f"drive '{drive}' is unknown; it must be one of {', '.join(DRIVES)}")
    striker, impact = measurement.striker, drive == "impact"
    needed = {
        "a force or stress column": measurement.stress is not None,
        "a time column": not impact or measurement.time is not None,
        "[striker] mass": not impact or (striker is not None and striker.mass is not None),
        "[striker] velocity greater than zero": not impact or (striker and striker.velocity),
        "a displacement or strain column": impact or measurement.displacement is not None,
    }
    if missing := [what for what, there in needed.items() if not there]:
        raise InputError(f"{measurement.name}: the {drive} drive needs {' and '.join(missing)}")
    force = measurement.outliers.get("stress")
    if drive == "stress" and force is not None and force.clipped_at is not None:
        raise InputError(
            f"{measurement.name}: the force is clipped, so it cannot drive the specimen; choose "
            "the displacement or the impact drive"
        )


def interior_curves(measurement: Measurement, springs: int) -> dict[str, int]:
    """Curves of the masses inside a chain whose motion was measured, and their node."""
    nodes = sorted(node for node in measurement.interior if node < springs)
    return {f"{interior_channel(node)}_time": node for node in nodes}


def check_interior(measurement: Measurement, springs: int) -> None:
    """Refuse the displacement of a mass that is not inside the chain (InputError).

    A single spring has nothing inside; the result's notes say so.
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
    """Weights of all curves; those that are not given are zero."""
    for name, weight in weights.items():
        if name not in curves or not isinstance(weight, Real) or not 0 <= weight < np.inf:
            raise InputError(
                f"weights: '{name}' = {weight} is not admissible; give {', '.join(curves)} a "
                "weight of zero or more"
            )
    return dict.fromkeys(curves, 0.0) | dict(weights)


def default_weights(measurement: Measurement, drive: str, springs: int = 1) -> dict[str, float]:
    """Weights that count each measured channel once.

    In the impact drive stress and displacement are compared in time; a displacement that was
    integrated from the force is not a second measurement. In the displacement drive the only curve
    is the stress along the measured displacement, in the stress drive the displacement.
    Displacements of masses inside count in all drives: they tell the springs apart.
    """
    weights = dict.fromkeys(CURVES, 0.0)
    weights |= dict.fromkeys(interior_curves(measurement, springs), 1.0)
    if drive == "impact":
        weights["stress_time"] = float("stress" not in measurement.derived)
        moved = measurement.displacement is not None and measurement.motion != INTEGRATED
        weights["displacement_time"] = float(moved and "displacement" not in measurement.derived)
        if measurement.acceleration is not None:
            weights[ACCELERATION] = 1.0
    elif drive == "stress":
        weights["displacement_time"] = 1.0
    else:
        weights["stress_strain"] = 1.0
    return weights


def smoothed(values: Array, window: int) -> Array:
    """Smooth samples by the parabola through each (odd) window of them (Savitzky & Golay 1964).

    Analytical Chemistry 36, 1627; as `scipy.signal.savgol_filter`, whose package takes longer to
    import than a search. The first and the last half of a window lie on its parabola.
    """
    half, clock = window // 2, np.arange(float(window))
    weights, *_ = lstsq(np.vander(half - clock, 3, increasing=True).T, np.array([1.0, 0.0, 0.0]))
    out = convolve1d(values, weights, mode="constant")
    for edge, part in ((slice(half), slice(window)), (slice(-half, None), slice(-window, None))):
        out[edge] = np.polyval(np.polyfit(clock, values[part], 2), clock[edge])
    return np.asarray(out)


def driving_stress(stress: Array, model: Model) -> Array:
    """Smooth a measured stress (Pa) that is to drive a model.

    The noise of a driving stress is taken for stress that acted, and biases the soft branches
    (errors in variables): a parabola over a twenty-fifth of the samples takes it off. A chain with
    a unilateral spring carries no tension.
    """
    window = 2 * (stress.size // 50) + 1
    smooth = smoothed(stress, window) if window > 3 else stress
    return np.maximum(smooth, 0.0) if "unilateral" in model.kinds else smooth


def driving_motion(
    measurement: Measurement, time: Array, *, always: bool = False
) -> SmoothMotion | None:
    """The measured motion without its noise; None where its samples say all, or are not there.

    An exact motion that turns sharply between samples went further than they say. Where a noisy one
    leaves the samples more than their noise the machine's motion is not that smooth: the samples
    themselves are the better motion, unless it is to be smooth `always`. `time` (n,) is that of the
    samples, s.
    """
    values, level = measurement.displacement, measurement.noise.of("displacement")
    if values is None or level is None:
        return None
    counts = measurement.sampled.get("displacement")
    found = follow(time, values, level, counts)
    if level.sigma <= EXACT * float(np.ptp(values)):
        beside = np.abs(found.turns[:, None] - time).min(axis=1, initial=np.inf)
        return found if np.any(beside > 1e-6 * float(np.median(np.diff(time)))) else None
    if measurement.block > 1 and found.turns.size:
        # The mean of rows on either side of a turn lies off the motion.
        gap = float(np.median(np.diff(time)))
        apart = np.abs(time[:, None] - found.turns).min(axis=1) > 0.75 * gap
        counts = apart if counts is None else counts & apart
        found = follow(time, values, level, counts)
    return found if always or found.sigma <= FOLLOWED * level.sigma else None


def moved_at(instants: Array, time: Array, values: Array, motion: SmoothMotion | None) -> Array:
    """A measured motion (m) at some instants, straight on before its first sample."""
    if motion is not None:
        return motion.at(instants)
    before = np.minimum(instants - time[0], 0.0) / (time[1] - time[0])
    return np.asarray(np.interp(instants, time, values) + before * (values[1] - values[0]))


def driven_instants(measurement: Measurement, clock: Array, motion: SmoothMotion | None) -> Array:
    """Instants to simulate: those of the samples, turns between them, and the contact.

    How far a motion goes where it turns is what springs remember. Where the first sample lies a
    little after the contact the springs start there without strain: what they carry at the first
    sample relaxes already.
    """
    more = [] if motion is None else motion.turns.tolist()
    values = measurement.displacement
    if values is not None and measurement.contact != "file" and not measurement.start_strain:
        time = clock if measurement.time is None else measurement.time
        (at, then), (first, second) = clock[:2], moved_at(clock[:2], time, values, motion)
        late = first / (second - first) if second > first else -1.0
        more += [at - late * (then - at)] if 0.0 < late < LATEST else []
    return np.union1d(clock, more) if more else clock


def without_tension(motion: Motion) -> Motion:
    """The run of a specimen that is not fixed to the platen: where it would pull, it bears none.

    It has lost contact there; what it remembers follows the platen on.
    """
    lost = motion.base_stress < 0.0
    if not lost.any():
        return motion
    slopes = motion.slopes
    if slopes is not None:
        slopes = slopes._replace(base_stress=np.where(lost, 0.0, slopes.base_stress))
    return motion._replace(base_stress=np.where(lost, 0.0, motion.base_stress), slopes=slopes)


def later(time: Array, curves: Array, late: float) -> Array:
    """Curves (…, n) seen `late` seconds later, at the samples; straight past their ends."""
    return np.asarray(make_interp_spline(time, curves, k=1, axis=-1)(time - late))


def instants(time: Array, fine: int) -> Array:
    """Instants that each sample averages: so many, evenly spread over its share of the clock."""
    if fine == 1:
        return time
    gaps = np.diff(time)
    widths = np.minimum(np.append(gaps, gaps[-1]), np.append(gaps[0], gaps))
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    return np.asarray((time[:, None] + widths[:, None] * offsets).ravel())


def check_time_shift(measurement: Measurement, drive: str) -> None:
    """Refuse a time shift where the test has no two channels in time (InputError)."""
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
