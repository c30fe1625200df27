"""Estimated rates of vibration and relaxation of a chain, which explicit steps must resolve."""

from __future__ import annotations

import math

import numpy as np

from foamfit.arrays import Array
from foamfit.solve.scene import FREE, VISCOUS

# Ratio of the rates of stopping and of creep above which dashpots stop a striker long before the
# springs throw it back.
OVERDAMPED = 1e3


def contact_time(first: Array, eta: Array, heights: Array, mass: float, drag: float) -> float:
    """Return a rough estimate of the duration of contact of a striker with the chain, s."""
    soft = float(np.sum(heights / first))
    return math.sqrt(mass * soft) + drag * soft + float(np.max(eta / first))


def is_overdamped(first: Array, eta: Array, heights: Array, mass: float) -> bool:
    """Whether dashpots stop a striker of that mass long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends when the base stress has
    fallen to (a/b)² of its peak, which explicit steps, with errors relative to the peak, miss.
    """
    if not eta.all():
        return False
    soft, flow = float(np.sum(heights / first)), float(np.sum(heights / eta))
    return soft > OVERDAMPED * flow * flow * mass


def fastest_rates(
    first: Array,
    steep: Array,
    eta: Array,
    heights: Array,
    ends: Array,
    mass: Array,
    drag: float,
    top: int,
    struck: bool,
    duration: float,
) -> tuple[float, float]:
    """Estimate the fastest vibration and relaxation of a scene, as rate times duration (radians).

    `first` and `steep` are the slopes of the springs at rest and at most, `mass` that of the nodes;
    both estimates are infinite if the scene `is_overdamped`.
    """
    if struck and is_overdamped(first, eta, heights, float(mass[-1])):
        return math.inf, math.inf
    vibration = relaxation = below_stiff = below_damp = 0.0
    i0 = 0
    for g, end in enumerate(ends.tolist()):
        own, loose = slice(i0, end), eta[i0:end] == 0.0
        # compliance of the springs without dashpot; the others are rigid at first
        soft = float(np.sum((heights[own] / steep[own])[loose]))
        damp = 0.0 if loose.any() else 1.0 / float(np.sum(heights[own] / eta[own]))
        stiff = 1.0 / soft if soft > 0.0 else 0.0
        if soft == 0.0 and end - i0 == 1:
            stiff = float(steep[i0] / heights[i0])
        elif end - i0 > 1 and not loose.all():
            rest = steep[own] + heights[own] * stiff
            relaxation = max(
                relaxation, float(np.max((rest / np.where(loose, 1.0, eta[own]))[~loose]))
            )
        if g > 0:
            relaxation = max(relaxation, (below_damp + damp) / float(mass[g - 1]))
            vibration = max(vibration, math.sqrt((below_stiff + stiff) / float(mass[g - 1])))
        below_stiff, below_damp, i0 = stiff, damp, end
    if top == FREE:
        relaxation = max(relaxation, (below_damp + drag) / float(mass[-1]))
        vibration = max(vibration, math.sqrt(below_stiff / float(mass[-1])))
    elif top == VISCOUS:
        relaxation = max(relaxation, below_stiff / drag)
        if below_damp > 1e4 * drag:  # v = (push - Σ)/drag loses its digits
            relaxation = math.inf
    if struck:
        duration = min(duration, contact_time(first, eta, heights, float(mass[-1]), drag))
    return vibration * duration, relaxation * duration
