"""The flat parameter vector with microscale springs and relaxation terms."""

from __future__ import annotations

import numpy as np
import pytest

import foamfit as ff
from foamfit.springs.compiled import compiled
from foamfit.springs.laws.record import OWN_ETA, OWN_HEIGHT, OWN_RELAXATION
from foamfit.springs.model import Model
from foamfit.springs.parameters import unit_of

MICROSCALE = (5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, 3.0)
BISTABLE = (5.5e6, 82.5e6, -0.179e6, 0.14, 0.31, 14.3e6, 2.3e6, 0.0)
TERMS = ((0.5, 0.2), (0.0, 3.0))


def test_a_vector_with_relaxation_becomes_springs_and_rows() -> None:
    model = Model.parse("linear+microscale+bistable", relaxation=2)
    flat = [t for pair in TERMS for t in pair]
    values = np.array([6e7, 0.0, *MICROSCALE, *flat, *BISTABLE, *flat, 1e-3, 1e-3, 1e-3, 0.0])
    assert len(values) == len(model.names)
    chain = model.chain(values, 3e-3, 1e-5)
    assert chain.springs == (
        ff.LinearSpring(6e7),
        ff.MicroscaleSpring(*MICROSCALE, relaxation=TERMS),
        ff.BistableSpring(*BISTABLE, relaxation=TERMS),
    )
    rows = model.rows(values)
    assert rows is not None
    linear, own, _ = columns = [compiled(law).columns for law in model.laws]
    assert rows.shape == (3, 5 + max(columns))  # dashpot, terms, and the row of the law
    np.testing.assert_array_equal(chain.arrays.rows, rows)
    np.testing.assert_array_equal(rows[:, 0], [0.0, 3.0, 0.0])
    np.testing.assert_array_equal(rows[1:, 1:5], [flat, flat])
    np.testing.assert_array_equal(rows[0, 1:5], [0.0, np.inf, 0.0, np.inf])
    assert not rows[0, 5 + linear :].any()
    bare = Model.parse("microscale").rows(np.array([*MICROSCALE, 0.0]))
    assert bare is not None
    assert bare.shape == (1, 1 + own)
    np.testing.assert_array_equal(bare[0, 0], rows[1, 0])
    np.testing.assert_array_equal(bare[0, 1:], rows[1, 5 : 5 + own])


def test_names_units_and_directions_of_relaxation_terms() -> None:
    model = Model.parse("microscale", relaxation=2)
    assert model.names[7:-1] == ("s1_eta", "s1_g1", "s1_tau1", "s1_g2", "s1_tau2")
    own = dict(zip(model.names, model.directions[:, 1].tolist(), strict=True))
    assert own["s1_eta"] == OWN_ETA
    assert own["s1_spread_minus"] == 6
    assert [own[f"s1_{n}"] - OWN_RELAXATION for n in ("g1", "tau1", "g2", "tau2")] == [0, 1, 2, 3]
    assert len({*own.values(), OWN_HEIGHT}) == len(own) + 1
    units = [unit_of(name) for name in model.names]
    assert units == ["Pa", "Pa", "", "Pa", "", "Pa", "", "Pa s", "", "s", "", "s", "Pa s"]


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


@pytest.mark.parametrize("given", [0.5, [0.5], [(0.5,)], [(0.5, 0.2, 0.1)], None, [None]])
def test_relaxation_that_is_no_sequence_of_pairs_is_refused(given: object) -> None:
    with pytest.raises(ff.InputError, match=r"^relaxation must be a sequence of pairs"):
        ff.MicroscaleSpring(*MICROSCALE, relaxation=given)  # type: ignore[arg-type]
