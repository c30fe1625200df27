"""What a command is doing, on one line of its terminal: best misfit, time left, a bar, the step."""

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
# Simulations for the best misfit take at most this share of the time of a fit, and are at least so
# many seconds apart.
SHARE, APART = 0.02, 0.2
# The time left is told after this share of the work; its pace is that of this share of the time.
ENOUGH, RECENT = 0.03, 0.4


class Progress:
    """Takes what a fit reports and shows nothing: stderr is no terminal, or is to stay silent."""

    watch: Callable[[Problem, Array], None] | None = None

    def __init__(self, says: bool = True) -> None:
        self.says = says

    def progress(self, fraction: float, what: str) -> None:
        """Take the share of the work that is done, and the present step."""

    def tell(self, told: str) -> None:
        """Print a sentence on stderr, unless silence is asked for."""
        if self.says:
            say(f"foamfit: {told}", err=True)


class Watcher(Progress):
    """Looks at the best point so far a few times a second, for a small share of the time."""

    _best: tuple[Problem, Array] | None = None
    _next, _looked = 0.0, False

    def watch(self, problem: Problem, values: Array) -> None:
        """Take the best point so far."""
        self._best = problem, values
        self.look()

    def look(self) -> None:
        """Simulate the best point so far, unless that would slow the fit."""
        if self._best is None or (began := time.monotonic()) < self._next:
            return
        (problem, values), self._best = self._best, None
        if (misfit := problem.objective.look(values)) is not None:
            self.seen(problem, values, misfit)
        took = time.monotonic() - began if self._looked else 0.0  # the first one loads the solver
        self._next, self._looked = began + took + max(took / SHARE, APART), True

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Take the best point and its misfits, which count as no step of the fit."""


class ProgressLine(Watcher):
    """Keeps one line of a terminal, which `name` begins, up to date from a thread.

    The work ends after `limit` seconds. The misfit is the RMS of all fitted curves over their
    measured ranges.
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
        """Take the share of the work that is done, and the present step."""
        scope = what.rpartition(": ")[0]
        if scope != self.scope and not scope.startswith("model"):
            self.misfit = self._best = None  # it was of another test
        self.what, self.scope = what, scope
        if fraction > self.fraction:
            self.fraction = fraction
            self.marks.append((time.monotonic(), fraction))
        self.look()

    def seen(self, problem: Problem, values: Array, misfit: dict[str, float | None]) -> None:
        """Take the misfit of all fitted curves together."""
        objective = problem.objective
        pairs = zip(objective.counted, objective.sizes, strict=True)
        squares = sum(size * (misfit[name] or 0.0) ** 2 for name, size in pairs)
        whole = math.sqrt(squares / objective.n_data)
        self.misfit = whole if self.misfit is None else min(self.misfit, whole)

    def tell(self, told: str) -> None:
        """Print a sentence above the line."""
        self._bar.write(printable(f"foamfit: {told}"), file=self._bar.fp)

    def left(self) -> str:
        """Say how much time is left, by the recent pace and the limit; "" if neither tells."""
        if self.fraction >= 1.0:
            return ""
        now, ahead = time.monotonic(), self._ahead()
        rest = math.inf if self.limit is None else max(self.limit - (now - self.began), 0.0)
        if rest <= ahead:
            return "" if rest == math.inf else f"at most {duration(rest)} left"
        return f"about {duration(ahead)} left"

    def _ahead(self) -> float:
        """Seconds left by the recent pace; infinite where it is not known yet."""
        now, (at, done) = time.monotonic(), self.marks[-1]
        if self.fraction < ENOUGH:
            return math.inf
        since = at - RECENT * (at - self.began)
        before = [mark for mark in self.marks if mark[0] <= since] or [self.marks[0]]
        pace = (done - before[-1][1]) / max(at - before[-1][0], 1e-6)
        ahead = (1.0 - done) / pace
        return max(ahead - (now - at), 0.5 * ahead)  # a late step makes the pace unknown

    def draw(self) -> None:
        """Show the line as it is now; a narrow terminal cuts its end."""
        best = "" if self.misfit is None else f"best misfit {100.0 * self.misfit:.2g} %"
        told = ", ".join(filter(None, [best, self.left()]))
        what = printable(self.what).replace("{", "{{").replace("}", "}}")
        self._bar.bar_format = f"{self.name}: {told and told + ' '}|{{bar}}| {what}"
        self._bar.n = min(self.fraction, 1.0)
        self._bar.refresh()

    def close(self) -> None:
        """Take the line away."""
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
    """Give a line on stderr that shows progress; elsewhere than a terminal it only `says`."""
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
