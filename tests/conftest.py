"""Shared synthetic tests: simulated impacts and loops with known noise."""

import functools
import gc
import os
import pickle
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# Each test process uses one thread: more threads do not speed up small matrices, and threads that
# wait for a busy core take thirty times as long. NumPy reads these variables when it is imported.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy.signal import lfilter

import fabricated
import foamfit as ff
from foamfit.cli import main
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.fitting import search
from foamfit.report import folder as result_folder
from foamfit.solve import cache, precompile

ROOT = Path(__file__).parent.parent
EXPERIMENTS = ROOT / "experiments"
RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"
DATA = Path(os.environ.get("FOAMFIT_DATA", ROOT.parent / "shared" / "data"))

# Records made by the studies, which share no code with foamfit.
STUDIES = ("recovery", "law_error", "real_foams", "stability", "microscale", "paper_claims")
STUDIES += ("other_laws", "")
sys.path += [str(EXPERIMENTS / name) for name in STUDIES]
gc.disable()  # imported modules and collected tests live until exit
HEIGHT, AREA = 1.19e-3, 1.9635e-5
NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus")
SPECIMEN = '[specimen]\nheight = "10 mm"\narea = "100 mm^2"\n'
STRIKER = '[striker]\nmass = "1 kg"\nvelocity = "1 m/s"\n'
HEADER = "time (ms),stress (MPa),displacement (mm)"
os.environ["COLUMNS"] = "100"  # the same output width in every terminal

posix = pytest.mark.skipif(os.name != "posix", reason="signals, permissions and shell of POSIX")
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measurements of others are not beside this checkout"
)
needs_panel = pytest.mark.skipif(
    find_spec("panel") is None, reason='the page needs Panel: pip install "foamfit[page]"'
)


# This script compiles, in a separate process, the loops that a first fit does not need.
FIRST_USE = Path(__file__).with_name("first_use.py")
LOOPS = {"along": "balance"}
BEGUN = pytest.StashKey[list[subprocess.Popen[bytes]]]()


def first_use(part: str) -> subprocess.Popen[bytes]:
    """Start a process that compiles one group of loops."""
    return subprocess.Popen([sys.executable, str(FIRST_USE), part])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use all cores to test folders or the full suite, and only this process for single files."""
    cores = min(os.cpu_count() or 1, 8)
    files = all(Path(arg.partition("::")[0]).is_file() for arg in config.args)
    return 0 if files or cores == 1 else cores


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the loops shared by the test processes once.

    The loops of a first fit are compiled before the processes start, the others during collection.
    """
    if hasattr(session.config, "workerinput"):
        # A worker starts with Ctrl-C disabled, and processes started by tests would inherit this.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    asked = session.config.option
    if asked.collectonly or not getattr(asked, "numprocesses", None):
        return
    if not cache.compiled():
        precompile.compile_solver()
    missing = [part for part, loop in LOOPS.items() if not cache.compiled(loop)]
    judge = ["judge"] if missing else []  # the stability study has a separate cache
    session.config.stash[BEGUN] = [first_use(part) for part in missing + judge]


def pytest_collection_finish() -> None:
    """Restrict garbage collection to objects created by the tests."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Wait until everything is compiled before any process starts its tests."""
    for process in node.config.stash.get(BEGUN, []):
        assert process.wait() == 0


@pytest.fixture(scope="session", autouse=True)
def compiled() -> None:
    """Compile once the loops that most tests need.

    Commands then print no message about compiling.
    """
    if not cache.compiled():
        precompile.compile_solver()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to an empty directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def without_hops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Omit hops from the best minimum, which take half of a search and have tests of their own."""
    monkeypatch.setattr(search, "leave_minimum", lambda *_: [])


def run(*args: object, code: int | tuple[int, ...] = 0, encoding: str = "utf-8") -> Result:
    """Call a command of foamfit that ends with (one of) these exit codes, in a terminal."""
    told = CliRunner(charset=encoding).invoke(main, [str(arg) for arg in args])
    assert told.exit_code in np.atleast_1d(code), told.output
    return told


def run_refused(*args: object) -> str:
    """Call a command that must be refused; return its only sentence."""
    told = run(*args, code=1)
    assert told.stdout == "", told.output
    assert re.fullmatch(r"foamfit: [^\n]+\n", told.stderr)
    assert "defect" not in told.stderr
    return told.stderr


def write_csv(path: Path, head: str, *columns: Any, fmt: str = "%.9g", toml: str = "") -> Path:
    """Write columns under a head, and a TOML beside them if there is one."""
    np.savetxt(path, np.column_stack(columns), fmt, ",", header=head, comments="")
    if toml:
        path.with_suffix(".toml").write_text(toml, encoding="utf-8")
    return path


def write_lines(folder: Path, lines: list[str], toml: str | None = SPECIMEN, **form: Any) -> Path:
    """Write test.csv with these lines, in UTF-8 unless `form` differs, and a TOML beside it."""
    path = folder / "test.csv"
    path.write_text("\n".join(lines) + "\n", **{"encoding": "utf-8"} | form)
    if toml is not None:
        path.with_suffix(".toml").write_text(toml, encoding="utf-8")
    return path


def write_measurement(path: Path, test: Measurement, more: str = "") -> Path:
    """Write a test as CSV and TOML, with more lines of TOML at the end."""
    columns = {"time (s)": test.time, "stress (Pa)": test.stress}
    columns = {name: values for name, values in columns.items() if values is not None}
    head = ",".join([*columns, "displacement (m)"])
    one, by = test.specimen, test.striker
    toml = f'[specimen]\nheight = "{one.height} m"\narea = "{one.area} m^2"\n'
    toml += f'[striker]\nmass = "{by.mass} kg"\nvelocity = "{by.velocity} m/s"\n' if by else ""
    return write_csv(path, head, *columns.values(), test.displacement, toml=toml + more)


def correlated(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    """Return autoregressive noise of unit variance; `rho` is the correlation of neighbours."""
    white = rng.standard_normal(n + 500)
    return lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], white)[500:]


def specimen_toml(folder: Path, height: float, diameter: float, more: str = "") -> Path:
    """Write the TOML of a cylinder with these sizes in mm."""
    path = folder / "specimen.toml"
    sizes = f'height = "{height} mm"\ndiameter = "{diameter} mm"\n'
    path.write_text(f"[specimen]\n{sizes}{more}", encoding="utf-8")
    return path


def thinned(path: Path, folder: Path, every: int) -> Path:
    """Write every n-th row of a record into a folder (n is `every`)."""
    head, *rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
    (folder / path.name).write_text("".join([head, *rows[::every]]), encoding="utf-8")
    return folder / path.name


@pytest.fixture(scope="session")
def thin_foams(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keep every fourth row of the shoe foams, so that each fit takes a quarter of the time."""
    place = tmp_path_factory.mktemp("thin")
    for folder in ("shoe-foam", "shoe-foam-twins"):
        (place / folder).mkdir()
        for path in (DATA / folder).iterdir():
            thinned(path, place / folder, 1 if path.name == "specimens.csv" else 4)
    return place


def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pictures of result folders by files of a few bytes."""
    monkeypatch.setattr(result_folder, "figures_of", lambda *_: fabricated.no_figures())


def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pictures of result folders by files of a few bytes, and empty the page."""
    small_pictures(monkeypatch)
    monkeypatch.setattr(result_folder, "render_report", lambda *_, **__: "")


def few_bytes(figure: object, place: Path, *_: object) -> bytes:
    """Write placeholders for the PNG and the PDF of a study."""
    for suffix in (".png", ".pdf"):
        place.with_suffix(suffix).write_bytes(b"\x89PNG")
    return b"\x89PNG"


@functools.cache
def synthetic_impact(
    velocity: float = 2.0, noise: float = 0.01, seed: int = 0, eta: float = 0.0, samples: int = 401
) -> tuple[ff.BistableSpring, Measurement]:
    """Simulate an impact on a spring with the published values of foam-1 and known time zero."""
    spring = ff.published["foam-1/model-1"].bistable
    spring = ff.BistableSpring(*spring.seven, eta=eta)
    chain = ff.Chain([spring], [HEIGHT], AREA)
    time = np.linspace(0.0, 0.75e-3, samples)
    response = ff.simulate(chain, ff.Impact(7e-3, velocity), time)
    rng = np.random.default_rng(seed)
    stress, motion = response.base_stress, response.displacement[-1]
    spread = [noise * np.ptp(stress), noise * np.ptp(motion)]
    stress = stress + spread[0] * rng.standard_normal(samples)
    motion = motion + spread[1] * rng.standard_normal(samples)
    return spring, Measurement(
        "synthetic impact", None, "0" * 64, time, stress, motion, Specimen(HEIGHT, AREA),
        Striker(7e-3, velocity), Noise(*spread) if noise else Noise(), motion="measured",
    )  # fmt: skip


def assert_near(found: ff.FitResult, truth: dict[str, float], errors: float) -> None:
    """Check that springs have the true parameters within this number of standard errors."""
    for name, value in truth.items():
        one = found.parameters[f"s1_{name}"]
        assert abs(one.value - value) < errors * one.stderr, name


def refused(path: Path, *words: str, specimen: Path | None = None) -> str:
    """Check that a test is rejected with one sentence that contains these words; return it."""
    with pytest.raises(ff.InputError) as caught:
        ff.read_test(path, specimen)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    return message


@functools.cache
def synthetic_loop(noise: float = 0.005) -> tuple[ff.BistableSpring, Measurement]:
    """Simulate a quasi-static loop without time and without a striker."""
    spring = ff.published["foam-1/model-1"].bistable
    strain = np.concatenate([np.linspace(0, 0.38, 200), np.linspace(0.38, 0.02, 200)[1:]])
    stress = spring.stress(strain)
    rng = np.random.default_rng(1)
    noisy = stress + noise * np.ptp(stress) * rng.standard_normal(stress.size)
    return spring, loop_measurement(noisy, strain * HEIGHT, Specimen(HEIGHT, AREA))


def loop_measurement(
    stress: np.ndarray, motion: np.ndarray, specimen: Specimen, time: np.ndarray | None = None,
    striker: Striker | None = None,
) -> Measurement:  # fmt: skip
    """Return a test of stress (Pa) and motion (m), with or without time (s) and striker."""
    return Measurement(
        "synthetic", None, "", time, stress, motion, specimen, striker, motion="measured"
    )


class Inline(Executor):
    """An executor that calls in this process, with arguments pickled as for another process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future = Future[Any]()
        try:
            there, given, named = pickle.loads(pickle.dumps((fn, args, kwargs)))
            future.set_result(there(*given, **named))
        except Exception as error:
            future.set_exception(error)
        return future
