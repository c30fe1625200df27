"""The covariance of a joint fit, computed in blocks."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import HEIGHT, NAMES, synthetic_loop
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import Links, fit_linked
from foamfit.study.joint_fit import errors_of, fit_jointly
from foamfit.trust.best_point import BestPoint
from foamfit.trust.joint_point import JointPoint

SPRING, WHOLE = synthetic_loop(noise=0.0)
LOOP = replace(WHOLE, displacement=WHOLE.displacement[::2], stress=WHOLE.stress[::2])
X = np.log([0.1, 1.0, 10.0])


def loops_of(changes, noise, seed=0, colour=0.0):
    rng = np.random.default_rng(seed)
    problems, vectors = [], []
    for i, change in enumerate(changes):
        spring = replace(SPRING, **change)
        stress = spring.stress(LOOP.displacement / HEIGHT)
        error = noise * rng.standard_normal(stress.size)
        for k in range(1, error.size if colour else 0):
            error[k] += colour * error[k - 1]
        one = make_problem(
            replace(LOOP, name=f"loop {i}", stress=stress + error),
            "bistable", None, None, None, interior_mass=False,
        )  # fmt: skip
        values = one.vector()
        for name in NAMES:
            values[one.index[f"s1_{name}"]] = getattr(spring, name)
        problems.append(one)
        vectors.append(values)
    return problems, vectors


@pytest.fixture(scope="module")
def point():
    problems, vectors = loops_of([{"k0": 5e6}, {}, {"k0": 6e6, "eps_c": 0.3}], 2e4, colour=0.5)
    kinds = dict.fromkeys(problems[0].free(), "shared") | {
        "s1_eps_c": "own", "s1_kh_plus": "own", "s1_k0": "log rate",
    }  # fmt: skip
    found = fit_linked(problems, Links(kinds, X), [vectors])
    return JointPoint(found, errors_of(found))


def test_the_covariance_is_the_sandwich_of_all_residuals(point):
    blocks, plain, s = point.uncertainty.blocks, point.uncertainty, len(point.names)
    slopes = [block.jacobian @ block.through for block in blocks]
    hessian = sum(one.T @ one for one in slopes)
    meat = sum(
        one.T @ process.times(one)
        for one, block in zip(slopes, blocks, strict=True)
        for process in block.noise
    )
    inverse = np.linalg.inv(hessian)
    assert hessian.shape == (s + 3 * 2,) * 2
    assert plain.inverse == pytest.approx(inverse, rel=1e-6)
    assert plain.matrix == pytest.approx(inverse @ meat @ inverse, rel=1e-6)
    value = np.array([values[point.bests[0].index["s1_kh_plus"]] for values in point.found.values])
    places = [s + 2 * t + 1 for t in range(3)]
    matrix, bread = point.of_logarithms("s1_kh_plus")
    scales = point.uncertainty.scales[places] / value
    assert matrix == pytest.approx(
        plain.matrix[np.ix_(places, places)] * np.outer(scales, scales), rel=1e-6
    )
    assert bread == pytest.approx(
        inverse[np.ix_(places, places)] * np.outer(scales, scales), rel=1e-6
    )


def test_one_test_alone_has_the_covariance_of_its_own_fit():
    problems, vectors = loops_of([{}], 2e4)
    kinds = dict.fromkeys(problems[0].free(), "shared")
    joint = fit_jointly(problems, Links(kinds), [vectors])
    alone = BestPoint(problems[0], joint.found.values[0])
    errors = [joint.point.of_common(name)[0] for name in alone.names]
    assert errors == pytest.approx(alone.spread.stderr, rel=1e-3)
    freedom = [joint.point.of_common(name)[1] for name in alone.names]
    assert freedom == pytest.approx(alone.spread.freedom, rel=0.05)


def test_beside_an_error_of_the_law_tests_add_up_as_well():
    """One spring cannot follow the wave in these three tests; errors still decrease by √3."""
    problems, vectors = loops_of([{}] * 3, 5e2)
    wave = 3e4 * np.sin(LOOP.displacement / HEIGHT * 40.0)
    bent = [
        make_problem(
            replace(p.measurement, stress=p.measurement.stress + wave), "bistable", None, None,
            None, interior_mass=False,
        )
        for p in problems
    ]  # fmt: skip
    kinds = dict.fromkeys(problems[0].free(), "shared")
    found = fit_linked(bent, Links(kinds), [vectors])
    alone = [BestPoint(p, values) for p, values in zip(bent, found.values, strict=True)]
    point = JointPoint(found, tuple(best.errors for best in alone))
    assert all(error.found for errors in point.errors for error in errors)
    wanted = np.sqrt(np.mean([best.spread.stderr**2 for best in alone], axis=0) / 3.0)
    errors = [point.of_common(name)[0] for name in problems[0].free()]
    assert errors == pytest.approx(wanted, rel=0.05)
