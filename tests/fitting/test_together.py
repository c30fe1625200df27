"""Joint fits: parameters that are shared, own, scatter, follow a rate law, or are fixed."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import HEIGHT, synthetic_loop
from foamfit.errors import InputError
from foamfit.fitting import together as engine
from foamfit.fitting.levenberg import Iterate
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import Links, fit_linked
from foamfit.options import KINDS, LOG_RATE, POWER_RATE

SPRING, LOOP = synthetic_loop(noise=0.0)
X = np.log([0.1, 1.0, 10.0])
SLOPES = (14.3e6, 11e6, 9e6)


def problem(measurement, model="bistable"):
    return make_problem(measurement, model, None, None, None, False)


def problems(changes, noise=1e3, model="bistable", held=()):
    made = []
    for i, change in enumerate(changes):
        stress = replace(SPRING, **change).stress(LOOP.displacement / HEIGHT)
        noisy = stress + noise * np.random.default_rng(i).standard_normal(stress.size)
        test = replace(LOOP, name=f"loop {i}", stress=noisy)
        one = problem(test, model)
        for name in held if i == 0 else ():
            one.params[name].vary = False
        made.append(one)
    return made


def vectors(tests, changes):
    out = []
    for one, change in zip(tests, changes, strict=True):
        values = one.vector()
        for name in (n for n in one.names if n.startswith("s1_") and n != "s1_eta"):
            values[one.index[name]] = getattr(replace(SPRING, **change), name[3:])
        out.append(values)
    return out


def fit_together(problems, own, starts):
    """Fit several tests that share all parameters except `own`."""
    names = {name for one in problems for name in one.free()}
    return fit_linked(problems, Links({n: "shared" for n in names if n not in own}), starts)


@pytest.fixture(scope="module")
def tests():
    changes = [{"kh_plus": slope} for slope in SLOPES]
    wrong = {"k0": 1.1 * SPRING.k0, "kh_minus": 0.9 * SPRING.kh_minus, "eps_a": 0.13}
    made = problems(changes, noise=2e3)
    return made, vectors(made, [one | wrong for one in changes])


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


@pytest.mark.parametrize("kind", [LOG_RATE, POWER_RATE])
@pytest.mark.parametrize("name", ["kh_plus", "k0", "eps_c"])
def test_a_law_of_rate_is_recovered_whatever_its_coordinate_is(kind, name):
    """The fit uses kh_plus itself, the logarithm of k0, and eps_c relative to another parameter."""
    v, b = getattr(SPRING, name), -0.05
    law = {LOG_RATE: lambda v, b: v * (1.0 + b * X), POWER_RATE: lambda v, b: v * np.exp(b * X)}
    tests = problems([{name: value} for value in law[kind](v, b)])
    starts = [vectors(tests, [{"eps_a": 0.135}] * 3)]
    kinds = dict.fromkeys(tests[0].free(), "shared") | {f"s1_{name}": kind}
    found = fit_linked(tests, Links(kinds, X), starts)
    value, slope = found.common[f"s1_{name}"]
    assert value == pytest.approx(v, rel=0.01)
    assert slope == pytest.approx(b, abs=0.006)
    assert found.value(f"s1_{name}") == pytest.approx(law[kind](value, slope), rel=1e-9)
    assert found.n_vary == 8
    for other in found.shared:
        if other != f"s1_{name}":
            assert found.value(other) == [found.common[other][0]] * 3  # exactly equal


def test_the_slopes_of_every_kind_are_those_of_the_cost():
    changes = [{"kh_plus": 12e6}, {}, {"eps_c": 0.3, "k0": 6e6}]
    tests = problems(changes, noise=1e4, held=["s1_kh_minus"])
    kinds = {
        "s1_k0": LOG_RATE, "s1_kh_plus": POWER_RATE, "s1_eps_c": LOG_RATE, "s1_kc": "scatter",
        "s1_dsigma": "shared", "s1_eps_a": "own", "s1_kh_minus": "shared",
    }  # fmt: skip
    assert set(kinds.values()) == set(KINDS)
    links = Links(kinds, X, {"s1_kc": np.array([3.0, 5.0, 7.0])})
    layout = engine.Layout.of(tuple(tests), links)
    point = layout.start(vectors(tests, changes))
    point = point + 0.01 * np.cos(np.arange(point.size)) * (np.abs(point) < 100.0)
    at = Iterate(point, layout.residual(point), layout.jacobian(point))
    for j in range(point.size):
        costs = []
        for step in (-1e-6, 1e-6):
            moved = point.copy()
            moved[j] += step * max(abs(moved[j]), 1.0)
            costs.append(float(np.sum(layout.residual(moved) ** 2)))
        slope = (costs[1] - costs[0]) / (2e-6 * max(abs(point[j]), 1.0))
        assert 2.0 * at.gradient[j] == pytest.approx(slope, rel=1e-3, abs=1.0)


def test_what_does_not_vary_in_one_test_keeps_its_value_there():
    tests = problems([{}, {}], held=["s1_kh_minus"])
    starts = vectors(tests, [{"kh_minus": 2e6}, {}])
    tests[0].params["s1_kh_minus"].value = 2e6
    found = fit_linked(tests, Links({"s1_k0": "shared"}), [starts])
    assert found.value("s1_kh_minus")[0] == 2e6
    assert found.value("s1_kh_minus")[1] == pytest.approx(SPRING.kh_minus, rel=0.02)
    assert found.n_vary == 1 + 5 + 6
    shared = dict.fromkeys(tests[1].free(), "shared")
    found = fit_linked(tests, Links(shared), [starts])
    assert found.value("s1_kh_minus")[0] == 2e6
    assert found.n_vary == 7


def test_a_scattering_parameter_is_drawn_to_what_the_tests_have_in_common():
    changes = [{"kh_plus": 12e6}, {"kh_plus": 14e6}, {"kh_plus": 17e6}]
    tests = problems(changes)
    starts = [vectors(tests, changes)]
    kinds = dict.fromkeys(tests[0].free(), "shared") | {"s1_kh_plus": "scatter"}
    free, drawn, tight = (
        fit_linked(tests, Links(kinds, None, {"s1_kh_plus": np.full(3, pull)}), starts)
        for pull in (0.0, 100.0, 1e5)
    )
    spreads = [np.std(np.log(one.value("s1_kh_plus"))) for one in (free, drawn, tight)]
    assert spreads[0] > spreads[1] > 100 * spreads[2]
    (common,) = drawn.common["s1_kh_plus"]
    assert np.log(common) == pytest.approx(np.mean(np.log(drawn.value("s1_kh_plus"))), abs=1e-5)
