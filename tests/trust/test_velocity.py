"""Intervals of a record that has only the velocity of the striker, as of a laser vibrometer."""

import numpy as np

import foamfit as ff

SPRING = ff.BistableSpring(5.5e6, 82.5e6, -0.17907e6, 0.14, 0.31, 14.3e6, 2.3375e6)
TOML = """
[specimen]
height = "1.19 mm"
diameter = "5 mm"
[striker]
mass = "7 g"
velocity = "2.3 m/s"
gravity = false
"""


def test_noise_of_a_velocity_is_not_taken_for_noise_of_its_integral(tmp_path):
    """The integral of white noise is a random walk; once, 1 of 36 intervals held the truth."""
    area, mass, speed = np.pi * 2.5e-3**2, 7e-3, 2.3
    time = np.linspace(0.0, 0.6e-3, 901)
    seen = ff.simulate(ff.Chain([SPRING], [1.19e-3], area), ff.Impact(mass, speed), time, rtol=1e-9)
    braked = seen.base_stress * area / mass
    steps = 0.5 * (braked[1:] + braked[:-1]) * np.diff(time)
    velocity = speed - np.append(0.0, np.cumsum(steps))
    path, held = tmp_path / "hit.csv", 0
    path.with_suffix(".toml").write_text(TOML, encoding="utf-8")
    for seed in range(4):
        noisy = velocity + 0.005 * np.random.default_rng(seed).standard_normal(time.size)
        rows = np.column_stack([time, noisy])
        np.savetxt(path, rows, "%.9g", ",", header="time (s),velocity (m/s)", comments="")
        found = ff.fit(ff.read_test(path), starts=8).parameters
        for name in ("k0", "kc", "eps_a", "eps_c", "kh_plus", "kh_minus"):
            low, high = found[f"s1_{name}"].ci95
            held += low <= getattr(SPRING, name) <= high
            assert high - low < getattr(SPRING, name)
    assert held >= 20
