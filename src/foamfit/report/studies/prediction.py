"""Prediction of a test: folder, text and figure."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.codec import plain
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.parts import ParameterEstimate, law_in_words
from foamfit.report import figures
from foamfit.report.figures import BLUE, FITTED, INSIDE, SEEN, TWO, VERMILION
from foamfit.report.folder import write_columns, write_json
from foamfit.report.readable import readable_unit
from foamfit.report.render import words
from foamfit.report.result_figures import Mapped
from foamfit.report.shown import Result, told
from foamfit.results import flags_of
from foamfit.springs.model import Model
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCHEMA = 1
PANEL = (2.6, 2.2)  # inches
# Colour and dashes of each part of the band; the dashes distinguish them in greyscale.
COLOURS: dict[str, tuple[str, Any]] = {
    "parameters": (BLUE, "-"),
    "scatter": (INSIDE[1], (0, (5, 1.2))),
    "noise": (INSIDE[2], (0, (2.5, 1.2))),
    "motion": (VERMILION, (0, (1, 1.2))),
    "law_error": (INSIDE[0], (0, (5, 1.2, 1, 1.2))),
}
TOLD: Any = FITTED | {"label": "predicted"}
BAND: Any = {"color": VERMILION, "alpha": 0.18, "linewidth": 0.0, "label": "95 % band"}


@dataclass(frozen=True, eq=False)
class PredictedCurve:
    """A curve of a test with its 95 % band, one row per sample, in Pa or m.

    `parts` contains the half width (n,) of the band due to each source of uncertainty alone.
    """

    channel: str  # "stress", "displacement", "displacement_1", …
    unit: str
    measured: Array
    predicted: Array
    lo: Array
    hi: Array
    parts: dict[str, Array]
    kept: NDArray[np.bool_]  # Samples that count: measured ones that are not outliers

    @property
    def range(self) -> float:
        """Range of the measured values."""
        return float(np.ptp(self.measured))

    def met(self, part: slice) -> tuple[float, float]:
        """Return misfit over the range, and fraction inside the band, of a part of the samples."""
        kept, measured = self.kept[part], self.measured[part]
        residual = (self.predicted[part] - measured)[kept]
        within = (self.lo[part] <= measured) & (measured <= self.hi[part])
        misfit = np.sqrt(np.mean(residual**2)) / np.ptp(measured[kept])
        return float(misfit), float(np.mean(within[kept]))

    @property
    def inside(self) -> float:
        """Fraction of the samples inside the band."""
        return self.met(slice(None))[1]

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
class Prediction(Result):
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
    sentences: tuple[str, ...]
    warnings: tuple[str, ...]
    #: Unknowns of the record (contact time, zeros, striker, time shift), fitted to it with the
    #: predicted springs; parameters that vary between specimens are free in this fit. Values count
    #: from the origins of the file.
    aligned: dict[str, float] = field(default_factory=dict)

    _replaces = "prediction.json"  # a result of another kind may be its source

    def _shown(self, *, html: bool = False) -> str:
        """Return the sentences on the prediction."""
        return told(f"{self.measurement.name} predicted from {self.source}", self.sentences, html)

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints, with half widths relative to the range."""
        every = self.curves.values()
        parts = [part for part in COLOURS if any(part in one.parts for one in every)]
        return words("prediction", found=self, parts=parts)

    def write(
        self, folder: Path, *, pages: bool = True, width: str = TWO, mapped: Mapped = map
    ) -> None:
        """Write ``prediction.json``, ``.csv``, ``.png`` and ``.pdf`` into an existing folder."""
        write_json(folder / "prediction.json", self.to_json_dict())
        write_columns(folder / "prediction.csv", self.columns)
        if pages:
            figures.write_both(plot_prediction(self, width=width), folder / "prediction")

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.model, self.relaxation)

    @property
    def inside(self) -> dict[str, float]:
        """Fraction of the samples of each curve inside its 95 % band."""
        return {name: curve.inside for name, curve in self.curves.items()}

    @property
    def by_cycle(self) -> dict[int, dict[str, float]]:
        """Misfit over the range, and fraction inside the band, of each of several cycles.

        The curve is the stress if the motion is prescribed, otherwise the first curve.
        """
        curve = self.curves.get("stress_time", next(iter(self.curves.values())))
        each = {n: curve.met(part) for n, part in cycles_of(self.measurement).items()}
        return {n: {"misfit": misfit, "inside": inside} for n, (misfit, inside) in each.items()}

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
        content = {"schema": SCHEMA, "foamfit": version("foamfit"), "test": m.name}
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
    """Draw the loop, each curve with its band, and the parts of the band.

    Above are the loop and each curve over time, below the half width due to each part alone.
    `width` is "one" or "two" columns, or a length such as "85 mm"; panels that do not fit side by
    side are stacked.
    """
    curves = list(found.curves.values())
    wide = min(figures.inches(width), PANEL[0] * (1 + len(curves)))
    across = figures.abreast(wide, 1 + len(curves))
    bands = -(-(1 + len(curves)) // across)  # each has an upper and a lower row of panels
    inside = ", ".join(f"{c.channel} {percent(c.inside, 3)}" for c in curves)
    title = figures.title(
        width,
        f"{found.measurement.name}, predicted from {found.source}; {words('rates', found=found)}",
        f"inside the 95 % band: {inside}",
    )
    with figures.drawing(wide, bands * 1.7 * PANEL[1] + 0.1, *title) as figure:
        grid = {"hspace": 0.06, "height_ratios": (1.0, 0.6) * bands}
        axes = figure.subplots(2 * bands, across, squeeze=False, gridspec_kw=grid)
        loop, *above = axes[::2].ravel()
        key, *below = axes[1::2].ravel()
        _loop(loop, found)
        for upper, lower, curve in zip(above, below, curves, strict=False):
            _in_time(upper, lower, found, curve)
        for ax in (key, *above[len(curves) :], *below[len(curves) :]):
            ax.set_axis_off()
        entries = figures.named_in(figure.axes)
        key.legend(entries.values(), entries, loc="upper left", fontsize=7, borderaxespad=0.0)
        figure.align_ylabels()
    return figure


def _loop(ax: Axes, found: Prediction) -> None:
    """Draw the loop; with the band of the stress if the motion is prescribed."""
    m, predicted = found.measurement, {c.channel: c for c in found.curves.values()}
    stress, moved = predicted.get("stress"), predicted.get("displacement")
    motion = m.displacement if moved is None else moved.predicted
    if m.displacement is None or motion is None or m.stress is None:
        figures.say_nothing_there(ax, "no motion")
        return
    height = m.specimen.height
    factor, unit = readable_unit(float(np.max(m.stress)), "Pa")
    ax.plot(m.displacement / height, m.stress / factor, **SEEN)
    ax.plot(motion / height, (m.stress if stress is None else stress.predicted) / factor, **TOLD)
    if stress is not None and moved is None:
        turn = int(np.argmax(motion))
        for part in (slice(None, turn + 1), slice(turn, None)):
            ends = stress.lo[part] / factor, stress.hi[part] / factor
            ax.fill_between(motion[part] / height, *ends, **BAND)
    ax.set(xlabel="strain", ylabel=f"stress ({unit})")


def _in_time(above: Axes, below: Axes, found: Prediction, curve: PredictedCurve) -> None:
    """Draw a curve with its band, and the half width of each part below."""
    x, x_label = np.arange(curve.measured.size, dtype=float), "sample"
    if (time := found.measurement.time) is not None:
        scale, unit = readable_unit(float(np.nanmax(np.abs(time))), "s")
        x, x_label = time / scale, f"time ({unit})"
    factor, unit = readable_unit(float(np.max(np.abs(curve.measured))), curve.unit)
    above.fill_between(x, curve.lo / factor, curve.hi / factor, **BAND)
    above.plot(x, curve.measured / factor, **SEEN)
    above.plot(x, curve.predicted / factor, **TOLD)
    above.set(xlabel=x_label, ylabel=f"{curve.channel.replace('_', ' ')} ({unit})")
    parts = {"all": (0.5 * (curve.hi - curve.lo), "black", ":")}
    for part, look in COLOURS.items():
        if part in curve.parts and np.any(curve.parts[part]):
            parts[part.replace("_", " ")] = (curve.parts[part], *look)
    for part, (half, colour, dashes) in parts.items():
        style: Any = {"color": colour, "ls": dashes, "lw": 0.9, "label": f"half width: {part}"}
        below.plot(x, half / factor, **style)
    below.set_ylim(bottom=0.0)
    below.set(xlabel=x_label, ylabel=f"half width ({unit})")
