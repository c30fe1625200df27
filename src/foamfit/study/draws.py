"""What the tests at hand leave open: drawn foams that would have given the same records.

Springs in series may have exchanged branches, and a spring may have stayed on its first branches:
each such explanation of the records is a minimum of the cost. Foams are drawn about all of them,
each weighted by Laplace's approximation of its probability (MacKay 2003, Information Theory,
Inference, and Learning Algorithms, ch. 28), which prefers the explanation with fewer branches.

Intervals of a joint fit include what follows the tests about as well (`joint_fit`), and what a plan
expects includes it too: other springs are fitted to the records of a drawn foam in the tests at
hand and in a candidate, and then, to first order, to those in every other candidate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from operator import attrgetter

import numpy as np
from scipy import stats

from foamfit.arrays import Array, Mask
from foamfit.data.rig import Candidate, Rig
from foamfit.errors import SimulationError
from foamfit.fitting import levenberg
from foamfit.fitting.box import Space
from foamfit.fitting.problem import Problem
from foamfit.fitting.together import Layout, Links, Together, fit_linked
from foamfit.springs.model import exchanges
from foamfit.springs.parameters import NUISANCE
from foamfit.study import gain
from foamfit.study.gain import Draw, Known, Other, Test
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import NOTHING, WEAK
from foamfit.trust.refits import ALIKE
from foamfit.trust.settle import in_order, joint_minima

TRIES = 60  # attempts per draw
FROM = 3  # number of minima from which springs with fewer branches are sought
MOST, STEPS = 8, 10  # number of other springs that are fitted to a drawn foam, and of their steps
NEAR = 60.0  # largest rise of the sum of squares, noise having a variance of 1
EXPLAINED = 3  # number of explanations that are tried besides exchanges


def known_of(
    tests: Sequence[Test], rng: np.random.Generator, draws: int, informed: int | None = None
) -> Known:
    """Return what some tests of one foam say about the parameters of its springs.

    The information is computed in the first `informed` draws, by default in all. Without draws
    only the best point is known.
    """
    first, at_hand = tests[0].problem, [one.values for one in tests]
    names = tuple(name for name in first.free() if name not in NUISANCE)
    missed, share, roots = _of_fits(tests, names)

    def explained(vectors: Sequence[Array]) -> Draw:
        sizes, (bread, meat) = first.sizes(names, vectors[0]), np.zeros((2, len(names), len(names)))
        for test, values, root in zip(tests, vectors, roots, strict=True):
            rows = test.rows(values, names, sizes)
            # The covariance of a test alone is that of its fit, D (JᵀJ)⁻¹ D.
            alone = np.linalg.pinv(own := rows.T @ rows, rcond=1e-12, hermitian=True)
            bread, meat = bread + own, meat + own @ (alone * np.outer(root, root)) @ own
        return Draw(tuple(vectors), sizes, bread, meat, _reached(tests, vectors, names))

    problems, links = [one.problem for one in tests], Links(dict.fromkeys(names, "shared"))
    starts = Together.of_own_fits(problems, at_hand).starts(len(tests))
    vectors = at_hand if len(tests) == 1 else fit_linked(problems, links, starts).values
    best, every = explained(vectors), list[Draw]()
    known = Known(first, names, (best,), 1, missed, share, np.ones(len(names)))
    known = replace(known, stretch=_stretch(known, tests))
    if not draws:
        return known
    if first.model.has_several and any(one.fit for one in tests):
        for found in _explanations(tests, vectors, names):
            with suppress(SimulationError):  # it was found with less accuracy
                every.append(explained(found.values))
    drawn, weights = _draws(known, tests, every or [best], rng, draws)
    for i, one in enumerate(drawn[:informed]):
        with suppress(SimulationError):  # a coarser simulation had followed the test
            drawn[i] = explained([test.with_springs(one.springs) for test in tests])
    others = tuple(every[i].springs for i in np.argsort(-weights)) if every else ()
    return replace(known, drawn=tuple(drawn), informed=informed or draws, explained=others)


def _reached(tests: Sequence[Test], vectors: Sequence[Array], names: Sequence[str]) -> Mask:
    """Return whether a test has reached the branch of each parameter, (k,)."""
    pairs = [(one, one.problem.objective, x) for one, x in zip(tests, vectors, strict=True)]
    each = [one.reached(does.simulate(x, everything=True), names) for one, does, x in pairs]
    return np.asarray(np.any(each, axis=0))


def _explanations(
    tests: Sequence[Test], vectors: Sequence[Array], names: Sequence[str]
) -> list[Together]:
    """Return springs in series that explain the tests at hand, minima first, best first."""
    problems, model = tuple(one.problem for one in tests), tests[0].problem.model
    links, top = Links(dict.fromkeys(names, "shared")), max(one.scales.stress for one in problems)
    layout = Layout.of(problems, links)
    minima = joint_minima(layout.fitted(layout.start(vectors)))
    # Springs that stay on their first branches (`Law.fewer`) follow the tests about as well with
    # fewer parameters, but no search finds them, as more branches also follow the noise.
    simpler = dict[tuple[int, ...], Together]()
    for found in minima[:FROM]:
        own = [model.own(i, found.values[0]) for i in range(len(model.laws))]
        each = [[x, *law.fewer(x, top)] for x, law in zip(own, model.laws, strict=True)]
        for kind in list(product(*(range(len(levels)) for levels in each)))[1:]:
            vectors = [values.copy() for values in found.values]
            for values, (i, level) in product(vectors, enumerate(kind)):
                model.own(i, values)[:] = each[i][level]
            with suppress(SimulationError):
                other = fit_linked(_held(tests, vectors, names), links, [vectors])
                if kind not in simpler or other.cost < simpler[kind].cost:
                    simpler[kind] = other
    return [*minima, *simpler.values()]


def _held(tests: Sequence[Test], vectors: Sequence[Array], names: Sequence[str]) -> list[Problem]:
    """Return the problems of some tests in which parameters of unreached branches are held."""
    seen, out = _reached(tests, vectors, names), list[Problem]()
    for problem, values in zip((one.problem for one in tests), vectors, strict=True):
        lost = np.array(names)[~seen].tolist()
        out.append(problem.holding({name: float(values[problem.index[name]]) for name in lost}))
    return out


def _of_fits(tests: Sequence[Test], names: Sequence[str]) -> tuple[float, float, Array]:
    """Return `missed` and `share` of `Known`, and standard errors of each fit over those of JᵀJ."""
    missed, whole, roots = 0.0, 1e-300, np.ones((len(tests), len(names)))
    for t, one in enumerate(tests):
        best, objective = BestPoint(one.problem, one.values), one.problem.objective
        if one.fit is None:  # a simulated test has neither noise nor model error
            continue
        for curve, n, error in zip(objective.counted, objective.sizes, best.errors, strict=True):
            missed, whole = missed + n * error.law**2, whole + n * objective.span(curve) ** 2
        for name, found in zip(best.names, best.spread.inflation.tolist(), strict=True):
            if name in names and math.isfinite(found):
                roots[t, names.index(name)] = math.sqrt(found)
    return missed, math.sqrt(missed / whole), roots


def _stretch(known: Known, tests: Sequence[Test]) -> Array:
    """Return the widest range of each parameter in the fits over that to first order, (k,)."""
    law = np.sqrt(np.maximum(np.diagonal(gain.covariance(known, [])[1][0]), 0.0))
    out = np.ones(law.size)
    for fit in (one.fit for one in tests if one.fit is not None):
        for i, name in enumerate(known.names):
            if (found := fit.parameters[name].range) is not None and law[i] > 0.0:
                half = 0.5 * (found[1] - found[0]) / known.drawn[0].sizes[i]
                out[i] = max(out[i], half / law[i])
    return out


def _draws(
    known: Known, tests: Sequence[Test], every: Sequence[Draw], rng: np.random.Generator, count: int
) -> tuple[list[Draw], Array]:
    """Return draws that follow the tests about as well as the best, and weights of explanations."""
    problem, k = known.problem, len(known.names)
    space, at = problem.space(), np.array([problem.index[name] for name in known.names])
    measured = any(one.fit is not None for one in tests)
    allowed, prior = (ALIKE**2 - 1.0) * known.missed, np.eye(k) / NOTHING**2
    thin, n_springs = [one.problem.thinned().objective for one in tests], len(problem.model.names)

    def cost(one: Draw, values: Array) -> float:
        springs, pairs = values[:n_springs], zip(thin, one.vectors, strict=True)
        own = [(objective, np.append(springs, x[n_springs:])) for objective, x in pairs]
        return sum(float(np.sum(objective.residual(x) ** 2)) for objective, x in own)

    bread, meat = (np.diag(one) for one in (known.drawn[0].bread, known.drawn[0].meat))
    noise = max(float(np.max(meat / np.maximum(bread, 1e-300))), 1.0)
    marks, steps = list[float](), list[tuple[Array, Array]]()
    costs = [cost(one, one.vectors[0]) for one in every]
    for one, least in zip(every, costs, strict=True):
        inverse = np.linalg.inv(one.bread + prior)
        spread = inverse @ (one.meat + prior) @ inverse + allowed / 1.96**2 * inverse
        power, axes = np.linalg.eigh(spread)
        # Parameters of other branches are drawn from what the law calls likely, or from the limits
        # of the search; those of a published set are known.
        axes = np.where(one.reached[:, None], axes * np.sqrt(np.maximum(power, 0.0)), 0.0)
        best = space.encode(one.vectors[0])  # steps are taken in the coordinates of the search
        slopes = space.slopes(best, one.vectors[0])[at] / one.sizes[:, None]
        steps.append((best, np.linalg.lstsq(slopes, axes, rcond=1e-12)[0]))
        volume = np.linalg.slogdet(np.eye(best.size) + slopes.T @ one.bread @ slopes)[1]
        marks.append(-0.5 * (least / noise + volume))
    most = min(costs) + allowed + noise * float(stats.chi2.ppf(0.99, k))
    weights, out = _weights(every, np.array(marks)), list[Draw]()
    for _ in range(count):
        chosen = int(rng.choice(len(every), p=weights)) if len(every) > 1 else 0
        one, (best, axes) = every[chosen], steps[chosen]
        found, open_ = one.vectors[0], at[~one.reached & measured]
        # What noise and model error do not allow is drawn again, nearer to what explains the tests.
        for step in 0.95 ** np.arange(TRIES):
            point = np.clip(best + step * axes @ rng.normal(size=k), *space.box)
            values = _with_open(problem, space, space.decode(point), open_, rng)
            values[n_springs:] = found[n_springs:]
            if cost(one, values) <= most:
                found = in_order(space, problem.objective, values) if len(every) > 1 else values
                break
        out.append(replace(one, vectors=(found, *one.vectors[1:])))
    return out, weights


def _weights(every: Sequence[Draw], marks: Array) -> Array:
    """Return the probabilities of explanations; those that reach the same branches overlap."""
    kinds, weights = [one.reached.tobytes() for one in every], np.exp(marks - marks.max())
    for kind in set(kinds):
        same = np.array([other == kind for other in kinds])
        weights[same] *= weights[same].max() / max(weights[same].sum(), 1e-300)
    return np.asarray(weights / weights.sum())


def _with_open(
    problem: Problem, space: Space, values: Array, open_: Array, rng: np.random.Generator
) -> Array:
    """Return parameters within their limits, with random ones at the places `open_`."""
    for i, law in enumerate(problem.model.laws):
        own = problem.model.own(i, values)
        places = problem.model.own_places[i] + np.arange(own.size)
        unseen = np.isin(places, open_)
        if law.likely is not None and unseen.any():
            own[unseen] = law.likely(own, ~unseen, rng.random(len(law.params)))[unseen]
            open_ = np.setdiff1d(open_, places)
    point = space.encode(values)
    for j, one in enumerate(space.coordinates):
        if one.place in open_ and one.param is not None:
            point[j] = rng.uniform(*one.param.start_limits)
    return space.decode(point)


def with_others(known: Known, tests: Sequence[Test], candidate: Candidate, rig: Rig) -> Known:
    """Return the same with springs that nearly give the records of each drawn foam."""
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
    """Return springs that nearly give drawn records, nearest first, each with other parameters."""
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
