"""Other springs in series that would give the same records as a drawn foam.

Springs in series can exchange branches, and intervals of a joint fit include what follows the tests
about as well (`study.joint_fit`). What a plan expects includes it too: other springs are fitted to
the records of a drawn foam in the tests at hand and in a candidate, and then, to first order, to
those in every other candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from foamfit.arrays import Array
from foamfit.data.rig import Candidate, Rig
from foamfit.fitting import levenberg
from foamfit.fitting.together import Layout, Links
from foamfit.springs.model import exchanges
from foamfit.study import gain
from foamfit.study.gain import Known, Other, Test
from foamfit.trust.covariance import WEAK
from foamfit.trust.settle import in_order

MOST, STEPS = 8, 10  # number of other springs that are fitted to a drawn foam, and of their steps
NEAR = 60.0  # largest rise of the sum of squares, noise having a variance of 1
EXPLAINED = 3  # number of explanations that are tried besides exchanges


def with_others(known: Known, tests: Sequence[Test], candidate: Candidate, rig: Rig) -> Known:
    """Return the same with springs that nearly give the records of each drawn foam.

    They are sought in these tests and a candidate, among the explanations of the tests and springs
    that have exchanged branches.
    """
    thin = [replace(one, problem=one.problem.thinned()) for one in tests]
    search, out = [*thin, gain.as_test(known, candidate, rig)], list(known.drawn)
    for i, drawn in enumerate(known.draws):
        every = [(one, one.with_springs(drawn.springs)) for one in tests]
        pairs = [(one, one.problem.objective.residual(values)) for one, values in every]
        others = list[Other]()
        for springs in _sought(known, drawn.springs, drawn.sizes, search):
            shown = [gain.difference(known, springs, drawn.sizes, *each) for each in pairs]
            others.append(Other.together(shown))
        out[i] = replace(drawn, others=tuple(others))
    return replace(known, drawn=tuple(out))


def _sought(known: Known, drawn: Array, sizes: Array, tests: Sequence[Test]) -> list[Array]:
    """Return springs that nearly give the records of drawn ones in some tests, nearest first.

    Each differs in another parameter.
    """
    links = Links(dict.fromkeys(known.names, "shared"))
    layout = Layout.of(tuple(one.problem for one in tests), links)
    weigh = np.concatenate([one.roots for one in tests])

    def start(springs: Array) -> Array:
        return layout.start([one.with_springs(springs) for one in tests])

    def residual(point: Array) -> Array:
        return weigh * (layout.residual(point) - target)

    def jacobian(point: Array) -> Array:
        return np.asarray(weigh[:, None] * layout.jacobian(point).toarray())

    def left(apart: Array) -> float:
        """Return what a fit would leave, to first order."""
        return float(apart @ apart - np.sum((tangent.T @ apart) ** 2))

    target = layout.residual(start(drawn))
    tangent = np.linalg.qr(jacobian(start(drawn)))[0]
    springs = drawn[: len(known.problem.model.names)]
    every = [*known.explained[:EXPLAINED], *exchanges(known.problem.model, springs)]
    starts = [point for point in map(start, every) if np.all(np.isfinite(residual(point)))]
    starts = sorted(starts, key=lambda point: left(residual(point)))[:MOST]
    ends = [
        levenberg.descend(residual, jacobian, start, layout.box, STEPS, enough=1e-2)
        for start in starts
    ]
    out, covered = list[Array](), np.zeros(len(known.names), dtype=bool)
    for end in sorted(ends, key=attrgetter("cost")):
        values, first = layout.terms[0].values(end.point), tests[0].problem
        found = in_order(first.space(), first.objective, values)
        far = np.abs(found - drawn)[known.places] > 0.5 * WEAK * sizes
        if end.cost <= NEAR and (far & ~covered).any():
            covered |= far
            out.append(found)
    return out
