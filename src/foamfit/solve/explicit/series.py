"""Taylor series in time of a chain on fixed branches.

On each branch the law is a straight line or σ (1 - x) = k x, so every coefficient of strains,
stresses and motion follows from the lower ones by a short recurrence. Springs with memory have
their own recurrences (`explicit.memory`), and so have the derivatives (`explicit.tangents`).

Only masses are nodes. Between two nodes lies a group of springs in series, which carry one stress;
massless nodes have no state. In a group, the springs without dashpot share the elongation according
to their compliances, at every order of the series.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.solve.explicit.memory import (
    EQ,
    GAIN,
    GIVE,
    PER_A,
    PER_GAIN,
    PER_GIVE,
    RELAXED,
    SOFT,
    Memory,
    enter_mixture,
    finish_mixture,
    keep,
    start_mixture,
    strain_at,
    strain_of_mixture,
)
from foamfit.solve.polynomial import value_at
from foamfit.solve.scene import FREE, MOTION, STRESS, VISCOUS
from foamfit.springs import microscale_kernels as micro
from foamfit.springs.kernels import (
    HELD,
    KIND,
    REMEMBERS,
    Array,
    Branches,
    Row,
    branch_shape,
    inlined,
    inner,
    interval,
    maker,
    once,
    piece,
)
from foamfit.springs.law import MICROSCALE
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_HEIGHT
from foamfit.springs.sensitivities import branch_derivative

# Rows of the series of a chain: displacement and velocity of the nodes above the groups, strain and
# stress of the springs, common stress of the groups, slope T = dσ/dε of the springs.
W, V, EPS, SIG, GROUP, TILT, N_SERIES = range(7)
# Columns of `Links.law`. Those that depend on parameters: slope k and origins x0 and s0 of the
# current branch, dashpot and height of the spring. Then whether the branch is curved (0 or 1, or
# the branch of a microscale spring that is a mixture), the strains at which it ends, and 1/(1 - x)
# on a curved branch at the start of the step.
SLOPE, ORIGIN, OFFSET, DASHPOT, HEIGHT, N_MOVES = range(6)
CURVED, LOW, HIGH, INVERSE, N_LAW = range(N_MOVES, 10)


class Links(NamedTuple):
    """A chain with its springs on their current branches.

    The series of a chain are an array (N_SERIES, springs, order + 2); order 0 of W, V and EPS is
    the state. W, V and GROUP have one column per group; the last order of SIG, GROUP and TILT is
    unused.
    """

    law: Array  #: the branches, as `enter` writes them, (springs, N_LAW)
    ends: Branches  #: one past the last spring of each group, (groups,)
    mass: Array  #: areal mass of the node above each group, kg/m², (groups,)
    drag: float  #: η_site/H, Pa·s/m
    top: int  #: see `solve.scene.Scene`


class SeriesTangents(NamedTuple):
    """Derivatives of a chain in p directions."""

    law: Array  #: of the first columns of `Links.law`, (p, springs, N_MOVES)
    drag: Array  #: of the onsite damping, (p,)
    live: Array  #: 1 where any derivative is nonzero, (p,)
    series: Array  #: of the series except TILT, (p, N_SERIES, springs, order + 2)


@inner
def is_mixture(row: Row, branch: int) -> bool:
    """Whether `Memory` follows a spring: off branch a, and on it too if the spring remembers."""
    return branch >= HELD or (row[KIND] == MICROSCALE and row[REMEMBERS] > 0.0)


@inner
def enter(rows: Array, i: int, branch: int, law: Array, memory: Memory | None) -> None:
    """Write the branch that spring i enters."""
    if memory is not None and is_mixture(rows[i], branch):
        law[i, CURVED] = float(max(branch, HELD))
        law[i, LOW], law[i, HIGH] = enter_mixture(memory, i)
        return
    curved, law[i, SLOPE], law[i, ORIGIN], law[i, OFFSET] = branch_shape(rows[i], branch)
    law[i, CURVED] = 1.0 if curved else 0.0
    law[i, LOW], law[i, HIGH] = interval(rows[i], branch)
    if memory is not None and rows[i, KIND] == MICROSCALE:
        law[i, LOW], law[i, HIGH] = -math.inf, memory.state[i, micro.HIGH]


@inner
def slope_now(law: Array, i: int, eps: float, memory: Memory | None) -> float:
    """Return the slope dΣ/dε of spring i; for a mixture, at the start of the step."""
    k, y = law[i, SLOPE], 1.0 - (eps - law[i, ORIGIN])
    slope = k / (y * y) if law[i, CURVED] != 0.0 else k
    if memory is not None:
        gain = memory.now[i, GAIN]
        return gain / memory.now[i, GIVE] if law[i, CURVED] >= HELD else gain * slope
    return slope


@inner
def enter_tangents(
    rows: Array, i: int, branch: int, directions: Branches, d: SeriesTangents
) -> None:
    """Write the derivatives of the branch that spring i enters."""
    for p in range(directions.shape[0]):
        if directions[p, 0] == i and directions[p, 1] < OWN_ETA:
            dk, dx0, ds0 = branch_derivative(rows[i], branch, directions[p, 1])
            d.law[p, i, SLOPE], d.law[p, i, ORIGIN], d.law[p, i, OFFSET] = dk, dx0, ds0
            if dk != 0.0 or dx0 != 0.0 or ds0 != 0.0:
                d.live[p] = 1.0
            if is_mixture(rows[i], branch):  # `Memory` has the derivatives
                d.live[p] = 1.0


@maker
def make_series(count: int, order: int, directions: Branches) -> tuple[Array, SeriesTangents]:
    """Return the series of a chain at rest, and derivatives with the directions set."""
    p = directions.shape[0]
    series, ways = np.zeros((1 + p, N_SERIES, count, order + 2)), np.zeros((2, p))
    d = SeriesTangents(np.zeros((p, count, N_MOVES)), ways[0], ways[1], series[1:])
    for q in range(p):
        i, what = directions[q, 0], directions[q, 1]
        if what >= OWN_ETA:
            d.live[q] = 1.0
        if what == OWN_ETA:
            d.law[q, i, DASHPOT] = 1.0
        elif what == OWN_HEIGHT:
            d.law[q, i, HEIGHT] = 1.0
        elif what == DRAG:
            d.drag[q] = 1.0
    return series[0], d


# ---------------------------------------------------------------- the motion


@inner
def springs_of(ends: Branches, g: int) -> tuple[np.int64, np.int64]:
    """Return the first spring of a group, and one past its last."""
    first = ends[g - 1] if g > 0 else ends[0] - ends[0]
    return first, ends[g]


@inlined
def product(x: Array, y: Array, i: int, n: int) -> float:
    """Return Σ x_j y_{n-j} of spring i for j from 1 to n - 1."""
    even = odd = 0.0  # two independent sums run in parallel
    for j in range(1, n - 1, 2):
        even += x[i, j] * y[i, n - j]
        odd += x[i, j + 1] * y[i, n - j - 1]
    if n % 2 == 0:
        even += x[i, n - 1] * y[i, 1]
    return even + odd


@inlined
def _law_stress(law: Array, i: int, eps: Array, sig: Array, n: int) -> float:
    """Return order n of the stress of a spring's law from its strain up to order n."""
    k = law[i, SLOPE]
    if n > 0:
        if law[i, CURVED] == 0.0:
            return k * eps[i, n]
        known = product(eps, sig, i, n)
        return ((k + sig[i, 0]) * eps[i, n] + known) * law[i, INVERSE]
    x = eps[i, 0] - law[i, ORIGIN]
    if law[i, CURVED] == 0.0:
        return law[i, OFFSET] + k * x
    law[i, INVERSE] = 1.0 / (1.0 - x) if x < 1.0 else math.inf
    return k * x * law[i, INVERSE]


@inlined
def _stress_term(
    law: Array, i: int, eps: Array, sig: Array, n: int, memory: Memory | None
) -> float:
    """Return order n of a spring's stress from its strain up to order n."""
    if memory is None:
        return _law_stress(law, i, eps, sig, n)
    moving, now, m = law[i, CURVED] > HELD, memory.now[i], memory.series[i]
    if law[i, CURVED] < HELD:
        s_n = _law_stress(law, i, eps, memory.series[:, :, EQ], n)
        if n == 0:
            now[PER_A] = 1.0 / (law[i, SLOPE] + s_n)
            soft = (1.0 - (eps[i, 0] - law[i, ORIGIN])) * now[PER_A]
            if law[i, CURVED] == 0.0:
                soft = 1.0 / law[i, SLOPE] if law[i, SLOPE] > 0.0 else math.inf
            now[SOFT] = soft * now[PER_GAIN]
    elif n == 0:
        s_n = start_mixture(memory, i, moving, eps[i, 0])
    else:
        s_n = (eps[i, n] - strain_of_mixture(now, m, moving, n)) * now[PER_GIVE]
        finish_mixture(now, m, moving, n, s_n)
    keep(memory.rows[i], m, n, s_n)
    return now[GAIN] * s_n + m[n, RELAXED]


@inlined
def _softness(law: Array, i: int, eps: Array, sig: Array, memory: Memory | None) -> float:
    """Return the compliance dε/dΣ at the start of the step; infinite on a flat branch."""
    if memory is not None:
        return memory.now[i, SOFT]
    if law[i, CURVED] == 0.0:
        return 1.0 / law[i, SLOPE] if law[i, SLOPE] > 0.0 else math.inf
    return (1.0 - (eps[i, 0] - law[i, ORIGIN])) / (law[i, SLOPE] + sig[i, 0])


@inlined
def _strain_term(
    law: Array, i: int, eps: Array, sig: Array, n: int, memory: Memory | None
) -> tuple[float, float]:
    """Return known part and compliance of order n >= 1 of a strain, known + compliance · σ_n."""
    soft = _softness(law, i, eps, sig, memory)
    if memory is None:
        if law[i, CURVED] == 0.0:
            return 0.0, soft
        return -product(eps, sig, i, n) / (law[i, SLOPE] + sig[i, 0]), soft
    now, m, known = memory.now[i], memory.series[i], 0.0
    if law[i, CURVED] >= HELD:
        known = strain_of_mixture(now, m, law[i, CURVED] > HELD, n)
    elif law[i, CURVED] != 0.0:
        known = -product(eps, memory.series[:, :, EQ], i, n) * now[PER_A]
    return (known - soft * m[n, RELAXED] if soft < math.inf else known), soft


@inlined
def _settle_stress(law: Array, i: int, n: int, s_n: float, memory: Memory) -> None:
    """Store order n >= 1 of the stress of a spring whose strain came from `_strain_term`."""
    now, m = memory.now[i], memory.series[i]
    own = (s_n - m[n, RELAXED]) * now[PER_GAIN]
    if law[i, CURVED] >= HELD:
        finish_mixture(now, m, law[i, CURVED] > HELD, n, own)
    keep(memory.rows[i], m, n, own)


@once
def _share_elongation(
    law: Array, i0: int, i1: int, eps: Array, sig: Array, u_n: float, n: int, memory: Memory | None
) -> float:
    """Return order n >= 1 of the common stress of a group with springs without dashpot.

    Their strains are filled; a flat branch takes up the remaining elongation.
    """
    compliance, rest, flat = 0.0, u_n, -1
    for i in range(i0, i1):
        if law[i, DASHPOT] > 0.0:
            rest -= law[i, HEIGHT] * eps[i, n]
            continue
        known, soft = _strain_term(law, i, eps, sig, n, memory)
        eps[i, n] = known  # the compliant part follows
        rest -= law[i, HEIGHT] * known
        if soft < math.inf:
            compliance += law[i, HEIGHT] * soft
        elif flat < 0:
            flat = i
    s_n = rest / compliance
    if flat >= 0:
        s_n = 0.0 if memory is None else memory.series[flat, n, RELAXED]
        rest -= s_n * compliance
    for i in range(i0, i1):
        if law[i, DASHPOT] == 0.0:
            sig[i, n] = s_n
            soft = _softness(law, i, eps, sig, memory)
            if soft < math.inf:
                eps[i, n] += soft * s_n
            if memory is not None:
                _settle_stress(law, i, n, s_n, memory)
    if flat >= 0:
        eps[flat, n] = rest / law[flat, HEIGHT]
    return s_n


@inlined
def _damped_term(
    law: Array, i0: int, i1: int, sig: Array, rate_n: float, push_n: float, drag: float, n: int
) -> float:
    """Return order n of the common stress of a group in which every spring has a dashpot.

    Σ = (rate + Σ h_i σ_i/η_i) / Σ h_i/η_i. A viscous top (drag > 0) has the rate (push - Σ)/drag,
    which `rate_n` excludes.
    """
    total, weight = rate_n, 0.0
    for i in range(i0, i1):
        total += law[i, HEIGHT] * sig[i, n] / law[i, DASHPOT]
        weight += law[i, HEIGHT] / law[i, DASHPOT]
    if drag > 0.0:
        total += push_n / drag
        weight += 1.0 / drag
    return total / weight


@inlined
def _group_term(
    links: Links, s: Array, g: int, push_n: float, n: int, memory: Memory | None
) -> float:
    """Return order n of the common stress of a group from the motion of its nodes."""
    law, (i0, i1), eps, sig = links.law, springs_of(links.ends, g), s[EPS], s[SIG]
    viscous = g == links.ends.size - 1 and links.top == VISCOUS
    drag, u_n, rate_n = links.drag if viscous else 0.0, s[W, g, n], 0.0 if viscous else s[V, g, n]
    if g > 0:
        u_n -= s[W, g - 1, n]
        rate_n -= s[V, g - 1, n]
    if i1 - i0 == 1:
        eps[i0, n] = u_n * (1.0 / law[i0, HEIGHT])  # the quotient depends on no result
        sig[i0, n] = _stress_term(law, i0, eps, sig, n, memory)
        if law[i0, DASHPOT] == 0.0:
            return sig[i0, n]
        return _damped_term(law, i0, i1, sig, rate_n, push_n, drag, n)
    damped, first = 0, -1
    for i in range(i0, i1):
        if law[i, DASHPOT] > 0.0:
            damped += 1
        elif first < 0 or (law[i, CURVED] == 0.0 and law[i, SLOPE] == 0.0):
            first = i  # on a flat branch the stress is exact (0 in an open gap)
        if n == 0 or law[i, DASHPOT] > 0.0:
            sig[i, n] = _stress_term(law, i, eps, sig, n, memory)
    if damped == i1 - i0:
        return _damped_term(law, i0, i1, sig, rate_n, push_n, drag, n)
    if n == 0:
        return sig[first, 0]
    return _share_elongation(law, i0, i1, eps, sig, u_n, n, memory)


@once
def _stressed_term(
    law: Array, i0: int, i1: int, eps: Array, sig: Array, s_n: float, n: int, memory: Memory | None
) -> bool:
    """Fill order n of the strains of a group under prescribed stress; false on a flat branch."""
    for i in range(i0, i1):
        if law[i, DASHPOT] > 0.0 or n == 0:
            sig[i, n] = _stress_term(law, i, eps, sig, n, memory)
            continue
        known, soft = _strain_term(law, i, eps, sig, n, memory)
        if soft == math.inf:
            return False
        eps[i, n] = known + soft * s_n
        sig[i, n] = s_n
        if memory is not None:
            _settle_stress(law, i, n, s_n, memory)
    return True


@inner
def is_bare(links: Links, memory: Memory | None) -> bool:
    """Whether every spring is undamped and, without memory, alone between two masses."""
    if links.top != FREE or (memory is None and links.ends.size != links.law.shape[0]):
        return False
    damped = 0
    for i in range(links.law.shape[0]):
        damped += links.law[i, DASHPOT] > 0.0
    return damped == 0


@inlined
def _accelerate(links: Links, s: Array, push: Array, n: int) -> None:
    """Write the next order of the motion of all masses of a chain without dashpots."""
    w, v, group, last, share = s[W], s[V], s[GROUP], links.mass.size - 1, 1.0 / (n + 1)
    for g in range(last + 1):
        net = -group[g, n]
        if g < last:
            net += group[g + 1, n]
        else:
            net += push[n] if n < 2 else 0.0
            if links.drag > 0.0:
                net -= links.drag * v[g, n]
        v[g, n + 1] = net * (share / links.mass[g])
        w[g, n + 1] = v[g, n] * share


@inlined
def expand_bare(links: Links, s: Array, push: Array, order: int, memory: Memory | None) -> None:
    """Fill the series of a chain that `is_bare`, as `expand` does, with fewer cases."""
    law, w, eps, sig, group = links.law, s[W], s[EPS], s[SIG], s[GROUP]
    for n in range(order + 1):
        for g in range(links.mass.size):
            u_n, i0, i1 = w[g, n] - (w[g - 1, n] if g > 0 else 0.0), g, g + 1
            if memory is not None:
                i0, i1 = springs_of(links.ends, g)
            if memory is None or i1 - i0 == 1:
                eps[i0, n] = u_n * (1.0 / law[i0, HEIGHT])
                sig[i0, n] = group[g, n] = _stress_term(law, i0, eps, sig, n, memory)
            elif n > 0:
                group[g, n] = _share_elongation(law, i0, i1, eps, sig, u_n, n, memory)
            else:
                common = i0
                for i in range(i0, i1):
                    sig[i, n] = _stress_term(law, i, eps, sig, n, memory)
                    if law[i, CURVED] == 0.0 and law[i, SLOPE] == 0.0:
                        common = i  # see `_group_term`
                group[g, n] = sig[common, n]
        _accelerate(links, s, push, n)


@inner
def expand(
    links: Links, s: Array, push: Array, motion: Array, order: int, memory: Memory | None
) -> bool:
    """Fill the series up to `order`; return false if a prescribed stress meets a flat branch.

    `push` (2,) is the stress on the top and its rate, `motion` (2,) its displacement and rate.
    """
    law, ends, mass, drag, top = links
    w, v, eps, sig, group = s[W], s[V], s[EPS], s[SIG], s[GROUP]
    last = ends.size - 1
    for n in range(order + 1):
        push_n = push[n] if n < 2 else 0.0
        share = 1.0 / (n + 1)
        if top == MOTION:
            w[last, n] = motion[n] if n < 2 else 0.0
            v[last, n] = motion[1] if n == 0 else 0.0
        for g in range(last + 1):
            i0, i1 = springs_of(ends, g)
            stressed = g == last and top == STRESS
            if stressed:
                group[g, n] = push_n
                if not _stressed_term(law, i0, i1, eps, sig, push_n, n, memory):
                    return False
            else:
                group[g, n] = _group_term(links, s, g, push_n, n, memory)
            if i1 - i0 > 1 or stressed:
                for i in range(i0, i1):
                    if law[i, DASHPOT] > 0.0:
                        eps[i, n + 1] = (group[g, n] - sig[i, n]) * share / law[i, DASHPOT]
        for g in range(last + 1):
            if g < last or top == FREE:
                net = (group[g + 1, n] if g < last else push_n) - group[g, n]
                if g == last and drag > 0.0:
                    net -= drag * v[g, n]
                v[g, n + 1] = net * (share / mass[g])
                w[g, n + 1] = v[g, n] * share
            elif top == VISCOUS:
                v[g, n] = (push_n - group[g, n]) / drag
                w[g, n + 1] = v[g, n] * share
    return True


# ---------------------------------------------------------------- the end of a step


@inlined
def _settle_group(links: Links, s: Array, g: int, memory: Memory | None) -> None:
    """Redistribute the elongation of a group, so that errors do not accumulate.

    Springs without dashpot share the difference according to their compliances, a flat branch takes
    all of it, and if every spring has a dashpot the dashpots share it.
    """
    law, (i0, i1) = links.law, springs_of(links.ends, g)
    if i1 - i0 == 1 or (g == links.ends.size - 1 and links.top == STRESS):
        return
    weight, flow, flat = 0.0, 0.0, -1
    miss = s[W, g, 0] - (s[W, g - 1, 0] if g > 0 else 0.0)
    for i in range(i0, i1):
        miss -= law[i, HEIGHT] * s[EPS, i, 0]
        slope = slope_now(law, i, s[EPS, i, 0], memory)
        if law[i, DASHPOT] > 0.0:
            flow += law[i, HEIGHT] / law[i, DASHPOT]
        elif slope > 0.0:
            weight += law[i, HEIGHT] / slope
        elif flat < 0:
            flat = i
    for i in range(i0, i1):
        if flat >= 0:
            s[EPS, i, 0] += miss / law[i, HEIGHT] if i == flat else 0.0
        elif weight > 0.0 and law[i, DASHPOT] == 0.0:
            s[EPS, i, 0] += miss / weight / slope_now(law, i, s[EPS, i, 0], memory)
        elif weight == 0.0:
            s[EPS, i, 0] += miss / flow / law[i, DASHPOT]


@inner
def settle(links: Links, s: Array) -> None:
    """Redistribute the elongation of every group of a chain without memory."""
    for g in range(links.ends.size):
        _settle_group(links, s, g, None)


@inlined
def share_stresses(links: Links) -> bool:
    """Whether springs carry a common or a prescribed stress."""
    return links.ends.size < links.law.shape[0] or links.top == STRESS


@inner
def share_a_stress(law: Array, ends: Branches, i: int, j: int, memory: Memory) -> bool:
    """Whether two springs carry one stress, without dashpot or relaxation."""
    plain = law[i, DASHPOT] == 0.0 and law[j, DASHPOT] == 0.0
    plain = plain and memory.now[i, GAIN] == 1.0 and memory.now[j, GAIN] == 1.0
    for g in range(ends.size if plain else 0):
        first, last = springs_of(ends, g)
        if first <= i < last:
            return bool(first <= j < last)
    return False


@inner
def _share_under(
    law: Array, i0: int, i1: int, eps: Array, softs: Array, stress: float, memory: Memory
) -> tuple[float, float, float]:
    """Put the undamped springs of a group under a stress.

    Fill their strains, and the slopes dε/dΣ in `softs`; return elongation, sum of absolute
    elongations, and compliance.
    """
    total = size = compliance = 0.0
    for i in range(i0, i1):
        if law[i, DASHPOT] > 0.0:
            continue
        gain, k = memory.now[i, GAIN], law[i, SLOPE]
        s = (stress - memory.series[i, 0, RELAXED]) / gain
        if law[i, CURVED] >= HELD:
            moving, row = law[i, CURVED] > HELD, memory.rows[i]
            own, soft = strain_at(row, memory.state[i], memory.now[i], moving, s)
        elif law[i, CURVED] == 0.0:
            own, soft = law[i, ORIGIN] + (s - law[i, OFFSET]) / k, 1.0 / k
        else:
            own, soft = law[i, ORIGIN] + s / (k + s), k / ((k + s) * (k + s))
        eps[i, 0], softs[i, 0] = own, soft / gain
        total += law[i, HEIGHT] * own
        size += law[i, HEIGHT] * abs(own)
        compliance += law[i, HEIGHT] * softs[i, 0]
    return total, size, compliance


@once
def _common_stress(
    law: Array,
    i0: int,
    i1: int,
    eps: Array,
    softs: Array,
    stress: float,
    rest: float,
    stressed: bool,
    memory: Memory,
) -> tuple[bool, float, float]:
    """Solve for the stress at which the undamped springs of a group have the elongation `rest`.

    Return whether it was found, the elongation, and the remaining correction of the stress. The
    method is Newton's, inside the bracket found so far; a prescribed stress is used as it is.
    """
    before, low, high = math.inf, -math.inf, math.inf
    total, more = 0.0, 0.0
    for trial in range(120):
        total, size, compliance = _share_under(law, i0, i1, eps, softs, stress, memory)
        if stressed:
            return True, total, 0.0
        miss = abs(total - rest)
        more = (rest - total) / compliance
        if miss <= 4e-16 * (size + abs(rest)) or abs(more) <= 4e-15 * abs(stress):
            return True, total, more
        if 0.5 * before <= miss <= 1e-14 * size:  # limited by rounding
            return True, total, more
        if total > rest:
            high = stress
        else:  # also where the law ends (NaN)
            low = stress
        before, more = miss, more if math.isfinite(total + more) else 0.0
        stress += more
        if not low < stress < high or trial % 8 == 7:
            if math.isfinite(high - low):
                stress = 0.5 * (low + high)
            else:
                step = max(abs(more), 1e-6 * abs(low if low > -math.inf else high), 1.0)
                step *= 2.0 ** (trial + 1)
                stress = low + step if low > -math.inf else high - step
    return False, total, more


@piece
def settle_together(
    links: Links, s: Array, order: int, span: float, push: Array, memory: Memory
) -> None:
    """Bring the undamped springs of each group to one stress at their common elongation.

    Truncation errors of the strains make their stresses differ: by a large amount for a nearly
    rigid spring, or one with a very narrow snap.
    """
    law, eps, softs = links.law, s[EPS], s[SIG]  # stresses are unused until the next series
    for g in range(links.ends.size):
        i0, i1 = springs_of(links.ends, g)
        stressed = g == links.ends.size - 1 and links.top == STRESS
        if i1 - i0 == 1 and not stressed:
            continue
        rest, free = s[W, g, 0] - (s[W, g - 1, 0] if g > 0 else 0.0), 0
        for i in range(i0, i1):
            if law[i, DASHPOT] > 0.0:
                rest -= law[i, HEIGHT] * eps[i, 0]
            elif law[i, CURVED] == 0.0 and not law[i, SLOPE] > 0.0:
                free = -links.law.shape[0]  # a flat branch has no strain of its own
            else:
                free += 1
        if free <= 0:
            _settle_group(links, s, g, memory)
            continue
        stress = push[0] + push[1] * span if stressed else value_at(s[GROUP, g], order, span)
        for i in range(i0, i1):
            s[TILT, i, 0] = eps[i, 0]
        found, total, more = _common_stress(law, i0, i1, eps, softs, stress, rest, stressed, memory)
        lost = not (found and math.isfinite(total))
        for i in range(i0, i1):
            if lost:
                eps[i, 0] = s[TILT, i, 0]
            elif law[i, DASHPOT] == 0.0:
                eps[i, 0] += softs[i, 0] * more  # a correction below the resolution of the stress
        if lost:
            _settle_group(links, s, g, memory)


@inner
def advance(s: Array, groups: int, order: int, span: float) -> None:
    """Advance the state, order 0 of W, V and EPS, over a step of length `span`."""
    for row in range(W, EPS + 1):
        for i in range(s.shape[1] if row == EPS else groups):
            s[row, i, 0] = value_at(s[row, i], order, span)
