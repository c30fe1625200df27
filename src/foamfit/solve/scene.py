"""Types and helpers shared by all integrators: scene, samples, outcomes and results of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import SimulationError

# Top of the chain: with a mass, with an onsite damper only, under known stress, in known motion.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Outcomes of a run.
DONE, TOO_MANY_STEPS, STEP_UNDERFLOW, FLAT_UNDER_STRESS, NOT_FINITE, TOO_FAST = range(6)
_FAILURES = {
    TOO_MANY_STEPS: "the bound of {steps} steps was reached: something in the scene is "
    "too fast to be followed (a light mass or a heavy dashpot)",
    STEP_UNDERFLOW: "the step shrank to nothing near t = {time:g} s, where the scene "
    "changes faster than numbers can resolve (a strain at the end of its branch, a very light "
    "mass, or many springs on a flat branch)",
    TOO_FAST: "something in the scene is too fast to be followed (a light mass, or a dashpot that "
    "is very light beside a stiff spring)",
    FLAT_UNDER_STRESS: "a prescribed stress acts on a flat branch (kh_plus or kh_minus = 0) "
    "that nothing slows; give the top a mass or the spring a dashpot",
    NOT_FINITE: "a stress or strain is no longer finite: the drive goes past the end of a "
    "branch (strain 1 on branch a, 1 + eps_star on branch c), or the stress by which a law in a "
    "chain resists the strain rate is zero at any rate",
}
_PULLED = (FLAT_UNDER_STRESS, NOT_FINITE)  # of a unilateral spring under a prescribed tension

CLOSED_FORM = "closed form"
NO_SWITCHES = np.empty((0, 5))


class Slopes(NamedTuple):
    """Derivatives of a motion in p directions."""

    displacement: Array  #: (p, nodes, n_t)
    base_stress: Array  #: (p, n_t)


@dataclass(eq=False, slots=True)  # as for `plan.Plan`
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


def difference(one: Array, other: Array) -> float:
    """Return the largest difference of two curves over the range (0 included) of the first."""
    span = max(float(one.max()), 0.0) - min(float(one.min()), 0.0)
    return float(np.abs(one - other).max()) / span if span > 0.0 else 0.0


def failure(outcome: int, top: int, values: Array, loose: list[int], **ending: float) -> Exception:
    """Return the error of a run that failed; `ending` has its number of steps and its last time.

    `loose` are the numbers of unilateral springs without a dashpot.
    """
    pulled = top == STRESS and outcome in _PULLED and values.min() < 0.0
    if not (pulled and loose):
        return SimulationError(_FAILURES[outcome].format(**ending))
    at = int(np.argmax(values < 0.0))
    return SimulationError(
        f"the prescribed stress {values[at]:g} Pa (sample {at}) is a tension, which spring "
        f"{loose[0]} cannot carry because it is unilateral; give the spring a dashpot or the top a "
        "mass, or keep the stress at zero or above"
    )
