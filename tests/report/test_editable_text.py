"""Text in figures stays editable: TrueType fonts in a PDF, words in an SVG."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from drawn import figures
from foamfit.report.figures import images


@pytest.mark.parametrize("name", ["microscale, relaxing", "comparison"])
def test_text_is_text(name: str) -> None:
    figure = dict(figures())[name]
    pdf, svg = images(figure, "pdf", "svg")
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf
    root = ElementTree.fromstring(svg)
    words = ["".join(one.itertext()) for one in root.iter("{http://www.w3.org/2000/svg}text")]
    letters = set("".join(words))
    assert set("σ+−" if name == "comparison" else "σ₊₋–·%") <= letters
    assert "published" in words if name == "comparison" else "stress (kPa)" in words
