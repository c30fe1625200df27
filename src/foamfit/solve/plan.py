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

    Attributes
    ----------
    solver : str
        The least solver.
    height : float
        H, m.
    ends, mass : arrays
        The groups of springs and the areal masses between them; see `solve.scene.Scene`.
    drag : float
        η_site/H, Pa·s/m.
    top : int
        What is known of the top; see `solve.scene`.
    values, time : (n,) arrays
        The drive and its samples; of an impact, values (1,) is the weight of the striker, Pa.
    speed : float
        Velocity of the striker, m/s; 0 = no impact.
    margin : float
        Truncation of an explicit step over the wanted error.
    max_steps, max_explicit : int
        Bounds on steps, and on explicit ones that implicit ones may take over from.
    plain : bool
        Whether one mass bounces once: it has neither dashpot nor damper, nor a mass inside.
    implicit : bool or None
        Whether to take implicit steps; None = where explicit ones are the wrong tool.
    memory : bool
        Whether a spring keeps more than its branch: microscale springs and relaxation.
    unit : float
        Time, s, in which springs with memory are strained by about 1: in it the coefficients of
        their series stay numbers. A power of 2, which costs no digit.
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
        of the derivatives to carry along; see `springs.parameters`.

        Raises
        ------
        SimulationError
            If the scene has no finite answer; the message says why.
        """
        if self.solver == CLOSED_FORM:
            return self._closed_form(rows, heights, rtol, everything, directions)
        p, time = len(directions), self.time
        out = np.empty((1 + p, 1 + len(heights) if everything else 2, time.size))
        log = np.empty((LOGGED, 5)) if everything else NO_SWITCHES
        if self.memory:
            return self._remembered(self.given(rows, heights, drag), rtol, directions, out, log)
        drag = self.drag if drag is None else drag
        bounces = self.plain and not drag and self.implicit is None
        stiff = not bounces and self._is_stiff(self.given(rows, heights, drag))
        one = self.speed > 0.0 and self.top == scenes.FREE and len(self.ends) == 1
        one = one and p == 0 and not stiff and len(heights) >= LEAST_AGGREGATE
        one = one and self.values[0] == 0.0  # springs that count as one know no weight
        if one and many.holds(rows):
            return self._aggregate(self.given(rows, heights, drag), rtol, out)
        start = _AT_REST if self.top in _RESTING else self._start(rows, heights, directions)
        if not stiff:
            cache.announce(taylor.integrate, "the solver")
            most = self.max_explicit if self.implicit is None else self.max_steps
            ending: Sequence[Any] = taylor.integrate(
                rows,
                heights,
                self.ends,
                self.mass,
                np.array((drag, self.top, self.speed, self.margin * rtol, most)),
                self.values,
                time,
                directions,
                start,
                out,
                log,
            )
            if self.implicit is False or ending[0] not in _STIFF:
                return _motion(TAYLOR, ending, out, log)
        margin = OF_MASSES_IMPLICIT if len(self.ends) > 1 else IMPLICIT
        scene, tol = (
            scenes.Scene(*self.given(rows, heights, drag)),
            max(margin * rtol, LEAST_IMPLICIT),
        )
        most = min(self.max_steps, MOST_IMPLICIT)
        samples = scenes.Samples(time, out[0], out[1:])
        *ending, lost = steps.integrate_implicit(scene, tol, most, directions, start, samples, log)
        return _motion(RADAU, ending, out, log, lost)

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
        rows, heights, k = given[0], given[1], kernels
        elastic, terms = np.zeros((len(rows), k.N_COLUMNS)), rows[:, k.N_COLUMNS :]
        bistable = rows[:, k.KIND] == BISTABLE
        steep = np.where(bistable, np.maximum(rows[:, k.KH_PLUS], rows[:, k.KC]), rows[:, k.KC])
        elastic[:, k.KIND], elastic[:, k.ETA] = LINEAR, rows[:, k.ETA]
        elastic[:, k.K0] = np.maximum(rows[:, k.K0], steep) * (1.0 + terms[:, ::2].sum(axis=1))
        swings, decays = rates.fastest_rates((elastic, heights, *given[2:]))
        found = [(swings, "a light mass"), (decays, "a light mass or a dashpot")]
        lasts = float(given[8][-1] - (0.0 if self.speed > 0.0 else given[8][0]))
        for i, term in zip(*np.nonzero(terms[:, ::2]), strict=True):
            tau = terms[i, 2 * term + 1]
            name = f"the relaxation of spring {i + 1} (s{i + 1}_tau{term + 1} = {tau:g} s)"
            found.append((lasts / tau, name))
        return max(found)

    def given(self, rows: Array, heights: Array, drag: float | None = None) -> scenes.SceneTuple:
        """The scene with these springs (and onsite damping) as the compiled integrators take it."""
        return (
            rows, heights, self.ends, self.mass, self.drag if drag is None else drag, self.top,
            self.values, self.speed, self.time,
        )  # fmt: skip

    def _closed_form(
        self, rows: Array, heights: Array, rtol: float, everything: bool, directions: Directions
    ) -> Motion:
        """Undamped and massless: one stress in all springs; or one spring under known motion."""
        moved, wanted = self.top == scenes.MOTION, everything or len(directions) > 0
        slopes: Slopes | None = None
        if self.memory and moved and len(heights) == 1:
            top, fine = np.array(self.values), True
            strain = (self.values / heights)[None, :]
            stress, seen, pressed = relaxation.stress_along(
                rows[0], strain[0], self.time, heights[0], rtol, directions
            )
            branches = seen[None, :]
            if len(directions):
                slopes = Slopes(np.zeros((len(directions), 1, stress.size)), pressed)
        elif moved:
            top = np.array(self.values)
            stress, strain, branches = self._stretched(rows, heights)
            fine = True
        else:
            stress, top = np.array(self.values), np.empty(self.time.size)
            strain, branches = _new_history(len(heights) if wanted else 0, self.time.size)
            fine = equilibrium.strains_along(rows, heights, stress, top, strain, branches)
        if len(directions) and slopes is None:
            slopes = Slopes(
                *equilibrium_tangents(rows, heights, stress, strain, branches, moved, directions),
                _on_one_plateau(rows, branches, directions) if moved else _NOTHING[:0],
            )
        eta = rows[0, kernels.ETA]
        damped = eta > 0.0
        if len(directions):
            damped |= bool(np.isin(directions[:, 1], (OWN_ETA, OWN_HEIGHT)).any())
        if moved and len(heights) == 1 and stress.size > 1 and damped:
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

    def _stretched(self, rows: Array, heights: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Stress, strains and branches under a known motion."""
        count, n = len(heights), self.time.size
        if count == 1:
            strain = self.values / heights
            stress, history = kernels.stress_along(rows[0], strain)
            return stress, strain[None, :], history[None, :]
        stress = np.empty(n)
        strain, branches = _new_history(count, n)
        equilibrium.equilibrium_along(rows, heights, self.values, stress, strain, branches)
        miss = np.abs(heights @ strain - self.values).max()
        if not miss <= 1e-9 * (self.height + np.abs(self.values).max()):
            raise SimulationError(_OUTCOMES[scenes.NOT_FINITE])
        return stress, strain, branches

    def _aggregate(self, given: scenes.SceneTuple, rtol: float, out: Array) -> Motion:
        """Springs under one stress count as one: one step to a switch."""
        count = len(given[0])
        log, tolerance = np.empty((4 * count + 64, 5)), AS_ONE * rtol / count
        cache.announce(many.integrate_aggregate, "the solver of many springs")
        ending = many.integrate_aggregate(
            given, tolerance, self.max_steps, out[0], log, np.zeros(2, np.int64)
        )
        return _motion(AGGREGATE, ending, out, log)

    def _start(self, rows: Array, heights: Array, directions: Directions) -> Array:
        """Strains (1 + p, springs) in equilibrium with the first sample, and their derivatives.

        Under a stress, a spring that a dashpot holds starts from rest.
        """
        start = np.zeros((1 + len(directions), len(heights)))
        first = self.ends[-2] if len(self.ends) > 1 else 0
        rows, heights, moved = rows[first:], heights[first:], self.top == scenes.MOTION
        stress, (strain, branches) = self.values[:1].copy(), _new_history(len(heights), 1)
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

    def fastest_rates(self, rows: Array, heights: Array) -> tuple[float, float]:
        """Vibration and relaxation (radians) that explicit steps would have to go through."""
        return rates.fastest_rates(self.given(rows, heights))

    def _is_stiff(self, given: scenes.SceneTuple) -> bool:
        """Whether explicit steps would have to follow rates that have long died out."""
        if self.implicit is not None:
            return self.implicit
        vibrates, relaxes = rates.fastest_rates(given)
        return bool(vibrates > MOST_VIBRATION or relaxes > MOST_RELAXATION)


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


def _new_history(count: int, n: int) -> tuple[Array, NDArray[np.int64]]:
    """Empty arrays for the strains and branches of springs along a history."""
    return np.empty((count, n)), np.empty((count, n), np.int64)


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

    Parameters
    ----------
    chain : Chain
        Only its heights, area, masses, site damping and which springs have a dashpot,
        relaxation terms or the microscale law count.
    drive : Impact, StressDrive or DisplacementDrive
        How it is loaded.
    t : (n_t,) array
        Samples, s, increasing.
    dashpots : bool
        Whether to reckon with a dashpot in every spring, also where it is zero.
    relaxing : bool
        Whether to reckon with the relaxation terms that there are, also where they are zero.
    max_steps : int
        Bound on steps; there are others on steps times springs.

    Raises
    ------
    ValueError
        If t does not increase or has not one value per sample of the drive.
    """
    time = _time(t)
    speed, values, top = 0.0, _NOTHING, scenes.FREE
    if isinstance(drive, Impact):
        speed = drive.velocity
    else:
        name = "stress" if isinstance(drive, StressDrive) else "displacement"
        values = np.array(getattr(drive, name))
        if values.size != time.size:
            raise InputError(
                f"{name} has {values.size} samples and t has {time.size}: give one value per sample"
            )
    above = chain.masses[-1]
    if isinstance(drive, Impact):
        above += drive.mass
        values = np.array([above * drive.gravity / chain.area])
    elif isinstance(drive, DisplacementDrive):
        above, top = 0.0, scenes.MOTION
    elif above == 0.0:
        top = scenes.VISCOUS if chain.site_damping > 0.0 else scenes.STRESS
    if chain.is_registered:
        return plan_of(chain, time, top, values, speed, above)
    ends, masses = chain.arrays.top, np.array([above / chain.area])
    if chain.arrays.heavy:
        inside = np.flatnonzero(chain.arrays.masses[:-1] > 0.0)
        ends = np.append(inside + 1, ends)
        masses = np.append(chain.arrays.masses[inside] / chain.area, masses)
    relaxing |= chain.relaxes
    memory = relaxing or chain.remembers
    alone = top == scenes.MOTION and len(chain.springs) == 1
    damped = dashpots or chain.arrays.damped or top == scenes.VISCOUS
    if len(ends) > 1 or above > 0.0:
        solver = SECOND_ORDER
    elif (damped or relaxing) and not alone:
        solver = FIRST_ORDER
    else:
        solver = CLOSED_FORM
    count = len(chain.springs)
    most = min(MOST_WORK // count + 2 * time.size + 8 * count, MOST_SAMPLED // count)
    most = max(min(max_steps, most), 1)
    explicit = min(MOST_EXPLICIT, MOST_EXPLICIT_WORK // count) + 20 * time.size
    return Plan(
        solver=solver,
        height=chain.height,
        ends=ends,
        mass=masses,
        drag=chain.site_damping / chain.height,
        top=top,
        values=values,
        time=time,
        speed=speed,
        margin=OF_MASSES if len(ends) > 1 else OF_IMPACT if speed > 0.0 else ALONG_DRIVE,
        max_steps=most,
        max_explicit=min(most, explicit),
        plain=speed > 0.0 and len(ends) == 1 and not damped and chain.site_damping == 0.0,
        memory=memory,
        unit=_unit(chain, drive, time) if memory else 1.0,
    )


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
