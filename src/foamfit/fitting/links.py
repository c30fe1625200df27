"""What a parameter is to several tests that are fitted together, and the laws of rate.

A parameter is shared (one value), own (one value for each test), scatters (one for each test,
log-normal about a common value), or follows a law of rate, of which the common value v and the
slope b are shared: with x = ln(rate/rate0) of a test, v·(1 + b x) or v·(rate/rate0)^b = v·e^(b x).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array

LOG_RATE, POWER_RATE = "log rate", "power rate"
RATES = (LOG_RATE, POWER_RATE)
KINDS = ("shared", "own", "scatter", *RATES)
# Smallest factor of the law v·(1 + b x): past it the law has no positive value to give.
LEAST_FACTOR = 1e-6
# The slope of a law of rate lies within so much of zero.
STEEPEST = 5.0


@dataclass(frozen=True, eq=False)
class Links:
    """What the parameters are to n tests.

    `kinds` has one of `KINDS` for each parameter that is named; the others are own. `log_rates`
    (n,) are ln(rate/rate0), needed by laws of rate, and `rate_errors` (n,) their standard errors
    (none where there is none). `pulls` (n,) of a scattering parameter are the
    roots of the weights of (ln v - ln common value)²; where there is none nothing pulls.
    """

    kinds: Mapping[str, str]
    log_rates: Array | None = None
    pulls: Mapping[str, Array] = field(default_factory=dict)
    rate_errors: Array | None = None

    def kind(self, name: str) -> str:
        """Kind of a parameter."""
        return self.kinds.get(name, "own")


def law(kind: str, v: float, b: float, x: float) -> float:
    """Value at x = ln(rate/rate0) by a law of rate."""
    return v * (max(1.0 + b * x, LEAST_FACTOR) if kind == LOG_RATE else float(np.exp(b * x)))


def law_slopes(kind: str, v: float, b: float, x: float) -> tuple[float, float]:
    """Derivatives of `law` by v and b."""
    if kind == POWER_RATE:
        factor = float(np.exp(b * x))
        return factor, v * x * factor
    steep = 1.0 + b * x > LEAST_FACTOR
    return max(1.0 + b * x, LEAST_FACTOR), v * x if steep else 0.0


def log_law(kind: str, u: float, b: float, x: float) -> float:
    """Logarithm of the value, with u the logarithm of the common value."""
    return u + (float(np.log(max(1.0 + b * x, LEAST_FACTOR))) if kind == LOG_RATE else b * x)


def log_law_slopes(kind: str, b: float, x: float) -> tuple[float, float]:
    """Derivatives of `log_law` by u and b."""
    if kind == POWER_RATE:
        return 1.0, x
    factor = 1.0 + b * x
    return 1.0, x / factor if factor > LEAST_FACTOR else 0.0


def law_bend(kind: str, v: float, b: float, x: float) -> float:
    """Second derivative of `law` by b, that by v and b being its first by b over v."""
    return v * x * x * float(np.exp(b * x)) if kind == POWER_RATE else 0.0


def start_of(kind: str, values: Array, x: Array) -> tuple[float, float]:
    """Common value and slope nearest to the values of some tests (least squares, as the law is).

    Values that the law cannot meet give their median and no slope.
    """
    if kind == POWER_RATE and np.all(values > 0.0):
        slope, level = np.polyfit(x, np.log(values), 1) if np.ptp(x) > 0.0 else (0.0, None)
        v = float(np.median(values)) if level is None else float(np.exp(level))
    else:
        slope, v = np.polyfit(x, values, 1) if np.ptp(x) > 0.0 else (0.0, np.median(values))
        slope = slope / v if v else 0.0
    slope = float(np.clip(slope, -STEEPEST, STEEPEST))
    if not np.isfinite(v) or v == 0.0 or np.min(law_values(kind, float(v), slope, x) / v) <= 1e-3:
        return float(np.median(values)), 0.0
    return float(v), slope


def law_values(kind: str, v: float, b: float, x: Array) -> Array:
    """Values of several tests by a law of rate."""
    return np.array([law(kind, v, b, float(one)) for one in x])


@dataclass(frozen=True, eq=False)
class Slots:
    """Where each linked parameter has its coordinates among the shared ones.

    `linked` are the parameters that follow from shared coordinates, `scatter` those of which only
    the common value (the logarithm) is one.
    """

    linked: tuple[str, ...]
    kinds: tuple[str, ...]  # Of `linked`
    scatter: tuple[str, ...]

    @cached_property
    def places(self) -> NDArray[np.intp]:
        """Place of the first coordinate of each linked parameter."""
        counts = [2 if kind in RATES else 1 for kind in self.kinds]
        return np.cumsum([0, *counts])[:-1].astype(np.intp)

    @cached_property
    def common(self) -> NDArray[np.intp]:
        """Places of the common values of the scattering parameters."""
        laws = sum(kind in RATES for kind in self.kinds)
        return len(self.linked) + laws + np.arange(len(self.scatter), dtype=np.intp)

    @property
    def count(self) -> int:
        """Number of shared coordinates."""
        laws = sum(kind in RATES for kind in self.kinds)
        return len(self.linked) + laws + len(self.scatter)
