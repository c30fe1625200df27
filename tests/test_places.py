"""Where `foamfit fit` puts a result, which older result it replaces, and which it leaves alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

import fabricated
import foamfit as ff
from conftest import run, run_refused, without_pictures, write_csv
from foamfit.cli.others import _named

TOML = '[specimen]\nheight = "10 mm"\narea = "100 mm^2"\nmass = "1 g"\n'
FAST = ("--model", "linear", "--quiet", "--no-report")


def write(path: Path, seed: int = 0) -> Path:
    """Write a slow record of three cycles of a linear foam, as a rig would."""
    strain = np.tile(np.concatenate([np.linspace(0, 0.4, 40), np.linspace(0.4, 0, 40)[1:-1]]), 3)
    stress = 2.0 * strain + 2e-3 * np.random.default_rng(seed).standard_normal(strain.size)
    columns = 0.1 * np.arange(strain.size), stress, 10.0 * strain
    head = "time (s),stress (MPa),displacement (mm)"
    return write_csv(path, head, *columns, fmt="%.6f", toml=TOML)


@pytest.fixture(autouse=True)
def record(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a record; the pictures of results are placeholders."""
    without_pictures(monkeypatch)
    return write(here / "foam.csv")


def fit(*args: object) -> Result:
    return run("fit", "foam.csv", *args)


def fitted(*args: object) -> list[str]:
    """Run a fit, and return all result folders of the test afterwards."""
    fit(*args)
    return sorted(str(path.parent) for path in Path().rglob("*.json") if path.parent.parent.name)


def refused(*args: object) -> str:
    """Return the sentence with which a fit is refused before it is made; nothing changes."""
    before = files()
    with pytest.MonkeyPatch.context() as patch:
        for made in ("foamfit.study.cycles.fit", "foamfit.api.fit"):
            patch.setattr(made, lambda *_, **__: pytest.fail("the fit was made"))
        told = run_refused("fit", "foam.csv", *args)
    assert files() == before
    return told


def files() -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def content(folder: str | Path) -> dict[str, Any]:
    return json.loads((Path(folder) / "fit.json").read_text())


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ("", "bistable"),
        ("--drive displacement --seed 0 --cycle 1 --relaxation 0", "bistable"),
        ("--no-report --figure-width one --quiet", "bistable"),
        ("--specimen foam.toml", "bistable"),
        ("--model linear+bistable", "linear+bistable"),
        ("--model auto", "auto"),
        ("--drive stress", "bistable-stress"),
        ("--model microscale --drive stress --relaxation 1", "microscale-relaxation-1-stress"),
        ("--cycle 2", "bistable-cycle-2"),
        ("--model microscale --mullins --cycles 1-3", "microscale-mullins-cycles-1-3"),
        ("--model microscale --stiffening --cycles 2-3", "microscale-stiffening-cycles-2-3"),
        ("--specimen other.toml", "bistable-specimen-other"),
        ("--fix s1_k0=5.5e6 --fix s1_eta=0", "bistable-fix-s1_eta=0,s1_k0=5.5e+06"),
        ("--fix s1_k0=5512345.678 --vary s1_eta", "bistable-fix-s1_k0=5512345.678-vary-s1_eta"),
        ("--interior-mass --model linear+bistable", "linear+bistable-interior-mass"),
        ("--time-shift", "bistable-time-shift"),
        ("--starts 2 --seed 3 --max-time 60", "bistable-max-time-60-seed-3-starts-2"),
        ("--profile", "bistable-profile"),
        ("--mcmc 500", "bistable-mcmc-draws-500"),
    ],
)
def test_the_name_has_the_model_and_every_option_that_changes_the_numbers(
    record: Path, monkeypatch: pytest.MonkeyPatch, options: str, name: str
) -> None:
    record.with_name("other.toml").write_text(TOML)
    monkeypatch.setattr("foamfit.api.fit", lambda *_, **__: fabricated.result())
    assert fitted(*options.split()) == [f"fits/foam/{name}"]


def test_what_is_made_of_a_result_is_named_after_its_place() -> None:
    assert _named("fits/foam/bistable", cycle=2, drive=None) == "foam-bistable-cycle-2"
    assert _named("runs/foam", "foam-1/model-2", rig="slow") == "runs-foam+foam-1-model-2-rig-slow"
    Path("fits").touch()
    Path("plans/foam").mkdir(parents=True)
    Path("plans/foam/joint.toml").write_text(
        'tests = ["../../foam.csv", "b.csv"]\nmodel = "linear"\n'
    )
    assert "fits/foam-joint cannot" in run_refused("joint", "plans/foam/joint.toml")


def test_other_options_and_cycles_get_folders_of_their_own() -> None:
    assert fitted(*FAST) == ["fits/foam/linear"]
    first = files()
    for options in (["--seed", 1], ["--cycle", 2], ["--fix", "s1_eta=0"], ["--cycles", "1-2"]):
        fitted(*FAST, *options)
    assert sum(path.name == "fit.json" for path in files()) == 5
    assert {path: one for path, one in files().items() if path in first} == first
    assert content("fits/foam/linear")["options"] == {"model": "linear"}
    assert content("fits/foam/linear-seed-1")["options"] == {"model": "linear", "seed": 1}


@pytest.mark.parametrize("where", [[], ["--out", "fits/foam/linear"]])
def test_a_result_of_the_same_data_and_options_is_replaced_as_a_whole(where: list[str]) -> None:
    fitted(*FAST)
    (Path("fits/foam/linear") / "ladder.csv").write_text("of an older result")
    before = content("fits/foam/linear")
    fitted("--model", "linear", "--quiet", "--drive", "displacement", *where)
    names = {path.name for path in Path("fits/foam/linear").iterdir()}
    assert "ladder.csv" not in names
    assert "report.html" in names
    after = content("fits/foam/linear")
    del before["runtime_s"], after["runtime_s"]
    assert after == before


def test_a_result_of_other_data_or_options_is_replaced_by_force_alone(record: Path) -> None:
    there = ("--out", "fits/foam/linear")
    fitted(*FAST)
    told = refused(*FAST, "--seed", 1, "--cycle", 2, *there)
    assert "fits/foam/linear holds a result made with other options (seed, cycle)" in told
    assert "--force" in told
    assert "other options (model)" in refused("--quiet", *there)
    write(record.with_name("other.csv"))
    fitted(*FAST, "--specimen", "other.toml", "--out", "second")
    assert "other options (specimen)" in refused(*FAST, "--out", "second")
    write(record, seed=1)
    assert "fits/foam/linear holds a result of other data" in refused(*FAST)
    assert "other data" in refused(*FAST, *there)
    fitted(*FAST, "--force")
    after = content("fits/foam/linear")
    assert after["data_sha256"] == ff.read_test(record).data_sha256
    fitted(*FAST, "--seed", 1, "--force", *there)
    assert content("fits/foam/linear")["seed"] == 1


def test_a_corrected_toml_describes_the_same_test(record: Path) -> None:
    fitted(*FAST)
    record.with_suffix(".toml").write_text(TOML.replace("10 mm", "11 mm"))
    assert fitted(*FAST) == ["fits/foam/linear"]
    assert content("fits/foam/linear")["specimen"]["height"] == pytest.approx(11e-3)


def test_what_does_not_say_with_which_options_it_was_made_is_left_alone() -> None:
    """Results of older versions, of joint fits, and of parameters changed in Python."""
    fitted(*FAST)
    path = Path("fits/foam/linear/fit.json")
    older = content(path.parent)
    del older["options"]
    path.write_text(json.dumps(older))
    assert "does not say with which options it was made" in refused(*FAST)
    fitted(*FAST, "--force")
    test = ff.read_test("foam.csv")
    ff.fit(test, model="linear", params=ff.make_params(test, "linear")).save("mine", report=False)
    assert "does not say" in refused(*FAST, "--out", "mine")
    Path("together").mkdir()
    Path("together/joint.json").write_text('{"schema": 1, "foamfit": "0.2.0", "tests": {}}')
    assert "together holds a joint result, so it is" in refused(*FAST, "--out", "together")


def test_a_fit_from_python_is_compared_too() -> None:
    test = ff.read_test("foam.csv", cycle=2)
    made = ff.fit(test, model=" linear ", seed=1, drive="displacement", vary=["s1_eta"])
    made.save("mine", report=False)
    assert content("mine")["options"] == {
        "model": "linear", "seed": 1, "vary": ["s1_eta"], "cycle": 2,
    }  # fmt: skip
    assert "(cycle)" in refused(*FAST, "--seed", 1, "--vary", "s1_eta", "--out", "mine")
    fitted(*FAST, "--seed", 1, "--vary", "s1_eta", "--cycle", 2, "--out", "mine")
    read = ff.load("mine")
    assert isinstance(read, ff.FitResult)
    read.save("again", report=False)
    assert Path("again/fit.json").read_bytes() == Path("mine/fit.json").read_bytes()


def test_cycles_one_by_one_share_a_folder_and_are_compared_as_one() -> None:
    place = Path("fits/foam/linear-cycle-all")
    fitted(*FAST, "--cycle", "all")
    assert {path.name for path in place.iterdir() if path.is_dir()} == {
        "cycle-1", "cycle-2", "cycle-3",
    }  # fmt: skip
    fitted(*FAST, "--cycle", "3,2,1")
    assert [path.name for path in place.parent.iterdir()] == [place.name]
    fitted(*FAST, "--cycle", "1,3")
    assert {path.name for path in place.parent.iterdir()} == {place.name, "linear-cycle-1,3"}
    told = refused(*FAST, "--cycle", "1,2", "--out", place)
    assert f"{place} holds a result made with other options (cycle)" in told
    assert "(cycle)" in refused(*FAST, "--out", place)
    assert "(seed, cycle)" in refused(*FAST, "--seed", 1, "--cycle", 2, "--out", place)
    read = ff.load(place)
    assert isinstance(read, ff.CycleFits)
    read.save("again", report=False)
    assert Path("again/cycles.json").read_bytes() == (place / "cycles.json").read_bytes()


def test_init_overwrites_a_toml_by_force_alone(record: Path) -> None:
    toml, call = record.with_suffix(".toml"), ["init", "foam.csv"]
    told = run_refused(*call)
    assert "foam.toml exists already" in told
    assert "--force overwrites it" in told
    assert toml.read_text() == TOML
    run(*call, "--force")
    asked = toml.read_text()
    toml.unlink()
    run(*call, "--force")
    assert toml.read_text() == asked != TOML
