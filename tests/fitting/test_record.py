"""Contact, zeros and weights keep to the record where the law does not describe the foam.

The records are made by the formulas below: a foam that is crushed, recovers little, and is recorded
from before the contact with arbitrary zeros and noise in each channel.
"""

import numpy as np
import pytest

import foamfit as ff
from conftest import write_csv

HEIGHT, AREA = 15e-3, 7.07e-4  # m, m²
OFFSET, BIAS = 3.1e-3, 0.21e6  # zeros of motion, m, and stress, Pa, in the file
TOML = f'[specimen]\nheight = "{HEIGHT} m"\narea = "{AREA} m^2"\n'


def crushed(folder, *, seed=0, most=0.75, noise=(20e3, 2e-6), rest=40, rows=700):
    """Write a record of a crushed foam and return its path, travel (m) and peak stress (Pa)."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 10e-3, rows)
    start = time[rest] + 0.4 * time[1]
    phase = np.clip((time - start) / (time[-1] - start), 0.0, 1.0)
    strain = most * np.sin(0.62 * np.pi * phase) / np.sin(0.5 * np.pi)
    top = int(np.argmax(strain))
    plateau = 1.1e6 * np.minimum(strain / 0.012, 1.0)
    stress = plateau + 9e6 * strain**4 + 1.4e7 * np.maximum(strain - 0.45, 0.0) ** 1.5
    set_in = 0.9 * most  # strain that is not recovered
    back = stress[top] * np.maximum((strain - set_in) / (most - set_in), 0.0) ** 1.2
    stress[top:] = back[top:]
    path = recorded(folder / f"crushed-{seed}.csv", rng, time, stress, strain, noise)
    return path, most * HEIGHT, float(stress.max())


def recorded(path, rng, time, stress, strain, noise):
    """Write a record with the zeros of the file and with noise of stress (Pa) and motion (m)."""
    read = (stress + BIAS, strain * HEIGHT + OFFSET)
    noisy = [
        one + size * rng.standard_normal(time.size) for one, size in zip(read, noise, strict=True)
    ]
    head = "time (s),stress (Pa),displacement (m)"
    return write_csv(path, head, time, *noisy, fmt="%.17g", toml=TOML)


@pytest.mark.parametrize(("model", "terms"), [("bistable", 0), ("microscale", 1)])
def test_zeros_do_not_hide_an_error_of_the_law(model, terms, tmp_path):
    """They stay where rest and first rise show them, and the result says what they would gain."""
    path, travel, peak = crushed(tmp_path)
    result = ff.fit(ff.read_test(path), model=model, relaxation=terms, starts=4)
    motion, stress = (result.parameters[f"{c}_zero"] for c in ("displacement", "stress"))
    assert abs(motion.value - OFFSET) < 0.01 * travel
    assert abs(stress.value - BIAS) < 0.01 * peak
    for one in (motion, stress):
        assert one.state == "fixed"
        assert one.ci95[0] < one.value < one.ci95[1]
        assert "record shows" in one.why
    assert max(result.strain) - (motion.value - OFFSET) / HEIGHT < 1.0
    assert all(misfit is None or misfit < 0.1 for misfit in result.misfit.values())
    check = next(one for one in result.checklist if one.key == "record")
    if check.answer is False:
        (warning,) = check.warnings
        assert warning.startswith("The law is at fault: with ")
        assert " the misfit would fall from " in warning


def test_a_zero_at_which_the_measured_strain_reaches_one_is_refused(tmp_path):
    test = ff.read_test(crushed(tmp_path)[0])
    wrong = OFFSET - 0.3 * HEIGHT
    with pytest.raises(ff.InputError, match=r"displacement_zero = .* measured strain would reach"):
        ff.fit(test, fix={"displacement_zero": wrong})
    low = ff.make_params(test)["displacement_zero"].min
    assert test.displacement.max() + OFFSET - low < HEIGHT


@pytest.mark.parametrize("intervals", ["auto", "local"])
def test_a_noisy_motion_does_not_excuse_an_error_of_the_law(intervals, tmp_path):
    """The fit follows the record as plain least squares does, and says that it stays plain.

    The best of 25 random starts of SciPy's `least_squares` along the measured motion misses the
    stress by 8.36 % of its range.
    """
    test = ff.read_test(crushed(tmp_path, noise=(20e3, 250e-6))[0])
    result = ff.fit(test, intervals=intervals)
    assert result.misfit["stress_strain"] < 1.05 * 0.0836
    assert any("The noise of the motion does not explain the residuals" in n for n in result.notes)


def test_contact_is_not_sought_before_stress_and_motion_leave_their_rest(tmp_path):
    """Impact of a striker on the crushed foam: the contact keeps to the first rise."""
    path, *_ = crushed(tmp_path, rest=120, rows=900)
    toml = TOML + '[striker]\nmass = "3 kg"\nvelocity = "4.8 m/s"\ngravity = false\n'
    path.with_suffix(".toml").write_text(toml)
    step, rise = np.loadtxt(path, delimiter=",", skiprows=1)[[1, 120], 0]
    limits = ff.make_params(ff.read_test(path), drive="impact")["contact_time"]
    assert rise - 10.0 * step < limits.min < rise + step < limits.max < rise + 20.0 * step


def test_where_the_law_is_true_contact_and_zeros_stay_free(tmp_path):
    """The record is that of a bistable spring: its zeros are found and bought nothing."""
    spring = ff.BistableSpring(
        k0=4e6, kc=4e7, dsigma=-0.2e6, eps_a=0.2, eps_c=0.35, kh_plus=3e6, kh_minus=1.5e6
    )
    rng, rows, rest = np.random.default_rng(5), 800, 60
    time = np.linspace(0.0, 2.0, rows)
    phase = np.clip((time - time[rest] - 0.3 * time[1]) / (2.0 - time[rest]), 0.0, 1.0)
    strain = 0.55 * np.sin(np.pi * phase)
    stress = np.maximum(np.asarray(spring.stress(strain)), 0.0)
    noise = 2e-3 * stress.max(), 1e-6
    path = recorded(tmp_path / "true.csv", rng, time, stress, strain, noise)
    result = ff.fit(ff.read_test(path), starts=8)
    zero = result.parameters["displacement_zero"]
    assert zero.vary
    assert abs(zero.value - OFFSET) < 4.0 * zero.stderr
    check = next(one for one in result.checklist if one.key == "record")
    assert (check.answer, check.warnings) == (True, ())
