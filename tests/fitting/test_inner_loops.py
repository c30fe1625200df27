"""Records with partial unloading: microscale springs follow it, bistable springs do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import loop_measurement
from foamfit.data.measurement import Measurement, Noise, Specimen
from foamfit.report.summary import summary_text

SPRING = ff.MicroscaleSpring(4.4e5, 4.9e5, 0.29, 1.06e5, 0.44, 6e4, 0.7)
HEIGHT, SIGMA = 0.01, 500.0
CORNERS = (0.0, 0.35, 0.2, 0.6, 0.3, 0.45, 0.0)


def record(corners: tuple[float, ...] = CORNERS, between: int = 60) -> Measurement:
    """Return a synthetic test between the given strains, with noise on its stress."""
    ends = np.arange(len(corners), dtype=float)
    time = np.linspace(0.0, ends[-1], between * (len(corners) - 1) + 1)
    strain = np.interp(time, ends, corners)
    noise = SIGMA * np.random.default_rng(3).standard_normal(time.size)
    stress = np.asarray(SPRING.stress(strain)) + noise
    made = loop_measurement(stress, strain * HEIGHT, Specimen(HEIGHT, 5e-5), time)
    return replace(made, noise=Noise(stress=SIGMA))


def test_microscale_springs_follow_inner_loops_to_the_noise() -> None:
    test = record()
    micro = ff.fit(test, model="microscale", starts=4, intervals="local")
    assert micro.noise["stress_strain"]["residual_over_noise"] == pytest.approx(1.0, abs=0.1)
    for name in ("k0", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus"):
        assert micro.parameters[f"s1_{name}"].value == pytest.approx(getattr(SPRING, name), rel=0.1)
    assert not any("inner loops" in note for note in micro.notes)
    (visited,) = (check for check in micro.checklist if check.key == "visited")
    assert (visited.answer, visited.sentence) == (True, "a, snap-through and snap-back were.")


def test_a_bistable_fit_says_what_partial_unloading_leaves() -> None:
    test = record()
    fit = ff.fit(test, model="bistable", starts=4, intervals="local")
    (told,) = (note for note in fit.notes if "inner loops" in note)
    assert "from 1 s to 2.383 s and from 4 s to 5.35 s" in told
    squares = (fit.curves.stress_along - test.stress) ** 2
    inside = sum(squares[a:b].sum() for a, b in ((60, 143), (240, 321))) / squares.sum()
    assert inside > 0.5
    assert f"these 45 % of the samples account for {100.0 * inside:.2g} % of the squared" in told
    assert "microscale springs do" in told
    assert told in " ".join(summary_text(fit, verbose=True).split())
