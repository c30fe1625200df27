"""How sure the identified parameters are: covariance, intervals, and which are determined at all.

An interval tells where the best that the law can do would lie if the test were measured again. So
the covariance has the noise alone in it, correlated as it is (`noise_process`); an error of the law
(`law_error`) only changes how the best point follows the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from foamfit.arrays import Array
from foamfit.text import percent
from foamfit.trust.residuals.noise_process import NoiseProcess, noise_processes, parts

# Half widths of the 95 % interval, over the scale of a parameter (`fitting.box.Scales`), past which
# it is weak, and past which the test does not determine it.
WEAK, NOTHING = 0.5, 3.0
RULE = (
    f"Determined: 95 % interval and range are both within ±{WEAK:.0%} of the parameter's scale "
    "(its value, or what its sentence names).",
    f"Not determined: one of them is wider than ±{NOTHING:.0%}, or its branch was never reached; "
    "weak: all between.",
)
# A parameter this close to a limit, over its scale, lies at it.
AT_LIMIT = 1e-6
# Two directions closer than this count as one.
SINGULAR = 1e-12
# Curvature of the cost over that of JᵀJ below which it is not believed.
FLATTEST = 0.05


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the varied parameters at the best point."""

    matrix: Array  # (k, k): Covariance, SI; NaN rows and columns where the test says nothing
    # (k,): Variance of each parameter over that of a residual of white noise of unit variance: what
    # a rise of the sum of squares along a parameter's profile must be divided by to be a χ².
    inflation: Array
    # (k,): Degrees of freedom of each variance: those of the χ² distribution that is as uncertain
    # as the estimated noise makes it (Satterthwaite 1946, Biometrics Bull. 2, 110), but no more
    # than the effective samples that the parameters have left: what a model cannot follow is no
    # noise whose spectrum is known.
    freedom: Array
    effective: float  # Effective number of samples
    noise: tuple[NoiseProcess, ...]  # Noise of each curve, in units of the residual

    @property
    def tau(self) -> tuple[float, ...]:
        """Autocorrelation time of each curve, samples."""
        return tuple(process.tau for process in self.noise)

    @property
    def stderr(self) -> Array:
        """Standard errors, (k,)."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def correlation(self) -> Array:
        """Correlation matrix, (k, k)."""
        scale = self.stderr
        return self.matrix / np.outer(scale, scale)

    def with_some(self, chosen: NDArray[np.intp], other: Covariance) -> Covariance:
        """Take these parameters from another covariance; the rest is correlated with nothing.

        No variance becomes smaller: the curvature of a cost with kinks is known to some tenths.
        """
        variance = np.diag(self.matrix)
        more = np.sqrt(np.fmax(variance[chosen] / np.diag(other.matrix), 1.0))
        matrix = np.diag(variance)
        matrix[np.ix_(chosen, chosen)] = other.matrix * np.outer(more, more)
        inflation, freedom = self.inflation.copy(), self.freedom.copy()
        inflation[chosen], freedom[chosen] = other.inflation * more**2, other.freedom
        return replace(self, matrix=matrix, inflation=inflation, freedom=freedom)


def covariance(
    jacobian: Array,
    residual: Array,
    sizes: tuple[int, ...],
    sizes_of: Array,
    noise: Sequence[NoiseProcess] | None = None,
    gradient: Callable[[Array], Array] | None = None,
) -> Covariance:
    """Covariance H⁻¹ JᵀΣJ H⁻¹ with Σ the noise of each curve (by default `noise_processes`).

    `residual` (n,) and `jacobian` (n, k) are those of the best point, so many samples of each curve
    as in `sizes` and behind them priors of unit variance;
    `sizes_of` (k,) are the scales of the parameters, so that directions compare. H
    is JᵀJ, or with `gradient` the derivative of Jᵀr, which a residual that is no noise changes
    (White 1982, Econometrica 50, 1): `gradient` gives Jᵀr (k,) at a step (k,), both scaled, off the
    best point; it is asked one standard error to either side along the principal axes.
    """
    scaled = jacobian * sizes_of
    noise = noise_processes(residual, scaled, sizes) if noise is None else noise
    left, singular, vt = np.linalg.svd(scaled, full_matrices=False)
    seen = singular > SINGULAR * max(float(singular[0]), 1e-300)
    left, root = left[:, seen], vt[seen].T / singular[seen]
    curves = list(zip(noise, parts(sizes), strict=True))
    inner = np.sum([left[part].T @ process.times(left[part]) for process, part in curves], axis=0)
    rest = left[sum(sizes) :]  # priors, of unit variance
    inner = inner + rest.T @ rest
    power, axes = np.linalg.eigh(0.5 * (inner + inner.T))
    least = 1e-12 * power.max(initial=0.0)  # no variance is negative
    axes = axes * np.sqrt(np.maximum(power, least))
    bread = np.eye(len(axes))
    if gradient is not None and len(axes):
        bread = _bread(gradient, root, axes)
    spread = root @ bread @ axes
    matrix, inverse = spread @ spread.T, root @ bread @ root.T
    lost = np.any(np.abs(vt[~seen]) > 1e-3, axis=0)
    matrix[lost, :] = np.nan
    matrix[:, lost] = np.nan
    effective = sum(n / process.tau for n, process in zip(sizes, noise, strict=True))
    errors = left @ bread @ root.T  # of the estimates, by the noise of each sample
    variance = np.sum([process.forms(errors[part]) for process, part in curves], axis=0)
    variance = variance + np.sum(errors[sum(sizes) :] ** 2, axis=0)
    doubt = np.sum([process.doubt(errors[part]) for process, part in curves], axis=0)
    known = 2.0 * variance**2 / np.maximum(doubt, 1e-300)
    return Covariance(
        matrix * np.outer(sizes_of, sizes_of),
        np.diag(matrix) / np.where(lost, np.nan, np.diag(inverse)),
        np.minimum(known, max(effective - len(matrix), 1.0)),
        float(effective),
        tuple(noise),
    )


def _bread(gradient: Callable[[Array], Array], root: Array, axes: Array) -> Array:
    """H⁻¹ in coordinates in which JᵀJ is one; along what has no curvature, that of JᵀJ.

    `root` (k, m) leads from these coordinates to scaled steps, `axes` (m, m) are the steps.
    """
    steps = (root @ axes).T
    change = np.array([0.5 * (gradient(step) - gradient(-step)) for step in steps]).T
    try:
        curvature = np.linalg.solve(axes.T, (root.T @ change).T)
    except np.linalg.LinAlgError:
        return np.eye(len(axes))
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    values = np.where(values > FLATTEST, values, 1.0)
    return np.asarray((vectors / values) @ vectors.T)


def half_width(stderr: float, freedom: float) -> float:
    """Half of the 95 % interval by Student's t with `freedom` degrees of freedom."""
    return float(stats.t.ppf(0.975, max(freedom, 1.0))) * stderr


def state(
    value: float,
    half: float,
    size: float,
    low: float,
    high: float,
    of: str = "its value",
    what: str = "95 % interval",
) -> tuple[str, str]:
    """State of a parameter that was varied and whose branch was reached, and why.

    The rule (`RULE`): determined if its 95 % interval and its range are within ±`WEAK` of its
    scale, not determined if one of them is wider than ±`NOTHING`, weak between. `half` is half of
    the wider of the two, in words `what`, not cut at the limits, NaN where the data fix only a
    combination; `size` is its scale, in words `of`; `low` and `high` are its limits.
    """
    if not math.isfinite(half):
        return "not determined", "the data fix only a combination of it with other parameters"
    ratio, edge = half / size, AT_LIMIT * size
    width = f"its {what} is ±{percent(ratio)} of {of}"
    if half > NOTHING * size:
        wide = "more than 100 times" if ratio > 100.0 else f"±{ratio:.2g} times"
        return "not determined", f"its {what} is {wide} {of}"
    if value - low <= edge or high - value <= edge:
        limit = low if value - low <= edge else high
        return "weak", f"it lies at its limit {limit:g}; its interval is open on that side"
    return "weak" if half > WEAK * size else "determined", width
