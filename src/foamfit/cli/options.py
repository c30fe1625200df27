"""What several commands share: options, the compilation at first use, progress, files to write."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.errors import InputError
from foamfit.files import check_file
from foamfit.terminal import say

if TYPE_CHECKING:
    from concurrent.futures import Future

    from foamfit.study.processes import Processes

FILE = click.Path(path_type=Path)
TEST = click.argument("test", metavar="TEST.csv", type=FILE)
SPECIMEN = click.option(
    "--specimen", metavar="FILE.toml", type=FILE,
    help="Specimen, striker, columns, noise, window, data. Default: TEST.toml beside the CSV.",
)  # fmt: skip
CYCLE = click.option(
    "--cycle", metavar="N|all",
    help="Cycle of a slow record: a number, several as 1,2,10, or all. Default: the first.",
)  # fmt: skip
PLOT = click.option(
    "--plot", type=FILE,
    help="Also draw a PNG, PDF or SVG; what is plotted in it is beside it as CSV.",
)  # fmt: skip


def _width(context: click.Context, option: click.Parameter, value: str) -> str:
    """Refuse what is no width before anything is computed."""
    if value not in ("one", "two"):  # these need no import
        from foamfit.report.figures import inches

        inches(value)
    return value


WIDTH = click.option(
    "--figure-width", metavar="one|two|LENGTH", default="two", show_default=True, callback=_width,
    help='Width of figures: one column (3.25 in), two (7 in), or a length as "85 mm".',
)  # fmt: skip
NO_REPORT = click.option(
    "--no-report", is_flag=True, help="Tables alone: no report and no figures of each fit."
)
_OPENING = "foamfit.open"  # whether the command of a context is to open what it writes


def _keep_open(context: click.Context, option: click.Parameter, value: bool) -> None:
    context.meta[_OPENING] = value


OPEN = click.option(
    "--open", is_flag=True, expose_value=False, callback=_keep_open,
    help="Open what was found in the browser, also with exit code 2; not together with --json.",
)  # fmt: skip
DRIVE = click.option(
    "--drive",
    type=click.Choice(["impact", "stress", "displacement"]),
    help="Default: impact if striker and time are known, else displacement.",
)  # fmt: skip
RELAXATION = click.option(
    "--relaxation", type=click.IntRange(min=0), default=0, show_default=True, metavar="N",
    help="Relaxation terms of every bistable and microscale spring; auto tries one by itself.",
)  # fmt: skip


def cycles_of(text: str | None) -> tuple[int | None, tuple[int, ...] | None]:
    """Read --cycle: the one cycle that is named, or the several that are ("all" names none)."""
    if text is None or text.strip().lower() == "all":
        return None, None if text is None else ()
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--cycle {text!r} must be a number from 1 up, several as 1,2,10, or all")
    numbers = tuple(int(part) for part in parts)
    return (None, numbers) if len(numbers) > 1 else (numbers[0], None)


@contextmanager
def compiling(
    quiet: bool, model: str = "bistable", relaxation: int = 0
) -> Iterator[Callable[[], None]]:
    """Compile at first use, beside the body; it calls what is given before it simulates."""
    import logging

    from foamfit.solve import cache, precompile

    if quiet:  # what is compiled later is announced by the log
        logging.getLogger("foamfit").setLevel(logging.ERROR)

    def tell() -> None:
        if not quiet:
            say(f"foamfit: {cache.compiling('the solver')}", err=True)

    with precompile.at_first_use(model, relaxation, tell) as finish:
        yield finish


class Drawers:
    """Two processes that draw figures, once they have begun and where there are two cores.

    They import what they need beside the process that begins them, which then need not. Where they
    cannot be had, or end before they are done, that process draws.
    """

    def __init__(self) -> None:
        self._pool: Processes | None = None

    def begin(self) -> None:
        """Start the processes."""
        from foamfit.study import processes

        if processes.cores() > 1:
            with suppress(OSError):  # the machine gives no more processes
                self._pool = processes.Processes(2, processes.DRAWING)

    def map(self, draw: Callable[[str], Any], names: Iterable[str]) -> Iterable[Any]:
        """Begin to draw; what is given is waited for when it is asked for."""
        if self._pool is None:
            return map(draw, names)
        begun = [(name, self._pool.submit(draw, name)) for name in names]
        return (_drawn(one, draw, name) for name, one in begun)

    def stop(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.stop()


def _drawn(begun: Future[Any], draw: Callable[[str], Any], name: str) -> Any:
    """What a process has drawn, or else this one draws, and says what is wrong with the figure."""
    try:
        return begun.result()
    except Exception:
        return draw(name)


@contextmanager
def drawing_beside() -> Iterator[Drawers]:
    """Give drawers, which are stopped at the end."""
    drawers = Drawers()
    try:
        yield drawers
    finally:
        drawers.stop()


def check_open(as_json: bool, no_report: bool = False) -> None:
    """Refuse --open where JSON alone is printed (a browser may print too), or no page is made."""
    for option, given in (("json", as_json), ("no-report", no_report)):
        if click.get_current_context().meta[_OPENING] and given:
            raise InputError(f"--open and --{option} exclude each other; leave one of them out")


def tell_written(page: Path, silent: bool) -> None:
    """Say where a result is and which page of it to look at; with --open open that."""
    if not silent:
        say(f"\nwritten to {page.parent}" + (f": open {page}" if page.is_file() else ""))
    if not click.get_current_context().meta[_OPENING]:
        return
    import webbrowser

    try:
        opened = webbrowser.open(page.resolve().as_uri())
    except (webbrowser.Error, OSError):
        opened = False
    if not opened:
        say(f"foamfit: no browser could be opened; open {page} by hand", err=True)


def spare(folder: Path, inputs: Iterable[Path]) -> None:
    """Refuse a result folder that holds a file which the command reads."""
    for path in inputs:
        if folder.is_dir() and folder.resolve() in path.resolve().parents:
            raise InputError(
                f"{folder} holds {path.name} and would be replaced as a whole; choose another --out"
            )


def check_files(table: Path | None, plot: Path | None, inputs: Iterable[Path]) -> bool:
    """Refuse files that could not be written, or that are read too, before anything is computed.

    Returns whether what is plotted needs a table of its own: `table` may be it already.
    """
    given = [path for path in (table, plot) if path is not None]
    for path in given:
        check_file(path)
        if path.resolve() in [source.resolve() for source in inputs]:
            raise InputError(f"{path} is read by this command and would be lost; name another file")
    if len({path.resolve() for path in given}) < len(given):
        raise InputError(f"{given[0]} cannot be two things; name two files")
    if plot is None:
        return False
    from foamfit.report.figures import check_table, figure_format

    figure_format(plot)
    data = plot.with_suffix(".csv")
    if table is not None and data.resolve() == table.resolve():
        return False
    check_table(data)
    return True
