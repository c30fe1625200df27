"""The brute-force judge of experiments/stability against closed forms and other programs."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import reference
from conftest import EXPERIMENTS
from reference import Bistable, Chain, Impact, Linear

sys.path.insert(0, str(EXPERIMENTS / "stability"))
import independent
from independent import follow, over_range

AREA, H = 2e-5, 1e-3
SPRING = Bistable(5.75e6, 230e6, -3.07e6, 0.40, 0.70, 34.5e6, 1.15e6)


class Stress:
    def __init__(self, stress: object) -> None:
        self.stress = np.asarray(stress, float)


class Displacement:
    def __init__(self, displacement: object) -> None:
        self.displacement = np.asarray(displacement, float)


def chain(*springs: object, masses: tuple[float, ...] | None = None, site: float = 0.0) -> Chain:
    heights = tuple(H * (1.0 + 0.2 * i) for i in range(len(springs)))
    return Chain(springs, heights, AREA, masses or (0.0,) * len(springs), site)


# ---------------------------------------------------------------------------------- closed forms


def test_a_linear_spring_throws_its_striker_back() -> None:
    k, m, v = 3e6, 7e-3, 2.0
    omega = math.sqrt(k * AREA / (m * H))
    time = np.linspace(0.0, 1.3 * math.pi / omega, 77)
    got = follow(chain(Linear(k)), Impact(m, v), time)
    held = time < math.pi / omega
    want = np.where(held, v / omega * np.sin(omega * time), -v * (time - math.pi / omega))
    assert got.contact_end == pytest.approx(math.pi / omega, rel=1e-12)
    np.testing.assert_allclose(got.displacement[0], want, rtol=0, atol=1e-12 * want.max())
    stress = np.where(held, k / H * want, 0.0)
    np.testing.assert_allclose(got.base_stress, stress, rtol=0, atol=1e-12 * stress.max())


def test_a_damped_spring() -> None:
    k, m, v, eta = 3e6, 7e-3, 2.0, 60.0
    omega, decay = math.sqrt(k * AREA / (m * H)), 0.5 * eta * AREA / (m * H)
    ring = math.sqrt(omega**2 - decay**2)
    time = np.linspace(0.0, 1.3 * math.pi / omega, 50)
    got = follow(chain(Linear(k, eta)), Impact(m, v), time)
    # Σ = 0 where the deceleration is zero: tan(ring t) = 2 decay ring/(decay² - ring²)
    end = math.atan2(2.0 * decay * ring, decay**2 - ring**2) / ring
    held = time < end
    want = v / ring * np.exp(-decay * time) * np.sin(ring * time)
    rate = v * np.exp(-decay * time) * (np.cos(ring * time) - decay / ring * np.sin(ring * time))
    assert got.contact_end == pytest.approx(end, rel=1e-12)
    np.testing.assert_allclose(got.displacement[0, held], want[held], rtol=0, atol=1e-12 * H)
    stress = (k * want + eta * rate) / H
    miss = np.abs(got.base_stress - np.where(held, stress, 0.0)).max()
    assert miss <= 1e-12 * stress.max()


def test_creep_under_a_rising_stress() -> None:
    k, eta, pace = 3e6, 50.0, 1e10
    time = np.linspace(0.0, 5.0 * eta / k, 30)
    load = pace * time
    got = follow(chain(Linear(k, eta), Linear(2.0 * k)), Stress(load), time)
    creep = pace / k * (time - eta / k * -np.expm1(-k * time / eta))
    np.testing.assert_allclose(got.displacement[0], H * creep, rtol=0, atol=1e-15)
    top = H * creep + 1.2 * H * load / (2.0 * k)
    np.testing.assert_allclose(got.displacement[1], top, rtol=0, atol=1e-15)
    np.testing.assert_allclose(got.base_stress, load, rtol=1e-14)


def test_relaxation_between_a_spring_and_a_dashpot_that_share_a_stress() -> None:
    """A ramp of displacement on a linear spring above one with a dashpot."""
    k, eta, pace = 3e6, 50.0, 1e-2
    time = np.linspace(0.0, 1e-4, 40)
    got = follow(chain(Linear(k, eta), Linear(2.0 * k)), Displacement(pace * time), time)
    # η ε1' = 2k (pace t - h1 ε1)/h2 - k ε1
    rate = (2.0 / 1.2 + 1.0) * k / eta
    slope = 2.0 * k * pace / (1.2 * H * eta)
    eps = slope * (time / rate - -np.expm1(-rate * time) / rate**2)
    np.testing.assert_allclose(got.displacement[0], H * eps, rtol=0, atol=1e-12 * H * eps.max())
    stress = 2.0 * k * (pace * time - H * eps) / (1.2 * H)
    np.testing.assert_allclose(got.base_stress, stress, rtol=0, atol=1e-11 * stress.max())


def test_a_loop_keeps_its_energy() -> None:
    m, v = 7e-3, 5.0
    time = np.linspace(0.0, 2e-3, 3)
    got = follow(chain(SPRING), Impact(m, v), time)
    assert got.contact_end is not None
    assert got.switches == 3
    rebound = (got.displacement[-1, -1] - got.displacement[-1, 1]) / (time[2] - time[1])
    row = independent.bistable_row(SPRING, H)
    x = independent
    up = quad(lambda e: SPRING.k0 * e / (1 - e), 0.0, SPRING.eps_a)[0]
    up += quad(lambda e: row[x.SIG_A] + row[x.UP] * (e - SPRING.eps_a), 0.4, row[x.HAT_C])[0]
    down = quad(
        lambda e: SPRING.kc * (e - row[x.STAR]) / (1 - (e - row[x.STAR])), 0.7, row[x.HAT_C]
    )[0]
    zero = 0.7 - row[x.SIG_C] / row[x.DOWN]  # where the stress on branch e is zero
    down += quad(lambda e: row[x.SIG_C] + row[x.DOWN] * (e - 0.7), zero, 0.7)[0]
    lost = 0.5 * m * (v**2 - rebound**2)
    assert lost == pytest.approx(AREA * H * (up - down), rel=1e-11)


# ------------------------------------------------------------------------------- other programs


def test_two_masses_by_scipy() -> None:
    k, eta = np.array([2e6, 5e6]), np.array([20.0, 0.0])
    h, m, v = np.array([H, 1.2 * H]), np.array([1e-4, 7e-3]) / AREA, 1.5

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        w, u = y[:2], y[2:]
        s = (k * np.diff(w, prepend=0.0) + eta * np.diff(u, prepend=0.0)) / h
        return np.concatenate((u, (np.append(s[1:], 0.0) - s) / m))

    time = np.linspace(0.0, 4e-4, 60)
    found = solve_ivp(
        rates, (0.0, 4e-4), [0.0, 0.0, 0.0, v], "DOP853", time, rtol=1e-13, atol=1e-18
    )
    got = follow(
        chain(Linear(k[0], eta[0]), Linear(k[1]), masses=(1e-4, 0.0)), Impact(7e-3, v), time
    )
    np.testing.assert_allclose(got.displacement, found.y[:2], rtol=0, atol=1e-10 * found.y.max())
    stress = (k[0] * found.y[0] + eta[0] * found.y[2]) / h[0]
    assert over_range(got.base_stress, stress) <= 1e-10


DAMPED = Bistable(5.75e6, 230e6, -3.07e6, 0.40, 0.70, 34.5e6, 1.15e6, 40.0)


@pytest.mark.parametrize(
    ("springs", "masses", "site"),
    [
        ((Linear(250e6, 1e3, True), SPRING), (5e-6, 0.0), 0.0),
        ((Linear(250e6, 0.0, True), SPRING, DAMPED), None, 1e3),
        ((DAMPED, DAMPED), None, 0.0),
    ],
)
def test_impacts_of_the_reference(springs: tuple, masses: tuple | None, site: float) -> None:
    """The error of the reference is at most 1e-11 of the range, that of the judge 6e-12.

    Both were found against the reference with 2,000 steps and a tolerance of 3e-14.
    """
    time = np.linspace(0.0, 1.2e-3, 60)
    made, drive = chain(*springs, masses=masses, site=site), Impact(7e-3, 4.44)
    want = reference.reference_impact(made, drive, time, steps=300)
    got = follow(made, drive, time)
    assert got.contact_end == pytest.approx(want.contact_end, rel=1e-9)
    assert over_range(got.base_stress, want.base_stress) <= 1e-9
    assert over_range(got.displacement, want.displacement) <= 1e-9


@pytest.mark.parametrize(
    ("springs", "masses", "site"),
    [
        ((Linear(50e6, 0.0, True), SPRING), None, 0.0),
        ((Linear(50e6, 3e3), DAMPED), None, 0.0),
        ((SPRING, DAMPED), (1e-4, 0.0), 0.0),
    ],
)
def test_displacements_of_the_reference(springs: tuple, masses: tuple | None, site: float) -> None:
    time = np.sort(np.append(np.linspace(0.0, 4e-3, 12), 1.234e-3))
    motion = np.interp(time, [0.0, 1.2e-3, 2e-3, 2.9e-3, 4e-3], [0.0, 1e-3, 4e-4, 1.3e-3, 0.0])
    made = chain(*springs, masses=masses, site=site)
    want = reference.reference_displacement(made, motion, time)
    got = follow(made, Displacement(motion), time)
    kinks = slice(1, -1)  # the reference averages both sides at a sample
    base = want.base_stress.copy()
    if not masses and all(s.eta > 0.0 for s in springs):
        before, after = np.diff(time)[:-1], np.diff(time)[1:]
        jump = np.diff(np.diff(motion) / np.diff(time)) / sum(
            h / s.eta for h, s in zip(made.heights, springs, strict=True)
        )
        base[kinks] += (before / (before + after) - 0.5) * jump
    assert over_range(got.base_stress, base) <= 1e-9
    assert over_range(got.displacement, want.displacement) <= 1e-9


@pytest.mark.parametrize(
    ("masses", "site"), [((0.0, 5e-5), 0.0), (None, 2e3), (None, 0.0), ((1e-3, 0.0), 5e2)]
)
def test_stresses_of_the_reference(masses: tuple | None, site: float) -> None:
    time = np.linspace(0.0, 4e-3, 12)
    load = np.interp(time, [0.0, 1.2e-3, 2e-3, 2.9e-3, 4e-3], [0.0, 12e6, 2e6, 20e6, 1e5])
    made = chain(Linear(250e6, 3e3), SPRING, masses=masses, site=site)
    want, got = reference.reference_stress(made, load, time), follow(made, Stress(load), time)
    assert over_range(got.base_stress, want.base_stress) <= 1e-9
    assert over_range(got.displacement, want.displacement) <= 1e-9


def test_no_judgement_past_the_bound_on_steps() -> None:
    made = chain(Linear(2e6, 1e6), SPRING, masses=(1e-9, 0.0))
    got = independent.judge(made, Impact(7e-3, 1.0), np.linspace(0.0, 1e-3, 11), most=10_000)
    assert got.why == "too many steps"


def test_it_has_no_say_where_the_law_leaves_open_which_spring_moves() -> None:
    """Two gaps or two flat branches under one stress: only the sum of the strains is determined."""
    time = np.linspace(0.0, 1.0, 11)
    pull = SimpleNamespace(displacement=1e-5 * time)
    gap, flat = Linear(6e7, unilateral=True), Bistable(2e6, 6e7, -1e5, 0.2, 0.5, 0.0, 1e6)
    for spring, sure in ((gap, False), (flat, False), (Linear(6e7), True)):
        twice = Chain((spring, spring), (1e-3, 1e-3), 2e-5, (0.0, 0.0))
        apart = Chain((spring, spring), (1e-3, 1e-3), 2e-5, (1e-3, 0.0))
        assert (independent.follow(twice, pull, time).why == "") == sure
        assert independent.follow(apart, pull, time, most=10_000).why != independent.SHARED
