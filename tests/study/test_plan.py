"""The plan of the next test: what it promises, its limits, its files and its refusals."""

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
from conftest import run, run_refused, write_measurement
from foamfit.data import rig as rigs
from foamfit.data.measurement import INTEGRATED, MEASURED, Measurement, Noise, Specimen, Striker
from foamfit.data.rig import Candidate, candidates, read_rig
from foamfit.errors import InputError
from foamfit.fitting.problem import make_problem
from foamfit.study import plan as plan_module
from foamfit.study.gain import Target, as_test
from foamfit.study.study_file import read_study

QUANTITY = "peak_force at 2.5 m/s"
FOAM_1 = Path(__file__).parents[2] / "experiments/foam-1"
RIG = """\
[striker]
velocity = "0.9 to 4 m/s"
masses = ["7 g"]
[limits]
force = "{force} N"
[record]
rate = "1 MHz"
noise = {{ stress = "35 kPa", displacement = "3.8 um" }}
"""


@pytest.fixture(scope="module")
def soft():
    """A fit of foam-1 hit too softly to close its loop."""
    return ff.fit(ff.read_test(FOAM_1 / "model-2-1.75mps-reconstruction.csv"), starts=4)


def hit(chain, mass, speed, step, noise, rng):
    """Return the record of an impact, with noise in stress (Pa) and motion (m)."""
    time = np.arange(0.0, 6.0 * chain.height / speed, step)
    seen = ff.simulate(chain, ff.Impact(mass, speed), time)
    curves = np.array([seen.base_stress, seen.displacement[-1]])
    curves += np.reshape(noise, (2, 1)) * rng.standard_normal((time.size, 3)).T[1:]
    specimen = Specimen(chain.height, chain.area, None, tuple(chain.heights))
    return Measurement(
        "hit", None, "", time, *curves, specimen, Striker(mass, speed), Noise(*noise)
    )


def fewer(patch):
    """Plan with fewer draws and velocities, where neither changes what the plan says."""
    patch.setattr(plan_module, "DRAWS", 10)
    patch.setattr(rigs, "VELOCITIES", 8)
    patch.setattr(rigs, "STRAINS", 3)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A rig with a force sensor of 200 N."""
    path = tmp_path_factory.mktemp("rig") / "RIG.toml"
    path.write_text(RIG.format(force=200), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def planned(soft, rig):
    """The plan after the soft hit."""
    return ff.plan(soft, rig=rig)


@pytest.fixture(scope="module")
def of_quantity(soft):
    """The plan for the peak force of a faster impact."""
    with pytest.MonkeyPatch.context() as patch:
        fewer(patch)
        return ff.plan(soft, quantity=QUANTITY)


@pytest.fixture(scope="module")
def of_published():
    """The plan with the published parameters of foam-1."""
    return ff.plan("foam-1/model-2")


def test_published_foam_1_closes_its_loop_at_the_velocity_of_the_energy_balance(of_published):
    """By root finding of ½mv² = A H ∫σ dε up to ε̂_c: 1.911 m/s with 7 g."""
    item = ff.published["foam-1/model-2"]
    spring = item.bistable
    strain = np.linspace(0.0, spring.eps_hat_c, 20001)
    work = np.trapezoid(spring.stress(strain), strain) * item.chain.area * item.chain.height
    closing = math.sqrt(2.0 * work / item.striker_mass)
    half, sure = of_published.closing[item.striker_mass]
    assert half == pytest.approx(closing, rel=0.01)
    assert sure == pytest.approx(closing, rel=0.02)
    assert of_published.advice.candidate.velocity > closing
    opened = {name for name, one in of_published.now.items() if one.state == "not determined"}
    assert opened == {"s1_kc", "s1_dsigma", "s1_eps_c", "s1_kh_minus"}
    assert opened < set(of_published.advice.determined)
    assert all("s1_eta" not in one.determined for one in of_published.outcomes)  # it may be zero


def test_a_soft_hit_is_followed_by_one_that_probably_closes_the_loop(planned):
    assert planned.advice.breaks <= 0.05
    assert planned.advice.number > sum(one.probability for one in planned.now.values()) + 1.0
    softer = [one for one in planned.outcomes if one.candidate.velocity < 1.7]
    assert all("s1_kc" not in one.determined for one in softer if one.candidate.mass == 7e-3)


def test_a_softer_test_loses_at_most_a_quarter_of_what_the_best_adds(planned):
    each = [replace(planned.now["s1_k0"], probability=share) for share in (0.0, 0.45)]
    tests = [replace(planned.advice, force=i, expected={"": one}) for i, one in enumerate(each)]
    assert plan_module._advised(tests, 0.0) is tests[1]


def test_a_test_that_exceeds_the_force_of_the_sensor_is_shown_and_not_advised(planned):
    strong = [one for one in planned.outcomes if one.force > 200.0]
    assert strong
    assert all(one.breaks >= 0.5 for one in strong)
    assert planned.advice not in strong


def test_table_and_plot_show_each_test_and_each_parameter(planned):
    table, best = planned.table(), planned.advice.candidate
    assert len(table) == len(planned.outcomes)
    (row,) = table[(table.mass == best.mass) & (table.velocity == best.velocity)].to_dict("records")
    assert row["determined"] == planned.advice.number
    assert row["s1_k0_ci95_width"] == planned.advice.expected["s1_k0"].ci95_width
    axes = planned.plot()
    assert [one.get_text() for one in axes.get_yticklabels()] == planned.own([*planned.now])
    assert len(axes.get_legend().get_texts()) == 2


def test_without_a_safe_test_none_is_advised(soft, tmp_path, monkeypatch):
    fewer(monkeypatch)
    rig = tmp_path / "RIG.toml"
    rig.write_text(RIG.format(force=1), encoding="utf-8")
    found = ff.plan(soft, rig=rig)
    assert found.advice is None
    assert found.sentences[0].startswith("Next test: none.")
    assert all(found.now[name].state != "determined" for name in found.never)
    assert found.never["s1_kc"] == "a rig with higher limits"
    found.save(tmp_path / "plan")
    assert not (tmp_path / "plan/next.toml").exists()


def test_expected_widths_are_those_of_a_joint_fit_with_the_advised_test(of_published, tmp_path):
    """The record of the second test is simulated; widths agree within a factor of 1.5."""
    item, rng = ff.published["foam-1/model-2"], np.random.default_rng(3)
    chain = ff.Chain(item.chain.springs, item.chain.heights, item.chain.area)
    levels = tuple(of_published.rig.noise.values())
    toml = '[noise]\nstress = "{} Pa"\ndisplacement = "{} m"\n'.format(*levels)
    speeds = {"first": 1.75, "second": of_published.advice.candidate.velocity}
    for name, speed in speeds.items():
        record = hit(chain, 7e-3, speed, 1.0 / of_published.rig.sampling, levels, rng)
        write_measurement(tmp_path / f"{name}.csv", record, toml)
    text = 'name = "both"\ntests = ["first.csv", "second.csv"]\nmodel = "bistable"\n[parameters]\n'
    shared = "".join(f'{name} = "shared"\n' for name in of_published.now)
    (tmp_path / "both.toml").write_text(text + shared)
    joint = ff.joint(tmp_path / "both.toml")
    for name in of_published.now:
        width, expected = np.ptp(joint.parameters[name].ci95), of_published.advice.expected[name]
        assert 1 / 1.5 < width / expected.ci95_width < 1.5, (name, width, expected)
        assert joint.parameters[name].state == "determined"
    tests, _ = plan_module._read([joint])
    assert [one.study for one in tests] == ["both", "both"]
    tests[0].values[at := tests[0].problem.index["s1_kc"]] *= 10.0  # as a fit that leaves it open
    known = plan_module.known_of(tests, rng, 0)
    assert known.drawn[0].springs[at] == pytest.approx(joint.parameters["s1_kc"].value, rel=0.1)


def test_a_spring_that_may_not_have_snapped_is_hit_harder(monkeypatch):
    """Both springs followed the record of the one that snapped, and a test as soft was advised."""
    fewer(monkeypatch)
    monkeypatch.setattr(plan_module, "FEWER_DRAWS", 4)
    first = ff.BistableSpring(1.15e6, 6.2e6, -6.5e4, 0.246, 0.414, 1.8e5, 5.4e5)
    second = ff.BistableSpring(1.7e6, 7.9e7, -6.3e5, 0.325, 0.523, 3.7e5, 1.9e5)
    chain, rng = ff.Chain([first, second], [0.01, 0.01], 1e-3), np.random.default_rng(0)
    test = hit(chain, 5.0, 0.94, 4e-4, (2.5e3, 2.5e-5), rng)
    result = ff.fit(test, model="bistable+bistable", starts=4, intervals="local")
    assert ff.plan(result).advice.candidate.velocity > 1.2  # it was 0.78 m/s


def test_a_quantity_is_known_better_after_the_test_that_is_chosen_for_it(of_quantity):
    safe, advice = [one for one in of_quantity.outcomes if one.breaks <= 0.05], of_quantity.advice
    assert advice.error < of_quantity.quantity.error
    assert advice.number >= max(one.number for one in safe) - 0.1
    assert min(one.error for one in safe) <= advice.error


def test_a_rival_law_is_told_apart_by_a_test_beyond_the_first(soft, monkeypatch):
    fewer(monkeypatch)
    test = ff.read_test(FOAM_1 / "model-2-1.75mps-reconstruction.csv")
    quick = {"drive": "displacement", "starts": 1, "intervals": "local"}
    rival = ff.fit(test, model="microscale", **quick)
    found = ff.plan(soft, rival)
    again = next(one for one in found.outcomes if one.candidate.repeat)
    assert found.rivals == ("microscale",)
    assert found.advice.apart["microscale"] > again.apart["microscale"]


@pytest.mark.parametrize(
    "name", ["peak_force", "peak_strain", "absorbed_energy", "dissipated_energy"]
)
@pytest.mark.parametrize("motion", [MEASURED, INTEGRATED])
def test_slopes_of_a_quantity_are_its_differences(name, motion):
    """A motion that was integrated from the force has slopes as well; their loss promised ±0."""
    (known_test,), _ = plan_module._read(["foam-1/model-1"])
    record = replace(known_test.problem.measurement, motion=motion)
    problem = make_problem(record, "bistable", "impact", None, None, False)
    test = plan_module.Test(problem, np.resize(known_test.values, len(problem.names)))
    known = plan_module.known_of([test], np.random.default_rng(0), 0)
    rig = read_rig(None, record)
    target = Target.of(f"{name} at 3 m/s", known, rig)
    asked = as_test(known, Candidate("impact", 7e-3, 3.0), rig, with_motion=True)
    for i, parameter in enumerate(known.names):
        step = np.zeros(len(problem.names))
        step[problem.index[parameter]] = 1e-5 * known.drawn[0].sizes[i]
        # To one side, as the spring is not damped.
        moved = (known.drawn[0].springs + i * step for i in range(3))
        at = [Target._in_draw(name, known, asked, springs)[0] for springs in moved]
        slope = (4.0 * at[1] - at[2] - 3.0 * at[0]) / 2e-5
        # The absorbed energy is that of the striker; its slopes are those of the sampling.
        size = target.middle if name == "absorbed_energy" else np.abs(target.slopes).max()
        assert target.slopes[0, i] == pytest.approx(slope, abs=1e-4 * size)
    assert target.error(known, []) > 0.0
    if name == "absorbed_energy":
        assert target.middle == pytest.approx(0.5 * 7e-3 * 3.0**2, rel=1e-3)


def test_motions_inside_have_the_noise_of_the_rig(soft):
    """The driving motion of a slow test has none."""
    for stated in (None, 1e-6):
        noise = replace(soft.measurement.noise, displacement=stated)
        test = replace(soft.measurement, noise=noise)
        slow = Candidate("displacement", strain=0.5, rate=0.1, cycles=1, interior=1)
        record = slow.recorded(test, read_rig(None, test), 0.0, 1e6)
        levels = [record.noise.of(name) for name in ("displacement", "displacement_1")]
        assert levels[0].sigma == 0.0 < levels[1].sigma
        assert levels[1].given == (stated is not None)
    several = replace(slow, cycles=3)
    assert tomllib.loads(several.toml(test))["window"] == {"cycles": [1, 3]}
    fast = replace(read_rig(None, test), sampling=1e6)  # for impacts
    rows = several.weight(record.time, test, fast) * record.time.size
    assert rows == pytest.approx(3 * test.displacement.size)


def test_the_same_law_with_relaxation_is_a_rival(monkeypatch):
    plain = plan_module._published("foam-1/model-1")
    record = plain.problem.measurement
    relaxing = make_problem(record, "bistable", "impact", None, None, False, relaxation=1)
    tests = {"foam-1/model-1": plain, "foam-1/model-2": plan_module.Test(relaxing, np.empty(0))}
    monkeypatch.setattr(plan_module, "_published", tests.get)
    same, rivals = plan_module._read([*tests])
    assert [one.problem for one in same] == [plain.problem]
    assert [*rivals] == ["bistable with relaxation"]


def test_files_and_terminal(soft, of_quantity, here, monkeypatch):
    """The same result and seed give the same plan, in the terminal as in Python."""
    fewer(monkeypatch)  # as the plan in Python
    soft.save("fits/foam/bistable", report=False)
    with monkeypatch.context() as early:
        early.setattr(plan_module, "plan", None)  # refused before anything is computed
        told = run_refused("plan", "fits/foam/bistable", "--out", "fits/foam/bistable")
    assert "which does not belong to a plan" in told
    ran = run("plan", "fits/foam/bistable", "--for", QUANTITY)
    assert "Next test: an impact of 7 g at" in ran.output
    folder = here / "plans/foam-bistable-quantity-peak_force-at-2.5-m-s"
    content = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    assert content == json.loads(json.dumps(of_quantity.to_json_dict()))
    advice, now = content["advice"], content["now"]
    assert content["schema"] == 1
    assert {"drive", "mass", "velocity", "determined", "open", "breaks"} <= advice.keys()
    assert now["s1_kc"] == now["s1_kc"] | {"ci95_width": None, "state": "not determined"}
    first = content["candidates"][0]
    assert {"drive", "mass", "velocity", "breaks", "expected"} <= first.keys()
    assert first["expected"]["s1_k0"]["ci95_width"] > 0.0
    striker = tomllib.loads((folder / "next.toml").read_text(encoding="utf-8"))["striker"]
    assert striker["velocity"] == f"{advice['velocity']:.6g} m/s"
    page = (folder / "plan.html").read_text(encoding="utf-8")
    assert all(one in page for one in ("which test next?", 'src="data:image/svg+xml'))
    # Once the new record is there, one line fits both.
    record = FOAM_1 / "model-2-2.0mps-reconstruction.csv"
    (folder / "next.csv").write_bytes(record.read_bytes())
    study = read_study(folder / "joint.toml")
    assert [path.resolve() for _, path, _ in study.tests] == [
        soft.measurement.path.resolve(), (folder / "next.csv").resolve()
    ]  # fmt: skip
    assert set(study.kinds.values()) == {"shared"}


def test_a_study_of_the_next_test_reads_the_tests_at_hand_as_they_were_fitted(
    of_quantity, tmp_path
):
    """A fit of cycle 2 became one of cycle 1, and fixed parameters were free again."""
    fixed = replace(of_quantity, held={"s1_k0": 5.5e6})
    fixed.write(tmp_path, pages=False)
    (tmp_path / "next.csv").touch()
    study = read_study(tmp_path / "joint.toml")
    assert (study.held, study.drive) == ({"s1_k0": 5.5e6}, "impact")
    second = replace(of_quantity.tests[0], cycle=2, cycles=(1, 2))
    (tmp_path / "second").mkdir()
    lost = replace(of_quantity.tests[0], path=tmp_path / "gone.csv")
    for test, why in ((second, "other cycles"), (lost, "is not found at")):
        other = replace(of_quantity, tests=(test,))
        other.write(tmp_path / "second", pages=False)
        assert not (tmp_path / "second/joint.toml").exists()
        assert why in other.sentences[-1]


def test_a_record_is_found_from_any_directory(soft, tmp_path):
    (tmp_path / "foam.csv").touch()
    test = replace(soft.measurement, path=Path("foam.csv"))
    replace(soft, measurement=test).save(tmp_path / "fits/foam/bistable", report=False)
    (found,), _ = plan_module._read([tmp_path / "fits/foam/bistable"])
    assert found.problem.measurement.path == tmp_path / "foam.csv"


def slow_test() -> Measurement:
    """A triangular loop of a microscale spring to a strain of 0.5 in 2 s, with 1 kPa of noise."""
    rng, time = np.random.default_rng(0), np.linspace(0.0, 2.0, 401)
    strain = 0.5 - 0.5 * np.abs(1.0 - time)
    spring = ff.MicroscaleSpring(8e5, 4e5, 0.3, 1.1e5, 0.4, 7e4, 0.6, relaxation=[(0.5, 0.3)])
    chain = ff.Chain([spring], [10e-3], 5e-5)
    stress = ff.simulate(chain, ff.DisplacementDrive(strain * 10e-3), time).base_stress
    return Measurement(
        "loop", None, "0" * 64, time, stress + 1e3 * rng.standard_normal(401), strain * 10e-3,
        Specimen(10e-3, 5e-5), noise=Noise(1e3, 1e-7), motion="measured",
    )  # fmt: skip


def test_two_springs_with_a_camera_have_candidates_with_an_interior_displacement(soft, tmp_path):
    rig = tmp_path / "RIG.toml"
    rig.write_text(RIG.format(force=200) + "interior = true\n", encoding="utf-8")
    asked = candidates(read_rig(rig, soft.measurement), soft.measurement, 2)
    assert {one.interior for one in asked} == {None, 1}
    text = next(one for one in asked if one.interior).toml(soft.measurement)
    assert "displacement_1" in text
    assert tomllib.loads(text)["specimen"]["height"] == "1.19 mm"


def test_a_slow_test_is_followed_by_cycles_and_holds(monkeypatch):
    fewer(monkeypatch)
    result = ff.fit(slow_test(), model="microscale", relaxation=1, starts=4)
    found = ff.plan(result)
    kinds = {(one.candidate.drive, one.candidate.hold > 0.0) for one in found.outcomes}
    assert kinds == {("displacement", False), ("displacement", True)}
    assert found.advice.number >= sum(one.probability for one in found.now.values())
    fast = [one for one in found.outcomes if one.candidate.rate > 1.0]
    slow = [one for one in found.outcomes if one.candidate.rate < 0.1]
    share = {id(one): one.expected["s1_tau1"].share for one in (*fast, *slow)}
    assert min(share[id(one)] for one in fast) < min(share[id(one)] for one in slow)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[strikr]\n", "strikr"),
        ("[striker]\nvelocity = 3\n", "velocity = 3"),
        ('[striker]\nvelocity = "6 to 2 m/s"\n', "0.5 to 6 m/s"),
        ('[striker]\nmasses = "7 g"\n', "masses must be a list"),
        ('[limits]\nforce = "500 mm"\n', "wrong dimension"),
        ('[limits]\nstrain = "-0.2"\n', "positive"),
        ("[limits]\nstrain = 90\n", 'strain = "90" must be between 0 and 1'),
        ('[machine]\nstrain = "0.1 to 1.7"\n', 'between 0 and 1, like "0.1 to 0.7"'),
        ("[machine]\ncycles = 0\n", "a whole number from 1 up"),
        ("[record]\nnoise = 3\n", "noise"),
        ('[record]\nnoise = { sress = "2 Pa" }\n', "sress"),
        ("velocity = 3\n", "velocity"),
        ("[striker\n", "not valid TOML"),
    ],
)
def test_a_wrong_rig_is_refused_by_name(soft, tmp_path, text, message):
    rig = tmp_path / "RIG.toml"
    rig.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"RIG\.toml") as refused:
        ff.plan(soft, rig=rig)
    assert message in str(refused.value)


def test_what_cannot_be_planned_is_refused(soft, tmp_path):
    with pytest.raises(InputError, match=r"no such file|not a folder"):
        ff.plan(tmp_path / "missing")
    with pytest.raises(InputError, match="seed = -1 is not admissible"):
        ff.plan(soft, seed=-1)
    with pytest.raises(InputError, match="at least one result"):
        ff.plan()
    with pytest.raises(InputError, match="peak_force"):
        ff.plan(soft, quantity="mass at 3 m/s")
    with pytest.raises(InputError, match="'peak_force at -3 m/s' needs a positive velocity"):
        ff.plan(soft, quantity="peak_force at -3 m/s")
    with pytest.raises(InputError, match="two results are of this record"):  # of any drive
        ff.plan(soft, ff.fit(soft.measurement, drive="stress", starts=1))
    run_refused("plan", tmp_path / "missing")


def test_init_writes_a_draft_of_the_rig_that_can_be_read(soft, here):
    run("init", "--rig", "RIG.toml")
    text = (here / "RIG.toml").read_text(encoding="utf-8")
    (here / "all.toml").write_text(text.replace("\n# ", "\n").replace("\nLines", "\n# Lines"))
    rig = read_rig(here / "all.toml", soft.measurement)
    assert (rig.velocity, rig.masses, rig.force) == ((0.5, 6.0), (0.007, 0.014), 500.0)
    assert rig.notes == ()
    run("init", "--rig", "RIG.toml", code=1)


def test_what_the_rig_does_not_state_is_taken_from_the_record_and_said():
    test = Measurement(
        "impact", None, "", np.linspace(0.0, 1e-3, 101), np.linspace(0.0, 1e6, 101),
        np.linspace(0.0, 1e-3, 101), Specimen(2e-3, 1e-5), Striker(7e-3, 2.0), Noise(1e4, 1e-6),
    )  # fmt: skip
    rig = read_rig(None, test)
    assert (rig.masses, rig.velocity, len(rig.notes)) == ((7e-3,), (1.0, 6.0), 5)
    assert rig.sampling == pytest.approx(1e5)
    assert rig.noise == {"stress": 1e4, "displacement": 1e-6}


def test_where_the_law_errs_ranges_are_expected_and_no_test_removes_them(monkeypatch):
    """A microscale foam that is fitted by the bistable law: its kinks are not in the record."""
    fewer(monkeypatch)
    result = ff.fit(slow_test(), model="bistable", starts=4)
    found = ff.plan(result)
    assert found.missed
    assert any("no test removes it" in sentence for sentence in found.sentences)
    again = next(one for one in found.outcomes if one.candidate.repeat)
    named = [n for n, one in result.parameters.items() if one.range and one.vary and n in found.now]
    wide = [name for name in named if result.parameters[name].state == "not determined"]
    assert all(again.expected[name].state != "determined" for name in wide)
