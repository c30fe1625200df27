"""The flat parameter vector with microscale springs and relaxation terms."""

from __future__ import annotations

import numpy as np
import pytest

import foamfit as ff
from foamfit.springs.model import Model

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
