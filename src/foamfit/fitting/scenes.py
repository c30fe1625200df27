"""The curves that a test would show: its scenes, and the readings of its channels.

Everything that does not change during a fit is prepared once. `Scenes.rows` then maps the
parameters of springs and channels to the curves, each stacked on its derivatives.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.data.motion import SmoothMotion
from foamfit.errors import InputError, SimulationError
from foamfit.fitting import curves, nuisance as nuisances
from foamfit.solve.plan import Motion, Plan, plan as make_plan
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.laws.record import BEGUN, HEAVIER, MOVED, STRUCK
from foamfit.springs.model import Model

Places = NDArray[np.int64]

NOWHERE: Places = np.empty(0, np.int64)
# Curves of the measured stress, which is the simulated one over the scale of the force.
STRESSES = ("stress_time", "stress_strain")
MAX_STEPS = 20_000  # a trial that needs more steps is too stiff and counts as failed
FINEST = 8  # most instants simulated per sample that averages rows of the file
STEP_OF_TIME = 0.02  # of the derivative of a late reading, in sampling intervals
# Directions of the solver for nuisance parameters. In an impact the motion may be late.
OF_NUISANCE = {
    "displacement_zero": MOVED, nuisances.CONTACT_TIME: BEGUN, nuisances.TIME_SHIFT: BEGUN,
    nuisances.VELOCITY: STRUCK, nuisances.STRIKER_MASS: HEAVIER,
}  # fmt: skip


class Wanted(NamedTuple):
    """Derivatives to return, by the places of their parameters in the flat vector."""

    own: Places  # rows of the derivatives by parameters of springs
    directions: Places  # of the solver: those of springs, then those of nuisance parameters
    others: tuple[tuple[int, str], ...]  # rows and names of nuisance parameters
    columns: dict[str, int]  # places of nuisance parameters among the directions
    damped: bool  # whether one is by a dashpot
    by_site: tuple[int, ...]  # rows of the derivative by site_eta


def _stacked(motion: Motion, node: int | None = None) -> Array:
    """Return the base stress, or the displacement of a node, stacked on its derivatives."""
    every = (motion,) if motion.slopes is None else (motion, motion.slopes)
    if node is None:
        return np.vstack([one.base_stress for one in every])
    return np.vstack([one.displacement[..., node, :] for one in every])


@dataclass(eq=False)
class Scenes:
    """The scenes of a test with a model under a drive; `Objective` describes the fields."""

    measurement: Measurement
    model: Model
    drive: str
    curves: tuple[str, ...]  # all of the test
    interior: dict[str, int]  # node of each curve of an interior mass
    nuisance: tuple[str, ...]
    rtol: float
    interior_mass: bool
    followed: tuple[SmoothMotion | None, ...] = ()
    averaged: float = np.inf
    glued: bool = False  # whether the specimen bears tension
    _asked: dict[tuple[bytes, bool], Wanted] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        """Prepare the instants and the plans."""
        test = self.measurement
        self.driven = self.drive == "displacement"
        self.time = test.instants
        sampled = self.drive == "stress" and self.smooth is None
        self._fine = 1 if sampled else min(test.block, FINEST)
        self.clock = own = curves.instants(self.time, self._fine, self.averaged)
        self._earlier = 0  # number of instants before a later cycle
        if self.driven:
            self.clock = curves.driven_instants(test, own, self.motion)
            if (before := curves.history(test, self.model)) is not None:
                self.clock, self._earlier = np.append(before[0], self.clock), before[0].size
        self._own = np.searchsorted(self.clock, own) if self.clock.size > own.size else None
        absent = f"{self.drive}_time", "stress_time" if test.time is None else ""
        self.present = tuple(name for name in self.curves if name not in absent)
        self._largest = 0.0 if test.displacement is None else float(test.displacement.max())  # m
        self._gravity = (test.striker.gravity if test.striker else None) or 0.0
        self.usual = nuisances.values_of(test)
        self._dashpots = [i for i, name in enumerate(self.model.names[:-1]) if name.endswith("eta")]
        # Whether all samples share one clock and no reading is averaged.
        self._plain = self._fine == 1 and self._own is None
        self._slack = not self.glued
        self._one = np.array([test.specimen.height])
        self.plans = self._make(self._loading())

    @cached_property
    def motion(self) -> SmoothMotion | None:
        """The measured motion without its noise, or None; see `driving_motion`."""
        if self.followed:
            return self.followed[0]
        return curves.driving_motion(self.measurement, self.time)

    @cached_property
    def smooth(self) -> SmoothMotion | None:
        """What drives the springs, without its noise: a motion (m) or a stress (Pa), or None."""
        if self.drive == "stress":
            return curves.smooth_stress(self.measurement, self.time)
        return self.motion if self.driven else None

    def driving(self, times: Array) -> Array:
        """Return the driving stress at some instants, Pa."""
        return curves.driving_stress(self.measurement, self.model, times, self.smooth)

    @cached_property
    def _moved(self) -> Array:
        """The measured motion at the simulated instants, m."""
        assert self.measurement.displacement is not None
        moved = curves.moved_at(self.clock, self.time, self.measurement.displacement, self.motion)
        if self._earlier and (before := curves.history(self.measurement, self.model)) is not None:
            moved[: self._earlier] = before[1]
        return moved

    @cached_property
    def _along(self) -> dict[bool, Plan]:
        """Scenes of the springs along the measured motion; empty without a motion."""
        is_measured = self.measurement.displacement is not None
        return self._make(DisplacementDrive(self._moved)) if is_measured else {}

    @cached_property
    def _zeros(self) -> dict[str, str]:
        """The nuisance parameter that is added to each curve, if there is one."""
        zeros = {curve: f"{channel_of(curve)}_zero" for curve in self.curves}
        return {curve: zero for curve, zero in zeros.items() if zero in self.nuisance}

    def modes(self, smooth: SmoothMotion) -> Array:
        """Return the modes of the drive at the simulated instants; zero before a later cycle."""
        modes = smooth.modes(self.clock)
        modes[: self._earlier] = 0.0
        return modes

    def moved_by(self, change: Array | float) -> Scenes:
        """Return the scenes with a changed driving motion."""
        other = copy(self)
        pairs = self.plans.items()
        other.plans = {key: plan.changed(values=plan.values + change) for key, plan in pairs}
        return other

    def _loading(self) -> Drive:
        if self.drive == "impact":
            usual = self.usual
            return Impact(usual[nuisances.STRIKER_MASS], usual[nuisances.VELOCITY], self._gravity)
        if self.drive == "stress":
            return StressDrive(self.driving(self.clock))
        return DisplacementDrive(self._moved)

    def _make(self, loading: Drive) -> dict[bool, Plan]:
        """Prepare scenes without and with dashpots; they do not depend on the spring parameters."""
        specimen, count = self.measurement.specimen, len(self.model.kinds)
        heights, masses = [specimen.height / count] * count, [0.0] * count
        # Along a prescribed motion the springs are in equilibrium.
        if self.interior_mass and count > 1 and isinstance(loading, Impact):
            if specimen.mass is None:
                raise InputError(
                    f"{self.measurement.name}: interior masses need [specimen] mass, "
                    'like mass = "5.56 mg"'
                )
            masses = [specimen.mass / (count - 1)] * (count - 1) + [0.0]
        springs = [law.any_spring(self.model.relaxation) for law in self.model.laws]
        chain = Chain(springs, heights, specimen.area, masses)
        make = partial(make_plan, chain, loading, self.clock, max_steps=MAX_STEPS)
        relaxing = self.model.relaxation > 0
        return {damped: make(dashpots=damped, relaxing=relaxing) for damped in (False, True)}

    # ------------------------------------------------------------------ curves and derivatives

    def wanted(self, places: Places, followed: bool) -> Wanted:
        """Return the derivatives by the parameters at `places`, prepared once.

        `followed` is whether springs follow the measured motion.
        """
        key = places.tobytes(), followed
        if (found := self._asked.get(key)) is None:
            names, count = self.model.names, len(self.model.names)
            own = np.flatnonzero(places < count)
            rows = ((row, place - count) for row, place in enumerate(places.tolist()))
            others = tuple((row, self.nuisance[i]) for row, i in rows if i >= 0)
            damped = any(place in self._dashpots for place in places.tolist())
            adds = () if followed else ("displacement_zero",)  # which moves nothing
            more = [name for _, name in others if name in OF_NUISANCE and name not in adds]
            columns = {name: own.size + k for k, name in enumerate(more)}
            given = np.reshape([(-1, OF_NUISANCE[name]) for name in more], (-1, 2)).astype(np.int64)
            directions = np.concatenate((self.model.directions[places[own]], given))
            site = tuple(r for r, p in enumerate(places[own].tolist()) if p == len(names) - 1)
            found = Wanted(own, directions, others, columns, damped, site)
            self._asked[key] = found
        return found

    def rows(
        self, values: Array, places: Places, counted: tuple[str, ...], everything: bool
    ) -> tuple[dict[str, Array], Motion]:
        """Return curves (1 + p, n) stacked on their derivatives, and the simulated motion.

        These are the readings of the channels: the `counted` ones, or all with `everything`. Raise
        SimulationError if the parameters are not admissible or the scene has no finite answer.
        """
        count = len(self.model.names)
        springs, given = values[:count], values[count:].tolist()
        at = dict(zip(self.nuisance, given, strict=True))
        followed = self.driven or "stress_strain" in counted or everything
        wanted = self.wanted(places, followed)
        found, motion = self._curves(springs, at, wanted, counted, everything)
        if not wanted.others:
            return found, motion
        out = dict[str, Array]()
        for curve, rows in found.items():
            out[curve] = every = np.empty((1 + places.size, rows.shape[1]))
            every[0], every[1 + wanted.own] = rows[0], rows[1 : 1 + wanted.own.size]
            for row, name in wanted.others:
                every[1 + row] = self._by_nuisance(name, curve, rows, at, wanted)
        return out, motion

    def _by_nuisance(
        self, name: str, curve: str, rows: Array, at: dict[str, float], wanted: Wanted
    ) -> Array:
        """Return the derivative of one of the simulated `rows` by a nuisance parameter, (n,)."""
        by = np.full(rows.shape[1], float(self._zeros.get(curve) == name))
        if name == nuisances.FORCE_SCALE and curve in STRESSES:
            return np.asarray((at.get(self._zeros.get(curve, ""), 0.0) - rows[0]) / at[name])
        forces = (nuisances.TIME_SHIFT, "impact", "stress_time")  # which are never late
        column = wanted.columns.get(name)
        if column is None or (name, self.drive, curve) == forces:
            return by
        factors = {
            "displacement_zero": -1.0,  # a larger zero means a smaller motion
            nuisances.STRIKER_MASS: 1.0 / self.measurement.specimen.area,
        }
        by += factors.get(name, 1.0) * rows[1 + column]
        return by

    def _curves(
        self, springs: Array, at: dict[str, float], wanted: Wanted, counted: tuple[str, ...],
        everything: bool,
    ) -> tuple[dict[str, Array], Motion]:  # fmt: skip
        """Return the curves with derivatives by parameters of the springs."""
        height, drag = self.measurement.specimen.height, springs.item(-1)
        rows, heights, fine = self.model.rows(springs), self._one, drag >= 0.0
        if len(self.model.kinds) > 1:
            heights = springs[-1 - len(self.model.kinds) : -1].copy()
            fine = fine and heights.min() > 0.0
        if rows is None or not fine:
            raise SimulationError("the parameters are not admissible")
        if self._largest - at.get("displacement_zero", 0.0) >= height:
            raise SimulationError("the measured strain would reach one with this displacement_zero")
        # Dashpots at zero are omitted.
        damped = wanted.damped or any(springs.item(i) != 0.0 for i in self._dashpots)
        drag /= height

        def run(plan: Plan, shown: bool) -> Motion:
            more: Any = {"drag": drag, "everything": shown, "directions": wanted.directions}
            return plan.run(rows, heights, self.rtol, **more)

        inside = everything or any(name in self.interior for name in counted)
        plan, late = self._placed(self.plans[damped], at), at.get(nuisances.TIME_SHIFT, 0.0)
        motion = run(plan, inside)
        if self.driven and self._slack:
            motion = curves.without_tension(motion)
        shown = motion
        if late != 0.0 and self.drive == "impact":
            shown = run(plan.changed(time=plan.time - late), inside)
        along = motion if self.driven else None
        if along is None and (everything or "stress_strain" in counted) and self._along:
            along = curves.without_tension(run(self._followed(self._along[damped], at), False))
        runs = {"stress_time": (motion, None), "displacement_time": (shown, -1)}
        runs |= {name: (shown, node - 1) for name, node in self.interior.items()}
        if along is not None:
            runs["stress_strain"] = along, None
        asked = self.present if everything else counted
        parts = {name: _stacked(*runs[name]) for name in asked if name in runs}
        if curves.ACCELERATION in asked:
            parts[curves.ACCELERATION] = self._acceleration(shown, drag, at, wanted)
        out = {name: self._read(name, rows, at, wanted) for name, rows in parts.items()}
        if everything:
            motion = self._averaged(motion, at.get(nuisances.CONTACT_TIME, 0.0))
        return out, motion

    def _read(self, name: str, rows: Array, at: dict[str, float], wanted: Wanted) -> Array:
        """Return the reading of a channel: scaled, averaged, late, and with its zero; in place."""
        scale, late = at.get(nuisances.FORCE_SCALE, 1.0), at.get(nuisances.TIME_SHIFT, 0.0)
        if scale != 1.0 and name in STRESSES:
            rows = rows / scale
        rows = rows if self._plain else self._sampled(rows)
        column = wanted.columns.get(nuisances.TIME_SHIFT)
        rows = rows if late == 0.0 and column is None else self._late(name, rows, late, column)
        if zero := at.get(self._zeros.get(name, ""), 0.0):
            rows = np.concatenate([rows[:1] + zero, rows[1:]])
        if wanted.by_site:
            rows = rows.copy()
            rows[1 + wanted.by_site[0]] /= self.measurement.specimen.height  # acts through η_site/H
        return rows

    # ------------------------------------------------------------------ times and zeros

    def _placed(self, plan: Plan, at: dict[str, float]) -> Plan:
        """Return the plan with contact time, striker and zero of the driving motion applied."""
        zero = at.get("displacement_zero", 0.0)
        if self.driven and (zero != 0.0 or self.measurement.contact != "file"):
            moved = plan.values - zero  # below zero there is no contact
            touched = int(np.argmax(moved > 0.0)) if self.glued else moved.size
            np.maximum(moved[:touched], 0.0, out=moved[:touched])
            return plan.changed(values=moved)
        if self.drive != "impact":
            return plan
        mass = plan.mass.copy()
        mass[-1] = at[nuisances.STRIKER_MASS] / self.measurement.specimen.area
        time, weight = self.clock - at[nuisances.CONTACT_TIME], plan.values * mass[-1:]
        speed, values = at[nuisances.VELOCITY], weight / plan.mass[-1]
        return plan.changed(time=time, speed=speed, mass=mass, values=values)

    def _followed(self, plan: Plan, at: dict[str, float]) -> Plan:
        """Return the plan along the measured motion, zero without contact."""
        values = np.maximum(plan.values - at.get("displacement_zero", 0.0), 0.0)
        before = self.clock < at.get(nuisances.CONTACT_TIME, -np.inf)
        return plan.changed(values=np.where(before, 0.0, values))

    def _sampled(self, values: Array) -> Array:
        """Return the mean over the instants that each sample averages, along the last axis."""
        values = values if self._own is None else values.take(self._own, axis=-1)
        if self._fine == 1:
            return values
        parts = [values[..., i :: self._fine] for i in range(self._fine)]  # faster than .mean()
        return np.asarray(sum(parts[1:], parts[0]) / self._fine)

    def _averaged(self, motion: Motion, contact: float) -> Motion:
        """Return a simulated motion at the times of the samples."""
        if not self._plain:
            moved, stress = self._sampled(motion.displacement), self._sampled(motion.base_stress)
            motion = replace(motion, displacement=moved, base_stress=stress)
        if self._earlier:
            of_cycle = motion.switches[:, 0] > self.clock[self._earlier - 1]
            motion = replace(motion, switches=motion.switches[of_cycle])
        if contact == 0.0:
            return motion
        switches = motion.switches.copy()
        switches[:, 0] += contact
        return replace(motion, switches=switches, contact_end=motion.contact_end + contact)

    def _late(self, name: str, rows: Array, late: float, column: int | None) -> Array:
        """Return curves, and in `column` their derivative by `late`, on the clock of the file."""
        by_stress = self.drive == "stress"
        simulated = self.drive == "impact" and name != "stress_strain"
        if simulated or (name in STRESSES) == by_stress:
            return rows

        def read(row: Array, late: float) -> Array:
            if by_stress:
                return curves.later(self.time, row, late)
            return np.interp(self.time + late, self.time, row)

        out = np.array([read(row, late) for row in rows])
        if column is not None:
            step = STEP_OF_TIME * float(np.median(np.diff(self.time)))
            before, after = (read(rows[0], late + side) for side in (-step, step))
            out[1 + column] = (after - before) / (2.0 * step)
        return out

    def _acceleration(
        self, motion: Motion, drag: float, at: dict[str, float], wanted: Wanted
    ) -> Array:
        """Return the deceleration of the striker, m/s², and its derivatives.

        By the equation of motion it is A (Σ_N + η_site/H dw/dt)/m; with interior masses it is the
        second derivative of the motion. An accelerometer does not measure gravity in free fall.
        """
        speed = np.gradient(_stacked(motion, -1), self.clock, axis=-1)
        if self.interior_mass:
            felt = -np.gradient(speed, self.clock, axis=-1)
            felt[0] += self._gravity
            return felt
        per_mass = self.measurement.specimen.area / at[nuisances.STRIKER_MASS]
        braked = np.where(self.clock < at[nuisances.CONTACT_TIME], 0.0, speed)
        pushed: Array = per_mass * (_stacked(motion) + drag * braked)
        for row in wanted.by_site:
            pushed[1 + row] += per_mass * braked[0]
        if (heavier := wanted.columns.get(nuisances.STRIKER_MASS)) is not None:
            pushed[1 + heavier] -= per_mass * pushed[0]  # by the areal mass
        return pushed


def channel_of(name: str) -> str:
    """Return the channel that a curve is compared with."""
    own = name.startswith("displacement") or name == curves.ACCELERATION
    return name.removesuffix("_time") if own else "stress"
