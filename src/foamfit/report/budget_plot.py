"""The uncertainty budget of a fit as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from foamfit.report.figures import GREY, TWO, drawing, inches, legend_below
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.results import Budget

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
ROW = 0.2  # height of a bar with its gap, in


def plot_budget(budget: Budget, *, width: str = TWO) -> Figure:
    """Draw the share of each source in the variance of each parameter, and the combined error.

    The combined standard deviation, on the right, is in percent of the scale of the parameter.
    """
    names, wide = list(budget.contributions), inches(width)
    with drawing(wide, 0.9 + ROW * len(names)) as figure:
        shares, totals = figure.subplots(1, 2, sharey=True, width_ratios=[3.0, 1.4])
        entries = _draw_shares(shares, budget, names)
        _draw_totals(totals, budget, names)
        shares.set_yticks(range(len(names)), names)
        shares.set_ylim(len(names) - 0.4, -0.6)
        legend_below(figure, entries)
    return figure


def _draw_shares(ax: Axes, budget: Budget, names: list[str]) -> dict[str, object]:
    """Draw the stacked bars; returns what stands for each source in a legend."""
    left, entries = np.zeros(len(names)), dict[str, object]()
    for source in budget.sources:
        colour, hatch = LOOKS[source]
        variances = [budget.contributions[name][source] ** 2 for name in names]
        share = [
            100.0 * variance / (budget.combined(name) ** 2 or 1.0)
            for variance, name in zip(variances, names, strict=True)
        ]
        bars = ax.barh(
            range(len(names)), share, 0.72, left, color=colour, hatch=hatch, edgecolor="white",
            linewidth=0.5,
        )  # fmt: skip
        left, entries[source] = left + share, bars
    ax.set_xlim(0.0, 100.0)
    ax.set_xlabel("share of the variance (%)")
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    return entries


def _draw_totals(ax: Axes, budget: Budget, names: list[str]) -> None:
    """Draw the combined standard deviations, in percent of the scales."""
    totals = [budget.combined(name) / budget.scales[name] for name in names]
    ax.barh(range(len(names)), [100.0 * total for total in totals], 0.72, color=GREY)
    for i, total in enumerate(totals):
        ax.annotate(
            percent(total), (100.0 * total, i), (3, 0), textcoords="offset points", va="center",
            fontsize=6.5,
        )  # fmt: skip
    ax.set_xlim(0.0, 150.0 * max(totals))
    ax.locator_params(axis="x", nbins=3)
    ax.set_xlabel("combined (%)")
    ax.tick_params(axis="y", length=0)
