"""Studies whose models know nothing of foamfit: rigs, micro-springs and the claims of the paper."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
import microscale
import paper_claims as claims
import rig
import rigs
from independent import over_range
from paper_claims import FOAM_2, MODEL_1, MODEL_2, MODEL_3, STRIKER


@pytest.mark.parametrize("law", ["bistable", "microscale"])
@pytest.mark.parametrize("relaxation", [0, 1])
@pytest.mark.parametrize(("seed", "gravity"), [(1, 0.0), (2, 0.0), (1, 0.1), (4, 0.1)])
def test_impacts_are_those_of_foamfit(law: str, relaxation: int, seed: int, gravity: float) -> None:
    """From before to after contact, also where gravity would show its absence."""
    made = rig.impact(rig.Impact(law=law, relaxation=relaxation), seed).rig
    made = replace(made, gravity=gravity * made.velocity**2 / made.height)
    course = made.run(0.0, 100.0 * made.height / made.velocity)
    time = np.linspace(-0.2 * course.end, 1.3 * course.end, 800)
    found, without = (
        ff.simulate(rigs.chain_of(made), ff.Impact(made.mass, made.velocity, g), time, rtol=1e-9)
        for g in (made.gravity, 0.0)
    )
    assert over_range(found.base_stress, course.stress(time)) < 1e-6
    assert over_range(found.displacement[-1], course.top(time, gauge=False)) < 1e-6
    assert found.contact_end == pytest.approx(course.end, rel=1e-6)
    assert (over_range(without.base_stress, course.stress(time)) > 1e-3) == (gravity > 0.0)


@pytest.mark.parametrize(
    "setup",
    [
        rig.Slow(law="bistable", inner=0.05, motion="trapezoid"),
        rig.Slow(law="bistable+bistable", inner=0.1),
        rig.Slow(inner=0.1),
        rig.Slow(relaxation=2, motion="ramp", early=True),
        rig.Slow(relaxation=1, motion="sine"),
        rig.Slow(dashpot=True, relaxation=1),
        rig.Slow(relaxation=1, cycles=3),
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_slow_tests_are_those_of_foamfit(setup: rig.Slow, seed: int) -> None:
    course = rig.slow(setup, seed).course
    assert course.rig.motion is not None
    turns = [t for t in course.rig.motion.times if course.start < t < course.end]
    # foamfit interpolates the motion linearly, so a sine and a ramp need many samples.
    samples = 20_001 if setup.motion in ("sine", "ramp") else 1_001
    time = np.union1d(np.linspace(course.start, course.end, samples), turns)
    drive = ff.DisplacementDrive(course.top(time, gauge=False))
    found = ff.simulate(rigs.chain_of(course.rig), drive, time - course.start, rtol=1e-9)
    smooth = ~np.isin(time, [*turns, course.start])  # a dashpot's stress jumps at a turn
    assert over_range(found.base_stress[smooth], course.stress(time)[smooth]) < 1e-6


def test_micro_springs_converge_to_the_law_as_their_number() -> None:
    errors = {n: microscale.error(n) for n in (10, 100)}
    assert microscale.rate(errors) == pytest.approx(-1.0, abs=0.02)
    assert errors[10] == pytest.approx(0.0131, rel=0.01)


# -------------------------------------------------------------- the claims of the paper, in numbers


def test_two_of_three_damping_ratios_follow_from_the_tables() -> None:
    each = {name: claims.ratio_readings(name) for name in claims.SETS}
    formula = {name: next(iter(readings.values())) for name, readings in each.items()}
    assert f"{formula[MODEL_3]:.4f}" == "0.0297"
    assert f"{formula[FOAM_2]:.3f}" == "0.525"
    assert not [one for one in each[MODEL_2].values() if f"{one:.3f}" == "0.894"]
    for name, value in formula.items():
        assert ff.published[name].damping_ratio_by_formula() == pytest.approx(value)
    eta = claims.viscosity_wanted()
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
