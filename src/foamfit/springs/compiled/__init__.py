"""Compiled laws: the contract between laws and solvers, the built-in laws, and rows of springs."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from foamfit.arrays import Array

if TYPE_CHECKING:
    from foamfit.springs.compiled.contract import Compiled
    from foamfit.springs.laws.record import Law


def built_in(kind: str) -> Compiled:
    """Return the compiled functions of a built-in law."""
    if kind.startswith("microscale"):
        from foamfit.springs.compiled import microscale

        return microscale.COMPILED
    from foamfit.springs.compiled import bistable

    return {
        "bistable": bistable.COMPILED, "linear": bistable.LINEAR, "unilateral": bistable.UNILATERAL
    }[kind]  # fmt: skip


@cache
def compiled(law: Law) -> Compiled:
    """Return the compiled functions of a law."""
    given: Any = law.functions
    if isinstance(given, str):
        return built_in(given)
    from foamfit.springs.compiled.own import compile_law

    return compile_law(law)


def row_of(law: Law, values: ArrayLike) -> Array | None:
    """Return the row of a law from its parameters (and eta); None if they are not admissible."""
    made = compiled(law)
    row, own = np.zeros(made.columns), np.array(values, dtype=float)[: len(law.params)]
    return row if made.fill(own, row) else None


def solver_row(law: Law, values: Array, terms: ArrayLike, room: int) -> Array | None:
    """Return the row of a spring for the solver; None if it is not admissible.

    `values` are the parameters and eta. The row contains eta, `room` relaxation terms (g, τ), and
    the row of the law.
    """
    from foamfit.springs.compiled.contract import TINY

    made, pairs = compiled(law), np.ravel(terms)
    row = np.zeros(1 + 2 * room + made.columns)
    fine = made.fill(values[:-1], row[1 + 2 * room :]) and values[-1] >= 0.0
    row[0], row[2 : 1 + 2 * room : 2] = values[-1], np.inf  # unused terms
    if made.damps and values[-1] == 0.0:
        row[0] = TINY
    row[1 : 1 + pairs.size] = pairs
    for g, tau in pairs.reshape(-1, 2).tolist():
        fine = fine and 0.0 <= g < math.inf and 0.0 < tau < math.inf
    return row if fine else None
