"""A user-defined law from the file given by --law is available to all commands and processes."""

import json
from pathlib import Path

import numpy as np
import pytest

from conftest import SPECIMEN, run, run_refused, without_pictures, write_csv
from foamfit.errors import InputError
from foamfit.springs import laws

# An elastic law suffices, because only its availability is tested.
LAW = """\
import foamfit as ff

def stress(p, x, strain, branch):
    return p[0] * strain + p[1] * strain**3


LAW = ff.Law(
    kind="cubic",
    title="cubic spring",
    hysteretic=False,
    params=(
        ff.Param("k", ("k", ""), "Pa", "slope", (1.0, "slope"), (1e-2, 1e2), "slope",
                 example="1 MPa"),
        ff.Param("q", ("q", ""), "Pa", "factor of the cube", (1.0, "slope"), (1e-2, 1e2), "slope",
                 example="3 MPa"),
    ),
    functions=ff.Functions(stress),
)
"""
TRUE = {"s1_k": 2e5, "s1_q": 1e6}


@pytest.fixture(scope="module")
def cubic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the law file once per module, so that it is compiled only once."""
    path = tmp_path_factory.mktemp("law") / "cubic.py"
    path.write_text(LAW)
    return path


@pytest.fixture(autouse=True)
def tests(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write two tests of the law; registered laws are removed after each test."""
    monkeypatch.setattr(laws, "_LAWS", dict(laws._LAWS))
    monkeypatch.setattr(laws, "_TEXTS", dict(laws._TEXTS))
    without_pictures(monkeypatch)
    strain = 0.5 * np.sin(np.linspace(0.0, np.pi, 61))
    stress = TRUE["s1_k"] * strain + TRUE["s1_q"] * strain**3
    for seed in (1, 2):
        noise = 500.0 * np.random.default_rng(seed).standard_normal(strain.size)
        head = "time (s),stress (Pa),strain"
        columns = np.arange(61), stress + noise, strain
        write_csv(here / f"t{seed}.csv", head, *columns, toml=SPECIMEN)


def test_a_law_of_a_file_simulates(here: Path, cubic: Path) -> None:
    (here / "drive.csv").write_text("time (s),displacement (mm)\n0,0\n1,2\n2,4\n3,0\n")
    (here / "scene.toml").write_text(
        '[chain]\narea = "1 cm^2"\n[[chain.springs]]\nkind = "cubic"\nheight = "10 mm"\n'
        'k = "0.2 MPa"\nq = "1 MPa"\n[drive]\nkind = "displacement"\nfile = "drive.csv"\n'
    )
    assert "kind = 'cubic'" in run_refused("simulate", "scene.toml")
    run("simulate", "scene.toml", "--law", cubic)
    stress, strain = np.loadtxt(here / "scene.csv", delimiter=",", skiprows=1).T[1:3]
    np.testing.assert_allclose(strain, [0.0, 0.2, 0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(stress, 2e5 * strain + 1e6 * strain**3, rtol=1e-9, atol=1e-6)


def test_a_law_of_a_file_is_fitted_and_predicts(
    here: Path, cubic: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ("--model", "cubic", "--law", cubic, "--starts", 2, "--out", "r", "--json")
    told = run("fit", "t1.csv", *asked)
    found = json.loads(told.stdout)["parameters"]
    for name, true in TRUE.items():
        assert found[name]["state"] == "determined"
        assert found[name]["value"] == pytest.approx(true, rel=0.02)
    monkeypatch.setattr(laws, "_LAWS", {k: v for k, v in laws._LAWS.items() if k != "cubic"})
    for wrong in (("predict", "r", "t2.csv"), ("plan", "r"), ("compare", "r", "r")):
        told = run_refused(*wrong)
        assert "'cubic' is not a spring" in told
        assert "--law FILE.py" in told  # and not: fit again
        assert not {"again", "wrote"} & {*told.split()}
    told = run("predict", "r", "t2.csv", "--law", cubic, "--json", "--no-report")
    assert json.loads(told.stdout)["misfit"]["stress_strain"] < 0.01


def test_processes_of_a_batch_know_the_law_as_it_is_now(here: Path) -> None:
    """After a change of the law file, the batch repeats finished fits."""
    (here / "cubic.py").write_text(LAW)
    asked = ("t1.csv", "--model", "cubic", "--law", "cubic.py", "--starts", 1, "--jobs", 1)
    told = run("batch", *asked, "--json", "--no-report", "--out", "b")
    (first,) = json.loads(told.stdout)
    assert first["s1_q"] == pytest.approx(TRUE["s1_q"], rel=0.02)
    (here / "cubic.py").write_text(LAW.replace("strain**3", "strain**2"))
    told = run("batch", *asked, "--json", "--no-report", "--out", "b")
    (second,) = json.loads(told.stdout)
    assert second["s1_q"] != pytest.approx(first["s1_q"], rel=0.1)


def test_no_toml_no_result_and_no_browser_names_a_law_file(here: Path) -> None:
    """A law file is code, so only the command line may name one."""
    from foamfit.page.worker import parsed

    (here / "law.py").write_text("import pathlib\npathlib.Path('run').touch()\n")
    (here / "scene.toml").write_text('law = "law.py"\n[chain]\npublished = "foam-2"\n')
    assert "'law'" in run_refused("simulate", "scene.toml")
    (here / "study.toml").write_text('law = "law.py"\ntests = ["t1.csv"]\nmodel = "linear"\n')
    assert "'law'" in run_refused("joint", "study.toml")
    (here / "t1.toml").write_text('law = "law.py"\n[specimen]\nheight = "1 cm"\narea = "1 cm^2"\n')
    assert "'law'" in run_refused("check", "t1.csv")
    for given in (["--law", "law.py"], ["--law=law.py"]):
        with pytest.raises(InputError, match="--law"):
            parsed(given)
    with pytest.raises(InputError, match="law"):
        parsed(["--model", "--law=law.py"]) and laws.law("--law=law.py")
    assert not (here / "run").exists()
