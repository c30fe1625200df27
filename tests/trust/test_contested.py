"""A contradiction in a record: default drive, first warning, printed lines and states."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
import records
import rig
from conftest import DATA, needs_data, run, without_pictures
from foamfit.data.energy import audit

QUICK = {"starts": 2, "intervals": "local"}


def record_of(
    seed: int, *, velocity: float = 1.0, force: float = 1.0, mass: float = 1.0, **more: object
) -> rig.Record:
    """Return an impact whose file or TOML states wrong numbers, by these factors."""
    more = {"samples": 120} | more
    made = rig.impact(rig.Impact(law="microscale", before=0.3, **more), seed)
    channels = dict(made.channels)
    if "force" in channels:
        channels["force"] = force * channels["force"]
    other = replace(made.rig, mass=mass * made.rig.mass)
    stated = f"{velocity * made.rig.velocity:.8g} m/s"
    return replace(made, channels=channels, rig=other, toml_velocity=stated)


def far(result: ff.FitResult, truth: dict[str, float]) -> list[str]:
    """Return the determined springs whose interval misses the truth by more than its width."""
    out = []
    for name, one in result.parameters.items():
        if one.state == "determined" and name.startswith("s1_") and name in truth:
            low, high = one.ci95
            if max(low - truth[name], truth[name] - high) > high - low:
                out.append(name)
    return out


@pytest.mark.parametrize(
    ("wrong", "word"),
    [({"velocity": 0.9}, "velocity is given as"), ({"mass": 1.15}, "impulse of the force is 0.8")],
)
def test_a_contradicted_impact_is_driven_by_its_motion(
    wrong: dict[str, float], word: str, tmp_path: Path
) -> None:
    made = record_of(2, **wrong)
    test = ff.read_test(rig.write(made, tmp_path))
    default = ff.fit(test, model="microscale", **QUICK)
    assert default.drive == "displacement"
    assert default.status == "warnings"
    assert word in default.warnings[0]
    assert default.contradictions[0].lines[0][1] in default.warnings[0]
    assert far(default, made.truth) == []
    stresses = {default.parameters[f"s1_{name}"].state for name in ("k0", "sigma_plus")}
    if "velocity" in wrong:  # a given motion does not depend on it
        assert stresses == {"determined"}
    else:
        assert stresses == {"weak"}
        assert "with force ×" in default.parameters["s1_k0"].why
    assert default.parameters["s1_eps_star"].state == "determined"
    impact = ff.fit(test, model="microscale", drive="impact", **QUICK)
    assert word in impact.warnings[0]
    assert far(impact, made.truth) == []
    states = {one.state for name, one in impact.parameters.items() if name.startswith("s1_")}
    assert "determined" not in states
    content = impact.to_json_dict()
    assert content["contradictions"][0]["quantity"] == impact.contradictions[0].quantity
    impact.save(tmp_path / "out", report=False)
    assert ff.load(tmp_path / "out").contradictions == impact.contradictions


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"velocity": 0.9}, "velocity"),
        ({"force": 0.85}, "force_scale"),
        ({"mass": 1.15}, "striker_mass"),
    ],
)
def test_a_varied_number_settles_it_and_is_found(
    wrong: dict[str, float], name: str, tmp_path: Path
) -> None:
    made = record_of(2, **wrong)
    truth = made.truth | {"force_scale": 1 / wrong.get("force", 1.0)}
    test = ff.read_test(rig.write(made, tmp_path))
    result = ff.fit(test, model="microscale", vary=[name], **QUICK)
    assert (result.drive, result.contradictions) == ("impact", ())
    one = result.parameters[name]
    assert one.state == "determined"
    assert abs(one.value - truth[name]) < 4 * one.stderr < 0.02 * truth[name]
    for spring in ("k0", "kc", "eps_star", "sigma_plus"):
        item = result.parameters[f"s1_{spring}"]
        assert item.state == "determined"
        assert abs(item.value - truth[f"s1_{spring}"]) < 4 * item.stderr
    assert not any("impulse" in one or "given as" in one for one in result.warnings)
    assert not any("--time-shift" in one for one in result.warnings)


def test_a_contradicted_impact_without_its_rebound_is_reported(tmp_path: Path) -> None:
    """The sentence on the balance needed a ratio, which only the rebound shows."""
    made = record_of(2, force=2.0)
    path = rig.write(made, tmp_path)
    rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text("".join(rows[: 1 + len(rows) // 2]), encoding="utf-8")
    test = ff.read_test(path)
    assert audit(test).impulse_ratio is None
    result = ff.fit(test, **QUICK)
    (check,) = (one for one in result.checklist if one.key == "impulse")
    assert check.sentence == "Force and motion contradict each other."


def test_a_lag_of_the_force_determines_nothing_until_it_is_fitted(tmp_path: Path) -> None:
    made = record_of(2)
    lag = 0.03 * made.course.end
    late = np.interp(made.time - lag, made.time, made.channels["force"])
    made = replace(made, channels=made.channels | {"force": late})
    test = ff.read_test(rig.write(made, tmp_path))
    result = ff.fit(test, model="microscale", **QUICK)
    assert result.drive == "impact"
    (told,) = (one for one in result.warnings if "early" in one)
    assert told.startswith("Check: the motion is early against the force by")
    assert "--time-shift" in told
    states = {one.state for name, one in result.parameters.items() if name.startswith("s1_")}
    assert "determined" not in states
    fitted = ff.fit(test, model="microscale", time_shift=True, **QUICK | {"starts": 4})
    assert fitted.contradictions == ()
    one = fitted.parameters["time_shift"]
    assert abs(one.value + lag) < 4 * one.stderr
    assert fitted.parameters["s1_k0"].state == "determined"
    assert far(fitted, made.truth) == []


def test_starts_are_read_off_the_loop_as_the_striker_delays_it(tmp_path: Path) -> None:
    """From the loop as filed, the search ended in another minimum, one value of it determined."""
    made = record_of(7, delay_sd=0.1, samples=200)
    result = ff.fit(ff.read_test(rig.write(made, tmp_path)), model="microscale", **QUICK)
    assert far(result, made.truth) == []


def test_a_stated_delay_that_the_record_excludes_is_named(tmp_path: Path) -> None:
    """Eight standard deviations off, kc was determined, seven errors from the truth."""
    made = record_of(2, delay_sd=0.1, samples=200)
    stated = replace(made, delay_sd=abs(made.truth["time_shift"]) / 10.0)
    result = ff.fit(ff.read_test(rig.write(stated, tmp_path)), model="microscale", **QUICK)
    assert any("correct delay under [motion]" in one for one in result.warnings)
    assert far(result, made.truth) == []


@pytest.mark.parametrize(
    ("more", "kw", "words"),
    [
        ({}, {"drive": "displacement", "vary": ["force_scale"]}, "scale of all stiffnesses"),
        ({}, {"drive": "stress", "vary": ["force_scale"]}, "scale of all stiffnesses"),
        ({}, {"drive": "displacement", "vary": ["velocity"]}, "needs no striker"),
        ({"channels": ("force",)}, {"vary": ["force_scale"]}, "nothing that would show it"),
    ],
)
def test_what_the_record_cannot_show_is_refused(
    more: dict[str, object], kw: dict[str, object], words: str, tmp_path: Path
) -> None:
    test = ff.read_test(rig.write(record_of(2, **more), tmp_path))
    with pytest.raises(ff.InputError, match=words) as caught:
        ff.fit(test, **kw)
    assert "\n" not in str(caught.value)


def test_the_terminal_prints_whole_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_pictures(monkeypatch)
    path = rig.write(record_of(2, velocity=0.9, force=0.8), tmp_path)
    call = ["fit", str(path), "--model", "microscale", "--starts", "2"]
    out = run(*call, "--out", str(tmp_path / "out"))
    lines = out.stdout.splitlines()
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    wanted = [one["lines"][0][1] for one in content["contradictions"]]
    assert [one.split(" =")[0] for one in wanted] == ["velocity", "force"]
    assert all(line in lines for line in wanted)
    assert any("[striker] and [columns]" in line for line in lines)
    assert max(map(len, lines[:-3])) <= 80
    assert len(lines) <= 24


def test_tests_of_a_joint_fit_have_the_same_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_pictures(monkeypatch)
    rig.write(record_of(2, velocity=0.9), tmp_path, "wrong")
    rig.write(record_of(2, force=1.0001), tmp_path, "right")  # other rows
    study = tmp_path / "study.toml"
    study.write_text(
        'tests = ["*.csv"]\nmodel = "microscale"\nstarts = 2\n[parameters]\ns1_k0 = "shared"\n'
    )
    found = ff.joint(study)
    content = found.to_json_dict()
    drives = {name: one["drive"] for name, one in content["tests"].items()}
    assert drives == {"right": "impact", "wrong": "displacement"}
    assert found.warnings[0].startswith("Check wrong: the velocity is given as")


@needs_data
def test_an_impact_on_cartilage_says_which_numbers_are_wrong(tmp_path: Path) -> None:
    test = ff.read_test(records.place("cartilage 1", tmp_path, DATA))
    result = ff.fit(test, model="linear", **QUICK)
    assert result.drive == "displacement"
    assert 'velocity = "0.788 m/s" under [striker]' in result.warnings[0]
    assert "scale = 1.30 } under [columns]" in result.warnings[1]
    impact = ff.fit(test, model="linear", drive="impact", **QUICK)
    assert impact.warnings[0].startswith("Check: the velocity is given as 0.9 m/s")
    springs = [one.state for name, one in impact.parameters.items() if name.startswith("s1_")]
    assert "determined" not in springs


@needs_data
def test_a_chain_counts_the_error_of_a_zero_that_is_held(tmp_path: Path) -> None:
    """Its interval had noise alone, 200 Pa instead of 50 kPa."""
    test = ff.read_test(records.place("turbo-comp-2", tmp_path))
    result = ff.fit(test, model="linear", intervals="mcmc", draws=200)
    one = result.parameters["s1_k0"]
    assert "displacement_zero" not in result.problem.free()
    assert one.ci95[1] - one.ci95[0] == pytest.approx(3.92 * one.stderr, rel=0.15)
