"""Slow tests of a relaxing foam with holds, rests, steps and many cycles, read from files."""

from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
from conftest import SPECIMEN, assert_near, write_csv
from foamfit.data.blocks import without_holds
from foamfit.data.energy import audit
from foamfit.data.measurement import Record

LAW = {
    "k0": 5e5, "kc": 9e5, "eps_star": 0.25, "sigma_plus": 1.1e5, "spread_plus": 0.35,
    "sigma_minus": 6e4, "spread_minus": 0.5,
}  # fmt: skip
TERM = {"g1": 0.4, "tau1": 0.5}
STEPS = [p for k in range(6) for p in ((10.2 * k, 0.1 * k), (10.2 * k + 0.2, 0.1 * k + 0.1))]
HELD = 1.0 + np.geomspace(3e-3, 299.9, 200)  # as a logger with a logarithmic clock writes it
UNEVEN = np.concatenate([np.linspace(0.0, 1.0, 301), HELD, np.linspace(301.0, 302.0, 301)])
# Corners of the strain along the time (s), and the interval between rows, s.
PATHS = {
    "long hold": ([(0, 0), (2, 0.6), (152, 0.6), (154, 0)], 0.01),
    "hold of an hour": ([(0, 0), (2, 0.6), (3602, 0.6), (3604, 0)], 0.1),
    "steps": ([*STEPS, (61.2, 0.6), (63.2, 0)], 0.02),
    "preload": ([(0, 0), (0.2, 0.04), (5.2, 0.04), (7.2, 0.6), (9.2, 0)], 0.01),
    "partial unloading": ([(0, 0), (1, 0.3), (1.5, 0.15), (3, 0.6), (5, 0)], 0.005),
    "rest of an hour": ([(0, 0), (2, 0.6), (4, 0), (3604, 0), (3606, 0.6), (3608, 0)], 0.02),
    "no rest": ([(0, 0), (2, 0.6), (4, 0), (6, 0.6), (8, 0)], 0.01),
    "uneven hold": ([(0, 0), (1, 0.6), (301, 0.6), (302, 0)], 0.0),
    "many cycles": ([(2 * k, 0.6 * (k % 2)) for k in range(61)], 0.065),
}


def record(folder: Path, name: str, copies: int = 1) -> Path:
    """Write the record of a relaxing foam along one of `PATHS`, with noise in both channels."""
    corners, step = PATHS[name]
    at, strains = np.transpose(corners)
    time = np.arange(0.0, at[-1] + 0.5 * step, step) if step else UNEVEN
    if step and at[-1] > 1000.0:  # rows in a hold or rest of an hour are few
        moves = np.diff(strains)[np.searchsorted(at[1:-1], time)] != 0.0
        time = time[moves | (time % 20.0 < step)]
    strain = np.interp(time, at, strains)
    spring = ff.MicroscaleSpring(**LAW, relaxation=[(TERM["g1"], TERM["tau1"])])
    chain = ff.Chain([spring], [10e-3], 1e-4)
    stress = ff.simulate(chain, ff.DisplacementDrive(10e-3 * strain), time).base_stress
    noise = np.random.default_rng(5).standard_normal((2, time.size))
    read = [np.maximum(stress, 0.0) / 1e3 + 2e-6 * np.ptp(stress) * noise[0]]
    rows = np.repeat([time, *read, 10.0 * strain + 5e-4 * noise[1]], copies, axis=1)
    head = "time (s),stress (kPa),displacement (mm)"
    return write_csv(folder / "slow.csv", head, *rows, fmt="%.6f", toml=SPECIMEN)


def fitted(path: Path, drive: str | None = None, **chosen: object) -> ff.FitResult:
    options = {"drive": drive, "intervals": "local", "starts": 8}
    return ff.fit(ff.read_test(path, **chosen), model="microscale", relaxation=1, **options)


@pytest.mark.parametrize(
    ("name", "chosen"),
    [
        ("long hold", {}),  # 11 rows were averaged, 5 % of the ramp: k0 was twice as large
        ("hold of an hour", {}),  # tau had a limit above its value: g1 was a third too small
        ("steps", {}),  # the first hold was taken for a rest, its stress for an offset
        ("preload", {}),
        ("partial unloading", {}),
        ("rest of an hour", {"cycles": (1, 2)}),  # ended in a traceback
        ("uneven hold", {}),  # the motion swung by its height between the rows
        ("no rest", {"cycle": 2}),  # began without the stress of cycle 1: k0 was 13 % off
        ("many cycles", {"cycles": (1, 30)}),  # means of rows cut off the peaks
    ],
)
def test_holds_rests_and_steps_hide_no_loading(
    tmp_path: Path, name: str, chosen: dict[str, object]
) -> None:
    found = fitted(record(tmp_path, name), **chosen)
    assert_near(found, LAW | TERM, 4.0)
    assert found.misfit["stress_strain"] < 0.0025


def test_steps_of_a_driving_stress_all_count(tmp_path: Path) -> None:
    """It was zero up to the end of the first step: k0 was a quarter too small, determined."""
    time = np.linspace(0.0, 30.0, 501)
    corners = [t for k in range(5) for t in (5.0 * k, 5.0 * k + 0.5)]
    stress = np.interp(
        time, [*corners, 25.0, 28.0], [*np.repeat(np.arange(6) * 9e4, 2)[1:-1], 4.5e5, 0.0]
    )
    spring = ff.MicroscaleSpring(**LAW, relaxation=[(TERM["g1"], TERM["tau1"])])
    chain = ff.Chain([spring], [10e-3], 1e-4)
    motion = ff.simulate(chain, ff.StressDrive(stress), time).displacement[-1]
    noise = np.random.default_rng(5).standard_normal((2, time.size))
    rows = time, stress / 1e3 + 0.5 * noise[0], 1e3 * motion + 5e-4 * noise[1]
    head = "time (s),stress (kPa),displacement (mm)"
    path = write_csv(tmp_path / "slow.csv", head, *rows, fmt="%.6f", toml=SPECIMEN)
    assert_near(fitted(path, drive="stress"), LAW | TERM, 4.0)


def test_noisy_cycles_are_no_rest() -> None:
    """Two thirds of their rows were left out as a hold."""
    time = np.linspace(0.0, 80.0, 40_001)
    noise = np.random.default_rng(0).standard_normal((2, time.size))
    motion = np.abs((time / 2.0 + 1.0) % 2.0 - 1.0) + 0.02 * noise[0]
    kept, block = without_holds(Record(time, motion**2 + 0.02 * noise[1], motion))
    assert len(kept) == time.size
    assert block < 11


def test_rows_written_several_times_add_nothing(tmp_path: Path) -> None:
    """They were spread over the time until the next: g1 was 8 % off."""
    once = ff.read_test(record(tmp_path, "preload"))
    again = ff.read_test(record(tmp_path, "preload", copies=4))
    np.testing.assert_array_equal(once.time, again.time)
    np.testing.assert_allclose(once.stress, again.stress, rtol=1e-12)


def test_the_energy_of_several_cycles_is_that_up_to_the_first_peak(tmp_path: Path) -> None:
    """A curve through all peaks went to twice the largest motion."""
    path = record(tmp_path, "rest of an hour")
    one, several = (audit(ff.read_test(path, **c)) for c in ({}, {"cycles": (1, 2)}))
    assert several.dissipated_energy > 1.5 * one.dissipated_energy
    assert 0.9 < several.absorbed_energy / one.absorbed_energy < 3.0


def test_a_record_that_ends_under_load_determines_nothing_if_the_law_errs(tmp_path: Path) -> None:
    """Without the last tenth of the unloading sigma_minus moved by more than its range."""
    path = record(tmp_path, "no rest")
    path.with_suffix(".toml").write_text(SPECIMEN + '[window]\nstart = "0 s"\nend = "3.2 s"\n')
    found = ff.fit(ff.read_test(path), starts=8)
    states = {p.state for p in found.parameters.values() if p.vary}
    assert "determined" not in states
    assert any("the record ends at" in p.why for p in found.parameters.values())
