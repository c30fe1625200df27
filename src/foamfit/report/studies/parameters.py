"""Figure of the parameters of several tests: a panel per parameter, a row per test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.options import RATES
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, TWO, VERMILION
from foamfit.report.plots import draw_loops
from foamfit.report.tables import ByTest, formula, symbols, unit_of_all

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from foamfit.parts import ParameterEstimate
    from foamfit.results import Loop

LEAST_PANEL, LETTER = 0.62, 0.052  # least width of a panel and width of a letter, inches
TALLEST, ROW, ABOVE = 7.5, 0.17, 2.5  # heights of all panels, a row and the panel above, inches
MOST_ROWS, MOST_LOOPS = 60, 24  # tests that are named, and whose loops are drawn
ROOMY = 0.8  # width of a panel with room for more numbers, inches
# Colours of edge and face of the marks.
_MARKS = {"determined": (BLUE, BLUE), "weak": (BLUE, "white"), "not determined": (GREY, "white")}


@dataclass(frozen=True)
class Panel:
    """One parameter of several tests, and the values it is compared with.

    `references` are other values by test, `joint` is the parameter in a joint fit of the tests.
    """

    name: str
    head: str  # symbol
    tests: dict[str, ParameterEstimate]
    references: dict[str, ParameterEstimate] = field(default_factory=dict)
    joint: ParameterEstimate | None = None

    @property
    def common(self) -> ParameterEstimate | None:
        """The value common to all tests, if there is one."""
        return self.joint if self.joint and self.joint.kind in ("shared", "scatter") else None

    @property
    def has_law(self) -> bool:
        """Whether the parameter follows a rate law."""
        return self.joint is not None and self.joint.kind in RATES

    @property
    def note(self) -> str:
        """Kind of the parameter in a joint fit, and the slope of a rate law."""
        if self.joint is None:
            return ""
        slope = "" if self.joint.b is None else f", b = {self.joint.b:.2g}".replace("-", "−")
        return f"{self.joint.kind}{slope}"


def panels_of(tests: Sequence[str], parameters: ByTest) -> list[Panel]:
    """Return a panel for each parameter, given its value, or None, in each test."""
    return [
        Panel(name, formula(own), {t: p for t, p in zip(tests, each, strict=True) if p is not None})
        for own, (name, each) in zip(symbols(parameters), parameters.items(), strict=True)
    ]


def plot_parameters(
    title: str,
    tests: Sequence[str],
    panels: Sequence[Panel],
    *,
    width: str = TWO,
    loops: Sequence[Loop] = (),
) -> Figure:
    """Draw values with 95 % intervals, a panel per parameter, a row per test.

    A band is the 95 % interval of a common value, dashed lines its spread between specimens, ticks
    are references. Very wide intervals are cut; an arrow at the edge is a value outside the panel.
    A panel above the others has at most `MOST_LOOPS` loops; for `width` see `plots.plot_fit`.
    """
    wide, count, n = figures.inches(width), len(tests), max(len(panels), 1)
    step = max(-(-count // MOST_ROWS), 1)  # of very many tests only some are named
    most = int(min(0.28 * wide, 1.3) / LETTER)
    names = [figures.tail(name, most) for name in tests][::step]
    margin = LETTER * max(map(len, names), default=3) + 0.1
    across = figures.abreast(wide - margin, n, LEAST_PANEL)
    rows = -(-n // across)
    across = -(-n // rows)  # rows of equal length
    tall = min(max(ROW * count, 0.5), max(TALLEST / rows, 0.1 * len(names))) + 0.55
    heights = [ABOVE if loops else 0.0, rows * tall]
    with figures.drawing(wide, sum(heights) + 0.3, *figures.title(width, title)) as figure:
        part: Figure | SubFigure = figure
        if loops:
            top, part = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
            few = np.unique(np.linspace(0, len(loops) - 1, MOST_LOOPS).astype(int))
            draw_loops([loops[i] for i in few], top.subplots())
        axes = part.subplots(rows, across, squeeze=False, sharey=True).ravel().tolist()
        for ax in axes[n:]:
            ax.set_axis_off()
        size = min(6.5, 0.62 * 72.0 * (tall - 0.55) / max(len(names), 1))
        for ax, panel in zip(axes, panels, strict=False):
            _draw(ax, panel, tests, (wide - margin) / across > ROOMY)
            ax.tick_params(axis="y", length=0, labelsize=size)
        axes[0].set_ylim(count - 0.4, -0.6)
        axes[0].set_yticks(range(0, count, step), names, parse_math=False)
        if not panels:
            figures.say_nothing_there(axes[0], "no parameter to compare")
        figures.legend_below(figure, axes, first=_MARKS)
    return figure


def _draw(ax: Axes, panel: Panel, tests: Sequence[str], roomy: bool) -> None:
    """Draw one parameter; with fewer numbers on its axis unless it is `roomy`."""
    others = [*panel.references.values(), *([panel.common] if panel.common else [])]
    factor, unit = unit_of_all([*panel.tests.values(), *others])
    rows = [(y, panel.tests[test]) for y, test in enumerate(tests) if test in panel.tests]
    known = [p for _, p in rows if p.state in ("determined", "weak")] or [p for _, p in rows]
    known += others
    ends = [end / factor for p in known for end in p.ci95 or () if np.isfinite(end)]
    low, high = figures.limits([p.value / factor for p in known], ends)
    ax.set_xlim(low, high)
    ax.set_title(f"{panel.head} ({unit})" if unit else panel.head, fontsize=7.5, pad=3)
    ax.set_label(panel.name)
    ax.set_xlabel(panel.note, fontsize=6.5, labelpad=1, color=GREY)
    ax.tick_params(axis="x", labelsize=5.5, length=2, pad=1.5)
    ax.locator_params(axis="x", nbins=2, steps=[1, 2, 5, 10])
    ticks = [tick for tick in ax.get_xticks() if low <= tick <= high]
    if not roomy and len(ticks) > 2:
        ax.set_xticks(ticks[:: len(ticks) - 1])
    ax.grid(axis="y", color="0.9", lw=0.5)
    ax.set_axisbelow(True)
    _draw_others(ax, panel, tests, factor)
    bars = [(y, *p.ci95) for y, p in rows if p.ci95 is not None and np.all(np.isfinite(p.ci95))]
    if bars:
        y, left, right = np.array(bars).T
        ax.hlines(y, left / factor, right / factor, color=GREY, lw=0.9, label="95 % interval")
    if not panel.has_law:
        size = 3.4 if len(tests) <= 25 else 2.4 if len(tests) <= MOST_ROWS else 1.4
        _draw_values(ax, rows, factor, size)


def _draw_values(
    ax: Axes, rows: Sequence[tuple[int, ParameterEstimate]], factor: float, size: float
) -> None:
    """Draw values by row and state; those outside the panel as arrows at its edge."""
    low, high = ax.get_xlim()
    for state, (edge, face) in _MARKS.items():
        style: Any = {"color": edge, "mfc": face, "ls": "none", "ms": size, "mew": 0.8, "zorder": 4}
        points = [(p.value / factor, y) for y, p in rows if p.state == state]
        if inside := [at for at in points if low <= at[0] <= high]:
            ax.plot(*np.array(inside).T, "o", label=state, **style)
        for mark, end, sign in (("<", low, -1.0), (">", high, 1.0)):
            if at := [y for x, y in points if sign * (x - end) > 0.0]:
                style |= {"label": "beyond the panel", "clip_on": False}
                ax.plot([end] * len(at), at, mark, **style)


def _draw_others(ax: Axes, panel: Panel, tests: Sequence[str], factor: float) -> None:
    """Draw references, and line, band and spread between specimens of the common value."""
    line: dict[str, Any] = {"color": VERMILION, "lw": 1.0, "zorder": 2}
    for y, test in enumerate(tests):
        if p := panel.references.get(test):
            ax.vlines(p.value / factor, y - 0.36, y + 0.36, label=p.state, **line)
    if panel.has_law:
        rows = [y for y, test in enumerate(tests) if test in panel.tests]
        ax.plot([panel.tests[tests[y]].value / factor for y in rows], rows, label="common", **line)
    elif panel.common is not None:
        value = panel.common.value / factor
        ax.axvline(value, label="common", **line)
        if panel.common.ci95 is not None:
            band: dict[str, Any] = {"color": VERMILION, "alpha": 0.18, "lw": 0, "zorder": 1}
            ends = (end / factor for end in panel.common.ci95)
            ax.axvspan(*ends, label="95 % interval of the common value", **band)
        scatter = panel.common.scatter or 0.0
        for sign in (-1.0, 1.0) if scatter else ():
            edge = value * float(np.exp(sign * scatter))
            line |= {"ls": (0, (3, 2)), "lw": 0.8}
            ax.axvline(edge, label="spread between specimens", **line)
