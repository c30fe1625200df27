"""Output to the terminal, and signals."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import unicodedata
from codecs import register_error
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from types import FrameType
from typing import Any, TextIO

from foamfit.errors import InputError

# Signals that ask a process to end: Ctrl-C, `kill`, and on POSIX the end of the terminal.
ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
# Control characters except tab and new line, and characters that reverse the direction of writing:
# in a file name they could move the cursor or hide text. Also surrogates (non-UTF-8 bytes).
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""Escape control characters, as in "\x1b", but not new lines."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Write a minus as "-", an index as a digit, and escape all else that an encoding lacks."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end].replace("\N{MINUS SIGN}", "-")
    plain = unicodedata.normalize("NFKC", lacking)
    return plain.encode("ascii", "backslashreplace").decode(), error.end


register_error("foamfit-in-ascii", _in_ascii)


def show_all() -> None:
    """Let stdout replace characters that its encoding lacks, as cp1252 of a pipe on Windows."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="foamfit-in-ascii")


def say(text: str, *, err: bool = False, newline: bool = True) -> None:
    """Print a text on stdout or stderr; InputError if stdout cannot be written (disk full).

    If the reader closes the pipe, as `head` does, the rest is discarded without an error.
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
        nowhere = os.open(os.devnull, os.O_WRONLY)  # for buffered and all further output
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        if not isinstance(error, BrokenPipeError):
            raise InputError(
                f"standard output cannot be written: {error.strerror or error}; give it room or "
                "redirect it elsewhere"
            ) from None


class TerminatedError(KeyboardInterrupt):
    """Raised on SIGTERM, or when the terminal is closed; the message is the name of the signal.

    Like Ctrl-C it keeps the best point found so far.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def _terminate(number: int, frame: FrameType | None) -> None:
    raise TerminatedError(number)


@contextmanager
def ending_cleanly() -> Iterator[None]:
    """Turn SIGTERM and a closed terminal into an exception, so that no partial file stays behind.

    Neither these nor Ctrl-C are lost in code that cannot raise, such as numba's callbacks when it
    loads compiled code.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    taken = [number for number in ENDING if signal.getsignal(number) is signal.SIG_DFL]
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
    """Send a signal again if Python has ignored its exception; a hook of `sys`."""
    if not isinstance(lost.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    number = getattr(lost.exc_value, "number", signal.SIGINT)
    again = threading.Timer(0.02, signal.raise_signal, (number,))
    again.daemon = True
    again.start()


@contextmanager
def without_ctrl_c() -> Iterator[None]:
    """Ignore Ctrl-C in the body, where it would only lose results."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
