"""`foamfit fit`, `batch` and `joint`.

The options of fit are shared with batch, the call of the fit with the page.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli import options
from foamfit.cli.options import NOT_ACCEPTABLE, Output, declared, main, option
from foamfit.errors import InputError
from foamfit.options import FREED, OPTIONS
from foamfit.terminal import Progress, progress_line, say
from foamfit.text import option_value

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from foamfit.api import FitResult
    from foamfit.data.measurement import Measurement
    from foamfit.one_model import Options
    from foamfit.study.batch import Batch
    from foamfit.study.cycles import CycleFits

# Options of the command that are not keywords of `foamfit.fit`
NO_KEYWORDS = ("cycle", "cycles", "model", "profile", "mcmc")
PATIENCE = 10  # s, time limit for a scheduler to answer

fit_options = options.together(
    *(declared(name) for name, one in OPTIONS.items() if not one.python_only)
)


def keywords_of(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a command as keywords of `foamfit.fit`."""
    if asked["cycle"] is not None and asked["cycles"] is not None:
        raise InputError("give either --cycle or --cycles, not both")
    profile, draws = asked["profile"], asked["mcmc"]
    if profile and draws is not None:
        why = "--profile and --mcmc exclude each other; choose one method for the intervals"
        raise InputError(why)
    way = "profile" if profile else "auto" if draws is None else "mcmc"
    search = {name: one for name, one in asked.items() if name not in NO_KEYWORDS}
    return search | {"intervals": way, "draws": draws}


@dataclass(frozen=True)
class Ready:
    """A fit as the command asks for it: files read, options checked, nothing simulated."""

    test: Path
    specimen: Path | None
    measurement: Measurement
    model: str
    options: Options
    several: tuple[int, ...] | None  # cycles to be fitted one by one, () for all

    def fit(self, news: Progress) -> FitResult | CycleFits:
        """Fit the test, or the cycles of the record, and report the progress."""
        from foamfit import api

        how: Any = vars(replace(self.options, watch=news.watch)) | {"model": self.model}
        how |= {"progress": news.progress, "tell": news.tell}
        if self.several is None:
            return api.fit(self.measurement, **how)
        from foamfit.study import cycles as study

        return study.fit_cycles(self.test, self.specimen, cycles=self.several or None, **how)


def read_as_asked(test: Path, specimen: Path | None, asked: Mapping[str, Any]) -> Ready:
    """Read a test with the options of the command; InputError if it cannot be fitted so."""
    from foamfit.data.csv_file import read_test
    from foamfit.one_model import Options

    model, wanted, options = asked["model"].strip(), asked["cycle"], Options(**keywords_of(asked))
    several, alone = (wanted, None) if isinstance(wanted, tuple) else (None, wanted)
    measurement = read_test(test, specimen, alone, cycles=asked["cycles"])
    for number in set(several or ()).difference(measurement.cycles):
        last = f"its cycles are {min(measurement.cycles)} to {max(measurement.cycles)}"
        raise InputError(f"--cycle {number}: {test} has no cycle {number}; {last}")
    options.check(measurement, model)  # fail before anything is compiled
    return Ready(test, specimen, measurement, model, options, several)


# Options in the name of a folder: the first ones, in this order, and those of which only the value
# is named.
FIRST = (
    "relaxation", *FREED, "drive", "cycle", "cycles", "specimen", "fix", "vary", "intervals",
)  # fmt: skip
BARE, LONGEST = ("drive", "intervals"), 120  # characters of a name


def folder_name(options: Mapping[str, Any]) -> str:
    """Return the name of a result's folder: the model and the options that the result stores."""
    parts = [options["model"]]
    for name in sorted(options.keys() - {"model"}, key=lambda one: ((*FIRST, one).index(one), one)):
        value, shown = options[name], name.replace("_", "-")
        named = option_value(value) if name in BARE else f"{shown}-{option_value(value)}"
        parts.append(shown if value is True else named)
    whole = re.sub(r"[^\w.,+=-]+", "-", "-".join(parts))
    mark = hashlib.sha256(whole.encode()).hexdigest()[:8]
    return whole if len(whole) <= LONGEST else f"{whole[: LONGEST - 9]}-{mark}"


@main.command()
@options.TEST
@fit_options
@options.output("fits/<test>/<model and options>", "fit.json")
@option("--force", "Replace a result of other data or options in the same folder.")
@option("--verbose", "Also print the checklist, reasons, notes and all models.")
def fit(
    test: Path, specimen: Path | None, output: Output, force: bool, verbose: bool, **asked: Any
) -> int:
    """Identify the parameters of TEST.csv and write a result folder.

    The name of the default folder has the model and all options that change the numbers, such as
    microscale-relaxation-1. A result of the same data and options is replaced.

    With several cycles the folder holds one result folder for each, cycles.csv, cycles.png and
    cycles.json: the parameters by cycle.

    Exit code 0: a fit was made; 1: the input or the call is wrong; 2: no acceptable fit was found
    (the best one is written); 70: a defect of foamfit; 130 and 143: ended by Ctrl-C or SIGTERM
    before any result (later, the best point so far is the result).

    \b
    Examples:
        foamfit fit TEST.csv
        foamfit fit TEST.csv --model auto --open
        foamfit fit TEST.csv --model microscale --relaxation 1
        foamfit fit TEST.csv --model microscale --relaxation 1 --cycle all
        foamfit fit TEST.csv --model microscale --stiffening --mullins --cycles 1-3
        foamfit fit TEST.csv --drive displacement --out results/today --figure-width one
        foamfit fit TEST.csv --model linear+bistable --fix s1_k0=60e6
    """
    from foamfit.data.toml_file import toml_beside
    from foamfit.report.folder import check_same

    ready, toml = read_as_asked(test, specimen, asked), toml_beside(test)
    several = () if ready.several is None else ready.several or ready.measurement.cycles
    made = ready.options.stored(ready.measurement, ready.model, several)
    if specimen not in (None, toml):
        made["specimen"] = specimen.stem
    folder = output.folder(Path("fits", toml.stem, folder_name(made)))

    def check(place: Path) -> None:
        if not force:
            check_same(place, ready.measurement.data_sha256, made)

    check(folder)
    options.compile_solver(output.silent, ready.model)
    with progress_line(output.silent, "fit", says=not output.quiet) as news:
        found = replace(ready.fit(news), options=made)
    page = folder / ("report.html" if ready.several is None else "cycles.png")
    return output.finish(found, page, check=check, verbose=verbose, force=force)


@main.command()
@click.argument("tests", metavar="TEST.csv|FOLDER|GLOB …", nargs=-1, required=True)
@fit_options
@option(
    "--jobs",
    "Processes on this machine, one thread each. Default: one for each core.",
    options.COUNT,
    metavar="N",
)
@option("--scheduler", "A running Dask scheduler, as tcp://127.0.0.1:8786.", metavar="ADDRESS")
@option("--fresh", "Fit everything again, including what is already done.")
@options.output("fits/batch/<model>", "the rows as JSON", always_page=True)
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
    if not (wrong := sum(not row.has_fit for row in rows)):
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
@declared("seed", default=None, help="The same tests and seed give the same numbers. Default: 0.")
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
    from foamfit.study.study_file import read_study

    read = read_study(study)  # report a wrong path before the folder that it would have
    name = f"{study.resolve().parent.name}-joint" if study.stem == "joint" else study.stem
    folder = output.folder(Path("fits", name), "joint.json")
    from foamfit.study.joint import joint as fit_jointly

    options.compile_solver(output.silent, read.model)
    with progress_line(output.silent, "joint fit") as line:
        found = fit_jointly(read, seed=seed, progress=line.progress)
    return output.finish(found, folder / "joint.html")
