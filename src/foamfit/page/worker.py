"""Processes of the page: a fit, and the compilation of the solver.

The process of a fit reads a job as one line of JSON and reports in lines of JSON. The line "stop"
ends its search and keeps the best point, as Ctrl-C does in a terminal.
"""

from __future__ import annotations

import _thread
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit.cli.progress import APART, Watcher
from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.solve import cache
from foamfit.springs.model import Model
from foamfit.system import apart, end_all

if TYPE_CHECKING:
    from foamfit.arrays import Array
    from foamfit.fitting.problem import Problem

PACKAGE = Path(__file__).parent.parent
COMPILING = "compiling the solver, once after installation"
# Compiled in this order, for springs without and with memory: model, and the function that is
# cached last.
COMPILED = (("bistable", "integrate"), ("microscale", "follow"))
COMPILE = """from foamfit.solve.precompile import compile_solver
compile_solver({!r}, lambda: None)"""
STOP = "stop"
STOPPED_EARLY = "The fit was stopped before it had a result; start it again."


@dataclass(frozen=True)
class Job:
    """A fit to run: files, result folder and arguments of `foamfit fit`."""

    csv: str
    toml: str
    folder: str
    arguments: list[str] = field(default_factory=list)
    laws: dict[str, str] = field(default_factory=dict)  # the texts of law files, by path


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


def with_package() -> dict[str, str]:
    """Return an environment in which a process imports this copy of the package."""
    paths = f"{PACKAGE.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    return os.environ | {"PYTHONPATH": paths.rstrip(os.pathsep)}


class Worker:
    """A fit in another process: its last report, and how it ended."""

    def __init__(self, job: Job) -> None:
        self.job, self.news = job, News()
        self.stopping = False
        self.told = ""  # text that the command prints for several cycles
        self.ended: str | None = None  # after the end: why there is no result, or ""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (closed when the process ends)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "foamfit.page.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            encoding="utf-8",
            env=with_package(),
            **apart(),
        )
        self._tell(json.dumps(vars(job)))
        threading.Thread(target=self._listen, daemon=True).start()

    def stop(self) -> None:
        """Stop the search; the result of the best point is still written."""
        if not self.stopping and self.process.poll() is None:
            self.stopping = True
            self._tell(STOP)

    def _tell(self, line: str) -> None:
        """Write a line to the process, unless it has ended."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError, ValueError):
            self.process.stdin.write(line + "\n")
            self.process.stdin.flush()

    def _listen(self) -> None:
        """Read the reports of the process until it ends."""
        assert self.process.stdout is not None
        done: str | None = None
        for line in self.process.stdout:
            try:
                report = json.loads(line)
            except ValueError:  # output of a library, or an incomplete line
                continue
            if "ended" in report:
                done, self.told = report["ended"], report.get("told", "")
            else:
                self.news = News(**report)
        code = self.process.wait()
        self.process.stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()  # type: ignore[union-attr]
        done = self._why(code) if done is None else done
        self._errors.close()
        self.ended = done

    def _why(self, code: int) -> str:
        """Describe how a process ended that did not report it."""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        last = lines[-1].strip() if lines else ""
        if self.stopping and (code == -signal.SIGINT or last == "KeyboardInterrupt"):
            return STOPPED_EARLY
        last = f" ({last})" if last else ""
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        return f"The process of the fit has died {how}{last}; start the fit again."


class FirstUse:
    """Compiles the solver in other processes, once after installation.

    The page stays responsive meanwhile.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        pool = ThreadPoolExecutor(1, thread_name_prefix="foamfit-compiling")
        self.parts = [pool.submit(self._compile, *part) for part in COMPILED]

    def needed(self, model: str, relaxation: int) -> Future[None]:
        """Return the compilation that must finish before a model is simulated."""
        memory = (
            model == "auto" or relaxation or any(one.remembers for one in Model.parse(model).laws)
        )
        return self.parts[-1 if memory else 0]

    def _compile(self, model: str, loop: str) -> None:
        if self._closed or cache.compiled(loop):
            return
        command = [sys.executable, "-c", COMPILE.format(model)]
        self._process = subprocess.Popen(command, env=with_package(), **apart())
        self._process.wait()

    def close(self) -> None:
        """Stop compiling."""
        self._closed = True
        if self._process is not None:
            end_all(self._process)


# --------------------------------------------------------------------- in the process of the fit


class _Teller(Watcher):
    """Reports a fit to the page a few times a second."""

    def __init__(self) -> None:
        super().__init__(says=False)
        self.told: dict[str, Any] = {}
        self._said = 0.0

    def progress(self, fraction: float, what: str, *, now: bool = False) -> None:
        """Report the completed fraction, at most once per `APART` seconds unless `now`."""
        self.told |= {"fraction": fraction, "what": what}
        if now and self._best is not None:
            self._next = 0.0
        self.look()
        if now or time.monotonic() - self._said >= APART:
            self._say()

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Report the parameters and misfits of the best point so far."""
        named = zip(problem.names, (values + problem.origins).tolist(), strict=True)
        self.told |= {
            "model": problem.model.name,
            "relaxation": problem.model.relaxation,
            "drive": problem.objective.drive,
            "cycle": problem.measurement.cycle,
            "last_cycle": problem.measurement.last_cycle,
            "values": dict(named),
            "misfit": misfit,
        }
        self._say()

    def _say(self) -> None:
        self._said = time.monotonic()
        _say(self.told)


def _say(told: dict[str, Any]) -> None:
    print(json.dumps(told), flush=True)


def parsed(arguments: list[str]) -> dict[str, Any]:
    """Parse arguments as `foamfit fit` does; InputError names the wrong one."""
    import click

    from foamfit.cli.fit import fit as command
    from foamfit.cli.options import Output

    # A browser must not name a law file, because law files are code.
    own = click.Command("fit", params=[one for one in command.params if one.name != "law"])
    try:
        context = own.make_context("fit", ["TEST.csv", *arguments])
    except click.ClickException as error:
        raise InputError(error.format_message()) from None
    others = {"test", "specimen", "force", "verbose", *Output.__dataclass_fields__} - {
        "figure_width"
    }
    return {name: value for name, value in context.params.items() if name not in others}


def _run(job: Job) -> tuple[str, str]:
    """Fit and write the result; return why the fit failed or "", and the text on cycles."""
    try:
        from foamfit.cli.fit import read_as_asked
        from foamfit.solve.precompile import compile_solver
        from foamfit.terminal import without_ctrl_c

        teller, asked = _Teller(), parsed(job.arguments)
        width = asked.pop("figure_width")
        tell = partial(teller.progress, 0.0, COMPILING, now=True)
        ready = read_as_asked(Path(job.csv), Path(job.toml), asked)
        compile_solver(asked["model"], tell)
        with as_signalled():
            found = ready.fit(teller)
        with without_ctrl_c():
            teller.progress(1.0, "writing the report", now=True)
            found.save(job.folder, figure_width=width)
            told = "" if ready.several is None else found.text()
    except (InputError, SimulationError) as error:
        return str(error), ""
    except KeyboardInterrupt:
        return STOPPED_EARLY, ""
    return "", told


def _wait_for_stop() -> None:
    """Interrupt the main thread when stdin says so."""
    if sys.stdin.readline().strip() == STOP:
        _thread.interrupt_main()


def main() -> None:
    """Run the job that stdin describes."""
    from foamfit.springs import laws
    from foamfit.terminal import ending_cleanly

    job = Job(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_wait_for_stop, daemon=True).start()
    laws.load_texts(job.laws)
    with ending_cleanly():
        ended, told = _run(job)
    _say({"ended": ended, "told": told})


if __name__ == "__main__":
    main()
