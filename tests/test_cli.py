"""The command line as a user calls it: printed output, written files and error messages."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

import fabricated
import foamfit as ff
from conftest import HEADER, RECONSTRUCTION, SPECIMEN, STRIKER, run, run_refused, small_pictures

COMMANDS = (
    "batch", "check", "fit", "init", "simulate", "compare", "published", "joint", "predict"
)  # fmt: skip

LOOP = np.sin(np.linspace(0.0, np.pi, 41))
ROWS = [f"{i},{2 * y:.6f},{4 * y:.6f}" for i, y in enumerate(LOOP)]


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def accepted(*args: object) -> Result:
    result = run(*args)
    assert result.stderr == ""
    return result


def refused(folder: Path, *args: object, words: tuple[str, ...]) -> None:
    """Check for one error sentence with these words, exit code 1 and no new files."""
    before = files(folder), {*folder.rglob("*")}
    told = run_refused(*args)
    for word in words:
        assert word in told
    assert (files(folder), {*folder.rglob("*")}) == before


pytestmark = pytest.mark.usefixtures("here")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """Fit a reconstruction once without --out; return the directory and the printed output.

    The pictures are placeholders; the tests of separate processes draw real ones.
    """
    folder = tmp_path_factory.mktemp("fitted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        small_pictures(patch)
        result = run("fit", RECONSTRUCTION, "--seed", 1, "--starts", 4)
    return folder, result


def write(
    folder: Path, header: str = HEADER, rows: list[str] = ROWS, toml: str | None = SPECIMEN
) -> Path:
    path = folder / "test.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    if toml is not None:
        path.with_suffix(".toml").write_text(toml)
    return path


# Normal operation.


@pytest.mark.parametrize("args", [[], *([command] for command in COMMANDS)])
def test_help_shows_an_example(args: list[str]) -> None:
    text = accepted(*args, "--help").stdout
    assert text.startswith(f"Usage: foamfit {' '.join(args)}".rstrip())
    assert "foamfit" in text.splitlines()[0]
    for line in text.splitlines():
        assert len(line) <= 100
    if args in ([], ["check"], ["fit"]):
        assert re.search(r"\n {6}foamfit (fit|check) \S+\.csv", text)


def test_check_with_another_specimen(here: Path) -> None:
    path = write(here, toml=None)
    (here / "other.toml").write_text('name = "another"\n' + SPECIMEN)
    assert "another" in accepted("check", path, "--specimen", "other.toml").stdout


def test_fit_writes_beneath_the_current_directory(fitted: tuple[Path, Result]) -> None:
    folder, result = fitted
    at = f"fits/{RECONSTRUCTION.stem}/bistable-seed-1-starts-4"
    profiled = "profile likelihood" in (folder / at / "parameters.csv").read_text()
    names = fabricated.FILES | {"budget.csv"} | ({"profiles.csv"} if profiled else set())
    assert set(files(folder)) == {f"{at}/{name}" for name in names}
    assert f"written to {at}" in result.stdout
    assert "s1_kh_minus" in result.stdout
    assert result.stderr == ""  # no terminal, no progress
    content = json.loads((folder / at / "fit.json").read_text())
    assert (content["schema"], content["model"], content["drive"]) == (1, "bistable", "impact")
    assert (content["seed"], content["status"]) == (1, "ok")
    assert set(content["visited"]["s1"]) == set("adce")
    page = next(folder.rglob("report.html")).read_text(encoding="utf-8")
    for name in content["statistics"]:  # every statistic has a label
        assert f"<td>{name.replace('_', ' ')}</td>" not in page


def test_json_is_all_there_is_and_the_seed_repeats(here: Path, fitted: tuple[Path, Result]) -> None:
    args = ("--seed", 1, "--starts", 4, "--json", "--out", "a/b", "--no-report")
    result = accepted("fit", RECONSTRUCTION, *args)
    content = json.loads(result.stdout)
    assert content == json.loads((here / "a/b/fit.json").read_text())
    before = json.loads(next(fitted[0].rglob("fit.json")).read_text())
    del content["runtime_s"], before["runtime_s"]
    assert content == before


def test_a_failed_fit_is_written(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small_pictures(monkeypatch)
    strain = np.concatenate([np.linspace(0, 0.4, 100), np.linspace(0.4, 0, 100)])
    stress = np.abs(np.random.default_rng(0).standard_normal(200))
    rows = [f"{s:.6f},{10 * e:.6f}" for s, e in zip(stress, strain, strict=True)]
    path = write(here, "stress (MPa),displacement (mm)", rows)
    result = run("fit", path, "--starts", 2, "--out", "out", code=2)
    assert result.stderr == "foamfit: no acceptable fit was found; see out\n"
    assert set(files(here / "out")) - {"profiles.csv"} == fabricated.FILES
    content = json.loads((here / "out" / "fit.json").read_text())
    assert content["status"] == "failed"
    assert any("not acceptable" in warning for warning in content["warnings"])


# Simulated scenes.

SPRING = """\
[[chain.springs]]
kind = "bistable"
height = "1.19 mm"
k0 = "5.5 MPa"
kc = "82.5 MPa"
dsigma = "-0.17907 MPa"
eps_a = 0.14
eps_c = 0.31
kh_plus = "14.3 MPa"
kh_minus = "2.475 MPa"
"""
OWN = '[chain]\ndiameter = "5 mm"\n' + SPRING
PUBLISHED = '[chain]\npublished = "foam-1/model-1"\n'
IMPACT = '[drive]\nkind = "impact"\nmass = "7 g"\nvelocity = "2 m/s"\n[time]\nend = "1 ms"\n'


def scene(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def table(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_simulate_an_impact_on_a_published_chain(here: Path) -> None:
    result = accepted("simulate", scene(here, PUBLISHED + IMPACT), "--plot", "response.png")
    assert "501 samples, written to scene.csv" in result.stdout
    assert (here / "response.png").read_bytes().startswith(b"\x89PNG")
    header = (here / "scene.csv").read_text().splitlines()[0]
    assert header == "time (s),base stress (Pa),strain,displacement_1 (m)"
    assert table(here / "scene.csv")[:, 1].max() == pytest.approx(4.93e6, rel=0.01)
    assert "drawn in response.png" in result.stdout


def test_a_response_takes_the_place_of_a_response_alone(here: Path) -> None:
    path = write(here, toml=PUBLISHED + IMPACT).with_suffix(".toml")
    for args in ((), ("--out", "test.csv")):
        refused(here, "simulate", path, *args, words=("test.csv", "response", "another"))
    for _ in range(2):
        accepted("simulate", path, "--out", "new.csv")
    accepted("simulate", path, "--out", "/dev/null")


def test_simulate_own_springs(here: Path) -> None:
    accepted("simulate", scene(here, PUBLISHED + IMPACT))
    accepted("simulate", scene(here, OWN + IMPACT + "samples = 501\n"), "--out", "own.csv")
    assert table(here / "own.csv") == pytest.approx(table(here / "scene.csv"), rel=1e-3, abs=50)


MICROSCALE = """\
[chain]
diameter = "5 mm"
[[chain.springs]]
kind = "microscale"
height = "1 cm"
k0 = "550 kPa"
kc = "250 kPa"
eps_star = 0.08
sigma_plus = "130 kPa"
spread_plus = 0.4
sigma_minus = "55 kPa"
spread_minus = 0.77
relaxation = [{ g = 0.5, tau = "200 ms" }, { g = 0.1, tau = "2 s" }]
[drive]
kind = "displacement"
file = "drive.csv"
"""


def test_simulate_a_microscale_spring_that_relaxes(here: Path) -> None:
    time, strain = np.linspace(0.0, 1.0, 9), np.array([0, 2, 4, 3, 2, 3, 5, 2, 0]) / 10
    rows = [f"{t},{1e-2 * eps}" for t, eps in zip(time, strain, strict=True)]
    (here / "drive.csv").write_text("\n".join(["t,displacement", *rows]) + "\n")
    accepted("simulate", scene(here, MICROSCALE))
    spring = ff.MicroscaleSpring(
        5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, relaxation=[(0.5, 0.2), (0.1, 2.0)]
    )
    chain = ff.Chain([spring], [1e-2], np.pi / 4 * 5e-3**2)
    want = ff.simulate(chain, ff.DisplacementDrive(1e-2 * strain), time).base_stress
    np.testing.assert_allclose(table(here / "scene.csv")[:, 1], want, rtol=1e-12)


def test_what_is_simulated_can_be_read(here: Path) -> None:
    accepted("simulate", scene(here, PUBLISHED + IMPACT), "--out", "test.csv")
    (here / "test.toml").write_text('[specimen]\nheight = "1.19 mm"\ndiameter = "5 mm"\n')
    assert "peak 4.9" in accepted("check", "test.csv").stdout


@pytest.mark.parametrize(
    ("kind", "header", "scale"),
    [
        ("displacement", "t,displacement", (1e-3, 0.42e-3)),
        ("displacement", "time (ms),displacement (mm)", (1.0, 0.42)),
        ("stress", "t,stress", (1e-3, 3e6)),
        ("stress", "Time [ms];Stress [MPa]", (1.0, 3.0)),
    ],
)
def test_simulate_a_drive_from_a_file(
    here: Path, kind: str, header: str, scale: tuple[float, float]
) -> None:
    comma = ";" if ";" in header else ","
    rows = [f"{scale[0] * i}{comma}{scale[1] * y}" for i, y in enumerate(LOOP)]
    (here / "drive.csv").write_text("\n".join([header, *rows]) + "\n")
    drive = f'[drive]\nkind = "{kind}"\nfile = "drive.csv"\n'
    accepted("simulate", scene(here, OWN + drive))
    time, stress, strain, displacement = table(here / "scene.csv").T
    assert time[-1] == pytest.approx(0.04)
    if kind == "displacement":
        assert displacement.max() == pytest.approx(0.42e-3)
        assert stress.max() > 4e6
    else:
        assert stress.max() == pytest.approx(3e6)
        assert 0.14 < strain.max() < 0.36


# Invalid input is rejected with one sentence.


@pytest.mark.parametrize(
    ("more", "args", "words"),
    [
        ("", ("--drive", "impact"), ("impact drive needs", "[striker] mass and", "velocity")),
        (
            STRIKER.replace('"1 m/s', '"0 m/s'),
            ("--drive", "impact"),
            ("test.toml", "[striker] velocity", "must be positive"),
        ),
        (
            'heights = ["4 mm", "6 mm"]\n',
            ("--model", "linear+bistable", "--vary", "s1_height"),
            ("'s1_height' is given by the specimen", "leave [specimen] heights out"),
        ),
    ],
)
def test_refuses_what_the_toml_does_not_allow(
    here: Path, more: str, args: tuple[str, ...], words: tuple[str, ...]
) -> None:
    refused(here, "fit", write(here, toml=SPECIMEN + more), *args, words=words)


@pytest.mark.parametrize(
    ("header", "keys", "lines"),
    [
        (HEADER, ["height", "diameter"], 6),
        ("Time (s),Load,Way", ["height", "diameter", "force", "displacement"], 9),
        ("a,b,c", ["height", "diameter", "stress", "displacement"], 9),
    ],
)
def test_without_a_toml_all_that_is_missing_is_shown(
    here: Path, header: str, keys: list[str], lines: int
) -> None:
    path = write(here, header, toml=None)
    result = run("fit", path, code=1)
    assert (result.stdout, list(files(here))) == ("", ["test.csv"])
    told, *shown = result.stderr.splitlines()
    assert told.startswith(f"foamfit: {path.with_suffix('.toml')}: no such file; test.csv needs")
    assert told.endswith(f"create it with: foamfit init {path}")
    assert f"a TOML with {', '.join(keys[:-1])} and {keys[-1]}, and" in told
    assert [line.split(" = ")[0].strip() for line in shown if " = " in line] == [
        *keys, "mass", "velocity",
    ]  # fmt: skip
    assert len(shown) == lines
    tomllib.loads("\n".join(shown))  # the printed TOML can be pasted


@pytest.mark.parametrize(
    ("header", "answers"),
    [
        (HEADER, {}),
        ("Time [ms],Load,Extension (mm)", {"force": "N"}),
        ("t (ms),Stress (MPa),Way", {"displacement": "mm"}),
    ],
)
def test_init_asks_for_the_rest(here: Path, header: str, answers: dict[str, str]) -> None:
    path = write(here, header, toml=None)
    told = accepted("init", path).stdout
    toml = path.with_suffix(".toml")
    text = toml.read_text(encoding="utf-8")
    assert set(tomllib.loads(text)["columns"]) | answers.keys() >= {"time", "displacement"}
    run("check", path, code=1)  # because required values are missing
    for key in ("height", "diameter", *answers):
        assert f"    {key} = " in told
        at = text.index(f"\n# {key} = ")
        text = text[:at] + text[at:].replace("# ", "", 1)
    toml.write_text(text, encoding="utf-8")
    understood = accepted("check", path).stdout
    assert "height 10 mm" in understood
    for channel, unit in answers.items():
        assert re.search(rf"{channel} from '\w+' in {unit}", " ".join(understood.split()))
    refused(here, "init", path, words=("test.toml exists", "is not changed", "foamfit check"))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--model", "rubber"], ("model 'rubber'", "bistable, linear")),
        (["--model", "../../x"], ("model '../../x'", "bistable, linear")),
        (["--drive", "push"], ("'--drive'", "'push'", "'displacement'")),
        (["--modle", "bistable"], ("'--modle'", "--model", "foamfit fit --help")),
        (["--fix", "s1_k9=1"], ("'s1_k9'", "s1_k0")),
        (["--fix", "s1_k0"], ("'s1_k0'", "NAME=VALUE")),
        (["--fix", "s1_k0=nan"], ("'s1_k0=nan'", "NAME=VALUE")),
        (["--fix", "s1_k0=5e6", "--fix", "s1_k0=6e6"], ("'s1_k0' is given twice",)),
        (["--vary", "s2_eta"], ("'s2_eta'", "s1_eta")),
        (["--fix", "s1_eta=0", "--vary", "s1_eta"], ("'s1_eta'", "both fixed and varied")),
        (["--model", "linear+bistable", "--fix", "s2_height=1e-3"], ("s2_height", "s1_height")),
        (["--fix", "s1_eps_a=2"], ("s1_eps_a = 2", "between 0 and 1")),
        (["--fix", "s1_k0=1e300"], ("s1_k0 = 1e+300", "less than 1e+30")),
        (["--starts", "0"], ("'--starts'", "1<=x")),
        (["--starts", "1000000000"], ("--starts", "x<=100000")),
        (["--relaxation", "999"], ("--relaxation", "x<=10")),
        (["--model", "+".join(["linear"] * 99)], ("99 springs", "20 at most")),
        (["--mcmc", "1000000000"], ("--mcmc", "x<=100000")),
        (["--cycle", "1,99"], ("no cycle 99", "1 to 1")),
        (["--seed", "-1"], ("'--seed'", "x>=0")),
        (["--max-time", "-1"], ("max_time", "positive")),
        (["--max-time", "soon"], ("'--max-time'", "'soon'")),
        (["--out", "test.csv"], ("test.csv", "is a file", "choose")),
        (["--out", "test.csv/in/it"], ("test.csv is a file", "choose")),
        (["--out", "thesis"], ("thesis", "no foamfit result", "choose")),
        (["--specimen", "none.toml"], ("none.toml", "no such file")),
        (["another.csv"], ("another.csv", "foamfit fit --help")),
    ],
)
def test_refuses_calls_of_fit(here: Path, args: list[str], words: tuple[str, ...]) -> None:
    (here / "thesis").mkdir()
    (here / "thesis" / "thesis.tex").write_text("all of it")
    refused(here, "fit", write(here), *args, words=words)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["fit"], ("TEST.csv",)),
        (["simulate"], ("SCENE.toml",)),
        (["fitt", "x"], ("'fitt'", "foamfit --help")),
        (["--verbose"], ("--verbose", "foamfit --help")),
        (["check", "none.csv"], ("none.csv", "no such file")),
        (["check", "."], ("directory",)),
        (["fit", "."], ("directory", "CSV")),
        (["fit", "/dev/zero"], ("/dev/zero", "device")),
        (["check", RECONSTRUCTION, "--specimen", "/dev/zero"], ("/dev/zero", "device")),
        (["compare", "/dev/zero"], ("/dev/zero", "device")),
        (["batch", "NOTHING"], ("NOTHING", "no such file", ".csv")),
        (["simulate", "none.toml"], ("none.toml", "no such file")),
        (["simulate", "."], ("directory", "scene")),
        (["compare", "none"], ("none is not a result folder",)),
    ],
)
def test_refuses_calls(here: Path, args: list[str], words: tuple[str, ...]) -> None:
    refused(here, *args, words=words)


DRIVE = '[drive]\nkind = "stress"\nfile = "drive.csv"\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[chain\n", ("not valid TOML", "line 1")),
        (OWN, ("[drive] is missing",)),
        (IMPACT, ("[chain] is missing",)),
        (OWN + "[drive]\n", ("[drive] kind", "impact, stress or displacement")),
        (OWN + IMPACT + "[tyme]\n", ("'tyme'", "time")),
        (OWN + "colour = 1\n" + IMPACT, ("spring 1", "'colour'")),
        ("[chain]\nspring = 1\n" + IMPACT, ("[chain]", "'spring'", "springs")),
        ('[chain]\narea = "1 mm^2"\n' + IMPACT, ("[[chain.springs]]",)),
        (OWN.replace("0.14", "0.4") + IMPACT, ("spring 1", "eps_a")),
        (OWN.replace('"5.5 MPa"', '"5.5 mm"') + IMPACT, ("spring 1", "k0", "wrong dimension")),
        (OWN.replace('"5.5 MPa"', "5.5") + IMPACT, ("spring 1", "k0 = 5.5", '"5.5 MPa"')),
        (OWN + 'eta = "1 Pa"\n' + IMPACT, ("spring 1", "eta", "wrong dimension", "Pa*s")),
        (OWN.replace('"bistable"', '"rubber"') + IMPACT, ("spring 1", "'rubber'", "bistable")),
        (OWN.replace('"1.19 mm"', '"0 mm"') + IMPACT, ("[chain]", "heights", "greater than 0")),
        (OWN.replace('"5 mm"', '"5 mm"\narea = "1 mm^2"') + IMPACT, ("diameter and an area",)),
        ('[chain]\npublished = "foam-9"\n' + IMPACT, ("'foam-9'", "foam-1/model-1")),
        ('[chain]\npublished = ["foam-2"]\n' + IMPACT, ("foam-1/model-1",)),
        (OWN + IMPACT.replace('"2 m/s"', '"0 m/s"'), ("[drive]", "velocity", "greater than 0")),
        (OWN + IMPACT.split("[time]")[0], ("[time] is missing",)),
        (OWN + IMPACT.replace('"1 ms"', '"-1 ms"'), ("[time] end", "positive")),
        (OWN + IMPACT + "samples = 1\n", ("[time] samples", "from 2")),
        (
            OWN + DRIVE.replace("drive.csv", "none.csv"),
            ("none.csv", "no such file", "stress (MPa)"),
        ),
        (OWN + DRIVE.replace("file", "# file"), ("[drive] file is missing", "drive.csv")),
        (OWN + DRIVE, ("drive.csv", "row 3", "'stress (MPa)'", "'abc'")),
        (OWN + DRIVE.replace('"stress"', '"displacement"'), ("drive.csv", "displacement (mm)")),
        (OWN + DRIVE + '[time]\nend = "1 ms"\n', ("[time] must be left out",)),
        *(
            (MICROSCALE.replace(was, now), ("spring 1", says))
            for was, now, says in (
                ("eps_star = 0.08\n", "", "eps_star is missing; give it like eps_star = 0.08"),
                ("g = 0.1", "g = -0.1", "g2 = -0.1 is not admissible"),
                ('tau = "2 s"', 'tau = "2 m"', "relaxation term 2: tau"),
                ("g = 0.1, ", "", "relaxation term 2: g is missing; give it like g = 0.5"),
                ("= [{ g = 0.5", "= [1, { g = 0.5", "relaxation term 1 must be like"),
                ("eps_star = 0.08", "dsigma = 0.08", "dsigma"),
            )
        ),
    ],
)
def test_refuses_scenes(here: Path, text: str, words: tuple[str, ...]) -> None:
    (here / "drive.csv").write_text("time (ms),stress (MPa)\n0,0\n1,abc\n2,0\n")
    name = "drive.csv" if "drive.csv" in words else "scene.toml"
    if "none.csv" in words:
        name = "none.csv"
    refused(here, "simulate", scene(here, text), words=(name, *words))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--plot", "x.docx"], ("x.docx", ".png, .pdf or .svg")),
        (["--plot", "no/x.png"], ("no/x.png", "no folder no")),
        (["--out", "no/x.csv"], ("no/x.csv", "no folder no")),
        (["--out", "."], ("is a folder",)),
        (["--rtol", "0"], ("--rtol", "1e-14<=x<=0.1")),
        (["--rtol", "nan"], ("rtol = nan", "between")),
        (["--out", "scene.toml"], ("scene.toml exists and is not a response", "another name")),
        (["--plot", "./scene.toml"], (".png, .pdf or .svg, not 'scene.toml'",)),
    ],
)
def test_refuses_calls_of_simulate(here: Path, args: list[str], words: tuple[str, ...]) -> None:
    refused(here, "simulate", scene(here, PUBLISHED + IMPACT), *args, words=words)


def test_simulate_keeps_the_history_that_drives_it(here: Path) -> None:
    (here / "drive.csv").write_text("time (ms),stress (MPa)\n0,0\n1,1\n2,0\n")
    path = scene(here, OWN + DRIVE).rename(here / "drive.toml")  # without --out: drive.csv
    refused(
        here, "simulate", path, words=("drive.csv exists and is not a response", "another name")
    )
    accepted("simulate", path, "--out", "response.csv")


def test_a_json_that_is_nested_too_deeply_is_no_defect(here: Path) -> None:
    (here / "deep").mkdir()
    (here / "deep" / "fit.json").write_text("[" * 100_000 + "]" * 100_000)
    refused(here, "compare", "deep", words=("deep", "no", "JSON"))
    refused(here, "fit", write(here), "--out", "deep", words=("deep", "no foamfit result"))


def test_compare_and_fit_keep_what_they_read(here: Path, fitted: tuple[Path, Result]) -> None:
    folder = here / "old"
    shutil.copytree(next(fitted[0].rglob("fit.json")).parent, folder)
    args = ("--published", "foam-1/model-1", "--plot", folder / "fit.json")
    refused(here, "compare", folder, *args, words=(".png, .pdf or .svg, not 'fit.json'",))
    write(folder)
    refused(here, "fit", folder / "test.csv", "--out", folder, words=("old holds test.csv",))


# Run as a separate process.


def test_the_light_commands_import_nothing_heavy() -> None:
    heavy = "{'numba', 'pandas', 'matplotlib', 'scipy', 'lmfit', 'pint'}"
    script = (
        "import sys\nfrom foamfit.cli import main\nfor name in ('--help', 'published'):\n"
        "    try:\n        main([name])\n"
        "    except SystemExit as leaving:\n        assert leaving.code == 0\n"
        f"    print(name, sorted({heavy} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    told = done.stdout.splitlines()
    assert "--help []" in told
    assert told[-1] == "published []"


def test_the_command_imports_what_a_fit_uses_and_prints_nothing_else(here: Path) -> None:
    code = "import atexit, sys\natexit.register(lambda: print('modules', *sys.modules))\n"
    code += "from foamfit.cli import main\nmain(sys.argv[1:])"
    call = ["fit", str(RECONSTRUCTION), "--out", str(here / "r"), "--starts", "2", "--json"]
    call = [sys.executable, "-c", code, *call, "--max-time", "5"]
    run = subprocess.run(call, capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")
    printed, _, modules = run.stdout.rpartition("modules ")
    assert json.loads(printed)["test"].endswith("(reconstruction)")
    assert (here / "r" / "fit.png").stat().st_size > 10_000
    assert (here / "r" / "fit.pdf").read_bytes().startswith(b"%PDF")
    assert "lmfit" in modules.split()
    assert "unittest.mock" not in modules.split()
