"""Judge of rate-independent chains under a known motion: root finding at 30 digits.

Undamped, massless springs without relaxation bear one stress, and as long as the stress is
monotone, the strain of each is a monotone function of it. At every sample the judge finds the
stress at which the elongations add up to the prescribed displacement; then each spring updates its
state: the flag of a bistable spring, the ranks of a microscale one. Nothing is integrated, so
neither the times of the samples nor the width of a snap matter. Laws: docs/theory.md.
"""

from typing import Any

import numpy as np
from mpmath import exp, findroot, inf, log, mp, mpf, ncdf

from independent import Array, Truth, bistable_row

DIGITS = 30


class _Linear:
    """ε = σ/k."""

    def __init__(self, spring: Any) -> None:
        self.k0 = mpf(spring.k0)

    def strain(self, s: Any) -> Any:
        return s / self.k0

    def keep(self, s: Any) -> None:
        """Update the state of the spring at a stress."""


class _Bistable(_Linear):
    """Four branches, and a flag for a spring that has snapped."""

    def __init__(self, spring: Any) -> None:
        points = map(mpf, bistable_row(spring, 1.0)[:11])
        self.k0, self.kc, self.eps_a, self.eps_c, self.star, self.sigma_a, *rest = points
        self.sigma_c, self.up, self.down, back, through = rest
        self.back = self.sigma_c + self.down * (back - self.eps_c) if back > -inf else -inf
        self.through, self.snapped = self.sigma_a + self.up * (through - self.eps_a), False

    def strain(self, s: Any) -> Any:
        on_c = s > self.sigma_c if self.snapped else s > self.through
        if on_c:
            return self.star + s / (self.kc + s)
        if self.snapped and s >= self.back:
            return self.eps_c + (s - self.sigma_c) / self.down
        if not self.snapped and s >= self.sigma_a:
            return self.eps_a + (s - self.sigma_a) / self.up
        return s / (self.k0 + s)

    def keep(self, s: Any) -> None:
        self.snapped = s >= self.back if self.snapped else s > self.through


class _Microscale(_Linear):
    """Ranks of micro-springs snapped now and snapped ever, as normal scores."""

    def __init__(self, spring: Any) -> None:
        names = ("k0", "kc", "eps_star", "spread_plus", "spread_minus", "stiffening", "weakening")
        self.k0, self.kc, self.star, self.plus, self.minus, self.n, self.weakening = (
            mpf(getattr(spring, name)) for name in names
        )
        self.at_plus, self.at_minus = log(mpf(spring.sigma_plus)), log(mpf(spring.sigma_minus))
        self.soft, self.rank, self.most = self.k0 * exp(-mpf(spring.softening)), -inf, -inf

    def moved(self, s: Any) -> tuple[Any, Any]:
        """Return both ranks at a stress, from the stored ones."""
        if s <= 0:
            return -inf, self.most
        plus = (log(s) - self.at_plus) / self.plus
        least = max(plus, min(plus + self.weakening / self.plus, self.most))
        most = max(least, (log(s) - self.at_minus) / self.minus)
        rank = min(max(self.rank, least), most)
        return rank, max(rank, self.most)

    def _on_a(self, s: Any, k: Any) -> Any:
        return s / (k + s) if self.n == 1 else 1 - (1 + self.n * s / k) ** (-1 / self.n)

    def strain(self, s: Any) -> Any:
        rank, most = self.moved(s)
        snapped, rest, never = ncdf(rank), ncdf(-rank), ncdf(-most)
        on_c = self.star + s / (self.kc + s) if snapped > 0 else mpf(0)
        worn = (rest - never) * self._on_a(s, self.soft) if rest > never else mpf(0)
        return never * self._on_a(s, self.k0) + worn + snapped * on_c

    def keep(self, s: Any) -> None:
        self.rank, self.most = self.moved(s)


KINDS = {"sigma_plus": _Microscale, "kc": _Bistable, "k0": _Linear}  # by what only they have


def _root(springs: list[_Linear], heights: list[Any], top: Any, s: Any) -> Any:
    """Return the stress at which the elongations add up, by bisection from the last stress."""

    def miss(at: Any) -> Any:
        return sum(h * p.strain(at) for h, p in zip(heights, springs, strict=True)) - top

    here = miss(s)
    if here == 0:
        return s
    low = high = s
    low_miss = high_miss = here
    step = max(abs(s), min(p.k0 for p in springs)) / 1000
    # only a linear spring can be pulled further
    floor = -min(min(p.k0, getattr(p, "soft", p.k0) / getattr(p, "n", 1)) for p in springs)
    while here * (high_miss if here < 0 else low_miss) > 0:
        if here < 0:
            low, low_miss = high, high_miss
            high += step
            high_miss = miss(high)
        else:
            high, high_miss = low, low_miss
            low = max(low - step, (low + floor) / 2) if low > floor else low - step
            low_miss = miss(low)
        step *= 2
    close = mpf(10) ** (2 - DIGITS) * max(abs(low), abs(high))
    return findroot(miss, (low, high), solver="bisect", tol=close, maxsteps=400, verify=False)


def follow(chain: Any, drive: Any, time: Array) -> Truth:
    """Follow a chain over the samples of a known displacement of its top."""
    with mp.workdps(DIGITS):
        springs = [next(kind for name, kind in KINDS.items() if hasattr(spring, name))(spring)
                   for spring in chain.springs]  # fmt: skip
        heights = [mpf(h) for h in chain.heights]
        base, nodes = np.empty(time.size), np.empty((len(springs), time.size))
        s = mpf(0)
        for j, top in enumerate(drive.displacement):
            s = _root(springs, heights, mpf(float(top)), s)
            strains = [p.strain(s) for p in springs]
            base[j] = float(s)
            nodes[:, j] = np.cumsum([float(h * e) for h, e in zip(heights, strains, strict=True)])
            for p in springs:
                p.keep(s)
    return Truth(nodes, base, None, unsure=0.0)
