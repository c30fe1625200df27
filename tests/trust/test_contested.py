"""A contradiction in a record: default drive, first warning, printed lines and states."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

import foamfit as ff
from conftest import DATA, EXPERIMENTS, needs_data, without_pictures
from foamfit.cli import main
from foamfit.trust.contested import judged

sys.path.insert(0, str(EXPERIMENTS / "recovery"))
import rig

QUICK = {"starts": 4, "intervals": "local"}


def record_of(
    seed: int, *, velocity: float = 1.0, force: float = 1.0, mass: float = 1.0, **more: object
) -> rig.Record:
    """Return an impact whose file or TOML states wrong numbers, by these factors."""
    made = rig.impact(rig.Impact(law="microscale", samples=400, before=0.3, **more), seed)
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
    [
        ({"velocity": 0.9}, "velocity is given as"),
        ({"force": 0.85}, "impulse of the force is 0.8"),
        ({"mass": 1.15}, "impulse of the force is 0.8"),
    ],
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


def test_a_right_impact_stays_one(tmp_path: Path) -> None:
    test = ff.read_test(rig.write(record_of(2), tmp_path))
    result = ff.fit(test, model="microscale", **QUICK)
    assert (result.drive, result.contradictions) == ("impact", ())
    assert "contradictions" not in result.to_json_dict()
    assert result.parameters["s1_k0"].state == "determined"


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
    fitted = ff.fit(test, model="microscale", time_shift=True, **QUICK)
    assert fitted.contradictions == ()
    one = fitted.parameters["time_shift"]
    assert abs(one.value + lag) < 4 * one.stderr
    assert fitted.parameters["s1_k0"].state == "determined"
    assert far(fitted, made.truth) == []


@pytest.mark.parametrize(("clipped", "zero", "words"), [(5e5, 1e3, "clipped"), (None, 2e4, "zero")])
def test_a_doubtful_force_may_be_why_the_law_errs(
    clipped: float | None, zero: float, words: str
) -> None:
    def judge(clipped: float | None, zero: float, kept: dict[str, int]) -> tuple[str, str]:
        test = SimpleNamespace(
            outliers={"stress": SimpleNamespace(clipped_at=clipped)},
            zeros={"stress": zero},
            stress=np.array([0.0, 1e6]),
        )
        objective = SimpleNamespace(drive="impact")
        problem = SimpleNamespace(kept=kept, objective=objective, measurement=test)
        best = SimpleNamespace(problem=problem)
        return judged((), best, "s1_k0", (0.0, 1.0), ("determined", "as it is"))

    state, why = judge(clipped, zero, {"contact_time": 1})
    assert state == "weak"
    assert words in why
    assert judge(clipped, zero, {}) == ("determined", "as it is")
    assert judge(None, 1e3, {"contact_time": 1}) == ("determined", "as it is")


def test_the_scale_of_the_force_takes_its_deviation_as_prior(tmp_path: Path) -> None:
    path = rig.write(record_of(2), tmp_path)
    toml = path.with_suffix(".toml")
    columns = '[columns]\nforce = { column = "force (N)", scale = "1 ± 0.001" }\n'
    toml.write_text(toml.read_text() + columns)
    test = ff.read_test(path)
    held = ff.fit(test, model="microscale", **QUICK)
    assert "force_scale" not in held.parameters  # its ± is systematic
    assert held.parameters["s1_k0"].systematic > 0.0
    free = ff.fit(test, model="microscale", vary=["force_scale"], **QUICK)
    one = free.parameters["force_scale"]
    assert (one.unit, one.vary) == ("", True)
    assert 0.0 < one.stderr <= 0.001
    assert free.parameters["s1_k0"].systematic == 0.0


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


def test_force_and_acceleration_show_a_wrong_scale_of_the_force(tmp_path: Path) -> None:
    """Without a measured displacement the impact drive remains, with the contradiction first."""
    made = record_of(3, force=0.85, channels=("force", "acceleration"))
    test = ff.read_test(rig.write(made, tmp_path))
    result = ff.fit(test, model="microscale", **QUICK)
    assert result.drive == "impact"
    assert "impulse of the force is 0.85" in result.warnings[0]
    assert far(result, made.truth) == []
    free = ff.fit(test, model="microscale", vary=["force_scale"], **QUICK)
    assert free.parameters["force_scale"].value == pytest.approx(1 / 0.85, rel=0.01)


def test_the_terminal_prints_whole_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_pictures(monkeypatch)
    path = rig.write(record_of(2, velocity=0.9, force=0.8), tmp_path)
    call = ["fit", str(path), "--model", "microscale", "--starts", "4"]
    out = CliRunner().invoke(main, [*call, "--out", str(tmp_path / "out")])
    assert out.exit_code == 0, out.output
    lines = out.stdout.splitlines()
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    wanted = [one["lines"][0][1] for one in content["contradictions"]]
    assert [one.split(" =")[0] for one in wanted] == ["velocity", "force"]
    assert all(line in lines for line in wanted)
    assert any("[striker] and [columns]" in line for line in lines)
    assert max(map(len, lines[:-3])) <= 80
    assert len(lines) <= 24


def test_tests_of_a_joint_fit_and_a_batch_have_the_same_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_pictures(monkeypatch)
    rig.write(record_of(2, velocity=0.9), tmp_path, "wrong")
    rig.write(record_of(2), tmp_path, "right")
    study = tmp_path / "study.toml"
    study.write_text(
        'tests = ["*.csv"]\nmodel = "microscale"\nstarts = 4\n[parameters]\ns1_k0 = "shared"\n'
    )
    found = ff.joint(study, jobs=1)
    content = found.to_json_dict()
    drives = {name: one["drive"] for name, one in content["tests"].items()}
    assert drives == {"right": "impact", "wrong": "displacement"}
    assert found.warnings[0].startswith("Check wrong: the velocity is given as")
    table = ff.batch(
        tmp_path, out=tmp_path / "batch", model="microscale", starts=4, jobs=1, report=False
    )
    assert list(table["test"]) == ["right", "wrong"]
    each = {
        name: json.loads((tmp_path / "batch" / name / "fit.json").read_text())["drive"]
        for name in ("right", "wrong")
    }
    assert each == drives


def test_a_joint_impact_determines_nothing_that_would_move(tmp_path: Path) -> None:
    for seed in (2, 3):
        rig.write(record_of(seed, mass=1.15), tmp_path, f"test-{seed}")
    study = tmp_path / "study.toml"
    study.write_text(
        'tests = ["*.csv"]\nmodel = "microscale"\ndrive = "impact"\nstarts = 4\n'
        '[parameters]\ns1_eps_star = "shared"\n'
    )
    found = ff.joint(study, jobs=1)
    assert [text.split(":")[0] for text in found.warnings[:2]] == ["Check test-2", "Check test-3"]
    for name, one in found.parameters.items():
        assert one.kind == "own" or one.state != "determined", name
    for seed in (2, 3):
        own = found.results[f"test-{seed}"].parameters
        assert own["s1_k0"].state == "weak"
        assert "contradict each other" in own["s1_k0"].why
        assert far(SimpleNamespace(parameters=own), record_of(seed).truth) == []


@needs_data
def test_an_impact_on_cartilage_says_which_numbers_are_wrong(tmp_path: Path) -> None:
    toml = tmp_path / "test.toml"
    toml.write_text(
        '[specimen]\nheight = "0.563 mm"\ndiameter = "8.5 mm"\n'
        '[striker]\nmass = "358.39 g"\nvelocity = "0.9 m/s"\n'
    )
    test = ff.read_test(DATA / "cartilage-impact" / "test_1_impact.csv", toml)
    result = ff.fit(test, **QUICK)
    assert result.drive == "displacement"
    assert 'velocity = "0.788 m/s" under [striker]' in result.warnings[0]
    assert "scale = 1.30 } under [columns]" in result.warnings[1]
    impact = ff.fit(test, drive="impact", **QUICK)
    assert impact.warnings[0].startswith("Check: the velocity is given as 0.9 m/s")
    springs = [one.state for name, one in impact.parameters.items() if name.startswith("s1_")]
    assert "determined" not in springs
