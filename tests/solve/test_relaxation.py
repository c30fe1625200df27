"""Springs with relaxation against brute-force steps, closed forms and quadrature."""

import itertools
import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ndtri
from test_memory import value_of, with_value

import foamfit as ff
from independent import follow
from reference import differences

Terms = list[tuple[float, float]]


def loops(turns: tuple[float, ...], samples: int) -> np.ndarray:
    """Return samples between the turning points, including the turns."""
    legs = [np.linspace(a, b, samples + 1)[1:] for a, b in itertools.pairwise(turns)]
    return np.concatenate([[turns[0]], *legs])


def chain(spring: Any) -> ff.Chain:
    return ff.Chain([spring], [2e-2], 1e-4)


def stress_of(
    spring: Any, eps: np.ndarray, t: np.ndarray, rtol: float = 1e-6, **more: Any
) -> ff.Response:
    return ff.simulate(chain(spring), ff.DisplacementDrive(2e-2 * eps), t, rtol, **more)


SHOE = (5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77)
LAWS = {
    "shoe foam": SHOE,
    "reversible at low ranks": (5e5, 1e6, 0.3, 1e5, 1.2, 5e4, 0.1),
    "narrow": (5e5, 5e5, 0.2, 1e5, 3e-3, 5e4, 0.05),
}
TURNS = (0.0, 0.5, 0.2, 0.4, 0.05, 0.6, -0.02, 0.3)


@pytest.mark.parametrize("own", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize(
    ("terms", "samples"),
    [([(0.5, 0.2)], 4), ([(0.5, 0.2)], 40), ([(0.5, 1e-2), (1.0, 1e4)], 4), ([(0.7, 1e-4)], 4)],
    ids=["one, coarse", "one, fine", "fast and slow", "very fast"],
)
def test_stress_is_within_rtol(own: tuple[float, ...], terms: Terms, samples: int) -> None:
    eps = loops(TURNS, samples)
    t = np.linspace(0.0, 1.0, eps.size)
    spring = ff.MicroscaleSpring(*own, relaxation=terms)
    truth = follow(chain(spring), ff.DisplacementDrive(2e-2 * eps), t)
    assert not truth.why
    want = truth.base_stress
    for rtol in (1e-4, 1e-6, 1e-9):
        got = stress_of(spring, eps, t, rtol).base_stress
        assert np.abs(got - want).max() <= rtol * np.ptp(want)


def test_a_held_strain_relaxes_exponentially() -> None:
    """After almost instantaneous loading the overstress is g σ exp(-t/τ)."""
    spring = ff.MicroscaleSpring(*SHOE, relaxation=[(0.5, 0.2), (0.0, 1.0)])
    t = np.array([0.0, 1e-9, 0.1, 0.3, 5.0])
    got = stress_of(spring, np.array([0.0, 0.4, 0.4, 0.4, 0.4]), t).base_stress
    rest = spring.stress(0.4)
    np.testing.assert_allclose(got[1:], rest * (1 + 0.5 * np.exp(-t[1:] / 0.2)), rtol=1e-8)
    below = stress_of(spring, np.array([0.4, 0.4]), np.array([0.0, 1.0])).base_stress
    np.testing.assert_allclose(below, rest, rtol=1e-15)  # a chain starts without overstress


@pytest.mark.parametrize("terms", [[(0.5, 0.2)], [(0.5, 0.02), (0.0, 3.0)], []])
@pytest.mark.parametrize("kind", ["microscale", "bistable"])
def test_sensitivities_against_differences(kind: str, terms: Terms) -> None:
    eps = loops((0.0, 0.43, 0.21, 0.4, 0.06, 0.6, 0.01), 13)
    spring: Any = ff.MicroscaleSpring(*SHOE, eta=300.0, relaxation=terms)
    if kind == "bistable":
        eps *= 0.6
        spring = ff.BistableSpring(
            5.5e6, 82.5e6, -0.17907e6, 0.14, 0.31, 14.3e6, 2.3375e6, eta=300.0, relaxation=terms
        )
    t = np.linspace(0.0, 1.0, eps.size)
    short = [*spring.law.names, "height"]
    short += [f"{name}{k + 1}" for k in range(len(terms)) for name in ("g", "tau")]
    names = [f"s1_{name}" for name in short]
    got = stress_of(spring, eps, t, 1e-10, sensitivities=names).sensitivities

    def run(name: str, change: float) -> ff.Response:
        value = value_of(chain(spring), f"s1_{name}") + change
        changed = with_value(chain(spring), f"s1_{name}", value)
        return ff.simulate(changed, ff.DisplacementDrive(2e-2 * eps), t, 1e-10)

    for name in short:
        size = 1e-5 * (1.0 if name[0] == "g" else 2e-2 if name == "height" else 0.0)
        if name[:3] == "tau":
            size = 1e-4 * terms[int(name[-1]) - 1][1]
        size = size or 2e-5 * abs(getattr(spring, name))
        if name == "g2":  # g2 = 0: one-sided
            at = [run(name, k * size).base_stress for k in range(3)]
            want = (-3 * at[0] + 4 * at[1] - at[2]) / (2 * size)
        else:
            want = differences(partial(run, name), size)[1]
        miss = np.abs(got[f"s1_{name}"].base_stress - want).max()
        rounding = 1e-9 * np.abs(spring.stress(eps)).max() / size if name == "tau2" else 0.0
        assert miss <= 2e-6 * np.abs(want).max() + rounding, name


def test_a_term_of_no_strength_is_left_out() -> None:
    """A spring with g = 0 uses the same solver as without the term, also in an impact."""
    bistable = ff.BistableSpring(5.5e6, 82.5e6, -0.17907e6, 0.14, 0.31, 14.3e6, 2.3375e6)
    t = np.linspace(0.0, 1e-3, 50)
    runs = [
        ff.simulate(ff.Chain([spring], [1.19e-3], 2e-5), ff.Impact(7e-3, 2.0), t)
        for spring in (bistable, replace(bistable, relaxation=[(0.0, 1e-4)]))
    ]
    np.testing.assert_array_equal(runs[0].base_stress, runs[1].base_stress)
    eps = loops(TURNS, 10)
    spring = ff.MicroscaleSpring(*SHOE)
    got = stress_of(replace(spring, relaxation=[(0.0, 0.1)]), eps, np.linspace(0, 1, eps.size))
    np.testing.assert_array_equal(got.base_stress, stress_of(spring, eps, got.time).base_stress)


def test_moments_of_short_and_long_steps_meet() -> None:
    """For linear σ, one step of any length gives q = g τ (1 - exp(-t/τ)) dσ/dt."""
    flat = ff.BistableSpring(1e9, 2e9, -1.0, 0.5, 0.9, 1e6, 1e6, relaxation=[(1.0, 1.0)])
    for x in (1e-12, 1e-3, 0.9999, 1.0001, 3.0, 50.0, 1e4):
        eps, t = np.array([0.0, 1e-9]), np.array([0.0, x])
        got = stress_of(flat, eps, t, sensitivities=["s1_tau1"])
        assert got.base_stress[1] == pytest.approx(1.0 - math.expm1(-x) / x, rel=1e-8)
        by_tau = -math.exp(-x) - math.expm1(-x) / x
        slope = got.sensitivities["s1_tau1"].base_stress[1]
        assert slope == pytest.approx(by_tau, rel=1e-7, abs=1e-15)


def test_what_a_spring_cannot_bear_is_refused() -> None:
    pulled = ff.StressDrive(np.array([0.0, -6e5]))
    with pytest.raises(ff.SimulationError, match="no longer finite"):
        ff.simulate(chain(ff.MicroscaleSpring(*SHOE)), pulled, [0.0, 1.0])
    for terms in ([], [(0.5, 0.2)]):
        spring = ff.MicroscaleSpring(*SHOE, relaxation=terms)
        with pytest.raises(ff.SimulationError, match="no longer finite"):
            stress_of(spring, np.array([0.0, 0.5, 1.08, 0.3]), np.arange(4.0))


@pytest.mark.parametrize("sigma_plus", [1e-100, 1e-300])
def test_springs_may_snap_at_next_to_no_stress(sigma_plus: float) -> None:
    """Stresses too small to reach by bisection from k0 are still found."""
    law, star = (5.5e5, 2.5e5, 0.08, sigma_plus, 0.4, 7e4, 0.77), 0.08
    once = stress_of(ff.MicroscaleSpring(*law), np.array([0.0, 0.03]), np.array([0.0, 1.0]))
    want = sigma_plus * math.exp(0.4 * ndtri(0.03 / star))
    assert once.base_stress[1] == pytest.approx(want, rel=1e-11, abs=0.0)
    t = np.linspace(0.0, 0.5, 251)
    eps = 0.5 * np.sin(np.pi * t)
    bare = stress_of(ff.MicroscaleSpring(*law), eps, t).base_stress
    snaps = (eps > 0.0) & (eps < star)
    want = sigma_plus * np.exp(0.4 * ndtri(eps[snaps] / star))
    assert bare[snaps] == pytest.approx(want, rel=1e-11, abs=0.0)

    def snapped(at: float) -> float:
        x = max(float(np.interp(at, t, eps)) - star, 0.0)
        return 2.5e5 * x / (1.0 - x)

    assert bare[-1] == pytest.approx(snapped(0.5), rel=1e-12)
    g, tau = 0.5, 0.2
    got = stress_of(ff.MicroscaleSpring(*law, relaxation=[(g, tau)]), eps, t, 1e-8).base_stress
    begins = t[np.flatnonzero(~snaps & (eps > 0.0))[0] - 1]
    kinks = np.append(t[t >= begins], 0.5)
    began = brentq(lambda at: np.interp(at, t, eps) - star, kinks[0], kinks[1])
    kinks[0] = began
    faded = sum(
        quad(lambda u: snapped(u) * math.exp(-(0.5 - u) / tau) / tau, a, b, epsabs=0.0)[0]
        for a, b in itertools.pairwise(kinks)
        if b > a
    )
    assert got[-1] == pytest.approx(snapped(0.5) + g * (snapped(0.5) - faded), rel=1e-8)
    # Branch a, up to the least strain at which micro-springs snap, leaves next to nothing, in Pa.
    assert (np.abs(got[snaps]) < max(1e3 * sigma_plus, 1e-20)).all()
