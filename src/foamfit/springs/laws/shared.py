"""Shared parts of the built-in laws: stiffnesses, start points with other k_c."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from foamfit.arrays import Array
from foamfit.springs.laws.record import Param

_INNER = (math.log(0.3), math.log(300.0))  # of stiffness divided by largest stress
K0 = Param(
    "k0", ("k", "0"), "Pa", "first slope of branch a", (3.0, "slope"), (1e-3, 1e4), "stress",
    inner=_INNER, branch="a", example="5.5 MPa",
)  # fmt: skip
KC = Param(
    "kc", ("k", "c"), "Pa", "first slope of branch c", (20.0, "slope"), (1e-2, 1e5), "stress",
    inner=_INNER, branch="c", example="82.5 MPa",
)  # fmt: skip
# k_c of further start points, divided by the largest stress.
STEEP = np.geomspace(1.0, 1000.0, 7)


def steeper(values: Array, kc: int, start: int, top: float, low: float) -> Iterator[Array]:
    """Yield springs with another k_c whose branch c has the same strain at the largest stress.

    A search that changes only k_c misses a steep branch c. `kc` and `start` are the indices of k_c
    and of the strain at which branch c begins, at the stress `low`.
    """
    for other in top * STEEP:
        moved = values.copy()
        moved[kc] = other
        rises = [top / (k + top) - low / (k + low) for k in (values[kc], other)]
        moved[start] += rises[0] - rises[1]
        yield moved
