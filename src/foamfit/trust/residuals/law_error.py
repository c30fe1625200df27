"""Noise or error of the law: what the residual of each curve is made of.

What a law cannot follow is left in the residual and is the same whenever the test is measured
again: it is not noise. It shows as slow waves, a peak of the spectrum at low frequencies that falls
faster beyond than noise does. Where there is evidence for such a peak, the noise is read off the
frequencies beyond it; elsewhere the residual is the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.fft import dct

from foamfit.arrays import Array
from foamfit.trust.residuals.noise_process import (
    NoiseProcess,
    basis_of,
    levinson,
    noise_processes,
    parts,
)

# Least RMS of an error of the law, in units of the residual: below it is that of the simulation.
SMALLEST = 2e-3
# Frequencies (half waves in the record) that stand alone, and the ratio of the bands beyond them.
ALONE, BAND = 64, 1.06
# The most half waves in the record at which an error of the law has its corner. Beyond it the
# spectrum falls as the frequency to the power of minus twice the steepness (a kink leaves 2, noise
# of first order has 1); up to it, it rises as twice the rise, because a fit takes what is slow.
LAST_CORNER, STEEPNESS, RISES = 60.0, (1.5, 2.0, 3.0), (0.0, 1.0, 2.0)
# Corner of noise on top of white noise, as a share of the frequencies: slower noise of that kind
# cannot be told from an error of the law.
FAST = 0.25
# Autocorrelations from sample to sample: of noise alone, and beside an error of the law.
ANY, VISIBLE = 1.0 - np.geomspace(1.0, 0.01, 32), 1.0 - np.geomspace(0.99, 0.07, 16)
# Frequencies of which the fit took more than this share do not count.
TAKEN = 0.9
ROUNDS = 60  # of the fit of the amplitudes
FEWEST = 40  # samples of a curve of which anything is said
ORDER = 10  # of the autoregression that has the spectrum of the noise


@dataclass(frozen=True, eq=False)
class CurveError:
    """What the residual of one curve is made of, in units of the residual."""

    noise: NoiseProcess
    # Of an error of the law beside noise: how much lower its Bayesian information criterion is than
    # that of noise alone; None where the curve has too few samples.
    evidence: float | None = None
    law: float = 0.0  # RMS of the law's error; 0 where all is noise

    @property
    def found(self) -> bool:
        """Whether the residual holds an error of the law."""
        return self.law > 0.0


class _Sum(NamedTuple):
    """A spectrum as the sum of an error of the law, red noise and white noise, each (b,)."""

    criterion: float  # Bayesian information criterion
    law: Array
    red: Array
    white: Array


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Power of a residual by frequency: its cosine transform (each of variance S), in bands."""

    frequency: Array  # (b,): half waves in the record
    power: Array  # (b,): mean square of the transform, what the fit took of noise given back
    count: Array  # (b,): frequencies in the band
    left: Array  # (b,): share of the noise that the fit left
    samples: int

    @classmethod
    def of(cls, residual: Array, basis: Array) -> _Spectrum:
        """Spectrum of a residual of a fit; `basis` (n, k) is what that took, over all curves."""
        n = residual.size
        k = np.arange(1, n)
        power = dct(residual, norm="ortho")[1:] ** 2
        left = 1.0 - np.sum(dct(basis, axis=0, norm="ortho")[1:] ** 2, axis=1)
        edges = list(range(1, min(ALONE, n) + 1))
        while edges[-1] < n:
            edges.append(min(max(int(edges[-1] * BAND), edges[-1] + 1), n))
        band = np.searchsorted(edges, k, side="right") - 1
        use = left > 1.0 - TAKEN
        count = np.bincount(band, use, len(edges))
        there = count > 0.0

        def mean(values: Array) -> Array:
            sums = np.bincount(band, np.where(use, values, 0.0), len(edges))
            return np.asarray(sums[there] / count[there])

        power = np.maximum(mean(power / np.where(use, left, 1.0)), 1e-300)
        return cls(np.exp(mean(np.log(k))), power, count[there].astype(float), mean(left), n)

    def fall(self, corners: Array, steepness: float) -> Array:
        """Spectra that are flat up to a corner and fall beyond, (corners, b)."""
        return np.asarray((1.0 + (self.frequency / corners[:, None]) ** 2) ** -steepness)

    def first_order(self, phi: Array) -> Array:
        """Spectra of noise with these autocorrelations from one sample to the next, (phi, b)."""
        phi = phi[:, None]
        angle = np.pi * self.frequency / self.samples
        return np.asarray((1.0 - phi**2) / (1.0 + phi**2 - 2.0 * phi * np.cos(angle)))

    def peaks(self) -> Array:
        """Spectra of an error of the law: a fall beyond a corner, and a rise or none up to it."""
        corners = np.geomspace(1.0, LAST_CORNER, 16)
        rising = {rise: (self.frequency / corners[:, None]) ** (2.0 * rise) for rise in RISES}
        out = [up * self.fall(corners, s + rise) for rise, up in rising.items() for s in STEEPNESS]
        return np.concatenate(out) / self.left  # the fit took nothing of what it left

    def sum(self, laws: Array, reds: Array, *, floor: bool = True) -> _Sum:
        """The sum of the least criterion of one of these laws, one of these reds and white noise.

        Likelihood of Whittle (1953, Ark. Mat. 2, 423); multiplicative steps lower it and keep
        amplitudes positive (Févotte, Bertin & Durrieu 2009, Neural Computation 21, 793).
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
        whole = np.einsum("mc,mcb->mb", sizes, shapes)
        cost = (np.log(whole) + self.power / whole) @ self.count
        at = int(np.argmin(cost))
        own = list(sizes[at][:, None] * shapes[at])
        law = own.pop(0) if laws.any() else laws[0]
        red = own.pop(0) if reds.any() else reds[0]
        white = own.pop(0) if floor else flat[0]
        spent = floor + 3 * bool(laws.any()) + 2 * bool(reds.any())
        price = spent * math.log(float(self.count.sum()))
        return _Sum(float(cost[at]) + price, law, red, white)


def curve_errors(
    residual: Array,
    jacobian: Array,
    sizes: tuple[int, ...],
    taken: Array | None = None,
    driven: bool = False,
) -> tuple[CurveError, ...]:
    """Tell noise from an error of the law in the residual of each curve, whichever is likelier.

    Arguments as of `noise_processes`, whose noise is taken where the residual holds no error of the
    law. Noise alone is white, of first order (one autocorrelation from sample to sample), or of
    first or second order with a corner above `FAST` on top of white noise. With an error of the
    law, a peak at low frequencies comes to white noise or to noise of first order. The Bayesian
    information criterion decides; one of 1200 records of white noise and of noise of first order
    (up to 0.95 from sample to sample, 120 to 5000 samples) was taken for an error of the law. Where
    the test is `driven` by a stress all is noise: that of the stress comes through the springs as
    slow waves of the displacement, which look like an error of the law.
    """
    basis = basis_of(jacobian) if taken is None else taken
    own = noise_processes(residual, jacobian, sizes, taken)
    return tuple(
        CurveError(process) if driven else _curve_error(residual[part], basis[part], process)
        for part, process in zip(parts(sizes), own, strict=True)
    )


def _curve_error(residual: Array, basis: Array, own: NoiseProcess) -> CurveError:
    n = residual.size
    if n < FEWEST or not residual.any():
        return CurveError(own)
    seen = _Spectrum.of(residual, basis)
    none, fast = np.zeros((1, seen.frequency.size)), np.geomspace(FAST * n, n, 12)
    reds = [seen.fall(fast, order) for order in (1.0, 2.0)]
    first = seen.sum(none, seen.first_order(ANY), floor=False)
    alone = min(
        [seen.sum(none, red) for red in (none, *reds)] + [first], key=attrgetter("criterion")
    )
    laws, firsts = seen.peaks(), seen.first_order(VISIBLE)
    both = []
    for red in (none, seen.sum(none, firsts, floor=False).red[None]):
        both.append(seen.sum(laws, red, floor=not red.any()))
        both.append(seen.sum(both[-1].law[None], firsts, floor=False))
    found = min(both, key=attrgetter("criterion"))
    evidence = alone.criterion - found.criterion
    noise = found.red + found.white
    process = _process(seen, noise, max(float(seen.count @ (found.law < noise)), 1.0))
    size = math.sqrt(max(float(residual @ residual) / n - process.variance, 0.0))
    if evidence <= 0.0 or size < SMALLEST:
        return CurveError(own, evidence)
    return CurveError(process, evidence, size)


def _process(seen: _Spectrum, noise: Array, samples: float) -> NoiseProcess:
    """Autoregressive noise with a spectrum that is given in bands."""
    k = np.arange(seen.samples)
    spectrum = np.exp(np.interp(k, seen.frequency, np.log(noise)))
    lags = np.fft.irfft(np.append(spectrum, spectrum[-1]))[: ORDER + 1]
    if np.ptp(noise) < 1e-9 * float(noise.max()):
        return NoiseProcess(np.empty(0), float(noise[0]), samples)
    return NoiseProcess(levinson(lags)[-1][0], float(lags[0]), samples)
