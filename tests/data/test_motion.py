"""Smooth motions and strain rates from noisy displacements, compared with known motions."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from conftest import HEIGHT, synthetic_loop
from foamfit.data.cycles import loading_rate
from foamfit.data.measurement import Noise, NoiseLevel
from foamfit.data.motion import SmoothMotion, follow
from foamfit.data.noise import estimated_noise, with_noise

DRAWS = 20
SHAPES = {  # corners of straight lines (time, displacement), both normalised to one
    "triangle": ([0.0, 0.4873, 1.0], [0.0, 1.0, 0.0]),
    "trapezoid": ([0.0, 0.4312, 0.5123, 1.0], [0.0, 1.0, 1.0, 0.0]),
    "inner loop": ([0.0, 0.3011, 0.3312, 0.5531, 1.0], [0.0, 0.6, 0.54, 1.0, 0.0]),
    "cycles": ([0.0, 0.13, 0.27, 0.44, 0.61, 0.8, 1.0], [0.0, 0.4, 0.1, 0.7, 0.1, 1.0, 0.0]),
    "sine": None,
    "haversine": None,
}


def truth(shape: str, t: np.ndarray) -> np.ndarray:
    if shape == "sine":
        return np.sin(0.93 * np.pi * t)
    if shape == "haversine":
        return 0.5 - 0.5 * np.cos(2.0 * np.pi * t)
    return np.interp(t, *SHAPES[shape])


def given(sigma: float) -> NoiseLevel:
    return NoiseLevel(sigma, True, "given")


def measured(shape: str, n: int, sigma: float, seed: int) -> tuple[np.ndarray, ...]:
    t, rng = np.linspace(0.0, 1.0, n), np.random.default_rng(seed)
    true = truth(shape, t)
    return t, true, true + sigma * rng.standard_normal(n)


def reversal(motion: SmoothMotion, t: np.ndarray) -> float:
    """Return the largest step of the motion against its direction between two turns."""
    ends, worst = np.concatenate([t[:1], motion.turns, t[-1:]]), 0.0
    for a, b in pairwise(ends):
        steps = np.diff(motion.at(np.linspace(a, b, 5 * t.size)))
        worst = max(worst, min(steps.max(), -steps.min()))
    return worst


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sigma", [0.0005, 0.003])
def test_intervals_hold_the_motion_as_often_as_they_say(shape, sigma):
    held, errors = [], []
    for seed in range(DRAWS):
        t, true, noisy = measured(shape, 400, sigma, seed)
        motion = follow(t, noisy, given(sigma))
        off = motion.at(t) - true
        held.append(np.mean(np.abs(off) < 1.96 * np.linalg.norm(motion.modes(t), axis=1)))
        errors.append(np.sqrt(np.mean(off**2)) / sigma)
    # Errors within a record are correlated: over 20 records the coverage scatters by about 3.5 %.
    assert 0.88 < np.mean(held) < 0.995
    assert np.mean(errors) < 0.4


@pytest.mark.parametrize("shape", ["triangle", "inner loop", "cycles"])
def test_turns_are_found_with_their_instants_and_heights(shape):
    places, heights = (np.array(v) for v in SHAPES[shape])
    late, high = [], []
    for seed in range(DRAWS):
        t, _, noisy = measured(shape, 1000, 0.001, seed)
        motion = follow(t, noisy, given(0.001))
        assert motion.turns.size == places.size - 2
        late.append((motion.turns - places[1:-1]) / t[1])
        stderr = np.linalg.norm(motion.modes(motion.turns), axis=1)
        high.append((motion.at(motion.turns) - heights[1:-1]) / stderr)
    assert np.sqrt(np.mean(np.square(late))) < 0.5  # to a fraction of a sample
    off = np.concatenate(high)
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.3
    assert abs(np.mean(off)) < 0.5


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [300, 3000])
def test_noise_makes_no_turn_and_no_reversal(shape, n):
    turns = {"inner loop": 3, "cycles": 5}.get(shape, 1)
    for seed in range(8):
        t, _, noisy = measured(shape, n, 0.002, seed)
        motion = follow(t, noisy, given(0.002))
        assert motion.turns.size == turns
        assert reversal(motion, t) == 0.0


@pytest.mark.parametrize("hold", [0.0, 1.0])
def test_a_line_and_a_hold_have_no_turn(hold):
    t = np.linspace(0.0, 2e-3, 500)
    line = 1e-3 * np.interp(t, [0.0, 1e-3, 2e-3], [0.0, 1.0, 2.0 - hold])
    rng = np.random.default_rng(3)
    motion = follow(t, line + 1e-6 * rng.standard_normal(t.size), given(1e-6))
    assert motion.turns.size == 0
    assert np.all(np.diff(motion.at(t)) >= 0.0)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("rounding", [0.0, 1e-7])
def test_data_without_noise_stay_as_they_are(shape, rounding):
    t = np.linspace(5.0, 5.002, 700)
    part = (t - t[0]) / (t[-1] - t[0])
    true = truth(shape, part)
    values = np.round(true / rounding) * rounding if rounding else true
    motion = follow(t, values, given(rounding / 12**0.5))
    assert np.abs(motion.at(t) - true).max() < 1e-6
    assert motion.turns.size == {"inner loop": 3, "cycles": 5}.get(shape, 1)
    assert reversal(motion, t) == 0.0


def test_an_unknown_noise_is_found():
    for shape in ("triangle", "haversine", "trapezoid"):
        t, _, noisy = measured(shape, 1000, 0.002, 1)
        for level in (estimated_noise(noisy), NoiseLevel(0.006, False, ""), given(0.0005)):
            assert follow(t, noisy, level).sigma == pytest.approx(0.002, rel=0.12)


# ---------------------------------------------------------------- the mean strain rate on loading

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


@pytest.mark.parametrize("seed", range(4))
def test_a_rest_before_the_ramp_is_no_loading(seed):
    """Counted from the first row the rate was up to 5 % too low."""
    time, rng = np.linspace(0.0, 62.0, 901), np.random.default_rng(seed)
    strain = np.interp(time, [0.0, 2.0, 32.0, 62.0], [0.0, 0.0, 0.6, 0.0])
    rate = loading_rate(moved(time, strain + 2e-3 * rng.standard_normal(time.size)))
    assert rate == pytest.approx(0.02, rel=0.006)


@pytest.mark.parametrize("end", [3.0, 4.0, 20.0])
def test_a_hold_at_the_largest_strain_is_no_loading(end):
    time = np.linspace(0.0, 30.0, 3001)
    strain = np.interp(time, [0.0, 2.0, end, 30.0], [0.0, 0.5, 0.5, 0.0])
    noisy = strain + 1e-4 * np.random.default_rng(0).standard_normal(time.size)
    assert loading_rate(moved(time, noisy)) == pytest.approx(0.25, rel=0.02)


def test_the_rate_of_several_cycles_is_that_of_the_first():
    """The largest sample may be in any cycle."""
    time = np.linspace(0.0, 4.2, 1201)
    strain = np.interp(time, [0.0, 2.0, 2.4, 3.8, 4.2], [0.0, 0.5, 0.0, 0.502, 0.0])
    noisy = strain + 1e-4 * np.random.default_rng(0).standard_normal(time.size)
    assert loading_rate(moved(time, noisy)) == pytest.approx(0.25, rel=0.02)


def test_a_motion_whose_peak_lies_in_its_rest_has_no_rate():
    """Of three rows within the noise of the peak, one was the last of the rest."""
    test = moved(np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([0.5, 0.1, 0.0, 2.0, -0.3]))
    quiet = replace(test, noise=Noise(displacement=0.01 * HEIGHT))
    assert loading_rate(quiet) is None
