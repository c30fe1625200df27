"""SciPy's integrators as an external reference, restarted at every switch of a branch.

They are made as fast as is sensible: right-hand sides, Jacobians and switching functions are
compiled, the solver objects are stepped directly (`solve_ivp` costs more per step), and a switch is
a root of the solver's dense output. Massless springs in series are integrated in their common
stress, which makes everything explicit: C(s) ds/dt = dw/dt with the compliance C = Σ h_i/k_i of eq.
2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from scipy.integrate import DOP853, LSODA, Radau
from scipy.optimize import brentq

import written_law as law

METHODS = {"DOP853": DOP853, "LSODA": LSODA, "Radau": Radau}
TINY = 4 * np.finfo(float).eps

compiled = njit(cache=True, error_model="numpy")


@compiled
def entered(branch, rising):
    """Return the branch that a spring enters when it leaves another."""
    return law.above(branch) if rising else law.below(branch)


# ---------------------------------------------------------------- a mass above every spring


@compiled
def nodes_rate(y, rows, branches, heights, mass, drag):
    """Return d/dt of (displacements, velocities) of the nodes."""
    n = mass.size
    out = np.empty(2 * n)
    over = -drag * y[2 * n - 1]
    for i in range(n - 1, -1, -1):
        u, rate = y[i], y[n + i]
        if i > 0:
            u -= y[i - 1]
            rate -= y[n + i - 1]
        stress = (
            law.stress_on(rows[i], branches[i], u / heights[i])
            + rows[i, law.ETA] * rate / heights[i]
        )
        out[i] = y[n + i]
        out[n + i] = (over - stress) / mass[i]
        over = stress
    return out


@compiled
def nodes_jacobian(y, rows, branches, heights, mass, drag):
    """Return the derivative of `nodes_rate` by the state, (2n, 2n)."""
    n = mass.size
    out = np.zeros((2 * n, 2 * n))
    out[2 * n - 1, 2 * n - 1] = -drag / mass[n - 1]
    for i in range(n):
        out[i, n + i] = 1.0
        u = y[i] - (y[i - 1] if i > 0 else 0.0)
        stiff = law.slope_on(rows[i], branches[i], u / heights[i]) / heights[i]
        dash = rows[i, law.ETA] / heights[i]
        for by, part in ((0, stiff), (n, dash)):
            out[n + i, by + i] -= part / mass[i]
            if i > 0:
                out[n + i, by + i - 1] += part / mass[i]
                out[n + i - 1, by + i] += part / mass[i - 1]
                out[n + i - 1, by + i - 1] -= part / mass[i - 1]
    return out


@compiled
def nodes_room(states, rows, branches, heights, pressed):
    """Find the first state (2n, samples) where a spring has left its branch or contact ended.

    Return its index (-1 = none), the smallest distance there to a switch in strain (base stress
    over k0 for contact), the spring (-1 = contact) and the side. Without a switch these describe
    the last state.
    """
    n = heights.size
    least, who, side = np.inf, -1, 0
    for j in range(states.shape[1]):
        least = np.inf
        for i in range(n):
            eps = (states[i, j] - (states[i - 1, j] if i > 0 else 0.0)) / heights[i]
            low, high = law.interval(rows[i], branches[i])
            if eps - low < least:
                least, who, side = eps - low, i, -1
            if high - eps < least:
                least, who, side = high - eps, i, 1
        if pressed:
            eps = states[0, j] / heights[0]
            base = law.stress_on(rows[0], branches[0], eps)
            base += rows[0, law.ETA] * states[n, j] / heights[0]
            if base / rows[0, law.K0] < least:
                least, who, side = base / rows[0, law.K0], -1, 0
        if least < 0.0:
            return j, least, who, side
    return -1, least, who, side


@compiled
def nodes_output(states, rows, branches, heights, out_w, out_s):
    """Fill in displacement of the top and base stress at states (2n, samples)."""
    n = heights.size
    for j in range(states.shape[1]):
        eps = states[0, j] / heights[0]
        out_w[j] = states[n - 1, j]
        dash = rows[0, law.ETA] * states[n, j] / heights[0]
        out_s[j] = law.stress_on(rows[0], branches[0], eps) + dash


# ---------------------------------------------------------------- massless springs in series


@compiled
def series_compliance(s, rows, branches, heights):
    """Return C = Σ h_i dε_i/ds (m/Pa) of springs in series, and dC/ds; k/(k+s)² if curved."""
    soft, change = 0.0, 0.0
    for i in range(heights.size):
        curved, k, _, _ = law.branch_shape(rows[i], branches[i])
        part = heights[i] * (k / (k + s) ** 2 if curved else 1.0 / k)
        soft += part
        change -= 2.0 * part / (k + s) if curved else 0.0
    return soft, change


@compiled
def series_rate(y, rows, branches, heights, mass, drag):
    """Return d/dt of (common stress, velocity of the striker)."""
    out = np.empty(2)
    out[0] = y[1] / series_compliance(y[0], rows, branches, heights)[0]
    out[1] = -(y[0] + drag * y[1]) / mass[0]
    return out


@compiled
def series_jacobian(y, rows, branches, heights, mass, drag):
    """Return the derivative of `series_rate` by the state, (2, 2)."""
    soft, change = series_compliance(y[0], rows, branches, heights)
    out = np.empty((2, 2))
    out[0, 0], out[0, 1] = -y[1] * change / soft**2, 1.0 / soft
    out[1, 0], out[1, 1] = -1.0 / mass[0], -drag / mass[0]
    return out


@compiled
def series_limits(rows, branches, pressed):
    """Return the stresses between which no spring leaves its branch, and the limiting springs.

    After first contact the lower limit is at least the end of contact (-1).
    """
    low, high, who_low, who_high = (0.0 if pressed else -np.inf), np.inf, -1, -1
    for i in range(branches.size):
        down, up = law.interval(rows[i], branches[i], law.OF_STRESS)
        if down > low:
            low, who_low = down, i
        if up < high:
            high, who_high = up, i
    return low, high, who_low, who_high


@compiled
def series_room(states, low, high, who_low, who_high):
    """See `nodes_room`; the distance is a stress."""
    left, who, side = np.inf, -1, 0
    for j in range(states.shape[1]):
        s = states[0, j]
        if s - low < high - s:
            left, who, side = s - low, who_low, -1
        else:
            left, who, side = high - s, who_high, 1
        if left < 0.0:
            return j, left, who, side
    return -1, left, who, side


@compiled
def series_output(states, rows, branches, heights, out_w, out_s):
    """Fill in displacement of the top and base stress at states (2, samples)."""
    for j in range(states.shape[1]):
        out_s[j] = states[0, j]
        out_w[j] = 0.0
        for i in range(heights.size):
            out_w[j] += heights[i] * law.strain_on(rows[i], branches[i], states[0, j])


# ---------------------------------------------------------------- an impact


@dataclass
class System:
    """An impact for SciPy: its state and the current branches."""

    rows: np.ndarray
    heights: np.ndarray
    mass: np.ndarray
    drag: float
    speed: float

    def __post_init__(self) -> None:
        """Choose the state: nodes if every spring has a mass above it, else the stress."""
        self.series = self.mass.size == 1 and self.heights.size > 1
        assert self.series or self.mass.size == self.heights.size
        self.branches = np.array([law.first_branch(row) for row in self.rows])
        self.pressed = False
        self.unit = self.rows[0, law.K0]
        n = self.mass.size
        if self.series:
            assert not self.rows[:, law.ETA].any()
            self.y = np.array([0.0, self.speed])
            stiff = 1.0 / series_compliance(0.0, self.rows, self.branches, self.heights)[0]
            self.scale = np.array([self.speed * np.sqrt(stiff * self.mass[0]), self.speed])
            self.rate, self.slope, self.output = series_rate, series_jacobian, series_output
        else:
            self.y = np.zeros(2 * n)
            self.y[-1] = self.speed
            self.scale = np.repeat([self.heights.sum(), self.speed], n)
            self.rate, self.slope, self.output = nodes_rate, nodes_jacobian, nodes_output

    def still(self) -> tuple[Any, ...]:
        """Arguments of the compiled functions besides the state."""
        return self.rows, self.branches, self.heights, self.mass, self.drag

    def enter(self, who: int, side: int) -> None:
        """Change the branch of a spring that has reached the end of its branch."""
        self.branches[who] = entered(self.branches[who], side > 0)

    def room(self) -> Callable[[np.ndarray], tuple[int, float, int, int]]:
        """Return the function that finds the first state (size, n) past a switch.

        It returns the index (-1 = none), the distance there, the spring (-1 = contact) and the
        side.
        """
        if not self.series:
            still = self.rows, self.branches, self.heights, self.pressed
            return lambda states: nodes_room(states, *still)
        limits = series_limits(self.rows, self.branches, self.pressed)
        return lambda states: series_room(states, *limits)

    def write(self, states: np.ndarray, out_w: np.ndarray, out_s: np.ndarray) -> None:
        """Fill in displacement of the striker and base stress at states (size, n)."""
        self.output(states, self.rows, self.branches, self.heights, out_w, out_s)


MOST_SWITCHES = 100_000  # each of 1000 springs makes four


class Impact(Protocol):
    """Interface of a system for `impact`."""

    y: np.ndarray
    scale: np.ndarray
    unit: float
    pressed: bool
    rate: Callable[..., np.ndarray]
    slope: Callable[..., np.ndarray]

    still: Callable[[], tuple[Any, ...]]
    enter: Callable[[int, int], None]
    room: Callable[[], Callable[[np.ndarray], tuple[int, float, int, int]]]
    write: Callable[[np.ndarray, np.ndarray, np.ndarray], None]


def impact(
    system: Impact, t: np.ndarray, method: str, rtol: float, looks: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return displacement of the striker and base stress (n,) of an impact at the samples t.

    Switches are detected at the samples, at the ends of steps, and at `looks` points inside steps:
    with vibrating masses, a spring may leave its branch and return within a step.
    """
    out_w, out_s = np.zeros(t.size), np.zeros(t.size)
    now, done = float(t[0]), 0
    for _ in range(MOST_SWITCHES):
        with np.errstate(all="ignore"):  # a stage past a pole: the step is rejected
            now, done, who, side = _phase(system, now, t, done, method, rtol, looks, out_w, out_s)
        if who is None:
            return out_w, out_s
        if who == -1:  # contact ends and the striker flies off
            last_w, last_s = np.empty(1), np.empty(1)
            system.write(system.y[:, None], last_w, last_s)
            out_w[done:] = last_w[0] + system.y[-1] * (t[done:] - now)
            return out_w, out_s
        system.enter(who, side)
    raise RuntimeError(f"{method}: too many switches at rtol = {rtol:g}")


def _phase(
    system: Impact,
    now: float,
    t: np.ndarray,
    done: int,
    method: str,
    rtol: float,
    looks: int,
    out_w: np.ndarray,
    out_s: np.ndarray,
) -> tuple[float, int, int | None, int]:
    """Continue from `now` to the next switch: return time, samples done, spring or None, side."""
    still, room = system.still(), system.room()
    options: dict[str, Any] = {}
    if method != "DOP853":
        options["jac"] = lambda _, y: system.slope(y, *still)
    solver: Any = METHODS[method](
        lambda _, y: system.rate(y, *still), now, system.y, float(t[-1]),
        rtol=rtol, atol=rtol * system.scale, **options,
    )  # fmt: skip
    inside = np.arange(1, looks + 1) / (looks + 1)
    while solver.status == "running":
        message = solver.step()
        if solver.status == "failed" or not np.isfinite(solver.y).all():
            raise RuntimeError(f"{method}: {message or 'not finite'}")
        last = done
        if t[done] <= solver.t:
            last = int(np.searchsorted(t, solver.t, side="right"))
        dense = solver.dense_output() if last > done else None
        times = np.append(t[done:last], solver.t)
        states = dense(times) if dense else solver.y[:, None]
        if looks:
            dense = dense or solver.dense_output()
            between = solver.t_old + inside * (solver.t - solver.t_old)
            lost = room(dense(between))[0]
            if lost >= 0 and room(states)[0] != 0:
                before = int(np.searchsorted(times, between[lost]))
                times = np.append(times[:before], between[lost])
                states = dense(times)
                last = done + before
        first = room(states)[0]
        if first >= 0:
            dense = dense or solver.dense_output()
            low = times[first - 1] if first > 0 else solver.t_old
            end = _root(
                lambda at, room=room, dense=dense: room(dense(at)[:, None])[1], low, times[first]
            )
            who, side = room(dense(times[first])[:, None])[2:]
            last = done + int(np.searchsorted(times[:-1], end))
            system.write(states[:, : last - done], out_w[done:last], out_s[done:last])
            system.y = dense(end)
            return end, last, who, side
        if last > done:
            system.write(states[:, :-1], out_w[done:last], out_s[done:last])
            done = last
            system.pressed = system.pressed or out_s[last - 1] > 10.0 * rtol * system.unit
            room = system.room()
    return now, done, None, 0


def _root(gap: Callable[[float], float], low: float, high: float) -> float:
    """Return the time at which `gap` becomes negative; it is negative at `high`."""
    if gap(low) <= 0.0:  # at a previous switch up to rounding: find a point after it
        for part in (0.01, 0.1, 0.3, 0.6, 0.9):
            if gap(low + part * (high - low)) > 0.0:
                low += part * (high - low)
                break
        else:
            return low
    return float(brentq(gap, low, high, xtol=TINY * high, rtol=TINY))


def along(solver: Any, points: np.ndarray, done: int, out: np.ndarray) -> tuple[int, np.ndarray]:
    """Step a solver to its end; fill in `out` at the points from `done` on that it passes.

    Return the number of points done and the last state.
    """
    while solver.status == "running":
        message = solver.step()
        if solver.status == "failed":
            raise RuntimeError(f"{type(solver).__name__}: {message}")
        last = int(np.searchsorted(points, solver.t, side="right"))
        if last > done:
            out[done:last] = solver.dense_output()(points[done:last])[0]
            done = last
    return done, solver.y
