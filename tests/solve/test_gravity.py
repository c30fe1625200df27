"""Gravity on a striker by all solvers, with derivatives, against an independent integration."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
import rig
import rigs
from foamfit.solve.plan import plan
from foamfit.springs.chain import Chain, Impact

WEIGHT = 300.0  # m/s²: thirty times standard gravity, so that every test would show its absence


def share(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.abs(found - truth).max() / np.ptp(truth))


@pytest.mark.parametrize("law", ["bistable", "microscale"])
@pytest.mark.parametrize("relaxation", [0, 1])
@pytest.mark.parametrize("seed", [1, 4])
def test_a_falling_striker_moves_as_an_independent_integration_says(
    law: str, relaxation: int, seed: int
) -> None:
    setup = rig.Impact(law=law, relaxation=relaxation, gravity=True)
    made = rig.impact(setup, seed).rig
    made = replace(made, gravity=0.1 * made.velocity**2 / made.height)
    course = made.run(0.0, 100.0 * made.height / made.velocity)
    time = np.linspace(-0.2 * course.end, 1.3 * course.end, 800)
    drive = ff.Impact(made.mass, made.velocity, made.gravity)
    found = ff.simulate(rigs.chain_of(made), drive, time, rtol=1e-9)
    assert share(found.base_stress, course.stress(time)) < 1e-6
    assert share(found.displacement[-1], course.top(time, gauge=False)) < 1e-6
    assert found.contact_end == pytest.approx(course.end, rel=1e-6)
    without = ff.simulate(rigs.chain_of(made), ff.Impact(made.mass, made.velocity), time)
    assert share(without.base_stress, course.stress(time)) > 1e-3


def scene(eta: float = 0.0, count: int = 1) -> Chain:
    springs = [replace(ff.published["foam-1/model-2"].chain.springs[0], eta=eta)] * count
    return Chain(springs, [1.19e-3 / count] * count, 1.9635e-5)


@pytest.mark.parametrize("eta", [0.0, 300.0])
def test_implicit_steps_and_many_springs_know_gravity(eta: float) -> None:
    time = np.linspace(-2e-4, 3e-3, 700)
    made = plan(scene(eta), Impact(7e-3, 2.0, WEIGHT), time)
    rows, heights = scene(eta).arrays.rows, np.array([1.19e-3])
    explicit = made.run(rows, heights, 1e-9)
    implicit = made.changed(implicit=True).run(rows, heights, 1e-8)
    assert share(implicit.base_stress, explicit.base_stress) < 1e-7
    assert share(implicit.displacement, explicit.displacement) < 1e-7
    assert implicit.contact_end == pytest.approx(explicit.contact_end, rel=1e-7)
    assert np.all(explicit.displacement[0][time > 0.0] != 0.0)
    many = ff.simulate(scene(eta, 12), ff.Impact(7e-3, 2.0, WEIGHT), time, rtol=1e-8)
    assert share(many.base_stress, explicit.base_stress) < 1e-6
    assert share(many.displacement[-1], explicit.displacement[0]) < 1e-6


@pytest.mark.parametrize("implicit", [False, True])
def test_derivatives_under_gravity_are_those_of_differences(implicit: bool) -> None:
    time = np.linspace(-2e-4, 3e-3, 300)
    chain = scene(200.0)
    made = plan(chain, Impact(7e-3, 2.0, WEIGHT), time).changed(implicit=implicit)
    rows, heights = chain.arrays.rows, np.array([1.19e-3])
    directions = np.array([[0, 0], [0, 3]])  # k0 and eps_a
    slopes = made.run(rows, heights, 1e-9, directions=directions).slopes
    assert slopes is not None
    for p, spring in enumerate(("k0", "eps_a")):
        sides = []
        for sign in (-1, 1):
            one = chain.springs[0]
            changed = replace(one, **{spring: getattr(one, spring) * (1.0 + sign * 1e-5)})
            moved = Chain([changed], [1.19e-3], chain.area).arrays.rows
            sides.append(made.run(moved, heights, 1e-9))
        step = 2e-5 * getattr(chain.springs[0], spring)
        by = (sides[1].displacement[0] - sides[0].displacement[0]) / step
        assert share(slopes.displacement[p, 0], by) < 2e-4
        after = time > sides[0].contact_end + 1e-4
        assert after.any()
        assert share(slopes.displacement[p, 0][after], by[after]) < 2e-4
