"""What was identified: the result of a fit and the folder that it is written to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import lmfit

    from foamfit.chain import Chain
    from foamfit.measurement import Measurement

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter, in SI.

    `stderr` and `ci95` are None where the test does not determine it; `state` is "determined",
    "weak", "not determined" or "fixed" (fixed by the user or the model), and `why` says so in a sentence.
    """

    value: float
    stderr: float | None
    ci95: tuple[float, float] | None
    unit: str
    vary: bool
    state: str
    why: str


@dataclass(frozen=True, eq=False)
class Curves:
    """Measured and fitted curves, one row per sample of the conditioned test; None = not there.

    `stress` and `displacement` are what the drive gives (base stress in Pa, top displacement in m);
    `stress_along` is the stress (Pa) that the identified springs give along the measured displacement.
    """

    time: Array | None
    measured_stress: Array | None
    measured_displacement: Array | None
    stress: Array | None
    displacement: Array | None
    stress_along: Array | None


@dataclass(frozen=True)
class Switch:
    """A change of branch in the fitted response: which spring, when, and where on the curves."""

    spring: int  # 1 at the base
    source: str  # "a", "d", "c", "e"
    target: str
    time: float | None  # s
    displacement: float  # of the top, m
    stress: float  # Pa


@dataclass(frozen=True, eq=False)
class FitResult:
    """Everything that a fit found; `save` writes it as a folder."""

    measurement: Measurement
    model: str
    drive: str
    seed: int
    status: str
    warnings: tuple[str, ...]
    chain: Chain
    params: lmfit.Parameters
    parameters: dict[str, ParameterEstimate]
    visited: dict[str, tuple[str, ...]]
    misfit: dict[str, float | None]
    weights: dict[str, float]
    statistics: dict[str, float | int | None]
    energy: dict[str, Any]
    runtime_s: float
    curves: Curves
    switches: tuple[Switch, ...]

    def save(self, folder: str | Path) -> Path:
        """Write the result folder whole, replacing an older one at the end."""
        raise NotImplementedError
