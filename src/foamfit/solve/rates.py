"""How fast a chain vibrates and relaxes: what explicit steps must follow.

Implicit steps damp out what is too fast for them.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math

from foamfit.solve.scene import FREE, VISCOUS, Scene, SceneTuple
from foamfit.springs.kernels import ETA, K0, KC, KH_PLUS, compiled, inner

# (Rate of stopping)/(rate of creep) from which dashpots stop a striker long before it is thrown
# back.
OVERDAMPED = 1e3


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
