"""`foamfit batch` and `joint`: several tests, each on its own or in one fit."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli import options
from foamfit.cli.fit import fit_options, keywords_of
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import Output
from foamfit.cli.progress import progress_line
from foamfit.errors import InputError
from foamfit.terminal import say

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from foamfit.study.batch import Batch

PATIENCE = 10  # s, time limit for the scheduler to answer


@main.command()
@click.argument("tests", metavar="TEST.csv|FOLDER|GLOB …", nargs=-1, required=True)
@fit_options
@options.option(
    "--jobs",
    "Processes on this machine, one thread each. Default: one for each core.",
    options.COUNT,
    metavar="N",
)
@options.option(
    "--scheduler", "A running Dask scheduler, as tcp://127.0.0.1:8786.", metavar="ADDRESS"
)
@options.option("--fresh", "Fit everything again, including what is already done.")
@options.output("fits/batch/<model>", "the rows as JSON")
def batch(
    tests: tuple[str, ...],
    specimen: Path | None,
    jobs: int | None,
    scheduler: str | None,
    fresh: bool,
    output: Output,
    **asked: Any,
) -> int:
    """Fit every test on its own, in parallel.

    Writes a result folder for each test, summary.csv and summary.html.
    A test that cannot be read or fitted is a row of the summary that says why. Called again, the
    command fits only tests that are missing or whose data, TOML, settings, figure width or version
    have changed. Finished tests are kept, however the command ends.

    Exit code 0: every test has a fit; 1: the call is wrong, or the results cannot be written; 2:
    some tests have no fit; 70, 130 and 143 as for fit.

    \b
    Examples:
        foamfit batch tests/ --specimen foam.toml
        foamfit batch "tests/*.csv" --model microscale --relaxation 1 --jobs 4 --out results
        foamfit batch tests/ --scheduler tcp://127.0.0.1:8786 --no-report
    """
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler exclude each other; leave one of them out")
    output.check()
    search, cycles = keywords_of(asked), asked["cycle"]
    from foamfit.report.listing import summary_words, table_rows
    from foamfit.study import batch as study

    if scheduler is None:
        options.compile_solver(output.silent, asked["model"])
    with (
        nullcontext() if scheduler is None else _cluster(scheduler) as executor,
        progress_line(output.silent, "batch") as line,
    ):
        found: list[Batch] = []

        def tell(made: Batch) -> None:
            found[:] = [made]
            done, left = len(made.rows), len(made.tests) - len(made.rows)
            state = f"{done} done, {made.wrong} without a fit, {left} left"
            line.progress(made.fitted / max(made.fitted + left, 1), state)

        how: Any = {"report": not output.no_report, "figure_width": output.figure_width}
        how |= {"cycle": "all" if cycles == () else cycles, "cycles": asked["cycles"]}
        how |= {"executor": executor, "jobs": jobs, "fresh": fresh, "specimen": specimen}
        study.batch(tests, out=output.out, model=asked["model"], progress=tell, **how, **search)
    rows, folder = found[0].summary, found[0].out

    output.show(lambda: table_rows(rows), lambda: summary_words(rows))
    output.tell_written(folder / "summary.html")
    wrong = sum(not row.has_fit for row in rows)
    if not wrong:
        return 0
    have = "has" if wrong == 1 else "have"
    summary = folder / "summary.csv"
    say(f"foamfit: {wrong} of {len(rows)} tests {have} no acceptable fit; see {summary}", err=True)
    return NOT_ACCEPTABLE


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """Yield the executor of a running Dask scheduler."""
    try:
        from dask.distributed import Client
    except ImportError:
        raise InputError(
            '--scheduler needs Dask, which is not installed: pip install "foamfit[dask]"'
        ) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are reported below
    connect: Any = Client  # it has no type annotations
    try:
        client = connect(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:  # also TimeoutError
        reason = " ".join(str(error).split())
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers ({reason}); start one by 'dask "
            "scheduler' and name its address, as tcp://127.0.0.1:8786"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            say("foamfit: the scheduler has no worker yet; the tests wait for one", err=True)
        yield client.get_executor(pure=False)


@main.command()
@click.argument("study", metavar="STUDY.toml", type=options.FILE)
@options.declared(
    "seed", default=None, help="The same tests and seed give the same numbers. Default: 0."
)
@options.output("fits/<STUDY>; fits/<plan>-joint for the joint.toml of a plan", "joint.json")
def joint(study: Path, seed: int | None, output: Output) -> int:
    """Fit the tests of STUDY.toml together.

    Parameters are shared, own (one per test), scattering or rate-dependent.
    Writes joint.json, joint.html, figures, table.tex and a result folder for each test. Exit codes
    are those of foamfit fit. A test that cannot be read is omitted with a warning.

    \b
    STUDY.toml, for example:
        name = "shoe foam"
        tests = ["heel-*.csv"]                  # files, folders, globs, relative to this file
        specimen = "heel.toml"                  # for all tests; default: the TOML beside each
        model = "microscale"
        relaxation = 1
        drive = "displacement"                  # default: as for foamfit fit
        [parameters]                            # parameters not listed are "own"
        s1_k0 = "shared"                        # one value for all tests
        s1_kc = "own"                           # one value for each test
        s1_sigma_plus = "scatter"               # one for each test, log-normal about a common value
        s1_sigma_minus = "log rate"             # v (1 + b ln(rate/rate0)), rate0 of the median test
        s1_tau1 = "power rate"                  # v (rate/rate0)^b
        s1_g1 = "auto"                          # shared, own or a rate law, by evidence
        s1_eps_star = 0.3                       # fixed at a value (SI)
    Also: seed, cycle, starts, and [specimens] with a TOML for single tests: heel-1 = "a.toml".
    """
    output.check(without_report=False)
    name = f"{study.resolve().parent.name}-joint" if study.stem == "joint" else study.stem
    folder = output.folder(Path("fits", name), "joint.json")
    from foamfit.study.study_file import read_study

    read = read_study(study)
    from foamfit.study.joint import joint as fit_jointly

    options.compile_solver(output.silent, read.model)
    with progress_line(output.silent, "joint fit") as line:
        found = fit_jointly(read, seed=seed, progress=line.progress)
    return output.finish(found, folder / "joint.html")
