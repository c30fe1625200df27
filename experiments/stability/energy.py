"""What energy says of an impact on undamped massless springs in series: no motion is followed.

All springs carry one stress s. On the way up to the largest stress each follows its loading
curve, on the way down its unloading curve from there, so the strains are known functions of s: the
energy m v²/(2A) of the striker is ∫ s C ds up to the turn, C = Σ h dε/ds; what is left after it is
∫ s C ds on the way down, and the time of contact is ∫ C/v ds over both. The law of microscale
springs is written out anew with SciPy's normal distribution; linear springs may be in series.
On the way down what has snapped once is softer and snaps through earlier (section 8).
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

Array = NDArray[np.float64]
NODES = 40
_X, _W = np.polynomial.legendre.leggauss(NODES)


def _score(spring: Any, sign: str, s: Array, weakened: float = 0.0) -> Array:
    place, wide = getattr(spring, f"sigma_{sign}"), getattr(spring, f"spread_{sign}")
    return np.asarray((np.log(s / place) + weakened) / wide)


def _on_a(spring: Any, k: float, s: Array) -> tuple[Array, Array]:
    """Strain of branch a and its slope."""
    n = spring.stiffening
    left = (1.0 + n * s / k) ** (-1.0 / n)
    return 1.0 - left, left / (k + n * s)


def _compliance(spring: Any, s: Array, most: float, rising: bool) -> Array:
    """Return dε/ds of a spring at stresses s > 0 on the way up to `most`, or down from it."""
    if not hasattr(spring, "sigma_plus"):
        return np.full(s.size, 1.0 / spring.k0)
    held = float(_score(spring, "plus", np.array([most]))[0])
    a, slope = _on_a(spring, spring.k0, s)
    if rising:
        w, wide = _score(spring, "plus", s), np.full(s.size, spring.spread_plus)
        on_a = ndtr(-w) * slope
    else:
        up = _score(spring, "plus", s, spring.weakening)
        down = _score(spring, "minus", s)
        back = np.maximum(up, down)
        w = np.minimum(held, back)
        wide = np.where(up >= down, spring.spread_plus, spring.spread_minus)
        wide = np.where(held < back, np.inf, wide)
        a, softer = _on_a(spring, spring.k0 * math.exp(-spring.softening), s)
        on_a = ndtr(-held) * slope + (ndtr(-w) - ndtr(-held)) * softer
    gap = spring.eps_star + s / (spring.kc + s) - a
    density = np.exp(-0.5 * w * w) / math.sqrt(2.0 * math.pi) / (wide * s)
    return np.asarray(on_a + ndtr(w) * spring.kc / (spring.kc + s) ** 2 + gap * density)


def _cuts(chain: Any, most: float, rising: bool) -> Array:
    """Stresses between which all is smooth, and changes by little."""
    cuts = [0.0, most]
    for spring in chain.springs:
        if not hasattr(spring, "sigma_plus"):
            continue
        for sign in ("plus",) if rising else ("plus", "minus"):
            place, wide = getattr(spring, f"sigma_{sign}"), getattr(spring, f"spread_{sign}")
            if sign == "plus" and not rising:
                place *= math.exp(-spring.weakening)
            cuts += list(place * np.exp(wide * np.arange(-9.0, 9.01, 0.5)))
        if rising:
            continue
        held = math.log(most / spring.sigma_plus) / spring.spread_plus
        cuts.append(most * math.exp(-spring.weakening))
        cuts.append(spring.sigma_minus * math.exp(min(spring.spread_minus * held, 600.0)))
        apart = 1.0 / spring.spread_minus - 1.0 / spring.spread_plus
        if apart != 0.0:
            at = math.log(spring.sigma_minus) / spring.spread_minus
            at -= (math.log(spring.sigma_plus) - spring.weakening) / spring.spread_plus
            at /= apart
            cuts.append(math.exp(min(max(at, -600.0), 600.0)))
    cuts += list(most * np.linspace(0.0, 1.0, 12))
    return np.unique([c for c in cuts if 0.0 <= c <= most])


class _Way:
    """One way between rest and the largest stress: energies and times by Gauss quadrature."""

    def __init__(self, chain: Any, most: float, rising: bool) -> None:
        self.chain, self.most, self.rising = chain, most, rising
        self.cuts = _cuts(chain, most, rising)

    def soft(self, s: Array) -> Array:
        total = np.zeros(s.size)
        for spring, h in zip(self.chain.springs, self.chain.heights, strict=True):
            total += h * _compliance(spring, s, self.most, self.rising)
        return total

    def taken(self) -> float:
        """Energy per area from rest to the largest stress."""
        total = 0.0
        for low, high in pairwise(self.cuts):
            s = low + 0.5 * (high - low) * (_X + 1.0)
            total += 0.5 * (high - low) * float(_W @ (s * self.soft(s)))
        return total

    def time(self, areal: float) -> tuple[float, float]:
        """Time from the turn to rest, and the speed there; over x = √(most - s): v is smooth."""
        ends = np.unique(np.sqrt(self.most - self.cuts))
        energy = time = 0.0
        for low, high in pairwise(ends):
            half = 0.5 * (high - low)
            x = low + half * (_X + 1.0)
            s = self.most - x * x
            soft = self.soft(s)
            power = 2.0 * x * s * soft
            # what has been given back up to each node: the polynomial through the nodes, integrated
            along = energy + half * (_CUMULATIVE @ power)
            if low == 0.0:  # v goes to zero with x: each node by its own quadrature
                inner = 0.5 * (_X[None, :] + 1.0) * x[:, None]
                far = self.most - inner**2
                c = self.soft(far.ravel()).reshape(far.shape)
                along = 0.5 * x * ((2.0 * inner * far * c) @ _W)
            time += half * float(_W @ (2.0 * x * soft / np.sqrt(2.0 * along / areal)))
            energy += half * float(_W @ power)
        return time, math.sqrt(2.0 * energy / areal)


def _cumulative() -> Array:
    """Integrals from -1 to each node of the polynomial through values at the nodes."""
    fit = np.linalg.inv(np.polynomial.legendre.legvander(_X, NODES - 1))
    columns = [
        np.polynomial.legendre.legval(_X, np.polynomial.legendre.legint(fit[:, j], lbnd=-1.0))
        for j in range(NODES)
    ]
    return np.array(columns).T


_CUMULATIVE = _cumulative()


def rebound_of(chain: Any, drive: Any) -> tuple[float, float, float] | None:
    """End of contact (s), speed of the rebound (m/s) and largest stress (Pa); None if not known.

    Known where all springs are microscale or linear, without relaxation and dashpots, and nothing
    but the striker has mass.
    """
    if not hasattr(drive, "velocity") or any(chain.masses) or chain.site_damping > 0.0:
        return None
    for spring in chain.springs:
        if spring.eta > 0.0 or any(g > 0.0 for g, _ in getattr(spring, "relaxation", ())):
            return None
        if not hasattr(spring, "sigma_plus") and hasattr(spring, "kc"):
            return None
    if not any(hasattr(s, "sigma_plus") for s in chain.springs):
        return None
    areal = drive.mass / chain.area
    wanted = 0.5 * areal * drive.velocity**2
    high = min(s.k0 for s in chain.springs)
    while _Way(chain, high, True).taken() < wanted:
        high *= 2.0
        if high > 1e18:
            return None
    low = high
    while _Way(chain, low, True).taken() > wanted:
        low *= 0.5
    most = float(
        brentq(lambda s: _Way(chain, s, True).taken() - wanted, low, high, xtol=1e-300, rtol=1e-14)
    )
    up, _ = _Way(chain, most, True).time(areal)
    down, speed = _Way(chain, most, False).time(areal)
    return up + down, speed, most
