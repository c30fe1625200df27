"""The start of an impact and the zeros found before it, for synthetic pulses in closed form."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import foamfit as ff
import rig
from conftest import write_csv
from foamfit.data.contact import first_contact, rise_of
from foamfit.data.csv_file import read_test
from foamfit.data.cycles import loading_rate
from foamfit.data.energy import audit
from foamfit.data.measurement import NoiseLevel, Record, Specimen, Striker
from foamfit.data.noise import estimated_noise
from foamfit.data.prepare import condition
from foamfit.data.zeros import tail_level
from foamfit.errors import InputError
from foamfit.fitting.problem import make_params
from foamfit.springs.published import published

HEIGHT, AREA, MASS, VELOCITY = 10e-3, 1e-4, 0.5, 2.0
DURATION = 4e-3
OMEGA = np.pi / DURATION
BRAKED = 0.95 * VELOCITY * OMEGA  # peak, m/s²; the impulse is 1.9 times the initial momentum
PEAK = BRAKED * MASS / AREA
SPECIMEN, STRIKER = Specimen(HEIGHT, AREA), Striker(MASS, VELOCITY)


def noise(rng, n, tau):
    """Return noise of unit variance with an autocorrelation time of `tau` samples."""
    rho = (tau - 1) / (tau + 1)
    return lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], rng.standard_normal(n + 400))[400:]


def record(
    channels="FW", n=500, before=200, phase=0.37, level=0.003, tau=1, gauge="flight", seed=0,
    clock=0.0, zeros=(0.0, 0.0, 0.0), after=0.3, gravity=0.0,
):  # fmt: skip
    """Return a half-sine pulse of `n` samples with contact at time `clock`.

    `zeros` are offsets of stress, displacement and acceleration as fractions of their peaks.
    """
    rng = np.random.default_rng(seed)
    step = DURATION / n
    t = (np.arange(-before, int(n * (1 + after))) + phase) * step
    inside = np.clip(t, 0.0, DURATION)
    a = BRAKED * np.sin(OMEGA * inside) * (t > 0) * (t < DURATION)
    w = VELOCITY * inside - BRAKED / OMEGA * (inside - np.sin(OMEGA * inside) / OMEGA)
    last = VELOCITY - 2 * BRAKED / OMEGA
    w = w + last * np.maximum(t - DURATION, 0.0)
    if gauge == "flight":
        w = w + np.where(t < 0, VELOCITY * t + 0.5 * gravity * t**2, 0.0)
    top = w[(t > 0) & (t < DURATION)].max()
    a, s, w = (
        x + size * (level * noise(rng, t.size, tau) + zero)
        for x, size, zero in ((a, BRAKED, zeros[2]), (a * MASS / AREA, PEAK, zeros[0]),
                              (w, top, zeros[1]))
    )  # fmt: skip
    motion = w if "W" in channels else None
    if "F" in channels:
        return Record(t + clock, s, motion, None, a if "A" in channels else None)
    return Record(t + clock, a * MASS / AREA, motion)


def run(given, striker=STRIKER, **more):
    return condition(given, SPECIMEN, striker=striker, **more)


def error(done, clock=0.0):
    """Return the error of the contact time, s."""
    return done.origins["contact_time"] - clock


CHANNELS = ["F", "A", "FA", "FW", "AW"]
ZEROS = [(0.0, 0.0, 0.0), (-0.9, 0.7, 0.4), (0.8, -1.0, -0.6)]


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("gauge", ["flight", "rest"])
@pytest.mark.parametrize("tau", [1, 8])
@pytest.mark.parametrize(("n", "before"), [(80, 40), (500, 150), (500, 2000), (4000, 1500)])
def test_the_start_is_found_within_samples_or_a_few_percent(channels, gauge, tau, n, before):
    # One zero for each noise level, which differ between channels: so every pair is covered.
    shift = CHANNELS.index(channels)
    for i, j in ((i, (i + shift) % 3) for i in range(3)):
        level, zeros, seed = (5e-4, 5e-3, 0.02)[i], ZEROS[j], 3 * i + j
        clock = (0.0, 12.5, -3.0)[seed % 3]
        given = record(channels, n, before, 0.37, level, tau, gauge, seed, clock, zeros)
        done = run(given)
        share = 0.02 if tau == 1 else 0.03  # slow noise resembles a rise of the stress
        assert abs(error(done, clock)) <= max(3 * DURATION / n, share * DURATION)
        assert done.contact != "file"


@pytest.mark.parametrize(("gauge", "before"), [("flight", 200), ("rest", 200), ("flight", 3)])
def test_rows_before_contact_do_not_change_the_strain_rate(gauge, before):
    """A gauge in flight made it 11 % larger, one at rest 17 % smaller."""
    done = run(record(before=before, phase=0.0, level=1e-3, gauge=gauge))
    turn = np.arccos(1.0 - VELOCITY * OMEGA / BRAKED) / OMEGA  # the velocity is zero there
    moved = VELOCITY * turn - BRAKED / OMEGA * (turn - np.sin(OMEGA * turn) / OMEGA)
    assert loading_rate(done) == pytest.approx(moved / turn / HEIGHT, rel=0.02)


def test_of_two_hits_the_first_is_used():
    """The higher one was, against the velocity at the first: the fit failed."""
    first, again = record("F"), record("F", before=9000, seed=1)
    stress = np.append(first.stress, np.tile(1.1 * again.stress, 5))
    done = run(Record(first.time[0] + np.arange(stress.size) * DURATION / 500, stress, None))
    assert done.origins["contact_time"] == pytest.approx(0.0, abs=0.01 * DURATION)
    assert done.time[-1] < 1.5 * DURATION
    assert any("only the first contact is used" in note for note in done.notes)
    short = record("F", n=40, before=1000)
    short.stress[20:28] = 0.75 * PEAK  # a glitch brings no momentum
    assert first_contact(short) is short


@pytest.mark.parametrize(("level", "least", "most"), [(1e-4, 0.28, 0.3), (0.01, 0.01, 0.1)])
def test_the_zero_of_a_digitised_force_averages_with_noise_alone(level, least, most):
    """The rest lay on one level, its mean was exact: eta was ten standard errors off."""
    step, given = PEAK / 100, record(level=level)
    done = run(replace(given, stress=np.round(given.stress / step) * step))
    assert least < done.zeros["stress"] / step < most


@pytest.mark.parametrize("channels", ["F", "FW", "AW", "FA"])
def test_one_impact_written_in_several_ways_starts_at_one_instant(channels):
    first = run(record(channels, level=0.01))
    for clock, zeros in ((7.0, ZEROS[1]), (-1e3, ZEROS[2]), (0.25, ZEROS[0])):
        done = run(record(channels, level=0.01, clock=clock, zeros=zeros))
        assert error(done, clock) == pytest.approx(error(first), abs=1e-4 * DURATION)
        np.testing.assert_allclose(done.time, first.time, atol=1e-4 * DURATION)
        np.testing.assert_allclose(done.stress, first.stress, atol=1e-6 * PEAK)
        np.testing.assert_allclose(done.displacement, first.displacement, atol=2e-6)


@pytest.mark.parametrize("after", [0.0, 0.3])
@pytest.mark.parametrize("phase", [0.0, 0.5])
@pytest.mark.parametrize("level", [5e-4, 0.02])
def test_a_record_that_begins_at_contact_loses_nothing(phase, level, after):
    """The zero of the stress is found only if the record continues after the end of contact."""
    given = record(before=0, phase=phase, level=level, after=after)
    done = run(given)
    assert error(done) == 0.0
    assert (done.contact, done.sampled) == ("file", {})
    zero, shown = done.origins["stress_zero"], done.zeros.get("stress", 0.0)
    assert set(done.zeros) == ({"stress"} if after else set())
    assert abs(zero) <= 3.0 * shown <= 3.0 * 0.25 * level * PEAK
    np.testing.assert_allclose(done.stress + zero, given.stress[: len(done.stress)], rtol=1e-12)
    np.testing.assert_array_equal(done.displacement, given.displacement[: len(done.stress)])
    assert done.origins == {"contact_time": 0.0, "stress_zero": zero, "displacement_zero": 0.0}


def test_a_stress_that_rises_in_two_steps_is_found_at_the_first():
    """The stress rises slowly to 10 % of its peak, then steeply; once, no start was found."""
    rng, t = np.random.default_rng(0), (np.arange(-200, 160) + 0.4) * DURATION / 80
    plateau = np.interp(t, [0.0, 0.1 * DURATION, DURATION], [0.0, 0.05, 0.1])
    peak = np.interp(t, [0.85 * DURATION, 0.95 * DURATION, 1.1 * DURATION], [0.0, 1.0, 0.0])
    stress = PEAK * (np.where(t < 1.05 * DURATION, plateau, 0.0) + peak)
    stress += 0.01 * PEAK * rng.standard_normal(t.size)
    done = run(Record(t, stress, 1e-3 + 0.5 * np.minimum(t, 2 * DURATION - t)))
    assert done.contact == "stress"
    assert abs(error(done)) < 0.25 * DURATION  # 2.5 durations when no start was found


# Rows before contact.


def test_zeros_have_the_error_of_their_mean():
    errors = {"stress": [], "acceleration": [], "displacement": []}
    told = {name: [] for name in errors}
    for seed in range(40):
        one = run(record("FA", level=0.01, tau=8, seed=seed, zeros=ZEROS[1], before=600))
        two = run(record("FW", level=0.01, tau=8, seed=seed, zeros=ZEROS[1], gauge="rest"))
        top = 0.7 * record(level=0.0).displacement[200:].max()
        for name, done, truth in (
            ("stress", one, -0.9 * PEAK),
            ("acceleration", one, 0.4 * BRAKED),
            ("displacement", two, top),
        ):
            errors[name].append(done.origins[f"{name}_zero"] - truth)
            told[name].append(done.zeros[name])
    for name, found in errors.items():
        assert np.std(found) == pytest.approx(np.median(told[name]), rel=0.35)
        assert abs(np.mean(found)) < 0.6 * np.median(told[name])


@pytest.mark.parametrize("soft", [True, False])
def test_a_soft_end_of_contact_is_not_the_offset_of_the_sensor(soft):
    """The record ends with the contact; the stress last falls from 3 % of its peak, slowly."""
    fall = np.linspace(1.0, 0.0, 30) if soft else np.full(30, 0.5)
    clean = np.concatenate([np.sin(np.linspace(0.0, 3.1, 470)), 0.03 * fall])
    sigma, rng = 0.005, np.random.default_rng(4)
    known = NoiseLevel(sigma, False, "known")
    found = [tail_level(clean + sigma * rng.standard_normal(500), known) for _ in range(60)]
    taken = [level for level in found if level is not None]
    if soft:
        assert len(taken) <= 3
        return
    assert len(taken) >= 57
    assert np.abs([level.value - 0.015 for level in taken]).max() < 4.0 * sigma / np.sqrt(20)


def test_a_crest_at_the_end_of_contact_is_not_the_offset_of_the_sensor():
    """The record ends with the contact, while the mass inside foam-2 vibrates."""
    foam, rng = published["foam-2"], np.random.default_rng(4)
    given = foam.chain
    chain = ff.Chain(given.springs, given.heights, given.area, given.masses)
    hit = ff.Impact(foam.striker_mass, foam.striker_velocity)
    end = ff.simulate(chain, hit, np.linspace(0.0, 3e-3, 6001)).contact_end
    clean = np.append(ff.simulate(chain, hit, np.linspace(0.0, end, 1500)).base_stress, np.zeros(3))
    sigma = 0.002 * clean.max()
    known = NoiseLevel(sigma, False, "known")
    found = [tail_level(clean + sigma * rng.standard_normal(1503), known) for _ in range(20)]
    assert not [level for level in found if level is not None and level.value > 4.0 * level.error]


def test_a_rest_that_drifts_owns_up_to_it():
    given = record(level=1e-3, before=400)
    t = given.time
    drift = np.where(t < 0, 0.1 * PEAK * (t - t[0]) / -t[0], 0.0)
    still, drifting = run(given), run(replace(given, stress=given.stress + drift))
    assert any("The stress drifts by" in note for note in drifting.notes)
    assert drifting.zeros["stress"] > 0.05 * PEAK > 50 * still.zeros["stress"]
    assert drifting.origins["stress_zero"] == 0.0
    # An offset larger than the drift is subtracted nevertheless.
    far = run(replace(given, stress=given.stress + drift + 3 * PEAK))
    assert far.stress.max() == pytest.approx(PEAK, rel=0.1)


def test_a_motion_counts_before_contact_only_in_flight():
    flight, rest = run(record()), run(record(gauge="rest"))
    assert flight.time[0] == pytest.approx(-0.1 * DURATION, rel=0.1)
    assert flight.sampled == {}
    assert "displacement" not in flight.zeros
    late = record()  # the striker comes into the range of its gauge
    late = run(replace(late, displacement=np.maximum(late.displacement, -0.0015)))
    assert late.displacement.max() == pytest.approx(flight.displacement.max(), rel=1e-3)
    marked = rest.sampled["displacement"]
    assert not marked[rest.time < 0].any()
    assert not marked[(rest.time > 0) & (rest.time < 1.9 * DURATION / 500)].any()
    assert marked[(rest.time > 3 * DURATION / 500) & (rest.time < 0.97 * DURATION)].all()
    assert not marked[-3:].any()  # the gauge is at rest again
    assert rest.rows.used == len(rest.time)
    assert not any("the displacement starts at" in note for note in rest.notes)


# Channels.


def write(folder, header, *columns, velocity=f"{VELOCITY} m/s"):
    toml = (
        f'[specimen]\nheight = "{HEIGHT} m"\narea = "{AREA} m^2"\n'
        f'[striker]\nmass = "{MASS} kg"\nvelocity = "{velocity}"\n'
    )
    return write_csv(folder / "test.csv", header, *columns, fmt="%.18e", toml=toml)


@pytest.mark.parametrize("gauge", ["flight", "rest", "rest after it too"])
def test_a_file_of_the_motion_alone_gives_a_derived_stress(tmp_path, gauge):
    given = record(gauge=gauge.split()[0], n=1000, level=1e-3, zeros=ZEROS[2])
    if "after" in gauge:
        gone = (given.time > 0.2 * DURATION) & (given.displacement < given.displacement[0])
        given.displacement[np.argmax(gone) :] = given.displacement[0]
    path = write(tmp_path, "time (s),displacement (m)", given.time, given.displacement)
    done = read_test(path)
    assert done.derived == ("stress",)
    assert done.motion == "measured"
    assert any("deceleration of its motion" in note for note in done.notes)
    clock = done.time + done.origins["contact_time"]  # since the contact time is only approximate
    truth = np.where(clock > 0, PEAK * np.sin(OMEGA * np.clip(clock, 0, DURATION)), 0.0)
    assert np.sqrt(np.mean((done.stress - truth) ** 2)) < 0.05 * PEAK
    assert ("displacement" in done.zeros) == (gauge != "flight")
    turned = write(tmp_path, "time (s),displacement (m)", given.time, -given.displacement)
    other = read_test(turned)
    assert other.turned == ("displacement",)
    np.testing.assert_allclose(other.stress, done.stress, atol=1e-9 * PEAK)


def test_a_start_from_which_the_motion_passes_the_height_is_moved():
    given = record("FW", level=1e-4)
    top = float(given.displacement.max())
    thin = replace(SPECIMEN, height=top / 1.1)  # as if contact were too early
    done = condition(given, thin, striker=STRIKER)
    assert done.displacement.max() == pytest.approx(0.97 * thin.height, rel=1e-3)
    assert error(done) == pytest.approx((top - 0.97 * thin.height) / VELOCITY, rel=0.02)
    assert any("does not exceed the height" in note for note in done.notes)
    with pytest.raises(InputError, match="beyond one"):
        condition(given, replace(SPECIMEN, height=top / 1.5), striker=STRIKER)


# The striker's flight.


@pytest.mark.parametrize(("given", "spread", "told"), [(2.0, 0, 0), (2.1, 0, 1), (2.1, 0.05, 0)])
def test_a_velocity_that_the_flight_contradicts_is_told(given, spread, told):
    done = run(record(level=1e-3), striker=Striker(MASS, given), spread=spread)
    notes = [note for note in done.notes if "before contact the displacement moves at" in note]
    assert len(notes) == told
    if told:
        assert notes[0].startswith("Check:")
        assert "velocity is given as 2.1 m/s" in notes[0]
        assert re.search(r"moves at (2|2\.00\d|1\.99\d) ± ", notes[0])


@pytest.mark.parametrize("acts", [0.0, 9.81])
@pytest.mark.parametrize("given", [None, 0.0, 9.80665])
def test_a_striker_whose_flight_shows_gravity_is_said_to_fall(acts, given):
    striker = replace(STRIKER, gravity=given)
    done = run(record(level=1e-4, before=4000, gravity=acts), striker)
    notes = [note for note in done.notes if "it falls" in note]
    assert len(notes) == (acts > 0.0)
    assert done.striker.gravity == ((9.80665 if acts else 0.0) if given is None else given)
    if acts:
        contradicted = given == 0.0
        assert notes[0].startswith("Check:") == contradicted
        assert ("[striker] gravity is false" in notes[0]) == contradicted
        assert ("The fit includes gravity." in notes[0]) != contradicted


@pytest.mark.parametrize(("given", "asks"), [(None, True), (0.0, False), (9.80665, False)])
def test_where_gravity_matters_and_the_record_does_not_show_it_the_toml_is_asked(given, asks):
    done = run(record(channels="FW", before=4), replace(STRIKER, gravity=given))
    notes = [note for note in done.notes if "write gravity = true or false" in note]
    assert len(notes) == asks
    assert done.striker.gravity == given
    if asks:
        assert notes[0].startswith("Check: a falling striker gains 2 % of its velocity")


@pytest.mark.parametrize("channels", ["FW", "AW"])
def test_a_gauge_that_rests_again_does_not_stop_the_striker(channels):
    """The rebound velocity is evaluated while the gauge moves; the momentum balance closes."""
    given = record(channels, gauge="rest")
    end = int(np.searchsorted(given.time, DURATION))
    still = np.where(given.time < DURATION, given.displacement, given.displacement[end])
    done = run(replace(given, displacement=still, derived=("stress",) * (channels == "AW")))
    found = audit(done)
    assert found.rebound_velocity == pytest.approx(2 * BRAKED / OMEGA - VELOCITY, rel=0.12)
    assert found.impulse_ratio == pytest.approx(1.0, abs=0.06)
    assert found.absorbed_over_striker == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("given", "seed"),
    [
        (rig.Impact(tau=8.0), 6008),
        (rig.Impact(tau=8.0), 6018),
        (rig.Impact(samples=150), 6007),
        (rig.Impact(noise=0.02), 6007),
    ],
)
def test_a_fit_can_reach_the_contact_of_a_record_whose_rest_is_hard_to_see(given, seed, tmp_path):
    """Cases with correlated noise, few samples, or a soft start before a steep peak."""
    made = rig.impact(given, seed)
    contact = make_params(read_test(rig.write(made, tmp_path)))["contact_time"]
    assert contact.min < made.truth["contact_time"] < contact.max


@pytest.mark.parametrize("seed", range(3))
def test_a_slow_test_does_not_begin_where_its_motion_passes_an_arbitrary_zero(seed):
    """The zero crossing, at 40 % of the loading, was taken for the contact of a soft foam."""
    rng, time = np.random.default_rng(seed), np.linspace(-0.6, 20.0, 1030)
    way = 1.0 - np.abs(time / 10.0 - 1.0)
    stress = 1e5 * np.maximum(way, 0.0) ** 2 + 1e3 * rng.standard_normal(time.size)
    motion = 5e-3 * (way - 0.4) + 1.5e-5 * rng.standard_normal(time.size)
    test = condition(Record(time, stress, motion), SPECIMEN)
    assert test.displacement.size > 900
    assert not any("starts under load" in note for note in test.notes)


@pytest.mark.parametrize("gravity", [9.80665, 0.0])
@pytest.mark.parametrize("seed", range(3))
def test_force_and_motion_show_whether_the_striker_falls(gravity, seed):
    """A slow drop on a linear spring; without gravity its stiffest part was fitted 6 % off."""
    mass, speed, height, area, modulus = 2.0, 1.5, 20e-3, 1e-3, 5e5
    omega, rng = np.sqrt(modulus * area / height / mass), np.random.default_rng(seed)
    time = np.linspace(-0.2e-3, 29e-3, 800)
    after = np.maximum(time, 0.0)
    fall = gravity / omega**2 * (1.0 - np.cos(omega * after))
    motion = np.where(time < 0.0, speed * time, fall + speed / omega * np.sin(omega * after))
    stress = modulus / height * np.maximum(motion, 0.0)
    curves = [one + 3e-3 * np.ptp(one) * rng.standard_normal(time.size) for one in (stress, motion)]
    test = condition(Record(time, *curves), Specimen(height, area), striker=Striker(mass, speed))
    assert test.striker.gravity == pytest.approx(gravity)
    assert not any("does not show whether" in note for note in test.notes)
    assert any("the striker" in note and "m/s²" in note for note in test.notes)


# The contact time that the first rise of a channel shows, on records of other laws.

CONTACT = 0.37  # s; the largest stress is 1, one second later


def rise(kind: str, since: np.ndarray) -> np.ndarray:
    """Return a made rise of the stress, by the time since contact (s)."""
    x = np.maximum(since, 0.0)
    return {
        "kink": x,
        "soft": x**2,
        "jump": np.where(since >= 0.0, 0.08 + 0.92 * x, 0.0),
        "plateau": np.minimum(6.0 * x, 0.3) + 0.7 * x**4,
        "late kink": 0.1 * x + 9.0 * np.maximum(x - 0.9, 0.0),
    }[kind]


@pytest.mark.parametrize("kind", ["kink", "soft", "jump", "plateau", "late kink"])
@pytest.mark.parametrize("noise", [1e-3, 1e-2])
@pytest.mark.parametrize("rows", [150, 2000])
def test_the_standard_error_covers_the_true_contact(kind, noise, rows):
    """Of 24 records none is off by more than four standard errors, their RMS is at most 1.7."""
    off = []
    for seed in range(24):
        rng = np.random.default_rng([seed, rows])
        step = 1.0 / rows
        time = np.arange(-0.3, 1.0, step) + rng.uniform(0.0, step) + CONTACT
        clean = rise(kind, time - CONTACT)
        values = clean + noise * rng.standard_normal(time.size)
        before = int(np.searchsorted(time, CONTACT))
        values -= values[: before - 2].mean()
        noise_of_zero = noise / before**0.5
        contact, error = rise_of(time, values, estimated_noise(values), before - 2, noise_of_zero)
        assert error > 0.2 * step
        off.append((contact - CONTACT) / error)
    assert np.max(np.abs(off)) < 4.0
    assert np.sqrt(np.mean(np.square(off))) < 1.7


@pytest.mark.parametrize("kind", ["kink", "soft"])
def test_any_length_of_rest_shows_the_same_contact(kind):
    """After 20,000 rows of rest the first rise was taken for a part of it."""
    rng, time = np.random.default_rng(0), np.arange(-20_000, 250) / 250.0
    values = rise(kind, time) + 1e-2 * rng.standard_normal(time.size)
    noise, found = estimated_noise(values), []
    for first in (0, 19_800):
        before = 20_000 - first
        found.append(rise_of(time[first:], values[first:], noise, before, 1e-2 / before**0.5))
    assert found[0] == pytest.approx(found[1], abs=0.5 * found[1][1])
    assert abs(found[0][0]) < 3.0 * found[0][1]


def test_a_rest_longer_than_the_way_to_the_peak_shows_no_rise():
    """The width of the mean over these rows was zero."""
    noise = estimated_noise(np.random.default_rng(0).standard_normal(100))
    values = np.concatenate([[0.0, 1.0], np.zeros(100)])
    assert rise_of(np.arange(102.0), values, noise, 50, None) is None
