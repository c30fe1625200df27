"""In figures for one and two print columns, nothing is cut off and nothing overlaps."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import fabricated
from conftest import run_refused
from drawn import figures
from foamfit.errors import InputError
from foamfit.report.figures import DPI, STYLE, inches


@pytest.mark.parametrize(
    ("width", "wide"), [("one", 3.25), ("Two", 7.0), ("85 mm", 85 / 25.4), ("3.25in", 3.25)]
)
def test_a_width_is_columns_or_a_length(width: str, wide: float) -> None:
    assert inches(width) == pytest.approx(wide)


@pytest.mark.parametrize(
    ("width", "words"),
    [
        ("wide", "is not a quantity"),
        ("3 mm", "from 64 to 508 mm"),
        ("5 s", "has the wrong dimension"),
    ],
)
def test_what_is_no_width_is_refused_before_anything_is_done(
    width: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=words):
        fabricated.result().save(tmp_path / "r", figure_width=width)
    assert words in run_refused("fit", "none.csv", "--figure-width", width)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("width", ["one", "two"])
def test_nothing_is_cut_off_and_no_panel_overlaps_another(width: str) -> None:
    for name, figure in figures(width):
        with matplotlib.rc_context(STYLE):
            figure.dpi = DPI
            figure.draw_without_rendering()
            least = DPI / 72.0  # a typographic point
            parts = [ax for ax in figure.axes if ax.axison]
            boxes = [part.get_tightbbox() for part in parts]
            low = np.min([[box.x0, box.y0] for box in boxes], axis=0)
            high = np.max([[box.x1, box.y1] for box in boxes], axis=0)
            assert np.all(low > -least), name
            assert np.all(high - figure.bbox.max < least), name
            for legend in figure.legends:
                box = legend.get_window_extent()
                assert box.x0 > -least, name
                assert box.x1 < figure.bbox.x1 + least, name
                assert box.y1 < min(one.y0 for one in boxes) + least, name
            for one, other in combinations(boxes, 2):
                wide = min(one.x1, other.x1) - max(one.x0, other.x0)
                tall = min(one.y1, other.y1) - max(one.y0, other.y0)
                assert min(wide, tall) < 2.0 * least, name
