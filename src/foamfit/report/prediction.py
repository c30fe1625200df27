"""Prediction of a test: folder, text and figure."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array, Mask
from foamfit.codec import plain
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.parts import OfLaw, ParameterEstimate
from foamfit.report import figures
from foamfit.report.figures import BLUE, INSIDE, TWO, VERMILION
from foamfit.report.folder import Result, write_columns, write_json
from foamfit.report.panels import AXES, Line, Panel, measured
from foamfit.report.plots import panelled
from foamfit.report.render import words
from foamfit.results import flags_of, stamp
from foamfit.springs.model import Model
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Colour and dashes of each part of the band; the dashes distinguish them in greyscale.
COLOURS: dict[str, tuple[str, Any]] = {
    "parameters": (BLUE, "-"),
    "scatter": (INSIDE[1], (0, (5, 1.2))),
    "noise": (INSIDE[2], (0, (2.5, 1.2))),
    "motion": (VERMILION, (0, (1, 1.2))),
    "law_error": (INSIDE[0], (0, (5, 1.2, 1, 1.2))),
}
# Labels and styles of curves.
PREDICTED: tuple[str, dict[str, Any]] = ("predicted", {"color": VERMILION, "lw": 0.9, "zorder": 4})
BAND: tuple[str, dict[str, Any]] = ("95 % band", {"color": VERMILION, "alpha": 0.18, "lw": 0.0})


@dataclass(frozen=True, eq=False)
class PredictedCurve:
    """A curve of a test with its 95 % band, one row per sample, in Pa or m."""

    channel: str  # "stress", "displacement", "displacement_1", …
    unit: str
    measured: Array
    predicted: Array
    lo: Array
    hi: Array
    parts: dict[str, Array]  # Half width (n,) of the band due to each source of uncertainty alone
    kept: Mask  # Samples that count: measured ones that are not outliers

    @property
    def range(self) -> float:
        """Range of the measured values."""
        return float(np.ptp(self.measured))

    def met(self, part: slice) -> dict[str, float]:
        """Return misfit over the range, and fraction inside the band, of a part of the samples."""
        kept, measured = self.kept[part], self.measured[part]
        residual = (self.predicted[part] - measured)[kept]
        within = (self.lo[part] <= measured) & (measured <= self.hi[part])
        misfit = np.sqrt(np.mean(residual**2)) / np.ptp(measured[kept])
        return {"misfit": float(misfit), "inside": float(np.mean(within[kept]))}

    @property
    def inside(self) -> float:
        """Fraction of the samples inside the band."""
        return self.met(slice(None))["inside"]

    @property
    def half_width(self) -> float:
        """Mean half width of the band over the samples that count."""
        return float(np.mean(0.5 * (self.hi - self.lo)[self.kept]))

    @property
    def widest(self) -> str:
        """The part that contributes most to the band."""
        return max(self.parts, key=self.half_width_of)

    def half_width_of(self, part: str) -> float:
        """Return the mean half width of the band due to a part alone."""
        return float(np.mean(self.parts[part][self.kept])) if part in self.parts else 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result, OfLaw):
    """Prediction, from a result, of a test that was not fitted; in SI."""

    source: str  #: Name of the result
    joint: bool  #: Whether the result is that of several tests
    measurement: Measurement  #: The test, whose specimen, striker and motion are simulated
    model: str
    relaxation: int
    drive: str
    seed: int
    #: Curves that the drive does not prescribe, by their names in fit.json
    curves: dict[str, PredictedCurve]
    misfit: dict[str, float | None]  #: RMS of predicted minus measured over the measured range
    parameters: dict[str, ParameterEstimate]  #: With `kind` as in joint.json
    rate: float | None  #: Mean strain rate of the test on loading, 1/s
    fitted_rates: tuple[float, ...]  #: Those of the fitted tests
    extrapolated: bool  #: Whether the rate lies outside the fitted ones
    draws: int  #: Number of specimens drawn
    redrawn: int  #: Number of further specimens, which were not admissible and were replaced
    held: tuple[str, ...]  #: Parameters fixed at their values because they are not determined
    #: Unknowns of the record (contact time, zeros, striker, time shift), fitted to it with the
    #: predicted springs; parameters that vary between specimens are free in this fit. Values count
    #: from the origins of the file.
    aligned: dict[str, float] = field(default_factory=dict)
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    _kind = "prediction.json"

    def __repr__(self) -> str:
        """Return the sentences on the prediction."""
        title = f"{self.measurement.name} predicted from {self.source}"
        return "\n  ".join((title, *self.sentences))

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints, with half widths relative to the range."""
        every = self.curves.values()
        parts = [part for part in COLOURS if any(part in one.parts for one in every)]
        return words("prediction", found=self, parts=parts)

    def write(self, folder: Path, *, pages: bool = True, width: str = TWO) -> None:
        """Write ``prediction.json``, ``.csv``, ``.png`` and ``.pdf`` into an existing folder."""
        write_json(folder / "prediction.json", self.to_json_dict())
        write_columns(folder / "prediction.csv", self.columns)
        if pages:
            figures.write_both(plot_prediction(self, width=width), folder / "prediction")

    @property
    def inside(self) -> dict[str, float]:
        """Fraction of the samples of each curve inside its 95 % band."""
        return {name: curve.inside for name, curve in self.curves.items()}

    @property
    def by_cycle(self) -> dict[int, dict[str, float]]:
        """Misfit over range and fraction inside the band by cycle, of the stress or first curve."""
        curve = self.curves.get("stress_time", next(iter(self.curves.values())))
        return {n: curve.met(part) for n, part in cycles_of(self.measurement).items()}

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``prediction.json``: SI, plain types, None for missing values."""
        m, model = self.measurement, Model.parse(self.model)
        renamed = ("source", "measurement", "model", "curves")
        names = [one.name for one in fields(self) if one.name not in renamed]
        names += ["inside", "by_cycle"]
        curves = {
            name: {
                "range": curve.range,
                "half_width": curve.half_width,
                "half_widths": {part: curve.half_width_of(part) for part in curve.parts},
                "n": int(curve.kept.sum()),
                "unit": curve.unit,
            }
            for name, curve in self.curves.items()
        }
        content = {**stamp(), "test": m.name}
        content |= {name: getattr(m, name) for name in ("data_sha256", "cycle", "last_cycle")}
        content |= {"result": self.source, "model": model.words, **model.options}
        content |= {name: getattr(self, name) for name in names} | {"curves": curves}
        return dict(plain(content))

    @property
    def columns(self) -> dict[str, Array]:
        """The columns of prediction.csv, one value per sample, in SI: the data of the figure."""
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
        columns |= flags_of(m)
        height = m.specimen.height
        if m.displacement is not None:
            columns["measured strain"] = m.displacement / height
        if (moved := self.curves.get("displacement_time")) is not None:
            columns["predicted strain"] = moved.predicted / height
        return columns


def plot_prediction(found: Prediction, *, width: str = TWO) -> Figure:
    """Draw the loop, and each curve with its band and below its parts; `width` as in `plot_fit`."""
    inside = ", ".join(f"{c.channel} {percent(c.inside, 3)}" for c in found.curves.values())
    about = f"{found.measurement.name}, predicted from {found.source}"
    title = f"{about}; {words('rates', found=found)}", f"inside the 95 % band: {inside}"
    return panelled(_panels(found), width, *title, known=found.drive == "displacement")


def _panels(found: Prediction) -> list[Panel]:
    """Return the loop, with the band of the stress if the motion is prescribed, and each curve."""
    m, told = found.measurement, {c.channel: c for c in found.curves.values()}
    stress, moved = told.get("stress"), told.get("displacement")
    motion, panels = m.displacement if moved is None else moved.predicted, list[Panel]()
    if m.displacement is not None and motion is not None:
        strain, height = motion / m.specimen.height, m.specimen.height
        loop = measured(m.displacement / height, m.stress)
        loop += [Line(strain, m.stress if stress is None else stress.predicted, *PREDICTED)]
        turn = int(np.argmax(motion))
        for way in (slice(None, turn + 1), slice(turn, None)):
            if stress is not None and moved is None:
                loop.append(Line(strain[way], stress.lo[way], *BAND, high=stress.hi[way]))
        panels.append(Panel("stress-strain", *AXES["stress-strain"], loop))
    for c in found.curves.values():
        timed = ("time", "s") if m.time is not None else ("sample", "–")
        x = m.instants
        lines = [Line(x, c.lo, *BAND, high=c.hi), *measured(x, c.measured)]
        lines += [Line(x, c.predicted, *PREDICTED)]
        halves = {"all": (0.5 * (c.hi - c.lo), "black", ":")}
        for part, look in COLOURS.items():
            if part in c.parts and np.any(c.parts[part]):
                halves[part.replace("_", " ")] = (c.parts[part], *look)
        below = list[Line]()
        for part, (half, colour, dashes) in halves.items():
            style = {"color": colour, "ls": dashes, "lw": 0.9}
            below.append(Line(x, 100.0 * half / c.range, f"half width: {part}", style))
        name = c.channel.replace("_", " ")
        panels.append(Panel(f"{name}-time", timed, (name, c.unit), lines, below, "half width"))
    return panels
