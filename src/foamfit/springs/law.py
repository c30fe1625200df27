"""Formulas of the seven-parameter law (eqs. 2, 4 and 5) and of the microscale law.

They are plain Python functions of numbers, which are also compiled in `springs.compiled`.
"""

from __future__ import annotations

import math


def derived_points(
    k0: float, kc: float, dsigma: float, eps_a: float, eps_c: float, kh_plus: float, kh_minus: float
) -> tuple[float, float, float, float, float]:
    """Return σ_a and σ̄_c (Pa), ε_*, ε̂_a (-inf: e never meets a) and ε̂_c (eqs. 4 and 5).

    Both quadratic equations are written relative to the known end of the branch (C2 for ε̂_c, A1 for
    ε̂_a), so that their coefficients contain no difference of nearly equal numbers.
    """
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    sigma_c = sigma_a + dsigma
    eps_star = eps_c - sigma_c / (kc + sigma_c)

    # Eq. 5, c = d. With y = ε - ε_c and u = 1 - (ε_c - ε_*) = kc/(kc + σ̄_c):
    # u kh+ y² + (kc - u² kh+ + u gap) y - u² gap = 0, one root y >= 0.
    gap = kh_plus * (eps_c - eps_a) - dsigma
    u = kc / (kc + sigma_c)
    b = kc - u * u * kh_plus + u * gap
    root = math.sqrt(b * b + 4.0 * u * kh_plus * u * u * gap)
    y = 2.0 * u * u * gap / (b + root) if b >= 0.0 else (root - b) / (2.0 * u * kh_plus)

    # Eq. 4, a = e. With z = ε_a - ε and v = 1 - ε_a:
    # v kh- z² + (v² kh- + v fall - k0) z + v² fall = 0, the smaller root z >= 0, if any.
    fall = kh_minus * (eps_c - eps_a) - dsigma
    v = 1.0 - eps_a
    b = v * v * kh_minus + v * fall - k0
    discriminant = b * b - 4.0 * v * kh_minus * v * v * fall
    if fall == 0.0:
        eps_hat_a = eps_a
    elif b < 0.0 and discriminant >= 0.0:
        eps_hat_a = eps_a - 2.0 * v * v * fall / (math.sqrt(discriminant) - b)
    else:
        eps_hat_a = -math.inf
    return sigma_a, sigma_c, eps_star, eps_hat_a, eps_c + y


def admissible(
    k0: float, kc: float, dsigma: float, eps_a: float, eps_c: float, kh_plus: float, kh_minus: float
) -> bool:
    """Return whether the seven parameters are admissible (docs/theory.md).

    The other conditions follow from these: branch d lies above C2 and branch e below A1.
    """
    return (
        0.0 < k0 < math.inf
        and 0.0 < kc < math.inf
        and 0.0 < eps_a < 1.0
        and eps_a < eps_c < math.inf
        and -k0 * eps_a / (1.0 - eps_a) < dsigma <= 0.0
        and 0.0 <= kh_plus < math.inf
        and 0.0 <= kh_minus < math.inf
    )


def most_beyond(k: float, kc: float, n: float) -> tuple[float, float]:
    """Return the least ε_* with which branch c never lies before branch a, and its stress.

    It is the maximum over σ of the difference
    f(σ) = a(σ; k) - σ/(kc+σ) with a = 1 - (1 + nσ/k)^(-1/n). It rises where
    g(σ) = 2 ln(kc+σ) - ln(k kc) - (1+1/n) ln(1+nσ/k) is positive; g turns once at most, so f has
    one maximum at most.
    """
    if n == 1.0:
        one, other = math.sqrt(k), math.sqrt(kc)
        return max(0.0, (other - one) / (other + one)), one * other

    def rises(sigma: float) -> float:
        gains = 2.0 * math.log(kc + sigma) - math.log(k) - math.log(kc)
        return gains - (1.0 + 1.0 / n) * math.log1p(n * sigma / k)

    turn = ((1.0 + n) * kc - 2.0 * k) / (n - 1.0)  # of g
    if n > 1.0:  # g falls up to its turn, and is negative there
        if kc <= k:
            return 0.0, 0.0
        low, high = 0.0, turn
    else:  # g rises up to its turn, if that is at a stress at all, and falls without end
        low = max(turn, 0.0)
        if rises(low) <= 0.0:
            return 0.0, 0.0
        high = max(low, k, kc)
        while rises(high) > 0.0 and high < 1e300:
            high *= 2.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        if rises(middle) > 0.0:
            low = middle
        else:
            high = middle
    sigma = 0.5 * (low + high)
    excess = -math.expm1(-math.log1p(n * sigma / k) / n) - sigma / (kc + sigma)
    return max(excess, 0.0), sigma
