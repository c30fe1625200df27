"""Separate fits of many tests: parallel, resumable, with a folder per test and one summary."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent import futures
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

import numpy as np

from foamfit.data.toml_file import toml_beside
from foamfit.errors import InputError, check_whole
from foamfit.files import is_left, reason, sweep
from foamfit.fitting import nuisance
from foamfit.fitting.problem import check_fixed_and_varied
from foamfit.one_model import Options
from foamfit.options import Keywords
from foamfit.parts import law_in_words
from foamfit.report import listing as tables
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import FILES, check_target, is_written
from foamfit.report.listing import Row
from foamfit.solve import precompile
from foamfit.springs.model import Model, with_options
from foamfit.study.batch_work import Recipe, Task, fingerprint, stored, work
from foamfit.study.processes import FITS, PAGES, EndedError, Processes, cores
from foamfit.study.study_file import find_tests
from foamfit.terminal import without_ctrl_c
from foamfit.text import counted

if TYPE_CHECKING:
    import pandas as pd

MOST_AHEAD = 1000  # tests submitted to the executor at a time
PAUSE = 60.0  # least time between two summaries, s: of many tests, one takes seconds
Tests = str | Path | Iterable[str | Path]
Cycles = int | Sequence[int] | Literal["all"] | None


@dataclass
class Batch:
    """The tests of a batch, their results so far, and the fits under way; see `batch`."""

    out: Path
    recipe: Recipe
    tests: list[tuple[str, Path]]  # name and file
    toml: Path | None  # for all tests; None: the TOML next to each
    fresh: bool
    progress: Callable[[Batch], None]
    rows: dict[str, tuple[Row, ...]] = field(default_factory=dict)  # by name of the test
    waiting: dict[Future[tuple[Row, ...]], Task] = field(default_factory=dict)
    fitted: int = 0  # number of tests fitted in this call
    wrong: int = 0  # number of finished tests without an acceptable fit
    saved: float = field(default_factory=lambda: time.monotonic())  # time of the last summary

    @property
    def summary(self) -> list[Row]:
        """One row per test, or per cycle of a test, in the order of the tests."""
        why = "not fitted yet because the batch ended early; call it again"
        rows = list[Row]()
        for name, path in self.tests:
            rows += self.rows.get(name) or (Row(name, str(path), tables.OPEN, why),)
        return rows

    def save(self, *, whole: bool = False) -> None:
        """Write summary.csv and summary.html; `whole` adds a comparison of the parameters."""
        rows = self.summary
        tables.write_summary(rows, self.out)
        options = Options(**self.recipe.options)
        model = with_options(self.recipe.model, **options.of_springs)
        law = law_in_words(model, options.relaxation)
        title, picture = f"{self.out.resolve().name}: {law}", None
        if whole:
            pictures, width = self.recipe.pages, self.recipe.width
            picture = tables.write_comparison(rows, self.out, title, width=width, pictures=pictures)
        tables.write_page(rows, self.out, title, picture)

    def fit(self, executor: Executor) -> None:
        """Fit all tests without a stored result; write a summary even if this ends early."""
        try:
            for name, path in self.tests:
                self._begin(executor, name, path)
                self._collect(0.0)
                while len(self.waiting) >= MOST_AHEAD:
                    self._collect(1.0)
            while self.waiting:
                self._collect(1.0)
        except BaseException as error:
            for future in self.waiting:
                future.cancel()
            with without_ctrl_c(), suppress(InputError):
                self.save()
            why = " ".join(str(error).split())
            if isinstance(error, futures.BrokenExecutor | futures.CancelledError):
                why = f"the executor has ended: {why or 'it cancelled the tests'}"
            elif not isinstance(error, InputError):
                raise
            done = f"{len(self.rows)} of {counted(len(self.tests), 'test')} are done and kept"
            raise InputError(f"{why}; {done}; call again to fit the others") from error
        self.save(whole=True)

    def _begin(self, executor: Executor, name: str, path: Path) -> None:
        """Use the stored rows of a test, or submit its fit."""
        toml = toml_beside(path) if self.toml is None else self.toml
        folder = self.out / name
        mark = fingerprint(self.recipe, path, toml)
        rows = None if self.fresh else stored(folder, mark, self.recipe)
        if rows is not None:
            self._keep(name, tuple(replace(row, file=str(path)) for row in rows))
            return
        task = Task(name, path, toml, self.recipe, mark, folder)
        try:
            self.waiting[executor.submit(work, task)] = task
        except RuntimeError as error:  # the executor was shut down
            raise futures.BrokenExecutor(str(error)) from error

    def _collect(self, seconds: float) -> None:
        """Take finished fits, waiting up to the given time for one; update an old summary."""
        done, _ = futures.wait(self.waiting, seconds, futures.FIRST_COMPLETED)
        for future in [future for future in self.waiting if future in done]:
            self._take(future)
        if time.monotonic() - self.saved >= PAUSE:
            self.save()
            self.saved = time.monotonic()

    def _take(self, future: Future[tuple[Row, ...]]) -> None:
        task = self.waiting.pop(future)
        try:
            rows = future.result()
        except (futures.BrokenExecutor, futures.CancelledError, InputError):
            raise  # the result cannot be written, or no other test can be fitted
        except Exception as error:
            self._keep(task.name, (Row(task.name, str(task.path), tables.REFUSED, _lost(error)),))
            return
        self.fitted += 1
        self._keep(task.name, rows)

    def _keep(self, name: str, rows: tuple[Row, ...]) -> None:
        self.rows[name] = rows
        self.wrong += not all(row.has_fit for row in rows)
        self.progress(self)


def batch(
    tests: Tests,
    *,
    out: str | Path | None = None,
    model: str = "bistable",
    executor: Executor | None = None,
    jobs: int | None = None,
    fresh: bool = False,
    specimen: str | Path | None = None,
    cycle: Cycles = None,
    cycles: tuple[int, int] | None = None,
    report: bool = True,
    figure_width: str = TWO,
    progress: Callable[[Batch], None] | None = None,
    **options: Unpack[Keywords],
) -> pd.DataFrame:
    """Fit many tests separately and in parallel; write a result folder per test and one summary.

    A repeated call fits only tests that have no result yet or whose data, TOML, settings or version
    of foamfit have changed. A test that cannot be read or fitted gets a row with the error message.
    Finished results are kept however the call ends.

    Parameters
    ----------
    tests : str, Path or several
        Files, folders and globs; see `foamfit.study.study_file.find_tests`.
    out : str or Path, optional
        The folder; by default ``fits/batch/<model>``. It contains the result folder ``<test>/``
        of each test, ``summary.csv`` and ``summary.html``.
    model, options
        As for `foamfit.fit`.
    executor : concurrent.futures.Executor, optional
        Executor that runs the fits, such as a Dask client's ``get_executor()``. Its machines must
        see the same file system. By default the fits run in single-threaded processes on this
        machine, one per core.
    jobs : int, optional
        Number of processes on this machine.
    fresh : bool
        Whether to fit all tests again.
    specimen : str or Path, optional
        One TOML for all tests; by default the TOML next to each test.
    cycle : int, sequence of int or "all", optional
        The cycle of each record to fit; several cycles are fitted separately, as by
        `foamfit.fit_cycles`, and each has a row in the summary.
    cycles : (int, int), optional
        First and last of several cycles that are fitted as one history.
    report : bool
        Whether to write a report and figures for each fit.
    figure_width : str
        "one" or "two" columns, or a length such as "85 mm". A test whose figures have another
        width is fitted again, because its curves are not stored.
    progress : callable, optional
        Called with the `Batch` after each test; its `rows`, `tests`, `wrong` and `fitted` describe
        the progress, and at the end its `summary` the results.

    Returns
    -------
    pandas.DataFrame
        The rows of ``summary.csv``.

    Raises
    ------
    InputError
        If the call is wrong, or a result cannot be written (full disk).
    """
    numbers = () if cycle == "all" else cycle
    if isinstance(numbers, int | np.integer):
        numbers = int(numbers)
    elif numbers is not None:
        numbers = tuple(map(int, numbers))
    chosen = Options.of("batch", options)
    named = _checked(model, chosen)
    recipe = Recipe(named, vars(chosen), numbers, report, figure_width, history=cycles)
    if jobs is not None:
        check_whole("jobs", jobs, 1)
    if numbers is not None and cycles is not None:
        raise InputError("give either cycle or cycles, not both")
    if jobs is not None and executor is not None:
        raise InputError("jobs and an executor exclude each other; leave one of them out")
    inches(figure_width)  # rejects an invalid width
    toml = None if specimen is None else Path(specimen)
    if toml is not None and not toml.is_file():
        raise InputError(f"{toml}: no such file; give the TOML of the specimen for all tests")
    folder = Path("fits", "batch", named) if out is None else Path(out)
    found, notify = find_tests(tests), progress or (lambda _: None)
    made = Batch(folder, recipe, found, toml, fresh, notify)
    _check_out(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder.resolve(), [*(name for name, _ in found), *FILES["batch.json"]])
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {reason(error)}") from None
    try:
        with _executor(executor, jobs, made) as runner:
            made.fit(runner)
    finally:  # a process that was killed may have left half a folder
        sweep(folder.resolve(), [name for name, _ in found])
    return tables.read_table(folder / "summary.csv")


def _checked(model: str, options: Options) -> str:
    """Return the model's name; reject a model or options that no test could be fitted with."""
    if model.strip() == "auto":
        options.check_auto()
        return "auto"
    read = Model.parse(with_options(model, **options.of_springs), options.relaxation)
    drive = options.drive or "impact"  # has all nuisance parameters; each test checks its own
    names = (*read.names, *nuisance.names_of(drive, time_shift=True))
    check_fixed_and_varied(names, read.name, options.fix or {}, options.vary)
    return read.name


def _check_out(out: Path) -> None:
    """Raise InputError unless foamfit may use the folder: it contains no files of others."""
    if not out.is_dir():
        check_target(out)
        return
    try:
        for path in sorted(out.iterdir()):
            name = path.name
            if is_left(name) or (name in FILES["batch.json"] and path.is_file()):
                continue
            if path.is_dir() and not path.is_symlink():
                inside = list(path.iterdir())
                foreign = [inner.name for inner in inside if not is_written(inner)]
                if not inside or (not foreign and any(inner.name in FILES for inner in inside)):
                    continue
                name = "/".join([name, *foreign[:1]])
            raise InputError(
                f"{out} holds {name}, which foamfit did not write; choose a new or an empty folder"
            )
        if not os.access(out, os.W_OK | os.X_OK):
            raise PermissionError(0, f"Permission denied in {out.resolve()}")
    except OSError as error:
        raise InputError(f"{out} cannot be written: {reason(error)}") from None


@contextmanager
def _executor(given: Executor | None, jobs: int | None, made: Batch) -> Iterator[Executor]:
    """Yield the given executor, or else processes of this machine, which end with the body."""
    if given is not None:
        yield given
        return
    precompile.compile_solver(made.recipe.model)
    count = min(jobs or cores(), max(len(made.tests), 1))
    with Processes(count, (*FITS, *(PAGES if made.recipe.pages else ()))) as pool:
        yield pool


def _lost(error: Exception) -> str:
    """Return why a test has no result if the cause may lie outside the test."""
    if isinstance(error, EndedError) or type(error).__name__ == "KilledWorker":  # raised by Dask
        return (
            "its process ended before it was fitted (killed, or out of memory); call again to retry"
        )
    why = " ".join(f"{type(error).__name__}: {error}".split())
    return f"its fit was lost ({why}); call again to retry"
