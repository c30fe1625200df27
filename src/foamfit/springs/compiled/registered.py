"""A registered law, compiled to the contract of the solvers.

The functions of such a law are plain formulas, compiled for complex numbers. Every derivative is
the imaginary part of a formula with an imaginary step in one of its arguments, exact to rounding
(Squire & Trapp 1998). Only one function is compiled for each law; those of the contract are
compiled once for all, and call it by the address that its spring keeps in memory.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from foamfit.arrays import Array
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import (
    BY,
    COMPLEXES_AT,
    EXPLICIT,
    INTERNAL,
    SLOPE,
    WHOLE,
    inner,
    past,
)
from foamfit.springs.laws.record import Functions, Law

STEP = 1e-40  # imaginary step
# What the function of a law fills: σ, V, A and B; the ends of the branch; or the internal variables
# on the next branch, whose number it returns.
VALUES, ENDS, DOWN, UP = range(4)
# What a spring of a registered law keeps in memory: the address of its function, kind, numbers of
# parameters and of internal variables, and whether its branches end.
FORMULAS, KIND, COUNT, INSIDE, BOUNDED = range(contract.OWN, contract.OWN + 5)
FORMULA = WHOLE(COMPLEXES_AT, WHOLE, WHOLE, COMPLEXES_AT)
FURTHEST, TRIALS = 1e12, 200  # largest strain, and trials, in the search for a strain


def _call(context, builder, signature, args):
    """Call the function of a law, at the address `args[0]`, by numba's own convention."""
    long, told = ir.IntType(64), ir.IntType(8).as_pointer()
    result = cgutils.alloca_once_value(builder, ir.Constant(long, 0))
    given = [result, cgutils.alloca_once(builder, told), *args[1:]]
    kind = ir.FunctionType(ir.IntType(32), [value.type for value in given])
    # An exception, as of a division by zero, is not raised: results keep what they were.
    builder.call(builder.inttoptr(args[0], kind.as_pointer()), given)
    return builder.load(result)


call_formulas = contract.emitted(WHOLE(WHOLE, *FORMULA.args), _call)


@inner
def ask(s, point, what, out):
    """Call the function of the law of a spring, on its branch."""
    return call_formulas(int(s[FORMULAS]), point, int(s.branch), what, out)


@inner
def gather(row, s, eps, x):
    """Return the arguments of the formulas (strain, rate, x, p), and room for results."""
    inside, count = int(s[INSIDE]), int(s[COUNT])
    point = contract.complexes_at(contract.address(past(row, count + 1)))
    point[0], point[1] = complex(eps, 0.0), complex(s.rate, 0.0)
    for k in range(inside):
        point[2 + k] = complex(x[k], 0.0)
    for k in range(count):
        point[2 + inside + k] = complex(row[k], 0.0)
    return point, past(point, 2 + inside + count)


@inner
def stress_of(row, s, point, found):
    """Return stress and slope at the arguments `point`, whose strain has the imaginary step."""
    ask(s, point, VALUES, found)
    return found[0].real, found[0].imag / STEP


@inner
def bound(row, s, point, found):
    """Set the ends of the branch."""
    found[0], found[1], found[2] = complex(-math.inf, 0.0), complex(math.inf, 0.0), 0j
    ask(s, point, ENDS, found)
    s.low, s.high, s.turns = found[0].real, found[1].real, found[2].real


@inner
def enter(row, s):
    """Set the ends of a branch at its beginning; the stresses there of an EXPLICIT law."""
    point, found = gather(row, s, s.eps, s.xs)
    bound(row, s, point, found)
    low, high, explicit = -math.inf, math.inf, s[KIND] == EXPLICIT
    if explicit and s.low > -math.inf:
        point[0] = complex(s.low, STEP)
        low, _ = stress_of(row, s, point, found)
    if explicit and s.high < math.inf:
        point[0] = complex(s.high, STEP)
        high, _ = stress_of(row, s, point, found)
    if abs(high - low) < 1e-14 * max(abs(low), abs(high)):  # a flat branch without rounding
        high = low
    s.sigma_low, s.sigma_high = low, high


@contract.beginning
def _begin(row, s):
    s.eps = s.branch = s.rate = 0.0
    for k in range(int(s[INSIDE])):
        s.xs[k] = 0.0
    enter(row, s)
    return 0.0


@inner
def evaluate_explicit(row, s, eps, n, want, out):
    """Fill the results of an EXPLICIT law."""
    count = int(s[COUNT])
    point, found = gather(row, s, 0.0, s)
    for j in range(n):
        point[0] = complex(eps[j], STEP)
        out[contract.OF_LAW * n + j], out[SLOPE * n + j] = stress_of(row, s, point, found)
        if want == 0:
            continue
        point[0] = complex(eps[j], 0.0)
        for c in range(count):
            point[2 + c] = complex(row[c], STEP)
            ask(s, point, VALUES, found)
            point[2 + c] = complex(row[c], 0.0)
            out[(BY + c) * n + j] = found[0].imag / STEP


@inner
def derive_along(s, point, found, dx, own, out):
    """Fill derivatives of σ, V, A and B by dx and, unless negative, parameter `own`."""
    inside, total = int(s[INSIDE]), 1.0 if own >= 0 else 0.0
    for k in range(inside):
        total += abs(dx[k])
    if not 0.0 < total < math.inf:
        for f in range(2 + 2 * inside):
            out[f] = 0.0 * total
        return
    step = STEP / total
    for k in range(inside):
        point[2 + k] = complex(point[2 + k].real, step * dx[k])
    if own >= 0:
        point[2 + inside + own] = complex(point[2 + inside + own].real, step)
    ask(s, point, VALUES, found)
    for f in range(2 + 2 * inside):
        out[f] = found[f].imag / step


@inner
def evaluate_internal(row, s, eps, x, own, want, out):
    """Fill the results of an INTERNAL law."""
    inside, values = int(s[INSIDE]), past(out, BY)
    size = 2 + 2 * inside
    if want == contract.DIRECTION:
        point, found = gather(row, s, s.eps, s.xs)
        derive_along(s, point, found, x, own, out)
        return
    point, found = gather(row, s, eps, x)
    point[0] = complex(eps, STEP)
    ask(s, point, VALUES, found)
    for f in range(size):
        values[f], values[size + f] = found[f].real, found[f].imag / STEP
    out[contract.OF_LAW], out[SLOPE] = values[0], values[size]
    point[0] = complex(eps, 0.0)
    if want and s.lossy > 0.0:
        point[1] = complex(s.rate, STEP)
        ask(s, point, VALUES, found)
        values[contract.BY_RATE * size] = found[1].imag / STEP
        point[1] = complex(s.rate, 0.0)
    for k in range(2 if want == contract.PATHS else 0):  # along A and along B
        along, to = past(values, 2 + k * inside), past(values, (contract.ALONG_A + k) * size)
        derive_along(s, point, found, along, -1, to)
    if s[BOUNDED] > 0.0:  # the ends may depend on the internal variables
        point, found = gather(row, s, eps, x)
        bound(row, s, point, found)


@contract.evaluating
def _evaluate(row, s, eps, x, n, want, out):
    if s[KIND] == EXPLICIT:
        evaluate_explicit(row, s, eps, n, want, out)
    else:
        evaluate_internal(row, s, eps[0], x, n, want, out)
    return 0.0


@inner
def derive_switch(row, s, turns, up, out):
    """Fill the derivatives of internal variables on the next branch, and of the end, by ε, x, p."""
    count, inside = int(s[COUNT]), int(s[INSIDE])
    wide = 1 + inside + count
    for q in range(wide):
        point, found = gather(row, s, s.eps, s.xs)
        at = q if q == 0 else q + 1
        kept = point[at].real
        point[at] = complex(kept, STEP)
        found[0] = found[1] = found[2] = 0j
        ask(s, point, ENDS, found)
        end = found[1 if up else 0].imag / STEP
        out[inside * wide + q] = end if not turns else 1.0 if q == 0 else 0.0
        ask(s, point, UP if up else DOWN, found)
        for k in range(inside):
            out[k * wide + q] = point[2 + k].imag / STEP


@contract.switching
def _switch(row, s, up, out):
    turns = s.turns * (1.0 if up else -1.0) < 0.0
    if not turns:
        s.eps = s.high if up else s.low
    if s[KIND] == INTERNAL:
        derive_switch(row, s, turns, up, out)
    point, found = gather(row, s, s.eps, s.xs)
    s.branch = ask(s, point, UP if up else DOWN, found)
    for k in range(int(s[INSIDE])):
        s.xs[k] = point[2 + k].real
    enter(row, s)
    return 0.0


@contract.inverting
def _strain(row, s, sigma):
    """Search by Newton's method inside a bracket."""
    point, found = gather(row, s, 0.0, s.xs)
    if s.sigma_low == s.sigma_high:
        s.soft = math.inf
        return s.low
    eps, low, high = min(max(s.eps, s.low), s.high), -math.inf, math.inf
    for trial in range(TRIALS):
        point[0] = complex(eps, STEP)
        value, slope = stress_of(row, s, point, found)
        miss = value - sigma
        if abs(eps) > FURTHEST:
            s.soft = 0.0
            return math.inf if eps > 0.0 else -math.inf
        if not abs(miss) < math.inf:  # beyond the strains that the law admits
            miss = math.inf if eps > 0.0 else -math.inf
        s.soft = 1.0 / slope if slope > 0.0 else math.inf
        if miss > 0.0:
            high = eps
        elif miss < 0.0:
            low = eps
        else:
            break
        new = eps - miss * s.soft
        if abs(new - eps) <= 2e-16 * abs(eps):
            break
        if not low < new < high or trial % 8 == 7:
            if low > -math.inf and high < math.inf:
                new = 0.5 * (low + high)
            elif not low < new < high:
                new = eps + (1.0 if miss < 0.0 else -1.0) * max(abs(eps), 1e-3)
            if new in (low, high):  # neighbouring floating-point numbers
                break
        eps = new
    return eps


@contract.outer
def slope_at_rest(where, row, s):
    """Return dσ/dε at rest along the path of the internal variables."""
    block, own = contract.as_spring(contract.start(s)), contract.start(row)
    contract.call_begin(where[0], own, block)
    inside, out = int(block[INSIDE]), block.results
    law, want = where[contract.EVALUATE], contract.PATHS
    contract.call_evaluate(law, own, block, block.point, block.xs, 1, want, out)
    slope = out[SLOPE]
    if block[KIND] == INTERNAL:
        slope += out[BY + contract.ALONG_A * (2 + 2 * inside)]
    return slope


# ---------------------------------------------------------------- compilation

_ALONE: dict[str, Any] = {
    **contract.OPTIONS, "no_rewrites": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip
_WITHIN: dict[str, Any] = {**_ALONE, "_nrt": False}
kept: list[Any] = []  # compiled functions, whose addresses stay valid


@njit(**_WITHIN)
def _nothing(p, x, strain, branch, out):
    """Leave rates at zero, and the branch without ends."""


@njit(**_WITHIN)
def _same(p, x, strain, branch, up):
    """Stay on the branch."""
    return branch


@njit(**_WITHIN)
def _no_stress(p, x, strain, rate, branch):
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
    def load(typing, pointer):
        def emit(context, builder, signature, args):
            at = [builder.gep(args[0], [ir.Constant(ir.IntType(64), k)]) for k in range(count)]
            return context.make_tuple(builder, kind, [builder.load(one) for one in at])

        return kind(COMPLEXES_AT), emit

    return load


def _formulas(given: Functions, count: int, inside: int) -> Any:
    """Compile the functions of a law into one."""
    stress, viscous = _inside(given.stress), _inside(given.viscous, _no_stress)
    along, decay = _inside(given.along, _nothing), _inside(given.decay, _nothing)
    ends, change = _inside(given.ends, _nothing), _inside(given.switch, _same)
    load = _tuple_at(count)

    @njit(FORMULA, **_ALONE)
    def formulas(point, branch, what, out):
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


def compile_law(law: Law) -> contract.Compiled:
    """Compile a registered law."""
    given: Any = law.functions
    count, inside, viscous = len(law.params), law.internal, given.viscous is not None
    kind, bounded = INTERNAL if inside or viscous else EXPLICIT, float(given.ends is not None)
    formulas = _formulas(given, count, inside)
    made = formulas.overloads[FORMULA.args]
    where = float(made.library.get_pointer_to_function(made.fndesc.llvm_func_name))  # below 2^53
    begin_any, lossy = _begin.address, float(viscous)

    @cfunc(contract.REAL(contract.REALS_AT, contract.SPRING), **contract.OPTIONS)
    def begin(row, s):
        s[FORMULAS], s[KIND], s[COUNT], s[INSIDE] = where, kind, count, inside
        s[BOUNDED], s.lossy = bounded, lossy
        contract.call_begin(begin_any, row, s)
        return 0.0

    functions = (begin, _evaluate, _switch, contract.settle, _strain)
    addresses = np.array([one.address for one in functions])
    kept.append((formulas, begin))  # the addresses stay valid
    # parameters, slope at rest, then room for complex numbers
    columns = count + 1 + 2 * (2 + inside + count + max(3, 2 + 2 * inside))
    work = np.zeros(contract.RESULTS + contract.results_of(count, inside))

    def fill(values: Array, row: Array) -> bool:
        row[:count] = values
        fine = np.isfinite(values).all()
        if not (fine and (given.admissible is None or given.admissible(values))):
            return False
        slope = float(slope_at_rest(addresses, row, work))
        row[count] = slope if 0.0 < slope < math.inf else 1.0
        return True

    flows = contract.FADES if given.decay else contract.STILL
    if given.along or given.viscous or (given.decay and (given.ends or given.switch)):
        flows = contract.FLOWS
    return contract.Compiled(
        fill, kind, columns, count, inside, functions, (count,), -1, viscous, flows
    )
