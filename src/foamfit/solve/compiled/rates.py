"""Vibration and relaxation of a chain: what explicit steps must resolve and implicit ones miss."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from foamfit.solve.compiled.run import FREE, STRESS, VISCOUS, spring
from foamfit.springs.compiled.contract import inner

# Ratio of the rates of stopping and of creep above which dashpots stop a striker long before the
# springs throw it back.
OVERDAMPED = 1e3


def _compliance(heights: Iterable[float], slopes: Iterable[float]) -> float:
    """Return the sum of h/k, m/Pa or m/(Pa·s)."""
    return sum(h / k if k > 0.0 else math.inf for h, k in zip(heights, slopes, strict=True))


def contact_time(
    first: Sequence[float], eta: Sequence[float], heights: Sequence[float], mass: float, drag: float
) -> float:
    """Return a rough estimate of the duration of contact of a striker with the chain, s."""
    soft = _compliance(heights, first)
    slowest = max(loss / k if k > 0.0 else math.inf for loss, k in zip(eta, first, strict=True))
    return math.sqrt(mass * soft) + drag * soft + slowest


def is_overdamped(
    first: Sequence[float], eta: Sequence[float], heights: Sequence[float], mass: float
) -> bool:
    """Whether dashpots stop a striker of that mass long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends when the base stress has
    fallen to (a/b)² of its peak, which explicit steps, with errors relative to the peak, miss.
    """
    if not all(eta):
        return False
    soft, flow = _compliance(heights, first), _compliance(heights, eta)
    return soft > OVERDAMPED * flow * flow * mass


def fastest_rates(
    first: Sequence[float], steep: Sequence[float], eta: Sequence[float], heights: Sequence[float],
    ends: Sequence[int], mass: Sequence[float], drag: float, top: int, struck: bool,
    duration: float,
) -> tuple[float, float]:  # fmt: skip
    """Estimate the fastest vibration and relaxation, as rate times duration (radians)."""
    # `first` and `steep` are the slopes of the springs at rest and at most, `mass` of the nodes.
    if struck and is_overdamped(first, eta, heights, mass[-1]):
        return math.inf, math.inf
    vibration = relaxation = below_stiff = below_damp = 0.0
    i0 = 0
    for g, end in enumerate(ends):
        own = range(i0, end)
        # compliance of the springs without dashpot; the others are rigid at first
        loose = [i for i in own if eta[i] == 0.0]
        soft = _compliance([heights[i] for i in loose], [steep[i] for i in loose])
        damp = 0.0 if loose else 1.0 / _compliance(heights[i0:end], eta[i0:end])
        stiff = 1.0 / soft if soft > 0.0 else 0.0
        if soft == 0.0 and end - i0 == 1:
            stiff = steep[i0] / heights[i0]
            if top == STRESS and eta[i0] != 0.0:  # it settles against its dashpot
                relaxation = max(relaxation, steep[i0] / eta[i0])
        elif end - i0 > 1:
            rates = [(steep[i] + heights[i] * stiff) / eta[i] for i in own if eta[i] != 0.0]
            relaxation = max(relaxation, *rates, 0.0)
        if g > 0:
            relaxation = max(relaxation, (below_damp + damp) / mass[g - 1])
            vibration = max(vibration, math.sqrt((below_stiff + stiff) / mass[g - 1]))
        below_stiff, below_damp, i0 = stiff, damp, end
    if top == FREE:
        relaxation = max(relaxation, (below_damp + drag) / mass[-1])
        vibration = max(vibration, math.sqrt(below_stiff / mass[-1]))
    elif top == VISCOUS:
        relaxation = max(relaxation, below_stiff / drag)
        if below_damp > 1e4 * drag:  # v = (push - Σ)/drag loses its digits
            relaxation = math.inf
    if struck:
        duration = min(duration, contact_time(first, eta, heights, mass[-1], drag))
    return vibration * duration, relaxation * duration


# ---------------------------------------------------------------- during implicit steps


@inner
def stiffness_of(c, g, damped):
    """Return the stiffness of a group or, if `damped`, its damping; 0 beyond both ends."""
    if g >= c.groups or (g == c.groups - 1 and c.nodes < c.groups and c.top == STRESS):
        return 0.0
    soft = 0.0
    for i in range(c.first[g], c.first[g + 1]):
        s = spring(c, i)
        part = s.eta if damped else s.gain * s.tangent
        soft += s.height / part if part > 0.0 else math.inf
    return 1.0 / soft


@inner
def is_unresolved(c, span):
    """Whether a mass vibrates too fast for a step and keeps vibrating after it."""
    for g in range(c.nodes):
        own = math.sqrt((stiffness_of(c, g, False) + stiffness_of(c, g + 1, False)) * c.per_mass[g])
        fade = 0.5 * c.per_mass[g] * (stiffness_of(c, g, True) + stiffness_of(c, g + 1, True))
        if own * span > 0.5 and fade < own and fade * span < 20.0 and c.top != VISCOUS:
            return True
    return False


@inner
def remember(c, span, wait):
    """Add the vibrations that a step was too long to resolve to those the response lacks.

    A mass whose velocity differs by δv from the initial velocity of the step's polynomial then
    vibrates with amplitude δv/ω. `alive` (groups, 2) sums δv/√ω over all steps, because a vibration
    whose stiffness changes slowly conserves energy over frequency, and keeps the decay rate of the
    slowest: in a row of masses the slowest unresolved vibration decays last, with the amplitude of
    all of them together. What the response lacks includes the vibration left after `wait`, at the
    first sample that may show it.
    """
    motion = stress = 0.0
    alive, r = c.alive, c.now
    row = math.sin(0.5 * math.pi / max(c.nodes, 2))
    for g in range(c.nodes):
        below, above = stiffness_of(c, g, False), stiffness_of(c, g + 1, False)
        damping = stiffness_of(c, g, True) + stiffness_of(c, g + 1, True)
        damping += c.drive.dragged if g == c.groups - 1 else 0.0
        own = math.sqrt((below + above) * c.per_mass[g])
        fade, root = 0.5 * damping * c.per_mass[g], math.sqrt(own)
        if (g == c.groups - 1 and c.top != FREE) or own == 0.0:
            continue
        started = 0.0
        if own * span > 2.0 and fade < own:
            started = abs(c.line[2 * g] - span * c.y[2 * g + 1]) / span / root
            slow = fade * min(max(2.0 * row * row, 4.0 / (own * span) ** 2), 1.0)
            lasting = alive[2 * g] > 1e-3 * started
            alive[2 * g + 1] = min(slow, alive[2 * g + 1]) if lasting else slow
            alive[2 * g] += started
        if alive[2 * g] > 0.0:
            size = alive[2 * g] / root * math.exp(-alive[2 * g + 1] * wait)
            motion += size
            stress = max(stress, max(below, above) * size)
            alive[2 * g] *= math.exp(-alive[2 * g + 1] * span)
    r.motion_lost, r.stress_lost = max(r.motion_lost, motion), max(r.stress_lost, stress)
