"""Remove the noise from a displacement, with the uncertainty of the smooth motion.

The motion is a penalised spline of the fifth degree with kinks; the penalty is on the square of its
third derivative. A kink a (x − s)+ is a jump of the velocity; neither its height a nor its instant
s is penalised. The penalty and the number of kinks maximise the marginal likelihood, with the
spline as a random function and a fixed price per kink; the final penalty maximises the restricted
likelihood (REML).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from scipy import linalg
from scipy.interpolate import BSpline, PPoly
from scipy.special import ndtr

from foamfit.arrays import Array, Integers, Mask
from foamfit.data.cycles import find_turns
from foamfit.data.measurement import NoiseLevel
from foamfit.data.noise import quantum, residual_noise

_DEGREE, _ORDER = 5, 3
_SPOTS = 120  # number of trial instants for a new kink
_SWINGS = 0.02  # largest distance from the samples between them, as a share of the range
_ENOUGH = 1000  # samples in the search for kinks; more are averaged in blocks
_KINKS = 40  # largest number of kinks
_STIFF = 100.0  # multiple of the penalty while kinks are moved first: roughness then moves a kink
_SETTLED = 1e-2  # stop moving kinks if twice the log-likelihood gains less than this
_PIECE = 4  # samples per piece of the spline
_PIECES, _MANY = 64, 256  # most pieces, and most if these do not follow the data
_SIGNIFICANT = 4.5  # standard errors of a significant reversal
_SHARE = 0.98  # share of the mean variance contained in the modes
_ROUNDING = 1e-7  # smallest noise (rounding), as a share of the range
_OFF = 1.3  # residuals over noise at which a spline does not follow the motion
_LITTLE = 1e-5  # noise, as a share of the range, below which the data are interpolated


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples (n,), scaled by duration and noise, and a diagonalising basis (n, b).

    A rotation transforms the coefficients of the spline to b coordinates in which the normal
    matrix `data` and the penalty matrix `rough` are diagonal; `y_onto` is the right-hand side.
    """

    x: Array
    y: Array
    knots: Array
    rotation: Array
    basis: Array
    data: Array
    rough: Array
    y_onto: Array

    @classmethod
    def of(cls, x: Array, y: Array, pieces: int) -> _Samples:
        """Build the basis; the density of knots averages those of time and of samples."""
        level = 0.5 * (x + np.linspace(0.0, 1.0, x.size))
        inner = np.interp(np.linspace(0.0, 1.0, pieces + 1), level, x)
        knots = np.pad(inner, _DEGREE, mode="edge")
        basis = BSpline.design_matrix(x, knots, _DEGREE)
        half, (points, weights) = 0.5 * np.diff(inner), np.polynomial.legendre.leggauss(3)
        places = (inner[:-1, None] + half[:, None] * (points + 1.0)).ravel()
        bends = BSpline(knots, np.eye(pieces + _DEGREE), _DEGREE).derivative(_ORDER)(places)
        penalty = bends.T @ (np.outer(half, weights).reshape(-1, 1) * bends)
        gram = (basis.T @ basis).toarray()
        little = 1e-9 * np.trace(gram) / np.trace(penalty)  # keeps pieces without samples regular
        while True:
            try:
                rough, rotation = linalg.eigh(penalty, gram + little * penalty)
                break
            except linalg.LinAlgError:  # pieces of a pause much longer than the step
                little *= 10.0
        rough = np.maximum(rough, np.finfo(float).eps * rough[-1])  # smaller ones are rounding
        rough[:_ORDER] = 0.0
        basis, data = basis @ rotation, np.maximum(1.0 - little * rough, 0.0)
        return cls(x, y, knots, rotation, basis, data, rough, basis.T @ y)

    @cached_property
    def price(self) -> float:
        """Least gain of twice the log-likelihood for a kink, which has two unknowns (BIC)."""
        return 2.0 * float(np.log(self.x.size))

    @cached_property
    def penalties(self) -> Array:
        """Trial penalties, from almost zero to one that leaves a parabola."""
        least, most = np.log10([1.0 / self.rough[-1], 1e4 / self.rough[_ORDER]])
        return np.logspace(least, most, int(most - least) + 2)


def _kinks(x: Array, instants: Array) -> Array:
    """Return the columns (x − s)+ of kinks, (n, k)."""
    return np.maximum(x[:, None] - instants, 0.0)


class _Fit:
    """Normal equations of a spline and additional columns (n, k), by default of kinks."""

    def __init__(self, samples: _Samples, instants: Array, columns: Array | None = None) -> None:
        self.samples, self.instants = samples, instants
        self.columns = _kinks(samples.x, instants) if columns is None else columns
        self.onto, self.gram = samples.basis.T @ self.columns, self.columns.T @ self.columns

    def reduced(self, penalties: Array) -> tuple[Array, Array, Array]:
        """Return the weights (p, b) of the spline and the reduced equations of the columns.

        The spline is eliminated; matrices (p, k, k) and right-hand sides (p, k) for p penalties.
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
        """Return −2 ln of the likelihood without the spline (marginal), up to a constant, (p,)."""
        s = self.samples
        weight, left, right = self.reduced(penalties)
        found = np.linalg.solve(left, right[:, :, None])[:, :, 0]
        out = s.y @ s.y - weight @ s.y_onto**2 - (right * found).sum(axis=1)
        out -= np.log(weight[:, _ORDER:] * s.rough[_ORDER:] * penalties[:, None]).sum(axis=1)
        return np.asarray(out + np.linalg.slogdet(left)[1] if restricted else out)

    def noise(self, penalty: float) -> float:
        """Estimate the noise from the residuals."""
        s, (spline, found) = self.samples, self.solve(penalty)
        residual = s.y - s.basis @ spline - self.columns @ found
        dof = float((s.data / (s.data + penalty * s.rough)).sum()) + 2.0 * self.instants.size
        return float(np.sqrt(residual @ residual / max(s.x.size - dof, 1.0)))

    @property
    def apart(self) -> bool:
        """Whether samples lie between any two kinks, so that they can be distinguished."""
        return bool(np.all(np.diff(np.searchsorted(self.samples.x, self.instants)) > 0))

    @cached_property
    def best(self) -> tuple[float, float]:
        """Least −2 ln likelihood over all penalties, including the price of kinks; its penalty."""
        if not self.apart:
            return np.inf, float(self.samples.penalties[0])
        levels = self.unlikely(self.samples.penalties)
        i = int(np.argmin(levels))
        priced = float(levels[i]) + self.samples.price * self.instants.size
        return priced, float(self.samples.penalties[i])

    def step(self, penalty: float) -> Array:
        """Return the Gauss-Newton step of the instants of the kinks, (k,)."""
        jumps = self.solve(penalty)[1]
        delays = np.where(self.samples.x[:, None] > self.instants, -jumps, 0.0)
        moving = _Fit(self.samples, self.instants, np.hstack([self.columns, delays]))
        _, left, right = moving.reduced(np.array([penalty]))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(left[0]), 1e-300))
        scaled = scale[:, None] * left[0] * scale
        found = scale * np.linalg.lstsq(scaled, scale * right[0], rcond=1e-13)[0]
        room = 0.4 * np.diff(np.concatenate([[0.0], self.instants, [1.0]]))
        return np.asarray(np.clip(found[jumps.size :], -room[:-1], room[1:]))

    def refined(self, penalty: float, steps: int) -> _Fit:
        """Optimise the instants of the kinks at one penalty."""
        fit, x, at = self, self.samples.x, np.array([penalty])
        level = fit.unlikely(at)[0]
        for _ in range(steps if self.instants.size else 0):
            before, step = level, fit.step(penalty)
            for part in (1.0, 0.4, 0.1):
                trial = _Fit(self.samples, np.clip(fit.instants + part * step, x[1], x[-2]))
                if trial.apart and (better := trial.unlikely(at)[0]) < level:
                    level, fit = better, trial
                    break
            if before - level < _SETTLED:
                break
        return fit

    def settled(self, penalty: float) -> _Fit:
        """Optimise the instants of the kinks with a stiff spline, then at the best penalty."""
        fit = self.refined(_STIFF * penalty, 4)
        return fit.refined(fit.best[1], 6)

    def covariance(self, penalty: float) -> tuple[Array, Array]:
        """Return the uncertainty of the spline and of the jumps and instants of the kinks.

        It consists of changes by one standard deviation each (unknowns, m), largest first, which
        contain most of the variance at the samples, and the standard errors of the instants.
        """
        s, k, size = self.samples, self.instants.size, self.samples.rough.size
        jumps, late = self.solve(penalty)[1], s.x[:, None] - self.instants
        past, eye = np.asarray(late > 0.0, float), np.eye(size + 2 * k)
        for _ in range(3):  # weight samples by the probability that they follow the kink
            moving = _Fit(s, self.instants, np.hstack([self.columns, -jumps * past]))
            data = np.block([[np.diag(s.data), moving.onto], [moving.onto.T, moving.gram]])
            every = data + np.diag(np.append(penalty * s.rough, np.zeros(2 * k)))
            scale = 1.0 / np.sqrt(np.maximum(np.diag(every), 1e-300))
            factor = np.linalg.cholesky(scale[:, None] * every * scale + 1e-12 * eye)
            half = scale[:, None] * linalg.solve_triangular(factor, eye, lower=True).T
            stderr = np.maximum(np.linalg.norm(half[size + k :], axis=1), 1e-15)
            past = ndtr(late / stderr)
        parts, turned = np.linalg.eigh(half.T @ data @ half)
        few = int(np.searchsorted(np.cumsum(parts[::-1]), _SHARE * float(parts.sum()))) + 1
        return half @ turned[:, ::-1][:, :few], stderr


def _with_more(fit: _Fit) -> _Fit:
    """Add the one or two kinks that increase the likelihood most."""
    s, k = fit.samples, fit.instants.size
    at = np.unique(np.linspace(2, s.x.size - 2, min(s.x.size - 3, _SPOTS)).astype(int))
    spots = 0.5 * (s.x[at] + s.x[at - 1])
    tried = _Fit(s, spots, np.hstack([fit.columns, _kinks(s.x, spots)]))
    best, more = np.inf, spots[:1]
    penalties = s.penalties[s.penalties >= 0.1 * fit.best[1]][::2]  # a kink reduces roughness
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
    return _Fit(s, np.sort(np.append(fit.instants, more)))


def _find_kinks(samples: _Samples) -> _Fit:
    """Find the kinks, starting from likely turns or none, then remove unnecessary ones."""
    none = _Fit(samples, np.empty(0))
    turned = _Fit(samples, _likely_turns(samples)).settled(none.best[1])
    fit = min(none, turned, key=lambda f: f.best[0])
    while fit.instants.size < min(_KINKS, samples.x.size // 8):
        trial = _with_more(fit).settled(fit.best[1])
        if trial.best[0] >= fit.best[0]:
            break
        fit = trial
    while fit.instants.size:
        rest = [np.delete(fit.instants, i) for i in range(fit.instants.size)]
        likely = sorted((_Fit(samples, r) for r in rest), key=lambda f: f.best[0])[:2]
        trial = min((f.settled(fit.best[1]) for f in likely), key=lambda f: f.best[0])
        if trial.best[0] > fit.best[0]:
            break
        fit = trial
    return fit


def _likely_turns(samples: _Samples) -> Array:
    """Find turns of running means at eight standard errors, for the width with the most turns."""
    best = np.empty(0)
    for width in 2 ** np.arange(int(np.log2(samples.x.size / 10.0))):
        total = np.cumsum(np.append(0.0, samples.y))
        mean = (total[width:] - total[:-width]) / width
        at = find_turns(mean, 8.0 / np.sqrt(width)) + 0.5 * (width - 1)
        at = at[(at > 1) & (at < samples.x.size - 2)]
        best = at if best.size < at.size <= _KINKS else best
    return np.interp(best, np.arange(samples.x.size), samples.x)


def _fitted(x: Array, y: Array, pieces: int) -> tuple[_Fit, float]:
    """Fit samples (n,) with unit noise; return the fit and its penalty."""
    block = max(1, x.size // _ENOUGH)
    full = x.size // block * block
    mean_x, mean_y = (v[:full].reshape(-1, block).mean(axis=1) for v in (x, y))
    coarse = _Samples.of(mean_x, mean_y * np.sqrt(block), pieces)
    found = _find_kinks(coarse)
    samples = coarse if block == 1 else _Samples.of(x, y, pieces)
    penalty = block * found.best[1]
    fit = _Fit(samples, found.instants).refined(penalty, 20)
    finer = penalty * np.geomspace(0.03, 30.0, 21)
    return fit, float(finer[np.argmin(fit.unlikely(finer, restricted=True))])


@dataclass(frozen=True, eq=False)
class _Modes:
    """Changes of the motion by one standard deviation each, at times x scaled by the duration.

    They consist of changes of the `spline`, and of the `jumps` (k, m) and `instants` (k, m) of the
    kinks. `kinks` (4, k): instants, their standard errors, jumps, and velocities before the kinks.
    """

    spline: BSpline
    jumps: Array
    instants: Array
    kinks: Array

    def __call__(self, x: Array) -> Array:
        where, stderr, jump, before = self.kinks
        late = x[:, None] - where
        # An uncertain kink changes the motion at a nearby sample by a part of the jump.
        moved = np.where(np.abs(late) < 1e-12, before, -jump * ndtr(late / stderr))
        return np.asarray(self.spline(x) + _kinks(x, where) @ self.jumps + moved @ self.instants)


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """A motion without noise."""

    turns: Array  #: times at which the motion turns, s, (k,)
    sigma: float  #: standard deviation of the noise, m
    _curve: PPoly
    _modes: _Modes
    _start: float
    _duration: float

    def at(self, times: Array) -> Array:
        """Return the displacement (m) at times in the record; it is monotone between turns."""
        part = (times - self._start) / self._duration
        inside = np.clip(part, 0.0, 1.0)
        past = part - inside
        ends = self._curve(np.array([0.0, 1.0]), 1)  # for linear extrapolation
        return np.asarray(self._curve(inside) + past * np.where(past < 0.0, ends[0], ends[1]))

    def modes(self, times: Array) -> Array:
        """Return changes of the motion by one standard deviation each, (n, m), m, largest first.

        The covariance of the motion at these times is `modes @ modes.T`. At a turn, they are the
        changes of its height, regardless of the shift of its instant.
        """
        return self._modes(np.clip((times - self._start) / self._duration, 0.0, 1.0))


def follow(
    time: Array | None, displacement: Array, noise: NoiseLevel, counts: Mask | None = None
) -> SmoothMotion:
    """Remove the noise from a displacement (n,), m, at times (n,), s, or samples.

    `counts` marks the measured samples, by default all. The noise is estimated from the residuals
    unless it is given and consistent with the data. Results are cached, because every model of a
    record and every resampling of its other curves needs the same motion.
    """
    times = np.arange(displacement.size, dtype=float) if time is None else time
    taken = slice(None) if counts is None else counts
    return _cached(times[taken].tobytes(), displacement[taken].tobytes(), noise)


@lru_cache(maxsize=32)
def _cached(raw_times: bytes, raw_motion: bytes, noise: NoiseLevel) -> SmoothMotion:
    """Run `follow` with its arrays as bytes, which can be cached."""
    times, w = np.frombuffer(raw_times), np.frombuffer(raw_motion)
    with suppress(linalg.LinAlgError):
        found = _found(times, w, noise)
        if _keeps_to(found, times, w):
            return found
    # No spline follows very uneven samples, as in a long hold with few of them.
    return _exact(times, w, max(noise.sigma, residual_noise(w)[0]))


def _keeps_to(found: SmoothMotion, times: Array, w: Array) -> bool:
    most = max(8.0 * found.sigma, _SWINGS * float(np.ptp(w)))
    low, high = np.minimum(w[:-1], w[1:]) - most, np.maximum(w[:-1], w[1:]) + most
    between = [found.at(times[:-1] + share * np.diff(times)) for share in (0.25, 0.5, 0.75)]
    return all(bool(np.all((low <= one) & (one <= high))) for one in between)


def _found(times: Array, w: Array, noise: NoiseLevel) -> SmoothMotion:
    """Remove the noise by a spline with kinks."""
    start, duration = float(times[0]), float(np.ptp(times))
    x = (times - start) / duration
    middle, size = float(np.mean(w)), max(float(np.ptp(w)), 1e-300)
    pieces, finest = max(4, min(x.size // _PIECE, _PIECES)), min(_MANY, x.size // 2)
    slow, shown, digital = np.sqrt(max(noise.time, 1.0)), residual_noise(w)[0], quantum(w) / 12**0.5
    # Overestimated noise hides a kink before the next turn, underestimated noise creates many.
    sigma = max(noise.sigma, shown)
    if noise.given and not _LITTLE * size < noise.sigma < sigma / _OFF:
        sigma = noise.sigma
    for _ in range(8):
        if sigma <= _LITTLE * size:
            return _exact(times, w, max(sigma, _ROUNDING * size))
        unit = sigma * slow
        fit, penalty = _fitted(x, (w - middle) / unit, pieces)
        left = fit.noise(penalty) * unit
        if left > _OFF * max(sigma, shown) and pieces < finest:
            pieces = min(2 * pieces, finest)
            continue
        # A digitiser leaves residuals of about its step, but a motion in equal steps leaves none.
        least = noise.sigma if noise.given else digital * (left > 0.2 * digital)
        if abs(max(left, least) / sigma - 1.0) < 0.1:
            break
        sigma = max(left, least)
    return _motion(fit, penalty, unit / slow, unit, middle, (start, duration))


def _motion(
    fit: _Fit, penalty: float, sigma: float, unit: float, middle: float, span: tuple[float, float]
) -> SmoothMotion:
    """Construct the monotone curve, its turns and its modes."""
    samples, instants = fit.samples, fit.instants
    spline, jumps = (unit * v for v in fit.solve(penalty))
    half, stderr = fit.covariance(penalty)
    k, size = instants.size, spline.size
    bend = BSpline(samples.knots, samples.rotation @ spline, _DEGREE)

    def velocity(x: Array) -> tuple[Array, Array]:  # before and after
        late, smooth = x[:, None] - instants, bend.derivative()(x)
        return smooth + (late > 0.0) @ jumps, smooth + (late >= 0.0) @ jumps

    changes = BSpline(samples.knots, unit * (samples.rotation @ half[:size]), _DEGREE)
    kinks = np.stack([instants, stderr, jumps, velocity(instants)[0]])
    modes = _Modes(changes, unit * half[size : size + k], half[size + k :], kinks)
    x = np.unique(np.concatenate([[0.0, 1.0], samples.x, samples.knots, instants]))
    before, after = velocity(x)
    back = np.flatnonzero(after[:-1] * before[1:] < 0.0)  # zeros of the velocity
    part = after[back] / (after[back] - before[back + 1])
    x = np.union1d(x, x[back] + part * np.diff(x)[back])
    values, velocities = middle + bend(x) + _kinks(x, instants) @ jumps, velocity(x)
    turns = _turns(x, values, modes, (1e-300, 2.0 * unit))
    curve, (start, duration) = _monotone(x, values, velocities, turns), span
    at = start + duration * x[turns[1:-1]]
    return SmoothMotion(at, sigma, curve, modes, start, duration)


def _exact(times: Array, values: Array, sigma: float) -> SmoothMotion:
    """Interpolate data without noise; add sharp turns between samples."""
    start, duration = float(times[0]), float(times[-1] - times[0])
    x, none = (times - start) / duration, np.empty((0, 1))
    flat = BSpline(np.array([0.0, 1.0]), np.zeros((1, 1)), 0)
    modes, bounds = _Modes(flat, none, none, np.empty((4, 0))), (2.0 * sigma,) * 2
    turns = _turns(x, values, modes, bounds)[1:-1]
    corners = [corner for i in turns if (corner := _corner(x, values, int(i), 4.0 * sigma))]
    if corners:
        more, heights = np.array(corners).T
        places = np.searchsorted(x, more)
        x, values = np.insert(x, places, more), np.insert(values, places, heights)
    turns, slopes = _turns(x, values, modes, bounds), np.gradient(values, x)
    curve, at = _monotone(x, values, (slopes, slopes), turns), start + duration * x[turns[1:-1]]
    return SmoothMotion(at, sigma, curve, modes, start, duration)


def _corner(x: Array, y: Array, i: int, tolerance: float) -> tuple[float, float] | None:
    """Return where the lines on both sides of a turn at or next to sample i intersect."""
    for a in (i, i - 1):  # the last sample before the turn
        if a < 2 or a + 3 >= x.size:
            continue
        before, after = ((y[j + 1] - y[j]) / (x[j + 1] - x[j]) for j in (a - 1, a + 1))
        lines = (a, a - 2, before), (a + 1, a + 3, after)
        bend = max(abs(y[i] + slope * (x[j] - x[i]) - y[j]) for i, j, slope in lines)
        step = (x[a + 1] - x[a]) * max(abs(before), abs(after))
        at = (y[a + 1] - y[a] + before * x[a] - after * x[a + 1]) / ((before - after) or np.inf)
        straight = bend <= 0.01 * step + tolerance
        if straight and before * after < 0.0 and x[a] < at < x[a + 1]:
            return float(at), float(y[a] + before * (at - x[a]))
    return None


def _turns(x: Array, values: Array, modes: _Modes, bounds: tuple[float, float]) -> Integers:
    """Return the indices of the significant turns of the motion, with both ends.

    Standard errors of differences are clipped to `bounds`.
    """
    up = np.sign(np.diff(values))
    moves = np.flatnonzero(up)
    turn = moves[np.flatnonzero(np.diff(up[moves]) != 0.0) + 1]
    at = np.concatenate([[0], turn, [x.size - 1]])
    changes = modes(x[at])
    while at.size > 2:
        stderr = np.clip(np.linalg.norm(np.diff(changes, axis=0), axis=1), *bounds)
        significance = np.abs(np.diff(values[at])) / (_SIGNIFICANT * stderr)
        i = int(np.argmin(significance))
        if significance[i] >= 1.0:
            break
        # Merge the first or last stretch with its neighbour; remove any other with both its ends.
        gone = [1] if i == 0 else [at.size - 2] if i == at.size - 2 else [i, i + 1]
        at, changes = np.delete(at, gone), np.delete(changes, gone, axis=0)
    return at


def _monotone(x: Array, values: Array, velocities: tuple[Array, Array], turns: Integers) -> PPoly:
    """Return the cubic interpolant of the values, made monotone between turns."""
    y = values.copy()
    for first, last in pairwise(turns):
        part = slice(first, last + 1)
        sign = 1.0 if values[last] >= values[first] else -1.0
        v = sign * values[part]
        level = 0.5 * (np.maximum.accumulate(v) + np.minimum.accumulate(v[::-1])[::-1])
        least = v[0] if first > 0 else -np.inf
        most = v[-1] if last < x.size - 1 else np.inf
        y[part] = sign * np.clip(level, least, most)
    h, chord = np.diff(x), np.diff(y) / np.diff(x)
    # A cubic is monotone if its slopes at the ends are at most three times that of its chord.
    over = np.where(chord, chord, np.inf)
    a, b = (chord * np.clip(v / over, 0.0, 3.0) for v in (velocities[1][:-1], velocities[0][1:]))
    cubic, square = (a + b - 2.0 * chord) / h**2, (3.0 * chord - 2.0 * a - b) / h
    return PPoly(np.stack([cubic, square, a, y[:-1]]), x)
