"""Weights of residuals for an uncertain driving motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from foamfit.arrays import Array

# Probability at which amplitudes of the motion's modes are no longer credible; one single
# amplitude may be larger in ten times as many tests (3.5 standard deviations among 20).
RARE = 1e-3


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
    sizes: Array  # d (m,)
    at: Array  # the parameters at which it was found, SI

    @classmethod
    def of(cls, uncertain: Array, levels: Array, at: Array) -> Weighing:
        """Make the transform from S (n, m) and √v (n,)."""
        axes, size, _ = np.linalg.svd(uncertain / levels[:, None], full_matrices=False)
        return cls(levels, axes, 1.0 - 1.0 / np.sqrt(1.0 + size**2), size, at)

    def amplitudes(self, residual: Array) -> Array:
        """Return the residual along the modes over its standard deviation, of modes with d > 1.

        They are standard normal if the motion's uncertainty and noise explain the residual.
        """
        along = (residual / self.levels) @ self.axes / np.sqrt(1.0 + self.sizes**2)
        return np.asarray(along[self.sizes > 1.0])

    def explains(self, residual: Array) -> bool:
        """Return whether noise and the uncertainty of the motion can explain a residual (n,)."""
        sizes = self.amplitudes(residual) ** 2
        if not sizes.size:
            return True
        most = chdtri(sizes.size, RARE), chdtri(1, 10.0 * RARE / sizes.size)
        return bool(sizes.sum() <= most[0] and sizes.max() <= most[1])

    def __call__(self, rows: Array) -> Array:
        """Transform residuals (n,), or columns of their derivatives (n, k)."""
        along = (rows.T / self.levels) @ self.axes * self.less
        return np.asarray(rows - (self.levels * (along @ self.axes.T)).T)
