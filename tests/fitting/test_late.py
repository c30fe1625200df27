"""Impacts whose motion is late, and impacts of which only the velocity was recorded."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
import rig


@pytest.mark.parametrize("gauge", [True, False])
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("seed", [3, 4])
def test_a_late_motion_is_found(tmp_path, seed, stated, gauge):
    """Before contact the gauge rests, or else follows the striker; its clock may have a ±."""
    made = rig.impact(rig.Impact(delay_sd=0.05, gauge=gauge, noise=1e-3, before=0.3), seed)
    test = ff.read_test(rig.write(made if stated else replace(made, delay_sd=0.0), tmp_path))
    result = ff.fit(test, time_shift=not stated, starts=2, intervals="local")
    late = made.truth["time_shift"]
    assert result.parameters["time_shift"].value == pytest.approx(late, rel=0.02)
    for name in ("s1_kc", "s1_eps_c", "s1_kh_plus"):
        assert result.parameters[name].value == pytest.approx(made.truth[name], rel=0.05), name
    # The balances use the motion at its own time.
    assert result.energy["absorbed_over_striker"] == pytest.approx(1.0, abs=0.03)


def test_noise_of_a_velocity_is_not_taken_for_noise_of_its_integral(tmp_path):
    """The integral of white noise is a random walk; once, 1 of 36 intervals held the truth."""
    held = list[bool]()
    for seed in range(4):
        made = rig.impact(rig.Impact(channels=("velocity",), noise=1e-3, samples=800), seed)
        found = ff.fit(ff.read_test(rig.write(made, tmp_path)), starts=8).parameters
        for name in ("s1_k0", "s1_kc", "s1_eps_c", "s1_kh_plus"):
            if (ci95 := found[name].ci95) is not None:
                held.append(ci95[0] <= made.truth[name] <= ci95[1])
    assert len(held) >= 12
    assert np.mean(held) > 0.8
