"""Parameters of several tests that follow a rate law, scatter, or are fixed in some tests."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import HEIGHT, synthetic_loop
from foamfit.fitting import together as engine
from foamfit.fitting.levenberg import Iterate
from foamfit.fitting.links import KINDS, LOG_RATE, POWER_RATE, Links, law_values, start_of
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import fit_linked

SPRING, LOOP = synthetic_loop(noise=0.0)
X = np.log([0.1, 1.0, 10.0])


def problems(changes, noise=1e3, model="bistable", held=()):
    made = []
    for i, change in enumerate(changes):
        stress = replace(SPRING, **change).stress(LOOP.displacement / HEIGHT)
        noisy = stress + noise * np.random.default_rng(i).standard_normal(stress.size)
        test = replace(LOOP, name=f"loop {i}", stress=noisy)
        one = make_problem(test, model, None, None, None, False)
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


@pytest.mark.parametrize("kind", [LOG_RATE, POWER_RATE])
@pytest.mark.parametrize("name", ["kh_plus", "k0", "eps_c"])
def test_a_law_of_rate_is_recovered_whatever_its_coordinate_is(kind, name):
    """The fit uses kh_plus itself, the logarithm of k0, and eps_c relative to another parameter."""
    v, b = getattr(SPRING, name), -0.05
    changes = [{name: value} for value in law_values(kind, v, b, X)]
    tests = problems(changes)
    starts = [vectors(tests, [{"eps_a": 0.135}] * 3)]
    kinds = dict.fromkeys(tests[0].free(), "shared") | {f"s1_{name}": kind}
    found = fit_linked(tests, Links(kinds, X), starts)
    value, slope = found.common[f"s1_{name}"]
    assert value == pytest.approx(v, rel=0.01)
    assert slope == pytest.approx(b, abs=0.006)
    assert found.value(f"s1_{name}") == pytest.approx(law_values(kind, value, slope, X), rel=1e-9)
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
    layout = engine._Layout.of(tuple(tests), links)
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


def test_values_that_a_law_cannot_meet_start_at_their_median():
    assert start_of(LOG_RATE, 2.0 * (1.0 + 0.1 * X), X) == pytest.approx((2.0, 0.1))
    assert start_of(POWER_RATE, 2.0 * np.exp(0.1 * X), X) == pytest.approx((2.0, 0.1))
    assert start_of(LOG_RATE, np.array([9.0, 1.0, 0.0]), X) == (1.0, 0.0)
    assert start_of(POWER_RATE, np.array([1.0, 2.0]), np.zeros(2)) == (1.5, 0.0)
