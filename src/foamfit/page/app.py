"""One window of the page: its parts, and the actions of its buttons.

`desk` and `turning` compute, as the commands do; this module calls them and shows the results.
Content of files is always shown as escaped text.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import panel as pn

from foamfit.data.measurement import Measurement
from foamfit.errors import InputError
from foamfit.page import desk as desks, inputs as ui
from foamfit.page.curves import Curves, misfits_text
from foamfit.page.turning import Turning
from foamfit.page.worker import FirstUse, News, parsed
from foamfit.parts import law_in_words
from foamfit.report.folder import load_result
from foamfit.springs.model import Model
from foamfit.study.identified import load

EXAMPLE = Path(__file__).with_name("example") / "foam.csv"
# Shared by all windows: one test is read, and one set of curves prepared, at a time.
READING, PREPARING = (
    ThreadPoolExecutor(1, thread_name_prefix=f"foamfit-{name}") for name in ("reading", "preparing")
)
COMPILING = (
    "The solver is being compiled, once after installation. This takes half a minute, or a minute "
    "on a busy machine. Meanwhile you can drop a test and fill in its specimen."
)
PROMPT = "To fit this test, fill in the {0} above, like {1}."


class Window:
    """The page in one browser window; windows share nothing."""

    def __init__(
        self, desk: desks.Desk, test: Path | None, first_use: FirstUse, gone: Callable[[], None]
    ) -> None:
        self.desk, self.first_use, self.curves = desk, first_use, Curves()
        self._asked = {READING: 0, PREPARING: 0}
        self.received, self.problem, self.progress, self.compiling = (ui.text() for _ in range(4))
        self.understood, self.ending, self.misfit, self.report = (ui.text() for _ in range(4))
        self.understood.object = ui.soft("There is no test yet.")
        self.ending.object = ui.soft("There is no fit yet.")
        self.inputs = ui.Inputs(self._edited, self._model_chosen, self._refuse)
        self.upload = pn.widgets.FileDropper(
            name=f"Drop a CSV here (and its TOML), {desks.LARGEST // 2**20} MB at most",
            multiple=True,
            previews=[],
            height=96,  # the list of files below its label stays hidden
            **ui.STYLE,
        )
        self.upload.param.watch(self._received, "value")
        self.example = ui.button("Try an example", lambda _: self._take(EXAMPLE))
        self.check = ui.button("Check the test", self._check)
        self.remedies = pn.Column(**ui.WIDE)
        self.run = ui.button("Fit", self._run, "primary", disabled=True)
        self.stop = ui.button("Stop, and keep the best", self._stop, "danger", visible=False)
        self.back = ui.button("Back to the fit", self._back, visible=False)
        self.report_of = pn.widgets.Select(
            name="Report and curves of cycle", options=[0], visible=False, **ui.STYLE
        )
        self.report_of.param.watch(self._back, "value")
        self.saves = self._saves()
        self.template = self._template()
        self._allow()
        document = pn.state.curdoc
        if not first_use.done.done():  # enable the buttons when the solver is compiled
            first_use.done.add_done_callback(lambda _: document.add_next_tick_callback(self._allow))
        pn.state.on_session_destroyed(lambda _: gone())
        if test is not None:
            pn.state.onload(partial(self._take, test))

    def _template(self) -> Any:
        """Return the page with its parts in their places."""
        made = pn.Template((ui.TEMPLATES / "page.html").read_text(encoding="utf-8"))
        inputs = self.inputs.parts
        parts = inputs | {
            "test": [self.upload, self.received, self.example, *inputs["test"]],
            "check": [self.check, self.problem, self.remedies],
            "run": [self.run, self.stop, self.progress],
            "curves": [self.compiling, self.misfit, self.curves.view, self.back],
            "understood": [self.understood],
            "result": [self.saves, self.ending, self.report_of, self.report],
        }
        for name, widgets in parts.items():
            made.add_panel(name, pn.Column(*widgets, **ui.WIDE))
        return made

    def _saves(self) -> Any:
        """Return the buttons that save parts of a result."""

        def save(what: str, name: str, content: Callable[[], bytes]) -> Any:
            how: Any = {"filename": name, "callback": lambda: BytesIO(content()), **ui.STYLE}
            return pn.widgets.FileDownload(label=f"Save {what}", embed=False, auto=True, **how)

        saves = [
            save("the result folder", "result.zip", self.desk.zipped),
            save("the report", "report.html", lambda: self._report().encode()),
            save("the LS-DYNA card", "card.zip", lambda: self.desk.card(self.report_of.value)),
            save("the test plan", "plan.html", lambda: self.desk.planned(self.report_of.value)),
        ]
        return ui.grid(saves, 11.0)

    def _report(self) -> str:
        return (self.desk.fits[self.report_of.value] / "report.html").read_text(encoding="utf-8")

    def _allow(self) -> None:
        """Enable the Fit button: there is a test, the solver is compiled, and no fit is running."""
        compiled = self.first_use.done.done()
        self.compiling.object = "" if compiled else ui.piece("busy", COMPILING)
        self.run.disabled = self.desk.measurement is None or not compiled or self.desk.running

    def _beside(
        self, pool: ThreadPoolExecutor, work: Callable[[], Any], then: Callable[[Any], None]
    ) -> None:
        """Work in a thread, then show the result unless it is out of date."""
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
            # In a callback of the document, because a thread does not hold its lock
            document.add_next_tick_callback(lambda: then(found) if last() else None)

        pool.submit(run)

    def _refuse(self, error: object) -> None:
        self.problem.object = ui.wrong(error)

    def _received(self, event: Any) -> None:
        """Take the files that were dropped."""
        files = dict(self.upload.value)
        self.upload.value.clear()  # so that the same file can be dropped again
        for name, content in files.items():
            raw = content.encode() if isinstance(content, str) else content  # as Panel decoded it
            self._read(partial(self.desk.receive, name, raw), table=not name.endswith(".toml"))

    def _take(self, path: Path) -> None:
        self._read(partial(self.desk.take, path))

    def _read(self, receive: Callable[[], desks.Fields | None], *, table: bool = True) -> None:
        """Receive files, fill in the values of a TOML, and check the test."""
        try:
            found = receive()
        except (InputError, OSError) as error:
            self.received.object = ui.wrong(error)
            return
        if table:
            self.received.object = ui.soft(self.desk.given)
        new = self.desk.worker is None
        if new:  # the displayed fit belongs to another test
            self._hide_result("There is no fit yet.")
            self.curves.held, self.curves.found = {}, {}
        if found is not None:  # without a TOML empty: the fields were those of another specimen
            self.inputs.fill(found, cycles=new)
        self._check()

    def _edited(self) -> None:
        if self.desk.csv is not None:
            self._check()

    def _check(self, event: Any = None) -> None:
        """Check the test with the values filled in, and show the outcome or the error."""
        self.run.disabled = True
        self._asked[PREPARING] += 1  # curves in preparation belong to the old test
        self.curves.sliders.waiting = True  # a move would be lost
        given = self.inputs.given()
        self._beside(READING, lambda: self.desk.check(*given), self._show_checked)

    def _show_checked(self, found: str | Exception) -> None:
        error = found if isinstance(found, Exception) else ""
        missing = desks.wrong_quantity(str(error))
        if missing and not self.inputs.quantities[missing].value:
            label, example = desks.QUANTITIES[missing]
            self.problem.object = ui.soft(PROMPT.format(label.lower(), example))
        else:
            self._refuse(error)
        self._offer(str(error))
        if error and (csv := self.desk.csv) is not None:
            rest = self.inputs.rest.value or ""
            self._beside(READING, lambda: desks.preview(csv, rest), self._show_preview)
        unread = "The test cannot be read yet; see the error message."
        self.understood.object = ui.soft(unread) if error else ui.piece("verbatim", found)
        if self.desk.measurement is not None:
            self.inputs.show_cycles(len(self.desk.measurement.cycles))
        self._model_chosen()

    def _offer(self, message: str) -> None:
        """Show what a message proposes as buttons."""
        self.remedies[:] = [
            ui.button(words, partial(self.inputs.add_column, *one))
            for words, one in desks.remedies(message).items()
        ]

    def _show_preview(self, found: desks.Preview | Exception) -> None:
        """Show the curves of a file whose specimen is not known yet, and its columns."""
        if isinstance(found, Exception):
            return
        self.inputs.offer(found.headers)
        if found.why:
            self._offer(found.why)
        if found.picture is not None:
            self.misfit.object = ui.piece("preview", base64.b64encode(found.picture).decode())

    def _model_chosen(self) -> None:
        """Show the curves of the model, with start values read off the measured loop."""
        auto = self.inputs.auto
        self._allow()
        self.inputs.relaxation.disabled, self.curves.sliders.ticks = auto, not auto
        if self.desk.measurement is None:
            self._show_turning("")
            return
        try:
            asked = parsed(self.inputs.arguments())
        except InputError:  # reported when the fit is started
            asked = parsed([])
        model = ui.models()[1] if auto else self.inputs.model.value
        self._turn_model(model, self.desk.measurement, asked, {})

    def _turn_model(
        self, model: str, of: Measurement | News, asked: dict[str, Any], values: dict[str, float]
    ) -> None:
        """Show the sliders of a model, at `values` or at values read off the measured loop.

        `of` gives the cycles: a test, or the report of a fit. `asked` are the options of the fit.
        """
        options: Any = {one: asked[one] for one in ui.OF_CURVES}

        def make() -> Turning:
            self.first_use.done.result()
            made = Turning(self.desk.measured(of.cycle, of.last_cycle), model, values, **options)
            made.turn({})  # load the compiled code
            return made

        self.curves.sliders.waiting = True
        what = law_in_words(model, options["relaxation"])
        self.misfit.object = ui.piece("busy", f"Preparing the curves of {what} …")
        self._beside(PREPARING, make, self._show_turning)

    def _show_turning(self, made: Turning | Exception | str) -> None:
        """Show curves, or hide them and show why there are none."""
        if isinstance(made, Turning):
            self.misfit.object = ""
            self.curves.show(made)
        else:
            self.curves.hide()
            self.misfit.object = ui.wrong(made)

    def _run(self, event: Any = None) -> None:
        arguments = self.inputs.arguments()
        if not self.inputs.auto:
            held, varied = self.curves.chosen()
            arguments += [f"--fix={name}={value!r}" for name, value in held.items()]
            arguments += [f"--vary={name}" for name in varied]
        document = pn.state.curdoc
        try:
            self.desk.fit(arguments, lambda: document.add_next_tick_callback(self._follow))
        except InputError as error:
            self.progress.object = ui.wrong(error)
            return
        self._hide_result("A fit is running.")
        self.curves.found = {}
        self._hold(True)

    def _hold(self, running: bool) -> None:
        """Keep the test from being changed during a fit, which can be stopped."""
        self.inputs.hold(running)
        self.example.disabled = self.check.disabled = running
        self.stop.param.update(visible=running, disabled=False)
        self._allow()

    def _hide_result(self, why: str) -> None:
        self.saves.visible = self.back.visible = self.report_of.visible = False
        self.report.object = ""
        self.ending.object = ui.soft(why)

    def _stop(self, event: Any = None) -> None:
        if self.desk.worker is not None:
            self.desk.worker.stop()
            self.stop.disabled = True

    def _follow(self) -> None:
        """Show the progress of the fit, and its result when it has ended."""
        if (worker := self.desk.worker) is None:
            return
        if worker.ended is not None:
            self._ended()
            return
        news, share = worker.news, round(100 * worker.news.fraction)
        what = "stopping; the best point is kept" if self.stop.disabled else news.what
        best = f"; best misfit {misfits_text(news.misfit)}" if news.misfit else ""
        self.progress.object = ui.piece("progress", share, f"{what}, {share} %{best}")
        self._show_best(news)

    def _show_best(self, news: News) -> None:
        """Draw the curves of the best point so far, and move the sliders to it."""
        if not news.values or self.desk.measurement is None:
            return
        law, shown = law_in_words(news.model, news.relaxation), None
        if (now := self.curves.turning) is not None:
            test = now.problem.measurement
            shown = now.law, now.drive, test.cycle, test.last_cycle
        if shown == (law, news.drive, news.cycle, news.last_cycle):
            self.curves.put(news.values)
        else:
            self._turn_fitted(news)

    def _turn_fitted(self, news: News) -> None:
        """Show the curves of the last fit at the reported values."""
        assert self.desk.worker is not None
        asked = parsed(self.desk.worker.job.arguments)
        asked |= {"relaxation": news.relaxation, "drive": news.drive}
        self._turn_model(news.model, news, asked, news.values)

    def _ended(self) -> None:
        """Show the result of the fit, or why it failed."""
        self._hold(False)
        self.received.object = ui.soft(self.desk.given)  # a file may have been refused meanwhile
        self.progress.object = ui.piece("ended")
        if (result := self.desk.result) is None:
            self.ending.object = ui.wrong(self.desk.ending())
            return
        ending = ui.soft(f"In a terminal, in the saved folder: {self.desk.command}")
        if (picture := result / "cycles.png").is_file():
            cycles: Any = load(result)
            png = base64.b64encode(picture.read_bytes()).decode()
            ending += ui.piece("verbatim", cycles.text()) + ui.piece("cycles", png)
        self.ending.object = ending
        fits = [*self.desk.fits]
        self.saves.visible = self.back.visible = True
        self.report_of.param.update(options=fits, value=fits[0], visible=len(fits) > 1)
        self._back()

    def _back(self, event: Any = None) -> None:
        """Show the report of the fit, and move the sliders back to its values."""
        if (cycle := self.report_of.value) not in self.desk.fits:
            return
        self.report.object = ui.piece("report", self._report())
        fit = load_result(self.desk.fits[cycle])
        self.curves.found = fit["parameters"]
        values = {name: one["value"] for name, one in fit["parameters"].items()}
        place = {name: fit[name] for name in ("relaxation", "drive")}
        place |= {name: fit["data"][name] for name in ("cycle", "last_cycle")}
        self._turn_fitted(News(values=values, model=Model.of_result(fit).name, **place))
