"""The compiled integrator for stiff scenes: implicit collocation from switch to switch.

Light masses and heavy or very light dashpots make rates that explicit steps must follow. Here a
step is a polynomial in time through five Radau points (Radau IIA, order 9), on which the balance of
every node holds exactly:

    μ_i d²w_i/dt² + c dw_i/dt + Σ_i - Σ_{i+1} = p,      Σ_i = σ_i(ε_i) + η_i dε_i/dt

A node without mass or a spring without dashpot only lacks its term, so massless, undamped and mixed
chains are one case. The unknowns are the displacements of all nodes at the points. Newton's method
with the exact Jacobian finds them; it is block tridiagonal over the nodes, and its elimination goes
once up the chain and once down: cost grows with the number of springs. The method is L-stable:
what relaxes or vibrates too fast to be followed dies out.

No branch changes inside a step. A switch, or the end of contact, is the first crossing of the
polynomial; the step is then taken again, shorter, until it ends there.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False

from __future__ import annotations

import math

import numpy as np

from foamfit.kernels import (
    ETA,
    K0,
    KC,
    KH_MINUS,
    KH_PLUS,
    OPEN,
    Array,
    Branches,
    above,
    below,
    branch_shape,
    compiled,
    first_branch,
    interval,
    slope_on,
    stress_on,
)
from foamfit.polynomial import first_crossing, slope_at, value_at
from foamfit.taylor import (
    DONE,
    FLAT_UNDER_STRESS,
    FREE,
    MOTION,
    NOT_FINITE,
    STEP_UNDERFLOW,
    STRESS,
    TOO_MANY_STEPS,
    VISCOUS,
    fly,
    start,
)

STAGES = 5
# Steps that the error alone makes short, compared with the motion, before they may grow anyway:
# then something vibrates too fast to be worth following, and is damped out. Where that would cost
# more than the wanted error, it is followed for so many steps of one spring all the same.
SHORT, PATIENCE, LITTLE_PATIENCE, LONGEST_PATIENCE = 5e-4, 600, 60, 10_000

# Behind heavy dashpots contact ends when no more than 1e-12 of the peak of the base stress is left:
# while the striker presses it is followed with so large an error of what is left, at most.
FAINT = 1e-7
# (stopping rate)/(creep rate) from which that is so.
FAINTLY = 1e3


def radau(stages: int) -> tuple[Array, Array]:
    """Nodes c and matrix A of the Radau IIA method of order 2 stages - 1."""
    series = np.zeros(stages + 1)
    series[-2:] = 1.0, -1.0
    nodes = np.sort(0.5 * (1.0 + np.real(np.polynomial.legendre.legroots(series))))
    nodes[-1] = 1.0
    powers = np.arange(1, stages + 1)
    integrals = nodes[:, None] ** powers / powers
    values = nodes[:, None] ** (powers - 1)
    return nodes, np.asarray(np.linalg.solve(values.T, integrals.T).T, dtype=np.float64)


NODES, WEIGHTS = radau(STAGES)
# From increments at the points to their time derivatives (times the step), first and second.
RATES = np.linalg.inv(WEIGHTS)
RATES_2 = RATES @ RATES
# From increments at the points to the coefficients 1 … 5 of the polynomial over the step [0, 1].
COEFFICIENTS = np.linalg.inv(NODES[:, None] ** np.arange(1, STAGES + 1))


@compiled
def _stages(
    rows: Array,
    branches: Branches,
    heights: Array,
    eps0: Array,
    v0: Array,
    z: Array,
    span: float,
    eps: Array,
    vel: Array,
    total: Array,
    slope: Array,
) -> bool:
    """Fill strains, velocities, stresses and slopes at the points; false past the end of a branch.

    z (springs, points) is what the nodes move beyond v0 times time.
    """
    for i in range(heights.size):
        for j in range(STAGES):
            rate = 0.0
            for k in range(STAGES):
                rate += RATES[j, k] * z[i, k]
            vel[i, j] = v0[i] + rate / span
            move = z[i, j] + NODES[j] * span * v0[i]
            stretching = vel[i, j]
            if i > 0:
                move -= z[i - 1, j] + NODES[j] * span * v0[i - 1]
                stretching -= vel[i - 1, j]
            eps[i, j] = eps0[i] + move / heights[i]
            slope[i, j] = slope_on(rows[i], branches[i], eps[i, j])
            stress = stress_on(rows[i], branches[i], eps[i, j])
            if not math.isfinite(stress):
                return False
            total[i, j] = stress + rows[i, ETA] * stretching / heights[i]
    return True


@compiled
def _solve(m: Array, n: int, columns: int) -> bool:
    """Solve n equations in place, right-hand sides in the columns past n; false if singular."""
    for p in range(n):
        best = p
        for q in range(p + 1, n):
            if abs(m[q, p]) > abs(m[best, p]):
                best = q
        if not abs(m[best, p]) > 0.0:
            return False
        if best != p:
            for k in range(p, columns):
                m[p, k], m[best, k] = m[best, k], m[p, k]
        for q in range(p + 1, n):
            factor = m[q, p] / m[p, p]
            if factor != 0.0:
                for k in range(p + 1, columns):
                    m[q, k] -= factor * m[p, k]
    for k in range(n, columns):
        for p in range(n - 1, -1, -1):
            rest = m[p, k]
            for q in range(p + 1, n):
                rest -= m[p, q] * m[q, k]
            m[p, k] = rest / m[p, p]
    return True


@compiled
def _correct(
    rows: Array,
    heights: Array,
    mass: Array,
    drag: float,
    moving: int,
    span: float,
    residual: Array,
    slope: Array,
    delta: Array,
    lift: Array,
) -> bool:
    """Newton's correction `delta` of the first `moving` nodes; false if the equations are singular.

    Going up, the chain below a node acts on it through a stiffness K and a force r. Written so that
    nothing cancels: under a spring of stiffness S, (K, r) become (S D⁻¹ K, S D⁻¹ r), D = K + S.
    """
    s = STAGES
    stiff = np.zeros((s, s))  # of the chain below the node, as the node feels it
    spring = np.zeros((s, s))
    m = np.empty((s, 2 * s + 1))
    for i in range(moving):
        soft = 1e-12 * rows[i, K0]  # a flat branch: the step would have no bound, the force has
        damp = rows[i, ETA] / (heights[i] * span)
        for j in range(s):
            for k in range(s):
                spring[j, k] = damp * RATES[j, k]
            spring[j, j] += max(slope[i, j], soft) / heights[i]
        if i == 0:
            for j in range(s):
                for k in range(s):
                    stiff[j, k] = spring[j, k]
        else:
            for j in range(s):
                for k in range(s):
                    m[j, k] = stiff[j, k] + spring[j, k]
                    m[j, s + k] = stiff[j, k]
                m[j, 2 * s] = delta[i - 1, j]
            if not _solve(m, s, 2 * s + 1):
                return False
            for j in range(s):
                for k in range(s):
                    lift[i - 1, j, k] = (1.0 if j == k else 0.0) - m[j, s + k]
                delta[i - 1, j] = m[j, 2 * s]
            for j in range(s):
                for k in range(s):
                    stiff[j, k] = 0.0
                    for q in range(s):
                        stiff[j, k] += spring[j, q] * m[q, s + k]
        resist = drag if i == heights.size - 1 else 0.0
        for j in range(s):
            delta[i, j] = residual[i, j]
            for k in range(s):
                stiff[j, k] += mass[i] * RATES_2[j, k] / span**2 + resist * RATES[j, k] / span
                if i > 0:
                    delta[i, j] += spring[j, k] * delta[i - 1, k]
    last = moving - 1
    for j in range(s):
        for k in range(s):
            m[j, k] = stiff[j, k]
        m[j, s] = delta[last, j]
    if moving < heights.size:  # the spring above the last free node hangs on the driven top
        i = moving
        damp = rows[i, ETA] / (heights[i] * span)
        for j in range(s):
            for k in range(s):
                m[j, k] += damp * RATES[j, k]
            m[j, j] += max(slope[i, j], 1e-12 * rows[i, K0]) / heights[i]
    if not _solve(m, s, s + 1):
        return False
    for j in range(s):
        delta[last, j] = m[j, s]
    for i in range(last - 1, -1, -1):
        for j in range(s):
            for k in range(s):
                delta[i, j] += lift[i, j, k] * delta[i + 1, k]
    return True


@compiled
def _collocate(
    rows: Array,
    branches: Branches,
    heights: Array,
    mass: Array,
    drag: float,
    moving: int,
    eps0: Array,
    v0: Array,
    push: float,
    push_rate: float,
    span: float,
    reach: float,
    z: Array,
    eps: Array,
    vel: Array,
    total: Array,
    slope: Array,
    residual: Array,
    delta: Array,
    lift: Array,
    tally: Branches,
) -> bool:
    """Solve one step by Newton's method from the guess in z; false if it does not converge."""
    count = heights.size
    if not _stages(rows, branches, heights, eps0, v0, z, span, eps, vel, total, slope):
        for i in range(moving):
            for j in range(STAGES):
                z[i, j] = 0.0
        if not _stages(rows, branches, heights, eps0, v0, z, span, eps, vel, total, slope):
            return False
    before = math.inf
    slow = 0
    for _ in range(30):
        if moving == 0:
            return True
        for i in range(moving):
            for j in range(STAGES):
                force = -total[i, j]
                if i < count - 1:
                    force += total[i + 1, j]
                else:
                    force += push + push_rate * NODES[j] * span - drag * vel[i, j]
                if mass[i] > 0.0:
                    pull = 0.0
                    for k in range(STAGES):
                        pull += RATES_2[j, k] * z[i, k]
                    force -= mass[i] * pull / span**2
                residual[i, j] = force
        tally[0] += 1
        tally[1] += moving
        if not _correct(
            rows, heights, mass, drag, moving, span, residual, slope, delta, lift
        ):  # fmt: skip
            return False
        part, size, moved = 1.0, 0.0, 0.0
        for i in range(count):
            curved, _, x0, _ = branch_shape(rows[i], branches[i])
            for j in range(STAGES):
                gain = delta[i, j] if i < moving else 0.0
                size = max(size, abs(gain))
                if not math.isfinite(gain):
                    return False
                moved = max(moved, abs(z[i, j] + NODES[j] * span * v0[i]))
                if i > 0:
                    gain -= delta[i - 1, j]
                room = 0.9 * (1.0 - (eps[i, j] - x0))
                if curved and gain / heights[i] > room:
                    part = min(part, room * heights[i] / gain)
        for i in range(moving):
            for j in range(STAGES):
                z[i, j] += part * delta[i, j]
        if not _stages(rows, branches, heights, eps0, v0, z, span, eps, vel, total, slope):
            return False
        if part == 1.0:
            if size <= 1e-8 * moved + 1e-15 * reach:
                return True
            slow = slow + 1 if size > 0.5 * before else 0
            if slow > 5:  # near a pole corrections double before they halve
                return False
            before = size
    return False


@compiled
def _polynomial(first: float, points: Array, out: Array) -> None:
    """Coefficients over [0, 1] of the polynomial through `first` at 0 and the values at points."""
    out[0] = first
    for k in range(STAGES):
        out[k + 1] = 0.0
        for j in range(STAGES):
            out[k + 1] += COEFFICIENTS[k, j] * (points[j] - first)


@compiled
def _truncation(c: Array) -> float:
    """Size of the first Legendre term that a step's polynomial leaves out."""
    fifth = abs(c[5]) / 252.0
    fourth = abs(c[4] + 2.5 * c[5]) / 70.0
    if fifth >= fourth:
        return fifth
    return fifth * max(fifth / fourth, 0.02)


@compiled
def _base_stress(
    rows: Array,
    branches: Branches,
    heights: Array,
    eps: Array,
    first: int,
    below_top: bool,
    top: int,
    v_top: float,
    drag: float,
    push: float,
) -> float:
    """Stress that the `first` springs at the base carry together, up to the lowest node with state.

    `v_top` is the velocity of that node, if it has one.
    """
    if not below_top and top == STRESS:
        return push
    flow, rate = 0.0, v_top
    for i in range(first):
        stress = stress_on(rows[i], branches[i], eps[i])
        if rows[i, ETA] == 0.0:
            return stress
        flow += heights[i] / rows[i, ETA]
        rate += heights[i] * stress / rows[i, ETA]
    if not below_top and top == VISCOUS:
        return (rate + push / drag) / (flow + 1.0 / drag)
    return rate / flow


@compiled
def _guess(
    moves: Array, v: Array, v0: Array, moving: int, span: float, taken: float, z: Array
) -> None:
    """Fill z with the motion of the last step, of length `taken`, carried on over the next."""
    for i in range(v.size):
        ahead = i < moving and 0.0 < span <= 2.0 * taken
        last = value_at(moves[i], STAGES, 1.0)
        for j in range(STAGES):
            time = NODES[j] * span
            if ahead:
                z[i, j] = value_at(moves[i], STAGES, 1.0 + time / taken) - last - time * v0[i]
            else:
                z[i, j] = time * (v[i] - v0[i]) if i < moving else 0.0


@compiled
def _describe(
    rows: Array,
    branches: Branches,
    heights: Array,
    eps0: Array,
    base0: float,
    eps: Array,
    total: Array,
    reach: float,
    load: float,
    faint: float,
    strains: Array,
    base: Array,
    stress: Array,
    some: Array,
) -> tuple[float, float, float]:
    """Fill the polynomials of the strains and the base stress of a step.

    `reach` and `load` are the scales of motion and stress before the step. Returns the truncation
    relative to the scales, and the scales with what the step itself reaches. While the striker
    presses, `faint` weighs the truncation of the base stress relative to what is left of it.
    """
    count = heights.size
    for i in range(count):
        _polynomial(eps0[i], eps[i], strains[i])
        for j in range(STAGES):
            stress[i, j] = stress_on(rows[i], branches[i], eps[i, j])
            reach = max(reach, heights[i] * abs(eps[i, j]))
            load = max(load, abs(stress[i, j]))
    present, parts = abs(base0), 0.0
    for j in range(STAGES):
        present = max(present, abs(total[0, j]))
        parts = max(parts, abs(stress[0, j]))
    load = max(load, present)
    _polynomial(base0, total[0], base)
    error = 0.0
    if load > 0.0:
        error = _truncation(base) / load
        if faint > 0.0:  # what is left is known to the rounding of its parts
            error = max(error, faint * error * load / max(present, FAINT * parts))
    for i in range(count):
        if reach > 0.0:
            error = max(error, _truncation(strains[i]) * heights[i] / reach)
        if load > 0.0:
            _polynomial(stress_on(rows[i], branches[i], eps0[i]), stress[i], some)
            error = max(error, _truncation(some) / load)
    return error, reach, load


@compiled
def _first_event(
    rows: Array,
    branches: Branches,
    strains: Array,
    base: Array,
    slack: Array,
    struck: bool,
    pressed: bool,
) -> tuple[float, int, int]:
    """First event of a step: where in [0, 1], which spring (-1: none, the last + 1: base), side.

    A spring that starts within `slack` of the end of its branch leaves it by more than that. The
    last slack is that of the base stress, which has to rise by ten times as much before contact can
    end.
    """
    when, which, side = 1.0, -1, 0
    count = branches.size
    for i in range(count):
        low, high = interval(rows[i], branches[i])
        if abs(strains[i, 0] - low) <= slack[i]:
            low -= slack[i]
        if abs(strains[i, 0] - high) <= slack[i]:
            high += slack[i]
        at, out = first_crossing(strains[i], STAGES, low, high, 1.0)
        if out != 0 and (which < 0 or at < when):
            when, which, side = at, i, out
    if struck:
        low = 0.0 if pressed else -slack[count]
        at, out = first_crossing(base, STAGES, low, math.inf, 1.0)
        risen = pressed or value_at(base, STAGES, 0.5 * at) > 10.0 * slack[count]
        if out != 0 and at <= when and risen:
            when, which, side = at, count, out
    return when, which, side


@compiled
def _record(
    now: float,
    span: float,
    end: float,
    last: bool,
    t: Array,
    done: int,
    w: Array,
    moves: Array,
    base: Array,
    out_w: Array,
    out_s: Array,
) -> int:
    """Write the samples that a step contains; returns how many samples are done."""
    top = w.size - 1
    while done < t.size and (t[done] < end or (last and t[done] <= end)):
        at = (t[done] - now) / span
        out_s[done] = value_at(base, STAGES, at)
        if out_w.shape[0] == 1:
            out_w[0, done] = w[top] + value_at(moves[top], STAGES, at)
        else:
            for i in range(w.size):
                out_w[i, done] = w[i] + value_at(moves[i], STAGES, at)
        done += 1
    return done


@compiled
def _bounce(rows: Array, heights: Array, mass: Array, drag: float) -> float:
    """Time, roughly, for which the mass on top stays on the chain that it strikes."""
    soft, slow = 0.0, 0.0
    for i in range(heights.size):
        soft += heights[i] / rows[i, K0]
        slow = max(slow, rows[i, ETA] / rows[i, K0])
    return math.sqrt(mass[-1] * soft) + drag * soft + slow


@compiled
def hurry_of(
    rows: Array,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    speed: float,
    t: Array,
) -> tuple[float, float]:
    """How much faster than the scene its fastest vibration and its fastest relaxation are.

    Both are rates times duration, estimated row by row from the masses, dashpots and slopes of the
    springs: what steps that must follow every rate have to go through. Arguments as in
    `integrate_implicit`.
    """
    vibration, relaxation = 0.0, 0.0
    below_stiff, below_damp = 0.0, 0.0
    i0 = 0
    for g in range(ends.size):
        soft = 0.0  # compliance of the springs without dashpot; the others start as rigid
        flow = 0.0
        for i in range(i0, ends[g]):
            slope = max(rows[i, K0], rows[i, KC], rows[i, KH_PLUS])
            if rows[i, ETA] == 0.0:
                soft += heights[i] / slope
            flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
        stiff = 1.0 / soft if soft > 0.0 else 0.0
        damp = 0.0 if flow == math.inf else 1.0 / flow
        for i in range(i0, ends[g]):
            slope = max(rows[i, K0], rows[i, KC], rows[i, KH_PLUS])
            if rows[i, ETA] == 0.0 or ends[g] - i0 == 1:
                if soft == 0.0:
                    stiff = slope / heights[i]
                continue
            rest = heights[i] * stiff
            relaxation = max(relaxation, (slope + rest) / rows[i, ETA])
        if g > 0:
            relaxation = max(relaxation, (below_damp + damp) / mass[g - 1])
            vibration = max(vibration, math.sqrt((below_stiff + stiff) / mass[g - 1]))
        below_stiff, below_damp = stiff, damp
        i0 = ends[g]
    if top == FREE:
        relaxation = max(relaxation, (below_damp + drag) / mass[-1])
        vibration = max(vibration, math.sqrt(below_stiff / mass[-1]))
    elif top == VISCOUS:
        relaxation = max(relaxation, below_stiff / drag)
        if below_damp > 1e4 * drag:  # explicit steps take the velocity from what little is left
            relaxation = math.inf
    duration = t[t.size - 1] - (0.0 if speed > 0.0 else t[0])
    if speed > 0.0:
        duration = min(duration, _bounce(rows, heights, mass, drag))
    return vibration * duration, relaxation * duration


@compiled
def parts_faintly(rows: Array, heights: Array, mass: float) -> bool:
    """Tell whether dashpots stop a striker long before the springs throw it back.

    With the rates a = k/c of creep and b = c/m of stopping, contact ends where the base stress has
    fallen to (a/b)² of its peak: explicit steps, whose error is relative to the peak, lose it.
    """
    soft, flow = 0.0, 0.0
    for i in range(heights.size):
        if rows[i, ETA] == 0.0:
            return False
        soft += heights[i] / rows[i, K0]
        flow += heights[i] / rows[i, ETA]
    return soft > FAINTLY * flow * flow * mass


@compiled
def _ringing(
    rows: Array, heights: Array, ends: Branches, mass: Array, drag: float, top: int
) -> Array:
    """Vibration of each mass between fixed neighbours: (masses, 2) rates 1/s, of it and its decay.

    Where the dashpots are too heavy for a vibration, (Σ c)² >= 4 μ Σ k, its rate is zero; else it
    dies out as exp(-Σ c t/(2 μ)).
    """
    rates = np.zeros((ends.size, 2))
    below_stiff, below_damp = 0.0, 0.0
    i0 = 0
    for g in range(ends.size + 1):
        stiff, damp = 0.0, 0.0
        if g < ends.size and not (g == ends.size - 1 and top == STRESS):
            soft, flow = 0.0, 0.0
            for i in range(i0, ends[g]):
                slope = max(max(rows[i, K0], rows[i, KC]), max(rows[i, KH_PLUS], rows[i, KH_MINUS]))
                soft += heights[i] / slope
                flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
            stiff, damp = 1.0 / soft, (0.0 if flow == math.inf else 1.0 / flow)
            i0 = ends[g]
        if g > 0 and (g < ends.size or top == FREE):
            hold = below_damp + damp + (drag if g == ends.size else 0.0)
            if hold**2 < 4.0 * mass[g - 1] * (below_stiff + stiff):
                rates[g - 1, 0] = math.sqrt((below_stiff + stiff) / mass[g - 1])
                rates[g - 1, 1] = 0.5 * hold / mass[g - 1]
        below_stiff, below_damp = stiff, damp
    return rates


@compiled
def _rings(rates: Array, span: float) -> bool:
    """Tell whether a mass vibrates too fast for a step and goes on vibrating after it."""
    for g in range(rates.shape[0]):
        if rates[g, 0] * span > 0.5 and rates[g, 1] * span < 20.0:
            return True
    return False


@compiled
def _passed_over(
    rows: Array,
    branches: Branches,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    eps0: Array,
    z: Array,
    span: float,
    wait: float,
    alive: Array,
    begun: Array,
    fading: Array,
) -> tuple[float, float, float, float]:
    """Vibrations that steps were too long to show: motion, stress; rate and decay of a new one.

    A mass whose velocity differs by δv from that at which the polynomial of the step sets out
    vibrates from then on by δv/ω, of which the points of the step show no more than δv/ω/(ω span).
    `begun` is filled with δv/√ω of each mass; that of earlier steps is in `alive`, since a
    vibration whose stiffness changes slowly keeps its energy over its frequency. `fading` is filled
    with the rate at which it dies out: the slowest vibration of masses in a row decays last, and
    moves as far as all of them together. What is left after `wait` is returned.
    """
    moved, pressed, rate, decay, worst = 0.0, 0.0, 0.0, 0.0, 0.0
    below_stiff, below_damp = 0.0, 0.0
    i0 = 0
    row = math.sin(0.5 * math.pi / max(ends.size, 2))
    for g in range(ends.size + 1):
        stiff, damp = 0.0, 0.0
        if g < ends.size and not (g == ends.size - 1 and top == STRESS):
            soft, flow = 0.0, 0.0
            for i in range(i0, ends[g]):
                soft += heights[i] / slope_on(rows[i], branches[i], eps0[i])
                flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
            stiff, damp = 1.0 / soft, (0.0 if flow == math.inf else 1.0 / flow)
            i0 = ends[g]
        if g > 0 and (g < ends.size or top == FREE) and below_stiff + stiff > 0.0:
            hold = below_damp + damp + (drag if g == ends.size else 0.0)
            own = math.sqrt((below_stiff + stiff) / mass[g - 1])
            fade = 0.5 * hold / mass[g - 1]
            begun[g - 1], fading[g - 1] = 0.0, 2.0 * row * row * fade
            if own * span > 2.0 and fade < own:
                kick = 0.0
                for j in range(STAGES):
                    kick += COEFFICIENTS[0, j] * z[ends[g - 1] - 1, j] / span
                begun[g - 1] = abs(kick) / math.sqrt(own)
                if begun[g - 1] > worst:
                    worst, rate, decay = begun[g - 1], own, fading[g - 1]
            size = (alive[g - 1] + begun[g - 1]) / math.sqrt(own)
            size *= math.exp(-fading[g - 1] * wait)
            moved += size
            pressed = max(pressed, max(below_stiff, stiff) * size)
        below_stiff, below_damp = stiff, damp
    return moved, pressed, rate, decay


@compiled
def integrate_implicit(
    rows: Array,
    heights: Array,
    ends: Branches,
    mass: Array,
    drag: float,
    top: int,
    values: Array,
    speed: float,
    t: Array,
    tol: float,
    max_steps: int,
    out_w: Array,
    out_s: Array,
    log: Array,
    tally: Branches,
    wanted: float,
    lost: Array,
) -> tuple[int, float, int, int]:
    """Integrate a chain from rest (or struck) over the samples t, by implicit steps.

    All but the last arguments are those of `foamfit.taylor.integrate`, as are the outcomes; `tol`
    is the truncation of a step relative to the motion so far. `tally` (2,) is filled with the
    linear systems solved and with the blocks eliminated in them; `lost` (1,) with the size,
    relative to the motion and stress, of the vibrations that were damped out because they could not
    be followed. Those above `wanted` are followed longer.

    Returns
    -------
    tuple
        Outcome, end of contact (NaN if none), steps taken, switches (also those past the log).
    """
    count, groups = rows.shape[0], ends.size
    moving = count - 1 if top == MOTION else count
    areal = np.zeros(count)
    for g in range(groups):
        if g < groups - 1 or top == FREE:
            areal[ends[g] - 1] = mass[g]
    shape = (count, STAGES)
    z, eps, vel, total, slope = (
        np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape),
    )  # fmt: skip
    slack = np.zeros(count + 1)
    residual, delta, lift = np.zeros(shape), np.zeros(shape), np.zeros((count, STAGES, STAGES))
    moves = np.zeros((count, STAGES + 1))  # polynomials of the last step: nodes, strains, base
    strains = np.zeros((count, STAGES + 1))
    base, some = np.zeros(STAGES + 1), np.zeros(STAGES + 1)
    w, v0, v, eps0 = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    branches = np.empty(count, np.int64)
    for i in range(count):
        branches[i] = first_branch(rows[i])
    struck = speed > 0.0
    now = 0.0 if struck else t[0]
    done = 0
    while struck and done < t.size and t[done] < 0.0:  # the striker is still on its way
        out_s[done] = 0.0
        for i in range(out_w.shape[0]):
            out_w[i, done] = speed * t[done] if i == out_w.shape[0] - 1 else 0.0
        done += 1
    if struck:
        v0[count - 1] = v[count - 1] = speed
    else:
        state, strain = np.zeros((groups, 1)), np.zeros((count, 1))
        start(rows, branches, heights, ends, top, values[0], state, strain)
        node = 0.0
        for i in range(count):
            eps0[i] = strain[i, 0]
            node += heights[i] * eps0[i]
            if i >= (ends[groups - 2] if groups > 1 else 0):
                w[i] = node
    pace = t[t.size - 1] - now
    if struck:
        pace = min(pace, 5.0 * _bounce(rows, heights, areal, drag))
    short = SHORT * pace * (tol / 3e-8) ** (1.0 / 6.0)
    ringing = _ringing(rows, heights, ends, mass, drag, top)
    fast = ringing[:, 0].max() > 0.0
    faint = 0.0
    if struck and parts_faintly(rows, heights, mass[groups - 1]):
        faint = min(1.0, tol / FAINT)
    lost[0], burst = 0.0, 0.0
    alive, begun, fading = np.zeros(groups), np.zeros(groups), np.zeros(groups)
    seen, passed_w, passed_s = 0.0, 0.0, 0.0  # what lost[0] is made of
    w_scale, s_scale, pressed, knot, switches, rate = 0.0, 0.0, False, -1, 0, 0.0
    contact_end = math.nan
    hurry, shorts, floor, stalled = 0, 0, 0.0, 0
    proposal, taken, worst = 0.0, 0.0, 1.0  # worst: the largest error let pass, over tol
    for i in range(count):
        s_scale = max(s_scale, abs(stress_on(rows[i], branches[i], eps0[i])))
        w_scale = max(w_scale, heights[i] * abs(eps0[i]))
    step = 0
    while step < max_steps:
        if done == t.size:
            return DONE, contact_end, step, switches
        horizon = t[t.size - 1]
        push, push_rate = 0.0, 0.0
        fresh = False
        if not struck:
            while knot < t.size - 2 and (knot < 0 or now >= t[knot + 1]):
                knot += 1
                fresh = True
            if t.size > 1:
                horizon = t[knot + 1]
                new_rate = (values[knot + 1] - values[knot]) / (t[knot + 1] - t[knot])
            else:
                knot, new_rate = 0, 0.0
            if top == MOTION:
                v0[count - 1] = v[count - 1] = new_rate
                if fresh:  # rounding does not pile up
                    eps0[count - 1] += (values[knot] - w[count - 1]) / heights[count - 1]
                    w[count - 1] = values[knot]
            else:
                push_rate = new_rate
                push = values[knot] + new_rate * (now - t[knot])
            if fresh and knot > 0 and top == MOTION and groups == 1:
                flow = 0.0  # dashpots feel the kink in the motion
                for i in range(count):
                    flow += heights[i] / rows[i, ETA] if rows[i, ETA] > 0.0 else math.inf
                before, after = t[knot] - t[knot - 1], t[knot + 1] - t[knot]
                out_s[knot] += before / (before + after) * (new_rate - rate) / flow
            rate = new_rate
        if top == STRESS:
            for i in range(ends[groups - 2] if groups > 1 else 0, count):
                if rows[i, ETA] == 0.0 and slope_on(rows[i], branches[i], eps0[i]) == 0.0:
                    return FLAT_UNDER_STRESS, contact_end, step, switches
        first = ends[0]
        base0 = _base_stress(
            rows, branches, heights, eps0, first, groups > 1, top,
            0.0 if groups == 1 and top in (STRESS, VISCOUS) else v0[first - 1], drag, push,
        )  # fmt: skip
        if horizon <= now:  # a single sample, or the last one
            for j in range(done, t.size):
                out_s[j] = base0
                for i in range(out_w.shape[0]):
                    out_w[i, j] = w[i if out_w.shape[0] > 1 else count - 1]
            return DONE, contact_end, step, switches
        span = horizon - now
        if proposal > 0.0:
            span = min(span, proposal)
        elif struck:
            span = min(span, 0.02 * pace)
        longest = span
        wait = 0.0  # until the next sample
        if fast:
            after = done
            while after < t.size - 1 and t[after] <= now:
                after += 1
            wait = max(t[after] - now, 0.0)
        target, side, level = -1, 0, 0.0  # what the step is to end at: a spring, or `count`: base
        arrived, chased, tries = False, 0, 0
        trial_span, trial_error = math.inf, math.inf  # to see whether shorter steps are better
        while True:
            tries += 1
            if now + span <= now or tries > 200:
                if chased > 0:  # the crossing is here, within rounding
                    arrived, span = True, 0.0
                    break
                for i in range(count):
                    curved, _, x0, _ = branch_shape(rows[i], branches[i])
                    if curved and 1.0 - (eps0[i] - x0) < 1e-3:
                        return NOT_FINITE, contact_end, step, switches
                return STEP_UNDERFLOW, contact_end, step, switches
            _guess(moves, v, v0, moving, span, taken, z)
            if not _collocate(
                rows, branches, heights, areal, drag, moving, eps0, v0, push, push_rate, span,
                w_scale, z, eps, vel, total, slope, residual, delta, lift, tally,
            ):  # fmt: skip
                if chased > 0:
                    target, side, chased = -1, 0, 0
                span *= 0.3
                longest = span
                continue
            error, reach, load = _describe(
                rows, branches, heights, eps0, base0, eps, total, w_scale, s_scale,
                faint if pressed else 0.0,
                strains, base, residual, some,
            )  # fmt: skip
            if chased == 0:
                error /= tol
                factor = 0.9 * max(error, 1e-12) ** (-1.0 / 6.0)
                if not math.isfinite(error):
                    span *= 0.3
                    longest = span
                    continue
                stuck = False  # rounding, or a layer thinner than the clock can tell
                if error > 1.0 and span <= 1e-6 * trial_span:
                    stuck = error > 0.3 * trial_error
                    trial_span, trial_error = span, error
                elif trial_span == math.inf:
                    trial_span, trial_error = span, error
                stuck = stuck or now + 0.1 * span <= now
                rings = error > 1.0 and _rings(ringing, span)
                if error > 1.0 and not stuck and span <= floor * (1.0 + 1e-9):
                    patient = shorts * count < LONGEST_PATIENCE
                    if rings and patient and seen - burst + error * tol > 0.3 * wanted:
                        floor, hurry = 0.0, -4 * PATIENCE
                if error > 1.0 and not stuck and span > floor * (1.0 + 1e-9):
                    span = max(span * min(max(factor, 0.1), 0.9), floor)
                    longest = span
                    continue
                if error > 1.0 and rings and error * tol > burst:
                    seen += error * tol - burst
                    burst = error * tol
                elif error <= 1.0:
                    burst = 0.0
                if fast and floor == 0.0 and not stuck:
                    moved, pressing, vibration, decay = _passed_over(
                        rows, branches, heights, ends, mass, drag, top, eps0, z, span, wait,
                        alive, begun, fading,
                    )  # fmt: skip
                    size = max(moved / reach, pressing / load) if moved > 0.0 else 0.0
                    left = LONGEST_PATIENCE // count - shorts
                    if size > 0.1 * wanted and vibration > 0.0 and decay * left > 10.0 * vibration:
                        span = 1.0 / vibration  # it dies out soon enough to be followed
                        longest = span
                        continue
                proposal = max(span * min(max(factor, 0.2), 5.0), floor)
                if error > 1.0:
                    proposal = max(proposal, 2.0 * span)
                worst = max(worst, error)
            for i in range(count):
                slack[i] = max(1e-12, tol * reach / heights[i])
            slack[count] = min(worst * tol, 1e-3) * load
            when, which, where = _first_event(
                rows, branches, strains, base, slack, struck, pressed
            )  # fmt: skip
            if target >= 0:
                value = total[0, STAGES - 1] if target == count else eps[target, STAGES - 1]
                fine = 1e-13 * (abs(base0) if target == count else max(1.0, abs(level)))
                same = which < 0 or which == target or when > 1.0 - 1e-9
                if same and abs(value - level) <= fine:
                    arrived = True
                    break
                if same and chased > 12:
                    arrived = abs(value - level) <= 1e5 * fine
                    break
                if which < 0:  # a little further
                    pace_out = slope_at(base if target == count else strains[target], STAGES, 1.0)
                    more = (level - value) / pace_out if pace_out * side > 0.0 else math.inf
                    if not (1.0 + more) * span < longest:
                        break  # it turned back: nothing was crossed
                    span *= 1.0 + more
                    chased += 1
                    continue
            if which < 0:
                break
            target, side, level = which, where, 0.0
            if which < count:
                low, high = interval(rows[which], branches[which])
                level = high if where > 0 else low
            ending = base if which == count else strains[which]
            beyond = value_at(ending, STAGES, 0.5 * when) - level
            near = abs(ending[0] - level) <= slack[which] and beyond * where >= 0.0
            if now + when * span <= now or near:
                arrived, span = True, 0.0
                break
            if when >= 1.0 - 1e-15:
                arrived = True
                break
            span *= when
            chased += 1
        if span > 0.0 and now + span > now:
            step += 1
            stalled = 0
            end = now + span
            last = span >= horizon - now or end >= horizon
            if last:
                end = horizon
            if fast:
                moved, pressing, _, _ = _passed_over(
                    rows, branches, heights, ends, mass, drag, top, eps0, z, span, wait,
                    alive, begun, fading,
                )  # fmt: skip
                passed_w, passed_s = max(passed_w, moved), max(passed_s, pressing)
                for g in range(groups):
                    alive[g] = (alive[g] + begun[g]) * math.exp(-fading[g] * span)
            for i in range(count):
                for j in range(STAGES):
                    residual[i, j] = z[i, j] + NODES[j] * span * v0[i]
                _polynomial(0.0, residual[i], moves[i])
            leaves_here = arrived and target == count
            done = _record(now, span, end, last, t, done, w, moves, base, out_w, out_s)
            for i in range(count):
                w[i] += residual[i, STAGES - 1]
                eps0[i] = eps[i, STAGES - 1]
                v[i] = vel[i, STAGES - 1]
                if areal[i] > 0.0:
                    v0[i] = v[i]
                w_scale = max(w_scale, heights[i] * abs(eps0[i]))
                s_scale = max(s_scale, abs(stress_on(rows[i], branches[i], eps0[i])))
            if top != STRESS:
                w_scale = max(w_scale, abs(w[count - 1]))
            s_scale = max(s_scale, abs(total[0, STAGES - 1]))
            lost[0] = seen
            if passed_s > 0.0:
                lost[0] += max(passed_w / w_scale, passed_s / s_scale)
            now = end
            taken = span
            if not leaves_here and total[0, STAGES - 1] > 10.0 * slack[count]:
                pressed = True
            # steps that only the error keeps short
            if proposal < short and not last:
                hurry += 1
                shorts += 1
                if hurry > (PATIENCE if shorts < 3 * PATIENCE else LITTLE_PATIENCE):
                    floor = max(2.0 * floor, 2.0 * span)
                    floor = min(floor, short)
                    proposal = max(proposal, floor)
            elif proposal >= short:
                hurry, floor = 0, 0.0
        else:
            stalled += 1
            if stalled > 4 * count + 8:
                return STEP_UNDERFLOW, contact_end, step, switches
        if not arrived:
            continue
        leaves = target == count
        if not leaves:
            for i in range(count):
                low, high = interval(rows[i], branches[i])
                out, level = 0, 0.0
                if i == target:
                    out = side
                elif span > 0.0:
                    tilt = slope_at(strains[i], STAGES, 1.0)
                    if tilt > 0.0 and eps0[i] >= high - 1e-12:
                        out = 1
                    elif tilt < 0.0 and eps0[i] <= low + 1e-12:
                        out = -1
                if out == 0:
                    continue
                entered = above(branches[i]) if out > 0 else below(branches[i])
                if entered == OPEN and i < first and rows[i, ETA] == 0.0:
                    leaves = leaves or (struck and pressed)  # nothing presses on the base now
                if switches < log.shape[0]:
                    log[switches, 0], log[switches, 1] = now, i
                    log[switches, 2], log[switches, 3] = branches[i], entered
                    log[switches, 4] = high if out > 0 else low
                switches += 1
                branches[i] = entered
        if leaves:
            w_end = np.zeros(out_w.shape[0])
            for i in range(count):
                w_end[i if out_w.shape[0] > 1 else 0] = w[i]
            fly(out_w, out_s, t, done, now, w_end, v[count - 1])
            return DONE, now, step, switches
    return TOO_MANY_STEPS, contact_end, max_steps, switches
