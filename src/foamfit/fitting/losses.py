"""How residuals count: losses that reduce large ones, and weights for an uncertain motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from foamfit.arrays import Array

# Losses, and the residual (in units of the scale) past which each reduces it: those of 95 %
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
    z = (residual / LOSSES[loss]) ** 2  # 0 under the linear loss
    if loss == "soft_l1":
        return residual / np.sqrt(1.0 + z), (1.0 + z) ** -1.5
    if loss == "cauchy":
        return residual / (1.0 + z), (1.0 - z) / (1.0 + z) ** 2
    return residual / np.sqrt(np.maximum(z, 1.0)), (z <= 1.0).astype(float)


def softness(residual: Array, loss: str, data: int | None = None) -> Array:
    """Derivative of `soften` by the residual, (n,): ψ over the softened residual, 1 at zero."""
    soft = soften(residual, loss)
    near = np.abs(soft) < 1e-8
    near[residual.size if data is None else data :] = True
    return np.where(near, 1.0, influence(residual, loss)[0] / np.where(near, 1.0, soft))


@dataclass(frozen=True, eq=False)
class Weighing:
    """What turns residuals of covariance v + SSᵀ into residuals of covariance v.

    v is diagonal, the noise of each sample; the columns of S are what one standard deviation along
    each mode of the motion does to the residual. With S' = S/√v = U d Vᵀ the residual r becomes
    √v (1 + S'S'ᵀ)^(-1/2) r/√v. `levels` (n,) are √v, `axes` (n, m) is U, and `less` (m,) is
    1 - (1 + d²)^(-1/2).
    """

    levels: Array
    axes: Array
    less: Array

    @classmethod
    def of(cls, uncertain: Array, levels: Array) -> Weighing:
        """Make it from S (n, m) and √v (n,)."""
        axes, size, _ = np.linalg.svd(uncertain / levels[:, None], full_matrices=False)
        return cls(levels, axes, 1.0 - 1.0 / np.sqrt(1.0 + size**2))

    def __call__(self, rows: Array) -> Array:
        """Weigh residuals (n,), or columns of their derivatives (n, k)."""
        levels, less = self.levels, self.less
        if rows.ndim == 2:
            levels, less = levels[:, None], less[:, None]
        return np.asarray(rows - levels * (self.axes @ (less * (self.axes.T @ (rows / levels)))))
