"""Local identifiability of the parameters: sensitivities, information, directions.

All quantities are evaluated at one point, usually the best one. Sensitivities are in standard
deviations of the noise per relative change of a parameter (over its scale,
`fitting.box.Scales.of_parameter`), so that parameters and curves can be compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.nuisance import POSITIVE
from foamfit.springs.parameters import NUISANCE
from foamfit.text import listed
from foamfit.trust import say
from foamfit.trust.best_point import BestPoint, sections
from foamfit.trust.covariance import scale_in_words

PART = 0.05  # smallest component of a direction that counts
NAMED = 0.3  # smallest component, relative to the largest, that is named in a sentence
MOST = 3  # largest number of parameters named in a joint change
# Times and zeros have an arbitrary origin, so that powers of them are meaningless.
OF_NO_POWER = set(NUISANCE) - set(POSITIVE)


@dataclass(frozen=True, eq=False)
class Insight:
    """Sensitivities of all fitted curves to the parameters whose branch was reached."""

    names: tuple[str, ...]  # (k,): parameters that vary and whose branch was reached
    values: Array  # (k,), SI
    sizes: Array  # (k,): scales of the parameters, SI
    parts: tuple[tuple[str, str], ...]  # curve, and branches of the springs along a part of it
    # (n_parts, k, k): triangles R of QR factorizations of the sensitivities along each part; RᵀR
    # contains all their information.
    triangles: Array
    silent: tuple[str, ...] = ()  # parameters that vary but whose branch was never reached

    @cached_property
    def _directions(self) -> tuple[Array, Array]:
        """Standard errors along the principal directions (k,), and these as rows, weakest last."""
        k = len(self.names)
        triangle = np.linalg.qr(self.triangles.reshape(-1, k), mode="r")
        _, singular, vt = np.linalg.svd(triangle, full_matrices=True)
        tiny = 1e-12 * max(float(singular.max(initial=0.0)), 1e-300)
        with np.errstate(divide="ignore"):  # infinite where the curves do not depend on a direction
            return np.where(singular > tiny, 1.0 / singular, np.inf), vt

    def shares(self) -> Array:
        """Return the share (k, n_parts) of each of the `parts` in the information on a parameter.

        The information on a parameter, with all others free, is the sum of squares of its column of
        sensitivities after the other columns are projected out (Frisch and Waugh 1933, Econometrica
        1, 387). As a sum over samples it can be divided among the parts. Each row adds up to one;
        it is NaN for an undetermined parameter.
        """
        k = len(self.names)
        # The rows of the pseudo-inverse are the projected columns, up to a factor.
        projected = np.linalg.pinv(self.triangles.reshape(-1, k), rcond=1e-12)
        shares = np.sum(projected.reshape(k, -1, k) ** 2, axis=2)
        errors, vt = self._directions
        shares[np.any(np.abs(vt[np.isinf(errors)]) > 1e-3, axis=0)] = np.nan
        with np.errstate(invalid="ignore"):
            return np.asarray(shares / shares.sum(axis=1, keepdims=True))

    def weakest(self) -> tuple[float, dict[str, float]]:
        """Return the error along the weakest direction, and its components over the largest."""
        errors, vt = self._directions
        direction = vt[-1] / vt[-1][np.argmax(np.abs(vt[-1]))]
        order = np.argsort(-np.abs(direction), kind="stable")
        named = {self.names[i]: float(direction[i]) for i in order if abs(direction[i]) >= NAMED}
        return float(errors[-1]), named

    def sentence(self) -> str:
        """Name the least determined direction."""
        error, parts = self.weakest()
        joint, scale = listed(f"{name} ({part:+.2g})" for name, part in parts.items()), ""
        if len(parts) == 1:
            (joint,) = parts
            at = self.names.index(joint)
            scale = scale_in_words(joint, self.values[at], self.sizes[at])
        names = joint.replace("-", "−")
        return say("least", "told", names=names, error=error, scale=scale, silent=self.silent)

    def combination(self, name: str, loose: float) -> str:
        """Describe what the data fix instead of a parameter; "" if it is undetermined by itself.

        Directions with a relative standard error above `loose` count as free. A single fixed
        combination is given as a product of powers, exact to first order; otherwise the parameters
        that compensate a change are named.
        """
        from scipy.sparse.csgraph import connected_components

        errors, vt = self._directions
        free, me = vt[errors > loose], self.names.index(name)
        movable = np.linalg.norm(free, axis=0) > 2.0 * PART
        linked = (np.abs(free.T @ free) > PART) & np.outer(movable, movable)
        _, groups = connected_components(linked)
        group = np.flatnonzero(groups == groups[me])
        if len(group) < 2:
            return ""
        left, singular, _ = np.linalg.svd(free[:, group].T, full_matrices=True)
        names, moving = [self.names[i] for i in group], int(np.sum(singular > NAMED))
        if moving == len(group):
            return say("why", "nothing", names=listed(names))
        counted = set(names) & OF_NO_POWER or not np.all(self.values[group] != 0.0)
        if moving == len(group) - 1 and not counted:
            # d ln|p| = (size/p) dx, so exponents are the weights of x times p/size.
            powers = left[:, -1] * (self.values / self.sizes)[group]
            return say("why", "product", product=_product(names, powers))
        change = (free[:, me] * np.minimum(errors[errors > loose], 1e6) ** 2) @ free
        change = change / change[me]
        change[me] = 0.0
        order = np.argsort(-np.abs(change), kind="stable")
        large = [i for i in order if abs(change[i]) > NAMED * abs(change[order[0]])]
        parts = [(self.names[i], change[i]) for i in large]
        return say("why", "compensated", most=MOST, parts=parts)


def look(best: BestPoint) -> Insight:
    """Compute the sensitivities at a point of the parameters, usually the best one.

    The unit is one standard deviation of the noise of each curve, times the root of its
    autocorrelation time.
    """
    problem, objective, k = best.problem, best.problem.objective, len(best.names)
    labels = np.array(sections(problem, best.simulated))
    parts, triangles = list[tuple[str, str]](), list[Array]()
    pairs = zip(objective.by_curve(best.scaled).items(), best.errors, strict=True)
    for (curve, slopes), error in pairs:
        rows = slopes / math.sqrt(max(error.noise.variance * error.noise.tau, 1e-300))
        for label in dict.fromkeys(labels.tolist()):
            triangle = np.linalg.qr(rows[labels[objective.kept[curve]] == label], mode="r")
            parts.append((curve, label))
            triangles.append(np.pad(triangle, ((0, k - len(triangle)), (0, 0))))
    return Insight(
        names=best.names,
        values=best.values[best.places],
        sizes=best.sizes,
        parts=tuple(parts),
        triangles=np.array(triangles),
        silent=tuple(name for name in problem.free() if name in best.unreached),
    )


def _product(names: list[str], powers: Array) -> str:
    """Write Π p_i^e_i with the largest power 1: "s2_k0·s1_k0^0.43/s1_height^0.57"."""
    order = np.argsort(-np.round(np.abs(powers), 6), kind="stable")  # make ties reproducible
    powers = powers / powers[order[0]]
    sides: dict[bool, list[str]] = {True: [], False: []}
    for name, power in ((names[i], powers[i]) for i in order):
        shown = f"{abs(power):.2f}".rstrip("0").rstrip(".")
        if abs(power) >= PART:
            sides[bool(power > 0.0)].append(name if shown == "1" else f"{name}^{shown}")
    above, below = ("·".join(sides[side]) for side in (True, False))
    below = f"({below})" if len(sides[False]) > 1 else below
    return f"{above}/{below}" if below else above
