"""The objective: weighted residuals between simulated and measured curves.

Curves are compared in time, or sample by sample along a history, never by interpolation across the
loop. Only curves with a weight above zero count, so that no measurement counts twice.
"""

from __future__ import annotations

import math
import time
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from foamfit.arrays import Array
from foamfit.data.measurement import INTEGRATED, Measurement, NoiseLevel
from foamfit.data.motion import SmoothMotion
from foamfit.data.noise import with_noise
from foamfit.errors import InputError, SimulationError, raise_signal
from foamfit.fitting import curves, nuisance as nuisances
from foamfit.fitting.box import thinned
from foamfit.fitting.scenes import NOWHERE, Places, Scenes, channel_of
from foamfit.solve.plan import Motion
from foamfit.springs.model import Model

PENALTY = 10.0  # residual after a failed simulation, as a multiple of the measured range
OF_DRIVE = ("those of the drive",)  # default of `Objective.nuisance`
# Lower limit of the estimated noise, as a fraction of the range of a channel. Fits of the bistable
# law to measured foams have misfits above 1 %: a smaller noise must not let one channel outweigh
# the other, as the residuals of both are then errors of the law.
MODEL_ERROR = 0.005
MOST_EXPLAINED = 1.5  # ratio of the RMS residual to the expected noise up to which it is noise
NORMAL = 1.4826  # standard deviation of normal residuals over their median absolute value
RANKING = 1e-3  # allowed error of the simulations that rank starts on a thinned record
JUMP = 10.0  # ratio of the effects of a mode to both sides of a jump of the residual
THIN = 0.8  # a record is thinned if at most this fraction of its samples is left
# Probability at which amplitudes of the motion's modes are no longer credible; one single
# amplitude may be larger in ten times as many tests (3.5 standard deviations among 20).
RARE = 1e-3


@dataclass(frozen=True, eq=False)
class Simulated:
    """The curves of one set of parameters, the simulated motion, and derivatives on request."""

    # Curves stacked on their p derivatives, (1 + p, n), by the names in `Objective.curves`, without
    # those that the drive prescribes, the test lacks or the residual does not need; stress_strain
    # is the stress (Pa) along the measured displacement.
    rows: dict[str, Array]
    motion: Motion  # At the times of the samples if everything was requested

    @cached_property
    def curves(self) -> dict[str, Array]:
        """The curves, (n,) each."""
        return {name: rows[0] for name, rows in self.rows.items()}

    @property
    def slopes(self) -> dict[str, Array]:
        """Derivatives of each curve, (p, n)."""
        return {name: rows[1:] for name, rows in self.rows.items()}


@dataclass
class Spent:
    """Simulated sets of parameters; an objective made by `replace` counts with its original."""

    evaluations: int = 0
    failures: int = 0  # of these
    sloped: int = 0  # with derivatives
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Weighing:
    """Transform of residuals with covariance v + SSᵀ into residuals with covariance v.

    v is diagonal, the noise of each sample. Each column of S is the change of the residual by one
    standard deviation of a mode of the motion. With S' = S/√v = U d Vᵀ the residual r becomes
    √v (1 + S'S'ᵀ)^(-1/2) r/√v. `levels` (n,) are √v, `axes` (n, m) is U, and `less` (m,) is
    1 - (1 + d²)^(-1/2).
    """

    levels: Array
    axes: Array
    less: Array
    sizes: Array  # d (m,)
    at: Array  # the parameters at which it was found, SI

    @classmethod
    def of(cls, uncertain: Array, levels: Array, at: Array) -> Weighing:
        """Make the transform from S (n, m) and √v (n,)."""
        axes, size, _ = np.linalg.svd(uncertain / levels[:, None], full_matrices=False)
        return cls(levels, axes, 1.0 - 1.0 / np.sqrt(1.0 + size**2), size, at)

    def amplitudes(self, residual: Array) -> Array:
        """Return the residual along the modes over its standard deviation, of modes with d > 1.

        They are standard normal if the motion's uncertainty and noise explain the residual.
        """
        along = (residual / self.levels) @ self.axes / np.sqrt(1.0 + self.sizes**2)
        return np.asarray(along[self.sizes > 1.0])

    def explains(self, residual: Array) -> bool:
        """Return whether noise and the uncertainty of the motion can explain a residual (n,)."""
        sizes = self.amplitudes(residual) ** 2
        if not sizes.size:
            return True
        most = chdtri(sizes.size, RARE), chdtri(1, 10.0 * RARE / sizes.size)
        return bool(sizes.sum() <= most[0] and sizes.max() <= most[1])

    def __call__(self, rows: Array) -> Array:
        """Transform residuals (n,), or columns of their derivatives (n, k)."""
        along = (rows.T / self.levels) @ self.axes * self.less
        return np.asarray(rows - (self.levels * (along @ self.axes.T)).T)


@dataclass(eq=False)
class Objective:
    """Residuals of a model under a drive against a measurement.

    `curves` are the names of all curves, `interior` maps those of interior masses to their node.
    """

    measurement: Measurement
    model: Model
    drive: str  # "impact", "stress" or "displacement"
    weights: dict[str, float]  # Factor of the squared residuals of each curve
    rtol: float = 1e-4  # Allowed error of the simulation; with its margin some 1e-7 of the range
    # Whether the mass of the specimen is distributed equally between the springs, as in the paper.
    interior_mass: bool = False
    time_shift: bool = False  # Whether the delay of the motion, s, is a nuisance parameter
    # Nuisance parameters at the end of the vector; by default those of the drive.
    nuisance: tuple[str, ...] = OF_DRIVE
    weighing: Weighing | None = None  # Effect of an uncertain driving motion; see `weigh_motion`
    given: tuple[nuisances.Prior, ...] = ()  # Priors of spring parameters
    erring: bool = False  # Whether the law errs, so that priors count by the scales of the curves
    followed: tuple[SmoothMotion | None, ...] = ()  # `Scenes.motion`, if it is already known
    averaged: float = np.inf  # longest time that a sample averages, s, if the samples are thinned
    glued: bool | None = None  # see `is_glued`; None: as the record shows
    spent: Spent = field(default_factory=Spent)
    # Largest amplitude, in standard deviations, of the motion that would explain the residual
    unexplained: float | None = field(default=None, init=False)
    # Whether noise, that of the drive included, explains the size of the residual
    explained: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        """Prepare the scenes and the scale of each curve."""
        curves.check_drive(self.measurement, self.drive)
        if self.time_shift:
            curves.check_time_shift(self.measurement, self.drive)
        if self.nuisance == OF_DRIVE:
            self.nuisance = nuisances.names_of(self.drive, time_shift=self.time_shift)
        self.measurement = test = with_noise(self.measurement)
        self.interior = curves.interior_curves(test, len(self.model.kinds))
        self._accelerated = self.drive == "impact" and test.acceleration is not None
        felt = (curves.ACCELERATION,) if self._accelerated else ()
        self.curves = (*curves.CURVES, *felt, *self.interior)
        self.weights = curves.checked_weights(self.weights, self.curves)
        leaves = self.drive == "impact" or self.model.relaxation or test.last_cycle is not None
        if self.glued is None:
            self.glued = curves.is_glued(test, leaves=bool(leaves))
        self.scenes = Scenes(
            test, self.model, self.drive, self.curves, self.interior, self.nuisance, self.rtol,
            self.interior_mass, self.followed, self.averaged, self.glued,
        )  # fmt: skip
        self.time, self.usual = self.scenes.time, self.scenes.usual
        self.driven = self.scenes.driven  # whether the measured motion drives the springs
        self.measured = self._measured()
        self.counted = tuple(name for name in self.measured if self.weights[name] > 0)
        if not self.counted:
            raise InputError(
                f"{test.name}: no curve is left to fit; give one that the "
                f"{self.drive} drive has a weight above zero"
            )
        least = {name: MODEL_ERROR * float(np.ptp(curve)) for name, curve in self.measured.items()}
        self.scale = {  # standard deviation of the noise; if estimated, at least `least`
            name: level.sigma if (level := self.noise(name)).given else max(level.sigma, floor)
            for name, floor in least.items()
        }
        # Indices of the samples of each curve that are in the residual.
        self.kept = {name: self._samples(name) for name in self.measured}
        self.sizes = tuple(self.kept[name].size for name in self.counted)
        self.n_data = sum(self.sizes)
        self.penalty = max(PENALTY * self.span(name) for name in self.counted)
        self._set_targets()

    def _set_targets(self) -> None:
        """Prepare the measured residuals and the priors."""
        ends = np.cumsum((0, *self.sizes)).tolist()
        every = [size == self.time.size for size in self.sizes]
        self._parts = [  # curve, samples, factor, place in the residual
            (name, slice(None) if all_ else self.kept[name], self.factor(name), slice(first, end))
            for name, all_, first, end in zip(self.counted, every, ends[:-1], ends[1:], strict=True)
        ]
        self._unzeroed = {name: self._open_zero(name) for name in self.interior}
        self._target = np.concatenate([self.measured[name][kept] for name, kept, *_ in self._parts])
        known = nuisances.priors_of(self.measurement, self.drive)
        self.priors = (*self.given, *(known[name] for name in self.nuisance if name in known))
        names = (*self.model.names, *self.nuisance)
        self._prior_places = np.array([names.index(one.name) for one in self.priors], np.int64)
        self._means = np.array([one.mean for one in self.priors])
        self._sigmas = np.array([one.sigma for one in self.priors]) / self.unit

    def _open_zero(self, name: str) -> float:
        """Return the share of its mean that is taken off the residual of an interior motion.

        The unknown zero of the gauge, with a normal prior of its error before contact (none if it
        was not at rest there), shifts all samples. The likelihood is integrated over it.
        """
        error = self.measurement.zeros.get(channel_of(name))
        if error is None:
            return 1.0
        return 1.0 - 1.0 / math.sqrt(1.0 + self.kept[name].size * (error * self.factor(name)) ** 2)

    def as_read(self, name: str, curve: Array) -> Array:
        """Return a simulated curve, that of an interior motion with the zero of its gauge, SI."""
        share = self._unzeroed.get(name)
        if not share:
            return curve
        return curve + share * float((self.measured[name] - curve)[self.kept[name]].mean())

    def thinned(self) -> Objective:
        """Return the objective of a few hundred samples, or this one if it has no more.

        Each curve has the same weight in the sum of squares as with all samples.
        """
        motion = self.scenes.motion if self.driven else None
        test = thinned(self.measurement, None if motion is None else motion.at(self.time))
        if test.stress.size > THIN * self.time.size:
            return self
        followed = (motion,) if self.driven else self.followed
        gap = float(np.median(np.diff(self.time)))
        few = replace(
            self, measurement=test, followed=followed, weighing=None, averaged=gap, rtol=RANKING
        )
        pairs = zip(self.counted, self.sizes, few.sizes, strict=True)
        more = {name: self.weights[name] * size / left for name, size, left in pairs}
        return replace(few, weights=self.weights | more)

    def weigh_motion(self, values: Array) -> bool:
        """Weight the residuals by the uncertainty of the driving motion; False if it has none.

        `values` are the optimum of plain least squares; its residual sets the level of each curve.
        If noise and motion cannot explain that residual, the law errs and the residuals stay
        unweighted, so that the noise does not decide which part of the error the fit follows.
        """
        uncertain = self.by_motion(values)
        if uncertain is None:
            # The moving parabola leaves noise in the pulse of an impact.
            self.explained = self.measurement.striker is not None
            return False
        plain = self.plain(values)
        levels = [
            max(NORMAL * float(np.median(part)), self.noise(name).sigma * self.factor(name), 1e-9)
            for name, part in self.by_curve(np.abs(plain)).items()
        ]
        weighing = Weighing.of(uncertain, np.repeat(levels, self.sizes), values)
        noises = [self.noise(name).sigma * self.factor(name) for name in self.counted]
        expected = np.sum(np.repeat(noises, self.sizes) ** 2) + np.sum(uncertain**2)
        self.explained = bool(plain @ plain <= MOST_EXPLAINED**2 * expected)
        if not weighing.explains(plain):
            self.unexplained = float(np.abs(weighing.amplitudes(plain)).max())
        elif self.explained:
            self.weighing = weighing
        return self.weighing is not None

    def plain(self, values: Array) -> Array:
        """Return the residuals of the curves without priors and weighing, (n_data,)."""
        return self._moved_by(0.0).residual(values)[: self.n_data]

    def by_motion(self, values: Array) -> Array | None:
        """Return the change of the residual by each mode of what drives, (n_data, m), or None."""
        if self.scenes.smooth is None:
            return None
        modes = self.scenes.modes(self.scenes.smooth)
        if self.drive == "stress" and (zero := self.measurement.zeros.get("stress", 0.0)):
            modes = np.column_stack((modes, np.full(len(modes), zero)))
        out, plain = np.empty((self.n_data, modes.shape[1])), self.plain(values)
        for column, mode in zip(out.T, modes.T, strict=True):
            low, high = (
                2.0 * side * (self._moved_by(0.5 * side * mode).plain(values) - plain)
                for side in (-1.0, 1.0)
            )
            # A loop that only just closes opens on one side, with a jump of the residual.
            sizes = float(low @ low), float(high @ high)
            smooth = max(sizes) <= JUMP**2 * min(sizes)
            column[:] = 0.5 * (low + high) if smooth else (low, high)[int(np.argmin(sizes))]
        return out

    def _moved_by(self, change: Array | float) -> Objective:
        """Return the objective with a changed driving motion and unweighted residuals."""
        other = copy(self)
        other.weighing, other.scenes = None, self.scenes.moved_by(change)
        return other

    def _measured(self) -> dict[str, Array]:
        """Return the measured curves that the drive does not prescribe."""
        test = self.measurement
        measured = {"stress_time": test.stress}
        if test.displacement is not None:
            measured |= {"displacement_time": test.displacement, "stress_strain": test.stress}
        measured |= {name: test.interior[node] for name, node in self.interior.items()}
        if self._accelerated and test.acceleration is not None:
            measured[curves.ACCELERATION] = test.acceleration
        return {n: curve for n, curve in measured.items() if n in self.scenes.present}

    def noise(self, name: str) -> NoiseLevel:
        """Return the noise of a curve, stated or estimated."""
        level = self.measurement.noise.of(channel_of(name))
        assert level is not None  # completed by with_noise
        return level

    def _samples(self, name: str) -> NDArray[np.intp]:
        """Return the indices of the samples that count: measured ones without outliers."""
        channel, every = channel_of(name), np.ones(self.time.size, dtype=bool)
        counts = self.measurement.sampled.get(channel, every)
        if name == "stress_strain" and not self.driven:
            counts = counts & self.measurement.sampled.get("displacement", every)
        outliers = self.measurement.outliers.get(channel)
        if self.drive == "stress":
            counts = counts & curves.shows_motion(self.scenes.driving(self.time))
        return np.flatnonzero(counts if outliers is None else counts & ~outliers.left_out)

    # ------------------------------------------------------------------ simulation and residual

    def simulate(
        self, values: Array, *, everything: bool = False, places: Places = NOWHERE
    ) -> Simulated:
        """Simulate the counted curves, or all curves with `everything`.

        `places` are the indices of the parameters by which derivatives are returned. Raises
        SimulationError if the parameters are not admissible or the scene has no finite answer.
        """
        began = time.perf_counter()
        self.spent.evaluations += 1
        self.spent.sloped += places.size > 0
        try:
            return Simulated(*self.scenes.rows(values, places, self.counted, everything))
        except SimulationError:
            self.spent.failures += 1
            raise
        except SystemError as error:
            raise_signal(error)
            raise
        finally:
            self.spent.seconds += time.perf_counter() - began

    def residual(self, values: Array) -> Array:
        """Return the weighted residuals of all counted curves and of the priors, dimensionless.

        The first `n_data` belong to the curves: simulated minus measured, divided by the scale of
        the curve, times the square root of its weight, without outliers. One residual per prior
        follows, divided by its standard deviation. If the simulation fails, the residuals are a
        finite penalty, and `spent.failures` is increased.
        """
        try:
            return self.compare(self.simulate(values), values)
        except SimulationError:
            return np.append(np.full(self.n_data, self.penalty), self.off_priors(values))

    def compare(self, simulated: Simulated, values: Array) -> Array:
        """Return the residuals of simulated curves; see `residual`."""
        off = self._gathered(simulated.rows)[0]
        # The stress may be huge near the pole of branch c.
        off = np.maximum(np.minimum(off, self.penalty), -self.penalty)
        off = off if self.weighing is None else self.weighing(off)
        return np.concatenate((off, self.off_priors(values))) if self.priors else off

    def _gathered(self, rows: dict[str, Array]) -> Array:
        """Return the residuals of the curves, stacked on their derivatives, (1 + p, n_data)."""
        out = np.empty((len(rows[self.counted[0]]), self.n_data))
        for name, kept, factor, at in self._parts:
            out[:, at] = rows[name][:, kept]
            out[0, at] -= self._target[at]
            out[:, at] *= factor
            if share := self._unzeroed.get(name):
                out[:, at] -= share * out[:, at].mean(axis=1, keepdims=True)
        return out

    def off_priors(self, values: Array) -> Array:
        """Return the deviations of parameters from their priors, in standard deviations."""
        return np.asarray((values[self._prior_places] - self._means) / self._sigmas)

    def jacobian(self, values: Array, places: Places) -> Array:
        """Return the derivative of the residual by the parameters at `places`, (n, n_places), SI.

        It is integrated along with the simulation, and zero if the simulation fails.
        """
        out = np.zeros((self.n_data + len(self.priors), places.size))
        out[self.n_data :] = (self._prior_places[:, None] == places) / self._sigmas[:, None]
        if not places.size:
            return out
        try:
            found = self._gathered(self.simulate(values, places=places).rows)
        except SimulationError:
            return out
        slopes = found[1:].T
        slopes[np.abs(found[0]) >= self.penalty] = 0.0
        out[: self.n_data] = slopes if self.weighing is None else self.weighing(slopes)
        return out

    def jacobian_along(self, values: Array, moves: Array) -> Array:
        """Return the derivative of the residual along moves (n_values, m), (n_data, m)."""
        places = np.flatnonzero(moves.any(axis=1))
        return self.jacobian(values, places) @ moves[places]

    # ------------------------------------------------------------------ what a residual says

    @property
    def floor(self) -> float:
        """The noise floor: 1.5 times the sum of squares expected from noise alone."""
        sizes = zip(self.counted, self.sizes, strict=True)
        return 1.5 * sum(n * (self.noise(one).sigma * self.factor(one)) ** 2 for one, n in sizes)

    @property
    def unit(self) -> float:
        """Residual of a prior at one standard deviation: the RMS expected from noise alone.

        One if the law errs, as its error is of the size of the scales.
        """
        return 1.0 if self.erring else math.sqrt(self.floor / 1.5 / self.n_data) or 1.0

    def factor(self, name: str) -> float:
        """Return the residual of a deviation of one SI unit in a curve."""
        return float(self.weights[name] ** 0.5 / self.scale[name])

    def span(self, name: str) -> float:
        """Return the measured range of a curve, in units of its residual."""
        return float(np.ptp(self.measured[name])) * self.factor(name)

    def n_measured(self, name: str) -> int:
        """Return the number of measured samples of a curve, outliers included."""
        taken = self.measurement.sampled.get(channel_of(name))
        return self.time.size if taken is None else int(np.count_nonzero(taken))

    def by_curve(self, residual: Array) -> dict[str, Array]:
        """Split a residual into the parts of the counted curves."""
        return {name: residual[at] for name, *_, at in self._parts}

    def rms(self, residual: Array) -> dict[str, float]:
        """Return the RMS deviation of each counted curve in its unit, from a residual."""
        parts = self.by_curve(residual).items()
        return {name: float(np.sqrt(np.mean(own**2))) / self.factor(name) for name, own in parts}

    def misfit(self, simulated: Simulated) -> dict[str, float | None]:
        """Return the misfit of each curve: RMS of simulated minus measured over the measured range.

        Outliers are left out. It is None if the test or the drive does not have the curve, or if
        its motion was integrated from the force and does not count.
        """
        derived = curves.MOTION_CURVES if self.measurement.motion == INTEGRATED else ()
        shown = [name for name in self.curves if name in self.counted or name not in derived]
        return {name: self.off(simulated, name) if name in shown else None for name in self.curves}

    def look(self, values: Array) -> dict[str, float | None] | None:
        """Return the misfits of all curves, without counting the evaluation; None if it fails."""
        uncounted = copy(self)
        uncounted.spent = Spent()
        try:
            return self.misfit(uncounted.simulate(values, everything=True))
        except SimulationError:
            return None

    def off(self, simulated: Simulated, name: str) -> float | None:
        """Return the misfit of one curve; None if it was not measured or simulated."""
        measured, curve = self.measured.get(name), simulated.curves.get(name)
        if measured is None or curve is None:
            return None
        miss = (self.as_read(name, curve) - measured)[self.kept[name]]
        return float(np.sqrt(np.mean(miss**2)) / np.ptp(measured))
