"""An independent law of the bistable and the linear spring, and the energies of an impact.

Nothing here uses the package: of springs and chains only the parameters are read. Derived points
are roots of the branch functions, found by bracketing.
"""

from collections.abc import Callable, Iterator
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

Array = NDArray[np.float64]

_QUADRATURE = np.polynomial.legendre.leggauss(24)


def root(function: Callable[[float], float], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-17, rtol=4 * np.finfo(float).eps, maxiter=500))


# --------------------------------------------------------------------------- the law of one spring


class LinearLaw:
    """A linear spring, which may carry no tension."""

    def __init__(self, spring: Any) -> None:
        self.k0 = float(spring.k0)
        self.unilateral = bool(spring.unilateral)

    def strain_at(self, flag: str, sigma: float) -> float:
        return max(sigma, 0.0) / self.k0 if self.unilateral else sigma / self.k0

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
    mass = np.array(chain.masses, float)
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
