"""A gauge that sticks and then jumps is detected and bridged, without false detections."""

import numpy as np
import pytest

import records
from conftest import DATA, needs_data, write_csv
from foamfit.data.csv_file import read_test
from foamfit.data.measurement import Record, Specimen
from foamfit.data.prepare import condition

HEIGHT = 10.0  # mm
SPECIMEN = f'[specimen]\nheight = "{HEIGHT} mm"\narea = "100 mm^2"\n'
STEP, TAU = 0.004, 0.5  # s
TOP = 6.0  # mm


def motion(*ramps):
    """Return displacement (mm) at equal time steps; a ramp is its end and number of samples."""
    out = [0.0]
    for to, samples in ramps:
        out += list(np.linspace(out[-1], to, samples + 1)[1:])
    return np.array(out)


def relaxing_stress(w):
    """Return stress (kPa) of a stiffening spring with friction and a Maxwell element.

    The formulas are independent of the package.
    """
    elastic = 20.0 * w + 3.0 * np.maximum(w - 3.0, 0.0) ** 2
    friction, maxwell = np.zeros_like(w), np.zeros_like(w)
    for i in range(1, w.size):
        dw = w[i] - w[i - 1]
        friction[i] = np.clip(friction[i - 1] + 60.0 * dw, -15.0, 15.0)
        maxwell[i] = np.exp(-STEP / TAU) * (maxwell[i - 1] + 15.0 * dw)
    return elastic + (friction + maxwell) * np.minimum(np.maximum(w, 0.0), 1.0)


def held(w, samples):
    """Return the displacement of a gauge that is updated only once every `samples` samples."""
    return w[np.arange(w.size) // samples * samples]


def recorded(folder, shown, stress, *, noise=(0.0, 0.0), timed=True, seed=0):
    """Write and read a test; `noise` is a fraction of the range of displacement and stress."""
    rng = np.random.default_rng(seed)
    shown = shown + noise[0] * TOP * rng.standard_normal(shown.size)
    stress = stress + noise[1] * np.ptp(stress) * rng.standard_normal(shown.size)
    columns = {"displacement (mm)": shown, "stress (kPa)": stress}
    if timed:
        columns = {"time (s)": STEP * np.arange(shown.size)} | columns
    path, head = folder / "test.csv", ",".join(columns)
    return read_test(write_csv(path, head, *columns.values(), toml=SPECIMEN))


def conditioned(shown, stress, noise):
    """Return the test without writing a file, with noise on the stress."""
    noisy = stress + noise * np.ptp(stress) * np.random.default_rng(0).standard_normal(stress.size)
    record = Record(STEP * np.arange(shown.size), 1e3 * noisy, 1e-3 * shown)
    return condition(record, Specimen(height=1e-3 * HEIGHT, area=1e-4))


def notes(test):
    return [note for note in test.notes if "stands still" in note]


# Unloading has another number of samples: equal displacements would suggest a digitised signal.
CYCLE = ((TOP, 600), (0.0, 613))
SLOW_TOP = ((TOP, 600), (TOP, 60), (0.0, 613))  # a short rest at the top


def stuck(w, first, last):
    """Return the displacement of a gauge that sticks from sample `first` to sample `last`."""
    return np.concatenate((w[:first], np.full(last - first, w[first]), w[last:]))


@pytest.mark.parametrize("timed", [True, False], ids=["time", "no time"])
@pytest.mark.parametrize(
    ("ramps", "first", "last", "every"),
    [
        (SLOW_TOP, 594, 650, 1),  # sticks just before the top and while the machine rests there
        (SLOW_TOP, 594, 645, 5),  # the same, updated every fifth sample
        (CYCLE, 600, 640, 1),  # backlash: sticks at the top while the machine unloads
        (((TOP, 500), (3.0, 250), (TOP, 250), (0.0, 450)), 750, 790, 1),  # sticks in an inner loop
    ],
)
@pytest.mark.parametrize("noise", [(0.0, 0.0), (0.0002, 0.002)])
def test_a_gauge_that_stands_still_and_jumps_is_bridged(
    tmp_path, ramps, first, last, every, timed, noise
):
    w = motion(*ramps)
    # The gauge sticks at its last updated value.
    at = first // every * every
    shown = stuck(held(w, every), at, last)
    test = recorded(tmp_path, shown, relaxing_stress(w), noise=noise, timed=timed)
    (note,) = notes(test)
    jump = abs(shown[last] - shown[last - 1]) / HEIGHT
    told = [float(part.split(" %")[0].split()[-1]) for part in note.split("jumps by")[1:]]
    assert told == pytest.approx([100.0 * jump], rel=0.1, abs=0.05)
    (dropped,) = (item for item in test.rows.dropped if "stands still" in item.why)
    # Line 1 is the header, sample 0 is line 2.
    assert abs(dropped.first - (at + 3)) <= (2 if noise[0] == 0.0 else 25)
    assert abs(dropped.last - (last + 1)) <= 1
    assert f"rows {dropped.first} to {dropped.last} " in note
    assert test.rows.rows == test.rows.used + sum(item.rows for item in test.rows.dropped)
    # A straight line bridges the standstill and the jump.
    ((start, end),) = test.standstills
    instants = np.arange(test.stress.size) if test.time is None else test.time
    bridged = (instants >= start) & (instants <= end)
    assert bridged.sum() == dropped.rows
    assert np.abs(np.diff(test.displacement[bridged], 2)).max() < 1e-9
    at_ends = np.flatnonzero(bridged)[[0, -1]] + [-1, 1]
    line = np.interp(instants[bridged], instants[at_ends], test.displacement[at_ends])
    np.testing.assert_allclose(test.displacement[bridged], line, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(test.outliers["displacement"].left_out, bridged)


def test_only_the_stretches_of_the_cycle_that_is_used_are_named(tmp_path):
    one = motion(*CYCLE)
    w = np.concatenate((one, one[1:]))
    second = one.size - 1
    shown = stuck(w, second + 600, second + 640)
    path = recorded(tmp_path, shown, relaxing_stress(w)).path
    assert not notes(read_test(path))
    path.with_suffix(".toml").write_text(SPECIMEN + "[window]\ncycle = 2\n")
    (note,) = notes(read_test(path))
    assert f"rows {second + 603} to {second + 641} " in note


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("digit", [0.0, 0.3])  # mm
@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize(
    "ramps",
    [
        CYCLE,
        ((TOP, 600), (TOP, 250), (0.0, 613)),  # a hold of 1 s
        ((TOP, 600), (TOP, 2500), (0.0, 600)),  # a hold of 10 s
        ((3.0, 300), (3.0, 250), (TOP, 300), (3.0, 300), (3.0, 250), (0.0, 300)),  # two holds
        ((2.0, 4), (2.0, 300), (4.0, 4), (4.0, 300), (TOP, 4), (TOP, 300), (0.0, 600)),  # steps
        ((0.0, 400), (TOP, 600), (0.0, 600), (0.0, 400)),  # rests around contact
        ((TOP, 30), (TOP, 20), (0.0, 30)),  # few samples
    ],
    ids=["turn", "1 s", "10 s", "twice", "steps", "dwell", "few"],
)
def test_a_true_hold_is_no_standstill(ramps, every, digit, noise):
    w = motion(*ramps)
    stress = relaxing_stress(w)
    shown = held(w + noise * TOP * np.random.default_rng(5).standard_normal(w.size), every)
    shown = np.round(shown / digit) * digit if digit else shown
    assert not notes(conditioned(shown, stress, noise))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_gauge_that_slips_after_a_hold_at_constant_stress_has_not_stood_still(noise):
    """A sticking gauge hides a motion that changes the stress; here the motion did rest."""
    true = motion((4.0, 300), (4.0, 60), (TOP, 150), (0.0, 450))
    shown = true + np.where(np.arange(true.size) > 360, 0.3, 0.0)
    assert notes(conditioned(shown, 20.0 * true, noise)) == []


@needs_data
def test_the_gauge_of_the_shoe_foams_stands_still_at_the_top(tmp_path):
    """In ten tests (arXiv:2602.12694) 34 to 76 samples stand still before a jump of 0.4 to 1 %."""
    for name in records.HEELS[::3]:
        test = read_test(records.place(name, tmp_path, DATA))
        (note,) = notes(test)
        ((start, end),) = test.standstills
        (dropped,) = (item for item in test.rows.dropped if "stands still" in item.why)
        assert 30 <= dropped.rows <= 80
        top = test.time[np.argmax(test.displacement)]
        assert start < top <= end + 0.15
        assert "falls by" in note
