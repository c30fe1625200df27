"""How sure the identified parameters are: covariance, intervals, and which are determined at all.

An interval tells where the best that the law can do would lie if the tests were measured again. So
the covariance has the noise alone in it, correlated as it is (`noise_process`); an error of the law
(`law_error`) only changes how the best point follows the noise. One test is the case of a single
block whose parameters are the unknowns.
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
from foamfit.fitting.box import scale_in_words
from foamfit.text import percent
from foamfit.trust.residuals.noise_process import NoiseProcess, noise_processes, parts

Ends = tuple[float, float]
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
    def stderr(self) -> Array:
        """Standard errors, (k,)."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def correlation(self) -> Array:
        """Correlation matrix, (k, k)."""
        scale = self.stderr
        return self.matrix / np.outer(scale, scale)


def _directions(rows: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of some rows, without the directions that they do not show."""
    left, singular, vt = np.linalg.svd(rows, full_matrices=False)
    seen = singular > SINGULAR * max(float(singular.max(initial=0.0)), 1e-300)
    return left[:, seen], singular[seen], vt[seen]


@dataclass(frozen=True, eq=False)
class Block:
    """One test in a covariance; everything is scaled, so that directions compare.

    The covariance is that of m unknowns. Those of one test are its k parameters themselves; what
    several tests have in common, one unknown for all, its parameters follow.
    """

    jacobian: Array  # (n, k): Slopes of its curves, one after the other, then of priors
    residual: Array  # (n,)
    sizes: tuple[int, ...]  # Samples of each curve; what is behind them are priors of unit variance
    noise: Sequence[NoiseProcess]  # Of each curve
    through: Array  # (k, m): How its parameters follow the unknowns
    # Jᵀr of some parameters (their places) at a step of these off the best point; None where the
    # law misses no more than noise, so that the curvature is JᵀJ.
    gradient: Callable[[NDArray[np.intp], Array], Array] | None = None
    room: Array | None = None  # (k, 2): How far they are above and below their limits
    # (k,): What one standard error of a quantity that is taken for exact does to its parameters.
    given: Array | None = None

    @cached_property
    def axes(self) -> tuple[Array, Array]:
        """Orthonormal columns (n, r), and what leads from parameters to them (r, k): J is both."""
        left, singular, vt = _directions(self.jacobian)
        return left, singular[:, None] * vt

    @cached_property
    def steps(self) -> Array:
        """Parameters that lead to each of the orthonormal columns, (k, r)."""
        rows = self.axes[1]
        return np.asarray(rows.T / np.sum(rows**2, axis=1))

    @cached_property
    def meat(self) -> Array:
        """Covariance of the noise along the orthonormal columns, (r, r)."""
        left = self.axes[0]
        pairs = zip(self.noise, parts(self.sizes), strict=True)
        inner = np.sum([left[p].T @ one.times(left[p]) for one, p in pairs], axis=0)
        rest = left[sum(self.sizes) :]
        return np.asarray(inner + rest.T @ rest)

    @property
    def effective(self) -> float:
        """Effective number of samples."""
        return float(sum(n / one.tau for n, one in zip(self.sizes, self.noise, strict=True)))

    def doubt(self, mix: Array) -> Array:
        """Variance of the variances that the noise makes along `mix` (r, m), (m,)."""
        left = self.axes[0]
        pairs = zip(self.noise, parts(self.sizes), strict=True)
        return np.asarray(np.sum([one.doubt(left[p], mix) for one, p in pairs], axis=0))

    def without(self, held: NDArray[np.bool_]) -> Block:
        """The block with some of the unknowns held."""
        rows = np.flatnonzero(~(self.through[:, held] != 0.0).any(axis=1))
        full = self.gradient
        return replace(
            self,
            jacobian=self.jacobian[:, rows],
            through=self.through[np.ix_(rows, ~held)],
            gradient=full and (lambda places, step: full(rows[places], step)),
            given=None if self.given is None else self.given[rows],
        )

    def curvature(self, spread: Array) -> Array:
        """Curvature of half the cost along the orthonormal columns, (r, r), where JᵀJ is one.

        By differences of the gradient, one standard error to either side along the principal axes
        of `spread` (r, r), the covariance there.
        """
        none = np.eye(len(spread))
        if self.gradient is None or not len(spread):
            return none
        power, axes = np.linalg.eigh(0.5 * (spread + spread.T))
        axes = axes * np.sqrt(np.maximum(power, 1e-12 * power.max()))
        every = np.arange(self.jacobian.shape[1])
        change = [
            0.5 * (self.gradient(every, step) - self.gradient(every, -step))
            for step in (self.steps @ axes).T
        ]
        try:
            found = np.linalg.solve(axes.T, np.array(change) @ self.steps)
        except np.linalg.LinAlgError:
            return none
        return np.asarray(0.5 * (found + found.T))


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the noise leaves uncertain of m unknowns at the best point of one test or several.

    A covariance H⁻¹ JᵀΣJ H⁻¹ with Σ the noise of the curves of all tests, scaled. H is JᵀJ, or with
    `curvatures` (of each test, along its `Block.axes`) that of half the cost, which a residual that
    is no noise changes (White 1982, Econometrica 50, 1). `bend` (m, m) is what the bend of
    `Block.through` adds to H. `drawn` (d, m) are the slopes of further residuals, of so much
    variance each (d,). All is computed along s directions of the unknowns along which the residuals
    of all tests together have unit slopes.
    """

    blocks: tuple[Block, ...]
    scales: Array  # (m,)
    drawn: tuple[Array, Array] | None = None
    bend: Array | None = None
    curvatures: tuple[Array, ...] | None = None

    @property
    def errs(self) -> bool:
        """Whether the law misses more of some test than noise."""
        return any(block.gradient for block in self.blocks)

    @cached_property
    def _solved(self) -> tuple[Array, Array]:
        rows = [block.axes[1] @ block.through for block in self.blocks]
        rows += [] if self.drawn is None else [self.drawn[0]]
        left, singular, vt = _directions(np.concatenate(rows))
        return left, vt.T / singular

    @property
    def root(self) -> Array:
        """Unknowns that lead to each of the directions, (m, s)."""
        return self._solved[1]

    @cached_property
    def lost(self) -> NDArray[np.bool_]:
        """Unknowns of which the tests say nothing, (m,)."""
        along = self.root / np.maximum(np.linalg.norm(self.root, axis=0), 1e-300)
        return np.asarray(np.sum(along**2, axis=1) < 1.0 - 1e-6)

    @cached_property
    def lefts(self) -> list[Array]:
        """The directions along the orthonormal columns of each test (r, s), then of `drawn`."""
        return np.split(self._solved[0], np.cumsum([len(block.axes[1]) for block in self.blocks]))

    @property
    def _pairs(self) -> list[tuple[Array, Block]]:
        return list(zip(self.lefts, self.blocks, strict=False))

    @cached_property
    def axes(self) -> Array:
        """Principal axes of the covariance of the noise, one deviation long, (s, s)."""
        rows = [block.meat @ left for left, block in self._pairs]
        rows += [] if self.drawn is None else [self.drawn[1][:, None] * self.lefts[-1]]
        meat = self._solved[0].T @ np.concatenate(rows)
        power, axes = np.linalg.eigh(0.5 * (meat + meat.T))
        least = 1e-12 * power.max(initial=0.0)  # no variance is negative
        return np.asarray(axes * np.sqrt(np.maximum(power, least)))

    @cached_property
    def _bread(self) -> Array:
        """H⁻¹ along the directions; where there is no curvature, that of JᵀJ."""
        out = np.eye(self.root.shape[1])
        if self.curvatures is None:
            return out
        pairs = list(zip(self.lefts, self.curvatures, strict=False))
        more = [(curved - np.eye(len(curved))) @ left for left, curved in pairs]
        out += np.concatenate([left for left, _ in pairs]).T @ np.concatenate(more)
        out += 0.0 if self.bend is None else self.root.T @ self.bend @ self.root
        values, vectors = np.linalg.eigh(0.5 * (out + out.T))
        return np.asarray((vectors / np.where(values > FLATTEST, values, 1.0)) @ vectors.T)

    @cached_property
    def inverse(self) -> Array:
        """H⁻¹, (m, m); zero where the tests say nothing."""
        return self.root @ self._bread @ self.root.T

    @cached_property
    def matrix(self) -> Array:
        """The covariance of the scaled unknowns, (m, m); NaN where the tests say nothing."""
        spread = self.root @ self._bread @ self.axes
        out = spread @ spread.T
        for t, (left, block) in enumerate(self._pairs):
            if block.given is not None and block.given.any():
                moved = block.axes[1] @ block.given
                moved = moved if self.curvatures is None else self.curvatures[t] @ moved
                pull = self.root @ self._bread @ left.T @ moved
                out = out + np.outer(pull, pull)
        out[self.lost, :] = out[:, self.lost] = np.nan
        return out

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Unknowns that the residuals press to a limit by more than their noise could, (m,)."""
        pull, sure = np.zeros((2, self.scales.size))
        near = np.zeros((2, self.scales.size), dtype=bool)
        for block in self.blocks:
            slopes = block.axes[1] @ block.through
            pull += block.through.T @ (block.jacobian.T @ block.residual)
            sure += np.einsum("ij,ij->j", slopes, block.meat @ slopes)
            if block.room is not None:
                near |= (block.room.T <= AT_LIMIT) @ (block.through != 0.0)
        outward = np.where(near[0], pull, np.where(near[1], -pull, 0.0))
        return np.asarray(outward > 1.96 * np.sqrt(sure))

    @cached_property
    def bent(self) -> Uncertainty:
        """With the curvature of the cost of each test, what is pressed to a limit held."""
        free, one = ~self.held, self
        if not free.all():
            one = Uncertainty(
                tuple(block.without(self.held) for block in self.blocks),
                self.scales[free],
                None if self.drawn is None else (self.drawn[0][:, free], self.drawn[1]),
                None if self.bend is None else self.bend[np.ix_(free, free)],
            )
        spreads = [left @ one.axes for left in one.lefts]
        pairs = zip(one.blocks, spreads, strict=False)
        return replace(one, curvatures=tuple(block.curvature(s @ s.T) for block, s in pairs))

    @cached_property
    def sandwich(self) -> Covariance:
        """The covariance, SI, with the curvature that this has."""
        back, m = self._bread @ self.root.T, self.scales.size
        variance, doubt, most = np.zeros((3, m))
        there = np.array([(block.through != 0.0).any(axis=0) for block in self.blocks])
        own = there & (there.sum(axis=0) == 1)
        effective = sum(block.effective for block in self.blocks)
        for (left, block), mine in zip(self._pairs, own, strict=True):
            mix = left @ back
            variance += np.einsum("ij,ij->j", mix, block.meat @ mix)
            doubt += block.doubt(mix)
            most[mine] = block.effective - np.count_nonzero(mine)
        most[~own.any(axis=0)] = effective - m
        if self.drawn is not None:
            mix = self.lefts[-1] @ back
            variance += self.drawn[1] @ mix**2
        known = 2.0 * variance**2 / np.maximum(doubt, 1e-300)
        return Covariance(
            self.matrix * np.outer(self.scales, self.scales),
            np.diag(self.matrix) / np.where(self.lost, np.nan, np.diag(self.inverse)),
            np.minimum(known, np.maximum(most, 1.0)),
            effective,
            tuple(one for block in self.blocks for one in block.noise),
        )

    @cached_property
    def covariance(self) -> Covariance:
        """Covariance of the unknowns, SI: with the curvature of the cost where a law errs.

        That makes no variance smaller: the curvature of a cost with kinks is known to some tenths.
        What is held is correlated with nothing.
        """
        plain = self.sandwich
        if not self.errs or self.held.all():
            return plain
        free, bent, variance = np.flatnonzero(~self.held), self.bent.sandwich, np.diag(plain.matrix)
        more = np.sqrt(np.fmax(variance[free] / np.diag(bent.matrix), 1.0))
        matrix, inflation, freedom = np.diag(variance), plain.inflation.copy(), plain.freedom.copy()
        matrix[np.ix_(free, free)] = bent.matrix * np.outer(more, more)
        inflation[free], freedom[free] = bent.inflation * more**2, bent.freedom
        return replace(plain, matrix=matrix, inflation=inflation, freedom=freedom)


def covariance(
    jacobian: Array, residual: Array, sizes: tuple[int, ...], sizes_of: Array
) -> Covariance:
    """Covariance of the least squares of one test, its noise read off the residual.

    `residual` (n,) and `jacobian` (n, k) are those of the best point, so many samples of each curve
    as in `sizes` and behind them priors of unit variance; `sizes_of` (k,) are the scales of the
    parameters.
    """
    scaled = jacobian * sizes_of
    noise = noise_processes(residual, scaled, sizes)
    block = Block(scaled, residual, sizes, noise, np.eye(sizes_of.size))
    return Uncertainty((block,), sizes_of).covariance


def half_width(stderr: float, freedom: float) -> float:
    """Half of the 95 % interval by Student's t with `freedom` degrees of freedom."""
    return float(stats.t.ppf(0.975, max(freedom, 1.0))) * stderr


def wider(ends: Ends, span: Ends | None) -> tuple[Ends, str]:
    """The wider of a 95 % interval and of a range, and which it is."""
    if span is not None and span[1] - span[0] > ends[1] - ends[0]:
        return span, "range"
    return ends, "95 % interval"


def state(
    name: str, value: float, known: tuple[Ends, str], size: float, limits: Ends
) -> tuple[str, str]:
    """State of a parameter that was varied and whose branch was reached, and why.

    The rule (`RULE`): determined if its 95 % interval and its range are within ±`WEAK` of its
    scale, not determined if one of them is wider than ±`NOTHING`, weak between. `known` is the
    wider of the two (`wider`), not cut at the limits, NaN where the data fix only a combination;
    `size` is its scale.
    """
    ((low, high), what), of = known, scale_in_words(name, value, size)
    half = 0.5 * (high - low)
    if not math.isfinite(half):
        return "not determined", "the data fix only a combination of it with other parameters"
    ratio = half / size
    if half > NOTHING * size:
        wide = "more than 100 times" if ratio > 100.0 else f"±{ratio:.2g} times"
        return "not determined", f"its {what} is {wide} {of}"
    for limit in limits:
        if abs(value - limit) <= AT_LIMIT * size:
            return "weak", f"it lies at its limit {limit:g}; its interval is open on that side"
    width = f"its {what} is ±{percent(ratio)} of {of}"
    return "weak" if half > WEAK * size else "determined", width
