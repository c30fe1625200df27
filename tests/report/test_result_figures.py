"""Figures of a result are the same in any process and need few imports."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

import fabricated
from conftest import EXPERIMENTS
from foamfit.report.result_figures import Images, draw_all
from foamfit.study.processes import DRAWING, workers

RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"


@pytest.fixture(scope="module")
def drawn_here() -> dict[str, Images | None]:
    return dict(draw_all(fabricated.result()))


def test_other_processes_draw_the_same(drawn_here: dict[str, Images | None]) -> None:
    with workers(2, 2, preload=DRAWING) as mapped:
        assert dict(draw_all(fabricated.result(), mapped=mapped)) == drawn_here
    fit = drawn_here["fit"]
    assert fit is not None
    assert fit.png.startswith(b"\x89PNG")
    assert fit.pdf.startswith(b"%PDF")
    shown = drawn_here["shown"]
    assert shown is not None
    assert b"stress (MPa)</text>" in shown.svg


def a_process(code: str, *arguments: str) -> tuple[str, set[str]]:
    """Run code in a new process; return its output and the modules that it imported."""
    at_the_end = "import atexit, sys\natexit.register(lambda: print('modules', *sys.modules))\n"
    run = subprocess.run(
        [sys.executable, "-c", at_the_end + code, *arguments], capture_output=True, text=True
    )
    assert (run.returncode, run.stderr) == (0, "")
    printed, _, modules = run.stdout.rpartition("modules ")
    return printed, set(modules.split())


def test_drawing_imports_no_fit() -> None:
    _, there = a_process("import foamfit.report.result_figures")
    assert not there & {"lmfit", "pandas", "scipy.stats", "scipy.optimize", "numba"}


def test_the_command_imports_what_a_fit_uses_and_prints_nothing_else(tmp_path: Any) -> None:
    call = ["fit", str(RECONSTRUCTION), "--out", str(tmp_path / "r"), "--starts", "2", "--json"]
    code = "from foamfit.cli import main\nmain(sys.argv[1:])"
    printed, there = a_process(code, *call, "--max-time", "5")
    assert json.loads(printed)["test"].endswith("(reconstruction)")
    assert (tmp_path / "r" / "fit.png").stat().st_size > 10_000
    assert (tmp_path / "r" / "fit.pdf").read_bytes().startswith(b"%PDF")
    assert "lmfit" in there
    assert not there & {"matplotlib.figure", "fontTools", "unittest.mock"}
