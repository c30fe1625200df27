"""Errors raised by foamfit, and Ctrl-C inside compiled code."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from numbers import Integral


class InputError(ValueError):
    """A file, key, column, option or argument is wrong; the message says how to correct it.

    Any other ValueError (such as numpy's LinAlgError) is a defect of foamfit. The command prints
    `lines` below the message, for the user to copy into a file.
    """

    def __init__(self, message: str = "", lines: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.lines = lines


class UnknownLawError(InputError):
    """A law is not known in this process, so a result of it may be whole."""


def check_whole(name: str, value: object, least: int) -> None:
    """Raise InputError unless an argument is a whole number from `least` up."""
    if not isinstance(value, Integral) or isinstance(value, bool) or int(value) < least:
        raise InputError(
            f"{name} = {value!r} is not admissible; it must be a whole number from {least} up"
        )


@contextmanager
def naming(path: object) -> Iterator[None]:
    """Put the path of the file in front of an InputError raised by the body."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}", error.lines) from None


class SimulationError(RuntimeError):
    """A simulation cannot continue; the message says why. Simulations never return NaN."""


@contextmanager
def as_signalled() -> Iterator[None]:
    """Raise KeyboardInterrupt where Python has turned it into a SystemError.

    This happens if Ctrl-C or a signal arrives while a compiled loop returns its result.
    """
    try:
        yield
    except SystemError as error:
        raise_signal(error)
        raise


def raise_signal(error: SystemError) -> None:
    """Raise the KeyboardInterrupt that Python has turned into a SystemError, if there is one."""
    first: BaseException | None = error
    while isinstance(first, SystemError):  # one for each nested compiled loop
        first = first.__cause__ or first.__context__
    if first is not None and not isinstance(first, Exception):
        raise first from None
