"""The study of discrete micro-springs: its numbers, and its page, which must contain them."""

from __future__ import annotations

import importlib.util
import re
import sys

import pytest

from conftest import EXPERIMENTS

FOLDER = EXPERIMENTS / "microscale"
_spec = importlib.util.spec_from_file_location("microscale_study", FOLDER / "microscale.py")
assert _spec is not None
assert _spec.loader is not None
study = importlib.util.module_from_spec(_spec)
sys.modules["microscale_study"] = study
_spec.loader.exec_module(study)


def test_micro_springs_converge_to_the_law_as_their_number() -> None:
    table = [(n, *study.errors(n)) for n in (10, 100)]
    assert study.rate(table, 1) == pytest.approx(-1.0, abs=0.02)
    assert table[0][1] == pytest.approx(0.0131, rel=0.01)
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    for n, largest, rms in table:
        assert f"| {n} | {largest:.2e} | {rms:.2e} |" in page


def test_inner_loops_close() -> None:
    assert max(study.returns(n) for n in (None, 2, 7, 50)) < 1e-15


def test_page_is_the_filled_template() -> None:
    template = (FOLDER / "page.template.md").read_text(encoding="utf-8")
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    for text in re.split(r"{[^}]+}", template):
        assert text in page
    assert (FOLDER / "microscale.png").is_file()
