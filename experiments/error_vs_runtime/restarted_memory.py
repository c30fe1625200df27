"""SciPy's integrators and hand-written schemes for a microscale spring with relaxation.

As in `restarted.py`, right-hand sides and switching functions are compiled. The state of an impact
is the equilibrium stress s, in which the law is explicit (no root finding), the relaxing part z = q
- g s, and the velocity of the striker. The solver is restarted where the spring reverses, snaps
again, or contact ends. A linear spring may lie under the microscale one; both carry the same
stress. Under a prescribed displacement only z is integrated, and s is the compiled root of the law
at the given strain, so that the integrand is as smooth as the history. The law is implemented here
independently of all others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit

import foamfit as ff
from restarted import METHODS, along

compiled = njit(cache=True, error_model="numpy")

K0, KC, STAR, LOG_PLUS, WIDE_PLUS, LOG_MINUS, WIDE_MINUS, HEIGHT, SOFT, G, TAU, AREAL = range(12)
SNAP, HELD, BACK = range(3)
ROOT_2, DENSITY = math.sqrt(2.0), 1.0 / math.sqrt(2.0 * math.pi)


def row_of(chain: ff.Chain, mass: float = 0.0) -> np.ndarray:
    """Return the parameters of a microscale spring, alone or above an undamped linear one."""
    spring, height, soft = chain.springs[-1], chain.heights[-1], 0.0
    assert isinstance(spring, ff.MicroscaleSpring)
    if len(chain.springs) == 2:
        soft = chain.heights[0] / chain.springs[0].k0
    g, tau = spring.relaxation[0] if spring.relaxation else (0.0, 1.0)
    return np.array(
        [
            spring.k0, spring.kc, spring.eps_star, math.log(spring.sigma_plus), spring.spread_plus,
            math.log(spring.sigma_minus), spring.spread_minus, height, soft, g, tau,
            mass / chain.area,
        ]
    )  # fmt: skip


@compiled
def strain(row, branch, rank, s):
    """Return the strain at an equilibrium stress, and dε/ds."""
    u, wide = rank, 0.0
    if branch != HELD:
        wide = row[WIDE_PLUS] if branch == SNAP else row[WIDE_MINUS]
        place = row[LOG_PLUS] if branch == SNAP else row[LOG_MINUS]
        u = (math.log(s) - place) / wide if s > 0.0 else -math.inf
    p, q = 0.5 * math.erfc(-u / ROOT_2), 0.5 * math.erfc(u / ROOT_2)
    a, c = 1.0 / (row[K0] + s), 1.0 / (row[KC] + s)
    soft = q * row[K0] * a * a + p * row[KC] * c * c
    if branch != HELD and s > 0.0:
        soft += DENSITY * math.exp(-0.5 * u * u) / (wide * s) * (row[STAR] + s * (c - a))
    return q * s * a + p * (row[STAR] + s * c), soft


@compiled
def limits(row, rank):
    """Return the stresses between which the rank of a spring is constant."""
    low = math.exp(row[LOG_MINUS] + row[WIDE_MINUS] * rank)
    return low, math.exp(row[LOG_PLUS] + row[WIDE_PLUS] * rank)


@compiled
def turned(row, branch, s):
    """Return the constant rank of a spring after a reversal at a stress."""
    if s <= 0.0:
        return -math.inf
    if branch == SNAP:
        return (math.log(s) - row[LOG_PLUS]) / row[WIDE_PLUS]
    return (math.log(s) - row[LOG_MINUS]) / row[WIDE_MINUS]


@compiled
def rate(y, row, branch, rank):
    """Return d/dt of (s, z, velocity)."""
    out = np.empty(3)
    s, z, v = y
    out[1] = -(z + row[G] * s) / row[TAU]
    give = row[HEIGHT] * strain(row, branch, rank, s)[1] + row[SOFT] * (1.0 + row[G])
    out[0] = (v - row[SOFT] * out[1]) / give
    out[2] = -((1.0 + row[G]) * s + z) / row[AREAL]
    return out


@compiled
def slope(y, row, branch, rank):
    """Return the derivative of `rate` by the state, (3, 3); dε/ds by a central difference."""
    s, z, v = y
    out = np.zeros((3, 3))
    out[1, 0], out[1, 1] = -row[G] / row[TAU], -1.0 / row[TAU]
    out[2, 0], out[2, 1] = -(1.0 + row[G]) / row[AREAL], -1.0 / row[AREAL]
    step = 1e-5 * max(abs(s), 1e-6 * row[K0])
    more = strain(row, branch, rank, s + step)[1] - strain(row, branch, rank, s - step)[1]
    give = row[HEIGHT] * strain(row, branch, rank, s)[1] + row[SOFT] * (1.0 + row[G])
    push = v + row[SOFT] * (z + row[G] * s) / row[TAU]
    out[0, 0] = row[SOFT] * row[G] / row[TAU] / give
    out[0, 0] -= push * row[HEIGHT] * more / (2.0 * step) / give**2
    out[0, 1], out[0, 2] = row[SOFT] / row[TAU] / give, 1.0 / give
    return out


@compiled
def room(states, row, branch, rank, speed, pressed):
    """Find the first state (3, n) past a turn, limit or contact; see `restarted.nodes_room`."""
    least, who, side = np.inf, 0, 0
    low, high = limits(row, rank) if branch == HELD else (0.0, 0.0)
    for j in range(states.shape[1]):
        s, z, v = states[:, j]
        push = (v + row[SOFT] * (z + row[G] * s) / row[TAU]) / speed
        if branch == SNAP:
            least, who, side = push, 0, -1
        elif branch == BACK:
            least, who, side = -push, 0, 1
        elif s - low < high - s:
            least, who, side = (s - low) / row[K0], 0, -1
        else:
            least, who, side = (high - s) / row[K0], 0, 1
        if pressed:
            base = ((1.0 + row[G]) * s + z) / row[K0]
            if base < least:
                least, who, side = base, -1, 0
        if least < 0.0:
            return j, least, who, side
    return -1, least, who, side


@compiled
def output(states, row, branch, rank, out_w, out_s):
    """Fill in displacement of the striker and base stress at states (3, n)."""
    for j in range(states.shape[1]):
        s = states[0, j]
        out_s[j] = (1.0 + row[G]) * s + states[1, j]
        out_w[j] = row[HEIGHT] * strain(row, branch, rank, s)[0] + row[SOFT] * out_s[j]


class MemorySystem:
    """An impact for `restarted.impact`."""

    def __init__(self, row: np.ndarray, speed: float) -> None:
        """Start at rest."""
        self.row, self.speed, self.branch, self.rank = row, speed, SNAP, -math.inf
        self.pressed, self.unit = False, row[K0]
        self.y = np.array([0.0, 0.0, speed])
        stress = speed * math.sqrt(row[K0] * row[AREAL] / row[HEIGHT])
        self.scale = np.array([stress, stress, speed])
        self.rate, self.slope = rate, slope

    def still(self) -> tuple[Any, ...]:
        """Arguments of the compiled functions besides the state."""
        return self.row, self.branch, self.rank

    def enter(self, who: int, side: int) -> None:
        """Change the branch at a turn or a limit."""
        if self.branch == HELD:
            self.branch = SNAP if side > 0 else BACK
            return
        self.rank = turned(self.row, self.branch, self.y[0])
        self.branch = HELD

    def room(self) -> Callable[[np.ndarray], tuple[int, float, int, int]]:
        """See `restarted.System.room`."""
        still = *self.still(), self.speed, self.pressed
        return lambda states: room(states, *still)

    def write(self, states: np.ndarray, out_w: np.ndarray, out_s: np.ndarray) -> None:
        """See `restarted.System.write`."""
        output(states, *self.still(), out_w, out_s)


@compiled
def _advance(y, h, row, branch, rank):
    """Take one step of the classical Runge-Kutta scheme."""
    a = rate(y, row, branch, rank)
    b = rate(y + 0.5 * h * a, row, branch, rank)
    c = rate(y + 0.5 * h * b, row, branch, rank)
    d = rate(y + h * c, row, branch, rank)
    return y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)


@compiled
def runge_kutta(row, speed, t, substeps, out_w, out_s):
    """Integrate an impact in fixed steps; update the branch at the end of each step."""
    y = np.array([0.0, 0.0, speed])
    branch, rank = SNAP, -math.inf
    one_w, one_s = np.zeros(1), np.zeros(1)
    out_w[0] = out_s[0] = 0.0
    for j in range(1, t.size):
        h = (t[j] - t[j - 1]) / substeps
        for sub in range(substeps):
            before, last = y, (1.0 + row[G]) * y[0] + y[1]
            y = _advance(y, h, row, branch, rank)
            base = (1.0 + row[G]) * y[0] + y[1]
            if base <= 0.0 < last:  # contact has ended and the striker flies off
                part = last / (last - base)
                y = before + part * (y - before)
                output(y.reshape(3, 1), row, branch, rank, one_w, one_s)
                end = t[j - 1] + (sub + part) * h
                for rest in range(j, t.size):
                    out_s[rest], out_w[rest] = 0.0, one_w[0] + y[2] * (t[rest] - end)
                return
            if branch == HELD:
                low, high = limits(row, rank)
                if y[0] > high:
                    branch = SNAP
                elif y[0] < low:
                    branch = BACK
            else:
                rising = y[0] > before[0]
                if rising != (branch == SNAP):
                    rank = turned(row, branch, before[0])
                    branch = HELD
        output(y.reshape(3, 1), row, branch, rank, out_w[j : j + 1], out_s[j : j + 1])


# ---------------------------------------------------------------- along a displacement


@compiled
def stress_at(row, branch, rank, eps, guess):
    """Return the equilibrium stress at a strain on a branch, by guarded Newton steps."""
    low, high, s = 0.0, np.inf, max(guess, 1e-12 * row[K0])
    if eps <= 0.0:
        return 0.0
    for _ in range(100):
        value, soft = strain(row, branch, rank, s)
        if value > eps:
            high = s
        else:
            low = s
        new = s - (value - eps) / soft
        if not low < new < high:
            new = 2.0 * s if high == np.inf else 0.5 * (low + high)
        if abs(new - s) <= 1e-14 * s:
            return new
        s = new
    return s


@compiled
def follow(row, state, eps):
    """Return the stress at the next strain of a history; `state` is (branch, rank, strain, s)."""
    branch, rank, last, s = int(state[0]), state[1], state[2], state[3]
    if (branch == SNAP and eps < last) or (branch == BACK and eps > last):
        branch, rank = HELD, turned(row, branch, s)
    if branch == HELD:
        low, high = limits(row, rank)
        if eps > strain(row, HELD, rank, high)[0]:
            branch = SNAP
        elif eps < strain(row, HELD, rank, low)[0]:
            branch = BACK
    s = stress_at(row, branch, rank, eps, s)
    state[0], state[1], state[2], state[3] = branch, rank, eps, s
    return s


@compiled
def samples_of(row, eps, out):
    """Return stress (n,) and (branch, rank) (n, 2) in equilibrium along a history from rest."""
    state = np.array([SNAP, -math.inf, 0.0, 0.0])
    kept = np.zeros((eps.size, 2))
    for j in range(eps.size):
        out[j] = follow(row, state, eps[j])
        kept[j, 0], kept[j, 1] = state[0], state[1]
    return kept


@compiled
def relaxing_rate(now, z, row, t, eps, equilibrium, kept):
    """Return dz/dt at a time; the strain is linear between samples."""
    j = min(max(np.searchsorted(t, now) - 1, 0), t.size - 2)
    part = (now - t[j]) / (t[j + 1] - t[j])
    state = np.array([kept[j, 0], kept[j, 1], eps[j], equilibrium[j]])
    s = follow(row, state, eps[j] + part * (eps[j + 1] - eps[j]))
    return -(z + row[G] * s) / row[TAU]


def along_displacement(
    row: np.ndarray, t: np.ndarray, eps: np.ndarray, method: str, rtol: float
) -> np.ndarray:
    """Return the stress (n,) along a history of strain; restart at its turning points."""
    equilibrium = np.zeros(t.size)
    kept = samples_of(row, eps, equilibrium)
    z = np.zeros(t.size)
    turns = [0, *(np.flatnonzero(np.diff(np.sign(np.diff(eps)))) + 1), t.size - 1]
    given = row, t, eps, equilibrium, kept
    for first, last in pairwise(turns):
        options: dict[str, Any] = {}
        if method != "DOP853":
            options["jac"] = lambda _, __: np.array([[-1.0 / row[TAU]]])
        solver: Any = METHODS[method](
            lambda now, y: (relaxing_rate(now, y[0], *given),), t[first], z[first : first + 1],
            t[last], rtol=rtol, atol=rtol * 1e-2 * row[K0], **options,
        )  # fmt: skip
        z[last] = along(solver, t[: last + 1], first + 1, z)[1][0]
    return (1.0 + row[G]) * equilibrium + z


@compiled
def recursion(row, t, eps, substeps, out):
    """Integrate q exactly for an equilibrium stress that is linear between points."""
    state = np.array([SNAP, -math.inf, 0.0, 0.0])
    out[0] = last = q = 0.0
    for j in range(1, t.size):
        h = (t[j] - t[j - 1]) / substeps
        fade = math.exp(-h / row[TAU])
        gain = row[G] * row[TAU] / h * (1.0 - fade)
        for sub in range(1, substeps + 1):
            s = follow(row, state, eps[j - 1] + sub / substeps * (eps[j] - eps[j - 1]))
            q = q * fade + gain * (s - last)
            last = s
        out[j] = last + q
