"""Links between the parameters of several tests that are fitted together.

A parameter is shared (one value), own (one value per test), scattering (one value per test,
log-normal about a common value), or follows a rate law with a common value v and slope b: with
x = ln(rate/rate0) of a test, v·(1 + b x) or v·(rate/rate0)^b = v·e^(b x).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from foamfit.arrays import Array

LOG_RATE, POWER_RATE = "log rate", "power rate"
RATES = (LOG_RATE, POWER_RATE)
KINDS = ("shared", "own", "scatter", *RATES)
LEAST_FACTOR = 1e-6  # smallest factor 1 + b x, below which the law has no positive value
STEEPEST = 5.0  # largest absolute slope of a rate law


@dataclass(frozen=True, eq=False)
class Links:
    """The links between the parameters of n tests.

    `kinds` gives one of `KINDS` for each named parameter; all others are own. `log_rates` (n,) are
    ln(rate/rate0), needed for rate laws. `pulls` (n,) of a scattering parameter are the square
    roots of the weights of (ln v - ln common value)²; parameters without an entry have no such
    term.
    """

    kinds: Mapping[str, str]
    log_rates: Array | None = None
    pulls: Mapping[str, Array] = field(default_factory=dict)

    def kind(self, name: str) -> str:
        """Return the kind of a parameter."""
        return self.kinds.get(name, "own")

    def x(self, test: int) -> float:
        """Return ln(rate/rate0) of a test; 0 if no rates are known."""
        return 0.0 if self.log_rates is None else float(self.log_rates[test])

    def having(self, **kinds: str) -> Links:
        """Return links with some kinds replaced."""
        return replace(self, kinds={**self.kinds, **kinds})

    def of(self, tests: list[int]) -> Links:
        """Return the links of a subset of the tests."""
        rates = None if self.log_rates is None else self.log_rates[tests]
        pulls = {name: pull[tests] for name, pull in self.pulls.items()}
        return replace(self, log_rates=rates, pulls=pulls)


def factor(kind: str, b: float, x: float) -> tuple[float, float]:
    """Return value over common value at x = ln(rate/rate0), and its derivative by b."""
    if kind == POWER_RATE:
        value = float(np.exp(b * x))
        return value, x * value
    value = 1.0 + b * x
    return (value, x) if value > LEAST_FACTOR else (LEAST_FACTOR, 0.0)


def start_of(kind: str, values: Array, x: Array) -> tuple[float, float]:
    """Return the common value and slope of the rate law fitted to the values of some tests.

    If the law cannot describe the values, their median and slope zero are returned.
    """
    middle = float(np.median(values))
    if not np.ptp(x) > 0.0:
        return middle, 0.0
    if kind == POWER_RATE and np.all(values > 0.0):
        slope, level = np.polyfit(x, np.log(values), 1)
        v = float(np.exp(level))
    else:
        slope, v = np.polyfit(x, values, 1)
        slope = slope / v if v else 0.0
    slope = float(np.clip(slope, -STEEPEST, STEEPEST))
    if not np.isfinite(v) or v == 0.0 or min(factor(kind, slope, one)[0] for one in x) <= 1e-3:
        return middle, 0.0
    return float(v), slope
