"""The picture of a joint fit: the loop of each test, and what each parameter is to the tests."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.fitting.links import RATES, law_values
from foamfit.report import figures
from foamfit.report.figures import BLUE, TWO, VERMILION
from foamfit.report.readable import in_unit, own_name, readable_unit
from foamfit.springs.parameters import NUISANCE
from foamfit.text import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.arrays import Array
    from foamfit.study.joint_result import JointData

# Columns of the picture, and inches of a loop and of a parameter.
LOOPS, LOOP, COLUMNS, PANEL = 6, (1.25, 1.15), 3, (2.5, 1.6)
LEAST_LOOP, LEAST_PANEL, LEAST_TABLE = 1.05, 1.55, 2.1  # in
MEASURED = "0.65"  # wide and light below what is fitted, which is darker in grey too
MOST_LOOPS = 48
MOST_NAMES = 12  # of tests that stand at an axis
# Largest over smallest rate from which on the tests stand by rate though nothing follows a law of
# it: the rates of twins under one programme of the machine differ by some percent.
SEVERAL_RATES = 1.5
# Points of a drawn curve, and the share of the largest range that intervals may run out of.
POINTS = 400


def plot_joint(found: JointData, *, width: str = TWO) -> Figure:
    """Draw the loop of each test and every parameter by test, or by rate where there are several.

    Bars are 95 % intervals; a hollow mark is a test that does not determine the parameter well. The
    line is what the tests have in common: a value, a law of rate, a common value with its spread
    between specimens. `width` is "one" or "two" columns, or a length such as "85 mm".
    """
    shown = _shown(found)
    names = [
        name for name, one in found.parameters.items()
        if one.kind not in ("fixed", "shared") and name not in NUISANCE
    ]  # fmt: skip
    shared = [n for n, one in found.parameters.items() if one.kind == "shared"]
    panels, wide = len(names) + bool(shared), figures.inches(width)
    across = figures.abreast(wide, min(LOOPS, max(len(shown), COLUMNS)), LEAST_LOOP)
    columns = figures.abreast(wide, COLUMNS, LEAST_PANEL)
    rows, low = -(-len(shown) // across), -(-panels // columns)
    heights = [rows * LOOP[1], low * PANEL[1]]
    more = f"; {len(shown)} of {len(found.tests)} drawn" if len(shown) < len(found.tests) else ""
    lines = figures.title_lines(
        wide,
        f"{found.study.name} · {found.study.model} · {len(found.tests)} tests together",
        f"loops: measured grey and wide, fitted blue and thin{more}; below: 95 % intervals by "
        "test, hollow if not well determined; lines: in common",
    )
    with figures.drawing(wide, sum(heights) + 0.2 + 0.13 * len(lines), lines) as figure:
        top, bottom = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)[:, 0]
        most = int(72.0 * wide / across / 4.2)  # letters of a name
        loops = top.subplots(rows, across, squeeze=False).ravel().tolist()
        _draw_loops(loops, found, shown, most)
        axes = bottom.subplots(low, columns, squeeze=False).ravel().tolist()
        narrow = wide / columns < LEAST_TABLE
        for ax, name in zip(axes, names, strict=False):
            _parameter(ax, found, name, parted=narrow)
        for ax in axes[len(names) :]:
            ax.set_axis_off()
        if shared:
            _list(axes[len(names)], found, shared, stacked=narrow)
    return figure


def _shown(found: JointData) -> list[int]:
    """Tests whose loops are drawn, by rate where they have several: all, or some at equal steps."""
    rates = found.rates if by_rate(found) else [0.0] * len(found.tests)
    order = sorted(range(len(found.tests)), key=lambda t: (rates[t] or 0.0, t))
    places = np.unique(np.linspace(0, len(order) - 1, min(MOST_LOOPS, len(order))).astype(int))
    return [order[place] for place in places]


def _draw_loops(axes: list[Axes], found: JointData, shown: list[int], most: int) -> None:
    """Draw the loop of each test that is shown; names have so many letters at most."""
    tests = found.measurements
    top = max(float(np.max(t.stress)) for t in tests if t.stress is not None)
    factor, unit = readable_unit(top, "Pa")
    for ax, t in zip(axes, shown, strict=False):
        problem, test = found.problems[t], tests[t]
        curves = problem.objective.simulate(found.fit.found.values[t], everything=True).curves
        along, fitted, label = _along(found, t, curves)
        if along is None or test.stress is None:
            continue
        step = max(along.size // POINTS, 1)
        seen = along[::step]
        ax.plot(seen, test.stress[::step] / factor, color=MEASURED, lw=1.5, label="_measured")
        if fitted is not None:
            ax.plot(seen, fitted[::step] / factor, color=BLUE, lw=0.7, label="_fitted")
        ax.set_label(found.tests[t])
        rate = found.rates[t] if by_rate(found) else None
        told = found.tests[t] if rate is None else f"{found.tests[t]}, {rate:.2g}/s"
        ax.set_title(told if len(told) <= most else f"…{told[-most + 1 :]}", fontsize=6)
        ax.tick_params(labelsize=5.5, length=2, pad=1.5)
        ax.locator_params(nbins=3)
        ax.set_xlabel(label, fontsize=6, labelpad=1, visible=t == shown[0])
        ax.set_ylabel(f"stress ({unit})", fontsize=6, labelpad=1, visible=t == shown[0])
    for ax in axes[len(shown) :]:
        ax.set_axis_off()


def by_rate(found: JointData) -> bool:
    """Whether the tests stand by rate: something follows a law of it, or there are several."""
    rates = [rate for rate in found.rates if rate]
    if found.rate0 is None or min(rates) == max(rates):
        return False
    if any(one.kind in RATES for one in found.parameters.values()):
        return True
    return len(rates) == len(found.rates) and max(rates) > SEVERAL_RATES * min(rates)


def _marks(tests: Sequence[str]) -> list[str]:
    """What the names of the tests differ in where that is short, else their numbers."""
    before, after = _alike(tests), _alike([name[::-1] for name in tests])
    marks = [name[before : len(name) - after] for name in tests]
    short = all(0 < len(mark) <= 4 for mark in marks)
    return marks if short else [str(t) for t in range(1, len(tests) + 1)]


def _alike(names: Sequence[str]) -> int:
    """How many letters names begin with alike, up to the number that they differ in."""
    letters = takewhile(lambda at: len(set(at)) == 1, zip(*names, strict=False))
    return len("".join(at[0] for at in letters).rstrip("0123456789"))


def _along(
    found: JointData, t: int, curves: dict[str, Array]
) -> tuple[Array | None, Array | None, str]:
    """What a stress is drawn against, the fitted stress, and the name of the axis."""
    test = found.measurements[t]
    if test.displacement is not None and "stress_strain" in curves:
        return test.displacement / test.specimen.height, curves["stress_strain"], "strain"
    return test.time, curves.get("stress_time"), "time (s)"


def _parameter(ax: Axes, found: JointData, name: str, *, parted: bool) -> None:
    """One parameter by test, or by rate; its title in two lines if `parted`."""
    one = found.parameters[name]
    rated = by_rate(found)
    factor, unit = readable_unit(abs(one.value), one.unit)
    x = np.array(found.rates, dtype=float) if rated else np.arange(1.0, len(found.tests) + 1)
    told = f"{own_name(name, found.study.model)}{f' ({unit})' if unit else ''}:"
    ax.set_title(f"{told}\n{one.kind}" if parted else f"{told} {one.kind}")
    ax.set_label(f"{told} {one.kind}")
    tests = one.tests or {}
    points = [(at, tests[test]) for at, test in zip(x, found.tests, strict=True) if test in tests]
    points = [(at, value) for at, value in points if value.state != "fixed"]
    size = 0.0 if one.kind in RATES else 3.5 if len(found.tests) < 60 else 1.5
    values, ends = figures.draw_estimates(ax, points, factor, size)
    if rated:
        ax.set_xscale("log")
        ax.set_xlabel("strain rate (1/s)", labelpad=1)
        if np.nanmax(x) < 10.0 * np.nanmin(x):  # no two powers of ten, and minor labels overlap
            ticks = np.geomspace(np.nanmin(x), np.nanmax(x), 3)
            ax.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
            ax.minorticks_off()
    else:
        ax.set_xlabel("test", labelpad=1)
        if len(x) <= MOST_NAMES:
            ax.set_xticks(x, _marks(found.tests))
    _common(ax, found, name, x, factor)
    if values and one.kind not in RATES:
        figures.limit(ax, values, ends)


def _common(ax: Axes, found: JointData, name: str, x: Array, factor: float) -> None:
    """What the tests have in common: line and 95 % band, spread between specimens dashed."""
    one = found.parameters[name]
    if one.kind == "own":
        return
    span = np.array([np.nanmin(x), np.nanmax(x)])
    if one.kind in RATES and one.b is not None and found.rate0 is not None:
        span = np.geomspace(span[0], span[1], 50)
        values = law_values(one.kind, one.value, one.b, np.log(span / found.rate0))
        ax.plot(span, values / factor, color=VERMILION, linewidth=1.0, label="_law of rate")
        told = f"b = {one.b:.3g}"
        if one.b_ci95 is not None:
            told += f" ({one.b_ci95[0]:.3g} to {one.b_ci95[1]:.3g})"
        _say(ax, told, below=one.b > 0.0)
        return
    style: dict[str, Any] = {"color": VERMILION, "zorder": 0}
    ax.plot(span, [one.value / factor] * 2, linewidth=1.0, label="_in common", **style)
    if one.ci95 is not None:
        low, high = (end / factor for end in one.ci95)
        ax.fill_between(
            span, low, high, alpha=0.18, linewidth=0, label="_95 % interval in common", **style
        )
    if one.scatter:
        for sign in (-1.0, 1.0):
            edge = one.value * np.exp(sign * one.scatter) / factor
            label = "_spread between specimens"
            ax.plot(span, [edge] * 2, "--", linewidth=0.7, label=label, **style)
        _say(ax, f"spread {percent(one.scatter)}")


def _list(ax: Axes, found: JointData, names: list[str], *, stacked: bool) -> None:
    """Write the values that all tests share, side by side or `stacked` below their names."""
    lines = [["shared by all tests", "", ""]]
    for name in names:
        one = found.parameters[name]
        widths = [ends[1] - ends[0] for ends in (one.ci95, one.range) if ends is not None]
        half = 0.5 * max(widths, default=0.0)  # what its state goes by
        error = f"±{percent(half / abs(one.value))}" if half and one.value else ""
        error += f" {one.state or ''}" if one.state != "determined" else ""
        value = in_unit((one.value,), one.unit)
        if stacked:
            lines += [[own_name(name, found.study.model), "", ""], [f"   {value} {error}", "", ""]]
        else:
            lines.append([own_name(name, found.study.model), value, error])
    size = min(7.0, 90.0 / len(lines))
    for column, x in ((0, 0.0), (1, 0.42), (2, 0.78)):
        told = "\n".join(line[column] for line in lines)
        ax.text(x, 1.0, told, transform=ax.transAxes, va="top", fontsize=size, linespacing=1.5)


def _say(ax: Axes, told: str, *, below: bool = False) -> None:
    y, side = (0.05, "bottom") if below else (0.97, "top")
    ax.text(0.98, y, told, transform=ax.transAxes, ha="right", va=side, fontsize=6.5)
