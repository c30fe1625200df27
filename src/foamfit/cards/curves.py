"""Loading curves of a fitted law: engineering values, compression positive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.integrate import cumulative_trapezoid

from foamfit.arrays import Array
from foamfit.data.measurement import Specimen
from foamfit.solve.simulation import Response, simulate
from foamfit.springs.chain import DisplacementDrive
from foamfit.study.prediction.identified import Source
from foamfit.study.prediction.population import Population

POINTS = 100  # of a curve in a card
# A curve ends at this strain, or where the stress is so many times the largest measured one, but
# not within the measured strain.
END, MOST = 0.9, 10.0
_FINE = 2000  # intervals of the strain from which the points are chosen
# Least slope of a curve over its mean slope within the measured strain.
_LEAST_SLOPE = 1e-3
# The jump that a dashpot makes at the start is spread over this strain.
_START = 0.01
# Rates that differ by less than this share are one; so are curves, of their range.
_SAME, _CLOSE = 0.1, 0.01


@dataclass(frozen=True, eq=False)
class Curves:
    """Loading curves: stress (n_rates, n) in Pa over strain (n,) at strain rates (1/s), ascending.

    Beyond the strain `measured_to` they are extrapolated by the law.
    """

    rates: Array
    strain: Array
    stress: Array
    measured_to: float

    @cached_property
    def work(self) -> Array:
        """Energy under the curves up to each strain, (n_rates, n), J/m³."""
        return np.asarray(cumulative_trapezoid(self.stress, self.strain, initial=0))

    @property
    def measured(self) -> int:
        """How many of the points lie within the measured strain."""
        return int(np.sum(self.strain <= self.measured_to))

    def at(self, values: Array, strain: Array, rate: Array) -> Array:
        """Interpolate `stress` or `work` linearly in strain and rate, clamped at the ends."""
        each = np.array([np.interp(strain, self.strain, one) for one in values])
        place = np.interp(rate, self.rates, np.arange(self.rates.size))
        low, samples = place.astype(int), np.arange(strain.size)
        high = np.minimum(low + 1, self.rates.size - 1)
        below: Array = each[low, samples]
        return np.asarray(below + (place - low) * (each[high, samples] - below))


def follow(
    source: Source, rate: float | None, strain: Array, time: Array, names: Sequence[str] = ()
) -> Response:
    """Follow the law, as it is at a strain rate (1/s), along a strain; the time is in s.

    `names` are parameters by which the stress is differentiated. Raises InputError if the common
    values of a joint result are not admissible together, SimulationError if it cannot be followed.
    """
    heights = [one.value for name, one in source.parameters.items() if name.endswith("_height")]
    height = sum(heights) or 1.0  # a single spring of any height has the same stress
    population = Population(source, source.model.names, Specimen(height, 1.0), rate)
    chain = source.model.chain(population.point, height, 1.0)
    return simulate(chain, DisplacementDrive(strain * height), time, sensitivities=names)


def fitted_rates(source: Source) -> list[float]:
    """Return the rates of the fitted tests, ascending, one of each group of about the same rate."""
    rates = np.sort(source.rates)
    return [float(rates[at]) for at in np.unique(np.round(np.log(rates) / _SAME), True)[1]]


def loading_curves(
    source: Source, rates: Sequence[float], measured_to: float
) -> tuple[Curves, bool]:
    """Return the loading curves at ascending rates, and whether curves of the law had crossed.

    Each starts at zero and rises strictly, and none is below that of a lower rate. A rate beyond
    the fitted ones has the curve of the nearest fitted rate.
    """
    ends = (min(source.rates), max(source.rates)) if source.rates else (rates[0], rates[0])
    fine = np.linspace(0.0, max(END, measured_to), _FINE + 1)
    within = fine <= measured_to
    known = np.clip(rates, *ends).tolist()
    raw = np.array([follow(source, rate, fine, fine / rate).base_stress for rate in known])
    jumps = np.maximum(2.0 * raw[:, 1:2] - raw[:, 2:3], 0.0)
    raw = raw - jumps * np.maximum(1.0 - fine / _START, 0.0)
    raw[:, 0] = 0.0
    line = _LEAST_SLOPE * raw[:, within].max() / measured_to * fine
    rising = np.maximum.accumulate(raw - line, axis=1) + line
    stress = np.maximum.accumulate(rising, axis=0)
    scale = float(stress[:, within].max())
    kept = within | (stress.max(axis=0) <= MOST * scale)
    strain = _points(fine[kept], stress[:, kept] / scale, measured_to)
    chosen = np.array([np.interp(strain, fine, one) for one in stress])
    crossed = bool(np.any(stress - rising > _CLOSE * scale))
    return Curves(np.array(rates), strain, chosen, measured_to), crossed


def _points(fine: Array, stress: Array, measured_to: float) -> Array:
    """Choose the strains of a card: dense where a curve bends, `measured_to` among them."""
    # What lines between points miss goes with curvature times the square of their distance; it is
    # judged against the stress, at least that at `measured_to` (1).
    bend = np.abs(np.gradient(np.gradient(stress, fine, axis=1), fine, axis=1))
    density = np.sqrt((bend / np.maximum(stress, 1.0)).max(axis=0))
    density = density / density.mean() + 0.5
    share = cumulative_trapezoid(density, fine, initial=0)
    strain = np.interp(np.linspace(0.0, share[-1], POINTS), share, fine)
    strain[np.argmin(np.abs(strain - measured_to))] = measured_to
    return np.asarray(strain)


def guessed(source: Source, curves: Curves) -> list[str]:
    """Return the parameters on which the curves depend and which the tests do not determine."""
    open_ = [name for name, one in source.parameters.items() if one.state == "not determined"]
    rate = source.rates[0] if source.rates else 1.0
    slopes = follow(source, rate, curves.strain, curves.strain / rate, open_).sensitivities
    changes = {name: slopes[name].base_stress * source.parameters[name].value for name in open_}
    least = _CLOSE * curves.stress.max()
    return [name for name in open_ if np.abs(changes[name]).max() > least]
