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

from foamfit.springs.compiled.contract import (
    BRANCH,
    BY,
    BY_HELD,
    BY_STRESS,
    EPS,
    HELD,
    HIGH,
    LOW,
    MISS,
    OF_HELD,
    OF_LAW,
    OF_PARAMETER,
    OF_STRESS,
    OPTIONS,
    OWN,
    SIGMA_HIGH,
    SIGMA_LOW,
    SLOPE,
    SOFT,
    TURNS,
    Compiled,
    X,
    beginning,
    evaluating,
    inlined,
    inner,
    inverting,
    past,
    settling,
    switching,
)
from foamfit.springs.law import LEAST_RANK, crossing, most_beyond

# Branches: A before the first snap, FIXED for a constant snapped fraction, and those above.
A, FIXED, SNAP, BACK, BOTH, AGAIN = 0, 6, 7, 8, 9, 10
# The row: k0, kc, eps_star; mean and standard deviation of ln σ at snap-through and snap-back; n;
# k0 and mean of ln σ of micro-springs that have snapped before; 1 if there is stiffening, softening
# or weakening; ln of the stress at which both laws of snapping meet (see `law.crossing`).
K0, KC, STAR, LOG_PLUS, PLUS, LOG_MINUS, MINUS, N, WORN, LOG_AGAIN, REMEMBERS, CROSS, COLUMNS = (
    range(13)
)
# Parameters by their place among the derivatives.
STIFFENING, SOFTENING, WEAKENING, PARAMETERS = range(7, 11)
# Memory: ranks w and W; p, 1 - p, 1 - P; dε/dσ and d²ε/dσ² where the stress was last computed.
RANK, EVER = HELD, HELD + 1
SNAPPED, REST, NEVER, FLEXIBILITY, CURVATURE = range(OWN, OWN + 5)
CHANGE = OF_PARAMETER + PARAMETERS
# Strain below which no micro-spring snaps: ln σ is singular at zero.
LEAST_STRAIN = 1e-14
# Relative step of Halley's method, per width of the snap, below which the step is the last: the
# remaining error is about its cube.
NEAR = 3e-6
ROUNDED = 1e-8  # largest correction of a share that rounding errors can explain
LEAST = 2.0**-1022  # least stress of a search: the least normal number
_HALF, _TURN = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)

_crossing, _most_beyond = inner(crossing), inner(most_beyond)


@njit(**OPTIONS, cache=True)
def fill(values, row):  # type: ignore[no-untyped-def]
    """Write the row; stiffening, softening and weakening, if present, follow spread_minus."""
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
    row[K0], row[KC], row[STAR] = values[0], values[1], values[2]
    row[LOG_PLUS], row[PLUS] = math.log(values[3]), values[4]
    row[LOG_MINUS], row[MINUS], row[N] = math.log(values[5]), values[6], n
    row[WORN], row[LOG_AGAIN] = row[K0] * math.exp(-softening), row[LOG_PLUS] - weakening
    row[REMEMBERS] = 1.0 if count > 7 else 0.0
    row[CROSS] = _crossing(row[LOG_AGAIN], row[PLUS], row[LOG_MINUS], row[MINUS])
    return row[WORN] > 0.0 and row[STAR] >= _most_beyond(row[WORN], row[KC], n)[0]


# ---------------------------------------------------------------- the mixture


@inlined
def shares(rank):  # type: ignore[no-untyped-def]
    """Return Φ and 1 - Φ, the shares below and above a rank; the smaller one has all digits."""
    least = 0.5 * math.erfc(_HALF * abs(rank))
    return (1.0 - least, least) if rank > 0.0 else (least, 1.0 - least)


@inlined
def density(rank):  # type: ignore[no-untyped-def]
    """Return Φ', the density of ranks."""
    return _TURN * math.exp(-0.5 * rank * rank)


@inlined
def on_a(n, k, sigma):  # type: ignore[no-untyped-def]
    """Return strain a(σ; k) (-inf past its pole) and its derivatives by σ, σ twice, and n."""
    if n == 1.0:
        one = 1.0 / (k + sigma)
        slope = k * one * one
        if not sigma > -k:
            return -math.inf, 0.0, 0.0, 0.0
        by_n = 0.0
        return sigma * one, slope, -2.0 * slope * one, by_n
    above = k + n * sigma
    if not above > 0.0:
        return -math.inf, 0.0, 0.0, 0.0
    log = math.log1p(n * sigma / k) / n
    left, per = math.exp(-log), 1.0 / above
    slope = left * per
    return -math.expm1(-log), slope, -(1.0 + n) * slope * per, left * (sigma * per - log) / n


@inner
def stress_on_a(n, k, eps):  # type: ignore[no-untyped-def]
    """Return the stress at a strain of branch a; infinite from its end on."""
    if not eps < 1.0:
        return math.inf
    return k * eps / (1.0 - eps) if n == 1.0 else k * math.expm1(-n * math.log1p(-eps)) / n


@inner
def moves(branch):  # type: ignore[no-untyped-def]
    """Whether micro-springs snap or snap back on a branch."""
    return branch > FIXED


@inner
def line(row, branch):  # type: ignore[no-untyped-def]
    """Return mean and standard deviation of the normal distribution of ln σ on a branch."""
    if branch == BACK:
        return row[LOG_MINUS], row[MINUS]
    return row[LOG_PLUS] if branch == SNAP else row[LOG_AGAIN], row[PLUS]


@inner
def mixture(row, branch, p, rest, never, sigma):  # type: ignore[no-untyped-def]
    """Return the strain at a stress, given p, 1 - p and 1 - P, and two derivatives at fixed p, P.

    The last two values are strain and slope of the branch a that snaps.
    """
    n, k = row[N], row[WORN]
    two = 1.0 / (row[KC] + sigma)
    on_c = row[KC] * two * two
    if branch == SNAP or never == 1.0:  # nothing on branch a has ever snapped
        k, never = row[K0], 0.0
    one, slope, bend, _ = on_a(n, k, sigma)
    strain = rest * one + p * (row[STAR] + sigma * two)
    soft, bent = rest * slope + p * on_c, rest * bend - 2.0 * p * on_c * two
    if never > 0.0 and k != row[K0]:
        fresh, stiff, stiffer, _ = on_a(n, row[K0], sigma)
        strain += never * (fresh - one)
        soft += never * (stiff - slope)
        bent += never * (stiffer - bend)
    return strain, soft, bent, one, slope


@inner
def at_stress(row, s, sigma):  # type: ignore[no-untyped-def]
    """Return the strain at a stress on the branch; fill dε/dσ and d²ε/dσ²."""
    branch = int(s[BRANCH])
    if not moves(branch) or not sigma > 0.0:  # where none has snapped, branches are continued
        p, rest = (0.0, 1.0) if moves(branch) else (s[SNAPPED], s[REST])
        strain, slope, bend, _, _ = mixture(row, branch, p, rest, s[NEVER], sigma)
        s[FLEXIBILITY], s[CURVATURE] = slope, bend
        return strain
    place, scale = line(row, branch)
    rank = (math.log(sigma) - place) / scale
    p, rest = shares(rank)
    strain, slope, bend, one, on_one = mixture(row, branch, p, rest, s[NEVER], sigma)
    two = 1.0 / (row[KC] + sigma)
    gap, rate = row[STAR] + sigma * two - one, density(rank) / (scale * sigma)
    bend += 2.0 * rate * (row[KC] * two * two - on_one)
    bend -= rate * gap * (rank / scale + 1.0) / sigma
    s[FLEXIBILITY], s[CURVATURE] = slope + rate * gap, bend
    return strain


@inner
def _ends_of_stress(row, s, eps):  # type: ignore[no-untyped-def]
    """Return bounds of the stress at a strain, from the stiffest and the softest branch."""
    n, stiff = row[N], stress_on_a(row[N], row[K0], eps)
    if eps < 0.0 or (not moves(int(s[BRANCH])) and s[SNAPPED] == 0.0):
        soft = stress_on_a(n, row[WORN], eps)
        low, high = min(stiff, soft), max(stiff, soft)
    else:
        low, high = 0.0, stiff
        if eps > row[STAR]:
            low = row[KC] * (eps - row[STAR]) / (1.0 - (eps - row[STAR]))
    wide = 1e-14
    return low - wide * abs(low), high + wide * abs(high)


@inner
def _inside(row, low, high):  # type: ignore[no-untyped-def]
    """Return a stress between two bounds, the upper of which may be infinite."""
    return 0.5 * (low + high) if high < math.inf else max(2.0 * low, row[K0])


@inner
def _halfway(low, high, sigma):  # type: ignore[no-untyped-def]
    """Return a stress between two bounds, halfway in the logarithm if possible."""
    if high == math.inf:
        return 2.0 * max(sigma, LEAST)
    if low > 0.0:
        return math.sqrt(low) * math.sqrt(high)
    if low == 0.0:
        return 1e-3 * high if high > 1e6 * LEAST else 0.5 * high
    return 0.5 * (low + high)


@inner
def _held_stress(row, p, rest, eps):  # type: ignore[no-untyped-def]
    """Return the stress at a strain for fixed p without memory: the root of a quadratic."""
    k0, kc, beyond = row[K0], row[KC], eps - p * row[STAR]
    a, product = 1.0 - beyond, beyond * k0 * kc
    if not a > 0.0:
        return math.inf
    b = rest * kc + p * k0 - beyond * (k0 + kc)
    root = math.sqrt(b * b + 4.0 * a * product)
    return 2.0 * product / (b + root) if b >= 0.0 else (root - b) / (2.0 * a)


@inner
def stress_in(row, s, eps):  # type: ignore[no-untyped-def]
    """Return the stress at a strain on the branch; infinite past its end.

    The method is Halley's inside a bracket, from a parabola at the previous point.
    """
    branch = int(s[BRANCH])
    if branch == FIXED and row[REMEMBERS] == 0.0:
        return _held_stress(row, s[SNAPPED], s[REST], eps)
    reach = 1.0 + (row[STAR] if moves(branch) or s[SNAPPED] > 0.0 else 0.0)
    if not eps < reach:
        return math.inf
    if branch == A and (s[NEVER] == 1.0 or eps == 0.0):
        return stress_on_a(row[N], row[K0], eps)
    sigma, slope, low, high = s[X], s[FLEXIBILITY], -math.inf, math.inf
    bounded = not slope > 0.0
    if bounded:
        low, high = _ends_of_stress(row, s, eps)
        if not low < sigma < high:
            sigma = _inside(row, low, high)
    else:
        step = (eps - s[EPS]) / slope
        sigma += step * (1.0 - 0.5 * step * s[CURVATURE] / slope)
    narrow = min(row[PLUS], row[MINUS], 1.0) if moves(branch) else 1.0
    for _ in range(300):
        miss = at_stress(row, s, sigma) - eps
        slope, bend = s[FLEXIBILITY], s[CURVATURE]
        step = miss / slope
        part = 1.0 - 0.5 * step * bend / slope
        if 0.5 < part < 2.0:
            step /= part
        new = sigma - step
        if abs(step) <= NEAR * abs(sigma) * narrow and low <= new <= high:
            s[FLEXIBILITY] += bend * (new - sigma)
            return new
        if not bounded:  # the initial guess did not suffice
            low, high = _ends_of_stress(row, s, eps)
            bounded = True
            if not low < sigma < high:
                sigma = _inside(row, low, high)
                continue
        if miss > 0.0:
            high = sigma
        else:
            low = sigma
        if not low < new < high:
            new = _halfway(low, high, sigma)
            if not low < new < high:  # neighbouring floating-point numbers
                return sigma
        sigma = new
    return sigma


# ---------------------------------------------------------------- from branch to branch


@inner
def _end(row, s, high, sigma):  # type: ignore[no-untyped-def]
    """Set the upper (`high`) or lower end of the branch to a stress, not behind the spring."""
    soft, bend = s[FLEXIBILITY], s[CURVATURE]
    eps = at_stress(row, s, sigma)
    s[FLEXIBILITY], s[CURVATURE] = soft, bend
    if (eps < s[EPS]) if high else (eps > s[EPS]):
        eps, sigma = s[EPS], s[X]
    if high:
        s[HIGH], s[SIGMA_HIGH] = eps, sigma
    else:
        s[LOW], s[SIGMA_LOW] = eps, sigma


@inner
def _no_less(row, s, high):  # type: ignore[no-untyped-def]
    """Raise an end of the branch to the least strain at which a micro-spring may snap."""
    if (s[HIGH] if high else s[LOW]) < LEAST_STRAIN:
        soft, bend = s[FLEXIBILITY], s[CURVATURE]
        sigma = stress_in(row, s, LEAST_STRAIN)
        if high:
            s[HIGH], s[SIGMA_HIGH] = LEAST_STRAIN, sigma
        else:
            s[LOW], s[SIGMA_LOW] = LEAST_STRAIN, sigma
        s[FLEXIBILITY], s[CURVATURE] = soft, bend


@inner
def _has_loop(row, sigma, up):  # type: ignore[no-untyped-def]
    """Whether snap-back lies below snap-through just above (`up`) or just below a stress."""
    log = math.log(sigma)
    if row[MINUS] >= row[PLUS]:
        return log < row[CROSS] if up else log <= row[CROSS]
    return log >= row[CROSS] if up else log > row[CROSS]


@inner
def _last_stress(row):  # type: ignore[no-untyped-def]
    """Return the stress at which the last micro-spring has snapped back."""
    through = row[LOG_AGAIN] + row[PLUS] * LEAST_RANK
    return math.exp(min(through, row[LOG_MINUS] + row[MINUS] * LEAST_RANK))


@inner
def _enter(row, s, branch):  # type: ignore[no-untyped-def]
    """Enter a branch at the present strain and stress."""
    s[BRANCH], s[FLEXIBILITY] = branch, 0.0
    s[TURNS] = 1.0 if branch == SNAP or branch == AGAIN else -1.0 if branch == BACK else 0.0
    s[LOW], s[SIGMA_LOW], s[HIGH], s[SIGMA_HIGH] = -math.inf, -math.inf, math.inf, math.inf
    below, cross, remembers = row[MINUS] >= row[PLUS], math.exp(row[CROSS]), row[REMEMBERS] > 0.0
    if branch == A:
        s[RANK], s[SNAPPED], s[REST] = -math.inf, 0.0, 1.0
        first = row[LOG_PLUS] if s[NEVER] == 1.0 else row[LOG_AGAIN]
        _end(row, s, True, math.exp(first + row[PLUS] * LEAST_RANK))
        if s[HIGH] < LEAST_STRAIN:
            s[BRANCH] = SNAP if s[NEVER] == 1.0 else AGAIN
            _no_less(row, s, True)
            s[BRANCH] = A
        return
    if branch != BACK and (branch != SNAP or not remembers):
        high = math.exp(row[LOG_AGAIN] + row[PLUS] * s[EVER]) if remembers else math.inf
        if (branch != BOTH) == below:  # the other branch begins where both laws of snapping meet
            high = min(high, cross)
        if high < math.inf:
            _end(row, s, True, high)
    if branch == BOTH or branch == BACK:
        last = _last_stress(row)
        _end(row, s, False, max(last, cross) if (branch == BOTH) == below else last)
        _no_less(row, s, False)


@inner
def _hold(row, s, rank):  # type: ignore[no-untyped-def]
    """Hold the present rank.

    In a narrow snap the last digit of the stress covers many ranks, so the snapped share is
    corrected to match the strain.
    """
    p, rest = shares(rank)
    sigma = s[X]
    eps, _, _, on_main, _ = mixture(row, FIXED, p, rest, s[NEVER], sigma)
    more = (s[EPS] - eps) / (row[STAR] + sigma / (row[KC] + sigma) - on_main)
    if abs(more) < min(ROUNDED, p, rest):
        p, rest = p + more, rest - more
    s[BRANCH], s[TURNS], s[RANK], s[SNAPPED], s[REST] = FIXED, 0.0, rank, p, rest
    s[FLEXIBILITY] = 0.0
    first = row[LOG_PLUS] if rank >= s[EVER] else row[LOG_AGAIN]
    back, again = row[LOG_MINUS] + row[MINUS] * rank, row[LOG_AGAIN] + row[PLUS] * rank
    _end(row, s, True, max(math.exp(first + row[PLUS] * rank), sigma))
    _end(row, s, False, min(math.exp(min(back, again)), sigma))


@inner
def rank_now(row, s):  # type: ignore[no-untyped-def]
    """Return the rank up to which micro-springs have snapped."""
    branch = int(s[BRANCH])
    if not moves(branch):
        return s[RANK]
    place, scale = line(row, branch)
    return (math.log(s[X]) - place) / scale


@inner
def _turn(row, s, up, out):  # type: ignore[no-untyped-def]
    """Hold the rank that a spring has reached where its strain turns."""
    branch, remembers, rank = s[BRANCH], row[REMEMBERS] > 0.0, rank_now(row, s)
    first = 5 if branch == BACK else 3
    scale = line(row, int(branch))[1]
    for h in range(2 if branch == SNAP and remembers else 1):
        by = past(out, h * CHANGE)
        by[OF_HELD + h], by[OF_STRESS] = 0.0, 1.0 / (scale * s[X])
        by[OF_PARAMETER + first] = -math.exp(-row[first]) / scale
        by[OF_PARAMETER + first + 1] = -rank / scale
        if branch == AGAIN:
            by[OF_PARAMETER + WEAKENING] = 1.0 / scale
    if branch == SNAP and remembers:
        s[EVER], s[NEVER] = rank, shares(rank)[1]
    _hold(row, s, rank)
    if not up and row[LOG_AGAIN] == row[LOG_PLUS] and not _has_loop(row, s[X], False):
        _enter(row, s, BOTH)


@switching
def switch(row, s, up, out):  # type: ignore[no-untyped-def]
    branch, remembers = s[BRANCH], row[REMEMBERS] > 0.0
    for c in range(2 * CHANGE):
        out[c] = 0.0
    out[OF_HELD], out[CHANGE + OF_HELD + 1] = 1.0, 1.0
    if (branch == BACK) if up else (branch == SNAP or branch == AGAIN):
        _turn(row, s, up, out)
        return 0.0
    s[EPS], s[X] = (s[HIGH], s[SIGMA_HIGH]) if up else (s[LOW], s[SIGMA_LOW])
    sigma = s[X]
    if branch == A or (branch == FIXED and up):
        if remembers and (s[RANK] >= s[EVER] or s[NEVER] == 1.0):
            _enter(row, s, SNAP)
        elif _has_loop(row, sigma, True):
            _enter(row, s, AGAIN if remembers else SNAP)
        else:
            _enter(row, s, BOTH)
    elif branch == FIXED:
        _enter(row, s, BACK if _has_loop(row, sigma, False) else BOTH)
    elif up:
        log = row[LOG_AGAIN] + row[PLUS] * s[EVER]
        if not remembers:
            _enter(row, s, SNAP if branch == BOTH else BOTH)
        elif math.log(sigma) < log - 1e-14 * max(abs(log), 1.0):
            _enter(row, s, AGAIN if branch == BOTH else BOTH)
        else:  # all micro-springs that ever snapped have snapped again
            s[RANK] = s[EVER]
            if row[LOG_AGAIN] == row[LOG_PLUS]:
                _enter(row, s, SNAP)
            else:
                out[OF_HELD], out[OF_HELD + 1] = 0.0, 1.0
                _hold(row, s, s[EVER])
    elif sigma <= _last_stress(row) or s[EPS] <= LEAST_STRAIN:
        out[OF_HELD] = 0.0
        _enter(row, s, A)
    else:
        _enter(row, s, BOTH if branch == BACK else BACK)
    return 0.0


@beginning
def begin(row, s):  # type: ignore[no-untyped-def]
    s[EPS] = s[X] = s[SNAPPED] = 0.0
    s[RANK], s[EVER], s[REST], s[NEVER] = -math.inf, -math.inf, 1.0, 1.0
    _enter(row, s, A)
    return 0.0


@settling
def settle(row, s, eps):  # type: ignore[no-untyped-def]
    sigma = stress_in(row, s, eps)
    s[EPS], s[X] = eps, sigma
    return sigma


@inverting
def strain(row, s, sigma):  # type: ignore[no-untyped-def]
    eps = at_stress(row, s, sigma)
    s[SOFT] = s[FLEXIBILITY]
    return eps


@evaluating
def evaluate(row, s, eps, x, count, want, out):  # type: ignore[no-untyped-def]
    branch = s[BRANCH]
    k0, kc, star, n, remembers = row[K0], row[KC], row[STAR], row[N], row[REMEMBERS] > 0.0
    p, rest, never, rank, pace, weight = s[SNAPPED], s[REST], s[NEVER], 0.0, 0.0, 0.0
    moving, first = branch > FIXED, 5 if branch == BACK else 3
    place = row[LOG_AGAIN] if branch >= BOTH else row[first]
    wide, on_ever = 1.0 / row[first + 1], 0.0
    by_median = math.exp(-row[first]) if want and moving else 0.0
    # shares on branch a of what never and what once snapped
    mixed = remembers and branch != SNAP and never < 1.0
    softened = mixed and row[WORN] != k0
    if want and mixed:
        on_ever = density(s[EVER])
    if want and not moving and p > 0.0:
        weight = density(s[RANK])
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
            one, soft_one, _, by_n_one = on_a(n, row[WORN], sigma)
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
        for c in range(3, PARAMETERS):
            by[c * count] = 0.0
        held[0], held[count] = 0.0, 0.0
        if moving:
            through = slope * by_rank * wide
            by[first * count], by[(first + 1) * count] = through * by_median, through * rank
            if branch >= BOTH:
                by[WEAKENING * count] = -through
        else:
            held[0] = -slope * by_rank
        if remembers:
            by[STIFFENING * count] = -slope * (fresh * by_n + worn * by_n_one)
            by[SOFTENING * count] = -slope * worn * sigma * soft_one
            held[count] = -slope * on_ever * (one - main)
    return 0.0


COMPILED = Compiled(
    fill,
    BY_STRESS,
    COLUMNS,
    PARAMETERS,
    1,
    (begin.address, evaluate.address, switch.address, settle.address, strain.address),
    (K0, KC),
    STAR,
)
