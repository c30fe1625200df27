"""Forward simulation: a chain under a drive, by the least solver that the scene needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit import aggregate, implicit, kernels, ringing, series, taylor
from foamfit.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive, check_scene
from foamfit.errors import SimulationError
from foamfit.law import BISTABLE
from foamfit.series import equilibrium_tangents
from foamfit.spring import (
    BISTABLE_NAMES,
    LINEAR_NAMES,
    BistableSpring,
    as_number,
    as_samples,
)

Array = NDArray[np.float64]

CLOSED_FORM, FIRST_ORDER, SECOND_ORDER = "closed form", "first order", "second order"
TAYLOR, RADAU, AGGREGATE = "Taylor series", "Radau IIA", "aggregate"
MAX_STEPS = 2_000_000
# Explicit steps are given up where something relaxes, or vibrates, so many times (in radians) while
# the scene lasts, or after so many steps.
MOST_RELAXATION, MOST_VIBRATION, MOST_EXPLICIT = 1e4, 1e5, 200_000
# Bounds on steps times springs (seconds, not hours): for all but the samples of a drive, before
# explicit steps are given up, and for everything.
MOST_WORK, MOST_EXPLICIT_WORK, MOST_SAMPLED = 1_500_000, 500_000, 10_000_000
# From so many steps on, and where steps are implicit or several masses are inside, a motion is run
# again to check it; so it is where a strain comes so close to the end of its branch.
FEW_STEPS, CLOSE = 1000, 1e-3
LOST = 0.03  # so large a difference is not mended by still shorter steps
# From so many springs on, those that carry one stress are integrated as one.
LEAST_AGGREGATE = 9

_OUTCOMES = {
    taylor.TOO_MANY_STEPS: "the bound of {steps} steps was reached: something in the scene is "
    "too fast to be followed (a light mass or a heavy dashpot)",
    taylor.STEP_UNDERFLOW: "the step shrank to nothing near t = {time:g} s: there the scene "
    "changes faster than numbers can tell (a strain at the end of its branch, a very light mass, "
    "or many springs on a flat branch)",
    taylor.FLAT_UNDER_STRESS: "a prescribed stress acts on a flat branch (kh_plus or kh_minus = 0) "
    "that nothing slows; give the top a mass or the spring a dashpot",
    taylor.NOT_FINITE: "a stress or strain is no longer finite: the drive goes past the end of a "
    "branch (strain 1 on branch a, 1 + eps_star on branch c)",
}
_RINGING = (
    "masses vibrate too fast to be followed, by up to {size:.1g} of the range: ask for no smaller "
    "rtol than that, give the springs heavier dashpots, or leave the masses out"
)


@dataclass(frozen=True, eq=False)
class Response:
    """What a chain does under a drive.

    Attributes
    ----------
    time : (n_t,) array
        s.
    displacement : (n_springs, n_t) array
        Downward displacement w_i of the node above each spring, m.
    base_stress : (n_t,) array
        Stress at the sensor, Σ_1, Pa; zero outside contact.
    strain : (n_t,) array
        Overall strain w_N/H.
    contact_end : float or None
        When an impact's base stress returned to zero, s; None if it has not, or in other drives.
    solver : str
        "closed form", "first order" or "second order": the least that the scene needs.
    method : str
        "closed form", "Taylor series" (explicit steps), "aggregate" (the same, for many springs
        that carry one stress) or "Radau IIA" (implicit steps, where light masses or dashpots make
        the scene stiff; a vibration too fast to be followed is damped out, and refused where it
        would exceed rtol).
    switches : (m, 5) array
        Time (s), spring (0 at the base), branch left, branch entered, strain of that spring.
    steps : int
        Steps of the integrator; 0 for the closed form.
    sensitivities : dict of str to Sensitivity
        Derivatives by the parameters that were asked for.
    """

    time: Array
    displacement: Array
    base_stress: Array
    strain: Array
    contact_end: float | None
    solver: str
    method: str
    switches: Array
    steps: int
    sensitivities: dict[str, Sensitivity] = field(default_factory=dict)


Directions = NDArray[np.int64]
NO_DIRECTIONS: Directions = np.empty((0, 2), np.int64)
NO_SWITCHES = np.empty((0, 5))
_NOTHING = np.zeros(1)


class Slopes(NamedTuple):
    """Derivatives of displacement (p, nodes, n_t) and base stress (p, n_t) in p directions."""

    displacement: Array
    base_stress: Array


NO_SLOPES = Slopes(np.empty((0, 0, 0)), np.empty((0, 0)))


class Motion(NamedTuple):
    """The bare outcome of a run; see `Response`. `slopes` is None where none were asked for."""

    displacement: Array
    base_stress: Array
    contact_end: float
    switches: Array
    steps: int
    method: str = CLOSED_FORM
    slopes: Slopes | None = None
    unresolved: float = 0.0  # vibrations that were damped out, relative to the ranges


@dataclass(frozen=True, eq=False)
class Plan:
    """A scene made ready to run many times with other springs: what does not change between runs.

    Attributes
    ----------
    solver : str
        The least solver.
    height : float
        H, m.
    ends, mass : arrays
        The groups of springs and the areal masses between them; see `foamfit.taylor.integrate`.
    drag : float
        η_site/H, Pa·s/m.
    top : int
        What is known of the top; see `foamfit.taylor`.
    values, time : (n,) arrays
        The drive and its samples.
    speed : float
        Velocity of the striker, m/s; 0 = no impact.
    max_steps : int
        Bound on the steps of the integrator.
    lossless : bool
        Whether there is neither a dashpot nor a mass inside.
    implicit : bool or None
        Whether to take implicit steps; None = where explicit ones are the wrong tool.
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
    max_steps: int = MAX_STEPS
    lossless: bool = False
    implicit: bool | None = None

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
        of the derivatives to carry along; see `foamfit.series`.

        Raises
        ------
        SimulationError
            If the scene has no finite answer; the message says why.
        """
        drag = self.drag if drag is None else drag
        if self.solver == CLOSED_FORM:
            return self._closed_form(rows, heights, everything, directions)
        return self._integrate(rows, heights, rtol, drag, everything, directions)

    def _closed_form(
        self, rows: Array, heights: Array, everything: bool, directions: Directions
    ) -> Motion:
        """Undamped and massless: one stress in all springs; or one spring under known motion."""
        moved = self.top == taylor.MOTION
        strain = np.empty((len(heights), self.time.size))
        branches = np.empty(strain.shape, np.int64)
        stress = np.array(self.values)
        if moved:
            kernels.equilibrium_along(rows, heights, self.values, stress, strain, branches)
        else:
            kernels.strains_along(rows, stress, strain, branches)
        slopes: Slopes | None = None
        if len(directions):
            slopes = Slopes(
                *equilibrium_tangents(rows, heights, strain, branches, moved, directions)
            )
        eta = rows[0, kernels.ETA]
        if moved and len(heights) == 1 and stress.size > 1 and (eta > 0.0 or slopes is not None):
            rate = np.gradient(strain[0], self.time)
            stress = stress + eta * rate
            for p, (_, what) in enumerate(directions):
                if slopes is not None and what == series.OWN_ETA:
                    slopes.base_stress[p] += rate
                elif slopes is not None and what == series.HEIGHT:
                    slopes.base_stress[p] -= eta * rate / heights[0]
        if not math.isfinite(kernels.total(stress) + kernels.total(strain.ravel())):
            raise SimulationError(_OUTCOMES[taylor.NOT_FINITE])
        if not everything:
            if slopes is not None:
                slopes = Slopes(slopes.displacement[:, -1:], slopes.base_stress)
            top = (heights @ strain)[None, :]
            return Motion(top, stress, math.nan, NO_SWITCHES, 0, CLOSED_FORM, slopes)
        nodes = np.cumsum(heights[:, None] * strain, axis=0)
        switches = _switches(self.time, strain, branches)
        return Motion(nodes, stress, math.nan, switches, 0, CLOSED_FORM, slopes)

    def _integrate(
        self,
        rows: Array,
        heights: Array,
        rtol: float,
        drag: float,
        everything: bool,
        directions: Directions,
    ) -> Motion:
        # Without an interior mass there are few steps: a margin costs little.
        inside = len(self.ends) > 1
        nodes, n, p = (len(heights) if everything else 1), self.time.size, len(directions)
        displacement, stress, log = np.empty((nodes, n)), np.empty(n), np.empty((1024, 5))
        slopes = Slopes(np.empty((p, nodes, n)), np.empty((p, n))) if p > 0 else NO_SLOPES
        most = MOST_WORK // len(heights) + 2 * n + 8 * len(heights)
        max_steps = max(min(self.max_steps, most, MOST_SAMPLED // len(heights)), 1)
        lost = np.zeros(1)
        method = RADAU if self._is_stiff(rows, heights, drag) else TAYLOR
        if method == TAYLOR and p == 0 and self._is_one(rows):
            method = AGGREGATE
            log = np.empty((4 * len(heights) + 64, 5))
        moved = (self.ends, self.mass, drag, self.top, self.values, self.speed, self.time)
        scene = (rows, heights, *moved)
        outcome, contact_end, steps, switches = taylor.TOO_MANY_STEPS, math.nan, 0, 0
        if method == AGGREGATE:
            # One step to a switch: the errors of many add up, and one order more costs little.
            tolerance = max(1e-4 * rtol / len(heights), 1e-16)
            outcome, contact_end, steps, switches = aggregate.integrate_aggregate(
                rows,
                heights,
                self.mass[0],
                drag,
                self.speed,
                self.time,
                tolerance,
                min(max(round(4.0 - 0.5 * math.log(tolerance)), 6), aggregate.DEGREE),
                self.max_steps,
                displacement,
                stress,
                log,
                np.zeros(2, np.int64),
            )
        if method == TAYLOR:
            tolerance = max((1e-2 if inside else 1e-3 if self.speed > 0.0 else 1e-4) * rtol, 1e-16)
            order = min(max(round(4.0 - 0.5 * math.log(tolerance)), 6), 24)
            most = min(MOST_EXPLICIT, MOST_EXPLICIT_WORK // len(heights)) + 20 * self.time.size
            outcome, contact_end, steps, switches = taylor.integrate(
                *scene,
                tolerance,
                order,
                min(max_steps, most) if self.implicit is None else max_steps,
                directions,
                displacement,
                stress,
                *slopes,
                log,
            )
            if outcome in (taylor.TOO_MANY_STEPS, taylor.STEP_UNDERFLOW) and self.implicit is None:
                method = RADAU
        if method == RADAU:
            outcome, contact_end, steps, switches = implicit.integrate_implicit(
                *scene,
                max((3e-2 if inside else 3e-4) * rtol, 1e-14),
                max_steps,
                directions,
                displacement,
                stress,
                *slopes,
                log,
                np.zeros(2, np.int64),
                rtol,
                lost,
                implicit.rest(rows, heights, self.ends, self.top, self.values[0], directions),
            )
        if outcome != taylor.DONE:
            last = log[min(switches, len(log)) - 1, 0] if switches else self.time[0]
            raise SimulationError(_OUTCOMES[outcome].format(steps=steps, time=last))
        return Motion(
            displacement, stress, contact_end, log[:switches], steps, method,
            slopes if p > 0 else None, float(lost[0]),
        )  # fmt: skip

    def _is_one(self, rows: Array) -> bool:
        """Tell whether an impact acts on springs so many and so plain that they count as one."""
        return (
            len(rows) >= LEAST_AGGREGATE
            and len(self.ends) == 1
            and self.top == taylor.FREE
            and self.speed > 0.0
            and bool(aggregate.holds(rows))
        )

    def hurry(self, rows: Array, heights: Array, drag: float) -> tuple[float, float]:
        """Vibration and relaxation (radians) that explicit steps would have to go through."""
        return ringing.hurry_of(
            rows, heights, self.ends, self.mass, drag, self.top, self.speed, self.time
        )

    def _is_stiff(self, rows: Array, heights: Array, drag: float) -> bool:
        """Tell whether explicit steps would have to follow what is long over."""
        if self.implicit is not None:
            return self.implicit
        if self.lossless and drag == 0.0 and self.speed > 0.0:  # one mass bounces once
            return False
        if self.speed > 0.0 and ringing.parts_faintly(rows, heights, self.mass[-1]):
            return True
        vibration, relaxation = self.hurry(rows, heights, drag)
        return bool(vibration > MOST_VIBRATION or relaxation > MOST_RELAXATION)


def _switches(time: Array, strain: Array, branches: NDArray[np.int64]) -> Array:
    """List the changes of branch between samples, at the later sample."""
    springs, samples = np.nonzero(np.diff(branches, axis=1))
    order = np.argsort(samples, kind="stable")
    i, j = springs[order], samples[order] + 1
    return (
        np.column_stack((time[j], i, branches[i, j - 1], branches[i, j], strain[i, j]))
        if i.size
        else np.empty((0, 5))
    )


def _time(t: ArrayLike) -> Array:
    time = as_samples(t, "t")  # a copy of one compiled type: writable
    if time.ndim != 1 or time.size == 0:
        raise ValueError("t must be a one-dimensional array with at least one sample")
    at = kernels.fault(time)
    if at >= 0 and not math.isfinite(time[at]):
        raise ValueError(f"t must be finite; sample {at} is not")
    if at >= 0:
        raise ValueError(f"t must increase; sample {at} is not later than the one before it")
    return time


def plan(chain: Chain, drive: Drive, t: ArrayLike, *, dashpots: bool = False) -> Plan:
    """Find what a scene needs: the nodes that have a state, and the least solver.

    Parameters
    ----------
    chain : Chain
        Only its heights, area, masses, site damping and which springs have a dashpot count.
    drive : Impact, StressDrive or DisplacementDrive
        How it is loaded.
    t : (n_t,) array
        Samples, s, increasing.
    dashpots : bool
        Whether to reckon with a dashpot in every spring, also where it is zero.

    Raises
    ------
    ValueError
        If t does not increase or has not one value per sample of the drive.
    """
    time = _time(t)
    masses = chain.arrays.masses.copy()
    speed, values = 0.0, _NOTHING
    top = taylor.FREE
    if isinstance(drive, Impact):
        masses[-1] += drive.mass
        speed = drive.velocity
    else:
        name = "stress" if isinstance(drive, StressDrive) else "displacement"
        values = np.array(drive.stress if isinstance(drive, StressDrive) else drive.displacement)
        if values.size != time.size:
            raise ValueError(
                f"{name} has {values.size} samples and t has {time.size}: give one value per sample"
            )
        if isinstance(drive, DisplacementDrive):
            masses[-1] = 0.0
            top = taylor.MOTION
        elif masses[-1] == 0.0:
            top = taylor.VISCOUS if chain.site_damping > 0.0 else taylor.STRESS
    if chain.arrays.heavy:
        nodes = masses > 0.0
        nodes[-1] = True
        ends, masses = np.flatnonzero(nodes) + 1, masses[nodes]
    else:
        ends, masses = chain.arrays.top, masses[-1:]
    damped = dashpots or chain.arrays.damped or top == taylor.VISCOUS
    if len(masses) > 1 or masses[0] > 0.0:
        solver = SECOND_ORDER
    elif damped and not (top == taylor.MOTION and len(chain.springs) == 1):
        solver = FIRST_ORDER
    else:
        solver = CLOSED_FORM
    return Plan(
        solver=solver,
        height=chain.height,
        ends=ends,
        mass=masses / chain.area,
        drag=chain.site_damping / chain.height,
        top=top,
        values=values,
        time=time,
        speed=speed,
        lossless=len(ends) == 1 and not damped,
    )


def _verified(
    scene: Plan,
    rows: Array,
    heights: Array,
    rtol: float,
    directions: Directions = NO_DIRECTIONS,
) -> Motion:
    """Run a scene; where masses make its errors grow, follow it again by shorter steps and compare.

    Raises
    ------
    SimulationError
        If the scene has no answer within `rtol`; the message says why.
    """
    motion = scene.run(rows, heights, rtol, directions=directions)
    many = _many(motion, FEW_STEPS) or len(scene.ends) > 2 or motion.method == RADAU
    if scene.speed > 0.0 and not many and not _hard(scene, rows, heights):
        return motion
    motion = _resolved(scene, rows, heights, rtol, directions, motion)
    lost = motion.unresolved
    if lost > 0.7 * rtol:  # the comparison below leaves 0.3
        scene = replace(scene, implicit=False)
        # an explicit step goes through two or three radians
        if max(scene.hurry(rows, heights, scene.drag)) / 3.0 > MOST_WORK / len(heights):
            raise SimulationError(_RINGING.format(size=lost))
        motion = _followed(scene, rows, heights, rtol, directions, lost)
    room = _room_at_peak(scene, rows, heights, motion, rtol)
    if 0.3 * rtol * room < 1e-15:
        raise SimulationError(
            f"a strain comes within {room:.1g} of the end of its branch, 1 + eps_star: there "
            f"rounding alone makes errors above rtol = {rtol:g}"
        )
    forced = 0 if scene.speed > 0.0 else scene.time.size
    many = _many(motion, FEW_STEPS + 2 * forced) or len(scene.ends) > 2 or room < CLOSE
    many = many and scene.solver == SECOND_ORDER
    if not (many or motion.method == RADAU) or rtol < 1e-12:  # no finer run could tell
        return motion
    miss = math.inf
    for factor in (1e-2, 1e-4, 1e-6):
        if rtol * factor < 1e-14:
            break
        finer = _followed(scene, rows, heights, rtol * factor, directions, lost)
        miss = max(
            _difference(finer.displacement, motion.displacement),
            _difference(finer.base_stress, motion.base_stress),
        )
        if miss <= 0.3 * rtol and min(finer.unresolved, motion.unresolved) <= rtol:
            return finer if finer.unresolved <= rtol else motion
        if factor < 1e-2 and miss > LOST:
            break
        motion = finer
    raise SimulationError(
        "vibrations let the least error grow: two runs with shorter steps each differ by "
        f"{miss:.1g} of the range; ask for a larger rtol, give the springs heavier dashpots, or "
        "leave the masses out"
    )


def _resolved(
    scene: Plan, rows: Array, heights: Array, rtol: float, directions: Directions, motion: Motion
) -> Motion:
    """Take shorter implicit steps where these follow the vibrations that longer ones have lost.

    What many damped masses have lost together is overestimated: shorter steps may show that.
    """
    implicit_scene = replace(scene, implicit=True)
    for factor in (1e-2, 1e-4):
        if motion.unresolved <= 0.7 * rtol or rtol * factor < 1e-14:
            break
        try:
            finer = implicit_scene.run(rows, heights, rtol * factor, directions=directions)
        except SimulationError:
            break
        if finer.unresolved <= 0.7 * rtol:
            return finer
    return motion


def _followed(
    scene: Plan, rows: Array, heights: Array, rtol: float, directions: Directions, lost: float
) -> Motion:
    """Run a scene; where explicit steps follow what implicit ones lost, that is why they fail."""
    try:
        return scene.run(rows, heights, rtol, directions=directions)
    except SimulationError:
        if scene.implicit is not False:
            raise
        raise SimulationError(_RINGING.format(size=lost)) from None


def _many(motion: Motion, few: int) -> bool:
    """Whether a motion took many steps; those of springs under one stress are but switches."""
    return motion.steps > few and motion.method != AGGREGATE


def _difference(one: Array, other: Array) -> float:
    """Largest difference of two motions over the range of the first, rest included."""
    span = max(float(one.max()), 0.0) - min(float(one.min()), 0.0)
    return float(np.abs(one - other).max()) / span if span > 0.0 else 0.0


def _room(rows: Array, heights: Array, displacement: Array) -> float:
    """Least distance, in strain, of a spring on branch c from its end at 1 + ε_*."""
    strain = np.diff(displacement, axis=0, prepend=0.0).max(axis=1) / heights
    bistable = (rows[:, kernels.KIND] == BISTABLE) & (strain > rows[:, kernels.EPS_C])
    return float(np.where(bistable, 1.0 - (strain - rows[:, kernels.EPS_STAR]), 1.0).min())


def _hard(scene: Plan, rows: Array, heights: Array) -> bool:
    """Whether a blow may bring a spring close to the end of its branch c."""
    brought = 0.5 * float(scene.mass[-1]) * scene.speed**2
    return brought >= 6.0 * float(heights @ rows[:, kernels.KC])


def _room_at_peak(scene: Plan, rows: Array, heights: Array, motion: Motion, rtol: float) -> float:
    """Room at the peak of an impact that may come close to the end of a branch.

    The peak of a hard blow is so short that no sample need lie in it: it is closed in on.
    """
    room = _room(rows, heights, motion.displacement)
    bistable = rows[:, kernels.KIND] == BISTABLE
    if scene.speed == 0.0 or not bistable.any():
        return room
    if not _hard(scene, rows, heights):
        return room
    low, high = 0.0, float(scene.time[-1])
    for _ in range(12):
        grid = np.linspace(low, high, 201)
        top = replace(scene, time=grid).run(rows, heights, rtol).displacement
        room = min(room, _room(rows, heights, top))
        at = int(top[-1].argmax())
        low, high = float(grid[max(at - 1, 0)]), float(grid[min(at + 1, 200)])
        if high - low < 1e-15 * high or at == 200:
            break
    return room


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivative of a response by one parameter, in SI, at fixed times.

    Attributes
    ----------
    displacement : (n_springs, n_t) array
        m per unit of the parameter.
    base_stress : (n_t,) array
        Pa per unit of the parameter. At a switch of branch its slope jumps, not its value; it jumps
        where contact ends.
    """

    displacement: Array
    base_stress: Array


def _direction(chain: Chain, name: str) -> tuple[int, int]:
    """Spring and own parameter, or height, or onsite damper, that a name like "s1_kc" means."""
    if name == "site_eta":
        return -1, series.DRAG
    prefix, _, short = name.partition("_")
    known = [f"s{i}" for i in range(1, len(chain.springs) + 1)]
    if prefix in known:
        spring = known.index(prefix)
        own = BISTABLE_NAMES if isinstance(chain.springs[spring], BistableSpring) else LINEAR_NAMES
        if short == "height":
            return spring, series.HEIGHT
        if short in own:
            return spring, BISTABLE_NAMES.index(short)
    raise ValueError(
        f"sensitivities: '{name}' is not a parameter of this chain; give names like s1_k0, "
        "s2_height or site_eta"
    )


def _sensitivities(
    chain: Chain, names: Sequence[str], directions: Directions, slopes: Slopes
) -> dict[str, Sensitivity]:
    """Name the derivatives of a run; η_site acts through η_site/H, and so does every height."""
    out = {}
    drag = chain.site_damping / chain.height
    for p, name in enumerate(names):
        moved, pressed = slopes.displacement[p], slopes.base_stress[p]
        if directions[p, 1] == series.DRAG:
            moved, pressed = moved / chain.height, pressed / chain.height
        elif directions[p, 1] == series.HEIGHT and drag > 0.0:
            moved = moved - drag / chain.height * slopes.displacement[-1]
            pressed = pressed - drag / chain.height * slopes.base_stress[-1]
        out[name] = Sensitivity(moved, pressed)
    return out


def simulate(
    chain: Chain,
    drive: Drive,
    t: ArrayLike,
    rtol: float = 1e-6,
    *,
    sensitivities: Sequence[str] = (),
) -> Response:
    """Simulate a chain under a drive.

    Parameters
    ----------
    chain : Chain
        Springs, heights, area, masses, onsite damper.
    drive : Impact, StressDrive or DisplacementDrive
        An impact starts at t = 0 (before, the striker is on its way); the sampled drives start
        from rest at t[0] and are linear between samples, where a dashpot feels the mean rate.
    t : (n_t,) array
        Samples, s, increasing.
    rtol : float
        Wanted error of displacement and base stress relative to their range.
    sensitivities : sequence of str
        Parameters by which the response is differentiated: s1_k0 … s2_eta, s1_height, site_eta.

    Returns
    -------
    Response
        Past the end of contact the base stress is zero and the chain flies with the striker.

    Raises
    ------
    ValueError
        If something is not admissible; the message names it.
    SimulationError
        If the scene has no finite answer, or none to the wanted error; the message says why.
    """
    check_scene(chain, drive)
    if not 1e-14 <= as_number(rtol, "rtol") <= 1e-1:
        raise ValueError(f"rtol = {rtol:g} is not admissible: it must be between 1e-14 and 0.1")
    directions = NO_DIRECTIONS
    if sensitivities:
        wanted = [_direction(chain, name) for name in sensitivities]
        longer = any(what == series.HEIGHT for _, what in wanted)
        if longer and chain.site_damping > 0.0:  # the onsite damper acts over the whole height
            wanted.append((-1, series.DRAG))
        directions = np.array(wanted)
    scene = plan(chain, drive, t, dashpots=any(name.endswith("_eta") for name in sensitivities))
    motion = _verified(scene, chain.arrays.rows, chain.arrays.heights, rtol, directions)
    return Response(
        time=scene.time,
        displacement=motion.displacement,
        base_stress=motion.base_stress,
        strain=motion.displacement[-1] / chain.height,
        contact_end=None if math.isnan(motion.contact_end) else motion.contact_end,
        solver=scene.solver,
        method=motion.method,
        switches=motion.switches,
        steps=motion.steps,
        sensitivities=(
            {} if motion.slopes is None
            else _sensitivities(chain, sensitivities, directions, motion.slopes)
        ),
    )  # fmt: skip
