"""What all integrators share: the scene, its samples, how a run can end and what it finds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foamfit.springs.kernels import Array, Branches, inner

# What is known of the top: it has a mass, no mass but the onsite damper, its stress, its motion.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Outcomes.
DONE, TOO_MANY_STEPS, STEP_UNDERFLOW, FLAT_UNDER_STRESS, NOT_FINITE = range(5)
# The base stress is followed to its own size where that is at least so much of the springs'
# stresses: what has not come through to the base yet is not worth a step.
LEAST_BASE = 1e-6

CLOSED_FORM = "closed form"
NO_SWITCHES, _NONE = np.empty((0, 5)), np.zeros(0)

# A `Scene` as integrators are given it: a named tuple would cost each call a microsecond more.
SceneTuple = tuple[Array, Array, Branches, Array, float, int, Array, float, Array]


class Scene(NamedTuple):
    """A chain under a drive.

    rows (springs, columns) are the springs, base first (see `springs.kernels`), heights (springs,)
    is in m. ends (groups,) is one past the last spring of each group; above each lies a node of
    areal mass m/A, mass (groups,), kg/m². `drag` is the onsite damping of the top, η_site/H,
    Pa·s/m, and `top` what is known of it. values (n,) is the prescribed stress (Pa) or, for MOTION,
    displacement (m) of the top at the samples t (n,), s. `speed` is the velocity of a striker, m/s,
    at the time 0, and values (1,) its weight over the area, Pa; 0 = no impact, and every other
    drive starts at t[0].
    """

    rows: Array
    heights: Array
    ends: Branches
    mass: Array
    drag: float
    top: int
    values: Array
    speed: float
    t: Array


class Samples(NamedTuple):
    """The curves to fill, over the samples t (n,), counted each from the one before it in a drive.

    curves (1 + springs or 1, n): base stress, Pa, then displacements above each spring or of the
    top alone, m; slopes (p, …) are their derivatives.
    """

    t: Array
    curves: Array
    slopes: Array


class Slopes(NamedTuple):
    """Derivatives of displacement (p, nodes, n_t) and base stress (p, n_t) in p directions.

    Of those marked in `one_sided` (p,), there are two.
    """

    displacement: Array
    base_stress: Array
    one_sided: Array = _NONE


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


def difference(one: Array, other: Array) -> float:
    """Largest difference of two motions over the range of the first, rest included."""
    span = max(float(one.max()), 0.0) - min(float(one.min()), 0.0)
    return float(np.abs(one - other).max()) / span if span > 0.0 else 0.0


@inner
def log_switch(
    log: Array, switches: int, now: float, i: int, left: int, entered: int, eps: float
) -> int:
    """Note a change of branch where the log has place for it; returns how many there are now."""
    if switches < log.shape[0]:
        log[switches, 0], log[switches, 1], log[switches, 2] = now, i, left
        log[switches, 3], log[switches, 4] = entered, eps
    return switches + 1


@inner
def first_past(t: Array, first: int, end: float, last: bool) -> int:
    """First sample from `first` on at the time `end` or later; where it is the `last`, later."""
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
    """Write at + rate (t - now) + gravity (t - now)²/2 to `out`."""
    for j in range(t.size):
        out[j] = at + (rate + 0.5 * gravity * (t[j] - now)) * (t[j] - now)


@inner
def before_contact(curves: Array, t: Array, speed: float, gravity: float) -> int:
    """Fill the samples before contact, at time 0, and return how many these are.

    Nothing presses and only the striker moves.
    """
    rows = curves.shape[0]
    none = rows - rows  # not the literals, which are types: compiled anew
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
    """After contact the chain keeps its shape and moves with the striker; nothing presses."""
    for j in range(first, t.size):
        curves[0, j] = 0.0
    for i in range(curves.shape[0] - 1):
        fill_flight(w_end[i], speed, gravity, t[first:], t_end, curves[1 + i, first:])
