"""The best point of one test or several: curves, residual, Jacobian and covariance.

All that is concluded from a fit reads this: one plain simulation and one with sensitivities. The
unknowns of several tests are what all have in common, then the own parameters of each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.fitting.branches import unreached
from foamfit.fitting.links import LOG_RATE, RATES, factor
from foamfit.fitting.objective import Simulated
from foamfit.fitting.problem import Problem
from foamfit.fitting.together import Together
from foamfit.trust import covariance
from foamfit.trust.covariance import Block, Covariance, Uncertainty
from foamfit.trust.residuals.law_error import CurveError, curve_errors
from foamfit.trust.residuals.noise_process import basis_of

# Share of the residuals along a direction that a cycle takes at most, so that it is not all.
MOST_TAKEN = 0.99


@dataclass(frozen=True, eq=False)
class BestPoint:
    """A point of the parameters (SI), usually the best one, and what holds locally there.

    `chosen` are the parameters whose uncertainty is wanted; by default those that vary and
    whose branch was reached.
    """

    problem: Problem
    values: Array
    chosen: tuple[str, ...] | None = None

    @cached_property
    def simulated(self) -> Simulated:
        """All curves."""
        return self.problem.objective.simulate(self.values, everything=True)

    @cached_property
    def residual(self) -> Array:
        """Residual of curves and priors."""
        return self.problem.objective.compare(self.simulated, self.values)

    @cached_property
    def cost(self) -> float:
        """Sum of squares of the residual."""
        return float(self.residual @ self.residual)

    @cached_property
    def unreached(self) -> dict[str, str]:
        """Parameters whose branch was never reached, and that branch."""
        return unreached(self.problem, self.simulated)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the k parameters whose uncertainty is wanted."""
        if self.chosen is not None:
            return self.chosen
        return tuple(name for name in self.problem.free() if name not in self.unreached)

    @property
    def index(self) -> dict[str, int]:
        """Place of each parameter in `values`."""
        return self.problem.index

    @cached_property
    def places(self) -> NDArray[np.intp]:
        """Places of the k parameters in `values`."""
        return np.array([self.index[name] for name in self.names], dtype=np.intp)

    @cached_property
    def sizes(self) -> Array:
        """Their characteristic sizes, (k,)."""
        return self.problem.sizes(self.names, self.values)

    def limits(self, name: str) -> tuple[float, float]:
        """Limits of a parameter, SI."""
        parameter = self.problem.params[name]
        return float(parameter.min), float(parameter.max)

    @cached_property
    def box(self) -> Array:
        """Lower and upper limits of the k parameters, SI, (2, k)."""
        return np.reshape([self.limits(name) for name in self.names], (-1, 2)).T

    @cached_property
    def jacobian(self) -> Array:
        """Derivative of `residual` by them, (n_data, k)."""
        return self.problem.slopes(self.values, self.names)

    @cached_property
    def errors(self) -> tuple[CurveError, ...]:
        """Whether the residual of each counted curve is noise, or holds an error of the law too."""
        return curve_errors(*self.to_judge())

    @cached_property
    def scaled(self) -> Array:
        """Jacobian by the scaled parameters, (n_data, k)."""
        return np.asarray(self.jacobian * self.sizes)

    def to_judge(self, taken: Array | None = None) -> tuple[Any, ...]:
        """What `curve_errors` takes; `taken` is what a joint fit took of the noise."""
        objective = self.problem.objective
        return self.residual, self.scaled, objective.sizes, taken, objective.drive == "stress"

    @property
    def misfits(self) -> bool:
        """Whether the law misses more of some curve than its noise."""
        return any(error.found for error in self.errors)

    def block(self, errors: Sequence[CurveError]) -> Block:
        """Its part in a covariance, by the errors of its curves."""
        return Block(
            self.scaled,
            self.residual,
            self.problem.objective.sizes,
            [error.noise for error in errors],
            np.eye(len(self.names)),
            self.gradient if any(error.found for error in errors) else None,
            (np.abs(self.box - self.values[self.places]) / self.sizes).T,
        )

    def gradient(self, places: NDArray[np.intp], step: Array) -> Array:
        """Half the gradient of the cost by some of the parameters, all scaled, at a step of them.

        The step ends at their limits.
        """
        at, sizes, (low, high) = self.places[places], self.sizes[places], self.box[:, places]
        values = self.values.copy()
        values[at] = np.clip(values[at] + step * sizes, low, high)
        slopes = self.problem.slopes(values, tuple(self.names[i] for i in places)) * sizes
        return np.asarray(slopes.T @ self.problem.objective.residual(values))

    @cached_property
    def spread(self) -> Covariance:
        """Their local covariance."""
        return Uncertainty((self.block(self.errors),), self.sizes).covariance

    @cached_property
    def quantiles(self) -> Array:
        """Student's t of the 95 % interval of each parameter, (k,)."""
        return np.array([covariance.half_width(1.0, freedom) for freedom in self.spread.freedom])

    @cached_property
    def halves(self) -> Array:
        """Half of each local 95 % interval, (k,)."""
        return self.quantiles * self.spread.stderr

    @cached_property
    def known(self) -> list[str]:
        """Parameters that the local interval does not leave undetermined."""
        known = np.flatnonzero(self.halves <= covariance.NOTHING * self.sizes)
        return [self.names[i] for i in known]

    def rises(self, residual: Array) -> Array:
        """Rise of the cost at another point, from its residual, as χ² of each, (k,)."""
        return np.asarray((float(residual @ residual) - self.cost) / self.spread.inflation)


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
        return tuple(map(BestPoint, self.found.problems, self.found.values))

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
        out, shared = list[float](), set(self.found.shared)
        for name in self.names:
            shows = [b for b in self.bests if name in shared and name in b.problem.free()]
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

    def of_common(self, name: str) -> tuple[float, float]:
        """Standard error and degrees of freedom of what is in `names`; NaN of anything else."""
        row = np.zeros(self._scales.size)
        row[[i for i, one in enumerate(self.names) if one == name]] = 1.0
        return self._known(row)

    def of_test(self, test: int, name: str) -> tuple[float, float]:
        """Standard error and degrees of freedom of a parameter of one test; NaN if unreached."""
        best = self.bests[test]
        if name not in best.names:
            return float("nan"), 1.0
        i = best.names.index(name)
        return self._known(self.uncertainty.blocks[test].through[i] * best.sizes[i] / self._scales)

    def _known(self, row: Array) -> tuple[float, float]:
        """Standard error and degrees of freedom of a sum of unknowns; NaN of none."""
        if not (at := np.flatnonzero(row)).size:
            return float("nan"), 1.0
        covariance = self.uncertainty.covariance
        variance = row[at] @ covariance.matrix[np.ix_(at, at)] @ row[at]
        return float(np.sqrt(variance)), float(covariance.freedom[at[0]])

    def reach(self, name: str) -> float:
        """How far a shared value is off where the cost has risen by one; 0 where it is unseen."""
        at, known = self.names.index(name), self.uncertainty
        off = 0.0 if known.lost[at] else math.sqrt(known.inverse[at, at])
        return off * float(self._scales[at])

    def moved(self, name: str, change: float) -> list[Array]:
        """Values of each test with a shared one moved, and the others after it, were all linear."""
        at, out = self.names.index(name), list[Array]()
        along = self.uncertainty.inverse[:, at]
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
        left = self.uncertainty.lefts[test]
        share, axes = np.linalg.eigh(left @ left.T)
        own = self.uncertainty.blocks[test].axes[0]
        return np.asarray((own @ axes) * np.sqrt(np.clip(share, 0.0, 1.0)))

    @cached_property
    def _undrawn(self) -> tuple[Array, Array]:
        """Covariance and inverse curvature of the unknowns, whatever draws them, SI, (m, m)."""
        known = self.uncertainty
        held = known.held if known.errs else np.zeros(self._scales.size, dtype=bool)
        alone = replace(known.bent if known.errs else known, drawn=None)
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


def cycle_growth(best: BestPoint) -> float | None:
    """`growth` from the last fitted cycle to the next; None where there are not several cycles."""
    objective, spans = best.problem.objective, cycles_of(best.problem.measurement)
    if len(spans) < 2 or not best.names:
        return None
    last = spans[max(spans)]
    kept = np.concatenate([objective.kept(name) for name in objective.counted])
    return growth(
        best.jacobian, best.residual, np.flatnonzero((kept >= last.start) & (kept < last.stop))
    )


def growth(jacobian: Array, residual: Array, rows: NDArray[np.intp]) -> float:
    """Mean square of what a law misses of a new cycle over that of a fitted one, less one.

    The fitted cycle has the samples `rows` and the part H of the hat matrix. Errors that differ
    from cycle to cycle leave residuals r of covariance I - H in it, and of I + H in a new one like
    it: r'(I + H)(I - H)⁻¹r there for r'r here. (To leave the fitted cycle out would tell more,
    (I - H)⁻¹r, as one cycle fewer is fitted then.)
    """
    onto, share, _ = np.linalg.svd(basis_of(jacobian)[rows], full_matrices=False)
    hat, left = np.minimum(share**2, MOST_TAKEN), residual[rows]
    return float(2.0 * hat / (1.0 - hat) @ (onto.T @ left) ** 2 / max(left @ left, 1e-300))
