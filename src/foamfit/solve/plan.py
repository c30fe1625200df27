"""A scene made ready, and its motion by the least solver that it needs."""

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
# Explicit steps are given up where something relaxes, or vibrates, so many times (in radians) while
# the scene lasts, or after so many steps.
MOST_RELAXATION, MOST_VIBRATION, MOST_EXPLICIT = 1e4, 3e5, 200_000
# Bounds on steps times springs (seconds, not hours): for all but the samples of a drive, before
# explicit steps are given up, and for everything.
MOST_WORK, MOST_EXPLICIT_WORK, MOST_SAMPLED = 1_500_000, 500_000, 10_000_000
# Truncation of a step over the wanted error: of explicit steps with masses inside, where every
# switch makes errors grow (five hundredfold over 56 of them), in any other impact and along a
# drive; a margin costs little, since the order grows with it. Of implicit steps with masses inside
# and without; of springs that count as one, whose errors add up.
OF_MASSES, OF_IMPACT, ALONG_DRIVE = 1e-4, 1e-3, 1e-4
OF_MASSES_IMPLICIT, IMPLICIT, AS_ONE = 3e-2, 3e-4, 1e-4
# Least truncation of implicit steps: less is rounding. The most of them: each takes half a
# millisecond.
LEAST_IMPLICIT, MOST_IMPLICIT = 1e-14, 250_000
# From so many springs on, those that carry one stress in an impact count as one.
LEAST_AGGREGATE = 9
# Switches that are kept, of springs that do not count as one.
LOGGED = 1024

_OUTCOMES = {
    scenes.TOO_MANY_STEPS: "the bound of {steps} steps was reached: something in the scene is "
    "too fast to be followed (a light mass or a heavy dashpot)",
    scenes.STEP_UNDERFLOW: "the step shrank to nothing near t = {time:g} s: there the scene "
    "changes faster than numbers can tell (a strain at the end of its branch, a very light mass, "
    "or many springs on a flat branch)",
    scenes.FLAT_UNDER_STRESS: "a prescribed stress acts on a flat branch (kh_plus or kh_minus = 0) "
    "that nothing slows; give the top a mass or the spring a dashpot",
    scenes.NOT_FINITE: "a stress or strain is no longer finite: the drive goes past the end of a "
    "branch (strain 1 on branch a, 1 + eps_star on branch c)",
}


_TOO_FAST = (
    "springs with memory are followed by explicit steps, for which {culprit} is too fast: the "
    "scene lasts {rate:.2g} of its radians or relaxation times, and has at most {steps} steps"
)
# Radians, or relaxation times, that one explicit step goes through at most; steps after which it
# is asked how many it takes.
RADIANS, FEW_EXPLICIT = 3.0, 20_000

NO_DIRECTIONS: Directions = np.empty((0, 2), np.int64)
_NOTHING = np.zeros(1)
# Tops under which springs start from rest, and what they start from.
_RESTING, _AT_REST = (scenes.FREE, scenes.VISCOUS), np.zeros((1, 0))
# Outcomes of explicit steps after which implicit ones are tried.
_STIFF = (scenes.TOO_MANY_STEPS, scenes.STEP_UNDERFLOW)


class Plan(NamedTuple):
    """A scene made ready to run many times with other springs: what does not change between runs.

    `solver` is the least solver, `height` H, m. `ends`, `mass`, `drag`, `top`, `values`, `speed`
    and `time` are those of a `solve.scene.Scene`. `margin` is the truncation of an explicit step
    over the wanted error, `max_steps` bounds steps, `max_explicit` those that implicit ones may
    take over from. `plain` says that one mass bounces once, without dashpot, damper, or mass
    inside; `implicit` whether to take implicit steps (None: where explicit ones are the wrong
    tool); `memory` whether a spring keeps more than its branch. `unit` is a time, s, in which
    springs with memory are strained by about 1: in it the coefficients of their series stay
    numbers; a power of 2 costs no digit.
    """

    solver: str
    height: float
    ends: NDArray[np.int64]
    mass: Array
    drag: float
    top: int
    values: Array
    time: Array
    speed: float
    margin: float
    max_steps: int
    max_explicit: int
    plain: bool = False
    implicit: bool | None = None
    memory: bool = False
    unit: float = 1.0

    @property
    def moves_one(self) -> bool:
        """Whether a known motion drives one spring with memory, which has a derivative by it."""
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

        `drag` replaces the scene's own. With `everything` false only the base stress and the
        displacement of the top, shape (1, n_t), are sure to be there. `directions` (p, 2) are those
        of the derivatives to carry along; see `springs.parameters`. A scene without a finite answer
        is refused (SimulationError).
        """
        if self.solver == CLOSED_FORM:
            return self._closed_form(rows, heights, rtol, everything, directions)
        p, time, values = len(directions), self.time, self.values
        drag = self.drag if drag is None else drag
        out = np.empty((1 + p, 1 + len(heights) if everything else 2, time.size))
        log = np.empty((LOGGED, 5)) if everything else NO_SWITCHES
        if self.memory:
            return self._remembered(self.given(rows, heights, drag), rtol, directions, out, log)
        stiff = bool(self.implicit)
        if self.implicit is None and (drag or not self.plain):
            vibrates, relaxes = self.fastest_rates(rows, heights, drag)
            stiff = vibrates > MOST_VIBRATION or relaxes > MOST_RELAXATION
        one = self.speed > 0.0 and len(self.ends) == 1 and p == 0 and not stiff
        one = one and values[0] == 0.0  # springs that count as one know no weight
        if one and len(heights) >= LEAST_AGGREGATE and many.holds(rows):
            cache.announce(many.integrate_aggregate, "the solver of many springs")
            tol, log = AS_ONE * rtol / len(rows), np.empty((4 * len(rows) + 64, 5))
            given = self.given(rows, heights, drag), tol, self.max_steps
            ending = many.integrate_aggregate(*given, out[0], log, np.zeros(2, np.int64))
            return _motion(AGGREGATE, ending, out, log)
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
                return _motion(TAYLOR, ending, out, log)
        margin = OF_MASSES_IMPLICIT if len(self.ends) > 1 else IMPLICIT
        scene = scenes.Scene(*self.given(rows, heights, drag))
        tol = max(margin * rtol, LEAST_IMPLICIT)
        most = min(self.max_steps, MOST_IMPLICIT)
        samples = scenes.Samples(time, out[0], out[1:])
        *found, lost = steps.integrate_implicit(scene, tol, most, directions, start, samples, log)
        return _motion(RADAU, found, out, log, lost)

    def _remembered(
        self, given: scenes.SceneTuple, rtol: float, directions: Directions, out: Array, log: Array
    ) -> Motion:
        """Springs with memory: by explicit steps, which must follow all that is fast."""
        start = _AT_REST
        if self.top not in _RESTING:
            start = self._start(given[0], given[1], directions)
        one_sided = np.zeros(len(directions))
        cache.announce(taylor.integrate_with_memory, "the solver of springs with memory")
        for most in (min(FEW_EXPLICIT, self.max_steps), self.max_steps):
            ending: Sequence[Any] = taylor.integrate_with_memory(
                given, self.unit, self.margin * rtol, most, directions, start, out, log, one_sided
            )
            if ending[0] not in _STIFF:
                break
            rate, culprit = self._fastest(given)
            too_fast = rate > RADIANS * self.max_steps
            if most == self.max_steps and ending[0] == scenes.TOO_MANY_STEPS:
                too_fast = RADIANS * rate > self.max_steps
            if too_fast:
                message = _TOO_FAST.format(culprit=culprit, rate=rate, steps=self.max_steps)
                raise SimulationError(message)
            if ending[0] == scenes.STEP_UNDERFLOW:  # more steps would end there too
                break
        return _motion(TAYLOR, ending, out, log, one_sided=one_sided)

    def _fastest(self, given: scenes.SceneTuple) -> tuple[float, str]:
        """What of springs with memory is fastest, in radians while the scene lasts; its name."""
        rows, heights, drag, k = given[0], given[1], given[4], kernels
        elastic, terms = np.zeros((len(rows), k.N_COLUMNS)), rows[:, k.N_COLUMNS :]
        bistable = rows[:, k.KIND] == BISTABLE
        steep = np.where(bistable, np.maximum(rows[:, k.KH_PLUS], rows[:, k.KC]), rows[:, k.KC])
        elastic[:, k.KIND], elastic[:, k.ETA] = LINEAR, rows[:, k.ETA]
        elastic[:, k.K0] = np.maximum(rows[:, k.K0], steep) * (1.0 + terms[:, ::2].sum(axis=1))
        swings, decays = self.fastest_rates(elastic, heights, drag)
        found = [(swings, "a light mass"), (decays, "a light mass or a dashpot")]
        for i, term in zip(*np.nonzero(terms[:, ::2]), strict=True):
            tau = terms[i, 2 * term + 1]
            name = f"the relaxation of spring {i + 1} (s{i + 1}_tau{term + 1} = {tau:g} s)"
            found.append((self._lasts / tau, name))
        return max(found)

    def _closed_form(
        self, rows: Array, heights: Array, rtol: float, everything: bool, directions: Directions
    ) -> Motion:
        """Undamped and massless: one stress in all springs; or one spring under known motion."""
        moved, wanted, n = self.top == scenes.MOTION, len(directions) > 0, self.time.size
        alone, top, fine = moved and len(heights) == 1, np.array(self.values), True
        slopes: Slopes | None = None
        if alone:
            strain = (self.values / heights)[None, :]
            if self.memory or wanted:
                history = strain[0], self.time, heights[0], rtol, directions
                stress, seen, pressed = relaxation.stress_along(rows[0], *history)
                slopes = Slopes(np.zeros((len(directions), 1, n)), pressed) if wanted else None
            else:
                stress, seen = kernels.stress_along(rows[0], strain[0])
            branches = seen[None, :]
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
        felt = wanted and not {OWN_ETA, OWN_HEIGHT}.isdisjoint(directions[:, 1].tolist())
        if alone and n > 1 and (felt or eta > 0.0):
            rate = np.gradient(strain[0], self.time)
            stress = stress + eta * rate
            for p, (_, what) in enumerate(directions):
                if slopes is not None and what == OWN_ETA:
                    slopes.base_stress[p] += rate
                elif slopes is not None and what == OWN_HEIGHT:
                    slopes.base_stress[p] -= eta * rate / heights[0]
        if not (fine and math.isfinite(kernels.total(stress))):
            raise SimulationError(_OUTCOMES[scenes.NOT_FINITE])
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
        """Strains (1 + p, springs) in equilibrium with the first sample, and their derivatives.

        Under a stress, a spring that a dashpot holds starts from rest.
        """
        start = np.zeros((1 + len(directions), len(heights)))
        first = self.ends[-2] if len(self.ends) > 1 else 0
        rows, heights, moved = rows[first:], heights[first:], self.top == scenes.MOTION
        stress, count = self.values[:1].copy(), len(heights)
        strain, branches = np.empty((count, 1)), np.empty((count, 1), np.int64)
        held = (rows[:, kernels.ETA] > 0.0) & (not moved)  # a dashpot holds its spring where it is
        if moved:
            equilibrium.equilibrium_along(rows, heights, self.values[:1], stress, strain, branches)
        else:
            equilibrium.strains_along(rows, heights, stress, np.empty(1), strain, branches)
            strain[held] = 0.0
        if not np.isfinite(strain).all():
            raise SimulationError(_OUTCOMES[scenes.NOT_FINITE])
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

    @property
    def _lasts(self) -> float:
        """Duration, s."""
        return float(self.time[-1] - (0.0 if self.speed > 0.0 else self.time[0]))

    def given(self, rows: Array, heights: Array, drag: float | None = None) -> scenes.SceneTuple:
        """The scene with these springs (and onsite damping) as the compiled integrators take it."""
        drag = self.drag if drag is None else drag
        motion = self.top, self.values, self.speed, self.time
        return (rows, heights, self.ends, self.mass, drag, *motion)

    def fastest_rates(self, rows: Array, heights: Array, drag: float) -> tuple[float, float]:
        """Vibration and relaxation (radians) that explicit steps would have to go through."""
        chain = rows, heights, self.ends, self.mass, drag, self.top
        return rates.fastest_rates(*chain, self.speed > 0.0, self._lasts)


AnyPlan = Plan | AnyLawPlan


def _on_one_plateau(rows: Array, branches: NDArray[np.int64], directions: Directions) -> Array:
    """Mark the directions of springs that were on flat branches together: either may go first."""
    flat = (branches == kernels.D) & (rows[:, kernels.KH_PLUS] == 0.0)[:, None]
    flat |= (branches == kernels.E) & (rows[:, kernels.KH_MINUS] == 0.0)[:, None]
    together = (flat & (flat.sum(axis=0) > 1)).any(axis=1)
    height = np.isin(directions[:, 1], (0, 2, 3))  # k0, dsigma, eps_a
    return np.where(height & (directions[:, 0] >= 0), together[directions[:, 0]], False).astype(
        float
    )


def _motion(
    method: str,
    ending: Sequence[Any],
    out: Array,
    log: Array,
    lost: float = 0.0,
    one_sided: Array = _NOTHING[:0],
) -> Motion:
    """Gather what an integrator found, or say why it found nothing."""
    outcome, time, steps, switches = ending
    if outcome != scenes.DONE:
        raise SimulationError(_OUTCOMES[outcome].format(steps=steps, time=time))
    slopes = Slopes(out[1:, 1:], out[1:, 0], one_sided) if len(out) > 1 else None
    seen = log if log is NO_SWITCHES else log[:switches]
    return Motion(out[0, 1:], out[0, 0], time, seen, steps, method, slopes, lost)


def _time(t: ArrayLike) -> Array:
    time = as_samples(t, "t")  # a copy of one compiled type: writable
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
    """Find what a scene needs: the nodes that have a state, and the least solver.

    Of the chain only its heights, area, masses, site damping and which springs have a dashpot,
    relaxation terms or a memory count. `t` (n_t,) are samples, s. `dashpots` and `relaxing` say to
    reckon with a dashpot in every spring, and with the relaxation terms that there are, also where
    they are zero. `max_steps` bounds steps; there are other bounds on steps times springs. A time
    that does not increase, or does not fit the drive, is refused (InputError).
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
    return Plan(  # without names, which take a tenth of the time of a plan
        solver, chain.height, ends, masses, drag, top, values, time, speed,
        margin, most, explicit, plain, None, memory, unit,
    )  # fmt: skip


def _unit(chain: Chain, drive: Drive, time: Array) -> float:
    """Find the unit of time of a `Plan`, s."""
    least, softest = min(chain.heights), min(spring.k0 for spring in chain.springs)
    if isinstance(drive, Impact):
        rate = drive.velocity / least
    else:
        values = (
            drive.stress / softest if isinstance(drive, StressDrive) else drive.displacement / least
        )
        rate = float(np.abs(np.diff(values) / np.diff(time)).max(initial=0.0))
    return 2.0 ** -round(math.log2(rate)) if 1e-100 < rate < 1e100 else 1.0
