"""Gravity on a striker in implicit steps and for many springs, against explicit steps."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from foamfit.solve.plan import plan
from foamfit.springs.chain import Chain, Impact
from independent import over_range

WEIGHT = 300.0  # m/s²: thirty times standard gravity, so that every test would show its absence


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
    assert over_range(implicit.base_stress, explicit.base_stress) < 1e-7
    assert over_range(implicit.displacement, explicit.displacement) < 1e-7
    assert implicit.contact_end == pytest.approx(explicit.contact_end, rel=1e-7)
    assert np.all(explicit.displacement[0][time > 0.0] != 0.0)
    many = ff.simulate(scene(eta, 12), ff.Impact(7e-3, 2.0, WEIGHT), time, rtol=1e-8)
    assert over_range(many.base_stress, explicit.base_stress) < 1e-6
    assert over_range(many.displacement[-1], explicit.displacement[0]) < 1e-6
