"""Contradictions between velocity, mass, force and motion, in records of a simulated rig."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rig
from conftest import DATA, needs_data, run
from foamfit.data.calibration import balance, contradictions
from foamfit.data.csv_file import read_test

RIGHT = {
    "any zero": rig.Impact(),
    "much noise": rig.Impact(noise=0.02),
    "little noise": rig.Impact(noise=5e-4),
    "correlated noise": rig.Impact(tau=8.0),
    "trimmed at contact": rig.Impact(trimmed=True),
    "150 samples": rig.Impact(samples=150),
    "gauge on the specimen": rig.Impact(gauge=True),
    "gravity not stated": rig.Impact(gravity=True, said=False),
    "velocity with a ±": rig.Impact(velocity_sd=0.01),
    "microscale with relaxation": rig.Impact(law="microscale", relaxation=1),
    "acceleration and motion": rig.Impact(channels=("acceleration", "displacement")),
    "force and acceleration": rig.Impact(channels=("force", "acceleration")),
}


def quantities(path: Path) -> list[str]:
    return [one.quantity for one in contradictions(read_test(path))]


def times(record: rig.Record, channel: str, factor: float) -> rig.Record:
    """Return the record with a channel in a wrong scale."""
    return replace(record, channels=record.channels | {channel: factor * record.channels[channel]})


def with_line(path: Path, table: str, line: str) -> None:
    """Put a line into a table of the TOML, instead of the line with the same key."""
    toml = path.with_suffix(".toml")
    lines = toml.read_text(encoding="utf-8").splitlines()
    lines = [one for one in lines if one.split(" =")[0] != line.split(" =")[0]]
    if f"[{table}]" not in lines:
        lines.append(f"[{table}]")
    lines.insert(lines.index(f"[{table}]") + 1, line)
    toml.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.mark.parametrize("kind", RIGHT)
def test_a_right_record_is_not_contradictory(kind: str, tmp_path: Path) -> None:
    for seed in range(1, 4):
        path = rig.write(rig.impact(RIGHT[kind], seed), tmp_path)
        assert quantities(path) == [], seed


def with_damper(seed: int) -> tuple[rig.Record, float]:
    """Return the record of an impact with an onsite damper at the striker, and its η (Pa s)."""
    undamped = rig.impact(rig.Impact(), seed).course
    peak = float(undamped.stress(np.linspace(0.0, undamped.end, 500)).max())
    eta = 0.3 * peak * undamped.rig.height / undamped.rig.velocity

    damped = replace(undamped.rig, site_damping=eta)
    course = damped.run(0.0, 100.0 * damped.height / damped.velocity)
    return rig.recorded(rig.Impact(), course, seed), eta


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_onsite_damper_of_the_striker_is_no_contradiction(seed: int, tmp_path: Path) -> None:
    """Its force is not in the sensor at the base. A wrong velocity or mass is still found."""
    record, eta = with_damper(seed)
    path = rig.write(record, tmp_path)
    found = balance(read_test(path)).damping
    assert quantities(path) == []
    assert found is not None
    assert abs(found[0] - eta) < 4.0 * found[1] < 0.5 * eta
    text = path.with_suffix(".toml").read_text(encoding="utf-8")
    for entry, factor in (("velocity", 0.8), ("mass", 1.3)):
        line = next(one for one in text.splitlines() if one.startswith(entry))
        value = float(line.split('"')[1].split()[0])
        wrong = line.replace(line.split('"')[1].split()[0], str(factor * value))
        path.with_suffix(".toml").write_text(text.replace(line, wrong), encoding="utf-8")
        assert quantities(path)


@pytest.mark.parametrize("kind", ["any zero", "trimmed at contact", "gauge on the specimen"])
@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"velocity": 0.9}, "velocity"),
        ({"velocity": 1.06}, "velocity"),
        ({"force": 0.85}, "force_scale"),
        ({"mass": 1.15}, "force_scale"),
        ({"displacement": 1.1}, "motion_scale"),
    ],
)
def test_what_is_wrong_is_found_and_settled_by_the_printed_line(
    kind: str, wrong: dict[str, float], found: str, tmp_path: Path
) -> None:
    for seed in (1, 2):
        record = rig.impact(RIGHT[kind], seed)
        for name, factor in wrong.items():
            if name == "velocity":
                stated = f"{factor * record.rig.velocity:.8g} m/s"
                record = replace(record, toml_velocity=stated)
            elif name == "mass":
                other = replace(record.rig, mass=factor * record.rig.mass)
                record = replace(record, rig=other)
            else:
                record = times(record, name, factor)
        path = rig.write(record, tmp_path)
        (one,) = contradictions(read_test(path))
        assert one.quantity == found
        ((name, factor),) = wrong.items()
        right = factor if name == "mass" else 1 / factor
        assert one.ratio == pytest.approx(right, rel=0.03)
        kept = path.with_suffix(".toml").read_text()
        for table, line in one.lines:
            with_line(path, table, line)
            assert quantities(path) == [], line
            path.with_suffix(".toml").write_text(kept)


@pytest.mark.parametrize(
    "entry",
    [
        'force = { column = "Load", unit = "V", scale = "200 N/V" }',
        'force = { column = "Load", unit = "mV", scale = "5 mV/N" }',
        'force = { column = "Load", unit = "kN", scale = 0.8 }',
    ],
)
def test_the_printed_line_keeps_column_and_unit_of_the_force(entry: str, tmp_path: Path) -> None:
    path = rig.write(times(rig.impact(rig.Impact(), 4), "force", 0.8), tmp_path)
    head, *rows = path.read_text().splitlines()
    unit = {"200": 200.0, "5 m": 0.2, "0.8": 800.0}[entry.split("scale = ")[1].strip('"')[:3]]
    values = [row.split(",") for row in rows]
    lines = [",".join([t, f"{float(force) / unit:.9g}", w]) for t, force, w in values]
    header = head.replace("force (N)", "Load")
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    with_line(path, "columns", entry)
    (one,) = contradictions(read_test(path))
    (table, line), _ = one.lines
    assert line.split("scale")[0] == entry.split("scale")[0]
    with_line(path, table, line)
    assert quantities(path) == []


@pytest.mark.parametrize("share", [0.05, -0.03])
def test_a_linear_drift_of_the_force_is_taken_off(share: float, tmp_path: Path) -> None:
    for seed in (1, 2):
        record = rig.impact(rig.Impact(before=0.4), seed)
        force, lasts = record.channels["force"], record.course.end
        drift = share * np.ptp(force) * (record.time - record.time[0]) / lasts
        drifting = replace(record, channels=record.channels | {"force": force + drift})
        still, straight = (read_test(rig.write(one, tmp_path)) for one in (record, drifting))
        assert any("this line is taken off" in note for note in straight.notes)
        assert not any("this line is taken off" in note for note in still.notes)
        assert contradictions(straight) == ()
        at = np.interp(straight.time, still.time, still.stress)
        off = np.abs(np.mean(straight.stress - at))
        assert off < 0.1 * abs(share) * np.ptp(still.stress)


def test_check_says_what_contradicts_and_the_line_that_settles_it(tmp_path: Path) -> None:
    record = rig.impact(rig.Impact(before=0.4), 1)
    right = record.rig.velocity
    path = rig.write(replace(record, toml_velocity=f"{0.9 * right:.8g} m/s"), tmp_path)
    out = run("check", str(path))
    told = " ".join(out.output.split())
    assert f"the velocity is given as {0.9 * right:.4g} m/s, the striker moves at" in told
    assert "before contact" in told
    (line,) = (one for one in out.output.splitlines() if one.startswith("settle"))
    assert line.split("[striker] ")[1] == contradictions(read_test(path))[0].lines[0][1]


REAL = {
    "cartilage-impact/test_1_impact.csv": (
        '[specimen]\nheight = "0.563 mm"\ndiameter = "8.5 mm"\n'
        '[striker]\nmass = "358.39 g"\nvelocity = "0.9 m/s"\n',
        ['velocity = "0.788 m/s"', 'stress = { column = "stress_Pa", scale = 1.30 }'],
    ),
    "lattice-impact/Hex_Diamond_contact.csv": (
        '[specimen]\nheight = "20 mm"\narea = "400 mm^2"\n'
        '[striker]\nmass = "1 kg"\nvelocity = "1.0 m/s"\n'
        '[columns]\nforce = { column = "specific_force_N_per_kg", unit = "N" }\n',
        ['velocity = "1.16 m/s"'],
    ),
}


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_measured_records_show_their_own_numbers(name: str, tmp_path: Path) -> None:
    toml, lines = tmp_path / "test.toml", REAL[name][1]
    toml.write_text(REAL[name][0])
    found = contradictions(read_test(DATA / name, toml))
    assert [one.lines[0][1] for one in found] == lines
