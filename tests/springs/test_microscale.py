"""The microscale law against root finding on an independent implementation of the law."""

import itertools

import numpy as np
import pytest

import foamfit as ff
from foamfit.springs.model import Model
from reference import Microscale

SHOE = ff.MicroscaleSpring(5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77)
SPRINGS = {
    "shoe foam": SHOE,
    "narrow": ff.MicroscaleSpring(5e5, 1e6, 0.2, 1e5, 1e-3, 4e4, 2e-3),
    "wide": ff.MicroscaleSpring(5e5, 5e5, 0.0, 2e5, 2.0, 5e4, 2.0),
    "reversible at low ranks": ff.MicroscaleSpring(5e5, 4e6, 0.6, 1e5, 1.2, 5e4, 0.1),
    "reversible at high ranks": ff.MicroscaleSpring(5e5, 1e5, 0.3, 1e5, 0.01, 6e4, 1.0),
    "reversible everywhere": ff.MicroscaleSpring(5e5, 2.5e5, 0.08, 1e5, 0.3, 2e5, 0.3),
    "hard to snap": ff.MicroscaleSpring(5e5, 2.5e5, 0.08, 6e5, 0.2, 3e5, 0.3),
}
EACH = pytest.mark.parametrize("spring", SPRINGS.values(), ids=SPRINGS)
TURNS = (0.0, 0.5, 0.3, 0.4, 0.15, 0.45, 0.7, -0.05, 0.25, 0.1, 0.9)


def walk(turns: tuple[float, ...] = TURNS, between: int = 5) -> np.ndarray:
    """Return strains with `between` steps from one turning point to the next."""
    return np.concatenate(
        [[turns[0]]] + [np.linspace(a, b, between + 1)[1:] for a, b in itertools.pairwise(turns)]
    )


@EACH
def test_stress_is_that_of_root_finding_through_reversals(spring: ff.MicroscaleSpring) -> None:
    strain = walk() * min(1.0, 0.9 * (1.0 + spring.eps_star))
    want = Microscale.along(spring, strain, "stress")
    got = spring.stress(strain)
    np.testing.assert_allclose(got, want, rtol=2e-12, atol=1e-12 * np.abs(want).max())


@EACH
def test_strain_is_the_law_written_anew_and_the_inverse(spring: ff.MicroscaleSpring) -> None:
    stress = walk(TURNS, 20) * 5e5
    want, got = Microscale.along(spring, stress, "strain"), spring.strain(stress)
    np.testing.assert_allclose(got, want, rtol=0, atol=3e-15)
    np.testing.assert_allclose(spring.stress(got), stress, rtol=1e-12, atol=1e-9)


def test_branches_of_a_loop_with_an_inner_loop() -> None:
    strain = [0.0, 0.3, 0.2, 0.25, 0.1, 0.15, 0.3, 0.6, -0.1, 0.3]
    assert SHOE.branches(strain).tolist() == [
        "a", "snap-through", "held", "held", "snap-back", "held", "snap-through", "snap-through",
        "a", "snap-through",
    ]  # fmt: skip
    other = SPRINGS["reversible everywhere"].branches(strain)
    assert set(other.tolist()) == {"a", "reversible"}
    narrow = SPRINGS["narrow"]
    assert SHOE.stress(-0.1) == pytest.approx(-5.5e5 * 0.1 / 1.1, rel=1e-15)
    np.testing.assert_array_equal(narrow.branches([0.1, 0.3, 0.25]), ["a", "snap-through", "held"])


@EACH
def test_the_stress_comes_back_to_where_it_turned(spring: ff.MicroscaleSpring) -> None:
    """Return-point memory of an inner loop and of a loop inside it."""
    scale = min(1.0, 0.9 * (1.0 + spring.eps_star))
    strain = np.array([0.6, 0.2, 0.5, 0.3, 0.4, 0.3, 0.5, 0.2, 0.6, 0.8]) * scale
    stress = spring.stress(strain)
    np.testing.assert_allclose(stress[[8, 7, 6, 5]], stress[[0, 1, 2, 3]], rtol=3e-14)
    straight = spring.stress([0.6 * scale, 0.8 * scale])
    np.testing.assert_allclose(stress[[0, 9]], straight, rtol=3e-14)


@pytest.mark.parametrize("beyond", [0.0, 1e-9, 1.0])
def test_strain_past_the_pole_is_refused(beyond: float) -> None:
    with pytest.raises(ff.SimulationError, match=r"sample 2.*1 \+ eps_star"):
        SHOE.stress([0.0, 0.9, 1.08 + beyond, 0.0])
    assert np.isfinite(SHOE.stress([0.0, 1.08 - 1e-12, 0.0])).all()
    with pytest.raises(ff.SimulationError, match=r"stress -550000 Pa \(sample 1\)"):
        SHOE.strain([0.0, -5.5e5])


@EACH
def test_slope_is_that_of_the_stress(spring: ff.MicroscaleSpring) -> None:
    """The slope is that in the direction of loading, a third of the way into each leg."""
    turns = np.array(TURNS) * min(1.0, 0.9 * (1.0 + spring.eps_star))
    for k in range(1, turns.size):
        here = turns[k - 1] + (turns[k] - turns[k - 1]) / 3
        step = np.sign(turns[k] - turns[k - 1]) * 1e-7
        path = [*turns[:k], here - step, here, here + step]
        stress, slope = spring.stress(path), spring.tangent(path)
        rough = (stress[-1] - stress[-3]) / (2 * step)
        assert slope[-2] == pytest.approx(rough, rel=3e-3 if spring.spread_plus < 0.1 else 1e-6)


def test_the_held_rank_at_the_end_of_its_stresses_is_held() -> None:
    """After snapping back to rank 0, a spring keeps its rank up to and including sigma_plus."""
    spring = SPRINGS["reversible at low ranks"]
    stress = np.array([0.0, 3e5, 5e4, 1e5])
    assert (spring.fraction_along(stress)[2:] == 0.5).all()
    got = ff.simulate(ff.Chain([spring], [1.0], 1.0), ff.StressDrive(stress), np.arange(4.0))
    np.testing.assert_array_equal(got.switches[:, [0, 3]], [(1.0, 1), (2.0, 3), (3.0, 2)])
    s = stress[2:]
    want = 0.5 * (s / (spring.k0 + s) + spring.eps_star + s / (spring.kc + s))
    np.testing.assert_allclose(got.displacement[0, 2:], want, rtol=1e-15)


@pytest.mark.parametrize("spread", [1e-6, 1e-5])
def test_a_narrow_snap_goes_on_at_the_stress_at_which_it_turned(spread: float) -> None:
    """One ulp of the stress spans many ranks; only the strain resolves the snapped fraction."""
    spring = ff.MicroscaleSpring(2.5e6, 2.1e8, 1.09, 7.5e4, spread, 7.2e3, 0.46)
    for turn in np.linspace(0.1, 1.0, 50):
        there, _, again = spring.stress(np.array([turn, 0.99 * turn, turn]))
        assert again == pytest.approx(there, rel=5e-14)


# ---------------------------------------------------------------- the vector of parameters

MICROSCALE = (5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, 3.0)


@pytest.mark.parametrize("place", range(13))
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_vector_that_is_not_admissible_has_no_rows(place: int, value: float) -> None:
    model = Model.parse("microscale", relaxation=2)
    values = np.array([*MICROSCALE, 0.5, 0.2, 0.0, 3.0, 0.0])
    assert model.rows(values) is not None
    values[place] = value
    if place == 12 or (place == 7 and value == np.inf):  # no row contains the onsite damper
        return
    assert model.rows(values) is None
    with pytest.raises(ValueError, match=rf"\b{model.names[place].removeprefix('s1_')}\b"):
        model.springs(values)


@pytest.mark.parametrize("number", [-1, 1.0, True, "1", None])
def test_a_number_of_terms_that_is_none_is_refused(number: object) -> None:
    with pytest.raises(ff.InputError, match=r"relaxation = .* must be a whole number"):
        Model.parse("bistable", number)  # type: ignore[arg-type]
    with pytest.raises(ff.InputError, match="no hysteretic spring that could relax"):
        Model.parse("linear", 1)


@pytest.mark.parametrize("given", [0.5, [0.5], [(0.5,)], [(0.5, 0.2, 0.1)], None, [None]])
def test_relaxation_that_is_no_sequence_of_pairs_is_refused(given: object) -> None:
    with pytest.raises(ff.InputError, match=r"^relaxation must be a sequence of pairs"):
        ff.MicroscaleSpring(*MICROSCALE, relaxation=given)  # type: ignore[arg-type]
