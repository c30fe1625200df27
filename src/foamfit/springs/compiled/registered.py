"""A registered law, compiled to the contract of the solvers by the functions of `compiled.own`."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.extending import intrinsic

from foamfit.arrays import Array
from foamfit.springs.compiled.contract import (
    EXPLICIT,
    FADES,
    FLOWS,
    INTERNAL,
    OPTIONS,
    REAL,
    REALS_AT,
    RESULTS,
    SPRING,
    STILL,
    TINY,
    Compiled,
    call_begin,
    past,
    results_of,
)  # fmt: skip
from foamfit.springs.compiled.own import (
    BEGIN,
    BOUNDED,
    COMPLEXES,
    COUNT,
    DAMPS,
    ENDS,
    FORMULA,
    FORMULAS,
    INSIDE,
    KIND,
    OTHERS,
    UP,
    VALUES,
    slope_at_rest,
)  # fmt: skip

if TYPE_CHECKING:
    from foamfit.springs.laws.record import Functions, Law

_ALONE: dict[str, Any] = {
    **OPTIONS,
    "no_rewrites": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
_WITHIN: dict[str, Any] = {**_ALONE, "_nrt": False}
kept: list[Any] = []  # compiled functions, whose addresses stay valid


@njit(**_WITHIN)
def _nothing(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    """Leave rates at zero, and the branch without ends."""


@njit(**_WITHIN)
def _same(p, x, strain, branch, up):  # type: ignore[no-untyped-def]
    """Stay on the branch."""
    return branch


@njit(**_WITHIN)
def _no_stress(p, x, strain, rate, branch):  # type: ignore[no-untyped-def]
    return 0j


@cache
def _inside(function: Any, otherwise: Any = None) -> Any:
    """Return a function of a law, to be compiled into that of the law."""
    if function is None:
        return otherwise
    return njit(**_WITHIN)(getattr(function, "py_func", function))


def _tuple_at(count: int) -> Any:
    """Return a function that loads numbers as a tuple."""
    kind = types.UniTuple(types.complex128, count)

    @intrinsic
    def load(typing, pointer):  # type: ignore[no-untyped-def]
        def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
            at = [builder.gep(args[0], [ir.Constant(ir.IntType(64), k)]) for k in range(count)]
            return context.make_tuple(builder, kind, [builder.load(one) for one in at])

        return kind(COMPLEXES), emit

    return load


def _formulas(given: Functions, count: int, inside: int) -> Any:
    """Compile the functions of a law into one."""
    stress, viscous = _inside(given.stress), _inside(given.viscous, _no_stress)
    along, decay = _inside(given.along, _nothing), _inside(given.decay, _nothing)
    ends, change = _inside(given.ends, _nothing), _inside(given.switch, _same)
    load = _tuple_at(count)

    @njit(FORMULA, **_ALONE)
    def formulas(point, branch, what, out):  # type: ignore[no-untyped-def]
        p, x = load(past(point, 2 + inside)), carray(past(point, 2), (inside,))
        strain = point[0]
        if what == VALUES:
            out[0] = complex(math.nan, 0.0)  # of a formula that divides by zero
            out[0], out[1] = stress(p, x, strain, branch), viscous(p, x, strain, point[1], branch)
            one, two = carray(past(out, 2), (inside,)), carray(past(out, 2 + inside), (inside,))
            for k in range(2 * inside):
                out[2 + k] = 0j
            along(p, x, strain, branch, one)
            decay(p, x, strain, branch, two)
        elif what == ENDS:
            ends(p, x, strain, branch, carray(out, (3,)))
        else:
            return int(change(p, x, strain, branch, what == UP))
        return branch

    return formulas


def compile_law(law: Law) -> Compiled:
    """Compile a registered law."""
    given: Any = law.functions
    count, inside = len(law.params), law.internal
    simple = inside == 0 and given.viscous is None
    kind, bounded = EXPLICIT if simple else INTERNAL, float(given.ends is not None)
    damps = float(given.viscous is not None)
    formulas = _formulas(given, count, inside)
    made = formulas.overloads[FORMULA.args]
    where = float(made.library.get_pointer_to_function(made.fndesc.llvm_func_name))  # below 2^53

    begin_any = BEGIN

    @cfunc(REAL(REALS_AT, SPRING), **OPTIONS)
    def begin(row, s):  # type: ignore[no-untyped-def]
        s[FORMULAS], s[KIND], s[COUNT], s[INSIDE] = where, kind, count, inside
        s[BOUNDED], s[DAMPS] = bounded, damps
        call_begin(begin_any, row, s)
        return 0.0

    addresses: Any = begin.address, *OTHERS
    kept.append((formulas, begin))  # the addresses stay valid
    # parameters, slope at rest, then room for complex numbers
    columns = count + 1 + 2 * (2 + inside + count + max(3, 2 + 2 * inside))
    fill = _fill(given.admissible, count, addresses, RESULTS + results_of(count, inside))
    flows = FLOWS if given.along or given.viscous else FADES if given.decay else STILL
    if flows == FADES and (given.ends or given.switch):
        flows = FLOWS
    return Compiled(
        fill, kind, columns, count, inside, addresses, (count,), -1, damps * TINY, flows
    )


def _fill(
    admissible: Callable[[Array], bool] | None, count: int, addresses: tuple[int, ...], size: int
) -> Callable[[Array, Array], bool]:
    """Return the function that writes a row."""
    where, work = np.array(addresses), np.zeros(size)

    def fill(values: Array, row: Array) -> bool:
        row[:count] = values
        if not np.isfinite(values).all() or not (admissible is None or admissible(values)):
            return False
        slope = float(slope_at_rest(where, row, work))
        row[count] = slope if 0.0 < slope < math.inf else 1.0
        return True

    return fill
