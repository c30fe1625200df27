"""A fit in a process of its own: begun, watched and stopped by the page.

The process reads a job as one line of JSON and answers in lines of JSON; Ctrl-C (SIGINT) stops its
search, which keeps the best point, as in the terminal.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit.cli.progress import APART, Progress, Watcher
from foamfit.errors import InputError, SimulationError, as_signalled

if TYPE_CHECKING:
    from foamfit.arrays import Array
    from foamfit.fitting.problem import Problem

PACKAGE = Path(__file__).parent.parent
COMPILING = "compiling the solver, once after installation"
STOPPED_EARLY = "The fit was stopped before anything was found; start it again."


@dataclass(frozen=True)
class Job:
    """What is to be fitted, where the result goes, and the arguments of `foamfit fit`."""

    csv: str
    toml: str
    folder: str
    arguments: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class News:
    """What a fit has told last; `values` are by the names of the parameters of `model`, SI."""

    fraction: float = 0.0
    what: str = "starting"
    model: str = ""
    relaxation: int = 0
    drive: str = ""
    cycle: int = 1
    values: dict[str, float] = field(default_factory=dict)
    misfit: dict[str, float | None] = field(default_factory=dict)


def with_package() -> dict[str, str]:
    """The environment of a process that is to find this very package."""
    paths = f"{PACKAGE.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    return os.environ | {"PYTHONPATH": paths.rstrip(os.pathsep)}


def end_all(process: subprocess.Popen[Any]) -> None:
    """End a process that leads a session at once, and what it has begun to compile in."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


class Worker:
    """A running fit, as the page sees it: the last news, and how it ended."""

    def __init__(self, job: Job) -> None:
        self.job, self.news = job, News()
        self.began = time.monotonic()
        self.stopping = False
        self.told = ""  # what the command prints of several cycles
        self._done: str | None = None  # the sentence with which it ended, "" where all is well
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (closed when the process ends)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "foamfit.page.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            encoding="utf-8",
            env=with_package(),
            start_new_session=True,  # Ctrl-C in the terminal of the page is not for this one
        )
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(vars(job)) + "\n")
            self._process.stdin.close()
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    @property
    def ended(self) -> str | None:
        """None while it runs; then "" where a result is written, or else why there is none."""
        return self._done

    def stop(self) -> None:
        """End the search; the best point is kept, concluded and written."""
        if not self.stopping and self._process.poll() is None:
            self.stopping = True
            self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End the process at once."""
        end_all(self._process)

    def _listen(self) -> None:
        """Read what the process tells until it ends."""
        assert self._process.stdout is not None
        done: str | None = None
        for line in self._process.stdout:
            try:
                told = json.loads(line)
            except ValueError:  # what some library has printed, or half a line of one that died
                continue
            if "ended" in told:
                done, self.told = told["ended"], told.get("told", "")
            else:
                self.news = News(**told)
        code = self._process.wait()
        self._process.stdout.close()
        done = self._why(code) if done is None else done
        self._errors.close()
        self._done = done

    def _why(self, code: int) -> str:
        """Say how a process ended that has not said it itself."""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        last = lines[-1].strip() if lines else ""
        if self.stopping and (code == -signal.SIGINT or last == "KeyboardInterrupt"):
            return STOPPED_EARLY
        last = f" ({last})" if last else ""
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        return f"The process of the fit has died {how}{last}; start the fit again."


# --------------------------------------------------------------------- in the process of the fit


class _Teller(Watcher):
    """What the page is told of a fit, a few times a second."""

    def __init__(self) -> None:
        super().__init__(says=False)
        self.told: dict[str, Any] = {}
        self._said = 0.0

    def progress(self, fraction: float, what: str, *, now: bool = False) -> None:
        """Tell how far the fit is, `now` or if the last line is some time ago."""
        self.told |= {"fraction": fraction, "what": what}
        if now and self._best is not None:
            self._next = 0.0
        self.look()
        if now or time.monotonic() - self._said >= APART:
            self._say()

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Tell the parameters and misfits of the best point so far."""
        named = zip(problem.names, (values + problem.origins).tolist(), strict=True)
        self.told |= {
            "model": problem.model.name,
            "relaxation": problem.model.relaxation,
            "drive": problem.objective.drive,
            "cycle": problem.measurement.cycle,
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
    """Read arguments as `foamfit fit` does; InputError says which one is wrong."""
    import click

    from foamfit.cli.fit import fit as command
    from foamfit.cli.options import Output

    try:
        context = command.make_context("fit", ["TEST.csv", *arguments])
    except click.ClickException as error:
        raise InputError(error.format_message()) from None
    others = {"test", "specimen", "verbose", *Output.__dataclass_fields__} - {"figure_width"}
    return {name: value for name, value in context.params.items() if name not in others}


def _run(job: Job) -> tuple[str, str]:
    """Fit and write the result; returns "" or why there is none, and what is told of cycles."""
    try:
        from foamfit.cli.fitting import fit_as_asked
        from foamfit.report.studies.cycles import cycles_text
        from foamfit.results import Fit
        from foamfit.solve.precompile import at_first_use
        from foamfit.terminal import without_ctrl_c

        teller, asked = _Teller(), parsed(job.arguments)
        width = asked.pop("figure_width")
        tell = partial(teller.progress, 0.0, COMPILING, now=True)
        with at_first_use(asked["model"], asked["relaxation"], tell) as compile_rest:

            def begin(_: float | None) -> contextlib.AbstractContextManager[Progress]:
                compile_rest()
                return contextlib.nullcontext(teller)

            with as_signalled():
                found = fit_as_asked(Path(job.csv), Path(job.toml), asked, begin)
        with without_ctrl_c():
            teller.progress(1.0, "writing the report", now=True)
            found.save(job.folder, figure_width=width)
            told = "" if isinstance(found, Fit) else cycles_text(found)
    except (InputError, SimulationError) as error:
        return str(error), ""
    except KeyboardInterrupt:
        return STOPPED_EARLY, ""
    return "", told


def main() -> None:
    """Do the job that stands on stdin."""
    from foamfit.terminal import ending_cleanly

    job = Job(**json.loads(sys.stdin.readline()))
    with ending_cleanly():
        ended, told = _run(job)
    _say({"ended": ended, "told": told})


if __name__ == "__main__":
    main()
