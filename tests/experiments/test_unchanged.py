"""What is remade on another machine changes nothing that is tracked, unless a figure changed."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from conftest import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
from unchanged import keep_unchanged, same_text


@pytest.mark.parametrize(
    ("old", "new", "alike"),
    [
        ("coverage 94.12 %", "coverage 94.13 %", True),
        ("coverage 94.1 %", "coverage 95.1 %", False),
        ("error 3e-14", "error −8e-13", True),
        ("1910 answers", "1911 answers", False),
        ('"nfev": 1910,', '"nfev": 1811,', True),
        ("110 refused", "112 refused", False),
        ("0.41 s each", "0.99 s each", True),
        ("0.41 s each", "4.9 s each", False),
        ('"runtime_s": 0.5,', '"runtime_s": 1.1,', True),
        ("k0 determined 5.5", "k0 weak 5.5", False),
    ],
)
def test_what_texts_say(old: str, new: str, alike: bool) -> None:
    assert same_text(old, new) == alike


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    matplotlib.image.imsave(file, pixels, format="png")
    return file.getvalue()


def test_files_are_put_back_unless_they_really_changed(tmp_path: Path) -> None:
    picture = np.zeros((100, 100))
    smudged, redrawn = picture.copy(), picture.copy()
    smudged[0, :20], redrawn[:, :20] = 1.0, 1.0
    old = {
        "same.csv": b"name,value,seconds\nk0,5.5000001,0.2\n",
        "other.csv": b"name,value,seconds\nk0,5.5,0.2\n",
        "same.png": png(picture), "other.png": png(picture), "page.html": b"<p>1</p>",
    }  # fmt: skip
    new = {
        "same.csv": b"name,value,seconds\nk0,5.5000002,0.5\n",
        "other.csv": b"name,value,seconds\nk0,5.6,0.2\n",
        "same.png": png(smudged), "other.png": png(redrawn), "page.html": b"<p>2</p>",
    }  # fmt: skip
    for name, content in old.items():
        (tmp_path / name).write_bytes(content)
    with keep_unchanged(tmp_path):
        for name, content in new.items():
            (tmp_path / name).write_bytes(content)
        (tmp_path / "more.csv").write_bytes(b"new")
    for name in old:
        kept = name.startswith("same")
        assert (tmp_path / name).read_bytes() == (old if kept else new)[name], name
    assert (tmp_path / "more.csv").exists()
