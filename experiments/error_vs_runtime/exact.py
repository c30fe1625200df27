"""References of 12 digits, made independently of the solver under test.

Undamped springs without mass between them carry one stress s, and the motion of the striker follows
from energy: m v²/(2A) = ∫ s C(s) ds from s up to the stress s_max at which it turns, with
C(s) = Σ h_i dε_i/ds of eq. 2, and t = ∫ C/v ds. Both integrals are taken over x = √(s_max - s), in
which v is smooth, by Chebyshev polynomials between all stresses at which a spring switches: no
differential equation is solved. One or two springs with dashpots or a mass between them are left
to `tests/reference.py`: DOP853 at rtol = 1e-13, stopped at every switch. Both have a law of their
own, whose points are found by bracketing. Longer chains with masses would take that plain Python
hours; there it is SciPy's DOP853 of `restarted.py` at rtol = 1e-13. Springs with memory are left to
the judge of the stability study.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import restarted
from numpy.polynomial import chebyshev
from scipy.optimize import brentq

import foamfit as ff
from foamfit.solve.plan import plan
from foamfit.springs.chain import Drive

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.append(str(Path(__file__).parents[1] / "stability"))
import independent

import reference

Array = np.ndarray

NODES = 20  # of the polynomials of one piece, on [-1, 1]
_X = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)[::-1]
_FIT = np.linalg.inv(chebyshev.chebvander(_X, NODES - 1))
_R, _W = (part * 0.5 for part in np.polynomial.legendre.leggauss(NODES))
_R = _R + 0.5  # Gauss's nodes and weights on [0, 1]
LINE, A, C, D, E = range(5)


class Frozen(NamedTuple):
    """Springs in series on branches that do not change: what their strains are made of."""

    curved: Array  # first slopes k, Pa, heights and strains at zero stress of those on a or c
    straight: Array  # slopes, heights, and strains at zero stress of the others

    def compliance(self, s: Array) -> Array:
        """C(s) = Σ h_i dε_i/ds, m/Pa."""
        k, h = self.curved[:2, :, None]
        out: Array = (h * k / (k + s) ** 2).sum(axis=0) + (
            self.straight[1] / self.straight[0]
        ).sum()
        return out

    def elongation(self, s: float) -> float:
        """Σ h_i ε_i, m."""
        (k, h, x0), (slope, height, start) = self.curved, self.straight
        return float(h @ (x0 + s / (k + s)) + height @ (start + s / slope))


class Series:
    """Undamped springs in series without mass between them, by the law of `tests/reference.py`."""

    def __init__(self, chain: Any) -> None:
        laws = [reference.law(spring) for spring in chain.springs]
        self.heights = np.array(chain.heights)
        self.linear = np.array([isinstance(law, reference.LinearLaw) for law in laws])

        def of(name: str, otherwise: float = np.inf) -> Array:
            values = [getattr(law, name, otherwise) for law in laws]
            return np.array([otherwise if value is None else value for value in values])

        self.k0, self.kc, self.star = of("k0"), of("kc"), of("eps_star")
        self.sigma_a, self.sigma_c, self.hat_c = of("sigma_a"), of("sigma_c"), of("sigma_hat_c")
        hat_a = of("eps_hat_a", -np.inf)
        self.hat_a = np.full(hat_a.size, -np.inf)
        meets = np.isfinite(hat_a)
        self.hat_a[meets] = self.k0[meets] * hat_a[meets] / (1.0 - hat_a[meets])
        self.d, self.e = (of("kh_plus"), of("eps_a")), (of("kh_minus"), of("eps_c"))
        points = np.concatenate([self.sigma_a, self.sigma_c, self.hat_c, self.hat_a])
        self.switches = np.unique(points[np.isfinite(points) & (points > 0.0)])

    def frozen(self, s: float, most: float, rising: bool) -> Frozen:
        """The springs as they are at stress s on the way up to `most`, or down from it."""
        up = np.where(s < self.sigma_a, A, np.where(s > self.hat_c, C, D))
        down = np.where(s > self.sigma_c, C, np.where(s < self.hat_a, A, E))
        branch = np.where((most > self.hat_c) & (not rising), down, up)
        branch[self.linear] = LINE
        bent = (branch == A) | (branch == C)
        k = np.where(branch == A, self.k0, self.kc)
        x0 = np.where(branch == A, 0.0, self.star)
        with np.errstate(invalid="ignore"):
            slope = np.select([branch == D, branch == E], [self.d[0], self.e[0]], self.k0)
            zero_d = self.d[1] - self.sigma_a / self.d[0]
            zero_e = self.e[1] - self.sigma_c / self.e[0]
        start = np.select([branch == D, branch == E], [zero_d, zero_e], 0.0)
        h = self.heights
        return Frozen(
            np.array([k[bent], h[bent], x0[bent]]),
            np.array([slope[~bent], h[~bent], start[~bent]]),
        )


class Piece(NamedTuple):
    """A stretch of x = √(s_max - s) on which no spring switches."""

    low: float
    high: float
    since: float  # time from the turning point to `low`, s
    elapsed: Array  # Chebyshev coefficients of the time from `low`
    springs: Frozen


def _way(series: Series, most: float, rising: bool, areal: float) -> tuple[list[Piece], Any, Any]:
    """Follow the motion from the turning point to s = 0, either way: pieces, time, speed there."""
    cuts = series.switches[series.switches < most]
    ends = np.unique([*np.sqrt(most - cuts), *np.linspace(0.0, np.sqrt(most), 9)])
    energy, since, out = 0.0, 0.0, []
    for low, high in pairwise(ends):
        springs = series.frozen(most - (0.5 * (low + high)) ** 2, most, rising)
        half = 0.5 * (high - low)
        x = low + half * (_X + 1.0)
        s = most - x * x
        soft = springs.compliance(s)
        work = chebyshev.chebint(_FIT @ (2.0 * x * s * soft), lbnd=-1.0, scl=1.0) * half
        along = chebyshev.chebval(_X, work)
        if low == 0.0:  # v goes to zero with x: ∫ s C ds = x² ∫ 2 r s C dr from 0 to 1
            inside = most - np.outer(x, _R) ** 2
            c = springs.compliance(inside.ravel()).reshape(inside.shape)
            along = x**2 * ((2.0 * _R * inside * c) @ _W)
        speed = np.sqrt(2.0 / areal * (energy + along))
        elapsed = chebyshev.chebint(_FIT @ (2.0 * x * soft / speed), lbnd=-1.0) * half
        out.append(Piece(low, high, since, elapsed, springs))
        energy += chebyshev.chebval(1.0, work)
        since += chebyshev.chebval(1.0, elapsed)
    return out, since, np.sqrt(2.0 / areal * energy)


def _turning_stress(series: Series, areal: float, speed: float) -> float:
    """Stress at which ∫ s C ds has taken up the striker's energy, Pa."""
    wanted, taken, low = 0.5 * areal * speed**2, 0.0, 0.0
    for high in [*series.switches, *(series.switches[-1] * 1.2 ** np.arange(1, 60))]:
        springs = series.frozen(0.5 * (low + high), high, True)

        def more(top: float, low: float = low, springs: Frozen = springs) -> float:
            s = low + (top - low) * _R
            return (top - low) * float(_W @ (s * springs.compliance(s)))

        step = more(high)
        if taken + step >= wanted:
            miss = taken - wanted
            return float(
                brentq(lambda top, f=more, m=miss: f(top) + m, low, high, xtol=1e-12, rtol=1e-15)
            )
        taken, low = taken + step, high
    raise ValueError("the striker's energy is more than the springs can take")


def series_impact(chain: Any, drive: Any, t: Array) -> tuple[Array, Array]:
    """Displacement of the striker (m) and base stress (Pa), (n,) each, from energy alone."""
    series = Series(chain)
    areal = drive.mass / chain.area
    most = _turning_stress(series, areal, drive.velocity)
    up, turn, _ = _way(series, most, True, areal)
    down, fall, leaving = _way(series, most, False, areal)
    w, s = np.zeros(t.size), np.zeros(t.size)
    for j, now in enumerate(t):
        if now >= turn + fall:
            w[j] = down[-1].springs.elongation(0.0) - leaving * (now - turn - fall)
            continue
        way, apart = (up, turn - now) if now < turn else (down, now - turn)
        at = int(np.searchsorted([piece.since for piece in way], apart, side="right")) - 1
        x = _x_at(way[max(at, 0)], apart)
        s[j] = most - x * x
        w[j] = way[max(at, 0)].springs.elongation(s[j])
    return w, s


def _x_at(piece: Piece, apart: float) -> float:
    """Place in a piece at a time from the turning point."""

    def late(x: float) -> float:
        scaled = 2.0 * (x - piece.low) / (piece.high - piece.low) - 1.0
        return float(piece.since + chebyshev.chebval(scaled, piece.elapsed) - apart)

    if late(piece.low) >= 0.0:  # the ends miss `apart` by rounding
        return piece.low
    if late(piece.high) <= 0.0:
        return piece.high
    return float(brentq(late, piece.low, piece.high, xtol=1e-300, rtol=1e-15))


# ---------------------------------------------------------------- which reference a scene takes


def _restarted(chain: ff.Chain, drive: ff.Impact, t: Array) -> tuple[Array, Array]:
    scene = plan(chain, drive, t)
    rows, heights = np.array([s.row for s in chain.springs]), np.array(chain.heights)
    system = restarted.System(rows, heights, scene.mass, scene.drag, scene.speed)
    return restarted.impact(system, t, "DOP853", 1e-13, looks=15)


def _by_brute_force(chain: ff.Chain, drive: Drive, t: Array) -> tuple[Array, Array]:
    truth = independent.follow(chain, drive, t)
    assert not truth.why
    return truth.displacement[-1], truth.base_stress


def _by_reference(chain: ff.Chain, drive: Drive, t: Array) -> tuple[Array, Array]:
    if isinstance(drive, ff.Impact):
        motion = reference.reference_impact(chain, drive, t, rtol=1e-13)
    elif isinstance(drive, ff.StressDrive):
        motion = reference.reference_stress(chain, drive.stress, t)
    else:
        motion = reference.reference_displacement(chain, drive.displacement, t)
    return motion.displacement[-1], motion.base_stress


def reference_of(
    chain: ff.Chain, drive: Drive
) -> tuple[str, Callable[[Any, Any, Array], tuple[Array, Array]]]:
    """Return the name of the reference for a scene, and the function that makes it.

    The function gives the displacement of the top (m) and the base stress (Pa), (n,) each.
    """
    if independent.has_memory(chain):
        return "brute force at 1e-13 (experiments/stability/independent.py)", _by_brute_force
    if not isinstance(drive, ff.Impact):
        return "root finding on the law (tests/reference.py)", _by_reference
    damped = chain.site_damping > 0.0 or any(spring.eta > 0.0 for spring in chain.springs)
    if not damped and not any(chain.masses):
        return "energy quadrature (exact.py)", series_impact
    if len(chain.springs) <= 2:
        return "DOP853 at rtol 1e-13 with a law of its own (tests/reference.py)", _by_reference
    return "DOP853 at rtol 1e-13 (restarted.py)", _restarted
