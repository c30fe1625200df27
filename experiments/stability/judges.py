"""The judge by shorter steps: a scene at smaller tolerances, by either method of the solver."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

import foamfit as ff
from foamfit.solve.plan import MOST_WORK, Motion, plan

Scene = tuple[ff.Chain, ff.Impact | ff.StressDrive | ff.DisplacementDrive, NDArray[np.float64]]
MOST_RADIANS = 1e5


def bare(scene: Scene, rtol: float, implicit: bool | None = None, most: int = MOST_WORK) -> Motion:
    """Run a scene once, without the check by shorter steps that `simulate` makes.

    `most` bounds steps times springs.
    """
    chain, drive, time = scene
    max_steps = most // len(chain.springs) + time.size
    made = plan(chain, drive, time, max_steps=max_steps)._replace(implicit=implicit)
    return made.run(chain.arrays.rows, chain.arrays.heights, rtol)


def difference(one: ff.Response | Motion, other: ff.Response | Motion) -> float:
    """Largest difference of displacement, or of base stress, over the range of each."""
    worst = 0.0
    for a, b in ((one.displacement, other.displacement), (one.base_stress, other.base_stress)):
        span = float(np.ptp(np.append(b, 0.0)))
        miss = float(np.abs(a - b).max())
        if miss > 0.0:
            worst = max(worst, miss / span if span > 0.0 else math.inf)
    return worst


def explicit_fits(scene: Scene) -> bool:
    """Tell whether explicit steps are a judge: not where they lose digits, or hardly ever end."""
    chain, drive, time = scene
    rates = plan(chain, drive, time).fastest_rates(chain.arrays.rows, chain.arrays.heights)
    return max(rates) < MOST_RADIANS


def refined(
    scene: Scene, answer: ff.Response, rtol: float, *, implicit: bool, most: int
) -> float | None:
    """Difference of an answer from runs with ever smaller steps, until one agrees.

    None where the method (`implicit` or not) does not fit the scene: it gives up, within `most`
    steps times springs, says that it has damped out more than the tolerance, or does not agree with
    itself.
    """
    least, last = math.inf, None
    agrees = False
    for finer in (1e-2 * rtol, 1e-4 * rtol, 1e-6 * rtol):
        try:
            motion = bare(scene, finer, implicit, most)
        except ff.SimulationError:
            break
        if motion.unresolved > rtol:
            continue
        least = min(least, difference(answer, motion))
        agrees = last is not None and difference(motion, last) <= 0.1 * rtol
        last = motion
        if least <= rtol:
            return least
    return least if agrees else None
