"""Many tests, each on its own: in parallel, resumable, a folder for each and one summary."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent import futures
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

from foamfit.data.toml_file import motion_file, toml_beside
from foamfit.errors import InputError
from foamfit.files import is_left, read_whole, reason, sweep
from foamfit.fitting import nuisance
from foamfit.fitting.problem import check_fixed_and_varied
from foamfit.one_model import Keywords, Options
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import FILES, check_target, is_written
from foamfit.report.studies import batch as tables
from foamfit.report.studies.batch import Row
from foamfit.results import law_in_words
from foamfit.solve import cache, precompile
from foamfit.springs.model import Model, with_options
from foamfit.study.batch_work import (
    Outcome,
    Recipe,
    Task,
    fingerprint,
    put,
    stored,
    work,
)
from foamfit.study.processes import FITS, PAGES, EndedError, Processes, check_jobs, cores
from foamfit.study.test_files import find_tests
from foamfit.terminal import without_ctrl_c
from foamfit.text import counted

if TYPE_CHECKING:
    import pandas as pd

_LOG = logging.getLogger(__name__)
# Most tests, and most bytes of their files, that wait in an executor.
MOST_AHEAD, MOST_BYTES = 1000, 2**28
# Least time between two summaries: in seconds, and over the time that writing one takes.
PAUSE, SHARE = 5.0, 50.0
Tests = str | Path | Iterable[str | Path]
Cycles = int | Sequence[int] | Literal["all"] | None


@dataclass
class Batch:
    """The tests of a batch, what became of them, and the fits that an executor has; see `batch`."""

    out: Path
    recipe: Recipe
    tests: list[tuple[str, Path]]
    toml: Path | None = None  # for all; else the one beside each
    foreign: bool = False  # whether the executor's machines may have other files
    fresh: bool = False
    progress: Callable[[Batch], None] = lambda _: None
    rows: dict[str, tuple[Row, ...]] = field(default_factory=dict)  # by the name of the test
    waiting: dict[Future[Outcome], Task] = field(default_factory=dict)
    fitted: int = 0  # now
    wrong: int = 0  # of all that are done, without a fit
    saved: float = field(default_factory=lambda: time.monotonic())  # when the summary was written
    took: float = 0.0  # to write it, s

    @property
    def summary(self) -> list[Row]:
        """A row for each test, or for each of its cycles, in the order of the tests."""
        found = list[Row]()
        for name, path in self.tests:
            again = "not fitted yet, because the batch was ended before; call it again"
            found += self.rows.get(name) or (Row(name, str(path), tables.OPEN, again),)
        return found

    def save(self, *, whole: bool = False) -> None:
        """Write summary.csv and summary.html; as a `whole` also parameters side by side."""
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
        """Fit what is to be fitted; what ends this leaves a summary of what is done."""
        try:
            for i, (name, path) in enumerate(self.tests):
                self._begin(executor, name, path)
                while (
                    len(self.waiting) >= MOST_AHEAD
                    or sum(task.size for task in self.waiting.values()) >= MOST_BYTES
                ):
                    self._collect(1.0)
                self._collect(0.0)
                while i == 0 and not self.foreign and self._is_cold() and self.waiting:
                    self._collect(1.0)  # one compiles, for all
            while self.waiting:
                self._collect(1.0)
        except BaseException as error:
            for future in self.waiting:
                future.cancel()
            with without_ctrl_c(), suppress(InputError):
                self.save()
            told = " ".join(str(error).split())
            if isinstance(error, futures.BrokenExecutor | futures.CancelledError):
                told = f"the executor has ended: {told or 'it has given up the tests'}"
            elif not isinstance(error, InputError):
                raise
            done = f"{len(self.rows)} of {counted(len(self.tests), 'test')} are done and stay"
            raise InputError(f"{told}; {done}, call again for the others") from error
        self.save(whole=True)

    def _is_cold(self) -> bool:
        """Whether the first fit compiles what the others need too."""
        model = self.recipe.model
        memory = model == "auto" or self.recipe.options["relaxation"] > 0
        memory = memory or any(law.remembers for law in Model.parse(model).laws)
        return memory and not cache.compiled("integrate_with_memory")

    def _begin(self, executor: Executor, name: str, path: Path) -> None:
        """Take the stored rows of a test, or have it fitted."""
        toml = toml_beside(path) if self.toml is None else self.toml
        folder = self.out / name
        try:
            data, settings, camera = read_whole(path), _bytes(toml), motion_file(toml)
            motion = None if camera is None else _bytes(camera)
        except OSError:  # reading the test gives a better message
            data, settings, motion = b"", None, None
        mark = fingerprint(self.recipe.key, data, settings, motion)
        known = None if self.fresh else stored(folder, mark, self.recipe)
        if known is not None:
            self._keep(name, tuple(replace(row, file=str(path)) for row in known))
            return
        content = (data, settings, motion) if self.foreign and data else None
        out = None if self.foreign else folder.absolute()
        task = Task(name, path, toml, self.recipe, mark, out, content)
        try:
            self.waiting[executor.submit(work, task)] = task
        except RuntimeError as error:  # it was shut down
            raise futures.BrokenExecutor(str(error)) from error

    def _collect(self, seconds: float) -> None:
        """Take the fits that are done, waiting for one so long."""
        done, _ = futures.wait(self.waiting, seconds, futures.FIRST_COMPLETED)
        for future in [one for one in self.waiting if one in done]:
            self._take(future)
        self._save_sometimes()

    def _take(self, future: Future[Outcome]) -> None:
        task = self.waiting.pop(future)
        try:
            rows, files = future.result()
            if files is not None:
                put(files, self.out / task.name)
        except (futures.BrokenExecutor, futures.CancelledError, InputError):  # not written
            raise
        except Exception as error:
            self._keep(task.name, (Row(task.name, str(task.path), tables.REFUSED, _lost(error)),))
            return
        self.fitted += 1
        self._keep(task.name, rows)

    def _keep(self, name: str, rows: tuple[Row, ...]) -> None:
        self.rows[name] = rows
        self.wrong += not all(row.has_fit for row in rows)
        self.progress(self)

    def _save_sometimes(self) -> None:
        """Write the summary from time to time: what is killed leaves it as it was then."""
        began = time.monotonic()
        if began - self.saved < max(PAUSE, SHARE * self.took):
            return
        self.save()
        self.saved = time.monotonic()
        self.took = self.saved - began


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
    """Fit every test on its own, in parallel; a result folder for each and one summary.

    Called again, only what is missing or has changed is fitted: data, TOML, settings or version.
    A test that cannot be read or fitted is a row with its sentence. What is done stays, whatever
    ends the call.

    Parameters
    ----------
    tests : str, Path or several
        Files, folders and globs; see `foamfit.study.test_files.find_tests`.
    out : str or Path, optional
        The folder; by default ``fits/batch/<model>``. It holds ``<test>/`` for each test, the
        result folder of its fit, ``summary.csv`` and ``summary.html``.
    model, options
        As for `foamfit.fit`.
    executor : concurrent.futures.Executor, optional
        What runs the fits, as a Dask client's ``get_executor()``; tests go there and results come
        back with the calls, so that its machines need no common file system. By default processes
        of this machine, one for each core, with one thread each.
    jobs : int, optional
        How many processes of this machine.
    fresh : bool
        Whether everything is fitted again.
    specimen : str or Path, optional
        One TOML for all tests; by default the one beside each.
    cycle : int, sequence of int or "all", optional
        The cycle of each record; several are fitted as `foamfit.fit_cycles` does, and each is a
        row of the summary.
    cycles : (int, int), optional
        First and last of several cycles that are fitted as one history.
    report : bool
        Whether each fit has a report and figures.
    figure_width : str
        "one" or "two" columns, or a length such as "85 mm". A test whose figures have another
        width is fitted again, as its curves are not kept.
    progress : callable, optional
        Given the `Batch` after each test: `rows`, `tests`, `wrong` and `fitted` say how far it is.

    Returns
    -------
    pandas.DataFrame
        The rows of ``summary.csv``.

    Raises
    ------
    InputError
        If the call is wrong, or a result cannot be written, as to a full disk.
    """
    each = () if cycle == "all" else cycle
    if each is not None and not isinstance(each, int):
        each = tuple(int(number) for number in each)
    found = run(
        tests,
        Recipe(model, options, each, report, figure_width, history=cycles),
        out=out,
        executor=executor,
        jobs=jobs,
        fresh=fresh,
        specimen=specimen,
        progress=progress,
    )
    return tables.table(found.summary)


def run(
    tests: Tests,
    recipe: Recipe,
    *,
    out: str | Path | None = None,
    executor: Executor | None = None,
    jobs: int | None = None,
    fresh: bool = False,
    specimen: str | Path | None = None,
    progress: Callable[[Batch], None] | None = None,
) -> Batch:
    """Do what `batch` says, and return all that is known of it."""
    options = Options.of("batch", recipe.options)
    recipe = replace(recipe, model=_checked(recipe.model, options), options=vars(options))
    check_jobs(jobs)
    if recipe.cycles is not None and recipe.history is not None:
        raise InputError("give either cycle or cycles, not both")
    if jobs is not None and executor is not None:
        raise InputError("jobs and an executor exclude each other; leave one of them out")
    inches(recipe.width)  # refuses what is no width
    toml = None if specimen is None else Path(specimen)
    if toml is not None and not toml.is_file():
        raise InputError(f"{toml}: no such file; name the TOML of the specimen of all tests")
    folder = Path("fits", "batch", recipe.model) if out is None else Path(out)
    tell = progress or (lambda _: None)
    made = Batch(folder, recipe, find_tests(tests), toml, executor is not None, fresh, tell)
    _check_out(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder.resolve(), [*(name for name, _ in made.tests), *FILES["batch.json"]])
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {reason(error)}") from None
    with _executor(executor, jobs, made) as runner:
        made.fit(runner)
    return made


def _checked(model: str, options: Options) -> str:
    """Return the model's name; refuse what no test could be fitted with."""
    if model.strip() == "auto":
        options.check_auto()
        return "auto"
    read = Model.parse(with_options(model, **options.of_springs), options.relaxation)
    drive = options.drive or "impact"  # which has them all; each test checks its own
    names = (*read.names, *nuisance.names_of(drive, time_shift=True))
    check_fixed_and_varied(names, read.name, options.fix or {}, options.vary)
    return read.name


def _check_out(out: Path) -> None:
    """Raise InputError unless a folder is free, or holds nothing but what foamfit wrote."""
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
                if not inside or (not foreign and any(one.name in FILES for one in inside)):
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
    """Give what runs the fits; processes of this machine end with the body."""
    if given is not None:
        yield given
        return
    if not cache.compiled():
        _LOG.warning("foamfit: compiling the solver, once after installation")
        with precompile.side_by_side() as finish:
            finish()
    count = min(jobs or cores(), max(len(made.tests), 1))
    try:
        with Processes(count, (*FITS, *(PAGES if made.recipe.pages else ()))) as pool:
            yield pool
    finally:
        sweep(made.out.resolve(), [name for name, _ in made.tests])


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _lost(error: Exception) -> str:
    """Say why a test has no result that the test itself is not known to be the reason of."""
    if isinstance(error, EndedError) or type(error).__name__ == "KilledWorker":  # that is Dask's
        return (
            "its process ended each time that the fit was tried (killed, or out of memory); call "
            "again to try once more"
        )
    told = " ".join(f"{type(error).__name__}: {error}".split())
    return f"its fit was lost ({told}); call again to try once more"
