"""How fast a chain vibrates and relaxes: what explicit steps must follow.

Implicit steps damp out what is too fast for them.
"""

from __future__ import annotations

import math

from foamfit.solve.scene import FREE, VISCOUS
from foamfit.springs.kernels import ETA, K0, KC, KH_PLUS, Array, Branches, compiled, inner

# (Rate of stopping)/(rate of creep) from which dashpots stop a striker long before it is thrown
# back.
OVERDAMPED = 1e3


@inner
def contact_time(rows: Array, heights: Array, mass: float, drag: float) -> float:
    """Time, roughly, for which the mass on top stays on the chain that it strikes."""
    soft, slow = 0.0, 0.0
    for i in range(heights.size):
        soft += heights[i] / rows[i, K0]
        slow = max(slow, rows[i, ETA] / rows[i, K0])
    return math.sqrt(mass * soft) + drag * soft + slow


@inner
def is_overdamped(rows: Array, heights: Array, mass: float) -> bool:
    """Whether dashpots stop a striker of that mass long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends where the base stress has
    fallen to (a/b)² of its peak: explicit steps, whose error is relative to the peak, lose it.
    """
    soft, flow = 0.0, 0.0
    for i in range(heights.size):
        if rows[i, ETA] == 0.0:
            return False
        soft += heights[i] / rows[i, K0]
        flow += heights[i] / rows[i, ETA]
    return soft > OVERDAMPED * flow * flow * mass


@compiled
def fastest_rates(
    rows: Array,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    struck: bool,
    duration: float,
) -> tuple[float, float]:
    """Fastest vibration and relaxation of a scene, as rates times its duration (radians).

    They are estimated from the masses, dashpots and slopes of the springs. Infinite where a scene
    `is_overdamped`.
    """
    if struck and is_overdamped(rows, heights, mass[-1]):
        return math.inf, math.inf
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
    if struck:
        duration = min(duration, contact_time(rows, heights, mass[-1], drag))
    return vibration * duration, relaxation * duration
