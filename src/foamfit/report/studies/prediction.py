"""The folder of a prediction, its text and its picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.errors import InputError
from foamfit.report.figures import (
    BLUE,
    INSIDE,
    TWO,
    VERMILION,
    abreast,
    drawing,
    image,
    inches,
    laid_out,
)
from foamfit.report.folder import (
    PREDICTION_FILES,
    check_target,
    save_whole,
    write_json,
    write_table,
)
from foamfit.report.readable import readable_unit
from foamfit.text import aligned, percent, wrapped

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


def save_prediction(
    found: PredictedTest, folder: str | Path, *, report: bool = True, width: str = TWO
) -> Path:
    """Write the folder whole, replacing an older prediction at the end; returns it.

    Without `report` there is no figure; for its `width` see `plot_prediction`.
    """

    def write(fresh: Path) -> None:
        write_json(fresh / "prediction.json", found.to_json_dict())
        write_table(fresh / "prediction.csv", found.rows())
        if not report:
            return
        figure = plot_prediction(found, width=width)
        with laid_out(figure):
            (fresh / "prediction.png").write_bytes(image(figure, "png"))
            (fresh / "prediction.pdf").write_bytes(image(figure, "pdf"))

    check_replaceable(folder)
    return save_whole(folder, write)


def check_replaceable(folder: str | Path) -> None:
    """Raise InputError unless `folder` is free, empty or an older prediction.

    A result of another kind is not replaced: it may be the one that is predicted from.
    """
    check_target(folder)
    place = Path(folder)
    there = sorted(path.name for path in place.iterdir()) if place.is_dir() else []
    if others := [name for name in there if name not in PREDICTION_FILES]:
        raise InputError(
            f"{folder} holds {others[0]}, which is no part of a prediction, so it is not replaced; "
            "choose a new or an empty folder"
        )


# ------------------------------------------------------------------------------- in words


def prediction_text(found: PredictedTest) -> str:
    """Return what the command prints of a prediction."""
    kind = "joint fit" if found.joint else "fit"
    lines = wrapped(f"{found.measurement.name}: predicted from the {kind} {found.source!r}")
    lines += wrapped(f"{found.law}, {found.drive} drive; {_rates(found)}")
    lines += ["", *_table(found)]
    for sentence in (*found.sentences, *(f"Warning: {one}" for one in found.warnings)):
        lines += ["", *wrapped(sentence)]
    return "\n".join(lines)


def _rates(found: PredictedTest) -> str:
    rates = found.fitted_rates
    if found.rate is None:
        return "rate not known"
    if not rates:
        return f"rate {found.rate:.3g} 1/s"
    low, high = min(rates), max(rates)
    fitted = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
    return f"rate {found.rate:.3g} 1/s, fitted at {fitted} 1/s"


def _table(found: PredictedTest) -> list[str]:
    """Misfit, share inside and half widths of each curve, over its measured range."""
    there = [part for part in COLOURS if any(part in one.parts for one in found.curves.values())]
    rows = [["curve", "misfit", "inside", "band", *(part.replace("_", " ") for part in there)]]
    for name, curve in found.curves.items():
        off = found.misfit.get(name)
        widths = [curve.half_width, *(curve.half_width_of(part) for part in there)]
        rows.append(
            [
                name,
                "–" if off is None else percent(off),
                percent(curve.inside, 3),
                *(f"±{percent(width / curve.range)}" for width in widths),
            ]
        )
    return aligned(rows)


# ------------------------------------------------------------------------------- the picture


def plot_prediction(found: PredictedTest, *, width: str = TWO) -> Figure:
    """Draw each curve with its band, the loop, and what makes the band.

    Above are the loop and each curve in time, below the half width that each part alone would give.
    `width` is "one" or "two" columns, or a length such as "85 mm"; what has no room beside the
    others stands below them.
    """
    curves = list(found.curves.values())
    wide = min(inches(width), PANEL[0] * (1 + len(curves)))
    across = abreast(wide, 1 + len(curves))
    bands = -(-(1 + len(curves)) // across)  # each a row of panels with a lower one beneath
    lines = [line for part in _title(found) for line in wrapped(part, 0, int(16 * wide))]
    tall = bands * 1.7 * PANEL[1] + 0.4 + 0.15 * max(len(lines) - 2, 0)
    with drawing(wide, tall) as figure:
        axes = figure.subplots(
            2 * bands, across, squeeze=False, height_ratios=(1.0, 0.6) * bands,
            gridspec_kw={"hspace": 0.06},
        )  # fmt: skip
        places = [(2 * (i // across), i % across) for i in range(bands * across)]
        _loop(axes[places[0]], found)
        for (row, column), curve in zip(places[1:], curves, strict=False):
            _in_time(axes[row, column], axes[row + 1, column], found, curve)
        for row, column in places[1 + len(curves) :]:
            axes[row, column].set_axis_off()
            axes[row + 1, column].set_axis_off()
        _legend(axes[1, 0], found)
        figure.suptitle("\n".join(lines), x=0.01, ha="left", fontsize=8, parse_math=False)
        figure.align_ylabels()
    return figure


def _title(found: PredictedTest) -> tuple[str, str]:
    inside = ", ".join(f"{c.channel} {percent(c.inside, 3)}" for c in found.curves.values())
    return (
        f"{found.measurement.name}, predicted from {found.source}; {_rates(found)}",
        f"inside the 95 % band: {inside}",
    )


def _loop(ax: Axes, found: PredictedTest) -> None:
    """Stress against displacement; with the band of the stress where the motion is measured."""
    m = found.measurement
    stress = next((c for c in found.curves.values() if c.channel == "stress"), None)
    moved = next((c for c in found.curves.values() if c.channel == "displacement"), None)
    motion = m.displacement if moved is None else moved.predicted
    if m.displacement is None or motion is None or m.stress is None:
        ax.set_axis_off()
        ax.text(0.5, 0.5, "no motion", ha="center", va="center", transform=ax.transAxes)
        return
    pressed = m.stress if stress is None else stress.predicted
    height = m.specimen.height
    factor, unit = readable_unit(float(np.max(m.stress)), "Pa")
    ax.plot(m.displacement / height, m.stress / factor, color=MEASURED, linewidth=1.4)
    ax.plot(motion / height, pressed / factor, color=VERMILION, linewidth=0.9)
    if stress is not None and moved is None:
        turn = int(np.argmax(motion))
        for part in (slice(None, turn + 1), slice(turn, None)):
            _band(ax, motion[part] / height, stress, factor, part)
    ax.set_xlabel("strain")
    ax.set_ylabel(f"stress ({unit})")


def _band(ax: Axes, x: Array, curve: PredictedCurve, factor: float, part: slice) -> None:
    ax.fill_between(
        x, curve.lo[part] / factor, curve.hi[part] / factor, color=VERMILION, alpha=0.18,
        linewidth=0.0,
    )  # fmt: skip


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
    above.plot(x, curve.measured / factor, color=MEASURED, linewidth=1.4)
    above.plot(x, curve.predicted / factor, color=VERMILION, linewidth=0.9)
    above.set_ylabel(f"{curve.channel.replace('_', ' ')} ({unit})")
    for part, (colour, dashes) in COLOURS.items():
        if part in curve.parts and np.any(curve.parts[part]):
            style: Any = {"color": colour, "linestyle": dashes, "linewidth": 0.9}
            below.plot(x, curve.parts[part] / factor, **style)
    below.plot(x, 0.5 * (curve.hi - curve.lo) / factor, ":", color="black", linewidth=0.9)
    below.set_ylim(bottom=0.0)
    below.set_ylabel(f"half width ({unit})")
    below.set_xlabel(label)


def _legend(ax: Axes, found: PredictedTest) -> None:
    """What the lines are, in a panel of their own."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ax.set_axis_off()
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=MEASURED, linewidth=1.4, label="measured"),
        Line2D([], [], color=VERMILION, label="predicted"),
        Patch(color=VERMILION, alpha=0.18, label="95 % band"),
        Line2D([], [], color="black", linestyle=":", label="half width: all"),
    ]
    for part, (colour, dashes) in COLOURS.items():
        if any(np.any(curve.parts.get(part, 0.0)) for curve in found.curves.values()):
            handles.append(
                Line2D(
                    [],
                    [],
                    color=colour,
                    linestyle=dashes,
                    label=f"half width: {part.replace('_', ' ')}",
                )
            )
    ax.legend(handles=handles, loc="upper left", fontsize=7, borderaxespad=0.0)
