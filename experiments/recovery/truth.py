"""Response of springs to a striker or a given motion: the truth behind synthetic records.

Neither code nor method comes from foamfit: the judge of the stability study integrates the springs
by brute force to 13 digits (`stability/independent.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from independent import HAT_A, HAT_C, SIG_A, STAR, A, C, E, Truth, bistable_row, follow, pressed

Array = NDArray[np.float64]
Terms = tuple[tuple[float, float], ...]  # pairs (g, tau in s)
FINE = 10_001  # samples of a motion, which the judge joins by straight lines
CLOSE = 1e-9  # of a duration
NONE = np.empty(0)


@dataclass(frozen=True)
class Bistable:
    """A bistable spring (docs/theory.md, eqs. 1 to 5)."""

    k0: float
    kc: float
    dsigma: float
    eps_a: float
    eps_c: float
    kh_plus: float
    kh_minus: float
    eta: float = 0.0
    relaxation: Terms = ()

    @cached_property
    def row(self) -> list[float]:
        """Parameters and derived points, as the judge has them."""
        return bistable_row(self, 1.0)

    @property
    def onset(self) -> float:
        """Stress at A1."""
        return self.row[SIG_A]

    @property
    def closing(self) -> float:
        """Stress at C1."""
        return self.onset + self.kh_plus * (self.row[HAT_C] - self.eps_a)

    def strain(self, s: float) -> float:
        """Return the strain at a stress of the first loading."""
        if s < self.onset:
            return s / (self.k0 + s)
        if s < self.closing:
            return self.eps_a + (s - self.onset) / self.kh_plus
        return self.row[STAR] + s / (self.kc + s)

    def unloading(self, strain: float) -> float:
        """Return the stress at a strain of the unloading from branch c."""
        branch = C if strain > self.eps_c else E if strain > self.row[HAT_A] else A
        return float(pressed.py_func(self.row, branch, strain)[0])


@dataclass(frozen=True)
class Microscale:
    """Micro-springs with log-normal snap stresses (docs/theory.md, section 6)."""

    k0: float
    kc: float
    eps_star: float
    sigma_plus: float
    spread_plus: float
    sigma_minus: float
    spread_minus: float
    eta: float = 0.0
    relaxation: Terms = ()
    stiffening: float = 1.0
    softening: float = 0.0
    weakening: float = 0.0

    def strain(self, s: float) -> float:
        """Return the strain at a stress of the first loading."""
        on_a = 1.0 - (1.0 + self.stiffening * s / self.k0) ** (-1.0 / self.stiffening)
        on_c = self.eps_star + s / (self.kc + s)
        z = math.log(s / self.sigma_plus) / self.spread_plus if s > 0.0 else -math.inf
        return on_a + 0.5 * math.erfc(-z / math.sqrt(2.0)) * (on_c - on_a)


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
        return float(brentq(lambda t: self.at(np.array([t]))[0], *self.times[:2], xtol=1e-14))

    def at(self, time: Array) -> Array:
        """Return the displacement at times, m."""
        last = len(self.shapes) - 1
        leg = np.clip(np.searchsorted(self.times, time, "right") - 1, 0, last)
        lasts, rise = np.diff(self.times)[leg], np.diff(self.levels)[leg]
        x = (time - np.array(self.times)[leg]) / lasts
        shares = {
            "line": x,
            "cosine": 0.5 - 0.5 * np.cos(np.pi * x),
            "ramp": np.where(x < 0.5, 4 / 3 * x * x, 4 / 3 * x - 1 / 3),
        }
        shape = np.array(self.shapes)[leg]
        share = np.select([shape == name for name in shares], list(shares.values()))
        return np.array(self.levels)[leg] + rise * share


@dataclass(frozen=True)
class Rig:
    """Springs in series on a base (height of each, m; area, m²) and the drive of the top.

    The drive is a striker (mass in kg, velocity at contact in m/s, gravity in m/s²) or a motion.
    """

    springs: tuple[Law, ...]
    heights: tuple[float, ...]
    area: float
    mass: float = math.inf
    velocity: float = 0.0
    gravity: float = 0.0
    motion: Motion | None = None
    site_damping: float = 0.0  # Pa s, between striker and base

    @property
    def masses(self) -> list[float]:
        """Mass above each spring: none but the striker."""
        return [0.0] * len(self.springs)

    @property
    def height(self) -> float:
        """Total height, m."""
        return math.fsum(self.heights)

    def follow(self, time: Array) -> Truth:
        """Return the motion of the springs and the stress at the base at times after the contact.

        Times before the contact are admissible for a striker.
        """
        drive: Any = self
        if self.motion is not None:
            moved = self.motion.at(time)
            drive = SimpleNamespace(displacement=moved - moved[0])
        truth = follow(self, drive, time)
        if truth.why:
            raise RuntimeError(truth.why)
        return truth

    def run(self, start: float, last: float) -> Course:
        """Follow the springs from contact at `start` until the base stress returns to zero."""
        if self.motion is None:
            truth = self.follow(np.array([0.0, last]))
            return Course(self, start, truth.contact_end or last)
        time, stress = self.pressed(start, last)
        lost = np.flatnonzero((stress[1:] <= 0.0) & (stress[:-1] > 0.0))
        if lost.size:
            two = slice(lost[0], lost[0] + 2)
            last = float(np.interp(0.0, stress[two][::-1], time[two][::-1]))
        return Course(self, start, last)

    def pressed(self, start: float, last: float, more: Array = NONE) -> tuple[Array, Array]:
        """Return times of a motion, at most `CLOSE` from the turns and `more` times, and stresses.

        Of times that are almost equal one is left, because their difference gives a dashpot's rate.
        """
        turns = [t for t in self.motion.times if start < t < last] if self.motion else []
        time = np.union1d(np.linspace(start, last, FINE), [*turns, *more])
        time = time[np.append(True, np.diff(time) > CLOSE * (last - start))]
        return time, self.follow(time).base_stress


@dataclass(frozen=True)
class Course:
    """Response of a rig from contact to the end of contact (s)."""

    rig: Rig
    start: float
    end: float

    def stress(self, time: Array) -> Array:
        """Return the stress at the base, zero outside contact."""
        inside = (time >= self.start) & (time <= self.end)
        if self.rig.motion is None:
            return np.where(inside, self.rig.follow(time).base_stress, 0.0)
        known = self.rig.pressed(self.start, self.end, time[inside])
        return np.where(inside, np.interp(time, *known), 0.0)

    def top(self, time: Array, gauge: bool) -> Array:
        """Return the displacement of striker or gauge, zero at contact."""
        if self.rig.motion is not None:
            return self.rig.motion.at(time)
        moved = self.rig.follow(time).displacement[-1]
        return np.where(time > 0.0, self._left(time, moved), 0.0) if gauge else moved

    def _left(self, time: Array, moved: Array) -> Array:
        """Return the motion of the specimen, which creeps back once the striker has left.

        It is known for a single bistable spring that has closed: η dε/dt = -σ(ε).
        """
        spring, height, after = self.rig.springs[0], self.rig.height, time > self.end
        last = float(self.rig.follow(np.array([0.0, self.end])).displacement[-1, -1]) / height
        if spring.relaxation:
            raise ValueError("the motion of a relaxing specimen that is free is not known")
        if not after.any():
            return moved
        strain = np.full(int(after.sum()), last)
        if spring.eta > 0.0 and isinstance(spring, Bistable):
            found = solve_ivp(
                lambda _, y: [-spring.unloading(y[0]) / spring.eta], (self.end, time[-1]), [last],
                "LSODA", t_eval=time[after], rtol=1e-9, atol=1e-12,
            )  # fmt: skip
            strain = found.y[0]
        return np.concatenate([moved[~after], height * strain])
