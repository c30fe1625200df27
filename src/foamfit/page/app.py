"""One window of the page: inputs, curves, and the actions of its buttons.

`desk` and `turning` compute, as the commands do; this module calls them and shows the results.
Content of files is always shown as escaped text.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import panel as pn

from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.options import FREED
from foamfit.page import preview as previews
from foamfit.page.curves import Curves, grid, misfits_text
from foamfit.page.desk import BUSY, FIRST, LARGEST, QUANTITIES, Desk, wrong_quantity
from foamfit.page.turning import Turning
from foamfit.page.widgets import RELAXATIONS, TEMPLATES, WIDE, Field, Upload, message, piece, style
from foamfit.page.worker import FirstUse, News, parsed
from foamfit.report.folder import load_result
from foamfit.results import law_in_words
from foamfit.springs import laws
from foamfit.springs.model import Model

# Possible places of the repository: the working directory, or that of an editable install.
CHECKOUTS = (Path(), Path(__file__).parents[3])
# Options shown at once, and options folded away; tick boxes stand for --fix and --vary.
CYCLES = ("cycle", "cycles")  # shown if a record has several
SHOWN = ("model", "drive", "relaxation", *CYCLES)
FOLDED = (
    *FREED,
    *("starts", "max_time", "seed", "interior_mass", "time_shift"),
    *("profile", "mcmc"),
)
# Options that change the curves of a model.
OF_CURVES = ("drive", "relaxation", "interior_mass", "time_shift", *FREED)
POLL = 200  # interval between two looks at a running fit, ms
# Shared by all windows: one test is read, and one set of curves prepared, at a time.
READING, PREPARING = (
    ThreadPoolExecutor(1, thread_name_prefix=f"foamfit-{name}") for name in ("reading", "preparing")
)
COMPILING = (
    "The solver is being compiled, once after installation. This takes half a minute, or a minute "
    "on a busy machine. Meanwhile you can drop a test and fill in its specimen."
)
PROMPT = "To fit this test, fill in the {0} above, like {1}."
TEXT, FIELD = style("text"), style("field")
WRONG = FIELD + ".bk-input { border: 2px solid #b3261e; background: var(--bad); }"
STYLE: dict[str, Any] = {
    "stylesheets": [FIELD],
    "sizing_mode": "stretch_width",
    "margin": (3, 0),
}


class Window:
    """The page in one browser window; windows share nothing."""

    def __init__(
        self,
        desk: Desk,
        address: str,
        test: Path | None,
        first_use: FirstUse,
        gone: Callable[[], None],
    ) -> None:
        self.desk, self.first_use, self.curves = desk, first_use, Curves()
        self._shown: object = None
        self._filling = False
        self._asked = {READING: 0, PREPARING: 0}
        self._outputs()
        self._inputs(address)
        self.template = pn.Template((TEMPLATES / "page.html").read_text(encoding="utf-8"))
        fields = [*self.quantities.values()]
        first = grid(fields[:FIRST], 8.0)
        first.visible = True
        parts = {
            "test": [self.upload, self.chosen, first],
            "specimen": [*fields[FIRST:], self.rest],
            "columns": [self.picked],
            "check": [self.check, self.problem, self.remedies],
            "model": [self.options[name].widget for name in SHOWN],
            "more": [self.options[name].widget for name in FOLDED],
            "run": [self.run, self.stop, self.progress],
            "curves": [self.compiling, self.misfit, self.curves.view, self.back],
            "understood": [self.understood],
            "result": [self.saves, self.ending, self.report_of, self.report],
        }
        for name, widgets in parts.items():
            self.template.add_panel(name, pn.Column(*widgets, **WIDE))
        self._allow()
        document = pn.state.curdoc
        for part in first_use.parts:  # enable the buttons when the solver is compiled
            if not part.done():
                part.add_done_callback(lambda _: document.add_next_tick_callback(self._allow))
        self._poll = pn.state.add_periodic_callback(self._follow, POLL, start=False)
        pn.state.on_session_destroyed(lambda _: gone())
        pn.state.onload(send_at_once)
        if test is not None:
            pn.state.onload(partial(self._take, test))

    # ------------------------------------------------------------------------------- the parts

    def _inputs(self, address: str) -> None:
        text, select = (partial(getattr(pn.widgets, n), **STYLE) for n in ("TextInput", "Select"))

        def button(name: str, do: Callable[[Any], None], kind: str = "default", **more: Any) -> Any:
            made = pn.widgets.Button(name=name, button_type=kind, **more, **STYLE)
            made.on_click(do)
            return made

        self.upload = Upload(address=address, limit=LARGEST, sizing_mode="stretch_width")
        self.upload.on_msg(self._received)
        listed = [sorted(one.glob("experiments/foam-*/*-reconstruction.csv")) for one in CHECKOUTS]
        found = next(filter(None, listed), [])
        self.reconstructions = {f"{one.parent.name}: {one.stem}": one for one in found}
        self.chosen = select(
            name="or a reconstruction of the repository",
            options=["", *self.reconstructions],
            visible=bool(found),
        )
        self.chosen.param.watch(self._choose, "value")
        self.quantities = {
            name: text(name=label, placeholder=f"like {example}")
            for name, (label, example) in QUANTITIES.items()
        }
        self.rest = pn.widgets.TextAreaInput(
            name="Further TOML: name, [columns], [noise], [window]",
            placeholder='[columns]\nforce = { column = "Load", unit = "kN" }',
            rows=4,
            max_length=20_000,
            **STYLE,
        )
        self.check = button("Check the test", self._check)
        self.remedies = pn.Column(**WIDE)
        self.pickers = {
            channel: (
                select(name=f"Column of the {channel}", options=[""]),
                select(name=f"Unit of the {channel}", options=["", *filter(None, units)]),
            )
            for channel, units in previews.UNITS.items()
        }
        for channel, pair in self.pickers.items():
            for field in pair:
                field.param.watch(partial(self._picked, channel), "value")
        self.picked = pn.Column(*(grid([*pair], 8.0) for pair in self.pickers.values()), **WIDE)
        for row in self.picked:
            row.visible = True
        lists = {"model": models(), "relaxation": [*range(RELAXATIONS)]}
        self.options = {name: Field(name, lists.get(name), **STYLE) for name in (*SHOWN, *FOLDED)}
        self.model, _, self.relaxation, *self.cycles = (self.options[n].widget for n in SHOWN)
        for field in self.cycles:
            field.visible = False
        self.run = button("Fit", self._run, "primary", disabled=True)
        self.stop = button("Stop, and keep the best", self._stop, "danger", visible=False)
        self.back = button("Back to the fit", self._back, visible=False)
        self.report_of = select(name="Report and curves of cycle", options=[0], visible=False)
        self.report_of.param.watch(self._back, "value")
        self.fields = (*self.quantities.values(), self.rest, *self.cycles)
        for field in self.fields:
            field.param.watch(self._edited, "value")
        for name in ("model", *OF_CURVES):
            self.options[name].widget.param.watch(self._model_chosen, "value")
        save = partial(pn.widgets.FileDownload, embed=False, auto=True, **STYLE)
        saves = (
            ("the result folder", "result.zip", lambda: BytesIO(self.desk.zipped())),
            ("the report", "report.html", lambda: BytesIO(self._report().encode())),
            ("the TOML", "test.toml", lambda: BytesIO(self.desk.toml)),
            ("the LS-DYNA card", "card.zip", lambda: BytesIO(self.desk.card(self.report_of.value))),
            (
                "the test plan",
                "plan.html",
                lambda: BytesIO(self.desk.planned(self.report_of.value)),
            ),
        )
        self.saves = grid(
            [save(label=f"Save {s}", filename=n, callback=c) for s, n, c in saves], 11.0
        )

    def _report(self) -> str:
        """Return the HTML report of the fit, or of the selected cycle."""
        return (self.desk.fits[self.report_of.value] / "report.html").read_text(encoding="utf-8")

    def _outputs(self) -> None:
        """Create the panes for text, which is escaped before it is put there."""
        style = {"stylesheets": [TEXT], "sizing_mode": "stretch_width", "margin": (4, 0)}
        places = [pn.pane.HTML("", **style) for _ in range(7)]
        self.problem, self.progress, self.compiling, self.understood = places[:4]
        self.ending, self.misfit, self.report = places[4:]
        self.understood.object = soft("There is no test yet.")
        self.ending.object = soft("There is no fit yet.")

    # ------------------------------------------------------------------------------- beside

    def _allow(self) -> None:
        """Enable the Fit button: there is a test, the solver is compiled, and no fit is running."""
        compiled = self.first_use.needed(self.model.value, self.relaxation.value).done()
        self.compiling.object = "" if compiled else piece("busy", COMPILING)
        ready = self.desk.measurement is not None and compiled
        self.run.disabled = not ready or self.desk.running

    def _beside(
        self, pool: ThreadPoolExecutor, work: Callable[[], Any], then: Callable[[Any], None]
    ) -> None:
        """Work in a thread, then show the result unless it is out of date.

        Results are shown in a callback of the document, because threads do not hold its lock.
        """
        self._asked[pool] += 1
        asked, document = self._asked[pool], pn.state.curdoc

        def last() -> bool:
            return asked == self._asked[pool]

        def run() -> None:
            if not last():
                return
            try:
                found = work()
            except Exception as error:  # show it; a thread would lose it
                found = error
            document.add_next_tick_callback(lambda: then(found) if last() else None)

        pool.submit(run)

    # ------------------------------------------------------------------------------- the test

    def _received(self, event: Any) -> None:
        if message(event).get("received"):
            self.chosen.value = ""
            self._read()

    def _choose(self, event: Any) -> None:
        if event.new in self.reconstructions:  # a browser must not name any other path
            self._take(self.reconstructions[event.new])

    def _take(self, path: Path) -> None:
        try:
            self.desk.take(path)
        except (InputError, OSError) as error:
            self.problem.object = wrong(error)
            return
        self._read()

    def _read(self) -> None:
        """Fill in the values of a dropped TOML, and check the test.

        Without a TOML the fields are cleared, as they belong to the specimen of the previous file.
        """
        try:
            found = self.desk.dropped_toml()
        except InputError as error:
            self.problem.object = wrong(error)
            return
        self._filling = True  # check once, after all fields are filled in
        if self.desk.worker is None:  # the displayed fit belongs to another test
            self._hide_result("There is no fit yet.")
            self.curves.held, self.curves.found = {}, {}
            for field in self.cycles:
                field.value = ""
        if found is not None or self.desk.replaced:
            quantities, self.rest.value = found or ({}, "")
            for name, field in self.quantities.items():
                field.value = quantities.get(name, "")
        self.desk.replaced = False
        self._filling = False
        self._check()

    def _edited(self, event: Any) -> None:
        if not self._filling and self.desk.csv is not None:
            self._check()

    def _check(self, event: Any = None) -> None:
        """Check the test with the values filled in, and show the outcome or the error."""
        given = {name: field.value or "" for name, field in self.quantities.items()}
        which = [argument for name in CYCLES for argument in self.options[name].arguments()]
        rest, self.run.disabled = self.rest.value or "", True
        self._asked[PREPARING] += 1  # curves in preparation belong to the old test
        self._beside(READING, lambda: self.desk.check(given, rest, which), self._show_checked)

    def _show_checked(self, found: str | Exception) -> None:
        error = found if isinstance(found, Exception) else ""
        missing = wrong_quantity(str(error))
        empty = bool(missing) and not self.quantities[missing].value
        self.problem.object = (
            soft(PROMPT.format(QUANTITIES[missing][0].lower(), QUANTITIES[missing][1]))
            if empty
            else wrong(error)
        )
        for name, field in self.quantities.items():
            field.stylesheets = [WRONG if name == missing and not empty else FIELD]
        if str(error) == BUSY:
            return
        self._offer(str(error))
        if error:
            csv, rest = self.desk.csv, self.rest.value or ""
            if csv is not None:
                self._beside(PREPARING, lambda: previews.preview(csv, rest), self._show_preview)
        unread = "The test cannot be read yet; see the error message."
        self.understood.object = soft(unread) if error else piece("verbatim", found)
        self._allow()
        if self.desk.measurement is not None:
            count = len(self.desk.measurement.cycles)
            for field in self.cycles:
                field.visible = count > 1
            self.cycles[0].name = f"{self.options['cycle'].label} This record has {count}."
        self._model_chosen()

    def _offer(self, message: str) -> None:
        """Show the entries of [columns] that a message proposes as buttons."""

        def use(channel: str, content: str) -> Any:
            made = pn.widgets.Button(name=previews.in_words(channel, content), **STYLE)
            made.on_click(lambda _: self._add_column(channel, content))
            return made

        self.remedies[:] = [use(*one) for one in previews.remedies(message)]

    def _add_column(self, channel: str, content: str) -> None:
        try:
            self.rest.value = previews.with_column(self.rest.value or "", channel, content)
        except InputError as error:
            self.problem.object = wrong(error)

    def _picked(self, channel: str, event: Any) -> None:
        """Enter the column and unit that were chosen from the lists."""
        column, unit = (field.value for field in self.pickers[channel])
        if self._filling or self.desk.csv is None:
            return
        given = f"column = {json.dumps(column, ensure_ascii=False)}" if column else ""
        self._add_column(channel, given + (f', unit = "{unit}"' if given and unit else ""))

    def _show_preview(self, found: previews.Preview | Exception) -> None:
        """Show the curves of a file whose specimen is not known yet, and its columns."""
        if isinstance(found, Exception):
            return
        self._filling = True
        for column, _ in self.pickers.values():
            if column.options != ["", *found.headers]:
                column.param.update(options=["", *found.headers], value="")
        self._filling = False
        if found.picture is not None:
            png = base64.b64encode(found.picture).decode()
            self.misfit.object = piece("preview", png)

    # ------------------------------------------------------------------------------- the curves

    def _model_chosen(self, event: Any = None) -> None:
        """Show the curves of the model, with start values read off the measured loop."""
        auto = self.model.value == "auto"
        self._allow()
        self.relaxation.disabled, self.curves.sliders.ticks = auto, not auto
        if self.desk.measurement is None:
            self._hide_curves()
            return
        try:
            asked = parsed(self._arguments(ticked=False))
        except InputError:  # reported when the fit is started
            asked = parsed([])
        model = models()[1] if auto else self.model.value
        self._turn_model(model, self.desk.measurement, **keywords(asked))

    def _hide_curves(self, why: object = "") -> None:
        self.curves.hide()
        self.misfit.object = wrong(why)

    def _turn_model(
        self,
        model: str,
        of: Measurement | News,
        values: Mapping[str, float] | None = None,
        **options: Any,
    ) -> None:
        """Show the sliders of a model, at `values` or at values read off the measured loop.

        `of` gives the cycles: a test, or the report of a fit.
        """

        def make() -> Turning:
            self.first_use.needed(model, options["relaxation"]).result()
            test = self.desk.measured(of.cycle, of.last_cycle)
            made = Turning(test, model, values, **options)
            made.turn({})  # load the compiled code
            return made

        what = f"Preparing the curves of {law_in_words(model, options['relaxation'])} …"
        if self.curves.turning is None and not self.compiling.object:
            self.misfit.object = piece("busy", what)
        else:
            self.curves.sliders.tell(what)
        self._beside(PREPARING, make, self._show_turning)

    def _show_turning(self, made: Turning | Exception) -> None:
        if isinstance(made, Exception):
            self._hide_curves(made)
            return
        self.misfit.object = ""
        self.curves.show(made)

    # ------------------------------------------------------------------------------- the fit

    def _arguments(self, ticked: bool = True) -> list[str]:
        """Return the arguments of `foamfit fit` for the values filled in."""
        auto = self.model.value == "auto"
        hidden = {"relaxation": auto} | dict.fromkeys(CYCLES, not self.cycles[0].visible)
        shown = (field for name, field in self.options.items() if not hidden.get(name))
        given = [argument for field in shown for argument in field.arguments()]
        if auto or not ticked:
            return given
        held, varied = self.curves.chosen()
        given += [f"--fix={name}={value!r}" for name, value in held.items()]
        return given + [f"--vary={name}" for name in varied]

    def _run(self, event: Any = None) -> None:
        try:
            arguments = self._arguments()
            self.desk.fit(arguments)
        except InputError as error:
            self.progress.object = wrong(error)
            return
        self.run.disabled, self.stop.visible, self.stop.disabled = True, True, False
        self._hide_result("A fit is running.")
        self.curves.found = {}
        for field in (*self.fields, self.chosen, self.check):  # the test must not change
            field.disabled = True
        self._poll.start()

    def _hide_result(self, why: str) -> None:
        self.saves.visible = self.back.visible = False
        self.report_of.visible = False
        self.report.object = ""
        self.ending.object = soft(why)

    def _stop(self, event: Any = None) -> None:
        if self.desk.worker is not None:
            self.desk.worker.stop()
            self.stop.disabled = True

    def _follow(self) -> None:
        """Show the progress of the fit, and its result when it has ended."""
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
        what = "stopping; the best point is kept" if worker.stopping else news.what
        text = f"{what}, {share} %"
        if news.misfit:
            text += f"; best misfit {misfits_text(news.misfit)}"
        self.progress.object = piece("progress", share, text)
        self._show_best(news)

    def _show_best(self, news: News) -> None:
        """Draw the curves of the best point so far, and move the sliders to it."""
        if not news.values or self.desk.measurement is None:
            return
        now = self.curves.turning
        test = None if now is None else now.problem.measurement
        shown = now and test and (now.law, now.drive, test.cycle, test.last_cycle)
        law = law_in_words(news.model, news.relaxation)
        if shown != (law, news.drive, news.cycle, news.last_cycle):
            self._turn_fitted(news)
        else:
            self.curves.put(news.values)

    def _turn_fitted(self, news: News) -> None:
        """Show the curves of the last fit at the reported values."""
        assert self.desk.worker is not None
        options = keywords(parsed(self.desk.worker.job.arguments))
        options |= {"relaxation": news.relaxation, "drive": news.drive}
        self._turn_model(news.model, news, news.values, **options)

    def _ended(self) -> None:
        """Show the result of the fit, or why it failed."""
        self._allow()
        self.stop.visible = False
        self.progress.object = piece("ended")
        for field in (*self.fields, self.chosen, self.check):
            field.disabled = False
        if self.desk.result is None:
            self.ending.object = wrong(self.desk.ending())
            return
        assert self.desk.worker is not None
        told, picture = self.desk.worker.told, self.desk.result / "cycles.png"
        self.ending.object = soft(f"In a terminal: {self.desk.command}")
        if told:
            self.ending.object += piece("verbatim", told)
        if told and picture.is_file():
            png = base64.b64encode(picture.read_bytes()).decode()
            self.ending.object += piece("cycles", png)
        fits = [*self.desk.fits]
        self.saves.visible = True
        self.back.visible, self.report_of.visible = bool(fits), len(fits) > 1
        if not fits:
            return
        self.report_of.param.update(options=fits, value=fits[0])
        self._back()

    def _back(self, event: Any = None) -> None:
        """Show the report of the fit, and move the sliders back to its values."""
        cycle = self.report_of.value
        if cycle not in self.desk.fits:
            return
        self.report.object = piece("report", self._report())
        fit = load_result(self.desk.fits[cycle])
        self.curves.found = fit["parameters"]
        values = {name: one["value"] for name, one in fit["parameters"].items()}
        place = {name: fit[name] for name in ("relaxation", "drive")}
        place |= {name: fit["data"][name] for name in ("cycle", "last_cycle")}
        self._turn_fitted(News(values=values, model=Model.of_result(fit).name, **place))


def keywords(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that change the curves of a model."""
    return {one: asked[one] for one in OF_CURVES}


def models() -> list[str]:
    """Return the models in the list: each law alone, on a linear spring, and twice."""
    alone = [kind for kind in laws.kinds() if laws.law(kind).hysteretic]
    return ["auto", *alone, *(f"linear+{one}" for one in alone), *(f"{one}+{one}" for one in alone)]


def send_at_once() -> None:
    """Send messages of this window without waiting for acknowledgements (40 ms each).

    Bokeh gives no public access to its sockets; if this fails, curves are drawn late.
    """
    with suppress(AttributeError):
        for connection in pn.state.curdoc.session_context.session._subscribed_connections:
            connection._socket.set_nodelay(True)


def soft(text: str) -> str:
    """Return a text as a paragraph in a muted colour."""
    return piece("paragraph", text, "soft")


def wrong(error: object) -> str:
    """Return an error as a paragraph, "" for none; unexpected errors are called defects."""
    text = str(error)
    if isinstance(error, Exception) and not isinstance(
        error, InputError | SimulationError | OSError
    ):
        text = f"This is a defect of foamfit, please report it ({type(error).__name__}: {error})."
    return piece("paragraph", text, "error") if text else ""
