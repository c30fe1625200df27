"""Scenes of the study of error against run time, and all solvers for them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import fixed_step
import foamfit as ff
import restarted
import restarted_memory
import written_law
from foamfit.solve.plan import plan
from foamfit.springs.chain import Drive

sys.path.append(str(Path(__file__).parents[1] / "stability"))
import independent

Array = np.ndarray
Answer = tuple[Array, Array]  # displacement of the top (m) and base stress (Pa), (n,) each
# Fixed-step schemes by number of steps, and SciPy's integrators by method and rtol.
Rivals = tuple[dict[str, Callable[[int], Answer]], Callable[[str, float], Answer]]

SAMPLES, LENGTH = 501, 0.8e-3
MASS = 7e-3
MODEL_2, MODEL_3 = ff.published["foam-1/model-2"], ff.published["foam-1/model-3"]
HEIGHT, AREA = MODEL_2.chain.height, MODEL_2.chain.area

PUBLIC, KERNEL = "foamfit simulate", "foamfit kernel"


@dataclass(frozen=True)
class Scene:
    """A chain under a drive, and the settings of each solver.

    `own` and `outside` are tolerances of foamfit and of SciPy, `substeps` the steps of fixed-step
    schemes between two samples. No setting is tried after one that takes `longest` (s). `looks` is
    that of `restarted.impact`.
    """

    name: str
    title: str
    chain: ff.Chain
    drive: Drive
    time: Array
    own: Sequence[float] = tuple(10.0**-k for k in range(2, 13))
    outside: Sequence[float] = tuple(10.0**-k for k in range(3, 13))
    substeps: Sequence[int] = tuple(2**k for k in range(11))
    longest: float = 0.3
    looks: int = 0


def graded(count: int, mass: float = 0.0, eta: float = 0.0) -> ff.Chain:
    """Return springs of foam-1/model-2 with k0, k_c, Δσ, k_h±, ε_a, ε_c varied by ±10 %, shuffled.

    No two of them switch at the same stress. `mass` (kg) is divided among the nodes between them.
    """
    rng = np.random.default_rng(count)
    steps = 0.1 * (2.0 * (np.arange(count) + 0.5) / count - 1.0)
    base = MODEL_2.bistable
    springs = [
        ff.BistableSpring(
            base.k0 * f, base.kc * f, base.dsigma * f, base.eps_a * g, base.eps_c * g,
            base.kh_plus * f, base.kh_minus * f, eta,
        )
        for f, g in zip(1 + rng.permutation(steps), 1 + rng.permutation(steps), strict=True)
    ]  # fmt: skip
    masses = [mass / max(count - 1, 1)] * (count - 1) + [0.0]
    return ff.Chain(springs, [HEIGHT / count] * count, AREA, masses)


def scenes() -> list[Scene]:
    """Return all scenes, small ones first."""
    t = np.linspace(0.0, LENGTH, SAMPLES)
    spring = MODEL_2.bistable
    one = ff.Chain([spring], [HEIGHT], AREA)
    two = MODEL_3.chain
    rtol = tuple(10.0**-k for k in range(5, 11))
    return [
        Scene("one_spring_impact", "one spring, impact at 2.0 m/s", one, ff.Impact(MASS, 2.0), t),
        Scene(
            "two_springs_mass_impact",
            "two springs with the specimen's mass between, onsite damper, impact at 2.3 m/s", two,
            ff.Impact(MASS, 2.3), t, outside=tuple(10.0**-k for k in range(3, 12)), longest=1.0,
        ),
        Scene(
            "10_springs_mass_impact",
            "10 springs with dashpots of 2 Pa·s and 9 masses between, impact at 2.2 m/s",
            graded(10, MODEL_2.specimen_mass, 2.0), ff.Impact(MASS, 2.2), t,
            outside=rtol, looks=4, longest=0.6,
        ),
        Scene(
            "1000_springs_impact", "1000 springs, impact at 2.2 m/s", graded(1000),
            ff.Impact(MASS, 2.2), t, own=(1e-6, 1e-10), outside=(1e-7, 1e-8, 1e-10, 1e-11),
            substeps=(1, 4, 16), longest=4.0,
            looks=4,
        ),
        *_with_memory(),
    ]  # fmt: skip


def _with_memory() -> list[Scene]:
    """Return scenes of a microscale spring like shoe foam; two of three with relaxation."""
    law = (5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77)
    height, area = 25e-3, 1.6e-3
    plain = ff.MicroscaleSpring(*law)
    slow = ff.MicroscaleSpring(*law, relaxation=[(0.5, 0.2)])
    quick = ff.MicroscaleSpring(*law, relaxation=[(0.5, 0.01)])
    struck = np.linspace(0.0, 0.08, SAMPLES)
    pressed = np.linspace(0.0, 2.0, 1280)
    motion = 0.6 * height * np.sin(np.pi * pressed) ** 2 * np.where(pressed < 1.0, 1.0, 0.8)
    base = ff.LinearSpring(5e6)
    return [
        Scene(
            "microscale_impact", "one microscale spring, impact at 1.5 m/s",
            ff.Chain([plain], [height], area), ff.Impact(2.0, 1.5), struck,
        ),
        Scene(
            "microscale_relaxation_displacement",
            "one microscale spring with a relaxation term, displacement drive of two cycles",
            ff.Chain([slow], [height], area), ff.DisplacementDrive(motion), pressed,
        ),
        Scene(
            "linear_microscale_relaxation_impact",
            "a microscale spring with a relaxation term on a linear one, impact at 1.5 m/s",
            ff.Chain([base, quick], [0.2 * height, 0.8 * height], area), ff.Impact(2.0, 1.5),
            struck,
        ),
    ]  # fmt: skip


@dataclass(frozen=True)
class Competitor:
    """One solver at one setting."""

    family: str
    setting: str
    run: Callable[[], Answer]


def _ladder(
    family: str, run: Callable[[Any], Answer], values: Sequence[Any], text: str = "rtol = {:.0e}"
) -> dict[str, list[Competitor]]:
    """Return a solver at several settings."""
    return {family: [Competitor(family, text.format(v), partial(run, v)) for v in values]}


def own(scene: Scene) -> dict[str, list[Competitor]]:
    """Return foamfit's solvers: `simulate`, and the bare `Plan.run` that a fit calls."""
    made = plan(scene.chain, scene.drive, scene.time)
    rows, heights = scene.chain.arrays.rows, scene.chain.arrays.heights

    def public(rtol: float) -> Answer:
        response = ff.simulate(scene.chain, scene.drive, scene.time, rtol)
        return response.displacement[-1], response.base_stress

    def kernel(rtol: float) -> Answer:
        motion = made.run(rows, heights, rtol, everything=False)
        return motion.displacement[-1], motion.base_stress

    return _ladder(PUBLIC, public, scene.own) | _ladder(KERNEL, kernel, scene.own)


def others(scene: Scene) -> dict[str, list[Competitor]]:
    """Return the fixed-step schemes and SciPy's integrators."""
    if not isinstance(scene.chain.springs[-1], ff.MicroscaleSpring):
        fixed, outside = _bistable(scene)
    elif isinstance(scene.drive, ff.Impact):
        fixed, outside = _microscale_impact(scene)
    else:
        fixed, outside = _microscale_displacement(scene)
    out, steps = dict[str, list[Competitor]](), [n * (scene.time.size - 1) for n in scene.substeps]
    for name, run in fixed.items():
        out |= _ladder(name, run, steps, "{} steps")
    for method in restarted.METHODS:
        out |= _ladder(f"SciPy {method}", partial(outside, method), scene.outside)
    return out


def _bistable(scene: Scene) -> Rivals:
    rows, heights, t = written_law.rows_of(scene.chain), np.array(scene.chain.heights), scene.time
    made = plan(scene.chain, scene.drive, t)

    def fixed(scheme: int, steps: int) -> Answer:
        out = np.zeros(t.size), np.zeros(t.size)
        given = rows, heights, np.array(made.ends), made.mass, made.drag, made.speed, t
        fixed_step.impact(*given, steps // (t.size - 1), scheme, *out)
        return out

    def outside(method: str, rtol: float) -> Answer:
        system = restarted.System(rows, heights, made.mass, made.drag, made.speed)
        return restarted.impact(system, t, method, rtol, scene.looks)

    return {name: partial(fixed, k) for k, name in enumerate(fixed_step.NAMES)}, outside


def _microscale_impact(scene: Scene) -> Rivals:
    """Return solvers of a microscale spring, alone or on a linear one."""
    t, drive = scene.time, scene.drive
    row = restarted_memory.row_of(scene.chain, drive.mass)

    def fixed(steps: int) -> Answer:
        out = np.zeros(t.size), np.zeros(t.size)
        restarted_memory.runge_kutta(row, drive.velocity, t, steps // (t.size - 1), *out)
        return out

    def outside(method: str, rtol: float) -> Answer:
        system = restarted_memory.MemorySystem(row, drive.velocity)
        return restarted.impact(system, t, method, rtol, scene.looks)

    return {"Runge-Kutta 4": fixed}, outside


def _microscale_displacement(scene: Scene) -> Rivals:
    t, row = scene.time, restarted_memory.row_of(scene.chain)
    motion = np.array(scene.drive.displacement)
    eps = motion / scene.chain.height

    def by_hand(steps: int) -> Answer:
        out = np.zeros(t.size)
        restarted_memory.recursion(row, t, eps, steps // (t.size - 1), out)
        return motion, out

    def outside(method: str, rtol: float) -> Answer:
        return motion, restarted_memory.along_displacement(row, t, eps, method, rtol)

    return {"exponential recursion": by_hand}, outside


def reference(scene: Scene) -> Answer:
    """Return the result of the judge of the stability study, some 14 digits."""
    most = 10_000_000 * len(scene.chain.springs)
    truth = independent.follow(scene.chain, scene.drive, scene.time, most=most)
    assert not truth.why
    return truth.displacement[-1], truth.base_stress


def error(answer: Answer, truth: Answer) -> float:
    """Return the largest error over range of top displacement and base stress."""
    worst = 0.0
    for got, want in zip(answer, truth, strict=True):
        miss = np.abs(got - want).max() / np.ptp(want)
        worst = max(worst, float(miss) if np.isfinite(miss) else np.inf)
    return worst
