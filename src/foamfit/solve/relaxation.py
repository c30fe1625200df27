"""One spring under a known motion, with relaxation or the memory of the microscale law.

Term k adds q_k to the equilibrium stress σ, with dq_k/dt = -q_k/τ_k + g_k dσ/dt from q_k = 0.
Setting q_k = g_k (σ + y_k) avoids the derivative of σ: dy/dt = -(y + σ)/τ, or over a time h

    y(h) = exp(-x) y(0) - x ∫₀¹ exp(-x (1-r)) σ(r h) dr,        x = h/τ.

The strain is linear between samples, so σ is a smooth function of time on each branch. A step
approximates it by the cubic through its values at the four Lobatto nodes and integrates the cubic
exactly for any x. Derivatives by parameters follow from those of σ at the same nodes. Steps that
the cubic does not fit are halved; on nearly straight ones it is the cubic through values and slopes
at both ends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.springs import kernels
from foamfit.springs import microscale_kernels as micro
from foamfit.springs.kernels import (
    HELD,
    KIND,
    N_COLUMNS,
    REMEMBERS,
    A,
    Array,
    Branches,
    Row,
    compiled,
    inlined,
    inner,
    maker,
)
from foamfit.springs.law import MICROSCALE
from foamfit.springs.laws import followed
from foamfit.springs.microscale_kernels import BRANCH, CURVATURE, EPS, FLEXIBILITY, OF_STRAIN, SIGMA
from foamfit.springs.parameters import MOVED, OWN_ETA, OWN_HEIGHT, OWN_RELAXATION
from foamfit.springs.sensitivities import branch_tangents, stress_tangents_along

# The Lobatto nodes on [0, 1], and the coefficients of 1, r, r², r³ of their Lagrange polynomials.
_NODES = (0.0, 0.5 - math.sqrt(0.05), 0.5 + math.sqrt(0.05), 1.0)
NODES = np.array(_NODES)
LAGRANGE = np.linalg.inv(np.vander(NODES, increasing=True))
# The slopes of these polynomials at both ends.
SLOPES = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 2.0, 3.0]]) @ LAGRANGE
_BEND = 0.25 * math.sqrt(5.0)
MARGIN = 2.0  # safety factor of the error estimate; the cubic is more accurate than estimated
LEAST_PACE = 1e-9  # least step, as a share of the time between two samples
# The cubic through values and slopes at both ends needs one stress instead of three. It is used
# where the second derivatives confirm its accuracy, and:
PLAIN = 1e-2  # the last four-node step had an error below this share of the requested error
EVEN = 0.1  # the slope of the stress changes by less than this share over the step
CHECKED = 16  # no more than this number of steps have used it since
# Columns of the table of a term: step h; exp(-x); weights of the four nodes; their derivatives by
# x; error of the cubic for the Legendre polynomials of degree 4, 5, 6 and for r²(1 - r)²; g, times
# duration/τ if that is below 1; moments J_0 … J_4.
STEP, DECAY, WEIGHT, BY_X, OF_FOURTH, OF_FIFTH, OF_SIXTH = 0, 1, 2, 6, 10, 11, 12
OF_BUMP, LASTING, MOMENTS, TABLE = 13, 14, 15, 20


class Work(NamedTuple):
    """Working arrays of a run."""

    nodes: Array  #: stresses at the nodes of a step, (4,)
    d_nodes: Array  #: their derivatives, (4, carried)
    d_ranks: Array  #: derivatives of the ranks, (2, CARRIED)
    table: Array  #: (terms, TABLE)
    y: Array  #: state of the relaxation terms, (terms,)
    by: Array  #: its derivatives, (terms, carried)
    by_tau: Array  #: its derivatives by τ, (terms or 0,)


@maker
def _make_work(terms: int, count: int, derived: int) -> Work:
    """Return working arrays, with derivatives by τ of `derived` terms."""
    table, by = np.zeros((terms, TABLE)), np.zeros((terms, count))
    nodes, d_nodes, d_ranks = np.empty(4), np.zeros((4, count)), np.zeros((2, micro.CARRIED))
    return Work(nodes, d_nodes, d_ranks, table, np.zeros(terms), by, np.zeros(derived))


_, _begin, _leaves, _switch_law, _settle_law = followed.functions_of("microscale")[:5]


@inner
def _settle(row: Row, state: Array, eps: float) -> None:
    """Bring a spring to a strain on its branch, and compute its slope there."""
    _settle_law(row, state, eps)
    closed = state[BRANCH] == A or (state[BRANCH] == HELD and row[REMEMBERS] == 0.0)
    if row[KIND] == MICROSCALE and closed and state[SIGMA] < math.inf:
        micro.at_stress(
            row, state, state[SIGMA]
        )  # the search for the stress gives the slope of others


@inner
def _switch(row: Row, state: Array, up: bool) -> None:
    """Change to the next branch, at the end of this one or where the strain reverses."""
    _switch_law(row, state, up)
    if row[KIND] == MICROSCALE:
        sigma = state[SIGMA]
        _settle(row, state, state[EPS])  # initial slope
        state[SIGMA] = sigma


@inner
def _tangents(row: Row, state: Array, seed: Array, d_ranks: Array, out: Array) -> None:
    """Fill the derivatives of the stress; that by the strain is in the direction seed · (1, ε)."""
    branch, eps = int(state[BRANCH]), state[EPS]
    moved = seed[0] + seed[1] * eps
    if row[KIND] == MICROSCALE:
        rank = micro.rank_now(row, state)
        ever = micro.ever_now(state, rank)
        micro.tangents(row, branch, rank, ever, state[SIGMA], moved, d_ranks, out)
    else:
        branch_tangents(row, branch, eps, moved, out)


@inner
def _moments(x: float, out: Array) -> None:
    """Fill J_m = ∫₀¹ exp(-x (1-r)) r^m dr for m = 0 … 4."""
    if x > 1.0:
        out[0] = -math.expm1(-x) / x
        for m in range(1, 5):
            out[m] = (1.0 - m * out[m - 1]) / x
        return
    term = total = 0.2
    for k in range(1, 30):
        term *= -x / (5.0 + k)
        total += term
        if abs(term) < 1e-17:
            break
    out[4] = total
    for m in range(4, 0, -1):
        out[m - 1] = (1.0 - x * out[m]) / m


@inner
def _tabulate(h: float, tau: float, table: Array) -> None:
    """Fill the table of a term for steps of length h."""
    x, moments = h / tau, table[MOMENTS:]
    _moments(x, moments)
    table[STEP], table[DECAY] = h, math.exp(-x)
    for i in range(4):
        value = change = 0.0
        for m in range(4):
            value += LAGRANGE[m, i] * moments[m]
            change += LAGRANGE[m, i] * (moments[m + 1] - moments[m])
        table[WEIGHT + i], table[BY_X + i] = value, change
    # At the nodes the Legendre polynomials P4, P5, P6 equal P2, 0.72 P1 + 0.28 P3 and
    # 0.44 P0 + 0.56 P2. The error is the difference of the integrals, accumulated over the
    # 1/(1 - exp(-x)) steps for which it lasts.
    linear = 2.0 * moments[1] - moments[0]
    fourth = 70.0 * moments[4] - 140.0 * moments[3] + 84.0 * moments[2] - 14.0 * moments[1]
    table[OF_FOURTH] = abs(fourth) / moments[0]
    table[OF_FIFTH] = min(0.72 * linear / moments[0], 25.0 / x)
    table[OF_SIXTH] = min(0.44, 39.0 / x)
    table[OF_BUMP] = max(moments[2] - 2.0 * moments[3] + moments[4], 0.0) / moments[0]


@inner
def _truncation(nodes: Array, table: Array, begins: float, ends_with: float) -> float:
    """Estimate the error of the stress of all terms due to the cubic through four nodes.

    The Legendre coefficients are assumed to keep decreasing at the rate of the first ones; slopes
    at the ends, where known (not 0), bound the fourth from below.
    """
    ends, inside = 0.25 * (nodes[3] - nodes[0]), _BEND * (nodes[2] - nodes[1])
    one, three = abs(ends + inside), abs(ends - inside)
    two = abs(nodes[0] + nodes[3] - nodes[1] - nodes[2]) / 2.4
    if one + two + three == 0.0:
        return 0.0
    if one > 0.0:
        three = max(three, 0.5 * two * two / one)
    fall = 1.0
    if three < two < one:
        fall = max(three / two, two / one)
    error = 0.0
    for k in range(table.shape[0]):
        more = table[k, OF_FOURTH] + fall * (table[k, OF_FIFTH] + fall * table[k, OF_SIXTH])
        error += table[k, LASTING] * more
    fourth = three * fall
    if begins != 0.0 and ends_with != 0.0:
        for i in range(4):
            begins -= SLOPES[0, i] * nodes[i]
            ends_with -= SLOPES[1, i] * nodes[i]
        fourth = max(fourth, (abs(begins) + abs(ends_with)) / 14.0)
    return fourth * error


@inlined
def _try_slopes(
    row: Row, state: Array, nodes: Array, table: Array, end: float, bar: float, largest: float
) -> bool:
    """Try a step to a strain by the cubic through values and slopes at its ends.

    Return false, with the state unchanged, if the step is too long: the second derivatives give the
    size of the next term, r²(1 - r)². `bar` is the requested error over the `largest` stress.
    """
    origin, flexibility, curvature = state[EPS], state[FLEXIBILITY], state[CURVATURE]
    _settle(row, state, end)
    bump = math.inf
    if flexibility > 0.0 and state[FLEXIBILITY] > 0.0:
        longer, stiff, stiff_last = end - origin, 1.0 / flexibility, 1.0 / state[FLEXIBILITY]
        begins, ends_with = longer * stiff, longer * stiff_last
        if abs(ends_with - begins) <= EVEN * abs(begins):
            nodes[3] = state[SIGMA]
            rise = nodes[3] - nodes[0]
            low, high = begins - rise, ends_with - rise
            for i in range(1, 3):
                r = NODES[i]
                nodes[i] = nodes[0] + r * (rise + (1.0 - r) * ((1.0 - r) * low - r * high))
            first = 4.0 * low + 2.0 * high - begins * begins * curvature * stiff
            last = 2.0 * low + 4.0 * high + ends_with * ends_with * state[CURVATURE] * stiff_last
            bump = 0.0
            for k in range(table.shape[0]):
                bump += table[k, LASTING] * table[k, OF_BUMP]
            bump *= 0.5 * max(abs(first), abs(last))
    if MARGIN * bump <= bar * max(largest, abs(state[SIGMA])):
        return True
    state[EPS], state[SIGMA] = origin, nodes[0]
    state[FLEXIBILITY], state[CURVATURE] = flexibility, curvature
    return False


@inlined
def _try_nodes(
    row: Row, state: Array, nodes: Array, table: Array, goal: float, rough: bool
) -> tuple[float, bool]:
    """Step to a strain by four nodes; return its error (0 if `rough`) and if slopes are known."""
    origin, flexibility, begins, ends_with = state[EPS], state[FLEXIBILITY], 0.0, 0.0
    for i in range(1, 4):
        _settle(row, state, goal if i == 3 else origin + NODES[i] * (goal - origin))
        nodes[i] = state[SIGMA]
    if rough or not abs(nodes[3]) < math.inf:
        return 0.0, False
    if flexibility > 0.0 and state[FLEXIBILITY] > 0.0:
        begins = (goal - origin) / flexibility
        ends_with = (goal - origin) / state[FLEXIBILITY]
    return MARGIN * _truncation(nodes, table, begins, ends_with), begins * ends_with != 0.0


@inlined
def _derive(row: Row, state: Array, seed: Array, work: Work, first: float, short: bool) -> None:
    """Fill the derivatives of the stress at the nodes of a step from a strain to the present one.

    For a `short` step they are those of the parabola through both ends and the middle.
    """
    nodes, d_nodes, d_ranks = work.nodes, work.d_nodes, work.d_ranks
    here = state[SIGMA], state[EPS]
    for c in range(d_nodes.shape[1]):
        d_nodes[0, c] = d_nodes[3, c]
    if short:
        state[EPS] = 0.5 * (first + here[1])
        state[SIGMA] = 0.625 * (nodes[1] + nodes[2]) - 0.125 * (nodes[0] + nodes[3])
        _tangents(row, state, seed, d_ranks, d_nodes[1])
        state[SIGMA], state[EPS] = here
        _tangents(row, state, seed, d_ranks, d_nodes[3])
        for c in range(d_nodes.shape[1]):
            before, middle, last = d_nodes[0, c], d_nodes[1, c], d_nodes[3, c]
            mean, slant = 0.1 * (before + last) + 0.8 * middle, 0.4 * _BEND * (last - before)
            d_nodes[1, c], d_nodes[2, c] = mean - slant, mean + slant
        return
    for i in range(1, 4):
        state[EPS], state[SIGMA] = first + NODES[i] * (here[1] - first), nodes[i]
        _tangents(row, state, seed, d_ranks, d_nodes[i])
    state[SIGMA], state[EPS] = here


@inlined
def _relax(row: Row, h: float, work: Work) -> None:
    """Advance all terms, and their derivatives, over a step of length h."""
    nodes, d_nodes, y, by = work.nodes, work.d_nodes, work.y, work.by
    for k in range(y.size):
        table, tau = work.table[k], row[N_COLUMNS + 2 * k + 1]
        x, decay, total, change = h / tau, table[DECAY], 0.0, 0.0
        for i in range(4):
            total += table[WEIGHT + i] * nodes[i]
            change += table[BY_X + i] * nodes[i]
        if work.by_tau.size > 0:
            by_x = -decay * y[k] - total - x * change
            work.by_tau[k] = decay * work.by_tau[k] - by_x * x / tau
            for c in range(d_nodes.shape[1]):
                total_c = 0.0
                for i in range(4):
                    total_c += table[WEIGHT + i] * d_nodes[i, c]
                by[k, c] = decay * by[k, c] - x * total_c
        y[k] = decay * y[k] - x * total


@inlined
def _follow(
    row: Row, state: Array, seed: Array, work: Work, part: tuple[float, float, float, float],
    rtol: float, largest: float, plain: int,
) -> tuple[float, int]:  # fmt: skip
    """Follow a branch to a strain by steps of sufficient accuracy.

    `part` contains that strain, the time between two samples (s), and the positions between them,
    from 0 to 1, at which the branch begins and ends. Return the largest stress so far and the
    number of next steps that may use values and slopes at both ends.
    """
    (end, between, begun, until), nodes, table = part, work.nodes, work.table
    first, done, pace = state[EPS], begun, until - begun
    while done < until:
        pace = min(pace, until - done)
        last = pace == until - done
        nodes[0], origin = state[SIGMA], state[EPS]
        flexibility, curvature = state[FLEXIBILITY], state[CURVATURE]
        h = pace * between
        for k in range(table.shape[0]):
            if not abs(h - table[k, STEP]) <= 1e-13 * h:
                _tabulate(h, row[N_COLUMNS + 2 * k + 1], table[k])
        goal = end
        if not last:
            goal = first + (done + pace - begun) / (until - begun) * (end - first)
        tried = plain > 0 and last and pace == 1.0
        short = tried and _try_slopes(row, state, nodes, table, end, rtol, largest)
        plain, error, sloped = plain - tried, 0.0, False
        if not short:
            error, sloped = _try_nodes(row, state, nodes, table, goal, pace <= LEAST_PACE)
        if not abs(nodes[3]) < math.inf:
            break
        largest = max(largest, abs(nodes[3]))
        if error > rtol * largest:
            state[EPS], state[SIGMA] = origin, nodes[0]
            state[FLEXIBILITY], state[CURVATURE] = flexibility, curvature
            pace *= 0.5
            continue
        if not short:
            plain = CHECKED if sloped and error <= PLAIN * rtol * largest else 0
        if work.by_tau.size > 0:
            _derive(row, state, seed, work, origin, short)
        _relax(row, h, work)
        done = until if last else done + pace
        pace *= 2.0
    return largest, plain


@inlined
def _sum_up(row: Row, sigma: float, work: Work, by: Array, by_g: Array, by_tau: Array) -> float:
    """Fill the derivatives of the stress at a sample; return the stress with all terms."""
    total, d_sigma = sigma, work.d_nodes[3]
    for c in range(by.size):
        by[c] = d_sigma[c]
    for k in range(by_g.size):
        g = row[N_COLUMNS + 2 * k]
        by_g[k] = sigma + work.y[k]
        total += g * by_g[k]
        for c in range(by.size):
            by[c] += g * (d_sigma[c] + work.by[k, c])
    for k in range(by_tau.size):
        by_tau[k] = row[N_COLUMNS + 2 * k] * work.by_tau[k]
    return total


@compiled
def relaxed_along(
    row: Row, eps: Array, t: Array, rtol: float, derive: bool, seeds: Array
) -> tuple[Array, Branches, Array, Array, Array]:
    """Compute the stress of a spring with relaxation terms along a strain history.

    `eps` and `t` (n,) are strains and times, s, `rtol` the requested error over the largest stress.
    With `derive`, derivatives are computed too. The derivative by the strain is in the direction
    seed · (1, ε) on the way to each sample, with seeds (n, 2); (0, 1) is the logarithm of strain.

    Return the stress (n,), Pa, infinite beyond the end of a branch; branches (n,); derivatives of
    the stress (8, 11 or 0, n) by k0 … kh_minus or spread_minus, by the strain, and by stiffening,
    softening and weakening; by the g (terms, n); and by the τ of the terms (terms or 0, n).
    """
    n, terms, wanted, count = eps.size, (row.size - N_COLUMNS) // 2, int(derive), micro.carried(row)
    sigma, branches, by = np.empty(n), np.empty(n, np.int64), np.empty((wanted * count, n))
    by_g, by_tau = np.empty((terms, n)), np.empty((wanted * terms, n))
    state, work = np.empty(micro.STATE), _make_work(terms, count, wanted * terms)
    _begin(row, state)
    largest, entered, plain = 0.0, True, 0
    for k in range(terms):
        lasts = (t[n - 1] - t[0]) / row[N_COLUMNS + 2 * k + 1]
        work.table[k, LASTING] = row[N_COLUMNS + 2 * k] * min(1.0, lasts)
    for j in range(n):
        before, done, leaving = state[EPS], 0.0, True
        while leaving:
            up, leaving = eps[j] > state[EPS], _leaves(row, state, eps[j])
            turning = leaving and row[KIND] == MICROSCALE and micro.turned(state, up)
            if not turning:
                end, until = eps[j], 1.0
                if leaving:
                    end = state[micro.HIGH] if up else state[micro.LOW]
                    until = min(max((end - before) / (eps[j] - before), done), 1.0)
                if j == 0:  # the first sample is reached instantaneously
                    _settle(row, state, end)
                    done, entered = until, True
                if derive and entered:
                    _tangents(row, state, seeds[j], work.d_ranks, work.d_nodes[3])
                entered = False
                if done < until:
                    part = (end, t[j] - t[j - 1], done, until)
                    largest, plain = _follow(row, state, seeds[j], work, part, rtol, largest, plain)
                    done = until
                if not abs(state[SIGMA]) < math.inf:
                    sigma[j:], branches[j:] = math.inf, int(state[BRANCH])
                    return sigma, branches, by, by_g, by_tau
                if not leaving and state[EPS] != end:  # the rest of the way takes no time
                    _settle(row, state, end)
                    if derive:
                        _tangents(row, state, seeds[j], work.d_ranks, work.d_nodes[3])
            if leaving:
                _switch(row, state, up)
                entered, plain = True, 0
        if j == 0:
            work.y[:] = -state[SIGMA]
            for p in range(count):
                work.by[:, p] = -work.d_nodes[3, p]
        sigma[j] = _sum_up(row, state[SIGMA], work, by[:, j], by_g[:, j], by_tau[:, j])
        branches[j] = int(state[BRANCH])
    return sigma, branches, by, by_g, by_tau


def _seeds(eps: Array, *, moved: bool) -> Array:
    """Return seeds of the derivative by the log strain or, if `moved`, by strains in contact."""
    seeds = np.zeros((eps.size, 2))
    if not moved:
        seeds[:, 1] = 1.0
        return seeds
    contact = (eps > 0.0).astype(float)
    seeds[:, 0] = contact
    for j in np.flatnonzero(np.diff(contact)) + 1:  # contact begins or ends before this sample
        seeds[j] = 0.0, 1.0 / (eps[j] - eps[j - 1]) * (contact[j] - contact[j - 1])
    return seeds


def stress_along(
    row: Row, eps: Array, t: Array, height: float, rtol: float, directions: Branches
) -> tuple[Array, Branches, Array]:
    """Compute the stress of one spring, without its dashpot, along a strain history.

    `eps` and `t` (n,) are strains and times, s, `height` is in m, `rtol` the requested error over
    the largest stress; for directions (p, 2) see `springs.parameters`. Return the stress (n,), Pa,
    branches (n,), and derivatives of the stress at fixed elongation (p, n).
    """
    own = directions[:, 1]
    by = by_g = by_tau = out = np.zeros((len(own), eps.size))
    if row.size > N_COLUMNS and (row[N_COLUMNS::2].any() or (own >= OWN_RELAXATION).any()):
        seeds = _seeds(eps, moved=bool((own == MOVED).any()))
        stress, branches, by, by_g, by_tau = relaxed_along(row, eps, t, rtol, len(own) > 0, seeds)
    elif row[KIND] == MICROSCALE:
        stress, ranks, branches = micro.stress_along(row, eps)
        if len(own):
            first, share = _seeds(eps, moved=bool((own == MOVED).any())).T
            moved = first + share * eps
            by = micro.stress_tangents_along(row, moved, stress, ranks, branches)[0]
    else:
        stress, branches = kernels.stress_along(row, eps)
        by = stress_tangents_along(row, eps, branches)
    for p, what in enumerate(own):
        if what == MOVED:
            out[p] = by[OF_STRAIN] / height
        elif what < OWN_ETA:
            out[p] = by[what]
        elif what == OWN_HEIGHT:
            out[p] = by[OF_STRAIN] / -height
        elif what >= OWN_RELAXATION:
            term, of_tau = divmod(what - OWN_RELAXATION, 2)
            out[p] = by_tau[term] if of_tau else by_g[term]
    return stress, branches, out
