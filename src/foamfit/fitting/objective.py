"""The objective: weighted residuals between simulated and measured curves.

Curves are compared in time, or sample by sample along a history, never by interpolation across the
loop. Only curves with a weight above zero count, so that no measurement counts twice.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import INTEGRATED, Measurement, NoiseLevel
from foamfit.data.motion import SmoothMotion
from foamfit.data.noise import with_noise
from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.fitting import nuisance as nuisances
from foamfit.fitting.curves import (
    ACCELERATION,
    CURVES,
    MOTION_CURVES,
    check_drive,
    check_time_shift,
    checked_weights,
    driven_instants,
    driving_motion,
    driving_stress,
    instants,
    interior_curves,
    later,
    moved_at,
    without_tension,
)
from foamfit.fitting.weighing import Weighing
from foamfit.solve.plan import Motion, Plan
from foamfit.solve.plan import plan as make_plan
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.model import Model
from foamfit.springs.parameters import MOVED

# Curves of the measured stress, which is the simulated one over the scale of the force.
STRESSES = ("stress_time", "stress_strain")
# Residual after a failed simulation, as a multiple of the measured range.
PENALTY = 10.0
NOWHERE = np.empty(0, np.int64)
OF_DRIVE = ("those of the drive",)  # default of `Objective.nuisance`
# Lower limit of the estimated noise, as a fraction of the range of a channel. Fits of the bistable
# law to measured foams have misfits above 1 %: a smaller noise must not let one channel outweigh
# the other, as the residuals of both are then errors of the law.
MODEL_ERROR = 0.005
MAX_STEPS = 20_000  # a trial that needs more steps is too stiff and counts as failed
NORMAL = 1.4826  # standard deviation of normal residuals over their median absolute value
FINEST = 8  # most instants simulated per sample that averages rows of the file
# Steps of difference quotients: velocity and mass, relative; times, in sampling intervals; and the
# zero of a motion, as a fraction of its range.
RELATIVE_STEP, STEP_OF_TIME, STEP_OF_ZERO = 1e-3, 0.02, 1e-4


@dataclass(frozen=True, eq=False)
class Simulated:
    """The curves of one set of parameters, the simulated motion, and derivatives on request."""

    # By the names in `Objective.curves`, without those that the drive prescribes, the test lacks or
    # the residual does not need; stress_strain is the stress (Pa) along the measured displacement.
    curves: dict[str, Array]
    motion: Motion  # At the times of the samples if everything was requested
    slopes: dict[str, Array] | None = None  # Derivatives of each curve, (p, n)


def _with_slopes(motion: Motion, node: int | None = None) -> Array:
    """Return the base stress, or the displacement of a node, stacked on its derivatives."""

    def of(base_stress: Array, displacement: Array) -> Array:
        return base_stress if node is None else displacement[..., node, :]

    rows = of(motion.base_stress, motion.displacement)[None]
    if (slopes := motion.slopes) is None:
        return rows
    return np.concatenate([rows, of(slopes.base_stress, slopes.displacement)])


@dataclass(eq=False)
class Objective:
    """Residuals of a model under a drive against a measurement.

    `curves` are the names of all curves, `interior` maps those of interior masses to their node.
    """

    measurement: Measurement
    model: Model
    drive: str  # "impact", "stress" or "displacement"
    weights: dict[str, float]  # Factor of the squared residuals of each curve
    rtol: float = 1e-4  # Allowed error of the simulation; with its margin some 1e-7 of the range
    # Whether the mass of the specimen is distributed equally between the springs, as in the paper.
    interior_mass: bool = False
    time_shift: bool = False  # Whether the delay of the motion, s, is a nuisance parameter
    # Nuisance parameters at the end of the vector; by default those of the drive.
    nuisance: tuple[str, ...] = OF_DRIVE
    weighing: Weighing | None = None  # Effect of an uncertain driving motion; see `weigh_motion`
    given: tuple[nuisances.Prior, ...] = ()  # Priors of spring parameters
    followed: tuple[SmoothMotion | None, ...] = ()  # `motion`, if it is already known
    # Largest amplitude, in standard deviations, of the motion that would explain the residual
    unexplained: float | None = field(default=None, init=False)
    evaluations: int = field(default=0, init=False)  # Number of simulated sets of parameters
    failures: int = field(default=0, init=False)  # Number of failed simulations

    def __post_init__(self) -> None:
        """Prepare the scenes and the scale of each curve."""
        check_drive(self.measurement, self.drive)
        if self.time_shift:
            check_time_shift(self.measurement, self.drive)
        if self.nuisance == OF_DRIVE:
            self.nuisance = nuisances.names_of(self.drive, time_shift=self.time_shift)
        self.measurement = with_noise(self.measurement)
        self.interior = interior_curves(self.measurement, len(self.model.kinds))
        self.accelerated = self.drive == "impact" and self.measurement.acceleration is not None
        self.curves = (*CURVES, *((ACCELERATION,) if self.accelerated else ()), *self.interior)
        self.weights = checked_weights(self.weights, self.curves)
        self._dashpots = np.array([name.endswith("eta") for name in self.model.names])
        self._dashpots[-1] = False  # site_eta belongs to no spring
        time = self.measurement.time
        self.time = np.arange(self.stress.size, dtype=float) if time is None else time
        self._fine = min(self.measurement.block, FINEST) if self.drive != "stress" else 1
        self._clock, self._own = instants(self.time, self._fine), None
        if self._driven:
            own = self._clock
            self._clock = driven_instants(self.measurement, own, self.motion)
            self._own = np.searchsorted(self._clock, own) if self._clock.size > own.size else None
        driving = {"stress": ["stress_time"], "displacement": ["displacement_time"]}
        self._absent = driving.get(self.drive, []) + ["stress_time"] * (time is None)
        self.usual = nuisances.values_of(self.measurement)
        motion = self.measurement.displacement
        self._largest = 0.0 if motion is None else float(motion.max())  # m
        striker = self.measurement.striker
        self._gravity = (striker.gravity if striker else None) or 0.0
        self._plans = self._scenes(self._loading())
        self.measured = self._measured()
        self.counted = tuple(name for name in self.measured if self.weights[name] > 0)
        self._inside = any(name in self.interior for name in self.counted)
        if not self.counted:
            raise InputError(
                f"{self.measurement.name}: no curve is left to fit; give one that the "
                f"{self.drive} drive has a weight above zero"
            )
        least = {name: MODEL_ERROR * float(np.ptp(curve)) for name, curve in self.measured.items()}
        self.scale = {  # standard deviation of the noise; if estimated, at least `least`
            name: level.sigma if (level := self.noise(name)).given else max(level.sigma, floor)
            for name, floor in least.items()
        }
        self._kept = {name: self._fitted(name) for name in self.measured}
        self.sizes = tuple(self.kept(name).size for name in self.counted)
        self.n_data = sum(self.sizes)
        self.penalty = max(PENALTY * self.span(name) for name in self.counted)
        self._set_nuisance()

    @cached_property
    def motion(self) -> SmoothMotion | None:
        """The measured motion without its noise, or None; see `driving_motion`."""
        return self.followed[0] if self.followed else driving_motion(self.measurement, self.time)

    @cached_property
    def _moved(self) -> Array:
        """The measured motion at the simulated instants, m."""
        assert self.measurement.displacement is not None
        return moved_at(self._clock, self.time, self.measurement.displacement, self.motion)

    @cached_property
    def _along(self) -> dict[bool, Plan]:
        """Scenes of the springs along the measured motion; empty without a motion."""
        is_measured = self.measurement.displacement is not None
        return self._scenes(DisplacementDrive(self._moved)) if is_measured else {}

    def weigh_motion(self, values: Array) -> bool:
        """Weight the residuals by the uncertainty of the driving motion; False if it has none.

        `values` are the optimum of plain least squares; its residual, noise or error of the law,
        sets the level of each curve. If the motion cannot explain that residual, the law errs and
        the residuals stay unweighted.
        """
        uncertain = self.by_motion(values)
        if uncertain is None:
            return False
        plain = self.plain(values)
        levels = [
            max(NORMAL * float(np.median(part)), self.noise(name).sigma * self.factor(name), 1e-9)
            for name, part in self.by_curve(np.abs(plain)).items()
        ]
        weighing = Weighing.of(uncertain, np.repeat(levels, self.sizes))
        if not weighing.explains(plain):
            self.unexplained = float(np.abs(weighing.amplitudes(plain)).max())
            return False
        self.weighing = weighing
        return True

    def plain(self, values: Array) -> Array:
        """Return the residuals of the curves without priors and weighing, (n_data,)."""
        return self._moved_by(0.0).residual(values)[: self.n_data]

    def by_motion(self, values: Array) -> Array | None:
        """Return the change of the residual by each mode of the motion, (n_data, m), or None."""
        if not self._driven or self.motion is None:
            return None
        modes = self.motion.modes(self._clock)
        out = np.empty((self.n_data, modes.shape[1]))
        for column, mode in zip(out.T, modes.T, strict=True):
            sides = [self._moved_by(side * mode).residual(values) for side in (-0.5, 0.5)]
            column[:] = (sides[1] - sides[0])[: self.n_data]
        self.evaluations += 2 * modes.shape[1]
        return out

    def _moved_by(self, change: Array | float) -> Objective:
        """Return the objective with a changed driving motion and unweighted residuals."""
        other = copy(self)
        other.weighing = None
        other._plans = {
            damped: plan._replace(values=plan.values + change)
            for damped, plan in self._plans.items()
        }
        return other

    def _set_nuisance(self) -> None:
        """Prepare the zero of each curve, the steps of difference quotients, and the priors."""
        channels = {channel: zero for zero, channel in nuisances.ZEROS.items()}
        self._zero_of = {
            curve: zero
            for curve in self.curves
            if (zero := channels.get(self.channel(curve))) in self.nuisance
        }
        gap = float(np.median(np.diff(self._clock)))
        self._steps = dict.fromkeys(self.nuisance, STEP_OF_TIME * gap)
        self._steps |= {name: RELATIVE_STEP * self.usual[name] for name in nuisances.STRIKER}
        if self.measurement.displacement is not None:
            span = float(np.ptp(self.measurement.displacement))
            self._steps["displacement_zero"] = STEP_OF_ZERO * span
        known = nuisances.priors_of(self.measurement, self.drive)
        self.priors = (*self.given, *(known[name] for name in self.nuisance if name in known))
        names = (*self.model.names, *self.nuisance)
        self._prior_places = np.array([names.index(one.name) for one in self.priors], np.int64)

    @property
    def stress(self) -> Array:
        """Measured stress, Pa."""
        assert self.measurement.stress is not None  # checked by check_drive
        return self.measurement.stress

    def _loading(self) -> Drive:
        if self.drive == "impact":
            usual = self.usual
            return Impact(usual[nuisances.STRIKER_MASS], usual[nuisances.VELOCITY], self._gravity)
        if self.drive == "stress":
            return StressDrive(driving_stress(self.stress, self.model))
        return DisplacementDrive(self._moved)

    def _scenes(self, loading: Drive) -> dict[bool, Plan]:
        """Prepare scenes without and with dashpots; they do not depend on the spring parameters.

        Interior masses are included in impacts only; along a prescribed motion the springs are in
        equilibrium.
        """
        specimen, count = self.measurement.specimen, len(self.model.kinds)
        heights, masses = [specimen.height / count] * count, [0.0] * count
        if self.interior_mass and count > 1 and isinstance(loading, Impact):
            if specimen.mass is None:
                raise InputError(
                    f"{self.measurement.name}: interior masses need [specimen] mass, "
                    'like mass = "5.56 mg"'
                )
            masses = [specimen.mass / (count - 1)] * (count - 1) + [0.0]
        springs = [law.any_spring(self.model.relaxation) for law in self.model.laws]
        chain = Chain(springs, heights, specimen.area, masses)
        make = partial(make_plan, chain, loading, self._clock, max_steps=MAX_STEPS)
        relaxing = self.model.relaxation > 0
        return {damped: make(dashpots=damped, relaxing=relaxing) for damped in (False, True)}

    def _measured(self) -> dict[str, Array]:
        """Return the measured curves that the drive does not prescribe."""
        measured = {"stress_time": self.stress}
        if self.measurement.displacement is not None:
            measured["displacement_time"] = self.measurement.displacement
            measured["stress_strain"] = self.stress
        inside = self.measurement.interior
        measured |= {name: inside[node] for name, node in self.interior.items()}
        if self.accelerated:
            assert self.measurement.acceleration is not None
            measured[ACCELERATION] = self.measurement.acceleration
        return {name: curve for name, curve in measured.items() if name not in self._absent}

    def channel(self, name: str) -> str:
        """Return the channel that a curve is compared with."""
        own = name.startswith("displacement") or name == ACCELERATION
        return name.removesuffix("_time") if own else "stress"

    def noise(self, name: str) -> NoiseLevel:
        """Return the noise of a curve, stated or estimated."""
        level = self.measurement.noise.of(self.channel(name))
        assert level is not None  # completed by with_noise
        return level

    def _fitted(self, name: str) -> NDArray[np.intp]:
        """Return the indices of the samples that count: measured ones without outliers."""
        channel = self.channel(name)
        counts = self.measurement.sampled.get(channel, np.ones(self.time.size, dtype=bool))
        outliers = self.measurement.outliers.get(channel)
        return np.flatnonzero(counts if outliers is None else counts & ~outliers.left_out)

    # ------------------------------------------------------------------ simulation and residual

    def simulate(
        self, values: Array, *, everything: bool = False, places: NDArray[np.int64] = NOWHERE
    ) -> Simulated:
        """Simulate the counted curves, or all curves with `everything`.

        `places` are the indices of the parameters by which derivatives are returned. Raises
        SimulationError if the parameters are not admissible or the scene has no finite answer.
        """
        count = len(self.model.names)
        self.evaluations += 1
        try:
            with as_signalled():
                return self._seen(values[:count], values[count:], everything, places)
        except SimulationError:
            self.failures += 1
            raise

    def add_counts(self, other: Objective) -> None:
        """Add the evaluations and failures of another objective."""
        self.evaluations += other.evaluations
        self.failures += other.failures

    def _seen(
        self, values: Array, nuisance: Array, everything: bool, places: NDArray[np.int64]
    ) -> Simulated:
        """Return the curves in the readings of the channels, with all derivatives."""
        own = places < values.size
        if own.all():
            return self._curves(values, nuisance, everything, places)
        zero, named = "displacement_zero", [self.nuisance[p - values.size] for p in places[~own]]
        still = not self._is_damped(values, places[own])
        moved = zero in named and still and self._plans[False].moves_one
        curves = self._curves(values, nuisance, everything, places[own], moved=moved)
        carried, n = curves.slopes or {}, self.time.size
        slopes = {name: np.empty((places.size, n)) for name in curves.curves}
        for curve, rows in carried.items():
            slopes[curve][own] = rows[: np.count_nonzero(own)]
        for at, name in zip(np.flatnonzero(~own), named, strict=True):
            if moved and name == zero:  # a larger zero means a smaller motion
                by = {curve: -rows[-1] for curve, rows in carried.items()}
            elif name == nuisances.FORCE_SCALE:
                by = self._scale_slope(curves.curves, nuisance)
            else:
                by = self._nuisance_slope(values, nuisance, name)
            for curve, rows in slopes.items():
                rows[at] = by[curve]
        return replace(curves, slopes=slopes)

    def _is_damped(self, values: Array, places: NDArray[np.int64]) -> bool:
        """Return whether a spring has a dashpot, or a derivative by one is requested."""
        eta = self._dashpots
        return bool(values[: eta.size][eta].any() or eta[places].any())

    def _scale_slope(self, curves: dict[str, Array], nuisance: Array) -> dict[str, Array]:
        """Return the derivative of the curves by the scale of the force."""
        at = dict(zip(self.nuisance, nuisance.tolist(), strict=True))
        return {
            name: (at.get(self._zero_of.get(name, ""), 0.0) - curve) / at[nuisances.FORCE_SCALE]
            if name in STRESSES
            else np.zeros(curve.size)
            for name, curve in curves.items()
        }

    def _nuisance_slope(self, values: Array, nuisance: Array, name: str) -> dict[str, Array]:
        """Return the derivative of the curves by one nuisance parameter.

        The zero of a channel is simply added to it. Other derivatives are central difference
        quotients of two simulations, including the zero of a motion that the stress follows.
        """
        n, at, step = self.time.size, self.nuisance.index(name), self._steps[name]
        followed = self._driven or "stress_strain" in self.counted
        if name in nuisances.ZEROS and not (followed and name == "displacement_zero"):
            return {
                curve: np.full(n, float(self._zero_of.get(curve) == name)) for curve in self.curves
            }
        if self.drive != "impact" and name not in (nuisances.TIME_SHIFT, "displacement_zero"):
            return {curve: np.zeros(n) for curve in self.curves}
        sides = []
        for side in (-0.5, 0.5):
            shifted = nuisance.copy()
            shifted[at] += side * step
            sides.append(self._curves(values, shifted, False, NOWHERE).curves)
        slopes = {curve: (sides[1][curve] - sides[0][curve]) / step for curve in sides[0]}
        if name == nuisances.CONTACT_TIME:  # where the stress jumps if there is a dashpot
            jumped = np.abs(self._clock - nuisance[at]) <= step
            for slope in slopes.values():
                slope[np.any(jumped.reshape(n, -1), axis=1)] = 0.0
        return slopes

    def _curves(
        self,
        values: Array,
        nuisance: Array,
        everything: bool,
        places: NDArray[np.int64],
        moved: bool = False,
    ) -> Simulated:
        """Return the curves with derivatives by parameters of the springs.

        With `moved` the last derivative is by a shift of the driving motion.
        """
        height, rows = self.measurement.specimen.height, self.model.rows(values)
        heights = np.ascontiguousarray(self.model.heights(values, height))
        if rows is None or not (heights.min() > 0.0 and values[-1] >= 0.0):
            raise SimulationError("the parameters are not admissible")
        damped = self._is_damped(values, places)  # dashpots at zero are omitted
        drag, everywhere = float(values[-1]) / height, everything or self._inside
        wanted = self.model.directions[places]
        wanted = np.append(wanted, [(0, MOVED)], axis=0) if moved else wanted
        at = dict(zip(self.nuisance, nuisance.tolist(), strict=True))

        def run(plan: Plan, everything: bool) -> Motion:
            return plan.run(
                rows, heights, self.rtol, drag=drag, everything=everything, directions=wanted
            )

        if self._largest - at.get("displacement_zero", 0.0) >= height:
            raise SimulationError("the measured strain would reach one with this displacement_zero")
        plan, late = self._placed(self._plans[damped], at), at.get(nuisances.TIME_SHIFT, 0.0)
        motion = run(plan, everywhere)
        if self._driven and self.measurement.last_cycle is not None:
            motion = without_tension(motion)
        shown = motion
        if late != 0.0 and self.drive == "impact":
            shown = run(plan._replace(time=plan.time - late), everywhere)
        along = motion if self._driven else None
        if along is None and (everything or "stress_strain" in self.counted) and self._along:
            along = without_tension(run(self._followed(self._along[damped], at), False))
        by_site = np.flatnonzero(places == values.size - 1) if places.size else places
        runs = {"stress_time": (motion, None), "displacement_time": (shown, -1)}
        runs |= {name: (shown, node - 1) for name, node in self.interior.items()}
        if along is not None:
            runs["stress_strain"] = along, None
        asked = set(self.curves).difference(self._absent) if everything else self.counted
        parts = {name: _with_slopes(*runs[name]) for name in runs if name in asked}
        if ACCELERATION in asked:
            parts[ACCELERATION] = self._acceleration(shown, drag, at, by_site)
        curves, slopes = dict[str, Array](), dict[str, Array]()
        scale = at.get(nuisances.FORCE_SCALE, 1.0)
        for name in STRESSES if scale != 1.0 else ():
            parts |= {name: parts[name] / scale} if name in parts else {}
        for name, simulated in parts.items():
            seen, zero = self._late(name, self._sampled(simulated), late), self._zero_of.get(name)
            curves[name], slopes[name] = seen[0] + at[zero] if zero else seen[0], seen[1:]
            if by_site.size:
                slopes[name][by_site] /= height  # site_eta acts through η_site/H
        if everything:
            motion = self._averaged(motion, at.get(nuisances.CONTACT_TIME, 0.0))
        return Simulated(curves, motion, slopes if len(wanted) else None)

    # ------------------------------------------------------------------ times and zeros

    @property
    def _driven(self) -> bool:
        """Whether the measured motion drives the springs."""
        return self.drive == "displacement"

    def _placed(self, plan: Plan, at: dict[str, float]) -> Plan:
        """Return the plan with contact time, striker and zero of the driving motion applied."""
        zero = at.get("displacement_zero", 0.0)
        if self._driven and (zero != 0.0 or self.measurement.contact != "file"):
            return plan._replace(values=np.maximum(plan.values - zero, 0.0))  # no contact below
        if self.drive != "impact":
            return plan
        mass = plan.mass.copy()
        mass[-1] = at[nuisances.STRIKER_MASS] / self.measurement.specimen.area
        time, weight = self._clock - at[nuisances.CONTACT_TIME], plan.values * mass[-1:]
        return plan._replace(
            time=time, speed=at[nuisances.VELOCITY], mass=mass, values=weight / plan.mass[-1]
        )

    def _followed(self, plan: Plan, at: dict[str, float]) -> Plan:
        """Return the plan along the measured motion of an impact, zero without contact."""
        if self.drive != "impact":
            return plan
        values = np.maximum(plan.values - at["displacement_zero"], 0.0)
        before = self._clock < at[nuisances.CONTACT_TIME]
        return plan._replace(values=np.where(before, 0.0, values))

    def _sampled(self, values: Array) -> Array:
        """Return the mean over the instants that each sample averages, along the last axis."""
        values = values if self._own is None else values[..., self._own]
        if self._fine == 1:
            return values
        parts = [values[..., i :: self._fine] for i in range(self._fine)]  # faster than .mean()
        return np.asarray(sum(parts[1:], parts[0]) / self._fine)

    def _averaged(self, motion: Motion, contact: float) -> Motion:
        """Return a simulated motion at the times of the samples."""
        if self._fine > 1 or self._own is not None:
            motion = motion._replace(
                displacement=self._sampled(motion.displacement),
                base_stress=self._sampled(motion.base_stress),
            )
        if contact == 0.0:
            return motion
        switches = motion.switches.copy()
        switches[:, 0] += contact
        return motion._replace(switches=switches, contact_end=motion.contact_end + contact)

    def _late(self, name: str, curves: Array, late: float) -> Array:
        """Return curves on the clock of the file, whose motion is `late` seconds late."""
        if late == 0.0 or (self.drive == "impact" and name != "stress_strain"):
            return curves
        if self.drive == "stress":
            return later(self.time, curves, late) if name.startswith("displacement") else curves
        if name.startswith("displacement"):
            return curves
        when = self.time + late
        rows = [np.interp(when, self.time, row) for row in np.atleast_2d(curves)]
        return np.reshape(rows, curves.shape)

    def _acceleration(
        self, motion: Motion, drag: float, at: dict[str, float], by_site: NDArray[np.intp]
    ) -> Array:
        """Return the deceleration of the striker, m/s², and its derivatives.

        By the equation of motion it is A (Σ_N + η_site/H dw/dt)/m; with interior masses it is the
        second derivative of the motion. An accelerometer does not measure gravity in free fall.
        """
        speed = np.gradient(_with_slopes(motion, -1), self._clock, axis=-1)
        if self.interior_mass:
            felt = -np.gradient(speed, self._clock, axis=-1)
            felt[0] += self._gravity
            return felt
        per_mass = self.measurement.specimen.area / at[nuisances.STRIKER_MASS]
        braked = np.where(self._clock < at[nuisances.CONTACT_TIME], 0.0, speed)
        pushed: Array = per_mass * (_with_slopes(motion) + drag * braked)
        pushed[1:][by_site] += per_mass * braked[0]
        return pushed

    # ------------------------------------------------------------------ residual

    def residual(self, values: Array) -> Array:
        """Return the weighted residuals of all counted curves and of the priors, dimensionless.

        The first `n_data` belong to the curves: simulated minus measured, divided by the scale of
        the curve, times the square root of its weight, without outliers. One residual per prior
        follows, divided by its standard deviation. If the simulation fails, the residuals are a
        finite penalty, and `failures` is increased.
        """
        try:
            curves = self.simulate(values)
        except SimulationError:
            return np.append(np.full(self.n_data, self.penalty), self.off_priors(values))
        return self.compare(curves, values)

    def off_priors(self, values: Array) -> Array:
        """Return the deviations of parameters from their priors, in standard deviations."""
        known = zip(values[self._prior_places], self.priors, strict=True)
        return np.array([(value - one.mean) / one.sigma for value, one in known])

    def compare(self, curves: Simulated, values: Array) -> Array:
        """Return the residuals of simulated curves; see `residual`."""
        parts = [
            (curves.curves[name] - self.measured[name])[self._kept[name]] * self.factor(name)
            for name in self.counted
        ]
        # The stress may be huge near the pole of branch c.
        bounded = np.minimum(np.maximum(np.concatenate(parts), -self.penalty), self.penalty)
        bounded = bounded if self.weighing is None else self.weighing(bounded)
        return np.append(bounded, self.off_priors(values)) if self.priors else bounded

    @property
    def floor(self) -> float:
        """The noise floor: 1.5 times the sum of squares expected from noise alone."""
        sizes = zip(self.counted, self.sizes, strict=True)
        return 1.5 * sum(n * (self.noise(one).sigma * self.factor(one)) ** 2 for one, n in sizes)

    def factor(self, name: str) -> float:
        """Return the residual of a deviation of one SI unit in a curve."""
        return float(self.weights[name] ** 0.5 / self.scale[name])

    def span(self, name: str) -> float:
        """Return the measured range of a curve, in units of its residual."""
        return float(np.ptp(self.measured[name])) * self.factor(name)

    def jacobian(self, values: Array, places: NDArray[np.int64]) -> Array:
        """Return the derivative of the residual by the parameters at `places`, (n, n_places), SI.

        It is integrated along with the simulation, and zero if the simulation fails.
        """
        by_priors = np.zeros((len(self.priors), places.size))
        for row, (one, place) in enumerate(zip(self.priors, self._prior_places, strict=True)):
            by_priors[row, places == place] = 1.0 / one.sigma
        try:
            curves = self.simulate(values, places=places)
        except SimulationError:
            return np.concatenate([np.zeros((self.n_data, places.size)), by_priors])
        if (by := curves.slopes) is None:  # `places` is empty
            return np.zeros((self.n_data + len(self.priors), 0))
        parts = [by[name][:, self._kept[name]] * self.factor(name) for name in self.counted]
        slopes = np.concatenate(parts, axis=1).T
        residual = self.compare(curves, values)[: self.n_data]
        slopes[np.abs(residual) >= self.penalty] = 0.0
        slopes = slopes if self.weighing is None else self.weighing(slopes)
        return np.concatenate([slopes, by_priors]) if self.priors else slopes

    def jacobian_along(self, values: Array, moves: Array) -> Array:
        """Return the derivative of the residual along moves (n_values, m), (n_data, m)."""
        places = np.flatnonzero(moves.any(axis=1))
        return self.jacobian(values, places) @ moves[places]

    def kept(self, name: str) -> NDArray[np.intp]:
        """Return the indices of the samples of a curve that are in the residual."""
        return self._kept[name]

    def n_measured(self, name: str) -> int:
        """Return the number of measured samples of a curve, outliers included."""
        taken = self.measurement.sampled.get(self.channel(name))
        return self.time.size if taken is None else int(np.count_nonzero(taken))

    def by_curve(self, residual: Array) -> dict[str, Array]:
        """Split a residual into the parts of the counted curves."""
        parts = np.split(residual[: self.n_data], np.cumsum(self.sizes)[:-1])
        return dict(zip(self.counted, parts, strict=True))

    def rms(self, residual: Array) -> dict[str, float]:
        """Return the RMS deviation of each counted curve in its unit, from a residual."""
        return {
            name: float(np.sqrt(np.mean(part**2))) / self.factor(name)
            for name, part in self.by_curve(residual).items()
        }

    def misfit(self, curves: Simulated) -> dict[str, float | None]:
        """Return the misfit of each curve: RMS of simulated minus measured over the measured range.

        Outliers are left out. It is None if the test or the drive does not have the curve, or if
        its motion was integrated from the force and does not count.
        """
        derived = MOTION_CURVES if self.measurement.motion == INTEGRATED else ()
        shown = [name for name in self.curves if name in self.counted or name not in derived]
        return {name: self.off(curves, name) if name in shown else None for name in self.curves}

    def shifted(self, curves: Simulated, late: float) -> dict[str, Array]:
        """Return the curves that channels with a motion `late` seconds late would show."""
        moved = "displacement" if self.drive == "impact" else " "
        return {
            name: later(self.time, curve, late)
            if name.startswith(moved)
            else self._late(name, curve, late)
            for name, curve in curves.curves.items()
        }

    def look(self, values: Array) -> dict[str, float | None] | None:
        """Return the misfits of all curves, without counting the evaluation; None if it fails."""
        counts = self.evaluations, self.failures
        try:
            return self.misfit(self.simulate(values, everything=True))
        except SimulationError:
            return None
        finally:
            self.evaluations, self.failures = counts

    def off(self, curves: Simulated, name: str) -> float | None:
        """Return the misfit of one curve; None if it was not measured or simulated."""
        measured, simulated = self.measured.get(name), curves.curves.get(name)
        if measured is None or simulated is None:
            return None
        miss = (simulated - measured)[self._kept[name]]
        return float(np.sqrt(np.mean(miss**2)) / np.ptp(measured))
