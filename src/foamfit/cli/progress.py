"""The progress line of a command: best misfit, time left, a bar and the current step."""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from foamfit.terminal import printable, say

if TYPE_CHECKING:
    from foamfit.arrays import Array
    from foamfit.fitting.problem import Problem

REDRAWN = 0.2  # refresh interval, s
# Simulations for the best misfit: largest fraction of the run time, and least time between two, s.
SHARE, APART = 0.02, 0.2
# The time left is shown after this fraction of the work, from the pace over this fraction of the
# time so far.
ENOUGH, RECENT = 0.03, 0.4


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
    """A line of the terminal, beginning with `name`, that a thread keeps up to date.

    `limit` is the time limit of the work, s. The misfit is the RMS of all fitted curves, each
    divided by its measured range.
    """

    def __init__(self, stream: TextIO, name: str, limit: float | None = None) -> None:
        from tqdm import tqdm

        super().__init__()
        self.name, self.limit = name, limit
        self.began = time.monotonic()
        self.fraction, self.what, self.scope = 0.0, "", ""
        self.misfit: float | None = None
        self.marks = deque([(self.began, 0.0)], maxlen=400)
        self._ended = threading.Event()
        self._bar: Any = tqdm(
            total=1.0, file=stream, leave=False, dynamic_ncols=True, bar_format=f"{name}:"
        )
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def progress(self, fraction: float, what: str) -> None:
        """Receive the completed fraction of the work and the current step."""
        scope = what.rpartition(": ")[0]
        if scope != self.scope and not scope.startswith("model"):
            self.misfit = self._best = None  # they belong to another test
        self.what, self.scope = what, scope
        if fraction > self.fraction:
            self.fraction = fraction
            self.marks.append((time.monotonic(), fraction))
        self.look()

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Receive the misfits; show that of all fitted curves together."""
        objective = problem.objective
        pairs = zip(objective.counted, objective.sizes, strict=True)
        squares = sum(size * (misfit[name] or 0.0) ** 2 for name, size in pairs)
        whole = math.sqrt(squares / objective.n_data)
        self.misfit = whole if self.misfit is None else min(self.misfit, whole)

    def tell(self, text: str) -> None:
        """Print a sentence above the line."""
        self._bar.write(printable(f"foamfit: {text}"), file=self._bar.fp)

    def left(self) -> str:
        """Return the time left in words, from the recent pace and the limit; "" if unknown."""
        if self.fraction >= 1.0:
            return ""
        now, ahead = time.monotonic(), self._ahead()
        rest = math.inf if self.limit is None else max(self.limit - (now - self.began), 0.0)
        if rest <= ahead:
            return "" if rest == math.inf else f"at most {duration(rest)} left"
        return f"about {duration(ahead)} left"

    def _ahead(self) -> float:
        """Return the time left, s, at the recent pace; infinite if it is not known yet."""
        now, (at, done) = time.monotonic(), self.marks[-1]
        if self.fraction < ENOUGH:
            return math.inf
        since = at - RECENT * (at - self.began)
        before = [mark for mark in self.marks if mark[0] <= since] or [self.marks[0]]
        pace = (done - before[-1][1]) / max(at - before[-1][0], 1e-6)
        ahead = (1.0 - done) / pace
        return max(ahead - (now - at), 0.5 * ahead)  # a slow step must not bring it to zero

    def draw(self) -> None:
        """Draw the line; a narrow terminal cuts off its end."""
        best = "" if self.misfit is None else f"best misfit {100.0 * self.misfit:.2g} %"
        state = ", ".join(filter(None, [best, self.left()]))
        what = printable(self.what).replace("{", "{{").replace("}", "}}")
        self._bar.bar_format = f"{self.name}: {state and state + ' '}|{{bar}}| {what}"
        self._bar.n = min(self.fraction, 1.0)
        self._bar.refresh()

    def close(self) -> None:
        """Remove the line."""
        self._ended.set()
        self._thread.join()
        self._bar.close()

    def _keep(self) -> None:
        while not self._ended.wait(REDRAWN):
            if self.what:
                self.draw()


def duration(seconds: float) -> str:
    """Write an approximate time."""
    if seconds < 90:
        return f"{max(seconds, 1.0):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@contextmanager
def progress_line(
    quiet: bool, name: str, limit: float | None = None, *, says: bool = True
) -> Iterator[Progress]:
    """Yield a progress line on stderr; without a terminal it only prints sentences."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield Progress(says)
        return
    from tqdm.contrib.logging import logging_redirect_tqdm

    with logging_redirect_tqdm([logging.getLogger("foamfit")]):
        line = ProgressLine(sys.stderr, name, limit)
        try:
            yield line
        finally:
            line.close()
