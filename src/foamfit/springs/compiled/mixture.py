"""The mixture of micro-springs that a microscale spring is, and its stress at a strain.

`microscale` has the law and its branches, and explains the symbols.
"""

from __future__ import annotations

import math

from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import inlined, inner

# Branches: A before the first snap, FIXED for a constant snapped fraction, on the others p changes.
A, SNAP, FIXED, BACK, BOTH, AGAIN = range(6)
# The row: k0, kc, eps_star; mean and standard deviation of ln σ at snap-through and snap-back; n;
# k0 and mean of ln σ of micro-springs that have snapped before; 2 if n is a parameter, else 1 if
# there is softening or weakening; ln of the stress where both laws of snapping meet (`crossing`).
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
# Strain below which no micro-spring snaps: ln σ is singular at zero.
LEAST_STRAIN = 1e-14
# Relative step of Halley's method, per width of the snap, below which the step is the last: the
# remaining error is about its cube.
NEAR = 3e-6
ROUNDED = 1e-8  # largest correction of a share that rounding errors can explain
# Rank (standard normal score) below which no micro-spring counts as snapped: a fraction of 5e-17.
LEAST_RANK = -8.3
LEAST = 2.0**-1022  # least stress of a search: the least normal number
_HALF, _TURN = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)


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
def moves(branch):
    """Whether micro-springs snap or snap back on a branch."""
    return branch != A and branch != FIXED


@inner
def line(row, branch):
    """Return mean and standard deviation of the normal distribution of ln σ on a branch."""
    if branch == BACK:
        return row.log_minus, row.minus
    return row.log_plus if branch == SNAP else row.log_again, row.plus


@inner
def crossing(log_plus: float, spread_plus: float, log_minus: float, spread_minus: float) -> float:
    """Return the logarithm of the stress at which one rank snaps through and snaps back.

    The spring is hysteretic (snap-back below snap-through) below this stress if
    spread_minus >= spread_plus, else above it. It is ±inf if the two laws never meet.
    """
    if spread_minus == spread_plus:
        return math.inf if log_minus < log_plus else -math.inf
    return log_plus + spread_plus * ((log_plus - log_minus) / (spread_minus - spread_plus))


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
    if not moves(branch) or not sigma > 0.0:  # where none has snapped, branches are continued
        p, rest = (0.0, 1.0) if moves(branch) else (s.snapped, s.rest)
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
    if eps < 0.0 or (not moves(int(s.branch)) and s.snapped == 0.0):
        soft = stress_on_a(n, row.worn, eps)
        low, high = min(stiff, soft), max(stiff, soft)
    else:
        low, high = 0.0, stiff
        if eps > row.star:
            low = row.kc * (eps - row.star) / (1.0 - (eps - row.star))
    wide = 1e-14
    return low - wide * abs(low), high + wide * abs(high)


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
    reach = 1.0 + (row.star if moves(branch) or s.snapped > 0.0 else 0.0)
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
    narrow = min(row.plus, row.minus, 1.0) if moves(branch) else 1.0
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
