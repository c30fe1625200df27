"""The motion behind a noisy displacement, smooth between its turns, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, PPoly
from scipy.special import ndtr

from foamfit.arrays import Array
from foamfit.data.kinked_spline import DEGREE, Fit, fitted, kink
from foamfit.data.measurement import NoiseLevel
from foamfit.data.noise import quantum, residual_noise

# Samples for a piece of the spline; most pieces, and most where these do not follow the data.
_PIECE, _PIECES, _MANY = 4, 64, 256
_SIGNIFICANT = 4.5  # standard errors by which a motion goes back where it turns
_SHARE = 0.98  # of the mean variance that the modes hold
# Noise that counts as rounding, as a share of the range.
_ROUNDING = 1e-7
# Residuals over noise from which on a spline does not follow the motion; noise, as a share of the
# range, up to which the data are taken as they stand.
_OFF, _LITTLE = 1.3, 1e-5


@dataclass(frozen=True, eq=False)
class _Modes:
    """Changes of the motion by one standard deviation each, by parts x of the record's duration.

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
        where, stderr, jump, before = self.kinks
        late = x[:, None] - where
        # A kink that may lie on either side of a sample moves it by a part of the jump.
        moved = np.where(np.abs(late) < 1e-12, before, -jump * ndtr(late / stderr))
        return np.asarray(self.spline(x) + kink(x, where) @ self.jumps + moved @ self.instants)


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
        inside = self._part(times)
        past = (np.asarray(times, float) - self._start) / self._duration - inside
        ends = self._curve(np.array([0.0, 1.0]), 1)  # it goes straight on past what was measured
        return np.asarray(self._curve(inside) + past * np.where(past < 0.0, ends[0], ends[1]))

    def modes(self, times: Array) -> Array:
        """Changes of the motion by one standard deviation each, (n, m), m, the largest first.

        The covariance of the motion at these times is `modes @ modes.T`. At a turn itself they are
        the changes of its height, wherever its instant moves to.
        """
        return self._modes(self._part(times))

    def _part(self, times: Array) -> Array:
        return np.clip((np.asarray(times, float) - self._start) / self._duration, 0.0, 1.0)


def follow(
    time: Array | None,
    displacement: Array,
    noise: NoiseLevel,
    counts: NDArray[np.bool_] | None = None,
) -> SmoothMotion:
    """Find the motion behind a displacement (n,), m, at times (n,), s, or samples.

    `counts` marks the samples to go by, by default all. A noise that is not given, or that the
    data contradict, is estimated again from what the motion leaves.
    """
    taken = np.ones(displacement.size, bool) if counts is None else counts
    times = np.arange(displacement.size, dtype=float) if time is None else time
    own, w = times[taken], displacement[taken]
    start, duration = float(own[0]), float(np.ptp(own))
    x = (own - start) / duration
    middle, size = float(np.mean(w)), max(float(np.ptp(w)), 1e-300)
    pieces, finest = max(4, min(x.size // _PIECE, _PIECES)), min(_MANY, x.size // 2)
    slow, shown, digital = np.sqrt(max(noise.time, 1.0)), residual_noise(w)[0], quantum(w) / 12**0.5
    # Too much noise hides a kink until the next turn, too little invents many.
    sigma = max(noise.sigma, shown)
    if noise.given and not _LITTLE * size < noise.sigma < sigma / _OFF:
        sigma = noise.sigma
    for _ in range(8):
        if sigma <= _LITTLE * size:
            return _exact(times[taken], w, max(sigma, _ROUNDING * size))
        unit = sigma * slow
        fit, penalty = fitted(x, (w - middle) / unit, pieces)
        left = fit.left(penalty) * unit
        if left > _OFF * max(sigma, shown) and pieces < finest:
            pieces = min(2 * pieces, finest)
            continue
        # Steps of a digitiser leave about what they are, a motion of equal steps leaves nothing.
        least = noise.sigma if noise.given else digital * (left > 0.2 * digital)
        if abs(max(left, least) / sigma - 1.0) < 0.1:
            break
        sigma = max(left, least)
    return _motion(fit, penalty, unit / slow, unit, middle, (start, duration))


def _motion(
    fit: Fit, penalty: float, sigma: float, unit: float, middle: float, span: tuple[float, float]
) -> SmoothMotion:
    """Make the monotone curve, its turns and its modes."""
    samples, instants = fit.samples, fit.instants
    spline, jumps = (unit * v for v in fit.solve(penalty))
    half, stderr, dof = fit.covariance(penalty, _SHARE)
    k, size = instants.size, spline.size
    bend = BSpline(samples.knots, samples.rotation @ spline, DEGREE)

    def velocity(x: Array) -> tuple[Array, Array]:  # before and after
        late, smooth = x[:, None] - instants, bend.derivative()(x)
        return smooth + (late > 0.0) @ jumps, smooth + (late >= 0.0) @ jumps

    modes = _Modes(
        BSpline(samples.knots, unit * (samples.rotation @ half[:size]), DEGREE),
        unit * half[size : size + k],
        half[size + k :],
        np.stack([instants, stderr, jumps, velocity(instants)[0]]),
    )
    x = np.unique(np.concatenate([[0.0, 1.0], samples.x, samples.knots, instants]))
    before, after = velocity(x)
    back = np.flatnonzero(after[:-1] * before[1:] < 0.0)  # where the velocity passes through zero
    part = after[back] / (after[back] - before[back + 1])
    x = np.union1d(x, x[back] + part * np.diff(x)[back])
    values, velocities = middle + bend(x) + kink(x, instants) @ jumps, velocity(x)
    turns = _turns(x, values, modes, (1e-300, 2.0 * unit))
    stderr = _turns_stderr(x, turns, velocities, modes)
    curve, (start, duration) = _monotone(x, values, velocities, turns), span
    at = start + duration * x[turns[1:-1]]
    return SmoothMotion(at, duration * stderr, sigma, dof, curve, modes, start, duration)


def _exact(times: Array, values: Array, sigma: float) -> SmoothMotion:
    """Go through data without noise as they stand; sharp turns between samples are added."""
    start, duration = float(times[0]), float(times[-1] - times[0])
    x, none = (times - start) / duration, np.empty((0, 1))
    flat = BSpline(np.array([0.0, 1.0]), np.zeros((1, 1)), 0)
    modes, bounds = _Modes(flat, none, none, np.empty((4, 0))), (2.0 * sigma,) * 2
    turns = _turns(x, values, modes, bounds)[1:-1]
    corners = [corner for i in turns if (corner := _corner(x, values, int(i), 4.0 * sigma))]
    if corners:
        more, heights = np.array(corners).T
        order = np.argsort(np.append(x, more), kind="stable")
        x, values = np.append(x, more)[order], np.append(values, heights)[order]
    turns, slopes = _turns(x, values, modes, bounds), np.gradient(values, x)
    curve, at = _monotone(x, values, (slopes, slopes), turns), turns[1:-1]
    gap = 0.5 * duration * (x[at + 1] - x[at - 1])
    at_times = start + duration * x[at]
    return SmoothMotion(at_times, gap, sigma, float(x.size), curve, modes, start, duration)


def _corner(x: Array, y: Array, i: int, off: float) -> tuple[float, float] | None:
    """Return where the straight lines on both sides of a turn at or beside sample i meet."""
    for a in (i, i - 1):  # the last sample on the way there
        if a < 2 or a + 3 >= x.size:
            continue
        there, back = ((y[j + 1] - y[j]) / (x[j + 1] - x[j]) for j in (a - 1, a + 1))
        bends = (
            y[a] + there * (x[a - 2] - x[a]) - y[a - 2],
            y[a + 1] + back * (x[a + 3] - x[a + 1]) - y[a + 3],
        )
        step = (x[a + 1] - x[a]) * max(abs(there), abs(back))
        at = (y[a + 1] - y[a] + there * x[a] - back * x[a + 1]) / ((there - back) or np.inf)
        straight = max(map(abs, bends)) <= 0.01 * step + off
        if straight and there * back < 0.0 and x[a] < at < x[a + 1]:
            return float(at), float(y[a] + there * (at - x[a]))
    return None


def _turns(
    x: Array, values: Array, modes: _Modes, bounds: tuple[float, float]
) -> NDArray[np.int64]:
    """Return the places between which the motion goes back significantly, with both ends.

    Standard errors of differences are taken within `bounds`.
    """
    up = np.sign(np.diff(values))
    moves = np.flatnonzero(up)
    turn = moves[np.flatnonzero(np.diff(up[moves]) != 0.0) + 1]
    at = np.concatenate([[0], turn, [x.size - 1]])
    changes = modes(x[at])
    while at.size > 2:
        stderr = np.clip(np.linalg.norm(np.diff(changes, axis=0), axis=1), *bounds)
        sure = np.abs(np.diff(values[at])) / (_SIGNIFICANT * stderr)
        i = int(np.argmin(sure))
        if sure[i] >= 1.0:
            break
        # The first and the last stretch join their neighbours, any other goes with both its ends.
        gone = [1] if i == 0 else [at.size - 2] if i == at.size - 2 else [i, i + 1]
        at, changes = np.delete(at, gone), np.delete(changes, gone, axis=0)
    for i in range(1, at.size - 1):  # a stretch may reach further than where it was cut
        part = values[at[i - 1] : at[i + 1] + 1]
        high = values[at[i]] > values[at[i - 1]]
        at[i] = at[i - 1] + int(np.argmax(part) if high else np.argmin(part))
    return at


def _turns_stderr(
    x: Array, turns: NDArray[np.int64], velocities: tuple[Array, Array], modes: _Modes
) -> Array:
    """Standard errors of turns: of a kink's instant, or of where the velocity is zero."""
    before, after = velocities
    out = []
    for i in turns[1:-1]:
        kinked = np.flatnonzero(modes.kinks[0] == x[i])
        step = 1e-3
        bend = abs(before[i + 1] - after[i - 1]) / (x[i + 1] - x[i - 1])
        slope = np.diff(modes(x[i] + np.array([-step, step])), axis=0) / (2.0 * step)
        smooth = float(np.linalg.norm(slope)) / max(bend, 1e-300)
        out.append(modes.kinks[1, kinked[0]] if kinked.size else min(smooth, 1.0))
    return np.array(out)


def _monotone(
    x: Array, values: Array, velocities: tuple[Array, Array], turns: NDArray[np.int64]
) -> PPoly:
    """Return the curve through the values, in cubic pieces that go nowhere back between turns."""
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
    # A cubic is monotone if its velocity at the ends is at most three times that of its chord.
    over = np.where(chord, chord, np.inf)
    a, b = (chord * np.clip(v / over, 0.0, 3.0) for v in (velocities[1][:-1], velocities[0][1:]))
    return PPoly(
        np.stack([(a + b - 2.0 * chord) / h**2, (3.0 * chord - 2.0 * a - b) / h, a, y[:-1]]), x
    )
