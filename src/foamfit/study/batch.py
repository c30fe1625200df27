"""Separate fits of many tests: parallel, resumable, with a folder per test and one summary.

`work` is done in another process: its arguments and results can be pickled, and a test depends
only on its task.
"""

from __future__ import annotations

import hashlib
import json
import platform
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Executor, Future
from contextlib import chdir, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np

from foamfit.api import fit
from foamfit.codec import build, plain
from foamfit.data.csv_file import read_test
from foamfit.data.toml_file import motion_file, toml_beside
from foamfit.errors import InputError, SimulationError, check_whole
from foamfit.files import read_whole, reason, sweep
from foamfit.fitting import nuisance
from foamfit.fitting.problem import check_fixed_and_varied
from foamfit.one_model import Options
from foamfit.options import Keywords
from foamfit.parts import law_in_words
from foamfit.report import listing as tables
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import FILES, check_target, save_whole, write_json, write_result
from foamfit.report.listing import REFUSED, Row, row_of
from foamfit.results import stamp
from foamfit.solve import precompile
from foamfit.springs import laws
from foamfit.study.cycles import fit_cycles
from foamfit.study.processes import FITS, PAGES, EndedError, Processes, cores
from foamfit.study.study_file import find_tests
from foamfit.terminal import without_ctrl_c
from foamfit.text import counted

if TYPE_CHECKING:
    import pandas as pd

VERSION = version("foamfit")
RECORD = "batch.json"  # in the folder of each test: its rows, and the fingerprint of their inputs
# One fit at a time per process, also in an executor with threads: drawing is not thread-safe.
_ALONE = threading.Lock()
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
        rows, recipe, picture = self.summary, self.recipe, None
        tables.write_summary(rows, self.out)
        law = law_in_words(recipe.model, recipe.options["relaxation"])
        name = self.out.resolve().name
        title = law if name == recipe.model else f"{name}: {law}"
        if whole:
            how: Any = {"width": recipe.width, "pictures": recipe.pages}
            picture = tables.write_comparison(rows, self.out, title, **how)
        tables.write_page(rows, self.out, title, picture)

    def fit(self, executor: Executor) -> None:
        """Fit all tests without a stored result; write a summary even if this ends early."""
        try:
            for name, path in self.tests:
                self._begin(executor, name, path)
            for future in futures.as_completed(self.waiting):
                self._take(future)
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
        mark = fingerprint(self.recipe, path, toml)
        task = Task(name, path, toml, self.recipe, mark, self.out / name)
        rows = None if self.fresh else stored(task)
        if rows is not None:
            self._keep(name, tuple(replace(row, file=str(path)) for row in rows))
            return
        try:
            future = executor.submit(work, task)
        except RuntimeError as error:  # the executor was shut down
            raise futures.BrokenExecutor(str(error)) from error
        self.waiting[future] = task
        if future.done():
            self._take(future)

    def _take(self, future: Future[tuple[Row, ...]]) -> None:
        task = self.waiting.pop(future)
        try:
            rows = future.result()
        except (futures.BrokenExecutor, futures.CancelledError, InputError):
            raise  # the result cannot be written, or no other test can be fitted
        except Exception as error:  # its cause may lie outside the test
            kind = type(error).__name__
            why = f"its fit was lost ({kind}: {error})"
            if isinstance(error, EndedError) or kind == "KilledWorker":  # raised by Dask
                why = "its process ended before it was fitted (killed, or out of memory)"
            rows = task.refused(f"{why}; call again to retry")
        else:
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
    report, figure_width
        As for `foamfit.FitResult.save`. A test whose figures have another width is fitted again,
        because its curves are not stored.
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
    if numbers is not None:
        for number in numbers if np.iterable(numbers) else (numbers,):
            check_whole("cycle", number, 1)
        numbers = tuple(map(int, numbers)) if np.iterable(numbers) else int(numbers)
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
    check_target(folder, kept=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder.resolve(), [*(name for name, _ in found), *FILES["batch.json"]])
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {reason(error)}") from None
    try:
        if executor is not None:
            made.fit(executor)
        else:
            precompile.compile_solver(named)
            imported = FITS + (PAGES if report else ())
            with Processes(min(jobs or cores(), len(found)), imported) as processes:
                made.fit(processes)
    finally:  # a process that was killed may have left half a folder
        sweep(folder.resolve(), [name for name, _ in found])
    return tables.read_table(folder / "summary.csv")


def _checked(model: str, options: Options) -> str:
    """Return the model's name; reject a model or options that no test could be fitted with."""
    if model.strip() == "auto":
        options.check_auto()
        return "auto"
    read = options.parse(model)
    drive = options.drive or "impact"  # has all nuisance parameters; each test checks its own
    names = (*read.names, *nuisance.names_of(drive, time_shift=True))
    check_fixed_and_varied(names, read.name, options.fix or {}, options.vary)
    return read.name


@dataclass(frozen=True)
class Recipe:
    """How every test of a batch is fitted."""

    model: str
    options: Mapping[str, Any]  # keywords of `foamfit.fit`
    cycles: int | tuple[int, ...] | None = None  # (): all; None: the one that the TOML names
    pages: bool = True
    width: str = TWO  # of the figures
    laws: Mapping[str, str] = field(default_factory=laws.texts)  # texts of the user's law files
    history: tuple[int, int] | None = None  # first and last of several cycles fitted as one

    @property
    def key(self) -> str:
        """Settings and version that determine the results; `stored` checks pages and width."""
        parts = asdict(replace(self, pages=True)) | {"foamfit": VERSION}
        del parts["width"]
        texts = parts.pop("laws")
        if any(laws.is_registered(kind) for kind in self.model.split("+")):
            parts["laws"] = sorted(texts.values())
        return json.dumps(parts, sort_keys=True)


@dataclass(frozen=True)
class Task:
    """One test to be fitted."""

    name: str
    path: Path
    toml: Path
    recipe: Recipe
    fingerprint: str  # of the files as the caller sees them
    out: Path  # folder to write
    where: Path = field(default_factory=Path.cwd)  # from which relative paths count

    def refused(self, why: str) -> tuple[Row, ...]:
        """Return the row of a test without a result."""
        return (Row(self.name, str(self.path), REFUSED, " ".join(why.split())),)


def fingerprint(recipe: Recipe, path: Path, toml: Path) -> str:
    """Return a hash of everything that determines a result: settings, version and files."""
    try:
        parts = [read_whole(path)]
        for other in (toml, motion_file(toml)):
            if other is not None and other.is_file():
                parts.append(other.read_bytes())
    except OSError:  # the fit reads the test again, with a better error message
        parts = []
    digests = (hashlib.sha256(part).hexdigest() for part in parts)
    return hashlib.sha256(json.dumps([recipe.key, *digests]).encode()).hexdigest()


def stored(task: Task) -> tuple[Row, ...] | None:
    """Return the rows in a test's folder if fingerprint and figures are those asked, else None."""
    # There may be no record, or one of another version.
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        content = json.loads((task.out / RECORD).read_text(encoding="utf-8"))
        width = content.get("figure_width", inches(TWO)) if content["pages"] else None
        drawn = not task.recipe.pages or width == inches(task.recipe.width)
        if drawn and content["fingerprint"] == task.fingerprint:
            return tuple(build(Row, row, {}) for row in content["rows"])
    return None


def work(task: Task) -> tuple[Row, ...]:
    """Fit one test, write its folder at once and return its rows; an error becomes a row.

    Raises InputError if it cannot be written, RuntimeError where files or version are others.
    """
    with _ALONE:
        laws.load_texts(task.recipe.laws)
        if task.where.is_dir():
            with chdir(task.where):
                if fingerprint(task.recipe, task.path, task.toml) == task.fingerprint:
                    return _written(task)
    raise RuntimeError(
        f"{platform.node()} does not see the same files or has another version of foamfit; every "
        "worker must see the file system of the call"
    )


def _written(task: Task) -> tuple[Row, ...]:
    write: Callable[[Path], None] = lambda _: None  # noqa: E731
    try:
        rows, write = _results(task)
    except (InputError, SimulationError) as error:
        rows = task.refused(str(error))
    except (MemoryError, OSError):  # a fault of this machine, not of the test
        raise
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
        rows = task.refused(f"this is a defect of foamfit, please report it ({fault})")
    record = {
        **stamp(),
        "fingerprint": task.fingerprint,
        "pages": task.recipe.pages,
        "figure_width": inches(task.recipe.width),
        "rows": plain(rows, {}),
    }

    def fill(folder: Path) -> None:
        write(folder)
        write_json(folder / RECORD, record)

    save_whole(task.out, fill)
    return rows


def _results(task: Task) -> tuple[tuple[Row, ...], Callable[[Path], None]]:
    """Return one row, or one per cycle (a subfolder), and a function that writes the files."""
    recipe, path, file = task.recipe, task.path, str(task.path)
    pictures: Any = {"pages": recipe.pages, "width": recipe.width}
    if not isinstance(recipe.cycles, tuple):
        test = read_test(path, task.toml, recipe.cycles, cycles=recipe.history)
        result = fit(test, model=recipe.model, **recipe.options)
        return (row_of(task.name, file, result),), partial(write_result, result, **pictures)
    numbers = recipe.cycles or None
    fits = fit_cycles(path, task.toml, cycles=numbers, model=recipe.model, **recipe.options)
    return fits.listed(task.name, file), partial(fits.write, **pictures)
