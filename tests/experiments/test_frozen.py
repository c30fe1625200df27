"""The study of frozen results reports every change and nothing else."""

from __future__ import annotations

import sys

import pytest

from conftest import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS / "frozen"))
from frozen import changed

BEFORE = {
    ("simulation a", "peak"): "1000.0",
    ("fit", "s1_k0 value"): "100.0",
    ("fit", "s1_k0 stderr"): "2.0",
    ("fit", "s1_k0 state"): "determined",
    ("fit", "misfit stress_time"): "0.01",
}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        (("simulation a", "peak"), "1000.0000001", False),
        (("simulation a", "peak"), "1000.00001", True),
        (("fit", "s1_k0 value"), "100.01", False),  # within a hundredth of its standard error
        (("fit", "s1_k0 value"), "100.03", True),
        (("fit", "s1_k0 stderr"), "2.001", False),
        (("fit", "s1_k0 state"), "weak", True),
        (("fit", "misfit stress_time"), "0.0101", True),
        (("fit", "s1_kc value"), "1.0", True),
    ],
)
def test_a_change_beyond_rounding_is_said(key: tuple[str, str], value: str, said: bool) -> None:
    told = changed(BEFORE, BEFORE | {key: value})
    assert bool(told) is said
    assert all(" ".join(key) in line for line in told)


def test_what_is_gone_is_said() -> None:
    assert len(changed(BEFORE, {})) == len(BEFORE)
