"""Types and helpers shared by all integrators: scene, samples, outcomes and results of a run."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foamfit.errors import SimulationError
from foamfit.springs import kernels
from foamfit.springs.kernels import Array, Branches, inner
from foamfit.springs.law import UNILATERAL

# Top of the chain: with a mass, with an onsite damper only, under known stress, in known motion.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Outcomes of a run.
DONE, TOO_MANY_STEPS, STEP_UNDERFLOW, FLAT_UNDER_STRESS, NOT_FINITE = range(5)
_FAILURES = {
    TOO_MANY_STEPS: "the bound of {steps} steps was reached: something in the scene is "
    "too fast to be followed (a light mass or a heavy dashpot)",
    STEP_UNDERFLOW: "the step shrank to nothing near t = {time:g} s, where the scene "
    "changes faster than numbers can resolve (a strain at the end of its branch, a very light "
    "mass, or many springs on a flat branch)",
    FLAT_UNDER_STRESS: "a prescribed stress acts on a flat branch (kh_plus or kh_minus = 0) "
    "that nothing slows; give the top a mass or the spring a dashpot",
    NOT_FINITE: "a stress or strain is no longer finite: the drive goes past the end of a "
    "branch (strain 1 on branch a, 1 + eps_star on branch c)",
}
_PULLED = (FLAT_UNDER_STRESS, NOT_FINITE)  # of a unilateral spring under a prescribed tension
# Errors of the base stress are relative to its own size, or to this share of the largest stress in
# a spring if that is more: a pulse that has not reached the base yet must not shorten steps.
LEAST_BASE = 1e-6

CLOSED_FORM = "closed form"
NO_SWITCHES, _NONE = np.empty((0, 5)), np.zeros(0)

# The fields of a `Scene`, as compiled integrators take them: a named tuple costs 1 µs more a call.
SceneTuple = tuple[Array, Array, Branches, Array, float, int, Array, float, Array]


class Scene(NamedTuple):
    """A chain under a drive. Above each group of springs lies a node with a mass."""

    rows: Array  #: springs, base first, (springs, columns); see `springs.kernels`
    heights: Array  #: m, (springs,)
    ends: Branches  #: one past the last spring of each group, (groups,)
    mass: Array  #: areal masses of the nodes, m/A, kg/m², (groups,)
    drag: float  #: onsite damping of the top, η_site/H, Pa·s/m
    top: int  #: FREE, VISCOUS, STRESS or MOTION
    #: stress (Pa) or, for MOTION, displacement (m) of the top at t, (n,); for an impact the weight
    #: of the striker over the area, Pa, (1,)
    values: Array
    speed: float  #: velocity of a striker at time 0, m/s; 0 for other drives, which start at t[0]
    t: Array  #: sample times, s, (n,)


class Samples(NamedTuple):
    """The curves that a run fills."""

    t: Array  #: sample times, s, (n,); for explicit steps along a drive, since the previous sample
    #: base stress, Pa, then displacements above each spring or of the top only, m, (1 + nodes, n)
    curves: Array
    slopes: Array  #: derivatives of the curves, (p, 1 + nodes, n)


class Slopes(NamedTuple):
    """Derivatives of a motion in p directions."""

    displacement: Array  #: (p, nodes, n_t)
    base_stress: Array  #: (p, n_t)
    one_sided: Array = _NONE  #: 1 where left and right derivatives differ, (p,)


class Motion(NamedTuple):
    """Result of a run before verification; for the fields see `Response`."""

    displacement: Array
    base_stress: Array
    contact_end: float
    switches: Array
    steps: int
    method: str = CLOSED_FORM
    slopes: Slopes | None = None  #: None if no derivatives were requested
    unresolved: float = 0.0  #: size of damped-out vibrations, relative to the ranges


def difference(one: Array, other: Array) -> float:
    """Return the largest difference of two curves over the range (0 included) of the first."""
    span = max(float(one.max()), 0.0) - min(float(one.min()), 0.0)
    return float(np.abs(one - other).max()) / span if span > 0.0 else 0.0


def failure(outcome: int, top: int, values: Array, rows: Array, **ending: float) -> SimulationError:
    """Return the error of a run that failed; `ending` has its number of steps and its last time."""
    pulled = top == STRESS and outcome in _PULLED and values.min() < 0.0
    loose = (rows[:, kernels.KIND] == UNILATERAL) & (rows[:, kernels.ETA] == 0.0)
    if not (pulled and loose.any()):
        return SimulationError(_FAILURES[outcome].format(**ending))
    at = int(np.argmax(values < 0.0))
    return SimulationError(
        f"the prescribed stress {values[at]:g} Pa (sample {at}) is a tension, which spring "
        f"{int(loose.argmax()) + 1} cannot carry because it is unilateral; give the spring a "
        "dashpot or the top a mass, or keep the stress at zero or above"
    )


@inner
def log_switch(
    log: Array, switches: int, now: float, i: int, left: int, entered: int, eps: float
) -> int:
    """Log a change of branch if there is room; return the number of changes so far."""
    if switches < log.shape[0]:
        log[switches, 0], log[switches, 1], log[switches, 2] = now, i, left
        log[switches, 3], log[switches, 4] = entered, eps
    return switches + 1


@inner
def first_past(t: Array, first: int, end: float, last: bool) -> int:
    """Return the first sample from `first` on at or after `end`; strictly after it if `last`."""
    low, high, step = first, first, 1
    while high < t.size and (t[high] < end or (last and t[high] == end)):
        low, high = high + 1, high + step
        step *= 2
    high = min(high, t.size)
    while low < high:
        mid = (low + high) // 2
        if t[mid] < end or (last and t[mid] == end):
            low = mid + 1
        else:
            high = mid
    return low


@inner
def fill_flight(at: float, rate: float, gravity: float, t: Array, now: float, out: Array) -> None:
    """Write at + rate (t - now) + gravity (t - now)²/2 into `out`."""
    for j in range(t.size):
        out[j] = at + (rate + 0.5 * gravity * (t[j] - now)) * (t[j] - now)


@inner
def before_contact(curves: Array, t: Array, speed: float, gravity: float) -> int:
    """Fill the samples before contact, when only the striker moves; return their number."""
    rows = curves.shape[0]
    none = rows - rows  # a literal would be another type and compile again
    done = first_past(t, none, 0.0, none > 0)
    for i in range(rows):
        for j in range(done):
            curves[i, j] = 0.0
    fill_flight(0.0, speed, gravity, t[:done], 0.0, curves[rows - 1, :done])
    return done


@inner
def fly(
    curves: Array, t: Array, first: int, t_end: float, w_end: Array, speed: float, gravity: float
) -> None:
    """Fill the samples after contact: no base stress, and the chain moves with the striker."""
    for j in range(first, t.size):
        curves[0, j] = 0.0
    for i in range(curves.shape[0] - 1):
        fill_flight(w_end[i], speed, gravity, t[first:], t_end, curves[1 + i, first:])
