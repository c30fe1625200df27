"""Real figures of a fit by the command, and what the command imports."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from conftest import EXPERIMENTS

RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"


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
