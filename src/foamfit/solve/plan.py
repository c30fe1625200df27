"""A scene prepared for repeated runs, and the choice of the simplest solver that suffices."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.solve import cache, histories
from foamfit.solve.compiled import along, groups, loop, rates, run
from foamfit.solve.compiled.samples import increases
from foamfit.solve.histories import NO_SWITCHES
from foamfit.solve.layout import Memory, Shape, memory_of
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.compiled import compiled, slopes_of
from foamfit.springs.compiled.contract import FLOWS, INTERNAL, Compiled
from foamfit.springs.laws.record import OWN_RELAXATION, Law
from foamfit.springs.spring import as_samples

Directions = NDArray[np.int64]

FIRST_ORDER, SECOND_ORDER = "first order", "second order"
CLOSED_FORM = "closed form"
EXPLICIT_STEPS, RADAU, AGGREGATE = "Dormand-Prince", "Radau IIA", "aggregate"
# Springs that an impact treats as one; error over the requested error and the springs.
LEAST_AGGREGATE, AS_ONE = 9, 1e-4
MAX_STEPS = 2_000_000
# Implicit steps replace explicit ones above these limits.
MOST_RELAXATION = 3e3  # relaxation times in the duration of the scene
MOST_VIBRATION = 1e5  # radians of the fastest vibration in the duration
FASTEST = 1e10  # radians above which a step that shrinks to nothing is said to be too fast
MOST_EXPLICIT_WORK, MOST_IMPLICIT_WORK = 1_200_000, 1_500_000  # steps times springs
# Bounds on steps times springs of any solver keep runs to seconds.
MOST_WORK = 6_000_000  # in addition to the samples of a drive
MOST_SAMPLED = 10_000_000  # in total
# Error of a step over the requested error.
ALONE, IN_SERIES, OF_MASSES = 1e-3, 2e-3, 1e-3
OF_IMPLICIT, OF_IMPLICIT_MASSES = 3e-4, 2e-2  # of an implicit step
# Length of a short implicit step, as a share of the duration, for a truncation of 3e-8.
SHORT = 5e-4
# Least error of a step; of vibrating masses, whose steps would not exceed rounding errors below it.
LEAST_TOL, LEAST_OF_MASSES, LEAST_VIBRATING = 2e-14, 5e-13, 5e-12  # the last of implicit steps
_FAILURES = {
    run.TOO_MANY_STEPS: "the bound of {steps} steps was reached: something in the scene is "
    "too fast to be followed (a light mass or a heavy dashpot)",
    run.STEP_UNDERFLOW: "the step shrank to nothing near t = {time:g} s, where the scene "
    "changes faster than numbers can resolve (a strain at the end of its branch, a very light "
    "mass, or many springs on a flat branch)",
    run.TOO_FAST: "something in the scene is too fast to be followed (a light mass, or a dashpot "
    "that is very light beside a stiff spring)",
    run.FLAT_UNDER_STRESS: "a prescribed stress acts on a flat branch (kh_plus or kh_minus = 0) "
    "that nothing slows; give the top a mass or the spring a dashpot",
    run.NOT_FINITE: "a stress or strain is no longer finite: the drive goes past the end of a "
    "branch (strain 1 on branch a, 1 + eps_star on branch c), or the stress by which a law in a "
    "chain resists the strain rate is zero at any rate",
}
_PULLED = run.FLAT_UNDER_STRESS, run.NOT_FINITE  # of a unilateral spring under tension
_STIFF = run.TOO_MANY_STEPS, run.STEP_UNDERFLOW  # after which implicit steps are tried
LOGGED = 64
AT_MOST = 1e-9  # error of an elongation over the height, or over the largest elongation

NO_DIRECTIONS: Directions = np.empty((0, 2), np.int64)
_NOTHING = np.zeros(1)


class Slopes(NamedTuple):
    """Derivatives of a motion in p directions."""

    displacement: Array  #: (p, nodes, n_t)
    base_stress: Array  #: (p, n_t)


@dataclass(eq=False, slots=True)  # as for `Plan`
class Motion:
    """Result of a run before verification; for the fields see `Response`."""

    displacement: Array
    base_stress: Array
    contact_end: float
    switches: Array
    steps: int
    method: str = CLOSED_FORM
    slopes: Slopes | None = None  #: None if no derivatives were requested
    unresolved: float = 0.0  #: size of damped-out vibrations, relative to the ranges
    strongest: float = 0.0  #: largest stress at an end of a step, Pa
    tol: float = 0.0  #: allowed error of a step


class Laws(NamedTuple):
    """The laws of a chain as the solver takes them."""

    records: tuple[Law, ...]
    made: tuple[Compiled, ...]
    loose: tuple[int, ...] = ()  #: numbers of the unilateral springs
    flowing: bool = False  #: whether one has internal variables


@lru_cache(maxsize=1024)
def _laws(records: tuple[Law, ...]) -> Laws:
    loose = tuple(i + 1 for i, law in enumerate(records) if law.kind == "unilateral")
    made = tuple(compiled(law) for law in records)
    return Laws(records, made, loose, any(one.kind == INTERNAL for one in made))


@lru_cache(maxsize=64)
def _numbers(
    drag: float, speed: float, tol: float, most: int, brief: float, over: bool,
    least: tuple[float, ...],
) -> Array:  # fmt: skip
    """Return the numbers that the loop over time is given, see `loop`; they are only read."""
    return np.array((drag, 1.0, speed, tol, most, brief, over, *least))


@dataclass(eq=False)  # a run reads it thirty times; a named tuple takes twice as long
class Plan:
    """A scene for many runs with other springs; above each group lies a mass, or the top."""

    solver: str  #: the simplest that suffices
    laws: Laws
    terms: int  #: number of relaxation terms in a row
    height: float  #: H, m
    ends: tuple[int, ...]  #: one past the last spring of each group
    mass: Array  #: areal masses of the nodes, m/A, kg/m², (groups,)
    drag: float  #: onsite damping of the top, η_site/H, Pa·s/m
    top: int  #: FREE, VISCOUS, STRESS or MOTION
    #: stress (Pa) or, for MOTION, displacement (m) of the top at t, (n,); for an impact the weight
    #: of the striker over the area, Pa, (1,)
    values: Array
    time: Array  #: sample times, s, (n,)
    speed: float  #: velocity of a striker at time 0, m/s; 0 for other drives, which start at t[0]
    margin: float  #: error of a step over the requested error
    max_steps: int
    max_explicit: int  #: explicit steps before implicit ones are tried
    damped: bool  #: whether a spring may have a dashpot
    least: float | None = None  #: least error of a step; None: that of the method
    implicit: bool | None = None  #: whether steps are implicit; None: only in stiff scenes

    def changed(self, **values: object) -> Plan:
        """Return a copy with other values (`dataclasses.replace` takes three times as long)."""
        other = object.__new__(Plan)
        vars(other).update(vars(self), **values)
        return other

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
            found = self._closed_form(rows, heights, rtol, everything, directions)
            if found is not None:
                return found
        drag = self.drag if drag is None else drag
        return self._integrated(rows, heights, rtol, drag, directions, everything)

    # ------------------------------------------------------------------ arrays of the solver

    def _memory(
        self, rows: Array, damped: bytes, directions: Directions, degree: int = 0,
        integrated: bool = True,
    ) -> Memory:  # fmt: skip
        """Return the memory of a run; `damped` is whether each spring has a dashpot."""
        terms = self.terms
        if terms and not rows[:, 1 : 1 + 2 * terms : 2].any():  # no strength: as without terms
            terms = terms if (directions[:, 1] >= OWN_RELAXATION).any() else 0
        shape = Shape(
            self.laws.records, terms, self.ends, self.top, damped, directions.tobytes(),
            self.speed > 0.0, degree, integrated,
        )  # fmt: skip
        return memory_of(shape)

    def _slopes(self, rows: Array) -> Array:
        return slopes_of(self.laws.made, rows[:, 1 + 2 * self.terms :])

    def _scales(self, rows: Array, heights: Array) -> tuple[float, float, float, float]:
        """Return least scales of displacement, velocity, strain and stress under a drive."""
        first, total = self._slopes(rows)[0].min(), heights.sum()
        most = float(np.abs(self.values).max())
        if self.top == run.MOTION:
            rate = np.abs(np.diff(self.values) / np.diff(self.time)).max(initial=0.0)
            return most, rate, most / total, 1e-3 * first * most / total
        return 1e-3 * most * total / first, 0.0, 1e-3 * most / first, most

    # ------------------------------------------------------------------ integration in time

    def _integrated(
        self, rows: Array, heights: Array, rtol: float, drag: float, directions: Directions,
        everything: bool, logged: int = LOGGED,
    ) -> Motion:  # fmt: skip
        """Integrate in time and log the switches, again if there are more than `logged`."""
        count, p = len(heights), len(directions)
        damped = (rows[:, 0] > 0.0).tobytes() if self.damped else bytes(count)
        methods = self._methods(rows, heights, drag, damped)
        out = np.empty((1 + p, 1 + (count if everything else 1), self.time.size))
        if count >= LEAST_AGGREGATE and methods[0] == p == 0:
            found = self._as_one(rows, heights, rtol, drag, out)
            if found is not None:
                return found
        log = np.empty((logged, 5)) if everything else NO_SWITCHES
        for degree in methods:
            reals = self._reals(rows, heights, rtol, drag, degree)
            _, told = self._integrate(rows, heights, damped, directions, out, log, reals, degree)
            outcome = told.item(run.OUTCOME)
            if outcome not in _STIFF:
                break
        if outcome == run.STEP_UNDERFLOW:
            fastest = max(self.fastest_rates(rows, heights, drag))
            told[run.OUTCOME] = run.TOO_FAST if fastest > FASTEST else run.STEP_UNDERFLOW
        if outcome == run.DONE and everything and told.item(run.SWITCHES) > logged:
            more = int(told.item(run.SWITCHES))
            return self._integrated(rows, heights, rtol, drag, directions, everything, more)
        method = RADAU if degree else EXPLICIT_STEPS
        return self._motion(out, method, told, log, rows, reals.item(loop.TOL))

    def _methods(self, rows: Array, heights: Array, drag: float, damped: bytes) -> tuple[int, ...]:
        """Return the degrees of the methods to try: 0 for explicit steps."""
        if self.implicit is not None or self.time.size == 1:
            return (run.POINTS,) if self.implicit and self.time.size > 1 else (0,)
        if drag or len(self.ends) > 1 or 1 in damped:
            vibrates, relaxes = self.fastest_rates(rows, heights, drag)
            if vibrates > MOST_VIBRATION or relaxes > MOST_RELAXATION:
                return run.POINTS, 0
        # Where explicit steps may take as many as all, implicit ones are not tried after them.
        return (0, run.POINTS) if self.max_explicit < self.max_steps else (0,)

    def _reals(
        self, rows: Array, heights: Array, rtol: float, drag: float, degree: int = 0
    ) -> Array:
        """Return the numbers that the loop over time is given; see `loop`."""
        least = self.least or (LEAST_OF_MASSES if len(self.ends) > 1 else LEAST_TOL)
        tol, most, brief, over = max(self.margin * rtol, least), self.max_steps, 0.0, False
        if degree:
            damped = bool(rows[:, 0].any())
            factor = OF_IMPLICIT if len(self.ends) == 1 else OF_IMPLICIT_MASSES
            least = self.least or (LEAST_TOL if damped else LEAST_VIBRATING)
            tol = max(factor * rtol, least)
            most = min(most, MOST_IMPLICIT_WORK // len(heights))
            first, lasts = self._slopes(rows)[0].tolist(), self._duration
            springs = first, rows[:, 0].tolist(), heights.tolist()
            if self.speed > 0.0:
                mass = self.mass.item(-1)
                lasts = min(lasts, 5.0 * rates.contact_time(*springs, mass, drag))
                over = rates.is_overdamped(*springs, mass)
            brief = SHORT * lasts * (tol / 3e-8) ** (1.0 / 6.0)
        elif self.implicit is None:
            most = self.max_explicit
        speed = self.speed
        least_scales = (0.0, speed, 0.0, 0.0) if speed > 0.0 else self._scales(rows, heights)
        return _numbers(drag, speed, tol, most, brief, over, least_scales)

    def _integrate(
        self, rows: Array, heights: Array, damped: bytes, directions: Directions, out: Array,
        log: Array, reals: Array, degree: int = 0,
    ) -> Memory:  # fmt: skip
        """Run the loop over time, with implicit steps if `degree` is not 0; return the memory."""
        memory = self._memory(rows, damped, directions, degree)
        drive = self.mass, reals, self.values, self.time
        cache.timed(loop.integrate, *memory, rows, heights, *drive, out, log)
        return memory

    def _as_one(
        self, rows: Array, heights: Array, rtol: float, drag: float, out: Array
    ) -> Motion | None:
        """Treat many springs under one stress as one spring in an impact, if that is possible."""
        count = len(heights)
        if len(self.ends) > 1 or self.terms or self.speed == 0.0:
            return None
        from foamfit.solve.compiled import aggregate  # which compiles it

        row = aggregate.row_of(self.laws.made, rows, heights)
        if row is None:
            return None
        law, made = aggregate.law_of(count)
        one = self.changed(laws=Laws((law,), (made,)), ends=(1,), implicit=False)
        row, height = np.concatenate(([0.0], row))[None], heights.sum(keepdims=True)
        reals = one._reals(row, height, AS_ONE * rtol / count / self.margin, drag)
        log = np.empty((4 * count + 64, 5))
        whole = out if out.shape[1] == 2 else np.empty((1, 2, self.time.size))
        words, told = one._integrate(row, height, b"\0", NO_DIRECTIONS, whole, log, reals)
        out[0, 0], out[0, -1] = whole[0, 0], whole[0, 1]
        if told[run.OUTCOME] == run.DONE:
            memory, end = told[len(run.NOW) + words[run.AT["row"]] :], told.item(run.ENDED)
            log = aggregate.nodes_and_switches(memory, heights, log[:, 0], self.time, end, out)
            told[run.SWITCHES], told[run.FINITE] = len(log), np.isfinite(out[0]).all()
        return self._motion(out, AGGREGATE, told, log, rows, reals.item(loop.TOL))

    def _motion(
        self, out: Array, method: str, told: Array, log: Array, rows: Array, tol: float
    ) -> Motion:
        """Return the result of a run as a Motion; raise SimulationError if it failed."""
        outcome, time, steps, switches, finite, strongest, *damped = told[: run.TOLD].tolist()
        if outcome != run.DONE or not finite:
            outcome = int(outcome) if outcome != run.DONE else run.NOT_FINITE
            raise self._failure(outcome, rows, steps=int(steps), time=time)
        slopes = Slopes(out[1:, 1:], out[1:, 0]) if len(out) > 1 else None
        log, lost = log[: int(switches)], loop.lost(strongest, *damped) if method == RADAU else 0.0
        first = out[0]
        return Motion(
            first[1:], first[0], time, log, int(steps), method, slopes, lost, strongest, tol
        )  # fmt: skip

    def _failure(self, outcome: int, rows: Array, **ending: float) -> SimulationError:
        """Return the error of a run that failed; `ending` has its number of steps and last time."""
        pulled = self.top == run.STRESS and outcome in _PULLED and self.values.min() < 0.0
        loose = [i for i in self.laws.loose if rows[i - 1, 0] == 0.0]
        if not (pulled and loose):
            return SimulationError(_FAILURES[outcome].format(**ending))
        at = int(np.argmax(self.values < 0.0))
        return SimulationError(
            f"the prescribed stress {self.values[at]:g} Pa (sample {at}) is a tension, which "
            f"spring {loose[0]} cannot carry because it is unilateral; give the spring a dashpot "
            "or the top a mass, or keep the stress at zero or above"
        )

    # ------------------------------------------------------------------ without integration

    def _closed_form(
        self, rows: Array, heights: Array, rtol: float, everything: bool, directions: Directions
    ) -> Motion | None:
        """Solve equilibrium under one stress, or one spring in known motion; None if unfit."""
        count, n = len(heights), self.time.size
        alone = self.top == run.MOTION and count == 1
        shown = count if everything else 1
        out = np.empty((1 + len(directions), 1 + shown, n))
        reals = np.array((0.0, 1.0, 0.0, rtol))
        damped = (rows[:, 0] > 0.0).tobytes()
        memory = self._memory(rows, damped, directions, integrated=False)
        given = *memory, rows, heights
        if alone:
            own, strain = directions[:, 1].tolist(), self.values / heights
            samples = np.empty((n, 4))
            drive = self.mass, reals, strain, self.time
            outcome = cache.timed(along.follow, *given, *drive, out, NO_SWITCHES, samples)
            if outcome == along.UNFIT:
                return None
            fine, strains, branches = outcome == run.DONE, strain[None], samples[None, :, 2]
            out[0, 1], out[1:, 1] = self.values, 0.0
            eta = rows.item(0, 0)
            histories.add_dashpot(out, self.time, strain, eta, heights.item(0), own, samples)
            fine = fine and (eta == 0.0 or bool(np.isfinite(out[0, 0]).all()))
        else:
            strains, branches = history = np.empty((2, count, n))
            drive = self.mass, reals, self.values, self.time
            miss = cache.timed(groups.balance, *given, *drive, out, NO_SWITCHES, history)
            fine = miss <= AT_MOST * self.height or miss <= AT_MOST * np.abs(self.values).max()
        if not fine:
            raise self._failure(run.NOT_FINITE, rows)
        slopes = Slopes(out[1:, 1:], out[1:, 0]) if len(out) > 1 else None
        switches = histories.switches(self.time, strains, branches) if everything else NO_SWITCHES
        return Motion(out[0, 1:], out[0, 0], math.nan, switches, 0, CLOSED_FORM, slopes)

    @property
    def _duration(self) -> float:
        return float(self.time[-1] - (0.0 if self.speed > 0.0 else self.time[0]))

    def fastest_rates(self, rows: Array, heights: Array, drag: float) -> tuple[float, float]:
        """Return the radians of vibration and relaxation that explicit steps would cover."""
        first, steep = self._slopes(rows)
        if self.terms:
            gain = 1.0 + rows[:, 1 : 1 + 2 * self.terms : 2].sum(axis=1)
            first, steep = gain * first, gain * steep
        chain = first.tolist(), steep.tolist(), rows[:, 0].tolist(), heights.tolist()
        nodes = self.ends, self.mass.tolist()
        struck = self.speed > 0.0
        return rates.fastest_rates(*chain, *nodes, drag, self.top, struck, self._duration)


def _time(t: ArrayLike) -> Array:
    time = as_samples(t, "t")  # a writable copy, for which the loops are compiled
    if time.ndim != 1 or time.size == 0:
        raise InputError("t must be a one-dimensional array with at least one sample")
    if not (time.item(-1) - time.item(0) < math.inf and increases(time)):
        wrong = ~np.isfinite(time)
        wrong[1:] |= ~(time[1:] > time[:-1])
        at = int(wrong.argmax())
        what = "later than the one before it" if math.isfinite(time[at]) else "finite"
        raise InputError(f"t must be finite and increase; sample {at} is not {what}")
    return time


def _check_viscous(laws: Laws, ends: tuple[int, ...], top: int) -> None:
    """Raise InputError for a viscous law in a group of springs, whose stress would be unknown."""
    nodes = {0, *(ends[:-1] if top in (run.STRESS, run.VISCOUS) else ends)}
    for i, (law, made) in enumerate(zip(laws.records, laws.made, strict=True)):
        if made.viscous and not {i, i + 1} <= nodes:
            raise InputError(
                f"spring {i + 1}: the stress of '{law.kind}' depends on the strain rate (viscous), "
                "so each of its ends needs a mass, a prescribed motion or the base"
            )


def plan(
    chain: Chain,
    drive: Drive,
    t: ArrayLike,
    *,
    dashpots: bool = False,
    relaxing: bool = False,
    max_steps: int = MAX_STEPS,
) -> Plan:
    """Prepare a scene: find the nodes that have a state, and the simplest solver.

    The plan depends on the heights, area, masses and site damping of the chain, and on which
    springs have a dashpot or relaxation terms. `t` (n_t,) are the sample times, s. `dashpots`
    allows for a dashpot in every spring and `relaxing` for the relaxation terms, even if they are
    zero. Steps are bounded by `max_steps`, and steps times springs by `MOST_WORK`. Raise InputError
    if times do not increase or do not match the drive.
    """
    time = _time(t)
    speed, values, top, above = 0.0, _NOTHING, run.FREE, chain.masses[-1]
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
            above, top = 0.0, run.MOTION
        elif above == 0.0:
            top = run.VISCOUS if chain.site_damping > 0.0 else run.STRESS
    arrays, count, laws = chain.arrays, len(chain.springs), _laws(chain.laws)
    masses, heavy = np.array([*arrays.inside, above / chain.area]), len(arrays.ends) > 1
    alone = top == run.MOTION and count == 1
    if laws.flowing:
        _check_viscous(laws, arrays.ends, top)
    internal = laws.flowing and not (alone and laws.made[0].flows < FLOWS)
    damped = dashpots or arrays.damped or top == run.VISCOUS or internal
    if heavy or above > 0.0:
        solver = SECOND_ORDER
    elif ((damped or relaxing or chain.relaxes) and not alone) or internal:
        solver = FIRST_ORDER
    else:
        solver = CLOSED_FORM
    margin = OF_MASSES if heavy else IN_SERIES if count > 1 else ALONE
    most = MOST_WORK // count + 2 * time.size + 8 * count
    most = max(1, min(max_steps, most, MOST_SAMPLED // count))
    explicit = min(most, 20 * time.size + max(1000, MOST_EXPLICIT_WORK // count))
    if laws.flowing:  # whose own rates no estimate knows; implicit steps are tried after a few
        explicit = min(explicit, most // 4)
    drag, terms = chain.site_damping / chain.height, max(chain.relaxation)
    return Plan(
        solver, laws, terms, chain.height, arrays.ends, masses, drag, top, values, time, speed,
        margin, most, explicit, damped,
    )  # fmt: skip
