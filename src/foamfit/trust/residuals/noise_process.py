"""The noise of each curve as an autoregressive process, estimated from the residuals of a fit.

Measured noise is seldom white: neighbouring samples of an oversampled curve are correlated. The
effective number of samples is n/τ, with τ the autocorrelation time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import matmul_toeplitz, orth

from foamfit.arrays import Array

MOST_ORDERS = 10  # highest order of an autoregression
LARGEST = 0.995  # largest reflection coefficient
CORRECTIONS = 4  # iterations of the correction for the noise that a fit absorbed


def parts(sizes: tuple[int, ...]) -> list[slice]:
    """Return the slices of the curves in a residual, from their numbers of samples."""
    ends = np.cumsum(sizes)
    return [slice(int(end - size), int(end)) for size, end in zip(sizes, ends, strict=True)]


@dataclass(frozen=True, eq=False)
class NoiseProcess:
    """Autoregressive noise of one curve: x_t = Σ φ_j x_(t-j) + white noise."""

    coefficients: Array  # (p,): φ_1 … φ_p; empty for white noise
    variance: float  # of the process itself, not of the white noise that drives it

    def autocovariance(self, n: int) -> Array:
        """Return the autocovariance at the lags 0 … n-1."""
        lags = self._response(4 * max(n, 256))[:n]
        return np.asarray(lags * (self.variance / lags[0]))

    def _response(self, size: int) -> Array:
        """Return the autocovariance at `size` lags for driving white noise of unit variance."""
        transfer = np.abs(np.fft.rfft(np.append(1.0, -self.coefficients), size)) ** -2
        return np.asarray(np.fft.irfft(transfer))

    @cached_property
    def tau(self) -> float:
        """Autocorrelation time 1 + 2 Σ ρ_k, at least one, in samples."""
        if not self.coefficients.size:
            return 1.0
        white = 1.0 / float(self._response(1 << 14)[0])  # variance of what drives it, over its own
        return max(white / (1.0 - float(self.coefficients.sum())) ** 2, 1.0)

    def scatter(self, kept: Array) -> float:
        """Return the standard deviation behind a filter, whose autocorrelation is `kept`."""
        lags = self.autocovariance(kept.size)
        return math.sqrt(max(float(kept[0] * lags[0] + 2.0 * kept[1:] @ lags[1:]), 0.0))

    def times(self, columns: Array) -> Array:
        """Multiply the covariance matrix of n samples by the columns of an (n, k) array."""
        if not self.coefficients.size:
            return self.variance * columns
        return np.asarray(matmul_toeplitz(self.autocovariance(len(columns)), columns))


def levinson(lags: Array) -> list[tuple[Array, float]]:
    """Return the autoregressions of order 0, 1, … and their white-noise variances from lags."""
    fits = [(np.empty(0), float(lags[0]))]
    for order in range(1, lags.size):
        phi, white = fits[-1]
        if white <= 0.0:
            break
        reflection = (lags[order] - phi @ lags[order - 1 : 0 : -1]) / white
        reflection = float(np.clip(reflection, -LARGEST, LARGEST))
        phi = np.append(phi - reflection * phi[::-1], reflection)
        fits.append((phi, white * (1.0 - reflection**2)))
    return fits


def _lag_sums(one: Array, other: Array, order: int) -> Array:
    """Return Σ_t one_t · other_(t+k), symmetrised in k, for k = 0 … order, (order+1,)."""
    n = len(one)
    pairs = ((one[: n - k], other[k:], one[k:], other[: n - k]) for k in range(order + 1))
    return 0.5 * np.array([np.vdot(a, b) + np.vdot(c, d) for a, b, c, d in pairs])


def noise_processes(
    residual: Array, jacobian: Array, sizes: tuple[int, ...], taken: Array | None = None
) -> list[NoiseProcess]:
    """Estimate the noise of each curve as an autoregressive process from the residuals of a fit.

    The order minimises the Bayesian information criterion. The parameters of a fit absorb part of
    the noise, mostly at low frequencies, so that residuals are smaller and less correlated than the
    noise. With the hat matrix H = QQᵀ of the fit, residuals (I-H)e have the expected lag sums
    tr S_k (I-H)Σ(I-H); the autocovariances are corrected by the part of Σ that is absorbed.

    `residual` (n,) contains all curves in turn, each with `sizes` samples in the order of time; the
    columns of `jacobian` (n, k) may have any scale. If the fit used other data too, `taken` (n, k)
    is the part of the noise that it absorbed: orthogonal columns, each with the length of the root
    of the absorbed share along it.
    """
    basis = basis_of(jacobian) if taken is None else _shortened(taken)
    curves = parts(sizes)
    sums, processes = [], []
    for part in curves:
        own, n = residual[part], part.stop - part.start
        lag_sums = _lag_sums(own, own, min(MOST_ORDERS, n // 10))
        fits = levinson(lag_sums / n)
        scores = [n * math.log(max(white, 1e-300)) + len(f) * math.log(n) for f, white in fits]
        order = int(np.argmin(scores))
        sums.append(lag_sums[: order + 1])
        processes.append(NoiseProcess(_damped(fits[order][0], n), float(lag_sums[0] / n)))
    if not basis.shape[1]:
        return processes
    for _ in range(CORRECTIONS):
        pairs = list(zip(processes, curves, strict=True))
        images = [process.times(basis[part]) for process, part in pairs]
        squares = [basis[part].T @ image for image, part in zip(images, curves, strict=True)]
        rest = basis[sum(sizes) :]  # priors, of unit variance
        middle = np.sum(squares, axis=0) + rest.T @ rest
        processes = [
            _corrected(process, seen, basis[part], image, middle)
            for process, seen, part, image in zip(processes, sums, curves, images, strict=True)
        ]
    return processes


def _shortened(taken: Array) -> Array:
    """Return columns q for which (I-qqᵀ)² leaves the same share of white noise as `taken`.

    A share λ of the noise along a column is absorbed; 1-λ is the square of 1-λ'.
    """
    share = np.clip(np.sum(taken**2, axis=0), 1e-300, 1.0)
    return np.asarray(taken * np.sqrt((1.0 - np.sqrt(1.0 - share)) / share))


def _corrected(
    process: NoiseProcess, seen: Array, basis: Array, image: Array, middle: Array
) -> NoiseProcess:
    """Return the process whose lag sums, less the absorbed part, are those `seen` in residuals."""
    n, order = len(basis), seen.size - 1
    taken = _lag_sums(basis, 2.0 * image - basis @ middle, order)
    lags = (seen + taken) / (n - np.arange(order + 1))
    # If a fit absorbed most of a curve's noise, the correction is unreliable and must be limited.
    lags *= min(1.0, 4.0 * seen[0] / n / lags[0]) if lags[0] > 0.0 else 1.0
    if lags[0] <= 0.0:
        return process
    coefficients = _damped(levinson(lags)[-1][0], n)
    return replace(process, coefficients=coefficients, variance=float(lags[0]))


def _damped(coefficients: Array, n: int) -> Array:
    """Limit the decay times of the modes of an autoregression to a quarter of n samples."""
    decays = np.abs(np.roots(np.append(1.0, -coefficients)))  # of the modes, per sample
    share = min(1.0, (1.0 - 4.0 / n) / max(float(np.max(decays, initial=0.0)), 1e-300))
    return np.asarray(coefficients * share ** np.arange(1, coefficients.size + 1))


def basis_of(jacobian: Array) -> Array:
    """Return an orthonormal basis of the columns of a Jacobian."""
    if not jacobian.shape[1]:
        return jacobian
    scale = np.linalg.norm(jacobian, axis=0)
    return np.asarray(orth(jacobian / np.where(scale > 0.0, scale, 1.0), rcond=1e-10))


def autocorrelation_time(residual: Array) -> float:
    """Return the autocorrelation time τ = 1 + 2 Σ ρ_k >= 1 in samples; 1 for white noise."""
    if residual.size < 8 or not residual.any():
        return 1.0
    return noise_processes(residual, np.empty((residual.size, 0)), (residual.size,))[0].tau
