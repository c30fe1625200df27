"""`foamfit joint`: several tests in one fit."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import (
    FILE,
    NO_REPORT,
    OPEN,
    WIDTH,
    check_open,
    compiling,
    spare,
    tell_written,
)
from foamfit.cli.progress import progress_line
from foamfit.errors import InputError
from foamfit.terminal import say, without_ctrl_c

if TYPE_CHECKING:
    from foamfit.study.joint import JointResult


@main.command()
@click.argument("study", metavar="STUDY.toml", type=FILE)
@click.option("--out", type=FILE, help="Result folder. Default: fits/<STUDY>.")
@click.option(
    "--jobs", type=click.IntRange(min=1), help="Processes. Default: one for each core."
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(min=0), help="Same tests and seed, same numbers. Default: 0."
)
@NO_REPORT
@WIDTH
@OPEN
@click.option("--json", "as_json", is_flag=True, help="Print joint.json on stdout, nothing else.")
@click.option("--quiet", is_flag=True, help="Print nothing but warnings of failure.")
def joint(
    study: Path, out: Path | None, jobs: int | None, seed: int | None,
    no_report: bool, figure_width: str, as_json: bool, quiet: bool,
) -> int:  # fmt: skip
    """Fit the tests of STUDY.toml together: shared, own, scattering, rate-dependent parameters.

    Writes joint.json, joint.html, joint.png and a result folder for each test. Exit codes are those
    of foamfit fit; a test that cannot be read is left out with a warning.

    \b
    STUDY.toml, for example:
        name = "shoe foam, new heel"
        tests = ["new-heel-comp-*_raw.txt"]     # files, folders, globs, relative to this file
        specimen = "heel.toml"                  # of all tests; default: the TOML beside each
        model = "microscale"
        relaxation = 1
        drive = "displacement"                  # default: what each test allows
        [parameters]                            # what is not named is "own"
        s1_k0 = "shared"                        # one value for all tests
        s1_kc = "own"                           # one value for each
        s1_sigma_plus = "scatter"               # one for each, log-normal about a common value
        s1_sigma_minus = "log rate"             # v (1 + b ln(rate/rate0)), rate0 of the median test
        s1_tau1 = "power rate"                  # v (rate/rate0)^b
        s1_g1 = "auto"                          # shared, own or a law of rate, by evidence
        s1_eps_star = 0.3                       # held at a number (SI)
    Also: seed, cycle, starts, and [specimens] with a TOML for single tests: new-heel-1 = "a.toml".
    """
    check_open(as_json)
    from foamfit.report.folder import save_somewhere, try_target

    folder = Path("fits", study.stem) if out is None else out
    try_target(folder)
    from foamfit.study.study_file import read_study

    read = read_study(study)
    spare(folder, [study, *(path for _, path in read.tests)])
    with compiling(quiet or as_json, read.model, read.relaxation) as compile_rest:
        from foamfit.study.joint import FEW_FOLDERS
        from foamfit.study.joint import joint as fit_jointly
        from foamfit.study.workers import begin

        compile_rest()
        if not no_report:
            begin(jobs, len(read.tests), FEW_FOLDERS)
        with progress_line(quiet or as_json, "joint fit") as shown:
            result = fit_jointly(
                read, jobs=jobs, seed=seed, progress=shown.progress, keep=folder
            )  # fmt: skip
        try:
            with progress_line(quiet or as_json, "joint fit") as shown, without_ctrl_c():
                shown.progress(1.0, "writing the reports")
                save_somewhere(
                    result.save, folder, report=not no_report, jobs=jobs, figure_width=figure_width
                )
        except InputError:  # the numbers are not lost with the folder
            _tell(result, as_json, quiet)
            raise
    _tell(result, as_json, quiet)
    tell_written(folder / "joint.html", quiet or as_json)
    if result.status == "failed":
        say(f"foamfit: no acceptable fit was found; see {folder}", err=True)
        return NOT_ACCEPTABLE
    return 0


def _tell(result: JointResult, as_json: bool, quiet: bool) -> None:
    """Print a result."""
    if as_json:
        import json

        say(json.dumps(result.to_json_dict(), allow_nan=False))
    elif not quiet:
        from foamfit.report.studies.joint import joint_text

        say(joint_text(result))
