"""The functions of the contract for all registered laws.

The functions of such a law are plain formulas, compiled for complex numbers. Every derivative is
the imaginary part of a formula with an imaginary step in one of its arguments, exact to rounding
(Squire & Trapp 1998). Only one function is compiled for each law (`compiled.registered`); those
below are compiled once, and call it by the address that its spring keeps in memory.
"""

from __future__ import annotations

import math

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from foamfit.springs.compiled.bistable import settle
from foamfit.springs.compiled.contract import (
    ALONG_A,
    ALONG_B,
    AT_RATE,
    AT_STRAIN,
    BY,
    BY_HELD,
    BY_RATE,
    DERIVED,
    DIRECTION,
    EPS,
    EVALUATE,
    EXPLICIT,
    INTERNAL,
    MISS,
    OF_LAW,
    ON_BRANCH,
    OWN,
    PATHS,
    POINT,
    RESULTS,
    SLOPE,
    WANTED,
    WHOLE,
    X,
    address,
    as_spring,
    beginning,
    call_begin,
    call_evaluate,
    complexes_at,
    evaluating,
    inner,
    inverting,
    last_point,
    outer,
    past,
    start,
    switching,
)

STEP = 1e-40  # imaginary step
# What the function of a law fills: σ, V, A and B; the ends of the branch; or the internal variables
# on the next branch, whose number it returns.
VALUES, ENDS, DOWN, UP = range(4)
# What a spring of a registered law keeps in memory: the address of its function, kind, numbers of
# parameters and of internal variables, whether its branches end, and whether V depends on the rate.
FORMULAS, KIND, COUNT, INSIDE, BOUNDED, DAMPS = range(OWN, OWN + 6)
COMPLEXES = types.CPointer(types.complex128)
FORMULA = WHOLE(COMPLEXES, WHOLE, WHOLE, COMPLEXES)
FURTHEST, TRIALS = 1e12, 200  # largest strain, and trials, in the search for a strain


@intrinsic
def call_formulas(typing, where, point, branch, what, out):  # type: ignore[no-untyped-def]
    """Call the function of a law, by numba's own convention.

    An exception, such as that of a division by zero, is not raised: the results keep what they were
    before.
    """

    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        long, told = ir.IntType(64), ir.IntType(8).as_pointer()
        result = cgutils.alloca_once_value(builder, ir.Constant(long, 0))
        given = [result, cgutils.alloca_once(builder, told), *args[1:]]
        kind = ir.FunctionType(ir.IntType(32), [value.type for value in given])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), given)
        return builder.load(result)

    return WHOLE(WHOLE, COMPLEXES, WHOLE, WHOLE, COMPLEXES), emit


@inner
def room_of(row, s):  # type: ignore[no-untyped-def]
    """Return where a row has room for the arguments of the formulas: strain, rate, x and p."""
    return complexes_at(address(past(row, int(s[COUNT]) + 1)))


@inner
def gather(row, s, eps, x):  # type: ignore[no-untyped-def]
    """Gather the arguments of the formulas at a point; return them, and room for results."""
    point, inside, count = room_of(row, s), int(s[INSIDE]), int(s[COUNT])
    point[0], point[1] = complex(eps, 0.0), complex(s.rate, 0.0)
    for k in range(inside):
        point[2 + k] = complex(x[k], 0.0)
    for k in range(count):
        point[2 + inside + k] = complex(row[k], 0.0)
    return point, past(point, 2 + inside + count)


@inner
def stress_of(row, s, point, found):  # type: ignore[no-untyped-def]
    """Return stress and slope at the arguments `point`, whose strain has the imaginary step."""
    call_formulas(int(s[FORMULAS]), point, int(s.branch), VALUES, found)
    return found[0].real, found[0].imag / STEP


@inner
def bound(row, s, point, found):  # type: ignore[no-untyped-def]
    """Set the ends of the branch."""
    found[0], found[1], found[2] = complex(-math.inf, 0.0), complex(math.inf, 0.0), 0j
    call_formulas(int(s[FORMULAS]), point, int(s.branch), ENDS, found)
    s.low, s.high, s.turns = found[0].real, found[1].real, found[2].real


@inner
def bound_stress(row, s, point, found):  # type: ignore[no-untyped-def]
    """Set the stresses at the ends of the branch of an EXPLICIT law."""
    low, high, flat, size = -math.inf, math.inf, True, 0.0
    if s.low > -math.inf:
        point[0] = complex(s.low, STEP)
        low, slope = stress_of(row, s, point, found)
        flat, size = flat and slope == 0.0, abs(low)
    if s.high < math.inf:
        point[0] = complex(s.high, STEP)
        high, slope = stress_of(row, s, point, found)
        flat, size = flat and slope == 0.0, max(size, abs(high))
    if flat and abs(high - low) <= 1e-14 * size:  # without rounding
        high = low
    s.sigma_low, s.sigma_high = low, high


@inner
def enter(row, s):  # type: ignore[no-untyped-def]
    """Set the ends of a branch at its beginning."""
    point, found = gather(row, s, s.eps, past(s, X))
    bound(row, s, point, found)
    s.sigma_low, s.sigma_high = -math.inf, math.inf
    if s[KIND] == EXPLICIT:
        bound_stress(row, s, point, found)


@beginning
def _begin(row, s):  # type: ignore[no-untyped-def]
    s.eps = s.branch = s.rate = 0.0
    s.lossy = s[DAMPS]
    for k in range(int(s[INSIDE])):
        s[X + k] = 0.0
    enter(row, s)
    return 0.0


@inner
def evaluate_explicit(row, s, eps, n, want, out):  # type: ignore[no-untyped-def]
    """Fill the results of an EXPLICIT law."""
    where, count, branch = int(s[FORMULAS]), int(s[COUNT]), int(s.branch)
    point, found = gather(row, s, 0.0, s)
    for j in range(n):
        point[0] = complex(eps[j], STEP)
        call_formulas(where, point, branch, VALUES, found)
        out[OF_LAW * n + j], out[SLOPE * n + j] = found[0].real, found[0].imag / STEP
        out[MISS * n + j] = out[BY_HELD * n + j] = out[(BY_HELD + 1) * n + j] = 0.0
        if want == 0:
            continue
        point[0] = complex(eps[j], 0.0)
        for c in range(count):
            point[2 + c] = complex(row[c], STEP)
            call_formulas(where, point, branch, VALUES, found)
            point[2 + c] = complex(row[c], 0.0)
            out[(BY + c) * n + j] = found[0].imag / STEP


@inner
def is_last(s, eps, x, want, point):  # type: ignore[no-untyped-def]
    """Whether an INTERNAL law was evaluated here last; else note that it is."""
    same = want < point[WANTED] and eps == point[AT_STRAIN] and s.branch == point[ON_BRANCH]
    same = same and (s[DAMPS] == 0.0 or s.rate == point[AT_RATE])
    for k in range(int(s[INSIDE])):
        same = same and x[k] == point[POINT + k]
        point[POINT + k] = x[k]
    if not same:
        point[WANTED], point[DERIVED], point[AT_STRAIN] = want + 1.0, 0.0, eps
        point[AT_RATE], point[ON_BRANCH] = s.rate, s.branch
    return same


@inner
def derive_along(s, point, found, dx, own, out):  # type: ignore[no-untyped-def]
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
    call_formulas(int(s[FORMULAS]), point, int(s.branch), VALUES, found)
    for f in range(2 + 2 * inside):
        out[f] = found[f].imag / step


@inner
def evaluate_internal(row, s, eps, x, own, want, out):  # type: ignore[no-untyped-def]
    """Fill the results of an INTERNAL law."""
    inside, values = int(s[INSIDE]), past(out, BY)
    size, last = 2 + 2 * inside, last_point(values, inside)
    if want == DIRECTION:
        point, found = gather(row, s, s.eps, past(s, X))
        derive_along(s, point, found, x, own, out)
        return
    if is_last(s, eps, x, want, last):
        return
    point, found = gather(row, s, eps, x)
    point[0] = complex(eps, STEP)
    call_formulas(int(s[FORMULAS]), point, int(s.branch), VALUES, found)
    for f in range(size):
        values[f], values[size + f] = found[f].real, found[f].imag / STEP
    out[OF_LAW], out[SLOPE] = values[0], values[size]
    point[0] = complex(eps, 0.0)
    if want and s[DAMPS] > 0.0:
        point[1] = complex(s.rate, STEP)
        call_formulas(int(s[FORMULAS]), point, int(s.branch), VALUES, found)
        values[BY_RATE * size] = found[1].imag / STEP
        point[1] = complex(s.rate, 0.0)
    if want == PATHS:
        derive_along(s, point, found, past(values, 2), -1, past(values, ALONG_A * size))
        derive_along(s, point, found, past(values, 2 + inside), -1, past(values, ALONG_B * size))
    if s[BOUNDED] > 0.0:  # the ends may depend on the internal variables
        point, found = gather(row, s, eps, x)
        bound(row, s, point, found)


@evaluating
def _evaluate(row, s, eps, x, n, want, out):  # type: ignore[no-untyped-def]
    if s[KIND] == EXPLICIT:
        evaluate_explicit(row, s, eps, n, want, out)
    else:
        evaluate_internal(row, s, eps[0], x, n, want, out)
    return 0.0


@inner
def derive_switch(row, s, turns, up, out):  # type: ignore[no-untyped-def]
    """Fill the derivatives of internal variables on the next branch, and of the end, by ε, x, p."""
    where, count, branch = int(s[FORMULAS]), int(s[COUNT]), int(s.branch)
    inside = int(s[INSIDE])
    wide = 1 + inside + count
    for q in range(wide):
        point, found = gather(row, s, s.eps, past(s, X))
        at = q if q == 0 else q + 1
        kept = point[at].real
        point[at] = complex(kept, STEP)
        found[0] = found[1] = found[2] = 0j
        call_formulas(where, point, branch, ENDS, found)
        end = found[1 if up else 0].imag / STEP
        out[inside * wide + q] = end if not turns else 1.0 if q == 0 else 0.0
        call_formulas(where, point, branch, UP if up else DOWN, found)
        for k in range(inside):
            out[k * wide + q] = point[2 + k].imag / STEP


@switching
def _switch(row, s, up, out):  # type: ignore[no-untyped-def]
    turns = s.turns * (1.0 if up else -1.0) < 0.0
    if not turns:
        s.eps = s.high if up else s.low
    if s[KIND] == INTERNAL:
        derive_switch(row, s, turns, up, out)
    point, found = gather(row, s, s.eps, past(s, X))
    what = UP if up else DOWN
    s.branch = call_formulas(int(s[FORMULAS]), point, int(s.branch), what, found)
    for k in range(int(s[INSIDE])):
        s[X + k] = point[2 + k].real
    enter(row, s)
    return 0.0


@inverting
def _strain(row, s, sigma):  # type: ignore[no-untyped-def]
    """Search by Newton's method inside a bracket."""
    point, found = gather(row, s, 0.0, past(s, X))
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


@outer
def slope_at_rest(where, row, s):  # type: ignore[no-untyped-def]
    """Return dσ/dε at rest along the path of the internal variables."""
    block, own = as_spring(start(s)), start(row)
    call_begin(where[0], own, block)
    inside, out = int(block[INSIDE]), past(block, RESULTS)
    call_evaluate(where[EVALUATE], own, block, past(block, EPS), past(block, X), 1, PATHS, out)
    slope = out[SLOPE]
    if block[KIND] == INTERNAL:
        slope += out[BY + ALONG_A * (2 + 2 * inside)]
    return slope


#: addresses of `begin`, to be called by that of a law, and of the other functions of all laws
BEGIN = _begin.address
OTHERS = _evaluate.address, _switch.address, settle.address, _strain.address
