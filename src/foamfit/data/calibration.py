"""Compare velocity, mass and calibration of an impact with its measured motion.

The motion of a rigid striker follows from its equation of motion, whatever the law of the specimen:
w = w₀ + v t + g t²/2 − (A/m) ∬σ. Fitted to the measured motion by least squares, it shows the
velocity v at contact, and the factor of the double integral, which is 1 if mass, force and motion
agree. The zero of the force and its delay against the motion are left open. An onsite damper of the
striker, whose force the sensor at the base does not see, adds -(η A/(H m)) ∫(w - w(0)); it is
assumed where it alone makes all numbers agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import GRAVITY, INTEGRATED, Entry, Measurement, is_clipped
from foamfit.data.noise import integrated_twice, residual_time, with_noise
from foamfit.text import engineering, percent, rounded, times

# Two numbers contradict each other if they differ by more than this many standard deviations. A
# number without a ± has one of this share, so the limit is 3 % if no ± is stated.
BEYOND, UNSTATED = 3.0, 0.01
# Standard deviation of the zero of the force, as a share of its peak, and of the delay between
# force and motion, as a share of the time under load.
ZERO, DELAY = 0.01, 0.1
MATTERS = 0.01  # relative gain of velocity in a fall above which gravity must be known
AGREES = 2.0  # standard errors within which an acceleration is that of gravity, or none
TENTH = 0.1  # of the limit: to this share a number in a line of the TOML is rounded
LATE = 4.0  # standard errors of a delay beyond which the clocks of force and motion disagree
_LOADED = 0.05  # largest stress at the first sample, as a share of the peak, if it is at contact
_FEWEST = 12  # samples of the motion
_ROUNDS = 3  # fits, each with the scatter left by the one before

Shown = tuple[float, float]  # a number that a record shows, and its standard error


@dataclass(frozen=True)
class Balance:
    """What the equation of motion of the striker shows; None if it does not show a number.

    `velocity` is that at contact, m/s; `force` is the factor by which the measured force must be
    multiplied, 1 if mass, force and motion agree; `delay` is that of the motion against the force,
    s; `damping` is the η of an onsite damper of the striker, Pa s; `scatter` is the standard
    deviation of the motion about the fit, m; `gravity` is the striker's acceleration by gravity,
    m/s², if that is not known.
    """

    velocity: Shown | None = None
    force: Shown | None = None
    delay: Shown | None = None
    damping: Shown | None = None
    scatter: float = 0.0
    gravity: Shown | None = None


@dataclass(frozen=True)
class Contradiction:
    """A number that the record contradicts; a clause `says` what contradicts what.

    `ratio` is the number that the record shows over the number in use, `limit` the largest
    difference of this ratio from 1 of numbers that agree. Of a time shift, they are the delay of
    the motion against the force, s, and the largest one that may be noise of the record. `lines`
    are tables and lines of the TOML, each of which would settle it, the likelier one first.
    """

    quantity: str  #: "velocity", "force_scale", "motion_scale" or "time_shift"
    ratio: float
    limit: float
    says: str
    lines: tuple[tuple[str, str], ...]

    def is_settled(self, vary: Iterable[str]) -> bool:
        """Return whether it is settled by fitting these parameters."""
        free, strong = set(vary), {"force_scale", "striker_mass"}
        if self.quantity in ("velocity", "time_shift"):
            return self.quantity in free
        return bool(free & strong) and (self.quantity == "force_scale" or "velocity" in free)


def contradictions(test: Measurement, shown: Balance | None = None) -> tuple[Contradiction, ...]:
    """Return the numbers that a record contradicts, the velocity first; `shown`: its `balance`."""
    shown = balance(test) if shown is None else shown
    found = _of_striker(test, shown)
    if shown.delay is not None and test.time is not None:
        (late, error), stated = shown.delay, test.uncertainties.get("delay", 0.0)
        limit = max(LATE * error, float(np.median(np.diff(test.time))))
        if abs(late) > max(limit, LATE * math.hypot(error, stated)):
            says = f"the motion is {'late' if late > 0.0 else 'early'} against the force by "
            says += engineering(abs(late), "s", error)
            found.append(Contradiction("time_shift", late, limit, says, ()))
    return tuple(found)


def _of_striker(test: Measurement, shown: Balance) -> list[Contradiction]:
    """Return the contradictions of velocity, mass and scales of force and motion."""
    striker, found = test.striker, list[Contradiction]()
    if striker is None or not striker.velocity or not striker.mass:
        return []
    if shown.velocity is not None:
        speed, error = shown.velocity
        ratio, limit = speed / striker.velocity, _limit(test, error / striker.velocity, "velocity")
        if abs(ratio - 1.0) > limit:
            line = f'velocity = "{rounded(speed, TENTH * limit)} m/s"'
            when = "before" if test.flight else "at"
            says = f"the velocity is given as {striker.velocity:.4g} m/s, the striker moves at "
            says += f"{speed:.4g} ± {error:.2g} m/s {when} contact"
            found.append(Contradiction("velocity", ratio, limit, says, (("striker", line),)))
    if shown.force is not None:
        ratio, limit = shown.force[0], _limit(test, shown.force[1], "striker_mass", "stress_scale")
        if abs(ratio - 1.0) > limit:
            found.append(_of_force(test, ratio, limit, striker.mass))
    # If the motion is too fast and too long by one factor, its scale alone may be wrong.
    if len(found) == 2 and abs(found[0].ratio / found[1].ratio - 1.0) < found[1].limit:
        ratio, limit = found[1].ratio, found[1].limit
        says = f"the motion is {times(ratio)} times as large as mass, velocity and force imply"
        entry = test.entries.get("displacement", Entry("displacement"))
        lines = ((entry.table, entry.times(1.0 / ratio, TENTH * limit)),)
        return [Contradiction("motion_scale", 1.0 / ratio, limit, says, lines)]
    return found


def _limit(test: Measurement, error: float, *quantities: str) -> float:
    """Return the largest relative difference of these quantities from a motion that agrees."""
    striker, stated = test.striker, test.uncertainties
    sizes = {"velocity": striker and striker.velocity, "striker_mass": striker and striker.mass}
    spreads = [stated.get(name, 0.0) / (sizes.get(name) or 1.0) for name in quantities]
    more = stated.get("displacement_scale", stated.get("velocity_scale", 0.0))
    return BEYOND * math.hypot(error, 0.0 if all(spreads) else UNSTATED, more, *spreads)


def _of_force(test: Measurement, ratio: float, limit: float, mass: float) -> Contradiction:
    """Return the contradiction between mass, scale of the force and motion."""
    what = "acceleration" if test.braked else "force"
    says = f"the impulse of the {what} is {times(1.0 / ratio)} of the change of momentum in the "
    says += f"motion, so {'' if test.braked else 'mass, '}scale of the {what} and motion disagree"
    entry = test.entries.get("stress", Entry(what))
    lines = [(entry.table, entry.times(ratio, TENTH * limit))]
    if not test.braked:  # otherwise the mass cancels
        lines.append(("striker", f'mass = "{engineering(1e3 * mass / ratio, "g")}"'))
        if test.uncertainties.keys() & {"stress_scale", "striker_mass"} == {"stress_scale"}:
            lines.reverse()  # the mass is the number without a ±
    return Contradiction("force_scale", ratio, limit, says, tuple(lines))


def balance(test: Measurement) -> Balance:
    """Return what the equation of motion of the striker shows in an impact."""
    striker, w, stress, time = test.striker, test.displacement, test.stress, test.time
    if striker is None or w is None or time is None:
        return Balance()
    if not (striker.mass and striker.velocity) or test.motion == INTEGRATED:
        return Balance()
    integrated = "displacement" in test.derived  # from the acceleration, with the stated velocity
    still = float(stress.max()) <= 0.0 or float(np.ptp(w)) <= 0.0
    if is_clipped(test) or (test.braked and integrated) or still:
        return Balance(test.flight)
    given = with_noise(test), striker.mass, w, stress, time
    fitted = _fitted(*given)
    if fitted is None:
        return Balance(test.flight)
    begins = test.flight is not None or stress[0] <= _LOADED * float(stress.max())
    velocity, derived = fitted.velocity if begins and not integrated else None, test.derived
    if "stress" in derived:
        return Balance(velocity, None)
    found, damped = fitted, _fitted(*given, damped=True)
    if damped is not None and damped.damping is not None and not contradictions(test, damped):
        (size, error), closer = damped.damping, damped.scatter <= 0.5 * fitted.scatter
        if size > BEYOND * error and (closer or contradictions(test, fitted)):
            found = damped
    return found if velocity is not None else Balance(force=found.force, damping=found.damping)


def with_gravity(test: Measurement) -> Measurement:
    """Decide by force and motion whether the striker falls, if neither TOML nor flight says it."""
    striker, time = test.striker, test.time
    if striker is None or time is None or striker.gravity is not None or not striker.velocity:
        return test
    if (share := GRAVITY * float(time[-1]) / striker.velocity) <= MATTERS:
        return test
    shown = balance(test)
    value, error = shown.gravity or (0.0, math.inf)
    falls, flies = (abs(value - one) <= AGREES * error for one in (GRAVITY, 0.0))
    if falls != flies and 2.0 * AGREES * error <= GRAVITY and not contradictions(test, shown):
        does, taken = ("falls", GRAVITY) if falls else ("does not fall", 0.0)
        note = f"Force and motion show that the striker {does}: gravity accelerates it by "
        note += f"{value:.2g} ± {error:.1g} m/s². The fit takes {taken:g} m/s²."
        striker = replace(striker, gravity=taken)
    else:
        note = f"Check: a falling striker gains {percent(share)} of its velocity over the contact, "
        note += "but the record does not show whether this one falls; write gravity = true or "
        note += "false under [striker]."
    return replace(test, striker=striker, notes=(*test.notes, note))


def _fitted(
    test: Measurement, mass: float, w: Array, stress: Array, time: Array, *, damped: bool = False
) -> Balance | None:
    """Fit the equation of motion, of a `damped` striker with an onsite damper."""
    kept = test.sampled.get("displacement", np.ones(time.size, dtype=bool))
    if (outliers := test.outliers.get("displacement")) is not None:
        kept = kept & ~outliers.left_out
    per_mass, gravity = test.specimen.area / mass, test.striker and test.striker.gravity
    lead = [0.0] * int(time[0] > 0.0)  # from time zero on, the stress rises from zero
    whole = np.append(lead, time), np.append([0.0] * len(lead), stress * per_mass)
    integrals = [part[len(lead) :] for part in integrated_twice(*whole)]
    slipped = np.where(time > 0.0, w - np.interp(0.0, time, w), 0.0) / test.specimen.height
    damper = -per_mass * integrated_twice(time, slipped)[0]
    # Priors of the zero of the force, which acts like an unknown gravity, and of the delay.
    peak, loaded = float(stress.max()), float(np.ptp(time[stress > 0.02 * stress.max()]))
    zero = max(min(test.zeros.get("stress", np.inf), ZERO * peak), 1e-6 * peak) * per_mass
    known = [] if test.flight is None else [(1, *test.flight)]
    known.append((3, 0.0, math.hypot(zero, GRAVITY if gravity is None else 0.0)))
    late, most = 0.0, math.hypot(test.uncertainties.get("delay", 0.0), DELAY * loaded)
    noise, of_force = test.noise.of("displacement"), test.noise.of("stress")
    assert noise is not None
    assert of_force is not None
    scatter, steps = max(noise.sigma, 1e-9 * float(np.ptp(w))), noise.time
    for _ in range(_ROUNDS):
        rows = kept & (time - late <= time[-1])  # the force there is in the record
        if np.count_nonzero(rows) < _FEWEST:
            return None
        t = time[rows]
        slowed, braked = (np.interp(t - late, time, part) for part in integrals)
        columns = np.column_stack([np.ones(t.size), t, -braked, 0.5 * t**2, slowed, damper[rows]])
        columns = columns if damped else columns[:, :-1]
        y, priors = w[rows] - 0.5 * (gravity or 0.0) * t**2, [*known, (4, -late, most)]
        found, errors = _solved(columns, y, scatter * math.sqrt(steps), priors)
        if found[2] <= 0.0:
            return None
        left, late = y - columns @ found, late + float(found[4] / found[2])
        rms = math.sqrt(left @ left / max(left.size - found.size, 1))
        scatter, steps = max(scatter, rms), max(steps, residual_time(left))
    # The inertia of the specimen, and the noise of the force, which the integral sums up.
    inertia = 0.5 * (test.specimen.mass or 0.0) / mass
    summed = of_force.sigma * math.sqrt(of_force.time / time.size) / float(stress.mean())
    speed, factor = found[1:3].tolist()
    error = math.hypot(errors[1], inertia * speed)
    force = factor, math.hypot(errors[2], inertia, summed)
    damping = (float(found[5]), float(errors[5])) if damped else None
    delay = late, float(errors[4]) / factor
    fall = (float(found[3]), math.hypot(errors[3], zero)) if gravity is None else None
    return Balance((speed, error), force, delay, damping, scatter, fall)


def _solved(
    columns: Array, y: Array, scatter: float, known: list[tuple[int, float, float]]
) -> tuple[Array, Array]:
    """Return the coefficients of the columns and their standard errors.

    `scatter` is the standard deviation of y; `known` are index, mean and standard deviation of
    coefficients with a prior.
    """
    rows = np.zeros((len(known), columns.shape[1]))
    for row, (at, _, sigma) in zip(rows, known, strict=True):
        row[at] = 1.0 / sigma
    matrix = np.concatenate([columns / scatter, rows])
    right = np.append(y / scatter, [mean / sigma for _, mean, sigma in known])
    sizes = np.linalg.norm(matrix, axis=0)
    sizes[sizes == 0.0] = 1.0
    inverse = np.linalg.pinv(matrix / sizes)
    return inverse @ right / sizes, np.linalg.norm(inverse, axis=1) / sizes
