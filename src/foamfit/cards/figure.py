"""The picture of a card: measured, fitted, card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.cards.curves import Curves
from foamfit.cards.records import Record
from foamfit.report import figures
from foamfit.report.figures import BLUE, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.text import percent, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


STYLES: dict[str, Any] = {
    "measured": {"color": "0.65", "linewidth": 1.8},
    "fitted": {"color": BLUE, "linewidth": 0.9},
    "card": {"color": VERMILION, "linewidth": 1.0, "linestyle": (0, (5, 1.2))},
}
WIDTH, HEIGHT = 2.7, 2.9  # of a panel, inches
MOST = 3  # records that are drawn: the slowest, the middle and the fastest


def draw(
    name: str, misfit: Mapping[str, float | None], records: Sequence[Record], curves: Curves
) -> Figure:
    """Draw the records with law and card along them, and the loading curves to their ends."""
    known = {name: value for name, value in misfit.items() if value is not None}
    told = ", ".join(f"{name} {percent(value)}" for name, value in known.items())
    shown = sorted(records, key=lambda one: one.rate or 0.0)
    if len(shown) > MOST:
        shown = [shown[0], shown[len(shown) // 2], shown[-1]]
    width = WIDTH * (len(shown) + 1)
    title = figures.title_lines(width, name, f"misfit: {told}")
    factor, unit = readable_unit(max(float(one.stress.max()) for one in shown), "Pa")
    with figures.drawing(width, HEIGHT, title) as figure:
        axes = figure.subplots(1, len(shown) + 1)
        for ax, one in zip(axes, shown, strict=False):
            loops = ((one.strain, one.stress), (one.motion, one.fitted), (one.motion, one.card))
            drawn = {
                name: ax.plot(strain, stress / factor, **style)[0]
                for (name, style), (strain, stress) in zip(STYLES.items(), loops, strict=True)
            }
            rate = "rate not known" if one.rate is None else f"{significant(one.rate, 3)} 1/s"
            ax.set(title=rate, xlabel="strain", ylabel=f"stress ({unit})")
        _loading(axes[-1], curves)
        figures.legend_below(figure, drawn)
    return figure


def _loading(ax: Axes, curves: Curves) -> None:
    factor, unit = readable_unit(float(curves.stress.max()), "Pa")
    inside, shades = curves.measured, np.linspace(1.0, 0.4, len(curves.rates))[::-1]
    for shade, stress in zip(shades, curves.stress, strict=True):
        style: Any = {"color": VERMILION, "alpha": float(shade), "linewidth": 1.0}
        ax.plot(curves.strain[:inside], stress[:inside] / factor, **style)
        ax.plot(curves.strain[inside - 1 :], stress[inside - 1 :] / factor, linestyle=":", **style)
    ax.set(title="loading; dotted: extrapolated", xlabel="strain", ylabel=f"stress ({unit})")
