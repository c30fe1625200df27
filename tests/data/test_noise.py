"""Noise and outliers of a channel, compared with known noise and added outliers."""

import functools

import numpy as np
import pytest

import foamfit as ff
from conftest import DATA, HEIGHT, correlated, needs_data, synthetic_impact
from fabricated import half_sine
from foamfit.data.measurement import Record, Specimen, Striker
from foamfit.data.noise import quantum, residual_noise
from foamfit.data.outliers import find_outliers
from foamfit.data.prepare import condition

SPECIMEN = Specimen(HEIGHT, 1.9635e-5)


@functools.cache
def signal(channel: str, n: int) -> np.ndarray:
    """Return a normalised noise-free channel with kinks where springs switch branches."""
    if channel == "loop":
        spring = ff.published["foam-1/model-1"].bistable
        strain = 0.38 * (1 - np.abs(np.linspace(-1, 1, n)))
        values = spring.stress(strain)
    else:
        _, test = synthetic_impact(noise=0.0, samples=n)
        values = getattr(test, channel)
    return values / np.ptp(values)


CHANNELS = ("stress", "displacement", "loop")


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("n", [300, 1000, 5000])
def test_white_noise_is_estimated_to_fifteen_percent(channel, n):
    rng = np.random.default_rng(n)
    ratios = [
        residual_noise(signal(channel, n) + level * rng.standard_normal(n))[0] / level
        for level in (0.002, 0.01, 0.03)
        for _ in range(20)
    ]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)
    # The estimate itself scatters by 6 % for 300 samples and by 1.5 % for 5000.
    assert np.mean(np.abs(np.array(ratios) - 1.0) < 0.15) >= (0.9 if n == 300 else 0.99)


@pytest.mark.parametrize(("n", "phi", "off"), [(300, 0.5, 0.4), (1000, 0.8, 0.4), (5000, 0.9, 0.2)])
def test_slow_noise_is_not_taken_for_signal(n, phi, off):
    """Estimates from second differences would be too small by factors of 0.61, 0.34 and 0.25."""
    rng = np.random.default_rng(1)
    found = np.array(
        [
            residual_noise(signal(channel, n) + 0.01 * correlated(rng, n, phi))
            for channel in CHANNELS
            for _ in range(8)
        ]
    )
    ratios = found[:, 0] / 0.01
    assert np.median(ratios) == pytest.approx(1.0, abs=0.15)
    assert np.mean(np.abs(ratios - 1.0) < off) >= 0.8
    assert np.median(found[:, 1]) == pytest.approx(phi, abs=0.1)


@pytest.mark.parametrize("step", [0.002, 0.02])
def test_a_digitiser_makes_noise_of_its_own(step):
    values = np.round(signal("stress", 600) / step) * step
    assert quantum(values) == pytest.approx(step)
    assert step / np.sqrt(12) * (1 - 1e-9) <= residual_noise(values)[0] < step
    assert quantum(signal("stress", 600)) == 0.0


@pytest.mark.parametrize("samples", [121, 301, 1001])
@pytest.mark.parametrize("digits", [4, 9])
@pytest.mark.parametrize(
    "turns", [(0.0, 1.0, 0.0), (0.0, 1.0, 1.0, 0.0), (0.0, 1.0, 0.2, 0.8, 0.2)]
)
def test_a_motion_at_one_speed_has_no_noise(samples, digits, turns):
    """Loading and unloading pass the same values, which resembles a digitised signal."""
    share = np.linspace(0.0, 1.0, samples)
    at = np.cumsum([0.0, *np.maximum(np.abs(np.diff(turns)), 0.2)])
    motion = np.round(10.0 * np.interp(share, at / at[-1], turns), digits)
    assert residual_noise(motion)[0] <= 10.0 ** (1 - digits)


def test_noise_is_taken_from_the_samples_before_contact():
    """The noise is slow, so that residuals of the signal would underestimate it."""
    _, test = synthetic_impact(noise=0.0, samples=601)
    rng = np.random.default_rng(3)
    step = test.time[1]
    time = np.concatenate([np.arange(-200, 0) * step, test.time])
    stress = np.concatenate([np.zeros(200), test.stress]) + 40e3 * correlated(rng, 801, 0.4)
    motion = np.concatenate([np.zeros(200), test.displacement])
    motion += 3e-6 * rng.standard_normal(801)
    done = condition(Record(time, stress, motion), SPECIMEN, striker=Striker(7e-3, 2.0))
    level = done.noise.estimated["stress"]
    assert "samples before contact" in level.how
    assert level.sigma == pytest.approx(40e3, rel=0.15)
    assert level.time == pytest.approx((1 + 0.4) / (1 - 0.4), rel=0.5)
    assert done.noise.estimated["displacement"].sigma == pytest.approx(3e-6, rel=0.15)
    assert not level.given


# ------------------------------------------------------------------------------------- outliers


def test_clean_records_have_next_to_no_outliers():
    rng = np.random.default_rng(6)
    flagged = samples = 0
    for channel in CHANNELS:
        for n in (150, 300, 600, 1500):
            assert not find_outliers(signal(channel, n)).any()  # kinks are not outliers
            for level in (0.0005, 0.003, 0.01, 0.03):
                for phi in (0.0, 0.5, 0.9):
                    for _ in range(3):
                        noisy = signal(channel, n) + level * correlated(rng, n, phi)
                        flagged += int(find_outliers(noisy).sum())
                        samples += n
    assert flagged / samples < 1e-3


def uneven(rng: np.random.Generator, n: int, kind: str) -> np.ndarray:
    """Return times from 0 to 1 with unequal steps."""
    if kind == "random":
        step = rng.uniform(0.1, 1.0, n)
    else:  # a machine that records every 10 ms and occasionally sooner
        step = np.where(rng.random(n) < 0.1, 3.0, 10.0)
    clock = np.cumsum(step)
    return (clock - clock[0]) / (clock[-1] - clock[0])


@pytest.mark.parametrize("kind", ["random", "machine"])
def test_uneven_times_make_no_outliers(kind):
    rng = np.random.default_rng(6)
    flagged = by_number = samples = 0
    for channel in CHANNELS:
        fine = signal(channel, 6000)
        for n in (150, 300, 600, 1500):
            clock = uneven(rng, n, kind)
            values = np.interp(clock, np.linspace(0.0, 1.0, fine.size), fine)
            assert not find_outliers(values, clock).any()
            for level in (0.0005, 0.003, 0.01, 0.03):
                noisy = values + level * correlated(rng, n, 0.5)
                flagged += int(find_outliers(noisy, clock).sum())
                by_number += int(find_outliers(noisy).sum())
                samples += n
    assert flagged / samples < 2e-4
    assert by_number > 3 * flagged  # without the times, more samples are flagged


@pytest.mark.parametrize(("size", "least"), [(5.0, 0.4), (7.0, 0.85), (10.0, 0.97), (20.0, 0.99)])
def test_spikes_are_found(size, least):
    rng = np.random.default_rng(7)
    found = []
    for _ in range(150):
        channel, n = rng.choice(CHANNELS), int(rng.choice([300, 600, 1500]))
        values = signal(channel, n) + 0.01 * rng.standard_normal(n)
        at = int(rng.integers(8, n - 8))
        values[at] += size * 0.01 * rng.choice([-1, 1])
        found.append(find_outliers(values)[at])
    assert np.mean(found) >= least


@pytest.mark.parametrize("constant", [0.0, 1.5, -999.0])
def test_dropped_samples_are_found(constant):
    rng = np.random.default_rng(8)
    found = []
    for _ in range(100):
        channel, n = rng.choice(CHANNELS), int(rng.choice([300, 600, 1500]))
        values = signal(channel, n) + 0.01 * rng.standard_normal(n)
        at, run = int(rng.integers(n // 4, n * 3 // 5)), int(rng.integers(1, 4))
        if abs(values[at] - constant) < 0.3:
            continue
        values[at : at + run] = constant
        found.append(find_outliers(values)[at : at + run].all())
    assert np.mean(found) >= 0.95


@needs_data
def test_measurements_of_others_have_next_to_no_outliers():
    flagged = samples = 0
    for path in sorted((DATA / "shoe-foam").glob("*_cycle*.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        for channel in ("displacement_m", "force_N"):
            flagged += int(find_outliers(table[channel]).sum())
            samples += table.size
    assert samples > 20_000
    assert flagged / samples < 1e-3


def test_outliers_are_bridged_named_and_kept_for_the_eye():
    time, strain, stress, _ = half_sine()
    rng = np.random.default_rng(10)
    spoilt = stress + 1e4 * rng.standard_normal(time.size)
    clean = spoilt.copy()
    spoilt[200] = 0.0
    spoilt[[300, 301]] = 1e8
    done = condition(Record(time, spoilt, strain * HEIGHT), SPECIMEN, striker=Striker(7e-3, 1.75))
    found = done.outliers["stress"]
    np.testing.assert_allclose(found.at, time[[200, 300, 301]], atol=1e-6)
    np.testing.assert_allclose(found.values, [0.0, 1e8, 1e8], rtol=1e-6, atol=2e4)
    assert found.left_out.sum() == 3
    assert done.stress[~found.left_out].max() < 1.1 * clean.max()
    (note,) = [note for note in done.notes if "spikes or gaps" in note]
    assert note.startswith("Check: 3 samples of the stress")
    assert "100 MPa" in note
    assert set(done.outliers) == {"stress"}


def test_a_steep_short_peak_is_no_gap() -> None:
    """The peak rises as steeply as it falls, over four samples of branch c after a slow rise."""
    peak = [250.8, 277.2, 303.9, 292.1, 265.7]
    rise, fall, rest = np.linspace(0.0, 246.4, 149), np.arange(239.6, 10.0, -26.2), np.zeros(140)
    force = np.array([*rise, *peak, *fall, *rest])
    assert not find_outliers(force).any()
    often = np.arange(force.size) % 20 == 5
    assert np.array_equal(find_outliers(np.where(often, 9999.0, force)), often)  # for no value
    hits = np.where(np.arange(300) % 20 < 2, 250.0, np.random.default_rng(1).normal(size=300))
    assert not find_outliers(hits).any()  # clipped, and too short for flanks
    force[40:44] = 0.0  # a real gap in the same record
    assert np.flatnonzero(find_outliers(force)).tolist() == [40, 41, 42, 43]
