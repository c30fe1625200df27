"""The figure of a comparison: how far each parameter is from its reference."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit.report import figures
from foamfit.report.comparison import Comparison, Pair, Row
from foamfit.report.figures import BLUE, GREY, TWO, VERMILION
from foamfit.text import signed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKS = ((BLUE, "o"), (VERMILION, "s"), ("black", "^"), (GREY, "D"))  # of the results


def plot_comparison(
    comparison: Comparison, path: str | Path | None = None, *, width: str = TWO, table: bool = True
) -> Figure:
    """Draw how far each parameter is from its reference, in standard errors, and in percent.

    One panel for each reference; shaded are one and three standard errors. What is not compared is
    left out, what is not determined is named. For `path` and `width` see `plots.plot_fit`; without
    `table` no CSV of what is plotted is written.
    """
    groups: dict[str, list[Pair]] = {}
    for pair in comparison.pairs:
        groups.setdefault(pair.reference, []).append(pair)
    wide = figures.inches(width)
    columns = figures.abreast(wide, min(len(groups), 2), 2.9)
    lines = [max(len(_shown(pairs)), 1) * (len(_lanes(pairs)) + 1) for pairs in groups.values()]
    rows = [max(lines[i : i + columns]) for i in range(0, len(lines), columns)]
    with figures.drawing(wide, 0.5 + sum(0.6 + 0.12 * n for n in rows)) as figure:
        ratios = [n + 2 for n in rows]
        axes = figure.subplots(len(rows), columns, squeeze=False, height_ratios=ratios).ravel()
        for ax in axes[len(groups) :]:
            ax.remove()
        for ax, (reference, pairs) in zip(axes, groups.items(), strict=False):
            _draw_comparison(ax, pairs)
            title = textwrap.fill(f"beside {reference}", int(16 * wide / columns))
            ax.set_title(title, loc="left", fontsize=7.5, pad=4, weight="bold", parse_math=False)
        for ax in figure.axes[-columns:]:  # the lowest ones
            ax.set_xlabel("deviation (standard errors)")
        _name_results(figure, list(groups.values()))
    return figures.save(figure, path, table=table)


def _is_shown(row: Row) -> bool:
    return row.standard_errors is not None or row.lost


def _shown(pairs: list[Pair]) -> list[str]:
    """Return the parameters of which some result has something to show, in their order."""
    rows = [row for pair in pairs for row in pair.rows]
    there = {row.label for row in rows if _is_shown(row)}
    return [label for label in dict.fromkeys(row.label for row in rows) if label in there]


def _lanes(pairs: list[Pair]) -> list[int]:
    """Return the places of the results that have anything to show: each gets a lane."""
    return [k for k, pair in enumerate(pairs) if any(map(_is_shown, pair.rows))]


def _draw_comparison(ax: Axes, pairs: list[Pair]) -> None:
    """One line for each parameter of each result; results of a parameter stand together."""
    labels = _shown(pairs)
    if not labels:
        figures.say_nothing_there(ax)
        return
    found = [row.standard_errors for pair in pairs for row in pair.rows]
    reach = max(4.0, 1.1 * max((abs(z) for z in found if z is not None), default=0.0))
    for half, shade in ((3.0, "0.95"), (1.0, "0.88")):
        ax.axvspan(-half, half, color=shade, lw=0, zorder=0)
    ax.axvline(0.0, color=GREY, lw=0.6, zorder=1)
    lanes = _lanes(pairs)
    step = len(lanes) + 1
    for lane, k in enumerate(lanes):
        color, mark = MARKS[k % len(MARKS)]
        side = f"{pairs[k].test}, {pairs[k].model}, {pairs[k].drive} drive"
        for row in pairs[k].rows:
            if row.label not in labels:
                continue
            y, z, name = labels.index(row.label) * step + lane, row.standard_errors, row.label
            beside: dict[str, Any] = {"va": "center", "fontsize": 6.5, "color": color}
            if row.lost:
                beside |= {"ha": "center", "style": "italic", "label": f"_{side}: {name}:"}
                ax.annotate("not determined", (0.0, y), **beside)
            elif z is not None:
                ax.plot([0.0, z], [y, y], color=color, lw=0.9, zorder=2)
                face = "white" if row.state == "weak" else color
                style: dict[str, Any] = {"ms": 3.4, "color": color, "mfc": face, "zorder": 3}
                ax.plot(z, y, mark, label=f"_{side}: {name}", **style)
                beside |= {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
                ax.annotate(_percent(row), (1.0, y), (2, 0), ha="left", **beside)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(step * len(labels) - 0.5, -1.0)
    ax.set_yticks(
        [i * step + 0.5 * (step - 2) for i in range(len(labels))],
        [_math(label) for label in labels],
    )
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)


def _name_results(figure: Figure, groups: list[list[Pair]]) -> None:
    """Say once what the colours mean: the drives, where these are the same in every panel."""
    drives = [[f"{pair.drive} drive" for pair in pairs] for pairs in groups]
    names = max(drives, key=len)
    if len(groups) == 1 and len(set(names)) < len(names):
        names = [f"{s.test}: {s.model}, {s.drive} drive" for s in groups[0]]
    elif len(set(names)) < len(names) or any(d != names[: len(d)] for d in drives):
        names = [f"result {k + 1}" for k in range(len(names))]
    drawn = {k for pairs in groups for k in _lanes(pairs)}
    entries = dict[str, Any]()
    for k, name in enumerate(names):
        color, mark = MARKS[k % len(MARKS)]
        label = name if k in drawn else f"{name}: nothing to compare"
        (entries[label],) = figure.axes[0].plot([], [], mark, ms=3.4, color=color)
    if any(row.state == "weak" for group in groups for pair in group for row in pair.rows):
        style: dict[str, Any] = {"ms": 3.4, "color": GREY, "mfc": "white"}
        (entries["hollow: weakly determined"],) = figure.axes[0].plot([], [], "o", **style)
    figures.legend_below(figure, entries)


def _math(label: str) -> str:
    """Write the symbols of a label as formulas: "s2 k_h+/k0" gives "s2 $k_{h+}$/$k_{0}$"."""
    *spring, name = label.split(" ")
    parts = re.findall(r"(Δ?\w)_?([^/]*)/?", name.translate(str.maketrans("₊₋−", "+--")))
    told = "/".join(f"${stem}_{{{index}}}$" if index else f"${stem}$" for stem, index in parts)
    return " ".join([*spring, told])


def _percent(row: Row) -> str:
    """Return the difference with its standard error, in percent of the reference."""
    if row.percent is None or not row.reference:
        return ""
    spread = 100.0 * row.spread / abs(row.reference)
    places = 0 if spread >= 10.0 else 1 if spread >= 1.0 else 2
    return f"{signed(row.percent, places)} ± {spread:.{places}f} %"
