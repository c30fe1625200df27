"""The fit: recovery, repeatability, states, fixed values and interruption."""

from dataclasses import replace

import lmfit
import numpy as np
import pytest

import foamfit as ff
import rig
from conftest import (
    DATA,
    NAMES,
    RECONSTRUCTION,
    loop_measurement,
    needs_data,
    specimen_toml,
    synthetic_impact,
    synthetic_loop,
    thinned,
)
from foamfit.data.measurement import Specimen
from foamfit.fitting import levenberg
from foamfit.fitting.problem import make_params, make_problem


def test_an_impact_is_recovered_within_three_standard_errors():
    spring, measurement = synthetic_impact(samples=201)
    impact_fit = ff.fit(measurement, starts=4)
    for name, true in zip(NAMES, spring.seven, strict=True):
        item = impact_fit.parameters[f"s1_{name}"]
        assert abs(item.value - true) <= 3 * item.stderr, name
        assert item.state in ("determined", "weak")
    assert impact_fit.statistics["redchi"] == pytest.approx(1.0, abs=0.15)
    assert 1 < impact_fit.statistics["n_agreeing"] <= impact_fit.statistics["n_descents"]
    assert impact_fit.status in ("ok", "warnings")
    assert impact_fit.visited == {"s1": ("a", "d", "c", "e")}


def test_a_branch_may_be_moved_by_a_parameter_that_is_not_determined():
    """Branch c fixes eps_star alone; at one eps_c 16 of 25 intervals of kc contained the truth."""
    spring, off = ff.published["foam-1/model-1"].bistable, []
    strain = np.linspace(0.0, 0.38, 200)
    for seed in range(8):
        noise = 0.01 * np.ptp(spring.stress(strain)) * np.random.default_rng(seed).normal(size=200)
        loading = spring.stress(strain) + noise, strain * 1e-3, Specimen(1e-3, 2e-5)
        result = ff.fit(loop_measurement(*loading), intervals="local")
        assert result.parameters["s1_eps_c"].state == "not determined"
        kc = result.parameters["s1_kc"]
        off.append((kc.value - spring.kc) / kc.stderr)
    assert np.sqrt(np.mean(np.square(off))) < 1.7


def test_a_branch_that_was_never_reached_is_not_determined():
    _, measurement = synthetic_impact(velocity=1.75, samples=201)
    result = ff.fit(measurement, starts=4)
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
    share = spring.kh_minus / spring.kh_plus
    params["s1_kh_minus"].set(expr=f"{share!r} * s1_kh_plus")
    result = ff.fit(measurement, params=params, starts=4, intervals="local")
    assert result.params["s1_k0"].value == spring.k0
    assert result.params["s1_kc"].value == pytest.approx(15 * spring.k0, rel=1e-12)
    assert result.params["s1_eps_c"].value <= 0.305
    assert result.parameters["s1_k0"].state == "fixed"
    assert result.parameters["s1_kc"].stderr is None  # as that of s1_k0
    of, tied = (result.parameters[f"s1_kh_{side}"] for side in ("plus", "minus"))
    assert (tied.state, tied.stderr) == ("fixed", pytest.approx(share * of.stderr))
    assert tied.ci95 == pytest.approx([share * end for end in of.ci95])
    assert result.lmfit.params["s1_kh_minus"].stderr == tied.stderr
    names, matrix = result.correlation.names, result.correlation.matrix
    rows = [matrix[names.index(f"s1_kh_{side}")] for side in ("plus", "minus")]
    assert rows[0] == pytest.approx(rows[1], nan_ok=True)
    assert result.parameters["s1_eps_c"].state == "weak"  # the true value lies outside the bound


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"s1_k0": {"min": -1.0, "max": 0.0}}, "s1_k0 between -1 and 0 is .* must be positive"),
        ({"s1_eps_a": {"min": 1.5, "max": 2.0}}, "s1_eps_a between 1.5 and 2 is not admissible"),
        ({"s1_k0": {"min": 5e6, "max": 5e6}}, "params cannot be evaluated: .*min == max"),
        ({"s1_kc": {"expr": "s1_k0 / 0"}}, r"\(s1_kc = s1_k0 / 0\): ZeroDivisionError"),
        ({"s1_kc": {"expr": "s1_k0"}, "s1_k0": {"expr": "s1_kc"}}, "depend on each other"),
        ({"share": {}, "s1_kc": {"expr": "share * s1_k0"}}, "'share' is not one of the model"),
    ],
)
def test_parameters_that_no_fit_can_have_are_refused(given, why):
    params = make_params(synthetic_impact()[1])
    for name, one in given.items():
        params.add(name) if name not in params else params[name].set(**one)
    with pytest.raises(ff.InputError, match=why):
        ff.fit(synthetic_impact()[1], params=params)


def test_one_bound_of_a_nuisance_parameter_is_kept_without_the_other():
    test, bare = synthetic_impact()[1], lmfit.Parameters()
    usual = make_params(test)["displacement_zero"]
    bare.add("displacement_zero", value=0.0, min=0.5 * usual.min)
    made = make_problem(test, "bistable", None, bare, None, interior_mass=False)
    one = made.params["displacement_zero"]
    assert (one.min, one.max) == (0.5 * usual.min, usual.max)


def test_parameters_without_bounds_are_searched_like_those_with_bounds():
    test, bare = synthetic_loop()[1], lmfit.Parameters()
    bare.add("s1_k0", value=5e6)
    found = ff.fit(test, params=bare, starts=1)
    assert found.params["s1_k0"].value == ff.fit(test, starts=1).params["s1_k0"].value


@pytest.mark.parametrize("name", ["s1_eta", "displacement_zero"])
def test_an_expression_has_no_nuisance_parameter(name):
    params = make_params(synthetic_impact()[1])
    params[name].set(expr="contact_time * 1e6 + 20")
    with pytest.raises(ff.InputError, match=f"the expression {name} = .* has contact_time"):
        ff.fit(synthetic_impact()[1], params=params)


def test_contact_and_zero_are_reported_in_the_numbers_of_the_file():
    """The caller's parameters, also relative to the file, are unchanged and can be used again."""
    test = ff.read_test(RECONSTRUCTION)
    params = make_params(test)
    before = params.valuesdict(), {name: (one.min, one.max) for name, one in params.items()}
    result = ff.fit(test, params=params, starts=1, intervals="local")
    assert before == (params.valuesdict(), {n: (one.min, one.max) for n, one in params.items()})
    for name, true in (("contact_time", 49.5 * 1.416e-6), ("displacement_zero", 0.0)):
        origin, item = test.origins[name], result.parameters[name]
        assert origin != 0.0
        assert before[0][name] == origin
        assert item.ci95[0] < true < item.ci95[1], name
        assert result.params[name].value == item.value
    held = make_params(test)
    held["contact_time"].set(value=66e-6, vary=False)
    result = ff.fit(test, params=held, starts=1, intervals="local")
    assert result.params["contact_time"].value == pytest.approx(66e-6, rel=1e-12)
    assert result.parameters["contact_time"].state == "fixed"


def test_the_best_point_survives_ctrl_c(monkeypatch):
    _, measurement = synthetic_impact()
    calls = 0
    original = levenberg.descend

    def interrupted(*args, **more):
        nonlocal calls
        calls += 1
        if calls == 12:
            raise KeyboardInterrupt
        return original(*args, **more)

    monkeypatch.setattr(levenberg, "descend", interrupted)
    result = ff.fit(measurement)
    assert "Ctrl-C" in result.warnings[0]
    assert result.stopped == "Ctrl-C"
    assert result.misfit["stress_time"] < 0.05


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": 3}, "model = 3"),
        ({"model": None}, "model = None"),
        ({"params": {"s1_k0": 5e6}}, "params must be lmfit.Parameters"),
        ({"weights": {"stress_strain": "all"}}, "'stress_strain' = all"),
        ({"model": "rubber"}, "rubber"),
        ({"params": lmfit.create_params(s2_k0=1.0)}, "s2_k0"),
        ({"params": lmfit.create_params(s1_eps_a={"value": 2.0, "vary": False})}, "s1_eps_a = 2"),
        ({"params": lmfit.create_params(s1_k0={"value": -1.0, "vary": False})}, "s1_k0 = -1"),
    ],
)
def test_wrong_calls_are_refused(options, message):
    with pytest.raises(ff.InputError, match=message):
        ff.fit(synthetic_loop()[1], **options)


def test_an_unknown_option_is_a_type_error_that_names_it():
    wrong = r"\(\) got an unexpected keyword argument 'start'; did you mean 'starts'\?"
    for function, given in ((ff.fit, synthetic_loop()[1]), (ff.fit_cycles, "x"), (ff.batch, "x")):
        with pytest.raises(TypeError, match=f"^{function.__name__}{wrong}"):
            function(given, start=3)


def test_a_path_is_no_measurement():
    with pytest.raises(ff.InputError, match=r"measurement is a str; give what foamfit\.read_test"):
        ff.fit("test.csv")


SOFT = ff.published["foam-1/model-1"].bistable
STIFF = ff.BistableSpring(
    k0=9e6, kc=120e6, dsigma=-0.4e6, eps_a=0.16, eps_c=0.33, kh_plus=9e6, kh_minus=4e6
)


def two_springs(*springs, noise=0.005):
    """Return a slow loop without time of two equally high springs, with a tracked mass between."""
    height = 1.19e-3
    strain = np.concatenate([np.linspace(0, 0.4, 75), np.linspace(0.4, 0.02, 75)[1:]])
    chain = ff.Chain(springs, [0.5 * height] * 2, 1.9635e-5)
    run = ff.simulate(chain, ff.DisplacementDrive(strain * height), np.arange(strain.size))
    rng = np.random.default_rng(1)
    noisy = [
        y + noise * np.ptp(y) * rng.standard_normal(y.size)
        for y in (run.base_stress, run.displacement[0])
    ]
    specimen = Specimen(height, 1.9635e-5, heights=(0.5 * height,) * 2)
    made = loop_measurement(noisy[0], strain * height, specimen)
    return replace(made, interior={1: noisy[1]})


def test_a_mass_inside_shows_which_spring_is_at_the_base():
    """The stiffer spring is at the base; without this motion it would be put on top."""
    measurement = two_springs(STIFF, SOFT)
    result = ff.fit(measurement, model="bistable+bistable", starts=2, intervals="local")
    for spring, true in zip(result.chain.springs, (STIFF, SOFT), strict=True):
        assert spring.sigma_a == pytest.approx(true.sigma_a, rel=0.05)
        assert spring.kc == pytest.approx(true.kc, rel=0.05)
    assert result.misfit["displacement_1_time"] == pytest.approx(0.005, rel=0.15)
    measured, fitted = result.curves.interior[1]
    assert measured is measurement.interior[1]
    off = np.sqrt(np.mean((fitted - measured) ** 2)) / np.ptp(measured)
    assert off == pytest.approx(result.misfit["displacement_1_time"], rel=1e-12)
    assert result.weights["displacement_1_time"] == 1.0


def test_where_no_motion_is_measured_another_contact_time_is_tried(tmp_path):
    """A minimum with later contact and a dashpot has χ² = 1801, the true parameters 1795."""
    record = rig.impact(rig.Impact(channels=("force", "acceleration")), 6010)
    result = ff.fit(ff.read_test(rig.write(record, tmp_path)), intervals="local")
    assert result.statistics["chisqr"] < 1790.0
    assert result.parameters["s1_eps_a"].value == pytest.approx(record.truth["s1_eps_a"], rel=0.2)


@pytest.mark.parametrize(
    ("model", "drive", "why"),
    [
        ("bistable", "impact", "a single spring has none"),
        ("linear+bistable", "displacement", "none moves in the displacement drive"),
    ],
)
def test_interior_masses_that_are_not_there_are_said_to_change_nothing(model, drive, why):
    _, impact = synthetic_impact(samples=101)
    top = f"s{model.count('+') + 1}"
    quick = {f"{top}_{name}": getattr(SOFT, name) for name in ("kc", "dsigma", "eps_a", "eps_c")}
    options = {"model": model, "drive": drive, "fix": quick, "starts": 1, "intervals": "local"}
    asked, plain = (ff.fit(impact, interior_mass=mass, **options) for mass in (True, False))
    assert any(why in note for note in asked.notes)
    assert not any(why in note for note in plain.notes)
    assert asked.params.valuesdict() == plain.params.valuesdict()
    assert asked.warnings == plain.warnings


def test_a_mass_inside_is_left_out_of_a_single_spring_and_refused_as_the_top():
    measurement = two_springs(STIFF, SOFT)
    result = ff.fit(measurement, starts=1, intervals="local")
    assert any("not fitted: displacement_1" in note for note in result.notes)
    assert "displacement_1_time" not in result.misfit
    top = replace(measurement, interior={2: measurement.interior[1]})
    with pytest.raises(ff.InputError, match="node 2 of a 2-spring chain is the top"):
        ff.fit(top, model="linear+bistable")


FOAMS = {  # height and diameter, mm
    "turbo-comp-1": (10.53, 7.63),
    "leap-comp-2": (10.65, 7.62),
    "new-heel-comp-1": (9.90, 7.67),
}


@needs_data
@pytest.mark.parametrize("name", FOAMS)
def test_one_spring_follows_the_first_cycle_of_a_shoe_foam(name, tmp_path):
    """Data of arXiv:2602.12694; an exhaustive global search reaches misfits of 0.029 to 0.032."""
    record = thinned(DATA / "shoe-foam" / f"{name}_cycle1.csv", tmp_path, 4)
    measurement = ff.read_test(record, specimen_toml(tmp_path, *FOAMS[name]))
    result = ff.fit(measurement, intervals="local")
    assert result.drive == "displacement"
    assert result.misfit["stress_strain"] <= 0.035


@pytest.mark.parametrize(
    ("given", "seed"),
    [
        (rig.Slow(relaxation=1, dashpot=True, noise=1e-3), 6077),
        (rig.Slow(relaxation=1, dashpot=True, noise=1e-3), 6148),
        (rig.Slow("bistable", noise=1e-3, early=True, zero=True), 6097),
    ],
)
def test_a_wrong_minimum_is_left_where_more_than_noise_is_missed(given, seed, tmp_path):
    """Wrong minima have long relaxation times and soft springs, or a short branch without slope."""
    test = ff.read_test(rig.write(made := rig.slow(given, seed), tmp_path))
    params = ff.make_params(test, given.law, "displacement", relaxation=given.relaxation)
    params["s1_eta"].vary = given.dashpot
    options = {"relaxation": given.relaxation, "intervals": "local"}
    result = ff.fit(test, model=given.law, params=params, **options)
    assert result.noise["stress_strain"]["residual_over_noise"] < 1.1
    for name in ("s1_k0", "s1_kc", "s1_eta"):
        assert result.parameters[name].value == pytest.approx(made.truth[name], rel=0.1)
