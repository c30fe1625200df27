"""Figures of a result, each drawn once for all its files.

The figure of the fit is in `plots`; the other figures of the report, profiles of the cost and
snapped micro-springs, are here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, INSIDE, TWO, VERMILION
from foamfit.report.plots import plot_fit
from foamfit.report.readable import readable_unit
from foamfit.results import Fit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.parts import ParameterEstimate
    from foamfit.results import Profile

INSTANTS = 7  # pictures of a foam
SNAPPED, STANDING = "#7FB2D9", "#E6EEF4"  # shades of the snapped part and of the rest of a spring


def figures_of(result: Fit, width: str = TWO) -> dict[str, Figure]:
    """Return the figures of a result by name; `width` is that of "fit"."""
    drawn = {
        "fit": plot_fit(result, width=width),
        "snapping": plot_snapping(result),
        "profiles": plot_profiles(result),
    }
    return {name: figure for name, figure in drawn.items() if figure is not None}


def plot_profiles(result: Fit) -> Figure | None:
    """Draw each profile of the cost with its 95 % threshold and interval, four panels per row.

    The dashed parabola is that of the local covariance. Return None without a profile.
    """
    profiles = () if result.intervals is None else result.intervals.profiles
    if not profiles:
        return None
    rows = -(-len(profiles) // 4)
    with figures.drawing(7.0, 0.55 + 1.55 * rows) as figure:
        axes = figures.grid_of(figure, rows, 4, len(profiles), sharey=True)
        for at, (ax, profile) in enumerate(zip(axes, profiles, strict=True)):
            _draw_profile(ax, profile, result.parameters[profile.name])
            ax.set_ylabel("rise of χ²", visible=at % 4 == 0)
            ax.set_label(profile.name)
        figures.legend_below(figure, figures.named_in(axes))
    return figure


def _draw_profile(ax: Axes, profile: Profile, estimate: ParameterEstimate) -> None:
    """Draw one profile: threshold, interval, and the parabola of the standard error."""
    factor, unit = readable_unit(float(np.max(np.abs(profile.values))), estimate.unit)
    top = 2.0 * profile.cut
    best = float(profile.values[np.argmin(profile.rises)])
    x = profile.values / factor
    ax.axhline(profile.cut, color=GREY, lw=0.6, ls=(0, (2, 2)), label="95 % threshold")
    ax.axvspan(*(end / factor for end in profile.ci95), color="0.92", lw=0, label="95 % interval")
    fine = np.linspace(x.min(), x.max(), 200)
    if estimate.stderr:
        parabola = ((fine * factor - best) / estimate.stderr) ** 2
        below = np.where(parabola <= top, parabola, np.nan)
        ax.plot(fine, below, color=GREY, lw=0.8, ls="--", label="local covariance")
    root = np.sign(profile.values - best) * np.sqrt(np.maximum(profile.rises, 0.0))
    style: Any = {"color": BLUE, "lw": 1.1, "label": "lowest cost, all others refitted"}
    ax.plot(fine, np.interp(fine, x, root) ** 2, **style)
    ax.plot(x, profile.rises, "o", color=BLUE, ms=2.2)
    ax.plot(best / factor, 0.0, "o", color=VERMILION, ms=3.5, label="best fit")
    ax.set_ylim(-0.04 * top, top)
    ax.locator_params(axis="x", nbins=4)
    name = f"{profile.name} ({unit})" if unit else profile.name
    ax.set_xlabel(name if profile.complete else f"{name}, stopped", labelpad=1)


def plot_snapping(result: Fit) -> Figure | None:
    """Draw the fraction of snapped micro-springs over time, and the chain at a few instants.

    The instants are evenly spaced along the motion of the first cycle. Return None if no fraction
    is known.
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
    return figure


def _draw_strip(ax: Axes, result: Fit, overall: Array, at: list[int]) -> None:
    """Draw the chain at the samples `at`, each spring shaded by its snapped fraction."""
    chain, snapping = result.chain, result.snapping
    strains = [overall]
    if len(chain.springs) > 1:  # all in equilibrium, otherwise no fraction is known
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
        label = f"{number}: {100 * float(overall[sample]):.0f} %"
        ax.annotate(label, (number, floor), (0, 3), textcoords="offset points", ha="center")
    ax.set(ylim=(0.0, 1.25), xlim=(0.4, len(at) + 0.6))
    ax.set_title("shaded: snapped fraction; numbers: strain", loc="left", fontsize=7.5)
    ax.set_axis_off()
