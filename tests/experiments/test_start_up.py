"""The study of the time from the command to the report runs its probe."""

from __future__ import annotations

import sys
from pathlib import Path

from conftest import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS / "start_up"))
import start_up


def test_the_probe_prints_the_time_of_each_part(tmp_path: Path) -> None:
    test = start_up.write(tmp_path, 200)
    command = [sys.executable, "-c", start_up.PROBE, str(test), str(tmp_path / "result")]
    wall, _, printed = start_up.run(command)
    parts = [float(part) for part in printed.split()]
    assert len(parts) == len(start_up.PARTS)
    assert min(parts) > 0.0
    assert sum(parts) < wall
    assert (tmp_path / "result" / "report.html").is_file()
