"""How sure the parameters of a joint fit are: the sandwich covariance by blocks, linear in tests.

The curvature H of the cost has a block for each test that only the shared coordinates couple. With
the own parameters u of the tests eliminated, B = H_ss - Σ H_su H_uu⁻¹ H_us, gradients g of noise
move the shared coordinates by -B⁻¹ Σ P g, P = [1, -H_su H_uu⁻¹], and the own ones of a test by
-H_uu⁻¹ (g_u + H_us δs). The covariance of g in a test is JᵀΣJ with Σ the noise of its curves, as
for one test (`trust.covariance`); where the law misses more than noise, H is the curvature itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.fitting.links import LOG_RATE, RATES, law, law_bend, law_slopes
from foamfit.fitting.together import Together
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import AT_LIMIT, FLATTEST
from foamfit.trust.residuals.law_error import CurveError
from foamfit.trust.residuals.noise_process import NoiseProcess, parts

# Directions whose curvature is below this share of the largest are not seen.
UNSEEN = 1e-13


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Covariance of what all tests have in common and of the parameters of each test, SI.

    `names` are those of the shared coordinates: of a parameter itself, of its logarithm where it
    scatters, and with ":b" of the slope of a law of rate. NaN where the tests say nothing.
    """

    names: tuple[str, ...]
    matrix: Array  # (s, s)
    freedom: Array  # (s,): Degrees of freedom of each variance, as `Covariance.freedom`
    # Of each test: its parameters that vary and whose branch was reached, their covariance and
    # degrees of freedom.
    locals: tuple[tuple[str, ...], ...]
    matrices: tuple[Array, ...]
    freedoms: tuple[Array, ...]
    effective: float  # Effective number of samples of all tests

    def of_test(self, test: int, name: str) -> tuple[float, float]:
        """Standard error and degrees of freedom of a parameter of one test; NaN if unreached."""
        if name not in self.locals[test]:
            return float("nan"), 1.0
        at = self.locals[test].index(name)
        return float(np.sqrt(self.matrices[test][at, at])), float(self.freedoms[test][at])

    def of_common(self, name: str) -> tuple[float, float]:
        """Standard error and degrees of freedom of a shared coordinate; NaN if it is none."""
        if name not in self.names:
            return float("nan"), 1.0
        at = self.names.index(name)
        return float(np.sqrt(self.matrix[at, at])), float(self.freedom[at])


@dataclass(frozen=True, eq=False)
class _Block:
    """One test: slopes of its residual by the shared coordinates and by its own parameters.

    Everything is scaled. `through` (k, s + q) leads from shared and own coordinates to the k
    parameters of the test, `bend` (s, s) is what the bend of the links adds to the curvature.
    `pulls` are rows (r, s + q) by which scattering parameters are drawn to their common value, and
    `drawn` the same for the covariance of what draws them. `rated` (k,) is what one standard error
    of the rate of the test does to parameters that follow a law of it.
    """

    best: BestPoint
    names: tuple[str, ...]  # (k,)
    jacobian: Array  # (n, k)
    through: Array
    bend: Array
    pulls: Array
    drawn: Array
    rated: Array
    noise: tuple[NoiseProcess, ...]  # Of each curve
    curvature: Array | None = None  # (k, k), where it is not JᵀJ

    @cached_property
    def slopes(self) -> Array:
        """Slopes of the residual by shared and own coordinates, (n, s + q)."""
        return self.jacobian @ self.through

    @cached_property
    def _inner(self) -> Array:
        """Curvature of half the cost by the parameters of the test, (k, k)."""
        return self.jacobian.T @ self.jacobian if self.curvature is None else self.curvature

    @cached_property
    def hessian(self) -> Array:
        """Curvature of half the cost, (s + q, s + q)."""
        s = len(self.bend)
        out = self.through.T @ self._inner @ self.through + self.pulls.T @ self.pulls
        if self.curvature is not None:
            out[:s, :s] += self.bend
        return np.asarray(out)

    @cached_property
    def meat(self) -> Array:
        """Covariance of the gradient, (s + q, s + q)."""
        out = self.drawn.T @ self.drawn
        if self.rated.any():
            pull = self.through.T @ self._inner @ self.rated
            out = out + np.outer(pull, pull)
        return np.asarray(out + self.slopes.T @ self.times(self.slopes))

    def times(self, columns: Array) -> Array:
        """Covariance of the noise times columns (n, m)."""
        pairs = zip(self.noise, self.parts, strict=True)
        priors = columns[self.best.problem.objective.n_data :]  # of unit variance
        return np.concatenate([*(process.times(columns[p]) for process, p in pairs), priors])

    def doubt(self, columns: Array) -> Array:
        """Variance of the variance that the noise makes of each column, (m,)."""
        pairs = zip(self.noise, self.parts, strict=True)
        return np.asarray(np.sum([process.doubt(columns[p]) for process, p in pairs], axis=0))

    @property
    def effective(self) -> float:
        """Effective number of samples."""
        sizes = self.best.problem.objective.sizes
        return sum(n / process.tau for n, process in zip(sizes, self.noise, strict=True))

    @cached_property
    def parts(self) -> list[slice]:
        """Samples of each curve."""
        return parts(self.best.problem.objective.sizes)

    def kept(self, columns: NDArray[np.intp]) -> _Block:
        """The block with some of the shared and own coordinates only; the others are held."""
        shared = columns[columns < len(self.bend)]
        return replace(
            self, through=self.through[:, columns], pulls=self.pulls[:, columns],
            drawn=self.drawn[:, columns], bend=self.bend[np.ix_(shared, shared)],
        )  # fmt: skip


def _inverse(matrix: Array, plain: Array | None = None) -> tuple[Array, NDArray[np.bool_]]:
    """Inverse of a positive matrix where it is seen, and what of its coordinates is not.

    With `plain`, directions in which the curvature is hardly any of that one take that one's.
    """
    if not matrix.size:
        return matrix, np.zeros(0, dtype=bool)
    base = matrix if plain is None else plain
    scale = np.sqrt(np.maximum(np.diag(base), 1e-300))
    power, axes = np.linalg.eigh(base / np.outer(scale, scale))
    seen = power > UNSEEN * max(float(power[-1]), 1e-300)
    root = axes[:, seen] / np.sqrt(power[seen]) / scale[:, None]  # plain is one in it
    lost = np.any(np.abs(axes[:, ~seen]) > 1e-3, axis=1)
    if plain is None:
        return root @ root.T, lost
    bent, vectors = np.linalg.eigh(root.T @ (0.5 * (matrix + matrix.T)) @ root)
    inner = root @ vectors
    return np.asarray((inner / np.where(bent > FLATTEST, bent, 1.0)) @ inner.T), lost


@dataclass(frozen=True, eq=False)
class Arrow:
    """The blocks of all tests, solved: covariances of shared and own coordinates, all scaled."""

    blocks: tuple[_Block, ...]
    plain: bool = True  # Whether the curvature is JᵀJ everywhere

    @property
    def s(self) -> int:
        """Number of shared coordinates."""
        return len(self.blocks[0].bend)

    @cached_property
    def _own(self) -> list[tuple[Array, Array, NDArray[np.bool_]]]:
        """Of each test: H_uu⁻¹, H_uu⁻¹ H_us, what of the own parameters is not seen."""
        out, s = [], self.s
        for block in self.blocks:
            plain = None
            if not self.plain and block.curvature is not None:
                plain = replace(block, curvature=None).hessian[s:, s:]
            inverse, lost = _inverse(block.hessian[s:, s:], plain)
            out.append((inverse, inverse @ block.hessian[s:, :s], lost))
        return out

    @cached_property
    def _shared(self) -> tuple[Array, NDArray[np.bool_]]:
        """B⁻¹, and what of the shared coordinates is not seen."""
        s, plain = self.s, None
        bread = np.zeros((s, s))
        for block, (_, gain, _) in zip(self.blocks, self._own, strict=True):
            bread += block.hessian[:s, :s] - block.hessian[:s, s:] @ gain
        if not self.plain:
            flat = Arrow(tuple(replace(block, curvature=None) for block in self.blocks))
            plain = np.zeros((s, s))
            for block, (_, gain, _) in zip(flat.blocks, flat._own, strict=True):
                plain += block.hessian[:s, :s] - block.hessian[:s, s:] @ gain
        return _inverse(bread, plain)

    @cached_property
    def _ways(self) -> list[Array]:
        """P of each test, (s, s + q)."""
        return [np.hstack([np.eye(self.s), -gain.T]) for _, gain, _ in self._own]

    @cached_property
    def shared(self) -> Array:
        """Covariance of the shared coordinates, (s, s)."""
        bread = self._shared[0]
        meat = np.zeros((self.s, self.s))
        for way, block in zip(self._ways, self.blocks, strict=True):
            meat += way @ block.meat @ way.T
        return bread @ meat @ bread

    @property
    def unseen(self) -> NDArray[np.bool_]:
        """Shared coordinates of which the tests say nothing, (s,)."""
        return self._shared[1]

    def step(self, at: int) -> Array:
        """Column of the inverse curvature of the shared coordinates, (s,)."""
        return np.asarray(self._shared[0][:, at])

    def after(self, test: int, shared: Array) -> Array:
        """How the own parameters of a test follow a step of the shared coordinates, (q,)."""
        return np.asarray(-self._own[test][1] @ shared)

    def lost(self, test: int) -> NDArray[np.bool_]:
        """Own parameters of which a test says nothing, (q,)."""
        return self._own[test][2]

    def _with_gradient(self, test: int) -> Array:
        """Covariance of the own gradient of a test and the shared coordinates, (q, s)."""
        product = self.blocks[test].meat @ self._ways[test].T
        return np.asarray(-product[self.s :] @ self._shared[0])

    def of_test(self, test: int) -> Array:
        """Covariance of shared and own coordinates of a test, (s + q, s + q)."""
        s, v = self.s, self.shared
        inverse, gain, _ = self._own[test]
        block, side = self.blocks[test], self._with_gradient(test)
        h_us = block.hessian[s:, :s]
        inner = block.meat[s:, s:] + side @ h_us.T + h_us @ side.T + h_us @ v @ h_us.T
        cross = -(inverse @ side + gain @ v)
        return np.block([[v, cross.T], [cross, inverse @ inner @ inverse]])

    def inverse(self, test: int) -> Array:
        """Block of a test of the inverse curvature, (s + q, s + q)."""
        own, gain, _ = self._own[test]
        bread = self._shared[0]
        cross = -gain @ bread
        return np.block([[bread, cross.T], [cross, own - cross @ gain.T]])

    def errors(self, test: int) -> Array:
        """What each sample of a test does to shared and own coordinates, (n, s + q)."""
        block, s = self.blocks[test], self.s
        shared = block.slopes @ self._ways[test].T @ self._shared[0]
        own = (block.slopes[:, s:] - shared @ block.hessian[:s, s:]) @ self._own[test][0]
        return np.hstack([shared, own])

    def across(self, places: Sequence[int | None]) -> tuple[Array, Array]:
        """Covariance of one own coordinate of every test, (n, n), and the inverse curvature.

        `places` say where it stands among the own ones of each test; NaN where it is not there.
        """
        n, s = len(self.blocks), self.s
        gains, sides = np.zeros((n, s)), np.zeros((n, s))
        own, breads = np.full(n, np.nan), np.full(n, np.nan)
        for t, place in enumerate(places):
            if place is None or self.lost(t)[place]:
                continue
            inverse, gain, _ = self._own[t]
            gains[t], sides[t] = gain[place], (inverse @ self._with_gradient(t))[place]
            own[t] = (inverse @ self.blocks[t].meat[s:, s:] @ inverse)[place, place]
            breads[t] = inverse[place, place]
        both = sides @ gains.T
        matrix = np.diag(own) + both + both.T + gains @ self.shared @ gains.T
        bread = np.diag(breads) + gains @ self._shared[0] @ gains.T
        gone = np.isnan(own)
        matrix[gone, :] = matrix[:, gone] = np.nan
        bread[gone, :] = bread[:, gone] = np.nan
        return matrix, bread


# ------------------------------------------------------------------------------- of a joint fit


@dataclass(frozen=True, eq=False)
class JointPoint:
    """The best point of a joint fit, and what holds locally there.

    `errors` are those of the curves of each test (`BestPoint.errors`), `inflations` (n,) of each
    scattering parameter its variance over that of white noise, by which the weight that draws it to
    the common value is larger than its spread says.
    """

    found: Together
    errors: tuple[tuple[CurveError, ...], ...] = ()
    inflations: Mapping[str, Array] = field(default_factory=dict)

    @cached_property
    def bests(self) -> tuple[BestPoint, ...]:
        """The best point of each test."""
        pairs = zip(self.found.problems, self.found.values, strict=True)
        return tuple(BestPoint(problem, values) for problem, values in pairs)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the shared coordinates; see `JointCovariance`."""
        out = list[str]()
        for name in self.found.shared:
            out += [name, f"{name}:b"] if self.found.links.kind(name) in RATES else [name]
        return (*out, *self._scatter)

    @property
    def _scatter(self) -> tuple[str, ...]:
        links = self.found.links
        return tuple(name for name in self.found.own if links.kind(name) == "scatter")

    @cached_property
    def _scales(self) -> Array:
        """Scales of the shared coordinates."""
        out = []
        for name in self.names:
            if name in self.found.shared:
                best = next(b for b in self.bests if name in b.problem.free())
                out.append(float(best.problem.sizes((name,), best.values)[0]))
            else:
                out.append(1.0)  # a slope, or a logarithm
        return np.array(out)

    @cached_property
    def blocks(self) -> tuple[_Block, ...]:
        """The blocks of all tests."""
        return tuple(self._block(t) for t in range(len(self.bests)))

    def _block(self, t: int) -> _Block:
        best, links, s = self.bests[t], self.found.links, len(self.names)
        x = 0.0 if links.log_rates is None else float(links.log_rates[t])
        mine = [name for name in best.names if name in self.found.own]
        through, bend = np.zeros((len(best.names), s + len(mine))), np.zeros((s, s))
        jacobian = best.jacobian * best.sizes
        pull = jacobian.T @ best.residual
        for i, name in enumerate(best.names):
            if name in mine:
                through[i, s + mine.index(name)] = 1.0
                continue
            at, kind = self.names.index(name), links.kind(name)
            if kind not in RATES:
                through[i, at] = self._scales[at] / best.sizes[i]
                continue
            v, b = self.found.common[name]
            slopes = law_slopes(kind, v, b, x)
            through[i, at : at + 2] = slopes * self._scales[at : at + 2] / best.sizes[i]
            force = pull[i] / best.sizes[i] * self._scales[at + 1]
            bend[at, at + 1] = bend[at + 1, at] = force * slopes[1] / v * self._scales[at]
            bend[at + 1, at + 1] = force * law_bend(kind, v, b, x) * self._scales[at + 1]
        rows, wide = [], []
        for name in self._scatter:
            if name not in mine or name not in links.pulls:
                continue
            row, i = np.zeros(through.shape[1]), best.names.index(name)
            value = float(best.values[best.index[name]])
            row[s + mine.index(name)] = best.sizes[i] / value if value else 0.0
            row[self.names.index(name)] = -1.0
            rows.append(row * links.pulls[name][t])
            wide.append(rows[-1] * np.sqrt(self.inflations[name][t]))
        none = np.zeros((0, through.shape[1]))
        return _Block(
            best, best.names, jacobian, through, bend, np.array(rows) if rows else none,
            np.array(wide) if wide else none, self._rated(t),
            tuple(error.noise for error in self.errors[t]) if self.errors else (),
        )  # fmt: skip

    def _rated(self, t: int) -> Array:
        """What one standard error of the rate does to the scaled parameters of a test, (k,)."""
        best, links = self.bests[t], self.found.links
        out = np.zeros(len(best.names))
        if links.rate_errors is None:
            return out
        for i, name in enumerate(best.names):
            if (kind := links.kind(name)) in RATES and name in self.found.shared:
                v, b = self.found.common[name]
                x = 0.0 if links.log_rates is None else float(links.log_rates[t])
                out[i] = b * (v if kind == LOG_RATE else law(kind, v, b, x)) / best.sizes[i]
        return np.asarray(out * links.rate_errors[t])

    @cached_property
    def _plain(self) -> Arrow:
        return Arrow(self.blocks)

    def reach(self, name: str) -> float:
        """How far a shared value is off where the cost has risen by one; 0 where it is unseen."""
        at = self.names.index(name)
        if self._plain.unseen[at]:
            return 0.0
        return float(np.sqrt(self._plain.step(at)[at]) * self._scales[at])

    def moved(self, name: str, change: float) -> list[Array]:
        """Values of each test with a shared one moved, and the others after it, were all linear."""
        at, out = self.names.index(name), list[Array]()
        step = self._plain.step(at)
        shared = change / self._scales[at] * step / step[at]
        for t, (block, best) in enumerate(zip(self.blocks, self.bests, strict=True)):
            values, own = best.values.copy(), self._plain.after(t, shared)
            moves = block.through @ np.concatenate([shared, own]) * best.sizes
            for one, by in zip(best.names, moves, strict=True):
                low, high = best.limits(one)
                values[best.index[one]] = np.clip(values[best.index[one]] + by, low, high)
            out.append(values)
        return out

    def taken(self, test: int) -> Array:
        """What the joint fit took of the noise of a test; see `noise_processes`.

        Along a direction that several tests determine it took a share of each one's noise only.
        """
        block = self.blocks[test]
        inverse = block.through @ self._plain.inverse(test) @ block.through.T
        basis, triangle = np.linalg.qr(block.jacobian)
        share, axes = np.linalg.eigh(triangle @ inverse @ triangle.T)
        return np.asarray((basis @ axes) * np.sqrt(np.clip(share, 0.0, 1.0)))

    @cached_property
    def _held(self) -> list[NDArray[np.bool_]]:
        """Shared and own coordinates that lie at a limit and are pressed there, of each test."""
        s = len(self.names)
        pull, sure = np.zeros(s), np.zeros(s)
        for block in self.blocks:
            pull += block.slopes[:, :s].T @ block.best.residual
            sure += np.einsum("ij,ij->j", block.slopes[:, :s], block.times(block.slopes[:, :s]))
        out = list[NDArray[np.bool_]]()
        shared = np.zeros(s, dtype=bool)
        for block in self.blocks:
            best = block.best
            own_pull = block.slopes.T @ best.residual
            own_sure = np.einsum("ij,ij->j", block.slopes, block.times(block.slopes))
            own_pull[:s], own_sure[:s] = pull, sure
            held = np.zeros(own_pull.size, dtype=bool)
            for i, name in enumerate(best.names):
                if self.found.links.kind(name) not in ("own", "shared"):
                    continue
                at = int(np.argmax(block.through[i] != 0.0))
                low, high = best.limits(name)
                value, near = best.values[best.index[name]], AT_LIMIT * best.sizes[i]
                sides = (value - low <= near, high - value <= near)
                outward = own_pull[at] if sides[0] else -own_pull[at] if sides[1] else 0.0
                held[at] = outward > 1.96 * np.sqrt(own_sure[at])
            shared[held[:s]] = True
            out.append(held)
        for held in out:
            held[:s] = shared
        return out

    @cached_property
    def _curvatures(self) -> list[Array | None]:
        return [self._curved(t) for t in range(len(self.blocks))]

    def _curved(self, t: int) -> Array | None:
        """Curvature of half the cost of a test by its parameters; None where JᵀJ is taken.

        By differences of the gradient, one standard error to either side along the principal axes
        of the covariance.
        """
        block = self.blocks[t]
        if not any(error.found for error in self.errors[t]):
            return None
        best, held = block.best, self._held[t]
        free = np.flatnonzero(~(np.abs(block.through[:, held]) > 0.0).any(axis=1))
        spread = block.through @ self._plain.of_test(t) @ block.through.T
        power, axes = np.linalg.eigh(spread[np.ix_(free, free)])
        if not np.all(np.isfinite(power)) or not free.size:
            return None
        steps = axes * np.sqrt(np.maximum(power, 1e-12 * power[-1]))
        names = tuple(best.names[i] for i in free)
        places = [best.index[name] for name in names]
        low, high = np.array([best.limits(name) for name in names]).T

        def gradient(step: Array) -> Array:
            values = best.values.copy()
            values[places] = np.clip(values[places] + step * best.sizes[free], low, high)
            slopes = best.problem.slopes(values, names) * best.sizes[free]
            return np.asarray(slopes.T @ best.problem.objective.residual(values))

        change = np.array([0.5 * (gradient(step) - gradient(-step)) for step in steps.T])
        try:
            inner = np.linalg.solve(steps.T, change)
        except np.linalg.LinAlgError:
            return None
        out = block.jacobian.T @ block.jacobian
        out[np.ix_(free, free)] = 0.5 * (inner + inner.T)
        return np.asarray(out)

    @cached_property
    def covariance(self) -> JointCovariance:
        """Covariance of all parameters."""
        plain = self._solved(self._plain, [np.zeros(h.size, dtype=bool) for h in self._held])
        if not any(error.found for errors in self.errors for error in errors):
            return plain
        return _wider(plain, self._solved(self._bent, self._held))

    @cached_property
    def _bent(self) -> Arrow:
        """The blocks with the curvature itself, what is pressed to a limit held."""
        blocks = [
            replace(block, curvature=self._curvatures[t]).kept(np.flatnonzero(~self._held[t]))
            for t, block in enumerate(self.blocks)
        ]
        return Arrow(tuple(blocks), plain=False)

    def _solved(self, arrow: Arrow, held: Sequence[NDArray[np.bool_]]) -> JointCovariance:
        """Covariances of solved blocks, SI; NaN for what is held."""
        s, scales = arrow.s, self._scales
        kept = np.flatnonzero(~held[0][: scales.size])
        unseen, doubt = arrow.unseen, np.zeros(s)
        matrices, freedoms = list[Array](), list[Array]()
        count = self.found.n_vary
        effective = sum(block.effective for block in arrow.blocks)
        variance, places = np.diag(arrow.shared), list[list[int]]()
        for t, block in enumerate(arrow.blocks):
            errors = arrow.errors(t)
            doubt += block.doubt(errors[:, :s])
            through = block.through
            matrix = through @ arrow.of_test(t) @ through.T
            bad = np.concatenate([unseen, arrow.lost(t)])
            lost = (np.abs(through[:, bad]) > 0.0).any(axis=1) | ~through.any(axis=1)
            matrix[lost, :] = matrix[:, lost] = np.nan
            own = np.maximum(block.doubt(errors @ through.T), 1e-300)
            left = block.effective - (through.shape[1] - s)
            freedoms.append(np.clip(2.0 * np.diag(matrix) ** 2 / own, 1.0, max(left, 1.0)))
            matrices.append(matrix * np.outer(block.best.sizes, block.best.sizes))
            places.append([int(np.argmax(row[:s] != 0.0)) if row[:s].any() else -1
                           for row in through])  # fmt: skip
        known = 2.0 * variance**2 / np.maximum(doubt, 1e-300)
        freedom = np.clip(known, 1.0, max(effective - count, 1.0))
        for mine, where in zip(freedoms, places, strict=True):
            linked = np.array(where) >= 0
            mine[linked] = freedom[np.array(where)[linked]]
        whole = np.full((scales.size, scales.size), np.nan)
        inner = arrow.shared.copy()
        inner[unseen, :] = inner[:, unseen] = np.nan
        whole[np.ix_(kept, kept)] = inner
        out = np.ones(scales.size)
        out[kept] = freedom
        return JointCovariance(
            self.names, whole * np.outer(scales, scales), out,
            tuple(block.names for block in arrow.blocks), tuple(matrices), tuple(freedoms),
            float(effective),
        )  # fmt: skip

    @cached_property
    def _undrawn(self) -> Arrow:
        """The blocks as the data alone have them, whatever draws parameters to a common value."""
        s = len(self.names)
        free = [i for i, one in enumerate(self.names) if one not in self._scatter]
        blocks = list[_Block]()
        for t, block in enumerate(self.blocks):
            columns = np.array([*free, *range(s, block.through.shape[1])], dtype=np.intp)
            none = np.zeros((0, columns.size))
            curved = replace(block, curvature=self._curvatures[t]) if self.errs else block
            blocks.append(replace(curved.kept(columns), pulls=none, drawn=none))
        return Arrow(tuple(blocks), plain=not self.errs)

    def own_errors(self, test: int, names: Sequence[str]) -> Array:
        """Covariance of some own parameters of a test as the data alone have it, SI, (k, k).

        Zero where the test says nothing of them.
        """
        block, arrow = self.blocks[test], self._undrawn
        mine = [name for name in block.names if name in self.found.own]
        whole = np.where(arrow.lost(test), 0.0, 1.0) * arrow.of_test(test)[arrow.s :, arrow.s :]
        out = np.zeros((len(names), len(names)))
        here = [i for i, name in enumerate(names) if name in mine]
        places = [mine.index(names[i]) for i in here]
        sizes = [block.best.sizes[block.names.index(names[i])] for i in here]
        out[np.ix_(here, here)] = whole[np.ix_(places, places)] * np.outer(sizes, sizes)
        return out

    def of_logarithms(self, name: str) -> tuple[Array, Array]:
        """Covariance of the logarithms of a parameter in all tests that have it of its own, (n, n).

        As the data alone have it, whatever draws it to a common value; then the inverse curvature.
        NaN where a test says nothing of it.
        """
        places, factors = list[int | None](), list[float]()
        for block in self.blocks:
            mine = [one for one in block.names if one in self.found.own]
            places.append(mine.index(name) if name in mine else None)
            value = float(block.best.values[block.best.index[name]])
            size = block.best.sizes[block.names.index(name)] if name in block.names else 0.0
            factors.append(size / abs(value) if value else np.nan)
        matrix, bread = self._undrawn.across(places)
        scale = np.outer(factors, factors)
        return matrix * scale, bread * scale

    @property
    def errs(self) -> bool:
        """Whether the law misses more of some test than noise."""
        return any(error.found for errors in self.errors for error in errors)


def _wider(plain: JointCovariance, bent: JointCovariance) -> JointCovariance:
    """The second covariance where it has a parameter, but no variance below that of the first."""
    matrix, freedom = _with_some(plain.matrix, bent.matrix, plain.freedom, bent.freedom)
    pairs = [
        _with_some(*both)
        for both in zip(plain.matrices, bent.matrices, plain.freedoms, bent.freedoms, strict=True)
    ]
    return replace(
        plain, matrix=matrix, freedom=freedom, matrices=tuple(one for one, _ in pairs),
        freedoms=tuple(one for _, one in pairs),
    )  # fmt: skip


def _with_some(
    plain: Array, bent: Array, freedom: Array, bent_freedom: Array
) -> tuple[Array, Array]:
    """See `trust.covariance.Covariance.with_some`."""
    variance, other = np.diag(plain), np.diag(bent)
    there = np.flatnonzero(np.isfinite(other) & (other > 0.0))
    more = np.sqrt(np.fmax(variance[there] / other[there], 1.0))
    matrix = np.diag(variance)
    matrix[np.ix_(there, there)] = bent[np.ix_(there, there)] * np.outer(more, more)
    out = freedom.copy()
    out[there] = bent_freedom[there]
    return matrix, out
