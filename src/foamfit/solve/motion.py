"""What a run of a scene finds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array

CLOSED_FORM = "closed form"
NO_SWITCHES, _NONE = np.empty((0, 5)), np.zeros(0)


class Slopes(NamedTuple):
    """Derivatives of displacement (p, nodes, n_t) and base stress (p, n_t) in p directions.

    Of those marked in `one_sided` (p,), there are two.
    """

    displacement: Array
    base_stress: Array
    one_sided: Array = _NONE


class Motion(NamedTuple):
    """The bare outcome of a run; see `Response`. `slopes` is None where none were asked for."""

    displacement: Array
    base_stress: Array
    contact_end: float
    switches: Array
    steps: int
    method: str = CLOSED_FORM
    slopes: Slopes | None = None
    unresolved: float = 0.0  # vibrations that were damped out, relative to the ranges


def list_switches(time: Array, strain: Array, branches: NDArray[np.int64]) -> Array:
    """List the changes of branch between samples, at the later sample."""
    samples, springs = np.nonzero((branches[:, 1:] != branches[:, :-1]).T)
    out, later = np.empty((samples.size, 5)), samples + 1
    out[:, 0], out[:, 1], out[:, 4] = time[later], springs, strain[springs, later]
    out[:, 2], out[:, 3] = branches[springs, samples], branches[springs, later]
    return out
