"""The parameters of several tests side by side: a panel each, a row for each test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import commonprefix
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.fitting.links import RATES
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, TWO, VERMILION
from foamfit.report.readable import own_symbol
from foamfit.report.tables import formula, unit_of_all

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.results import ParameterEstimate

LEAST_PANEL, LETTER = 0.62, 0.052  # in, of a panel and of a letter of a name
TALLEST, ROW, MOST_ROWS = 7.5, 0.17, 60  # in; tests beyond which none is named
DPI, ROOMY = 200, 0.8  # in, of a panel with more numbers
# What a mark means: colour of its edge, of its inside, and its words.
_MARKS = {
    "determined": (BLUE, BLUE, "determined"),
    "weak": (BLUE, "white", "weak"),
    "not determined": (GREY, "white", "not determined"),
}
_BEYOND = "beyond the panel"


@dataclass(frozen=True)
class Compared:
    """One parameter of several tests; `common` is what they have in common, if anything.

    `scatter` is the standard deviation of its logarithm between specimens.
    """

    name: str
    tests: Mapping[str, ParameterEstimate]
    springs: int = 1
    kind: str = ""
    common: ParameterEstimate | None = None
    scatter: float | None = None


def plot_parameters(
    title: str, tests: Sequence[str], compared: Sequence[Compared], *, width: str = TWO
) -> Figure:
    """Draw values with 95 % intervals by test, a panel for each parameter, tests named at the left.

    A band is the 95 % interval of a common value, dashed its spread between specimens. Wide
    intervals run out of a panel; an arrow at its edge is a value beyond. `width` is "one" or "two"
    columns, or a length such as "85 mm".
    """
    wide, count = figures.inches(width), len(tests)
    named = count <= MOST_ROWS
    most = int(min(0.28 * wide, 1.3) / LETTER)
    names = _short(tests, most) if named else []
    margin = LETTER * max(map(len, names), default=3) + 0.1
    across = figures.abreast(wide - margin, max(len(compared), 1), LEAST_PANEL)
    rows = -(-max(len(compared), 1) // across)
    across = -(-max(len(compared), 1) // rows)  # rows of equal length
    tall = min(max(ROW * count, 0.5), max(TALLEST / rows, 0.1 * count if named else 1.5)) + 0.55
    lines = figures.title_lines(wide, title, titled=figures.is_titled(width))
    with figures.drawing(wide, rows * tall + 0.16 * len(lines) + 0.3, lines) as figure:
        axes = figures.grid_of(figure, rows, across, max(len(compared), 1), sharey=True)
        size = min(6.5, 0.62 * 72.0 * (tall - 0.55) / max(count, 1))
        for ax, one in zip(axes, compared, strict=False):
            _panel(ax, one, tests, (wide - margin) / across > ROOMY)
            ax.tick_params(axis="y", length=0, labelsize=size)
        axes[0].set_ylim(count - 0.4, -0.6)
        axes[0].set_yticks(range(count) if named else [], names, parse_math=False)
        for ax in [] if named else axes[::across]:
            ax.set_ylabel(f"{count} tests")
        entries, order = figures.named_in(axes), [label for *_, label in _MARKS.values()]
        known = sorted(entries, key=lambda label: order.index(label) if label in order else 9)
        lines_below = figures.legend_below(figure, {label: entries[label] for label in known})
        figure.set_figheight(figure.get_figheight() + 0.15 * max(lines_below - 1, 0))
    return figure


def _short(tests: Sequence[str], most: int) -> list[str]:
    """Names of so many letters at most: the end that all have is left out, then the beginning."""
    if all(len(name) <= most for name in tests):
        return list(tests)
    end = len(commonprefix([name[::-1] for name in tests])) if len(tests) > 1 else 0  # noqa: RUF071
    cut = [name[: len(name) - end] or name for name in tests]
    return [figures.tail(name, most) for name in cut]


def _panel(ax: Axes, one: Compared, tests: Sequence[str], roomy: bool) -> None:
    """Draw one parameter, with fewer numbers at its axis where it is not `roomy`."""
    every = [*one.tests.values(), *([one.common] if one.common else [])]
    factor, unit = unit_of_all(every)
    there = [(y, one.tests[test]) for y, test in enumerate(tests) if test in one.tests]
    sure = [p for _, p in there if p.state in ("determined", "weak")] or [p for _, p in there]
    sure += [one.common] if one.common else []
    ends = [end / factor for p in sure for end in p.ci95 or () if np.isfinite(end)]
    low, high = figures.limits([p.value / factor for p in sure], ends)
    ax.set_xlim(low, high)
    head = formula(own_symbol(one.name, one.springs))
    ax.set_title(f"{head} ({unit})" if unit else head, fontsize=7.5, pad=3)
    ax.set_label(one.name)
    ax.set_xlabel(one.kind, fontsize=6.5, labelpad=1, color=GREY)
    ax.tick_params(axis="x", labelsize=5.5, length=2, pad=1.5)
    ax.locator_params(axis="x", nbins=2, steps=[1, 2, 5, 10])
    ticks = [tick for tick in ax.get_xticks() if low <= tick <= high]
    if not roomy and len(ticks) > 2:
        ax.set_xticks(ticks[:: len(ticks) - 1])
    ax.grid(axis="y", color="0.9", lw=0.5)
    ax.set_axisbelow(True)
    _common(ax, one, there, factor)
    bars = [(y, *p.ci95) for y, p in there if p.ci95 is not None and np.all(np.isfinite(p.ci95))]
    if bars:
        y, left, right = np.array(bars).T
        ax.hlines(y, left / factor, right / factor, color=GREY, lw=0.9, label="95 % interval")
    size = 3.4 if len(tests) <= 25 else 2.4 if len(tests) <= MOST_ROWS else 1.4
    for state in () if one.kind in RATES else _MARKS:
        _points(ax, [(p.value / factor, y) for y, p in there if p.state == state], state, size)


def _points(ax: Axes, points: Sequence[tuple[float, int]], state: str, size: float) -> None:
    """Draw the values of one state; those beyond the panel as arrows at its edge."""
    edge, face, label = _MARKS[state]
    style: Any = {"color": edge, "mfc": face, "ls": "none", "ms": size, "mew": 0.8, "zorder": 4}
    low, high = ax.get_xlim()
    inside = [at for at in points if low <= at[0] <= high]
    if inside:
        ax.plot(*np.array(inside).T, "o", label=label, **style)
    for mark, end, sign in (("<", low, -1.0), (">", high, 1.0)):
        if at := [y for x, y in points if sign * (x - end) > 0.0]:
            ax.plot([end] * len(at), at, mark, clip_on=False, label=_BEYOND, **style)


def _common(
    ax: Axes, one: Compared, there: Sequence[tuple[int, ParameterEstimate]], factor: float
) -> None:
    """What the tests have in common: line and band, spread between specimens dashed."""
    line: dict[str, Any] = {"color": VERMILION, "lw": 1.0, "zorder": 2}
    if one.kind in RATES:
        ax.plot([p.value / factor for _, p in there], [y for y, _ in there], label="common", **line)
        return
    if one.common is None:
        return
    value = one.common.value / factor
    ax.axvline(value, label="common", **line)
    if one.common.ci95 is not None:
        band: dict[str, Any] = {"color": VERMILION, "alpha": 0.18, "lw": 0, "zorder": 1}
        ends = (end / factor for end in one.common.ci95)
        ax.axvspan(*ends, label="95 % interval of the common value", **band)
    for sign in (-1.0, 1.0) if one.scatter else ():
        edge = value * float(np.exp(sign * (one.scatter or 0.0)))
        ax.axvline(edge, **line | {"ls": (0, (3, 2)), "lw": 0.8}, label="spread between specimens")
