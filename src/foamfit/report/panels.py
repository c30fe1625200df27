"""The panels of a fit: measured and fitted curves with their residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.report.figures import GREY, INSIDE, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.results import Fit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = 60  # markers on a measured curve; more would merge
MANY = 5000  # samples beyond which a curve is stored as pixels, because its outline is too large
PALE = "#A6CEE3"
# Dashes and marks of interior masses, from the base up, distinguishable without colour.
DASHES: Any = ((0, (5, 1.2)), (0, (2.5, 1.2)), (0, (1, 1)), (0, (5, 1.2, 1, 1.2)))
MARKS = ("^", "v", "D", "p")


@dataclass(frozen=True)
class Line:
    """A curve of a panel in SI; `residual` of a measured one is in % of its range."""

    x: Array
    y: Array
    label: str
    style: dict[str, Any]
    kind: Literal["measured", "fitted", "other"] = "other"
    node: int = 0  # interior mass, 0 = top
    residual: Array | None = None


@dataclass(frozen=True)
class Panel:
    """Curves in common axes, with the names and SI units of the axes."""

    name: str  # "stress-strain", …
    x_name: str
    x_unit: str
    y_name: str
    y_unit: str
    lines: list[Line]

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
        x, x_unit = readable_unit(max(size(line.x) for line in self.lines), self.x_unit)
        y, y_unit = readable_unit(max(size(line.y) for line in self.lines), self.y_unit)
        return x, f"{self.x_name} ({x_unit})", y, f"{self.y_name} ({y_unit})"


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
        loop.append(Line(strain, c.stress_along, "springs along measured strain", pale))
    panels = [
        Panel("stress-time", "time", "s", "stress", "Pa", pushing),
        Panel("displacement-time", "time", "s", "displacement", "m", moving),
        Panel("stress-strain", "strain", "–", "stress", "Pa", loop),
    ]
    if is_known(result):
        panels = [panels[2], panels[0]]
    return [panel for panel in panels if panel.lines]


def _measured(
    x: Array | None, y: Array | None, fitted: Array | None, motion: str = "measured", node: int = 0
) -> list[Line]:
    if x is None or y is None:
        return []
    label, mark, edge = "measured", "o", "0.6"
    if node:
        mark, edge = MARKS[(node - 1) % len(MARKS)], _colour(node)
        label = f"_measured, mass {node}"
    elif motion != "measured":
        label, mark = f"measured, motion {motion}", "s"
    style = {"marker": mark, "mfc": "white", "mec": edge, "mew": 0.6, "ms": 3.4, "zorder": 3}
    residual = None if fitted is None else 100.0 * (fitted - y) / (float(np.ptp(y)) or 1.0)
    return [Line(x, y, label, style, "measured", node, residual)]


def _fitted(x: Array | None, y: Array | None, node: int = 0) -> list[Line]:
    if x is None or y is None:
        return []
    style = {"ls": DASHES[(node - 1) % len(DASHES)] if node else "-", "lw": 0.9, "zorder": 4}
    label = f"mass {node}" if node else "fitted"
    return [Line(x, y, label, style | {"color": _colour(node)}, "fitted", node)]


def _colour(node: int) -> str:
    return INSIDE[(node - 1) % len(INSIDE)] if node else VERMILION


def draw(ax: Axes, panel: Panel) -> None:
    """Draw the curves of a panel, the measured ones as thin lines with a few markers."""
    fx, x_label, fy, y_label = panel.scale()
    for line in panel.lines:
        x, y, style = line.x / fx, line.y / fy, line.style
        if line.kind == "measured":
            thin: Any = {"color": "0.82", "lw": 0.5, "zorder": 1, "rasterized": x.size > MANY}
            ax.plot(x, y, label=f"_{line.label.removeprefix('_')}, all samples", **thin)
            marked = evenly(x, y, MARKERS)
            x, y, style = x[marked], y[marked], {"ls": "none", **style}
        ax.plot(x, y, label=line.label, rasterized=x.size > MANY, **style)
    ax.set(xlabel=x_label, ylabel=y_label, label=panel.name)
    ax.margins(0.05, 0.11)


def draw_residuals(ax: Axes, strip: Axes, panel: Panel) -> None:
    """Draw fitted minus measured below a panel, in percent of the measured range."""
    for line in panel.lines:
        if line.residual is not None:
            style: Any = {"color": _colour(line.node), "lw": 0.7, "label": "_fitted − measured"}
            style["rasterized"] = line.x.size > MANY
            strip.plot(line.x / panel.scale()[0], line.residual, **style)
    strip.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    strip.set(xlabel=ax.get_xlabel(), label=f"{panel.name}, residual")
    strip.set_ylabel("residual\n(% of range)", fontsize=7)
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
