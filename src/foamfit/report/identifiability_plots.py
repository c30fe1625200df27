"""Figures of what a test determines: sensitivities, correlation, profiles, uncertainty budget."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, INSIDE, TWO, VERMILION, name_cells
from foamfit.report.readable import readable_unit
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase
    from matplotlib.image import AxesImage

    from foamfit.fitting.branches import Section
    from foamfit.results import Budget, Fit, ParameterEstimate, Profile
    from foamfit.trust.identifiability import Insight

# Shades of the branches of one spring; alternating shades for several springs.
SHADES = {"a": "#eef3f7", "d": "#fbeedd", "c": "#e6ddd5", "e": "#e3f1ea"}
SHADES |= {"snap-through": "#fbeedd", "held": "#e6ddd5", "snap-back": "#e3f1ea"}
OTHERS = ("#f3f3f3", "#e4e4e4")
STRIP, LOW_STRIP = 0.4, 0.28  # height of a strip, and where panels stand above others, in
CELL = 0.24  # height of a cell, in
SIDE_BY_SIDE = 5.0  # in, from which on two matrices stand side by side
ROW = 0.2  # height of a bar with its gap, in
# Colour and hatching of each source: what is fitted is plain, what the TOML states is hatched.
LOOKS = {
    "noise": ("#0B2F4F", ""),
    "contact and zero": ("#D55E00", ""),
    "velocity": ("#9AD0F5", ""),
    "mass": ("#5B2C6F", "////"),
    "height": ("#008F6B", "////"),
    "area": ("#E69F00", "////"),
    "calibration": ("#F5E9B8", "////"),
    "law": ("#BDBDBD", "...."),
}


def plot_insight(
    insight: Insight,
    correlation: Array | None = None,
    title: str = "",
    path: str | Path | None = None,
    *,
    width: str = TWO,
) -> Figure:
    """Draw the sensitivity of each curve to each parameter, what fixes it, and the correlation.

    Above, a row has one scale, its largest value, in standard deviations of the noise per 1 % of
    the parameter's scale. `correlation` is (k, k), where it is better known than from `insight`.
    For `path` and `width` see `plots.plot_fit`.
    """
    wide = figures.inches(width)
    rows = -(-len(insight.curves) // figures.abreast(wide, len(insight.curves)))
    heights = [
        rows * (0.75 + (STRIP if rows == 1 else LOW_STRIP) * len(insight.names)),
        (1.15 + CELL * len(insight.names)) * (1 if wide >= SIDE_BY_SIDE else 2),
    ]
    title = textwrap.fill(title, int(12 * wide))
    more = 0.15 * (title.count("\n") + 2) * bool(title)
    with figures.drawing(wide, sum(heights) + more) as figure:
        if title:
            style: Any = {"fontsize": 8.5, "weight": "bold", "parse_math": False}
            figure.suptitle(title, x=0.012, ha="left", **style)
        halves = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)[:, 0]
        _draw_sensitivities(halves[0], insight, wide)
        _draw_information(halves[1], insight, correlation, wide)
    return figures.save(figure, path, table=True)


def plot_profiles(result: Fit, path: str | Path | None = None) -> Figure:
    """Draw the profile of each parameter that was followed, with its 95 % cut and its interval.

    Four panels a row; dashed is the parabola of the local covariance.
    """
    profiles = result.intervals.profiles if result.intervals is not None else ()
    rows = max(-(-len(profiles) // 4), 1)
    with figures.drawing(7.0, 0.35 + 1.55 * rows) as figure:
        axes = figure.subplots(rows, 4, squeeze=False, sharey=True).ravel()
        for ax in axes[len(profiles) :]:
            ax.set_axis_off()
        for at, (ax, profile) in enumerate(zip(axes, profiles, strict=False)):
            _draw_profile(ax, profile, result.parameters[profile.name])
            ax.set_ylabel("rise of χ²", visible=at % 4 == 0)
            ax.set_label(profile.name)
        if not profiles:
            figures.say_nothing_there(axes[0])
    return figures.save(figure, path, table=True)


def _draw_profile(ax: Axes, profile: Profile, estimate: ParameterEstimate) -> None:
    """One profile, its cut, its interval, and the parabola of the standard error."""
    factor, unit = readable_unit(float(np.max(np.abs(profile.values))), estimate.unit)
    top = 2.0 * profile.cut
    x = profile.values / factor
    ax.axhline(profile.cut, color=GREY, lw=0.6, ls=(0, (2, 2)), label="_95 % cut")
    ax.axvspan(*(end / factor for end in profile.ci95), color="0.92", lw=0, label="_95 % interval")
    fine = np.linspace(x.min(), x.max(), 200)
    if estimate.stderr:
        parabola = ((fine * factor - estimate.value) / estimate.stderr) ** 2
        below = np.where(parabola <= top, parabola, np.nan)
        ax.plot(fine, below, color=GREY, lw=0.8, ls="--", label="_local covariance")
    root = np.sign(profile.values - estimate.value) * np.sqrt(np.maximum(profile.rises, 0.0))
    ax.plot(fine, np.interp(fine, x, root) ** 2, color=BLUE, lw=1.1, label="_profile, between")
    ax.plot(x, profile.rises, "o", color=BLUE, ms=2.2, label="_profile")
    ax.plot(estimate.value / factor, 0.0, "o", color=VERMILION, ms=3.5, label="_best fit")
    ax.set_ylim(-0.04 * top, top)
    ax.locator_params(axis="x", nbins=4)
    name = f"{profile.name} ({unit})" if unit else profile.name
    ax.set_xlabel(name if profile.complete else f"{name}, stopped", labelpad=1)


# ---------------------------------------------------------------- sensitivities


def _draw_sensitivities(figure: FigureBase, insight: Insight, width: float) -> None:
    """Draw all rows of a curve in one panel; separate panels would take seconds to lay out."""
    from matplotlib.transforms import Affine2D

    k, n = len(insight.names), len(insight.curves)
    across = figures.abreast(width, n)
    axes = figure.subplots(-(-n // across), across, sharey=True, squeeze=False).ravel()
    for ax in axes[n:]:
        ax.set_axis_off()
    factor, unit = readable_unit(float(insight.clock[-1]), "s") if insight.timed else (1.0, "")
    x = insight.clock / factor
    rows = {
        name: [0.01 * insight.along(name, curve) for curve in insight.curves]
        for name in insight.names
    }
    reach = {name: max(float(np.max(np.abs(row))) for row in rows[name]) for name in rows}
    for j, (ax, curve) in enumerate(zip(axes, insight.curves, strict=False)):
        _shade(ax, x, insight.sections)
        for i, name in enumerate(insight.names):
            ax.axhline(i, color=GREY, lw=0.5)
            # The numbers of the row, shifted to its place.
            moved = Affine2D().scale(1.0, -0.44 / (reach[name] or 1.0)).translate(0.0, i)
            style: Any = {"color": _color(curve), "lw": 1.0, "transform": moved + ax.transData}
            ax.plot(x, rows[name][j], label=f"_{name}", **style)
        for i in range(1, k):
            ax.axhline(i - 0.5, color="white", lw=1.6, zorder=1)
        ax.set_xlim(x[0], x[-1])
        ax.set_ylim(k - 0.5, -0.5)
        ax.set_title(curve.replace("_", "-"), loc="left", fontsize=7.5, pad=11)
        ax.set_xlabel(f"time ({unit})" if unit else "sample")
        ax.set_ylabel("noise s.d. per 1 %", visible=False)
        _without_left_edge(ax)
    axes[0].set_yticks(range(k), [f"{name}\n±{reach[name]:.2g}" for name in insight.names])
    figure.supylabel("noise s.d. per 1 % of the parameter", fontsize=6.5)


def _shade(ax: Axes, x: Array, cuts: tuple[Section, ...]) -> None:
    """Shade the branches, and write their names above where there is room."""
    for turn, cut in enumerate(without_shakes(cuts, x.size)):
        left, right = x[cut.start], x[min(cut.stop, x.size - 1)]
        flies = " " in cut.branches
        shade = SHADES.get(cut.branches, "white" if flies else OTHERS[turn % 2])
        name = "flight" if flies else cut.branches
        ax.axvspan(left, right, color=shade, lw=0, zorder=0, label=f"_branch {name}")
        if right - left > 0.03 * (x[-1] - x[0]):
            style: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
            style |= {"ha": "center", "va": "bottom", "fontsize": 6.5, "color": GREY}
            ax.annotate(name, (0.5 * (left + right), 1.0), (0, 2), **style)


def without_shakes(cuts: tuple[Section, ...], samples: int) -> list[Section]:
    """Drop sections shorter than a hundredth of the test between two of the same name.

    A shaking measured motion makes a spring leave its branch for a moment.
    """
    out: list[Section] = []
    for i, cut in enumerate(cuts):
        around = {one.branches for one in (*out[-1:], *cuts[i + 1 : i + 2])}
        if out and len(around) == 1 and cut.stop - cut.start < 0.01 * samples:
            cut = replace(cut, branches=out[-1].branches)
        if out and cut.branches == out[-1].branches:
            out[-1] = replace(out[-1], stop=cut.stop)
        else:
            out.append(cut)
    return out


def _color(curve: str) -> str:
    inside = INSIDE[0] if curve.startswith("displacement") else VERMILION
    return BLUE if curve == "displacement_time" else inside


def _without_left_edge(ax: Axes) -> None:
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)


# ---------------------------------------------------------------- information and correlation


def _draw_information(
    figure: FigureBase, insight: Insight, correlation: Array | None, width: float
) -> None:
    """Draw which part of which curve fixes each parameter, and the correlation."""
    parts, shares = insight.shares()
    told = [c for c in range(len(parts)) if np.nanmax(shares[:, c], initial=0.0) > 0.005]
    parts, shares = tuple(parts[c] for c in told), shares[:, told]
    k = len(insight.names)
    if width >= SIDE_BY_SIDE:
        left, right = figure.subplots(1, 2, width_ratios=[max(len(parts) + 1.0, 0.6 * k), k])
    else:
        left, right = figure.subplots(2, 1)
    picture = _cells(left, 100.0 * shares, "Blues", (0.0, 130.0), "{:.0f}")
    name_cells(picture, insight.names, [f"{curve}: {branch}" for curve, branch in parts])
    left.set_title("where the information comes from (%)", loc="left", fontsize=7.5, pad=4)
    left.set_yticks(range(k), insight.names)
    labels = ["flight" if " " in branch else branch for _, branch in parts]
    longest = max(map(len, labels), default=0)
    left.set_xticks(range(len(parts)), labels, rotation=90 if longest > 6 else 0)
    beneath = -16.0 if longest <= 6 else -4.0 - 4.0 * longest
    style: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
    style |= {"ha": "center", "va": "top", "fontsize": 7, "annotation_clip": False}
    for curve in dict.fromkeys(curve for curve, _ in parts):
        at = [c for c, part in enumerate(parts) if part[0] == curve]
        if at[0]:
            left.axvline(at[0] - 0.5, color="black", lw=0.8)
        place = float(np.mean(at)), 0.0
        name = curve.replace("_", "-")
        left.annotate(name, place, (0, beneath), color=_color(curve), **style)
    matrix = insight.correlation if correlation is None else correlation
    below = np.where(np.tri(k, dtype=bool), matrix, np.nan)
    picture = _cells(right, below, "RdBu_r", (-1.4, 1.4), "{:.2f}")
    name_cells(picture, insight.names, insight.names)
    right.set_title("correlation of the estimates", loc="left", fontsize=7.5, pad=4)
    right.set_xticks(range(k), insight.names, rotation=90)
    beside = width >= SIDE_BY_SIDE  # then the names stand on the left
    right.set_yticks([] if beside else range(k), [] if beside else insight.names)


def _cells(
    ax: Axes, values: Array, colors: str, limits: tuple[float, float], form: str
) -> AxesImage:
    """Draw a matrix as shaded cells with their numbers; NaN is left blank."""
    picture = ax.imshow(values, cmap=colors, vmin=limits[0], vmax=limits[1], aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            shown = form.format(value).replace("-", "−").replace("0.", ".")
            shown = {"−.00": "0", ".00": "0", "1.00": "1", "−0": "0", "0": ""}.get(shown, shown)
            color = "white" if abs(value) > 0.6 * limits[1] else "black"
            text = ax.text(j, i, shown, ha="center", va="center", fontsize=5.5, color=color)
            text.set_in_layout(False)  # inside its cell; measuring is slow
    ax.tick_params(length=0, labelsize=6.5)
    ax.spines[:].set_visible(False)
    return picture


# ---------------------------------------------------------------- uncertainty budget


def plot_budget(budget: Budget, *, width: str = TWO) -> Figure:
    """Draw the share of each source in the variance of each parameter, and the combined error.

    The combined standard deviation, on the right, is in percent of the scale of the parameter.
    """
    names, wide = list(budget.contributions), figures.inches(width)
    combined = np.array([budget.combined(name) for name in names])
    totals = 100.0 * combined / [budget.scales[name] for name in names]
    with figures.drawing(wide, 0.9 + ROW * len(names)) as figure:
        shares, right = figure.subplots(1, 2, sharey=True, width_ratios=[3.0, 1.4])
        left, entries = np.zeros(len(names)), dict[str, object]()
        for source in budget.sources:
            colour, hatch = LOOKS[source]
            parts = np.array([budget.contributions[name][source] for name in names])
            share = 100.0 * parts**2 / np.where(combined > 0.0, combined, 1.0) ** 2
            style: Any = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.5}
            entries[source] = shares.barh(range(len(names)), share, 0.72, left, **style)
            left = left + share
        shares.set(xlim=(0.0, 100.0), xlabel="share of the variance (%)")
        _without_left_edge(shares)
        right.barh(range(len(names)), totals, 0.72, color=GREY)
        for i, total in enumerate(totals.tolist()):
            offset: Any = {"textcoords": "offset points", "va": "center", "fontsize": 6.5}
            right.annotate(percent(0.01 * total), (total, i), (3, 0), **offset)
        right.set(xlim=(0.0, 1.5 * totals.max()), xlabel="combined (%)")
        right.locator_params(axis="x", nbins=3)
        right.tick_params(axis="y", length=0)
        shares.set_yticks(range(len(names)), names)
        shares.set_ylim(len(names) - 0.4, -0.6)
        figures.legend_below(figure, entries)
    return figure
