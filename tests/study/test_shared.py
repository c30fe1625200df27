"""Shared values from separate fits of several tests."""

from dataclasses import replace

import numpy as np

from conftest import HEIGHT, synthetic_loop
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import effective_samples

SPRING, LOOP = synthetic_loop(noise=0.0)


def test_an_error_of_the_law_has_few_effective_samples():
    stress = SPRING.stress(LOOP.displacement / HEIGHT)
    noise = 0.01 * np.ptp(stress) * np.random.default_rng(0).standard_normal(stress.size)
    loop = replace(LOOP, stress=stress + noise)
    problem = make_problem(loop, "bistable", None, None, None, interior_mass=False)
    values = problem.vector()
    for name in problem.free():
        values[problem.index[name]] = getattr(SPRING, name[3:])
    white = effective_samples(problem, values)
    wrong = values.copy()
    wrong[problem.index["s1_k0"]] *= 1.3
    assert 15 < white < 40
    assert effective_samples(problem, wrong) < white - 5
