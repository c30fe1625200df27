"""Files made again on another machine change tracked files only where a figure has changed."""

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
        ("coverage 94.1 %", "coverage 94.2 %", True),
        ("coverage 94.1 %", "coverage 94.3 %", False),
        ("misfit 0.55 %", "misfit 0.56 %", False),
        ("error 3.62e-05", "error 3.61e-05", True),
        ("error 3.62e-05", "error 3.60e-05", False),
        ("error 0.00024", "error 0.000239", True),
        ("error 3e-14", "error −8e-13", True),
        ("1910 answers", "1911 answers", False),
        ('"nfev": 1910,', '"nfev": 1811,', True),
        ("110 refused", "112 refused", False),
        ("0.41 s each", "0.99 s each", True),
        ("0.41 s each", "4.9 s each", False),
        ('"runtime_s": 0.5,', '"runtime_s": 1.1,', True),
        ("k0 determined 5.5", "k0 weak 5.5", False),
        ("(foamfit 0.1.0, Python 3.11.7, x86_64)", "(foamfit 0.2.0, Python 3.13.1, arm64)", True),
        ("AMD EPYC (x86_64, 2 cores); 5 fits", "Apple M3 (arm64, 8 cores); 5 fits", True),
        ("AMD EPYC (x86_64, 2 cores); 5 fits", "Apple M3 (arm64, 8 cores); 6 fits", False),
        ('"processor": "AMD, 2 cores, x86_64",', '"processor": "M3, 8 cores, arm64",', True),
        (
            "| n | kernel (s) |\n| --- | --- |\n| 1 | 2e-5 |",
            "| n | kernel (s) |\n| --- | --- |\n| 1 | 9e-6 |",
            True,
        ),
        (
            "| n | kernel (s) |\n| --- | --- |\n| 1 | 2e-5 |",
            "| n | kernel (s) |\n| --- | --- |\n| 2 | 2e-5 |",
            False,
        ),
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
        "same-runs.csv": b"# Python 3.11.7\nname,time (s),median (s),runs\nk0,5.5,0.2,100\n",
        "other-runs.csv": b"# Python 3.11.7\nname,time (s),median (s),runs\nk0,5.5,0.2,100\n",
        "same.png": png(picture), "other.png": png(picture), "page.html": b"<p>1</p>",
    }  # fmt: skip
    new = {
        "same.csv": b"name,value,seconds\nk0,5.5000002,0.5\n",
        "other.csv": b"name,value,seconds\nk0,5.6,0.2\n",
        "same-runs.csv": b"# Python 3.13.1\nname,time (s),median (s),runs\nk0,5.5,0.4,180\n",
        "other-runs.csv": b"# Python 3.11.7\nname,time (s),median (s),runs\nk0,5.6,0.2,100\n",
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


def test_files_are_put_back_where_the_study_ends_by_an_exception(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_bytes(b"name,seconds\nk0,0.2\n")

    def study() -> None:
        table.write_bytes(b"name,seconds\nk0,0.3\n")
        sys.exit("a scene ended with a wrong answer")

    with pytest.raises(SystemExit), keep_unchanged(table):
        study()
    assert table.read_bytes() == b"name,seconds\nk0,0.2\n"
