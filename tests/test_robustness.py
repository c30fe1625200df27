"""Robustness of a fit to outliers, a time shift and interruption."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner

import fabricated
import foamfit as ff
import foamfit.report.figures
import foamfit.report.summary
from conftest import AREA, HEIGHT, small_pictures, synthetic_impact, synthetic_loop
from foamfit import one_model
from foamfit.cli import main
from foamfit.data.measurement import Measurement, Outliers
from foamfit.fitting.curves import default_weights
from foamfit.fitting.objective import Objective
from foamfit.report.comparison import compare, comparison_text
from foamfit.report.folder import load_result
from foamfit.report.plots import plot_fit
from foamfit.report.summary import render_report, summary_text
from foamfit.springs.model import Model

BISTABLE = Model.parse("bistable")
NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus")


def worst_deviation(result: ff.FitResult, spring: ff.BistableSpring) -> float:
    """Return the largest deviation of the seven parameters from the true values, in stderr."""
    items = [result.parameters[f"s1_{name}"] for name in NAMES]
    return max(
        abs(item.value - true) / item.stderr for item, true in zip(items, spring.seven, strict=True)
    )


# --------------------------------------------------------------------------------------- outliers


def spoilt_impact() -> tuple[ff.BistableSpring, Measurement, np.ndarray]:
    """Return an impact with stress outliers at some samples, in the form the loader returns."""
    spring, test = synthetic_impact()
    at = np.array([57, 148, 149, 301])
    left_out = np.isin(np.arange(test.time.size), at)
    found = Outliers(left_out, test.time[at], np.full(4, 9e6))
    return spring, replace(test, outliers={"stress": found}), at


def test_what_stands_at_an_outlier_does_not_matter():
    spring, test, at = spoilt_impact()
    changed = replace(test, stress=np.where(test.outliers["stress"].left_out, 7e5, test.stress))
    weights = default_weights(test, "impact")
    one, other = (Objective(t, BISTABLE, "impact", weights) for t in (test, changed))
    values = np.array([*spring.seven, 0.0, 0.0, *(one.usual[name] for name in one.nuisance)])
    np.testing.assert_array_equal(one.residual(values), other.residual(values))
    assert one.sizes == (401 - at.size, 401)
    simulated = one.simulate(values)
    assert one.misfit(simulated)["stress_time"] == pytest.approx(
        other.misfit(simulated)["stress_time"], rel=1e-12
    )


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
    path = tmp_path / "spoilt.csv"
    table = np.column_stack([test.time, stress, motion])
    np.savetxt(path, table, delimiter=",", header="time_s,stress_Pa,displacement_m", comments="")
    path.with_suffix(".toml").write_text(
        f'[specimen]\nheight = "{HEIGHT} m"\narea = "{AREA} m^2"\n'
        '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n'
    )
    read = ff.read_test(path)
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


# ------------------------------------------------------------------------------------- time shift


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
    assert item.unit == "s"
    assert item.state == "determined"
    assert abs(item.value - late) < max(3 * item.stderr, 0.05 * abs(late))
    assert item.ci95[0] < item.value < item.ci95[1]
    assert worst_deviation(result, spring) < 4.0
    assert not [w for w in result.warnings if "--time-shift" in w]
    assert result.params["time_shift"].value == item.value
    assert "time shift Δt" in summary_text(result)


def test_no_shift_is_warned_of_where_there_is_none():
    _, test = synthetic_impact(samples=201)
    plain, shifted = (
        ff.fit(test, time_shift=shift, starts=2, intervals="local") for shift in (False, True)
    )
    assert not [w for w in plain.warnings if "--time-shift" in w]
    shifted = shifted.parameters["time_shift"]
    assert abs(shifted.value) < 3 * shifted.stderr


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


def test_a_slow_test_in_time_has_a_shift_too():
    _, loop = synthetic_loop()
    time = np.linspace(0.0, 4.0, loop.stress.size)
    late = 0.05
    seen = np.interp(time - late, time, loop.displacement)
    test = replace(loop, time=time, displacement=seen)
    result = ff.fit(test, time_shift=True, starts=4, intervals="local")
    item = result.parameters["time_shift"]
    assert item.value == pytest.approx(late, abs=max(3 * item.stderr, 2e-3))
    assert result.drive == "displacement"
    assert any("relaxes" in note for note in result.notes)


@pytest.mark.parametrize(
    ("changed", "missing"),
    [({"time": None, "striker": None}, "no time"), ({"motion": "integrated from force"}, "motion")],
)
def test_a_shift_without_two_channels_in_time_is_refused(changed, missing):
    _, test = synthetic_impact()
    with pytest.raises(ff.InputError, match=missing) as caught:
        ff.fit(replace(test, **changed), time_shift=True)
    assert "time shift" in str(caught.value)


def test_the_command_fits_a_shift_and_refuses_it_without_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    test = fabricated_csv(tmp_path)
    monkeypatch.setattr("foamfit.api.FitResult.save", lambda *_, **__: None)
    call = ["fit", str(test), "--starts", "2", "--json", "--time-shift"]
    out = CliRunner().invoke(main, call)
    assert out.exit_code == 0
    content = json.loads(out.stdout)
    assert content["parameters"]["time_shift"]["unit"] == "s"
    rows = [line.split(",")[1:] for line in test.read_text().splitlines()[:200]]
    (tmp_path / "slow.csv").write_text("\n".join(",".join(row) for row in rows))
    (tmp_path / "slow.toml").write_text('[specimen]\nheight = "1.19 mm"\ndiameter = "5 mm"\n')
    out = CliRunner().invoke(main, ["fit", "slow.csv", "--time-shift"])
    assert out.exit_code == 1
    assert "it has no time" in out.stderr
    assert len(out.stderr.splitlines()) == 1


# ----------------------------------------------------------------------------------- interruption


def test_a_stopped_fit_is_marked_everywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small_pictures(monkeypatch)
    test = fabricated_csv(tmp_path)
    out = CliRunner().invoke(main, ["fit", str(test), "--max-time", "0.02", "--out", "stopped"])
    assert out.exit_code in (0, 2)
    assert "stopped by the time limit" in out.stdout.splitlines()[0]
    content = load_result(tmp_path / "stopped")
    assert content["stopped"] == "the time limit"
    assert content["status"] in ("warnings", "failed")
    assert "stopped by the time limit" in content["warnings"][0]
    head = (tmp_path / "stopped" / "report.html").read_text().split("</h1>")[1][:400]
    assert "stopped by the time limit" in head
    text = comparison_text(compare([tmp_path / "stopped"], "foam-1/model-1"))
    assert "stopped by the time limit)" in text.splitlines()[0]
    assert "not those of a finished fit" in " ".join(text.split())


def test_sigterm_keeps_the_best_so_far(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small_pictures(monkeypatch)
    end = partial(signal.raise_signal, signal.SIGTERM)
    monkeypatch.setattr(one_model, "settle_ends", lambda *_: end())  # stop after the search
    call = ["fit", str(fabricated_csv(tmp_path)), "--starts", "2", "--out", "stopped"]
    out = CliRunner().invoke(main, call)
    assert (out.exit_code, out.stderr) == (0, "")
    assert "stopped by SIGTERM" in out.stdout.splitlines()[0]
    assert load_result(tmp_path / "stopped")["stopped"] == "SIGTERM"
    monkeypatch.setattr(one_model, "make_problem", lambda *_, **__: end())
    out = CliRunner().invoke(main, [*call, "--quiet"])
    assert (out.exit_code, out.stderr.strip()) == (143, "foamfit: ended by SIGTERM")


def test_the_figure_of_a_stopped_fit_says_so():
    stopped = fabricated.result(stopped="Ctrl-C")
    assert "stopped by Ctrl-C" in plot_fit(stopped).get_suptitle().replace("\n", " ")
    assert "stopped" not in plot_fit(fabricated.result()).get_suptitle()
    assert "stopped by Ctrl-C" in render_report(stopped, fabricated.no_figures())
    assert json.loads(json.dumps(fabricated.result().to_json_dict()))["stopped"] is None


def test_a_stopped_fit_is_never_ok(monkeypatch):
    from foamfit.fitting.search import SearchStoppedError
    from foamfit.trust import settle

    def stop(*_: object, **__: object) -> None:
        raise SearchStoppedError

    monkeypatch.setattr(settle, "refine", stop)
    result = ff.fit(synthetic_impact(samples=201)[1], starts=2)
    assert result.stopped == "the time limit"
    assert result.status == "warnings"


def fabricated_csv(folder):
    _, test = synthetic_impact(samples=201)
    path = folder / "foam-1-model-1.csv"
    table = np.column_stack([test.time, test.stress, test.displacement])
    np.savetxt(path, table, delimiter=",", header="time_s,stress_Pa,displacement_m", comments="")
    path.with_suffix(".toml").write_text(
        f'[specimen]\nheight = "{HEIGHT} m"\narea = "{AREA} m^2"\n'
        '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n'
    )
    return path
