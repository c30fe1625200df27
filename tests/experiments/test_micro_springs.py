"""Discrete micro-springs, which know nothing of foamfit, converge to its law."""

from __future__ import annotations

import pytest

import microscale


def test_micro_springs_converge_to_the_law_as_their_number() -> None:
    table = [(n, *microscale.errors(n)) for n in (10, 100)]
    assert microscale.rate(table, 1) == pytest.approx(-1.0, abs=0.02)
    assert table[0][1] == pytest.approx(0.0131, rel=0.01)
