"""The command `foamfit`: help, exit codes, and errors as one sentence."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from foamfit.errors import InputError, SimulationError, as_signalled
from foamfit.terminal import TerminatedError, ending_cleanly, say, show_all

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
        show_all()
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
