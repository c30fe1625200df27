"""Several cycles as one history, and springs that remember, from the file to the prediction."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import foamfit as ff
from foamfit.cli import main
from foamfit.data.cycles import cycles_of
from foamfit.springs.model import Model

TRUTH = ff.MicroscaleSpring(
    5e5, 3e5, 0.25, 1.2e5, 0.4, 5.5e4, 0.6, stiffening=1.8, softening=0.7, weakening=0.4
)
AREA, HEIGHT = 5e-5, 0.01


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four synthetic cycles of one spring, written as a rig does: arbitrary zeros, noise."""
    folder, rng = tmp_path_factory.mktemp("cycles"), np.random.default_rng(5)
    corners = np.array([0.0, 0.0, 0.55, 0.0, 0.0, 0.55, 0.0, 0.0, 0.55, 0.0, 0.0, 0.55, 0.0, 0.0])
    times = np.array([0.0, 0.4, 2.0, 3.6, 3.9, 5.5, 7.1, 7.4, 9.0, 10.6, 10.9, 12.5, 14.1, 14.4])
    t = np.arange(0.0, 14.4, 0.015)
    strain = np.interp(t, times, corners)
    force = AREA * TRUTH.stress(strain) + 0.05 + rng.normal(0.0, 0.02, t.size)
    moved = 1e3 * HEIGHT * strain + 3.0
    table = np.column_stack([t + 1.0, force, moved])
    np.savetxt(
        folder / "foam.csv", table, "%.6f", ",", header="time (s),force (N),displacement (mm)",
        comments="",
    )  # fmt: skip
    (folder / "foam.toml").write_text('[specimen]\nheight = "10 mm"\narea = "50 mm^2"\n')
    return folder / "foam.csv"


def test_cycles_are_read_as_one_history(record: Path) -> None:
    test = ff.read_test(record, cycles=(1, 3))
    assert (test.cycle, test.last_cycle, test.cycles) == (1, 3, (1, 2, 3, 4))
    assert test.displacement is not None
    spans = cycles_of(test)
    assert list(spans) == [1, 2, 3]
    for part in spans.values():
        assert test.displacement[part].max() == pytest.approx(0.55 * HEIGHT, rel=0.01)
    later = ff.read_test(record, cycles=(2, 3))
    assert list(cycles_of(later)) == [2, 3]
    assert len(cycles_of(ff.read_test(record, cycle=2))) == 0


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        (["--cycles", "3-1"], "'3-1' is not FIRST-LAST in that order, like 1-3"),
        (["--cycles", "2"], "'2' is not FIRST-LAST"),
        (["--cycles", "1-9"], "cycle 9 cannot be taken: the file has cycles 1 to 4"),
        (["--cycles", "1-3", "--cycle", "2"], "either --cycle or --cycles, not both"),
        (["--mullins"], "mullins needs a microscale spring, and the model 'bistable' has none"),
        (["--stiffening", "--model", "linear"], "stiffening needs a microscale spring"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(record: Path, given: list[str], wrong: str) -> None:
    told = CliRunner().invoke(main, ["fit", str(record), *given])
    assert told.exit_code == 1
    assert wrong in told.output + (told.stderr or "")
    assert "Traceback" not in told.output


def test_cycles_of_a_record_without_any_are_refused(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 60)
    table = np.column_stack([t, 0.3 * t, 2e5 * t])
    np.savetxt(tmp_path / "a.csv", table, "%.6g", ",", header="time (s),strain,stress (Pa)",
               comments="")  # fmt: skip
    (tmp_path / "a.toml").write_text('[specimen]\nheight = "10 mm"\narea = "50 mm^2"\n')
    with pytest.raises(ff.InputError, match="cycles 1 to 3 cannot be taken: the record has no"):
        ff.read_test(tmp_path / "a.csv", cycles=(1, 3))


def test_one_set_of_parameters_for_all_cycles_and_the_next(record: Path, tmp_path: Path) -> None:
    """Identified from cycles 1 to 3 through the file, and a fourth is predicted."""
    call = ["fit", str(record), "--model", "microscale", "--stiffening", "--mullins"]
    call += ["--cycles", "1-3", "--starts", "6", "--out", str(tmp_path / "fit"), "--quiet"]
    told = CliRunner().invoke(main, [*call, "--no-report"])
    assert told.exit_code == 0, told.output
    content = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert (content["model"], content["stiffening"], content["mullins"]) == (
        "microscale", True, True,
    )  # fmt: skip
    assert (content["data"]["cycle"], content["data"]["last_cycle"]) == (1, 3)
    assert Model.of_result(content).laws[0].own[-3:] == ("stiffening", "softening", "weakening")
    for name in ("softening", "weakening", "sigma_plus", "k0"):
        found = content["parameters"][f"s1_{name}"]
        assert abs(found["value"] - getattr(TRUTH, name)) < 4.0 * found["stderr"], name
        assert found["state"] == "determined"
    said = CliRunner().invoke(
        main,
        ["predict", str(tmp_path / "fit"), str(record), "--cycles", "1-4", "--draws", "60",
         "--out", str(tmp_path / "next"), "--quiet"],
    )  # fmt: skip
    assert said.exit_code == 0, said.output
    found = json.loads((tmp_path / "next" / "prediction.json").read_text())["by_cycle"]
    assert list(found) == ["1", "2", "3", "4"]
    assert found["4"]["misfit"] < 0.01
    assert found["4"]["inside"] > 0.85


def test_a_scene_file_may_name_what_a_spring_remembers(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(
        '[chain]\narea = "50 mm^2"\n[[chain.springs]]\nkind = "microscale"\nk0 = "0.5 MPa"\n'
        'kc = "0.3 MPa"\neps_star = 0.25\nsigma_plus = "0.12 MPa"\nspread_plus = 0.4\n'
        'sigma_minus = "55 kPa"\nspread_minus = 0.6\nsoftening = 0.7\nheight = "10 mm"\n'
        '[drive]\nkind = "impact"\nmass = "1 kg"\nvelocity = "1 m/s"\n[time]\nend = "40 ms"\n'
    )
    from foamfit.scene_file import read_scene

    spring = read_scene(scene)[0].springs[0]
    assert spring.values[-4:] == (1.0, 0.7, 0.0, 0.0)


def test_a_batch_and_a_toml_take_several_cycles(record: Path, tmp_path: Path) -> None:
    out = tmp_path / "runs"
    rows = ff.batch(
        [record], out=out, model="microscale", mullins=True, cycles=(1, 2), starts=2, jobs=1,
        report=False, max_time=20.0,
    )  # fmt: skip
    assert rows["status"].tolist() != ["refused"], rows["error"].tolist()
    content = json.loads((out / "foam" / "fit.json").read_text())
    assert (content["data"]["last_cycle"], content["mullins"]) == (2, True)
    toml = record.with_name("own.toml")
    toml.write_text(record.with_suffix(".toml").read_text() + "[window]\ncycles = [2, 4]\n")
    assert ff.read_test(record, toml).last_cycle == 4
    assert ff.read_test(record, toml, cycle=1).last_cycle is None
    toml.write_text(record.with_suffix(".toml").read_text() + "[window]\ncycles = 3\n")
    with pytest.raises(ff.InputError, match=r"\[window\] cycles = 3 must be the numbers"):
        ff.read_test(record, toml)


def test_a_branch_of_the_first_sample_was_reached(record: Path) -> None:
    """A spring that snaps at the first sample already has reached that branch."""
    test = ff.read_test(record, cycles=(1, 3))
    found = ff.fit(
        test, model="microscale", mullins=True, starts=2, intervals="local", max_time=30.0
    )
    assert "snap-through" in found.visited["s1"]
    assert "never reached" not in found.parameters["s1_sigma_plus"].why
