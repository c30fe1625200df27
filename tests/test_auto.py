"""The ladder: runs test, effective parameters, known structures, interruption and output."""

import itertools
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import foamfit as ff
import records
from conftest import (
    loop_measurement,
    needs_data,
    run,
    run_refused,
    small_pictures,
    synthetic_impact,
    synthetic_loop,
    write_measurement,
)
from foamfit import auto, one_model
from foamfit.data.measurement import Specimen, Striker
from foamfit.fitting import search
from foamfit.springs import laws
from foamfit.springs.model import Model
from foamfit.trust import evidence
from foamfit.trust.best_point import BestPoint, branch_of_samples
from foamfit.trust.evidence import find_structure, neighbours_test, runs_test

HEIGHT, AREA = 1.2e-3, 1.9635e-5


def short_loop():
    """Return the loop of conftest with every second sample."""
    _, loop = synthetic_loop()
    return replace(loop, stress=loop.stress[::2], displacement=loop.displacement[::2])


def groups(*names, relaxation=0):
    """Return models to compare, each in a separate group."""
    return tuple((Model.parse(name, relaxation),) for name in names)


def test_the_runs_test_holds_its_level_and_sees_waves():
    rng = np.random.default_rng(0)
    p = np.array([runs_test(rng.standard_normal(400)) for _ in range(1000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.02)
    assert np.mean(p < 0.5) == pytest.approx(0.5, abs=0.06)
    wave = np.sin(np.linspace(0, 20, 400))
    assert runs_test(wave + 0.5 * rng.standard_normal(400)) < 1e-6
    assert runs_test(np.ones(11)) == pytest.approx(2.0**-10)
    assert runs_test(np.array([1.0, -1.0] * 50)) > 0.999  # alternating signs count as random
    assert runs_test(np.zeros(5)) == 1.0


def test_the_neighbours_test_holds_its_level_and_sees_a_short_wave():
    rng = np.random.default_rng(4)
    p = np.array([neighbours_test(rng.standard_normal(400)) for _ in range(1000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.02)
    short = rng.standard_normal(400)
    short[100:120] += 3.0
    assert neighbours_test(short) < 1e-4 < 1e-2 < runs_test(short)


def tried(residual, columns):
    """Return a fitted model of one curve with only the fields that `evidence` uses."""
    return SimpleNamespace(
        residual=residual,
        sizes=(residual.size,),
        curves=[residual],
        n_eff=residual.size / evidence.autocorrelation_time(residual),
        taus=[evidence.autocorrelation_time(residual)],
        chisqr=float(residual @ residual),
        grams=np.array([columns.T @ columns]),
    )


def test_combinations_are_not_counted_as_parameters():
    rng = np.random.default_rng(1)
    x = np.linspace(-1, 1, 600)
    noise = tried(rng.standard_normal(600), np.ones((600, 1)))
    apart = np.column_stack([np.ones_like(x), x, x**2])
    same = np.column_stack([apart, apart[:, 0] - apart[:, 1]])
    vague = np.column_stack([apart, 0.01 * x**3])  # the interval of its coefficient is about ±13
    counted = [
        evidence.effective_parameters(np.array([columns.T @ columns]), noise)
        for columns in (apart, same, vague)
    ]
    assert counted == [3, 3, 3]


def test_the_criteria_are_those_of_closed_form():
    """For white noise, AICc and BIC follow from n samples and k = 2 parameters."""
    residual = np.random.default_rng(2).standard_normal(500)
    columns = np.column_stack([np.ones(500), np.linspace(-1, 1, 500)])
    one = tried(residual, columns)
    found = evidence.criteria(one, one)
    fit = 500 * np.log(residual @ residual / 500)
    assert found.rank == 2
    assert found.aicc == pytest.approx(fit + 4 + 12 / 497, rel=1e-12)
    assert found.bic == pytest.approx(fit + 2 * np.log(500), rel=1e-12)


def test_correlated_residuals_are_less_evidence():
    """1000 samples with a lag-one correlation of 2/3 count as 200 independent samples."""
    rng = np.random.default_rng(3)
    small, large = (
        scale * lfilter([1.0], [1.0, -2.0 / 3.0], rng.standard_normal(1000)) for scale in (1.0, 1.1)
    )
    columns = np.ones((1000, 1))
    bic = [evidence.criteria(tried(r, columns), tried(small, columns)).bic for r in (large, small)]
    expected = 200.0 * np.log((large @ large) / (small @ small))
    assert bic[0] - bic[1] == pytest.approx(expected, rel=0.15)


def test_a_bent_structure_is_found_where_it_is():
    strain = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, 0, 200)])
    switches = np.array([[50, 1, 0, 1, 0], [150, 1, 1, 2, 0], [250, 1, 2, 3, 0]], dtype=float)
    problem = SimpleNamespace(
        model=SimpleNamespace(laws=[laws.law("linear"), laws.law("bistable")]),
        objective=SimpleNamespace(time=np.arange(400.0)),
        measurement=SimpleNamespace(stress=strain),
    )
    run = SimpleNamespace(motion=SimpleNamespace(switches=switches))
    places = branch_of_samples(problem, run)
    residual = 1e-3 * np.random.default_rng(0).standard_normal(400)
    residual[50:150] += 0.1 * (np.linspace(-1, 1, 100) ** 2 - 1 / 3)
    found = find_structure(residual, places)
    assert found.place == "loading, spring 2 on d"
    assert found.straight
    assert found.share > 0.99
    assert found.bent > 0.99
    rms = 0.1 * np.sqrt(4 / 45) * 0.5  # RMS of 0.1 (x² - 1/3) on a quarter of the samples
    assert found.size == pytest.approx(rms, rel=0.05)


def impact(springs, heights, velocity, samples=101):
    """Simulate an impact with noise of 0.5 %, whose level is not stated."""
    chain = ff.Chain(springs, heights, AREA)
    drive = ff.Impact(7e-3, velocity)
    long = ff.simulate(chain, drive, np.linspace(0, 20 * HEIGHT / velocity, 4001))
    time = np.linspace(0, 1.05 * long.contact_end, samples)
    run = ff.simulate(chain, drive, time)
    rng = np.random.default_rng(0)
    curves = [
        y + 0.005 * np.ptp(y) * rng.standard_normal(y.size)
        for y in (run.base_stress, run.displacement[-1])
    ]
    return loop_measurement(*curves, Specimen(HEIGHT, AREA), time, Striker(7e-3, velocity))


SPRING = ff.published["foam-1/model-1"].bistable
SOFT = ff.BistableSpring(
    k0=4e6, kc=60e6, dsigma=-0.4e6, eps_a=0.2, eps_c=0.5, kh_plus=4e6, kh_minus=1.2e6
)
STIFF = ff.BistableSpring(
    k0=15e6, kc=200e6, dsigma=-1.2e6, eps_a=0.2, eps_c=0.5, kh_plus=15e6, kh_minus=4e6
)
HALVES = [0.5 * HEIGHT] * 2
CASES = {
    "bistable with damping": ([replace(SPRING, eta=400.0)], [HEIGHT]),
    "linear+bistable without damping": ([ff.LinearSpring(12e6), SOFT], HALVES),
}


@pytest.mark.parametrize("name", CASES)
def test_a_clear_structure_is_found(name):
    test = impact(*CASES[name], velocity=2.6)
    result = ff.fit(test, model="auto", starts=2, intervals="local")
    assert result.ladder.chosen.name == name
    assert result.model == result.ladder.chosen.model
    assert result.misfit["stress_time"] == result.ladder.chosen.misfit["stress_time"]
    assert result.ladder.chosen.runs_p > 1e-3
    assert len([rung for rung in result.ladder.rungs if rung.chosen]) == 1


def test_two_bistable_springs_are_told_from_fewer(monkeypatch):
    """To save time, omit the model of a linear spring and hops from the best minimum."""
    monkeypatch.setattr(auto, "LADDER", groups("bistable", "bistable+bistable"))
    monkeypatch.setattr(search, "leave_minimum", lambda *_: [])
    test = impact([SOFT, STIFF], HALVES, velocity=4.5, samples=201)
    result = ff.fit(test, model="auto", starts=4, intervals="local")
    assert result.ladder.chosen.name == "bistable+bistable without damping"
    below = result.ladder.rungs[:2]
    assert all(rung.bic > result.ladder.chosen.bic + evidence.MARGIN for rung in below)
    assert result.ladder.rungs[0].neighbours_p < 1e-6


def choose_of(table, by_prediction, criteria=None):
    """Return the choice from a table of (parameters, fitted misfit, predicted misfit)."""
    scores = [evidence.Score(*row) for row in table]
    criteria = criteria or [evidence.Criteria(n, 0.0, 0.0) for n, *_ in table]
    return evidence.decide(scores, criteria, by_prediction)


def test_the_model_that_predicts_best_for_its_parameters_is_chosen():
    """The table is that of a shoe foam, with misfits in percent of the range."""
    foam = [
        (7, 2.35, 3.07),  # bistable
        (7, 1.20, 1.39),  # microscale
        (9, 2.36, 3.00),  # linear+bistable
        (9, 1.42, 2.06),  # bistable with relaxation
        (9, 0.63, 0.88),  # microscale with relaxation
        (15, 1.05, 1.08),  # bistable+bistable
        (17, 0.61, 0.80),  # predicts 9 % better with eight more parameters
    ]
    decision = choose_of(foam, by_prediction=True)
    assert decision.best == 4
    assert decision.before == (None, 0, 1, 1, 1, 4, 4)
    assert decision.ruled_out_by == (None, None, 0, 1, None, 4, None)
    assert choose_of([*foam, (11, 0.5, 0.82)], by_prediction=True).best == 7  # 6.8 % better
    assert choose_of([*foam, (11, 0.5, 0.84)], by_prediction=True).best == 4  # only 4.5 % better
    assert choose_of([*foam, (9, 0.9, 0.87)], by_prediction=True).best == 7  # equal count


def slow_loop(*, noise=0.003, wave=0.0, samples=150):
    """Simulate a 2 s loop with time on a relaxing microscale spring, plus a wave no model follows.

    Noise and wave amplitude are fractions of the stress range.
    """
    spring = ff.MicroscaleSpring(
        k0=5.5e5, kc=2.5e5, eps_star=0.08, sigma_plus=1.3e5, spread_plus=0.4, sigma_minus=5.5e4,
        spread_minus=0.77, relaxation=[(0.5, 0.2)],
    )  # fmt: skip
    time = np.linspace(0.0, 2.0, samples)
    strain = 0.5 * np.interp(time, [0.0, 1.0, 2.0], [0.0, 1.0, 0.02])
    drive = ff.DisplacementDrive(strain * HEIGHT)
    stress = ff.simulate(ff.Chain([spring], [HEIGHT], AREA), drive, time).base_stress
    rng = np.random.default_rng(0)
    off = noise * rng.standard_normal(time.size) + wave * np.sin(20.0 * time)
    stress += np.ptp(stress) * off
    return loop_measurement(stress, strain * HEIGHT, Specimen(HEIGHT, AREA), time)


def test_held_back_samples_are_predicted_by_a_fit_to_the_others():
    """Starting near the best point, the true model predicts noise-free curves exactly."""
    test = slow_loop(noise=0.0, samples=301)  # odd: one sample is exactly at the reversal
    found = one_model.identify(
        test, "microscale", None, one_model.Options(starts=4, relaxation=1), lambda *_: None
    )
    beside = BestPoint(found.problem, found.best().values * 1.02)
    assert evidence.misfit_of(beside.problem.objective, beside.residual) > 3e-3
    assert evidence.predicted_misfit(beside) < 3e-4


def test_a_microscale_spring_that_relaxes_is_found():
    result = ff.fit(slow_loop(), model="auto", starts=2, intervals="local")
    chosen = result.ladder.chosen
    assert chosen.name == "microscale with relaxation"
    assert (chosen.relaxation, result.relaxation) == (1, 1)
    assert not result.ladder.by_prediction
    assert chosen.why.startswith("its residuals are random")
    assert result.params["s1_g1"].value == pytest.approx(0.5, rel=0.1)
    assert result.params["s1_tau1"].value == pytest.approx(0.2, rel=0.15)
    assert chosen.predicted_misfit == pytest.approx(0.003, rel=0.3)
    assert chosen.gain > 0.5


def test_where_no_model_reaches_the_noise_prediction_decides(monkeypatch, tmp_path):
    few = (*groups("bistable", "microscale"), *groups("microscale", relaxation=1))
    monkeypatch.setattr(auto, "LADDER", few)
    result = ff.fit(slow_loop(wave=0.005), model="auto", starts=2, intervals="local")
    ladder = result.ladder
    assert ladder.by_prediction
    assert ladder.chosen.name == "microscale with relaxation"
    assert len(ladder.rungs) == 3
    for rung in ladder.rungs:
        assert rung.predicted_misfit >= 0.98 * rung.misfit["stress_strain"]
    small_pictures(monkeypatch)
    folder = result.save(tmp_path / "auto")
    content = json.loads((folder / "fit.json").read_text())["ladder"]
    assert [one["why"] for one in content["rungs"]] == [one.why for one in ladder.rungs]
    row = content["rungs"][2]
    assert (row["model"], row["relaxation"]) == ("microscale", 1)
    simpler = min(content["rungs"][:2], key=lambda rung: rung["predicted_misfit"])
    assert row["gain_over"] == simpler["model"]
    assert row["gain"] == pytest.approx(1.0 - row["predicted_misfit"] / simpler["predicted_misfit"])
    assert f"{100 * row['gain']:.0f} % less than {simpler['model']};" in ladder.chosen.why
    assert any("AICc and BIC are not valid" in sentence for sentence in ladder.sentences)
    assert any(text.startswith("Every model leaves system") for text in result.warnings)


@needs_data
def test_a_running_shoe_foam_ends_below_one_percent(thin_foams, tmp_path, monkeypatch):
    test = ff.read_test(records.place("turbo-comp-1", tmp_path, thin_foams))
    few = (*groups("bistable", "microscale"), *groups("microscale", relaxation=1))
    monkeypatch.setattr(auto, "LADDER", few)  # saves time
    result = ff.fit(test, model="auto", starts=2, intervals="local")
    assert result.misfit["stress_strain"] <= 0.009
    assert result.ladder.chosen.name == "microscale with relaxation"


def test_only_models_that_the_test_allows_are_tried(monkeypatch):
    tried = []

    def identify(_, model, __, options, *___):
        tried.append((model, options.relaxation))
        raise ff.SimulationError("not now")

    def models(test):
        """Return the models to try, without repetition, and the omitted models with reasons."""
        tried.clear()
        with pytest.raises(ff.SimulationError) as caught:
            ff.fit(test, model="auto")
        told = str(caught.value).split("no model could be tried: ")[1].split("; ")
        return list(dict.fromkeys(tried)), [why for why in told if not why.endswith("not now")]

    monkeypatch.setattr(one_model, "identify", identify)
    all_of_them = [(model.name, model.relaxation) for group in auto.LADDER for model in group]
    _, test = synthetic_impact()
    assert models(test) == (all_of_them, [])
    specimen = replace(test.specimen, heights=(0.6e-3, 0.59e-3))
    allowed, skipped = models(replace(test, specimen=specimen))
    assert allowed == [one for one in all_of_them if one[0].count("+") < 2]
    assert skipped == ["linear+bistable+bistable: [specimen] heights are those of 2 springs"]
    allowed, skipped = models(replace(test, interior={1: test.displacement * 0.4}))
    assert allowed == [one for one in all_of_them if "+" in one[0]]
    assert len(skipped) == 5
    assert all("motion was measured" in why for why in skipped)
    allowed, skipped = models(replace(synthetic_loop()[1], time=None))
    *first, two, slow, last = [one for one in all_of_them if one[1] == 0]
    assert allowed == [*first, slow, two, last]  # two microscale springs before two bistable ones
    assert skipped[0] == "bistable with relaxation: relaxation needs a time column"
    with pytest.raises(ff.InputError, match="no model of the ladder"):
        ff.fit(replace(test, interior={5: test.displacement}), model="auto")


def test_only_the_chosen_rung_gets_the_intervals_that_were_asked_for(monkeypatch):
    """Models are compared with local intervals, and options apply to every model."""
    given = []
    original = one_model.judge

    def watched(found, choice, *rest):
        given.append((found.problem.model.name, choice.method, found.record.seed))
        return original(found, choice, *rest)

    monkeypatch.setattr(auto.one_model, "judge", watched)
    result = ff.fit(short_loop(), model="auto", starts=2, intervals="profile", seed=3)
    assert given == [("bistable", "local", 3), ("bistable", "profile", 3)]
    known = [p for p in result.parameters.values() if p.ci95 is not None]
    assert {p.ci95_method for p in known} == {"profile likelihood"}
    # A drive without dampers has one rung for each model.
    assert [(rung.model, rung.damping) for rung in result.ladder.rungs] == [("bistable", "none")]
    assert result.ladder.ended == "the residuals are random"
    assert (result.status, result.seed) == ("ok", 3)


@pytest.fixture(scope="module")
def wavy():
    """Return a loop that no model follows because of a superposed wave of 5 %."""
    loop = short_loop()
    wave = 0.05 * np.ptp(loop.stress) * np.sin(np.linspace(0, 60, loop.stress.size))
    return replace(loop, stress=loop.stress + wave, name="synthetic loop with a wave")


def test_an_interrupted_ladder_keeps_what_is_done(wavy, monkeypatch):
    calls = 0
    original = one_model.identify

    def interrupted(*args):
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(auto.one_model, "identify", interrupted)
    result = ff.fit(wavy, model="auto", starts=2, intervals="local")
    assert [rung.name for rung in result.ladder.rungs] == ["bistable"]
    assert (result.stopped, result.ladder.stopped) == ("Ctrl-C", "Ctrl-C")
    assert result.status == "warnings"
    assert "stopped by Ctrl-C" in result.warnings[0]
    calls = 1
    with pytest.raises(KeyboardInterrupt):
        ff.fit(wavy, model="auto", starts=2)


def test_springs_in_series_are_not_searched_on_from_a_poor_first_search(monkeypatch, wavy):
    """Richer chains are then skipped too."""
    monkeypatch.setattr(auto, "UNPROMISING", 0.0)  # every first search counts as poor
    monkeypatch.setattr(
        auto, "LADDER", groups("bistable", "bistable+bistable", "linear+bistable+bistable")
    )
    ladder = ff.fit(wavy, model="auto", starts=2, intervals="local").ladder
    assert [rung.model for rung in ladder.rungs] == ["bistable"]
    first, richer = ladder.skipped
    assert first.startswith("bistable+bistable: its first descents miss the curves by ")
    assert richer == "linear+bistable+bistable: the first descents with bistable+bistable were poor"


def test_the_time_limit_is_shared_over_the_rungs(wavy, monkeypatch):
    """With a clock that advances 1 s per reading, each model gets less time than the one before."""
    now = itertools.count(0.0, 1.0)
    monkeypatch.setattr(auto.time, "monotonic", lambda: next(now))
    given = []
    original = one_model.identify

    def watched(measurement, model, params, options, *rest):
        given.append(options.max_time)
        return original(measurement, model, params, replace(options, max_time=None), *rest)

    monkeypatch.setattr(auto.one_model, "identify", watched)
    monkeypatch.setattr(auto, "predicted_misfit", lambda *_: 0.1)  # must not read the clock
    result = ff.fit(wavy, model="auto", starts=2, max_time=2.5)
    assert given == [1.5, 0.5]
    assert len(result.ladder.rungs) == 2
    assert result.stopped == "the time limit"


@pytest.fixture
def loop_file(here):
    return write_measurement(here / "loop.csv", short_loop())


def test_the_command_writes_to_auto(loop_file, tmp_path, monkeypatch):
    small_pictures(monkeypatch)
    done = run("fit", loop_file, "--model", "auto", "--starts", 2, "--verbose")
    assert "chosen of 1 model tried: bistable: its residuals are random" in done.stdout
    folder = tmp_path / "fits" / "loop" / "auto-starts-2"
    content = json.loads((folder / "fit.json").read_text())
    assert content["model"] == "bistable"
    assert [rung["chosen"] for rung in content["ladder"]["rungs"]] == [True]
    page = (folder / "report.html").read_text()
    assert "bistable was chosen of 1 model: it is the simplest" in page


def test_the_command_refuses_parameters_of_one_model(loop_file, tmp_path):
    for option in (("--fix", "s1_eta=0"), ("--vary", "s1_eta"), ("--relaxation", 2)):
        told = run_refused("fit", loop_file, "--model", "auto", *option)
        assert re.search("belongs? to one model", told)
    assert not (tmp_path / "fits").exists()
    with pytest.raises(ff.InputError, match="belong to one model"):
        ff.fit(synthetic_loop()[1], model="auto", params=ff.make_params(synthetic_loop()[1]))
