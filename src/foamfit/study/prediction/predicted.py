"""What the prediction of a test says: data only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.results import law_in_words, plain
from foamfit.springs.model import Model

SCHEMA = 1
# What makes the band, in the order in which it is told; "motion" where a noisy one drives.
PARTS = ("parameters", "scatter", "noise", "motion", "law_error")


@dataclass(frozen=True, eq=False)
class PredictedCurve:
    """A curve of a test with its 95 % band, one row per sample, Pa or m.

    `parts` has the half width (n,) that each of `PARTS` that is there would give the band alone.
    """

    channel: str  # "stress", "displacement", "displacement_1", …
    unit: str
    measured: Array
    predicted: Array
    lo: Array
    hi: Array
    parts: dict[str, Array]
    kept: NDArray[np.bool_]  # Samples that count: those that the channel measured, but no outliers

    @property
    def range(self) -> float:
        """Measured range."""
        return float(np.ptp(self.measured))

    @property
    def inside(self) -> float:
        """Share of the samples that lie inside the band."""
        within = (self.lo <= self.measured) & (self.measured <= self.hi)
        return float(np.mean(within[self.kept]))

    @property
    def half_width(self) -> float:
        """Half of the band, mean over the samples that count."""
        return float(np.mean(0.5 * (self.hi - self.lo)[self.kept]))

    @property
    def widest(self) -> str:
        """The part that makes the band widest."""
        return max(self.parts, key=self.half_width_of)

    def half_width_of(self, part: str) -> float:
        """Half of the band that a part alone would give, mean over the samples that count."""
        return float(np.mean(self.parts[part][self.kept])) if part in self.parts else 0.0


@dataclass(frozen=True)
class PredictedParameter:
    """A parameter as it is for the test: its value, and its 95 % interval."""

    kind: str  # As in joint.json; "shared" or "fixed" where the result is of one test
    value: float
    lo: float
    hi: float


@dataclass(frozen=True, eq=False)
class PredictedTest:
    """A test that was not fitted, predicted from a result, SI."""

    source: str  # Name of the result
    joint: bool  # Whether it is of several tests
    measurement: Measurement  # The test: its specimen, striker and motion are simulated
    model: str
    relaxation: int
    drive: str
    seed: int
    curves: dict[
        str, PredictedCurve
    ]  # By their names in fit.json; those that the drive leaves free
    misfit: dict[str, float | None]  # RMS of predicted minus measured over the measured range
    parameters: dict[str, PredictedParameter]
    # Mean strain rate on loading of the test and of those that were fitted, 1/s
    rate: float | None
    fitted_rates: tuple[float, ...]
    extrapolated: bool  # Whether the rate lies outside the fitted ones
    draws: int  # Of specimens
    redrawn: int  # Those more that were not admissible and were drawn again
    held: tuple[str, ...]  # Parameters that the result does not determine, held at their values
    sentences: tuple[str, ...]
    warnings: tuple[str, ...]
    # What the record of the test does not say exactly (contact time, zeros, striker, time shift),
    # fitted to it with the springs held as predicted but for what varies between specimens: values
    # in its own numbers
    aligned: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Tell how well it meets the record."""
        head = f"{self.measurement.name} predicted from {self.source}"
        return "\n  ".join((head, *self.sentences))

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.model, self.relaxation)

    @property
    def inside(self) -> dict[str, float]:
        """Share of the samples of each curve that lie inside its 95 % band."""
        return {name: curve.inside for name, curve in self.curves.items()}

    @property
    def by_cycle(self) -> dict[int, dict[str, float]]:
        """Misfit, over its own range, and share inside the band of each of several cycles.

        They are those of the stress under a driven motion, or of the first curve.
        """
        curve = self.curves.get("stress_time", next(iter(self.curves.values())))
        out = {}
        for number, part in cycles_of(self.measurement).items():
            kept = curve.kept[part]
            measured, predicted, lo, hi = (
                one[part][kept] for one in (curve.measured, curve.predicted, curve.lo, curve.hi)
            )
            miss = float(np.sqrt(np.mean((predicted - measured) ** 2)) / np.ptp(measured))
            within = float(np.mean((lo <= measured) & (measured <= hi)))
            out[number] = {"misfit": miss, "inside": within}
        return out

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``prediction.json``: SI, plain types, null = not there."""
        m, model = self.measurement, Model.parse(self.model)
        asked = ("relaxation", "drive", "seed", "draws", "redrawn", "rate", "fitted_rates")
        found = ("extrapolated", "misfit", "inside", "by_cycle")
        told = ("parameters", "held", "aligned", "warnings", "sentences")
        content: dict[str, Any] = plain(
            {
                "schema": SCHEMA,
                "foamfit": version("foamfit"),
                "test": m.name,
                "data_sha256": m.data_sha256,
                "cycle": m.cycle,
                "last_cycle": m.last_cycle,
                "result": self.source,
                "joint": self.joint,
                "model": model.words,
                **model.options,
                **{name: getattr(self, name) for name in (*asked, *found)},
                "curves": {
                    name: {
                        "range": curve.range,
                        "half_width": curve.half_width,
                        "half_widths": {part: curve.half_width_of(part) for part in curve.parts},
                        "n": int(curve.kept.sum()),
                        "unit": curve.unit,
                    }
                    for name, curve in self.curves.items()
                },
                **{name: getattr(self, name) for name in told},
            }
        )
        return content

    def rows(self) -> Iterator[list[object]]:
        """Rows of prediction.csv, the header first: one row per sample, SI.

        Everything that `prediction.png` shows is in them.
        """
        m, columns = self.measurement, dict[str, Array]()
        if m.time is not None:
            columns["time (s)"] = m.time
        predicted = {curve.channel for curve in self.curves.values()}
        for channel, values in m.channels().items():
            if channel not in predicted:
                columns[f"measured {channel} ({'Pa' if channel == 'stress' else 'm'})"] = values
        for curve in self.curves.values():
            channel, unit = curve.channel, curve.unit
            columns[f"measured {channel} ({unit})"] = curve.measured
            columns[f"predicted {channel} ({unit})"] = curve.predicted
            columns[f"{channel} band low ({unit})"] = curve.lo
            columns[f"{channel} band high ({unit})"] = curve.hi
            for part, width in curve.parts.items():
                columns[f"{channel} half width, {part.replace('_', ' ')} ({unit})"] = width
            found, taken = m.outliers.get(channel), m.sampled.get(channel)
            if found is not None and found.left_out.any():
                columns[f"outliers of {channel} left out"] = found.left_out.astype(int)
            if taken is not None:
                columns[f"{channel} is measured"] = taken.astype(int)
        height = m.specimen.height
        if m.displacement is not None:
            columns["measured strain"] = m.displacement / height
        if (moved := self.curves.get("displacement_time")) is not None:
            columns["predicted strain"] = moved.predicted / height
        yield list(columns)
        for row in zip(*(column.tolist() for column in columns.values()), strict=True):
            yield list(row)
