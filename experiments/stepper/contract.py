"""The contract of a law: three compiled functions that the stepper calls by their addresses.

The stepper is compiled once for all laws; a law is compiled alone, and a registered one runs as
fast as a built-in one. A spring is a row of numbers, which `fill` computes from its parameters, and
a memory of `MEMORY` numbers, which only its law changes, at switches of branch.

    evaluate(row, memory, eps, x, want, out) -> sigma
        Fill out[SLOPE] = dσ/dε and out[MISS] = ε(x) - ε, and if `want` is not 0 the derivatives of
        the stress at fixed strain: by parameter c in out[BY + c], by held number h of the memory in
        out[BY_HELD + h].
    switch(row, memory, eps, x, up, out) -> x
        Change the branch at its upper (up = 1) or lower (0) end or at a turning point. Fill, for
        each held number h, out[h * CHANGE :] with its derivatives by stress, by each held number
        before, and by the parameters. Return the internal variable, improved where it is known.
    begin(row, memory)
        Set the memory at rest.

A law that gives strain by stress has the stress as its internal variable x, which the stepper
integrates with dx/dt = dσ/dε dε/dt; others ignore x. Within a branch the stress is a smooth
function of the strain, the parameters and the held numbers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba import cfunc, njit, types
from numba.extending import intrinsic

# Memory: branch; strains at its ends; TURNS: 1 (-1) if it ends where the strain stops rising
# (falling); numbers held until a switch; then whatever the law keeps.
BRANCH, LOW, HIGH, TURNS, HELD, OWN, MEMORY = 0, 1, 2, 3, 4, 6, 16
HELD_NUMBERS = 2
# Results of `evaluate`; of `switch`, for each held number.
SLOPE, MISS, BY, BY_HELD, RESULTS = 0, 1, 2, 14, 16
OF_STRESS, OF_HELD, OF_PARAMETER, CHANGE = 0, 1, 3, 16

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}
_INSIDE: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
maker = njit(**_INSIDE)
# Without reference counts, which take longer than the loops.
inner = njit(**_INSIDE, _nrt=False)
inlined = njit(**_INSIDE, _nrt=False, forceinline=True)

_F, _I, _P = types.float64, types.int64, types.CPointer(types.float64)
evaluating = cfunc(_F(_P, _P, _F, _F, _I, _P), **OPTIONS)
switching = cfunc(_F(_P, _P, _F, _F, _I, _P), **OPTIONS)
beginning = cfunc(_F(_P, _P), **OPTIONS)


class Law(NamedTuple):
    """A law for the stepper."""

    fill: Callable[..., Any]  #: parameters -> row
    names: tuple[str, ...]  #: of the parameters, in the order of the derivatives
    implicit: bool  #: whether strain is given by stress, its internal variable
    addresses: tuple[int, int, int]  #: of evaluate, switch and begin


@intrinsic
def call_law(typing, address, i, rows, memory, eps, x, flag, out):
    """Call evaluate or switch of spring i; rows of the arrays are passed as pointers."""

    def emit(context, builder, signature, args):
        def row_of(index, which):
            array = context.make_array(signature.args[which])(context, builder, args[which])
            stride = builder.extract_value(array.shape, 1)
            return builder.gep(array.data, [builder.mul(index, stride)])

        given = row_of(args[1], 2), row_of(args[1], 3), args[4], args[5], args[6]
        values = [*given, row_of(args[1], 7)]
        kind = ir.FunctionType(ir.DoubleType(), [value.type for value in values])
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)

    return _F(_I, _I, rows, memory, _F, _F, _I, out), emit


@intrinsic
def call_begin(typing, address, i, rows, memory):
    """Call begin of spring i."""

    def emit(context, builder, signature, args):
        values = []
        for which in (2, 3):
            array = context.make_array(signature.args[which])(context, builder, args[which])
            stride = builder.extract_value(array.shape, 1)
            values.append(builder.gep(array.data, [builder.mul(args[1], stride)]))
        kind = ir.FunctionType(ir.DoubleType(), [value.type for value in values])
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)

    return _F(_I, _I, rows, memory), emit
