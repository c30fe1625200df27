"""What fixes what, to look at: sensitivities along the curves, information and correlation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foamfit.report.plots import BLUE, GREY, INSIDE, STYLE, VERMILION, save
from foamfit.report.readable import readable_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

    from foamfit.fitting.branches import Section
    from foamfit.trust.identifiability import Insight

Array = NDArray[np.float64]

SHADES = {
    "a": "#eef3f7",
    "d": "#fbeedd",
    "c": "#e6ddd5",
    "e": "#e3f1ea",
}  # of one spring's branches
OTHERS = ("#f3f3f3", "#e4e4e4")  # of several springs' branches, in turn
STRIP = 0.4  # height of a strip, in
CELL = 0.24  # height of a cell, in


def plot_sensitivities(insight: Insight, path: str | Path | None = None) -> Figure:
    """Draw by how much each curve moves with each parameter, along time, over shaded branches.

    Parameters
    ----------
    insight : Insight
        What the test can tell.
    path : str or Path, optional
        Where to save the figure; the suffix gives the format.

    Returns
    -------
    matplotlib.figure.Figure
        One row for each parameter, one panel for each counted curve. A row has one scale, its
        largest value, in standard deviations of the noise per 1 % of the scale.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, strips_height(insight)), layout="constrained")
        draw_sensitivities(figure, insight)
    return save(figure, path)


def plot_information(
    insight: Insight, correlation: Array | None = None, path: str | Path | None = None
) -> Figure:
    """Draw which part of which curve fixes each parameter, and the correlation of the estimates.

    Parameters
    ----------
    insight : Insight
        What the test can tell.
    correlation : (k, k) array, optional
        Of the estimates, where it is better known than from `insight`.
    path : str or Path, optional
        Where to save the figure; the suffix gives the format.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, cells_height(insight)), layout="constrained")
        draw_information(figure, insight, correlation)
    return save(figure, path)


def strips_height(insight: Insight) -> float:
    """Height of the strips, inches."""
    return 0.75 + STRIP * len(insight.names)


def cells_height(insight: Insight) -> float:
    """Height of the matrices, inches."""
    return 1.15 + CELL * len(insight.names)


# ---------------------------------------------------------------- sensitivities


def draw_sensitivities(figure: FigureBase, insight: Insight) -> None:
    """Set all rows of a curve in one panel: as panels of their own they take seconds to lay out."""
    k = len(insight.names)
    axes = figure.subplots(1, len(insight.curves), sharey=True, squeeze=False)[0]
    factor, unit = readable_unit(float(insight.clock[-1]), "s") if insight.timed else (1.0, "")
    x = insight.clock / factor
    rows = {
        name: [0.01 * insight.along(name, curve) for curve in insight.curves]
        for name in insight.names
    }
    reach = {name: max(float(np.max(np.abs(row))) for row in rows[name]) for name in rows}
    for j, (ax, curve) in enumerate(zip(axes, insight.curves, strict=True)):
        _shade(ax, x, insight.sections)
        for i, name in enumerate(insight.names):
            ax.axhline(i, color=GREY, lw=0.5)
            ax.plot(x, i - 0.44 * rows[name][j] / (reach[name] or 1.0), color=_color(curve), lw=1.0)
        for i in range(1, k):
            ax.axhline(i - 0.5, color="white", lw=1.6, zorder=1)
        ax.set_xlim(x[0], x[-1])
        ax.set_ylim(k - 0.5, -0.5)
        ax.set_title(curve.replace("_", "-"), loc="left", fontsize=7.5, pad=11)
        ax.set_xlabel(f"time ({unit})" if unit else "sample")
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
    axes[0].set_yticks(range(k), [f"{name}\n±{reach[name]:.2g}" for name in insight.names])
    figure.supylabel("noise s.d. per 1 % of the parameter", fontsize=6.5)


def _shade(ax: Axes, x: Array, cuts: tuple[Section, ...]) -> None:
    last = x.size - 1
    for turn, cut in enumerate(cuts):
        left, right = x[cut.start], x[min(cut.stop, last)]
        shade = SHADES.get(cut.branches, "white" if " " in cut.branches else OTHERS[turn % 2])
        ax.axvspan(left, right, color=shade, lw=0, zorder=0)
        if right - left > 0.03 * (x[-1] - x[0]):
            ax.annotate(
                "flight" if " " in cut.branches else cut.branches, (0.5 * (left + right), 1.0),
                (0, 2), xycoords=("data", "axes fraction"), textcoords="offset points",
                ha="center", va="bottom", fontsize=6.5, color=GREY,
            )  # fmt: skip


def _color(curve: str) -> str:
    if curve == "displacement_time":
        return BLUE
    return INSIDE[0] if curve.startswith("displacement") else VERMILION


# ---------------------------------------------------------------- information and correlation


def draw_information(figure: FigureBase, insight: Insight, correlation: Array | None) -> None:
    """Draw what `plot_information` shows into a figure or a part of one."""
    parts, shares = insight.shares()
    told = [c for c in range(len(parts)) if np.nanmax(shares[:, c], initial=0.0) > 0.005]
    parts, shares = tuple(parts[c] for c in told), shares[:, told]
    k = len(insight.names)
    left, right = figure.subplots(1, 2, width_ratios=[len(parts) + 1.0, k])
    _cells(left, 100.0 * shares, "Blues", (0.0, 130.0), "{:.0f}")
    left.set_title("where the information comes from (%)", loc="left", fontsize=7.5, pad=4)
    left.set_yticks(range(k), insight.names)
    labels = ["flight" if " " in branch else branch for _, branch in parts]
    left.set_xticks(range(len(parts)), labels, rotation=90 if max(map(len, labels)) > 6 else 0)
    for curve in dict.fromkeys(curve for curve, _ in parts):
        at = [c for c, part in enumerate(parts) if part[0] == curve]
        if at[0]:
            left.axvline(at[0] - 0.5, color="black", lw=0.8)
        beneath = -16 if max(map(len, labels)) <= 6 else -4.0 - 4.0 * max(map(len, labels))
        left.annotate(
            curve.replace("_", "-"), (float(np.mean(at)), 0.0), (0, beneath),
            xycoords=("data", "axes fraction"), textcoords="offset points", ha="center", va="top",
            fontsize=7, color=_color(curve), annotation_clip=False,
        )  # fmt: skip
    matrix = insight.correlation if correlation is None else correlation
    below = np.where(np.tri(k, dtype=bool), matrix, np.nan)
    _cells(right, below, "RdBu_r", (-1.4, 1.4), "{:.2f}")
    right.set_title("correlation of the estimates", loc="left", fontsize=7.5, pad=4)
    right.set_xticks(range(k), insight.names, rotation=90)
    right.set_yticks([])


def _cells(ax: Axes, values: Array, colors: str, limits: tuple[float, float], form: str) -> None:
    """Draw a matrix as shaded cells with their numbers; NaN is left blank."""
    ax.imshow(values, cmap=colors, vmin=limits[0], vmax=limits[1], aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            shown = form.format(value).replace("-", "−").replace("0.", ".")
            dark = abs(value) > 0.6 * limits[1]
            text = ax.text(
                j, i, _short(shown), ha="center", va="center", fontsize=5.5,
                color="white" if dark else "black",
            )  # fmt: skip
            text.set_in_layout(False)  # inside its cell anyway; to measure each takes long
    style: dict[str, Any] = {"length": 0, "labelsize": 6.5}
    ax.tick_params(**style)
    for spine in ax.spines.values():
        spine.set_visible(False)


def _short(text: str) -> str:
    return {"−.00": "0", ".00": "0", "1.00": "1", "−0": "0", "0": ""}.get(text, text)
