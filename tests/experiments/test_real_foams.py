"""Third-party records that several studies share are read with their specimens."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from conftest import DATA, EXPERIMENTS, needs_data

sys.path.insert(0, str(EXPERIMENTS / "real_foams"))
import real_foams


@needs_data
def test_every_uniaxial_specimen_is_read(tmp_path: Path) -> None:
    tests = list(real_foams.first_cycles(DATA, tmp_path))
    names = [test.name for test in tests]
    assert len(set(names)) == 14
    assert sum(name.startswith("new-heel") for name in names) == 5
    for test in tests:
        assert float(test.displacement.max()) / test.specimen.height == pytest.approx(0.6, abs=0.03)
