"""The progress line of a command: best misfit, time left, a bar and the current step."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from foamfit.terminal import printable, say

if TYPE_CHECKING:
    from foamfit.arrays import Array
    from foamfit.fitting.problem import Problem

REDRAWN = 0.2  # refresh interval, s
# Simulations for the best misfit: largest fraction of the run time, and least time between two, s.
SHARE, APART = 0.02, 0.2
RECENT = 0.1  # weight of the last step in the mean pace, from which tqdm tells the time left


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
