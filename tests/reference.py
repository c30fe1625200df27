"""An independent law of the bistable and the linear spring.

Nothing here uses the package: of springs only the parameters are read. Derived points are those of
the judge of the stability study, which finds them by bracketing.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from independent import HAT_A, HAT_C, SIG_A, SIG_C, STAR, bistable_row

Array = NDArray[np.float64]

_QUADRATURE = np.polynomial.legendre.leggauss(24)


class LinearLaw:
    """A linear spring, which may carry no tension."""

    def __init__(self, spring: Any) -> None:
        self.k0 = float(spring.k0)
        self.unilateral = bool(spring.unilateral)

    def strain_at(self, flag: str, sigma: float) -> float:
        return max(sigma, 0.0) / self.k0 if self.unilateral else sigma / self.k0

    def strain(self, history: ArrayLike) -> Array:
        return np.array([self.strain_at("", s) for s in np.asarray(history, float)])

    def work(self, history: ArrayLike) -> Array:
        eps = np.asarray(history, float)
        return 0.5 * self.k0 * (np.maximum(eps, 0.0) if self.unilateral else eps) ** 2


class BistableLaw:
    """The seven-parameter law, branch by branch."""

    def __init__(self, spring: Any) -> None:
        self.k0, self.kc = float(spring.k0), float(spring.kc)
        self.eps_a, self.eps_c = float(spring.eps_a), float(spring.eps_c)
        self.kh_plus, self.kh_minus = float(spring.kh_plus), float(spring.kh_minus)
        points = bistable_row(spring, 1.0)
        self.sigma_a, self.sigma_c, self.eps_star = points[SIG_A], points[SIG_C], points[STAR]
        self.limit, self.eps_hat_c = 1.0 + self.eps_star, points[HAT_C]
        self.sigma_hat_c = self.sigma("d", self.eps_hat_c)
        self.eps_hat_a = points[HAT_A] if np.isfinite(points[HAT_A]) else None

    def sigma(self, branch: str, eps: float) -> float:
        if branch == "a":
            return self.k0 * eps / (1 - eps)
        if branch == "d":
            return self.sigma_a + self.kh_plus * (eps - self.eps_a)
        if branch == "c":
            return self.kc * (eps - self.eps_star) / (1 - (eps - self.eps_star))
        return self.sigma_c + self.kh_minus * (eps - self.eps_c)

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
        ends = low, self.limit - room
        return float(brentq(gap, *ends, xtol=1e-17, rtol=4 * np.finfo(float).eps, maxiter=500))

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
