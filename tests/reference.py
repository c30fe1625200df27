"""An independent reference for the spring law and for the chain: slow, simple and reliable.

Nothing here uses the package. Springs and chains are any objects with the attributes of `Bistable`,
`Linear` and `Chain` below. Derived points are roots of the branch functions, found by bracketing.
Motions are integrated with DOP853 on fixed branches; the integration stops exactly at every switch
and restarts there. States at samples and switches are ends of steps: the error of a step is bounded
by the tolerance, that of the interpolant of lower order between steps is not. Springs between two
nodes that have mass (or are clamped or driven) form a group: they are in series and carry the same
stress, which follows from the group's state.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import brentq

Array = NDArray[np.float64]

_QUADRATURE = np.polynomial.legendre.leggauss(24)


@dataclass(frozen=True)
class Bistable:
    k0: float
    kc: float
    dsigma: float
    eps_a: float
    eps_c: float
    kh_plus: float
    kh_minus: float
    eta: float = 0.0


@dataclass(frozen=True)
class Linear:
    k0: float
    eta: float = 0.0
    unilateral: bool = False


@dataclass(frozen=True)
class Chain:
    springs: tuple[Bistable | Linear, ...]
    heights: tuple[float, ...]
    area: float
    masses: tuple[float, ...] | None = None
    site_damping: float = 0.0


@dataclass(frozen=True)
class Impact:
    mass: float
    velocity: float


@dataclass
class Motion:
    """Motion of the nodes; `velocity` is zero for nodes without mass."""

    time: Array
    displacement: Array
    velocity: Array
    base_stress: Array
    strain: Array
    contact_end: float | None = None
    rebound: float | None = None
    switches: list[tuple[float, int, str]] = field(default_factory=list)


def root(function: Callable[[float], float], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-17, rtol=4 * np.finfo(float).eps, maxiter=500))


# --------------------------------------------------------------------------- the law of one spring


class LinearLaw:
    """A linear spring; its branches are `on` and, if it cannot pull, `off` below zero strain."""

    def __init__(self, spring: Any) -> None:
        self.k0 = float(spring.k0)
        self.unilateral = bool(spring.unilateral)
        self.start = "on"

    def sigma(self, branch: str, eps: float) -> float:
        return self.k0 * eps if branch == "on" else 0.0

    def slope(self, branch: str, eps: float) -> float:
        return self.k0 if branch == "on" else 0.0

    def inverse(self, branch: str, sigma: float) -> float:
        return sigma / self.k0

    def bounds(self, branch: str) -> list[tuple[float, int, str]]:
        if not self.unilateral:
            return []
        return [(0.0, -1, "off")] if branch == "on" else [(0.0, +1, "on")]

    def strain_at(self, flag: str, sigma: float) -> float:
        return max(sigma, 0.0) / self.k0 if self.unilateral else sigma / self.k0

    def flag_after(self, flag: str, eps: float) -> str:
        return flag

    def stress(self, history: ArrayLike) -> Array:
        eps = np.asarray(history, float)
        return self.k0 * np.maximum(eps, 0.0) if self.unilateral else self.k0 * eps

    def strain(self, history: ArrayLike) -> Array:
        return np.array([self.strain_at("", s) for s in np.asarray(history, float)])

    def work(self, history: ArrayLike) -> Array:
        eps = np.asarray(history, float)
        return 0.5 * self.k0 * (np.maximum(eps, 0.0) if self.unilateral else eps) ** 2

    loop = 0.0


class BistableLaw:
    """The seven-parameter law, branch by branch."""

    start = "a"
    nearly_parallel = False  # if True, rounding decides whether a and e meet

    def __init__(self, spring: Any) -> None:
        self.k0, self.kc = float(spring.k0), float(spring.kc)
        self.eps_a, self.eps_c = float(spring.eps_a), float(spring.eps_c)
        self.kh_plus, self.kh_minus = float(spring.kh_plus), float(spring.kh_minus)
        self.sigma_a = self.sigma("a", self.eps_a)
        self.sigma_c = self.sigma_a + float(spring.dsigma)
        # Find the start of branch c for which C2 lies on that branch.
        part = root(lambda x: self.kc * x - self.sigma_c * (1 - x), 0.0, 1.0)
        self.eps_star = self.eps_c - part
        self.limit = 1.0 + self.eps_star
        self.eps_hat_c = self._find_hat_c()
        self.sigma_hat_c = self.sigma("d", self.eps_hat_c)
        self.eps_hat_a = self._find_hat_a()

    def _find_hat_c(self) -> float:
        part = self.eps_c - self.eps_star

        def gap(beyond: float) -> float:  # c − d beyond C2, multiplied by the distance to the pole
            x = part + beyond
            return self.kc * x - (1 - x) * self.sigma("d", self.eps_c + beyond)

        if gap(0.0) >= 0.0:  # C1 is C2, up to rounding
            return self.eps_c
        return self.eps_c + root(gap, 0.0, 1 - part)

    def _find_hat_a(self) -> float | None:
        def gap(eps: float) -> float:
            return self.sigma("a", eps) - self.sigma("e", eps)

        if gap(self.eps_a) == 0.0:
            return self.eps_a
        if self.kh_minus < 1e-3 * self.k0 and gap(0.0) <= 0.0:
            return root(gap, 0.0, self.eps_a)
        lowest = 1.0 - np.sqrt(self.k0 / self.kh_minus)  # where a and e are parallel
        size = abs(self.sigma("a", lowest)) + abs(self.sigma("e", lowest))
        self.nearly_parallel = abs(gap(lowest)) <= 1e-12 * size
        if lowest >= self.eps_a or gap(lowest) > 0.0:
            return None
        return root(gap, lowest, self.eps_a)

    def sigma(self, branch: str, eps: float) -> float:
        if branch == "a":
            return self.k0 * eps / (1 - eps)
        if branch == "d":
            return self.sigma_a + self.kh_plus * (eps - self.eps_a)
        if branch == "c":
            return self.kc * (eps - self.eps_star) / (1 - (eps - self.eps_star))
        return self.sigma_c + self.kh_minus * (eps - self.eps_c)

    def slope(self, branch: str, eps: float) -> float:
        if branch == "a":
            return self.k0 / (1 - eps) ** 2
        if branch == "d":
            return self.kh_plus
        if branch == "c":
            return self.kc / (self.limit - eps) ** 2
        return self.kh_minus

    def inverse(self, branch: str, sigma: float) -> float:
        if branch == "a":
            return sigma / (self.k0 + sigma)
        if branch == "d":
            return self.eps_a + (sigma - self.sigma_a) / self.kh_plus
        if branch == "c":
            return self.eps_star + sigma / (self.kc + sigma)
        return self.eps_c + (sigma - self.sigma_c) / self.kh_minus

    def bounds(self, branch: str) -> list[tuple[float, int, str]]:
        """Return the ends of a branch: (strain, direction of leaving, next branch)."""
        if branch == "a":
            return [(self.eps_a, +1, "d")]
        if branch == "d":
            return [(self.eps_a, -1, "a"), (self.eps_hat_c, +1, "c")]
        if branch == "c":
            return [(self.eps_c, -1, "e")]
        below = [] if self.eps_hat_a is None else [(self.eps_hat_a, -1, "a")]
        return [(self.eps_c, +1, "c"), *below]

    def branch(self, flag: str, eps: float) -> str:
        if flag == "a":
            return "a" if eps <= self.eps_a else "d" if eps <= self.eps_hat_c else "c"
        if eps >= self.eps_c:
            return "c"
        return "a" if self.eps_hat_a is not None and eps < self.eps_hat_a else "e"

    def flag_after(self, flag: str, eps: float) -> str:
        return {"a": "a", "d": "a", "c": "c", "e": "c"}[self.branch(flag, eps)]

    def branches(self, history: ArrayLike) -> list[str]:
        flag, out = "a", []
        for eps in np.asarray(history, float):
            out.append(self.branch(flag, eps))
            flag = self.flag_after(flag, eps)
        return out

    def stress(self, history: ArrayLike) -> Array:
        pairs = zip(self.branches(history), np.asarray(history, float), strict=True)
        return np.array([self.sigma(branch, eps) for branch, eps in pairs])

    def strain_at(self, flag: str, sigma: float) -> float:
        """Return the strain at a stress by bracketing on the monotone curve that `flag` selects."""

        def gap(eps: float) -> float:
            return self.sigma(self.branch(flag, eps), eps) - sigma

        low = -1.0
        while gap(low) > 0.0:
            low *= 2.0
            if low < -1e9:
                raise ValueError("no strain carries this stress")
        room = 0.5 * (self.limit - self.eps_hat_c)
        while gap(self.limit - room) < 0.0:
            room *= 0.5
        return root(gap, low, self.limit - room)

    def strain(self, history: ArrayLike) -> Array:
        flag, out = "a", []
        for sigma in np.asarray(history, float):
            eps = self.strain_at(flag, sigma)
            flag = self.flag_after(flag, eps)
            out.append(eps)
        return np.array(out)

    def pieces(self, history: ArrayLike) -> Iterator[list[tuple[str, float, float]]]:
        """Yield for each sample the branch segments traversed since the previous sample."""
        branch, here = "a", 0.0
        for there in np.asarray(history, float):
            out, sense = [], 1 if there >= here else -1
            while here != there:
                ends = [b for b in self.bounds(branch) if b[1] == sense]
                crossed = [b for b in ends if (there - b[0]) * sense > 0.0]
                stop, _, following = crossed[0] if crossed else (there, 0, branch)
                out.append((branch, here, stop))
                branch, here = following, stop
            yield out

    def integral(self, branch: str, start: float, stop: float) -> float:
        x, w = _QUADRATURE
        eps = 0.5 * (start + stop) + 0.5 * (stop - start) * x
        return 0.5 * (stop - start) * float(w @ [self.sigma(branch, e) for e in eps])

    def work(self, history: ArrayLike) -> Array:
        """Return ∫σ dε along a history that starts from rest."""
        steps = [sum(self.integral(*piece) for piece in way) for way in self.pieces(history)]
        return np.cumsum(steps)

    @property
    def loop(self) -> float:
        """Return the energy per volume dissipated in one closed loop."""
        if self.eps_hat_a is None:
            raise ValueError("this loop is not closed by branch a")
        corners = [
            ("a", self.eps_hat_a, self.eps_a),
            ("d", self.eps_a, self.eps_hat_c),
            ("c", self.eps_hat_c, self.eps_c),
            ("e", self.eps_c, self.eps_hat_a),
        ]
        return sum(self.integral(*piece) for piece in corners)


@cache
def _law(spring: Any) -> BistableLaw | LinearLaw:
    return BistableLaw(spring) if hasattr(spring, "kc") else LinearLaw(spring)


def law(spring: Any) -> Any:
    """Return the law of any object that has the attributes of a spring."""
    return _law(spring)


# ------------------------------------------------------------------------------- a chain in motion


@dataclass
class _Group:
    """Springs in series between two nodes of known motion; all carry the same stress."""

    springs: list[int]  # indices, base first
    bottom: int  # index of the node below (0 is the base)
    top: int  # index of the node above


class _System:
    """Right-hand side and outputs of a chain on the fixed branches `self.branch`.

    The state contains the strains of the springs with a dashpot, then displacement and velocity of
    every node with mass, then, under a prescribed stress, the displacement of a top node that has
    no mass but a damper to the ground.
    """

    def __init__(self, chain: Any, striker: float, drive: str) -> None:
        self.n = len(chain.springs)
        self.laws = [law(s) for s in chain.springs]
        self.h = [float(h) for h in chain.heights]
        self.eta = [float(s.eta) for s in chain.springs]
        self.area = float(chain.area)
        masses = [0.0] * self.n if chain.masses is None else [float(m) for m in chain.masses]
        masses[-1] += striker
        self.mass = [0.0, *masses]
        self.site = float(chain.site_damping) / sum(self.h)
        self.drive = drive
        n = self.n
        self.heavy = [i for i in range(1, n + 1) if self.mass[i] > 0.0]
        if drive == "displacement":
            self.heavy = [i for i in self.heavy if i != n]
        self.dashed = [i for i in range(n) if self.eta[i] > 0.0]
        light_top = drive == "stress" and n not in self.heavy
        self.damped_top = light_top and self.site > 0.0
        self.loaded_top = light_top and self.site == 0.0
        ends = sorted({0, *self.heavy, n})
        self.groups = [_Group(list(range(b, t)), b, t) for b, t in pairwise(ends)]
        self.free = [[i for i in one.springs if self.eta[i] == 0.0] for one in self.groups]
        self.damped = [[i for i in one.springs if self.eta[i] > 0.0] for one in self.groups]
        self.at_strain = {i: k for k, i in enumerate(self.dashed)}
        k = len(self.dashed)
        self.at_node = {node: k + 2 * j for j, node in enumerate(self.heavy)}
        k += 2 * len(self.heavy)
        self.at_top = k if self.damped_top else None
        self.size = k + (1 if self.damped_top else 0)
        self.branch = [lw.start for lw in self.laws]
        self.guess = [0.0] * len(self.groups)
        # drive in the current interval between samples: start time, start value and rate
        self.t0 = self.value = self.rate = 0.0

    def driven(self, t: float) -> float:
        return self.value + self.rate * (t - self.t0)

    def series(self, springs: Sequence[int], length: float, guess: float) -> float:
        """Return the stress at which springs in series without dashpots shorten by `length`."""
        if len(springs) == 1:
            i = springs[0]
            return float(self.laws[i].sigma(self.branch[i], length / self.h[i]))
        if any(self.branch[i] == "off" for i in springs):
            return 0.0

        def gap(s: float) -> float:
            inv = (self.h[i] * self.laws[i].inverse(self.branch[i], s) for i in springs)
            return sum(inv) - length

        soft = [self.laws[i].k0 for i in springs if self.branch[i] == "a"]
        soft += [self.laws[i].kc for i in springs if self.branch[i] == "c"]
        floor = -min(soft, default=np.inf)
        s = guess
        for _ in range(30):  # Newton's method; if it fails, the bracketing below takes over
            if s <= floor:
                break
            eps = [self.laws[i].inverse(self.branch[i], s) for i in springs]
            miss = sum(self.h[i] * e for i, e in zip(springs, eps, strict=True)) - length
            soften = sum(
                self.h[i] / self.laws[i].slope(self.branch[i], e)
                for i, e in zip(springs, eps, strict=True)
            )
            step = miss / soften
            s -= step
            if abs(step) <= 1e-14 * abs(s) + 1e-9:  # the remaining error is of second order
                return s
        scale = max(self.laws[i].k0 for i in springs)
        high = scale
        while gap(high) < 0.0:
            high *= 2.0
        low = -scale if floor == -np.inf else floor * (1 - 1e-12)
        while floor == -np.inf and gap(low) > 0.0:
            low *= 2.0
        return root(gap, low, high)

    def solve(self, t: float, y: Any) -> tuple[list[float], list[float], list[float], float]:
        """Return strains, group stresses, node positions at group ends, and the top velocity."""
        strain = [0.0] * self.n
        for i, k in self.at_strain.items():
            strain[i] = y[k]
        place, speed = {0: 0.0}, {0: 0.0}
        for node, k in self.at_node.items():
            place[node], speed[node] = y[k], y[k + 1]
        top_speed = np.nan
        if self.drive == "displacement":
            place[self.n], speed[self.n] = self.driven(t), self.rate
        elif self.at_top is not None:
            place[self.n] = y[self.at_top]
        stress = []
        for g, group in enumerate(self.groups):
            free, dashed = self.free[g], self.damped[g]
            sigma = {i: self.laws[i].sigma(self.branch[i], strain[i]) for i in dashed}
            loaded = group.top == self.n and self.loaded_top
            if loaded:
                s = self.driven(t)
            elif free:
                length = place[group.top] - place[group.bottom]
                length -= sum(self.h[i] * strain[i] for i in dashed)
                s = self.series(free, length, self.guess[g])
                self.guess[g] = s
            else:
                flow = sum(self.h[i] / self.eta[i] for i in dashed)
                rest = sum(self.h[i] * sigma[i] / self.eta[i] for i in dashed)
                if group.top in speed:
                    s = (speed[group.top] - speed[group.bottom] + rest) / flow
                else:  # the damper of the top node carries the rest of the stress
                    push = self.driven(t) - self.site * (speed[group.bottom] - rest)
                    s = push / (1.0 + self.site * flow)
            if free and not loaded and any(self.branch[i] == "off" for i in free):
                slack = [i for i in free if self.branch[i] == "off"]
                for i in free:
                    strain[i] = 0.0
                    if i not in slack:
                        strain[i] = self.laws[i].inverse(self.branch[i], 0.0)
                        length -= self.h[i] * strain[i]
                for i in slack:
                    strain[i] = length / len(slack) / self.h[i]
            elif len(free) == 1 and not loaded:
                strain[free[0]] = length / self.h[free[0]]
            else:
                for i in free:
                    strain[i] = self.laws[i].inverse(self.branch[i], s)
            stress.append(s)
        if self.drive == "stress" and self.damped_top:
            top_speed = (self.driven(t) - stress[-1]) / self.site
        return strain, stress, [place[g.bottom] for g in self.groups], top_speed

    def rhs(self, t: float, y: Any) -> list[float]:
        y = y.tolist()
        strain, stress, _, top_speed = self.solve(t, y)
        out = [0.0] * self.size
        for g, group in enumerate(self.groups):
            for i in group.springs:
                if self.eta[i] > 0.0:
                    sigma = self.laws[i].sigma(self.branch[i], strain[i])
                    out[self.at_strain[i]] = (stress[g] - sigma) / self.eta[i]
            k = self.at_node.get(group.top)
            if k is None:
                continue
            force = -stress[g]
            if g + 1 < len(self.groups):
                force += stress[g + 1]
            if group.top == self.n:
                force -= self.site * y[k + 1]
                if self.drive == "stress":
                    force += self.driven(t)
            out[k] = y[k + 1]
            out[k + 1] = force * self.area / self.mass[group.top]
        if self.at_top is not None:
            out[self.at_top] = top_speed
        return out

    def output(self, t: float, y: Any) -> tuple[list[float], list[float], float]:
        strain, stress, bottoms, _ = self.solve(t, y.tolist())
        nodes, speeds = [], []
        for group, bottom in zip(self.groups, bottoms, strict=True):
            at = bottom
            for i in group.springs:
                at += self.h[i] * strain[i]
                k = self.at_node.get(i + 1)
                nodes.append(at if k is None else float(y[k]))
                speeds.append(0.0 if k is None else float(y[k + 1]))
        return nodes, speeds, stress[0]

    def events(self) -> tuple[list[Callable[[float, Any], float]], list[tuple[int, str]]]:
        functions, meaning = [], []
        for i in range(self.n):
            for where, sense, following in self.laws[i].bounds(self.branch[i]):

                def gap(t: float, y: Any, i: int = i, where: float = where) -> float:
                    return float(self.solve(t, y.tolist())[0][i] - where)

                gap.terminal, gap.direction = True, sense  # type: ignore[attr-defined]
                functions.append(gap)
                meaning.append((i, following))
        return functions, meaning


def _integrate(
    system: _System,
    y: Array,
    t: Array,
    knots: Array,
    samples: Array | None,
    scale: Array,
    rtol: float,
    steps: int,
) -> Motion:
    """Integrate from t[0] to t[-1]; the drive has kinks at `knots` with the values `samples`."""
    n_t = len(t)
    out = Motion(t, np.zeros((system.n, n_t)), np.zeros((system.n, n_t)), np.zeros(n_t), t * 0)

    def record(k: int, here: float, state: Array) -> None:
        out.displacement[:, k], out.velocity[:, k], out.base_stress[k] = system.output(here, state)

    def off_contact(here: float, state: Array) -> float:
        return system.solve(here, state.tolist())[1][0]

    off_contact.terminal, off_contact.direction = True, -1  # type: ignore[attr-defined]
    longest, entered = (t[-1] - t[0]) / steps, dict[int, float]()
    for j in range(len(knots) - 1):
        here, stop = float(knots[j]), float(knots[j + 1])
        if samples is not None:
            system.t0, system.value = here, float(samples[j])
            system.rate = float(samples[j + 1] - samples[j]) / (stop - here)
        if j == 0:
            record(0, here, y)
        elif system.drive == "displacement":  # the rate jumps at each knot, which is a sample here
            out.base_stress[j] = 0.5 * (out.base_stress[j] + system.output(here, y)[2])
        while here < stop:
            functions, meaning = system.events()
            if system.drive == "impact":
                functions, meaning = [*functions, off_contact], [*meaning, (-1, "free")]
            step = longest
            while True:
                found = solve_ivp(
                    system.rhs,
                    (here, stop),
                    y,
                    method="DOP853",
                    rtol=rtol,
                    atol=0.1 * rtol * scale,
                    events=functions or None,
                    dense_output=True,
                    max_step=step,
                )
                if found.status < 0:
                    raise RuntimeError(found.message)
                if not _missed(found, functions, meaning):
                    break
                step = 0.2 * min(step, float(np.diff(found.t).max()))
            ends = [
                gap for gap, at in zip(functions, found.t_events or (), strict=False) if len(at)
            ]
            reached = _event(system, found, ends[0]) if ends else found.t[-1]
            for k in np.flatnonzero((t > here) & (t <= reached)):
                record(int(k), t[k], _state(system, found, t[k]))
            here, y = reached, _state(system, found, reached)
            if found.status == 0:
                break
            for times, (i, following) in zip(found.t_events, meaning, strict=True):
                if len(times) and i == -1:
                    _fly(system, out, here, y)
                    return out
                if len(times):
                    system.branch[i] = following
                    entered[i] = here
                    out.switches.append((here, i, following))
            # other springs may switch at the same instant
            strain = system.solve(here, y.tolist())[0]
            for i in range(system.n):
                if here - entered.get(i, -np.inf) <= 1e-9 * longest:
                    continue  # rounding must not send it back
                for where, sense, following in system.laws[i].bounds(system.branch[i]):
                    if (strain[i] - where) * sense > 0.0:
                        system.branch[i], entered[i] = following, here
                        out.switches.append((here, i, following))
                        break
    return out


def _state(system: _System, found: Any, at: float) -> Array:
    """Return the state at a time, by a step of the method from the last step before it."""
    last = int(np.clip(np.searchsorted(found.t, at) - 1, 0, found.t.size - 2))
    start, y, h = found.t[last], found.y[:, last], at - found.t[last]
    k = np.zeros((DOP853.n_stages, y.size))
    for i in range(DOP853.n_stages):
        k[i] = system.rhs(start + DOP853.C[i] * h, y + h * (DOP853.A[i, :i] @ k[:i]))
    return np.asarray(y + h * (DOP853.B @ k))


def _event(system: _System, found: Any, gap: Callable[[float, Any], float]) -> float:
    """Return the time of an event, moved by a secant from where the interpolant has it."""
    at = float(found.t[-1])
    back = 1e-3 * (at - float(found.t[-2]))
    now, before = (gap(end, _state(system, found, end)) for end in (at, at - back))
    if now == before:
        return at
    return at + float(np.clip(-now * back / (now - before), -back, back))


def _missed(found: Any, functions: Sequence[Any], meaning: Sequence[tuple[int, str]]) -> bool:
    """Return whether an event was missed because its function changed sign twice in a step."""
    for start, stop in pairwise(found.t):
        for part in (0.25, 0.5, 0.75):
            at = start + part * (stop - start)
            y = found.sol(at)
            for gap, (i, _) in zip(functions, meaning, strict=True):
                if gap(at, y) * gap.direction > (1e-11 if i >= 0 else 1.0):
                    return True
    return False


def _fly(system: _System, out: Motion, here: float, y: Array) -> None:
    """Let all nodes follow the free flight of the striker after the end of contact."""
    nodes, speeds, _ = system.output(here, y)
    out.contact_end, out.rebound = here, -speeds[-1]
    for k in np.flatnonzero(out.time > here):
        out.displacement[:, k] = np.array(nodes) + speeds[-1] * (out.time[k] - here)
        out.velocity[:, k] = speeds[-1]
        out.base_stress[k] = 0.0


def _finish(out: Motion, chain: Any) -> Motion:
    out.strain = out.displacement[-1] / sum(chain.heights)
    for values in (out.displacement, out.velocity, out.base_stress):
        if not np.isfinite(values).all():
            raise RuntimeError("the reference has values that are not finite")
    return out


def _scale(system: _System, speed: float) -> Array:
    scale = np.ones(system.size)
    for k in system.at_node.values():
        scale[k], scale[k + 1] = sum(system.h), speed
    if system.at_top is not None:
        scale[system.at_top] = sum(system.h)
    return scale


def reference_impact(
    chain: Any, drive: Any, t: ArrayLike, rtol: float = 1e-12, steps: int = 800
) -> Motion:
    """Simulate an impact at t[0] on a chain at rest until contact ends."""
    t = np.asarray(t, float)
    system = _System(chain, float(drive.mass), "impact")
    y = np.zeros(system.size)
    y[system.at_node[system.n] + 1] = drive.velocity
    scale = _scale(system, float(drive.velocity))
    return _finish(_integrate(system, y, t, t[[0, -1]], None, scale, rtol, steps), chain)


def reference_stress(chain: Any, stress: ArrayLike, t: ArrayLike, rtol: float = 1e-12) -> Motion:
    """Simulate a stress history on top, linear between samples, starting from rest."""
    t, load = np.asarray(t, float), np.asarray(stress, float)
    system = _System(chain, 0.0, "stress")
    if system.size == 0:
        strain = np.array([lw.strain(load) for lw in system.laws])
        nodes = np.cumsum(strain * np.array(system.h)[:, None], axis=0)
        return _finish(Motion(t, nodes, nodes * 0, load.copy(), load * 0), chain)
    scale = _scale(system, sum(system.h) / (t[-1] - t[0]))
    return _finish(_integrate(system, np.zeros(system.size), t, t, load, scale, rtol, 300), chain)


def reference_displacement(
    chain: Any, displacement: ArrayLike, t: ArrayLike, rtol: float = 1e-12
) -> Motion:
    """Simulate a prescribed displacement of the top, linear between samples, starting from rest.

    The velocity jumps at samples. If a dashpot makes the base stress depend on the velocity, the
    stress at a sample is the mean of the limits from both sides (at the ends, the only limit).
    """
    t, w = np.asarray(t, float), np.asarray(displacement, float)
    system = _System(chain, 0.0, "displacement")
    if system.size == 0:
        return _finish(_quasi_static(system, w, t), chain)
    scale = _scale(system, sum(system.h) / (t[-1] - t[0]))
    return _finish(_integrate(system, np.zeros(system.size), t, t, w, scale, rtol, 300), chain)


def _quasi_static(system: _System, w: Array, t: Array) -> Motion:
    flags = ["a"] * system.n
    nodes, base = np.zeros((system.n, len(w))), np.zeros(len(w))
    for k, total in enumerate(w):
        if system.n == 1:
            eps = [total / system.h[0]]
            lw = system.laws[0]
            if isinstance(lw, BistableLaw):
                base[k] = lw.sigma(lw.branch(flags[0], eps[0]), eps[0])
            else:
                base[k] = lw.stress(eps)[0]
        else:

            def gap(s: float, total: float = total, flags: list[str] = flags) -> float:
                parts = zip(system.h, system.laws, flags, strict=True)
                return sum(h * lw.strain_at(f, s) for h, lw, f in parts) - total

            slack = [i for i, lw in enumerate(system.laws) if getattr(lw, "unilateral", False)]
            if slack and gap(0.0) > 0.0:  # longer than at rest: a gap opens and the stress is zero
                base[k] = 0.0
                eps = [lw.strain_at(f, 0.0) for lw, f in zip(system.laws, flags, strict=True)]
                open_by = gap(0.0) / sum(system.h[i] for i in slack)
                eps = [e - open_by if i in slack else e for i, e in enumerate(eps)]
            else:
                low, high = -1e3, 1e6
                while gap(high) < 0.0:
                    high *= 2.0
                while gap(low) > 0.0:
                    low *= 2.0
                base[k] = brentq(gap, low, high, xtol=1e-9, rtol=1e-14)
                eps = [lw.strain_at(f, base[k]) for lw, f in zip(system.laws, flags, strict=True)]
        flags = [lw.flag_after(f, e) for lw, f, e in zip(system.laws, flags, eps, strict=True)]
        nodes[:, k] = np.cumsum(np.array(system.h) * eps)
    return Motion(t, nodes, nodes * 0, base, w * 0)


# ------------------------------------------------------------------------------------------ energy


def energy_balance(
    chain: Any, drive: Any, displacement: ArrayLike, velocity: ArrayLike
) -> dict[str, Array]:
    """Return the energies of an undamped impact, in J, at the given samples of the motion.

    `brought` is the kinetic energy of the striker at contact and `kinetic` the kinetic energy of
    all masses. `work` is the work done on the springs: `dissipated` is the part lost in closed
    loops, `stored` the rest. During contact, `brought` = `kinetic` + `work`.
    """
    w, v = np.atleast_2d(displacement), np.atleast_2d(velocity)
    n = len(chain.springs)
    mass = np.zeros(n) if chain.masses is None else np.array(chain.masses, float)
    mass[-1] += drive.mass
    strain = np.diff(w, axis=0, prepend=0.0) / np.array(chain.heights)[:, None]
    work, lost = np.zeros(w.shape[1]), np.zeros(w.shape[1])
    for spring, h, eps in zip(chain.springs, chain.heights, strain, strict=True):
        lw = law(spring)
        work += chain.area * h * lw.work(eps)
        if isinstance(lw, BistableLaw):
            closed = np.cumsum(
                [
                    sum(p[0] == "e" and q[0] == "a" for p, q in pairwise(way))
                    for way in lw.pieces(eps)
                ]
            )
            if closed.any():
                lost += chain.area * h * lw.loop * closed
    kinetic = 0.5 * mass @ v**2
    return {
        "brought": np.full(w.shape[1], 0.5 * drive.mass * drive.velocity**2),
        "kinetic": kinetic,
        "work": work,
        "dissipated": lost,
        "stored": work - lost,
    }
