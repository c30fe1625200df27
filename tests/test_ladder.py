"""The ladder: runs test, effective parameters, known structures, interruption, what is written."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import foamfit as ff
from foamfit import evidence
from foamfit.measurement import Measurement, Specimen, Striker
from foamfit.structure import branch_places, find_structure, neighbours_test, runs_test

HEIGHT, AREA = 1.2e-3, 1.9635e-5


# ---------------------------------------------------------------- runs test


def exact_p(positive: int, negative: int, runs: int) -> float:
    """Chance of so few runs or fewer, counted over all orders of the signs."""
    n = positive + negative
    orders = list(itertools.combinations(range(n), positive))
    few = 0
    for order in orders:
        signs = np.zeros(n, dtype=int)
        signs[list(order)] = 1
        few += 1 + np.count_nonzero(np.diff(signs)) <= runs
    return few / len(orders)


@pytest.mark.parametrize(
    "signs", ["++++----++++----", "+-+-++--+-+--++-", "+++++---+--+--+", "++++++++------"]
)
def test_the_runs_test_is_that_of_all_orders_counted(signs):
    residual = np.array([1.0 if sign == "+" else -0.5 for sign in signs])
    runs = len(list(itertools.groupby(signs)))
    exact = exact_p(signs.count("+"), signs.count("-"), runs)
    assert runs_test(residual) == pytest.approx(exact, abs=0.012)


def test_the_runs_test_holds_its_level_and_sees_waves():
    rng = np.random.default_rng(0)
    p = np.array([runs_test(rng.standard_normal(400)) for _ in range(1000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.02)
    assert np.mean(p < 0.5) == pytest.approx(0.5, abs=0.06)
    wave = np.sin(np.linspace(0, 20, 400))
    assert runs_test(wave + 0.5 * rng.standard_normal(400)) < 1e-6
    assert runs_test(np.ones(11)) == pytest.approx(2.0**-10)
    assert runs_test(np.array([1.0, -1.0] * 50)) > 0.999  # alternating is no structure
    assert runs_test(np.zeros(5)) == 1.0


def test_the_neighbours_test_holds_its_level_and_sees_a_short_wave():
    rng = np.random.default_rng(4)
    p = np.array([neighbours_test(rng.standard_normal(400)) for _ in range(1000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.02)
    short = rng.standard_normal(400)
    short[100:120] += 3.0
    assert neighbours_test(short) < 1e-4 < 1e-2 < runs_test(short)


# ---------------------------------------------------------------- evidence


def tried(residual, columns):
    """A rung of one curve, as far as the evidence looks at it."""
    return SimpleNamespace(
        residual=residual,
        sizes=(residual.size,),
        curves=[residual],
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
    faint = np.column_stack([apart, 0.01 * x**3])  # its interval is ±13 natural sizes
    counted = [
        evidence.effective_parameters(np.array([columns.T @ columns]), noise)
        for columns in (apart, same, faint)
    ]
    assert counted == [3, 3, 3]


def test_the_criteria_are_those_of_closed_form():
    """White noise: AICc and BIC of n samples; k = 2."""
    residual = np.random.default_rng(2).standard_normal(500)
    columns = np.column_stack([np.ones(500), np.linspace(-1, 1, 500)])
    one = tried(residual, columns)
    found = evidence.evidence(one, one)
    fit = 500 * np.log(residual @ residual / 500)
    assert found.rank == 2
    assert found.aicc == pytest.approx(fit + 4 + 12 / 497, rel=1e-12)
    assert found.bic == pytest.approx(fit + 2 * np.log(500), rel=1e-12)


def test_correlated_residuals_are_less_evidence():
    """Each sample written five times says no more than written once."""
    rng = np.random.default_rng(3)
    small, large = (scale * rng.standard_normal(200) for scale in (1.0, 1.1))
    columns = np.ones((200, 1))
    once = [evidence.evidence(tried(r, columns), tried(small, columns)).bic for r in (large, small)]
    five = [
        evidence.evidence(
            tried(np.repeat(r, 5), np.repeat(columns, 5, axis=0)),
            tried(np.repeat(small, 5), np.repeat(columns, 5, axis=0)),
        ).bic
        for r in (large, small)
    ]
    assert five[0] - five[1] == pytest.approx(once[0] - once[1], rel=0.2)


def test_a_bent_structure_is_found_where_it_is():
    strain = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, 0, 200)])
    switches = np.array([[50, 1, 0, 1, 0], [150, 1, 1, 2, 0], [250, 1, 2, 3, 0]], dtype=float)
    names = ("a", "d", "c", "e")
    places = branch_places(("linear", "bistable"), switches, np.arange(400.0), strain, names)
    residual = 1e-3 * np.random.default_rng(0).standard_normal(400)
    residual[50:150] += 0.1 * (np.linspace(-1, 1, 100) ** 2 - 1 / 3)
    found = find_structure(residual, places)
    assert found.place == "loading, spring 2 on d"
    assert found.straight
    assert found.share > 0.99
    assert found.bent > 0.99
    rms = 0.1 * np.sqrt(4 / 45) * 0.5  # of x² - 1/3 along a quarter of the samples
    assert found.size == pytest.approx(rms, rel=0.05)


# ---------------------------------------------------------------- known structures


def impact(springs, heights, site=0.0, velocity=2.0, noise=0.005, seed=0):
    """A synthetic impact without stated noise."""
    chain = ff.Chain(springs, heights, AREA, site_damping=site)
    drive = ff.Impact(7e-3, velocity)
    long = ff.simulate(chain, drive, np.linspace(0, 20 * HEIGHT / velocity, 4001))
    time = np.linspace(0, 1.05 * long.contact_end, 301)
    run = ff.simulate(chain, drive, time)
    rng = np.random.default_rng(seed)
    curves = [
        y + noise * np.ptp(y) * rng.standard_normal(y.size)
        for y in (run.base_stress, run.displacement[-1])
    ]
    return Measurement(
        name="synthetic impact",
        path=None,
        data_sha256="",
        time=time,
        stress=curves[0],
        displacement=curves[1],
        specimen=Specimen(HEIGHT, AREA),
        striker=Striker(7e-3, velocity),
        motion="measured",
    )


SPRING = ff.published["foam-1/model-1"].bistable
SOFT = ff.BistableSpring(
    k0=4e6, kc=60e6, dsigma=-0.4e6, eps_a=0.2, eps_c=0.5, kh_plus=4e6, kh_minus=1.2e6
)
STIFF = ff.BistableSpring(
    k0=15e6, kc=200e6, dsigma=-1.2e6, eps_a=0.2, eps_c=0.5, kh_plus=15e6, kh_minus=4e6
)
LINE = ff.LinearSpring(12e6)
HALVES = [0.5 * HEIGHT] * 2
CASES = {
    "bistable without damping": ([SPRING], [HEIGHT], 0.0),
    "bistable with damping": ([replace(SPRING, eta=400.0)], [HEIGHT], 0.0),
    "linear+bistable without damping": ([LINE, SOFT], HALVES, 0.0),
    "linear+bistable with damping": ([LINE, SOFT], HALVES, 400.0),
}


@pytest.mark.parametrize("name", CASES)
def test_a_clear_structure_is_found(name):
    springs, heights, site = CASES[name]
    result = ff.fit(impact(springs, heights, site, velocity=2.6), model="auto", starts=12)
    assert result.ladder.chosen.name == name
    assert result.model == result.ladder.chosen.model
    assert result.misfit["stress_time"] == result.ladder.chosen.misfit["stress_time"]
    assert result.ladder.chosen.runs_p > 1e-3
    assert len([rung for rung in result.ladder.rungs if rung.chosen]) == 1
