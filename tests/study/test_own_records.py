"""Parameters of the record (contact, zeros, velocity) in joint fits, predictions and intervals.

The impacts are synthetic records of a rig (`experiments/recovery/rig.py`, which shares no code
with foamfit). Each has its own clock, zeros and striker.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS, without_pictures
from foamfit.fitting.nuisance import names_of
from foamfit.fitting.problem import make_problem
from foamfit.springs.parameters import NUISANCE
from foamfit.study.identified import read_source
from inline import Inline

sys.path.insert(0, str(EXPERIMENTS / "recovery"))
import rig

SPRING = tuple(f"s1_{name}" for name in (
    "k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta",
))  # fmt: skip
# Recorded from before contact; from contact on; with a velocity ± 1 %; force only.
SETUPS = (
    rig.Impact(before=0.4, samples=250),
    rig.Impact(trimmed=True, samples=250),
    rig.Impact(velocity_sd=0.01, samples=250),
    rig.Impact(channels=("force",), samples=250),
)
FASTER = (1.0, 0.9, 1.1, 1.05)


def write_impacts(folder: Path, seed: int, setups=SETUPS) -> list[rig.Record]:
    """Write impacts t0, t1, … on one spring by strikers of different velocities."""
    drawn = rig.drawn_impact(setups[0], np.random.default_rng([seed, 1])).rig
    records = []
    with pytest.MonkeyPatch.context() as patch:
        for i, (setup, factor) in enumerate(zip(setups, FASTER, strict=False)):
            one = replace(drawn, velocity=factor * drawn.velocity)
            course = one.run(0.0, 100.0 * one.heights[0] / one.velocity)
            patch.setattr(rig, "drawn_impact", lambda *_, course=course: course)
            records.append(rig.impact(setup, 100 * seed + i))
            rig.write(records[-1], folder, f"t{i}")
    return records


def fit_together(folder: Path, seed: int):
    records = write_impacts(folder, seed)
    shared = "\n".join(f'{name} = "shared"' for name in SPRING)
    (folder / "study.toml").write_text(
        f'tests = ["t*.csv"]\nmodel = "bistable"\nstarts = 2\n[parameters]\n{shared}\n'
    )
    return records, ff.joint(folder / "study.toml", jobs=1)


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    folder = tmp_path_factory.mktemp("impacts")
    return folder, *fit_together(folder, 0)


# ------------------------------------------------------------------------------- joint fits


def test_each_test_has_its_own_contact_zero_and_striker(together):
    _, records, found = together
    content = json.loads(json.dumps(found.to_json_dict(), allow_nan=False))["parameters"]
    assert list(content)[-len(set(content) & set(NUISANCE)) :] == [
        name for name in NUISANCE if name in content
    ]  # after the parameters of the springs
    assert content.keys() & NUISANCE.keys() == {
        "contact_time", "displacement_zero", "stress_zero", "velocity",
    }  # fmt: skip
    tests = {name: set(content[name]["tests"]) for name in content if name in NUISANCE}
    assert tests["contact_time"] == {"t0", "t1", "t2", "t3"}
    assert tests["displacement_zero"] == {"t0", "t1", "t2"}  # t3 records force only
    assert tests["velocity"] == {"t2"}
    for name in ("contact_time", "displacement_zero", "velocity"):
        assert content[name]["kind"] == "own"
        for test, one in content[name]["tests"].items():
            truth = records[int(test[1:])].truth[name]  # in the clock and zeros of the file
            assert abs(one["value"] - truth) < 4.0 * one["stderr"]
            assert one["ci95"][0] < one["value"] < one["ci95"][1]


def test_the_folder_of_each_test_has_its_own_numbers(together, tmp_path, monkeypatch):
    _, _, found = together
    without_pictures(monkeypatch)
    found.save(tmp_path / "out", jobs=1)
    content = json.loads((tmp_path / "out" / "joint.json").read_text())
    for test in ("t0", "t2"):
        single = json.loads((tmp_path / "out" / test / "fit.json").read_text())["parameters"]
        names = [name for name in single if name in NUISANCE]
        assert ("velocity" in names) == (test == "t2")
        for name in names:
            assert single[name]["value"] == content["parameters"][name]["tests"][test]["value"]
            assert single[name]["value"] == content["tests"][test]["values"][name]


def test_intervals_of_shared_values_hold_the_truth(together, tmp_path):
    """Over 20 draws, 93 % do (147 of 158). Of the 16 intervals here, one may miss."""
    inside, off = [], []
    for records, found in (together[1:], fit_together(tmp_path, 1)):
        for name in SPRING:
            one, truth = found.parameters[name], records[0].truth[name]
            inside.append(one.ci95[0] <= truth <= one.ci95[1])
            off.append(abs(one.value - truth) / one.stderr)
    assert np.mean(inside) > 0.9
    assert max(off) < 4.0


def test_a_value_that_the_study_holds_is_that_of_each_file(together):
    study = together[0] / "held.toml"
    study.write_text(
        'tests = ["t0.csv", "t1.csv"]\nmodel = "bistable"\nstarts = 2\n'
        "[parameters]\nstress_zero = 0\n"
    )
    found = ff.joint(study, jobs=1)
    held = found.parameters["stress_zero"]
    assert (held.kind, held.value) == ("fixed", 0.0)
    # Rows before contact show another value.
    assert found.estimates(0)["stress_zero"].value == 0.0
    assert found.problems[0].measurement.origins["stress_zero"] != 0.0


# ------------------------------------------------------------------------------- predictions


@pytest.fixture(scope="module")
def fitted(together):
    folder, _, _ = together
    return ff.fit(ff.read_test(folder / "t0.csv"), starts=2, intervals="local")


def test_an_unseen_impact_is_aligned_before_it_is_compared(together, fitted):
    folder, records, found = together
    for result in (found, fitted):
        for i in (0, 2, 3):
            made, truth = ff.predict(result, folder / f"t{i}.csv", draws=60), records[i].truth
            assert made.aligned["contact_time"] == pytest.approx(
                truth["contact_time"], abs=0.02 * records[i].course.end
            )
            assert made.parameters.keys() == {*SPRING, "site_eta"}
            assert all(share > 0.9 for share in made.inside.values())
            assert "not predicted (with the springs fixed)" in " ".join(made.sentences)
            assert made.to_json_dict()["aligned"] == made.aligned


def test_nothing_of_a_record_is_carried_to_another(together, fitted):
    source = read_source(fitted)
    assert not {*source.parameters, *source.names} & NUISANCE.keys()
    assert set(source.names) == set(fitted.correlation.names) - NUISANCE.keys()
    # the same impact written in two ways gets the same prediction
    folder, records, _ = together
    other = folder / "other"
    other.mkdir()
    rig.write(records[0].written_so(zero=2e-3, clock=5.0, skip=20), other, "t0")
    one, two = (ff.predict(fitted, f / "t0.csv", draws=60) for f in (folder, other))
    assert two.aligned["contact_time"] - one.aligned["contact_time"] == pytest.approx(5.0, abs=1e-6)
    for curve, off in one.misfit.items():
        assert off == pytest.approx(two.misfit[curve], rel=0.05)


def write_slow(folder: Path, seeds, law="microscale", rows=400):
    """Write slow tests of one spring; the displacement has noise of 0.3 % of its range."""
    setup = rig.Slow(law=law, rows=rows)
    course = rig.drawn_slow(setup, np.random.default_rng([seeds[0], 1]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig, "drawn_slow", lambda *_: course)
        return [rig.write(rig.slow(setup, seed), folder, f"t{seed}") for seed in seeds]


def test_the_band_holds_what_a_noisy_motion_leaves_uncertain(tmp_path):
    """Over 20 springs, each predicted from one fit, the band contains 94 to 96 % of the samples."""
    first, *others = write_slow(tmp_path, range(10, 15))
    result = ff.fit(ff.read_test(first), model="microscale", starts=2, intervals="local")
    made = [ff.predict(result, path, draws=60) for path in others]
    assert 0.93 < np.mean([one.inside["stress_strain"] for one in made]) < 0.99
    for one in made:
        curve = one.curves["stress_strain"]
        assert curve.half_width_of("motion") > 0.0
        assert "stress half width, motion (Pa)" in one.columns


# ------------------------------------------------------------------------------- a weighed motion


def test_a_joint_fit_weighs_each_driving_motion(tmp_path, monkeypatch):
    write_slow(tmp_path, (20, 21, 22))
    shared = '\ns1_k0 = "shared"\ns1_kc = "shared"\ns1_sigma_plus = "shared"'
    (tmp_path / "study.toml").write_text(
        'tests = ["t*.csv"]\nmodel = "microscale"\ndrive = "displacement"\nstarts = 2\n'
        f"[parameters]{shared}\n"
    )
    found = ff.joint(tmp_path / "study.toml", jobs=1)
    whole = [problem.objective.weighing for problem in found.problems]
    assert all(one is not None for one in whole)
    # Sharing values raises chi-square by no more than noise does, as both use the same weights.
    statistics = found.statistics
    assert 0.0 < statistics["chisqr"] - statistics["chisqr_alone"] < 40.0
    held = found.problems[0].holding("s1_k0", 1.0)
    assert held.objective.weighing is whole[0]


def test_profiles_agree_with_the_local_intervals(together, tmp_path):
    folder, _, _ = together
    (slow,) = write_slow(tmp_path, (30,), law="bistable", rows=300)
    for path in (folder / "t2.csv", slow):
        test = ff.read_test(path)
        local = ff.fit(test, intervals="local", starts=2).parameters
        other = ff.fit(test, intervals="profile", starts=2).parameters
        wider = [
            np.ptp(other[name].ci95) / np.ptp(local[name].ci95)
            for name in local
            if local[name].ci95 is not None and other[name].ci95 is not None
        ]
        assert len(wider) >= 6
        assert 0.7 < np.median(wider) < 1.4


# ------------------------------------------------------------------------------- batch, page, auto


def test_a_batch_fixes_and_varies_what_a_record_does_not_say(together, tmp_path):
    folder, _, _ = together
    quick = {"starts": 2, "intervals": "local", "report": False, "executor": Inline()}
    fixed = {"stress_zero": 0.0}
    frame = ff.batch(
        [folder / "t1.csv", folder / "t2.csv"], out=tmp_path / "out", fix=fixed,
        vary=["velocity"], **quick,
    ).set_index("test")  # fmt: skip
    assert frame.loc["t2", "velocity_stderr"] > 0.0
    assert frame.loc["t2", ["stress_zero", "stress_zero_state"]].tolist() == [0.0, "fixed"]
    assert np.all(frame["contact_time_stderr"] > 0.0)
    places = [frame.columns.get_loc(name) for name in ("s1_eta", "displacement_zero", "velocity")]
    assert places == sorted(places)  # after those of the springs, in a fixed order
    with pytest.raises(ff.InputError, match=r"its parameters are s1_k0, .*, contact_time, "):
        ff.batch(folder, out=tmp_path / "no", fix={"contact": 0.0}, **quick)
    with pytest.raises(ff.InputError, match="'stress_zero' is not one of the model"):
        ff.batch(folder, out=tmp_path / "no", fix=fixed, drive="stress", **quick)
    assert not (tmp_path / "no").exists()


def test_what_nothing_shows_cannot_vary(together):
    test = ff.read_test(together[0] / "t1.csv")
    params = ff.make_params(test)
    params["acceleration_zero"].set(vary=True)
    with pytest.raises(ff.InputError, match="'acceleration_zero' cannot vary"):
        ff.fit(test, params=params)


def test_a_fit_of_a_record_from_before_contact_is_drawn_on_the_page(fitted):
    pytest.importorskip("panel")
    from foamfit.page.turning import Turning

    told = {name: one.value for name, one in fitted.parameters.items()}
    turning = Turning(fitted.measurement, "bistable", told)
    assert not {row.name for row in turning.rows} & NUISANCE.keys()  # without controls on the page
    drawn = turning.turn({})
    _, stress = drawn.curves["stress_time"]
    np.testing.assert_allclose(stress, fitted.curves.stress, atol=1e-6 * np.ptp(stress))
    assert drawn.misfit["stress_time"] == pytest.approx(fitted.misfit["stress_time"], rel=1e-3)


def test_richer_models_start_from_the_contact_that_simpler_ones_found(fitted):
    from foamfit.auto import _carry
    from foamfit.springs.model import Model

    model = Model.parse("linear+bistable")
    params = ff.make_params(fitted.measurement, model)
    _carry(params, model, [SimpleNamespace(result=fitted, chisqr=1.0)])
    for name in ("contact_time", "displacement_zero"):
        assert params[name].value == fitted.params[name].value
        assert params[name].min < params[name].value < params[name].max


# ------------------------------------------------------------------------------- two clocks


def write_two_clocks(folder: Path, seed: int, late: float) -> dict[str, float]:
    """Write a force at 1 MHz and a camera at 50 kHz whose clock lags by `late` seconds."""
    setup = rig.Impact(samples=250)
    made = rig.drawn_impact(setup, np.random.default_rng([3, 1])).rig
    course = made.run(0.0, 100.0 * made.heights[0] / made.velocity)
    noise = np.random.default_rng(seed)
    time = np.arange(-0.3 * course.end, 1.2 * course.end, 1e-6)
    frames = np.arange(-0.2 * course.end, 1.1 * course.end, 20e-6)
    force, moved = course.stress(time) * made.area, course.top(frames, gauge=False)
    force = force + 0.005 * np.ptp(force) * noise.standard_normal(force.size)
    moved = moved + 0.005 * np.ptp(moved) * noise.standard_normal(moved.size)
    for name, head, table in (
        ("test.csv", "time (us),force (N)", (1e6 * time, force)),
        ("camera.csv", "time (us),displacement (um)", (1e6 * (frames - late), 1e6 * moved)),
    ):
        np.savetxt(
            folder / name, np.column_stack(table), delimiter=",", header=head, comments="",
            fmt="%.9g",
        )  # fmt: skip
    (folder / "test.toml").write_text(
        f'[specimen]\nheight = "{made.heights[0]} m"\narea = "{made.area} m^2"\n'
        f'[striker]\nmass = "{made.mass} kg"\nvelocity = "{made.velocity} m/s"\n'
        '[motion]\nfile = "camera.csv"\ndelay = "0 ± 50 us"\n'
    )
    return {f"s1_{name}": getattr(made.springs[0], name) for name in ("k0", "eps_a", "eps_c")}


def test_a_delay_with_a_spread_is_fitted_as_a_time_shift(tmp_path):
    truth = write_two_clocks(tmp_path, 0, 30e-6)
    test = ff.read_test(tmp_path / "test.csv")
    assert "time_shift" in ff.make_params(test)
    result = ff.fit(test, starts=2, intervals="local")
    shift = result.parameters["time_shift"]
    # time of the force = time of the motion + 30 µs, so the motion is 30 µs early
    assert abs(shift.value + 30e-6) < 2.0 * shift.stderr
    assert shift.stderr < 10e-6  # far below the standard deviation of the prior
    for name, value in truth.items():
        one = result.parameters[name]
        assert abs(one.value - value) < 3.0 * one.stderr
    problem = make_problem(test, "bistable", None, None, None, interior_mass=False)
    assert problem.objective.nuisance == names_of("impact", time_shift=True)
    prior = {one.name: one.sigma for one in problem.objective.priors}["time_shift"]
    assert prior == pytest.approx(50e-6)
