"""The folder of a prediction, its text and its picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.errors import InputError
from foamfit.report import figures
from foamfit.report import folder as results
from foamfit.report.figures import BLUE, INSIDE, TWO, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.report.render import words
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.arrays import Array
    from foamfit.study.prediction.predicted import PredictedCurve, PredictedTest

PANEL = (2.6, 2.2)  # inches
MEASURED = "0.65"  # wide and light below what is predicted, which is darker in grey too
# Colour of each part of the band, and its dashes, for who sees or prints grey.
COLOURS: dict[str, tuple[str, Any]] = {
    "parameters": (BLUE, "-"),
    "scatter": (INSIDE[1], (0, (5, 1.2))),
    "noise": (INSIDE[2], (0, (2.5, 1.2))),
    "motion": (VERMILION, (0, (1, 1.2))),
    "law_error": (INSIDE[0], (0, (5, 1.2, 1, 1.2))),
}
# Styles of the lines and of the band.
LINES: dict[str, dict[str, Any]] = {
    "measured": {"color": MEASURED, "linewidth": 1.4},
    "predicted": {"color": VERMILION, "linewidth": 0.9},
    "half width: all": {"color": "black", "linestyle": ":", "linewidth": 0.9},
}
BAND: Any = {"color": VERMILION, "alpha": 0.18, "linewidth": 0.0}


def save_prediction(
    found: PredictedTest, folder: str | Path, *, report: bool = True, width: str = TWO
) -> Path:
    """Write the folder whole, replacing an older prediction at the end; returns it.

    Without `report` there is no figure; for its `width` see `plot_prediction`.
    """

    def write(fresh: Path) -> None:
        results.write_json(fresh / "prediction.json", found.to_json_dict())
        results.write_table(fresh / "prediction.csv", found.rows())
        if not report:
            return
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
    if others := [name for name in there if name not in results.PREDICTION_FILES]:
        raise InputError(
            f"{folder} holds {others[0]}, which is no part of a prediction, so it is not replaced; "
            "choose a new or an empty folder"
        )


def prediction_text(found: PredictedTest) -> str:
    """Return what the command prints of a prediction.

    Its table has misfit, share inside and half widths of each curve, over its measured range.
    """
    there = [part for part in COLOURS if any(part in one.parts for one in found.curves.values())]
    rows = [["curve", "misfit", "inside", "band", *(part.replace("_", " ") for part in there)]]
    for name, curve in found.curves.items():
        off = found.misfit.get(name)
        shown = ["–" if off is None else percent(off), percent(curve.inside, 3)]
        widths = [curve.half_width, *map(curve.half_width_of, there)]
        rows.append([name, *shown, *(f"±{percent(width / curve.range)}" for width in widths)])
    source, rates = repr(found.source), _rates(found)
    return words("prediction", found=found, source=source, rates=rates, table=rows)


def _rates(found: PredictedTest) -> str:
    rates = found.fitted_rates
    if found.rate is None:
        return "rate not known"
    ends = dict.fromkeys(f"{choose(rates):.3g}" for choose in (min, max)) if rates else ()
    fitted = f", fitted at {' to '.join(ends)} 1/s" if ends else ""
    return f"rate {found.rate:.3g} 1/s{fitted}"


def plot_prediction(found: PredictedTest, *, width: str = TWO) -> Figure:
    """Draw each curve with its band, the loop, and what makes the band.

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
        f"{found.measurement.name}, predicted from {found.source}; {_rates(found)}",
        f"inside the 95 % band: {inside}",
        titled=figures.is_titled(width),
    )
    tall = bands * 1.7 * PANEL[1] + 0.4 + 0.15 * max(len(lines) - 2, 0)
    with figures.drawing(wide, tall, lines) as figure:
        grid = {"hspace": 0.06, "height_ratios": (1.0, 0.6) * bands}
        axes = figure.subplots(2 * bands, across, squeeze=False, gridspec_kw=grid)
        # Each place has a panel above and one below it.
        places = [axes[i : i + 2, j] for i in range(0, 2 * bands, 2) for j in range(across)]
        _loop(places[0][0], found)
        for (above, below), curve in zip(places[1:], curves, strict=False):
            _in_time(above, below, found, curve)
        for ax in [ax for place in places[1 + len(curves) :] for ax in place]:
            ax.set_axis_off()
        _legend(places[0][1], found)
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
    ax.plot(m.displacement / height, m.stress / factor, **LINES["measured"])
    ax.plot(motion / height, pressed / factor, **LINES["predicted"])
    if stress is not None and moved is None:
        turn = int(np.argmax(motion))
        for part in (slice(None, turn + 1), slice(turn, None)):
            _band(ax, motion[part] / height, stress, factor, part)
    ax.set(xlabel="strain", ylabel=f"stress ({unit})")


def _band(ax: Axes, x: Array, curve: PredictedCurve, factor: float, part: slice) -> None:
    ax.fill_between(x, curve.lo[part] / factor, curve.hi[part] / factor, **BAND)


def _in_time(above: Axes, below: Axes, found: PredictedTest, curve: PredictedCurve) -> None:
    """One curve with its band, and the half width of each part."""
    time = found.measurement.time
    if time is None:
        x, label = np.arange(curve.measured.size, dtype=float), "sample"
    else:
        scale, unit = readable_unit(float(time[-1]), "s")
        x, label = time / scale, f"time ({unit})"
    factor, unit = readable_unit(float(np.max(np.abs(curve.measured))), curve.unit)
    _band(above, x, curve, factor, slice(None))
    above.plot(x, curve.measured / factor, **LINES["measured"])
    above.plot(x, curve.predicted / factor, **LINES["predicted"])
    above.set_ylabel(f"{curve.channel.replace('_', ' ')} ({unit})")
    for part, (colour, dashes) in COLOURS.items():
        if part in curve.parts and np.any(curve.parts[part]):
            style: Any = {"color": colour, "linestyle": dashes, "linewidth": 0.9}
            below.plot(x, curve.parts[part] / factor, **style)
    below.plot(x, 0.5 * (curve.hi - curve.lo) / factor, **LINES["half width: all"])
    below.set_ylim(bottom=0.0)
    below.set(xlabel=label, ylabel=f"half width ({unit})")


def _legend(ax: Axes, found: PredictedTest) -> None:
    """Explain the lines in a panel of its own."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ax.set_axis_off()
    shown = LINES | {
        f"half width: {part.replace('_', ' ')}": {"color": colour, "linestyle": dashes}
        for part, (colour, dashes) in COLOURS.items()
        if any(np.any(curve.parts.get(part, 0.0)) for curve in found.curves.values())
    }
    handles: list[Any] = [Line2D([], [], label=name, **style) for name, style in shown.items()]
    handles.insert(2, Patch(label="95 % band", **BAND))
    ax.legend(handles=handles, loc="upper left", fontsize=7, borderaxespad=0.0)
