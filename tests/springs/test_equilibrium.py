"""Springs in series in equilibrium: every switch is followed, however coarse the samples."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import foamfit as ff
from strategies import admissible_springs

AREA = 2e-5
FOAM = ff.published["foam-1/model-1"].bistable
SOFT = replace(FOAM, k0=3e6, dsigma=-0.05e6)


def chain(*springs, heights=None):
    return ff.Chain(springs, heights or [1e-3] * len(springs), AREA)


def drive(structure, top):
    top = np.asarray(top, float)
    return ff.simulate(structure, ff.DisplacementDrive(top), np.arange(top.size, dtype=float))


def there_and_back(peak, n):
    return np.concatenate([np.linspace(0, peak, n), np.linspace(peak, 0.02 * peak, n)[1:]])


@pytest.mark.parametrize("springs", [(FOAM, SOFT), (SOFT, FOAM, FOAM), (FOAM,) * 5])
def test_coarse_samples_end_where_fine_ones_do(springs):
    """Several springs switch between two coarse samples; fine samples resolve every switch."""
    peak = 0.40e-3 * len(springs)
    fine = drive(chain(*springs), there_and_back(peak, 4001))
    coarse = drive(chain(*springs), there_and_back(peak, 9))
    scale = np.ptp(fine.base_stress)
    np.testing.assert_allclose(coarse.base_stress, fine.base_stress[::500], atol=1e-12 * scale)
    np.testing.assert_allclose(coarse.displacement, fine.displacement[:, ::500], atol=1e-12 * peak)
    counts = [np.unique(fine.switches[:, 1], return_counts=True)[1]]
    assert np.min(counts) >= 3  # every spring went through its loop


@settings(max_examples=40, deadline=None)
@given(
    springs=st.lists(admissible_springs(sloped=True), min_size=2, max_size=4),
    turns=st.lists(st.floats(0.05, 0.6), min_size=2, max_size=5),
)
def test_all_springs_carry_one_stress_and_fill_the_elongation(springs, turns):
    """For any history, the law of each spring along its own strain gives the base stress."""
    structure = chain(*springs)
    top = np.concatenate([[0.0], np.array(turns) * structure.height])
    top = np.interp(np.linspace(0, len(turns), 60 * len(turns) + 1), np.arange(top.size), top)
    response = drive(structure, top)
    np.testing.assert_allclose(response.displacement[-1], top, atol=1e-12 * structure.height)
    strains = np.diff(response.displacement, axis=0, prepend=0.0) / 1e-3
    largest = np.max(np.abs(response.base_stress))
    for spring, strain in zip(springs, strains, strict=True):
        along = spring.stress(strain)
        stiff = spring.tangent(strain)  # strains are exact only to rounding
        slack = 1e-9 * largest + 1e-12 * stiff
        switched = spring.branches(strain) != np.roll(spring.branches(strain), 1)
        assert np.all((np.abs(along - response.base_stress) <= slack) | switched)


def test_flat_branches_are_shared_from_the_base_up():
    """With k_h+ = 0 the split on the plateau is open; by convention the base spring snaps first."""
    flat = replace(FOAM, kh_plus=0.0)
    structure = chain(flat, flat, flat)
    at_a1 = 3 * flat.eps_a * 1e-3
    snap = (flat.eps_hat_c - flat.eps_a) * 1e-3
    top = np.concatenate([np.linspace(0, at_a1, 20), at_a1 + snap * np.linspace(0, 3, 31)[1:]])
    response = drive(structure, top)
    on_plateau = response.base_stress[20:-1]
    np.testing.assert_allclose(on_plateau, flat.sigma_a, rtol=1e-12)
    strains = np.diff(response.displacement, axis=0, prepend=0.0) / 1e-3
    np.testing.assert_allclose(strains[0, 29:], flat.eps_hat_c, rtol=1e-9)  # first third: base
    np.testing.assert_allclose(strains[2, 20:40], flat.eps_a, rtol=1e-9)  # the top snaps last
    np.testing.assert_allclose(response.displacement[-1], top, atol=1e-15)


def test_a_plateau_is_left_on_the_way_back():
    flat = replace(FOAM, kh_plus=0.0)
    structure = chain(flat, flat)
    at_a1 = 2 * flat.eps_a * 1e-3
    top = [0.0, at_a1 + 0.05e-3, at_a1, 0.5 * at_a1, 0.0]
    response = drive(structure, top)
    assert response.base_stress[1] == pytest.approx(flat.sigma_a, rel=1e-12)
    half = flat.stress([0.5 * flat.eps_a])[0]
    assert response.base_stress[3] == pytest.approx(half, rel=1e-9)
    assert response.base_stress[4] == pytest.approx(0.0, abs=1e-6)
