"""The objective: how far a model's curves are from the measured ones, sample by sample.

Curves are compared in time (or sample by sample along a history), never by interpolating across
the loop. Two channels were measured, stress and displacement, and perhaps displacements of masses
inside; what is counted of them, and how much, is in `weights`, so that nothing is counted twice
silently.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import INTEGRATED, Measurement, NoiseLevel
from foamfit.data.noise import with_noise
from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.fitting.curves import (
    CURVES,
    MOTION_CURVES,
    check_drive,
    check_time_shift,
    driving_stress,
    interior_curves,
)
from foamfit.fitting.losses import LOSSES, soften, softness
from foamfit.solve.plan import Motion, Plan
from foamfit.solve.plan import plan as make_plan
from foamfit.springs import kernels
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.model import Model
from foamfit.springs.spring import LinearSpring, MicroscaleSpring, Spring

# What a residual is, in units of the curve's scale, where a simulation failed.
PENALTY = 10.0
NOWHERE = np.empty(0, np.int64)
# Share of a channel's range that estimated noise counts for at least. The law has not followed a
# measured foam closer than 1 % of its range: noise far below that must not let one channel outweigh
# the other by what is an error of the model in both.
MODEL_ERROR = 0.005
# A spring of a kind, whatever its numbers, where that is more than a linear one to the solver.
_ANY_SPRING: dict[str, Spring] = {"microscale": MicroscaleSpring(1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0)}
# A trial that needs more steps than this is too stiff to be worth waiting for.
MAX_STEPS = 20_000


@dataclass(frozen=True, eq=False)
class Simulated:
    """The curves of one set of parameters and the run itself.

    `curves` are by their names in `Objective.curves`, absent where the drive prescribes or the test
    lacks them; stress_strain is the stress (Pa) along the measured displacement. `slopes` are the
    derivatives (p, n) of the curves by the parameters that were asked for; None where none were.
    """

    curves: dict[str, Array]
    motion: Motion
    slopes: dict[str, Array] | None = None


@dataclass(eq=False)
class Objective:
    """Residuals of a model under a drive against a measurement.

    `curves` are the names of the curves that can be counted, `interior` those of masses inside and
    their node.
    """

    measurement: Measurement  # Conditioned
    model: Model
    drive: str  # "impact", "stress" or "displacement"
    weights: dict[str, float]  # Of each curve: it multiplies the curve's squares
    rtol: float = 1e-6  # Of the simulation
    # Whether the specimen's mass sits between the springs, in equal parts, as in the paper.
    interior_mass: bool = False
    # Whether the vector of parameters ends with how late the motion channel is, s.
    time_shift: bool = False
    loss: str = "linear"  # One of `LOSSES`
    evaluations: int = field(default=0, init=False)  # Sets of parameters that were simulated
    failures: int = field(default=0, init=False)  # Those of them that could not be

    def __post_init__(self) -> None:
        """Make the scenes ready and fix the scale of each curve."""
        check_drive(self.measurement, self.drive)
        if self.time_shift:
            check_time_shift(self.measurement, self.drive)
        if self.loss not in LOSSES:
            raise InputError(
                f"loss '{self.loss}' is unknown; it must be one of {', '.join(LOSSES)}"
            )
        self.measurement = with_noise(self.measurement)
        self.interior = interior_curves(self.measurement, len(self.model.kinds))
        self.curves = (*CURVES, *self.interior)
        self._check_weights()
        self._dashpots = np.array([name.endswith("eta") for name in self.model.names])
        self._dashpots[-1] = False  # the onsite damper is none of a spring
        time = self.measurement.time
        # Of the samples, s; their number where the test has no time.
        self.time = np.arange(self._stress.size, dtype=float) if time is None else time
        self._absent = {"stress": ["stress_time"], "displacement": ["displacement_time"]}.get(
            self.drive, []
        ) + (["stress_time"] if time is None else [])
        loading = self._loading()
        self._plans = {damped: self._scene(loading, damped=damped) for damped in (False, True)}
        self._along: dict[bool, Plan] = {}
        if self.measurement.displacement is not None:
            along = DisplacementDrive(self.measurement.displacement)
            self._along = {damped: self._scene(along, damped=damped) for damped in (False, True)}
        self.measured = self._measured()
        self.counted = tuple(name for name in self.measured if self.weights[name] > 0)
        self._inside = any(name in self.interior for name in self.counted)
        if not self.counted:
            raise InputError(
                f"{self.measurement.name}: no curve is left to fit; give one that the "
                f"{self.drive} drive has a weight above zero"
            )
        self.scale = {name: self._scale(name) for name in self.measured}
        self._kept = {name: self._fitted(name) for name in self.measured}
        self.sizes = tuple(self.kept(name).size for name in self.counted)
        self.n_data = sum(self.sizes)
        # Worse per sample than any curve that stays within ten ranges.
        self.penalty = max(PENALTY * self.span(name) for name in self.counted)

    def _check_weights(self) -> None:
        for name, weight in self.weights.items():
            number = isinstance(weight, Real)
            if name not in self.curves or not number or not 0 <= weight < np.inf:
                raise InputError(
                    f"weights: '{name}' = {weight} is not admissible; give "
                    f"{', '.join(self.curves)} a weight of zero or more"
                )
        self.weights = dict.fromkeys(self.curves, 0.0) | self.weights

    @property
    def _stress(self) -> Array:
        assert self.measurement.stress is not None  # checked by check_drive
        return self.measurement.stress

    def _loading(self) -> Drive:
        if self.drive == "impact":
            striker = self.measurement.striker
            assert striker is not None
            assert striker.mass is not None
            assert striker.velocity is not None
            return Impact(striker.mass, striker.velocity)
        if self.drive == "stress":
            return StressDrive(driving_stress(self._stress, self.model))
        assert self.measurement.displacement is not None
        return DisplacementDrive(self.measurement.displacement)

    def _scene(self, loading: Drive, *, damped: bool) -> Plan:
        """Make a scene ready; only which springs have a dashpot matters here, not their values.

        Interior masses move in an impact only; along a given motion the springs are in equilibrium.
        """
        specimen = self.measurement.specimen
        count = len(self.model.kinds)
        springs = [_ANY_SPRING.get(kind, LinearSpring(1.0)) for kind in self.model.kinds]
        heights = [specimen.height / count] * count
        masses = [0.0] * count
        if self.interior_mass and count > 1 and isinstance(loading, Impact):
            if specimen.mass is None:
                raise InputError(
                    f"{self.measurement.name}: interior masses need [specimen] mass, "
                    'like mass = "5.56 mg"'
                )
            masses = [specimen.mass / (count - 1)] * (count - 1) + [0.0]
        chain = Chain(springs, heights, specimen.area, masses)
        return make_plan(
            chain, loading, self.time, dashpots=damped, relaxing=self.model.relaxation > 0,
            max_steps=MAX_STEPS,
        )  # fmt: skip

    def _measured(self) -> dict[str, Array]:
        """Measured curves that the drive leaves free."""
        measured = {"stress_time": self._stress}
        if self.measurement.displacement is not None:
            measured["displacement_time"] = self.measurement.displacement
            measured["stress_strain"] = self._stress
        inside = self.measurement.interior
        measured |= {name: inside[node] for name, node in self.interior.items()}
        return {name: curve for name, curve in measured.items() if name not in self._absent}

    @property
    def nuisance(self) -> tuple[str, ...]:
        """Names of the parameters that the objective adds to those of the model."""
        return ("time_shift",) if self.time_shift else ()

    def channel(self, name: str) -> str:
        """Channel of the test that a curve is compared with."""
        return name.removesuffix("_time") if name.startswith("displacement") else "stress"

    def noise(self, name: str) -> NoiseLevel:
        """Noise of a curve, stated or estimated."""
        level = self.measurement.noise.of(self.channel(name))
        assert level is not None  # completed by with_noise
        return level

    def _scale(self, name: str) -> float:
        """One standard deviation of a curve's noise; an estimated one not below MODEL_ERROR."""
        level = self.noise(name)
        least = MODEL_ERROR * float(np.ptp(self.measured[name]))
        return level.sigma if level.given else max(level.sigma, least)

    def _fitted(self, name: str) -> slice | NDArray[np.bool_]:
        """Samples of a curve that count: those that its channel measured, but no outliers."""
        outliers = self.measurement.outliers.get(self.channel(name))
        taken = self.measurement.sampled.get(self.channel(name))
        if outliers is None:
            return slice(None) if taken is None else taken
        return ~outliers.left_out if taken is None else taken & ~outliers.left_out

    # ------------------------------------------------------------------ simulation and residual

    def simulate(
        self, values: Array, *, everything: bool = False, places: NDArray[np.int64] = NOWHERE
    ) -> Simulated:
        """Simulate a flat vector of parameters; what is not counted only if `everything`.

        `places` are those of the parameters by which derivatives are wanted.

        Raises SimulationError if they are not admissible or the scene has no finite answer.
        """
        count = len(self.model.names)
        self.evaluations += 1
        try:
            with as_signalled():
                springs = self._springs(values[:count], everything, places[places < count])
        except SimulationError:
            self.failures += 1
            raise
        if not self.time_shift:
            return springs
        return self.shifted(springs, float(values[count]), places == count)

    def add_counts(self, other: Objective) -> None:
        """Count the evaluations and failures of another objective as one's own."""
        self.evaluations += other.evaluations
        self.failures += other.failures

    def _springs(self, values: Array, everything: bool, places: NDArray[np.int64]) -> Simulated:
        """Simulate the parameters of the model, without a time shift; see `simulate`."""
        height = self.measurement.specimen.height
        rows = self.model.rows(values)
        heights = np.ascontiguousarray(self.model.heights(values, height))
        if rows is None or not (np.all(heights > 0.0) and values[-1] >= 0.0):
            raise SimulationError("the parameters are not admissible")
        # A dashpot at zero is left out, unless a derivative by it is wanted.
        damped = bool(rows[:, kernels.ETA].any()) or bool(self._dashpots[places].any())
        drag = float(values[-1]) / height
        everywhere = everything or self._inside
        wanted = self.model.directions[places]
        run = self._plans[damped].run(
            rows, heights, self.rtol, drag=drag, everything=everywhere, directions=wanted
        )
        inside = self.interior if everywhere else {}
        along = run if self.drive == "displacement" else None
        if along is None and self._along and (everything or "stress_strain" in self.counted):
            plan = self._along[damped]
            along = plan.run(rows, heights, self.rtol, everything=False, directions=wanted)
        curves = {"stress_time": run.base_stress, "displacement_time": run.displacement[-1]}
        curves |= {name: run.displacement[node - 1] for name, node in inside.items()}
        if along is not None:
            curves["stress_strain"] = along.base_stress
        curves = {name: curve for name, curve in curves.items() if name not in self._absent}
        if run.slopes is None or (along is not None and along.slopes is None):
            return Simulated(curves, run)
        moved, pressed = run.slopes
        slopes = {"stress_time": pressed, "displacement_time": moved[:, -1]}
        slopes |= {name: moved[:, node - 1] for name, node in inside.items()}
        if along is not None and along.slopes is not None:
            slopes["stress_strain"] = along.slopes.base_stress
        for slope in slopes.values():
            slope[places == values.size - 1] /= height  # site_eta acts through η_site/H
        return Simulated(curves, run, slopes)

    def shifted(
        self, curves: Simulated, late: float, by_shift: NDArray[np.bool_] = NOWHERE == 0
    ) -> Simulated:
        """Curves as channels show them of which the motion is late by so many seconds.

        Slopes are shifted with their curves. Where `by_shift` (n_places,) marks one by the shift
        itself, that is a difference over one sample: no simulation is in it.
        """
        there, slopes = curves.curves, curves.slopes
        if by_shift.size:
            step = float(np.median(np.diff(self.time)))
            own = slopes or {name: np.empty((0, self.time.size)) for name in there}
            slopes = {}
            for name in there.keys() & own.keys():
                out = np.empty((by_shift.size, self.time.size))
                rows = [self._shift(name, row, late, 0.0) for row in own[name]]
                out[~by_shift] = np.reshape(rows, (-1, self.time.size))
                sides = [self._shift(name, there[name], late + side * step) for side in (-0.5, 0.5)]
                out[by_shift] = (sides[1] - sides[0]) / step
                slopes[name] = out
        if late != 0.0:
            there = {name: self._shift(name, curve, late) for name, curve in there.items()}
        return replace(curves, curves=there, slopes=slopes)

    def _shift(self, name: str, curve: Array, late: float, speed: float | None = None) -> Array:
        """One curve, or its derivative, seen by channels of which the motion is late (s).

        Where time is that of the force the motion is seen later; where it is that of the motion
        (time zero is read off it, or it drives) the force is seen earlier. Before contact the
        striker comes at its velocity, or at `speed` (m/s), and no stress acts; a displacement that
        was set to zero where the stress starts is so here.
        """
        impact, contact = self.drive == "impact", self.measurement.contact
        by_motion = self.drive == "displacement" or (impact and contact == "motion")
        if not name.startswith("displacement"):
            if not by_motion and name != "stress_strain":
                return curve
            when = self.time + late
            earlier = np.interp(when, self.time, curve)
            return np.where(when < 0.0, 0.0, earlier) if late < 0.0 else earlier
        if by_motion:
            return curve
        before: float | None = None
        if impact:
            assert self.measurement.striker is not None  # checked by check_drive
            before = self.measurement.striker.velocity if speed is None else speed
        moved = _later(self.time, curve, late, before)
        if impact and contact == "stress":
            moved = moved - _later(self.time, curve, late, before, at=0.0)
        return moved

    def residual(self, values: Array, shift: Array | float = 0.0) -> Array:
        """Weighted residuals of all counted curves, shape (n_data,), dimensionless.

        Simulated minus measured over the curve's scale, times the root of its weight, softened by
        the loss; outliers are left out. Parameters that cannot be simulated cost a finite penalty
        and are counted in `failures`. `shift` (n_data,) is taken off before the loss: data that
        differ by so much from those that were measured.
        """
        return soften(self.differences(values) - shift, self.loss)

    def differences(self, values: Array) -> Array:
        """Residuals before the loss gives way to large ones, shape (n_data,)."""
        try:
            curves = self.simulate(values)
        except SimulationError:
            return np.full(self.n_data, self.penalty)
        return self.compare(curves)

    def compare(self, curves: Simulated) -> Array:
        """Residuals of simulated curves before the loss gives way to large ones, (n_data,)."""
        parts = [
            (curves.curves[name] - self.measured[name])[self._kept[name]] * self.factor(name)
            for name in self.counted
        ]
        # A stress near the pole of branch c is as bad as none.
        return np.asarray(np.clip(np.concatenate(parts), -self.penalty, self.penalty))

    def factor(self, name: str) -> float:
        """Residual of a curve that is off by one SI unit."""
        return float(self.weights[name] ** 0.5 / self.scale[name])

    def span(self, name: str) -> float:
        """Measured range of a curve, in the unit of its residual."""
        return float(np.ptp(self.measured[name])) * self.factor(name)

    def jacobian(self, values: Array, places: NDArray[np.int64]) -> Array:
        """Derivative of the residual by the parameters at `places`, (n_data, n_places), SI.

        Carried along with the simulation; zeros where the parameters cannot be simulated.
        """
        try:
            curves = self.simulate(values, places=places)
        except SimulationError:
            return np.zeros((self.n_data, places.size))
        if curves.slopes is None:  # none were asked for
            return np.zeros((self.n_data, 0))
        parts = [
            curves.slopes[name][:, self._kept[name]] * self.factor(name) for name in self.counted
        ]
        slopes = np.concatenate(parts, axis=1).T
        residual = self.compare(curves)
        slopes[np.abs(residual) >= self.penalty] = 0.0
        return slopes if self.loss == "linear" else slopes * softness(residual, self.loss)[:, None]

    def jacobian_along(self, values: Array, moves: Array) -> Array:
        """Derivative of the residual along moves (n_values, m) of the parameters, (n_data, m)."""
        places = np.flatnonzero(moves.any(axis=1))
        return self.jacobian(values, places) @ moves[places]

    def kept(self, name: str) -> NDArray[np.intp]:
        """Samples of a curve that stand in the residual, in their order."""
        return np.arange(self.time.size)[self._kept[name]]

    def n_measured(self, name: str) -> int:
        """Count the samples that the channel of a curve measured, outliers included."""
        taken = self.measurement.sampled.get(self.channel(name))
        return self.time.size if taken is None else int(np.count_nonzero(taken))

    def rms(self, residual: Array) -> dict[str, float]:
        """RMS of each counted curve in its unit, from residuals before the loss."""
        parts = np.split(residual, np.cumsum(self.sizes)[:-1])
        return {
            name: float(np.sqrt(np.mean(part**2))) / self.factor(name)
            for name, part in zip(self.counted, parts, strict=True)
        }

    def misfit(self, curves: Simulated) -> dict[str, float | None]:
        """RMS of simulated minus measured over the measured range, per curve; None if not there.

        Outliers are left out. A motion that was integrated from the force is there only if it is
        counted.
        """
        derived = MOTION_CURVES if self.measurement.motion == INTEGRATED else ()
        there = [name for name in self.curves if name in self.counted or name not in derived]
        return {name: self.off(curves, name) if name in there else None for name in self.curves}

    def look(self, values: Array, *, everything: bool = False) -> dict[str, float | None] | None:
        """Misfits of a point, see `misfit`, which is counted as no step of a fit.

        None if it cannot be simulated.
        """
        counts = self.evaluations, self.failures
        try:
            return self.misfit(self.simulate(values, everything=everything))
        except SimulationError:
            return None
        finally:
            self.evaluations, self.failures = counts

    def off(self, curves: Simulated, name: str) -> float | None:
        """RMS of simulated minus measured over the measured range of one curve, if it is there."""
        measured, simulated = self.measured.get(name), curves.curves.get(name)
        if measured is None or simulated is None:
            return None
        miss = (simulated - measured)[self._kept[name]]
        return float(np.sqrt(np.mean(miss**2)) / np.ptp(measured))


def _later(
    time: Array, curve: Array, late: float, before: float | None, *, at: float | None = None
) -> Array:
    """Motion (m) seen `late` seconds later, at the samples or at one time; straight past its ends.

    `before` is the velocity (m/s) ahead of the first sample, by default that of its first step.
    """
    when = (time if at is None else np.array([at])) - late
    first = (curve[1] - curve[0]) / (time[1] - time[0]) if before is None else before
    last = (curve[-1] - curve[-2]) / (time[-1] - time[-2])
    inside = np.interp(when, time, curve)
    ahead, after = np.minimum(when - time[0], 0.0), np.maximum(when - time[-1], 0.0)
    return np.asarray(inside + first * ahead + last * after)
