"""`foamfit joint`: several tests in one fit."""

from __future__ import annotations

from pathlib import Path

import click

from foamfit.cli import options
from foamfit.cli.group import NOT_ACCEPTABLE, main
from foamfit.cli.options import Output
from foamfit.cli.progress import progress_line
from foamfit.terminal import say


@main.command()
@click.argument("study", metavar="STUDY.toml", type=options.FILE)
@options.option("--jobs", "Processes. Default: one for each core.", options.COUNT)
@options.option(
    "--seed", "The same tests and seed give the same numbers. Default: 0.", options.WHOLE
)
@options.output("fits/<STUDY>", "joint.json")
def joint(study: Path, jobs: int | None, seed: int | None, output: Output) -> int:
    """Fit the tests of STUDY.toml together: shared, own, scattering, rate-dependent parameters.

    Writes joint.json, joint.html, pictures, table.tex and a result folder for each test. Exit codes
    are those of foamfit fit; a test that cannot be read is left out with a warning.

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
    output.check(without_report=False)
    folder = output.folder(Path("fits", study.stem), [study])
    from foamfit.study.study_file import read_study

    read = read_study(study)
    output.folder(folder, [path for _, path in read.tests])
    with options.compiling(output.silent, read.model, read.relaxation) as compile_rest:
        from foamfit.report.studies.joint import joint_text
        from foamfit.study.joint import FEW_FOLDERS
        from foamfit.study.joint import joint as fit_jointly
        from foamfit.study.processes import begin

        compile_rest()
        if not output.no_report:
            begin(jobs, len(read.tests), FEW_FOLDERS)
        with progress_line(output.silent, "joint fit") as line:
            found = fit_jointly(read, jobs=jobs, seed=seed, progress=line.progress)
        output.finish(
            found.save,
            folder / "joint.html",
            found.to_json_dict,
            lambda: joint_text(found),
            jobs=jobs,
            figure_width=output.figure_width,
        )
    if found.status != "failed":
        return 0
    say(f"foamfit: no acceptable fit was found; see {folder}", err=True)
    return NOT_ACCEPTABLE
