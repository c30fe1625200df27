"""A penalised spline with kinks through noisy samples; the likelihood says how many and where.

The spline is of the fifth degree, and the square of its third derivative is penalised: what is free
is a parabola. A kink a (x − s)+ is a jump of the velocity; neither its height nor its instant is
penalised. Penalty and number of kinks are those of the largest marginal likelihood, in which the
spline is a random function and each kink has a price; the final penalty is that of the restricted
likelihood (REML).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.interpolate import BSpline
from scipy.special import ndtr

from foamfit.arrays import Array
from foamfit.data.cycles import find_turns

DEGREE, _ORDER = 5, 3
# Where kinks are looked for: among so many spots, on so many samples (blocks of more are averaged).
_SPOTS, _ENOUGH = 120, 1000
_KINKS = 40
# Kinks are moved first at so many times the penalty: what looks rough may be a kink out of place.
_STIFF = 100.0
_SETTLED = 1e-2  # gain of a step, in twice the log-likelihood, that is not worth another


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples (n,) in units of record and noise, and a basis in which all is diagonal.

    A rotation takes the spline's coefficients to coordinates b, of which the fit has the normal
    equations `data` and the penalty `rough`; `basis` (n, b) are its values.
    """

    x: Array
    y: Array
    knots: Array
    rotation: Array
    basis: Array
    data: Array
    rough: Array

    @classmethod
    def of(cls, x: Array, y: Array, pieces: int) -> Samples:
        """Put knots even in time and in samples, by halves."""
        level = 0.5 * (x + np.linspace(0.0, 1.0, x.size))
        inner = np.interp(np.linspace(0.0, 1.0, pieces + 1), level, x)
        knots = np.pad(inner, DEGREE, mode="edge")
        basis = BSpline.design_matrix(x, knots, DEGREE)
        half, (points, weights) = 0.5 * np.diff(inner), np.polynomial.legendre.leggauss(3)
        places = (inner[:-1, None] + half[:, None] * (points + 1.0)).ravel()
        bends = BSpline(knots, np.eye(pieces + DEGREE), DEGREE).derivative(_ORDER)(places)
        penalty = bends.T @ (np.outer(half, weights).reshape(-1, 1) * bends)
        gram = (basis.T @ basis).toarray()
        little = 1e-9 * np.trace(gram) / np.trace(penalty)  # for pieces without samples
        rough, rotation = linalg.eigh(penalty, gram + little * penalty)
        rough[:_ORDER] = 0.0
        return cls(x, y, knots, rotation, basis @ rotation, 1.0 - little * rough, rough)

    @cached_property
    def y_onto(self) -> Array:
        """Products of the basis with the samples."""
        return np.asarray(self.basis.T @ self.y)

    @property
    def price(self) -> float:
        """What a kink, two unknowns, has to add to twice the log-likelihood (BIC)."""
        return 2.0 * float(np.log(self.x.size))

    @cached_property
    def penalties(self) -> Array:
        """Penalties to try, from hardly any to a parabola."""
        least, most = np.log10([1.0 / self.rough[-1], 1e4 / self.rough[_ORDER]])
        return np.logspace(least, most, int(most - least) + 2)


def kink(x: Array, instants: Array) -> Array:
    """Columns (x − s)+ of kinks, (n, k)."""
    return np.maximum(x[:, None] - instants, 0.0)


@dataclass(frozen=True, eq=False)
class Fit:
    """Normal equations of a spline and columns (n, k) beside it, by default those of kinks."""

    samples: Samples
    instants: Array
    columns: Array

    @classmethod
    def of(cls, samples: Samples, instants: Array) -> Fit:
        """Kinks at some instants."""
        return cls(samples, instants, kink(samples.x, instants))

    @cached_property
    def onto(self) -> Array:
        """Products of the basis with the columns."""
        return np.asarray(self.samples.basis.T @ self.columns)

    @cached_property
    def gram(self) -> Array:
        """Products of the columns."""
        return np.asarray(self.columns.T @ self.columns)

    def reduced(self, penalties: Array) -> tuple[Array, Array, Array]:
        """Weights (p, b) of the spline's coordinates, and equations of the columns without it.

        Matrices (p, k, k) and right sides (p, k), for p penalties.
        """
        s = self.samples
        weight = 1.0 / (s.data + penalties[:, None] * s.rough)
        left = self.gram - self.onto.T @ (weight[:, :, None] * self.onto)
        left += 1e-12 * np.diag(np.diag(self.gram))
        return weight, left, s.y @ self.columns - (weight * s.y_onto) @ self.onto

    def solve(self, penalty: float) -> tuple[Array, Array]:
        """Return the coordinates of the spline and the coefficients of the columns."""
        weight, left, right = (part[0] for part in self.reduced(np.array([penalty])))
        found = np.linalg.solve(left, right)
        return weight * (self.samples.y_onto - self.onto @ found), found

    def unlikely(self, penalties: Array, *, restricted: bool = False) -> Array:
        """Return −2 ln of the likelihood (p,), up to a constant, the spline integrated out."""
        s = self.samples
        weight, left, right = self.reduced(penalties)
        found = np.linalg.solve(left, right[:, :, None])[:, :, 0]
        out = s.y @ s.y - weight @ s.y_onto**2 - (right * found).sum(axis=1)
        out -= np.log(weight[:, _ORDER:] * s.rough[_ORDER:] * penalties[:, None]).sum(axis=1)
        return np.asarray(out + np.linalg.slogdet(left)[1] if restricted else out)

    def left(self, penalty: float) -> float:
        """Estimate the noise from the residuals."""
        s, (spline, found) = self.samples, self.solve(penalty)
        residual = s.y - s.basis @ spline - self.columns @ found
        dof = float((s.data / (s.data + penalty * s.rough)).sum()) + 2.0 * self.instants.size
        return float(np.sqrt(residual @ residual / max(s.x.size - dof, 1.0)))

    @cached_property
    def apart(self) -> bool:
        """Whether there are samples between any two kinks: without, there is no telling them."""
        cells = np.searchsorted(self.samples.x, self.instants)
        return bool(np.all(np.diff(cells) > 0))

    @cached_property
    def best(self) -> tuple[float, float]:
        """The least −2 ln likelihood over all penalties, kinks at their price; its penalty."""
        if not self.apart:
            return np.inf, float(self.samples.penalties[0])
        levels = self.unlikely(self.samples.penalties)
        i = int(np.argmin(levels))
        priced = float(levels[i]) + self.samples.price * self.instants.size
        return priced, float(self.samples.penalties[i])

    def step(self, penalty: float) -> Array:
        """How far to move the kinks, (k,), by Gauss and Newton."""
        jumps = self.solve(penalty)[1]
        delays = np.where(self.samples.x[:, None] > self.instants, -jumps, 0.0)
        moving = Fit(self.samples, self.instants, np.hstack([self.columns, delays]))
        _, left, right = moving.reduced(np.array([penalty]))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(left[0]), 1e-300))
        scaled = scale[:, None] * left[0] * scale
        found = scale * np.linalg.lstsq(scaled, scale * right[0], rcond=1e-13)[0]
        room = 0.4 * np.diff(np.concatenate([[0.0], self.instants, [1.0]]))
        return np.asarray(np.clip(found[jumps.size :], -room[:-1], room[1:]))

    def refined(self, penalty: float, steps: int) -> Fit:
        """Move the kinks to where they fit best at one penalty."""
        fit, x, at = self, self.samples.x, np.array([penalty])
        level = fit.unlikely(at)[0]
        for _ in range(steps if self.instants.size else 0):
            before, step = level, fit.step(penalty)
            for part in (1.0, 0.4, 0.1):
                trial = Fit.of(self.samples, np.clip(fit.instants + part * step, x[1], x[-2]))
                if trial.apart and (better := trial.unlikely(at)[0]) < level:
                    level, fit = better, trial
                    break
            if before - level < _SETTLED:
                break
        return fit

    def settled(self, penalty: float) -> Fit:
        """Refine kinks and penalty by turns."""
        fit = self.refined(_STIFF * penalty, 4)
        return fit.refined(fit.best[1], 6)

    def covariance(self, penalty: float, share: float) -> tuple[Array, Array, float]:
        """What stays uncertain of the spline's coordinates, of the kinks' jumps and instants.

        Returns changes by one standard deviation each (unknowns, m), the largest first, so many
        that they hold a share of the variance at the samples; the standard errors of the instants;
        the effective number of parameters.
        """
        s, k, size = self.samples, self.instants.size, self.samples.rough.size
        jumps, late = self.solve(penalty)[1], s.x[:, None] - self.instants
        past, eye = np.asarray(late > 0.0, float), np.eye(size + 2 * k)
        for _ in range(3):  # a sample is past a kink by the probability that it is
            moving = Fit(s, self.instants, np.hstack([self.columns, -jumps * past]))
            data = np.block([[np.diag(s.data), moving.onto], [moving.onto.T, moving.gram]])
            every = data + np.diag(np.append(penalty * s.rough, np.zeros(2 * k)))
            scale = 1.0 / np.sqrt(np.maximum(np.diag(every), 1e-300))
            factor = np.linalg.cholesky(scale[:, None] * every * scale + 1e-12 * eye)
            half = scale[:, None] * linalg.solve_triangular(factor, eye, lower=True).T
            stderr = np.maximum(np.linalg.norm(half[size + k :], axis=1), 1e-15)
            past = ndtr(late / stderr)
        parts, turned = np.linalg.eigh(half.T @ data @ half)
        dof = float(parts.sum())
        few = int(np.searchsorted(np.cumsum(parts[::-1]), share * dof)) + 1
        return half @ turned[:, ::-1][:, :few], stderr, dof


def _with_more(fit: Fit) -> Fit:
    """Add the kink, or the two kinks, that raise the likelihood most."""
    s, k = fit.samples, fit.instants.size
    at = np.unique(np.linspace(2, s.x.size - 2, min(s.x.size - 3, _SPOTS)).astype(int))
    spots = 0.5 * (s.x[at] + s.x[at - 1])
    tried = Fit(s, spots, np.hstack([fit.columns, kink(s.x, spots)]))
    best, more = np.inf, spots[:1]
    penalties = s.penalties[s.penalties >= 0.1 * fit.best[1]][::2]  # a kink takes roughness away
    _, lefts, rights = tried.reduced(penalties)
    for level, left, right in zip(fit.unlikely(penalties), lefts, rights, strict=True):
        solved = np.linalg.solve(left[:k, :k], left[:k, k:])
        q, gram = right[k:] - right[:k] @ solved, left[k:, k:] - left[k:, :k] @ solved
        own = np.maximum(np.diag(gram), 1e-300)
        one = level + s.price - q**2 / own
        if one.min() < best:
            best, more = one.min(), spots[[int(np.argmin(one))]]
        det = np.maximum(np.outer(own, own) - gram**2, 1e-4 * np.outer(own, own))
        gain = np.outer(q**2, own)
        two = level + 2.0 * s.price - (gain + gain.T - 2.0 * gram * np.outer(q, q)) / det
        if two.min() < best:
            best, more = two.min(), spots[list(np.unravel_index(int(np.argmin(two)), two.shape))]
    return Fit.of(s, np.sort(np.append(fit.instants, more)))


def _find_kinks(samples: Samples) -> Fit:
    """Find the kinks, from those at likely turns or from none, then drop needless ones."""
    none = Fit.of(samples, np.empty(0))
    turned = Fit.of(samples, _likely_turns(samples)).settled(none.best[1])
    fit = min(none, turned, key=lambda f: f.best[0])
    while fit.instants.size < min(_KINKS, samples.x.size // 8):
        trial = _with_more(fit).settled(fit.best[1])
        if trial.best[0] >= fit.best[0]:
            break
        fit = trial
    while fit.instants.size:
        rest = [np.delete(fit.instants, i) for i in range(fit.instants.size)]
        likely = sorted((Fit.of(samples, r) for r in rest), key=lambda f: f.best[0])[:2]
        trial = min((f.settled(fit.best[1]) for f in likely), key=lambda f: f.best[0])
        if trial.best[0] > fit.best[0]:
            break
        fit = trial
    return fit


def _likely_turns(samples: Samples) -> Array:
    """Turns that running means show at eight standard errors, of the width that shows most."""
    best = np.empty(0)
    for width in 2 ** np.arange(int(np.log2(samples.x.size / 10.0))):
        total = np.cumsum(np.append(0.0, samples.y))
        mean = (total[width:] - total[:-width]) / width
        at = find_turns(mean, 8.0 / np.sqrt(width)) + 0.5 * (width - 1)
        at = at[(at > 1) & (at < samples.x.size - 2)]
        best = at if best.size < at.size <= _KINKS else best
    return np.interp(best, np.arange(samples.x.size), samples.x)


def fitted(x: Array, y: Array, pieces: int) -> tuple[Fit, float]:
    """Return the fit to samples (n,) with noise of one, and its penalty."""
    block = max(1, x.size // _ENOUGH)
    whole = x.size // block * block
    mean_x, mean_y = (v[:whole].reshape(-1, block).mean(axis=1) for v in (x, y))
    coarse = Samples.of(mean_x, mean_y * np.sqrt(block), pieces)
    found = _find_kinks(coarse)
    samples = coarse if block == 1 else Samples.of(x, y, pieces)
    penalty = block * found.best[1]
    fit = Fit.of(samples, found.instants).refined(penalty, 20)
    finer = penalty * np.geomspace(0.03, 30.0, 21)
    return fit, float(finer[np.argmin(fit.unlikely(finer, restricted=True))])
