"""Compare the laws of experiments/other_laws with closed forms, SciPy and direct evaluation."""

import importlib
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.special import erf, gamma

import foamfit as ff
from conftest import SPECIMEN, write_csv

CURVE = {"mu": 2.3e5, "alpha": 9.0, "nu": 2e4, "beta": 2.5}
UP_DOWN = np.concatenate([np.linspace(0.0, 0.6, 61), np.linspace(0.59, 0.0, 60)])


@cache
def law(name):
    """Register the law in a file and return it."""
    return ff.register(importlib.import_module(name).LAW)


def stress(strain, mu, alpha, nu, beta):
    """Return the nominal stress of the hyperfoam from its published sum."""
    stretch = 1.0 - strain
    terms = ((mu, alpha), (nu, -beta))
    return sum(2.0 * m / a * (1.0 / stretch - stretch ** (a - 1.0)) for m, a in terms)


def pressed(spring, time, strain):
    """Return the base stress of one spring under a prescribed motion."""
    chain = ff.Chain([spring], [0.01], area=1e-4)
    drive = ff.DisplacementDrive(0.01 * strain)
    return ff.simulate(chain, drive, time, rtol=1e-6).base_stress


def test_ogden_roxburgh_softens_by_the_energy_below_the_largest():
    r, m = 1.6, 6e4
    spring = law("ogden_roxburgh").make([*CURVE.values(), r, m, 0.0], [])
    path = np.concatenate([UP_DOWN, np.linspace(0.0, 0.7, 71)])
    elastic = stress(path, **CURVE)
    energy = np.array([quad(lambda e: stress(e, **CURVE), 0.0, e)[0] for e in path])
    largest = np.maximum.accumulate(energy)
    wanted = elastic * (1.0 - erf((largest - energy) / m) / r)
    np.testing.assert_allclose(spring.stress(path), wanted, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize("n", [0.7, 1.0, 3.0])
def test_bouc_wen_follows_its_differential_equation(n):
    k, limit = 4e5, 0.08
    spring = law("bouc_wen_foam").make([*CURVE.values(), k, limit, n, 0.0], [])
    z, wanted, last = 0.0, [], 0.0
    for turn in (0.5, 0.2, 0.6, 0.0):
        way = np.sign(turn - last)

        def slope(e, z, way=way):
            return 1.0 - (np.abs(z) / limit) ** n * (z * way > 0.0)

        parts = [last, turn]
        if z * way < 0.0 and abs(turn - last) > abs(z):  # the slope has a kink at z = 0
            parts = [last, last - z, turn]
        for one, other in pairwise(parts):
            found = solve_ivp(slope, (one, other), [z], "DOP853", rtol=1e-10, atol=1e-12)
            z = found.y[0, -1]
        wanted.append(stress(turn, **CURVE) + k * z)
        last = turn
    np.testing.assert_allclose(spring.stress([0.0, 0.5, 0.2, 0.6, 0.0])[1:], wanted, rtol=1e-4)


def test_maxwell_slip_is_its_sliders_and_near_their_limit():
    k, slip, spread = 4e5, 0.2, 1.5
    spring = law("maxwell_slip").make([*CURVE.values(), k, slip, spread, 0.0], [])
    limits = slip * ((np.arange(24) + 0.5) / 24) ** spread
    held, wanted = np.zeros(24), []
    for step in np.diff(UP_DOWN, prepend=0.0):
        held = np.clip(held + step, -limits, limits)
        wanted.append(k * held.mean())
    added = spring.stress(UP_DOWN) - stress(UP_DOWN, **CURVE)
    np.testing.assert_allclose(added, wanted, atol=1e-6)


@pytest.mark.parametrize("order", [0.1, 0.3, 0.7])
def test_fractional_element_under_a_ramp_of_stress(order):
    strength = 0.4
    spring = law("fractional").make([*CURVE.values(), strength, order, 0.0], [])
    grid = np.linspace(0.0, 0.5, 2001)
    time = np.linspace(0.0, 2.0, 801)
    top = stress(0.5, **CURVE)
    strain = np.interp(time / 2.0 * top, stress(grid, **CURVE), grid)
    wanted = top * time / 2.0 + strength * top / 2.0 * time ** (1.0 - order) / gamma(2.0 - order)
    np.testing.assert_allclose(pressed(spring, time, strain), wanted, atol=3e-3 * top)


BISTABLE = {
    "k0": 5.5e6, "kc": 82.5e6, "dsigma": -0.179e6, "eps_a": 0.14, "eps_c": 0.31,
    "kh_plus": 14.3e6, "kh_minus": 2.34e6,
}  # fmt: skip


def test_power_law_damper_adds_a_power_of_the_rate():
    c, n = 2e5, 0.3
    spring = law("power_law_damper").make([*BISTABLE.values(), c, n, 0.0], [])
    time = np.linspace(0.0, 1.0, 501)
    strain = 0.36 * (1.0 - np.abs(1.0 - 2.0 * time))
    rate = np.where(time < 0.5, 0.72, -0.72) * (time != 0.5)  # the mean at the turn
    wanted = ff.BistableSpring(**BISTABLE).stress(strain) + c * np.abs(rate) ** n * np.sign(rate)
    np.testing.assert_allclose(pressed(spring, time, strain), wanted, rtol=1e-9, atol=1e-3)


def test_a_law_that_depends_on_time_needs_one(tmp_path):
    law("fractional")
    path, strain = tmp_path / "t.csv", np.linspace(0.0, 0.5, 40)
    write_csv(path, "strain,stress (Pa)", strain, stress(strain, **CURVE), toml=SPECIMEN)
    with pytest.raises(ff.InputError, match="'fractional' needs a time column"):
        ff.fit(ff.read_test(path), model="fractional")
