"""The command `foamfit`. Heavy modules are imported by the commands that need them."""

# ruff: noqa: D301  (a \b keeps click from joining the lines of an example)

from __future__ import annotations

import atexit
import functools
import gc
import math
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from foamfit.errors import InputError, SimulationError
from foamfit.files import check_file
from foamfit.terminal import TerminatedError, ending_cleanly, say, show_all, without_ctrl_c

if TYPE_CHECKING:
    import lmfit

    from foamfit.api import FitResult
    from foamfit.data.measurement import Measurement
    from foamfit.study.cycles import CycleFits

# Exit codes: the input or the call is wrong; no acceptable fit; a defect (EX_SOFTWARE of
# sysexits.h). The number of a signal that ended the command is added to the last.
WRONG, NOT_ACCEPTABLE, DEFECT, SIGNALLED = 1, 2, 70, 128


class _Group(click.Group):
    """A command group whose every refusal is one sentence with its exit code."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        kwargs["standalone_mode"] = False
        _spare_the_collector()
        show_all()
        try:
            with ending_cleanly():
                code = super().main(*args, **kwargs)
                say("", newline=False)  # what click has printed
        except click.ClickException as error:
            _leave(WRONG, _one_sentence(error))
        except (InputError, SimulationError) as error:
            _leave(WRONG, str(error))
        except (click.Abort, KeyboardInterrupt):
            _leave(SIGNALLED + signal.SIGINT, "interrupted by Ctrl-C")
        except TerminatedError as error:
            _leave(SIGNALLED + error.number, f"ended by {signal.Signals(error.number).name}")
        except Exception as error:
            if os.environ.get("FOAMFIT_TRACEBACK"):
                raise
            told = f"{type(error).__name__}: {error}"
            _leave(
                DEFECT,
                f"this is a defect of foamfit, please report it ({told}); FOAMFIT_TRACEBACK=1 "
                "shows where it is",
            )
        sys.exit(code if isinstance(code, int) else 0)


@functools.cache
def _spare_the_collector() -> None:
    """Keep the garbage collector from going through what the imports have made.

    These are some hundred thousand objects that all stay; to collect them took a quarter of a fit.
    """
    gc.set_threshold(100_000, 20, 10)
    atexit.register(gc.freeze)


def _leave(code: int, message: str) -> NoReturn:
    """Print one line on stderr and leave."""
    say(f"foamfit: {' '.join(message.split())}", err=True)
    sys.exit(code)


def _one_sentence(error: click.ClickException) -> str:
    """Return what click refuses, and where the right call is told, where click does not tell it."""
    message = error.format_message()
    if isinstance(error, click.UsageError) and not isinstance(error, click.BadParameter):
        path = error.ctx.command_path if error.ctx else "foamfit"
        message = message.replace(". Did you", ", did you").replace(". (Did you", " (did you")
        message = f"{message.rstrip('.?')}; see {path} --help"
    return message


@click.group(
    "foamfit",
    cls=_Group,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="foamfit", message="foamfit %(version)s")
@click.pass_context
def main(context: click.Context) -> None:
    """Identify the parameters of a foam from an impact or compression test.

    \b
    Look at a test, then fit it:
        foamfit check experiments/foam-1/model-1-2.0mps-reconstruction.csv
        foamfit fit experiments/foam-1/model-1-2.0mps-reconstruction.csv
    Two springs, fixed seed, result as JSON:
        foamfit fit TEST.csv --model linear+bistable --seed 1 --json
    A forward run:
        foamfit simulate SCENE.toml --plot scene.png

    The model is that of Thevamaran, Fraternali & Daraio (2014), J. Appl. Mech. 81, 121006.
    """
    if context.invoked_subcommand is None:
        say(context.get_help())


_FILE = click.Path(path_type=Path)
_TEST = click.argument("test", metavar="TEST.csv", type=_FILE)
_SPECIMEN = click.option(
    "--specimen", metavar="FILE.toml", type=_FILE,
    help="Specimen, striker, columns, noise, window, data. Default: TEST.toml beside the CSV.",
)  # fmt: skip
_CYCLE = click.option(
    "--cycle", metavar="N|all",
    help="Cycle of a slow record: a number, several as 1,2,10, or all. Default: the first.",
)  # fmt: skip
_PLOT = click.option("--plot", type=_FILE, help="Also draw a PNG, PDF or SVG.")
_DRIVE = click.option(
    "--drive",
    type=click.Choice(["impact", "stress", "displacement"]),
    help="Default: impact if striker and time are known, else displacement.",
)  # fmt: skip
_RELAXATION = click.option(
    "--relaxation", type=click.IntRange(min=0), default=0, show_default=True, metavar="N",
    help="Relaxation terms of every bistable and microscale spring; auto tries one by itself.",
)  # fmt: skip


@main.command()
@_TEST
@_SPECIMEN
@click.option("--model", help="Also estimate what the test determines of this model.")
@_DRIVE
@_RELAXATION
@click.option("--published", "published_set", metavar="NAME", help="Start from a published set.")
@click.option(
    "--params", metavar="RESULT", type=_FILE,
    help="Start from an earlier result. Default: a quick descent from the measured loop.",
)  # fmt: skip
@_PLOT
def check(
    test: Path, specimen: Path | None, model: str | None, drive: str | None,
    published_set: str | None, params: Path | None, plot: Path | None, relaxation: int,
) -> None:  # fmt: skip
    """Say what the loader understood of TEST.csv: columns, contact, specimen, energy.

    With --model also what the test determines: the velocity that closes the loop, the standard
    errors to expect, the channel worth measuring better. A TOML in place of the CSV plans a test
    that is not made yet, if --published or --params says what foam it will be.

    \b
    Examples:
        foamfit check TEST.csv --specimen foam.toml
        foamfit check TEST.csv --model bistable --plot what.png
        foamfit check PLAN.toml --model bistable --published foam-1/model-1
    """
    from foamfit.data.csv_file import read_test
    from foamfit.data.describe import describe
    from foamfit.data.energy import audit

    if model is None:
        given: dict[str, object] = {
            "drive": drive, "published": published_set, "params": params, "plot": plot,
            "relaxation": relaxation or None,
        }  # fmt: skip
        for option, value in given.items():
            if value is not None:
                raise InputError(f"--{option} needs --model; give one, as --model bistable")
    _check_files(None, plot, ())
    if published_set is not None and params is not None:
        raise InputError("--published and --params exclude each other; give one of them")
    description = ""
    if model is None or test.suffix.lower() != ".toml":
        measurement = read_test(test, specimen)
        description = describe(measurement, audit(measurement)) + "\n"
    if model is None:
        say(description, newline=False)
        return
    from foamfit.report.outlook import outlook_of
    from foamfit.report.outlook_text import outlook_text

    with _compiling(False, model, relaxation) as compile_rest:
        compile_rest()
    outlook = outlook_of(
        test, specimen, model, drive, published_set=published_set, result=params,
        relaxation=relaxation,
    )  # fmt: skip
    if description:
        say(description)
    say(outlook_text(outlook))
    if plot is not None:
        from foamfit.report.identifiability_plots import plot_insight

        name, insight = outlook.problem.measurement.name, outlook.planned.insight
        if insight is None:
            say("\nnothing is drawn: no parameter changes the curves")
        else:
            title = f"{name} · {outlook.problem.model.name} · before the fit"
            plot_insight(insight, title=title, path=plot)
            say(f"\ndrawn in {plot}")


def _fixes(
    context: click.Context, option: click.Parameter, values: tuple[str, ...]
) -> dict[str, float]:
    fixed = {}
    for text in values:
        name, _, number = text.partition("=")
        try:
            fixed[name.strip()] = value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise click.BadParameter(f"'{text}' is not NAME=VALUE in SI, as s1_eta=0.")
    return fixed


def _params(
    measurement: Measurement, model: str, search: dict[str, Any],
    fix: dict[str, float], vary: tuple[str, ...],
) -> lmfit.Parameters | None:  # fmt: skip
    """Return the parameters of a model as --fix and --vary want them; None for auto."""
    from foamfit.fitting.curves import check_time_shift, choose_drive
    from foamfit.fitting.problem import make_params

    drive, time_shift = search["drive"], search["time_shift"]
    if time_shift:
        check_time_shift(measurement, drive or choose_drive(measurement))
    if model == "auto":
        if fix or vary:
            raise InputError(
                "--fix and --vary belong to one model; name it instead of --model auto"
            )
        return None
    params = make_params(
        measurement, model, drive, time_shift=time_shift, relaxation=search["relaxation"]
    )
    for name in (*fix, *vary):
        if name not in params:
            raise InputError(
                f"parameter '{name}' is not one of the model {model}; "
                f"its parameters are {', '.join(params)}"
            )
        if name in fix and name in vary:
            raise InputError(f"parameter '{name}' cannot be both fixed and varied; choose one")
        if params[name].expr is not None:
            others = ", ".join(other for other in params if other in params[name].expr)
            raise InputError(f"parameter '{name}' follows from {others}; fix or vary that instead")
        if name in vary and name.endswith("_height") and not params[name].vary:
            raise InputError(
                f"'{name}' is given by the specimen; leave [specimen] heights out to have it fitted"
            )
    for name, value in fix.items():
        params[name].set(value=value, vary=False, min=-math.inf, max=math.inf)
    for name in vary:
        params[name].set(vary=True)
    return params


def _intervals(profile: bool, bootstrap: int | None, mcmc: int | None) -> dict[str, Any]:
    """Return the way of making intervals that --profile, --bootstrap or --mcmc names."""
    given = {"profile": profile or None, "bootstrap": bootstrap, "mcmc": mcmc}
    ways = [name for name, value in given.items() if value is not None]
    if len(ways) > 1:
        names = " and ".join(f"--{name}" for name in ways)
        raise InputError(f"{names} exclude each other; choose one way to make the intervals")
    draws = mcmc if bootstrap is None else bootstrap
    return {"intervals": ways[0] if ways else "auto", "draws": draws}


@main.command()
@_TEST
@_SPECIMEN
@_CYCLE
@click.option(
    "--model", default="bistable", show_default=True,
    help="Springs from the base up; auto compares models, takes the simplest that holds.",
)  # fmt: skip
@_DRIVE
@click.option("--out", type=_FILE, help="Result folder. Default: fits/<test>/<model>.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True,
    help="Same test and seed, same numbers.",
)  # fmt: skip
@click.option(
    "--starts", type=click.IntRange(min=1), help="Descents of the search. Default: 16 per spring."
)  # fmt: skip
@click.option("--max-time", type=float, metavar="SECONDS", help="Then the best so far is taken.")
@click.option("--fix", multiple=True, metavar="NAME=VALUE", callback=_fixes, help="Hold one (SI).")
@click.option("--vary", multiple=True, metavar="NAME", help="Vary one that is held by default.")
@click.option("--interior-mass", is_flag=True, help="Put the specimen's mass between the springs.")
@click.option("--time-shift", is_flag=True, help="Fit how late the motion is against the force.")
@_RELAXATION
@click.option(
    "--loss", type=click.Choice(["linear", "soft_l1", "huber", "cauchy"]), default="linear",
    show_default=True, help="All but linear weigh large residuals less.",
)  # fmt: skip
@click.option("--profile", is_flag=True, help="95 % intervals by profile likelihood.")
@click.option(
    "--bootstrap", type=int, metavar="N",
    help="95 % intervals by N >= 40 refits to resampled blocks.",
)  # fmt: skip
@click.option("--mcmc", type=int, metavar="N", help="95 % intervals by N steps of emcee.")
@click.option("--json", "as_json", is_flag=True, help="Print fit.json on stdout, nothing else.")
@click.option("--quiet", is_flag=True, help="Print nothing but warnings of failure.")
@click.option(
    "--verbose", is_flag=True, help="Print the checklist, reasons, notes and all models too."
)
def fit(
    test: Path, specimen: Path | None, cycle: str | None, model: str, out: Path | None,
    fix: dict[str, float], vary: tuple[str, ...],
    as_json: bool, quiet: bool, verbose: bool, **search: Any,
) -> int:  # fmt: skip
    """Identify the parameters of TEST.csv and write a result folder.

    With several cycles the folder holds one result folder for each, cycles.csv, cycles.png and
    cycles.json: what changes from cycle to cycle, by one fit of them together.

    Exit code 0: a fit was made; 1: the input or the call is wrong; 2: no acceptable fit was found
    (what was found is written); 70: a defect of foamfit; 130 and 143: ended by Ctrl-C before
    anything was found, and by SIGTERM.

    \b
    Examples:
        foamfit fit TEST.csv
        foamfit fit TEST.csv --model auto
        foamfit fit TEST.csv --model microscale --relaxation 1
        foamfit fit TEST.csv --model microscale --relaxation 1 --cycle all
        foamfit fit TEST.csv --drive displacement --out results/today
        foamfit fit TEST.csv --model linear+bistable --fix s1_k0=60e6
    """
    from foamfit.data.csv_file import read_test
    from foamfit.springs.model import Model

    search |= _intervals(**{way: search.pop(way) for way in ("profile", "bootstrap", "mcmc")})
    model = "auto" if model.strip() == "auto" else Model.parse(model).name
    alone, several = _cycles(cycle)
    with _compiling(quiet or as_json, model, search["relaxation"]) as compile_rest:
        measurement = read_test(test, specimen, alone)
        folder = _result_folder(out, test, specimen, model)
        from foamfit import api

        params = _params(measurement, model, search, fix, vary)
        compile_rest()
        tell = None if quiet else lambda told: say(f"foamfit: {told}", err=True)
        with _progress(quiet or as_json) as progress:
            if several is not None:
                from foamfit.study.cycles import fit_cycles

                found = fit_cycles(
                    test, specimen, cycles=several or None, model=model, progress=progress,
                    params=lambda one: _params(one, model, search, fix, vary), tell=tell, **search,
                )  # fmt: skip
            else:
                result = api.fit(
                    measurement, model=model, params=params, progress=progress, tell=tell, **search
                )
        if several is not None:
            return _tell_cycles(found, folder, as_json, quiet)
        try:
            with without_ctrl_c():
                result.save(folder)
        except InputError:  # the numbers are not lost with the folder
            _tell_result(result, as_json, quiet, verbose)
            raise
    _tell_result(result, as_json, quiet, verbose)
    if not quiet and not as_json:
        say(f"\nwritten to {folder}: open {folder / 'report.html'}")
    if result.status == "failed":
        say(f"foamfit: no acceptable fit was found; see {folder}", err=True)
        return NOT_ACCEPTABLE
    return 0


def _cycles(text: str | None) -> tuple[int | None, tuple[int, ...] | None]:
    """Read --cycle: the one cycle that is named, or the several that are ("all" names none)."""
    if text is None or text.strip().lower() == "all":
        return None, None if text is None else ()
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--cycle {text!r} must be a number from 1 up, several as 1,2,10, or all")
    numbers = tuple(int(part) for part in parts)
    return (None, numbers) if len(numbers) > 1 else (numbers[0], None)


def _tell_cycles(found: CycleFits, folder: Path, as_json: bool, quiet: bool) -> int:
    """Write and print the fits of several cycles; returns the exit code."""
    import json

    from foamfit.report.cycles import cycles_text

    content = found.to_json_dict()
    content["cycles"] = {n: one.to_json_dict() for n, one in sorted(found.results.items())}
    shown = json.dumps(content, allow_nan=False) if as_json else cycles_text(found)
    try:
        with without_ctrl_c():
            found.save(folder)
    finally:  # the numbers are not lost with the folder
        if as_json or not quiet:
            say(shown)
    if not quiet and not as_json:
        say(f"\nwritten to {folder}: open {folder / 'cycles.png'}")
    good = [n for n, one in found.results.items() if one.status != "failed"]
    if not good:
        say(f"foamfit: no acceptable fit of any cycle was found; see {folder}", err=True)
    return 0 if good else NOT_ACCEPTABLE


def _tell_result(result: FitResult, as_json: bool, quiet: bool, verbose: bool) -> None:
    """Print a result."""
    if as_json:
        import json

        say(json.dumps(result.to_json_dict(), allow_nan=False))
    elif not quiet:
        from foamfit.report.summary import summary_text

        say(summary_text(result, verbose=verbose))


def _result_folder(out: Path | None, test: Path, specimen: Path | None, model: str) -> Path:
    """Return the folder for a result, which must not be one that would be lost."""
    from foamfit.report.folder import check_target

    folder = Path("fits", test.stem, model) if out is None else out
    check_target(folder)
    for path in (test, specimen or test.with_suffix(".toml")):
        if folder.resolve() in path.resolve().parents and folder.is_dir():
            raise InputError(
                f"{folder} holds {path.name} and would be replaced as a whole; choose another --out"
            )
    return folder


@contextmanager
def _compiling(
    quiet: bool, model: str = "bistable", relaxation: int = 0
) -> Iterator[Callable[[], None]]:
    """Compile at first use, beside the body; it calls what is given before it simulates."""
    import logging

    from foamfit.solve import cache, precompile

    if quiet:  # what is compiled later is announced by the log
        logging.getLogger("foamfit").setLevel(logging.ERROR)
    memory = model == "auto" or "microscale" in model or relaxation > 0
    integrator = (model == "auto" or not memory) and not cache.compiled()
    memory = memory and not cache.compiled("relaxed_along")
    if not (integrator or memory):
        yield lambda: None
        return
    if not quiet:
        say("foamfit: compiling the solver, once after installation", err=True)
    with precompile.side_by_side(integrator, memory) as finish:
        yield finish


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Give a progress bar on stderr; silent when stderr is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda fraction, what: None
        return
    with click.progressbar(length=1000, label="fit", file=sys.stderr, show_eta=False) as bar:

        def progress(fraction: float, what: str) -> None:
            bar.label = f"fit: {what:<10}"
            bar.update(round(1000 * fraction) - bar.pos)

        yield progress


@main.command()
@click.argument("scene", metavar="SCENE.toml", type=_FILE)
@click.option("--out", type=_FILE, help="CSV. Default: SCENE.csv here.")
@_PLOT
@click.option(
    "--rtol", type=click.FloatRange(1e-14, 0.1), default=1e-6, show_default=True,
    help="Wanted error over the range.",
)  # fmt: skip
def simulate(scene: Path, out: Path | None, plot: Path | None, rtol: float) -> None:
    """Run any chain under any drive forward and write its response as CSV.

    \b
    SCENE.toml, for example:
        [chain]
        diameter = "5 mm"
        [[chain.springs]]               # from the base up
        kind = "bistable"               # or "microscale", "linear", "unilateral"
        height = "1.19 mm"
        k0 = "5.5 MPa"
        kc = "82.5 MPa"
        dsigma = "-0.179 MPa"
        eps_a = 0.14
        eps_c = 0.31
        kh_plus = "14.3 MPa"
        kh_minus = "2.34 MPa"
        [drive]
        kind = "impact"                 # or "stress", "displacement" with file = "drive.csv"
        mass = "7 g"
        velocity = "2 m/s"
        [time]
        end = "1 ms"
        samples = 501
    Instead of the springs, published = "foam-1/model-3" under [chain] takes a published set. A
    microscale spring has k0, kc, eps_star, sigma_plus, spread_plus, sigma_minus and spread_minus;
    it and the bistable one may relax: relaxation = [{ g = 0.5, tau = "0.2 s" }].
    """
    from foamfit.scene_file import files_of_scene, read_scene, write_response
    from foamfit.solve.simulation import simulate as run

    target = Path(scene.with_suffix(".csv").name) if out is None else out
    _check_files(target, plot, files_of_scene(scene))
    with _compiling(quiet=False) as compile_rest:
        chain, drive, time = read_scene(scene)
        compile_rest()
    response = run(chain, drive, time, rtol)
    write_response(response, target)
    say(f"{response.solver}, {response.time.size} samples, written to {target}")
    if plot is not None:
        from foamfit.report.plots import plot_response

        plot_response(response, plot)
        say(f"drawn in {plot}")


def _check_files(table: Path | None, plot: Path | None, inputs: Iterable[Path]) -> None:
    """Refuse files that could not be written, or that are read too, before anything is computed."""
    given = [path for path in (table, plot) if path is not None]
    for path in given:
        check_file(path)
        if path.resolve() in [source.resolve() for source in inputs]:
            raise InputError(f"{path} is read by this command and would be lost; name another file")
    if len({path.resolve() for path in given}) < len(given):
        raise InputError(f"{given[0]} cannot be two things; name two files")
    if plot is not None:
        from foamfit.report.figures import figure_format

        figure_format(plot)


@main.command()
@click.argument("results", metavar="RESULT [RESULT …]", nargs=-1, required=True, type=_FILE)
@click.option(
    "--published", "name", metavar="NAME",
    help="The published set to compare with. Default: the one that the name of the test contains.",
)  # fmt: skip
@_PLOT
@click.option("--csv", "table", type=_FILE, help="Also write a table.")
def compare(
    results: tuple[Path, ...], name: str | None, plot: Path | None, table: Path | None
) -> None:
    """Put result folders beside the published parameters, or beside the first of them.

    \b
    Examples:
        foamfit compare fits/foam-1/model-1/impact fits/foam-1/model-1/stress
        foamfit compare fits/TEST/bistable --published foam-1/model-1 --plot comparison.png
    """
    from foamfit.report.comparison import compare as side_by_side
    from foamfit.report.comparison_plot import plot_comparison
    from foamfit.report.comparison_text import comparison_text, write_csv

    _check_files(table, plot, [p / "fit.json" if p.is_dir() else p for p in results])
    comparison = side_by_side(results, name)
    say(comparison_text(comparison))
    if plot is not None:
        plot_comparison(comparison, plot)
        say(f"\ndrawn in {plot}")
    if table is not None:
        write_csv(comparison, table)
        say(f"\nwritten to {table}")


@main.command()
def published() -> None:
    """Print the published parameter sets and their derived points."""
    from foamfit.springs.published import table

    say(table())
