"""The equations of motion of a chain: rates of its state, and of the derivatives of the state.

The state is one array. First come displacement w and velocity v of each node that has a state, then
of each spring its strain if it has a dashpot and other springs lie between the same nodes, its
relaxation terms z_k = q_k/g_k - σ with dz_k/dt = -(z_k + σ)/τ_k, and the internal variables of an
INTERNAL law. The derivatives by parameter of all these follow. The rest of the state follows from
them on a branch, but is integrated as well, which costs less than to solve for it: strains of
springs without a dashpot, and the stress of BY_STRESS laws. Its derivatives are computed.

The derivatives δx of internal variables need those of the strain rate. Where no state contains the
strain these are unknown, and u = δx - A δε is integrated instead, the derivatives at fixed strain:
du/dt = dε/dt (A_x u + A_p) + δB - A_x B δε.

Springs without mass between them form a group, which carries one stress S:

- one spring between two nodes: its strain follows from the nodes;
- several with dashpots: S = (Δv + Σ h T/η)/(Σ h/η), dε/dt = (S - T)/η;
- some without: S is their T; they share the rest of the elongation by their compliances; a spring
  on a flat branch takes all of it.

A zero-mass node therefore needs no equation to be solved. If a stress is prescribed on a top
without mass, it is S of the last group; an onsite damper then moves the top with v = (push - S)/D.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from llvmlite import ir
from numba import cfunc, types
from numba.extending import intrinsic

from foamfit.solve.equilibrium import (
    EPS_AT,
    FIXED,
    INTERNALS,
    KIND,
    NUMBERS,
    PARAMETERS,
    X_AT,
    Z_AT,
    put,
    root,
    strain_at,
)
from foamfit.solve.scene import FREE, MOTION, STRESS, VISCOUS
from foamfit.springs.compiled.contract import (
    BEGIN,
    BY,
    BY_HELD,
    BY_STRESS,
    DRIFT,
    EPS,
    ETA,
    EVALUATE,
    EXPLICIT,
    GAIN,
    HEIGHT,
    INTERNAL,
    LOSS,
    LOSSY,
    OF_HELD,
    OF_LAW,
    OF_PARAMETER,
    OFFSET,
    OF_STRESS,
    PER_HEIGHT,
    RATE,
    RELAX,
    SETTLE,
    SIGMA_HIGH,
    SIGMA_LOW,
    SLOPE,
    STEEP,
    STRESS as TOTAL,
    SWITCH,
    TANGENT,
    OPTIONS,
    X,
    address,
    call_begin,
    call_evaluate,
    call_number,
    call_switch,
    floats_at,
    inlined,
    inner,
    integers_at,
    past,
)
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_HEIGHT, OWN_RELAXATION

# Kinds of components of the state, which share a scale: displacement, velocity, strain, stress;
# each internal variable has its own.
OF_W, OF_V, OF_EPS, OF_SIGMA, SCALES = range(5)
# The drive now: stress or displacement at the start of the piece and its rate; velocity of a
# viscous top; 1 if a stress acts on a flat branch; onsite damping of the top, Pa s/m; 0 if time
# stands still for the laws, else 1.
VALUE, VALUE_RATE, TOP_SPEED, FLAT, DRAGGED, PACE, DRIVES = range(7)


class Links(NamedTuple):
    """A chain in a run: pointers, then sizes. `pack` keeps it in memory for other functions."""

    springs: Any  #: blocks of `width` numbers, see `compiled.contract`
    per_mass: Any  #: of the nodes, area over mass
    drive: Any  #: see above
    carried: Any  #: stress of each group
    own: Any  #: derivatives of height and of eta of each spring; of drag
    held: Any  #: of the held numbers of each spring
    part: Any  #: of the stress of each spring at fixed strain, then of its T at fixed strain
    common: Any  #: of the stress of each group; zeros; two rows to work with
    strain: Any  #: of the strains
    numbers: Any  #: rows of NUMBERS integers
    ends: Any  #: one past the last spring of each group
    directions: Any  #: of the derivatives, (p, 2)
    owned: Any  #: where the directions of each spring begin and end, and these directions
    words: Any  #: this, in memory
    results: int  #: place of the results of the law in a block
    row: int  #: place of its row
    width: int
    count: int  #: springs
    groups: int
    nodes: int  #: with a state
    p: int
    base: int  #: components of the state before the derivatives, if all are integrated
    carries: int  #: components that have derivatives
    terms: int  #: of relaxation
    top: int  #: see `solve.scene.Scene`
    solved: int  #: whether the rest of the state is computed, not integrated
    none: int  #: 0; a literal is another type, for which functions are compiled again


# After the chain, the addresses of `_rates` and `_change_branch`.
RATES_AT = len(Links._fields)
CHANGE_AT, WORDS = RATES_AT + 1, RATES_AT + 2
_F, _I, _P, _IP = types.float64, types.int64, types.CPointer(types.float64), types.CPointer(types.int64)


@inlined
def pack(c):  # type: ignore[no-untyped-def]
    """Keep a chain in its `words`."""
    w = c.words
    w[0], w[1], w[2], w[3] = address(c.springs), address(c.per_mass), address(c.drive), address(c.carried)
    w[4], w[5], w[6], w[7] = address(c.own), address(c.held), address(c.part), address(c.common)
    w[8], w[9], w[10] = address(c.strain), address(c.numbers), address(c.ends)
    w[11], w[12], w[13] = address(c.directions), address(c.owned), address(c.words)
    w[14], w[15], w[16], w[17], w[18], w[19] = c.results, c.row, c.width, c.count, c.groups, c.nodes
    w[20], w[21], w[22], w[23], w[24] = c.p, c.base, c.carries, c.terms, c.top
    w[25], w[26] = c.solved, c.none


@inlined
def unpack(w):  # type: ignore[no-untyped-def]
    """Return the chain of its words."""
    return Links(
        floats_at(w[0]), floats_at(w[1]), floats_at(w[2]), floats_at(w[3]), floats_at(w[4]),
        floats_at(w[5]), floats_at(w[6]), floats_at(w[7]), floats_at(w[8]), integers_at(w[9]),
        integers_at(w[10]), integers_at(w[11]), integers_at(w[12]), w, w[14], w[15], w[16], w[17],
        w[18], w[19], w[20], w[21], w[22], w[23], w[24], w[25], w[26],
    )  # fmt: skip


# ---------------------------------------------------------------- springs


@inner
def evaluate(c, i, want):  # type: ignore[no-untyped-def]
    """Fill the results of the law of a spring at its strain and internal variables."""
    s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
    row, out = past(s, c.row), past(s, c.results)
    call_evaluate(n[EVALUATE], row, s, past(s, EPS), past(s, X), 1, want, out)


@inner
def follow_spring(c, i, eps, y, f, want):  # type: ignore[no-untyped-def]
    """Fill the values of a spring at a strain, and the rates of its relaxation terms; return T."""
    s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
    kind, out = n[KIND], past(s, c.results)
    if kind == BY_STRESS and c.solved:
        call_number(n[SETTLE], past(s, c.row), s, eps)
    elif kind != EXPLICIT:
        for k in range(n[INTERNALS]):
            s[X + k] = y[n[X_AT] + k]
    s[EPS] = eps
    evaluate(c, i, want if kind != INTERNAL or want else 2 * n[FIXED])
    sigma, tangent, drift = out[OF_LAW], out[SLOPE], 0.0
    if kind == INTERNAL and (want or n[FIXED]):
        x, values = n[INTERNALS], past(out, BY + n[PARAMETERS])
        size = 2 + 2 * x
        for k in range(x):
            by_x = values[size + (2 + k) * size]
            tangent += by_x * values[2 + k]
            drift += c.drive[PACE] * s[GAIN] * by_x * values[2 + x + k]
    stress = s[GAIN] * sigma
    for k in range(c.terms):
        z, at = y[n[Z_AT] + k], RELAX + 2 * k
        dz = -(z + sigma) / s[at + 1]
        f[n[Z_AT] + k] = dz
        stress += s[at] * z
        drift += s[at] * dz
    s[TOTAL], s[DRIFT], s[TANGENT] = stress, drift, tangent
    return stress


@inner
def move_inside(c, i, f):  # type: ignore[no-untyped-def]
    """Fill the rates of the internal variables of a spring."""
    s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
    if n[KIND] == BY_STRESS and not c.solved:
        f[n[X_AT]] = s[c.results + SLOPE] * s[RATE]
    elif n[KIND] == INTERNAL:
        x, values = n[INTERNALS], past(s, c.results + BY + n[PARAMETERS])
        for k in range(x):
            f[n[X_AT] + k] = values[2 + k] * s[RATE] + c.drive[PACE] * values[2 + x + k]


@inner
def viscous(c, i):  # type: ignore[no-untyped-def]
    """Return the stress V of an INTERNAL law."""
    s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
    return c.drive[PACE] * s[c.results + BY + n[PARAMETERS] + 1] if n[KIND] == INTERNAL else 0.0


LEAST_RATE = 1e-25  # smaller strain rates are zero, 1/s


@inner
def take_rate(c, i, common, want):  # type: ignore[no-untyped-def]
    """Fill the strain rate of a damped spring under the stress of its group.

    If V depends on the rate, by Newton's method in logarithms inside a bracket: it takes one step for
    a power of the rate.
    """
    s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
    force, s[LOSS] = common - s[TOTAL], s[ETA]
    if s[LOSSY] == 0.0 or c.drive[PACE] == 0.0:
        s[RATE] = force / s[ETA]
        return
    sign, rate, low, high = 1.0 if force > 0.0 else -1.0, abs(s[RATE]), 0.0, math.inf
    values = past(s, c.results + BY + n[PARAMETERS])
    rate = rate if rate > 0.0 else 1.0
    for _ in range(200):
        s[RATE] = sign * rate if force != 0.0 else 0.0
        evaluate(c, i, want if want else 2)
        value = sign * (values[1] + s[ETA] * s[RATE])
        s[LOSS] = s[ETA] + values[2 * (2 + 2 * n[INTERNALS]) + 1]
        if force == 0.0:  # at rest, where the derivative of a power is infinite or zero
            s[LOSS] = math.inf
            return
        low, high = (low, rate) if value >= abs(force) else (rate, high)
        new = -1.0
        if value > 0.0 and s[LOSS] > 0.0:
            new = rate * (abs(force) / value) ** (value / (s[LOSS] * rate))
        if abs(new - rate) <= 4e-16 * rate:
            return
        if not low < new < high:
            new = math.sqrt(low * high) if low > 0.0 else 1e-3 * high
            if high == math.inf:
                new = 1e3 * low
        if new == low or new == high:
            return
        rate = new
        if not rate > LEAST_RATE:
            force = 0.0


@inner
def has_loss(c, i0, i1):  # type: ignore[no-untyped-def]
    """Whether a stress V in a group depends on the strain rate."""
    for i in range(i0, i1):
        if past(c.springs, i * c.width)[LOSSY] > 0.0 and c.drive[PACE] > 0.0:
            return True
    return False


@inner
def common_of(c, i0, i1, rate, push, drag, common):  # type: ignore[no-untyped-def]
    """Return the stress under which damped springs, one of which has V, reach a rate together.

    With drag > 0 their top moves with the velocity (push - common)/drag too.
    """
    low, high = -math.inf, math.inf
    for _ in range(200):
        miss, soft = -rate, 0.0
        if drag > 0.0:
            miss, soft = miss - (push - common) / drag, 1.0 / drag
        for i in range(i0, i1):
            s = past(c.springs, i * c.width)
            take_rate(c, i, common, c.none)
            miss += s[HEIGHT] * s[RATE]
            soft += s[HEIGHT] / s[LOSS]
        low, high = (low, common) if miss > 0.0 else (common, high)
        new = common - miss / soft if soft > 0.0 else math.nan
        if miss == 0.0 or abs(new - common) <= 4e-16 * abs(common):
            break
        if not low < new < high:
            if low > -math.inf and high < math.inf:
                new = 0.5 * (low + high)
            else:
                new = common + (1.0 if miss < 0.0 else -1.0) * max(abs(common), 1.0)
            if new == low or new == high:
                break
        common = new
    return common


@inner
def span_of(c, g, y, at):  # type: ignore[no-untyped-def]
    """Return elongation and its rate of a group, as far as its nodes tell."""
    last = g == c.groups - 1
    if last and c.top == MOTION:
        reach, rate = c.drive[VALUE] + c.drive[VALUE_RATE] * at, c.drive[VALUE_RATE]
    elif last and c.top == STRESS:
        reach = rate = 0.0
    else:
        reach, rate = y[2 * g], y[2 * g + 1]
        if last and c.top == VISCOUS:
            rate = 0.0
    if g > 0:
        reach, rate = reach - y[2 * g - 2], rate - y[2 * g - 1]
    return reach, rate


@inner
def is_alone(c, g):  # type: ignore[no-untyped-def]
    """Whether the strain of a group follows from its nodes: one spring, and no massless top."""
    first = c.ends[g - 1] if g > 0 else 0
    return c.ends[g] - first == 1 and (g < c.groups - 1 or c.top == FREE or c.top == MOTION)


@inner
def follow_group(c, g, y, f, want, at):  # type: ignore[no-untyped-def]
    """Fill the values of the springs of a group and their part of the rates `f`; return S."""
    i0, i1 = (c.ends[g - 1] if g > 0 else 0), c.ends[g]
    reach, rate = span_of(c, g, y, at)
    if is_alone(c, g):
        s = past(c.springs, i0 * c.width)
        s[RATE] = rate = rate * s[PER_HEIGHT]
        common = follow_spring(c, i0, reach * s[PER_HEIGHT], y, f, want) + s[ETA] * rate
        move_inside(c, i0, f)
        c.carried[g] = common = common + viscous(c, i0)
        return common
    last = g == c.groups - 1
    push = c.drive[VALUE] + c.drive[VALUE_RATE] * at
    weight, total, loose, flat = 0.0, rate, -1, -1
    if c.solved:
        solve_loose(c, g, i0, i1, reach, push, y)
    for i in range(i0, i1):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        eps = y[n[EPS_AT]] if s[ETA] > 0.0 or not c.solved else s[EPS]
        h, eta, stress = s[HEIGHT], s[ETA], follow_spring(c, i, eps, y, f, want)
        if eta > 0.0:
            weight += h / eta
            total += h / eta * stress
        else:
            loose = i
            if s[TANGENT] == 0.0:
                flat = i
    if last and c.top == STRESS:
        common = push
    elif loose < 0:
        if last and c.top == VISCOUS:
            weight, total = weight + 1.0 / c.drive[DRAGGED], total + push / c.drive[DRAGGED]
        common = total / weight
        if has_loss(c, i0, i1):
            drag = c.drive[DRAGGED] if last and c.top == VISCOUS else 0.0
            common = common_of(c, i0, i1, rate, push, drag, c.carried[g])
    else:
        common = past(c.springs, (loose if flat < 0 else flat) * c.width)[TOTAL]
    if last and c.top == VISCOUS:
        c.drive[TOP_SPEED] = (push - common) / c.drive[DRAGGED]
        rate += c.drive[TOP_SPEED]
    share_rate(c, i0, i1, common, rate, loose, flat, last and c.top == STRESS, want)
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] > 0.0 or not c.solved:
            f[c.numbers[i * NUMBERS + EPS_AT]] = s[RATE]
        move_inside(c, i, f)
    c.carried[g] = common
    return common


@inner
def solve_loose(c, g, i0, i1, reach, push, y):  # type: ignore[no-untyped-def]
    """Fill the strains of the springs without a dashpot on their branches."""
    flat, rest, some, common = -1, reach, False, c.carried[g]
    for i in range(i0, i1):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        s[OFFSET] = 0.0
        for k in range(c.terms):
            s[OFFSET] += s[RELAX + 2 * k] * y[n[Z_AT] + k]
        if s[ETA] > 0.0:
            rest -= s[HEIGHT] * y[n[EPS_AT]]
            continue
        some = True
        if n[KIND] == INTERNAL:
            for k in range(n[INTERNALS]):
                s[X + k] = y[n[X_AT] + k]
        if s[SIGMA_LOW] == s[SIGMA_HIGH]:
            flat = i
    if not some:
        return
    if g == c.groups - 1 and c.top == STRESS:
        common = push
    elif flat >= 0:
        s = past(c.springs, flat * c.width)
        common = s[GAIN] * s[SIGMA_HIGH] + s[OFFSET]
    else:
        root(c, i0, i1, rest, common, -math.inf, math.inf, 1)
        return
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] == 0.0 and i != flat:
            put(c, i, strain_at(c, i, common), common)
            rest -= s[HEIGHT] * s[EPS]
    if flat >= 0 and not (g == c.groups - 1 and c.top == STRESS):
        s = past(c.springs, flat * c.width)
        s[EPS] = rest / s[HEIGHT]


@inner
def share_rate(c, i0, i1, common, rate, loose, flat, pushed, want):  # type: ignore[no-untyped-def]
    """Fill the strain rates of a group of several springs; `pushed`: its stress is prescribed."""
    soft, rest, climb = 0.0, rate, c.drive[VALUE_RATE]
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] > 0.0:
            take_rate(c, i, common, want)
            rest -= s[HEIGHT] * s[RATE]
        elif flat < 0:
            compliance = s[HEIGHT] / (s[GAIN] * s[TANGENT])
            soft += compliance
            rest += compliance * s[DRIFT]
    if loose < 0:
        return
    if not pushed and flat < 0:
        climb = rest / soft
    elif not pushed:
        climb = past(c.springs, flat * c.width)[DRIFT]
    elif flat >= 0:
        c.drive[FLAT] = 1.0
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] == 0.0 and i != flat:
            slope = s[GAIN] * s[TANGENT]
            s[RATE] = (climb - s[DRIFT]) / slope if slope > 0.0 else 0.0
            rest -= s[HEIGHT] * s[RATE] if flat >= 0 else 0.0
    if flat >= 0:
        past(c.springs, flat * c.width)[RATE] = 0.0 if pushed else (
            rest / past(c.springs, flat * c.width)[HEIGHT]
        )  # fmt: skip


# ---------------------------------------------------------------- derivatives


@inner
def derive_spring(c, i, y):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the stress of a spring at fixed strain, and of T at fixed strain."""
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    part, total = past(c.part, i * p), past(c.part, (c.count + i) * p)
    out = past(s, c.results)
    s[STEEP] = s[TANGENT] if n[FIXED] else out[SLOPE]
    for j in range(p):
        part[j] = 0.0
    if n[KIND] == BY_STRESS:
        a, b, held = out[BY_HELD], out[BY_HELD + 1], past(c.held, 2 * i * p)
        for j in range(p):
            part[j] = a * held[j] + b * held[p + j]
    elif n[KIND] == INTERNAL:
        size = 2 + 2 * n[INTERNALS]
        for k in range(n[INTERNALS]):
            by_x = out[BY + n[PARAMETERS] + size + (2 + k) * size]
            d_x = past(y, c.base + (n[X_AT] + k) * p)
            for j in range(p):
                part[j] += by_x * d_x[j]
    for k in range(c.owned[i], c.owned[i + 1]):
        part[c.owned[k]] += out[BY + c.directions[2 * c.owned[k] + 1]]
    gain = s[GAIN]
    for j in range(p):
        total[j] = gain * part[j]
    for k in range(c.terms):
        g, dz, of_g = s[RELAX + 2 * k], past(y, c.base + (n[Z_AT] + k) * p), OWN_RELAXATION + 2 * k
        for j in range(p):
            total[j] += g * dz[j]
            if c.directions[2 * j] == i and c.directions[2 * j + 1] == of_g:
                total[j] += out[OF_LAW] + y[n[Z_AT] + k]


@inner
def derive_inside(c, i, y, f, quicker):  # type: ignore[no-untyped-def]
    """Fill the rates of the derivatives of relaxation terms and of internal variables.

    `quicker` are the derivatives of the strain rate, for INTERNAL laws; not read if they are unknown.
    """
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    part, strain, out = past(c.part, i * p), past(c.strain, i * p), past(s, c.results)
    for k in range(c.terms):
        at, per = c.base + (n[Z_AT] + k) * p, 1.0 / s[RELAX + 2 * k + 1]
        more, of_tau = (y[n[Z_AT] + k] + out[OF_LAW]) * per * per, OWN_RELAXATION + 2 * k + 1
        for j in range(p):
            f[at + j] = -per * (y[at + j] + s[STEEP] * strain[j] + part[j])
            if c.directions[2 * j] == i and c.directions[2 * j + 1] == of_tau:
                f[at + j] += more
    if n[KIND] != INTERNAL:
        return
    x, values = n[INTERNALS], past(out, BY + n[PARAMETERS])
    size = 2 + 2 * x
    by = past(values, size)
    for k in range(x):
        a, b, rate = 2 + k, 2 + x + k, s[RATE]
        at, by_strain = c.base + (n[X_AT] + k) * p, c.drive[PACE] * by[b]
        if n[FIXED]:
            for m in range(x):
                column = past(by, (2 + m) * size)
                change = column[b] * values[2 + m] - column[a] * values[2 + x + m]
                by_strain += c.drive[PACE] * change
        else:
            by_strain += rate * by[a]
        for j in range(p):
            f[at + j] = by_strain * strain[j] + (0.0 if n[FIXED] else values[a] * quicker[j])
        for m in range(x):
            column, d_x = past(by, (2 + m) * size), past(y, c.base + (n[X_AT] + m) * p)
            for j in range(p):
                f[at + j] += (rate * column[a] + c.drive[PACE] * column[b]) * d_x[j]
        for m in range(c.owned[i], c.owned[i + 1]):
            j = c.owned[m]
            column = past(by, (2 + x + c.directions[2 * j + 1]) * size)
            f[at + j] += rate * column[a] + c.drive[PACE] * column[b]


@inner
def derive_viscous(c, i, y, quicker, out):  # type: ignore[no-untyped-def]
    """Add the derivatives of the stress V of an INTERNAL law."""
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    strain, size = past(c.strain, i * p), 2 + 2 * n[INTERNALS]
    by = past(s, c.results + BY + n[PARAMETERS] + size)
    for j in range(p):
        out[j] += c.drive[PACE] * (by[1] * strain[j] + by[size + 1] * quicker[j])
    for k in range(n[INTERNALS]):
        d_x = past(y, c.base + (n[X_AT] + k) * p)
        for j in range(p):
            out[j] += c.drive[PACE] * by[(2 + k) * size + 1] * d_x[j]
    for m in range(c.owned[i], c.owned[i + 1]):
        j = c.owned[m]
        out[j] += c.drive[PACE] * by[(2 + n[INTERNALS] + c.directions[2 * j + 1]) * size + 1]


@inner
def span_tangents(c, g, y, reach, rate):  # type: ignore[no-untyped-def]
    """Fill the derivatives of elongation and rate of a group, as far as its nodes tell."""
    p, last = c.p, g == c.groups - 1
    for j in range(p):
        reach[j] = rate[j] = 0.0
    if not last or c.top == FREE or c.top == VISCOUS:
        dw = past(y, c.base + 2 * g * p)
        for j in range(p):
            reach[j] = dw[j]
        if not last or c.top == FREE:
            for j in range(p):
                rate[j] = dw[p + j]
    if g > 0:
        dw = past(y, c.base + 2 * (g - 1) * p)
        for j in range(p):
            reach[j] -= dw[j]
            rate[j] -= dw[p + j]


@inner
def derive_group(c, g, y, f):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the stress of a group, and of the rates of its springs."""
    i0, i1, p = (c.ends[g - 1] if g > 0 else 0), c.ends[g], c.p
    out = past(c.common, g * p)
    reach, rate = past(c.common, (c.groups + 1) * p), past(c.common, (c.groups + 2) * p)
    span_tangents(c, g, y, reach, rate)
    if not is_alone(c, g):
        derive_several(c, g, i0, i1, y, f, reach, rate, out)
        return
    derive_spring(c, i0, y)
    s, own, strain = past(c.springs, i0 * c.width), past(c.own, 2 * i0 * p), past(c.strain, i0 * p)
    per, eta, total = s[PER_HEIGHT], s[ETA], past(c.part, (c.count + i0) * p)
    slope, eps, faster = s[STEEP] * s[GAIN], s[EPS], s[RATE]
    for j in range(p):
        strain[j] = (reach[j] - eps * own[j]) * per
        rate[j] = (rate[j] - faster * own[j]) * per
        out[j] = slope * strain[j] + total[j] + own[p + j] * faster + eta * rate[j]
    derive_inside(c, i0, y, f, rate)
    if c.numbers[i0 * NUMBERS + KIND] == INTERNAL:
        derive_viscous(c, i0, y, rate, out)


@inner
def derive_several(c, g, i0, i1, y, f, reach, rate, out):  # type: ignore[no-untyped-def]
    """Do the same for a group of several springs, or under a massless top."""
    p, loose, soft, weight, flat = c.p, -1, 0.0, 0.0, -1
    last = g == c.groups - 1
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] > 0.0:
            weight += s[HEIGHT] / s[LOSS]
            continue
        loose = i
        if s[TANGENT] == 0.0:
            flat = i
        else:
            soft += s[HEIGHT] / (s[GAIN] * s[TANGENT])
    for i in range(i0, i1):  # of damped springs `total` becomes the whole derivative
        derive_spring(c, i, y)
        s, own, total = (
            past(c.springs, i * c.width),
            past(c.own, 2 * i * p),
            past(c.part, (c.count + i) * p),
        )
        slope, at, share = s[GAIN] * s[STEEP], c.numbers[i * NUMBERS + EPS_AT], 0.0
        if s[ETA] > 0.0:
            share = s[HEIGHT] / s[LOSS]
            for j in range(p):
                c.strain[i * p + j] = y[c.base + at * p + j]
                total[j] += slope * c.strain[i * p + j]
            if s[LOSSY] > 0.0:  # at the present rate
                derive_viscous(c, i, y, past(c.common, c.groups * p), total)
        else:
            for j in range(p):
                total[j] += own[p + j] * s[RATE]
            if flat < 0:
                share = s[HEIGHT] / slope
        over = -s[RATE] if loose < 0 else 0.0
        for j in range(p):
            if loose < 0:
                rate[j] += share * total[j] + over * (own[j] - share * own[p + j])
            elif s[ETA] > 0.0:
                reach[j] -= s[EPS] * own[j] + s[HEIGHT] * y[c.base + at * p + j]
            else:
                reach[j] -= s[EPS] * own[j] - share * total[j]
    derive_common(c, last, loose, flat, soft, weight, reach, rate, out)
    for i in range(i0, i1):
        derive_share(c, i, y, f, i == flat, reach, out)
    if last and c.top == VISCOUS:
        per, of_drag, top = 1.0 / c.drive[DRAGGED], past(c.own, 2 * c.count * p), c.base + 2 * g * p
        for j in range(p):
            f[top + j] = -per * (out[j] + of_drag[j] * c.drive[TOP_SPEED])
            f[top + p + j] = 0.0


@inner
def derive_common(c, last, loose, flat, soft, weight, reach, rate, out):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the stress of a group; see `derive_several`."""
    p, of_drag = c.p, past(c.own, 2 * c.count * c.p)
    if last and c.top == STRESS:
        for j in range(p):
            out[j] = 0.0
    elif loose < 0:
        if last and c.top == VISCOUS:
            weight += 1.0 / c.drive[DRAGGED]
            for j in range(p):
                rate[j] -= of_drag[j] * c.drive[TOP_SPEED] / c.drive[DRAGGED]
        for j in range(p):
            out[j] = rate[j] / weight if weight > 0.0 else 0.0  # all at rest
    elif flat < 0:
        for j in range(p):
            out[j] = reach[j] / soft
    else:
        for j in range(p):
            out[j] = c.part[(c.count + flat) * p + j]
            reach[j] -= out[j] * soft  # left for the flat branch


@inner
def derive_share(c, i, y, f, is_flat, reach, out):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the strain of a spring in a group of several; of its rate too."""
    p, at = c.p, c.numbers[i * NUMBERS + EPS_AT]
    s, own, total = (
        past(c.springs, i * c.width),
        past(c.own, 2 * i * p),
        past(c.part, (c.count + i) * p),
    )
    strain, mine = past(c.strain, i * p), c.base + at * p
    if s[ETA] > 0.0:
        for j in range(p):
            strain[j] = y[mine + j]
            f[mine + j] = (out[j] - total[j] - s[RATE] * own[p + j]) / s[LOSS]
    elif is_flat:
        for j in range(p):
            strain[j] = reach[j] / s[HEIGHT]
    else:
        slope = s[GAIN] * s[STEEP]
        for j in range(p):
            strain[j] = (out[j] - total[j]) / slope
    derive_inside(c, i, y, f, past(f, mine) if s[ETA] > 0.0 else strain)


@cfunc(types.void(_IP, _P, _P, _I, _F, _I), **OPTIONS, cache=True)
def _rates(words, y, f, want, at, only):  # type: ignore[no-untyped-def]
    c = unpack(words)
    p, last = c.p, c.groups - 1
    for g in range(c.groups):
        if only >= 0 and g != only:
            continue
        follow_group(c, g, y, f, want, at)
        if want:
            derive_group(c, g, y, f)
    if only >= 0:
        return
    for g in range(c.nodes):
        if g == last and c.top == VISCOUS:
            f[2 * g], f[2 * g + 1] = c.drive[TOP_SPEED], 0.0
            continue
        v, per, drag = y[2 * g + 1], c.per_mass[g], 0.0
        above = past(c.common, (g + 1) * p)  # zeros above the last
        if g == last:
            drag = c.drive[DRAGGED]
            force = c.drive[VALUE] + c.drive[VALUE_RATE] * at - c.carried[g] - drag * v
        else:
            force = c.carried[g + 1] - c.carried[g]
        f[2 * g], f[2 * g + 1] = v, force * per
        if not want:
            continue
        dv, df = past(y, c.base + (2 * g + 1) * p), past(f, c.base + 2 * g * p)
        here, of_drag = past(c.common, g * p), past(c.own, 2 * c.count * p)
        for j in range(p):
            df[j] = dv[j]
            df[p + j] = (above[j] - here[j] - drag * dv[j]) * per
        if g == last:
            for j in range(p):
                df[p + j] -= of_drag[j] * v * per


RATES = _rates.address


@intrinsic
def _call_rates(typing, where, words, y, f, want, at, only):  # type: ignore[no-untyped-def]
    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in args[1:]])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
        return context.get_dummy_value()

    return types.void(_I, _IP, _P, _P, _I, _F, _I), emit


@inlined
def rates(c, y, f, want, at):  # type: ignore[no-untyped-def]
    """Fill the rates f of a state y (with derivatives if `want`) at a time since the piece began."""
    _call_rates(c.words[RATES_AT], c.words, y, f, want, at, -1)


@inlined
def rates_of(c, g, y, f, want, at):  # type: ignore[no-untyped-def]
    """Fill the values of one group, as `rates` does."""
    _call_rates(c.words[RATES_AT], c.words, y, f, want, at, g)


# ---------------------------------------------------------------- from branch to branch


@inner
def leave_inside(c, i, up, y):  # type: ignore[no-untyped-def]
    """Change the branch of a spring of an INTERNAL law, whose internal variables may jump.

    Their rates may jump too, so that the delay of the instant of the change counts.
    """
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    x = n[INTERNALS]
    changes = past(s, c.results + BY + n[PARAMETERS] + 2 + 2 * x)  # instead of derivatives
    call_switch(n[SWITCH], past(s, c.row), s, up, changes)
    for k in range(x):
        y[n[X_AT] + k] = s[X + k]
    if p == 0:
        return
    wide, first = 1 + x + n[PARAMETERS], past(s, c.results + BY + n[PARAMETERS] + 2)  # A, then B
    end, out, late = past(changes, x * wide), past(changes, (x + 1) * wide), 0.0
    faster = s[RATE] * (1.0 - end[0])  # of the strain past the end
    for k in range(x):
        faster -= end[1 + k] * (s[RATE] * first[k] + c.drive[PACE] * first[x + k])
    delays = past(c.common, (c.groups + 1) * p)
    for j in range(p):
        strain = c.strain[i * p + j]
        own = c.directions[2 * j + 1] if c.directions[2 * j] == i else OWN_ETA
        for k in range(x + 1):  # of the end, then of the internal variables at the instant
            by = end if k == 0 else past(changes, (k - 1) * wide)
            value = by[0] * (strain + s[RATE] * late if k > 0 else strain)
            for m in range(x):
                d_x = y[c.base + (n[X_AT] + m) * p + j] + (first[m] * strain if n[FIXED] else 0.0)
                if k > 0:
                    d_x += (s[RATE] * first[m] + c.drive[PACE] * first[x + m]) * late
                value += by[1 + m] * d_x
            if own < OWN_ETA:
                value += by[1 + x + own]
            if k == 0:
                late = (value - strain) / faster if faster != 0.0 else 0.0
            else:
                out[k - 1] = value
        delays[j] = late
        for k in range(x):
            y[c.base + (n[X_AT] + k) * p + j] = out[k]
    evaluate(c, i, c.none)  # on the next branch
    for j in range(p):
        strain = c.strain[i * p + j] if n[FIXED] else 0.0
        for k in range(x):
            moved = first[k] * (strain + s[RATE] * delays[j])
            moved += c.drive[PACE] * first[x + k] * delays[j]
            y[c.base + (n[X_AT] + k) * p + j] -= moved


@cfunc(types.void(_IP, _I, _I, _P), **OPTIONS, cache=True)
def _change_branch(words, i, up, y):  # type: ignore[no-untyped-def]
    c = unpack(words)
    s, n, p = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS), c.p
    out, kind = past(s, c.results), n[KIND]
    slope, x = out[SLOPE], n[INTERNALS]
    changes = past(out, BY + n[PARAMETERS])  # no derivatives of a BY_STRESS law
    if kind == INTERNAL:
        leave_inside(c, i, up, y)
        return
    call_switch(n[SWITCH], past(s, c.row), s, up, changes)
    if kind == EXPLICIT:
        return
    if not c.solved and n[X_AT] >= 0:
        y[n[X_AT]] = s[X]
    held, change = past(c.held, 2 * i * p), OF_PARAMETER + n[PARAMETERS]
    for j in range(p):
        d_sigma = slope * c.strain[i * p + j] + c.part[i * p + j]
        first, second, own = held[j], held[p + j], c.directions[2 * j + 1]
        for h in range(2):
            by = past(changes, h * change)
            value = by[OF_STRESS] * d_sigma + by[OF_HELD] * first + by[OF_HELD + 1] * second
            if c.directions[2 * j] == i and own < OWN_ETA:
                value += by[OF_PARAMETER + own]
            held[h * p + j] = value


CHANGE = _change_branch.address


@intrinsic
def _call_change(typing, where, words, i, up, y):  # type: ignore[no-untyped-def]
    def emit(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in args[1:]])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
        return context.get_dummy_value()

    return types.void(_I, _IP, _I, _I, _P), emit


@inlined
def change_branch(c, i, up, y):  # type: ignore[no-untyped-def]
    """Change the branch of a spring, and the derivatives of its held numbers."""
    _call_change(c.words[CHANGE_AT], c.words, i, up, y)


# ---------------------------------------------------------------- layout


@inner
def begin(c):  # type: ignore[no-untyped-def]
    """Set all springs at rest."""
    for i in range(c.count):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        call_begin(n[BEGIN], past(s, c.row), s)
        s[EPS] = s[RATE] = 0.0
