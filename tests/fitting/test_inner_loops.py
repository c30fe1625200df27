"""Records with partial unloading: microscale springs follow it, bistable springs do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import loop_measurement
from foamfit.data.cycles import inner_loops
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


@pytest.mark.parametrize(
    ("corners", "loops"),
    [
        (CORNERS, [(60, 143), (240, 321)]),
        ((0.0, 0.6, 0.0), []),
        ((0.0, 0.5, 0.2, 0.4, 0.3, 0.6, 0.0), [(60, 280)]),  # a loop within a loop
        ((0.0, 0.6, 0.3, 0.5), [(120, 181)]),  # the record ends within its inner loop
    ],
)
def test_partial_unloading_lasts_until_the_motion_is_past_it(
    corners: tuple[float, ...], loops: list[tuple[int, int]]
) -> None:
    assert inner_loops(record(corners).displacement) == loops


def test_microscale_springs_follow_inner_loops_to_the_noise() -> None:
    test = record()
    micro = ff.fit(test, model="microscale", starts=4, intervals="local")
    assert micro.noise["stress_strain"]["residual_over_noise"] == pytest.approx(1.0, abs=0.1)
    for name in ("k0", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus"):
        assert micro.parameters[f"s1_{name}"].value == pytest.approx(getattr(SPRING, name), rel=0.1)
    assert not any("inner loops" in note for note in micro.notes)
    (visited,) = (check for check in micro.checklist if check.key == "visited")
    assert (visited.answer, visited.sentence) == (True, "a, snap-through and snap-back were.")


def test_snap_back_that_was_not_reached_is_told() -> None:
    up = record((0.0, 0.6))
    fit = ff.fit(up, model="microscale", starts=2, intervals="local")
    (visited,) = (check for check in fit.checklist if check.key == "visited")
    assert (visited.answer, visited.sentence) == (False, "Not visited: snap-back of s1.")
    assert fit.parameters["s1_sigma_minus"].why == "branch snap-back of spring 1 was never reached"


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
