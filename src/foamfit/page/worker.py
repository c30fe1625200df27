"""Processes of the page: a fit, and the compilation of the solver.

The process of a fit reports through a pipe. A message to it ends its search and keeps the best
point, as Ctrl-C does in a terminal.
"""

from __future__ import annotations

import _thread
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache as once, partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.fitting.problem import Problem
from foamfit.options import OPTIONS
from foamfit.solve import cache
from foamfit.solve.precompile import LOOPS, compile_solver
from foamfit.springs import laws
from foamfit.study.processes import FITS, PAGES, context_of
from foamfit.terminal import APART, Watcher, ending_cleanly, without_ctrl_c

COMPILING = "compiling the solver, once after installation"
STOP = "stop"
STOPPED_EARLY = "The fit was stopped before it had a result; start it again."


@dataclass(frozen=True)
class Job:
    """A fit to run: files, result folder and arguments of `foamfit fit`."""

    csv: Path
    toml: Path
    folder: Path
    arguments: list[str] = field(default_factory=list)
    laws: dict[str, str] = field(default_factory=laws.texts)  # the texts of law files, by path


@dataclass(frozen=True)
class News:
    """Report of a running fit; `values` are the parameters of `model` by name, SI."""

    fraction: float = 0.0
    what: str = "starting"
    model: str = ""
    relaxation: int = 0
    drive: str = ""
    cycle: int = 1
    last_cycle: int | None = None
    values: dict[str, float] = field(default_factory=dict)
    misfit: dict[str, float | None] = field(default_factory=dict)


@once
def processes() -> Any:
    """Return the context of the page's processes, which share the imports of a fit."""
    return context_of(("foamfit.cli.fit", *FITS, *PAGES))


class Worker:
    """A fit in another process; `tell` is called in a thread at each report and at the end."""

    def __init__(self, job: Job, tell: Callable[[], object] = lambda: None) -> None:
        self.job, self.news, self._tell = job, News(), tell
        self.ended: str | None = None  # after the end: why there is no result, or ""
        self._pipe, there = processes().Pipe()
        self.process = processes().Process(target=run, args=(job, there), daemon=True)
        self.process.start()
        there.close()  # so that the pipe ends with the process
        threading.Thread(target=self._listen, daemon=True).start()

    def stop(self) -> None:
        """Stop the search; the result of the best point is still written."""
        with suppress(OSError):  # the process has ended
            self._pipe.send(STOP)

    def end(self) -> None:
        """End the process at once."""
        self.process.kill()
        self.process.join()

    def _listen(self) -> None:
        done: str | None = None
        with suppress(EOFError, OSError):
            while done is None:
                if isinstance(report := self._pipe.recv(), News):
                    self.news = report
                    self._tell()
                else:
                    done = report
        self.process.join()
        if done is None:
            code = self.process.exitcode or 0
            how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
            done = f"The process of the fit has died {how}; start the fit again."
        self.ended = done
        self._tell()


class FirstUse:
    """Compiles the solver in another process, once after installation; `done` is the end of it."""

    def __init__(self) -> None:
        self.process = processes().Process(target=_compile, daemon=True)
        pool = ThreadPoolExecutor(1, thread_name_prefix="foamfit-compiling")
        self.done: Future[None] = pool.submit(self._compile)

    def _compile(self) -> None:
        if not all(map(cache.compiled, LOOPS)):
            self.process.start()
            self.process.join()

    def close(self) -> None:
        """Stop compiling."""
        if self.process.pid is not None:
            self.process.kill()


def _leave_terminal() -> None:
    """Keep Ctrl-C in the terminal from this process: the server of the page ends it."""
    if hasattr(os, "setpgrp"):  # not on Windows
        os.setpgrp()


def _compile() -> None:
    _leave_terminal()
    compile_solver("auto")


class _Teller(Watcher):
    """Reports a fit to the page a few times a second."""

    def __init__(self, pipe: Connection) -> None:
        super().__init__(says=False)
        self.pipe, self.news = pipe, News()
        self._said = 0.0

    def progress(self, fraction: float, what: str) -> None:
        """Report the completed fraction at each new step, and every `APART` seconds."""
        new, self.news = what != self.news.what, replace(self.news, fraction=fraction, what=what)
        self.look()
        if new or time.monotonic() - self._said >= APART:
            self._say()

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Report the parameters and misfits of the best point so far."""
        self.news = replace(
            self.news,
            model=problem.model.name,
            relaxation=problem.model.relaxation,
            drive=problem.objective.drive,
            cycle=problem.measurement.cycle,
            last_cycle=problem.measurement.last_cycle,
            values=dict(zip(problem.names, (values + problem.origins).tolist(), strict=True)),
            misfit=misfit,
        )
        self._say()

    def _say(self) -> None:
        self._said = time.monotonic()
        self.pipe.send(self.news)


def parsed(arguments: list[str]) -> dict[str, Any]:
    """Parse arguments as `foamfit fit` does; InputError names the wrong one."""
    import click

    from foamfit.cli.fit import fit as command

    # A browser must not name a law file, because law files are code.
    own = click.Command("fit", params=[one for one in command.params if one.name != "law"])
    try:
        context = own.make_context("fit", ["TEST.csv", *arguments])
    except click.ClickException as error:
        raise InputError(error.format_message()) from None
    kept = OPTIONS.keys() - {"specimen"}
    return {name: value for name, value in context.params.items() if name in kept}


def _fitted(job: Job, teller: _Teller) -> str:
    """Fit and write the result; return why the fit failed, or ""."""
    from foamfit.cli.fit import read_as_asked

    try:
        threading.Thread(target=_wait_for_stop, args=(teller.pipe,), daemon=True).start()
        laws.load_texts(job.laws)
        ready = read_as_asked(job.csv, job.toml, parsed(job.arguments))
        compile_solver(ready.model, partial(teller.progress, 0.0, COMPILING))
        with as_signalled():
            found = ready.fit(teller)
        with without_ctrl_c():
            teller.progress(1.0, "writing the report")
            found.save(job.folder)
    except (InputError, SimulationError) as error:
        return str(error)
    except KeyboardInterrupt:
        return STOPPED_EARLY
    return ""


def _wait_for_stop(pipe: Connection) -> None:
    with suppress(EOFError, OSError):
        if pipe.recv() == STOP:
            _thread.interrupt_main()


def run(job: Job, pipe: Connection) -> None:
    """Run a job; reports, and in the end its outcome, go to a pipe."""
    _leave_terminal()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # by which a fit is stopped
    with ending_cleanly():
        pipe.send(_fitted(job, _Teller(pipe)))
