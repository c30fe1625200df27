"""Figures of a fit and of a forward run: the three panels of Figs. 3 and 4 of the paper."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, INSIDE, TWO, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.terminal import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.results import Fit, Loop
    from foamfit.solve.simulation import Response

# Points at which a spring changes between two branches, in either order.
POINTS = {"ad": "A1", "da": "A1", "dc": "C1", "ce": "C2", "ec": "C2", "ea": "A2"}
# Preferred offset of the name of a switching point, in typographic points.
IN_LOOP = {"A1": (-4, 5), "C1": (-5, 3), "C2": (5, -3), "A2": (4, -7), "σ₊": (-4, 5), "σ₋": (5, -5)}
IN_TIME = {"A1": (5, -4), "C1": (-5, 3), "C2": (5, 3), "A2": (5, 4), "σ₊": (5, -4), "σ₋": (5, 4)}
# The same for branches whose name is not at the upper left.
BESIDE = {"c": (7.0, -3.0), "e": (4.0, -7.0), "snap-back": (7.0, -6.0)}
# Position of the name along an elastic branch, as a fraction of its length, and its offset.
LIGHT = {"a": (0.9, (-4.0, 3.0)), "c": (0.5, (5.0, -4.0))}
MARKERS = 60  # markers on a measured curve; more would merge
PALE = "#A6CEE3"
MOST_NAMED = 12  # loops up to which a legend names all
STOOD = "#F2DC6B"  # standstill of the gauge
# Dashes and marks of interior masses, from the base up, distinguishable without colour.
DASHES: Any = ((0, (5, 1.2)), (0, (2.5, 1.2)), (0, (1, 1)), (0, (5, 1.2, 1, 1.2)))
MARKS = ("^", "v", "D", "p")
# Typographic points: height of panels side by side, of stacked panels and of a residual strip.
HEIGHT, STACKED, STRIP = 133.0, 112.0, 40.0
BESIDE_IT, BELOW_IT, AROUND = 31.0, 26.0, 39.0  # room for labels, and for title and legend
MOST_WIDE = {0: 4.0, 1: 4.0, 2: 5.4, 3: 7.0}  # largest width in inches, by number of panels
LOOP, WIDER = 165.0, 1.45  # prescribed motion: height of the loop, its width over that of others


def plot_fit(result: Fit, path: str | Path | None = None, *, width: str = TWO) -> Figure:
    """Draw stress-time, displacement-time and stress-strain, measured and fitted, and residuals.

    Panels without a curve are omitted. If the motion is prescribed, the loop is large and the input
    is not drawn. `width` is "one" or "two" columns, or a length such as "85 mm"; ", untitled" after
    it omits the title. Panels that do not fit side by side are stacked, and few panels make a
    narrower figure. With `path`, the figure is saved in the format of its suffix.
    """
    panels = _panels(result)
    with _panelled(panels, width, residuals=True, known=is_known(result)) as (figure, axes, sizes):
        for ax, panel, size in zip(axes, panels, sizes, strict=False):
            _annotate(ax, panel, result, size)
        _head(figure, result, titled=figures.is_titled(width))
    return figures.save(figure, path)


def draw_panel(result: Fit, ax: Axes | None = None, what: str = "stress-strain") -> Axes:
    """Draw one panel of `plot_fit` into axes or a new figure; return the axes.

    `what` is "stress-strain", "stress-time" or "displacement-time".
    """
    panels = {panel.key.replace("_", "-"): panel for panel in _panels(result)}
    if what not in panels:
        raise InputError(f"what = {what!r} is not admissible; this fit has {', '.join(panels)}")
    with figures.axes_or_new(ax) as ax:
        _draw(ax, panels[what])
        wide, high = (72.0 * side / ax.figure.dpi for side in ax.bbox.size)
        _annotate(ax, panels[what], result, (wide, high))
        ax.legend(loc="best", fontsize="small")
    return ax


def draw_loops(loops: Iterable[Loop], ax: Axes | None = None) -> Axes:
    """Draw the loops of several tests into axes or a new figure; return the axes.

    Measured curves are grey and wide, fitted ones thin and coloured from light to dark. If there
    are many, the legend names only the first and the last.
    """
    import matplotlib

    shown = list(loops)
    factor, unit = readable_unit(max((_size(one.measured) for one in shown), default=0.0), "Pa")
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, max(len(shown), 1)))
    with figures.axes_or_new(ax) as ax:
        for place, (one, colour) in enumerate(zip(shown, colours, strict=False)):
            ax.plot(one.along, one.measured / factor, color="0.75", lw=2.0, label="_measured")
            if one.fitted is not None:
                named = len(shown) <= MOST_NAMED or place in (0, len(shown) - 1)
                label = one.name if named else f"_{one.name}"
                ax.plot(one.along, one.fitted / factor, color=colour, lw=0.9, label=label)
        ax.set(xlabel=shown[0].label if shown else "strain", ylabel=f"stress ({unit})")
        if shown:
            ax.legend(
                loc="best", fontsize="small", title="fitted; measured grey", title_fontsize="small"
            )
    return ax


def plot_response(
    response: Response, path: str | Path | None = None, *, width: str = TWO
) -> Figure:
    """Draw a forward run: base stress and displacements over time, stress over strain.

    For `path` and `width` see `plot_fit`.
    """
    time, stress, nodes = response.time, response.base_stress, response.displacement
    end = response.contact_end
    loop = time <= (np.inf if end is None else end)  # afterwards the striker flies freely
    # From the base up: light to dark grey, the top in the colour of simulated curves.
    shades = np.linspace(0.7, 0.35, max(len(nodes) - 1, 1))
    last = {"color": VERMILION, "lw": 1.3}
    moving = [
        _Line(time, node, f"node {i}", {"color": str(shade), "lw": 1.0})
        for i, (node, shade) in enumerate(zip(nodes[:-1], shades, strict=False), start=1)
    ] + [_Line(time, nodes[-1], "top", last)]
    pushed = [_Line(time, stress, "_base stress", last)]
    looped = [_Line(response.strain[loop], stress[loop], "_base stress", last)]
    panels = [
        _Panel("stress_time", "time", "s", "base stress", "Pa", pushed),
        _Panel("displacement_time", "time", "s", "displacement", "m", moving),
        _Panel("stress_strain", "overall strain", "–", "base stress", "Pa", looped),
    ]
    with _panelled(panels, width) as (figure, axes, _):
        if end is not None:
            at = end / panels[0].scale()[0]
            for ax in axes[:2]:
                ax.axvline(at, color=GREY, lw=0.6, ls=(0, (2, 2)), label="end of contact")
        figures.legend_below(figure, figures.named_in(axes))
    return figures.save(figure, path)


def origin_word(result: Fit) -> str | None:
    """Return "reconstruction" or "synthetic" if the name or notes of the test contain it."""
    text = " ".join((result.measurement.name, *result.measurement.notes)).lower()
    match = re.search(r"\b(reconstruct|synthetic)", text)
    return match and {"reconstruct": "reconstruction"}.get(match[1], match[1])


def is_known(result: Fit) -> bool:
    """Return whether the motion is prescribed and no interior masses are compared."""
    return result.drive == "displacement" and not result.curves.interior


# ------------------------------------------------------------------------------- the panels


@dataclass(frozen=True)
class _Line:
    """A curve of a panel in SI; `residual` of a measured one is in % of its range."""

    x: Array
    y: Array
    label: str
    style: dict[str, Any]
    kind: Literal["measured", "fitted", "other"] = "other"
    node: int = 0  # interior mass, 0 = top
    residual: Array | None = None


@dataclass(frozen=True)
class _Panel:
    key: str
    x_name: str
    x_unit: str
    y_name: str
    y_unit: str
    lines: list[_Line]

    @property
    def is_loop(self) -> bool:
        return self.key == "stress_strain"

    @property
    def fitted(self) -> _Line | None:
        """The fitted curve of the top."""
        return next((one for one in self.lines if one.kind == "fitted" and not one.node), None)

    def scale(self) -> tuple[float, str, float, str]:
        """Return factor and axis label of x, then of y."""
        x, x_unit = readable_unit(max(_size(line.x) for line in self.lines), self.x_unit)
        y, y_unit = readable_unit(max(_size(line.y) for line in self.lines), self.y_unit)
        return x, f"{self.x_name} ({x_unit})", y, f"{self.y_name} ({y_unit})"


def _panels(result: Fit) -> list[_Panel]:
    c, height = result.curves, result.measurement.specimen.height
    # The fitted loop needs the prescribed curve, which may exist only as the measured one.
    pushed = c.measured_stress if result.drive == "stress" and c.stress is None else c.stress
    moved = c.displacement
    if result.drive == "displacement" and moved is None:
        moved = c.measured_displacement
    strain = None if c.measured_displacement is None else c.measured_displacement / height
    motion = result.measurement.motion or "measured"

    def compared(curve: str, fitted: Array | None) -> Array | None:
        return None if result.misfit.get(curve) is None else fitted

    fitted = compared("stress_time", c.stress)
    pushing = _measured(c.time, c.measured_stress, fitted) + _fitted(c.time, c.stress)
    fitted = compared("displacement_time", c.displacement)
    moving = _measured(c.time, c.measured_displacement, fitted, motion)
    moving += _fitted(c.time, c.displacement)
    for node, (measured, fitted) in c.interior.items():
        moving += _measured(c.time, measured, fitted, node=node) + _fitted(c.time, fitted, node)
    loop = _measured(strain, c.measured_stress, compared("stress_strain", c.stress_along), motion)
    loop += _fitted(None if moved is None else moved / height, pushed)
    if strain is not None and c.stress_along is not None and not is_known(result):
        # Wide and pale below the others, because it coincides with them if the fit is good.
        pale = {"color": PALE, "lw": 3.2, "zorder": 2}
        loop.append(_Line(strain, c.stress_along, "springs along measured strain", pale))
    panels = [
        _Panel("stress_time", "time", "s", "stress", "Pa", pushing),
        _Panel("displacement_time", "time", "s", "displacement", "m", moving),
        _Panel("stress_strain", "strain", "–", "stress", "Pa", loop),
    ]
    if is_known(result):
        panels = [panels[2], panels[0]]
    return [panel for panel in panels if panel.lines]


def _measured(
    x: Array | None, y: Array | None, fitted: Array | None, motion: str = "measured", node: int = 0
) -> list[_Line]:
    if x is None or y is None:
        return []
    label, mark, edge = "measured", "o", "0.6"
    if node:
        mark, edge = MARKS[(node - 1) % len(MARKS)], INSIDE[(node - 1) % len(INSIDE)]
        label = f"_measured, mass {node}"
    elif motion != "measured":
        label, mark = f"measured, motion {motion}", "s"
    style = {"marker": mark, "mfc": "white", "mec": edge, "mew": 0.6, "ms": 3.4, "zorder": 3}
    residual = None if fitted is None else 100.0 * (fitted - y) / (float(np.ptp(y)) or 1.0)
    return [_Line(x, y, label, style, "measured", node, residual)]


def _fitted(x: Array | None, y: Array | None, node: int = 0) -> list[_Line]:
    if x is None or y is None:
        return []
    style = {"ls": DASHES[(node - 1) % len(DASHES)] if node else "-", "lw": 0.9, "zorder": 4}
    label = f"mass {node}" if node else "fitted"
    return [_Line(x, y, label, style | {"color": _colour(node)}, "fitted", node)]


def _colour(node: int) -> str:
    return INSIDE[(node - 1) % len(INSIDE)] if node else VERMILION


@contextmanager
def _panelled(
    panels: list[_Panel], width: str, *, residuals: bool = False, known: bool = False
) -> Iterator[tuple[Figure, list[Axes], list[tuple[float, float]]]]:
    """Yield a figure with its panels drawn, their axes, and their approximate sizes in points.

    Residuals are drawn below the panels if wanted; for a `known` motion the first panel is largest.
    """
    count = max(len(panels), 1)
    wide = min(figures.inches(width), MOST_WIDE[3 if known and count > 1 else len(panels)])
    across = figures.abreast(wide, count)
    rows, every = -(-count // across), 2 if residuals else 1
    parts = [WIDER if known else 1.0, *[1.0] * (across - 1)]
    spans = [72.0 * wide * part / sum(parts) - BESIDE_IT for part in parts]
    tall = LOOP if known and across > 1 else HEIGHT if rows == 1 else STACKED
    heights = [tall, STRIP][:every] * rows
    height = (sum(heights) + rows * BELOW_IT + AROUND) / 72.0
    with figures.drawing(wide, height) as figure:
        ratios = {"width_ratios": parts, "height_ratios": heights}
        grid = figure.subplots(every * rows, across, squeeze=False, gridspec_kw=ratios)
        axes, below = grid[::every].ravel().tolist(), grid[1::every].ravel().tolist()
        for ax in [*axes[len(panels) :], *below[len(panels) :]]:
            ax.set_axis_off()
        if not panels:
            figures.say_nothing_there(axes[0])
        sizes = [(span, tall) for span in spans * rows]
        for i, (ax, panel) in enumerate(zip(axes, panels, strict=False)):
            ax.set_label(panel.key.replace("_", "-"))
            _draw(ax, panel)
            if residuals and any(line.residual is not None for line in panel.lines):
                _draw_residuals(ax, below[i], panel)
            elif residuals:  # the panel fills their place
                below[i].remove()
                at = ax.get_subplotspec().rowspan.start
                ax.set_subplotspec(ax.get_gridspec()[at : at + 2, i % across])
                sizes[i] = (sizes[i][0], tall + STRIP)
        yield figure, axes, sizes
        figure.align_ylabels()


def _draw(ax: Axes, panel: _Panel) -> None:
    fx, x_label, fy, y_label = panel.scale()
    for line in panel.lines:
        x, y, style = line.x / fx, line.y / fy, line.style
        if line.kind == "measured":
            label = f"_{line.label.removeprefix('_')}, all samples"
            ax.plot(x, y, color="0.82", lw=0.5, zorder=1, label=label)
            marked = _evenly(x, y, MARKERS)
            x, y, style = x[marked], y[marked], {"ls": "none", **style}
        ax.plot(x, y, label=line.label, **style)
    ax.set(xlabel=x_label, ylabel=y_label)
    ax.margins(0.05, 0.11)


def _draw_residuals(ax: Axes, strip: Axes, panel: _Panel) -> None:
    """Draw fitted minus measured below a panel, in percent of the measured range."""
    for line in panel.lines:
        if line.residual is not None:
            style: Any = {"color": _colour(line.node), "lw": 0.7, "label": "_fitted − measured"}
            strip.plot(line.x / panel.scale()[0], line.residual, **style)
    strip.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    strip.set(xlabel=ax.get_xlabel(), label=f"{ax.get_label()}, residual")
    strip.set_ylabel("residual\n(% of range)", fontsize=7)
    strip.sharex(ax)
    ax.set_xlabel("")
    ax.tick_params(labelbottom=False)


def _evenly(x: Array, y: Array, n: int) -> NDArray[np.intp]:
    """Return up to `n` samples, evenly spaced along the curve (not in time)."""
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if finite.size <= n:
        return finite
    dx, dy = (np.diff(v[finite]) / (np.ptp(v[finite]) or 1.0) for v in (x, y))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(dx, dy))))
    return finite[np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], n)))]


def _annotate(ax: Axes, panel: _Panel, result: Fit, size: tuple[float, float]) -> None:
    """Add everything except the curves to a panel of about this size in points."""
    _mark_outliers(ax, panel, result)
    _shade_standstills(ax, panel, result)
    labels = _Labels(ax, panel, size)
    if panel.is_loop:
        _draw_law(labels, result)
    _mark_switches(labels, panel, result)
    if panel.is_loop:
        _name_branches(labels, panel, result)


def _mark_outliers(ax: Axes, panel: _Panel, result: Fit) -> None:
    """Mark outliers, which are not fitted, with crosses; at the edge if beyond the panel."""
    test = result.measurement
    fx, _, fy, _ = panel.scale()
    own = "displacement" if panel.key == "displacement_time" else "stress"
    for channel, found in test.outliers.items():
        x, motion = found.at, test.displacement
        if not channel.startswith(own) or not x.size:
            continue
        if panel.is_loop and motion is not None:
            time = np.arange(motion.size) if test.time is None else test.time
            x = np.interp(x, time, motion) / test.specimen.height
        elif panel.is_loop or test.time is None:
            continue
        low, high = ax.get_ylim()  # fixed, so that an outlier does not shrink the curves
        style: Any = {"ms": 4.0, "mew": 1.0, "color": "black", "zorder": 6, "clip_on": False}
        y = np.clip(found.values / fy, low, high)
        ax.plot(x / fx, y, "x", label="outlier, not fitted", **style)
        ax.set_ylim(low, high)


def _shade_standstills(ax: Axes, panel: _Panel, result: Fit) -> None:
    """Shade standstills of the gauge: a span of time, or a part of the measured loop."""
    test = result.measurement
    fx, _, fy, _ = panel.scale()
    style: Any = {"color": STOOD, "zorder": 0.5, "label": "gauge stands still, bridged"}
    for start, end in test.standstills:
        if not panel.is_loop:
            ax.axvspan(start / fx, end / fx, lw=0.0, **style)
            continue
        for line in panel.lines:
            instants = np.arange(line.x.size) if test.time is None else test.time
            if line.kind == "measured":
                at = (instants >= start) & (instants <= end)
                ax.plot(line.x[at] / fx, line.y[at] / fy, lw=7.0, solid_capstyle="butt", **style)


# ---------------------------------------------------------------------------- names in a panel


class _Labels:
    """Placement of names in a panel, away from other names, curves and marks."""

    def __init__(self, ax: Axes, panel: _Panel, size: tuple[float, float]) -> None:
        """Initialise for a panel of about this size in typographic points."""
        self.ax, (self.fx, _, self.fy, _) = ax, panel.scale()
        self.corner, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
        self.size, self.scale = size, np.array(size) / (high - self.corner)  # points per unit
        self.drawn = [np.empty((0, 2))]  # points that names should not cover
        for line in panel.lines:
            if line.kind == "fitted":
                seen = _evenly(line.x, line.y, 4 * MARKERS)
                self.drawn.append(np.column_stack((line.x / self.fx, line.y / self.fy))[seen])
        self.taken: list[Array] = []

    def mark(self, name: str, places: Array) -> None:
        """Draw dots, which names should not cover, at places (n, 2) in the units of the axes."""
        self.ax.plot(*places.T, "o", ms=3.2, color="black", zorder=5, label=f"_{name}")
        self.drawn += [places, places]

    def write(
        self,
        name: str,
        places: Sequence[Array],
        wanted: tuple[float, float],
        *,
        stay: bool = False,
        **style: Any,
    ) -> None:
        """Write a name near one of `places`, offset by `wanted` points or where it covers least.

        Earlier places are preferred. With `stay` the name stays on the wanted side.
        """
        avoid = (np.concatenate(self.drawn) - self.corner) * self.scale
        x, y = wanted
        sides = [(x, y)] if stay else [(x, y), (-x, -y), (x, -y), (-x, y)]
        candidates = []
        for place, far, (dx, dy) in product(range(len(places)), (1.0, 2.5, 4.0), sides):
            size = np.array([4.2 * len(name), 9.0])
            left = dx - (size[0] if dx < 0 else 0.0)
            low = (places[place] - self.corner) * self.scale + (left, far * dy - 0.5 * size[1])
            high = low + size
            names = sum(bool(np.all((low < b[2:]) & (b[:2] < high))) for b in self.taken)
            beyond = bool(np.any((low < 0.0) | (high > self.size)))
            inside = int(np.all((avoid > low) & (avoid < high), axis=1).sum())
            cost = 1000 * names + 50 * beyond + inside + 2.0 * far + 3.0 * place
            candidates.append((cost, places[place], (dx, far * dy), np.concatenate((low, high))))
        _, at, offset, box = min(candidates, key=lambda one: one[0])
        self.taken.append(box)
        side = "left" if offset[0] > 0 else "right"
        style |= {"ha": side, "va": "center", "zorder": 6, "annotation_clip": False}
        back = {"fc": "white", "alpha": 0.75, "lw": 0.0, "pad": 0.5}
        self.ax.annotate(
            name, (at[0], at[1]), offset, textcoords="offset points", bbox=back, **style
        )


def _mark_switches(labels: _Labels, panel: _Panel, result: Fit) -> None:
    """Mark the switches of the springs, and name each kind of switch once."""
    at: dict[str, list[tuple[float, float]]] = {}
    for spring, point, x, y in _points(panel, result):
        name = f"{spring} {point}" if len(result.chain.springs) > 1 else point
        at.setdefault(name, []).append((x / labels.fx, y / labels.fy))
    wanted = IN_LOOP if panel.is_loop else IN_TIME
    for name, places in at.items():
        labels.mark(name, np.array(places))
    for name, places in at.items():
        labels.write(name, [np.array(places[0])], wanted.get(name[-2:], (5, 5)), fontsize=7)


def _points(panel: _Panel, result: Fit) -> Iterator[tuple[str, str, float, float]]:
    """Yield spring, name, x and y of changes of branch and of half-snapped micro-springs.

    They are in the coordinates of the measured curves, whose zeros may have been fitted.
    """
    for switch in result.switches:
        ends, x = (switch.source, switch.target), switch.time
        name = POINTS.get("".join(ends))
        moved = switch.displacement + result.zero_of("displacement")
        if panel.is_loop:
            x = moved / result.measurement.specimen.height
        remembers = result.chain.springs[switch.spring - 1].law.remembers
        if x is not None and not (name is None and remembers):
            stress = switch.stress + result.zero_of("stress")
            y = moved if panel.key == "displacement_time" else stress
            yield f"s{switch.spring}", name or "→".join(ends), x, y
    for spring, snapped in result.snapping.items():
        for symbol, sample in zip(("σ₊", "σ₋"), snapped.halves, strict=True):
            if sample is not None and (on := panel.fitted) is not None and sample < on.x.size:
                yield spring, symbol, float(on.x[sample]), float(on.y[sample])


def _draw_law(labels: _Labels, result: Fit) -> None:
    """Draw the elastic branches, if any, and the equilibrium of a single spring."""
    spring, ax = result.chain.springs[0], labels.ax
    if len(result.chain.springs) > 1 or not hasattr(spring, "elastic_branches"):
        return
    (left, right), (low, top) = ax.get_xlim(), ax.get_ylim()
    ax.set(xlim=(left, right), ylim=(low, top))  # the branches extend beyond the panel
    zero = result.zero_of("stress")
    moved = result.zero_of("displacement") / result.measurement.specimen.height
    stress = np.linspace(0.0, top * labels.fy - zero, 200)
    for name, strain in spring.elastic_branches(stress).items():
        line = np.column_stack((strain + moved, (stress + zero) / labels.fy))
        line = line[strain + moved < right]
        if len(line):  # branch c may lie beyond the strains of the test
            ax.plot(*line.T, color="0.72", lw=0.7, zorder=1.5, label=f"_branch {name}")
            along, wanted = LIGHT[name[0]]
            at = line[int(along * (len(line) - 1))]
            labels.write(name, [at], wanted, color=GREY, fontsize=7)
    if spring.relaxation and "s1" in result.snapping and result.strain is not None:
        style: Any = {"color": "0.35", "lw": 0.7, "ls": (0, (4, 2)), "zorder": 3.5}
        equilibrium = (result.snapping["s1"].stress + zero) / labels.fy
        ax.plot(result.strain, equilibrium, label="equilibrium", **style)


def _name_branches(labels: _Labels, panel: _Panel, result: Fit) -> None:
    """Write the names of the branches next to the curve of a single spring."""
    springs, fitted = result.chain.springs, panel.fitted
    if len(springs) > 1 or not springs[0].law.hysteretic or fitted is None:
        return
    for branch, stretch in _longest_visits(result, fitted).items():
        x, y = fitted.x[stretch] / labels.fx, fitted.y[stretch] / labels.fy
        middle = x[_evenly(x, y, 3)[1]]
        inner = np.column_stack((x, y))[_evenly(x, y, 9)]
        around = sorted(inner, key=lambda at: float(abs(at[0] - middle)))
        style: Any = {"fontsize": 7.5 if len(branch) == 1 else 7.0, "label": "_on branch"}
        wanted = BESIDE.get(branch, (-6.0, 5.0))
        labels.write(branch, around, wanted, stay=True, color=BLUE, **style)


def _longest_visits(result: Fit, fitted: _Line) -> dict[str, slice]:
    """Return the samples of the longest visit (in strain) of a single spring to each branch."""
    ends = [0, *_switch_samples(result, fitted), fitted.x.size - 1]
    at_rest = next(iter(result.chain.springs[0].law.branches))
    branches = [switch.source for switch in result.switches[:1]] or [at_rest]
    branches += [switch.target for switch in result.switches]
    visits, longest = dict[str, slice](), dict[str, float]()
    for branch, start, end in zip(branches, ends, ends[1:], strict=False):
        span = float(np.ptp(fitted.x[start : end + 1])) if end > start else 0.0
        # Shorter visits, below 2 % of the range of strain, are vibrations.
        if span > longest.get(branch, 0.02 * float(np.ptp(fitted.x))):
            visits[branch], longest[branch] = slice(start, end + 1), span
    return visits


def _switch_samples(result: Fit, loop: _Line) -> list[int]:
    """Return the sample of the fitted loop (strain, stress) at which each switch occurs."""
    samples, time = [0], result.curves.time
    for switch in result.switches:
        if time is not None and switch.time is not None:
            samples.append(min(int(np.searchsorted(time, switch.time)), loop.x.size - 1))
        else:  # the nearest sample after the previous switch
            moved = switch.displacement + result.zero_of("displacement")
            strain = moved / result.measurement.specimen.height
            stress = switch.stress + result.zero_of("stress")
            x, y = loop.x[samples[-1] :] - strain, loop.y[samples[-1] :] - stress
            distance = np.hypot(x / (np.ptp(loop.x) or 1.0), y / (np.ptp(loop.y) or 1.0))
            samples.append(samples[-1] + int(np.argmin(distance)))
    return samples[1:]


def _head(figure: Figure, result: Fit, *, titled: bool) -> None:
    """Write the title above and the legend below the panels, and make room for both."""
    name = printable(" ".join(result.measurement.name.split()))
    name = name if len(name) <= 60 else name[:59] + "…"
    word = origin_word(result)
    more = [word] if word and word not in name.lower() else []
    more += [f"stopped by {result.stopped}"] if result.stopped else []
    # The no-break space keeps a line from starting with a dot.
    title = "\u00a0· ".join([name, result.law, f"{result.drive} drive", *more])
    title = textwrap.fill(title, int(12 * figure.get_figwidth()))
    if titled:  # a dollar sign in a name does not start a formula
        figure.suptitle(title, x=0.012, ha="left", fontsize=8.5, parse_math=False)
    lines = figures.legend_below(figure, figures.named_in(figure.axes))
    extra = 11.0 * max(lines - 1, 0) + (11.0 * title.count("\n") if titled else -13.0)
    figure.set_figheight(figure.get_figheight() + extra / 72.0)


def _size(values: Array) -> float:
    return float(np.nanmax(np.abs(values), initial=0.0))
