"""Output to the terminal, the progress line of a command, and signals."""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
import threading
import time
import unicodedata
from codecs import register_error
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO

from foamfit.errors import InputError

if TYPE_CHECKING:
    from foamfit.arrays import Array
    from foamfit.fitting.problem import Problem

REDRAWN = 0.2  # refresh interval, s
# Simulations for the best misfit: largest fraction of the run time, and least time between two, s.
SHARE, APART = 0.02, 0.2
RECENT = 0.1  # weight of the last step in the mean pace, from which tqdm tells the time left
# Signals that ask a process to end: Ctrl-C, `kill`, and on POSIX the end of the terminal.
ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
IN_ASCII = "foamfit-in-ascii"  # writes what an encoding lacks, as cp1252 of a pipe on Windows
# Control characters except tab and new line, and characters that reverse the direction of writing:
# in a file name they could move the cursor or hide text. Also surrogates (non-UTF-8 bytes).
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""Escape control characters, as in "\x1b", but not new lines."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Write a minus as "-", an index as a digit, and escape all else that an encoding lacks."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end].replace("\N{MINUS SIGN}", "-")
    plain = unicodedata.normalize("NFKC", lacking)
    return plain.encode("ascii", "backslashreplace").decode(), error.end


register_error(IN_ASCII, _in_ascii)


def say(text: str, *, err: bool = False, newline: bool = True) -> None:
    """Print a text on stdout or stderr; InputError if stdout cannot be written (disk full).

    If the reader closes the pipe, as `head` does, the rest is discarded without an error.
    """
    stream: TextIO | None = sys.stderr if err else sys.stdout
    if stream is None:  # closed by the parent process
        return
    try:
        stream.write(printable(text) + ("\n" if newline else ""))
        stream.flush()
    except OSError as error:
        if err:
            return
        nowhere = os.open(os.devnull, os.O_WRONLY)  # for buffered and all further output
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        if not isinstance(error, BrokenPipeError):
            raise InputError(
                f"standard output cannot be written: {error.strerror or error}; give it room or "
                "redirect it elsewhere"
            ) from None


class Progress:
    """Receives the progress of a fit and shows nothing: for --quiet, or without a terminal."""

    watch: Callable[[Problem, Array], None] | None = None

    def __init__(self, says: bool = True) -> None:
        self.says = says

    def progress(self, fraction: float, what: str) -> None:
        """Receive the completed fraction of the work and the current step."""

    def tell(self, text: str) -> None:
        """Print a sentence on stderr, unless `says` is false."""
        if self.says:
            say(f"foamfit: {text}", err=True)


class Watcher(Progress):
    """Simulates the best point so far a few times a second, in a small fraction of the time."""

    _best: tuple[Problem, Array] | None = None
    _next, _looked = 0.0, False

    def watch(self, problem: Problem, values: Array) -> None:
        """Receive the best point so far."""
        self._best = problem, values
        self.look()

    def look(self) -> None:
        """Simulate the best point so far, unless that would slow the fit."""
        if self._best is None or (began := time.monotonic()) < self._next:
            return
        (problem, values), self._best = self._best, None
        if (misfit := problem.objective.look(values)) is not None:
            self.seen(problem, values, misfit)
        took = time.monotonic() - began if self._looked else 0.0  # the first run loads the solver
        self._next, self._looked = began + took + max(took / SHARE, APART), True

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Receive the best point and its misfits; this does not count as a step of the fit."""


class ProgressLine(Watcher):
    """A line of the terminal, beginning with `name`, with a bar of tqdm and the largest misfit."""

    def __init__(self, stream: TextIO, name: str) -> None:
        from tqdm import tqdm

        super().__init__()
        self.name, self.scope = name, ""
        self.misfit: float | None = None
        self._bar: Any = tqdm(
            total=1.0,
            file=stream,
            leave=False,
            dynamic_ncols=True,
            miniters=0,
            mininterval=REDRAWN,
            smoothing=RECENT,
            bar_format=f"{name}:",
        )

    def progress(self, fraction: float, what: str) -> None:
        """Receive the completed fraction of the work and the current step."""
        scope = what.rpartition(": ")[0]
        if scope != self.scope and not scope.startswith("model"):
            self.misfit = self._best = None  # they belong to another test
        self.scope = scope
        self.look()
        best = "" if self.misfit is None else f"best misfit {100.0 * self.misfit:.2g} %, "
        step = printable(what).replace("{", "{{").replace("}", "}}")
        self._bar.bar_format = f"{self.name}: {best}{{remaining}} left |{{bar}}| {step}"
        self._bar.update(max(min(fraction, 1.0) - self._bar.n, 0.0))

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Receive the misfits; show the largest of the fitted curves."""
        largest = max(misfit[name] or 0.0 for name in problem.objective.counted)
        self.misfit = largest if self.misfit is None else min(self.misfit, largest)

    def tell(self, text: str) -> None:
        """Print a sentence above the line."""
        self._bar.write(printable(f"foamfit: {text}"), file=self._bar.fp)

    def close(self) -> None:
        """Remove the line."""
        self._bar.close()


@contextmanager
def progress_line(quiet: bool, name: str, *, says: bool = True) -> Iterator[Progress]:
    """Yield a progress line on stderr; without a terminal it only prints sentences."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield Progress(says)
        return
    from tqdm.contrib.logging import logging_redirect_tqdm

    log = logging.getLogger("foamfit")
    with logging_redirect_tqdm([log]), closing(ProgressLine(sys.stderr, name)) as line:
        yield line


class TerminatedError(KeyboardInterrupt):
    """Raised on SIGTERM, or when the terminal is closed; the message is the name of the signal.

    Like Ctrl-C it keeps the best point found so far.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def _terminate(number: int, frame: FrameType | None) -> None:
    raise TerminatedError(number)


@contextmanager
def ending_cleanly() -> Iterator[None]:
    """Turn SIGTERM and a closed terminal into an exception, so that no partial file stays behind.

    Neither these nor Ctrl-C are lost in code that cannot raise, such as numba's callbacks when it
    loads compiled code.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    taken = [number for number in ENDING if signal.getsignal(number) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, _terminate)
    told, sys.unraisablehook = sys.unraisablehook, _raise_again
    try:
        yield
    finally:
        sys.unraisablehook = told
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def _raise_again(lost: Any) -> None:
    """Send a signal again if Python has ignored its exception; a hook of `sys`."""
    if not isinstance(lost.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    number = getattr(lost.exc_value, "number", signal.SIGINT)
    again = threading.Timer(0.02, signal.raise_signal, (number,))
    again.daemon = True
    again.start()


@contextmanager
def without_ctrl_c() -> Iterator[None]:
    """Ignore Ctrl-C in the body, where it would only lose results."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
