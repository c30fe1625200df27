"""The tables and the figure of the study of real foams, from fabricated fits."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.image
import pandas as pd
import pytest

import fabricated
from conftest import DATA, EXPERIMENTS, needs_data

sys.path.insert(0, str(EXPERIMENTS))

import real_foams


def table(rows: list[tuple[str, str, float, str]]) -> pd.DataFrame:
    """Return a table of fits: test, parameter, value and state of each law."""
    return pd.DataFrame(
        {
            "test": test, "foam": test.rpartition("-comp")[0], "law": law, "misfit": 0.01 * k,
            "agreeing": 3 if test.endswith("1") else 1, "seconds": 2.0, "parameter": parameter,
            "value": value, "state": state,
        }
        for k, law in enumerate(real_foams.LAWS, start=1)
        for test, parameter, value, state in rows
    )  # fmt: skip


ROWS = [
    ("heel-comp-1", "s1_k0", 90.0, "determined"), ("heel-comp-2", "s1_k0", 110.0, "determined"),
    ("heel-comp-1", "s1_kc", 1.0, "weak"), ("heel-comp-2", "s1_kc", 3.0, "not determined"),
]  # fmt: skip


def test_states_agree_where_all_twins_got_the_same() -> None:
    lines = real_foams.law_table(table(ROWS)).splitlines()
    assert lines[2] == "| bistable | 2 | 1.00 % | 1 of 2 | 2.0 s | 2 / 1 / 1 | 1 of 2 |"
    assert lines[5].startswith("| microscale, relaxation | 2 | 4.00 % |")


def test_misfits_stand_by_specimen_and_law() -> None:
    lines = real_foams.misfit_table(table(ROWS)).splitlines()
    assert lines[2:] == [f"| heel-comp-{n} | 1.00 | 2.00 | 3.00 | 4.00 |" for n in (1, 2)]


def test_the_picture_is_drawn_of_both_laws(tmp_path: Path) -> None:
    both = {real_foams.PLAIN: fabricated.microscale_result(relaxation=0),
            real_foams.BEST: fabricated.microscale_result()}  # fmt: skip
    real_foams.draw(both, tmp_path / "loop.png")
    assert matplotlib.image.imread(tmp_path / "loop.png").shape[1] == 1750


@needs_data
def test_every_uniaxial_specimen_is_read(tmp_path: Path) -> None:
    tests = list(real_foams.first_cycles(DATA, tmp_path))
    names = [test.name for test in tests]
    assert len(set(names)) == 14
    assert sum(name.startswith("new-heel") for name in names) == 5
    for test in tests:
        assert float(test.displacement.max()) / test.specimen.height == pytest.approx(0.6, abs=0.03)
