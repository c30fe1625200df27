"""A motion in a separate file with its own clock is resampled to the force or rejected.

The records are synthetic: a force at 100 kHz and camera frames at 10 kHz.
"""

import numpy as np
import pytest

from conftest import SPECIMEN, STRIKER, refused, write_csv
from foamfit.data.csv_file import read_test
from foamfit.data.frames import Frames, join
from foamfit.data.measurement import Record
from foamfit.fitting.problem import make_problem
from foamfit.study.batch import Recipe, fingerprint
from foamfit.study.study_file import find_tests

LAST = 4e-3  # s
MOTION = '[motion]\nfile = "camera.csv"\n'
COLUMNS = MOTION + "[motion.columns]\n"
GREEN, APART = "the Green–Lagrange strain reaches 0.6", "does not overlap in time"


def clock(rate):
    return np.arange(round(LAST * rate) + 1) / rate


def press(t):
    """Return a displacement (m) with a peak of 4 mm."""
    return 4e-3 * np.sin(np.pi * t / LAST)


TIMED, MOVED = {"time (s)": np.copy}, {"displacement (mm)": press}


def table(path, **columns):
    write_csv(path, ",".join(columns), *columns.values(), fmt="%.18e")


def written(folder, toml=MOTION, rate=1e5, frames=None, motion=None, force=None):
    """Write two files, the force and the motion at `frames` (s), and return the first path."""
    t, at = clock(rate), clock(1e4) if frames is None else frames
    given = {"time (ms)": 1e3 * t, "force (N)": 200.0 * np.sin(np.pi * t / LAST)}
    table(folder / "test.csv", **given, **(force or {}))
    given = {"t (us)": 1e6 * at, "displacement (um)": 1e6 * press(at)} if motion is None else motion
    table(folder / "camera.csv", **given)
    (folder / "test.toml").write_text(SPECIMEN + toml, encoding="utf-8")
    return folder / "test.csv"


def taken(test, channel="displacement"):
    return np.flatnonzero(test.sampled[channel])


# What is read.


def test_frames_are_put_on_the_clock_of_the_force(tmp_path):
    test = read_test(written(tmp_path))
    assert test.motion == "measured"
    assert test.time.size == 401
    assert test.displacement == pytest.approx(press(test.time), abs=1e-9)
    assert taken(test).tolist() == list(range(0, 401, 10))
    assert test.uncertainties == {}
    notes = " ".join(test.notes)
    assert "the motion is that of camera.csv: 41 frames, every 100 µs from 0 s to 4 ms" in (
        notes.replace("The", "the")
    )
    assert "the delay is 0 s exactly" in notes
    assert "41 of 401 samples have a frame of the displacement" in notes
    assert test.noise.of("displacement").how.endswith("to 41 frames on their own clock")


@pytest.mark.parametrize(
    ("late", "told"), [(2.5e-4, "250 µs"), (-2.5e-4, "−250 µs"), (100.0, "100 s")]
)
def test_time_of_the_force_is_that_of_the_motion_and_the_delay(tmp_path, late, told):
    at = clock(1e4)
    motion = {"time (s)": at - late, "strain (%)": 1e4 * press(at)}
    toml = f'{MOTION}delay = "{late * 1e6} ± 50 us"\n'
    test = read_test(written(tmp_path, toml, motion=motion))
    assert test.displacement == pytest.approx(press(test.time), abs=1e-9)
    assert test.uncertainties == {"delay": pytest.approx(5e-5)}
    assert any(f"the delay is {told} ± 50 µs" in n for n in test.notes)


def test_a_frame_counts_at_the_sample_nearest_to_it(tmp_path):
    at = clock(1e4)[:-1] + 3.4e-5 + 2e-6  # 4e-6 s before the next sample
    test = read_test(written(tmp_path, frames=at))
    assert test.count.rows == 401
    [gone] = test.count.dropped
    assert gone.why == "outside the time of camera.csv"
    assert gone.rows == 401 - test.time.size == 4 + 7
    samples = clock(1e5)[4 : 4 + test.time.size]
    near = samples[taken(test)]
    assert near[:-1] == pytest.approx(at[: near.size - 1], abs=0.5e-5)  # the last frame is dropped
    assert near[0] == pytest.approx(at[0], abs=0.5e-5)


@pytest.mark.parametrize(("rate", "sigma"), [(1e5, 1.0), (2.5e4, 0.5)])
def test_a_faster_motion_is_interpolated_or_averaged_and_counts_everywhere(rate, sigma):
    at = clock(1e5)
    noise = 1e-5 * np.random.default_rng(0).standard_normal(at.size)
    t = clock(rate)
    record = Record(t, np.sin(np.pi * t / LAST), None)
    joined = join(record, Frames("camera.csv", at, {"displacement": press(at) + noise}))
    assert joined.sampled == {}
    off = joined.displacement - press(t)
    assert np.std(off) == pytest.approx(1e-5 * sigma, rel=0.15)
    clean = join(record, Frames("camera.csv", at, {"displacement": press(at)}))
    assert clean.displacement == pytest.approx(press(t), abs=4e-7)


def test_masses_inside_and_columns_of_the_toml(tmp_path):
    at = clock(1e4)
    toml = COLUMNS + (
        'time = { column = "A", unit = "ms" }\n'
        'displacement = { column = "B", unit = "px", scale = "-10 um/px ± 2 %" }\n'
        'displacement_1 = { column = "C", unit = "mm" }\n'
    ).replace("px", "V")
    motion = {"A": 1e3 * at, "B": -1e5 * press(at), "C": 0.4e3 * press(at), "D": at}
    test = read_test(written(tmp_path, toml, motion=motion))
    assert test.displacement.max() == pytest.approx(4e-3)
    assert test.interior[1].max() == pytest.approx(1.6e-3)
    assert test.sampled.keys() == {"displacement", "displacement_1"}
    assert test.uncertainties == {"displacement_scale": pytest.approx(0.02)}
    assert any(n.startswith("camera.csv: Read") and "not used: 'D'" in n for n in test.notes)


def test_a_spike_is_no_frame(tmp_path):
    at = clock(1e4)
    motion = {"t (us)": 1e6 * at, "displacement (um)": 1e6 * press(at)}
    motion["displacement (um)"][12] += 900.0
    test = read_test(written(tmp_path, motion=motion))
    assert 120 not in taken(test)
    assert taken(test).size == 40
    assert test.displacement == pytest.approx(press(test.time), abs=1e-6)
    assert any("1 frame of the displacement stood out" in note for note in test.notes)


# Fits.


def test_only_frames_are_fitted_and_the_others_are_no_outliers(tmp_path):
    test = read_test(written(tmp_path, STRIKER + MOTION + 'delay = "0 ± 50 us"\n'))
    problem = make_problem(
        test, "bistable", "impact", params=None, weights=None, interior_mass=False
    )
    objective = problem.objective
    for name in ("displacement_time", "stress_strain"):
        assert objective.kept[name].tolist() == taken(test).tolist()
    assert objective.kept["stress_time"].size == test.time.size
    assert objective.n_measured("displacement_time") == taken(test).size
    assert objective.n_data == sum(objective.kept[name].size for name in objective.counted)


def test_the_digest_covers_both_files(tmp_path):
    path = written(tmp_path)
    first = read_test(path).data_sha256
    assert len(first) == 64
    camera = tmp_path / "camera.csv"
    camera.write_text(camera.read_text() + "\n")
    assert read_test(path).data_sha256 != first
    recipe, toml = Recipe("bistable", {}), path.with_name("test.toml")
    before = fingerprint(recipe, path, toml)
    (path.parent / "camera.csv").unlink()
    assert fingerprint(recipe, path, toml) != before


def test_a_motion_is_no_test_of_its_own(tmp_path):
    path = written(tmp_path)
    assert find_tests(tmp_path) == [("test", path)]
    assert find_tests("*.csv", tmp_path) == [("test", path)]
    named = find_tests(tmp_path / "camera.csv")
    assert [name for name, _ in named] == ["camera"]


# What is refused.


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ('[motion]\nfile = "film.csv"\n', ["film.csv: no such file", "[motion] file of test.toml"]),
        ("[motion]\nfile = 3\n", ["test.toml: [motion] file = 3 must be a file"]),
        ('[motion]\nfile = "a\\u0000"\n', ["test.toml: [motion] file", "must be a file"]),
        ('[motion]\nfile = "."\n', ["cannot be read", "[motion] file of test.toml"]),
        ('[motion]\ndelay = "1 us"\n', ["[motion] file is missing; it must be a file, like"]),
        ('[motion]\nfile = "test.csv"\n', ["test.toml: [motion] file", "is the file of the force"]),
        (MOTION + 'shift = "1 us"\n', ["[motion] has no key 'shift'"]),
        (MOTION + "delay = 5\n", ["[motion] delay = 5 is not a quantity"]),
        (MOTION + 'delay = "5 mm"\n', ["[motion] delay", "wrong dimension"]),
        (MOTION + 'delay = "0 ± -5 us"\n', ["[motion] delay", "must not be negative"]),
        (MOTION + 'delay = "0 us ± 5 %"\n', ["[motion] delay", "less than the value"]),
        (MOTION + 'delay = "0 us ± 5 um"\n', ["[motion] delay", "± has the wrong dimension"]),
        (MOTION + 'delay = "5 ms"\n', [APART, "0 s to 4 ms", "5 ms to 9 ms"]),
        (MOTION + 'delay = "0 ± 5 ms"\n', ["[motion] ± of delay = 5 ms is longer"]),
        (
            MOTION + 'delay = "3.95 ms"\n',
            [
                "camera.csv overlaps in time with 6 samples of the force; at least 10 are needed",
                "0 s to 4 ms",
            ],
        ),
        (COLUMNS + 'force = { column = "F" }\n', ["[motion.columns] has no key 'force'"]),
        (
            COLUMNS + 'velocity = { column = "v" }\n',
            ["no key 'velocity'; its keys are time, displ"],
        ),
        (
            COLUMNS + 'displacement = { column = "x" }\n',
            ["camera.csv: [motion.columns] displacement: column 'x' is nowhere"],
        ),
    ],
)
def test_a_wrong_motion_is_refused(tmp_path, toml, words):
    refused(written(tmp_path, toml), *words)


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (MOVED, ["camera.csv: no column is a time", "[motion.columns]"]),
        (TIMED | {"x": press}, ["camera.csv: no column is a displacement or a strain"]),
        (
            TIMED | {"displacement": press},
            ["'displacement' has no unit", "in [motion.columns] like displacement"],
        ),
        ({"time (s)": np.negative} | MOVED, ["camera.csv: row 3", "goes back"]),
        (TIMED | {"green strain (%)": lambda t: 1.5e4 * press(t)}, ["camera.csv: " + GREEN]),
        ({"time (s)": lambda t: t + 1.0} | MOVED, ["test.toml: [motion] camera.csv " + APART]),
    ],
)
def test_a_file_of_frames_that_cannot_be_used_is_refused(tmp_path, motion, words):
    columns = {name: made(clock(1e4)) for name, made in motion.items()}
    columns |= {"note": clock(1e4)} if len(columns) == 1 else {}
    refused(written(tmp_path, motion=columns), *words)


@pytest.mark.parametrize("name", ["displacement (mm)", "strain (%)", "displacement_1 (mm)"])
def test_a_motion_in_both_files_is_refused(tmp_path, name):
    path = written(tmp_path, force={name: 1e3 * press(clock(1e5))})
    refused(path, "test.csv: column", "'camera.csv' contains the motion; leave one of them out")


def test_a_force_without_a_time_is_refused(tmp_path):
    path = written(tmp_path)
    table(path, **{"force (N)": 200.0 * clock(1e5), "more": clock(1e5)})
    refused(path, "test.csv: no column is a time")
