"""The contract of a law: compiled functions that the solvers call by their addresses.

The solvers are compiled once for all laws, and a law is compiled alone. A spring is a block of
numbers: its memory, which only its law changes; its present values; the results of its law; and its
row, the constants that `fill` computes from its parameters.

    fill(values, row) -> bool
        Write the row of the law's parameters; return false if they are not admissible.
    begin(row, s)
        Set the memory of a spring at rest.
    evaluate(row, s, eps, x, count, want, out)
        Fill, for `count` points on the present branch, the columns of `out` (columns, count):
        σ in OF_LAW, dσ/dε in SLOPE. With `want` also the derivatives of σ at fixed strain, by the
        two held numbers in BY_HELD and by parameter c in BY + c. x are internal variables.
    switch(row, s, up, out)
        Leave the branch at its upper (up = 1) or lower (0) end, or at a turning point, and enter
        the next. At an end, EPS and X become those of the end. A BY_STRESS law fills in `out`, for
        each held number, its derivatives by the stress, by both held numbers before, and by the
        parameters; an INTERNAL one, for each internal variable, its derivatives by ε, by all
        internal variables before, and by the parameters, and then those of the strain at the end (1
        and zeros at a turning point).
    settle(row, s, eps)
        Bring a spring to a strain on its branch: fill EPS, X and SLOPE.
    strain(row, s, sigma) -> ε
        Return the strain at a stress on the branch, and its derivative in SOFT.

There are three kinds of law. Of an EXPLICIT one the stress is a function of the strain. A BY_STRESS
one gives the strain as a function of the stress, which is then its internal variable x; `evaluate`
takes x for the stress and fills ε(x) - ε in MISS. An INTERNAL one has internal variables x with

    dx/dt = A dε/dt + B,        σ = σ(ε, x) + V(ε, x, dε/dt);

`evaluate` fills V, A and B in the columns from BY + parameters on, and then, with `want`, the
derivatives of σ, V, A and B by ε, dε/dt, x and the parameters (see `Layout`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from llvmlite import ir
from numba import cfunc, njit, types
from numba.extending import intrinsic

# Memory: branch; strains and stresses at its ends; 1 (-1) if it ends where the strain stops rising
# (falling). From HELD on two held numbers, then what the law keeps.
BRANCH, LOW, HIGH, SIGMA_LOW, SIGMA_HIGH, TURNS, HELD, OWN, MEMORY = 0, 1, 2, 3, 4, 5, 6, 8, 48
# Values: strain and its rate, stress T with relaxation but without dashpot, the part of dT/dt
# without dε/dt, strain and rate at the start of a step, height, dashpot, 1 + Σ g, 1/height, dε/dσ,
# dσ/dε along the path of the internal variables, Σ g z, dσ/dε of the derivatives, dashpot and ∂V by
# the strain rate, and 1 if V depends on that rate, which `begin` sets.
EPS, RATE, TOTAL, DRIFT, OLD_EPS, OLD_RATE, HEIGHT, ETA, GAIN, PER_HEIGHT, SOFT, TANGENT = range(
    MEMORY, MEMORY + 12
)
OFFSET, STEEP, LOSS, LOSSY = range(MEMORY + 12, MEMORY + 16)
# Dashpot of a law with V that has none: it counts as damped.
TINY = 1e-300
X, MOST_INTERNAL = 64, 32  # internal variables
RELAX, MOST_TERMS = 96, 10  # g and τ of relaxation terms
MIDWAY = RELAX + 2 * MOST_TERMS  # strain rate about the middle of a step
RESULTS = 128  # of `evaluate`
OF_LAW, SLOPE, MISS, BY_HELD, BY = 0, 1, 2, 3, 5
OF_STRESS, OF_HELD, OF_PARAMETER = 0, 1, 3  # columns of CHANGES
EXPLICIT, BY_STRESS, INTERNAL = range(3)

# The layout of the derivatives is in `results_of` and in the solvers.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}
_INSIDE: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
# Without reference counts, which take longer than the loops.
inner = njit(**_INSIDE, _nrt=False)
inlined = njit(**_INSIDE, _nrt=False, forceinline=True)
# Called from Python.
outer = njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False, cache=True)

REAL, WHOLE = types.float64, types.int64
REALS_AT, WHOLES_AT = types.CPointer(REAL), types.CPointer(WHOLE)
evaluating = cfunc(
    REAL(REALS_AT, REALS_AT, REALS_AT, REALS_AT, WHOLE, WHOLE, REALS_AT), **OPTIONS, cache=True
)
switching = cfunc(REAL(REALS_AT, REALS_AT, WHOLE, REALS_AT), **OPTIONS, cache=True)
beginning = cfunc(REAL(REALS_AT, REALS_AT), **OPTIONS, cache=True)
settling = cfunc(REAL(REALS_AT, REALS_AT, REAL), **OPTIONS, cache=True)
inverting = cfunc(REAL(REALS_AT, REALS_AT, REAL), **OPTIONS, cache=True)


class Compiled(NamedTuple):
    """The compiled functions of a law."""

    fill: Any
    kind: int  #: EXPLICIT, BY_STRESS or INTERNAL
    columns: int  #: of a row
    derivatives: int  #: number of parameters, by which `evaluate` gives derivatives
    internal: int  #: number of internal variables
    addresses: tuple[int, int, int, int, int]  #: begin, evaluate, switch, settle, strain
    #: columns of the row with slopes dσ/dε (Pa) of branches at zero stress, that at rest first
    slopes: tuple[int, ...] = ()
    pole: int = -1  #: column of the row with ε_*, if the strain stays below 1 + ε_*
    damps: bool = False  #: whether V depends on the strain rate


BEGIN, EVALUATE, SWITCH, SETTLE, STRAIN = range(5)


def results_of(parameters: int, internal: int) -> int:
    """Return the number of columns of `evaluate`."""
    values = 2 + 2 * internal
    return BY + parameters + values + (2 + internal + parameters) * values


@intrinsic
def start(typing, array):  # type: ignore[no-untyped-def]
    """Return the pointer to the first element of an array."""

    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), emit


@intrinsic
def past(typing, pointer, count):  # type: ignore[no-untyped-def]
    """Return the pointer to the element number `count`."""

    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.gep(args[0], [args[1]])

    return pointer(pointer, WHOLE), emit


@intrinsic
def address(typing, pointer):  # type: ignore[no-untyped-def]
    """Return a pointer as an integer."""

    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.ptrtoint(args[0], ir.IntType(64))

    return WHOLE(pointer), emit


def _pointer(kind: Any, width: Any) -> Any:
    @intrinsic
    def at(typing, number):  # type: ignore[no-untyped-def]
        def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.inttoptr(args[0], width.as_pointer())

        return types.CPointer(kind)(WHOLE), emit

    return at


_COMPLEX = ir.LiteralStructType([ir.DoubleType(), ir.DoubleType()])
floats_at, integers_at = _pointer(REAL, ir.DoubleType()), _pointer(WHOLE, ir.IntType(64))
complexes_at = _pointer(types.complex128, _COMPLEX)


def by_address(context, builder, signature, args):  # type: ignore[no-untyped-def]
    """Call the function at an address, the first argument, with the others."""
    returned = signature.return_type
    result = ir.VoidType() if returned == types.void else context.get_value_type(returned)
    kind = ir.FunctionType(result, [value.type for value in args[1:]])
    found = builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
    return context.get_dummy_value() if returned == types.void else found


@intrinsic
def call_begin(typing, where, row, s):  # type: ignore[no-untyped-def]
    """Call `begin` of a law."""
    return REAL(WHOLE, REALS_AT, REALS_AT), by_address


@intrinsic
def call_evaluate(typing, where, row, s, eps, x, count, want, out):  # type: ignore[no-untyped-def]
    """Call `evaluate` of a law."""
    return REAL(WHOLE, REALS_AT, REALS_AT, REALS_AT, REALS_AT, WHOLE, WHOLE, REALS_AT), by_address


@intrinsic
def call_switch(typing, where, row, s, up, out):  # type: ignore[no-untyped-def]
    """Call `switch` of a law."""
    return REAL(WHOLE, REALS_AT, REALS_AT, WHOLE, REALS_AT), by_address


@intrinsic
def call_number(typing, where, row, s, number):  # type: ignore[no-untyped-def]
    """Call `settle` or `strain` of a law."""
    return REAL(WHOLE, REALS_AT, REALS_AT, REAL), by_address
