"""Each step from raw samples to one loading and unloading, on pulses with known values."""

from dataclasses import replace

import numpy as np
import pytest

from foamfit.data.blocks import thin, without_holds
from foamfit.data.energy import audit
from foamfit.data.measurement import Record, Specimen, Striker, Window
from foamfit.data.outliers import fill_staircase
from foamfit.data.prepare import condition
from foamfit.errors import InputError

SPECIMEN = Specimen(height=1.19e-3, area=1.9635e-5, mass=5.56e-6)
STRIKER = Striker(mass=7e-3, velocity=1.75)
DURATION = 7e-4
PEAK = 1.9 * 7e-3 * 1.75 * np.pi / 2 / DURATION / 1.9635e-5  # impulse of 1.9 momenta


def pulse(t):
    """Return stress, displacement and velocity of a half-sine pulse; contact starts at t = 0."""
    omega = np.pi / DURATION
    inside = np.clip(t, 0, DURATION)
    stress = np.where((t > 0) & (t < DURATION), PEAK * np.sin(omega * inside), 0.0)
    a = PEAK * SPECIMEN.area / STRIKER.mass
    v = STRIKER.velocity - a / omega * (1 - np.cos(omega * inside))
    w = STRIKER.velocity * inside - a / omega * (inside - np.sin(omega * inside) / omega)
    w = w + np.where(t < 0, STRIKER.velocity * t, 0) + v * np.maximum(t - DURATION, 0)
    return stress, w, v


def impact(n=600, before=0.0, after=0.0, noise=0.0, offset=0.0, origin=0.0, w="measured"):
    """Return a record of a pulse; `before` and `after` are fractions of the contact duration."""
    step = DURATION / n
    t = np.arange(-round(before * n), round((1 + after) * n) + 1) * step
    if before:
        t = t + 0.37 * step  # contact starts between two samples
    stress, displacement, _ = pulse(t)
    random = np.random.default_rng(0)
    stress = stress + PEAK * (offset + noise * random.normal(size=t.size))
    displacement = displacement + 4e-4 * noise * random.normal(size=t.size)
    if w == "at rest before contact":
        displacement = np.where(t < 0, 0.0, displacement)
    elif w == "from another zero":
        displacement = displacement + 2e-3
    return Record(t + origin, stress, None if w == "missing" else displacement)


def run(record, **window):
    return condition(record, SPECIMEN, striker=STRIKER, window=Window(**window))


def error_of_motion(conditioned):
    """Return the RMS error of measured displacements in contact, relative to the peak."""
    truth = pulse(conditioned.time)[1]
    inside = (conditioned.time <= DURATION) & conditioned.sampled.get("displacement", True)
    return np.sqrt(np.mean((conditioned.displacement - truth)[inside] ** 2)) / truth.max()


@pytest.mark.parametrize("missing", [3, 30])
@pytest.mark.parametrize("origin", [0.0, -4.0, 1.7e3])
def test_the_rise_is_extrapolated_back_where_the_first_samples_are_missing(missing, origin):
    record = impact(noise=0.003, origin=origin).rows(slice(missing, None))
    done = run(record)
    assert done.origins["contact_time"] == pytest.approx(origin, abs=3.1 * DURATION / 600)
    assert len(done.stress) == len(record)
    assert done.zeros == {}
    assert any("Contact starts before the first sample" in note for note in done.notes)


def test_a_low_stress_before_and_after_a_sharp_peak_is_contact():
    """On branches a and e, most of the contact, the stress may be only a few times the noise."""
    n = 1000
    s = np.linspace(0, 1.25, n)
    stress = np.where(s < 0.5, np.exp(-(((s - 0.5) / 0.08) ** 2)), 0.0)
    stress = np.maximum(stress, np.where(s < 0.5, 0.08 * s, 0.0))
    stress = np.where(
        (s >= 0.5) & (s < 1), np.maximum(0.06 * (1 - s), 1 - (s - 0.5) / 0.02), stress
    )
    w = 4e-4 * np.sin(np.pi * np.minimum(s, 1))
    random = np.random.default_rng(0)
    for _ in range(5):
        noisy = PEAK * (stress + 0.01 * random.normal(size=n))
        done = run(Record(s * DURATION, noisy, w + 4e-6 * random.normal(size=n)))
        assert done.contact == "file"
        assert done.time[0] == 0.0
        assert done.time[-1] > 0.8 * DURATION
        assert done.time[-1] < 1.1 * DURATION


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_contact_ends_before_a_second_bounce(noise):
    t = np.arange(0, 4000) * DURATION / 1000
    stress, w, _ = pulse(t)
    second = 0.4 * pulse(t - 2 * DURATION)[0]
    random = np.random.default_rng(0)
    record = Record(t, stress + second + noise * PEAK * random.normal(size=t.size), w)
    end = run(record).time[-1]
    assert end == pytest.approx(DURATION, rel=0.04)


@pytest.mark.parametrize("source", ["force", "velocity", "acceleration"])
@pytest.mark.parametrize("before", [0.0, 0.4])
def test_motion_is_integrated_where_it_is_missing(source, before):
    record = impact(before=before, after=0.2 if before else 0.0, w="missing")
    stress, _, velocity = pulse(record.time)
    known = {"velocity": velocity, "acceleration": stress * SPECIMEN.area / STRIKER.mass}
    conditioned = run(replace(record, **{name: known[name] for name in known if name == source}))
    assert conditioned.motion == f"integrated from {source}"
    assert any(conditioned.motion in note for note in conditioned.notes)
    assert error_of_motion(conditioned) < (5e-3 if before else 1e-5)


def test_a_staircase_becomes_its_ramp():
    t = np.arange(1000) * 1e-3
    w = 1e-4 * np.sin(np.pi * t)
    held = w[np.arange(1000) // 5 * 5]
    filled, _ = fill_staircase(Record(t, w, held))
    assert np.abs(filled.displacement - w)[:-5].max() < 0.02 * np.abs(held - w).max()
    assert "5 samples" in filled.notes[0]
    assert np.flatnonzero(filled.sampled["displacement"]).tolist() == list(range(0, 1000, 5))
    coarse = Record(t, w, np.round(w / 1e-6) * 1e-6)  # by a digitiser, several rows to a step
    assert fill_staircase(coarse)[0].displacement is coarse.displacement


def followed(record, share=0.4, zero=3e-3, noise=0.0):
    """Add a mass inside that rests at `zero`, then moves by a fraction `share` of the top."""
    moved = np.where(record.time < 0, 0.0, pulse(np.maximum(record.time, 0.0))[1])
    random = np.random.default_rng(1)
    inside = zero + share * moved + noise * share * moved.max() * random.normal(size=moved.size)
    return replace(record, interior={1: inside})


@pytest.mark.parametrize(
    ("before", "n", "noise"), [(0.4, 600, 0.01), (0.4, 5000, 0.0), (0.0, 600, 0.0)]
)
def test_a_mass_inside_goes_through_the_same_steps(before, n, noise):
    conditioned = run(followed(impact(n, before=before, after=0.3), noise=noise))
    assert conditioned.interior[1].shape == conditioned.time.shape
    truth = 0.4 * pulse(np.minimum(conditioned.time, DURATION))[1]
    inside = (conditioned.time >= 0) & (conditioned.time <= DURATION)
    away = np.abs(np.mean(conditioned.interior[1] - truth, where=inside)) / truth.max()
    assert away < 2e-3  # its offset of 3 mm in the file is subtracted
    assert any("displacement_1 at contact, 3 mm, is taken off" in n for n in conditioned.notes)


def test_a_mass_inside_that_starts_slowly_keeps_the_zero_of_the_file():
    record = followed(impact(before=0.0), zero=0.0)
    slow = record.interior[1] * (record.interior[1] / record.interior[1].max()) ** 0.3
    conditioned = run(replace(record, interior={1: slow}))
    assert "displacement_1" not in " ".join(conditioned.notes)
    assert conditioned.interior[1].max() == pytest.approx(slow.max(), rel=1e-6)


def test_a_mass_inside_that_overtakes_the_top_is_noted():
    notes = run(followed(impact(), share=1.2, zero=0.0)).notes
    assert any(note.startswith("Check: displacement_1 goes farther") for note in notes)


def test_a_mass_inside_that_rests_within_the_window_is_refused():
    still = replace(impact(), interior={1: np.r_[np.zeros(590), np.ones(11)]})
    with pytest.raises(InputError, match="displacement_1 is constant within"):
        run(still, end=580 * DURATION / 600)


def cycles(n=3, hold=50):
    """Return trapezoids of 1 mm with holds at both ends, after a rest; stress ∝ displacement."""
    corners = np.cumsum([60, *(n * [200, hold, 200, hold])])
    heights = [0, *(n * [1e-3, 1e-3, 2e-5, 2e-5])]
    w = np.interp(np.arange(corners[-1]), corners, heights)
    t = np.arange(w.size) * 0.01
    return Record(t, 1e9 * w, w - 5e-3)


def test_cycles_are_told_from_each_other_however_far_the_machine_came_from():
    """Cycles of 1 mm that unload to 0.3 mm are counted after an approach of 8 mm."""
    w = np.interp(np.arange(1000), [0, 400, 500, 600, 700, 800, 900, 999],
                  [-8e-3, 0, 1e-3, 3e-4, 1e-3, 3e-4, 1e-3, 0])  # fmt: skip
    record = Record(np.arange(1000) * 0.01, np.maximum(1e9 * w, 0.0), w)
    assert condition(record, SPECIMEN, window=Window(cycle=2)).cycles == (1, 2, 3)


def preconditioned(set_strain, offset=0.0, noise=0.0, n=4, lowest=0.0):
    """Return triangles of 1 mm on a foam of 10 mm with a permanent set, with a slope of 1 MPa/mm.

    `set_strain` is the permanent set of each cycle, below which the stress is zero.
    """
    corners = [0.0, *(level for _ in range(n) for level in (1e-3, lowest))]
    w = np.interp(np.arange(200 * (len(corners) - 1) + 1) / 200, np.arange(len(corners)), corners)
    number = np.maximum(np.arange(w.size) - 1, 0) // 400
    gone = 1e-2 * np.asarray(set_strain)[number]
    stress = 1e9 * np.maximum(w - gone, 0.0) + offset
    stress += noise * np.random.default_rng(0).standard_normal(w.size)
    return Record(0.01 * np.arange(w.size), stress, w - 5e-3)


SPECIMEN_10 = Specimen(1e-2, 1e-4)


@pytest.mark.parametrize("noise", [0.0, 5e3])
@pytest.mark.parametrize("cycle", [2, 3, 4])
def test_a_later_cycle_starts_at_its_own_contact(cycle, noise):
    sets = [0.0, 0.01, 0.015, 0.02]
    test = condition(preconditioned(sets, noise=noise), SPECIMEN_10, window=Window(cycle=cycle))
    gone = sets[cycle - 1]
    assert test.start_strain == pytest.approx(gone, abs=1.5e-3)  # contact is at 1 % of the peak
    # time, displacement and stress are zero at contact, and the end without contact is cut
    assert abs(test.time[0]) <= 0.011
    assert abs(test.displacement[0]) < 1.1e-5
    assert test.stress[0] < 0.04 * test.stress.max()
    assert test.displacement.max() == pytest.approx(1e-3 - 1e-2 * gone, rel=0.02)
    assert test.displacement[-1] < 2e-5
    assert test.displacement.min() > -2e-5
    assert test.rows.rows == test.rows.used + sum(item.rows for item in test.rows.dropped)
    whys = {item.why for item in test.rows.dropped}
    assert {"before contact starts", "after contact ends"} <= whys
    (told,) = [note for note in test.notes if "start strain" in note]
    assert f"Contact of cycle {cycle} starts" in told


def test_a_stress_below_zero_between_the_cycles_is_the_offset_of_the_sensor():
    record = preconditioned([0.0, 0.01, 0.01, 0.01], offset=-2e4)
    first = condition(record, SPECIMEN_10)
    later = condition(record, SPECIMEN_10, window=Window(cycle=2))
    assert first.stress.max() - later.stress.max() == pytest.approx(1e5 - 2e4 - 0.0, rel=0.3)
    assert later.stress.min() > -1.0
    assert any("−20 kPa, is taken off as the sensor's offset" in note for note in later.notes)


def test_a_specimen_that_stays_under_load_between_the_cycles_is_told():
    record = preconditioned([0.0] * 4, lowest=1e-4)  # a tenth of the peak displacement
    later = condition(record, SPECIMEN_10, window=Window(cycle=2))
    assert any("stays under load between the cycles" in note for note in later.notes)
    assert later.stress.max() == pytest.approx(1e6)


def test_a_cycle_that_is_not_there_is_refused():
    with pytest.raises(InputError, match="cycle 4 cannot be taken: the file has cycles 1 to 3;"):
        condition(cycles(), SPECIMEN, window=Window(cycle=4))
    with pytest.raises(InputError, match="slow tests"):
        run(impact(), cycle=2)


def test_the_window_is_by_the_clock_of_the_file():
    record = impact(before=1.0, after=1.0, origin=5e-3)
    conditioned = run(record, start=4.8e-3, end=5.9e-3)
    assert any("[window] cut" in note for note in conditioned.notes)
    assert error_of_motion(conditioned) < 0.01
    with pytest.raises(InputError, match="constant within"):
        condition(cycles(), SPECIMEN, window=Window(end=0.4))
    with pytest.raises(InputError, match="need a time"):
        condition(Record(None, record.stress, record.displacement), SPECIMEN, window=Window(0.0))


@pytest.mark.parametrize("n", [1501, 2000, 54321])
def test_thinning_keeps_the_peak_and_lowers_the_noise(n):
    t = np.linspace(0, DURATION, n)
    stress, w, _ = pulse(t)
    thinned = thin(*without_holds(Record(t, stress, w)))
    assert len(thinned) <= 1000
    assert thinned.stress.max() == pytest.approx(PEAK, rel=1e-3)
    assert thinned.displacement.max() == pytest.approx(w.max(), rel=1e-3)
    assert np.interp(3e-4, thinned.time, thinned.stress) == pytest.approx(
        float(pulse(np.array(3e-4))[0]), rel=1e-3
    )
    assert str(n) in thinned.notes[0]


@pytest.mark.parametrize(
    ("specimen", "striker", "words"),
    [
        (SPECIMEN, Striker(7e-3, 2.2), "velocity is given as 2.2"),
        (Specimen(1.19e-3, 1.9635e-5, mass=5.56e-3), STRIKER, "density"),
    ],
)
def test_what_smells_wrong_is_noted(specimen, striker, words):
    done = condition(impact(), specimen, striker=striker)
    told = (*done.notes, *audit(done).warnings())
    assert any(note.startswith("Check:") and words in note for note in told)
    assert not any(note.startswith("Check:") for note in run(impact()).notes)


@pytest.mark.parametrize("striker", [None, STRIKER])
@pytest.mark.parametrize("spikes", [[0], [-1], [90], [40, 120]])
@pytest.mark.parametrize("channel", ["stress", "displacement"])
def test_a_channel_that_is_constant_but_for_single_rows_is_refused(channel, spikes, striker):
    loop = np.sin(np.linspace(0.0, np.pi, 200))
    flat = np.full(200, 0.5) + 1e-16 * loop
    flat[spikes] = 0.9
    scaled = {"stress": 1e6 * loop, "displacement": 4e-4 * loop}
    scaled[channel] *= flat / loop.clip(1e-9)
    record = Record(np.linspace(0.0, 1e-3, 200), **scaled)
    with pytest.raises(InputError, match=f"the {channel} is constant but for single rows"):
        condition(record, SPECIMEN, striker=striker)


def test_a_tiny_impact_is_refused():
    """Seven rows have no tail of eight, from which a zero was to be taken."""
    with pytest.raises(InputError, match="at least 10 needed"):
        run(impact(n=6))


def test_a_gauge_that_moves_only_after_contact_is_refused():
    record = impact(before=0.5, after=1.0)
    dead = np.where(record.time < 1.5 * DURATION, 0.0, record.displacement)
    with pytest.raises(InputError, match="the displacement does not vary in the part that is used"):
        run(replace(record, displacement=dead))


@pytest.mark.parametrize(("offset", "told"), [(-0.2, "starts below zero, at −1"), (0.2, "17 %")])
def test_a_slow_record_that_starts_with_a_stress_is_doubted(offset, told):
    """A zero of the force that was never set moved all stresses, and nothing was said."""
    loop = np.sin(np.linspace(0.0, np.pi, 200))
    done = condition(Record(None, 1e5 * (loop + offset), 4e-4 * loop), SPECIMEN)
    (note,) = (one for one in done.notes if one.startswith("Check:"))
    assert told in note


def test_an_impact_that_is_mostly_at_its_largest_stress_is_one_contact():
    """Its median was taken for the unloaded level, so that no contact was left."""
    record = impact()
    clipped = np.minimum(record.stress, np.quantile(record.stress, 0.4))
    assert run(replace(record, stress=clipped)).stress.max() == pytest.approx(clipped.max())
