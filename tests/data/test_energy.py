"""The balance of energy and momentum, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import DATA, needs_data, specimen_toml, synthetic_impact
from foamfit.data.csv_file import read_test
from foamfit.data.energy import audit, largest_motion
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker

SPECIMEN = Specimen(height=1e-3, area=2e-5)
MASS, VELOCITY, REBOUND, STIFFNESS = 7e-3, 1.75, 1.05, 5e4


def bounce():
    """Return a test on a spring that is stiffer in loading, so that it rebounds with REBOUND."""
    omega = np.sqrt(STIFFNESS / MASS)
    loading = np.linspace(0, np.pi / 2 / omega, 400)
    top = VELOCITY / omega
    # With a stiffness lower by (REBOUND / VELOCITY)², unloading starts at the same displacement.
    slow = omega * REBOUND / VELOCITY
    unloading = np.linspace(0, np.pi / 2 / slow, 400)[1:]
    time = np.concatenate([loading, loading[-1] + unloading])
    w = np.concatenate([top * np.sin(omega * loading), top * np.cos(slow * unloading)])
    stiffness = np.where(time <= loading[-1], STIFFNESS, STIFFNESS * (REBOUND / VELOCITY) ** 2)
    return Measurement(
        "bounce", None, "", time, stiffness * w / SPECIMEN.area, w, SPECIMEN,
        Striker(MASS, VELOCITY), Noise(stress=2e4), motion="measured",
        notes=("Read it.", "Contact starts at the first sample."),
    )  # fmt: skip


def test_a_test_that_closes():
    found = audit(bounce())
    energy = MASS * VELOCITY**2 / (2 * SPECIMEN.area * SPECIMEN.height)
    assert found.striker_energy == pytest.approx(energy)
    assert found.absorbed_energy == pytest.approx(energy, rel=1e-3)
    assert found.dissipated_fraction == pytest.approx(1 - (REBOUND / VELOCITY) ** 2, rel=1e-3)
    assert found.rebound_velocity == pytest.approx(REBOUND, rel=0.01)
    assert found.momentum_change == pytest.approx(MASS * (VELOCITY + REBOUND), rel=0.01)
    assert found.impulse_ratio == pytest.approx(1, rel=0.01)
    assert found.warnings() == []
    assert found.missing == ()


@pytest.mark.parametrize("velocity", [1.75, 2.0, 2.3])
@pytest.mark.parametrize(("noise", "scatter"), [(0.0, 2e-4), (0.01, 0.015), (0.02, 0.03)])
def test_noise_does_not_bias_the_absorbed_energy(velocity, noise, scatter):
    tests = [synthetic_impact(velocity, noise, seed)[1] for seed in range(20 if noise else 1)]
    found = [audit(test) for test in tests]
    ratios = np.array([item.absorbed_over_striker for item in found])
    assert abs(ratios.mean() - 1) < (0.01 if noise else 2e-4)
    assert ratios.std() <= scatter
    peaks = [largest_motion(test.displacement, test.time)[1] for test in tests]
    true = synthetic_impact(velocity, 0.0)[1].displacement.max()
    assert np.mean(peaks) == pytest.approx(true, rel=5e-3)
    assert np.std(peaks) <= 0.4 * noise * true
    lost = synthetic_impact(velocity, 0.0)[1]
    fractions = [item.dissipated_fraction for item in found]
    assert np.mean(fractions) == pytest.approx(audit(lost).dissipated_fraction, abs=0.015)


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1.2, ["absorbs 1.20 times", "impossible"]),
        (0.78, ["only 0.78", "impulse of the force is 0.78"]),
    ],
)
def test_a_wrong_scale_of_force_is_found(scale, words):
    test = bounce()
    sentences = " ".join(audit(replace(test, stress=scale * test.stress)).sentences())
    assert all(word in sentences for word in words)


@pytest.mark.parametrize(
    ("change", "gone", "words"),
    [
        ({"striker": None}, "striker_energy", "mass and velocity"),
        ({"striker": Striker(velocity=1.75)}, "momentum_change", "mass"),
        ({"displacement": None}, "absorbed_energy", "displacement"),
        ({"time": None}, "impulse", "momentum"),
        ({"motion": "integrated from force"}, "momentum_change", "integrated from the force"),
    ],
)
def test_what_is_missing_is_named(change, gone, words):
    found = audit(replace(bounce(), **change))
    assert getattr(found, gone) is None
    assert any(words in sentence for sentence in found.missing)
    assert set(map(type, found.as_dict().values())) <= {float, str, type(None)}


@needs_data
@pytest.mark.parametrize(("number", "velocity"), [(1, 0.785), (3, 0.905)])
def test_cartilage_does_not_close(tmp_path, number, velocity):
    striker = f'[striker]\nmass = "358.39 g"\nvelocity = "{velocity} m/s"\n'
    toml = specimen_toml(tmp_path, 0.563, 8.5, striker)
    found = audit(read_test(DATA / "cartilage-impact" / f"test_{number}_impact.csv", toml))
    assert 0.745 < found.impulse_ratio < 0.795  # depends on the zero of eight rows
    assert any("impulse of the force" in warning for warning in found.warnings())
    assert "N·s (by the velocity given)." in " ".join(found.sentences())  # the other is the ratio
