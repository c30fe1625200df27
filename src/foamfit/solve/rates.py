"""Estimated rates of vibration and relaxation of a chain, which explicit steps must resolve."""

from __future__ import annotations

import math

from foamfit.solve.scene import FREE, VISCOUS
from foamfit.springs.kernels import ETA, K0, KC, KH_PLUS, Array, Branches, compiled, inner

# Ratio of the rates of stopping and of creep above which dashpots stop a striker long before the
# springs throw it back.
OVERDAMPED = 1e3


@inner
def contact_time(rows: Array, heights: Array, mass: float, drag: float) -> float:
    """Return a rough estimate of the duration of contact of a striker with the chain, s."""
    soft, slow = 0.0, 0.0
    for i in range(heights.size):
        soft += heights[i] / rows[i, K0]
        slow = max(slow, rows[i, ETA] / rows[i, K0])
    return math.sqrt(mass * soft) + drag * soft + slow


@inner
def is_overdamped(rows: Array, heights: Array, mass: float) -> bool:
    """Whether dashpots stop a striker of that mass long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends when the base stress has
    fallen to (a/b)² of its peak, which explicit steps, with errors relative to the peak, miss.
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
    """Estimate the fastest vibration and relaxation of a scene, as rate times duration (radians).

    The estimates use the masses, dashpots and slopes of the springs; both are infinite if the scene
    `is_overdamped`.
    """
    if struck and is_overdamped(rows, heights, mass[-1]):
        return math.inf, math.inf
    vibration, relaxation = 0.0, 0.0
    below_stiff, below_damp = 0.0, 0.0
    i0 = 0
    for g in range(ends.size):
        soft = 0.0  # compliance of the springs without dashpot; the others are rigid at first
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
        if below_damp > 1e4 * drag:  # v = (push - Σ)/drag loses its digits
            relaxation = math.inf
    if struck:
        duration = min(duration, contact_time(rows, heights, mass[-1], drag))
    return vibration * duration, relaxation * duration
