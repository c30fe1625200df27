"""The figure of a comparison: how far each parameter is from its reference."""

from __future__ import annotations

import math
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from foamfit.report.comparison import Comparison, Pair, Row
from foamfit.report.figures import (
    BLUE,
    GREY,
    TWO,
    VERMILION,
    abreast,
    drawing,
    inches,
    save,
    say_nothing_there,
)
from foamfit.text import signed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKS = ((BLUE, "o"), (VERMILION, "s"), ("black", "^"), (GREY, "D"))  # of the results
MATH = {
    "k0": "$k_0$", "σ_a": r"$\sigma_a$", "ε_a": r"$\varepsilon_a$", "ε_c": r"$\varepsilon_c$",
    "k_h+": "$k_{h+}$", "k_h−": "$k_{h-}$", "k_c": "$k_c$", "Δσ": r"$\Delta\sigma$",
    "η": r"$\eta$", "ε_*": r"$\varepsilon_*$", "σ₊": r"$\sigma_+$", "σ₋": r"$\sigma_-$",
    "s₊": "$s_+$", "s₋": "$s_-$",
}  # fmt: skip
MATH |= {f"g_{k}": f"$g_{k}$" for k in range(1, 10)}
MATH |= {f"τ_{k}": rf"$\tau_{k}$" for k in range(1, 10)}
IN_MATH = re.compile("|".join(map(re.escape, MATH)))


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
    wide = inches(width)
    columns = abreast(wide, min(len(groups), 2), 2.9)
    lines = [max(len(_shown(pairs)), 1) * (len(_lanes(pairs)) + 1) for pairs in groups.values()]
    rows = [max(lines[i : i + columns]) for i in range(0, len(lines), columns)]
    with drawing(wide, 0.5 + sum(0.6 + 0.12 * n for n in rows)) as figure:
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
    return save(figure, path, table=table)


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
        say_nothing_there(ax)
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
            y = labels.index(row.label) * step + lane
            if row.lost:
                ax.annotate(
                    "not determined", (0.0, y), ha="center", va="center", fontsize=6.5,
                    color=color, style="italic", label=f"_{side}: {row.label}:",
                )  # fmt: skip
            elif row.standard_errors is not None:
                ax.plot([0.0, row.standard_errors], [y, y], color=color, lw=0.9, zorder=2)
                ax.plot(
                    row.standard_errors, y, mark, ms=3.4, color=color, zorder=3,
                    label=f"_{side}: {row.label}",
                    mfc="white" if row.state == "weak" else color,
                )  # fmt: skip
                ax.annotate(
                    _percent(row), (1.0, y), (2, 0), xycoords=("axes fraction", "data"),
                    textcoords="offset points", ha="left", va="center", fontsize=6.5, color=color,
                )  # fmt: skip
    ax.set_xlim(-reach, reach)
    ax.set_ylim(step * len(labels) - 0.5, -1.0)
    ax.set_yticks(
        [i * step + 0.5 * (step - 2) for i in range(len(labels))],
        [IN_MATH.sub(lambda found: MATH[found[0]], label) for label in labels],
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
    for k, name in enumerate(names):
        color, mark = MARKS[k % len(MARKS)]
        label = name if k in drawn else f"{name}: nothing to compare"
        figure.axes[0].plot([], [], mark, ms=3.4, color=color, label=label)
    if any(row.state == "weak" for group in groups for pair in group for row in pair.rows):
        figure.axes[0].plot(
            [], [], "o", ms=3.4, color=GREY, mfc="white", label="hollow: weakly determined"
        )
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles, [label.replace("$", r"\$") for label in labels], loc="outside lower center",
        ncols=_columns_of(labels, figure.get_figwidth()), handletextpad=0.2,
    )  # fmt: skip


def _columns_of(labels: list[str], width: float) -> int:
    """How many columns of a legend have room, inches."""
    longest = max(map(len, labels))
    return 1 if longest > 30 else min(len(labels), max(int(72.0 * width / (4.2 * longest + 26)), 1))


def _percent(row: Row) -> str:
    """Return the difference with its standard error, in percent of the reference."""
    if row.percent is None or not row.reference:
        return ""
    spread = 100.0 * math.hypot(row.stderr or 0.0, row.reference_stderr or 0.0)
    spread /= abs(row.reference)
    places = 0 if spread >= 10.0 else 1 if spread >= 1.0 else 2
    return f"{signed(row.percent, places)} ± {spread:.{places}f} %"
