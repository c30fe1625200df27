"""Figures of a fit, of several loops, of the parameters of several tests and of a forward run.

A fit has the three panels of Figs. 3 and 4 of the paper, profiles of the cost, and pictures of the
snapped micro-springs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.cycles import cycles_of
from foamfit.errors import InputError
from foamfit.options import RATES
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, INSIDE, TWO, VERMILION
from foamfit.report.panels import Line, Panel, annotate, draw, draw_below, is_known, panels_of, size
from foamfit.report.render import ByTest, formula, symbols, unit_of_all
from foamfit.terminal import printable
from foamfit.text import readable_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from foamfit.parts import ParameterEstimate
    from foamfit.results import Fit, Loop, Profile
    from foamfit.solve.simulation import Response

MOST_NAMED = 12  # loops up to which a legend names all
# Typographic points: height of panels side by side, of stacked panels and of a residual strip.
HEIGHT, STACKED, STRIP = 127.0, 106.0, 40.0
# Room around a panel, above it if it has a title, between it and its strip, and for the legend.
LEFT, RIGHT, ABOVE, BELOW, TITLE, GAP, LEGEND = 53.0, 8.0, 6.0, 29.0, 12.0, 5.0, 18.0
ASIDE, BENEATH = 31.0, 16.0  # distance of the labels from the axes
MOST_WIDE = {0: 4.0, 1: 4.0, 2: 5.4, 3: 7.0}  # largest width in inches, by number of panels
INSTANTS = 7  # pictures of a foam
SNAPPED, STANDING = "#7FB2D9", "#E6EEF4"  # shades of the snapped part and of the rest of a spring
LEAST_PANEL, LETTER = 0.62, 0.052  # least width of a panel and width of a letter, inches
TALLEST, ROW, LOOPS_HIGH = 7.5, 0.17, 2.5  # heights of all panels, a row and the loops, inches
MOST_ROWS, MOST_LOOPS = 60, 24  # tests that are named, and whose loops are drawn
ROOMY = 0.8  # width of a panel with room for more numbers, inches
# Colours of edge and face of the marks.
_MARKS = {"determined": (BLUE, BLUE), "weak": (BLUE, "white"), "not determined": (GREY, "white")}
LOOP, WIDER = 159.0, 1.45  # prescribed motion: height of the loop, its width over that of others


def plot_fit(result: Fit, *, width: str = TWO) -> Figure:
    """Draw stress-time, displacement-time and stress-strain, measured and fitted, and residuals.

    Panels without a curve are omitted. If the motion is prescribed, the loop is large and the input
    is not drawn. `width` is "one" or "two" columns, or a length such as "85 mm"; ", untitled" after
    it omits the title. Panels that do not fit side by side are stacked, and few panels make a
    narrower figure.
    """
    name = printable(" ".join(result.measurement.name.split()))
    word = origin_word(result)
    more = [word] if word and word not in name.lower() else []
    more += [f"stopped by {result.stopped}"] if result.stopped else []
    title = " · ".join([name, result.law, f"{result.drive} drive", *more])
    add = partial(annotate, result)
    return panelled(panels_of(result), width, title, known=is_known(result), add=add)


def draw_panel(result: Fit, ax: Axes | None = None, what: str = "stress-strain") -> Axes:
    """Draw one panel of `plot_fit`, such as "stress-time", into axes or a new figure."""
    panels = {panel.name: panel for panel in panels_of(result)}
    if what not in panels:
        raise InputError(f"what = {what!r} is not admissible; this fit has {', '.join(panels)}")
    with figures.axes_or_new(ax) as ax:
        draw(ax, panels[what])
        wide, high = (72.0 * side / ax.figure.dpi for side in ax.bbox.size)
        annotate(result, ax, panels[what], (wide, high))
        ax.legend(loc="best", fontsize="small")
    return ax


def draw_loops(loops: Iterable[Loop], ax: Axes | None = None) -> Axes:
    """Draw loops, measured grey, fitted coloured from light to dark, into axes or a new figure."""
    import matplotlib

    shown = list(loops)
    # Of many loops, the legend names only the first and the last.
    named = range(len(shown)) if len(shown) <= MOST_NAMED else (0, len(shown) - 1)
    factor, unit = readable_unit(max((size(one.measured) for one in shown), default=0.0), "Pa")
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, max(len(shown), 1)))
    with figures.axes_or_new(ax) as ax:
        for place, (one, colour) in enumerate(zip(shown, colours, strict=False)):
            ax.plot(one.along, one.measured / factor, color="0.75", lw=2.0, label="_measured")
            if one.fitted is not None:
                label = one.name if place in named else f"_{one.name}"
                ax.plot(one.along, one.fitted / factor, color=colour, lw=0.9, label=label)
        ax.set(xlabel=shown[0].label if shown else "strain", ylabel=f"stress ({unit})")
        if shown:
            about = {"title": "fitted; measured grey", "title_fontsize": "small"}
            ax.legend(loc="best", fontsize="small", **about)
    return ax


def plot_response(
    response: Response, path: str | Path | None = None, *, width: str = TWO
) -> Figure:
    """Draw a forward run: base stress and displacements over time, stress over strain.

    With `path`, the figure is saved in the format of its suffix; for `width` see `plot_fit`.
    """
    time, stress, nodes = response.time, response.base_stress, response.displacement
    end = response.contact_end
    loop = time <= (np.inf if end is None else end)  # afterwards the striker flies freely
    # From the base up: light to dark grey, the top in the colour of simulated curves.
    shades = np.linspace(0.7, 0.35, max(len(nodes) - 1, 1))
    last = {"color": VERMILION, "lw": 1.3}
    moving = [
        Line(time, node, f"node {i}", {"color": str(shade), "lw": 1.0})
        for i, (node, shade) in enumerate(zip(nodes[:-1], shades, strict=False), start=1)
    ] + [Line(time, nodes[-1], "top", last)]
    pushed = [Line(time, stress, "_base stress", last)]
    looped = [Line(response.strain[loop], stress[loop], "_base stress", last)]
    panels = [
        Panel("stress-time", ("time", "s"), ("base stress", "Pa"), pushed),
        Panel("displacement-time", ("time", "s"), ("displacement", "m"), moving),
        Panel("stress-strain", ("overall strain", "–"), ("base stress", "Pa"), looped),
    ]

    def add(ax: Axes, panel: Panel, _: object) -> None:
        if end is not None and not panel.is_loop:
            style: Any = {"color": GREY, "lw": 0.6, "ls": (0, (2, 2))}
            ax.axvline(end / panel.scale()[0], label="end of contact", **style)

    return figures.save(panelled(panels, width, add=add), path)


def origin_word(result: Fit) -> str | None:
    """Return "reconstruction" or "synthetic" if the name or notes of the test contain it."""
    text = " ".join((result.measurement.name, *result.measurement.notes)).lower()
    match = re.search(r"\b(reconstruct|synthetic)", text)
    return match and {"reconstruct": "reconstruction"}.get(match[1], match[1])


def panelled(
    panels: list[Panel],
    width: str,
    *title: str,
    known: bool = False,
    add: Callable[[Axes, Panel, tuple[float, float]], object] = lambda *_: None,  # size in points
) -> Figure:
    """Draw panels above their strips and a legend; for a `known` motion the first is largest."""
    # Places are given, as finding them from all texts takes as long as drawing the figure.
    count = max(len(panels), 1)
    wide = min(figures.inches(width), MOST_WIDE[3 if known and count > 1 else min(len(panels), 3)])
    across = figures.abreast(wide, count)
    rows, parts = -(-count // across), [WIDER if known else 1.0, *[1.0] * (across - 1)]
    spans = [(72.0 * wide - RIGHT) * part / sum(parts) - LEFT for part in parts]
    tall = LOOP if known and across > 1 else HEIGHT if rows == 1 else STACKED
    below = GAP + STRIP if any(panel.below for panel in panels) else 0.0
    top = ABOVE + max((TITLE for panel in panels if panel.title), default=0.0)
    cell = top + tall + below + BELOW
    height, title = (rows * cell + LEGEND) / 72.0, figures.title(width, *title)
    with figures.drawing(wide, height, *title, layout=None) as figure:
        title_high = 72.0 * (figure.get_figheight() - height)
        axes = [figure.add_axes((0.0, 0.0, 1.0, 1.0)) for _ in range(count)]
        if not panels:
            figures.say_nothing_there(axes[0])
        places = list[Any]()
        for i, (ax, panel) in enumerate(zip(axes, panels, strict=False)):
            (row, column), high = divmod(i, across), tall
            x, y = (column + 1) * LEFT + sum(spans[:column]), title_high + row * cell + top
            draw(ax, panel)
            if panel.below:
                strip = figure.add_axes((0.0, 0.0, 1.0, 1.0))
                draw_below(ax, strip, panel)
                places.append((strip, x, y + tall + GAP, spans[column], STRIP))
            else:
                high += below
            places.append((ax, x, y, spans[column], high))
            add(ax, panel, (spans[column], high))
        figures.legend_below(figure, figure.axes)
        whole = 72.0 * figure.get_figheight()
        for ax, x, y, span, high in places:
            box = (x / 72.0 / wide, 1.0 - (y + high) / whole, span / 72.0 / wide, high / whole)
            ax.set_position(box)
            ax.yaxis.set_label_coords(-ASIDE / span, 0.5)
            ax.xaxis.set_label_coords(0.5, -BENEATH / high)
    return figure


def figures_of(result: Fit, width: str = TWO) -> dict[str, Figure]:
    """Return the figures of a result by name; `width` is that of "fit"."""
    others = {"snapping": plot_snapping(result), "profiles": plot_profiles(result)}
    drawn = {name: figure for name, figure in others.items() if figure is not None}
    return {"fit": plot_fit(result, width=width), **drawn}


def plot_profiles(result: Fit) -> Figure | None:
    """Draw each profile of the cost with 95 % threshold and interval; None without a profile."""
    panels = list[Panel]()
    for one in result.profiles:
        estimate = result.parameters[one.name]
        name = one.name if one.complete else f"{one.name}, stopped"
        lines = _profile_lines(one, estimate.stderr)
        panels.append(Panel(one.name, (name, estimate.unit), ("rise of χ²", ""), lines))
    return panelled(panels, TWO) if panels else None


def _profile_lines(profile: Profile, stderr: float | None) -> list[Line]:
    """Return interval, threshold, parabola and cost, up to twice the threshold."""
    values, rises, ends = profile.values, profile.rises, np.array(profile.ci95)
    top, best = 2.0 * profile.cut, float(values[np.argmin(rises)])
    fine = np.linspace(values.min(), values.max(), 200)
    root = np.sign(values - best) * np.sqrt(np.maximum(rises, 0.0))
    parabola = ((fine - best) / (stderr or np.nan)) ** 2
    threshold = np.full_like(fine, profile.cut)
    dots: dict[str, Any] = {"marker": "o", "ls": "none", "ms": 2.2, "color": BLUE}
    lines = [
        Line(fine, threshold, "95 % threshold", {"color": GREY, "lw": 0.6, "ls": (0, (2, 2))}),
        Line(fine, parabola, "local covariance", {"color": GREY, "lw": 0.8, "ls": "--"}),
        Line(fine, np.interp(fine, values, root) ** 2, "lowest cost, all others refitted",
             {"color": BLUE, "lw": 1.1}),
        Line(values, rises, "_samples", dots),
        Line(np.array([best]), np.zeros(1), "best fit", dots | {"color": VERMILION, "ms": 3.5}),
    ]  # fmt: skip
    shown = (replace(one, y=np.where(one.y <= top, one.y, np.nan)) for one in lines)
    shade: dict[str, Any] = {"color": "0.92", "lw": 0.0}
    band = Line(ends, np.zeros(2), "95 % interval", shade, high=np.full(2, top))
    return [band, *(one for one in shown if np.isfinite(one.y).any())]


def plot_snapping(result: Fit) -> Figure | None:
    """Draw the snapped fractions over time, and the chain at a few instants; None if unknown."""
    snapping, time, strain = result.snapping, result.curves.time, result.strain
    if not snapping or time is None or strain is None:
        return None
    # The instants are evenly spaced along the motion of the first cycle.
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
        figures.legend_below(figure, [below])
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
        label = f"{number}: {round(100 * float(overall[sample]))} %"
        ax.annotate(label, (number, floor), (0, 3), textcoords="offset points", ha="center")
    ax.set(ylim=(0.0, 1.25), xlim=(0.4, len(at) + 0.6))
    ax.set_title("shaded: snapped fraction; numbers: strain", loc="left", fontsize=7.5)
    ax.set_axis_off()


@dataclass(frozen=True)
class Values:
    """One parameter of several tests, and the values it is compared with."""

    name: str
    head: str  # symbol
    tests: dict[str, ParameterEstimate]
    references: dict[str, ParameterEstimate] = field(default_factory=dict)  # other ones, by test
    joint: ParameterEstimate | None = None  # in a joint fit of the tests

    @property
    def common(self) -> ParameterEstimate | None:
        """The value common to all tests, if there is one."""
        return self.joint if self.joint and self.joint.kind in ("shared", "scatter") else None

    @property
    def has_law(self) -> bool:
        """Whether the parameter follows a rate law."""
        return self.joint is not None and self.joint.kind in RATES


def values_of(tests: Sequence[str], parameters: ByTest) -> list[Values]:
    """Return a panel for each parameter, given its value, or None, in each test."""
    out = list[Values]()
    for name, own in symbols(parameters).items():
        known = {t: p for t, p in zip(tests, parameters[name], strict=True) if p is not None}
        out.append(Values(name, formula(own), known))
    return out


def plot_parameters(
    title: str,
    tests: Sequence[str],
    panels: Sequence[Values],
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
    heights = [LOOPS_HIGH if loops else 0.0, rows * tall]
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
            _draw_panel(ax, panel, tests, (wide - margin) / across > ROOMY)
            ax.tick_params(axis="y", length=0, labelsize=size)
        axes[0].set_ylim(count - 0.4, -0.6)
        axes[0].set_yticks(range(0, count, step), names, parse_math=False)
        if not panels:
            figures.say_nothing_there(axes[0], "no parameter to compare")
        figures.legend_below(figure, axes, first=_MARKS)
    return figure


def _draw_panel(ax: Axes, panel: Values, tests: Sequence[str], roomy: bool) -> None:
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
    if (joint := panel.joint) is not None:
        slope = "" if joint.b is None else f", b = {joint.b:.2g}".replace("-", "−")
        ax.set_xlabel(f"{joint.kind}{slope}", fontsize=6.5, labelpad=1, color=GREY)
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


def _draw_others(ax: Axes, panel: Values, tests: Sequence[str], factor: float) -> None:
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
