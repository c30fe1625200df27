"""The compiled functions of the microscale spring; its internal variable is the stress.

With p the snapped fraction of micro-springs and P its largest value so far (docs/theory.md),

    ε = (1-P) a(σ; k0) + (P-p) a(σ; k0 e^-d) + p (eps_star + σ/(kc+σ)),
    a(σ; k) = 1 - (1 + nσ/k)^(-1/n).

The held numbers are two ranks w and W as standard normal scores, p = Φ(w) and P = Φ(W), so that Φ
is never inverted and 1 - p = Φ(-w) keeps all its digits. On first loading (SNAP) w = W = u₊ =
(ln σ - ln sigma_plus)/spread_plus. Micro-springs that have snapped before snap through again
(AGAIN) at w = u₊ + s/spread_plus up to W; then p is held until u₊ = W, where first loading
continues. They snap back (BACK) at w = u₋. On BOTH they do both at one stress. Without softening,
weakening and stiffening W has no effect and is not stored: P = 0.

Stress and strain grow together along any history, so a branch ends at a strain as well as at a
stress, and a history is followed from one end of a branch to the next.
"""

from __future__ import annotations

import math

from numba import njit

from foamfit.springs.compiled import contract, mixture as mix
from foamfit.springs.compiled.contract import BY, BY_HELD, MISS, OF_LAW, SLOPE, inner, past, start
from foamfit.springs.compiled.mixture import AGAIN, BACK, BOTH, FIXED, SNAP, A, at_stress, shares
from foamfit.springs.laws.microscale import most_beyond

_most_beyond = inner(most_beyond)


@njit(**contract.OPTIONS, cache=True)
def fill(values, array):
    """Write the row; stiffening, softening and weakening, if present, follow spread_minus."""
    row = mix.as_row(start(array))
    count, n, softening, weakening = values.size, 1.0, 0.0, 0.0
    if count == 8 or count == 10:
        n = values[7]
    if count > 8:
        softening, weakening = values[count - 2], values[count - 1]
    for c in range(7):
        if c != 2 and not 0.0 < values[c] < math.inf:
            return False
    fine = 0.0 <= values[2] < math.inf and 0.0 < n < math.inf
    if not (fine and 0.0 <= softening < math.inf and 0.0 <= weakening < math.inf):
        return False
    row.k0, row.kc, row.star = values[0], values[1], values[2]
    row.log_plus, row.plus = math.log(values[3]), values[4]
    row.log_minus, row.minus, row.n = math.log(values[5]), values[6], n
    row.worn, row.log_again = row.k0 * math.exp(-softening), row.log_plus - weakening
    row.remembers = 0.0 if count == 7 else 1.0 if count == 9 else 2.0
    row.cross = mix.crossing(row.log_again, row.plus, row.log_minus, row.minus)
    least, _ = _most_beyond(row.worn, row.kc, n)
    return row.worn > 0.0 and row.star >= least


# ---------------------------------------------------------------- from branch to branch


@inner
def _put_end(s, high, eps, sigma):
    """Set the upper (`high`) or lower end of the branch."""
    if high:
        s.high, s.sigma_high = eps, sigma
    else:
        s.low, s.sigma_low = eps, sigma


@inner
def _end(row, s, high, sigma):
    """Set the upper (`high`) or lower end of the branch to a stress, not behind the spring."""
    eps, _, _ = at_stress(row, s, sigma)
    behind = eps < s.eps if high else eps > s.eps
    _put_end(s, high, s.eps if behind else eps, s.x if behind else sigma)


@inner
def _no_less(row, s, high):
    """Raise an end of the branch to the least strain at which a micro-spring may snap."""
    if (s.high if high else s.low) < mix.LEAST_STRAIN:
        sigma, _ = mix.stress_in(row, s, mix.LEAST_STRAIN)
        _put_end(s, high, mix.LEAST_STRAIN, sigma)
        s.flexibility = 0.0  # it is not that of the present stress


@inner
def _has_loop(row, sigma, up):
    """Whether snap-back lies below snap-through just above (`up`) or just below a stress."""
    log = math.log(sigma)
    if row.minus >= row.plus:
        return log < row.cross if up else log <= row.cross
    return log >= row.cross if up else log > row.cross


@inner
def _last_stress(row):
    """Return the stress at which the last micro-spring has snapped back."""
    through = row.log_again + row.plus * mix.LEAST_RANK
    return math.exp(min(through, row.log_minus + row.minus * mix.LEAST_RANK))


@inner
def _enter(row, s, branch):
    """Enter a branch at the present strain and stress."""
    s.branch, s.flexibility = branch, 0.0
    s.turns = 1.0 if branch == SNAP or branch == AGAIN else -1.0 if branch == BACK else 0.0
    s.low, s.sigma_low, s.high, s.sigma_high = -math.inf, -math.inf, math.inf, math.inf
    below, cross, remembers = row.minus >= row.plus, math.exp(row.cross), row.remembers > 0.0
    if branch == A:
        s.rank, s.snapped, s.rest = -math.inf, 0.0, 1.0
        first = row.log_plus if s.never == 1.0 else row.log_again
        _end(row, s, True, math.exp(first + row.plus * mix.LEAST_RANK))
        if s.high < mix.LEAST_STRAIN:
            s.branch = SNAP if s.never == 1.0 else AGAIN
            _no_less(row, s, True)
            s.branch = A
        return
    if branch != BACK and (branch != SNAP or not remembers):
        high = math.exp(row.log_again + row.plus * s.ever) if remembers else math.inf
        if (branch != BOTH) == below:  # the other branch begins where both laws of snapping meet
            high = min(high, cross)
        if high < math.inf:
            _end(row, s, True, high)
    if branch == BOTH or branch == BACK:
        last = _last_stress(row)
        _end(row, s, False, max(last, cross) if (branch == BOTH) == below else last)
        _no_less(row, s, False)


@inner
def _hold(row, s, rank):
    """Hold the present rank."""
    p, rest = shares(rank)
    sigma = s.x
    # In a narrow snap the last digit of the stress covers many ranks, so the strain decides.
    eps, _, _, on_main, _ = mix.mixture(row, FIXED, p, rest, s.never, sigma)
    more = (s.eps - eps) / (row.star + sigma / (row.kc + sigma) - on_main)
    if abs(more) < min(mix.ROUNDED, p, rest):
        p, rest = p + more, rest - more
    s.branch, s.turns, s.rank, s.snapped, s.rest = FIXED, 0.0, rank, p, rest
    s.flexibility = 0.0
    first = row.log_plus if rank >= s.ever else row.log_again
    back, again = row.log_minus + row.minus * rank, row.log_again + row.plus * rank
    _end(row, s, True, max(math.exp(first + row.plus * rank), sigma))
    _end(row, s, False, min(math.exp(min(back, again)), sigma))


@inner
def _turn(row, s, up, out):
    """Hold the rank that a spring has reached where its strain turns."""
    branch, remembers = s.branch, row.remembers > 0.0
    first = 5 if branch == BACK else 3
    place, scale = mix.line(row, int(branch))
    rank = (math.log(s.x) - place) / scale
    for h in range(2 if branch == SNAP and remembers else 1):
        by = past(out, h * mix.CHANGE)
        by[contract.OF_HELD + h], by[contract.OF_STRESS] = 0.0, 1.0 / (scale * s.x)
        by[contract.OF_PARAMETER + first] = -math.exp(-row[first]) / scale
        by[contract.OF_PARAMETER + first + 1] = -rank / scale
        if branch == AGAIN:
            by[contract.OF_PARAMETER + mix.WEAKENING] = 1.0 / scale
    if branch == SNAP and remembers:
        s.ever = rank
        _, s.never = shares(rank)
    _hold(row, s, rank)
    if not up and row.log_again == row.log_plus and not _has_loop(row, s.x, False):
        _enter(row, s, BOTH)


@contract.switching
def switch(row, s, up, out):
    row, s = mix.as_row(row), mix.as_microscale(s)
    branch, remembers = s.branch, row.remembers > 0.0
    for c in range(2 * mix.CHANGE):
        out[c] = 0.0
    out[contract.OF_HELD], out[mix.CHANGE + contract.OF_HELD + 1] = 1.0, 1.0
    if (branch == BACK) if up else (branch == SNAP or branch == AGAIN):
        _turn(row, s, up, out)
        return 0.0
    s.eps, s.x = (s.high, s.sigma_high) if up else (s.low, s.sigma_low)
    sigma = s.x
    if branch == A or (branch == FIXED and up):
        if remembers and (s.rank >= s.ever or s.never == 1.0):
            _enter(row, s, SNAP)
        elif _has_loop(row, sigma, True):
            _enter(row, s, AGAIN if remembers else SNAP)
        else:
            _enter(row, s, BOTH)
    elif branch == FIXED:
        _enter(row, s, BACK if _has_loop(row, sigma, False) else BOTH)
    elif up:
        log = row.log_again + row.plus * s.ever
        if not remembers:
            _enter(row, s, SNAP if branch == BOTH else BOTH)
        elif math.log(sigma) < log - 1e-14 * max(abs(log), 1.0):
            _enter(row, s, AGAIN if branch == BOTH else BOTH)
        else:  # all micro-springs that ever snapped have snapped again
            s.rank = s.ever
            if row.log_again == row.log_plus:
                _enter(row, s, SNAP)
            else:
                out[contract.OF_HELD], out[contract.OF_HELD + 1] = 0.0, 1.0
                _hold(row, s, s.ever)
    elif sigma <= _last_stress(row) or s.eps <= mix.LEAST_STRAIN:
        out[contract.OF_HELD] = 0.0
        _enter(row, s, A)
    else:
        _enter(row, s, BOTH if branch == BACK else BACK)
    return 0.0


@contract.beginning
def begin(row, s):
    row, s = mix.as_row(row), mix.as_microscale(s)
    s.eps = s.x = s.snapped = 0.0
    s.rank, s.ever, s.rest, s.never = -math.inf, -math.inf, 1.0, 1.0
    _enter(row, s, A)
    return 0.0


@contract.settling
def settle(row, s, eps):
    row, s = mix.as_row(row), mix.as_microscale(s)
    sigma, soft = mix.stress_in(row, s, eps)
    s.eps = eps
    s.x = s.sigma = sigma
    s.slope, s.miss = 1.0 / soft, 0.0
    return 1.0 if soft > 0.0 else 0.0


@contract.inverting
def strain(row, s, sigma):
    row, s = mix.as_row(row), mix.as_microscale(s)
    eps, s.soft, s.curvature = at_stress(row, s, sigma)
    s.flexibility = s.soft
    return eps


@contract.evaluating
def evaluate(row, s, eps, x, count, want, out):
    row, s = mix.as_row(row), mix.as_microscale(s)
    branch = s.branch
    k0, kc, star, n, remembers = row.k0, row.kc, row.star, row.n, row.remembers > 0.0
    p, rest, never, rank, pace, weight = s.snapped, s.rest, s.never, 0.0, 0.0, 0.0
    moving, first = mix.moves(branch), 5 if branch == BACK else 3
    place = row.log_again if branch >= BOTH else row[first]
    wide, on_ever = 1.0 / row[first + 1], 0.0
    by_median = math.exp(-row[first]) if want and moving else 0.0
    # shares on branch a of what never and what once snapped
    mixed = remembers and branch != SNAP and never < 1.0
    softened = mixed and row.worn != k0
    if want and mixed:
        on_ever = mix.density(s.ever)
    if want and not moving and p > 0.0:
        weight = mix.density(s.rank)
    for j in range(count):
        sigma = x[j]
        if moving and sigma > 0.0:
            rank = (math.log(sigma) - place) * wide
            p, rest = shares(rank)
            weight, pace = mix.density(rank), wide / sigma
        elif moving:  # continued
            rank = p = weight = pace = 0.0
            rest = 1.0
        two = 1.0 / (kc + sigma)
        fresh, worn = rest, 0.0
        if mixed:
            fresh = min(never, rest)
            worn = rest - fresh
        main, soft, _, by_n = mix.on_a(n, k0, sigma)
        one, soft_one, by_n_one = main, soft, by_n
        if softened:
            one, soft_one, _, by_n_one = mix.on_a(n, row.worn, sigma)
        softness = fresh * soft + worn * soft_one
        on_c = star + sigma * two
        by_rank = weight * (on_c - one)
        slope = 1.0 / (softness + p * kc * two * two + by_rank * pace)
        out[OF_LAW * count + j], out[SLOPE * count + j] = sigma, slope
        out[MISS * count + j] = fresh * main + worn * one + p * on_c - eps[j]
        if want == 0:
            continue
        by, held = past(out, BY * count + j), past(out, BY_HELD * count + j)
        by[0] = slope * sigma * softness / k0
        by[count], by[2 * count] = slope * p * sigma * two * two, -slope * p
        for c in range(3, mix.PARAMETERS):
            by[c * count] = 0.0
        held[0], held[count] = 0.0, 0.0
        if moving:
            through = slope * by_rank * wide
            by[first * count], by[(first + 1) * count] = through * by_median, through * rank
            if branch >= BOTH:
                by[mix.WEAKENING * count] = -through
        else:
            held[0] = -slope * by_rank
        if remembers:
            if n == 1.0 and row.remembers > 1.0:
                by_n, by_n_one = mix.by_stiffening(k0, sigma), mix.by_stiffening(row.worn, sigma)
            by[mix.STIFFENING * count] = -slope * (fresh * by_n + worn * by_n_one)
            by[mix.SOFTENING * count] = -slope * worn * sigma * soft_one
            held[count] = -slope * on_ever * (one - main)
    return 0.0


_FUNCTIONS = (begin, evaluate, switch, settle, strain)
_K0, _KC, _STAR = (mix.ROW.index(name) for name in ("k0", "kc", "star"))
COMPILED = contract.Compiled(
    fill, contract.BY_STRESS, len(mix.ROW), mix.PARAMETERS, 1, _FUNCTIONS, (_K0, _KC), _STAR
)
