"""Compiled laws: the contract between laws and solvers, the built-in laws, and rows of springs."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
    from foamfit.springs.laws.record import Functions

    if not isinstance(given, Functions):
        return given  # of a law that the solver has made
    from foamfit.springs.compiled.registered import compile_law

    return compile_law(law)


def slopes_of(laws: Sequence[Compiled], rows: Array) -> Array:
    """Return slopes dσ/dε (Pa) at zero stress of springs with these rows of their laws, (2, n).

    The first is that at rest, the second that of the steepest branch.
    """
    found = [[rows.item(i, column) for column in one.slopes] or [1.0] for i, one in enumerate(laws)]
    return np.array([[one[0] for one in found], [max(one) for one in found]])


def solver_row(law: Law, values: Array, terms: ArrayLike = (), room: int = 0) -> Array | None:
    """Return the row of a spring for the solver; None if it is not admissible.

    `values` are the parameters and eta. The row contains eta, `room` relaxation terms (g, τ), and
    the row of the law.
    """
    made = compiled(law)
    row = np.zeros(1 + 2 * room + made.columns)
    return row if fill_row(made, values, np.ravel(terms), room, row) else None


def fill_row(made: Compiled, values: Array, terms: Array, room: int, row: Array) -> bool:
    """Fill the row of a spring (see `solver_row`); return whether it is admissible."""
    own, eta = 1 + 2 * room, values.item(-1)
    fine = made.fill(values[:-1], row[own : own + made.columns]) and eta >= 0.0
    row[0] = made.least_eta if eta == 0.0 else eta
    if room:
        row[2:own:2] = np.inf  # unused terms
        row[1 : 1 + terms.size] = terms
        for g, tau in terms.reshape(-1, 2).tolist():
            fine = fine and 0.0 <= g < math.inf and 0.0 < tau < math.inf
    return bool(fine)
