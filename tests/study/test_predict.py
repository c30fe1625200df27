"""Prediction of an unseen test: its curve, its band, and the refusals."""

import json
import re
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import foamfit as ff
from conftest import few_bytes, run, run_refused, synthetic_impact, write_measurement
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement, Noise, Specimen
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.problem import make_problem
from foamfit.report import prediction as prediction_report
from foamfit.study.identified import Population, read_source

HEIGHT, AREA, SIGMA = 10e-3, 5e-5, 1e3
LAW = {
    "s1_k0": 8e5, "s1_kc": 4e5, "s1_eps_star": 0.3, "s1_sigma_plus": 1.1e5, "s1_spread_plus": 0.4,
    "s1_sigma_minus": 7e4, "s1_spread_minus": 0.6,
}  # fmt: skip
DRAWS = 60


def loop(rate=0.25, seed=None, height=HEIGHT, noise=SIGMA, most=0.5, **changes) -> Measurement:
    """Return a triangular loop to a strain of `most` on a microscale spring, with seeded noise."""
    time = np.linspace(0.0, 1.0 / rate, 301)
    strain = 2.0 * most * (0.5 - np.abs(0.5 - rate * time))
    values = LAW | {f"s1_{name}": value for name, value in changes.items()}
    spring = ff.MicroscaleSpring(**{name[3:]: value for name, value in values.items()})
    stress = np.asarray(spring.stress(strain))
    if seed is not None:
        stress = stress + noise * np.random.default_rng(seed).standard_normal(stress.size)
    return Measurement(
        "held out", None, "0" * 64, time, stress, strain * height, Specimen(height, AREA),
        noise=Noise(noise, 1e-7), motion="measured",
    )  # fmt: skip


def fit_content(**changes) -> dict:
    """Return fit.json of a test at 0.25 1/s in which only sigma_plus is uncertain."""
    parameters = {
        name: {"value": value, "stderr": None, "ci95": None, "vary": False, "state": "fixed"}
        for name, value in LAW.items()
    }
    parameters["s1_sigma_plus"] |= {"stderr": 1e3, "vary": True, "state": "determined"}
    return {
        "schema": 1, "foamfit": "0", "test": "fitted", "model": "microscale", "relaxation": 0,
        "drive": "displacement", "status": "ok", "data": {"rate": 0.25}, "parameters": parameters,
        "misfit": {"stress_strain": 0.01}, "noise": {},
        "correlation": {"names": ["s1_sigma_plus"], "matrix": [[1.0]]},
    } | changes  # fmt: skip


def joint_content(parameters: dict, rates=(0.2, 0.3), misfit=None) -> dict:
    """Return joint.json of tests in which all but `parameters` are fixed."""
    held = {name: {"kind": "fixed", "value": value} for name, value in LAW.items()}
    tests = {f"t{i}": {"rate": rate, "misfit": misfit or {}} for i, rate in enumerate(rates)}
    return {
        "schema": 1, "name": "several", "model": "microscale", "relaxation": 0,
        "drive": "displacement", "status": "ok", "rate0": 0.25, "tests": tests,
        "parameters": held | parameters, "covariance": {"names": [], "matrix": []},
    }  # fmt: skip


def written(folder: Path, content: dict) -> Path:
    path = folder / ("joint.json" if "tests" in content else "fit.json")
    path.write_text(json.dumps(content))
    return path


def population(content: dict, folder: Path, test: Measurement | None = None) -> Population:
    source = read_source(written(folder, content))
    return Population(source, (test or loop()).specimen, 0.25)


# ------------------------------------------------------------------------------- the band


@pytest.fixture(scope="module")
def fitted():
    return ff.fit(loop(seed=99), model="microscale", starts=3, intervals="local")


def test_a_band_that_fails_is_told(fitted):
    def told(measurement):
        warned = ff.predict(fitted, measurement, draws=DRAWS).warnings
        return [one for one in warned if "of the samples of stress lie inside the 95 % band" in one]

    assert not told(loop(seed=1))
    [said] = told(loop(seed=1, sigma_plus=1.1 * LAW["s1_sigma_plus"]))
    assert "held out differs from" in said


def test_the_band_holds_held_out_noise(fitted):
    shares = [
        ff.predict(fitted, loop(seed=seed), draws=DRAWS).inside["stress_strain"]
        for seed in range(20)
    ]
    assert 0.93 < np.mean(shares) < 0.97


def test_the_fitted_record_is_driven_through_turns_between_its_samples(tmp_path):
    """As another record is, if its motion has no noise."""
    noise = {"stress_strain": {"motion_smoothed": False}}
    path = written(tmp_path, fit_content(noise=noise, data_sha256="0" * 64))
    few = {name: getattr(loop(), name)[1::2] for name in ("time", "stress", "displacement")}
    test = replace(loop(), noise=Noise(SIGMA, 1e-12), **few)
    other = replace(test, data_sha256="1" * 64)
    first, second = (ff.predict(path, one).curves["stress_strain"] for one in (test, other))
    assert np.array_equal(first.predicted, second.predicted)


def test_the_band_of_the_parameters_is_that_of_linearised_errors(fitted):
    found = ff.predict(fitted, loop(seed=1), draws=400)
    problem = make_problem(loop(), "microscale", None, None, None, interior_mass=False)
    names = fitted.correlation.names
    stderr = np.array([fitted.parameters[name].stderr for name in names])
    covariance = fitted.correlation.matrix * np.outer(stderr, stderr)
    slopes = problem.slopes(problem.vector(fitted.params), names)
    slopes /= problem.objective.factor("stress_strain")
    linear = 1.96 * np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
    drawn = found.curves["stress_strain"].parts["parameters"]
    assert np.linalg.norm(drawn - linear) < 0.15 * np.linalg.norm(linear)


def test_what_is_not_determined_leaves_the_band_as_wide_as_the_noise_does():
    """The mean variance at the fitted samples is σ²k/n, even if some directions are open."""
    short = loop(seed=99, most=0.1)
    result = ff.fit(short, model="microscale", starts=3, intervals="local")
    assert result.parameters["s1_kc"].state == "not determined"
    found = ff.predict(result, loop(seed=1, most=0.1))
    half = found.curves["stress_strain"].parts["parameters"]
    k, n = len(result.correlation.names), half.size
    assert np.sqrt(np.mean(half**2)) == pytest.approx(1.96 * SIGMA * (k / n) ** 0.5, rel=0.2)


def in_memory(content):
    return SimpleNamespace(content=content, to_json_dict=lambda: content)


def scatter(values):
    logs = np.log(values)
    mean, tau, n = float(np.exp(logs.mean())), float(logs.std(ddof=1)), len(values)
    item = {
        "kind": "scatter", "value": mean, "stderr": mean * tau / n**0.5, "scatter": tau,
        "tests": {f"t{i}": {"value": v} for i, v in enumerate(values)},
    }  # fmt: skip
    content = joint_content({"s1_sigma_plus": item}, [0.25] * n)
    content["covariance"] = {"names": ["s1_sigma_plus"], "matrix": [[item["stderr"] ** 2]]}
    return in_memory(content)


def own(values):
    item = {
        "kind": "own", "value": float(np.median(values)), "stderr": None,
        "tests": {f"t{i}": {"value": v} for i, v in enumerate(values)},
    }  # fmt: skip
    return in_memory(joint_content({"s1_sigma_plus": item}, [0.25] * len(values)))


@pytest.mark.parametrize("make", [scatter, own])
def test_the_band_holds_new_specimens(make):
    """Of 20 groups of eight specimens; sigma_plus is log-normal."""
    rng, shares = np.random.default_rng(5), []
    for group in range(20):
        values = 1.1e5 * np.exp(0.25 * rng.standard_normal(9))
        found = ff.predict(make(values[:-1]), loop(seed=group, sigma_plus=values[-1]), draws=DRAWS)
        shares.append(found.inside["stress_strain"])
    assert 0.90 < np.mean(shares) < 0.99


def scattering(n=5, **more):
    """Return joint.json of n specimens in which k0 and sigma_plus scatter by 20 % each."""
    logs = 0.2 * np.array([-1.0, -0.5, 0.0, 0.5, 1.0][:n])
    made = {
        name: {
            "kind": "scatter", "value": LAW[name], "stderr": 1e-3 * LAW[name], "scatter": 0.2,
            "tests": {f"t{i}": {"value": LAW[name] * np.exp(v)} for i, v in enumerate(logs)},
        }
        for name in ("s1_k0", "s1_sigma_plus")
    }  # fmt: skip
    return joint_content(made, [0.25] * n) | more


@pytest.mark.parametrize("together", [-0.99, 0.99])
def test_what_scatters_is_drawn_as_it_varies_together(tmp_path, together):
    names, matrix = ["s1_k0", "s1_sigma_plus"], [[1.0, together], [together, 1.0]]
    content = scattering(specimens={"names": names, "correlation": matrix})
    drawn = islice(population(content, tmp_path).draws(0), 400)
    logs = np.log([one[[0, 3]] for one in drawn])
    ranks = np.argsort(np.argsort(logs, axis=0), axis=0)
    assert np.corrcoef(ranks.T)[0, 1] == pytest.approx(together, abs=0.03)


def test_a_stiffer_specimen_is_not_taken_for_one_that_is_touched_earlier():
    stiffer = replace(loop(seed=0, k0=1.2 * LAW["s1_k0"], sigma_plus=1.3e5), contact="motion")
    found = ff.predict(in_memory(scattering()), stiffer, draws=DRAWS)
    assert found.aligned["displacement_zero"] == pytest.approx(0.0, abs=1e-3 * HEIGHT)
    assert found.inside["stress_strain"] > 0.9


def test_what_the_law_missed_before_is_in_the_band():
    content = fit_content(misfit={"stress_strain": 0.05})
    content["noise"] = {"stress_strain": {"sigma": 3e3, "range": 1e5}}
    curve = ff.predict(in_memory(content), loop(seed=0), draws=DRAWS).curves["stress_strain"]
    assert curve.parts["law_error"] == pytest.approx(
        1.96 * (0.05**2 - 0.03**2) ** 0.5 * np.ptp(curve.predicted), rel=1e-4
    )
    assert np.all(curve.hi - curve.lo > 2 * curve.parts["law_error"])


def test_the_error_of_the_law_grows_after_the_last_fitted_cycle():
    time = np.linspace(0.0, 16.0, 1201)
    strain = 0.5 - np.abs(0.5 - 0.25 * (time % 4.0))
    four = replace(
        loop(), time=time, displacement=strain * HEIGHT, cycle=1, cycles=(1, 2, 3, 4), last_cycle=4,
        stress=np.asarray(ff.MicroscaleSpring(**{n[3:]: v for n, v in LAW.items()}).stress(strain)),
    )  # fmt: skip
    content = fit_content(statistics={"cycle_growth": 0.5})
    for fitted in ({"last_cycle": 2}, {"cycle": 2, "last_cycle": None}):
        content["data"] |= fitted
        found = ff.predict(in_memory(content), four)
        law = found.curves["stress_strain"].parts["law_error"]
        widths = np.array([law[part].mean() for part in cycles_of(four).values()])
        assert widths / widths[0] == pytest.approx([1.0, 1.0, 1.5**0.5, 2.0**0.5])


# ------------------------------------------------------------------------------- the parameters


def test_what_is_not_determined_is_held_and_narrows_what_is_correlated_with_it(tmp_path):
    content = fit_content()
    content["parameters"]["s1_k0"] |= {"vary": True, "state": "not determined"}
    content["correlation"] = {
        "names": ["s1_k0", "s1_sigma_plus"], "matrix": [[1.0, 0.8], [0.8, 1.0]]
    }  # fmt: skip
    known = population(content, tmp_path)
    assert known.held == ("s1_k0",)
    assert known.covariance[0, 0] == 0.0
    assert known.covariance[3, 3] ** 0.5 == pytest.approx(0.6 * 1e3)
    found = ff.predict(in_memory(content), loop(seed=0), draws=DRAWS)
    assert any("s1_k0 is fixed at its value" in one for one in found.warnings)


def test_what_has_a_range_lies_anywhere_in_it(tmp_path):
    content = fit_content()
    content["parameters"]["s1_k0"] |= {"vary": True, "range": [4e5, 1.6e6]}
    known = population(content, tmp_path)
    assert known.held == ()
    assert known.covariance[0, 0] ** 0.5 == pytest.approx(8e5 * np.log(4.0) / 12**0.5)


def test_draws_that_are_not_admissible_are_drawn_again_and_counted():
    values = np.exp(0.5 * np.linspace(-1.0, 1.0, 5))
    content = own(1.1e5 * values).content
    item = content["parameters"].pop("s1_sigma_plus")
    content["parameters"] |= {"s1_sigma_plus": {"kind": "fixed", "value": 1.1e5}}
    tests = {name: {"value": 0.01 * v} for name, v in zip(item["tests"], values, strict=True)}
    content["parameters"]["s1_eps_star"] = item | {"value": 0.01, "tests": tests}
    content["parameters"]["s1_kc"]["value"] = 1.036 * LAW["s1_k0"]
    found = ff.predict(in_memory(content), loop(seed=0, eps_star=0.01), draws=DRAWS)
    assert found.draws == DRAWS
    assert 0.4 * DRAWS < found.redrawn < 1.6 * DRAWS  # about one draw in two
    low, _ = found.parameters["s1_eps_star"].ci95
    assert low >= 0.008  # below, branch c would precede branch a
    assert found.to_json_dict()["redrawn"] == found.redrawn


def test_draws_that_are_never_admissible_are_refused():
    content = fit_content()
    content["parameters"]["s1_kc"] |= {"value": 4e9}  # eps_star = 0.3 is too small for it
    with pytest.raises(SimulationError, match="fitted: neither its common values"):
        ff.predict(in_memory(content), loop(seed=0), draws=DRAWS)


def test_medians_that_are_no_spring_give_way_to_the_nearest_test():
    values = {"s1_k0": (8e5, 8e5, 8e5), "s1_kc": (4e5, 8e7, 9e7), "s1_eps_star": (0.1, 0.9, 0.2)}
    made = {
        name: {
            "kind": "own", "value": float(np.median(each)),
            "tests": {f"t{i}": {"value": v} for i, v in enumerate(each)},
        }
        for name, each in values.items()
    }  # fmt: skip
    found = ff.predict(in_memory(joint_content(made, [0.25] * 3)), loop(seed=0), draws=DRAWS)
    assert found.parameters["s1_kc"].value == pytest.approx(8e7)
    assert found.parameters["s1_eps_star"].value == pytest.approx(0.9)
    assert any("nearest" in one for one in found.warnings)


# ------------------------------------------------------------------------------- the test


def test_specimen_and_motion_are_those_of_the_new_test():
    thicker = loop(seed=0, height=2 * HEIGHT)
    found = ff.predict(in_memory(fit_content()), thicker, draws=DRAWS)
    clean = loop(height=2 * HEIGHT).stress
    assert found.curves["stress_strain"].predicted == pytest.approx(clean, rel=1e-6, abs=1.0)


def test_mass_and_velocity_are_those_of_the_new_test():
    spring, slow = synthetic_impact(1.75)
    content = fit_content(model="bistable", drive="impact", data={"rate": 1100.0})
    content["parameters"] = {
        f"s1_{name}": {"value": getattr(spring, name), "stderr": None, "vary": False}
        for name in ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")
    }
    content |= {"correlation": None, "misfit": {}}
    found = ff.predict(in_memory(content), slow, draws=DRAWS)
    assert set(found.curves) == {"stress_time", "displacement_time"}
    assert found.misfit["stress_time"] == pytest.approx(0.01, rel=0.1)  # its noise
    assert 0.93 < found.inside["displacement_time"] < 0.97


def test_heights_of_a_chain_keep_their_shares():
    content = fit_content(model="linear+linear")
    content |= {"correlation": {"names": ["s1_height"], "matrix": [[1.0]]}}
    item = {"stderr": None, "vary": False}
    content["parameters"] = {
        "s1_k0": item | {"value": 1e6}, "s2_k0": item | {"value": 4e5},
        "s1_height": item | {"value": 4e-3, "vary": True, "stderr": 1e-4},
        "s2_height": item | {"value": 6e-3},
    }  # fmt: skip
    found = ff.predict(in_memory(content), loop(seed=0, height=2 * HEIGHT), draws=DRAWS)
    first, second = (found.parameters[f"s{i}_height"] for i in (1, 2))
    assert (first.value, second.value) == pytest.approx((8e-3, 12e-3))
    assert first.ci95[1] + second.ci95[0] == pytest.approx(2 * HEIGHT)
    assert first.ci95[1] > 8.2e-3


def test_a_law_of_rate_is_taken_at_the_rate_of_the_test():
    for kind, factor in (("power rate", 2**0.3), ("log rate", 1 + 0.3 * np.log(2))):
        item = {"kind": kind, "value": 1.1e5, "stderr": 1e3, "b": 0.3, "b_stderr": 0.01}
        content = joint_content({"s1_sigma_plus": item}, (0.05, 1.0))
        content["covariance"] = {
            "names": ["s1_sigma_plus", "s1_sigma_plus:b"], "matrix": [[1e6, 0.0], [0.0, 1e-4]]
        }  # fmt: skip
        found = ff.predict(in_memory(content), loop(rate=0.5, seed=0), draws=DRAWS)
        assert found.parameters["s1_sigma_plus"].value == pytest.approx(1.1e5 * factor, rel=5e-3)
        clean = loop(sigma_plus=found.parameters["s1_sigma_plus"].value).stress
        by_motion = LAW["s1_k0"] * 1e-7 / HEIGHT  # Pa, of the motion's noise, which is smoothed
        assert found.curves["stress_strain"].predicted == pytest.approx(clean, abs=by_motion)


def test_a_law_of_rate_needs_a_rate():
    content = joint_content({"s1_sigma_plus": {"kind": "power rate", "value": 1.1e5, "b": 0.3}})
    with pytest.raises(InputError, match="s1_sigma_plus follows a rate law, but the rate of"):
        ff.predict(in_memory(content), replace(loop(), time=None), draws=DRAWS)


# ------------------------------------------------------------------------------- refusals


def test_a_rate_outside_the_fitted_ones_is_refused_unless_it_is_wanted():
    content = in_memory(joint_content({}, (0.05, 0.3)))
    assert not ff.predict(content, loop(rate=0.35, seed=0), draws=DRAWS).extrapolated
    with pytest.raises(InputError) as refused:
        ff.predict(content, loop(rate=0.5, seed=0), draws=DRAWS)
    for word in ("0.5 1/s", "0.05 to 0.3 1/s", "--extrapolate"):
        assert word in str(refused.value)
    found = ff.predict(content, loop(rate=0.5, seed=0), extrapolate=True, draws=DRAWS)
    assert found.extrapolated
    assert "Extrapolation: its rate, 0.5 1/s" in found.text().replace("\n  ", " ")
    told = found.to_json_dict()
    assert told["extrapolated"]
    assert any("Extrapolation" in one for one in told["warnings"])


def test_a_drive_that_the_test_cannot_feed_is_named_with_the_way_out():
    content = fit_content(drive="impact")
    with pytest.raises(InputError, match=r"impact drive needs .* --drive"):
        ff.predict(in_memory(content), loop(seed=0), draws=DRAWS)
    found = ff.predict(in_memory(content), loop(seed=0), drive="displacement", draws=DRAWS)
    assert any("fitted in the impact drive" in one for one in found.warnings)


def without(content, *keys):
    *path, last = keys
    for key in path:
        content = content[key]
    del content[last]


BROKEN = {
    "no_model": (lambda c: without(c, "model"), "not the result of a fit"),
    "schema": (lambda c: c.update(schema=7), "schema 7"),
    "model": (lambda c: c.update(model="rubber"), "'rubber' is not a spring"),
    "drive": (lambda c: c.update(drive="gravity"), "drive is 'gravity'"),
    "parameter": (lambda c: without(c, "parameters", "s1_kc"), "no parameter s1_kc"),
    "value": (lambda c: c["parameters"]["s1_kc"].update(value=None), "s1_kc: value is nan"),
    "item": (lambda c: c["parameters"].update(s1_kc=4.0), "parameter s1_kc: "),
    "unknown": (lambda c: c["parameters"].update(s9_k0={"value": 1.0}), "s9_k0 is not a parameter"),
    "stderr": (lambda c: c["parameters"]["s1_kc"].update(stderr=-1.0), "stderr is -1.0"),
    "ci95": (lambda c: c["parameters"]["s1_kc"].update(ci95=[1.0]), "parameter s1_kc: "),
    "matrix": (lambda c: c["correlation"].update(matrix=[[1.0, 0.0]]), "cannot reshape"),
    "names": (lambda c: c["correlation"].update(names=["s1_zeta"]), "correlation contains s1_zeta"),
}


JOINT_BROKEN = {
    "kind": ({"kind": "mine", "value": 1e5}, "kind is 'mine'"),
    "tests": ({"kind": "own", "value": 1e5}, "s1_kc: tests is missing"),
    "scatter": ({"kind": "scatter", "value": 1e5, "tests": {}}, "scatter is missing"),
    "b": ({"kind": "log rate", "value": 1e5}, "b is missing"),
}


@pytest.mark.parametrize(
    ("change", "words"), [*BROKEN.values(), *JOINT_BROKEN.values()], ids=[*BROKEN, *JOINT_BROKEN]
)
def test_a_broken_result_is_refused_by_its_key(tmp_path, change, words):
    content = joint_content({"s1_kc": change}) if isinstance(change, dict) else fit_content()
    if callable(change):
        change(content)
    with pytest.raises(InputError, match=re.escape(words)) as refused:
        ff.predict(written(tmp_path, content), loop(seed=0), draws=DRAWS)
    assert "\n" not in str(refused.value)


def test_what_is_no_result_is_refused(tmp_path):
    path = tmp_path / "fit.json"
    for text, words in (
        ("", "valid JSON"), ("{", "valid JSON"), ("[1, 2]", "the result of a fit"),
        ('{"name": "package"}', "the result of a fit"), ("\udc80", "valid JSON"),
    ):  # fmt: skip
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(InputError, match=rf"fit\.json is not {words}"):
            ff.predict(tmp_path, loop(seed=0))
    with pytest.raises(InputError, match="or its path, not int"):
        ff.predict(3, loop(seed=0))
    path.unlink()
    with pytest.raises(InputError, match="is not a result folder"):
        ff.predict(tmp_path, loop(seed=0))
    (tmp_path / "cycle-1").mkdir()
    (tmp_path / "cycle-1" / "fit.json").write_text("{}")
    with pytest.raises(InputError, match=r"contains 1 fit; name one, like .*cycle-1"):
        ff.predict(tmp_path, loop(seed=0))


# ------------------------------------------------------------------------------- files


def test_file_and_memory_give_the_same_numbers(tmp_path, fitted):
    path = written(tmp_path, json.loads(json.dumps(fitted.to_json_dict())))
    there, here = (ff.predict(one, loop(seed=3), draws=DRAWS) for one in (path, fitted))
    assert there.to_json_dict() == here.to_json_dict()
    for name in ("lo", "hi", "predicted"):
        one, other = (getattr(p.curves["stress_strain"], name) for p in (there, here))
        assert np.array_equal(one, other)
    folder = ff.predict(tmp_path, loop(seed=3), draws=DRAWS)
    assert folder.to_json_dict() == here.to_json_dict()
    assert here.fitted_rates == pytest.approx((0.25,), rel=0.01)


STATED = f'[noise]\nstress = "{SIGMA} Pa"\n'


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    """Four tests fitted jointly: one parameter scatters, one follows a rate law, one is own."""
    here = tmp_path_factory.mktemp("family")
    for i, rate in enumerate((0.01, 0.03, 0.3, 1.0)):
        test = loop(rate=rate, seed=i, sigma_plus=1.1e5 * (rate / 0.1) ** 0.05, kc=4e5 + 2e4 * i)
        write_measurement(here / f"t{i}.csv", test, STATED)
    kinds = dict.fromkeys(LAW, "shared") | {"s1_kc": "scatter", "s1_sigma_plus": "power rate"}
    kinds |= {"s1_sigma_minus": "own"}
    (here / "study.toml").write_text(
        'tests = ["t*.csv"]\nmodel = "microscale"\ndrive = "displacement"\nstarts = 1\n'
        "[parameters]\n" + "\n".join(f'{name} = "{kind}"' for name, kind in kinds.items())
    )
    return ff.joint(here / "study.toml")


def test_a_joint_fit_predicts_a_rate_between_its_own(tmp_path, joint):
    test = loop(rate=0.1, seed=9, kc=4.3e5)
    found = ff.predict(joint, test, draws=DRAWS)
    assert found.parameters["s1_sigma_plus"].value == pytest.approx(1.1e5, rel=0.02)
    assert {one.kind for one in found.parameters.values()} >= {
        "shared", "own", "scatter", "power rate", "fixed"
    }  # fmt: skip
    assert 0.9 < found.inside["stress_strain"] <= 1.0
    assert found.curves["stress_strain"].half_width_of("scatter") > 0.0
    path = written(tmp_path, json.loads(json.dumps(joint.to_json_dict())))
    assert ff.predict(path, test, draws=DRAWS).to_json_dict() == found.to_json_dict()
    with pytest.raises(InputError, match=r"10 1/s, lies outside .* 0\.01 to 1 1/s"):
        ff.predict(tmp_path, loop(rate=10.0, seed=9))


@pytest.fixture
def record(tmp_path) -> Path:
    """Write a test as an instrument would, and its TOML; return the path of the test."""
    return write_measurement(tmp_path / "other.csv", loop(seed=4), STATED)


@pytest.fixture
def result(tmp_path) -> Path:
    (tmp_path / "result").mkdir()
    return written(tmp_path / "result", fit_content()).parent


def test_the_command_writes_a_folder_whole(here, record, result):
    done = run("predict", result, record, "--draws", DRAWS)
    assert done.stderr == ""
    assert "inside the 95 % band" in done.stdout
    folder = here / "predictions/other" / f"{here.name}-result"
    assert {path.name for path in folder.iterdir()} == {
        f"prediction.{form}" for form in ("json", "csv", "png", "pdf")
    }
    told = json.loads((folder / "prediction.json").read_text())
    assert told["test"] == "other"
    assert {"kind", "value", "ci95", "unit"} <= told["parameters"]["s1_k0"].keys()
    columns = pd.read_csv(folder / "prediction.csv")
    low, high = (columns[f"stress band {end} (Pa)"] for end in ("low", "high"))
    measured = columns["measured stress (Pa)"]
    inside = np.mean((low <= measured) & (measured <= high))
    assert inside == pytest.approx(told["inside"]["stress_strain"])
    assert "stress half width, law error (Pa)" in columns


def test_the_command_replaces_predictions_and_nothing_else(tmp_path, monkeypatch, record, result):
    monkeypatch.setattr(prediction_report.figures, "write_both", few_bytes)
    before = (result / "fit.json").read_bytes()
    told = run_refused("predict", result, record, "--out", result, "--draws", DRAWS)
    assert "holds fit.json, which does not belong to a prediction" in told
    assert (result / "fit.json").read_bytes() == before
    out = tmp_path / "out"
    for seed in (0, 1):
        words = ("--out", out, "--draws", DRAWS, "--seed", seed, "--json")
        done = run("predict", result, record, *words)
    told = json.loads((out / "prediction.json").read_text())
    assert json.loads(done.stdout) == told
    assert told["seed"] == 1
