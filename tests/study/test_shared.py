"""Which parameters several tests share."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from conftest import EXPERIMENTS, HEIGHT, synthetic_loop
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import Together, effective_samples

sys.path.insert(0, str(EXPERIMENTS / "damage"))
from selection import select_own

SPRING, LOOP = synthetic_loop(noise=0.0)


def group(changes, noise=0.01, seed=0):
    """Three tests on springs that differ in what `changes` says of each."""
    rng = np.random.default_rng(seed)
    problems, vectors = [], []
    for change in changes:
        spring = replace(SPRING, **change)
        stress = spring.stress(LOOP.displacement / HEIGHT)
        noisy = stress + noise * np.ptp(stress) * rng.standard_normal(stress.size)
        problem = make_problem(
            replace(LOOP, stress=noisy), "bistable", None, None, None, interior_mass=False
        )
        values = problem.vector()
        for name in problem.free():
            values[problem.index[name]] = getattr(spring, name[3:])
        problems.append(problem)
        vectors.append(values)
    return Together.of_own_fits(problems, vectors)


STEEPER = [{}, {"kh_plus": 12e6}, {"kh_plus": 10e6}]


def test_the_parameter_that_changes_is_chosen_and_no_other():
    selection = select_own([group(STEEPER)])
    assert selection.best.own == ("s1_kh_plus",)
    assert [len(step.own) for step in selection.steps] == [0, 1, 2]  # the last one against evidence
    assert selection.steps[2].bic > selection.steps[1].bic < selection.steps[0].bic
    assert selection.best.fits[0].value("s1_kh_plus") == pytest.approx(
        [14.3e6, 12e6, 10e6], rel=0.03
    )
    assert selection.explained(selection.best) > 0.98
    assert selection.explained(selection.steps[0]) == 0.0


def test_nothing_changes_where_nothing_does():
    selection = select_own([group([{}, {}, {}])])
    assert selection.best.own == ()
    assert selection.chosen == 0


def test_groups_have_the_same_own_parameters_and_shared_values_of_their_own():
    other = [{"k0": 6.5e6, **change} for change in STEEPER]
    told = []
    groups = [group(STEEPER), group(other, seed=1)]
    selection = select_own(groups, progress=lambda done, what: told.append(done))
    assert selection.best.own == ("s1_kh_plus",)
    one, two = (fit.value("s1_k0")[0] for fit in selection.best.fits)
    assert one == pytest.approx(SPRING.k0, rel=0.03)
    assert two == pytest.approx(6.5e6, rel=0.03)
    assert selection.best.n_vary == 2 * (6 + 3)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_an_error_of_the_law_has_few_effective_samples():
    noisy = group([{}])
    white = effective_samples(noisy.problems[0], noisy.values[0])
    wrong = noisy.values[0].copy()
    wrong[noisy.problems[0].index["s1_k0"]] *= 1.3
    assert 15 < white < 40
    assert effective_samples(noisy.problems[0], wrong) < white - 5
