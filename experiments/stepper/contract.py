"""The contract of a law: three compiled functions that the stepper calls by their addresses.

The stepper is compiled once for all laws; a law is compiled alone, and a registered one runs as
fast as a built-in one. A spring is a row of numbers, which `fill` computes from its parameters, and
a memory of RESULTS numbers, which only its law changes, at switches of branch.

    evaluate(row, memory, eps, x, count, want, out)
        Fill, for `count` points on the present branch, the columns of `out` (columns, count):
        OF_LAW = σ, SLOPE = dσ/dε and MISS = ε(x) - ε, and if `want` is not 0 the derivatives of the
        stress at fixed strain: by parameter c in column BY + c, by held number h in BY_HELD + h.
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

# A spring is one row of numbers: its memory, the results of its law, values now, and constants.
# Memory: branch; strains at its ends; TURNS: 1 (-1) if it ends where the strain stops rising
# (falling); numbers held until a switch; then whatever the law keeps.
BRANCH, LOW, HIGH, TURNS, HELD, OWN, HELD_NUMBERS = 0, 1, 2, 3, 4, 6, 2
# Results of `evaluate`; of `switch`, for each held number.
SLOPE, MISS, BY, BY_HELD, OF_LAW, COLUMNS, RESULTS = 0, 1, 2, 12, 14, 15, 16
OF_STRESS, OF_HELD, OF_PARAMETER, CHANGE, CHANGES = 0, 1, 3, 16, 32
# Values now and before; height, dashpot, 1 + Σ g; the row of the law; g and τ of relaxation terms.
EPS, RATE, SIGMA, STRESS, DRIFT, OLD_EPS, OLD_RATE = range(64, 71)
HEIGHT, ETA, GAIN, PER_HEIGHT, ROW, RELAX = 72, 73, 74, 75, 80, 192

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}
_INSIDE: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
# Without reference counts, which take longer than the loops.
inner = njit(**_INSIDE, _nrt=False)
inlined = njit(**_INSIDE, _nrt=False, forceinline=True)

_F, _I, _P = types.float64, types.int64, types.CPointer(types.float64)
evaluating = cfunc(_F(_P, _P, _P, _P, _I, _I, _P), **OPTIONS)
switching = cfunc(_F(_P, _P, _F, _F, _I, _P), **OPTIONS)
beginning = cfunc(_F(_P, _P), **OPTIONS)


class Law(NamedTuple):
    """A law for the stepper."""

    fill: Callable[..., Any]  #: parameters -> row
    names: tuple[str, ...]  #: of the parameters, in the order of the derivatives
    implicit: bool  #: whether strain is given by stress, its internal variable
    addresses: tuple[int, int, int]  #: of evaluate, switch and begin


@intrinsic
def start(typing, array):
    """Return the pointer to the first element of an array."""

    def emit(context, builder, signature, args):
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), emit


@intrinsic
def past(typing, pointer, count):
    """Return the pointer to the element number `count`."""

    def emit(context, builder, signature, args):
        return builder.gep(args[0], [args[1]])

    return pointer(pointer, _I), emit


def _call(builder, address, values):
    kind = ir.FunctionType(ir.DoubleType(), [value.type for value in values])
    return builder.call(builder.inttoptr(address, kind.as_pointer()), values)


@intrinsic
def call_evaluate(typing, address, spring, eps, x, count, want, out):
    """Call evaluate of a spring."""

    def emit(context, builder, signature, args):
        row = builder.gep(args[1], [ir.Constant(ir.IntType(64), ROW)])
        return _call(builder, args[0], [row, *args[1:]])

    return _F(_I, _P, _P, _P, _I, _I, _P), emit


@intrinsic
def call_switch(typing, address, spring, eps, x, up, results):
    """Call switch of a spring; its results go to the column `results`."""

    def emit(context, builder, signature, args):
        row = builder.gep(args[1], [ir.Constant(ir.IntType(64), ROW)])
        out = builder.gep(args[1], [args[5]])
        return _call(builder, args[0], [row, args[1], args[2], args[3], args[4], out])

    return _F(_I, _P, _F, _F, _I, _I), emit


@intrinsic
def call_begin(typing, address, spring):
    """Call begin of a spring."""

    def emit(context, builder, signature, args):
        row = builder.gep(args[1], [ir.Constant(ir.IntType(64), ROW)])
        return _call(builder, args[0], [row, args[1]])

    return _F(_I, _P), emit
