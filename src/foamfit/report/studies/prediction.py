"""The folder of a prediction, its text and its picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.errors import InputError
from foamfit.report import figures
from foamfit.report import folder as results
from foamfit.report.figures import BLUE, INSIDE, MEASURED, TWO, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.report.render import words
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.study.prediction.predicted import PredictedCurve, PredictedTest

PANEL = (2.6, 2.2)  # inches
# Colour and dashes of each part of the band; dashes tell them apart in grey.
COLOURS: dict[str, tuple[str, Any]] = {
    "parameters": (BLUE, "-"),
    "scatter": (INSIDE[1], (0, (5, 1.2))),
    "noise": (INSIDE[2], (0, (2.5, 1.2))),
    "motion": (VERMILION, (0, (1, 1.2))),
    "law_error": (INSIDE[0], (0, (5, 1.2, 1, 1.2))),
}
# Styles of the lines and of the band; the key of the figure takes their labels.
SEEN: Any = {"color": MEASURED, "linewidth": 1.4, "label": "measured"}
PREDICTED: Any = {"color": VERMILION, "linewidth": 0.9, "label": "predicted"}
BAND: Any = {"color": VERMILION, "alpha": 0.18, "linewidth": 0.0, "label": "95 % band"}


def save_prediction(
    found: PredictedTest, folder: str | Path, *, report: bool = True, width: str = TWO
) -> Path:
    """Write the folder whole, replacing an older prediction at the end; returns it.

    Without `report` there is no figure; for its `width` see `plot_prediction`.
    """

    def write(fresh: Path) -> None:
        results.write_json(fresh / "prediction.json", found.to_json_dict())
        results.write_table(fresh / "prediction.csv", found.rows())
        if report:
            figures.write_both(plot_prediction(found, width=width), fresh / "prediction")

    check_replaceable(folder)
    return results.save_whole(folder, write)


def check_replaceable(folder: str | Path) -> None:
    """Raise InputError unless `folder` is free, empty or an older prediction.

    A result of another kind is not replaced: it may be the one that is predicted from.
    """
    results.check_target(folder)
    place = Path(folder)
    there = sorted(path.name for path in place.iterdir()) if place.is_dir() else []
    if others := [name for name in there if name not in results.FILES["prediction.json"]]:
        raise InputError(
            f"{folder} holds {others[0]}, which is no part of a prediction, so it is not replaced; "
            "choose a new or an empty folder"
        )


def prediction_text(found: PredictedTest) -> str:
    """Return what the command prints: misfit, share inside and half widths over the range."""
    there = [part for part in COLOURS if any(part in one.parts for one in found.curves.values())]
    return words("prediction", found=found, parts=there)


def plot_prediction(found: PredictedTest, *, width: str = TWO) -> Figure:
    """Draw each curve with its band, the loop, and the parts of the band.

    Above are the loop and each curve in time, below the half width that each part alone would give.
    `width` is "one" or "two" columns, or a length such as "85 mm"; what has no room beside the
    others stands below them.
    """
    curves = list(found.curves.values())
    wide = min(figures.inches(width), PANEL[0] * (1 + len(curves)))
    across = figures.abreast(wide, 1 + len(curves))
    bands = -(-(1 + len(curves)) // across)  # each a row of panels with a lower one beneath
    inside = ", ".join(f"{c.channel} {percent(c.inside, 3)}" for c in curves)
    lines = figures.title_lines(
        wide,
        f"{found.measurement.name}, predicted from {found.source}; {words('rates', found=found)}",
        f"inside the 95 % band: {inside}",
        titled=figures.is_titled(width),
    )
    tall = bands * 1.7 * PANEL[1] + 0.4 + 0.15 * max(len(lines) - 2, 0)
    with figures.drawing(wide, tall, lines) as figure:
        grid = {"hspace": 0.06, "height_ratios": (1.0, 0.6) * bands}
        axes = figure.subplots(2 * bands, across, squeeze=False, gridspec_kw=grid)
        loop, *above = axes[::2].ravel()
        key, *below = axes[1::2].ravel()
        _loop(loop, found)
        for (upper, lower), curve in zip(zip(above, below, strict=True), curves, strict=False):
            _in_time(upper, lower, found, curve)
        for ax in (key, *above[len(curves) :], *below[len(curves) :]):
            ax.set_axis_off()
        told = figures.named_in(figure.axes)
        key.legend(told.values(), told, loc="upper left", fontsize=7, borderaxespad=0.0)
        figure.align_ylabels()
    return figure


def _loop(ax: Axes, found: PredictedTest) -> None:
    """Stress against displacement; with the band of the stress where the motion is measured."""
    m, predicted = found.measurement, {c.channel: c for c in found.curves.values()}
    stress, moved = predicted.get("stress"), predicted.get("displacement")
    motion = m.displacement if moved is None else moved.predicted
    if m.displacement is None or motion is None or m.stress is None:
        figures.say_nothing_there(ax, "no motion")
        return
    pressed = m.stress if stress is None else stress.predicted
    height = m.specimen.height
    factor, unit = readable_unit(float(np.max(m.stress)), "Pa")
    ax.plot(m.displacement / height, m.stress / factor, **SEEN)
    ax.plot(motion / height, pressed / factor, **PREDICTED)
    if stress is not None and moved is None:
        turn = int(np.argmax(motion))
        for part in (slice(None, turn + 1), slice(turn, None)):
            ends = stress.lo[part] / factor, stress.hi[part] / factor
            ax.fill_between(motion[part] / height, *ends, **BAND)
    ax.set(xlabel="strain", ylabel=f"stress ({unit})")


def _in_time(above: Axes, below: Axes, found: PredictedTest, curve: PredictedCurve) -> None:
    """One curve with its band, and the half width of each part."""
    x, label = np.arange(curve.measured.size, dtype=float), "sample"
    if (time := found.measurement.time) is not None:
        scale, unit = readable_unit(float(np.nanmax(np.abs(time))), "s")
        x, label = time / scale, f"time ({unit})"
    factor, unit = readable_unit(float(np.max(np.abs(curve.measured))), curve.unit)
    above.fill_between(x, curve.lo / factor, curve.hi / factor, **BAND)
    above.plot(x, curve.measured / factor, **SEEN)
    above.plot(x, curve.predicted / factor, **PREDICTED)
    above.set_ylabel(f"{curve.channel.replace('_', ' ')} ({unit})")
    style: Any = {"color": "black", "ls": ":", "lw": 0.9, "zorder": 3}
    below.plot(x, 0.5 * (curve.hi - curve.lo) / factor, label="half width: all", **style)
    for part, (colour, dashes) in COLOURS.items():
        if part in curve.parts and np.any(curve.parts[part]):
            style = {"color": colour, "ls": dashes, "lw": 0.9}
            told = f"half width: {part.replace('_', ' ')}"
            below.plot(x, curve.parts[part] / factor, label=told, **style)
    below.set_ylim(bottom=0.0)
    below.set(xlabel=label, ylabel=f"half width ({unit})")
