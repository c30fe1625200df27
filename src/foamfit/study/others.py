"""Other springs in series that would give the same records as a drawn foam.

Springs in series can exchange branches, and intervals of a joint fit include what follows the tests
about as well (`study.joint_fit`). What a plan expects includes it too: other springs are fitted to
the records of a drawn foam in the tests at hand and in a candidate, and then, to first order, to
those in every other candidate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array, Mask
from foamfit.data.rig import Candidate, Rig
from foamfit.errors import SimulationError
from foamfit.fitting import levenberg
from foamfit.fitting.branches import unreached
from foamfit.fitting.links import Links
from foamfit.fitting.minima import in_order
from foamfit.fitting.problem import Problem
from foamfit.fitting.together import Layout
from foamfit.springs.model import exchanges
from foamfit.study import gain
from foamfit.study.draws import Test
from foamfit.study.gain import Known, Refit, Seen, problem_for
from foamfit.trust.covariance import NOTHING, WEAK

MOST, STEPS = 8, 10  # number of other springs that are fitted to a drawn foam, and of their steps
NEAR = 60.0  # largest rise of the sum of squares, noise having a variance of 1
EXPLAINED = 3  # number of explanations that are tried besides exchanges


@dataclass(frozen=True, eq=False)
class Other:
    """Springs that nearly give the records of a drawn foam in some tests.

    `inner` (k + 1, k + 1) has the products of the slopes by scaled parameters, and of the
    differences of the residuals as a last column, without nuisance parameters.
    """

    values: Array  # of the springs
    scale: Array  # (k,), as `Known.drawn_sizes` of the foam
    inner: Array
    reached: Mask  # (k,)

    def and_in(self, known: Known, problem: Problem, residual: Array, weight: float) -> Other:
        """Return the same with one more test, in which the foam has a residual."""
        objective, values = problem.objective, known.with_springs(self.values, problem)
        shown = objective.simulate(values, everything=True)
        apart = objective.compare(shown, values) - residual
        rows = np.column_stack((gain.rows_of(problem, values, known.names, known.sizes), apart))
        rows *= gain.roots_of(problem, weight)[:, None]
        rows, never = gain.without_nuisance(rows, len(known.names) + 1), unreached(problem, shown)
        reached = self.reached | np.array([name not in never for name in known.names])
        return replace(self, inner=self.inner + rows.T @ rows, reached=reached)

    def refit(self, known: Known) -> Refit:
        """Return the springs fitted to the tests, to first order."""
        bread, gradient = self.inner[:-1, :-1], self.inner[:-1, -1]
        step = np.linalg.solve(bread + np.diag((NOTHING * self.scale) ** -2.0), gradient)
        values = self.values[known.places] / known.sizes - step
        return Refit(values, max(self.inner[-1, -1] - float(gradient @ step), 0.0), self.reached)


def others_of(
    known: Known, tests: Sequence[Test], candidate: Candidate, rig: Rig
) -> list[list[Other]]:
    """Return, for each drawn foam, springs that nearly give its records in the tests at hand.

    They are sought in the tests at hand alone, and together with a candidate.
    """
    reference = problem_for(known, candidate, rig)
    weight = candidate.weight(reference.objective.time, known.problem.measurement, rig)
    thin, out = [one.problem.thinned() for one in tests], list[list[Other]]()
    k = len(known.names)
    for drawn, scale in zip(known.draws, known.drawn_sizes, strict=True):
        own, more = [one.with_springs(drawn) for one in tests], known.with_springs(drawn, reference)
        searches = (thin, own, 1.0), ([*thin, reference], [*own, more], weight)
        residuals = [one.problem.objective.residual(x) for one, x in zip(tests, own, strict=True)]
        others = list[Other]()
        for search in searches:
            for springs in _sought(known, scale, *search):
                with suppress(SimulationError):
                    one = Other(springs, scale, np.zeros((k + 1, k + 1)), np.zeros(k, dtype=bool))
                    for test, residual in zip(tests, residuals, strict=True):
                        one = one.and_in(known, test.problem, residual, 1.0)
                    others.append(one)
        out.append(others)
    return out


def _sought(
    known: Known, scale: Array, problems: Sequence[Problem], drawn: Sequence[Array], weight: float
) -> list[Array]:
    """Return springs that nearly give the records of drawn ones in some tests, nearest first.

    Each differs in another parameter. The last test has samples of some `weight`.
    """
    layout = Layout.of(tuple(problems), Links(dict.fromkeys(known.names, "shared")))
    weights = [*[1.0] * (len(problems) - 1), weight]
    weigh = np.concatenate(list(map(gain.roots_of, problems, weights)))
    begin = layout.start(drawn)
    target, count = layout.residual(begin), len(known.problem.model.names)

    def residual(point: Array) -> Array:
        return weigh * (layout.residual(point) - target)

    def jacobian(point: Array) -> Array:
        return np.asarray(weigh[:, None] * layout.jacobian(point).toarray())

    assert known.explained is not None
    springs = [*known.explained[:EXPLAINED], *exchanges(known.problem.model, drawn[0][:count])]
    points = [layout.start([np.append(one, own[count:]) for own in drawn]) for one in springs]
    tangent = np.linalg.qr(jacobian(begin))[0]
    left = list[tuple[float, int]]()  # what a fit would leave, to first order
    for i, apart in enumerate(map(residual, points)):
        if np.all(np.isfinite(apart)):
            left.append((float(np.sum(apart**2) - np.sum((tangent.T @ apart) ** 2)), i))
    ends = [
        levenberg.descend(residual, jacobian, points[i], layout.box, STEPS, enough=1e-2)
        for _, i in sorted(left)[:MOST]
    ]
    out, covered = list[Array](), np.zeros(len(known.names), dtype=bool)
    first, places = problems[0], known.places
    for end in sorted(ends, key=lambda one: one.cost):
        values = layout.terms[0].values(end.point)
        found = in_order(first.space(), first.objective, values)[:count]
        far = np.abs(found - drawn[0][:count])[places] > 0.5 * WEAK * known.sizes * scale
        if end.cost <= NEAR and (far & ~covered).any():
            covered |= far
            out.append(found)
    return out


def with_others(
    known: Known, others: Sequence[Sequence[Other]], candidate: Candidate, seen: Seen, rig: Rig
) -> Seen:
    """Return what a candidate shows with the springs that would follow it as well."""
    problem = problem_for(known, candidate, rig)
    weight = candidate.weight(problem.objective.time, known.problem.measurement, rig)
    out = list[tuple[Refit, ...]]()
    for drawn, each, broken in zip(known.draws, others, seen.broken, strict=True):
        found = list[Refit]()
        if each and not broken:
            residual = problem.objective.residual(known.with_springs(drawn, problem))
            for one in each:
                try:
                    found.append(one.and_in(known, problem, residual, weight).refit(known))
                except SimulationError:  # which these springs would not follow
                    found.append(one.refit(known)._replace(rise=math.inf))
        out.append(tuple(found))
    return replace(seen, others=tuple(out))
