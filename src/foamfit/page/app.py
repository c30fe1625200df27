"""One window of the page: its inputs, its curves, and what happens when something is pressed.

What is computed stands in `desk` and `turning`, and is what the commands compute; here it is asked
for and shown. All that comes from a file is shown as text.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from foamfit.errors import InputError, SimulationError
from foamfit.one_model import Options
from foamfit.page.desk import BUSY, LARGEST, QUANTITIES, Checked, Desk, Excerpt
from foamfit.page.turning import PANELS, Row, Turning
from foamfit.page.widgets import TEMPLATES, Sliders, Upload, message
from foamfit.report.figures import GREY, VERMILION
from foamfit.report.folder import load_result
from foamfit.report.readable import readable_unit
from foamfit.report.summary import CURVES
from foamfit.results import law_in_words
from foamfit.solve.precompile import at_first_use
from foamfit.springs.published import published
from foamfit.text import percent

# Where a checkout of the repository may be: the working directory, or around an editable package.
CHECKOUTS = (Path(), Path(__file__).parents[3])
MODELS = ("auto", "bistable", "linear+bistable", "bistable+bistable", "microscale",
          "linear+microscale", "unilateral+bistable")  # fmt: skip
OWN = "as the test allows"  # drive
POLL = 200  # ms
MOST_DRAWN, MOST_MARKERS = 400, 150  # points of a curve, of a measured one
# One thing at a time, for all windows.
BESIDE = ThreadPoolExecutor(1, thread_name_prefix="foamfit-page")
NOTHING = np.empty(0), np.empty(0)
AXES = {  # of each panel: x and y, with the SI units of both
    "stress_time": (("time", "s"), ("stress", "Pa")),
    "displacement_time": (("time", "s"), ("displacement", "m")),
    "stress_strain": (("strain", ""), ("stress", "Pa")),
}
TEXT = """
  :host { font: 1rem/1.5 system-ui, sans-serif; color: #1d2327; }
  p { margin: .3rem 0; overflow-wrap: anywhere; } pre { margin: 0; overflow-x: auto;
    font: .8rem/1.45 ui-monospace, Menlo, Consolas, monospace; white-space: pre; }
  .error { border-left: 4px solid #b3261e; background: #fdeeed; padding: .5rem .8rem; }
  .soft { color: #4f5960; } iframe { width: 100%; height: 85vh; border: 1px solid #dfe3e6; }
  .wide { overflow-x: auto; }
  table { border-collapse: collapse; font-size: .84rem; margin: .6rem 0; }
  th, td { border: 1px solid #aab2b8; padding: .1rem .5rem; text-align: left; white-space: pre; }
  th { background: #f5f7f8; } td.wrong { background: #f9dbd3; outline: 2px solid #85280a; }
  progress { width: 100%; height: .8rem; accent-color: #0072B2; }
"""
FIELD = """
  :host { width: 100%; color: #1d2327; } label { color: #1d2327; font-size: .9rem; }
  .bk-input { color: #1d2327; border: 1px solid #6f7a81; font-size: .95rem; }
  .bk-input::placeholder { color: #667078; }
  .bk-input:focus-visible, .bk-btn:focus-visible { outline: 3px solid #0072B2;
    outline-offset: 2px; }
  .bk-btn, .bk-btn a { font-size: .95rem; }
  .bk-btn-primary { background: #005a8f; color: white; }
  .bk-btn-danger { background: #9b2218; color: white; }
"""
WRONG = FIELD + ".bk-input { border: 2px solid #b3261e; background: #fdeeed; }"


def text_pane() -> pn.pane.HTML:
    """Make a place for text that is put there already escaped."""
    return pn.pane.HTML("", stylesheets=[TEXT], sizing_mode="stretch_width", margin=(4, 0))


def grid(parts: list[Any], width: float) -> pn.Column:
    """Put parts side by side, none narrower than so many rem; hidden at first.

    What is hidden is the column around it: a part that says itself how it is laid out stays.
    """
    style = (
        ":host { display: grid; gap: .4rem; "
        f"grid-template-columns: repeat(auto-fit, minmax(min(100%, {width}rem), 1fr)); }}"
    )
    wide: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
    return pn.Column(pn.Column(*parts, stylesheets=[style], **wide), visible=False, **wide)


def paragraph(text: str, kind: str = "") -> str:
    """Write a text, whatever is in it, as a paragraph."""
    role = ' role="alert"' if kind == "error" else ""
    return f'<p class="{kind}"{role}>{html.escape(text)}</p>'


class Window:
    """The page in one window of a browser; it shares nothing with another one."""

    def __init__(
        self, desk: Desk, address: str, test: Path | None, gone: Callable[[], None]
    ) -> None:
        self.desk = desk
        self.turning: Turning | None = None
        self.rows: dict[str, Row] = {}
        self._shown: object = None
        self._filling, self._asked = False, 0
        self._inputs(address)
        self._outputs()
        self._react()
        self.template = pn.Template((TEMPLATES / "page.html").read_text(encoding="utf-8"))
        wide: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
        parts = {
            "test": pn.Column(self.upload, self.chosen, *self.quantities.values(), self.rest,
                              self.check, self.problem, **wide),
            "model": pn.Column(self.model, self.drive, self.relaxation, self.starts, self.max_time,
                               self.seed, self.run, self.stop, self.progress, **wide),
            "curves": pn.Column(self.panels, self.misfit, self.sliders, self.back, **wide),
            "understood": pn.Column(self.understood, **wide),
            "result": pn.Column(self.ending, self.saves, self.beside, self.comparison,
                                self.report, **wide),
        }  # fmt: skip
        for name, part in parts.items():
            self.template.add_panel(name, part)
        self._poll = pn.state.add_periodic_callback(self._follow, POLL, start=False)
        pn.state.on_session_destroyed(lambda _: gone())
        if test is not None:
            pn.state.onload(partial(self._take, test))

    # ------------------------------------------------------------------------------- the parts

    def _inputs(self, address: str) -> None:
        style: dict[str, Any] = {
            "stylesheets": [FIELD], "sizing_mode": "stretch_width", "margin": (3, 0),
        }  # fmt: skip
        text, select, button = pn.widgets.TextInput, pn.widgets.Select, pn.widgets.Button
        self.upload = Upload(address=address, limit=LARGEST, sizing_mode="stretch_width")
        listed = [sorted(one.glob("experiments/foam-*/*-reconstruction.csv")) for one in CHECKOUTS]
        found = next(filter(None, listed), [])
        self.reconstructions = {f"{one.parent.name}: {one.stem}": one for one in found}
        self.chosen = select(
            name="or a reconstruction of the repository", options=["", *self.reconstructions],
            visible=bool(found), **style,
        )  # fmt: skip
        self.quantities = {
            q.name: text(name=q.label, placeholder=f"like {q.example}", **style) for q in QUANTITIES
        }
        self.rest = pn.widgets.TextAreaInput(
            name="Further TOML: name, [columns], [noise], [window]", rows=4, max_length=20_000,
            placeholder='[columns]\nforce = { column = "Load", unit = "kN" }', **style,
        )  # fmt: skip
        self.check = button(name="Check the test", **style)
        self.model = select(name="Model, springs from the base up", options=[*MODELS],
                            value="bistable", **style)  # fmt: skip
        self.drive = select(name="Drive", options=[OWN, "impact", "stress", "displacement"],
                            **style)  # fmt: skip
        self.relaxation = select(name="Relaxation terms", options=[0, 1, 2, 3], **style)
        self.starts = text(name="Starts of the search", placeholder="16 for each spring", **style)
        self.max_time = text(name="Longest time, s", placeholder="no limit", **style)
        self.seed = text(name="Seed", value="0", **style)
        self.run = button(name="Fit", button_type="primary", disabled=True, **style)
        self.stop = button(name="Stop, and keep the best", button_type="danger", visible=False,
                           **style)  # fmt: skip
        self.sliders = Sliders(sizing_mode="stretch_width", margin=(6, 0))
        self.back = button(name="Back to the fit", visible=False, **style)
        self.beside = select(name="Compare with a published set", options=["", *published],
                             visible=False, **style)  # fmt: skip
        self.saves = grid(
            [
                self._save("Save the result folder", "result.zip", lambda: self.desk.zipped()),
                self._save("Save the report", "report.html", partial(self._file, "report.html")),
                self._save("Save the TOML", "test.toml", lambda: self.desk.toml),
            ],
            11.0,
        )

    def _save(self, label: str, filename: str, content: Callable[[], bytes]) -> Any:
        return pn.widgets.FileDownload(
            callback=lambda: BytesIO(content()), filename=filename, label=label, embed=False,
            auto=True, stylesheets=[FIELD], margin=(3, 0), sizing_mode="stretch_width",
        )  # fmt: skip

    def _file(self, name: str) -> bytes:
        assert self.desk.result is not None  # what saves it is hidden until then
        return (self.desk.result / name).read_bytes()

    def _outputs(self) -> None:
        self.problem, self.progress = text_pane(), text_pane()
        self.understood, self.ending = text_pane(), text_pane()
        self.misfit, self.comparison, self.report = text_pane(), text_pane(), text_pane()
        self.understood.object = paragraph("There is no test yet.", "soft")
        self.ending.object = paragraph("There is no fit yet.", "soft")
        self.measured = {name: ColumnDataSource({"x": [], "y": []}) for name in PANELS}
        # One source for all panels: one message for a move.
        self.turned = ColumnDataSource({f"{name}_{axis}": [] for name in PANELS for axis in "xy"})
        self.scales: dict[str, tuple[float, float]] = {}
        self.figures = {name: self._figure(name) for name in PANELS}
        self.panels = grid(
            [pn.pane.Bokeh(one, sizing_mode="stretch_width") for one in self.figures.values()], 14.5
        )

    def _figure(self, name: str) -> Any:
        made = figure(
            height=270, sizing_mode="stretch_width", title=CURVES[name], output_backend="canvas",
            tools="pan,box_zoom,reset", toolbar_location="right",
            x_range=Range1d(0.0, 1.0), y_range=Range1d(0.0, 1.0),
        )  # fmt: skip
        made.scatter("x", "y", source=self.measured[name], size=5, fill_color="white",
                     line_color=GREY, legend_label="measured")  # fmt: skip
        made.line(
            f"{name}_x", f"{name}_y", source=self.turned, color=VERMILION, width=2,
            legend_label="springs",
        )  # fmt: skip
        made.legend.background_fill_alpha = 0.7
        made.legend.location = "center" if name == "displacement_time" else "top_right"
        if name == "stress_strain":
            made.legend.location = "top_left"
        made.legend.padding = made.legend.margin = 3
        made.legend.label_text_font_size = "8.5pt"
        made.toolbar.logo = None
        made.toolbar.autohide = True
        return made

    def _react(self) -> None:
        self.upload.on_msg(self._received)
        self.sliders.on_msg(self._moved)
        self.chosen.param.watch(self._choose, "value")
        self.check.on_click(self._check)
        self.run.on_click(self._run)
        self.stop.on_click(self._stop)
        self.back.on_click(self._back)
        self.beside.param.watch(self._compare, "value")
        for field in (*self.quantities.values(), self.rest):
            field.param.watch(self._edited, "value")
        for field in (self.model, self.drive, self.relaxation):
            field.param.watch(self._model_chosen, "value")

    # ------------------------------------------------------------------------------- beside

    def _beside(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Do what takes a while beside the server, then show it; what is asked for later wins.

        What is shown changes in a turn of the document only: threads know no lock of it.
        """
        self._asked += 1
        asked, document = self._asked, pn.state.curdoc

        def done(found: Any) -> None:
            if asked == self._asked:
                then(found)

        def run() -> None:
            if asked != self._asked:
                return
            try:
                found = work()
            except Exception as error:  # shown, not lost in a thread
                found = error
            document.add_next_tick_callback(partial(done, found))

        BESIDE.submit(run)

    # ------------------------------------------------------------------------------- the test

    def _received(self, event: Any) -> None:
        """Read what was dropped."""
        if message(event).get("received"):
            self.chosen.value = ""
            self._read()

    def _choose(self, event: Any) -> None:
        """Take a reconstruction; only those of the list can be."""
        if event.new in self.reconstructions:
            self._take(self.reconstructions[event.new])

    def _take(self, path: Path) -> None:
        try:
            self.desk.take(path)
        except (InputError, OSError) as error:
            self.problem.object = paragraph(str(error), "error")
            return
        self._read()

    def _read(self) -> None:
        """Fill in what a dropped TOML says, and check."""
        try:
            found = self.desk.dropped_toml()
        except InputError as error:
            self.problem.object = paragraph(str(error), "error")
            return
        if self.desk.worker is None:  # what is shown of a fit is of another test
            self._hide_result("There is no fit yet.")
        if found is not None:
            quantities, rest = found
            self._filling = True  # one check after all of them
            for name, field in self.quantities.items():
                field.value = quantities.get(name, "")
            self.rest.value = rest
            self._filling = False
        self._check()

    def _edited(self, event: Any) -> None:
        if not self._filling and self.desk.csv is not None:
            self._check()

    def _check(self, event: Any = None) -> None:
        """Check the test as it is filled in, and show what is understood or wrong."""
        given = {name: field.value or "" for name, field in self.quantities.items()}
        rest = self.rest.value or ""
        self.run.disabled = True
        self._beside(lambda: self.desk.check(given, rest), self._show_checked)

    def _show_checked(self, checked: Checked | Exception) -> None:
        if isinstance(checked, Exception):
            checked = Checked(error=defect(checked))
        self.problem.object = paragraph(checked.error, "error") if checked.error else ""
        for name, field in self.quantities.items():
            field.stylesheets = [WRONG if name == checked.quantity else FIELD]
        if checked.error == BUSY:
            return
        if checked.error:
            shown = paragraph("The test cannot be read yet: see what is wrong with it.", "soft")
            self.understood.object = shown + excerpt_html(checked.excerpt)
        else:
            self.understood.object = f'<pre tabindex="0">{html.escape(checked.text)}</pre>'
        self.run.disabled = bool(checked.error) or self.desk.running
        self._model_chosen()

    # ------------------------------------------------------------------------------- the curves

    def _model_chosen(self, event: Any = None) -> None:
        """Put the model's parameters over the test, read off its loop."""
        if self.desk.measurement is None:
            self._hide_curves()
            return
        model = "bistable" if self.model.value == "auto" else self.model.value
        self._turn_model(model, self.relaxation.value, self._drive())

    def _drive(self) -> str | None:
        return None if self.drive.value == OWN else str(self.drive.value)

    def _hide_curves(self, why: str = "") -> None:
        self.sliders.tell("")
        self.turning, self.rows, self.sliders.rows = None, {}, []
        self.panels.visible = False
        self.misfit.object = paragraph(why, "error") if why else ""

    def _turn_model(
        self, model: str, relaxation: int, drive: str | None,
        values: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Put other sliders under the curves; they begin at these values, or read off the loop."""
        measurement = self.desk.measurement
        assert measurement is not None

        def make() -> Turning:
            with at_first_use(model, relaxation, lambda: None) as compile_rest:
                compile_rest()
            made = Turning(measurement, model, relaxation, drive, values)
            made.turn({})  # loads what is compiled
            return made

        if self.turning is None:
            self.misfit.object = paragraph(
                "Preparing the curves; right after installation the solver is compiled, once.",
                "soft",
            )
        self._beside(make, self._show_turning)

    def _show_turning(self, made: Turning | Exception) -> None:
        if isinstance(made, Exception):
            known = isinstance(made, InputError | SimulationError)
            self._hide_curves(str(made) if known else defect(made))
            return
        self.turning = made
        self.rows = {row.name: row for row in made.rows}
        self._show_measured()
        self.misfit.object = ""
        self.sliders.rows = [vars(row) for row in made.rows]
        self._draw({})

    def _show_measured(self) -> None:
        assert self.turning is not None
        for name, made in self.figures.items():
            there = self.turning.measured.get(name)
            made.visible = there is not None
            if there is None:
                continue
            (x_name, x_si), (y_name, y_si) = AXES[name]
            fx, x_unit = readable_unit(float(abs(there[0]).max()), x_si)
            fy, y_unit = readable_unit(float(abs(there[1]).max()), y_si)
            self.scales[name] = fx, fy
            made.xaxis.axis_label = f"{x_name} ({x_unit})" if x_unit else x_name
            made.yaxis.axis_label = f"{y_name} ({y_unit})"
            some = slice(None, None, max(len(there[0]) // MOST_MARKERS, 1))
            x, y = there[0] / fx, there[1] / fy
            self.measured[name].data = {"x": x[some], "y": y[some]}
            # They stay while parameters are turned: what moves is the curve alone.
            for limits, values, beyond in ((made.x_range, x, 0.04), (made.y_range, y, 0.15)):
                more = beyond * float(np.ptp(values))
                limits.update(
                    start=float(values.min()) - more, end=float(values.max()) + more,
                    reset_start=float(values.min()) - more, reset_end=float(values.max()) + more,
                )  # fmt: skip
        self.panels.visible = True

    def _moved(self, event: Any) -> None:
        """Draw the curves of the parameters that were moved."""
        moves = message(event).get("moves")
        moves = moves if isinstance(moves, dict) else {}
        wanted = {
            name: float(value) * self.rows[name].factor
            for name, value in moves.items()
            if name in self.rows and isinstance(value, int | float)
        }
        if self.turning is not None and wanted:
            self._draw(wanted)
        self.sliders.drawn()

    def _draw(self, moves: Mapping[str, float]) -> None:
        """Send the arrays of the curves alone; the figures stay as they are."""
        assert self.turning is not None
        drawn = self.turning.turn(moves)
        data = dict[str, Any]()
        for name in PANELS:
            x, y = drawn.curves.get(name, NOTHING)
            fx, fy = self.scales.get(name, (1.0, 1.0))
            some = slice(None, None, max(len(x) // MOST_DRAWN, 1))
            data |= {f"{name}_x": x[some] / fx, f"{name}_y": y[some] / fy}
        longest = max(map(len, data.values()), default=0)
        self.turned.data = {
            name: np.pad(one, (0, longest - len(one)), constant_values=np.nan)
            for name, one in data.items()
        }
        told = f"{self.turning.law}, {self.turning.drive} drive: "
        told += f"misfit {misfits_text(drawn.misfit)}"
        used, shown = self.turning.samples
        told += f"; {shown} of {used} samples are drawn" if shown < used else ""
        self.sliders.tell(drawn.error or told, wrong=bool(drawn.error))

    # ------------------------------------------------------------------------------- the fit

    def _options(self) -> dict[str, Any]:
        """Return the keywords of `foamfit.fit` that are filled in; InputError names a wrong one."""
        given: dict[str, Any] = {"drive": self._drive()}
        for field, key, kind in (
            (self.seed, "seed", int), (self.starts, "starts", int),
            (self.max_time, "max_time", float),
        ):  # fmt: skip
            text = (field.value or "").strip()
            try:
                given |= {key: kind(text)} if text else {}
            except ValueError:
                wanted = "a whole number" if kind is int else "a number of seconds"
                raise InputError(f"{field.name} = {text!r} must be {wanted}.") from None
        if self.model.value != "auto":
            given["relaxation"] = self.relaxation.value
        Options(**given)
        return given

    def _run(self, event: Any = None) -> None:
        try:
            self.desk.fit(self.model.value, self._options())
        except InputError as error:
            self.progress.object = paragraph(str(error), "error")
            return
        self.run.disabled, self.stop.visible, self.stop.disabled = True, True, False
        self._hide_result("A fit is running.")
        self._hold(True)
        self._poll.start()

    def _hold(self, held: bool) -> None:
        """Let nothing of the test be changed while it is fitted."""
        for field in (*self.quantities.values(), self.rest, self.chosen, self.check):
            field.disabled = held

    def _hide_result(self, why: str) -> None:
        self.saves.visible = self.beside.visible = self.back.visible = False
        self.report.object = self.comparison.object = ""
        self.ending.object = paragraph(why, "soft")

    def _stop(self, event: Any = None) -> None:
        if self.desk.worker is not None:
            self.desk.worker.stop()
            self.stop.disabled = True

    def _follow(self) -> None:
        """Show how far the fit is; when it has ended, its result."""
        worker = self.desk.worker
        if worker is None:
            return
        ended, news = worker.ended, worker.news
        if ended is not None:
            self._poll.stop()
            self._ended()
            return
        if news is self._shown and not worker.stopping:
            return
        self._shown = news
        share = round(100 * news.fraction)
        what = "stopping; the best is kept" if worker.stopping else news.what
        told = f"{what}, {share} %"
        if news.misfit:
            told += f"; best misfit {misfits_text(news.misfit)}"
        bar = f'<progress max="100" value="{share}" aria-label="progress of the fit"></progress>'
        self.progress.object = bar + paragraph(told)
        self._show_best(news.model, news.relaxation, news.drive, news.values)

    def _show_best(
        self, model: str, relaxation: int, drive: str, values: Mapping[str, float]
    ) -> None:
        """Draw the curves of a model at some parameters, and put the sliders there."""
        if not values or self.desk.measurement is None:
            return
        now = self.turning
        if now is None or (now.law, now.drive) != (law_in_words(model, relaxation), drive):
            self._turn_model(model, relaxation, drive, values)
            return
        self._draw(values)
        self.sliders.show(
            {name: v / self.rows[name].factor for name, v in values.items() if name in self.rows}
        )

    def _ended(self) -> None:
        """Show the result of the fit, or why there is none."""
        self.run.disabled, self.stop.visible = self.desk.measurement is None, False
        self.progress.object = ""
        self._hold(False)
        if self.desk.result is None:
            self.ending.object = paragraph(self.desk.ending(), "error")
            return
        self.ending.object = ""
        report = self._file("report.html").decode()
        self.report.object = (
            '<iframe sandbox="" title="Report of the fit: figures, parameters with their states, '
            f'notes" srcdoc="{html.escape(report)}"></iframe>'
        )
        self.saves.visible = self.beside.visible = self.back.visible = True
        self.beside.value = ""
        self._back()

    def _back(self, event: Any = None) -> None:
        """Put the sliders back to the fit."""
        if self.desk.result is None:
            return
        fit = load_result(self.desk.result)
        values = {name: one["value"] for name, one in fit["parameters"].items()}
        self._turn_model(fit["model"], fit["relaxation"], fit["drive"], values)

    def _compare(self, event: Any) -> None:
        if not event.new:
            self.comparison.object = ""
            return
        try:
            text = self.desk.compared(event.new)
            self.comparison.object = f'<pre tabindex="0">{html.escape(text)}</pre>'
        except InputError as error:
            self.comparison.object = paragraph(str(error), "error")


def defect(error: Exception) -> str:
    """Say that what happened should not."""
    return f"This is a defect of foamfit, please report it ({type(error).__name__}: {error})."


def misfits_text(misfit: Mapping[str, float | None]) -> str:
    """Name the misfits of the three panels that are there."""
    shown = {CURVES[name]: misfit.get(name) for name in PANELS}
    return ", ".join(f"{name} {percent(off)}" for name, off in shown.items() if off is not None)


def excerpt_html(excerpt: Excerpt | None) -> str:
    """Show rows of a file as a table, the wrong cell, row or column marked."""
    if excerpt is None:
        return ""
    lines = []
    for k, (number, cells) in enumerate(zip(excerpt.numbers, excerpt.cells, strict=True)):
        row = [f'<th scope="row">{number}</th>']
        for j, cell in enumerate(cells):
            hit = excerpt.column in (None, j) if excerpt.row == k else False
            hit = hit or (excerpt.row is None and excerpt.column == j)
            mark = ' class="wrong"' if hit else ""
            row.append(f"<td{mark}>{html.escape(cell)}</td>")
        lines.append(f"<tr>{''.join(row)}</tr>")
    return f'<div class="wide" tabindex="0"><table>{"".join(lines)}</table></div>'
