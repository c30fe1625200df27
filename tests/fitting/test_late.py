"""A motion whose clock is late, recorded from before the contact of an impact."""

from pathlib import Path

import numpy as np
import pytest

import foamfit as ff

HEIGHT, AREA, MASS, SPEED = 1.19e-3, np.pi * 2.5e-3**2, 7e-3, 2.3
SPRING = ff.BistableSpring(5.5e6, 82.5e6, -0.17907e6, 0.14, 0.31, 14.3e6, 2.3375e6)
TOML = """
[specimen]
height = "1.19 mm"
diameter = "5 mm"
[striker]
mass = "7 g"
velocity = "2.3 m/s"
"""


def record(folder: Path, late: float, *, flies: bool, delay: str | None) -> ff.Measurement:
    """Write force and motion, in a file of its own with a `delay`, and read them.

    Before contact the gauge follows the striker if it `flies`, or else rests.
    """
    time = np.linspace(-0.3e-3, 0.7e-3, 1001)
    hit = time[time >= 0.0]
    chain = ff.Chain([SPRING], [HEIGHT], AREA)
    seen = ff.simulate(chain, ff.Impact(MASS, SPEED), hit, rtol=1e-9)
    force, moved = np.zeros(time.size), SPEED * time if flies else np.zeros(time.size)
    force[time >= 0.0] = AREA * np.where(hit <= seen.contact_end, seen.base_stress, 0.0)
    moved[time >= 0.0] = seen.displacement[-1]
    before = SPEED * (time[0] - late) if flies else 0.0
    moved = np.where(time < time[0] + late, before, np.interp(time - late, time, moved))
    rng = np.random.default_rng(0)
    force, moved = force + rng.normal(0.0, 0.2, 1001), moved + rng.normal(0.0, 5e-7, 1001)
    path, toml = folder / "hit.csv", TOML
    columns = {"time (s)": time, "force (N)": force, "displacement (m)": moved}
    if delay is not None:
        names = "time (s),displacement (m)"
        np.savetxt(
            folder / "camera.csv",
            np.column_stack([time, moved]),
            "%.9g",
            ",",
            header=names,
            comments="",
        )
        toml += f'[motion]\nfile = "camera.csv"\ndelay = "{delay}"\n'
        del columns["displacement (m)"]
    rows = np.column_stack([*columns.values()])
    np.savetxt(path, rows, "%.9g", ",", header=",".join(columns), comments="")
    path.with_suffix(".toml").write_text(toml, encoding="utf-8")
    return ff.read_test(path)


@pytest.mark.parametrize("flies", [True, False])
@pytest.mark.parametrize(
    ("late", "delay"), [(20e-6, "0 ± 50 us"), (-20e-6, "0 ± 20 us"), (20e-6, None)]
)
def test_a_late_motion_is_found(tmp_path, late, delay, flies):
    test = record(tmp_path, late, flies=flies, delay=delay)
    result = ff.fit(test, time_shift=delay is None, starts=4, intervals="local")
    found = {name: one.value for name, one in result.parameters.items()}
    assert found["time_shift"] == pytest.approx(late, abs=0.3e-6)
    assert found["s1_kc"] == pytest.approx(SPRING.kc, rel=0.01)
    assert found["s1_eps_c"] == pytest.approx(SPRING.eps_c, rel=0.01)
    assert max(result.misfit.values()) < 5e-3
    # The balances use the motion at its own time.
    assert result.energy["absorbed_over_striker"] == pytest.approx(1.0, abs=0.02)
