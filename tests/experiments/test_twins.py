"""Statistics that the study of ten twins computes from the fits."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from scipy import stats

from conftest import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS / "twins"))
from twins import Group, change_of, lost, mean_loop


def test_a_change_is_welchs_test_of_the_logarithms() -> None:
    new, worn = (10.0, 11.0, 9.0, 10.5, 9.5), (8.0, 9.0, 7.0, 8.5, 6.5)
    one = change_of("quantity", Group.of(new), Group.of(worn))
    found = stats.ttest_ind(np.log(worn), np.log(new), equal_var=False)
    assert one["p"] == pytest.approx(found.pvalue)
    ends = found.confidence_interval(0.95)
    assert one["change_lo"] == pytest.approx(math.expm1(ends.low))
    assert one["change_hi"] == pytest.approx(math.expm1(ends.high))
    gone = np.mean(np.log(worn)) - np.mean(np.log(new))
    assert one["change"] == pytest.approx(math.expm1(gone))
    spread = math.sqrt(0.5 * (np.var(np.log(new), ddof=1) + np.var(np.log(worn), ddof=1)))
    assert one["change_over_spread"] == pytest.approx(-gone / spread)


def test_the_mean_loop_of_one_loop_is_that_loop() -> None:
    up = np.linspace(0.0, 0.5, 301)
    strain = np.concatenate([up, up[::-1][1:]])
    stress = np.where(np.arange(strain.size) <= 300, 2e5 * strain, 4e5 * strain**2)
    along, mean, spread = mean_loop([(strain, stress), (strain, 1.2 * stress)])
    half = along.size // 2
    assert mean[:half] == pytest.approx(1.1 * 2e5 * along[:half])
    assert mean[half:] == pytest.approx(1.1 * 4e5 * along[half:] ** 2, abs=2.0)
    assert spread[half - 1] == pytest.approx(0.2 * 1e5 / math.sqrt(2.0))
    assert lost((strain, stress)) == pytest.approx(0.5 * 1e5 * 0.5 - 4e5 * 0.5**3 / 3.0, rel=1e-4)
