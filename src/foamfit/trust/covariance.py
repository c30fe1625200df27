"""Uncertainty of the identified parameters: covariance, intervals and states.

A 95 % interval shows where the best point of the law would lie if the tests were measured again.
The covariance therefore includes the noise only, with its correlation; model error only changes how
the best point responds to the noise (`residuals`). A fit of one test is a single block whose
parameters are the unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from foamfit.arrays import Array
from foamfit.springs.parameters import unit_of
from foamfit.text import engineering, percent
from foamfit.trust.residuals import NoiseProcess, noise_processes, parts

Ends = tuple[float, float]
# A parameter is weak if half its 95 % interval exceeds WEAK times its scale (`fitting.box.Scales`),
# and not determined if it exceeds NOTHING times its scale.
WEAK, NOTHING = 0.5, 3.0
RULE = (
    f"Determined: 95 % interval and range are both within ±{percent(WEAK)} of the parameter's "
    "scale (its value, unless its sentence names another).",
    f"Not determined: one of them is wider than ±{percent(NOTHING)}, or its branch was never "
    "reached. Otherwise weak.",
)
# A parameter is at a limit if its distance to it, over its scale, is no more than this.
AT_LIMIT = 1e-6
# Directions with a singular value below this share of the largest one are not seen by the data.
SINGULAR = 1e-12
# Ratios of the curvature of the cost to JᵀJ: the least one, as smaller ones are due to kinks, and
# the scatter that kinks cause.
FLATTEST, KINKED = 0.5, 1.0


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the varied parameters at the best point."""

    matrix: Array  # (k, k): covariance, SI; NaN rows and columns for undetermined parameters
    # (k,): variance of each parameter over its variance under white noise of unit variance. A rise
    # of the sum of squares along a profile, divided by this, is a χ².
    inflation: Array
    freedom: Array  # (k,): degrees of freedom: effective samples less the number of parameters
    effective: float  # effective number of samples

    @property
    def stderr(self) -> Array:
        """Standard errors, (k,)."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def correlation(self) -> Array:
        """Correlation matrix, (k, k)."""
        return self.matrix / np.outer(self.stderr, self.stderr)


def _directions(rows: Array) -> tuple[Array, Array, Array]:
    """Return the singular value decomposition of some rows, without its null space."""
    left, singular, vt = np.linalg.svd(rows, full_matrices=False)
    seen = singular > SINGULAR * max(float(singular.max(initial=0.0)), 1e-300)
    return left[:, seen], singular[seen], vt[seen]


def _principal(spread: Array) -> Array:
    """Return the principal axes of a covariance, one standard deviation long."""
    power, axes = np.linalg.eigh(0.5 * (spread + spread.T))
    least = 1e-12 * power.max(initial=0.0)  # rounding may make a variance negative
    return np.asarray(axes * np.sqrt(np.maximum(power, least)))


@dataclass(frozen=True, eq=False)
class Block:
    """One test in a covariance, with all quantities scaled so that directions are comparable.

    The covariance has m unknowns. For a single test these are its k parameters; for several tests
    the parameters of a test depend on common unknowns and on its own ones.
    """

    jacobian: Array  # (n, k): derivatives of the residuals of its curves in turn, then of priors
    sizes: tuple[int, ...]  # samples of each curve; the remaining rows are priors
    noise: Sequence[NoiseProcess]  # of each curve
    through: Array  # (k, m): derivatives of its parameters by the unknowns
    # Jᵀr after a step from the best point; None where the residual is noise only, so that the
    # curvature is JᵀJ.
    gradient: Callable[[Array], Array] | None = None
    # (n, q): change of the residual by one standard error of each quantity that the fit takes as
    # exact, like a parameter held where the record shows it
    shifts: Array | None = None
    # (n, q): change of the residual by one standard deviation of each mode of an uncertain motion;
    # such waves are slow, so the noise of a curve with model error does not contain them
    modes: Array | None = None
    of_priors: float | Array = 1.0  # variance of the remaining residuals

    @cached_property
    def axes(self) -> tuple[Array, Array]:
        """Factors of the Jacobian: orthonormal columns (n, r) and orthogonal rows (r, k)."""
        left, singular, vt = _directions(self.jacobian)
        return left, singular[:, None] * vt

    @property
    def curves(self) -> list[tuple[NoiseProcess, Array]]:
        """Noise of each curve, and its rows of the orthonormal columns."""
        pairs = zip(self.noise, parts(self.sizes), strict=True)
        return [(one, self.axes[0][part]) for one, part in pairs]

    @cached_property
    def meat(self) -> Array:
        """Covariance of the noise along the orthonormal columns, (r, r)."""
        rest = self.axes[0][sum(self.sizes) :]
        inner = sum(left.T @ one.times(left) for one, left in self.curves)
        if self.modes is not None:
            along = self.axes[0].T @ self.modes
            inner = inner + along @ along.T
        return np.asarray(inner + rest.T @ (np.reshape(self.of_priors, (-1, 1)) * rest))

    def curvature(self, spread: Array) -> Array:
        """Return the curvature of half the cost along the orthonormal columns, (r, r).

        In this basis JᵀJ is the unit matrix. The curvature is a difference of gradients, one
        standard error to either side along the principal axes of the covariance `spread` (r, r). A
        curved valley adds a fourth-order term; where it exceeds the effect of kinks, which longer
        steps average better, it is removed by half the step (Richardson 1911).
        """
        unit, axes = np.eye(len(spread)), _principal(spread)
        if self.gradient is None or not len(spread):
            return unit
        try:
            short, whole = (np.linalg.solve(axes.T, self._bent(axes, p)) for p in (0.5, 1.0))
        except np.linalg.LinAlgError:
            return unit
        fourth = float(np.max(np.abs(whole - short))) ** 2
        curved = whole + (4.0 / 3.0) * fourth / (KINKED**2 + fourth) * (short - whole)
        return np.asarray(0.5 * (curved + curved.T))

    def _bent(self, axes: Array, part: float) -> Array:
        """Return the changes of the gradient along each axis per `part` of its length, (r, r)."""
        assert self.gradient is not None
        rows = self.axes[1]
        unit_steps = rows.T / np.sum(rows**2, axis=1)
        steps = part * (unit_steps @ axes).T
        change = [self.gradient(step) - self.gradient(-step) for step in steps]
        return np.asarray(np.array(change) @ unit_steps / (2.0 * part))


@dataclass(eq=False)
class Uncertainty:
    """Uncertainty of m unknowns due to noise at the best point of one test or several.

    The scaled covariance is H⁻¹ JᵀΣJ H⁻¹, with Σ the noise covariance of the curves of all tests.
    H is JᵀJ or, with `curvatures` (of each block, along its `Block.axes`), the Hessian of half the
    cost, which differs from JᵀJ if there is model error (White 1982, Econometrica 50, 1). A block
    without curves has residuals that belong to no test. All is computed along s directions of the
    unknowns, along which all residuals together have unit slopes.
    """

    blocks: tuple[Block, ...]
    scales: Array  # (m,)
    curvatures: tuple[Array, ...] | None = None

    def __post_init__(self) -> None:
        """Solve for the directions.

        `root` (m, s) contains the steps of the unknowns that are unit steps along the directions,
        `lefts` the components of these along each block's orthonormal columns; `lost` (m,) are the
        unknowns that the tests do not determine, and `errs` is whether a test has model error.
        """
        rows = [block.axes[1] @ block.through for block in self.blocks]
        every, singular, vt = _directions(np.concatenate(rows))
        self.lefts = np.split(every, np.cumsum([len(row) for row in rows[:-1]]))
        self.root = vt.T / singular
        along = self.root / np.maximum(np.linalg.norm(self.root, axis=0), 1e-300)
        self.lost: NDArray[np.bool_] = np.sum(along**2, axis=1) < 1.0 - 1e-6
        self.errs = any(block.gradient for block in self.blocks)

    @cached_property
    def axes(self) -> Array:
        """Principal axes of the covariance of the noise, one standard deviation long, (s, s)."""
        pairs = zip(self.lefts, self.blocks, strict=True)
        return _principal(np.asarray(sum(left.T @ block.meat @ left for left, block in pairs)))

    @cached_property
    def _bread(self) -> Array:
        """H⁻¹ along the directions; that of JᵀJ without curvature."""
        if self.curvatures is None:
            return np.eye(self.root.shape[1])
        pairs = zip(self.lefts, self.curvatures, strict=True)
        out = np.asarray(sum(left.T @ curved @ left for left, curved in pairs))
        values, vectors = np.linalg.eigh(0.5 * (out + out.T))
        return np.asarray((vectors / np.maximum(values, FLATTEST)) @ vectors.T)

    @cached_property
    def inverse(self) -> Array:
        """H⁻¹, (m, m); zero for undetermined unknowns."""
        return self.root @ self._bread @ self.root.T

    @cached_property
    def matrix(self) -> Array:
        """Covariance of the scaled unknowns, (m, m); NaN for undetermined ones."""
        spread = self.root @ self._bread @ self.axes
        out = spread @ spread.T
        for left, block in zip(self.lefts, self.blocks, strict=True):
            if block.shifts is not None:
                # So far away the curvature of a cost with kinks is unknown, and JᵀJ is used.
                pulls = self.root @ left.T @ (block.axes[0].T @ block.shifts)
                out = out + pulls @ pulls.T
        out[self.lost, :] = out[:, self.lost] = np.nan
        return out

    @cached_property
    def bent(self) -> Uncertainty:
        """The same with the curvature of the cost of each test."""
        spreads = [left @ self.axes for left in self.lefts]
        pairs = zip(self.blocks, spreads, strict=True)
        return replace(self, curvatures=tuple(block.curvature(s @ s.T) for block, s in pairs))

    @cached_property
    def sandwich(self) -> Covariance:
        """Covariance, SI, with H as it is here."""
        tests = [block for block in self.blocks if block.sizes]
        effective = [sum(len(x) / one.tau for one, x in block.curves) for block in tests]
        used = np.array([(block.through != 0.0).any(axis=0) for block in tests])
        freedom = np.full(self.scales.size, sum(effective) - self.scales.size)
        for own, count in zip(used & (used.sum(axis=0) == 1), effective, strict=True):
            freedom[own] = count - np.count_nonzero(own)
        return Covariance(
            self.matrix * np.outer(self.scales, self.scales),
            np.diag(self.matrix) / np.where(self.lost, np.nan, np.diag(self.inverse)),
            np.maximum(freedom, 1.0),
            float(sum(effective)),
        )

    @cached_property
    def covariance(self) -> Covariance:
        """Covariance of the unknowns, SI, with the curvature of the cost if there is model error.

        The curvature of a cost with kinks is only roughly known, so it does not reduce any
        variance.
        """
        plain = self.sandwich
        if not self.errs:
            return plain
        bent = self.bent.sandwich
        more = np.sqrt(np.fmax(np.diag(plain.matrix) / np.diag(bent.matrix), 1.0))
        matrix, inflation = bent.matrix * np.outer(more, more), bent.inflation * more**2
        return replace(bent, matrix=matrix, inflation=inflation)


def covariance(
    jacobian: Array, residual: Array, sizes: tuple[int, ...], scales: Array, of_priors: float = 1.0
) -> Covariance:
    """Return the covariance of a least-squares fit of one test, with noise from its residual.

    `residual` (n,) and `jacobian` (n, k) are taken at the best point; they contain `sizes` samples
    of each curve in turn, then those of priors, of variance `of_priors`. `scales` (k,) are those of
    the parameters.
    """
    scaled = jacobian * scales
    noise = noise_processes(residual, scaled, sizes)
    block = Block(scaled, sizes, noise, np.eye(scales.size), of_priors=of_priors)
    return Uncertainty((block,), scales).covariance


def half_width(stderr: float, freedom: float) -> float:
    """Return half of the 95 % interval by Student's t with `freedom` degrees of freedom."""
    return float(stats.t.ppf(0.975, max(freedom, 1.0))) * stderr


def wider(ends: Ends, span: Ends | None) -> tuple[Ends, str]:
    """Return the wider of a 95 % interval and a range, and its name."""
    if span is not None and span[1] - span[0] > ends[1] - ends[0]:
        return span, "range"
    return ends, "95 % interval"


def scale_in_words(name: str, value: float, scale: float) -> str:
    """Return the scale of a parameter in words: its value, or a number with its unit."""
    if math.isclose(scale, abs(value), rel_tol=1e-9):
        return "its value"
    return engineering(scale, unit_of(name))


def state(
    name: str, value: float, interval: tuple[Ends, str], size: float, limits: Ends
) -> tuple[str, str]:
    """Return the state of a varied parameter whose branch was reached, and the reason.

    It is determined if both sides of its 95 % interval, or half of its range, are within `WEAK`
    times its scale `size`, not determined if half of either is wider than `NOTHING`, otherwise
    weak. `interval` is the wider of both, not cut at the limits; NaN where the data fix only a
    combination.
    """
    ((low, high), what), of = interval, scale_in_words(name, value, size)
    half = 0.5 * (high - low)
    if not math.isfinite(half):
        return "not determined", "the data fix only a combination of it with other parameters"
    ratio = half / size
    if half > NOTHING * size:
        wide = "more than 100 times" if ratio > 100.0 else f"±{percent(ratio)} of"
        return "not determined", f"its {what} is {wide} {of}"
    for limit in limits:
        if abs(value - limit) <= AT_LIMIT * size:
            at = "it lies at its limit" if limit else "it lies at its limit 0"
            return "weak", f"{at}; its interval is open on that side"
    width = f"its {what} is ±{percent(ratio)} of {of}"
    far = half if what == "range" else max(high - value, value - low)
    if half <= WEAK * size < far:  # another minimum lies to one side
        width = f"its {what} reaches {percent(far / size)} of {of} to one side"
    return "weak" if far > WEAK * size else "determined", width
