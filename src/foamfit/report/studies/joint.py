"""The folder of a joint fit: joint.json, a page, a picture, and a result folder for each test."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit.report.figures import TWO, image
from foamfit.report.folder import save_whole, write_result
from foamfit.report.plotted import table
from foamfit.report.studies.joint_page import joint_page
from foamfit.report.studies.joint_plot import plot_joint

if TYPE_CHECKING:
    from foamfit.study.joint_result import JointData, TestFit

DPI = 180  # of the picture


def save_joint(
    found: JointData, folder: str | Path, each: Callable[..., Iterable[Any]] = map, *,
    reports: bool = True, width: str = TWO,
) -> Path:  # fmt: skip
    """Write the folder whole, replacing an older result at the end; returns it.

    `each` maps a function over the tests, as `map` does; `width` is that of the figures. Where the
    reports fail, joint.json is written all the same, and RuntimeError says so.
    """
    failed = list[Exception]()

    def write(fresh: Path) -> None:
        text = json.dumps(found.to_json_dict(), indent=2, ensure_ascii=False, allow_nan=False)
        (fresh / "joint.json").write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
        try:
            show(fresh)
        except OSError:
            raise
        except Exception as error:
            failed.append(error)

    def show(fresh: Path) -> None:
        folders = [fresh / name for name in found.tests]
        # Where other processes make the folders, the picture of all is drawn beside them.
        n = len(folders)
        made = each(_write_test, found.test_fits(), folders, [reports] * n, [width] * n)
        figure = plot_joint(found, width=width)
        png = image(figure, "png", DPI)
        (fresh / "joint.png").write_bytes(png)
        (fresh / "joint.csv").write_bytes(table(figure))
        if width != TWO:  # the page is as wide as two columns
            png = image(plot_joint(found), "png", DPI)
        page = joint_page(found, png, linked=reports)
        (fresh / "joint.html").write_text(page, encoding="utf-8", errors="replace")
        for _ in made:
            pass

    save_whole(folder, write)
    if failed:
        raise RuntimeError(
            f"{failed[0]!r}; {Path(folder) / 'joint.json'} is written, but not all reports"
        ) from failed[0]
    return Path(folder)


def _write_test(one: TestFit, folder: Path, reports: bool, width: str) -> None:
    """Write the result folder of one test."""
    folder.mkdir()
    write_result(one.fit(), folder, pages=reports, width=width)
