"""Effect of the ± of the TOML on the parameters, compared with exact scalings and refits."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import foamfit as ff
from conftest import AREA, HEIGHT, loop_measurement, synthetic_impact, synthetic_loop, write_csv
from foamfit.data.measurement import Measurement, Specimen
from foamfit.fitting.problem import make_problem
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import responses

STRESSES = ("s1_k0", "s1_kc", "s1_dsigma", "s1_kh_plus", "s1_kh_minus")
STRAINS = ("s1_eps_a", "s1_eps_c")
MICRO = ff.MicroscaleSpring(4.4e5, 4.9e5, 0.29, 1.06e5, 0.44, 6e4, 0.7)


def fitted(test: Measurement, **more: Any) -> ff.FitResult:
    return ff.fit(test, starts=2, intervals="local", **{"model": "bistable"} | more)


def moved(best: BestPoint, quantity: str, name: str) -> float:
    """Return the relative change of a parameter for one standard deviation of a quantity."""
    return float(responses(best)[quantity][best.index[name]] / best.values[best.index[name]])


@pytest.fixture(scope="module")
def loop() -> BestPoint:
    """Best point of a displacement-driven loop without time."""
    _, test = synthetic_loop()
    one = test.specimen
    test = replace(
        test,
        uncertainties={
            "area": 0.01 * one.area, "stress_scale": 0.02, "height": 0.01 * one.height,
            "displacement_scale": 0.01,
        },
    )  # fmt: skip
    found = fitted(test)
    problem = make_problem(test, "bistable", None, None, None, interior_mass=False)
    values = problem.vector()
    for name in problem.model.names:
        values[problem.index[name]] = found.parameters[name].value
    return BestPoint(problem, values)


@pytest.mark.parametrize(("quantity", "share"), [("area", -0.01), ("stress_scale", 0.02)])
def test_area_and_scale_of_the_force_scale_all_stresses(loop, quantity, share):
    for name in STRESSES:
        assert moved(loop, quantity, name) == pytest.approx(share, rel=1e-4)
    for name in STRAINS:
        assert moved(loop, quantity, name) == pytest.approx(0.0, abs=1e-8)


def test_height_and_scale_of_the_motion_are_one_and_the_same_strain(loop):
    """A strain is a displacement divided by a height, so only the ratio of the two matters."""
    for name in (*STRESSES, *STRAINS):
        one, other = (moved(loop, q, name) for q in ("height", "displacement_scale"))
        assert one == pytest.approx(-other, rel=1e-3)


def written(folder: Path, *, height: str, area: str, velocity: str = "2 m/s", mass: str = "7 g",
            noise: float = 1e-4) -> Path:  # fmt: skip
    """Write the same impact as a CSV file of force and motion, with its TOML."""
    _, test = synthetic_impact(noise=noise)
    columns = test.time * 1e3, test.stress * AREA, test.displacement * 1e3
    head = "time (ms),force (N),displacement (mm)"
    toml = f'[specimen]\nheight = "{height}"\narea = "{area}"\n'
    toml += f'[striker]\nmass = "{mass}"\nvelocity = "{velocity}"\n'
    return write_csv(folder / "impact.csv", head, *columns, fmt="%.12g", toml=toml)


SIZE = {"height": f"{HEIGHT * 1e3:.12g} mm", "area": f"{AREA * 1e6:.12g} mm^2"}


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> ff.FitResult:
    """Fit of the impact whose TOML states no ±."""
    return fitted(ff.read_test(written(tmp_path_factory.mktemp("plain"), **SIZE)))


@pytest.fixture(scope="module")
def stated(tmp_path_factory) -> ff.FitResult:
    """Fit of the same impact with an uncertainty of 3 % in the area."""
    size = SIZE | {"area": SIZE["area"] + " ± 3 %"}
    return fitted(ff.read_test(written(tmp_path_factory.mktemp("stated"), **size)))


@pytest.mark.parametrize("quantity", ["height", "area"])
def test_what_a_fit_of_the_changed_toml_gives(tmp_path, quantity):
    """`systematic` for ± 0.5 % equals the change when the value in the file is 0.5 % larger."""
    value, unit = SIZE[quantity].split()
    stated = ff.read_test(written(tmp_path, **SIZE | {quantity: f"{value} {unit} ± 0.5 %"}))
    first = fitted(stated)
    larger = f"{1.005 * float(value):.12g} {unit}"
    again = fitted(ff.read_test(written(tmp_path, **SIZE | {quantity: larger})))
    for name in (*STRESSES, *STRAINS):
        one, other = first.parameters[name], again.parameters[name]
        change = abs(other.value - one.value)
        # Samples at switches cause neighbouring minima that differ by 0.1 standard errors.
        assert one.systematic == pytest.approx(change, rel=0.05, abs=0.2 * one.stderr), name
        assert first.budget.contributions[name][quantity] == one.systematic
    if quantity == "area":
        for name in STRESSES:
            assert first.parameters[name].systematic == pytest.approx(
                0.005 * abs(first.parameters[name].value), rel=1e-3
            )


def test_what_the_toml_does_not_state_is_in_no_parameter(plain):
    assert {p.systematic for p in plain.parameters.values()} == {0.0}
    assert set(plain.budget.sources) <= {"noise", "contact and zero", "law"}


def test_systematic_is_in_no_interval(plain, stated):
    for name in (*STRESSES, *STRAINS):
        assert stated.parameters[name].ci95 == pytest.approx(plain.parameters[name].ci95)
        assert stated.parameters[name].stderr == pytest.approx(plain.parameters[name].stderr)


def test_velocity_and_mass_with_a_deviation_are_fitted_within_it(tmp_path):
    """Both TOML values are wrong by less than their ±; the record corrects them."""
    path = written(tmp_path, **SIZE, velocity="1.98 ± 0.03 m/s", mass="7.05 ± 0.1 g", noise=0.003)
    result = fitted(ff.read_test(path))
    assert result.statistics["n_data"] == 2 * result.curves.time.size  # a prior is no sample
    velocity, mass = (result.parameters[name] for name in ("velocity", "striker_mass"))
    assert velocity.state == mass.state == "determined"
    assert velocity.value == pytest.approx(2.0, abs=3.0 * velocity.stderr)
    assert mass.value == pytest.approx(7e-3, abs=3.0 * mass.stderr)
    assert velocity.stderr < 0.015
    assert velocity.systematic == mass.systematic == 0.0
    for name in STRESSES:
        assert result.budget.contributions[name]["velocity"] > 0.0
        assert result.budget.contributions[name]["mass"] == 0.0


def test_a_force_that_is_mass_times_acceleration_does_not_tell_the_mass(tmp_path):
    """Every stress is then exactly proportional to the mass, which is therefore not fitted."""
    path = written(tmp_path, **SIZE, mass="7 g ± 1 %")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table[:, 1] /= 7e-3
    header = "time (ms),acceleration (m/s^2),displacement (mm)"
    np.savetxt(path, table, "%.12g", ",", header=header, comments="")
    result = fitted(ff.read_test(path))
    assert "striker_mass" not in result.parameters
    for name in STRESSES:
        one = result.parameters[name]
        assert one.systematic == pytest.approx(0.01 * abs(one.value), rel=1e-3)
    for name in STRAINS:
        assert result.parameters[name].systematic < 1e-6


def test_the_parts_of_the_noise_add_up_to_the_standard_error():
    _, test = synthetic_impact()
    test = replace(test, uncertainties={"velocity": 0.02, "area": 0.01 * AREA})
    result = fitted(test)
    for name, row in result.budget.contributions.items():
        parts = [row[source] for source in ("noise", "contact and zero", "velocity")]
        assert all(part > 0.0 for part in parts), name
        assert math.hypot(*parts) == pytest.approx(result.parameters[name].stderr)
        assert result.budget.combined(name) == pytest.approx(math.hypot(*parts, row["area"]))


def test_heights_of_a_chain(tmp_path):
    """The ± of one spring's height affects this spring, the ± of the total height all others."""
    time = np.linspace(0.0, 1.0, 201)
    motion = 4e-3 * np.sin(np.pi * time)
    chain = ff.Chain([ff.LinearSpring(2e6), MICRO], [4e-3, 6e-3], AREA)
    stress = ff.simulate(chain, ff.DisplacementDrive(motion), time).base_stress
    stress += 50.0 * np.random.default_rng(0).standard_normal(time.size)
    test = loop_measurement(stress, motion, Specimen(0.01, AREA, heights=(4e-3, 6e-3)), time)
    test = replace(test, uncertainties={"height": 1e-4, "height_1": 4e-5})
    problem = make_problem(
        test, "linear+microscale", "displacement", None, None, interior_mass=False
    )
    values = problem.vector()
    values[:2], values[2:10] = [2e6, 0.0], MICRO.values
    found = responses(best := BestPoint(problem, values))
    assert found["height_1"][best.index["s1_height"]] == pytest.approx(4e-5)
    assert found["height_1"][best.index["s2_height"]] == 0.0
    assert found["height"][best.index["s1_height"]] == 0.0
    assert found["height"][best.index["s2_height"]] == pytest.approx(6e-5)
    # A change in height of a linear spring is compensated by its stiffness.
    assert moved(best, "height_1", "s1_k0") == pytest.approx(0.01, rel=2e-3)
    assert moved(best, "height_1", "s2_k0") == pytest.approx(0.0, abs=2e-5)
