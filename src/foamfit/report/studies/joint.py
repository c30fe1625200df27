"""The folder of a joint fit: joint.json, a page, a picture, and a result folder for each test."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from foamfit.report.folder import save_whole, write_result
from foamfit.workers import workers

if TYPE_CHECKING:
    from foamfit.study.joint_result import JointData, TestFit

# Up to so many folders are written in this process: each takes a second or two.
FEW = 4


def save_joint(found: JointData, folder: str | Path, jobs: int | None = 1) -> Path:
    """Write the folder whole, replacing an older result at the end; returns it."""

    def write(fresh: Path) -> None:
        text = json.dumps(found.to_json_dict(), indent=2, ensure_ascii=False, allow_nan=False)
        (fresh / "joint.json").write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
        folders = [fresh / name for name in found.tests]
        with workers(jobs, len(folders), FEW) as each:
            for _ in each(_write_test, found.test_fits(), folders):
                pass

    return save_whole(folder, write)


def _write_test(one: TestFit, folder: Path) -> None:
    """Write the result folder of one test."""
    folder.mkdir()
    write_result(one.fit(), folder)
