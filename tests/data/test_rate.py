"""The rate of a test."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import synthetic_impact
from foamfit.data.measurement import Measurement, Specimen
from foamfit.data.rate import loading_rate


def held_triangle(rate: float, hold: float, noise: float = 0.0) -> Measurement:
    """To a strain of 0.5 at a rate, held for a time, and back."""
    top = 0.5 / rate
    time = np.linspace(0.0, 2 * top + hold, 801)
    strain = np.interp(time, [0.0, top, top + hold, 2 * top + hold], [0.0, 0.5, 0.5, 0.0])
    moved = 0.01 * (strain + noise * np.random.default_rng(1).standard_normal(time.size))
    return Measurement("held", None, "0" * 64, time, 1e5 * strain, moved, Specimen(0.01, 1e-4))


def test_the_rate_is_the_strain_at_the_peak_over_the_time_to_it():
    assert loading_rate(held_triangle(0.25, 0.0)) == pytest.approx(0.25, rel=0.01)


def test_a_hold_at_the_peak_is_no_part_of_loading():
    assert loading_rate(held_triangle(0.25, 3.0, noise=1e-4)) == pytest.approx(0.25, rel=0.01)


def test_an_impact_has_the_mean_rate_to_its_peak():
    _, impact = synthetic_impact(noise=0.0)
    peak = int(np.argmax(impact.displacement))
    mean = impact.displacement[peak] / impact.specimen.height / impact.time[peak]
    assert loading_rate(impact) == pytest.approx(mean, rel=0.05)


def test_without_time_or_motion_there_is_none():
    test = held_triangle(0.25, 0.0)
    assert loading_rate(replace(test, time=None)) is None
    assert loading_rate(replace(test, displacement=None)) is None


def test_noise_about_a_flat_peak_does_not_move_it():
    """The largest sample lies up to a tenth of the time off."""
    time, rng = np.linspace(0.0, 1e-3, 301), np.random.default_rng(0)
    strain = 0.4 * np.sin(np.pi * time / time[-1])
    test = replace(held_triangle(0.25, 0.0), time=time)
    rates = [
        loading_rate(replace(test, displacement=0.01 * (strain + 2e-3 * rng.standard_normal(301))))
        for _ in range(50)
    ]
    assert np.mean(rates) == pytest.approx(800.0, rel=0.02)
    assert np.std(rates) < 8.0
