"""Robustness of a fit to outliers, a time shift and interruption."""

import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import foamfit as ff
from conftest import AREA, HEIGHT, NAMES, run, small_pictures, synthetic_impact, write_measurement
from foamfit import one_model
from foamfit.data.measurement import Measurement, Outliers
from foamfit.fitting.curves import default_weights
from foamfit.fitting.objective import Objective
from foamfit.report.comparison import compare, comparison_text
from foamfit.report.folder import load_result
from foamfit.report.plots import plot_fit
from foamfit.report.summary import summary_text
from foamfit.springs.model import Model

pytestmark = pytest.mark.usefixtures("without_hops")
BISTABLE = Model.parse("bistable")


def worst_deviation(result: ff.FitResult, spring: ff.BistableSpring) -> float:
    """Return the largest deviation of the seven parameters from the true values, in stderr."""
    items = [result.parameters[f"s1_{name}"] for name in NAMES]
    return max(
        abs(item.value - true) / item.stderr for item, true in zip(items, spring.seven, strict=True)
    )


def spoilt_impact() -> tuple[ff.BistableSpring, Measurement, np.ndarray]:
    """Return an impact with stress outliers at some samples, in the form the loader returns."""
    spring, test = synthetic_impact()
    at = np.array([57, 148, 149, 301])
    left_out = np.isin(np.arange(test.time.size), at)
    found = Outliers(left_out, test.time[at], np.full(4, 9e6))
    return spring, replace(test, outliers={"stress": found}), at


def test_outliers_are_in_the_result_and_crossed_in_the_figure(tmp_path, monkeypatch):
    small_pictures(monkeypatch)
    _, test, at = spoilt_impact()
    result = ff.fit(test, starts=2, intervals="local")
    content = result.to_json_dict()
    assert content["statistics"]["n_left_out"] == at.size
    assert content["outliers"]["stress"]["values"] == [9e6] * 4
    assert any("4 outliers of the stress" in note for note in result.notes)
    figure = plot_fit(result)
    for ax, count in zip(figure.axes[:3], (1, 0, 1), strict=True):
        crosses = [line for line in ax.lines if line.get_label() == "outlier, not fitted"]
        assert len(crosses) == count
        for line in crosses:
            assert line.get_xdata().size == at.size
            assert max(line.get_ydata()) <= ax.get_ylim()[1]  # the curves keep their room
    folder = result.save(tmp_path / "fit")
    header, *rows = (folder / "curves.csv").read_text().splitlines()
    column = header.split(",").index("outliers of stress left out")
    assert [i for i, row in enumerate(rows) if row.split(",")[column] == "1"] == at.tolist()


def test_a_file_with_spikes_and_gaps_gives_the_parameters_of_the_spring(tmp_path):
    spring, test = synthetic_impact(samples=601)
    stress, motion = test.stress.copy(), test.displacement.copy()
    rng = np.random.default_rng(2)
    spikes = rng.choice(np.arange(40, 400), 3, replace=False)
    stress[spikes] += 15 * test.noise.stress
    stress[[210, 211]] = 0.0
    motion[333] = 0.0
    spoilt = replace(test, stress=stress, displacement=motion)
    read = ff.read_test(write_measurement(tmp_path / "spoilt.csv", spoilt))
    assert read.outliers["stress"].at.size == 5
    assert read.outliers["displacement"].at.size == 1
    said = [note for note in read.notes if "spikes or gaps" in note]
    assert any(note.startswith("Check: 5 samples of the stress") for note in said)
    assert any(note.startswith("Check: 1 sample of the displacement") for note in said)
    result = ff.fit(read, starts=4, intervals="local")
    assert worst_deviation(result, spring) < 4.0
    assert result.noise["stress_time"]["given"] is False
    assert result.noise["stress_time"]["residual_over_noise"] == pytest.approx(1.0, abs=0.15)
    assert result.statistics["redchi"] == pytest.approx(1.0, abs=0.2)


def shifted_impact(late: float, **changed: object) -> tuple[ff.BistableSpring, Measurement]:
    """Return the impact of conftest with its motion recorded `late` seconds too late."""
    spring, test = synthetic_impact(samples=201)
    chain = ff.Chain([spring], [HEIGHT], AREA)
    dense = np.linspace(0.0, 0.9e-3, 20_001)
    motion = ff.simulate(chain, ff.Impact(7e-3, 2.0), dense).displacement[-1]
    when = test.time - late
    seen = np.where(when < 0.0, 2.0 * when, np.interp(when, dense, motion))
    noise = test.noise.displacement * np.random.default_rng(3).standard_normal(when.size)
    return spring, replace(test, displacement=seen + noise, **changed)


@pytest.mark.parametrize("late", [15e-6, -10e-6])
def test_a_shift_between_force_and_motion_is_warned_of_and_fitted(late):
    spring, test = shifted_impact(late)
    plain = ff.fit(test, starts=2, intervals="local")
    word = "late" if late > 0 else "early"
    (warning,) = [w for w in plain.warnings if "--time-shift" in w]
    assert f"{word} against the force by" in warning
    result = ff.fit(test, time_shift=True, starts=2, intervals="local")
    item = result.parameters["time_shift"]
    assert (item.unit, item.state) == ("s", "determined")
    assert abs(item.value - late) < max(3 * item.stderr, 0.05 * abs(late))
    assert worst_deviation(result, spring) < 4.0
    assert not [w for w in result.warnings if "--time-shift" in w]
    assert "time shift Δt" in summary_text(result)


@pytest.mark.parametrize("contact", ["file", "stress", "motion"])
def test_the_curves_of_a_shifted_test_are_those_that_it_shows(contact):
    """Time zero comes from the file, the onset of stress (zero displacement), or the motion."""
    late = 12e-6
    spring, test = synthetic_impact(noise=0.0)
    chain = ff.Chain([spring], [HEIGHT], AREA)
    seen = np.append(0.0, test.time[1:] + (late if contact == "motion" else -late))
    free = seen < 0.0
    there = ff.simulate(chain, ff.Impact(7e-3, 2.0), np.append(0.0, seen[seen > 0.0]), rtol=1e-10)
    at = {"time_shift": late}
    if contact == "motion":
        test = replace(test, stress=there.base_stress)
        at["contact_time"] = -late
    else:
        motion = np.append(2.0 * seen[free], there.displacement[-1][1:])
        motion = np.append(-2.0 * late, motion)
        at["displacement_zero"] = 2.0 * late if contact == "stress" else 0.0
        test = replace(test, displacement=motion + at["displacement_zero"])
    weights = default_weights(test, "impact")
    one = Objective(test, BISTABLE, "impact", weights, time_shift=True, rtol=1e-10)
    nuisance = [(one.usual | at)[name] for name in one.nuisance]
    curves = one.simulate(np.array([*spring.seven, 0.0, 0.0, *nuisance]))
    for simulated, measured in (
        (curves.curves["stress_time"], test.stress),
        (curves.curves["displacement_time"], test.displacement),
    ):
        off = np.abs(simulated - measured)[1:] / np.ptp(measured)
        assert off.max() < 1e-6


@pytest.mark.parametrize(
    ("changed", "missing"),
    [({"time": None, "striker": None}, "no time"), ({"motion": "integrated from force"}, "motion")],
)
def test_a_shift_without_two_channels_in_time_is_refused(changed, missing):
    _, test = synthetic_impact()
    with pytest.raises(ff.InputError, match=missing) as caught:
        ff.fit(replace(test, **changed), time_shift=True)
    assert "time shift" in str(caught.value)


def test_a_stopped_fit_is_marked_everywhere(here, monkeypatch):
    small_pictures(monkeypatch)
    test = fabricated_csv(here)
    out = run("fit", str(test), "--max-time", "0.02", "--out", "stopped", code=(0, 2))
    assert "stopped by the time limit" in out.stdout.splitlines()[0]
    content = load_result(here / "stopped")
    assert content["stopped"] == "the time limit"
    assert content["status"] in ("warnings", "failed")
    assert "stopped by the time limit" in content["warnings"][0]
    head = (here / "stopped" / "report.html").read_text().split("</h1>")[1][:400]
    assert "stopped by the time limit" in head
    text = comparison_text(compare([here / "stopped"], "foam-1/model-1"))
    assert "stopped by the time limit)" in text.splitlines()[0]
    assert "not those of a finished fit" in " ".join(text.split())


def test_sigterm_keeps_the_best_so_far(here, monkeypatch):
    small_pictures(monkeypatch)
    end = partial(signal.raise_signal, signal.SIGTERM)
    monkeypatch.setattr(one_model.settle, "settle_ends", lambda *_: end())  # stop after the search
    call = ["fit", str(fabricated_csv(here)), "--starts", "2", "--out", "stopped"]
    out = run(*call)
    assert out.stderr == ""
    assert "stopped by SIGTERM" in out.stdout.splitlines()[0]
    assert load_result(here / "stopped")["stopped"] == "SIGTERM"
    monkeypatch.setattr(one_model, "make_problem", lambda *_, **__: end())
    assert run(*call, "--quiet", code=143).stderr.strip() == "foamfit: ended by SIGTERM"


def fabricated_csv(folder):
    return write_measurement(folder / "foam-1-model-1.csv", synthetic_impact(samples=201)[1])
