"""A slow test whose measured stress drives the springs, as in the paper."""

import numpy as np
import pytest

import foamfit as ff

LAW = {
    "k0": 5.5e5, "kc": 2.5e5, "eps_star": 0.08, "sigma_plus": 1.3e5, "spread_plus": 0.4,
    "sigma_minus": 5.5e4, "spread_minus": 0.6,
}  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_a_machine_that_moves_before_contact_with_an_arbitrary_zero(tmp_path, seed):
    """The zero of the file stayed, by 8 % of the motion, and the smoothed stress lost its peak."""
    rng, time = np.random.default_rng(seed), np.linspace(-0.5, 20.0, 615)
    strain = 0.5 * (1.0 - np.abs(time / 10.0 - 1.0))
    stress = ff.MicroscaleSpring(**LAW).stress(np.maximum(strain, 0.0))
    curves = [stress / 1e3, 10.0 * strain + 0.8]
    noisy = [one + 4e-3 * np.ptp(one) * rng.standard_normal(time.size) for one in curves]
    path, header = tmp_path / "slow.csv", "time (s),stress (kPa),displacement (mm)"
    table = np.column_stack([time + 0.5, *noisy])
    np.savetxt(path, table, fmt="%.6f", delimiter=",", header=header, comments="")
    path.with_suffix(".toml").write_text('[specimen]\nheight = "10 mm"\narea = "1 cm^2"\n')
    found = ff.fit(
        ff.read_test(path), model="microscale", drive="stress", starts=4, intervals="local"
    )
    for name, value in LAW.items():
        one = found.parameters[f"s1_{name}"]
        assert abs(one.value - value) < 3.5 * one.stderr, name
    zero = found.parameters["displacement_zero"]
    assert abs(zero.value - 0.8e-3) < 3.5 * zero.stderr
    assert max(found.misfit["displacement_time"], found.misfit["stress_strain"]) < 0.01
