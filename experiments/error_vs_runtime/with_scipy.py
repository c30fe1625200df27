"""SciPy's `solve_ivp` for an impact, restarted wherever a branch or contact ends.

It integrates the equations of the judge of the stability study, which are compiled; the ends are
its terminal events.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp

import independent as judge
from independent import Array, Flags, System

METHODS = ("DOP853", "LSODA", "Radau")
TINY = 4 * np.finfo(float).eps
MOST_SWITCHES = 10_000

compiled = njit(cache=True, error_model="numpy")


def equations(system: System) -> tuple[Callable[..., Any], ...]:
    """Compile functions of time, state and `Flags` with the constants of a run.

    They return d/dt of the state (NaN past the pole of a law, where a step is rejected), the
    overshoot past the end of a branch, and the base stress, which ends contact.
    """
    springs, relax, ends, mass = system.springs, system.relax, system.ends, system.mass
    drag, top, speed, gravity = system.drag, system.top, system.speed, system.gravity
    still = np.ones(springs.shape[0])

    @njit(error_model="numpy")
    def filled(y: Array, flags: Flags) -> tuple[Array, Array, float]:
        out, stress, work = np.empty(y.size), np.empty(ends.size), np.empty((4, still.size))
        own = System(springs, relax, ends, mass, drag, top, speed, gravity, work[0], work)
        if not judge.fill_rates(y, out, stress, flags, own, 0.0, 0.0):
            out[:] = math.nan
        return out, stress, judge.overshoot(y, out, still, flags, own, stress[0], 0.0)

    @njit
    def rates(_: float, y: Array, branch: np.ndarray, ranks: Array, most: Array) -> Array:
        return filled(y, Flags(branch, ranks, most))[0]

    @njit
    def passed(_: float, y: Array, branch: np.ndarray, ranks: Array, most: Array) -> float:
        return filled(y, Flags(branch, ranks, most))[2]

    @njit
    def pressed(_: float, y: Array, branch: np.ndarray, ranks: Array, most: Array) -> float:
        return filled(y, Flags(branch, ranks, most))[1][0]

    for event, direction in ((passed, 1), (pressed, -1)):
        event.terminal, event.direction = True, direction
    return rates, passed, pressed


@compiled
def enter(y: Array, flags: Flags, system: System) -> int:
    """Change the branch of each spring that has left its branch or reversed; count them."""
    rates, stress, moving = np.empty(y.size), np.empty(system.ends.size), system.ends.size
    judge.fill_rates(y, rates, stress, flags, system, 0.0, 0.0)
    return judge.enter_branches(y, rates, moving, flags, system.springs)


@compiled
def write(
    states: Array, flags: Flags, system: System, nodes: Array, base: Array, done: int
) -> None:
    """Fill in displacements and base stress at the samples from `done` on."""
    rates, stress, now = np.empty(states.shape[0]), np.empty(system.ends.size), np.zeros(1)
    for j in range(states.shape[1]):
        y = states[:, j].copy()
        judge.fill_rates(y, rates, stress, flags, system, 0.0, 0.0)
        judge.record_samples(
            y, system.ends.size, flags, system.springs, now, 0.0, 0, stress[0],
            nodes[:, done + j :], base[done + j :],
        )  # fmt: skip


class Impact:
    """The equations of an impact for SciPy."""

    def __init__(self, chain: Any, drive: Any, time: Array) -> None:
        self.time, (self.system, self.kinds) = time, judge.system_of(chain, drive, time)
        self.rates, *self.events = equations(self.system)
        nodes = self.system.ends.size
        self.first = np.zeros(nodes + self.kinds.size + self.system.relax[:, :, 0].size)
        self.first[nodes - 1] = self.system.speed
        stiff = self.system.springs[:, judge.K0]
        self.scale = np.full(self.first.size, stiff.max())  # of relaxing stresses
        self.scale[:nodes] = self.system.speed
        by_strain = self.kinds < judge.HELD  # a microscale spring moves by its stress
        self.scale[nodes : nodes + self.kinds.size] = np.where(by_strain, 1.0, stiff)

    def run(self, method: str, rtol: float) -> tuple[Array, Array]:
        """Return displacement of the striker and base stress at the samples."""
        time, y, count, done = self.time, self.first.copy(), self.kinds.size, 0
        flags = Flags(self.kinds.copy(), np.full(count, -math.inf), np.full(count, -math.inf))
        nodes, base, now = np.zeros((count, time.size)), np.zeros(time.size), float(time[0])
        while enter(y, flags, self.system):
            pass
        for turn in range(MOST_SWITCHES):
            events = self.events if turn else self.events[:1]  # contact ends after a switch
            with np.errstate(all="ignore"):  # a stage past a pole: the step is rejected
                found = solve_ivp(
                    self.rates, (now, time[-1]), y, method, time[done:], events=events,
                    args=flags, rtol=rtol, atol=rtol * self.scale,
                )  # fmt: skip
            if found.status < 0 or not all(np.isfinite(one).all() for one in found.y):
                raise RuntimeError(f"{method}: {found.message}")
            if len(found.t):
                write(found.y, flags, self.system, nodes, base, done)
                done += len(found.t)
            if found.status == 0:
                return nodes[-1], base
            left = turn > 0 and found.t_events[1].size > 0
            now, y = float(found.t_events[left][0]), found.y_events[left][0]
            if left:
                write(y[:, None], flags, self.system, nodes, base, done)
                top = self.system.ends.size - 1
                nodes[:, done:] = nodes[:, done, None] + y[top] * (time[done:] - now)
                base[done:] = 0.0
                return nodes[-1], base
            slope, step = self.rates(now, y, *flags), TINY * now
            for _ in range(60):  # the event is right up to rounding
                if enter(y, flags, self.system):
                    break
                y, step = y + step * slope, 2.0 * step
        raise RuntimeError(f"{method}: too many switches at rtol = {rtol:g}")
