"""Forward simulation of a chain under a drive, with a check of its accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.solve import plan as plans
from foamfit.solve.compiled.run import MOTION
from foamfit.solve.plan import NO_DIRECTIONS, Directions, Motion, Plan, Slopes, plan
from foamfit.springs.chain import Chain, ChainArrays, Drive, check_scene
from foamfit.springs.compiled.contract import BY_STRESS
from foamfit.springs.laws.record import DRAG, OWN_HEIGHT, OWN_RELAXATION
from foamfit.springs.parameters import direction
from foamfit.springs.spring import as_number

_UNRESOLVED = (
    "masses vibrate too fast to be resolved, with up to {size:.1g} of the range: use an rtol no "
    "smaller than that, give the springs heavier dashpots, or leave the masses out"
)
# A motion is verified by a second run where steps are implicit, several masses are inside, a
# dashpot acts below a mass, or one of these limits is passed.
FEW_STEPS = 1000
FEW_SWITCHES = 32  # switches of branch under masses
CLOSE = 1e-3  # distance of a strain from the end of its branch
MOST_FOLLOWED = 10_000  # a motion of more implicit steps is not repeated with shorter ones
ROUNDING = 1e-12  # relative error of a sum of elongations
ROUGH = 1e-5  # largest error of runs where it may decide which spring snaps
LONGER, LONGEST = 100.0, 1e-3  # tolerance of longer steps over that of others, and at most
THINNED = 4  # share of the samples of an impact at which they are compared
LOST = 0.03  # shorter steps do not help where two runs differ by more than this


@dataclass(eq=False, repr=False)  # freezing it would cost 5 % of a short run
class Response:
    """Response of a chain to a drive."""

    time: Array  #: times of the samples, s, (n_t,)
    displacement: Array  #: of the node above each spring, downward, m, (n_springs, n_t)
    base_stress: Array  #: stress at the sensor, Pa, (n_t,); zero outside contact
    height: float  #: overall height H, m
    #: time at which the base stress of an impact returned to zero, s; None if it did not
    contact_end: float | None
    solver: str  #: "closed form", "first order" or "second order": the simplest that suffices
    #: "closed form", "Dormand-Prince" (explicit steps), "aggregate" (explicit steps of many springs
    #: under one stress) or "Radau IIA" (implicit steps, where light masses or dashpots make the
    #: scene stiff; they damp unresolved vibrations)
    method: str
    #: time (s), spring (0 at the base), branch left, branch entered (numbers in the order of
    #: `spring.law.branches`), and strain, (m, 5)
    switches: Array
    steps: int  #: number of integration steps; 0 for the closed form
    #: derivatives by the requested parameters
    sensitivities: dict[str, Sensitivity] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return a line without arrays."""
        stress, strain = self.base_stress.max(), self.strain.max()
        peaks = f"peak base stress {stress:.4g} Pa, peak strain {strain:.4g}"
        return f"Response at {self.time.size} times: {peaks} ({self.method})"

    @property
    def strain(self) -> Array:
        """Overall strain w_N/H, (n_t,)."""
        top: Array = self.displacement[-1]
        return top / self.height


def _verified(scene: Plan, arrays: ChainArrays, rtol: float, directions: Directions) -> Motion:
    """Run a scene and, where errors may grow, compare it with another run, to within `rtol`."""
    rows, heights, laws, ends = arrays.rows, arrays.heights, scene.laws.made, scene.ends

    def run(scene: Plan, rtol: float) -> Motion:
        return scene.run(rows, heights, rtol, directions=directions)

    sharp = _may_snap_wrongly(scene)
    rtol = min(rtol, ROUGH) if sharp else rtol
    try:
        motion = run(scene, rtol)
    except SimulationError:
        if not sharp or rtol < 1e-8:
            raise
        motion = run(scene, 1e-3 * rtol)
    inside = len(ends) > 2
    if len(ends) == 2:  # the base stress depends on the velocity of the mass above
        viscous = any(one.viscous for one in laws[: ends[0]])
        inside = viscous or bool((rows[: ends[0], 0] > 0.0).any())
    long = inside or motion.method == plans.RADAU or _is_long(scene, motion, FEW_STEPS)
    # An impact may bring a spring close to the end of its branch c if it has energy enough.
    hard = 0.5 * scene.mass.item(-1) * scene.speed**2 >= 6.0 * arrays.steep
    if scene.speed > 0.0 and not long and not hard:
        return motion
    lost = motion.unresolved
    if lost > 0.7 * rtol:  # the comparison below leaves 0.3
        # An explicit step covers about 3 radians and costs 1 % of an implicit step.
        rates = scene.fastest_rates(rows, heights, scene.drag)
        explicit = max(rates) / 3.0 <= plans.MOST_WORK / len(heights)
        motion, scene = _resolve_vibrations(scene, motion, rtol, explicit, run)
    distance, by_stress = _distances(scene, arrays, motion)
    if scene.speed > 0.0 and not arrays.damped:  # its peak may lie between two samples
        distance = min(distance, by_stress)
    if 0.3 * rtol * distance < 1e-15:
        raise SimulationError(
            f"a strain comes within {distance:.1g} of the end of its branch, 1 + eps_star, where "
            f"rounding errors exceed rtol = {rtol:g}"
        )
    forced = 0 if scene.speed > 0.0 else scene.time.size
    long = _is_long(scene, motion, FEW_STEPS + 2 * forced) or inside
    long = long or min(distance, by_stress) < CLOSE
    long = (long and scene.solver == plans.SECOND_ORDER) or sharp
    if not (long or motion.method == plans.RADAU) or rtol < 1e-12:  # a finer run would only round
        return motion
    if motion.method == plans.EXPLICIT_STEPS and not sharp:
        with suppress(SimulationError):
            if _agrees_with_longer_steps(scene, arrays, motion, rtol):
                return motion
    return _compared(scene, motion, rtol, lost, run)


def _agrees_with_longer_steps(
    scene: Plan, arrays: ChainArrays, motion: Motion, rtol: float
) -> bool:
    """Whether longer steps, which cost less than shorter ones, give the same motion."""
    part = slice(None, None, THINNED if scene.speed > 0.0 else None)
    scene = scene.changed(time=scene.time[part].copy(), least=min(LONGER * motion.tol, LONGEST))
    rough = scene.run(arrays.rows, arrays.heights, rtol)
    return _miss(motion.displacement[:, part], motion.base_stress[part], rough) <= 0.3 * rtol


def _difference(one: Array, other: Array) -> float:
    """Return the largest difference of two curves over the range (0 included) of the first."""
    span = max(float(one.max()), 0.0) - min(float(one.min()), 0.0)
    return float(np.abs(one - other).max()) / span if span > 0.0 else 0.0


def _miss(displacement: Array, base_stress: Array, other: Motion) -> float:
    """Return the largest difference of two runs over the ranges of the first."""
    return max(
        _difference(displacement, other.displacement), _difference(base_stress, other.base_stress)
    )


def _compared(
    scene: Plan, motion: Motion, rtol: float, lost: float, run: Callable[[Plan, float], Motion]
) -> Motion:
    """Compare a motion with runs of shorter steps, until two agree.

    Where steps cannot be shorter, a run with longer steps must agree: its error is four times as
    large, so the two differ by three times the error of the motion. `lost` is the size of the
    vibrations that implicit steps damped out.
    """
    miss, least = math.inf, plans.LEAST_TOL if motion.method == plans.RADAU else None
    for factor in (1e-2, 1e-4, 1e-6):
        if rtol * factor < 1e-14:
            break
        try:
            finer = run(scene.changed(least=least), rtol * factor)
        except SimulationError:
            if scene.implicit is False:  # the last resort, see `_resolve_vibrations`
                raise SimulationError(_UNRESOLVED.format(size=lost)) from None
            if miss == math.inf:
                raise
            break
        if finer.tol > 0.5 * motion.tol:
            same = finer.tol < 2.0 * motion.tol
            longer = run(scene.changed(least=4.0 * motion.tol), rtol) if same else finer
            miss = _miss(motion.displacement, motion.base_stress, longer)
            if miss <= 2.0 * rtol and motion.unresolved <= rtol:
                return motion
            break
        miss = _miss(finer.displacement, finer.base_stress, motion)
        if miss <= 0.3 * rtol and min(finer.unresolved, motion.unresolved) <= rtol:
            return finer if finer.unresolved <= rtol else motion
        if factor < 1e-2 and miss > LOST:
            break
        motion = finer
    raise SimulationError(
        "vibrations amplify the smallest error: two runs with steps of different length differ by "
        f"{miss:.1g} of the range; use a larger rtol, give the springs heavier dashpots, or leave "
        "the masses out"
    )


def _may_snap_wrongly(scene: Plan) -> bool:
    """Whether the smallest error may decide which of the springs under one stress snaps."""
    several = scene.solver == plans.FIRST_ORDER and len(scene.laws.made) > len(scene.ends)
    return several and any(one.kind == BY_STRESS for one in scene.laws.made)


def _resolve_vibrations(
    scene: Plan, motion: Motion, rtol: float, explicit: bool, run: Callable[[Plan, float], Motion]
) -> tuple[Motion, Plan]:
    """Resolve vibrations that implicit steps damped out, by explicit or shorter implicit steps."""
    error = SimulationError(_UNRESOLVED.format(size=motion.unresolved))
    if explicit:
        try:
            scene = scene.changed(implicit=False)
            return run(scene, rtol), scene
        except SimulationError:
            raise error from None
    for factor in (1e-2, 1e-4):
        if motion.steps < MOST_FOLLOWED and rtol * factor >= 1e-14:
            with suppress(SimulationError):
                finer = run(scene.changed(implicit=True), rtol * factor)
                if finer.unresolved <= 0.7 * rtol:
                    return finer, scene
    raise error


def _is_long(scene: Plan, motion: Motion, few: int) -> bool:
    """Whether a motion took many steps or switches (the steps of an aggregate are switches)."""
    if motion.steps > few:
        return motion.method != plans.AGGREGATE
    bounces = len(scene.ends) > 1 or scene.speed == 0.0
    return bounces and scene.solver == plans.SECOND_ORDER and len(motion.switches) > FEW_SWITCHES


def _distances(scene: Plan, arrays: ChainArrays, motion: Motion) -> tuple[float, float]:
    """Return the least distance, in strain, of any spring from 1 + ε_*; at most 1.

    The first is that at a sample. The second is a lower bound, also between samples, where a mass
    may rebound from the end of a branch: that at which branch c has the largest stress of any
    spring.
    """
    at, sampled, least = 1 + 2 * scene.terms, 1.0, 1.0
    strain = np.diff(motion.displacement, axis=0, prepend=0.0).max(axis=1) / arrays.heights
    for i, one in enumerate(scene.laws.made):
        if one.pole >= 0:
            star, kc = (arrays.rows.item(i, at + k) for k in (one.pole, one.slopes[1]))
            sampled = min(sampled, 1.0 - (strain.item(i) - max(star, 0.0)))
            least = min(least, kc / (kc + motion.strongest))
    return sampled, least


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivative of a response with respect to one parameter, in SI units, at fixed times.

    Where equal springs stop while they snap or share a flat branch, derivatives from above and
    below differ, and this may be neither: the smallest change decides which of them continues.
    """

    displacement: Array  #: m per unit of the parameter, (n_springs, n_t)
    #: Pa per unit of the parameter, (n_t,); its slope jumps at switches of branch, its value at
    #: the end of contact
    base_stress: Array


def _sensitivities(
    chain: Chain, names: Sequence[str], directions: Directions, slopes: Slopes
) -> dict[str, Sensitivity]:
    """Return the derivatives of a run by parameter name."""
    out = {}
    # The solver differentiates by η_site/H, on which η_site and every height act.
    drag = chain.site_damping / chain.height
    for p, name in enumerate(names):
        motion, stress = slopes.displacement[p], slopes.base_stress[p]
        if directions[p, 1] == DRAG:
            motion, stress = motion / chain.height, stress / chain.height
        elif directions[p, 1] == OWN_HEIGHT and drag > 0.0:
            motion = motion - drag / chain.height * slopes.displacement[-1]
            stress = stress - drag / chain.height * slopes.base_stress[-1]
        out[name] = Sensitivity(motion, stress)
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
        An impact starts at t = 0; before that, the striker approaches. Sampled drives start from
        rest at t[0] and are linear between samples, where dashpots feel the mean of both rates.
    t : (n_t,) array
        Sample times, s, increasing.
    rtol : float
        Allowed error of displacement and base stress, relative to their range.
    sensitivities : sequence of str
        Parameters for which derivatives are computed: s1_k0 … s2_eta, s1_height, site_eta,
        and s1_g1, s1_tau1, … of relaxation terms.

    Returns
    -------
    Response
        After contact the base stress is zero and the chain moves with the striker.

    Raises
    ------
    ValueError
        If an argument is not admissible; the message names it.
    SimulationError
        If the scene has no finite solution, or none within `rtol`; the message gives the reason.
    """
    check_scene(chain, drive)
    if not 1e-14 <= as_number(rtol, "rtol") <= 1e-1:
        raise InputError(f"rtol = {rtol:g} is not admissible: it must be between 1e-14 and 0.1")
    directions, dashpots, relaxing = NO_DIRECTIONS, False, False
    if sensitivities:
        wanted = [direction(chain.laws, name, chain.relaxation) for name in sensitivities]
        by_height = any(what == OWN_HEIGHT for _, what in wanted)
        if by_height and chain.site_damping > 0.0:  # which changes η_site/H
            wanted.append((-1, DRAG))
        directions = np.array(wanted)
        dashpots = any(name.endswith("_eta") for name in sensitivities)
        relaxing = any(what >= OWN_RELAXATION for _, what in directions)
    scene = plan(chain, drive, t, dashpots=dashpots, relaxing=relaxing)
    motion = _verified(scene, chain.arrays, rtol, directions)
    if scene.top == MOTION and len(chain.springs) > 1:
        miss = _difference(scene.values, motion.displacement[-1])
        if not miss <= max(rtol, ROUNDING):
            raise SimulationError(
                f"the springs' elongations miss the prescribed displacement by {miss:.1g} of its "
                f"range, more than rtol = {rtol:g}: use a larger rtol or more samples"
            )
    end = None if math.isnan(motion.contact_end) else motion.contact_end
    given = motion.slopes
    slopes = _sensitivities(chain, sensitivities, directions, given) if given else {}
    return Response(  # positional, as keywords are slower
        scene.time, motion.displacement, motion.base_stress, chain.height, end,
        scene.solver, motion.method, motion.switches, motion.steps, slopes,
    )  # fmt: skip
