"""Figures of the report beside the fit: information, correlation, profiles, what has snapped."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, INSIDE, TWO, VERMILION
from foamfit.report.readable import readable_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.results import Fit, ParameterEstimate, Profile
    from foamfit.trust.identifiability import Insight

CELL = 0.24  # height of a cell, in
SIDE_BY_SIDE = 5.0  # in, from which on two matrices stand side by side
INSTANTS = 7  # pictures of a foam
SNAPPED, STANDING = "#7FB2D9", "#E6EEF4"  # shades of a spring


def plot_profiles(result: Fit, path: str | Path | None = None) -> Figure:
    """Draw the profile of each parameter that was followed, with its 95 % cut and its interval.

    Four panels a row; dashed is the parabola of the local covariance.
    """
    profiles = result.intervals.profiles if result.intervals is not None else ()
    rows, count = max(-(-len(profiles) // 4), 1), max(len(profiles), 1)
    with figures.drawing(7.0, 0.55 + 1.55 * rows) as figure:
        axes = figures.grid_of(figure, rows, 4, count, sharey=True)
        for at, (ax, profile) in enumerate(zip(axes, profiles, strict=False)):
            _draw_profile(ax, profile, result.parameters[profile.name])
            ax.set_ylabel("rise of χ²", visible=at % 4 == 0)
            ax.set_label(profile.name)
        if not profiles:
            figures.say_nothing_there(axes[0])
        figures.legend_below(figure, figures.key_of(axes))
    return figures.save(figure, path)


def _draw_profile(ax: Axes, profile: Profile, estimate: ParameterEstimate) -> None:
    """One profile, its cut, its interval, and the parabola of the standard error."""
    factor, unit = readable_unit(float(np.max(np.abs(profile.values))), estimate.unit)
    top = 2.0 * profile.cut
    best = float(profile.values[np.argmin(profile.rises)])  # from the zero of the profile
    x = profile.values / factor
    ax.axhline(profile.cut, color=GREY, lw=0.6, ls=(0, (2, 2)), label="_95 % threshold")
    ax.axvspan(*(end / factor for end in profile.ci95), color="0.92", lw=0, label="_95 % interval")
    fine = np.linspace(x.min(), x.max(), 200)
    if estimate.stderr:
        parabola = ((fine * factor - best) / estimate.stderr) ** 2
        below = np.where(parabola <= top, parabola, np.nan)
        ax.plot(fine, below, color=GREY, lw=0.8, ls="--", label="_local covariance")
    root = np.sign(profile.values - best) * np.sqrt(np.maximum(profile.rises, 0.0))
    style: Any = {"color": BLUE, "lw": 1.1, "label": "_lowest cost, all others refitted"}
    ax.plot(fine, np.interp(fine, x, root) ** 2, **style)
    ax.plot(x, profile.rises, "o", color=BLUE, ms=2.2)
    ax.plot(best / factor, 0.0, "o", color=VERMILION, ms=3.5, label="_best fit")
    ax.set_ylim(-0.04 * top, top)
    ax.locator_params(axis="x", nbins=4)
    name = f"{profile.name} ({unit})" if unit else profile.name
    ax.set_xlabel(name if profile.complete else f"{name}, stopped", labelpad=1)


def plot_insight(insight: Insight, correlation: Array | None = None, *, width: str = TWO) -> Figure:
    """Draw which part of which curve fixes each parameter, and the correlation.

    `correlation` is (k, k), where it is better known than from `insight`.
    """
    wide, k = figures.inches(width), len(insight.names)
    beside = wide >= SIDE_BY_SIDE
    parts, shares = insight.parts, insight.shares()
    told = [c for c in range(len(parts)) if np.nanmax(shares[:, c], initial=0.0) > 0.005]
    parts, shares = tuple(parts[c] for c in told), shares[:, told]
    matrix = insight.correlation if correlation is None else correlation
    with figures.drawing(wide, (1.15 + CELL * k) * (1 if beside else 2)) as figure:
        if beside:
            ratios = [max(len(parts) + 1.0, 0.6 * k), k]
            left, right = figure.subplots(1, 2, width_ratios=ratios)
        else:
            left, right = figure.subplots(2, 1)
        _cells(left, 100.0 * shares, "Blues", (0.0, 130.0), "{:.0f}")
        left.set_title("where the information comes from (%)", loc="left", fontsize=7.5, pad=4)
        left.set_yticks(range(k), insight.names)
        _name_parts(left, parts)
        # Points that a cell is wide: two digits need 15.
        cell = 72.0 * (0.5 * wide if beside else wide - 0.85) / k
        below = np.where(np.tri(k, dtype=bool), matrix, np.nan)
        _cells(right, below, "RdBu_r", (-1.4, 1.4), "{:.2f}" if cell >= 15.0 else "{:.1f}")
        right.set_title("correlation of the estimates", loc="left", fontsize=7.5, pad=4)
        right.set_xticks(range(k), insight.names, rotation=90)
        # Beside the other matrix the names stand on the left of that.
        right.set_yticks([] if beside else range(k), [] if beside else insight.names)
    return figure


def _name_parts(ax: Axes, parts: Sequence[tuple[str, str]]) -> None:
    """Name the branches below a matrix, and below these the curves."""
    labels = ["flight" if " " in branch else branch for _, branch in parts]
    longest = max(map(len, labels), default=0)
    ax.set_xticks(range(len(parts)), labels, rotation=90 if longest > 6 else 0)
    beneath = -16.0 if longest <= 6 else -4.0 - 4.0 * longest
    style: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
    style |= {"ha": "center", "va": "top", "fontsize": 7, "annotation_clip": False}
    colours = {"stress_time": VERMILION, "stress_strain": VERMILION, "displacement_time": BLUE}
    for curve in dict.fromkeys(curve for curve, _ in parts):
        at = [c for c, part in enumerate(parts) if part[0] == curve]
        if at[0]:
            ax.axvline(at[0] - 0.5, color="black", lw=0.8)
        place, name = (float(np.mean(at)), 0.0), curve.replace("_", "-")
        ax.annotate(name, place, (0, beneath), color=colours.get(curve, INSIDE[0]), **style)


def _cells(ax: Axes, values: Array, colors: str, limits: tuple[float, float], form: str) -> None:
    """Draw a matrix as shaded cells with their numbers; NaN is left blank."""
    ax.imshow(values, cmap=colors, vmin=limits[0], vmax=limits[1], aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            tenths = (
                np.trunc(10.000001 * value) / 10.0 if form == "{:.1f}" else value
            )  # .97 is no 1
            shown = form.format(tenths).replace("-", "−").replace("0.", ".")
            shown = "1" if shown.startswith("1.") else shown if shown.strip("−.0") else ""
            color = "white" if abs(value) > 0.6 * limits[1] else "black"
            text = ax.text(j, i, shown, ha="center", va="center", fontsize=6, color=color)
            text.set_in_layout(False)  # inside its cell; measuring is slow
    ax.tick_params(length=0, labelsize=6.5)
    ax.spines[:].set_visible(False)


def plot_snapping(result: Fit, path: str | Path | None = None) -> Figure | None:
    """Draw the fraction of micro-springs snapped over time, and the chain at a few instants.

    The instants are even along the motion, within the first cycle of several. None if no fraction
    is known. Saved at `path`, if one is given.
    """
    snapping, time, strain = result.snapping, result.curves.time, result.strain
    if not snapping or time is None or strain is None:
        return None
    first = next(iter(cycles_of(result.measurement).values()), slice(None))
    along = np.cumsum(np.abs(np.diff(strain[first], prepend=strain[0])))
    at = np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], INSTANTS))).tolist()
    with figures.drawing(7.0, 3.0) as figure:
        above, below = figure.subplots(2, 1, height_ratios=[1.0, 1.2])
        _draw_strip(above, result, strain, at)
        factor, unit = readable_unit(float(time[-1]), "s")
        for (name, one), colour in zip(snapping.items(), (BLUE, VERMILION, *INSIDE), strict=False):
            of = f" of {name}" if len(result.chain.springs) > 1 else ""
            style = {"color": colour, "lw": 1.0}
            below.plot(time / factor, 100.0 * one.fraction, label=f"snapped{of}", **style)
            below.plot(time / factor, 100.0 * one.ever, "--", label=f"ever snapped{of}", **style)
        for number, sample in enumerate(at, start=1):
            below.axvline(time[sample] / factor, color=GREY, lw=0.5, ls=":", zorder=0)
            below.annotate(f"{number}", (time[sample] / factor, 104.0), ha="center", fontsize=7)
        below.set(xlabel=f"time ({unit})", ylabel="micro-springs (%)", ylim=(0.0, 115.0))
        figures.legend_below(figure, figures.named_in([below]))
    return figures.save(figure, path)


def _draw_strip(ax: Axes, result: Fit, overall: Array, at: list[int]) -> None:
    """Draw the chain at some samples, each spring shaded from below by its fraction snapped."""
    chain, snapping = result.chain, result.snapping
    strains = [overall]
    if len(chain.springs) > 1:  # all in equilibrium, else no fraction is known
        stress = next(iter(snapping.values())).stress
        strains = [np.asarray(spring.strain(stress)) for spring in chain.springs]
    total = sum(chain.heights)
    for number, sample in enumerate(at, start=1):
        floor = 0.0
        for i, (strain, height) in enumerate(zip(strains, chain.heights, strict=True), start=1):
            tall = height / total * (1.0 - float(strain[sample]))
            share = float(snapping[f"s{i}"].fraction[sample]) if f"s{i}" in snapping else 0.0
            ax.bar(number, tall, 0.5, floor, color=STANDING, edgecolor=GREY, lw=0.6)
            ax.bar(number, share * tall, 0.5, floor, color=SNAPPED)
            floor += tall
        told = f"{number}: {100 * float(overall[sample]):.0f} %"
        ax.annotate(told, (number, floor), (0, 3), textcoords="offset points", ha="center")
    ax.set(ylim=(0.0, 1.25), xlim=(0.4, len(at) + 0.6))
    ax.set_title("shaded: the fraction snapped; written: the strain", loc="left", fontsize=7.5)
    ax.set_axis_off()
