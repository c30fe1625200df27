"""Figures of a result, and the imports of the command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import fabricated
from conftest import EXPERIMENTS
from foamfit.report.figures import images
from foamfit.report.result_figures import figures_of

RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"


def test_the_figure_of_a_fit_is_a_picture_and_has_text(tmp_path: Path) -> None:
    folder = fabricated.result().save(tmp_path / "r")
    assert (folder / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "fit.pdf").read_bytes().startswith(b"%PDF")
    (svg,) = images(figures_of(fabricated.result())["fit"], "svg")
    assert b"stress (MPa)</text>" in svg


def a_process(code: str, *arguments: str) -> tuple[str, set[str]]:
    """Run code in a new process; return its output and the modules that it imported."""
    at_the_end = "import atexit, sys\natexit.register(lambda: print('modules', *sys.modules))\n"
    run = subprocess.run(
        [sys.executable, "-c", at_the_end + code, *arguments], capture_output=True, text=True
    )
    assert (run.returncode, run.stderr) == (0, "")
    printed, _, modules = run.stdout.rpartition("modules ")
    return printed, set(modules.split())


def test_the_command_imports_what_a_fit_uses_and_prints_nothing_else(tmp_path: Any) -> None:
    call = ["fit", str(RECONSTRUCTION), "--out", str(tmp_path / "r"), "--starts", "2", "--json"]
    code = "from foamfit.cli import main\nmain(sys.argv[1:])"
    printed, there = a_process(code, *call, "--max-time", "5")
    assert json.loads(printed)["test"].endswith("(reconstruction)")
    assert (tmp_path / "r" / "fit.png").stat().st_size > 10_000
    assert (tmp_path / "r" / "fit.pdf").read_bytes().startswith(b"%PDF")
    assert "lmfit" in there
    assert "unittest.mock" not in there
