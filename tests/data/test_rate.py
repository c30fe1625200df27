"""The mean strain rate on loading."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import HEIGHT, synthetic_loop
from foamfit.data.cycles import loading_rate
from foamfit.data.noise import with_noise

_, LOOP = synthetic_loop(noise=0.0)


def moved(time, strain):
    test = replace(LOOP, time=time, displacement=HEIGHT * strain, stress=np.sin(time / time[-1]))
    return with_noise(test)


def test_a_triangle_has_the_rate_of_its_loading():
    time = np.linspace(0.0, 8.0, 801)  # 2 s of loading, 6 s of unloading
    strain = np.interp(time, [0.0, 2.0, 8.0], [0.0, 0.5, 0.0])
    assert loading_rate(moved(time, strain)) == pytest.approx(0.25, rel=1e-3)


def test_noise_about_a_flat_peak_does_not_move_it():
    """The largest sample can be a tenth of the duration away from the true peak."""
    time, rng = np.linspace(0.0, 1e-3, 301), np.random.default_rng(0)
    strain = 0.4 * np.sin(np.pi * time / time[-1])
    rates = [loading_rate(moved(time, strain + 2e-3 * rng.standard_normal(301))) for _ in range(50)]
    assert np.mean(rates) == pytest.approx(800.0, rel=0.02)
    assert np.std(rates) < 8.0


def test_a_hold_at_the_largest_strain_is_no_loading():
    time = np.linspace(0.0, 30.0, 3001)
    strain = np.interp(time, [0.0, 2.0, 20.0, 30.0], [0.0, 0.5, 0.5, 0.0])
    noisy = strain + 1e-4 * np.random.default_rng(0).standard_normal(time.size)
    assert loading_rate(moved(time, noisy)) == pytest.approx(0.25, rel=0.02)


def test_the_rate_of_several_cycles_is_that_of_the_first():
    """The largest sample may be in any cycle."""
    time = np.linspace(0.0, 4.2, 1201)
    strain = np.interp(time, [0.0, 2.0, 2.4, 3.8, 4.2], [0.0, 0.5, 0.0, 0.502, 0.0])
    noisy = strain + 1e-4 * np.random.default_rng(0).standard_normal(time.size)
    assert loading_rate(moved(time, noisy)) == pytest.approx(0.25, rel=0.02)
