"""The group of all commands, with exit codes and errors, and what several commands share."""

from __future__ import annotations

import atexit
import functools
import gc
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from foamfit import terminal
from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.files import check_file
from foamfit.options import OPTIONS
from foamfit.terminal import TerminatedError, ending_cleanly, progress_line, say, without_ctrl_c

if TYPE_CHECKING:
    from foamfit.report.folder import Result

Command = Callable[..., Any]
FILE, COUNT = click.Path(path_type=Path), click.IntRange(min=1)
# Exit codes: the input or the call is wrong; no acceptable fit; a defect (EX_SOFTWARE of
# sysexits.h); ended by a signal, to which the number of the signal is added.
WRONG, NOT_ACCEPTABLE, DEFECT, SIGNALLED = 1, 2, 70, 128


def _load_laws(context: click.Context, option: click.Parameter, files: tuple[str, ...]) -> None:
    """Register the laws in the files of --law before anything else is done."""
    for file in files:
        from foamfit.springs import laws

        laws.load_file(file)


class _Group(click.Group):
    """A group whose commands all have --law, and whose errors are one sentence."""

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        cmd.params.append(
            click.Option(
                ["--law"],
                multiple=True,
                metavar="FILE.py",
                is_eager=True,
                expose_value=False,
                callback=_load_laws,
                help="Register the spring laws that a Python file defines; the file is executed.",
            )
        )
        super().add_command(cmd, name)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        kwargs["standalone_mode"] = False
        gc.set_threshold(100_000, 20, 10)  # imported objects took it a quarter of a fit
        atexit.register(gc.freeze)
        if isinstance(sys.stdout, TextIOWrapper):
            sys.stdout.reconfigure(errors=terminal.IN_ASCII)
        try:
            with ending_cleanly(), as_signalled():
                code = super().main(*args, **kwargs)
                say("", newline=False)  # what click has printed
        except click.ClickException as error:
            _leave(WRONG, _one_sentence(error))
        except (InputError, SimulationError) as error:
            _leave(WRONG, str(error), getattr(error, "lines", ()))
        except (click.Abort, KeyboardInterrupt) as error:  # click turns the second into the first
            first = error.__cause__ or error
            if isinstance(first, TerminatedError):
                _leave(SIGNALLED + first.number, f"ended by {first}")
            _leave(SIGNALLED + signal.SIGINT, "interrupted by Ctrl-C")
        except Exception as error:
            if os.environ.get("FOAMFIT_TRACEBACK"):
                raise
            told = f"({type(error).__name__}: {error}); FOAMFIT_TRACEBACK=1 shows where it is"
            _leave(DEFECT, f"this is a defect of foamfit, please report it {told}")
        sys.exit(code if isinstance(code, int) else 0)


def _leave(code: int, message: str, lines: Sequence[str] = ()) -> NoReturn:
    """Print a line on stderr, below it lines that can be copied into a file, and exit."""
    say("\n    ".join([f"foamfit: {' '.join(message.split())}", *lines]), err=True)
    sys.exit(code)


def _one_sentence(error: click.ClickException) -> str:
    """Return click's message as one sentence that refers to --help."""
    message = error.format_message()
    value = isinstance(error, click.BadParameter) and not isinstance(error, click.MissingParameter)
    if isinstance(error, click.UsageError) and not value:
        path = error.ctx.command_path if error.ctx else "foamfit"
        message = message.replace(". Did you", ", did you").replace(". (Did you", " (did you")
        message = f"{message.rstrip('.?')}; see {path} --help"
    return message


@click.group(
    "foamfit",
    cls=_Group,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(package_name="foamfit", message="foamfit %(version)s")
@click.pass_context
def main(context: click.Context) -> None:
    """Identify the parameters of a foam from an impact or compression test.

    \b
    Check a test, then fit it (foamfit init TEST.csv writes the TOML for a test of yours):
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


def option(flag: str, text: str, kind: Any = None, **more: Any) -> Callable[[Command], Command]:
    """Declare an option; without a type, a metavar or a default it is a flag."""
    if kind is None and not more.keys() & {"metavar", "default"}:
        more["is_flag"] = True
    return click.option(*flag.split(), type=kind, help=text, **more)


def _width(context: click.Context, parameter: click.Parameter, value: str) -> str:
    """Reject an invalid width before anything is computed."""
    if value not in ("one", "two"):  # these need no import
        from foamfit.report.figures import inches

        inches(value)
    return value


TEST = click.argument("test", metavar="TEST.csv", type=FILE)


def _range(text: str) -> tuple[int, int]:
    """Return the first and the last cycle of --cycles."""
    first, dash, last = (part.strip() for part in text.partition("-"))
    if not (dash and first.isdecimal() and last.isdecimal() and 0 < int(first) <= int(last)):
        raise click.BadParameter(f"'{text}' is not FIRST-LAST in that order, like 1-3.")
    return int(first), int(last)


def _cycles(text: str) -> int | tuple[int, ...]:
    """Return the value of --cycle: a number, several numbers, or () for "all"."""
    if text.strip().lower() == "all":
        return ()
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) > 0 for part in parts):
        raise click.BadParameter(f"{text!r} must be a number from 1 up, several as 1,2,10, or all")
    numbers = tuple(int(part) for part in parts)
    return numbers if len(numbers) > 1 else numbers[0]


def _fixes(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> dict[str, float] | None:
    """Return the parameters and values of --fix."""
    fixed = {}
    for text in values:
        name, _, number = text.partition("=")
        if name.strip() in fixed:
            raise click.BadParameter(f"'{name.strip()}' is given twice; fix it at one value.")
        try:
            fixed[name.strip()] = value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise click.BadParameter(f"'{text}' is not NAME=VALUE in SI, as s1_eta=0.")
    return fixed or None


# Options whose values the command parses by a rule of its own, not by their kind.
READ: dict[str, dict[str, Any]] = {
    "specimen": {"type": FILE},
    "cycle": {"type": _cycles},
    "cycles": {"type": _range},
    "fix": {"type": str, "multiple": True, "callback": _fixes},
    "vary": {"type": str, "multiple": True},
}


def declared(name: str, **more: Any) -> Callable[[Command], Command]:
    """Declare an option of `foamfit.options`; `more` are arguments of click that differ."""
    one = OPTIONS[name]
    how: dict[str, Any] = {"help": one.text, "default": one.default, "metavar": one.metavar or None}
    whole = click.IntRange(one.least, one.most)
    kinds: Any = {"bool": {"is_flag": True}, "int": {"type": whole}, "float": {"type": float}}
    how |= {"type": click.Choice(one.choices)} if one.choices else kinds.get(one.kind, {})
    return click.option(one.flag, **how | READ.get(name, {}) | more)


SPECIMEN, CYCLES = declared("specimen"), declared("cycles")
PLOT = option("--plot", "Also draw a PNG, PDF or SVG.", FILE)
WIDTH = option(
    "--figure-width",
    'Width of figures: one column (3.25 in), two (7 in), or a length like "85 mm". "two, untitled" '
    "omits titles.",
    default="two",
    metavar="one|two|LENGTH",
    callback=_width,
)


def together(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Combine options into one decorator; the help lists them in this order."""
    return lambda command: functools.reduce(lambda f, add: add(f), reversed(options), command)


@dataclass(frozen=True)
class Output:
    """Where a command writes its result folder, and what it prints."""

    out: Path | None
    no_report: bool
    figure_width: str
    opening: bool
    as_json: bool
    quiet: bool

    @property
    def silent(self) -> bool:
        """Whether only failures and a result as JSON are printed."""
        return self.quiet or self.as_json

    def folder(self, default: Path, of: str | None = None) -> Path:
        """Return the result folder; InputError if it must not be replaced by the result `of`."""
        from foamfit.report.folder import check_target

        folder = default if self.out is None else self.out
        check_target(folder, of=of)
        return folder

    def finish(
        self,
        found: Result,
        page: Path,
        *,
        check: Callable[[Path], object] = lambda _: None,
        verbose: bool = False,
        force: bool = False,
    ) -> int:
        """Save a result in the folder of `page`, print it and its place; return the exit code.

        If saving fails, the result is printed all the same. `check` may refuse a folder; `force`
        replaces a result of any kind.
        """
        from foamfit.report.folder import save_somewhere

        def save(place: Path, **how: Any) -> None:
            check(place)  # another fit may have written there in the meantime
            found.save(place, figure_width=self.figure_width, force=force, **how)

        try:
            with progress_line(self.silent, "result") as line, without_ctrl_c():
                line.progress(1.0, "writing the report")
                save_somewhere(save, page.parent, report=not self.no_report)
        finally:
            self.show(found.printed, functools.partial(found.text, verbose=verbose))
        self.tell_written(page)
        if found.failed:
            say(f"foamfit: no acceptable fit was found; see {page.parent}", err=True)
        return NOT_ACCEPTABLE if found.failed else 0

    def show(self, content: Callable[[], Any], text: Callable[[], str]) -> None:
        """Print a result as JSON or as text, whichever is asked for."""
        if self.as_json:
            say(json.dumps(content(), allow_nan=False))
        elif not self.quiet:
            say(text())

    def tell_written(self, page: Path) -> None:
        """Say where a result is and which page of it to look at; with --open open that."""
        if not self.silent:
            say(f"\nwritten to {page.parent}" + (f": open {page}" if page.is_file() else ""))
        if self.opening:
            open_page(page)


def open_page(page: Path) -> None:
    """Open a page in the browser, or say that it cannot be opened."""
    import webbrowser

    try:
        opened = webbrowser.open(page.resolve().as_uri())
    except (webbrowser.Error, OSError):
        opened = False
    if not opened:
        say(f"foamfit: no browser could be opened; open {page} by hand", err=True)


def output(folder: str, printed: str, *, always_page: bool = False) -> Callable[[Command], Command]:
    """Add the options of `Output` to a command; `folder` and `printed` complete its help.

    --open is rejected with --json (a browser may print on stdout), and with --no-report unless the
    command writes a page even so.
    """
    options = together(
        option("--out", f"Result folder. Default: {folder}.", FILE),
        option("--no-report", "Write tables only: no reports and no figures."),
        WIDTH,
        option("--open opening", "Open the report in the browser; not together with --json."),
        option("--json as_json", f"Print {printed} on stdout and nothing else."),
        option("--quiet", "Print nothing but failures."),
    )

    def add(command: Command) -> Command:
        @functools.wraps(command)
        def run(**given: Any) -> Any:
            wanted = Output(**{one.name: given.pop(one.name) for one in fields(Output)})
            if wanted.opening and (wanted.as_json or (wanted.no_report and not always_page)):
                other = "json" if wanted.as_json else "no-report"
                raise InputError(f"--open and --{other} exclude each other; leave one of them out")
            return command(output=wanted, **given)

        return options(run)

    return add


def check_plot(plot: Path | None) -> None:
    """Raise InputError if a figure cannot be written."""
    if plot is not None:
        from foamfit.report.figures import figure_format

        figure_format(plot)
        check_file(plot)


def compile_solver(quiet: bool, model: str = "bistable") -> None:
    """Compile at first use what the fit of a model needs, and say so unless `quiet`."""
    from foamfit.solve import cache, precompile

    if quiet:  # the log would announce later compilations
        logging.getLogger("foamfit").setLevel(logging.ERROR)

    tell = None if quiet else lambda: say(f"foamfit: {cache.compiling('the solver')}", err=True)
    precompile.compile_solver(model, tell)
