"""How fast a chain vibrates and relaxes, and what of it implicit steps do not resolve.

Explicit steps must follow every rate; implicit ones damp out what is too fast for them. What they
damp out is estimated here, so that an answer can say what it lacks.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.implicit.collocation import COEFFICIENTS, STAGES, Points, State
from foamfit.solve.scene import FREE, STRESS, VISCOUS, Scene, SceneTuple
from foamfit.springs.kernels import (
    ETA,
    K0,
    KC,
    KH_MINUS,
    KH_PLUS,
    Array,
    compiled,
    inner,
    maker,
    slope_on,
)

# (Rate of stopping)/(rate of creep) from which dashpots stop a striker long before it is thrown
# back.
OVERDAMPED = 1e3


class Unresolved(NamedTuple):
    """Vibrations that steps did not resolve, per mass (groups,): see `unresolved_vibration`.

    worst (2,) is the largest motion and stress that they had at a sample; slopes (springs,) is
    scratch.
    """

    alive: Array
    begun: Array
    fading: Array
    worst: Array
    slopes: Array


@inner
def contact_time(scene: Scene) -> float:
    """Time, roughly, for which the mass on top stays on the chain that it strikes."""
    soft, slow = 0.0, 0.0
    for i in range(scene.heights.size):
        soft += scene.heights[i] / scene.rows[i, K0]
        slow = max(slow, scene.rows[i, ETA] / scene.rows[i, K0])
    return math.sqrt(scene.mass[-1] * soft) + scene.drag * soft + slow


@compiled
def fastest_rates(given: SceneTuple) -> tuple[float, float]:
    """Fastest vibration and fastest relaxation of a scene, as rates times its duration (radians).

    They are estimated row by row from the masses, dashpots and slopes of the springs: what steps
    that must follow every rate have to go through.
    """
    scene = Scene(*given)
    rows, heights, ends, mass, drag, top = scene[:6]
    vibration, relaxation = 0.0, 0.0
    below_stiff, below_damp = 0.0, 0.0
    i0 = 0
    for g in range(ends.size):
        soft = 0.0  # compliance of the springs without dashpot; the others start as rigid
        flow = 0.0
        for i in range(i0, ends[g]):
            slope = max(rows[i, K0], rows[i, KC], rows[i, KH_PLUS])
            if rows[i, ETA] == 0.0:
                soft += heights[i] / slope
            flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
        stiff = 1.0 / soft if soft > 0.0 else 0.0
        damp = 0.0 if flow == math.inf else 1.0 / flow
        for i in range(i0, ends[g]):
            slope = max(rows[i, K0], rows[i, KC], rows[i, KH_PLUS])
            if rows[i, ETA] == 0.0 or ends[g] - i0 == 1:
                if soft == 0.0:
                    stiff = slope / heights[i]
                continue
            rest = heights[i] * stiff
            relaxation = max(relaxation, (slope + rest) / rows[i, ETA])
        if g > 0:
            relaxation = max(relaxation, (below_damp + damp) / mass[g - 1])
            vibration = max(vibration, math.sqrt((below_stiff + stiff) / mass[g - 1]))
        below_stiff, below_damp = stiff, damp
        i0 = ends[g]
    if top == FREE:
        relaxation = max(relaxation, (below_damp + drag) / mass[-1])
        vibration = max(vibration, math.sqrt(below_stiff / mass[-1]))
    elif top == VISCOUS:
        relaxation = max(relaxation, below_stiff / drag)
        if below_damp > 1e4 * drag:  # explicit steps take the velocity from what little is left
            relaxation = math.inf
    duration = scene.t[scene.t.size - 1] - (0.0 if scene.speed > 0.0 else scene.t[0])
    if scene.speed > 0.0:
        duration = min(duration, contact_time(scene))
    return vibration * duration, relaxation * duration


@inner
def is_overdamped(scene: Scene) -> bool:
    """Tell whether dashpots stop a striker long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends where the base stress has
    fallen to (a/b)² of its peak: explicit steps, whose error is relative to the peak, lose it.
    """
    soft, flow = 0.0, 0.0
    for i in range(scene.heights.size):
        if scene.rows[i, ETA] == 0.0:
            return False
        soft += scene.heights[i] / scene.rows[i, K0]
        flow += scene.heights[i] / scene.rows[i, ETA]
    return scene.speed > 0.0 and soft > OVERDAMPED * flow * flow * scene.mass[-1]


@compiled
def stops_the_striker(given: SceneTuple) -> bool:
    """Tell whether a scene `is_overdamped`."""
    return is_overdamped(Scene(*given))


@maker
def _steepest(scene: Scene) -> Array:
    """Largest first slope of any branch of each spring."""
    slopes = np.empty(scene.heights.size)
    for i in range(slopes.size):
        row = scene.rows[i]
        slopes[i] = max(max(row[K0], row[KC]), max(row[KH_PLUS], row[KH_MINUS]))
    return slopes


@inner
def _group(scene: Scene, slopes: Array, g: int) -> tuple[float, float]:
    """Stiffness and damping that hold a mass through a group of springs; 0 where there is none."""
    groups = scene.ends.size
    if g == groups or (g == groups - 1 and scene.top == STRESS):
        return 0.0, 0.0
    soft, flow = 0.0, 0.0
    for i in range(scene.ends[g - 1] if g > 0 else 0, scene.ends[g]):
        eta = scene.rows[i, ETA]
        soft += scene.heights[i] / slopes[i]
        flow += scene.heights[i] / eta if eta > 0.0 else math.inf
    return 1.0 / soft, (0.0 if flow == math.inf else 1.0 / flow)


@maker
def of_masses(scene: Scene) -> Array:
    """Vibration of each mass between fixed neighbours: (masses, 2) rates 1/s, of it and its decay.

    Where the dashpots are too heavy for a vibration, (Σ c)² >= 4 μ Σ k, its rate is zero; else it
    dies out as exp(-Σ c t/(2 μ)).
    """
    groups, slopes = scene.ends.size, _steepest(scene)
    rates = np.zeros((groups, 2))
    below_stiff, below_damp = 0.0, 0.0
    for g in range(groups + 1):
        stiff, damp = _group(scene, slopes, g)
        if g > 0 and (g < groups or scene.top == FREE):
            mass, hold = scene.mass[g - 1], below_damp + damp
            hold += scene.drag if g == groups else 0.0
            if hold**2 < 4.0 * mass * (below_stiff + stiff):
                rates[g - 1, 0] = math.sqrt((below_stiff + stiff) / mass)
                rates[g - 1, 1] = 0.5 * hold / mass
        below_stiff, below_damp = stiff, damp
    return rates


@inner
def is_unresolved(rates: Array, span: float) -> bool:
    """Tell whether a mass vibrates too fast for a step and goes on vibrating after it."""
    for g in range(rates.shape[0]):
        if rates[g, 0] * span > 0.5 and rates[g, 1] * span < 20.0:
            return True
    return False


@inner
def unresolved_vibration(
    scene: Scene, state: State, at: Points, span: float, wait: float, r: Unresolved
) -> tuple[float, float, float, float]:
    """Vibrations that steps were too long to show: motion, stress; rate and decay of a new one.

    A mass whose velocity differs by δv from that at which the polynomial of the step sets out
    vibrates from then on by δv/ω, of which the points of the step show no more than δv/ω/(ω span).
    `begun` is filled with δv/√ω of each mass; that of earlier steps is in `alive`, since a
    vibration whose stiffness changes slowly keeps its energy over its frequency. `fading` is filled
    with the rate at which it dies out: of masses in a row the slowest vibration that the step is
    too long for decays last, and moves as far as all of them together. What is left after `wait` is
    returned.
    """
    moved, pressed, rate, decay, worst = 0.0, 0.0, 0.0, 0.0, 0.0
    below_stiff, below_damp = 0.0, 0.0
    ends, groups, z = scene.ends, scene.ends.size, at.z
    for i in range(scene.heights.size):
        r.slopes[i] = slope_on(scene.rows[i], state.branches[i], state.eps0[i])
    row = math.sin(0.5 * math.pi / max(groups, 2))
    for g in range(groups + 1):
        stiff, damp = _group(scene, r.slopes, g)
        if g > 0 and (g < groups or scene.top == FREE) and below_stiff + stiff > 0.0:
            mass, hold = scene.mass[g - 1], below_damp + damp
            hold += scene.drag if g == groups else 0.0
            own = math.sqrt((below_stiff + stiff) / mass)
            fade = 0.5 * hold / mass
            r.begun[g - 1] = 0.0
            if own * span > 2.0 and fade < own:
                kick = 0.0
                for j in range(STAGES):
                    kick += COEFFICIENTS[0, j] * z[ends[g - 1] - 1, j] / span
                r.begun[g - 1] = abs(kick) / math.sqrt(own)
                slow = fade * min(max(2.0 * row * row, 4.0 / (own * span) ** 2), 1.0)
                if r.alive[g - 1] > 1e-3 * r.begun[g - 1]:
                    slow = min(slow, r.fading[g - 1])
                r.fading[g - 1] = slow
                if r.begun[g - 1] > worst:
                    worst, rate, decay = r.begun[g - 1], own, slow
            size = (r.alive[g - 1] + r.begun[g - 1]) / math.sqrt(own)
            size *= math.exp(-r.fading[g - 1] * wait)
            moved += size
            pressed = max(pressed, max(below_stiff, stiff) * size)
        below_stiff, below_damp = stiff, damp
    return moved, pressed, rate, decay
