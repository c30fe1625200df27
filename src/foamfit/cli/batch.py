"""`foamfit batch`: every test on its own, in parallel, resumable."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli.fit_options import fit_options, intervals_of
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import (
    CYCLE,
    FILE,
    NO_REPORT,
    OPEN,
    SPECIMEN,
    WIDTH,
    check_open,
    compiling,
    cycles_of,
    tell_written,
)
from foamfit.cli.progress import duration
from foamfit.errors import InputError
from foamfit.terminal import say

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from foamfit.study.batch import State

# Seconds in which a scheduler must answer.
PATIENCE = 10


@main.command()
@click.argument("tests", metavar="TEST.csv|FOLDER|GLOB …", nargs=-1, required=True)
@SPECIMEN
@CYCLE
@click.option("--out", type=FILE, help="Folder of all results. Default: fits/batch/<model>.")
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N",
    help="Processes on this machine, one thread each. Default: one for each core.",
)  # fmt: skip
@click.option(
    "--scheduler", metavar="ADDRESS", help="A running Dask scheduler, as tcp://127.0.0.1:8786."
)
@click.option("--fresh", is_flag=True, help="Fit everything again, what is done already too.")
@NO_REPORT
@fit_options
@WIDTH
@OPEN
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON, nothing else.")
@click.option("--quiet", is_flag=True, help="Print nothing but warnings of failure.")
def batch(
    tests: tuple[str, ...], specimen: Path | None, cycle: str | None, model: str, out: Path | None,
    jobs: int | None, scheduler: str | None, fresh: bool, no_report: bool, figure_width: str,
    as_json: bool, quiet: bool, **search: Any,
) -> int:  # fmt: skip
    """Fit every test on its own: a result folder for each, summary.csv and summary.html.

    A test that cannot be read or fitted is a row of the summary with its sentence. Called again,
    only what is missing or has changed is fitted: data, TOML, settings, width of the figures or
    version. What is done stays, however the command ends.

    Exit code 0: every test has a fit; 1: the call is wrong, or the results cannot be written; 2:
    some tests have no fit; 70, 130 and 143 as of fit.

    \b
    Examples:
        foamfit batch tests/ --specimen foam.toml
        foamfit batch "tests/*.csv" --model microscale --relaxation 1 --jobs 4 --out results
        foamfit batch tests/ --scheduler tcp://127.0.0.1:8786 --no-report
    """
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler exclude each other; leave one of them out")
    check_open(as_json)
    search |= intervals_of(**{way: search.pop(way) for way in ("profile", "bootstrap", "mcmc")})
    alone, several = cycles_of(cycle)
    from foamfit.study import processes

    if scheduler is None:
        processes.prepare((*processes.FITS, *(() if no_report else processes.PAGES)))
    from foamfit.report.studies.batch import summary_words, table_rows
    from foamfit.study.batch import run
    from foamfit.study.batch_work import Recipe

    fix, vary = search.pop("fix") or None, search.pop("vary")
    cycles = alone if several is None else several
    recipe = Recipe(model, {}, cycles, fix, vary, not no_report, figure_width)
    if scheduler is None:
        with compiling(quiet or as_json, model, search["relaxation"]) as compile_rest:
            compile_rest()
    with (
        nullcontext() if scheduler is None else _cluster(scheduler) as executor,
        _progress_line(quiet or as_json) as progress,
    ):
        found = run(
            tests, recipe, out=out, executor=executor, jobs=jobs, fresh=fresh, specimen=specimen,
            progress=progress, **search,
        )  # fmt: skip
    rows = found.summary
    if as_json:
        import json

        head, *cells = table_rows(rows)
        say(json.dumps([dict(zip(head, row, strict=True)) for row in cells], allow_nan=False))
    elif not quiet:
        say(summary_words(rows))
    tell_written(found.out / "summary.html", quiet or as_json)
    wrong = sum(not row.has_fit for row in rows)
    if wrong:
        told = f"{wrong} of {len(rows)} tests {'has' if wrong == 1 else 'have'} no acceptable fit"
        say(f"foamfit: {told}; see {found.out / 'summary.csv'}", err=True)
    return NOT_ACCEPTABLE if wrong else 0


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """Give the executor of a running Dask scheduler."""
    try:
        from dask.distributed import Client
    except ImportError:
        raise InputError(
            '--scheduler needs Dask, which is not installed: pip install "foamfit[dask]"'
        ) from None
    import logging

    # What matters is said in a sentence.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    connect: Any = Client  # which has no types
    try:
        client = connect(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:  # also TimeoutError
        told = " ".join(str(error).split())
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers ({told}); start one by 'dask "
            "scheduler' and name its address, as tcp://127.0.0.1:8786"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            say("foamfit: the scheduler has no worker yet, the tests wait for one", err=True)
        yield client.get_executor(pure=False)


@contextmanager
def _progress_line(quiet: bool) -> Iterator[Callable[[State], None]]:
    """Give a line on stderr: done, without a fit, left; silent where stderr is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda state: None
        return
    began = time.monotonic()
    with click.progressbar(length=1000, label="batch", file=sys.stderr, show_eta=False) as bar:

        def progress(state: State) -> None:
            bar.label = f"{state.done} done, {state.wrong} without a fit, {state.left} left"
            if state.fitted and state.left:
                rest = (time.monotonic() - began) / state.fitted * state.left
                bar.label += f", about {duration(rest)}"
            total = max(state.done + state.left, 1)
            bar.update(round(1000 * state.done / total) - bar.pos)

        yield progress
