"""Synthetic records of the rig: their true curves agree with foamfit, files with the records."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS / "recovery"))
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


def test_gravity_and_a_gauge_on_the_specimen() -> None:
    setup = rig.Impact(noise=0.0, gravity=True, before=0.3)
    course = next(
        c for c in (rig.impact(setup, i).course for i in range(9)) if c.rig.springs[0].eta
    )
    mass, area = course.rig.mass, course.rig.area
    time = np.linspace(-0.2 * course.end, 1.2 * course.end, 20_001)
    gained = np.gradient(np.gradient(course.top(time, False), time), time)
    braked = rig.GRAVITY - course.stress(time) * area / mass
    smooth = (np.abs(time) > 1e-3 * course.end) & (np.abs(time - course.end) > 1e-3 * course.end)
    assert np.abs(gained - braked)[smooth][5:-5].max() < 1e-3 * np.ptp(braked)
    rests = course.top(time, gauge=True)
    assert np.all(rests[time <= 0.0] == 0.0)
    after = time > course.end
    assert np.all(np.diff(rests[after]) <= 0.0)  # the specimen recovers after the striker has left
    assert course.top(time, False)[-1] < rests[-1]


def test_a_file_says_what_the_record_holds(tmp_path: Path) -> None:
    setup = rig.Impact(channels=("force", "displacement", "acceleration"), samples=400, before=0.4)
    made = rig.impact(setup, 5)
    header, *rows = rig.write(made, tmp_path).read_text().splitlines()
    assert header == "time (ms),force (N),displacement (mm),acceleration (m/s^2)"
    table = np.array([row.split(",") for row in rows], dtype=float)
    assert table[:, 0] == pytest.approx(1e3 * made.time, abs=1e-7)
    assert table[:, 2] == pytest.approx(1e3 * made.channels["displacement"])
    contact = made.truth["contact_time"]
    before = made.time < contact
    assert before.mean() == pytest.approx(0.4, abs=0.01)
    flown = made.rig.velocity * (contact - made.time[before][-1])
    zero = made.clean["displacement"][before][-1] + flown
    assert zero == pytest.approx(made.truth["displacement_zero"], abs=1e-9)


def test_the_rig_numbers_springs_and_terms_as_the_fit_does() -> None:
    """By the stress at A1 and by the relaxation time, because estimates are compared by name."""
    for seed in range(1, 6):
        truth = rigs.make("slow", "two springs, 300 rows, 0.3 %", seed).truth
        onsets = [
            truth[f"s{i}_k0"] * truth[f"s{i}_eps_a"] / (1.0 - truth[f"s{i}_eps_a"]) for i in (1, 2)
        ]
        assert onsets[0] < onsets[1]
        truth = rigs.make("slow", "microscale+2, 300 rows, 0.3 %", seed).truth
        assert truth["s1_tau1"] < truth["s1_tau2"]


@pytest.mark.parametrize(("truth", "holds", "far"), [(1.0, 1, 0), (1.03, 0, 0), (1.1, 0, 1)])
def test_far_is_an_interval_that_misses_by_more_than_its_width(
    truth: float, holds: bool, far: bool
) -> None:
    found = SimpleNamespace(value=1.0, stderr=0.01, ci95=(0.98, 1.02), state="determined")
    row = rigs.judged("s1_k0", truth, found)
    assert (row["holds"], row["far"]) == (holds, far)


def test_a_failure_is_a_row_and_what_is_done_is_not_done_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ff.InputError("the record is empty.")

    monkeypatch.setattr(ff, "fit", refuse)
    raw = tmp_path / "rows.csv"
    job = ("slow", "microscale, 300 rows, 0.3 %", 1)
    rows = rigs.run([job], raw, 1)
    assert list(rows["error"]) == ["InputError: the record is empty."]
    assert rigs.coverage(rows, "class")["failed"].tolist() == [1, 1]
    monkeypatch.setattr(rigs, "run_test", pytest.fail)
    again = rigs.run([job], raw, 1)
    assert again["error"].tolist() == rows["error"].tolist()
