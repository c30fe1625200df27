"""The panels of a fit: measured and fitted curves, residuals, marks of switches and branches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.report.figures import BLUE, GREY, INSIDE, VERMILION
from foamfit.results import Fit, Switch
from foamfit.text import readable_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = 60  # markers on a measured curve; more would merge
MANY = 5000  # samples beyond which a curve is stored as pixels, because its outline is too large
PALE = "#A6CEE3"
# Dashes and marks of interior masses, from the base up, distinguishable without colour.
DASHES: Any = ((0, (5, 1.2)), (0, (2.5, 1.2)), (0, (1, 1)), (0, (5, 1.2, 1, 1.2)))
MARKS = ("^", "v", "D", "p")

AXES = {  # name and SI unit of x and y in each panel
    "stress-time": (("time", "s"), ("stress", "Pa")),
    "displacement-time": (("time", "s"), ("displacement", "m")),
    "stress-strain": (("strain", "–"), ("stress", "Pa")),
}
# Points at which a spring changes between two branches, in either order.
POINTS = {"ad": "A1", "da": "A1", "dc": "C1", "ce": "C2", "ec": "C2", "ea": "A2"}
# Offsets of a name from its point, in typographic points: preferred ones first, then further away.
SIDES = ((-5.0, 4.0), (5.0, -4.0), (5.0, 4.0), (-5.0, -4.0))
FARTHER = (1.0, 2.5, 4.0)
LIGHT = {"a": 0.9, "c": 0.5}  # place of the name along an elastic branch, over its length


@dataclass(frozen=True)
class Line:
    """A curve of a panel in SI, or with `high` a band between two curves."""

    x: Array
    y: Array
    label: str
    style: dict[str, Any]
    kind: Literal["measured", "fitted", "other"] = "other"
    node: int = 0  # interior mass, 0 = top
    high: Array | None = None


@dataclass(frozen=True)
class Panel:
    """Curves in common axes, with name and SI unit of x and of y."""

    name: str  # "stress-strain", …
    x: tuple[str, str]
    y: tuple[str, str]
    lines: list[Line]
    below: list[Line] = field(default_factory=list)  # in a strip, in % of the measured range
    below_name: str = "residual"
    title: str = ""

    @property
    def is_loop(self) -> bool:
        """Whether the curves are over the strain."""
        return self.name == "stress-strain"

    @property
    def fitted(self) -> Line | None:
        """The fitted curve of the top."""
        return next((one for one in self.lines if one.kind == "fitted" and not one.node), None)

    def scale(self) -> tuple[float, str, float, str]:
        """Return factor and axis label of x, then of y."""
        fx, x_unit = readable_unit(max(size(line.x) for line in self.lines), self.x[1])
        fy, y_unit = readable_unit(max(size(line.y) for line in self.lines), self.y[1])
        x_label, y_label = f"{self.x[0]} ({x_unit})", f"{self.y[0]} ({y_unit})"
        return fx, x_label.removesuffix(" ()"), fy, y_label.removesuffix(" ()")


def is_known(result: Fit) -> bool:
    """Return whether the motion is prescribed and no interior masses are compared."""
    return result.drive == "displacement" and not result.curves.interior


def panels_of(result: Fit) -> list[Panel]:
    """Return the panels of a fit that have a curve; the loop is first if the motion is known."""
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

    pushing = measured(c.time, c.measured_stress) + _fitted(c.time, c.stress)
    moving, off = list[Line](), list[Line]()
    for node, (seen, found) in {0: (c.measured_displacement, c.displacement), **c.interior}.items():
        moving += measured(c.time, seen, motion, node) + _fitted(c.time, found, node)
        fitted = found if node else compared("displacement_time", found)
        off += _residual(c.time, seen, fitted, node)
    loop = measured(strain, c.measured_stress, motion)
    loop += _fitted(None if moved is None else moved / height, pushed)
    if strain is not None and c.stress_along is not None and not is_known(result):
        # Wide and pale below the others, because it coincides with them if the fit is good.
        pale = {"color": PALE, "lw": 3.2, "zorder": 2}
        loop.append(Line(strain, c.stress_along, "springs along measured strain", pale))
    pushed_off = _residual(c.time, c.measured_stress, compared("stress_time", c.stress))
    looped_off = _residual(strain, c.measured_stress, compared("stress_strain", c.stress_along))
    panels = [
        Panel("stress-time", *AXES["stress-time"], pushing, pushed_off),
        Panel("displacement-time", *AXES["displacement-time"], moving, off),
        Panel("stress-strain", *AXES["stress-strain"], loop, looped_off),
    ]
    if is_known(result):
        panels = [panels[2], panels[0]]
    return [panel for panel in panels if panel.lines]


def _line(x: Array | None, y: Array | None, *look: Any) -> list[Line]:
    """Return a curve with label, style, kind and node, or none if it is missing."""
    return [] if x is None or y is None else [Line(x, y, *look)]


def measured(
    x: Array | None, y: Array | None, motion: str = "measured", node: int = 0
) -> list[Line]:
    """Return a measured curve, or none if it is missing."""
    label, mark, edge = "measured", "o", "0.6"
    if node:
        mark, edge = MARKS[(node - 1) % len(MARKS)], _colour(node)
        label = f"_measured, mass {node}"
    elif motion != "measured":
        label, mark = f"measured, motion {motion}", "s"
    style = {"marker": mark, "mfc": "white", "mec": edge, "mew": 0.6, "ms": 3.4, "zorder": 3}
    return _line(x, y, label, style, "measured", node)


def _residual(x: Array | None, y: Array | None, fitted: Array | None, node: int = 0) -> list[Line]:
    gap = None if y is None or fitted is None else 100.0 * (fitted - y) / (float(np.ptp(y)) or 1.0)
    return _line(x, gap, "_fitted − measured", {"color": _colour(node), "lw": 0.7})


def _fitted(x: Array | None, y: Array | None, node: int = 0) -> list[Line]:
    dashes = DASHES[(node - 1) % len(DASHES)] if node else "-"
    style = {"ls": dashes, "lw": 0.9, "zorder": 4, "color": _colour(node)}
    return _line(x, y, f"mass {node}" if node else "fitted", style, "fitted", node)


def _colour(node: int) -> str:
    return INSIDE[(node - 1) % len(INSIDE)] if node else VERMILION


def draw(ax: Axes, panel: Panel) -> None:
    """Draw the curves of a panel, the measured ones as thin lines with a few markers."""
    fx, x_label, fy, y_label = panel.scale()
    for line in panel.lines:
        x, y, style = line.x / fx, line.y / fy, line.style
        if line.high is not None:
            ax.fill_between(x, y, line.high / fy, label=line.label, **style)
            continue
        if line.kind == "measured":
            thin: Any = {"color": "0.82", "lw": 0.5, "zorder": 1, "rasterized": x.size > MANY}
            ax.plot(x, y, label=f"_{line.label.removeprefix('_')}, all samples", **thin)
            marked = evenly(x, y, MARKERS)
            x, y, style = x[marked], y[marked], {"ls": "none", **style}
        ax.plot(x, y, label=line.label, rasterized=x.size > MANY, **style)
    ax.set(xlabel=x_label, ylabel=y_label, label=panel.name, title=panel.title)
    ax.margins(0.05, 0.11)


def draw_below(ax: Axes, strip: Axes, panel: Panel) -> None:
    """Draw the strip below a panel, such as fitted minus measured."""
    for line in panel.below:
        style = line.style | {"rasterized": line.x.size > MANY}
        strip.plot(line.x / panel.scale()[0], line.y, label=line.label, **style)
    strip.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    strip.set(xlabel=ax.get_xlabel(), label=f"{panel.name}, {panel.below_name}")
    strip.set_ylabel(f"{panel.below_name}\n(% of range)", fontsize=7)
    strip.ticklabel_format(axis="y", scilimits=(-2, 4))  # long numbers would cover the label
    strip.sharex(ax)
    ax.set_xlabel("")
    ax.tick_params(labelbottom=False)


def evenly(x: Array, y: Array, n: int) -> NDArray[np.intp]:
    """Return up to `n` samples, evenly spaced along the curve (not in time)."""
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if finite.size <= n:
        return finite
    dx, dy = (np.diff(v[finite]) / (np.ptp(v[finite]) or 1.0) for v in (x, y))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(dx, dy))))
    return finite[np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], n)))]


def size(values: Array) -> float:
    """Return the largest absolute value; 0 without a finite one."""
    return float(np.nanmax(np.abs(values), initial=0.0))


def annotate(result: Fit, ax: Axes, panel: Panel, size: tuple[float, float]) -> None:
    """Add everything except the curves to a panel of about this size in points."""
    _mark_outliers(ax, panel, result)
    labels = _Labels(ax, panel, size)
    if panel.is_loop:
        _draw_law(labels, result)
    _mark_switches(labels, panel, result)
    if panel.is_loop:
        _name_branches(labels, panel, result)


def _mark_outliers(ax: Axes, panel: Panel, result: Fit) -> None:
    """Mark outliers, which are not fitted, with crosses; at the edge if beyond the panel."""
    test = result.measurement
    fx, _, fy, _ = panel.scale()
    own = "displacement" if panel.name == "displacement-time" else "stress"
    for channel, found in test.outliers.items():
        x, motion = found.at, test.displacement
        if not channel.startswith(own) or not x.size:
            continue
        if panel.is_loop and motion is not None:
            x = np.interp(x, test.instants, motion) / test.specimen.height
        elif panel.is_loop or test.time is None:
            continue
        low, high = ax.get_ylim()  # fixed, so that an outlier does not shrink the curves
        style: Any = {"ms": 4.0, "mew": 1.0, "color": "black", "zorder": 6, "clip_on": False}
        y = np.clip(found.values / fy, low, high)
        ax.plot(x / fx, y, "x", label="outlier, not fitted", **style)
        ax.set_ylim(low, high)


class _Labels:
    """Placement of names in a panel, away from other names, curves and marks."""

    def __init__(self, ax: Axes, panel: Panel, size: tuple[float, float]) -> None:
        """Initialise for a panel of about this size in typographic points."""
        self.ax, (self.fx, _, self.fy, _) = ax, panel.scale()
        self.corner, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
        self.size, self.scale = size, np.array(size) / (high - self.corner)  # points per unit
        self.drawn = [np.empty((0, 2))]  # points that names should not cover
        for line in panel.lines:
            if line.kind == "fitted":
                seen = evenly(line.x, line.y, 4 * MARKERS)
                self.drawn.append(np.column_stack((line.x / self.fx, line.y / self.fy))[seen])
        self.taken: list[Array] = []

    def mark(self, name: str, places: Array) -> None:
        """Draw dots, which names should not cover, at places (n, 2) in the units of the axes."""
        self.ax.plot(*places.T, "o", ms=3.2, color="black", zorder=5, label=f"_{name}")
        self.drawn += [places, places]

    def write(
        self, name: str, places: Sequence[Array], sides: Sequence[Any] = SIDES, **style: Any
    ) -> None:
        """Write a name near one of `places`, where it covers least; earlier ones are preferred."""
        avoid = (np.concatenate(self.drawn) - self.corner) * self.scale
        size, candidates = np.array([4.2 * len(name), 9.0]), []
        for rank, (place, far, (dx, dy)) in enumerate(product(places, FARTHER, sides)):
            dy, left = far * dy, dx - (size[0] if dx < 0 else 0.0)
            low = (place - self.corner) * self.scale + (left, dy - 0.5 * size[1])
            high = low + size
            names = sum(bool(np.all((low < b[2:]) & (b[:2] < high))) for b in self.taken)
            beyond = bool(np.any((low < 0.0) | (high > self.size)))
            inside = int(np.all((avoid > low) & (avoid < high), axis=1).sum())
            cost = 1000 * names + 100 * beyond + inside + 0.5 * rank
            candidates.append((cost, place, (dx, dy), np.concatenate((low, high))))
        _, at, offset, box = min(candidates, key=lambda one: one[0])
        self.taken.append(box)
        style |= {"ha": "left" if offset[0] > 0 else "right", "va": "center", "zorder": 6}
        style |= {"bbox": {"fc": "white", "alpha": 0.75, "lw": 0.0, "pad": 0.5}}
        style |= {"textcoords": "offset points", "annotation_clip": False}
        self.ax.annotate(name, (float(at[0]), float(at[1])), offset, **style)


def _mark_switches(labels: _Labels, panel: Panel, result: Fit) -> None:
    """Mark the switches of the springs, and name each kind of switch once."""
    at: dict[str, list[tuple[float, float]]] = {}
    for spring, point, x, y in _points(panel, result):
        name = f"{spring} {point}" if len(result.chain.springs) > 1 else point
        at.setdefault(name, []).append((x / labels.fx, y / labels.fy))
    for name, places in at.items():
        labels.mark(name, np.array(places))
    for name, places in at.items():
        labels.write(name, [np.array(places[0])], fontsize=7)


def _place(switch: Switch, result: Fit) -> tuple[float, float, float]:
    """Return displacement, strain and stress of a switch as the measured curves show them."""
    moved = switch.displacement + result.zero_of("displacement")
    return moved, moved / result.measurement.specimen.height, result.as_read(switch.stress)


def _points(panel: Panel, result: Fit) -> Iterator[tuple[str, str, float, float]]:
    """Yield spring, name, x and y, as measured, of switches and of half-snapped micro-springs."""
    for switch in result.switches:
        ends, x = (switch.source, switch.target), switch.time
        name = POINTS.get("".join(ends))
        moved, strain, stress = _place(switch, result)
        if panel.is_loop:
            x = strain
        remembers = result.chain.springs[switch.spring - 1].law.remembers
        if x is not None and not (name is None and remembers):
            y = moved if panel.name == "displacement-time" else stress
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
    scale, zero = result.nuisance("force_scale", 1.0), result.zero_of("stress")
    moved = result.zero_of("displacement") / result.measurement.specimen.height
    stress = np.linspace(0.0, scale * (top * labels.fy - zero), 200)
    for name, strain in spring.elastic_branches(stress).items():
        line = np.column_stack((strain + moved, result.as_read(stress) / labels.fy))
        line = line[strain + moved < right]
        if len(line):  # branch c may lie beyond the strains of the test
            ax.plot(*line.T, color="0.72", lw=0.7, zorder=1.5, label=f"_branch {name}")
            at = line[int(LIGHT[name[0]] * (len(line) - 1))]
            labels.write(name, [at], color=GREY, fontsize=7)
    if spring.relaxation and "s1" in result.snapping and result.strain is not None:
        style: Any = {"color": "0.35", "lw": 0.7, "ls": (0, (4, 2)), "zorder": 3.5}
        equilibrium = result.as_read(result.snapping["s1"].stress) / labels.fy
        ax.plot(result.strain, equilibrium, label="equilibrium", **style)


def _name_branches(labels: _Labels, panel: Panel, result: Fit) -> None:
    """Write the names of the branches next to the curve of a single spring."""
    springs, fitted = result.chain.springs, panel.fitted
    if len(springs) > 1 or not springs[0].law.hysteretic or fitted is None:
        return
    ends = [0, *_switch_samples(result, fitted), fitted.x.size - 1]
    at_rest = next(iter(springs[0].law.branches))
    names = [switch.source for switch in result.switches[:1]] or [at_rest]
    names += [switch.target for switch in result.switches]
    visits = {name: (0.02 * float(np.ptp(fitted.x)), slice(0)) for name in names}
    for name, start, end in zip(names, ends, ends[1:], strict=False):
        span = float(np.ptp(fitted.x[start : end + 1])) if end > start else 0.0
        if span > visits[name][0]:  # the longest; those below 2 % of the range are vibrations
            visits[name] = span, slice(start, end + 1)
    for name, (_, stretch) in visits.items():
        x, y = fitted.x[stretch] / labels.fx, fitted.y[stretch] / labels.fy
        if not x.size:
            continue
        middle = x[evenly(x, y, 3)[1]]
        inner = np.column_stack((x, y))[evenly(x, y, 9)]
        around = sorted(inner, key=lambda at: float(abs(at[0] - middle)))
        side = SIDES[1:2] if x[-1] < x[0] else SIDES[:1]  # below the curve on the way back
        labels.write(name, around, side, color=BLUE, fontsize=7.0, label="_on branch")


def _switch_samples(result: Fit, loop: Line) -> list[int]:
    """Return the sample of the fitted loop (strain, stress) at which each switch occurs."""
    samples, time = [0], result.curves.time
    for switch in result.switches:
        if time is not None and switch.time is not None:
            samples.append(min(int(np.searchsorted(time, switch.time)), loop.x.size - 1))
        else:  # the nearest sample after the previous switch
            _, strain, stress = _place(switch, result)
            x, y = loop.x[samples[-1] :] - strain, loop.y[samples[-1] :] - stress
            distance = np.hypot(x / (np.ptp(loop.x) or 1.0), y / (np.ptp(loop.y) or 1.0))
            samples.append(samples[-1] + int(np.argmin(distance)))
    return samples[1:]
