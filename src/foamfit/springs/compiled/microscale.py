"""The compiled functions of the microscale spring; its internal variable is the stress.

`laws.microscale` has the law, with p the snapped fraction of micro-springs and P its largest value
so far. The held numbers are two ranks w and W as standard normal scores, p = Φ(w) and P = Φ(W), so
that Φ is never inverted and 1 - p = Φ(-w) keeps all its digits. On first loading (SNAP) w = W = u₊
= (ln σ - ln sigma_plus)/spread_plus. Micro-springs that have snapped before snap through again
(AGAIN) at w = u₊ + s/spread_plus up to W; then p is held until u₊ = W, where first loading
continues. They snap back (BACK) at w = u₋. On BOTH they do both at one stress. Without softening,
weakening and stiffening W has no effect and is not stored: P = 0. As stress and strain grow
together, a branch ends at a strain as well as at a stress.
"""

from __future__ import annotations

import math

from numba import njit

from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import BY, SLOPE, inlined, inner, past, start
from foamfit.springs.laws.microscale import most_beyond

# Branches: A before the first snap, FIXED for a constant snapped fraction, on the others p changes.
A, SNAP, FIXED, BACK, BOTH, AGAIN = range(6)
# The row: k0, kc, eps_star; mean and standard deviation of ln σ at snap-through and snap-back; n;
# k0 and mean of ln σ of micro-springs that have snapped before; 2 if n is a parameter, else 1 if
# there is softening or weakening; ln of the stress where both laws of snapping meet.
ROW = (
    "k0", "kc", "star", "log_plus", "plus", "log_minus", "minus", "n", "worn", "log_again",
    "remembers", "cross",
)  # fmt: skip
as_row = contract.naming("Microscale row", ROW)
# Parameters by their place among the derivatives.
STIFFENING, SOFTENING, WEAKENING, PARAMETERS = range(7, 11)
# Memory: ranks w and W; p, 1 - p, 1 - P; dε/dσ and d²ε/dσ² where the stress was last computed.
_MEMORY = ("rank", "ever", "snapped", "rest", "never", "flexibility", "curvature")
_PLACES = {name: contract.HELD + k for k, name in enumerate(_MEMORY)}
as_microscale = contract.pointing(
    contract.Named("Microscale spring", contract.REAL, contract.SPRING.places | _PLACES)
)
CHANGE = contract.OF_PARAMETER + PARAMETERS
LEAST_STRAIN = 1e-14  # below which no micro-spring snaps: ln σ is singular at zero
NEAR = 3e-6  # relative last step of Halley's method per width of the snap; the error is its cube
ROUNDED = 1e-8  # largest correction of a share that rounding errors can explain
LEAST_RANK = -8.3  # below which no micro-spring counts as snapped: a fraction of 5e-17
LEAST = 2.0**-1022  # least stress of a search: the least normal number
_HALF, _TURN = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)
_most_beyond = inner(most_beyond)


@njit(**contract.OPTIONS, cache=True)
def fill(values, array):
    """Write the row; stiffening, softening and weakening, if present, follow spread_minus."""
    row = as_row(start(array))
    count, softening, weakening = values.size, 0.0, 0.0
    n = values[7] if count == 8 or count == 10 else 1.0
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
    # Where one rank snaps through and snaps back; the spring is hysteretic (snap-back below
    # snap-through) below this stress if minus >= plus, else above it.
    gap, widens = row.log_again - row.log_minus, row.minus - row.plus
    row.cross = math.inf if gap > 0.0 else -math.inf  # the two laws never meet
    if widens != 0.0:
        row.cross = row.log_again + row.plus * (gap / widens)
    least, _ = _most_beyond(row.worn, row.kc, n)
    return row.worn > 0.0 and row.star >= least


# ---------------------------------------------------------------- stress and strain on a branch


@inlined
def shares(rank):
    """Return Φ and 1 - Φ, the shares below and above a rank; the smaller one has all digits."""
    least = 0.5 * math.erfc(_HALF * abs(rank))
    return (1.0 - least, least) if rank > 0.0 else (least, 1.0 - least)


@inlined
def density(rank):
    """Return Φ', the density of ranks."""
    return _TURN * math.exp(-0.5 * rank * rank)


@inlined
def on_a(n, k, sigma):
    """Return a(σ; k), -inf past its pole, and derivatives by σ, σ twice, and n (0 if n = 1)."""
    above = k + n * sigma
    if not above > 0.0:
        return -math.inf, 0.0, 0.0, 0.0
    per = 1.0 / above
    if n == 1.0:
        slope, by_n = k * per * per, 0.0
        return sigma * per, slope, -2.0 * slope * per, by_n
    log = math.log1p(n * sigma / k) / n
    left = math.exp(-log)
    slope = left * per
    return -math.expm1(-log), slope, -(1.0 + n) * slope * per, left * (sigma * per - log) / n


@inlined
def by_stiffening(k, sigma):
    """Return the derivative of a(σ; k) by n at n = 1."""
    per = 1.0 / (k + sigma)
    return k * per * (sigma * per - math.log1p(sigma / k))


@inner
def stress_on_a(n, k, eps):
    """Return the stress at a strain of branch a; infinite from its end on."""
    if not eps < 1.0:
        return math.inf
    return k * eps / (1.0 - eps) if n == 1.0 else k * math.expm1(-n * math.log1p(-eps)) / n


@inner
def line(row, branch):
    """Return mean and standard deviation of the normal distribution of ln σ on a branch."""
    if branch == BACK:
        return row.log_minus, row.minus
    return row.log_plus if branch == SNAP else row.log_again, row.plus


@inner
def mixture(row, branch, p, rest, never, sigma):
    """Return strain and two derivatives at fixed p, P; strain and slope of the a that snaps."""
    n, k = row.n, row.worn
    two = 1.0 / (row.kc + sigma)
    on_c = row.kc * two * two
    if branch == SNAP or never == 1.0:  # nothing on branch a has ever snapped
        k, never = row.k0, 0.0
    one, slope, bend, _ = on_a(n, k, sigma)
    strain = rest * one + p * (row.star + sigma * two)
    soft, bent = rest * slope + p * on_c, rest * bend - 2.0 * p * on_c * two
    if never > 0.0 and k != row.k0:
        fresh, stiff, stiffer, _ = on_a(n, row.k0, sigma)
        strain += never * (fresh - one)
        soft += never * (stiff - slope)
        bent += never * (stiffer - bend)
    return strain, soft, bent, one, slope


@inner
def at_stress(row, s, sigma):
    """Return the strain at a stress on the branch, dε/dσ and d²ε/dσ²."""
    branch = int(s.branch)
    held = branch == A or branch == FIXED
    if held or not sigma > 0.0:  # where none has snapped, branches are continued
        p, rest = (s.snapped, s.rest) if held else (0.0, 1.0)
        strain, slope, bend, _, _ = mixture(row, branch, p, rest, s.never, sigma)
        return strain, slope, bend
    place, scale = line(row, branch)
    rank = (math.log(sigma) - place) / scale
    p, rest = shares(rank)
    strain, slope, bend, one, on_one = mixture(row, branch, p, rest, s.never, sigma)
    two = 1.0 / (row.kc + sigma)
    gap, rate = row.star + sigma * two - one, density(rank) / (scale * sigma)
    bend += 2.0 * rate * (row.kc * two * two - on_one)
    bend -= rate * gap * (rank / scale + 1.0) / sigma
    return strain, slope + rate * gap, bend


@inner
def _ends_of_stress(row, s, eps):
    """Return bounds of the stress at a strain, from the stiffest and the softest branch."""
    n, stiff = row.n, stress_on_a(row.n, row.k0, eps)
    if eps < 0.0 or ((s.branch == A or s.branch == FIXED) and s.snapped == 0.0):
        soft = stress_on_a(n, row.worn, eps)
        low, high = min(stiff, soft), max(stiff, soft)
    else:
        low, high = 0.0, stiff
        if eps > row.star:
            low = row.kc * (eps - row.star) / (1.0 - (eps - row.star))
    return low - 1e-14 * abs(low), high + 1e-14 * abs(high)


@inner
def _halfway(low, high, sigma):
    """Return a stress between two bounds, halfway in the logarithm if possible."""
    if high == math.inf:
        return 2.0 * max(sigma, LEAST)
    if low > 0.0:
        return math.sqrt(low) * math.sqrt(high)
    if low == 0.0:
        return 1e-3 * high if high > 1e6 * LEAST else 0.5 * high
    return 0.5 * (low + high)


@inner
def stress_in(row, s, eps):
    """Return the stress at a strain on the branch (inf past its end), and dε/dσ, 0 if unknown."""
    branch = int(s.branch)
    moving = branch != A and branch != FIXED
    reach = 1.0 + (row.star if moving or s.snapped > 0.0 else 0.0)
    if not eps < reach:
        return math.inf, 0.0
    if branch == A and (s.never == 1.0 or eps == 0.0):
        return stress_on_a(row.n, row.k0, eps), 0.0
    sigma, slope, low, high = s.x, s.flexibility, -math.inf, math.inf
    bounded = not slope > 0.0
    if bounded:
        low, high = _ends_of_stress(row, s, eps)
        if not low < sigma < high:
            sigma = _halfway(low, high, max(low, row.k0))
    else:
        step = (eps - s.eps) / slope
        sigma += step * (1.0 - 0.5 * step * s.curvature / slope)
    narrow = min(row.plus, row.minus, 1.0) if moving else 1.0
    # Halley's method inside a bracket, from a parabola at the previous point.
    for _ in range(300):
        reached, slope, bend = at_stress(row, s, sigma)
        miss = reached - eps
        step = miss / slope
        part = 1.0 - 0.5 * step * bend / slope
        if 0.5 < part < 2.0:
            step /= part
        new = sigma - step
        if abs(step) <= NEAR * abs(sigma) * narrow and low <= new <= high:
            s.flexibility, s.curvature = slope + bend * (new - sigma), bend
            return new, s.flexibility
        if not bounded:  # the initial guess did not suffice
            low, high = _ends_of_stress(row, s, eps)
            bounded = True
            if not low < sigma < high:
                sigma = _halfway(low, high, max(low, row.k0))
                continue
        if miss > 0.0:
            high = sigma
        else:
            low = sigma
        if not low < new < high:
            new = _halfway(low, high, sigma)
            if not low < new < high:  # neighbouring floating-point numbers
                return sigma, 0.0
        sigma = new
    return sigma, 0.0


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
    if (s.high if high else s.low) < LEAST_STRAIN:
        sigma, _ = stress_in(row, s, LEAST_STRAIN)
        _put_end(s, high, LEAST_STRAIN, sigma)
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
    through = row.log_again + row.plus * LEAST_RANK
    return math.exp(min(through, row.log_minus + row.minus * LEAST_RANK))


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
        _end(row, s, True, math.exp(first + row.plus * LEAST_RANK))
        if s.high < LEAST_STRAIN:
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
    eps, _, _, on_main, _ = mixture(row, FIXED, p, rest, s.never, sigma)
    more = (s.eps - eps) / (row.star + sigma / (row.kc + sigma) - on_main)
    if abs(more) < min(ROUNDED, p, rest):
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
    place, scale = line(row, int(branch))
    rank = (math.log(s.x) - place) / scale
    for h in range(2 if branch == SNAP and remembers else 1):
        by = past(out, h * CHANGE)
        by[contract.OF_HELD + h], by[contract.OF_STRESS] = 0.0, 1.0 / (scale * s.x)
        by[contract.OF_PARAMETER + first] = -math.exp(-row[first]) / scale
        by[contract.OF_PARAMETER + first + 1] = -rank / scale
        if branch == AGAIN:
            by[contract.OF_PARAMETER + WEAKENING] = 1.0 / scale
    if branch == SNAP and remembers:
        s.ever = rank
        _, s.never = shares(rank)
    _hold(row, s, rank)
    if not up and row.log_again == row.log_plus and not _has_loop(row, s.x, False):
        _enter(row, s, BOTH)


@contract.switching
def switch(row, s, up, out):
    row, s = as_row(row), as_microscale(s)
    branch, remembers = s.branch, row.remembers > 0.0
    for c in range(2 * CHANGE):
        out[c] = 0.0
    out[contract.OF_HELD], out[CHANGE + contract.OF_HELD + 1] = 1.0, 1.0
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
    elif sigma <= _last_stress(row) or s.eps <= LEAST_STRAIN:
        out[contract.OF_HELD] = 0.0
        _enter(row, s, A)
    else:
        _enter(row, s, BOTH if branch == BACK else BACK)
    return 0.0


@contract.beginning
def begin(row, s):
    row, s = as_row(row), as_microscale(s)
    s.eps = s.x = s.snapped = 0.0
    s.rank, s.ever, s.rest, s.never = -math.inf, -math.inf, 1.0, 1.0
    _enter(row, s, A)
    return 0.0


@contract.settling
def settle(row, s, eps):
    row, s = as_row(row), as_microscale(s)
    sigma, soft = stress_in(row, s, eps)
    s.eps = eps
    s.x = s.sigma = sigma
    s.slope, s.miss = 1.0 / soft, 0.0
    return 1.0 if soft > 0.0 else 0.0


@contract.inverting
def strain(row, s, sigma):
    row, s = as_row(row), as_microscale(s)
    eps, s.soft, s.curvature = at_stress(row, s, sigma)
    s.flexibility = s.soft
    return eps


@contract.evaluating
def evaluate(row, s, eps, x, count, want, out):
    row, s = as_row(row), as_microscale(s)
    branch = s.branch
    k0, kc, star, n, remembers = row.k0, row.kc, row.star, row.n, row.remembers > 0.0
    p, rest, never, rank, pace, weight = s.snapped, s.rest, s.never, 0.0, 0.0, 0.0
    moving, first = branch != A and branch != FIXED, 5 if branch == BACK else 3
    place = row.log_again if branch >= BOTH else row[first]
    wide = 1.0 / row[first + 1]
    by_median = math.exp(-row[first]) if want and moving else 0.0
    # shares on branch a of what never and what once snapped
    mixed = remembers and branch != SNAP and never < 1.0
    softened = mixed and row.worn != k0
    on_ever = density(s.ever) if want and mixed else 0.0
    if want and not moving and p > 0.0:
        weight = density(s.rank)
    for j in range(count):
        sigma = x[j]
        if moving and sigma > 0.0:
            rank = (math.log(sigma) - place) * wide
            p, rest = shares(rank)
            weight, pace = density(rank), wide / sigma
        elif moving:  # continued
            rank = p = weight = pace = 0.0
            rest = 1.0
        two = 1.0 / (kc + sigma)
        fresh, worn = rest, 0.0
        if mixed:
            fresh = min(never, rest)
            worn = rest - fresh
        main, soft, _, by_n = on_a(n, k0, sigma)
        one, soft_one, by_n_one = main, soft, by_n
        if softened:
            one, soft_one, _, by_n_one = on_a(n, row.worn, sigma)
        softness = fresh * soft + worn * soft_one
        on_c = star + sigma * two
        by_rank = weight * (on_c - one)
        slope = 1.0 / (softness + p * kc * two * two + by_rank * pace)
        out[contract.OF_LAW * count + j], out[SLOPE * count + j] = sigma, slope
        out[contract.MISS * count + j] = fresh * main + worn * one + p * on_c - eps[j]
        if want == 0:
            continue
        by, held = past(out, BY * count + j), past(out, contract.BY_HELD * count + j)
        by[0] = slope * sigma * softness / k0
        by[count], by[2 * count] = slope * p * sigma * two * two, -slope * p
        for c in range(3, PARAMETERS):
            by[c * count] = 0.0
        held[0], held[count] = 0.0 if moving else -slope * by_rank, 0.0
        if moving:
            through = slope * by_rank * wide
            by[first * count], by[(first + 1) * count] = through * by_median, through * rank
            if branch >= BOTH:
                by[WEAKENING * count] = -through
        if remembers:
            if n == 1.0 and row.remembers > 1.0:
                by_n, by_n_one = by_stiffening(k0, sigma), by_stiffening(row.worn, sigma)
            by[STIFFENING * count] = -slope * (fresh * by_n + worn * by_n_one)
            by[SOFTENING * count] = -slope * worn * sigma * soft_one
            held[count] = -slope * on_ever * (one - main)
    return 0.0


_FUNCTIONS = (begin, evaluate, switch, settle, strain)
_K0, _KC, _STAR = (ROW.index(name) for name in ("k0", "kc", "star"))
COMPILED = contract.Compiled(
    fill, contract.BY_STRESS, len(ROW), PARAMETERS, 1, _FUNCTIONS, (_K0, _KC), _STAR
)
