"""Panels with measured and simulated curves, and a slider for each parameter.

The page and the notebook `turn_the_parameters` show the same panels.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import panel as pn
from bokeh.core.properties import value
from bokeh.models import Band, ColumnDataSource, LabelSet, Range1d
from bokeh.plotting import figure

from foamfit.arrays import Array
from foamfit.page.inputs import WIDE, Sliders, grid, piece
from foamfit.page.turning import PANELS, Drawn, Turning
from foamfit.report.figures import GREY, VERMILION
from foamfit.report.panels import AXES, Line, Panel
from foamfit.report.summary import CURVES, misfit_words

MOST_DRAWN, MOST_MARKERS = 400, 150  # largest number of points of a simulated and a measured curve
NOTHING = np.empty(0), np.empty(0)


class Curves:
    """Panels and sliders of one test; `view` is the Panel object that contains them."""

    def __init__(self, turning: Turning | None = None) -> None:
        self.turning: Turning | None = None
        self.held: dict[str, bool] = {}  # by parameter: whether the user has fixed it
        self.found: dict[str, Any] = {}  # parameters of the fit, as in fit.json
        self._scales: dict[str, tuple[float, float]] = {}
        self._measured = {name: ColumnDataSource({"x": [], "y": []}) for name in PANELS}
        # With one source for all panels each move needs one message.
        self._turned = ColumnDataSource({f"{name}_{axis}": [] for name in PANELS for axis in "xy"})
        self._points = ColumnDataSource({"x": [], "y": [], "name": [], "aside": [], "up": []})
        self._figures = {name: self._figure(name) for name in PANELS}
        self.sliders = Sliders(sizing_mode="stretch_width", margin=(6, 0))
        # Take the lock of the document, as not every message holds it.
        self.sliders.on_msg(lambda event: pn.state.execute(partial(self._moved, event), True))
        legend = pn.pane.HTML(piece("legend", GREY, VERMILION), **WIDE)
        loop_first = sorted(PANELS, key=lambda name: name != "stress_strain")
        self._panes = {n: pn.pane.Bokeh(self._figures[n], **WIDE) for n in loop_first}
        self._panels = grid([*self._panes.values()], 14.5)
        self._panels.insert(0, legend)  # the legend of a figure would be redrawn each time
        self.view = pn.Column(self._panels, self.sliders, **WIDE)
        if turning is not None:
            self.show(turning)

    def show(self, turning: Turning) -> None:
        """Show another model or test, with its sliders."""
        self.turning = turning
        self._show_measured(turning)
        rows = list[dict[str, Any]]()
        for name, row in turning.rows.items():
            fit = self.found.get(name, {})
            given = {"interval": fit.get("ci95"), "range": fit.get("range")}
            spans = {what: [end / row["factor"] for end in x] for what, x in given.items() if x}
            rows.append(row | {"held": self.held.get(name, row["held"])} | spans)
        self.sliders.rows = rows
        self.sliders.waiting = False
        self._draw({})

    def put(self, values: Mapping[str, float]) -> None:
        """Draw the curves at other values (SI), and move the sliders to them."""
        self._draw(values)
        rows = {} if self.turning is None else self.turning.rows
        self.sliders.show({n: v / rows[n]["factor"] for n, v in values.items() if n in rows})

    def hide(self) -> None:
        """Hide everything."""
        self.turning = None
        self.sliders.param.update(told="", wrong=False, rows=[], waiting=False)
        self._panels.visible = False

    def chosen(self) -> tuple[dict[str, float], list[str]]:
        """Return what a fit must fix, by name (SI), and vary, other than it does by default."""
        held, varied = dict[str, float](), list[str]()
        if self.turning is None:
            return held, varied
        now, usual = self.turning.named, self.turning.problem.params
        for name, row in self.turning.rows.items():
            if not self.held.get(name, row["held"]):
                varied += [name] if row["held"] else []
            elif not row["held"] or now[name] != usual[name].value:
                held[name] = now[name]
        return held, varied

    def _figure(self, name: str) -> Any:
        made = figure(
            title=CURVES[name],
            height=270,
            sizing_mode="stretch_width",
            output_backend="canvas",
            stylesheets=[":host { filter: var(--figure, none); }"],  # for the dark colour scheme
            tools="pan,box_zoom,reset",
            toolbar_location="right",
            x_range=Range1d(0.0, 1.0),
            y_range=Range1d(0.0, 1.0),
        )
        measured = {"source": self._measured[name], "line_color": GREY}
        made.scatter("x", "y", size=5, fill_color="white", **measured)
        # Simulated curves have their own canvas, so axes and measured curves are not redrawn. There
        # the frame clips annotations but not glyphs, so a curve is drawn as a band of zero width.
        above = {"source": self._turned, "level": "overlay", "line_color": VERMILION}
        ends = {"base": f"{name}_x", "lower": f"{name}_y", "upper": f"{name}_y"}
        made.add_layout(Band(line_width=2, line_alpha=1.0, fill_alpha=0.0, **above, **ends))
        if name == "stress_strain":
            at: dict[str, Any] = {"x": "x", "y": "y", "source": self._points, "level": "overlay"}
            centred = {"text_align": "center", "text_baseline": "middle"}
            made.add_layout(LabelSet(text=value("\u25cf"), **centred, **at))
            beside = {"x_offset": "aside", "y_offset": "up", "text_font_size": "9pt"}
            made.add_layout(LabelSet(text="name", **beside, **at))
        made.toolbar.logo = None
        made.toolbar.autohide = True
        return made

    def _show_measured(self, turning: Turning) -> None:
        for name, made in self._figures.items():
            measured = turning.measured.get(name)
            if name == "displacement_time" and turning.drive == "displacement":
                measured = None  # it is the input
            self._panes[name].visible = measured is not None
            if measured is None:
                continue
            panel = Panel(CURVES[name], *AXES[CURVES[name]], [Line(*measured, "", {})])
            fx, made.xaxis.axis_label, fy, made.yaxis.axis_label = panel.scale()
            self._scales[name] = fx, fy
            some = self._some(measured[0], MOST_MARKERS)
            x, y = measured[0] / fx, measured[1] / fy
            self._measured[name].data = {"x": x[some], "y": y[some]}
            # The axes keep their ranges while parameters change.
            for limits, values, beyond in ((made.x_range, x, 0.04), (made.y_range, y, 0.15)):
                more = beyond * float(np.ptp(values))
                low, high = float(values.min()) - more, float(values.max()) + more
                limits.update(start=low, end=high, reset_start=low, reset_end=high)
        self._panels.visible = True

    def _some(self, samples: Array, most: int) -> slice:
        """Return a slice with at most `most` samples of each cycle."""
        assert self.turning is not None
        return slice(None, None, -(-len(samples) // (most * self.turning.cycles)) or 1)

    def _moved(self, event: Any) -> None:
        """Draw the curves for the sliders that were moved, and store the ticks."""
        moves, held = event.data.get("moves", {}), event.data.get("held", {})
        rows = {} if self.turning is None else self.turning.rows
        self.held |= {name: value for name, value in held.items() if name in rows}
        if wanted := {n: value * rows[n]["factor"] for n, value in moves.items() if n in rows}:
            self._draw(wanted)
        if moves:
            self.sliders.drawn()

    def _draw(self, moves: Mapping[str, float]) -> None:
        """Simulate the curves, and send only their arrays."""
        assert self.turning is not None
        drawn = self.turning.turn(moves)
        data = dict[str, Any]()
        for name in PANELS:
            x, y = drawn.curves.get(name, NOTHING)
            fx, fy = self._scales.get(name, (1.0, 1.0))
            some = self._some(x, MOST_DRAWN)
            data |= {f"{name}_x": x[some] / fx, f"{name}_y": y[some] / fy}
        # A source needs arrays of equal length; single precision is finer than a pixel.
        sent = {name: np.full(max(map(len, data.values())), np.nan, np.float32) for name in data}
        for name, values in data.items():
            sent[name][: len(values)] = values
        self._turned.data = sent
        self._draw_points(drawn)
        test = self.turning.problem.measurement
        text = f"{self.turning.law}, {self.turning.drive} drive"
        if test.last_cycle is not None:
            text += f", cycles {test.cycle} to {test.last_cycle}"
        elif len(test.cycles) > 1:
            text += f", cycle {test.cycle}"
        text += f": misfit {misfits_text(drawn.misfit)}"
        self.sliders.param.update(told=drawn.error or text, wrong=bool(drawn.error))

    def _draw_points(self, drawn: Drawn) -> None:
        fx, fy = self._scales.get("stress_strain", (1.0, 1.0))
        x, y = np.array([*drawn.points.values()]).reshape(-1, 2).T
        if len(x) or len(self._points.data["x"]):
            names = [*drawn.points]
            # Offsets in px: A1 and C1 above on the left, A2 and C2 below on the right of the curve.
            beside = [(-8 - 7 * len(name), 2) if name[-1] == "1" else (6, -15) for name in names]
            aside, up = np.array(beside).reshape(-1, 2).T
            self._points.data = {"x": x / fx, "y": y / fy, "name": names, "aside": aside, "up": up}


def misfits_text(misfit: Mapping[str, float | None]) -> str:
    """Return the misfits of the panels in words."""
    return misfit_words({CURVES[name]: misfit.get(name) for name in PANELS})
