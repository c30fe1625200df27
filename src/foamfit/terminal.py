"""What the command and its terminal tell each other: text that can be shown, and signals."""

from __future__ import annotations

import codecs
import os
import re
import signal
import sys
import threading
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from types import FrameType
from typing import Any, TextIO

from foamfit.errors import InputError

# Control characters but tab and new line, and what turns the direction of writing round: in a name
# they would move the cursor, colour the terminal or hide what stands there. And what Python makes
# of file names that are no Unicode.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
# What replaces a character that an encoding does not have; Greek letters are named.
_PAIRS = "−- –- ±+/- ·* …... →-> √sqrt µu ²^2 ³^3 ⁻^- ¹1 ∂d"
_INSTEAD = {pair[0]: pair[1:] for pair in _PAIRS.split()}


def printable(text: str) -> str:
    r"""Return a text with its control characters written out, as in "\x1b"; lines stay lines."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def _instead(error: UnicodeError) -> tuple[str, int]:
    """Replace what an encoding does not have by ASCII: an error handler of `codecs`."""
    assert isinstance(error, UnicodeEncodeError)
    told = ""
    for character in error.object[error.start : error.end]:
        match unicodedata.name(character, "").split():
            case ["GREEK", size, "LETTER", letter]:
                told += letter.lower() if size == "SMALL" else letter.capitalize()
            case ["COMBINING", *_]:
                pass
            case _:
                told += _INSTEAD.get(character, "?")
    return told, error.end


codecs.register_error("foamfit.instead", _instead)


def show_all() -> None:
    """Let stdout and stderr replace what their encoding does not have, where they would fail."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors != "foamfit.instead":
            stream.reconfigure(errors="foamfit.instead")


def say(text: str, *, err: bool = False, newline: bool = True) -> None:
    """Print a text on stdout or stderr; InputError if stdout cannot be written, as to a full disk.

    A reader that has enough, as `head`, is no error; what is left is then not printed.
    """
    stream: TextIO | None = sys.stderr if err else sys.stdout
    if stream is None:  # closed by whoever started this process
        return
    try:
        stream.write(printable(text) + ("\n" if newline else ""))
        stream.flush()
    except OSError as error:
        if err:  # there is nowhere left to say it
            return
        drop_output()
        if not isinstance(error, BrokenPipeError):
            raise InputError(
                f"standard output cannot be written: {error.strerror or error}; give it room or "
                "redirect it elsewhere"
            ) from None


def drop_output() -> None:
    """Send what stdout still holds, and what is yet to come, nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


class TerminatedError(KeyboardInterrupt):
    """The process is asked to end, by the signal `number`: SIGTERM, or its terminal has gone.

    As Ctrl-C it keeps what was found. Its text is the name of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def _terminate(number: int, frame: FrameType | None) -> None:
    raise TerminatedError(number)


def _handles_signals() -> bool:
    """Whether this is the thread that may say what signals do."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def ending_cleanly() -> Iterator[None]:
    """Make SIGTERM and SIGHUP an exception, so that nothing half done stays behind.

    Neither these nor Ctrl-C are lost in code that cannot raise, as the callbacks by which numba
    loads what it compiled.
    """
    if not _handles_signals():
        yield
        return
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    taken = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, _terminate)
    told, sys.unraisablehook = sys.unraisablehook, _raise_again
    try:
        yield
    finally:
        sys.unraisablehook = told
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def _raise_again(lost: Any) -> None:
    """Send a signal once more whose exception was ignored: a hook of `sys`."""
    if isinstance(lost.exc_value, TerminatedError):
        number = lost.exc_value.number
    elif isinstance(lost.exc_value, KeyboardInterrupt):
        number = signal.SIGINT
    else:
        sys.__unraisablehook__(lost)
        return
    again = threading.Timer(0.02, signal.raise_signal, (number,))
    again.daemon = True
    again.start()


@contextmanager
def without_ctrl_c() -> Iterator[None]:
    """Let Ctrl-C wait for the end of the body, where it could only lose what was found."""
    if not _handles_signals():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
