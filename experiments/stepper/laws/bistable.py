"""The bistable spring (eqs. 1-5) and the linear one, as laws of the stepper."""

import math

import numpy as np
from contract import (
    BRANCH, BY, HIGH, LOW, MISS, OF_LAW, SLOPE, TURNS, Law, beginning, evaluating, past, switching,
)  # fmt: skip

NAMES = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus")
A, D, C, E = range(4)
SIGMA_A, SIGMA_C, EPS_STAR, HAT_A, HAT_C = range(7, 12)


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
    return np.array([*own, sigma_a, sigma_c, star, hat_a, eps_c + y])


@evaluating
def evaluate(row, memory, eps, x, count, want, out):
    branch, k0, kc = memory[BRANCH], row[0], row[1]
    sigma, slope = past(out, OF_LAW * count), past(out, SLOPE * count)
    curved = branch == A or branch == C
    if curved:
        k, origin = (k0, 0.0) if branch == A else (kc, row[EPS_STAR])
        for j in range(count):
            r = eps[j] - origin
            q = 1.0 / (1.0 - r)
            sigma[j] = k * r * q if r < 1.0 else math.inf
            slope[j] = k * q * q
    else:
        k, origin, start = row[5], row[3], row[SIGMA_A]
        if branch == E:
            k, origin, start = row[6], row[4], row[SIGMA_C]
        for j in range(count):
            sigma[j], slope[j] = start + k * (eps[j] - origin), k
    if want == 0:
        return 0.0
    for j in range(count):
        out[MISS * count + j] = 0.0
    # of slope k, strain origin and stress origin
    one, stiff = 1.0 / (1.0 - row[3]), 1.0 / (kc + row[SIGMA_C])
    for c in range(7):
        on_k = on_origin = on_start = 0.0
        of_a = row[3] * one if c == 0 else k0 * one * one if c == 3 else 0.0
        of_c = of_a + (1.0 if c == 2 else 0.0)
        if branch == A:
            on_k = 1.0 if c == 0 else 0.0
        elif branch == D:
            on_k, on_origin, on_start = (1.0 if c == 5 else 0.0), (1.0 if c == 3 else 0.0), of_a
        elif branch == E:
            on_k, on_origin, on_start = (1.0 if c == 6 else 0.0), (1.0 if c == 4 else 0.0), of_c
        else:
            on_k = (1.0 if c == 1 else 0.0)
            on_origin = (1.0 if c == 4 else 0.0) - (kc * of_c - row[SIGMA_C] * on_k) * stiff * stiff
        by = past(out, (BY + c) * count)
        for j in range(count):
            on = sigma[j] / k if curved else eps[j] - origin
            by[j] = on * on_k - slope[j] * on_origin + on_start
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
