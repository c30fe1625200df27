"""The figure of the look ahead at a test."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from foamfit.report.identifiability_plots import (
    cells_height,
    draw_information,
    draw_sensitivities,
    strips_height,
)
from foamfit.report.outlook import Plan
from foamfit.report.plots import STYLE, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_plan(plan: Plan, path: str | Path | None = None) -> Figure:
    """Draw sensitivities, information and correlation of a planned experiment in one figure."""
    import matplotlib
    from matplotlib.figure import Figure

    insight = plan.outlook.insight
    with matplotlib.rc_context(STYLE):
        if insight is None:
            figure = Figure(figsize=(4.0, 1.0), layout="constrained")
            figure.text(0.5, 0.5, "no parameter leaves a trace in the curves", ha="center")
            return save(figure, path)
        heights = [strips_height(insight), cells_height(insight)]
        figure = Figure(figsize=(7.0, sum(heights) + 0.3), layout="constrained")
        name = " ".join(plan.problem.measurement.name.split())[:70]
        figure.suptitle(
            f"{name} · {plan.problem.model.name} · before the fit", x=0.012, ha="left",
            fontsize=8.5, weight="bold", parse_math=False,
        )  # fmt: skip
        halves = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)[:, 0]
        draw_sensitivities(halves[0], insight)
        draw_information(halves[1], insight, None)
    return save(figure, path)
