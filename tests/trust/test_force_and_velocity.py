"""Records of force and velocity: the noise of the velocity is a random walk in its integral."""

import numpy as np
import pytest

import foamfit as ff

HEIGHT, AREA, MASS, SPEED, STIFFNESS = 1.2e-3, 2e-5, 7e-3, 1.5, 8e6


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_of_a_velocity_is_no_error_of_the_law(tmp_path, seed):
    """Its integral has slow waves, which were called an error of the law in every such record."""
    omega = np.sqrt(AREA * STIFFNESS / (MASS * HEIGHT))
    time = np.pi / omega / 300 * np.arange(-60, 380)
    phase = np.clip(omega * time, 0.0, np.pi)
    curves = [STIFFNESS * SPEED / (omega * HEIGHT) * np.sin(phase) * AREA, SPEED * np.cos(phase)]
    rng = np.random.default_rng(seed)
    columns = [one + 5e-3 * np.ptp(one) * rng.standard_normal(time.size) for one in curves]
    path = tmp_path / "impact.csv"
    table = np.column_stack([1e3 * time + 4.0, *columns])
    header = "time (ms),force (N),velocity (m/s)"
    np.savetxt(path, table, fmt="%.6f", delimiter=",", header=header, comments="")
    path.with_suffix(".toml").write_text(
        '[specimen]\nheight = "1.2 mm"\narea = "20 mm^2"\n'
        '[striker]\nmass = "7 g"\nvelocity = "1.5 m/s"\ngravity = false\n'
    )
    found = ff.fit(ff.read_test(path), model="linear", starts=3, intervals="local")
    assert not any("law misses" in one or "law is at fault" in one for one in found.warnings)
    stiffness = found.parameters["s1_k0"]
    assert abs(stiffness.value - STIFFNESS) < 3.0 * stiffness.stderr
    assert stiffness.stderr < 0.01 * STIFFNESS
