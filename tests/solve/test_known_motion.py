"""Chains with memory under a prescribed motion: narrow snaps, equal springs, origins of time."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from foamfit.errors import SimulationError
from foamfit.solve.plan import Plan
from independent import over_range

AREA, H = 1e-3, 10e-3
SHOE = ff.MicroscaleSpring(5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77)
FOAM = ff.published["foam-1/model-3"].bistable
SOFT = replace(FOAM, k0=5e5, kc=8e6, dsigma=-3e4, kh_plus=1e6, kh_minus=3e5)
STRESSES = np.concatenate(
    [
        np.linspace(a, b, 12)[1:]
        for a, b in zip([0, 3e5, 4e4, 2e5, 1e5, 5e5], [3e5, 4e4, 2e5, 1e5, 5e5, 0], strict=True)
    ]
)
TURNS = [0.0, 0.25, 0.1, 0.3, 0.02, 0.4, 0.0]


def narrow(spread: float, **more: float) -> ff.MicroscaleSpring:
    return replace(SHOE, spread_plus=spread, spread_minus=spread, **more)


def chain(*springs: ff.springs.spring.Spring) -> ff.Chain:
    return ff.Chain(springs, [H * (1.0 + 0.3 * i) for i in range(len(springs))], AREA)


@pytest.mark.parametrize("spread", [1e-6, 1e-5, 5e-4, 1e-2, 0.3, 5.0])
@pytest.mark.parametrize("other", [SHOE, SOFT, ff.LinearSpring(2e6)], ids=["micro", "two", "line"])
def test_the_stress_whose_strains_make_the_motion_is_found(spread, other) -> None:
    """The laws give the strain of every spring under a stress, and so the motion to prescribe."""
    given = chain(narrow(spread), other, narrow(3.0 * spread, sigma_plus=1.7e5))
    strains = np.array([spring.strain(STRESSES) for spring in given.springs])
    above = np.cumsum(np.array(given.heights)[:, None] * strains, axis=0)
    time = np.cumsum(10.0 ** np.linspace(-8.0, 0.0, STRESSES.size))
    for rtol in (1e-4, 1e-8):
        got = ff.simulate(given, ff.DisplacementDrive(above[-1]), time, rtol)
        # A narrow spread amplifies rounding of the stress in the rank.
        assert over_range(got.base_stress, STRESSES) <= 1e-12 + 1e-15 / min(spread, 1.0)
        assert over_range(got.displacement, above) <= 1e-12 + 1e-15 / min(spread, 1.0)


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_like_springs_share_the_motion(rtol) -> None:
    """Two equal springs act as one of twice the height, with derivatives and without."""
    top = np.interp(np.linspace(0.0, 6.0, 61), np.arange(7.0), 2 * H * np.array(TURNS))
    time, drive = np.linspace(0.0, 1.0, 61), ff.DisplacementDrive(top)
    for spring in (narrow(1e-5), SHOE, replace(SHOE, relaxation=[(0.5, 0.1)])):
        one = ff.simulate(ff.Chain([spring], [2 * H], AREA), drive, time, rtol)
        two = ff.Chain([spring] * 2, [H] * 2, AREA)
        for names in ((), ("s1_k0",)):
            got = ff.simulate(two, drive, time, rtol, sensitivities=names)
            assert over_range(got.base_stress, one.base_stress) <= rtol
            assert over_range(got.displacement[0], 0.5 * top) <= rtol


@pytest.mark.parametrize("eta", [0.0, 2e3])
def test_no_origin_of_time_takes_digits(eta) -> None:
    """Steps of about 1 µs at 1.7e9 s, chosen as whole multiples of one ulp of that time."""
    step, origin = 2.0**-20, 1.7e9
    given = chain(replace(SHOE, eta=eta, relaxation=[(0.5, 2e-5)]), replace(SHOE, k0=8e5))
    top = np.interp(np.linspace(0.0, 6.0, 61), np.arange(7.0), 2 * H * np.array(TURNS))
    runs = [
        ff.simulate(given, ff.DisplacementDrive(top), at + step * np.arange(61.0))
        for at in (0.0, origin)
    ]
    np.testing.assert_array_equal(runs[1].base_stress, runs[0].base_stress)
    np.testing.assert_array_equal(runs[1].displacement, runs[0].displacement)
    np.testing.assert_allclose(runs[1].switches[:, 0] - origin, runs[0].switches[:, 0], atol=step)


def test_a_top_that_is_not_where_it_was_prescribed_is_refused(monkeypatch) -> None:
    run, top, time = Plan.run, 2 * H * np.array(TURNS), np.linspace(0.0, 1.0, 7)

    def drifted(self: Plan, *given, **more):
        motion = run(self, *given, **more)
        return replace(motion, displacement=motion.displacement * (1.0 + 1e-5))

    monkeypatch.setattr(Plan, "run", drifted)
    with pytest.raises(SimulationError, match="miss the prescribed displacement by 1e-05 of its"):
        ff.simulate(chain(SHOE, SOFT), ff.DisplacementDrive(top), time)
    assert ff.simulate(chain(SHOE, SOFT), ff.DisplacementDrive(top), time, 1e-4).steps == 0


@pytest.mark.parametrize("like", [0.0, 1e-9, 1e-6, -1e-6])
def test_springs_alike_are_answered_while_the_motion_holds(like) -> None:
    """Rounding once reversed the springs in turn, and some values of rtol led to a refusal."""
    spring, time = replace(SHOE, relaxation=[(0.5, 0.1)]), np.linspace(0.0, 1.0, 41)
    given = ff.Chain([replace(spring, k0=spring.k0 * (1.0 + like)), spring], [H, H], AREA)
    drive = ff.DisplacementDrive(2 * H * np.interp(time, [0, 0.4, 0.7, 1], [0, 0.35, 0.35, 0.05]))
    runs = [ff.simulate(given, drive, time, rtol).base_stress for rtol in (1e-4, 1e-6, 1e-8, 1e-10)]
    for got, rtol in zip(runs, (1e-4, 1e-6, 1e-8), strict=False):
        assert over_range(got, runs[-1]) <= rtol
