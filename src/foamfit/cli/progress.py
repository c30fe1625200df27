"""What a command is at, on one line of its terminal: a bar, the best misfit, the time left."""

from __future__ import annotations

import logging
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TextIO

from foamfit.terminal import printable, say

if TYPE_CHECKING:
    from foamfit.arrays import Array
    from foamfit.fitting.problem import Problem

REDRAWN = 0.2  # s between two looks whether the line has changed
# Simulations for the best misfit take at most this share of the time of a fit, and are no nearer to
# each other, s.
SHARE, APART = 0.02, 0.2
# The time left is told after this share of the work, s; by the pace of this share of the time.
ENOUGH, RECENT = 0.03, 0.4
BAR = 24  # characters at most; below a third of it there is none


class Progress:
    """Takes what a fit tells and shows nothing: stderr is no terminal, or is to stay silent."""

    watch: Callable[[Problem, Array], None] | None = None

    def __init__(self, says: bool = True) -> None:
        self.says = says

    def progress(self, fraction: float, what: str) -> None:
        """Take how far the command is."""

    def tell(self, told: str) -> None:
        """Print a sentence on stderr, unless nothing is to be said."""
        if self.says:
            say(f"foamfit: {told}", err=True)


class _Above(logging.Handler):
    """Prints what foamfit logs above a line of progress, not into it."""

    def __init__(self, line: ProgressLine) -> None:
        super().__init__(logging.WARNING)
        self.line = line

    def emit(self, record: logging.LogRecord) -> None:
        """Print one sentence."""
        self.line.tell(record.getMessage().removeprefix("foamfit: "))


class ProgressLine(Progress):
    """Keeps one line of a terminal up to date, from a thread: fits may be silent for long.

    `limit` are the seconds after which the work ends in any case. `name` begins the line. The
    misfit is the RMS of all fitted curves over their measured ranges.
    """

    def __init__(self, stream: TextIO, name: str, limit: float | None = None) -> None:
        super().__init__()
        self.stream, self.name, self.limit = stream, name, limit
        self.began = time.monotonic()
        self.fraction, self.what, self.scope = 0.0, "", ""
        self.misfit: float | None = None
        self.marks = deque([(self.began, 0.0)], maxlen=400)
        self.watch = self._watch
        self._best: tuple[Problem, Array] | None = None
        self._next, self._looked, self._shown = 0.0, False, ""
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def progress(self, fraction: float, what: str) -> None:
        """Take how far the command is: the share of its time, and what is being done."""
        scope = what.rpartition(": ")[0]
        if scope != self.scope and not scope.startswith("model"):
            self.misfit = self._best = None  # it was of another test
        self.what, self.scope = what, scope
        if fraction > self.fraction:
            self.fraction = fraction
            self.marks.append((time.monotonic(), fraction))
        self._look()

    def _watch(self, problem: Problem, values: Array) -> None:
        """Take the best point so far."""
        self._best = problem, values
        self._look()

    def _look(self) -> None:
        """Simulate the best point, unless that would slow the fit."""
        if self._best is None or (began := time.monotonic()) < self._next:
            return
        (problem, values), self._best = self._best, None
        objective = problem.objective
        if (found := objective.look(values)) is not None:
            pairs = zip(objective.counted, objective.sizes, strict=True)
            squares = sum(size * (found[name] or 0.0) ** 2 for name, size in pairs)
            misfit = math.sqrt(squares / objective.n_data)
            self.misfit = misfit if self.misfit is None else min(self.misfit, misfit)
        took = time.monotonic() - began if self._looked else 0.0  # the first one loads the solver
        self._next, self._looked = began + took + max(took / SHARE, APART), True

    def tell(self, told: str) -> None:
        """Print a sentence above the line."""
        with self._lock:
            self._write("")
            super().tell(told)

    def left(self) -> str:
        """Say what time is left, by the pace of late and the limit; "" where neither tells."""
        if self.fraction >= 1.0:
            return ""
        now, ahead = time.monotonic(), self._ahead()
        rest = math.inf if self.limit is None else max(self.limit - (now - self.began), 0.0)
        if rest <= ahead:
            return "" if rest == math.inf else f"at most {duration(rest)} left"
        return f"about {duration(ahead)} left"

    def _ahead(self) -> float:
        """Seconds that are left by the pace of late; infinite where it does not tell."""
        now, (at, done) = time.monotonic(), self.marks[-1]
        if self.fraction < ENOUGH:
            return math.inf
        since = at - RECENT * (at - self.began)
        before = [mark for mark in self.marks if mark[0] <= since] or [self.marks[0]]
        pace = (done - before[-1][1]) / max(at - before[-1][0], 1e-6)
        ahead = (1.0 - done) / pace
        return max(ahead - (now - at), 0.5 * ahead)  # past that nobody knows

    def line(self, width: int) -> str:
        """Return what is shown in so many columns."""
        parts = [] if self.misfit is None else [f"best misfit {100.0 * self.misfit:.2g} %"]
        parts += filter(None, [self.left()])
        head, tail = printable(f"{self.name}: {self.what}"), ", ".join(parts)
        room = min(BAR, width - len(head) - len(tail) - 6)
        if room < BAR // 3:  # what is best and when it ends is worth more than what is done
            most = width - len(tail) - 3
            head = head if len(head) <= most else f"{head[: max(most - 1, 0)]}…"
            return f"{head}  {tail}".rstrip()[: width - 1]
        done = round(room * min(self.fraction, 1.0))
        return f"{head} [{'#' * done}{'-' * (room - done)}] {tail}".rstrip()

    def close(self) -> None:
        """Take the line away."""
        self._ended.set()
        self._thread.join()
        with self._lock:
            self._write("")

    def _keep(self) -> None:
        while not self._ended.wait(REDRAWN):
            with self._lock:
                if self.what and not self._ended.is_set():
                    self._write(self.line(_columns(self.stream)))

    def _write(self, line: str) -> None:
        """Put a line in the place of the one that is shown."""
        if line == self._shown:
            return
        blank = " " * max(len(self._shown) - len(line), 0)
        with suppress(OSError, ValueError):  # the terminal has gone
            self.stream.write(f"\r{line}{blank}" + ("" if line else "\r"))
            self.stream.flush()
        self._shown = line


def _columns(stream: TextIO) -> int:
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def duration(seconds: float) -> str:
    """Write a time that is only about known."""
    if seconds < 90:
        return f"{max(seconds, 1.0):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@contextmanager
def progress_line(
    quiet: bool, name: str, limit: float | None = None, *, says: bool = True
) -> Iterator[Progress]:
    """Give a line on stderr that shows progress; nothing is shown where that is no terminal.

    `says` is whether sentences are printed where there is no line.
    """
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield Progress(says)
        return
    line, log = ProgressLine(sys.stderr, name, limit), logging.getLogger("foamfit")
    above = _Above(line)
    log.addHandler(above)
    try:
        yield line
    finally:
        log.removeHandler(above)
        line.close()
