"""Scenes with springs of registered laws: a time stepper that needs only the law's own functions.

A drive is linear between samples, and each step takes every spring to a new strain by the functions
of its law (`springs.laws.followed`). Springs in series carry one stress, which each step solves
for. A striker of areal mass M follows M dv/dt = -(Σ + η_site v/H), plus gravity if any, by the
velocity Verlet method. The scheme is of second order: for rate-dependent scenes, steps are halved
until two runs agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.solve.scene import MOTION, STRESS, Motion, Slopes, difference
from foamfit.springs import kernels
from foamfit.springs.chain import Chain
from foamfit.springs.laws import followed
from foamfit.springs.laws.followed import (
    AT_START,
    MEMORY,
    STRENGTH,
    TIME,
    Springs,
    compiled,
    inner,
)
from foamfit.springs.laws.record import BRANCH, EPS, Law
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_HEIGHT, OWN_RELAXATION

METHOD = "steps of any law"
FIRST_STEPS, MOST_STEPS = 400, 4_000_000
RELATIVE = 1e-5  # step of finite differences over the value of a parameter
ABSOLUTE = 1e-6  # the same at zero, over the scale of the parameter


@cache
def in_series(laws: tuple[Law, ...]) -> tuple[followed.Compiled, ...]:
    """Return loops for springs in series: start, impose a stress or elongation, write a sample."""
    loops, count = followed.loops_of(laws), len(laws)
    start, step, to_stress = loops.start, loops.step, loops.to_stress

    @inner
    def begin(springs: Springs) -> None:
        for i in range(count):
            start(i, springs.rows[i], springs.states[i], 0.0)

    @inner
    def stretch(springs: Springs, sigma: float, h: float) -> float:
        """Take all springs to a stress; return their elongation, m."""
        out = 0.0
        for i in range(count):
            out += springs.heights[i] * to_stress(i, springs, sigma, h)
        return out

    @inner
    def beside(given: tuple[Springs, float], sigma: float) -> float:
        """Return the elongation under a stress, without moving the springs."""
        return stretch(followed.trial_of(given[0]), sigma, given[1])

    find = followed.inverse(beside)

    @inner
    def elongate(springs: Springs, sigma: float, moved: float, h: float) -> float:
        """Take springs to an elongation, m; return their stress, found from the guess `sigma`."""
        if count == 1:
            # The base, but not as the constant 0, for which `step` would be compiled once more.
            return step(count - 1, springs, moved / springs.heights[0], h)
        common = find((springs, h), sigma, 1e-3 * max(abs(sigma), 1.0), 0.0, moved)
        if math.isfinite(common):
            stretch(springs, common, h)
        return common

    @inner
    def note(springs: Springs, j: int, nodes: Array, branches: NDArray[np.int64]) -> None:
        """Write the displacements and branches of a sample."""
        top = 0.0
        for i in range(count):
            top += springs.heights[i] * springs.states[i, EPS]
            nodes[i, j] = top
            branches[i, j] = int(springs.states[i, BRANCH])

    return begin, stretch, elongate, note


@cache
def driven(laws: tuple[Law, ...], top: int) -> Callable[..., tuple[float, bool]]:
    """Return the loop along a prescribed stress (Pa) or motion (m) for springs of these laws."""
    begin, stretch, elongate, note = in_series(laws)

    @inner
    def press(springs: Springs, sigma: float, value: float, h: float) -> float:
        return value if math.isfinite(stretch(springs, value, h)) else math.nan

    follow = press if top == STRESS else elongate  # the other is then not compiled

    @compiled
    def drive(
        springs: Springs, t: Array, values: Array, parts: int,
        nodes: Array, stress: Array, branches: NDArray[np.int64],
    ) -> tuple[float, bool]:  # fmt: skip
        """Follow a drive with a number of steps (`parts`) between samples."""
        sigma = 0.0
        begin(springs)
        for j in range(t.size):
            for k in range(parts if j else 1):
                part = (k + 1.0) / parts if j else 1.0
                before = values[j - 1] if j else 0.0
                value = before + part * (values[j] - before)
                h = (t[j] - t[j - 1]) / parts if j else AT_START
                sigma = follow(springs, sigma, value, h)
            if not math.isfinite(sigma):
                return math.nan, False
            stress[j] = sigma
            note(springs, j, nodes, branches)
        return math.nan, True

    return drive


@cache
def struck(laws: tuple[Law, ...]) -> Callable[..., tuple[float, bool]]:
    """Return the loop through an impact for springs of these laws."""
    begin, _, elongate, note = in_series(laws)
    count, delayed = len(laws), followed.loops_of(laws).delayed

    @compiled
    def strike(
        springs: Springs, mass: float, drag: float, speed: float, gravity: float, t: Array,
        parts: int,
        nodes: Array, stress: Array, branches: NDArray[np.int64],
    ) -> tuple[float, bool]:  # fmt: skip
        """Follow a striker from contact at t = 0; return the end of contact, s."""
        w, v, now, end, soft = 0.0, speed, 0.0, math.nan, 0.0
        begin(springs)
        for i in range(count):
            soft += springs.heights[i] / springs.eta[i]
        sigma = speed / soft  # stress of the dashpots at contact; 0 if a spring has none
        if count == 1:
            pace = speed / springs.heights[0], 0.0
            sigma += delayed(count - 1, springs.rows[0], springs.states[0], pace)
        for j in range(t.size):
            if t[j] <= 0.0:
                nodes[:, j], stress[j], branches[:, j] = 0.0, sigma if t[j] == 0.0 else 0.0, 0
                nodes[count - 1, j] = (speed + 0.5 * gravity * t[j]) * t[j]
                continue
            h = (t[j] - now) / parts
            for _ in range(parts if end != end else 0):
                half = v + 0.5 * h * (gravity - (sigma + drag * v) / mass)
                after = elongate(springs, sigma, w + h * half, h)
                if not math.isfinite(after):
                    return math.nan, False
                if after <= 0.0 and half < 0.0:
                    share = sigma / (sigma - after) if sigma > after else 0.0
                    end = now + share * h
                    w += share * h * half  # the velocity at the middle of the step
                    v = half + (share - 0.5) * h * (gravity - drag * half / mass)
                    break
                w += h * half
                v = half + 0.5 * h * (gravity - after / mass)
                v /= 1.0 + 0.5 * h * drag / mass
                sigma = after
                now += h
            if end == end:
                stress[j] = 0.0
                note(springs, j, nodes, branches)
                flown = t[j] - end
                shift = w + (v + 0.5 * gravity * flown) * flown - nodes[count - 1, j]
                for i in range(count):
                    nodes[i, j] += shift
            else:
                now, stress[j] = t[j], sigma
                note(springs, j, nodes, branches)
        return end, True

    return strike


class Followed(NamedTuple):
    """Result of one run; displacements and branches are (springs, n_t)."""

    nodes: Array
    stress: Array
    branches: NDArray[np.int64]
    contact_end: float
    parts: int


class AnyLawPlan(NamedTuple):
    """A scene prepared for springs of any laws, with the interface of a `solve.plan.Plan`."""

    laws: tuple[Law, ...]
    height: float
    top: int
    values: Array
    time: Array
    speed: float
    mass: Array  #: of the striker, (1,)
    drag: float

    @property
    def moves_one(self) -> bool:
        """See `solve.plan.Plan`: there is no derivative by the motion."""
        return False

    @property
    def solver(self) -> str:
        """See `solve.simulation.Response`."""
        return "second order" if self.speed > 0.0 else "first order"

    def springs(self, rows: Array, heights: Array) -> Springs:
        """Return springs from rows of own parameters, eta and relaxation terms, zero-padded."""
        sizes = [followed.sizes_of(law) for law in self.laws]
        counts = [len(law.names) for law in self.laws]
        room = max((rows.shape[1] - min(counts)) // 2, 0)
        own = np.zeros((len(rows), max(columns for columns, _ in sizes)))
        terms = np.zeros((len(rows), room, 3))
        terms[:, :, TIME] = math.inf
        for i, (law, count) in enumerate(zip(self.laws, counts, strict=True)):
            row = followed.row_of(law, rows[i, : count - 1])
            if row is None:
                raise SimulationError(f"the parameters of spring {i + 1} are not admissible")
            own[i, : row.size] = row
            relaxation = rows[i, count:]
            for k in range(relaxation.size // 2 if law.hysteretic else 0):
                if relaxation[2 * k] > 0.0:
                    terms[i, k, :2] = relaxation[2 * k : 2 * k + 2]
        used = terms[:, terms[:, :, STRENGTH].any(axis=0)] if room else terms
        eta = np.array([rows[i, count - 1] for i, count in enumerate(counts)])
        states = np.zeros((len(rows), max(states for _, states in sizes)))
        return Springs(own, states, np.ascontiguousarray(used), np.array(heights), eta)

    def follow(self, rows: Array, heights: Array, drag: float, parts: int) -> Followed:
        """Run once with `parts` steps between samples; raise SimulationError if not finite."""
        springs, shape = self.springs(rows, heights), (len(rows), self.time.size)
        rate, eta = None, springs.eta
        if self.top == MOTION and len(rows) == 1 and eta[0] > 0.0:  # rate prescribed
            rate = np.gradient(self.values / heights[0], self.time)
            springs = springs._replace(eta=np.zeros(1))
        nodes, stress, branches = np.empty(shape), np.empty(shape[1]), np.empty(shape, np.int64)
        springs.terms[:, :, MEMORY] = 0.0
        filled = parts, nodes, stress, branches
        if self.speed > 0.0:
            striker = self.mass[-1], drag, self.speed, self.values[0] / self.mass[-1]
            end, fine = struck(self.laws)(springs, *striker, self.time, *filled)
        else:
            loop = driven(self.laws, self.top)
            end, fine = loop(springs, self.time, self.values, *filled)
        if not fine:
            raise SimulationError(
                "a stress or strain is no longer finite: the drive exceeds the range of the law"
            )
        if rate is not None:
            stress += eta[0] * rate
        return Followed(nodes, stress, branches, end, parts)

    def resolve(self, rows: Array, heights: Array, drag: float, rtol: float) -> Followed:
        """Halve steps until base stress and displacement are accurate within `rtol`."""
        count, springs = self.time.size, self.springs(rows, heights)
        alone = self.top == MOTION and len(rows) == 1
        timed = bool(springs.terms.size) or (springs.eta.any() and not alone)
        timed |= any(law.is_viscous for law in self.laws)
        if self.speed == 0.0 and not timed:
            return self.follow(rows, heights, drag, 1)
        parts = max(FIRST_STEPS // count, 1)
        run = self.follow(rows, heights, drag, parts)
        while 2 * parts * count <= MOST_STEPS:
            parts *= 2
            finer = self.follow(rows, heights, drag, parts)
            miss = max(difference(finer.nodes, run.nodes), difference(finer.stress, run.stress))
            run = finer
            if miss <= 2.0 * rtol:
                return run
        raise SimulationError(
            f"{MOST_STEPS} steps leave an error above rtol = {rtol:g}: use a larger rtol"
        )

    def run(
        self,
        rows: Array,
        heights: Array,
        rtol: float = 1e-6,
        *,
        drag: float | None = None,
        everything: bool = True,
        directions: NDArray[np.int64] | None = None,
    ) -> Motion:
        """Run the scene as `solve.plan.Plan.run` does; derivatives are finite differences."""
        drag = self.drag if drag is None else drag
        found = self.resolve(rows, heights, drag, rtol)
        slopes = None
        if directions is not None and len(directions):
            pairs = [self._slope(rows, heights, drag, found, way) for way in directions]
            displacement, stress = zip(*pairs, strict=True)
            slopes = Slopes(np.array(displacement), np.array(stress))
        strain = np.diff(found.nodes, axis=0, prepend=0.0) / np.array(heights)[:, None]
        switches = kernels.list_switches(self.time, strain, found.branches)
        nodes = found.nodes if everything else found.nodes[-1:]
        if slopes is not None and not everything:
            slopes = slopes._replace(displacement=slopes.displacement[:, -1:])
        steps = found.parts * self.time.size
        return Motion(nodes, found.stress, found.contact_end, switches, steps, METHOD, slopes)

    def _slope(
        self, rows: Array, heights: Array, drag: float, found: Followed, way: Sequence[int]
    ) -> tuple[Array, Array]:
        """Return finite differences of displacements and base stress in one direction.

        They are one-sided at zero and at a limit of the law; SimulationError without either side.
        """
        spring, what = way
        count = len(self.laws[spring].names)
        places = {OWN_ETA: count - 1, OWN_HEIGHT: -1, DRAG: -1}
        place = places.get(what, count + what - OWN_RELAXATION if what > DRAG else what)
        value = {OWN_HEIGHT: heights[spring], DRAG: drag}.get(what, rows[spring, place])
        own = self.laws[spring].params
        peak = max(float(np.abs(found.stress).max()), 1.0)
        size = peak if what < len(own) and own[what].unit == "Pa" else 1.0
        # The scale of a dashpot carries all the stress.
        damping = peak * (float(self.time[-1] - self.time[0]) or 1.0)
        zero = {OWN_ETA: damping, DRAG: damping / self.height}
        step = RELATIVE * abs(value) or ABSOLUTE * zero.get(what, size)

        def shifted(by: float) -> Followed | None:
            moved, higher = rows.copy(), np.array(heights, dtype=float)
            if what == OWN_HEIGHT:
                higher[spring] += by
            elif what != DRAG:
                moved[spring, place] += by
            try:
                return self.follow(moved, higher, drag + by * (what == DRAG), found.parts)
            except SimulationError:
                return None

        above = shifted(step)
        below = shifted(-step) if value or above is None else None
        width = step * ((above is not None) + (below is not None))
        if width == 0.0:
            raise SimulationError(
                "a parameter of the law admits no nearby value: it has no derivative"
            )
        above, below = above or found, below or found
        return (above.nodes - below.nodes) / width, (above.stress - below.stress) / width


def plan_of(
    chain: Chain, time: Array, top: int, values: Array, speed: float, above: float
) -> AnyLawPlan:
    """Prepare a scene; `above` is the mass on top, kg, the other arguments are those of a `Plan`.

    Raise InputError for masses between springs, or a mass or damper under a prescribed stress.
    """
    if chain.arrays.heavy:
        raise InputError(
            "masses between springs require the paper's laws: leave them out in a chain with a "
            "registered law"
        )
    if speed == 0.0 and top not in (MOTION, STRESS):
        raise InputError(
            "a prescribed stress on a mass or an onsite damper requires the paper's laws: leave "
            "them out in a chain with a registered law"
        )
    drag, mass = chain.site_damping / chain.height, np.array([above / chain.area])
    return AnyLawPlan(chain.laws, chain.height, top, values, time, speed, mass, drag)
