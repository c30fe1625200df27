"""Synthetic records of the rig: their true curves agree with foamfit."""

from __future__ import annotations

import numpy as np
import pytest

import foamfit as ff
import rig
import rigs


def share(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.abs(found - truth).max() / np.ptp(truth))


@pytest.mark.parametrize("law", ["bistable", "microscale"])
@pytest.mark.parametrize("relaxation", [0, 1])
@pytest.mark.parametrize("seed", [1, 2])
def test_impacts_are_those_of_foamfit(law: str, relaxation: int, seed: int) -> None:
    course = rig.impact(rig.Impact(law=law, relaxation=relaxation), seed).course
    time, drive = np.linspace(0.0, 1.02 * course.end, 800), course.rig
    found = ff.simulate(
        rigs.chain_of(drive), ff.Impact(drive.mass, drive.velocity), time, rtol=1e-9
    )
    assert share(found.base_stress, course.stress(time)) < 1e-6
    assert share(found.displacement[-1], course.top(time, gauge=False)) < 1e-6
    assert found.contact_end == pytest.approx(course.end, rel=1e-6)


@pytest.mark.parametrize(
    "setup",
    [
        rig.Slow(law="bistable", inner=0.05, motion="trapezoid"),
        rig.Slow(law="bistable+bistable", inner=0.1),
        rig.Slow(inner=0.1),
        rig.Slow(relaxation=2, motion="ramp", early=True),
        rig.Slow(relaxation=1, motion="sine"),
        rig.Slow(dashpot=True, relaxation=1),
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_slow_tests_are_those_of_foamfit(setup: rig.Slow, seed: int) -> None:
    course = rig.slow(setup, seed).course
    assert course.rig.motion is not None
    turns = [t for t in course.rig.motion.times if course.start < t < course.end]
    # foamfit interpolates the motion linearly, so a sine and a ramp need many samples.
    samples = 20_001 if setup.motion in ("sine", "ramp") else 1_001
    time = np.union1d(np.linspace(course.start, course.end, samples), turns)
    drive = ff.DisplacementDrive(course.top(time, gauge=False))
    found = ff.simulate(rigs.chain_of(course.rig), drive, time - course.start, rtol=1e-9)
    smooth = ~np.isin(time, [*turns, course.start])  # a dashpot's stress jumps at a turn
    assert share(found.base_stress[smooth], course.stress(time)[smooth]) < 1e-6
