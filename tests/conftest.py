"""Shared synthetic tests: simulated impacts and loops with stated noise."""

from __future__ import annotations

import functools
import gc
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Each process of the tests computes with one thread: small matrices gain nothing by more, and
# threads that wait for a busy core take thirty times as long. NumPy reads this when imported.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import pytest

import fabricated
import foamfit as ff
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.report import folder as result_folder
from foamfit.solve import cache, precompile

ROOT = Path(__file__).parent.parent
EXPERIMENTS = ROOT / "experiments"
DATA = Path(os.environ.get("FOAMFIT_DATA", ROOT.parent / "shared" / "data"))

gc.disable()  # what is imported and collected stays
HEIGHT, AREA = 1.19e-3, 1.9635e-5
os.environ["COLUMNS"] = "100"  # of what commands print, whatever the terminal of the tests

needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measurements of others are not beside this checkout"
)


# What compiles, in a process of its own, loops that a first fit does not need, and these loops.
FIRST_USE = Path(__file__).with_name("first_use.py")
LOOPS = {
    "struck": "integrate_with_memory",  # takes longest
    "along": "relaxed_along",
    "many": "integrate_aggregate",
}
BEGUN = pytest.StashKey[list[subprocess.Popen[bytes]]]()


def first_use(part: str) -> subprocess.Popen[bytes]:
    """Begin to compile a part of what many tests need."""
    return subprocess.Popen([sys.executable, str(FIRST_USE), part])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Folders, and so the whole suite, are tested by all cores; single files in this process."""
    cores = min(os.cpu_count() or 1, 8)
    files = all(Path(arg.partition("::")[0]).is_file() for arg in config.args)
    return 0 if files or cores == 1 else cores


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what several processes will need, once and on all cores.

    The loops of a first fit before these processes start, the others while they collect the tests.
    """
    if hasattr(session.config, "workerinput"):
        # One of several is begun without Ctrl-C, and would begin others without it in the tests.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    asked = session.config.option
    if asked.collectonly or not getattr(asked, "numprocesses", None):
        return
    if not cache.compiled():
        with precompile.side_by_side() as compile_rest:
            compile_rest()
    missing = [part for part, loop in LOOPS.items() if not cache.compiled(loop)]
    judge = ["judge"] if missing else []  # of the stability study, which has a cache of its own
    session.config.stash[BEGUN] = [first_use(part) for part in missing + judge]


def pytest_collection_finish() -> None:
    """Look for garbage in what the tests make, not in what was collected."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Let no process begin with its tests before all is compiled."""
    for process in node.config.stash.get(BEGUN, []):
        assert process.wait() == 0


@pytest.fixture(scope="session", autouse=True)
def compiled() -> Iterator[None]:
    """Compile once, in two processes, what most tests need; no command then says that it does.

    The loops of many springs are compiled beside the first tests.
    """
    if cache.compiled():
        yield
        return
    with precompile.side_by_side() as compile_rest:
        compile_rest()
    with first_use("many"):
        yield


def thinned(path: Path, folder: Path, every: int) -> Path:
    """Write each so-many-th row of a record into a folder."""
    head, *rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
    (folder / path.name).write_text("".join([head, *rows[::every]]), encoding="utf-8")
    return folder / path.name


@pytest.fixture(scope="session")
def thin_foams(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every fourth row of the shoe foams: each fit of them takes a quarter of the time."""
    place = tmp_path_factory.mktemp("thin")
    for folder in ("shoe-foam", "shoe-foam-twins"):
        (place / folder).mkdir()
        for path in (DATA / folder).iterdir():
            thinned(path, place / folder, 1 if path.name == "specimens.csv" else 4)
    return place


def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a result folder be written with pictures of a few bytes."""
    monkeypatch.setattr(result_folder, "draw_all", lambda *_: fabricated.no_figures().items())


def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a result folder be written with pictures of a few bytes and an empty page."""
    small_pictures(monkeypatch)
    monkeypatch.setattr(result_folder, "render_report", lambda *_, **__: "")


def few_bytes(figure: object, place: Path, *_: object) -> bytes:
    """Write what stands for a PNG and a PDF of a study."""
    for suffix in (".png", ".pdf"):
        place.with_suffix(suffix).write_bytes(b"\x89PNG")
    return b"\x89PNG"


@functools.cache
def synthetic_impact(
    velocity: float = 2.0, noise: float = 0.01, seed: int = 0, eta: float = 0.0, samples: int = 401
) -> tuple[ff.BistableSpring, Measurement]:
    """A simulated impact on a spring with the published parameters of foam-1, time zero known."""
    spring = ff.published["foam-1/model-1"].bistable
    spring = ff.BistableSpring(*spring.seven, eta=eta)
    chain = ff.Chain([spring], [HEIGHT], AREA)
    time = np.linspace(0.0, 0.75e-3, samples)
    response = ff.simulate(chain, ff.Impact(7e-3, velocity), time)
    rng = np.random.default_rng(seed)
    stress, motion = response.base_stress, response.displacement[-1]
    spread = [noise * np.ptp(stress), noise * np.ptp(motion)]
    measurement = Measurement(
        name="synthetic impact",
        path=None,
        data_sha256="0" * 64,
        time=time,
        stress=stress + spread[0] * rng.standard_normal(samples),
        displacement=motion + spread[1] * rng.standard_normal(samples),
        specimen=Specimen(HEIGHT, AREA),
        striker=Striker(7e-3, velocity),
        noise=Noise(*spread) if noise else Noise(),
        motion="measured",
    )
    return spring, measurement


@functools.cache
def refused(path: Path, *words: str, specimen: Path | None = None) -> None:
    """A test is refused in one sentence that has these words."""
    with pytest.raises(ff.InputError) as caught:
        ff.read_test(path, specimen)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def synthetic_loop(noise: float = 0.005) -> tuple[ff.BistableSpring, Measurement]:
    """A quasi-static loop without time and without striker."""
    spring = ff.published["foam-1/model-1"].bistable
    strain = np.concatenate([np.linspace(0, 0.38, 200), np.linspace(0.38, 0.02, 200)[1:]])
    stress = spring.stress(strain)
    rng = np.random.default_rng(1)
    noisy = stress + noise * np.ptp(stress) * rng.standard_normal(stress.size)
    return spring, loop_measurement(noisy, strain * HEIGHT, Specimen(HEIGHT, AREA))


def loop_measurement(
    stress: np.ndarray, motion: np.ndarray, specimen: Specimen, time: np.ndarray | None = None
) -> Measurement:
    """A measured loop: stress (Pa) along a motion (m), with its time (s) or without."""
    return Measurement(
        name="synthetic loop",
        path=None,
        data_sha256="",
        time=time,
        stress=stress,
        displacement=motion,
        specimen=specimen,
        motion="measured",
    )
