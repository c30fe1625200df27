"""The fit: recovery, repeatability, states, fixed values, and being stopped."""

from __future__ import annotations

from dataclasses import replace

import lmfit
import numpy as np
import pytest

import foamfit as ff
from conftest import DATA, needs_data, synthetic_impact, synthetic_loop
from foamfit import search
from foamfit.identification import make_params
from foamfit.measurement import Noise

NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus")


@pytest.fixture(scope="module")
def impact_fit():
    return ff.fit(synthetic_impact()[1], seed=0)


def test_an_impact_is_recovered_within_three_standard_errors(impact_fit):
    spring, _ = synthetic_impact()
    for name, true in zip(NAMES, spring.seven, strict=True):
        item = impact_fit.parameters[f"s1_{name}"]
        assert abs(item.value - true) <= 3 * item.stderr, name
        assert item.state in ("determined", "weak")
    assert impact_fit.statistics["redchi"] == pytest.approx(1.0, abs=0.15)
    assert impact_fit.status in ("ok", "warnings")
    assert impact_fit.visited == {"s1": ("a", "d", "c", "e")}


def test_the_result_speaks_lmfit(impact_fit):
    assert isinstance(impact_fit.params, lmfit.Parameters)
    item = impact_fit.parameters["s1_kc"]
    assert impact_fit.params["s1_kc"].value == item.value
    assert impact_fit.params["s1_kc"].stderr == item.stderr
    assert impact_fit.chain.springs[0].kc == item.value


def test_same_test_and_seed_give_the_same_numbers(impact_fit):
    again = ff.fit(synthetic_impact()[1], seed=0)
    assert again.params.valuesdict() == impact_fit.params.valuesdict()
    assert again.statistics == impact_fit.statistics


def test_a_loop_without_time_is_fitted_in_the_displacement_drive():
    spring, measurement = synthetic_loop()
    result = ff.fit(measurement)
    assert result.drive == "displacement"
    assert result.misfit["stress_strain"] < 0.006
    assert result.misfit["displacement_time"] is None
    assert result.parameters["s1_kc"].value == pytest.approx(spring.kc, rel=0.05)


def test_the_stress_drive_fits_the_displacement():
    _, measurement = synthetic_loop()
    result = ff.fit(measurement, drive="stress")
    assert result.misfit["stress_time"] is None
    assert result.misfit["stress_strain"] < 0.02


def test_a_branch_that_was_never_reached_is_not_determined():
    _, measurement = synthetic_impact(velocity=1.75)
    result = ff.fit(measurement)
    assert result.visited["s1"] == ("a", "d")
    for name in ("kc", "eps_c", "dsigma", "kh_minus"):
        item = result.parameters[f"s1_{name}"]
        assert (item.state, item.stderr, item.ci95) == ("not determined", None, None)
        assert "branch" in item.why
    for name in ("k0", "eps_a", "kh_plus"):
        assert result.parameters[f"s1_{name}"].state == "determined"
    assert result.status == "warnings"


def test_fixed_values_bounds_and_expressions_are_kept():
    spring, measurement = synthetic_impact()
    params = make_params(measurement)
    params["s1_k0"].set(value=spring.k0, vary=False)
    params["s1_kc"].set(expr="15 * s1_k0")
    params["s1_eps_c"].set(max=0.305)
    result = ff.fit(measurement, params=params)
    assert result.params["s1_k0"].value == spring.k0
    assert result.params["s1_kc"].value == pytest.approx(15 * spring.k0, rel=1e-12)
    assert result.params["s1_eps_c"].value <= 0.305
    assert result.parameters["s1_k0"].state == "fixed"
    assert result.parameters["s1_eps_c"].state == "weak"  # the true value lies past the bound


def test_the_best_point_survives_the_time_limit():
    result = ff.fit(synthetic_impact()[1], max_time=0.02)
    assert "time limit" in result.warnings[0]
    assert np.isfinite(result.misfit["stress_time"])


def test_the_best_point_survives_ctrl_c(monkeypatch):
    _, measurement = synthetic_impact()
    calls = 0
    original = search.descend

    def interrupted(*args):
        nonlocal calls
        calls += 1
        if calls == 12:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(search, "descend", interrupted)
    result = ff.fit(measurement)
    assert "Ctrl-C" in result.warnings[0]
    assert result.misfit["stress_time"] < 0.05


def test_a_test_that_no_spring_can_follow_fails_honestly():
    _, measurement = synthetic_loop()
    rng = np.random.default_rng(0)
    noise = np.abs(rng.standard_normal(measurement.stress.size)) * 1e6
    result = ff.fit(replace(measurement, stress=noise))
    assert result.status == "failed"
    assert any("not acceptable" in warning for warning in result.warnings)


def test_without_stated_noise_the_errors_come_from_the_residuals():
    _, measurement = synthetic_impact()
    stated = ff.fit(measurement)
    guessed = ff.fit(replace(measurement, noise=Noise()))
    for name in ("s1_kc", "s1_eps_c", "s1_kh_plus"):
        ratio = guessed.parameters[name].stderr / stated.parameters[name].stderr
        assert 0.7 < ratio < 1.4, name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"starts": 0}, "starts = 0"),
        ({"max_time": -1.0}, "max_time"),
        ({"model": "rubber"}, "rubber"),
        ({"drive": "sideways"}, "sideways"),
        ({"params": lmfit.create_params(s2_k0=1.0)}, "s2_k0"),
    ],
)
def test_wrong_calls_are_refused(options, message):
    with pytest.raises(ff.InputError, match=message):
        ff.fit(synthetic_loop()[1], **options)


FOAMS = {
    "turbo-comp-1": (7.63, 10.53),
    "leap-comp-2": (7.62, 10.65),
    "new-heel-comp-1": (7.67, 9.90),
}


@needs_data
@pytest.mark.parametrize("name", FOAMS)
def test_one_spring_follows_the_first_cycle_of_a_shoe_foam(name, tmp_path):
    """Measurements of arXiv:2602.12694; a global search by brute force reaches 0.029-0.032."""
    diameter, height = FOAMS[name]
    toml = tmp_path / "foam.toml"
    toml.write_text(f'[specimen]\nheight = "{height} mm"\ndiameter = "{diameter} mm"\n')
    measurement = ff.read_test(DATA / "shoe-foam" / f"{name}_cycle1.csv", toml)
    result = ff.fit(measurement)
    assert result.drive == "displacement"
    assert result.misfit["stress_strain"] <= 0.035
