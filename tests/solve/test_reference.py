"""The reference against closed forms, other tolerances of its own and the energy balance."""

import dataclasses

import numpy as np
import pytest

from reference import (
    Bistable,
    Chain,
    Impact,
    Linear,
    energy_balance,
    law,
    reference_displacement,
    reference_impact,
    reference_stress,
)

AREA = np.pi * 2.5e-3**2
SOFT = Bistable(2e6, 60e6, -0.32 * 2e6 * 0.35 / 0.65, 0.35, 0.71, 6.8e6, 1.05e6)
ONE = Bistable(5.5e6, 82.5e6, -0.2 * 5.5e6 * 0.14 / 0.86, 0.14, 0.31, 14.3e6, 2.475e6)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max() / np.ptp(b))


def test_linear_spring_is_a_harmonic_oscillator() -> None:
    k, h, m, v = 60e6, 1e-3, 7e-3, 1.75
    omega = np.sqrt(k * AREA / (h * m))
    t = np.linspace(0, 1.3 * np.pi / omega, 203)
    got = reference_impact(Chain((Linear(k),), (h,), AREA), Impact(m, v), t)
    end = np.pi / omega
    w = np.where(t < end, v / omega * np.sin(omega * t), -v * (t - end))
    assert relative(got.displacement[0], w) < 1e-12
    assert relative(got.base_stress, np.where(t < end, k / h * w, 0.0)) < 1e-12
    assert got.contact_end == pytest.approx(end, rel=1e-12)
    assert got.rebound == pytest.approx(v, rel=1e-12)


@pytest.mark.parametrize("onsite", [False, True])
def test_damped_linear_spring(onsite: bool) -> None:
    k, h, m, v, eta = 60e6, 1e-3, 7e-3, 1.75, 300.0
    omega0 = np.sqrt(k * AREA / (h * m))
    decay = eta * AREA / (h * m) / 2
    omega = np.sqrt(omega0**2 - decay**2)
    spring = Linear(k, 0.0 if onsite else eta)
    chain = Chain((spring,), (h,), AREA, site_damping=eta if onsite else 0.0)
    t = np.linspace(0, 0.9 * np.pi / omega, 203)
    got = reference_impact(chain, Impact(m, v), t)
    w = v / omega * np.exp(-decay * t) * np.sin(omega * t)
    rate = v * np.exp(-decay * t) * (np.cos(omega * t) - decay / omega * np.sin(omega * t))
    sensor = (k * w + (0.0 if onsite else eta) * rate) / h
    assert relative(got.displacement[0], w) < 1e-11
    assert relative(got.base_stress, sensor) < 1e-11


def test_contact_end_of_a_damped_spring_counts_the_dashpot() -> None:
    k, h, m, v, eta = 60e6, 1e-3, 7e-3, 1.75, 3000.0
    omega0 = np.sqrt(k * AREA / (h * m))
    decay = eta * AREA / (h * m) / 2
    omega = np.sqrt(omega0**2 - decay**2)
    # k w + η w' = 0
    end = (np.pi - np.arctan2(eta * omega, k - eta * decay)) / omega
    t = np.linspace(0, 2 * end, 100)
    got = reference_impact(Chain((Linear(k, eta),), (h,), AREA), Impact(m, v), t)
    assert got.contact_end == pytest.approx(end, rel=1e-10)


def test_dashpot_creeps_under_a_ramp_of_stress() -> None:
    k, h, eta, rate = 60e6, 1e-3, 1e4, 1e9
    t = np.linspace(0, 2e-3, 50)
    want = rate / k * (t - eta / k * (1 - np.exp(-k * t / eta)))
    got = reference_stress(Chain((Linear(k, eta),), (h,), AREA), rate * t, t)
    assert relative(got.strain, want) < 1e-11
    # with the damper between top and ground, the motion is the same but the base force differs
    onsite = Chain((Linear(k),), (h,), AREA, site_damping=eta)
    got = reference_stress(onsite, rate * t, t)
    assert relative(got.strain, want) < 1e-11
    assert relative(got.base_stress, k * want) < 1e-11


def test_small_mass_under_a_ramp_of_stress() -> None:
    k, h, m, rate = 60e6, 1e-3, 5e-4, 1e9
    omega = np.sqrt(k * AREA / (h * m))
    t = np.linspace(0, 20 / omega, 120)
    want = rate / k * (t - np.sin(omega * t) / omega)
    got = reference_stress(Chain((Linear(k),), (h,), AREA, (m,)), rate * t, t)
    assert relative(got.strain, want) < 1e-11


def test_mass_between_linear_springs_under_a_driven_top() -> None:
    k, h, m, rate = 60e6, 0.5e-3, 5e-5, 1.0
    omega = np.sqrt(2 * k * AREA / (h * m))
    t = np.linspace(0, 20 / omega, 120)
    w1 = rate / 2 * (t - np.sin(omega * t) / omega)
    chain = Chain((Linear(k), Linear(k)), (h, h), AREA, (m, 0.0))
    got = reference_displacement(chain, rate * t, t)
    assert relative(got.displacement[0], w1) < 1e-11
    assert relative(got.base_stress, k * w1 / h) < 1e-11


def test_dashpot_in_series_with_a_spring_relaxes() -> None:
    # spring k + dashpot in parallel (k, η) below, spring k above, top driven at constant rate
    k, h, eta, rate = 60e6, 0.5e-3, 1e4, 1.0
    t = np.linspace(0, 1e-3, 60)
    tau = eta / (2 * k)
    w1 = rate / 2 * (t - tau * (1 - np.exp(-t / tau)))
    chain = Chain((Linear(k, eta), Linear(k)), (h, h), AREA)
    got = reference_displacement(chain, rate * t, t)
    assert relative(got.displacement[0], w1) < 1e-11
    assert relative(got.base_stress, k * (rate * t - w1) / h) < 1e-11


TWO = (Linear(60e6), SOFT)
HEIGHTS = (0.7e-3, 0.49e-3)


@pytest.mark.parametrize(
    ("chain", "fast"),
    [
        (Chain((ONE,), (1.19e-3,), AREA), 1.98),
        (Chain((dataclasses.replace(ONE, eta=100.0),), (1.19e-3,), AREA), 2.1),
        (Chain(TWO, HEIGHTS, AREA), 2.1),
        (Chain(TWO, HEIGHTS, AREA, (2e-5, 0.0)), 2.1),
        (Chain((Linear(60e6, 300.0), SOFT), HEIGHTS, AREA), 2.1),
        (Chain((ONE, SOFT, Linear(60e6)), (0.4e-3, 0.5e-3, 0.4e-3), AREA), 2.1),
    ],
)
def test_other_tolerance_and_step_give_the_same_impact(chain: Chain, fast: float) -> None:
    t = np.linspace(0, 1.2e-3, 150)
    fine = reference_impact(chain, Impact(7e-3, fast), t, rtol=1e-12, steps=300)
    rough = reference_impact(chain, Impact(7e-3, fast), t, rtol=1e-11, steps=150)
    assert fine.contact_end is not None
    assert len(fine.switches) >= 3
    assert relative(rough.displacement, fine.displacement) < 3e-9
    assert relative(rough.base_stress, fine.base_stress) < 3e-9


@pytest.mark.parametrize("masses", [None, (2e-5, 0.0), (2e-4, 1e-4)])
def test_undamped_impact_keeps_its_energy(masses: tuple[float, ...] | None) -> None:
    chain, drive = Chain(TWO, HEIGHTS, AREA, masses), Impact(7e-3, 2.1)
    t = np.linspace(0, 1.2e-3, 300)
    got = reference_impact(chain, drive, t)
    energy = energy_balance(chain, drive, got.displacement, got.velocity)
    total = energy["kinetic"] + energy["work"]
    brought = energy["brought"]
    if masses is not None and masses[-1]:
        brought = total[:1]  # the top mass starts with the striker's velocity
    on = t < got.contact_end
    np.testing.assert_allclose(total[on], np.broadcast_to(brought, t.shape)[on], rtol=1e-11)


def test_three_springs_in_series_carry_one_stress() -> None:
    chain = Chain((ONE, SOFT, Linear(60e6)), (0.4e-3, 0.5e-3, 0.4e-3), AREA)
    t = np.linspace(0, 1.2e-3, 150)
    got = reference_impact(chain, Impact(7e-3, 2.1), t)
    on = t < got.contact_end
    strain = np.diff(got.displacement, axis=0, prepend=0.0) / np.array(chain.heights)[:, None]
    for spring, eps in zip(chain.springs, strain, strict=True):
        stress = law(spring).stress(eps)
        np.testing.assert_allclose(stress[on], got.base_stress[on], rtol=1e-9, atol=1e-3)


def test_slow_motion_of_a_chain_follows_its_equilibrium() -> None:
    chain = Chain(TWO, HEIGHTS, AREA)
    t = np.linspace(0, 1, 121)
    w = 0.62e-3 * np.sin(np.pi * t)
    still = reference_displacement(chain, w, t)
    again = reference_stress(chain, still.base_stress, t)
    assert relative(again.displacement, still.displacement) < 1e-12
    slow = dataclasses.replace(chain, springs=(Linear(60e6, 1e4), SOFT))
    moved = reference_displacement(slow, w, t, rtol=1e-8)
    assert relative(moved.displacement, still.displacement) < 2e-3


def test_branch_inverses_and_integrals() -> None:
    points = law(SOFT)
    for branch, low, high in [
        ("a", -0.01, 0.35),
        ("d", 0.35, points.eps_hat_c),
        ("c", 0.71, 0.9),
        ("e", points.eps_hat_a, 0.71),
    ]:
        for eps in np.linspace(low, high, 9):
            assert points.inverse(branch, points.sigma(branch, eps)) == pytest.approx(
                eps, rel=1e-13, abs=1e-15
            )
            slope = (points.sigma(branch, eps + 1e-6) - points.sigma(branch, eps - 1e-6)) / 2e-6
            assert points.slope(branch, eps) == pytest.approx(slope, rel=1e-6)
    up = np.linspace(0.0, 0.9, 40)
    down = np.linspace(0.9, -0.05, 60)
    back = np.linspace(-0.05, 0.0, 5)
    work = points.work(np.concatenate([up, down, back]))
    assert work[-1] == pytest.approx(points.loop, rel=1e-12)
    assert work[39] == pytest.approx(points.work([0.9])[0], rel=1e-12)
