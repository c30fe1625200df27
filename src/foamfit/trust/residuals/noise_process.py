"""The noise of each curve as an autoregressive process, read off the residuals of a fit.

Measured noise is seldom white: oversampled curves repeat themselves. n/τ is the effective number of
samples, τ the autocorrelation time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import orth, toeplitz

from foamfit.arrays import Array

# Of the autoregressive noise: most orders, largest reflection coefficient, rounds of correction.
MOST_ORDERS, LARGEST, CORRECTIONS = 10, 0.995, 4


def parts(sizes: tuple[int, ...]) -> list[slice]:
    """Slices of the curves in a residual, from their numbers of samples."""
    ends = np.cumsum(sizes)
    return [slice(int(end - size), int(end)) for size, end in zip(sizes, ends, strict=True)]


@dataclass(frozen=True, eq=False)
class NoiseProcess:
    """Autoregressive noise of one curve: x_t = Σ φ_j x_(t-j) + white."""

    coefficients: Array  # (p,): φ_1 … φ_p; none for white noise
    variance: float  # Of the process itself, not of the white noise that drives it
    # How many it was read off, less those that the parameters of the fit took; infinite if it is
    # known.
    samples: float = math.inf

    def autocovariance(self, n: int) -> Array:
        """Autocovariance at the lags 0 … n-1."""
        lags = self._response(4 * max(n, 256))[:n]
        return np.asarray(lags * (self.variance / lags[0]))

    def _response(self, size: int) -> Array:
        """Autocovariance at `size` lags if the driving white noise has unit variance."""
        transfer = np.abs(np.fft.rfft(np.append(1.0, -self.coefficients), size)) ** -2
        return np.asarray(np.fft.irfft(transfer))

    @cached_property
    def white(self) -> float:
        """Variance of the driving white noise over that of the process."""
        return float(1.0 / self._response(1 << 14)[0])

    @cached_property
    def tau(self) -> float:
        """Autocorrelation time 1 + 2 Σ ρ_k, at least one, in samples."""
        if not self.coefficients.size:
            return 1.0
        return max(self.white / (1.0 - float(self.coefficients.sum())) ** 2, 1.0)

    def times(self, columns: Array) -> Array:
        """Covariance matrix of n samples times the columns of an (n, k) array."""
        if not self.coefficients.size:
            return self.variance * columns
        n = len(columns)
        lags = self.autocovariance(n)
        # A circulant matrix that has the covariance in a corner: the transform makes it diagonal.
        circulant = np.fft.rfft(np.concatenate([lags, [0.0], lags[:0:-1]]))
        product: Array = np.fft.irfft(
            np.fft.rfft(columns, 2 * n, axis=0) * circulant[:, None], axis=0
        )
        return product[:n]

    def forms(self, columns: Array, mix: Array | None = None) -> Array:
        """Variance lᵀΣl of the noise times each column l of an (n, m) product, (m,).

        The product is that of `columns` (n, k) and `mix` (k, m), by default the columns themselves.
        """
        inner = columns.T @ self.times(columns)
        if mix is None:
            return np.diag(inner)
        return np.asarray(np.einsum("ij,ij->j", mix, inner @ mix))

    def doubt(self, columns: Array, mix: Array) -> Array:
        """Variance of `forms`, as estimated from `samples`, (m,): the delta method.

        Estimates of the white variance w and of φ are independent for large n. That of w has the
        variance 2w²/n of normal noise; those of φ have the covariance w Γ⁻¹/n with Γ that of p
        successive samples (Brockwell & Davis 1991, Time Series: Theory and Methods, theorem 8.1.1).
        """
        if math.isinf(self.samples):
            return np.zeros(mix.shape[1])
        here = self.forms(columns, mix)
        out = 2.0 * here**2
        order = self.coefficients.size
        if order:
            white = self.variance * self.white
            step = 1e-4 * (1.0 - _radius(self.coefficients))
            moved = [
                NoiseProcess(phi, white / NoiseProcess(phi, 1.0).white)
                for phi in self.coefficients + step * np.eye(order)
            ]
            slopes = np.array([(other.forms(columns, mix) - here) / step for other in moved])
            gamma = toeplitz(self.autocovariance(order))
            out += white * np.einsum("ik,ik->k", slopes, np.linalg.solve(gamma, slopes))
        return np.asarray(out / self.samples)


def levinson(lags: Array) -> list[tuple[Array, float]]:
    """Autoregressions of order 0, 1, … from autocovariances, with their white variance."""
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
    """Σ_t (one_t ⊗ other_(t+k), symmetric in k) for k = 0 … order, (order+1, columns, columns)."""
    n = len(one)
    sums = [one[: n - k].T @ other[k:] + one[k:].T @ other[: n - k] for k in range(order + 1)]
    return 0.5 * np.array(sums)


def noise_processes(
    residual: Array, jacobian: Array, sizes: tuple[int, ...], taken: Array | None = None
) -> list[NoiseProcess]:
    """Noise of each curve as an autoregressive process, from the residuals of a fit.

    The order is that of the least Bayesian information criterion. A fit takes what its parameters
    can follow out of the noise, mostly at low frequencies: residuals look less correlated and
    smaller than the noise was. With the hat matrix H = QQᵀ of the fit, residuals (I-H)e have the
    expected lag sums tr S_k (I-H)Σ(I-H); the autocovariances are corrected by what Σ itself loses.

    `residual` (n,) holds all curves, one after the other, each in the order of time with `sizes`
    samples; `jacobian` (n, k) may have any scaling of its columns. Where other data took part in
    the fit, `taken` (n, k) says what it took of these: orthogonal columns, each as long as the root
    of the share of the noise along it.
    """
    basis = basis_of(jacobian) if taken is None else _shortened(taken)
    curves = parts(sizes)
    sums, processes = [], []
    for part in curves:
        own = residual[part][:, None]
        n = len(own)
        highest = min(MOST_ORDERS, n // 10)
        sums.append(_lag_sums(own, own, highest)[:, 0, 0])
        fits = levinson(sums[-1] / n)
        scores = [n * math.log(max(white, 1e-300)) + len(f) * math.log(n) for f, white in fits]
        order = int(np.argmin(scores))
        sums[-1] = sums[-1][: order + 1]
        left = max(n - float(np.sum(basis[part] ** 2)), 1.0)
        processes.append(NoiseProcess(_damped(fits[order][0], n), float(sums[-1][0] / n), left))
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
    """Columns q with which (I-qqᵀ) twice leaves of white noise what `taken` leaves of it once.

    A share λ of the noise along a column is gone from a residual; 1-λ is the square of (1-λ').
    """
    share = np.clip(np.sum(taken**2, axis=0), 1e-300, 1.0)
    return np.asarray(taken * np.sqrt((1.0 - np.sqrt(1.0 - share)) / share))


def _corrected(
    process: NoiseProcess, seen: Array, basis: Array, image: Array, middle: Array
) -> NoiseProcess:
    """Process whose lag sums, less what the fit took of them, are those seen in the residual."""
    n, order = len(basis), seen.size - 1
    once = np.trace(_lag_sums(basis, image, order), axis1=1, axis2=2)
    twice = np.einsum("kij,ji->k", _lag_sums(basis, basis, order), middle)
    taken = 2.0 * once - twice
    lags = (seen + taken) / (n - np.arange(order + 1))
    # A fit that took most of a curve's noise leaves nothing to correct it by.
    lags *= min(1.0, 4.0 * seen[0] / n / lags[0]) if lags[0] > 0.0 else 1.0
    if lags[0] <= 0.0:
        return process
    coefficients = _damped(levinson(lags)[-1][0], n)
    return replace(process, coefficients=coefficients, variance=float(lags[0]))


def _radius(coefficients: Array) -> float:
    """Largest factor from sample to sample of the waves of an autoregression."""
    return float(np.max(np.abs(np.roots(np.append(1.0, -coefficients))), initial=0.0))


def _damped(coefficients: Array, n: int) -> Array:
    """Coefficients of an autoregression none of whose waves lives longer than a quarter of n."""
    share = min(1.0, (1.0 - 4.0 / n) / max(_radius(coefficients), 1e-300))
    return np.asarray(coefficients * share ** np.arange(1, coefficients.size + 1))


def basis_of(jacobian: Array) -> Array:
    """Orthonormal basis of the columns of a Jacobian."""
    if not jacobian.shape[1]:
        return jacobian
    scale = np.linalg.norm(jacobian, axis=0)
    return np.asarray(orth(jacobian / np.where(scale > 0.0, scale, 1.0), rcond=1e-10))


def autocorrelation_time(residual: Array) -> float:
    """Autocorrelation time τ = 1 + 2 Σ ρ_k >= 1 of a residual, in samples; 1 of white noise."""
    if residual.size < 8 or not residual.any():
        return 1.0
    return noise_processes(residual, np.empty((residual.size, 0)), (residual.size,))[0].tau
