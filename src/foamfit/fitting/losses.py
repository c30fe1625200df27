"""Losses that give way to large residuals."""

from __future__ import annotations

import numpy as np

from foamfit.arrays import Array

# Losses, and the residual (in units of the scale) past which each gives way: those of 95 %
# efficiency under normal noise for Huber's and Cauchy's (Holland & Welsch 1977, Commun. Stat. A6,
# 813).
LOSSES = {"linear": np.inf, "soft_l1": 1.345, "huber": 1.345, "cauchy": 2.385}


def soften(residual: Array, loss: str, data: int | None = None) -> Array:
    """Residuals whose squares sum to the loss: sign(r) c √ρ((r/c)²), shape (n,).

    Those behind the first `data`, if that is given, are of priors and stay as they are.

    A search that lowers a sum of squares so lowers Σ c² ρ((r/c)²); ρ(z) is z (linear),
    2 (√(1+z) - 1) (soft_l1), z up to 1 and 2√z - 1 beyond (huber), ln(1+z) (cauchy), as in
    `scipy.optimize.least_squares`, and c is in `LOSSES`.
    """
    if loss == "linear":
        return residual
    if data is not None and data < residual.size:
        return np.append(soften(residual[:data], loss), residual[data:])
    width = LOSSES[loss]
    z = (residual / width) ** 2
    if loss == "soft_l1":
        rho = 2.0 * z / (np.sqrt(1.0 + z) + 1.0)
    elif loss == "huber":
        rho = np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0)
    else:
        rho = np.log1p(z)
    return np.asarray(np.sign(residual) * width * np.sqrt(rho))


def influence(residual: Array, loss: str) -> tuple[Array, Array]:
    """Influence ψ(r) = r ρ'(z) of residuals under a loss, and its slope ψ'(r), shapes (n,)."""
    if loss == "linear":
        return residual, np.ones_like(residual)
    z = (residual / LOSSES[loss]) ** 2
    if loss == "soft_l1":
        return residual / np.sqrt(1.0 + z), (1.0 + z) ** -1.5
    if loss == "huber":
        inside = z <= 1.0
        return residual / np.sqrt(np.maximum(z, 1.0)), inside.astype(float)
    return residual / (1.0 + z), (1.0 - z) / (1.0 + z) ** 2


def softness(residual: Array, loss: str, data: int | None = None) -> Array:
    """Derivative of `soften` by the residual, (n,): ψ over the softened residual, 1 at zero."""
    soft = soften(residual, loss)
    near = np.abs(soft) < 1e-8
    near[residual.size if data is None else data :] = True
    return np.where(near, 1.0, influence(residual, loss)[0] / np.where(near, 1.0, soft))
