"""A scene prepared for repeated runs, and the choice of the simplest solver that suffices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.solve import cache, many, rates, relaxation
from foamfit.solve import scene as scenes
from foamfit.solve.any_law import AnyLawPlan, plan_of
from foamfit.solve.explicit import taylor
from foamfit.solve.implicit import steps
from foamfit.solve.scene import CLOSED_FORM as CLOSED_FORM
from foamfit.solve.scene import NO_SWITCHES, Slopes
from foamfit.solve.scene import Motion as Motion
from foamfit.springs import equilibrium, kernels
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.law import BISTABLE, LINEAR
from foamfit.springs.parameters import OWN_ETA, OWN_HEIGHT
from foamfit.springs.sensitivities import equilibrium_tangents
from foamfit.springs.spring import as_samples

Directions = NDArray[np.int64]

FIRST_ORDER, SECOND_ORDER = "first order", "second order"
TAYLOR, RADAU, AGGREGATE = "Taylor series", "Radau IIA", "aggregate"
MAX_STEPS = 2_000_000
# Implicit steps replace explicit ones above these limits.
MOST_RELAXATION = 1e4  # relaxation times in the duration of the scene
MOST_VIBRATION = 3e5  # radians of the fastest vibration in the duration
MOST_EXPLICIT = 200_000  # steps
MOST_EXPLICIT_WORK = 500_000  # steps times springs
# Bounds on steps times springs of any solver keep runs to seconds.
MOST_WORK = 1_500_000  # in addition to the samples of a drive
MOST_SAMPLED = 10_000_000  # in total
# Truncation of a step over the requested error. For explicit steps a small value is cheap: it only
# raises the order.
OF_MASSES = 1e-4  # with masses inside: switches amplify errors (500-fold over 56 switches)
OF_IMPACT = 1e-3  # other impacts
ALONG_DRIVE = 1e-4  # other drives
# Implicit steps.
OF_MASSES_IMPLICIT = 3e-2  # with masses inside
IMPLICIT = 3e-4  # without
# Aggregates.
AS_ONE = 1e-4  # divided by the number of springs, whose errors add up
LEAST_IMPLICIT = 1e-14  # least truncation of implicit steps, about the rounding error
MOST_IMPLICIT = 250_000  # implicit steps, at 0.5 ms each
LEAST_AGGREGATE = 9  # an impact treats at least this number of springs under one stress as one
LOGGED = 1024  # switches in the log of a first run; with more it is repeated

_TOO_FAST = (
    "springs with memory are followed by explicit steps, for which {culprit} is too fast: the "
    "scene lasts {rate:.2g} of its radians or relaxation times, too many for {steps} steps"
)
RADIANS = 3.0  # or relaxation times, that one explicit step covers at most
FEW_EXPLICIT = 20_000  # steps after which the total is estimated

NO_DIRECTIONS: Directions = np.empty((0, 2), np.int64)
_NOTHING = np.zeros(1)
# Tops under which springs start from rest, and that start.
_RESTING, _AT_REST = (scenes.FREE, scenes.VISCOUS), np.zeros((1, 0))
# Outcomes of explicit steps after which implicit ones are tried.
_STIFF = (scenes.TOO_MANY_STEPS, scenes.STEP_UNDERFLOW)


class Plan(NamedTuple):
    """A scene prepared to run many times with different springs.

    `ends`, `mass`, `drag`, `top`, `values`, `speed` and `time` are those of a `solve.scene.Scene`.
    """

    solver: str  #: the simplest that suffices
    height: float  #: H, m
    ends: NDArray[np.int64]
    mass: Array
    drag: float
    top: int
    values: Array
    time: Array
    speed: float
    margin: float  #: truncation of an explicit step over the requested error
    max_steps: int
    max_explicit: int  #: explicit steps before implicit ones are tried
    plain: bool = False  #: whether one mass bounces on springs, without any damping
    implicit: bool | None = None  #: whether steps are implicit; None: only in stiff scenes
    memory: bool = False  #: whether a spring remembers more than its branch
    #: unit of time, s, in which strains with memory change by about 1, so that the coefficients of
    #: their series neither over- nor underflow; a power of 2, which rounds nothing
    unit: float = 1.0

    @property
    def moves_one(self) -> bool:
        """Whether responses have a derivative by the prescribed motion: one spring with memory."""
        closed = self.solver == CLOSED_FORM and self.top == scenes.MOTION
        return closed and self.memory and self.mass.size == 1

    def run(
        self,
        rows: Array,
        heights: Array,
        rtol: float = 1e-6,
        *,
        drag: float | None = None,
        everything: bool = True,
        directions: Directions = NO_DIRECTIONS,
    ) -> Motion:
        """Run the scene with the springs in `rows` (n_springs, columns) and their heights (m).

        `drag` replaces the scene's own. If `everything` is false, the motion need only contain the
        base stress and the displacement of the top, (1, n_t). `directions` (p, 2) selects the
        derivatives; see `springs.parameters`. Raise SimulationError if the motion is not finite.
        """
        if self.solver == CLOSED_FORM:
            return self._closed_form(rows, heights, rtol, everything, directions)
        drag = self.drag if drag is None else drag
        given = rows, heights, rtol, drag, directions
        motion = self._integrated(*given, np.empty((LOGGED, 5)) if everything else NO_SWITCHES)
        if motion.method != AGGREGATE and len(motion.switches) > LOGGED:
            motion = self._integrated(*given, motion.switches)
        return motion

    def _integrated(
        self, rows: Array, heights: Array, rtol: float, drag: float, directions: Directions,
        log: Array,
    ) -> Motion:  # fmt: skip
        """Integrate in time and log the switches; without room, only the top is followed.

        If the log is too short, the switches are an array of the right length, not filled.
        """
        p, time, values = len(directions), self.time, self.values
        everything = log is not NO_SWITCHES
        out = np.empty((1 + p, 1 + len(heights) if everything else 2, time.size))
        if self.memory:
            return self._with_memory(self.packed(rows, heights, drag), rtol, directions, out, log)
        stiff = bool(self.implicit)
        if self.implicit is None and (drag or not self.plain):
            vibrates, relaxes = self.fastest_rates(rows, heights, drag)
            stiff = vibrates > MOST_VIBRATION or relaxes > MOST_RELAXATION
        one = self.speed > 0.0 and len(self.ends) == 1 and p == 0 and not stiff
        one = one and values[0] == 0.0  # the aggregate ignores gravity
        if one and len(heights) >= LEAST_AGGREGATE and many.holds(rows):
            cache.announce(many.integrate_aggregate, "the solver of many springs")
            tol, log = AS_ONE * rtol / len(rows), np.empty((4 * len(rows) + 64, 5))
            arguments = self.packed(rows, heights, drag), tol, self.max_steps, out[0], log
            ending = many.integrate_aggregate(*arguments, np.zeros(2, np.int64))
            return self._motion(rows, AGGREGATE, ending, out, log)
        start = _AT_REST if self.top in _RESTING else self._start(rows, heights, directions)
        if not stiff:
            cache.announce(taylor.integrate, "the solver")
            most = self.max_explicit if self.implicit is None else self.max_steps
            numbers = np.array((drag, self.top, self.speed, self.margin * rtol, most))
            ends, mass = self.ends, self.mass
            ending = taylor.integrate(
                rows, heights, ends, mass, numbers, values, time, directions, start, out, log
            )
            if self.implicit is False or ending[0] not in _STIFF:
                return self._motion(rows, TAYLOR, ending, out, log)
        margin = OF_MASSES_IMPLICIT if len(self.ends) > 1 else IMPLICIT
        scene = scenes.Scene(*self.packed(rows, heights, drag))
        tol = max(margin * rtol, LEAST_IMPLICIT)
        most = min(self.max_steps, MOST_IMPLICIT)
        samples = scenes.Samples(time, out[0], out[1:])
        *result, lost = steps.integrate_implicit(scene, tol, most, directions, start, samples, log)
        return self._motion(rows, RADAU, result, out, log, lost)

    def _with_memory(
        self, scene: scenes.SceneTuple, rtol: float, directions: Directions, out: Array, log: Array
    ) -> Motion:
        """Run springs with memory by explicit steps, which must follow even the fastest process."""
        start = _AT_REST
        if self.top not in _RESTING:
            start = self._start(scene[0], scene[1], directions)
        one_sided = np.zeros(len(directions))
        cache.announce(taylor.integrate_with_memory, "the solver of springs with memory")
        for most in (min(FEW_EXPLICIT, self.max_steps), self.max_steps):
            ending: Sequence[Any] = taylor.integrate_with_memory(
                scene, self.unit, self.margin * rtol, most, directions, start, out, log, one_sided
            )
            if ending[0] not in _STIFF:
                break
            rate, culprit = self._fastest(scene)
            too_fast = rate > RADIANS * self.max_steps
            if most == self.max_steps and ending[0] == scenes.TOO_MANY_STEPS:
                too_fast = RADIANS * rate > self.max_steps
            if too_fast:
                message = _TOO_FAST.format(culprit=culprit, rate=rate, steps=self.max_steps)
                raise SimulationError(message)
            if ending[0] == scenes.STEP_UNDERFLOW:  # more steps would not help
                break
        return self._motion(scene[0], TAYLOR, ending, out, log, one_sided=one_sided)

    def _fastest(self, scene: scenes.SceneTuple) -> tuple[float, str]:
        """Return the radians of the fastest process over the scene's duration, and its name."""
        rows, heights, drag, k = scene[0], scene[1], scene[4], kernels
        elastic, terms = np.zeros((len(rows), k.N_COLUMNS)), rows[:, k.N_COLUMNS :]
        bistable = rows[:, k.KIND] == BISTABLE
        steep = np.where(bistable, np.maximum(rows[:, k.KH_PLUS], rows[:, k.KC]), rows[:, k.KC])
        elastic[:, k.KIND], elastic[:, k.ETA] = LINEAR, rows[:, k.ETA]
        elastic[:, k.K0] = np.maximum(rows[:, k.K0], steep) * (1.0 + terms[:, ::2].sum(axis=1))
        swings, decays = self.fastest_rates(elastic, heights, drag)
        processes = [(swings, "a light mass"), (decays, "a light mass or a dashpot")]
        for i, term in zip(*np.nonzero(terms[:, ::2]), strict=True):
            tau = terms[i, 2 * term + 1]
            name = f"the relaxation of spring {i + 1} (s{i + 1}_tau{term + 1} = {tau:g} s)"
            processes.append((self._duration / tau, name))
        return max(processes)

    def _closed_form(
        self, rows: Array, heights: Array, rtol: float, everything: bool, directions: Directions
    ) -> Motion:
        """Solve springs in static equilibrium under one stress, or one spring in known motion."""
        moved, wanted, n = self.top == scenes.MOTION, len(directions) > 0, self.time.size
        alone, top, fine = moved and len(heights) == 1, np.array(self.values), True
        slopes: Slopes | None = None
        if alone:
            strain = (self.values / heights)[None, :]
            if self.memory or wanted:
                history = strain[0], self.time, heights[0], rtol, directions
                stress, branch, tangents = relaxation.stress_along(rows[0], *history)
                slopes = Slopes(np.zeros((len(directions), 1, n)), tangents) if wanted else None
            else:
                stress, branch = kernels.stress_along(rows[0], strain[0])
            branches = branch[None, :]
        else:
            kept = len(heights) if moved or everything or wanted else 0
            strain, branches = np.empty((kept, n)), np.empty((kept, n), np.int64)
            if moved:
                stress = np.empty(n)
                equilibrium.equilibrium_along(rows, heights, top, stress, strain, branches)
                miss = np.abs(heights @ strain - top).max()
                fine = miss <= 1e-9 * (self.height + np.abs(top).max())
            else:
                stress, top = top, np.empty(n)
                fine = equilibrium.strains_along(rows, heights, stress, top, strain, branches)
            if wanted and fine:
                along = rows, heights, stress, strain, branches
                slopes = Slopes(*equilibrium_tangents(*along, moved, directions))
                if moved:
                    one_sided = _on_one_plateau(rows, branches, directions)
                    slopes = slopes._replace(one_sided=one_sided)
        eta = rows[0, kernels.ETA]
        by_dashpot = wanted and not {OWN_ETA, OWN_HEIGHT}.isdisjoint(directions[:, 1].tolist())
        if alone and n > 1 and (by_dashpot or eta > 0.0):
            rate = np.gradient(strain[0], self.time)
            stress = stress + eta * rate
            for p, (_, what) in enumerate(directions):
                if slopes is not None and what == OWN_ETA:
                    slopes.base_stress[p] += rate
                elif slopes is not None and what == OWN_HEIGHT:
                    slopes.base_stress[p] -= eta * rate / heights[0]
        if not (fine and math.isfinite(kernels.total(stress))):
            raise scenes.failure(scenes.NOT_FINITE, self.top, self.values, rows)
        if not everything:
            if slopes is not None:
                slopes = slopes._replace(displacement=slopes.displacement[:, -1:])
            return Motion(top[None, :], stress, math.nan, NO_SWITCHES, 0, CLOSED_FORM, slopes)
        nodes = heights[:, None] * strain
        for i in range(1, len(nodes)):  # np.cumsum takes six times as long
            nodes[i] += nodes[i - 1]
        switches = kernels.list_switches(self.time, strain, branches)
        return Motion(nodes, stress, math.nan, switches, 0, CLOSED_FORM, slopes)

    def _start(self, rows: Array, heights: Array, directions: Directions) -> Array:
        """Return strains in equilibrium with the first sample, and derivatives, (1 + p, springs).

        Under a prescribed stress, springs with a dashpot start from rest.
        """
        start = np.zeros((1 + len(directions), len(heights)))
        first = self.ends[-2] if len(self.ends) > 1 else 0
        rows, heights, moved = rows[first:], heights[first:], self.top == scenes.MOTION
        stress, count = self.values[:1].copy(), len(heights)
        strain, branches = np.empty((count, 1)), np.empty((count, 1), np.int64)
        held = (rows[:, kernels.ETA] > 0.0) & (not moved)  # by a dashpot
        if moved:
            equilibrium.equilibrium_along(rows, heights, self.values[:1], stress, strain, branches)
        else:
            equilibrium.strains_along(rows, heights, stress, np.empty(1), strain, branches)
            strain[held] = 0.0
        if not np.isfinite(strain).all():
            raise scenes.failure(scenes.NOT_FINITE, self.top, self.values, rows)
        start[0, first:] = strain[:, 0]
        own = np.flatnonzero(directions[:, 0] >= first)
        if len(own):
            local = directions[own] - np.array([first, 0])
            above, _ = equilibrium_tangents(rows, heights, stress, strain, branches, moved, local)
            longer = np.diff(above[:, :, 0], axis=1, prepend=0.0)
            for p, (spring, what) in enumerate(local):
                longer[p, spring] -= strain[spring, 0] if what == OWN_HEIGHT else 0.0
            start[1 + own, first:] = np.where(held, 0.0, longer / heights)
        return start

    def _motion(
        self,
        rows: Array,
        method: str,
        ending: Sequence[Any],
        out: Array,
        log: Array,
        lost: float = 0.0,
        one_sided: Array = _NOTHING[:0],
    ) -> Motion:
        """Return the result of an integrator as a Motion; raise SimulationError if it failed."""
        outcome, time, steps, switches = ending
        if outcome != scenes.DONE:
            raise scenes.failure(outcome, self.top, self.values, rows, steps=steps, time=time)
        slopes = Slopes(out[1:, 1:], out[1:, 0], one_sided) if len(out) > 1 else None
        if log is not NO_SWITCHES:
            log = log[:switches] if switches <= len(log) else np.empty((switches, 5))
        return Motion(out[0, 1:], out[0, 0], time, log, steps, method, slopes, lost)

    @property
    def _duration(self) -> float:
        return float(self.time[-1] - (0.0 if self.speed > 0.0 else self.time[0]))

    def packed(self, rows: Array, heights: Array, drag: float | None = None) -> scenes.SceneTuple:
        """Return the scene with these springs (and onsite damping) for compiled integrators."""
        drag = self.drag if drag is None else drag
        motion = self.top, self.values, self.speed, self.time
        return (rows, heights, self.ends, self.mass, drag, *motion)

    def fastest_rates(self, rows: Array, heights: Array, drag: float) -> tuple[float, float]:
        """Return the radians of vibration and relaxation that explicit steps would cover."""
        chain = rows, heights, self.ends, self.mass, drag, self.top
        return rates.fastest_rates(*chain, self.speed > 0.0, self._duration)


AnyPlan = Plan | AnyLawPlan


def _on_one_plateau(rows: Array, branches: NDArray[np.int64], directions: Directions) -> Array:
    """Mark directions of springs that were on flat branches together: either may move first."""
    flat = (branches == kernels.D) & (rows[:, kernels.KH_PLUS] == 0.0)[:, None]
    flat |= (branches == kernels.E) & (rows[:, kernels.KH_MINUS] == 0.0)[:, None]
    together = (flat & (flat.sum(axis=0) > 1)).any(axis=1)
    marked = np.isin(directions[:, 1], (0, 2, 3)) & (directions[:, 0] >= 0)  # k0, dsigma, eps_a
    return np.where(marked, together[directions[:, 0]], 0.0)


def _time(t: ArrayLike) -> Array:
    time = as_samples(t, "t")  # a writable copy, for which the loops are compiled
    if time.ndim != 1 or time.size == 0:
        raise InputError("t must be a one-dimensional array with at least one sample")
    at = kernels.fault(time)
    if at >= 0:
        what = "later than the one before it" if math.isfinite(time[at]) else "finite"
        raise InputError(f"t must be finite and increase; sample {at} is not {what}")
    return time


def plan(
    chain: Chain,
    drive: Drive,
    t: ArrayLike,
    *,
    dashpots: bool = False,
    relaxing: bool = False,
    max_steps: int = MAX_STEPS,
) -> AnyPlan:
    """Prepare a scene: find the nodes that have a state, and the simplest solver.

    The plan depends on the heights, area, masses and site damping of the chain, and on which
    springs have a dashpot, relaxation terms or a memory. `t` (n_t,) are the sample times, s.
    `dashpots` allows for a dashpot in every spring and `relaxing` for the relaxation terms, even if
    they are zero. Steps are bounded by `max_steps`, and steps times springs by `MOST_WORK`. Raise
    InputError if times do not increase or do not match the drive.
    """
    time = _time(t)
    speed, values, top, above = 0.0, _NOTHING, scenes.FREE, chain.masses[-1]
    if isinstance(drive, Impact):
        speed = drive.velocity
        above += drive.mass
        if drive.gravity:
            values = np.array([above * drive.gravity / chain.area])
    else:
        name = "stress" if isinstance(drive, StressDrive) else "displacement"
        values = np.array(getattr(drive, name))
        if values.size != time.size:
            raise InputError(
                f"{name} has {values.size} samples and t has {time.size}: give one value per sample"
            )
        if isinstance(drive, DisplacementDrive):
            above, top = 0.0, scenes.MOTION
        elif above == 0.0:
            top = scenes.VISCOUS if chain.site_damping > 0.0 else scenes.STRESS
    if chain.is_registered:
        return plan_of(chain, time, top, values, speed, above)
    arrays, count = chain.arrays, len(chain.springs)
    ends, masses = arrays.top, np.array([above / chain.area])
    if arrays.heavy:
        inside = np.flatnonzero(arrays.masses[:-1] > 0.0)
        ends = np.append(inside + 1, ends)
        masses = np.append(arrays.masses[inside] / chain.area, masses)
    relaxing |= chain.relaxes
    memory = relaxing or chain.remembers
    alone = top == scenes.MOTION and count == 1
    damped = dashpots or arrays.damped or top == scenes.VISCOUS
    if arrays.heavy or above > 0.0:
        solver = SECOND_ORDER
    elif (damped or relaxing) and not alone:
        solver = FIRST_ORDER
    else:
        solver = CLOSED_FORM
    margin = OF_MASSES if arrays.heavy else OF_IMPACT if speed > 0.0 else ALONG_DRIVE
    most = MOST_WORK // count + 2 * time.size + 8 * count
    most = max(1, min(max_steps, most, MOST_SAMPLED // count))
    explicit = min(most, 20 * time.size + min(MOST_EXPLICIT, MOST_EXPLICIT_WORK // count))
    plain = speed > 0.0 and not (arrays.heavy or damped or chain.site_damping > 0.0)
    unit = _unit(chain, drive, time) if memory else 1.0
    drag = chain.site_damping / chain.height
    return Plan(  # positional, as keywords would take 10 % of the time
        solver, chain.height, ends, masses, drag, top, values, time, speed,
        margin, most, explicit, plain, None, memory, unit,
    )  # fmt: skip


def _unit(chain: Chain, drive: Drive, time: Array) -> float:
    """Return the unit of time of a `Plan`, s."""
    least, softest = min(chain.heights), min(spring.k0 for spring in chain.springs)
    if isinstance(drive, Impact):
        rate = drive.velocity / least
    else:
        values = (
            drive.stress / softest if isinstance(drive, StressDrive) else drive.displacement / least
        )
        rate = float(np.abs(np.diff(values) / np.diff(time)).max(initial=0.0))
    return 2.0 ** -round(math.log2(rate)) if 1e-100 < rate < 1e100 else 1.0
