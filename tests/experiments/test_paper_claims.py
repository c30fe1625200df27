"""The main numbers of the study of the paper's claims, several against closed forms."""

from __future__ import annotations

import math

import pytest

import claims
import foamfit as ff
from claims import FOAM_2, MODEL_1, MODEL_2, MODEL_3, OWN_MASS, STRIKER


@pytest.fixture(scope="module")
def drive() -> claims.Drive:
    return claims.drive_of_impact()


def test_the_foams_mass_oscillates_and_a_small_damper_stops_it(drive: claims.Drive) -> None:
    free = claims.oscillation(drive, OWN_MASS, 0.0)
    assert free["stress"] == pytest.approx(3.95, abs=0.1)
    assert min(free["turns"], free["turns_w"]) > 20
    still = claims.oscillation(drive, 0.0, 0.0)
    assert max(still["stress"], still["displacement"], still["turns"]) < 1e-6
    needed = claims.damper_needed(drive)
    assert needed == pytest.approx(8.1, abs=0.3)
    damped = claims.oscillation(drive, OWN_MASS, needed)
    assert damped["stress"] < 0.5
    assert damped["turns"] == damped["turns_w"] == 0


def test_the_literal_reading_fails_by_half(drive: claims.Drive) -> None:
    assert claims.displacement_error(drive, 0.0, 0.0) < 1e-6
    assert claims.displacement_error(drive, STRIKER, 0.0) == pytest.approx(49.3, abs=0.3)
    assert claims.displacement_error(drive, STRIKER, claims.ETA) == pytest.approx(54.5, abs=0.3)
    same = math.sqrt(STRIKER / OWN_MASS)  # so much slower, 7 g act like the foam's mass
    own = claims.displacement_error(drive, OWN_MASS, 0.0)
    assert claims.slowed(drive, 0.0, same) == pytest.approx(own, rel=1e-6)


def test_two_of_three_damping_ratios_follow_from_the_tables() -> None:
    each = {name: claims.ratio_readings(name) for name in claims.SETS}
    formula = {name: next(iter(readings.values())) for name, readings in each.items()}
    assert f"{formula[MODEL_3]:.4f}" == "0.0297"
    assert f"{formula[FOAM_2]:.3f}" == "0.525"
    assert not [one for one in each[MODEL_2].values() if f"{one:.3f}" == "0.894"]
    for name, value in formula.items():
        assert ff.published[name].damping_ratio_by_formula() == pytest.approx(value)
    eta = claims.ratio_wanted()["eta"]
    assert next(iter(claims.ratio_readings(MODEL_2, eta).values())) == pytest.approx(0.894)


@pytest.mark.parametrize(
    ("name", "needed"), [(MODEL_1, 1.9107), (MODEL_2, 1.9107), (MODEL_3, 1.9227), (FOAM_2, 4.3933)]
)
def test_the_velocity_that_closes_the_loop(name: str, needed: float) -> None:
    assert claims.closing_velocity(name, interior=False) == pytest.approx(needed, abs=1e-4)
    assert claims.closing_velocity_by_energy(name) == pytest.approx(needed, abs=1e-4)


def test_a_massless_chain_loses_the_loop_area() -> None:
    """Just past C1 the striker loses the area of the smallest closed loop, below it nothing."""
    chain, velocity = claims.impact_scene(MODEL_2), 1.9108
    brought = 0.5 * STRIKER * velocity**2 / chain.area
    lost = claims.lost_share(chain, velocity) / 100 * brought
    assert lost == pytest.approx(claims.loop_area(MODEL_2), rel=1e-3)
    assert claims.lost_share(chain, 1.75) == pytest.approx(0.0, abs=1e-3)
