"""How fast a chain vibrates and relaxes, and what of it implicit steps pass over.

Explicit steps must follow every rate; implicit ones damp out what is too fast for them. What they
damp out is estimated here, so that an answer can say what it lacks.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math

import numpy as np

from foamfit.solve.explicit.series import FREE, STRESS, VISCOUS
from foamfit.solve.implicit.collocation import COEFFICIENTS, STAGES
from foamfit.springs.kernels import (
    ETA,
    K0,
    KC,
    KH_MINUS,
    KH_PLUS,
    Array,
    Branches,
    compiled,
    inner,
    maker,
    slope_on,
)

# (Rate of stopping)/(rate of creep) from which dashpots stop a striker long before it is thrown
# back.
FAINTLY = 1e3


@inner
def bounce(rows: Array, heights: Array, mass: Array, drag: float) -> float:
    """Time, roughly, for which the mass on top stays on the chain that it strikes."""
    soft, slow = 0.0, 0.0
    for i in range(heights.size):
        soft += heights[i] / rows[i, K0]
        slow = max(slow, rows[i, ETA] / rows[i, K0])
    return math.sqrt(mass[-1] * soft) + drag * soft + slow


@compiled
def hurry_of(
    rows: Array,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    speed: float,
    t: Array,
) -> tuple[float, float]:
    """How much faster than the scene its fastest vibration and its fastest relaxation are.

    Both are rates times duration, estimated row by row from the masses, dashpots and slopes of the
    springs: what steps that must follow every rate have to go through. Arguments as in
    `integrate_implicit`.
    """
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
    duration = t[t.size - 1] - (0.0 if speed > 0.0 else t[0])
    if speed > 0.0:
        duration = min(duration, bounce(rows, heights, mass, drag))
    return vibration * duration, relaxation * duration


@compiled
def parts_faintly(rows: Array, heights: Array, mass: float) -> bool:
    """Tell whether dashpots stop a striker long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends where the base stress has
    fallen to (a/b)² of its peak: explicit steps, whose error is relative to the peak, lose it.
    """
    soft, flow = 0.0, 0.0
    for i in range(heights.size):
        if rows[i, ETA] == 0.0:
            return False
        soft += heights[i] / rows[i, K0]
        flow += heights[i] / rows[i, ETA]
    return soft > FAINTLY * flow * flow * mass


@maker
def ringing_of(
    rows: Array, heights: Array, ends: Branches, mass: Array, drag: float, top: int
) -> Array:
    """Vibration of each mass between fixed neighbours: (masses, 2) rates 1/s, of it and its decay.

    Where the dashpots are too heavy for a vibration, (Σ c)² >= 4 μ Σ k, its rate is zero; else it
    dies out as exp(-Σ c t/(2 μ)).
    """
    rates = np.zeros((ends.size, 2))
    below_stiff, below_damp = 0.0, 0.0
    i0 = 0
    for g in range(ends.size + 1):
        stiff, damp = 0.0, 0.0
        if g < ends.size and not (g == ends.size - 1 and top == STRESS):
            soft, flow = 0.0, 0.0
            for i in range(i0, ends[g]):
                slope = max(max(rows[i, K0], rows[i, KC]), max(rows[i, KH_PLUS], rows[i, KH_MINUS]))
                soft += heights[i] / slope
                flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
            stiff, damp = 1.0 / soft, (0.0 if flow == math.inf else 1.0 / flow)
            i0 = ends[g]
        if g > 0 and (g < ends.size or top == FREE):
            hold = below_damp + damp + (drag if g == ends.size else 0.0)
            if hold**2 < 4.0 * mass[g - 1] * (below_stiff + stiff):
                rates[g - 1, 0] = math.sqrt((below_stiff + stiff) / mass[g - 1])
                rates[g - 1, 1] = 0.5 * hold / mass[g - 1]
        below_stiff, below_damp = stiff, damp
    return rates


@inner
def rings(rates: Array, span: float) -> bool:
    """Tell whether a mass vibrates too fast for a step and goes on vibrating after it."""
    for g in range(rates.shape[0]):
        if rates[g, 0] * span > 0.5 and rates[g, 1] * span < 20.0:
            return True
    return False


@inner
def passed_over(
    rows: Array,
    branches: Branches,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    eps0: Array,
    z: Array,
    span: float,
    wait: float,
    alive: Array,
    begun: Array,
    fading: Array,
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
    i0 = 0
    row = math.sin(0.5 * math.pi / max(ends.size, 2))
    for g in range(ends.size + 1):
        stiff, damp = 0.0, 0.0
        if g < ends.size and not (g == ends.size - 1 and top == STRESS):
            soft, flow = 0.0, 0.0
            for i in range(i0, ends[g]):
                soft += heights[i] / slope_on(rows[i], branches[i], eps0[i])
                flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
            stiff, damp = 1.0 / soft, (0.0 if flow == math.inf else 1.0 / flow)
            i0 = ends[g]
        if g > 0 and (g < ends.size or top == FREE) and below_stiff + stiff > 0.0:
            hold = below_damp + damp + (drag if g == ends.size else 0.0)
            own = math.sqrt((below_stiff + stiff) / mass[g - 1])
            fade = 0.5 * hold / mass[g - 1]
            begun[g - 1] = 0.0
            if own * span > 2.0 and fade < own:
                kick = 0.0
                for j in range(STAGES):
                    kick += COEFFICIENTS[0, j] * z[ends[g - 1] - 1, j] / span
                begun[g - 1] = abs(kick) / math.sqrt(own)
                slow = fade * min(max(2.0 * row * row, 4.0 / (own * span) ** 2), 1.0)
                if alive[g - 1] > 1e-3 * begun[g - 1]:
                    slow = min(slow, fading[g - 1])
                fading[g - 1] = slow
                if begun[g - 1] > worst:
                    worst, rate, decay = begun[g - 1], own, slow
            size = (alive[g - 1] + begun[g - 1]) / math.sqrt(own)
            size *= math.exp(-fading[g - 1] * wait)
            moved += size
            pressed = max(pressed, max(below_stiff, stiff) * size)
        below_stiff, below_damp = stiff, damp
    return moved, pressed, rate, decay
