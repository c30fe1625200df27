"""Chains of linear springs against closed forms."""

import math
from typing import Any

import numpy as np
import pytest

import foamfit as ff
from independent import over_range

AREA, H, MASS, SPEED = 2e-5, 1e-3, 7e-3, 2.0
K, RATE = 3e6, 1e10


def run(chain: ff.Chain, drive: Any, time: np.ndarray) -> ff.Response:
    return ff.simulate(chain, drive, time, rtol=1e-10)


def line(k: float = K, eta: float = 0.0) -> ff.LinearSpring:
    return ff.LinearSpring(k, eta)


def chain(*springs: Any, masses: list[float] | None = None, site: float = 0.0) -> ff.Chain:
    return ff.Chain(springs, [H] * len(springs), AREA, masses, site)


@pytest.mark.parametrize(("eta", "onsite"), [(0.0, False), (60.0, False), (60.0, True)])
def test_a_striker_is_thrown_back(eta: float, onsite: bool) -> None:
    """m w″ + c w′ + k w = 0; contact ends where the stress of spring and dashpot is zero."""
    omega, decay = math.sqrt(K * AREA / (MASS * H)), 0.5 * eta * AREA / (MASS * H)
    ring = math.sqrt(omega**2 - decay**2)
    carried = 0.0 if onsite else eta
    end = (math.pi - math.atan2(carried * ring, K - carried * decay)) / ring
    time = np.linspace(0.0, 1.3 * math.pi / omega, 77)
    own = chain(line(eta=carried), site=eta if onsite else 0.0)
    got, held = run(own, ff.Impact(MASS, SPEED), time), time < end
    fades = SPEED * np.exp(-decay * time)
    w = fades / ring * np.sin(ring * time)
    rate = fades * (np.cos(ring * time) - decay / ring * np.sin(ring * time))
    assert got.contact_end == pytest.approx(end, rel=1e-9)
    assert over_range(got.displacement[0, held], w[held]) <= 1e-10
    assert over_range(got.base_stress, np.where(held, (K * w + carried * rate) / H, 0.0)) <= 1e-10


def test_creep_under_a_rising_stress() -> None:
    eta = 50.0
    time = np.linspace(0.0, 5.0 * eta / K, 30)
    drive = ff.StressDrive(RATE * time)
    creep = RATE / K * (time + eta / K * np.expm1(-K * time / eta))
    got = run(chain(line(eta=eta), line(2.0 * K)), drive, time)
    assert over_range(got.displacement[0], H * creep) <= 1e-10
    assert over_range(got.displacement[1], H * (creep + RATE * time / (2.0 * K))) <= 1e-10
    # a damper between the top and the ground has the same motion, and takes its part of the load
    got = run(chain(line(), site=eta), drive, time)
    assert over_range(got.displacement[0], H * creep) <= 1e-10
    assert over_range(got.base_stress, K * creep) <= 1e-10


def test_a_spring_and_a_dashpot_share_a_ramp_of_displacement() -> None:
    eta, pace, time = 50.0, 1e-2, np.linspace(0.0, 1e-4, 40)
    got = run(chain(line(eta=eta), line(2.0 * K)), ff.DisplacementDrive(pace * time), time)
    rate, slope = 3.0 * K / eta, 2.0 * K * pace / (H * eta)  # η ε′ = 2k (pace t/h - ε) - k ε
    eps = slope * (time / rate + np.expm1(-rate * time) / rate**2)
    assert over_range(got.displacement[0], H * eps) <= 1e-9
    assert over_range(got.base_stress, 2.0 * K * (pace * time / H - eps)) <= 1e-9


def test_a_mass_on_a_spring_and_between_two() -> None:
    mass, pace = 5e-4, 1.0
    omega = math.sqrt(K * AREA / (H * mass))
    time = np.linspace(0.0, 20.0 / omega, 120)
    got = run(chain(line(), masses=[mass]), ff.StressDrive(RATE * time), time)
    assert (
        over_range(got.displacement[0], H * RATE / K * (time - np.sin(omega * time) / omega))
        <= 1e-9
    )
    omega *= math.sqrt(2.0)
    got = run(chain(line(), line(), masses=[mass, 0.0]), ff.DisplacementDrive(pace * time), time)
    w = 0.5 * pace * (time - np.sin(omega * time) / omega)
    assert over_range(got.displacement[0], w) <= 1e-9
    assert over_range(got.base_stress, K * w / H) <= 1e-9
