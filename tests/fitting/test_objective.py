"""The objective: channels counted, their scale, and the penalty for failed simulations."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import synthetic_impact, synthetic_loop
from foamfit.data.measurement import Measurement, Noise, Outliers
from foamfit.fitting.curves import check_drive, choose_drive, default_weights
from foamfit.fitting.objective import Objective
from foamfit.one_model import Options
from foamfit.springs.model import Model

BISTABLE = Model.parse("bistable")


def values_of(spring: ff.BistableSpring) -> np.ndarray:
    return np.array([*spring.seven, spring.eta, 0.0])


def objective(measurement, drive="impact", weights=None):
    return Objective(measurement, BISTABLE, drive, weights or default_weights(measurement, drive))


def known(one: Objective, values: np.ndarray) -> np.ndarray:
    """Return values of springs followed by the nuisance parameters stated by record and TOML."""
    return np.append(values, [one.usual[name] for name in one.nuisance])


def test_the_true_parameters_leave_nothing_without_noise():
    spring, measurement = synthetic_impact(noise=0.0)
    one = replace(objective(measurement), rtol=1e-6)  # that of the synthetic record
    assert np.max(np.abs(one.residual(known(one, values_of(spring))))) < 1e-12
    usual = objective(measurement)
    assert np.max(np.abs(usual.residual(known(usual, values_of(spring))))) < 1e-3


def test_each_channel_is_counted_once():
    _, impact = synthetic_impact()
    assert objective(impact).counted == ("stress_time", "displacement_time")
    integrated = replace(impact, motion="integrated from force")
    assert objective(integrated).counted == ("stress_time",)
    assert objective(impact, "displacement").counted == ("stress_strain",)
    assert objective(impact, "stress").counted == ("displacement_time",)


def test_a_motion_integrated_from_the_force_has_no_misfit_unless_it_is_counted():
    spring, impact = synthetic_impact()
    integrated = replace(impact, motion="integrated from force")
    one = objective(integrated)
    curves = one.simulate(known(one, values_of(spring)), everything=True)
    misfit = one.misfit(curves)
    assert misfit["stress_time"] > 0.0
    assert misfit["displacement_time"] is None
    assert misfit["stress_strain"] is None
    assert one.off(curves, "displacement_time") > 0.0
    assert all(objective(impact).misfit(curves).values())
    assert objective(integrated, "stress").misfit(curves)["displacement_time"] > 0.0
    other = objective(integrated, "displacement")
    simulated = other.simulate(known(other, values_of(spring)))
    assert other.misfit(simulated)["stress_strain"] > 0.0


def test_the_stress_strain_misfit_runs_along_the_measured_displacement():
    spring, measurement = synthetic_loop()
    one = objective(measurement, "displacement")
    misfit = one.misfit(one.simulate(known(one, values_of(spring)), everything=True))
    assert misfit["stress_time"] is None
    assert misfit["displacement_time"] is None
    along = spring.stress(measurement.displacement / measurement.specimen.height)
    borne = np.maximum(along, 0.0)  # the specimen is loose
    expected = np.sqrt(np.mean((borne - measurement.stress) ** 2)) / np.ptp(measurement.stress)
    assert misfit["stress_strain"] == pytest.approx(expected, rel=1e-12)


def test_the_jacobian_agrees_with_the_law_in_closed_form():
    """With a given displacement, dσ/dk0 is ε/(1-ε) on branch a and ε_a/(1-ε_a) on branch d."""
    spring, measurement = synthetic_loop()
    one = objective(measurement, "displacement")
    values = known(one, values_of(spring))
    column = one.jacobian(values, np.array([0]))[:, 0] * one.scale["stress_strain"]
    strain = measurement.displacement / measurement.specimen.height
    up = np.arange(strain.size) < 200
    on_a = up & (strain < 0.13)
    on_d = up & (strain > 0.15) & (strain < 0.33)
    np.testing.assert_allclose(
        column[on_a], strain[on_a] / (1 - strain[on_a]), rtol=1e-12, atol=1e-15
    )
    np.testing.assert_allclose(column[on_d], 0.14 / 0.86, rtol=1e-12)


def differences_of(one: Objective, values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return central differences of the residual with respect to all parameters."""
    columns = []
    for i, step in enumerate(steps):
        sides = []
        for side in (step, -step):
            moved = values.copy()
            moved[i] += side
            sides.append(one.residual(moved))
        columns.append((sides[0] - sides[1]) / (2.0 * step))
    return np.column_stack(columns)


@pytest.mark.parametrize("late", [0.0, 7.3e-6])
@pytest.mark.parametrize("contact", [0.0, 11.4e-6])
def test_the_jacobian_is_that_of_the_residual(late, contact):
    """It agrees with central differences, with outliers removed and with a shift in time."""
    spring, test = synthetic_impact(eta=20.0, samples=151)
    wrong = np.zeros(151, bool)
    wrong[[20, 21, 70]] = True
    spikes = Outliers(wrong, test.time[wrong], test.stress[wrong])
    test = replace(test, outliers={"stress": spikes}, uncertainties={"velocity": 0.01})
    weights = {"stress_time": 1.0, "displacement_time": 2.0, "stress_strain": 0.5}
    one = Objective(test, BISTABLE, "impact", weights, rtol=1e-11, time_shift=True)
    assert one.n_data == 3 * 151 - 2 * 3
    values = known(one, values_of(spring))
    values[:8] *= 1.0 + 0.02 * np.array([1, -1, 1, -1, 1, -1, 1, -1])
    values[8], values[9], values[-1] = 10.0, contact, late
    values[10] = 2e-6  # displacement_zero
    sample = test.time[1] - test.time[0]
    values[15] = 1.2  # force_scale
    sizes = np.concatenate([np.abs(values[:9]), [sample, 1e-5, 1e4, 1e2, 2.0, 7e-3, 1.0, sample]])
    assert sizes.size == len(one.nuisance) + 9
    steps = 1e-6 * sizes
    steps[[9, -1]] = 1e-3 * sample
    steps[[13, 14]] *= 100.0
    found = one.jacobian(values, np.arange(values.size))
    wanted = differences_of(one, values, steps)
    for i, size in enumerate(sizes):
        # The four largest errors are ignored: differences at a sample next to a kink of the strain
        # rate, or to the jump of the dashpot at contact, may be one-sided.
        off = np.sort(np.abs(found[:, i] - wanted[:, i]) * size)[-5]
        reach = np.sort(np.abs(wanted[:, i]) * size)[-5]
        assert off <= (1e-4 if i < 9 else 2e-3) * reach, one.nuisance[i - 9] if i > 8 else i


def an_impact(shown: str, eta: float, samples: int = 151) -> tuple[ff.BistableSpring, Measurement]:
    """Return a synthetic impact recorded by its force and a displacement or acceleration."""
    spring, test = synthetic_impact(eta=eta, samples=samples)
    if shown == "acceleration":
        push = test.specimen.area / test.striker.mass * test.stress
        test = replace(test, displacement=None, motion=None, acceleration=push, noise=Noise())
    zeros = {"displacement": 1e-6, "stress": 1e4, "acceleration": 20.0}
    return spring, replace(
        test, zeros=zeros, uncertainties={"velocity": 0.01, "striker_mass": 5e-6}
    )


@pytest.mark.parametrize("eta", [0.0, 20.0])
@pytest.mark.parametrize("shown", ["displacement", "acceleration"])
def test_nuisance_parameters_of_an_impact_act_as_their_names_say(shown, eta):
    """Changing them is equivalent to another striker, contact time and zeros of the channels."""
    spring, test = an_impact(shown, eta)
    one = Objective(test, BISTABLE, "impact", default_weights(test, "impact"), rtol=1e-9)
    assert one.counted == ("stress_time", f"{shown}_time")
    at = {
        "contact_time": 21.4e-6, "displacement_zero": 3e-6, "stress_zero": 2e4,
        "acceleration_zero": 50.0, "velocity": 2.02, "striker_mass": 7.01e-3,
        "force_scale": 1.25,
    }  # fmt: skip
    values = np.append(values_of(spring), [at[name] for name in one.nuisance])
    seen = one.simulate(values).curves
    free = test.time < at["contact_time"]
    np.testing.assert_allclose(seen["stress_time"][free], 2e4, rtol=1e-12)
    chain = ff.Chain([spring], [test.specimen.height], test.specimen.area)
    since = np.append(0.0, test.time[~free] - at["contact_time"])
    there = ff.simulate(chain, ff.Impact(7.01e-3, 2.02), since, rtol=1e-10)
    pressed = there.base_stress[1:]
    near = {"rtol": 1e-6, "atol": 1e-6 * np.ptp(test.stress)}
    np.testing.assert_allclose(seen["stress_time"][~free], pressed / 1.25 + 2e4, **near)
    if shown == "acceleration":
        push = test.specimen.area / 7.01e-3 * pressed
        np.testing.assert_allclose(seen["acceleration_time"][~free], push + 50.0, rtol=1e-5)
        np.testing.assert_allclose(seen["acceleration_time"][free], 50.0, rtol=1e-12)
    else:
        moved = seen["displacement_time"]
        np.testing.assert_allclose(moved[~free], there.displacement[-1][1:] + 3e-6, atol=1e-9)
        flight = 2.02 * (test.time[free] - 21.4e-6) + 3e-6
        np.testing.assert_allclose(moved[free], flight, atol=1e-12)

    off = [(at[prior.name] - prior.mean) / prior.sigma for prior in one.priors]
    names = [prior.name for prior in one.priors]
    assert names == [n for n in one.nuisance if n not in ("contact_time", "force_scale")]
    np.testing.assert_allclose(one.residual(values)[one.n_data :], off, rtol=1e-12)
    places = np.arange(9, values.size)
    found, gap = one.jacobian(values, places), test.time[1]
    steps = np.array([1e-3 * gap, 1e-9, 10.0, 0.1, 1e-4, 1e-6, 1e-5])
    assert found.shape == (one.n_data + len(names), 7)
    wanted = differences_of(one, values, np.append(np.ones(9), steps))[:, 9:]
    off = np.sort(np.abs(found - wanted), axis=0)[-5]
    assert np.all(off <= 2e-3 * np.sort(np.abs(wanted), axis=0)[-5])


def test_the_drive_is_chosen_by_what_the_test_has():
    _, impact = synthetic_impact()
    _, loop = synthetic_loop()
    assert choose_drive(impact) == "impact"
    assert choose_drive(replace(impact, striker=None)) == "displacement"
    assert choose_drive(loop) == "displacement"
    with pytest.raises(ff.InputError, match="no drive is possible"):
        choose_drive(replace(loop, displacement=None))


@pytest.mark.parametrize(
    ("drive", "missing"),
    [("impact", "time column and \\[striker\\] mass"), ("sideways", "unknown")],
)
def test_a_drive_that_the_test_cannot_feed_is_refused(drive, missing):
    _, loop = synthetic_loop()
    with pytest.raises(ff.InputError, match=missing):
        check_drive(loop, drive)


def test_unknown_and_negative_weights_are_refused():
    _, loop = synthetic_loop()
    for weights in ({"stress": 1.0}, {"stress_strain": -1.0}, {"stress_strain": 0.0}):
        with pytest.raises(ff.InputError):
            objective(loop, "displacement", weights)


def of_two_loops() -> SystemError:
    """Return the error that Ctrl-C causes in a compiled loop called by another one."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize("lost", [KeyboardInterrupt(), of_two_loops(), None, ValueError("a bug")])
def test_ctrl_c_in_a_compiled_loop_is_ctrl_c(monkeypatch, lost):
    """Python raises SystemError if the signal arrives while a loop returns its result."""

    def interrupted(*_, **__):
        raise SystemError("returned a result with an exception set") from lost

    problem = Options().problem(synthetic_impact()[1], "bistable")
    monkeypatch.setattr(type(problem.objective.scenes), "rows", interrupted)
    signalled = isinstance(lost, KeyboardInterrupt | SystemError)
    expected = KeyboardInterrupt if signalled else SystemError
    with pytest.raises(expected):
        problem.objective.simulate(problem.vector())
