"""Real figures of a fit by the command, and what the command imports."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from conftest import RECONSTRUCTION


def test_the_command_imports_what_a_fit_uses_and_prints_nothing_else(tmp_path: Any) -> None:
    code = "import atexit, sys\natexit.register(lambda: print('modules', *sys.modules))\n"
    code += "from foamfit.cli import main\nmain(sys.argv[1:])"
    call = ["fit", str(RECONSTRUCTION), "--out", str(tmp_path / "r"), "--starts", "2", "--json"]
    call = [sys.executable, "-c", code, *call, "--max-time", "5"]
    run = subprocess.run(call, capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")
    printed, _, modules = run.stdout.rpartition("modules ")
    assert json.loads(printed)["test"].endswith("(reconstruction)")
    assert (tmp_path / "r" / "fit.png").stat().st_size > 10_000
    assert (tmp_path / "r" / "fit.pdf").read_bytes().startswith(b"%PDF")
    assert "lmfit" in modules.split()
    assert "unittest.mock" not in modules.split()
