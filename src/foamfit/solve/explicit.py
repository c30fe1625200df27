"""Explicit steps of a chain: the pair of Dormand and Prince of order 8(5,3) with dense output.

Switches of branch and the end of contact are roots on the dense output, of order 7. Its stages are
computed only in steps that contain a sample or, by a look at both ends, may contain a switch. The
error norm leaves the derivatives by parameters out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import cfunc, types
from numba.extending import intrinsic
from scipy.integrate._ivp import dop853_coefficients as pair

from foamfit.solve.links import rates, unpack
from foamfit.springs.compiled.contract import (
    EPS,
    HIGH,
    LOW,
    OLD_EPS,
    OLD_RATE,
    OPTIONS,
    RATE,
    STRESS as TOTAL,
    TURNS,
    address,
    floats_at,
    inlined,
    inner,
    integers_at,
    past,
)

STAGES, ALL_STAGES = 12, 16
_A = np.zeros((ALL_STAGES, ALL_STAGES))
_A[:, : pair.A.shape[1]] = pair.A
_A[STAGES, :STAGES] = pair.B
# Coefficients without zeros: stage s is the sum of WEIGHT[k] K[FROM[k]], FIRST[s] <= k < FIRST[s+1];
# after the stages come the four higher terms of the dense output, and the errors of order 5 and 3.
_FULL = np.zeros((22, ALL_STAGES))
_FULL[:16], _FULL[16:20], _FULL[20, :13], _FULL[21, :13] = _A, pair.D, pair.E5, pair.E3
_ROWS = [np.flatnonzero(row) for row in _FULL]
NONE = np.array([-row.size % 4 for row in _ROWS])  # zeros at the end of a row
_ROWS = [
    np.append(row, [row[-1] if row.size else 0] * (-row.size % 4)).astype(int) for row in _ROWS
]
FIRST = np.cumsum([0] + [len(row) for row in _ROWS])
FROM = np.concatenate(_ROWS)
WEIGHT = np.concatenate(
    [np.where(np.arange(row.size) < row.size - more, full[row], 0.0)
     for full, row, more in zip(_FULL, _ROWS, NONE, strict=True)]
)  # fmt: skip
TIMES = pair.C[:ALL_STAGES]

# Numbers that change during a run: time since the piece began, time at which it begins, step,
# length of the piece, steps, growth
# of the next step, largest stress, whether the base stress has risen, last error, next sample,
# number of the piece, switches; of implicit steps: length of the one before, least length that the
# error can enforce, length of a short step, short steps in a row, size of all vibrations that were
# damped out, and of those in the last steps.
NOW, BEGUN, STEP, HORIZON, TAKEN, GROW, LARGEST, PRESSED, LAST, SAMPLE, PIECE, LOGGED = range(12)
BEFORE, FLOOR, BRIEF, IN_ROW, DAMPED, DAMPING, RUN = range(12, 19)
PLAIN, SAMPLED, DOUBTFUL, FAILED = range(4)  # ends of an attempted step
LAST_TERM = 1e-3  # share of the last term of the dense output that counts as its error
RISEN = 1e-9  # base stress over the largest stress above which its return to zero ends the contact
# Kinds of events: a branch ends at its upper or lower strain, a spring turns, contact ends.
TOP_END, LOW_END, TURN, RELEASE = range(4)


class Work(NamedTuple):
    """Arrays of a run: pointers. `pack_work` keeps it in memory for other functions."""

    stage: Any  #: rates at the stages
    line: Any  #: the dense output
    y: Any  #: the state
    new: Any  #: at the end of the step
    state: Any  #: between
    f: Any  #: rates between
    nil: Any  #: zeros
    errors: Any
    scales: Any  #: of the kinds
    run: Any  #: numbers that change, see above
    batch: Any  #: samples that are computed together
    kinds: Any  #: of the components, integers
    words: Any  #: this, in memory
    wide: int  #: width of a row of stages
    degree: int  #: of the dense output if it is a polynomial of an implicit step, else 0


@inlined
def pack_work(m):  # type: ignore[no-untyped-def]
    """Keep the arrays of a run in its `words`."""
    w = m.words
    w[0], w[1], w[2], w[3] = address(m.stage), address(m.line), address(m.y), address(m.new)
    w[4], w[5], w[6], w[7] = address(m.state), address(m.f), address(m.nil), address(m.errors)
    w[8], w[9], w[10], w[11] = address(m.scales), address(m.run), address(m.batch), address(m.kinds)
    w[12], w[13], w[14] = address(w), m.wide, m.degree


@inlined
def unpack_work(w):  # type: ignore[no-untyped-def]
    """Return the arrays of a run from its words."""
    return Work(
        floats_at(w[0]), floats_at(w[1]), floats_at(w[2]), floats_at(w[3]), floats_at(w[4]),
        floats_at(w[5]), floats_at(w[6]), floats_at(w[7]), floats_at(w[8]), floats_at(w[9]),
        floats_at(w[10]), integers_at(w[11]), w, w[13], w[14],
    )  # fmt: skip


WORK_WORDS = len(Work._fields)


@inner
def combine(m, n, row, scale, begin, out):  # type: ignore[no-untyped-def]
    """Fill out = begin + scale Σ WEIGHT[k] stage[FROM[k]] of a row of coefficients."""
    first, last, stage, wide = FIRST[row], FIRST[row + 1], m.stage, m.wide
    if n <= 8:
        for i in range(0, n, 4):
            a = b = c = d = 0.0
            for k in range(first, last - NONE[row]):
                weight, at = WEIGHT[k], FROM[k] * wide + i
                a += weight * stage[at]
                b += weight * stage[at + 1]
                c += weight * stage[at + 2]
                d += weight * stage[at + 3]
            out[i] = begin[i] + scale * a
            out[i + 1] = begin[i + 1] + scale * b
            out[i + 2] = begin[i + 2] + scale * c
            out[i + 3] = begin[i + 3] + scale * d
        return
    source = begin
    for k in range(first, last, 4):  # loops that are vectorised; rows are filled up with zeros
        one, two = scale * WEIGHT[k], scale * WEIGHT[k + 1]
        three, four = scale * WEIGHT[k + 2], scale * WEIGHT[k + 3]
        a, b = past(stage, FROM[k] * wide), past(stage, FROM[k + 1] * wide)
        c, d = past(stage, FROM[k + 2] * wide), past(stage, FROM[k + 3] * wide)
        for i in range(n):
            out[i] = source[i] + (one * a[i] + two * b[i] + (three * c[i] + four * d[i]))
        source = out


@inner
def take(c, m, n, dt, at, want):  # type: ignore[no-untyped-def]
    """Fill the stages of a step from the first, and the state and rates at its end."""
    for s in range(1, STAGES + 1):
        target = m.new if s == STAGES else m.state
        combine(m, n, s, dt, m.y, target)
        rates(c, target, past(m.stage, s * m.wide), want, at + TIMES[s] * dt if s < STAGES else at + dt)


@inner
def error_of(c, m, dt, tol):  # type: ignore[no-untyped-def]
    """Return the error of a step over the tolerance."""
    for q in range(2):
        combine(m, c.base, 20 + q, dt, m.nil, past(m.errors, q * m.wide))
    five = three = 0.0
    for i in range(c.base):
        size = max(m.scales[m.kinds[i]], max(abs(m.y[i]), abs(m.new[i])))
        if size > 0.0:
            scale = 1.0 / (tol * size)
            five += (m.errors[i] * scale) ** 2
            three += (m.errors[m.wide + i] * scale) ** 2
    if five == 0.0:
        return 0.0
    return five / math.sqrt(c.base * (five + 0.01 * three))


@inner
def make_dense(c, m, n, dt, at, tol, want):  # type: ignore[no-untyped-def]
    """Fill the dense output of a step; return the size of its last term over the tolerance.

    Where fast processes have died out, that exceeds the error at the end of the step by far.
    """
    for s in range(STAGES + 1, ALL_STAGES):
        combine(m, n, s, dt, m.y, m.state)
        rates(c, m.state, past(m.stage, s * m.wide), want, at + TIMES[s] * dt)
    wide, line = m.wide, m.line
    for i in range(n):
        rise, last = m.new[i] - m.y[i], m.stage[STAGES * wide + i]
        line[i], line[wide + i] = rise, dt * m.stage[i] - rise
        line[2 * wide + i] = 2.0 * rise - dt * (last + m.stage[i])
    for q in range(4):
        combine(m, n, ALL_STAGES + q, dt, m.nil, past(line, (3 + q) * wide))
    size = 0.0
    for i in range(c.base):
        most = max(m.scales[m.kinds[i]], abs(m.new[i]))
        if most > 0.0:
            size = max(size, abs(line[6 * wide + i]) / most)
    return LAST_TERM / tol * size


@inner
def dense(m, n, x, out):  # type: ignore[no-untyped-def]
    """Fill the state at the share x of the step."""
    z, line, wide = 1.0 - x, m.line, m.wide
    if m.degree:
        for i in range(n):
            value = 0.0
            for q in range(m.degree - 1, -1, -1):
                value = (value + line[q * wide + i]) * x
            out[i] = m.y[i] + value
        return
    for i in range(n):
        value = line[4 * wide + i] + z * (line[5 * wide + i] + x * line[6 * wide + i])
        value = line[2 * wide + i] + z * (line[3 * wide + i] + x * value)
        out[i] = m.y[i] + x * (line[i] + z * (line[wide + i] + x * value))


# ---------------------------------------------------------------- events


@inner
def excess(c, i, kind):  # type: ignore[no-untyped-def]
    """Return how far a spring is past the end of its branch, or the contact past its own."""
    s = past(c.springs, i * c.width)
    if kind == RELEASE:
        return -c.carried[0]
    if kind == TURN:
        return -s[TURNS] * s[RATE]
    return s[EPS] - s[HIGH] if kind == TOP_END else s[LOW] - s[EPS]


@inner
def look(c, m, dt, at, x, i, kind):  # type: ignore[no-untyped-def]
    """Return the excess of a spring at the share x of the step."""
    dense(m, c.base, x, m.state)
    rates(c, m.state, m.f, c.none, at + x * dt)
    return excess(c, i, kind)


@inner
def locate(c, m, dt, at, low, high, i, kind):  # type: ignore[no-untyped-def]
    """Return where an excess becomes positive between two shares, by Illinois' method."""
    f_low = look(c, m, dt, at, low, i, kind)
    f_high, side = look(c, m, dt, at, high, i, kind), 0
    if f_low >= 0.0:
        return low
    s, value, slope, middle = past(c.springs, i * c.width), f_high, 0.0, high
    for _ in range(60):
        if kind < TURN:  # Newton's method
            slope = (s[RATE] if kind == TOP_END else -s[RATE]) * dt
            middle -= value / slope
        if kind >= TURN or not low < middle < high:
            middle = high - f_high * (high - low) / (f_high - f_low)
        if high - low <= 4e-16 or not low < middle < high:
            break
        value = look(c, m, dt, at, middle, i, kind)
        if kind < TURN and abs(value) < 1e-15:
            return middle
        if value > 0.0:
            f_low *= 0.5 if side == 1 else 1.0
            high, f_high, side = middle, value, 1
        else:
            f_high *= 0.5 if side == -1 else 1.0
            low, f_low, side = middle, value, -1
    return high


@inner
def first_event(c, m, dt, at, risen):  # type: ignore[no-untyped-def]
    """Return share, spring and kind of the first switch in a step; spring -1 if there is none."""
    found, who, what, before, pieces = 1.0, -1, -1, 0.0, 1
    look(c, m, dt, at, 1.0, c.none, c.none)
    for i in range(c.count):
        s = past(c.springs, i * c.width)
        if s[OLD_RATE] * s[RATE] <= 0.0:  # otherwise one look at the end tells
            pieces = 4
    for piece in range(1, pieces + 1):
        x, missed = piece / pieces, True
        for i in range(c.count):
            for kind in range(4):
                if kind == RELEASE and (i > 0 or not risen):
                    continue
                if missed:  # or else still known
                    look(c, m, dt, at, x, i, kind)
                    missed = False
                over = excess(c, i, kind)
                if over > 0.0 or (kind == RELEASE and over == 0.0):
                    there = locate(c, m, dt, at, before, x, i, kind)
                    missed = True
                    if who < 0 or there < found or (kind == RELEASE and there <= found + 1e-9):
                        found, who, what = there, i, kind
        if who >= 0:
            break
        before = x
    return found, who, what


@inner
def suspicious(c, dt, risen):  # type: ignore[no-untyped-def]
    """Whether a step may contain a switch, by the values at both ends."""
    if risen and c.carried[0] <= 0.0:
        return True
    for i in range(c.count):
        s = past(c.springs, i * c.width)
        eps, old, low, high = s[EPS], s[OLD_EPS], s[LOW], s[HIGH]
        if eps > high or eps < low or s[TURNS] * s[RATE] < 0.0:
            return True
        if s[OLD_RATE] * s[RATE] < 0.0:  # an extremum is no further away than this
            most = 0.5 * dt * max(abs(s[OLD_RATE]), abs(s[RATE]))
            if max(eps, old) + most > high or min(eps, old) - most < low:
                return True
    return False


@inner
def keep_values(c):  # type: ignore[no-untyped-def]
    """Keep strains and rates of the beginning of a step; return the largest stress."""
    largest = 0.0
    for i in range(c.count):
        s = past(c.springs, i * c.width)
        s[OLD_EPS], s[OLD_RATE] = s[EPS], s[RATE]
        largest = max(largest, abs(s[TOTAL]))
    return largest


# ---------------------------------------------------------------- one step


_F, _I, _IP = types.float64, types.int64, types.CPointer(types.int64)
#: words of chain and work, whether with derivatives, tolerance, time of the next sample, bound on
#: steps, and words of the systems of implicit steps
STEPPING = _I(_IP, _IP, _I, _F, _F, _F, _IP)


@cfunc(STEPPING, **OPTIONS, cache=True)
def _step(words, of_work, want, tol, upto, most, of_systems):  # type: ignore[no-untyped-def]
    """Take one step, shorter ones until it is accurate; return how it ended.

    `upto` is the time of the next sample inside the piece. A step that may contain a switch or
    contains a sample has its dense output.
    """
    c, m = unpack(words), unpack_work(of_work)
    r, again, n = m.run, False, c.base + c.carries * c.p
    while True:
        dt, at = r[STEP], r[NOW]
        if r[NOW] + dt == r[NOW] or not dt > 0.0:
            return FAILED
        take(c, m, n, dt, at, want)
        r[TAKEN] += 1.0
        error = error_of(c, m, dt, tol)
        if not error <= 1.0:
            again = True
            r[STEP] = dt * (max(0.2, 0.9 * error**-0.125) if error < math.inf else 0.2)
            if r[TAKEN] > most:
                return FAILED
            continue
        grow = 6.0
        if error > 1e-8:
            grow = min(6.0, max(0.3, 0.9 * error**-0.115 * r[LAST] ** 0.02))
        r[GROW] = min(grow, 1.0) if again else grow
        doubtful = suspicious(c, dt, r[PRESSED] > 0.0)
        if not doubtful and upto > r[NOW] + dt:
            r[LAST] = max(error, 1e-4)
            return PLAIN
        size = make_dense(c, m, n, dt, at, tol, want)
        if size > 1.0 and dt > 1e-12 * abs(r[HORIZON]):
            again = True
            r[STEP] = dt * max(0.3, 0.9 * size**-0.143)
            continue
        r[LAST] = max(error, 1e-4)
        if size > 0.0:
            r[GROW] = min(r[GROW], 0.9 * size**-0.143)
        return DOUBTFUL if doubtful else SAMPLED


EXPLICIT_STEP = _step.address


@intrinsic
def take_step(typing, where, words, of_work, want, tol, upto, most, of_systems):  # type: ignore[no-untyped-def]
    """Take one step by the function at an address; return how it ended."""

    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(ir.IntType(64), [value.type for value in args[1:]])
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])

    return _I(_I, _IP, _IP, _I, _F, _F, _F, _IP), emit
