"""Weights of residuals for an uncertain driving motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from foamfit.arrays import Array


@dataclass(frozen=True, eq=False)
class Weighing:
    """Transform of residuals with covariance v + SSᵀ into residuals with covariance v.

    v is diagonal, the noise of each sample. Each column of S is the change of the residual by one
    standard deviation of a mode of the motion. With S' = S/√v = U d Vᵀ the residual r becomes
    √v (1 + S'S'ᵀ)^(-1/2) r/√v. `levels` (n,) are √v, `axes` (n, m) is U, and `less` (m,) is
    1 - (1 + d²)^(-1/2).
    """

    levels: Array
    axes: Array
    less: Array

    @classmethod
    def of(cls, uncertain: Array, levels: Array) -> Weighing:
        """Make the transform from S (n, m) and √v (n,)."""
        axes, size, _ = np.linalg.svd(uncertain / levels[:, None], full_matrices=False)
        return cls(levels, axes, 1.0 - 1.0 / np.sqrt(1.0 + size**2))

    def __call__(self, rows: Array) -> Array:
        """Transform residuals (n,), or columns of their derivatives (n, k)."""
        along = (rows.T / self.levels) @ self.axes * self.less
        return np.asarray(rows - (self.levels * (along @ self.axes.T)).T)
