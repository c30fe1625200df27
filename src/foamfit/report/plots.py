"""What was fitted, to look at: the three panels of the paper's Figs. 3 and 4, and the residuals."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.report.figures import (
    BLUE,
    GREY,
    INSIDE,
    TWO,
    VERMILION,
    abreast,
    drawing,
    inches,
    legend_below,
    save,
    say_nothing_there,
    write_haloed,
)
from foamfit.report.readable import readable_unit
from foamfit.springs.laws import LinearSpring
from foamfit.terminal import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.results import Fit
    from foamfit.solve.simulation import Response

POINTS = {
    ("a", "d"): "A1", ("d", "a"): "A1",
    ("d", "c"): "C1",
    ("c", "e"): "C2", ("e", "c"): "C2",
    ("e", "a"): "A2",
}  # fmt: skip
# Where the name of a point stands, in points from it: beside its curve, off the others.
IN_LOOP = {"A1": (-4, 5), "C1": (-5, 3), "C2": (5, -3), "A2": (4, -7), "σ₊": (-4, 5), "σ₋": (5, -5)}
IN_TIME = {"A1": (5, -4), "C1": (-5, 3), "C2": (5, 3), "A2": (5, 4), "σ₊": (5, -4), "σ₋": (5, 4)}
LIGHT = {"a": (-4.0, 3.0), "c": (5.0, -4.0)}  # of branches that are drawn lightly
IN_WORDS = {"snap-through": (-6.0, 6.0), "held": (-6.0, 4.0), "snap-back": (7.0, -6.0)}
BESIDE = {"a": (-6, 4), "d": (-6, 4), "c": (7, -3), "e": (4, -7)}  # points from the branch
MARKERS = 60  # of a measured curve: more of them blot
PALE = "#A6CEE3"
STOOD = "#F2DC6B"  # where the gauge stood still
# Of masses inside, from the base up: beside their colours, for who sees or prints grey.
DASHES: Any = ((0, (5, 1.2)), (0, (2.5, 1.2)), (0, (1, 1)), (0, (5, 1.2, 1, 1.2)))
MARKS = ("^", "v", "D", "p")
# Typographic points: height of a panel beside others and above others, what its labels take beside
# and below it, and what title and legend take.
HEIGHT, STACKED, BESIDE_IT, BELOW_IT, AROUND = 133.0, 112.0, 31.0, 26.0, 39.0
MOST_WIDE = {0: 4.0, 1: 4.0, 2: 5.4, 3: 7.0}  # in, by the number of panels


def plot_fit(result: Fit, path: str | Path | None = None, *, width: str = TWO) -> Figure:
    """Draw stress-time, displacement-time and stress-strain, measured and fitted.

    A panel of which the fit has no curve is left out. `width` is "one" or "two" columns, or a
    length such as "85 mm"; panels for which it has no room side by side stand one above the other,
    and a figure of fewer panels is no wider than these need. Saved at `path`, if one is given, in
    the format of its suffix, with what is plotted in a CSV beside it.
    """
    panels = list(_panels(result))
    wide = min(inches(width), MOST_WIDE[len(panels)])
    across = abreast(wide, max(len(panels), 1))
    rows = -(-max(len(panels), 1) // across)
    size = 72.0 * wide / across - BESIDE_IT, HEIGHT if rows == 1 else STACKED
    with drawing(wide, (rows * (size[1] + BELOW_IT) + AROUND) / 72.0) as figure:
        axes = figure.subplots(rows, across, squeeze=False).ravel()
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        if not panels:
            say_nothing_there(axes[0])
        for ax, panel in zip(axes, panels, strict=False):
            ax.set_label(panel.key.replace("_", "-"))
            _draw(ax, panel)
            _mark_outliers(ax, panel, result)
            _shade_standstills(ax, panel, result)
            labels = _Labels(ax, panel, size)
            if panel.key == "stress_strain":
                _draw_law(labels, result)
            _mark_switches(labels, panel, result)
            if panel.key == "stress_strain":
                _name_branches(labels, panel, result)
        _head(figure, result)
        figure.align_ylabels()
    return save(figure, path, table=True)


def plot_residuals(result: Fit, path: str | Path | None = None) -> Figure:
    """Draw fitted minus measured along each curve, in percent of the measured range.

    One strip above the other, 7 in wide, over time, or over the sample where there is no time; a
    curve that has nothing to compare is left out. Saved at `path`, if one is given.
    """
    strips = list(_residuals(result))
    with drawing(7.0, 0.45 + 0.85 * max(len(strips), 1)) as figure:
        column = figure.subplots(max(len(strips), 1), 1, sharex=True, squeeze=False)[:, 0]
        time = result.curves.time
        for ax, (name, residual) in zip(column, strips, strict=False):
            factor, unit = readable_unit(_size(time), "s") if time is not None else (1.0, "")
            x = np.arange(residual.size) if time is None else time / factor
            ax.axhline(0.0, color=GREY, lw=0.6)
            ax.plot(x, 100.0 * residual, color=VERMILION, lw=0.9, label="fitted − measured")
            ax.set_ylabel("% of range")
            ax.set_title(f"{name}: fitted − measured", loc="left", fontsize=7.5, pad=3)
            column[-1].set_xlabel(f"time ({unit})" if unit else "sample")
        if not strips:
            say_nothing_there(column[0])
    return save(figure, path, table=True)


def plot_response(
    response: Response, path: str | Path | None = None, *, width: str = TWO, table: bool = True
) -> Figure:
    """Draw what a forward run gave: base stress and displacements over time, stress over strain.

    For `path` and `width` see `plot_fit`; without `table` no CSV of what is plotted is written.
    """
    time, stress, nodes = response.time, response.base_stress, response.displacement
    wide = min(inches(width), MOST_WIDE[3])
    across = abreast(wide, 3)
    rows = -(-3 // across)
    tall = rows * ((HEIGHT if rows == 1 else STACKED) + BELOW_IT) + AROUND
    with drawing(wide, tall / 72.0) as figure:
        axes = figure.subplots(rows, across, squeeze=False).ravel()
        for ax in axes[3:]:
            ax.set_axis_off()
        ft, t_unit = readable_unit(_size(time), "s")
        fs, s_unit = readable_unit(_size(stress), "Pa")
        fw, w_unit = readable_unit(_size(nodes), "m")
        last: Any = {"color": VERMILION, "lw": 1.3}
        axes[0].plot(time / ft, stress / fs, **last, label="_base stress")
        # From the base up: light to dark, the top in the colour of what is simulated.
        shades = np.linspace(0.7, 0.35, max(len(nodes) - 1, 1))
        for i, node in enumerate(nodes[:-1]):
            axes[1].plot(time / ft, node / fw, color=str(shades[i]), lw=1.0, label=f"node {i + 1}")
        axes[1].plot(time / ft, nodes[-1] / fw, label="top", **last)
        end = response.contact_end
        loop = time <= (np.inf if end is None else end)  # then the striker flies
        axes[2].plot(response.strain[loop], stress[loop] / fs, **last, label="_base stress")
        x, base = f"time ({t_unit})", f"base stress ({s_unit})"
        names = "stress-time", "displacement-time", "stress-strain"
        for ax, name in zip(axes, names, strict=False):
            ax.set_label(name)
        axes[0].set(xlabel=x, ylabel=base, xmargin=0.05, ymargin=0.11)
        axes[1].set(xlabel=x, ylabel=f"displacement ({w_unit})", xmargin=0.05, ymargin=0.11)
        axes[2].set(xlabel="overall strain (–)", ylabel=base, xmargin=0.05, ymargin=0.11)
        if end is not None:
            for ax in axes[:2]:
                ax.axvline(end / ft, color=GREY, lw=0.6, ls=(0, (2, 2)), label="_end of contact")
            axes[0].annotate(
                "end of contact", (end / ft, 1.0), (-3, -3),
                xycoords=("data", "axes fraction"), textcoords="offset points",
                ha="right", va="top", rotation=90, color=GREY, fontsize=6.5,
            )  # fmt: skip
        if len(nodes) > 1:
            axes[1].legend(loc="best", handlelength=1.4)
        figure.align_ylabels()
    return save(figure, path, table=table)


def origin_word(result: Fit) -> str | None:
    """Return "reconstruction" or "synthetic" where the test's name or notes say it is that."""
    text = " ".join((result.measurement.name, *result.measurement.notes)).lower()
    match = re.search(r"\b(reconstruct|synthetic)", text)
    return match and {"reconstruct": "reconstruction"}.get(match[1], match[1])


@dataclass(frozen=True)
class _Line:
    x: Array
    y: Array
    kind: Literal["measured", "fitted", "along"]
    node: int = 0  # the mass inside that it belongs to, 0 = the top
    source: str = "measured"  # where the motion of a measured line came from


@dataclass(frozen=True)
class _Panel:
    key: str
    x_name: str
    x_unit: str
    y_name: str
    y_unit: str
    lines: list[_Line]

    def scale(self) -> tuple[float, str, float, str]:
        """Return factor and axis label of x, then of y."""
        x, x_unit = readable_unit(max(_size(line.x) for line in self.lines), self.x_unit)
        y, y_unit = readable_unit(max(_size(line.y) for line in self.lines), self.y_unit)
        return x, f"{self.x_name} ({x_unit})", y, f"{self.y_name} ({y_unit})"


def _panels(result: Fit) -> Iterator[_Panel]:
    c, height = result.curves, result.measurement.specimen.height
    # What a drive prescribes, the fitted loop has too, whether or not it is kept twice.
    pushed = c.measured_stress if result.drive == "stress" and c.stress is None else c.stress
    moved = c.displacement
    if result.drive == "displacement" and moved is None:
        moved = c.measured_displacement
    measured_strain = None if c.measured_displacement is None else c.measured_displacement / height
    motion = result.measurement.motion or "measured"

    def lines(source: str, *curves: tuple[Any, Any, Any]) -> list[_Line]:
        there = [curve for curve in curves if curve[1] is not None and curve[2] is not None]
        return [_Line(x, y, kind, source=source) for kind, x, y in there]

    in_time = lines(
        motion, ("measured", c.time, c.measured_displacement), ("fitted", c.time, c.displacement)
    )
    if c.time is not None:
        for node, (measured, fitted) in c.interior.items():
            in_time.append(_Line(c.time, measured, "measured", node))
            in_time.append(_Line(c.time, fitted, "fitted", node))
    stress = lines(
        "measured", ("measured", c.time, c.measured_stress), ("fitted", c.time, c.stress)
    )
    loop = lines(
        motion,
        ("measured", measured_strain, c.measured_stress),
        ("fitted", None if moved is None else moved / height, pushed),
        ("along", measured_strain, c.stress_along),
    )
    panels = (
        _Panel("stress_time", "time", "s", "stress", "Pa", stress),
        _Panel("displacement_time", "time", "s", "displacement", "m", in_time),
        _Panel("stress_strain", "strain", "–", "stress", "Pa", loop),
    )
    yield from (panel for panel in panels if panel.lines)


def _draw(ax: Axes, panel: _Panel) -> None:
    fx, x_label, fy, y_label = panel.scale()
    for line in panel.lines:
        x, y = line.x / fx, line.y / fy
        color = INSIDE[(line.node - 1) % len(INSIDE)] if line.node else VERMILION
        dashes = DASHES[(line.node - 1) % len(DASHES)] if line.node else "-"
        if line.kind == "measured":
            some = _evenly(x, y, MARKERS)
            mark, name, edge = "o", "measured", "0.6"
            if line.node:
                mark, edge = MARKS[(line.node - 1) % len(MARKS)], color
                name = f"_measured, mass {line.node}"
            elif line.source != "measured":
                mark, name = "s", f"measured, motion {line.source}"
            every = f"_{name.removeprefix('_')}, all samples"
            ax.plot(x, y, color="0.82", lw=0.5, zorder=1, label=every)
            ax.plot(
                x[some], y[some], mark, label=name, ms=3.4, mfc="white", mec=edge, mew=0.6,
                zorder=3,
            )  # fmt: skip
        elif line.kind == "fitted":
            name = f"mass {line.node}" if line.node else "fitted"
            ax.plot(x, y, color=color, ls=dashes, lw=0.9, zorder=4, label=name)
        else:
            # Wide and pale below the others, with which it coincides where the fit is good.
            ax.plot(x, y, color=PALE, lw=3.2, zorder=2, label="springs along measured strain")
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    ax.margins(0.05, 0.11)


def _evenly(x: Array, y: Array, n: int) -> NDArray[np.intp]:
    """Return up to `n` samples even along the curve; even in time they would crowd at its turns."""
    there = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if there.size <= n:
        return there
    dx, dy = (np.diff(v[there]) / (np.ptp(v[there]) or 1.0) for v in (x, y))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(dx, dy))))
    return there[np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], n)))]


def _mark_outliers(ax: Axes, panel: _Panel, result: Fit) -> None:
    """Cross what the file has at samples that are not fitted, at the edge if it is beyond."""
    test = result.measurement
    fx, _, fy, _ = panel.scale()
    own = "displacement" if panel.key == "displacement_time" else "stress"
    for channel, found in test.outliers.items():
        elsewhere = panel.key != "stress_strain" and test.time is None
        if not channel.startswith(own) or elsewhere or not found.at.size:
            continue
        x = found.at
        if panel.key == "stress_strain":
            motion = test.displacement
            if motion is None:
                continue
            time = np.arange(motion.size) if test.time is None else test.time
            x = np.interp(found.at, time, motion) / test.specimen.height
        low, high = ax.get_ylim()  # fixed: a wild sample must not shrink the curves
        y = np.clip(found.values / fy, low, high)
        ax.plot(
            x / fx, y, "x", ms=4.0, mew=1.0, color="black", zorder=6, clip_on=False,
            label="outlier, not fitted",
        )  # fmt: skip
        ax.set_ylim(low, high)


def _shade_standstills(ax: Axes, panel: _Panel, result: Fit) -> None:
    """Shade where the displacement is bridged: a span of time, a stretch of the measured loop."""
    test = result.measurement
    fx, _, fy, _ = panel.scale()
    style: Any = {"color": STOOD, "zorder": 0.5, "label": "gauge stands still, bridged"}
    for start, end in test.standstills:
        if panel.key != "stress_strain":
            ax.axvspan(start / fx, end / fx, lw=0.0, **style)
            continue
        for line in panel.lines:
            instants = np.arange(line.x.size) if test.time is None else test.time
            if line.kind == "measured":
                at = (instants >= start) & (instants <= end)
                ax.plot(line.x[at] / fx, line.y[at] / fy, lw=7.0, solid_capstyle="butt", **style)


class _Labels:
    """Places names in a panel: on no other name, and on little of the fitted curves and marks."""

    def __init__(self, ax: Axes, panel: _Panel, size: tuple[float, float]) -> None:
        """Take a panel and about how large it will be, typographic points."""
        self.ax, (self.fx, _, self.fy, _) = ax, panel.scale()
        low = np.array([ax.get_xlim()[0], ax.get_ylim()[0]])
        self.corner, self.size = low, size
        limits = np.array([np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())])
        self.span = np.array(size) / limits  # points per unit
        self.curves = [
            np.column_stack((s.x / self.fx, s.y / self.fy))[_evenly(s.x, s.y, 4 * MARKERS)]
            for s in panel.lines
            if s.kind == "fitted"
        ]
        self.marks: list[Array] = []
        self.taken: list[Array] = []

    def mark(self, name: str, places: Array) -> None:
        """Draw dots at places (n, 2), in the units of the axes, that names are to leave free."""
        self.ax.plot(*places.T, "o", ms=3.2, color="black", zorder=5, label=f"_{name}")
        self.marks += [places, places]

    def has_room(self, name: str, at: Array, wanted: tuple[float, float]) -> bool:
        """Whether a name beside a place stays in the width of the panel."""
        anchor, width = (at[0] - self.corner[0]) * self.span[0], 5.5 * len(name) + abs(wanted[0])
        return bool(anchor > width if wanted[0] < 0 else anchor + width < self.size[0])

    def write(
        self, name: str, at: Array, wanted: tuple[float, float], *, stay: bool = False, **style: Any
    ) -> None:
        """Write a name beside a place; `stay`: on no other side of it than is wanted."""
        avoid = np.concatenate([np.empty((0, 2)), *self.curves, *self.marks])
        anchor, avoid = (at - self.corner) * self.span, (avoid - self.corner) * self.span
        offset = _free_offset(anchor, name, wanted, avoid, self.taken, self.size, stay=stay)
        side = "left" if offset[0] > 0 else "right"
        write_haloed(self.ax, name, at, offset, zorder=6, ha=side, va="center", **style)


def _mark_switches(labels: _Labels, panel: _Panel, result: Fit) -> None:
    """Mark what happens to the springs, and name each mark where it first stands."""
    at: dict[str, list[tuple[float, float]]] = {}
    for name, x, y in (*_switches(panel, result), *_halves(panel, result)):
        at.setdefault(name, []).append((x / labels.fx, y / labels.fy))
    wanted = IN_LOOP if panel.key == "stress_strain" else IN_TIME
    for name, places in at.items():
        labels.mark(name, np.array(places))
    for name, places in at.items():
        labels.write(name, np.array(places[0]), wanted.get(name[-2:], (5, 5)), fontsize=7)


def _switches(panel: _Panel, result: Fit) -> Iterator[tuple[str, float, float]]:
    """Give the points where a bistable spring changes its branch: name and place, SI."""
    micro = result.microscale_springs
    for switch in result.switches:
        if f"s{switch.spring}" in micro:
            continue
        point = POINTS.get((switch.source, switch.target), f"{switch.source}→{switch.target}")
        name = f"s{switch.spring} {point}" if len(result.chain.springs) > 1 else point
        x = switch.time
        if panel.key == "stress_strain":
            x = switch.displacement / result.measurement.specimen.height
        y = switch.displacement if panel.key == "displacement_time" else switch.stress
        if x is not None:
            yield name, x, y


def _halves(panel: _Panel, result: Fit) -> Iterator[tuple[str, float, float]]:
    """Give where half of the micro-springs have snapped, and snapped back: name and place, SI."""
    fitted = next((line for line in panel.lines if line.kind == "fitted" and not line.node), None)
    for spring, snapped in result.snapping.items():
        for symbol, sample in zip(("σ₊", "σ₋"), snapped.halves, strict=True):
            if sample is not None and fitted is not None and sample < fitted.x.size:
                name = f"{spring} {symbol}" if len(result.chain.springs) > 1 else symbol
                yield name, float(fitted.x[sample]), float(fitted.y[sample])


def _draw_law(labels: _Labels, result: Fit) -> None:
    """Draw branches a and c of the only spring, if it is microscale, and its equilibrium."""
    if len(result.chain.springs) > 1 or not result.microscale_springs:
        return
    spring, ax = result.microscale_springs["s1"], labels.ax
    (left, right), (low, top) = ax.get_xlim(), ax.get_ylim()
    ax.set(xlim=(left, right), ylim=(low, top))  # the branches go on beyond
    stress = np.linspace(0.0, top * labels.fy, 200)
    on_a = stress / (spring.k0 + stress)
    on_c = spring.eps_star + stress / (spring.kc + stress)
    for name, strain, along in (("a", on_a, 0.9), ("c", on_c, 0.5)):
        line = np.column_stack((strain, stress / labels.fy))[strain < right]
        if len(line):  # branch c may lie beyond all that the test reached
            ax.plot(*line.T, color="0.72", lw=0.7, zorder=1.5, label=f"_branch {name}")
            at = line[int(along * (len(line) - 1))]
            labels.write(name, at, LIGHT[name], color=GREY, fontsize=7)
    if spring.relaxation and "s1" in result.snapping and result.strain is not None:
        equilibrium = result.snapping["s1"].stress
        ax.plot(
            result.strain, equilibrium / labels.fy, color="0.35", lw=0.7, ls=(0, (4, 2)),
            zorder=3.5, label="equilibrium",
        )  # fmt: skip


def _free_offset(
    anchor: Array,
    name: str,
    wanted: tuple[float, float],
    avoid: Array,
    taken: list[Array],
    panel: tuple[float, float],
    *,
    stay: bool = False,
) -> tuple[float, float]:
    """Return where a name stands beside its anchor: on no other name, on little of the curves.

    All in typographic points; the box of the name (left, low, right, high) is added to `taken`.
    """
    x, y = wanted
    size, best, found = np.array([4.2 * len(name), 9.0]), math.inf, (wanted, np.zeros(4))
    for factor in (1.0, 2.5, 4.0):
        sides = ((x, factor * y), (-x, -factor * y), (x, -factor * y), (-x, factor * y))
        for dx, dy in sides[:1] if stay else sides:
            low = np.add(anchor, (dx - (size[0] if dx < 0 else 0.0), dy - 0.5 * size[1]))
            high = low + size
            names = sum(bool(np.all((low < b[2:]) & (b[:2] < high))) for b in taken)
            beyond = bool(np.any((low < 0.0) | (high > panel)))
            inside = int(np.all((avoid > low) & (avoid < high), axis=1).sum())
            cost = 1000 * names + 50 * beyond + inside + 2.0 * factor
            if cost < best:
                best, found = cost, ((dx, dy), np.concatenate((low, high)))
    taken.append(found[1])
    return found[0]


def _name_branches(labels: _Labels, panel: _Panel, result: Fit) -> None:
    """Write beside the curve of the only spring on which branch it is."""
    fitted = next((line for line in panel.lines if line.kind == "fitted"), None)
    springs = result.chain.springs
    if len(springs) > 1 or isinstance(springs[0], LinearSpring) or fitted is None:
        return
    for branch, start, end in _first_visits(result, fitted):
        x, y = fitted.x[start : end + 1] / labels.fx, fitted.y[start : end + 1] / labels.fy
        middle = _evenly(x, y, 3)[1]
        if branch in BESIDE and result.bistable_springs:
            labels.ax.annotate(
                branch, (x[middle], y[middle]), BESIDE[branch], textcoords="offset points",
                ha="center", va="center", zorder=6, color=BLUE, label="_on branch",
            )  # fmt: skip
        elif branch in IN_WORDS:
            inner = np.column_stack((x, y))[_evenly(x, y, 9)]
            around = sorted(inner, key=lambda at: float(abs(at[0] - x[middle])))
            wanted = IN_WORDS[branch]
            at = next((at for at in around if labels.has_room(branch, at, wanted)), around[0])
            labels.write(branch, at, wanted, stay=True, fontsize=7, color=BLUE, label="_on branch")


def _first_visits(result: Fit, fitted: _Line) -> Iterator[tuple[str, int, int]]:
    """Give each branch of the only spring, and the samples of its first stretch on it.

    Micro-springs are held wherever a measured motion shakes: a stretch that goes back by less than
    a fiftieth of the largest strain is part of the one before it.
    """
    starts = [0, *_switch_samples(result, fitted), fitted.x.size - 1]
    branches = [switch.source for switch in result.switches[:1]] or ["a"]
    branches += [switch.target for switch in result.switches]
    stretches: list[tuple[str, int, int]] = []
    for branch, start, end in zip(branches, starts, starts[1:], strict=False):
        shakes = branch == "held" and np.ptp(fitted.x[start : end + 1]) < 0.02 * np.ptp(fitted.x)
        if stretches and (shakes or branch == stretches[-1][0]):
            stretches[-1] = (stretches[-1][0], stretches[-1][1], end)
        elif not shakes:
            stretches.append((branch, start, end))
    for i, (branch, start, end) in enumerate(stretches):
        if end > start and branch not in [one for one, *_ in stretches[:i]]:
            yield branch, start, end


def _switch_samples(result: Fit, loop: _Line) -> list[int]:
    """Return the sample of the fitted loop (strain, stress) at which each switch happens."""
    samples, time = [0], result.curves.time
    for switch in result.switches:
        if time is not None and switch.time is not None:
            samples.append(min(int(np.searchsorted(time, switch.time)), loop.x.size - 1))
        else:  # the nearest sample after the switch before
            strain = switch.displacement / result.measurement.specimen.height
            x, y = loop.x[samples[-1] :] - strain, loop.y[samples[-1] :] - switch.stress
            away = np.hypot(x / (np.ptp(loop.x) or 1.0), y / (np.ptp(loop.y) or 1.0))
            samples.append(samples[-1] + int(np.argmin(away)))
    return samples[1:]


def _head(figure: Figure, result: Fit) -> None:
    name = printable(" ".join(result.measurement.name.split()))
    name = name if len(name) <= 60 else name[:59] + "…"
    title = f"{name} · {result.law} · {result.drive} drive"
    word = origin_word(result)
    if word and word not in name.lower():
        title += f" · {word}"
    if result.stopped:
        title += f" · stopped by {result.stopped}"
    # A dot stays with what is before it.
    title = textwrap.fill(title.replace(" · ", "\u00a0· "), int(12 * figure.get_figwidth()))
    # A name may hold a dollar sign: it is no formula.
    figure.suptitle(title, x=0.012, ha="left", fontsize=8.5, parse_math=False)
    entries: dict[str, Any] = {}
    for ax in figure.axes:
        entries |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    lines = legend_below(figure, entries)
    more = 11.0 * max(lines - 1, 0) + 11.0 * title.count("\n")
    figure.set_figheight(figure.get_figheight() + more / 72.0)


def _residuals(result: Fit) -> Iterator[tuple[str, Array]]:
    c = result.curves
    for key, name, fitted, measured in (
        ("stress_time", "stress-time", c.stress, c.measured_stress),
        ("displacement_time", "displacement-time", c.displacement, c.measured_displacement),
        ("stress_strain", "stress-strain", c.stress_along, c.measured_stress),
    ):
        compared = result.misfit.get(key) is not None  # else the drive prescribes this curve
        if compared and fitted is not None and measured is not None:
            yield name, (fitted - measured) / (float(np.ptp(measured)) or 1.0)
    for node, (measured, fitted) in c.interior.items():
        off = (fitted - measured) / (float(np.ptp(measured)) or 1.0)
        yield f"displacement-time of mass {node}", off


def _size(values: Array) -> float:
    return float(np.nanmax(np.abs(values), initial=0.0))
