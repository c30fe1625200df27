"""An independent integrator for chains of springs with memory: SciPy, from event to event.

Unlike foamfit, it uses no power series, no strains as state variables and no lowest rank. The state
consists of the equilibrium stresses of the springs, ds/dt = (dε/dt)/(dε/ds), the relaxation
variables, and the motion of the masses.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import ndtr

import foamfit as ff
from foamfit.springs.chain import Drive

Array = NDArray[np.float64]
PLUS, MINUS, HELD, BOTH, VIRGIN = "plus", "minus", "held", "both", "virgin"
FIRST = "first"
LEAST = -12.0  # rank at which the snapped fraction is 2e-33


class Linear:
    """ε = s/k."""

    def __init__(self, spring: Any) -> None:
        self.spring, self.mode = spring, "line"

    def strain(self, s: float) -> tuple[float, float]:
        return s / self.spring.k0, 1.0 / self.spring.k0

    def bears(self, s: float) -> float:
        """Return the stress that the spring transmits."""
        return s

    def ends(self) -> tuple[float, float]:
        return -math.inf, math.inf

    def turns(self) -> int:
        """Return the sign of ds/dt that ends the mode, or 0 if neither sign does."""
        return 0

    def leave(self, s: float, side: int) -> None:
        raise AssertionError

    def turn(self, s: float) -> None:
        raise AssertionError


class Unilateral(Linear):
    """A unilateral spring alone between two masses; its state s = k ε also covers an open gap."""

    def bears(self, s: float) -> float:
        return max(s, 0.0)

    def ends(self) -> tuple[float, float]:
        return (0.0, math.inf) if self.mode == "line" else (-math.inf, 0.0)

    def leave(self, s: float, side: int) -> None:
        self.mode = "line" if side > 0 else "open"


class Bistable(Linear):
    """Eqs. 1 to 3 as functions of stress."""

    def __init__(self, spring: Any) -> None:
        self.spring, self.mode = spring, "a"

    def strain(self, s: float) -> tuple[float, float]:
        p = self.spring
        if self.mode == "a":
            return s / (p.k0 + s), p.k0 / (p.k0 + s) ** 2
        if self.mode == "c":
            return p.eps_star + s / (p.kc + s), p.kc / (p.kc + s) ** 2
        if self.mode == "d":
            return p.eps_a + (s - p.sigma_a) / p.kh_plus, 1.0 / p.kh_plus
        return p.eps_c + (s - p.sigma_c) / p.kh_minus, 1.0 / p.kh_minus

    def ends(self) -> tuple[float, float]:
        p = self.spring
        top = p.sigma_a + p.kh_plus * (p.eps_hat_c - p.eps_a)
        low = p.k0 * p.eps_hat_a / (1.0 - p.eps_hat_a) if p.eps_hat_a > -math.inf else -math.inf
        return {
            "a": (-math.inf, p.sigma_a), "d": (p.sigma_a, top),
            "c": (p.sigma_c, math.inf), "e": (low, p.sigma_c),
        }[self.mode]  # fmt: skip

    def leave(self, s: float, side: int) -> None:
        after = {("a", 1): "d", ("d", 1): "c", ("d", -1): "a", ("c", -1): "e"}
        self.mode = (after | {("e", 1): "c", ("e", -1): "a"})[self.mode, side]


class Microscale(Linear):
    """Section 6 of the model, with p expressed by ranks, starting from p = 0."""

    def __init__(self, spring: Any) -> None:
        self.spring, self.rank, self.mode = spring, LEAST, VIRGIN

    def _of(self, minus: bool) -> tuple[float, float]:
        p = self.spring
        return (p.sigma_minus, p.spread_minus) if minus else (p.sigma_plus, p.spread_plus)

    def _cross(self) -> float:
        """Return the stress at which P₊ = P₋ for the current parameters."""
        (plus, spread), (minus, other) = self._of(False), self._of(True)
        if spread == other:
            return math.inf if minus < plus else 0.0
        slope = 1.0 / other - 1.0 / spread
        number = math.log(minus) / other - math.log(plus) / spread
        at = number / slope
        return math.exp(at) if at < 700.0 else math.inf

    def _hysteretic(self, s: float, side: int) -> bool:
        below = self.spring.spread_minus >= self.spring.spread_plus
        cross = self._cross()
        beyond = s > cross or (s == cross and side > 0)
        return not beyond if below else beyond

    def strain(self, s: float) -> tuple[float, float]:
        p = self.spring
        middle, spread = self._of(self.mode == MINUS)
        u, steep = self.rank if self.mode == HELD else -math.inf, 0.0
        if self.mode not in (HELD, VIRGIN) and s > 0.0:  # a trial step may pass 0
            u = math.log(s / middle) / spread
            steep = math.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi) / (spread * s)
        snapped, rest = ndtr(u), ndtr(-u)
        a, c = s / (p.k0 + s), p.eps_star + s / (p.kc + s)
        soft = rest * p.k0 / (p.k0 + s) ** 2 + snapped * p.kc / (p.kc + s) ** 2
        return rest * a + snapped * c, soft + steep * (c - a)

    def ends(self) -> tuple[float, float]:
        p, cross = self.spring, self._cross()
        below = p.spread_minus >= p.spread_plus  # True if the law is hysteretic below the crossing
        plus, minus = (m * math.exp(w * self.rank) for m, w in (self._of(False), self._of(True)))
        if self.mode == HELD:
            return min(plus, minus), plus
        plus, minus = (m * math.exp(w * LEAST) for m, w in (self._of(False), self._of(True)))
        if self.mode == VIRGIN:
            return -math.inf, plus
        if self.mode == PLUS:
            return -math.inf, cross if below else math.inf
        if self.mode == MINUS:
            return minus if below else max(minus, cross), math.inf
        return (max(plus, cross), math.inf) if below else (plus, cross)

    def turns(self) -> int:
        return {PLUS: -1, MINUS: 1}.get(self.mode, 0)

    def leave(self, s: float, side: int) -> None:
        if self.mode in (MINUS, BOTH) and side < 0 and s != self._cross():
            self.mode = VIRGIN
        elif not self._hysteretic(s, side):
            self.mode = BOTH
        else:
            self.mode = PLUS if side > 0 else MINUS

    def turn(self, s: float) -> None:
        middle, spread = self._of(self.mode == MINUS)
        self.rank = math.log(s / middle) / spread
        self.mode = HELD


class Remembering(Microscale):
    """Section 8 of the model: micro-springs that have snapped are softer and snap earlier."""

    def __init__(self, spring: Any) -> None:
        super().__init__(spring)
        self.most = LEAST  # highest rank that has ever snapped

    def _of(self, minus: bool) -> tuple[float, float]:
        middle, spread = super()._of(minus)
        return middle if minus else middle * math.exp(-self.spring.weakening), spread

    def _a(self, s: float, k: float) -> tuple[float, float]:
        n = self.spring.stiffening
        y = 1.0 + n * s / k
        return 1.0 - y ** (-1.0 / n), y ** (-1.0 / n - 1.0) / k

    def strain(self, s: float) -> tuple[float, float]:
        p = self.spring
        middle, spread = self._of(self.mode == MINUS)
        middle = p.sigma_plus if self.mode == FIRST else middle
        u, steep = self.rank if self.mode == HELD else -math.inf, 0.0
        if self.mode not in (HELD, VIRGIN) and s > 0.0:
            u = math.log(s / middle) / spread
            steep = math.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi) / (spread * s)
        snapped, ever = ndtr(u), ndtr(u if self.mode == FIRST else self.most)
        (fresh, stiff), (worn, soft) = self._a(s, p.k0), self._a(s, p.k0 * math.exp(-p.softening))
        c, rise = p.eps_star + s / (p.kc + s), p.kc / (p.kc + s) ** 2
        strain = (1.0 - ever) * fresh + (ever - snapped) * worn + snapped * c
        slope = (1.0 - ever) * stiff + (ever - snapped) * soft + snapped * rise
        return strain, slope + steep * (c - (fresh if self.mode == FIRST else worn))

    def _first(self, rank: float) -> float:
        return float(self.spring.sigma_plus * math.exp(self.spring.spread_plus * rank))

    def _again(self, rank: float) -> float:
        middle, spread = self._of(False)
        return middle * math.exp(spread * rank)

    def ends(self) -> tuple[float, float]:
        if self.mode == FIRST:
            return -math.inf, math.inf
        low, high = super().ends()
        if (self.mode == HELD and self.rank >= self.most) or (
            self.mode == VIRGIN and self.most == LEAST
        ):
            high = self._first(self.rank)
        if self.mode in (PLUS, BOTH):
            high = min(high, self._again(self.most))
        return low, high

    def turns(self) -> int:
        return -1 if self.mode == FIRST else super().turns()

    def leave(self, s: float, side: int) -> None:
        if side > 0 and s == self._first(self.rank) and self.rank >= self.most:
            self.mode = FIRST
        elif side > 0 and self.mode in (PLUS, BOTH) and s == self._again(self.most):
            self.mode, self.rank = HELD, self.most
        else:
            super().leave(s, side)
            if self.mode == VIRGIN:
                self.rank = LEAST

    def turn(self, s: float) -> None:
        if self.mode == FIRST:
            self.most = self.rank = math.log(s / self.spring.sigma_plus) / self.spring.spread_plus
            self.mode = HELD
        else:
            super().turn(s)


def law_of(spring: Any) -> Linear:
    if getattr(spring, "unilateral", False):
        return Unilateral(spring)
    if spring.law.own[-1] == "weakening":
        return Remembering(spring)
    return {
        ff.BistableSpring: Bistable, ff.MicroscaleSpring: Microscale, ff.LinearSpring: Linear
    }[type(spring)](spring)  # fmt: skip


def follow(
    chain: ff.Chain, drive: Drive, t: Array, tol: float = 1e-12, method: str = "DOP853"
) -> tuple[Array, Array, float, int]:
    """Return displacements (springs, n), base stress (n,), end of contact or NaN, and events."""
    laws, h, count = [law_of(s) for s in chain.springs], np.array(chain.heights), len(chain.springs)
    eta = np.array([s.eta for s in chain.springs])
    terms = [(i, g, tau) for i, s in enumerate(chain.springs) for g, tau in s.relaxation if g > 0.0]
    own = np.array([i for i, _, _ in terms], int)
    g, tau = np.array([x[1] for x in terms]), np.array([x[2] for x in terms])
    gain = 1.0 + np.bincount(own, g, count)
    drag = chain.site_damping / chain.height
    mass = np.array(chain.masses) / chain.area
    struck = isinstance(drive, ff.Impact)
    if isinstance(drive, ff.Impact):
        mass[-1] += drive.mass / chain.area
        if isinstance(laws[0], Unilateral):  # contact ends when the top spring opens
            laws[0] = Linear(chain.springs[0])
    moved = isinstance(drive, ff.DisplacementDrive)
    heavy = [i for i in range(count) if mass[i] > 0.0 and not (moved and i == count - 1)]
    tops = heavy if heavy and heavy[-1] == count - 1 else [*heavy, count - 1]
    groups = [range(a + 1, b + 1) for a, b in zip([-1, *tops[:-1]], tops, strict=True)]
    values = np.zeros(t.size)
    if isinstance(drive, ff.StressDrive):
        values = drive.stress
    elif isinstance(drive, ff.DisplacementDrive):
        values = drive.displacement
    knot, _free, pressed = 0, bool(heavy) and heavy[-1] == count - 1, not struck and not moved

    def rates(now: float, y: Array) -> tuple[Array, float]:
        """Return the derivative of the state [s, z, w and v of masses] and the base stress."""
        s, z, w = y[:count], y[count : count + len(terms)], y[count + len(terms) :]
        v = dict(zip(heavy, w[1::2], strict=True))
        slope = (values[knot + 1] - values[knot]) / (t[knot + 1] - t[knot]) if not struck else 0.0
        push = values[knot] + slope * (now - t[knot]) if pressed else 0.0
        dz = -(z + g * s[own]) / tau
        held, held_rate = np.bincount(own, z, count), np.bincount(own, dz, count)
        sig = gain * [law.bears(x) for law, x in zip(laws, s, strict=True)] + held
        soft = np.array([law.strain(x)[1] for law, x in zip(laws, s, strict=True)])
        ds, common = np.zeros(count), []
        below = 0.0
        for group in groups:
            top = group[-1]
            damped = [i for i in group if eta[i] > 0.0]
            rigid = [i for i in group if eta[i] == 0.0]
            known = top in v or moved or top != count - 1
            total = float(sig[rigid[0]]) if rigid else 0.0
            if not known and drag == 0.0:  # under a prescribed stress
                total = push
                for i in rigid:
                    ds[i] = (slope - held_rate[i]) / gain[i]
            else:
                above = v.get(top, slope if moved else 0.0)
                if not rigid:
                    pull = sum(h[i] * sig[i] / eta[i] for i in damped)
                    weight = sum(h[i] / eta[i] for i in damped)
                    if known:
                        total = (above - below + pull) / weight
                    else:
                        total = (push / drag - below + pull) / (weight + 1.0 / drag)
                if not known:
                    above = (push - total) / drag
                rest = above - below - sum(h[i] * (total - sig[i]) / eta[i] for i in damped)
                give = {i: h[i] * soft[i] / gain[i] for i in rigid}
                rest += sum(give[i] * held_rate[i] for i in rigid)
                for i in rigid:
                    ds[i] = (rest / sum(give.values()) - held_rate[i]) / gain[i]
                below = above
            for i in damped:
                ds[i] = (total - sig[i]) / eta[i] / soft[i]
            common.append(total)
        dw = np.empty(2 * len(heavy))
        for k, i in enumerate(heavy):
            last = i == count - 1
            net = (push if last else common[k + 1]) - common[k] - (drag * v[i] if last else 0.0)
            dw[2 * k], dw[2 * k + 1] = v[i], net / mass[i]
        return np.concatenate([ds, dz, dw]), common[0]

    y = np.zeros(count + len(terms) + 2 * len(heavy))
    if isinstance(drive, ff.Impact):
        y[-1] = drive.velocity
    out_w, out_s = np.zeros((count, t.size)), np.zeros(t.size)
    now, events, done, end = float(t[0]), 0, 0, math.nan
    scale = max(s.k0 for s in chain.springs)
    atol = np.concatenate([
        np.full(count + len(terms), tol * scale * 1e-2), np.full(2 * len(heavy), tol * 1e-3)
    ])  # fmt: skip
    while now < t[-1]:
        stop = float(t[-1]) if struck else float(t[knot + 1])
        for i, law in enumerate(laws):
            if law.turns() * rates(now, y)[0][i] > 0.0:
                law.turn(y[i])
        found: list[Any] = []  # function, direction, spring, side
        for i, law in enumerate(laws):
            low, high = law.ends()
            if low > -math.inf:
                found.append((lambda x, y, i=i, at=low: y[i] - at, -1.0, i, -1))
            if high < math.inf:
                found.append((lambda x, y, i=i, at=high: y[i] - at, 1.0, i, 1))
            if law.turns():
                found.append((lambda x, y, i=i: rates(x, y)[0][i], law.turns(), i, 0))
        if struck and now > 0.0:
            found.append((lambda x, y: rates(x, y)[1], -1.0, -1, 0))
        for check, way, _, _ in found:
            check.terminal, check.direction = True, way
        limit = 0.02 * (t[-1] - t[0])
        if struck and now == 0.0:  # the base stress starts at zero
            stop = 1e-3 * float(t[-1])
        run = solve_ivp(
            lambda x, y: rates(x, y)[0], (now, stop), y, method, rtol=max(tol, 3e-14), atol=atol,
            events=[check for check, *_ in found] or None, dense_output=True, max_step=limit,
        )  # fmt: skip
        assert run.success, run.message
        reached = float(run.t[-1])
        while done < t.size and (t[done] < reached or (t[done] <= reached == stop)):
            state = run.sol(t[done])
            strain = [law.strain(x)[0] for law, x in zip(laws, state[:count], strict=True)]
            out_w[:, done] = np.cumsum(h * np.array(strain))
            out_s[done] = rates(float(t[done]), state)[1]
            done += 1
        now, y = reached, run.y[:, -1].copy()
        hit = [k for k, at in enumerate(run.t_events or []) if len(at)]
        for k in hit if run.status == 1 else []:
            events += 1
            i, side = found[k][2:]
            if i < 0:
                end = now
                strain = [law.strain(x)[0] for law, x in zip(laws, y[:count], strict=True)]
                place = np.cumsum(h * np.array(strain))
                later = t[done:] - now
                out_w[:, done:] = place[:, None] + y[-1] * later
                return out_w, out_s, end, events
            if side == 0:
                laws[i].turn(y[i])
            else:
                laws[i].leave(laws[i].ends()[0 if side < 0 else 1], side)
        if not struck and now >= t[knot + 1] and knot < t.size - 2:
            knot += 1
            if moved:  # at a kink a dashpot uses the mean of the rates on both sides
                share = (now - t[knot - 1]) / (t[knot + 1] - t[knot - 1])
                out_s[knot] += share * (rates(now, y)[1] - out_s[knot])
    return out_w, out_s, end, events
