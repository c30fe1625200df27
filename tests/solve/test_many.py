"""Many springs under one stress solved together: the same curves at linear cost."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from test_simulation import AREA, MODEL_1

import foamfit as ff
from foamfit.solve import plan as planned
from foamfit.solve.compiled import groups
from foamfit.solve.plan import AGGREGATE, EXPLICIT_STEPS
from foamfit.solve.simulation import Response
from foamfit.springs.laws.bistable import LAW
from reference import law

TIME = np.linspace(-0.05e-3, 0.9e-3, 301)
HEIGHT = 1.19e-3
STRIKER = 7e-3
# Unloading starts on branch d at the first speed, with some springs on c at the second, and beyond
# c at the others.
SPEEDS = (1.2, 1.8, 2.1, 3.0)


def unlike(spring: ff.BistableSpring, factor: float) -> ff.BistableSpring:
    """Return the spring with all stresses multiplied by `factor`."""
    scaled = {
        name: factor * getattr(spring, name)
        for name in ("k0", "kc", "dsigma", "kh_plus", "kh_minus")
    }
    return dataclasses.replace(spring, **scaled)


def chain_of(count: int, spread: float = 0.1, linear: bool = False, drag: float = 0.0) -> ff.Chain:
    """Return `count` springs like foam-1's with stresses varied by ± spread; a fifth may be linear.

    In every other one, branch e meets branch a in compression; the others stay on e to the end.
    """
    factors = 1.0 + spread * np.random.default_rng(count).uniform(-1.0, 1.0, count)
    springs: list[Any] = [unlike(MODEL_1, factor) for factor in factors]
    springs[1::2] = [dataclasses.replace(s, kh_minus=0.7 * s.kh_minus) for s in springs[1::2]]
    if linear:
        springs[::5] = [ff.LinearSpring(60e6 * factor) for factor in factors[::5]]
    shares = 1.0 + 0.3 * np.cos(np.arange(count))
    return ff.Chain(springs, HEIGHT * shares / shares.sum(), AREA, site_damping=drag)


def one_by_one(chain: ff.Chain, speed: float, time: np.ndarray = TIME) -> Response:
    """Simulate the impact with every spring followed through every step, at rtol = 1e-11."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planned, "LEAST_AGGREGATE", 10**9)
        response = ff.simulate(chain, ff.Impact(STRIKER, speed), time, rtol=1e-11)
    assert response.method == EXPLICIT_STEPS
    return response


def base_first(switches: np.ndarray) -> np.ndarray:
    """Return switches with those of one instant in the order of the springs."""
    instants = np.cumsum(np.diff(switches[:, 0], prepend=switches[:1, 0]) > 1e-12)
    return switches[np.lexsort((switches[:, 1], instants))]


def assert_same(got: Response, want: Response, most: float = 1e-9) -> None:
    """Assert equal curves (to `most` of their range), switches and end of contact."""
    assert got.method == AGGREGATE
    for a, b in ((got.displacement, want.displacement), (got.base_stress, want.base_stress)):
        assert np.abs(a - b).max() <= most * np.ptp(b)
    one, other = base_first(got.switches), base_first(want.switches)
    assert np.array_equal(one[:, 1:4], other[:, 1:4])
    assert np.allclose(one[:, [0, 4]], other[:, [0, 4]], rtol=0.0, atol=1e-12)
    assert (got.contact_end is None) == (want.contact_end is None)
    if want.contact_end is not None:
        assert got.contact_end == pytest.approx(want.contact_end, rel=1e-9)


@pytest.mark.parametrize("count", [10, 60])
@pytest.mark.parametrize("drag", [0.0, 2e2, 1e4])
@pytest.mark.parametrize("linear", [False, True])
def test_the_springs_as_one_move_as_each_by_itself(count: int, drag: float, linear: bool) -> None:
    chain = chain_of(count, linear=linear, drag=drag)
    seen = set()
    for speed in SPEEDS:
        got = ff.simulate(chain, ff.Impact(STRIKER, speed), TIME)
        assert_same(got, one_by_one(chain, speed))
        seen |= {LAW.named_branch(int(branch)) for branch in got.switches[:, 3]}
    assert seen == (set() if drag == 1e4 else {"a", "d", "c", "e"})


@pytest.mark.parametrize("speed", SPEEDS)
def test_what_the_striker_loses_stays_in_the_loops(speed: float) -> None:
    chain, blow = chain_of(30), ff.Impact(STRIKER, speed)
    response = ff.simulate(chain, blow, TIME)
    flight = response.time > response.contact_end
    away = np.diff(response.displacement[-1, -2:])[0] / np.diff(TIME[-2:])[0]
    still = response.displacement - flight * away * (TIME - response.contact_end)
    strains = np.diff(still, axis=0, prepend=0.0) / np.array(chain.heights)[:, None]
    work = dissipated = 0.0
    for spring, height, strain in zip(chain.springs, chain.heights, strains, strict=True):
        one = law(spring)
        work += AREA * height * one.work(strain)[-1]
        steps = (step for way in one.pieces(strain) for step in itertools.pairwise(way))
        closed = sum((before[0], after[0]) == ("e", "a") for before, after in steps)
        dissipated += AREA * height * one.loop * closed if closed else 0.0
    assert work + 0.5 * STRIKER * away**2 == pytest.approx(0.5 * STRIKER * speed**2, rel=1e-8)
    assert (dissipated > 0.0) == (speed > 1.5)


def test_a_thousand_springs_take_a_step_for_each_switch() -> None:
    """Each spring goes from a to d, d to c, c to e, and every other one from e to a."""
    got = ff.simulate(chain_of(1000), ff.Impact(STRIKER, 2.1), TIME)
    assert got.method == AGGREGATE
    assert len(got.switches) == 3500
    assert got.steps <= 3600


def test_like_springs_switch_together_and_nearly_like_ones_one_by_one() -> None:
    same = chain_of(9, spread=0.0)
    got = ff.simulate(same, ff.Impact(STRIKER, 2.1), TIME)
    assert got.steps < 60
    assert len(np.unique(got.switches[:, 0])) == 4
    assert len(got.switches) == 31
    assert_same(got, one_by_one(same, 2.1))
    for spread in (1e-15, 1e-13, 1e-10):
        nearly = chain_of(9, spread=spread)
        got = ff.simulate(nearly, ff.Impact(STRIKER, 2.1), TIME)
        assert len(got.switches) == 31
        assert np.abs(got.base_stress - one_by_one(same, 2.1).base_stress).max() <= 1e-8 * np.ptp(
            got.base_stress
        )


# ---------------------------------------------------------------- a prescribed elongation

# Reversals on every branch, tension, and strains past all switches.
TURNS = [0.0, 0.22, 0.05, 0.3, 0.18, 0.45, 0.38, 0.41, 0.12, 0.24, -0.1, 0.5, 0.0]
TO_AND_FRO = np.concatenate(
    [HEIGHT * np.linspace(a, b, 61)[1:] for a, b in itertools.pairwise(TURNS)]
)


@pytest.mark.parametrize("count", [3, 8, 40, 300])
@pytest.mark.parametrize("linear", [False, True])
def test_springs_under_a_known_elongation_carry_one_stress(
    monkeypatch: pytest.MonkeyPatch, count: int, linear: bool
) -> None:
    """The strains add up to the elongation and satisfy the spring laws on every branch."""
    chain, found, balance = chain_of(count, linear=linear), [], groups.balance

    def kept(*given: np.ndarray) -> float:
        miss = balance(*given)
        found.extend(given[-1])
        return miss

    monkeypatch.setattr(groups, "balance", kept)
    drive, time = ff.DisplacementDrive(TO_AND_FRO), np.arange(float(TO_AND_FRO.size))
    stress = ff.simulate(chain, drive, time).base_stress
    (strain, branches), heights = found, chain.arrays.heights
    assert np.abs(heights @ strain - TO_AND_FRO).max() <= 1e-13 * HEIGHT
    for spring, own in zip(chain.springs, strain, strict=True):
        assert np.abs(spring.stress(own) - stress).max() <= 1e-11 * np.ptp(stress)
    seen = {(one, number) for one, own in zip(chain.laws, branches, strict=True) for number in own}
    assert len(seen) == (5 if linear else 4)


def test_an_elongation_that_no_stress_gives_is_no_number() -> None:
    chain = chain_of(20)
    for most in (1.5 * HEIGHT, 1e300, -1e300):
        with pytest.raises(ff.SimulationError, match=r"end of (a|its) branch"):
            ff.simulate(chain, ff.DisplacementDrive(np.linspace(0.0, most, 31)), TIME[:31])


def test_tension_beyond_the_least_slope_is_borne_on_a_straight_branch() -> None:
    """When the stress passes its -k0, the softest spring is on branch e, which has no pole."""
    soft = ff.BistableSpring(1e5, 1e5, 0.0, 0.5, 0.75, 1e5, 4e5)
    stiff = ff.BistableSpring(1e7, 1e7, 0.0, 0.5, 0.75, 1e7, 1.3e7)
    chain = ff.Chain([soft, stiff, stiff], [1e-3] * 3, AREA)
    top = 3e-3 * np.interp(np.arange(121.0), [0, 60, 120], [0.0, 0.5, 0.0625])
    response = ff.simulate(chain, ff.DisplacementDrive(top), np.arange(121.0))
    assert response.base_stress.min() < -1e5
    strain = np.diff(response.displacement, axis=0, prepend=0.0) / 1e-3
    for spring, own in zip(chain.springs, strain, strict=True):
        assert np.abs(spring.stress(own) - response.base_stress).max() <= 1e-6
