"""Loading curves of a fitted law, and the unloading of a card, fitted to the law.

Values are engineering, compression positive. Unloading scales the stress σ_load of the loading
curve,

    σ = [1 - (1 - HU) (1 - (W/Wmax)^SHAPE)^EXPON] σ_load,

with the energy W under the loading curve at the current strain, and Wmax at the largest strain so
far. Each solver applies this formula in its own way: see `REPLAYS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from foamfit.arrays import Array, Mask
from foamfit.data.measurement import Specimen
from foamfit.errors import InputError, SimulationError
from foamfit.solve.simulation import Response, simulate
from foamfit.springs.chain import DisplacementDrive
from foamfit.study.identified import Population, Source

POINTS = 100  # of a curve in a card
# A curve ends at the strain END, or where its stress exceeds MOST times the largest stress within
# the measured strain. It always covers the measured strain.
END, MOST = 0.9, 10.0
_ENDS = 20  # ends of the curves that are tried
_FINE = 2000  # intervals of the strain from which the points are chosen
_LEAST_SLOPE = 1e-3  # least slope of a curve over its mean slope within the measured strain
_SAME = 0.1  # rates that differ by a smaller fraction count as equal
_CLOSE = 0.01  # smaller differences of stress, over its range, are ignored
# Bounds and start of HU, SHAPE and EXPON. HU = 0 would switch off the hysteresis.
_LEAST, _MOST = (1e-3, 0.05, 0.05), (1.0, 50.0, 50.0)
_START_AT = (0.2, 2.0, 0.9)
_WINDOW = 0.03  # smoothing window of the strain, as a fraction of the samples of a record


@dataclass(frozen=True, eq=False)
class Curves:
    """Loading curves over the strain, one for each strain rate."""

    rates: Array  #: 1/s, ascending
    strain: Array  #: (n,)
    stress: Array  #: (n_rates, n), Pa
    measured_to: float  #: strain beyond which they are extrapolated by the law

    @cached_property
    def work(self) -> Array:
        """Energy under the curves up to each strain, (n_rates, n), J/m³."""
        return np.asarray(cumulative_trapezoid(self.stress, self.strain, initial=0))

    @property
    def measured(self) -> int:
        """Number of points within the measured strain."""
        return int(np.sum(self.strain <= self.measured_to))

    def at(self, values: Array, strain: Array, rate: Array) -> Array:
        """Interpolate `stress` or `work` linearly in strain and rate, clamped at the ends."""
        curves = np.array([np.interp(strain, self.strain, one) for one in values])
        place = np.interp(rate, self.rates, np.arange(self.rates.size))
        low, samples = place.astype(int), np.arange(strain.size)
        high = np.minimum(low + 1, self.rates.size - 1)
        below: Array = curves[low, samples]
        return np.asarray(below + (place - low) * (curves[high, samples] - below))


def follow(
    source: Source, rate: float | None, strain: Array, time: Array, names: Sequence[str] = ()
) -> Response:
    """Simulate the law along a strain (over time in s) at `rate` (1/s), with slopes by `names`.

    Raises InputError if the common values of a joint result are not admissible together.
    """
    heights = [one.value for name, one in source.parameters.items() if name.endswith("_height")]
    height = sum(heights) or 1.0  # a single spring of any height has the same stress
    population = Population(source, Specimen(height, 1.0), rate)
    try:
        chain = source.model.chain(population.point, height, 1.0)
    except InputError as error:
        if not source.joint:
            raise
        raise InputError(
            f"{source.where}: the common values of its tests are not a spring ({error}). Its tests "
            "may be of different foams; give the folder of one of them"
        ) from None
    return simulate(chain, DisplacementDrive(strain * height), time, sensitivities=names)


def fitted_rates(source: Source) -> list[float]:
    """Return the rates of the fitted tests, ascending, one for each group of nearly equal rates."""
    rates: list[float] = []
    for rate in sorted(map(float, source.rates)):
        if not rates or rate > rates[-1] * (1.0 + _SAME):
            rates.append(rate)
    return rates


def curves_at(source: Source, rates: Sequence[float], measured_to: float) -> tuple[Curves, bool]:
    """Return the loading curves at ascending rates, and whether curves of the law cross.

    Each curve starts at zero, rises strictly and is nowhere below that of a lower rate. For a rate
    outside the fitted ones it is the curve at the nearest fitted rate.
    """
    ends = (min(source.rates), max(source.rates)) if source.rates else (rates[0], rates[0])
    fine, raw = _reached(source, np.clip(rates, *ends).tolist(), measured_to)
    within = fine <= measured_to
    raw[:, 0] = 0.0  # the jump due to a dashpot is spread over the first interval
    line = _LEAST_SLOPE * raw[:, within].max() / measured_to * fine
    rising = np.maximum.accumulate(raw - line, axis=1) + line
    stress = np.maximum.accumulate(rising, axis=0)
    scale = float(stress[:, within].max())
    kept = within | (stress.max(axis=0) <= MOST * scale)
    strain = np.linspace(0.0, fine[kept][-1], POINTS)
    strain[np.argmin(np.abs(strain - measured_to))] = measured_to
    chosen = np.array([np.interp(strain, fine, one) for one in stress])
    crossed = bool(np.any(stress - rising > _CLOSE * scale))
    return Curves(np.array(rates), strain, chosen, measured_to), crossed


def _reached(source: Source, rates: Sequence[float], measured_to: float) -> tuple[Array, Array]:
    """Return strains up to the largest that the law reaches, and its stress there at each rate."""
    for end in np.linspace(max(END, measured_to), measured_to, _ENDS).tolist():
        fine = np.linspace(0.0, end, _FINE + 1)
        try:
            return fine, np.array([follow(source, r, fine, fine / r).base_stress for r in rates])
        except SimulationError as error:  # a negative eps_star ends a spring below a strain of one
            ended = error
    raise ended


def guessed(source: Source, curves: Curves) -> list[str]:
    """Return the parameters that affect the curves but are not determined by the tests."""
    open_ = [name for name, one in source.parameters.items() if one.state == "not determined"]
    rate = source.rates[0] if source.rates else 1.0
    slopes = follow(source, rate, curves.strain, curves.strain / rate, open_).sensitivities
    changes = {name: slopes[name].base_stress * source.parameters[name].value for name in open_}
    least = _CLOSE * curves.stress.max()
    return [name for name in open_ if np.abs(changes[name]).max() > least]


class Unloading(NamedTuple):
    """Parameters of the unloading, by their names in the cards."""

    HU: float
    SHAPE: float
    EXPON: float = 1.0

    def share(self, energy: Array) -> Array:
        """Return the stress over the loading stress at `energy` = W/Wmax."""
        recovered = 1.0 - np.clip(energy, 0.0, 1.0) ** self.SHAPE
        return np.asarray(1.0 - (1.0 - self.HU) * recovered**self.EXPON)


# The stress (Pa) of a card along a record, as a function of the unloading.
Replay = Callable[[Unloading], Array]


class Motion(NamedTuple):
    """Strain of a record, its rate (1/s), and whether it is the largest so far (first loading)."""

    strain: Array
    rate: Array
    first: Mask

    @classmethod
    def of(cls, strain: Array, time: Array) -> Motion:
        """Return the motion of a record in compression; the time is in s."""
        strain = np.maximum(strain, 0.0)
        window = max(3, int(_WINDOW * strain.size)) | 1  # so that noise neither loads nor unloads
        smooth = savgol_filter(strain, window, 1) if strain.size > window else strain
        return cls(strain, np.gradient(smooth, time), smooth >= np.maximum.accumulate(smooth))


def by_energy(curves: Curves, motion: Motion) -> Replay:
    """LS-DYNA: the stress is scaled below the largest strain so far, on reloading as well."""
    strain, speed = motion.strain, np.abs(motion.rate)
    load, work = (curves.at(values, strain, speed) for values in (curves.stress, curves.work))
    most = curves.at(curves.work, np.maximum.accumulate(strain), speed)
    energy = np.where(motion.first, 1.0, _ratio(work, most))
    return lambda unloading: unloading.share(energy) * load


def by_slowest(curves: Curves, motion: Motion) -> Replay:
    """Radioss LAW90: unloading scales the slowest curve, any loading follows the loading curves."""
    back = (motion.rate < 0.0) & ~motion.first
    load = curves.at(curves.stress, motion.strain, np.where(back, 0.0, motion.rate))
    # The energy is integrated along the path.
    work: Array = np.maximum(cumulative_trapezoid(load, motion.strain, initial=0), 0.0)
    energy = np.where(back, _ratio(work, np.maximum.accumulate(work)), 1.0)
    return lambda unloading: unloading.share(energy) * load


def by_rate(curves: Curves, motion: Motion) -> Replay:
    """Abaqus: interpolate in the rate between an unloading curve and the loading curves."""
    load = curves.at(curves.stress, motion.strain, np.maximum(motion.rate, 0.0))
    back = np.clip(0.5 * (1.0 - motion.rate / curves.rates[0]), 0.0, 1.0)

    def stress(unloading: Unloading) -> Array:
        below = np.interp(motion.strain, curves.strain, unloading_curve(curves, unloading))
        return np.asarray(back * below + (1.0 - back) * load)

    return stress


REPLAYS = {"mat083": by_energy, "mat057": by_energy, "csv": by_energy}
REPLAYS |= {"law90": by_slowest, "abaqus": by_rate}


def _ratio(work: Array, most: Array) -> Array:
    """Return W/Wmax, or 1 where Wmax is zero."""
    return np.divide(work, most, out=np.ones_like(most), where=most > 0.0)


def unloading_curve(curves: Curves, unloading: Unloading) -> Array:
    """Return the stress (Pa) of unloading from the largest measured strain at the lowest rate."""
    most = np.interp(curves.measured_to, curves.strain, curves.work[0])
    # Beyond this strain it stays just below the loading curve, which it must not meet.
    share = np.minimum(unloading.share(curves.work[0] / most), 0.999)
    return np.asarray(share * curves.stress[0])


def fit_unloading(
    replays: Sequence[Replay], targets: Sequence[Array], *, expon: bool = True
) -> Unloading:
    """Fit the unloading to stresses (Pa) relative to their ranges; without `expon`, EXPON is 1."""
    free = slice(None) if expon else slice(2)
    weights = [1.0 / (np.ptp(target) * np.sqrt(target.size)) for target in targets]

    def residuals(logs: Array) -> Array:
        unloading = Unloading(*np.exp(logs).tolist())
        triples = zip(replays, targets, weights, strict=True)
        return np.concatenate([w * (replay(unloading) - target) for replay, target, w in triples])

    bounds = (np.log(_LEAST)[free], np.log(_MOST)[free])
    found = least_squares(residuals, np.log(_START_AT)[free], bounds=bounds)
    return Unloading(*np.exp(found.x).tolist())
