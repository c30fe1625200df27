"""A result as lmfit's objects: report, correlations, and confidence intervals by lmfit alone."""

from dataclasses import replace

import lmfit
import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS, synthetic_impact, synthetic_loop


@pytest.fixture(scope="module")
def result():
    spring, test = synthetic_loop()
    stress = spring.stress(test.displacement / test.specimen.height)
    noise = 0.005 * np.ptp(stress) * np.random.default_rng(4).standard_normal(stress.size)
    return ff.fit(replace(test, stress=stress + noise), starts=4, intervals="profile")


def test_the_report_of_lmfit_has_the_numbers_of_the_fit(result):
    told = lmfit.fit_report(result.lmfit)
    for name, one in result.parameters.items():
        if one.stderr is not None:
            assert f"{name}:" in told
            assert result.lmfit.params[name].stderr == one.stderr
            assert result.lmfit.params[name].value == one.value
    assert f"chi-square         = {result.statistics['chisqr']:.6f}" in told
    assert "<table" in result.lmfit._repr_html_()
    residual = result.lmfit.residual
    assert float(residual @ residual) == pytest.approx(result.statistics["chisqr"], rel=1e-9)


def test_correlations_are_those_of_the_covariance(result):
    names, covar = result.lmfit.var_names, result.lmfit.covar
    stderr = np.sqrt(np.diag(covar))
    for i, name in enumerate(names):
        assert stderr[i] == pytest.approx(result.parameters[name].stderr)
        for j, other in enumerate(names):
            if i != j:
                expected = covar[i, j] / (stderr[i] * stderr[j])
                assert result.params[name].correl[other] == pytest.approx(expected)
    assert any(abs(one) > 0.3 for one in result.params["s1_k0"].correl.values())


def test_confidence_intervals_of_lmfit_are_the_profile_intervals(result):
    """lmfit profiles by MINPACK on the same residual; foamfit by its own refits."""
    names = ["s1_k0", "s1_eps_c", "s1_kh_minus"]
    found = lmfit.conf_interval(result.minimizer, result.lmfit, p_names=names, sigmas=[1.96])
    for name in names:
        low, high = result.parameters[name].ci95
        ends = [value for _, value in found[name]]
        assert [ends[0], ends[-1]] == pytest.approx([low, high], abs=0.03 * (high - low))


def test_a_parameter_at_its_limit_does_not_freeze_the_others():
    """With a dashpot at zero lmfit's intervals were up to 40 times too narrow."""
    test = synthetic_impact()[1]
    result = ff.fit(test, starts=4, intervals="local")
    assert result.parameters["s1_eta"].value == 0.0
    assert result.parameters["s1_eta"].vary
    one = result.parameters["s1_k0"]
    found = lmfit.conf_interval(result.minimizer, result.lmfit, p_names=["s1_k0"], sigmas=[1.96])
    ends = [value for _, value in found["s1_k0"]]
    assert ends[-1] - ends[0] == pytest.approx(3.92 * one.stderr, rel=0.4)
    with pytest.raises(ff.InputError, match="no effect beside params"):
        ff.fit(test, params=result.params, fix={"s1_k0": 4e6})
    with pytest.raises(ff.InputError, match="must be a number in SI"):
        ff.fit(test, fix={"s1_k0": "5.5 MPa"})


def test_a_result_read_back_has_the_same_objects(result, tmp_path):
    again = ff.load(result.save(tmp_path / "result", report=False))
    assert lmfit.fit_report(again.lmfit) == lmfit.fit_report(result.lmfit)
    first, second = (
        lmfit.conf_interval(one.minimizer, one.lmfit, p_names=["s1_k0"], sigmas=[1.0])
        for one in (result, again)
    )
    assert np.array(second["s1_k0"]) == pytest.approx(np.array(first["s1_k0"]), rel=1e-6)


def test_the_weights_due_to_a_noisy_motion_are_read_back(tmp_path):
    test = ff.read_test(EXPERIMENTS / "foam-1" / "model-2-2.0mps-reconstruction.csv")
    result = ff.fit(test, drive="displacement", starts=4, intervals="local")
    assert result.weighed_at
    again = ff.load(result.save(tmp_path / "result", report=False))
    residual = again.minimizer.userfcn(again.params)
    assert float(residual @ residual) == pytest.approx(result.statistics["chisqr"], rel=1e-9)


def test_an_undetermined_parameter_is_held():
    """Foam-1 is hit too softly to reach the unloading branch."""
    result = ff.fit(synthetic_impact(samples=201, velocity=0.4)[1], starts=4)
    lost = [n for n, one in result.parameters.items() if one.vary and one.stderr is None]
    assert lost
    assert not any(result.lmfit.params[name].vary for name in lost)
    lmfit.fit_report(result.lmfit)
