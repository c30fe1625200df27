"""The bistable spring (eqs. 1-5) and the linear one, as laws of the stepper."""

import math

import numpy as np
from contract import (
    BRANCH, BY, HIGH, LOW, MISS, SLOPE, TURNS, Law, beginning, evaluating, switching,
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
def evaluate(row, memory, eps, x, want, out):
    branch, k0, kc = memory[BRANCH], row[0], row[1]
    out[MISS] = 0.0
    if branch == A or branch == C:
        k, r = (k0, eps) if branch == A else (kc, eps - row[EPS_STAR])
        q = 1.0 / (1.0 - r)
        out[SLOPE] = slope = k * q * q
        sigma = k * r * q if r < 1.0 else math.inf
    else:
        slope = row[5] if branch == D else row[6]
        r = eps - (row[3] if branch == D else row[4])
        out[SLOPE], sigma = slope, (row[SIGMA_A] if branch == D else row[SIGMA_C]) + slope * r
        q = 0.0
    if want:
        for c in range(7):
            out[BY + c] = 0.0
        if branch == A:
            out[BY] = r * q
            return sigma
        one = 1.0 / (1.0 - row[3])
        by_k0, by_a = row[3] * one, k0 * one * one  # of σ_a
        if branch == D:
            out[BY], out[BY + 3], out[BY + 5] = by_k0, by_a - slope, r
        elif branch == E:
            out[BY], out[BY + 2], out[BY + 3] = by_k0, 1.0, by_a
            out[BY + 4], out[BY + 6] = -slope, r
        else:
            stiff = 1.0 / (kc + row[SIGMA_C])
            back = slope * kc * stiff * stiff  # -dσ/dε dε_*/dσ_c
            out[BY], out[BY + 2], out[BY + 3] = back * by_k0, back, back * by_a
            out[BY + 1] = r * q - slope * row[SIGMA_C] * stiff * stiff
            out[BY + 4] = -slope
    return sigma


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
