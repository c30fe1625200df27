"""How sure the identified parameters are: covariance, intervals, and which are determined at all.

Measured noise is seldom white: oversampled curves repeat themselves, and what the model cannot
follow shows as slow waves in the residuals. The covariance therefore counts only the effective
number of samples, n/τ, with τ the autocorrelation time of the residuals of each curve.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

# Half widths of the 95 % interval, over the natural size of a parameter, past which it is weak,
# and past which the test says nothing about it.
WEAK, NOTHING = 0.5, 3.0
# Two directions closer than this cannot be told apart.
SINGULAR = 1e-12


def autocorrelation_time(residual: Array) -> float:
    """Integrated autocorrelation time τ >= 1 of a residual, in samples.

    τ = 1 + 2 Σ ρ_k, summed until the first pair of autocorrelations whose sum is not positive
    (initial positive sequence, Geyer 1992, Stat. Sci. 7, 473). White noise has τ = 1.

    Parameters
    ----------
    residual : (n,) array
        In the order of time.
    """
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if n < 8 or power == 0.0:
        return 1.0
    spectrum = np.fft.rfft(centred, 2 * n)
    rho = np.fft.irfft(np.abs(spectrum) ** 2)[: n // 2] / power
    total = 0.0
    for pair in range(rho.size // 2):
        both = rho[2 * pair] + rho[2 * pair + 1]
        if both <= 0.0:
            break
        total += both
    tau = max(2.0 * total - 1.0, 1.0)
    # Within the scatter of white noise, τ is one.
    return float(tau) if abs(rho[1]) > 2.0 / np.sqrt(n) else 1.0


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the varied parameters at the best point.

    Attributes
    ----------
    matrix : (k, k) array
        Covariance, SI; NaN rows and columns where the test says nothing.
    effective : float
        Effective number of samples.
    tau : tuple of float
        Autocorrelation time of each curve, samples.
    """

    matrix: Array
    effective: float
    tau: tuple[float, ...]

    @property
    def stderr(self) -> Array:
        """Standard errors, (k,)."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def correlation(self) -> Array:
        """Correlation matrix, (k, k)."""
        scale = self.stderr
        return self.matrix / np.outer(scale, scale)


def covariance(
    jacobian: Array,
    residual: Array,
    sizes: tuple[int, ...],
    sizes_of: Array,
    noise_times: tuple[float, ...] = (),
) -> Covariance:
    """Covariance (JᵀJ)⁻¹ Jᵀ S J (JᵀJ)⁻¹ with S the noise of each curve, counted effectively.

    Parameters
    ----------
    jacobian : (n, k) array
        Derivative of the residual.
    residual : (n,) array
        At the best point.
    sizes : tuple of int
        Samples of each curve, in their order.
    sizes_of : (k,) array
        Natural size of each parameter, so that directions can be compared.
    noise_times : tuple of float, optional
        Autocorrelation time of the noise of each curve, where it is known: τ is at least that,
        because a fit takes up some of what is slow in it.
    """
    n, k = jacobian.shape
    scaled = jacobian * sizes_of
    noise = np.empty(n)
    tau: list[float] = []
    effective = 0.0
    known = noise_times or (1.0,) * len(sizes)
    for part, least in zip(parts(sizes), known, strict=True):
        length = part.stop - part.start
        time = max(autocorrelation_time(residual[part]), min(least, length / 10.0))
        dof = max(length - k * length / n, 1.0)
        noise[part] = float(residual[part] @ residual[part]) / dof * time
        tau.append(time)
        effective += length / time
    _, singular, vt = np.linalg.svd(scaled, full_matrices=False)
    seen = singular > SINGULAR * max(float(singular[0]), 1e-300)
    inverse = (vt[seen].T / singular[seen] ** 2) @ vt[seen]
    matrix = inverse @ (scaled.T * noise) @ scaled @ inverse
    lost = np.any(np.abs(vt[~seen]) > 1e-3, axis=0)
    matrix[lost, :] = np.nan
    matrix[:, lost] = np.nan
    return Covariance(matrix * np.outer(sizes_of, sizes_of), effective, tuple(tau))


def parts(sizes: tuple[int, ...]) -> list[slice]:
    """Slices of the curves in a residual, of which they have so many samples each."""
    ends = np.cumsum(sizes)
    return [slice(int(end - size), int(end)) for size, end in zip(sizes, ends, strict=True)]


def half_width(stderr: float, freedom: float) -> float:
    """Half of the 95 % interval by Student's t with `freedom` degrees of freedom."""
    return float(stats.t.ppf(0.975, max(freedom, 1.0))) * stderr


def state(value: float, half: float, size: float, low: float, high: float) -> tuple[str, str]:
    """State of a parameter that was varied and whose branch was reached, and why.

    Parameters
    ----------
    value : float
        Identified value.
    half : float
        Half of its 95 % interval, not cut at the limits; NaN where the data fix only a combination.
    size : float
        Its natural size.
    low, high : float
        Its limits.
    """
    if not math.isfinite(half):
        return "not determined", "the data fix only a combination of it with other parameters"
    edge = 1e-6 * size
    if half > NOTHING * size:
        return "not determined", f"its 95 % interval is ±{half / size:.0%} of its natural size"
    if value - low <= edge or high - value <= edge:
        limit = low if value - low <= edge else high
        return "weak", f"it lies at its limit {limit:g}; its interval is open on that side"
    if half > WEAK * size:
        return "weak", f"its 95 % interval is ±{half / size:.0%} of its natural size"
    return "determined", f"its 95 % interval is ±{half / size:.1%} of its natural size"
