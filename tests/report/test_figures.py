"""Figures for print: widths, room, editable text, distinguishable colours."""

from itertools import combinations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import fabricated
from conftest import run_refused
from drawn import figures
from foamfit.errors import InputError
from foamfit.report.figures import BLUE, DPI, SEEN, STYLE, VERMILION, images, inches


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


@pytest.mark.parametrize("name", ["microscale, relaxing", "comparison"])
def test_text_is_text(name: str) -> None:
    """A PDF has TrueType fonts, and an SVG has words."""
    figure = dict(figures())[name]
    pdf, svg = images(figure, "pdf", "svg")
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf
    root = ElementTree.fromstring(svg)
    words = ["".join(one.itertext()) for one in root.iter("{http://www.w3.org/2000/svg}text")]
    letters = set("".join(words))
    assert set("σ+−" if name == "comparison" else "σ₊₋–·%") <= letters
    assert "published" in words if name == "comparison" else "stress (kPa)" in words


# Colour vision without one type of cone, by the matrices of Machado, Oliveira and Fernandes (2009,
# IEEE Trans. Vis. Comput. Graph. 15, 1291) in linear RGB.
EYES = {
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
    "grey": [[0.2126, 0.7152, 0.0722]] * 3,
}  # fmt: skip
# Smallest distance in L*a*b* (CIE76, D65) at which lines are distinguishable at a glance, in colour
# and in grey (where only lightness differs).
APART, APART_IN_GREY = 20.0, 12.0
XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]


def lab(colour: Any, eye: str) -> np.ndarray:
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(EYES[eye]) @ linear, 0.0, 1.0)
    x, y, z = np.array(XYZ) @ seen / [0.9505, 1.0, 1.089]
    f = [t ** (1 / 3) if t > 0.008856 else 7.787 * t + 16 / 116 for t in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(one: Any, other: Any, eye: str) -> float:
    return float(np.linalg.norm(lab(one, eye) - lab(other, eye)))


def is_told(one: Any, other: Any) -> dict[str, float]:
    """Return the kinds of vision that do not distinguish two colours, with their difference."""
    found = {eye: apart(one, other, eye) for eye in EYES}
    return {
        eye: round(far, 1) for eye, far in found.items()
        if far < (APART_IN_GREY if eye == "grey" else APART)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (SEEN["color"], VERMILION),
        (BLUE, "white"),  # hollow marks
    ],
)
def test_measured_and_simulated_are_told_apart(one: str, other: str) -> None:
    assert not is_told(one, other)
