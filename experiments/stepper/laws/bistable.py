"""The bistable spring (eqs. 1-5) and the linear one, as laws of the stepper."""

import math

import numpy as np
from contract import (
    BRANCH,
    BY,
    HIGH,
    LOW,
    MISS,
    OF_LAW,
    SLOPE,
    TURNS,
    Law,
    beginning,
    evaluating,
    past,
    switching,
)  # fmt: skip

NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus")
A, D, C, E = range(4)
HAT_A, HAT_C, TABLE, WIDE = 10, 11, 12, 24  # columns


def fill(k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus):
    """Return the row: parameters, σ_a, σ̄_c, ε_*, ε̂_a (-inf: none), ε̂_c."""
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + dsigma
    star = eps_c - sigma_c / (kc + sigma_c)
    # c = d from C2 on, and a = e from A1 on: the roots that do not cancel
    gap, u = kh_plus * (eps_c - eps_a) - dsigma, kc / (kc + sigma_c)
    b = kc - u * u * kh_plus + u * gap
    root = math.sqrt(b * b + 4.0 * u**3 * kh_plus * gap)
    y = 2.0 * u * u * gap / (b + root) if b >= 0.0 else (root - b) / (2.0 * u * kh_plus)
    fall, v = kh_minus * (eps_c - eps_a) - dsigma, 1.0 - eps_a
    b = v * v * kh_minus + v * fall - k0
    square, hat_a = b * b - 4.0 * v**3 * kh_minus * fall, -math.inf
    if fall == 0.0:
        hat_a = eps_a
    elif b < 0.0 and square >= 0.0:
        hat_a = eps_a - 2.0 * v * v * fall / (math.sqrt(square) - b)
    own = (k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus)
    # of each branch: slope, origins of strain and stress, and their derivatives
    zero, one = np.zeros(7), np.eye(7)
    of_a = eps_a / v * one[0] + k0 / (v * v) * one[3]
    of_c, stiff = of_a + one[2], kc + sigma_c
    of_star = one[4] - (kc * of_c - sigma_c * one[1]) / stiff**2
    table = [
        (k0, 0.0, 0.0, *one[0], *zero, *zero), (kh_plus, eps_a, sigma_a, *one[5], *one[3], *of_a),
        (kc, star, 0.0, *one[1], *of_star, *zero), (kh_minus, eps_c, sigma_c, *one[6], *one[4], *of_c),
    ]  # fmt: skip
    return np.array([*own, sigma_a, sigma_c, star, hat_a, eps_c + y, *np.ravel(table)])


@evaluating
def evaluate(row, memory, eps, x, count, want, out):
    branch = memory[BRANCH]
    line = past(row, TABLE + int(branch) * WIDE)
    sigma, slope = past(out, OF_LAW * count), past(out, SLOPE * count)
    factor = past(out, MISS * count)  # of the derivative of the slope; an explicit law has no miss
    k, origin, start = line[0], line[1], line[2]
    if branch == A or branch == C:
        for j in range(count):
            r = eps[j] - origin
            q = 1.0 / (1.0 - r)
            sigma[j] = k * r * q if r < 1.0 else math.inf
            slope[j], factor[j] = k * q * q, r * q
    else:
        for j in range(count):
            r = eps[j] - origin
            sigma[j], slope[j], factor[j] = start + k * r, k, r
    if want:
        for j in range(count):
            for c in range(7):
                by = line[3 + c] * factor[j] - line[10 + c] * slope[j] + line[17 + c]
                out[(BY + c) * count + j] = by
    return 0.0


@switching
def switch(row, memory, eps, x, up, out):
    branch = memory[BRANCH]
    if up:
        branch = D if branch == A else C
    else:
        branch = E if branch == C else A
    memory[BRANCH] = branch
    memory[LOW], memory[HIGH] = -math.inf, math.inf
    if branch == A:
        memory[HIGH] = row[3]
    elif branch == D:
        memory[LOW], memory[HIGH] = row[3], row[HAT_C]
    elif branch == C:
        memory[LOW] = row[4]
    else:
        memory[LOW], memory[HIGH] = row[HAT_A], row[4]
    return x


@beginning
def begin(row, memory):
    memory[BRANCH], memory[TURNS] = A, 0.0
    memory[LOW], memory[HIGH] = -math.inf, row[3]
    return 0.0


LAW = Law(fill, NAMES, False, (evaluate.address, switch.address, begin.address))
