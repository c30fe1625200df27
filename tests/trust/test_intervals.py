"""Profiles and Markov chains compared with closed forms, each other and independent refits."""

import csv
import importlib.util
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.optimize import least_squares
from scipy.signal import lfilter

import foamfit as ff
from conftest import (
    RECONSTRUCTION,
    correlated,
    loop_measurement,
    run,
    run_refused,
    synthetic_impact,
)
from foamfit.data.measurement import Specimen, Striker
from foamfit.errors import InputError
from foamfit.fitting.objective import Spent
from foamfit.fitting.problem import Problem, make_params, make_problem
from foamfit.fitting.search import SearchRecord, Tracker
from foamfit.one_model import Found, judge
from foamfit.report import plots
from foamfit.report.plots import plot_profiles
from foamfit.results import Profile
from foamfit.trust import intervals
from foamfit.trust.best_point import BestPoint
from foamfit.trust.conclude import conclude
from foamfit.trust.intervals import Choice, assess, mcmc
from foamfit.trust.refits import trace
from foamfit.trust.residuals import NoiseProcess, noise_processes


def profile(best: BestPoint, name: str) -> Profile:
    return trace(best, name, Tracker(best.problem.objective))[0]


@dataclass(eq=False)
class Curve:
    """An objective in closed form with two parameters; `bend` makes it nonlinear."""

    time: np.ndarray
    data: np.ndarray
    bend: float = 0.0
    spent: Spent = field(default_factory=Spent)
    penalty: float = 1e3
    drive: str = "displacement"
    priors: tuple[()] = ()
    unit: float = 1.0
    by_motion = staticmethod(lambda _: None)  # its motion is exact

    def __post_init__(self) -> None:
        self.sizes = (self.time.size,)
        self.n_data = self.time.size

    def model(self, values: np.ndarray) -> np.ndarray:
        a, b = values
        return a + b * self.time + self.bend * b**2 * self.time**2

    def simulate(self, values: np.ndarray, *, everything: bool = False) -> np.ndarray:
        self.spent.evaluations += 1
        return self.model(values)

    def compare(self, curves: np.ndarray, values: np.ndarray) -> np.ndarray:
        return curves - self.data

    def residual(self, values: np.ndarray) -> np.ndarray:
        return self.compare(self.simulate(values), values)


@dataclass(eq=False)
class Bench:
    """A minimal problem for a `Curve`, with the attributes that `BestPoint` uses."""

    objective: Curve
    low: float = -100.0
    high: float = 100.0
    kept: Any = field(default_factory=dict)  # nothing is held
    index: Any = field(default_factory=lambda: {"a": 0, "b": 1})

    @property
    def params(self) -> dict[str, SimpleNamespace]:
        return {name: SimpleNamespace(min=self.low, max=self.high) for name in self.index}

    def sizes(self, names: tuple[str, ...], values: np.ndarray) -> np.ndarray:
        return np.ones(len(names))

    def space(self, absolute: tuple[str, ...] = ()) -> Any:
        """Each coordinate is the value of its parameter."""
        names, same, eye = tuple(self.index), lambda values: values, np.eye(len(self.index))
        self.objective.jacobian_along = lambda values, moves: self.slopes(values, names) @ moves
        places = [SimpleNamespace(place=place) for place in self.index.values()]
        by = {"complete": same, "encode": same, "decode": same, "slopes": lambda *_: eye}
        box = np.repeat([[self.low], [self.high]], len(names), axis=1)
        return SimpleNamespace(coordinates=places, box=box, **by)

    def slopes(self, values: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        """Differences, which are exact for parabolas."""
        model, steps = self.objective.model, np.eye(values.size)[[self.index[n] for n in names]]
        return np.column_stack([model(values + one) - model(values - one) for one in steps]) / 2.0


def curve(
    bend: float = 0.0, rho: float = 0.0, low: float = -100.0, slope: float = 0.3, n: int = 400
) -> BestPoint:
    """Return the best fit of a curve with noise of standard deviation 0.1."""
    rng = np.random.default_rng(5)
    time = np.linspace(-1, 1, n)
    bench = Bench(Curve(time, np.zeros(n), bend), low)
    noise = correlated(rng, n, rho)
    bench.objective.data = bench.objective.model(np.array([1.0, slope])) + 0.1 * noise
    best = least_squares(bench.objective.residual, [1.0, slope], xtol=1e-14, ftol=1e-14).x
    return BestPoint(bench, best, ("a", "b"))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def impact() -> BestPoint:
    """Best fit of a synthetic impact with a closed loop, started at the true values."""
    spring, measurement = synthetic_impact(samples=301)
    problem = make_problem(measurement, "bistable", "impact", None, None, False)
    problem.params["s1_eta"].set(value=0.0, vary=False)
    values = problem.vector()
    values[:9] = *spring.seven, 0.0, 0.0
    assert problem.free()[7:] == ("contact_time", "displacement_zero")
    return BestPoint(problem, _refitted(problem, values, problem.free()), problem.free())


def _refitted(problem: Problem, values: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Refit some of the parameters with SciPy's least squares and its finite differences."""
    places = [problem.index[name] for name in names]
    sizes = problem.sizes(names, values)

    def point(x: np.ndarray) -> np.ndarray:
        out = values.copy()
        out[places] = x * sizes
        return out

    def residual(x: np.ndarray) -> np.ndarray:
        return problem.objective.residual(point(x))

    start = values[places] / sizes
    found = least_squares(residual, start, jac="3-point", diff_step=1e-5, xtol=1e-12, ftol=1e-12)
    return point(found.x)


# ---------------------------------------------------------------- noise


def test_the_noise_process_finds_an_autoregression_of_second_order():
    rng = np.random.default_rng(0)
    noise = lfilter([1.0], [1.0, -1.2, 0.5], rng.standard_normal(20500))[500:]
    found = noise_processes(noise, np.empty((noise.size, 0)), (noise.size,))[0]
    assert found.coefficients == pytest.approx([1.2, -0.5], abs=0.03)
    assert found.variance == pytest.approx(noise.var(), rel=1e-3)


def test_the_product_with_the_covariance_matrix_is_that_of_the_matrix():
    process = NoiseProcess(np.array([0.6]), 2.0)
    n = 50
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    columns = np.random.default_rng(1).standard_normal((n, 3))
    assert process.times(columns) == pytest.approx((2.0 * 0.6**lags) @ columns, abs=1e-8)
    assert process.tau == pytest.approx(1.6 / 0.4, rel=1e-6)


# ---------------------------------------------------------------- profiles


@pytest.mark.parametrize("rho", [0.0, 0.7])
@pytest.mark.parametrize("name", ["a", "b"])
def test_the_profile_of_a_linear_problem_is_the_local_interval(name, rho):
    around = curve(rho=rho)
    found = profile(around, name)
    column = around.names.index(name)
    half = around.quantiles[column] * around.spread.stderr[column]
    assert found.ci95 == pytest.approx(
        (around.values[column] - half, around.values[column] + half), abs=1e-3 * half
    )
    expected = ((found.values - around.values[column]) / around.spread.stderr[column]) ** 2
    assert found.rises == pytest.approx(expected, abs=1e-6)


def test_a_limit_ends_an_interval():
    around = curve(low=0.29)
    found = profile(around, "b")
    assert found.ci95[0] == 0.29


def test_the_ends_of_a_profile_satisfy_the_cut_by_an_independent_refit(impact):
    """With ε_a fixed at either end of its interval, SciPy finds the same minimum cost."""
    name = "s1_eps_a"
    found = profile(impact, name)
    place = impact.problem.index[name]
    others = tuple(other for other in impact.names if other != name)
    unit = impact.spread.inflation[impact.names.index(name)]
    assert found.complete
    for end in found.ci95:
        start = found.points[np.argmin(np.abs(found.values - end))].copy()
        start[place] = end
        residual = impact.problem.objective.residual(_refitted(impact.problem, start, others))
        rise = (residual @ residual - impact.cost) / unit
        assert rise == pytest.approx(found.cut, rel=0.06)


def origin(seed: int, two: Callable[..., Any], slopes: Callable[..., Any]) -> BestPoint:
    """Return the point a = b = 0 of a cost of `two` residuals over 1/30, and 398 of noise."""
    noise = np.random.default_rng(seed).standard_normal(400)
    noise[:2] = 0.0

    class Two(Curve):
        def residual(self, values: np.ndarray) -> np.ndarray:
            return np.append(30.0 * np.array(two(*values)), self.data[2:])

    class TwoBench(Bench):
        def slopes(self, values: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
            return np.append(30.0 * np.array(slopes(*values)), np.zeros((398, 2)), axis=0)

    return BestPoint(TwoBench(Two(np.arange(400.0), noise)), np.zeros(2), ("a", "b"))


@pytest.mark.parametrize("method", ["auto", "profile"])
def test_an_interval_goes_on_to_a_minimum_that_is_as_good(method):
    """The cost x² (x-3)² has two minima; its residual is x (x-3), the other samples are noise."""
    slopes = lambda _, b: ((0.0, 2.0 * b - 3.0), (1.0, 0.0))  # noqa: E731
    around = origin(0, lambda a, b: (b * (b - 3.0), a), slopes)
    low, high = around.local("b")
    found = assess(around, Choice(method), minima=[np.array([0.0, 3.0])])
    assert found.ends["b"] == pytest.approx((low, 3.0 + high), rel=0.05)
    assert found.methods["b"] == "other minima"


@pytest.mark.parametrize("far", [True, False])
def test_a_value_far_outside_that_fits_almost_as_well_is_named(far):
    """The residual is linear in b up to 1.2 half widths; beyond, it is constant if `far`.

    There the best a changes with b, so that a refit with a fixed does not find these values of b.
    """

    def two(a: float, b: float) -> tuple[float, float]:
        beyond = max(b - 0.08, 0.0) if far else 0.0
        return a - 10.0 * beyond, b - beyond

    on, beyond = np.eye(2), np.array([[1.0, -10.0], [0.0, 0.0]])
    found = assess(origin(2, two, lambda _, b: beyond if far and b > 0.08 else on), Choice())
    half = 1.966 / 30.0
    assert found.ends == {}
    there = {"a": 10.0 * (3.0 * half - 0.08), "b": 3.0 * half} if far else {}
    assert found.elsewhere == pytest.approx(there, rel=0.1)


class _Interrupting(Tracker):
    """A tracker that raises Ctrl-C after a given number of evaluations."""

    left = 60

    def residual(self, values: np.ndarray) -> np.ndarray:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return super().residual(values)


def test_an_interrupted_profile_keeps_what_was_done(impact, monkeypatch):
    monkeypatch.setattr(intervals, "Tracker", _Interrupting)
    found = assess(impact, Choice("profile"))
    assert found.profiles[0].complete
    assert not found.profiles[-1].complete
    assert len(found.profiles) < len(impact.names)
    assert set(found.ends) == {p.name for p in found.profiles if p.complete}
    assert found.notes == ()  # the interrupt is a warning, since the profiles are incomplete
    assert "were stopped by Ctrl-C" in found.warnings[0]
    local = found.warnings[0].partition("the intervals of ")[2].removesuffix(" are local.")
    assert local.split(", ") == [name for name in impact.names if name not in found.ends]


# ---------------------------------------------------------------- Markov chains


def test_a_markov_chain_agrees_with_the_local_errors():
    pytest.importorskip("emcee")
    around = curve(rho=0.7)
    chain = mcmc(around, 600, seed=3)
    assert chain.samples.std(axis=0) == pytest.approx(around.spread.stderr, rel=0.15)
    assert chain.samples.mean(axis=0) == pytest.approx(
        around.values, abs=0.25 * float(around.spread.stderr.max())
    )
    assert "autocorrelation times" in chain.sentence()
    assert "too short" in mcmc(curve(), 100, seed=0).sentence()
    for seed in (3, 2**70):  # NumPy's legacy generators accept no seed above 2³²
        twice = [mcmc(around, 100, seed=seed).samples for _ in range(2)]
        assert np.array_equal(*twice)


class Levels(Curve):
    """A curve that determines b, but of a and c only the sum."""

    def model(self, values: np.ndarray) -> np.ndarray:
        a, b, c = values
        return a + c + b * self.time


def levels(kind: type[Curve] = Levels, names: tuple[str, ...] = ("a", "b", "c")) -> BestPoint:
    """Return the best point of a curve that does not determine a and c."""
    time = np.linspace(-1, 1, 400)
    data = 0.4 + 0.3 * time + 0.1 * np.random.default_rng(5).standard_normal(400)
    bench = Bench(kind(time, data), -1.0, 1.0, index={"a": 0, "b": 1, "c": 2})
    slope, level = np.polyfit(time, data, 1)
    best = np.array([0.5 * level, slope, 0.5 * level])
    return BestPoint(bench, best, names)  # type: ignore[arg-type]


def test_a_chain_runs_over_what_is_not_determined_within_its_limits():
    """Marginalising over an undetermined parameter leaves the errors of the others unchanged."""
    pytest.importorskip("emcee")
    around = levels()
    assert np.isnan(around.spread.stderr).tolist() == [True, False, True]
    a, b, c = mcmc(around, 1000, seed=1).samples.T
    assert np.ptp(a) > 1.0  # a + c = 0.4 with both in [-1, 1] allows a from -0.6 to 1
    assert max(np.abs(a).max(), np.abs(c).max()) <= 1.0
    error = 0.1 / np.sqrt(400)
    assert np.std(a + c) == pytest.approx(error, rel=0.15)
    assert np.std(b) == pytest.approx(error * np.sqrt(3.0), rel=0.15)
    found = assess(around, Choice("mcmc", 200))
    assert set(found.ends) == {"b"}
    (told,) = (*found.notes, *found.warnings)
    assert "does not determine a, c" in told


@pytest.mark.parametrize("method", ["profile", "mcmc"])
def test_nothing_is_drawn_where_nothing_is_determined(method):
    around = levels(names=("a", "c"))
    assert around.known == []
    before = around.problem.objective.spent.evaluations
    found = assess(around, Choice(method, 200))
    assert "determines no parameter" in found.warnings[0]
    assert found.ends == {}
    assert around.problem.objective.spent.evaluations == before
    by_default = assess(around, Choice())
    assert (by_default.ends, by_default.warnings) == ({}, ())


@pytest.mark.parametrize("after", [5, 900])
def test_ctrl_c_keeps_what_was_drawn(after, monkeypatch, capsys):
    """This includes Ctrl-C during the first draws; emcee's own message is suppressed."""
    monkeypatch.setattr(_Interrupting, "left", after)
    monkeypatch.setattr(intervals, "Tracker", _Interrupting)
    found = assess(levels(), Choice("mcmc", 5000))
    assert set(found.ends) == ({"b"} if after > 5 else set())
    assert found.notes == ()
    assert "stopped by Ctrl-C" in found.warnings[0]
    assert capsys.readouterr() == ("", "")


def test_says_in_one_sentence_that_emcee_is_missing(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'emcee, .* pip install "foamfit\[mcmc\]"'):
        Choice("mcmc", 1000)


# ---------------------------------------------------------------- in the result


def test_the_result_says_what_made_each_interval(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(plots, "plot_fit", lambda *_, **__: Figure())
    _, measurement = synthetic_impact(samples=201)
    told: list[str] = []
    result = ff.fit(measurement, starts=1, intervals="profile", tell=told.append)
    assert "simulations" in told[0]
    assert " s" in told[0]
    varied = [p for p in result.parameters.values() if p.ci95 is not None]
    assert {p.ci95_method for p in varied} <= {"profile likelihood", "other minima"}
    result.save(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert content["parameters"]["s1_kc"]["ci95_method"] == "profile likelihood"
    with (tmp_path / "out" / "profiles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows} == {p.name for p in result.intervals.profiles}
    report = (tmp_path / "out" / "report.html").read_text()
    assert "profile likelihood" in report
    assert "Profiles of the cost" in report
    figure = plot_profiles(result)
    labels = [ax.get_xlabel() for ax in figure.axes if ax.axison]
    assert len(labels) == len(result.intervals.profiles)


def test_the_command_makes_intervals_one_way_and_tells_the_cost(tmp_path: Path):
    call = ["fit", str(RECONSTRUCTION), "--starts", "2", "--out", str(tmp_path / "out")]
    told = run_refused(*call, "--profile", "--mcmc", "200")
    assert "--profile and --mcmc exclude each other" in told
    assert not (tmp_path / "out").exists()
    done = run(*call, "--mcmc", "100", "--json", "--no-report")
    assert "intervals by mcmc: 2626 simulations, about" in done.stderr
    content = json.loads(done.stdout)
    assert content["parameters"]["s1_kc"]["ci95_method"] == "MCMC"
    assert any("Markov chain of 26 walkers and 100 steps" in note for note in content["warnings"])


AGREED = SearchRecord(0, 8, 0.0, ((1.0, 8),))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["profile likelihood", "MCMC", "none"])
def test_an_interval_is_in_order_and_holds_its_value(impact, method, seed):
    """The given ends may lie on one side of the value, be swapped, or lie beyond the limits."""
    rng = np.random.default_rng(seed)
    ends, sizes = {}, impact.sizes * 10.0 ** rng.uniform(-6, 1, len(impact.names))
    for name, size in zip(impact.names, sizes, strict=True):
        value = impact.values[impact.index[name]]
        ends[name] = tuple(value + size * rng.uniform(-1, 1, 2))
    made = intervals.Intervals(ends, dict.fromkeys(ends, method))
    if method == "none":
        made = intervals.Intervals()
    problem, values = impact.problem, impact.values.copy()
    values[impact.index["s1_dsigma"]] = -1e-15
    for item in conclude(BestPoint(problem, values), AGREED, made).parameters.values():
        if item.ci95 is not None:
            assert item.ci95[0] <= item.value <= item.ci95[1]
            assert item.ci95[0] < item.ci95[1]
            assert item.stderr > 0.0


def test_what_is_within_rounding_of_its_limit_is_at_it(impact):
    problem, at = impact.problem, impact.index["s1_dsigma"]
    values = impact.values.copy()
    values[at] = -3e-15
    found = Found(problem, Tracker(problem.objective, best_values=values), AGREED)
    result, _ = judge(found, Choice("local"), lambda _: None)
    item = result.parameters["s1_dsigma"]
    assert (item.value, str(item.value)) == (0.0, "0.0")
    assert result.params["s1_dsigma"].value == 0.0
    assert item.state == "weak"
    assert "lies at its limit 0" in item.why
    assert item.ci95[1] == 0.0


def test_the_ends_of_a_profile_do_not_depend_on_rounding():
    """The curves of two springs determine only combinations of parameters: the cost is flat."""
    rng, time = np.random.default_rng(4), np.linspace(0.0, 8e-4, 301)
    foam = ff.BistableSpring(2.0510e6, 60.822e6, -0.39005e6, 0.34889, 0.62232, 6.7937e6, 1.1061e6)
    chain = ff.Chain([ff.LinearSpring(60e6), foam], [0.7e-3, 0.49e-3], 2e-5)
    run = ff.simulate(chain, ff.Impact(7e-3, 2.3), time)
    stress, motion = (
        curve + 0.01 * np.ptp(curve) * rng.standard_normal(time.size)
        for curve in (run.base_stress, run.displacement[-1])
    )
    measurement = loop_measurement(stress, motion, Specimen(height=1.19e-3, area=2e-5), time)
    measurement = replace(measurement, motion=None, striker=Striker(mass=7e-3, velocity=2.3))
    params = make_params(measurement, "linear+bistable", "impact")
    for known in ("contact_time", "displacement_zero"):
        params[known].set(value=0.0, vary=False)
    problem = make_problem(measurement, "linear+bistable", "impact", params, None, False)
    best = np.array([38.871e6, 0.0, 3.56346e6, 89.8142e6, -270282.0, 0.214886, 0.399398, 10.6933e6,
                     1.68852e6, 0.0, 0.424033e-3, 0.765967e-3, 0.229676])  # fmt: skip
    best = np.append(best, problem.vector()[best.size :])
    ends = []
    for seed in range(3):
        rounding = 1e-12 * seed * np.random.default_rng(seed).standard_normal(best.size)
        here = BestPoint(problem, best * (1.0 + rounding))
        ends.append(profile(here, "s2_kh_plus").ci95)
    assert np.ptp(ends, axis=0) == pytest.approx(0.0, abs=1e-6 * np.ptp(ends[0]))
