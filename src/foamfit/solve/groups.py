"""Groups of several springs between two nodes, or under a top without mass: one stress S.

- Several springs with dashpots: S = (Δv + Σ h T/η)/(Σ h/η), dε/dt = (S - T)/η.
- Some without: S is their T; they share the rest of the elongation by their compliances; a spring
  on a flat branch takes all of it.

A zero-mass node therefore needs no equation to be solved. If a stress is prescribed on a top
without mass, it is S of the last group; an onsite damper then moves the top with v = (push - S)/D.
"""

from __future__ import annotations

import math

from numba import cfunc

from foamfit.solve.equilibrium import put, root, strain_at
from foamfit.solve.events import ROUNDED
from foamfit.solve.motion import (
    GROUP,
    LOSE,
    LOSSES,
    ONLY_DERIVATIVES,
    SHARE,
    call_inside,
    derive_inside,
    derive_spring,
    follow_spring,
    move_inside,
    span_of,
    span_tangents,
)
from foamfit.solve.run import (
    DRAGGED,
    EPS_AT,
    FLAT,
    INTERNALS,
    KIND,
    NUMBERS,
    PACE,
    PUSH,
    SPREAD,
    TOP_SPEED,
    VALUE,
    VALUE_RATE,
    X_AT,
    Z_AT,
    unpack,
)
from foamfit.solve.scene import STRESS, VISCOUS
from foamfit.springs.compiled.contract import (
    BY_STRESS,
    DRIFT,
    EPS,
    ETA,
    GAIN,
    HEIGHT,
    HIGH,
    INTERNAL,
    LOSS,
    LOSSY,
    LOW,
    OFFSET,
    OPTIONS,
    RATE,
    RELAX,
    SIGMA_HIGH,
    SIGMA_LOW,
    STEEP,
    TANGENT,
    TOTAL,
    TURNS,
    X,
    inner,
    past,
)  # fmt: skip

STANDS, MOVES = 1e-12, 1e-9  # relative rates that are nothing but rounding, and more than that
SNAPPING = (0, 2, 3)  # parameters of a bistable law on which the stress at A1 depends


@inner
def _follow(c, g, y, f, want, at):  # type: ignore[no-untyped-def]
    """Fill the values of the springs of a group and their part of the rates `f`."""
    i0, i1 = (c.ends[g - 1] if g > 0 else 0), c.ends[g]
    reach, rate = span_of(c, g, y, at)
    last = g == c.groups - 1
    push = c.drive[VALUE] + c.drive[VALUE_RATE] * at
    weight, total, pull, loose, flat, lossy = 0.0, rate, -rate, -1, -1, False
    if c.solved:
        solve_loose(c, g, i0, i1, reach, push, y)
    for i in range(i0, i1):
        s, n = past(c.springs, i * c.width), past(c.numbers, i * NUMBERS)
        eps = y[n[EPS_AT]] if s[ETA] > 0.0 or not c.solved else s[EPS]
        h, eta, stress = s[HEIGHT], s[ETA], follow_spring(c, i, eps, y, f, want)
        if eta > 0.0:
            weight += h / eta
            total += h / eta * stress
            pull += h / eta * (push - stress)
            lossy = lossy or s[LOSSY] * c.drive[PACE] > 0.0
        else:
            loose = i
            if s[TANGENT] == 0.0:
                flat = i
    if last and c.top == STRESS:
        common = push
    elif loose >= 0:
        common = past(c.springs, (loose if flat < 0 else flat) * c.width)[TOTAL]
    elif lossy:
        c.drive[PUSH], c.drive[SPREAD] = push, rate
        call_inside(c, SHARE, g, want, y, f, y, y)
        common = c.carried[g]
    elif last and c.top == VISCOUS:  # without the difference of S and push, which may be tiny
        common = push - c.drive[DRAGGED] * pull / (c.drive[DRAGGED] * weight + 1.0)
    else:
        common = total / weight
    if last and c.top == VISCOUS:
        drag = c.drive[DRAGGED]
        if loose >= 0:
            c.drive[TOP_SPEED] = (push - common) / drag
        elif not lossy:
            c.drive[TOP_SPEED] = pull / (drag * weight + 1.0)
        rate += c.drive[TOP_SPEED]
    c.carried[g] = common
    share_rate(c, g, i0, i1, rate, loose, flat, last and c.top == STRESS, lossy)
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] > 0.0 or not c.solved:
            f[c.numbers[i * NUMBERS + EPS_AT]] = s[RATE]
        move_inside(c, i, f)


@inner
def solve_loose(c, g, i0, i1, reach, push, y):  # type: ignore[no-untyped-def]
    """Fill the strains of the springs without a dashpot on their branches."""
    flat, rest, some = -1, reach, False
    common = c.carried[g] if abs(c.carried[g]) < math.inf else 0.0  # after a trial that failed
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
def _close(c, i0, i1, rest, pushed):  # type: ignore[no-untyped-def]
    """Give what rounding leaves of the rate of elongation to the spring with the lightest dashpot.

    Rounding errors of S - T over a light dashpot would change the elongation, and nothing resists.
    """
    least, where = math.inf, i0
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[LOSS] < least * s[HEIGHT]:
            least, where = s[LOSS] / s[HEIGHT], i
    if not pushed:
        s = past(c.springs, where * c.width)
        s[RATE] += rest / s[HEIGHT]


@inner
def share_rate(c, g, i0, i1, rate, loose, flat, pushed, lossy):  # type: ignore[no-untyped-def]
    """Fill the strain rates of a group of several springs; `pushed`: its stress is prescribed.

    `lossy`: a stress of its springs depends on the strain rate, besides that of dashpots.
    """
    soft, rest, climb, common = 0.0, rate, c.drive[VALUE_RATE], c.carried[g]
    for i in range(i0, i1):
        s = past(c.springs, i * c.width)
        if s[ETA] > 0.0:
            if lossy and s[LOSSY] > 0.0:
                call_inside(c, LOSE, i, g, c.y, c.f, c.y, c.y)
            else:
                s[RATE] = (common - s[TOTAL]) / s[ETA]
            rest -= s[HEIGHT] * s[RATE]
        elif flat < 0:
            compliance = s[HEIGHT] / (s[GAIN] * s[TANGENT])
            soft += compliance
            rest += compliance * s[DRIFT]
    if loose < 0:
        _close(c, i0, i1, rest if not pushed else 0.0, pushed)
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
def derive_group(c, g, y, f):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the stress of a group, and of the rates of its springs."""
    i0, i1, p = (c.ends[g - 1] if g > 0 else 0), c.ends[g], c.p
    out = past(c.common, g * p)
    reach, rate = past(c.common, (c.groups + 1) * p), past(c.common, (c.groups + 2) * p)
    span_tangents(c, g, y, reach, rate)
    loose, soft, weight, flat = -1, 0.0, 0.0, -1
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
                total[j] += slope * y[c.base + at * p + j]
            if s[LOSSY] > 0.0:
                call_inside(c, LOSSES, i, c.none, y, f, y, total)
        else:
            for j in range(p):
                total[j] += own[p + j] * s[RATE]
            if slope > 0.0:
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
            here = -per * (out[j] + of_drag[j] * c.drive[TOP_SPEED])
            f[top + j], f[top + p + j] = rate[j] if loose < 0 else here, 0.0


@inner
def derive_common(c, last, loose, flat, soft, weight, reach, rate, out):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the stress of a group; see `derive_group`."""
    p, of_drag = c.p, past(c.own, 2 * c.count * c.p)
    if last and c.top == STRESS:
        for j in range(p):
            out[j] = 0.0
    elif loose < 0 and last and c.top == VISCOUS:
        drag, speed = c.drive[DRAGGED], c.drive[TOP_SPEED]
        for j in range(p):  # `rate` becomes that of the velocity of the top
            rate[j] = -(rate[j] + of_drag[j] * speed * weight) / (drag * weight + 1.0)
            out[j] = -drag * rate[j] - of_drag[j] * speed
    elif loose < 0:
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
            strain[j] = (out[j] - total[j]) / slope if slope > 0.0 else 0.0
    derive_inside(c, i, y, f, past(f, mine) if s[ETA] > 0.0 else strain)


@inner
def _mark_one_sided(c, g):  # type: ignore[no-untyped-def]
    """Mark the derivatives that differ from above and below.

    A snapping spring that stands still continues for one sign of the change of a parameter and is
    held for the other; of several springs on flat branches, the sign decides which moves first.
    """
    p, flat, ready, common = c.p, 0, 0, past(c.common, g * c.p)
    first, last = (c.ends[g - 1] if g > 0 else 0), c.ends[g]
    for i in range(first, last):
        s = past(c.springs, i * c.width)
        ends = min(abs(s[EPS] - s[HIGH]), abs(s[EPS] - s[LOW])) < ROUNDED  # and may go on to one
        flat += int(s[SIGMA_LOW] == s[SIGMA_HIGH] and s[ETA] == 0.0)
        ready += int(s[SIGMA_LOW] < s[SIGMA_HIGH] and ends and s[ETA] == 0.0)
    for i in range(first, last):
        s, total = past(c.springs, i * c.width), past(c.part, (c.count + i) * p)
        snaps = s[TURNS] != 0.0 and c.numbers[i * NUMBERS + KIND] == BY_STRESS
        stands = snaps and abs(s[RATE]) * s[ETA] < STANDS * abs(c.carried[g])
        for j in range(p):
            if stands and abs(common[j] - total[j]) > MOVES * max(abs(common[j]), abs(total[j])):
                c.sided[j] = 1.0
            several = flat > 1 or (flat == 1 and ready > 0)
            mine = c.directions[2 * j] == i and s[SIGMA_LOW] == s[SIGMA_HIGH] and s[ETA] == 0.0
            if several and mine and c.directions[2 * j + 1] in SNAPPING:
                c.sided[j] = 1.0


@cfunc(GROUP, **OPTIONS, cache=True)
def _group(words, g, y, f, want, at):  # type: ignore[no-untyped-def]
    """Fill the values of the springs of a group and their part of the rates `f`; return S."""
    c = unpack(words)
    if want != ONLY_DERIVATIVES:
        _follow(c, g, y, f, want, at)
    if want:
        derive_group(c, g, y, f)
        _mark_one_sided(c, g)
    return c.carried[g]


GROUP_AT = _group.address
