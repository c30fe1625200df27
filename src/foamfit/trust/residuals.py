"""Noise and model error in the residual of each curve.

Measured noise is seldom white: neighbouring samples of an oversampled curve are correlated. It is
an autoregressive process, estimated from the residuals; the effective number of samples is n/τ,
with τ the autocorrelation time. Model error ("error of the law") is not noise, because it would be
the same if the test were measured again. It appears as slow waves: a spectral peak at low
frequencies that falls off faster than noise. Where there is evidence for such a peak, the noise is
estimated at the frequencies beyond it; otherwise the residual is the noise.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.fft import dct
from scipy.linalg import matmul_toeplitz, orth

from foamfit.arrays import Array
from foamfit.data.noise import residual_filter, robust_variance

MOST_ORDERS = 10  # highest order of an autoregression
LARGEST = 0.995  # largest reflection coefficient
CORRECTIONS = 4  # iterations of the correction for the noise that a fit absorbed
# Smallest RMS of a model error, in units of the residual; below it is the error of the simulation.
SMALLEST = 2e-3
ALONE = 64  # lowest frequencies (half waves in the record), each with a band of its own
BAND = 1.06  # ratio of successive band limits above these
LAST_CORNER = 60.0  # highest corner frequency of a model error, half waves in the record
# Above its corner the spectrum of a model error falls as the frequency to the power of minus twice
# the steepness (a kink has 2, noise of first order has 1). Below, it rises as the frequency to the
# power of twice the rise, because a fit absorbs slow components.
STEEPNESS, RISES = (1.5, 2.0, 3.0), (0.0, 1.0, 2.0)
# Lowest corner frequency of noise on top of white noise, as a share of all frequencies; slower
# noise of this kind cannot be distinguished from model error.
FAST = 0.25
# Autocorrelations of first-order noise from sample to sample, without and with model error.
ANY, VISIBLE = 1.0 - np.geomspace(1.0, 0.01, 32), 1.0 - np.geomspace(0.99, 0.07, 16)
TAKEN = 0.9  # frequencies are ignored if the fit absorbed more than this share of their noise
ROUNDS = 60  # iterations for the amplitudes
FEWEST = 40  # smallest number of samples of a curve for which model error is estimated
ORDER = 10  # order of the autoregression fitted to the noise spectrum
# Noise scatters about local cubics of this width, in samples, as its process does. In 1800 records
# of first-order noise (60 to 300 samples, autocorrelations up to 0.98), the scatter of the process
# is at most 1.5 times that of the record, and in half of them within 1 %. Beside a large model
# error, the spectrum of a short record may leave the noise far too small.
LOCAL, ROUGHER, SMOOTHER = 5, 2.0, 1.25


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
        every = zip(processes, sums, curves, images, strict=True)
        processes = [_corrected(p, seen, basis[at], image, middle) for p, seen, at, image in every]
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


# ---------------------------------------------------------------- model error


@dataclass(frozen=True, eq=False)
class CurveError:
    """Noise and model error in the residual of one curve, in units of the residual."""

    noise: NoiseProcess
    # Reduction of the Bayesian information criterion by model error in addition to noise; None if
    # the curve has too few samples
    evidence: float | None = None
    law: float = 0.0  # RMS of the model error; 0 if all is noise

    @property
    def found(self) -> bool:
        """Whether the residual contains model error."""
        return self.law > 0.0


class _Sum(NamedTuple):
    """A spectrum as the sum of model error and noise, each (b,)."""

    criterion: float  # Bayesian information criterion
    law: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Power spectrum of a residual, from its cosine transform, in bands of frequency."""

    frequency: Array  # (b,): half waves in the record
    power: Array  # (b,): mean square of the transform, corrected for absorbed noise
    count: Array  # (b,): number of frequencies in the band
    left: Array  # (b,): share of the noise that the fit did not absorb
    samples: int

    @classmethod
    def of(cls, residual: Array, basis: Array) -> _Spectrum:
        """Return the spectrum of a residual; `basis` (n, k) is the part that the fit absorbed."""
        n = residual.size
        k = np.arange(1, n)
        power = dct(residual, norm="ortho")[1:] ** 2
        left = 1.0 - np.sum(dct(basis, axis=0, norm="ortho")[1:] ** 2, axis=1)
        edges = list(range(1, min(ALONE, n) + 1))
        while edges[-1] < n:
            edges.append(min(max(int(edges[-1] * BAND), edges[-1] + 1), n))
        use = left > 1.0 - TAKEN
        band = np.searchsorted(edges, k, side="right")[use] - 1
        count = np.bincount(band)
        filled = count > 0

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(band, values[use])[filled] / count[filled])

        power = np.maximum(mean(power / np.where(use, left, 1.0)), 1e-300)
        return cls(np.exp(mean(np.log(k))), power, count[filled].astype(float), mean(left), n)

    def fall(self, corners: Array, steepness: float) -> Array:
        """Return spectra that are flat up to a corner and fall beyond, (corners, b)."""
        return np.asarray((1.0 + (self.frequency / corners[:, None]) ** 2) ** -steepness)

    def first_order(self, phi: Array) -> Array:
        """Return spectra of first-order noise with autocorrelations `phi` at lag one, (phi, b)."""
        phi = phi[:, None]
        angle = np.pi * self.frequency / self.samples
        return np.asarray((1.0 - phi**2) / (1.0 + phi**2 - 2.0 * phi * np.cos(angle)))

    def peaks(self) -> Array:
        """Return spectra of model error: a fall above a corner, and perhaps a rise below it."""
        corners = np.geomspace(1.0, LAST_CORNER, 16)
        rising = {rise: (self.frequency / corners[:, None]) ** (2.0 * rise) for rise in RISES}
        out = [up * self.fall(corners, s + rise) for rise, up in rising.items() for s in STEEPNESS]
        # `power` is corrected for absorbed noise, but a fit does not absorb its own model error.
        return np.concatenate(out) / self.left

    def sum(self, laws: Array, reds: Array, *, floor: bool = True) -> _Sum:
        """Find the best sum of one of `laws`, one of `reds` and white noise (if `floor`).

        The likelihood is that of Whittle (1953, Ark. Mat. 2, 423). Multiplicative steps minimise
        its negative logarithm and keep amplitudes positive (Févotte, Bertin & Durrieu 2009, Neural
        Computation 21, 793).
        """
        flat = np.ones_like(laws[:1]) if floor else np.zeros_like(laws[:1])
        kinds = [kind for kind in (laws, reds, flat) if kind.any()]
        shapes = np.stack(np.broadcast_arrays(*kinds), axis=1)
        shapes = shapes / shapes.max(axis=2, keepdims=True)
        weights = self.count * self.power
        level = float(weights.sum() / self.count.sum())
        sizes = np.full(shapes.shape[:2], level)
        for _ in range(ROUNDS):
            inverse = 1.0 / np.einsum("mc,mcb->mb", sizes, shapes)
            up = np.matmul(shapes, (weights * inverse**2)[:, :, None])[:, :, 0]
            down = np.matmul(shapes, (self.count * inverse)[:, :, None])[:, :, 0]
            sizes = np.maximum(sizes * up / down, 1e-12 * level)
        total = np.einsum("mc,mcb->mb", sizes, shapes)
        cost = (np.log(total) + self.power / total) @ self.count
        at, errs = int(np.argmin(cost)), bool(laws.any())
        terms = sizes[at][:, None] * shapes[at]
        penalty = (floor + 3 * errs + 2 * bool(reds.any())) * math.log(float(self.count.sum()))
        law, noise = terms[0] if errs else laws[0], terms[errs:].sum(axis=0)
        return _Sum(float(cost[at]) + penalty, law, noise)


def curve_errors(
    residual: Array,
    jacobian: Array,
    sizes: tuple[int, ...],
    taken: Array | None = None,
    slow: Collection[int] = (),
) -> tuple[CurveError, ...]:
    """Separate noise and model error in the residual of each curve.

    The arguments are those of `noise_processes`, whose result is used where there is no model
    error. Noise alone is white, of first order, or of first or second order with a corner above
    `FAST` on top of white noise. Model error adds a peak at low frequencies to white or first-order
    noise. The Bayesian information criterion decides between the two; among 1200 records of white
    and first-order noise (autocorrelations up to 0.95, 120 to 5000 samples) it found model error in
    one. A process that scatters about local cubics more than `ROUGHER` times as much as the
    residual cannot be its noise; such a residual also contains model error. The residual of curves
    with `slow` noise is all taken as noise: noise of a driving stress passes through the springs as
    slow waves of the displacement, which look like model error, as does that of a velocity in its
    integral. So does the noise of one curve that a fit leaves in another, more exact one, if it
    does not weigh both by their noise: what a fit by the noise would take away is no model error
    (one test alone).
    """
    own = noise_processes(residual, jacobian, sizes, taken)
    if len(slow) == len(sizes):
        return tuple(map(CurveError, own))
    basis = basis_of(jacobian) if taken is None else taken
    found = _separated(residual, basis, sizes, own)
    found = tuple(CurveError(own[i]) if i in slow else one for i, one in enumerate(found))
    errs = [error.found for error in found]
    if taken is not None or all(errs) or not any(errs):
        return found
    return _without_noise_of_others(residual, jacobian, sizes, found)


def _separated(
    residual: Array, basis: Array, sizes: tuple[int, ...], own: list[NoiseProcess]
) -> tuple[CurveError, ...]:
    """Separate noise and model error in each curve; `own` is all of it as noise."""
    pairs = zip(parts(sizes), own, strict=True)
    return tuple(_curve_error(residual[part], basis[part], process) for part, process in pairs)


def _without_noise_of_others(
    residual: Array, jacobian: Array, sizes: tuple[int, ...], found: tuple[CurveError, ...]
) -> tuple[CurveError, ...]:
    """Return `found` without the model error that a fit weighted by the noise would take away."""
    scales = [max(math.sqrt(error.noise.variance), 1e-300) for error in found]
    units = np.ones(residual.size)  # those of priors
    units[: sum(sizes)] = np.repeat(scales, sizes)
    left, slopes = residual / units, jacobian / units[:, None]
    basis = basis_of(slopes)
    left -= basis @ (basis.T @ left)
    again = _separated(left, basis, sizes, noise_processes(left, slopes, sizes))
    return tuple(
        CurveError(replace(new.noise, variance=new.noise.variance * scale**2), new.evidence)
        if error.found and not new.found
        else error
        for error, new, scale in zip(found, again, scales, strict=True)
    )


def _curve_error(residual: Array, basis: Array, own: NoiseProcess) -> CurveError:
    n = residual.size
    if n < FEWEST or not residual.any():
        return CurveError(own)
    seen = _Spectrum.of(residual, basis)
    none, fast = np.zeros((1, seen.frequency.size)), np.geomspace(FAST * n, n, 12)
    reds = [seen.fall(fast, order) for order in (1.0, 2.0)]
    noises = [seen.sum(none, red) for red in (none, *reds)]
    noises.append(seen.sum(none, seen.first_order(ANY), floor=False))
    alone = min(noises, key=attrgetter("criterion"))
    laws, firsts = seen.peaks(), seen.first_order(VISIBLE)
    both = []
    for red in (none, seen.sum(none, firsts, floor=False).noise[None]):
        both.append(seen.sum(laws, red, floor=not red.any()))
        both.append(seen.sum(both[-1].law[None], firsts, floor=False))
    with_law = min(both, key=attrgetter("criterion"))
    evidence = alone.criterion - with_law.criterion
    weights, kept = residual_filter(LOCAL)
    local = np.convolve(residual, weights, "valid")
    least = math.sqrt(robust_variance(local)) / SMOOTHER
    most = ROUGHER * math.sqrt(float(np.mean(local**2)))
    process = _process(seen, with_law)
    scatter = max(process.scatter(kept), 1e-300)
    factor = min(max(scatter, least), most) / scatter  # so that it scatters like the record
    process = replace(process, variance=factor**2 * process.variance)
    size = math.sqrt(max(float(residual @ residual) / n - process.variance, 0.0))
    if size < SMALLEST or (evidence <= 0.0 and own.scatter(kept) <= most):
        return CurveError(own, evidence)
    return CurveError(process, evidence, size)


def _process(seen: _Spectrum, found: _Sum) -> NoiseProcess:
    """Return autoregressive noise with a spectrum given in bands."""
    noise = found.noise
    if np.ptp(noise) < 1e-9 * float(noise.max()):
        return NoiseProcess(np.empty(0), float(noise[0]))
    spectrum = np.exp(np.interp(np.arange(seen.samples), seen.frequency, np.log(noise)))
    lags = np.fft.irfft(np.append(spectrum, spectrum[-1]))[: ORDER + 1]
    return NoiseProcess(levinson(lags)[-1][0], float(lags[0]))
