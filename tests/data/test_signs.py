"""Channels that are negative in compression are reversed and named; ambiguous ones are refused.

The records are written by plain NumPy: a foam that is stiffer in loading than in unloading, under
motions that machines and strikers make.
"""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

import fabricated
from conftest import DATA, SPECIMEN, needs_data, refused, run, specimen_toml, write_csv
from foamfit.data.csv_file import read_test
from foamfit.data.measurement import Measurement
from foamfit.report.summary import summary_text

STRIKER = '[striker]\nmass = "1 kg"\nvelocity = "4 m/s"\n'
COMBINATIONS = [(1, -1), (-1, 1), (-1, -1)]  # signs of force and motion


def path_through(corners: list[float], n: int = 120) -> np.ndarray:
    parts = [np.linspace(a, b, n, endpoint=False) for a, b in itertools.pairwise(corners)]
    return np.concatenate([*parts, [corners[-1]]])


def foam(w: np.ndarray) -> np.ndarray:
    """Return the force (N) of a foam 10 mm high at a displacement (mm); none without contact."""
    x = np.maximum(w, 0.0)
    loading = np.gradient(w) > 0.0
    return np.where(loading, 60.0 * np.tanh(4.0 * x), 20.0 * x / 5.0) + 0.3 * x**4


def noisy(values: np.ndarray, share: float = 0.002) -> np.ndarray:
    rng = np.random.default_rng(len(values))
    return values + share * np.ptp(values) * rng.standard_normal(len(values))


def motions() -> dict[str, np.ndarray]:
    """Return displacements (mm) of slow tests by name."""
    return {
        "loop": path_through([0, 5, 0]),
        "loading alone": path_through([0, 5]),
        "unloading alone": path_through([5, 0]),
        "cycles": path_through([0, 5, 0, 5, 0, 5, 0]),
        "rising cycles": path_through([0, 1, 0, 2, 0, 4, 0]),
        "inner loops": path_through([0, 2, 1, 5, 3, 4, 0]),
        "approach": path_through([-6, 5, -6], 400),
        "lifted before": path_through([0, -3, 5, 0]),
        "retracted far away": path_through([-1, 5, -60], 400),
    }


def written(folder: Path, toml: str = SPECIMEN, name: str = "test", **columns: np.ndarray) -> Path:
    """Write a table; the keys are headers with _ for blanks around units."""
    path = folder / f"{name}.csv"
    return write_csv(path, ",".join(columns), *columns.values(), toml=toml)


def same(one: Measurement, other: Measurement) -> None:
    """Check that two records contain the same samples and rows."""
    assert one.rows == other.rows
    for name, values in one.channels().items():
        size = float(np.ptp(values))
        np.testing.assert_allclose(other.channels()[name], values, atol=1e-6 * size, err_msg=name)


# ---------------------------------------------------------------------- force and motion


@pytest.mark.parametrize("gap", [0.0, 80.0])
@pytest.mark.parametrize("kind", motions())
def test_a_slow_test_of_any_convention_is_the_same_test(
    tmp_path: Path, kind: str, gap: float
) -> None:
    w = motions()[kind]
    force, t = noisy(foam(w)), 0.01 * np.arange(len(w))
    plain = read_test(written(tmp_path, time_s=t, force_N=force, displacement_mm=w))
    assert plain.turned == ()
    for sign, way in COMBINATIONS:
        other = written(tmp_path, time_s=t, force_N=sign * force, Position_mm=way * w + gap)
        test = read_test(other)
        expected = [("force", sign), ("displacement", way)]
        assert test.turned == tuple(name for name, value in expected if value < 0)
        if gap == 0.0:
            same(plain, test)


@pytest.mark.parametrize("at", ["after the test", "before the test", "in the test"])
def test_samples_that_are_no_part_of_the_test_have_no_say(tmp_path: Path, at: str) -> None:
    """Five of 961 rows are lower than the peak is high, as when an evaluation ends."""
    w = path_through([0, 5, 0.5], 480)
    force, t = noisy(foam(w)), 0.01 * np.arange(len(w))
    rows = {"after the test": slice(-5, None), "before the test": slice(5), "in the test": 300}[at]
    force[rows] = -6.0 * force.max()
    plain = read_test(written(tmp_path, time_s=t, force_N=force, displacement_mm=w))
    assert plain.turned == ()
    assert plain.stress.max() == pytest.approx(1e4 * foam(w).max(), rel=0.02)
    assert plain.stress.min() > -0.1 * plain.stress.max()
    dropped = [item for item in plain.rows.dropped if "jumps there by more" in item.why]
    assert [item.rows for item in dropped] == ([] if at == "in the test" else [5])
    for sign, way in COMBINATIONS:
        path = written(tmp_path, time_s=t, force_N=sign * force, displacement_mm=way * w)
        same(plain, read_test(path))


def test_adhesion_at_the_end_is_kept(tmp_path: Path) -> None:
    w = path_through([0, 5, 0])
    force, t = foam(w), 0.01 * np.arange(len(w))
    force[-15:] = -8.0
    plain = read_test(written(tmp_path, time_s=t, force_N=force, displacement_mm=w))
    assert (plain.turned, plain.stress.min()) == ((), pytest.approx(-8e4))
    assert any("kept" in note and "−" in note for note in plain.notes)
    test = read_test(written(tmp_path, time_s=t, force_N=-force, displacement_mm=-w))
    assert test.turned == ("force", "displacement")
    same(plain, test)


def test_a_first_row_of_zeros_is_no_gap(tmp_path: Path) -> None:
    w = path_through([0, 5, 0])
    force, t = np.append(0.0, foam(w)), 0.01 * np.arange(len(w) + 1)
    gap = np.append(0.0, 30.0 - w)
    test = read_test(written(tmp_path, time_s=t, force_N=force, Gap_mm=gap))
    assert test.displacement.max() == pytest.approx(5e-3, rel=0.01)
    assert any("row 2: the displacement jumps there" in str(item) for item in test.rows.dropped)


# ---------------------------------------------------------------------- impacts


def impact(rest: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time (ms), force (N) and displacement (mm) of an impact at 4 m/s, 3.2 mm deep."""
    t = np.arange(-1.0, 4.0, 0.005)
    frequency = np.pi / 2.5
    inside = (t >= 0.0) & (t <= 2.5)
    w = np.where(
        inside, 4.0 / frequency * np.sin(frequency * t), np.where(t > 2.5, 10 - 4 * t, 4 * t)
    )
    w = np.where(rest & (t < 0.0), 0.0, w)
    force = np.where(inside, 4e3 * frequency * np.sin(frequency * t), 0.0)
    return t, noisy(force, 0.003), noisy(w, 0.0003)


@pytest.mark.parametrize("rest", [False, True])
def test_an_impact_of_any_convention_is_the_same_test(tmp_path: Path, rest: bool) -> None:
    t, force, w = impact(rest)
    toml = SPECIMEN + STRIKER
    plain = read_test(written(tmp_path, toml, time_ms=t, force_N=force, displacement_mm=w))
    assert plain.turned == ()
    for sign, way in COMBINATIONS:
        columns = {"time_ms": t, "force_N": sign * force, "displacement_mm": way * w}
        same(plain, read_test(written(tmp_path, toml, **columns)))


@pytest.mark.parametrize("late", ["", "undershoot", "artefact"])
def test_a_force_alone_is_judged_by_its_pulse(tmp_path: Path, late: str) -> None:
    t, force, _ = impact(rest=True)
    if late == "undershoot":  # of a charge amplifier
        force = force - 0.05 * force.max() * (t > 2.5) * np.exp(-(t - 2.5))
    elif late == "artefact":
        force[-4:] = -7.0 * force.max()
    toml = SPECIMEN + STRIKER
    plain = read_test(written(tmp_path, toml, time_ms=t, force_N=force))
    test = read_test(written(tmp_path, toml, time_ms=t, force_N=-force))
    assert (plain.turned, test.turned) == ((), ("force",))
    same(plain, test)


def test_the_other_channels_agree_with_force_and_motion(tmp_path: Path) -> None:
    t, force, w = impact(rest=False)
    toml = SPECIMEN + STRIKER
    velocity = np.convolve(np.gradient(w, t), np.full(41, 1 / 41), "same")
    for sign, way in itertools.product((1, -1), (1, -1)):
        columns = {"time_ms": t, "force_N": sign * force, "velocity_m/s": way * velocity}
        test = read_test(written(tmp_path, toml, **columns))
        assert ("force" in test.turned, "velocity" in test.turned) == (sign < 0, way < 0)
        assert test.displacement.max() == pytest.approx(3.2e-3, rel=0.05)
        columns = {"time_ms": t, "velocity_m/s": way * velocity}
        test = read_test(written(tmp_path, toml, **columns))
        assert test.turned == (("velocity",) if way < 0 else ())
        columns = {"time_ms": t, "force_N": force, "acceleration_m/s2": sign * force}
        test = read_test(written(tmp_path, toml, **columns))
        assert test.turned == (("acceleration",) if sign < 0 else ())
        columns = {"time_ms": t, "acceleration_m/s2": sign * force, "displacement_mm": way * w}
        test = read_test(written(tmp_path, toml, **columns))
        assert ("acceleration" in test.turned, "displacement" in test.turned) == (sign < 0, way < 0)
        _, force, w = impact(rest=True)
        columns = {"time_ms": t, "force_N": force, "displacement_mm": w}
        columns |= {"stress_MPa": sign * force / 100, "strain_%": 10 * way * w}
        test = read_test(written(tmp_path, toml, **columns, **{"displacement_1_mm": way * w / 2}))
        assert ("stress" in test.turned) == (sign < 0)
        assert {"strain", "displacement_1"} <= {*test.turned} or way > 0
        assert test.interior[1].max() == pytest.approx(1.6e-3, rel=0.02)
        assert not any(note.startswith("Check: the displacement is used") for note in test.notes)


# ---------------------------------------------------------------------- what is refused


@pytest.mark.parametrize("offset", [0.0, 300.0])
def test_what_stays_ambiguous_is_refused_with_both_remedies(tmp_path: Path, offset: float) -> None:
    """Tension and compression, or a force that falls from a large value."""
    t = np.linspace(0.0, 10.0, 401)
    w = 4.0 * np.sin(2.0 * np.pi * t / 10.0)
    w = np.abs(w) if offset else w
    given = {"time_s": t, "force_N": offset - 50.0 * w, "displacement_mm": w}
    path = written(tmp_path, **given)
    remedies = (
        'force = { column = "force_N", scale = -1 }',
        'displacement = { column = "displacement_mm", counts_down = true }',
    )
    refused(path, "does not show which of them is negative", *remedies)
    for remedy in remedies:
        path.with_suffix(".toml").write_text(f"{SPECIMEN}[columns]\n{remedy}\n")
        if not offset and "scale" in remedy:
            test = read_test(path)
            assert (test.turned, test.stress.max()) == ((), pytest.approx(2e6, rel=1e-3))
        elif not offset or "scale" in remedy:  # tension comes first, or a force without a zero
            refused(path, "the stress is never positive in the part that is used")


def test_a_force_that_is_never_positive_is_refused(tmp_path: Path) -> None:
    """It falls throughout, while the motion goes there and back."""
    t = np.linspace(0.0, 10.0, 61)
    columns = {"time_s": t, "force_N": -3.0 * t, "displacement_mm": 10 - 4 * np.sin(np.pi * t / 10)}
    path = written(tmp_path, SPECIMEN + STRIKER, **columns)
    refused(path, "the stress is never positive in the part that is used, only −300 kPa to 0 Pa")


def test_every_output_says_what_was_reversed(tmp_path: Path) -> None:
    w = path_through([0, 5, 0])
    path = written(
        tmp_path, time_s=0.01 * np.arange(len(w)), force_N=-foam(w), Gap_um=9e3 - 1e3 * w
    )
    told = " ".join(run("check", str(path)).stdout.split())
    notes = (
        "The force 'force_N' is negative in compression; its sign is reversed.",
        "The displacement 'Gap_um' counts down in compression; its sign is reversed.",
    )
    result = fabricated.result(measurement=read_test(path))
    in_json = json.dumps(result.to_json_dict()["data"]["notes"])
    for note in notes:
        assert note in told
        assert note in in_json
    line = "sign reversed (negative in compression): force, displacement\n"
    assert line in summary_text(result)


@needs_data
@pytest.mark.parametrize(
    ("name", "size", "turned"),
    [
        ("shoe-foam/turbo-comp-1_raw.txt", (10.53, 7.63), ("displacement",)),
        ("shoe-foam-twins/worn-heel-comp-1_raw.txt", (10.0, 7.6), ("displacement",)),
        ("mycelium-rates/outplane-2s-1_raw.txt", (10.98, 8.0), ("displacement",)),
        ("mycelium-rates/outplane-80s-3_raw.txt", (8.72, 8.0), ("displacement",)),
        ("lattice-cycles/tpu87-20_raw.csv", (12.0, 20.0), ("force", "displacement")),
        ("shoe-foam/leap-comp-2_cycle1.csv", (10.65, 7.62), ()),
        ("aluminium-foam/stress_strain_rate.csv", (15.0, 30.0), ()),
    ],
)
def test_measured_records_need_no_entry_for_their_sign(
    tmp_path: Path, name: str, size: tuple[float, float], turned: tuple[str, ...]
) -> None:
    test = read_test(DATA / name, specimen_toml(tmp_path, *size))
    assert test.turned == turned
    strain, peak = test.displacement / test.specimen.height, test.stress.max()
    assert 0.4 < strain.max() < 0.8
    assert test.stress.min() > -0.1 * peak
    up = strain[: np.argmax(strain) + 1] > 0.5 * strain.max()
    assert (test.stress[: up.size][up] > 0.1 * peak).all()
