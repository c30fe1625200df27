"""Response of springs to a striker or a given motion: an independent reference for foamfit.

Neither code nor method comes from foamfit. The laws (docs/theory.md) are functions of stress
instead of strain; the stress that governs snapping is part of the state. SciPy's DOP853 integrates
to 11 digits, from switch to switch (its events).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

Array = NDArray[np.float64]
Terms = tuple[tuple[float, float], ...]  # pairs (g, tau in s)
Mode = tuple[str, float]  # branch of a spring, and the constant rank of a held one


def soft(s: float, k: float) -> tuple[float, float]:
    """Return the strain s/(k + s) of an elastic branch, and its derivative."""
    return s / (k + s), k / (k + s) ** 2


@dataclass(frozen=True)
class Bistable:
    """Eqs. 1 to 5 as functions of stress. `terms` are pairs (g, tau)."""

    k0: float
    kc: float
    dsigma: float
    eps_a: float
    eps_c: float
    kh_plus: float
    kh_minus: float
    eta: float = 0.0
    terms: Terms = ()

    start = ("a", 0.0)

    @cached_property
    def points(self) -> tuple[float, float, float, float, float]:
        """Stresses at A1, C2, C1 and A2 (-inf where e never meets a), and the strain eps_star."""
        top = self.k0 * self.eps_a / (1.0 - self.eps_a)
        low = top + self.dsigma
        star = self.eps_c - low / (self.kc + low)

        def above(s: float) -> float:
            return star + s / (self.kc + s) - self.eps_a - (s - top) / self.kh_plus

        def below(s: float) -> float:
            return self.eps_c + (s - low) / self.kh_minus - s / (self.k0 + s)

        far = 2.0 * top
        while above(far) > 0.0:
            far *= 2.0
        least = max(0.0, math.sqrt(self.k0 * self.kh_minus) - self.k0)
        meets = least < low and below(least) < 0.0
        back = brentq(below, least, low, xtol=1e-12 * low) if meets else -math.inf
        return top, low, brentq(above, top, far, xtol=1e-12 * top), back, star

    def strain(self, s: float, mode: Mode) -> tuple[float, float]:
        """Return strain and compliance on a branch."""
        top, low, _, _, star = self.points
        if mode[0] == "d":
            return self.eps_a + (s - top) / self.kh_plus, 1.0 / self.kh_plus
        if mode[0] == "e":
            return self.eps_c + (s - low) / self.kh_minus, 1.0 / self.kh_minus
        on, slope = soft(s, self.k0 if mode[0] == "a" else self.kc)
        return (on if mode[0] == "a" else star + on), slope

    def ends(self, mode: Mode) -> tuple[float, float]:
        """Return the stresses between which a mode is valid."""
        top, low, high, back, _ = self.points
        inf = math.inf
        return {"a": (-inf, top), "d": (top, high), "c": (low, inf), "e": (back, low)}[mode[0]]

    def leave(self, mode: Mode, upwards: bool) -> Mode:
        """Return the mode that follows at an end of a mode."""
        return {"a": "d", "d": "c" if upwards else "a", "c": "e", "e": "c" if upwards else "a"}[
            mode[0]
        ], 0.0

    def turn(self, mode: Mode, s: float, rising: bool) -> Mode:
        """Return the mode after a reversal: the same branch, backwards."""
        return mode

    def loading(self, s: float) -> Mode:
        """Return the branch of first loading at a stress."""
        return ("a" if s < self.points[0] else "d" if s < self.points[2] else "c"), 0.0


@dataclass(frozen=True)
class Microscale:
    """Micro-springs with log-normal snap stresses as functions of stress; `terms`: (g, tau).

    Modes: "plus" follows P+ up, "back" follows it down (where snapping is reversible), "minus"
    follows P- down, and "held" keeps the rank that has snapped.
    """

    k0: float
    kc: float
    eps_star: float
    sigma_plus: float
    spread_plus: float
    sigma_minus: float
    spread_minus: float
    eta: float = 0.0
    terms: Terms = ()

    start = ("plus", 0.0)

    def rank(self, s: float, sign: str) -> float:
        """Return the standard normal score of the ranks that snap at a stress."""
        if s <= 0.0:
            return -math.inf
        return math.log(s / getattr(self, f"sigma_{sign}")) / getattr(self, f"spread_{sign}")

    def strain(self, s: float, mode: Mode) -> tuple[float, float]:
        """Return strain and compliance in a mode."""
        sign = "minus" if mode[0] == "minus" else "plus"
        z, density = mode[1], 0.0
        if mode[0] != "held":
            z = self.rank(s, sign)
            if s > 0.0:
                wide = getattr(self, f"spread_{sign}") * s
                density = math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * wide)
        p, rest = 0.5 * math.erfc(-z / math.sqrt(2.0)), 0.5 * math.erfc(z / math.sqrt(2.0))
        (a, slope_a), (c, slope_c) = soft(s, self.k0), soft(s, self.kc)
        gap = self.eps_star + c - a
        return a + p * gap, rest * slope_a + p * slope_c + density * gap

    @cached_property
    def crossing(self) -> float:
        """Return the stress at which a rank snaps both through and back; infinite if none does."""
        m, p = self.spread_minus, self.spread_plus
        if m == p:
            return math.inf
        at = (m * math.log(self.sigma_plus) - p * math.log(self.sigma_minus)) / (m - p)
        return math.exp(min(at, 700.0))

    def ends(self, mode: Mode) -> tuple[float, float]:
        """Return the stresses between which a mode is valid."""
        if mode[0] == "held":
            low = self.sigma_minus * math.exp(self.spread_minus * mode[1])
            return low, self.sigma_plus * math.exp(self.spread_plus * mode[1])
        ends = {"back": self.spread_minus > self.spread_plus,
                "minus": self.spread_minus < self.spread_plus}  # fmt: skip
        return (self.crossing if ends.get(mode[0], False) else -math.inf), math.inf

    def leave(self, mode: Mode, upwards: bool) -> Mode:
        """Return the mode that follows at an end of a mode."""
        return ("plus" if upwards else "back" if mode[0] == "minus" else "minus"), 0.0

    def turn(self, mode: Mode, s: float, rising: bool) -> Mode:
        """Return the mode after a reversal."""
        if mode[0] == "held":
            return mode
        if rising:
            return ("plus", 0.0) if mode[0] == "back" else ("held", self.rank(s, "minus"))
        plus = self.rank(s, "plus")
        return ("back", 0.0) if self.rank(s, "minus") <= plus else ("held", plus)

    def loading(self, s: float) -> Mode:
        """Return the mode of first loading."""
        return self.start


Law = Bistable | Microscale


@dataclass(frozen=True)
class Motion:
    """A prescribed motion of the top through `levels` (m) at `times` (s), joined by `shapes`.

    A "line" is straight, a "cosine" half a wave, a "ramp" accelerates uniformly in its first half.
    """

    times: tuple[float, ...]
    levels: tuple[float, ...]
    shapes: tuple[str, ...]

    def contact(self) -> float:
        """Return the time at which the motion first passes zero."""
        if self.levels[0] == 0.0:
            return self.times[0]
        return float(brentq(lambda t: self.at(t, 0)[0], *self.times[:2], xtol=1e-14))

    def leg(self, t: float) -> int:
        """Return the number of the leg that contains or starts at a time."""
        return int(np.clip(np.searchsorted(self.times, t, "right") - 1, 0, len(self.shapes) - 1))

    def at(self, t: float, leg: int | None = None) -> tuple[float, float]:
        """Return displacement and velocity at a time."""
        i = self.leg(t) if leg is None else leg
        lasts, rise = self.times[i + 1] - self.times[i], self.levels[i + 1] - self.levels[i]
        x = (t - self.times[i]) / lasts
        if self.shapes[i] == "cosine":
            share, rate = 0.5 - 0.5 * math.cos(math.pi * x), 0.5 * math.pi * math.sin(math.pi * x)
        elif self.shapes[i] == "ramp":
            share, rate = (4 / 3 * x * x, 8 / 3 * x) if x < 0.5 else (4 / 3 * x - 1 / 3, 4 / 3)
        else:
            share, rate = x, 1.0
        return self.levels[i] + rise * share, rise * rate / lasts


@dataclass(frozen=True)
class Rig:
    """Springs in series on a base (height of each, m; area, m²) and the drive of the top.

    The drive is a striker (mass in kg, velocity at contact in m/s, gravity in m/s²) or a motion.
    Several springs in series have no relaxation.
    """

    springs: tuple[Law, ...]
    heights: tuple[float, ...]
    area: float
    mass: float = math.inf
    velocity: float = 0.0
    gravity: float = 0.0
    motion: Motion | None = None

    @property
    def height(self) -> float:
        """Total height, m."""
        return math.fsum(self.heights)

    @property
    def memory(self) -> Terms:
        """Relaxation terms of a single spring."""
        return self.springs[0].terms

    def speed(self, t: float, y: Array, leg: int | None = None) -> float:
        """Return the velocity of the top during contact."""
        return self.motion.at(t, leg)[1] if self.motion else float(y[1])

    def total(self, t: float, y: Array, leg: int | None = None) -> float:
        """Return the stress at the base during contact."""
        eta = self.springs[0].eta
        return float(y[2:].sum()) + (eta * self.speed(t, y, leg) / self.height if eta else 0.0)

    def freed(self, y: Array, soft: float) -> tuple[float, float]:
        """Return velocity of a free top, and rate of the stress that governs snapping."""
        eta = self.springs[0].eta
        if eta > 0.0:
            v = -float(y[2:].sum()) / eta * self.height
            return v, v / soft
        fades = sum(q / tau for q, (_, tau) in zip(y[3:], self.memory, strict=True))
        ds = fades / (1.0 + sum(g for g, _ in self.memory))
        return ds * soft, ds

    def run(self, start: float, last: float, before: Course | None = None) -> Course:
        """Integrate from contact at `start` until the stress at the base returns to zero.

        If the course `before` is given, the top is free. The state is displacement and velocity of
        the top, the stress that governs snapping, and the stress of each relaxation term.
        """
        pieces = list[tuple[float, Any]]()
        t, y = start, np.array([0.0, self.velocity, 0.0, *(0.0 for _ in self.memory)])
        modes, rising = [spring.start for spring in self.springs], before is None
        if before:
            y, modes = before.state, list(before.modes)

        def turned() -> list[Mode]:
            pairs = zip(self.springs, modes, strict=True)
            return [spring.turn(mode, y[2], rising) for spring, mode in pairs]

        knots = self.motion.times if self.motion else ()
        for until in [*(k for k in knots if start < k < last), last]:
            ahead = self.motion.at(0.5 * (t + until))[1] if self.motion else 0.0
            if ahead and (ahead > 0.0) != rising:
                rising = not rising
                modes = turned()
            while t < until:
                free = before is not None
                hit, found = self._piece(t, y, until, modes, rising, free)
                t, y = float(found.t[-1]), found.y[:, -1].copy()
                pieces.append((t, found.sol))
                if hit == ("end",):
                    return Course(self, start, t, pieces, y, modes)
                if hit == ("turn",):
                    y[1], rising = 0.0, not rising
                    modes = turned()
                elif hit:
                    i, upwards, y[2] = hit
                    modes[i] = self.springs[i].leave(modes[i], upwards)
        return Course(self, start, t, pieces, y, modes)

    def _piece(
        self, t: float, y: Array, until: float, modes: list[Mode], rising: bool, free: bool
    ) -> tuple[tuple[Any, ...], Any]:
        """Integrate to a switch, a reversal, the end of contact or a time; return which it was."""
        springs, leg = self.springs, self.motion.leg(0.5 * (t + until)) if self.motion else None
        events, what = list[Callable[[float, Array], float]](), list[tuple[Any, ...]]()

        def rates(t: float, y: Array) -> Array:
            each = zip(self.heights, springs, modes, strict=True)
            soft = math.fsum(h * spring.strain(y[2], mode)[1] for h, spring, mode in each)
            if free:
                v, ds = self.freed(y, soft)
                a = 0.0
            else:
                v = self.speed(t, y, leg)
                ds, a = v / soft, self.gravity - self.total(t, y, leg) * self.area / self.mass
            more = [g * ds - q / tau for (g, tau), q in zip(self.memory, y[3:], strict=True)]
            return np.array([v, a, ds, *more])

        def stop(where: Callable[[float, Array], float], upwards: bool, *then: Any) -> None:
            where.terminal = True  # type: ignore[attr-defined]
            where.direction = 1.0 if upwards else -1.0  # type: ignore[attr-defined]
            events.append(where)
            what.append(then)

        if not free:
            stop(lambda t, y: self.total(t, y, leg), False, "end")
        if not free and self.motion is None:
            stop(lambda t, y: y[1], not rising, "turn")
        for i, (spring, mode) in enumerate(zip(springs, modes, strict=True)):
            for end, upwards in zip(spring.ends(mode), (False, True), strict=True):
                if math.isfinite(end):
                    stop(lambda t, y, end=end: y[2] - end, upwards, i, upwards, end)
        scale = max(spring.k0 for spring in springs)
        step = 0.01 * self.height / self.velocity if self.velocity else (until - t) / 50.0
        size = np.array([self.height, self.velocity or 1.0, *[scale] * (len(y) - 2)])
        found = solve_ivp(rates, (t, until), y, "DOP853", events=events, dense_output=True,
                          rtol=1e-11, atol=1e-13 * size, max_step=step)  # fmt: skip
        assert found.success, found.message
        for spring, mode in zip(springs, modes, strict=True):
            low, high = spring.ends(mode)
            off = max(low - found.y[2, -1], found.y[2, -1] - high)
            assert off < 1e-9 * scale, f"a switch of {mode} was missed"
        return next((w for w, at in zip(what, found.t_events, strict=True) if len(at)), ()), found


@dataclass(frozen=True)
class Course:
    """Solution from contact (s) to the end of contact (s), and the state there."""

    rig: Rig
    start: float
    end: float
    pieces: list[tuple[float, Any]]
    state: Array
    modes: list[Mode]

    def states(self, time: Array) -> Array:
        """Return the states at times within the course, shape (k, n)."""
        which = np.searchsorted([end for end, _ in self.pieces], time)
        which = np.minimum(which, len(self.pieces) - 1)
        out = np.empty((len(self.state), len(time)))
        for i in np.unique(which):
            out[:, which == i] = self.pieces[i][1](time[which == i])
        return out

    def stress(self, time: Array) -> Array:
        """Return the stress at the base, zero outside contact."""
        inside, out = (time >= self.start) & (time <= self.end), np.zeros(len(time))
        pairs = zip(time[inside], self.states(time[inside]).T, strict=True) if inside.any() else ()
        out[inside] = [self.rig.total(t, y) for t, y in pairs]
        return out

    def top(self, time: Array, gauge: bool) -> Array:
        """Return the displacement of striker or gauge, zero at contact."""
        rig, inside = self.rig, (time >= self.start) & (time <= self.end)
        if rig.motion is not None:
            return np.array([rig.motion.at(t)[0] for t in time])
        since, out = time - self.start, np.zeros(len(time))
        g, (w, v) = rig.gravity, self.state[:2]
        if inside.any():
            out[inside] = self.states(time[inside])[0]
        after, late = time > self.end, time - self.end
        if not gauge:
            out[~inside] = (rig.velocity * since + 0.5 * g * since**2)[~inside]
            out[after] = (w + v * late + 0.5 * g * late**2)[after]
        elif after.any():
            idle = not rig.memory and rig.springs[0].eta == 0.0
            out[after] = w
            if not idle:
                free = rig.run(self.end, float(time[-1]) + 1e-12, self)
                out[after] = free.states(time[after])[0]
        return out
