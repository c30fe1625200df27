"""Judge that shares neither code nor method with the solver: brute-force Runge-Kutta steps.

It reads the public attributes of springs, chain and drive and imports nothing else. The law is
implemented branch by branch, the derived points of a bistable spring are roots found by bracketing,
and the motion is an ordinary differential equation; no algebraic equation is solved. The state
consists of the velocities of the nodes with mass, the strain of each linear or bistable spring, the
equilibrium stress s of each microscale spring, and z = q - g s of each relaxation term. In s the
microscale law is explicit: its strain is (1-p) s/(k0+s) + p (eps_star + s/(kc+s)), and ds/dt =
(dε/dt)/(dε/ds). A spring carries T = (1 + Σ g) s + Σ z and its dashpot. Springs between two nodes
that have mass, are clamped or are prescribed carry one stress S:

- every spring has a dashpot: S = (v_top - v_bottom + Σ h T/η)/(Σ h/η), dε/dt = (S - T)/η;
- some have none: S is the T of one of these; those with a dashpot follow as above, and the others
  share the remaining rate of elongation by dε/dt = (dε/ds) (dS/dt - Σ dz/dt)/(1 + Σ g); a flat
  branch takes all of the rate;
- the stress on a massless top is prescribed: S is that stress.

The rank of a microscale spring between snaps is a constant normal score w: it snaps through again
at ln s = ln sigma_plus + spread_plus w, and back at ln s = ln sigma_minus + spread_minus w. For
springs that remember, W is the largest w ever: up to W they snap through at ln s = ln sigma_plus -
weakening + spread_plus w, beyond W as before. Branch a is σ = k ((1 - ε)^-n - 1)/n, with the
softened k for the share Φ(W) - Φ(w) that has snapped once.

The method of Dormand and Prince of order 8(5,3) takes explicit steps with compensated sums. A step
ends at each sample, kink of the drive, end of a branch and turning point of s on a branch that
snaps; these are found by repeating the step with other lengths. The normal distribution is crossed
in steps of at most one standard deviation. Stiff scenes take many steps: beyond a limit there is no
judgement.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import DOP853
from scipy.optimize import brentq

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

TIGHT, LOOSE = 1e-13, 1e-12  # local error of a step relative to the largest values so far
MOST_WORK = 30_000_000  # steps times springs of one run
# Base stress over the largest stress so far above which a return to zero counts.
RISEN = 1e-11
FAR = 8.0  # standard deviations beyond which the normal distribution is 0 or 1 to rounding

_A, _B, _C = DOP853.A[:12, :12].copy(), DOP853.B.copy(), DOP853.C[:12].copy()
_E3, _E5 = DOP853.E3[:12].copy(), DOP853.E5[:12].copy()

# Columns of a spring; then those of a microscale spring besides K0, KC, ETA and H.
K0, KC, EPS_A, EPS_C, STAR, SIG_A, SIG_C, UP, DOWN, HAT_A, HAT_C, ETA, H = range(13)
EPS_STAR, LOG_PLUS, WIDE_PLUS, LOG_MINUS, WIDE_MINUS, N, K_WORN, LOG_AGAIN = range(2, 10)
# Branches; of a microscale spring: p is held; p = P+; p = raw P-; both are the same; and p = P+ of
# what has snapped once. Where nothing differs then, P+ is followed on SNAP and BOTH.
A, D, C, E, LINE, ONE_SIDED, GAP, HELD, SNAP, BACK, BOTH, AGAIN = range(12)
# Drive of the top.
MASS, DAMPER, STRESS, MOTION = range(4)
# End of a run.
DONE, TOO_LONG, NO_STEP, FLAT = range(4)
WHY = ("", "too many steps", "no step is short enough", "stress prescribed on a flat branch")
SHARED = "several gaps or flat branches share an elongation, and the law does not say how"

# Functions called only by compiled loops are compiled as part of them.
inner = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


class System(NamedTuple):
    """A chain under a drive: the constants of a run."""

    springs: Array  # (n, 13)
    relax: Array  # (n, terms, 2): g and tau
    ends: Integers  # of the groups that carry one stress
    mass: Array  # of their upper nodes, over the area
    drag: float
    top: int
    speed: float  # of a striker, else 0
    gravity: float  # on a striker
    values: Array  # of the drive at the samples
    work: Array  # (4, n), overwritten by `fill_rates`


class Flags(NamedTuple):
    """Branch of each spring, and its ranks snapped now and snapped ever."""

    branch: Integers
    ranks: Array
    most: Array


class Tried(NamedTuple):
    """A step: rates of its stages, end state, increment, and error scales."""

    k: Array
    y1: Array
    some: Array
    scale: Array
    reach: Array
    stress: Array
    rates: Array
    units: Integers
    paces: Array


# ------------------------------------------------------------------------------------ the law


def bistable_row(spring: Any, height: float) -> list[float]:
    k0, kc, up, down = spring.k0, spring.kc, spring.kh_plus, spring.kh_minus
    eps_a, eps_c = spring.eps_a, spring.eps_c
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + spring.dsigma
    # C2 lies on branch c: x/(1-x) = σ_c/k_c
    star = eps_c - (sigma_c / kc) / (1.0 + sigma_c / kc)

    def c_over_d(eps: float) -> float:  # times the distance to the end of branch c
        x = eps - star
        return kc * x - (1.0 - x) * (sigma_a + up * (eps - eps_a))

    def a_over_e(eps: float) -> float:
        return k0 * eps - (1.0 - eps) * (sigma_c + down * (eps - eps_c))

    hat_c = eps_c
    if c_over_d(eps_c) < 0.0:
        hat_c = float(brentq(c_over_d, eps_c, 1.0 + star, xtol=1e-16, rtol=1e-15))
    lowest = -1.0
    if down > 0.0:
        lowest = max((down * (1.0 + eps_c) - k0 - sigma_c) / (2.0 * down), -1e9)
    hat_a = -math.inf
    if a_over_e(eps_a) <= 0.0:
        hat_a = eps_a
    elif lowest < eps_a and a_over_e(lowest) < 0.0:
        hat_a = float(brentq(a_over_e, lowest, eps_a, xtol=1e-16, rtol=1e-15))
    return [
        k0, kc, eps_a, eps_c, star, sigma_a, sigma_c, up, down, hat_a, hat_c, spring.eta, height,
    ]  # fmt: skip


def row_of(spring: Any, height: float) -> tuple[list[float], int]:
    """Return the parameters of a spring and its initial branch."""
    if hasattr(spring, "kc") and not hasattr(spring, "sigma_plus"):
        return bistable_row(spring, height), A
    row = [0.0] * 13
    row[K0], row[ETA], row[H] = spring.k0, spring.eta, height
    if not hasattr(spring, "sigma_plus"):
        return row, ONE_SIDED if spring.unilateral else LINE
    row[KC], row[EPS_STAR] = spring.kc, spring.eps_star
    row[LOG_PLUS], row[WIDE_PLUS] = math.log(spring.sigma_plus), spring.spread_plus
    row[LOG_MINUS], row[WIDE_MINUS] = math.log(spring.sigma_minus), spring.spread_minus
    row[N], row[K_WORN] = spring.stiffening, spring.k0 * math.exp(-spring.softening)
    row[LOG_AGAIN] = row[LOG_PLUS] - spring.weakening
    return row, HELD


@inner
def pressed(p: Array, branch: int, eps: float) -> tuple[float, float]:
    """Return stress (infinite past a pole) and slope of a linear or bistable spring."""
    if branch == D:
        return p[SIG_A] + p[UP] * (eps - p[EPS_A]), p[UP]
    if branch == E:
        return p[SIG_C] + p[DOWN] * (eps - p[EPS_C]), p[DOWN]
    if branch in (A, C):
        k, x = (p[K0], eps) if branch == A else (p[KC], eps - p[STAR])
        return k * x / (1.0 - x) if x < 1.0 else math.inf, k / (1.0 - x) ** 2
    return (0.0, 0.0) if branch == GAP else (p[K0] * eps, p[K0])


@inner
def bounds(p: Array, branch: int) -> tuple[float, float, int, int]:
    """Return the lower and upper strain limits of a branch, and the following branches."""
    if branch == A:
        return -math.inf, p[EPS_A], A, D
    if branch == D:
        return p[EPS_A], p[HAT_C], A, C
    if branch == C:
        return p[EPS_C], math.inf, E, C
    if branch == E:
        return p[HAT_A], p[EPS_C], A, C
    if branch == ONE_SIDED:
        return 0.0, math.inf, GAP, ONE_SIDED
    if branch == GAP:
        return -math.inf, 0.0, GAP, ONE_SIDED
    return -math.inf, math.inf, LINE, LINE


@inner
def _score(p: Array, branch: int, rank: float, s: float) -> tuple[float, float]:
    """Return the normal score of the snapped share, and its spread over ln s (0 = constant)."""
    if branch == HELD:
        return rank, 0.0
    if s <= 0.0:
        return -math.inf, 0.0
    if branch == BACK:
        return (math.log(s) - p[LOG_MINUS]) / p[WIDE_MINUS], p[WIDE_MINUS]
    place = p[LOG_PLUS] if branch == SNAP else p[LOG_AGAIN]
    return (math.log(s) - place) / p[WIDE_PLUS], p[WIDE_PLUS]


@inner
def _remembers(p: Array) -> bool:
    """Return whether a first snap changes the spring."""
    return p[K_WORN] < p[K0] or p[LOG_AGAIN] < p[LOG_PLUS]


@inner
def _on_a(n: float, k: float, s: float) -> tuple[float, float]:
    """Return strain and slope of branch a at a stress; infinite past the pole."""
    if k + n * s <= 0.0:
        return -math.inf, math.nan
    if n == 1.0:
        return s / (k + s), k / (k + s) ** 2
    left = (1.0 + n * s / k) ** (-1.0 / n)
    return -math.expm1(-math.log1p(n * s / k) / n), left / (k + n * s)


@inner
def _mixture(p: Array, branch: int, rank: float, most: float, s: float) -> tuple[float, float]:
    """Return strain and dε/ds of a microscale spring at a stress; infinite past the pole."""
    u, wide = _score(p, branch, rank, s)
    snapped, whole = 0.5 * math.erfc(-u / math.sqrt(2.0)), 0.5 * math.erfc(u / math.sqrt(2.0))
    a, slope = _on_a(p[N], p[K0], s)
    c, rise, soft, strain = 0.0, 0.0, whole * slope, whole * a
    if branch != SNAP and most > -math.inf and p[K_WORN] < p[K0]:
        never = min(0.5 * math.erfc(most / math.sqrt(2.0)), whole)
        other, softer = _on_a(p[N], p[K_WORN], s)
        soft = never * slope + (whole - never) * softer
        strain, a = never * a + (whole - never) * other, other
    if a == -math.inf or (snapped > 0.0 and p[KC] + s <= 0.0):
        return -math.inf, math.nan
    if snapped > 0.0:
        c, rise = p[EPS_STAR] + s / (p[KC] + s), p[KC] / (p[KC] + s) ** 2
    if wide > 0.0:
        density = math.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
        soft += density / (wide * s) * (c - a)
    return strain + snapped * c, soft + snapped * rise


@inner
def _meets(p: Array) -> tuple[float, bool]:
    """Return the stress of equal snap-through and snap-back scores; is there a loop above it?"""
    slope = 1.0 / p[WIDE_MINUS] - 1.0 / p[WIDE_PLUS]
    constant = p[LOG_AGAIN] / p[WIDE_PLUS] - p[LOG_MINUS] / p[WIDE_MINUS]
    if slope == 0.0:
        return (-math.inf if constant > 0.0 else math.inf), True
    at = -constant / slope
    if at > 690.0:
        return math.inf, slope > 0.0
    return (math.exp(at) if at > -690.0 else -math.inf), slope > 0.0


@inner
def _ends(p: Array, branch: int, rank: float, most: float) -> tuple[float, float, int, int]:
    """Return the limits of a branch (stress or strain), and the branches beyond."""
    if branch < HELD:
        return bounds(p, branch)
    if branch == SNAP and _remembers(p):
        return -math.inf, math.inf, SNAP, SNAP
    cross, above = _meets(p)
    differs, again = _remembers(p), p[LOG_AGAIN] + p[WIDE_PLUS] * rank
    if branch == HELD:
        back = p[LOG_MINUS] + p[WIDE_MINUS] * rank
        loop = back < again if rank > -math.inf else not above or cross == -math.inf
        low, high = math.exp(min(back, again)), math.exp(again)
        onward = BOTH if not loop else AGAIN if differs else SNAP
        if differs and rank >= most:
            onward, high = SNAP, math.exp(p[LOG_PLUS] + p[WIDE_PLUS] * rank)
        low = low if low > 0.0 else -math.inf
        return low, high, BACK if loop or not differs else BOTH, onward
    if branch == BACK:
        return (cross if above else -math.inf), math.inf, BOTH, BACK
    low, under = (-math.inf if branch != BOTH or above else cross), BACK
    high = cross if (branch == BOTH) == above else math.inf
    last = math.exp(p[LOG_AGAIN] + p[WIDE_PLUS] * most) if differs else math.inf
    if last < high:
        return low, last, under, HELD
    return low, high, under, BOTH if branch != BOTH else AGAIN if differs else SNAP


# ----------------------------------------------------------------------------- the equations


@inner
def fill_rates(
    y: Array, out: Array, stress: Array, flags: Flags, system: System, value: float, rate: float
) -> bool:
    """Fill the rates `out` of a state and the `stress` of each group.

    `value` and `rate` describe the drive (stress or displacement). Return False on a flat branch
    under a prescribed stress, and past the pole of a law.
    """
    springs, relax, ends, top = system.springs, system.relax, system.ends, system.top
    groups, count, terms = ends.size, springs.shape[0], relax.shape[1]
    moving = groups if top == MASS else groups - 1
    work = system.work
    held, fade, gain, soft = work[0], work[1], work[2], work[3]  # T, Σ dz/dt, 1 + Σ g, dε/ds
    for i in range(count):
        p, x = springs[i], y[moving + i]
        if flags.branch[i] >= HELD:
            s = x
            soft[i] = _mixture(p, flags.branch[i], flags.ranks[i], flags.most[i], s)[1]
            if not soft[i] > 0.0:
                return False
        else:
            s, slope = pressed(p, flags.branch[i], x)
            soft[i] = 1.0 / slope if slope > 0.0 else math.inf
        gain[i], held[i], fade[i] = 1.0, 0.0, 0.0
        for n in range(terms):
            g, tau, at = relax[i, n, 0], relax[i, n, 1], moving + count + i * terms + n
            out[at] = 0.0
            if g > 0.0:
                gain[i] += g
                held[i] += y[at]
                out[at] = -(y[at] + g * s) / tau
                fade[i] += out[at]
        held[i] += gain[i] * s
    for g in range(groups):
        i0, i1 = ends[g - 1] if g > 0 else 0, ends[g]
        low = y[g - 1] if g > 0 else 0.0
        prescribed = g == groups - 1 and top == STRESS
        damper = g == groups - 1 and top == DAMPER
        high = y[g] if g < moving else rate  # of a prescribed top
        flow = pull = 0.0
        free = -1  # the softest spring without a dashpot
        for i in range(i0, i1):
            if springs[i, ETA] > 0.0:
                flow += springs[i, H] / springs[i, ETA]
                pull += springs[i, H] * held[i] / springs[i, ETA]
            elif free < 0 or soft[i] > soft[free]:
                free = i
        if prescribed:
            s = value
        elif free >= 0:
            s = held[free]
            if damper:
                high = (value - s) / system.drag
        elif damper:
            s = (value / system.drag - low + pull) / (flow + 1.0 / system.drag)
            high = (value - s) / system.drag
        elif i1 - i0 == 1:
            s = held[i0] + springs[i0, ETA] * (high - low) / springs[i0, H]
        else:
            s = (high - low + pull) / flow
        stress[g] = s
        rest, give, drift = high - low, 0.0, 0.0
        for i in range(i0, i1):
            if springs[i, ETA] > 0.0:
                if i1 - i0 == 1 and not prescribed and not damper:
                    out[moving + i] = (high - low) / springs[i, H]
                else:
                    out[moving + i] = (s - held[i]) / springs[i, ETA]
                rest -= springs[i, H] * out[moving + i]
            else:
                part = springs[i, H] * soft[i] / gain[i]
                give += part
                drift += part * fade[i]
        if free < 0:
            continue
        flat = soft[free] == math.inf
        if prescribed and flat:
            return False
        pace = rate if prescribed else fade[free] if flat else (rest + drift) / give
        for i in range(i0, i1):
            if springs[i, ETA] == 0.0 and not (flat and i == free):
                out[moving + i] = (
                    soft[i] * (pace - fade[i]) / gain[i] if soft[i] < math.inf else 0.0
                )
                rest -= springs[i, H] * out[moving + i]
        if flat:
            out[moving + free] = rest / springs[free, H]
    for i in range(count):
        if flags.branch[i] >= HELD:
            out[moving + i] /= soft[i]
    for g in range(moving):
        net = (stress[g + 1] if g + 1 < groups else 0.0) - stress[g]
        if g == groups - 1:
            net += value - system.drag * y[g]
        out[g] = net / system.mass[g]
    return True


@inner
def overshoot(
    y: Array, rates: Array, paces: Array, flags: Flags, system: System, base: float, peak: float
) -> float:
    """Return the overshoot of a state past a branch end, turn or contact; negative if none.

    `peak` is the largest base stress so far, or 0 if contact cannot end.
    """
    moving, worst = y.size - system.relax[:, :, 0].size - flags.branch.size, -math.inf
    for i in range(flags.branch.size):
        p, branch, x = system.springs[i], flags.branch[i], y[moving + i]
        low, high, _, _ = _ends(p, branch, flags.ranks[i], flags.most[i])
        unit = p[K0] if branch >= HELD else 1.0
        if branch >= HELD and max(abs(low), abs(high)) < math.inf and high > 0.0:
            unit = high
        worst = max(worst, (low - x) / unit, (x - high) / unit)
        if branch in (SNAP, AGAIN, BACK):
            way = 1.0 if branch == BACK else -1.0
            worst = max(worst, way * rates[moving + i] / paces[i])
    return max(worst, -base / peak) if peak > 0.0 else worst


@inner
def _leaps(y: Array, y1: Array, moving: int, flags: Flags, springs: Array) -> bool:
    """Return whether a step crosses more than one standard deviation of the snap stresses."""
    for i in range(flags.branch.size):
        if flags.branch[i] > HELD:
            u0 = _score(springs[i], flags.branch[i], flags.ranks[i], y[moving + i])[0]
            u1 = _score(springs[i], flags.branch[i], flags.ranks[i], y1[moving + i])[0]
            if abs(min(max(u1, -FAR), FAR) - min(max(u0, -FAR), FAR)) > 1.0:
                return True
    return False


@inner
def enter_branches(y: Array, rates: Array, moving: int, flags: Flags, springs: Array) -> int:
    """Change the branch of each spring that leaves it or reverses; return their number."""
    moved = 0
    for i in range(flags.branch.size):
        before = flags.branch[i]
        low, high, under, over = _ends(springs[i], before, flags.ranks[i], flags.most[i])
        x, way = y[moving + i], rates[moving + i]
        if x >= high and way > 0.0:
            flags.branch[i] = over
            if over == HELD:
                flags.ranks[i] = flags.most[i]
        elif x <= low and way < 0.0:
            flags.branch[i] = under
        elif (before in (SNAP, AGAIN) and way < 0.0) or (before == BACK and way > 0.0):
            flags.ranks[i] = _score(springs[i], before, flags.ranks[i], x)[0]
            flags.branch[i] = HELD
            if before == SNAP:
                flags.most[i] = flags.ranks[i]
            # a rate of zero within rounding must not reverse the spring repeatedly
            low, high, _, _ = _ends(springs[i], HELD, flags.ranks[i], flags.most[i])
            near = 4e-16 if before == BACK else -4e-16
            y[moving + i] = (max(x, low) if before == BACK else min(x, high)) * (1.0 + near)
        moved += flags.branch[i] != before
    return moved


@inner
def _step(
    y: Array, h: float, one: Tried, flags: Flags, system: System, value: float, rate: float,
    tol: float,
) -> float:  # fmt: skip
    """Take a step of length h from y with rates one.k[0]; fill in y1 and, in `some`, y1 - y.

    Return the error over the tolerance; infinite if a value is not finite.
    """
    k, y1, some, scale = one.k, one.y1, one.some, one.scale
    size = y.size
    for stage in range(1, 12):
        for j in range(size):
            total = 0.0
            for m in range(stage):
                total += _A[stage, m] * k[m, j]
            y1[j] = y[j] + h * total
        at = value + rate * _C[stage] * h
        if not fill_rates(y1, k[stage], one.stress, flags, system, at, rate):
            return math.inf
    largest = np.zeros(3)
    for j in range(size):
        total = 0.0
        for m in range(12):
            total += _B[m] * k[m, j]
        some[j] = h * total
        y1[j] = y[j] + some[j]
        scale[j] = max(one.reach[j], abs(y1[j]))
        largest[one.units[j]] = max(largest[one.units[j]], scale[j])
    norm5 = norm3 = 0.0
    for j in range(size):
        e5 = e3 = 0.0
        for m in range(12):
            e5 += _E5[m] * k[m, j]
            e3 += _E3[m] * k[m, j]
        unit = tol * max(scale[j], 1e-6 * largest[one.units[j]]) + 1e-290
        norm5 += (e5 / unit) ** 2
        norm3 += (e3 / unit) ** 2
    if not math.isfinite(norm5 + norm3):
        return math.inf
    return abs(h) * norm5 / math.sqrt((norm5 + 0.01 * norm3) * size) if norm5 > 0.0 else 0.0


@inner
def _past(
    y: Array, h: float, one: Tried, flags: Flags, system: System, value: float, rate: float,
    tol: float, peak: float,
) -> float:  # fmt: skip
    """Take a step and return its overshoot past a switch; see `overshoot`."""
    _step(y, h, one, flags, system, value, rate, tol)
    fill_rates(one.y1, one.rates, one.stress, flags, system, value + rate * h, rate)
    return overshoot(one.y1, one.rates, one.paces, flags, system, one.stress[0], peak)


@inner
def _turn(g0: float, d0: float, g1: float, d1: float, h: float) -> float:
    """Return where in a step a quantity has an interior maximum; 1 if it has none.

    Uses the cubic through its values and rates at both ends.
    """
    if not (d0 > 0.0 > d1):
        return 1.0
    # rate: d0 + 2 (3m - 2 d0 - d1) x + 3 (d0 + d1 - 2 m) x², m the mean rate
    m = (g1 - g0) / h
    a, b = 3.0 * (d0 + d1 - 2.0 * m), 3.0 * m - 2.0 * d0 - d1
    disc = math.sqrt(max(b * b - a * d0, 0.0))
    x = d0 / (disc - b) if disc - b > 0.0 else 0.5
    return min(max(x, 0.0), 1.0)


@inner
def _suspect(
    y: Array, stress: Array, h: float, one: Tried, flags: Flags, system: System, value: float,
    rate: float, lifts: bool,
) -> float:  # fmt: skip
    """Return the share of a step at which a switch may be passed and repassed; 1 if none."""
    k, y1, f1, first = one.k, one.y1, one.rates, 1.0
    moving = y.size - system.relax[:, :, 0].size - flags.branch.size
    for i in range(flags.branch.size):
        p, branch = system.springs[i], flags.branch[i]
        low, high, _, _ = _ends(p, branch, flags.ranks[i], flags.most[i])
        way = 1.0 if k[0, moving + i] > 0.0 else -1.0
        e0, e1, end = way * y[moving + i], way * y1[moving + i], high if way > 0.0 else -low
        d0, d1 = way * k[0, moving + i], way * f1[moving + i]
        if end < math.inf and d0 > 0.0 > d1:
            x = _turn(e0, d0, e1, d1, h)
            if max(e0, e1) + 2.0 * h * d0 * x > end:
                first = min(first, x)
        if branch in (SNAP, AGAIN, BACK):
            way = -1.0 if branch == BACK else 1.0
            for stage in range(1, 12):
                if way * k[stage, moving + i] < 0.0:
                    first = min(first, _C[stage])
    if lifts:  # rates of the base stress at both ends, by finite differences
        tiny, base0, base1, other = 1e-5 * h, stress[0], one.stress[0], np.empty(stress.size)
        fill_rates(y + tiny * k[0], one.scale, other, flags, system, value + tiny * rate, rate)
        d0 = (other[0] - base0) / tiny
        at_end = value + rate * h - tiny * rate
        fill_rates(y1 - tiny * f1, one.scale, other, flags, system, at_end, rate)
        d1 = (base1 - other[0]) / tiny
        if d0 < 0.0 < d1:
            x = _turn(-base0, -d0, -base1, -d1, h)
            if min(base0, base1) + 2.0 * h * d0 * x < 0.0:
                first = min(first, x)
    return first


@inner
def _locate(
    y: Array, h: float, high_at: float, high_past: float, stress: Array, one: Tried, flags: Flags,
    system: System, value: float, rate: float, tol: float, peak: float,
) -> tuple[float, int]:  # fmt: skip
    """Return the share of a step at which a switch is just passed, and the number of trials.

    At the share `high_at` it is passed by `high_past`. False position and bisection alternate.
    """
    low_at, trials = 0.0, 0
    low_past = min(overshoot(y, one.k[0], one.paces, flags, system, stress[0], peak), 0.0)
    for turn in range(80):
        if high_past <= 1e-16 or high_at - low_at <= 1e-15 * high_at:
            break
        mid = 0.5 * (low_at + high_at)
        if turn % 3 != 2 and low_past < high_past < math.inf:
            mid = high_at - high_past * (high_at - low_at) / (high_past - low_past)
            mid += (1e-3 if turn % 3 == 0 else 0.0) * (high_at - mid)
            if not low_at < mid < high_at:
                mid = 0.5 * (low_at + high_at)
        past = _past(y, mid * h, one, flags, system, value, rate, tol, peak)
        trials += 1
        if past > 0.0:
            high_at, high_past = mid, past
        else:
            low_at, low_past = mid, past
    return high_at, trials


@inner
def _reach(y: Array, lost: Array, moving: int, flags: Flags, springs: Array) -> None:
    """Put each spring that is within rounding of an end of its branch exactly there."""
    for i in range(flags.branch.size):
        low, high, _, _ = _ends(springs[i], flags.branch[i], flags.ranks[i], flags.most[i])
        floor = 1e-2 if flags.branch[i] < HELD else 1e-290
        for bound in (low, high):
            off = abs(y[moving + i] - bound)
            if math.isfinite(bound) and off <= 1e-15 * max(abs(bound), floor):
                y[moving + i], lost[moving + i] = bound, 0.0


@inner
def record_samples(
    y: Array, moving: int, flags: Flags, springs: Array, times: Array, now: float, done: int,
    pressure: float, nodes: Array, base: Array,
) -> int:  # fmt: skip
    """Write the samples that are due; return the number done."""
    while done < times.size and times[done] <= now:
        place = 0.0
        for i in range(springs.shape[0]):
            x, branch = y[moving + i], flags.branch[i]
            if branch >= HELD:
                x = _mixture(springs[i], branch, flags.ranks[i], flags.most[i], x)[0]
            place += springs[i, H] * x
            nodes[i, done] = place
        base[done] = pressure
        done += 1
    return done


@njit(cache=True, error_model="numpy")
def _follow(
    system: System, kinds: Integers, times: Array, tol: float, most: int,
    nodes: Array, base: Array,
) -> tuple[int, int, float]:  # fmt: skip
    """Follow a chain over the samples; fill in displacements and base stress.

    Return the kind of end, the number of steps, and the end of contact (NaN if none).
    """
    springs, values, top = system.springs, system.values, system.top
    count, groups = springs.shape[0], system.ends.size
    moving = groups if top == MASS else groups - 1
    size = moving + count + system.relax[:, :, 0].size
    y, lost = np.zeros(size), np.zeros(size)
    stress = np.empty(groups)
    one = Tried(
        np.empty((12, size)), np.empty(size), np.empty(size), np.empty(size), np.zeros(size),
        np.empty(groups), np.empty(size), np.zeros(size, np.int64), np.ones(count),
    )  # fmt: skip
    one.units[moving:] = 2
    flags = Flags(kinds.copy(), np.full(count, -math.inf), np.full(count, -math.inf))
    for i in range(count):
        if kinds[i] < HELD:
            one.units[moving + i] = 1
    struck = system.speed > 0.0
    now, done = (0.0 if struck else times[0]), 0
    if struck:
        y[groups - 1] = system.speed
        done = np.searchsorted(times, 0.0)
        nodes[count - 1, :done] = times[:done] * (
            system.speed + 0.5 * system.gravity * times[:done]
        )
    knot, steps, peak, largest = 0, 0, 0.0, 0.0
    pressed = False
    h = rate = 0.0
    value = system.gravity * system.mass[groups - 1]
    late = 0.0  # rounding error of the clock
    fresh, since = True, now
    while True:
        # samples that are due, with the preceding rate of the drive
        if done < times.size and times[done] <= now and not fresh:
            value += rate * (now - since)
            if fill_rates(y, one.k[0], stress, flags, system, value, rate):
                done = record_samples(
                    y, moving, flags, springs, times, now, done, stress[0], nodes, base
                )
        # the drive from here on
        since = now
        if not struck:
            while knot + 2 < times.size and now >= times[knot + 1]:
                knot += 1
                fresh = True
            if fresh and times.size > 1:
                rate = (values[knot + 1] - values[knot]) / (times[knot + 1] - times[knot])
            value = values[knot] + rate * (now - times[knot])
        if not fill_rates(y, one.k[0], stress, flags, system, value, rate):
            return DONE if done == times.size else FLAT, steps, math.nan
        if fresh and not struck and knot > 0 and top == MOTION:  # dashpots see the mean rate
            a, b = times[knot] - times[knot - 1], times[knot + 1] - times[knot]
            base[knot] += a / (a + b) * (stress[0] - base[knot])
        fresh = False
        if enter_branches(y, one.k[0], moving, flags, springs):
            steps += 1
            if steps > most:
                return TOO_LONG, steps, math.nan
            continue
        done = record_samples(y, moving, flags, springs, times, now, done, stress[0], nodes, base)
        if done == times.size:
            return DONE, steps, math.nan
        largest, peak = max(largest, np.abs(stress).max()), max(peak, stress[0])
        pressed = pressed or (struck and stress[0] > RISEN * largest)
        for j in range(size):
            one.reach[j] = max(one.reach[j], abs(y[j]))
        for i in range(count):
            x, pace = y[moving + i], one.k[0, moving + i]
            one.paces[i] = max(abs(pace), 1e-12 * abs(x), 1e-290)
        left = (times[done] - now) - late
        if h == 0.0:
            h = 1e-6 * (times[times.size - 1] - now)
        while True:  # until a step is short enough
            steps += 1
            if steps > most:
                return TOO_LONG, steps, math.nan
            full = h
            lands = h >= left
            if lands:
                h = left
            elif h > 0.5 * left:
                h = 0.5 * left
            error = _step(y, h, one, flags, system, value, rate, tol)
            if error <= 1.0 and _leaps(y, one.y1, moving, flags, springs):
                error = 20.0
            if error <= 1.0:
                break
            h *= max(0.9 * error**-0.125, 0.2) if error < math.inf else 0.1
            if now + 1e-3 * h == now and h < 1e-22:
                return NO_STEP, steps, math.nan
        grow = min(0.9 * max(error, 1e-30) ** -0.125, 6.0)
        following = max(full, h * grow) if h < full else h * grow
        # does a branch or contact end in this step?
        if not fill_rates(one.y1, one.rates, one.stress, flags, system, value + rate * h, rate):
            return FLAT, steps, math.nan
        lifts = peak if pressed and stress[0] > 0.0 else 0.0
        past = overshoot(one.y1, one.rates, one.paces, flags, system, one.stress[0], lifts)
        at = 1.0
        if past <= 0.0:
            first = _suspect(y, stress, h, one, flags, system, value, rate, lifts > 0.0)
            if 1e-6 < first < 1.0:
                at, steps = first, steps + 1
                past = _past(y, at * h, one, flags, system, value, rate, tol, lifts)
        hit = past > 0.0
        if hit:
            at, trials = _locate(
                y, h, at, past, stress, one, flags, system, value, rate, tol, lifts
            )
            steps += trials
        length, lands = at * h, lands and at == 1.0 and not hit
        if at < 1.0:  # the last trial may have another length
            _step(y, length, one, flags, system, value, rate, tol)
            steps += 1
        # accept the step, with compensated rounding
        for j in range(size):
            more = one.some[j] - lost[j]
            total = y[j] + more
            lost[j] = (total - y[j]) - more
            y[j] = total
        if lands:
            now, late = times[done], 0.0
        else:
            more = length + late
            total = now + more
            late = more - (total - now)
            now = total
        h = following
        if hit:
            fill_rates(y, one.rates, one.stress, flags, system, value + rate * length, rate)
            _reach(y, lost, moving, flags, springs)
            if lifts > 0.0 and one.stress[0] <= 1e-15 * peak:
                break
    # after contact the chain moves with the striker, without load
    for j in range(done, times.size):
        record_samples(
            y, moving, flags, springs, times[j : j + 1], math.inf, 0, 0.0, nodes[:, j:], base[j:]
        )
        nodes[:, j] += (times[j] - now) * (y[groups - 1] + 0.5 * system.gravity * (times[j] - now))
    return DONE, steps, now


# ------------------------------------------------------------------------------------ the judge


@dataclass(frozen=True, eq=False)
class Truth:
    """Result of the judge for a scene.

    Attributes
    ----------
    displacement : (n_springs, n_t) array, m
    base_stress : (n_t,) array, Pa
    contact_end : float or None, s
    steps : int, of the run at the tighter tolerance
    why : str, reason if there is no judgement, else ""
    unsure : float, largest difference from the run at the looser tolerance, over the range of each
        curve; NaN if there was none
    """

    displacement: Array
    base_stress: Array
    contact_end: float | None
    steps: int = 0
    why: str = ""
    unsure: float = math.nan


def over_range(one: Array, other: Array) -> float:
    """Return the largest difference of two curves over the range of the second, including 0."""
    span = max(float(other.max()), 0.0) - min(float(other.min()), 0.0)
    miss = float(np.abs(one - other).max())
    if miss == 0.0:
        return 0.0
    return miss / span if span > 0.0 and math.isfinite(miss) else math.inf


def _shares(chain: Any, drive: Any, ends: Integers) -> bool:
    """Return whether a motion may meet gaps or flat branches of several springs at one stress.

    The stress is the same whichever spring moves, so the law does not define which one moves. A
    spring that alone passes its flat branch has snapped; one that shares the motion has not.
    """
    if not hasattr(drive, "displacement"):
        return False
    for first, last in zip([0, *ends[:-1]], ends, strict=True):
        stresses = []
        for spring in chain.springs[first:last]:
            if spring.eta > 0.0:
                continue
            if not hasattr(spring, "kc"):
                stresses += [("gap", 0.0)] if spring.unilateral else []
                continue
            snap = spring.k0 * spring.eps_a / (1.0 - spring.eps_a)
            stresses += [("d", snap)] if spring.kh_plus == 0.0 else []
            stresses += [("e", snap + spring.dsigma)] if spring.kh_minus == 0.0 else []
        if len(set(stresses)) < len(stresses):
            return True
    return False


def system_of(chain: Any, drive: Any, time: Array) -> tuple[System, Integers]:
    """Return the constants of a run and the initial branches."""
    pairs = [row_of(s, h) for s, h in zip(chain.springs, chain.heights, strict=True)]
    rows, kinds = np.array([row for row, _ in pairs]), np.array([kind for _, kind in pairs])
    relaxing = [list(getattr(spring, "relaxation", ())) for spring in chain.springs]
    relax = np.tile([0.0, 1.0], (len(pairs), max(map(len, relaxing)), 1))
    for i, terms in enumerate(relaxing):
        for n, term in enumerate(terms):
            relax[i, n] = term
    above, values, top = float(chain.masses[-1]), np.zeros(time.size), MASS
    speed, gravity = float(getattr(drive, "velocity", 0.0)), float(getattr(drive, "gravity", 0.0))
    drag = chain.site_damping / math.fsum(chain.heights)
    if hasattr(drive, "velocity"):
        above += drive.mass
    elif hasattr(drive, "displacement"):
        above, values, top = 0.0, np.array(drive.displacement, float), MOTION
    else:
        values = np.array(drive.stress, float)
        top = MASS if above > 0.0 else DAMPER if drag > 0.0 else STRESS
    if values[0] != 0.0:
        raise ValueError("a drive must start at zero")
    inside = [i for i in range(len(pairs) - 1) if chain.masses[i] > 0.0]
    ends = np.array([*(i + 1 for i in inside), len(pairs)])
    mass = np.array([*(chain.masses[i] for i in inside), above]) / chain.area
    work = np.empty((4, len(pairs)))
    return System(rows, relax, ends, mass, drag, top, speed, gravity, values, work), kinds


def follow(chain: Any, drive: Any, time: Array, tol: float = TIGHT, most: int = MOST_WORK) -> Truth:
    """Follow a scene once, at one tolerance, without an estimate of the uncertainty."""
    count, time = len(chain.springs), np.ascontiguousarray(time, float)
    if not hasattr(drive, "velocity"):  # few digits of a step are left far from zero
        time = time - time[0]
    system, kinds = system_of(chain, drive, time)
    nodes, base = np.zeros((count, time.size)), np.zeros(time.size)
    memory = any(hasattr(s, "sigma_plus") or getattr(s, "relaxation", ()) for s in chain.springs)
    if not memory and _shares(chain, drive, system.ends):
        return Truth(nodes, base, None, why=SHARED)
    outcome, steps, end = _follow(system, kinds, time, tol, most // count, nodes, base)
    why = WHY[outcome]
    if not why and not (np.isfinite(nodes).all() and np.isfinite(base).all()):
        why = "not finite"
    return Truth(nodes, base, None if math.isnan(end) else end, steps, why)


def judge(chain: Any, drive: Any, time: Array, most: int = MOST_WORK) -> Truth:
    """Follow a scene at two tolerances; their difference is the uncertainty of the judgement."""
    curves = []
    for tol in (LOOSE, TIGHT):
        truth = follow(chain, drive, time, tol, most)
        if truth.why:
            return truth
        curves.append(np.vstack((truth.base_stress, truth.displacement)))
    return replace(truth, unsure=max(map(over_range, *curves)))
