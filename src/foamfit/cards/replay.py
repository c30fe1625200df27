"""A card along a strain, as its solver follows it, and its unloading fitted to a law.

Unloading takes a share of the stress σ_load of the loading curve,

    σ = [1 - (1 - HU) (1 - (W/Wmax)^SHAPE)^EXPON] σ_load,

with the energy W under the loading curve at the strain, and Wmax at the largest strain so far. The
solvers differ in what they do with it: see `REPLAYS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from foamfit.arrays import Array
from foamfit.cards.curves import Curves

# Least and largest HU, SHAPE and EXPON, and where their search starts. HU = 0 would switch the
# hysteresis off.
_LEAST, _MOST = (1e-3, 0.05, 0.05), (1.0, 50.0, 50.0)
_STARTS = ((0.2, 0.5, 0.9), (0.2, 2.0, 0.9), (0.5, 5.0, 1.1), (0.1, 1.0, 0.5))
# Window over which the strain of a record is smoothed, as a share of its samples.
_WINDOW = 0.03


class Unloading(NamedTuple):
    """Parameters of the unloading, as cards name them."""

    HU: float
    SHAPE: float
    EXPON: float = 1.0

    def share(self, energy: Array) -> Array:
        """Share of the loading stress at W/Wmax."""
        gone = 1.0 - np.clip(energy, 0.0, 1.0) ** self.SHAPE
        return np.asarray(1.0 - (1.0 - self.HU) * gone**self.EXPON)


# The stress (Pa) of a card along a record, by its unloading.
Replay = Callable[[Unloading], Array]


class Motion(NamedTuple):
    """Strain of a record, its strain rate (1/s), and where it is the largest so far.

    The last two are those of the smoothed strain: noise neither loads nor unloads.
    """

    strain: Array
    rate: Array
    first: NDArray[np.bool_]

    @classmethod
    def of(cls, strain: Array, time: Array) -> Motion:
        """Return the motion of a record in compression; the time is in s."""
        strain = np.maximum(strain, 0.0)
        window = max(3, int(_WINDOW * strain.size)) | 1
        smooth = savgol_filter(strain, window, 1) if strain.size > window else strain
        return cls(strain, np.gradient(smooth, time), smooth >= np.maximum.accumulate(smooth))


def by_energy(curves: Curves, motion: Motion) -> Replay:
    """LS-DYNA: below the largest strain so far the stress is the share, also in loading again."""
    strain, speed = motion.strain, np.abs(motion.rate)
    load, work = (curves.at(values, strain, speed) for values in (curves.stress, curves.work))
    most = curves.at(curves.work, np.maximum.accumulate(strain), speed)
    energy = np.where(motion.first, 1.0, _ratio(work, most))
    return lambda unloading: unloading.share(energy) * load


def by_slowest(curves: Curves, motion: Motion) -> Replay:
    """Radioss LAW90: unloading takes a share of the slowest curve, any loading the whole stress.

    The energy is summed up along the path.
    """
    back = (motion.rate < 0.0) & ~motion.first
    load = curves.at(curves.stress, motion.strain, np.where(back, 0.0, motion.rate))
    summed: Array = cumulative_trapezoid(load, motion.strain, initial=0)
    work = np.maximum(summed, 0.0)
    energy = np.where(back, _ratio(work, np.maximum.accumulate(work)), 1.0)
    return lambda unloading: unloading.share(energy) * load


def by_rate(curves: Curves, motion: Motion) -> Replay:
    """Abaqus: interpolated in the rate between an unloading curve and the loading curves."""
    load = curves.at(curves.stress, motion.strain, np.maximum(motion.rate, 0.0))
    back = np.clip(0.5 * (1.0 - motion.rate / curves.rates[0]), 0.0, 1.0)

    def stress(unloading: Unloading) -> Array:
        below = np.interp(motion.strain, curves.strain, unloading_curve(curves, unloading))
        return np.asarray(back * below + (1.0 - back) * load)

    return stress


REPLAYS = {"mat083": by_energy, "mat057": by_energy, "csv": by_energy}
REPLAYS |= {"law90": by_slowest, "abaqus": by_rate}


def _ratio(work: Array, most: Array) -> Array:
    """W/Wmax; 1 where nothing has been loaded."""
    return np.divide(work, most, out=np.ones_like(most), where=most > 0.0)


def unloading_curve(curves: Curves, unloading: Unloading) -> Array:
    """Return the stress (Pa) of unloading from the largest measured strain at the lowest rate.

    Beyond that it stays just below the loading curve, which it must not meet.
    """
    most = np.interp(curves.measured_to, curves.strain, curves.work[0])
    share = np.minimum(unloading.share(curves.work[0] / most), 0.999)
    return np.asarray(share * curves.stress[0])


def fit_unloading(
    replays: Sequence[Replay], targets: Sequence[Array], *, expon: bool = True
) -> Unloading:
    """Fit the unloading to stresses (Pa) along records; without `expon` the exponent is 1.

    Each record counts the same, by the mean square of the residuals over its range.
    """
    free = slice(None) if expon else slice(2)
    weights = [1.0 / (np.ptp(target) * np.sqrt(target.size)) for target in targets]

    def off(logs: Array) -> Array:
        unloading = Unloading(*np.exp(logs).tolist())
        triples = zip(replays, targets, weights, strict=True)
        return np.concatenate([w * (replay(unloading) - target) for replay, target, w in triples])

    bounds = (np.log(_LEAST)[free], np.log(_MOST)[free])
    found = [least_squares(off, np.log(start)[free], bounds=bounds) for start in _STARTS]
    return Unloading(*np.exp(min(found, key=lambda one: one.cost).x).tolist())
