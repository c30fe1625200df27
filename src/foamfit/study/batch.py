"""Many tests, each on its own: in parallel, resumable, a folder for each and one summary."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

from foamfit.data.toml_file import motion_file, toml_beside
from foamfit.errors import InputError
from foamfit.files import is_left, read_whole, reason, sweep
from foamfit.fitting import nuisance
from foamfit.one_model import Keywords, Options
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import FILES, check_target, is_written
from foamfit.report.studies import batch as tables
from foamfit.report.studies.batch import Row
from foamfit.results import law_in_words
from foamfit.solve import cache, precompile
from foamfit.springs import laws
from foamfit.springs.model import Model, with_options
from foamfit.study.batch_work import (
    Outcome,
    Recipe,
    Task,
    fingerprint,
    put,
    settings_key,
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
# What is given to an executor ahead of what it has done: tests, and bytes of their files.
MOST_AHEAD, MOST_BYTES = 1000, 2**28
# Seconds between two summaries, and how much longer than both its files take to write.
PAUSE, SHARE = 5.0, 50.0
Tests = str | Path | Iterable[str | Path]
Cycles = int | Sequence[int] | Literal["all"] | None


class BatchKeywords(Keywords, total=False):
    """The options of a fit, and parameters that it holds or varies."""

    fix: Mapping[str, float] | None
    vary: Sequence[str]


@dataclass(frozen=True)
class State:
    """How far a batch is: tests done in all, of these without a fit, left, and fitted now."""

    done: int
    wrong: int
    left: int
    fitted: int


Progress = Callable[[State], None]


@dataclass
class Batch:
    """The tests of a batch, what became of them, and the fits that an executor has; see `batch`."""

    out: Path
    recipe: Recipe
    tests: list[tuple[str, Path]]
    toml: Path | None = None  # for all; else the one beside each
    foreign: bool = False  # whether the executor's machines may have other files
    fresh: bool = False
    progress: Progress = lambda _: None
    rows: dict[str, tuple[Row, ...]] = field(default_factory=dict)  # by the name of the test
    waiting: dict[Future[Outcome], tuple[str, Path, int]] = field(default_factory=dict)
    ahead: int = 0  # bytes that wait
    fitted: int = 0
    wrong: int = 0
    saved: float = field(default_factory=lambda: time.monotonic())  # when the summary was written
    took: float = 0.0  # to write it, s

    @cached_property
    def key(self) -> str:
        """What the results are made by."""
        return settings_key(self.recipe)

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
        options = self.recipe.options
        model = with_options(self.recipe.model, **{o: bool(options.get(o)) for o in laws.OPTIONS})
        law = law_in_words(model, options.get("relaxation", 0))
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
                while len(self.waiting) >= MOST_AHEAD or self.ahead >= MOST_BYTES:
                    self._collect(1.0)
                self._collect(0.0)
                while i == 0 and not self.foreign and self._is_cold() and self.waiting:
                    self._collect(1.0)  # one compiles, for all
            while self.waiting:
                self._collect(1.0)
        except BaseException:
            for future in self.waiting:
                future.cancel()
            with without_ctrl_c(), suppress(InputError):
                self.save()
            raise
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
        except OSError:  # who reads the test says it better
            data, settings, motion = b"", None, None
        mark = fingerprint(self.key, data, settings, motion)
        known = None if self.fresh else stored(folder, mark, self.recipe)
        if known is not None:
            self._keep(name, tuple(replace(row, file=str(path)) for row in known))
            return
        content = (data, settings, motion) if self.foreign and data else None
        out = None if self.foreign else folder.absolute()
        task = Task(name, path, toml, self.recipe, mark, out, content)
        try:
            future = executor.submit(work, task)
        except (BrokenExecutor, RuntimeError) as error:
            raise self._ended(error) from error
        size = len(data) + len(motion or b"") if content else 0
        self.ahead += size
        self.waiting[future] = (name, path, size)

    def _collect(self, seconds: float) -> None:
        """Take the fits that are done, waiting for one so long."""
        done, _ = wait(self.waiting, seconds, FIRST_COMPLETED) if self.waiting else ((), ())
        for future in [one for one in self.waiting if one in done]:
            self._take(future)
        self._save_sometimes()

    def _take(self, future: Future[Outcome]) -> None:
        name, path, size = self.waiting.pop(future)
        self.ahead -= size
        try:
            outcome = future.result()
        except (BrokenExecutor, CancelledError) as error:
            raise self._ended(error) from error
        except Exception as error:
            self._keep(name, (Row(name, str(path), tables.REFUSED, _lost(error)),))
            return
        unwritten = outcome.unwritten
        if unwritten is None and outcome.files is not None:
            try:
                put(outcome.files, self.out / name)
            except InputError as error:
                unwritten = str(error)
        if unwritten is not None:
            raise InputError(f"{unwritten}; {self._done_words()}")
        self.fitted += 1
        self._keep(name, outcome.rows)
        self._save_sometimes()

    def _keep(self, name: str, rows: tuple[Row, ...]) -> None:
        self.rows[name] = rows
        self.wrong += not all(row.has_fit for row in rows)
        done = len(self.rows)
        self.progress(State(done, self.wrong, len(self.tests) - done, self.fitted))

    def _save_sometimes(self) -> None:
        """Write the summary from time to time: what is killed leaves it as it was then."""
        began = time.monotonic()
        if began - self.saved < max(PAUSE, SHARE * self.took):
            return
        self.save()
        self.saved = time.monotonic()
        self.took = self.saved - began

    def _ended(self, error: BaseException) -> InputError:
        told = " ".join(str(error).split()) or "it has given up the tests"
        return InputError(f"the executor has ended: {told}; {self._done_words()}")

    def _done_words(self) -> str:
        done, count = len(self.rows), counted(len(self.tests), "test")
        return f"{done} of {count} are done and stay, call again for the others"


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
    progress: Progress | None = None,
    **options: Unpack[BatchKeywords],
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
    model : str
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
        Told the `State` after each test.
    options
        As for `foamfit.fit`; and ``fix``, parameters to hold at a value (SI), and ``vary``, names
        of parameters to vary though they are held by default.

    Returns
    -------
    pandas.DataFrame
        The rows of ``summary.csv``.

    Raises
    ------
    InputError
        If the call is wrong, or a result cannot be written, as to a full disk.
    """
    fix, vary = options.pop("fix", None), tuple(options.pop("vary", ()))
    each = () if cycle == "all" else cycle
    if each is not None and not isinstance(each, int):
        each = tuple(int(number) for number in each)
    if each is not None and cycles is not None:
        raise InputError("give either cycle or cycles, not both")
    found = run(
        tests,
        Recipe(model, options, each, fix, vary, report, figure_width, history=cycles),
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
    progress: Progress | None = None,
    **options: Unpack[Keywords],
) -> Batch:
    """Do what `batch` says, and return all that is known of it.

    The options of the fits are those of the recipe, or given here.
    """
    chosen = Options.of("batch", {**recipe.options, **options})
    recipe = replace(recipe, model=_checked(recipe, chosen), options=vars(chosen))
    check_jobs(jobs)
    if jobs is not None and executor is not None:
        raise InputError("jobs and an executor exclude each other; leave one of them out")
    inches(recipe.width)  # refuses what is no width
    toml = None if specimen is None else Path(specimen)
    if toml is not None and not toml.is_file():
        raise InputError(f"{toml}: no such file; name the TOML of the specimen of all tests")
    folder = Path("fits", "batch", recipe.model) if out is None else Path(out)
    found, tell = find_tests(tests), progress or (lambda _: None)
    made = Batch(folder, recipe, found, toml, executor is not None, fresh, tell)
    check_out(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder.resolve(), [*(name for name, _ in made.tests), *FILES["batch.json"]])
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {reason(error)}") from None
    with _executor(executor, jobs, made) as runner:
        made.fit(runner)
    return made


def _checked(recipe: Recipe, options: Options) -> str:
    """Return the model's name; refuse what no test could be fitted with."""
    if recipe.model.strip() == "auto":
        if recipe.fix or recipe.vary:
            raise InputError("fix and vary belong to one model; name it instead of 'auto'")
        if options.relaxation:
            raise InputError(
                f"relaxation = {options.relaxation} belongs to one model; name it instead of "
                "'auto', which tries relaxation by itself"
            )
        return "auto"
    asked = {name: getattr(options, name) for name in laws.OPTIONS}
    model = Model.parse(with_options(recipe.model, **asked), options.relaxation)
    drive = options.drive or "impact"  # which has them all; each test checks its own
    names = (*model.names, *nuisance.names_of(drive, time_shift=True))
    for name in (*(recipe.fix or ()), *recipe.vary):
        if name not in names:
            raise InputError(
                f"parameter '{name}' is not one of the model {model.name}; "
                f"its parameters are {', '.join(names)}"
            )
        if name in (recipe.fix or ()) and name in recipe.vary:
            raise InputError(f"parameter '{name}' cannot be both fixed and varied; choose one")
    return model.name


def check_out(out: Path) -> None:
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
