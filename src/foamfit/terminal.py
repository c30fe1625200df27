"""The terminal: text that it can show, and signals."""

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

# Control characters but tab and new line, and those that reverse the direction of writing: in a
# name they could move the cursor, colour the terminal or hide text. And surrogates, which stand for
# bytes that are not UTF-8.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
# What replaces a character that an encoding does not have; Greek letters are named.
_PAIRS = "−- –- ±+/- ·* …... →-> √sqrt µu ²^2 ³^3 ⁻^- ¹1 ∂d"
_INSTEAD = {pair[0]: pair[1:] for pair in _PAIRS.split()}


def printable(text: str) -> str:
    r"""Return a text with its control characters escaped, as in "\x1b"; lines stay lines."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def _instead(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that an encoding lacks by ASCII: an error handler of `codecs`."""
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
    """Let stdout and stderr replace characters that their encoding lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors != "foamfit.instead":
            stream.reconfigure(errors="foamfit.instead")


def say(text: str, *, err: bool = False, newline: bool = True) -> None:
    """Print a text on stdout or stderr; InputError if stdout cannot be written (a full disk).

    A reader that closes the pipe, as `head` does, is no error; the rest is not printed.
    """
    stream: TextIO | None = sys.stderr if err else sys.stdout
    if stream is None:  # closed by the parent process
        return
    try:
        stream.write(printable(text) + ("\n" if newline else ""))
        stream.flush()
    except OSError as error:
        if err:
            return
        nowhere = os.open(os.devnull, os.O_WRONLY)  # for what stdout holds, and all further output
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        if not isinstance(error, BrokenPipeError):
            raise InputError(
                f"standard output cannot be written: {error.strerror or error}; give it room or "
                "redirect it elsewhere"
            ) from None


class TerminatedError(KeyboardInterrupt):
    """The signal `number` asks the process to end: SIGTERM, or SIGHUP of a closed terminal.

    Like Ctrl-C it keeps what was found. Its text is the name of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def _terminate(number: int, frame: FrameType | None) -> None:
    raise TerminatedError(number)


def _handles_signals() -> bool:
    """Whether this thread may install signal handlers."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def ending_cleanly() -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into an exception, so that nothing half-written stays behind.

    Neither these nor Ctrl-C get lost in code that cannot raise, such as the callbacks by which
    numba loads compiled code.
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
    """Send a signal again whose exception was ignored: a hook of `sys`."""
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
    """Ignore Ctrl-C in the body, where it could only lose results."""
    if not _handles_signals():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
