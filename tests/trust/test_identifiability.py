"""Identifiability, checked by closed forms, energy, an independent integration and refits."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import foamfit as ff
from conftest import AREA, HEIGHT, loop_measurement, synthetic_impact, synthetic_loop
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.fitting.objective import Spent
from foamfit.fitting.problem import Problem, make_params, make_problem
from foamfit.fitting.search import SearchRecord
from foamfit.report.comparison import published_side
from foamfit.report.summary import summary_text
from foamfit.results import Intervals
from foamfit.trust.best_point import BestPoint
from foamfit.trust.conclude import conclude
from foamfit.trust.identifiability import Insight

AGREED = ((1.0, 5), (4.0, 2))


def problem_of(
    measurement: Measurement, model: str = "bistable", *, damped: bool = False, **given: Any
) -> Problem:
    """Return a problem with dampers fixed at zero unless `damped`."""
    drive = given.pop("drive", None)
    params = make_params(measurement, model, drive)
    if not damped:
        for name in params:
            if name.endswith("eta"):
                params[name].set(value=0.0, vary=False)
    for name, changed in given.items():
        params[name].set(**changed)
    return make_problem(measurement, model, drive, params, None, interior_mass=False)


def values_of(problem: Problem, *springs: ff.BistableSpring, **given: float) -> np.ndarray:
    values = problem.vector()
    for i, spring in enumerate(springs, start=1):
        for short in ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta"):
            values[problem.model.index[f"s{i}_{short}"]] = getattr(spring, short)
    for name, value in given.items():
        values[problem.model.index[name]] = value
    return problem.space().complete(values)


def concluded_of(problem: Problem, spring: ff.BistableSpring, *more: Any) -> Any:
    """Return the conclusions at the parameters of one spring."""
    found = BestPoint(problem, values_of(problem, spring))
    return conclude(found, *more or (SearchRecord(0, 8, 0.0, AGREED),))


def insight_of(scaled: np.ndarray, values: np.ndarray | None = None) -> Insight:
    """Return an insight for given sensitivities of one curve."""
    n, k = scaled.shape
    values = np.ones(k) if values is None else values
    halves = (scaled[: n // 2], scaled[n // 2 :])
    triangles = np.array([np.linalg.qr(half, mode="r") for half in halves])
    parts = (("stress_time", "a"), ("stress_time", "d"))
    return Insight(tuple("pqrst"[:k]), values, np.abs(values), parts, triangles)


# ---------------------------------------------------------------- directions in words


def test_two_springs_in_series_show_only_their_compliance() -> None:
    """A slow loop only determines the compliance C = h/k_1 + (H-h)/k_2.

    The powers of the combination are the logarithmic derivatives of C.
    """
    k, h = (8e6, 3e6), 0.3 * HEIGHT
    compliance = h / k[0] + (HEIGHT - h) / k[1]
    strain = np.concatenate([np.linspace(0, 0.3, 150), np.linspace(0.3, 0.0, 150)[1:]])
    rng = np.random.default_rng(2)
    stress = strain * HEIGHT / compliance + 2e3 * rng.standard_normal(strain.size)
    test = loop_measurement(stress, strain * HEIGHT, Specimen(HEIGHT, AREA))
    test = replace(test, noise=Noise(2e3))
    problem = problem_of(test, "linear+linear")
    values = values_of(problem, s1_k0=k[0], s2_k0=k[1], s1_height=h)
    result = conclude(BestPoint(problem, values), SearchRecord(0, 1, 0.0, AGREED))
    slopes = {
        "s1_k0": -(h / k[0]) / compliance,
        "s2_k0": -((HEIGHT - h) / k[1]) / compliance,
        "s1_height": h * (1 / k[0] - 1 / k[1]) / compliance,
    }
    power = {name: abs(s / slopes["s2_k0"]) for name, s in slopes.items()}
    wanted = f"s2_k0·s1_height^{power['s1_height']:.2g}·s1_k0^{power['s1_k0']:.2g}"
    for name in slopes:
        item = result.parameters[name]
        assert (item.state, item.stderr, item.ci95) == ("not determined", None, None)
        assert item.why == f"the data fix only {wanted}"
    said = next(w for w in result.warnings if w.startswith("Not determined"))
    assert all(name in said for name in slopes)
    assert said.count(wanted) == 1 or all(f"{n} (" in said for n in slopes)


X = np.linspace(0.0, 1.0, 60)


@pytest.mark.parametrize(
    ("columns", "values", "said"),
    [
        ((X, X, 1 - X), (1.0, 1.0, 1.0), "the data fix only p·q"),
        ((X, -X, 1 - X), (1.0, 1.0, 1.0), "the data fix only p/q"),
        ((2 * X, -X, 1 - X), (1.0, 1.0, 1.0), "the data fix only p/q^0.5"),
        ((2 * X, -X, 1 - X), (1.0, -3.0, 1.0), "the data fix only p·q^0.5"),
        ((X, X**2, X + 2 * X**2), (1.0, 1.0, 1.0), "compensated by q (+2), r (−1)"),
        ((0 * X, 0 * X, 1 - X), (1.0, 1.0, 1.0), ""),
    ],
)
def test_a_combination_is_named_with_its_powers(
    columns: tuple[np.ndarray, ...], values: tuple[float, ...], said: str
) -> None:
    told = insight_of(100 * np.column_stack(columns), np.array(values)).combination("p", 1.0)
    assert told == said or ("compensated" in said and said in told)


def test_the_weakest_direction_is_told_in_words() -> None:
    alike = insight_of(np.column_stack([X, X * (1 + 1e-3 * X), 50 * (1 - X)]))
    error, parts = alike.weakest()
    assert parts == pytest.approx({"p": -1.0, "q": 1.0}, rel=2e-3) or parts == pytest.approx(
        {"p": 1.0, "q": -1.0}, rel=2e-3
    )
    assert error > 100.0
    assert "The least determined combination is a joint" in alike.sentence()
    alone = insight_of(np.column_stack([30 * X, 1 - X]))
    assert alone.sentence().startswith("The least determined parameter is q: its standard error is")
    nothing = insight_of(np.column_stack([X, 0 * X]))
    assert "is q: the curves do not depend on it" in nothing.sentence()
    assert np.isnan(nothing.shares()[1]).all()


def test_the_shares_of_the_information_add_up_and_lie_where_the_branch_is() -> None:
    spring, test = synthetic_impact()
    result = concluded_of(problem_of(test, drive="displacement"), spring)
    parts, shares = result.insight.parts, result.insight.shares()
    assert np.sum(shares, axis=1) == pytest.approx(np.ones(len(result.insight.names)))
    where = {
        name: {branch: float(shares[i, j]) for j, (_, branch) in enumerate(parts)}
        for i, name in enumerate(result.insight.names)
    }
    # With the motion given, only the samples on a branch depend on the stiffness of this branch.
    assert where["s1_kh_minus"]["e"] > 0.99
    assert where["s1_kh_plus"]["d"] > 0.99
    assert where["s1_kc"]["c"] > 0.99
    assert where["s1_k0"]["a"] > 0.99


# ---------------------------------------------------------------- the checklist


def concluded(
    measurement: Measurement | None = None,
    record: dict[str, Any] | None = None,
    intervals: Intervals | None = None,
    **given: Any,
) -> Any:
    """Return the conclusions at the true parameters of a synthetic impact."""
    spring, test = synthetic_impact(samples=201)
    problem = problem_of(test if measurement is None else measurement, **given)
    found = SearchRecord(0, 8, 0.0, **({"costs": AGREED} | (record or {})))
    return concluded_of(problem, spring, found, intervals)


def answers(result: Any) -> dict[str, bool | None]:
    return {check.key: check.answer for check in result.checklist}


def test_a_good_fit_passes_every_question() -> None:
    result = concluded()
    found = answers(result)
    assert found.pop("damping") is None  # does not apply to an impact
    assert set(found.values()) == {True}
    assert (result.status, result.warnings) == ("ok", ())
    assert summary_text(result, verbose=True).count("\nyes  ") == len(found)


def _wave(test: Measurement) -> Measurement:
    swing = 2.0 * test.noise.stress * np.sin(np.linspace(0, 12, test.time.size))
    return replace(test, stress=test.stress + swing)


SPOILT = {
    "ended": {"record": {"stopped": "the time limit"}},
    "agree": {"record": {"costs": ((1.0, 1), (2.0, 6))}},
    "followed": {"change": lambda t: replace(t, stress=t.stress[::-1].copy())},
    "noise": {"change": lambda t: replace(t, noise=Noise(t.noise.stress / 2, None))},
    "noise by structure": {"change": _wave},
    "visited": {"change": lambda _: synthetic_impact(velocity=1.75, samples=201)[1]},
    "determined": {"change": lambda _: synthetic_impact(velocity=1.75, samples=201)[1]},
    "bounds": {"s1_kh_minus": {"min": ff.published["foam-1/model-1"].bistable.kh_minus}},
    "energy": {"change": lambda t: replace(t, striker=Striker(6e-3, 2.0)), "drive": "displacement"},
    "impulse": {"change": lambda t: replace(t, striker=Striker(8e-3, 2.0))},
}  # fmt: skip


@pytest.mark.parametrize("key", SPOILT)
def test_each_question_is_answered_no_by_what_deserves_it(key: str) -> None:
    given = dict(SPOILT[key])
    change = given.pop("change", None)
    test = synthetic_impact(samples=201)[1]
    result = concluded(None if change is None else change(test), **given)
    assert answers(result)[key.split()[0]] is False
    assert result.status == ("failed" if key == "followed" else "warnings")
    assert result.warnings
    told = result.to_json_dict()["checklist"]
    assert all({"question", "answer", "sentence"} <= set(item) for item in told)
    assert sum(item["answer"] is False for item in told) >= 1


def test_trials_that_fail_and_masses_that_ring_are_asked_after() -> None:
    spring, test = synthetic_impact(samples=201)
    problem = problem_of(test)
    problem.objective.spent = Spent(10, 90)
    result = concluded_of(problem, spring)
    assert answers(result)["simulated"] is False
    item = ff.published["foam-1/model-3"]
    heavy = replace(test, specimen=Specimen(HEIGHT, AREA, 5.56e-6, item.chain.heights))
    params = make_params(heavy, "linear+bistable")
    problem = make_problem(heavy, "linear+bistable", None, params, None, interior_mass=True)
    known = {name: p.value for name, p in published_side("foam-1/model-3").estimates.items()}
    values = problem.vector()
    for name in problem.model.names:
        values[problem.model.index[name]] = 0.0 if name.endswith("eta") else known[name]
    values = problem.space().complete(values)
    result = conclude(BestPoint(problem, values), SearchRecord(0, 8, 0.0, AGREED))
    assert answers(result)["vibration"] is False
    assert "determined" not in {p.state for p in result.parameters.values()}


def test_a_profile_much_narrower_than_the_local_interval_is_not_taken() -> None:
    """A profile is too narrow if its refits stall where the cost is flat."""
    local = concluded().parameters["s1_k0"]
    half = (local.ci95[1] - local.ci95[0]) / 2
    ends = {"s1_k0": (local.value - 0.1 * half, local.value)}
    found = concluded(intervals=Intervals(ends, {"s1_k0": "profile likelihood"})).parameters[
        "s1_k0"
    ]
    assert (found.ci95, found.stderr) == (local.ci95, local.stderr)
    assert found.ci95_method == "local covariance"
    assert "was not used" in found.why


def test_what_the_test_does_not_say_is_neither_yes_nor_no() -> None:
    spring, test = synthetic_loop()
    result = concluded_of(problem_of(test, drive="displacement"), spring)
    assert answers(result)["energy"] is None
    assert answers(result)["impulse"] is None
    assert answers(result)["noise"] is True  # since the noise is estimated from the record
    assert result.status == "ok"


def test_a_damper_that_may_be_none_is_not_called_determined() -> None:
    spring, test = synthetic_impact(eta=8.0)
    result = concluded_of(problem_of(test, damped=True), spring)
    item = result.parameters["s1_eta"]
    assert item.ci95[0] == 0.0
    assert item.state == "weak"
    assert item.why.startswith("it is consistent with zero; upper bound ")
    # A small upper bound is reported, but is not a reason for a warning.
    assert result.status == "ok"
    told = next(check for check in result.checklist if check.key == "determined")
    expected = "7 of 8 are determined; consistent with zero, with a small upper bound: s1_eta."
    assert told.sentence == expected
    spring, test = synthetic_impact(eta=60.0)
    result = concluded_of(problem_of(test, damped=True), spring)
    assert result.parameters["s1_eta"].state == "determined"
