"""Separation of noise from errors of the law, and the ranges that such errors cause."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import binom

import foamfit as ff
import law_error
import real_foams
import records
from conftest import DATA, correlated, loop_measurement, needs_data
from foamfit.api import FitResult
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.fitting import search
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import Tracker
from foamfit.one_model import Options, identify, judge
from foamfit.report.folder import load_result
from foamfit.report.render import readable
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import RULE, Block, Uncertainty, covariance
from foamfit.trust.intervals import Choice
from foamfit.trust.refits import ALIKE, Refit, ends_alike, left_open, refits_alike, tolerance
from foamfit.trust.residuals import NoiseProcess, curve_errors


def wave(n: int) -> np.ndarray:
    """Return a slow residual with kinks, orthogonal to all polynomials of degree 7, of unit RMS."""
    x = np.linspace(-1, 1, n)
    kinks = np.abs(x + 0.4) - 1.7 * np.abs(x - 0.1) + np.abs(x - 0.6)
    basis = np.polynomial.legendre.legvander(x, 7)
    kinks -= basis @ np.linalg.lstsq(basis, kinks, rcond=None)[0]
    return kinks / kinks.std()


def of(residual: np.ndarray):
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, residual.size), 7)
    residual = residual - basis @ np.linalg.lstsq(basis, residual, rcond=None)[0]
    return curve_errors(residual, basis, (residual.size,))[0]


@pytest.mark.parametrize("rho", [0.0, 0.5, 7 / 9, 0.9])
@pytest.mark.parametrize("n", [300, 1000])
def test_noise_of_first_order_is_no_error_of_the_law(n, rho):
    """Nine records per case, all of them noise only."""
    rng = np.random.default_rng(11)
    found = [of(correlated(rng, n, rho)) for _ in range(9)]
    assert not any(one.found for one in found)
    assert all(one.evidence < 0.0 for one in found)


def test_noise_that_one_curve_leaves_in_an_exact_one_is_no_error_of_the_law():
    """An impact with a displacement of 1 µm was said to be missed by the law."""
    n, rng = 400, np.random.default_rng(3)
    slopes = np.concatenate([np.polynomial.legendre.legvander(np.linspace(-1, 1, n), 7)] * 2)
    noise = rng.standard_normal(2 * n) * np.repeat([1.0, 1e-3], n)
    residual = noise - slopes @ np.linalg.lstsq(slopes, noise, rcond=None)[0]
    assert np.std(residual[n:]) > 10.0 * 1e-3  # by noise of the first curve
    found = curve_errors(residual, slopes, (n, n))
    assert not any(one.found for one in found)
    assert found[1].noise.variance == pytest.approx(1e-6, rel=0.5)
    residual[n:] += 0.05 * wave(n)  # which the parameters do not follow
    assert curve_errors(residual, slopes, (n, n))[1].found


@pytest.mark.parametrize("size", [1.0, 3.0, 30.0])
def test_the_noise_beside_an_error_of_the_law_is_that_of_the_high_frequencies(size):
    rng = np.random.default_rng(3)
    found = [of(size * wave(800) + correlated(rng, 800, 0.0)) for _ in range(5)]
    assert all(one.found for one in found)
    power = [one.noise.variance * one.noise.tau for one in found]
    assert np.mean(power) == pytest.approx(1.0, rel=0.1)
    assert np.mean([one.law for one in found]) == pytest.approx(size, rel=0.15)


@pytest.mark.parametrize(("n", "size"), [(60, 10.0), (60, 100.0), (100, 30.0), (300, 100.0)])
def test_a_short_record_does_not_leave_the_noise_too_small(n, size):
    """The spectrum alone left a hundredth of it beside a large error of the law."""
    rng = np.random.default_rng(5)
    found = [of(size * wave(n) + correlated(rng, n, 0.0)) for _ in range(20)]
    assert all(one.found for one in found)
    sigma = [math.sqrt(one.noise.variance) for one in found]
    assert min(sigma) > 0.4
    assert 0.75 < np.median(sigma) < 1.25


def test_an_error_below_that_of_the_simulation_is_none():
    assert not of(1e-3 * wave(800)).found
    assert curve_errors(np.zeros(100), np.ones((100, 1)), (100,))[0].evidence is None
    assert curve_errors(np.ones(20), np.ones((20, 1)), (20,))[0].evidence is None


def test_the_curvature_that_a_residual_leaves_is_in_the_covariance():
    """The curves b² t and 5 b cannot fit the data; White's formula gives the variance of b.

    With J = (2 b t, 5) the Hessian is H = JᵀJ + 2 Σ t r, where r is the residual of the first
    curve.
    """
    t = np.linspace(0.0, 1.0, 400)
    y = 0.3 * t + 0.5 * np.sin(9.0 * t)

    def residual(b: np.ndarray) -> np.ndarray:
        return np.concatenate([b[0] ** 2 * t - y, np.full(400, 5.0 * (b[0] - 1.0))])

    def slopes(b: np.ndarray) -> np.ndarray:
        return np.concatenate([2.0 * b[0] * t, np.full(400, 5.0)])[:, None]

    best = least_squares(residual, [0.8], jac=slopes, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    left, jacobian = residual(best), slopes(best)
    white = [NoiseProcess(np.empty(0), 1e-4)] * 2
    block = Block(
        jacobian, (400, 400), white, np.eye(1),
        lambda step: slopes(best + step).T @ residual(best + step),
    )  # fmt: skip
    one = Uncertainty((block,), np.ones(1))
    found, plain = one.bent.sandwich, one.sandwich
    square = float(np.sum(jacobian**2))
    curvature = square + 2.0 * float(t @ left[:400])
    assert abs(curvature / square - 1.0) > 5e-3
    assert found.matrix[0, 0] == pytest.approx(1e-4 * square / curvature**2, rel=1e-4)
    # On a parabola of the cost, an increase by one unit of χ² corresponds to one standard error.
    assert found.inflation[0] == pytest.approx(found.matrix[0, 0] * curvature, rel=1e-4)
    assert one.covariance.matrix[0, 0] == pytest.approx(max(plain.matrix[0, 0], found.matrix[0, 0]))


# ---------------------------------------------------------------- on tests


@cache
def micro(draw: int | None, law: str = "microscale and relaxation") -> Measurement:
    """Return half the samples of a test of another law; `draw` adds 0.5 % noise to the stress."""
    curves = law_error.curves(law)
    stress = curves.stress[::2]
    if draw is not None:
        white = np.random.default_rng([4, draw]).standard_normal(stress.size)
        stress = stress + 0.005 * np.ptp(stress) * white
    specimen = Specimen(curves.height, curves.area)
    return loop_measurement(stress, curves.displacement[::2], specimen, curves.time[::2])


@cache
def fitted(draw: int | None):
    found = identify(micro(draw), "bistable", None, Options(), lambda *_: None)
    return *judge(found, Options().choice, lambda _: None), found


@cache
def strikes(kind: str) -> Problem:
    """Return the problem of a noise-free impact on a foam of another law or of the fitted law."""
    curves = law_error.curves(kind)
    stress, motion, time = (x[::2] for x in (curves.stress, curves.displacement, curves.time))
    test = loop_measurement(stress, motion, Specimen(curves.height, curves.area), time)
    test = replace(test, striker=Striker(*curves.striker))
    return make_problem(test, "bistable", "impact", None, None, False)


def refitted(problem: Problem, values: np.ndarray, names: tuple[str, ...]) -> BestPoint:
    refit = Refit(BestPoint(problem, values, names), Tracker(problem.objective))
    end = refit.descend(refit.space.encode(values), refit.box, 40)
    return BestPoint(problem, refit.values(end), names)


@pytest.mark.parametrize("kind", ["rate effect", "own law"])
def test_the_interval_holds_the_best_fit_without_noise(kind):
    """At 95 % coverage, 14 or fewer of 20 independent intervals of k_c succeed with p < 1e-3.

    The intervals are at most 2.5 times as wide as the scatter of refits implies. They would be
    much wider if the systematic residual of the rate effect were treated as correlated noise.
    """
    assert binom.cdf(14, 20, 0.95) < 1e-3
    clean = strikes(kind)
    names, start = clean.free()[:7], clean.vector()
    start[:9] = *law_error.SPRING.seven, 0.0, 0.0  # contact and zeros are known
    best = refitted(clean, start, names)
    column, at = names.index("s1_kc"), best.index["s1_kc"]
    values, halves, found, old = [], [], 0, []
    for draw in range(20):
        rng = np.random.default_rng([9, draw])
        test = clean.measurement
        stress, motion = (
            x + 0.005 * np.ptp(x) * rng.standard_normal(x.size)
            for x in (test.stress, test.displacement)
        )
        noisy = replace(test, stress=stress, displacement=motion, noise=Noise())
        around = refitted(
            make_problem(noisy, "bistable", "impact", None, None, False), best.values, names
        )
        values.append(around.values[at])
        halves.append(around.halves[column])
        found += around.misfits
        plain = covariance(
            around.jacobian, around.residual, around.problem.objective.sizes, around.sizes
        )
        old.append(plain.stderr[column])
    held = np.abs(np.array(values) - best.values[at]) <= halves
    assert held.sum() > 14
    assert 0.5 < np.median(halves) / (1.96 * np.std(values, ddof=1)) < 2.5
    if kind == "own law":
        assert found == 0
    else:
        assert found > 14
        assert np.median(old) > 2.5 * np.std(values, ddof=1)


def test_every_description_in_the_range_follows_the_curves_about_as_well():
    result, best, found = fitted(0)
    assert best.misfits
    points = ends_alike(best, found.tracker.ends, found.tracker)
    points += refits_alike(best, found.tracker, np.inf)
    costs = [float(np.sum(best.problem.objective.residual(point) ** 2)) for point in points]
    law = sum(n * e.law**2 for e, n in zip(best.errors, best.problem.objective.sizes, strict=True))
    assert tolerance(best) == pytest.approx((ALIKE**2 - 1.0) * law)
    assert max(costs) <= best.cost + 1.001 * tolerance(best)
    assert len(points) > 10
    opened = left_open(best, found.tracker.ends, found.tracker)
    for name, item in result.parameters.items():
        if item.range is not None:
            assert item.range == pytest.approx(opened.ranges[name], rel=0.05, abs=1e-3)
            assert item.range[0] <= item.value <= item.range[1]
            assert item.ci95 is None or np.ptp(item.range) > 0.0


def test_ranges_contain_the_ends_of_hops_that_follow_the_curves_about_as_well():
    """Of two springs that follow half of a record, those of the other half lay outside."""
    _, best, found = fitted(0)
    far, objective = next(refits_alike(best, found.tracker, np.inf)), best.problem.objective
    worse = best.values.copy()
    worse[best.places] *= 0.5
    alone, more = (
        left_open(best, (), Tracker(objective, met=met), budget=0.0).ranges
        for met in ([], [far, worse])
    )
    assert not alone[best.names[0]][0] <= far[best.places[0]]
    assert more[best.names[0]][0] == pytest.approx(far[best.places[0]])
    for name, value in zip(best.names, worse[best.places], strict=True):
        assert more[name][0] > value or value <= 0.0


@pytest.mark.parametrize("led", [False, True])
def test_hops_of_springs_in_series_are_kept_for_their_ranges(led, monkeypatch):
    monkeypatch.setattr(search, "LONG", 20)
    _, best, one = fitted(0)
    assert not one.tracker.met
    given = best.problem.measurement, "bistable+bistable", None, Options(starts=2)
    found = identify(*given, lambda *_: None, below=one if led else None)
    if led:  # the search has combined springs of the poorer model, and hops only here
        judge(found, Choice(), lambda _: None)
    assert len(found.tracker.met) > 5


def test_the_result_says_what_was_decided(tmp_path):
    result, *_ = fitted(0)
    told = result.noise["stress_strain"]
    assert told["law_error_evidence"] > 10.0
    missed = result.misfit["stress_strain"] * told["range"]
    assert told["law_error"] == pytest.approx(missed, rel=0.1)
    (check,) = [check for check in result.checklist if check.key == "noise"]
    assert check.answer is False
    assert "the law misses" in check.warnings[0]
    folder = FitResult(**vars(result)).save(tmp_path / "out")
    kept = load_result(folder)["parameters"]["s1_kc"]
    assert kept["range"] == pytest.approx(result.parameters["s1_kc"].range)
    header = (folder / "parameters.csv").read_text().splitlines()[0]
    assert header.split(",")[3:7] == ["ci95_lo", "ci95_hi", "range_lo", "range_hi"]
    report = (folder / "report.html").read_text()
    assert all(line.replace("'", "&#39;") in report for line in RULE)


def test_a_fit_that_errs_is_not_weighed_by_the_noise_of_its_motion():
    """Such weights moved k_c by 1 %, which is twice its interval."""
    test, rng = micro(0), np.random.default_rng(1)
    noisy = test.displacement + 0.003 * np.ptp(test.displacement) * rng.standard_normal(465)
    found = ff.fit(replace(test, displacement=noisy, noise=Noise()), starts=4, intervals="local")
    assert found.weighed_at == ()


@pytest.mark.parametrize("friction", [0.0, 0.01])
def test_there_is_no_range_where_the_law_follows_the_curves(friction):
    rng = np.random.default_rng(0)
    curves = law_error.curves("own law")
    rubs = friction * np.sign(np.gradient(curves.displacement))
    stress = curves.stress + np.ptp(curves.stress) * (rubs + 0.005 * rng.standard_normal(501))
    specimen = Specimen(curves.height, curves.area)
    test = loop_measurement(stress, curves.displacement, specimen, curves.time)
    result = ff.fit(test, starts=4)
    if friction:
        found = BestPoint(result.problem, result.problem.vector()).friction
        assert found[0] == pytest.approx(friction * np.ptp(curves.stress), rel=0.3)
        assert any("as by friction" in warning for warning in result.warnings)
        return
    assert all(item.range is None for item in result.parameters.values())
    assert result.noise["stress_strain"]["law_error"] is None
    assert readable("s1_kc", result.parameters["s1_kc"]).range == ""


@needs_data
def test_twins_get_the_same_states(thin_foams, tmp_path):
    states, values = {}, {}
    for specimen in ("turbo-comp-1", "turbo-comp-2", *records.HEELS):
        foam, test = specimen[:-2], ff.read_test(records.place(specimen, tmp_path, thin_foams))
        for name, item in real_foams.varied(ff.fit(test, starts=2)).items():
            states.setdefault((foam, name), []).append(item.state)
            values.setdefault((foam, name), []).append(item.value)
    scatter = {key: np.std(own, ddof=1) / abs(np.mean(own)) for key, own in values.items()}
    same = [max(map(own.count, own)) for own in states.values()]
    assert sum(same) >= 0.85 * sum(map(len, states.values()))
    near = [state for key, own in states.items() if scatter[key] <= 0.15 for state in own]
    close = [state for key, own in states.items() if scatter[key] <= 0.10 for state in own]
    assert near.count("not determined") <= 0.05 * len(near)
    assert close.count("determined") >= 2 / 3 * len(close)
    assert not any("determined" in own for key, own in states.items() if scatter[key] > 0.5)


@needs_data
@pytest.mark.parametrize(
    ("name", "model", "terms"), [("tpu87-20", "bistable", 0), ("tpu87-50", "microscale", 1)]
)
def test_a_slow_error_of_the_law_in_a_short_record_is_no_noise(name, model, terms, tmp_path):
    """The spectrum of 100 samples alone took residuals of 41 and 9 times the noise for noise."""
    test = ff.read_test(records.place(name, tmp_path, DATA), cycle=1)
    found = ff.fit(test, model=model, relaxation=terms, starts=4, intervals="local")
    told = found.noise["stress_strain"]
    assert told["law_error"] > 0.8 * found.misfit["stress_strain"] * told["range"]
    assert told["law_error"] > 5.0 * told["sigma"]


@needs_data
def test_an_uncertain_motion_is_no_excuse_for_an_error_of_the_law(tmp_path):
    """Weighed by the motion's noise, this fit once missed by 1.3 % (record: study of damage)."""
    test = ff.read_test(records.place("tpu87-35", tmp_path, DATA), cycle=10)
    found = ff.fit(test, model="microscale", relaxation=1, starts=4, intervals="local")
    assert found.misfit["stress_strain"] < 0.0035
