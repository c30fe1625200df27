"""Joint fits of several tests, with shared parameters and parameters of each test."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import HEIGHT, synthetic_loop
from foamfit.errors import InputError
from foamfit.fitting.links import Links
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import fit_linked

SPRING, LOOP = synthetic_loop(noise=0.0)


def fit_together(problems, own, starts):
    """Fit several tests that share all parameters except `own`."""
    names = {name for one in problems for name in one.free()}
    return fit_linked(problems, Links({n: "shared" for n in names if n not in own}), starts)


SLOPES = (14.3e6, 11e6, 9e6)


def loop(spring, seed, noise=2e3):
    stress = spring.stress(LOOP.displacement / HEIGHT)
    rng = np.random.default_rng(seed)
    noisy = stress + noise * rng.standard_normal(stress.size)
    return replace(LOOP, name=f"loop {seed}", stress=noisy)


def problem(measurement, model="bistable", relaxation=0):
    return make_problem(measurement, model, None, None, None, False, relaxation=relaxation)


def vector(problem_, spring):
    values = problem_.vector()
    for name in ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus"):
        values[problem_.index[f"s1_{name}"]] = getattr(spring, name)
    return values


@pytest.fixture(scope="module")
def tests():
    springs = [replace(SPRING, kh_plus=slope) for slope in SLOPES]
    problems = [problem(loop(spring, i)) for i, spring in enumerate(springs)]
    wrong = replace(SPRING, k0=1.1 * SPRING.k0, kh_minus=0.9 * SPRING.kh_minus, eps_a=0.13)
    return problems, [vector(p, wrong) for p in problems]


def test_shared_parameters_have_one_value_and_own_ones_their_own(tests):
    problems, starts = tests
    found = fit_together(problems, ["s1_kh_plus"], [starts])
    assert found.own == ("s1_kh_plus",)
    assert found.n_vary == 6 + 3
    assert found.value("s1_kh_plus") == pytest.approx(SLOPES, rel=0.01)
    for name in found.shared:
        values = found.value(name)
        assert values == [values[0]] * 3
        assert values[0] == pytest.approx(getattr(SPRING, name[3:]), rel=0.02)
    assert found.cost == pytest.approx(
        sum(
            float(np.sum(p.objective.residual(values) ** 2))
            for p, values in zip(problems, found.values, strict=True)
        )
    )


def test_the_end_is_a_minimum_along_every_shared_and_own_parameter(tests):
    problems, starts = tests
    found = fit_together(problems, ["s1_kh_plus", "s1_eps_a"], [starts])

    def cost(moved):
        pairs = zip(problems, moved, strict=True)
        return sum(float(np.sum(p.objective.residual(values) ** 2)) for p, values in pairs)

    for name in (*found.shared, *found.own):
        alone = range(3) if name in found.own else [None]
        for which in alone:
            for factor in (0.998, 1.002):
                moved = [values.copy() for values in found.values]
                for i, (p, values) in enumerate(zip(problems, moved, strict=True)):
                    if which in (None, i):
                        values[p.index[name]] *= factor
                assert cost(moved) > found.cost


def test_nothing_shared_is_each_test_alone(tests):
    problems, starts = tests
    names = problems[0].free()
    together = fit_together(problems, names, [starts])
    alone = [fit_together([p], (), [[start]]) for p, start in zip(problems, starts, strict=True)]
    for cost, one in zip(together.costs, alone, strict=True):
        assert cost == pytest.approx(one.cost, rel=1e-4)
    # sharing more parameters never lowers the cost
    costs = [fit_together(problems, names[:n], [starts]).cost for n in (0, 3)]
    assert costs[0] > costs[1] >= together.cost * (1.0 - 1e-6)


def test_a_shared_parameter_stays_one_value_where_its_limit_is_another_for_each_test():
    """The lower limit of eps_star depends on k0, which differs between the tests."""
    strain = LOOP.displacement / HEIGHT
    problems, starts = [], []
    for i, k0 in enumerate((4e5, 2e5)):
        spring = ff.MicroscaleSpring(
            k0=k0, kc=5e5, eps_star=0.3, sigma_plus=1e5, spread_plus=0.4, sigma_minus=6e4,
            spread_minus=0.6,
        )  # fmt: skip
        noise = 200.0 * np.random.default_rng(i).standard_normal(strain.size)
        one = problem(replace(LOOP, stress=spring.stress(strain) + noise), "microscale")
        values = one.vector()
        for name in one.free():
            values[one.index[name]] = getattr(spring, name[3:]) * 1.03
        problems.append(one)
        starts.append(values)
    found = fit_together(problems, ["s1_k0"], [starts])
    assert len(set(found.value("s1_eps_star"))) == 1
    assert found.value("s1_eps_star")[0] == pytest.approx(0.3, abs=0.02)
    assert found.value("s1_k0") == pytest.approx([4e5, 2e5], rel=0.02)


def test_tests_that_cannot_be_fitted_together_are_refused(tests):
    problems, starts = tests
    other = problem(problems[1].measurement, "bistable+bistable")
    with pytest.raises(InputError, match="loop 1 has other parameters than loop 0"):
        fit_together([problems[0], other], (), [starts[:2]])
