"""SciPy's integrators for an impact, restarted wherever a branch or contact ends.

They follow the equations of the judge of the stability study, which are compiled. The solver
objects are stepped directly (`solve_ivp` costs more per step), and a switch is a root of the
solver's dense output.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from scipy.integrate import DOP853, LSODA, Radau
from scipy.optimize import brentq

import independent as judge
from independent import Array, Flags, System

METHODS = {"DOP853": DOP853, "LSODA": LSODA, "Radau": Radau}
TINY = 4 * np.finfo(float).eps
MOST_SWITCHES = 10_000

compiled = njit(cache=True, error_model="numpy")


def equations(system: System) -> Callable[[Array, np.ndarray, Array, Array], Array]:
    """Compile d/dt of the state with the constants of a run, which need not be handed over then.

    It is NaN past the pole of a law, where a step is rejected.
    """
    springs, relax, ends, mass = system.springs, system.relax, system.ends, system.mass
    drag, top, speed, gravity = system.drag, system.top, system.speed, system.gravity

    @njit(error_model="numpy")
    def rates(y: Array, branch: np.ndarray, ranks: Array, most: Array) -> Array:
        out, stress, work = np.empty(y.size), np.empty(ends.size), np.empty((4, branch.size))
        own = System(springs, relax, ends, mass, drag, top, speed, gravity, work[0], work)
        if not judge.fill_rates(y, out, stress, Flags(branch, ranks, most), own, 0.0, 0.0):
            out[:] = math.nan
        return out

    return rates


@compiled
def passed(states: Array, flags: Flags, system: System, peak: float) -> tuple[int, float, float]:
    """Return the first of the states (size, n) past a switch (-1: none) and its overshoot.

    Also return the largest base stress. Contact may end if `peak` is positive.
    """
    rates, stress, past = np.empty(states.shape[0]), np.empty(system.ends.size), -math.inf
    paces, largest = np.ones(flags.branch.size), 0.0
    for j in range(states.shape[1]):
        y = states[:, j].copy()
        judge.fill_rates(y, rates, stress, flags, system, 0.0, 0.0)
        past = judge.overshoot(y, rates, paces, flags, system, stress[0], peak)
        if past > 0.0:
            return j, past, largest
        largest = max(largest, stress[0])
    return -1, past, largest


@compiled
def enter(y: Array, flags: Flags, system: System) -> None:
    """Change the branch of each spring that has left its branch or reversed."""
    rates, stress, moving = np.empty(y.size), np.empty(system.ends.size), system.ends.size
    for _ in range(4):
        judge.fill_rates(y, rates, stress, flags, system, 0.0, 0.0)
        if not judge.enter_branches(y, rates, moving, flags, system.springs):
            break


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
    """An impact for SciPy: its equations, and state, branches and samples of the last run."""

    def __init__(self, chain: Any, drive: Any, time: Array) -> None:
        self.time, (self.system, self.kinds) = time, judge.system_of(chain, drive, time)
        self.rates, nodes = equations(self.system), self.system.ends.size
        self.first = np.zeros(nodes + self.kinds.size + self.system.relax[:, :, 0].size)
        self.first[nodes - 1] = self.system.speed
        stiff = self.system.springs[:, judge.K0]
        self.scale = np.full(self.first.size, stiff.max())  # of relaxing stresses
        self.scale[:nodes] = self.system.speed
        by_strain = self.kinds < judge.HELD  # a microscale spring moves by its stress
        strains = np.where(by_strain, 1.0, stiff)
        self.scale[nodes : nodes + self.kinds.size] = strains

    def run(self, method: str, rtol: float) -> tuple[Array, Array]:
        """Return displacement of the striker and base stress at the samples.

        Switches are detected at the samples and at the ends of steps.
        """
        count, self.y, self.done, self.peak = self.kinds.size, self.first.copy(), 0, 0.0
        self.flags = Flags(self.kinds.copy(), np.full(count, -math.inf), np.full(count, -math.inf))
        self.nodes, self.base = np.zeros((count, self.time.size)), np.zeros(self.time.size)
        now = float(self.time[0])
        for _ in range(MOST_SWITCHES):
            enter(self.y, self.flags, self.system)
            with np.errstate(all="ignore"):  # a stage past a pole: the step is rejected
                now, ended = self._phase(now, method, rtol)
            if ended:
                return self.nodes[-1], self.base
        raise RuntimeError(f"{method}: too many switches at rtol = {rtol:g}")

    def _phase(self, now: float, method: str, rtol: float) -> tuple[float, bool]:
        """Continue to the next switch; return its time, and whether samples or contact end."""
        branch, ranks, most = self.flags
        solver: Any = METHODS[method](
            lambda _, y: self.rates(y, branch, ranks, most), now, self.y, float(self.time[-1]),
            rtol=rtol, atol=rtol * self.scale,
        )  # fmt: skip
        while solver.status == "running":
            message = solver.step()
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                raise RuntimeError(f"{method}: {message or 'not finite'}")
            last = int(np.searchsorted(self.time, solver.t, side="right"))
            times = np.append(self.time[self.done : last], solver.t)
            dense = solver.dense_output() if last > self.done else None
            states = dense(times) if dense else solver.y[:, None]
            first, _, largest = passed(states, self.flags, self.system, self.peak)
            if first >= 0:
                dense = dense or solver.dense_output()
                low = times[first - 1] if first > 0 else solver.t_old
                return self._switch(dense, states, low, times[first])
            self._keep(states, last)
            if largest > 10.0 * rtol * self.system.springs[0, judge.K0]:
                self.peak = max(self.peak, largest)
        return now, True

    def _keep(self, states: Array, last: int) -> None:
        """Write the samples up to number `last`."""
        if last > self.done:
            given = states[:, : last - self.done]
            write(given, self.flags, self.system, self.nodes, self.base, self.done)
            self.done = last

    def _switch(self, dense: Any, states: Array, low: float, high: float) -> tuple[float, bool]:
        """Go to the switch between two times; return its time and whether contact ends there."""

        def gap(at: float) -> float:
            return passed(dense(at)[:, None], self.flags, self.system, self.peak)[1]

        end = _root(gap, low, high)
        self._keep(states, int(np.searchsorted(self.time, end)))
        self.y = dense(end)
        if not self.peak or passed(self.y[:, None], self.flags, self.system, 0.0)[1] > 0.0:
            return end, False
        rest, top = self.nodes[:, self.done :], self.system.ends.size - 1
        write(self.y[:, None], self.flags, self.system, self.nodes, self.base, self.done)
        rest[:] = rest[:, :1] + self.y[top] * (self.time[self.done :] - end)
        self.base[self.done :] = 0.0
        return end, True


def _root(gap: Callable[[float], float], low: float, high: float) -> float:
    """Return a time just after `gap` becomes positive; it is positive at `high`."""
    for part in (0.0, 0.01, 0.1, 0.3, 0.6, 0.9):  # a previous switch is at `low` up to rounding
        start = low + part * (high - low)
        if gap(start) <= 0.0:
            break
    else:
        return low
    end, step = float(brentq(gap, start, high, xtol=TINY * high, rtol=TINY)), TINY * high
    while gap(end) <= 0.0:
        end, step = min(end + step, high), 2.0 * step
    return end
