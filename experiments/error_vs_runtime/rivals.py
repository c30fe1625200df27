"""Scenes of the study of error against run time, and all solvers for them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import foamfit as ff
from foamfit.solve.plan import plan
from foamfit.springs.chain import Drive

sys.path.append(str(Path(__file__).parents[1] / "stability"))
import independent
import with_scipy

Array = np.ndarray
Answer = tuple[Array, Array]  # displacement of the top (m) and base stress (Pa), (n,) each

SAMPLES, LENGTH = 501, 0.8e-3
MASS = 7e-3
MODEL_2, MODEL_3 = ff.published["foam-1/model-2"], ff.published["foam-1/model-3"]
HEIGHT, AREA = MODEL_2.chain.height, MODEL_2.chain.area

PUBLIC, KERNEL, SCIPY, HEYOKA = "foamfit simulate", "foamfit kernel", "SciPy", "heyoka"


@dataclass(frozen=True)
class Scene:
    """A chain under a drive, and the settings of each solver.

    `own` and `outside` are tolerances of foamfit and of SciPy; without the latter SciPy is left
    out. No setting is tried after one that takes `longest` (s).
    """

    name: str
    title: str
    chain: ff.Chain
    drive: Drive
    time: Array
    own: Sequence[float] = tuple(10.0**-k for k in range(2, 13))
    outside: Sequence[float] = tuple(10.0**-k for k in range(3, 13))
    longest: float = 0.3


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
            outside=rtol, longest=0.6,
        ),
        Scene(
            "1000_springs_impact", "1000 springs, impact at 2.2 m/s", graded(1000),
            ff.Impact(MASS, 2.2), t, own=(1e-6, 1e-10), outside=(), longest=4.0,
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
            ff.Chain([slow], [height], area), ff.DisplacementDrive(motion), pressed, outside=(),
        ),
        Scene(
            "linear_microscale_relaxation_impact",
            "a microscale spring with a relaxation term on a linear one, impact at 1.5 m/s",
            ff.Chain([base, quick], [0.2 * height, 0.8 * height], area), ff.Impact(2.0, 1.5),
            struck,
        ),
    ]  # fmt: skip


def solvers(scene: Scene) -> dict[str, dict[float, Callable[[], Answer]]]:
    """Return all solvers of a scene, and the runs of each by tolerance."""
    return own(scene) | by_scipy(scene) | by_heyoka(scene)


def own(scene: Scene) -> dict[str, dict[float, Callable[[], Answer]]]:
    """Return foamfit's solvers: `simulate`, and the bare `Plan.run` that a fit calls."""
    made = plan(scene.chain, scene.drive, scene.time)
    rows, heights = scene.chain.arrays.rows, scene.chain.arrays.heights

    def public(rtol: float) -> Answer:
        response = ff.simulate(scene.chain, scene.drive, scene.time, rtol)
        return response.displacement[-1], response.base_stress

    def kernel(rtol: float) -> Answer:
        motion = made.run(rows, heights, rtol, everything=False)
        return motion.displacement[-1], motion.base_stress

    return {
        name: {rtol: partial(run, rtol) for rtol in scene.own}
        for name, run in ((PUBLIC, public), (KERNEL, kernel))
    }


def by_scipy(scene: Scene) -> dict[str, dict[float, Callable[[], Answer]]]:
    """Return SciPy's integrators."""
    if not scene.outside:
        return {}
    impact = with_scipy.Impact(scene.chain, scene.drive, scene.time)
    return {
        f"{SCIPY} {method}": {rtol: partial(impact.run, method, rtol) for rtol in scene.outside}
        for method in with_scipy.METHODS
    }


def by_heyoka(scene: Scene) -> dict[str, dict[float, Callable[[], Answer]]]:
    """Return heyoka, if it is installed and the scene is an impact on one bistable spring."""
    if scene.name != "one_spring_impact" or find_spec("heyoka") is None:
        return {}
    import with_heyoka

    given = scene.chain, scene.drive, scene.time
    return {HEYOKA: {tol: with_heyoka.Impact(*given, tol).run for tol in (*scene.own, 1e-15)}}


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
