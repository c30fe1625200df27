"""Compiled laws: the contract between laws and solvers, the built-in laws, and rows of springs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.springs.laws.record import Functions, Law

if TYPE_CHECKING:
    from foamfit.springs.compiled.contract import Compiled


@cache
def compiled(law: Law) -> Compiled:
    """Return the compiled functions of a law."""
    given: Any = law.functions
    if isinstance(given, str):  # built in
        module, _, name = given.partition(".")
        given = getattr(import_module(f"foamfit.springs.compiled.{module}"), name)
    elif isinstance(given, Functions):
        from foamfit.springs.compiled.registered import compile_law

        given = compile_law(law)
    return given


def slopes_of(laws: Sequence[Compiled], rows: Array) -> Array:
    """Return slopes dσ/dε (Pa) at zero stress: at rest, and of the steepest branch, (2, n)."""
    found = [[rows.item(i, column) for column in one.slopes] or [1.0] for i, one in enumerate(laws)]
    return np.array([[one[0] for one in found], [max(one) for one in found]])


def fill_row(made: Compiled, values: Array, terms: Array, room: int, row: Array) -> bool:
    """Fill a row: eta, `room` relaxation terms, row of the law; return if it is admissible."""
    own, eta = 1 + 2 * room, values.item(-1)
    fine = made.fill(values[:-1], row[own : own + made.columns]) and eta >= 0.0
    row[0] = eta
    if room:
        row[2:own:2] = np.inf  # unused terms
        row[1 : 1 + terms.size] = terms
        for g, tau in terms.reshape(-1, 2).tolist():
            fine = fine and 0.0 <= g < math.inf and 0.0 < tau < math.inf
    return bool(fine)
