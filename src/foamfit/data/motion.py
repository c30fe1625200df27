"""The motion behind a noisy displacement: smooth between its turns, and what stays uncertain of it.

The motion is a cubic spline, whose roughness is penalised, plus kinks a (t − t_k)+ at which the
velocity jumps: turns of a triangle, start and end of a hold. Marginal likelihood at the known noise
sets the penalty and says how many kinks there are; their instants are unknowns like the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.interpolate import BSpline, PPoly
from scipy.special import ndtr

from foamfit.arrays import Array
from foamfit.data.cycles import find_turns
from foamfit.data.measurement import NoiseLevel
from foamfit.data.noise import residual_noise

# Pieces of the spline: of so many samples each, and at most so many; the latter also where the
# noise is too low for the former.
_PIECE, _PIECES, _MANY = 4, 64, 256
# Order of the derivative that is penalised, and degree of the spline.
_ORDER, _DEGREE = 3, 5
_SPOTS = 200  # at which a kink is tried, at most
_GAPS = (1, 2, 4, 8)  # spots between two kinks that are tried together
_KINKS = 40
# What a kink has to add to twice the logarithm of the likelihood, beside 2 ln n.
_EVIDENCE = 6.0
_SIGNIFICANT = 4.5  # standard errors by which a motion goes back where it turns
_MODES = 40
# Samples that are enough to find the kinks; blocks of more are averaged.
_ENOUGH = 1000
# Noise, as a share of the range, that counts as none.
_EXACT = 1e-7
# Residuals over noise from which on a spline does not follow the motion, and noise, as a share of
# the range, below which the data are then taken as they stand.
_OFF, _LITTLE = 1.3, 1e-5


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """A motion without its noise.

    Attributes
    ----------
    turns, turns_stderr : (k,) arrays
        Instants at which the motion turns round and their standard errors, s.
    sigma : float
        Standard deviation of the noise, m.
    dof : float
        Effective number of parameters of the motion.
    """

    turns: Array
    turns_stderr: Array
    sigma: float
    dof: float
    _curve: PPoly
    _modes: _Modes
    _start: float
    _duration: float

    def at(self, times: Array) -> Array:
        """Displacement (m) at times inside the record; monotone between two turns."""
        return np.asarray(self._curve(self._scaled(times)))

    def modes(self, times: Array) -> Array:
        """Changes of the motion by one standard deviation each, (n, m), m.

        The covariance of the motion at these times is `modes @ modes.T`. At a turn itself they are
        the changes of its height, wherever its instant moves to.
        """
        return self._modes(self._scaled(times))

    def _scaled(self, times: Array) -> Array:
        return np.clip((np.asarray(times, float) - self._start) / self._duration, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class _Modes:
    """Changes of the motion by one standard deviation each, by parts of the record's duration.

    They are those of the `spline`, of the `jumps` (k, m) of the velocity at the kinks, and of the
    `instants` (k, m) of these. `kinks` (4, k) holds instants, their standard errors, jumps, and the
    velocities before them.
    """

    spline: BSpline
    jumps: Array
    instants: Array
    kinks: Array

    def __call__(self, x: Array) -> Array:
        """Return the modes at (n,) places, (n, m), m."""
        where, spread, jump, before = self.kinks
        late = x[:, None] - where
        # A kink that may lie on either side of a sample moves it by a part of the jump.
        moved = np.where(late == 0.0, before, -jump * ndtr(late / spread))
        return np.asarray(
            self.spline(x) + np.maximum(late, 0.0) @ self.jumps + moved @ self.instants
        )


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (n,) in units of record and noise, and a spline basis that makes them diagonal.

    A rotation takes the spline's coefficients to coordinates b in which its fit adds Σ data b² and
    its roughness is Σ rough b².
    """

    x: Array
    y: Array
    knots: Array
    rotation: Array
    data: Array
    rough: Array

    @classmethod
    def of(cls, x: Array, y: Array, pieces: int) -> _Samples:
        """Knots are even in time and in samples, by halves."""
        level = 0.5 * (x + np.linspace(0.0, 1.0, x.size))
        inner = np.interp(np.linspace(0.0, 1.0, pieces + 1), level, x)
        knots = np.concatenate([np.zeros(_DEGREE), inner, np.ones(_DEGREE)])
        basis = BSpline.design_matrix(x, knots, _DEGREE)
        h, (points, weights) = np.diff(inner), np.polynomial.legendre.leggauss(_DEGREE)
        places = (inner[:-1, None] + 0.5 * h[:, None] * (points + 1.0)).ravel()
        bends = BSpline(knots, np.eye(pieces + _DEGREE), _DEGREE).derivative(_ORDER)(places)
        rough = bends.T @ ((0.5 * h[:, None] * weights).reshape(-1, 1) * bends)
        gram = (basis.T @ basis).toarray()
        little = 1e-9 * np.trace(gram) / np.trace(rough)
        values, rotation = linalg.eigh(rough, gram + little * rough)
        values = np.maximum(values, 0.0)
        values[:_ORDER] = 0.0
        return cls(x, y, knots, rotation, 1.0 - little * values, values)

    @cached_property
    def basis(self) -> sparse.csr_array:
        return BSpline.design_matrix(self.x, self.knots, _DEGREE)

    def onto(self, columns: Array) -> Array:
        """Products of the basis with columns (n, p) or (n,)."""
        return np.asarray(self.rotation.T @ (self.basis.T @ columns))

    @cached_property
    def y_onto(self) -> Array:
        return self.onto(self.y)

    @cached_property
    def penalties(self) -> Array:
        """Penalties to try, from an interpolating spline to a straight line."""
        least, most = 1.0 / self.rough[-1], 1e4 / self.rough[_ORDER]
        return np.geomspace(least, most, int(np.log10(most / least)) + 2)

    @cached_property
    def spots(self) -> Array:
        """Instants between samples at which a kink is tried."""
        n = self.x.size
        at = np.unique(np.linspace(2, n - 2, min(n - 3, _SPOTS)).astype(int))
        return 0.5 * (self.x[at] + self.x[at - 1])

    @cached_property
    def cells(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Sums of columns, and of columns times x, between two spots and past the last."""
        n, first = self.x.size, np.searchsorted(self.x, self.spots)
        ends = np.append(first, n)
        shape = (first.size, n)
        taken, of = np.arange(first[0], n), ends - first[0]
        one = sparse.csr_array((np.ones(taken.size), taken, of), shape=shape)
        return one, sparse.csr_array((self.x[taken], taken, of), shape=shape)

    def onto_spots(self, columns: Array | sparse.csr_array) -> Array:
        """Products of the kinks at all spots with columns, (spots, p)."""
        plain, moment = ((sums @ columns) for sums in self.cells)
        if sparse.issparse(plain):
            plain, moment = plain.toarray(), moment.toarray()
        plain, moment = (np.cumsum(v[::-1], axis=0)[::-1] for v in (plain, moment))
        return np.asarray(moment - self.spots[:, None] * plain)

    @cached_property
    def spots_basis(self) -> Array:
        return self.onto_spots(self.basis) @ self.rotation

    @cached_property
    def spots_y(self) -> Array:
        return self.onto_spots(self.y[:, None])[:, 0]

    @cached_property
    def spots_gram(self) -> Array:
        """Products of kinks at spots with those 0, 1, 2, 4, … spots later, (1 + gaps, spots)."""
        powers = np.stack([np.ones_like(self.x), self.x], axis=1)
        sums = self.onto_spots(powers)  # Σ (x − s)+ and Σ (x − s)+ x
        out = np.full((1 + len(_GAPS), self.spots.size), np.nan)
        out[0] = sums[:, 1] - self.spots * sums[:, 0]
        for row, gap in enumerate(_GAPS, start=1):
            later = sums[gap:]
            out[row, :-gap] = later[:, 1] - self.spots[:-gap] * later[:, 0]
        return out


def _kink(x: Array, instants: Array) -> Array:
    return np.maximum(x[:, None] - instants, 0.0)


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of the columns beside the spline."""

    samples: _Samples
    columns: Array

    @cached_property
    def onto(self) -> Array:
        return self.samples.onto(self.columns)

    @cached_property
    def gram(self) -> Array:
        return np.asarray(self.columns.T @ self.columns)

    @cached_property
    def with_y(self) -> Array:
        return np.asarray(self.columns.T @ self.samples.y)

    def reduced(self, penalty: float) -> tuple[Array, Array, Array]:
        """Weights of the spline's coordinates; equations of the columns with the spline gone."""
        s = self.samples
        weight = 1.0 / (s.data + penalty * s.rough)
        left = self.gram - self.onto.T @ (weight[:, None] * self.onto)
        left[np.diag_indices_from(left)] *= 1.0 + 1e-10
        return weight, left, self.with_y - self.onto.T @ (weight * s.y_onto)

    def solve(self, penalty: float) -> tuple[Array, Array]:
        """Return coordinates of the spline and coefficients of the columns."""
        weight, left, right = self.reduced(penalty)
        found = np.linalg.solve(left, right)
        return weight * (self.samples.y_onto - self.onto @ found), found

    def unlikely(self, penalty: float, *, restricted: bool = False) -> float:
        """Return −2 ln of the likelihood, up to a constant, with the spline integrated out."""
        s = self.samples
        weight, left, right = self.reduced(penalty)
        found = np.linalg.solve(left, right) if right.size else right
        rough = s.rough[_ORDER:] * penalty
        out = s.y @ s.y - s.y_onto @ (weight * s.y_onto) - right @ found
        out -= np.log(weight[_ORDER:] * rough).sum()
        return float(out + (np.linalg.slogdet(left)[1] if restricted else 0.0))


def _best_pair(samples: _Samples, normal: _Normal, price: float) -> tuple[float, list[float]]:
    """Find the kink, or the pair of kinks, that adds most to twice the log-likelihood."""
    cross = samples.onto_spots(normal.columns)
    onto, y, gram = samples.spots_basis, samples.spots_y, samples.spots_gram
    now, best = np.inf, (np.inf, -1, 0)
    for penalty in samples.penalties:
        weight, left, right = normal.reduced(penalty)
        level = normal.unlikely(penalty)
        now = min(now, level)
        weighted = onto * weight
        to_kinks = cross - weighted @ normal.onto
        solved = np.linalg.solve(left, to_kinks.T).T
        q = y - weighted @ samples.y_onto - solved @ right
        own = gram[0] - (weighted * onto).sum(1) - (solved * to_kinks).sum(1)
        own = np.maximum(own, 1e-10 * gram[0])
        gain = q**2 / own
        i = int(np.argmax(gain))
        best = min(best, (level - gain[i] + price, i, 0))
        for row, gap in enumerate(_GAPS, start=1):
            a, b = slice(None, -gap), slice(gap, None)
            both = gram[row, a] - (weighted[a] * onto[b]).sum(1) - (solved[a] * to_kinks[b]).sum(1)
            det = np.maximum(own[a] * own[b] - both**2, 1e-6 * own[a] * own[b])
            gain = (own[b] * q[a] ** 2 + own[a] * q[b] ** 2 - 2.0 * both * q[a] * q[b]) / det
            i = int(np.argmax(gain))
            best = min(best, (level - gain[i] + 2.0 * price, i, gap))
    _, i, gap = best
    found = [float(samples.spots[i])]
    return now - best[0], found + [float(samples.spots[i + gap])] * bool(gap)


def _refined(
    samples: _Samples, instants: Array, penalty: float, steps: int
) -> tuple[Array, _Normal]:
    """Move kinks to where they fit best, at one penalty, by Gauss–Newton steps."""
    x = samples.x
    normal = _Normal(samples, _kink(x, instants))
    level = normal.unlikely(penalty)
    for _ in range(steps if instants.size else 0):
        _, jumps = normal.solve(penalty)
        delays = np.where(x[:, None] > instants, -jumps, 0.0)
        _, left, right = _Normal(samples, np.hstack([normal.columns, delays])).reduced(penalty)
        step = np.linalg.lstsq(left, right, rcond=1e-13)[0][instants.size :]
        room = np.diff(np.concatenate([x[:1], instants, x[-1:]]))
        step = np.clip(step, -0.4 * room[:-1], 0.4 * room[1:])
        for _ in range(6):
            moved = np.clip(instants + step, x[1], x[-2])
            trial = _Normal(samples, _kink(x, moved))
            if (better := trial.unlikely(penalty)) < level:
                break
            step = 0.4 * step
        else:
            break
        gained, level, instants, normal = level - better, better, moved, trial
        if gained < 1e-3:
            break
    return instants, normal


def _level(normal: _Normal) -> tuple[float, float]:
    """Return the least −2 ln likelihood over all penalties, and the penalty."""
    return min((normal.unlikely(penalty), penalty) for penalty in normal.samples.penalties)


def _find_kinks(samples: _Samples) -> Array:
    """Find the kinks that the likelihood asks for, one or two at a time, then drop needless ones."""
    price = 2.0 * np.log(samples.x.size) + _EVIDENCE
    instants = np.empty(0)
    normal = _Normal(samples, _kink(samples.x, instants))
    level, penalty = _level(normal)
    turns = find_turns(samples.y)
    turns = samples.x[turns[(turns > 1) & (turns < samples.x.size - 2)]]
    trial, normal_there = _refined(samples, turns, penalty, 3)
    there, penalty_there = _level(normal_there)
    if there + price * turns.size < level:
        instants, normal, level, penalty = trial, normal_there, there, penalty_there
    while instants.size < _KINKS:
        gain, more = _best_pair(samples, normal, price)
        if gain <= 0.0:
            break
        trial, normal_there = _refined(samples, np.sort(np.append(instants, more)), penalty, 3)
        there, _ = _level(normal_there)
        trial, normal_there = _refined(samples, trial, _, 6)
        there, penalty_there = _level(normal_there)
        if there + price * (trial.size - instants.size) >= level:
            break
        instants, normal, level, penalty = trial, normal_there, there, penalty_there
    while instants.size:
        without = [np.delete(instants, i) for i in range(instants.size)]
        fits = [_refined(samples, rest, penalty, 3) for rest in without]
        levels = [_level(fit[1])[0] for fit in fits]
        i = int(np.argmin(levels))
        if levels[i] > level + price:
            break
        instants, normal = fits[i]
        level, penalty = _level(normal)
    return instants


@dataclass(frozen=True, eq=False)
class _Fit:
    samples: _Samples
    normal: _Normal
    instants: Array
    penalty: float

    @cached_property
    def left(self) -> float:
        """Root mean square of the residuals."""
        spline, jumps = self.normal.solve(self.penalty)
        s = self.samples
        fitted = s.basis @ (s.rotation @ spline) + self.normal.columns @ jumps
        return float(np.sqrt(np.mean((s.y - fitted) ** 2)))

    @cached_property
    def _linear(self) -> tuple[Array, Array, float, Array]:
        s, k = self.samples, self.instants.size
        size = s.rough.size
        _, jumps = self.normal.solve(self.penalty)
        late = s.x[:, None] - self.instants
        past, eye = np.asarray(late > 0.0, float), np.eye(size + 2 * k)
        for _ in range(3):
            full = _Normal(s, np.hstack([self.normal.columns, -jumps * past]))
            data = np.block([[np.diag(s.data), full.onto], [full.onto.T, full.gram]])
            every = data + np.diag(np.append(self.penalty * s.rough, np.zeros(2 * k)))
            # Equal diagonals keep the factors well conditioned.
            scale = 1.0 / np.sqrt(np.maximum(np.diag(every), 1e-300))
            factor = np.linalg.cholesky(scale[:, None] * every * scale + 1e-12 * eye)
            half = scale[:, None] * linalg.solve_triangular(factor, eye, lower=True).T
            spread = np.maximum(np.sqrt((half[size + k :] ** 2).sum(1)), 1e-15)
            past = ndtr(late / spread)
        shares, turned = np.linalg.eigh(half.T @ data @ half)
        return half @ turned[:, ::-1][:, :_MODES], spread, float(shares.sum())

    @property
    def half(self) -> Array:
        """One-standard-deviation changes of all unknowns, the most important first."""
        return self._linear[0]

    @property
    def spread(self) -> Array:
        """Standard errors of the instants."""
        return self._linear[1]

    @property
    def shares(self) -> float:
        """Effective number of parameters."""
        return self._linear[2]


def _fitted(x: Array, y: Array, pieces: int) -> _Fit:
    block = max(1, x.size // _ENOUGH)
    whole = x.size // block * block
    mean_x, mean_y = (v[:whole].reshape(-1, block).mean(axis=1) for v in (x, y))
    coarse = _Samples.of(mean_x, mean_y * np.sqrt(block), pieces)
    instants = _find_kinks(coarse)
    _, penalty = _level(_Normal(coarse, _kink(mean_x, instants)))
    samples = _Samples.of(x, y, pieces)
    instants, normal = _refined(samples, instants, block * penalty, 20)
    finer = block * penalty * np.geomspace(0.03, 30.0, 21)
    penalty = min(finer, key=lambda p: normal.unlikely(p, restricted=True))
    return _Fit(samples, normal, instants, float(penalty))


def follow(
    time: Array | None,
    displacement: Array,
    noise: NoiseLevel,
    counts: NDArray[np.bool_] | None = None,
) -> SmoothMotion:
    """Find the motion behind a displacement (n,), m, at times (n,), s, or samples.

    `counts` marks the samples to go by, by default all. A noise that is not given is estimated
    again from what the motion leaves.
    """
    taken = np.ones(displacement.size, bool) if counts is None else counts
    times = np.arange(displacement.size, dtype=float) if time is None else time
    start, duration = float(times[0]), float(times[-1] - times[0])
    x, w = (times[taken] - start) / duration, displacement[taken]
    size = max(float(np.ptp(w)), 1e-300)
    sigma, slow = noise.sigma, max(noise.time, 1.0)
    pieces = max(4, min(x.size // _PIECE, _PIECES))
    middle = float(np.mean(w))
    for _ in range(5):
        sigma = max(sigma, _EXACT * size)
        unit = sigma * np.sqrt(slow)
        fit = _fitted(x, (w - middle) / unit, pieces)
        left = fit.left * unit
        finest = min(_MANY, x.size // 2)
        if left > _OFF * sigma and sigma < _LITTLE * size:
            return _exact(times[taken], w, sigma)
        if left > _OFF * sigma and pieces < finest and residual_noise(w)[0] < left / _OFF:
            pieces = min(4 * pieces, finest)
        elif max(left, sigma) <= _EXACT * size or abs(left / sigma - 1.0) < 0.1:
            break
        elif noise.given and left < _OFF * sigma:
            break
        else:
            sigma = left
    return _motion(fit, sigma, unit, middle, start, duration)


def _exact(times: Array, values: Array, sigma: float) -> SmoothMotion:
    """Go through data without noise as they stand."""
    start, duration = float(times[0]), float(times[-1] - times[0])
    x = (times - start) / duration
    flat = BSpline(np.array([0.0, 1.0]), np.zeros((1, 1)), 0)
    modes = _Modes(flat, np.empty((0, 1)), np.empty((0, 1)), np.empty((4, 0)))
    turns = _turns(x, values, modes, 8.0 * sigma)
    slopes = np.gradient(values, x)
    curve = _monotone(x, values, slopes, slopes, turns)
    at = turns[1:-1]
    gap = 0.5 * (times[at + 1] - times[at - 1])
    return SmoothMotion(times[at], gap, sigma, float(x.size), curve, modes, start, duration)


def _motion(
    fit: _Fit, sigma: float, unit: float, middle: float, start: float, duration: float
) -> SmoothMotion:
    """Make the monotone curve, its turns and its modes."""
    samples, instants, penalty = fit.samples, fit.instants, fit.penalty
    spline, jumps = fit.normal.solve(penalty)
    k, size = instants.size, spline.size
    bend = BSpline(samples.knots, unit * (samples.rotation @ spline), _DEGREE)
    jumps = unit * jumps
    half, shares = fit.half, fit.shares
    modes = _Modes(
        BSpline(samples.knots, unit * (samples.rotation @ half[:size]), _DEGREE),
        unit * half[size : size + k],
        half[size + k :],
        np.stack([instants, fit.spread, jumps, _velocity(bend, instants, jumps, instants)[0]]),
    )
    x = np.unique(np.concatenate([samples.x, samples.knots, instants]))
    before, after = _velocity(bend, instants, jumps, x)
    # Places at which the velocity passes through zero between two of these.
    through = np.flatnonzero(after[:-1] * before[1:] < 0.0)
    part = after[through] / (after[through] - before[through + 1])
    x = np.union1d(x, x[through] + part * np.diff(x)[through])
    before, after = _velocity(bend, instants, jumps, x)
    values = middle + bend(x) + _kink(x, instants) @ jumps
    turns = _turns(x, values, modes)
    return SmoothMotion(
        start + duration * x[turns[1:-1]],
        duration * _turns_stderr(x, turns, before, after, modes),
        sigma,
        float(shares),
        _monotone(x, values, before, after, turns),
        modes,
        start,
        duration,
    )


def _velocity(bend: BSpline, instants: Array, jumps: Array, x: Array) -> tuple[Array, Array]:
    """Return the velocity just before and just after places (n,)."""
    smooth = bend.derivative()(x)
    late = x[:, None] - instants
    return smooth + (late > 0.0) @ jumps, smooth + (late >= 0.0) @ jumps


def _turns(x: Array, values: Array, modes: _Modes, least: float = 0.0) -> NDArray[np.int64]:
    """Return the places between which the motion goes back significantly, with both ends."""
    up = np.sign(np.diff(values))
    moves = np.flatnonzero(up)
    turn = moves[np.flatnonzero(np.diff(up[moves]) != 0.0) + 1]
    at = np.concatenate([[0], turn, [x.size - 1]])
    spread = modes(x[at])
    while at.size > 2:
        gone = np.abs(np.diff(values[at]))
        stderr = np.sqrt((np.diff(spread, axis=0) ** 2).sum(1))
        sure = gone / np.maximum(stderr, max(least / _SIGNIFICANT, 1e-300))
        i = int(np.argmin(sure))
        if sure[i] >= _SIGNIFICANT:
            break
        # The first and the last stretch join their neighbours, any other goes with both its ends.
        gone = [1] if i == 0 else [at.size - 2] if i == at.size - 2 else [i, i + 1]
        at, spread = np.delete(at, gone), np.delete(spread, gone, axis=0)
    for i in range(1, at.size - 1):  # a stretch may reach further than where it was cut
        part = values[at[i - 1] : at[i + 1] + 1]
        highest = values[at[i]] > values[at[i - 1]]
        at[i] = at[i - 1] + int(np.argmax(part) if highest else np.argmin(part))
    return at


def _turns_stderr(
    x: Array, turns: NDArray[np.int64], before: Array, after: Array, modes: _Modes
) -> Array:
    out = []
    for i in turns[1:-1]:
        kink = np.flatnonzero(modes.kinks[0] == x[i])
        if kink.size:
            out.append(float(modes.kinks[1, kink[0]]))
            continue
        step = min(x[i] - x[i - 1], x[i + 1] - x[i])
        bend = abs(before[i + 1] - after[i - 1]) / (x[i + 1] - x[i - 1])
        slope = np.diff(modes(np.array([x[i] - step, x[i] + step])), axis=0) / (2.0 * step)
        out.append(float(np.linalg.norm(slope)) / max(bend, 1e-300))
    return np.minimum(out, 1.0) if out else np.empty(0)


def _monotone(
    x: Array, values: Array, before: Array, after: Array, turns: NDArray[np.int64]
) -> PPoly:
    """Return the curve through the values, as cubic pieces which go back nowhere between turns."""
    y = values.copy()
    for first, last in zip(turns[:-1], turns[1:], strict=True):
        part = slice(first, last + 1)
        sign = 1.0 if values[last] >= values[first] else -1.0
        v = sign * values[part]
        level = 0.5 * (np.maximum.accumulate(v) + np.minimum.accumulate(v[::-1])[::-1])
        least = v[0] if first > 0 else -np.inf
        most = v[-1] if last < x.size - 1 else np.inf
        y[part] = sign * np.clip(level, least, most)
    h, rise = np.diff(x), np.diff(y)
    steep = rise / h
    # A cubic is monotone if its velocity at the ends is at most three times that of its chord.
    sides = [
        np.clip(v / np.where(rise, steep, 1.0), 0.0, 3.0) * steep for v in (after[:-1], before[1:])
    ]
    a, b = sides
    parts = [(a + b - 2.0 * steep) / h**2, (3.0 * steep - 2.0 * a - b) / h, a, y[:-1]]
    return PPoly(np.stack(parts), x)
