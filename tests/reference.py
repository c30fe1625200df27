"""Independent laws of the springs, and derivatives by differences.

Nothing here uses the package: of springs only the parameters are read. Derived points are those of
the judge of the stability study, which finds them by bracketing.
"""

import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

import independent as judge

Array = NDArray[np.float64]

BRANCHES = "adce"
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
        self.eps_a, self.eps_c = float(spring.eps_a), float(spring.eps_c)
        self.points = points = judge.bistable_row(spring, 1.0)
        self.sigma_a, self.sigma_c = points[judge.SIG_A], points[judge.SIG_C]
        self.eps_star = points[judge.STAR]
        self.limit, self.eps_hat_c = 1.0 + self.eps_star, points[judge.HAT_C]
        self.sigma_hat_c = self.sigma("d", self.eps_hat_c)
        self.eps_hat_a = points[judge.HAT_A] if np.isfinite(points[judge.HAT_A]) else None

    def sigma(self, branch: str, eps: float) -> float:
        return float(judge.pressed.py_func(self.points, BRANCHES.index(branch), eps)[0])

    def end(self, branch: str, sense: int) -> tuple[float, str]:
        """Return the end of a branch in a direction of the strain, and the next branch."""
        low, high, under, over = judge.bounds.py_func(self.points, BRANCHES.index(branch))
        return (high, BRANCHES[over]) if sense > 0 else (low, BRANCHES[under])

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
                stop, following = self.end(branch, sense)
                if (there - stop) * sense <= 0.0:
                    stop, following = there, branch
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


# ------------------------------------------------------------------------------ microscale springs


class Microscale:
    """Section 8 of docs/theory.md, with ranks w and W in place of p and P: 1 - P is accurate.

    The state is updated in small steps, the strain is explicit, and the stress at a strain is found
    by bracketing.
    """

    def __init__(self, spring: Any) -> None:
        self.spring, self.s, self.w, self.most = spring, 0.0, -math.inf, -math.inf

    def moved(self, s: float) -> tuple[float, float]:
        p, first, back = self.spring, -math.inf, -math.inf
        if s > 0.0:
            first = math.log(s / p.sigma_plus) / p.spread_plus
            back = math.log(s / p.sigma_minus) / p.spread_minus
        least = max(first, min(first + p.weakening / p.spread_plus, self.most))
        w = min(max(self.w, least), max(least, back))
        return w, max(self.most, w)

    def on_a(self, s: float, k: float) -> float:
        n = self.spring.stiffening
        return -math.expm1(-math.log1p(n * s / k) / n) if n * s > -k else -math.inf

    def strain(self, s: float) -> float:
        p, (w, most) = self.spring, self.moved(s)
        never, once, snapped = ndtr(-most), ndtr(-w) - ndtr(-most), ndtr(w)
        strain = never * self.on_a(s, p.k0)
        if once > 0.0:
            strain += once * self.on_a(s, p.k0 * math.exp(-p.softening))
        return strain + snapped * (p.eps_star + s / (p.kc + s)) if snapped > 0.0 else strain

    def stress(self, strain: float) -> float:
        low, high = 0.0, self.spring.k0
        if self.strain(0.0) > strain:  # in tension
            low, high = -1e-9 * high, 0.0
            while self.strain(low) > strain:
                low *= 2.0
        else:
            while self.strain(high) < strain:
                high *= 2.0
            near = high
            while near > 1e-280 and self.strain(near) > strain:  # bracket small roots closely
                near *= 1e-3
            low = near if self.strain(near) <= strain else 0.0
        if self.strain(low) == strain:
            return low
        return float(
            brentq(
                lambda s: max(self.strain(s) - strain, -1e300), low, high,
                xtol=1e-300, rtol=9e-16, maxiter=1000,
            )
        )  # fmt: skip

    def keep(self, s: float) -> None:
        for part in np.linspace(self.s, s, 5)[1:]:
            self.w, self.most = self.moved(float(part))
        self.s = s

    @classmethod
    def along(cls, spring: Any, given: ArrayLike, what: str) -> Array:
        """Return the "stress" at each strain of a history, or the "strain" at each stress."""
        one, out = cls(spring), []
        for value in np.asarray(given, float):
            out.append(getattr(one, what)(value))
            one.keep(out[-1] if what == "stress" else value)
        return np.array(out)


@cache
def law(spring: Any) -> Any:
    """Return the law of any object that has the attributes of a spring."""
    return BistableLaw(spring) if hasattr(spring, "kc") else LinearLaw(spring)


# ----------------------------------------------------------------------------------- derivatives


def differences(run: Callable[[float], Any], step: float, order: int = 4) -> tuple[Array, Array]:
    """Return derivatives of displacement and base stress by central differences of order 2 or 4.

    `run` takes the change of a value.
    """
    weights = {2: (1 / 2,), 4: (2 / 3, -1 / 12)}[order]
    sides = [(run(k * step), run(-k * step)) for k in range(1, len(weights) + 1)]
    moved, stress = (
        sum(
            weight * (getattr(up, what) - getattr(down, what)) / step
            for weight, (up, down) in zip(weights, sides, strict=True)
        )
        for what in ("displacement", "base_stress")
    )
    return moved, stress
