"""How fast a chain vibrates and relaxes, and what of it implicit steps do not resolve.

Explicit steps must follow every rate; implicit ones damp out what is too fast for them. What they
damp out is estimated here, so that a response can be refused where that exceeds its tolerance.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math
from typing import NamedTuple

from foamfit.solve.implicit.collocation import COEFFICIENTS, STAGES, Points, State
from foamfit.solve.scene import FREE, STRESS, VISCOUS, Scene, SceneTuple
from foamfit.springs.kernels import (
    ETA,
    K0,
    KC,
    KH_PLUS,
    Array,
    compiled,
    inner,
    slope_on,
)

# (Rate of stopping)/(rate of creep) from which dashpots stop a striker long before it is thrown
# back.
OVERDAMPED = 1e3


class Unresolved(NamedTuple):
    """Vibrations that steps did not resolve, per mass (groups,): see `remember`.

    worst (2,) is the largest motion and stress that they had at a sample; rates (groups, 3) are
    those of the last step (`_fill_rates`), slopes (springs,) is scratch.
    """

    alive: Array
    fading: Array
    worst: Array
    rates: Array
    slopes: Array


@inner
def contact_time(scene: Scene) -> float:
    """Time, roughly, for which the mass on top stays on the chain that it strikes."""
    soft, slow = 0.0, 0.0
    for i in range(scene.heights.size):
        soft += scene.heights[i] / scene.rows[i, K0]
        slow = max(slow, scene.rows[i, ETA] / scene.rows[i, K0])
    return math.sqrt(scene.mass[-1] * soft) + scene.drag * soft + slow


@inner
def is_overdamped(scene: Scene) -> bool:
    """Whether dashpots stop a striker long before the springs throw it back.

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
def fastest_rates(given: SceneTuple) -> tuple[float, float]:
    """Fastest vibration and fastest relaxation of a scene, as rates times its duration (radians).

    They are estimated row by row from the masses, dashpots and slopes of the springs: what steps
    that must follow every rate have to go through. Infinite where a scene `is_overdamped`.
    """
    scene = Scene(*given)
    if is_overdamped(scene):
        return math.inf, math.inf
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


@inner
def _fill_rates(scene: Scene, slopes: Array, rates: Array) -> None:
    """Fill (masses, 3) how each vibrates between fixed neighbours; zeros where nothing vibrates.

    The columns are the rate and that of its decay, 1/s, and the stiffness on its stiffer side.
    """
    groups = scene.ends.size
    below_stiff, below_damp = 0.0, 0.0
    for g in range(groups + 1):
        stiff, damp = _group(scene, slopes, g)
        if g > 0:
            rates[g - 1] = 0.0
        if g > 0 and (g < groups or scene.top == FREE) and below_stiff + stiff > 0.0:
            mass, hold = scene.mass[g - 1], below_damp + damp
            hold += scene.drag if g == groups else 0.0
            rates[g - 1, 0] = math.sqrt((below_stiff + stiff) / mass)
            rates[g - 1, 1] = 0.5 * hold / mass
            rates[g - 1, 2] = max(below_stiff, stiff)
        below_stiff, below_damp = stiff, damp


@inner
def is_unresolved(rates: Array, span: float) -> bool:
    """Whether a mass vibrates too fast for a step and goes on vibrating after it."""
    for g in range(rates.shape[0]):
        own, fade = rates[g, 0], rates[g, 1]
        if own * span > 0.5 and fade < own and fade * span < 20.0:
            return True
    return False


@inner
def remember(
    scene: Scene, state: State, at: Points, span: float, wait: float, r: Unresolved
) -> None:
    """Add what a step was too long to show to the vibrations that the answer lacks.

    A mass whose velocity differs by δv from that at which the polynomial of the step sets out
    vibrates from then on by δv/ω, of which the points of the step show no more than δv/ω/(ω span).
    `alive` is δv/√ω of all steps so far, since a vibration whose stiffness changes slowly keeps its
    energy over its frequency. `fading` is the rate at which it dies out: of masses in a row the
    slowest vibration that the step is too long for decays last, and moves as far as all of them
    together. `worst` counts what is left after `wait`, at the first sample that may show it.
    """
    moved, pressed = 0.0, 0.0
    for i in range(scene.heights.size):
        r.slopes[i] = slope_on(scene.rows[i], state.branches[i], state.eps0[i])
    _fill_rates(scene, r.slopes, r.rates)
    row = math.sin(0.5 * math.pi / max(scene.ends.size, 2))
    for g in range(scene.ends.size):
        own, fade, stiff = r.rates[g, 0], r.rates[g, 1], r.rates[g, 2]
        if own == 0.0:
            continue
        if own * span > 2.0 and fade < own:
            kick = 0.0
            for j in range(STAGES):
                kick += COEFFICIENTS[0, j] * at.z[scene.ends[g] - 1, j] / span
            begun = abs(kick) / math.sqrt(own)
            slow = fade * min(max(2.0 * row * row, 4.0 / (own * span) ** 2), 1.0)
            r.fading[g] = min(slow, r.fading[g]) if r.alive[g] > 1e-3 * begun else slow
            r.alive[g] += begun
        size = r.alive[g] / math.sqrt(own) * math.exp(-r.fading[g] * wait)
        moved += size
        pressed = max(pressed, stiff * size)
        r.alive[g] *= math.exp(-r.fading[g] * span)
    r.worst[0], r.worst[1] = max(r.worst[0], moved), max(r.worst[1], pressed)
