"""Joint fits of several tests, from files and a STUDY.toml as a user writes them."""

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import foamfit as ff
from conftest import few_bytes, run, run_refused, without_pictures, write_csv
from foamfit.study import joint_fit, joint_result as joint_report
from foamfit.study.identified import read_source

HEIGHT, TOP = 10e-3, 0.5
SPRING = {
    "k0": 5.5e5, "kc": 4e5, "eps_star": 0.3, "sigma_plus": 1.1e5, "spread_plus": 0.4,
    "sigma_minus": 7e4, "spread_minus": 0.6,
}  # fmt: skip
NOISE, RATES = 400.0, (0.01, 0.1, 1.0)
NAMES = [f"s1_{name}" for name in SPRING]
HEAD = "time (s),stress (Pa),displacement (mm)"


def write_test(folder: Path, name: str, *, rate=0.1, seed=0, noise=NOISE, samples=101, **changes):
    """Write the CSV of a slow loop of a microscale spring at a constant strain rate."""
    spring = ff.MicroscaleSpring(**{**SPRING, **changes})
    up = np.linspace(0.0, TOP, samples // 2 + 1)
    strain = np.concatenate([up, up[::-1][1:]])
    time = np.arange(strain.size) * (up[1] / rate)
    stress = spring.stress(strain) + noise * np.random.default_rng(seed).standard_normal(time.size)
    write_csv(folder / f"{name}.csv", HEAD, time, stress, 1e3 * HEIGHT * strain)


def write_study(folder: Path, parameters: str, more: str = "") -> Path:
    specimen = f'[specimen]\nheight = "10 mm"\narea = "100 mm^2"\n[noise]\nstress = "{NOISE} Pa"\n'
    (folder / "foam.toml").write_text(specimen)
    (folder / "study.toml").write_text(
        f'name = "a family"\ntests = ["t*.csv"]\nmodel = "microscale"\ndrive = "displacement"\n'
        f'specimen = "foam.toml"\nstarts = 2\n{more}\n[parameters]\n{parameters}\n'
    )
    return folder / "study.toml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Three tests over two decades of rate with different kc, and a file that is not a test."""
    here = tmp_path_factory.mktemp("family")
    for i, (rate, kc) in enumerate(zip(RATES, (3.6e5, 4e5, 4.5e5), strict=True)):
        slow = 1.0 + 0.04 * np.log(rate / 0.1)
        write_test(here, f"t{i}", rate=rate, seed=i, kc=kc, sigma_plus=1.1e5 * slow)
    (here / "t8.csv").write_bytes((here / "t0.csv").read_bytes())  # the same specimen again
    (here / "t9.csv").write_text("no numbers\n")
    return here


SHARED = '\ns1_spread_plus = "shared"\ns1_spread_minus = "shared"\ns1_eps_star = "shared"'


@pytest.fixture(scope="module")
def found(folder):
    parameters = 's1_k0 = "shared"\ns1_kc = "scatter"\ns1_sigma_plus = "log rate"' + SHARED
    return ff.joint(write_study(folder, parameters))


def test_kinds_are_what_the_study_says(found):
    kinds = {name: one.kind for name, one in found.parameters.items()}
    assert kinds == {
        "s1_k0": "shared", "s1_kc": "scatter", "s1_eps_star": "shared",
        "s1_sigma_plus": "log rate", "s1_spread_plus": "shared", "s1_sigma_minus": "own",
        "s1_spread_minus": "shared", "s1_eta": "fixed", "site_eta": "fixed",
    }  # fmt: skip
    assert found.status == "warnings"  # about the file that is not a test
    assert [Path(file).name for file in found.refused] == ["t8.csv", "t9.csv"]
    assert found.rates == pytest.approx(RATES)
    assert found.rate0 == pytest.approx(0.1)


def test_values_are_found_with_their_intervals(found):
    k0, rate = found.parameters["s1_k0"], found.parameters["s1_sigma_plus"]
    assert abs(k0.value - SPRING["k0"]) < 4.0 * k0.stderr
    assert k0.ci95[0] < k0.value < k0.ci95[1]
    assert k0.state == "determined"
    assert abs(rate.b - 0.04) < 4.0 * rate.b_stderr
    assert rate.b_stderr < 0.01
    scatter = found.parameters["s1_kc"]
    assert scatter.scatter_ci95[0] < 0.11 < scatter.scatter_ci95[1]
    assert scatter.value == pytest.approx(4e5, rel=0.1)
    assert set(scatter.tests) == {"t0", "t1", "t2"}


def coarse(figure, place, *_):
    """Render a figure of the page at a fifth of the resolution, to save time."""
    return joint_report.figures.images(figure, "png", dpi=36)[0]


def test_linked_values_are_one_value_bit_for_bit(found, tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    monkeypatch.setattr(joint_report.figures, "write_both", coarse)
    found.save(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "joint.json").read_text())
    value = content["parameters"]["s1_k0"]["value"]
    for test in content["tests"]:
        assert content["tests"][test]["values"]["s1_k0"] == value
        single = json.loads((tmp_path / "out" / test / "fit.json").read_text())
        assert single["parameters"]["s1_k0"]["value"] == value
        assert single["parameters"]["s1_k0"]["ci95"] == content["parameters"]["s1_k0"]["ci95"]
        mine = content["parameters"]["s1_kc"]["tests"][test]["value"]
        assert single["parameters"]["s1_kc"]["value"] == mine
        assert "Fitted together with 2 other tests (a family)" in single["notes"][0]
    read = ff.load(tmp_path / "out")
    assert read.to_json_dict() == content
    assert read.parameters.keys() == found.parameters.keys()
    assert read.parameters["s1_kc"] == found.parameters["s1_kc"]
    pd.testing.assert_frame_equal(read.table(), found.table())
    assert read.results["t1"].parameters["s1_k0"].value == value
    for one, other in zip(read.loops.values(), found.loops.values(), strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.along, other.along)
        np.testing.assert_allclose(one.fitted, other.fitted)
    read.save(tmp_path / "again")
    for name in ("joint.json", "joint.html", "table.tex", "t1/curves.csv", "t1/parameters.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
    table = read.table().loc["t1"]
    assert table.loc["s1_kc", "value"] == found.parameters["s1_kc"].tests["t1"].value
    assert read_source(read).parameters == read_source(found).parameters
    for one in content["parameters"].values():  # as an older version wrote it
        for at in one.get("tests", {}).values():
            del at["unit"], at["vary"], at["ci95_method"], at["range"], at["systematic"]
    (tmp_path / "out" / "joint.json").write_text(json.dumps(content))
    older = ff.load(tmp_path / "out").table()
    columns = ["value", "stderr", "ci95_lo", "unit", "state"]
    pd.testing.assert_frame_equal(older[columns], found.table()[columns])


def test_joint_json_says_everything(found):
    content = json.loads(json.dumps(found.to_json_dict(), allow_nan=False))
    assert content["schema"] == 1
    assert (content["name"], content["model"], content["drive"]) == (
        "a family", "microscale", "displacement",
    )  # fmt: skip
    assert sum(one["chi2_share"] for one in content["tests"].values()) == pytest.approx(1.0)
    assert content["tests"]["t1"]["misfit"]["stress_strain"] < 0.01
    parameters = content["parameters"]
    assert {"kind", "value", "stderr", "ci95", "unit", "state"} <= parameters["s1_k0"].keys()
    assert "scatter" not in parameters["s1_k0"]
    assert {"scatter", "scatter_stderr", "scatter_ci95", "tests"} <= parameters["s1_kc"].keys()
    assert {"b", "b_stderr", "b_ci95"} <= parameters["s1_sigma_plus"].keys()
    names = content["covariance"]["names"]
    assert {"s1_k0", "s1_kc", "s1_sigma_plus", "s1_sigma_plus:b"} <= set(names)
    matrix = np.array(content["covariance"]["matrix"])
    for name, error in (("s1_k0", "stderr"), ("s1_kc", "stderr"), ("s1_sigma_plus", "stderr")):
        at = names.index(name)
        assert matrix[at, at] ** 0.5 == pytest.approx(parameters[name][error])
    at = names.index("s1_sigma_plus:b")
    assert matrix[at, at] ** 0.5 == pytest.approx(parameters["s1_sigma_plus"]["b_stderr"])
    kinds = {one["kind"] for one in content["evidence"] if one["parameter"] == "s1_sigma_plus"}
    assert kinds == {"log rate", "power rate", "shared", "own"}
    assert [one["kind"] for one in content["evidence"] if one["chosen"]] == ["log rate"]
    assert content["statistics"]["n_vary"] == 4 + 2 + 3 + 3


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    """Five specimens whose k0 scatters by 5 %, and a study that takes k0 as shared."""
    here, deviates = tmp_path_factory.mktemp("unlike"), np.array([-1.2, -0.6, 0.1, 0.4, 1.3])
    for i, z in enumerate(deviates):
        write_test(here, f"t{i}", seed=i, noise=0.1 * NOISE, k0=5.5e5 * (1.0 + 0.05 * z))
    kinds = dict.fromkeys(NAMES, "shared") | {"s1_sigma_minus": "own", "s1_kc": "scatter"}
    study = write_study(here, "\n".join(f'{name} = "{kind}"' for name, kind in kinds.items()))
    heavy = here / "foam.toml"
    heavy.write_text(heavy.read_text().replace("[specimen]", '[specimen]\nmass = "1 kg"'))
    return ff.joint(study), 5.5e5 * 0.05 * np.std(deviates, ddof=1) / 5**0.5


def test_the_range_of_a_shared_value_holds_that_of_a_mean_over_other_specimens(unlike):
    joint, error = unlike
    k0 = joint.parameters["s1_k0"]
    low, high = joint_fit._over_specimens(joint.fit.found)["s1_k0"]
    assert 0.5 * (high - low) == pytest.approx(stats.t.ppf(0.975, 4) * error, rel=0.3)
    assert low < 5.5e5 < high
    assert k0.range[0] <= low < high <= k0.range[1]
    assert high - low > 5.0 * (k0.ci95[1] - k0.ci95[0])  # the interval covers noise only
    assert "its range is ±" in k0.why
    content = json.loads(json.dumps(joint.to_json_dict()))
    assert content["parameters"]["s1_k0"]["range"] == list(k0.range)
    assert any(one.startswith("Check t0, t1, t2 and 2 more: mass and") for one in joint.warnings)
    # A value of one test has a range too: without, it was called determined though the law errs.
    own = joint.parameters["s1_sigma_minus"].tests["t0"]
    assert own.range[0] < own.value < own.range[1]
    assert own.range[1] - own.range[0] > own.ci95[1] - own.ci95[0]


def test_evidence_chooses_a_kind(folder):
    parameters = '\ns1_sigma_plus = "auto"\ns1_k0 = "auto"\ns1_kc = "own"' + SHARED
    chosen = ff.joint(write_study(folder, parameters))
    assert chosen.parameters["s1_sigma_plus"].kind in ("log rate", "power rate")
    assert chosen.parameters["s1_k0"].kind == "shared"


def test_a_law_of_rate_is_no_kind_where_the_rates_span_too_little(tmp_path):
    """Repeats at a nominal rate, which a machine meets within 2 to 3 %; the specimens scatter."""
    rates = (0.0985, 0.0992, 0.1, 0.101, 0.1016)
    for i, (rate, k0) in enumerate(zip(rates, (5.1e5, 5.6e5, 5.4e5, 5.8e5, 5.9e5), strict=True)):
        write_test(tmp_path, f"t{i}", rate=rate, seed=i, k0=k0)
    rest = "".join(f'\n{name} = "shared"' for name in NAMES if name != "s1_k0")
    one = ff.joint(write_study(tmp_path, 's1_k0 = "auto"' + rest))
    assert one.parameters["s1_k0"].kind == "own"
    assert {other.kind for other in one.evidence} == {"shared", "own"}
    (told,) = (sentence for sentence in one.sentences if "No rate law" in sentence)
    assert re.search(
        r"was tried for s1_k0: over 0\.0985 to 0\.102 1/s, the values .* within ±[1-9]", told
    )
    named = ff.joint(write_study(tmp_path, 's1_k0 = "power rate"' + rest))
    (told,) = (warning for warning in named.warnings if "a rate law needs more" in warning)
    assert told.startswith("s1_k0 (power rate): its own values in the tests, at 0.0985 to 0.102")


def test_a_noisy_test_does_not_dominate(tmp_path):
    for i in range(4):
        write_test(tmp_path, f"t{i}", seed=i, noise=NOISE * (10.0 if i == 3 else 1.0))
    study = write_study(tmp_path, "\n".join(f'{name} = "shared"' for name in NAMES))
    specimen = (tmp_path / "foam.toml").read_text()
    (tmp_path / "noisy.toml").write_text(specimen.replace(f"{NOISE} Pa", f"{10 * NOISE} Pa"))
    study.write_text(study.read_text().replace("[parameters]",
                     '[specimens]\nt3 = "noisy.toml"\n[parameters]'))  # fmt: skip
    result = ff.joint(study)
    shares = [one.chi2_share for one in result.tests.values()]
    assert shares == pytest.approx([0.25] * 4, abs=0.06)
    one = result.parameters["s1_k0"]
    assert abs(one.value - SPRING["k0"]) < 4.0 * one.stderr


def test_drives_and_noise_mix(tmp_path):
    """An impact and a slow loop of one bistable spring, damped in the impact alone."""
    spring = ff.published["foam-1/model-1"].bistable
    spring = ff.BistableSpring(*spring.seven, eta=300.0)
    time = np.linspace(0.0, 0.75e-3, 301)
    run = ff.simulate(ff.Chain([spring], [1.19e-3], 1.9635e-5), ff.Impact(7e-3, 2.0), time)
    up = np.linspace(0.0, 0.38, 150)
    strain = np.concatenate([up, up[::-1][1:]])
    loops = {
        "fast": (time, run.base_stress, run.displacement[-1]),
        "slow": (np.arange(strain.size) * 0.01, spring.stress(strain), 1.19e-3 * strain),
    }
    rng = np.random.default_rng(0)
    common = '[specimen]\nheight = "1.19 mm"\narea = "19.635 mm^2"\n'
    for name, (t, stress, moved) in loops.items():
        stress = stress + 5e3 * rng.standard_normal(t.size)
        write_csv(tmp_path / f"{name}.csv", HEAD, t, stress, 1e3 * moved)
        striker = '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n' if name == "fast" else ""
        (tmp_path / f"{name}.toml").write_text(common + striker)
    study = tmp_path / "study.toml"
    study.write_text(
        'tests = ["*.csv"]\nmodel = "bistable"\nstarts = 2\n[parameters]\n'
        + "\n".join(f's1_{name} = "shared"' for name in spring.law.names)
    )
    result = ff.joint(study)
    assert result.drive is None
    assert [one["drive"] for one in result.to_json_dict()["tests"].values()] == [
        "impact", "displacement",
    ]  # fmt: skip
    assert result.parameters["s1_eta"].value == pytest.approx(300.0, rel=0.2)
    assert result.fit.found.value("s1_eta")[1] == 0.0  # it does not vary in the slow loop
    # Besides the spring's: contact time and zero of the impact, and the zero of the slow motion.
    assert result.fit.found.n_vary == 8 + 3
    assert result.parameters["s1_k0"].value == pytest.approx(5.5e6, rel=0.03)


def test_the_command_writes_and_prints(folder, tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    monkeypatch.setattr(joint_report.figures, "write_both", few_bytes)
    study = write_study(folder, 's1_k0 = "shared"\ns1_kc = 4e5' + SHARED)
    result = run("joint", study, "--out", tmp_path / "out")
    assert "3 tests together" in result.stdout
    assert "t9.csv is left out" in result.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"joint.json", "t0", "t1", "t2"}
    content = json.loads((tmp_path / "out" / "joint.json").read_text())
    assert content["parameters"]["s1_kc"]["kind"] == "fixed"
    assert content["parameters"]["s1_kc"]["value"] == 4e5
    again = run("joint", study, "--out", tmp_path / "out", "--json", "--no-report")
    assert json.loads(again.stdout)["seed"] == 0
    (tmp_path / "out" / "t1" / "mine.txt").write_text("mine")
    kept = run_refused("joint", study, "--out", tmp_path / "out")
    assert "holds t1, which foamfit did not write" in kept
    told = run_refused("joint", folder / "t0.csv", "--out", tmp_path / "out")
    assert "t0.csv" in told  # that it is no study is said before what the folder holds


@pytest.mark.parametrize(
    ("parameters", "more", "wanted"),
    [
        ('s1_kx = "shared"', "", "[parameters] s1_kx is not a parameter of the model microscale"),
        ('contact_time = "shared"', "", 'contact_time = "shared" is impossible: each test has'),
        ('velocity = "auto"', "", 'velocity = "auto" is impossible: each test has'),
        ("velocity = 2", "", "[parameters] velocity is a parameter of none of these tests"),
        ('s1_k0 = "share"', "", "s1_k0 = 'share' must be one of shared, own, scatter"),
        ('s1_k0 = "shared"', 'drive = "pull"', "drive = 'pull' must be one of impact"),
        ('s1_k0 = "shared"', "seed = -1", "seed = -1 must be a whole number from 0 up"),
        ('s1_k0 = "shared"', "sead = 1", "has no key 'sead'; did you mean 'seed'?"),
        ('s1_k0 = "shared"', 'tests = ["u*.csv"]', "u*.csv: the glob matches no file"),
        ('s1_k0 = "shared"', 'tests = ["t0.csv"]', "a joint fit needs at least two"),
        ('s1_k0 = "shared"', 'model = "microscale+x"', "'x' is not a spring"),
        ('s1_k0 = "shared"', 'drive = "impact"', "of 5 can be used, but a joint fit needs two"),
        ('s1_k0 = "shared"', 'specimen = "no.toml"', "no.toml: no such file"),
    ],
)  # fmt: skip
def test_bad_studies_are_refused_in_one_sentence(folder, tmp_path, parameters, more, wanted):
    text = write_study(folder, parameters).read_text()
    key = more.split(" =")[0]
    lines = [line for line in text.splitlines() if not (key and line.startswith(f"{key} ="))]
    study = folder / "bad.toml"
    study.write_text("\n".join([more, *lines]))
    assert wanted in run_refused("joint", study, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_law_of_rate_needs_two_rates(tmp_path):
    for i in range(2):
        write_test(tmp_path, f"t{i}", seed=i)
    study = write_study(tmp_path, 's1_k0 = "log rate"')
    with pytest.raises(
        ff.InputError, match=r'"log rate" needs tests at two or more rates, and all'
    ):
        ff.joint(study)


def test_one_number_may_be_all_that_is_fitted(tmp_path):
    study = write_study(tmp_path, 's1_k0 = "shared"').read_text()
    (tmp_path / "study.toml").write_text(study.replace('"microscale"', '"linear"'))
    for i in range(2):
        write_test(tmp_path, f"t{i}", seed=i)
    k0 = ff.joint(tmp_path / "study.toml").parameters["s1_k0"]
    assert k0.kind == "shared"
    assert k0.ci95[0] < k0.value < k0.ci95[1]
    assert k0.range[0] < k0.value < k0.range[1]


def test_joint_json_has_how_parameters_vary_together(found):
    said = found.to_json_dict()["specimens"]
    assert said["names"] == ["s1_kc", "s1_sigma_minus"]
    matrix = np.array(said["correlation"])
    assert np.diag(matrix) == pytest.approx(1.0)
    assert read_source(found).specimens[0] == tuple(said["names"])
    np.testing.assert_allclose(read_source(found).specimens[1], matrix)


def test_a_test_with_a_wrong_scale_of_the_force_is_named(tmp_path):
    wrong = {name: 1.05 * SPRING[name] for name in ("k0", "kc", "sigma_plus", "sigma_minus")}
    for i, rate in enumerate(RATES):
        write_test(tmp_path, f"t{i}", rate=rate, seed=i, **(wrong if i == 1 else {}))
    found = ff.joint(write_study(tmp_path, "\n".join(f'{name} = "shared"' for name in NAMES)))
    (factor,) = re.findall(r"(?m)^t1 departs .* times ([\d.]+) ", "\n".join(found.warnings))
    assert float(factor) == pytest.approx(1.0 / 1.05, rel=0.01)


@pytest.mark.parametrize(
    ("factor", "named"), [(1.3, True), (0.7, True), (-7.5, False), (3.0, False)]
)
def test_a_scale_to_first_order_is_said_only_near_one(factor, named):
    point = SimpleNamespace(
        uncertainty=SimpleNamespace(errs=True), scale=lambda t: [(factor, 0.8), (1.0, 0.1)][t]
    )
    result = SimpleNamespace(tests={"a": None, "b": None})
    found = joint_report._scaled(result, SimpleNamespace(point=point))
    assert found == (("a", factor, 0.8) if named else None)


@pytest.mark.parametrize(("found", "shown"), [((-2e5, 9e5), (0.0, 9e5)), ((1e5, 9e5), (1e5, 9e5))])
def test_the_range_of_a_rate_law_ends_at_the_limits_of_its_parameter(monkeypatch, found, shown):
    """It is the spread between specimens, on either side of the value."""
    best = SimpleNamespace(
        problem=SimpleNamespace(free=lambda: ["s1_k0"]), limits=lambda _: (0.0, math.inf)
    )
    links = SimpleNamespace(kind=lambda _: "log rate")
    point = SimpleNamespace(
        uncertainty=SimpleNamespace(errs=True), bests=[best],
        found=SimpleNamespace(shared=["s1_k0"], links=links),
    )  # fmt: skip
    of_specimens = {"s1_k0": found, "s1_k0:b": (-1.0, 1.0)}
    monkeypatch.setattr(joint_fit, "_over_specimens", lambda _: of_specimens)
    assert joint_fit.ranges_of(point) == ({"s1_k0": shown, "s1_k0:b": (-1.0, 1.0)}, [])
