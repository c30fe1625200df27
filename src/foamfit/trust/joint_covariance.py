"""How sure the parameters of a joint fit are: the covariance of several tests.

The unknowns are what all tests have in common, then the own parameters of each test; the sandwich
is that of a single test (`trust.covariance`), with a block for each test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.links import LOG_RATE, RATES, factor
from foamfit.fitting.together import Together
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import Block, Covariance, Frame, Uncertainty
from foamfit.trust.residuals.law_error import CurveError


@dataclass(frozen=True, eq=False)
class JointPoint:
    """The best point of a joint fit, and what holds locally there.

    `errors` are those of the curves of each test (`BestPoint.errors`), `inflations` (n,) of each
    scattering parameter its variance over that of white noise, by which the weight that draws it to
    the common value is larger than its spread says.
    """

    found: Together
    errors: tuple[tuple[CurveError, ...], ...] = ()
    inflations: Mapping[str, Array] = field(default_factory=dict)

    @cached_property
    def bests(self) -> tuple[BestPoint, ...]:
        """The best point of each test."""
        pairs = zip(self.found.problems, self.found.values, strict=True)
        return tuple(BestPoint(problem, values) for problem, values in pairs)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of what all tests have in common, the first of the unknowns.

        A shared parameter itself, with ":b" the slope of a law of rate, and the logarithm of the
        common value of what scatters.
        """
        out, links = list[str](), self.found.links
        for name in self.found.shared:
            out += [name, f"{name}:b"] if links.kind(name) in RATES else [name]
        return (*out, *(name for name in self.found.own if links.kind(name) == "scatter"))

    @cached_property
    def _own(self) -> list[dict[str, int]]:
        """Place of each own parameter of each test among the unknowns."""
        count, out = len(self.names), list[dict[str, int]]()
        for best in self.bests:
            mine = [name for name in best.names if name in self.found.own]
            out.append({name: count + i for i, name in enumerate(mine)})
            count += len(mine)
        return out

    @cached_property
    def _scales(self) -> Array:
        """Scales of the unknowns; 1 of a slope, or a logarithm."""
        out = list[float]()
        for name in self.names:
            shows = [
                b for b in self.bests if name in self.found.shared and name in b.problem.free()
            ]
            out += shows[0].problem.sizes((name,), shows[0].values).tolist() if shows else [1.0]
        for best, own in zip(self.bests, self._own, strict=True):
            out += [best.sizes[best.names.index(name)] for name in own]
        return np.array(out)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """What the noise leaves uncertain of all unknowns."""
        bend = np.zeros((self._scales.size,) * 2)
        blocks = tuple(self._block(t, bend) for t in range(len(self.bests)))
        return Uncertainty(blocks, self._scales, self._drawn(), bend)

    def _block(self, t: int, bend: Array) -> Block:
        """One test; what laws of rate add to the curvature of its cost is added to `bend`."""
        best, links, scales = self.bests[t], self.found.links, self._scales
        block = best.block(self.errors[t] if self.errors else ())
        through = np.zeros((len(best.names), scales.size))
        given, room = np.zeros(len(best.names)), np.array(block.room)
        pull = block.jacobian.T @ block.residual
        for i, name in enumerate(best.names):
            kind, at = links.kind(name), self._own[t].get(name)
            if at is not None:
                through[i, at] = 1.0
            elif kind in RATES:
                at, (v, b) = self.names.index(name), self.found.common[name]
                f, slope, second = factor(kind, b, links.x(t))
                two = slice(at, at + 2)
                through[i, two] = np.array([f, v * slope]) * scales[two] / best.sizes[i]
                bends = np.array([[0.0, slope], [slope, v * second]])
                bends *= np.outer(scales[two], scales[two])
                bend[two, two] += pull[i] / best.sizes[i] * bends
                if links.rate_errors is not None:
                    given[i] = b * v * (1.0 if kind == LOG_RATE else f) / best.sizes[i]
                    given[i] *= links.rate_errors[t]
            else:
                at = self.names.index(name)
                through[i, at] = scales[at] / best.sizes[i]
            if kind not in ("own", "shared"):
                room[i] = np.inf
        return replace(block, through=through, given=given, room=room)

    def _drawn(self) -> tuple[Array, Array] | None:
        """Slopes of the residuals of what is drawn to a common value, and their variances."""
        rows, variances = list[Array](), list[float]()
        for name, pulls in self.found.links.pulls.items():
            for t, (best, own) in enumerate(zip(self.bests, self._own, strict=True)):
                if name not in own or name not in self.names:
                    continue
                row, value = np.zeros(self._scales.size), float(best.values[best.index[name]])
                row[own[name]] = self._scales[own[name]] / value if value else 0.0
                row[self.names.index(name)] = -1.0
                rows.append(row * pulls[t])
                variances.append(float(self.inflations[name][t]) if self.inflations else 1.0)
        return (np.array(rows), np.array(variances)) if rows else None

    @property
    def errs(self) -> bool:
        """Whether the law misses more of some test than noise."""
        return self.uncertainty.errs

    # ------------------------------------------------------------------ what is known of each

    @property
    def covariance(self) -> Covariance:
        """Covariance of all unknowns, SI."""
        return self.uncertainty.covariance

    def of_common(self, name: str) -> tuple[float, float]:
        """Standard error and degrees of freedom of what is in `names`; NaN of anything else."""
        if name not in self.names:
            return float("nan"), 1.0
        at = self.names.index(name)
        return float(self.covariance.stderr[at]), float(self.covariance.freedom[at])

    def of_test(self, test: int, name: str) -> tuple[float, float]:
        """Standard error and degrees of freedom of a parameter of one test; NaN if unreached."""
        best, covariance = self.bests[test], self.covariance
        if name not in best.names:
            return float("nan"), 1.0
        i = best.names.index(name)
        row = self.uncertainty.blocks[test].through[i] * best.sizes[i] / self._scales
        at = np.flatnonzero(row)
        if not at.size:
            return float("nan"), 1.0
        variance = row[at] @ covariance.matrix[np.ix_(at, at)] @ row[at]
        return float(np.sqrt(variance)), float(covariance.freedom[at[0]])

    # ------------------------------------------------------------------ were all linear

    def reach(self, name: str) -> float:
        """How far a shared value is off where the cost has risen by one; 0 where it is unseen."""
        at, plain = self.names.index(name), self.uncertainty.plain
        return (
            0.0
            if plain.frame.lost[at]
            else float(np.sqrt(plain.inverse[at, at]) * self._scales[at])
        )

    def moved(self, name: str, change: float) -> list[Array]:
        """Values of each test with a shared one moved, and the others after it, were all linear."""
        at, out = self.names.index(name), list[Array]()
        along = self.uncertainty.plain.inverse[:, at]
        step = change / self._scales[at] * along / along[at]
        for block, best in zip(self.uncertainty.blocks, self.bests, strict=True):
            values = best.values.copy()
            for one, by in zip(best.names, block.through @ step * best.sizes, strict=True):
                low, high = best.limits(one)
                values[best.index[one]] = np.clip(values[best.index[one]] + by, low, high)
            out.append(values)
        return out

    def taken(self, test: int) -> Array:
        """What the joint fit took of the noise of a test; see `noise_processes`.

        Along a direction that several tests determine it took a share of each one's noise only.
        """
        left = self.uncertainty.plain.frame.lefts[test]
        share, axes = np.linalg.eigh(left @ left.T)
        own = self.uncertainty.blocks[test].axes[0]
        return np.asarray((own @ axes) * np.sqrt(np.clip(share, 0.0, 1.0)))

    # ------------------------------------------------------------------ as the data alone have it

    @cached_property
    def _undrawn(self) -> tuple[Array, Array]:
        """Covariance and inverse curvature of the unknowns, whatever draws them, SI, (m, m)."""
        held = self.uncertainty.held if self.errs else np.zeros(self._scales.size, dtype=bool)
        alone = self.uncertainty.bent if self.errs else self.uncertainty.plain
        if alone.frame.drawn is not None:
            alone = replace(alone, frame=Frame(alone.frame.blocks))
        free = np.ix_(~held, ~held)
        matrix, inverse = np.full((2, held.size, held.size), np.nan)
        matrix[free], inverse[free] = alone.matrix, alone.inverse
        scales = np.outer(self._scales, self._scales)
        return matrix * scales, inverse * scales

    def own_errors(self, test: int, names: Sequence[str]) -> Array:
        """Covariance of some own parameters of a test as the data alone have it, SI, (k, k).

        Zero where the test says nothing of them.
        """
        out, own = np.zeros((len(names), len(names))), self._own[test]
        here = [i for i, name in enumerate(names) if name in own]
        places = [own[names[i]] for i in here]
        out[np.ix_(here, here)] = np.nan_to_num(self._undrawn[0][np.ix_(places, places)])
        return out

    def of_logarithms(self, name: str) -> tuple[Array, Array]:
        """Covariance of the logarithms of a parameter in all tests that have it of its own, (n, n).

        As the data alone have it, whatever draws it to a common value; then the inverse curvature.
        NaN where a test says nothing of it.
        """
        sizes = np.abs(self.found.value(name))
        there = [t for t, own in enumerate(self._own) if name in own and sizes[t] > 0.0]
        places = [self._own[t][name] for t in there]
        out = np.full((2, len(self.bests), len(self.bests)), np.nan)
        for whole, found in zip(out, self._undrawn, strict=True):
            inner = found[np.ix_(places, places)]
            whole[np.ix_(there, there)] = inner / np.outer(sizes[there], sizes[there])
        return out[0], out[1]
