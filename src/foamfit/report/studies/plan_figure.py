"""Figure of a plan: what each test would determine, and the intervals now and afterwards."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, TWO, VERMILION
from foamfit.text import engineering

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.report.studies.plan import Expected, Outcome, Plan

SHOWN = 3.2  # largest half interval over the scale of a parameter that the figure shows


def plot_plan(plan: Plan, *, width: str = TWO) -> Figure:
    """Draw the expected number of determined parameters over all tests, and the intervals."""
    wide = figures.inches(width)
    title = [f"{plan.name}: {plan.law}. Expected by simulation, not measured."]
    title += [] if plan.advice is None else [f"Advised: {plan.advice.candidate}."]
    stacked = wide < 5.0
    tall = (5.8 if stacked else 3.1) + 0.16 * max(len(plan.now) - 8, 0)
    with figures.drawing(wide, tall, *figures.title(width, *title)) as figure:
        left, right = figure.subplots(2, 1) if stacked else figure.subplots(1, 2)
        _map(left, plan)
        draw_intervals(right, plan)
        figures.legend_below(figure, figures.named_in([left, right]))
    return figure


def _map(ax: Axes, plan: Plan) -> None:
    """Draw the expected number of determined parameters against the settings of the tests.

    Of several tests with the same settings the best counts. Tests that exceed a limit with more
    than 5 % probability are hatched.
    """
    impact = bool(plan.rig.masses)
    axes = ("velocity", "mass") if impact else ("rate", "strain")

    def settings(one: Outcome) -> tuple[float, float] | None:
        x, y = (getattr(one.candidate, name) for name in axes)
        return None if x is None or y is None or one.candidate.repeat else (x, y)

    ranked = sorted(plan.outcomes, key=lambda one: one.number)
    best = {at: one for one in ranked if (at := settings(one)) is not None}
    x, y = (sorted({at[i] for at in best}) for i in (0, 1))
    count = np.full((len(y), len(x)), np.nan)
    style: Any = {"facecolor": "none", "edgecolor": VERMILION, "hatch": "////", "linewidth": 0.0}
    for at, one in best.items():
        column, row = x.index(at[0]), y.index(at[1])
        count[row, column] = one.number
        if one.risky:
            ax.fill_between((column - 0.5, column + 0.5), row - 0.5, row + 0.5, **style)
    shown = ax.imshow(
        count, cmap="Blues", vmin=0, vmax=len(plan.now), origin="lower", aspect="auto"
    )
    if plan.advice is not None and (at := settings(plan.advice)) in best and at is not None:
        star: Any = {"color": VERMILION, "ms": 11, "mec": "white", "ls": "none"}
        ax.plot(x.index(at[0]), y.index(at[1]), "*", label="advised test", **star)
    for mass, (half, _) in plan.closing.items():
        if mass in y and x[0] < half < x[-1]:
            row, place = y.index(mass), np.interp(np.log(half), np.log(x), range(len(x)))
            ax.plot([place] * 2, [row - 0.5, row + 0.5], color="black", linewidth=1.0, ls="--")
    few = np.unique(np.linspace(0, len(x) - 1, 5).astype(int))
    ax.set_xticks(few, [f"{x[column]:.2g}" for column in few])
    ax.set_yticks(range(len(y)), [engineering(1e3 * b, "g") if impact else f"{b:.2g}" for b in y])
    ax.set_ylabel("striker mass" if impact else "largest strain")
    ax.set_xlabel("velocity (m/s)" if impact else "strain rate (1/s)")
    ax.set_title(f"expected number of the {len(plan.now)} parameters determined", fontsize=8)
    ax.figure.colorbar(shown, ax=ax, aspect=30, pad=0.02)


def draw_intervals(ax: Axes, plan: Plan) -> None:
    """Draw the 95 % interval of each parameter over its scale, now and after the advised test."""
    names, best = list(plan.now), plan.advice
    pairs: list[tuple[str, str, dict[str, Expected], float]] = [("now", GREY, plan.now, -0.17)]
    if best is not None:
        pairs.append(("after the advised test (expected)", BLUE, best.expected, 0.17))
    for label, colour, expected, shift in pairs:
        for i, name in enumerate(names):
            one = expected[name]
            unknown = one.state == "not determined" or not one.share < SHOWN
            half = SHOWN if unknown else max(one.share, 0.01)
            style: Any = {"color": colour, "linewidth": 2.6, "solid_capstyle": "butt"}
            style |= {"linestyle": (0, (1, 1)) if unknown else "-"}
            ax.plot([-half, half], [i + shift] * 2, label=f"{'_' * bool(i)}{label}", **style)
    for edge in (-0.5, 0.5):
        ax.axvline(edge, color="black", linewidth=0.5, linestyle=":")
    ax.set(yticks=range(len(names)), yticklabels=plan.own(names), ylim=(len(names) - 0.5, -0.5))
    ax.set_xscale("symlog", linthresh=0.1)
    ax.set(xticks=(-3, -0.5, 0, 0.5, 3), xlim=(-SHOWN, SHOWN))
    ax.set_xticklabels(["−300 %", "−50 %", "0", "50 %", "300 %"])
    ax.minorticks_off()
    ax.set_title("95 % interval (dotted: not determined)", fontsize=8)
